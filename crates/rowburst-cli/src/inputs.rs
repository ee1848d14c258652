//! The files that the command line names.

use crate::shared_args::CalibrationArgs;
use rowburst_io::Calibration;

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
