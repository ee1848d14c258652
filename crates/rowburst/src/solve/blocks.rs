//! Exact solution of `(G + ρI) y = r` for a block-diagonal `G`.
//!
//! A block `G_i` is given whole, or as `B Bᵀ` where `B` has few columns: the lit voxels. Then the smaller
//! system stands for it,
//!
//! ```text
//! (G_i + ρI)⁻¹ r = (r − B (BᵀB + ρI)⁻¹ Bᵀ r) / ρ
//! ```
//!
//! (Woodbury; Golub & Van Loan, 4th ed., section 2.1.4). Factors are f64: the eigenvalues of `G` span six
//! decades and more.

use super::GramSolver;
use crate::vecmath::simd;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::{Accum, Mat, MatMut, MatRef, Par, Spec};
use rayon::prelude::*;

/// Where the diagonal blocks of `G` come from.
pub trait BlockSource: Sync {
    /// Writes what lies on and above the diagonal of block `i` over zeros.
    fn fill(&self, i: usize, block: MatMut<f64>);

    /// `B` of block `i`, where it is known and has at most `most` columns.
    fn columns(&self, i: usize, most: usize) -> Option<Mat<f64>> {
        let _ = (i, most);
        None
    }
}

impl<F: Fn(usize, MatMut<f64>) + Sync> BlockSource for F {
    fn fill(&self, i: usize, block: MatMut<f64>) {
        self(i, block);
    }
}

/// The diagonal blocks of `G`; together they cover every element once.
#[derive(Default)]
pub struct Blocks {
    blocks: Vec<Block>,
    rho: f64,
}

/// A diagonal block of `G` with its Cholesky factor at the last `ρ`.
///
/// One square, column after column, holds both: `G` above its diagonal, which is kept apart, and the factor below it;
/// on the diagonal are the inverses of the factor's. Of a block that is given by columns the memory holds these and,
/// behind them, `BᵀB` in the same way.
struct Block {
    indices: Vec<usize>,
    memory: Vec<f64>,
    /// How many columns it is given by.
    columns: Option<usize>,
    diagonal: Vec<f64>,
    is_factorised: bool,
}

/// Most columns for each row of a block that is given by them: then they and their square
/// have place where the whole block has, and take less time.
const MOST_COLUMNS: f64 = 0.5;

impl Blocks {
    /// Blocks over the elements `indices` each of the whole vector.
    pub fn new(indices: Vec<Vec<usize>>, source: impl BlockSource) -> Self {
        let empty = |indices: Vec<usize>| Block {
            memory: vec![0.0; indices.len().pow(2)],
            indices,
            columns: None,
            diagonal: Vec::new(),
            is_factorised: false,
        };
        let mut blocks = Self {
            blocks: indices.into_iter().map(empty).collect(),
            rho: 0.0,
        };
        blocks.refill(|_| true, source);
        blocks
    }

