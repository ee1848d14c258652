//! The frame under one model of PSF and camera after another.

use super::super::frame_data::FrameData;
use super::super::held_out_check::HeldOutRun;
use super::super::{Model, Prior, RunResult, choose};
use super::parameters::{Parameter, Parameters};
use super::psf_model::PsfModel;
use crate::linop::LinearOperator;
use crate::measurement::Measurement;
use crate::solve::admm::{Progress, TauRule};
use crate::{Camera, PatchSet, Psf, RollingShutter};

/// The label of the runs of self-calibration.
const LABEL: &str = "self-calibration";

/// Smallest gain of a pixel; smaller amplifies noise.
const MIN_GAIN: f64 = 0.1;

/// PSF and camera as corrected so far.
#[derive(Debug, Clone)]
pub(super) struct Correction {
    pub parameters: Parameters,
    /// The PSF in place of that of `parameters`; `None`: it was not refined.
    pub refined: Option<Psf>,
    /// Stray counts of each row of the frame.
    pub row_offsets: Vec<f64>,
}

impl Correction {
    /// Whether rows have stray light of their own.
    pub fn has_row_offsets(&self) -> bool {
        self.row_offsets.iter().any(|o| *o != 0.0)
    }
}

/// The frame with what its model is made from.
pub(super) struct Calibrator<'p> {
    camera: &'p Camera,
    /// The frame without foreign pixels.
    measurement: Measurement,
    models: Vec<PsfModel>,
    offsets_px: Vec<(f64, f64)>,
    prior: Prior,
    /// Mean of the frame, in counts.
    mean: f64,
    /// Which set of pixels is held out.
    held_out_set: u64,
}

/// A reconstruction under one model, without the held-out pixels.
pub(super) struct Trial {
    pub data: FrameData,
    pub video: Vec<f32>,
    /// Root mean square of the weighted residual.
    pub residual_rms: f64,
    /// Weighted residuals of the held-out pixels.
    pub held_out: Vec<f64>,
}

impl<'p> Calibrator<'p> {
    pub fn new(
        camera: &'p Camera,
        psfs: &PatchSet,
        measurement: Measurement,
        prior: Prior,
    ) -> Self {
        let values = measurement.image().data();
        let weight = |i: usize| measurement.weights().is_none_or(|w| w[i] > 0.0);
        let usable = (0..values.len()).filter(|&i| weight(i));
        let (sum, count) = usable.fold((0.0, 0usize), |(sum, count), i| {
            (sum + f64::from(values[i]), count + 1)
        });
        Self {
            camera,
            mean: sum / count.max(1) as f64,
            measurement,
            models: psfs.psfs().iter().map(PsfModel::new).collect(),
            offsets_px: psfs.offsets_px().to_vec(),
            prior,
            held_out_set: 0,
        }
    }

    /// Holds other pixels out from now on than before.
    pub fn hold_out_others(&mut self) {
        self.held_out_set = 1;
    }

    /// PSF and camera as given.
    pub fn uncorrected(&self) -> Correction {
        Correction {
            parameters: Parameters::default(),
            refined: None,
            row_offsets: vec![0.0; self.measurement.image().rows()],
        }
    }

    /// Mean of the frame, in counts.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// The PSFs under `correction`.
    pub fn psfs(&mut self, correction: &Correction) -> PatchSet {
        match &correction.refined {
            Some(refined) => PatchSet::from(refined),
            None => self.model_psfs(&correction.parameters),
        }
    }

    /// The PSFs with `parameters`, not refined.
    pub fn model_psfs(&mut self, parameters: &Parameters) -> PatchSet {
        let psfs: Vec<Psf> = self.models.iter_mut().map(|m| m.psf(parameters)).collect();
        PatchSet::new(psfs, self.offsets_px.clone()).expect("the offsets of a patch set")
    }

