//! Writer, reader and `verify` against each other, and against damage.

use super::record::{CutRef, Dag, NO_OP, SplitRecord};
use super::testing::{DagOptions, random_dag};
use super::*;

fn pack(options: &DagOptions) -> (Dag, CompleteMesh, Vec<u8>) {
    let (dag, complete) = random_dag(options);
    let metadata = Metadata { title: "a random one".into(), crease_angle_deg: 30.5, ..Metadata::default() };
    let bytes = write_to_vec(&dag, &complete, &metadata).unwrap();
    (dag, complete, bytes)
}

fn every_kind() -> Vec<DagOptions> {
    let base = DagOptions::default();
    vec![
        DagOptions { splits: 1000, ..base },
        DagOptions { seed: 2, base: "torus", spawns: 0, splits: 300, has_colors: true, ..base },
        DagOptions { seed: 3, base: "annulus", spawns: 300, splits: 900, has_moves: true, ..base },
        DagOptions { seed: 4, base: "empty", spawns: 257, splits: 20, has_colors: true, has_moves: true, ..base },
        DagOptions { seed: 5, splits: 600, has_moves: true, by_vertices: true, ..base },
        DagOptions { seed: 5, base: "tetrahedron", spawns: 2, splits: 3000, bits: 21, ..base },
        DagOptions { seed: 6, base: "two-sided triangle", spawns: 0, splits: 0, ..base },
        DagOptions { seed: 7, base: "empty", spawns: 0, splits: 0, ..base },
    ]
}

#[test]
fn what_is_written_is_read() {
    for options in every_kind() {
        let (dag, complete, bytes) = pack(&options);
        assert_eq!(bytes, pack(&options).2, "same input, same bytes");
        let model = PackedModel::from_vec(bytes).unwrap();
        let info = model.info();
        assert_eq!((info.hash, info.vertices, info.triangles), (complete.hash, complete.vertices, complete.triangles));
        assert_eq!((info.lattice, info.has_colors, info.has_moves), (dag.lattice, dag.has_colors, options.has_moves));
        assert_eq!((info.title.as_str(), info.crease_angle_deg), ("a random one", 30.5));
        assert_eq!(model.base().positions, dag.base.positions);
        assert_eq!(model.base().colors, dag.base.colors);
        assert_eq!(model.base().faces, dag.base.faces);
        assert_eq!(model.base_first_splits(), dag.base.first_splits);
        assert_eq!(model.spawn_count() as usize, dag.spawns.len());
        assert_eq!(model.op_count() as usize, dag.spawns.len() + dag.splits.len());
        compare_spawns(&model, &dag);
        compare_splits(&model, &dag);
        compare_tests(&model, &dag);
        assert_eq!(model.damage(), None);
    }
}

fn compare_spawns(model: &PackedModel, dag: &Dag) {
    let (mut vertex, mut face) = (dag.base.positions.len() as u32, dag.base.faces.len() as u32);
    for (id, spawn) in (0..).zip(&dag.spawns) {
        assert_eq!(model.bounds(id).unwrap(), spawn.bounds);
        let patch = model.spawn_patch(id).unwrap();
        assert_eq!((&patch.positions, &patch.colors), (&spawn.patch.positions, &spawn.patch.colors));
        assert_eq!(patch.faces, spawn.patch.faces);
        assert_eq!(model.spawn_first_splits(id).unwrap(), spawn.patch.first_splits);
        assert_eq!(model.spawn_triangles(id).unwrap() as usize, spawn.patch.faces.len());
        assert_eq!(model.spawn_vertices(id).unwrap() as usize, spawn.patch.positions.len());
        for i in 0..spawn.patch.faces.len() as u32 {
            assert_eq!(model.root_face(face + i).unwrap(), (Some(id), i));
        }
        for i in 0..spawn.patch.positions.len() as u32 {
            assert_eq!(model.root_vertex(vertex + i).unwrap(), (Some(id), i));
        }
        vertex += spawn.patch.positions.len() as u32;
        face += spawn.patch.faces.len() as u32;
    }
    if face > 0 && !dag.base.faces.is_empty() {
        assert_eq!(model.root_face(0).unwrap(), (None, 0));
    }
    assert!(matches!(model.root_face(face), Err(PackError::OutOfRange { .. })));
    assert!(matches!(model.root_vertex(vertex), Err(PackError::OutOfRange { .. })));
    assert!(matches!(model.spawn_patch(model.spawn_count()), Err(PackError::OutOfRange { .. })));
    assert!(matches!(model.bounds(model.op_count()), Err(PackError::OutOfRange { .. })));
    assert!(matches!(model.tests(model.page_count()), Err(PackError::OutOfRange { .. })));
}

