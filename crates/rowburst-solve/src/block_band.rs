//! Exact solution of `(K + ρI) x = g` for a symmetric `K` whose blocks are zero far from the diagonal.
//!
//! A block column `t` holds the blocks from the diagonal down to `last(t)`. `last` does not decrease, so the Cholesky
//! factor has no other blocks (Golub & Van Loan, 4th ed., section 4.3.5).

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::{
    solve_lower_triangular_in_place, solve_upper_triangular_in_place,
};
use faer::reborrow::{Reborrow, ReborrowMut};
use faer::{Accum, ColMut, Mat, MatMut, MatRef, Par, Spec};
use rayon::prelude::*;
use rowburst_core::linop::Scalar;
use std::sync::Arc;

/// Rows of a parallel task; fixed, so that the bits do not depend on the number of threads.
const PART: usize = 128;

/// `K`.
pub struct BlockBand<T> {
    /// First row of each block, and the number of rows.
    starts: Arc<[usize]>,
    /// The last block below the diagonal of each block column.
    last: Vec<usize>,
    /// Block columns, from the diagonal block on.
    matrix: Vec<Mat<T>>,
}

/// The Cholesky factor of `K + ρI`.
pub struct BandFactor<T> {
    starts: Arc<[usize]>,
    /// Block columns, from the diagonal block on; above the diagonal undefined.
    panels: Vec<Mat<T>>,
    is_ill_conditioned: bool,
}

impl<T: Scalar> BlockBand<T> {
    /// A zero matrix with blocks of these `sizes`; block column `t` ends with block `last[t]`.
    ///
    /// # Panics
    /// If `last` decreases, or is above the diagonal.
    pub fn zero(sizes: &[usize], last: Vec<usize>) -> Self {
        assert!(last.is_sorted() && last.iter().enumerate().all(|(t, last)| *last >= t));
        let starts = starts_of(sizes);
        let rows = |t: usize| starts[last[t] + 1] - starts[t];
        let matrix = (0..sizes.len()).map(|t| Mat::zeros(rows(t), sizes[t]));
        Self {
            matrix: matrix.collect(),
            starts,
            last,
        }
    }

    /// Multiplications of a factor with blocks of these `sizes`.
    pub fn cost(sizes: &[usize], last: &[usize]) -> f64 {
        let starts = starts_of(sizes);
        let column = |t: usize| {
            let below = (starts[last[t] + 1] - starts[t]) as f64;
            sizes[t] as f64 * below * below / 2.0
        };
        (0..sizes.len()).map(column).sum()
    }

    /// First row of each block, and the number of rows.
    pub fn starts(&self) -> &[usize] {
        &self.starts
    }

    /// Adds `block` to the block at the block row `s` and the block column `t ≤ s`. Blocks on the diagonal are whole.
    pub fn add(&mut self, s: usize, t: usize, block: MatRef<T>) {
        let first = self.starts[s] - self.starts[t];
        let mut to = self.matrix[t].get_mut(first..first + block.nrows(), ..);
        to += block;
    }

    /// `Lᵀ K L`, where `roots` are the blocks of a block-diagonal `L`.
    ///
    /// # Panics
    /// If a size does not match.
    #[must_use]
    pub fn congruent(&self, roots: &[Mat<T>]) -> Self {
        let columns = self.matrix.par_iter().zip(roots).enumerate();
        let matrix = columns.map(|(t, (column, right))| {
            let half = column * right;
            let mut whole = Mat::zeros(half.nrows(), half.ncols());
            for (s, left) in roots.iter().enumerate().take(self.last[t] + 1).skip(t) {
                let first = self.starts[s] - self.starts[t];
                let rows = self.starts[s + 1] - self.starts[s];
                let to = whole.as_mut().subrows_mut(first, rows);
                let from = half.subrows(first, rows);
                matmul(
                    to,
                    Accum::Replace,
                    left.transpose(),
                    from,
                    T::one(),
                    Par::Seq,
                );
            }
            whole
        });
        Self {
            matrix: matrix.collect(),
            starts: Arc::clone(&self.starts),
            last: self.last.clone(),
        }
    }

