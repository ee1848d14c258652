//! What the frames of an experiment share, and a frame as a [`Task`].

use crate::event::{Event, Observer};
use crate::inputs::{
    naming_file, psf_path, read_capture, read_corrections_until, read_psfs, resolve_calibration,
};
use crate::options::UserOptions;
use crate::plausibility::{check_camera, check_frame};
use crate::task::Task;
use rowburst::camera::CameraParams;
use rowburst::measurement::{Corrections, Measurement, correct};
use rowburst::reconstruct::Options;
use rowburst::{Camera, Cancel, Error, Parameter, PatchSet, Result, Sensor};
use rowburst_io::{Calibration, Capture, Experiment, FromMetadata, SampleFormat};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// What the frames of an experiment share: camera, PSFs, corrections and options, as values.
#[derive(Clone)]
pub struct Setup {
    /// The camera.
    pub camera: Camera,
    /// The PSF, or one PSF for each patch of the field.
    pub psfs: PatchSet,
    /// Dark, flat and bad pixels. The level of saturation is that of each frame.
    pub corrections: Corrections,
    /// The options of the reconstruction.
    pub options: Options,
    /// Limit of the time for set-up and solver together; `None`: no limit.
    pub budget: Option<Duration>,
    /// The values of the camera that came from the metadata of the frame's file.
    pub from_metadata: FromMetadata,
    /// The experiment file, which errors name.
    pub experiment: Option<PathBuf>,
    /// The files of the corrections, which errors name.
    pub calibration: Calibration,
    /// Stops the runs.
    pub cancel: Cancel,
}

/// A frame as it was recorded.
pub struct Frame {
    /// Its pixels.
    pub capture: Capture,
    /// Whether the bias of the camera is in the pixels.
    pub bias: Bias,
    /// Its file, which errors name.
    pub file: Option<PathBuf>,
}

/// Whether the bias of the camera is in the pixels of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bias {
    /// It is, and the corrections subtract it.
    Contained,
    /// It has been subtracted, unless a dark says otherwise.
    Subtracted,
}

impl Frame {
    /// Reads a recorded frame.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn read(path: &Path) -> Result<Self> {
        Ok(Self {
            capture: read_capture(path)?,
            bias: Bias::Contained,
            file: Some(path.into()),
        })
    }
}

impl Setup {
    /// Camera and PSF without corrections, with the default options.
    pub fn new(camera: Camera, psfs: PatchSet) -> Self {
        Self {
            camera,
            psfs,
            corrections: Corrections::default(),
            options: Options::default(),
            budget: None,
            from_metadata: FromMetadata::default(),
            experiment: None,
            calibration: Calibration::default(),
            cancel: Cancel::default(),
        }
    }

    /// Reads the files of the corrections and the PSFs: each of `given`, or else that of `experiment`. `cancel` stops it
    /// between two files, and later the run.
    ///
    /// # Errors
    /// Options that do not exist, no PSF, a file that cannot be read, or a cancelled run.
    pub fn read(
        experiment: &Experiment,
        given: Calibration,
        options: &UserOptions,
        cancel: &Cancel,
        observer: Observer,
    ) -> Result<Self> {
        let warnings = check_camera(&experiment.params).map_err(|e| e.within(&experiment.path))?;
        let camera = experiment.camera()?;
        let (options, budget) = options.resolve(experiment)?;
        let calibration = resolve_calibration(given, experiment);
        let psf_path = psf_path(&calibration, experiment)?;
        let corrections = read_corrections_until(&calibration, cancel)?;
        cancel.check()?;
        let (psfs, note) = read_psfs(psf_path, &camera, corrections.dark.as_ref())?;
        if let Some(note) = note {
            let _ = observer(Event::Note(&note));
        }
        psfs.check_contrast().map_err(|e| e.within(psf_path))?;
        let mut from_metadata = experiment.from_metadata.clone();
        from_metadata.warnings.extend(warnings);
        Ok(Self {
            camera,
            psfs,
            corrections,
            options,
            budget,
            from_metadata,
            experiment: Some(experiment.path.clone()),
            calibration,
            cancel: cancel.clone(),
        })
    }

