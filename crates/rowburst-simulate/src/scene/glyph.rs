//! Bold digits of any size at any sub-pixel place.
//!
//! A digit is a set of strokes of constant width with round ends, drawn from its
//! centre lines. The coverage of a pixel is that of a straight edge at the distance
//! of the pixel's centre from the outline: exact to a few per cent for strokes wider
//! than a pixel, smooth under motion.

use std::f64::consts::PI;

/// Height of a digit over the size of its font: that of common sans-serif fonts.
const HEIGHT_PER_FONT_SIZE: f64 = 0.73;

/// Width of a digit over its height.
const ASPECT: f64 = 0.75;

/// Width of a stroke over the height of the digit: a bold face.
const STROKE: f64 = 0.21;

/// Height of digits of a font of `font_px` pixels, in whole pixels: 9 for 12.
pub(super) fn digit_height(font_px: usize) -> usize {
    (HEIGHT_PER_FONT_SIZE * font_px as f64).round() as usize
}

/// Width of digits of a height in pixels.
pub(super) fn digit_width(height: usize) -> usize {
    (ASPECT * height as f64).ceil() as usize
}

/// The centre lines of a digit, `(y, x)` in units of its height.
pub(super) struct Glyph {
    strokes: Vec<Vec<(f64, f64)>>,
}

impl Glyph {
    /// The digit `value`, 0 to 9.
    pub(super) fn digit(value: usize) -> Self {
        // Centre lines end half a stroke inside the box of 1 × ASPECT.
        let (top, bottom) = (0.5 * STROKE, 1.0 - 0.5 * STROKE);
        let (left, right) = (0.5 * STROKE, ASPECT - 0.5 * STROKE);
        let middle = 0.5 * ASPECT;
        let round = (0.0, 360.0);
        let six = || {
            vec![
                arc((0.635, middle), (0.26, 0.27), round),
                arc((0.6, 0.5), (0.495, 0.395), (180.0, 290.0)),
            ]
        };
        let strokes = match value {
            0 => vec![arc((0.5, middle), (0.395, 0.27), round)],
            1 => vec![
                vec![(0.26, left + 0.04), (top, 0.4), (bottom, 0.4)],
                vec![(bottom, left + 0.04), (bottom, right)],
            ],
            2 => {
                let mut bow = arc((0.335, middle), (0.23, 0.26), (190.0, 395.0));
                bow.extend([(bottom, left), (bottom, right)]);
                vec![bow]
            }
            3 => vec![
                arc((0.295, 0.36), (0.19, 0.25), (205.0, 450.0)),
                arc((0.69, 0.36), (0.205, 0.285), (-90.0, 155.0)),
            ],
            4 => vec![vec![(bottom, 0.5), (top, 0.5), (0.67, left), (0.67, right)]],
            5 => {
                let mut flag = vec![(top, right - 0.03), (top, left + 0.06), (0.46, left + 0.04)];
                flag.extend(arc((0.635, 0.36), (0.26, 0.285), (-130.0, 150.0)));
                vec![flag]
            }
            6 => six(),
            7 => vec![vec![(top, left), (top, right), (bottom, 0.28)]],
            8 => vec![
                arc((0.3, middle), (0.195, 0.225), round),
                arc((0.69, middle), (0.205, 0.27), round),
            ],
            _ => {
                let turned = |&(y, x): &(f64, f64)| (1.0 - y, ASPECT - x);
                let strokes = six();
                strokes
                    .iter()
                    .map(|s| s.iter().map(turned).collect())
                    .collect()
            }
        };
        Self { strokes }
    }

    /// Draws over a canvas of `columns` columns; where things overlap the brighter wins.
    ///
    /// `place` is the upper left corner `(y, x)` of the digit, in pixels.
    pub(super) fn draw(
        &self,
        canvas: &mut [f32],
        columns: usize,
        place: (f64, f64),
        height: usize,
    ) {
        let size = height as f64;
        let rows = canvas.len() / columns;
        let range = |start: f64, extent: f64, limit: usize| {
            let end = ((start + extent).ceil().max(0.0) as usize).min(limit);
            (start.floor().max(0.0) as usize).min(end)..end
        };
        for y in range(place.0, size, rows) {
            for x in range(place.1, ASPECT * size, columns) {
                let at = (
                    (y as f64 + 0.5 - place.0) / size,
                    (x as f64 + 0.5 - place.1) / size,
                );
                let outside = (self.distance(at) - 0.5 * STROKE) * size;
                let coverage = (0.5 - outside).clamp(0.0, 1.0) as f32;
                let pixel = &mut canvas[y * columns + x];
                *pixel = pixel.max(coverage);
            }
        }
    }

