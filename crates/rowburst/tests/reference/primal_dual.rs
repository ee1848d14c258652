//! A primal–dual method: neither the data term nor the prior is ever solved for.
//!
//! A. Chambolle, T. Pock, J. Math. Imaging Vis. 40, 120 (2011), Algorithm 1, with the data
//! and the differences as two blocks of the dual, each with its own step (Pock & Chambolle,
//! ICCV 2011):
//!
//! ```text
//! y ← (y + σ_A(b − A x̄))/(1 + σ_A)
//! p ← P_{τw}(p + σ_K K x̄)
//! x ← (x + s(Aᵀy − Kᵀp − τ w_1))₊,   x̄ = 2x − x₋,     s(σ_A‖A‖² + σ_K‖K‖²) ≤ 1
//! ```
//!
//! `y` tends to the residual, so `(y, p)` is the certificate's pair. The data's conjugate is
//! `½‖y‖² − ⟨b, y⟩` whatever the units, so `σ_A` is a number without one, and the rest follows
//! from the norms.

use super::certifier::{Certifier, residual};
use super::fista::MARGIN;
use super::run::{Iterate, Watch, begin, relative_change};
use super::{CertifiedSolution, Limits, Objective};
use rowburst::linop::{LinearOperator, operator_norm};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use std::ops::ControlFlow;

/// Parameters of [`solve`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PrimalDualParams {
    /// `σ_A`. A part of the video that `A` passes with the singular value `a` is found in
    /// about `2/σ_A` iterations where `a/‖A‖ > σ_A/2`, and slower below. `None`: 0.005 for
    /// `ℓ1` alone and 0.06 with differences, the best of 0.005, 0.02, 0.06 and 0.2 on a
    /// moving digit of 12×24×20 voxels.
    pub data_step: Option<f64>,
    /// From a start that is given, steps in which `p` is fitted to its residual.
    pub fit_steps: usize,
    /// When it stops.
    pub limits: Limits,
}

impl Default for PrimalDualParams {
    fn default() -> Self {
        Self {
            data_step: None,
            fit_steps: 200,
            limits: Limits::default(),
        }
    }
}

/// Minimises `objective` from the video `start` or else from darkness.
pub fn solve(
    objective: &Objective,
    start: Option<&[f32]>,
    params: &PrimalDualParams,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> CertifiedSolution {
    let (operator, k) = (objective.operator(), objective.differences());
    let power = (MARGIN * operator_norm(operator))
        .powi(2)
        .max(f64::MIN_POSITIVE);
    // Each block of the dual takes its part of the bound.
    let (blocks, usual) = match k.range_len() {
        0 => (1.0, 0.005),
        _ => (2.0, 0.06),
    };
    let data_step = params.data_step.unwrap_or(usual);
    let step = 1.0 / (blocks * data_step * power);
    let prior_step = 1.0 / (blocks * step * k.norm_squared_bound().max(1.0));
    let (mut video, mut light) = begin(objective, start);
    let (mut extrapolated, mut extrapolated_light) = (video.clone(), light.clone());
    let (mut y, mut p) = match start {
        None => (vec![0.0f32; light.len()], vec![0.0f32; k.range_len()]),
        Some(_) => {
            let y = residual(objective, &light);
            let p = Certifier::new(objective).fit_p(&y, params.fit_steps);
            (y, p)
        }
    };
    let (mut pull, mut hold) = (vec![0.0f32; video.len()], vec![0.0f32; video.len()]);
    let mut rise = vec![0.0f32; k.range_len()];
    let mut watch = Watch::new(objective, params.limits, observer);
    let l1_threshold = objective.l1_threshold() as f32;
    loop {
        for ((y, b), a) in y
            .iter_mut()
            .zip(objective.measurements())
            .zip(&extrapolated_light)
        {
            *y = (*y + data_step as f32 * (b - a)) / (1.0 + data_step as f32);
        }
        k.apply(&extrapolated, &mut rise);
        for (p, rise) in p.iter_mut().zip(&rise) {
            *p += prior_step as f32 * rise;
        }
        objective.project(&mut p);
        operator.adjoint(&y, &mut pull);
        k.adjoint(&p, &mut hold);
        let before = video.clone();
        for ((v, pull), hold) in video.iter_mut().zip(&pull).zip(&hold) {
            *v = (*v + step as f32 * (pull - hold - l1_threshold)).max(0.0);
        }
        for ((a, v), before) in extrapolated.iter_mut().zip(&video).zip(&before) {
            *a = 2.0 * v - before;
        }
        for (a, light) in extrapolated_light.iter_mut().zip(&light) {
            *a = -light;
        }
        operator.apply(&video, &mut light);
        for (a, light) in extrapolated_light.iter_mut().zip(&light) {
            *a += 2.0 * light;
        }
        let verdict = watch.see(&Iterate {
            change: relative_change(&video, &before),
            video: &video,
            light: &light,
            y: Some(&y),
            p: &p,
        });
        if let ControlFlow::Break(reason) = verdict {
            return watch.finish(video, reason);
        }
    }
}
