mod reader;

use self::reader::Reader;
use super::*;
use crate::testing::{OperationRng, base_meshes, check_replica};

/// A vertex that leaves `s` where it is, was in the middle between both on the lattice, or moves `s` anywhere.
fn random_moving_vertex(rng: &mut OperationRng, replica: &Replica, s: u32) -> NewVertex {
    let mut vertex = rng.random_vertex();
    let before = replica.positions()[s as usize];
    let other = rng.random_vertex();
    let moved = match rng.below(3) {
        0 => before,
        1 => std::array::from_fn(|k| {
            let odd = vertex.position[k] & 1;
            2 * before[k] - vertex.position[k] + if rng.one_in(2) { 1 - 2 * odd } else { 0 }
        }),
        _ => other.position,
    };
    let is_on_lattice = moved.iter().all(|x| (0..4096).contains(x));
    vertex.s_move = if is_on_lattice { std::array::from_fn(|k| moved[k] - before[k]) } else { [0; 3] };
    if rng.one_in(2) {
        vertex.s_color_move = other.color;
    }
    vertex
}

fn random_batch(rng: &mut OperationRng, state: &mut OpState, limit: u32, next_id: &mut u32) -> (Vec<u8>, OpCounts) {
    let patches = base_meshes();
    let mut encoder = BatchEncoder::new(state, rng.one_in(10));
    let share = 1 + rng.below(6);
    let mut members: Vec<u32> = encoder.replica().collapsible().iter().filter(|_| rng.one_in(share + 1)).collect();
    while encoder.collapse_round(&members).unwrap() {
        members = encoder.candidates().filter(|_| rng.one_in(2)).collect();
    }
    let mut spawns = Vec::new();
    let mut room = limit.saturating_sub(encoder.replica().triangle_count());
    if rng.one_in(3) {
        let free: Vec<u32> = (0..*next_id + 3).filter(|id| !encoder.replica().spawned_ids().contains(id)).collect();
        for id in free {
            let patch = &patches[id as usize % patches.len()].1;
            let faces = patch.faces.len() as u32;
            if rng.one_in(2) && faces > 0 && faces <= room {
                room -= faces;
                spawns.push((id, patch));
                *next_id = (*next_id).max(id + 1);
            }
        }
    }
    encoder.spawns(&spawns, limit).unwrap();
    let share = 1 + rng.below(5);
    let mut members: Vec<u32> = encoder.replica().vertices().iter().filter(|_| rng.one_in(share)).collect();
    members.truncate((room / 2) as usize);
    loop {
        encoder.split_round(&members).unwrap();
        if members.is_empty() {
            break;
        }
        for &s in &members {
            let cached = encoder.rounds.state.cache.top(VertexSlot(s)).copied();
            let OpState { has_moves, has_colors, .. } = *encoder.rounds.state;
            let resolve = |replica: &Replica, fan: &Fan| {
                let cut = match cached.and_then(|c| guess_cut(fan, c.left, c.right)) {
                    Some(cut) if !rng.one_in(3) => cut,
                    _ => rng.random_cut(fan).unwrap_or(if fan.is_closed() {
                        Cut::Both { right: 0, left: 1 }
                    } else {
                        Cut::Left { left: 0 }
                    }),
                };
                let vertex = cached.map(|c| c.vertex).unwrap_or_else(|| match has_moves {
                    false => rng.random_vertex(),
                    true => random_moving_vertex(rng, replica, s),
                });
                let s_color_move = if has_colors { vertex.s_color_move } else { [0; 3] };
                Some((cut, NewVertex { s_color_move, ..vertex }))
            };
            encoder.split(s, limit, resolve).unwrap();
            room = room.saturating_sub(2);
        }
        if !encoder.end_split_round() {
            break;
        }
        members = encoder.candidates().filter(|_| rng.one_in(3)).take((room / 2) as usize).collect();
    }
    encoder.finish()
}

#[test]
fn both_ends_agree_after_every_batch() {
    for (name, base) in base_meshes() {
        for seed in 0..12 {
            let mut rng = OperationRng::new(seed * 31 + 5);
            let capacity = rng.below(60);
            let (has_colors, has_moves) = (rng.one_in(2), rng.one_in(2));
            let mut server = OpState::new(&base, 12, has_colors, has_moves, capacity).unwrap();
            let mut client = server.clone();
            let limit = 40 + rng.below(400);
            let mut next_id = 0;
            for batch in 0..40 {
                let (bytes, counts) = random_batch(&mut rng, &mut server, limit, &mut next_id);
                let what = format!("{name} seed {seed} batch {batch}");
                let decoded = decode_batch(&bytes, &mut client, limit).unwrap_or_else(|e| panic!("{what}: {e}"));
                assert_eq!(decoded, counts, "{what}");
                assert_eq!(client.replica.digest(), server.replica.digest(), "{what}");
                assert_eq!(client.cache.len(), server.cache.len(), "{what}");
                assert_eq!(client.models, server.models, "{what}");
                assert!(client.replica.triangle_count() <= limit.max(base.faces.len() as u32), "{what}");
            }
            check_replica(&client.replica).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
        }
    }
}

/// The text is enough: a reader written from it gets every mesh.
#[test]
fn a_reader_written_from_the_text_agrees() {
    for (name, base) in base_meshes() {
        for seed in 0..3 {
            let mut rng = OperationRng::new(seed * 31 + 5);
            let capacity = rng.below(60);
            let (has_colors, has_moves) = (seed != 1, seed > 0);
            let mut server = OpState::new(&base, 12, has_colors, has_moves, capacity).unwrap();
            let mut reader = Reader::new(&base, 12, has_colors, has_moves, capacity);
            let limit = 40 + rng.below(200);
            let mut next_id = 0;
            for batch in 0..20 {
                let (bytes, _) = random_batch(&mut rng, &mut server, limit, &mut next_id);
                let what = format!("{name} seed {seed} batch {batch}");
                reader.batch(&bytes, limit).unwrap_or_else(|fault| panic!("{what}: {fault:?}"));
                assert_eq!(reader.digest(), server.replica.digest(), "{what}");
            }
        }
    }
}

#[test]
fn mutated_batches_are_refused_or_harmless() {
    let (_, base) = base_meshes().swap_remove(3);
    let mut rng = OperationRng::new(99);
    let mut server = OpState::new(&base, 12, true, true, 30).unwrap();
    let mut next_id = 0;
    for _ in 0..30 {
        let before = server.clone();
        let (bytes, _) = random_batch(&mut rng, &mut server, 500, &mut next_id);
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
    let (_, base) = base_meshes().swap_remove(0);
    let mut server = OpState::new(&base, 12, false, false, 0).unwrap();
    let mut client = server.clone();
    let mut rng = OperationRng::new(1);
    let (bytes, counts) = loop {
        let mut attempt = server.clone();
        let (bytes, counts) = random_batch(&mut rng, &mut attempt, 100, &mut 0);
        if counts.splits > 2 {
            server = attempt;
            break (bytes, counts);
        }
    };
    assert!(counts.max_triangles > 4 && server.replica.triangle_count() <= 100);
    assert!(matches!(decode_batch(&bytes, &mut client, 5), Err(DecodeError::OverLimit { limit: 5, .. })));
}
