//! Mutated files: no reader panics, hangs or takes more memory than the file's length allows.

use std::time::{Duration, Instant};

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
    assert!(accepted > MUTANTS / 50, "only {accepted} mutants were read to their end");
}

fn ply(format: &str) -> Vec<u8> {
    let header = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
                  property uchar green\nproperty uchar blue\nelement face 2\nproperty list uchar int vertex_indices\n\
                  element tristrips 1\nproperty list int int vertex_indices\nend_header\n";
    let mut bytes = format!("ply\nformat {format} 1.0\n{header}").into_bytes();
    let big = format == "binary_big_endian";
    let int = |value: i32| if big { value.to_be_bytes() } else { value.to_le_bytes() };
    if format == "ascii" {
        bytes.extend(b"0 0 0 1 2 3\n1.5 0 0 4 5 6\n0 1e0 0 7 8 9\n0 0 -1 0 0 0\n3 0 1 2\n4 0 1 2 3\n6 0 1 2 -1 0 3\n");
        return bytes;
    }
    for corner in 0..4_i32 {
        for axis in 0..3 {
            bytes.extend(int(if corner == axis { 0x3f80_0000 } else { 0 }));
        }
        bytes.extend([1, 2, 3]);
    }
    for face in [&[0, 1, 2][..], &[0, 1, 2, 3]] {
        bytes.push(face.len() as u8);
        face.iter().for_each(|&corner| bytes.extend(int(corner)));
    }
    [5, 0, 1, 2, -1, 3].iter().for_each(|&value| bytes.extend(int(value)));
    bytes
}

#[test]
fn mutated_text_ply_is_safe() {
    check(1, &[ply("ascii")], read_ply);
}

#[test]
fn mutated_binary_ply_is_safe() {
    check(2, &[ply("binary_little_endian"), ply("binary_big_endian")], read_ply);
}

#[test]
fn mutated_obj_is_safe() {
    let plain = b"# square\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n".to_vec();
    let rich = b"mtllib a.mtl\no x\nv 0 0 0 1 0.5 0\nv 1 0 0 0 0 0\nv 1 1 0 \\\n1 1 1\nvt 0 0\nvn 0 0 1\nusemtl m\n\
                 f -3/1/1 -2/1/1 -1/1/1\r\nl 1 2\n"
        .to_vec();
    check(3, &[plain, rich], read_obj);
}
