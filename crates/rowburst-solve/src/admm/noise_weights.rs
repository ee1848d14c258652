//! When the noise weights are computed afresh (docs/design/010).

use super::phase::Schedule;
use super::tuning::Tuning;

/// Says when the weights of the measurements follow the light of the video.
///
/// Shot noise depends on the light, which the video knows better than the single counts. New weights cost new Gram
/// blocks, so they are rare, and rarer once the video changes little. They begin with the first restriction: the light
/// of a video that is still taking shape is no better than the counts.
#[derive(Clone)]
pub(super) struct NoiseWeights {
    interval: usize,
    frequent_until: usize,
    late_interval: usize,
}

impl NoiseWeights {
    pub fn new(tuning: &Tuning) -> Self {
        Self {
            interval: tuning.weight_interval,
            frequent_until: tuning.frequent_weights_until,
            late_interval: tuning.late_weight_interval,
        }
    }

    pub fn is_due(&self, schedule: &Schedule) -> bool {
        let interval = if schedule.step() <= self.frequent_until {
            self.interval
        } else {
            self.late_interval
        };
        !schedule.is_warming_up() && schedule.is_multiple_of(interval)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ProblemKind;

    #[test]
    fn weights_become_rarer() {
        let weights = NoiseWeights::new(&Tuning::STANDARD);
        let mut schedule = Schedule::new(&Tuning::STANDARD, ProblemKind::Small);
        let mut steps = Vec::new();
        for _ in 0..310 {
            schedule.finish_iteration();
            schedule.advance(false);
            if weights.is_due(&schedule) {
                steps.push(schedule.step());
            }
        }
        assert_eq!(steps, [20, 40, 60, 80, 100, 200, 300]);
    }
}
