//! Frames under one model of PSF and camera after another.

use super::super::frame_data::FrameData;
use super::super::held_out::HeldOut;
use super::super::held_out_run::HeldOutRun;
use super::super::{Model, Observer, Prior, RunResult, SolverSettings};
use super::parameters::{ModelParameter, Parameters};
use super::psf_model::PsfModel;
use rowburst_core::Cancel;
use rowburst_core::linop::LinearOperator;
use rowburst_optics::forward::psf_map::PsfMap;
use rowburst_optics::measurement::Measurement;
use rowburst_optics::{Camera, PatchSet, Psf, RollingShutter, Shutter};
use rowburst_solve::admm::{Progress, TauRule};
use tracing::debug;

/// The label of the runs of self-calibration.
const LABEL: &str = "self-calibration";

/// Smallest gain of a pixel; smaller amplifies noise.
const MIN_GAIN: f64 = 0.1;

/// PSF and camera as corrected so far.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Correction {
    pub parameters: Parameters,
    /// The PSF in place of that of `parameters`; `None`: it was not refined.
    pub refined: Option<Psf>,
    /// Stray counts of each row of the frame.
    pub row_offsets: Vec<f64>,
}

impl Correction {
    /// The same without the parameters that are negligible.
    pub fn without_negligible(&self) -> Self {
        let mut correction = self.clone();
        for parameter in ModelParameter::ALL {
            if correction.parameters[parameter].abs() <= parameter.negligible() {
                correction.parameters[parameter] = 0.0;
            }
        }
        correction
    }

    /// Whether it changes nothing.
    pub fn is_identity(&self) -> bool {
        self.parameters == Parameters::default()
            && self.refined.is_none()
            && !self.has_row_offsets()
    }

    /// Whether rows have stray light of their own.
    pub fn has_row_offsets(&self) -> bool {
        self.row_offsets.iter().any(|o| *o != 0.0)
    }
}

/// A frame of the calibration.
struct Frame {
    /// The frame without foreign pixels.
    measurement: Measurement,
    /// The same without the pixels that judge and that confirm.
    fitted: Measurement,
    judging: Vec<usize>,
    confirming: Vec<usize>,
}

impl Frame {
    fn new(shutter: &RollingShutter, measurement: Measurement) -> Self {
        let judging = HeldOut::draw(shutter, measurement.weights(), 0);
        let without = |measurement: &Measurement, pixels: &[usize]| {
            let mut is_left_out = vec![false; measurement.image().data().len()];
            pixels.iter().for_each(|&i| is_left_out[i] = true);
            measurement.without(&is_left_out)
        };
        let others = without(&measurement, judging.pixels());
        let confirming = HeldOut::draw(shutter, others.weights(), 1);
        Self {
            fitted: without(&others, confirming.pixels()),
            judging: judging.pixels().to_vec(),
            confirming: confirming.pixels().to_vec(),
            measurement,
        }
    }
}

/// Frames of one camera with what their model is made from.
pub(super) struct Calibrator<'p> {
    camera: &'p Camera,
    cancel: &'p Cancel,
    frames: Vec<Frame>,
    /// The PSFs as given.
    given: &'p PatchSet,
    models: Vec<PsfModel>,
    prior: Prior,
    /// Mean of the frames, in counts.
    mean: f64,
    /// For each row -0.5 in the upper half of the sensor, 0.5 in the lower.
    halves: Vec<f64>,
}

/// A reconstruction of a frame under one model, without the pixels that judge and that confirm.
pub(super) struct Trial {
    frame: usize,
    pub data: FrameData,
    pub video: Vec<f32>,
    /// Root mean square of the weighted residual.
    pub residual_rms: f64,
    /// Weighted residuals of the judging pixels, which choose among corrections.
    pub judging: Vec<f64>,
    /// Weighted residuals of the confirming pixels, which no search has seen.
    pub confirming: Vec<f64>,
}

impl<'p> Calibrator<'p> {
    /// The PSFs `given` are corrected from `anchor` on, which is free of the noise outside the optics' pass band.
    pub fn new(
        shutter: &RollingShutter,
        camera: &'p Camera,
        cancel: &'p Cancel,
        given: &'p PatchSet,
        anchor: Option<&Psf>,
        measurements: &[Measurement],
        prior: Prior,
    ) -> Self {
        let (mut sum, mut count) = (0.0, 0usize);
        for measurement in measurements {
            for (i, value) in measurement.image().data().iter().enumerate() {
                if measurement.weights().is_none_or(|w| w[i] > 0.0) {
                    sum += f64::from(*value);
                    count += 1;
                }
            }
        }
        let frames = measurements.iter();
        let middle = camera.params().rows / 2;
        Self {
            camera,
            cancel,
            halves: camera
                .sensor_rows()
                .map(|row| if row < middle { -0.5 } else { 0.5 })
                .collect(),
            mean: sum / count.max(1) as f64,
            frames: frames
                .map(|measurement| Frame::new(shutter, measurement.clone()))
                .collect(),
            given,
            models: match anchor {
                Some(anchor) => vec![PsfModel::new(anchor)],
                None => given.psfs().iter().map(PsfModel::new).collect(),
            },
            prior,
        }
    }

