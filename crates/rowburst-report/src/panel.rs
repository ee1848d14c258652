//! One picture in a figure: pixels in place, a colour bar, a scale bar.

use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::format::number;
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

/// Draws a vertical colour bar right of `picture`, from `low` (below) to `high` (above),
/// and the name of the quantity above it.
pub(crate) fn colour_bar(
    figure: &mut Figure,
    picture: Rect,
    map: Map,
    (low, high): (f32, f32),
    unit: &str,
) {
    // The numbers, and the name of the quantity, need room beside low pictures too.
    let height = picture
        .height
        .max(if unit.is_empty() { 80.0 } else { 112.0 });
    let bar = Rect::new(picture.right() + 10.0, picture.y, 10.0, height);
    let ramp: Vec<f32> = (0..128).rev().map(|i| i as f32).collect();
    let ramp = Plane::reduced(128, 1, &ramp, 128).coloured(map, 0.0, 127.0);
    figure.raster(bar, ramp);
    figure.rect(bar, "axis", "");
    let (low, high) = (f64::from(low), f64::from(high));
    let middle = number(0.5 * (low + high), 3);
    for (text, y) in [
        (number(high, 3), bar.y + 10.0),
        (middle, bar.y + height / 2.0 + 4.0),
        (number(low, 3), bar.bottom()),
    ] {
        // The name of the quantity stands beside the middle: a long number would meet it.
        let meets = !unit.is_empty() && y > bar.y + 10.0 && y < bar.bottom();
        if !(meets && text.chars().count() > 5) {
            figure.text(bar.right() + 5.0, y, Anchor::Start, "muted", &text);
        }
    }
    figure.text_upwards(bar.right() + 56.0, bar.y + height / 2.0, "muted", unit);
}

/// Draws a scale bar under `place`, which shows `columns` pixels of `pitch_um` each.
pub(crate) fn scale_bar(figure: &mut Figure, place: Rect, columns: usize, pitch_um: Option<f64>) {
    let pitch_um = pitch_um.filter(|p| p.is_finite() && *p > 0.0);
    let (unit, of_pixel) = pitch_um.map_or(("px", 1.0), |pitch| ("µm", pitch));
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
    let text = format!("{} {unit}", number(length, 3));
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
    fn small_images_are_enlarged_by_a_whole_factor() {
        let place = fit(Rect::new(0.0, 0.0, 340.0, 340.0), 2.0, 108, 100);
        assert_eq!((place.width * 2.0, place.height * 2.0), (600.0, 648.0));
        let place = fit(Rect::new(0.0, 0.0, 340.0, 340.0), 2.0, 3000, 1500);
        assert_eq!((place.width, place.height), (170.0, 340.0));
        let place = fit(Rect::new(0.0, 0.0, 320.0, 320.0), 2.0, 500, 1);
        assert_eq!(place.width, 20.0);
    }
}
