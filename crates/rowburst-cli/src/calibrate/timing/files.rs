//! Files of `calibrate timing` into values, and the experiment file that comes out.

use super::TimingArgs;
use crate::calibrate::experiment_of;
use rowburst::ErrorKind;
use rowburst::calibrate::timing::{Extension, Lamp, Timing, Waveform};
use rowburst::error::Subject;
use rowburst::{Error, Image, Result, Shutter};
use rowburst_io::{Calibration, Experiment, OutputFolder, read_colour_image, write_npy_i64};
use rowburst_run::calibrate::timing::{KnownRowTime, read_waveform};

/// What the command line asks for, read.
pub struct TimingInputs {
    pub frames: Vec<Image>,
    pub light: Lamp,
    pub dark: Option<Image>,
    pub flat: Option<Image>,
    pub calibration: Calibration,
    pub saturation_counts: Option<f64>,
    /// Of a row of the frames.
    pub expected_row_time_us: Option<f64>,
    pub warnings: Vec<String>,
    experiment: Option<Experiment>,
    /// Rows of the frames in a row of the experiment.
    binning: usize,
}

impl TimingInputs {
    pub fn read(args: &TimingArgs) -> Result<Self> {
        let light = light(args)?;
        let experiment = args
            .experiment
            .as_deref()
            .map(|path| experiment_of(path, &args.frames))
            .transpose()?;
        let camera = experiment.as_ref().map(Experiment::camera).transpose()?;
        let known = experiment
            .as_ref()
            .map(|e| e.calibration.clone())
            .unwrap_or_default();
        let calibration = Calibration {
            dark: args.dark.clone().or(known.dark),
            flat: args.flat.clone().or(known.flat),
            ..Calibration::default()
        };
        let (mut frames, mut end) = (Vec::new(), None);
        for path in &args.frames {
            let capture = read_colour_image(path)?;
            end = capture.format.saturation_limit().or(end);
            frames.push(capture.image);
        }
        let extra = |path: &Option<std::path::PathBuf>| -> Result<Option<Image>> {
            path.as_deref()
                .map(|path| Ok(read_colour_image(path)?.image))
                .transpose()
        };
        let mut warnings = Vec::new();
        let (mut binning, mut expected) = (1, None);
        if let Some(camera) = &camera {
            let known = KnownRowTime::new(camera, frames[0].rows());
            (binning, expected) = (known.binning, known.row_time_us);
            warnings.extend(known.warning);
        }
        let of_sensor = camera.and_then(|c| c.sensor().saturation_counts());
        Ok(Self {
            frames,
            light,
            dark: extra(&calibration.dark)?,
            flat: extra(&calibration.flat)?,
            calibration,
            saturation_counts: of_sensor.or(end),
            expected_row_time_us: expected,
            warnings,
            experiment,
            binning,
        })
    }

    /// The experiment with what was found, and what of it was not.
    pub fn experiment_with(
        &self,
        timing: &Timing,
        folder: &OutputFolder,
    ) -> Option<(Experiment, Vec<String>)> {
        let mut experiment = self.experiment.clone()?;
        let mut notes = Vec::new();
        experiment.params.row_time_us = timing.row_time_us * self.binning as f64;
        if let Some((exposure, _)) = timing.exposure_us {
            experiment.params.exposure_us = exposure;
        }
        let before = &experiment.params.shutter;
        match timing.shutters.as_slice() {
            [only] => experiment.params.shutter = only.clone(),
            several if several.contains(before) => {}
            _ => notes.push(format!(
                "the shutter of the experiment, {}, is not among those that fit the light: it was kept; decide which is right and correct it",
                before.name()
            )),
        }
        match experiment.params.shutter {
            Shutter::Custom(_) => experiment.row_order = Some(folder.path().join("row_order.npy")),
            _ => experiment.row_order = None,
        }
        Some((experiment, notes))
    }

    /// Writes `experiment.toml`, and the order of a custom shutter beside it.
    pub fn write_experiment(&self, folder: &OutputFolder, experiment: &Experiment) -> Result<()> {
        experiment.camera()?;
        if let Shutter::Custom(order) = &experiment.params.shutter {
            let order: Vec<i64> = order.iter().map(|&k| k as i64).collect();
            folder.write("row_order.npy", |w| {
                write_npy_i64(w, &[order.len()], &order)
            })?;
        }
        folder.write_bytes(
            "experiment.toml",
            experiment.to_toml(folder.path()).as_bytes(),
        )
    }
}

fn light(args: &TimingArgs) -> Result<Lamp> {
    match (&args.signal, args.frequency_hz) {
        (Some(path), _) => {
            let extension = if args.repeat {
                Extension::Repeats
            } else {
                Extension::Holds
            };
            let points = read_waveform(path)?;
            let waveform = Waveform::new(&points, extension).map_err(|e| e.within(path))?;
            Ok(Lamp::Waveform(waveform))
        }
        (None, Some(frequency_hz)) => Ok(Lamp::Periodic {
            frequency_hz,
            duty: args.duty,
        }),
        (None, None) => Err(Error::input(
            Subject::named("command line"),
            "no light",
            "the light is given by its frequency or its waveform",
            "Give --frequency-hz F or --signal FILE.csv.",
        )
        .with_kind(ErrorKind::NoSignal)),
    }
}
