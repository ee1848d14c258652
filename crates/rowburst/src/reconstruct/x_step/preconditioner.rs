//! Preconditioners of the conjugate gradients: the mean field of the operator.

use rowburst_core::Support;
use rowburst_core::linop::Background;
use rowburst_core::vecmath::{dot, norm_squared};
use rowburst_optics::RollingShutter;
use rowburst_optics::forward::mean_field::{MeanField, MeanFieldSolver};
use rowburst_solve::conjugate_gradient::Preconditioner;
use std::sync::Arc;

/// Residual on unused pixels, relative to that of the first solve, at which they count as left out; larger takes more
/// products with the operator (docs/design/025).
const UNUSED_TOLERANCE: f64 = 0.01;

/// Most solves to leave out unused pixels; a caption over 3 % of the pixels takes at most 20.
const MAX_UNUSED_SOLVES: usize = 50;

/// Solves with the mean field `M + ρI` along the rows on the used pixels; unused pixels are coupled to no others.
///
/// The mean field knows no single pixels: its solve `z = (M + ρI)⁻¹ r` is that of a frame whose unused pixels are measured,
/// with the value 0. Values `c` on unused pixels with `z − (M + ρI)⁻¹ c = 0` there take that back: then the rest is the solve on
/// the used pixels alone (Schur complement). Conjugate gradients on the unused pixels find `c`.
pub struct MeanFieldPreconditioner {
    solver: MeanFieldSolver,
    /// Pixels with weight 0.
    unused: Vec<usize>,
}

impl MeanFieldPreconditioner {
    /// For videos on `support` with this background, and for the weights of the frame's pixels.
    pub fn new(
        mean_field: Arc<MeanField>,
        shutter: &RollingShutter,
        background: Background,
        support: Option<&Support>,
        weights: Option<&[f32]>,
    ) -> Self {
        let (rows, columns) = shutter.frame_shape();
        let row_weights = match weights {
            None => vec![1.0; rows],
            Some(weights) => weights.chunks_exact(columns).map(row_weight).collect(),
        };
        let mut fractions = match support {
            Some(support) => support.fractions(),
            None => vec![1.0; shutter.video_shape().bins],
        };
        // A static background would couple all rows, which helps little (docs/design/025).
        if background == Background::PerBin {
            fractions.iter_mut().for_each(|f| *f += 1.0);
        }
        let is_unused = |i: &usize| weights.is_some_and(|weights| weights[*i] == 0.0);
        Self {
            solver: MeanFieldSolver::new(mean_field, shutter, &fractions, &row_weights),
            unused: (0..rows * columns).filter(is_unused).collect(),
        }
    }

    /// Leaves out unused pixels: from the solve `out` of a frame that is 0 on them to that on the used pixels alone.
    fn leave_out(&mut self, rho: f64, out: &mut [f32]) {
        let on_unused =
            |frame: &[f32]| -> Vec<f32> { self.unused.iter().map(|&i| frame[i]).collect() };
        let mut residual = on_unused(out);
        let mut direction = residual.clone();
        let mut norm = norm_squared(&residual);
        let limit = norm * UNUSED_TOLERANCE.powi(2);
        let mut frame = vec![0.0; out.len()];
        let mut product = vec![0.0; out.len()];
        for _ in 0..MAX_UNUSED_SOLVES {
            if norm <= limit {
                break;
            }
            for (&i, d) in self.unused.iter().zip(&direction) {
                frame[i] = *d;
            }
            self.solver.solve(&frame, rho, &mut product);
            let step = (norm / dot(&on_unused(&product), &direction)) as f32;
            out.iter_mut()
                .zip(&product)
                .for_each(|(o, p)| *o -= step * p);
            residual = on_unused(out);
            let next = norm_squared(&residual);
            let beta = (next / norm) as f32;
            norm = next;
            for (d, r) in direction.iter_mut().zip(&residual) {
                *d = r + beta * *d;
            }
        }
    }
}

/// Root mean square of the weights of a row's used pixels; 0 without one.
fn row_weight(row: &[f32]) -> f64 {
    let used = row.iter().filter(|w| **w != 0.0).count().max(1);
    f64::from((row.iter().map(|w| w * w).sum::<f32>() / used as f32).sqrt())
}

impl Preconditioner for MeanFieldPreconditioner {
    fn max_iterations(&self, is_restricted: bool, is_early: bool) -> usize {
        // Runs that judge pixels and priors hold some of them out, and need better steps (docs/design/025).
        let is_coarse = is_early && self.unused.is_empty();
        match (is_restricted, is_coarse) {
            // Inexact steps on a support leave bins without light, which are then taken for underfit.
            (true, _) => 40,
            // The first iterations find shapes, for which a coarse step will do.
            (false, true) => 2,
            (false, false) => 6,
        }
    }

    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        if self.unused.is_empty() {
            return self.solver.solve(r, rho, out);
        }
        let mut used = r.to_vec();
        self.unused.iter().for_each(|&i| used[i] = 0.0);
        self.solver.solve(&used, rho, out);
        self.leave_out(rho, out);
        for &i in &self.unused {
            out[i] = r[i] / rho as f32;
        }
    }
}

