//! The variables of an ADMM iteration, and its steps.

use super::support_estimator::SupportEstimator;
use super::{AdmmParams, Solution, TauRule};
use crate::Shape;
use crate::linop::WRITE_PART_LEN;
use crate::prox::Prox;
use crate::solve::{Certificate, DataTerm, StopReason};
use crate::vecmath::{distance_squared, dot, norm_squared, simd};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Corrections of `ρ` inside this interval are skipped; wider saves factors, `τ` is less exact (docs/design/006).
const RHO_DEADBAND: (f64, f64) = (0.98, 1.02);
/// Deadband of `ρ` up to the first support update; wider saves factors, `ρ` settles later (docs/design/006).
const WARM_UP_RHO_DEADBAND: (f64, f64) = (0.8, 1.25);
/// [`RHO_DEADBAND`] for large blocks, whose factors cost several iterations; wider saves time (docs/design/008).
const LARGE_RHO_DEADBAND: (f64, f64) = (0.95, 1.05);
/// Deadband for large blocks up to the first support update and while a bin is unrestricted; wider saves time, `ρ`
/// settles later (docs/design/008).
const LARGE_UNRESTRICTED_RHO_DEADBAND: (f64, f64) = (0.6, 1.6);
/// First iteration that corrects `ρ` while such a bin is unrestricted; smaller follows residuals that have not settled
/// (docs/design/008).
const LARGE_UNRESTRICTED_RHO_FROM: usize = 20;
/// Iterations between corrections of `ρ` in that case; larger saves factors, `ρ` settles later (docs/design/008).
const LARGE_UNRESTRICTED_RHO_INTERVAL: usize = 5;
/// Iteration up to which `β` follows the brightness; larger delays the first certificate (docs/design/006).
const THRESHOLD_SETTLES: usize = 40;
/// Voxels per measurement above which the first support update waits; smaller makes more runs wait (docs/design/008).
const UNDERSAMPLED: usize = 300;
/// Relative fall of a bin's brightness that ends the wait; smaller ends it too early (docs/design/008).
const DECLINE: f64 = 0.005;
/// Iterations over which that fall is measured, and by which the schedule pauses (docs/design/008).
const DECLINE_WINDOW: usize = 5;
/// Iteration at which the wait ends at the latest; smaller may leave bins without light (docs/design/008).
const LATEST_FIRST_UPDATE: usize = 150;
/// `β` at first over its end; larger finds shapes faster and may lose faint points (docs/design/006).
const CONTINUATION_FACTOR: f64 = 4.0;
/// Iteration at which `β` reaches its end; later is faster for large shapes but less robust (docs/design/006).
const CONTINUATION_END: usize = 20;
/// Brightness of the scene over that of the first data step, which spreads sparse light; larger gives a larger `β`.
const INITIAL_BRIGHTNESS_RATIO: f64 = 10.0;
/// Iterations between updates of the noise weights; smaller costs more rebuilt blocks (docs/design/010).
const WEIGHT_UPDATE_INTERVAL: usize = 20;
/// Iteration after which the weights are updated a fifth as often; larger costs more rebuilt blocks
/// (docs/design/010).
const FREQUENT_UPDATES_UNTIL: usize = 100;
/// `df` is counted after this iteration; earlier counts a video that is active everywhere (docs/design/005).
const DEGREES_OF_FREEDOM_AFTER: usize = 15;
/// Largest part of the measurements that `df` may take; larger lets a fit follow the noise (docs/design/005).
pub(crate) const MAX_FREEDOM: f64 = 0.3;
/// `ρ` at first over a typical diagonal element; far from its end costs more factors (docs/design/006).
const INITIAL_RHO: f64 = 0.01;
/// The same for large blocks, nearer to the end since their factors cost more (docs/design/008).
const LARGE_INITIAL_RHO: f64 = 0.0015;
/// Smallest `ρ` on a support over `ρ` before; smaller lets the dual grow without end (docs/design/007).
const MIN_RHO_RATIO: f64 = 0.3;
/// The same for large blocks, whose `ρ` is farther from its end then (docs/design/008).
const LARGE_MIN_RHO_RATIO: f64 = 0.1;
/// Brightest voxel that the certificate admits over the brightest found; larger loosens the bound (docs/design/009).
const BRIGHTNESS_BOUND: f64 = 2.0;
/// Iterations credited to a warm start; smaller repeats more of the warm-up (docs/design/014).
const WARM_START_CREDIT: usize = 26;

