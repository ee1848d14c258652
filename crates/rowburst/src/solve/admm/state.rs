//! The variables of an iteration, and its steps.

use super::support_estimator::SupportEstimator;
use super::{AdmmParams, Solution, TauRule};
use crate::Shape;
use crate::linop::WRITE_PART;
use crate::prox::Prox;
use crate::solve::{Certificate, DataTerm, StopReason};
use crate::vecmath::{distance_squared, dot, norm_squared, simd};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Corrections of `ρ` that are not worth another factor, and at first, when factors
/// take as long as two iterations and corrections say little yet: a factor for every 2 % left the pictures of four
/// scenes within 0.3 dB, and took a quarter of the time.
const RHO_DEADBAND: (f64, f64) = (0.98, 1.02);
const OPEN_RHO_DEADBAND: (f64, f64) = (0.8, 1.25);
/// The same on a wide sensor, where they take as long as ten iterations, and while one of its bins is open.
const LARGE_RHO_DEADBAND: (f64, f64) = (0.95, 1.05);
const LARGE_OPEN_RHO_DEADBAND: (f64, f64) = (0.6, 1.6);
/// The first such correction, when the misfit has settled, and iterations from one to the next.
const LARGE_OPEN_RHO_FROM: usize = 20;
const LARGE_OPEN_RHO_INTERVAL: usize = 5;
/// Iterations in which the brightness that `β` refers to is followed.
const THRESHOLD_SETTLES: usize = 40;
/// With so many voxels for each measurement a video takes shape slowly: the
/// clock stands at [`SupportEstimator::FIRST_UPDATE`] until the brightness of every bin has passed its top, falling by this part in
/// so many iterations, or up to the iteration `LATEST_FIRST_UPDATE`. Digits on 2048×2048 pixels end at 62 dB so;
/// with a support found at iteration 80 half of the bins lack light
/// (`cargo bench --workspace --bench full_sensor -- 2048 2`).
const UNDERSAMPLED: usize = 300;
const DECLINE: f64 = 0.005;
const DECLINE_WINDOW: usize = 5;
const LATEST_FIRST_UPDATE: usize = 150;
/// `β` at first over what it will be, and the iteration at which it is that: large steps find
/// the places, small ones the details. Up to the 12th iteration larger digits take 56 to 85 iterations to 0.5 dB
/// of their end, up to the 20th 43 to 82; up to the 28th one of four seeds lost 5 dB. 8 up to the 20th iteration is faster still, and loses faint
/// LEDs in small videos, whose bins then have to be opened.
const CONTINUATION_FACTOR: f64 = 4.0;
const CONTINUATION_END: usize = 20;
/// The first data step spreads the light of a sparse scene; it is this much brighter.
const INITIAL_BRIGHTNESS_RATIO: f64 = 10.0;
/// Iterations from one look at the light that the noise depends on to the next, at first;
/// later, when it moves little, five times as many.
const WEIGHT_UPDATE_INTERVAL: usize = 20;
const FREQUENT_UPDATES_UNTIL: usize = 100;
/// First iteration that counts the degrees of freedom: before, everything is lit.
const DEGREES_OF_FREEDOM_AFTER: usize = 15;
/// Largest part of the measurements that the fit is allowed to spend.
pub(crate) const MAX_FREEDOM: f64 = 0.3;
/// `ρ` of the first step over the typical size of a diagonal element; on a wide sensor nearer to where it goes.
const INITIAL_RHO: f64 = 0.01;
const LARGE_INITIAL_RHO: f64 = 0.0015;
/// Lowest `ρ` on a support over `ρ` before it: a support that lacks light cannot meet the
/// bound, and the dual would grow without end. On a wide sensor `ρ` is farther from its end there.
const MIN_RHO_RATIO: f64 = 0.3;
const LARGE_MIN_RHO_RATIO: f64 = 0.1;
/// Data steps in a row that may be solved worse than asked for: the first ones start
/// from nothing.
const MAX_INEXACT_STEPS: usize = 3;
/// Brightest voxel that the certificate speaks of, over the brightest one found.
const BRIGHTNESS_BOUND: f64 = 2.0;
/// Iterations that the end of the frame before is worth: the first look at where light may be comes
/// four iterations later.
const WARM_START_CREDIT: usize = 26;

