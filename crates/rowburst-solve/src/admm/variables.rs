//! The variables of ADMM, and the three steps of an iteration.

use crate::prox::Prox;
use crate::{DataTerm, write_adjoint};
use rowburst_core::linop::WRITE_PART_LEN;
use rowburst_core::vecmath::{distance_squared, norm_squared, simd, zeros};
use rowburst_core::{Cancel, Support};
use std::sync::atomic::{AtomicU64, Ordering};

/// `‖b − A z‖` over `‖b‖` above which a run has diverged; smaller takes the first iterations for that.
const DIVERGED_RESIDUAL: f64 = 2.0;

/// The variables of the iteration, named as in the head of [`super`], with their products with `A`.
///
/// `q = x̂ + u` is stored in place of the scaled dual `u` and of `x`. Before a dual step it is the point of the z-step;
/// after it `u = q − z`, since the dual step is `u ← u + x̂ − z`.
#[derive(Clone)]
pub(super) struct Variables {
    /// `z`, the video.
    pub z: Vec<f32>,
    /// `q = x̂ + u`.
    pub q: Vec<f32>,
    /// `A z`.
    pub az: Vec<f32>,
    /// `A q`.
    pub aq: Vec<f32>,
    /// `(A Aᵀ + ρI)⁻¹(b − A p)` of the last x-step: `ρy = b − A x`.
    pub y: Vec<f32>,
    /// `‖b − A x‖` of the last x-step; `None` before the first one of a frame.
    pub x_residual_norm: Option<f64>,
    /// Scratch buffer the size of a video.
    pub scratch: Vec<f32>,
    /// Elements of a part of the sums of an x-step.
    slot: usize,
}

impl Variables {
    /// All variables zero, for videos with `columns` columns.
    pub fn new(data: &dyn DataTerm, columns: usize) -> Self {
        let (n, m) = (data.operator().domain_len(), data.operator().range_len());
        Self {
            z: zeros(n),
            q: zeros(n),
            az: vec![0.0; m],
            aq: vec![0.0; m],
            y: vec![0.0; m],
            x_residual_norm: None,
            scratch: zeros(n),
            slot: columns.min(WRITE_PART_LEN),
        }
    }

    /// The x-step with over-relaxation `α`: `q ← x̂ + u` with `x̂ = αx + (1−α)z`, and `A q` to match.
    ///
    /// Outside `support` (`None`: every voxel) `x = p`. Returns `‖q − q'‖/‖z‖`, where `q'` is the old `q`; 1 where
    /// `z = 0` and `q` moved. `None`: the run is cancelled, and cannot continue from here. Then `q` and `z` are as they
    /// were, and `y = 0`, which bounds nothing.
    pub fn x_step(
        &mut self,
        data: &mut dyn DataTerm,
        rho: f64,
        relaxation: f64,
        support: Option<&Support>,
    ) -> Option<f64> {
        let alpha = relaxation as f32;
        // b − A p with p = z − u = 2z − q.
        let products = data.measurements().iter().zip(&self.az).zip(&self.aq);
        let rhs: Vec<f32> = products.map(|((b, az), aq)| b - az + (aq - az)).collect();
        let mut gram_y = vec![0.0f32; self.az.len()];
        let is_exact = data.solve_gram(&rhs, rho, &mut self.y, &mut gram_y);
        if data.capabilities().cancel.is_some_and(Cancel::is_cancelled) {
            self.y.fill(0.0);
            return None;
        }
        // For an exact step both norms agree. The first one contains the error of an inexact step, which grows as `ρ`
        // falls: the discrepancy rule would then lower `ρ` without end.
        let x_residual_norm = if is_exact {
            distance_squared(&rhs, &gram_y).sqrt()
        } else {
            rho * norm_squared(&self.y).sqrt()
        };
        self.x_residual_norm = Some(x_residual_norm);
        let (z, slot) = (&self.z, self.slot);
        // Each part has a slot of its own for its two sums, as two f32 in a u64. So the order of the threads does not
        // matter.
        let sums: Vec<AtomicU64> = (0..z.len().div_ceil(slot))
            .map(|_| AtomicU64::new(0))
            .collect();
        write_adjoint(data, &self.y, support, &mut self.q, &|start, x, q| {
            // `x` holds x − p here.
            let sum = relax(q, &z[start..start + x.len()], x, alpha);
            let [step_squared, z_squared] = sum.map(|sum| u64::from(sum.to_bits()));
            sums[start / slot].store(step_squared << 32 | z_squared, Ordering::Relaxed);
        });
        for ((aq, az), gram_y) in self.aq.iter_mut().zip(&self.az).zip(&gram_y) {
            *aq = az + (1.0 - alpha) * (*aq - az) + alpha * gram_y;
        }
        Some(relative_change(sums, alpha))
    }

    /// The z-step: `z = prox(q)` with the threshold `β`.
    pub fn z_step(&mut self, prior: &mut dyn Prox, beta: f64) {
        prior.prox(&self.q, beta, &mut self.z);
    }

    /// The dual step `u ← u + x̂ − z`.
    ///
    /// With `u = q − z` it changes no stored variable. What changes is `A u = A q − A z`: the iteration's product with
    /// `A`.
    pub fn dual_step(&mut self, data: &dyn DataTerm) {
        self.update_az(data);
    }

