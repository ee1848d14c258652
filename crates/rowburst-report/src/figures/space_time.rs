//! The video as a body in space and time (the paper's Fig. 3f), and its x–t slice.
//!
//! Orthographic view along `+t`, turned and from above, so that a frame keeps its left
//! and right and time runs to the right and away:
//!
//! ```text
//! right = t sin β + x cos β,    down = y cos ε − (t cos β − x sin β) sin ε
//! ```

use rowburst::Video;

use super::{CaptionedFigure, Section, Videos, unobserved_text};
use crate::ReportInput;
use crate::chart::Axis;
use crate::colour::{Map, srgb, time_hue};
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{TimeUnit, grouped};
use crate::panel::{BAR_ROOM, PixelScale, colour_bar};
use crate::pixels::{LONGEST_SIDE, Plane};

/// Most voxels that are drawn: some 60 kB of SVG.
const MAX_DRAWN_VOXELS: usize = 4000;
/// Darkest voxel that is drawn, as a share of the white point.
const DARKEST: f32 = 0.25;
/// Angles of the view, `β` and `ε`.
const TURN_DEGREES: f64 = 52.0;
const ELEVATION_DEGREES: f64 = 24.0;
/// Length of the time axis over that of the longer side of a frame.
const STRETCH: f64 = 1.5;
/// Opacity of strokes by brightness, from [`DARKEST`] to the white point.
const OPACITIES: [f64; 3] = [0.4, 0.7, 1.0];

/// The colours of time need a dark ground, in the light theme too.
const GROUND: &str = r##"fill="#0e1117""##;
const BOX: &str = r##"style="stroke:#8b95a3;stroke-opacity:0.45;stroke-width:0.8;fill:none""##;
const TEXT_COLOUR: &str = "#cfd6df";

/// Draws the body and the slice, or nothing where the video is dark.
pub(super) fn draw(input: &ReportInput, videos: &Videos) -> Option<CaptionedFigure> {
    let bright = BrightVoxels::of(videos.video, DARKEST * videos.high, MAX_DRAWN_VOXELS);
    if bright.of == 0 {
        return None;
    }
    let mut figure = Figure::new(800.0, 420.0);
    let place = Rect::new(0.0, 22.0, 480.0, 390.0);
    let (shown, of) = (grouped(bright.shown() as f64), grouped(bright.of as f64));
    let title = if bright.shown() == bright.of {
        format!("{of} bright voxels in space and time")
    } else {
        format!("{shown} of {of} bright voxels in space and time")
    };
    figure.text(
        place.x + place.width / 2.0,
        14.0,
        Anchor::Middle,
        "strong",
        &title,
    );
    figure.rect(place, "mark", GROUND);
    body(&mut figure, place, input, videos, &bright);
    slices(&mut figure, input, videos);
    let drawn = if bright.shown() == bright.of {
        format!("All {of}")
    } else {
        format!("{shown} of {of}, a random sample of the")
    };
    Some(CaptionedFigure {
        name: "space-time",
        section: Section::Video,
        figure,
        caption: format!(
            "The video in space and time. Left, each stroke is a voxel for the time of its bin, its \
             colour the time as above, its opacity the brightness. {drawn} voxels above a quarter \
             of the white point. Right, the x–t slice: the brightest value over all rows, in \
             counts. Blinking points are broken lines along time, \
             moving points slanted ones. In a good result the space between them is empty.{}",
            unobserved_text(input, "")
        ),
        alt: "Bright voxels of the video in a box of x, y and time, and a picture of the largest \
              value over y against x and time."
            .into(),
    })
}

/// Bright voxels, not more than can be drawn.
struct BrightVoxels {
    /// Pixel and brightness over the threshold's white point, bin after bin.
    bins: Vec<Vec<(usize, f32)>>,
    /// How many there are.
    of: usize,
}

impl BrightVoxels {
    /// The voxels from `darkest` on, or about `most` of them drawn by lot: the brightest
    /// alone would leave out what is faint, every n-th would draw stripes.
    fn of(video: &Video, darkest: f32, most: usize) -> Self {
        let is_bright = |v: &f32| v.is_finite() && *v >= darkest;
        let of = video.data().iter().filter(|v| is_bright(v)).count();
        let part = (most as f64 / of.max(1) as f64).min(1.0);
        let is_drawn = |i: usize| part >= 1.0 || uniform_hash(i as u64) < part;
        let pixels = video.shape().pixels();
        let bins = (0..video.shape().bins).map(|t| {
            let voxels = video.bin(t).iter().copied().enumerate();
            voxels
                .filter(|(i, v)| is_bright(v) && is_drawn(t * pixels + i))
                .collect()
        });
        Self {
            bins: bins.collect(),
            of,
        }
    }

