//! The viewer for browsers: its module, its glue and its page in one folder.

use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

use super::{release_programs, root, run, target_dir, wasm_cargo, wasm_toolchain};

/// Which modules are built.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Modules {
    /// All: the page takes the one for WebGL where there is no WebGPU.
    All,
    /// The one for WebGPU. The other compiles wgpu with its shader translator and takes three times as long.
    WebGpu,
}

/// Builds the modules and bundles them with the page. Servers that are built afterwards embed the folder.
pub(super) fn build(modules: Modules) -> Result<()> {
    if !wasm_toolchain() {
        bail!(
            "there is no toolchain for wasm32: `rustup target add wasm32-unknown-unknown`, or `cargo xtask setup` on Debian"
        );
    }
    let mut named = vec![format!("webgpu={}", module("web", "webgpu")?)];
    if modules == Modules::All {
        named.push(format!("webgl={}", module("web,webgl", "webgl")?));
    }
    let (web, out) = (root().join("client/web"), target_dir().join("browser/bundle"));
    let text = |path: &Path| path.to_str().map(str::to_owned).context("the path of the project is not UTF-8");
    let (web, out) = (text(&web)?, text(&out)?);
    let mut arguments = vec!["run", "--quiet", "-p", "lodestream-bundler", "--", &web, &out];
    arguments.extend(named.iter().map(String::as_str));
    run("cargo", &arguments, &[])
}

/// Builds the decoder of recorded sessions as the viewer is built and returns where the module is.
pub(super) fn decoder() -> Result<String> {
    // Where it finds most of what it needs.
    let folder = target_dir().join("browser/webgpu");
    wasm_cargo("build", &folder, &["-p", "lodestream-wasm-decoder", "--profile", "browser"])?;
    let module = folder.join("wasm32-unknown-unknown/browser/lodestream_wasm_decoder.wasm");
    Ok(module.to_str().context("the path of the project is not UTF-8")?.to_owned())
}

/// Whether npm answers: it starts node.
pub(super) fn has_node() -> bool {
    let asked = Command::new("npm").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    asked.is_ok_and(|status| status.success())
}

/// Whether the tests in a browser can run.
pub(super) fn can_test() -> bool {
    let chromium = std::env::var("CHROMIUM").unwrap_or_else(|_| "/usr/bin/chromium".into());
    Path::new(&chromium).exists() && has_node()
}

/// Runs the viewer in Chromium against the server that was built for the tests.
pub(super) fn test() -> Result<()> {
    let folder = root().join("tests/browser");
    let folder = folder.to_str().context("the path of the project is not UTF-8")?;
    run("npm", &["--prefix", folder, "ci", "--no-audit", "--no-fund"], &[])?;
    run("npm", &["--prefix", folder, "test"], &[])
}

/// Measures the viewer in Chromium (`tests/browser/measure.mjs`), in the caller's folder.
pub(super) fn measure(arguments: &[String]) -> Result<()> {
    if !can_test() {
        bail!("no node with npm, or no chromium (CHROMIUM names another): `cargo xtask setup` on Debian");
    }
    build(Modules::All)?;
    let [server, client] = release_programs()?;
    let mut arguments = arguments.to_vec();
    if arguments.first().is_some_and(|what| what == "decode") {
        arguments.extend(["--decoder".into(), decoder()?]);
    }
    let folder = root().join("tests/browser");
    let name = folder.to_str().context("the path of the project is not UTF-8")?;
    run("npm", &["--prefix", name, "ci", "--no-audit", "--no-fund"], &[])?;
    let status = Command::new("node")
        // Modules are compiled as browsers do after a second, so that short measurements are of that.
        .arg("--no-liftoff")
        .arg(folder.join("measure.mjs"))
        .args(&arguments)
        .env("SERVER_BIN", server)
        .env("CLIENT_BIN", client)
        .status()
        .context("cannot run node")?;
    if status.success() { Ok(()) } else { bail!("the measurement failed ({status})") }
}

/// Builds the client with these features, in a folder of this name, and returns where the module is. In one folder, a module of other features would
/// take its place, as modules have no hash in their names, and each build would begin anew.
fn module(features: &str, name: &str) -> Result<String> {
    let what = ["-p", "lodestream-client", "--lib", "--crate-type", "cdylib", "--profile", "browser"];
    let folder = target_dir().join("browser").join(name);
    wasm_cargo("rustc", &folder, &[&what[..], &["--no-default-features", "--features", features]].concat())?;
    let built = folder.join("wasm32-unknown-unknown/browser/lodestream_client.wasm");
    Ok(built.to_str().context("the path of the project is not UTF-8")?.to_owned())
}
