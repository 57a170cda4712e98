//! The first look at a mesh: which of its vertices count at all, and how far they reach.

use super::bits::Bits;
use super::runs::blocks_in_order;
use crate::ingest::raw::RawMesh;
use crate::ingest::spill::SpillError;

/// A box that grows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Extent {
    pub(super) low: [f64; 3],
    pub(super) high: [f64; 3],
}

impl Extent {
    pub(super) const NOTHING: Self = Self { low: [f64::INFINITY; 3], high: [f64::NEG_INFINITY; 3] };

    #[inline]
    pub(super) fn add(&mut self, p: [f64; 3]) {
        self.join(Self { low: p, high: p });
    }

    #[inline]
    pub(super) fn join(&mut self, other: Self) {
        for k in 0..3 {
            self.low[k] = self.low[k].min(other.low[k]);
            self.high[k] = self.high[k].max(other.high[k]);
        }
    }

    /// Smallest and largest coordinates; zeros without points.
    pub(super) fn corners(&self) -> ([f64; 3], [f64; 3]) {
        if self.low[0] <= self.high[0] { (self.low, self.high) } else { Default::default() }
    }
}

/// What takes part in cleaning.
#[derive(Debug)]
pub(super) struct Usage {
    /// Vertices of the faces that have three finite corners.
    pub(super) used: Bits,
    pub(super) used_count: u64,
    /// Of the used vertices.
    pub(super) extent: Extent,
    /// Faces with a corner that is not finite or does not exist.
    pub(super) unusable_faces: u64,
}

/// The two zeros become one, so that equal positions have equal bits.
#[inline]
pub(super) fn plain(position: [f64; 3]) -> [f64; 3] {
    position.map(|x| x + 0.0)
}

/// Reads positions twice and faces once. Two bits for each vertex.
pub(super) fn usage(raw: &RawMesh) -> Result<Usage, SpillError> {
    let count = raw.positions.len();
    let is_lost = Bits::new(count);
    blocks_in_order(
        count,
        |range| {
            let block = raw.positions.read(range.clone())?;
            for (v, p) in (range.start as u32..).zip(&block) {
                if !p.iter().all(|x| x.is_finite()) {
                    is_lost.set(v);
                }
            }
            Ok(())
        },
        Ok,
    )?;
    let used = Bits::new(count);
    let mut unusable_faces = 0;
    blocks_in_order(
        raw.faces.len(),
        |range| {
            let mut unusable = 0;
            for face in raw.faces.read(range)? {
                if face.iter().all(|&v| u64::from(v) < count && !is_lost.get(v)) {
                    face.iter().for_each(|&v| used.set(v));
                } else {
                    unusable += 1;
                }
            }
            Ok(unusable)
        },
        |unusable: u64| {
            unusable_faces += unusable;
            Ok(())
        },
    )?;
    let mut extent = Extent::NOTHING;
    blocks_in_order(
        count,
        |range| {
            let mut extent = Extent::NOTHING;
            for (v, &p) in (range.start as u32..).zip(&raw.positions.read(range)?) {
                if used.get(v) {
                    extent.add(plain(p));
                }
            }
            Ok(extent)
        },
        |part| {
            extent.join(part);
            Ok(())
        },
    )?;
    let used_count = used.count();
    Ok(Usage { used, used_count, extent, unusable_faces })
}
