//! What a split's fan looks like, and what is expected of the vertex that it inserts.

use lodestream_protocol::mesh::{Cut, Fan, Replica};
use lodestream_protocol::op::TRAINED;

use super::coder::{Contexts, Tape};

type Vector = [i64; 3];

/// `16 log2(x)`, linear between powers of two.
pub(super) fn lg(x: u64) -> i32 {
    let exponent = x.max(1).ilog2() as i32;
    let sixteenths = (u128::from(x.max(1)) * 16) >> exponent;
    16 * exponent + sixteenths as i32 - 16
}

/// `2^16 * 2^(i / 16)`, rounded.
const POWERS: [u32; 16] = [
    65536, 68438, 71468, 74632, 77936, 81386, 84990, 88752, 92682, 96785, 101070, 105545, 110218, 115098, 120194,
    125515,
];

fn power(x: i32) -> u64 {
    let (whole, part) = (x.div_euclid(16), x.rem_euclid(16));
    u64::from((POWERS[part as usize] >> -whole).max(1))
}

fn minus(a: Vector, b: Vector) -> Vector {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn sum(vectors: &[Vector]) -> Vector {
    vectors.iter().fold([0; 3], |sum, v| [sum[0] + v[0], sum[1] + v[1], sum[2] + v[2]])
}

fn dot(a: Vector, b: Vector) -> i64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn lg_square(a: Vector) -> i32 {
    lg(dot(a, a) as u64)
}

pub(super) fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A normal shifted to so many bits, and the axes, the one where it is largest last.
pub(super) fn dominant(normal: Vector, most_bits: u32) -> (Vector, [usize; 3]) {
    let bits = normal.iter().map(|x| 64 - x.unsigned_abs().leading_zeros()).max().unwrap_or(0);
    let normal = normal.map(|x| x >> bits.saturating_sub(most_bits));
    let h = (0..3).find(|&h| (0..3).all(|k| normal[h].abs() >= normal[k].abs())).expect("one is largest");
    (normal, [[1, 2, 0], [0, 2, 1], [0, 1, 2]][h])
}

/// The fan of a vertex.
pub(super) struct Ring {
    slots: Vec<u32>,
    s: u32,
    is_closed: bool,
    pub(super) origin: [i32; 3],
    spokes: Vec<Vector>,
    /// How many bits each coordinate of a spoke loses so that the largest has 12.
    shift: u32,
    /// Spokes without those.
    scaled: Vec<Vector>,
    /// Edges of the ring between scaled spokes, one for each face.
    edges: Vec<Vector>,
    areas: Vec<i64>,
    pub(super) normal: Vector,
    pub(super) axes: [usize; 3],
}

impl Ring {
    pub(super) fn new(replica: &Replica, s: u32, fan: &Fan) -> Self {
        let at = |slot: u32| replica.positions()[slot as usize].map(i64::from);
        let spokes: Vec<Vector> = fan.ring().iter().map(|&slot| minus(at(slot), at(s))).collect();
        // -1 takes no bit, since a shift leaves it at -1.
        let bits = |x: i64| if x < 0 { -x - 1 } else { x }.checked_ilog2().map_or(0, |log| log + 1);
        let most = spokes.iter().flatten().map(|&x| bits(x)).max().expect("a fan has spokes");
        let shift = most.max(12) - 12;
        let scaled: Vec<Vector> = spokes.iter().map(|d| d.map(|x| x.div_euclid(1 << shift))).collect();
        let pairs = (0..fan.faces() as usize).map(|i| (scaled[i], scaled[(i + 1) % scaled.len()]));
        let crosses: Vec<Vector> = pairs.clone().map(|(a, b)| cross(a, b)).collect();
        let (normal, axes) = dominant(sum(&crosses), 14);
        Self {
            slots: fan.ring().to_vec(),
            s,
            is_closed: fan.is_closed(),
            origin: replica.positions()[s as usize],
            edges: pairs.map(|(a, b)| minus(b, a)).collect(),
            shift,
            scaled,
            areas: crosses.iter().map(|c| c[axes[2]].abs()).collect(),
            spokes,
            normal,
            axes,
        }
    }

    fn mean_square(vectors: &[Vector]) -> i32 {
        let squares: i64 = vectors.iter().map(|&v| dot(v, v)).sum();
        lg(squares as u64) - lg(vectors.len() as u64)
    }

    /// Reads whether two coordinates are multiples of the step, and which: those before the last of the axes.
    pub(super) fn coarse_axes(&self, tape: &mut Tape<'_>, contexts: &mut Contexts, step: i32) -> Option<[usize; 3]> {
        let multiples = self.origin.iter().filter(|x| **x % step == 0).count();
        let (here, closed) = (u32::from(multiples >= 2), u32::from(self.is_closed));
        if !tape.bit(contexts, &format!("steps/is_coarse/{here}/{closed}")) {
            return None;
        }
        let size = |axis: usize| lg(self.normal[axis].unsigned_abs());
        // By how much the fan faces them; stable, so that of equal ones the first comes first.
        let mut order = [0, 1, 2];
        order.sort_by_key(|&axis| std::cmp::Reverse(self.normal[axis].unsigned_abs()));
        let class = |i: usize| ((size(order[i]) - size(order[i + 1])) / 4).min(7);
        let exact = if tape.bit(contexts, &format!("steps/is_fans_axis/{}", class(0))) {
            order[0]
        } else if tape.bit(contexts, &format!("steps/is_next_axis/{}", class(1))) {
            order[1]
        } else {
            order[2]
        };
        Some([[1, 2, 0], [0, 2, 1], [0, 1, 2]][exact])
    }

    /// How far the fan's plane falls along the third axis.
    pub(super) fn fall(&self, du: i32, dv: i32) -> i32 {
        self.fall_along(self.axes, du, dv)
    }

    /// How far it falls along the last of some axes.
    pub(super) fn fall_along(&self, [u, v, h]: [usize; 3], du: i32, dv: i32) -> i32 {
        if self.normal[h] == 0 {
            return 0;
        }
        let fall = (self.normal[u] * i64::from(du) + self.normal[v] * i64::from(dv)) / self.normal[h];
        fall.clamp(-(1 << 23), 1 << 23) as i32
    }

    /// Reads where the fan opens.
    pub(super) fn cut(&self, tape: &mut Tape<'_>, contexts: &mut Contexts) -> Cut {
        let spokes = self.spokes.len() as u32;
        if self.is_closed && (3..=12).contains(&spokes) {
            return self.ranked_cut(tape, contexts);
        }
        if self.is_closed {
            let low = tape.tree(contexts, &format!("cut/long_arc/{}", spokes.saturating_sub(12).min(7)), 16);
            let arc = if low < 15 { low + 1 } else { 16 + tape.uniform(spokes.saturating_sub(16).max(1)) };
            let right = tape.uniform(spokes);
            return Cut::Both { right, left: (right + arc) % spokes };
        }
        if tape.bit(contexts, "cut/open_case/0") {
            let right = tape.uniform(spokes - 1);
            return Cut::Both { right, left: right + 1 + tape.uniform(spokes - 1 - right) };
        }
        match tape.bit(contexts, "cut/open_case/1") {
            true => Cut::Left { left: tape.uniform(spokes) },
            false => Cut::Right { right: tape.uniform(spokes) },
        }
    }

    /// The arc's length, then its starts from the likeliest on.
    fn ranked_cut(&self, tape: &mut Tape<'_>, contexts: &mut Contexts) -> Cut {
        let count = self.scaled.len();
        // In eighths of an octave, towards the shorter.
        let against = (Self::mean_square(&self.edges) - Self::mean_square(&self.scaled)).div_euclid(4);
        let class = (against + 4).clamp(0, 7);
        let mut longer = |node: usize| tape.bit(contexts, &format!("cut/arc/{}/{class}/{node}", count - 3));
        let arc = if count > 3 && longer(0) {
            (3..count - 1).find(|&arc| !longer(arc - 1)).unwrap_or(count - 1)
        } else if longer(1) {
            2
        } else {
            1
        };
        let weights = &TRAINED.cut.arcs[arc];
        let lengths: Vec<i32> = self.scaled.iter().map(|&v| lg_square(v)).collect();
        let edges: Vec<i32> = self.edges.iter().map(|&v| lg_square(v)).collect();
        // Areas keep 16 bits of their sum.
        let total: i64 = self.areas.iter().sum();
        let lost = (total.max(1).ilog2() as i64 - 15).max(0);
        let reciprocal = (1i64 << 31) / (total >> lost).max(1);
        let mut starts: Vec<(i32, u32)> = Vec::new();
        for right in 0..count {
            let faces = || (right..right + arc).map(|i| i % count);
            let left = (right + arc) % count;
            let area: i64 = faces().map(|i| self.areas[i]).sum();
            let area = (((area >> lost) * reciprocal) >> 23) as i32 - 128;
            let inner: i32 = faces().skip(1).map(|i| lengths[i]).sum();
            let score = weights.cut_length * (lengths[right] + lengths[left])
                + weights.inner_length * inner
                + weights.edge_length * faces().map(|i| edges[i]).sum::<i32>()
                + weights.area * area
                + weights.area_squared * (area * area / 256);
            starts.push((score.div_euclid(256), right as u32));
        }
        let best = starts.iter().map(|start| start.0).max().expect("there are starts");
        let weight = |score: i32| power((score - best).max(-320));
        // A stable sort: of equals the first comes first.
        starts.sort_by_key(|start| std::cmp::Reverse(weight(start.0)));
        for (rank, &(score, right)) in starts.iter().enumerate() {
            let rest: u64 = starts[rank + 1..].iter().map(|start| weight(start.0)).sum();
            let odds = ((lg(weight(score)) - lg(rest.max(1))) / 8 + 16).clamp(0, 31);
            let is_last = rank + 1 == starts.len();
            if is_last || tape.bit(contexts, &format!("cut/is_it/{}/{odds}", rank.min(2))) {
                return Cut::Both { right, left: (right + arc as u32) % count as u32 };
            }
        }
        unreachable!("the last start needs no bit")
    }

    /// Colours of `s` and of the two spokes that `cut` opens, or of one and `s` again, come from these slots.
    pub(super) fn beside(&self, cut: Cut) -> [u32; 3] {
        let slot = |spoke: u32| self.slots[spoke as usize];
        match cut {
            Cut::Both { right, left } => [self.s, slot(right), slot(left)],
            Cut::Left { left: spoke } | Cut::Right { right: spoke } => [self.s, slot(spoke), self.s],
        }
    }

    /// Where the new vertex is expected, and the sizes of residuals across the normal and along it.
    pub(super) fn prediction(&self, cut: Cut) -> ([i32; 3], i32, i32) {
        let count = self.spokes.len();
        // Spokes in the arc, right to left, ends included where the cut opens them.
        let (arc, faces): (Vec<usize>, usize) = match cut {
            Cut::Both { right, left } => {
                let (right, left) = (right as usize, left as usize);
                let faces = (left + count - right) % count;
                ((right..=right + faces).map(|i| i % count).collect(), faces)
            }
            Cut::Left { left } => ((0..=left as usize).collect(), left as usize),
            Cut::Right { right } => ((right as usize..count).collect(), count - 1 - right as usize),
        };
        let is_end = |i: usize| match cut {
            Cut::Both { right, left } => i == right as usize || i == left as usize,
            Cut::Left { left: spoke } | Cut::Right { right: spoke } => i == spoke as usize,
        };
        let pick = |test: &dyn Fn(usize) -> bool| -> Vec<Vector> {
            (0..count).filter(|&i| test(i)).map(|i| self.spokes[i]).collect()
        };
        let ends = pick(&|i| is_end(i));
        let inner = pick(&|i| arc.contains(&i) && !is_end(i));
        let rest = pick(&|i| !arc.contains(&i));
        let arc_spokes = if inner.is_empty() { &ends } else { &inner };
        let parts = [arc_spokes, &ends, &rest, &self.spokes];
        let shape = faces.clamp(1, 6) - 1 + if self.is_closed { 0 } else { 6 };
        // To the nearest of 1/65536.
        let reciprocal = |count: usize| if count == 0 { 0 } else { (131_072 / count as i64 + 1) / 2 };
        let weights: Vec<i64> =
            parts.iter().zip(TRAINED.position[shape]).map(|(part, w)| i64::from(w) * reciprocal(part.len())).collect();
        let point = std::array::from_fn(|k| {
            let weighted: i64 = parts.iter().zip(&weights).map(|(part, weight)| weight * sum(part)[k]).sum();
            self.origin[k] + (weighted + (1 << 23)).div_euclid(1 << 24) as i32
        });
        let span = match cut {
            Cut::Both { right, left } => minus(self.scaled[right as usize], self.scaled[left as usize]),
            Cut::Left { left: spoke } | Cut::Right { right: spoke } => self.scaled[spoke as usize],
        };
        let unscaled = 32 * self.shift as i32;
        let above: u64 = self.scaled.iter().map(|&d| dot(d, self.normal).unsigned_abs()).sum();
        let roughness = 2 * (lg(above) - lg(count as u64)) - lg_square(self.normal) + unscaled;
        let shortest = self.scaled.iter().map(|&v| lg_square(v)).min().expect("a fan has spokes") + unscaled;
        let area = lg(self.areas.iter().sum::<i64>() as u64) + unscaled;
        let spoke = Self::mean_square(&self.scaled) + unscaled;
        let reach = lg_square(sum(arc_spokes)) - 2 * lg(arc_spokes.len() as u64);
        let tail = [lg_square(span) + unscaled, reach, Self::mean_square(&self.edges) + unscaled, area];
        let size = |weights: &lodestream_protocol::op::SizeWeights, second: i32| {
            let features = [[spoke, second].as_slice(), &tail].concat();
            let weighted: i32 = weights.features.iter().zip(features).map(|(weight, feature)| weight * feature).sum();
            weights.constant[shape] + weighted.div_euclid(512)
        };
        (point, size(&TRAINED.tangent_size, shortest), size(&TRAINED.height_size, roughness))
    }
}
