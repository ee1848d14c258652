//! The choice of the model, and whether a guide belongs to the frame.

use super::{GuideModel, GuideTrial};
use rowburst_optics::Image;

/// Held-out error of a motion over that of a gain field above which the gain field is chosen; a gain field has more
/// parameters and predicts held-out pixels a little better where things move (docs/design/028).
const MOTION_MARGIN: f64 = 1.4;
/// The same above which no richer motion is tried.
pub(super) const HOPELESS_MOTION: f64 = 3.0;
/// Least part by which a richer motion must lower the held-out error.
const RICHER_MARGIN: f64 = 0.995;
/// Held-out error of a motion over that without a guide above which the guide is dropped.
const MAX_MOTION_RATIO: f64 = 1.06;
/// The same for a still picture.
const MAX_STILL_RATIO: f64 = 1.18;
/// The same for a gain field, which the coarse video without a guide beats where cells flicker fast.
const MAX_GAIN_RATIO: f64 = 2.0;
/// The same for places, whose traces explain every change of brightness; above so many σ the second.
const MAX_PLACES_RATIO: f64 = 1.0;
const MAX_BAD_PLACES_RATIO: f64 = 0.5;
const BAD_PLACES: f64 = 4.0;
/// Held-out error over σ up to which places explain the frame, whatever is left without them.
const GOOD_PLACES: f64 = 1.15;
/// Correlation with the coarse picture of the scene below which the guide is dropped. Honest ones
/// are above; so are some of other scenes, which a motion does not explain (docs/design/028).
const MIN_CORRELATION: f64 = 0.3;
/// Part of a guide's pixels at its greatest value above which it is overexposed.
const MAX_SATURATED: f64 = 0.05;

/// Part of the pixels within half a percent of the greatest value.
pub(super) fn saturated(guide: &Image) -> f64 {
    let end = guide.max() - 0.005 * (guide.max() - guide.min());
    let count = guide.data().iter().filter(|v| **v >= end).count();
    count as f64 / guide.data().len() as f64
}

/// The best trial: within a model by held-out error, the simplest unless a richer one is clearly better.
pub(super) fn choose(trials: &[GuideTrial]) -> usize {
    let best_of = |model: GuideModel| {
        let mut best: Option<usize> = None;
        for (i, trial) in trials.iter().enumerate().filter(|(_, t)| t.model == model) {
            let is_better =
                best.is_none_or(|b| trial.held_out < RICHER_MARGIN * trials[b].held_out);
            if is_better {
                best = Some(i);
            }
        }
        best
    };
    let still = best_of(GuideModel::Still);
    let motion = best_of(GuideModel::Motion);
    let gain = best_of(GuideModel::Gain).or(best_of(GuideModel::Places));
    let error = |i: usize| trials[i].held_out;
    let change = match (motion, gain) {
        (Some(m), Some(g)) if error(m) > MOTION_MARGIN * error(g) => Some(g),
        (motion, gain) => motion.or(gain),
    };
    match (still, change) {
        (Some(s), Some(c)) if error(s) <= error(c) => s,
        (still, change) => change.or(still).expect("at least one trial"),
    }
}

/// What a verdict rests on.
pub(super) struct Evidence<'a> {
    pub trials: &'a [GuideTrial],
    pub held_out_without: f64,
    pub correlation: f64,
    pub saturated: f64,
    /// The larger [`super::Affine::deviation`] of the registered map and of the fitted one.
    pub deviation: f64,
}

