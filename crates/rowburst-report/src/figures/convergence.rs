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
    let mut figure = Figure::new(800.0, 300.0);
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
    for (i, (label, value)) in panels.into_iter().enumerate() {
        let values = iterations.iter().map(value);
        let mut chart = Chart {
            place: Rect::new(60.0 + 270.0 * i as f64, 40.0, 186.0, 210.0),
            x: Axis::linear(from, to, "iteration"),
            y: Axis::about(values, label),
        };
        if i == 0 {
            let with_one = iterations.iter().map(value).chain([1.0]);
            chart.y = Axis::about(with_one, label);
        }
        chart.frame(&mut figure, Labels::Both);
        seconds(&mut figure, &chart, iterations);
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
        "Convergence over {} iterations and {} s (upper axis): residual/σ, relative \
         change of the video from one iteration to the next, and {}. In a good run residual/σ \
         settles at 1 (dashed) and all curves level off or keep falling.",
        last.iteration,
        number(last.seconds, 3),
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

/// An upper axis in seconds: ticks where the iterations have come to round times.
fn seconds(figure: &mut Figure, chart: &Chart, iterations: &[Iteration]) {
    let end = iterations.last().map_or(0.0, |i| i.seconds);
    if !(end.is_finite() && end > 0.0) {
        return;
    }
    for (seconds, text) in Axis::linear(0.0, end, "").ticks(3) {
        let after = iterations.partition_point(|i| i.seconds < seconds);
        let Some(b) = iterations.get(after) else {
            continue;
        };
        let a = if after == 0 {
            b
        } else {
            &iterations[after - 1]
        };
        if after == 0 && seconds < b.seconds {
            continue;
        }
        let part = (seconds - a.seconds) / (b.seconds - a.seconds).max(f64::MIN_POSITIVE);
        let at =
            a.iteration as f64 + part.clamp(0.0, 1.0) * (b.iteration as f64 - a.iteration as f64);
        let (x, _) = chart.at(at, f64::NAN);
        let y = chart.place.y;
        figure.line(&[(x, y), (x, y - 5.0)], "axis", "");
        figure.text(x, y - 9.0, Anchor::Middle, "muted", &format!("{text} s"));
    }
}