fn compare_splits(model: &PackedModel, dag: &Dag) {
    for (op, record) in (model.spawn_count()..).zip(&dag.splits) {
        let fields = model.split(op).unwrap();
        let read = SplitRecord {
            bounds: model.bounds(op).unwrap(),
            tree_parent: fields.tree_parent,
            s: fields.s,
            left: fields.left,
            right: fields.right,
            next_of_s: model.children(op).unwrap()[0],
            first_of_t: model.children(op).unwrap()[1],
            position: fields.position,
            color: fields.color,
            s_move: fields.s_move,
            s_color_move: fields.s_color_move,
            vertex_ops: record.vertex_ops,
        };
        assert_eq!(read, *record, "split {op}");
        let mut expected = vec![record.tree_parent];
        for cut in [record.left, record.right] {
            expected.push(match cut {
                CutRef::None => NO_OP,
                CutRef::Split { op, .. } => op,
                CutRef::Root { face, .. } => model.root_face(face).unwrap().0.unwrap_or(NO_OP),
            });
        }
        let mut seen = Vec::new();
        expected.retain(|&p| {
            let fresh = p != NO_OP && !seen.contains(&p);
            seen.push(p);
            fresh
        });
        let (parents, count) = model.parents(op).unwrap();
        assert_eq!(parents[..count], expected, "split {op}");
        for other in record.vertex_ops {
            if other != NO_OP && !expected.contains(&other) {
                expected.push(other);
            }
        }
        assert_eq!(model.prerequisites(op).unwrap().as_slice(), expected, "split {op}");
    }
}

fn compare_tests(model: &PackedModel, dag: &Dag) {
    let all = dag.spawns.iter().map(|s| s.bounds).chain(dag.splits.iter().map(|s| s.bounds));
    let mut rows = all.enumerate();
    for page in 0..model.page_count() {
        let tests = model.tests(page).unwrap();
        let centers = tests.center.map(|column| {
            let mut values = Vec::new();
            column.decode_into(&mut values);
            values
        });
        for i in 0..tests.radius.len() {
            let (op, bounds) = rows.next().unwrap();
            assert_eq!(op, tests.first_op as usize + i);
            assert_eq!(centers.each_ref().map(|c| c[i]), bounds.center);
            assert_eq!((tests.radius[i], tests.error[i]), (bounds.radius.0, bounds.error.0));
            assert_eq!(
                ([tests.axis[0][i], tests.axis[1][i]], tests.half_angle[i]),
                (bounds.cone.axis, bounds.cone.half_angle)
            );
        }
    }
    assert!(rows.next().is_none());
}

#[test]
fn verify_replays_every_kind() {
    for options in every_kind() {
        let (dag, complete, bytes) = pack(&options);
        let report = verify(Arc::new(bytes.clone())).unwrap();
        assert_eq!((report.splits as usize, report.hash), (dag.splits.len(), complete.hash.0));
        let model = PackedModel::from_vec(bytes).unwrap();
        let mesh = extract_complete(&model).unwrap();
        let quantized: Vec<_> = mesh.positions.iter().map(|&p| dag.lattice.quantize(p)).collect();
        assert_eq!(CompleteMesh::of(&quantized, mesh.colors.as_deref(), &mesh.faces), complete);
        let inspection = inspect(&model).unwrap();
        assert_eq!(inspection.parents_histogram.iter().sum::<u64>(), dag.splits.len() as u64);
        assert!(inspection.to_string().contains("a random one"));
    }
}

