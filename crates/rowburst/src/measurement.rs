//! From raw counts to a measurement: what the sensor did to the light is undone.
//!
//! `b = (raw − dark) / flat`; pixels that are bad or saturated get weight zero, and
//! where gain and read noise are known all others get the weight of their noise,
//! `σ² = (counts·gain + read²) / gain²` counts².

use crate::{Camera, Error, Image, Result};

/// A frame that may be handed to a solver.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    image: Image,
    weights: Option<Vec<f32>>,
    sigma: Option<f64>,
    bad: usize,
    saturated: usize,
}

/// What is known of the sensor beside [`crate::Sensor`]; all on the grid of the raw frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Corrections {
    /// Counts without light; takes the place of `bias_counts`.
    pub dark: Option<Image>,
    /// Response to even light; only its shape matters.
    pub flat: Option<Image>,
    /// Pixels that are not to be used: anything but zero.
    pub bad_pixels: Option<Image>,
    /// Counts at which a pixel is saturated, where the sensor does not say.
    pub saturation_counts: Option<f64>,
}

/// Largest part of the pixels that may be missing.
const MOST_MISSING: f64 = 0.5;

impl Measurement {
    /// A frame that needs no correction, with even noise.
    ///
    /// # Errors
    /// As [`correct`].
    pub fn new(image: Image) -> Result<Self> {
        check_light(&image)?;
        Ok(Self {
            image,
            weights: None,
            sigma: None,
            bad: 0,
            saturated: 0,
        })
    }

    /// The corrected frame `b`, `[y, x]`, in counts.
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// `σ_ref/σ` of every pixel, 0 for those without information; `None`: all 1.
    pub fn weights(&self) -> Option<&[f32]> {
        self.weights.as_deref()
    }

    /// Noise of a pixel with weight 1 by the calibration, in counts.
    pub fn sigma(&self) -> Option<f64> {
        self.sigma
    }

    /// Number of pixels left out as bad.
    pub fn bad(&self) -> usize {
        self.bad
    }

    /// Number of pixels left out as saturated.
    pub fn saturated(&self) -> usize {
        self.saturated
    }
}

/// The measurement in `raw`, a frame of the working grid of `camera` or of its raw
/// pixels (`binning` times as many along each side), which are then binned by mean.
///
/// # Errors
/// A frame of another size, with values that are not finite, without light or all
/// saturated; corrections of another size; a flat that is not positive.
pub fn correct(raw: &Image, camera: &Camera, corrections: &Corrections) -> Result<Measurement> {
    let binning = binning_of(raw, camera)?;
    if let Some((y, x)) = raw.first_non_finite() {
        return Err(Error::input(
            "frame",
            format!("{} at row {y}, column {x}", raw.at(y, x)),
            "every pixel of a frame is a finite number",
            "Mark the pixel in bad_pixels and give it any finite value.",
        ));
    }
    check_light(raw)?;
    let sensor = camera.sensor();
    let same_size = |name: &str, image: &Image| -> Result<()> {
        if (image.rows(), image.columns()) == (raw.rows(), raw.columns())
            && image.first_non_finite().is_none()
        {
            return Ok(());
        }
        Err(Error::input(
            name,
            format!("{}×{} pixels", image.rows(), image.columns()),
            format!(
                "it has the frame's {}×{} pixels, all finite",
                raw.rows(),
                raw.columns()
            ),
            "Record it with the camera settings of the frame.",
        ))
    };
    let end = sensor.saturation_counts().or(corrections.saturation_counts);
    let mut image = raw.clone();
    let mut usable = vec![1.0f32; raw.data().len()];
    let mut saturated = 0;
    if let Some(end) = end {
        for (usable, &count) in usable.iter_mut().zip(raw.data()) {
            if f64::from(count) >= end {
                *usable = 0.0;
                saturated += 1;
            }
        }
    }
    if saturated as f64 > MOST_MISSING * raw.data().len() as f64 {
        return Err(Error::input(
            "frame",
            format!("{saturated} of {} pixels saturated", raw.data().len()),
            "at least half of the pixels hold information",
            "Shorten the exposure or dim the light.",
        ));
    }
    let mut bad = 0;
    if let Some(map) = &corrections.bad_pixels {
        same_size("bad_pixels", map)?;
        for (usable, &flag) in usable.iter_mut().zip(map.data()) {
            if flag != 0.0 {
                *usable = 0.0;
                bad += 1;
            }
        }
        if bad as f64 > MOST_MISSING * raw.data().len() as f64 {
            return Err(Error::input(
                "bad_pixels",
                format!("{bad} of {} pixels", raw.data().len()),
                "at least half of the pixels are usable",
                "Mark bad pixels with a value other than 0, good ones with 0.",
            ));
        }
    }
    match (&corrections.dark, sensor.bias_counts) {
        (Some(dark), _) => {
            same_size("dark", dark)?;
            image
                .data_mut()
                .iter_mut()
                .zip(dark.data())
                .for_each(|(p, d)| *p -= d);
        }
        (None, Some(bias)) => image.data_mut().iter_mut().for_each(|p| *p -= bias as f32),
        (None, None) => {}
    }
    let mut variance = noise_variance(&image, camera);
    if let Some(flat) = &corrections.flat {
        same_size("flat", flat)?;
        divide_by_flat(
            &mut image,
            variance.as_mut(),
            flat,
            corrections.dark.as_ref(),
            &usable,
        )?;
    }
    finish(image, &usable, variance, binning, (bad, saturated))
}