    fn shown(&self) -> usize {
        self.bins.iter().map(Vec::len).sum()
    }
}

/// A number from 0 to 1 for each voxel, the same in every run (the finaliser of SplitMix64).
fn uniform_hash(voxel: u64) -> f64 {
    let mut bits = voxel.wrapping_add(0x9e37_79b9_7f4a_7c15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (bits ^ (bits >> 31)) as f64 / u64::MAX as f64
}

/// From parts of the box, each 0 to 1, to units of the figure.
struct View {
    origin: (f64, f64),
    t: (f64, f64),
    x: (f64, f64),
    y: (f64, f64),
}

impl View {
    /// The box of a video of `rows · columns` within `available`.
    fn fitting(available: Rect, rows: usize, columns: usize) -> Self {
        // A box that is not a needle, whatever the shape of the frames.
        let aspect = (columns as f64 / rows as f64).clamp(0.25, 4.0);
        let (width, height) = (aspect.min(1.0), (1.0 / aspect).min(1.0));
        let (turn, rise) = (TURN_DEGREES.to_radians(), ELEVATION_DEGREES.to_radians());
        let t = (STRETCH * turn.sin(), -STRETCH * turn.cos() * rise.sin());
        let x = (width * turn.cos(), width * turn.sin() * rise.sin());
        let y = (0.0, height * rise.cos());
        let (across, above, below) = (t.0 + x.0, -t.1, x.1 + y.1);
        let scale = (available.width / across).min(available.height / (above + below));
        let by = |(a, b): (f64, f64)| (scale * a, scale * b);
        Self {
            origin: (
                available.x + (available.width - scale * across) / 2.0,
                available.y + (available.height - scale * (above + below)) / 2.0 + scale * above,
            ),
            t: by(t),
            x: by(x),
            y: by(y),
        }
    }

    fn at(&self, t: f64, y: f64, x: f64) -> (f64, f64) {
        (
            self.origin.0 + t * self.t.0 + y * self.y.0 + x * self.x.0,
            self.origin.1 + t * self.t.1 + y * self.y.1 + x * self.x.1,
        )
    }
}

fn body(
    figure: &mut Figure,
    place: Rect,
    input: &ReportInput,
    videos: &Videos,
    bright: &BrightVoxels,
) {
    let shape = videos.video.shape();
    // Room for the numbers, left and below.
    let available = Rect::new(
        place.x + 52.0,
        place.y + 16.0,
        place.width - 84.0,
        place.height - 56.0,
    );
    let view = View::fitting(available, shape.rows, shape.columns);
    for (from, to) in edges() {
        let ends = [from, to].map(|[t, y, x]| view.at(t, y, x));
        figure.line(&ends, "mark", BOX);
    }
    let bins = shape.bins as f64;
    let step = {
        let (dx, dy) = (view.t.0 / bins, view.t.1 / bins);
        // Shorter strokes would fade in a long video.
        let longer = (1.0 / dx.hypot(dy)).max(1.0);
        (longer * dx, longer * dy)
    };
    let pixel = (view.y.1 / shape.rows as f64).max(view.x.0.hypot(view.x.1) / shape.columns as f64);
    let width = pixel.clamp(1.0, 4.0);
    let last = (shape.bins - 1).max(1) as f64;
    // The first bin is the nearest.
    for (t, voxels) in bright.bins.iter().enumerate().rev() {
        let [r, g, b] = srgb(time_hue(t as f64 / last));
        for (level, opacity) in OPACITIES.iter().enumerate() {
            let level_of = |v: f32| {
                let part = (v / videos.high - DARKEST) / (1.0 - DARKEST);
                ((part * OPACITIES.len() as f32) as usize).min(OPACITIES.len() - 1)
            };
            let of_level = voxels.iter().filter(|&&(_, v)| level_of(v) == level);
            let points: Vec<(f64, f64)> = of_level
                .map(|&(i, _)| {
                    let part = |at: usize, of: usize| (at as f64 + 0.5) / of as f64;
                    let y = part(i / shape.columns, shape.rows);
                    let x = part(i % shape.columns, shape.columns);
                    view.at(t as f64 / bins, y, x)
                })
                .collect();
            let style = format!(
                r##"fill="none" stroke="#{r:02x}{g:02x}{b:02x}" stroke-width="{width:.1}" stroke-opacity="{opacity}""##
            );
            figure.strokes(&points, step, &style);
        }
    }
    axes(figure, &view, input, videos.video);
}

/// The twelve edges of the box, as ends `[t, y, x]`.
fn edges() -> impl Iterator<Item = ([f64; 3], [f64; 3])> {
    (0..3).flat_map(|axis| {
        (0..4).map(move |corner| {
            let mut from = [0.0; 3];
            from[(axis + 1) % 3] = f64::from(corner & 1);
            from[(axis + 2) % 3] = f64::from(corner >> 1);
            let mut to = from;
            to[axis] = 1.0;
            (from, to)
        })
    })
}

/// Numbers and names along three outer edges.
fn axes(figure: &mut Figure, view: &View, input: &ReportInput, video: &Video) {
    let shape = video.shape();
    let (time, x, y) = scales(input, video);
    let ticks = |axis: &Axis, count| axis.ticks(count).into_iter();
    for (value, text) in ticks(&time, 4) {
        let (at_x, at_y) = view.at(time.fraction(value), 1.0, 1.0);
        figure.label(at_x + 5.0, at_y + 13.0, Anchor::Start, TEXT_COLOUR, &text);
    }
    let (at_x, at_y) = view.at(0.62, 1.0, 1.0);
    figure.label(
        at_x + 22.0,
        at_y + 32.0,
        Anchor::Start,
        TEXT_COLOUR,
        time.label(),
    );
    // A narrow side has no room for numbers.
    if shape.columns > shape.rows / 3 {
        for (value, text) in ticks(&x, 3).skip(1) {
            let (at_x, at_y) = view.at(0.0, 1.0, x.fraction(value));
            figure.label(at_x - 6.0, at_y + 11.0, Anchor::End, TEXT_COLOUR, &text);
        }
    }
    let (at_x, at_y) = view.at(0.0, 1.0, 0.45);
    figure.label(
        at_x - 30.0,
        at_y + 26.0,
        Anchor::End,
        TEXT_COLOUR,
        x.label(),
    );
    if shape.rows > shape.columns / 3 {
        for (value, text) in ticks(&y, 4) {
            let (at_x, at_y) = view.at(0.0, y.fraction(value), 0.0);
            figure.label(at_x - 6.0, at_y + 4.0, Anchor::End, TEXT_COLOUR, &text);
        }
    }
    let (at_x, at_y) = view.at(0.0, 0.0, 0.0);
    figure.label(
        at_x - 6.0,
        at_y - 14.0,
        Anchor::Middle,
        TEXT_COLOUR,
        y.label(),
    );
}

/// The axes of time, x and y.
fn scales(input: &ReportInput, video: &Video) -> (Axis, Axis, Axis) {
    let shape = video.shape();
    let total_us = shape.bins as f64 * input.time.bin_duration_us();
    let unit = TimeUnit::of(total_us);
    let (length, of_pixel) =
        PixelScale::of_scene(input.sensor).map_or(("px", 1.0), |scale| ("µm", scale.um));
    let side = |name: &str, pixels: usize| {
        Axis::linear(0.0, pixels as f64 * of_pixel, format!("{name} ({length})"))
    };
    (
        Axis::linear(
            input.time.start_us() / unit.us,
            input.time.end_us() / unit.us,
            format!("time ({})", unit.name),
        ),
        side("x", shape.columns),
        side("y", shape.rows),
    )
}

/// The largest value over y against time and x, of the reconstruction and of the truth.
fn slices(figure: &mut Figure, input: &ReportInput, videos: &Videos) {
    let (time, x, _) = scales(input, videos.video);
    // The box has no room for the place of its lengths.
    let x_label = PixelScale::of_scene(input.sensor).map_or_else(
        || x.label().to_string(),
        |scale| format!("x (µm {})", scale.place),
    );
    let shape = videos.video.shape();
    let named = [
        ("reconstruction", Some(videos.video)),
        ("truth", videos.truth),
    ];
    let panels: Vec<_> = named
        .into_iter()
        .filter_map(|(name, video)| Some((name, video?)))
        .collect();
    let height = if panels.len() == 2 { 160.0 } else { 300.0 };
    let range = (0.0, videos.high);
    let mut place = Rect::new(546.0, 22.0, 254.0 - BAR_ROOM, height);
    for (i, (name, video)) in panels.iter().enumerate() {
        place.y = 22.0 + i as f64 * (height + 34.0);
        let values = brightest_over_y(video);
        let plane = Plane::reduced(shape.columns, shape.bins, &values, LONGEST_SIDE);
        figure.raster(place, plane.coloured(Map::Light, range.0, range.1));
        figure.rect(place, "axis", "");
        let middle = place.x + place.width / 2.0;
        let title = format!("x–t slice: {name}");
        figure.text(middle, place.y - 8.0, Anchor::Middle, "strong", &title);
        for (value, text) in x.ticks(4) {
            let at = place.y + x.fraction(value) * place.height;
            figure.text(place.x - 6.0, at + 4.0, Anchor::End, "muted", &text);
        }
        figure.text_upwards(place.x - 38.0, place.y + height / 2.0, "muted", &x_label);
        colour_bar(figure, place, Map::Light, range, "counts");
    }
    for (value, text) in time.ticks(4) {
        let at = place.x + time.fraction(value) * place.width;
        figure.text(at, place.bottom() + 15.0, Anchor::Middle, "muted", &text);
    }
    let middle = place.x + place.width / 2.0;
    figure.text(
        middle,
        place.bottom() + 32.0,
        Anchor::Middle,
        "muted",
        time.label(),
    );
}

/// `[x, t]`: the largest value of each column of each bin.
fn brightest_over_y(video: &Video) -> Vec<f32> {
    let shape = video.shape();
    let mut values = vec![f32::NEG_INFINITY; shape.columns * shape.bins];
    for t in 0..shape.bins {
        for row in video.bin(t).chunks_exact(shape.columns) {
            for (x, &v) in row.iter().enumerate() {
                let value = &mut values[x * shape.bins + t];
                *value = value.max(v);
            }
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use rowburst::Shape;

    use super::*;

    #[test]
    fn the_box_fills_the_available_rectangle() {
        for (rows, columns) in [(108, 108), (10, 2000), (700, 20)] {
            let available = Rect::new(30.0, 40.0, 300.0, 200.0);
            let view = View::fitting(available, rows, columns);
            let corners = edges().flat_map(|(from, to)| [from, to]);
            let corners: Vec<_> = corners.map(|[t, y, x]| view.at(t, y, x)).collect();
            let inside =
                |&(x, y): &(f64, f64)| (29.9..330.1).contains(&x) && (39.9..240.1).contains(&y);
            assert!(corners.iter().all(inside), "{corners:?}");
            let reach = |f: fn(&(f64, f64)) -> f64| {
                let high = corners.iter().map(f).fold(f64::NEG_INFINITY, f64::max);
                high - corners.iter().map(f).fold(f64::INFINITY, f64::min)
            };
            let filled = (reach(|p| p.0) / 300.0).max(reach(|p| p.1) / 200.0);
            assert!((filled - 1.0).abs() < 1e-9, "{filled}");
            assert!(view.x.0 > 0.0 && view.y.1 > 0.0 && view.t.0 > 0.0);
        }
    }

    #[test]
    fn dense_videos_are_subsampled_in_every_bin() {
        let mut video = Video::zeros(Shape::new(10, 40, 50));
        video.data_mut().fill(1.0);
        video.data_mut()[3] = 0.1;
        video.data_mut()[4] = f32::NAN;
        let bright = BrightVoxels::of(&video, 0.5, 4000);
        assert_eq!(bright.of, 19_998);
        assert!((3800..4200).contains(&bright.shown()), "{}", bright.shown());
        assert!(bright.bins.iter().all(|b| (300..500).contains(&b.len())));
        assert_eq!(BrightVoxels::of(&video, 0.5, 20_000).shown(), 19_998);
        assert_eq!(BrightVoxels::of(&video, 2.0, 20_000).of, 0);
    }

    #[test]
    fn the_slice_holds_the_brightest_row() {
        let mut video = Video::zeros(Shape::new(2, 2, 3));
        video.bin_mut(1)[2] = 4.0;
        video.bin_mut(1)[5] = 5.0;
        assert_eq!(brightest_over_y(&video), [0.0, 0.0, 0.0, 0.0, 0.0, 5.0]);
    }
}
