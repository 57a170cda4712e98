//! Complete small meshes: the base and spawned components.

use std::collections::BTreeMap;

use lodestream_protocol::mesh::Patch;
use lodestream_protocol::op::TRAINED;

use super::coder::{Contexts, Tape, contexts, names};
use super::ring::{cross, dominant};
use super::{from_ycocg, to_ycocg};

type Point = [i32; 3];

/// Contexts of patches.
pub(super) fn patch_contexts() -> Contexts {
    let numbers = |name: &str, end| -> Vec<String> {
        names::each(name, &[end]).iter().flat_map(|name| names::number(name)).collect()
    };
    let nears =
        |name: &str| -> Vec<String> { names::each(name, &[3]).iter().flat_map(|name| names::near(name)).collect() };
    let steps = |bend: String| ["new", "before", "after"].map(|step| format!("{bend}/{step}"));
    let all = [
        vec!["plain".to_owned()],
        names::number("vertices"),
        numbers("faces", 2),
        vec!["closed".to_owned()],
        names::each("bend", &[5, 5]).into_iter().flat_map(steps).collect(),
        vec!["fills".to_owned()],
        names::each("boundary", &[3]),
        names::number("rank"),
        nears("second"),
        nears("third"),
        nears("next"),
        numbers("color", 3),
        numbers("plain_corner", 3),
        numbers("plain_color", 3),
    ];
    contexts(&all.concat(), TRAINED.patch_priors)
}

/// Reads a patch.
pub(super) fn read(tape: &mut Tape<'_>, contexts: &mut Contexts, bits: u8, has_colors: bool) -> Result<Patch, String> {
    let is_plain = tape.bit(contexts, "plain");
    let vertices = tape.number(contexts, "vertices") as usize;
    let more = tape.zigzag(contexts, &format!("faces/{}", u32::from(is_plain)));
    let faces = usize::try_from(2 * vertices as i64 - 4 + i64::from(more)).map_err(|e| e.to_string())?;
    if is_plain {
        return Ok(plain(tape, contexts, bits, has_colors, vertices, faces));
    }
    let is_closed = tape.bit(contexts, "closed");
    let mut walk = Walk { patch: Patch::default(), border: BTreeMap::new(), stack: Vec::new(), boundary: Vec::new() };
    while walk.patch.faces.len() < faces {
        let Some((a, b)) = walk.stack.pop() else {
            walk.first_face(tape, contexts, bits, has_colors);
            continue;
        };
        let Some(&d) = walk.border.get(&(a, b)) else { continue };
        walk.cross(tape, contexts, (bits, has_colors, is_closed, vertices), [a, b, d])?;
    }
    match walk.patch.positions.len() == vertices {
        true => Ok(walk.patch),
        false => Err("other vertices than announced".into()),
    }
}

fn plain(
    tape: &mut Tape<'_>,
    contexts: &mut Contexts,
    bits: u8,
    has_colors: bool,
    vertices: usize,
    faces: usize,
) -> Patch {
    let mut patch = Patch::default();
    let mut color = [0i32; 3];
    for _ in 0..vertices {
        patch.positions.push([0; 3].map(|_: i32| tape.raw(bits.into()) as i32));
        for (k, channel) in color.iter_mut().enumerate().filter(|_| has_colors) {
            *channel = (*channel + tape.zigzag(contexts, &format!("plain_color/{k}"))).clamp(0, 255);
        }
        patch.colors.push(color.map(|channel| channel as u8));
    }
    let mut unnamed = 0;
    for _ in 0..faces {
        patch.faces.push([0, 1, 2].map(|k| {
            let v = unnamed - tape.zigzag(contexts, &format!("plain_corner/{k}"));
            unnamed = unnamed.max(v + 1);
            v as u32
        }));
    }
    patch
}

struct Walk {
    patch: Patch,
    /// Third vertex of the face beside each edge that has none on the other side so far.
    border: BTreeMap<(u32, u32), u32>,
    stack: Vec<(u32, u32)>,
    /// Vertices known to lie on the boundary.
    boundary: Vec<u32>,
}

