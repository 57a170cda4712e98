//! How far the surface strays from the complete one, measured at samples that travel with the surviving vertices.
//!
//! Every vertex carries up to [`MAX_SAMPLES`] original vertices of its forest subtree. After a collapse those of both ends are
//! measured against the new star of `s`, and so are those of the vertices around `t` that lay at a face of `t`: the collapse
//! moves that face away from under them, although they stay with their vertex. Leaving these out let errors pass that were up
//! to 1.8 times what was stored; more samples did not help. (One-sided Hausdorff distance to the star, ALGORITHMS section 5:
//! the fixed factor in the error makes up for the samples that were dropped and for stars that look different in a selectively
//! refined mesh.)

use glam::DVec3;

use super::{NONE, Point};

/// What a distance found by a difference of squares may be off by, as a share of the squared distance to the centre: far more
/// than it is. Where it tells that a point is not the nearest, the point need not be found.
const FILTER_SLACK: f64 = 1e-9;

/// Most samples that one vertex carries.
const MAX_SAMPLES: usize = 8;

/// The faces around a vertex, prepared for distances from many points.
#[derive(Debug, Default)]
pub(crate) struct Star {
    center: DVec3,
    color: [u8; 3],
    spokes: Vec<Spoke>,
    wedges: Vec<Wedge>,
    is_closed: bool,
}

#[derive(Clone, Copy, Debug)]
struct Spoke {
    /// Face between this spoke and the next; for the last spoke of an open star that before it.
    face: u32,
    /// Vertex at its end.
    vertex: u32,
    to: DVec3,
    length_squared: f64,
    inverse: f64,
    color: [u8; 3],
}

/// The face between a spoke and the next one.
#[derive(Clone, Copy, Debug)]
struct Wedge {
    normal: DVec3,
    /// One over the squared length of `normal`, 0 for a face without area.
    inverse: f64,
    /// Dot product of the two spokes.
    dot: f64,
    /// From the end of this spoke to the end of the next, and one over its squared length.
    rim: DVec3,
    rim_inverse: f64,
}

fn inverse(x: f64) -> f64 {
    if x > 0.0 { 1.0 / x } else { 0.0 }
}

/// A point of the star: squared distance from the sample, and where it lies, as weights of up to three vertices.
#[derive(Clone, Copy)]
struct Nearest {
    distance_squared: f64,
    first: usize,
    second: usize,
    weights: [f64; 2],
}

impl Star {
    /// Takes over the star of `s` with the edges `ring`, counter-clockwise, each with a half-edge of the face between it and
    /// the next (for the last of an open star, of the face before it) and the vertex at its other end. Allocates only to grow.
    pub(crate) fn reset(&mut self, points: &[Point], s: u32, ring: impl Iterator<Item = (u32, u32)>) {
        let s = &points[s as usize];
        let is_closed = !s.is_boundary;
        self.center = s.at();
        self.color = s.color;
        self.is_closed = is_closed;
        self.spokes.clear();
        self.wedges.clear();
        let center = self.center;
        self.spokes.extend(ring.map(|(half_edge, vertex)| {
            let p = &points[vertex as usize];
            let to = p.at() - center;
            let length_squared = to.length_squared();
            Spoke { face: half_edge / 3, vertex, to, length_squared, inverse: inverse(length_squared), color: p.color }
        }));
        let faces = if is_closed { self.spokes.len() } else { self.spokes.len().saturating_sub(1) };
        for j in 0..faces {
            let (a, b) = (self.spokes[j].to, self.spokes[self.following(j)].to);
            let (normal, rim) = (a.cross(b), b - a);
            self.wedges.push(Wedge {
                normal,
                inverse: inverse(normal.length_squared()),
                dot: a.dot(b),
                rim,
                rim_inverse: inverse(rim.length_squared()),
            });
        }
    }

    #[inline]
    fn following(&self, j: usize) -> usize {
        if j + 1 == self.spokes.len() { 0 } else { j + 1 }
    }

