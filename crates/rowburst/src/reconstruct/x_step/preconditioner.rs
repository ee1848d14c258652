//! Preconditioners of the conjugate gradients: the mean field of the operator.

use rowburst_core::Support;
use rowburst_core::linop::Background;
use rowburst_optics::RollingShutter;
use rowburst_optics::forward::mean_field::{MeanField, MeanFieldSolver};
use rowburst_solve::conjugate_gradient::Preconditioner;
use std::sync::Arc;

/// Solves with the mean field along the rows; pixels with weight 0 are coupled to no others.
pub struct MeanFieldPreconditioner {
    solver: MeanFieldSolver,
    weights: Option<Vec<f32>>,
}

impl MeanFieldPreconditioner {
    /// For videos on `support` with this background, and for the weights of the frame's pixels.
    pub fn new(
        mean_field: Arc<MeanField>,
        shutter: &RollingShutter,
        background: Background,
        support: Option<&Support>,
        weights: Option<&[f32]>,
    ) -> Self {
        let (rows, columns) = shutter.frame_shape();
        let row_weight =
            |row: &[f32]| (row.iter().map(|w| w * w).sum::<f32>() / columns as f32).sqrt();
        let row_weights: Vec<f64> = match weights {
            None => vec![1.0; rows],
            Some(weights) => weights
                .chunks_exact(columns)
                .map(|row| f64::from(row_weight(row)))
                .collect(),
        };
        let mut fractions = match support {
            Some(support) => support.fractions(),
            None => vec![1.0; shutter.video_shape().bins],
        };
        // A static background would couple all rows, which helps little (docs/design/025).
        if background == Background::PerBin {
            fractions.iter_mut().for_each(|f| *f += 1.0);
        }
        Self {
            solver: MeanFieldSolver::new(mean_field, shutter, &fractions, &row_weights),
            weights: weights.map(<[f32]>::to_vec),
        }
    }
}

impl Preconditioner for MeanFieldPreconditioner {
    fn max_iterations(&self, is_restricted: bool, is_early: bool) -> usize {
        let has_unused = self.weights.as_ref().is_some_and(|w| w.contains(&0.0));
        match (is_restricted, has_unused) {
            // Inexact steps on a support leave bins without light, which are then taken for underfit.
            (true, _) => 40,
            // The mean field knows no single pixels, so a mask takes more iterations.
            (false, true) => 20,
            // The first iterations find shapes, for which a coarse step will do.
            (false, false) if is_early => 2,
            (false, false) => 6,
        }
    }

    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        let Some(weights) = &self.weights else {
            return self.solver.solve(r, rho, out);
        };
        let mut used = r.to_vec();
        let unused = used.iter_mut().zip(weights).filter(|(_, w)| **w == 0.0);
        unused.for_each(|(u, _)| *u = 0.0);
        self.solver.solve(&used, rho, out);
        let pixels = out.iter_mut().zip(r).zip(weights);
        let unused = pixels.filter(|(_, w)| **w == 0.0);
        unused.for_each(|((o, r), _)| *o = r / rho as f32);
    }
}

/// Divides in Fourier space where the operator convolves whole planes, else divides by a constant.
pub struct PlanePreconditioner {
    pub shutter: Arc<RollingShutter>,
    /// Typical size of a diagonal element of `A Aᵀ`.
    pub scale: f64,
}

impl Preconditioner for PlanePreconditioner {
    fn max_iterations(&self, _is_restricted: bool, _is_early: bool) -> usize {
        // Fewer cost quality, more cost time (docs/design/004).
        40
    }

    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        match self.shutter.circulant_inverse(r, rho) {
            Some(inverse) => out.copy_from_slice(&inverse),
            None => out
                .iter_mut()
                .zip(r)
                .for_each(|(o, r)| *o = r / (self.scale + rho) as f32),
        }
    }
}