    /// Gain and offset in counts of every pixel.
    fn pixels(&self, correction: &Correction) -> (Vec<f32>, Vec<f32>) {
        let pixels = self.measurement.image().data().len();
        let (mut gain, mut offset) = (vec![1.0; pixels], vec![0.0; pixels]);
        for parameter in Parameter::ALL.into_iter().filter(|p| !p.is_of_psf()) {
            let value = correction.parameters[parameter];
            if value == 0.0 {
                continue;
            }
            let (target, scale) = match parameter {
                Parameter::Vignetting => (&mut gain, value),
                _ => (&mut offset, value * self.mean),
            };
            for (at, target) in target.iter_mut().enumerate() {
                *target += scale * self.pattern(parameter, at);
            }
        }
        let columns = self.measurement.image().columns();
        for (row, line) in offset.chunks_exact_mut(columns).enumerate() {
            line.iter_mut()
                .for_each(|o| *o += correction.row_offsets[row]);
        }
        let single = |values: Vec<f64>| values.iter().map(|&v| v as f32).collect();
        gain.iter_mut().for_each(|g: &mut f64| *g = g.max(MIN_GAIN));
        (single(gain), single(offset))
    }

    /// How `parameter` changes the pixel `at`.
    fn pattern(&self, parameter: Parameter, at: usize) -> f64 {
        let image = self.measurement.image();
        let place = |at: usize, length: usize| {
            let centre = (length as f64 - 1.0) / 2.0;
            (at as f64 - centre) / (length as f64 / 2.0)
        };
        let y = place(at / image.columns(), image.rows());
        let x = place(at % image.columns(), image.columns());
        match parameter {
            Parameter::SlopeX => x,
            Parameter::SlopeY => y,
            Parameter::Vignetting => (x * x + y * y) / 2.0,
            _ => 1.0,
        }
    }

    /// The frame of an ideal camera.
    pub fn measurement(&self, correction: &Correction) -> Measurement {
        self.corrected(&self.measurement, correction)
    }

    /// `measurement` of the same frame as if by an ideal camera.
    pub fn corrected(&self, measurement: &Measurement, correction: &Correction) -> Measurement {
        let (gain, offset) = self.pixels(correction);
        measurement.adjusted(&gain, &offset)
    }

    /// Operator and frame under `correction`, without the held-out pixels.
    pub fn data(&mut self, correction: &Correction) -> FrameData {
        let model = Model::new(self.camera, self.psfs(correction));
        let mut data = FrameData::new(&model, &self.measurement(correction));
        let held_out = data.held_out_set(self.held_out_set);
        data.reset(self.prior.background(), Some(held_out));
        data
    }

    /// Reconstructs at the noise level `sigma`, in at most `iterations`. The error is the result so far of a run that the
    /// observer stopped.
    pub fn run(
        &mut self,
        correction: &Correction,
        sigma: f64,
        iterations: usize,
        observer: &mut choose::Observer,
    ) -> Result<Trial, Box<RunResult>> {
        let mut data = self.data(correction);
        let mut run = HeldOutRun::new(&mut data, self.prior, TauRule::Discrepancy { sigma }, None);
        let mut labelled = |progress: &Progress| {
            observer(&Progress {
                label: LABEL,
                max_iterations: iterations,
                ..*progress
            })
        };
        run.run(&mut data, iterations, &mut labelled)?;
        let video = run.admm.video().to_vec();
        Ok(Trial {
            held_out: data.held_out_residuals(&video),
            residual_rms: run.residual_rms(),
            video,
            data,
        })
    }

    /// How the corrected frame of `video` changes with `parameter`, in counts.
    pub fn derivative(
        &mut self,
        correction: &Correction,
        parameter: Parameter,
        video: &[f32],
        light: &[f32],
    ) -> Vec<f32> {
        if parameter.is_of_psf() {
            let step = parameter.step();
            let mut at = |sign: f64| {
                let mut parameters = correction.parameters;
                parameters[parameter] += sign * step;
                let shutter = RollingShutter::new(self.camera, self.model_psfs(&parameters));
                let mut light = vec![0.0; light.len()];
                shutter.apply(video, &mut light);
                light
            };
            let pairs = at(1.0).into_iter().zip(at(-1.0));
            return pairs
                .map(|(more, less)| ((f64::from(more) - f64::from(less)) / (2.0 * step)) as f32)
                .collect();
        }
        let (gain, _) = self.pixels(correction);
        let of = |at: usize| {
            let scale = match parameter {
                Parameter::Vignetting => f64::from(light[at]),
                _ => self.mean,
            };
            (scale * self.pattern(parameter, at) / f64::from(gain[at])) as f32
        };
        (0..light.len()).map(of).collect()
    }

    /// How a count of stray light changes each pixel of the corrected frame.
    pub fn offset_derivative(&self, correction: &Correction) -> Vec<f32> {
        self.pixels(correction).0.iter().map(|g| 1.0 / g).collect()
    }
}
