//! Which frames of an archive a process works on.
//!
//! Each process has a file `FIRST-END` in the folder of claims, and a lock on it as long as it lives.

use rowburst::{Error, ErrorKind, Parameter, Result, phrase};
use rowburst_io::write_error;
use rowburst_zarr::Lock;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// A range of frames that no other process makes; given back when dropped or when the process ends.
#[derive(Debug)]
pub struct Claim {
    path: PathBuf,
    _lock: Lock,
}

impl Claim {
    /// Claims `range` in the folder of claims. The caller holds a lock that all processes of the archive take.
    pub(crate) fn new(folder: &Path, range: Range<usize>) -> Result<Self> {
        fs::create_dir_all(folder).map_err(|e| write_error(&e).within(folder))?;
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let Some(other) = parse(&entry.file_name().to_string_lossy()) else {
                continue;
            };
            if other.start >= range.end || range.start >= other.end {
                continue;
            }
            if Lock::attempt(&entry.path())?.is_none() {
                return Err(overlap_error(folder, &range, &other));
            }
            // Its process was killed.
            let _ = fs::remove_file(entry.path());
        }
        let path = folder.join(format!("{}-{}", range.start, range.end));
        let lock = Lock::wait(&path)?;
        Ok(Self { path, _lock: lock })
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.path);
    }
}

fn parse(name: &str) -> Option<Range<usize>> {
    let (first, end) = name.split_once('-')?;
    Some(first.parse().ok()?..end.parse().ok()?)
}

fn overlap_error(folder: &Path, range: &Range<usize>, other: &Range<usize>) -> Error {
    let archive = folder.ancestors().nth(2).unwrap_or(folder);
    Error::input(
        archive,
        format!(
            "another process makes its frames {}:{}, and this one is to make {}:{}",
            other.start, other.end, range.start, range.end
        ),
        "processes that share an archive each make their own frames",
        phrase![
            "Wait for the other process, or give each a range of its own with ",
            Parameter::FramesRange,
            "."
        ],
    )
    .with_kind(ErrorKind::Conflict)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_that_overlap_are_refused() {
        let base = tempfile::tempdir().unwrap();
        let folder = base.path().join("out.zarr/rowburst/claims");
        let first = Claim::new(&folder, 0..4).unwrap();
        let beside = Claim::new(&folder, 4..8).unwrap();
        for range in [0..8, 0..4, 3..5, 7..9] {
            let error = Claim::new(&folder, range).unwrap_err().to_string();
            assert!(
                error.contains("out.zarr: ") && !error.contains("claims"),
                "{error}"
            );
        }
        drop((first, beside));
        // A process that was killed leaves its file without a lock.
        fs::write(folder.join("2-6"), "").unwrap();
        let all = Claim::new(&folder, 0..8).unwrap();
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        drop(all);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
    }
}
