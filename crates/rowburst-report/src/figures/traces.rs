//! The brightest spots over time.

use rowburst::Video;

use super::{Drawn, Section, Videos};
use crate::ReportInput;
use crate::chart::{Axis, Chart, Labels};
use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{TimeUnit, frequency};
use crate::frequency::{Tone, strongest_tone};
use crate::panel::{put, scale_bar};
use crate::pixels::{LONGEST_SIDE, Plane};
use crate::spots::{Spot, brightest_spots, mean3};

/// Most spots that are traced.
const SPOTS: usize = 6;
/// Colours of the spots, told apart by colour-blind readers too, on white and on black.
const COLOURS: [&str; SPOTS] = [
    "#2a85c9", "#e0662f", "#1a9b74", "#c563ae", "#c2940b", "#7577d6",
];

/// Draws the traces, or nothing where the video is dark.
pub(super) fn draw(input: &ReportInput, videos: &Videos) -> Option<Drawn> {
    let shape = videos.video.shape();
    let separation = (shape.rows.min(shape.columns) as f64 / 8.0).max(3.0);
    let spots = brightest_spots(&videos.projection.max, shape.columns, SPOTS, separation);
    if spots.is_empty() {
        return None;
    }
    let step_us = input.time.bin_duration_us();
    let unit = TimeUnit::of(shape.bins as f64 * step_us);
    let traces = |video: &Video| spots.iter().map(|s| trace(video, s)).collect::<Vec<_>>();
    let (traces, truths) = (traces(videos.video), videos.truth.map(traces));
    let all = || traces.iter().chain(truths.iter().flatten()).flatten();
    let top = all().copied().filter(|v| v.is_finite()).fold(0.0, f32::max);

    let mut figure = Figure::new(800.0, 0.0);
    let place = map(&mut figure, input, videos, &spots);
    let strip = if spots.len() > 3 { 62.0 } else { 96.0 };
    let mut tones = Vec::new();
    let mut bottom: f64 = 0.0;
    for (i, values) in traces.iter().enumerate() {
        let chart = Chart {
            place: Rect::new(330.0, 20.0 + i as f64 * (strip + 22.0), 460.0, strip),
            x: Axis::linear(
                0.0,
                shape.bins as f64 * step_us / unit.us,
                format!("time ({})", unit.name),
            ),
            y: Axis::linear(0.0, f64::from(top) * 1.05, ""),
        };
        bottom = chart.place.bottom();
        let is_last = i + 1 == traces.len();
        chart.frame(
            &mut figure,
            if is_last { Labels::Both } else { Labels::YOnly },
        );
        let points = |values: &[f32]| -> Vec<(f64, f64)> {
            let at = |(t, &v): (usize, &f32)| ((t as f64 + 0.5) * step_us / unit.us, f64::from(v));
            values.iter().enumerate().map(at).collect()
        };
        if let Some(truths) = &truths {
            let dashes = r#"stroke-dasharray="4 3""#;
            chart.curve(&mut figure, &points(&truths[i]), "reference", dashes);
        }
        let style = format!(r#"style="stroke:{}""#, COLOURS[i]);
        chart.curve(&mut figure, &points(values), "line", &style);
        let tone = strongest_tone(values, input.time.frame_rate_hz());
        let y = place.bottom() + 40.0 + 20.0 * i as f64;
        let swatch = [(4.0, y - 4.0), (24.0, y - 4.0)];
        figure.line(
            &swatch,
            "line",
            &format!(r#"style="stroke:{};stroke-width:3""#, COLOURS[i]),
        );
        let text = format!("{} · row {}, column {}", i + 1, spots[i].y, spots[i].x);
        figure.text(32.0, y, Anchor::Start, "", &text);
        let label = match tone {
            Some(tone) => format!("{} · {}", i + 1, frequency(tone.hertz)),
            None => format!("{}", i + 1),
        };
        let (right, above) = (chart.place.right(), chart.place.y - 4.0);
        figure.text(right, above, Anchor::End, "strong", &label);
        tones.extend(tone.map(|t| (i + 1, t)));
    }
    figure.text_upwards(284.0, (20.0 + bottom) / 2.0, "", "brightness");
    let legend = place.bottom() + 40.0 + 20.0 * spots.len() as f64;
    figure.set_height((bottom + 42.0).max(legend));
    Some(Drawn {
        name: "traces",
        section: Section::Video,
        figure,
        caption: caption(videos.truth.is_some(), &tones, input.time.frame_rate_hz()),
        alt: format!(
            "Brightness over time of the {} brightest spots, and a map of them.",
            spots.len()
        ),
    })
}

fn caption(has_truth: bool, tones: &[(usize, Tone)], rate_hz: f64) -> String {
    let mut text = String::from(
        "Brightness over time of the brightest spots (mean of 3 × 3 pixels, in the units of the \
         frame per unit of PSF sum; points at the middle of the bins)",
    );
    text += match has_truth {
        true => ", the truth dashed. In a good one the lines cover the dashes. ",
        false => ". In a good one lines are smooth and return to zero where the spot is dark. ",
    };
    if tones.is_empty() {
        return text + "No frequency stands out of a trace.";
    }
    text += "Strongest frequency, given where a sine of it explains much of the trace: ";
    let list = tones.iter().map(|(spot, tone)| {
        let percent = (100.0 * tone.share).round();
        format!(
            "spot {spot}, {} ({percent} % of the variance)",
            frequency(tone.hertz)
        )
    });
    text += &list.collect::<Vec<_>>().join("; ");
    let half = frequency(rate_hz / 2.0);
    text + &format!(". What is faster than half the frame rate, {half}, appears folded below it.")
}

/// Mean of the 3×3 pixels about a spot, in every bin.
fn trace(video: &Video, spot: &Spot) -> Vec<f32> {
    let shape = video.shape();
    (0..shape.bins)
        .map(|t| mean3(video.bin(t), shape.columns, spot.y, spot.x))
        .collect()
}

/// The largest values over time, with the spots marked.
fn map(figure: &mut Figure, input: &ReportInput, videos: &Videos, spots: &[Spot]) -> Rect {
    let projection = &videos.projection;
    let (rows, columns) = (projection.rows, projection.columns);
    let plane = Plane::reduced(rows, columns, &projection.max, LONGEST_SIDE / 2);
    let room = Rect::new(0.0, 20.0, 240.0, 300.0);
    let place = put(figure, room, plane.coloured(Map::Grey, 0.0, videos.high));
    scale_bar(figure, place, columns, input.pixel_pitch_um);
    for (i, spot) in spots.iter().enumerate() {
        let x = place.x + (spot.x as f64 + 0.5) / columns as f64 * place.width;
        let y = place.y + (spot.y as f64 + 0.5) / rows as f64 * place.height;
        figure.ring(x, y, 8.0, "#000", 3.5);
        figure.ring(x, y, 8.0, COLOURS[i], 2.0);
        let left = x + 24.0 > place.right();
        let (x, anchor) = if left {
            (x - 11.0, Anchor::End)
        } else {
            (x + 11.0, Anchor::Start)
        };
        figure.mark(x, y - 5.0, anchor, COLOURS[i], &(i + 1).to_string());
    }
    place
}
