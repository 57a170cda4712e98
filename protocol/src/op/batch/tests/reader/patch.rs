//! Patches for the dull reader.

use std::collections::{BTreeMap, BTreeSet};

use super::*;

fn distance(a: Vec3, b: Vec3) -> i64 {
    (0..3).map(|k| (a[k] - b[k]).abs()).sum()
}

fn bend(a: Vec3, b: Vec3, d: Vec3, x: Option<Vec3>) -> usize {
    let Some(x) = x else { return 0 };
    let (u, w, inside) = (sub(b, a), sub(x, a), sub(d, a));
    if dot(cross(u, w), cross(u, inside)) > 0 {
        1
    } else if dot(u, w) <= 0 {
        2
    } else if 4 * dot(u, w) * dot(u, w) > dot(u, u) * dot(w, w) {
        4
    } else {
        3
    }
}

impl Reader {
    pub(super) fn patch(&mut self) -> Result<Mesh, Fault> {
        let is_plain = self.coder.bit(PATCH);
        let vertices = self.coder.number(PATCH + 1);
        let more = self.coder.number(PATCH + 98 + if is_plain { 97 } else { 0 });
        let faces = (2 * vertices - 4 + unzigzag(more)) & 0xffff_ffff;
        if vertices > 1 << 22 || faces > 1 << 22 {
            return Err(Fault);
        }
        if is_plain { Ok(self.plain(vertices, faces)) } else { self.walked(vertices, faces) }
    }

    fn plain(&mut self, vertices: i64, faces: i64) -> Mesh {
        let mut mesh = Mesh::default();
        for _ in 0..vertices {
            mesh.positions.push([0; 3].map(|_: i64| self.coder.raw(self.bits)));
            let before = mesh.colors.last().copied().unwrap_or([0; 3]);
            mesh.colors.push(match self.has_colors {
                true => std::array::from_fn(|k| {
                    (before[k] + unzigzag(self.coder.number(PATCH + 1672 + 97 * k))).clamp(0, 255)
                }),
                false => [0; 3],
            });
        }
        let mut next = 0;
        for _ in 0..faces {
            mesh.faces.push(std::array::from_fn(|k| {
                let corner = next - unzigzag(self.coder.number(PATCH + 1381 + 97 * k));
                next = next.max(corner + 1).min(vertices);
                corner
            }));
        }
        mesh
    }

    fn walked(&mut self, vertices: i64, faces: i64) -> Result<Mesh, Fault> {
        let is_closed = self.coder.bit(PATCH + 292);
        let mut mesh = Mesh::default();
        // The third vertex of the face beside each edge.
        let mut border: BTreeMap<(i64, i64), i64> = BTreeMap::new();
        let mut stack: Vec<(i64, i64)> = Vec::new();
        let mut boundary = BTreeSet::new();
        while (mesh.faces.len() as i64) < faces {
            let n = mesh.positions.len() as i64;
            let edge = std::iter::from_fn(|| stack.pop()).find(|edge| border.contains_key(edge));
            let Some((a, b)) = edge else {
                if n + 3 > vertices {
                    return Err(Fault);
                }
                self.first_face(&mut mesh);
                add_face(&mut mesh, &mut border, &mut stack, [n, n + 1, n + 2], 0);
                continue;
            };
            let d = border[&(a, b)];
            let x = border.keys().filter(|edge| edge.1 == a).map(|edge| edge.0).max();
            let y = border.keys().filter(|edge| edge.0 == b).map(|edge| edge.1).max();
            let at = |v: i64| mesh.positions[v as usize];
            let bends = [bend(at(a), at(b), at(d), x.map(at)), bend(at(b), at(a), at(d), y.map(at))];
            let across = PATCH + 293 + 3 * (5 * bends[0] + bends[1]);
            let coder = &mut self.coder;
            let third = if n < vertices && coder.bit(across) {
                n
            } else if let Some(x) = x
                && coder.bit(if Some(x) == y { PATCH + 368 } else { across + 1 })
            {
                x
            } else if let Some(y) = y
                && x != Some(y)
                && coder.bit(across + 2)
            {
                y
            } else if !is_closed && coder.bit(PATCH + 369 + [a, b].iter().filter(|&v| boundary.contains(v)).count()) {
                border.remove(&(a, b));
                boundary.extend([a, b]);
                continue;
            } else if border.len() <= 256 {
                let others: BTreeSet<i64> = border.keys().map(|edge| edge.0).collect();
                let square =
                    |v: i64| -> i64 { (0..3).map(|k| at(a)[k] + at(b)[k] - 2 * at(v)[k]).map(|x| x * x).sum() };
                let is_other = |v: &i64| ![Some(a), Some(b), x, y].contains(&Some(*v));
                let mut others: Vec<(i64, i64)> = others.into_iter().filter(is_other).map(|v| (square(v), v)).collect();
                others.sort_unstable();
                others.get(coder.number(PATCH + 372) as usize).ok_or(Fault)?.1
            } else {
                coder.uniform(n)
            };
            if third == n {
                let position = self.across([at(a), at(b), at(d)]);
                let near = [a, b].map(|v| mesh.colors[v as usize]);
                mesh.positions.push(position);
                let color = self.patch_color(Some(near));
                mesh.colors.push(color);
            }
            add_face(&mut mesh, &mut border, &mut stack, [b, a, third], 1);
        }
        Ok(mesh)
    }

