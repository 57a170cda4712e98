//! From the state of a simplification in memory to one that is spilled.

use super::*;
use crate::ingest::hierarchy::forest::InCore;
use crate::ingest::hierarchy::{CollapseRecord, RootFace, RootVertex};

/// The same simplification as it would come from chunks, and the components' boxes.
pub(crate) fn spilled(done: &InCore, workspace: &Workspace) -> (Simplified, Vec<Component>) {
    let component_of = |v: u32| done.components.of_vertex[v as usize];
    let mut collapses = workspace.spill();
    for collapse in done.collapses {
        let point = &done.points[collapse.t as usize];
        let record = CollapseRecord {
            s: collapse.s,
            t: collapse.t,
            left: collapse.left,
            right: collapse.right,
            outer: collapse.outer,
            next_of_s: collapse.next_of_s,
            first_of_t: collapse.first_of_t,
            position: point.position,
            color: point.color,
            ..bytemuck::Zeroable::zeroed()
        };
        collapses.push(&[record.with_bounds(collapse.bounds)]).unwrap();
    }
    let mut of_faces: Vec<u32> = done.root_faces.iter().flat_map(|(_, corners)| *corners).collect();
    of_faces.sort_unstable();
    of_faces.dedup();
    let root_vertices = of_faces.into_iter().map(|vertex| {
        let (point, carried) = (&done.points[vertex as usize], &done.carried[vertex as usize]);
        RootVertex {
            vertex,
            component: component_of(vertex),
            position: point.position,
            color: point.color,
            last: carried.last,
            normals: carried.normals,
            stored: carried.stored,
        }
    });
    let root_faces = done.root_faces.iter().map(|&(face, corners)| {
        let component = component_of(corners[0]);
        RootFace { face, component, corners }
    });
    let simplified = Simplified {
        root_vertices: root_vertices.collect(),
        root_faces: root_faces.collect(),
        collapses: collapses.finish().unwrap(),
        vertex_ops: None,
    };
    let component = |&(low, high): &(glam::DVec3, glam::DVec3)| {
        let corner = |c: glam::DVec3| c.to_array().map(|x| x as i32);
        Component { low: corner(low), high: corner(high), height: 0 }
    };
    (simplified, done.components.boxes.iter().map(component).collect())
}