/// The variables of the iteration, named as in the head of [`super`], and all that adapts between iterations.
pub(super) struct State {
    shape: Shape,
    /// Scratch buffer the size of a video.
    scratch: Vec<f32>,
    /// The video.
    z: Vec<f32>,
    /// The point with `z = prox(q)`; the scaled dual is `u = q − z`.
    q: Vec<f32>,
    /// `A z`.
    az: Vec<f32>,
    /// `A q`.
    aq: Vec<f32>,
    /// `(A Aᵀ + ρI)⁻¹(b − A p)` of the last data step: `ρ y = b − A x`.
    y: Vec<f32>,
    rho: f64,
    /// Lower bound of `ρ` under the discrepancy rule; it only rises.
    rho_floor: f64,
    /// See [`DataTerm::min_rho`].
    stable_rho: f64,
    beta: f64,
    /// Brightness of each bin at the last call of [`Self::brightness_is_rising`]; 0 once it has declined.
    rising_brightness: Vec<f64>,
    rule: TauRule,
    /// See [`AdmmParams::threshold`].
    relative_threshold: f64,
    /// Bound of `‖b − A v‖` under the discrepancy rule.
    bound: f64,
    /// `‖b − A x‖` of the last data step.
    x_residual_norm: f64,
    /// Whether the last update left `ρ` unchanged.
    rho_is_unchanged: bool,
    pub iterations: usize,
    /// Iterations that the schedule counts as done at the start of the run.
    warm_start_credit: usize,
    /// Iterations that the schedule does not count, since the video was still taking shape.
    paused_iterations: usize,
    support_estimator: SupportEstimator,
}

impl State {
    pub fn new(data: &dyn DataTerm, shape: Shape, params: &AdmmParams) -> Self {
        let (n, m) = (data.operator().domain_len(), data.operator().range_len());
        assert!(
            n >= shape.voxels(),
            "the operator takes videos of this shape"
        );
        let first_rho = if data.has_large_blocks() {
            LARGE_INITIAL_RHO
        } else {
            INITIAL_RHO
        };
        let mut state = Self {
            shape,
            scratch: vec![0.0; n],
            z: vec![0.0; n],
            q: vec![0.0; n],
            az: vec![0.0; m],
            aq: vec![0.0; m],
            y: vec![0.0; m],
            rho: first_rho * data.scale(),
            rho_floor: (1e-7 * data.scale()).max(data.min_rho()),
            stable_rho: data.min_rho(),
            beta: 0.0,
            rising_brightness: vec![f64::MIN_POSITIVE; shape.bins],
            rule: params.tau,
            relative_threshold: params.threshold,
            bound: 0.0,
            x_residual_norm: 0.0,
            rho_is_unchanged: false,
            iterations: 0,
            warm_start_credit: 0,
            paused_iterations: 0,
            support_estimator: SupportEstimator::new(shape, data.max_restricted_voxels()),
        };
        state.set_tau_rule(params.tau, data);
        state
    }

    /// Sets how `τ` is found from now on.
    pub fn set_tau_rule(&mut self, rule: TauRule, data: &dyn DataTerm) {
        self.rule = rule;
        self.rho_is_unchanged = false;
        match rule {
            TauRule::Discrepancy { sigma } => {
                self.bound = sigma * (data.measurement_count() as f64).sqrt();
            }
            TauRule::Fixed(tau) if self.beta > 0.0 => self.set_rho_for_tau(tau),
            TauRule::Fixed(_) => {}
        }
    }

    /// Continues with the measurements of another frame, whose scene has changed little.
    pub fn warm_start(&mut self, data: &dyn DataTerm) {
        let iterations_past_credit = self.schedule_iteration().saturating_sub(WARM_START_CREDIT);
        // The next support update comes when it would have come without a new frame.
        self.warm_start_credit = self.schedule_iteration().min(WARM_START_CREDIT)
            + iterations_past_credit % SupportEstimator::UPDATE_INTERVAL;
        self.iterations = 0;
        self.paused_iterations = 0;
        self.support_estimator.reset();
        self.change_weights(data);
    }

