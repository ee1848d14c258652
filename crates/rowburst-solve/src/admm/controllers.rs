//! All that adapts between iterations, and the order in which it acts.
//!
//! `τ` by held-out pixels has its controller outside (`reconstruct/choose/level.rs` of `rowburst`): it judges videos that have
//! settled, and acts between runs by [`Controllers::set_tau_rule`].

use super::active_set::{ActiveSet, Restriction};
use super::brightness::{brightness, capped_brightness, participation};
use super::continuation::Continuation;
use super::discrepancy::Discrepancy;
use super::noise_weights::NoiseWeights;
use super::penalty::{Circumstances, Penalty};
use super::phase::{DeclineDetector, Phase, Schedule};
use super::stopping::Supports;
use super::variables::Variables;
use super::{AdmmParams, KindTuning, TauRule, Tuning};
use crate::DataTerm;
use crate::prox::Prox;
use rowburst_core::Shape;

/// The controllers of a run.
#[derive(Clone)]
pub(super) struct Controllers {
    shape: Shape,
    pub schedule: Schedule,
    pub penalty: Penalty,
    pub active_set: ActiveSet,
    discrepancy: Discrepancy,
    continuation: Continuation,
    noise_weights: NoiseWeights,
    decline: DeclineDetector,
    /// Whether the weights of the measurements changed before the present iteration.
    has_new_weights: bool,
    kind_tuning: KindTuning,
    tuning: Tuning,
}

impl Controllers {
    pub fn new(data: &dyn DataTerm, shape: Shape, params: &AdmmParams) -> Self {
        let tuning = &params.tuning;
        let kind = data.capabilities().hints.kind;
        let mut controllers = Self {
            shape,
            schedule: Schedule::new(tuning, kind),
            penalty: Penalty::new(params.tau, data, tuning),
            active_set: ActiveSet::new(data, shape, params),
            discrepancy: Discrepancy::new(tuning),
            continuation: Continuation::new(params.threshold, tuning, kind),
            noise_weights: NoiseWeights::new(tuning),
            decline: DeclineDetector::new(shape.bins, tuning),
            has_new_weights: false,
            kind_tuning: *tuning.for_kind(kind),
            tuning: *tuning,
        };
        controllers.set_tau_rule(params.tau, data);
        controllers
    }

    /// Sets how `τ` is found from now on.
    pub fn set_tau_rule(&mut self, rule: TauRule, data: &dyn DataTerm) {
        self.penalty.set_rule(rule);
        self.discrepancy.reset(rule, data.measurement_count());
    }

    /// Continues with other measurements, of a scene that has changed little.
    pub fn warm_start(&mut self, data: &dyn DataTerm) {
        self.schedule.warm_start();
        self.active_set.allow_changes();
        self.set_tau_rule(self.penalty.rule(), data);
    }

    /// Forgets which bins their support could not explain: those of another frame are others.
    pub fn forget_underfit_bins(&mut self) {
        self.active_set.forget_underfit_bins();
    }

    /// Lets each controller act before an iteration. Before the first one of a run there is nothing to adapt to; its
    /// threshold is found in [`Self::threshold`]. A warm start continues a run, so the first iteration of a later frame
    /// adapts, too.
    ///
    /// The order matters:
    /// 1. `ρ` first: it compares the residual of the last x-step with the bound that held then. The first iteration of
    ///    a frame has no x-step to compare.
    /// 2. The phase, which says what else is due.
    /// 3. The bound, for the next correction of `ρ`. It counts the degrees of freedom of the video as the prior left
    ///    it, before a restriction changes the video. So the first count is of the video of the warm-up.
    /// 4. `β`, from the same video. Where `τ` is given, `ρ` follows here.
    /// 5. The active set. It comes after `ρ`, which its first restriction bounds from below, and after the bound, to
    ///    which the residuals of bins are compared.
    /// 6. The noise weights, from the light of the restricted video, which is what the next x-step begins from.
    /// 7. Last, `A q` afresh, for the restricted `q` and the present weights.
    pub fn adapt(
        &mut self,
        variables: &mut Variables,
        data: &mut dyn DataTerm,
        prior: &mut dyn Prox,
    ) {
        if self.schedule.step() == 0 {
            return;
        }
        self.penalty.begin_iteration();
        self.correct_penalty(variables, data);
        self.advance_phase(variables, data);
        self.update_bound(variables, data, prior);
        if self.continuation.is_due(&self.schedule) {
            self.set_threshold(variables, data);
        }
        if self.active_set.is_due(&self.schedule) {
            self.update_active_set(variables, data, prior);
        }
        self.has_new_weights =
            self.noise_weights.is_due(&self.schedule) && data.update_weights(&variables.z);
        if self.has_new_weights {
            variables.update_products(data);
        }
        if self.schedule.is_multiple_of(self.tuning.refresh_interval) {
            // `A q` is a running sum: compute it afresh, so that rounding errors do not add up.
            variables.update_aq(data);
        }
    }