    /// The factor of `K + ρI`.
    ///
    /// # Panics
    /// If the matrix is not finite.
    pub fn factor(&self, rho: f64) -> BandFactor<T> {
        let mut factor = BandFactor {
            starts: Arc::clone(&self.starts),
            panels: Vec::new(),
            is_ill_conditioned: false,
        };
        self.refactor(rho, &mut factor);
        factor
    }

    /// Replaces `factor` by that of `K + ρI`, in its memory.
    ///
    /// # Panics
    /// If the matrix is not finite.
    pub fn refactor(&self, rho: f64, factor: &mut BandFactor<T>) {
        let shift = T::nearest(rho);
        factor.panels.clone_from(&self.matrix);
        factor.is_ill_conditioned = false;
        for t in 0..factor.panels.len() {
            let size = self.starts[t + 1] - self.starts[t];
            let (panel, rest) = factor.panels[t..].split_first_mut().expect("t is a column");
            let (mut diagonal, mut below) = panel.as_mut().split_at_row_mut(size);
            for j in 0..size {
                diagonal[(j, j)] += shift;
            }
            let need = llt::factor::cholesky_in_place_scratch::<T>(size, Par::Seq, Spec::default());
            let info = llt::factor::cholesky_in_place(
                diagonal.rb_mut(),
                // Exact pivots are at least ρ. One below ρ/2 is wrong by rounding and is replaced by ρ.
                llt::factor::LltRegularization {
                    dynamic_regularization_delta: shift,
                    dynamic_regularization_epsilon: shift * T::nearest(0.5),
                },
                Par::Seq,
                MemStack::new(&mut MemBuffer::new(need)),
                Spec::default(),
            )
            .expect("K is finite and positive semi-definite");
            factor.is_ill_conditioned |= info.dynamic_regularization_count > 0;
            let (diagonal, chunks) = (diagonal.rb(), below.rb_mut().par_row_chunks_mut(PART));
            chunks.for_each(|rows| {
                solve_lower_triangular_in_place(diagonal, rows.transpose_mut(), Par::Seq);
            });
            let (below, starts) = (below.rb(), &self.starts);
            let columns = rest[..self.last[t] - t].par_iter_mut().enumerate();
            columns.for_each(|(k, column)| {
                let s = t + 1 + k;
                let from = starts[s] - starts[t + 1];
                let rows = below.subrows(from, below.nrows() - from);
                let block = below.subrows(from, starts[s + 1] - starts[s]);
                let to = column.as_mut().subrows_mut(0, rows.nrows());
                matmul(to, Accum::Add, rows, block.transpose(), -T::one(), Par::Seq);
            });
        }
    }
}

impl<T: Scalar> BandFactor<T> {
    /// Whether rounding made a pivot too small: `ρ` is too small for `T`.
    pub fn is_ill_conditioned(&self) -> bool {
        self.is_ill_conditioned
    }

    /// The natural logarithm of the determinant of `K + ρI`.
    pub fn log_determinant(&self) -> f64 {
        let diagonal = |panel: &Mat<T>| -> f64 {
            let pivots = (0..panel.ncols()).map(|j| panel[(j, j)].into());
            pivots.map(|pivot: f64| pivot.ln()).sum()
        };
        2.0 * self.panels.iter().map(diagonal).sum::<f64>()
    }

    /// Replaces `values` by `(K + ρI)⁻¹ values`.
    ///
    /// # Panics
    /// If the length does not match.
    pub fn solve(&self, values: &mut [T]) {
        self.solve_columns(ColMut::from_slice_mut(values).as_mat_mut());
    }

