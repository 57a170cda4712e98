//! Random legal batches, for tests and soaks (feature `testing`).

use super::*;
use crate::testing::OperationRng;

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

/// Encodes and applies a batch of random legal ops: collapses, spawns of `patches` and splits, cached ones included, in as
/// many rounds as chance gives, within `limit`. `next_id` counts the components named so far, over all batches of a state.
/// O(mesh + ops).
///
/// # Panics
/// If the encoder refuses what is legal.
pub fn random_batch(
    rng: &mut OperationRng,
    state: &mut OpState,
    patches: &[Patch],
    limit: u32,
    next_id: &mut u32,
) -> (Vec<u8>, OpCounts) {
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
            let patch = &patches[id as usize % patches.len()];
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
            let cached = encoder.rounds.state.cache.top(VertexSlot(s));
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

impl OpState {
    /// What tells two states apart that should be alike, or `None`. Compares mesh, cache and every context of the coder;
    /// O(mesh + cache).
    pub fn difference(&self, other: &Self) -> Option<&'static str> {
        let (a, b) = (&self.replica, &other.replica);
        let checks = [
            ("digests", a.digest() == b.digest()),
            ("triangle counts", a.triangle_count() == b.triangle_count()),
            ("vertices", a.vertices().iter().eq(b.vertices().iter())),
            ("positions", a.positions() == b.positions()),
            ("colours", a.colors() == b.colors()),
            ("corners", a.corners().eq(b.corners())),
            ("collapsible ops", a.collapsible().iter().eq(b.collapsible().iter())),
            ("spawned components", a.spawned_ids() == b.spawned_ids()),
            ("caches", self.cache == other.cache),
            ("contexts", self.models == other.models),
        ];
        checks.into_iter().find(|(_, alike)| !alike).map(|(what, _)| what)
    }
}
