//! Choice of the lattice and rounding of the input onto it.

use glam::DVec3;
use lodestream_protocol::quant::{Lattice, MAX_LATTICE_BITS};

use crate::ingest::{hierarchy::Point, partition::MIN_DEFAULT_BITS};
use crate::mesh::TriMesh;

/// The lattice of `mesh`: `bits` if given, else the fewest for which a step is at most 1/16 of the mean edge and half the
/// 1st-percentile edge (edges of zero length left out), within 12 to 21 bits.
pub(crate) fn choose(mesh: &TriMesh, bits: Option<u8>) -> Lattice {
    let (min, max) = mesh.bounding_box().unwrap_or_default();
    if let Some(bits) = bits {
        return Lattice::of_box(min, max, bits);
    }
    let mut lengths: Vec<f32> = Vec::with_capacity(3 * mesh.faces.len());
    let mut sum = 0.0;
    for corners in &mesh.faces {
        for k in 0..3 {
            let [a, b] = [corners[k], corners[(k + 1) % 3]].map(|v| DVec3::from_array(mesh.positions[v as usize]));
            let length = a.distance(b);
            if length > 0.0 {
                lengths.push(length as f32);
                sum += length;
            }
        }
    }
    let mut bits = MIN_DEFAULT_BITS;
    if !lengths.is_empty() {
        let mean = sum / lengths.len() as f64;
        let rank = lengths.len() / 100;
        let percentile = f64::from(*lengths.select_nth_unstable_by(rank, f32::total_cmp).1);
        let step = (mean / 16.0).min(percentile / 2.0);
        while bits < MAX_LATTICE_BITS && Lattice::of_box(min, max, bits).step > step {
            bits += 1;
        }
    }
    Lattice::of_box(min, max, bits)
}

/// The vertices of `mesh`, rounded to `lattice`; which of them are on the boundary is left open.
pub(crate) fn round(mesh: &TriMesh, lattice: &Lattice) -> Vec<Point> {
    let colors = mesh.colors.as_deref();
    mesh.positions
        .iter()
        .enumerate()
        .map(|(v, &p)| Point {
            position: lattice.quantize(p),
            color: colors.map_or([0; 3], |c| c[v]),
            is_boundary: false,
        })
        .collect()
}