#[test]
fn an_inspection_as_json_says_all_there_is_to_say() {
    let (dag, complete) = random_dag(&DagOptions { has_colors: true, spawns: 20, ..DagOptions::default() });
    let cleaned = serde_json::json!({ "welded_vertices": 17 });
    let metadata = Metadata {
        license: "CC0-1.0".into(),
        source: "a field".into(),
        clean_report: cleaned.clone(),
        ..Metadata::default()
    };
    let bytes = write_to_vec(&dag, &complete, &metadata).unwrap();
    let model = PackedModel::from_vec(bytes).unwrap();
    let json = serde_json::to_value(inspect(&model).unwrap()).unwrap();
    let mut errors: Vec<f64> = dag
        .spawns
        .iter()
        .map(|spawn| &spawn.bounds)
        .chain(dag.splits.iter().map(|s| &s.bounds))
        .map(|bounds| f64::from(bounds.error.decode()) * dag.lattice.step)
        .collect();
    let zeros = errors.iter().filter(|&&error| error == 0.0).count();
    errors.retain(|&error| error > 0.0);
    errors.sort_by(f64::total_cmp);
    // Parents by the accessor, depth by going on until nothing changes.
    let mut histogram = [0u64; 4];
    let mut depth: Vec<u32> = vec![1; model.op_count() as usize];
    for op in dag.spawns.len() as u32..model.op_count() {
        histogram[model.parents(op).unwrap().1] += 1;
    }
    loop {
        let before = depth.clone();
        for op in dag.spawns.len() as u32..model.op_count() {
            let (parents, count) = model.parents(op).unwrap();
            let above = parents[..count].iter().map(|&parent| depth[parent as usize]).max();
            depth[op as usize] = 1 + above.unwrap_or(0);
        }
        if depth == before {
            break;
        }
    }
    for (pointer, expected) in [
        ("/triangles", serde_json::json!(complete.triangles)),
        ("/vertices", serde_json::json!(complete.vertices)),
        ("/splits", serde_json::json!(dag.splits.len())),
        ("/spawns", serde_json::json!(20)),
        ("/lattice/bits", serde_json::json!(dag.lattice.bits)),
        ("/lattice/step", serde_json::json!(dag.lattice.step)),
        ("/error_range", serde_json::json!([errors[0], errors[errors.len() - 1]])),
        ("/zero_errors", serde_json::json!(zeros)),
        ("/dag_depth", serde_json::json!(depth.iter().max())),
        ("/parents_histogram", serde_json::json!(histogram)),
        ("/base_triangles", serde_json::json!(dag.base.faces.len())),
        ("/base_vertices", serde_json::json!(dag.base.positions.len())),
        ("/smallest_limit", serde_json::json!(dag.base.faces.len())),
        ("/attributes", serde_json::json!(["position", "color"])),
        ("/metadata/license", serde_json::json!("CC0-1.0")),
        ("/metadata/source", serde_json::json!("a field")),
        ("/metadata/clean_report", cleaned),
    ] {
        assert_eq!(json.pointer(pointer), Some(&expected), "{pointer}");
    }
}

#[test]
fn verify_finds_records_that_fit_the_format_but_not_each_other() {
    let (dag, complete) = random_dag(&DagOptions { splits: 300, ..DagOptions::default() });
    let check = |what: &str, spoil: &dyn Fn(&mut Dag, &mut CompleteMesh)| {
        let (mut dag, mut complete) = (dag.clone(), complete);
        spoil(&mut dag, &mut complete);
        let bytes = write_to_vec(&dag, &complete, &Metadata::default()).expect(what);
        let error = verify(Arc::new(bytes)).expect_err(what);
        assert!(error.section().is_some(), "{what}: {error}");
    };
    let parent = dag.splits.iter().position(|s| s.next_of_s != NO_OP).unwrap();
    let leaf = dag.splits.iter().rposition(|s| s.next_of_s == NO_OP && s.first_of_t == NO_OP).unwrap();
    let spawns = dag.spawns.len() as u32;
    check("hash", &|_, complete| complete.hash.0 ^= 1);
    check("vertices", &|_, complete| complete.vertices += 1);
    check("box", &|_, complete| complete.box_max[1] -= 1);
    check("error of a parent", &|dag, _| dag.splits[parent].bounds.error.0 = 0);
    check("radius of a parent", &|dag, _| dag.splits[parent].bounds.radius.0 = 0);
    check("centre of a parent", &|dag, _| dag.splits[parent].bounds.center[0] += 4000);
    check("lost child", &|dag, _| dag.splits[parent].next_of_s = NO_OP);
    check("second child", &|dag, _| {
        dag.splits[parent].first_of_t = dag.splits[parent].next_of_s;
    });
    check("position", &|dag, _| dag.splits[leaf].position[2] ^= 1);
    check("cut of itself through another", &|dag, _| {
        let child = dag.splits[parent].next_of_s;
        dag.splits[parent].left = CutRef::Split { op: child, side: 0, edge: 1 };
        dag.splits[parent].right = CutRef::None;
        dag.splits[(child - spawns) as usize].left = CutRef::Split { op: parent as u32 + spawns, side: 0, edge: 1 };
    });
    check("cut far away", &|dag, _| dag.splits[leaf].left = CutRef::Root { face: 0, edge: 0 });
    check("base no manifold", &|dag, _| dag.base.faces[0].swap(0, 1));
    check("spawn no manifold", &|dag, _| {
        let first = dag.spawns[0].patch.faces[0];
        dag.spawns[0].patch.faces.push(first);
    });
}

