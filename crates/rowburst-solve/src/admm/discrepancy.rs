//! The bound of the residual by the discrepancy principle (docs/design/005).

use super::TauRule;
use super::phase::Schedule;
use super::tuning::Tuning;

/// The bound `σ √(m − df)` of `‖b − A v‖`.
///
/// The residual of the true video is as large as the noise, `σ √m` for `m` measurements. A fit with `df` degrees of
/// freedom also fits their share of the noise, so its residual is smaller. With the bound `σ √m` the video would be
/// over-smoothed. In the warm-up the video is active everywhere and would count far too many degrees of freedom, so they
/// are counted from its end on. The first count is still of the video of the warm-up, since the bound is updated before
/// the first restriction. They take at most [`Tuning::max_freedom`] of the measurements: this limits the first count, and
/// keeps a fit that follows the noise from lowering its own bound.
#[derive(Clone)]
pub(super) struct Discrepancy {
    bound: f64,
    max_freedom: f64,
    interval: usize,
}

impl Discrepancy {
    pub fn new(tuning: &Tuning) -> Self {
        Self {
            bound: 0.0,
            max_freedom: tuning.max_freedom,
            interval: tuning.freedom_interval,
        }
    }

    /// The bound of `‖b − A v‖`. Without a noise level it has no meaning.
    pub fn bound(&self) -> f64 {
        self.bound
    }

    /// Whether the degrees of freedom are to be counted in this iteration.
    pub fn is_due(&self, schedule: &Schedule) -> bool {
        !schedule.is_warming_up() && schedule.is_multiple_of(self.interval)
    }

    /// Sets the bound for `measurement_count` measurements without degrees of freedom.
    pub fn reset(&mut self, rule: TauRule, measurement_count: usize) {
        if let TauRule::Discrepancy { sigma } = rule {
            self.bound = sigma * (measurement_count as f64).sqrt();
        }
    }

    /// Sets the bound for a fit with these degrees of freedom.
    pub fn set_degrees_of_freedom(&mut self, df: f64, sigma: f64, measurement_count: usize) {
        let m = measurement_count as f64;
        self.bound = sigma * (m - df.min(self.max_freedom * m)).sqrt();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ProblemKind;

    #[test]
    fn degrees_of_freedom_are_counted_after_the_warm_up() {
        let discrepancy = Discrepancy::new(&Tuning::STANDARD);
        let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
        let mut steps = Vec::new();
        for _ in 0..55 {
            schedule.finish_iteration();
            schedule.advance(false);
            if discrepancy.is_due(&schedule) {
                steps.push(schedule.step());
            }
        }
        assert_eq!(steps, [20, 30, 40, 50]);
    }

    #[test]
    fn degrees_of_freedom_lower_the_bound() {
        let mut discrepancy = Discrepancy::new(&Tuning::STANDARD);
        discrepancy.reset(TauRule::Discrepancy { sigma: 2.0 }, 100);
        assert_eq!(discrepancy.bound(), 20.0);
        discrepancy.set_degrees_of_freedom(19.0, 2.0, 100);
        assert_eq!(discrepancy.bound(), 18.0);
        discrepancy.set_degrees_of_freedom(90.0, 2.0, 100);
        assert_eq!(discrepancy.bound(), 2.0 * 70f64.sqrt());
        // A given τ has no bound.
        discrepancy.reset(TauRule::Fixed(1.0), 400);
        assert_eq!(discrepancy.bound(), 2.0 * 70f64.sqrt());
    }
}
