//! The whole video in one picture: time as colour.

use rowburst::Image;

use super::{CaptionedFigure, Section, Videos, unobserved_text};
use crate::ReportInput;
use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::format::TimeUnit;
use crate::panel::{PixelScale, put, scale_bar};
use crate::pixels::{LONGEST_SIDE, Pixels, Plane};
use crate::projection::{Projection, legend};
use crate::stats::{display_high, display_low};

/// Draws the projection of the reconstruction, beside that of the truth.
pub(super) fn draw(
    input: &ReportInput,
    videos: &Videos,
    truth: Option<Projection>,
) -> CaptionedFigure {
    let shape = videos.video.shape();
    let mut figure = Figure::new(800.0, 0.0);
    let panels = panels_of(input, videos, truth);
    // Side by side, but wide pictures one below the other.
    let across = if panels.iter().all(|p| p.pixels.columns < 2 * p.pixels.rows) {
        panels.len()
    } else {
        1
    };
    let gap = 20.0;
    let width = (800.0 - gap * (across as f64 - 1.0)) / across as f64;
    let height = if across > 1 { 480.0 } else { 520.0 };
    let (mut x, mut bottom) = (0.0, -18.0_f64);
    for panel in panels {
        let top = if x > 0.0 { 22.0 } else { bottom + 40.0 };
        let available = Rect::new(x, top, width, height);
        let place = put(&mut figure, available, panel.pixels);
        let middle = place.x + place.width / 2.0;
        figure.text(middle, top - 8.0, Anchor::Middle, "strong", panel.name);
        if panel.is_field {
            scale_bar(
                &mut figure,
                place,
                shape.columns,
                PixelScale::of_scene(input.sensor),
            );
            sensor_outline(&mut figure, place, input);
        }
        bottom = bottom.max(place.bottom());
        if across > 1 {
            x += width + gap;
        }
    }
    let total_us = shape.bins as f64 * input.time.bin_duration_us();
    let bar = Rect::new(200.0, bottom + 30.0, 400.0, 12.0);
    figure.raster(bar, legend(shape.bins));
    figure.rect(bar, "axis", "");
    let unit = TimeUnit::of(total_us);
    for fraction in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let time_us = input.time.start_us() + fraction * total_us;
        let text = unit.stamp(time_us, 0.1 * unit.us);
        let x = bar.x + fraction * bar.width;
        figure.text(x, bar.bottom() + 16.0, Anchor::Middle, "muted", &text);
    }
    figure.set_height(bar.bottom() + 24.0);
    CaptionedFigure {
        name: "time-colour",
        section: Section::Video,
        figure,
        caption: format!(
            "The whole video of {} bins in one picture: hue is time (equal steps of time are \
             equal steps of hue, blue first, red last), brightness the largest value over time. \
             Constant light is grey.{}{}{} In a good result each object has one pure colour on \
             black; mixed colours are events that were not separated.",
            shape.bins,
            if is_larger(input) {
                " The dashed line is the edge of the sensor."
            } else {
                ""
            },
            if input.direct.is_some() {
                " In grey, the frame without the diffuser, in which each row shows its own instant only."
            } else {
                ""
            },
            unobserved_text(input, "")
        ),
        alt: format!(
            "Projection of the video over time with time shown as hue from blue at {} to red at {}.",
            unit.stamp(input.time.start_us(), 0.1 * unit.us),
            unit.stamp(input.time.end_us(), 0.1 * unit.us)
        ),
    }
}

/// The pictures of the figure: the reconstruction, the truth and the frame without the diffuser, as far as they are known.
fn panels_of(input: &ReportInput, videos: &Videos, truth: Option<Projection>) -> Vec<Panel> {
    let mut panels: Vec<Panel> = [
        ("reconstruction", Some(&videos.projection)),
        ("truth", truth.as_ref()),
    ]
    .into_iter()
    .filter_map(|(name, projection)| {
        Some(Panel {
            name,
            pixels: projection?.picture(videos.high),
            is_field: true,
        })
    })
    .collect();
    panels.extend(input.direct.map(|direct| Panel {
        name: "without the diffuser",
        pixels: grey(direct.image),
        is_field: false,
    }));
    panels
}

/// A picture beside the others.
struct Panel {
    name: &'static str,
    pixels: Pixels,
    /// Whether it shows the field of the video.
    is_field: bool,
}

fn grey(image: &Image) -> Pixels {
    let high = display_high(image.data());
    let low = display_low(image.data(), high);
    Plane::reduced(image.rows(), image.columns(), image.data(), LONGEST_SIDE).coloured(
        Map::Grey,
        low,
        high,
    )
}

fn is_larger(input: &ReportInput) -> bool {
    let shape = input.video.shape();
    shape.rows > input.frame.rows() || shape.columns > input.frame.columns()
}

/// Marks the sensor in the middle of a field that is larger.
fn sensor_outline(figure: &mut Figure, place: Rect, input: &ReportInput) {
    if !is_larger(input) {
        return;
    }
    let shape = input.video.shape();
    let span = |field: usize, sensor: usize, length: f64| {
        let pixel = length / field as f64;
        let offset = field.saturating_sub(sensor) / 2;
        (offset as f64 * pixel, sensor.min(field) as f64 * pixel)
    };
    let (y, height) = span(shape.rows, input.frame.rows(), place.height);
    let (x, width) = span(shape.columns, input.frame.columns(), place.width);
    let outline = Rect::new(place.x + x, place.y + y, width, height);
    let style = r##"fill="none" stroke="#fff" stroke-opacity="0.6" stroke-dasharray="4 4""##;
    figure.rect(outline, "mark", style);
}