#[test]
fn the_writer_refuses_what_a_reader_would() {
    let (dag, complete) = random_dag(&DagOptions::default());
    let check = |what: &str, spoil: &dyn Fn(&mut Dag)| {
        let mut dag = dag.clone();
        spoil(&mut dag);
        let result = write_to_vec(&dag, &complete, &Metadata::default());
        assert!(matches!(result, Err(WriteError::Invalid(_))), "{what}");
    };
    let spawns = dag.spawns.len() as u32;
    let last = dag.splits.len() - 1;
    check("child before parent", &|dag| dag.splits[last].first_of_t = spawns);
    check("child out of range", &|dag| dag.splits[0].first_of_t = NO_OP - 1);
    check("parent after child", &|dag| (dag.splits[0].tree_parent, dag.splits[0].s) = (spawns + last as u32, 0));
    check("third vertex of a split", &|dag| dag.splits[last].s = 2);
    check("no cut", &|dag| (dag.splits[0].left, dag.splits[0].right) = (CutRef::None, CutRef::None));
    check("fourth edge", &|dag| dag.splits[0].left = CutRef::Root { face: 0, edge: 3 });
    check("third side", &|dag| dag.splits[last].left = CutRef::Split { op: spawns, side: 2, edge: 0 });
    check("own face", &|dag| dag.splits[0].left = CutRef::Split { op: spawns, side: 0, edge: 0 });
    check("face of a spawn as a split's", &|dag| dag.splits[0].left = CutRef::Split { op: 0, side: 0, edge: 0 });
    check("off the lattice", &|dag| dag.splits[0].position[0] = -1);
    check("base off the lattice", &|dag| dag.base.positions[0][2] = 4096);
    check("colour without colours", &|dag| dag.splits[0].color = [1, 0, 0]);
    check("centre far out", &|dag| dag.splits[0].bounds.center[0] = i32::MAX);
    check("short array", &|dag| dag.base.first_splits.truncate(1));
    check("corner out of range", &|dag| dag.base.faces[0][0] = 999);
    check("empty spawn", &|dag| dag.spawns[0].patch = record::Patch::default());
    check("spawns out of order", &|dag| dag.spawns[0].bounds.error.0 -= 1);
}

/// Name of the section that byte `at` belongs to, its padding included, from the section table alone.
fn section_at(bytes: &[u8], at: usize) -> &'static str {
    let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
    let mut name = "header";
    for (i, section) in layout::Section::REQUIRED.iter().enumerate() {
        let entry = 32 + 32 * i;
        if word(entry + 16) > 0 && word(entry + 8) <= at {
            name = section.name();
        }
    }
    name
}

#[test]
fn every_flipped_byte_is_found_and_its_section_named() {
    let options = DagOptions { splits: 60, spawns: 2, has_colors: true, ..DagOptions::default() };
    let (_, _, bytes) = pack(&options);
    verify(Arc::new(bytes.clone())).unwrap();
    for at in 0..bytes.len() {
        for mask in [1, 0x80, 0xff] {
            let mut flipped = bytes.clone();
            flipped[at] ^= mask;
            read_everything(&flipped);
            let error = verify(Arc::new(flipped)).expect_err("a flipped byte");
            assert_eq!(error.section(), Some(section_at(&bytes, at)), "byte {at}: {error}");
        }
    }
}

#[test]
fn every_truncation_is_refused() {
    let (_, _, bytes) = pack(&DagOptions { splits: 60, spawns: 2, ..DagOptions::default() });
    for len in 0..bytes.len() {
        let result = PackedModel::from_vec(bytes[..len].to_vec());
        assert_eq!(result.expect_err("a truncated pack").section(), Some("header"));
    }
    let longer = [&bytes[..], &[0; 8]].concat();
    assert!(PackedModel::from_vec(longer).is_err());
}

