//! The options of `rowburst design`, and what they mean.

use crate::option_names;
use crate::shared_args::{ForceArgs, OpticsArgs};
use clap::Args;
use rowburst::camera::CameraParams;
use rowburst::design::LightParams;
use rowburst::simulate::SpeckleOptics;
use rowburst::{Camera, Error, ErrorKind, Parameter, Result, Sensor, Shutter};
use rowburst_io::{Experiment, read_video};
use rowburst_run::design::{DesignInputs, checked_snrs, light_of, paper_camera};
use std::path::PathBuf;

/// What a camera, a lens and a diffuser can do before they are bought.
///
/// Without options: the paper's camera and optics of its size.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  rowburst design -o design\n  then open design/report.html\n  rowburst design --rows 512 --columns 512 --diffuser-deg 4 --photons 1e8 --quick\n  rowburst design --experiment experiment.toml --psf psf.tif --json"
)]
pub struct DesignArgs {
    /// Camera, field and PSF from an experiment file; options take precedence
    #[arg(long)]
    pub experiment: Option<PathBuf>,
    /// A recorded PSF or patch set; without one, speckle of these optics is computed
    #[arg(long)]
    pub psf: Option<PathBuf>,
    /// A video of the scene (.npy, multi-page .tif), fitted to the field: how many numbers of an
    /// instant speak about its change, at the expected SNR
    #[arg(long, value_name = "VIDEO")]
    pub scene: Option<PathBuf>,
    #[command(flatten)]
    pub optics: OpticsArgs,
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub light: LightArgs,
    /// Leave out the trial reconstructions, which take most of a minute
    #[arg(long, visible_alias = "no-map", help_heading = "Run")]
    pub quick: bool,
    /// SNRs of the trial reconstructions, separated by commas [default: 8 to 256, each twice the last]
    #[arg(
        long,
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "quick",
        help_heading = "Run"
    )]
    pub trial_snr: Vec<f64>,
    /// Seed of speckle, scenes and noise
    #[arg(long, default_value_t = 1, help_heading = "Run")]
    pub seed: u64,
    /// Print design.json to standard output instead of a summary
    #[arg(long, help_heading = "Run")]
    pub json: bool,
    /// Folder for report.html, its pictures and design.json [default: none are written]
    #[arg(short, long, help_heading = "Run")]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub force: ForceArgs,
}

/// The camera; what is not given comes from the experiment, or else from the paper.
#[derive(Debug, Args)]
#[command(next_help_heading = "Camera")]
pub struct CameraArgs {
    /// Rows of the frame [paper: 108]
    #[arg(long)]
    pub rows: Option<usize>,
    /// Columns of the frame [paper: 108]
    #[arg(long)]
    pub columns: Option<usize>,
    /// top-down, bottom-up, dual-inside-out, dual-outside-in or global [paper: dual-inside-out]
    #[arg(long)]
    pub shutter: Option<String>,
    /// Time from one read-out to the next in microseconds [paper: 9.6]
    #[arg(long, allow_hyphen_values = true)]
    pub row_time_us: Option<f64>,
    /// Exposure of each row in microseconds [default: a row time]
    #[arg(long, allow_hyphen_values = true)]
    pub exposure_us: Option<f64>,
    /// Video frames in each row time [default: 1]
    #[arg(long)]
    pub bins_per_row: Option<usize>,
    /// Pitch of the pixels in micrometres [paper: 6.5]
    #[arg(long, allow_hyphen_values = true)]
    pub pixel_pitch_um: Option<f64>,
    /// Rows of the field, on the scale of the sensor [default: those of the sensor]
    #[arg(long)]
    pub field_rows: Option<usize>,
    /// Columns of the field [default: those of the sensor]
    #[arg(long)]
    pub field_columns: Option<usize>,
}

