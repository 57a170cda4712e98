//! The half-edge surface under simplification.
//!
//! Faces keep their corner numbering for life: a collapse relabels vertices and joins twins, and neither moves a half-edge.
//! So a half-edge id (`3 * face + corner`, running from that corner to the next) recorded at one moment still means the same
//! place later, which is what the split records are made of. Twins are explicit: two edges between the same pair of
//! vertices, should they ever arise, stay apart.

use glam::DVec3;

use crate::ingest::hierarchy::Point;

/// No half-edge, no vertex, no op.
pub(crate) const NONE: u32 = u32::MAX;

/// Next half-edge around the same face.
#[inline]
pub(crate) fn next(h: u32) -> u32 {
    if h % 3 == 2 { h - 2 } else { h + 1 }
}

/// Previous half-edge around the same face.
#[inline]
pub(crate) fn prev(h: u32) -> u32 {
    if h.is_multiple_of(3) { h + 2 } else { h - 1 }
}

/// An oriented triangle manifold, possibly with boundary, as half-edges.
#[derive(Clone, Debug)]
pub(crate) struct Surface {
    /// Vertex at the start of each half-edge; stale in removed faces.
    origins: Vec<u32>,
    /// Opposite half-edge, or [`NONE`] on the boundary.
    twins: Vec<u32>,
    /// One outgoing half-edge per vertex, at a boundary vertex the one without twin; [`NONE`] for a vertex without faces.
    outs: Vec<u32>,
    /// Faces per vertex.
    valences: Vec<u32>,
}

impl Surface {
    /// Builds the structure and checks what [`SurfaceError`] lists. O(faces + vertices) for any valence.
    #[cfg(test)]
    pub(crate) fn new(vertex_count: usize, faces: &[[u32; 3]]) -> Result<Self, SurfaceError> {
        let surface = Self::of_part(vertex_count, faces)?;
        for v in 0..vertex_count as u32 {
            if surface.spokes(v).count() != surface.valence(v) as usize {
                return Err(SurfaceError::SeveralFans { vertex: v });
            }
        }
        Ok(surface)
    }

    /// Builds the structure of a part of a mesh and checks what [`SurfaceError`] lists but for fans: where some faces of a
    /// vertex are missing, those that are there may be several fans, of which [`Surface::spokes`] then shows one. O(faces +
    /// vertices) for any valence.
    pub(crate) fn of_part(vertex_count: usize, faces: &[[u32; 3]]) -> Result<Self, SurfaceError> {
        check_indices(vertex_count, faces)?;
        let mut valences = vec![0u32; vertex_count];
        for &v in faces.iter().flatten() {
            valences[v as usize] += 1;
        }
        let origins: Vec<u32> = faces.iter().flatten().copied().collect();
        // Half-edges grouped by origin.
        let mut starts = vec![0u32; vertex_count + 1];
        for v in 0..vertex_count {
            starts[v + 1] = starts[v] + valences[v];
        }
        let mut cursor = starts.clone();
        let mut outgoing = vec![0u32; origins.len()];
        for (h, &v) in origins.iter().enumerate() {
            outgoing[cursor[v as usize] as usize] = h as u32;
            cursor[v as usize] += 1;
        }
        // Around each vertex: remember where the outgoing half-edges lead, then look up the incoming ones.
        let mut twins = vec![NONE; origins.len()];
        let mut reached_from = vec![(NONE, NONE); vertex_count];
        for v in 0..vertex_count {
            let star = &outgoing[starts[v] as usize..starts[v + 1] as usize];
            for &h in star {
                let to = origins[next(h) as usize];
                if reached_from[to as usize].0 == v as u32 {
                    return Err(SurfaceError::RepeatedEdge { from: v as u32, to });
                }
                reached_from[to as usize] = (v as u32, h);
            }
            for &h in star {
                let incoming = prev(h);
                let (owner, h) = reached_from[origins[incoming as usize] as usize];
                if owner == v as u32 {
                    twins[incoming as usize] = h;
                    twins[h as usize] = incoming;
                }
            }
        }
        let mut outs = vec![NONE; vertex_count];
        for (h, &v) in origins.iter().enumerate() {
            if outs[v as usize] == NONE || twins[h] == NONE {
                outs[v as usize] = h as u32;
            }
        }
        Ok(Self { origins, twins, outs, valences })
    }

    pub(crate) fn vertex_count(&self) -> usize {
        self.outs.len()
    }

    pub(crate) fn face_count(&self) -> usize {
        self.origins.len() / 3
    }

    #[inline]
    pub(crate) fn origin(&self, h: u32) -> u32 {
        self.origins[h as usize]
    }

