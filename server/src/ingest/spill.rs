//! Sequences that are too long for memory: written once from front to back, then read in ranges.
//!
//! A [`Workspace`] has a budget of bytes that its spills may keep in memory together, until they are dropped; what does not fit goes to files
//! without a name in its directory, which the operating system removes when the process ends, however it ends. What is read
//! back never depends on where it was kept.

use std::fs::File;
use std::io;
use std::marker::PhantomData;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::{AnyBitPattern, NoUninit};

/// Bytes by which a spill grows in memory, and that it writes at once.
const GRAIN: usize = 1 << 20;

/// Temporary data could not be written or read.
#[derive(Debug, thiserror::Error)]
#[error("cannot {what} temporary data in {}", directory.display())]
pub struct SpillError {
    what: &'static str,
    directory: PathBuf,
    #[source]
    source: io::Error,
}

/// Where the spills of one ingest live.
#[derive(Debug)]
pub struct Workspace {
    directory: PathBuf,
    budget: Arc<Budget>,
}

/// Bytes that spills may still keep in memory.
#[derive(Debug)]
struct Budget(AtomicU64);

impl Budget {
    /// Takes a grain out if it is there.
    fn reserve(&self) -> bool {
        let grain = GRAIN as u64;
        self.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(grain)).is_ok()
    }
}

/// Bytes out of a budget, which go back when this is dropped.
#[derive(Debug)]
struct Reserved {
    budget: Arc<Budget>,
    bytes: u64,
}

impl Reserved {
    /// Takes another grain if it is there.
    fn grow(&mut self) -> bool {
        let has_grown = self.budget.reserve();
        if has_grown {
            self.bytes += GRAIN as u64;
        }
        has_grown
    }

    fn give_back(&mut self) {
        self.budget.0.fetch_add(std::mem::take(&mut self.bytes), Ordering::Relaxed);
    }
}

impl Drop for Reserved {
    fn drop(&mut self) {
        self.give_back();
    }
}

impl Workspace {
    /// Spills into nameless files of `directory`, which must exist once the first spill is larger than what is left of
    /// `memory_bytes`.
    pub fn new(directory: &Path, memory_bytes: u64) -> Self {
        Self { directory: directory.to_owned(), budget: Arc::new(Budget(AtomicU64::new(memory_bytes))) }
    }

    /// Keeps everything in memory.
    pub fn in_memory() -> Self {
        Self::new(Path::new(""), u64::MAX)
    }

    /// Begins a sequence.
    pub(crate) fn spill<T: NoUninit + AnyBitPattern>(&self) -> SpillWriter<'_, T> {
        let reserved = Reserved { budget: Arc::clone(&self.budget), bytes: 0 };
        SpillWriter { workspace: self, memory: Vec::new(), reserved, file: None, written: 0 }
    }

    /// A spill of `items`.
    pub(crate) fn spill_of<T: NoUninit + AnyBitPattern>(&self, items: &[T]) -> Result<Spill<T>, SpillError> {
        let mut writer = self.spill();
        writer.push(items)?;
        writer.finish()
    }

    fn failed(&self, what: &'static str) -> impl FnOnce(io::Error) -> SpillError {
        let directory = self.directory.clone();
        move |source| SpillError { what, directory, source }
    }
}

/// A sequence being written.
#[derive(Debug)]
pub(crate) struct SpillWriter<'w, T> {
    workspace: &'w Workspace,
    /// All items, or those not yet in the file.
    memory: Vec<T>,
    /// Bytes of the budget that `memory` holds.
    reserved: Reserved,
    file: Option<File>,
    /// Items in the file.
    written: u64,
}

