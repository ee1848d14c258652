//! The list of the files that the program has written into a folder of results.
//!
//! The list is the hidden file `.rowburst-files` of the folder: a line of JSON for each file, written before the file gets
//! its name. A killed process therefore leaves no file that is not in it. A file belongs to the program if its name is in
//! the list with its size, and up to [`MAX_HASHED_BYTES`] with its SHA-256: a file that was changed belongs to the user.

use crate::source::ArrayPath;
use rowburst::Result;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Name of the list.
const LIST: &str = ".rowburst-files";
/// Largest file that is hashed; larger finds edits of larger files and takes longer.
const MAX_HASHED_BYTES: u64 = 1 << 20;
/// Ending of folders that count as one file.
const ARCHIVE: &str = ".zarr";

/// Size and hash of a file that the program has written.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Stamp {
    writer: String,
    /// `None`: any content.
    bytes: Option<u64>,
    /// `None`: any content of this size.
    sha256: Option<String>,
}

/// The list of a folder, for one command that writes into it.
#[derive(Debug)]
pub(crate) struct FileLog {
    folder: PathBuf,
    writer: &'static str,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// What was written under each name; more than one stamp where a process was killed in between.
    stamps: BTreeMap<String, Vec<Stamp>>,
    /// Names that this command has written.
    written: Vec<String>,
}

impl FileLog {
    /// Reads the list of `folder`, where there is one, for the command `writer`.
    pub fn open(folder: &Path, writer: &'static str) -> Self {
        let text = fs::read_to_string(folder.join(LIST)).unwrap_or_default();
        let mut state = State::default();
        // A line that a killed process has cut is none.
        for (name, stamp) in text.lines().filter_map(parse) {
            state.stamps.entry(name).or_default().push(stamp);
        }
        Self {
            folder: folder.into(),
            writer,
            state: Mutex::new(state),
        }
    }

    /// The files of the folder that the program has not written or that were changed since, sorted. Hidden files and
    /// subfolders do not count, archives do.
    pub fn foreign(&self) -> Vec<String> {
        let entries = fs::read_dir(&self.folder).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries
            .filter(|entry| {
                let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
                let name = entry.file_name();
                let name = name.to_string_lossy();
                !name.starts_with('.') && (!is_folder || name.ends_with(ARCHIVE))
            })
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .filter(|name| !self.is_own(name))
            .collect();
        names.sort();
        names
    }

    /// Whether the file `name` is as the program has written it.
    pub fn is_own(&self, name: &str) -> bool {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(stamps) = state.stamps.get(name) else {
            return false;
        };
        let path = self.folder.join(name);
        stamps.iter().any(|stamp| stamp.is_of(&path))
    }

    /// Notes that the content of the file `content` takes the name `name` next.
    pub fn note(&self, name: &str, content: &Path) -> io::Result<()> {
        let bytes = fs::metadata(content)?.len();
        self.append(name, Some(bytes), sha256_of_small(content, bytes)?)
    }

    /// Notes a file that is written step by step, or a folder.
    pub fn note_any(&self, name: &str) -> io::Result<()> {
        self.append(name, None, None)
    }

    fn append(&self, name: &str, bytes: Option<u64>, sha256: Option<String>) -> io::Result<()> {
        let stamp = Stamp {
            writer: self.writer.into(),
            bytes,
            sha256,
        };
        let line = stamp.line(name);
        let mut file = OpenOptions::new()
            .append(true)
            .create(true)
            .open(self.folder.join(LIST))?;
        file.write_all(line.as_bytes())?;
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.stamps.entry(name.into()).or_default().push(stamp);
        state.written.push(name.into());
        Ok(())
    }

    /// The files of an earlier run of this command that it has not written again and that are as it has written them.
    pub fn stale(&self) -> Vec<String> {
        let names: Vec<String> = {
            let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
            let of_writer = |stamps: &Vec<Stamp>| stamps.iter().all(|s| s.writer == self.writer);
            let stamps = state.stamps.iter();
            let stale = stamps.filter(|(name, s)| of_writer(s) && !state.written.contains(name));
            stale.map(|(name, _)| name.clone()).collect()
        };
        names.into_iter().filter(|name| self.is_own(name)).collect()
    }

    /// The list with one line for each file that is there, for the start of a command.
    pub fn compacted(&self) -> String {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let mut text = String::new();
        for (name, stamps) in &state.stamps {
            let path = self.folder.join(name);
            if let Some(stamp) = stamps.iter().rev().find(|stamp| stamp.is_of(&path)) {
                text += &stamp.line(name);
            }
        }
        text
    }

    /// Whether the folder has a list.
    pub fn exists(&self) -> bool {
        self.folder.join(LIST).is_file()
    }

    /// The list's name.
    pub fn name() -> &'static str {
        LIST
    }
}

impl Stamp {
    fn line(&self, name: &str) -> String {
        let mut value = json!({ "name": name, "writer": self.writer });
        if let Some(bytes) = self.bytes {
            value["bytes"] = json!(bytes);
        }
        if let Some(sha256) = &self.sha256 {
            value["sha256"] = json!(sha256);
        }
        format!("{value}\n")
    }

    /// Whether the file of `path` has this size and content.
    fn is_of(&self, path: &Path) -> bool {
        let Ok(metadata) = fs::symlink_metadata(path) else {
            return false;
        };
        match (self.bytes, &self.sha256) {
            (None, _) => true,
            (Some(bytes), _) if metadata.len() != bytes || !metadata.is_file() => false,
            (Some(_), None) => true,
            (Some(bytes), Some(hash)) => {
                sha256_of_small(path, bytes).is_ok_and(|found| found.as_ref() == Some(hash))
            }
        }
    }
}

fn parse(line: &str) -> Option<(String, Stamp)> {
    let value: Value = serde_json::from_str(line).ok()?;
    let text = |key: &str| Some(value.get(key)?.as_str()?.to_string());
    let stamp = Stamp {
        writer: text("writer")?,
        bytes: value.get("bytes").and_then(Value::as_u64),
        sha256: text("sha256"),
    };
    Some((text("name")?, stamp))
}

/// The hash of a file that is small enough for one.
fn sha256_of_small(path: &Path, bytes: u64) -> io::Result<Option<String>> {
    if bytes > MAX_HASHED_BYTES {
        return Ok(None);
    }
    sha256_of_file(path).map(Some)
}

fn sha256_of_file(path: &Path) -> io::Result<String> {
    let mut file = File::open(path)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        let read = file.read(&mut buffer)?;
        if read == 0 {
            break;
        }
        hash.update(&buffer[..read]);
    }
    let digits = hash.finalize();
    Ok(digits.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// SHA-256 of the content of a file, as 64 hexadecimal digits. `FILE.h5:/path` is the whole file.
///
/// # Errors
/// A file that cannot be read.
pub fn sha256(path: &Path) -> Result<String> {
    let file = ArrayPath::of(path).file;
    sha256_of_file(&file).map_err(|e| crate::fault::read_error(path, &e))
}
