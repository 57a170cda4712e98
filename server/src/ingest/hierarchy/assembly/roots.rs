//! What no collapse removed: which components are the base and which are spawned, and in what order their vertices and faces
//! are numbered.

use std::cmp::Reverse;
use std::ops::Range;

use glam::DVec3;
use lodestream_protocol::mesh::Patch;
use lodestream_protocol::op::canonical_order;
use rayon::prelude::*;

use super::{Model, invalid};
use crate::ingest::hierarchy::bounds::whole_component;
use crate::ingest::hierarchy::components::base_and_spawns;
use crate::ingest::hierarchy::{NONE, RootFace, RootVertex};
use crate::pack::record::{Bounds, NO_OP};
use crate::pack::{Outline, SpawnEntry, WriteError};

/// Numbers of root vertices and faces, and who brings them.
pub(super) struct Roots {
    /// Components of the base.
    pub(super) base: Vec<u32>,
    /// Components and bounds of the spawns, by error descending, then by diagonal.
    pub(super) spawns: Vec<(u32, Bounds)>,
    faces: Grouped,
    vertices: Grouped,
    /// By root vertex as given, its number; [`NONE`] for one without faces.
    pub(super) vertex_numbers: Vec<u32>,
    /// By root vertex as given, the spawn that brings it, or [`NO_OP`].
    pub(super) vertex_owners: Vec<u32>,
    /// By root face as given, its number.
    pub(super) face_numbers: Vec<u32>,
    /// By root face as given, which of its corners is stored first.
    face_firsts: Vec<u8>,
}

/// Places in a list, by component.
struct Grouped {
    places: Vec<u32>,
    starts: Vec<u32>,
}

impl Grouped {
    /// Keeps the order within each component.
    fn new(count: usize, pairs: impl Iterator<Item = (u32, u32)> + Clone) -> Self {
        let mut starts = vec![0u32; count + 1];
        for (component, _) in pairs.clone() {
            starts[component as usize + 1] += 1;
        }
        for component in 0..count {
            starts[component + 1] += starts[component];
        }
        let mut next = starts.clone();
        let mut places = vec![0; starts[count] as usize];
        for (component, place) in pairs {
            places[next[component as usize] as usize] = place;
            next[component as usize] += 1;
        }
        Self { places, starts }
    }

    fn of(&self, component: u32) -> &[u32] {
        &self.places[self.range(component)]
    }

    /// Puts what a component has in this order, as indices into what [`of`](Self::of) gives.
    fn reorder(&mut self, component: u32, order: impl Iterator<Item = u32>) {
        let range = self.range(component);
        let places: Vec<u32> = order.map(|i| self.places[range.start + i as usize]).collect();
        self.places[range].copy_from_slice(&places);
    }

    fn range(&self, component: u32) -> Range<usize> {
        let [first, end] = [component, component + 1].map(|c| self.starts[c as usize] as usize);
        first..end
    }
}

impl Roots {
    /// O(n log n) in the root vertices, root faces and components.
    pub(super) fn new(model: &Model, vertices: &[RootVertex], faces: &[RootFace]) -> Result<Self, WriteError> {
        let count = model.components.len();
        if vertices.len().max(faces.len()) >= (NONE >> 1) as usize {
            return Err(invalid("too many root elements"));
        }
        if !vertices.is_sorted_by(|a, b| a.vertex < b.vertex) || !faces.is_sorted_by(|a, b| a.face < b.face) {
            return Err(invalid("root elements are out of order"));
        }
        if faces.iter().any(|face| face.component as usize >= count || face.face >= model.faces) {
            return Err(invalid("a root face is out of range"));
        }
        // Vertices are numbered by their first use.
        let mut used = vec![false; vertices.len()];
        let mut by_use: Vec<(u32, u32)> = Vec::with_capacity(vertices.len());
        for face in faces {
            for corner in face.corners {
                let place = place_of(vertices, corner)?;
                if vertices[place as usize].component != face.component {
                    return Err(invalid(format!("root face {} has corners in two components", face.face)));
                }
                if !std::mem::replace(&mut used[place as usize], true) {
                    by_use.push((face.component, place));
                }
            }
        }
        let vertices_of = Grouped::new(count, by_use.iter().copied());
        let faces_of = Grouped::new(count, faces.iter().map(|face| face.component).zip(0..));

        let boxes = model.components.iter().map(|component| {
            let corner = |c: [i32; 3]| DVec3::from_array(c.map(f64::from));
            (corner(component.low), corner(component.high))
        });
        let boxes: Vec<(DVec3, DVec3)> = boxes.collect();
        let diagonals: Vec<f64> = boxes.iter().map(|(low, high)| low.distance(*high)).collect();
        let triangles: Vec<usize> = (0..count as u32).map(|component| faces_of.of(component).len()).collect();
        let (base, spawned) = base_and_spawns(&diagonals, &triangles);
        let mut spawns = Vec::with_capacity(spawned.len());
        for component in spawned {
            let mut normals = Vec::new();
            for &face in faces_of.of(component) {
                let mut corners = [DVec3::ZERO; 3];
                for (at, corner) in corners.iter_mut().zip(faces[face as usize].corners) {
                    let position = vertices[place_of(vertices, corner)? as usize].position;
                    *at = DVec3::from_array(position.map(f64::from));
                }
                let [a, b, c] = corners;
                normals.push((b - a).cross(c - a));
            }
            let carried = vertices_of.of(component).iter().map(|&place| &vertices[place as usize]);
            let carried: Vec<_> = carried
                .map(|v| {
                    let at = DVec3::from_array(v.position.map(f64::from));
                    (at, v.normals, (v.last != NONE).then_some(v.stored))
                })
                .collect();
            spawns.push((component, whole_component(boxes[component as usize], &normals, &carried)));
        }
        spawns.sort_by_key(|&(_, bounds)| Reverse(bounds.error));

        let mut roots = Self {
            base,
            spawns,
            faces: faces_of,
            vertices: vertices_of,
            vertex_numbers: vec![NONE; vertices.len()],
            vertex_owners: vec![NO_OP; vertices.len()],
            face_numbers: vec![NONE; faces.len()],
            face_firsts: vec![0; faces.len()],
        };
        roots.put_in_order(vertices, faces)?;
        roots.number();
        Ok(roots)
    }

