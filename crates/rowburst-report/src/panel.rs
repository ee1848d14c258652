//! One picture in a figure: pixels in place, a colour bar, a scale bar.

use rowburst::Sensor;

use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::format::{number, raised};
use crate::pixels::{Pixels, Plane};

/// The largest place inside `available` for an image of `rows · columns`, centred across and
/// at the top, on a grid of `grid` pixels a unit. Small images are enlarged by a whole factor; sides that would vanish
/// (1-pixel-wide images) are kept at a sixteenth of the room.
pub(crate) fn fit(available: Rect, grid: f64, rows: usize, columns: usize) -> Rect {
    let (rows, columns) = (rows as f64, columns as f64);
    let mut scale = (available.width / columns).min(available.height / rows);
    let whole = (scale * grid).floor();
    if whole >= 1.0 {
        scale = whole / grid;
    }
    let width = (scale * columns).max(available.width / 16.0);
    let height = (scale * rows).max(available.height / 16.0);
    let x = available.x + (available.width - width) / 2.0;
    let snap = |v: f64| (v * grid).round() / grid;
    Rect::new(snap(x), snap(available.y), snap(width), snap(height))
}

/// Room that a colour bar takes right of a picture, with its numbers and the name above it.
pub(crate) const BAR_ROOM: f64 = 84.0;
/// Width of a letter of a name, on average, in units of the figure.
pub(crate) const LETTER: f64 = 6.6;
/// Distance of the lines of a name.
pub(crate) const LINE: f64 = 14.0;

/// Draws a vertical colour bar right of `picture`, from `low` (below) to `high` (above). Above it stand the name of the
/// quantity and the power of ten that its numbers, of two digits, share.
pub(crate) fn colour_bar(
    figure: &mut Figure,
    picture: Rect,
    map: Map,
    (low, high): (f32, f32),
    unit: &str,
) {
    let (low, high) = (f64::from(low), f64::from(high));
    let exponent = shared_exponent(low.abs().max(high.abs()));
    let mut names = lines_of(unit, (BAR_ROOM / LETTER) as usize);
    if exponent != 0 {
        names.push(format!("×10{}", raised(exponent)));
    }
    let left = picture.right() + 10.0;
    for (i, name) in names.iter().enumerate() {
        let y = picture.y + 10.0 + LINE * i as f64;
        figure.text(left, y, Anchor::Start, "muted", name);
    }
    let head = if names.is_empty() {
        0.0
    } else {
        LINE * names.len() as f64 + 3.0
    };
    // The numbers need room beside low pictures too.
    let height = (picture.height - head).max(66.0);
    let bar = Rect::new(left, picture.y + head, 10.0, height);
    let ramp: Vec<f32> = (0..128).rev().map(|i| i as f32).collect();
    let ramp = Plane::reduced(128, 1, &ramp, 128).coloured(map, 0.0, 127.0);
    figure.raster(bar, ramp);
    figure.rect(bar, "axis", "");
    let text = |value: f64| number(value / 10_f64.powi(exponent), 2);
    for (value, y) in [
        (high, bar.y + 10.0),
        (0.5 * (low + high), bar.y + height / 2.0 + 4.0),
        (low, bar.bottom()),
    ] {
        figure.text(bar.right() + 5.0, y, Anchor::Start, "muted", &text(value));
    }
}

/// The lowest place that a colour bar beside `picture` reaches.
pub(crate) fn bar_bottom(picture: Rect) -> f64 {
    picture.bottom().max(picture.y + 66.0 + 3.0 * LINE + 3.0)
}

/// The power of ten that is taken out of numbers of this size: none where they are short without.
fn shared_exponent(size: f64) -> i32 {
    if size.is_finite() && size > 0.0 && !(0.01..1000.0).contains(&size) {
        size.log10().floor() as i32
    } else {
        0
    }
}

/// `text` in lines of at most `width` letters, broken between words.
fn lines_of(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_string()),
        }
    }
    lines
}

/// How long a pixel is, and where.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PixelScale {
    /// Length of a pixel in µm.
    pub um: f64,
    /// `at the sensor` or `at the object`.
    pub place: &'static str,
}