impl Walk {
    fn at(&self, v: u32) -> Point {
        self.patch.positions[v as usize]
    }

    fn first_face(&mut self, tape: &mut Tape<'_>, contexts: &mut Contexts, bits: u8, has_colors: bool) {
        let first: Point = [0; 3].map(|_: i32| tape.raw(bits.into()) as i32);
        let start = self.patch.positions.len() as u32;
        self.patch.positions.push(first);
        let color = if has_colors { [0; 3].map(|_: u8| tape.raw(8) as u8) } else { [0; 3] };
        self.patch.colors.push(color);
        let second = [0, 1, 2].map(|k| first[k] + near(tape, contexts, &format!("second/{k}"), bits.into()));
        self.add_vertex(tape, contexts, has_colors, second, [color; 2]);
        let scale = bit_length(distance(first, second));
        let third =
            [0, 1, 2].map(|k| ((first[k] + second[k]) >> 1) + near(tape, contexts, &format!("third/{k}"), scale));
        let colors = [color, self.patch.colors[start as usize + 1]];
        self.add_vertex(tape, contexts, has_colors, third, colors);
        self.add_face([start, start + 1, start + 2], false);
    }

    fn add_vertex(
        &mut self,
        tape: &mut Tape<'_>,
        contexts: &mut Contexts,
        has_colors: bool,
        position: Point,
        near: [[u8; 3]; 2],
    ) {
        self.patch.positions.push(position);
        let mut color = [0; 3];
        if has_colors {
            let mean = [0, 1, 2].map(|k| (i32::from(near[0][k]) + i32::from(near[1][k])) >> 1);
            let mean = to_ycocg(mean);
            let coded = [0, 1, 2].map(|k| mean[k] + tape.zigzag(contexts, &format!("color/{k}")));
            color = from_ycocg(coded).map(|channel| channel.clamp(0, 255) as u8);
        }
        self.patch.colors.push(color);
    }

    fn add_face(&mut self, face: [u32; 3], is_crossed: bool) {
        let [x, y, z] = face;
        self.patch.faces.push(face);
        if is_crossed {
            self.border.remove(&(y, x));
        }
        for (from, to, opposite) in [(x, y, z), (y, z, x), (z, x, y)].into_iter().skip(usize::from(is_crossed)) {
            if self.border.remove(&(to, from)).is_none() {
                self.border.insert((from, to), opposite);
                self.stack.push((from, to));
            }
        }
    }

    fn cross(
        &mut self,
        tape: &mut Tape<'_>,
        contexts: &mut Contexts,
        (bits, has_colors, is_closed, vertices): (u8, bool, bool, usize),
        [a, b, d]: [u32; 3],
    ) -> Result<(), String> {
        let before = self.border.keys().filter(|edge| edge.1 == a).map(|edge| edge.0).max();
        let after = self.border.keys().filter(|edge| edge.0 == b).map(|edge| edge.1).max();
        let [pa, pb, pd] = [a, b, d].map(|v| self.at(v));
        let bends = [bend(pa, pb, pd, before.map(|v| self.at(v))), bend(pb, pa, pd, after.map(|v| self.at(v)))];
        let name = |step: &str| format!("bend/{}/{}/{step}", bends[0], bends[1]);
        let count = self.patch.positions.len() as u32;
        let is_same = before.is_some() && before == after;
        let before_name = if is_same { "fills".to_owned() } else { name("before") };
        if self.patch.positions.len() < vertices && tape.bit(contexts, &name("new")) {
            let position = self.new_position(tape, contexts, [pa, pb, pd]);
            if position.iter().any(|x| !(0..1 << bits).contains(x)) {
                return Err(format!("{position:?} is off the lattice"));
            }
            let colors = [a, b].map(|v| self.patch.colors[v as usize]);
            self.add_vertex(tape, contexts, has_colors, position, colors);
            self.add_face([b, a, count], true);
        } else if before.is_some() && tape.bit(contexts, &before_name) {
            self.add_face([b, a, before.unwrap_or_default()], true);
        } else if after.is_some() && !is_same && tape.bit(contexts, &name("after")) {
            self.add_face([b, a, after.unwrap_or_default()], true);
        } else {
            let known = [a, b].iter().filter(|v| self.boundary.contains(v)).count();
            if !is_closed && tape.bit(contexts, &format!("boundary/{known}")) {
                self.border.remove(&(a, b));
                self.boundary.extend([a, b]);
                return Ok(());
            }
            if self.border.len() > 256 {
                let v = tape.uniform(count);
                self.add_face([b, a, v], true);
                return Ok(());
            }
            let others = self.border.keys().map(|edge| edge.0);
            let others = others.filter(|&v| v != a && v != b && Some(v) != before && Some(v) != after);
            let square = |x: i32| u64::from(x.unsigned_abs()).pow(2);
            let key = |v: u32| (0..3).map(|k| square(pa[k] + pb[k] - 2 * self.at(v)[k])).sum::<u64>();
            let mut ranked: Vec<(u64, u32)> = others.map(|v| (key(v), v)).collect();
            ranked.sort_unstable();
            ranked.dedup();
            let rank = tape.number(contexts, "rank") as usize;
            let v = ranked.get(rank).ok_or("there are not so many vertices")?.1;
            self.add_face([b, a, v], true);
        }
        Ok(())
    }

