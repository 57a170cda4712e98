//! Where the vertex lies that a collapse leaves, and what that costs.
//!
//! A place is a lattice point: it is rounded before its cost, the flip test and the error look at it, so nothing that is
//! stored differs from what was judged. One end of the edge *stays*: it keeps its number, and moves to the place. At
//! [`endpoint`] it does not even move; the other rules work between any two vertices but those of which only one is on the
//! boundary, where the boundary vertex stays put.

mod endpoint;
mod midpoint;
mod optimal;
mod subset;
#[cfg(test)]
mod tests;

use glam::DVec3;

use super::batch::Mover;
use super::quadric::{self, Planes};
use crate::ingest::hierarchy::Point;

/// Where the vertex that a collapse leaves lies, relative to the two that it joins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PlacementChoice {
    /// At the cheaper end: positions never change, and a split sends a single one.
    #[default]
    Endpoint,
    /// In the middle, rounded to the lattice by the parity of the end that goes; three bits tell where the other end was.
    Midpoint,
    /// At an end or in the middle, whichever is cheapest.
    Subset,
    /// Where the distances to the planes around are least and the volume stays the same, or as with `Subset` where that is cheaper.
    Optimal,
}

impl PlacementChoice {
    /// All there are, the default first.
    pub const ALL: [Self; 4] = [Self::Endpoint, Self::Midpoint, Self::Subset, Self::Optimal];

    /// What places vertices on a lattice with this largest coordinate, or `None` for half-edge collapses.
    pub(crate) fn mover(self, max_coordinate: i32) -> Option<Mover> {
        self.rule().map(|rule| Mover { rule, max_coordinate })
    }

    /// The rule, or `None` for half-edge collapses, which need none: their place is that of the end that stays.
    pub(super) fn rule(self) -> Option<&'static dyn Placement> {
        match self {
            Self::Endpoint => None,
            Self::Midpoint => Some(&midpoint::Midpoint),
            Self::Subset => Some(&subset::Subset),
            Self::Optimal => Some(&optimal::Optimal),
        }
    }
}

/// A rule that places the vertex which joins the ends of an edge.
pub(super) trait Placement: std::fmt::Debug + Sync {
    /// The place and the end that stays. Deterministic: `+ - * /` in a fixed order, ties to what comes first.
    fn place(&self, edge: &Edge) -> Place;

    /// The place to try, now that the edge's turn has come and its surroundings may be looked at.
    fn settle(&self, _edge: &Edge, place: Place, _volume: &dyn Fn() -> Volume) -> Place {
        place
    }
}

/// An edge as placements see it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Edge<'a> {
    pub(super) ends: [&'a Point; 2],
    pub(super) planes: [&'a Planes; 2],
    /// Largest coordinate of the lattice.
    pub(super) max: i32,
}

/// Six times the volume between the faces around an edge and those that replace them, as a function of the place:
/// `normal . place - height`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Volume {
    pub(super) normal: DVec3,
    pub(super) height: f64,
}

/// A place for the vertex that joins an edge's ends.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Place {
    /// On the lattice.
    pub(super) at: [i32; 3],
    /// Whether the first end stays, else the second.
    pub(super) keeps_first: bool,
    /// In lattice steps to the fifth, as [`quadric::costs`].
    pub(super) cost: f64,
}

impl Edge<'_> {
    /// A place at `at`; the nearer end stays, which is the one that moves less.
    fn at(&self, at: [i32; 3]) -> Place {
        let share = share(self.ends, at);
        Place { at, keeps_first: share <= 0.5, cost: self.cost(at, share) }
    }

    /// Value of the planes of both ends at `at`, and what [`quadric::costs`] adds for colour: each end's surroundings change their colour as
    /// far as the place lies from it along the edge.
    fn cost(&self, at: [i32; 3], share: f64) -> f64 {
        let [a, b] = self.ends.map(Point::at);
        let [qa, qb] = self.planes;
        let p = vector(at);
        let rest = 1.0 - share;
        let changed = share * share * qa.weight + rest * rest * qb.weight;
        let color = quadric::color_weight(self.ends[0].color, self.ends[1].color);
        qa.at(p - a) + qb.at(p - b) + quadric::along(a.distance_squared(b), color, changed)
    }
}

/// How far along the edge from the first end `at` lies, projected onto it: 0 to 1. Exactly 0 and 1 at the ends; 0 if they
/// coincide.
pub(super) fn share(ends: [&Point; 2], at: [i32; 3]) -> f64 {
    let [a, b] = ends.map(Point::at);
    let d = b - a;
    let length_squared = d.length_squared();
    if length_squared == 0.0 { 0.0 } else { ((vector(at) - a).dot(d) / length_squared).clamp(0.0, 1.0) }
}

/// Colour at a share of the way from one vertex to another.
pub(super) fn color(from: [u8; 3], to: [u8; 3], share: f64) -> [u8; 3] {
    std::array::from_fn(|k| {
        let (from, to) = (f64::from(from[k]), f64::from(to[k]));
        // In range, and never negative: the cast rounds.
        (from + (to - from) * share + 0.5) as u8
    })
}

/// A lattice point as a vector.
pub(super) fn vector(at: [i32; 3]) -> DVec3 {
    DVec3::new(f64::from(at[0]), f64::from(at[1]), f64::from(at[2]))
}
