//! The exact x-step on a support whose bins are seen by several instants.
//!
//! With `B = W A P`, one column for each active voxel, the x-step is
//!
//! ```text
//! y = (r − B s)/ρ,   (BᵀB + ρI) s = Bᵀ r
//! ```
//!
//! (Woodbury; Golub & Van Loan, 4th ed., section 2.1.4). Ordered in time, `BᵀB` is banded, since bins further apart than
//! an exposure have no instant in common (docs/design/025).

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, Par};
use rayon::prelude::*;
use rowburst_core::Support;
use rowburst_core::linop::{LinearOperator, WeightedOperator};
use rowburst_optics::RollingShutter;
use rowburst_optics::forward::gram::columns_of;
use rowburst_solve::block_band::BlockBand;
use std::sync::Arc;

/// Columns of a parallel task; fixed, so that the bits do not depend on the number of threads.
const PART: usize = 128;

/// Multiplications of a factor for each voxel of the video, above which conjugate gradients take less time
/// (docs/design/025).
const MAX_COST: f64 = 4e4;

/// `BᵀB` with its factor.
pub struct ActiveSystem {
    operator: Arc<WeightedOperator<Arc<RollingShutter>>>,
    support: Support,
    /// Indices of the active voxels.
    voxels: Vec<usize>,
    band: BlockBand<f32>,
    previous: Option<Previous>,
}

/// `(B Bᵀ + ρI) y = r` at the last solve.
struct Previous {
    rho: f64,
    r: Vec<f32>,
    y: Vec<f64>,
}

impl ActiveSystem {
    /// The system of `support`; `None` where conjugate gradients take less time.
    pub fn new(
        operator: &Arc<WeightedOperator<Arc<RollingShutter>>>,
        support: &Support,
    ) -> Option<Self> {
        let shutter = operator.inner();
        let shape = shutter.video_shape();
        let bins = (0..shape.bins).map(|bin| support.pixels_of(bin));
        let active: Vec<Vec<usize>> = bins.collect::<Option<_>>()?;
        let sizes: Vec<usize> = active.iter().map(Vec::len).collect();
        let last = last_bins(shutter);
        if BlockBand::<f32>::cost(&sizes, &last) > MAX_COST * shape.voxels() as f64 {
            return None;
        }
        let mut band = BlockBand::zero(&sizes, last);
        // The position of each pixel among those that are active in a bin of the instant.
        let mut position = vec![usize::MAX; shape.pixels()];
        for (instant, run) in shutter.time().instants().iter().enumerate() {
            let bins = &active[run.first_bin..run.first_bin + run.weights.len()];
            let mut pixels = Vec::new();
            for &pixel in bins.iter().flatten() {
                if position[pixel] == usize::MAX {
                    position[pixel] = pixels.len();
                    pixels.push(pixel);
                }
            }
            let products = gram_of_columns(&weighted_columns(operator, instant, &pixels));
            let terms: Vec<_> = bins.iter().zip(&run.weights).enumerate().collect();
            for (k, &(a, (first, w))) in terms.iter().enumerate() {
                for &(b, (second, v)) in &terms[k..] {
                    let block = Mat::from_fn(second.len(), first.len(), |i, j| {
                        (w * v) as f32 * products[(position[second[i]], position[first[j]])]
                    });
                    band.add(run.first_bin + b, run.first_bin + a, block.as_ref());
                }
            }
            pixels
                .iter()
                .for_each(|&pixel| position[pixel] = usize::MAX);
        }
        let bins = active.iter().enumerate();
        let voxels =
            bins.flat_map(|(t, pixels)| pixels.iter().map(move |p| t * shape.pixels() + p));
        Some(Self {
            operator: Arc::clone(operator),
            support: support.clone(),
            voxels: voxels.collect(),
            band,
            previous: None,
        })
    }

    /// Makes the next [`Self::solve`] the first one again.
    pub fn reset(&mut self) {
        self.previous = None;
    }

    /// Solves `(B Bᵀ + ρI) y = r` for an `r` that converges over the iterations, and sets `gram_y = B Bᵀ y`. Returns
    /// whether the factor is well conditioned.
    ///
    /// Each call solves for the change of `y` since the last one, so that rounding errors fade with the change.
    pub fn solve(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        let (mut whole, change): (Vec<f64>, Vec<f32>) = match self.previous.take() {
            None => (vec![0.0; r.len()], r.to_vec()),
            Some(previous) => {
                let decrease = previous.rho - rho;
                let pairs = r.iter().zip(&previous.r).zip(&previous.y);
                let change = pairs
                    .map(|((r, p), y)| (f64::from(*r) - f64::from(*p) + decrease * y) as f32)
                    .collect();
                (previous.y, change)
            }
        };
        let operator = &*self.operator;
        let mut video = vec![0.0; operator.domain_len()];
        let weighted = operator.weigh(&change);
        operator
            .inner()
            .adjoint_on(&weighted, &self.support, &mut video);
        let mut values: Vec<f32> = self.voxels.iter().map(|&i| video[i]).collect();
        self.band.solve(&mut values, rho);
        for (&i, value) in self.voxels.iter().zip(&values) {
            video[i] = *value;
        }
        let mut light = vec![0.0; r.len()];
        operator.apply(&video, &mut light);
        for i in 0..r.len() {
            whole[i] += (f64::from(change[i]) - f64::from(light[i])) / rho;
            y[i] = whole[i] as f32;
            gram_y[i] = (f64::from(r[i]) - rho * whole[i]) as f32;
        }
        self.previous = Some(Previous {
            rho,
            r: r.to_vec(),
            y: whole,
        });
        !self.band.is_ill_conditioned()
    }
}

/// The last bin that has an instant in common with each bin.
fn last_bins(shutter: &RollingShutter) -> Vec<usize> {
    let mut last: Vec<usize> = (0..shutter.video_shape().bins).collect();
    for run in shutter.time().instants() {
        let end = run.first_bin + run.weights.len() - 1;
        for last in &mut last[run.first_bin..=end] {
            *last = end.max(*last);
        }
    }
    last
}

/// `W S_i` for the field pixels `pixels`, at the rows of `instant`.
fn weighted_columns(
    operator: &WeightedOperator<Arc<RollingShutter>>,
    instant: usize,
    pixels: &[usize],
) -> Mat<f32> {
    let shutter = operator.inner();
    let mut columns = columns_of(shutter, instant, pixels);
    if let Some(weights) = operator.weights() {
        let indices = shutter.indices_of(instant);
        for column in columns.col_iter_mut() {
            let values = column.iter_mut().zip(&indices);
            values.for_each(|(value, &i)| *value *= weights[i]);
        }
    }
    columns
}

/// `columnsᵀ · columns`.
fn gram_of_columns(columns: &Mat<f32>) -> Mat<f32> {
    let mut products = Mat::zeros(columns.ncols(), columns.ncols());
    let parts = products.par_col_chunks_mut(PART);
    parts
        .zip(columns.par_col_chunks(PART))
        .for_each(|(to, part)| {
            matmul(to, Accum::Replace, columns.transpose(), part, 1.0, Par::Seq);
        });
    products
}
