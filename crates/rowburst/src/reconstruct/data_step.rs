//! The data term of a frame with its proximal operator, for other solvers.
//!
//! ```text
//! f(v) = ½‖W(b − A v)‖²
//! prox_{s f}(p) = argmin_v f(v) + ‖v − p‖²/(2s) = p + (WA)ᵀ (WA(WA)ᵀ + I/s)⁻¹ W(b − A p)
//! ```
//!
//! The step is exact where no bin is seen by two instants, since `A Aᵀ` is block-diagonal then, and where these blocks
//! fit in memory (see docs/design/003). Otherwise conjugate gradients are restarted until they are as accurate as f32.

use super::frame_data::FrameData;
use super::model::Model;
use rowburst_core::vecmath::norm;
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::measurement::Measurement;
use rowburst_solve::DataTerm;

/// Residual over the right-hand side at which the solve stops; f32 is no more accurate.
const TOLERANCE: f64 = 1e-6;
/// Limit of the calls of the Gram solver for one step. Blocks need few; conjugate gradients may need many.
const MAX_CALLS: usize = 40;

/// `½‖W(b − A v)‖²` with its gradient and its proximal step.
pub struct DataStep {
    data: FrameData,
}

impl DataStep {
    /// The data term of `measurement`. Costs the set-up of a reconstruction.
    pub fn new(model: &Model, measurement: &Measurement) -> Self {
        Self {
            data: FrameData::with_f64_blocks(model, measurement),
        }
    }

    /// Number of voxels of a video.
    pub fn len(&self) -> usize {
        self.data.video_shape().voxels()
    }

    /// Always `false`: a video has voxels.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// `W(b − A v)`.
    ///
    /// # Panics
    /// If the length is not that of a video.
    pub fn residual(&self, video: &[f32]) -> Vec<f32> {
        let measured = self.data.measurements();
        let mut residual = vec![0.0; measured.len()];
        self.data.operator().apply(video, &mut residual);
        let pairs = residual.iter_mut().zip(measured);
        pairs.for_each(|(r, b)| *r = b - *r);
        residual
    }

    /// `½‖W(b − A v)‖²`.
    ///
    /// # Panics
    /// If the length is not that of a video.
    pub fn value(&self, video: &[f32]) -> f64 {
        0.5 * norm(&self.residual(video)).powi(2)
    }

    /// `(WA)ᵀ W(A v − b)`.
    ///
    /// # Panics
    /// If the length is not that of a video.
    pub fn gradient(&self, video: &[f32]) -> Vec<f32> {
        let residual: Vec<f32> = self.residual(video).iter().map(|r| -r).collect();
        let mut gradient = vec![0.0; video.len()];
        self.data.operator().adjoint(&residual, &mut gradient);
        gradient
    }

    /// `argmin_v ½‖W(b − A v)‖² + ‖v − p‖²/(2 step)`.
    ///
    /// # Errors
    /// A step that is not above zero, or so long that `1/step` is below the smallest stable `ρ`.
    ///
    /// # Panics
    /// If the length is not that of a video.
    ///
    /// # Cost
    /// One product with `A`, one with `Aᵀ`, and triangular solves. A step that differs from the last one
    /// also costs a Cholesky factor of each block.
    pub fn prox(&mut self, p: &[f32], step: f64) -> Result<Vec<f32>> {
        let rho = 1.0 / step;
        let min_rho = self.data.min_rho();
        if !(rho.is_finite() && rho >= min_rho) {
            return Err(Error::input(
                Parameter::Step,
                step,
                format!("a step is above zero and at most {:.1e}", 1.0 / min_rho),
                "Steps about one over the norm of A squared are usual; longer ones are allowed.",
            ));
        }
        let mut remaining = self.residual(p);
        let target = TOLERANCE * norm(&remaining);
        let (mut y, mut increment, mut gram_increment) = (
            vec![0.0f32; remaining.len()],
            vec![0.0f32; remaining.len()],
            vec![0.0f32; remaining.len()],
        );
        for _ in 0..MAX_CALLS {
            let norm_before = norm(&remaining);
            self.data
                .solve_gram(&remaining, rho, &mut increment, &mut gram_increment);
            for i in 0..remaining.len() {
                y[i] += increment[i];
                remaining[i] = (f64::from(remaining[i])
                    - f64::from(gram_increment[i])
                    - rho * f64::from(increment[i])) as f32;
            }
            let norm_after = norm(&remaining);
            // After a solve with blocks only rounding is left, which further calls do not reduce.
            if norm_after <= target || norm_after > 0.9 * norm_before {
                break;
            }
        }
        let mut video = vec![0.0; p.len()];
        self.data.operator().adjoint(&y, &mut video);
        video.iter_mut().zip(p).for_each(|(v, p)| *v += p);
        Ok(video)
    }
}