    /// Puts the vertices and faces of each component in the order in which a patch is coded best.
    fn put_in_order(&mut self, vertices: &[RootVertex], faces: &[RootFace]) -> Result<(), WriteError> {
        let mut index_of = vec![NONE; vertices.len()];
        let components = self.vertices.starts.len() as u32 - 1;
        for component in 0..components {
            for (index, &place) in (0..).zip(self.vertices.of(component)) {
                index_of[place as usize] = index;
            }
        }
        let order = |component: u32| -> Result<_, WriteError> {
            let mut patch = Patch::default();
            for &place in self.vertices.of(component) {
                patch.positions.push(vertices[place as usize].position);
                patch.colors.push(vertices[place as usize].color);
            }
            for &place in self.faces.of(component) {
                let mut corners = faces[place as usize].corners;
                for corner in &mut corners {
                    *corner = index_of[place_of(vertices, *corner)? as usize];
                }
                patch.faces.push(corners);
            }
            Ok(canonical_order(&patch))
        };
        let orders: Vec<_> = (0..components).into_par_iter().map(order).collect::<Result<_, _>>()?;
        for (component, order) in (0..).zip(orders) {
            // A component that cannot be walked is sent as it is.
            let Some(order) = order else { continue };
            self.vertices.reorder(component, order.vertices.into_iter());
            self.faces.reorder(component, order.faces.iter().map(|&(face, _)| face));
            for (&place, &(_, first)) in self.faces.of(component).iter().zip(&order.faces) {
                self.face_firsts[place as usize] = first;
            }
        }
        Ok(())
    }

    /// By number of a root face, which of its corners is stored first.
    pub(super) fn firsts_by_number(&self) -> Vec<u8> {
        let mut firsts = vec![0; self.face_numbers.len()];
        for (&number, &first) in self.face_numbers.iter().zip(&self.face_firsts) {
            firsts[number as usize] = first;
        }
        firsts
    }

    fn number(&mut self) {
        let (mut vertex, mut face) = (0, 0);
        let spawned = self.spawns.iter().map(|&(component, _)| component);
        for (owner, component) in self.base.iter().map(|&c| (NO_OP, c)).chain((0..).zip(spawned)) {
            for &place in self.vertices.of(component) {
                self.vertex_numbers[place as usize] = vertex;
                self.vertex_owners[place as usize] = owner;
                vertex += 1;
            }
            for &place in self.faces.of(component) {
                self.face_numbers[place as usize] = face;
                face += 1;
            }
        }
    }

    /// All of the pack but its splits; whether there are moves is not known yet. `ids` are the final ids of the collapses.
    pub(super) fn outline(
        &self,
        model: &Model,
        splits: u32,
        vertices: &[RootVertex],
        faces: &[RootFace],
        ids: &[u32],
    ) -> Result<Outline, WriteError> {
        let mut outline = Outline {
            lattice: model.lattice,
            has_colors: model.has_colors,
            has_moves: false,
            is_open: model.is_open,
            by_vertices: false,
            splits,
            positions: Vec::with_capacity(vertices.len()),
            colors: Vec::with_capacity(vertices.len()),
            first_splits: Vec::with_capacity(vertices.len()),
            faces: Vec::with_capacity(faces.len()),
            spawns: self.spawns.iter().map(|&(_, bounds)| bounds).collect(),
            starts: Vec::with_capacity(self.spawns.len() + 1),
        };
        let spawned = self.spawns.iter().map(|(component, _)| std::slice::from_ref(component));
        for components in std::iter::once(&self.base[..]).chain(spawned) {
            let first = outline.positions.len() as u32;
            for &component in components {
                for &place in self.vertices.of(component) {
                    let RootVertex { position, color, last, .. } = vertices[place as usize];
                    outline.positions.push(position);
                    outline.colors.push(color);
                    let id = if last == NONE { Some(&NO_OP) } else { ids.get(last as usize) };
                    outline.first_splits.push(*id.ok_or_else(|| invalid("a root vertex names no collapse"))?);
                }
                for &place in self.faces.of(component) {
                    let mut corners = faces[place as usize].corners;
                    for corner in &mut corners {
                        let number = self.vertex_numbers[place_of(vertices, *corner)? as usize];
                        *corner = number - first;
                    }
                    corners.rotate_left(self.face_firsts[place as usize].into());
                    outline.faces.push(corners);
                }
            }
            let end = SpawnEntry { vertex: outline.positions.len() as u32, face: outline.faces.len() as u32 };
            outline.starts.push(end);
        }
        Ok(outline)
    }
}

/// Where a vertex stands among the root vertices.
fn place_of(vertices: &[RootVertex], vertex: u32) -> Result<u32, WriteError> {
    let found = vertices.binary_search_by_key(&vertex, |v| v.vertex);
    found.map(|place| place as u32).map_err(|_| invalid(format!("vertex {vertex} of a root face is no root vertex")))
}
