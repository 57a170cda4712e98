//! Embeds the viewer for browsers if it was built (`cargo xtask browser`): the folder that `LODESTREAM_VIEWER` names, or
//! `browser/bundle` in cargo's target folder. A server without it says so on its pages.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-env-changed=LODESTREAM_VIEWER");
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo says where"));
    let folder = match std::env::var_os("LODESTREAM_VIEWER") {
        Some(folder) => PathBuf::from(folder),
        None => {
            // OUT_DIR is target/PROFILE/build/PACKAGE/out, with the platform before the profile in a cross build.
            // A folder that was copied may lack cargo's tag.
            let is_target =
                |folder: &&Path| folder.join("CACHEDIR.TAG").exists() || folder.join("browser/bundle").exists();
            let target = out.ancestors().skip(4).find(is_target);
            let folder = target.map_or_else(|| out.join("none"), |target| target.join("browser/bundle"));
            // A path that does not exist would make cargo build this crate anew each time.
            fs::create_dir_all(&folder)?;
            folder
        }
    };
    println!("cargo::rerun-if-changed={}", folder.display());
    let mut files = Vec::new();
    collect(&folder, "", &mut files)?;
    files.sort();
    let mut code = String::from("pub(super) static FILES: &[(&str, &[u8])] = &[\n");
    for (name, path) in files {
        writeln!(code, "    ({name:?}, include_bytes!({path:?})),").expect("text takes all");
    }
    code.push_str("];\n");
    fs::write(out.join("viewer_files.rs"), code)
}

fn collect(folder: &Path, prefix: &str, files: &mut Vec<(String, PathBuf)>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        if entry.file_type()?.is_dir() {
            // A page and one folder: nothing lies deeper.
            if prefix.is_empty() {
                collect(&entry.path(), &format!("{name}/"), files)?;
            }
        } else {
            files.push((name, entry.path()));
        }
    }
    Ok(())
}
