//! Where the quadric is least.

use super::{Edge, Place, Placement, subset::Subset, vector};

/// Pull towards the middle of the edge, as a share of the quadrics' weight: where they leave a direction free (flat and ridged
/// places), the minimum is taken near the middle.
const PULL: f64 = 1e-3;
/// Most lengths of the edge that a place may be away from its middle. Further out the planes are nearly parallel.
const MAX_REACH: f64 = 1.0;

/// The minimum of both quadrics, rounded to the lattice, or what [`Subset`] says if that is no dearer.
#[derive(Debug)]
pub(super) struct Optimal;

impl Placement for Optimal {
    fn place(&self, edge: &Edge) -> Place {
        let subset = Subset.place(edge);
        match least(edge) {
            Some(least) if least.cost < subset.cost => least,
            _ => subset,
        }
    }
}

fn least(edge: &Edge) -> Option<Place> {
    let [a, b] = edge.ends.map(|end| vector(end.position));
    let [qa, qb] = edge.quadrics;
    let middle = (a + b) * 0.5;
    let offset = qa.least_with(qb, a, b, middle, PULL)?;
    let reach = MAX_REACH * MAX_REACH * a.distance_squared(b);
    if offset.length_squared() > reach {
        return None;
    }
    let at = (middle + offset).to_array().map(|x| x.clamp(0.0, f64::from(edge.max)));
    // Not negative: the cast rounds.
    Some(edge.at(at.map(|x| (x + 0.5) as i32)))
}