    /// Writes the blocks that `has_changed` anew, in the memory of the old ones.
    pub fn refill(&mut self, has_changed: impl Fn(usize) -> bool + Sync, source: impl BlockSource) {
        self.blocks
            .par_iter_mut()
            .enumerate()
            .filter(|(i, _)| has_changed(*i))
            .for_each(|(i, block)| block.fill(i, &source));
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
            .map_init(Vec::new, |beside, block| {
                if changed || !block.is_factorised {
                    block.factorise(rho, beside);
                }
                block.solve(r, rho)
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
    fn fill(&mut self, i: usize, source: &impl BlockSource) {
        let rows = self.indices.len();
        let most = (MOST_COLUMNS * rows as f64) as usize;
        let columns = source.columns(i, most);
        self.columns = columns.as_ref().map(Mat::ncols);
        match columns {
            None => {
                self.memory.fill(0.0);
                let whole = MatMut::from_column_major_slice_mut(&mut self.memory, rows, rows);
                source.fill(i, whole);
            }
            Some(columns) => {
                let (size, (kept, square)) = (columns.ncols(), self.parts_mut());
                MatMut::from_column_major_slice_mut(kept, rows, size).copy_from(&columns);
                triangular::matmul(
                    MatMut::from_column_major_slice_mut(square, size, size),
                    BlockStructure::TriangularUpper,
                    Accum::Replace,
                    columns.transpose(),
                    BlockStructure::Rectangular,
                    &columns,
                    BlockStructure::Rectangular,
                    1.0,
                    Par::Seq,
                );
            }
        }
        let size = self.size();
        let square = self.parts().1;
        self.diagonal = (0..size).map(|j| square[j * size + j]).collect();
        self.is_factorised = false;
    }

    /// Side of the square that is factored.
    fn size(&self) -> usize {
        self.columns.unwrap_or(self.indices.len())
    }

    /// The columns, if it is given by them, and the square.
    fn parts(&self) -> (&[f64], &[f64]) {
        let (start, size) = self.place_of_square();
        (&self.memory[..start], &self.memory[start..start + size])
    }

    fn parts_mut(&mut self) -> (&mut [f64], &mut [f64]) {
        let (start, size) = self.place_of_square();
        let (columns, rest) = self.memory.split_at_mut(start);
        (columns, &mut rest[..size])
    }

    fn place_of_square(&self) -> (usize, usize) {
        let start = self.columns.unwrap_or(0) * self.indices.len();
        (start, self.size().pow(2))
    }

    /// Works `beside`: the factorisation writes above the diagonal, too.
    fn factorise(&mut self, rho: f64, beside: &mut Vec<f64>) {
        let size = self.size();
        beside.resize(beside.len().max(size * size), 0.0);
        let factor = &mut beside[..size * size];
        copy_below(self.parts().1, size, factor);
        for (j, diagonal) in self.diagonal.iter().enumerate() {
            factor[j * size + j] = diagonal + rho;
        }
        let need = llt::factor::cholesky_in_place_scratch::<f64>(size, Par::Seq, Spec::default());
        llt::factor::cholesky_in_place(
            MatMut::from_column_major_slice_mut(factor, size, size),
            llt::factor::LltRegularization::default(),
            Par::Seq,
            MemStack::new(&mut MemBuffer::new(need)),
            Spec::default(),
        )
        .expect("G is positive semi-definite and ρ well above its rounding");
        let square = self.parts_mut().1;
        for j in 0..size {
            let lower = j * size + j..(j + 1) * size;
            square[lower.clone()].copy_from_slice(&factor[lower]);
            square[j * size + j] = factor[j * size + j].recip();
        }
        self.is_factorised = true;
    }

    fn solve(&self, r: &[f32], rho: f64) -> Mat<f64> {
        let (rows, size) = (self.indices.len(), self.size());
        let mut y = Mat::from_fn(rows, 1, |i, _| f64::from(r[self.indices[i]]));
        if self.columns.is_none() {
            self.solve_square(y.col_as_slice_mut(0));
            return y;
        }
        let columns = MatRef::from_column_major_slice(self.parts().0, rows, size);
        let mut lit = Mat::zeros(size, 1);
        let (add, replace) = (Accum::Add, Accum::Replace);
        matmul(&mut lit, replace, columns.transpose(), &y, 1.0, Par::Seq);
        self.solve_square(lit.col_as_slice_mut(0));
        matmul(&mut y, add, columns, &lit, -1.0, Par::Seq);
        y.col_mut(0).iter_mut().for_each(|y| *y /= rho);
        y
    }

    /// By the factor.
    fn solve_square(&self, values: &mut [f64]) {
        let (size, square) = (self.size(), self.parts().1);
        simd(
            #[inline(always)]
            || {
                forward(square, size, values);
                backward(square, size, values);
            },
        );
    }
}

/// Columns of a factor that one pass over the values takes.
const AT_ONCE: usize = 4;

/// The part of the columns `first..first + AT_ONCE` that belongs to the `rest` of the values.
#[inline(always)]
fn below<'s>(square: &'s [f64], size: usize, first: usize, rest: &[f64]) -> [&'s [f64]; AT_ONCE] {
    std::array::from_fn(|j| &square[(first + j + 1) * size - rest.len()..][..rest.len()])
}

/// `L⁻¹ values` in place, with `L` below the diagonal of `square`, column after column, and the inverse of its
/// diagonal on it.
#[inline(always)]
fn forward(square: &[f64], size: usize, values: &mut [f64]) {
    for first in (0..size).step_by(AT_ONCE) {
        let end = (first + AT_ONCE).min(size);
        for j in first..end {
            values[j] *= square[j * size + j];
            for i in j + 1..end {
                values[i] -= square[j * size + i] * values[j];
            }
        }
        let (solved, rest) = values.split_at_mut(end);
        if rest.is_empty() {
            break;
        }
        let v: [f64; AT_ONCE] = std::array::from_fn(|j| solved[first + j]);
        let [a, b, c, d] = below(square, size, first, rest);
        for i in 0..rest.len() {
            rest[i] -= (a[i] * v[0] + b[i] * v[1]) + (c[i] * v[2] + d[i] * v[3]);
        }
    }
}

/// `L⁻ᵀ values` in place.
#[inline(always)]
fn backward(square: &[f64], size: usize, values: &mut [f64]) {
    for first in (0..size).step_by(AT_ONCE).rev() {
        let end = (first + AT_ONCE).min(size);
        let (own, rest) = values.split_at_mut(end);
        if !rest.is_empty() {
            let sums = sums_of_products(below(square, size, first, rest), rest);
            own[first..].iter_mut().zip(sums).for_each(|(v, s)| *v -= s);
        }
        for j in (first..end).rev() {
            for i in j + 1..end {
                own[j] -= square[j * size + i] * own[i];
            }
            own[j] *= square[j * size + j];
        }
    }
}

/// `Σ column · values` of each column.
#[inline(always)]
fn sums_of_products(columns: [&[f64]; AT_ONCE], values: &[f64]) -> [f64; AT_ONCE] {
    let mut lanes = [[0.0; 8]; AT_ONCE];
    let (values8, values_rest) = values.as_chunks::<8>();
    let [a, b, c, d] = columns.map(|column| column.as_chunks::<8>());
    let parts = a.0.iter().zip(b.0).zip(c.0).zip(d.0).zip(values8);
    for ((((a, b), c), d), v) in parts {
        for i in 0..8 {
            lanes[0][i] += a[i] * v[i];
        }
        for i in 0..8 {
            lanes[1][i] += b[i] * v[i];
        }
        for i in 0..8 {
            lanes[2][i] += c[i] * v[i];
        }
        for i in 0..8 {
            lanes[3][i] += d[i] * v[i];
        }
    }
    let rests = [a.1, b.1, c.1, d.1];
    std::array::from_fn(|j| {
        let pairs = rests[j].iter().zip(values_rest);
        let tail: f64 = pairs.map(|(l, v)| l * v).sum();
        lanes[j].iter().sum::<f64>() + tail
    })
}

/// Writes what lies above the diagonal of a square of side `size` below that of `to`: a transposition,
/// tile by tile since columns are far apart. What is above the diagonal of `to` may be anything.
fn copy_below(square: &[f64], size: usize, to: &mut [f64]) {
    const TILE: usize = 8;
    let whole = size - size % TILE;
    for column in (0..whole).step_by(TILE) {
        for row in (0..=column).step_by(TILE) {
            let mut tile = [[0.0; TILE]; TILE];
            for (i, line) in tile.iter_mut().enumerate() {
                line.copy_from_slice(&square[(column + i) * size + row..][..TILE]);
            }
            for j in 0..TILE {
                let line = &mut to[(row + j) * size + column..][..TILE];
                for i in 0..TILE {
                    line[i] = tile[i][j];
                }
            }
        }
    }
    for i in whole..size {
        for j in 0..i {
            to[j * size + i] = square[i * size + j];
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
    use faer::linalg::solvers::Solve;

    #[test]
    fn solves_interleaved_blocks_at_changing_rho() {
        let a = Mat::from_fn(3, 2, |i, j| (i * 2 + j) as f64 * 0.3 - 0.4);
        let gram = &a * a.transpose();
        let mut blocks = Blocks::new(
            vec![vec![0, 2, 4], vec![1, 3, 5]],
            |i, mut block: MatMut<f64>| {
                block.copy_from(&gram * faer::Scale((i + 1) as f64));
            },
        );
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

    struct ByColumns(Vec<Mat<f64>>);

    impl BlockSource for ByColumns {
        fn fill(&self, i: usize, mut block: MatMut<f64>) {
            block.copy_from(&self.0[i] * self.0[i].transpose());
        }

        fn columns(&self, i: usize, most: usize) -> Option<Mat<f64>> {
            (self.0[i].ncols() <= most).then(|| self.0[i].clone())
        }
    }

    /// Blocks of many, few and no columns, one after another in the same memory, against
    /// `(B Bᵀ + ρI) y = r` itself: over the spread of eigenvalues that a fit on a support has.
    #[test]
    fn few_columns_give_what_the_whole_block_gives() {
        const ROWS: usize = 27;
        let wave = |k: usize| (k as f64 * 1.7).sin() + 0.8;
        let of = |columns| Mat::from_fn(ROWS, columns, |i, j| wave(i * 5 + j * j + columns));
        let r: Vec<f32> = (0..ROWS).map(|i| wave(3 * i) as f32).collect();
        let mut blocks = Blocks::new(vec![(0..ROWS).collect()], ByColumns(vec![of(ROWS)]));
        for columns in [22, 13, 0, 3, 14, 11, 1] {
            let source = ByColumns(vec![of(columns)]);
            blocks.refill(|_| true, source);
            assert_eq!(blocks.blocks[0].columns.is_some(), columns <= ROWS / 2);
            for rho in [1.0, 1e-2, 1e-4, 1e-5] {
                let b = of(columns);
                let (mut y, mut gram_y) = ([f32::NAN; ROWS], [f32::NAN; ROWS]);
                GramSolver::solve(&mut blocks, &r, rho, &mut y, &mut gram_y);
                let exact = (&b * b.transpose()
                    + Mat::<f64>::identity(ROWS, ROWS) * faer::Scale(rho))
                .as_ref()
                .llt(faer::Side::Lower)
                .unwrap()
                .solve(Mat::from_fn(ROWS, 1, |i, _| f64::from(r[i])));
                let size = exact.norm_max();
                for i in 0..ROWS {
                    let error = (f64::from(y[i]) - exact[(i, 0)]).abs();
                    assert!(
                        error < 1e-6 * size,
                        "{columns} columns, ρ {rho}: {error} of {size}"
                    );
                }
            }
        }
    }
}