/// Every accessor with good and bad numbers: any answer is fine, a panic is not.
fn read_everything(bytes: &[u8]) {
    let Ok(model) = PackedModel::from_vec(bytes.to_vec()) else { return };
    for op in (0..model.op_count().min(2000) + 3).chain([NO_OP]) {
        let _ = (model.bounds(op), model.children(op), model.split(op), model.parents(op));
        let _ = (model.spawn_patch(op), model.spawn_first_splits(op), model.spawn_triangles(op));
        let _ = (model.root_face(op), model.root_vertex(op), model.tests(op));
        let _ = [PageId::Ops(op), PageId::Patches(op)].map(|page| (model.is_ready(page), model.read_page(page)));
    }
}

/// Damage under checksums that fit: what a hostile writer can do.
#[test]
fn resealed_damage_never_panics() {
    let options = DagOptions { splits: 300, spawns: 3, has_colors: true, has_moves: true, ..DagOptions::default() };
    let (_, _, bytes) = pack(&options);
    let mut rng = lodestream_protocol::testing::OperationRng::new(11);
    let mut survived = 0;
    for _ in 0..1500 {
        let mut spoiled = bytes.clone();
        for _ in 0..1 + rng.below(3) {
            let at = 32 + rng.below(bytes.len() as u32 - 32) as usize;
            spoiled[at] = match rng.below(4) {
                0 => 0,
                1 => 0xff,
                2 => spoiled[at].wrapping_add(1),
                _ => rng.below(256) as u8,
            };
        }
        reseal(&mut spoiled);
        read_everything(&spoiled);
        if let Ok(model) = PackedModel::from_vec(spoiled.clone()) {
            let _ = inspect(&model);
        }
        survived += u32::from(verify(Arc::new(spoiled)).is_ok());
    }
    // Bounds, flags and metadata may change without contradiction once their checksums are renewed; but
    // most of a pack is geometry, and that is part of the hash.
    assert!(survived < 750, "{survived}");
}

/// Makes all checksums fit again, as far as offsets still make sense.
fn reseal(bytes: &mut [u8]) {
    let word = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
    let range = |bytes: &[u8], section: usize| {
        let entry = 32 + 32 * section;
        let (begin, len) = (word(bytes, entry + 8), word(bytes, entry + 16));
        begin.checked_add(len).filter(|&end| end <= bytes.len()).map(|end| begin..end)
    };
    for (pages, directory) in [(4, 5), (6, 7)] {
        let (Some(pages), Some(directory)) = (range(bytes, pages), range(bytes, directory)) else { continue };
        for number in 0..(directory.len() / 8).saturating_sub(1) {
            let (from, to) = (word(bytes, directory.start + 8 * number), word(bytes, directory.start + 8 * number + 8));
            if from.saturating_add(8) <= to && to <= pages.len() {
                page::seal(&mut bytes[pages.start + from..pages.start + to], number as u32);
            }
        }
    }
    for section in 0..8 {
        if let Some(range) = range(bytes, section) {
            let checksum = xxhash_rust::xxh3::xxh3_64(&bytes[range]);
            bytes[32 + 32 * section + 24..][..8].copy_from_slice(&checksum.to_le_bytes());
        }
    }
    bytes[24..32].fill(0);
    let checksum = xxhash_rust::xxh3::xxh3_64(&bytes[..32 + 8 * 32]);
    bytes[24..32].copy_from_slice(&checksum.to_le_bytes());
}

#[test]
fn swapped_pages_are_noticed() {
    // Two leaf pages of equal length would fit each other's place but for the seed of their checksums.
    let (_, _, bytes) = pack(&DagOptions { splits: 2000, bits: 21, ..DagOptions::default() });
    let model = PackedModel::from_vec(bytes.clone()).unwrap();
    let place = |section: layout::Section| {
        let (_, entry) = model.sections().iter().find(|(s, _)| *s == Some(section)).unwrap();
        entry.offset as usize
    };
    let directory = place(layout::Section::OpDirectory);
    let offset = |page: usize| u64::from_le_bytes(bytes[directory + 8 * page..][..8].try_into().unwrap()) as usize;
    let pages = place(layout::Section::OpPages);
    let page = |n: usize| &bytes[pages + offset(n)..pages + offset(n + 1)];
    let mut moved = bytes.clone();
    // Page 3's place in the directory leads to page 2.
    moved[directory + 24..directory + 32].copy_from_slice(&bytes[directory + 16..directory + 24]);
    moved[directory + 32..directory + 40].copy_from_slice(&bytes[directory + 24..directory + 32]);
    assert_ne!(page(2), page(3));
    let moved = PackedModel::from_vec(moved).unwrap();
    let error = moved.bounds(3 * PAGE_OPS).unwrap_err();
    assert!(error.to_string().contains("page 3"), "{error}");
    assert_eq!(moved.damage(), Some(&error));
    assert!(moved.bounds(0).is_ok(), "other pages are of use");
}

