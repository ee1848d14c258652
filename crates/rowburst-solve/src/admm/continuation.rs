//! Continuation in the threshold `β` (docs/design/006).

use super::phase::{Phase, Schedule};
use super::tuning::Tuning;
use crate::ProblemKind;

/// Chooses `β` as a part of the video's brightness that falls over the first steps.
///
/// A part of the brightness has no unit, so a frame in other units gives the same video in other units. A large
/// threshold moves light in few iterations, but finds only large shapes: the part begins at a multiple of its end and
/// falls linearly. `β` follows the brightness until the run settles, since the certificate needs a constant `β`. A wait
/// does not lower the part further.
#[derive(Clone)]
pub(super) struct Continuation {
    /// `β` at its end over the brightness, see [`super::AdmmParams::threshold`].
    relative_threshold: f64,
    factor: f64,
    end: usize,
    interval: usize,
    initial_brightness_ratio: f64,
}

impl Continuation {
    pub fn new(relative_threshold: f64, tuning: &Tuning, kind: ProblemKind) -> Self {
        Self {
            relative_threshold,
            factor: tuning.continuation_factor,
            end: tuning.for_kind(kind).continuation_end,
            interval: tuning.threshold_interval,
            initial_brightness_ratio: tuning.initial_brightness_ratio,
        }
    }

    /// Whether `β` is to be set in this iteration.
    pub fn is_due(&self, schedule: &Schedule) -> bool {
        schedule.phase() != Phase::Settled && schedule.is_multiple_of(self.interval)
    }

    /// `β` for a video of this `brightness`; `None` where it is dark.
    pub fn beta(&self, brightness: f64, schedule: &Schedule) -> Option<f64> {
        let early = 1.0 - schedule.step() as f64 / self.end as f64;
        let part = self.relative_threshold * (1.0 + (self.factor - 1.0) * early.max(0.0));
        (brightness > 0.0).then_some(part * brightness)
    }

    /// The first `β`, from the brightness of the first x-step, which spreads sparse light.
    pub fn first_beta(&self, brightness: f64, schedule: &Schedule) -> Option<f64> {
        self.beta(self.initial_brightness_ratio * brightness, schedule)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_threshold_falls_to_its_end() {
        let continuation = Continuation::new(0.01, &Tuning::STANDARD, ProblemKind::Small);
        let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
        assert_eq!(continuation.beta(0.0, &schedule), None);
        assert_eq!(continuation.first_beta(1.0, &schedule), Some(0.4));
        let mut betas = Vec::new();
        for _ in 0..60 {
            schedule.finish_iteration();
            schedule.advance(false);
            if continuation.is_due(&schedule) {
                let beta = continuation.beta(1.0, &schedule).unwrap();
                betas.push((schedule.step(), (beta * 1e6).round() / 1e6));
            }
        }
        let expected = [
            (5, 0.0325),
            (10, 0.025),
            (15, 0.0175),
            (20, 0.01),
            (25, 0.01),
            (30, 0.01),
            (35, 0.01),
        ];
        assert_eq!(betas, expected);
    }
}
