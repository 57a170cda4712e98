//! Sequences that are too long for memory: written once from front to back, then read in ranges.
//!
//! A [`Workspace`] has a budget of bytes that its spills may keep in memory together; what does not fit goes to files
//! without a name in its directory, which the operating system removes when the process ends, however it ends. What is read
//! back never depends on where it was kept.

use std::fs::File;
use std::io;
use std::marker::PhantomData;
use std::ops::Range;
use std::path::{Path, PathBuf};
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
    /// Bytes that spills may still keep in memory.
    budget: AtomicU64,
}

impl Workspace {
    /// Spills into nameless files of `directory`, which must exist once the first spill is larger than what is left of
    /// `memory_bytes`.
    pub fn new(directory: &Path, memory_bytes: u64) -> Self {
        Self { directory: directory.to_owned(), budget: AtomicU64::new(memory_bytes) }
    }

    /// Keeps everything in memory.
    pub fn in_memory() -> Self {
        Self::new(Path::new(""), u64::MAX)
    }

    /// Begins a sequence.
    pub(crate) fn spill<T: NoUninit + AnyBitPattern>(&self) -> SpillWriter<'_, T> {
        SpillWriter { workspace: self, memory: Vec::new(), reserved: 0, file: None, written: 0 }
    }

    /// A spill of `items`.
    pub(crate) fn spill_of<T: NoUninit + AnyBitPattern>(&self, items: &[T]) -> Result<Spill<T>, SpillError> {
        let mut writer = self.spill();
        writer.push(items)?;
        writer.finish()
    }

    /// Takes a grain out of the budget if it is there.
    fn reserve(&self) -> bool {
        let grain = GRAIN as u64;
        self.budget.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(grain)).is_ok()
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
    reserved: u64,
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
        self.memory.extend_from_slice(items);
        let bytes = std::mem::size_of_val(self.memory.as_slice()) as u64;
        while self.file.is_none() && bytes > self.reserved {
            if self.workspace.reserve() {
                self.reserved += GRAIN as u64;
            } else {
                let file = tempfile::tempfile_in(&self.workspace.directory).map_err(self.workspace.failed("make"))?;
                self.file = Some(file);
                self.workspace.budget.fetch_add(std::mem::take(&mut self.reserved), Ordering::Relaxed);
                self.flush()?;
                self.memory = Vec::with_capacity(GRAIN / size_of::<T>().max(1) + 1);
            }
        }
        if self.file.is_some() && bytes >= GRAIN as u64 {
            self.flush()?;
        }
        Ok(())
    }

    fn flush(&mut self) -> Result<(), SpillError> {
        if let Some(file) = &self.file {
            let at = self.written * size_of::<T>() as u64;
            write_at(file, bytemuck::cast_slice(&self.memory), at).map_err(self.workspace.failed("write"))?;
            self.written += self.memory.len() as u64;
            self.memory.clear();
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
        Ok(Spill { items, len, directory })
    }
}

/// A finished sequence. Reading takes no lock, so threads may share it.
#[derive(Debug)]
pub(crate) struct Spill<T> {
    items: Items<T>,
    len: u64,
    directory: PathBuf,
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
        match &self.items {
            Items::Memory(items) => out.extend_from_slice(&items[range.start as usize..range.end as usize]),
            Items::File(file, _) => {
                let before = out.len();
                out.resize(before + (range.end - range.start) as usize, T::zeroed());
                let at = range.start * size_of::<T>() as u64;
                read_at(file, bytemuck::cast_slice_mut(&mut out[before..]), at).map_err(|source| SpillError {
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
            items.chunks(777).for_each(|part| writer.push(part).unwrap());
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
    fn a_missing_directory_is_named() {
        let workspace = Workspace::new(Path::new("no/such/directory"), 0);
        let error = workspace.spill_of(&[1u32]).unwrap_err();
        assert_eq!(error.to_string(), "cannot make temporary data in no/such/directory");
    }
}
