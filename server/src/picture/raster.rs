//! Triangles into samples: nearest one wins, shaded smoothly except across creases.

use glam::DVec3;

use super::camera::Camera;
use crate::mesh::TriMesh;

/// Direction to the light: right, up, back. That of the viewer, whose picture this one turns into.
const LIGHT: DVec3 = DVec3::new(0.3, 0.4, 1.0);
/// Normals of faces that meet at a sharper angle than 45 degrees are not averaged: its cosine.
const CREASE_COSINE: f64 = 0.707_106_781_186_547_5;

/// Linear colours and coverage, sample by sample from the top left.
#[derive(Clone, Debug)]
pub(super) struct Canvas {
    pub(super) width: u32,
    pub(super) height: u32,
    /// Depth of the nearest surface, infinite where there is none.
    depth: Vec<f32>,
    color: Vec<[f32; 3]>,
}

impl Canvas {
    pub(super) fn new(width: u32, height: u32) -> Self {
        let samples = width as usize * height as usize;
        Self { width, height, depth: vec![f32::INFINITY; samples], color: vec![[0.0; 3]; samples] }
    }

    /// Linear colour of a sample inside the canvas, if something covers it.
    pub(super) fn sample(&self, x: u32, y: u32) -> Option<[f32; 3]> {
        let at = y as usize * self.width as usize + x as usize;
        (self.depth[at] < f32::INFINITY).then(|| self.color[at])
    }
}

/// A mesh before a camera. Without colours of its own it is white, and gets its tint when the picture is encoded.
pub(super) struct Surface<'a> {
    pub(super) mesh: &'a TriMesh,
    pub(super) camera: &'a Camera,
    pub(super) is_open: bool,
}

/// A corner of a triangle on its way to the canvas.
#[derive(Clone, Copy)]
struct Corner {
    /// See [`Camera::project`].
    at: [f64; 3],
    color: DVec3,
}

impl Surface<'_> {
    pub(super) fn draw(&self, canvas: &mut Canvas) {
        let mesh = self.mesh;
        let point = |v: u32| DVec3::from_array(mesh.positions[v as usize]);
        // Twice the area long, so that large faces count for more.
        let normals: Vec<DVec3> = mesh
            .faces
            .iter()
            .map(|face| {
                let [a, b, c] = face.map(point);
                (b - a).cross(c - a)
            })
            .collect();
        let around = FacesAround::new(mesh.positions.len(), &mesh.faces);
        for (face, &normal) in mesh.faces.iter().zip(&normals) {
            let faces_eye = normal.dot(self.camera.towards_eye(point(face[0]))) > 0.0;
            if !faces_eye && !self.is_open {
                continue;
            }
            let corners = face.map(|v| {
                let smooth = around.of(v).map(|f| normals[f as usize]).filter(|n| is_smooth(normal, *n)).sum::<DVec3>();
                let smooth = unit(if faces_eye { smooth } else { -smooth });
                let base = mesh.colors.as_ref().map_or(DVec3::ONE, |colors| linear(colors[v as usize]));
                Corner { at: self.camera.project(point(v)), color: base * self.light(smooth) }
            });
            fill(canvas, corners);
        }
    }

    /// How bright a surface of this unit normal is: the viewer's formula.
    fn light(&self, normal: DVec3) -> f64 {
        let Camera { right, up, back, .. } = self.camera;
        let key = unit(*right * LIGHT.x + *up * LIGHT.y + *back * LIGHT.z);
        0.25 * (0.75 + 0.25 * normal.dot(*up)) + 0.75 * normal.dot(key).max(0.0)
    }
}

fn unit(v: DVec3) -> DVec3 {
    let length = v.dot(v).sqrt();
    if length > 0.0 { v / length } else { DVec3::ZERO }
}

fn is_smooth(a: DVec3, b: DVec3) -> bool {
    a.dot(b) >= CREASE_COSINE * (a.dot(a) * b.dot(b)).sqrt()
}

/// The faces around each vertex.
struct FacesAround {
    begin: Vec<u32>,
    faces: Vec<u32>,
}

impl FacesAround {
    fn new(vertices: usize, faces: &[[u32; 3]]) -> Self {
        let mut begin = vec![0u32; vertices + 1];
        faces.iter().flatten().for_each(|&v| begin[v as usize + 1] += 1);
        for v in 0..vertices {
            begin[v + 1] += begin[v];
        }
        let mut next = begin.clone();
        let mut around = vec![0; 3 * faces.len()];
        for (f, face) in (0..).zip(faces) {
            for &v in face {
                around[next[v as usize] as usize] = f;
                next[v as usize] += 1;
            }
        }
        Self { begin, faces: around }
    }

    fn of(&self, v: u32) -> impl Iterator<Item = u32> + '_ {
        self.faces[self.begin[v as usize] as usize..self.begin[v as usize + 1] as usize].iter().copied()
    }
}

/// Covers the samples whose centres are in the triangle, edges included: neighbours share their edge's samples, and the nearer
/// one, else the first, has them.
fn fill(canvas: &mut Canvas, mut corners: [Corner; 3]) {
    let area = |a: [f64; 3], b: [f64; 3], x: f64, y: f64| (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]);
    let mut whole = area(corners[0].at, corners[1].at, corners[2].at[0], corners[2].at[1]);
    if whole < 0.0 {
        corners.swap(1, 2);
        whole = -whole;
    }
    if whole.is_nan() || whole <= 0.0 {
        return;
    }
    let [a, b, c] = corners;
    let range = |k: usize, samples: u32| {
        let ats = [a.at[k], b.at[k], c.at[k]];
        let low = ats.into_iter().fold(f64::INFINITY, f64::min) - 0.5;
        let high = ats.into_iter().fold(f64::NEG_INFINITY, f64::max) + 0.5;
        // Casts saturate, so nothing leaves the canvas.
        low.max(0.0) as u32..(high.max(0.0) as u32).min(samples)
    };
    for y in range(1, canvas.height) {
        for x in range(0, canvas.width) {
            let (at_x, at_y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            let weights = [area(b.at, c.at, at_x, at_y), area(c.at, a.at, at_x, at_y), area(a.at, b.at, at_x, at_y)];
            if weights.iter().any(|&w| w < 0.0) {
                continue;
            }
            // One over the depth is linear on the screen.
            let [u, v, w] = [weights[0] / whole / a.at[2], weights[1] / whole / b.at[2], weights[2] / whole / c.at[2]];
            let depth = 1.0 / (u + v + w);
            let at = y as usize * canvas.width as usize + x as usize;
            if (depth as f32) < canvas.depth[at] {
                canvas.depth[at] = depth as f32;
                canvas.color[at] = ((a.color * u + b.color * v + c.color * w) * depth).as_vec3().to_array();
            }
        }
    }
}

/// Linear light of an sRGB colour, each channel from 0 to 255: a polynomial that is within a thousandth of the standard's power.
pub(super) fn linear(color: [u8; 3]) -> DVec3 {
    DVec3::from_array(color.map(|channel| {
        let c = f64::from(channel) / 255.0;
        c * (c * (c * 0.305_306_011 + 0.682_171_111) + 0.012_522_878)
    }))
}