    /// The threshold `β` of the z-step. [`Self::adapt`] sets it, but for the first one of a run: this is a part of the
    /// brightness of the first `q = αx`.
    pub fn threshold(&mut self, variables: &Variables) -> f64 {
        if self.penalty.beta() == 0.0 {
            // With a background this is the brightness of both components; later calls take the foreground's.
            let beta = self
                .continuation
                .first_beta(brightness(&variables.q), &self.schedule);
            self.penalty.set_beta_or_keep(beta);
        }
        self.penalty.beta()
    }

    /// Whether a certificate can end the run: `β` is constant, the controllers left `ρ` unchanged in this iteration, and
    /// the support is stable.
    pub fn is_settled(&self) -> bool {
        self.schedule.phase() == Phase::Settled
            && self.penalty.is_unchanged()
            && self.active_set.is_settled()
    }

    /// Whether the iteration is a map, on a support, that later ones repeat: the run is settled, and no weight has changed.
    pub fn is_fixed_map(&self) -> bool {
        self.is_settled() && self.active_set.support().is_some() && !self.has_new_weights
    }

    /// The supports of a certificate.
    pub fn supports(&self) -> Supports<'_> {
        Supports {
            of_video: self.active_set.support(),
            of_x_step: self.active_set.x_step_support(),
        }
    }

    fn correct_penalty(&mut self, variables: &Variables, data: &dyn DataTerm) {
        let Some(x_residual_norm) = variables.x_residual_norm else {
            return;
        };
        let now = Circumstances {
            is_warming_up: self.schedule.is_warming_up(),
            has_reached_first_restriction: self.schedule.has_reached_first_restriction(),
            has_unrestricted_bin: self.active_set.has_unrestricted_bin(),
            has_diverged: variables.have_diverged(data),
            iterations: self.schedule.iterations(),
        };
        let bound = self.discrepancy.bound();
        self.penalty.correct(bound, x_residual_norm, now);
    }

    fn advance_phase(&mut self, variables: &Variables, data: &dyn DataTerm) {
        let must_wait =
            self.schedule.is_at_end_of_warm_up() && self.takes_shape_slowly(variables, data);
        self.schedule.advance(must_wait);
    }

    /// Whether the video is still taking shape at the end of the warm-up, see [`Phase::Waiting`].
    fn takes_shape_slowly(&mut self, variables: &Variables, data: &dyn DataTerm) -> bool {
        let (shape, done) = (self.shape, self.schedule.steps_with_repeats());
        let is_undersampled = shape.voxels() > self.tuning.undersampled * variables.az.len();
        let is_rising = is_undersampled
            && done < self.tuning.latest_first_restriction
            && self.decline.is_rising(&variables.z, shape);
        is_rising
            || done < self.kind_tuning.latest_extended_restriction
                && self.extent(variables, data) > 1.0
    }

    /// How far the scene is extended for its measurements: the participation of the video over [`Tuning::extended`] of the
    /// number of measurements. Above 1 the scene is extended: no restriction leaves far fewer voxels than measurements, and
    /// a larger `β` alone removes its haze (docs/design/034). It is 0 where no support is used, and in the first
    /// [`Tuning::extended_from`] steps, in which every scene is haze.
    fn extent(&self, variables: &Variables, data: &dyn DataTerm) -> f64 {
        let done = self.schedule.steps_with_repeats();
        if !self.active_set.is_used() || done < self.tuning.extended_from {
            return 0.0;
        }
        let limit = self.tuning.extended * data.measurement_count().max(1) as f64;
        self.participation(variables) / limit
    }

    /// The number of voxels of equal brightness that would share the light of the video alike.
    pub fn participation(&self, variables: &Variables) -> f64 {
        participation(self.foreground(variables))
    }

    fn update_bound(&mut self, variables: &Variables, data: &dyn DataTerm, prior: &dyn Prox) {
        if let TauRule::Discrepancy { sigma } = self.penalty.rule()
            && self.discrepancy.is_due(&self.schedule)
        {
            let df = self.degrees_of_freedom(variables, prior);
            self.discrepancy
                .set_degrees_of_freedom(df, sigma, data.measurement_count());
        }
    }

    /// The degrees of freedom of the video.
    pub fn degrees_of_freedom(&self, variables: &Variables, prior: &dyn Prox) -> f64 {
        let faint = self.tuning.flat_difference * brightness(self.foreground(variables));
        prior.degrees_of_freedom(&variables.z, faint as f32)
    }

    fn set_threshold(&mut self, variables: &Variables, data: &dyn DataTerm) {
        let foreground = self.foreground(variables);
        let bright = if self.schedule.step() < self.kind_tuning.brightness_capped_from {
            brightness(foreground)
        } else {
            capped_brightness(foreground, self.shape.pixels(), &self.tuning)
        };
        let factor = self.extended_factor(variables, data);
        self.penalty
            .set_beta_or_keep(self.continuation.beta(factor * bright, &self.schedule));
    }

    /// The factor on `β` of an extended scene, see [`KindTuning::max_extended_factor`].
    fn extended_factor(&self, variables: &Variables, data: &dyn DataTerm) -> f64 {
        let largest = self.kind_tuning.max_extended_factor;
        if largest <= 1.0 {
            return 1.0;
        }
        self.extent(variables, data).clamp(1.0, largest)
    }

    fn update_active_set(
        &mut self,
        variables: &mut Variables,
        data: &mut dyn DataTerm,
        prior: &mut dyn Prox,
    ) {
        // The residual of the bound, or the present one of all measurements where `τ` is given.
        let reference_rms = match self.penalty.rule() {
            TauRule::Discrepancy { .. } => {
                self.discrepancy.bound() / (data.measurement_count() as f64).sqrt()
            }
            TauRule::Fixed(_) => variables.residual_rms(data),
        };
        let restriction = self
            .active_set
            .update(variables, data, prior, reference_rms);
        if restriction == Restriction::Begins {
            self.penalty.raise_lower_bound();
        }
    }

    /// The video without its background; brightness and support refer to it.
    fn foreground<'a>(&self, variables: &'a Variables) -> &'a [f32] {
        &variables.z[..self.shape.voxels()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::Support;
    use rowburst_core::linop::LinearOperator;
    use std::sync::{Arc, Mutex};

    /// What the controllers ask of data and prior, in order. Videos are told by the number of their active voxels.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    enum Call {
        DegreesOfFreedom(usize),
        RestrictPrior,
        RestrictData,
        Apply(usize),
        UpdateWeights(usize),
    }

    type Calls = Arc<Mutex<Vec<Call>>>;

    fn active(video: &[f32]) -> usize {
        video.iter().filter(|v| **v != 0.0).count()
    }

    /// `A = I` for a frame of [`VOXELS`] pixels that counts as [`MEASUREMENTS`] measurements.
    struct RecordingData(Calls);

    #[derive(Clone)]
    struct RecordingPrior(Calls);

    const VOXELS: usize = 81;
    const MEASUREMENTS: usize = 100;

    impl LinearOperator for RecordingData {
        fn domain_len(&self) -> usize {
            VOXELS
        }

        fn range_len(&self) -> usize {
            VOXELS
        }

        fn apply(&self, x: &[f32], y: &mut [f32]) {
            self.0.lock().unwrap().push(Call::Apply(active(x)));
            y.copy_from_slice(x);
        }

        fn adjoint(&self, _: &[f32], _: &mut [f32]) {
            unreachable!("no adjoint is asked for")
        }
    }

    impl DataTerm for RecordingData {
        fn operator(&self) -> &dyn LinearOperator {
            self
        }

        fn measurements(&self) -> &[f32] {
            &[0.0; VOXELS]
        }

        fn measurement_count(&self) -> usize {
            MEASUREMENTS
        }

        fn scale(&self) -> f64 {
            1.0
        }

        fn solve_gram(&mut self, _: &[f32], _: f64, _: &mut [f32], _: &mut [f32]) -> bool {
            unreachable!("no solve is asked for")
        }

        fn residual_rms_of_bins(&self, _: &[f32]) -> Vec<f64> {
            unreachable!("no residual is asked for")
        }

        fn restrict(&mut self, _: &Support) {
            self.0.lock().unwrap().push(Call::RestrictData);
        }

        fn update_weights(&mut self, video: &[f32]) -> bool {
            let call = Call::UpdateWeights(active(video));
            self.0.lock().unwrap().push(call);
            false
        }
    }

    impl Prox for RecordingPrior {
        fn prox(&mut self, _: &[f32], _: f64, _: &mut [f32]) {
            unreachable!("no prox is asked for")
        }

        fn value(&self, _: &[f32]) -> f64 {
            unreachable!("no value is asked for")
        }

        fn degrees_of_freedom(&self, z: &[f32], _: f32) -> f64 {
            let call = Call::DegreesOfFreedom(active(z));
            self.0.lock().unwrap().push(call);
            19.0
        }

        fn restrict(&mut self, _: &Support) {
            self.0.lock().unwrap().push(Call::RestrictPrior);
        }

        fn subtract_dual(&self, _: &mut [f32]) {
            unreachable!("no dual is asked for")
        }
    }

    #[test]
    fn a_flash_counts_in_full_in_the_warm_up_alone() {
        let shape = Shape::new(3, 3, 9);
        let data = RecordingData(Calls::default());
        let params = AdmmParams::new(TauRule::Discrepancy { sigma: 1.0 });
        let mut controllers = Controllers::new(&data, shape, &params);
        let mut variables = Variables::new(&data, shape.columns);
        (variables.z[13], variables.z[40], variables.z[67]) = (1.0, 4.0, 1.0);
        let flash = brightness(&variables.z);
        assert!(flash > 3.0);
        for (step, bright) in [(19, flash), (20, 2.0)] {
            while controllers.schedule.step() < step {
                controllers.schedule.finish_iteration();
            }
            controllers.set_threshold(&variables, &data);
            let beta = controllers.continuation.beta(bright, &controllers.schedule);
            assert_eq!(Some(controllers.penalty.beta()), beta, "step {step}");
        }
    }

    /// The controllers of a run after `iterations`, and its video of so many voxels of brightness 1. With 100 measurements,
    /// more than 35 such voxels are an extended scene.
    fn run_of_even_voxels(
        voxels: usize,
        iterations: usize,
        params: &AdmmParams,
    ) -> (Controllers, Variables, RecordingData) {
        let shape = Shape::new(1, 9, 9);
        let data = RecordingData(Calls::default());
        let mut controllers = Controllers::new(&data, shape, params);
        let mut variables = Variables::new(&data, shape.columns);
        variables.z[..voxels].fill(1.0);
        for _ in 0..iterations {
            controllers.schedule.finish_iteration();
        }
        (controllers, variables, data)
    }

    /// Parameters that look for extended scenes.
    fn params_for_extended_scenes(support: bool) -> AdmmParams {
        let mut params = AdmmParams::new(TauRule::Discrepancy { sigma: 1.0 });
        params.support = support;
        params.tuning.small.max_extended_factor = 3.0;
        params.tuning.small.latest_extended_restriction = 60;
        params
    }

    #[test]
    fn an_extended_scene_takes_a_larger_threshold() {
        let factor = |voxels, iterations, params: AdmmParams| {
            let (mut controllers, variables, data) =
                run_of_even_voxels(voxels, iterations, &params);
            controllers.set_threshold(&variables, &data);
            let beta = controllers.continuation.beta(1.0, &controllers.schedule);
            (controllers.penalty.beta() / beta.unwrap() * 1e6).round() / 1e6
        };
        let params = params_for_extended_scenes(true);
        assert_eq!(factor(35, 20, params), 1.0);
        assert_eq!(factor(70, 20, params), 2.0);
        assert_eq!(factor(70, 19, params), 1.0);
        assert_eq!(factor(70, 20, params_for_extended_scenes(false)), 1.0);
        assert_eq!(factor(70, 20, AdmmParams::new(params.tau)), 1.0);
    }

    #[test]
    fn a_video_that_takes_shape_slowly_is_restricted_later() {
        let iterations = |voxels, params: AdmmParams| {
            let (mut controllers, variables, data) = run_of_even_voxels(voxels, 10, &params);
            while controllers.schedule.is_warming_up() {
                controllers.schedule.finish_iteration();
                controllers.advance_phase(&variables, &data);
            }
            controllers.schedule.iterations()
        };
        let params = params_for_extended_scenes(true);
        assert_eq!(iterations(35, params), 20);
        assert_eq!(iterations(70, params), 60);
        assert_eq!(iterations(70, params_for_extended_scenes(false)), 20);
        let mut undersampled = params;
        undersampled.tuning.undersampled = 0;
        assert_eq!(iterations(35, undersampled), 150);
        // All bins count as fallen at the second look, but the scene is extended.
        undersampled.tuning.decline = -1.0;
        assert_eq!(iterations(70, undersampled), 60);
    }

    /// All controllers act before iteration 21.
    #[test]
    fn controllers_act_in_their_order() {
        let shape = Shape::new(1, 9, 9);
        let calls = Calls::default();
        let mut data = RecordingData(Arc::clone(&calls));
        let mut prior = RecordingPrior(Arc::clone(&calls));
        let params = AdmmParams {
            tuning: Tuning {
                refresh_interval: 20,
                ..Tuning::STANDARD
            },
            ..AdmmParams::new(TauRule::Discrepancy { sigma: 1.0 })
        };
        let mut controllers = Controllers::new(&data, shape, &params);
        let mut variables = Variables::new(&data, shape.columns);
        // A bright voxel in haze, which the restriction takes away.
        variables.z.fill(0.01);
        variables.z[40] = 1.0;
        variables.q.fill(0.5);
        variables.x_residual_norm = Some(5.0);
        let bright = brightness(&variables.z);

        controllers.adapt(&mut variables, &mut data, &mut prior);
        assert!(calls.lock().unwrap().is_empty(), "nothing to adapt to");

        for _ in 0..20 {
            controllers.schedule.finish_iteration();
        }
        controllers.adapt(&mut variables, &mut data, &mut prior);
        // ρ follows the bound σ√m = 10 of the x-step before; the new bound is σ√(m − 19) = 9.
        assert_eq!(controllers.penalty.rho(), 10.0 / 5.0 * 0.01);
        assert_eq!(controllers.discrepancy.bound(), 9.0);
        assert_eq!(controllers.schedule.phase(), Phase::Settling);
        // β is a part of the brightness before the restriction.
        assert_eq!(controllers.penalty.beta(), params.threshold * bright);
        let expected = [
            Call::DegreesOfFreedom(81),
            Call::RestrictPrior,
            Call::RestrictData,
            // A z and A q on the support, the weights, and A q afresh.
            Call::Apply(9),
            Call::Apply(9),
            Call::UpdateWeights(9),
            Call::Apply(9),
        ];
        assert_eq!(*calls.lock().unwrap(), expected);
    }
}
