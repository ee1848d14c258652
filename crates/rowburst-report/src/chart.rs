//! Axes and curves.

use crate::figure::{Anchor, Figure, Rect};
use crate::format::{number, raised};

/// An axis: its range, whether it is logarithmic, and its label with the unit.
#[derive(Debug, Clone)]
pub(crate) struct Axis {
    low: f64,
    high: f64,
    log: bool,
    label: String,
}

impl Axis {
    /// A linear axis; an empty range is widened.
    pub(crate) fn linear(low: f64, high: f64, label: impl Into<String>) -> Self {
        let high = if high > low { high } else { low + 1.0 };
        Self {
            low,
            high,
            log: false,
            label: label.into(),
        }
    }

    /// An axis about `values`: logarithmic where all that are finite are positive and
    /// span more than a decade, otherwise linear with a margin.
    pub(crate) fn about(values: impl Iterator<Item = f64> + Clone, label: &str) -> Self {
        let finite = values.filter(|v| v.is_finite());
        let low = finite.clone().fold(f64::INFINITY, f64::min);
        let high = finite.fold(f64::NEG_INFINITY, f64::max);
        if low > high {
            return Self::linear(0.0, 1.0, label);
        }
        if low > 0.0 && high / low > 10.0 {
            return Self {
                low: low / 1.3,
                high: high * 1.3,
                log: true,
                label: label.into(),
            };
        }
        let margin = if high > low {
            0.06 * (high - low)
        } else {
            0.5 * low.abs().max(1.0)
        };
        Self::linear(low - margin, high + margin, label)
    }

    /// A logarithmic axis.
    ///
    /// # Panics
    /// If an end is not positive.
    pub(crate) fn logarithmic(low: f64, high: f64, label: impl Into<String>) -> Self {
        assert!(low > 0.0, "a logarithm needs positive ends");
        Self {
            low,
            high: if high > low { high } else { 10.0 * low },
            log: true,
            label: label.into(),
        }
    }

    /// Position of `value`, 0 at the low end and 1 at the high one.
    pub(crate) fn fraction(&self, value: f64) -> f64 {
        if self.log {
            (value / self.low).ln() / (self.high / self.low).ln()
        } else {
            (value - self.low) / (self.high - self.low)
        }
    }

    /// What it measures, with the unit.
    pub(crate) fn label(&self) -> &str {
        &self.label
    }

    /// Values and texts of about `count` ticks.
    pub(crate) fn ticks(&self, count: usize) -> Vec<(f64, String)> {
        if self.log {
            return log_ticks(self.low, self.high, count);
        }
        let mut step = nice((self.high - self.low) / count.max(1) as f64);
        let ends = |step: f64| {
            (
                (self.low / step - 1e-9).ceil(),
                (self.high / step + 1e-9).floor(),
            )
        };
        if ends(step).1 - ends(step).0 < 1.0 {
            step = nice(step / 2.0);
        }
        let (first, last) = ends(step);
        (0..=(last - first).max(0.0) as usize)
            .map(|i| (first + i as f64) * step)
            .map(|v| if v.abs() < 1e-6 * step { 0.0 } else { v })
            .map(|v| {
                let decimals = (-step.log10().floor()).clamp(0.0, 9.0) as usize;
                let long = v.abs() >= 1e6 || (step < 1e-4 && v != 0.0);
                let text = if long {
                    number(v, 4)
                } else {
                    format!("{v:.decimals$}").replace('-', "−")
                };
                (v, text)
            })
            .collect()
    }
}

/// The number of 1, 2, 5·10ⁿ nearest to `step` (geometrically).
fn nice(step: f64) -> f64 {
    let decade = 10_f64.powf(step.log10().floor());
    let factor = match step / decade {
        f if f < 2_f64.sqrt() => 1.0,
        f if f < 10_f64.sqrt() => 2.0,
        f if f < 50_f64.sqrt() => 5.0,
        _ => 10.0,
    };
    factor * decade
}

fn log_ticks(low: f64, high: f64, count: usize) -> Vec<(f64, String)> {
    let (first, last) = (low.log10().ceil() as i32, high.log10().floor() as i32);
    let inside = |&(v, _): &(f64, String)| v >= low && v <= high;
    if (high / low).log10() >= 2.5 {
        let stride = ((last - first + 1) as usize).div_ceil(count.max(1));
        let tick = |e: i32| (10_f64.powi(e), format!("10{}", raised(e)));
        return (first..=last).step_by(stride.max(1)).map(tick).collect();
    }
    let tick = |e: i32, f: f64| (f * 10_f64.powi(e), number(f * 10_f64.powi(e), 3));
    (first - 1..=last)
        .flat_map(|e| [1.0, 2.0, 5.0].map(|f| tick(e, f)))
        .filter(inside)
        .collect()
}

/// A pair of axes in a place of a figure.
#[derive(Debug, Clone)]
pub(crate) struct Chart {
    pub place: Rect,
    pub x: Axis,
    pub y: Axis,
}

/// Which parts of the axes are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Labels {
    /// Ticks, numbers and labels of both axes.
    Both,
    /// Numbers of the y axis only: a strip above another.
    YOnly,
}

impl Chart {
    /// Position of a point in the figure, kept within the axes' place (with a little slack).
    pub(crate) fn at(&self, x: f64, y: f64) -> (f64, f64) {
        let [fx, fy] = [self.x.fraction(x), self.y.fraction(y)].map(|f| f.clamp(-0.01, 1.02));
        let place = &self.place;
        (
            place.x + fx * place.width,
            place.bottom() - fy * place.height,
        )
    }

