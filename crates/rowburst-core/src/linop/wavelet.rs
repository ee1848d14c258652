//! The cycle-spun Daubechies wavelet transform of a bin.

use super::bins::{Band, BinTransform};
use crate::vecmath::simd;

/// Most levels. The coarsest wavelet of three levels is 22 pixels wide, as large as the
/// things that a scene holds.
const MAX_LEVELS: usize = 3;

/// The detail coefficients of the orthogonal Daubechies wavelet of four taps (two
/// vanishing moments) for all shifts of the bin at once: the stationary transform
/// ("à trous", Nason & Silverman 1995), whose filters are `1/√2` of the orthogonal ones.
///
/// At level `l = 1 … levels` there are three bands of as many coefficients as pixels, with
/// taps `2^(l−1)` pixels apart. The bin is continued periodically, which for any number of
/// rows and columns leaves `Σ_bands ‖·‖² + ‖approximation‖² = ‖v‖²`. The approximation is
/// left out: brightness as such is no detail.
///
/// A coefficient of level `l` is `2^−l` of the orthogonal transform's, of which one shift
/// in `4^l` has it; with the weight `2^−l` the weighted ℓ1 norm is
/// thus the mean over all shifts of the ℓ1 norm of the orthogonal coefficients
/// (cycle spinning, Coifman & Donoho 1995), which makes no grid visible.
///
/// Adjoint: the same filters the other way. Cost: 24 multiply–adds a pixel and level.
#[derive(Clone)]
pub struct Wavelet {
    rows: usize,
    columns: usize,
    levels: usize,
}

impl Wavelet {
    /// The transform of bins of `rows` × `columns` pixels, with three levels or as
    /// many as the shorter side has halvings.
    pub fn new(rows: usize, columns: usize) -> Self {
        let halvings = rows.min(columns).max(2).ilog2() as usize;
        Self {
            rows,
            columns,
            levels: halvings.min(MAX_LEVELS),
        }
    }

    /// Number of levels.
    pub fn levels(&self) -> usize {
        self.levels
    }

    fn pixels(&self) -> usize {
        self.rows * self.columns
    }

    /// `out += filterᵀ or filter` along x of all lines, with taps `spacing` apart.
    fn along_x(&self, taps: [f32; 4], spacing: isize, from: &[f32], out: &mut [f32]) {
        let lines = from.chunks_exact(self.columns);
        for (from, out) in lines.zip(out.chunks_exact_mut(self.columns)) {
            add_shifted(taps, spacing, from, out, 1);
        }
    }

    fn along_y(&self, taps: [f32; 4], spacing: isize, from: &[f32], out: &mut [f32]) {
        add_shifted(taps, spacing, from, out, self.columns);
    }
}

/// `out[n] += Σ_k taps[k] from[n + k·spacing]`, periodic, in units of `stride` elements.
#[inline(always)]
fn add_shifted(taps: [f32; 4], spacing: isize, from: &[f32], out: &mut [f32], stride: usize) {
    let length = (from.len() / stride) as isize;
    for (k, &tap) in taps.iter().enumerate() {
        let shift = (k as isize * spacing).rem_euclid(length) as usize * stride;
        let (head, tail) = out.split_at_mut(from.len() - shift);
        for (o, f) in head.iter_mut().zip(&from[shift..]) {
            *o += tap * f;
        }
        for (o, f) in tail.iter_mut().zip(&from[..shift]) {
            *o += tap * f;
        }
    }
}

/// Low-pass and high-pass taps, `1/√2` of the orthonormal ones (Daubechies 1988).
fn filters() -> ([f32; 4], [f32; 4]) {
    let root = 3f32.sqrt();
    let low = [1.0 + root, 3.0 + root, 3.0 - root, 1.0 - root].map(|h| h / 8.0);
    (low, [low[3], -low[2], low[1], -low[0]])
}

impl BinTransform for Wavelet {
    fn bin_shape(&self) -> (usize, usize) {
        (self.rows, self.columns)
    }

    fn bands(&self) -> Vec<Band> {
        (1..=self.levels as i32)
            .map(|level| Band {
                length: 3 * self.pixels(),
                weight: 0.5f32.powi(level),
                share: 0.25f64.powi(level),
            })
            .collect()
    }

    fn unseen(&self) -> f64 {
        self.pixels() as f64 * 0.25f64.powi(self.levels as i32)
    }

    fn analyse(&self, bin: &[f32], coefficients: &mut [f32]) {
        assert_eq!(coefficients.len(), 3 * self.levels * bin.len());
        let (low, high) = filters();
        let mut smooth = bin.to_vec();
        let (mut l, mut h) = (vec![0.0f32; bin.len()], vec![0.0f32; bin.len()]);
        coefficients.fill(0.0);
        let levels = coefficients.chunks_exact_mut(3 * bin.len());
        for (level, bands) in levels.enumerate() {
            let spacing = 1isize << level;
            l.fill(0.0);
            h.fill(0.0);
            simd(
                #[inline(always)]
                || {
                    self.along_x(low, spacing, &smooth, &mut l);
                    self.along_x(high, spacing, &smooth, &mut h);
                    smooth.fill(0.0);
                    let (lh, rest) = bands.split_at_mut(bin.len());
                    let (hl, hh) = rest.split_at_mut(bin.len());
                    self.along_y(low, spacing, &l, &mut smooth);
                    self.along_y(high, spacing, &l, lh);
                    self.along_y(low, spacing, &h, hl);
                    self.along_y(high, spacing, &h, hh);
                },
            );
        }
    }

