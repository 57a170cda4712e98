//! Puts the vertices in order along the Morton curve and joins those at exactly the same position, which meet there.
//!
//! The curve runs through the finest lattice of the box, and positions on one of its points follow by their bits. Since
//! this is a total order of positions, sorting by it by digits, most significant first, ends with parts that fit in memory or hold
//! a single position, however the vertices are spread: an outlier far away costs a few passes more, not memory.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use lodestream_protocol::quant::{Lattice, MAX_LATTICE_BITS};

use super::Limits;
use super::runs::{Runs, blocks_in_order, in_order};
use super::scan::{Usage, plain};
use crate::ingest::hierarchy::NONE;
use crate::ingest::raw::RawMesh;
use crate::ingest::spill::{Spill, SpillError, SpillWriter, Workspace};
use crate::mesh::morton::morton;

/// Bits of a digit.
const DIGIT: u32 = 16;
/// Digits of a key: one word for the place on the curve, three for the position.
const DIGITS: u32 = 4 * 64 / DIGIT;

/// Vertices that differ in position, by number.
#[derive(Debug)]
pub(super) struct Sorted {
    pub(super) positions: Spill<[f64; 3]>,
    /// Means of what was joined; `None` for a model without colours.
    pub(super) colors: Option<Spill<[u8; 3]>>,
    /// Number of each vertex of the input; [`NONE`] where it is not used.
    pub(super) numbers: Vec<u32>,
}

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Record {
    position: [f64; 3],
    index: u32,
    color: [u8; 3],
    padding: u8,
}

/// The order of positions.
struct Curve(Lattice);

impl Curve {
    fn code(&self, position: [f64; 3]) -> u64 {
        morton(self.0.quantize(position), self.0.max_coordinate())
    }

    fn digit(&self, position: [f64; 3], level: u32) -> usize {
        let per_word = 64 / DIGIT;
        let word = match level / per_word {
            0 => self.code(position),
            k => position[k as usize - 1].to_bits(),
        };
        (word >> (64 - DIGIT * (level % per_word + 1))) as usize & ((1 << DIGIT) - 1)
    }
}

/// One bucket, whose positions agree in the digits before `level`.
struct Part {
    records: Arc<Runs<Record>>,
    bucket: usize,
    level: u32,
}

/// Some 32 bytes of temporary data and 4 of memory for each vertex.
pub(super) fn sort(raw: &RawMesh, usage: &Usage, limits: Limits, workspace: &Workspace) -> Result<Sorted, SpillError> {
    let (low, high) = usage.extent.corners();
    let curve = Curve(Lattice::of_box(low, high, MAX_LATTICE_BITS));
    let len = raw.positions.len();
    let read = |range: std::ops::Range<u64>| -> Result<Vec<Record>, SpillError> {
        let positions = raw.positions.read(range.clone())?;
        let colors = match &raw.colors {
            Some(colors) => colors.read(range.clone())?,
            None => Vec::new(),
        };
        let record = |k: usize| Record {
            position: plain(positions[k]),
            index: range.start as u32 + k as u32,
            color: colors.get(k).copied().unwrap_or_default(),
            padding: 0,
        };
        Ok((0..positions.len()).filter(|&k| usage.used.get(range.start as u32 + k as u32)).map(record).collect())
    };

    // Buckets of the first digit.
    let split = {
        let mut counts = Counts::new();
        if usage.used_count > limits.vertices {
            blocks_in_order(
                len,
                |range| Ok(read(range)?.iter().map(|r| curve.digit(r.position, 0) as u16).collect::<Vec<_>>()),
                |digits| {
                    digits.iter().for_each(|&digit| counts.0[usize::from(digit)] += 1);
                    Ok(())
                },
            )?;
        }
        counts.split(limits.vertices)
    };
    let records = Runs::build(workspace, len, split.bucket_count, |range, out| {
        let bucket = |r: &Record| if split.bucket_count == 1 { 0 } else { split.bucket(curve.digit(r.position, 0)) };
        out.extend(read(range)?.into_iter().map(|r| (bucket(&r), r)));
        Ok(())
    })?;

    let mut out = Output {
        positions: workspace.spill(),
        colors: raw.colors.is_some().then(|| workspace.spill()),
        numbers: vec![NONE; len as usize],
        next: 0,
    };
    let mut stack = parts_of(records, 0);
    let mut ready: Vec<Part> = Vec::new();
    while let Some(part) = stack.pop() {
        let len = part.records.len(part.bucket);
        if len <= limits.vertices {
            ready.push(part);
            if ready.len() >= 64 {
                out.take_parts(&std::mem::take(&mut ready), &curve)?;
            }
            continue;
        }
        out.take_parts(&std::mem::take(&mut ready), &curve)?;
        let level = part.level + 1;
        if level == DIGITS {
            out.take_one_position(&part)?;
            continue;
        }
        let mut counts = Counts::new();
        part.records.for_each_part(part.bucket, |records| {
            records.iter().for_each(|r| counts.0[curve.digit(r.position, level)] += 1);
            Ok(())
        })?;
        let split = counts.split(limits.vertices);
        let finer = Runs::build(workspace, len, split.bucket_count, |range, out| {
            let records = part.records.read_range(part.bucket, range)?;
            out.extend(records.into_iter().map(|r| (split.bucket(curve.digit(r.position, level)), r)));
            Ok(())
        })?;
        stack.extend(parts_of(finer, level));
    }
    out.take_parts(&ready, &curve)?;
    Ok(Sorted {
        positions: out.positions.finish()?,
        colors: out.colors.map(SpillWriter::finish).transpose()?,
        numbers: out.numbers,
    })
}

