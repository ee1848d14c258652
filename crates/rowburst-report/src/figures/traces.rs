//! The light of a few places over time, with its error.

use rowburst::Video;
use rowburst::traces::Region;

use super::{CaptionedFigure, Section, Videos, light_text, time_text};
use crate::chart::{Axis, Chart, Labels};
use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{TimeUnit, frequency, frequency_with_error};
use crate::panel::{PixelScale, put, scale_bar};
use crate::pixels::{LONGEST_SIDE, Plane};
use crate::{AnnotatedTrace, ReportInput};

/// Colours of regions in all figures and in the viewer, told apart by colour-blind readers too, on white and on black; as
/// many traces are drawn.
pub const REGION_COLOURS: [&str; 8] = [
    "#2a85c9", "#e0662f", "#1a9b74", "#c563ae", "#c2940b", "#7577d6", "#5f8a1f", "#c0504d",
];
/// Half of a 95 % interval over its standard error.
const Z_95: f64 = 1.96;

/// The time axis of the charts.
struct TimeScale {
    start_us: f64,
    end_us: f64,
    step_us: f64,
    unit: TimeUnit,
}

impl TimeScale {
    /// Start of the video.
    fn start(&self) -> f64 {
        self.start_us / self.unit.us
    }

    /// End of the video.
    fn end(&self) -> f64 {
        self.end_us / self.unit.us
    }

    /// Middle of bin `t`.
    fn middle(&self, t: usize) -> f64 {
        (self.start_us + (t as f64 + 0.5) * self.step_us) / self.unit.us
    }

    /// One value per bin, each with its time.
    fn points(&self, values: &[f64]) -> Vec<(f64, f64)> {
        values
            .iter()
            .enumerate()
            .map(|(t, &v)| (self.middle(t), v))
            .collect()
    }
}

/// Draws the traces, or nothing where there are none.
pub(super) fn draw(input: &ReportInput, videos: &Videos) -> Option<CaptionedFigure> {
    let shape = videos.video.shape();
    let traces = &input.traces[..input.traces.len().min(REGION_COLOURS.len())];
    if traces.is_empty() {
        return None;
    }
    let step_us = input.time.bin_duration_us();
    let scale = TimeScale {
        start_us: input.time.start_us(),
        end_us: input.time.end_us(),
        step_us,
        unit: TimeUnit::of(shape.bins as f64 * step_us),
    };
    let truth_of = |video: &Video| -> Vec<Vec<f64>> {
        traces
            .iter()
            .map(|t| t.trace.region.mean_of(video))
            .collect()
    };
    let truths = videos.truth.map(truth_of);

    let mut figure = Figure::new(800.0, 0.0);
    let place = map(&mut figure, input, videos, traces);
    let strip = if traces.len() > 3 { 62.0 } else { 96.0 };
    let mut bottom: f64 = 0.0;
    let range = common_range(traces, truths.as_deref());
    for (i, annotated) in traces.iter().enumerate() {
        let chart = Chart {
            place: Rect::new(330.0, 20.0 + i as f64 * (strip + 22.0), 460.0, strip),
            x: Axis::linear(
                scale.start(),
                scale.end(),
                format!("time ({})", scale.unit.name),
            ),
            y: Axis::linear(range.0, range.1, ""),
        };
        bottom = chart.place.bottom();
        let is_last = i + 1 == traces.len();
        chart.frame(
            &mut figure,
            if is_last { Labels::Both } else { Labels::YOnly },
        );
        let truth = truths.as_ref().map(|truths| truths[i].as_slice());
        draw_curves(
            &mut figure,
            &chart,
            &scale,
            annotated,
            truth,
            REGION_COLOURS[i],
        );
        draw_legend_entry(
            &mut figure,
            place.bottom() + 40.0,
            i,
            &annotated.trace.region,
        );
        draw_label(&mut figure, &chart, i, annotated);
    }
    figure.text_upwards(284.0, (20.0 + bottom) / 2.0, "", "light (counts)");
    let legend = place.bottom() + 40.0 + 20.0 * traces.len() as f64;
    figure.set_height((bottom + 42.0).max(legend));
    Some(CaptionedFigure {
        name: "traces",
        section: Section::Video,
        figure,
        caption: caption(input, traces),
        alt: format!(
            "Brightness over time of {} regions with 95 % confidence intervals, and a map of them.",
            traces.len()
        ),
    })
}

