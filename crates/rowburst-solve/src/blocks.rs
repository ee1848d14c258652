//! Exact solution of `(G + ρI) y = r` for a block-diagonal `G`.
//!
//! A block `G_i` is given whole, or as `B Bᵀ` with one column of `B` for each active voxel. Where these are few, a
//! smaller system is solved:
//!
//! ```text
//! (G_i + ρI)⁻¹ r = (r − B (BᵀB + ρI)⁻¹ Bᵀ r) / ρ
//! ```
//!
//! (Woodbury; Golub & Van Loan, 4th ed., section 2.1.4). Blocks and factors are f32 or f64; f32 takes half of the
//! memory and of the time. The eigenvalues of `G` span six decades and more, and `ρ` has to exceed the rounding error
//! of the largest; smaller `ρ` need f64 (`docs/design/003`).

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::{Accum, ColMut, ColRef, Mat, MatMut, MatRef, Par, Spec};
use rayon::prelude::*;
use rowburst_core::Cancel;
use rowburst_core::linop::Scalar;
use rowburst_core::vecmath::simd;
use std::hint::black_box;

/// Supplies the diagonal blocks of `G`.
pub trait BlockSource<T>: Sync {
    /// Writes the elements on and above the diagonal of block `i` to `block`, which holds zeros.
    fn write_block(&self, i: usize, block: MatMut<T>);

    /// `B` of block `i = B Bᵀ`, where it is known and has at most `max_columns` columns.
    fn columns(&self, i: usize, max_columns: usize) -> Option<Mat<T>> {
        let _ = (i, max_columns);
        None
    }

    /// Whether block `i` is that of all voxels, active or not. Such a block is kept for later use until
    /// [`Blocks::rebuild_all`].
    fn is_unrestricted(&self, i: usize) -> bool {
        let _ = i;
        false
    }
}

impl<T, F: Fn(usize, MatMut<T>) + Sync> BlockSource<T> for F {
    fn write_block(&self, i: usize, block: MatMut<T>) {
        self(i, block);
    }
}

/// The diagonal blocks of `G` with their factors, for blocks and factors in `T`.
pub struct Blocks<T> {
    blocks: Vec<Block<T>>,
    is_ill_conditioned: bool,
    cancel: Cancel,
}

/// A diagonal block of `G`.
struct Block<T> {
    /// Positions of its elements in the whole vector.
    indices: Vec<usize>,
    /// `G_i`, if the block is given whole or was unrestricted before.
    gram: PackedCholesky<T>,
    /// Whether `gram` is the block of all voxels. It is kept while `low_rank` takes its place.
    is_unrestricted: bool,
    /// `B` and `BᵀB`, if the block is given by columns.
    low_rank: Option<(Mat<T>, PackedCholesky<T>)>,
    previous: Option<PreviousSolve>,
}

/// `(G_i + ρI) y = r` of a block, at the last [`Blocks::solve_incremental`].
struct PreviousSolve {
    rho: f64,
    r: Vec<f32>,
    y: Vec<f64>,
}

/// A symmetric matrix `M` and the Cholesky factor `L` of `M + ρI` for the last `ρ`.
///
/// Both share one square in column-major order: `M` above the diagonal, `L` on and below it.
struct PackedCholesky<T> {
    size: usize,
    memory: Vec<T>,
    /// The diagonal of `M`.
    diagonal: Vec<T>,
    /// The inverses of the diagonal tiles of `L`, each in column-major order.
    inverse_tiles: Vec<FactorTile<T>>,
    /// `ρ` of the factor, if there is one.
    rho: Option<f64>,
    /// Whether rounding made a pivot of the factor too small, so that it was replaced.
    is_ill_conditioned: bool,
}

/// Side of the tiles of a factor; 8 elements of f32 fill a vector register of 256 bits.
const TILE: usize = 8;

type FactorTile<T> = [[T; TILE]; TILE];

