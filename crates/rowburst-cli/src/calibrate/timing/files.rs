//! Files of `calibrate timing` into values.

use super::TimingArgs;
use crate::calibrate::experiment_of;
use rowburst::calibrate::timing::{Extension, Lamp, Waveform};
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Image, Result};
use rowburst_io::{Calibration, Experiment, read_colour_image};
use rowburst_run::calibrate::timing::{TimingInputs, read_waveform};

/// What the command line asks for, read.
pub struct TimingFiles {
    pub inputs: TimingInputs,
    pub calibration: Calibration,
    pub experiment: Option<Experiment>,
}

impl TimingFiles {
    pub fn read(args: &TimingArgs) -> Result<Self> {
        let light = light(args)?;
        let experiment = args
            .experiment
            .as_deref()
            .map(|path| experiment_of(path, &args.frames))
            .transpose()?;
        let known = experiment.as_ref().map(|e| e.calibration.clone());
        let known = known.unwrap_or_default();
        let calibration = Calibration {
            dark: args.dark.clone().or(known.dark),
            flat: args.flat.clone().or(known.flat),
            ..Calibration::default()
        };
        let (mut frames, mut saturation_limit) = (Vec::new(), None);
        for path in &args.frames {
            let capture = read_colour_image(path)?;
            saturation_limit = capture.format.saturation_limit().or(saturation_limit);
            frames.push(capture.image);
        }
        let extra = |path: &Option<std::path::PathBuf>| -> Result<Option<Image>> {
            path.as_deref()
                .map(|path| Ok(read_colour_image(path)?.image))
                .transpose()
        };
        let inputs = TimingInputs {
            frames,
            light,
            dark: extra(&calibration.dark)?,
            flat: extra(&calibration.flat)?,
            saturation_limit,
            camera: experiment.as_ref().map(Experiment::camera).transpose()?,
        };
        Ok(Self {
            inputs,
            calibration,
            experiment,
        })
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
