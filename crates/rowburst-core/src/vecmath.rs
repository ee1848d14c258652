//! Dot products and norms with f64 accumulation, products of spectra, small normal equations, and the selection of
//! SIMD instructions.
//!
//! Hot loops are plain Rust. [`simd`] compiles them once for each instruction set and selects the widest that the
//! processor has at run time (AVX-512, AVX2 or NEON). With `ROWBURST_SIMD=portable` in the environment it uses only
//! instructions that every processor of the architecture has.

use crate::error::Subject;
use crate::{Error, Parameter, Result};
use faer::linalg::solvers::Solve;
use faer::{Mat, Side};
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use rustfft::num_complex::Complex;
use std::sync::OnceLock;

/// Elements of a parallel task in a reduction; fixed, so that a sum does not depend on the number of threads.
const CHUNK: usize = 1 << 14;

/// Runs `work` compiled for the widest instruction set of this processor.
///
/// `work` and all functions that it calls must be `#[inline(always)]`; others keep the default instruction set.
#[inline(always)]
pub fn simd<R>(work: impl FnOnce() -> R) -> R {
    struct Work<F>(F);
    impl<R, F: FnOnce() -> R> pulp::NullaryFnOnce for Work<F> {
        type Output = R;
        #[inline(always)]
        fn call(self) -> R {
            self.0()
        }
    }
    arch().dispatch(Work(work))
}

/// The widest instruction set that may be used.
#[inline(always)]
fn arch() -> Arch {
    static ARCH: OnceLock<Arch> = OnceLock::new();
    *ARCH.get_or_init(|| {
        if is_portable() {
            Arch::Scalar
        } else {
            Arch::new()
        }
    })
}

/// Name of the instruction set that [`simd`] selects on this machine.
///
/// Results of different instruction sets agree up to rounding, not to the bit.
pub fn instruction_set() -> &'static str {
    match arch() {
        Arch::Scalar => PORTABLE,
        #[cfg(target_arch = "x86_64")]
        Arch::V3(_) => "avx2",
        #[cfg(target_arch = "x86_64")]
        Arch::V4(_) => "avx512",
        #[cfg(target_arch = "aarch64")]
        Arch::Neon(_) => "neon",
        #[allow(
            unreachable_patterns,
            reason = "the enum may grow on some targets alone"
        )]
        _ => "unknown",
    }
}

/// The environment variable that selects the instruction set.
const CHOICE: &str = "ROWBURST_SIMD";
const PORTABLE: &str = "portable";

/// Whether `ROWBURST_SIMD=portable` is set.
pub fn is_portable() -> bool {
    std::env::var_os(CHOICE).is_some_and(|value| value == PORTABLE)
}

/// Checks `ROWBURST_SIMD` in the environment. Programs call this; the library itself ignores unknown values.
///
/// # Errors
/// If the variable is set to anything but `portable`.
pub fn check_environment() -> Result<()> {
    match std::env::var_os(CHOICE) {
        Some(value) if value != PORTABLE => Err(Error::input(
            Subject::item(Parameter::Simd, format!("{CHOICE} in the environment")),
            value.to_string_lossy(),
            "it is `portable`, or not set",
            "Unset it: the widest SIMD instructions of this processor are used by default.",
        )),
        _ => Ok(()),
    }
}

/// Real types whose complex numbers have SIMD products.
pub trait Lanes: Sized {
    /// `sum += a · b`, or `sum += a* · b` if `IS_CONJUGATE`.
    ///
    /// # Panics
    /// If `a` or `b` is shorter than `sum`.
    fn add_products<S: Simd, const IS_CONJUGATE: bool>(
        simd: S,
        sum: &mut [Complex<Self>],
        a: &[Complex<Self>],
        b: &[Complex<Self>],
    );
}