/// Active columns per row up to which the Woodbury form is used; larger costs more time (docs/design/003).
const MAX_COLUMN_RATIO: f64 = 0.5;

impl<T: Scalar> Blocks<T> {
    /// One block for each list of `indices`: the positions of the block's elements in the whole vector.
    ///
    /// The lists together hold every position once.
    pub fn new(indices: Vec<Vec<usize>>, source: impl BlockSource<T>) -> Self {
        let empty = |indices: Vec<usize>| Block {
            indices,
            gram: PackedCholesky::new(),
            is_unrestricted: false,
            low_rank: None,
            previous: None,
        };
        let mut blocks = Self {
            blocks: indices.into_iter().map(empty).collect(),
            is_ill_conditioned: false,
            cancel: Cancel::default(),
        };
        blocks.rebuild_changed(|_| true, source);
        blocks
    }

    /// The same blocks, which solve nothing once `cancel` asks for the end.
    #[must_use]
    pub fn with_cancel(self, cancel: &Cancel) -> Self {
        Self {
            cancel: cancel.clone(),
            ..self
        }
    }

    /// No blocks at all.
    pub fn empty() -> Self {
        Self {
            blocks: Vec::new(),
            is_ill_conditioned: false,
            cancel: Cancel::default(),
        }
    }

    /// Whether rounding made a pivot of one of the present factors too small. `ρ` is then too small for `T`, and the
    /// last solution belongs to slightly different blocks.
    pub fn is_ill_conditioned(&self) -> bool {
        self.is_ill_conditioned
    }

    /// Solves `(G + ρI) y = r` and computes `gram_y = G y`, for an iteration in which `r` changes less and less.
    ///
    /// Each call solves for the change of `y` since the last one, so that rounding errors fade with the change. A
    /// defect `d` of the first call stays: later calls solve for `r + d`. An iteration that adds up `gram_y = r − ρy`
    /// absorbs `d` within a few steps. The solution is reliable unless [`Self::is_ill_conditioned`].
    ///
    /// # Panics
    /// If a block is not finite.
    pub fn solve_incremental(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) {
        let cancel = &self.cancel;
        let parts: Vec<Vec<(f32, f32)>> = self
            .blocks
            .par_iter_mut()
            .map_init(Vec::new, |scratch, block| {
                if cancel.is_cancelled() {
                    return Vec::new();
                }
                block.solve_incremental(r, rho, scratch)
            })
            .collect();
        self.is_ill_conditioned = self.blocks.iter().any(Block::is_ill_conditioned);
        for (block, part) in self.blocks.iter().zip(&parts) {
            for (values, &at) in part.iter().zip(&block.indices) {
                (y[at], gram_y[at]) = *values;
            }
        }
    }

    /// Makes the next [`Self::solve_incremental`] the first one again.
    pub fn reset(&mut self) {
        self.blocks.iter_mut().for_each(|b| b.previous = None);
    }

    /// Builds all blocks again, the unrestricted ones included.
    pub fn rebuild_all(&mut self, source: impl BlockSource<T>) {
        self.blocks
            .iter_mut()
            .for_each(|b| b.is_unrestricted = false);
        self.rebuild_changed(|_| true, source);
    }

    /// Builds the blocks `i` with `has_changed(i)` again, in the memory of the old ones.
    pub fn rebuild_changed(
        &mut self,
        has_changed: impl Fn(usize) -> bool + Sync,
        source: impl BlockSource<T>,
    ) {
        self.blocks
            .par_iter_mut()
            .enumerate()
            .filter(|(i, _)| has_changed(*i))
            .for_each(|(i, block)| block.rebuild(i, &source));
    }

