mod reader;

use self::reader::Reader;
use super::random::random_batch;
use super::*;
use crate::testing::{OperationRng, base_meshes, check_replica};

#[test]
fn both_ends_agree_after_every_batch() {
    let patches: Vec<Patch> = base_meshes().into_iter().map(|(_, patch)| patch).collect();
    for (name, base) in base_meshes() {
        for seed in 0..12 {
            let mut rng = OperationRng::new(seed * 31 + 5);
            let capacity = rng.below(60);
            let (has_colors, has_moves) = (rng.one_in(2), rng.one_in(2));
            let step = NonZeroU16::new(rng.below(4) as u16);
            let mut server = OpState::new(&base, 12, has_colors, has_moves, capacity).unwrap().with_step(step);
            let mut client = server.clone();
            let limit = 40 + rng.below(400);
            let mut next_id = 0;
            for batch in 0..40 {
                let (bytes, counts) = random_batch(&mut rng, &mut server, &patches, limit, &mut next_id);
                let what = format!("{name} seed {seed} batch {batch}");
                let decoded = decode_batch(&bytes, &mut client, limit).unwrap_or_else(|e| panic!("{what}: {e}"));
                assert_eq!(decoded, counts, "{what}");
                assert_eq!(client.difference(&server), None, "{what}");
                assert!(client.replica.triangle_count() <= limit.max(base.faces.len() as u32), "{what}");
            }
            check_replica(&client.replica).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
        }
    }
}

/// The text is enough: a reader written from it gets every mesh.
#[test]
fn a_reader_written_from_the_text_agrees() {
    let patches: Vec<Patch> = base_meshes().into_iter().map(|(_, patch)| patch).collect();
    for (name, base) in base_meshes() {
        for seed in 0..5 {
            let mut rng = OperationRng::new(seed * 31 + 5);
            let capacity = rng.below(60);
            let (has_colors, has_moves) = (seed != 1, seed > 0);
            // Steps that random coordinates are multiples of often and seldom.
            let step = [0, 2, 3][(seed % 3) as usize];
            let server = OpState::new(&base, 12, has_colors, has_moves, capacity).unwrap();
            let mut server = server.with_step(NonZeroU16::new(step));
            let mut reader = Reader::new(&base, 12, has_colors, has_moves, step, capacity);
            let limit = 40 + rng.below(200);
            let mut next_id = 0;
            for batch in 0..20 {
                let (bytes, _) = random_batch(&mut rng, &mut server, &patches, limit, &mut next_id);
                let what = format!("{name} seed {seed} batch {batch}");
                reader.batch(&bytes, limit).unwrap_or_else(|fault| panic!("{what}: {fault:?}"));
                assert_eq!(reader.digest(), server.replica.digest(), "{what}");
            }
        }
    }
}

#[test]
fn mutated_batches_are_refused_or_harmless() {
    let patches: Vec<Patch> = base_meshes().into_iter().map(|(_, patch)| patch).collect();
    let base = patches[3].clone();
    let mut rng = OperationRng::new(99);
    let mut server = OpState::new(&base, 12, true, true, 30).unwrap().with_step(NonZeroU16::new(3));
    let mut next_id = 0;
    for _ in 0..30 {
        let before = server.clone();
        let (bytes, _) = random_batch(&mut rng, &mut server, &patches, 500, &mut next_id);
        for _ in 0..60 {
            let mut mutated = bytes.clone();
            for _ in 0..1 + rng.below(3) {
                match rng.below(4) {
                    0 => mutated.truncate(rng.below(mutated.len() as u32 + 1) as usize),
                    1 => mutated.push(rng.below(256) as u8),
                    _ if !mutated.is_empty() => {
                        let at = rng.below(mutated.len() as u32) as usize;
                        mutated[at] ^= 1 << rng.below(8);
                    }
                    _ => {}
                }
            }
            let mut client = before.clone();
            if decode_batch(&mutated, &mut client, 500).is_ok() {
                check_replica(&client.replica).unwrap();
                assert!(client.replica.triangle_count() <= 500);
            }
        }
    }
}

#[test]
fn a_batch_over_the_limit_is_refused() {
    let patches: Vec<Patch> = base_meshes().into_iter().map(|(_, patch)| patch).collect();
    let base = patches[0].clone();
    let mut server = OpState::new(&base, 12, false, false, 0).unwrap();
    let mut client = server.clone();
    let mut rng = OperationRng::new(1);
    let (bytes, counts) = loop {
        let mut attempt = server.clone();
        let (bytes, counts) = random_batch(&mut rng, &mut attempt, &patches, 100, &mut 0);
        if counts.splits > 2 {
            server = attempt;
            break (bytes, counts);
        }
    };
    assert!(counts.max_triangles > 4 && server.replica.triangle_count() <= 100);
    assert!(matches!(decode_batch(&bytes, &mut client, 5), Err(DecodeError::OverLimit { limit: 5, .. })));
}

#[test]
fn candidates_are_sorted_whatever_their_number() {
    let mut rng = fastrand::Rng::with_seed(9);
    for round in 0..200 {
        let most = u32::MAX >> rng.u32(0..32);
        let mut candidates: Vec<(u32, u8)> = (0..rng.usize(0..2000)).map(|_| (rng.u32(0..=most), rng.u8(..))).collect();
        let mut expected = candidates.clone();
        super::sort_by_slot(&mut candidates);
        assert!(candidates.is_sorted_by_key(|candidate| candidate.0), "round {round}");
        expected.sort_unstable();
        candidates.sort_unstable();
        assert_eq!(candidates, expected, "round {round}");
    }
}