    /// Nearest point of the star to the one at `q` from its centre; stops early at one whose squared distance is at most
    /// `enough`, since the caller then has no use for a nearer one. At a rim the distance may be over the true one, never
    /// under it. O(valence).
    #[inline]
    fn nearest(&self, q: DVec3, enough: f64) -> Nearest {
        let mut best = Nearest { distance_squared: q.length_squared(), first: 0, second: 0, weights: [0.0; 2] };
        let Some(first) = self.spokes.first() else { return best };
        if best.distance_squared <= enough {
            return best;
        }
        let from_center = best.distance_squared;
        let slack = from_center * FILTER_SLACK;
        let mut along = q.dot(first.to);
        for (j, spoke) in self.spokes.iter().enumerate() {
            let share = (along * spoke.inverse).clamp(0.0, 1.0);
            let gained = share * (2.0 * along - share * spoke.length_squared);
            if from_center - gained < best.distance_squared + slack {
                let distance_squared = q.distance_squared(spoke.to * share);
                if distance_squared < best.distance_squared {
                    best = Nearest { distance_squared, first: j, second: j, weights: [share, 0.0] };
                }
            }
            let Some(wedge) = self.wedges.get(j) else { break };
            let k = self.following(j);
            let next = &self.spokes[k];
            let along_next = q.dot(next.to);
            // Barycentric weights of the two rim corners, times the squared normal.
            let u = next.length_squared * along - wedge.dot * along_next;
            let v = spoke.length_squared * along_next - wedge.dot * along;
            let beyond = (u + v) * wedge.inverse > 1.0 || wedge.inverse == 0.0;
            if beyond {
                // At least as far as the plane.
                let height = q.dot(wedge.normal);
                if height * height * wedge.inverse < best.distance_squared + slack {
                    let share = ((q - spoke.to).dot(wedge.rim) * wedge.rim_inverse).clamp(0.0, 1.0);
                    let distance_squared = (q - spoke.to).distance_squared(wedge.rim * share);
                    if distance_squared < best.distance_squared {
                        best = Nearest { distance_squared, first: j, second: k, weights: [1.0 - share, share] };
                    }
                }
            } else if u >= 0.0 && v >= 0.0 {
                let height = q.dot(wedge.normal);
                let distance_squared = height * height * wedge.inverse;
                if distance_squared < best.distance_squared {
                    let weights = [u * wedge.inverse, v * wedge.inverse];
                    best = Nearest { distance_squared, first: j, second: k, weights };
                }
            }
            if best.distance_squared <= enough {
                return best;
            }
            along = along_next;
        }
        best
    }

    /// The point of one face right below or above `q`, if that face is here and the squared distance at most `enough`: where a
    /// sample was near before, it mostly still is.
    #[inline]
    fn within_face(&self, q: DVec3, face: u32, enough: f64) -> Option<Nearest> {
        let j = self.spokes.iter().position(|spoke| spoke.face == face)?;
        let wedge = self.wedges.get(j)?;
        let (spoke, k) = (&self.spokes[j], self.following(j));
        let next = &self.spokes[k];
        let height = q.dot(wedge.normal);
        let distance_squared = height * height * wedge.inverse;
        if distance_squared > enough || wedge.inverse == 0.0 {
            return None;
        }
        let (along, along_next) = (q.dot(spoke.to), q.dot(next.to));
        let u = (next.length_squared * along - wedge.dot * along_next) * wedge.inverse;
        let v = (spoke.length_squared * along_next - wedge.dot * along) * wedge.inverse;
        (u >= 0.0 && v >= 0.0 && u + v <= 1.0).then_some(Nearest {
            distance_squared,
            first: j,
            second: k,
            weights: [u, v],
        })
    }

    /// The face that a nearest point lies on or at the edge of.
    fn face(&self, at: &Nearest) -> u32 {
        self.spokes.get(at.first).map_or(NONE, |spoke| spoke.face)
    }