#[test]
fn unknown_sections_are_skipped_unless_required() {
    let (_, _, bytes) = pack(&DagOptions::default());
    // Insert an entry for an empty section at the end of the table: everything moves by its 32 bytes.
    let with_section = |flags: u32| {
        let mut out = bytes[..32 + 8 * 32].to_vec();
        for entry in out[32..].chunks_exact_mut(32) {
            let offset = u64::from_le_bytes(entry[8..16].try_into().unwrap()) + 32;
            entry[8..16].copy_from_slice(&offset.to_le_bytes());
        }
        let end = bytes.len() as u64 + 32;
        out.extend(99u32.to_le_bytes());
        out.extend(flags.to_le_bytes());
        out.extend(end.to_le_bytes());
        out.extend(5u64.to_le_bytes());
        out.extend(xxhash_rust::xxh3::xxh3_64(b"hello").to_le_bytes());
        out.extend(&bytes[32 + 8 * 32..]);
        out.extend(b"hello\0\0\0");
        out[12] += 1;
        let len = out.len() as u64;
        out[16..24].copy_from_slice(&len.to_le_bytes());
        out[24..32].fill(0);
        let checksum = xxhash_rust::xxh3::xxh3_64(&out[..32 + 9 * 32]);
        out[24..32].copy_from_slice(&checksum.to_le_bytes());
        out
    };
    let optional = with_section(0);
    verify(Arc::new(optional.clone())).unwrap();
    assert_eq!(PackedModel::from_vec(with_section(1)).unwrap_err(), PackError::UnknownSection { kind: 99 });
    let mut spoiled = optional;
    let last = spoiled.len() - 5;
    spoiled[last] ^= 1;
    assert_eq!(verify(Arc::new(spoiled)).unwrap_err().section(), Some("unknown"));
    let mut newer = bytes;
    newer[8] = 2;
    assert_eq!(PackedModel::from_vec(newer).unwrap_err(), PackError::Version { found: 2 });
}

#[test]
fn many_threads_may_use_a_model_first() {
    let (dag, _, bytes) = pack(&DagOptions { splits: 3000, ..DagOptions::default() });
    let model = PackedModel::from_vec(bytes).unwrap();
    assert!(!model.is_ready(PackedModel::page_of(600)));
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| compare_splits(&model, &dag));
        }
    });
    assert!(model.is_ready(PackedModel::page_of(600)));
}

#[test]
fn a_thumbnail_finds_room_where_some_was_left() {
    let (dag, complete) = random_dag(&DagOptions::default());
    let plain = write_to_vec(&dag, &complete, &Metadata::default()).unwrap();
    let bare = PackedModel::from_vec(plain.clone()).unwrap();
    assert_eq!(bare.thumbnail(), Ok(None));
    assert!(thumbnail_edits(&bare, b"png").is_err(), "no room");

    let metadata = Metadata { leaves_room_for_thumbnail: true, ..Metadata::default() };
    let bytes = write_to_vec(&dag, &complete, &metadata).unwrap();
    let model = PackedModel::from_vec(bytes.clone()).unwrap();
    assert_eq!(model.thumbnail(), Ok(None));
    let picture: Vec<u8> = (0..1001u32).map(|i| ((i * i) >> 3) as u8).collect();
    let mut out = std::io::Cursor::new(bytes);
    for (at, bytes) in thumbnail_edits(&model, &picture).unwrap() {
        out.set_position(at);
        std::io::Write::write_all(&mut out, &bytes).unwrap();
    }
    let bytes = out.into_inner();
    assert_eq!(verify(Arc::new(bytes.clone())).unwrap().hash, complete.hash.0);
    let with = PackedModel::from_vec(bytes.clone()).unwrap();
    assert_eq!(with.thumbnail(), Ok(Some(&picture[..])));
    assert_eq!(with.metadata(), bare.metadata());
    assert!(thumbnail_edits(&with, b"png").is_err(), "the room is taken");
    let mut spoiled = bytes;
    let last = spoiled.len() - 10;
    spoiled[last] ^= 1;
    let spoiled = PackedModel::from_vec(spoiled).expect("it is checked when it is asked for");
    assert_eq!(spoiled.thumbnail().unwrap_err().section(), Some("thumbnail"));
    assert_eq!(spoiled.damage(), None, "the model can be streamed all the same");
}
