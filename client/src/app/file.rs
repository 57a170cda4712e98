//! Files that are complete or absent.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

/// Why a file was not written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write '{}'", path.display())]
pub struct FileError {
    /// The file asked for.
    pub path: PathBuf,
    /// What the system says.
    #[source]
    pub source: io::Error,
}

/// Writes a file under another name beside its own and renames it when it is complete. What is no regular file (a pipe,
/// `/dev/stdout`) is written in place.
///
/// # Errors
/// [`FileError`]; the file is then as it was before, and nothing is left beside it.
pub fn write_aside(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<(), FileError> {
    let is_special = fs::metadata(path).is_ok_and(|existing| !existing.is_file() && !existing.is_dir());
    let result = if is_special {
        File::create(path).and_then(|file| write_to(file, write)).map(drop)
    } else {
        write_and_rename(path, write)
    };
    result.map_err(|source| FileError { path: path.into(), source })
}

/// Checks that the folder of a file that is to be written later exists, so that a long wait does not end in vain.
///
/// # Errors
/// [`FileError`].
pub fn check_folder(path: &Path) -> Result<(), FileError> {
    let checked = match (path.file_name(), fs::metadata(folder(path))) {
        (_, Err(error)) => Err(error),
        (None, _) => Err(io::ErrorKind::IsADirectory.into()),
        (Some(_), Ok(folder)) if !folder.is_dir() => Err(io::ErrorKind::NotADirectory.into()),
        (Some(_), Ok(_)) if path.is_dir() => Err(io::ErrorKind::IsADirectory.into()),
        (Some(_), Ok(_)) => Ok(()),
    };
    checked.map_err(|source| FileError { path: path.into(), source })
}

fn folder(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn write_and_rename(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> io::Result<()> {
    let name = path.file_name().ok_or(io::ErrorKind::IsADirectory)?.to_string_lossy();
    let aside = folder(path).join(format!(".{name}.{}.part", std::process::id()));
    let file = OpenOptions::new().write(true).create(true).truncate(true).open(&aside)?;
    let result = write_to(file, write).and_then(|file| file.sync_all()).and_then(|()| fs::rename(&aside, path));
    if result.is_err() {
        // The first error is the one to report.
        let _ = fs::remove_file(&aside);
    }
    result
}

fn write_to(file: File, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> io::Result<File> {
    let mut out = BufWriter::new(file);
    write(&mut out)?;
    out.into_inner().map_err(|error| error.into_error())
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn a_file_is_replaced_whole_or_not_at_all() {
        let folder = std::env::temp_dir().join(format!("lodestream-file-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let path = folder.join("out.bin");
        write_aside(&path, |out| out.write_all(b"one")).unwrap();
        let failed = write_aside(&path, |out| {
            out.write_all(b"half")?;
            Err(io::Error::other("no more"))
        });
        assert_eq!(failed.unwrap_err().path, path);
        assert_eq!(fs::read(&path).unwrap(), b"one");
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "nothing lies beside it");
        write_aside(&path, |out| out.write_all(b"two")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");

        assert!(check_folder(&path).is_ok() && check_folder(Path::new("out.bin")).is_ok());
        assert!(check_folder(&folder).is_err(), "a folder is no file");
        assert!(check_folder(&folder.join("absent").join("out.bin")).is_err());
        fs::remove_dir_all(&folder).unwrap();
    }
}