impl<T: NoUninit + AnyBitPattern> SpillWriter<'_, T> {
    /// Items so far.
    pub(crate) fn len(&self) -> u64 {
        self.written + self.memory.len() as u64
    }

    /// Appends items.
    pub(crate) fn push(&mut self, items: &[T]) -> Result<(), SpillError> {
        if self.file.is_some() && size_of_val(items) >= GRAIN {
            self.flush()?;
            return self.write(items);
        }
        self.memory.extend_from_slice(items);
        let bytes = size_of_val(self.memory.as_slice()) as u64;
        while self.file.is_none() && bytes > self.reserved.bytes {
            if !self.reserved.grow() {
                let file = tempfile::tempfile_in(&self.workspace.directory).map_err(self.workspace.failed("make"))?;
                self.file = Some(file);
                self.reserved.give_back();
                self.flush()?;
                self.memory = Vec::with_capacity(GRAIN / size_of::<T>().max(1) + 1);
            }
        }
        if self.file.is_some() && bytes >= GRAIN as u64 {
            self.flush()?;
        }
        Ok(())
    }

    /// Moves what is in memory to the file, if there is one.
    fn flush(&mut self) -> Result<(), SpillError> {
        if self.file.is_some() {
            let items = std::mem::take(&mut self.memory);
            self.write(&items)?;
            self.memory = items;
            self.memory.clear();
        }
        Ok(())
    }

    fn write(&mut self, items: &[T]) -> Result<(), SpillError> {
        if let Some(file) = &self.file {
            let at = self.written * size_of::<T>() as u64;
            write_at(file, bytemuck::cast_slice(items), at).map_err(self.workspace.failed("write"))?;
            self.written += items.len() as u64;
        }
        Ok(())
    }

    /// Ends the sequence.
    pub(crate) fn finish(mut self) -> Result<Spill<T>, SpillError> {
        self.flush()?;
        let len = self.len();
        let directory = self.workspace.directory.clone();
        let items = match self.file {
            Some(file) => Items::File(file, PhantomData),
            None => Items::Memory(self.memory),
        };
        Ok(Spill { items, len, directory, _reserved: self.reserved })
    }
}

/// A finished sequence. Reading takes no lock, so threads may share it.
#[derive(Debug)]
pub(crate) struct Spill<T> {
    items: Items<T>,
    len: u64,
    directory: PathBuf,
    /// What `items` take of the budget.
    _reserved: Reserved,
}

#[derive(Debug)]
enum Items<T> {
    Memory(Vec<T>),
    File(File, PhantomData<T>),
}

impl<T: NoUninit + AnyBitPattern> Spill<T> {
    /// Number of items.
    pub(crate) fn len(&self) -> u64 {
        self.len
    }

    /// Replaces the contents of `out` by the items in `range`.
    ///
    /// # Panics
    /// If the range is not within the sequence.
    pub(crate) fn read_into(&self, range: Range<u64>, out: &mut Vec<T>) -> Result<(), SpillError> {
        out.clear();
        self.append_to(range, out)
    }

    /// Appends the items in `range` to `out`.
    ///
    /// # Panics
    /// If the range is not within the sequence.
    pub(crate) fn append_to(&self, range: Range<u64>, out: &mut Vec<T>) -> Result<(), SpillError> {
        assert!(range.start <= range.end && range.end <= self.len, "{range:?} of {} items", self.len);
        if let Items::Memory(items) = &self.items {
            out.extend_from_slice(&items[range.start as usize..range.end as usize]);
            return Ok(());
        }
        let before = out.len();
        out.resize(before + (range.end - range.start) as usize, T::zeroed());
        self.fill(range.start, &mut out[before..])
    }

    /// Overwrites `out` with the items from `start` on.
    ///
    /// # Panics
    /// If there are not so many.
    pub(crate) fn fill(&self, start: u64, out: &mut [T]) -> Result<(), SpillError> {
        let end = start + out.len() as u64;
        assert!(end <= self.len, "{start}..{end} of {} items", self.len);
        match &self.items {
            Items::Memory(items) => out.copy_from_slice(&items[start as usize..end as usize]),
            Items::File(file, _) => {
                let at = start * size_of::<T>() as u64;
                read_at(file, bytemuck::cast_slice_mut(out), at).map_err(|source| SpillError {
                    what: "read",
                    directory: self.directory.clone(),
                    source,
                })?;
            }
        }
        Ok(())
    }

    /// The items in `range`.
    ///
    /// # Panics
    /// If the range is not within the sequence.
    pub(crate) fn read(&self, range: Range<u64>) -> Result<Vec<T>, SpillError> {
        let mut out = Vec::new();
        self.read_into(range, &mut out)?;
        Ok(out)
    }

