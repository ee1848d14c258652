//! Fourier transforms: their plans, lengths at which they are fast, and transforms of square arrays.

use crate::vecmath::is_portable;
use rayon::prelude::*;
use realfft::{ComplexToReal, FftNum, RealFftPlanner, RealToComplex};
use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlanner, FftPlannerScalar};
use std::sync::Arc;

/// A number with Fourier transforms: `f32` or `f64`.
///
/// Its plans are made in this module only. The planners are generic in the number, so each crate that calls them
/// compiles all transforms of `rustfft` again.
pub trait FftNumber: FftNum {
    /// The forward and the inverse complex transform of `length` points, without normalisation; scalar code if
    /// [`is_portable`].
    fn complex_transforms(length: usize) -> (Arc<dyn Fft<Self>>, Arc<dyn Fft<Self>>);

    /// The transform of `length` real points into `length / 2 + 1` complex ones and its inverse, without normalisation.
    fn real_transforms(
        length: usize,
    ) -> (Arc<dyn RealToComplex<Self>>, Arc<dyn ComplexToReal<Self>>);
}

macro_rules! impl_fft_number {
    ($number:ty) => {
        impl FftNumber for $number {
            fn complex_transforms(length: usize) -> (Arc<dyn Fft<Self>>, Arc<dyn Fft<Self>>) {
                if is_portable() {
                    let mut planner = FftPlannerScalar::new();
                    (
                        planner.plan_fft_forward(length),
                        planner.plan_fft_inverse(length),
                    )
                } else {
                    let mut planner = FftPlanner::new();
                    (
                        planner.plan_fft_forward(length),
                        planner.plan_fft_inverse(length),
                    )
                }
            }

            fn real_transforms(
                length: usize,
            ) -> (Arc<dyn RealToComplex<Self>>, Arc<dyn ComplexToReal<Self>>) {
                let mut planner = RealFftPlanner::new();
                (
                    planner.plan_fft_forward(length),
                    planner.plan_fft_inverse(length),
                )
            }
        }
    };
}

impl_fft_number!(f32);
impl_fft_number!(f64);

/// Forward and inverse transforms of `n × n` points, without normalisation.
#[derive(Clone)]
pub struct Fft2 {
    n: usize,
    forward: Arc<dyn Fft<f32>>,
    inverse: Arc<dyn Fft<f32>>,
}

impl Fft2 {
    /// The transforms of arrays of `n × n` points.
    pub fn new(n: usize) -> Self {
        let (forward, inverse) = f32::complex_transforms(n);
        Self {
            n,
            forward,
            inverse,
        }
    }

    /// `X[l, k] = Σ x[n, m] exp(−2πi(kn + lm)/N)`: the result is **transposed**.
    pub fn forward(&self, data: &mut [Complex32]) {
        self.apply(self.forward.as_ref(), data);
    }

    /// The transform with the other sign; transposes too, so that forward then
    /// inverse gives the array back in its order, times `n²`.
    pub fn inverse(&self, data: &mut [Complex32]) {
        self.apply(self.inverse.as_ref(), data);
    }

    fn apply(&self, fft: &dyn Fft<f32>, data: &mut [Complex32]) {
        assert_eq!(data.len(), self.n * self.n, "a square array");
        self.rows(fft, data);
        self.transpose(data);
        self.rows(fft, data);
    }

    fn rows(&self, fft: &dyn Fft<f32>, data: &mut [Complex32]) {
        let scratch = || vec![Complex32::default(); fft.get_inplace_scratch_len()];
        data.par_chunks_exact_mut(self.n)
            .for_each_init(scratch, |scratch, row| {
                fft.process_with_scratch(row, scratch);
            });
    }

    /// In tiles, so that both of the swapped places stay in the cache.
    fn transpose(&self, data: &mut [Complex32]) {
        const TILE: usize = 32;
        let n = self.n;
        for y0 in (0..n).step_by(TILE) {
            for x0 in (y0..n).step_by(TILE) {
                for y in y0..(y0 + TILE).min(n) {
                    for x in x0.max(y + 1)..(x0 + TILE).min(n) {
                        data.swap(y * n + x, x * n + y);
                    }
                }
            }
        }
    }
}

/// The smallest number of the form 2ᵃ3ᵇ5ᶜ that is at least `least`: these are fast.
pub fn smooth_length(least: usize) -> usize {
    (least.max(1)..).find(|&n| is_smooth(n)).unwrap_or(least)
}

/// The smallest even number of the form 2ᵃ3ᵇ5ᶜ that is at least `least`, for transforms of real numbers.
pub fn smooth_even_length(least: usize) -> usize {
    2 * smooth_length(least.div_ceil(2))
}

/// The smallest multiple of 4 of the form 2ᵃ3ᵇ or 2ᵃ3ᵇ5 that is at least `least`. Transforms of some other smooth lengths
/// take up to 3.5 times as long (docs/design/001).
pub fn fast_length(least: usize) -> usize {
    (least.div_ceil(4).max(1)..)
        .find(|&quarter| is_smooth(quarter) && !quarter.is_multiple_of(25))
        .map_or(least, |quarter| 4 * quarter)
}

/// Whether `n` has no prime factor above 5.
fn is_smooth(mut n: usize) -> bool {
    for prime in [2, 3, 5] {
        while n.is_multiple_of(prime) {
            n /= prime;
        }
    }
    n == 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_the_sum_and_comes_back() {
        let n = 45;
        let fft = Fft2::new(n);
        let input: Vec<Complex32> = (0..n * n)
            .map(|i| Complex32::new((i * i % 17) as f32 - 8.0, (i * 7 % 11) as f32 - 5.0))
            .collect();
        let mut data = input.clone();
        fft.forward(&mut data);
        for (ky, kx) in [(0, 0), (3, 41), (44, 1), (22, 23)] {
            let mut sum = rustfft::num_complex::Complex64::default();
            for (i, value) in input.iter().enumerate() {
                let cycles = (ky * (i / n) + kx * (i % n)) as f64 / n as f64;
                let turn = rustfft::num_complex::Complex64::cis(-std::f64::consts::TAU * cycles);
                sum +=
                    turn * rustfft::num_complex::Complex64::new(value.re.into(), value.im.into());
            }
            let got = data[kx * n + ky];
            assert!((got.re - sum.re as f32).abs() < 0.01, "{got} {sum}");
            assert!((got.im - sum.im as f32).abs() < 0.01, "{got} {sum}");
        }
        fft.inverse(&mut data);
        for (got, want) in data.iter().zip(&input) {
            assert!((got / (n * n) as f32 - want).norm() < 1e-4);
        }
    }

    #[test]
    fn lengths_are_smooth() {
        let lengths = [1, 7, 11, 595, 1025].map(smooth_length);
        assert_eq!(lengths, [1, 8, 12, 600, 1080]);
        let even = [0, 1, 7, 11, 595, 1123].map(smooth_even_length);
        assert_eq!(even, [2, 2, 8, 12, 600, 1152]);
        let fast = [0, 7, 162, 200, 245, 450, 599].map(fast_length);
        assert_eq!(fast, [4, 8, 180, 216, 256, 480, 640]);
    }
}
