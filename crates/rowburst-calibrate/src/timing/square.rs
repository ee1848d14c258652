//! The exposure from the edges of a square wave.
//!
//! A square wave that is on for the part `d` of its period, integrated over an exposure
//! of the part `e` of it, is a trapezoid: `|c_h| ∝ |sin πhd · sin πhe| / h²`. The two enter alike:
//! `(d, e)`, `(e, d)`, `(1 − d, 1 − e)` and `(1 − e, 1 − d)` give one and the same frame.
//! Where the duty is not given, that one is taken for it which is near a half, and the
//! exposure is taken to be shorter than half a period.

use super::fit::{Basis, Optimum, linear, minimise};
use super::periodic::PeriodicFit;
use super::waveform::square_exposed;

/// A trapezoid that fits.
pub(super) struct SquareFit {
    /// Exposure in periods and its standard error; `None` where it cannot be told from
    /// the time of light.
    pub exposure: Option<(f64, f64)>,
    /// Part of the period in which the light is on.
    pub duty: f64,
    pub rss: f64,
    /// Values less parameters.
    pub dof: f64,
}

/// A duty this near to a half is one: drivers are no more exact, and longer or shorter
/// pulses are chosen on purpose and known.
const NEAR_HALF: f64 = 0.05;

/// Fits a trapezoid of the period that `free` found; `duty` where it is known.
pub(super) fn fit(
    frames: &[Vec<f64>],
    k: &[usize],
    free: &PeriodicFit,
    duty: Option<f64>,
) -> Option<SquareFit> {
    // θ: cycles per row, exposure, phase of each frame, and the duty where it is free.
    let of_frame = |theta: &[f64], f: usize| {
        let on = duty.unwrap_or_else(|| within(theta[2 + frames.len()]));
        let exposure = within(theta[1]);
        let lit = |(&k, g): (&usize, &f64)| {
            g * square_exposed(theta[0] * k as f64 + theta[2 + f], exposure, on)
        };
        let lit = k.iter().zip(&free.gain[f]).map(lit).collect();
        let basis: Basis = std::iter::once(lit)
            .chain(free.profile.iter().cloned())
            .collect();
        linear(&basis, &frames[f])
    };
    let residual = |theta: &[f64]| -> Vec<f64> {
        (0..frames.len())
            .flat_map(|f| of_frame(theta, f).residual)
            .collect()
    };
    let on = duty.unwrap_or(0.5);
    let mut best: Option<Optimum> = None;
    for start in [0.03, 0.12, 0.3, 0.45, 0.7, 0.9] {
        let mut theta = vec![free.cycles_per_row, start];
        // The maximum of the fundamental lies in the middle of the trapezoid.
        theta.extend((0..frames.len()).map(|f| free.phase(f) + 0.5 * (on + start)));
        theta.extend(duty.is_none().then_some(on));
        // Small against the part of a period that a row shows.
        let mut steps = vec![1e-5; theta.len()];
        steps[0] /= k.len() as f64;
        let found = minimise(&theta, &steps, &residual);
        let brighter = (0..frames.len()).all(|f| of_frame(&found.theta, f).weights[0] > 0.0);
        if brighter && best.as_ref().is_none_or(|b| found.rss < b.rss) {
            best = Some(found);
        }
    }
    let best = best?;
    let parameter_count = (1 + 2 * free.profile.len()) * frames.len() + best.theta.len();
    let dof = (frames.len() * k.len()) as f64 - parameter_count as f64;
    let (errors, _) = best.errors(dof, k.len());
    let near_half = |part: f64| (part - 0.5).abs() < NEAR_HALF;
    let exposure = (within(best.theta[1]), errors[1]);
    let shorter = |(part, error): (f64, f64)| (part.min(1.0 - part), error);
    let (exposure, duty) = match duty {
        Some(duty) if near_half(duty) => (Some(shorter(exposure)), duty),
        Some(duty) => (Some(exposure), duty),
        None => {
            let on = (
                within(best.theta[2 + frames.len()]),
                errors[2 + frames.len()],
            );
            if near_half(on.0) {
                (Some(shorter(exposure)), on.0)
            } else if near_half(exposure.0) {
                (Some(shorter(on)), exposure.0)
            } else {
                (None, on.0)
            }
        }
    };
    Some(SquareFit {
        exposure,
        duty,
        rss: best.rss,
        dof,
    })
}

/// Into a period, and not to nothing.
fn within(part: f64) -> f64 {
    part.rem_euclid(1.0).clamp(1e-6, 1.0 - 1e-6)
}