    /// Solves `(G + ρI) y = r`. A block is factored again only if it or `ρ` changed.
    ///
    /// # Panics
    /// If a block is not finite.
    pub fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32]) {
        let cancel = &self.cancel;
        let parts: Vec<Vec<T>> = self
            .blocks
            .par_iter_mut()
            .map_init(Vec::new, |scratch, block| {
                if cancel.is_cancelled() {
                    return Vec::new();
                }
                let mut y = block.indices.iter().map(|&i| T::from(r[i])).collect();
                block.solve(&mut y, rho, scratch);
                y
            })
            .collect();
        self.is_ill_conditioned = self.blocks.iter().any(Block::is_ill_conditioned);
        for (block, part) in self.blocks.iter().zip(&parts) {
            for (&value, &at) in part.iter().zip(&block.indices) {
                let value: f64 = value.into();
                y[at] = value as f32;
            }
        }
    }

    /// [`Self::solve`], and `gram_y = G y`.
    ///
    /// # Panics
    /// If a block is not finite.
    pub fn solve_with_product(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) {
        self.solve(r, rho, y);
        for ((g, &r), &y) in gram_y.iter_mut().zip(r).zip(y.iter()) {
            *g = (f64::from(r) - rho * f64::from(y)) as f32;
        }
    }
}

impl<T: Scalar> Block<T> {
    fn rebuild(&mut self, i: usize, source: &impl BlockSource<T>) {
        let rows = self.indices.len();
        let max_columns = (MAX_COLUMN_RATIO * rows as f64) as usize;
        let columns = source.columns(i, max_columns);
        if columns.is_some() && !self.is_unrestricted {
            self.gram = PackedCholesky::new();
        }
        let Some(columns) = columns else {
            self.low_rank = None;
            let is_unrestricted = source.is_unrestricted(i);
            if !(is_unrestricted && self.is_unrestricted) {
                self.gram
                    .set_matrix(rows, |gram| source.write_block(i, gram));
                self.is_unrestricted = is_unrestricted;
            }
            return;
        };
        let mut packed = self
            .low_rank
            .take()
            .map_or(PackedCholesky::new(), |(_, packed)| packed);
        packed.set_matrix(columns.ncols(), |packed| {
            triangular::matmul(
                packed,
                BlockStructure::TriangularUpper,
                Accum::Replace,
                columns.transpose(),
                BlockStructure::Rectangular,
                &columns,
                BlockStructure::Rectangular,
                T::one(),
                Par::Seq,
            );
        });
        self.low_rank = Some((columns, packed));
    }

    fn is_ill_conditioned(&self) -> bool {
        let packed = self
            .low_rank
            .as_ref()
            .map_or(&self.gram, |(_, packed)| packed);
        packed.is_ill_conditioned
    }

    /// [`Blocks::solve_incremental`] of this block: each element of `y` with that of `G y`.
    fn solve_incremental(&mut self, r: &[f32], rho: f64, scratch: &mut Vec<T>) -> Vec<(f32, f32)> {
        let r: Vec<f32> = self.indices.iter().map(|&i| r[i]).collect();
        let (mut y, mut change): (Vec<f64>, Vec<T>) = match self.previous.take() {
            None => (vec![0.0; r.len()], r.iter().map(|&r| T::from(r)).collect()),
            Some(previous) => {
                // The new right-hand side minus `(G + ρI) y` of the old `y`, with `G y = r − ρy` of the last call.
                let rho_decrease = previous.rho - rho;
                let change =
                    r.iter()
                        .zip(&previous.r)
                        .zip(&previous.y)
                        .map(|((&r, &previous), y)| {
                            T::nearest(f64::from(r) - f64::from(previous) + rho_decrease * y)
                        });
                let change = change.collect();
                (previous.y, change)
            }
        };
        self.solve(&mut change, rho, scratch);
        let values = y.iter_mut().zip(&change).zip(&r).map(|((y, &change), &r)| {
            *y += change.into();
            let rounded = *y as f32;
            (rounded, (f64::from(r) - rho * f64::from(rounded)) as f32)
        });
        let values = values.collect();
        self.previous = Some(PreviousSolve { rho, r, y });
        values
    }

