//! A folder of results, in which a file is either whole or not there.

use crate::fault;
use crate::file_log::FileLog;
use rowburst::error::With;
use rowburst::{Cancel, Error, ErrorKind as Kind, Parameter, Result, phrase};
use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;
use tracing::info;

/// A folder that results are written to. One that was made for them and has got none
/// is removed when dropped: a run that was refused leaves nothing behind.
#[derive(Debug)]
pub struct OutputFolder {
    path: PathBuf,
    is_new: bool,
    cancel: Cancel,
    /// The list of the files that were written; `None` in a folder that was not claimed.
    log: Option<FileLog>,
}

/// What is done where a folder holds files that the program has not written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ForeignFiles {
    /// The folder is refused.
    Refuse,
    /// They stay, but for those of the names that are written.
    Accept,
}

/// Foreign files that an error names.
const MAX_NAMED_FILES: usize = 3;

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if self.is_new {
            // A folder that holds anything stays.
            let _ = fs::remove_dir(&self.path);
        }
    }
}

impl OutputFolder {
    /// Makes the folder, and those above it, where they are missing, and checks
    /// that files can be made in it.
    ///
    /// # Errors
    /// A path that is a file, or a folder that may not be written to.
    pub fn create(path: &Path) -> Result<Self> {
        let is_new = !path.exists();
        let made = fs::create_dir_all(path).and_then(|()| temporary(path, "check").map(drop));
        made.map_err(|error| {
            let found = match error.kind() {
                ErrorKind::AlreadyExists | ErrorKind::NotADirectory => {
                    "a file where a folder is needed".to_string()
                }
                _ => format!("a folder that cannot be written to ({error})"),
            };
            Error::input(
                path,
                found,
                "results go to a folder that is new or can be written to",
                phrase!["Choose another folder", With(Parameter::Output), "."],
            )
        })?;
        Ok(Self {
            path: path.into(),
            is_new,
            cancel: Cancel::default(),
            log: None,
        })
    }

    /// Like [`Self::create`], for the results of the command `writer`: files that the program has not written, or that
    /// were changed since, are treated by `foreign`. Lists the files that are written, so that the next run knows them.
    /// Hidden files and subfolders of the user are no obstacle.
    ///
    /// # Errors
    /// Those of [`Self::create`], and a folder with foreign files where they are refused.
    pub fn claim(path: &Path, writer: &'static str, foreign: ForeignFiles) -> Result<Self> {
        let mut folder = Self::create(path)?;
        let log = FileLog::open(path, writer);
        let found = match foreign {
            ForeignFiles::Refuse => log.foreign(),
            ForeignFiles::Accept => Vec::new(),
        };
        if let Some(error) = foreign_error(path, &found) {
            return Err(error);
        }
        if log.exists() || holds_only_temporary(path) {
            remove_temporary(path);
        }
        if log.exists() {
            // One line for each file. Without room for it the longer list stays.
            let _ = folder.write_bytes(FileLog::name(), log.compacted().as_bytes());
        }
        folder.log = Some(log);
        Ok(folder)
    }

    /// A folder within this one, claimed for the same command.
    ///
    /// # Errors
    /// Those of [`Self::claim`].
    pub fn subfolder(&self, name: &str, writer: &'static str) -> Result<Self> {
        let folder = Self::claim(&self.path.join(name), writer, ForeignFiles::Accept)?;
        Ok(folder.with_cancel(&self.cancel))
    }

    /// Lists a file that is written step by step, or an archive of many files, before it is begun.
    ///
    /// # Errors
    /// A failed write.
    pub fn list(&self, name: &str) -> Result<()> {
        let Some(log) = &self.log else {
            return Ok(());
        };
        let noted = log.note_any(name);
        noted.map_err(|e| fault::write_error(&e).within(self.path.join(name)))
    }

    /// Removes the files of an earlier run of the same command that this one has not written again.
    ///
    /// # Errors
    /// A file that cannot be removed.
    pub fn remove_stale(&self) -> Result<()> {
        let stale = self.log.iter().flat_map(FileLog::stale);
        for name in stale {
            let path = self.path.join(&name);
            info!("removing {}, of an earlier run", path.display());
            if path.is_dir() {
                fs::remove_dir_all(&path).map_err(|e| fault::write_error(&e).within(path))?;
            } else {
                self.remove(&name)?;
            }
        }
        Ok(())
    }

    /// The same folder, to which nothing is written any more once `cancel` asks for the end.
    #[must_use]
    pub fn with_cancel(mut self, cancel: &Cancel) -> Self {
        self.cancel = cancel.clone();
        self
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Takes away the file `name` of an earlier run, where there is one.
    ///
    /// # Errors
    /// A file that cannot be removed.
    pub fn remove(&self, name: &str) -> Result<()> {
        let path = self.path.join(name);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => {
                Err(fault::write_error(&error).within(path))
            }
            _ => Ok(()),
        }
    }