    fn synthesise(&self, coefficients: &[f32], bin: &mut [f32]) {
        assert_eq!(coefficients.len(), 3 * self.levels * bin.len());
        let (low, high) = filters();
        let (mut l, mut h) = (vec![0.0f32; bin.len()], vec![0.0f32; bin.len()]);
        bin.fill(0.0);
        let levels = coefficients.chunks_exact(3 * bin.len());
        for (level, bands) in levels.enumerate().rev() {
            let spacing = -(1isize << level);
            l.fill(0.0);
            h.fill(0.0);
            simd(
                #[inline(always)]
                || {
                    let (lh, rest) = bands.split_at(bin.len());
                    let (hl, hh) = rest.split_at(bin.len());
                    self.along_y(low, spacing, bin, &mut l);
                    self.along_y(high, spacing, lh, &mut l);
                    self.along_y(low, spacing, hl, &mut h);
                    self.along_y(high, spacing, hh, &mut h);
                    bin.fill(0.0);
                    self.along_x(low, spacing, &l, bin);
                    self.along_x(high, spacing, &h, bin);
                },
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linop::{LinearOperator, OverBins, laws};
    use crate::vecmath::norm_squared;

    #[test]
    fn obeys_the_laws() {
        for (bins, rows, columns) in [(3, 5, 7), (1, 8, 6), (4, 1, 5), (2, 6, 1), (2, 16, 12)] {
            laws::check(&OverBins::new(bins, Wavelet::new(rows, columns)), 3);
        }
    }

    /// With its approximation the transform keeps the energy: a bin whose approximation
    /// is zero keeps it in the details, and no bin gains any.
    #[test]
    fn is_part_of_a_tight_frame() {
        // Fastest oscillation: level 1 has it all.
        let bin: Vec<f32> = (0..96)
            .map(|i| if (i + i / 12) % 2 == 0 { 1.0 } else { -1.0 })
            .collect();
        let wavelet = OverBins::new(1, Wavelet::new(8, 12));
        let mut coefficients = vec![f32::NAN; wavelet.range_len()];
        wavelet.apply(&bin, &mut coefficients);
        assert!((norm_squared(&coefficients) - 96.0).abs() < 1e-3);
        let random: Vec<f32> = (0..96).map(|i| (i as f32 * 12.9).sin()).collect();
        wavelet.apply(&random, &mut coefficients);
        assert!(norm_squared(&coefficients) <= norm_squared(&random));
        // Two vanishing moments: a ramp has no details away from the edges.
        let wavelet = OverBins::new(1, Wavelet::new(2, 64));
        let ramp: Vec<f32> = (0..128).map(|i| (i % 64) as f32).collect();
        let mut coefficients = vec![f32::NAN; wavelet.range_len()];
        wavelet.apply(&ramp, &mut coefficients);
        for band in coefficients.chunks(64) {
            assert!(band[..60].iter().all(|c| c.abs() < 1e-4), "{band:?}");
        }
    }

    /// The weighted ℓ1 norm is the mean over all shifts of that of the orthogonal transform.
    #[test]
    fn counts_as_the_mean_over_all_shifts() {
        let wavelet = Wavelet::new(8, 8);
        assert_eq!(wavelet.levels(), 3);
        let bin: Vec<f32> = (0..64).map(|i| (i as f32 * 0.7).sin().max(0.0)).collect();
        let mut coefficients = vec![0.0; wavelet.coefficients()];
        wavelet.analyse(&bin, &mut coefficients);
        let mut at = 0;
        let mut weighted = 0.0;
        for band in wavelet.bands() {
            let run = &coefficients[at..at + band.length];
            weighted +=
                f64::from(band.weight) * run.iter().map(|c| f64::from(c.abs())).sum::<f64>();
            at += band.length;
        }
        let mut mean = 0.0;
        for shift in 0..64 {
            let (dy, dx) = (shift / 8, shift % 8);
            let moved: Vec<f64> = (0..64)
                .map(|i| f64::from(bin[(i / 8 + dy) % 8 * 8 + (i % 8 + dx) % 8]))
                .collect();
            mean += orthogonal_l1(&moved, 8) / 64.0;
        }
        assert!((weighted - mean).abs() < 1e-4 * mean, "{weighted} {mean}");
    }

    /// ℓ1 norm of the details of the decimated transform, by its textbook definition.
    fn orthogonal_l1(bin: &[f64], size: usize) -> f64 {
        if size == 1 {
            return 0.0;
        }
        let low = filters().0.map(|h| f64::from(h) * 2f64.sqrt());
        let high = filters().1.map(|g| f64::from(g) * 2f64.sqrt());
        let half = size / 2;
        let filtered = |ty: &[f64; 4], tx: &[f64; 4]| -> Vec<f64> {
            let value = |i: usize| {
                let (y, x) = (2 * (i / half), 2 * (i % half));
                (0..16)
                    .map(|k| {
                        let at = (y + k / 4) % size * size + (x + k % 4) % size;
                        ty[k / 4] * tx[k % 4] * bin[at]
                    })
                    .sum()
            };
            (0..half * half).map(value).collect()
        };
        let details = [(&low, &high), (&high, &low), (&high, &high)];
        let sum: f64 = details
            .iter()
            .flat_map(|(ty, tx)| filtered(ty, tx))
            .map(f64::abs)
            .sum();
        sum + orthogonal_l1(&filtered(&low, &low), half)
    }
}
