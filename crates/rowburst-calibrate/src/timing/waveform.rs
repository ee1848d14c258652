//! The light of the lamp over time, and what an exposure integrates of it.

use rowburst_core::{Error, Parameter, Result};

/// A light that is known over time: straight lines between points; two points at one
/// time are a step.
#[derive(Debug, Clone, PartialEq)]
pub struct Waveform {
    /// Times in microseconds, never falling.
    times_us: Vec<f64>,
    values: Vec<f64>,
    /// `∫` of the light from the first time to each point.
    integral: Vec<f64>,
    extension: Extension,
}

/// What the light does before the first and after the last point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extension {
    /// It keeps the first and the last value.
    Holds,
    /// It starts anew: the last time of one round is the first of the next.
    Repeats,
}

impl Waveform {
    /// A light through the points `(time in µs, value)`.
    ///
    /// # Errors
    /// Fewer than three points, values that are not finite, times that go back, or a
    /// light that does not change.
    pub fn new(points: &[(f64, f64)], extension: Extension) -> Result<Self> {
        let wrong = |found: String, rule: &'static str, remedy: &'static str| {
            Err(Error::input(Parameter::Signal, found, rule, remedy))
        };
        if points.len() < 3 {
            return wrong(
                format!("{} points", points.len()),
                "a light that changes has at least three",
                "Give a line time_us,value for every corner of the light's waveform.",
            );
        }
        if let Some(i) = points
            .iter()
            .position(|(t, v)| !(t.is_finite() && v.is_finite()))
        {
            return wrong(
                format!("({}, {}) as point {}", points[i].0, points[i].1, i + 1),
                "times and values are finite numbers",
                "Correct the line.",
            );
        }
        if let Some(i) = points.windows(2).position(|pair| pair[1].0 < pair[0].0) {
            return wrong(
                format!(
                    "{} µs after {} µs (points {} and {})",
                    points[i + 1].0,
                    points[i].0,
                    i + 1,
                    i + 2
                ),
                "times never go back",
                "Sort the lines by time.",
            );
        }
        let (low, high) = range(points.iter().map(|p| p.1));
        if high <= low || points[points.len() - 1].0 <= points[0].0 {
            return wrong(
                "a light that does not change".into(),
                "the light must change, or all rows look the same",
                "Give the waveform of a chirp or of two pulses of unequal length.",
            );
        }
        let mut integral = vec![0.0];
        for pair in points.windows(2) {
            let area = 0.5 * (pair[0].1 + pair[1].1) * (pair[1].0 - pair[0].0);
            integral.push(integral[integral.len() - 1] + area);
        }
        Ok(Self {
            times_us: points.iter().map(|p| p.0).collect(),
            values: points.iter().map(|p| p.1).collect(),
            integral,
            extension,
        })
    }

    /// First and last time in microseconds.
    pub fn span_us(&self) -> (f64, f64) {
        (self.times_us[0], self.times_us[self.times_us.len() - 1])
    }

    /// What it does beyond its points.
    pub fn extension(&self) -> Extension {
        self.extension
    }

    /// Mean light over the `exposure_us` that ends at `end_us` (Eq. 2).
    pub fn mean_over_exposure(&self, end_us: f64, exposure_us: f64) -> f64 {
        (self.integral_to(end_us) - self.integral_to(end_us - exposure_us)) / exposure_us
    }

    /// `∫` of the light from the first time to `t`.
    fn integral_to(&self, t: f64) -> f64 {
        let (first, last) = self.span_us();
        let n = self.times_us.len();
        match self.extension {
            Extension::Repeats => {
                let rounds = ((t - first) / (last - first)).floor();
                let inside = t - rounds * (last - first);
                rounds * self.integral[n - 1] + self.inside(inside)
            }
            Extension::Holds if t <= first => (t - first) * self.values[0],
            Extension::Holds if t >= last => self.integral[n - 1] + (t - last) * self.values[n - 1],
            Extension::Holds => self.inside(t),
        }
    }

    fn inside(&self, t: f64) -> f64 {
        let n = self.times_us.len();
        let i = self.times_us.partition_point(|&at| at <= t).clamp(1, n - 1) - 1;
        let (a, b) = (self.times_us[i], self.times_us[i + 1]);
        let part = if b > a { (t - a) / (b - a) } else { 1.0 };
        let reached = self.values[i] + 0.5 * part * (self.values[i + 1] - self.values[i]);
        self.integral[i] + reached * part * (b - a)
    }
}

/// Mean over an exposure of a square wave: everything in periods. The light is on from
/// 0 to `duty` of each period; the exposure ends at `end`.
pub(super) fn square_exposed(end: f64, exposure: f64, duty: f64) -> f64 {
    let until = |t: f64| t.floor() * duty + (t - t.floor()).min(duty);
    (until(end) - until(end - exposure)) / exposure
}

pub(super) fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exposure_is_the_mean_of_many_moments() {
        let points = [(0.0, 1.0), (4.0, 3.0), (4.0, 0.0), (10.0, 6.0)];
        let value = |t: f64, extension| match extension {
            Extension::Holds if t < 0.0 => 1.0,
            Extension::Holds if t >= 10.0 => 6.0,
            _ => {
                let t = t.rem_euclid(10.0);
                if t < 4.0 { 1.0 + 0.5 * t } else { t - 4.0 }
            }
        };
        for extension in [Extension::Holds, Extension::Repeats] {
            let waveform = Waveform::new(&points, extension).unwrap();
            for end in [-13.0, -2.0, 0.5, 3.0, 5.5, 9.9, 12.0, 31.0] {
                for exposure in [0.3, 2.5, 17.0] {
                    let steps = 20_000;
                    let mean: f64 = (0..steps)
                        .map(|i| {
                            let part = (f64::from(i) + 0.5) / f64::from(steps);
                            value(end - part * exposure, extension)
                        })
                        .sum::<f64>()
                        / f64::from(steps);
                    let got = waveform.mean_over_exposure(end, exposure);
                    assert!((got - mean).abs() < 2e-3, "{extension:?} {end} {exposure}");
                }
            }
        }
        for (end, exposure, mean) in [(0.3, 0.2, 1.0), (0.1, 0.2, 0.5), (0.9, 2.0, 0.4)] {
            let got = square_exposed(end, exposure, 0.4);
            assert!((got - mean).abs() < 1e-12, "{end} {got}");
        }
    }

    #[test]
    fn bad_signals_say_what_is_wrong() {
        let refused = |points: &[(f64, f64)], word: &str| {
            let error = Waveform::new(points, Extension::Holds)
                .unwrap_err()
                .to_string();
            assert!(error.contains(word), "{error}");
        };
        refused(&[(0.0, 1.0), (1.0, 0.0)], "2 points");
        refused(&[(0.0, 1.0), (1.0, f64::NAN), (2.0, 0.0)], "point 2");
        refused(&[(0.0, 1.0), (2.0, 0.0), (1.0, 0.0)], "never go back");
        refused(&[(0.0, 1.0), (2.0, 1.0), (3.0, 1.0)], "does not change");
    }
}
