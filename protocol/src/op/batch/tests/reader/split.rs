//! What a split codes, for the dull reader.

use std::collections::BTreeMap;

use super::*;

pub(super) struct Ring {
    pub(super) slots: Vec<i64>,
    /// Face slots around `s`.
    pub(super) faces: Vec<i64>,
    pub(super) is_closed: bool,
    d: Vec<Vec3>,
    e: Vec<Vec3>,
    shift: i64,
    lengths: Vec<i64>,
    edges: Vec<i64>,
    areas: Vec<i64>,
    normal: Vec3,
    h: usize,
    mean: i64,
    edge: i64,
    shortest: i64,
}

impl Reader {
    pub(super) fn ring(&self, s: i64) -> Ring {
        // By face around `s`, the two other corners.
        let around: BTreeMap<i64, (i64, i64)> = self
            .face
            .iter()
            .filter_map(|(&face, c)| (0..3).find(|&k| c[k] == s).map(|k| (face, (c[(k + 1) % 3], c[(k + 2) % 3]))))
            .collect();
        let start = around.iter().find(|(_, (first, _))| !around.values().any(|(_, last)| last == first));
        let is_closed = start.is_none();
        let mut faces = vec![*start.map_or_else(|| around.keys().next().unwrap(), |(face, _)| face)];
        while faces.len() < around.len() {
            let last = around[faces.last().unwrap()].1;
            faces.push(*around.iter().find(|(_, (first, _))| *first == last).unwrap().0);
        }
        let mut slots: Vec<i64> = faces.iter().map(|face| around[face].0).collect();
        if !is_closed {
            slots.push(around[faces.last().unwrap()].1);
        }
        let d: Vec<Vec3> = slots.iter().map(|slot| sub(self.position[slot], self.position[&s])).collect();
        let n = d.len();
        let mut shift = 0;
        while d.iter().flatten().any(|x| !(-4936..4936).contains(&(x >> shift))) {
            shift += 1;
        }
        let e: Vec<Vec3> = d.iter().map(|d| d.map(|x| x >> shift)).collect();
        let squares: Vec<i128> = e.iter().map(|&e| dot(e, e)).collect();
        let sides: Vec<(Vec3, Vec3)> = (0..faces.len()).map(|i| (e[i], e[(i + 1) % n])).collect();
        let edges: Vec<i128> = sides.iter().map(|&(a, b)| dot(sub(b, a), sub(b, a))).collect();
        let crosses: Vec<Vec3> = sides.iter().map(|&(a, b)| cross(a, b)).collect();
        let (normal, h) = shifted(std::array::from_fn(|k| crosses.iter().map(|c| c[k]).sum()), 14);
        Ring {
            lengths: squares.iter().map(|&x| lg(x)).collect(),
            mean: lg(squares.iter().sum()) - lg(n as i128) + 32 * shift,
            shortest: lg(*squares.iter().min().unwrap()) + 32 * shift,
            edge: lg(edges.iter().sum()) - lg(faces.len() as i128) + 32 * shift,
            edges: edges.into_iter().map(lg).collect(),
            areas: crosses.iter().map(|c| c[h].abs()).collect(),
            slots,
            faces,
            is_closed,
            d,
            e,
            shift,
            normal,
            h,
        }
    }

    pub(super) fn cut(&mut self, ring: &Ring) -> Spokes {
        let n = ring.d.len() as i64;
        if ring.is_closed && (3..=12).contains(&n) {
            return self.ranked_cut(ring, n as usize);
        }
        if ring.is_closed {
            let mut a = self.coder.tree(3788 + 16 * (n - 12).clamp(0, 7) as usize, 16) + 1;
            if a == 16 {
                a += self.coder.uniform((n - 16).max(1));
            }
            let right = self.coder.uniform(n);
            return (Some(right), Some((right + a) % n));
        }
        if self.coder.bit(2730) {
            let right = self.coder.uniform(n - 1);
            return (Some(right), Some(right + 1 + self.coder.uniform((n - 1 - right).max(1))));
        }
        let is_left = self.coder.bit(2731);
        let spoke = Some(self.coder.uniform(n));
        if is_left { (None, spoke) } else { (spoke, None) }
    }

