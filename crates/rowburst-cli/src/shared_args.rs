//! Arguments that several verbs have.

use clap::Args;
use rowburst::Result;
use rowburst_io::{ForeignFiles, OutputFolder};
use std::path::{Path, PathBuf};

/// Files that stand in for those of `[calibration]`.
#[derive(Debug, Clone, Default, Args)]
pub struct CalibrationArgs {
    /// The PSF, instead of the experiment's
    #[arg(long)]
    pub psf: Option<PathBuf>,
    /// A frame without light, instead of the experiment's
    #[arg(long)]
    pub dark: Option<PathBuf>,
    /// A frame of even light, instead of the experiment's
    #[arg(long)]
    pub flat: Option<PathBuf>,
    /// A mask of pixels not to use (anything but 0), instead of the experiment's
    #[arg(long)]
    pub bad_pixels: Option<PathBuf>,
}

/// Whether a folder with foreign files is written to.
#[derive(Debug, Clone, Copy, Default, Args)]
pub struct ForceArgs {
    /// Write to a folder that holds files which Rowburst did not write; those of the same names are replaced
    #[arg(long)]
    pub force: bool,
}

impl ForceArgs {
    /// The folder of the results of `writer`.
    pub fn claim(self, path: &Path, writer: &'static str) -> Result<OutputFolder> {
        let foreign = if self.force {
            ForeignFiles::Accept
        } else {
            ForeignFiles::Refuse
        };
        OutputFolder::claim(path, writer, foreign)
    }
}

/// The optics of the computed speckle PSF. The defaults give a grain of 2.5 pixels of
/// 6.5 µm and an envelope that reaches over 108 rows.
#[derive(Debug, Clone, Copy, PartialEq, Args)]
#[command(next_help_heading = "Speckle PSF")]
pub struct OpticsArgs {
    /// Wavelength in nanometres
    #[arg(long, default_value_t = 532.0, allow_hyphen_values = true)]
    pub wavelength_nm: f64,
    /// Diameter of the pupil in millimetres
    #[arg(long, default_value_t = 1.71, allow_hyphen_values = true)]
    pub pupil_mm: f64,
    /// Focal length of the lens in millimetres
    #[arg(long, default_value_t = 50.0, allow_hyphen_values = true)]
    pub focal_length_mm: f64,
    /// Magnification from scene to sensor
    #[arg(long, default_value_t = 1.0 / 22.5, allow_hyphen_values = true)]
    pub magnification: f64,
    /// Image-side numerical aperture, instead of the pupil's diameter
    #[arg(long, conflicts_with = "pupil_mm", allow_hyphen_values = true)]
    pub na: Option<f64>,
    /// Full width at half maximum of the diffuser's scattering, in degrees
    #[arg(long, default_value_t = 1.0, allow_hyphen_values = true)]
    pub diffuser_deg: f64,
}

/// Where the page is, and who opens it.
#[cfg(feature = "view")]
#[derive(Debug, Clone, Default, Args)]
pub struct BrowserArgs {
    /// Port of the page on 127.0.0.1; 0 for any [default: 8787, or the next that is free]
    #[arg(long)]
    pub port: Option<u16>,
    /// Only print the page's address
    #[arg(long)]
    pub no_open: bool,
}