    /// Replaces each column of `values` by `(K + ρI)⁻¹` times it.
    ///
    /// # Panics
    /// If the number of rows does not match.
    pub fn solve_columns(&self, mut values: MatMut<T>) {
        let one = -T::one();
        for (panel, window) in self.panels.iter().zip(self.starts.windows(2)) {
            let (start, size) = (window[0], window[1] - window[0]);
            let touched = values.rb_mut().subrows_mut(start, panel.nrows());
            let (mut current, rest) = touched.split_at_row_mut(size);
            let (diagonal, below) = panel.split_at_row(size);
            solve_lower_triangular_in_place(diagonal, current.rb_mut(), Par::Seq);
            matmul(rest, Accum::Add, below, current.rb(), one, Par::Seq);
        }
        for (panel, window) in self.panels.iter().zip(self.starts.windows(2)).rev() {
            let (start, size) = (window[0], window[1] - window[0]);
            let touched = values.rb_mut().subrows_mut(start, panel.nrows());
            let (mut current, rest) = touched.split_at_row_mut(size);
            let (diagonal, below) = panel.split_at_row(size);
            matmul(
                current.rb_mut(),
                Accum::Add,
                below.transpose(),
                rest.rb(),
                one,
                Par::Seq,
            );
            solve_upper_triangular_in_place(diagonal.transpose(), current, Par::Seq);
        }
    }
}

impl<T: Scalar> BandFactor<T> {
    /// The diagonal of `(K + ρI)⁻¹`, by the blocks of the inverse within the band alone (Takahashi, Fagan & Chin, 8th PICA
    /// Conf., 1973): with the factor `L`, `Z L = L⁻ᵀ` from the last block column on.
    pub fn inverse_diagonal(&self) -> Vec<T> {
        let mut diagonal = vec![T::zero(); self.starts[self.panels.len()]];
        // Block columns of the inverse, from the diagonal block on.
        let mut inverse: Vec<Mat<T>> = vec![Mat::zeros(0, 0); self.panels.len()];
        for t in (0..self.panels.len()).rev() {
            let (start, size) = (self.starts[t], self.starts[t + 1] - self.starts[t]);
            let (lower, below) = self.panels[t].split_at_row(size);
            let mut column = Mat::<T>::zeros(self.panels[t].nrows(), size);
            let (mut top, mut rest) = column.as_mut().split_at_row_mut(size);
            (0..size).for_each(|j| top[(j, j)] = T::one());
            solve_upper_triangular_in_place(lower.transpose(), top.rb_mut(), Par::Seq);
            if below.nrows() > 0 {
                let known = self.known_inverse(&inverse, t + 1, below.nrows());
                let (known, minus) = (known.as_ref(), -T::one());
                matmul(rest.rb_mut(), Accum::Replace, known, below, minus, Par::Seq);
                let transposed = rest.rb_mut().transpose_mut();
                solve_upper_triangular_in_place(lower.transpose(), transposed, Par::Seq);
                let above = rest.rb().transpose();
                matmul(top.rb_mut(), Accum::Add, above, below, minus, Par::Seq);
            }
            let transposed = top.rb_mut().transpose_mut();
            solve_upper_triangular_in_place(lower.transpose(), transposed, Par::Seq);
            (0..size).for_each(|j| diagonal[start + j] = top[(j, j)]);
            inverse[t] = column;
        }
        diagonal
    }

    /// The inverse at `count` rows and columns from block `first` on, which are in its band.
    fn known_inverse(&self, inverse: &[Mat<T>], first: usize, count: usize) -> Mat<T> {
        let origin = self.starts[first];
        let mut known = Mat::<T>::zeros(count, count);
        for (k, column) in inverse.iter().enumerate().skip(first) {
            let from = self.starts[k] - origin;
            if from >= count {
                break;
            }
            for j in 0..column.ncols() {
                for i in j..count - from {
                    known[(from + i, from + j)] = column[(i, j)];
                    known[(from + j, from + i)] = column[(i, j)];
                }
            }
        }
        known
    }
}

