//! Calibrations as the command line and Python meet them: numbers, report and folder of each.

pub mod psf;
pub mod sensor;
pub mod timing;
