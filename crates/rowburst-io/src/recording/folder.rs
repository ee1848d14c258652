//! A folder of images, or of stacks, as a recording.

use super::{Frames, names, open_file};
use crate::fault;
use crate::pages::{Capture, IntegerFrame};
use crate::read::read_image;
use crate::source::{ENDINGS, Format, is_image};
use rowburst::{Error, Result};
use std::path::{Path, PathBuf};

/// Names of the images in a folder, all of one format, in their natural order; what is no image,
/// and hidden files, are left aside.
pub(crate) fn images_in(path: &Path) -> Result<Vec<String>> {
    let mut names = Vec::new();
    let mut formats: Vec<(Format, String)> = Vec::new();
    let entries = std::fs::read_dir(path).map_err(|e| fault::read_error(path, &e))?;
    for entry in entries {
        let entry = entry.map_err(|e| fault::read_error(path, &e))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let Some(format) = Format::of_name(Path::new(&name)) else {
            continue;
        };
        if name.starts_with('.') || !is_image(Path::new(&name)) || entry.path().is_dir() {
            continue;
        }
        if formats.iter().all(|(known, _)| *known != format) {
            formats.push((format, name.clone()));
        }
        names.push(name);
    }
    let error =
        |found: String, rule: String, remedy: &'static str| Error::input(path, found, rule, remedy);
    if names.is_empty() {
        return Err(error(
            "a folder without images".into(),
            format!("frames are {ENDINGS} files in the folder itself"),
            "Name the folder that holds them, or the stack or Zarr array.",
        ));
    }
    if let [(_, one), (_, other), ..] = formats.as_slice() {
        return Err(error(
            format!("{one} and {other}"),
            "the frames of a recording have one format".into(),
            "Move what is no frame (darks, previews) to another folder.",
        ));
    }
    names.sort_by(|a, b| names::natural(a, b));
    Ok(names)
}

/// Images of one format in a folder, in the natural order of their names.
pub(super) struct Folder {
    path: PathBuf,
    names: Vec<String>,
    numbers: Option<Vec<u64>>,
}

impl Folder {
    /// The images `names`, in their order.
    pub fn new(path: &Path, names: Vec<String>) -> Self {
        Self {
            path: path.into(),
            numbers: names::numbers(&names),
            names,
        }
    }
}

impl Frames for Folder {
    fn path(&self) -> &Path {
        &self.path
    }

    fn count(&self) -> usize {
        self.names.len()
    }

    fn name(&self, index: usize) -> String {
        self.names[index].clone()
    }

    fn number(&self, index: usize) -> u64 {
        match &self.numbers {
            Some(numbers) => numbers[index],
            None => index as u64,
        }
    }

    fn read(&self, index: usize) -> Result<Capture> {
        read_image(&self.path.join(&self.names[index]))
    }

    fn read_integers(&self, index: usize) -> Result<IntegerFrame> {
        let frames = open_file(&self.path.join(&self.names[index]))?;
        if frames.count() > 1 {
            // Its error says that one image is needed.
            return self.read(index).map(IntegerFrame::from);
        }
        frames.read_integers(0)
    }
}

/// Stacks in a folder, one after the other: programs begin a new file at 4 GB.
pub(super) struct Chain {
    path: PathBuf,
    /// Name and frames of each file, with the index of its first frame.
    parts: Vec<(usize, String, Box<dyn Frames>)>,
    count: usize,
}

impl Chain {
    /// Opens the stacks `names`, in their order; a file that cannot be opened is an error, since
    /// it does not say how many frames it has.
    pub fn open(path: &Path, names: &[String]) -> Result<Self> {
        let mut parts = Vec::new();
        let mut count = 0;
        for name in names {
            let frames = open_file(&path.join(name))?;
            let first = count;
            count += frames.count();
            parts.push((first, name.clone(), frames));
        }
        Ok(Self {
            path: path.into(),
            parts,
            count,
        })
    }

    /// The file of a frame, and its index there.
    fn part(&self, index: usize) -> (&str, &dyn Frames, usize) {
        let after = self.parts.partition_point(|(first, ..)| *first <= index);
        let (first, name, frames) = &self.parts[after - 1];
        (name, frames.as_ref(), index - first)
    }
}

impl Frames for Chain {
    fn path(&self) -> &Path {
        &self.path
    }

    fn count(&self) -> usize {
        self.count
    }

    fn name(&self, index: usize) -> String {
        let (name, frames, at) = self.part(index);
        match self.parts.len() {
            1 => frames.name(at),
            _ => format!("{name} {}", frames.name(at)),
        }
    }

    fn read(&self, index: usize) -> Result<Capture> {
        let (_, frames, at) = self.part(index);
        frames.read(at)
    }

    fn read_integers(&self, index: usize) -> Result<IntegerFrame> {
        let (_, frames, at) = self.part(index);
        frames.read_integers(at)
    }
}