    /// Writes the file `name` by `write`: into a hidden temporary file, which takes
    /// the name only once all of it is on disk. After an error an older file of that
    /// name is as it was.
    ///
    /// # Errors
    /// Those of `write`, with the file's path in front, failed writes, and [`Self::with_cancel`].
    pub fn write(
        &self,
        name: &str,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<()>,
    ) -> Result<()> {
        self.cancel.check()?;
        let path = self.path.join(name);
        let fault = |error: io::Error| fault::write_error(&error).within(&path);
        let (file, hidden) = temporary(&self.path, name).map_err(fault)?.into_parts();
        let mut writer = BufWriter::new(file);
        write(&mut writer).map_err(|e| e.within(&path))?;
        self.cancel.check()?;
        writer.flush().map_err(fault)?;
        let file = writer.into_inner().map_err(|e| fault(e.into_error()))?;
        let bytes = file.metadata().map_or(0, |metadata| metadata.len());
        // A disk that is full may say so only now.
        file.sync_all().map_err(fault)?;
        if let Some(log) = &self.log {
            log.note(name, &hidden).map_err(fault)?;
        }
        hidden.persist(&path).map_err(|e| fault(e.error))?;
        info!("wrote {}, {bytes} bytes", path.display());
        Ok(())
    }

    /// Writes `bytes` as the file `name`, as [`OutputFolder::write`] does.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write_bytes(&self, name: &str, bytes: &[u8]) -> Result<()> {
        self.write(name, |w| {
            w.write_all(bytes).map_err(|e| fault::write_error(&e))
        })
    }
}

/// The error of a folder with these foreign files; `None` without any.
fn foreign_error(path: &Path, names: &[String]) -> Option<Error> {
    if names.is_empty() {
        return None;
    }
    let mut found = names[..names.len().min(MAX_NAMED_FILES)].join(", ");
    if names.len() > MAX_NAMED_FILES {
        found += &format!(" and {} more", names.len() - MAX_NAMED_FILES);
    }
    let files = if names.len() == 1 { "a file" } else { "files" };
    let error = Error::input(
        path,
        format!("{files} that Rowburst did not write, or that changed since: {found}"),
        "results go to a folder of their own, so that nothing of yours is replaced",
        phrase![
            "Choose a new folder",
            With(Parameter::Output),
            ", or go on with ",
            Parameter::Force,
            ", which replaces files of the same names."
        ],
    );
    Some(error.with_kind(Kind::Exists))
}

/// Ending of hidden files that are being written.
const TEMPORARY: &str = ".part";

/// Whether a file is a hidden one that was being written.
fn is_temporary(entry: &fs::DirEntry) -> bool {
    let name = entry.file_name();
    let name = name.to_string_lossy();
    name.starts_with('.') && name.ends_with(TEMPORARY)
}

fn entries(folder: &Path) -> impl Iterator<Item = fs::DirEntry> {
    fs::read_dir(folder).into_iter().flatten().flatten()
}

/// Whether a folder holds nothing else than what a process has left that was killed at its first file.
fn holds_only_temporary(folder: &Path) -> bool {
    entries(folder).all(|entry| is_temporary(&entry))
}

/// Removes the hidden files that a killed process has left.
fn remove_temporary(folder: &Path) {
    for entry in entries(folder).filter(is_temporary) {
        let _ = fs::remove_file(entry.path());
    }
}

