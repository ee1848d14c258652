//! Solvers for `min_{v≥0} ½‖b − A v‖² + τ R(v)` (Eq. 5 in the head of the crate).
//!
//! They work on operators and know no optics.

pub mod admm;
pub mod block_band;
pub mod blocks;
pub mod certificate;
pub mod conjugate_gradient;
pub mod coupled_blocks;

pub use certificate::Certificate;

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

    /// Whether the run is cancelled. Then [`Self::solve_gram`] may return early, with a wrong solution.
    fn is_cancelled(&self) -> bool {
        false
    }

    /// Computes the weights of the measurements afresh, where the noise depends on the light of `video`.
    ///
    /// Returns whether it did. If so, [`Self::operator`] and [`Self::measurements`] have changed, since they contain
    /// the weights.
    fn update_weights(&mut self, _video: &[f32]) -> bool {
        false
    }

    /// What the solver may know of the cost of a step.
    fn hints(&self) -> DataHints {
        DataHints::default()
    }

    /// `P Aᵀ` without memory for a whole video; `None`: there is none.
    fn fused_adjoint(&self) -> Option<&dyn FusedAdjoint> {
        None
    }
}

/// What a solver may know of the cost of a data term. It chooses constants of the iteration, and with them, where the
/// support makes the problem non-convex, which of its solutions is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DataHints {
    /// How much a new `ρ` costs.
    pub size: admm::ProblemSize,
    /// Most active voxels of a bin for which a restricted x-step takes less time than an unrestricted one.
    ///
    /// A bin with more is unrestricted in the x-step; the prior alone keeps its inactive voxels at zero.
    pub max_restricted_voxels: usize,
}

impl Default for DataHints {
    fn default() -> Self {
        Self {
            size: admm::ProblemSize::Small,
            max_restricted_voxels: usize::MAX,
        }
    }
}

/// A data term that computes `P Aᵀ y` part by part.
pub trait FusedAdjoint {
    /// Calls `write(start, part, target)` for each part of [`DataTerm::adjoint_on`], in any order and in parallel:
    /// `part` is the result from element `start` on, and `target` has the same elements of the argument `target`.
    /// Parts without an active voxel may be left out.
    fn adjoint_each(
        &self,
        y: &[f32],
        support: Option<&Support>,
        target: &mut [f32],
        write: WritePart,
    );
}

/// [`FusedAdjoint::adjoint_each`] of any data term.
pub(crate) fn write_adjoint(
    data: &dyn DataTerm,
    y: &[f32],
    support: Option<&Support>,
    target: &mut [f32],
    write: WritePart,
) {
    if let Some(fused) = data.fused_adjoint() {
        return fused.adjoint_each(y, support, target, write);
    }
    let mut video = vec![0.0; target.len()];
    data.adjoint_on(y, support, &mut video);
    crate::linop::write_parts(&video, target, write);
}