/// Variance of the noise of each raw pixel in counts².
fn noise_variance(image: &Image, camera: &Camera) -> Option<Vec<f64>> {
    let gain = camera.sensor().gain_electrons_per_count?;
    let read = camera.sensor().read_noise_electrons?;
    // An instant's mean count stands for the expected light of a pixel that noise
    // may have pushed below zero.
    let variance =
        |&count: &f32| (f64::from(count.max(0.0)) * gain + read * read).max(1e-12) / (gain * gain);
    Some(image.data().iter().map(variance).collect())
}

fn divide_by_flat(
    image: &mut Image,
    variance: Option<&mut Vec<f64>>,
    flat: &Image,
    dark: Option<&Image>,
    usable: &[f32],
) -> Result<()> {
    let mut response = flat.clone();
    if let Some(dark) = dark {
        response
            .data_mut()
            .iter_mut()
            .zip(dark.data())
            .for_each(|(f, d)| *f -= d);
    }
    let good = || {
        response
            .data()
            .iter()
            .zip(usable)
            .filter(|(_, u)| **u > 0.0)
            .map(|(f, _)| *f)
    };
    if let Some(worst) = good().find(|&f| f <= 0.0) {
        return Err(Error::input(
            "flat",
            worst,
            "every usable pixel responds to light: its flat is above zero (after the dark)",
            "Record a brighter flat, or mark the pixel in bad_pixels.",
        ));
    }
    let mean = good().map(f64::from).sum::<f64>() / good().count() as f64;
    let gain: Vec<f64> = response
        .data()
        .iter()
        .map(|&f| if f > 0.0 { mean / f64::from(f) } else { 0.0 })
        .collect();
    image
        .data_mut()
        .iter_mut()
        .zip(&gain)
        .for_each(|(p, g)| *p = (f64::from(*p) * g) as f32);
    if let Some(variance) = variance {
        variance
            .iter_mut()
            .zip(&gain)
            .for_each(|(v, g)| *v *= g * g);
    }
    Ok(())
}

/// Bins values and variances, a block with any unusable pixel from its usable ones.
fn finish(
    image: Image,
    usable: &[f32],
    variance: Option<Vec<f64>>,
    binning: usize,
    (bad, saturated): (usize, usize),
) -> Result<Measurement> {
    let (rows, columns) = (image.rows() / binning, image.columns() / binning);
    let whole = (binning * binning) as f64;
    let mut binned = Image::zeros(rows, columns);
    let mut sigma = vec![0.0f64; rows * columns];
    for y in 0..rows {
        for x in 0..columns {
            let (mut sum, mut noise, mut count) = (0.0, 0.0, 0.0);
            for at in (0..binning * binning)
                .map(|i| (y * binning + i / binning) * image.columns() + x * binning + i % binning)
            {
                if usable[at] > 0.0 {
                    sum += f64::from(image.data()[at]);
                    noise += variance.as_ref().map_or(1.0 / whole, |v| v[at]);
                    count += 1.0;
                }
            }
            if count > 0.0 {
                binned.data_mut()[y * columns + x] = (sum / count) as f32;
                sigma[y * columns + x] = noise.sqrt() / count;
            }
        }
    }
    if variance.is_none() {
        // Only relative noise is known: a whole block has 1.
        sigma.iter_mut().for_each(|s| *s *= whole);
    }
    let even = variance.is_none() && bad + saturated == 0;
    let mut known: Vec<f64> = sigma.iter().copied().filter(|s| *s > 0.0).collect();
    known.sort_by(f64::total_cmp);
    let reference = known.get(known.len() / 2).copied().unwrap_or(1.0);
    let weight = |&s: &f64| if s > 0.0 { (reference / s) as f32 } else { 0.0 };
    Ok(Measurement {
        weights: (!even).then(|| sigma.iter().map(weight).collect()),
        sigma: variance.is_some().then_some(reference),
        image: binned,
        bad,
        saturated,
    })
}

/// How many raw pixels of `raw` make one of the working grid.
fn binning_of(raw: &Image, camera: &Camera) -> Result<usize> {
    let binning = camera.sensor().binning;
    for factor in [1, binning] {
        if (raw.rows(), raw.columns()) == (camera.rows() * factor, camera.columns() * factor) {
            return Ok(factor);
        }
    }
    let (rows, columns) = (camera.rows(), camera.columns());
    let mut rule = format!("the camera has {rows}×{columns}");
    if binning > 1 {
        rule += &format!(
            ", or {}×{} before binning by {binning}",
            rows * binning,
            columns * binning
        );
    }
    Err(Error::input(
        "frame",
        format!("{}×{} pixels", raw.rows(), raw.columns()),
        rule,
        "Set rows and columns in [camera] to the size of the frame, or crop the frame.",
    ))
}

