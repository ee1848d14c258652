//! From a measurement to a video: the only place where physics meets the solver.

mod data;
mod fit;
mod prior;
mod sigma;

pub use fit::{Fit, FitStatistics, Verdict, Without};
pub use prior::{FurtherWeights, Prior};
pub use sigma::estimate_sigma;

use crate::measurement::Measurement;
use crate::prox::Prox;
use crate::solve::admm::{self, AdmmParams, Progress, TauRule};
use crate::solve::{DataTerm, StopReason};
use crate::{Camera, Error, Image, PatchSet, Result, RollingShutter, Video};
use data::FrameData;
use sigma::Bands;
use std::ops::ControlFlow;

/// What the user chooses.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Recipe {
    /// The prior; `default` does well on sparse scenes, still or moving.
    pub prior: Prior,
    /// `τ` of `½‖W(b − Av)‖² + τ R(v)`; `None`: found by the discrepancy principle.
    pub tau: Option<f64>,
    /// Standard deviation of the noise in counts; `None`: from the calibration, or
    /// else from the frame itself.
    pub noise_sigma: Option<f64>,
    /// Most iterations; `None`: the solver's default.
    pub max_iterations: Option<usize>,
}

/// Where the noise level comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SigmaSource {
    /// The user gave it.
    Given,
    /// Gain and read noise of the sensor.
    Calibration,
    /// The part of the frame's spectrum that the optics do not pass.
    Frame,
}

impl SigmaSource {
    /// The word in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Given => "given",
            Self::Calibration => "from the calibration",
            Self::Frame => "estimated from the frame",
        }
    }
}

/// A reconstruction set up and ready to run.
pub struct Problem {
    data: FrameData,
    prior: Box<dyn Prox>,
    params: AdmmParams,
    recipe: Recipe,
    sigma: f64,
    sigma_source: SigmaSource,
    camera: Camera,
    bands: Bands,
}

/// A reconstructed video with what is needed to judge it.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// The video in counts, `[t, y, x]`.
    pub video: Video,
    /// `W(b − A v)/σ`, `[y, x]`; 0 where a pixel holds no information.
    pub residual: Image,
    /// Root mean square of the residual over the pixels that hold information.
    pub residual_over_sigma: f64,
    /// `τ` at the end.
    pub tau: f64,
    /// `½‖W(b − A v)‖² + τ R(v)` at the end.
    pub objective: f64,
    /// Noise of a pixel with weight 1, in counts.
    pub sigma: f64,
    /// Where `sigma` comes from.
    pub sigma_source: SigmaSource,
    /// Iterations done.
    pub iterations: usize,
    /// Why the solver stopped.
    pub stop_reason: StopReason,
    /// Part of the voxels that were allowed to be lit at the end.
    pub support: f64,
    /// Whether the model explains the frame.
    pub fit: Fit,
}

impl Problem {
    /// Sets up the reconstruction of `measurement`: operator, Gram factors, noise level.
    /// `psf` is one for the whole field (`&Psf`) or one for each part of it (`&PatchSet`).
    ///
    /// # Errors
    /// A `τ` or `σ` that is not above zero, a noise level that cannot be found, or a prior
    /// over time for a video of one bin.
    pub fn new(
        measurement: &Measurement,
        camera: &Camera,
        psf: impl Into<PatchSet>,
        recipe: Recipe,
    ) -> Result<Self> {
        let psf = psf.into();
        for (name, value) in [("--tau", recipe.tau), ("--noise-sigma", recipe.noise_sigma)] {
            if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                return Err(Error::input(
                    name,
                    value,
                    "the value is a finite number above zero",
                    "Leave it out: the program finds it.",
                ));
            }
        }
        let (sigma, sigma_source) = match (recipe.noise_sigma, measurement.sigma()) {
            (Some(sigma), _) => (sigma, SigmaSource::Given),
            (None, Some(sigma)) => (sigma, SigmaSource::Calibration),
            (None, None) => (
                estimate_sigma(measurement, psf.central()),
                SigmaSource::Frame,
            ),
        };
        let tau = recipe
            .tau
            .map_or(TauRule::Discrepancy { sigma }, TauRule::Fixed);
        let mut params = AdmmParams::new(tau);
        params.support = recipe.prior.support;
        if let Some(most) = recipe.max_iterations {
            params.max_iterations = most;
        }
        let bands = Bands::new(measurement, psf.central());
        let operator = RollingShutter::new(camera, psf);
        recipe.prior.check_bins(operator.video_shape().bins)?;
        params.threshold *= recipe.prior.threshold_factor(operator.video_shape());
        let prior = recipe.prior.prox(operator.video_shape());
        Ok(Self {
            camera: camera.clone(),
            bands,
            data: FrameData::new(operator, measurement),
            prior,
            params,
            recipe,
            sigma,
            sigma_source,
        })
    }

    /// What the user chose.
    pub fn recipe(&self) -> &Recipe {
        &self.recipe
    }

    /// Noise of a pixel with weight 1, in counts.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// Solves it; `observer` sees every iteration and may stop it.
    ///
    /// # Errors
    /// Numbers that overflowed.
    pub fn solve(
        mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> Result<Reconstruction> {
        let shape = self.data.shape();
        let mut history = Vec::new();
        let solution = admm::solve(
            &mut self.data,
            &mut *self.prior,
            shape,
            &self.params,
            &mut |progress| {
                history.push(progress.residual_rms);
                observer(progress)
            },
        );
        if !solution.objective.is_finite() {
            return Err(Error::work(
                "reconstruction",
                "the numbers overflowed",
                "Check that frame and PSF hold plausible values, and give --noise-sigma.",
            ));
        }
        let informative = self.data.informative() as f64;
        let residual_rms = crate::vecmath::norm(&solution.residual) / informative.sqrt();
        let residual: Vec<f32> = solution
            .residual
            .iter()
            .map(|r| (f64::from(*r) / self.sigma) as f32)
            .collect();
        let columns = self.camera.columns();
        let residual = Image::new(residual.len() / columns, columns, residual)?;
        let video = Video::new(shape, solution.video)?;
        let scaled = self.data.measured().iter();
        let measured: Vec<f32> = scaled
            .map(|b| (f64::from(*b) / self.sigma) as f32)
            .collect();
        let faint = (0.01 * admm::brightness(video.data())) as f32;
        let fit = fit::judge(&fit::Evidence {
            residual: &residual,
            measured: &measured,
            weights: self.data.weights(),
            camera: &self.camera,
            bands: &self.bands,
            video: &video,
            freedom: self.prior.degrees_of_freedom(video.data(), faint),
            history: &history,
            sigma: self.sigma,
            sigma_source: self.sigma_source,
            tau_is_given: self.recipe.tau.is_some(),
            stop_reason: solution.stop_reason,
            support: solution.support,
        });
        Ok(Reconstruction {
            video,
            residual,
            residual_over_sigma: residual_rms / self.sigma,
            tau: solution.tau,
            objective: solution.objective,
            sigma: self.sigma,
            sigma_source: self.sigma_source,
            iterations: solution.iterations,
            stop_reason: solution.stop_reason,
            support: solution.support,
            fit,
        })
    }
}
