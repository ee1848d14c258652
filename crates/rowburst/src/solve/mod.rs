//! Solvers for `min_{v≥0} ½‖b − A v‖² + τ R(v)` (Eq. 5); they know operators, not optics.

pub mod admm;
pub mod blocks;
pub mod bordered;
pub mod certificate;
pub mod conjugate_gradient;
pub mod fista;
pub mod gpsr_bb;
pub mod objective;
pub mod primal_dual;
mod run;

pub use certificate::{Certificate, Certifier};
pub use objective::Objective;
pub use run::{CertifiedSolution, Limits};

use crate::Support;
use crate::linop::{LinearOperator, WritePart};

/// Why a solver stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopReason {
    /// The video no longer changes.
    Converged,
    /// The largest number of iterations was reached first.
    IterationLimit,
    /// The observer stopped it because its time was up.
    TimeBudget,
    /// The observer stopped it because the user asked.
    Interrupted,
}

impl StopReason {
    /// The word in `result.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Converged => "converged",
            Self::IterationLimit => "iteration-limit",
            Self::TimeBudget => "time-budget",
            Self::Interrupted => "interrupted",
        }
    }
}

/// Solves `(A P Aᵀ + ρI) y = r`, with `P` the projection onto the support.
pub trait GramSolver: Send {
    /// Overwrites `y`.
    fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32]);

    /// The same, and `gram_y` with `A P Aᵀ y`.
    fn solve_with_product(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) {
        self.solve(r, rho, y);
        gram_product(r, rho, y, gram_y);
    }
}

/// `gram_y = r − ρy`.
pub(crate) fn gram_product(r: &[f32], rho: f64, y: &[f32], gram_y: &mut [f32]) {
    for ((g, &r), &y) in gram_y.iter_mut().zip(r).zip(y) {
        *g = (f64::from(r) - rho * f64::from(y)) as f32;
    }
}

/// The data term `½‖b − A v‖²` as a solver sees it.
pub trait DataTerm: Send {
    /// `A`.
    fn operator(&self) -> &dyn LinearOperator;

    /// `b`.
    fn measured(&self) -> &[f32];

    /// Number of measurements that carry information.
    fn measurement_count(&self) -> usize;

    /// Typical size of a diagonal element of `A Aᵀ`.
    fn scale(&self) -> f64;

    /// Smallest `ρ` for which [`Self::solve_gram`] has digits.
    fn min_rho(&self) -> f64 {
        0.0
    }

    /// See [`GramSolver::solve_with_product`]. Returns whether `y` is as good as it was asked to be.
    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool;

    /// Root mean square of `residual` over the measurements that see each bin.
    fn misfit_of_bins(&self, residual: &[f32]) -> Vec<f64>;

    /// From now on videos are zero outside `support`.
    fn restrict(&mut self, support: &Support);

    /// `P Aᵀ y`, with `P` the projection onto the support that it was last restricted to; `support`
    /// is that.
    fn adjoint_on(&self, y: &[f32], support: Option<&Support>, video: &mut [f32]) {
        self.operator().adjoint(y, video);
        if let Some(support) = support {
            support.apply(video);
        }
    }

    /// Calls `write(start, part, target)` for parts of [`Self::adjoint_on`] and of `target` that begin at `start`, for
    /// all that the support does not keep dark: while they are at hand, and without a video between.
    fn adjoint_each(
        &self,
        y: &[f32],
        support: Option<&Support>,
        target: &mut [f32],
        write: WritePart,
    ) {
        let mut video = vec![0.0; target.len()];
        self.adjoint_on(y, support, &mut video);
        crate::linop::write_parts(&video, target, write);
    }

    /// Whether another `ρ` costs far more than an iteration: factors of thousands of measurements.
    fn has_large_blocks(&self) -> bool {
        false
    }

    /// Most voxels of a bin that [`Self::restrict`] is worth its cost for; of more, the prior alone
    /// keeps the others dark.
    fn max_active_voxels(&self) -> usize {
        usize::MAX
    }

    /// Follows the light of `video`, where the noise depends on it: whether `A` and `b`, of
    /// which the weights are a part, have changed.
    fn update_weights(&mut self, _video: &[f32]) -> bool {
        false
    }
}