fn starts_of(sizes: &[usize]) -> Arc<[usize]> {
    let mut starts = vec![0];
    for size in sizes {
        starts.push(starts[starts.len() - 1] + size);
    }
    starts.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::linalg::solvers::Solve;
    use faer::{Col, Side};

    /// Blocks of several sizes, one of them empty, against a dense factor; the `ρ` changes.
    #[test]
    fn equals_a_dense_factor() {
        let (sizes, last) = ([3, 1, 0, 4, 2], vec![1, 3, 3, 4, 4]);
        let n: usize = sizes.iter().sum();
        let starts = starts_of(&sizes);
        let root = |i: usize, j: usize| ((i * 7 + j * 3) as f64 * 1.3).sin();
        let mut band = BlockBand::<f64>::zero(&sizes, last.clone());
        let mut dense = Mat::<f64>::zeros(n, n);
        for t in 0..sizes.len() {
            for s in t..=last[t] {
                let block = Mat::from_fn(sizes[s], sizes[t], |i, j| {
                    let (i, j) = (starts[s] + i, starts[t] + j);
                    root(i.min(j), i.max(j)) + if i == j { 12.0 } else { 0.0 }
                });
                band.add(s, t, block.as_ref());
                for (i, j) in (0..sizes[s]).flat_map(|i| (0..sizes[t]).map(move |j| (i, j))) {
                    dense[(starts[s] + i, starts[t] + j)] = block[(i, j)];
                    dense[(starts[t] + j, starts[s] + i)] = block[(i, j)];
                }
            }
        }
        let right = Col::from_fn(n, |i| (i as f64 * 0.7).cos());
        for rho in [0.5, 0.01] {
            let whole = &dense + Mat::<f64>::identity(n, n) * faer::Scale(rho);
            let expected = whole.llt(Side::Lower).unwrap().solve(&right);
            let factor = band.factor(rho);
            assert!(!factor.is_ill_conditioned());
            let mut values: Vec<f64> = right.iter().copied().collect();
            factor.solve(&mut values);
            for (value, expected) in values.iter().zip(expected.iter()) {
                assert!((value - expected).abs() < 1e-12, "{value} {expected}");
            }
            let mut columns = Mat::from_fn(n, 2, |i, j| right[i] * (1.0 + j as f64));
            factor.solve_columns(columns.as_mut());
            assert!((0..n).all(|i| (columns[(i, 1)] - 2.0 * values[i]).abs() < 1e-12));
            let pivots = whole.llt(Side::Lower).unwrap();
            let logarithm: f64 = (0..n).map(|i| 2.0 * pivots.L()[(i, i)].ln()).sum();
            assert!((factor.log_determinant() - logarithm).abs() < 1e-10);
            let inverse = pivots.solve(Mat::<f64>::identity(n, n));
            for (i, value) in factor.inverse_diagonal().iter().enumerate() {
                assert!((value - inverse[(i, i)]).abs() < 1e-12, "{i}: {value}");
            }
        }
        // Lᵀ K L of the blocks is that of the dense matrices.
        let roots = sizes.map(|size| Mat::from_fn(size, size, |i, j| root(i + 2 * j, size)));
        let mut whole_root = Mat::<f64>::zeros(n, n);
        for (t, block) in roots.iter().enumerate() {
            let (first, size) = (starts[t], sizes[t]);
            whole_root
                .get_mut(first..first + size, first..first + size)
                .copy_from(block);
        }
        let expected = whole_root.transpose() * &dense * &whole_root;
        let expected = (&expected + Mat::<f64>::identity(n, n) * faer::Scale(30.0))
            .llt(Side::Lower)
            .unwrap()
            .solve(&right);
        let mut values: Vec<f64> = right.iter().copied().collect();
        band.congruent(&roots).factor(30.0).solve(&mut values);
        for (value, expected) in values.iter().zip(expected.iter()) {
            assert!((value - expected).abs() < 1e-12, "{value} {expected}");
        }
    }
}
