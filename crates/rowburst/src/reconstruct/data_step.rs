//! The data term of a frame by itself, for solvers that are not ours.
//!
//! ```text
//! f(v) = ½‖W(b − A v)‖²
//! prox_{s f}(p) = argmin_v f(v) + ‖v − p‖²/(2s) = p + (WA)ᵀ (WA(WA)ᵀ + I/s)⁻¹ W(b − A p)
//! ```
//!
//! Exact where no bin is seen by two instants, since `A Aᵀ` is block-diagonal then; see
//! ARCHITECTURE.md. Else by conjugate gradients, taken up again until they are as good as f32.

use super::frame_data::FrameData;
use super::model::Model;
use crate::measurement::Measurement;
use crate::solve::DataTerm;
use crate::vecmath::norm;
use crate::{Error, Result};

/// What may be left of the right-hand side; f32 holds no more.
const TOLERANCE: f64 = 1e-6;
/// Most calls of the solver for one step; blocks need one.
const MAX_CALLS: usize = 40;

/// `½‖W(b − A v)‖²` with its gradient and its proximal step.
pub struct DataStep {
    data: FrameData,
}

impl DataStep {
    /// The data term of `measurement`. Cost: the set-up of a reconstruction.
    pub fn new(model: &Model, measurement: &Measurement) -> Self {
        Self {
            data: FrameData::with_f64_blocks(model, measurement),
        }
    }

    /// Length of a video.
    pub fn len(&self) -> usize {
        self.data.shape().voxels()
    }

    /// Whether videos have no voxels: never.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// `W(b − A v)`.
    ///
    /// # Panics
    /// If the length is not that of a video.
    pub fn residual(&self, video: &[f32]) -> Vec<f32> {
        let measured = self.data.measured();
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
    /// A step that is not above zero, or so long that float64 cannot tell it from infinity.
    ///
    /// # Panics
    /// If the length is not that of a video.
    ///
    /// # Cost
    /// One product with `A`, one with `Aᵀ`, and triangular solves; where the step differs from
    /// the last one a Cholesky factor of each block besides.
    pub fn prox(&mut self, p: &[f32], step: f64) -> Result<Vec<f32>> {
        let rho = 1.0 / step;
        let least = self.data.min_rho();
        if !(rho.is_finite() && rho >= least) {
            return Err(Error::input(
                "step",
                step,
                format!("a step is above zero and at most {:.1e}", 1.0 / least),
                "Steps about one over the norm of A squared are usual; longer ones are allowed.",
            ));
        }
        let mut rest = self.residual(p);
        let target = TOLERANCE * norm(&rest);
        let (mut y, mut part, mut gram) = (
            vec![0.0f32; rest.len()],
            vec![0.0f32; rest.len()],
            vec![0.0f32; rest.len()],
        );
        for _ in 0..MAX_CALLS {
            let before = norm(&rest);
            self.data.solve_gram(&rest, rho, &mut part, &mut gram);
            for i in 0..rest.len() {
                y[i] += part[i];
                rest[i] =
                    (f64::from(rest[i]) - f64::from(gram[i]) - rho * f64::from(part[i])) as f32;
            }
            let left = norm(&rest);
            // Blocks leave rounding alone, which no further call takes away.
            if left <= target || left > 0.9 * before {
                break;
            }
        }
        let mut video = vec![0.0; p.len()];
        self.data.operator().adjoint(&y, &mut video);
        video.iter_mut().zip(p).for_each(|(v, p)| *v += p);
        Ok(video)
    }
}
