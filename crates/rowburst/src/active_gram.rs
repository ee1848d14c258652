//! `BᵀB` of the columns `B` of `W A` that belong to active voxels.
//!
//! Ordered in time it is banded: bins further apart than an exposure have no instant in common (docs/design/025).

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};
use rayon::prelude::*;
use rowburst_core::linop::Scalar;
use rowburst_optics::forward::gram::columns_of;
use rowburst_optics::{InstantWeights, RollingShutter};
use rowburst_solve::block_band::BlockBand;
use std::ops::Range;

/// Columns of a parallel task; fixed, so that the bits do not depend on the number of threads.
const PART: usize = 128;

/// The active voxels of consecutive bins, and the instants whose pixels are used.
pub struct ActiveColumns<'a> {
    pub operator: &'a RollingShutter,
    /// `W`, `[y, x]`; `None`: all 1.
    pub weights: Option<&'a [f32]>,
    /// All bins that they see are in `pixels`.
    pub instants: Range<usize>,
    /// The bin of `pixels[0]`.
    pub first_bin: usize,
    /// The active pixels of each bin.
    pub pixels: Vec<Vec<usize>>,
}

/// The last bin that has one of `instants` in common with each of `count` bins from `first_bin` on, counted from that one.
pub fn last_bins(instants: &[InstantWeights], first_bin: usize, count: usize) -> Vec<usize> {
    let mut last: Vec<usize> = (0..count).collect();
    for instant in instants {
        let first = instant.first_bin - first_bin;
        let end = first + instant.weights.len() - 1;
        let seen = &mut last[first..=end];
        seen.iter_mut().for_each(|last| *last = end.max(*last));
    }
    last
}

/// The columns of an instant.
struct InstantColumns<T> {
    /// Columns of `W S_i`, one for each pixel that is active in a bin of the instant.
    columns: Mat<T>,
    /// For each bin of the instant: its index in [`ActiveColumns::pixels`], and the columns of its pixels with their weights.
    bins: Vec<(usize, Vec<(usize, f64)>)>,
}

impl ActiveColumns<'_> {
    /// Number of active voxels in each bin.
    pub fn sizes(&self) -> Vec<usize> {
        self.pixels.iter().map(Vec::len).collect()
    }

    /// The last bin that has an instant in common with each bin.
    pub fn last_bins(&self) -> Vec<usize> {
        let instants = &self.operator.time().instants()[self.instants.clone()];
        last_bins(instants, self.first_bin, self.pixels.len())
    }

    /// Multiplications of a factor of `BᵀB + ρI`.
    pub fn cost(&self) -> f64 {
        BlockBand::<f32>::cost(&self.sizes(), &self.last_bins())
    }

    /// `BᵀB`.
    pub fn gram<T: Scalar>(&self) -> BlockBand<T> {
        let mut band = BlockBand::zero(&self.sizes(), self.last_bins());
        self.each_instant(|_, InstantColumns::<T> { columns, bins }| {
            let products = gram_of_columns(&columns);
            for (k, (first, right)) in bins.iter().enumerate() {
                for (second, left) in &bins[k..] {
                    let block = Mat::from_fn(left.len(), right.len(), |i, j| {
                        let ((row, v), (column, w)) = (left[i], right[j]);
                        T::nearest(w * v) * products[(row, column)]
                    });
                    band.add(*second, *first, block.as_ref());
                }
            }
        });
        band
    }

    /// `Bᵀ y` for the pixels of the instants; `y` is `[y, x]`.
    pub fn adjoint(&self, y: &[f64]) -> Vec<f64> {
        let band = BlockBand::<f64>::zero(&self.sizes(), self.last_bins());
        let starts = band.starts();
        let mut values = vec![0.0; starts[self.pixels.len()]];
        self.each_instant(|indices, InstantColumns::<f64> { columns, bins }| {
            let y = Mat::from_fn(indices.len(), 1, |k, _| y[indices[k]]);
            let correlation: Mat<f64> = columns.transpose() * y;
            for (bin, columns) in bins {
                let to = &mut values[starts[bin]..starts[bin + 1]];
                for (to, (column, weight)) in to.iter_mut().zip(columns) {
                    *to += weight * correlation[(column, 0)];
                }
            }
        });
        values
    }

    /// Calls `use_columns` with the frame indices and the columns of each instant.
    fn each_instant<T: Scalar>(&self, mut use_columns: impl FnMut(&[usize], InstantColumns<T>)) {
        let mut position = vec![usize::MAX; self.operator.video_shape().pixels()];
        for instant in self.instants.clone() {
            let run = &self.operator.time().instants()[instant];
            let first = run.first_bin - self.first_bin;
            let mut pixels = Vec::new();
            for &pixel in self.pixels[first..first + run.weights.len()]
                .iter()
                .flatten()
            {
                if position[pixel] == usize::MAX {
                    position[pixel] = pixels.len();
                    pixels.push(pixel);
                }
            }
            let indices = self.operator.indices_of(instant);
            let mut columns = columns_of(self.operator, instant, &pixels);
            if let Some(weights) = self.weights {
                for column in columns.col_iter_mut() {
                    let values = column.iter_mut().zip(&indices);
                    values.for_each(|(value, &i)| *value *= T::from(weights[i]));
                }
            }
            let bins = run.weights.iter().enumerate().map(|(k, &weight)| {
                let pixels = &self.pixels[first + k];
                let row_scale = |&pixel: &usize| {
                    let y = pixel / self.operator.video_shape().columns;
                    f64::from(self.operator.row_scale(run.first_bin + k, y))
                };
                let column = |pixel: &usize| (position[*pixel], weight * row_scale(pixel));
                (first + k, pixels.iter().map(column).collect())
            });
            let bins = bins.collect();
            use_columns(&indices, InstantColumns { columns, bins });
            for pixel in pixels {
                position[pixel] = usize::MAX;
            }
        }
    }
}

/// `columnsᵀ · columns`.
fn gram_of_columns<T: Scalar>(columns: &Mat<T>) -> Mat<T> {
    let mut products = Mat::zeros(columns.ncols(), columns.ncols());
    let parts = products.par_col_chunks_mut(PART);
    parts
        .zip(columns.par_col_chunks(PART))
        .for_each(|(to, part)| {
            matmul(
                to,
                Accum::Replace,
                columns.transpose(),
                part,
                T::one(),
                Par::Seq,
            );
        });
    products
}
