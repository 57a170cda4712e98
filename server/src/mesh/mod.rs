//! Ingest-time geometry: indexed triangle meshes in `f64`, before they become a vertex-split DAG.

pub mod audit;
pub(crate) mod edges;
pub mod export;
pub(crate) mod morton;

/// An indexed triangle mesh as readers produce it and exporters write it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// Vertex positions in model units.
    pub positions: Vec<[f64; 3]>,
    /// Corner indices into `positions`, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// One RGB colour per vertex (`len == positions.len()`), or `None` for a model without colours.
    pub colors: Option<Vec<[u8; 3]>>,
}

impl TriMesh {
    /// Smallest and largest coordinates over all vertices, or `None` without vertices.
    pub fn bounding_box(&self) -> Option<([f64; 3], [f64; 3])> {
        let first = *self.positions.first()?;
        Some(self.positions.iter().fold((first, first), |(lo, hi), p| {
            (std::array::from_fn(|k| lo[k].min(p[k])), std::array::from_fn(|k| hi[k].max(p[k])))
        }))
    }
}