/// The light and the sensor's response to it.
#[derive(Debug, Args)]
#[command(next_help_heading = "Light and noise")]
pub struct LightArgs {
    /// Photons of one bright scene pixel in one bin that pass the lens
    #[arg(long, default_value_t = 2e7, allow_hyphen_values = true)]
    pub photons: f64,
    /// Bright pixels of the scene in a bin
    #[arg(long, default_value_t = 10)]
    pub bright_pixels: usize,
    /// Electrons per photon, up to 1
    #[arg(long, default_value_t = 0.6, allow_hyphen_values = true)]
    pub quantum_efficiency: f64,
    /// Read noise in electrons rms [default: the experiment's, or 1.5]
    #[arg(long, allow_hyphen_values = true)]
    pub read_noise_electrons: Option<f64>,
    /// Electrons at which a pixel is full [default: the experiment's, or 30000]
    #[arg(long, allow_hyphen_values = true)]
    pub full_well_electrons: Option<f64>,
    /// Bits of the converter, over the full well [default: the experiment's, or 16]
    #[arg(long)]
    pub bit_depth: Option<u32>,
    /// Full width of the source's spectrum in nanometres
    #[arg(long, default_value_t = 1.0, allow_hyphen_values = true)]
    pub source_bandwidth_nm: f64,
    /// Rms of the optical path through the diffuser in nanometres
    /// [default: 4 radians at the wavelength]
    #[arg(long, allow_hyphen_values = true)]
    pub diffuser_path_rms_nm: Option<f64>,
}

/// Longest side of a sensor or field; the largest chips have 20,000.
const MAX_SIDE: usize = 32_768;

impl DesignArgs {
    /// Options over experiment over the paper's camera.
    pub fn inputs(&self) -> Result<DesignInputs> {
        let experiment = match &self.experiment {
            Some(path) => Some(Experiment::read(path)?),
            None => None,
        };
        let of_file = experiment.as_ref().map(|e| e.params.clone());
        let params = self.params(of_file.unwrap_or_else(paper_camera))?;
        let camera = Camera::new(params).map_err(|e| self.naming_option(e))?;
        let sensor = camera.sensor();
        let from_sensor = light_of(
            &camera,
            self.light.read_noise_electrons,
            self.light.full_well_electrons,
        );
        let light = LightParams {
            photons: self.light.photons,
            bright_pixels: self.light.bright_pixels,
            quantum_efficiency: self.light.quantum_efficiency,
            source_bandwidth_nm: self.light.source_bandwidth_nm,
            diffuser_path_rms_nm: self.light.diffuser_path_rms_nm,
            ..from_sensor
        };
        light.check().map_err(|e| self.naming_option(e))?;
        let trial_snrs = checked_snrs(&self.trial_snr)?;
        let pitch = sensor.pixel_pitch_um;
        let optics = self
            .optics
            .lens()
            .optics(pitch.unwrap_or(SpeckleOptics::demo().pixel_pitch_um));
        optics.check().map_err(|e| self.naming_option(e))?;
        let psf_file = self.psf.clone();
        Ok(DesignInputs {
            camera,
            optics,
            light,
            psf_file: psf_file.or(experiment.and_then(|e| e.calibration.psf)),
            trial_snrs,
            scene: self.scene.as_deref().map(read_video).transpose()?,
            seed: self.seed,
        })
    }

