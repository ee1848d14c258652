//! Digits: one in every bin (the paper's Fig. 2), or moving through the bins.

use super::glyph::{Glyph, digit_height, digit_width};
use super::require_field_size;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rowburst_core::{Error, Parameter, Result, Shape};
use rowburst_optics::Video;

/// Smallest font whose digits can be told apart (4 px high).
const MIN_FONT_PX: usize = 6;

/// Fastest motion along any direction, in pixels per bin.
const MAX_SPEED_PX: f64 = 0.8;

/// Slowest motion in pixels per bin, where the field has room for it.
const MIN_SPEED_PX: f64 = 0.3;

/// One bold antialiased digit in every bin, `t mod 10`, each at a random place.
///
/// A font of `height_px` has digits 0.73 as high: 9 px for 12, 13 px for 18. Digits
/// sit on whole pixels and are never cut off. Values are 0 to 1.
///
/// # Errors
/// A font below 6 px, or a field that a digit does not fit into.
pub fn digits(shape: Shape, height_px: usize, seed: u64) -> Result<Video> {
    let (height, width) = check(shape, height_px)?;
    let glyphs: Vec<Glyph> = (0..10).map(Glyph::digit).collect();
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut video = Video::zeros(shape);
    for t in 0..shape.bins {
        let top = rng.random_range(0..=shape.rows - height);
        let left = rng.random_range(0..=shape.columns - width);
        let place = (top as f64, left as f64);
        glyphs[t % 10].draw(video.bin_mut(t), shape.columns, place, height);
    }
    Ok(video)
}

/// `digits` random digits that move in straight lines at up to 0.8 px per bin.
///
/// Direction and speed (0.3 to 0.8 px per bin) are random for each digit, slower
/// along an axis whose room they would leave: no digit is ever cut off. Places are
/// sub-pixel, those at the middle of each bin. Where digits overlap the brighter
/// pixel wins. The font is that of [`digits()`].
///
/// # Errors
/// No digit, a font below 6 px, or a field that a digit does not fit into.
pub fn moving_digit(shape: Shape, height_px: usize, digits: usize, seed: u64) -> Result<Video> {
    let (height, width) = check(shape, height_px)?;
    if digits == 0 {
        return Err(Error::input(
            Parameter::Digits,
            digits,
            "a scene of moving digits has at least one",
            "Give 1 for a single digit.",
        ));
    }
    let mut rng = Pcg64::seed_from_u64(seed);
    let mut video = Video::zeros(shape);
    let steps = (shape.bins - 1) as f64;
    for _ in 0..digits {
        let glyph = Glyph::digit(rng.random_range(0..10));
        let speed = rng.random_range(MIN_SPEED_PX..MAX_SPEED_PX);
        let angle: f64 = rng.random_range(0.0..std::f64::consts::TAU);
        let mut line = |free_length: usize, wish: f64| {
            let free_length = free_length as f64;
            let path = (wish * steps).clamp(-free_length, free_length);
            let low = (-path).max(0.0);
            let high = free_length - path.max(0.0);
            let start = low + (high - low) * rng.random::<f64>();
            (start, if steps > 0.0 { path / steps } else { 0.0 })
        };
        let (y, vy) = line(shape.rows - height, speed * angle.sin());
        let (x, vx) = line(shape.columns - width, speed * angle.cos());
        for t in 0..shape.bins {
            let place = (y + vy * t as f64, x + vx * t as f64);
            glyph.draw(video.bin_mut(t), shape.columns, place, height);
        }
    }
    Ok(video)
}

/// Height and width of the digits.
fn check(shape: Shape, height_px: usize) -> Result<(usize, usize)> {
    if height_px < MIN_FONT_PX {
        return Err(Error::input(
            Parameter::HeightPx,
            height_px,
            format!("digits are legible from a font of {MIN_FONT_PX} px"),
            "The paper's scenes have 12 and 18.",
        ));
    }
    let height = digit_height(height_px);
    let width = digit_width(height);
    require_field_size(shape, height, width, "a digit")?;
    Ok((height, width))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ink(bin: &[f32]) -> f32 {
        bin.iter().sum()
    }

    #[test]
    fn every_bin_has_one_whole_digit_at_its_own_place() {
        let shape = Shape::new(54, 40, 60);
        let video = digits(shape, 12, 1).unwrap();
        for t in 0..54 {
            let bin = video.bin(t);
            assert!(bin.iter().all(|p| (0.0..=1.0).contains(p)));
            assert!(bin.iter().copied().fold(0.0, f32::max) > 0.95);
            // The same digit elsewhere has the same ink, so none is cut off.
            assert!((ink(bin) - ink(video.bin(t % 10))).abs() < 1e-3, "bin {t}");
            let row = bin.iter().position(|&p| p > 0.0).unwrap() / 60;
            let last = 39 - bin.iter().rev().position(|&p| p > 0.0).unwrap() / 60;
            assert_eq!(last - row + 1, 9);
        }
        assert_ne!(video.bin(0), video.bin(10));
    }

    #[test]
    fn a_digit_fits_exactly() {
        let video = digits(Shape::new(20, 13, 10), 18, 5).unwrap();
        for t in 0..10 {
            assert_eq!(video.bin(t), video.bin(t + 10));
        }
    }

    #[test]
    fn moving_digits_stay_inside_and_move_evenly() {
        for seed in 0..20 {
            let shape = Shape::new(54, 50, 40);
            let video = moving_digit(shape, 18, 1, seed).unwrap();
            let centre = |t: usize| {
                let bin = video.bin(t);
                let moment = |f: fn(usize) -> usize| {
                    bin.iter()
                        .enumerate()
                        .map(|(i, p)| f(i) as f32 * p)
                        .sum::<f32>()
                        / ink(bin)
                };
                (moment(|i| i / 40), moment(|i| i % 40))
            };
            let (first, last) = (centre(0), centre(53));
            let step = ((last.0 - first.0) / 53.0, (last.1 - first.1) / 53.0);
            assert!(step.0.hypot(step.1) < 0.81, "{step:?}");
            for t in 0..54 {
                assert!((ink(video.bin(t)) / ink(video.bin(0)) - 1.0).abs() < 0.05);
                let (y, x) = centre(t);
                assert!((y - first.0 - step.0 * t as f32).abs() < 0.1, "{t}");
                assert!((x - first.1 - step.1 * t as f32).abs() < 0.1, "{t}");
            }
        }
    }

    #[test]
    fn seeds_decide() {
        let shape = Shape::new(6, 40, 40);
        assert_eq!(digits(shape, 12, 3), digits(shape, 12, 3));
        assert_ne!(digits(shape, 12, 3), digits(shape, 12, 4));
        assert_eq!(moving_digit(shape, 12, 3, 3), moving_digit(shape, 12, 3, 3));
        assert_ne!(moving_digit(shape, 12, 3, 3), moving_digit(shape, 12, 3, 4));
    }

    #[test]
    fn bad_input_is_refused() {
        assert!(digits(Shape::new(2, 8, 40), 12, 0).is_err());
        assert!(digits(Shape::new(2, 40, 6), 12, 0).is_err());
        assert!(digits(Shape::new(0, 40, 40), 12, 0).is_err());
        assert!(digits(Shape::new(2, 40, 40), 0, 0).is_err());
        assert!(moving_digit(Shape::new(2, 40, 40), 12, 0, 0).is_err());
        assert!(moving_digit(Shape::new(1, 40, 40), 12, 2, 0).is_ok());
    }
}