macro_rules! lanes {
    ($real:ty, $split:ident, $split_mut:ident, $multiply:ident, $multiply_conjugate:ident) => {
        impl Lanes for $real {
            #[inline(always)]
            fn add_products<S: Simd, const IS_CONJUGATE: bool>(
                simd: S,
                sum: &mut [Complex<Self>],
                a: &[Complex<Self>],
                b: &[Complex<Self>],
            ) {
                let length = sum.len();
                let (sums, sum_rest) = S::$split_mut(sum);
                let ((a, a_rest), (b, b_rest)) = (S::$split(&a[..length]), S::$split(&b[..length]));
                for ((s, &a), &b) in sums.iter_mut().zip(a).zip(b) {
                    *s = match IS_CONJUGATE {
                        true => simd.$multiply_conjugate(a, b, *s),
                        false => simd.$multiply(a, b, *s),
                    };
                }
                for ((s, a), b) in sum_rest.iter_mut().zip(a_rest).zip(b_rest) {
                    *s += if IS_CONJUGATE { a.conj() * b } else { a * b };
                }
            }
        }
    };
}
lanes!(
    f32,
    as_simd_c32s,
    as_mut_simd_c32s,
    mul_add_e_c32s,
    conj_mul_add_e_c32s
);
lanes!(
    f64,
    as_simd_c64s,
    as_mut_simd_c64s,
    mul_add_e_c64s,
    conj_mul_add_e_c64s
);

struct Products<'a, T, const IS_CONJUGATE: bool>(
    &'a mut [Complex<T>],
    &'a [Complex<T>],
    &'a [Complex<T>],
);

impl<T: Lanes, const IS_CONJUGATE: bool> WithSimd for Products<'_, T, IS_CONJUGATE> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        T::add_products::<S, IS_CONJUGATE>(simd, self.0, self.1, self.2);
    }
}

/// `sum += a · b`.
///
/// # Panics
/// If `a` or `b` is shorter than `sum`.
pub fn add_products<T: Lanes>(sum: &mut [Complex<T>], a: &[Complex<T>], b: &[Complex<T>]) {
    arch().dispatch(Products::<T, false>(sum, a, b));
}

/// `sum += a* · b`.
///
/// # Panics
/// If `a` or `b` is shorter than `sum`.
pub fn add_conjugate_products<T: Lanes>(
    sum: &mut [Complex<T>],
    a: &[Complex<T>],
    b: &[Complex<T>],
) {
    arch().dispatch(Products::<T, true>(sum, a, b));
}

/// `len` zeros in memory that is in place. The pages of `vec![0.0; len]` come at their first use: one that is read before it is
/// written comes twice, and all threads wait for the second time.
pub fn zeros<T: Copy + Default + Send + Sync>(len: usize) -> Vec<T> {
    let mut values = vec![T::default(); len];
    let parts = values.par_chunks_mut(CHUNK);
    parts.for_each(|part| part.fill(T::default()));
    values
}

/// `Σ aᵢ bᵢ`.
///
/// # Panics
/// If the lengths differ.
pub fn dot(a: &[f32], b: &[f32]) -> f64 {
    reduce(a, b, |a, b| f64::from(a) * f64::from(b))
}

/// `Σ aᵢ²`.
pub fn norm_squared(a: &[f32]) -> f64 {
    dot(a, a)
}

/// `√Σ aᵢ²`.
pub fn norm(a: &[f32]) -> f64 {
    norm_squared(a).sqrt()
}

/// `Σ (aᵢ − bᵢ)²`.
///
/// # Panics
/// If the lengths differ.
pub fn distance_squared(a: &[f32], b: &[f32]) -> f64 {
    reduce(a, b, |a, b| f64::from(a - b).powi(2))
}

