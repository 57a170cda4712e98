//! The repository against damage, failures in the middle and other processes.

use std::fs::{self, File};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use super::*;
use crate::pack::testing::{DagOptions, random_dag};
use crate::pack::{Metadata, WriteError, write, write_to_vec};

/// A directory that is removed at the end of its test.
struct Scratch(PathBuf);

impl Scratch {
    fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("lodestream-repository-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let path = std::env::temp_dir().join(name);
        fs::create_dir(&path).unwrap();
        Self(path)
    }

    fn names(&self) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(&self.0).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.retain(|name| name != ".lock");
        names.sort();
        names
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn id(text: &str) -> ModelId {
    text.parse().unwrap()
}

fn bytes(seed: u64) -> Vec<u8> {
    let (dag, complete) = random_dag(&DagOptions { seed, splits: 600, ..DagOptions::default() });
    write_to_vec(&dag, &complete, &Metadata::default()).unwrap()
}

fn publish(repository: &Repository, name: &str, seed: u64) {
    repository.publish(&id(name), |out| out.write_all(&bytes(seed))).unwrap();
}

#[test]
fn ids_are_safe_as_file_names() {
    for good in ["a", "0", "bunny", "dragon_871k", "v1.2-rc", &"x".repeat(64)] {
        assert_eq!(good.parse::<ModelId>().unwrap().as_str(), good);
    }
    for bad in ["", ".", "..", ".hidden", "-x", "_x", "A", "a/b", "a\\b", "a b", "a\0", "ä", &"x".repeat(65)] {
        assert!(bad.parse::<ModelId>().is_err(), "{bad:?}");
    }
}

#[test]
fn published_models_are_listed_cached_and_replaced() {
    let scratch = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    assert!(repository.list().unwrap().is_empty());
    assert!(matches!(repository.get(&id("bunny")), Err(RepositoryError::NotFound(_))));
    let (dag, complete) = random_dag(&DagOptions::default());
    repository.publish(&id("bunny"), |out| write(&dag, &complete, &Metadata::default(), out)).unwrap();
    let first = repository.get(&id("bunny")).unwrap();
    assert_eq!(first.info().hash, complete.hash);
    assert!(Arc::ptr_eq(&first, &repository.get(&id("bunny")).unwrap()), "opened once");
    repository.verify(&id("bunny")).unwrap();

    // Another process publishes a new model and a new version of the old one.
    let other = Repository::open(&scratch.0).unwrap();
    publish(&other, "armadillo", 7);
    publish(&other, "bunny", 8);
    let names: Vec<_> = repository.list().unwrap().iter().map(|entry| entry.id.to_string()).collect();
    assert_eq!(names, ["armadillo", "bunny"]);
    let second = repository.get(&id("bunny")).unwrap();
    assert_ne!(second.info().hash, first.info().hash);
    first.split(first.spawn_count()).expect("who has the old file keeps it");
    assert_eq!(scratch.names(), ["armadillo.lodepack", "bunny.lodepack"]);

    fs::remove_file(repository.path(&id("bunny"))).unwrap();
    assert_eq!(repository.list().unwrap().len(), 1);
    assert!(matches!(repository.get(&id("bunny")), Err(RepositoryError::NotFound(_))));
}

#[test]
fn bad_packs_are_listed_with_a_reason_and_harm_no_other() {
    let scratch = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    publish(&repository, "good", 1);
    let good = bytes(2);
    let file = |name: &str| scratch.0.join(format!("{name}.lodepack"));
    fs::write(file("empty"), []).unwrap();
    fs::write(file("text"), "no pack").unwrap();
    fs::write(file("cut"), &good[..good.len() / 2]).unwrap();
    fs::write(scratch.0.join("README.txt"), "not a model").unwrap();
    fs::write(file("Upper"), &good).unwrap();
    fs::create_dir(file("folder")).unwrap();
    let entries = repository.list().unwrap();
    let states: Vec<_> = entries.iter().map(|e| (e.id.as_str(), matches!(e.state, ModelState::Ready(_)))).collect();
    assert_eq!(states, [("cut", false), ("empty", false), ("folder", false), ("good", true), ("text", false)]);
    let reason = |name: &str| match &entries.iter().find(|e| e.id.as_str() == name).unwrap().state {
        ModelState::Damaged(reason) => reason.clone(),
        ModelState::Ready(_) => String::new(),
    };
    assert_eq!(reason("text"), "not a pack");
    assert!(reason("cut").contains("header"), "{}", reason("cut"));
}

#[test]
fn damage_found_later_puts_the_model_in_quarantine_until_it_is_replaced() {
    let scratch = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    let mut spoiled = bytes(3);
    let at = spoiled.len() - 2000;
    spoiled[at] ^= 1;
    repository.publish(&id("m"), |out| out.write_all(&spoiled)).expect("the damage is in a page");
    let model = repository.get(&id("m")).unwrap();
    let error = (0..model.op_count()).find_map(|op| model.bounds(op).err()).expect("a page is damaged");
    match repository.get(&id("m")) {
        Err(RepositoryError::Damaged { reason, .. }) => assert_eq!(reason, error),
        other => panic!("{other:?}"),
    }
    assert!(matches!(repository.list().unwrap()[0].state, ModelState::Damaged(_)));
    assert!(matches!(repository.verify(&id("m")), Err(RepositoryError::Damaged { .. })));
    publish(&repository, "m", 3);
    repository.get(&id("m")).unwrap();
    repository.verify(&id("m")).unwrap();
}

/// Fails at the n-th byte, as a full disk or a kill does.
struct Failing<'a, W> {
    out: &'a mut W,
    left: usize,
}

