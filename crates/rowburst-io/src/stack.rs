//! Frames of one file, read one at a time: the road of every format that holds several.

use crate::read::Pages;
use crate::source::{Format, Source};
use crate::{bmp, fits, mat, npy, photron, png, tiff};
use rowburst::ErrorKind;
use rowburst::Result;
use std::fs::File;
use std::io::BufReader;

/// In which order the sides of a frame lie in HDF5.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Axes {
    /// `[frame, y, x]`.
    Plain,
    /// `[frame, x, y]`: MATLAB's `(y, x, frame)`.
    Matlab,
}

/// An opened file of frames.
pub(crate) trait Stack: Send {
    /// Number of frames, at least one.
    fn count(&self) -> usize;

    /// What a user calls a frame.
    fn name(&self, at: usize) -> String {
        format!("[{at}]")
    }

    /// Reads one frame; sizes and kinds of numbers may differ from frame to frame.
    fn page(&mut self, source: &Source, at: usize) -> Result<Pages>;
}

/// Opens a file for reading frame by frame; one of a format with a single image is read.
pub(crate) fn open_stack(
    source: &Source,
    mut file: BufReader<File>,
    format: Format,
) -> Result<Box<dyn Stack>> {
    Ok(match format {
        Format::Npy => Box::new(npy::OpenStack::new(source, file)?),
        Format::Tiff => Box::new(tiff::Stack::open(source, file)?),
        Format::Png => Box::new(SingleImage(png::read(source, file)?)),
        Format::Bmp => Box::new(SingleImage(bmp::read(source, file)?)),
        Format::Hdf5 => open_hdf5(source, Axes::Plain)?,
        Format::Matlab => match mat::version(source, &mut file)? {
            mat::Version::Five => Box::new(mat::Variable::open(source, file)?),
            mat::Version::SevenThree => open_hdf5(source, Axes::Matlab)?,
        },
        Format::Fits => Box::new(fits::Stack::open(source, file)?),
        Format::Photron => Box::new(photron::Stack::open(source)?),
    })
}

#[cfg(feature = "hdf5")]
fn open_hdf5(source: &Source, axes: Axes) -> Result<Box<dyn Stack>> {
    Ok(Box::new(crate::hdf5::Stack::open(source, axes)?))
}

/// In a build without the feature `hdf5`.
#[cfg(not(feature = "hdf5"))]
fn open_hdf5(source: &Source, _: Axes) -> Result<Box<dyn Stack>> {
    Err(source.error(
        "an HDF5 file",
        "this program was built without the feature hdf5",
        "Build it with --features hdf5, or convert the file to .npy.",
    ))
}

/// All frames of a file, which must have one size and one kind of numbers.
pub(crate) fn all_pages(source: &Source, stack: &mut dyn Stack) -> Result<Pages> {
    let count = stack.count();
    let mut all = stack.page(source, 0)?;
    for at in 1..count {
        let page = stack.page(source, at)?;
        if (page.rows, page.columns, page.format) != (all.rows, all.columns, all.format) {
            return Err(source.error(
                format!(
                    "{} of {}×{} pixels after frames of {}×{}, or of another kind",
                    stack.name(at),
                    page.rows,
                    page.columns,
                    all.rows,
                    all.columns
                ),
                "the frames of a stack have one size and one kind of pixel",
                "Save the frames that belong together as one stack.",
            ));
        }
        if at == 1 {
            let missing = page.data.len().saturating_mul(count - 1);
            all.data.try_reserve_exact(missing).map_err(|_| {
                rowburst::Error::work(
                    source.path,
                    format!("no memory for {count} frames"),
                    "Crop or bin the images, or use a machine with more memory.",
                )
                .with_kind(ErrorKind::Memory)
            })?;
        }
        all.data.extend(page.data);
    }
    all.count = count;
    Ok(all)
}

/// A file of one image.
struct SingleImage(Pages);

impl Stack for SingleImage {
    fn count(&self) -> usize {
        1
    }

    fn page(&mut self, _: &Source, _: usize) -> Result<Pages> {
        Ok(self.0.clone())
    }
}
