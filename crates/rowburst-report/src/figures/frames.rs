//! Selected frames with their times, beside the truth.

use rowburst::{Shape, TimeGrid, Video};

use super::{CaptionedFigure, Section, Videos, light_text, unobserved, unobserved_text};
use crate::ReportInput;
use crate::colour::{Map, UNOBSERVED};
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{TimeUnit, rows};
use crate::panel::{BAR_ROOM, LETTER, LINE, colour_bar, fit, put};
use crate::pixels::{Pixels, Plane};

/// Longest side of a frame of the sheet, in pixels.
const FRAME_SIDE: usize = 512;
/// Room over a frame beside the lines of its text.
const HEAD: f64 = 12.0;
/// Scale of the difference row, as a share of the white point.
const DIFFERENCE: f32 = 0.25;

/// Draws the contact sheet of the `chosen` bins, else of some that are spread over the video.
pub(super) fn draw(
    input: &ReportInput,
    videos: &Videos,
    chosen: Option<&[usize]>,
) -> CaptionedFigure {
    let count = if videos.truth.is_some() { 6 } else { 8 };
    let bins = chosen.map_or_else(|| spread(videos.video.shape().bins, count), <[_]>::to_vec);
    match videos.truth {
        Some(truth) => compared(input, videos, truth, &bins),
        None => alone(input, videos, &bins),
    }
}

/// `count` bins (or all, if fewer) spread evenly over the video.
pub(super) fn spread(bins: usize, count: usize) -> Vec<usize> {
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

/// The picture of bin `bin` of the reconstruction, in which voxels that the frame does not observe are marked.
fn reconstructed(input: &ReportInput, videos: &Videos, bin: usize) -> Pixels {
    let shape = videos.video.shape();
    let plane = Plane::reduced(shape.rows, shape.columns, videos.video.bin(bin), FRAME_SIDE);
    let pixels = plane.coloured(Map::Light, 0.0, videos.high);
    match unobserved(input, bin) {
        Some(mask) => pixels.marked(&mask, (shape.rows, shape.columns), FRAME_SIDE, UNOBSERVED),
        None => pixels,
    }
}

/// The text over each of the `bins`, in lines of at most `room`: its time and its rows, with the room for the longest.
fn stamps(input: &ReportInput, bins: &[usize], room: f64) -> (Vec<Vec<String>>, f64) {
    let step_us = input.time.bin_duration_us();
    let unit = TimeUnit::of(input.time.bins() as f64 * step_us);
    let stamp = |&bin: &usize| {
        let time = unit.stamp(input.time.middle_us(bin), 0.5 * step_us);
        let read = rows(&rows_of_bin(input.instants, input.time, bin));
        [vec![time], in_lines(&read, room)].concat()
    };
    let stamps: Vec<Vec<String>> = bins.iter().map(stamp).collect();
    let most = stamps.iter().map(Vec::len).max().unwrap_or(0);
    (stamps, HEAD + LINE * most as f64)
}

/// `text` in lines of at most `room`, which end at commas.
fn in_lines(text: &str, room: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for part in text.split_inclusive(", ") {
        let is_long = |line: &String| {
            let letters = line.chars().count() + part.trim_end().chars().count();
            letters as f64 * LETTER > room
        };
        match lines.last_mut() {
            Some(line) if !is_long(line) => line.push_str(part),
            _ => lines.push(part.to_string()),
        }
    }
    lines
        .iter()
        .map(|line| line.trim_end().to_string())
        .collect()
}

/// Writes a text of [`stamps`] above a frame.
fn stamp(figure: &mut Figure, place: Rect, lines: &[String]) {
    let middle = place.x + place.width / 2.0;
    for (i, line) in lines.iter().enumerate() {
        let above = 6.0 + LINE * (lines.len() - 1 - i) as f64;
        let class = if i == 0 { "strong" } else { "muted" };
        figure.text(middle, place.y - above, Anchor::Middle, class, line);
    }
}

/// How many frames stand side by side, of `most` (for square ones).
fn per_line(shape: Shape, most: usize) -> usize {
    match shape.columns as f64 / shape.rows as f64 {
        aspect if aspect > 3.0 => most / 3,
        aspect if aspect > 1.6 => most / 2,
        _ => most,
    }
    .max(1)
}

/// A line of a sheet: the same quantity in several bins.
pub(super) struct Line<'l> {
    /// What it shows.
    pub name: &'static str,
    pub map: Map,
    /// Lower and upper end of the colours.
    pub range: (f32, f32),
    /// The picture of a bin.
    pub picture: &'l dyn Fn(usize) -> Pixels,
}

