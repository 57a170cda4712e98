//! `lodestream-bundler WEB OUT [NAME=MODULE.wasm]...`: what browsers get of the viewer, in one folder that a server embeds.
//!
//! Each module gets its glue from wasm-bindgen (of the version that its crate was built with, which is why this is no
//! installed program). All files but the page lie under a name that is the hash of their contents, so they can be cached
//! for ever, and each that shrinks lies there compressed too:
//!
//! ```text
//! OUT/index.html                   the page, with {{assets}} replaced by the hash
//! OUT/<hash>/main.js [.br] [.gz]   the files of WEB
//! OUT/<hash>/NAME.js, NAME.wasm    each module
//! ```

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};

const PAGE: &str = "index.html";
const USAGE: &str = "usage: lodestream-bundler WEB OUT [NAME=MODULE.wasm]...";

fn main() -> Result<()> {
    let mut args = std::env::args().skip(1);
    let (Some(web), Some(out)) = (args.next(), args.next()) else { bail!(USAGE) };
    let (web, out) = (PathBuf::from(web), PathBuf::from(out));
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(&web).with_context(|| format!("cannot read '{}'", web.display()))? {
        let path = entry?.path();
        if path.is_file() {
            files.insert(file_name(&path)?, read(&path)?);
        }
    }
    let page = files.remove(PAGE).with_context(|| format!("'{}' has no {PAGE}", web.display()))?;
    for argument in args {
        let (name, module) = argument.split_once('=').context(USAGE)?;
        bind(name, Path::new(module), &mut files)?;
    }
    let hash = hash(&files);
    let page = String::from_utf8(page).context("the page is not UTF-8")?;
    ensure!(page.contains("{{assets}}"), "the page does not say {{{{assets}}}}: it would find none");
    write(&out, &hash, &page.replace("{{assets}}", &hash), &files)
}

/// Glue and module under the names `NAME.js` and `NAME.wasm`.
fn bind(name: &str, module: &Path, files: &mut BTreeMap<String, Vec<u8>>) -> Result<()> {
    let bytes = read(module)?;
    let mut output = wasm_bindgen_cli_support::Bindgen::new()
        .input_bytes(name, bytes)
        .web(true)?
        .typescript(false)
        .omit_default_module_path(true)
        .remove_name_section(true)
        .remove_producers_section(true)
        .generate_output()
        .with_context(|| format!("no glue for '{}'", module.display()))?;
    ensure!(output.snippets().values().all(Vec::is_empty), "{name}: the page is alone, it cannot have snippets");
    files.insert(format!("{name}.js"), output.js().as_bytes().to_vec());
    files.insert(format!("{name}.wasm"), output.wasm_mut().emit_wasm());
    Ok(())
}

fn hash(files: &BTreeMap<String, Vec<u8>>) -> String {
    let mut all = Vec::new();
    for (name, bytes) in files {
        all.extend_from_slice(name.as_bytes());
        all.extend_from_slice(&(bytes.len() as u64).to_le_bytes());
        all.extend_from_slice(bytes);
    }
    format!("{:016x}", xxhash_rust::xxh3::xxh3_64(&all))
}

/// Writes beside the folder and puts it in its place, so that no build embeds a half of it.
fn write(out: &Path, hash: &str, page: &str, files: &BTreeMap<String, Vec<u8>>) -> Result<()> {
    let aside = out.with_extension("part");
    if aside.exists() {
        fs::remove_dir_all(&aside).with_context(|| format!("cannot remove '{}'", aside.display()))?;
    }
    let folder = aside.join(hash);
    fs::create_dir_all(&folder).with_context(|| format!("cannot make '{}'", folder.display()))?;
    let write = |path: PathBuf, bytes: &[u8]| {
        fs::write(&path, bytes).with_context(|| format!("cannot write '{}'", path.display()))
    };
    write(aside.join(PAGE), page.as_bytes())?;
    let mut sums = [0; 3];
    println!("{:24} {:>9} {:>9} {:>9}", "bytes of", "plain", "gzip", "brotli");
    for (name, bytes) in files {
        let (gzip, brotli) = (gzip(bytes)?, brotli(bytes)?);
        write(folder.join(name), bytes)?;
        for (extension, packed) in [("gz", &gzip), ("br", &brotli)] {
            if packed.len() < bytes.len() {
                write(folder.join(format!("{name}.{extension}")), packed)?;
            }
        }
        let sizes = [bytes.len(), gzip.len(), brotli.len()];
        println!("{name:24} {:9} {:9} {:9}", sizes[0], sizes[1], sizes[2]);
        (0..3).for_each(|k| sums[k] += sizes[k]);
    }
    println!("{:24} {:9} {:9} {:9}", "all", sums[0], sums[1], sums[2]);
    if out.exists() {
        fs::remove_dir_all(out).with_context(|| format!("cannot remove '{}'", out.display()))?;
    }
    fs::rename(&aside, out).with_context(|| format!("cannot make '{}'", out.display()))
}

fn gzip(bytes: &[u8]) -> Result<Vec<u8>> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    encoder.write_all(bytes)?;
    Ok(encoder.finish()?)
}

fn brotli(bytes: &[u8]) -> Result<Vec<u8>> {
    let mut packed = Vec::new();
    let params = brotli::enc::BrotliEncoderParams { quality: 11, lgwin: 22, ..Default::default() };
    brotli::BrotliCompress(&mut &*bytes, &mut packed, &params)?;
    Ok(packed)
}

fn read(path: &Path) -> Result<Vec<u8>> {
    fs::read(path).with_context(|| format!("cannot read '{}'", path.display()))
}

fn file_name(path: &Path) -> Result<String> {
    let name = path.file_name().and_then(|name| name.to_str());
    Ok(name.with_context(|| format!("'{}' has a name that is not UTF-8", path.display()))?.to_owned())
}
