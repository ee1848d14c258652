//! The still part of a dense video and its change, apart.

use rowburst::{Shape, Video};

use super::{CaptionedFigure, Section, Videos, unobserved, unobserved_text};
use crate::ReportInput;
use crate::colour::{Map, UNOBSERVED};
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{TimeUnit, number};
use crate::panel::{colour_bar, put};
use crate::pixels::{LONGEST_SIDE, Plane};
use crate::stats::display_high;

/// Part of a video's power in its mean over time from which the two are shown apart; smaller shows sparse scenes, of which
/// little is still.
const STILL_PART: f64 = 0.5;
/// Frames whose change is shown.
const FRAMES: usize = 3;

/// The mean over time, and the video less that mean at some times; `None` for a video of which most changes.
pub(super) fn draw(input: &ReportInput, videos: &Videos) -> Option<CaptionedFigure> {
    let (video, shape) = (videos.video, videos.video.shape());
    let mean = mean_of(video);
    let power = |values: &[f32]| -> f64 { values.iter().map(|v| f64::from(*v).powi(2)).sum() };
    let part = shape.bins as f64 * power(&mean) / power(video.data());
    if part.is_nan() || part < STILL_PART {
        return None;
    }
    let change = |bin: usize| -> Vec<f32> {
        let pairs = video.bin(bin).iter().zip(&mean);
        pairs.map(|(v, m)| v - m).collect()
    };
    let count = FRAMES.min(shape.bins);
    let bins = (0..count).map(|i| (2 * i + 1) * shape.bins / (2 * count));
    let changes: Vec<(usize, Vec<f32>)> = bins.map(|bin| (bin, change(bin))).collect();
    let sizes: Vec<f32> = changes
        .iter()
        .flat_map(|(_, c)| c.iter().map(|c| c.abs()))
        .collect();
    let half = display_high(&sizes);

    let mut figure = Figure::new(800.0, 0.0);
    let (head, gap, bar) = (22.0, 8.0, 74.0);
    let cell = (800.0 - 2.0 * bar - gap * FRAMES as f64) / (FRAMES as f64 + 1.0);
    let still = plane(shape, &mean).coloured(Map::Light, 0.0, videos.high);
    let available = Rect::new(0.0, head, cell, 1.6 * cell);
    let mut place = put(&mut figure, available, still);
    let title = |figure: &mut Figure, place: Rect, text: &str| {
        figure.text(
            place.x + place.width / 2.0,
            14.0,
            Anchor::Middle,
            "strong",
            text,
        );
    };
    title(&mut figure, place, "mean over time");
    colour_bar(&mut figure, place, Map::Light, (0.0, videos.high), "");
    let step_us = input.time.bin_duration_us();
    let unit = TimeUnit::of(input.time.bins() as f64 * step_us);
    for (i, (bin, change)) in changes.iter().enumerate() {
        let x = cell + bar + gap + i as f64 * (cell + gap);
        let mut pixels = plane(shape, change).coloured(Map::Signed, -half, half);
        if let Some(mask) = unobserved(input, *bin) {
            let size = (shape.rows, shape.columns);
            pixels = pixels.marked(&mask, size, LONGEST_SIDE, UNOBSERVED);
        }
        place = put(&mut figure, Rect::new(x, head, cell, 1.6 * cell), pixels);
        title(
            &mut figure,
            place,
            &unit.stamp(*bin as f64 * step_us, step_us),
        );
    }
    colour_bar(&mut figure, place, Map::Signed, (-half, half), "");
    figure.set_height(place.bottom().max(head + 90.0) + 8.0);
    Some(CaptionedFigure {
        name: "change",
        section: Section::Video,
        figure,
        caption: format!(
            "The still part and the change apart: the mean of the video over time, and the video less that mean at {count} \
             times. The mean holds {} % of the power. Brightness in the units of the frame per unit of PSF sum. A good one \
             has the change where things move and nowhere else; where the frame tells too little of it, only the mean is \
             to be believed.{}",
            number(100.0 * part, 3),
            unobserved_text(input, " (slate)")
        ),
        alt: "The mean of the video over time, and its deviation from the mean at several times."
            .into(),
    })
}

fn plane(shape: Shape, values: &[f32]) -> Plane<'_> {
    Plane::reduced(shape.rows, shape.columns, values, LONGEST_SIDE)
}

/// The mean over time; values that are not finite count as zero.
fn mean_of(video: &Video) -> Vec<f32> {
    let shape = video.shape();
    let mut sums = vec![0.0f64; shape.pixels()];
    for t in 0..shape.bins {
        let pairs = sums.iter_mut().zip(video.bin(t));
        pairs.for_each(|(sum, v)| *sum += if v.is_finite() { f64::from(*v) } else { 0.0 });
    }
    let mean = |sum: f64| (sum / shape.bins as f64) as f32;
    sums.into_iter().map(mean).collect()
}
