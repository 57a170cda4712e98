//! What crosses the wire, from recorded sessions in which every view settles before the next; and what lies on disk.
//!
//! Frames are counted with their WebSocket headers (RFC 6455, section 5.2), the upgrade (some 330 bytes) is not: `live` counts it.

use anyhow::ensure;
use lodestream_protocol::op::Part;
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use lodestream_server::pack::inspect;
use lodestream_tests::traces::{Path, SessionTrace, Spent};
use serde_json::{Value, json};

use crate::{Report, Subject};

/// Row 1.
pub(crate) fn complete(subject: &Subject, report: &Report) -> anyhow::Result<()> {
    let (trace, spent) = replayed(subject, Path::Complete, UNLIMITED_TRIANGLES)?;
    ensure!(
        u64::from(trace.replay()?.replica().triangle_count()) == subject.test.model.info().triangles,
        "the mesh is not complete"
    );
    let value = per(spent.total_bits, spent.ops.splits);
    report.line("1 bits per split, complete from cold", &subject.name, value, "bit", parts(&spent));
    Ok(())
}

/// Row 2.
pub(crate) fn moving(subject: &Subject, report: &Report) -> anyhow::Result<()> {
    let (trace, _) = replayed(subject, Path::Orbit, UNLIMITED_TRIANGLES)?;
    let spent = trace.spent_moving()?;
    let value = per(spent.total_bits, spent.ops.splits);
    report.line("2 bits per split, orbit", &subject.name, value, "bit", parts(&spent));
    Ok(())
}

/// Row 3: what is split again costs the address, what collapses the address. Each op has its part of what surrounds the ops.
pub(crate) fn again_and_back(subject: &Subject, report: &Report) -> anyhow::Result<()> {
    for (path, limit) in [(Path::Orbit, UNLIMITED_TRIANGLES), (Path::Jump, 100_000)] {
        let (trace, _) = replayed(subject, path, limit)?;
        let spent = trace.spent_moving()?;
        let around = around(&spent);
        let case = format!("{}/{}", subject.name, path.name());
        for (name, part, count) in [
            ("3 bits per cached split, coded", Part::Cached, spent.ops.cached_splits),
            ("3 bits per collapse, coded", Part::Collapse, spent.ops.collapses),
        ] {
            if count > 0 {
                let coded = per(spent.coded.bits(part), count);
                let more = json!({"with_framing": coded + around, "ops": count});
                report.line(name, &case, coded, "bit", more);
            }
        }
    }
    Ok(())
}

/// Row 7.
pub(crate) fn color(subject: &Subject, report: &Report) -> anyhow::Result<()> {
    for path in [Path::Complete, Path::Orbit] {
        let (_, spent) = replayed(subject, path, UNLIMITED_TRIANGLES)?;
        let new = spent.ops.splits - spent.ops.cached_splits;
        let case = format!("{}/{}", subject.name, path.name());
        let value = per(spent.coded.bits(Part::Color), new);
        report.line("7 bits per new split for colour", &case, value, "bit", parts(&spent));
    }
    Ok(())
}

/// Row 8.
pub(crate) fn pack(subject: &Subject, report: &Report) -> anyhow::Result<()> {
    let found = inspect(&subject.test.model)?;
    let value = found.bytes as f64 / f64::from(found.splits.max(1));
    let more = json!({"op_pages": found.bytes_per_split, "splits": found.splits, "spawns": found.spawns, "bytes": found.bytes});
    report.line("8 bytes per split in the pack", &subject.name, value, "B", more);
    Ok(())
}

/// A session and what it spent. Both ends compared digests after every batch when it was recorded, and its bytes decode again
/// to the last of them here.
fn replayed(subject: &Subject, path: Path, limit: u32) -> anyhow::Result<(SessionTrace, Spent)> {
    let trace = SessionTrace::record(&subject.test, path, limit);
    let digest = trace.replay()?.replica().digest() as u16;
    let last = trace.batches.last().map(|batch| batch.digest);
    ensure!(last.is_none_or(|last| last == digest), "the recording decodes to another mesh");
    let spent = trace.spent()?;
    Ok((trace, spent))
}

/// Bits per op that are no op's own.
fn around(spent: &Spent) -> f64 {
    per(spent.coded.bits(Part::Control) + spent.framing_bits + spent.websocket_bits, spent.ops.total())
}

fn parts(spent: &Spent) -> Value {
    let ops = &spent.ops;
    let new = ops.splits - ops.cached_splits;
    let mut parts =
        json!({"splits": ops.splits, "cached": ops.cached_splits, "collapses": ops.collapses, "frames": spent.frames});
    let bits = [
        ("address", per(spent.coded.bits(Part::Address), new)),
        ("cut", per(spent.coded.bits(Part::Cut), new)),
        ("position", per(spent.coded.bits(Part::Position), new)),
        ("color", per(spent.coded.bits(Part::Color), new)),
        ("per_cached_split", per(spent.coded.bits(Part::Cached), ops.cached_splits)),
        ("per_collapse", per(spent.coded.bits(Part::Collapse), ops.collapses)),
        ("collapses_per_split", per(spent.coded.bits(Part::Collapse), ops.splits)),
        ("spawns_per_split", per(spent.coded.bits(Part::Spawn), ops.splits)),
        ("control_per_split", per(spent.coded.bits(Part::Control), ops.splits)),
        ("framing_per_split", per(spent.framing_bits, ops.splits)),
        ("websocket_per_split", per(spent.websocket_bits, ops.splits)),
    ];
    let map = parts.as_object_mut().expect("an object");
    map.extend(bits.into_iter().filter(|(_, bits)| *bits > 0.0).map(|(name, bits)| (name.to_owned(), bits.into())));
    parts
}

fn per(bits: f64, count: u32) -> f64 {
    if count == 0 { 0.0 } else { bits / f64::from(count) }
}