    /// Distance from `at` to the nearest centre line.
    fn distance(&self, at: (f64, f64)) -> f64 {
        let segments = self.strokes.iter().flat_map(|s| s.windows(2));
        let distances = segments.map(|ends| segment_distance(at, ends[0], ends[1]));
        distances.fold(f64::INFINITY, f64::min)
    }
}

fn segment_distance(at: (f64, f64), from: (f64, f64), to: (f64, f64)) -> f64 {
    let along = (to.0 - from.0, to.1 - from.1);
    let offset = (at.0 - from.0, at.1 - from.1);
    let square = along.0 * along.0 + along.1 * along.1;
    let part = ((offset.0 * along.0 + offset.1 * along.1) / square).clamp(0.0, 1.0);
    (offset.0 - part * along.0).hypot(offset.1 - part * along.1)
}

/// An arc of an ellipse; angles in degrees, clockwise on the screen from the right.
fn arc(centre: (f64, f64), radii: (f64, f64), degrees: (f64, f64)) -> Vec<(f64, f64)> {
    /// Chords of 10° lie within 0.2 % of the radius: far below a pixel.
    const CHORD_DEGREES: f64 = 10.0;
    let chords = ((degrees.1 - degrees.0) / CHORD_DEGREES).ceil();
    let point = |i: usize| {
        let angle = (degrees.0 + (degrees.1 - degrees.0) * i as f64 / chords) * PI / 180.0;
        (
            centre.0 + radii.0 * angle.sin(),
            centre.1 + radii.1 * angle.cos(),
        )
    };
    (0..=chords as usize).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(value: usize, place: (f64, f64), height: usize) -> Vec<f32> {
        let mut canvas = vec![0.0; 40 * 40];
        Glyph::digit(value).draw(&mut canvas, 40, place, height);
        canvas
    }

    #[test]
    fn digits_fill_their_box_and_stay_in_it() {
        for value in 0..10 {
            let (place, height) = ((5.0, 7.0), 20);
            let canvas = drawn(value, place, height);
            let ink = |y: usize| canvas[y * 40..(y + 1) * 40].iter().any(|&p| p > 0.5);
            let rows: Vec<usize> = (0..40).filter(|&y| ink(y)).collect();
            assert_eq!((rows[0], rows.len()), (5, 20), "digit {value}");
            for (i, &p) in canvas.iter().enumerate() {
                let inside = (5..25).contains(&(i / 40)) && (7..22).contains(&(i % 40));
                assert!(inside || p == 0.0, "digit {value} at {} {}", i / 40, i % 40);
            }
        }
    }

    #[test]
    fn digits_differ() {
        for a in 0..10 {
            for b in 0..a {
                let (one, other) = (drawn(a, (5.0, 5.0), 9), drawn(b, (5.0, 5.0), 9));
                let difference: f32 = one.iter().zip(&other).map(|(p, q)| (p - q).abs()).sum();
                assert!(difference > 4.0, "{a} {b}: {difference}");
            }
        }
    }

    #[test]
    fn sub_pixel_motion_moves_the_centre_of_mass() {
        let centre = |place: (f64, f64)| {
            let canvas = drawn(3, place, 13);
            let sum: f32 = canvas.iter().sum();
            let moment = |f: fn(usize) -> usize| {
                canvas
                    .iter()
                    .enumerate()
                    .map(|(i, p)| f(i) as f32 * p)
                    .sum::<f32>()
                    / sum
            };
            (moment(|i| i / 40), moment(|i| i % 40))
        };
        let (before, after) = (centre((8.0, 8.0)), centre((8.3, 8.6)));
        assert!(
            (after.0 - before.0 - 0.3).abs() < 0.05,
            "{before:?} {after:?}"
        );
        assert!(
            (after.1 - before.1 - 0.6).abs() < 0.05,
            "{before:?} {after:?}"
        );
    }
}
