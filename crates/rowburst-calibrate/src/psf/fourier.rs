//! Two-dimensional Fourier transforms of images, and sub-pixel registration by them.

use rayon::prelude::*;
use rowburst_core::fft::{FftNumber, smooth_even_length};
use rowburst_optics::Image;
use rustfft::FftDirection;
use rustfft::num_complex::Complex32;
use std::f64::consts::TAU;

/// Spectrum `[y-frequency, x-frequency]` of an image padded with zeros.
#[derive(Debug, Clone)]
pub(super) struct Spectrum {
    pub rows: usize,
    pub columns: usize,
    data: Vec<Complex32>,
}

impl Spectrum {
    /// Of `image`, padded to at least `rows × columns`.
    pub fn of(image: &Image, rows: usize, columns: usize) -> Self {
        let rows = smooth_even_length(rows.max(image.rows()));
        let columns = smooth_even_length(columns.max(image.columns()));
        let mut data = vec![Complex32::ZERO; rows * columns];
        for y in 0..image.rows() {
            let line = &mut data[y * columns..][..image.columns()];
            for (to, &from) in line.iter_mut().zip(image.row(y)) {
                to.re = from;
            }
        }
        transform(&mut data, rows, columns, FftDirection::Forward);
        Self {
            rows,
            columns,
            data,
        }
    }

    /// `C[d] = Σ_x a[x + d] b[x]` for `a` of `self`: its place of the peak is the shift of
    /// `self` against `other`. Circular on the padded grid.
    pub fn correlate(&self, other: &Self) -> Correlation {
        assert_eq!((self.rows, self.columns), (other.rows, other.columns));
        let product = self.data.iter().zip(&other.data).map(|(a, b)| a * b.conj());
        let cross: Vec<Complex32> = product.collect();
        let mut data = cross.clone();
        transform(&mut data, self.rows, self.columns, FftDirection::Inverse);
        let scale = 1.0 / (self.rows * self.columns) as f32;
        Correlation {
            rows: self.rows,
            columns: self.columns,
            values: data.iter().map(|c| c.re * scale).collect(),
            cross,
        }
    }
}

/// A circular cross-correlation and its spectrum.
pub(super) struct Correlation {
    pub rows: usize,
    pub columns: usize,
    values: Vec<f32>,
    cross: Vec<Complex32>,
}

impl Correlation {
    /// At the displacement `(dy, dx)`.
    pub fn at(&self, dy: isize, dx: isize) -> f64 {
        let y = dy.rem_euclid(self.rows as isize) as usize;
        let x = dx.rem_euclid(self.columns as isize) as usize;
        f64::from(self.values[y * self.columns + x])
    }

    /// Place of the highest value among displacements up to half the grid.
    pub fn highest(&self) -> (isize, isize) {
        let best =
            (0..self.values.len()).max_by(|&a, &b| self.values[a].total_cmp(&self.values[b]));
        let best = best.expect("a grid has points");
        let signed = |i: usize, n: usize| {
            if i > n / 2 {
                i as isize - n as isize
            } else {
                i as isize
            }
        };
        (
            signed(best / self.columns, self.rows),
            signed(best % self.columns, self.columns),
        )
    }

    /// Place of the highest value within `radius` of `near`.
    pub fn highest_near(&self, near: (f64, f64), radius: f64) -> (isize, isize) {
        let (y0, x0) = (near.0.round() as isize, near.1.round() as isize);
        let reach = radius.ceil() as isize;
        let mut best = (f64::NEG_INFINITY, (y0, x0));
        for y in y0 - reach..=y0 + reach {
            for x in x0 - reach..=x0 + reach {
                if (y as f64 - near.0).hypot(x as f64 - near.1) <= radius && self.at(y, x) > best.0
                {
                    best = (self.at(y, x), (y, x));
                }
            }
        }
        best.1
    }

    /// The peak beside the grid point `start` to a fraction of a pixel: Newton's method on
    /// the trigonometric interpolation `C(d) = Re Σ_k X_k exp(2πi k·d)`, exact for light
    /// that the pixels sample.
    pub fn refine(&self, start: (isize, isize)) -> (f64, f64) {
        let mut at = (start.0 as f64, start.1 as f64);
        for _ in 0..6 {
            let (g, h) = self.derivatives(at);
            let det = h[0] * h[2] - h[1] * h[1];
            // Not a maximum: too noisy to be refined.
            if !(det > 0.0 && h[0] < 0.0) {
                return (start.0 as f64, start.1 as f64);
            }
            let step = (
                -(h[2] * g[0] - h[1] * g[1]) / det,
                -(h[0] * g[1] - h[1] * g[0]) / det,
            );
            at = (at.0 + step.0, at.1 + step.1);
            if (at.0 - start.0 as f64)
                .abs()
                .max((at.1 - start.1 as f64).abs())
                > 1.0
            {
                return (start.0 as f64, start.1 as f64);
            }
            if step.0.hypot(step.1) < 1e-4 {
                break;
            }
        }
        at
    }