    /// The same, if that face has the vertex `v` as a corner; else [`NONE`].
    fn face_at(&self, at: &Nearest, v: u32) -> u32 {
        let Some(spoke) = self.spokes.get(at.first) else { return NONE };
        // The last spoke of an open star stands for the face before it.
        let other =
            if self.wedges.get(at.first).is_some() { self.following(at.first) } else { at.first.saturating_sub(1) };
        if spoke.vertex == v || self.spokes[other].vertex == v { spoke.face } else { NONE }
    }

    /// Squared distance to the border through the centre: the first and the last spoke of an open star.
    fn border_distance_squared(&self, q: DVec3) -> f64 {
        let ends = [self.spokes.first(), self.spokes.last()];
        ends.into_iter().flatten().fold(q.length_squared(), |best, spoke| {
            let share = (q.dot(spoke.to) * spoke.inverse).clamp(0.0, 1.0);
            best.min(q.distance_squared(spoke.to * share))
        })
    }

    /// Largest difference of a channel, as a share of full scale, between `color` and the star's interpolated one.
    fn color_difference(&self, color: [u8; 3], at: &Nearest) -> f64 {
        let [a, b] = [self.spokes.get(at.first), self.spokes.get(at.second)].map(|s| s.map_or(self.color, |s| s.color));
        let rest = 1.0 - at.weights[0] - at.weights[1];
        (0..3).fold(0.0, |worst: f64, k| {
            let there =
                f64::from(self.color[k]) * rest + f64::from(a[k]) * at.weights[0] + f64::from(b[k]) * at.weights[1];
            worst.max((f64::from(color[k]) - there).abs() / 255.0)
        })
    }
}

/// What one collapse does to the samples of both its ends.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Deviation {
    /// Largest distance of a sample to the new star, or 0 if none is over the one passed as enough; lattice steps.
    pub(crate) distance: f64,
    /// Largest colour difference of a sample, as a share of full scale, times the diameter of what the samples span.
    pub(crate) color: f64,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    sample: Point,
    face: u32,
    octant: u8,
    is_kept: bool,
    score: f64,
}

/// The samples of all vertices.
///
/// They are copies, in blocks that collapses hand on: looking the originals up would miss the cache for nearly every one, and
/// only vertices that something collapsed onto need a block.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    blocks: Vec<Block>,
    /// Blocks not in use; the last one freed is likely still in the cache.
    free: Vec<u32>,
    /// Block of each vertex, or [`NONE`].
    block_of: Vec<u32>,
    has_colors: bool,
    candidates: Vec<Candidate>,
    /// Star of a vertex beside a collapse.
    beside: Star,
}

/// What a collapse changed around it, after the fact.
pub(crate) struct Surroundings<'a> {
    /// Neighbours that `t` had.
    pub(crate) around: &'a [u32],
    /// Faces that `t` had: those that are gone, and those that went over to `s`.
    pub(crate) changed: &'a [u32],
}

#[derive(Clone, Copy, Debug)]
struct Block {
    count: u32,
    /// For each sample, a face at its vertex on which or at whose edge it was near enough when last measured; [`NONE`] if
    /// that is not known.
    faces: [u32; MAX_SAMPLES],
    samples: [Point; MAX_SAMPLES],
}

impl Block {
    const EMPTY: Self = Self {
        count: 0,
        faces: [NONE; MAX_SAMPLES],
        samples: [Point { position: [0; 3], color: [0; 3], is_boundary: false }; MAX_SAMPLES],
    };
}

impl Samples {
    pub(crate) fn new(vertex_count: usize, has_colors: bool) -> Self {
        Self {
            blocks: Vec::new(),
            free: Vec::new(),
            block_of: vec![NONE; vertex_count],
            has_colors,
            candidates: Vec::with_capacity(2 * MAX_SAMPLES + 2),
            beside: Star::default(),
        }
    }

