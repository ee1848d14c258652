//! What a sensor adds to the light: noise, bias, counts.
//!
//! `b` is the noiseless frame (`A v`), `s` the `scale` that is returned:
//!
//! ```text
//! None      frame = s·b + bias
//! Gaussian  frame = s·b + bias + N(0, σ²),        σ = s·rms(b)/snr
//! Camera    frame = (Poisson(e) + N(0, read²))/gain + bias,   e = b·peak_electrons/max(b)
//! ```
//!
//! **Units.** `Camera` gives counts. The others give counts where the sensor says
//! what a count is (`bit_depth`, `bias_counts` or `full_well_counts` is known):
//! `s` then puts the brightest pixel at 90 % of the range, the lower of full well
//! and converter's end (16 bits where neither is known). Otherwise they leave the
//! frame in its own units: `s = 1`, no bias.
//! With `bit_depth`, `Gaussian` and `Camera` round to whole counts from 0;
//! both end at saturation. `None` does neither: what is asked for is no error.
//!
//! Reference: J. R. Janesick, Photon Transfer (SPIE 2007), chapter 3.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Poisson, StandardNormal};
use rand_pcg::Pcg64;
use rowburst_core::{Error, ErrorKind, Parameter, Result};
use rowburst_optics::{Image, Sensor};

/// Noise of a simulated frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Noise {
    /// No noise.
    None,
    /// The same white noise everywhere, as the paper's simulations have it.
    Gaussian {
        /// Rms of the noiseless frame over the standard deviation of the noise.
        snr: f64,
    },
    /// Shot noise and read noise of the sensor.
    ///
    /// What the sensor does not say is taken as 1 electron per count, no read noise,
    /// no bias and no saturation.
    Camera {
        /// Mean electrons of the brightest pixel of the noiseless frame (raw pixel,
        /// before binning).
        peak_electrons: f64,
    },
}

/// A frame as the sensor records it.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedFrame {
    /// The frame, bias included.
    pub frame: Image,
    /// Rms noise in units of the frame, that of rounding included, as the model has
    /// it (mean over the pixels, no clipping).
    pub sigma: f64,
    /// Units of the frame per unit of the noiseless frame; the truth times this is in
    /// the units of what is reconstructed from the frame.
    pub scale: f64,
    /// Pixels at or above saturation.
    pub saturated: usize,
}

/// Where the brightest pixel is put in the range of a sensor whose gain is free.
const PEAK_OF_RANGE: f64 = 0.9;

/// Range of a sensor that says its bias but not where it ends.
const DEFAULT_RANGE: f64 = 65535.0;

/// Variance of rounding to whole counts.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

impl Noise {
    /// Records `noiseless` with `sensor`.
    ///
    /// A pixel of a binned sensor is the mean of `binning²` raw pixels, each with its
    /// own shot noise, read noise, saturation and rounding (`Camera` only); it counts
    /// as saturated when one of them is.
    ///
    /// # Units
    /// `noiseless` in any unit of light; see the module for those of the frame.
    ///
    /// # Errors
    /// A noiseless frame with a value that is not finite or is negative, or without
    /// light; an `snr` or `peak_electrons` that is not a number above zero; a bias at
    /// or above 90 % of the range.
    pub fn apply(&self, noiseless: &Image, sensor: &Sensor, seed: u64) -> Result<SimulatedFrame> {
        let peak = check_light(noiseless)?;
        let mut rng = Pcg64::seed_from_u64(seed);
        match *self {
            Self::None => {
                let (scale, bias) = own_units_or_counts(sensor, peak)?;
                let value = |b: f64| scale * b + bias;
                Ok(record(noiseless, scale, 0.0, |b| (value(b), false)))
            }
            Self::Gaussian { snr } => {
                require_positive(
                    Parameter::Snr,
                    snr,
                    "Give 256 for the paper's, or no noise at all.",
                )?;
                let (scale, bias) = own_units_or_counts(sensor, peak)?;
                let sigma = scale * rms(noiseless) / snr;
                let rounding = sensor.bit_depth.map_or(0.0, |_| ROUNDING_VARIANCE);
                let total = (sigma * sigma + rounding).sqrt();
                Ok(record(noiseless, scale, total, |b| {
                    let draw: f64 = rng.sample(StandardNormal);
                    digitise(sensor, scale * b + bias + sigma * draw)
                }))
            }
            Self::Camera { peak_electrons } => {
                let remedy = "Give the electrons of the brightest pixel, below the full well.";
                require_positive(Parameter::PeakElectrons, peak_electrons, remedy)?;
                camera(noiseless, peak, peak_electrons, sensor, &mut rng)
            }
        }
    }
}