    /// Brings all that depends on the weights of the measurements up to date: `A` contains them.
    fn change_weights(&mut self, data: &dyn DataTerm) {
        self.set_tau_rule(self.rule, data);
        data.operator().apply(&self.z, &mut self.az);
        data.operator().apply(&self.q, &mut self.aq);
    }

    /// The iteration that the schedule counts: plus a warm start's credit, minus pauses.
    fn schedule_iteration(&self) -> usize {
        self.warm_start_credit + self.iterations - self.paused_iterations
    }

    /// Whether the schedule has not passed the first support update.
    pub fn is_warming_up(&self) -> bool {
        self.schedule_iteration() <= SupportEstimator::FIRST_UPDATE
    }

    /// The video, `[t, y, x]`.
    pub fn video(&self) -> &[f32] {
        &self.z
    }

    /// `A v` of the video.
    pub fn fitted(&self) -> &[f32] {
        &self.az
    }

    /// Part of the voxels that are active, from 0 to 1.
    pub fn support_fraction(&self) -> f64 {
        self.support_estimator.fraction()
    }

    /// Whether `β`, `τ` and the support have settled.
    pub fn is_settled(&self, params: &AdmmParams) -> bool {
        self.schedule_iteration() > THRESHOLD_SETTLES
            && self.rho_is_unchanged
            && (!params.support || self.support_estimator.is_stable())
    }

    pub fn tau(&self) -> f64 {
        match self.rule {
            TauRule::Fixed(tau) => tau,
            TauRule::Discrepancy { .. } => self.rho * self.beta,
        }
    }

    /// `q ← x̂ + u` with `x̂ = αx + (1−α)z`, and `A q` to match.
    ///
    /// Returns `‖q − q'‖/‖z‖`, where `q'` is the old `q`; 1 where `z = 0` and `q` moved.
    pub fn data_step(&mut self, data: &mut dyn DataTerm, params: &AdmmParams) -> f64 {
        let alpha = params.relaxation as f32;
        let m = self.az.len();
        // b − A p with p = z − u = 2z − q.
        let products = data.measurements().iter().zip(&self.az).zip(&self.aq);
        let rhs: Vec<f32> = products.map(|((b, az), aq)| b - az + (aq - az)).collect();
        let mut gram_y = vec![0.0f32; m];
        let is_exact = data.solve_gram(&rhs, self.rho, &mut self.y, &mut gram_y);
        // Both are the same for an exact step. The error of an inexact one is larger for a smaller `ρ`, which it would
        // drive to nothing.
        self.x_residual_norm = if is_exact {
            distance_squared(&rhs, &gram_y).sqrt()
        } else {
            self.rho * norm_squared(&self.y).sqrt()
        };
        let z = &self.z;
        let slot = self.shape.columns.min(WRITE_PART_LEN);
        // Each part has a slot of its own for its two sums, as two f32 in a u64. So the order of the threads does not
        // matter.
        let sums: Vec<AtomicU64> = (0..z.len().div_ceil(slot))
            .map(|_| AtomicU64::new(0))
            .collect();
        data.adjoint_each(
            &self.y,
            self.support_estimator.data_support(),
            &mut self.q,
            &|start, x, q| {
                // `x` holds x − p here.
                let sum = relax(q, &z[start..start + x.len()], x, alpha);
                let [step_squared, z_squared] = sum.map(|sum| u64::from(sum.to_bits()));
                sums[start / slot].store(step_squared << 32 | z_squared, Ordering::Relaxed);
            },
        );
        for ((aq, az), gram_y) in self.aq.iter_mut().zip(&self.az).zip(&gram_y) {
            *aq = az + (1.0 - alpha) * (*aq - az) + alpha * gram_y;
        }
        let (mut step_squared, mut z_squared) = (0.0, 0.0);
        for sum in sums.into_iter().map(AtomicU64::into_inner) {
            let to_f64 = |half: u64| f64::from(f32::from_bits(half as u32));
            (step_squared, z_squared) = (step_squared + to_f64(sum >> 32), z_squared + to_f64(sum));
        }
        if step_squared == 0.0 {
            return 0.0;
        }
        if z_squared > 0.0 {
            f64::from(alpha) * (step_squared / z_squared).sqrt()
        } else {
            1.0
        }
    }

    /// Forgets the solution of a data step that was cancelled; it bounds nothing.
    pub fn forget_data_step(&mut self) {
        self.y.fill(0.0);
    }

