//! A frame with stray light, `b = A v + C s + noise`, as the solver sees it.
//!
//! The columns of `C` are patterns of light that belongs to no scene, and `s` their unknown strengths. For any video the
//! best `s` follows by least squares, which leaves
//!
//! ```text
//! min_s ½‖W(b − A v − C s)‖² = ½‖(I − QQᵀ) W(b − A v)‖²,   W C = Q R
//! ```
//!
//! (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10(2), 413, 1973). So the solver has the operator
//! `(I − QQᵀ) W A`, and never sees `s`.

use super::FrameData;
use crate::reconstruct::x_step;
use faer::linalg::solvers::{Qr, SolveLstsq};
use faer::{Col, Mat};
use rowburst_core::Support;
use rowburst_core::linop::{LinearOperator, Subspace, WeightedOperator, WithoutSubspace};
use rowburst_optics::RollingShutter;
use rowburst_solve::conjugate_gradient::{ConjugateGradient, Preconditioner, TOLERANCE};
use rowburst_solve::{Capabilities, DataTerm};
use std::sync::Arc;

/// Early x-steps, see [`ConjugateGradient::early_calls`]: those of a fit, whose stray light is corrected later.
const EARLY_CALLS: usize = 40;

/// What a fit tells, in counts at each pixel.
pub(in crate::reconstruct) struct StrayLightFit {
    pub stray_light: Vec<f32>,
    /// What stray light and video leave of the frame; 0 at pixels with weight 0.
    pub rest: Vec<f32>,
}

/// The data term of a frame with stray light.
pub(in crate::reconstruct) struct WithStrayLight<'d> {
    data: &'d mut FrameData,
    /// `C`, `[pixel, pattern]`.
    patterns: &'d Mat<f64>,
    /// The factors of `W C`.
    factors: Qr<f64>,
    subspace: Arc<Subspace>,
    operator: WithoutSubspace<Arc<WeightedOperator<Arc<RollingShutter>>>>,
    measurements: Vec<f32>,
    x_step: ConjugateGradient,
}

impl<'d> WithStrayLight<'d> {
    /// The frame of `data`, which is as new and without a background, with stray light of `patterns`, `[pixel, pattern]`.
    pub fn new(data: &'d mut FrameData, patterns: &'d Mat<f64>) -> Self {
        let operator = Arc::clone(data.system.operator());
        let weights = operator.weights();
        let weighted = Mat::from_fn(patterns.nrows(), patterns.ncols(), |i, j| {
            patterns[(i, j)] * weights.map_or(1.0, |w| f64::from(w[i]))
        });
        let factors = weighted.qr();
        let orthonormal = factors.compute_thin_Q();
        let subspace = Arc::new(Subspace::new(Mat::from_fn(
            orthonormal.nrows(),
            orthonormal.ncols(),
            |i, j| orthonormal[(i, j)] as f32,
        )));
        let mut measurements = data.measurements.clone();
        // Rounding leaves a little of the stray light the first time.
        for _ in 0..2 {
            subspace.remove(&mut measurements);
        }
        let preconditioner = preconditioner(data, &subspace);
        let mut x_step = ConjugateGradient::new(preconditioner, measurements.len());
        x_step.early_calls = EARLY_CALLS;
        Self {
            x_step,
            operator: WithoutSubspace::new(operator, Arc::clone(&subspace)),
            data,
            patterns,
            factors,
            subspace,
            measurements,
        }
    }

    /// The stray light beside `video`, and what both leave of the frame.
    pub fn fit(&self, video: &[f32]) -> StrayLightFit {
        let light = self.data.predicted(video);
        let frame = self.data.frame.iter().zip(&light);
        let mut rest: Vec<f32> = frame.map(|(b, a)| b - a).collect();
        let weighted = self.data.weigh(&rest);
        let weighted = Col::from_fn(weighted.len(), |i| f64::from(weighted[i]));
        let stray_light = self.patterns * self.factors.solve_lstsq(&weighted);
        let stray_light: Vec<f32> = stray_light.iter().map(|s| *s as f32).collect();
        for ((rest, stray), is_usable) in rest.iter_mut().zip(&stray_light).zip(self.data.usable())
        {
            *rest = if is_usable { *rest - stray } else { 0.0 };
        }
        StrayLightFit { stray_light, rest }
    }
}

impl DataTerm for WithStrayLight<'_> {
    fn operator(&self) -> &dyn LinearOperator {
        &self.operator
    }

    fn measurements(&self) -> &[f32] {
        &self.measurements
    }

    fn measurement_count(&self) -> usize {
        self.data.measurement_count - self.patterns.ncols()
    }

    fn scale(&self) -> f64 {
        self.data.scale()
    }

    fn min_rho(&self) -> f64 {
        self.data.min_rho()
    }

    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        self.x_step
            .solve(&self.operator, r, rho, TOLERANCE, y, gram_y)
    }

    fn residual_rms_of_bins(&self, residual: &[f32]) -> Vec<f64> {
        self.data.residual_rms_of_bins(residual)
    }

    fn restrict(&mut self, support: &Support) {
        self.data.system.set_support(support);
        let preconditioner = preconditioner(self.data, &self.subspace);
        self.x_step.restrict(support, preconditioner);
    }

    fn capabilities(&self) -> Capabilities<'_> {
        Capabilities {
            hints: self.data.capabilities().hints,
            fused_adjoint: None,
            cancel: Some(self.data.cancel()),
        }
    }
}

/// The preconditioner of a frame, without what lies in the subspace of the stray light.
fn preconditioner(data: &FrameData, subspace: &Arc<Subspace>) -> Box<dyn Preconditioner> {
    Box::new(Projected {
        inner: x_step::preconditioner(&data.system),
        subspace: Arc::clone(subspace),
    })
}

/// A preconditioner without what lies in a subspace.
struct Projected {
    inner: Box<dyn Preconditioner>,
    subspace: Arc<Subspace>,
}

impl Preconditioner for Projected {
    fn max_iterations(&self, is_restricted: bool, is_early: bool) -> usize {
        self.inner.max_iterations(is_restricted, is_early)
    }

    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        self.inner.apply(r, rho, out);
        self.subspace.remove(out);
    }
}