    /// Replaces `y` by `(G_i + ρI)⁻¹ y`.
    fn solve(&mut self, y: &mut Vec<T>, rho: f64, scratch: &mut Vec<T>) {
        let Some((columns, packed)) = &mut self.low_rank else {
            return self.gram.solve(y, rho, scratch);
        };
        let mut active = vec![T::zero(); columns.ncols()];
        let (add, replace) = (Accum::Add, Accum::Replace);
        multiply(replace, &mut active, columns.transpose(), y, T::one());
        packed.solve(&mut active, rho, scratch);
        multiply(add, y, columns.as_ref(), &active, -T::one());
        let over_rho = T::nearest(1.0 / rho);
        y.iter_mut().for_each(|y| *y *= over_rho);
    }
}

impl<T: Scalar> PackedCholesky<T> {
    const fn new() -> Self {
        Self {
            size: 0,
            memory: Vec::new(),
            diagonal: Vec::new(),
            inverse_tiles: Vec::new(),
            rho: None,
            is_ill_conditioned: false,
        }
    }

    /// Elements from one column to the next.
    fn stride(&self) -> usize {
        self.size.next_multiple_of(TILE)
    }

    /// Sets `M`, of side `size`: `write` writes its elements on and above the diagonal over zeros.
    fn set_matrix(&mut self, size: usize, write: impl FnOnce(MatMut<T>)) {
        self.size = size;
        let stride = self.stride();
        self.memory.clear();
        self.memory.resize(stride * size, T::zero());
        write(as_matrix(&mut self.memory, size, stride));
        self.diagonal.clear();
        let diagonal = (0..size).map(|j| self.memory[j * stride + j]);
        self.diagonal.extend(diagonal);
        self.rho = None;
    }

    /// Computes `L` in `scratch`, since the factorisation overwrites the part above the diagonal too.
    fn factorise(&mut self, rho: f64, scratch: &mut Vec<T>) {
        let (size, stride, packed) = (self.size, self.stride(), &mut self.memory);
        scratch.resize(scratch.len().max(packed.len()), T::zero());
        let factor = &mut scratch[..packed.len()];
        copy_below(packed, size, stride, factor);
        let shift = T::nearest(rho);
        for (j, diagonal) in self.diagonal.iter().enumerate() {
            factor[j * stride + j] = *diagonal + shift;
        }
        let need = llt::factor::cholesky_in_place_scratch::<T>(size, Par::Seq, Spec::default());
        let info = llt::factor::cholesky_in_place(
            as_matrix(factor, size, stride),
            // Exact pivots are at least ρ. One below ρ/2 is wrong by rounding and is replaced by ρ.
            llt::factor::LltRegularization {
                dynamic_regularization_delta: shift,
                dynamic_regularization_epsilon: shift * T::nearest(0.5),
            },
            Par::Seq,
            MemStack::new(&mut MemBuffer::new(need)),
            Spec::default(),
        )
        .expect("G is finite and positive semi-definite");
        self.is_ill_conditioned = info.dynamic_regularization_count > 0;
        for j in 0..size {
            let lower = j * stride + j..j * stride + size;
            packed[lower.clone()].copy_from_slice(&factor[lower]);
            packed[j * stride + size..(j + 1) * stride].fill(T::zero());
        }
        let tiles = (0..size).step_by(TILE);
        let tiles = tiles.map(|first| inverse_tile(packed, size, stride, first));
        self.inverse_tiles.clear();
        self.inverse_tiles.extend(tiles);
        self.rho = Some(rho);
    }

    /// Replaces `values` by `(M + ρI)⁻¹ values`. A new factor is computed in `scratch`.
    fn solve(&mut self, values: &mut Vec<T>, rho: f64, scratch: &mut Vec<T>) {
        if self.rho != Some(rho) {
            self.factorise(rho, scratch);
        }
        self.prefetch();
        values.resize(self.stride(), T::zero());
        solve_packed(&self.memory, &self.inverse_tiles, values);
        values.truncate(self.size);
    }