fn camera(
    noiseless: &Image,
    peak: f64,
    peak_electrons: f64,
    sensor: &Sensor,
    rng: &mut Pcg64,
) -> Result<SimulatedFrame> {
    let gain = sensor.gain_electrons_per_count.unwrap_or(1.0);
    let read = sensor.read_noise_electrons.unwrap_or(0.0);
    let bias = sensor.bias_counts.unwrap_or(0.0);
    let raw_pixels = sensor.binning * sensor.binning;
    let electrons_per_unit = peak_electrons / peak;
    if peak_electrons > Poisson::<f64>::MAX_LAMBDA || !electrons_per_unit.is_finite() {
        return Err(Error::input(
            Parameter::PeakElectrons,
            peak_electrons,
            "a pixel holds fewer electrons",
            "Full wells hold 10⁴ to 10⁶ electrons.",
        ));
    }
    let mean_light =
        noiseless.data().iter().map(|&b| f64::from(b)).sum::<f64>() / noiseless.data().len() as f64;
    let rounding = sensor.bit_depth.map_or(0.0, |_| ROUNDING_VARIANCE);
    let variance = (electrons_per_unit * mean_light + read * read) / (gain * gain) + rounding;
    let sigma = (variance / raw_pixels as f64).sqrt();
    Ok(record(noiseless, electrons_per_unit / gain, sigma, |b| {
        let shot = Poisson::new(b * electrons_per_unit).ok();
        let (mut sum, mut any_full) = (0.0, false);
        for _ in 0..raw_pixels {
            // No distribution has a mean of zero: no light, no electrons.
            let electrons = shot.map_or(0.0, |shot| shot.sample(rng));
            let draw: f64 = rng.sample(StandardNormal);
            let (counts, full) = digitise(sensor, (electrons + read * draw) / gain + bias);
            sum += counts;
            any_full |= full;
        }
        (sum / raw_pixels as f64, any_full)
    }))
}

/// Maps every pixel by `value`, which says whether it is saturated.
fn record(
    noiseless: &Image,
    scale: f64,
    sigma: f64,
    mut value: impl FnMut(f64) -> (f64, bool),
) -> SimulatedFrame {
    let mut frame = noiseless.clone();
    let mut saturated = 0;
    for pixel in frame.data_mut() {
        let (recorded, full) = value(f64::from(*pixel));
        *pixel = recorded as f32;
        saturated += usize::from(full);
    }
    SimulatedFrame {
        frame,
        sigma,
        scale,
        saturated,
    }
}

/// Rounds and clips as the sensor does, and says whether the value is saturated.
fn digitise(sensor: &Sensor, counts: f64) -> (f64, bool) {
    let counts = match sensor.bit_depth {
        Some(_) => counts.round().max(0.0),
        None => counts,
    };
    match sensor.saturation_counts() {
        Some(end) if counts >= end => (end, true),
        _ => (counts, false),
    }
}

/// Scale and bias where the gain is free: see the module's "Units".
fn own_units_or_counts(sensor: &Sensor, peak: f64) -> Result<(f64, f64)> {
    let counts = sensor.bit_depth.is_some()
        || sensor.bias_counts.is_some()
        || sensor.full_well_counts.is_some();
    if !counts {
        return Ok((1.0, 0.0));
    }
    let bias = sensor.bias_counts.unwrap_or(0.0);
    let brightest = PEAK_OF_RANGE * sensor.saturation_counts().unwrap_or(DEFAULT_RANGE);
    if bias >= brightest {
        return Err(Error::input(
            Parameter::BiasCounts,
            bias,
            format!("the bias lies below 90 % of the range, {brightest:.0} counts"),
            "Check bias_counts against bit_depth and full_well_counts.",
        ));
    }
    Ok(((brightest - bias) / peak, bias))
}