    fn params(&self, base: CameraParams) -> Result<CameraParams> {
        let args = &self.camera;
        let rows = args.rows.unwrap_or(base.rows);
        let columns = args.columns.unwrap_or(base.columns);
        let field = match (args.field_rows, args.field_columns, base.field) {
            (None, None, None) => None,
            (field_rows, field_columns, of_file) => Some((
                field_rows.or(of_file.map(|f| f.0)).unwrap_or(rows),
                field_columns.or(of_file.map(|f| f.1)).unwrap_or(columns),
            )),
        };
        let (field_rows, field_columns) = field.unwrap_or((1, 1));
        for (parameter, side) in [
            (Parameter::Rows, rows),
            (Parameter::Columns, columns),
            (Parameter::FieldRows, field_rows),
            (Parameter::FieldColumns, field_columns),
        ] {
            if side > MAX_SIDE {
                return Err(Error::input(
                    parameter,
                    side,
                    format!("a design has at most {MAX_SIDE} pixels a side"),
                    "Give the part of the sensor that is read.",
                )
                .named(option_names::design_option(parameter)));
            }
        }
        let shutter = match args.shutter.as_deref() {
            None => base.shutter,
            Some("top-down") => Shutter::TopDown,
            Some("bottom-up") => Shutter::BottomUp,
            Some("dual-inside-out") => Shutter::DualInsideOut,
            Some("dual-outside-in") => Shutter::DualOutsideIn,
            Some("global") => Shutter::Global,
            Some(other) => {
                return Err(Error::input(
                    Parameter::Shutter,
                    format!("\"{other}\""),
                    "a shutter is top-down, bottom-up, dual-inside-out, dual-outside-in or global",
                    "Check the name; an order of your own goes into an experiment file (--experiment).",
                ).with_kind(ErrorKind::Unknown).named(option_names::design_option(Parameter::Shutter)));
            }
        };
        let row_time_us = args.row_time_us.unwrap_or(base.row_time_us);
        let of_base = if args.row_time_us.is_some() && self.experiment.is_none() {
            row_time_us
        } else {
            base.exposure_us
        };
        Ok(CameraParams {
            rows,
            columns,
            shutter,
            row_time_us,
            exposure_us: args.exposure_us.unwrap_or(of_base),
            bins_per_row: args.bins_per_row.unwrap_or(base.bins_per_row),
            field,
            sensor: Sensor {
                pixel_pitch_um: args.pixel_pitch_um.or(base.sensor.pixel_pitch_um),
                bit_depth: self.light.bit_depth.or(base.sensor.bit_depth),
                ..base.sensor
            },
        })
    }

    /// Names the option in an error, or the file for a key that it gave.
    pub fn naming_option(&self, error: Error) -> Error {
        let camera = &self.camera;
        let Some(parameter) = error.parameter() else {
            return error;
        };
        let is_of_file = match parameter {
            Parameter::Rows => camera.rows.is_none(),
            Parameter::Columns => camera.columns.is_none(),
            Parameter::RowTimeUs => camera.row_time_us.is_none(),
            Parameter::ExposureUs => camera.exposure_us.is_none(),
            Parameter::BinsPerRow => camera.bins_per_row.is_none(),
            Parameter::PixelPitchUm => camera.pixel_pitch_um.is_none(),
            Parameter::BitDepth => self.light.bit_depth.is_none(),
            Parameter::Field => camera.field_rows.is_none() && camera.field_columns.is_none(),
            Parameter::ReadNoiseElectrons => self.light.read_noise_electrons.is_none(),
            Parameter::RowOrder
            | Parameter::TriggerDelayUs
            | Parameter::Binning
            | Parameter::GainElectronsPerCount
            | Parameter::FullWellCounts
            | Parameter::BiasCounts => true,
            _ => false,
        };
        if let Some(path) = self.experiment.as_ref().filter(|_| is_of_file) {
            return error.within(path);
        }
        match parameter {
            Parameter::Aperture if self.optics.na.is_some() => error.named("--na"),
            Parameter::NonZeroPixels | Parameter::SuccessMap => error,
            parameter => error.named(option_names::design_option(parameter)),
        }
    }

    /// The command line that repeats the run.
    pub fn command_line(&self) -> String {
        // What was typed, but for the way to the program.
        let typed = crate::typed(Vec::new()).iter().skip(1);
        let typed: Vec<_> = typed.map(|word| word.to_string_lossy()).collect();
        format!("rowburst {}", typed.join(" "))
    }
}
