//! Generators and slow twins for tests (feature `testing`): nothing here is used in production.

use crate::ids::VertexSlot;
use crate::mesh::{Cut, Fan, NewVertex, Patch, Replica, twins_of};

/// A small deterministic generator (SplitMix64), so that the feature needs no dependency.
#[derive(Clone, Debug)]
pub struct OperationRng(u64);

impl OperationRng {
    /// Same seed, same sequence.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x51_7c_c1_b7)
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// A number below `end`, which is positive.
    pub fn below(&mut self, end: u32) -> u32 {
        (self.next_u64() % u64::from(end)) as u32
    }

    /// True once in `n` times.
    pub fn one_in(&mut self, n: u32) -> bool {
        self.below(n) == 0
    }

    /// Any cut that opens `fan`, or `None` where none does.
    pub fn random_cut(&mut self, fan: &Fan) -> Option<Cut> {
        let spokes = fan.ring().len() as u32;
        for _ in 0..20 {
            let (a, b) = (self.below(spokes), self.below(spokes));
            let cut = match self.below(3) {
                0 => Cut::Left { left: a },
                1 => Cut::Right { right: a },
                _ => Cut::Both { right: a, left: b },
            };
            if fan.admits(cut) {
                return Some(cut);
            }
        }
        None
    }

    /// A vertex somewhere on a 12-bit lattice.
    pub fn random_vertex(&mut self) -> NewVertex {
        NewVertex {
            position: [0; 3].map(|_: i32| self.below(4096) as i32),
            color: [0; 3].map(|_: u8| self.below(256) as u8),
            ..NewVertex::default()
        }
    }

    /// Splits a random vertex at a random cut.
    pub fn random_split(&mut self, replica: &mut Replica) -> Option<VertexSlot> {
        if replica.vertices().is_empty() {
            return None;
        }
        let rank = self.below(replica.vertices().len());
        let s = VertexSlot(replica.vertices().select_from(0, rank)?);
        let mut fan = Fan::default();
        replica.fan(s, &mut fan).expect("the vertex exists");
        let cut = self.random_cut(&fan)?;
        let vertex = self.random_vertex();
        Some(replica.split(s, &fan, cut, &vertex).expect("the cut fits"))
    }

    /// Collapses a random collapsible split.
    pub fn random_collapse(&mut self, replica: &mut Replica) -> Option<VertexSlot> {
        let splits: Vec<u32> = replica.collapsible().iter().filter(|&v| !replica.is_spawn(VertexSlot(v))).collect();
        if splits.is_empty() {
            return None;
        }
        let t = VertexSlot(splits[self.below(splits.len() as u32) as usize]);
        replica.collapse(t, &mut Vec::new()).expect("it is collapsible");
        Some(t)
    }
}

/// Small meshes of every kind of topology, by name.
pub fn base_meshes() -> Vec<(&'static str, Patch)> {
    let patch = |positions: Vec<[i32; 3]>, faces: Vec<[u32; 3]>| Patch {
        colors: positions.iter().map(|p| p.map(|x| (x * 37 % 256) as u8)).collect(),
        positions,
        faces,
    };
    let tetrahedron = vec![[0, 0, 0], [900, 0, 0], [0, 900, 0], [0, 0, 900]];
    // A torus of 3 x 3 quads: closed, genus 1.
    let torus_positions: Vec<[i32; 3]> = (0..9).map(|i| [i % 3 * 700, i / 3 * 500, i * i % 7 * 90]).collect();
    let torus_faces = (0..9)
        .flat_map(|i| {
            let at = |u: u32, v: u32| (v % 3) * 3 + u % 3;
            let (u, v) = (i % 3, i / 3);
            [[at(u, v), at(u + 1, v), at(u + 1, v + 1)], [at(u, v), at(u + 1, v + 1), at(u, v + 1)]]
        })
        .collect();
    // A 3 x 3 grid of quads without the middle one: two boundary loops.
    let grid = |skip: u32| -> Vec<[u32; 3]> {
        (0..9)
            .filter(|&i| i != skip)
            .flat_map(|i| {
                let a = i / 3 * 4 + i % 3;
                [[a, a + 1, a + 5], [a, a + 5, a + 4]]
            })
            .collect()
    };
    let grid_positions: Vec<[i32; 3]> = (0..16).map(|i| [i % 4 * 300, i / 4 * 300, i * i % 11 * 20]).collect();
    vec![
        ("tetrahedron", patch(tetrahedron, vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])),
        ("triangle", patch(vec![[0, 0, 0], [1000, 0, 0], [0, 1000, 0]], vec![[0, 1, 2]])),
        ("two-sided triangle", patch(vec![[0, 0, 0], [10, 0, 0], [0, 10, 0]], vec![[0, 1, 2], [0, 2, 1]])),
        ("torus", patch(torus_positions, torus_faces)),
        ("grid", patch(grid_positions.clone(), grid(99))),
        ("annulus", patch(grid_positions, grid(4))),
        ("empty", Patch::default()),
    ]
}