    /// `z = prox(q)`.
    pub fn prior_step(&mut self, data: &dyn DataTerm, prior: &mut dyn Prox) {
        if self.beta == 0.0 {
            // With a background this is the brightness of both components; later calls take the foreground's.
            self.set_threshold(INITIAL_BRIGHTNESS_RATIO * brightness(&self.q));
        }
        prior.prox(&self.q, self.beta, &mut self.z);
        data.operator().apply(&self.z, &mut self.az);
    }

    /// Corrects `ρ`, and when the schedule says so the bound, `β`, the support and the noise weights.
    pub fn update_parameters(
        &mut self,
        data: &mut dyn DataTerm,
        prior: &mut dyn Prox,
        params: &AdmmParams,
    ) {
        let is_slow = self.shape.voxels() > UNDERSAMPLED * self.az.len();
        if is_slow
            && self.schedule_iteration() == SupportEstimator::FIRST_UPDATE
            && self.iterations < LATEST_FIRST_UPDATE
            && self.brightness_is_rising()
        {
            self.paused_iterations += DECLINE_WINDOW;
        }
        let (schedule_iteration, rho) = (self.schedule_iteration(), self.rho);
        if let TauRule::Discrepancy { sigma } = self.rule {
            // ‖b − A x‖ grows with ρ, at most in proportion.
            let correction = (self.bound / self.x_residual_norm.max(1e-30)).clamp(0.5, 2.0);
            let has_large_blocks = data.has_large_blocks();
            let has_unrestricted_bin =
                has_large_blocks && params.support && self.support_estimator.has_unrestricted_bin();
            let (lower, upper) = match (
                has_large_blocks,
                self.is_warming_up() || has_unrestricted_bin,
            ) {
                (false, false) => RHO_DEADBAND,
                (false, true) => WARM_UP_RHO_DEADBAND,
                (true, false) => LARGE_RHO_DEADBAND,
                (true, true) => LARGE_UNRESTRICTED_RHO_DEADBAND,
            };
            let is_past_warm_up =
                self.warm_start_credit + self.iterations >= LARGE_UNRESTRICTED_RHO_FROM;
            let is_due = !has_unrestricted_bin
                || (is_past_warm_up
                    && self
                        .iterations
                        .is_multiple_of(LARGE_UNRESTRICTED_RHO_INTERVAL));
            if is_due && !(lower..upper).contains(&correction) {
                self.rho = (self.rho * correction).clamp(self.rho_floor, 1e7 * data.scale());
            }
            if schedule_iteration > DEGREES_OF_FREEDOM_AFTER
                && schedule_iteration.is_multiple_of(10)
            {
                let m = data.measurement_count() as f64;
                let tolerance = (0.01 * brightness(self.foreground())) as f32;
                let df = prior.degrees_of_freedom(&self.z, tolerance);
                self.bound = sigma * (m - df.min(MAX_FREEDOM * m)).sqrt();
            }
        }
        if schedule_iteration < THRESHOLD_SETTLES && schedule_iteration.is_multiple_of(5) {
            self.set_threshold(brightness(self.foreground()));
        }
        if params.support && SupportEstimator::is_due(schedule_iteration) {
            self.restrict(data, prior);
        }
        if (schedule_iteration <= FREQUENT_UPDATES_UNTIL
            || schedule_iteration.is_multiple_of(5 * WEIGHT_UPDATE_INTERVAL))
            && schedule_iteration.is_multiple_of(WEIGHT_UPDATE_INTERVAL)
            && data.update_weights(&self.z)
        {
            data.operator().apply(&self.z, &mut self.az);
            data.operator().apply(&self.q, &mut self.aq);
        }
        self.rho_is_unchanged = self.rho == rho;
        if schedule_iteration.is_multiple_of(50) {
            // `A q` is a running sum: compute it afresh, so that rounding errors do not add up.
            data.operator().apply(&self.q, &mut self.aq);
        }
    }

    /// Whether some bin's brightness has not yet declined, by [`DECLINE`] from one call to the next.
    fn brightness_is_rising(&mut self) -> bool {
        let bins = self.z.chunks_exact(self.shape.pixels());
        for (before, bin) in self.rising_brightness.iter_mut().zip(bins) {
            if *before > 0.0 {
                let now = brightness(bin);
                *before = if now > (1.0 - DECLINE) * *before {
                    now
                } else {
                    0.0
                };
            }
        }
        self.rising_brightness.iter().any(|before| *before > 0.0)
    }