    /// Reads one element of each cache line of the factor, so that the processor fetches many lines at once. The
    /// solve goes from column to column and would wait for each.
    fn prefetch(&self) {
        const LINE: usize = 64;
        let (stride, every) = (self.stride(), LINE / size_of::<T>());
        let mut sums = [T::zero(); 8];
        for (j, column) in self.memory.chunks_exact(stride.max(1)).enumerate() {
            let lines = column[j..].iter().step_by(every);
            for (k, value) in lines.enumerate() {
                sums[k % 8] += *value;
            }
        }
        black_box(sums);
    }
}

fn as_matrix<T>(packed: &mut [T], size: usize, stride: usize) -> MatMut<'_, T> {
    MatMut::from_column_major_slice_with_stride_mut(packed, size, size, stride)
}

/// Writes `weight · matrix · values` to `to`, or adds it, as `accum` says.
fn multiply<T: Scalar>(accum: Accum, to: &mut [T], matrix: MatRef<T>, values: &[T], weight: T) {
    let to = ColMut::from_slice_mut(to);
    matmul(
        to.as_mat_mut(),
        accum,
        matrix,
        ColRef::from_slice(values).as_mat(),
        weight,
        Par::Seq,
    );
}

/// The inverse of the diagonal tile of `L` at column `first`. Beyond the end of `L` the tile is the identity.
fn inverse_tile<T: Scalar>(
    packed: &[T],
    size: usize,
    stride: usize,
    first: usize,
) -> FactorTile<T> {
    let element = |i: usize, j: usize| packed[(first + j) * stride + first + i];
    let rows = TILE.min(size - first);
    let mut inverse = [[T::zero(); TILE]; TILE];
    for (j, column) in inverse.iter_mut().enumerate() {
        column[j] = T::one();
        if j < rows {
            for i in j..rows {
                let known = (j..i).map(|k| element(i, k) * column[k]);
                let sum = known.fold(column[i], |sum, part| sum - part);
                column[i] = sum / element(i, i);
            }
        }
    }
    inverse
}

/// Replaces `values` by `(L Lᵀ)⁻¹ values`.
///
/// `L` is the part of `packed` below the diagonal tiles, and `inverse_tiles` are the inverses of these. `values` is as
/// long as a column of `packed`, a multiple of [`TILE`].
fn solve_packed<T: Scalar>(packed: &[T], inverse_tiles: &[FactorTile<T>], values: &mut [T]) {
    let stride = values.len();
    simd(
        #[inline(always)]
        || {
            for (k, tile) in inverse_tiles.iter().enumerate() {
                let (solved, rest) = values.split_at_mut((k + 1) * TILE);
                let current = last_tile(solved);
                *current = times(tile, current);
                subtract_columns(below(packed, stride, k), current, rest);
            }
            for (k, tile) in inverse_tiles.iter().enumerate().rev() {
                let (before, rest) = values.split_at_mut((k + 1) * TILE);
                let sums = sums_of_products(below(packed, stride, k), rest);
                let current = last_tile(before);
                for (v, sum) in current.iter_mut().zip(sums) {
                    *v -= sum;
                }
                *current = tile.map(|column| dot(&column, current));
            }
        },
    );
}

#[inline(always)]
fn last_tile<T>(values: &mut [T]) -> &mut [T; TILE] {
    values.last_chunk_mut().expect("values come in tiles")
}

/// The columns of tile `k`, from the first row below the tile on.
#[inline(always)]
fn below<T>(packed: &[T], stride: usize, k: usize) -> [&[T]; TILE] {
    std::array::from_fn(|j| {
        let column = (k * TILE + j) * stride;
        // The last tile has no rows below it, and may have fewer columns.
        let rows = column + (k + 1) * TILE..column + stride;
        packed.get(rows).unwrap_or(&[])
    })
}

