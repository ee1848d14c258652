//! Reads the files that the command line names, and prints notes about them.

use crate::shared_args::CalibrationArgs;
use rowburst::{Camera, Image, PatchSet, Result};
use rowburst_io::Calibration;
use std::path::Path;

/// The calibration files of the command line.
pub fn calibration_from_args(args: &CalibrationArgs) -> Calibration {
    let files = args.clone();
    Calibration {
        psf: files.psf,
        dark: files.dark,
        flat: files.flat,
        bad_pixels: files.bad_pixels,
    }
}

/// Reads the PSFs of `path`. Prints a note where a PSF was binned.
pub fn read_psfs(path: &Path, camera: &Camera, dark: Option<&Image>) -> Result<PatchSet> {
    let (psfs, note) = rowburst_run::inputs::read_psfs(path, camera, dark)?;
    if let Some(note) = note {
        eprintln!("{note}");
    }
    Ok(psfs)
}