    /// Hands `t` and its samples over to `s`, whose star after the collapse is `star`, and measures all of them. `ends` are the
    /// two before the collapse; if vertices move, an end is an original vertex and so a sample only as long as nothing
    /// collapsed onto it. Distances up to `enough` are not told apart.
    pub(crate) fn merge(
        &mut self,
        [s, t]: [u32; 2],
        ends: [Point; 2],
        moves: bool,
        star: &Star,
        enough: f64,
    ) -> Deviation {
        let mut candidates = std::mem::take(&mut self.candidates);
        candidates.clear();
        // With colours the nearest point itself matters, not just that there is one near enough.
        let enough_squared = if self.has_colors { -1.0 } else { enough * enough };
        let on_border = ends[0].is_boundary;
        let is_original = |v: u32| self.block_of[v as usize] == NONE;
        let own_t = (!moves || is_original(t)).then_some(&ends[1]);
        let own_s = (moves && is_original(s)).then_some(&ends[0]);
        let (mut worst, mut worst_color, mut reach) = (0.0f64, 0.0f64, 0.0f64);
        let of = |v: u32| self.hinted(v);
        let own = |point| (point, NONE);
        for (point, hint) in of(t).chain(own_t.map(own)).chain(own_s.map(own)).chain(of(s)) {
            let q = point.at() - star.center;
            let nearest = match hint {
                NONE => None,
                face => star.within_face(q, face, enough_squared),
            };
            let nearest = nearest.unwrap_or_else(|| star.nearest(q, enough_squared));
            let mut score = nearest.distance_squared;
            if on_border && point.is_boundary && !star.is_closed {
                score = score.max(star.border_distance_squared(q));
            }
            worst = worst.max(score);
            if self.has_colors {
                let difference = star.color_difference(point.color, &nearest);
                worst_color = worst_color.max(difference);
                reach = reach.max(q.length_squared());
                score = score.max(difference * difference * q.length_squared());
            }
            let octant = u8::from(q.x < 0.0) | u8::from(q.y < 0.0) << 1 | u8::from(q.z < 0.0) << 2;
            let face = star.face(&nearest);
            candidates.push(Candidate { sample: *point, face, octant, is_kept: false, score });
        }
        if candidates.len() > MAX_SAMPLES {
            keep_worst_and_spread(&mut candidates);
        }
        let kept = self.shared_block(s, t);
        for (i, candidate) in candidates.iter().enumerate() {
            kept.samples[i] = candidate.sample;
            kept.faces[i] = candidate.face;
        }
        kept.count = candidates.len() as u32;
        self.candidates = candidates;
        let distance = worst.sqrt();
        Deviation { distance: if distance > enough { distance } else { 0.0 }, color: worst_color * 2.0 * reach.sqrt() }
    }

    /// Measures the samples that the vertices around a collapse keep, as far as they lay at a face that it changed, against
    /// `star`, that of `s` afterwards, and the star of their own vertex, which `reset` gives. Largest distance, or 0 if none is
    /// over `enough`.
    ///
    /// Whoever is not near enough to a face at its own vertex is measured again when anything changes around it.
    pub(crate) fn measure_around(
        &mut self,
        points: &[Point],
        surroundings: Surroundings<'_>,
        star: &Star,
        enough: f64,
        mut reset: impl FnMut(&mut Star, u32),
    ) -> f64 {
        let mut worst = enough * enough;
        // Bits of the faces that changed, by their numbers modulo 64: most faces are told apart by them.
        let bit = |face: u32| 1u64 << (face % 64);
        let changed = surroundings.changed.iter().fold(0, |bits, &face| bits | bit(face));
        for &v in surroundings.around {
            let Some(block) = self.blocks.get_mut(self.block_of[v as usize] as usize) else { continue };
            let mut is_ready = false;
            let on_border = points[v as usize].is_boundary && !star.is_closed;
            for i in 0..block.count as usize {
                let face = block.faces[i];
                if face != NONE && (changed & bit(face) == 0 || !surroundings.changed.contains(&face)) {
                    continue;
                }
                let point = &block.samples[i];
                let at = point.at();
                let q = at - star.center;
                let nearest = star.within_face(q, face, worst).unwrap_or_else(|| star.nearest(q, worst));
                let mut distance_squared = nearest.distance_squared;
                let mut face = star.face_at(&nearest, v);
                let needs_border = on_border && point.is_boundary;
                if distance_squared > worst || face == NONE || needs_border {
                    if !is_ready {
                        reset(&mut self.beside, v);
                        is_ready = true;
                    }
                    let q = at - self.beside.center;
                    let own = self.beside.nearest(q, worst);
                    if own.distance_squared <= distance_squared.max(worst) {
                        face = self.beside.face(&own);
                    }
                    distance_squared = distance_squared.min(own.distance_squared);
                    if needs_border {
                        let border = self.beside.border_distance_squared(q);
                        let border = border.min(star.border_distance_squared(at - star.center));
                        distance_squared = distance_squared.max(border);
                    }
                }
                block.faces[i] = face;
                worst = worst.max(distance_squared);
            }
        }
        if worst > enough * enough { worst.sqrt() } else { 0.0 }
    }

