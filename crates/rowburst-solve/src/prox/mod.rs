//! Proximal operators of the priors.
//!
//! [`Variation`] computes the terms of the default prior in one fused pass. [`Composite`] adds terms of any kind.
//! [`TERMS`] lists them all.

pub mod composite;
pub mod dual;
#[cfg(test)]
mod example;
mod fused;
pub mod lowrank;
pub mod restricted;
mod rows;
pub mod sparse;
pub mod sum_prior;
mod term;
pub mod variation;
pub mod variation3d;

pub use composite::Composite;
pub use dual::DualTerm;
pub use lowrank::LowRank;
pub use restricted::Restricted;
pub use sparse::Sparse;
pub use sum_prior::SumPrior;
#[doc(hidden)]
pub use term::TermForm;
pub use term::{Coupling, TermSpec};
pub use variation::{Variation, VariationWeights};
pub use variation3d::{Isotropy, Variation3d};

use dyn_clone::DynClone;
use rowburst_core::Support;

/// The convex terms, in the order in which a prior is written.
pub const TERMS: &[TermSpec] = &[
    fused::TV,
    fused::TDIFF,
    fused::L1,
    variation3d::TV3D,
    variation3d::TV3D_ANISO,
    sparse::DCT,
    sparse::WAVELET,
    composite::GROUP,
    lowrank::LOWRANK,
    fused::BACKGROUND,
    lowrank::LOWRANK_BACKGROUND,
];

/// A convex prior `R(v)` that includes the constraint `v ≥ 0`.
///
/// An iterative prox may keep its inner state between calls, so that each call is a warm start from the last one. A clone
/// has the same state, so a copy of a run goes on as the run does.
pub trait Prox: DynClone + Send {
    /// `z = argmin_{z≥0} ½‖z − q‖² + scale·R(z)`; overwrites `z`.
    ///
    /// # Panics
    /// If a length does not match.
    fn prox(&mut self, q: &[f32], scale: f64, z: &mut [f32]);

    /// `R(z)`.
    fn value(&self, z: &[f32]) -> f64;

    /// Estimate of the number of values in `z` that the data are free to choose. Differences below `tolerance` count
    /// as zero.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64;

    /// Restricts all later calls of [`Self::prox`] to videos that are zero outside `support`.
    fn restrict(&mut self, support: &Support);

    /// Whether further calls of an iterative prox take more steps. A solver that accelerates its iteration moves `q` fast, and
    /// needs a result that does not lag behind. Does nothing where the prox is exact.
    fn set_refined(&mut self, _is_refined: bool) {}

    /// `v −= c`, with `c` the dual point at which the last call of [`Self::prox`] ended.
    ///
    /// With the `scale` of that call, `⟨c, w⟩ ≤ scale·R(w)` for every `w ≥ 0`. A positive element of the result shows
    /// that `v` exceeds the dual point there. Negative elements of the result may be set to zero.
    fn subtract_dual(&self, v: &mut [f32]);
}

dyn_clone::clone_trait_object!(Prox);

#[cfg(test)]
mod tests;
