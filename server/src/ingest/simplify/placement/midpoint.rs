//! In the middle.

use super::{Edge, Place, Placement};

/// The lattice point in the middle; the end with the larger area stays. Between two lattice points, each coordinate is rounded
/// up if that of the end that goes is odd and down if it is even: without bias, and known to whoever knows that end and the
/// place, so that one bit each tells where the other end was.
#[derive(Debug)]
pub(super) struct Midpoint;

impl Placement for Midpoint {
    fn place(&self, edge: &Edge) -> Place {
        let keeps_first = edge.planes[0].weight >= edge.planes[1].weight;
        let [stays, goes] = if keeps_first { edge.ends } else { [edge.ends[1], edge.ends[0]] };
        let at = std::array::from_fn(|k| {
            let (s, t) = (stays.position[k], goes.position[k]);
            (s + t + (t & 1)) >> 1
        });
        Place { at, keeps_first, cost: edge.cost(at, 0.5) }
    }
}
