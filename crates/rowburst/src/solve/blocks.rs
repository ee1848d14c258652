//! Exact solution of `(G + ρI) y = r` for a block-diagonal `G`.
//!
//! Factors are f64: the eigenvalues of `G` span six decades and more.

use super::GramSolver;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::{Mat, MatMut, MatRef, Par, Spec};
use rayon::prelude::*;

/// The diagonal blocks of `G`; together they cover every element once.
pub struct Blocks {
    blocks: Vec<Block>,
    rho: f64,
}

/// A diagonal block of `G` with its Cholesky factor at the last `ρ`.
///
/// One square, column after column, holds both: `G` above its diagonal, which is kept
/// apart, and the factor on and below it.
struct Block {
    indices: Vec<usize>,
    diagonal: Vec<f64>,
    square: Vec<f64>,
    is_factorised: bool,
}

impl Blocks {
    /// Blocks over the elements `indices` each of the whole vector; `fill(i, G_i)` writes
    /// what lies on and above the diagonal of the symmetric block `i` over zeros.
    pub fn new(indices: Vec<Vec<usize>>, fill: impl Fn(usize, MatMut<f64>) + Sync) -> Self {
        let empty = |indices: Vec<usize>| Block {
            diagonal: vec![0.0; indices.len()],
            square: vec![0.0; indices.len().pow(2)],
            indices,
            is_factorised: false,
        };
        let mut blocks = Self {
            blocks: indices.into_iter().map(empty).collect(),
            rho: 0.0,
        };
        blocks.refill(|_| true, fill);
        blocks
    }

    /// Writes the blocks that `has_changed` anew, in the memory of the old ones.
    pub fn refill(
        &mut self,
        has_changed: impl Fn(usize) -> bool + Sync,
        fill: impl Fn(usize, MatMut<f64>) + Sync,
    ) {
        self.blocks
            .par_iter_mut()
            .enumerate()
            .filter(|(i, _)| has_changed(*i))
            .for_each(|(i, block)| {
                let size = block.indices.len();
                block.square.fill(0.0);
                fill(
                    i,
                    MatMut::from_column_major_slice_mut(&mut block.square, size, size),
                );
                for (j, diagonal) in block.diagonal.iter_mut().enumerate() {
                    *diagonal = block.square[j * size + j];
                }
                block.is_factorised = false;
            });
    }

    /// `y = (G + ρI)⁻¹ r`; overwrites `y`. Factors anew only where `ρ` or a block changed.
    ///
    /// # Panics
    /// If a block is not finite, or `ρ` is lost in its rounding.
    pub fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32]) {
        let changed = rho != self.rho;
        self.rho = rho;
        let parts: Vec<Mat<f64>> = self
            .blocks
            .par_iter_mut()
            .map(|block| {
                if changed || !block.is_factorised {
                    block.factorise(rho);
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

impl Block {
    fn factorise(&mut self, rho: f64) {
        let size = self.indices.len();
        // Beside: the factorisation writes above the diagonal, too.
        let mut factor = vec![0.0; size * size];
        self.copy_below(&mut factor);
        for (j, diagonal) in self.diagonal.iter().enumerate() {
            factor[j * size + j] = diagonal + rho;
        }
        let need = llt::factor::cholesky_in_place_scratch::<f64>(size, Par::Seq, Spec::default());
        llt::factor::cholesky_in_place(
            MatMut::from_column_major_slice_mut(&mut factor, size, size),
            llt::factor::LltRegularization::default(),
            Par::Seq,
            MemStack::new(&mut MemBuffer::new(need)),
            Spec::default(),
        )
        .expect("G is positive semi-definite and ρ well above its rounding");
        for j in 0..size {
            let lower = j * size + j..(j + 1) * size;
            self.square[lower.clone()].copy_from_slice(&factor[lower]);
        }
        self.is_factorised = true;
    }

    /// Writes what lies above the diagonal of `G` below that of `to`: a transposition, tile by
    /// tile since columns are far apart.
    fn copy_below(&self, to: &mut [f64]) {
        const TILE: usize = 16;
        let size = self.indices.len();
        for column in (0..size).step_by(TILE) {
            for row in (0..=column).step_by(TILE) {
                for i in column..(column + TILE).min(size) {
                    for j in row..(row + TILE).min(i) {
                        to[j * size + i] = self.square[i * size + j];
                    }
                }
            }
        }
    }

    fn solve(&self, r: &[f32]) -> Mat<f64> {
        let size = self.indices.len();
        let mut y = Mat::from_fn(size, 1, |i, _| f64::from(r[self.indices[i]]));
        let need = llt::solve::solve_in_place_scratch::<f64>(size, 1, Par::Seq);
        llt::solve::solve_in_place(
            MatRef::from_column_major_slice(&self.square, size, size),
            y.as_mut(),
            Par::Seq,
            MemStack::new(&mut MemBuffer::new(need)),
        );
        y
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
        let mut blocks = Blocks::new(vec![vec![0, 2, 4], vec![1, 3, 5]], |i, mut block| {
            block.copy_from(&gram * faer::Scale((i + 1) as f64));
        });
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