    /// The PSFs as given.
    pub fn given_psfs(&self) -> &PatchSet {
        self.given
    }

    /// Number of frames.
    pub fn frame_count(&self) -> usize {
        self.frames.len()
    }

    /// PSF and camera without a correction.
    pub fn uncorrected(&self) -> Correction {
        Correction {
            parameters: Parameters::default(),
            refined: None,
            row_offsets: vec![0.0; self.image().rows()],
        }
    }

    /// PSF and camera as given, with the noise of the PSF's capture.
    pub fn given(&self) -> Correction {
        Correction {
            refined: match self.given.psfs() {
                [psf] => Some(psf.clone()),
                _ => None,
            },
            ..self.uncorrected()
        }
    }

    fn image(&self) -> &rowburst_optics::Image {
        self.frames[0].measurement.image()
    }

    /// Whether all rows see the scene at the same time: the video is one picture.
    pub fn is_one_picture(&self) -> bool {
        *self.camera.shutter() == Shutter::Global
    }

    /// Mean of the frames, in counts.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Root mean square of the frames less the means of their rows, in counts.
    pub fn contrast(&self) -> f64 {
        let (mut power, mut count) = (0.0, 0usize);
        for Frame { measurement, .. } in &self.frames {
            let image = measurement.image();
            for (row, line) in image.data().chunks_exact(image.columns()).enumerate() {
                let first = row * image.columns();
                let is_usable = |x: &usize| {
                    let weights = measurement.weights();
                    weights.is_none_or(|w| w[first + x] > 0.0)
                };
                let usable: Vec<f64> = (0..line.len())
                    .filter(is_usable)
                    .map(|x| f64::from(line[x]))
                    .collect();
                let mean = usable.iter().sum::<f64>() / usable.len().max(1) as f64;
                power += usable.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
                count += usable.len();
            }
        }
        (power / count.max(1) as f64).sqrt()
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
        PatchSet::new(psfs, self.given.offsets_px().to_vec()).expect("the offsets of a patch set")
    }

    /// Gain and offset in counts of every pixel, `[y, x]`.
    pub fn pixels(&self, correction: &Correction) -> (Vec<f32>, Vec<f32>) {
        let pixels = self.image().data().len();
        let (mut gain, mut offset) = (vec![1.0; pixels], vec![0.0; pixels]);
        let of_pixels = |p: &ModelParameter| !p.is_of_psf() && !p.is_of_timing();
        for parameter in ModelParameter::ALL.into_iter().filter(of_pixels) {
            let value = correction.parameters[parameter];
            if value == 0.0 {
                continue;
            }
            let (target, scale) = match parameter {
                ModelParameter::Vignetting | ModelParameter::HalfGain => (&mut gain, value),
                _ => (&mut offset, value * self.mean),
            };
            for (at, target) in target.iter_mut().enumerate() {
                *target += scale * self.pattern(parameter, at);
            }
        }
        let columns = self.image().columns();
        for (row, line) in offset.chunks_exact_mut(columns).enumerate() {
            line.iter_mut()
                .for_each(|o| *o += correction.row_offsets[row]);
        }
        let single = |values: Vec<f64>| values.iter().map(|&v| v as f32).collect();
        gain.iter_mut().for_each(|g: &mut f64| *g = g.max(MIN_GAIN));
        (single(gain), single(offset))
    }

    /// How `parameter` changes the pixel `at`.
    fn pattern(&self, parameter: ModelParameter, at: usize) -> f64 {
        let image = self.image();
        let place = |at: usize, length: usize| {
            let centre = (length as f64 - 1.0) / 2.0;
            (at as f64 - centre) / (length as f64 / 2.0)
        };
        let y = place(at / image.columns(), image.rows());
        let x = place(at % image.columns(), image.columns());
        match parameter {
            ModelParameter::SlopeX => x,
            ModelParameter::SlopeY => y,
            ModelParameter::Vignetting => (x * x + y * y) / 2.0,
            ModelParameter::HalfGain => self.halves[at / image.columns()],
            _ => 1.0,
        }
    }

