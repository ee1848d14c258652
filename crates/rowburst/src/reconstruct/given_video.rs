//! The reconstruction of a video that another model has made of the frame.

use super::{Prior, Problem, Reconstruction, RunResult};
use rowburst_core::Result;
use rowburst_core::linop::Background;
use rowburst_optics::{Measurement, RollingShutter, Video};
use rowburst_solve::admm::Solution;
use rowburst_solve::{Certificate, DataTerm, StopReason};

impl Problem {
    /// The operator `A`.
    pub fn operator(&self) -> &RollingShutter {
        self.data.shutter()
    }

    /// The corrected frame.
    pub fn measurement(&self) -> &Measurement {
        &self.measurement
    }

    /// Judges `video` as the reconstruction of the frame: residual, fit and coverage. `degrees_of_freedom` is the number
    /// of parameters that it was fitted with. `τ` is zero, and there is no bound on the objective.
    ///
    /// # Errors
    /// Those of [`Problem::solve`].
    ///
    /// # Panics
    /// If the video has another shape than the camera's.
    pub fn judge(mut self, video: Video, degrees_of_freedom: f64) -> Result<Reconstruction> {
        assert_eq!(video.shape(), self.data.video_shape(), "shape of the video");
        if self.data.background() != Background::None {
            self.data.reset(Background::None, None);
        }
        let predicted = self.data.weigh(&self.data.light(video.data()));
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
