//! Opens a file of frames, by its format.

use crate::pages::{Axes, Pages, Stack};
use crate::source::{Format, Source};
use crate::{bmp, fits, mat, npy, photron, png, tiff};
use rowburst::Result;
use std::fs::File;
use std::io::BufReader;

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
