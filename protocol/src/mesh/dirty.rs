//! Which slots changed since someone last copied the replica elsewhere.

use std::ops::Range;

/// Births that are kept until someone takes them. Who has not looked for so many ops has nothing to animate.
const MAX_BIRTHS: usize = 1 << 18;

/// A vertex that an op has made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Birth {
    /// Where it is.
    pub slot: u32,
    /// The vertex that was split, which was at `slot`'s place on the surface before; `None` for spawned vertices.
    pub parent: Option<u32>,
}

/// Touched slots, recorded in any order and read back as sorted, merged intervals.
#[derive(Clone, Debug, Default)]
pub struct DirtySlots {
    vertices: Vec<u32>,
    faces: Vec<u32>,
    /// In the order of the ops, `None` unless someone asked for them.
    births: Option<Vec<Birth>>,
}

impl DirtySlots {
    #[inline]
    pub(super) fn touch_vertex(&mut self, slot: u32) {
        self.vertices.push(slot);
    }

    #[inline]
    pub(super) fn touch_face(&mut self, slot: u32) {
        self.faces.push(slot);
    }

    #[inline]
    pub(super) fn note_birth(&mut self, slot: u32, parent: Option<u32>) {
        if let Some(births) = &mut self.births {
            if births.len() < MAX_BIRTHS {
                births.push(Birth { slot, parent });
            } else {
                self.births = None;
            }
        }
    }

    /// The births since this was last called, in the order of the ops, and goes on recording. `None` if not all of them are
    /// known: the first time, after a new start of tracking, or when there were too many to keep.
    pub fn take_births(&mut self) -> Option<Vec<Birth>> {
        self.births.replace(Vec::new())
    }

    /// Whether nothing was touched.
    pub fn is_empty(&self) -> bool {
        self.vertices.is_empty() && self.faces.is_empty()
    }

    /// Number of touches recorded (a slot touched twice counts twice): what an upload allowance is checked against.
    pub fn touches(&self) -> usize {
        self.vertices.len() + self.faces.len()
    }

    /// Touched vertex slots as ascending, disjoint intervals; intervals closer than `gap` slots are merged.
    pub fn vertex_ranges(&mut self, gap: u32) -> Vec<Range<u32>> {
        merge(&mut self.vertices, gap)
    }

    /// Touched face slots as ascending, disjoint intervals; intervals closer than `gap` slots are merged.
    pub fn face_ranges(&mut self, gap: u32) -> Vec<Range<u32>> {
        merge(&mut self.faces, gap)
    }

    /// Forgets what was touched (births stay until they are taken) and keeps the memory.
    pub fn clear(&mut self) {
        self.vertices.clear();
        self.faces.clear();
    }
}

fn merge(slots: &mut Vec<u32>, gap: u32) -> Vec<Range<u32>> {
    slots.sort_unstable();
    slots.dedup();
    let mut ranges: Vec<Range<u32>> = Vec::new();
    for &slot in slots.iter() {
        match ranges.last_mut() {
            Some(last) if slot - last.end <= gap => last.end = slot + 1,
            _ => ranges.push(slot..slot + 1),
        }
    }
    ranges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_sorted_and_merged_across_small_gaps() {
        let mut dirty = DirtySlots::default();
        for slot in [9, 3, 4, 4, 20, 7] {
            dirty.touch_vertex(slot);
        }
        assert_eq!(dirty.vertex_ranges(0), [3..5, 7..8, 9..10, 20..21]);
        assert_eq!(dirty.vertex_ranges(2), [3..10, 20..21]);
        dirty.clear();
        assert!(dirty.is_empty());
    }

    #[test]
    fn births_are_kept_in_order_and_not_beyond_a_bound() {
        let mut dirty = DirtySlots::default();
        dirty.note_birth(1, None);
        assert_eq!(dirty.take_births(), None, "nobody had asked before");
        assert_eq!(dirty.take_births(), Some(Vec::new()));
        dirty.note_birth(5, Some(2));
        dirty.clear();
        dirty.note_birth(3, None);
        let births = [Birth { slot: 5, parent: Some(2) }, Birth { slot: 3, parent: None }];
        assert_eq!(dirty.take_births().as_deref(), Some(&births[..]));
        (0..=MAX_BIRTHS as u32).for_each(|slot| dirty.note_birth(slot, None));
        assert_eq!(dirty.take_births(), None);
    }
}