pub(super) struct State {
    shape: Shape,
    /// For what needs a video by the way.
    x: Vec<f32>,
    z: Vec<f32>,
    /// `z = prox(q)`, and the scaled dual is `u = q − z`.
    q: Vec<f32>,
    az: Vec<f32>,
    aq: Vec<f32>,
    /// `(A Aᵀ + ρI)⁻¹(b − A p)` of the last data step: `ρ y = b − A x`.
    y: Vec<f32>,
    rho: f64,
    rho_lower_bound: f64,
    /// See [`DataTerm::min_rho`].
    min_rho: f64,
    /// Data steps in a row that were solved worse than asked for.
    inexact_steps: usize,
    beta: f64,
    /// The brightness of each bin at the last look whether it grows; zero once it has passed its top.
    rising_brightness: Vec<f64>,
    rule: TauRule,
    relative_threshold: f64,
    /// Bound on `‖b − A v‖`, and `‖b − A x‖` of the last data step.
    bound: f64,
    x_residual_norm: f64,
    /// Whether `ρ` was left as it was.
    is_steady: bool,
    pub iterations: usize,
    /// Iterations that what it began from is worth.
    warm_start_credit: usize,
    /// Iterations in which the video only took shape.
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
        let first_rho = match data.has_large_blocks() {
            true => LARGE_INITIAL_RHO,
            false => INITIAL_RHO,
        };
        let mut state = Self {
            shape,
            x: vec![0.0; n],
            z: vec![0.0; n],
            q: vec![0.0; n],
            az: vec![0.0; m],
            aq: vec![0.0; m],
            y: vec![0.0; m],
            rho: first_rho * data.scale(),
            rho_lower_bound: (1e-7 * data.scale()).max(data.min_rho()),
            min_rho: data.min_rho(),
            inexact_steps: 0,
            beta: 0.0,
            rising_brightness: vec![f64::MIN_POSITIVE; shape.bins],
            rule: params.tau,
            relative_threshold: params.threshold,
            bound: 0.0,
            x_residual_norm: 0.0,
            is_steady: false,
            iterations: 0,
            warm_start_credit: 0,
            paused_iterations: 0,
            support_estimator: SupportEstimator::new(shape, data.max_active_voxels()),
        };
        state.set_tau_rule(params.tau, data);
        state
    }

    /// From now on `τ` is found by this rule.
    pub fn set_tau_rule(&mut self, rule: TauRule, data: &dyn DataTerm) {
        self.rule = rule;
        self.is_steady = false;
        match rule {
            TauRule::Discrepancy { sigma } => {
                self.bound = sigma * (data.measurement_count() as f64).sqrt();
            }
            TauRule::Fixed(tau) if self.beta > 0.0 => self.set_rho_for_tau(tau),
            TauRule::Fixed(_) => {}
        }
    }

    /// Goes on with other measurements of a scene that has changed little.
    pub fn warm_start(&mut self, data: &dyn DataTerm) {
        let beyond = self.schedule_iteration().saturating_sub(WARM_START_CREDIT);
        // The next look at the places comes when it would have come.
        self.warm_start_credit = self.schedule_iteration().min(WARM_START_CREDIT)
            + beyond % SupportEstimator::UPDATE_INTERVAL;
        self.iterations = 0;
        self.paused_iterations = 0;
        self.inexact_steps = 0;
        self.support_estimator.reset();
        self.set_tau_rule(self.rule, data);
        // The weights may be others.
        data.operator().apply(&self.z, &mut self.az);
        data.operator().apply(&self.q, &mut self.aq);
    }

    /// How far the run is: the iterations that count, and what it began with.
    fn schedule_iteration(&self) -> usize {
        self.warm_start_credit + self.iterations - self.paused_iterations
    }

    /// Whether it has not come to where a video has taken shape.
    pub fn is_warming_up(&self) -> bool {
        self.schedule_iteration() <= SupportEstimator::FIRST_UPDATE
    }

    /// The video, `[t, y, x]`.
    pub fn video(&self) -> &[f32] {
        &self.z
    }

    /// Part of the voxels that may be lit.
    pub fn support_fraction(&self) -> f64 {
        self.support_estimator.fraction()
    }

    /// Whether `β`, `τ` and the support are what they will be.
    pub fn is_settled(&self, params: &AdmmParams) -> bool {
        self.schedule_iteration() > THRESHOLD_SETTLES
            && self.is_steady
            && (!params.support || self.support_estimator.is_settled())
    }

    pub fn tau(&self) -> f64 {
        match self.rule {
            TauRule::Fixed(tau) => tau,
            TauRule::Discrepancy { .. } => self.rho * self.beta,
        }
    }

    /// `q ← x̂ + u` with `x̂ = αx + (1−α)z`, and `A q` along with it; returns how far `q` is from the last one, in
    /// sizes of `z`.
    pub fn data_step(&mut self, data: &mut dyn DataTerm, params: &AdmmParams) -> f64 {
        let alpha = params.relaxation as f32;
        let m = self.az.len();
        // b − A p with p = z − u
        let light = data.measured().iter().zip(&self.az).zip(&self.aq);
        let rest: Vec<f32> = light.map(|((b, az), aq)| b - az + (aq - az)).collect();
        let mut gram_y = vec![0.0f32; m];
        let solved = data.solve_gram(&rest, self.rho, &mut self.y, &mut gram_y);
        self.inexact_steps = if solved { 0 } else { self.inexact_steps + 1 };
        self.x_residual_norm = distance_squared(&rest, &gram_y).sqrt();
        let z = &self.z;
        let slot = self.shape.columns.min(WRITE_PART);
        // Of the parts that begin in each row: their order does not count.
        let sums: Vec<AtomicU64> = (0..z.len().div_ceil(slot))
            .map(|_| AtomicU64::new(0))
            .collect();
        data.adjoint_each(
            &self.y,
            self.support_estimator.data_support(),
            &mut self.q,
            &|start, x, q| {
                // x is x − p here.
                let sum = relax(q, &z[start..start + x.len()], x, alpha);
                let [distance, size] = sum.map(|sum| u64::from(sum.to_bits()));
                sums[start / slot].store(distance << 32 | size, Ordering::Relaxed);
            },
        );
        for ((aq, az), gram_y) in self.aq.iter_mut().zip(&self.az).zip(&gram_y) {
            *aq = az + (1.0 - alpha) * (*aq - az) + alpha * gram_y;
        }
        let (mut distance, mut size) = (0.0, 0.0);
        for sum in sums.into_iter().map(AtomicU64::into_inner) {
            let of = |half: u64| f64::from(f32::from_bits(half as u32));
            (distance, size) = (distance + of(sum >> 32), size + of(sum));
        }
        if distance == 0.0 {
            return 0.0;
        }
        // From a dark video all of it is a change.
        if size > 0.0 {
            f64::from(alpha) * (distance / size).sqrt()
        } else {
            1.0
        }
    }

    /// `z = prox(q)`.
    pub fn prior_step(&mut self, data: &dyn DataTerm, prior: &mut dyn Prox) {
        if self.beta == 0.0 {
            self.set_threshold(INITIAL_BRIGHTNESS_RATIO * brightness(&self.q));
        }
        prior.prox(&self.q, self.beta, &mut self.z);
        data.operator().apply(&self.z, &mut self.az);
    }

    /// Corrects `ρ` or the bound, and now and then `β` and the support.
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
        let (k, rho) = (self.schedule_iteration(), self.rho);
        if let TauRule::Discrepancy { sigma } = self.rule {
            if self.inexact_steps >= MAX_INEXACT_STEPS {
                // The smaller ρ, the harder the step: misfit that comes of poor steps would
                // drive it to nothing.
                self.rho_lower_bound = self.rho_lower_bound.max(2.0 * self.rho);
                self.rho = self.rho_lower_bound;
                self.inexact_steps = 0;
            }
            // ‖b − A x‖ grows with ρ, at most in proportion.
            let correction = (self.bound / self.x_residual_norm.max(1e-30)).clamp(0.5, 2.0);
            let has_large_blocks = data.has_large_blocks();
            let is_open =
                has_large_blocks && params.support && self.support_estimator.has_open_bin();
            let (least, most) = match (has_large_blocks, self.is_warming_up() || is_open) {
                (false, false) => RHO_DEADBAND,
                (false, true) => OPEN_RHO_DEADBAND,
                (true, false) => LARGE_RHO_DEADBAND,
                (true, true) => LARGE_OPEN_RHO_DEADBAND,
            };
            let has_settled = self.warm_start_credit + self.iterations >= LARGE_OPEN_RHO_FROM;
            let is_due = !is_open
                || (has_settled && self.iterations.is_multiple_of(LARGE_OPEN_RHO_INTERVAL));
            if is_due && !(least..most).contains(&correction) {
                self.rho = (self.rho * correction).clamp(self.rho_lower_bound, 1e7 * data.scale());
            }
            if k > DEGREES_OF_FREEDOM_AFTER && k.is_multiple_of(10) {
                let m = data.measurement_count() as f64;
                let tolerance = (0.01 * brightness(self.foreground())) as f32;
                let freedom = prior.degrees_of_freedom(&self.z, tolerance);
                self.bound = sigma * (m - freedom.min(MAX_FREEDOM * m)).sqrt();
            }
        }
        if k < THRESHOLD_SETTLES && k.is_multiple_of(5) {
            self.set_threshold(brightness(self.foreground()));
        }
        if params.support && SupportEstimator::is_due(k) {
            self.restrict(data, prior);
        }
        if (k <= FREQUENT_UPDATES_UNTIL || k.is_multiple_of(5 * WEIGHT_UPDATE_INTERVAL))
            && k.is_multiple_of(WEIGHT_UPDATE_INTERVAL)
            && data.update_weights(&self.z)
        {
            data.operator().apply(&self.z, &mut self.az);
            data.operator().apply(&self.q, &mut self.aq);
        }
        self.is_steady = self.rho == rho;
        if k.is_multiple_of(50) {
            // A q is a long sum: start it afresh.
            data.operator().apply(&self.q, &mut self.aq);
        }
    }

    /// Whether a bin is still taking shape.
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

    /// Sets `β` to its part of the brightness of the video's first part. The scaled dual `u` is left
    /// as it is: while the brightness still grows, multiplying it along (as a change of
    /// penalty asks for) would blow up the haze of the first iterations.
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

    /// `ρ = τ/β`; where the data step has no digits for that, a smaller `β`.
    fn set_rho_for_tau(&mut self, tau: f64) {
        self.rho = tau / self.beta;
        if self.rho < self.min_rho {
            self.rho = self.min_rho;
            self.beta = tau / self.rho;
        }
    }

    /// Looks where light may be, and keeps the rest dark.
    fn restrict(&mut self, data: &mut dyn DataTerm, prior: &mut dyn Prox) {
        let mut underfit_bins = Vec::new();
        let was_open = self.support_estimator.fraction() == 1.0;
        if self.support_estimator.support().is_some() {
            let residual = self.residual(data);
            let misfits = data.misfit_of_bins(&residual);
            underfit_bins = self
                .support_estimator
                .underfit_bins(misfits, self.expected_rms(data));
            if self.support_estimator.is_settled() && underfit_bins.is_empty() {
                return;
            }
            if !underfit_bins.is_empty() {
                // What the residual looks like in the video: brightest where light is missing.
                data.operator().adjoint(&residual, &mut self.x);
            }
        }
        let voxels = self.shape.voxels();
        let bright = brightness(self.foreground());
        let underfit_bins = (&self.x[..voxels], underfit_bins.as_slice());
        let support = self
            .support_estimator
            .update(&self.z[..voxels], bright, underfit_bins);
        if was_open && self.support_estimator.fraction() < 1.0 {
            let part = match data.has_large_blocks() {
                true => LARGE_MIN_RHO_RATIO,
                false => MIN_RHO_RATIO,
            };
            self.rho_lower_bound = self.rho_lower_bound.max(part * self.rho);
        }
        prior.restrict(&support);
        // What goes dark leaves the dual u = q − z as it was.
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
            data_support.apply(&mut self.q);
        }
        data.operator().apply(&self.z, &mut self.az);
        data.operator().apply(&self.q, &mut self.aq);
    }

    /// Root mean square that the residual is expected to have.
    fn expected_rms(&self, data: &dyn DataTerm) -> f64 {
        match self.rule {
            TauRule::Discrepancy { .. } => self.bound / (data.measurement_count() as f64).sqrt(),
            TauRule::Fixed(_) => self.residual_rms(data),
        }
    }

    /// See the module of [`super`]; overwrites `x`.
    pub fn certify(&mut self, data: &dyn DataTerm, prior: &dyn Prox) -> Certificate {
        let (b, tau) = (data.measured(), self.tau());
        let brightest = self.z.par_iter().copied().reduce(|| 0.0, f32::max);
        // Twice: a trace has no part outside the support, and the dual may have one.
        data.adjoint_on(&self.y, self.support_estimator.data_support(), &mut self.x);
        prior.subtract_dual(&mut self.x);
        self.restrict_x();
        // In units of ρ up to here.
        let over: f64 = self
            .x
            .par_chunks(CHUNK)
            .map(|x| x.iter().map(|v| f64::from(v.max(0.0))).sum::<f64>())
            .collect::<Vec<_>>()
            .iter()
            .sum();
        let rise = self.rho * (dot(b, &self.y) - BRIGHTNESS_BOUND * f64::from(brightest) * over);
        let size = self.rho * self.rho * norm_squared(&self.y);
        // s·y with s·c is as good a dual point for every 0 ≤ s ≤ 1.
        let s = if size > 0.0 {
            (rise / size).clamp(0.0, 1.0)
        } else {
            0.0
        };
        Certificate {
            primal: 0.5 * distance_squared(b, &self.az) + tau * prior.value(&self.z),
            dual: s * rise - 0.5 * s * s * size,
        }
    }

    /// What the brightness and the support are taken from.
    fn foreground(&self) -> &[f32] {
        &self.z[..self.shape.voxels()]
    }

    fn restrict_x(&mut self) {
        if let Some(support) = self.support_estimator.support() {
            support.apply(&mut self.x);
        }
    }

    fn residual(&self, data: &dyn DataTerm) -> Vec<f32> {
        data.measured()
            .iter()
            .zip(&self.az)
            .map(|(b, a)| b - a)
            .collect()
    }

    pub fn residual_rms(&self, data: &dyn DataTerm) -> f64 {
        (distance_squared(data.measured(), &self.az) / data.measurement_count() as f64).sqrt()
    }

    pub fn objective(&self, data: &dyn DataTerm, prior: &dyn Prox) -> f64 {
        0.5 * distance_squared(data.measured(), &self.az) + self.tau() * prior.value(&self.z)
    }

    /// What there is; afterwards it can go on, if the video is [returned](Self::restore_video).
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
            support: self.support_estimator.fraction(),
            video: std::mem::take(&mut self.z),
        }
    }

    /// Puts the video of [`Self::finish`] back.
    pub fn restore_video(&mut self, video: &[f32]) {
        self.z = video.to_vec();
    }
}

/// Lanes of sums.
const LANES: usize = 16;

/// `q ← z + (1−α)u + αx`, and with the old `u = q − z` `Σ (x − u)²` and `Σ z²`.
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
            // A pair of rows seldom fills all lanes to its end.
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

/// [`relax`] of as many as there are lanes, or fewer.
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

/// Brightness of what is lit, `√(Σ v⁴ / Σ v²)` over the positive part: a mean in which
/// faint haze has no say.
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