    fn ranked_cut(&mut self, ring: &Ring, n: usize) -> Spokes {
        let class = (((ring.edge - ring.mean) >> 2) + 4).clamp(0, 7);
        let longer = |coder: &mut Coder, node: usize| coder.bit(2828 + 12 * (8 * (n - 3) + class as usize) + node);
        let a = if n == 3 || !longer(&mut self.coder, 0) {
            1 + usize::from(longer(&mut self.coder, 1))
        } else {
            let mut a = 3;
            while a + 1 < n && longer(&mut self.coder, a - 1) {
                a += 1;
            }
            a
        };
        let weights = &numbers("arcs", "")[5 * a..][..5];
        let total = ring.areas.iter().sum::<i64>();
        let mut keep = 0;
        while total >> keep >= 1 << 16 {
            keep += 1;
        }
        let mut scores = Vec::new();
        for r in 0..n {
            let length = |i: usize| ring.lengths[i % n];
            let cut_length = length(r) + length(r + a);
            let inner: i64 = (r + 1..r + a).map(length).sum();
            let edges: i64 = (r..r + a).map(|i| ring.edges[i % n]).sum();
            let area: i64 = (r..r + a).map(|i| ring.areas[i % n]).sum();
            let area = (((area >> keep) * ((1 << 31) / (total >> keep).max(1))) >> 23) - 128;
            let features = [cut_length, inner, edges, area, (area * area) >> 8];
            scores.push(weights.iter().zip(features).map(|(w, f)| w * f).sum::<i64>() >> 8);
        }
        let best = *scores.iter().max().unwrap();
        let mut left: Vec<(usize, i64)> =
            scores.iter().map(|score| power((score - best).max(-320))).enumerate().collect();
        for rank in 0.. {
            let largest = left.iter().map(|pair| pair.1).max().unwrap();
            let at = left.iter().position(|pair| pair.1 == largest).unwrap();
            let (right, w) = left.remove(at);
            let rest: i64 = left.iter().map(|pair| pair.1).sum();
            let odds = ((lg(w.into()) - lg(rest.max(1).into())) / 8 + 16).clamp(0, 31);
            if left.is_empty() || self.coder.bit(2732 + 32 * std::cmp::min(rank, 2) + odds as usize) {
                return (Some(right as i64), Some(((right + a) % n) as i64));
            }
        }
        unreachable!()
    }

