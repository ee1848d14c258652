//! Solvers and priors for `min_{v≥0} ½‖b − A v‖² + τ R(v)` (Eq. 5 in the head of the crate `rowburst`).
//!
//! They work on operators and know no optics.

pub mod admm;
pub mod block_band;
pub mod blocks;
mod capabilities;
pub mod certificate;
pub mod conjugate_gradient;
pub mod coupled_blocks;
pub mod prox;

pub(crate) use capabilities::write_adjoint;
pub use capabilities::{Capabilities, DataHints, FusedAdjoint, ProblemKind};
pub use certificate::Certificate;

use rowburst_core::Support;
use rowburst_core::linop::LinearOperator;

/// Why a solver stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
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

    /// Solves `(A P Aᵀ + ρI) y = r` and writes `A P Aᵀ y` to `gram_y`. Returns whether the solution is accurate: the
    /// iteration reached its tolerance, or the factor is well conditioned.
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

    /// Computes the weights of the measurements afresh, where the noise depends on the light of `video`.
    ///
    /// Returns whether it did. If so, [`Self::operator`] and [`Self::measurements`] have changed, since they contain
    /// the weights.
    fn update_weights(&mut self, _video: &[f32]) -> bool {
        false
    }

    /// What it offers beside the mathematics; by default nothing.
    fn capabilities(&self) -> Capabilities<'_> {
        Capabilities::default()
    }
}