/// Sum of `term` over pairs of elements, in parallel.
fn reduce(a: &[f32], b: &[f32], term: impl Fn(f32, f32) -> f64 + Sync + Copy) -> f64 {
    assert_eq!(a.len(), b.len());
    let partial: Vec<f64> = a
        .par_chunks(CHUNK)
        .zip(b.par_chunks(CHUNK))
        .map(|(a, b)| {
            simd(
                #[inline(always)]
                || sum_of_lanes(a, b, term),
            )
        })
        .collect();
    partial.iter().sum()
}

/// Sum of `term` over pairs of elements, with eight running sums: the compiler can use SIMD without reordering any
/// sum.
#[inline(always)]
pub(crate) fn sum_of_lanes(a: &[f32], b: &[f32], term: impl Fn(f32, f32) -> f64) -> f64 {
    let mut lanes = [0.0; 8];
    let (a8, a_rest) = a.as_chunks::<8>();
    let (b8, b_rest) = b.as_chunks::<8>();
    for (a, b) in a8.iter().zip(b8) {
        for lane in 0..8 {
            lanes[lane] += term(a[lane], b[lane]);
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(&a, &b)| term(a, b)).sum();
    lanes.iter().sum::<f64>() + rest
}

/// Solves the normal equations `G x = b`, with `G` symmetric and positive definite.
///
/// `gram` has as many rows and columns as `b` has elements. Returns `None` if `G` is not positive definite or if `x`
/// is not finite.
pub fn solve_normal<Row: AsRef<[f64]>>(gram: &[Row], b: &[f64]) -> Option<Vec<f64>> {
    let n = b.len();
    let factor = Mat::from_fn(n, n, |i, j| gram[i].as_ref()[j]).llt(Side::Lower);
    let x = factor.ok()?.solve(Mat::from_fn(n, 1, |i, _| b[i]));
    let x: Vec<f64> = (0..n).map(|i| x[(i, 0)]).collect();
    x.iter().all(|v| v.is_finite()).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_agree_with_the_naive_ones() {
        for length in [0, 1, 7, 8, 9, 100_003] {
            let a: Vec<f32> = (0..length).map(|i| (i as f32 * 0.37).sin()).collect();
            let b: Vec<f32> = (0..length).map(|i| (i as f32 * 0.11).cos()).collect();
            let naive: f64 = a
                .iter()
                .zip(&b)
                .map(|(&a, &b)| f64::from(a) * f64::from(b))
                .sum();
            assert!((dot(&a, &b) - naive).abs() < 1e-9 * (length as f64 + 1.0));
            let far: f64 = a
                .iter()
                .zip(&b)
                .map(|(&a, &b)| f64::from(a - b).powi(2))
                .sum();
            assert!((distance_squared(&a, &b) - far).abs() < 1e-9 * (length as f64 + 1.0));
        }
    }

    #[test]
    fn normal_equations_are_solved_where_they_can_be() {
        let x = solve_normal(&[[4.0, 2.0], [2.0, 3.0]], &[10.0, 9.0]).unwrap();
        assert!((x[0] - 1.5).abs() < 1e-12 && (x[1] - 2.0).abs() < 1e-12);
        assert_eq!(solve_normal(&[[1.0, 2.0], [2.0, 1.0]], &[1.0, 1.0]), None);
        assert_eq!(solve_normal(&[[f64::NAN]], &[1.0]), None);
    }

    /// The processor's own set is used, as on ARM under an emulator.
    #[test]
    fn the_set_of_the_processor_is_used() {
        #[cfg(target_arch = "aarch64")]
        let own = std::arch::is_aarch64_feature_detected!("neon").then_some("neon");
        #[cfg(target_arch = "x86_64")]
        let own = std::arch::is_x86_feature_detected!("avx2").then_some("avx");
        #[cfg(not(any(target_arch = "aarch64", target_arch = "x86_64")))]
        let own: Option<&str> = None;
        let own = own.filter(|_| !is_portable()).unwrap_or_default();
        assert!(
            instruction_set().starts_with(own),
            "{own}: {}",
            instruction_set()
        );
    }
}
