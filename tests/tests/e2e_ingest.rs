//! Ingest that ends before it is done: the repository is as it was, and nothing is left behind.

use std::path::Path;
use std::time::{Duration, Instant};

use fastrand::Rng;
use lodestream_tests::meshes;
use lodestream_tests::server_process::{RUN_LIMIT, Running, TempDir, described, server, server_bin};

/// Kills per run; a soak sets more with `LODESTREAM_KILLS`.
const KILLS: u32 = 12;

fn ingest_words<'a>(file: &'a Path, repository: &'a Path) -> Vec<&'a str> {
    let [file, repository] = [file, repository].map(|path| path.to_str().expect("a path of ours"));
    // So little memory that temporary data go to files.
    vec!["ingest", file, "--repository", repository, "--name", "model", "--memory-limit", "320MiB", "--json"]
}

fn run(words: &[&str]) {
    let output = server(words);
    assert!(output.status.success(), "{}", described(&output));
}

/// Hash of the model, which is checked record by record.
fn verified_hash(repository: &Path) -> String {
    let repository = repository.to_str().expect("a path of ours");
    run(&["verify", "model", "--repository", repository, "--json"]);
    let output = server(["inspect", "model", "--repository", repository, "--json"]);
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).expect("--json prints JSON");
    report["hash"].as_str().expect("a hash").to_owned()
}

fn files(repository: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(repository).expect("it is there");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("readable").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn a_killed_ingest_leaves_the_repository_as_it_was() {
    let folder = TempDir::new();
    let repository = folder.join("repository");
    let small = folder.write_mesh("small", &meshes::colored_sphere(3));
    let large = folder.write_mesh("large", &meshes::colored_sphere(7));
    run(&ingest_words(&large, &repository));
    let new = verified_hash(&repository);
    let started = Instant::now();
    run(&ingest_words(&large, &repository));
    let whole = started.elapsed();
    run(&ingest_words(&small, &repository));
    let before = verified_hash(&repository);
    assert_ne!(before, new);

    let kills = std::env::var("LODESTREAM_KILLS").map_or(KILLS, |text| text.parse().expect("a number"));
    let mut rng = Rng::with_seed(9);
    let (mut killed, mut finished) = (0, 0);
    for _ in 0..kills {
        let mut ingest = Running::start(&server_bin(), ingest_words(&large, &repository));
        std::thread::sleep(Duration::from_secs_f64(whole.as_secs_f64() * rng.f64()));
        let output = ingest.kill();
        let is_new = verified_hash(&repository) == new;
        if output.status.success() || is_new {
            assert!(is_new, "it said that it was done");
            finished += 1;
            run(&ingest_words(&small, &repository));
        } else {
            killed += 1;
        }
        assert_eq!(verified_hash(&repository), before, "after {killed} kills");
    }
    println!("{killed} killed, {finished} done before that");
    assert!(killed > finished, "{killed} killed, {finished} done before that");
    run(&ingest_words(&small, &repository));
    assert_eq!(files(&repository), [".lock", "model.lodepack"]);
}

/// A file that cannot grow any more stands for a full disk.
#[test]
#[cfg(unix)]
fn a_write_that_fails_is_reported_and_undone() {
    let folder = TempDir::new();
    let repository = folder.join("repository");
    let small = folder.write_mesh("small", &meshes::colored_sphere(3));
    let large = folder.write_mesh("large", &meshes::colored_sphere(7));
    run(&ingest_words(&small, &repository));
    let before = verified_hash(&repository);
    let bin = server_bin();
    // From too small for the first temporary file to almost enough for the pack; in units of 512 or 1024 bytes.
    for blocks in ["100", "1000", "4000"] {
        let words = ingest_words(&large, &repository).join(" ");
        let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec {} {words}", bin.display());
        let output = Running::start(Path::new("/bin/sh"), ["-c", &script]).wait(RUN_LIMIT);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{}", described(&output));
        assert!(message.starts_with("error: cannot ingest") && message.contains("File too large"), "{message}");
        assert!(
            message.contains(repository.to_str().expect("a path of ours")) || message.contains("model"),
            "{message}"
        );
        assert_eq!(files(&repository), [".lock", "model.lodepack"]);
    }
    assert_eq!(verified_hash(&repository), before);
}
