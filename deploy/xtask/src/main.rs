//! The project's commands, run as `cargo xtask <command>`.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Instant;

use anyhow::{Context, Result, bail};

mod browser;
mod growth;

const USAGE: &str = "usage: cargo xtask <command>

  demo [args]   build everything and run `lodestream-server demo`: a sample model, ingested and served
  browser       build the viewer for browsers (WebGPU, and WebGL 2 where that is missing) into target/browser/bundle, which servers built afterwards embed
  page WHAT [args]
                measure the viewer in Chromium: pictures, first, frames, flight or decode, with --repository DIR --model ID
  test          everything that has to pass: format, lints, tests, docs, browser build and its twin, fuzz smoke, 10^7 ops of soak
  fuzz [secs]   mutate frames, batches and mesh files for so many seconds per target (default 20)
  bench [args]  measure the figures of TARGETS.md: [ROW...] [FILE...] [--json] [--bits N] [--runs N]; models of LODESTREAM_MESHES
  paper [file..]
                measure what Southern, Blake and Marais (2001) report, and write docs/paper.md with a plot
  soak [ops]    random sessions until so many ops have crossed (default 10^8), both ends compared after each batch
  growth [n..]  ingest generated scans of so many triangles each and write docs/ingest-growth.md with a plot
  flight [minutes] [file..]
                random flight over slow links, 60 virtual minutes each: memory, limits, silences
  sessions [args]
                measure how sessions grow and write docs/session-growth.md with plots: [--sizes N,..] [--sessions N,..]
  setup         install what the tests need on Debian (needs root)
";

