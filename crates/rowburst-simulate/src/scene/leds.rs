//! Three blinking LEDs, the paper's demonstration of speed.
//!
//! Each is a 200 µm fibre imaged at ×22.5 demagnification onto a disc of 8.9 µm,
//! blurred by the lens to a Gaussian spot:
//!
//! ```text
//! v[t, y, x] = on(t) · exp(−((y − y₀)² + (x − x₀)²)/(2σ²))
//! ```
//!
//! `on(t)` is the part of bin `t` in which the LED is lit, a square wave of duty ½
//! integrated over the bin in closed form.

use super::super::require_positive;
use super::require_field_size;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rowburst_core::{Parameter, Result, Shape};
use rowburst_optics::Video;

/// Frequencies of the LEDs in hertz: periods of 5, 3 and 2 bins of 9.6 µs.
pub const LED_FREQUENCIES_HZ: [f64; 3] = [20_833.0, 34_722.0, 52_083.0];

/// Diameter of the image of a fibre: 200 µm / 22.5.
const SPOT_DIAMETER_UM: f64 = 200.0 / 22.5;

/// Rms blur of the lens along an axis: with the disc and a pixel of 6.5 µm it makes a
/// spot of 0.81 px rms, 1.9 px at half maximum.
const LENS_BLUR_UM: f64 = 4.4;

/// The spot is a Gaussian to this many standard deviations, and lies as far inside.
const SPOT_SIGMAS: f64 = 5.0;

/// One LED of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Led {
    /// Row of its centre in pixels of the field.
    pub y: f64,
    /// Column of its centre in pixels of the field.
    pub x: f64,
    /// Frequency in hertz.
    pub frequency_hz: f64,
    /// Phase at the start of bin 0, in periods from 0 to 1; lit while it is below ½.
    pub phase: f64,
}

impl Led {
    /// The part of a bin, 0 to 1, in which the LED is lit.
    ///
    /// # Units
    /// `start_us` is counted from the start of bin 0.
    pub fn mean_intensity(&self, start_us: f64, duration_us: f64) -> f64 {
        let periods = |time_us: f64| self.frequency_hz * 1e-6 * time_us + self.phase;
        let lit_until = |u: f64| 0.5 * u.floor() + (u - u.floor()).min(0.5);
        let (from, to) = (periods(start_us), periods(start_us + duration_us));
        (lit_until(to) - lit_until(from)) / (to - from)
    }
}

/// Three LEDs of 20,833, 34,722 and 52,083 Hz at random places and phases.
///
/// The peak of a spot is 1 where its LED is lit for the whole bin. Spots lie whole
/// inside the field, at least a quarter of its longer side apart.
///
/// # Units
/// Microseconds for the duration of a bin, micrometres for the pitch of a pixel.
///
/// # Errors
/// A duration or pitch that is not above zero, a field that is smaller than a spot.
pub fn leds(
    shape: Shape,
    bin_duration_us: f64,
    pixel_pitch_um: f64,
    seed: u64,
) -> Result<(Video, Vec<Led>)> {
    require_positive(
        Parameter::RowTimeUs,
        bin_duration_us,
        "microseconds",
        "Take that of the camera's time grid.",
    )?;
    require_positive(
        Parameter::PixelPitchUm,
        pixel_pitch_um,
        "micrometres",
        "Read it from the camera's data sheet.",
    )?;
    let sigma = spot_sigma_px(pixel_pitch_um);
    let reach = SPOT_SIGMAS * sigma;
    let side = (2.0 * reach).ceil() as usize + 1;
    require_field_size(shape, side, side, "a spot")?;

    let mut rng = Pcg64::seed_from_u64(seed);
    let mut video = Video::zeros(shape);
    let mut leds: Vec<Led> = Vec::new();
    for frequency_hz in LED_FREQUENCIES_HZ {
        let (y, x) = place(shape, reach, &leds, &mut rng);
        let led = Led {
            y,
            x,
            frequency_hz,
            phase: rng.random(),
        };
        let spot = spot(&led, shape, sigma);
        for t in 0..shape.bins {
            let on = led.mean_intensity(t as f64 * bin_duration_us, bin_duration_us) as f32;
            let bin = video.bin_mut(t);
            for &(at, value) in &spot {
                bin[at] = bin[at].max(on * value);
            }
        }
        leds.push(led);
    }
    Ok((video, leds))
}

/// Variances of disc, lens and pixel add up.
fn spot_sigma_px(pixel_pitch_um: f64) -> f64 {
    let disc = SPOT_DIAMETER_UM / 4.0;
    let pixel = pixel_pitch_um / 12f64.sqrt();
    (disc * disc + LENS_BLUR_UM * LENS_BLUR_UM + pixel * pixel).sqrt() / pixel_pitch_um
}

