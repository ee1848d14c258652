//! The same light seen by a fast detector, laid over a trace.
//!
//! The detector's clock, gain and offset are its own: the time shift is that of the highest
//! correlation with the trace, gain and offset those of least squares. What the camera saw is the
//! detector's signal averaged over each bin.

use super::Trace;
use rowburst_core::error::Subject;
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::TimeGrid;

/// A signal over time, straight between its points.
#[derive(Debug, Clone, PartialEq)]
pub struct Photodiode {
    times_us: Vec<f64>,
    values: Vec<f64>,
    /// Integral from the first point to each.
    integrals: Vec<f64>,
}

/// A photodiode's signal laid over a trace.
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// The trace that it fits best.
    pub trace: usize,
    /// Correlation with it, −1…1.
    pub correlation: f64,
    /// To be added to the signal's times.
    pub shift_us: f64,
    /// Units of the trace per unit of the signal.
    pub gain: f64,
    /// Trace where the signal is zero.
    pub offset: f64,
}

/// Least part of the bins that the signal must cover.
const MIN_OVERLAP: f64 = 0.5;
/// Steps of the shift in a bin.
const STEPS_PER_BIN: f64 = 16.0;
/// Correlations that are closer than this part of `1 − r` are alike: a periodic signal fits at many
/// shifts, and the smallest is meant.
const TIE_FRACTION: f64 = 0.5;
/// The least and the most that two alike correlations may differ.
const MIN_TIE: f64 = 0.002;
const MAX_TIE: f64 = 0.02;

impl Photodiode {
    /// A signal through `(time_us, value)`.
    ///
    /// # Errors
    /// Fewer than two points, times that do not increase, values that are not finite.
    pub fn new(points: &[(f64, f64)]) -> Result<Self> {
        if points.len() < 2 {
            return Err(Error::input(
                Parameter::Photodiode,
                format!("{} points", points.len()),
                "a signal has at least two points",
                "Give a line time,value for each sample.",
            ));
        }
        for (i, &(time, value)) in points.iter().enumerate() {
            let is_later = i == 0 || time > points[i - 1].0;
            if !(time.is_finite() && value.is_finite() && is_later) {
                return Err(Error::input(
                    Subject::element(Parameter::Photodiode, "photodiode, sample", i),
                    format!("time {time} µs, value {value}"),
                    "times increase from sample to sample, and all numbers are finite",
                    "Sort the samples by time and take out those that are not numbers.",
                ));
            }
        }
        let mut integrals = vec![0.0];
        for pair in points.windows(2) {
            let area = 0.5 * (pair[0].1 + pair[1].1) * (pair[1].0 - pair[0].0);
            integrals.push(integrals[integrals.len() - 1] + area);
        }
        Ok(Self {
            times_us: points.iter().map(|p| p.0).collect(),
            values: points.iter().map(|p| p.1).collect(),
            integrals,
        })
    }

