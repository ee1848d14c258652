//! Measurement and operator of a rolling-shutter frame, `½‖W(b − A v)‖²`.
//!
//! [`System`] has the operator with its weights, support and background; an [`XStep`] solves with it. This module
//! keeps both in step with the frame: its counts, weights and held-out pixels.

mod data_term;
mod with_stray_light;

pub(super) use with_stray_light::{StrayLightFit, WithStrayLight};

use super::Observer;
use super::held_out::HeldOut;
use super::model::Model;
use super::prior::Prior;
use super::x_step::{self, ExactBlocks, Precision, System, XStep};
use rowburst_core::linop::{Background, LinearOperator};
use rowburst_core::{Shape, Support};
use rowburst_optics::RollingShutter;
use rowburst_optics::measurement::{Measurement, NoiseModel};
use rowburst_solve::StopReason;
use rowburst_solve::admm::{Progress, VideoOfIteration};
use rowburst_solve::prox::{Prox, Restricted};
use std::ops::ControlFlow;
use std::sync::Arc;

/// Sensitivity of a voxel over the largest one, below which the frame does not observe it; larger leaves more of the
/// edges of a field dark (docs/design/020).
const MIN_SENSITIVITY: f64 = 0.01;

/// Largest weight over the one below which a hundredth of the pixels lie, the brightest; larger takes more iterations of
/// conjugate gradients, smaller knows less of dark pixels (docs/design/025).
const MAX_WEIGHT_RATIO: f32 = 8.0;

/// How a video follows from what is solved for: it is the sum of foreground and background, or without a background `D w`
/// where the operator is equilibrated.
#[derive(Clone)]
pub(super) struct VideoForm {
    background: Background,
    shape: Shape,
    /// `A` or `A D`.
    operator: Arc<RollingShutter>,
}

impl VideoForm {
    /// The video.
    pub fn video(&self, stacked: Vec<f32>) -> Vec<f32> {
        if self.is_solved_for() {
            return stacked;
        }
        match self.background {
            Background::None => {
                let mut video = stacked;
                self.operator.scale_rows(&mut video);
                video
            }
            background => background.sum(self.shape, &stacked).into_owned(),
        }
    }

    /// Calls `observer` with the video of an iteration.
    pub fn observe(&self, progress: &Progress, observer: &mut Observer) -> ControlFlow<StopReason> {
        let VideoOfIteration::Solved(stacked) = progress.video else {
            return observer(progress);
        };
        if self.is_solved_for() {
            return observer(progress);
        }
        let video = || self.video(stacked.to_vec());
        observer(&Progress {
            video: VideoOfIteration::Computed(&video),
            ..*progress
        })
    }

    /// Whether the video itself is solved for.
    fn is_solved_for(&self) -> bool {
        self.background == Background::None && !self.operator.is_equilibrated()
    }
}

/// Weights and support of a run.
#[derive(Clone)]
pub(super) struct RunState {
    weights: Option<Vec<f32>>,
    support: Option<Support>,
}

/// The data term of a frame.
pub(super) struct FrameData {
    system: System,
    /// Solver of `(W A P Aᵀ W + ρI) y = r`.
    x_step: Box<dyn XStep>,
    precision: Precision,
    /// `b`.
    frame: Vec<f32>,
    /// `W b`, 0 at held-out pixels.
    measurements: Vec<f32>,
    /// `W` of all pixels at the start of a run, from the counts of this frame or of an earlier one, see
    /// [`Self::set_frame`]; held-out pixels keep their weights here.
    initial_weights: Option<Vec<f32>>,
    /// The present `W` of all pixels; [`rowburst_solve::DataTerm::update_weights`] computes it from the light of the
    /// video.
    weights: Option<Vec<f32>>,
    noise: Option<NoiseModel>,
    held_out: Option<HeldOut>,
    /// Pixels with a weight above zero, without the held-out ones.
    measurement_count: usize,
    /// The voxels that the frame observes; `None`: all.
    covered: Option<Support>,
}

impl FrameData {
    pub fn new(model: &Model, measurement: &Measurement) -> Self {
        Self::with_operator(
            model,
            model.solved_operator(),
            measurement,
            Precision::Adaptive,
        )
    }

    /// The same for videos as they are, on which a prior of given `τ` acts.
    pub fn unscaled(model: &Model, measurement: &Measurement) -> Self {
        Self::with_operator(model, model.shutter(), measurement, Precision::Adaptive)
    }