/// A random place, `reach` inside the field and away from the others where possible.
fn place(shape: Shape, reach: f64, others: &[Led], rng: &mut Pcg64) -> (f64, f64) {
    /// Far more than are ever needed: the others exclude at most three quarters of the field.
    const TRIES: usize = 1000;
    let free_length = |side: usize| (side as f64 - 1.0 - 2.0 * reach).max(0.0);
    let (rows, columns) = (free_length(shape.rows), free_length(shape.columns));
    let apart = 0.25 * rows.max(columns);
    let mut at = (0.0, 0.0);
    for _ in 0..TRIES {
        at = (
            reach + rows * rng.random::<f64>(),
            reach + columns * rng.random::<f64>(),
        );
        if others
            .iter()
            .all(|o| (o.y - at.0).hypot(o.x - at.1) >= apart)
        {
            break;
        }
    }
    at
}

/// Index and value of the pixels of a spot.
fn spot(led: &Led, shape: Shape, sigma: f64) -> Vec<(usize, f32)> {
    let reach = SPOT_SIGMAS * sigma;
    let range = |centre: f64, side: usize| {
        let first = (centre - reach).ceil().max(0.0) as usize;
        first..((centre + reach).floor() as usize + 1).min(side)
    };
    let mut pixels = Vec::new();
    for y in range(led.y, shape.rows) {
        for x in range(led.x, shape.columns) {
            let square = (y as f64 - led.y).powi(2) + (x as f64 - led.x).powi(2);
            let value = (-0.5 * square / (sigma * sigma)).exp();
            pixels.push((y * shape.columns + x, value as f32));
        }
    }
    pixels
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: Shape = Shape {
        bins: 54,
        rows: 108,
        columns: 90,
    };

    #[test]
    fn bins_hold_the_integral_of_the_square_wave() {
        let led = Led {
            y: 0.0,
            x: 0.0,
            frequency_hz: 37_000.0,
            phase: 0.83,
        };
        for duration in [0.7, 9.6, 50.0] {
            for bin in 0..40 {
                let start = f64::from(bin) * duration;
                let lit = |i: u32| {
                    let time = start + (f64::from(i) + 0.5) / 20_000.0 * duration;
                    u32::from((led.frequency_hz * 1e-6 * time + led.phase).fract() < 0.5)
                };
                let want = f64::from((0..20_000).map(lit).sum::<u32>()) / 20_000.0;
                let got = led.mean_intensity(start, duration);
                assert!((got - want).abs() < 1e-3, "{duration} {bin}: {got} {want}");
            }
        }
    }

    #[test]
    fn traces_follow_the_leds() {
        let (video, leds) = leds(SHAPE, 9.6, 6.5, 3).unwrap();
        assert!(video.max() <= 1.0 && video.max() > 0.6);
        for led in &leds {
            let (y, x) = (led.y.round(), led.x.round());
            let trace = video.trace(y as usize, x as usize);
            let square = (y - led.y).powi(2) + (x - led.x).powi(2);
            let spot = (-0.5 * square / spot_sigma_px(6.5).powi(2)).exp();
            for (t, value) in trace.iter().enumerate() {
                let want = spot * led.mean_intensity(9.6 * t as f64, 9.6);
                assert!((f64::from(*value) - want).abs() < 1e-5, "{led:?} {t}");
            }
        }
        // 52,083 Hz is two bins of 9.6 µs a period.
        let fast = &leds[2];
        let sum = fast.mean_intensity(0.0, 9.6) + fast.mean_intensity(9.6, 9.6);
        assert!((sum - 1.0).abs() < 1e-4);
    }

    #[test]
    fn spots_lie_inside_and_apart() {
        for seed in 0..50 {
            let (_, leds) = leds(SHAPE, 9.6, 6.5, seed).unwrap();
            for (i, a) in leds.iter().enumerate() {
                assert!((4.0..103.0).contains(&a.y) && (4.0..85.0).contains(&a.x));
                for b in &leds[..i] {
                    assert!((a.y - b.y).hypot(a.x - b.x) > 20.0, "{leds:?}");
                }
            }
        }
    }

    #[test]
    fn spot_is_that_of_the_paper() {
        assert!((spot_sigma_px(6.5) - 0.81).abs() < 0.01);
    }

    #[test]
    fn bad_input_is_refused_and_seeds_decide() {
        assert!(leds(SHAPE, 0.0, 6.5, 0).is_err());
        assert!(leds(SHAPE, 9.6, f64::NAN, 0).is_err());
        assert!(leds(Shape::new(5, 8, 90), 9.6, 6.5, 0).is_err());
        assert_eq!(leds(SHAPE, 9.6, 6.5, 1), leds(SHAPE, 9.6, 6.5, 1));
        assert_ne!(leds(SHAPE, 9.6, 6.5, 1), leds(SHAPE, 9.6, 6.5, 2));
    }
}
