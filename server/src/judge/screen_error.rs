//! The real screen error of a mesh in a view.

use glam::DVec3;
use lodestream_protocol::view::View;
use rayon::prelude::*;
use serde::Serialize;

use super::original::{BLOCK, Original, Shown};
use super::tree::TriangleTree;
use crate::mesh::TriMesh;

/// A mesh that stands in for the original.
#[derive(Debug)]
pub struct Candidate {
    tree: TriangleTree,
    /// Colours of each triangle's corners.
    colors: Option<Vec<[[u8; 3]; 3]>>,
}

impl Candidate {
    /// O(n log n).
    pub fn new(mesh: &TriMesh) -> Self {
        let triangles: Vec<_> =
            mesh.faces.iter().map(|face| face.map(|v| DVec3::from_array(mesh.positions[v as usize]))).collect();
        let colors =
            mesh.colors.as_ref().map(|colors| mesh.faces.iter().map(|face| face.map(|v| colors[v as usize])).collect());
        Self { tree: TriangleTree::new(&triangles), colors }
    }

    /// Triangles of the mesh.
    pub fn triangle_count(&self) -> usize {
        self.tree.len()
    }
}

/// How far some vertices lie off, in pixels. A share of the vertices lies nearer than each percentile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Percentiles {
    /// Vertices judged; with none, all else is 0.
    pub vertices: usize,
    /// Half of them.
    pub p50: f64,
    /// 99 % of them.
    pub p99: f64,
    /// 99.9 % of them.
    pub p999: f64,
    /// All of them. Infinite if the mesh has no triangle.
    pub max: f64,
}

impl Percentiles {
    /// Sorts `values`.
    pub fn of(values: &mut [f64]) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let Some(&max) = values.last() else { return Self::default() };
        let at = |share: f64| values[((values.len() as f64 * share) as usize).min(values.len() - 1)];
        Self { vertices: values.len(), p50: at(0.5), p99: at(0.99), p999: at(0.999), max }
    }
}

/// Difference between a vertex's colour and that of the mesh at the nearest point, its corners' colours interpolated: the
/// largest of the three channels, as a share of full scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ColorDifference {
    /// Over the unoccluded vertices.
    pub max: f64,
    /// Over the unoccluded vertices.
    pub mean: f64,
}

/// How far a mesh strays from the original in one view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ScreenError {
    /// Over all vertices of the original inside the view that face the eye.
    pub front_facing: Percentiles,
    /// Over those of them that nothing hides.
    pub unoccluded: Percentiles,
    /// Where both meshes have colours.
    pub color: Option<ColorDifference>,
}

/// What is found at one vertex.
#[derive(Clone, Copy, Debug)]
pub struct Finding {
    /// The vertex.
    pub shown: Shown,
    /// Its distance from the mesh, in pixels at its depth.
    pub pixels: f64,
    /// Colour difference there, as a share of full scale.
    pub color: Option<f64>,
}

/// Judges some vertices of the original, in their order: distance to the nearest point of the mesh, as pixels: distance x k /
/// depth along the view, with k pixels per unit at depth 1. Some microseconds a vertex on one core; runs in the caller's pool.
pub fn findings(original: &Original, shown: &[Shown], candidate: &Candidate, view: &View) -> Vec<Finding> {
    let scale = view.pixel_scale();
    let blocks = shown.par_chunks(BLOCK).map(|block| {
        let mut hint = u32::MAX;
        let judge = |shown: &Shown| {
            let Some(nearest) = candidate.tree.nearest(original.position(shown.vertex), hint) else {
                return Finding { shown: *shown, pixels: f64::INFINITY, color: None };
            };
            hint = nearest.hint;
            let color = candidate.colors.as_ref().zip(original.color(shown.vertex)).map(|(colors, own)| {
                let corners = colors[nearest.triangle as usize];
                let channel = |k: usize| {
                    let there: f64 = (0..3).map(|i| f64::from(corners[i][k]) * nearest.weights[i]).sum();
                    (f64::from(own[k]) - there).abs() / 255.0
                };
                channel(0).max(channel(1)).max(channel(2))
            });
            Finding { shown: *shown, pixels: nearest.distance_squared.sqrt() * scale / shown.depth, color }
        };
        block.iter().map(judge).collect::<Vec<_>>()
    });
    blocks.collect::<Vec<_>>().concat()
}