fn main() -> ExitCode {
    let mut args = std::env::args().skip(1);
    let command = args.next().unwrap_or_default();
    let rest: Vec<String> = args.collect();
    let result = match command.as_str() {
        "demo" => demo(&rest),
        "browser" => browser::build(browser::Modules::All),
        "page" => browser::measure(&rest),
        "test" => test(),
        "fuzz" => fuzz(rest.first().map_or("20", String::as_str)),
        "bench" => program("bench", &rest),
        "paper" => paper(&rest),
        "soak" => soak(rest.first().map_or("100000000", String::as_str)),
        "growth" => growth::growth(&rest),
        "sessions" => sessions(&rest),
        "flight" => program("flight", &rest),
        "setup" => setup(),
        _ => {
            eprint!("{USAGE}");
            return ExitCode::from(2);
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("xtask {command}: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).expect("deploy/xtask lies two levels down").to_path_buf()
}

/// Runs a command in the project's root, its output going through.
fn run(program: &str, args: &[&str], environment: &[(&str, &str)]) -> Result<()> {
    let line = format!("{program} {}", args.join(" "));
    println!("\n$ {line}");
    let start = Instant::now();
    let status = Command::new(program)
        .args(args)
        .envs(environment.iter().copied())
        .current_dir(root())
        .status()
        .with_context(|| format!("cannot run {program}"))?;
    println!("  ({:.0} s)", start.elapsed().as_secs_f64());
    if status.success() { Ok(()) } else { bail!("`{line}` failed ({status})") }
}

fn demo(args: &[String]) -> Result<()> {
    if wasm_toolchain() {
        browser::build(browser::Modules::All)?;
    } else {
        println!("without a wasm32 toolchain the demo's page has no viewer (cargo xtask setup installs one on Debian)");
    }
    println!("building the server and the client (a few minutes the first time)");
    let [server, _] = release_programs()?;
    let mut all = vec!["demo"];
    all.extend(args.iter().map(String::as_str));
    run(server.to_str().context("the path of the project is not UTF-8")?, &all, &[])
}

/// Builds the server and the client as they are shipped and returns where they are.
fn release_programs() -> Result<[PathBuf; 2]> {
    run("cargo", &["build", "--release", "-p", "lodestream-server", "-p", "lodestream-client"], &[])?;
    Ok(["lodestream-server", "lodestream"].map(|name| target_dir().join("release").join(name)))
}

fn paper(files: &[String]) -> Result<()> {
    let folder = root().join("docs");
    let folder = folder.to_str().context("the path of the project is not UTF-8")?;
    program("paper", &[&["--output".to_owned(), folder.to_owned()], files].concat())
}

fn sessions(arguments: &[String]) -> Result<()> {
    let folder = root().join("docs");
    let folder = folder.to_str().context("the path of the project is not UTF-8")?;
    program("session_growth", &[&["--output".to_owned(), folder.to_owned()], arguments].concat())
}

/// Builds and runs a program that measures in the caller's folder. Standard output is the program's alone.
fn program(name: &str, args: &[String]) -> Result<()> {
    eprintln!("building (minutes the first time)");
    let packages = ["-p", "lodestream-server", "-p", "lodestream-client", "-p", "lodestream-measure"];
    let build = ["build", "--release", "--quiet", "--bin", "lodestream-server", "--bin", "lodestream", "--bin", name];
    let built = Command::new("cargo").args(build).args(packages).current_dir(root()).status();
    if !built.context("cannot run cargo")?.success() {
        bail!("the build failed");
    }
    let status = Command::new(target_dir().join("release").join(name)).args(args).status();
    let status = status.with_context(|| format!("cannot run {name}"))?;
    if status.success() { Ok(()) } else { bail!("{name} failed ({status})") }
}

fn target_dir() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from)
}

fn test() -> Result<()> {
    let start = Instant::now();
    let missing = missing_tools();
    run("cargo", &["fmt", "--all", "--check"], &[])?;
    run("cargo", &["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"], &[])?;
    // The load tester builds without a renderer, the browser client without tokio: both feature sets keep the layers honest.
    let headless = ["clippy", "-p", "lodestream-client", "--no-default-features"];
    run("cargo", &[&headless[..], &["--features", "net-native", "--", "-D", "warnings"]].concat(), &[])?;
    run("cargo", &[&headless[..], &["--", "-D", "warnings"]].concat(), &[])?;
    // This builds the programs that the tests run, too. Built by themselves they would lack the features that only tests ask for,
    // and most of the workspace would be built twice.
    run("cargo", &["test", "--workspace"], &[])?;
    run("cargo", &["doc", "--workspace", "--no-deps", "--quiet"], &[("RUSTDOCFLAGS", "-D warnings")])?;
    if wasm_toolchain() {
        browser::build(browser::Modules::WebGpu)?;
        wasm_twin()?;
        if browser::can_test() {
            browser::test()?;
        }
    }
    built("fuzz", &["--seconds", "20"])?;
    // In the profile of the tests: its checks of arithmetic are worth the time.
    built("soak", &["10000000"])?;
    println!("\nall passed in {:.0} s", start.elapsed().as_secs_f64());
    if !missing.is_empty() {
        println!("not tested, for want of tools (`cargo xtask setup` installs them on Debian):");
        missing.iter().for_each(|what| println!("  {what}"));
    }
    Ok(())
}

/// What a test cannot run without, in words.
fn missing_tools() -> Vec<String> {
    let mut missing = Vec::new();
    let drivers = ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"];
    if cfg!(target_os = "linux") && !drivers.iter().any(|dir| Path::new(dir).is_dir()) {
        missing.push("images: no Vulkan driver (Debian: mesa-vulkan-drivers)".into());
    }
    if cfg!(target_os = "linux") && !Path::new("/usr/bin/Xvfb").is_file() {
        missing.push("window: no display for its tests (Debian: xvfb)".into());
    }
    if !wasm_toolchain() {
        missing.push("browser build: no wasm32 toolchain (Debian: rustc-web cargo-web rust-web-src lld-19)".into());
    }
    if !browser::can_test() {
        missing.push("browser tests: no node with npm, or no chromium (Debian: nodejs npm chromium)".into());
    }
    missing
}

/// Debian's compiler for the browser: the one that comes with library sources. Elsewhere `rustup target add` serves.
fn wasm_toolchain() -> bool {
    Path::new("/usr/lib/llvm-19/bin/wasm-ld").exists() && Path::new("/usr/bin/cargo").exists() || rustup_wasm_sysroot()
}

fn rustup_wasm_sysroot() -> bool {
    let output = Command::new("rustc").args(["--print", "sysroot"]).output();
    output.is_ok_and(|output| {
        let sysroot = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        Path::new(&sysroot).join("lib/rustlib/wasm32-unknown-unknown").is_dir()
    })
}

/// Checks that what the shared code decodes as built for browsers is what it decodes here.
fn wasm_twin() -> Result<()> {
    let module = browser::decoder()?;
    built("wasm_twin", &[&module])
}

/// Runs a program that was built with the tests: asked for by itself, cargo would build what it needs once more, with
/// fewer features.
fn built(name: &str, args: &[&str]) -> Result<()> {
    let program = target_dir().join("debug").join(name);
    run(program.to_str().context("the path of the project is not UTF-8")?, args, &[])
}

/// Runs cargo for browsers, building in `folder`.
fn wasm_cargo(command: &str, folder: &Path, arguments: &[&str]) -> Result<()> {
    let target = folder.to_str().context("the path of the project is not UTF-8")?;
    let common = [command, "--target", "wasm32-unknown-unknown", "--target-dir", target];
    if rustup_wasm_sysroot() {
        return run("cargo", &[&common[..], arguments].concat(), &[]);
    }
    let environment = [
        ("RUSTC_BOOTSTRAP", "1"),
        ("RUSTC", "/usr/bin/rustc"),
        ("RUSTFLAGS", "-C linker=wasm-ld-19"),
        ("CARGO_INCREMENTAL", "0"),
    ];
    run("/usr/bin/cargo", &[&common[..], &["-Zbuild-std=std,panic_abort"], arguments].concat(), &environment)
}

fn fuzz(seconds: &str) -> Result<()> {
    run("cargo", &["run", "--quiet", "-p", "lodestream-tests", "--bin", "fuzz", "--", "--seconds", seconds], &[])
}

fn soak(ops: &str) -> Result<()> {
    let args = ["run", "--quiet", "--release", "-p", "lodestream-tests", "--bin", "soak", "--", ops];
    run("cargo", &args, &[])
}

fn setup() -> Result<()> {
    let packages = ["mesa-vulkan-drivers", "xvfb", "rustc-web", "cargo-web", "rust-web-src", "lld-19", "chromium"];
    // A node that came another way is as good, and Debian's may not go with it.
    let node: &[&str] = if browser::has_node() { &[] } else { &["nodejs", "npm"] };
    run("apt-get", &["update", "-qq"], &[])?;
    let install = ["install", "-y", "-qq", "--no-install-recommends"];
    run("apt-get", &[&install[..], &packages, node].concat(), &[("DEBIAN_FRONTEND", "noninteractive")])
}
