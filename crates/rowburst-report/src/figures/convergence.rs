//! The course of the solver.

use super::{CaptionedFigure, Section};
use crate::Iteration;
use crate::chart::{Axis, Chart, Labels};
use crate::figure::{Anchor, Figure, Rect};
use crate::format::number;

/// What a panel shows, and its label.
type Quantity = (&'static str, fn(&Iteration) -> f64);

/// Draws residual, change and PSNR (or objective) against iterations; nothing for fewer
/// than two of them.
pub(super) fn draw(iterations: &[Iteration]) -> Option<CaptionedFigure> {
    let (first, last) = (iterations.first()?, iterations.last()?);
    if iterations.len() < 2 {
        return None;
    }
    let mut figure = Figure::new(800.0, 308.0);
    let has_psnr = iterations.iter().any(|i| i.psnr_db.is_some());
    let third: Quantity = if has_psnr {
        ("PSNR (dB)", |i| i.psnr_db.unwrap_or(f64::NAN))
    } else {
        ("objective", |i| i.objective)
    };
    let panels: [Quantity; 3] = [
        ("residual/σ", |i| i.residual_over_sigma),
        ("relative change", |i| i.change),
        third,
    ];
    let (from, to) = (first.iteration as f64, last.iteration as f64);
    let mut has_seconds = false;
    for (i, (label, value)) in panels.into_iter().enumerate() {
        let values = iterations.iter().map(value);
        let mut chart = Chart {
            place: Rect::new(60.0 + 270.0 * i as f64, 48.0, 186.0, 210.0),
            x: Axis::linear(from, to, "iteration"),
            y: Axis::about(values, label),
        };
        if i == 0 {
            let with_one = iterations.iter().map(value).chain([1.0]);
            chart.y = Axis::about(with_one, label);
        }
        chart.frame(&mut figure, Labels::Both);
        has_seconds = seconds(&mut figure, &chart, iterations);
        if i == 0 {
            let one = [(from, 1.0), (to, 1.0)];
            chart.curve(&mut figure, &one, "reference", r#"stroke-dasharray="4 3""#);
        }
        let points: Vec<_> = (iterations.iter())
            .map(|it| (it.iteration as f64, value(it)))
            .collect();
        chart.curve(&mut figure, &points, "line", "");
    }
    let mut caption = format!(
        "Convergence over {} iterations and {} s{}: residual/σ, relative \
         change of the video from one iteration to the next, and {}. In a good run residual/σ \
         settles at 1 (dashed) and all curves level off or keep falling.",
        last.iteration,
        number(last.seconds, 3),
        if has_seconds { " (upper axis)" } else { "" },
        if has_psnr {
            "PSNR against the truth"
        } else {
            "the objective"
        },
    );
    if has_psnr {
        caption += &format!(" Final objective: {}.", number(last.objective, 4));
    }
    Some(CaptionedFigure {
        name: "convergence",
        section: Section::Fit,
        figure,
        caption,
        alt: format!(
            "Three curves against iterations; the last residual/σ is {}.",
            number(last.residual_over_sigma, 3)
        ),
    })
}

/// Least distance of the ticks of the upper axis, in units of the figure.
const LEAST_DISTANCE: f64 = 46.0;

/// An upper axis in seconds: its end, and ticks where the iterations have come to round times, as far as there is room
/// between them. Returns whether it was drawn.
fn seconds(figure: &mut Figure, chart: &Chart, iterations: &[Iteration]) -> bool {
    let end = iterations.last().map_or(0.0, |i| i.seconds);
    if !(end.is_finite() && end > 0.0) {
        return false;
    }
    let (y, right) = (chart.place.y, chart.place.right());
    let mut ticks = vec![(right, number(end, 2))];
    let mut last = right;
    for (seconds, text) in Axis::linear(0.0, end, "").ticks(3).into_iter().rev() {
        let Some(at) = iteration_at(iterations, seconds) else {
            continue;
        };
        let (x, _) = chart.at(at, f64::NAN);
        if last - x >= LEAST_DISTANCE {
            ticks.push((x, text));
            last = x;
        }
    }
    for (x, text) in ticks {
        figure.line(&[(x, y), (x, y - 5.0)], "axis", "");
        figure.text(x, y - 9.0, Anchor::Middle, "muted", &text);
    }
    let middle = chart.place.x + chart.place.width / 2.0;
    figure.text(middle, y - 26.0, Anchor::Middle, "muted", "time (s)");
    true
}

/// The iteration, with its part, that was reached after `seconds`; `None` before the first.
fn iteration_at(iterations: &[Iteration], seconds: f64) -> Option<f64> {
    let after = iterations.partition_point(|i| i.seconds < seconds);
    let b = iterations.get(after)?;
    if after == 0 {
        return (seconds >= b.seconds).then_some(b.iteration as f64);
    }
    let a = &iterations[after - 1];
    let part = (seconds - a.seconds) / (b.seconds - a.seconds).max(f64::MIN_POSITIVE);
    Some(a.iteration as f64 + part.clamp(0.0, 1.0) * (b.iteration as f64 - a.iteration as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The texts of the upper axis where `seconds` gives the time of each iteration.
    fn upper_axis(seconds: impl Fn(usize) -> f64) -> (bool, Vec<f64>) {
        let iterations: Vec<Iteration> = (1..=100)
            .map(|i| Iteration {
                iteration: i,
                seconds: seconds(i),
                objective: 1.0,
                residual_over_sigma: 1.0,
                change: 0.1,
                psnr_db: None,
            })
            .collect();
        let chart = Chart {
            place: Rect::new(60.0, 48.0, 186.0, 210.0),
            x: Axis::linear(1.0, 100.0, ""),
            y: Axis::linear(0.0, 1.0, ""),
        };
        let mut figure = Figure::new(300.0, 300.0);
        let is_drawn = self::seconds(&mut figure, &chart, &iterations);
        let svg = figure.svg("a", "").unwrap();
        let ticks = svg.split("<polyline class=\"axis\"").skip(1);
        let x = ticks.map(|t| {
            let points = t.split("points=\"").nth(1).unwrap();
            points.split(',').next().unwrap().parse().unwrap()
        });
        (is_drawn, x.collect())
    }

    #[test]
    fn the_upper_axis_is_there_and_its_ticks_do_not_meet() {
        // Even steps, a long set-up before the first iteration, and one that takes nearly all the time.
        for seconds in [
            (|i: usize| 0.01 * i as f64) as fn(usize) -> f64,
            |i: usize| 30.0 + 1e-3 * i as f64,
            |i: usize| if i < 95 { 1e-4 * i as f64 } else { i as f64 },
        ] {
            let (is_drawn, mut x) = upper_axis(seconds);
            assert!(is_drawn && !x.is_empty());
            x.sort_by(f64::total_cmp);
            assert!(
                x.windows(2).all(|w| w[1] - w[0] >= LEAST_DISTANCE - 0.1),
                "{x:?}"
            );
        }
        assert!(!upper_axis(|_| f64::NAN).0);
    }
}