    fn first_face(&mut self, mesh: &mut Mesh) {
        let n = mesh.positions.len();
        for i in 0..3 {
            let before = mesh.positions[n..].to_vec();
            mesh.positions.push(std::array::from_fn(|k| match before[..] {
                [] => self.coder.raw(self.bits),
                [first] => first[k] + self.coder.near(PATCH + 469 + 69 * k, self.bits),
                [first, second, ..] => {
                    let scale = bit_length(distance(first, second).into());
                    ((first[k] + second[k]) >> 1) + self.coder.near(PATCH + 676 + 69 * k, scale)
                }
            }));
            let near = (i > 0).then(|| [mesh.colors[n], mesh.colors[n + i - 1]]);
            let color = self.patch_color(near);
            mesh.colors.push(color);
        }
    }

    fn across(&mut self, [a, b, d]: [Vec3; 3]) -> Vec3 {
        let (normal, h) = shifted(cross(sub(b, a), sub(d, a)), 30);
        let scale = bit_length(((distance(a, b) + distance(b, d) + distance(d, a)) / 3).into());
        let middle: Vec3 = std::array::from_fn(|k| (a[k] + b[k]) >> 1);
        let (mut out, mut sum) = ([0; 3], 0);
        for (i, k) in [[1, 2], [0, 2], [0, 1]][h].into_iter().enumerate() {
            let coded = self.coder.near(PATCH + 883 + 69 * i, scale);
            let residual = if middle[k] < d[k] { -coded } else { coded };
            sum += normal[k] * residual;
            out[k] = middle[k] + residual;
        }
        let coded = self.coder.near(PATCH + 883 + 138, scale);
        let plane = middle[h] - if normal[h] == 0 { 0 } else { sum / normal[h] };
        out[h] = plane + if normal[h] > 0 { -coded } else { coded };
        out
    }

    fn patch_color(&mut self, near: Option<[Vec3; 2]>) -> Vec3 {
        match near {
            _ if !self.has_colors => [0; 3],
            None => [0; 3].map(|_: i64| self.coder.raw(8)),
            Some([a, b]) => {
                let mean = to_ycocg(std::array::from_fn(|k| (a[k] + b[k]) >> 1));
                from_ycocg(std::array::from_fn(|k| mean[k] + unzigzag(self.coder.number(PATCH + 1090 + 97 * k))))
            }
        }
    }
}

fn add_face(
    mesh: &mut Mesh,
    border: &mut BTreeMap<(i64, i64), i64>,
    stack: &mut Vec<(i64, i64)>,
    face: [i64; 3],
    known: usize,
) {
    mesh.faces.push(face);
    for k in 0..3 {
        let (from, to) = (face[k], face[(k + 1) % 3]);
        if border.remove(&(to, from)).is_none() && k >= known {
            border.insert((from, to), face[(k + 2) % 3]);
            stack.push((from, to));
        }
    }
}