/// Divides in Fourier space where the operator convolves whole planes, else divides by a constant.
pub struct PlanePreconditioner {
    pub shutter: Arc<RollingShutter>,
    /// Typical size of a diagonal element of `A Aᵀ`.
    pub scale: f64,
}

impl Preconditioner for PlanePreconditioner {
    fn max_iterations(&self, _is_restricted: bool, _is_early: bool) -> usize {
        // Fewer cost quality, more cost time (docs/design/004).
        40
    }

    fn apply(&mut self, r: &[f32], rho: f64, out: &mut [f32]) {
        match self.shutter.circulant_inverse(r, rho) {
            Some(inverse) => out.copy_from_slice(&inverse),
            None => out
                .iter_mut()
                .zip(r)
                .for_each(|(o, r)| *o = r / (self.scale + rho) as f32),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::linalg::solvers::Solve;
    use faer::{Col, Mat, Side};
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Camera, Image, Psf, Sensor, Shutter};

    /// A lone pixel, a part of a row, whole rows and a block are left out as if the mean field had no such rows and columns.
    #[test]
    fn unused_pixels_are_left_out_of_the_mean_field() {
        let (rows, columns) = (12, 20);
        let camera = Camera::new(CameraParams {
            rows,
            columns,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 30.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let psf = Psf::new(Image::from_fn(23, 39, |y, x| {
            (1 + (7 * y * y + 13 * x + 3 * x * y) % 17) as f32
        }))
        .unwrap();
        let shutter = RollingShutter::new(&camera, &psf);
        let field = Arc::new(MeanField::new(&shutter));
        let size = rows * columns;
        let new = |weights: Option<&[f32]>| {
            let field = Arc::clone(&field);
            MeanFieldPreconditioner::new(field, &shutter, Background::None, None, weights)
        };
        let rho = 0.3 * shutter.pixel_power(rows / 4, columns / 4);
        let mut whole = new(None);
        let inverse_columns: Vec<Vec<f32>> = (0..size)
            .map(|i| {
                let (mut unit, mut out) = (vec![0.0; size], vec![f32::NAN; size]);
                unit[i] = 1.0;
                whole.apply(&unit, rho, &mut out);
                out
            })
            .collect();
        let inverse = Mat::<f64>::from_fn(size, size, |i, j| f64::from(inverse_columns[j][i]));
        let all = inverse
            .llt(Side::Lower)
            .unwrap()
            .solve(Mat::<f64>::identity(size, size));
        let is_unused = |i: usize| {
            let (y, x) = (i / columns, i % columns);
            i == 25 || (y == 4 && x < 9) || y == 7 || ((9..12).contains(&y) && (5..16).contains(&x))
        };
        let weights: Vec<f32> = (0..size).map(|i| f32::from(!is_unused(i))).collect();
        let used: Vec<usize> = (0..size).filter(|&i| !is_unused(i)).collect();
        let r: Vec<f32> = (0..size).map(|i| (i as f32 * 1.7).sin() + 0.2).collect();
        let part = Mat::<f64>::from_fn(used.len(), used.len(), |i, j| all[(used[i], used[j])]);
        let right = Col::<f64>::from_fn(used.len(), |i| f64::from(r[used[i]]));
        let expected = part.llt(Side::Lower).unwrap().solve(&right);
        let mut out = vec![f32::NAN; size];
        new(Some(&weights)).apply(&r, rho, &mut out);
        let errors = used.iter().enumerate();
        let error: f64 = errors
            .map(|(k, &i)| (f64::from(out[i]) - expected[k]).powi(2))
            .sum();
        let relative = error.sqrt() / expected.norm_l2();
        assert!(relative < 0.01, "relative error {relative}");
        for i in (0..size).filter(|&i| is_unused(i)) {
            assert_eq!(out[i], r[i] / rho as f32);
        }
        // Without leaving them out the error is large.
        let mut taken: Vec<f32> = r.iter().zip(&weights).map(|(r, w)| r * w).collect();
        whole.apply(&taken.clone(), rho, &mut taken);
        let errors = used.iter().enumerate();
        let error: f64 = errors
            .map(|(k, &i)| (f64::from(taken[i]) - expected[k]).powi(2))
            .sum();
        assert!(error.sqrt() > 0.05 * expected.norm_l2());
    }
}
