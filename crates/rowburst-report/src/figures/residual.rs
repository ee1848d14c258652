//! The residual: its map, and its histogram against the unit Gaussian.

use super::{CaptionedFigure, Section, excluded, excluded_text, without};
use crate::ReportInput;
use crate::chart::{Axis, Chart, Labels};
use crate::colour::{LEFT_OUT, Map};
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{fixed, number};
use crate::panel::{PixelScale, bar_bottom, colour_bar, put, scale_bar};
use crate::pixels::{LONGEST_SIDE, Plane};
use crate::stats::moments;
use rowburst::Image;

/// Half the range of the map, and of the histogram.
const MAP_LIMIT_SIGMAS: f32 = 4.0;
const HISTOGRAM_LIMIT_SIGMAS: f64 = 5.0;

/// Draws the map and the histogram. Pixels that were left out are marked, and are not in the histogram.
pub(super) fn draw(input: &ReportInput) -> CaptionedFigure {
    drawn(
        input,
        input.residual,
        "residual",
        "The residual (b − A v)/σ of each pixel, dimensionless, and its histogram against the unit Gaussian (line): \
         mean {mean}, standard deviation {deviation}, {beyond} % beyond ±4. Structureless noise of width 1 means that the \
         model explains the frame; structure means that it does not, and a width below 1 means that noise was fitted.",
    )
}

/// Draws the same of the model before self-calibration.
pub(super) fn draw_before(input: &ReportInput, before: &Image) -> CaptionedFigure {
    drawn(
        input,
        before,
        "residual-before",
        "The residual (b − A v)/σ with PSF and camera as given, before the frame has corrected them: mean {mean}, standard \
         deviation {deviation}, {beyond} % beyond ±4. What is structure here and not in the residual after it is what the \
         correction explains.",
    )
}

fn drawn(input: &ReportInput, image: &Image, name: &'static str, caption: &str) -> CaptionedFigure {
    let mut figure = Figure::new(800.0, 0.0);
    let plane = Plane::reduced(image.rows(), image.columns(), image.data(), LONGEST_SIDE);
    let mut pixels = plane.coloured(Map::Signed, -MAP_LIMIT_SIGMAS, MAP_LIMIT_SIGMAS);
    if let Some(mask) = excluded(input) {
        let size = (image.rows(), image.columns());
        pixels = pixels.marked(mask, size, LONGEST_SIDE, LEFT_OUT);
    }
    let values = without(image.data(), excluded(input));
    let place = put(&mut figure, Rect::new(0.0, 4.0, 340.0, 420.0), pixels);
    figure.rect(place, "axis", "");
    colour_bar(
        &mut figure,
        place,
        Map::Signed,
        (-MAP_LIMIT_SIGMAS, MAP_LIMIT_SIGMAS),
        "(b − A v)/σ",
    );
    scale_bar(
        &mut figure,
        place,
        image.columns(),
        PixelScale::of_sensor(input.sensor),
    );
    let height = place.height.clamp(200.0, 300.0);
    histogram(&mut figure, Rect::new(500.0, 10.0, 290.0, height), &values);
    figure.set_height((bar_bottom(place) + 22.0).max(10.0 + height + 42.0));

    let m = moments(&values);
    let mut caption = caption
        .replace("{mean}", &fixed(m.mean))
        .replace("{deviation}", &fixed(m.deviation))
        .replace("{beyond}", &number(100.0 * m.beyond_four, 2));
    if m.non_finite > 0 {
        caption += &format!(" {} pixels that are not finite are grey.", m.non_finite);
    }
    caption += &excluded_text(input);
    CaptionedFigure {
        name,
        section: Section::Fit,
        figure,
        caption,
        alt: format!(
            "Map of the residual and its histogram; standard deviation {}.",
            fixed(m.deviation)
        ),
    }
}

/// Counts of the finite values in equal bins over ±[`HISTOGRAM_LIMIT_SIGMAS`], as densities.
fn densities(values: &[f32]) -> Vec<f64> {
    let finite = values.iter().filter(|v| v.is_finite());
    let total = finite.clone().count().max(1) as f64;
    let bins = if total < 1000.0 { 20 } else { 50 };
    let width = 2.0 * HISTOGRAM_LIMIT_SIGMAS / bins as f64;
    let mut counts = vec![0.0; bins];
    for &value in finite {
        let at = (f64::from(value) + HISTOGRAM_LIMIT_SIGMAS) / width;
        if at >= 0.0 && at < bins as f64 {
            counts[at as usize] += 1.0 / (total * width);
        }
    }
    counts
}

fn histogram(figure: &mut Figure, place: Rect, values: &[f32]) {
    let densities = densities(values);
    let gaussian = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
    let top = densities.iter().copied().fold(gaussian(0.0), f64::max);
    let chart = Chart {
        place,
        x: Axis::linear(
            -HISTOGRAM_LIMIT_SIGMAS,
            HISTOGRAM_LIMIT_SIGMAS,
            "(b − A v)/σ",
        ),
        y: Axis::linear(0.0, 1.08 * top, "density"),
    };
    chart.frame(figure, Labels::Both);
    let width = 2.0 * HISTOGRAM_LIMIT_SIGMAS / densities.len() as f64;
    for (i, &density) in densities.iter().enumerate().filter(|(_, d)| **d > 0.0) {
        let left = -HISTOGRAM_LIMIT_SIGMAS + i as f64 * width;
        let ((x, y), (right, bottom)) = (chart.at(left, density), chart.at(left + width, 0.0));
        let bar = Rect::new(x + 0.4, y, right - x - 0.8, bottom - y);
        figure.rect(bar, "bars", "");
    }
    let curve: Vec<(f64, f64)> = (-100..=100)
        .map(|i| f64::from(i) * HISTOGRAM_LIMIT_SIGMAS / 100.0)
        .map(|x| (x, gaussian(x)))
        .collect();
    chart.curve(figure, &curve, "line", "");
    let (x, y) = chart.at(1.25, gaussian(1.1));
    figure.text(x + 4.0, y, Anchor::Start, "muted", "unit Gaussian");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn densities_integrate_to_the_share_inside() {
        let values = [0.1, 0.2, -4.9, 7.0, f32::NAN];
        let densities = densities(&values);
        let sum: f64 = densities.iter().sum::<f64>() * 10.0 / densities.len() as f64;
        assert!((sum - 0.75).abs() < 1e-12);
        assert!((densities[10] - 1.0).abs() < 1e-12);
    }
}