/// Draws the `bins` of each of `lines` below each other, from `top` on, in as many groups as they need. The figure ends
/// there.
pub(super) fn sheet(
    figure: &mut Figure,
    input: &ReportInput,
    top: f64,
    bins: &[usize],
    lines: &[Line],
) {
    let shape = input.video.shape();
    let across = per_line(shape, 6);
    let (left, gap) = (24.0, 6.0);
    let cell = (800.0 - left - BAR_ROOM - gap * (across as f64 - 1.0)) / across as f64;
    let available = Rect::new(0.0, 0.0, cell, 1.6 * cell);
    let height = fit(available, 2.0, shape.rows, shape.columns).height;
    // The upright names need some length.
    let pitch = (height + gap).max(108.0);
    let (stamps, head) = stamps(input, bins, cell);
    let group = head + lines.len() as f64 * pitch + 4.0;
    let groups = bins.chunks(across).zip(stamps.chunks(across));
    figure.set_height(top + groups.len() as f64 * group);
    for (i, (bins, stamps)) in groups.enumerate() {
        let top = top + i as f64 * group;
        for (row, line) in lines.iter().enumerate() {
            let y = top + head + row as f64 * pitch;
            let mut last = available;
            for (i, (&bin, text)) in bins.iter().zip(stamps).enumerate() {
                let available = Rect::new(left + i as f64 * (cell + gap), y, cell, 1.6 * cell);
                last = put(figure, available, (line.picture)(bin));
                if row == 0 {
                    stamp(figure, last, text);
                }
            }
            figure.text_upwards(left - 8.0, y + height / 2.0, "strong", line.name);
            if row > 0 || lines.len() == 1 {
                colour_bar(figure, last, line.map, line.range, "counts");
            }
        }
    }
}

/// `values` of a picture of the video's size in colours.
pub(super) fn coloured(input: &ReportInput, values: &[f32], map: Map, range: (f32, f32)) -> Pixels {
    let shape = input.video.shape();
    let plane = Plane::reduced(shape.rows, shape.columns, values, FRAME_SIDE);
    plane.coloured(map, range.0, range.1)
}

/// Truth, reconstruction and difference, one below the other.
fn compared(
    input: &ReportInput,
    videos: &Videos,
    truth: &Video,
    bins: &[usize],
) -> CaptionedFigure {
    let shape = videos.video.shape();
    let half = DIFFERENCE * videos.high;
    let (light, signed) = ((0.0, videos.high), (-half, half));
    let of_truth = |bin: usize| coloured(input, truth.bin(bin), Map::Light, light);
    let of_video = |bin: usize| reconstructed(input, videos, bin);
    let of_difference = |bin: usize| {
        let pairs = videos.video.bin(bin).iter().zip(truth.bin(bin));
        let difference: Vec<f32> = pairs.map(|(v, truth)| v - truth).collect();
        coloured(input, &difference, Map::Signed, signed)
    };
    let line = |name, map, range, picture| Line {
        name,
        map,
        range,
        picture,
    };
    let lines = [
        line("truth", Map::Light, light, &of_truth as &dyn Fn(_) -> _),
        line("reconstruction", Map::Light, light, &of_video),
        line("difference", Map::Signed, signed, &of_difference),
    ];
    let mut figure = Figure::new(800.0, 0.0);
    sheet(&mut figure, input, 0.0, bins, &lines);
    CaptionedFigure {
        name: "frames",
        section: Section::Video,
        figure,
        caption: format!(
            "{} of {} frames: truth, reconstruction and their difference (reconstruction − truth, \
             on a quarter of the scale). Above each, the time of the middle of its bin and the \
             rows that see it. {} In a good result the two upper rows look the same and the third is dark.{}",
            bins.len(),
            shape.bins,
            light_text(input),
            unobserved_text(input, " (slate in the reconstruction)")
        ),
        alt:
            "Contact sheet of frames: truth above, reconstruction in the middle, difference below."
                .into(),
    }
}

/// The reconstruction alone.
fn alone(input: &ReportInput, videos: &Videos, bins: &[usize]) -> CaptionedFigure {
    let shape = videos.video.shape();
    let across = per_line(shape, 4);
    let gap = 8.0;
    let cell = (800.0 - BAR_ROOM - gap * (across as f64 - 1.0)) / across as f64;
    let available = Rect::new(0.0, 0.0, cell, 1.4 * cell);
    let height = fit(available, 2.0, shape.rows, shape.columns).height;
    let (stamps, head) = stamps(input, bins, cell);
    let pitch = head + height.max(84.0) + gap;
    let mut figure = Figure::new(800.0, bins.len().div_ceil(across) as f64 * pitch);
    for (i, (&bin, text)) in bins.iter().zip(&stamps).enumerate() {
        let (column, line) = ((i % across) as f64, (i / across) as f64);
        let available = Rect::new(column * (cell + gap), head + line * pitch, cell, 1.4 * cell);
        let place = put(&mut figure, available, reconstructed(input, videos, bin));
        stamp(&mut figure, place, text);
        if (i + 1) % across == 0 || i + 1 == bins.len() {
            colour_bar(&mut figure, place, Map::Light, (0.0, videos.high), "counts");
        }
    }
    CaptionedFigure {
        name: "frames",
        section: Section::Video,
        figure,
        caption: format!(
            "{} of {} reconstructed frames. Above each, the time of the middle of its bin and the \
             rows that see it. {} A good one shows sharp objects on a dark, quiet ground.{}",
            bins.len(),
            shape.bins,
            light_text(input),
            unobserved_text(input, " (slate)")
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
    fn long_rows_stand_in_lines() {
        let rows = "rows 27–29, 105–107";
        assert_eq!(in_lines(rows, 140.0), [rows]);
        assert_eq!(in_lines(rows, 110.0), ["rows 27–29,", "105–107"]);
        assert_eq!(in_lines(rows, 1.0), ["rows 27–29,", "105–107"]);
        assert!(in_lines("", 110.0).is_empty());
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