impl Evidence<'_> {
    /// Whether the guide is used for the trial `chosen`, and why.
    pub fn verdict(&self, chosen: &GuideTrial) -> (bool, String) {
        if let Some(why) = self.objection(chosen) {
            return (false, format!("dropped: {why}"));
        }
        let reason = format!(
            "used: {}, held-out error {:.3} σ, {:.3} σ without a guide, correlation {:.2}",
            chosen.model.name(),
            chosen.held_out,
            self.held_out_without,
            self.correlation
        );
        (true, reason)
    }

    /// Why the guide does not belong to the frame.
    fn objection(&self, chosen: &GuideTrial) -> Option<String> {
        if self.saturated > MAX_SATURATED {
            let percent = 100.0 * self.saturated;
            return Some(format!(
                "it is overexposed, {percent:.0} % of its pixels have its greatest value"
            ));
        }
        // The coarse video shows little of a scene of few lit places, which their fit tells from others itself.
        if self.correlation < MIN_CORRELATION && chosen.model != GuideModel::Places {
            return Some(format!(
                "it does not resemble what the frame alone shows (correlation {:.2}, at least {MIN_CORRELATION} is needed)",
                self.correlation
            ));
        }
        if self.deviation > 1.0 {
            return Some("it would have to be shifted, turned or scaled too far".into());
        }
        let ratio = chosen.held_out / self.held_out_without;
        let limit = match chosen.model {
            GuideModel::Gain => MAX_GAIN_RATIO,
            GuideModel::Places if chosen.held_out > BAD_PLACES => MAX_BAD_PLACES_RATIO,
            GuideModel::Places => MAX_PLACES_RATIO,
            GuideModel::Still => MAX_STILL_RATIO,
            GuideModel::Motion | GuideModel::Auto => MAX_MOTION_RATIO,
        };
        if chosen.model == GuideModel::Places {
            return (ratio > limit && chosen.held_out > GOOD_PLACES).then(|| {
                format!(
                    "its lit places explain held-out pixels to {:.2} σ, and {:.2} σ is left without it: a place is missing, was dark, or has moved",
                    chosen.held_out, self.held_out_without
                )
            });
        }
        if ratio > limit {
            return Some(format!(
                "it predicts held-out pixels {ratio:.2} times as badly as no guide"
            ));
        }
        // A gain field explains many pictures of other scenes; one of the right scene at rest is near them already.
        let motion = self.trials.iter().filter(|t| t.model == GuideModel::Motion);
        let motion = motion.map(|t| t.held_out).fold(f64::INFINITY, f64::min);
        let is_named = motion.is_infinite();
        (chosen.model == GuideModel::Gain && !is_named && motion < MOTION_MARGIN * chosen.held_out)
            .then(|| "neither motion nor changes of brightness explain the frame".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trial(model: GuideModel, order: Option<usize>, held_out: f64) -> GuideTrial {
        GuideTrial {
            model,
            order,
            fitted: held_out,
            held_out,
        }
    }

    #[test]
    fn a_gain_field_needs_a_clear_lead_and_a_richer_motion_a_gain() {
        let moving = [
            trial(GuideModel::Still, None, 5.9),
            trial(GuideModel::Motion, Some(2), 1.201),
            trial(GuideModel::Motion, Some(3), 1.200),
            trial(GuideModel::Gain, None, 1.1),
        ];
        assert_eq!(choose(&moving), 1);
        let flickering = [
            trial(GuideModel::Still, None, 17.0),
            trial(GuideModel::Motion, Some(2), 5.0),
            trial(GuideModel::Gain, None, 1.7),
        ];
        assert_eq!(choose(&flickering), 2);
        let at_rest = [
            trial(GuideModel::Still, None, 1.01),
            trial(GuideModel::Motion, Some(2), 1.02),
        ];
        assert_eq!(choose(&at_rest), 0);
    }

    #[test]
    fn places_that_do_not_explain_the_frame_are_dropped() {
        let used = |held_out, held_out_without| {
            let trials = [trial(GuideModel::Places, None, held_out)];
            let evidence = Evidence {
                trials: &trials,
                held_out_without,
                correlation: 0.1,
                saturated: 0.0,
                deviation: 0.2,
            };
            evidence.verdict(&trials[0]).0
        };
        assert!(used(1.05, 4.5) && used(1.1, 0.9) && used(3.1, 4.5));
        assert!(!used(30.0, 4.5) && !used(78.0, 132.0) && !used(1.5, 1.4));
    }

    #[test]
    fn what_does_not_resemble_the_frame_is_dropped() {
        let trials = [trial(GuideModel::Motion, Some(2), 1.1)];
        let of = |correlation, held_out_without, saturated, deviation| {
            let evidence = Evidence {
                trials: &trials,
                held_out_without,
                correlation,
                saturated,
                deviation,
            };
            evidence.verdict(&trials[0]).0
        };
        assert!(of(0.8, 1.05, 0.0, 0.2));
        assert!(!of(0.2, 1.05, 0.0, 0.2));
        assert!(!of(0.8, 0.8, 0.0, 0.2));
        assert!(!of(0.8, 1.05, 0.2, 0.2));
        assert!(!of(0.8, 1.05, 0.0, 1.1));
    }
}
