//! `rowburst calibrate psf`: captures of a point source in, a PSF and its quality out.

mod captures;
mod run;

use crate::shared_args::ForceArgs;
use clap::Args;
use std::path::PathBuf;

pub use run::run;

/// PSF and its quality from captures of a point source; patches from several positions.
///
/// Captures of one position are averaged, or merged if --exposures-ms says that their exposures differ.
/// With --positions-mm each file has its own position.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst calibrate psf point.tif --dark dark.tif -o psf\n  rowburst calibrate psf scan/ --positions-mm scan.csv --experiment experiment.toml -o psf\n  then open psf/report.html\n\nscan.csv has a line capture,x_mm,y_mm for each file, such as\n  0.bmp,0.00,0"
)]
pub struct PsfArgs {
    /// Captures of a point source: files (.npy, .tif, .png, .bmp, .h5, .mat, .fits; stacks too) or
    /// folders of them
    #[arg(required = true)]
    pub captures: Vec<PathBuf>,
    /// A frame without light [default: the experiment's, or the darkest parts of the captures]
    #[arg(long)]
    pub dark: Option<PathBuf>,
    /// Exposure of each capture in milliseconds, if they differ: 1,10,100
    #[arg(
        long,
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "positions_mm"
    )]
    pub exposures_ms: Vec<f64>,
    /// Positions of the source: a file with lines capture,x_mm,y_mm
    #[arg(long)]
    pub positions_mm: Option<PathBuf>,
    /// Raw pixels along a side of one pixel of the working grid [default: the experiment's, or 1]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=64))]
    pub binning: Option<u16>,
    /// Counts from which on a pixel is saturated [default: the experiment's, or the file's end]
    #[arg(long, allow_hyphen_values = true)]
    pub saturation_counts: Option<f64>,
    /// The experiment that the PSF is for: it gives sensor and field, and a copy with the PSF is
    /// written
    #[arg(long)]
    pub experiment: Option<PathBuf>,
    /// Size of the field in pixels of the working grid, such as 216x216 [default: the
    /// experiment's, or the span of the positions]
    #[arg(long, value_name = "ROWSxCOLUMNS", value_parser = parse_field)]
    pub field: Option<(usize, usize)>,
    /// Diffraction-limited grain λz/D in pixels, to compare with
    #[arg(long, allow_hyphen_values = true)]
    pub expected_grain_px: Option<f64>,
    /// Diameter of the pinhole in µm: its blur is removed. Its image on the sensor is known from the
    /// experiment's pixel_pitch_um and magnification, or from --positions-mm
    #[arg(long, allow_hyphen_values = true)]
    pub pinhole_um: Option<f64>,
    /// Make a patch of every position, not only of as many as the field needs
    #[arg(long)]
    pub all_patches: bool,
    /// Print psf.json to standard output instead of a summary
    #[arg(long)]
    pub json: bool,
    /// Folder for psf.npy, psf.json, the report and the patches
    #[arg(short, long)]
    pub output: PathBuf,
    #[command(flatten)]
    pub force: ForceArgs,
}

fn parse_field(text: &str) -> Result<(usize, usize), String> {
    let sides = text.split_once(['x', '×', 'X']);
    let sides = sides.and_then(|(r, c)| Some((r.trim().parse().ok()?, c.trim().parse().ok()?)));
    match sides {
        Some((rows, columns)) if rows > 0 && columns > 0 => Ok((rows, columns)),
        _ => Err("a field is ROWSxCOLUMNS in pixels, such as 216x216".into()),
    }
}