/// Judges a mesh in a view (see [`Original::shown`] for which vertices count, [`findings`] for the measure).
pub fn screen_error(original: &Original, candidate: &Candidate, view: &View) -> ScreenError {
    let findings = findings(original, &original.shown(view), candidate, view);
    let unoccluded = || findings.iter().filter(|f| f.shown.is_unoccluded);
    let color = findings.first().and_then(|f| f.color).map(|_| {
        let (mut max, mut sum, mut count) = (0.0f64, 0.0, 0u64);
        for difference in unoccluded().filter_map(|f| f.color) {
            max = max.max(difference);
            sum += difference;
            count += 1;
        }
        ColorDifference { max, mean: sum / count.max(1) as f64 }
    });
    ScreenError {
        front_facing: Percentiles::of(&mut findings.iter().map(|f| f.pixels).collect::<Vec<_>>()),
        unoccluded: Percentiles::of(&mut unoccluded().map(|f| f.pixels).collect::<Vec<_>>()),
        color,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::TriMesh;

    /// A square of side 2 about the origin, facing +z, at a height.
    fn square(z: f64, color: u8) -> TriMesh {
        TriMesh {
            positions: vec![[-1.0, -1.0, z], [1.0, -1.0, z], [1.0, 1.0, z], [-1.0, 1.0, z]],
            faces: vec![[0, 1, 2], [0, 2, 3]],
            colors: Some(vec![[color, 0, 0]; 4]),
        }
    }

    #[test]
    fn pixels_are_distance_times_scale_over_depth() {
        let view = View::perspective(DVec3::Z * 10.0, DVec3::ZERO, 0.5);
        let error = screen_error(&Original::new(&square(0.0, 51)), &Candidate::new(&square(0.5, 0)), &view);
        let expected = 0.5 * view.pixel_scale() / 10.0;
        assert_eq!(error.front_facing.vertices, 4);
        assert_eq!(error.front_facing, error.unoccluded);
        assert!((error.unoccluded.max - expected).abs() < 1e-9 && (error.unoccluded.p50 - expected).abs() < 1e-9);
        assert_eq!(error.color, Some(ColorDifference { max: 0.2, mean: 0.2 }));
    }

    #[test]
    fn what_faces_away_or_is_hidden_is_told_apart() {
        let mut mesh = square(0.0, 0);
        // A second square behind the first, and smaller.
        mesh.positions.extend(square(-1.0, 0).positions.iter().map(|p| [p[0] / 2.0, p[1] / 2.0, p[2]]));
        mesh.faces.extend([[4, 5, 6], [4, 6, 7]]);
        mesh.colors = None;
        let (original, candidate) = (Original::new(&mesh), Candidate::new(&mesh));
        let from = |z: f64| screen_error(&original, &candidate, &View::perspective(DVec3::Z * z, DVec3::ZERO, 0.5));
        let error = from(10.0);
        assert_eq!((error.front_facing.vertices, error.unoccluded.vertices), (8, 4));
        assert_eq!((error.front_facing.max, error.color), (0.0, None));
        assert_eq!(from(-10.0).front_facing.vertices, 0, "they face the other way");
        let mut view = View::perspective(DVec3::Z * -10.0, DVec3::ZERO, 0.5);
        view.two_sided = true;
        let error = screen_error(&original, &candidate, &view);
        assert_eq!((error.front_facing.vertices, error.unoccluded.vertices), (8, 8), "the small one hides no corner");
    }

    #[test]
    fn percentiles_of_a_thousand() {
        let mut values: Vec<f64> = (0..1000).rev().map(f64::from).collect();
        let percentiles = Percentiles::of(&mut values);
        assert_eq!((percentiles.p50, percentiles.p99, percentiles.p999), (500.0, 990.0, 999.0));
        assert_eq!((percentiles.max, percentiles.vertices), (999.0, 1000));
        assert_eq!(Percentiles::of(&mut []), Percentiles::default());
    }
}
