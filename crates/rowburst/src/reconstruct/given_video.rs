//! The reconstruction of a video that another model has made of the frame.

use super::{Prior, Problem, Reconstruction, RunResult};
use rowburst_core::Result;
use rowburst_core::linop::Background;
use rowburst_optics::{Measurement, RollingShutter, Video};
use rowburst_solve::admm::{Progress, Solution};
use rowburst_solve::{Certificate, DataTerm, StopReason};
use std::ops::ControlFlow;

impl Problem {
    /// The operator `A`.
    pub fn operator(&self) -> &RollingShutter {
        self.data.shutter()
    }

    /// Checks the model as [`Problem::solve`] does before its run, which then does not: the noise level is found where it
    /// is open, foreign pixels are left out, PSF and camera are corrected unless the scene is dense, and the effective noise
    /// level is set. For a video that another model is to make of the frame.
    ///
    /// # Errors
    /// The observer stopped it; the error is the reason.
    pub fn check(
        &mut self,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> std::result::Result<(), StopReason> {
        let stopped = |found: Box<RunResult>| found.solution.stop_reason;
        let prior = self.options.prior.unwrap_or(Prior::STANDARD);
        self.resolve_tau_rule(observer).map_err(stopped)?;
        self.check_model(prior, observer).map_err(stopped)?;
        self.is_ready = true;
        Ok(())
    }

    /// The corrected frame with the foreign pixels that [`Problem::check`] has found at weight 0.
    pub fn kept_measurement(&self) -> Measurement {
        self.measurement.without(&self.excluded)
    }

    /// Noise and error of the model at a pixel with weight 1 in counts, by [`Problem::check`].
    pub fn effective_sigma(&self) -> f64 {
        self.effective_sigma
    }

    /// The corrected frame.
    pub fn measurement(&self) -> &Measurement {
        &self.measurement
    }

    /// Judges `video` as the reconstruction of the frame: residual, fit and coverage. Voxels that the frame does not observe become zero. `degrees_of_freedom` is the number
    /// of parameters that it was fitted with. `τ` is zero, and there is no bound on the objective.
    ///
    /// # Errors
    /// Those of [`Problem::solve`].
    ///
    /// # Panics
    /// If the video has another shape than the camera's.
    pub fn judge(mut self, mut video: Video, degrees_of_freedom: f64) -> Result<Reconstruction> {
        assert_eq!(video.shape(), self.data.shape(), "shape of the video");
        // A check has held pixels out.
        self.data.reset(Background::None, None);
        let coverage = self.data.coverage();
        let voxels = video.data_mut().iter_mut().zip(&coverage);
        voxels
            .filter(|(_, covered)| **covered == 0)
            .for_each(|(value, _)| *value = 0.0);
        let predicted = self.data.weigh(&self.data.predicted(video.data()));
        let pairs = self.data.measurements().iter().zip(&predicted);
        let residual: Vec<f32> = pairs.map(|(b, a)| b - a).collect();
        let primal = 0.5 * rowburst_core::vecmath::norm_squared(&residual);
        let result = RunResult {
            prior: Prior::STANDARD,
            choice: None,
            solution: Solution {
                video: video.into_data(),
                residual,
                tau: 0.0,
                iterations: 0,
                stop_reason: StopReason::Converged,
                support_fraction: 1.0,
                degrees_of_freedom,
                certificate: Certificate { primal, dual: 0.0 },
            },
        };
        self.build_reconstruction(result, &[])
    }
}