/// The brightest pixel of a frame of light.
fn check_light(noiseless: &Image) -> Result<f64> {
    let bad = |p: &f32| !p.is_finite() || *p < 0.0;
    if let Some(at) = noiseless.data().iter().position(bad) {
        let (y, x) = (at / noiseless.columns(), at % noiseless.columns());
        return Err(Error::input(
            Parameter::NoiselessFrame,
            format!("{} at row {y}, column {x}", noiseless.at(y, x)),
            "light is a finite number and never negative",
            "Check the scene and the PSF that the frame was made from.",
        )
        .with_kind(ErrorKind::NotFinite));
    }
    let peak = f64::from(noiseless.max());
    if peak > 0.0 {
        return Ok(peak);
    }
    Err(Error::input(
        Parameter::NoiselessFrame,
        "no light",
        "the brightest pixel is above zero, or noise cannot be set in proportion to it",
        "Check that the scene is not empty and lies where the PSF sends light to the sensor.",
    )
    .with_kind(ErrorKind::NoSignal))
}

fn rms(image: &Image) -> f64 {
    let square: f64 = image.data().iter().map(|&p| f64::from(p).powi(2)).sum();
    (square / image.data().len() as f64).sqrt()
}

fn require_positive(parameter: Parameter, value: f64, remedy: &'static str) -> Result<()> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    Err(Error::input(
        parameter,
        value,
        "a number above zero is needed",
        remedy,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Half of the pixels at 0.25, half at 1.
    fn two_levels() -> Image {
        Image::from_fn(300, 400, |_, x| if x < 200 { 0.25 } else { 1.0 })
    }

    fn sensor() -> Sensor {
        Sensor {
            gain_electrons_per_count: Some(0.5),
            read_noise_electrons: Some(3.0),
            bias_counts: Some(100.0),
            ..Sensor::default()
        }
    }

    /// Mean and variance of the left and of the right half.
    fn halves(frame: &Image) -> [(f64, f64); 2] {
        [0, 200].map(|start| {
            let pixels = || {
                (0..frame.rows()).flat_map(move |y| {
                    frame.row(y)[start..start + 200]
                        .iter()
                        .map(|&p| f64::from(p))
                })
            };
            let count = (frame.rows() * 200) as f64;
            let mean = pixels().sum::<f64>() / count;
            (
                mean,
                pixels().map(|p| (p - mean).powi(2)).sum::<f64>() / count,
            )
        })
    }

    fn near(got: f64, want: f64, relative: f64) {
        assert!((got - want).abs() <= relative * want.abs(), "{got} {want}");
    }

    #[test]
    fn gaussian_noise_has_the_snr() {
        let noise = Noise::Gaussian { snr: 50.0 };
        let out = noise.apply(&two_levels(), &Sensor::default(), 1).unwrap();
        let sigma = (0.5f64 * (1.0 + 0.0625)).sqrt() / 50.0;
        near(out.sigma, sigma, 1e-9);
        assert_eq!((out.scale, out.saturated), (1.0, 0));
        for ((mean, variance), level) in halves(&out.frame).into_iter().zip([0.25, 1.0]) {
            near(mean, level, 1e-3);
            near(variance, sigma * sigma, 0.03);
        }
    }

    #[test]
    fn camera_noise_is_shot_and_read_noise() {
        let noise = Noise::Camera {
            peak_electrons: 80.0,
        };
        let out = noise.apply(&two_levels(), &sensor(), 2).unwrap();
        near(out.scale, 160.0, 1e-9);
        for ((mean, variance), electrons) in halves(&out.frame).into_iter().zip([20.0, 80.0]) {
            near(mean, 100.0 + electrons / 0.5, 2e-3);
            near(variance, (electrons + 9.0) / 0.25, 0.03);
        }
        near(out.sigma, ((50.0 + 9.0) / 0.25f64).sqrt(), 1e-9);
    }

    #[test]
    fn binning_averages_raw_pixels() {
        let binned = Sensor {
            binning: 3,
            ..sensor()
        };
        let noise = Noise::Camera {
            peak_electrons: 80.0,
        };
        let out = noise.apply(&two_levels(), &binned, 2).unwrap();
        near(halves(&out.frame)[1].1, 89.0 / 0.25 / 9.0, 0.03);
        near(out.sigma, (59.0 / 0.25 / 9.0f64).sqrt(), 1e-9);
    }

    #[test]
    fn pixels_saturate_and_are_counted() {
        let full = Sensor {
            full_well_counts: Some(200.0),
            bit_depth: Some(12),
            ..sensor()
        };
        // The bright half at 100 + 160 counts, sigma 18.9; the dark half at 140.
        let noise = Noise::Camera {
            peak_electrons: 80.0,
        };
        let out = noise.apply(&two_levels(), &full, 3).unwrap();
        let at_end = out.frame.data().iter().filter(|&&p| p == 200.0).count();
        assert_eq!(out.saturated, at_end);
        near(at_end as f64, 60_000.0, 0.01);
        assert_eq!(out.frame.max(), 200.0);
    }

    #[test]
    fn a_bit_depth_gives_whole_counts_within_the_range() {
        let eight = Sensor {
            bit_depth: Some(8),
            bias_counts: Some(4.0),
            ..Sensor::default()
        };
        let out = Noise::Gaussian { snr: 2.0 }
            .apply(&two_levels(), &eight, 4)
            .unwrap();
        near(out.scale, 0.9 * 255.0 - 4.0, 1e-6);
        assert!(out.frame.data().iter().all(|p| p.fract() == 0.0));
        assert_eq!((out.frame.min(), out.frame.max()), (0.0, 255.0));
        assert!(out.saturated > 0);

        let quiet = Noise::Gaussian { snr: 1e9 }
            .apply(&two_levels(), &eight, 4)
            .unwrap();
        near(quiet.sigma, (1.0f64 / 12.0).sqrt(), 1e-6);

        let none = Noise::None.apply(&two_levels(), &eight, 4).unwrap();
        assert!((none.frame.max() - 229.5).abs() < 1e-4);
        assert_eq!((none.sigma, none.scale), (0.0, out.scale));
    }

    #[test]
    fn no_noise_and_no_counts_is_the_frame_itself() {
        let out = Noise::None
            .apply(&two_levels(), &Sensor::default(), 0)
            .unwrap();
        assert_eq!(out.frame, two_levels());
        assert_eq!((out.sigma, out.scale), (0.0, 1.0));
    }

    #[test]
    fn seeds_decide() {
        for noise in [
            Noise::Gaussian { snr: 10.0 },
            Noise::Camera {
                peak_electrons: 50.0,
            },
        ] {
            let frame = |seed| noise.apply(&two_levels(), &sensor(), seed).unwrap().frame;
            assert_eq!(frame(1), frame(1));
            assert_ne!(frame(1), frame(2));
        }
    }

    #[test]
    fn bad_input_is_refused() {
        let refused = |noise: Noise, image: &Image, word: &str| {
            let error = noise.apply(image, &Sensor::default(), 0).unwrap_err();
            assert!(error.to_string().contains(word), "{error}");
        };
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            refused(Noise::Gaussian { snr: bad }, &two_levels(), "snr");
            let camera = Noise::Camera {
                peak_electrons: bad,
            };
            refused(camera, &two_levels(), "peak_electrons");
        }
        refused(Noise::None, &Image::zeros(2, 2), "no light");
        for bad in [f32::NAN, -0.1] {
            let image = Image::from_fn(2, 3, |y, x| if (y, x) == (1, 2) { bad } else { 1.0 });
            refused(Noise::None, &image, "row 1, column 2");
        }
        let high = Sensor {
            bias_counts: Some(250.0),
            bit_depth: Some(8),
            ..Sensor::default()
        };
        assert!(Noise::None.apply(&two_levels(), &high, 0).is_err());
    }
}
