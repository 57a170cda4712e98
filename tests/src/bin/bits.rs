//! Where the bits of a session go: `bits FILE... [--bits N] [--json]`.
//!
//! For a complete load and for each camera path, from cold: bits per op by what they were spent on, as code lengths of what
//! the decoder read. Frames are counted with what surrounds the ops; the WebSocket adds 2, 4 or 10 bytes to a frame by its
//! length (RFC 6455, section 5.2), the handshake is not counted.

use std::path::Path as FilePath;

use lodestream_protocol::op::{OpCounts, Part, decode_batch};
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use lodestream_server::ingest::read::read_mesh_in_memory;
use lodestream_tests::model::TestModel;
use lodestream_tests::traces::{Path, SessionTrace};
use serde_json::json;

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let bits = args.iter().position(|a| a == "--bits").and_then(|i| args.get(i + 1)).map_or(Ok(14), |b| b.parse())?;
    let as_json = args.iter().any(|a| a == "--json");
    if !as_json {
        println!(
            "{:12} {:9} {:>7} {:>6} {:>7} {:>6} | a new split: {:>7} {:>5} {:>8} {:>5} | {:>8} {:>6} | {:>5} {:>6} {:>7} {:>6} | {:>9}",
            "model",
            "path",
            "splits",
            "cached",
            "coll.",
            "frames",
            "address",
            "cut",
            "position",
            "color",
            "collapse",
            "cached",
            "spawn",
            "control",
            "framing",
            "websoc",
            "bits/split"
        );
    }
    for file in args.iter().take_while(|a| !a.starts_with("--")) {
        let (mesh, _) = read_mesh_in_memory(FilePath::new(file))?;
        let case = FilePath::new(file).file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let test = TestModel::new(mesh, Some(bits));
        for path in Path::ALL {
            let limit = if path == Path::Jump { 100_000 } else { UNLIMITED_TRIANGLES };
            report(&case, path, &SessionTrace::record(&test, path, limit), as_json)?;
        }
    }
    Ok(())
}

fn report(case: &str, path: Path, trace: &SessionTrace, as_json: bool) -> anyhow::Result<()> {
    let mut state = trace.start();
    let mut sum = OpCounts::default();
    for batch in &trace.batches {
        let counts = decode_batch(&batch.ops, &mut state, batch.limit)?;
        sum.splits += counts.splits;
        sum.cached_splits += counts.cached_splits;
        sum.collapses += counts.collapses;
        sum.spawns += counts.spawns;
    }
    let breakdown = trace.breakdown()?;
    let batch_bytes: u64 = trace.batches.iter().map(|batch| batch.ops.len() as u64).sum();
    let framing = 8.0 * (trace.frame_bytes - batch_bytes - trace.base_bytes) as f64;
    let websocket = 8.0 * trace.websocket_bytes as f64;
    let total = 8.0 * trace.frame_bytes as f64 + websocket;
    let per = |bits: f64, count: u32| if count == 0 { 0.0 } else { bits / f64::from(count) };
    let new = sum.splits - sum.cached_splits;
    let [address, cut, position, color] =
        [Part::Address, Part::Cut, Part::Position, Part::Color].map(|part| per(breakdown.bits(part), new));
    let collapse = per(breakdown.bits(Part::Collapse), sum.collapses);
    let cached = per(breakdown.bits(Part::Cached), sum.cached_splits);
    let [spawn, control] = [Part::Spawn, Part::Control].map(|part| per(breakdown.bits(part), sum.splits));
    let (framing, websocket) = (per(framing, sum.splits), per(websocket, sum.splits));
    let all = per(total, sum.splits);
    if as_json {
        let per_new_split = json!({"address": address, "cut": cut, "position": position, "color": color});
        let per_split =
            json!({"spawn": spawn, "control": control, "framing": framing, "websocket": websocket, "all": all});
        println!(
            "{}",
            json!({"name": "bits", "case": format!("{case}/{}", path.name()), "unit": "bits", "value": all,
                "splits": sum.splits, "cached_splits": sum.cached_splits, "collapses": sum.collapses,
                "spawns": sum.spawns, "frames": trace.frames, "base_bytes": trace.base_bytes, "per_new_split": per_new_split,
                "per_collapse": collapse, "per_cached_split": cached, "per_split": per_split})
        );
    } else {
        println!(
            "{case:12} {:9} {:7} {:6} {:7} {:6} |              {address:7.3} {cut:5.3} {position:8.3} {color:5.3} | {collapse:8.3} {cached:6.3} | {spawn:5.3} {control:6.3} {framing:7.3} {websocket:6.3} | {all:9.3}",
            path.name(),
            sum.splits,
            sum.cached_splits,
            sum.collapses,
            trace.frames
        );
    }
    Ok(())
}
