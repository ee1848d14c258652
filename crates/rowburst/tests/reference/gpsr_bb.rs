//! GPSR-BB: gradient projection with Barzilai–Borwein steps, for `ℓ1` alone.
//!
//! M. A. T. Figueiredo, R. D. Nowak, S. J. Wright, IEEE J. Sel. Top. Signal Process. 1,
//! 586 (2007), Sect. III-B, the solver that the paper names. With `v ≥ 0` the split into positive
//! and negative parts falls away, and the problem is a quadratic one with bounds:
//!
//! ```text
//! min_{v≥0} ½‖b − A v‖² + τ w_1 Σ v,      g = Aᵀ(A v − b) + τ w_1
//! d = (v − α g)₊ − v,   v ← v + λ d,   α ← ‖d‖²/‖A d‖²
//! ```

use super::run::{Iterate, Watch, begin, relative_change};
use super::{CertifiedSolution, Limits, Objective};
use rowburst::linop::operator_norm;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst::vecmath::{dot, norm_squared};
use std::ops::ControlFlow;

/// How far a step goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Descent {
    /// To the minimum along `d`: the objective never rises.
    Monotone,
    /// All of `d`, as Barzilai and Borwein: often faster, with rises in between.
    Whole,
}

/// Parameters of [`solve`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GpsrParams {
    /// How far a step goes.
    pub descent: Descent,
    /// `α` stays between these over `1/‖A‖²`. The authors' bounds are 10⁻³⁰ and 10³⁰;
    /// these keep an unlucky step from leaving f32.
    pub step_bounds: (f64, f64),
    /// When it stops.
    pub limits: Limits,
}

impl Default for GpsrParams {
    fn default() -> Self {
        Self {
            descent: Descent::Monotone,
            step_bounds: (1e-3, 1e9),
            limits: Limits::default(),
        }
    }
}

/// Minimises an objective with `ℓ1` alone, from the video `start` or else from darkness.
///
/// # Panics
/// If the objective has total variation or temporal differences.
pub fn solve(
    objective: &Objective,
    start: Option<&[f32]>,
    params: &GpsrParams,
    observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
) -> CertifiedSolution {
    let weights = objective.weights();
    assert!(
        weights.space == 0.0 && weights.time == 0.0,
        "this solver minimises with l1 alone"
    );
    let operator = objective.operator();
    let unit = 1.0 / operator_norm(operator).powi(2).max(f64::MIN_POSITIVE);
    let (shortest, longest) = (params.step_bounds.0 * unit, params.step_bounds.1 * unit);
    let l1_threshold = objective.l1_threshold() as f32;
    let (n, m) = (operator.domain_len(), operator.range_len());
    let (mut video, mut light) = begin(objective, start);
    let (mut gradient, mut direction, mut change) =
        (vec![0.0f32; n], vec![0.0f32; n], vec![0.0; m]);
    let mut watch = Watch::new(objective, params.limits, observer);
    let mut alpha = unit;
    loop {
        let misfit: Vec<f32> = light
            .iter()
            .zip(objective.measurements())
            .map(|(a, b)| a - b)
            .collect();
        operator.adjoint(&misfit, &mut gradient);
        gradient.iter_mut().for_each(|g| *g += l1_threshold);
        for ((d, v), g) in direction.iter_mut().zip(&video).zip(&gradient) {
            *d = (v - alpha as f32 * g).max(0.0) - v;
        }
        operator.apply(&direction, &mut change);
        let (slope, curvature) = (dot(&gradient, &direction), norm_squared(&change));
        let lambda = match params.descent {
            Descent::Whole => 1.0,
            Descent::Monotone if curvature > 0.0 => (-slope / curvature).clamp(0.0, 1.0),
            Descent::Monotone => 1.0,
        };
        alpha = if curvature > 0.0 {
            (norm_squared(&direction) / curvature).clamp(shortest, longest)
        } else {
            longest
        };
        let before = video.clone();
        for (v, d) in video.iter_mut().zip(&direction) {
            *v = (*v + lambda as f32 * d).max(0.0);
        }
        // A sum of steps in f32 drifts; so does v, by the same rounding. Afresh now and then.
        if watch.iterations().is_multiple_of(50) {
            operator.apply(&video, &mut light);
        } else {
            for (a, c) in light.iter_mut().zip(&change) {
                *a += lambda as f32 * c;
            }
        }
        let verdict = watch.see(&Iterate {
            change: relative_change(&video, &before),
            video: &video,
            light: &light,
            y: None,
            p: &[],
        });
        if let ControlFlow::Break(reason) = verdict {
            return watch.finish(video, reason);
        }
    }
}
