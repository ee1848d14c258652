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
#[derive(Clone)]
pub struct Cosine {
    rows: usize,
    columns: usize,
    along_y: CosineLines,
    along_x: CosineLines,
}

impl Cosine {
    /// The transform of bins of `rows` × `columns` pixels.
    pub fn new(rows: usize, columns: usize) -> Self {
        Self {
            rows,
            columns,
            along_y: CosineLines::new(rows),
            along_x: CosineLines::new(columns),
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
        self.along_x.forward(&mut lines);
        transpose(&lines, self.columns, coefficients);
        self.along_y.forward(coefficients);
    }

    fn synthesise(&self, coefficients: &[f32], bin: &mut [f32]) {
        let mut lines = coefficients.to_vec();
        self.along_y.inverse(&mut lines);
        transpose(&lines, self.rows, bin);
        self.along_x.inverse(bin);
    }
}

/// The orthonormal DCT-II of lines of one length, with the factors `a_0` and `a_k` of [`Cosine`].
#[derive(Clone)]
pub struct CosineLines(Arc<dyn TransformType2And3<f32>>);

impl CosineLines {
    /// For lines of `length` elements.
    pub fn new(length: usize) -> Self {
        Self(DctPlanner::new().plan_dct2(length))
    }

    fn factors(&self) -> (f32, f32) {
        let n = self.0.len() as f32;
        ((1.0 / n).sqrt(), (2.0 / n).sqrt())
    }

    /// Transforms each of the lines, which follow one another.
    pub fn forward(&self, lines: &mut [f32]) {
        let (first, others) = self.factors();
        let mut scratch = vec![0.0; self.0.get_scratch_len()];
        for line in lines.chunks_exact_mut(self.0.len()) {
            self.0.process_dct2_with_scratch(line, &mut scratch);
            line.iter_mut().for_each(|c| *c *= others);
            line[0] *= first / others;
        }
    }

    /// The inverse of [`Self::forward`]. The DCT-III takes half of its first element.
    pub fn inverse(&self, lines: &mut [f32]) {
        let (first, others) = self.factors();
        let mut scratch = vec![0.0; self.0.get_scratch_len()];
        for line in lines.chunks_exact_mut(self.0.len()) {
            line.iter_mut().for_each(|c| *c *= others);
            line[0] *= 2.0 * first / others;
            self.0.process_dct3_with_scratch(line, &mut scratch);
        }
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