    /// Vertex at the end of a half-edge.
    #[inline]
    pub(crate) fn target(&self, h: u32) -> u32 {
        self.origins[next(h) as usize]
    }

    #[inline]
    pub(crate) fn twin(&self, h: u32) -> Option<u32> {
        let twin = self.twins[h as usize];
        (twin != NONE).then_some(twin)
    }

    /// Normal of a face, twice its area long.
    pub(crate) fn face_normal(&self, points: &[Point], face: u32) -> DVec3 {
        let [a, b, c] = self.corners(face).map(|v| points[v as usize].at());
        (b - a).cross(c - a)
    }

    #[inline]
    pub(crate) fn valence(&self, v: u32) -> u32 {
        self.valences[v as usize]
    }

    /// Whether `v` has faces and lies on the boundary.
    #[cfg(test)]
    #[inline]
    pub(crate) fn is_boundary(&self, v: u32) -> bool {
        let out = self.outs[v as usize];
        out != NONE && self.twins[out as usize] == NONE
    }

    /// Corner vertices of a face, in its own order.
    #[inline]
    pub(crate) fn corners(&self, face: u32) -> [u32; 3] {
        let h = 3 * face as usize;
        [self.origins[h], self.origins[h + 1], self.origins[h + 2]]
    }

    /// Outgoing half-edges of `v`, counter-clockwise; one per face. At a boundary vertex the last neighbour, the origin of
    /// the half-edge before the last spoke, has no spoke of its own.
    #[inline]
    pub(crate) fn spokes(&self, v: u32) -> Spokes<'_> {
        let first = self.outs[v as usize];
        Spokes { surface: self, first, at: first }
    }

    /// Outgoing half-edges of the origin of `first` from there on, counter-clockwise, until the boundary or once around.
    #[inline]
    pub(crate) fn spokes_from(&self, first: u32) -> Spokes<'_> {
        Spokes { surface: self, first, at: first }
    }

    /// Calls `visit` for the neighbours of `v`, counter-clockwise, each once.
    #[inline]
    pub(crate) fn for_each_neighbor(&self, v: u32, mut visit: impl FnMut(u32)) {
        self.for_each_edge(v, |_, neighbor| visit(neighbor));
    }

    /// Calls `visit` for the edges at `v`, counter-clockwise, each with the neighbour at its other end. The half-edge is the
    /// one that leaves `v`, but for the last edge of an open fan, which only has the one that enters it.
    #[inline]
    pub(crate) fn for_each_edge(&self, v: u32, mut visit: impl FnMut(u32, u32)) {
        let first = self.outs[v as usize];
        let mut h = first;
        while h != NONE {
            visit(h, self.target(h));
            let incoming = prev(h);
            h = self.twins[incoming as usize];
            if h == NONE {
                visit(incoming, self.origin(incoming));
            } else if h == first {
                return;
            }
        }
    }

    /// First spoke of the arc of `t`: the faces that go over to `s`, counter-clockwise from here to `f_l` or the boundary.
    #[inline]
    pub(crate) fn arc_start(&self, site: Site) -> Option<u32> {
        match site.right {
            Some(right) => self.twin(prev(right)),
            None => {
                let out = self.outs[site.t as usize];
                (Some(out) != site.left.map(next)).then_some(out)
            }
        }
    }

    /// Collapses `site.t` onto `site.s`; the caller has checked that it is legal. `arc` holds the spokes of the arc faces.
    /// Returns the half-edges that lay across the four outer edges of `f_l` and `f_r`, in the order `fn0 .. fn3`.
    pub(crate) fn collapse(&mut self, site: Site, arc: &[u32]) -> [u32; 4] {
        let Site { s, t, left, right } = site;
        let across = |h: Option<u32>| h.map_or(NONE, |h| self.twins[h as usize]);
        let outer = [across(left.map(prev)), across(left.map(next)), across(right.map(prev)), across(right.map(next))];
        let out_s = self.outs[s as usize];
        if right.is_some_and(|h| next(h) == out_s) {
            self.outs[s as usize] = outer[2];
        } else if left == Some(out_s) {
            // Without `f_r` this was the boundary: the fan of `s` now starts where that of `t` did.
            let out_t = self.outs[t as usize];
            let starts_in_arc = right.is_none() && left.map(next) != Some(out_t);
            self.outs[s as usize] = if starts_in_arc { out_t } else { outer[0] };
        }
        for &h in arc {
            self.origins[h as usize] = s;
        }
        let mut sides = 0;
        if let Some(h) = left {
            self.remove_side(self.origin(prev(h)), prev(h), outer[1], outer[0]);
            sides += 1;
        }
        if let Some(h) = right {
            self.remove_side(self.origin(prev(h)), prev(h), outer[3], outer[2]);
            sides += 1;
        }
        self.valences[s as usize] = self.valences[s as usize] + self.valences[t as usize] - 2 * sides;
        self.valences[t as usize] = 0;
        self.outs[t as usize] = NONE;
        outer
    }

    /// Joins the two edges beside a removed face. `apex` is its third vertex, `out` the half-edge that left the apex in it,
    /// `outgoing` the outer half-edge that leaves the apex, `incoming` the other one.
    fn remove_side(&mut self, apex: u32, out: u32, outgoing: u32, incoming: u32) {
        self.valences[apex as usize] -= 1;
        if self.outs[apex as usize] == out {
            self.outs[apex as usize] = outgoing;
        }
        if outgoing != NONE {
            self.twins[outgoing as usize] = incoming;
        }
        if incoming != NONE {
            self.twins[incoming as usize] = outgoing;
        }
    }
}