impl PixelScale {
    /// On the sensor, where the pitch is known: the scale of frame, PSF and residual.
    pub(crate) fn of_sensor(sensor: &Sensor) -> Option<Self> {
        let um = sensor
            .pixel_pitch_um
            .filter(|p| p.is_finite() && *p > 0.0)?;
        Some(Self {
            um,
            place: "at the sensor",
        })
    }

    /// In the scene, where the magnification is known too, else on the sensor: the scale of the video.
    pub(crate) fn of_scene(sensor: &Sensor) -> Option<Self> {
        let on_sensor = Self::of_sensor(sensor)?;
        let magnification = sensor.magnification.filter(|m| m.is_finite() && *m > 0.0);
        Some(magnification.map_or(on_sensor, |m| Self {
            um: on_sensor.um / m,
            place: "at the object",
        }))
    }
}

/// Draws a scale bar under `place`, which shows `columns` pixels.
pub(crate) fn scale_bar(
    figure: &mut Figure,
    place: Rect,
    columns: usize,
    scale: Option<PixelScale>,
) {
    let (unit, of_pixel) = scale.map_or(("px", 1.0), |scale| ("µm", scale.um));
    let full = columns as f64 * of_pixel;
    let target = full / 4.0;
    let decade = 10_f64.powf(target.log10().floor());
    let factors = [5.0, 2.0, 1.0];
    let length = factors
        .into_iter()
        .map(|f| f * decade)
        .find(|&l| l <= target);
    let length = length.unwrap_or(decade);
    if unit == "px" && length < 1.0 {
        return;
    }
    let width = length / full * place.width;
    let y = place.bottom() + 10.0;
    let ends = [(place.x, y), (place.x + width, y)];
    figure.line(&ends, "axis", r#"style="stroke-width:2.5""#);
    let mut text = format!("{} {unit}", number(length, 3));
    if let Some(scale) = scale {
        text += &format!(" {}", scale.place);
    }
    figure.text(
        place.x + width + 7.0,
        y + 4.0,
        Anchor::Start,
        "muted",
        &text,
    );
}

/// Puts pixels in the largest fitting place of `available`; returns that place.
pub(crate) fn put(figure: &mut Figure, available: Rect, pixels: Pixels) -> Rect {
    let place = fit(available, figure.scale(), pixels.rows, pixels.columns);
    figure.raster(place, pixels);
    place
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_a_colour_bar_fit_beside_it() {
        let mut figure = Figure::new(200.0, 200.0);
        let picture = Rect::new(0.0, 0.0, 100.0, 160.0);
        let unit = "share of the light";
        colour_bar(&mut figure, picture, Map::Light, (0.0, 1.18e7), unit);
        let svg = figure.svg("bar", "").unwrap();
        for text in [
            ">share of the<",
            ">light<",
            ">×10⁷<",
            ">1.2<",
            ">0.59<",
            ">0<",
        ] {
            assert!(svg.contains(text), "{text} in {svg}");
        }
        assert!(!svg.contains("1.18"));
        assert_eq!(shared_exponent(0.0), 0);
        assert_eq!(shared_exponent(999.0), 0);
        assert_eq!(shared_exponent(0.004), -3);
        let longest = lines_of("brightness over all", 12);
        assert!(
            longest
                .iter()
                .all(|line| line.len() as f64 * LETTER <= BAR_ROOM)
        );
    }

    #[test]
    fn small_images_are_enlarged_by_a_whole_factor() {
        let place = fit(Rect::new(0.0, 0.0, 340.0, 340.0), 2.0, 108, 100);
        assert_eq!((place.width * 2.0, place.height * 2.0), (600.0, 648.0));
        let place = fit(Rect::new(0.0, 0.0, 340.0, 340.0), 2.0, 3000, 1500);
        assert_eq!((place.width, place.height), (170.0, 340.0));
        let place = fit(Rect::new(0.0, 0.0, 320.0, 320.0), 2.0, 500, 1);
        assert_eq!(place.width, 20.0);
    }
}
