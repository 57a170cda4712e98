//! Which slots changed since someone last copied the replica elsewhere.

use std::ops::Range;

/// Touched slots, recorded in any order and read back as sorted, merged intervals.
#[derive(Clone, Debug, Default)]
pub struct DirtySlots {
    vertices: Vec<u32>,
    faces: Vec<u32>,
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

    /// Forgets everything and keeps the memory.
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
    use super::DirtySlots;

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
}