    /// Calls `visit` with all items in order, a block at a time, and the index of each block's first item.
    pub(crate) fn for_each_block(&self, mut visit: impl FnMut(u64, &[T])) -> Result<(), SpillError> {
        let step = (GRAIN / size_of::<T>().max(1)).max(1) as u64;
        let mut block = Vec::new();
        let mut at = 0;
        while at < self.len {
            let end = self.len.min(at + step);
            if let Items::Memory(items) = &self.items {
                visit(at, &items[at as usize..end as usize]);
            } else {
                self.read_into(at..end, &mut block)?;
                visit(at, &block);
            }
            at = end;
        }
        Ok(())
    }
}

#[cfg(unix)]
fn write_at(file: &File, bytes: &[u8], at: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::write_all_at(file, bytes, at)
}

#[cfg(unix)]
fn read_at(file: &File, bytes: &mut [u8], at: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, at)
}

#[cfg(windows)]
fn write_at(file: &File, mut bytes: &[u8], mut at: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        let written = std::os::windows::fs::FileExt::seek_write(file, bytes, at)?;
        if written == 0 {
            return Err(io::ErrorKind::WriteZero.into());
        }
        (bytes, at) = (&bytes[written..], at + written as u64);
    }
    Ok(())
}

#[cfg(windows)]
fn read_at(file: &File, mut bytes: &mut [u8], mut at: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        let read = std::os::windows::fs::FileExt::seek_read(file, bytes, at)?;
        if read == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        (bytes, at) = (&mut bytes[read..], at + read as u64);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_read_back_does_not_depend_on_where_it_was_kept() {
        let directory = std::env::temp_dir();
        for memory_bytes in [0, GRAIN as u64, u64::MAX] {
            let workspace = Workspace::new(&directory, memory_bytes);
            let mut writer = workspace.spill::<[u32; 3]>();
            let items: Vec<[u32; 3]> = (0..300_000).map(|i| [i, i ^ 7, !i]).collect();
            let (small, large) = items.split_at(100_000);
            small.chunks(777).chain([large]).for_each(|part| writer.push(part).unwrap());
            assert_eq!(writer.len(), 300_000);
            let spill = writer.finish().unwrap();
            assert_eq!(spill.len(), 300_000);
            assert_eq!(spill.read(250_000..300_000).unwrap(), items[250_000..]);
            let mut pieces = spill.read(7..9).unwrap();
            spill.append_to(100..102, &mut pieces).unwrap();
            assert_eq!(pieces, [items[7], items[8], items[100], items[101]]);
            let mut all = Vec::new();
            spill
                .for_each_block(|at, block| {
                    assert_eq!(at, all.len() as u64);
                    all.extend_from_slice(block);
                })
                .unwrap();
            assert_eq!(all, items);
        }
    }

    #[test]
    fn what_a_spill_keeps_in_memory_is_free_again_once_it_is_dropped() {
        let workspace = Workspace::new(&std::env::temp_dir(), GRAIN as u64);
        let is_in_memory = |spill: &Spill<u8>| matches!(spill.items, Items::Memory(_));
        let first = workspace.spill_of(&[1]).unwrap();
        let second = workspace.spill_of(&[2]).unwrap();
        assert!(is_in_memory(&first) && !is_in_memory(&second));
        drop(second);
        assert!(!is_in_memory(&workspace.spill_of(&[3]).unwrap()), "a file holds nothing of the budget");
        drop(first);
        assert!(is_in_memory(&workspace.spill_of(&[4]).unwrap()));
        drop(workspace.spill::<u8>());
        assert!(is_in_memory(&workspace.spill_of(&[5]).unwrap()));
    }

    #[test]
    fn a_missing_directory_is_named() {
        let workspace = Workspace::new(Path::new("no/such/directory"), 0);
        let error = workspace.spill_of(&[1u32]).unwrap_err();
        assert_eq!(error.to_string(), "cannot make temporary data in no/such/directory");
    }
}
