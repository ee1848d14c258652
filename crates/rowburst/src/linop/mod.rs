//! Linear operators: a matrix-free map and its exact adjoint.
//!
//! Operators know no optics. Every implementation passes [`laws`]: linearity,
//! the adjoint identity, and that outputs are overwritten whatever they held.

mod bins;
mod cosine;
mod differences;
pub mod laws;
mod norm;
mod two_parts;
mod wavelet;
mod weighted;

pub use bins::{Band, BinTransform, OverBins};
pub use cosine::Cosine;
pub use differences::{Axis, Differences};
pub use norm::operator_norm;
pub use two_parts::{SecondPart, TwoParts, sum_of_bins};
pub use wavelet::Wavelet;
pub use weighted::Weighted;

/// A linear map from `domain_len` to `range_len` numbers.
pub trait LinearOperator: Sync {
    /// Length of the input of [`Self::apply`].
    fn domain_len(&self) -> usize;

    /// Length of the output of [`Self::apply`].
    fn range_len(&self) -> usize;

    /// `y = A x`; overwrites `y`.
    ///
    /// # Panics
    /// If a length does not match.
    fn apply(&self, x: &[f32], y: &mut [f32]);

    /// `x = Aᵀ y`; overwrites `x`.
    ///
    /// # Panics
    /// If a length does not match.
    fn adjoint(&self, y: &[f32], x: &mut [f32]);
}

impl<O: LinearOperator + Send> LinearOperator for std::sync::Arc<O> {
    fn domain_len(&self) -> usize {
        self.as_ref().domain_len()
    }

    fn range_len(&self) -> usize {
        self.as_ref().range_len()
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        self.as_ref().apply(x, y);
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        self.as_ref().adjoint(y, x);
    }
}