    /// The camera as given.
    pub fn camera(&self) -> &'p Camera {
        self.camera
    }

    /// Whether the frames can tell `parameter`.
    pub fn can_tell(&self, parameter: ModelParameter) -> bool {
        parameter.applies_to(self.camera)
    }

    /// Operator and fitted pixels of a frame under `correction`.
    fn data(&mut self, frame: usize, correction: &Correction) -> FrameData {
        let camera = self.camera.retimed(correction.parameters.timing());
        let model = Model::new(&camera, self.psfs(correction)).with_cancel(self.cancel);
        let (gain, offset) = self.pixels(correction);
        FrameData::new(&model, &self.frames[frame].fitted.adjusted(&gain, &offset))
    }

    /// Reconstructs a frame at the noise level `sigma`, in at most `iterations`. The error is the result so far of a run
    /// that the observer stopped.
    pub fn run(
        &mut self,
        frame: usize,
        correction: &Correction,
        sigma: f64,
        iterations: usize,
        observer: &mut Observer,
    ) -> Result<Trial, Box<RunResult>> {
        let mut data = self.data(frame, correction);
        let rule = TauRule::Discrepancy { sigma };
        let settings = SolverSettings::default().of_a_search();
        let mut run = HeldOutRun::without_reset(&data, self.prior, rule, settings);
        let mut labelled = |progress: &Progress| {
            observer(&Progress {
                label: LABEL,
                max_iterations: iterations,
                ..*progress
            })
        };
        run.run(&mut data, iterations, &mut labelled)?;
        debug!(
            "self-calibration: frame {frame} at σ {sigma:.4} counts, residual {:.4} counts",
            run.residual_rms()
        );
        let video = data.video(run.admm.video().to_vec());
        let light = data.light(&video);
        let (gain, offset) = self.pixels(correction);
        let Frame {
            measurement,
            judging,
            confirming,
            ..
        } = &self.frames[frame];
        let measured = measurement.image().data();
        // In counts of the frame, so that corrections compare.
        let residual = |&i: &usize| {
            let weight = measurement.weights().map_or(1.0, |w| f64::from(w[i]));
            let predicted = f64::from(gain[i]) * f64::from(light[i]) + f64::from(offset[i]);
            weight * (f64::from(measured[i]) - predicted)
        };
        Ok(Trial {
            frame,
            residual_rms: run.residual_rms(),
            judging: judging.iter().map(residual).collect(),
            confirming: confirming.iter().map(residual).collect(),
            video,
            data,
        })
    }

    /// The weighted residual of a trial's video under `correction`.
    pub fn residual(&mut self, correction: &Correction, trial: &Trial) -> Vec<f32> {
        let psfs = self.psfs(correction);
        let light = self.light(&correction.parameters, psfs, trial);
        let (gain, offset) = self.pixels(correction);
        let measured = self.frames[trial.frame].measurement.image().data();
        let residual: Vec<f32> = (0..light.len())
            .map(|i| (measured[i] - offset[i]) / gain[i] - light[i])
            .collect();
        trial.data.weigh(&residual)
    }

    /// `A v` of a trial's video with `psfs` and the timing of `parameters`.
    fn light(&self, parameters: &Parameters, psfs: PatchSet, trial: &Trial) -> Vec<f32> {
        let shutter = RollingShutter::new(&self.camera.retimed(parameters.timing()), psfs);
        let mut light = vec![0.0; shutter.range_len()];
        shutter.apply(&trial.video, &mut light);
        light
    }

    /// The map from a PSF to the frame of the trial's video; `None` where the PSF changes over the field.
    pub fn psf_map(&self, trial: &Trial) -> Option<PsfMap> {
        let [psf] = self.given.psfs() else {
            return None;
        };
        let size = (psf.image().rows(), psf.image().columns());
        Some(PsfMap::new(trial.data.shutter(), size, &trial.video))
    }

    /// How the corrected frame of a trial, of predicted `light`, changes with `parameter`, in counts.
    pub fn derivative(
        &mut self,
        correction: &Correction,
        parameter: ModelParameter,
        trial: &Trial,
        map: Option<&PsfMap>,
        light: &[f32],
    ) -> Vec<f32> {
        if parameter.is_of_psf() || parameter.is_of_timing() {
            let step = parameter.step();
            let changed = |sign: f64| {
                let mut parameters = correction.parameters;
                parameters[parameter] += sign * step;
                parameters
            };
            let quotient = |more: &[f32], less: &[f32]| -> Vec<f32> {
                let pairs = more.iter().zip(less);
                pairs
                    .map(|(m, l)| ((f64::from(*m) - f64::from(*l)) / (2.0 * step)) as f32)
                    .collect()
            };
            if let Some(map) = map.filter(|_| parameter.is_of_psf()) {
                let mut values = |sign| {
                    let psfs = self.model_psfs(&changed(sign));
                    psfs.central().image().data().to_vec()
                };
                return map.apply(&quotient(&values(1.0), &values(-1.0)));
            }
            let mut frame = |sign| {
                let parameters = changed(sign);
                let psfs = if parameter.is_of_timing() {
                    self.psfs(correction)
                } else {
                    self.model_psfs(&parameters)
                };
                self.light(&parameters, psfs, trial)
            };
            return quotient(&frame(1.0), &frame(-1.0));
        }
        let (gain, _) = self.pixels(correction);
        let of = |at: usize| {
            let scale = match parameter {
                ModelParameter::Vignetting | ModelParameter::HalfGain => f64::from(light[at]),
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