/// The parts, the first one last.
fn parts_of(records: Runs<Record>, level: u32) -> Vec<Part> {
    let records = Arc::new(records);
    let part = |bucket| Part { records: Arc::clone(&records), bucket, level };
    (0..records.bucket_count()).rev().map(part).collect()
}

/// How many vertices have each value of a digit.
struct Counts(Vec<u64>);

impl Counts {
    fn new() -> Self {
        Self(vec![0; 1 << DIGIT])
    }

    /// Ranges of the digit with at most `most` vertices each; a single value may have more.
    fn split(&self, most: u64) -> Split {
        let (mut bucket, mut held) = (0, 0);
        let buckets = self.0.iter().map(|&count| {
            if held > 0 && held + count > most {
                bucket += 1;
                held = 0;
            }
            held += count;
            bucket
        });
        let buckets: Vec<u32> = buckets.collect();
        Split { buckets, bucket_count: bucket as usize + 1 }
    }
}

struct Split {
    /// By value of the digit.
    buckets: Vec<u32>,
    bucket_count: usize,
}

impl Split {
    fn bucket(&self, digit: usize) -> u32 {
        self.buckets[digit]
    }
}

struct Output<'w> {
    positions: SpillWriter<'w, [f64; 3]>,
    colors: Option<SpillWriter<'w, [u8; 3]>>,
    numbers: Vec<u32>,
    /// Next number.
    next: u32,
}

/// The positions of one part, in order.
#[derive(Default)]
struct Joined {
    positions: Vec<[f64; 3]>,
    colors: Vec<[u8; 3]>,
    /// Vertex of the input and place in `positions`.
    places: Vec<(u32, u32)>,
}

impl Output<'_> {
    fn take_parts(&mut self, parts: &[Part], curve: &Curve) -> Result<(), SpillError> {
        let with_colors = self.colors.is_some();
        in_order(
            parts.len(),
            |k| Ok(join(&parts[k].records.read(parts[k].bucket)?, curve, with_colors)),
            |_, joined| {
                for &(index, place) in &joined.places {
                    self.numbers[index as usize] = self.next + place;
                }
                self.next += joined.positions.len() as u32;
                self.positions.push(&joined.positions)?;
                self.colors.as_mut().map_or(Ok(()), |colors| colors.push(&joined.colors))
            },
        )
    }

    /// All vertices of the part are at one position.
    fn take_one_position(&mut self, part: &Part) -> Result<(), SpillError> {
        let mut position = [0.0; 3];
        let mut mean = Mean::default();
        part.records.for_each_part(part.bucket, |records| {
            for record in records {
                position = record.position;
                mean.add(record.color);
                self.numbers[record.index as usize] = self.next;
            }
            Ok(())
        })?;
        self.next += 1;
        self.positions.push(&[position])?;
        self.colors.as_mut().map_or(Ok(()), |colors| colors.push(&[mean.color()]))
    }
}

fn join(records: &[Record], curve: &Curve, with_colors: bool) -> Joined {
    let mut order: Vec<(u64, u32)> = (0..).zip(records).map(|(k, r)| (curve.code(r.position), k)).collect();
    order.sort_unstable();
    let record = |k: u32| &records[k as usize];
    let bits = |k: u32| record(k).position.map(f64::to_bits);
    let mut joined = Joined { places: Vec::with_capacity(records.len()), ..Joined::default() };
    for group in order.chunk_by_mut(|a, b| a.0 == b.0) {
        if group.len() > 1 {
            group.sort_unstable_by_key(|&(_, k)| (bits(k), record(k).index));
        }
        for same in group.chunk_by(|a, b| bits(a.1) == bits(b.1)) {
            let place = joined.positions.len() as u32;
            joined.positions.push(record(same[0].1).position);
            joined.places.extend(same.iter().map(|&(_, k)| (record(k).index, place)));
            if with_colors {
                let mut mean = Mean::default();
                same.iter().for_each(|&(_, k)| mean.add(record(k).color));
                joined.colors.push(mean.color());
            }
        }
    }
    joined
}

/// Of colours, channel by channel, rounded half up.
#[derive(Default)]
struct Mean {
    sum: [u64; 3],
    count: u64,
}

impl Mean {
    fn add(&mut self, color: [u8; 3]) {
        (0..3).for_each(|k| self.sum[k] += u64::from(color[k]));
        self.count += 1;
    }

    fn color(&self) -> [u8; 3] {
        self.sum.map(|sum| u8::try_from((sum + self.count / 2) / self.count).expect("a mean of bytes is a byte"))
    }
}