    /// The same with f64 blocks from the start, for videos as they are.
    pub fn with_f64_blocks(model: &Model, measurement: &Measurement) -> Self {
        Self::with_operator(model, model.shutter(), measurement, Precision::Double)
    }

    fn with_operator(
        model: &Model,
        operator: &Arc<RollingShutter>,
        measurement: &Measurement,
        precision: Precision,
    ) -> Self {
        let weights = starting_weights(measurement, model.shutter());
        let system = System::new(model, operator, weights.clone());
        let mut data = Self {
            x_step: x_step::choose(&system, precision),
            system,
            precision,
            frame: measurement.image().data().to_vec(),
            measurements: Vec::new(),
            initial_weights: weights.clone(),
            weights,
            noise: measurement.noise().cloned(),
            held_out: None,
            measurement_count: 0,
            covered: None,
        };
        data.apply_weights_to_frame();
        data.set_coverage();
        data
    }

    fn set_coverage(&mut self) {
        let coverage = self.coverage_by(self.system.model().shutter());
        let shape = self.shape();
        self.covered = coverage
            .contains(&0)
            .then(|| Support::from_mask(coverage, shape));
    }

    /// The present `W` of all pixels; held-out pixels keep their weights here. `None`: all 1.
    pub fn weights(&self) -> Option<&[f32]> {
        self.weights.as_deref()
    }

    /// The background of its videos.
    pub fn background(&self) -> Background {
        self.system.background()
    }

    /// What stops its runs.
    pub fn cancel(&self) -> &rowburst_core::Cancel {
        self.system.model().cancel()
    }

    pub fn psfs(&self) -> &rowburst_optics::PatchSet {
        self.system.camera_model().psfs()
    }

    /// The operator of the camera.
    pub fn shutter(&self) -> &RollingShutter {
        self.system.camera_model().shutter()
    }

    /// Whether rows share bins.
    pub fn is_coupled(&self) -> bool {
        !self.shutter().time().is_disjoint()
    }

    /// Whether the frame sees some rows of some bins weakly, see [`RollingShutter::equilibrated`].
    pub fn has_weakly_seen_rows(&self) -> bool {
        self.system.foreground_operator().is_equilibrated()
    }

    /// The shape of the video.
    pub fn video_shape(&self) -> Shape {
        self.shutter().video_shape()
    }

    /// The shape of what is solved for: that of the video, or one bin for a scene at rest.
    pub fn shape(&self) -> Shape {
        self.system.shape()
    }

    /// Draws the pixels to be held out.
    pub fn held_out(&self) -> HeldOut {
        HeldOut::draw(self.shutter(), self.weights(), 0)
    }

    /// Resets to the initial weights and to all voxels, for videos with this background, without the
    /// pixels of `held_out`. The results do not depend on earlier calls, to the bit.
    pub fn reset(&mut self, background: Background, held_out: Option<HeldOut>) {
        let has_same_weights = self.weights == self.initial_weights && held_out == self.held_out;
        let is_fresh = self.x_step.reset();
        if has_same_weights && background == self.background() && is_fresh {
            if let Some(before) = self.system.remove_support() {
                self.x_step.restrict(&self.system, Some(&before));
            }
            return;
        }
        let start = RunState {
            weights: self.initial_weights.clone(),
            support: None,
        };
        self.set_run(background, held_out, start);
    }

    /// Weights and support of the present run.
    pub fn run_state(&self) -> RunState {
        RunState {
            weights: self.weights.clone(),
            support: self.system.support().cloned(),
        }
    }

    /// Continues a run for videos with this background from `state` with all pixels: with those that were held out, too.
    pub fn resume_with_all_pixels(&mut self, background: Background, state: RunState) {
        self.x_step.reset();
        self.set_run(background, None, state);
    }

    /// Begins or continues a run at `state`, without the pixels of `held_out`.
    fn set_run(&mut self, background: Background, held_out: Option<HeldOut>, state: RunState) {
        let shape_before = self.shape();
        self.held_out = held_out;
        self.weights = state.weights;
        self.system.set_background(background);
        if let Some(support) = &state.support {
            self.system.set_support(support);
        }
        self.apply_weights();
        if self.shape() != shape_before {
            self.set_coverage();
            self.renew_x_step();
        } else if self.x_step.is_renewed_by_rebuild(background) {
            self.x_step.rebuild(&self.system);
        } else {
            self.renew_x_step();
        }
    }