/// A hidden file in `folder` that is removed when dropped, with the permissions of
/// any new file.
fn temporary(folder: &Path, name: &str) -> io::Result<NamedTempFile> {
    let prefix = format!(".{name}.");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(TEMPORARY);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let name = |e: io::Result<fs::DirEntry>| e.unwrap().file_name().into_string().unwrap();
        entries.map(name).collect()
    }

    #[test]
    fn a_file_is_whole_or_as_it_was() {
        let base = tempfile::tempdir().unwrap();
        let folder = OutputFolder::create(&base.path().join("a/b")).unwrap();
        let file = folder.path().join("note.txt");
        let old = |w: &mut BufWriter<File>| w.write_all(b"old").map_err(|e| fault::write_error(&e));
        folder.write("note.txt", old).unwrap();
        assert_eq!(fs::read(&file).unwrap(), b"old");

        let broken = folder.write("note.txt", |w| {
            w.write_all(&[b'x'; 100_000]).unwrap();
            Err(Error::work(
                rowburst::error::Subject::named("solver"),
                "gave up",
                "Try again.",
            ))
        });
        let message = broken.unwrap_err().to_string();
        assert!(message.contains("note.txt: solver: gave up"), "{message}");
        assert_eq!(fs::read(&file).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["note.txt"]);
    }

    fn claim(path: &Path, writer: &'static str) -> Result<OutputFolder> {
        OutputFolder::claim(path, writer, ForeignFiles::Refuse)
    }

    #[test]
    fn foreign_files_are_refused_and_own_ones_replaced() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path();
        claim(path, "simulate")
            .unwrap()
            .write_bytes("experiment.toml", b"rows = 1")
            .unwrap();
        fs::create_dir(path.join("captures")).unwrap();
        fs::write(path.join(".hidden"), "").unwrap();
        let again = claim(path, "reconstruct").unwrap();
        again.write_bytes("video.npy", b"1").unwrap();
        claim(path, "simulate").unwrap();

        fs::write(path.join("experiment.toml"), "rows = 1 # my note").unwrap();
        fs::write(path.join("notes.txt"), "").unwrap();
        let error = claim(path, "simulate").unwrap_err();
        let message = error.to_string();
        assert!(message.contains("experiment.toml, notes.txt"), "{message}");
        assert!(
            error.is_input() && !message.contains("video.npy"),
            "{message}"
        );
        OutputFolder::claim(path, "simulate", ForeignFiles::Accept).unwrap();
    }

    #[test]
    fn what_an_earlier_run_left_is_removed() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path();
        let simulated = claim(path, "simulate").unwrap();
        simulated.write_bytes("frame.npy", b"1").unwrap();
        let first = claim(path, "reconstruct").unwrap();
        for name in ["video.npy", "direct.png", "kept.txt"] {
            first.write_bytes(name, b"1").unwrap();
        }
        fs::write(path.join("kept.txt"), "of the user now").unwrap();
        fs::create_dir(path.join("video.zarr")).unwrap();
        first.list("video.zarr").unwrap();
        let second = OutputFolder::claim(path, "reconstruct", ForeignFiles::Accept).unwrap();
        second.write_bytes("video.npy", b"2").unwrap();
        second.remove_stale().unwrap();
        let mut left = names(path);
        left.sort();
        let expected = [".rowburst-files", "frame.npy", "kept.txt", "video.npy"];
        assert_eq!(left, expected);
    }

    /// A process that is killed before, between and after the two renames leaves no file that is foreign.
    #[test]
    fn a_killed_process_leaves_no_foreign_file() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path();
        let folder = claim(path, "reconstruct").unwrap();
        folder.write_bytes("video.npy", b"old").unwrap();
        let log = folder.log.as_ref().unwrap();
        fs::write(path.join(".video.npy.x.part"), "new").unwrap();
        log.note("video.npy", &path.join(".video.npy.x.part"))
            .unwrap();
        claim(path, "reconstruct").unwrap();
        assert!(!path.join(".video.npy.x.part").exists());
        fs::write(path.join("video.npy"), "new").unwrap();
        log.note("video.npy", &path.join("video.npy")).unwrap();
        let list = path.join(FileLog::name());
        let text = fs::read_to_string(&list).unwrap();
        fs::write(&list, text + "{\"name\": \"cut").unwrap();
        claim(path, "reconstruct").unwrap();
    }

    #[test]
    fn nothing_is_written_after_the_end_was_asked_for() {
        let base = tempfile::tempdir().unwrap();
        let cancel = Cancel::default();
        let folder = OutputFolder::create(base.path()).unwrap();
        let folder = folder.with_cancel(&cancel);
        folder.write_bytes("a", b"a").unwrap();
        let during = folder.write("b", |_| {
            cancel.cancel();
            Ok(())
        });
        assert!(during.is_err() && folder.write_bytes("c", b"c").is_err());
        assert_eq!(names(folder.path()), ["a"]);
    }

    #[test]
    fn an_empty_folder_does_not_stay() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path().join("out");
        drop(OutputFolder::create(&path).unwrap());
        assert!(!path.exists());
        fs::create_dir(&path).unwrap();
        drop(OutputFolder::create(&path).unwrap());
        assert!(path.exists());
    }

    #[test]
    fn a_file_is_no_folder() {
        let base = tempfile::tempdir().unwrap();
        let file = base.path().join("file");
        fs::write(&file, "x").unwrap();
        for path in [file.clone(), file.join("below")] {
            let error = OutputFolder::create(&path).unwrap_err();
            assert!(error.is_input());
            assert!(
                error.to_string().contains("a file where a folder"),
                "{error}"
            );
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_names_the_file() {
        let full = || -> Result<()> {
            let mut full = BufWriter::new(File::create("/dev/full").unwrap());
            full.write_all(b"x")
                .and_then(|()| full.flush())
                .map_err(|e| fault::write_error(&e))
        };
        let base = tempfile::tempdir().unwrap();
        let folder = OutputFolder::create(base.path()).unwrap();
        let error = folder.write("video.npy", |_| full()).unwrap_err();
        assert!(!error.is_input());
        let message = error.to_string();
        assert!(
            message.contains("video.npy") && message.contains("Free space"),
            "{message}"
        );
        assert!(names(folder.path()).is_empty());
    }

    #[cfg(unix)]
    #[test]
    fn results_can_be_read_by_others() {
        use std::os::unix::fs::PermissionsExt;
        let base = tempfile::tempdir().unwrap();
        let folder = OutputFolder::create(base.path()).unwrap();
        folder.write("a", |_| Ok(())).unwrap();
        fs::write(base.path().join("b"), "").unwrap();
        let mode = |name| {
            fs::metadata(base.path().join(name))
                .unwrap()
                .permissions()
                .mode()
        };
        assert_eq!(mode("a"), mode("b"));
    }
}
