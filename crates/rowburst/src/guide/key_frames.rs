//! Guides with their times, and how a motion follows time.

use super::basis::beam_mode;
use rowburst_optics::Image;

/// Part of the greatest value from which on pixels tell the brightness of a guide.
const BRIGHT_PART: f32 = 0.1;

/// A guide on the grid of the field.
#[derive(Clone)]
pub(super) struct KeyFrame {
    /// The picture.
    pub image: Image,
    /// First and last bin of its exposure, as fractions of bins; `None`: its time is unknown.
    pub bins: Option<(f64, f64)>,
}

/// `τ_k(t_i)` of a guide, the mean over its exposure; 0 where its time is unknown.
pub(super) fn time_of(guide: &KeyFrame, k: usize, bins: usize) -> f64 {
    let Some((from, to)) = guide.bins else {
        return 0.0;
    };
    let samples = 9;
    let place = |s: usize| from + (to - from) * s as f64 / f64::from(samples - 1);
    let sum: f64 = (0..samples as usize)
        .map(|s| beam_mode(k, place(s), bins))
        .sum();
    sum / f64::from(samples)
}

/// Index of the guide whose time is nearest to the middle of the video.
pub(super) fn nearest_to_middle(guides: &[KeyFrame], bins: usize) -> usize {
    let middle = 0.5 * (bins as f64 - 1.0);
    let distance = |i: &usize| {
        let bins = guides[*i].bins;
        bins.map_or(0.0, |(from, to)| (0.5 * (from + to) - middle).abs())
    };
    let nearest = (0..guides.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.expect("at least one guide")
}

/// Gives the guide `reference`, which has light, the greatest value 1, and the others its brightness: the median of the ratios of
/// their pixels is 1. Returns what the guide `reference` was divided by.
pub(super) fn normalise(guides: &mut [KeyFrame], reference: usize) -> f32 {
    let peak = guides[reference].image.max();
    let pixels: Vec<f32> = guides[reference].image.data().to_vec();
    for guide in guides {
        let pairs = guide.image.data().iter().zip(&pixels);
        let bright = pairs.filter(|(_, r)| **r > BRIGHT_PART * peak);
        let mut ratios: Vec<f32> = bright.map(|(value, r)| value / r).collect();
        let middle = ratios.len() / 2;
        let (_, ratio, _) = ratios.select_nth_unstable_by(middle, f32::total_cmp);
        let divisor = if *ratio > 0.0 { peak * *ratio } else { peak };
        guide
            .image
            .data_mut()
            .iter_mut()
            .for_each(|p| *p /= divisor);
    }
    peak
}

/// Weight of each guide in each bin: linear between the times of neighbouring guides.
pub(super) fn shares(guides: &[KeyFrame], bins: usize) -> Vec<Vec<f32>> {
    let middle = |g: &KeyFrame| g.bins.map_or(0.0, |(from, to)| 0.5 * (from + to));
    let times: Vec<f64> = guides.iter().map(middle).collect();
    let share = |i: usize, t: f64| {
        let before = times.iter().filter(|s| **s < times[i]).copied();
        let after = times.iter().filter(|s| **s > times[i]).copied();
        let before = before.fold(f64::NEG_INFINITY, f64::max);
        let after = after.fold(f64::INFINITY, f64::min);
        if t < times[i] && before.is_finite() {
            ((t - before) / (times[i] - before)).max(0.0)
        } else if t > times[i] && after.is_finite() {
            ((after - t) / (after - times[i])).max(0.0)
        } else {
            1.0
        }
    };
    (0..guides.len())
        .map(|i| (0..bins).map(|t| share(i, t as f64) as f32).collect())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn guides_get_the_brightness_of_the_one_nearest_to_the_middle() {
        let guide = |brightness: f32, object: usize, bin: f64| KeyFrame {
            image: Image::from_fn(10, 10, |y, x| {
                let light = if x == object {
                    3.0
                } else {
                    0.5 + 0.1 * y as f32
                };
                brightness * light
            }),
            bins: Some((bin, bin)),
        };
        let mut guides = [guide(1.0, 2, 0.0), guide(4.0, 5, 9.0), guide(0.3, 8, 19.0)];
        let reference = nearest_to_middle(&guides, 20);
        assert_eq!(reference, 1);
        assert!((normalise(&mut guides, reference) - 12.0).abs() < 1e-5);
        for guide in guides {
            assert!((guide.image.max() - 1.0).abs() < 1e-6);
            assert!((guide.image.at(4, 0) - 0.3).abs() < 1e-6);
        }
    }
}
