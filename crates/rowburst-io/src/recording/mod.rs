//! Recordings: many frames of one camera, read one at a time.
//!
//! A folder of images in the natural order of their names, a folder of stacks one after the other,
//! or a file of several frames of any format that is read. Never more than a frame is in memory
//! for each reader.

mod folder;
mod names;

use crate::pages::{Capture, IntegerFrame, Stack, single};
use crate::read::read_image;
use crate::source::{Colour, Format, Source, open};
use crate::stack::open_stack;
pub(crate) use folder::images_in;
use folder::{Chain, Folder};
use rowburst::Result;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// The frames of a recording; several threads may read at once.
pub trait Frames: Send + Sync {
    /// The file or folder.
    fn path(&self) -> &Path;

    /// Number of frames, at least one.
    fn count(&self) -> usize;

    /// What a user calls frame `index`: a file's name, or a page.
    fn name(&self, index: usize) -> String;

    /// The place of frame `index` in time, in frame periods: the number in its file's name where
    /// the names are numbered, else `index`. Rises with `index`.
    fn number(&self, index: usize) -> u64 {
        index as u64
    }

    /// Reads frame `index`. Sizes and kinds of numbers may differ from frame to frame, and
    /// pixels need not be finite.
    ///
    /// # Errors
    /// A frame that is missing or damaged; the others may still be read.
    fn read(&self, index: usize) -> Result<Capture>;

    /// Like [`Self::read`], for a frame of integers, which keep all their digits. Floating-point numbers are cut to whole
    /// ones.
    ///
    /// # Errors
    /// Those of [`Self::read`].
    fn read_integers(&self, index: usize) -> Result<IntegerFrame> {
        self.read(index).map(IntegerFrame::from)
    }
}

/// Opens a folder of images or of stacks (all of one format), or a file of frames: a multi-page
/// `.tif`, a 3-D array `[frame, y, x]`, or a single image.
///
/// # Errors
/// A path that is missing, a folder without images or with images of several formats, a file
/// whose header is damaged.
pub fn open_recording(path: &Path) -> Result<Box<dyn Frames>> {
    if !path.is_dir() {
        return open_file(path);
    }
    let names = images_in(path)?;
    if let Ok(first) = open_file(&path.join(&names[0]))
        && first.count() > 1
    {
        return Ok(Box::new(Chain::open(path, &names)?));
    }
    Ok(Box::new(Folder::new(path, names)))
}

fn open_file(path: &Path) -> Result<Box<dyn Frames>> {
    let (source, file, format) = open(path, Colour::Refused)?;
    let bytes = source.bytes;
    if matches!(format, Format::Png | Format::Bmp) {
        return Ok(Box::new(Single { path: path.into() }));
    }
    let stack = open_stack(&source, file, format)?;
    Ok(Box::new(StackFile {
        count: stack.count(),
        stack: Mutex::new(stack),
        path: path.into(),
        bytes,
    }))
}

/// Numbers that are missing between those of neighbouring frames, as (index of the frame before,
/// first and last number that are missing).
pub fn gaps(frames: &dyn Frames) -> Vec<(usize, u64, u64)> {
    (1..frames.count())
        .filter_map(|index| {
            let (before, after) = (frames.number(index - 1), frames.number(index));
            (after > before + 1).then_some((index - 1, before + 1, after - 1))
        })
        .collect()
}

struct StackFile {
    path: PathBuf,
    bytes: u64,
    count: usize,
    /// One reader: a page takes milliseconds, what is made of it seconds.
    stack: Mutex<Box<dyn Stack>>,
}

impl StackFile {
    fn source(&self) -> Source<'_> {
        Source {
            path: &self.path,
            bytes: self.bytes,
            colour: Colour::Refused,
        }
    }
}

impl Frames for StackFile {
    fn path(&self) -> &Path {
        &self.path
    }

    fn count(&self) -> usize {
        self.count
    }

    fn name(&self, index: usize) -> String {
        let stack = self.stack.lock().unwrap_or_else(PoisonError::into_inner);
        stack.name(index)
    }

    fn read(&self, index: usize) -> Result<Capture> {
        let source = self.source();
        // A reader that another thread left in mid-page seeks anew.
        let mut stack = self.stack.lock().unwrap_or_else(PoisonError::into_inner);
        let page = stack.page(&source, index);
        drop(stack);
        single(&self.path, page?)
    }

    fn read_integers(&self, index: usize) -> Result<IntegerFrame> {
        let mut stack = self.stack.lock().unwrap_or_else(PoisonError::into_inner);
        stack.integers(&self.source(), index)
    }
}

/// One image.
struct Single {
    path: PathBuf,
}

impl Frames for Single {
    fn path(&self) -> &Path {
        &self.path
    }

    fn count(&self) -> usize {
        1
    }

    fn name(&self, _: usize) -> String {
        let name = self.path.file_name().unwrap_or_default();
        name.to_string_lossy().into_owned()
    }

    fn read(&self, _: usize) -> Result<Capture> {
        read_image(&self.path)
    }
}

#[cfg(test)]
mod tests;
