//! Transforms of one bin, applied to every bin of a video.

use super::LinearOperator;
use crate::Shape;
use rayon::prelude::*;

/// A run of coefficients that a prior treats alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band {
    /// Number of coefficients.
    pub length: usize,
    /// What a coefficient counts in an ℓ1 norm.
    pub weight: f32,
    /// Degrees of freedom of a coefficient: 1 where the transform is orthogonal, less
    /// where it is redundant.
    pub share: f64,
}

/// A linear transform `K` of a bin `[y, x]` with `‖K‖ ≤ 1`.
pub trait BinTransform: Send + Sync {
    /// Rows and columns of the bin.
    fn bin_shape(&self) -> (usize, usize);

    /// The runs of the coefficients, in their order.
    fn bands(&self) -> Vec<Band>;

    /// `coefficients = K bin`; overwrites `coefficients`.
    ///
    /// # Panics
    /// If a length does not match.
    fn analyse(&self, bin: &[f32], coefficients: &mut [f32]);

    /// `bin = Kᵀ coefficients`; overwrites `bin`.
    ///
    /// # Panics
    /// If a length does not match.
    fn synthesise(&self, coefficients: &[f32], bin: &mut [f32]);

    /// Degrees of freedom of a bin that no coefficient sees.
    fn unseen(&self) -> f64 {
        0.0
    }

    /// Number of coefficients of a bin.
    fn coefficients(&self) -> usize {
        self.bands().iter().map(|band| band.length).sum()
    }
}

/// `K` of every bin: from the video `[t, y, x]` to the coefficients `[t, k]`.
///
/// Adjoint: `Kᵀ` of every bin. Cost: `bins` times that of the transform, in parallel.
#[derive(Clone)]
pub struct OverBins<T> {
    shape: Shape,
    transform: T,
    coefficients: usize,
}

impl<T: BinTransform> OverBins<T> {
    /// `transform` over `bins` bins.
    pub fn new(bins: usize, transform: T) -> Self {
        let (rows, columns) = transform.bin_shape();
        Self {
            shape: Shape::new(bins, rows, columns),
            coefficients: transform.coefficients(),
            transform,
        }
    }

    /// The shape of the video.
    pub fn shape(&self) -> Shape {
        self.shape
    }

    /// The transform of a bin.
    pub fn transform(&self) -> &T {
        &self.transform
    }

    /// Number of coefficients of a bin.
    pub fn coefficients_per_bin(&self) -> usize {
        self.coefficients
    }
}

impl<T: BinTransform> LinearOperator for OverBins<T> {
    fn domain_len(&self) -> usize {
        self.shape.voxels()
    }

    fn range_len(&self) -> usize {
        self.shape.bins * self.coefficients
    }

    fn apply(&self, x: &[f32], y: &mut [f32]) {
        assert_eq!(x.len(), self.domain_len(), "length of the video");
        assert_eq!(y.len(), self.range_len(), "number of coefficients");
        x.par_chunks_exact(self.shape.pixels())
            .zip(y.par_chunks_exact_mut(self.coefficients))
            .for_each(|(bin, coefficients)| self.transform.analyse(bin, coefficients));
    }

    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        assert_eq!(x.len(), self.domain_len(), "length of the video");
        assert_eq!(y.len(), self.range_len(), "number of coefficients");
        x.par_chunks_exact_mut(self.shape.pixels())
            .zip(y.par_chunks_exact(self.coefficients))
            .for_each(|(bin, coefficients)| self.transform.synthesise(coefficients, bin));
    }
}