impl<W: Write> Write for Failing<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.left == 0 {
            return Err(io::Error::other("disk full"));
        }
        let n = self.out.write(&bytes[..bytes.len().min(self.left)])?;
        self.left -= n;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

impl<W: Seek> Seek for Failing<'_, W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.out.seek(to)
    }
}

#[test]
fn a_failed_publication_leaves_the_earlier_model_and_no_file() {
    let scratch = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    publish(&repository, "m", 1);
    let before = repository.get(&id("m")).unwrap().info().hash;
    let (dag, complete) = random_dag(&DagOptions { seed: 2, ..DagOptions::default() });
    let len = write_to_vec(&dag, &complete, &Metadata::default()).unwrap().len();
    for left in (0..len).step_by(97) {
        let result = repository
            .publish(&id("m"), |out| write(&dag, &complete, &Metadata::default(), &mut Failing { out, left }));
        assert!(matches!(result, Err(RepositoryError::Write(_))), "{left}");
        assert_eq!(scratch.names(), ["m.lodepack"]);
    }
    // A writer that stops early without an error, and one that writes no pack at all.
    let early = repository.publish(&id("m"), |out| out.write_all(&bytes(2)[..500]));
    assert!(matches!(early, Err(RepositoryError::Damaged { .. })));
    let nothing = repository.publish(&id("m"), |_| Ok::<_, WriteError>(()));
    assert!(nothing.is_err());
    assert_eq!(scratch.names(), ["m.lodepack"]);
    assert_eq!(repository.get(&id("m")).unwrap().info().hash, before);
}

#[test]
fn leftovers_of_dead_writers_are_ignored_and_removed_those_of_living_ones_kept() {
    let scratch = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    let dead = scratch.0.join(".publishing-m-1-0");
    fs::write(&dead, &bytes(1)[..700]).unwrap();
    let living = scratch.0.join(".publishing-m-2-0");
    let writer = File::create(&living).unwrap();
    writer.lock().unwrap();
    assert!(repository.list().unwrap().is_empty());
    publish(&repository, "m", 1);
    assert_eq!(scratch.names(), [".publishing-m-2-0", "m.lodepack"]);
    drop(writer);
    publish(&repository, "n", 1);
    assert_eq!(scratch.names(), ["m.lodepack", "n.lodepack"]);
}

#[test]
fn many_threads_publish_and_read_at_once() {
    let scratch = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    let packs = [bytes(1), bytes(2)];
    std::thread::scope(|scope| {
        for pack in &packs {
            scope.spawn(|| {
                for _ in 0..20 {
                    repository.publish(&id("m"), |out| out.write_all(pack)).unwrap();
                    let model = repository.get(&id("m")).unwrap();
                    model.bounds(model.op_count() - 1).unwrap();
                }
            });
        }
    });
    assert_eq!(scratch.names(), ["m.lodepack"]);
}

#[test]
fn originals_come_and_go_with_their_models() {
    let scratch = Scratch::new();
    let inputs = Scratch::new();
    let repository = Repository::open(&scratch.0).unwrap();
    let input = |name: &str, content: &str| {
        let path = inputs.0.join(name);
        fs::write(&path, content).unwrap();
        path
    };
    let publish_with = |name: &str, original: Option<Original>, seed| {
        repository.publish_with(&id(name), original, |out| out.write_all(&bytes(seed)))
    };
    let keep = |name: &str, path: &Path| repository.keep_original(&id(name), path).unwrap();
    let first = keep("a", &input("x.PLY", "one"));
    let first_name = first.name().to_owned();
    assert!(first_name.starts_with("a.original-") && first_name.ends_with(".ply"), "{first_name}");
    publish_with("a", Some(first), 1).unwrap();
    // A model whose name looks like that of an original is none.
    let other = format!("a.original-{}", "0".repeat(16));
    publish_with(&other, Some(keep(&other, &input("y", "two"))), 2).unwrap();
    assert_eq!(fs::read_to_string(scratch.0.join(&first_name)).unwrap(), "one");
    assert_eq!(scratch.names().len(), 4);

    // A publication that fails leaves the earlier original, be it the same or another one.
    for content in ["three", "one"] {
        let original = keep("a", &input("x.ply", content));
        let failed = repository.publish_with(&id("a"), Some(original), |_| Err::<(), _>(io::Error::other("full")));
        assert!(failed.is_err());
        assert!(scratch.0.join(&first_name).exists());
        assert_eq!(scratch.names().len(), 4);
    }
    publish_with("a", Some(keep("a", &input("x.obj", "three"))), 3).unwrap();
    assert!(!scratch.0.join(&first_name).exists());
    assert_eq!(scratch.names().len(), 4);
    publish_with("a", None, 3).unwrap();
    assert_eq!(scratch.names().len(), 3);
    assert_eq!(repository.list().unwrap().len(), 2);
    assert!(repository.keep_original(&id("a"), &inputs.0.join("gone")).is_err());
}
