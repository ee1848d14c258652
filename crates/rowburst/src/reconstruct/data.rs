//! The data term of a rolling-shutter frame: `½‖W(b − A v)‖²`.

use crate::linop::{LinearOperator, Weighted};
use crate::measurement::Measurement;
use crate::solve::blocks::Blocks;
use crate::solve::conjugate_gradient::{ConjugateGradient, Preconditioner};
use crate::solve::{DataTerm, GramSolver};
use crate::{RollingShutter, Shape, Support};
use faer::MatMut;
use faer::reborrow::ReborrowMut;
use std::sync::Arc;

/// Gram blocks larger than this, or in total than that, are not built.
const LARGEST_BLOCK: usize = 4096;
const MOST_BYTES: usize = 4 << 30;

/// Measurement and operator, with the solver of `W A P Aᵀ W + ρI`.
pub(super) struct FrameData {
    operator: Arc<Weighted<RollingShutter>>,
    measured: Vec<f32>,
    informative: usize,
    scale: f64,
    gram: Gram,
}

enum Gram {
    /// No bin is seen by two instants: the blocks are all there is.
    Exact(Blocks),
    Iterative(ConjugateGradient),
}

impl FrameData {
    pub fn new(operator: RollingShutter, measurement: &Measurement) -> Self {
        let weights = measurement.weights().map(<[f32]>::to_vec);
        let mut measured = measurement.image().data().to_vec();
        let mut informative = measured.len();
        if let Some(weights) = &weights {
            measured.iter_mut().zip(weights).for_each(|(b, w)| *b *= w);
            informative = weights.iter().filter(|w| **w > 0.0).count();
        }
        let operator = Arc::new(Weighted::new(operator, weights));
        // Halfway between the middle and the edge of the sensor.
        let (rows, columns) = operator.inner().frame_shape();
        let scale = operator
            .inner()
            .pixel_power(rows / 4, columns / 4)
            .max(f64::MIN_POSITIVE);
        let exact = operator.inner().time().is_disjoint();
        let gram = match blocks(&operator, None) {
            Some(blocks) if exact => Gram::Exact(blocks),
            Some(blocks) => iterative(Box::new(BlockPreconditioner(blocks)), measured.len()),
            None => {
                let operator = Arc::clone(&operator);
                iterative(
                    Box::new(PlanePreconditioner { operator, scale }),
                    measured.len(),
                )
            }
        };
        Self {
            operator,
            measured,
            informative,
            scale,
            gram,
        }
    }

    /// `W`, if not all 1.
    pub fn weights(&self) -> Option<&[f32]> {
        self.operator.weights()
    }

    pub fn shape(&self) -> Shape {
        self.operator.inner().video_shape()
    }
}

fn iterative(preconditioner: Box<dyn Preconditioner>, length: usize) -> Gram {
    Gram::Iterative(ConjugateGradient::new(preconditioner, length))
}

impl DataTerm for FrameData {
    fn operator(&self) -> &dyn LinearOperator {
        &*self.operator
    }

    fn measured(&self) -> &[f32] {
        &self.measured
    }

    fn informative(&self) -> usize {
        self.informative
    }

    fn scale(&self) -> f64 {
        self.scale
    }

    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        match &mut self.gram {
            Gram::Exact(blocks) => {
                GramSolver::solve(blocks, r, rho, y, gram_y);
                true
            }
            Gram::Iterative(solver) => solver.solve(&*self.operator, r, rho, y, gram_y),
        }
    }

    fn misfit_of_bins(&self, residual: &[f32]) -> Vec<f64> {
        let operator = self.operator.inner();
        let mut sums = vec![(0.0, 0usize); self.shape().bins];
        for (instant, run) in operator.time().instants().iter().enumerate() {
            let indices = operator.indices_of(instant);
            let usable = |i: &&usize| self.operator.weights().is_none_or(|w| w[**i] > 0.0);
            let count = indices.iter().filter(usable).count();
            let power: f64 = indices
                .iter()
                .map(|&i| f64::from(residual[i]).powi(2))
                .sum();
            for sum in &mut sums[run.first_bin..run.first_bin + run.weights.len()] {
                *sum = (sum.0 + power, sum.1 + count);
            }
        }
        sums.iter()
            .map(|(power, count)| (power / (*count).max(1) as f64).sqrt())
            .collect()
    }

    fn restrict(&mut self, support: &Support) {
        match &mut self.gram {
            Gram::Exact(exact) => {
                exact.refill(|i, sum| fill(&self.operator, i, Some(support), sum));
            }
            Gram::Iterative(solver) => {
                let blocks = blocks(&self.operator, Some(support));
                let preconditioner =
                    blocks.map(|b| Box::new(BlockPreconditioner(b)) as Box<dyn Preconditioner>);
                solver.restrict(support, preconditioner);
            }
        }
    }
}

/// The diagonal blocks of `W A P Aᵀ W`, one for each instant; `None` if they are too large.
fn blocks(operator: &Weighted<RollingShutter>, support: Option<&Support>) -> Option<Blocks> {
    let shutter = operator.inner();
    let (_, columns) = shutter.frame_shape();
    let sizes = || {
        shutter
            .rows_of_instants()
            .iter()
            .map(|rows| rows.len() * columns)
    };
    let bytes: usize = sizes().map(|size| 8 * size * size).sum();
    if sizes().any(|size| size > LARGEST_BLOCK) || bytes > MOST_BYTES {
        return None;
    }
    let indices = (0..shutter.rows_of_instants().len()).map(|i| shutter.indices_of(i));
    Some(Blocks::new(indices.collect(), |i, sum| {
        fill(operator, i, support, sum)
    }))
}

/// Writes the block of instant `i` of `W A P Aᵀ W` over zeros.
fn fill(
    operator: &Weighted<RollingShutter>,
    instant: usize,
    support: Option<&Support>,
    mut sum: MatMut<f64>,
) {
    let shutter = operator.inner();
    shutter.add_gram_block(instant, support, sum.rb_mut());
    if let Some(weights) = operator.weights() {
        let indices = shutter.indices_of(instant);
        for (j, &column) in indices.iter().enumerate() {
            for (i, &row) in indices.iter().enumerate() {
                sum[(i, j)] *= f64::from(weights[row]) * f64::from(weights[column]);
            }
        }
    }
}

struct BlockPreconditioner(Blocks);

impl Preconditioner for BlockPreconditioner {
    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        self.0.solve(r, rho, out);
    }
}

/// Where whole planes are convolved: division in Fourier space; else a constant.
struct PlanePreconditioner {
    operator: Arc<Weighted<RollingShutter>>,
    scale: f64,
}

impl Preconditioner for PlanePreconditioner {
    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        match self.operator.inner().circulant_inverse(r, rho) {
            Some(inverse) => out.copy_from_slice(&inverse),
            None => out
                .iter_mut()
                .zip(r)
                .for_each(|(o, r)| *o = r / (self.scale + rho) as f32),
        }
    }
}
