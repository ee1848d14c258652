//! Linear operators: a matrix-free map and its exact adjoint.
//!
//! Operators know no optics. Every implementation passes [`laws`]: it is linear, its adjoint is exact, and it
//! overwrites its outputs.

mod background;
mod bins;
mod cosine;
mod differences;
pub mod laws;
mod norm;
mod subspace;
mod wavelet;
mod weighted;

pub use background::{Background, WithBackground, sum_of_bins};
pub use bins::{Band, BinTransform, OverBins};
pub use cosine::{Cosine, CosineLines};
pub use differences::{Axis, Differences};
pub use norm::operator_norm;
pub use subspace::{Subspace, WithoutSubspace};
pub use wavelet::Wavelet;
pub use weighted::WeightedOperator;

use rayon::prelude::*;
use std::ops::{AddAssign, MulAssign, SubAssign};
use std::sync::Arc;

/// The number type of an operator: `f32`, or `f64` where a caller needs its precision.
///
/// Only these two types implement it.
pub trait Scalar:
    number::Number + AddAssign + SubAssign + MulAssign + From<f32> + Into<f64>
{
    /// The nearest number to `value`.
    fn nearest(value: f64) -> Self;
}

mod number {
    use crate::fft::FftNumber;
    use crate::vecmath::Lanes;

    /// What the transforms and factorisations need of a number; it seals [`super::Scalar`].
    pub trait Number: FftNumber + faer::traits::RealField + Lanes {}

    impl Number for f32 {}
    impl Number for f64 {}
}

impl Scalar for f32 {
    fn nearest(value: f64) -> Self {
        value as f32
    }
}

impl Scalar for f64 {
    fn nearest(value: f64) -> Self {
        value
    }
}

/// A callback `write(start, part, target)` that combines a part of a vector with the same part of a target.
///
/// Both parts begin at element `start`.
pub type WritePart<'w, T = f32> = &'w (dyn Fn(usize, &[T], &mut [T]) + Sync);

/// Elements of a part in [`write_parts`]; larger leaves fewer parts to share among threads.
pub const WRITE_PART_LEN: usize = 1 << 14;

/// Calls `write` for each part of `values` and `target`, in any order and in parallel.
pub fn write_parts<T: Scalar>(values: &[T], target: &mut [T], write: WritePart<T>) {
    let parts = target
        .par_chunks_mut(WRITE_PART_LEN)
        .zip(values.par_chunks(WRITE_PART_LEN));
    parts
        .enumerate()
        .for_each(|(i, (target, part))| write(i * WRITE_PART_LEN, part, target));
}

/// A linear map from vectors of `domain_len` elements to vectors of `range_len` elements.
pub trait LinearOperator<T = f32>: Sync {
    /// Length of the input of [`Self::apply`].
    fn domain_len(&self) -> usize;

    /// Length of the output of [`Self::apply`].
    fn range_len(&self) -> usize;

    /// `y = A x`; overwrites `y`.
    ///
    /// # Panics
    /// If a length does not match.
    fn apply(&self, x: &[T], y: &mut [T]);

    /// `x = Aᵀ y`; overwrites `x`.
    ///
    /// # Panics
    /// If a length does not match.
    fn adjoint(&self, y: &[T], x: &mut [T]);
}

impl<T, O: LinearOperator<T> + Send> LinearOperator<T> for Arc<O> {
    fn domain_len(&self) -> usize {
        self.as_ref().domain_len()
    }

    fn range_len(&self) -> usize {
        self.as_ref().range_len()
    }

    fn apply(&self, x: &[T], y: &mut [T]) {
        self.as_ref().apply(x, y);
    }

    fn adjoint(&self, y: &[T], x: &mut [T]) {
        self.as_ref().adjoint(y, x);
    }
}
