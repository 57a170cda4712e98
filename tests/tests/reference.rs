//! The codec against its plain twin: the same ops and the same bytes.

use std::num::NonZeroU16;

use lodestream_protocol::mesh::Patch;
use lodestream_protocol::op::{
    OpState, canonical_order, decode_base, decode_batch_traced, encode_base, encode_trace, random_batch,
};
use lodestream_protocol::testing::{OperationRng, base_meshes};
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use lodestream_server::ingest::simplify::{BuildOptions, PlacementChoice, Precision};
use lodestream_tests::meshes;
use lodestream_tests::model::TestModel;
use lodestream_tests::reference::{self, Reference};
use lodestream_tests::traces::{Path, SessionTrace};

/// Both decode a batch and apply it; what the twin read is encoded again by both.
fn compare(bytes: &[u8], limit: u32, client: &mut OpState, twin: &mut Reference, what: &str) {
    let before = client.clone();
    let ops = decode_batch_traced(bytes, client, limit).unwrap_or_else(|e| panic!("{what}: {e}"));
    let (read, again) = twin.decode_batch(bytes).unwrap_or_else(|e| panic!("{what}: the twin: {e}"));
    assert_eq!(read, ops, "{what}");
    assert_eq!(again, bytes, "{what}: the twin encodes otherwise");
    let mut server = before;
    let (encoded, _) = encode_trace(&read, &mut server, limit).unwrap_or_else(|e| panic!("{what}: {e}"));
    assert_eq!(encoded, bytes, "{what}: the codec encodes what the twin read otherwise");
    assert_eq!(twin.replica().digest(), client.replica().digest(), "{what}");
}

#[test]
fn random_batches() {
    let patches: Vec<Patch> = base_meshes().into_iter().map(|(_, patch)| patch).collect();
    for (name, base) in base_meshes() {
        for seed in 0..8 {
            let mut rng = OperationRng::new(seed * 77 + 3);
            let capacity = [0, rng.below(20), 500][rng.below(3) as usize];
            let (has_colors, has_moves) = (rng.one_in(2), rng.one_in(2));
            let step = [None, NonZeroU16::new(2), NonZeroU16::new(5)][rng.below(3) as usize];
            let mut server = OpState::new(&base, 12, has_colors, has_moves, capacity).unwrap().with_step(step);
            let mut client = server.clone();
            let mut twin = Reference::new(&base, 12, has_colors, has_moves, capacity).with_step(step);
            let limit = 40 + rng.below(300);
            let mut next_id = 0;
            for batch in 0..25 {
                let (bytes, _) = random_batch(&mut rng, &mut server, &patches, limit, &mut next_id);
                compare(&bytes, limit, &mut client, &mut twin, &format!("{name}, seed {seed}, batch {batch}"));
            }
        }
    }
}

#[test]
fn sessions() {
    let kinds = [
        ("sphere", meshes::icosphere(3), None, Path::Orbit),
        ("grid with holes", meshes::grid_with_holes(2, 6), Some(12), Path::Jump),
        ("components", meshes::many_components(60, 1), Some(12), Path::Jump),
        ("debris", meshes::debris(150, 3), None, Path::Close),
        ("colours", meshes::colored_sphere(4), Some(14), Path::Jump),
        ("painted plane", meshes::painted_plane(24), None, Path::Complete),
        ("noise", meshes::noisy_sphere(3000, 2), None, Path::Close),
    ];
    for (name, mesh, bits, path) in kinds {
        for (placement, precision) in PlacementChoice::ALL
            .into_iter()
            .zip([Precision::Exact, Precision::Visual].into_iter().cycle())
            .chain([(PlacementChoice::Endpoint, Precision::Visual)])
        {
            let options = BuildOptions { bits, placement, precision, ..BuildOptions::default() };
            let test = TestModel::with_options(mesh.clone(), &options);
            let trace = SessionTrace::record(&test, path, UNLIMITED_TRIANGLES);
            let SessionTrace { lattice_bits, has_colors, has_moves, visual_step, cache_entries, .. } = trace;
            let mut client = trace.start();
            let twin = Reference::new(&trace.base, lattice_bits, has_colors, has_moves, cache_entries);
            let mut twin = twin.with_step(visual_step);
            assert!(!trace.batches.is_empty());
            for (i, batch) in trace.batches.iter().enumerate() {
                compare(&batch.ops, batch.limit, &mut client, &mut twin, &format!("{name}, {placement:?}, batch {i}"));
            }
        }
    }
}

#[test]
fn base_meshes_of_every_kind() {
    let mut patches = base_meshes();
    let walked = patches.iter().filter_map(|(name, patch)| Some((*name, canonical_order(patch)?.apply(patch))));
    patches.extend(walked.collect::<Vec<_>>());
    for (name, mesh) in meshes::every_topology() {
        let test = TestModel::new(mesh, Some(12));
        patches.push((name, test.model.base().clone()));
        for spawn in 0..test.model.spawn_count() {
            patches.push((name, test.model.spawn_patch(spawn).unwrap()));
        }
    }
    for (name, patch) in patches {
        for has_colors in [false, true] {
            let bytes = encode_base(&patch, 12, has_colors);
            let decoded = decode_base(&bytes, 12, has_colors).unwrap();
            let (read, again) =
                reference::decode_base(&bytes, 12, has_colors).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(read, decoded, "{name}");
            assert_eq!(again, bytes, "{name}");
        }
    }
}
