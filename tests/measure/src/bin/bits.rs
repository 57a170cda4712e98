//! Where the bits of a session go: `bits FILE... [--bits N] [--precision visual] [--json]`.
//!
//! For a complete load and for each camera path, from cold: bits per op by what they were spent on, as code lengths of what
//! the decoder read. Frames are counted with what surrounds the ops; the WebSocket adds 2, 4 or 10 bytes to a frame by its
//! length (RFC 6455, section 5.2), the handshake is not counted.

use std::path::Path as FilePath;

use lodestream_protocol::op::Part;
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use lodestream_server::ingest::Precision;
use lodestream_server::ingest::read::read_mesh_in_memory;
use lodestream_server::ingest::simplify::BuildOptions;
use lodestream_tests::model::TestModel;
use lodestream_tests::traces::{Path, SessionTrace};
use serde_json::json;

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let bits = args.iter().position(|a| a == "--bits").and_then(|i| args.get(i + 1)).map_or(Ok(14), |b| b.parse())?;
    let is_visual = args.windows(2).any(|pair| pair == ["--precision", "visual"]);
    let precision = if is_visual { Precision::Visual } else { Precision::Exact };
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
        let options = BuildOptions { bits: Some(bits), precision, ..BuildOptions::default() };
        let test = TestModel::with_options(mesh, &options);
        for path in Path::ALL {
            let limit = if path == Path::Jump { 100_000 } else { UNLIMITED_TRIANGLES };
            report(&case, path, &SessionTrace::record(&test, path, limit), as_json)?;
        }
    }
    Ok(())
}

fn report(case: &str, path: Path, trace: &SessionTrace, as_json: bool) -> anyhow::Result<()> {
    let spent = trace.spent()?;
    let (sum, breakdown) = (spent.ops, &spent.coded);
    let per = |bits: f64, count: u32| if count == 0 { 0.0 } else { bits / f64::from(count) };
    let new = sum.splits - sum.cached_splits;
    let [address, cut, position, color] =
        [Part::Address, Part::Cut, Part::Position, Part::Color].map(|part| per(breakdown.bits(part), new));
    let collapse = per(breakdown.bits(Part::Collapse), sum.collapses);
    let cached = per(breakdown.bits(Part::Cached), sum.cached_splits);
    let [spawn, control] = [Part::Spawn, Part::Control].map(|part| per(breakdown.bits(part), sum.splits));
    let (framing, websocket) = (per(spent.framing_bits, sum.splits), per(spent.websocket_bits, sum.splits));
    let all = per(spent.total_bits, sum.splits);
    if as_json {
        let per_new_split = json!({"address": address, "cut": cut, "position": position, "color": color});
        let per_split =
            json!({"spawn": spawn, "control": control, "framing": framing, "websocket": websocket, "all": all});
        println!(
            "{}",
            json!({"name": "bits", "case": format!("{case}/{}", path.name()), "unit": "bits", "value": all,
                "splits": sum.splits, "cached_splits": sum.cached_splits, "collapses": sum.collapses,
                "spawns": sum.spawns, "frames": spent.frames, "base_bytes": trace.base_bytes, "per_new_split": per_new_split,
                "per_collapse": collapse, "per_cached_split": cached, "per_split": per_split})
        );
    } else {
        println!(
            "{case:12} {:9} {:7} {:6} {:7} {:6} |              {address:7.3} {cut:5.3} {position:8.3} {color:5.3} | {collapse:8.3} {cached:6.3} | {spawn:5.3} {control:6.3} {framing:7.3} {websocket:6.3} | {all:9.3}",
            path.name(),
            sum.splits,
            sum.cached_splits,
            sum.collapses,
            spent.frames
        );
    }
    Ok(())
}
