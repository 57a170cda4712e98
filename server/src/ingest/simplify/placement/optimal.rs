//! Where the distances to the planes around are least, moved so that the volume stays the same.
//!
//! Least distances alone put the vertices of a curved surface outside it. With the volume kept (Lindstrom and Turk 1998) the faces
//! cross the surface, and the mean distance falls by a fifth.

use glam::DVec3;

use super::{Edge, Place, Placement, Volume, subset::Subset, vector};
use crate::ingest::simplify::quadric::Minimum;

/// Pull towards the middle of the edge, as a share of the quadrics' weight: where they leave a direction free (flat and ridged
/// places), the minimum is taken near the middle.
pub(super) const PULL: f64 = 1e-3;
/// Most lengths of the edge that either step may take. Further out the planes are nearly parallel.
pub(super) const MAX_REACH: f64 = 1.0;

/// The minimum over the planes of both ends, rounded to the lattice, or what [`Subset`] says if that is no dearer.
#[derive(Debug)]
pub(super) struct Optimal;

impl Placement for Optimal {
    fn place(&self, edge: &Edge) -> Place {
        let subset = Subset.place(edge);
        let [a, b] = edge.ends.map(|end| vector(end.position));
        let middle = (a + b) * 0.5;
        let minimum = Minimum::new(edge.planes, [a, b], middle, PULL);
        match minimum.and_then(|minimum| near(edge, middle, minimum.offset())) {
            Some(least) if least.cost < subset.cost => least,
            _ => subset,
        }
    }

    fn settle(&self, edge: &Edge, place: Place, volume: &dyn Fn() -> Volume) -> Place {
        let Volume { normal, height } = volume();
        let at = vector(place.at);
        let minimum = Minimum::new(edge.planes, edge.ends.map(|end| vector(end.position)), at, PULL);
        let offset = minimum.and_then(|minimum| minimum.offset_onto(normal, height - normal.dot(at)));
        offset.and_then(|offset| near(edge, at, offset)).unwrap_or(place)
    }
}

/// The place at an offset, unless that is too far.
fn near(edge: &Edge, from: DVec3, offset: DVec3) -> Option<Place> {
    let [a, b] = edge.ends.map(|end| vector(end.position));
    if offset.length_squared() > MAX_REACH * MAX_REACH * a.distance_squared(b) {
        return None;
    }
    let at = (from + offset).to_array().map(|x| x.clamp(0.0, f64::from(edge.max)));
    // Not negative: the cast rounds.
    Some(edge.at(at.map(|x| (x + 0.5) as i32)))
}
