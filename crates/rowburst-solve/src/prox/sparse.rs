//! Few coefficients of a transform of each bin.
//!
//! ```text
//! R(v) = Σ_bins Σ_k c_k |(K v)_k|
//! ```
//!
//! with [`Cosine`] (`dct`: smooth or periodic pictures; boundary
//! half-sample symmetric) or [`Wavelet`] (`wavelet`: smooth shapes
//! with some edges, at any place; boundary periodic) as `K`, and the weights `c_k` of its
//! bands. The dual ball is a box, `|p_k| ≤ s w c_k`.

use super::dual::{self, DualTerm};
use super::term::TermSpec;
use rayon::prelude::*;
use rowburst_core::linop::{Band, BinTransform, Cosine, LinearOperator, OverBins, Wavelet};

/// The term `dct`.
pub const DCT: TermSpec = TermSpec {
    unit: |_| 3.0,
    ..TermSpec::dual("dct", "smooth or periodic pictures", |shape| {
        Box::new(Sparse::new(
            shape.bins,
            Cosine::new(shape.rows, shape.columns),
        ))
    })
};

/// The term `wavelet`.
pub const WAVELET: TermSpec = TermSpec {
    unit: |_| 5.0,
    ..TermSpec::dual("wavelet", "smooth shapes with some edges", |shape| {
        Box::new(Sparse::new(
            shape.bins,
            Wavelet::new(shape.rows, shape.columns),
        ))
    })
};

/// The weighted ℓ1 norm of the coefficients of every bin.
#[derive(Clone)]
pub struct Sparse<T> {
    transform: OverBins<T>,
    bands: Vec<Band>,
    dual: Vec<f32>,
}

impl<T: BinTransform> Sparse<T> {
    /// The term over `bins` bins, with its dual at zero.
    pub fn new(bins: usize, transform: T) -> Self {
        let bands = transform.bands();
        let transform = OverBins::new(bins, transform);
        Self {
            dual: vec![0.0; transform.range_len()],
            bands,
            transform,
        }
    }

    /// Sum over all bins of `of_bin(coefficients)`.
    fn sum_over_bins(&self, z: &[f32], of_bin: impl Fn(&[f32]) -> f64 + Sync) -> f64 {
        let sums: Vec<f64> = z
            .par_chunks_exact(self.transform.shape().pixels())
            .map(|bin| {
                let mut coefficients = vec![0.0; self.transform.coefficients_per_bin()];
                self.transform.transform().analyse(bin, &mut coefficients);
                of_bin(&coefficients)
            })
            .collect();
        sums.iter().sum()
    }
}

/// Each band with its part of `coefficients`.
fn runs<'a>(
    bands: &'a [Band],
    coefficients: &'a [f32],
) -> impl Iterator<Item = (&'a Band, &'a [f32])> {
    bands.iter().scan(coefficients, |rest, band| {
        let (run, after) = rest.split_at(band.length);
        *rest = after;
        Some((band, run))
    })
}

/// `Σ c_k |coefficient_k|`.
fn weighted_l1(bands: &[Band], coefficients: &[f32]) -> f64 {
    runs(bands, coefficients)
        .map(|(band, run)| {
            f64::from(band.weight) * run.iter().map(|c| f64::from(c.abs())).sum::<f64>()
        })
        .sum()
}

impl<T: BinTransform + Clone> DualTerm for Sparse<T> {
    fn norm_squared(&self) -> f64 {
        1.0
    }

    fn subtract_adjoint(&self, z: &mut [f32]) {
        let pixels = self.transform.shape().pixels();
        z.par_chunks_exact_mut(pixels)
            .zip(
                self.dual
                    .par_chunks_exact(self.transform.coefficients_per_bin()),
            )
            .for_each(|(z, p)| {
                let mut bin = vec![0.0; pixels];
                self.transform.transform().synthesise(p, &mut bin);
                z.iter_mut().zip(&bin).for_each(|(z, b)| *z -= b);
            });
    }

    fn step(&mut self, z: &[f32], step: f32, radius: f32) -> f64 {
        let (transform, bands) = (&self.transform, &self.bands);
        let sums: Vec<f64> = self
            .dual
            .par_chunks_exact_mut(transform.coefficients_per_bin())
            .zip(z.par_chunks_exact(transform.shape().pixels()))
            .map(|(mut p, bin)| {
                let mut coefficients = vec![0.0; p.len()];
                transform.transform().analyse(bin, &mut coefficients);
                for (band, run) in runs(bands, &coefficients) {
                    let (now, after) = p.split_at_mut(band.length);
                    let bound = radius * band.weight;
                    for (p, c) in now.iter_mut().zip(run) {
                        *p = (*p + step * c).max(-bound).min(bound);
                    }
                    p = after;
                }
                weighted_l1(bands, &coefficients)
            })
            .collect();
        sums.iter().sum()
    }

    fn rescale(&mut self, factor: f32) {
        dual::scale(&mut self.dual, factor);
    }

    fn value(&self, z: &[f32]) -> f64 {
        self.sum_over_bins(z, |coefficients| weighted_l1(&self.bands, coefficients))
    }

    /// The coefficients above `tolerance`, each with its share, and what the transform does
    /// not see (Zou, Hastie & Tibshirani 2007: those that are not zero).
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let unseen = self.transform.transform().unseen();
        self.sum_over_bins(z, |coefficients| {
            let seen: f64 = runs(&self.bands, coefficients)
                .map(|(band, run)| {
                    band.share * run.iter().filter(|c| c.abs() > tolerance).count() as f64
                })
                .sum();
            seen + unseen
        })
    }
}