    /// Gradient `(y, x)` and Hessian `(yy, yx, xx)` at `(dy, dx)`.
    fn derivatives(&self, at: (f64, f64)) -> ([f64; 2], [f64; 3]) {
        let phase = |n: usize, d: f64| -> Vec<(f64, f64, f64)> {
            (0..n)
                .map(|k| {
                    let k = if 2 * k > n {
                        k as f64 - n as f64
                    } else {
                        k as f64
                    };
                    // The highest frequency of an even length has no sign of its own.
                    let omega = if (2.0 * k - n as f64).abs() < 0.5 {
                        0.0
                    } else {
                        TAU * k / n as f64
                    };
                    let (sin, cos) = (omega * d).sin_cos();
                    (omega, cos, sin)
                })
                .collect()
        };
        let (of_y, of_x) = (phase(self.rows, at.0), phase(self.columns, at.1));
        let rows = self.cross.par_chunks_exact(self.columns).zip(&of_y);
        let sums = rows.map(|(line, &(wy, cy, sy))| {
            // Σ over x of X e^{iωx d}, and of it times ωx and ωx².
            let mut m = [[0.0f64; 2]; 3];
            for (value, &(wx, c, s)) in line.iter().zip(&of_x) {
                let (re, im) = (f64::from(value.re), f64::from(value.im));
                let (a, b) = (re * c - im * s, re * s + im * c);
                m[0][0] += a;
                m[0][1] += b;
                m[1][0] += wx * a;
                m[1][1] += wx * b;
                m[2][0] += wx * wx * a;
                m[2][1] += wx * wx * b;
            }
            let turned = m.map(|[a, b]| [a * cy - b * sy, a * sy + b * cy]);
            [
                -wy * turned[0][1],
                -turned[1][1],
                -wy * wy * turned[0][0],
                -wy * turned[1][0],
                -turned[2][0],
            ]
        });
        let total = sums.reduce(|| [0.0; 5], |a, b| std::array::from_fn(|i| a[i] + b[i]));
        ([total[0], total[1]], [total[2], total[3], total[4]])
    }
}

fn transform(data: &mut [Complex32], rows: usize, columns: usize, direction: FftDirection) {
    let plan = |length| {
        let (forward, inverse) = f32::complex_transforms(length);
        match direction {
            FftDirection::Forward => forward,
            FftDirection::Inverse => inverse,
        }
    };
    let (along_x, along_y) = (plan(columns), plan(rows));
    data.par_chunks_exact_mut(columns)
        .for_each(|line| along_x.process(line));
    let mut turned = vec![Complex32::ZERO; data.len()];
    transpose(data, &mut turned, rows, columns);
    turned
        .par_chunks_exact_mut(rows)
        .for_each(|line| along_y.process(line));
    transpose(&turned, data, columns, rows);
}

/// `to[x, y] = from[y, x]` for `from` of `rows × columns`, in tiles that stay in the cache.
fn transpose(from: &[Complex32], to: &mut [Complex32], rows: usize, columns: usize) {
    const TILE: usize = 16;
    for y0 in (0..rows).step_by(TILE) {
        for x0 in (0..columns).step_by(TILE) {
            for y in y0..(y0 + TILE).min(rows) {
                for x in x0..(x0 + TILE).min(columns) {
                    to[x * rows + y] = from[y * columns + x];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::filter::shifted;
    use super::*;

    #[test]
    fn a_shift_is_found_to_a_hundredth_of_a_pixel() {
        let texture = Image::from_fn(60, 90, |y, x| {
            let (y, x) = (y as f64, x as f64);
            let window = (-((y - 30.0) / 11.0).powi(2) - ((x - 45.0) / 16.0).powi(2)).exp();
            (window * (1.0 + (0.9 * x + 0.4 * y).sin() + (1.3 * y - 0.2 * x * y / 20.0).cos()))
                as f32
        });
        let moved = shifted(&texture, 60, 90, -4.37, 6.81);
        let (a, b) = (Spectrum::of(&moved, 0, 0), Spectrum::of(&texture, 0, 0));
        let correlation = a.correlate(&b);
        let peak = correlation.highest();
        assert_eq!(peak, (-4, 7));
        let (dy, dx) = correlation.refine(peak);
        assert!(
            (dy + 4.37).abs() < 0.01 && (dx - 6.81).abs() < 0.01,
            "{dy} {dx}"
        );
        assert_eq!(correlation.highest_near((-3.0, 6.0), 3.0), (-4, 7));
    }
}
