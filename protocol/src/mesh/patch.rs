//! A small complete mesh: the base, or what a spawn inserts.

use crate::limits::MAX_PATCH_ELEMENTS;

/// Vertices and faces that appear together.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Patch {
    /// Lattice positions.
    pub positions: Vec<[i32; 3]>,
    /// Colours, `len == positions.len()`; zeros for models without colours.
    pub colors: Vec<[u8; 3]>,
    /// Corner indices into `positions`, counter-clockwise.
    pub faces: Vec<[u32; 3]>,
}

/// Why a patch is no oriented manifold with one fan per vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PatchError {
    /// More elements than [`MAX_PATCH_ELEMENTS`].
    #[error("{0} vertices or faces are more than a patch may have")]
    TooLarge(usize),
    /// Positions and colours differ in number.
    #[error("{colors} colours for {positions} vertices")]
    ColorCount {
        /// Number of positions.
        positions: usize,
        /// Number of colours.
        colors: usize,
    },
    /// A corner names no vertex, or a face names one twice.
    #[error("face {0} has a corner out of range or repeated")]
    BadFace(usize),
    /// Two faces run along the same edge in the same direction.
    #[error("edge from vertex {0} to {1} belongs to two faces in one direction")]
    NonManifoldEdge(u32, u32),
    /// The faces around a vertex form several fans, or none.
    #[error("the faces around vertex {0} do not form one fan")]
    NotOneFan(u32),
}

/// Half-edge `face * 4 + k`, from corner `k` to corner `k + 1`, or `NO_HALF_EDGE`.
pub(crate) type HalfEdge = u32;
pub(crate) const NO_HALF_EDGE: HalfEdge = u32::MAX;

impl Patch {
    /// Checks the patch and returns [`twins_of`] its faces. O(F log F).
    ///
    /// # Errors
    /// Names the first thing that is wrong.
    pub fn validate(&self) -> Result<Vec<[u32; 3]>, PatchError> {
        let limit = MAX_PATCH_ELEMENTS as usize;
        if self.positions.len() > limit || self.faces.len() > limit {
            return Err(PatchError::TooLarge(self.positions.len().max(self.faces.len())));
        }
        if self.positions.len() != self.colors.len() {
            return Err(PatchError::ColorCount { positions: self.positions.len(), colors: self.colors.len() });
        }
        twins_of(self.positions.len() as u32, &self.faces)
    }
}

/// For each face and corner `k` the half-edge opposite to edge `k -> k + 1`, as `face * 4 + corner`, or `u32::MAX` at a
/// boundary. Fails unless the faces form an oriented manifold in which each vertex has exactly one fan. O(F log F).
///
/// # Errors
/// Names the face, edge or vertex at fault.
pub fn twins_of(vertices: u32, faces: &[[u32; 3]]) -> Result<Vec<[u32; 3]>, PatchError> {
    let mut edges: Vec<(u32, u32, HalfEdge)> = Vec::with_capacity(faces.len() * 3);
    for (f, face) in faces.iter().enumerate() {
        let [a, b, c] = *face;
        if a >= vertices || b >= vertices || c >= vertices || a == b || b == c || c == a {
            return Err(PatchError::BadFace(f));
        }
        for k in 0..3 {
            edges.push((face[k], face[(k + 1) % 3], f as u32 * 4 + k as u32));
        }
    }
    edges.sort_unstable();
    if let Some(w) = edges.windows(2).find(|w| (w[0].0, w[0].1) == (w[1].0, w[1].1)) {
        return Err(PatchError::NonManifoldEdge(w[0].0, w[0].1));
    }
    let mut twins = vec![[NO_HALF_EDGE; 3]; faces.len()];
    for &(a, b, h) in &edges {
        if let Ok(i) = edges.binary_search_by_key(&(b, a), |e| (e.0, e.1)) {
            twins[(h / 4) as usize][(h % 4) as usize] = edges[i].2;
        }
    }
    check_fans(vertices, faces, &twins, &edges)?;
    Ok(twins)
}

/// Walks each vertex's fan from its boundary start (or anywhere) and compares its length with the number of faces.
fn check_fans(
    vertices: u32,
    faces: &[[u32; 3]],
    twins: &[[u32; 3]],
    outgoing: &[(u32, u32, HalfEdge)],
) -> Result<(), PatchError> {
    let mut at = 0;
    for v in 0..vertices {
        let begin = at;
        while at < outgoing.len() && outgoing[at].0 == v {
            at += 1;
        }
        let degree = at - begin;
        // A fan has at most one outgoing half-edge without a twin: its start.
        let is_start = |e: &&(u32, u32, HalfEdge)| twins[(e.2 / 4) as usize][(e.2 % 4) as usize] == NO_HALF_EDGE;
        let Some(start) = outgoing[begin..at].iter().find(is_start).or(outgoing[begin..at].first()) else {
            return Err(PatchError::NotOneFan(v));
        };
        let mut h = start.2;
        let mut walked = 0;
        loop {
            walked += 1;
            let (f, k) = ((h / 4) as usize, (h % 4) as usize);
            debug_assert_eq!(faces[f][k], v);
            h = twins[f][(k + 2) % 3];
            if h == NO_HALF_EDGE || h == start.2 || walked > degree {
                break;
            }
        }
        if walked != degree {
            return Err(PatchError::NotOneFan(v));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(vertices: u32, faces: &[[u32; 3]], expected: Result<(), PatchError>) {
        assert_eq!(twins_of(vertices, faces).map(|_| ()), expected);
    }

    #[test]
    fn accepts_manifolds_and_names_what_is_wrong() {
        check(0, &[], Ok(()));
        check(3, &[[0, 1, 2]], Ok(()));
        check(4, &[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], Ok(()));
        check(3, &[[0, 1, 2], [0, 2, 1]], Ok(()));
        check(3, &[[0, 1, 3]], Err(PatchError::BadFace(0)));
        check(3, &[[0, 1, 1]], Err(PatchError::BadFace(0)));
        check(4, &[[0, 1, 2], [0, 1, 3]], Err(PatchError::NonManifoldEdge(0, 1)));
        // Bow-tie: two triangles that share only vertex 0.
        check(5, &[[0, 1, 2], [0, 3, 4]], Err(PatchError::NotOneFan(0)));
        check(4, &[[0, 1, 2]], Err(PatchError::NotOneFan(3)));
    }

    #[test]
    fn twins_point_at_each_other() {
        let faces = [[0, 1, 2], [2, 1, 3]];
        let twins = twins_of(4, &faces).unwrap();
        // Edge 1 -> 2 of face 0 is edge 2 -> 1 of face 1.
        assert_eq!(twins[0], [NO_HALF_EDGE, 4, NO_HALF_EDGE]);
        assert_eq!(twins[1], [1, NO_HALF_EDGE, NO_HALF_EDGE]);
    }
}
