//! The penalty `ρ`, the threshold `β` of the z-step, and with them `τ = ρβ`.

use super::TauRule;
use super::tuning::{KindTuning, Tuning};
use crate::DataTerm;

/// Keeps `ρ`, `β` and `τ` consistent.
///
/// Two of the three determine the third. Where `τ` is given, `ρ = τ/β` follows from `β`. Under the discrepancy
/// principle `τ = ρβ` follows, and `1/ρ` is the Lagrange multiplier of the bound on the residual of `x`: `‖b − A x‖`
/// rises with `ρ`, at most in proportion, so `ρ` is multiplied by the bound over the residual until both agree. A new
/// `ρ` costs new factors of the x-step. Small corrections are therefore skipped, and larger ones while the residual
/// still falls by itself. Bounds keep `ρ` where the x-step is numerically stable, and on a support, where the problem
/// is not convex, near its value before.
#[derive(Clone)]
pub(super) struct Penalty {
    rule: TauRule,
    rho: f64,
    beta: f64,
    /// `ρ` at the start of the present iteration; `NaN` in the first one.
    previous_rho: f64,
    /// Lower and upper bound of `ρ` under the discrepancy rule. The lower one only rises.
    bounds: (f64, f64),
    /// See [`DataTerm::min_rho`].
    stable_rho: f64,
    max_step: f64,
    tuning: KindTuning,
}

/// Where a run stands, as far as the correction of `ρ` depends on it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Circumstances {
    /// The video is still taking shape.
    pub is_warming_up: bool,
    /// The steps of the warm-up are done, though the video may wait.
    pub has_reached_first_restriction: bool,
    /// Some bin is unrestricted though a support is used.
    pub has_unrestricted_bin: bool,
    /// The video explains the measurements far less well than no video.
    pub has_diverged: bool,
    /// Iterations done.
    pub iterations: usize,
}

impl Penalty {
    pub fn new(rule: TauRule, data: &dyn DataTerm, tuning: &Tuning) -> Self {
        let kind_tuning = *tuning.for_kind(data.capabilities().hints.kind);
        let (scale, stable_rho) = (data.scale(), data.min_rho());
        let lower = (tuning.min_relative_rho * scale).max(stable_rho);
        Self {
            rule,
            rho: kind_tuning.initial_rho * scale,
            beta: 0.0,
            previous_rho: f64::NAN,
            bounds: (lower, (tuning.max_relative_rho * scale).max(lower)),
            stable_rho,
            max_step: tuning.max_rho_step,
            tuning: kind_tuning,
        }
    }

    pub fn rule(&self) -> TauRule {
        self.rule
    }

    pub fn rho(&self) -> f64 {
        self.rho
    }

    /// `β`; 0 before [`Self::set_beta`].
    pub fn beta(&self) -> f64 {
        self.beta
    }

    pub fn tau(&self) -> f64 {
        match self.rule {
            TauRule::Fixed(tau) => tau,
            TauRule::Discrepancy { .. } => self.rho * self.beta,
        }
    }

    /// Whether the controllers left `ρ` unchanged in the present iteration.
    pub fn is_unchanged(&self) -> bool {
        self.rho == self.previous_rho
    }

    /// Begins an iteration, for [`Self::is_unchanged`].
    pub fn begin_iteration(&mut self) {
        self.previous_rho = self.rho;
    }

    /// Sets how `τ` is found from now on.
    pub fn set_rule(&mut self, rule: TauRule) {
        self.rule = rule;
        if self.beta > 0.0 {
            self.set_rho_for_tau();
        }
    }

    /// Sets `β`, and `ρ` where `τ` is given.
    ///
    /// Neither here nor in [`Self::correct`] is the scaled dual `u` rescaled, though a change of the penalty calls for
    /// it (Boyd et al. 2011, section 3.4.1): in the first iterations rescaling would amplify their haze, and later
    /// corrections of `ρ` are small (docs/design/006).
    pub fn set_beta(&mut self, beta: f64) {
        self.beta = beta;
        self.set_rho_for_tau();
    }

    /// [`Self::set_beta`], or where it is `None` for want of light, keeps `β`, or makes the first one tiny.
    pub fn set_beta_or_keep(&mut self, beta: Option<f64>) {
        match beta {
            Some(beta) => self.set_beta(beta),
            None => self.beta = self.beta.max(f64::MIN_POSITIVE),
        }
    }

    /// Sets `ρ = τ/β` where `τ` is given. Where the x-step is not stable at this `ρ`, takes a smaller `β`.
    fn set_rho_for_tau(&mut self) {
        let TauRule::Fixed(tau) = self.rule else {
            return;
        };
        self.rho = tau / self.beta;
        if self.rho < self.stable_rho {
            self.rho = self.stable_rho;
            self.beta = tau / self.rho;
        }
    }

    /// Corrects `ρ` towards the `bound` of `‖b − A x‖` under the discrepancy rule. A bound that no video meets would lower `ρ`
    /// until light of both signs grows without end, so `ρ` rises where the run diverges.
    pub fn correct(&mut self, bound: f64, x_residual_norm: f64, now: Circumstances) {
        if matches!(self.rule, TauRule::Fixed(_)) {
            return;
        }
        let tuning = &self.tuning;
        let costly_interval = tuning
            .unrestricted_rho_interval
            .filter(|_| now.has_unrestricted_bin);
        let is_due = costly_interval.is_none_or(|interval| {
            now.has_reached_first_restriction && now.iterations.is_multiple_of(interval.get())
        });
        let deadband = if now.is_warming_up || costly_interval.is_some() {
            tuning.early_deadband_lower..tuning.early_deadband_upper
        } else {
            tuning.deadband_lower..tuning.deadband_upper
        };
        let correction =
            (bound / x_residual_norm.max(1e-30)).clamp(1.0 / self.max_step, self.max_step);
        let correction = if now.has_diverged {
            self.max_step
        } else {
            correction
        };
        if is_due && !deadband.contains(&correction) {
            let (lower, upper) = self.bounds;
            self.rho = (self.rho * correction).clamp(lower, upper);
        }
    }