    /// Sets `β` to the scheduled fraction of `brightness`.
    ///
    /// The scaled dual `u` is not rescaled, though a change of the penalty calls for it (Boyd et al. 2011, section
    /// 3.4.1): the brightness still grows then, and rescaling would amplify the haze of the first iterations.
    fn set_threshold(&mut self, brightness: f64) {
        if brightness <= 0.0 {
            self.beta = self.beta.max(f64::MIN_POSITIVE);
            return;
        }
        let early = 1.0 - self.schedule_iteration() as f64 / CONTINUATION_END as f64;
        let part = self.relative_threshold * (1.0 + (CONTINUATION_FACTOR - 1.0) * early.max(0.0));
        let beta = part * brightness;
        self.beta = beta;
        if let TauRule::Fixed(tau) = self.rule {
            self.set_rho_for_tau(tau);
        }
    }

    /// Sets `ρ = τ/β`. Where the data step is not stable at this `ρ`, takes a smaller `β`.
    fn set_rho_for_tau(&mut self, tau: f64) {
        self.rho = tau / self.beta;
        if self.rho < self.stable_rho {
            self.rho = self.stable_rho;
            self.beta = tau / self.rho;
        }
    }

    /// Updates the support, and sets the voxels outside it to zero.
    fn restrict(&mut self, data: &mut dyn DataTerm, prior: &mut dyn Prox) {
        let mut underfit_bins = Vec::new();
        let was_unrestricted = self.support_estimator.fraction() == 1.0;
        if self.support_estimator.support().is_some() {
            let residual = self.residual(data);
            let residual_rms = data.residual_rms_of_bins(&residual);
            underfit_bins = self
                .support_estimator
                .underfit_bins(residual_rms, self.reference_rms(data));
            if self.support_estimator.is_stable() && underfit_bins.is_empty() {
                return;
            }
            if !underfit_bins.is_empty() {
                // `Aᵀ(b − A v)` is largest where the video lacks light.
                data.operator().adjoint(&residual, &mut self.scratch);
            }
        }
        let voxels = self.shape.voxels();
        let bright = brightness(self.foreground());
        let support = self.support_estimator.update(
            &self.z[..voxels],
            bright,
            &self.scratch[..voxels],
            &underfit_bins,
        );
        if was_unrestricted && self.support_estimator.fraction() < 1.0 {
            let part = if data.has_large_blocks() {
                LARGE_MIN_RHO_RATIO
            } else {
                MIN_RHO_RATIO
            };
            self.rho_floor = self.rho_floor.max(part * self.rho);
        }
        prior.restrict(&support);
        // In voxels that become inactive `q` and `z` fall alike, so the dual u = q − z stays as it was.
        let active = support
            .mask()
            .par_iter()
            .zip(&mut self.z[..voxels])
            .zip(&mut self.q[..voxels]);
        active
            .filter(|((active, _), _)| **active == 0)
            .for_each(|((_, z), q)| {
                *q -= *z;
                *z = 0.0;
            });
        if let Some(data_support) = self.support_estimator.data_support() {
            data.restrict(data_support);
            // Where the data step is restricted too, the dual becomes zero.
            data_support.zero_outside(&mut self.q);
        }
        data.operator().apply(&self.z, &mut self.az);
        data.operator().apply(&self.q, &mut self.aq);
    }

    /// Root mean square to which that of a bin's residual is compared: that of the bound, or the present one of all
    /// measurements where `τ` is given.
    fn reference_rms(&self, data: &dyn DataTerm) -> f64 {
        match self.rule {
            TauRule::Discrepancy { .. } => self.bound / (data.measurement_count() as f64).sqrt(),
            TauRule::Fixed(_) => self.residual_rms(data),
        }
    }

