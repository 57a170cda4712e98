//! What a sequence of collapses becomes: deviations and visibility spheres, carried up with each surviving vertex while
//! simplification runs, and afterwards the records of a vertex-split DAG.
//!
//! Knows points, collapses and root faces; how collapses are found and ordered is the business of
//! [`simplify`](super::simplify), which calls this module and is never called by it. Start at [`assembly`].

pub(crate) mod assembly;
pub(crate) mod bounds;
pub(crate) mod components;
pub(crate) mod deviation;
#[cfg(test)]
pub(crate) mod forest;
pub(crate) mod order;
pub mod paper;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use self::bounds::Normals;
use super::spill::Spill;
use crate::pack::record::{Bounds, Cone, Magnitude, VERTEX_OPS};

/// No half-edge, no vertex, no op.
pub(crate) const NONE: u32 = u32::MAX;

/// A vertex on the lattice: 16 bytes, so that a look-up touches one cache line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    pub(crate) position: [i32; 3],
    /// Zero for models without colours.
    pub(crate) color: [u8; 3],
    /// Whether the vertex lies on the boundary. No collapse ever changes that: holes stay, and a boundary vertex only goes
    /// along the boundary.
    pub(crate) is_boundary: bool,
}

impl Point {
    /// Position in lattice steps. Coordinates have at most 21 bits, so a cross product of two differences is exact.
    #[inline]
    pub(crate) fn at(&self) -> DVec3 {
        DVec3::new(f64::from(self.position[0]), f64::from(self.position[1]), f64::from(self.position[2]))
    }
}

/// One collapse as simplification saw it. Its number is its place in the order of simplification, the reverse of the order of
/// refinement. Half-edges are `3 * face + corner`, from that corner to the next, in the numbering of the complete mesh.
#[derive(Clone, Debug)]
pub(crate) struct Collapse {
    /// The vertex that stays.
    pub(crate) s: u32,
    /// The vertex that goes.
    pub(crate) t: u32,
    /// Half-edge from `s` to `t`, in `f_l`; [`NONE`] if that face does not exist.
    pub(crate) left: u32,
    /// Half-edge from `t` to `s`, in `f_r`; [`NONE`] if that face does not exist.
    pub(crate) right: u32,
    /// Half-edges across the outer edges of the two faces, in `fn0 .. fn3`; [`NONE`] where there is none.
    pub(crate) outer: [u32; 4],
    /// The collapse before this one that kept `s`, which is the next split of `s` in refinement.
    pub(crate) next_of_s: u32,
    /// The last collapse that kept `t`, which is the first split of `t`.
    pub(crate) first_of_t: u32,
    /// What the split adds to the position of `s`: where `s` was before the collapse less where it is afterwards.
    pub(crate) s_move: [i32; 3],
    /// What the split adds to the colour of `s`, modulo 256.
    pub(crate) s_color_move: [u8; 3],
    /// Visibility sphere, as stored.
    pub(crate) bounds: Bounds,
}

/// A [`Collapse`] with all that its record needs, as it waits in a [`Spill`]: vertices, half-edges and ops by their global
/// numbers, 92 bytes without padding.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct CollapseRecord {
    /// The vertex that stays.
    pub(crate) s: u32,
    /// The vertex that goes.
    pub(crate) t: u32,
    /// Half-edge from `s` to `t`, in `f_l`; [`NONE`] if that face does not exist.
    pub(crate) left: u32,
    /// Half-edge from `t` to `s`, in `f_r`; [`NONE`] if that face does not exist.
    pub(crate) right: u32,
    /// Half-edges across the outer edges of the two faces, in `fn0 .. fn3`; [`NONE`] where there is none.
    pub(crate) outer: [u32; 4],
    /// The collapse before this one that kept `s`, which is the next split of `s` in refinement; or [`NONE`].
    pub(crate) next_of_s: u32,
    /// The last collapse that kept `t`, which is the first split of `t`; or [`NONE`].
    pub(crate) first_of_t: u32,
    /// Where `t` was.
    pub(crate) position: [i32; 3],
    /// What the split adds to the position of `s`: where `s` was before the collapse less where it is afterwards.
    pub(crate) s_move: [i32; 3],
    center: [i32; 3],
    radius: u16,
    error: u16,
    axis: [i8; 2],
    half_angle: u8,
    /// Colour of `t`.
    pub(crate) color: [u8; 3],
    /// What the split adds to the colour of `s`, modulo 256.
    pub(crate) s_color_move: [u8; 3],
    padding: [u8; 3],
}

impl CollapseRecord {
    /// Visibility sphere, as stored.
    pub(crate) fn bounds(&self) -> Bounds {
        Bounds {
            center: self.center,
            radius: Magnitude(self.radius),
            error: Magnitude(self.error),
            cone: Cone { axis: self.axis, half_angle: self.half_angle },
        }
    }

    /// The record with this visibility sphere.
    pub(crate) fn with_bounds(self, bounds: Bounds) -> Self {
        let Bounds { center, radius, error, cone } = bounds;
        Self { center, radius: radius.0, error: error.0, axis: cone.axis, half_angle: cone.half_angle, ..self }
    }
}

/// A vertex that is left when nothing can collapse any more.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RootVertex {
    pub(crate) vertex: u32,
    pub(crate) component: u32,
    pub(crate) position: [i32; 3],
    pub(crate) color: [u8; 3],
    /// Last collapse that kept it, or [`NONE`].
    pub(crate) last: u32,
    /// Normals of all that became part of it.
    pub(crate) normals: Normals,
    /// Bounds of its last collapse as stored; meaningless without one.
    pub(crate) stored: Bounds,
}

/// A face that is left.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RootFace {
    pub(crate) face: u32,
    pub(crate) component: u32,
    /// Vertices, in the face's own order.
    pub(crate) corners: [u32; 3],
}

/// A finished simplification of a chunked mesh.
#[derive(Debug)]
pub(crate) struct Simplified {
    /// In the order of simplification: the number of a collapse is its place.
    pub(crate) collapses: Spill<CollapseRecord>,
    /// Under the rule of vertices, by collapse: those whose splits its split waits for besides its parents', or [`NONE`].
    pub(crate) vertex_ops: Option<Vec<[u32; VERTEX_OPS]>>,
    /// By vertex.
    pub(crate) root_vertices: Vec<RootVertex>,
    /// By face.
    pub(crate) root_faces: Vec<RootFace>,
}