fn check_light(image: &Image) -> Result<()> {
    let (low, high) = (image.min(), image.max());
    if low == high {
        let (found, remedy) = if high == 0.0 {
            (
                "zero in every pixel".to_string(),
                "Check the shutter, the light and the file.",
            )
        } else {
            (
                format!("{high} in every pixel"),
                "The frame is saturated or blank: shorten the exposure, and check the light.",
            )
        };
        return Err(Error::input(
            "frame",
            found,
            "a frame holds a speckle pattern",
            remedy,
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::{Sensor, Shutter};

    fn camera(sensor: Sensor) -> Camera {
        Camera::new(CameraParams {
            rows: 4,
            columns: 6,
            shutter: Shutter::TopDown,
            row_time_us: 1.0,
            exposure_us: 1.0,
            bins_per_row: 1,
            field: None,
            sensor,
        })
        .unwrap()
    }

    fn ramp(rows: usize, columns: usize) -> Image {
        Image::from_fn(rows, columns, |y, x| 100.0 + (y * columns + x) as f32)
    }

    #[test]
    fn dark_flat_and_bad_pixels() {
        let raw = ramp(4, 6);
        let corrections = Corrections {
            dark: Some(Image::from_fn(4, 6, |_, _| 100.0)),
            flat: Some(Image::from_fn(
                4,
                6,
                |y, _| if y == 1 { 150.0 } else { 200.0 },
            )),
            bad_pixels: Some(Image::from_fn(4, 6, |y, x| {
                if (y, x) == (2, 3) { 255.0 } else { 0.0 }
            })),
            saturation_counts: Some(123.0),
        };
        let m = correct(&raw, &camera(Sensor::default()), &corrections).unwrap();
        // The mean response over the 22 usable pixels is (6·50 + 16·100)/22.
        let mean = 1900.0 / 22.0;
        assert!((f64::from(m.image().at(1, 2)) - 8.0 * mean / 50.0).abs() < 1e-4);
        assert!((f64::from(m.image().at(3, 1)) - 19.0 * mean / 100.0).abs() < 1e-4);
        let weights = m.weights().unwrap();
        assert_eq!(
            (weights[2 * 6 + 3], weights[3 * 6 + 5], weights[0]),
            (0.0, 0.0, 1.0)
        );
        assert_eq!((m.bad(), m.saturated()), (1, 1));
    }

    #[test]
    fn weights_follow_shot_and_read_noise() {
        let sensor = Sensor {
            bias_counts: Some(100.0),
            gain_electrons_per_count: Some(2.0),
            read_noise_electrons: Some(3.0),
            ..Sensor::default()
        };
        let m = correct(&ramp(4, 6), &camera(sensor), &Corrections::default()).unwrap();
        let sigma = |count: f64| ((count * 2.0 + 9.0) / 4.0).sqrt();
        let weights = m.weights().unwrap();
        for count in [0, 5, 23] {
            let expected = m.sigma().unwrap() / sigma(count as f64);
            assert!((f64::from(weights[count]) - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn raw_pixels_are_binned() {
        let sensor = Sensor {
            binning: 2,
            ..Sensor::default()
        };
        let m = correct(
            &ramp(8, 12),
            &camera(sensor.clone()),
            &Corrections::default(),
        )
        .unwrap();
        assert_eq!(m.image(), &ramp(8, 12).binned(2));
        assert_eq!(m.weights(), None);
        assert!(
            correct(
                &ramp(4, 6),
                &camera(sensor.clone()),
                &Corrections::default()
            )
            .is_ok()
        );
        let error = correct(&ramp(4, 12), &camera(sensor), &Corrections::default()).unwrap_err();
        assert!(error.to_string().contains("8×12 before binning"), "{error}");
    }

    #[test]
    fn frames_without_information_are_refused() {
        let camera = camera(Sensor {
            bit_depth: Some(8),
            ..Sensor::default()
        });
        let refused = |image: Image| {
            correct(&image, &camera, &Corrections::default())
                .unwrap_err()
                .to_string()
        };
        assert!(refused(Image::zeros(4, 6)).contains("zero in every pixel"));
        assert!(refused(Image::from_fn(4, 6, |_, _| 255.0)).contains("255 in every pixel"));
        assert!(
            refused(Image::from_fn(4, 6, |y, _| if y < 3 { 255.0 } else { 9.0 }))
                .contains("18 of 24")
        );
        let mut nan = ramp(4, 6);
        nan.data_mut()[8] = f32::NAN;
        assert!(refused(nan).contains("row 1, column 2"));
    }
}
