//! From a mesh to an open model in memory, by the same steps as `ingest`.

use std::collections::BTreeSet;
use std::sync::Arc;

use lodestream_server::ingest::clean::clean;
use lodestream_server::ingest::ingest_to_vec;
use lodestream_server::ingest::simplify::BuildOptions;
use lodestream_server::mesh::TriMesh;
use lodestream_server::pack::{Metadata, PackedModel, extract_complete};

/// A model and the mesh that it must refine to.
#[derive(Debug)]
pub struct TestModel {
    /// Ready for sessions.
    pub model: Arc<PackedModel>,
    /// The cleaned input, in model units.
    pub clean: TriMesh,
    pack: Arc<Vec<u8>>,
}

/// An oriented triangle by lattice positions, rotated to its smallest form.
pub type LatticeTriangle = [[i32; 3]; 3];

/// The smallest of the three rotations, orientation kept: the same for all ways to write a triangle, also where corners
/// coincide.
pub fn canonical(triangle: LatticeTriangle) -> LatticeTriangle {
    let [a, b, c] = triangle;
    [[a, b, c], [b, c, a], [c, a, b]].into_iter().min().expect("three rotations")
}

impl TestModel {
    /// Cleans and builds `mesh` with so many lattice bits, or the default.
    pub fn new(mesh: TriMesh, bits: Option<u8>) -> Self {
        Self::with_options(mesh, &BuildOptions { bits, ..BuildOptions::default() })
    }

    /// Cleans and builds `mesh`.
    pub fn with_options(mesh: TriMesh, options: &BuildOptions) -> Self {
        let (bytes, report, _) = ingest_to_vec(&mesh, options, &Metadata::default()).expect("the mesh can be built");
        let (mut clean, _) = clean(mesh);
        let pack = Arc::new(bytes);
        let model = open(&pack);
        if report.one_sided_edges > 0 {
            turn_like(&mut clean, &model);
        }
        Self { model, clean, pack }
    }

    /// The model as one that was just opened: none of its pages has been read.
    pub fn reopened(&self) -> Arc<PackedModel> {
        open(&self.pack)
    }

    /// The pack.
    pub fn pack(&self) -> &[u8] {
        &self.pack
    }

    /// The complete mesh as a sorted multiset of lattice triangles.
    pub fn expected_triangles(&self) -> Vec<LatticeTriangle> {
        let lattice = self.model.info().lattice;
        let at = |v: u32| lattice.quantize(self.clean.positions[v as usize]);
        let mut triangles: Vec<_> = self.clean.faces.iter().map(|f| canonical(f.map(at))).collect();
        triangles.sort_unstable();
        triangles
    }
}

/// Turns faces to the side that they have in the model: which one that is, is up to whoever cuts a one-sided surface.
fn turn_like(clean: &mut TriMesh, model: &PackedModel) {
    let lattice = model.info().lattice;
    let place = |mesh: &TriMesh, face: [u32; 3]| canonical(face.map(|v| lattice.quantize(mesh.positions[v as usize])));
    let complete = extract_complete(model).expect("a pack just written is sound");
    let theirs: BTreeSet<LatticeTriangle> = complete.faces.iter().map(|&face| place(&complete, face)).collect();
    for i in 0..clean.faces.len() {
        let [a, b, c] = clean.faces[i];
        if !theirs.contains(&place(clean, [a, b, c])) {
            clean.faces[i] = [a, c, b];
        }
    }
}

fn open(pack: &Arc<Vec<u8>>) -> Arc<PackedModel> {
    Arc::new(PackedModel::open(pack.clone()).expect("a pack just written opens"))
}
