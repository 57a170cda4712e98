//! Mutated files: no reader panics, hangs or takes more memory than the file's length allows.

use std::time::{Duration, Instant};

use super::testing::{Seeds, seeds};
use super::*;

const MUTANTS: usize = 20_000;

/// Tokens that are unlikely to arise by chance and likely to hurt.
const TOKENS: &[&[u8]] = &[
    b"-1",
    b"0",
    b"255",
    b"256",
    b"65536",
    b"4294967295",
    b"4294967296",
    b"9223372036854775807",
    b"18446744073709551616",
    b"1e400",
    b"nan",
    b"-inf",
    b"1.#QNAN",
    b"\\",
    b"\\\n",
    b"\r",
    b"\n",
    b" ",
    b"\0",
    b"\xff\xff\xff\xff",
    b"list",
    b"element vertex 4294967295\n",
    b"element face 99999999999\n",
    b"element e 9999999999999999\n",
    b"property list int int",
    b"vertex_indices",
    b"end_header\n",
    b"f 1 2 3\n",
    b"f -1 -2 -3\n",
    b"v 0 0 0\n",
    b"/",
    b"double",
    b"uchar",
    b"comment ",
    b"vertex 1 2 3\n",
    b"endloop\n",
    b"outer loop\n",
    b"OFF BINARY\n",
    b"{",
    b"[",
    b"\"",
    b"null",
    b"\"count\":4294967295",
    b"\"byteOffset\":18446744073709551615",
    b"\"children\":[0,1,2]",
    b"\"indices\":9",
    b"\"sparse\":",
];

fn mutate(random: &mut fastrand::Rng, seeds: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = random.choice(seeds).expect("there are seeds").clone();
    // Half of the mutants keep their first half, or few would get past the header.
    let kept = if random.bool() { bytes.len() / 2 } else { 0 };
    for _ in 0..random.usize(1..=4) {
        let at = random.usize(kept.min(bytes.len())..=bytes.len());
        let end = (at + random.usize(..12)).min(bytes.len());
        match random.u8(..7) {
            0 => bytes.truncate(at),
            1 => drop(bytes.drain(at..end)),
            2 => bytes[at..end].iter_mut().for_each(|b| *b = random.u8(..)),
            3 => bytes[at..end].iter_mut().for_each(|b| *b ^= 1 << random.u8(..8)),
            4 => drop(bytes.splice(at..end, random.choice(TOKENS).expect("there are tokens").iter().copied())),
            5 => drop(bytes.splice(at..at, random.choice(TOKENS).expect("there are tokens").iter().copied())),
            _ => {
                let other = random.choice(seeds).expect("there are seeds");
                let from = random.usize(..=other.len());
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
        }
    }
    bytes
}

type Read = fn(&[u8]) -> Result<(TriMesh, ReadReport), ReadError>;

fn check(seed: u64, seeds: &[Vec<u8>], read: Read) {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut accepted = 0;
    let mut slowest = Duration::ZERO;
    for _ in 0..MUTANTS {
        let bytes = mutate(&mut random, seeds);
        let start = Instant::now();
        let result = read(&bytes);
        slowest = slowest.max(start.elapsed());
        let Ok((mesh, report)) = result else { continue };
        accepted += 1;
        let context = || String::from_utf8_lossy(&bytes).into_owned();
        assert!(mesh.faces.as_flattened().iter().all(|&v| (v as usize) < mesh.positions.len()), "{}", context());
        assert!(mesh.colors.as_ref().is_none_or(|c| c.len() == mesh.positions.len()), "{}", context());
        assert_eq!(report.triangles, mesh.faces.len() as u64);
    }
    // Files are some hundred bytes: a second means a loop that follows a count.
    assert!(slowest < Duration::from_secs(1), "{slowest:?}");
    assert!(accepted > MUTANTS / 200, "only {accepted} mutants were read to their end");
}

#[test]
fn mutated_files_of_every_format_are_safe() {
    for (seed, Seeds { format, files }) in seeds().into_iter().enumerate() {
        let read = match format {
            "ply" => read_ply,
            "obj" => read_obj,
            "stl" => read_stl,
            "off" => read_off,
            _ => read_gltf,
        };
        for file in &files {
            let (mesh, report) = read(file).unwrap();
            assert_eq!(report.triangles, mesh.faces.len() as u64, "{format}");
        }
        check(seed as u64, &files, read);
    }
}
