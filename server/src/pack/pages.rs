//! A section of pages with its directory: each page is checked at its first use, without a lock.

use std::ops::Range;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use super::layout::{PAGE_SHIFT, Section};
use super::page::{checksum, u64_at};
use super::{PackError, damaged};

/// A page of a pack: what is read and checked as a whole.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum PageId {
    /// The ops `256 n ..`: their bounds and, of splits, all else.
    Ops(u32),
    /// The patches of spawns `256 n ..`.
    Patches(u32),
}

/// Where the pages of one kind are and which of them were checked.
///
/// The directory is not checked at open: an entry that is wrong leads to bytes whose checksum, which is seeded with the
/// page's number, does not fit.
#[derive(Debug)]
pub(super) struct Pages {
    section: Section,
    bytes: Range<usize>,
    directory: usize,
    count: u32,
    checked: Box<[AtomicU64]>,
}

impl Pages {
    /// Pages of 256 `items` each. Allocates a bit per page.
    pub(super) fn new(
        section: Section,
        bytes: Range<usize>,
        directory: Range<usize>,
        directory_section: Section,
        items: u32,
    ) -> Result<Self, PackError> {
        let count = items.div_ceil(1 << PAGE_SHIFT);
        if directory.len() as u64 != 8 * (u64::from(count) + 1) {
            let reason = format!("{} bytes for {count} pages", directory.len());
            return Err(damaged(directory_section, reason));
        }
        let checked = (0..count.div_ceil(64)).map(|_| AtomicU64::new(0)).collect();
        Ok(Self { section, bytes, directory: directory.start, count, checked })
    }

    pub(super) fn count(&self) -> u32 {
        self.count
    }

    #[inline]
    pub(super) fn is_checked(&self, page: u32) -> bool {
        // Acquire is not needed for the bytes, which never change; it orders nothing else.
        self.checked.get((page / 64) as usize).is_some_and(|w| w.load(Ordering::Relaxed) >> (page % 64) & 1 != 0)
    }

    /// How many were checked.
    pub(super) fn checked_count(&self) -> u32 {
        self.checked.iter().map(|word| word.load(Ordering::Relaxed).count_ones()).sum()
    }

    /// Bytes of a page that was used before.
    #[inline]
    pub(super) fn warm<'a>(&self, file: &'a [u8], page: u32) -> Option<&'a [u8]> {
        if self.is_checked(page) { self.slice(file, page) } else { None }
    }

    /// Bytes of a page; `check` runs on them at the first use, once their checksum fits and before anybody sees them.
    /// `first_damage` remembers the first failure.
    #[cold]
    pub(super) fn get<'a>(
        &self,
        file: &'a [u8],
        page: u32,
        first_damage: &OnceLock<PackError>,
        check: impl FnOnce(&'a [u8]) -> Result<(), String>,
    ) -> Result<&'a [u8], PackError> {
        let result = match self.slice(file, page) {
            Some(bytes) if self.is_checked(page) => return Ok(bytes),
            Some(bytes) => self.first_use(bytes, page, check).map(|()| bytes),
            None => Err("the directory leads nowhere".into()),
        };
        result.map_err(|reason| {
            let error = damaged(self.section, format!("page {page}: {reason}"));
            let _ = first_damage.set(error.clone());
            error
        })
    }

    fn first_use<'a>(
        &self,
        bytes: &'a [u8],
        page: u32,
        check: impl FnOnce(&'a [u8]) -> Result<(), String>,
    ) -> Result<(), String> {
        if u64_at(bytes, 0) != Some(checksum(bytes, page)) {
            return Err("the checksum does not fit".into());
        }
        check(bytes)?;
        self.checked[(page / 64) as usize].fetch_or(1 << (page % 64), Ordering::Relaxed);
        Ok(())
    }

    #[inline]
    fn slice<'a>(&self, file: &'a [u8], page: u32) -> Option<&'a [u8]> {
        let entry = self.directory + 8 * page as usize;
        let (begin, end) = (u64_at(file, entry)?, u64_at(file, entry + 8)?);
        let (begin, end) = (usize::try_from(begin).ok()?, usize::try_from(end).ok()?);
        // Page lengths are multiples of 8 and at least one word, so that casts are aligned and checksums have a place.
        if begin % 8 != 0 || end < begin.checked_add(8)? || end > self.bytes.len() {
            return None;
        }
        file.get(self.bytes.start + begin..self.bytes.start + end)
    }

    /// Whether the directory begins at the section's start and ends at its end; each page then begins where the one before
    /// it ends.
    pub(super) fn check_extent(&self, file: &[u8]) -> Result<(), PackError> {
        let first = u64_at(file, self.directory);
        let last = u64_at(file, self.directory + 8 * self.count as usize);
        if first != Some(0) || last != Some(self.bytes.len() as u64) {
            return Err(damaged(self.section, "the directory does not cover the section"));
        }
        Ok(())
    }
}
