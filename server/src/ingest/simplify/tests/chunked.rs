//! Builds by way of chunks: a dull partition in memory, the real simplification, and assembly in memory.

use super::super::{BuildOptions, PlacementChoice, lattice, surface::Surface, tree};
use crate::ingest::chunks::{ChunkedMesh, Component, ComponentTable, VertexTable, height_of, pack, patches, place};
use crate::ingest::hierarchy::{
    Collapse, NONE, Point, Simplified,
    bounds::Carried,
    components::Components,
    forest::{InCore, assemble},
};
use crate::ingest::spill::Workspace;
use crate::mesh::TriMesh;
use crate::mesh::morton::morton;
use crate::pack::CompleteMesh;
use crate::pack::record::Dag;

/// Cuts a clean mesh into chunks of at most `max_faces` faces.
pub(super) fn chunked(mesh: &TriMesh, max_faces: usize, workspace: &Workspace) -> ChunkedMesh {
    let lattice = lattice::choose(mesh, BuildOptions::default().bits);
    let points = lattice::round(mesh, &lattice);
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    let mut is_used = vec![false; points.len()];
    mesh.faces.as_flattened().iter().for_each(|&v| is_used[v as usize] = true);
    order.retain(|&v| is_used[v as usize]);
    order.sort_by_key(|&v| (morton(points[v as usize].position, lattice.max_coordinate()), v));
    let mut numbers = vec![NONE; points.len()];
    for (number, &v) in (0..).zip(&order) {
        numbers[v as usize] = number;
    }
    let mut faces: Vec<[u32; 3]> = mesh.faces.iter().map(|f| f.map(|v| numbers[v as usize])).collect();
    faces.sort_by_key(|f| *f.iter().min().unwrap());
    let points: Vec<Point> = order.iter().map(|&v| points[v as usize]).collect();
    let surface = Surface::new(points.len(), &faces).unwrap();
    let chunk_starts: Vec<u32> = (0..faces.len()).step_by(max_faces).chain([faces.len()]).map(|f| f as u32).collect();
    let chunks = chunk_starts.len() - 1;

    let mut spans = vec![(u32::MAX, 0); points.len()];
    let components = Components::new(&points, &faces);
    let mut component_spans = vec![(u32::MAX, 0); components.count()];
    let mut table = ComponentTable { patch_starts: vec![0], ..ComponentTable::default() };
    let mut numbers = vec![NONE; components.count()];
    for chunk in 0..chunks {
        let part = &faces[chunk_starts[chunk] as usize..chunk_starts[chunk + 1] as usize];
        let vertices: Vec<u32> = crate::ingest::chunks::vertices_of(part);
        let local: Vec<[u32; 3]> = part.iter().map(|f| f.map(|v| vertices.binary_search(&v).unwrap() as u32)).collect();
        let (labels, count) = patches(vertices.len(), &local);
        let first = table.of_patch.len();
        table.of_patch.resize(first + count as usize, NONE);
        for (face, label) in part.iter().zip(labels) {
            let component = components.of_vertex[face[0] as usize] as usize;
            if numbers[component] == NONE {
                numbers[component] = table.components.len() as u32;
                let (low, high) = components.boxes[component];
                let [low, high] = [low, high].map(|p| p.to_array().map(|x| x as i32));
                table.components.push(Component { low, high, height: 0 });
            }
            table.of_patch[first + label as usize] = numbers[component];
            let grow = |span: &mut (u32, u32)| *span = (span.0.min(chunk as u32), span.1.max(chunk as u32));
            grow(&mut component_spans[component]);
            face.iter().for_each(|&v| grow(&mut spans[v as usize]));
        }
        table.patch_starts.push(table.of_patch.len() as u32);
    }
    for (component, &number) in numbers.iter().enumerate() {
        let (first, last) = component_spans[component];
        table.components[number as usize].height = height_of(first, last);
    }
    let places = (0u32..).zip(&spans).map(|(v, &(a, b))| place(height_of(a, b), surface.is_boundary(v))).collect();
    let positions: Vec<[i32; 3]> = points.iter().map(|p| p.position).collect();
    let colors: Vec<[u8; 3]> = points.iter().map(|p| p.color).filter(|_| mesh.colors.is_some()).collect();
    let complete = CompleteMesh::of(&positions, mesh.colors.as_ref().map(|_| colors.as_slice()), &faces);
    ChunkedMesh {
        lattice,
        has_colors: mesh.colors.is_some(),
        is_open: false,
        vertices: VertexTable::new(positions.into_iter().map(pack).collect(), colors, places),
        faces: workspace.spill_of(&faces).unwrap(),
        chunk_starts,
        components: table,
        resampled: None,
        complete,
    }
}

/// A DAG by way of chunks of at most `max_faces` faces.
pub(super) fn build(mesh: &TriMesh, max_faces: usize, threads: u32, placement: PlacementChoice) -> Dag {
    let workspace = Workspace::in_memory();
    let mesh = chunked(mesh, max_faces, &workspace);
    let options = BuildOptions { placement, ..BuildOptions::default() };
    let method = options.method(mesh.lattice.max_coordinate());
    let (simplified, _) = tree::simplify(&mesh, method, &workspace, threads, &|_| {}).unwrap();
    in_core(&mesh, &simplified)
}

fn in_core(mesh: &ChunkedMesh, simplified: &Simplified) -> Dag {
    let faces = mesh.faces.read(0..mesh.faces.len()).unwrap();
    // Where vertices are at the end, or were when they went.
    let mut points: Vec<Point> = (0..mesh.vertices.len() as u32).map(|v| mesh.vertices.point(v)).collect();
    let components = Components::new(&points, &faces);
    let mut removed_by = vec![NONE; faces.len()];
    let mut carried = vec![Carried::new(&[], &[]); points.len()];
    let records = simplified.collapses.read(0..simplified.collapses.len()).unwrap();
    let collapses: Vec<Collapse> = (0u32..)
        .zip(&records)
        .map(|(op, r)| {
            for h in [r.left, r.right].into_iter().filter(|&h| h != NONE) {
                assert_eq!(std::mem::replace(&mut removed_by[h as usize / 3], op), NONE, "a face goes once");
            }
            let gone = &mut points[r.t as usize];
            (gone.position, gone.color) = (r.position, r.color);
            assert!([r.next_of_s, r.first_of_t].into_iter().all(|child| child == NONE || child < op));
            Collapse {
                s: r.s,
                t: r.t,
                left: r.left,
                right: r.right,
                outer: r.outer,
                next_of_s: r.next_of_s,
                first_of_t: r.first_of_t,
                s_move: r.s_move,
                s_color_move: r.s_color_move,
                bounds: r.bounds(),
            }
        })
        .collect();
    for root in &simplified.root_vertices {
        let of_vertex = &mut carried[root.vertex as usize];
        (of_vertex.last, of_vertex.normals, of_vertex.stored) = (root.last, root.normals, root.stored);
        let left = &mut points[root.vertex as usize];
        (left.position, left.color) = (root.position, root.color);
    }
    let root_faces: Vec<(u32, [u32; 3])> = simplified.root_faces.iter().map(|f| (f.face, f.corners)).collect();
    assert_eq!(root_faces.len() + removed_by.iter().filter(|&&op| op != NONE).count(), faces.len());
    let (dag, _) = assemble(&InCore {
        lattice: mesh.lattice,
        has_colors: mesh.has_colors,
        is_open: mesh.is_open,
        points: &points,
        components: &components,
        root_faces: &root_faces,
        collapses: &collapses,
        carried: &carried,
        removed_by: &removed_by,
    });
    dag
}