    /// Uses the held-out pixels, too, and keeps support and weights.
    pub fn release_held_out(&mut self) {
        self.held_out = None;
        self.apply_weights();
        self.x_step.rebuild(&self.system);
    }

    /// Replaces the frame by another one of the same camera and keeps the support. Weights that were updated from the
    /// light, and the weights and noise model that a run starts from, are kept where the same pixels have weights above
    /// zero.
    pub fn set_frame(&mut self, measurement: &Measurement) {
        self.frame = measurement.image().data().to_vec();
        let weights = starting_weights(measurement, self.shutter());
        let usable = |of: &Option<Vec<f32>>| -> Option<Vec<bool>> {
            of.as_ref().map(|w| w.iter().map(|w| *w > 0.0).collect())
        };
        let uses_noise_law = self.noise.is_some() && measurement.noise().is_some();
        if weights == self.initial_weights
            || (uses_noise_law && usable(&weights) == usable(&self.initial_weights))
        {
            self.apply_weights_to_frame();
            return;
        }
        self.noise = measurement.noise().cloned();
        self.initial_weights = weights.clone();
        self.weights = weights;
        self.set_coverage();
        self.apply_weights();
        self.x_step.rebuild(&self.system);
    }

    /// Replaces the law of the noise, from which [`rowburst_solve::DataTerm::update_weights`] takes the weights.
    pub fn set_noise(&mut self, noise: Option<NoiseModel>) {
        self.noise = noise;
    }

    /// The voxels that the frame observes: their sensitivity, the sum of `Aᵀ1` over the usable pixels, is at least
    /// [`MIN_SENSITIVITY`] of the largest one.
    pub fn coverage(&self) -> Vec<u8> {
        match self.background() {
            // Each bin shows what any row has seen.
            Background::Alone => {
                let of_picture = self.coverage_by(self.system.shutter());
                of_picture.repeat(self.video_shape().bins)
            }
            _ => self.coverage_by(self.shutter()),
        }
    }

    fn coverage_by(&self, shutter: &RollingShutter) -> Vec<u8> {
        let is_usable = |i: usize| self.initial_weights.as_ref().is_none_or(|w| w[i] > 0.0);
        let usable: Vec<f32> = (0..self.frame.len())
            .map(|i| f32::from(u8::from(is_usable(i))))
            .collect();
        let mut sensitivity = vec![0.0; shutter.video_shape().voxels()];
        shutter.adjoint(&usable, &mut sensitivity);
        let largest = sensitivity.iter().copied().fold(0.0, f32::max);
        let is_covered = |s: &f32| f64::from(*s) >= MIN_SENSITIVITY * f64::from(largest);
        sensitivity
            .iter()
            .map(|s| u8::from(is_covered(s)))
            .collect()
    }

    /// The proximal operator of `prior`, for videos that are zero in voxels that the frame does not observe: a prior
    /// would fill them with light of their neighbours.
    pub fn prox(&self, prior: &Prior) -> Box<dyn Prox> {
        let prox = prior.prox(self.video_shape());
        match &self.covered {
            Some(covered) => Box::new(Restricted::new(prox, covered.clone())),
            None => prox,
        }
    }

    /// Replaces `W b` until the next change of frame or weights.
    pub fn set_measurements(&mut self, measurements: Vec<f32>) {
        self.measurements = measurements;
    }

    /// Whether the present weight of each pixel is above zero.
    pub fn usable(&self) -> Vec<bool> {
        let weights = self.system.operator().weights();
        (0..self.frame.len())
            .map(|i| weights.is_none_or(|w| w[i] > 0.0))
            .collect()
    }

    /// The light of a video at all pixels, `A v`.
    pub fn light(&self, video: &[f32]) -> Vec<f32> {
        let mut light = vec![0.0; self.frame.len()];
        self.shutter().apply(video, &mut light);
        light
    }

    /// The light of what was solved for at all pixels.
    pub fn predicted(&self, stacked: &[f32]) -> Vec<f32> {
        let mut light = vec![0.0; self.frame.len()];
        match self.background() {
            Background::None | Background::Alone => {
                self.system.shutter().apply(stacked, &mut light);
            }
            background => {
                let video = background.sum(self.video_shape(), stacked);
                self.shutter().apply(&video, &mut light);
            }
        }
        light
    }

    /// `W values`.
    pub fn weigh(&self, values: &[f32]) -> Vec<f32> {
        self.system.operator().weigh(values).into_owned()
    }