    /// Corrects a frame.
    ///
    /// # Errors
    /// Those of [`correct`], with the file at fault.
    pub fn measurement(&self, frame: &Frame) -> Result<Measurement> {
        let Frame { capture, bias, .. } = frame;
        let corrected = correct_capture(capture, *bias, &self.camera, &self.corrections);
        corrected.map_err(|error| self.naming(error, frame))
    }

    /// The task of reconstructing `frame`, or the given bins of its video.
    ///
    /// # Errors
    /// Those of [`Self::measurement`] and [`Camera::subset`].
    pub fn task(mut self, frame: &Frame, bins: Option<Range<usize>>) -> Result<Task> {
        if self.experiment.is_none() {
            // That of a file has been checked when it was read.
            self.from_metadata
                .warnings
                .extend(check_camera(self.camera.params())?);
        }
        let checked = check_frame(&frame.capture, &self.camera, &self.psfs);
        let warnings = checked.map_err(|error| self.naming(error, frame))?;
        self.from_metadata.warnings.extend(warnings);
        let mut measurement = self.measurement(frame)?;
        let mut camera = self.camera;
        if let Some(bins) = bins {
            camera = camera.subset(bins)?;
            let rows: Vec<usize> = camera.sensor_rows().collect();
            measurement = measurement.select_rows(&rows);
        }
        Ok(Task {
            camera,
            psfs: self.psfs,
            measurement,
            options: self.options,
            budget: self.budget,
            truth: None,
            truth_file: None,
            direct: None,
            guide: None,
            seed: 0,
            from_metadata: self.from_metadata,
            cancel: self.cancel,
        })
    }

    /// Names the file, or else the input, that is at fault in an error of the corrections.
    pub(crate) fn naming(&self, error: Error, frame: &Frame) -> Error {
        if let (Some(Parameter::Psf), Some(file)) = (error.parameter(), &self.calibration.psf) {
            return error.within(file);
        }
        if let Some(file) = &frame.file {
            return naming_file(error, file, &self.calibration);
        }
        match error.parameter() {
            Some(
                Parameter::Psf
                | Parameter::Frame
                | Parameter::Dark
                | Parameter::Flat
                | Parameter::BadPixels,
            ) => error,
            _ => error.within("frame"),
        }
    }
}

/// Corrects a capture. It is saturated where its kind of numbers or the sensor ends.
///
/// # Errors
/// Those of [`correct`].
pub fn correct_capture(
    capture: &Capture,
    bias: Bias,
    camera: &Camera,
    corrections: &Corrections,
) -> Result<Measurement> {
    let mut corrections = Corrections {
        saturation_counts: capture.format.saturation_limit(),
        ..corrections.clone()
    };
    let subtracted = match bias {
        Bias::Subtracted if corrections.dark.is_none() => camera.sensor().bias_counts,
        Bias::Subtracted | Bias::Contained => None,
    };
    let Some(bias) = subtracted.filter(|bias| *bias > 0.0) else {
        return correct(&capture.image, camera, &corrections);
    };
    if let Some(flat) = &mut corrections.flat {
        flat.data_mut().iter_mut().for_each(|p| *p -= bias as f32);
    }
    correct(&capture.image, &without_bias(camera, bias)?, &corrections)
}

/// The camera of frames from which `bias` has been subtracted: it saturates that much earlier.
fn without_bias(camera: &Camera, bias: f64) -> Result<Camera> {
    let params = camera.params().clone();
    let saturation_counts = params.sensor.saturation_counts();
    Camera::new(CameraParams {
        sensor: Sensor {
            bias_counts: None,
            full_well_counts: saturation_counts
                .map(|counts| counts - bias)
                .filter(|counts| *counts > 0.0),
            ..params.sensor
        },
        ..params
    })
}

/// Whether an array of `format` is free of the bias: a sensor gives integers, and who has floating-point numbers has
/// subtracted it.
pub fn bias_of_array(format: SampleFormat) -> Bias {
    match format {
        SampleFormat::Counts { .. } => Bias::Contained,
        SampleFormat::Float => Bias::Subtracted,
    }
}
