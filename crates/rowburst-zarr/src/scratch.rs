//! Files that are whole or not there, whatever ends the process.

use rowburst::Result;
use rowburst_io::write_error;
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// A lock that other processes wait for; given back when dropped or when the process ends.
///
/// On a file system without locks (some parallel ones) it locks nothing.
#[derive(Debug)]
pub struct Lock {
    /// `None` where there are no locks.
    file: Option<File>,
}

impl Lock {
    /// Waits for the lock `path`, a file that is made where it is missing.
    ///
    /// # Errors
    /// A file that cannot be made.
    pub fn wait(path: &Path) -> Result<Self> {
        let locked = open_lock(path).and_then(|file| match file.lock() {
            Ok(()) => Ok(Some(file)),
            Err(error) if has_no_locks(&error) => Ok(None),
            Err(error) => Err(error),
        });
        let file = locked.map_err(|e| write_error(&e).within(path))?;
        Ok(Self { file })
    }

    /// The lock `path`, or `None` where another process has it.
    ///
    /// # Errors
    /// A file that cannot be made.
    pub fn attempt(path: &Path) -> Result<Option<Self>> {
        let fault = |e: io::Error| write_error(&e).within(path);
        let file = open_lock(path).map_err(fault)?;
        match file.try_lock() {
            Ok(()) => Ok(Some(Self { file: Some(file) })),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) if has_no_locks(&error) => {
                Ok(Some(Self { file: None }))
            }
            Err(TryLockError::Error(error)) => Err(fault(error)),
        }
    }

    /// Whether it keeps others out.
    pub fn is_real(&self) -> bool {
        self.file.is_some()
    }
}

fn open_lock(path: &Path) -> io::Result<File> {
    let mut options = File::options();
    options.create(true).truncate(false).write(true).open(path)
}

fn has_no_locks(error: &io::Error) -> bool {
    // ENOLCK on Linux.
    error.kind() == ErrorKind::Unsupported || error.raw_os_error() == Some(37)
}

/// A folder for the files of one process that are not whole yet. Removed when dropped; what a
/// process that was killed has left is removed by the next one.
#[derive(Debug)]
pub struct Scratch {
    folder: PathBuf,
    /// `None` while it is dropped.
    lock: Option<Lock>,
}

/// Held by a process as long as its folder is in use.
const IN_USE: &str = "in-use";

impl Scratch {
    /// Makes a folder in `place`, which must be on the disk of the files to be written. The
    /// caller holds a lock that all processes that share `place` take.
    ///
    /// # Errors
    /// A folder that cannot be made.
    pub fn open(place: &Path) -> Result<Self> {
        let made = fs::create_dir_all(place).and_then(|()| {
            remove_left_over(place);
            tempfile::Builder::new().prefix("p").tempdir_in(place)
        });
        let folder = made.map_err(|e| write_error(&e).within(place))?.keep();
        let lock = Lock::wait(&folder.join(IN_USE))?;
        Ok(Self {
            folder,
            lock: Some(lock),
        })
    }

    /// A place for what is to be moved as a whole.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Writes `bytes` as the file `target`, and the folders above it: after an error, or a kill
    /// at any moment, an older file of that name is as it was.
    ///
    /// # Errors
    /// Failed writes, naming `target`.
    pub fn put(&self, target: &Path, bytes: &[u8]) -> Result<()> {
        self.try_put(target, bytes)
            .map_err(|e| write_error(&e).within(target))
    }

    /// [`Scratch::put`] with the error as it is.
    pub(crate) fn try_put(&self, target: &Path, bytes: &[u8]) -> io::Result<()> {
        let mut file = new_file(&self.folder)?;
        file.write_all(bytes)?;
        // A disk that is full may say so only now.
        file.as_file().sync_all()?;
        if let Some(parent) = target.parent() {
            fs::create_dir_all(parent)?;
        }
        file.persist(target).map(drop).map_err(|e| e.error)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        // Windows removes no file that is open.
        self.lock = None;
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// A new file in `folder`, with the permissions of any other file.
fn new_file(folder: &Path) -> io::Result<NamedTempFile> {
    #[cfg(unix)]
    let builder = &mut tempfile::Builder::new();
    #[cfg(unix)]
    let builder = builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    #[cfg(not(unix))]
    let builder = tempfile::Builder::new();
    builder.tempfile_in(folder)
}

/// Removes the folders of processes that have ended.
fn remove_left_over(place: &Path) {
    let Ok(entries) = fs::read_dir(place) else {
        return;
    };
    for folder in entries.flatten().map(|entry| entry.path()) {
        let is_free = match File::options().write(true).open(folder.join(IN_USE)) {
            Ok(file) => match file.try_lock() {
                Ok(()) => true,
                Err(TryLockError::WouldBlock | TryLockError::Error(_)) => false,
            },
            // Killed before it had its lock.
            Err(error) => error.kind() == ErrorKind::NotFound,
        };
        if is_free {
            let _ = fs::remove_dir_all(folder);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(folder: &Path) -> usize {
        fs::read_dir(folder).unwrap().count()
    }

    #[test]
    fn what_others_use_stays_and_what_is_left_over_goes() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("tmp");
        let first = Scratch::open(&place).unwrap();
        let second = Scratch::open(&place).unwrap();
        assert_eq!(entries(&place), 2);
        // As if killed: the lock is gone, the folder is not.
        fs::create_dir(place.join("killed")).unwrap();
        fs::write(place.join("killed").join(IN_USE), "").unwrap();
        fs::write(place.join("killed").join("half"), "ha").unwrap();
        let third = Scratch::open(&place).unwrap();
        assert_eq!(entries(&place), 3);
        drop((first, second, third));
        assert_eq!(entries(&place), 0);
    }

    #[test]
    fn a_file_is_whole_or_as_it_was() {
        let base = tempfile::tempdir().unwrap();
        let scratch = Scratch::open(&base.path().join("tmp")).unwrap();
        let target = base.path().join("a/b/c");
        scratch.put(&target, b"old").unwrap();
        scratch.put(&target, b"new").unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"new");
        // A folder in the way.
        let error = scratch.put(&base.path().join("a"), b"x").unwrap_err();
        assert!(error.to_string().contains("/a: "), "{error}");
        assert_eq!(entries(&scratch.folder), 1, "the lock alone");
    }

    #[test]
    fn a_lock_keeps_others_out() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path().join("lock");
        let lock = Lock::wait(&path).unwrap();
        assert!(lock.is_real());
        let other = open_lock(&path).unwrap();
        assert!(other.try_lock().is_err());
        assert!(Lock::attempt(&path).unwrap().is_none());
        drop(lock);
        assert!(Lock::attempt(&path).unwrap().is_some());
        assert!(other.try_lock().is_ok());
    }
}