/// Draws one trace over its confidence band, with photodiodes and truth.
fn draw_curves(
    figure: &mut Figure,
    chart: &Chart,
    scale: &TimeScale,
    annotated: &AnnotatedTrace,
    truth: Option<&[f64]>,
    colour: &str,
) {
    let trace = &annotated.trace;
    let pairs = trace.debiased.iter().zip(&trace.standard_error);
    let band: Vec<(f64, f64, f64)> = pairs
        .enumerate()
        .map(|(t, (v, e))| (scale.middle(t), v - Z_95 * e, v + Z_95 * e))
        .collect();
    let fill = format!(r#"style="fill:{colour};fill-opacity:0.28;stroke:none""#);
    chart.band(figure, &band, &fill);
    let thin = r#"style="stroke-width:0.8;stroke-opacity:0.75""#;
    for diode in &annotated.photodiodes {
        let inside = diode.points.iter().map(|&(t, v)| (t / scale.unit.us, v));
        let inside: Vec<(f64, f64)> = inside
            .filter(|(t, _)| (scale.start()..=scale.end()).contains(t))
            .collect();
        chart.curve(figure, &inside, "reference", thin);
    }
    if let Some(truth) = truth {
        let dashes = r#"stroke-dasharray="4 3""#;
        chart.curve(figure, &scale.points(truth), "reference", dashes);
    }
    let style = format!(r#"style="stroke:{colour}""#);
    chart.curve(figure, &scale.points(&trace.debiased), "line", &style);
}

/// Names trace `i` and its region below the map; the legend begins at `top`.
fn draw_legend_entry(figure: &mut Figure, top: f64, i: usize, region: &Region) {
    let y = top + 20.0 * i as f64;
    let swatch = [(4.0, y - 4.0), (24.0, y - 4.0)];
    let colour = REGION_COLOURS[i];
    let wide = format!(r#"style="stroke:{colour};stroke-width:3""#);
    figure.line(&swatch, "line", &wide);
    let text = format!("{} · {}", i + 1, place_of(region));
    figure.text(32.0, y, Anchor::Start, "", &text);
}

/// Writes number and frequency of trace `i` above its chart.
fn draw_label(figure: &mut Figure, chart: &Chart, i: usize, annotated: &AnnotatedTrace) {
    let mut label = format!("{}", i + 1);
    if let Some(found) = &annotated.frequency {
        let text = frequency_with_error(found.hertz, found.error_hz);
        label += &format!(" · {text}");
    }
    let (right, above) = (chart.place.right(), chart.place.y - 4.0);
    figure.text(right, above, Anchor::End, "strong", &label);
}

/// Middle and size of a region in words.
fn place_of(region: &Region) -> String {
    let (y, x) = (region.y + region.rows / 2, region.x + region.columns / 2);
    let place = format!("row {y}, column {x}");
    match (region.rows, region.columns) {
        (3, 3) => place,
        (rows, columns) => format!("{place} ({rows} × {columns})"),
    }
}

/// The range of brightness that all traces are drawn in; wide errors do not stretch it without end.
fn common_range(traces: &[AnnotatedTrace], truths: Option<&[Vec<f64>]>) -> (f64, f64) {
    let values = traces.iter().flat_map(|t| &t.trace.debiased);
    let all = values.chain(truths.into_iter().flatten().flatten());
    let (mut low, mut high) = all
        .filter(|v| v.is_finite())
        .fold((0.0f64, 0.0f64), |(low, high), &v| {
            (low.min(v), high.max(v))
        });
    let (least, most) = (-0.35 * high, 1.35 * high);
    for annotated in traces {
        let pairs = annotated
            .trace
            .debiased
            .iter()
            .zip(&annotated.trace.standard_error);
        for (v, e) in pairs.filter(|(v, e)| v.is_finite() && e.is_finite()) {
            low = low.min((v - Z_95 * e).max(least));
            high = high.max((v + Z_95 * e).min(most));
        }
    }
    let margin = 0.04 * (high - low);
    (if low < 0.0 { low - margin } else { 0.0 }, high + margin)
}

fn caption(input: &ReportInput, traces: &[AnnotatedTrace]) -> String {
    let (has_truth, rate_hz) = (input.truth.is_some(), input.time.frame_rate_hz());
    let has_errors = traces
        .iter()
        .any(|t| t.trace.mean_standard_error().is_some());
    let mut text = format!(
        "Brightness over time, the mean over each region (of 3 × 3 pixels where no other size is given; points at the middle of the bins). {} {} ",
        light_text(input),
        time_text(input)
    );
    text += if has_errors {
        "Lines are debiased estimates on the active voxels; bands are 95 % confidence intervals"
    } else {
        "Lines are means of the video; their standard errors are not known"
    };
    text += if has_truth {
        "; the truth is dashed"
    } else {
        ""
    };
    if traces.iter().any(|t| !t.photodiodes.is_empty()) {
        text += "; thin lines are photodiodes, shifted and scaled to fit: ";
        let diodes = traces.iter().enumerate().flat_map(|(i, annotated)| {
            let one = move |d: &crate::AlignedSignal| {
                format!(
                    "{} over {} (correlation {:.3})",
                    d.name,
                    i + 1,
                    d.correlation
                )
            };
            annotated.photodiodes.iter().map(one)
        });
        text += &diodes.collect::<Vec<_>>().join(", ");
    }
    text += ". ";
    let tones: Vec<_> = traces
        .iter()
        .enumerate()
        .filter_map(|(i, t)| Some((i + 1, t.frequency.as_ref()?)))
        .collect();
    if tones.is_empty() {
        return text + "No significant frequency in any trace.";
    }
    text += "Strongest frequency with its standard error, where a sine of this frequency explains much of the trace: ";
    let list = tones.iter().map(|(place, found)| {
        let mut words = format!(
            "region {place}, {} ({} % of the variance",
            frequency_with_error(found.hertz, found.error_hz),
            (100.0 * found.share).round()
        );
        if found.is_half_rate {
            words += "; indistinguishable from half the frame rate";
        }
        let harmonics = found.harmonics.iter();
        let harmonics: Vec<String> = harmonics
            .map(|h| format!("{} at {}", h.order, frequency(h.hertz)))
            .collect();
        if !harmonics.is_empty() {
            words += &format!("; harmonic {}", harmonics.join(", "));
        }
        words + ")"
    });
    text += &list.collect::<Vec<_>>().join("; ");
    let half = frequency(rate_hz / 2.0);
    text + &format!(
        ". Frequencies above half the frame rate, {half}, are aliased below it, harmonics too."
    )
}

/// The largest values over time, with the spots marked.
fn map(
    figure: &mut Figure,
    input: &ReportInput,
    videos: &Videos,
    traces: &[AnnotatedTrace],
) -> Rect {
    let projection = &videos.projection;
    let (rows, columns) = (projection.rows, projection.columns);
    let plane = Plane::reduced(rows, columns, &projection.max, LONGEST_SIDE / 2);
    let available = Rect::new(0.0, 20.0, 240.0, 300.0);
    let place = put(
        figure,
        available,
        plane.coloured(Map::Grey, 0.0, videos.high),
    );
    scale_bar(figure, place, columns, PixelScale::of_scene(input.sensor));
    for (i, annotated) in traces.iter().enumerate() {
        let region = annotated.trace.region;
        let scale = (place.width / columns as f64, place.height / rows as f64);
        // About the pixels, not on them.
        let outline = Rect::new(
            place.x + region.x as f64 * scale.0 - 1.5,
            place.y + region.y as f64 * scale.1 - 1.5,
            region.columns as f64 * scale.0 + 3.0,
            region.rows as f64 * scale.1 + 3.0,
        );
        let colour = REGION_COLOURS[i];
        for (stroke, width) in [("#000", 3.5), (colour, 1.75)] {
            let style = format!(r#"fill="none" stroke="{stroke}" stroke-width="{width}""#);
            figure.rect(outline, "region", &style);
        }
        let is_at_edge = outline.right() + 14.0 > place.right();
        let (x, anchor) = if is_at_edge {
            (outline.x - 3.0, Anchor::End)
        } else {
            (outline.right() + 3.0, Anchor::Start)
        };
        let y = (outline.y + 4.0).max(place.y + 11.0);
        figure.mark(x, y, anchor, colour, &(i + 1).to_string());
    }
    place
}