    /// Draws grid, axes, ticks and labels.
    pub(crate) fn frame(&self, figure: &mut Figure, labels: Labels) {
        let place = self.place;
        let ticks_y = self
            .y
            .ticks((place.height / 40.0).round().clamp(2.0, 7.0) as usize);
        for (value, text) in ticks_y {
            let (_, y) = self.at(self.x.low, value);
            figure.line(&[(place.x, y), (place.right(), y)], "grid", "");
            figure.text(place.x - 6.0, y + 4.0, Anchor::End, "muted", &text);
        }
        for (value, text) in self
            .x
            .ticks((place.width / 80.0).round().clamp(2.0, 7.0) as usize)
        {
            let (x, _) = self.at(value, self.y.low);
            figure.line(&[(x, place.y), (x, place.bottom())], "grid", "");
            if labels == Labels::Both {
                figure.text(x, place.bottom() + 16.0, Anchor::Middle, "muted", &text);
            }
        }
        let corner = [
            (place.x, place.y),
            (place.x, place.bottom()),
            (place.right(), place.bottom()),
        ];
        figure.line(&corner, "axis", "");
        if labels == Labels::Both {
            let (middle, below) = (place.x + place.width / 2.0, place.bottom() + 34.0);
            figure.text(middle, below, Anchor::Middle, "", &self.x.label);
            let left = place.x - 46.0;
            figure.text_upwards(left, place.y + place.height / 2.0, "", &self.y.label);
        }
    }

    /// Fills between two curves with the same times; interrupted where a point of either cannot
    /// be drawn.
    pub(crate) fn band(&self, figure: &mut Figure, band: &[(f64, f64, f64)], style: &str) {
        let drawable = |&(x, low, high): &(f64, f64, f64)| {
            let (low, high) = (self.y.fraction(low), self.y.fraction(high));
            self.x.fraction(x).is_finite() && low.is_finite() && high.is_finite()
        };
        for run in band.split(|p| !drawable(p)) {
            let lower = run.iter().map(|&(x, low, _)| self.at(x, low));
            let upper = run.iter().rev().map(|&(x, _, high)| self.at(x, high));
            figure.area(&lower.chain(upper).collect::<Vec<_>>(), style);
        }
    }

    /// Draws a curve; it is interrupted where a point cannot be drawn. Long curves are
    /// thinned to the least and largest value of each of some hundred stretches.
    pub(crate) fn curve(
        &self,
        figure: &mut Figure,
        points: &[(f64, f64)],
        class: &str,
        style: &str,
    ) {
        let drawable = |&(x, y): &(f64, f64)| {
            let (x, y) = (self.x.fraction(x), self.y.fraction(y));
            x.is_finite() && y.is_finite()
        };
        for run in points.split(|p| !drawable(p)) {
            let path: Vec<_> = thinned(run)
                .into_iter()
                .map(|(x, y)| self.at(x, y))
                .collect();
            figure.line(&path, class, style);
        }
    }
}

fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    const MAX_SEGMENTS: usize = 700;
    if points.len() <= 2 * MAX_SEGMENTS {
        return points.to_vec();
    }
    let by_y = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
    points
        .chunks(points.len().div_ceil(MAX_SEGMENTS))
        .flat_map(|stretch| {
            let mut ends: Vec<(f64, f64)> =
                stretch.iter().min_by(by_y).copied().into_iter().collect();
            ends.extend(stretch.iter().max_by(by_y));
            ends.sort_by(|a, b| a.0.total_cmp(&b.0));
            ends
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(axis: &Axis, count: usize) -> Vec<String> {
        axis.ticks(count)
            .into_iter()
            .map(|(_, text)| text)
            .collect()
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(
            texts(&Axis::linear(0.0, 518.4, ""), 5),
            ["0", "100", "200", "300", "400", "500"]
        );
        assert_eq!(
            texts(&Axis::linear(-1.0, 1.0, ""), 4),
            ["−1.0", "−0.5", "0.0", "0.5", "1.0"]
        );
        assert_eq!(
            texts(&Axis::about([3.0, 3.0].into_iter(), ""), 2),
            ["2", "4"]
        );
        let log = Axis::about([0.9, 100.0].into_iter(), "");
        assert_eq!(texts(&log, 5), ["1", "2", "5", "10", "20", "50", "100"]);
        let log = Axis::about([1e-5, 1.0].into_iter(), "");
        assert_eq!(texts(&log, 3), ["10⁻⁵", "10⁻³", "10⁻¹"]);
    }

    #[test]
    fn degenerate_ranges_have_ticks() {
        for axis in [
            Axis::linear(0.0, 0.0, ""),
            Axis::about([f64::NAN, f64::INFINITY].into_iter(), ""),
            Axis::about(std::iter::empty(), ""),
            Axis::about([0.0].into_iter(), ""),
        ] {
            assert!(axis.ticks(4).len() > 1);
        }
    }

    #[test]
    fn thinning_keeps_extremes() {
        let mut points: Vec<(f64, f64)> = (0..100_000).map(|i| (f64::from(i), 0.0)).collect();
        points[77_777].1 = 9.0;
        let thin = thinned(&points);
        assert!(thin.len() < 1500 && thin.iter().any(|p| p.1 == 9.0));
    }
}
