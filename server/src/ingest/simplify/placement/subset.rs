//! At an end or in the middle.

use super::{Edge, Place, Placement, endpoint::Endpoint, midpoint::Midpoint};

/// The cheapest of both ends and the middle; an end in a tie.
#[derive(Debug)]
pub(super) struct Subset;

impl Placement for Subset {
    fn place(&self, edge: &Edge) -> Place {
        let (end, middle) = (Endpoint.place(edge), Midpoint.place(edge));
        if middle.cost < end.cost { middle } else { end }
    }
}
