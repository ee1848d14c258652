//! The x-step of a frame: the system `(B Bᵀ + ρI) y = r` for an active set and a penalty `ρ`.
//!
//! `B = W A P` has the weights `W`, the operator `A` and the projection `P` onto the support. [`XStep`] is the seam:
//! one implementation for each way to solve the system. [`choose`] selects it.
//!
//! | implementation | system | where |
//! |---|---|---|
//! | [`ExactBlocks`] | Cholesky factors of the blocks of instants, or of the smaller system of the active columns (Woodbury, [`rowburst_solve::blocks`]) | no bin is seen by two instants, and the blocks fit in memory |
//! | [`StaticBackground`] | the same blocks, with the Schur complement of a static background | as above, with a static background |
//! | [`ConjugateGradients`] | preconditioned conjugate gradients, or on a small support the factor of `BᵀB + ρI`, banded in time ([`active_system`]) | else |

mod active_system;
mod conjugate_gradients;
mod exact_blocks;
mod preconditioner;
mod static_background;
mod system;

pub(super) use conjugate_gradients::{ConjugateGradients, preconditioner};
pub(super) use exact_blocks::{ExactBlocks, Precision};
pub(super) use static_background::StaticBackground;
pub(super) use system::System;

use rowburst_core::Support;
use rowburst_core::linop::Background;
use rowburst_solve::DataHints;

/// Smallest `ρ` over a typical diagonal element of `A Aᵀ` where blocks would not fit in memory; smaller is not stable.
const MIN_RHO: f64 = 1e-9;

/// `(B Bᵀ + ρI) y = r`, and where its solution is written.
pub(super) struct Equation<'a> {
    pub r: &'a [f32],
    pub rho: f64,
    pub y: &'a mut [f32],
    /// `B Bᵀ y`.
    pub gram_y: &'a mut [f32],
}

/// A solver of `(B Bᵀ + ρI) y = r` for the [`System`] that each call is given.
///
/// It may keep factors and earlier solutions. It is told of every change of the system.
pub(super) trait XStep: Send {
    /// Solves for an `r` that converges over the iterations. Returns whether the solution is accurate.
    fn solve(&mut self, system: &System, equation: Equation) -> bool;

    /// Solves for an `r` that has nothing to do with the one before, where the solution itself is asked for: to the
    /// rounding of a factor, to a residual of 0.01 `ρ‖y‖` by conjugate gradients, or of 0.1 `ρ‖y‖` with a static
    /// background, as in [`Self::solve`].
    fn solve_alone(&mut self, system: &System, equation: Equation);

    /// The system has another support; the last one was `before` (`None`: every voxel).
    fn restrict(&mut self, system: &System, before: Option<&Support>);

    /// The system has other weights, or also another support and background, see [`Self::is_renewed_by_rebuild`].
    fn rebuild(&mut self, system: &System);

    /// Forgets earlier solutions, and returns whether the next ones are then those of a new solver, to the bit. Where it
    /// returns false it may have kept them, and is to be rebuilt or replaced.
    fn reset(&mut self) -> bool;

    /// Whether it solves like a new solver for systems with this background after [`Self::reset`] and
    /// [`Self::rebuild`].
    fn is_renewed_by_rebuild(&self, background: Background) -> bool;

    /// What it costs.
    fn hints(&self, system: &System) -> DataHints;

    /// How it solves now.
    #[cfg(test)]
    fn method(&self) -> Method;
}

/// How an [`XStep`] solves.
#[cfg(test)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Method {
    SingleBlocks,
    DoubleBlocks,
    StaticBackground,
    ConjugateGradients,
    ActiveSystem,
}

/// The solver for `system`.
pub(super) fn choose(system: &System, precision: Precision) -> Box<dyn XStep> {
    if !has_exact_blocks(system) {
        Box::new(ConjugateGradients::new(system, precision))
    } else if system.background() == Background::Static {
        Box::new(StaticBackground::new(system))
    } else {
        Box::new(ExactBlocks::new(system, precision))
    }
}

/// Smallest `ρ` at which the x-step of `system` is numerically stable.
pub(super) fn min_rho(system: &System) -> f64 {
    // Conjugate gradients do not depend on the rounding of a factor. Exposures longer than a row, which have no blocks
    // either, keep the bound of the blocks.
    let ratio = match system.model().gram_bytes() {
        Some(_) => system.shutter().min_rho(),
        None => MIN_RHO,
    };
    ratio * system.scale()
}

/// Whether `B Bᵀ` is block-diagonal in time with blocks that fit in memory.
fn has_exact_blocks(system: &System) -> bool {
    system.shutter().time().is_disjoint() && system.model().gram_bytes().is_some()
}