/// Why faces make no surface: all but the first mean that the mesh was not cleaned.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum SurfaceError {
    /// More than 32-bit half-edge ids can number.
    #[error("{vertices} vertices and {faces} faces are too many for one surface")]
    TooLarge {
        /// Vertices of the mesh.
        vertices: usize,
        /// Faces of the mesh.
        faces: usize,
    },
    /// A corner is no vertex.
    #[error("face {face} refers to vertex {vertex}, which does not exist")]
    NoSuchVertex {
        /// Index of the face.
        face: usize,
        /// The corner.
        vertex: u32,
    },
    /// A face has the same vertex twice.
    #[error("face {face} has a repeated corner")]
    RepeatedCorner {
        /// Index of the face.
        face: usize,
    },
    /// A directed edge belongs to two faces.
    #[error("two faces have an edge from vertex {from} to vertex {to}")]
    RepeatedEdge {
        /// Start of the edge.
        from: u32,
        /// End of the edge.
        to: u32,
    },
    /// The faces at a vertex are not one fan.
    #[cfg(test)]
    #[error("the faces at vertex {vertex} form several fans")]
    SeveralFans {
        /// Index of the vertex.
        vertex: u32,
    },
}

/// Checks counts, corner indices and repeated corners.
pub(crate) fn check_indices(vertex_count: usize, faces: &[[u32; 3]]) -> Result<(), SurfaceError> {
    if faces.len() > (NONE / 3 - 1) as usize || vertex_count > (NONE - 1) as usize {
        return Err(SurfaceError::TooLarge { vertices: vertex_count, faces: faces.len() });
    }
    for (face, corners) in faces.iter().enumerate() {
        if let Some(&vertex) = corners.iter().find(|&&v| v as usize >= vertex_count) {
            return Err(SurfaceError::NoSuchVertex { face, vertex });
        }
        let [a, b, c] = corners;
        if a == b || b == c || c == a {
            return Err(SurfaceError::RepeatedCorner { face });
        }
    }
    Ok(())
}

/// An edge with a direction to collapse it in: `t` onto `s`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Site {
    /// The vertex that stays.
    pub(crate) s: u32,
    /// The vertex that goes.
    pub(crate) t: u32,
    /// Half-edge from `s` to `t`, in `f_l`.
    pub(crate) left: Option<u32>,
    /// Half-edge from `t` to `s`, in `f_r`.
    pub(crate) right: Option<u32>,
}

impl Site {
    /// The site at half-edge `h` that keeps its origin, or its target.
    #[inline]
    pub(crate) fn new(surface: &Surface, h: u32, keep_origin: bool) -> Self {
        let (a, b, twin) = (surface.origin(h), surface.target(h), surface.twin(h));
        if keep_origin {
            Self { s: a, t: b, left: Some(h), right: twin }
        } else {
            Self { s: b, t: a, left: twin, right: Some(h) }
        }
    }

    /// Third corner of `f_l`.
    pub(crate) fn left_apex(&self, surface: &Surface) -> Option<u32> {
        self.left.map(|h| surface.origin(prev(h)))
    }

    /// Third corner of `f_r`.
    pub(crate) fn right_apex(&self, surface: &Surface) -> Option<u32> {
        self.right.map(|h| surface.origin(prev(h)))
    }
}

/// See [`Surface::spokes`].
#[derive(Clone, Debug)]
pub(crate) struct Spokes<'a> {
    surface: &'a Surface,
    first: u32,
    at: u32,
}

impl Iterator for Spokes<'_> {
    type Item = u32;

    #[inline]
    fn next(&mut self) -> Option<u32> {
        let h = self.at;
        if h == NONE {
            return None;
        }
        let following = self.surface.twins[prev(h) as usize];
        self.at = if following == self.first { NONE } else { following };
        Some(h)
    }
}
