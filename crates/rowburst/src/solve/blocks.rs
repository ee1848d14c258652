//! Exact solution of `(G + ρI) y = r` for a block-diagonal `G`.
//!
//! Factors are f64: the eigenvalues of `G` span six decades and more.

use super::GramSolver;
use crate::{Error, Result};
use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, Side};
use rayon::prelude::*;

/// A diagonal block of `G` with its Cholesky factor at the last `ρ`.
pub struct Block {
    indices: Vec<usize>,
    gram: Mat<f64>,
    factor: Option<Llt<f64>>,
}

impl Block {
    /// The block of the elements `indices` of the whole vector.
    ///
    /// # Panics
    /// If `gram` is not square of that size.
    pub fn new(indices: Vec<usize>, gram: Mat<f64>) -> Self {
        assert_eq!((gram.nrows(), gram.ncols()), (indices.len(), indices.len()));
        Self {
            indices,
            gram,
            factor: None,
        }
    }

    fn factorise(&mut self, rho: f64) -> Result<()> {
        let shifted = Mat::from_fn(self.indices.len(), self.indices.len(), |i, j| {
            self.gram[(i, j)] + if i == j { rho } else { 0.0 }
        });
        self.factor = Some(shifted.llt(Side::Lower).map_err(|_| {
            Error::work(
                "data term",
                "a Gram matrix is not positive definite: numbers overflowed",
                "Check that frame and PSF hold plausible values.",
            )
        })?);
        Ok(())
    }

    fn solve(&self, r: &[f32]) -> Mat<f64> {
        let factor = self.factor.as_ref().expect("factorised before solving");
        let mut y = Mat::from_fn(self.indices.len(), 1, |i, _| f64::from(r[self.indices[i]]));
        factor.solve_in_place(&mut y);
        y
    }
}

/// All blocks; together they cover every element once.
pub struct Blocks {
    blocks: Vec<Block>,
    rho: f64,
}

impl Blocks {
    /// The block-diagonal matrix of `blocks`.
    pub fn new(blocks: Vec<Block>) -> Self {
        Self { blocks, rho: 0.0 }
    }

    /// Replaces block `i`.
    pub fn replace(&mut self, i: usize, block: Block) {
        self.blocks[i] = block;
    }

    /// Median of the diagonal of `G`.
    pub fn median_diagonal(&self) -> f64 {
        let mut diagonal: Vec<f64> = self
            .blocks
            .iter()
            .flat_map(|b| (0..b.indices.len()).map(|i| b.gram[(i, i)]))
            .collect();
        let middle = diagonal.len() / 2;
        *diagonal.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// `y = (G + ρI)⁻¹ r`; overwrites `y`. Factors anew only where `ρ` or a block changed.
    ///
    /// # Panics
    /// If a block is not finite: its maker checks its numbers.
    pub fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32]) {
        let changed = rho != self.rho;
        self.rho = rho;
        let parts: Vec<Mat<f64>> = self
            .blocks
            .par_iter_mut()
            .map(|block| {
                if changed || block.factor.is_none() {
                    block
                        .factorise(rho)
                        .expect("G is positive semi-definite and ρ above zero");
                }
                block.solve(r)
            })
            .collect();
        for (block, part) in self.blocks.iter().zip(&parts) {
            for (i, &at) in block.indices.iter().enumerate() {
                y[at] = part[(i, 0)] as f32;
            }
        }
    }
}

impl GramSolver for Blocks {
    fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) {
        Blocks::solve(self, r, rho, y);
        for ((g, &r), &y) in gram_y.iter_mut().zip(r).zip(y.iter()) {
            *g = (f64::from(r) - rho * f64::from(y)) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_interleaved_blocks_at_changing_rho() {
        let a = Mat::from_fn(3, 2, |i, j| (i * 2 + j) as f64 * 0.3 - 0.4);
        let gram = &a * a.transpose();
        let mut blocks = Blocks::new(vec![
            Block::new(vec![0, 2, 4], gram.clone()),
            Block::new(vec![1, 3, 5], &gram * 2.0),
        ]);
        let r = [1.0f32, -0.5, 0.25, 2.0, 0.1, 0.7];
        for rho in [0.1, 0.01, 0.3] {
            let (mut y, mut gram_y) = ([0.0f32; 6], [0.0f32; 6]);
            GramSolver::solve(&mut blocks, &r, rho, &mut y, &mut gram_y);
            for (offset, factor) in [(0, 1.0), (1, 2.0)] {
                for i in 0..3 {
                    let product: f64 = (0..3)
                        .map(|j| factor * gram[(i, j)] * f64::from(y[2 * j + offset]))
                        .sum();
                    let at = 2 * i + offset;
                    assert!((product - f64::from(gram_y[at])).abs() < 1e-5);
                    assert!((product + rho * f64::from(y[at]) - f64::from(r[at])).abs() < 1e-5);
                }
            }
        }
    }
}
