//! Clipping, filling and depth test.

use glam::DVec3;

use super::{CLAY, Corner, Hit, Image, Light, RasterOptions, Subject, decode_srgb, shade};

/// Parts of a pixel to which corners snap, as on GPUs.
const SUBPIXEL: f64 = 256.0;
/// Corners further out than this many half-screens are clipped, so that edge functions stay within 64 bits.
const GUARD: f64 = 8.0;

/// Draws `subject`; the nearest face wins a pixel, the earlier one a tie.
///
/// Costs O(faces + pixels touched). A face of no area, with a corner that is not finite, or with an index out of range
/// draws nothing.
pub fn render(subject: &Subject, options: &RasterOptions) -> Image {
    let mut image = Image::blank(options.width, options.height);
    let light = Light::of_camera(options.view_projection);
    let normals = options.smooth.then(|| vertex_normals(subject));
    for (face, &corners) in (0u32..).zip(subject.faces) {
        let Some(points) = points(subject, corners) else { continue };
        let Some(flat) = (points[1] - points[0]).cross(points[2] - points[0]).try_normalize() else { continue };
        let corner = |i: usize| {
            let v = corners[i] as usize;
            Corner {
                clip: options.view_projection * points[i].extend(1.0),
                base: subject.colors.map_or(DVec3::from_array(CLAY), |c| DVec3::from_array(c[v].map(decode_srgb))),
                normal: normals.as_ref().map_or(flat, |n| n[v]),
            }
        };
        let polygon = clip(vec![corner(0), corner(1), corner(2)]);
        for i in 1..polygon.len().saturating_sub(1) {
            fill(&mut image, [polygon[0], polygon[i], polygon[i + 1]], face, flat, &light, options);
        }
    }
    image
}

fn points(subject: &Subject, corners: [u32; 3]) -> Option<[DVec3; 3]> {
    let mut points = [DVec3::ZERO; 3];
    for (point, v) in points.iter_mut().zip(corners) {
        *point = DVec3::from_array(*subject.positions.get(v as usize)?);
        if !point.is_finite() {
            return None;
        }
    }
    Some(points)
}

/// Area-weighted mean of the normals of the faces around each vertex, unit length, or zero where they cancel.
fn vertex_normals(subject: &Subject) -> Vec<DVec3> {
    let mut normals = vec![DVec3::ZERO; subject.positions.len()];
    for &corners in subject.faces {
        let Some([a, b, c]) = points(subject, corners) else { continue };
        let normal = (b - a).cross(c - a);
        corners.iter().for_each(|&v| normals[v as usize] += normal);
    }
    normals.iter().map(|n| n.normalize_or_zero()).collect()
}

/// Sutherland-Hodgman against the near plane and the guard band; the far plane is tested per pixel.
fn clip(mut polygon: Vec<Corner>) -> Vec<Corner> {
    let planes: [fn(&Corner) -> f64; 5] = [
        |c| c.clip.z,
        |c| GUARD * c.clip.w - c.clip.x,
        |c| GUARD * c.clip.w + c.clip.x,
        |c| GUARD * c.clip.w - c.clip.y,
        |c| GUARD * c.clip.w + c.clip.y,
    ];
    for side in planes {
        if polygon.iter().all(|c| side(c) >= 0.0) {
            continue;
        }
        let mut kept = Vec::with_capacity(polygon.len() + 1);
        for (i, corner) in polygon.iter().enumerate() {
            let next = &polygon[(i + 1) % polygon.len()];
            let (here, there) = (side(corner), side(next));
            if here >= 0.0 {
                kept.push(*corner);
            }
            if (here >= 0.0) != (there >= 0.0) {
                let t = here / (here - there);
                kept.push(Corner {
                    clip: corner.clip.lerp(next.clip, t),
                    base: corner.base.lerp(next.base, t),
                    normal: corner.normal.lerp(next.normal, t),
                });
            }
        }
        polygon = kept;
    }
    polygon.retain(|c| c.clip.w > 0.0);
    polygon
}

fn fill(image: &mut Image, triangle: [Corner; 3], face: u32, flat: DVec3, light: &Light, options: &RasterOptions) {
    let mut corners = triangle;
    // Screen x to the right, y down, in units of 1/256 pixel.
    let snap = |c: &Corner| {
        let x = (c.clip.x / c.clip.w * 0.5 + 0.5) * f64::from(options.width);
        let y = (0.5 - c.clip.y / c.clip.w * 0.5) * f64::from(options.height);
        [(x * SUBPIXEL).round() as i64, (y * SUBPIXEL).round() as i64]
    };
    let mut screen = corners.each_ref().map(snap);
    // With y down, a face that is counter-clockwise to the viewer has a negative cross product.
    let mut doubled = edge(screen[0], screen[1], screen[2]);
    if doubled == 0 || (doubled > 0 && !options.two_sided) {
        return;
    }
    let facing = if doubled < 0 { 1.0 } else { -1.0 };
    if doubled < 0 {
        corners.swap(1, 2);
        screen.swap(1, 2);
        doubled = -doubled;
    }
    let pixels = |axis: usize, limit: u32| {
        let lo = screen.iter().map(|s| s[axis]).min().expect("three corners");
        let hi = screen.iter().map(|s| s[axis]).max().expect("three corners");
        let first = (lo.div_euclid(SUBPIXEL as i64)).clamp(0, i64::from(limit));
        let end = (hi.div_euclid(SUBPIXEL as i64) + 1).clamp(0, i64::from(limit));
        first as u32..end as u32
    };
    let depth = corners.map(|c| c.clip.z / c.clip.w);
    let inverse_w = corners.map(|c| 1.0 / c.clip.w);
    for y in pixels(1, options.height) {
        for x in pixels(0, options.width) {
            let centre = [x, y].map(|p| i64::from(p) * SUBPIXEL as i64 + SUBPIXEL as i64 / 2);
            let edges = [(1, 2), (2, 0), (0, 1)].map(|(a, b)| (edge(screen[a], screen[b], centre), a, b));
            if !edges.iter().all(|&(e, a, b)| e > 0 || (e == 0 && is_top_left(screen[a], screen[b]))) {
                continue;
            }
            let weights = edges.map(|(e, ..)| e as f64 / doubled as f64);
            let z = (0..3).map(|i| weights[i] * depth[i]).sum::<f64>();
            let index = y as usize * options.width as usize + x as usize;
            if z > 1.0 || image.hits[index].is_some_and(|hit| hit.depth <= z) {
                continue;
            }
            let total: f64 = (0..3).map(|i| weights[i] * inverse_w[i]).sum();
            let mean = |value: fn(&Corner) -> DVec3| {
                (0..3).map(|i| value(&corners[i]) * (weights[i] * inverse_w[i] / total)).sum::<DVec3>()
            };
            let normal = mean(|c| c.normal).normalize_or(flat) * facing;
            image.set(index, Hit { face, depth: z }, shade(mean(|c| c.base), normal, light));
        }
    }
}

/// Twice the signed area of a, b, c; positive where they turn clockwise on the screen (y down).
fn edge(a: [i64; 2], b: [i64; 2], c: [i64; 2]) -> i64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Does the edge from `a` to `b` of a triangle that is clockwise on the screen own the pixel centres on it?
fn is_top_left(a: [i64; 2], b: [i64; 2]) -> bool {
    (a[1] == b[1] && b[0] > a[0]) || b[1] < a[1]
}
