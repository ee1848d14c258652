//! Proximal operators of the priors.
//!
//! [`Variation`] is the fused one of the default; [`Composite`] adds terms of any kind.

pub mod composite;
pub mod dual;
pub mod lowrank;
mod rows;
pub mod sparse;
pub mod sum_prior;
pub mod variation;
pub mod variation3d;
mod wavefront;

pub use composite::Composite;
pub use dual::DualTerm;
pub use lowrank::LowRank;
pub use sparse::Sparse;
pub use sum_prior::SumPrior;
pub use variation::{Variation, VariationWeights};
pub use variation3d::{Isotropy, Variation3d};

use crate::Support;

/// A convex prior `R(v)` with the constraint `v ≥ 0` inside.
///
/// An iterative prox may keep its inner state from call to call, so that each call
/// goes on where the last one stopped.
pub trait Prox: Send {
    /// `z = argmin_{z≥0} ½‖z − q‖² + scale·R(z)`; overwrites `z`.
    ///
    /// # Panics
    /// If a length does not match.
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]);

    /// `R(z)`.
    fn value(&self, z: &[f32]) -> f64;

    /// Estimate of the number of values in `z` that the data are free to choose;
    /// differences below `tolerance` count as none.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64;

    /// From now on the prox is taken over videos that are zero outside `support`.
    fn restrict(&mut self, support: &Support);

    /// `v −= c` for a `c` with `⟨c, w⟩ ≤ scale·R(w)` for every `w ≥ 0`: the dual point at
    /// which the last call of [`Self::prox`] ended, with its `scale`. Where that is
    /// positive, `v` is more than the prior holds back. Elements below zero may be cut.
    fn subtract_dual(&self, v: &mut [f32]);
}

#[cfg(test)]
mod tests;