    pub(super) fn geometry(&mut self, s: i64, ring: &Ring, cut: Spokes, a: i64) -> Entry {
        let (d, n, normal, h) = (&ring.d, ring.d.len(), ring.normal, ring.h);
        let arc = a as usize;
        let opened: Vec<usize> = [cut.0, cut.1].into_iter().flatten().map(|spoke| spoke as usize).collect();
        let inner: Vec<usize> = match cut {
            (Some(right), Some(_)) => (1..arc).map(|i| (right as usize + i) % n).collect(),
            (None, _) => (0..arc).collect(),
            (Some(right), None) => (1..=arc).map(|i| right as usize + i).collect(),
        };
        let others: Vec<usize> = (0..n).filter(|i| !inner.contains(i) && !opened.contains(i)).collect();
        let total = |spokes: &[usize]| -> Vec3 { std::array::from_fn(|k| spokes.iter().map(|&i| d[i][k]).sum()) };
        let all: Vec<usize> = (0..n).collect();
        let near_arc = if inner.is_empty() { &opened } else { &inner };
        let parts = [near_arc, &opened, &others, &all];
        let lg2 = |v: Vec3| lg(dot(v, v));
        let (e, up) = (&ring.e, 32 * ring.shift);
        let span = lg2(if opened.len() == 2 { sub(e[opened[0]], e[opened[1]]) } else { e[opened[0]] }) + up;
        let reach = lg2(total(near_arc)) - 2 * lg(near_arc.len() as i128);
        let above: i128 = e.iter().map(|&e| dot(e, normal).abs()).sum();
        let rough = 2 * (lg(above) - lg(n as i128)) - lg2(normal) + up;
        let area = lg(ring.areas.iter().sum::<i64>().into()) + up;
        let shape = (a.clamp(1, 6) - 1) as usize + if ring.is_closed { 0 } else { 6 };
        let size = |section, second| {
            let features = [ring.mean, second, span, reach, ring.edge, area];
            let sum: i64 = numbers(section, "features").iter().zip(features).map(|(w, f)| w * f).sum();
            numbers(section, "constant")[shape] + (sum >> 9)
        };
        let (tangent, height) = (size("tangent_size", ring.shortest), size("height_size", rough));
        let weights = numbers("position", "");
        let b = self.position[&s];
        let share = |n: i64| if n == 0 { 0 } else { (65_536 + n / 2) / n };
        let point: Vec3 = std::array::from_fn(|k| {
            let of = |i: usize| weights[4 * shape + i] * share(parts[i].len() as i64) * total(parts[i])[k];
            b[k] + (((0..4).map(of).sum::<i64>() + (1 << 23)) >> 24)
        });
        let across = [[1, 2], [0, 2], [0, 1]];
        let [u, v] = across[h];
        let near = |x: i64| x.clamp(-1 << 22, 1 << 22);
        let fall_along = |h: usize, x: i64, y: i64| match normal[h] {
            0 => 0,
            down => {
                let [u, v] = across[h];
                ((normal[u] * near(x) + normal[v] * near(y)) / down).clamp(-1 << 23, 1 << 23)
            }
        };
        let fall = |x: i64, y: i64| fall_along(h, x, y);
        let coder = &mut self.coder;
        let step = self.step;
        let is_s_coarse = step > 0 && b.iter().filter(|&&x| x % step == 0).count() >= 2;
        let mut t = [0; 3];
        if step > 0 && coder.bit(6810 + 2 * usize::from(is_s_coarse) + usize::from(ring.is_closed)) {
            let faces = |k: usize| normal[k].abs();
            let mut rest = across[h];
            if faces(rest[1]) > faces(rest[0]) {
                rest.swap(0, 1);
            }
            let more = |a: usize, b: usize| ((lg(faces(a).into()) - lg(faces(b).into())) / 4).clamp(0, 7) as usize;
            let mut e = h;
            if !coder.bit(6814 + more(h, rest[0])) {
                e = if coder.bit(6822 + more(rest[0], rest[1])) { rest[0] } else { rest[1] };
            }
            let [u, v] = across[e];
            let size = tangent - lg(step.into());
            let mut multiple =
                |k: usize, at| ((point[k] + step / 2).div_euclid(step) + coder.signed(at, 7350, size)) * step;
            (t[u], t[v]) = (multiple(u, 6830), multiple(v, 7090));
            t[e] = point[e] - fall_along(e, t[u] - point[u], t[v] - point[v]) + coder.signed(4436, 4696, height);
        } else {
            let du = coder.signed(3916, 4696, tangent);
            let dv = coder.signed(4176, 4696, tangent);
            (t[u], t[v]) = (point[u] + du, point[v] + dv);
            t[h] = point[h] - fall(du, dv) + coder.signed(4436, 4696, height);
        }

        let (mut color, mut moved, mut color_moved) = ([0; 3], [0; 3], [0; 3]);
        let before = self.color[&s];
        if self.has_colors {
            let of = |spoke: Option<i64>| to_ycocg(spoke.map_or(before, |i| self.color[&ring.slots[i as usize]]));
            let near = [to_ycocg(before), of(cut.0), of(cut.1)];
            let mut surprise = 0;
            color = from_ycocg(std::array::from_fn(|channel| {
                let [i, j, k] = near.map(|color| color[channel]);
                let size = lg(((i - j).abs() + (i - k).abs() + (j - k).abs() + surprise + 1).into()) - 16;
                let residual = coder.signed(4793 + 260 * channel, 5833, size);
                surprise = residual.abs().min(255) >> 1;
                (i + j + k + 1) / 3 + residual
            }));
        }
        if self.has_moves && !coder.bit(5930) {
            let back = sub(b, t);
            if coder.bit(5931) {
                let odd = |x: i64| if x & 1 == 1 { -1 } else { 1 };
                moved = std::array::from_fn(|k| back[k] + if coder.bit(5932) { odd(t[k]) } else { 0 });
            } else {
                moved[u] = back[u] / 2 + coder.signed(5933, 6713, tangent);
                moved[v] = back[v] / 2 + coder.signed(6193, 6713, tangent);
                moved[h] =
                    -back[h] + fall(-back[u], -back[v]) - fall(moved[u], moved[v]) + coder.signed(6453, 6713, height);
            }
        }
        if self.has_moves && self.has_colors {
            let by = moved.map(near);
            let edge = sub(sub(t, b).map(near), by);
            let square = dot(edge, edge);
            let of = (-dot(by, edge)).clamp(0, square);
            color_moved = std::array::from_fn(|k| {
                let (x, y) = (before[k], color[k]);
                let predicted = match square - of {
                    0 => 0,
                    rest => (i128::from(x) + i128::from(x - y) * of / rest).clamp(0, 255) as i64 - x,
                };
                (predicted + coder.signed(5573, 5833, lg(((x - y).abs() + 1).into()) - 16)) & 255
            });
        }
        let nested = Vec::new();
        Entry { age: 0, position: t, color, moved, color_moved, left: None, right: None, is_known: false, nested }
    }
}
