//! Packs of every published version stay readable, and the same model still gives the same bytes.

use std::path::PathBuf;
use std::sync::Arc;

use lodestream_protocol::quant::Lattice;
use lodestream_server::pack::record::{
    Bounds, Cone, CutRef, Dag, Magnitude, NO_OP, Patch, SpawnRecord, SplitRecord, VERTEX_OPS,
};
use lodestream_server::pack::{CompleteMesh, Metadata, PackedModel, extract_complete, verify, write_to_vec};

/// A tetrahedron, one vertex of which is split twice, and a triangle that spawns and is split at its boundary.
fn tiny() -> (Dag, CompleteMesh, Metadata) {
    let bounds = |center, radius: f64, error: f64, half_angle| Bounds {
        center,
        radius: Magnitude::encode_up(radius),
        error: Magnitude::encode_up(error),
        cone: Cone { axis: [0, 127], half_angle },
    };
    let color = |p: &[i32; 3]| p.map(|c| (c / 16) as u8);
    let patch = |positions: Vec<[i32; 3]>, faces: Vec<[u32; 3]>, first_splits: Vec<u32>| Patch {
        colors: positions.iter().map(color).collect(),
        positions,
        faces,
        first_splits,
    };
    let split = |bounds, tree_parent, s, left, right, next_of_s, position| SplitRecord {
        bounds,
        tree_parent,
        s,
        left,
        right,
        next_of_s,
        first_of_t: NO_OP,
        position,
        color: color(&position),
        s_move: [0; 3],
        s_color_move: [0; 3],
        vertex_ops: [NO_OP; VERTEX_OPS],
    };
    let solid = patch(
        vec![[0, 0, 0], [4095, 0, 0], [0, 4095, 0], [0, 0, 4095]],
        vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
        vec![1, NO_OP, NO_OP, NO_OP],
    );
    let triangle =
        patch(vec![[1000, 1000, 0], [1400, 1000, 0], [1000, 1400, 0]], vec![[0, 1, 2]], vec![2, NO_OP, NO_OP]);
    let face = |face, edge| CutRef::Root { face, edge };
    let of_split = |side, edge| CutRef::Split { op: 1, side, edge };
    let dag = Dag {
        lattice: Lattice { origin: [-1.0, 2.0, 1e6], step: 0.25, bits: 12 },
        has_colors: true,
        is_open: true,
        by_vertices: false,
        base: solid,
        spawns: vec![SpawnRecord { bounds: bounds([1100, 1100, 0], 700.0, 600.0, 255), patch: triangle }],
        splits: vec![
            split(bounds([9, 9, 9], 90.5, 20.25, 60), NO_OP, 0, face(1, 0), face(3, 1), 3, [40, 50, 60]),
            split(bounds([1100, 1100, 3], 300.0, 7.0, 9), 0, 4, face(4, 2), CutRef::None, NO_OP, [1010, 990, 5]),
            split(bounds([11, 9, 9], 12.0, 1.5, 30), 1, 0, of_split(0, 2), of_split(1, 1), NO_OP, [16, 0, 7]),
        ],
    };
    let positions = [
        &dag.base.positions[..],
        &dag.spawns[0].patch.positions,
        &dag.splits.iter().map(|s| s.position).collect::<Vec<_>>(),
    ]
    .concat();
    let colors: Vec<_> = positions.iter().map(color).collect();
    // Vertices 7, 8, 9 are those of the splits: 7 takes the faces of 0 from 3 over 2 to 1, 8 the face of 4, 9 the two faces
    // that were inserted with 7.
    let faces =
        [[7, 2, 1], [0, 1, 3], [1, 2, 3], [2, 7, 3], [9, 7, 1], [7, 9, 3], [0, 9, 1], [9, 0, 3], [8, 5, 6], [4, 8, 6]];
    let metadata = Metadata {
        title: "Tiny".into(),
        license: "CC0-1.0".into(),
        source: "by hand".into(),
        created_by: "golden".into(),
        crease_angle_deg: 44.5,
        build_report: serde_json::json!({ "splits": 3 }),
        ..Metadata::default()
    };
    (dag, CompleteMesh::of(&positions, Some(&colors), &faces), metadata)
}

fn golden(name: &str) -> Vec<u8> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    let text: String = std::fs::read_to_string(path).expect("the golden file is there").split_whitespace().collect();
    (0..text.len() / 2).map(|i| u8::from_str_radix(&text[2 * i..2 * i + 2], 16).expect("hex")).collect()
}

fn hex(bytes: &[u8]) -> String {
    let line = |line: &[u8]| line.iter().map(|b| format!("{b:02x}")).collect::<String>() + "\n";
    bytes.chunks(32).map(line).collect()
}

#[test]
fn version_1_is_written_as_ever() {
    let (dag, complete, metadata) = tiny();
    let bytes = write_to_vec(&dag, &complete, &metadata).unwrap();
    assert_eq!(hex(&bytes), hex(&golden("v1/tiny.pack.hex")), "the layout changed: that takes a new version");
}

#[test]
fn version_1_is_read() {
    let bytes = golden("v1/tiny.pack.hex");
    let (dag, complete, metadata) = tiny();
    assert_eq!(verify(Arc::new(bytes.clone())).unwrap().hash, complete.hash.0);
    let model = PackedModel::from_vec(bytes).unwrap();
    assert_eq!(model.metadata(), &metadata);
    assert_eq!(model.info().lattice, dag.lattice);
    for (op, record) in (1..).zip(&dag.splits) {
        assert_eq!(model.bounds(op).unwrap(), record.bounds);
        assert_eq!(model.split(op).unwrap().position, record.position);
        assert_eq!(model.children(op).unwrap(), [record.next_of_s, record.first_of_t]);
    }
    assert_eq!(model.parents(3).unwrap(), ([1, NO_OP, NO_OP], 1));
    assert_eq!(model.parents(2).unwrap(), ([0, NO_OP, NO_OP], 1));
    let mesh = extract_complete(&model).unwrap();
    assert_eq!((mesh.positions.len(), mesh.faces.len()), (10, 10));
    assert!(mesh.positions.contains(&[9.0, 14.5, 1_000_015.0]));
}