    /// Solves `(B Bᵀ + ρI) y = r` for an `r` that has nothing to do with the one before; `B` is `W A` on the support.
    pub fn solve_alone(&mut self, r: &[f32], rho: f64) -> Vec<f64> {
        let size = rowburst_core::vecmath::norm(r).max(f64::MIN_POSITIVE);
        let unit: Vec<f32> = r.iter().map(|r| (f64::from(*r) / size) as f32).collect();
        let (mut y, mut gram_y) = (vec![0.0; r.len()], vec![0.0; r.len()]);
        let equation = x_step::Equation {
            r: &unit,
            rho,
            y: &mut y,
            gram_y: &mut gram_y,
        };
        self.x_step.solve_alone(&self.system, equation);
        y.iter().map(|y| size * f64::from(*y)).collect()
    }

    /// `σ` in counts of a pixel with weight 1 under the noise model of the weights; `None` without a noise model.
    pub fn calibrated_sigma(&self) -> Option<f64> {
        self.noise.as_ref().map(NoiseModel::sigma)
    }

    /// How a video follows from what is solved for with `background`.
    pub fn video_form(&self, background: Background) -> VideoForm {
        VideoForm {
            background,
            shape: self.video_shape(),
            operator: Arc::clone(self.system.foreground_operator()),
        }
    }

    /// The video that follows from what was solved for.
    pub fn video(&self, stacked: Vec<f32>) -> Vec<f32> {
        self.video_form(self.background()).video(stacked)
    }

    /// Indices of the pixels that are held out now, in ascending order.
    pub fn held_out_pixels(&self) -> &[usize] {
        self.held_out.as_ref().map_or(&[], HeldOut::pixels)
    }

    /// `W(b − A v)` at the held-out pixels, with the weights that they would have.
    pub fn held_out_residuals(&self, video: &[f32]) -> Vec<f64> {
        if self.held_out.is_none() {
            return Vec::new();
        }
        let light = self.predicted(video);
        let pixels = self.held_out_pixels().iter();
        pixels
            .map(|&i| {
                let weight = self.weights.as_ref().map_or(1.0, |w| f64::from(w[i]));
                weight * (f64::from(self.frame[i]) - f64::from(light[i]))
            })
            .collect()
    }

    /// Applies the present weights and held-out pixels to system and frame, but not to the x-step.
    fn apply_weights(&mut self) {
        let mut weights = self.weights.clone();
        if let Some(held_out) = &self.held_out {
            let weights = weights.get_or_insert_with(|| vec![1.0; self.frame.len()]);
            held_out.pixels().iter().for_each(|&i| weights[i] = 0.0);
        }
        self.system.set_weights(weights);
        self.apply_weights_to_frame();
    }

    /// Replaces the x-step by a new one for the present system.
    fn renew_x_step(&mut self) {
        // Frees the old blocks before it builds the new ones.
        self.x_step = Box::new(ExactBlocks::empty());
        self.x_step = x_step::choose(&self.system, self.precision);
    }

    /// Sets `W b` and the number of measurements.
    fn apply_weights_to_frame(&mut self) {
        self.measurements = self.frame.clone();
        self.measurement_count = self.frame.len();
        if let Some(weights) = self.system.operator().weights() {
            let pixels = self.measurements.iter_mut().zip(weights);
            pixels.for_each(|(b, w)| *b *= w);
            self.measurement_count = weights.iter().filter(|w| **w > 0.0).count();
        }
    }
}

/// The weights of the counts of a frame.
fn starting_weights(measurement: &Measurement, shutter: &RollingShutter) -> Option<Vec<f32>> {
    let weights = measurement.weights()?.to_vec();
    Some(limited(weights, shutter))
}

/// Weights of a run. Where rows share bins, those of dark pixels are limited to [`MAX_WEIGHT_RATIO`], but none below 1, that
/// of the median: no preconditioner of the x-step follows weights that differ far within a row.
fn limited(mut weights: Vec<f32>, shutter: &RollingShutter) -> Vec<f32> {
    let mut used: Vec<f32> = weights.iter().copied().filter(|w| *w > 0.0).collect();
    if shutter.time().is_disjoint() || used.is_empty() {
        return weights;
    }
    let bright = used.len() / 100;
    let (_, least, _) = used.select_nth_unstable_by(bright, f32::total_cmp);
    let most = (MAX_WEIGHT_RATIO * *least).max(1.0);
    weights.iter_mut().for_each(|w| *w = w.min(most));
    weights
}

#[cfg(test)]
mod tests;
