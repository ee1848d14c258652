//! Solvers for `min_{v≥0} ½‖b − A v‖² + τ R(v)` (Eq. 5 in the head of the crate).
//!
//! They work on operators and know no optics.

pub mod admm;
pub mod block_band;
pub mod blocks;
pub mod certificate;
pub mod conjugate_gradient;
pub mod coupled_blocks;
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
    /// The [`Certificate`] reached the tolerance.
    Converged,
    /// The largest number of iterations was reached first.
    IterationLimit,
    /// The observer stopped it at the end of its time budget.
    TimeBudget,
    /// The observer stopped it at the user's request.
    Interrupted,
}

impl StopReason {
    /// Its name in `result.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Converged => "converged",
            Self::IterationLimit => "iteration-limit",
            Self::TimeBudget => "time-budget",
            Self::Interrupted => "interrupted",
        }
    }
}

/// Solver of `(A P Aᵀ + ρI) y = r`, with `P` the projection onto the support.
pub trait GramSolver: Send {
    /// Writes the solution to `y`.
    fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32]);

    /// Writes the solution to `y`, and `A P Aᵀ y` to `gram_y`.
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
    fn measurements(&self) -> &[f32];

    /// Number of measurements with a weight above zero.
    fn measurement_count(&self) -> usize;

    /// Typical size of a diagonal element of `A Aᵀ`.
    fn scale(&self) -> f64;

    /// Smallest `ρ` at which [`Self::solve_gram`] is numerically stable.
    fn min_rho(&self) -> f64 {
        0.0
    }

    /// See [`GramSolver::solve_with_product`]. Returns whether the solution is accurate: the iteration reached its
    /// tolerance, or the factor is well conditioned.
    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool;

    /// For each bin, the root mean square of `residual` over the measurements that see it.
    fn residual_rms_of_bins(&self, residual: &[f32]) -> Vec<f64>;

    /// Restricts videos to `support`: they are zero outside it from now on.
    fn restrict(&mut self, support: &Support);

    /// Writes `P Aᵀ y` to `video`, with `P` the projection onto `support` (`None`: every voxel).
    ///
    /// `support` is the one of the last [`Self::restrict`].
    fn adjoint_on(&self, y: &[f32], support: Option<&Support>, video: &mut [f32]) {
        self.operator().adjoint(y, video);
        if let Some(support) = support {
            support.zero_outside(video);
        }
    }

    /// Computes [`Self::adjoint_on`] part by part; an implementation may do without memory for a whole video.
    ///
    /// Calls `write(start, part, target)` for each part, in any order and in parallel: `part` is the result from
    /// element `start` on, and `target` has the same elements of the argument `target`. Parts without an active voxel
    /// may be left out.
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

    /// Whether the run is cancelled. Then [`Self::solve_gram`] may return early, with a wrong solution.
    fn is_cancelled(&self) -> bool {
        false
    }

    /// Whether a change of `ρ` costs far more than an iteration, since Gram blocks with thousands of measurements are
    /// factored again.
    fn has_large_blocks(&self) -> bool {
        false
    }

    /// Most active voxels of a bin for which a restricted data step takes less time than an unrestricted one.
    ///
    /// A bin with more is unrestricted in the data step; the prior alone keeps its inactive voxels at zero.
    fn max_restricted_voxels(&self) -> usize {
        usize::MAX
    }

    /// Computes the weights of the measurements afresh, where the noise depends on the light of `video`.
    ///
    /// Returns whether it did. If so, [`Self::operator`] and [`Self::measurements`] have changed, since they contain
    /// the weights.
    fn update_weights(&mut self, _video: &[f32]) -> bool {
        false
    }
}