/// `tile · values`.
#[inline(always)]
fn times<T: Scalar>(tile: &FactorTile<T>, values: &[T; TILE]) -> [T; TILE] {
    let mut sums = [[T::zero(); TILE]; 2];
    for (j, (column, &v)) in tile.iter().zip(values).enumerate() {
        let sum = &mut sums[j % 2];
        for i in 0..TILE {
            sum[i] += column[i] * v;
        }
    }
    std::array::from_fn(|i| sums[0][i] + sums[1][i])
}

#[inline(always)]
fn dot<T: Scalar>(a: &[T; TILE], b: &[T; TILE]) -> T {
    let products = std::array::from_fn::<T, TILE, _>(|i| a[i] * b[i]);
    let pairs = std::array::from_fn::<T, 4, _>(|i| products[i] + products[i + 4]);
    (pairs[0] + pairs[2]) + (pairs[1] + pairs[3])
}

/// `rest −= Σ_j column_j v_j`; the length of `rest` is a multiple of [`TILE`].
#[inline(always)]
fn subtract_columns<T: Scalar>(columns: [&[T]; TILE], v: &[T; TILE], rest: &mut [T]) {
    // Two tiles at once: 16 elements of f32 fill a vector register of 512 bits.
    const TWO: usize = 2 * TILE;
    let (double_tiles, single_tile) = rest.as_chunks_mut::<TWO>();
    let parts = columns.map(<[T]>::as_chunks::<TWO>);
    let double_columns = parts.map(|(double_columns, _)| &double_columns[..double_tiles.len()]);
    for (chunk, to) in double_tiles.iter_mut().enumerate() {
        let mut sum = *to;
        for j in 0..TILE {
            let part = &double_columns[j][chunk];
            for i in 0..TWO {
                sum[i] -= part[i] * v[j];
            }
        }
        *to = sum;
    }
    for j in 0..TILE {
        for (to, part) in single_tile.iter_mut().zip(parts[j].1) {
            *to -= *part * v[j];
        }
    }
}

/// `column_jᵀ values` of each column; the length of `values` is a multiple of [`TILE`].
#[inline(always)]
fn sums_of_products<T: Scalar>(columns: [&[T]; TILE], values: &[T]) -> [T; TILE] {
    let values = values.as_chunks::<TILE>().0;
    let columns = columns.map(|column| &column.as_chunks::<TILE>().0[..values.len()]);
    let mut sums = [[T::zero(); TILE]; TILE];
    for (chunk, v) in values.iter().enumerate() {
        for j in 0..TILE {
            let part = &columns[j][chunk];
            for i in 0..TILE {
                sums[j][i] += part[i] * v[i];
            }
        }
    }
    sums.map(|lanes| {
        let pairs = std::array::from_fn::<T, 4, _>(|i| lanes[i] + lanes[i + 4]);
        (pairs[0] + pairs[2]) + (pairs[1] + pairs[3])
    })
}

