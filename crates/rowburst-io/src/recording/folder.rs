//! A folder of images as a recording.

use super::{Frames, names};
use crate::fault;
use crate::read::{Capture, Format, read_image};
use rowburst::{Error, Result};
use std::path::{Path, PathBuf};

/// Images of one format in a folder, in the natural order of their names.
pub(super) struct Folder {
    path: PathBuf,
    names: Vec<String>,
    numbers: Option<Vec<u64>>,
}

impl Folder {
    /// Lists the folder; what is no image, and hidden files, are left aside.
    pub fn open(path: &Path) -> Result<Self> {
        let mut names = Vec::new();
        let mut formats: Vec<(Format, String)> = Vec::new();
        let entries = std::fs::read_dir(path).map_err(|e| fault::reading(path, &e))?;
        for entry in entries {
            let entry = entry.map_err(|e| fault::reading(path, &e))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let Some(format) = Format::of_name(Path::new(&name)) else {
                continue;
            };
            if name.starts_with('.') || entry.path().is_dir() {
                continue;
            }
            if formats.iter().all(|(known, _)| *known != format) {
                formats.push((format, name.clone()));
            }
            names.push(name);
        }
        let error = |found: String, rule: &str, remedy: &str| {
            Error::input(path.display().to_string(), found, rule, remedy)
        };
        if names.is_empty() {
            return Err(error(
                "a folder without images".into(),
                "frames are .npy, .tif, .png or .bmp files in the folder itself",
                "Name the folder that holds them, or the stack or Zarr array.",
            ));
        }
        if let [(_, one), (_, other), ..] = formats.as_slice() {
            return Err(error(
                format!("{one} and {other}"),
                "the frames of a recording have one format",
                "Move what is no frame (darks, previews) to another folder.",
            ));
        }
        names.sort_by(|a, b| names::natural(a, b));
        Ok(Self {
            path: path.into(),
            numbers: names::numbers(&names),
            names,
        })
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
}
