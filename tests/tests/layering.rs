//! The direction of imports and the homes of the crates that tie code to a platform, read from the sources.

use std::path::{Path, PathBuf};

/// A source file: path from the workspace's root with `/`, and its lines without comments.
struct Source {
    path: String,
    lines: Vec<String>,
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the package lies in the workspace");
    let mut files = Vec::new();
    for folder in ["protocol/src", "server/src", "client/src"] {
        collect(&root.join(folder), &mut files);
    }
    assert!(files.len() > 50, "only {} files: were the crates moved?", files.len());
    files.sort();
    let read = |path: PathBuf| {
        let text = std::fs::read_to_string(&path).expect("a source file is text");
        let relative = path.strip_prefix(root).expect("it lies below the root");
        let parts: Vec<_> = relative.iter().map(|part| part.to_string_lossy()).collect();
        Source { path: parts.join("/"), lines: text.lines().map(|line| code(line).to_owned()).collect() }
    };
    files.into_iter().map(read).collect()
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("the crate has sources") {
        let path = entry.expect("the folder can be read").path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
}

/// The line without its comment. An address in a string is cut too, which hides no path of Rust.
fn code(line: &str) -> &str {
    line.split_once("//").map_or(line, |(code, _)| code)
}

/// Whether `word` stands in `line`, not as a part of a longer name.
fn names(line: &str, word: &str) -> bool {
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    line.match_indices(word)
        .any(|(at, _)| !line[..at].ends_with(is_name) && !line[at + word.len()..].starts_with(is_name))
}

/// Whether `line` uses something of a crate or module: a path through it, or an import of it.
fn uses(line: &str, path: &str) -> bool {
    names(line, path) && (line.contains(&format!("{path}::")) || line.trim_start().starts_with("use "))
}

/// Lines on which `is_wrong` holds in files outside the `homes`, which are folders (ending in `/`) or files.
fn offenders(sources: &[Source], homes: &[&str], is_wrong: impl Fn(&str) -> bool) -> Vec<String> {
    let is_home = |path: &str| homes.iter().any(|home| path == *home || home.ends_with('/') && path.starts_with(home));
    let mut found = Vec::new();
    for source in sources.iter().filter(|source| !is_home(&source.path)) {
        for (number, line) in (1..).zip(&source.lines) {
            if is_wrong(line) {
                found.push(format!("{}:{number}: {}", source.path, line.trim()));
            }
        }
    }
    found
}

#[test]
fn names_are_told_from_parts_of_names() {
    assert!(uses("use tokio::net;", "tokio") && uses("    #[tokio::test]", "tokio") && uses("use tokio;", "tokio"));
    assert!(!uses("use tokio_tungstenite::x;", "tokio") && !uses(code("// tokio::net"), "tokio"));
    assert!(names("unsafe { x }", "unsafe") && !names("#![deny(unsafe_code)]", "unsafe"));
}

#[test]
fn platform_crates_stay_at_home() {
    let sources = sources();
    let homes: [(&str, &[&str]); 16] = [
        (
            "tokio",
            &[
                "server/src/runtime/",
                "server/src/http/",
                "server/src/cli/",
                "client/src/net/native.rs",
                "client/src/net/native/",
                "client/src/app/",
                "client/src/load/",
            ],
        ),
        // The tests of `snapshot` run a server of their own.
        (
            "tokio_tungstenite",
            &[
                "server/src/http/",
                "client/src/net/native.rs",
                "client/src/net/native/",
                "client/src/app/snapshot/tests.rs",
            ],
        ),
        ("axum", &["server/src/http/"]),
        ("hyper", &["server/src/http/"]),
        ("hyper_util", &["server/src/http/"]),
        ("wgpu", &["client/src/render/", "client/src/app/window/screen.rs"]),
        ("winit", &["client/src/app/window/"]),
        ("egui", &["client/src/app/window/"]),
        ("wasm_bindgen", &["client/src/app/web.rs"]),
        ("web_sys", &["client/src/app/web.rs", "client/src/render/canvas.rs"]),
        ("bincode", &["protocol/src/wire.rs"]),
        ("memmap2", &["server/src/repository/mmap.rs"]),
        ("clap", &["server/src/cli/", "client/src/main.rs"]),
        ("indicatif", &["server/src/cli/"]),
        ("prometheus", &["server/src/runtime/metrics.rs"]),
        ("plotters", &["client/src/load/plot.rs", "client/src/load/page.rs"]),
    ];
    for (name, homes) in homes {
        let found = offenders(&sources, homes, |line| uses(line, name));
        assert!(found.is_empty(), "`{name}` belongs in {homes:?}:\n{}", found.join("\n"));
        let is_used = sources.iter().any(|source| source.lines.iter().any(|line| uses(line, name)));
        assert!(is_used, "`{name}` is used nowhere: does this test still read the sources right?");
    }
    // Content security policies know words with it, which are no keywords.
    let is_unsafe = |line: &str| names(&line.replace("unsafe-", "").replace("-unsafe", ""), "unsafe");
    let found = offenders(&sources, &["server/src/repository/mmap.rs"], is_unsafe);
    assert!(found.is_empty(), "`unsafe` is for the memory map alone:\n{}", found.join("\n"));
}

#[test]
fn the_ends_do_not_know_each_other() {
    for (folder, others) in [
        ("server/", &["lodestream_client"][..]),
        ("client/", &["lodestream_server"]),
        ("protocol/", &["lodestream_client", "lodestream_server"]),
    ] {
        let own: Vec<_> = sources().into_iter().filter(|source| source.path.starts_with(folder)).collect();
        let found = offenders(&own, &[], |line| others.iter().any(|other| names(line, other)));
        assert!(found.is_empty(), "{folder} names {others:?}:\n{}", found.join("\n"));
    }
}

/// The modules of a crate and what each may import, itself aside.
type Layers<'a> = &'a [(&'a str, &'a [&'a str])];

const SERVER: Layers<'static> = &[
    ("mesh", &[]),
    ("pack", &["mesh"]),
    ("ingest", &["mesh", "pack"]),
    ("repository", &["mesh", "pack"]),
    ("session", &["mesh", "pack"]),
    ("judge", &["mesh", "pack", "session"]),
    ("picture", &["mesh", "pack", "session"]),
    ("runtime", &["pack", "session"]),
    ("http", &["pack", "picture", "repository", "runtime", "session"]),
    ("telemetry", &[]),
    ("config", &["http", "runtime", "session", "telemetry"]),
    (
        "cli",
        &[
            "config",
            "http",
            "ingest",
            "judge",
            "mesh",
            "pack",
            "picture",
            "repository",
            "runtime",
            "session",
            "telemetry",
        ],
    ),
];

const CLIENT: Layers<'static> = &[
    ("camera", &[]),
    ("core", &[]),
    ("net", &[]),
    ("render", &[]),
    ("app", &["camera", "core", "net", "render"]),
    ("load", &["camera", "core", "net"]),
];

#[test]
fn modules_import_downward() {
    let sources = sources();
    for (folder, layers) in [("server/src/", SERVER), ("client/src/", CLIENT)] {
        for (module, allowed) in layers {
            let (file, below) = (format!("{folder}{module}.rs"), format!("{folder}{module}/"));
            let own = sources.iter().filter(|source| source.path == file || source.path.starts_with(&below));
            let mut count = 0;
            for source in own {
                count += 1;
                // `super` of these is the crate; further down it leads no further than the module.
                let is_top = source.path == file || source.path == format!("{below}mod.rs");
                for (number, line) in (1..).zip(&source.lines) {
                    let place = format!("{}:{number}: {}", source.path, line.trim());
                    let group = line.split_once("crate::{").map(|(_, group)| group);
                    assert!(
                        group.is_none_or(|group| group.contains('}')),
                        "{place}: one line, so that it can be checked"
                    );
                    for (other, _) in layers.iter().filter(|(other, _)| other != module && !allowed.contains(other)) {
                        let is_named = group.is_some_and(|group| names(group, other))
                            || names(line, &format!("crate::{other}"))
                            || is_top && names(line, &format!("super::{other}")) && !line.contains("super::super::");
                        assert!(!is_named, "{place}: `{module}` may import {allowed:?} only");
                    }
                }
            }
            assert!(count > 0, "{folder} has no module `{module}`");
        }
    }
}