    /// The certificate of the iterate; see **Stopping** in the head of [`super`]. Overwrites `scratch`.
    pub fn certify(&mut self, data: &dyn DataTerm, prior: &dyn Prox) -> Certificate {
        let (b, tau) = (data.measurements(), self.tau());
        let brightest = self.z.par_iter().copied().reduce(|| 0.0, f32::max);
        // `adjoint_on` zeroes the voxels outside the support, since `group` reads a pixel's whole trace. They are
        // zeroed again after `subtract_dual`, whose result may be non-zero there.
        data.adjoint_on(
            &self.y,
            self.support_estimator.data_support(),
            &mut self.scratch,
        );
        prior.subtract_dual(&mut self.scratch);
        self.restrict_scratch();
        // `y` is the dual point over ρ, and so are the sums: `linear` and `quadratic` scale them.
        let excess: f64 = self
            .scratch
            .par_chunks(CHUNK)
            .map(|x| x.iter().map(|v| f64::from(v.max(0.0))).sum::<f64>())
            .collect::<Vec<_>>()
            .iter()
            .sum();
        let linear =
            self.rho * (dot(b, &self.y) - BRIGHTNESS_BOUND * f64::from(brightest) * excess);
        let quadratic = self.rho * self.rho * norm_squared(&self.y);
        // `s·y` with `s·c` is a dual point for every 0 ≤ s ≤ 1: take the best `s`.
        let s = if quadratic > 0.0 {
            (linear / quadratic).clamp(0.0, 1.0)
        } else {
            0.0
        };
        Certificate {
            primal: 0.5 * distance_squared(b, &self.az) + tau * prior.value(&self.z),
            dual: s * linear - 0.5 * s * s * quadratic,
        }
    }

    /// The video without its background; brightness and support refer to it.
    fn foreground(&self) -> &[f32] {
        &self.z[..self.shape.voxels()]
    }

    fn restrict_scratch(&mut self) {
        if let Some(support) = self.support_estimator.support() {
            support.zero_outside(&mut self.scratch);
        }
    }

    fn residual(&self, data: &dyn DataTerm) -> Vec<f32> {
        data.measurements()
            .iter()
            .zip(&self.az)
            .map(|(b, a)| b - a)
            .collect()
    }

    pub fn residual_rms(&self, data: &dyn DataTerm) -> f64 {
        (distance_squared(data.measurements(), &self.az) / data.measurement_count() as f64).sqrt()
    }

    pub fn objective(&self, data: &dyn DataTerm, prior: &dyn Prox) -> f64 {
        0.5 * distance_squared(data.measurements(), &self.az) + self.tau() * prior.value(&self.z)
    }

    /// The result. It takes the video out; a run that continues needs [`Self::restore_video`] first.
    pub fn finish(
        &mut self,
        data: &dyn DataTerm,
        prior: &dyn Prox,
        stop_reason: StopReason,
    ) -> Solution {
        let certificate = self.certify(data, prior);
        Solution {
            certificate,
            residual: self.residual(data),
            tau: self.tau(),
            iterations: self.iterations,
            stop_reason,
            support_fraction: self.support_estimator.fraction(),
            video: std::mem::take(&mut self.z),
        }
    }

    /// Puts the video that [`Self::finish`] took out back.
    pub fn restore_video(&mut self, video: &[f32]) {
        self.z = video.to_vec();
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

/// Elements of one parallel task.
const CHUNK: usize = 1 << 14;

/// Brightness of the active voxels, `√(Σ v⁴ / Σ v²)` over the positive part: a mean on which faint haze has little
/// influence. It is 0 where no voxel is positive.
pub(crate) fn brightness(video: &[f32]) -> f64 {
    let parts: Vec<(f64, f64)> = video
        .par_chunks(CHUNK)
        .map(|chunk| {
            simd(
                #[inline(always)]
                || powers(chunk),
            )
        })
        .collect();
    let (second, fourth) = parts
        .iter()
        .fold((0.0, 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    if second > 0.0 {
        (fourth / second).sqrt()
    } else {
        0.0
    }
}

/// `Σ v²` and `Σ v⁴` over the positive part.
#[inline(always)]
fn powers(values: &[f32]) -> (f64, f64) {
    const LANES: usize = 8;
    let (mut second, mut fourth) = ([0.0f64; LANES], [0.0f64; LANES]);
    let (parts, rest) = values.as_chunks::<LANES>();
    let mut last = [0.0; LANES];
    last[..rest.len()].copy_from_slice(rest);
    for part in parts.iter().chain([&last]) {
        for i in 0..LANES {
            let square = f64::from(part[i].max(0.0)).powi(2);
            second[i] += square;
            fourth[i] += square * square;
        }
    }
    (second.iter().sum(), fourth.iter().sum())
}
