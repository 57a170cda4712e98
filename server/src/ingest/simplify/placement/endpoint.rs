//! At the cheaper end.

use super::{Edge, Place, Placement};

/// The rule as others combine it. By itself it is the half-edge collapse, which has a path of its own.
#[derive(Debug)]
pub(super) struct Endpoint;

impl Placement for Endpoint {
    fn place(&self, edge: &Edge) -> Place {
        let [first, second] = edge.ends;
        let keep_first = edge.cost(first.position, 0.0);
        let keep_second = edge.cost(second.position, 1.0);
        if keep_first <= keep_second {
            Place { at: first.position, keeps_first: true, cost: keep_first }
        } else {
            Place { at: second.position, keeps_first: false, cost: keep_second }
        }
    }
}
