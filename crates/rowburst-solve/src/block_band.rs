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
use faer::{Accum, ColMut, Mat, Par, Spec};
use rayon::prelude::*;
use rowburst_core::linop::Scalar;

/// Rows of a parallel task; fixed, so that the bits do not depend on the number of threads.
const PART: usize = 128;

/// `K` and the Cholesky factor of `K + ρI` for the last `ρ`.
pub struct BlockBand<T> {
    /// First row of each block, and the number of rows.
    starts: Vec<usize>,
    /// The last block below the diagonal of each block column.
    last: Vec<usize>,
    /// Block columns, from the diagonal block on; above the diagonal undefined.
    matrix: Vec<Mat<T>>,
    factor: Vec<Mat<T>>,
    /// `ρ` of the factor, if there is one.
    rho: Option<f64>,
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
            factor: Vec::new(),
            rho: None,
            is_ill_conditioned: false,
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

    /// Adds `block` to the block at the block row `s` and the block column `t ≤ s`.
    pub fn add(&mut self, s: usize, t: usize, block: faer::MatRef<T>) {
        let first = self.starts[s] - self.starts[t];
        let mut to = self.matrix[t].get_mut(first..first + block.nrows(), ..);
        to += block;
        self.rho = None;
    }

    /// Whether rounding made a pivot of the present factor too small: `ρ` is too small for `T`.
    pub fn is_ill_conditioned(&self) -> bool {
        self.is_ill_conditioned
    }

    /// Replaces `values` by `(K + ρI)⁻¹ values`. Factorises if `ρ` has changed.
    ///
    /// # Panics
    /// If the matrix is not finite, or the length does not match.
    pub fn solve(&mut self, values: &mut [T], rho: f64) {
        if self.rho != Some(rho) {
            self.factorise(rho);
        }
        let one = -T::one();
        for (panel, window) in self.factor.iter().zip(self.starts.windows(2)) {
            let (start, size) = (window[0], window[1] - window[0]);
            let (current, rest) = values[start..start + panel.nrows()].split_at_mut(size);
            let mut current = ColMut::from_slice_mut(current).as_mat_mut();
            let (diagonal, below) = panel.split_at_row(size);
            solve_lower_triangular_in_place(diagonal, current.rb_mut(), Par::Seq);
            let rest = ColMut::from_slice_mut(rest).as_mat_mut();
            matmul(rest, Accum::Add, below, current.rb(), one, Par::Seq);
        }
        for (panel, window) in self.factor.iter().zip(self.starts.windows(2)).rev() {
            let (start, size) = (window[0], window[1] - window[0]);
            let (current, rest) = values[start..start + panel.nrows()].split_at_mut(size);
            let mut current = ColMut::from_slice_mut(current).as_mat_mut();
            let (diagonal, below) = panel.split_at_row(size);
            let rest = ColMut::from_slice_mut(rest).as_mat_mut();
            let transposed = below.transpose();
            matmul(
                current.rb_mut(),
                Accum::Add,
                transposed,
                rest.rb(),
                one,
                Par::Seq,
            );
            solve_upper_triangular_in_place(diagonal.transpose(), current, Par::Seq);
        }
    }

    fn factorise(&mut self, rho: f64) {
        let shift = T::nearest(rho);
        self.factor.clone_from(&self.matrix);
        self.is_ill_conditioned = false;
        for t in 0..self.factor.len() {
            let size = self.starts[t + 1] - self.starts[t];
            let (panel, rest) = self.factor[t..].split_first_mut().expect("t is a column");
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
            self.is_ill_conditioned |= info.dynamic_regularization_count > 0;
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
        self.rho = Some(rho);
    }
}

fn starts_of(sizes: &[usize]) -> Vec<usize> {
    let mut starts = vec![0];
    for size in sizes {
        starts.push(starts[starts.len() - 1] + size);
    }
    starts
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
            let mut values: Vec<f64> = right.iter().copied().collect();
            band.solve(&mut values, rho);
            assert!(!band.is_ill_conditioned());
            for (value, expected) in values.iter().zip(expected.iter()) {
                assert!((value - expected).abs() < 1e-12, "{value} {expected}");
            }
        }
    }
}
