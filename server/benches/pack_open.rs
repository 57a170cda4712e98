//! What a pack costs: bytes per split, opening, access, replay. One JSON object per line.
//!
//! Runs on a made-up DAG whose ids are in no spatial order, so that columns are as wide as they get; `cargo bench --bench
//! pack_open [SPLITS]`.

use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use lodestream_server::pack::testing::{DagOptions, random_dag};
use lodestream_server::pack::{Metadata, PackedModel, inspect, verify, write_to_vec};

fn report(name: &str, value: f64, unit: &str, case: &str) {
    println!("{}", serde_json::json!({ "name": name, "value": value, "unit": unit, "case": case }));
}

/// Shortest of a few runs, in seconds.
fn seconds(runs: u32, mut run: impl FnMut()) -> f64 {
    let once = |_| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64()
    };
    (0..runs).map(once).fold(f64::INFINITY, f64::min)
}

fn main() {
    let splits = std::env::args().filter_map(|arg| arg.parse().ok()).next().unwrap_or(435_000);
    for (case, options) in [
        ("14_bit", DagOptions { splits, bits: 14, ..DagOptions::default() }),
        ("21_bit_colors", DagOptions { splits, bits: 21, has_colors: true, ..DagOptions::default() }),
    ] {
        let (dag, complete) = random_dag(&options);
        let metadata = Metadata::default();
        let mut bytes = Vec::new();
        let write = seconds(3, || bytes = write_to_vec(&dag, &complete, &metadata).expect("a valid DAG"));
        report("pack/write", dag.splits.len() as f64 / write, "splits/s", case);
        report("pack/bytes", bytes.len() as f64 / dag.splits.len() as f64, "B/split", case);
        let owner: Arc<Vec<u8>> = Arc::new(bytes);
        let open = seconds(20, || drop(black_box(PackedModel::open(owner.clone()))));
        report("pack/open", open * 1e6, "us", case);
        let model = PackedModel::open(owner.clone()).expect("a good pack");
        let first = seconds(1, || (0..model.page_count()).for_each(|page| drop(black_box(model.tests(page)))));
        report("pack/first_use", first * 1e6 / f64::from(model.page_count()), "us/page", case);

        let (spawns, ops) = (model.spawn_count(), model.op_count());
        let count = ops - spawns;
        // A prime stride visits ops in an order without locality.
        let scattered: Vec<u32> =
            (0..count).map(|i| spawns + (u64::from(i) * 100_003 % u64::from(count)) as u32).collect();
        let among = |n: u32| -> Vec<u32> { scattered.iter().map(|&op| spawns + op % n.min(count)).collect() };
        let (near, nearest) = (among(20_000), among(1000));
        for (order, ops) in [("scattered", &scattered), ("20k_ops", &near), ("1k_ops", &nearest)] {
            let case = format!("{case}/{order}");
            let access = |name: &str, read: &dyn Fn(u32) -> u64| {
                let mut sum = 0;
                let time = seconds(3, || sum = ops.iter().map(|&op| read(op)).fold(0, u64::wrapping_add));
                assert_ne!(black_box(sum), 0);
                report(name, time * 1e9 / ops.len() as f64, "ns", &case);
            };
            access("pack/bounds", &|op| model.bounds(op).map_or(0, |b| b.center[0] as u64 + u64::from(b.error.0)));
            access("pack/children", &|op| model.children(op).map_or(0, |c| u64::from(c[0])));
            access("pack/split", &|op| model.split(op).map_or(0, |s| s.position[0] as u64 + 1));
            access("pack/parents", &|op| model.parents(op).map_or(0, |p| p.1 as u64 + 1));
        }
        let mut centers = Vec::new();
        let scan = seconds(3, || {
            for page in 0..model.page_count() {
                let tests = model.tests(page).expect("a good pack");
                centers.clear();
                tests.center.iter().for_each(|column| column.decode_into(&mut centers));
                black_box(&centers);
            }
        });
        report("pack/scan_centers", scan * 1e9 / f64::from(ops), "ns/op", case);
        report("pack/inspect", seconds(2, || drop(black_box(inspect(&model)))), "s", case);
        let mut hash = 0;
        let time = seconds(2, || hash = verify(owner.clone()).expect("a good pack").hash);
        assert_eq!(hash, complete.hash.0);
        report("pack/verify", time, "s", case);
    }
}