    /// Computes `A z` afresh.
    pub fn update_az(&mut self, data: &dyn DataTerm) {
        data.operator().apply(&self.z, &mut self.az);
    }

    /// Computes `A q` afresh.
    pub fn update_aq(&mut self, data: &dyn DataTerm) {
        data.operator().apply(&self.q, &mut self.aq);
    }

    /// Computes both products afresh.
    pub fn update_products(&mut self, data: &dyn DataTerm) {
        self.update_az(data);
        self.update_aq(data);
    }

    /// `b − A z`.
    pub fn residual(&self, data: &dyn DataTerm) -> Vec<f32> {
        let pairs = data.measurements().iter().zip(&self.az);
        pairs.map(|(b, a)| b - a).collect()
    }

    /// Whether the video explains the measurements far less well than no video, whose residual is `b`.
    pub fn have_diverged(&self, data: &dyn DataTerm) -> bool {
        let b = data.measurements();
        distance_squared(b, &self.az) > (DIVERGED_RESIDUAL * DIVERGED_RESIDUAL) * norm_squared(b)
    }

    /// Root mean square of `b − A z` over the measurements with a weight above zero.
    pub fn residual_rms(&self, data: &dyn DataTerm) -> f64 {
        (distance_squared(data.measurements(), &self.az) / data.measurement_count() as f64).sqrt()
    }
}

/// `α √(Σ (x − u)² / Σ z²)` from the sums of all parts, see [`relax`].
fn relative_change(sums: Vec<AtomicU64>, alpha: f32) -> f64 {
    let (mut step_squared, mut z_squared) = (0.0, 0.0);
    for sum in sums.into_iter().map(AtomicU64::into_inner) {
        let to_f64 = |half: u64| f64::from(f32::from_bits(half as u32));
        (step_squared, z_squared) = (step_squared + to_f64(sum >> 32), z_squared + to_f64(sum));
    }
    if step_squared == 0.0 {
        0.0
    } else if z_squared > 0.0 {
        f64::from(alpha) * (step_squared / z_squared).sqrt()
    } else {
        1.0
    }
}

/// Independent sums that [`relax`] adds up side by side, for vector instructions.
const LANES: usize = 16;

/// `q ← z + (1−α)u + αx`, where `u = q − z` has the old `q` and `x` holds `x − p`.
///
/// Returns `Σ (x − u)²` and `Σ z²`; `q` moved by `α (x − u)`.
fn relax(q: &mut [f32], z: &[f32], x: &[f32], alpha: f32) -> [f32; 2] {
    simd(
        #[inline(always)]
        || {
            let mut sums = [[0.0f32; LANES]; 2];
            let (q, q_rest) = q.as_chunks_mut::<LANES>();
            let (z, z_rest) = z.as_chunks::<LANES>();
            let (x, x_rest) = x.as_chunks::<LANES>();
            for ((q, z), x) in q.iter_mut().zip(z).zip(x) {
                relax_part(q, z, x, alpha, &mut sums);
            }
            // A part is seldom a multiple of 16 elements long: the rest takes vectors of four.
            let (q, q_rest) = q_rest.as_chunks_mut::<4>();
            let (z, z_rest) = z_rest.as_chunks::<4>();
            let (x, x_rest) = x_rest.as_chunks::<4>();
            for ((q, z), x) in q.iter_mut().zip(z).zip(x) {
                relax_part(q, z, x, alpha, &mut sums);
            }
            relax_part(q_rest, z_rest, x_rest, alpha, &mut sums);
            for sum in &mut sums {
                for half in [8, 4, 2, 1] {
                    for i in 0..half {
                        sum[i] += sum[i + half];
                    }
                }
            }
            [sums[0][0], sums[1][0]]
        },
    )
}

/// [`relax`] of at most [`LANES`] elements.
#[inline(always)]
fn relax_part(q: &mut [f32], z: &[f32], x: &[f32], alpha: f32, sums: &mut [[f32; LANES]; 2]) {
    let (z, x) = (&z[..q.len()], &x[..q.len()]);
    for i in 0..q.len() {
        let u = q[i] - z[i];
        sums[0][i] += (x[i] - u) * (x[i] - u);
        sums[1][i] += z[i] * z[i];
        q[i] = z[i] + (1.0 - alpha) * u + alpha * x[i];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relaxation_moves_q_by_the_step() {
        let n = 37;
        let value = |seed: usize| (0..n).map(move |i| ((seed * i + 3) % 11) as f32 / 11.0);
        let (q, z, x): (Vec<f32>, Vec<f32>, Vec<f32>) =
            (value(2).collect(), value(5).collect(), value(7).collect());
        let mut relaxed = q.clone();
        let [step_squared, z_squared] = relax(&mut relaxed, &z, &x, 1.7);
        let (mut steps, mut squares) = (0.0, 0.0);
        for i in 0..n {
            // `x` holds x − p with p = z − u.
            let u = q[i] - z[i];
            let x_hat = 1.7 * (x[i] + z[i] - u) - 0.7 * z[i];
            assert!((relaxed[i] - (x_hat + u)).abs() < 1e-5);
            steps += ((relaxed[i] - q[i]) / 1.7).powi(2);
            squares += z[i] * z[i];
        }
        assert!((step_squared - steps).abs() < 1e-4 * steps);
        assert!((z_squared - squares).abs() < 1e-4 * squares);
    }
}
