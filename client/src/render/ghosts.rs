//! Ghosts: the faces that a collapse has taken away, fading over the mesh that is there now.
//!
//! The replica knows nothing of them. What the last image showed is kept here (corners by face slot), and whatever of that
//! had a vertex that is gone now becomes a ghost: opaque in the first image, so that this looks like the one before, and
//! gone when its time is over. They lie in a buffer of bounded size: where more collapse at once, the rest goes at once.

use std::collections::{HashMap, HashSet};
use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use lodestream_protocol::ids::{FaceSlot, VertexSlot};
use lodestream_protocol::mesh::{Birth, Fan, Replica};

use super::morph::{MorphView, Morphs};

/// Most ghosts at a time.
pub const MAX_GHOSTS: usize = 8192;

/// A corner of a ghost as the shader has it.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub(super) struct GhostCorner {
    /// Lattice coordinates.
    position: [f32; 3],
    normal: [f32; 3],
    color: [u8; 4],
    /// In seconds of [`Morphs::now_s`].
    begin_s: f32,
    rate_per_s: f32,
}

/// Most bytes of ghosts that are uploaded for one image.
pub const MOST_GHOST_BYTES: u64 = 3 * MAX_GHOSTS as u64 * GHOST_CORNER_BYTES;

/// Bytes of a corner.
pub(super) const GHOST_CORNER_BYTES: u64 = size_of::<GhostCorner>() as u64;

/// All ghosts of one replica.
#[derive(Debug, Default)]
pub struct Ghosts {
    /// Corners and colours of the last image.
    corners: Vec<[u32; 3]>,
    colors: Vec<[u8; 3]>,
    ghosts: Vec<[GhostCorner; 3]>,
    has_changed: bool,
}

impl Ghosts {
    /// Faces that the last image showed and that have lost a vertex become ghosts. Call it before [`Morphs::advance`] for the
    /// same births: what it says of positions is still of the last image then. Returns how many were made.
    pub fn haunt(
        &mut self,
        births: &[Birth],
        touched_pairs: &[Range<u32>],
        replica: &Replica,
        morphs: &Morphs,
        view: &MorphView<'_>,
    ) -> usize {
        let before = self.ghosts.len();
        self.expire(morphs.now_s());
        let born: HashSet<u32> = births.iter().map(|birth| birth.slot).collect();
        let is_gone = |slot: u32| born.contains(&slot) || !replica.vertices().contains(slot);
        let mut lost = Vec::new();
        for face in faces(touched_pairs).take_while(|&face| face < self.corners.len()) {
            if self.ghosts.len() + lost.len() >= MAX_GHOSTS {
                break;
            }
            let corners = self.corners[face];
            if corners[0] != corners[1] && corners.into_iter().any(is_gone) {
                let places = corners.map(|slot| Vec3::from(morphs.shown(slot)));
                if view.shows(places) {
                    lost.push((corners, places));
                }
            }
        }
        let normals = normals(&lost, &is_gone, replica, morphs);
        let rate_per_s = view.rate_per_s();
        self.ghosts.extend(lost.iter().map(|(corners, places)| {
            std::array::from_fn(|k| {
                let [r, g, b] = self.colors[corners[k] as usize];
                GhostCorner {
                    position: places[k].to_array(),
                    normal: normals[&corners[k]].to_array(),
                    color: [r, g, b, 255],
                    begin_s: morphs.now_s(),
                    rate_per_s,
                }
            })
        }));
        self.has_changed |= self.ghosts.len() != before || !lost.is_empty();
        lost.len()
    }

    /// The image shows the replica as it is now.
    pub fn note_shown(&mut self, touched: &[Range<u32>], touched_pairs: &[Range<u32>], replica: &Replica) {
        self.corners.resize(replica.corners().len(), [0; 3]);
        self.colors.resize(replica.colors().len(), [0; 3]);
        for face in faces(touched_pairs) {
            self.corners[face] = replica.corners_of(FaceSlot(face as u32));
        }
        for slot in touched.iter().cloned().flatten().map(|slot| slot as usize) {
            self.colors[slot] = replica.colors()[slot];
        }
    }

    /// Nothing fades, and nothing is known of the last image.
    pub fn forget(&mut self) {
        self.has_changed |= !self.ghosts.is_empty();
        self.ghosts.clear();
        self.corners.clear();
        self.colors.clear();
    }

    /// Three corners each.
    pub(super) fn ghosts(&self) -> &[[GhostCorner; 3]] {
        &self.ghosts
    }

    /// Whether [`ghosts`](Self::ghosts) differs from what was uploaded.
    pub(super) fn has_changed(&self) -> bool {
        self.has_changed
    }

    /// [`ghosts`](Self::ghosts) is uploaded.
    pub(super) fn note_uploaded(&mut self) {
        self.has_changed = false;
    }

    fn expire(&mut self, now_s: f32) {
        // A time before the beginning belongs to an epoch that is over.
        let lives = |ghost: &[GhostCorner; 3]| (0.0..1.0).contains(&((now_s - ghost[0].begin_s) * ghost[0].rate_per_s));
        self.ghosts.retain(lives);
    }
}

fn faces(pairs: &[Range<u32>]) -> impl Iterator<Item = usize> + '_ {
    pairs.iter().flat_map(|pair| 2 * pair.start as usize..2 * pair.end as usize)
}

/// Normals at the corners of the faces that were lost: those of the mesh where a vertex is still there, else the mean of what
/// was lost around it.
fn normals(
    lost: &[([u32; 3], [Vec3; 3])],
    is_gone: &impl Fn(u32) -> bool,
    replica: &Replica,
    morphs: &Morphs,
) -> HashMap<u32, Vec3> {
    let mut sums: HashMap<u32, Vec3> = HashMap::new();
    for (corners, [a, b, c]) in lost {
        let area = (b - a).cross(c - a);
        corners.iter().for_each(|&slot| *sums.entry(slot).or_default() += area);
    }
    let mut fan = Fan::default();
    for (&slot, sum) in &mut sums {
        if is_gone(slot) || replica.fan(VertexSlot(slot), &mut fan).is_err() {
            continue;
        }
        let center = Vec3::from(morphs.shown(slot));
        let spokes: Vec<Vec3> =
            fan.ring().iter().map(|&v| replica.positions()[v as usize].map(|x| x as f32).into()).collect();
        let around = |i: usize| (spokes[i] - center).cross(spokes[(i + 1) % spokes.len()] - center);
        let closed = if fan.is_closed() { spokes.len() } else { spokes.len().saturating_sub(1) };
        let mean: Vec3 = (0..closed).map(around).sum();
        if mean.length_squared() > 0.0 {
            *sum = mean;
        }
    }
    sums.values_mut().for_each(|normal| *normal = normal.normalize_or_zero());
    sums
}
