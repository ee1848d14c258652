//! The cosine transform of a bin.

use super::bins::{Band, BinTransform};
use rustdct::{DctPlanner, TransformType2And3};
use std::sync::Arc;

/// The orthonormal two-dimensional DCT-II of a bin,
///
/// ```text
/// c[k,l] = a_k a_l Σ_{y,x} v[y,x] cos(π(y+½)k/H) cos(π(x+½)l/W),   a_0 = √(1/N), a_k = √(2/N)
/// ```
///
/// (Ahmed, Natarajan & Rao 1974). It is the Fourier transform of the bin mirrored at
/// its edges (half-sample symmetric boundary), so an edge of the field is no jump.
/// Coefficients are stored `[l, k]`. Adjoint: the inverse, DCT-III. Cost: `O(N log N)`.
pub struct Cosine {
    rows: usize,
    columns: usize,
    along_y: Arc<dyn TransformType2And3<f32>>,
    along_x: Arc<dyn TransformType2And3<f32>>,
}

impl Cosine {
    /// The transform of bins of `rows` × `columns` pixels.
    pub fn new(rows: usize, columns: usize) -> Self {
        let mut planner = DctPlanner::new();
        Self {
            rows,
            columns,
            along_y: planner.plan_dct2(rows),
            along_x: planner.plan_dct2(columns),
        }
    }
}

impl BinTransform for Cosine {
    fn bin_shape(&self) -> (usize, usize) {
        (self.rows, self.columns)
    }

    fn bands(&self) -> Vec<Band> {
        vec![Band {
            length: self.rows * self.columns,
            weight: 1.0,
            share: 1.0,
        }]
    }

    fn analyse(&self, bin: &[f32], coefficients: &mut [f32]) {
        let mut lines = bin.to_vec();
        forward(&*self.along_x, &mut lines);
        transpose(&lines, self.columns, coefficients);
        forward(&*self.along_y, coefficients);
    }

    fn synthesise(&self, coefficients: &[f32], bin: &mut [f32]) {
        let mut lines = coefficients.to_vec();
        inverse(&*self.along_y, &mut lines);
        transpose(&lines, self.rows, bin);
        inverse(&*self.along_x, bin);
    }
}

/// The factors `a_0` and `a_k`.
fn factors(length: usize) -> (f32, f32) {
    let n = length as f32;
    ((1.0 / n).sqrt(), (2.0 / n).sqrt())
}

/// The orthonormal DCT-II of every line.
fn forward(transform: &dyn TransformType2And3<f32>, lines: &mut [f32]) {
    let (first, others) = factors(transform.len());
    let mut scratch = vec![0.0; transform.get_scratch_len()];
    for line in lines.chunks_exact_mut(transform.len()) {
        transform.process_dct2_with_scratch(line, &mut scratch);
        line.iter_mut().for_each(|c| *c *= others);
        line[0] *= first / others;
    }
}

/// The inverse of [`forward`]. The DCT-III takes half of its first element.
fn inverse(transform: &dyn TransformType2And3<f32>, lines: &mut [f32]) {
    let (first, others) = factors(transform.len());
    let mut scratch = vec![0.0; transform.get_scratch_len()];
    for line in lines.chunks_exact_mut(transform.len()) {
        line.iter_mut().for_each(|c| *c *= others);
        line[0] *= 2.0 * first / others;
        transform.process_dct3_with_scratch(line, &mut scratch);
    }
}

/// Writes the lines of `from`, each `columns` long, as columns of `to`.
fn transpose(from: &[f32], columns: usize, to: &mut [f32]) {
    assert_eq!(from.len(), to.len(), "size of a bin");
    let rows = from.len() / columns;
    for (y, line) in from.chunks_exact(columns).enumerate() {
        for (x, &value) in line.iter().enumerate() {
            to[x * rows + y] = value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::linop::{OverBins, laws};
    use std::f64::consts::PI;

    #[test]
    fn obeys_the_laws() {
        for (bins, rows, columns) in [(3, 5, 7), (1, 8, 6), (4, 1, 5), (2, 6, 1), (2, 16, 12)] {
            laws::check(&OverBins::new(bins, Cosine::new(rows, columns)), 3);
        }
    }

    #[test]
    fn agrees_with_its_sum_and_inverts() {
        let (rows, columns) = (6, 5);
        let bin: Vec<f32> = (0..30).map(|i| (i as f32 * 1.7).sin()).collect();
        let cosine = Cosine::new(rows, columns);
        let mut found = vec![f32::NAN; 30];
        cosine.analyse(&bin, &mut found);
        for k in 0..rows {
            for l in 0..columns {
                let wave = |k: usize, i: usize, n: usize| {
                    let a = if k == 0 { 1.0 } else { 2.0f64 };
                    (a / n as f64).sqrt() * (PI * (i as f64 + 0.5) * k as f64 / n as f64).cos()
                };
                let term = |i: usize| {
                    f64::from(bin[i]) * wave(k, i / columns, rows) * wave(l, i % columns, columns)
                };
                let sum: f64 = (0..30).map(term).sum();
                assert!((sum - f64::from(found[l * rows + k])).abs() < 1e-5);
            }
        }
        let mut back = vec![f32::NAN; 30];
        cosine.synthesise(&found, &mut back);
        assert!(bin.iter().zip(&back).all(|(a, b)| (a - b).abs() < 1e-5));
    }
}
