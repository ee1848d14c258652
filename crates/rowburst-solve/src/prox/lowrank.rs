//! Few shapes, each with a trace of its own.
//!
//! ```text
//! R(v) = ‖V‖_* = Σ_i σ_i(V),   V[t, pixel] = v[t, y, x]
//! ```
//!
//! the nuclear norm of the space × time matrix (Fazel 2002; Cai, Candès & Shen 2010): small
//! where every bin is a mixture of few pictures, as for extended things that blink at
//! fixed places. Nothing is assumed of neighbours in space or in time, so there is no
//! boundary. The dual ball is that of the spectral norm; the projection takes down to
//! its radius the singular values of `P` that are larger, by the eigenvectors of the small
//! `P Pᵀ` (bins × bins), in f64: its eigenvalues span twice the decades of the singular values.

use super::dual::{self, DualTerm};
use super::term::{Coupling, TermForm, TermSpec, one_voxel};
use super::{Composite, VariationWeights};
use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatMut, MatRef, Par, Side};
use rayon::prelude::*;
use rowburst_core::Shape;
use rowburst_core::linop::Background;

/// The term `lowrank`.
pub const LOWRANK: TermSpec = TermSpec {
    coupling: Coupling::All,
    // Three times the singular value of a shape on a hundredth of `P` pixels of the field, active half of the time at
    // brightness 1: √(T·P/200).
    unit: |shape| 3.0 * (shape.bins as f64 * shape.pixels() as f64 / 200.0).sqrt(),
    ..TermSpec::dual("lowrank", "few shapes, each with its own trace", |shape| {
        Box::new(LowRank::new(shape))
    })
};

/// The term `lowrank-background`. Its weight grows with the larger of pixels and bins, as in Candès et al. (2011).
pub const LOWRANK_BACKGROUND: TermSpec = TermSpec {
    name: "lowrank-background",
    favours: "a background that blinks as a whole",
    coupling: Coupling::All,
    excludes: Some((
        "background",
        "a static background has low rank: use either background or lowrank-background",
    )),
    unit: one_voxel,
    form: TermForm::Background {
        kind: Background::PerBin,
        prox: |shape, weight| {
            let weight = weight * (shape.pixels().max(shape.bins) as f64).sqrt();
            let term = Box::new(LowRank::new(shape));
            Box::new(Composite::new(shape, VariationWeights::NONE, 0.0).with(weight, term))
        },
    },
};

/// Pixels of one parallel task.
const CHUNK: usize = 512;

/// The nuclear norm of a video as a matrix of bins × pixels.
#[derive(Clone)]
pub struct LowRank {
    shape: Shape,
    dual: Vec<f32>,
}

impl LowRank {
    /// The term with its dual at zero.
    pub fn new(shape: Shape) -> Self {
        Self {
            shape,
            dual: vec![0.0; shape.voxels()],
        }
    }

    /// Squared singular values of the matrix `v`, ascending, and its left singular vectors.
    fn spectrum(&self, v: &[f32]) -> (Vec<f64>, Mat<f64>) {
        let gram = self.gram(v);
        match gram.self_adjoint_eigen(Side::Lower) {
            Ok(eigen) => {
                let squares = eigen.S().column_vector().iter().map(|s| s.max(0.0));
                (squares.collect(), eigen.U().to_owned())
            }
            // Only for numbers that are not finite, which the solver reports as such.
            Err(_) => (vec![f64::NAN; self.shape.bins], gram),
        }
    }

    /// `V Vᵀ`.
    fn gram(&self, v: &[f32]) -> Mat<f64> {
        let (bins, pixels) = (self.shape.bins, self.shape.pixels());
        let parts: Vec<Mat<f64>> = (0..pixels.div_ceil(CHUNK))
            .into_par_iter()
            .map(|chunk| {
                let first = chunk * CHUNK;
                let width = CHUNK.min(pixels - first);
                let part = Mat::from_fn(width, bins, |i, t| f64::from(v[t * pixels + first + i]));
                let mut gram = Mat::zeros(bins, bins);
                let (left, right) = (part.transpose(), part.as_ref());
                matmul(gram.as_mut(), Accum::Replace, left, right, 1.0, Par::Seq);
                gram
            })
            .collect();
        let mut sum = Mat::zeros(bins, bins);
        parts.iter().for_each(|part| sum += part);
        sum
    }

    /// `dual ← (I − U diag(1 − keep) Uᵀ) dual`, with `U` and `keep` of the directions
    /// that are cut.
    fn clip_singular_values(&mut self, vectors: MatRef<f64>, keep: &[f64]) {
        let (bins, pixels) = (self.shape.bins, self.shape.pixels());
        let rank = keep.len();
        // Uᵀ of what is taken away, bins × bins.
        let scaled = Mat::from_fn(bins, rank, |t, k| vectors[(t, k)] * (1.0 - keep[k]));
        let mut taken = Mat::<f64>::zeros(bins, bins);
        let (left, right) = (scaled.as_ref(), vectors.transpose());
        matmul(taken.as_mut(), Accum::Replace, left, right, 1.0, Par::Seq);
        let mix = Mat::<f32>::from_fn(bins, bins, |i, j| {
            (f64::from(u8::from(i == j)) - taken[(i, j)]) as f32
        });
        let old = MatRef::from_column_major_slice(&self.dual, pixels, bins);
        let mut new = vec![0.0f32; self.dual.len()];
        matmul(
            MatMut::from_column_major_slice_mut(&mut new, pixels, bins),
            Accum::Replace,
            old,
            mix.transpose(),
            1.0,
            Par::rayon(0),
        );
        self.dual = new;
    }
}

impl DualTerm for LowRank {
    fn norm_squared(&self) -> f64 {
        1.0
    }

    fn subtract_adjoint(&self, z: &mut [f32]) {
        z.par_iter_mut().zip(&self.dual).for_each(|(z, p)| *z -= p);
    }

    fn step(&mut self, z: &[f32], step: f32, radius: f32) -> f64 {
        let value = self.value(z);
        self.dual
            .par_iter_mut()
            .zip(z)
            .for_each(|(p, z)| *p += step * z);
        let (squares, vectors) = self.spectrum(&self.dual);
        let radius = f64::from(radius);
        // Ascending: those above the radius are the last ones.
        let first = squares.partition_point(|s| *s <= radius * radius);
        if first < squares.len() {
            let keep: Vec<f64> = squares[first..].iter().map(|s| radius / s.sqrt()).collect();
            self.clip_singular_values(vectors.subcols(first, keep.len()), &keep);
        }
        value
    }

    fn rescale(&mut self, factor: f32) {
        dual::scale(&mut self.dual, factor);
    }

    fn value(&self, z: &[f32]) -> f64 {
        self.spectrum(z).0.iter().map(|s| s.sqrt()).sum()
    }

    /// `r (bins + pixels − r)` for `r` singular values above `tolerance` in every active voxel, over the pixels that are
    /// active at any time.
    fn degrees_of_freedom(&self, z: &[f32], tolerance: f32) -> f64 {
        let (bins, pixels) = (self.shape.bins, self.shape.pixels());
        let active = z.par_iter().filter(|v| **v > tolerance).count() as f64;
        let places = (0..pixels)
            .into_par_iter()
            .filter(|i| (0..bins).any(|t| z[t * pixels + i] > tolerance))
            .count() as f64;
        let least = f64::from(tolerance).powi(2) * active;
        let squares = self.spectrum(z).0;
        let rank = squares.iter().filter(|s| **s > least).count() as f64;
        rank * (bins as f64 + places - rank).max(0.0)
    }
}
