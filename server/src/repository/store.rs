//! Files of the repository: names, listing, atomic publication.

use std::fs::{self, File, Metadata, OpenOptions, TryLockError};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::SystemTime;

use super::{ModelId, RepositoryError};

const EXTENSION: &str = ".lodepack";
/// Begins with a dot, so no model's file is named like this.
const TEMPORARY: &str = ".publishing-";
/// Held while temporary files are made or cleaned up.
const LOCK: &str = ".lock";

/// Tells whether a file is the one that was opened before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stamp {
    pub(super) bytes: u64,
    modified: Option<SystemTime>,
    inode: u64,
}

impl Stamp {
    fn of(metadata: &Metadata) -> Self {
        #[cfg(unix)]
        let inode = std::os::unix::fs::MetadataExt::ino(metadata);
        #[cfg(not(unix))]
        let inode = 0;
        Self { bytes: metadata.len(), modified: metadata.modified().ok(), inode }
    }
}

/// A directory of packs.
#[derive(Debug)]
pub(super) struct Store {
    directory: PathBuf,
    next_temporary: AtomicU32,
}

impl Store {
    pub(super) fn new(directory: &Path) -> Self {
        Self { directory: directory.to_owned(), next_temporary: AtomicU32::new(0) }
    }

    pub(super) fn directory(&self) -> &Path {
        &self.directory
    }

    pub(super) fn path(&self, id: &ModelId) -> PathBuf {
        self.directory.join(format!("{id}{EXTENSION}"))
    }

    /// Published models by id.
    pub(super) fn list(&self) -> Result<Vec<(ModelId, PathBuf)>, RepositoryError> {
        let failed = || RepositoryError::io(format!("cannot list the repository {}", self.directory.display()));
        let mut models = Vec::new();
        for entry in fs::read_dir(&self.directory).map_err(failed())? {
            let entry = entry.map_err(failed())?;
            let name = entry.file_name();
            let id = name.to_str().and_then(|name| name.strip_suffix(EXTENSION)).and_then(|id| id.parse().ok());
            models.extend(id.map(|id: ModelId| (id, entry.path())));
        }
        models.sort();
        Ok(models)
    }

    pub(super) fn open(&self, id: &ModelId) -> Result<(File, Stamp), RepositoryError> {
        let file = File::open(self.path(id)).map_err(|e| match e.kind() {
            io::ErrorKind::NotFound => RepositoryError::NotFound(id.to_string()),
            _ => RepositoryError::io(format!("cannot open model {id}"))(e),
        })?;
        let metadata = file.metadata().map_err(RepositoryError::io(format!("cannot read model {id}")))?;
        if !metadata.is_file() {
            return Err(RepositoryError::io(format!("cannot open model {id}"))(io::Error::other("it is not a file")));
        }
        let stamp = Stamp::of(&metadata);
        Ok((file, stamp))
    }

    /// Writes aside, syncs, lets `check` look at the file, renames, syncs the directory.
    pub(super) fn publish<T>(
        &self,
        id: &ModelId,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<T, RepositoryError>,
        check: impl FnOnce(&File) -> Result<(), RepositoryError>,
    ) -> Result<T, RepositoryError> {
        let failed = || RepositoryError::io(format!("cannot publish model {id}"));
        let temporary = self.temporary(id).map_err(failed())?;
        let mut out = BufWriter::with_capacity(1 << 18, temporary.file.try_clone().map_err(failed())?);
        let written = write(&mut out)?;
        out.flush().map_err(failed())?;
        drop(out);
        temporary.file.sync_all().map_err(failed())?;
        check(&temporary.file)?;
        temporary.rename(&self.path(id)).map_err(failed())?;
        // Not every system lets a directory be opened; the rename is then as durable as the system makes it.
        if let Ok(directory) = File::open(&self.directory) {
            directory.sync_all().map_err(failed())?;
        }
        Ok(written)
    }

    /// A new temporary file, locked as long as it is open: that tells living writers from dead ones on any number of processes
    /// and containers. Removes the files of dead ones.
    fn temporary(&self, id: &ModelId) -> io::Result<Temporary> {
        let guard = OpenOptions::new().create(true).truncate(false).write(true).open(self.directory.join(LOCK))?;
        guard.lock()?;
        self.clean_up()?;
        loop {
            let number = self.next_temporary.fetch_add(1, Ordering::Relaxed);
            let path = self.directory.join(format!("{TEMPORARY}{id}-{}-{number}", std::process::id()));
            let file = match OpenOptions::new().create_new(true).read(true).write(true).open(&path) {
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => continue,
                file => file?,
            };
            file.lock()?;
            return Ok(Temporary { path: Some(path), file });
        }
    }

    /// Removes temporary files that nobody holds locked. The caller holds the lock of the directory.
    fn clean_up(&self) -> io::Result<()> {
        for entry in fs::read_dir(&self.directory)? {
            let entry = entry?;
            if !entry.file_name().to_str().is_some_and(|name| name.starts_with(TEMPORARY)) {
                continue;
            }
            // A file that cannot be looked at is left to somebody who can.
            let Ok(file) = OpenOptions::new().write(true).open(entry.path()) else { continue };
            match file.try_lock() {
                Ok(()) => drop(fs::remove_file(entry.path())),
                Err(TryLockError::WouldBlock | TryLockError::Error(_)) => {}
            }
        }
        Ok(())
    }
}

/// A file that vanishes unless it is renamed.
struct Temporary {
    path: Option<PathBuf>,
    file: File,
}

impl Temporary {
    fn rename(mut self, to: &Path) -> io::Result<()> {
        if let Some(path) = &self.path {
            fs::rename(path, to)?;
        }
        self.path = None;
        Ok(())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if let Some(path) = &self.path {
            // If it cannot be removed now, the next publication does it.
            let _ = fs::remove_file(path);
        }
    }
}