    /// Gives samples, at most as many as [`Samples::of`] ever shows, to a vertex that has none.
    pub(crate) fn give(&mut self, v: u32, samples: &[Point]) {
        if !samples.is_empty() {
            let mut block = Block::EMPTY;
            block.samples[..samples.len()].copy_from_slice(samples);
            block.count = samples.len() as u32;
            self.block_of[v as usize] = self.blocks.len() as u32;
            self.blocks.push(block);
        }
    }

    /// The samples of a vertex.
    pub(crate) fn of(&self, v: u32) -> &[Point] {
        match self.blocks.get(self.block_of[v as usize] as usize) {
            Some(block) => &block.samples[..block.count as usize],
            None => &[],
        }
    }

    /// The samples of a vertex, each with a face at which it was near enough, or [`NONE`].
    fn hinted(&self, v: u32) -> impl Iterator<Item = (&Point, u32)> {
        let block = self.blocks.get(self.block_of[v as usize] as usize);
        block.into_iter().flat_map(|block| block.samples.iter().zip(block.faces).take(block.count as usize))
    }

    /// The block of `s`, be it its own, that of `t` or another; that of `t` is free otherwise.
    fn shared_block(&mut self, s: u32, t: u32) -> &mut Block {
        let of_t = std::mem::replace(&mut self.block_of[t as usize], NONE);
        let slot = &mut self.block_of[s as usize];
        if *slot == NONE {
            *slot = if of_t != NONE { of_t } else { self.free.pop().unwrap_or(self.blocks.len() as u32) };
        } else if of_t != NONE {
            self.free.push(of_t);
        }
        let index = *slot as usize;
        if index == self.blocks.len() {
            self.blocks.push(Block::EMPTY);
        }
        &mut self.blocks[index]
    }
}

/// Cuts `candidates` to [`MAX_SAMPLES`]: the worst of each octant around the centre, then the second worst of each, then the
/// rest in their order.
fn keep_worst_and_spread(candidates: &mut Vec<Candidate>) {
    let mut best = [[NONE; 2]; 8];
    for i in 0..candidates.len() {
        let candidate = candidates[i];
        let pair = &mut best[usize::from(candidate.octant)];
        let beats = |j: u32| j == NONE || candidate.score > candidates[j as usize].score;
        if beats(pair[0]) {
            *pair = [i as u32, pair[0]];
        } else if beats(pair[1]) {
            pair[1] = i as u32;
        }
    }
    let mut kept = 0;
    let in_turn = best.iter().map(|pair| pair[0]).chain(best.iter().map(|pair| pair[1]));
    for i in in_turn.filter(|&i| i != NONE).take(MAX_SAMPLES) {
        candidates[i as usize].is_kept = true;
        kept += 1;
    }
    let mut write = 0;
    for i in 0..candidates.len() {
        let candidate = candidates[i];
        let fills = !candidate.is_kept && kept < MAX_SAMPLES;
        if fills {
            kept += 1;
        }
        if candidate.is_kept || fills {
            candidates[write] = candidate;
            write += 1;
        }
    }
    candidates.truncate(write);
}