    /// Keeps `ρ` from now on above [`KindTuning::min_rho_ratio`] of its present value, under the discrepancy rule.
    pub fn raise_lower_bound(&mut self) {
        let (lower, upper) = &mut self.bounds;
        *lower = lower.max(self.tuning.min_rho_ratio * self.rho).min(*upper);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Capabilities, DataHints, ProblemKind};
    use rowburst_core::Support;
    use rowburst_core::linop::LinearOperator;

    /// A data term whose numbers alone count.
    struct Numbers {
        kind: ProblemKind,
        min_rho: f64,
    }

    impl DataTerm for Numbers {
        fn operator(&self) -> &dyn LinearOperator {
            unreachable!("no operator is asked for")
        }

        fn measurements(&self) -> &[f32] {
            &[]
        }

        fn measurement_count(&self) -> usize {
            100
        }

        fn scale(&self) -> f64 {
            10.0
        }

        fn min_rho(&self) -> f64 {
            self.min_rho
        }

        fn solve_gram(&mut self, _: &[f32], _: f64, _: &mut [f32], _: &mut [f32]) -> bool {
            unreachable!("no solve is asked for")
        }

        fn residual_rms_of_bins(&self, _: &[f32]) -> Vec<f64> {
            unreachable!("no residual is asked for")
        }

        fn restrict(&mut self, _: &Support) {
            unreachable!("no support is asked for")
        }

        fn capabilities(&self) -> Capabilities<'_> {
            let hints = DataHints {
                kind: self.kind,
                ..DataHints::default()
            };
            Capabilities {
                hints,
                ..Capabilities::default()
            }
        }
    }

    const SETTLED: Circumstances = Circumstances {
        is_warming_up: false,
        has_reached_first_restriction: true,
        has_unrestricted_bin: false,
        has_diverged: false,
        iterations: 31,
    };

    fn penalty(rule: TauRule, kind: ProblemKind, min_rho: f64) -> Penalty {
        Penalty::new(rule, &Numbers { kind, min_rho }, &Tuning::STANDARD)
    }

    #[test]
    fn a_given_tau_is_the_product() {
        let mut penalty = penalty(TauRule::Fixed(0.2), ProblemKind::Small, 0.5);
        penalty.set_beta(0.1);
        assert_eq!((penalty.rho(), penalty.tau()), (2.0, 0.2));
        penalty.correct(1.0, 10.0, SETTLED);
        assert_eq!(penalty.rho(), 2.0);
        // At ρ = 0.2 the x-step would not be stable.
        penalty.set_beta(1.0);
        assert_eq!((penalty.rho(), penalty.beta()), (0.5, 0.4));
        penalty.set_rule(TauRule::Fixed(0.4));
        assert_eq!((penalty.rho(), penalty.beta()), (1.0, 0.4));
    }

    #[test]
    fn rho_moves_towards_the_bound() {
        let rule = TauRule::Discrepancy { sigma: 1.0 };
        let mut penalty = penalty(rule, ProblemKind::Small, 0.0);
        assert_eq!(penalty.rho(), 0.1);
        penalty.begin_iteration();
        penalty.correct(1.0, 1.01, SETTLED);
        assert!(penalty.is_unchanged());
        penalty.correct(1.1, 1.0, SETTLED);
        assert!((penalty.rho() - 0.11).abs() < 1e-12 && !penalty.is_unchanged());
        // At most by the largest step, and not below the lower bound.
        penalty.raise_lower_bound();
        penalty.correct(1.0, 100.0, SETTLED);
        assert!((penalty.rho() - 0.055).abs() < 1e-12);
        penalty.correct(1.0, 100.0, SETTLED);
        assert!((penalty.rho() - 0.033).abs() < 1e-12);
        let diverged = Circumstances {
            has_diverged: true,
            ..SETTLED
        };
        penalty.correct(1.0, 100.0, diverged);
        assert!((penalty.rho() - 0.066).abs() < 1e-12);
    }

    #[test]
    fn corrections_are_rarer_while_they_are_dear() {
        let rule = TauRule::Discrepancy { sigma: 1.0 };
        let is_corrected = |kind, residual_norm, now| {
            let mut penalty = penalty(rule, kind, 0.0);
            penalty.begin_iteration();
            penalty.correct(1.0, residual_norm, now);
            !penalty.is_unchanged()
        };
        let (small, wide) = (ProblemKind::Small, ProblemKind::Wide);
        let early = Circumstances {
            is_warming_up: true,
            ..SETTLED
        };
        assert!(is_corrected(small, 1.1, SETTLED) && !is_corrected(small, 1.1, early));
        assert!(is_corrected(small, 1.3, early) && !is_corrected(wide, 1.3, early));
        let unrestricted = Circumstances {
            has_unrestricted_bin: true,
            ..SETTLED
        };
        assert!(is_corrected(small, 1.1, unrestricted) && !is_corrected(wide, 9.0, unrestricted));
        let fifth = Circumstances {
            iterations: 35,
            ..unrestricted
        };
        assert!(is_corrected(wide, 9.0, fifth));
        let too_early = Circumstances {
            has_reached_first_restriction: false,
            ..fifth
        };
        assert!(!is_corrected(wide, 9.0, too_early));
    }
}