    fn new_position(&self, tape: &mut Tape<'_>, contexts: &mut Contexts, [a, b, d]: [Point; 3]) -> Point {
        let wide = |p: Point, q: Point| -> [i64; 3] { [0, 1, 2].map(|k| i64::from(q[k]) - i64::from(p[k])) };
        let (normal, [u, v, h]) = dominant(cross(wide(a, b), wide(a, d)), 30);
        let scale = bit_length((distance(a, b) + distance(b, d) + distance(d, a)) / 3);
        let middle = [0, 1, 2].map(|k| (a[k] + b[k]) >> 1);
        let mut out = middle;
        let mut fall = 0;
        for (i, k) in [u, v].into_iter().enumerate() {
            let coded = near(tape, contexts, &format!("next/{i}"), scale);
            let residual = if middle[k] < d[k] { -coded } else { coded };
            out[k] += residual;
            fall += normal[k] * i64::from(residual);
        }
        let coded = near(tape, contexts, "next/2", scale);
        out[h] -= if normal[h] == 0 { 0 } else { (fall / normal[h]) as i32 };
        out[h] += if normal[h] > 0 { -coded } else { coded };
        out
    }
}

fn bit_length(x: u64) -> u32 {
    64 - x.leading_zeros()
}

fn distance(a: Point, b: Point) -> u64 {
    (0..3).map(|k| u64::from(a[k].abs_diff(b[k]))).sum()
}

/// A signed number near a known bit length.
fn near(tape: &mut Tape<'_>, contexts: &mut Contexts, name: &str, scale: u32) -> i32 {
    let length = tape.tree(contexts, &format!("{name}/length"), 64) + scale;
    // 0 where it is that many bits shorter than the scale, or more.
    let Some(bits @ 1..) = length.checked_sub(32) else { return 0 };
    let (mut number, mut left) = (1, bits - 1);
    while left > 0 && number < 4 {
        left -= 1;
        number = number * 2 + i32::from(tape.bit(contexts, &format!("{name}/mantissa/{number}")));
    }
    let number = number << left | tape.raw(left) as i32;
    if tape.bit(contexts, &format!("{name}/sign")) { -number } else { number }
}

/// How the border bends at `a`.
fn bend(a: Point, b: Point, d: Point, x: Option<Point>) -> u32 {
    let Some(x) = x else { return 0 };
    let [u, w, inside] = [b, x, d].map(|p| [0, 1, 2].map(|k| i64::from(p[k]) - i64::from(a[k])));
    let dot = |p: [i64; 3], q: [i64; 3]| (0..3).map(|k| i128::from(p[k]) * i128::from(q[k])).sum::<i128>();
    if dot(cross(u, w), cross(u, inside)) > 0 {
        1
    } else if dot(u, w) <= 0 {
        2
    } else if 4 * dot(u, w).pow(2) <= dot(u, u) * dot(w, w) {
        3
    } else {
        4
    }
}
