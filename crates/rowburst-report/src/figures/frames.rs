//! Selected frames with their times, beside the truth.

use rowburst::{TimeGrid, Video};

use super::{Drawn, Section, Videos};
use crate::ReportInput;
use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{TimeUnit, rows};
use crate::panel::{colour_bar, fit, put};
use crate::pixels::Plane;

/// Longest side of a frame of the sheet, in pixels.
const FRAME_SIDE: usize = 512;
/// Scale of the difference row, as a share of the white point.
const DIFFERENCE: f32 = 0.25;

/// Draws the contact sheet.
pub(super) fn draw(input: &ReportInput, videos: &Videos) -> Drawn {
    let bins = videos.video.shape().bins;
    match videos.truth {
        Some(truth) => compared(input, videos, truth, &spread(bins, 6)),
        None => alone(input, videos, &spread(bins, 8)),
    }
}

/// `count` bins (or all, if fewer) spread evenly over the video.
fn spread(bins: usize, count: usize) -> Vec<usize> {
    let count = count.min(bins);
    (0..count)
        .map(|i| (2 * i + 1) * bins / (2 * count))
        .collect()
}

/// The rows of the frame that see `bin`, in ascending order.
fn rows_of_bin(instants: &[usize], time: &TimeGrid, bin: usize) -> Vec<usize> {
    let sees = |&row: &usize| {
        let weights = time.instants().get(instants[row]);
        weights.is_some_and(|w| {
            let at = bin.checked_sub(w.first_bin).and_then(|i| w.weights.get(i));
            at.is_some_and(|&weight| weight > 0.0)
        })
    };
    (0..instants.len()).filter(sees).collect()
}

fn stamp(figure: &mut Figure, input: &ReportInput, place: Rect, bin: usize) {
    let step_us = input.time.bin_duration_us();
    let unit = TimeUnit::of(input.time.bins() as f64 * step_us);
    let time = unit.stamp(bin as f64 * step_us, step_us);
    let middle = place.x + place.width / 2.0;
    figure.text(middle, place.y - 20.0, Anchor::Middle, "strong", &time);
    let read = rows(&rows_of_bin(input.instants, input.time, bin));
    figure.text(middle, place.y - 6.0, Anchor::Middle, "muted", &read);
}

/// Truth, reconstruction and difference, one below the other.
fn compared(input: &ReportInput, videos: &Videos, truth: &Video, bins: &[usize]) -> Drawn {
    let shape = videos.video.shape();
    let (left, top, gap) = (24.0, 40.0, 6.0);
    let cell = (800.0 - left - 74.0 - 5.0 * gap) / 6.0;
    let height = fit(
        Rect::new(0.0, 0.0, cell, 1.6 * cell),
        2.0,
        shape.rows,
        shape.columns,
    )
    .height;
    let mut figure = Figure::new(800.0, top + 3.0 * (height + gap) + 4.0);
    let half = DIFFERENCE * videos.high;
    for (row, name) in ["truth", "reconstruction", "difference"].iter().enumerate() {
        let y = top + row as f64 * (height + gap);
        let mut last = Rect::new(left, y, cell, height);
        for (i, &bin) in bins.iter().enumerate() {
            let room = Rect::new(left + i as f64 * (cell + gap), y, cell, 1.6 * cell);
            let difference: Vec<f32>;
            let (values, map, range) = match row {
                0 => (truth.bin(bin), Map::Light, (0.0, videos.high)),
                1 => (videos.video.bin(bin), Map::Light, (0.0, videos.high)),
                _ => {
                    let pairs = videos.video.bin(bin).iter().zip(truth.bin(bin));
                    difference = pairs.map(|(v, truth)| v - truth).collect();
                    (difference.as_slice(), Map::Signed, (-half, half))
                }
            };
            let plane = Plane::reduced(shape.rows, shape.columns, values, FRAME_SIDE);
            last = put(&mut figure, room, plane.coloured(map, range.0, range.1));
            if row == 0 {
                stamp(&mut figure, input, last, bin);
            }
        }
        figure.text_upwards(left - 8.0, y + height / 2.0, "strong", name);
        let (map, range) = match row {
            2 => (Map::Signed, (-half, half)),
            _ => (Map::Light, (0.0, videos.high)),
        };
        if row > 0 {
            colour_bar(&mut figure, last, map, range, "");
        }
    }
    Drawn {
        name: "frames",
        section: Section::Video,
        figure,
        caption: format!(
            "{} of {} frames: truth, reconstruction and their difference (reconstruction − truth, \
             on a quarter of the scale). Above each, the time at which its bin begins and the \
             rows that see it. Brightness in the units of the frame per unit of PSF sum. In a \
             good one the two upper rows look the same and the third is blank.",
            bins.len(),
            shape.bins
        ),
        alt:
            "Contact sheet of frames: truth above, reconstruction in the middle, difference below."
                .into(),
    }
}

/// The reconstruction alone, in rows of four.
fn alone(input: &ReportInput, videos: &Videos, bins: &[usize]) -> Drawn {
    let shape = videos.video.shape();
    let (top, gap) = (40.0, 8.0);
    let cell = (800.0 - 74.0 - 3.0 * gap) / 4.0;
    let height = fit(
        Rect::new(0.0, 0.0, cell, 1.4 * cell),
        2.0,
        shape.rows,
        shape.columns,
    )
    .height;
    let lines = bins.len().div_ceil(4) as f64;
    let mut figure = Figure::new(800.0, lines * (top + height + gap));
    for (i, &bin) in bins.iter().enumerate() {
        let (column, line) = ((i % 4) as f64, (i / 4) as f64);
        let y = top + line * (top + height + gap);
        let room = Rect::new(column * (cell + gap), y, cell, 1.4 * cell);
        let plane = Plane::reduced(shape.rows, shape.columns, videos.video.bin(bin), FRAME_SIDE);
        let place = put(
            &mut figure,
            room,
            plane.coloured(Map::Light, 0.0, videos.high),
        );
        stamp(&mut figure, input, place, bin);
        if i % 4 == 3 || i + 1 == bins.len() {
            colour_bar(&mut figure, place, Map::Light, (0.0, videos.high), "");
        }
    }
    Drawn {
        name: "frames",
        section: Section::Video,
        figure,
        caption: format!(
            "{} of {} reconstructed frames. Above each, the time at which its bin begins and the \
             rows that see it. Brightness in the units of the frame per unit of PSF sum. A good \
             one shows sharp objects on a dark, quiet ground.",
            bins.len(),
            shape.bins
        ),
        alt: "Contact sheet of reconstructed frames.".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_over_the_video() {
        assert_eq!(spread(54, 6), [4, 13, 22, 31, 40, 49]);
        assert_eq!(spread(2, 6), [0, 1]);
        assert_eq!(spread(1, 8), [0]);
    }

    #[test]
    fn rows_of_a_bin_follow_the_exposure() {
        let time = TimeGrid::rolling(4, 10.0, 2.0, 1);
        assert_eq!(rows_of_bin(&[0, 1, 2, 3], &time, 0), [0]);
        assert_eq!(rows_of_bin(&[0, 1, 2, 3], &time, 2), [1, 2]);
        assert_eq!(rows_of_bin(&[3, 2, 1, 0], &time, 4), [0]);
        assert!(rows_of_bin(&[9], &time, 0).is_empty());
    }
}
