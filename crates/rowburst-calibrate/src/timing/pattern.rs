//! A still scene under the stripes, which frames of several phases show.
//!
//! Each row's own brightness `p[r]` is common to all frames: with the stripes `M_f[r]` of a fit,
//! `p[r] = Σ_f y_f[r] M_f[r] / Σ_f M_f[r]²` by least squares.

use super::periodic::{self, PeriodicFit};
use std::f64::consts::TAU;

/// With two frames a row's brightness would take half of what they say of the stripes.
pub(super) const MIN_FRAMES: usize = 3;
/// Mean length of the phases' arrows, 1 for equal ones: above this the frames show the same stripes, and scene
/// and stripes cannot be told apart.
const MAX_PHASE_CONCENTRATION: f64 = 0.75;

/// Whether the frames of `fit` are many enough and of different phases.
pub(super) fn is_identifiable(fit: &PeriodicFit) -> bool {
    let frames = fit.model.len();
    let (mut x, mut y) = (0.0, 0.0);
    for f in 0..frames {
        let (sin, cos) = (TAU * fit.phase(f)).sin_cos();
        x += cos;
        y += sin;
    }
    frames >= MIN_FRAMES && f64::hypot(x, y) < MAX_PHASE_CONCENTRATION * frames as f64
}

/// Each row over its mean over the frames.
pub(super) fn divide_by_mean(frames: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let rows = 0..frames[0].len();
    let mean: Vec<f64> = rows
        .map(|r| frames.iter().map(|y| y[r]).sum::<f64>() / frames.len() as f64)
        .collect();
    let dark = 1e-3;
    let over = |y: &Vec<f64>| y.iter().zip(&mean).map(|(y, m)| y / m.max(dark)).collect();
    frames.iter().map(over).collect()
}

/// The frames without the rows' own brightness, and the fit of them.
pub(super) fn fit_without_scene(
    frames: &[Vec<f64>],
    k: &[usize],
    fit: &PeriodicFit,
) -> (Vec<Vec<f64>>, PeriodicFit) {
    let mut found = fit.clone();
    // What the still scene hid may be seen now.
    let harmonics = 2 * fit.harmonics[0].len();
    let mut cleaned = frames.to_vec();
    for _ in 0..2 {
        for r in 0..k.len() {
            let of = |a: &[Vec<f64>]| -> f64 {
                a.iter().zip(&found.model).map(|(a, m)| a[r] * m[r]).sum()
            };
            let brightness = of(&cleaned) / of(&found.model).max(f64::MIN_POSITIVE);
            // A row that is dark in all frames has no brightness of its own.
            let brightness = brightness.clamp(0.1, 10.0);
            cleaned.iter_mut().for_each(|y| y[r] /= brightness);
        }
        found = periodic::fit(&cleaned, k, found.cycles_per_row, harmonics);
    }
    let count = frames.len() as f64;
    found.dof -= k.len() as f64;
    found.scene_inflation = count / (count - 1.0);
    (cleaned, found)
}