    /// Its points, `(time_us, value)`.
    pub fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        self.times_us
            .iter()
            .copied()
            .zip(self.values.iter().copied())
    }

    /// Mean over the bins of `time`, the signal shifted by `shift_us`; `None` where it does not
    /// cover a bin.
    fn binned(&self, time: &TimeGrid, shift_us: f64) -> Vec<Option<f64>> {
        let step = time.bin_duration_us();
        let (first, last) = (self.times_us[0], self.times_us[self.times_us.len() - 1]);
        // A sample stands for the time about it.
        let slack = 0.5 * (last - first) / (self.times_us.len() - 1) as f64 + 1e-6 * step;
        let mean = |t: usize| {
            let from = time.start_us() + t as f64 * step - shift_us;
            let to = from + step;
            let covered = from >= first - slack && to <= last + slack;
            let (from, to) = (from.max(first), to.min(last));
            (covered && to > from).then(|| (self.integral(to) - self.integral(from)) / (to - from))
        };
        (0..time.bins()).map(mean).collect()
    }

    fn integral(&self, time: f64) -> f64 {
        let at = self.times_us.partition_point(|&t| t <= time);
        let i = at.clamp(1, self.times_us.len() - 1) - 1;
        let span = self.times_us[i + 1] - self.times_us[i];
        let part = (time - self.times_us[i]) / span;
        let value = self.values[i] + 0.5 * part * (self.values[i + 1] - self.values[i]);
        self.integrals[i] + value * part * span
    }

    /// Lays the signal over that of `traces` that it fits best; `None` where it covers less than
    /// half of the bins at every shift, or no trace changes.
    pub fn align(&self, traces: &[Trace], time: &TimeGrid) -> Option<Alignment> {
        let step = time.bin_duration_us();
        let (first, last) = (self.times_us[0], self.times_us[self.times_us.len() - 1]);
        let length = step * time.bins() as f64;
        let video_start = time.start_us();
        let overlap = MIN_OVERLAP * length.min(last - first);
        let (low, high) = (
            video_start + overlap - last,
            video_start + length - overlap - first,
        );
        let count = ((high - low) * STEPS_PER_BIN / step).ceil().max(0.0) as usize + 1;
        // Shift 0 is among them.
        let start = (low * STEPS_PER_BIN / step).ceil() * step / STEPS_PER_BIN;
        let fits: Vec<(f64, Vec<Option<Fit>>)> = (0..count)
            .map(|k| {
                let shift = start + k as f64 * step / STEPS_PER_BIN;
                let binned = self.binned(time, shift);
                let fit = |trace: &Trace| Fit::of(&binned, &trace.debiased);
                (shift, traces.iter().map(fit).collect())
            })
            .collect();
        let best_of = |trace: usize| {
            let known = fits.iter().filter_map(|(_, fits)| fits[trace]);
            known
                .map(|fit| fit.correlation)
                .fold(f64::NEG_INFINITY, f64::max)
        };
        let trace = (0..traces.len()).max_by(|&a, &b| best_of(a).total_cmp(&best_of(b)))?;
        let best = best_of(trace);
        if !best.is_finite() {
            return None;
        }
        let enough = best - (TIE_FRACTION * (1.0 - best)).clamp(MIN_TIE, MAX_TIE);
        let correlation = |k: usize| fits[k].1[trace].map_or(f64::NEG_INFINITY, |f| f.correlation);
        // A maximum as good as the best, and nearest to no shift at all.
        let is_peak = |&k: &usize| {
            let here = correlation(k);
            here >= enough
                && (k == 0 || correlation(k - 1) <= here)
                && (k + 1 == fits.len() || correlation(k + 1) <= here)
        };
        let peak = (0..fits.len())
            .filter(is_peak)
            .min_by(|&a, &b| fits[a].0.abs().total_cmp(&fits[b].0.abs()))?;
        let shift_us = self.refined(fits[peak].0, step / STEPS_PER_BIN, time, &traces[trace]);
        let fit = Fit::of(&self.binned(time, shift_us), &traces[trace].debiased)?;
        Some(Alignment {
            trace,
            correlation: fit.correlation,
            shift_us,
            gain: fit.gain,
            offset: fit.offset,
        })
    }

    /// The shift of the highest correlation within `reach` of `about`.
    fn refined(&self, about: f64, reach: f64, time: &TimeGrid, trace: &Trace) -> f64 {
        let value = |shift: f64| {
            Fit::of(&self.binned(time, shift), &trace.debiased)
                .map_or(f64::NEG_INFINITY, |f| f.correlation)
        };
        let (mut low, mut high) = (about - reach, about + reach);
        for _ in 0..30 {
            let third = (high - low) / 3.0;
            if value(low + third) < value(high - third) {
                low += third;
            } else {
                high -= third;
            }
        }
        let middle = 0.5 * (low + high);
        if value(middle) > value(about) {
            middle
        } else {
            about
        }
    }
}

/// A straight line from the signal to the trace.
#[derive(Debug, Clone, Copy)]
struct Fit {
    correlation: f64,
    gain: f64,
    offset: f64,
}