/// Transposes the part of `packed` above the diagonal into the part of `to` below its diagonal.
///
/// It works tile by tile, since columns are far apart in memory. The rest of `to` is undefined afterwards.
fn copy_below<T: Scalar>(packed: &[T], size: usize, stride: usize, to: &mut [T]) {
    let whole = size - size % TILE;
    for column in (0..whole).step_by(TILE) {
        for row in (0..=column).step_by(TILE) {
            let mut tile = [[T::zero(); TILE]; TILE];
            for (i, line) in tile.iter_mut().enumerate() {
                line.copy_from_slice(&packed[(column + i) * stride + row..][..TILE]);
            }
            for j in 0..TILE {
                let line = &mut to[(row + j) * stride + column..][..TILE];
                for i in 0..TILE {
                    line[i] = tile[i][j];
                }
            }
        }
    }
    for i in whole..size {
        for j in 0..i {
            to[j * stride + i] = packed[i * stride + j];
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
            blocks.solve_with_product(&r, rho, &mut y, &mut gram_y);
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

    struct ByColumns(Mat<f64>);

    impl<T: Scalar> BlockSource<T> for ByColumns {
        fn write_block(&self, _: usize, mut block: MatMut<T>) {
            let whole = &self.0 * self.0.transpose();
            for (i, j) in (0..ROWS).flat_map(|i| (0..ROWS).map(move |j| (i, j))) {
                block[(i, j)] = T::nearest(whole[(i, j)]);
            }
        }

        fn columns(&self, _: usize, max_columns: usize) -> Option<Mat<T>> {
            let columns = self.0.ncols();
            let of = |i: usize, j: usize| T::nearest(self.0[(i, j)]);
            (columns <= max_columns).then(|| Mat::from_fn(ROWS, columns, of))
        }
    }

    const ROWS: usize = 27;

    /// Solves blocks of many, few and no columns, one after the other in the same memory, for each of `rhos`.
    ///
    /// Returns the largest residual over `ρ‖y‖`, and the largest error of `y` over its largest element.
    fn worst<T: Scalar>(rhos: &[f64]) -> (f64, f64) {
        let sample = |k: usize| (k as f64 * 1.7).sin() + 0.8;
        let of = |columns| Mat::from_fn(ROWS, columns, |i, j| sample(i * 5 + j * j + columns));
        let r: Vec<f32> = (0..ROWS).map(|i| sample(3 * i) as f32).collect();
        let wanted = Mat::from_fn(ROWS, 1, |i, _| f64::from(r[i]));
        let mut blocks = Blocks::<T>::new(vec![(0..ROWS).collect()], ByColumns(of(ROWS)));
        let mut worst = (0.0f64, 0.0f64);
        for columns in [22, 13, 0, 3, 14, 11, 1] {
            let b = of(columns);
            blocks.rebuild_changed(|_| true, ByColumns(b.clone()));
            assert_eq!(blocks.blocks[0].low_rank.is_some(), columns <= ROWS / 2);
            for &rho in rhos {
                let mut y = [f32::NAN; ROWS];
                blocks.solve(&r, rho, &mut y);
                assert!(!blocks.is_ill_conditioned());
                let y = Mat::from_fn(ROWS, 1, |i, _| f64::from(y[i]));
                let whole =
                    &b * b.transpose() + Mat::<f64>::identity(ROWS, ROWS) * faer::Scale(rho);
                let left = (&whole * &y - &wanted).norm_l2() / (rho * y.norm_l2());
                let exact = whole
                    .as_ref()
                    .llt(faer::Side::Lower)
                    .unwrap()
                    .solve(&wanted);
                let error = (&y - &exact).norm_max() / exact.norm_max();
                worst = (worst.0.max(left), worst.1.max(error));
            }
        }
        worst
    }

    /// The diagonal of `G` is about 20.
    #[test]
    fn low_rank_blocks_equal_full_blocks() {
        let (left, _) = worst::<f32>(&[1.0, 0.1, 0.02]);
        assert!(left < 1e-2, "{left}");
        let (_, error) = worst::<f64>(&[1.0, 1e-2, 1e-4, 1e-5]);
        assert!(error < 1e-6, "{error}");
    }

    /// A matrix of ones and far too small a `ρ`.
    #[test]
    fn ill_conditioning_is_reported() {
        let ones = |_: usize, mut block: MatMut<f32>| block.fill(1.0);
        let mut blocks = Blocks::new(vec![(0..ROWS).collect()], ones);
        let mut y = [0.0; ROWS];
        for (rho, is_ill_conditioned) in [(1e-2, false), (1e-9, true), (1e-2, false)] {
            blocks.solve(&[1.0; ROWS], rho, &mut y);
            assert_eq!(blocks.is_ill_conditioned(), is_ill_conditioned);
        }
    }
}
