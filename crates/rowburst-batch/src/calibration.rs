//! One correction of PSF and camera for all frames, found from a few of them together.
//!
//! It is found once and kept in the job: the same for all processes that work on it, and after every kill. So every
//! process takes it from the files, also the one that found it.

use crate::inputs::BatchInputs;
use crate::measurement::read_measurement;
use rowburst::error::Subject;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{Calibration, Model, ModelParameter, calibrate};
use rowburst::solve::StopReason;
use rowburst::{Cancel, Error, Image, Psf, Result};
use rowburst_io::{read_image, write_npy_image};
use rowburst_run::CalibrationNumbers;
use rowburst_zarr::Scratch;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::ops::ControlFlow;
use std::path::Path;

/// Frames that the correction is found from; more find more and take longer.
const FRAMES: usize = 4;

const PSF: &str = "psf-corrected.npy";
const GAIN: &str = "pixel-gain.npy";
const OFFSET: &str = "pixel-offset.npy";

/// `calibration.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct CalibrationFile {
    /// The frames that were looked at.
    pub frames: Vec<usize>,
    /// What was found, as in `result.json`; null: PSF and camera are used as given.
    pub self_calibration: Option<Value>,
}

/// PSF and camera of all frames.
pub(crate) struct RecordingCalibration {
    pub file: CalibrationFile,
    pub model: Model,
    /// Gain and offset of each pixel.
    pixels: Option<(Image, Image)>,
}

impl RecordingCalibration {
    /// That of the folder; `None`: it was not looked for yet.
    pub fn read(
        inputs: &BatchInputs,
        folder: &Path,
        file: Option<CalibrationFile>,
    ) -> Result<Option<Self>> {
        let Some(file) = file else {
            return Ok(None);
        };
        if file.self_calibration.is_none() {
            return Ok(Some(Self::as_given(inputs, file)));
        }
        let image = |name: &str| -> Result<Image> { Ok(read_image(&folder.join(name))?.image) };
        let psf = Psf::new(image(PSF)?)?;
        let found = &file.self_calibration;
        let value = |parameter: ModelParameter| {
            let value = found.as_ref()?.get(parameter.name())?.get("value")?;
            value.as_f64()
        };
        let timing = ModelParameter::timing(|parameter| value(parameter).unwrap_or(0.0));
        Ok(Some(Self {
            file,
            model: Model::new(&inputs.model.camera().retimed(timing), &psf).with_cached_gram(),
            pixels: Some((image(GAIN)?, image(OFFSET)?)),
        }))
    }

    /// PSF and camera as given.
    pub fn as_given(inputs: &BatchInputs, file: CalibrationFile) -> Self {
        Self {
            file,
            model: inputs.model.clone(),
            pixels: None,
        }
    }

    /// Looks for a correction on a few frames, and writes it; `None` where it was stopped.
    pub fn find(
        inputs: &BatchInputs,
        folder: &Path,
        scratch: &Scratch,
        cancel: &Cancel,
    ) -> Result<Option<CalibrationFile>> {
        let is_asked_for = !inputs.options.self_calibration.is_off()
            && inputs.budget.is_none()
            && inputs.model.psfs().psfs().len() == 1;
        let mut frames = Vec::new();
        let mut found = None;
        if is_asked_for {
            let count = inputs.frames.count();
            let spread = FRAMES.min(count);
            let picked = (0..spread).map(|i| i * (count - 1) / (spread - 1).max(1));
            let mut measurements: Vec<Measurement> = Vec::new();
            for frame in picked {
                // A frame that cannot be read gets its line when its turn comes.
                if let Ok((_, measurement)) = read_measurement(inputs, frame) {
                    frames.push(frame);
                    measurements.push(measurement);
                }
            }
            let model = inputs.model.clone().with_cancel(cancel);
            let looked = calibrate(&model, &measurements, inputs.options, &mut |_| {
                if cancel.is_cancelled() {
                    ControlFlow::Break(StopReason::Interrupted)
                } else {
                    ControlFlow::Continue(())
                }
            });
            if cancel.is_cancelled() {
                return Ok(None);
            }
            found = looked?;
        }
        let numbers = found.as_ref().map(CalibrationNumbers::new);
        if let Some(calibration) = &found {
            write(inputs, folder, scratch, calibration)?;
        }
        Ok(Some(CalibrationFile {
            frames,
            self_calibration: numbers
                .map(|numbers| serde_json::to_value(numbers).expect("plain numbers")),
        }))
    }

    /// A frame as an ideal camera would have measured it.
    pub fn corrected(&self, measurement: Measurement) -> Measurement {
        match &self.pixels {
            None => measurement,
            Some((gain, offset)) => measurement.adjusted(gain.data(), offset.data()),
        }
    }
}

/// Writes PSF, gain and offset.
fn write(
    inputs: &BatchInputs,
    folder: &Path,
    scratch: &Scratch,
    calibration: &Calibration,
) -> Result<()> {
    let camera = inputs.model.camera();
    let (rows, columns) = (camera.sensor_rows().count(), camera.columns());
    let pixels = |values: &[f32]| Image::new(rows, columns, values.to_vec());
    let images = [
        (PSF, calibration.psfs.central().image().clone()),
        (GAIN, pixels(&calibration.gain)?),
        (OFFSET, pixels(&calibration.offset)?),
    ];
    for (name, image) in images {
        let mut bytes = Vec::new();
        write_npy_image(&mut bytes, &image)
            .map_err(|error| Error::work(Subject::named(name), error, "Run it again."))?;
        scratch.put(&folder.join(name), &bytes)?;
    }
    Ok(())
}