/// The dull twin of the replica's bookkeeping: checks from the face list alone that the mesh is an oriented manifold with
/// one fan per vertex, that counts and canonical fans agree, and recomputes the digest.
///
/// # Errors
/// Says what is wrong.
pub fn check_replica(replica: &Replica) -> Result<(), String> {
    let dead = [0; 3];
    let live: Vec<(u32, [u32; 3])> = (0..).zip(replica.corners()).filter(|&(_, c)| c != dead).collect();
    if live.len() as u32 != replica.triangle_count() {
        return Err(format!("{} faces, {} counted", live.len(), replica.triangle_count()));
    }
    let slots: Vec<u32> = replica.vertices().iter().collect();
    let rank = |slot: u32| slots.binary_search(&slot).map_err(|_| format!("slot {slot} of a face holds no vertex"));
    let mut faces = Vec::new();
    for &(_, corners) in &live {
        faces.push([rank(corners[0])? as u32, rank(corners[1])? as u32, rank(corners[2])? as u32]);
    }
    // Random ops may produce double edges, which an index list cannot tell apart; adjacency is then checked by walking only.
    let indexed = twins_of(slots.len() as u32, &faces);
    let mut fan = Fan::default();
    let mut around = vec![0u32; slots.len()];
    faces.iter().flatten().for_each(|&v| around[v as usize] += 1);
    for (&slot, &degree) in slots.iter().zip(&around) {
        replica.fan(VertexSlot(slot), &mut fan).map_err(|e| e.to_string())?;
        if fan.faces() != degree {
            return Err(format!("the fan of slot {slot} has {} of {degree} faces", fan.faces()));
        }
        let mut smallest = u32::MAX;
        for i in 0..fan.faces() {
            let corners = replica.corners_of(fan.face(i));
            let k = corners.iter().position(|&c| c == slot).ok_or_else(|| format!("a face not of slot {slot}"))?;
            let ring = fan.ring();
            if corners[(k + 1) % 3] != ring[i as usize] || corners[(k + 2) % 3] != ring[(i as usize + 1) % ring.len()] {
                return Err(format!("face {i} of slot {slot} is out of order"));
            }
            smallest = smallest.min(fan.face(i).0);
        }
        if fan.is_closed() && fan.face(0).0 != smallest {
            return Err(format!("the fan of slot {slot} does not begin at its smallest face"));
        }
        if let Ok(twins) = &indexed
            && !fan.is_closed()
        {
            let first = live.iter().position(|&(f, _)| f == fan.face(0).0).expect("the face is live");
            let k = replica.corners_of(fan.face(0)).iter().position(|&c| c == slot).expect("checked above");
            if twins[first][k] != u32::MAX {
                return Err(format!("the open fan of slot {slot} does not begin at the boundary"));
            }
        }
    }
    let mut scratch = replica.clone();
    let digest = scratch.recompute_digest();
    if digest != replica.digest() {
        return Err("the digest does not match the mesh".into());
    }
    Ok(())
}