impl Fit {
    /// `None` where fewer than half of the bins are covered, or one side does not change.
    fn of(signal: &[Option<f64>], trace: &[f64]) -> Option<Self> {
        let pairs: Vec<(f64, f64)> = signal
            .iter()
            .zip(trace)
            .filter_map(|(s, t)| s.map(|s| (s, *t)))
            .collect();
        if pairs.len() < 3 || (pairs.len() as f64) < MIN_OVERLAP * trace.len() as f64 {
            return None;
        }
        let n = pairs.len() as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / n;
        let (x, y) = (mean(|p| p.0), mean(|p| p.1));
        let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
        for (s, t) in &pairs {
            xx += (s - x).powi(2);
            yy += (t - y).powi(2);
            xy += (s - x) * (t - y);
        }
        let flat = |sum: f64, mean: f64| sum <= 1e-18 * n * mean * mean || sum <= 0.0;
        if flat(xx, x) || flat(yy, y) {
            return None;
        }
        let gain = xy / xx;
        Some(Self {
            correlation: xy / (xx * yy).sqrt(),
            gain,
            offset: y - gain * x,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::traces::Region;

    const REGION: Region = Region {
        y: 0,
        x: 0,
        rows: 1,
        columns: 1,
    };

    fn grid() -> TimeGrid {
        TimeGrid::rolling(54, 9.6, 1.0, 1)
    }

    fn trace(value: impl Fn(f64) -> f64) -> Trace {
        // The mean over a bin by many points.
        let mean = |n: usize| {
            (0..200)
                .map(|k| value(9.6 * (n as f64 + (f64::from(k) + 0.5) / 200.0)))
                .sum::<f64>()
                / 200.0
        };
        let debiased: Vec<f64> = (0..54).map(mean).collect();
        Trace {
            region: REGION,
            value: debiased.clone(),
            standard_error: vec![0.01; 54],
            debiased,
        }
    }

    fn signal(value: impl Fn(f64) -> f64, from_us: f64) -> Photodiode {
        let points: Vec<(f64, f64)> = (0..1080)
            .map(|k| from_us + 0.48 * (f64::from(k) + 0.5))
            .map(|t| (t, value(t)))
            .collect();
        Photodiode::new(&points).unwrap()
    }

    #[test]
    fn clock_gain_and_offset_are_found() {
        let light = |t: f64| {
            0.3 + (-((t - 200.0) / 40.0).powi(2)).exp()
                + 0.5 * (-((t - 350.0) / 25.0).powi(2)).exp()
        };
        let other = |t: f64| 0.2 + 0.1 * (t / 30.0).sin();
        let traces = [trace(other), trace(light)];
        let late = signal(|t| 5.0 * light(t - 37.3) - 1.0, 0.0);
        let found = late.align(&traces, &grid()).unwrap();
        assert_eq!(found.trace, 1);
        assert!((found.shift_us + 37.3).abs() < 0.3, "{found:?}");
        assert!((found.gain - 0.2).abs() < 2e-3 && (found.offset - 0.2).abs() < 2e-3);
        assert!(found.correlation > 0.9999);
    }

    #[test]
    fn a_periodic_signal_is_shifted_as_little_as_possible() {
        let square = |t: f64| f64::from((t / 48.0).fract() < 0.5);
        let found = signal(square, 0.0)
            .align(&[trace(square)], &grid())
            .unwrap();
        assert!(
            found.shift_us.abs() < 0.3 && found.correlation > 0.999,
            "{found:?}"
        );
        // A clock that began 3 periods and a bit earlier.
        let early = signal(|t| square(t + 6.0), -3.0 * 48.0);
        let found = early.align(&[trace(square)], &grid()).unwrap();
        assert!((found.shift_us - 6.0).abs() < 0.4, "{found:?}");
    }

    #[test]
    fn nothing_to_align() {
        let flat = trace(|_| 1.0);
        assert_eq!(signal(|t| t, 0.0).align(&[flat], &grid()), None);
        assert_eq!(signal(|t| t, 0.0).align(&[], &grid()), None);
        let short = Photodiode::new(&[(0.0, 1.0), (20.0, 2.0)]).unwrap();
        assert_eq!(short.align(&[trace(|t| t)], &grid()), None);
    }

    #[test]
    fn bad_signals_are_refused() {
        for bad in [
            &[(0.0, 1.0)][..],
            &[(0.0, 1.0), (0.0, 2.0)],
            &[(0.0, 1.0), (1.0, f64::NAN)],
        ] {
            assert!(Photodiode::new(bad).is_err());
        }
    }
}
