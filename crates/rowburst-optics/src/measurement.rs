//! From raw counts to a measurement: what the sensor did to the light is undone.
//!
//! `b = (raw − dark) · ⟨flat − dark⟩ / (flat − dark)`; pixels that are bad or saturated
//! get weight zero, and where gain and read noise are known all others get the weight of
//! their noise, `σ² = (counts·gain + read²) / gain²` counts², and 1/12 more where the
//! counts are rounded. `bias_counts` stands in for a dark frame that is not there.

mod noise_model;

pub use noise_model::NoiseModel;

use crate::{Camera, Image};
use rowburst_core::{Error, ErrorKind, Parameter, Result, phrase};
use std::borrow::Cow;
use tracing::info;

/// A frame that may be handed to a solver.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    image: Image,
    weights: Option<Vec<f32>>,
    noise: Option<NoiseModel>,
    bad: usize,
    saturated: usize,
}

/// A frame as the camera recorded it, in raw counts `[y, x]`.
///
/// A solver does not take it: [`RawFrame::correct`] makes a [`Measurement`] of it.
#[derive(Debug, Clone, PartialEq)]
pub struct RawFrame(Image);

impl RawFrame {
    /// A frame of these counts.
    pub fn new(counts: Image) -> Self {
        Self(counts)
    }

    /// The counts, `[y, x]`.
    pub fn counts(&self) -> &Image {
        &self.0
    }

    /// The frame with the sensor's effects undone; see [`correct`].
    ///
    /// # Errors
    /// Those of [`correct`].
    pub fn correct(&self, camera: &Camera, corrections: &Corrections) -> Result<Measurement> {
        correct(&self.0, camera, corrections)
    }
}

/// What is known of the sensor beside [`crate::Sensor`]; all on the grid of the frame, or
/// on that of the raw pixels where the frame is already binned.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Corrections {
    /// Counts without light; takes the place of `bias_counts`.
    pub dark: Option<Image>,
    /// A frame of even light, dark level included; only the shape of its light matters.
    pub flat: Option<Image>,
    /// Pixels that are not to be used: anything but zero.
    pub bad_pixels: Option<Image>,
    /// Counts at which a pixel is saturated, where the sensor does not say.
    pub saturation_counts: Option<f64>,
}

/// Largest part of the pixels that may be missing.
const MAX_MISSING_FRACTION: f64 = 0.5;

impl Measurement {
    /// A frame that needs no correction, with even noise.
    ///
    /// # Errors
    /// A frame with values that are not finite, or without light.
    pub fn new(image: Image) -> Result<Self> {
        check_finite(&image)?;
        check_light(&image)?;
        Ok(Self {
            image,
            weights: None,
            noise: None,
            bad: 0,
            saturated: 0,
        })
    }

    /// Some rows of it, one after another, as [`Camera::subset`] reads them. The noise, and the
    /// numbers of bad and saturated pixels, are those of the whole frame.
    ///
    /// # Panics
    /// If there is no such row.
    #[must_use]
    pub fn select_rows(&self, rows: &[usize]) -> Self {
        let columns = self.image.columns();
        let lines = |values: &[f32]| -> Vec<f32> {
            let lines = rows
                .iter()
                .map(|&r| &values[r * columns..(r + 1) * columns]);
            lines.flatten().copied().collect()
        };
        let weights = self.weights().map(lines);
        let image = Image::new(rows.len(), columns, lines(self.image.data()));
        Self {
            image: image.expect("as many values as pixels"),
            noise: self.noise.as_ref().map(|model| model.picked(lines)),
            weights,
            bad: self.bad,
            saturated: self.saturated,
        }
    }

    /// The same measurement with the pixels of `is_excluded`, `[y, x]`, at weight 0.
    ///
    /// # Panics
    /// If the length is not that of the frame.
    #[must_use]
    pub fn without(&self, is_excluded: &[bool]) -> Self {
        let pixels = self.image.data().len();
        assert_eq!(is_excluded.len(), pixels, "one flag for each pixel");
        if !is_excluded.contains(&true) {
            return self.clone();
        }
        let mut weights = self.weights.clone().unwrap_or_else(|| vec![1.0; pixels]);
        let excluded = weights.iter_mut().zip(is_excluded);
        excluded
            .filter(|(_, excluded)| **excluded)
            .for_each(|(weight, _)| *weight = 0.0);
        Self {
            weights: Some(weights),
            noise: self.noise.as_ref().map(|noise| noise.without(is_excluded)),
            ..self.clone()
        }
    }

    /// The same measurement with even noise: every usable pixel has weight 1.
    #[must_use]
    pub fn with_even_noise(&self) -> Self {
        let weights = self.weights.as_ref().filter(|w| w.contains(&0.0));
        let is_usable = |w: &f32| f32::from(u8::from(*w > 0.0));
        Self {
            weights: weights.map(|w| w.iter().map(is_usable).collect()),
            noise: None,
            ..self.clone()
        }
    }

    /// Median of the weights above zero; 1 where all are 1.
    pub fn typical_weight(&self) -> f64 {
        let weights = self.weights.iter().flatten().copied();
        let mut usable: Vec<f32> = weights.filter(|w| *w > 0.0).collect();
        let middle = usable.len() / 2;
        if usable.is_empty() {
            return 1.0;
        }
        f64::from(*usable.select_nth_unstable_by(middle, f32::total_cmp).1)
    }

    /// The light `(b − offset)/gain` of pixels that turn a light `l` into `gain·l + offset` counts; both `[y, x]`. A
    /// pixel's noise is divided by its gain too, and its weight multiplied.
    ///
    /// # Panics
    /// If a length is not that of the frame, or a gain is not above zero.
    #[must_use]
    pub fn adjusted(&self, gain: &[f32], offset: &[f32]) -> Self {
        let pixels = self.image.data().len();
        assert!(
            gain.len() == pixels && offset.len() == pixels,
            "one value for each pixel"
        );
        assert!(gain.iter().all(|g| *g > 0.0), "gains above zero");
        let mut image = self.image.clone();
        let values = image.data_mut().iter_mut().zip(gain.iter().zip(offset));
        values.for_each(|(b, (g, o))| *b = (*b - o) / g);
        let mut weights = self.weights.clone();
        if gain.iter().any(|g| *g != 1.0) {
            let weights = weights.get_or_insert_with(|| vec![1.0; pixels]);
            weights.iter_mut().zip(gain).for_each(|(w, g)| *w *= g);
        }
        Self {
            image,
            weights,
            noise: self
                .noise
                .as_ref()
                .map(|noise| noise.adjusted(gain, offset)),
            bad: self.bad,
            saturated: self.saturated,
        }
    }

    /// The measurement without `light`, `[y, x]` in counts; its noise stays.
    ///
    /// # Panics
    /// If the length is not that of the frame.
    #[must_use]
    pub fn without_light(&self, light: &[f32]) -> Self {
        self.adjusted(&vec![1.0; light.len()], light)
    }

    /// The measurement with these stored values, without a noise model. It serves to look at a completed
    /// reconstruction; a new one needs [`correct`].
    ///
    /// # Errors
    /// Another number of weights than pixels, or a frame with values that are not finite.
    pub fn from_stored(
        image: Image,
        weights: Option<Vec<f32>>,
        bad: usize,
        saturated: usize,
    ) -> Result<Self> {
        check_finite(&image)?;
        let pixels = image.data().len();
        if let Some(count) = weights.as_ref().map(Vec::len).filter(|n| *n != pixels) {
            return Err(Error::input(
                Parameter::Weights,
                format!("{count} values"),
                format!("there is one for each of the {pixels} pixels"),
                "Reconstruct the frame again.",
            )
            .with_kind(ErrorKind::Shape));
        }
        Ok(Self {
            image,
            weights,
            noise: None,
            bad,
            saturated,
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
        self.noise.as_ref().map(NoiseModel::sigma)
    }

    /// How the noise follows the light, where gain and read noise are known.
    pub fn noise(&self) -> Option<&NoiseModel> {
        self.noise.as_ref()
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
/// Corrections of raw pixels are binned too where the frame already is; one bad pixel
/// then makes its whole block bad, since it is mixed into it.
///
/// # Errors
/// A frame of another size, with values that are not finite, without light or all
/// saturated; corrections of another size or not finite; a flat that is no brighter than
/// the dark in a usable pixel.
pub fn correct(raw: &Image, camera: &Camera, corrections: &Corrections) -> Result<Measurement> {
    let binning = binning_of(raw, camera)?;
    check_finite(raw)?;
    check_light(raw)?;
    let sensor = camera.sensor();
    let fitted = |name, image| on_grid_of(raw, name, image, sensor.binning / binning);
    let pixels = raw.data().len();
    let mut usable = vec![1.0f32; pixels];
    let mut bad = 0;
    if let Some(map) = &corrections.bad_pixels {
        for (usable, &flag) in usable
            .iter_mut()
            .zip(fitted(Parameter::BadPixels, map)?.data())
        {
            if flag != 0.0 {
                *usable = 0.0;
                bad += 1;
            }
        }
        if bad as f64 > MAX_MISSING_FRACTION * pixels as f64 {
            return Err(Error::input(
                Parameter::BadPixels,
                format!("{bad} of {pixels} pixels"),
                "at least half of the pixels are usable",
                "Mark bad pixels with a value other than 0, good ones with 0.",
            ));
        }
    }
    let end = sensor.saturation_counts().or(corrections.saturation_counts);
    let mut saturated = 0;
    if let Some(end) = end {
        for (usable, &count) in usable.iter_mut().zip(raw.data()) {
            if f64::from(count) >= end && *usable > 0.0 {
                *usable = 0.0;
                saturated += 1;
            }
        }
    }
    if (saturated + bad) as f64 > MAX_MISSING_FRACTION * pixels as f64 {
        let also = if bad > 0 {
            format!(", {bad} bad")
        } else {
            String::new()
        };
        return Err(Error::input(
            Parameter::Frame,
            format!("{saturated} of {pixels} pixels saturated{also}"),
            "at least half of the pixels hold information",
            "Shorten the exposure or dim the light.",
        )
        .with_kind(ErrorKind::NoSignal));
    }
    let dark = match (&corrections.dark, sensor.bias_counts) {
        (Some(dark), _) => Some(fitted(Parameter::Dark, dark)?),
        (None, Some(bias)) => {
            let level = Image::from_fn(raw.rows(), raw.columns(), |_, _| bias as f32);
            Some(Cow::Owned(level))
        }
        (None, None) => None,
    };
    let mut image = raw.clone();
    subtract(&mut image, dark.as_deref());
    check_usable_light(&image, &usable, (bad, saturated))?;
    let mut variances = pixel_variances(&image, camera, sensor.binning / binning);
    if let Some(flat) = &corrections.flat {
        let mut response = fitted(Parameter::Flat, flat)?.into_owned();
        subtract(&mut response, dark.as_deref());
        divide_by_response(&mut image, variances.as_mut(), &response, &usable)?;
    }
    info!("corrected the frame: {bad} bad pixels, {saturated} saturated ones, of {pixels}");
    finish(image, &usable, variances, binning, (bad, saturated))
}

/// A correction on the grid of the frame `raw`, of which a pixel is the mean of
/// `block_side × block_side` raw ones.
fn on_grid_of<'a>(
    raw: &Image,
    name: Parameter,
    image: &'a Image,
    block_side: usize,
) -> Result<Cow<'a, Image>> {
    if let Some((y, x)) = image.first_non_finite() {
        return Err(Error::input(
            name,
            format!("{} at row {y}, column {x}", image.at(y, x)),
            "every pixel of a dark, a flat or a mask is a finite number",
            "Record it again, or replace the pixel by the mean of its neighbours.",
        )
        .with_kind(ErrorKind::NotFinite));
    }
    let (rows, columns) = (raw.rows(), raw.columns());
    if (image.rows(), image.columns()) == (rows, columns) {
        return Ok(Cow::Borrowed(image));
    }
    let mut rule = format!("it has the frame's {rows}×{columns} pixels");
    if block_side > 1 {
        let unbinned = (rows * block_side, columns * block_side);
        if (image.rows(), image.columns()) == unbinned {
            return Ok(Cow::Owned(image.binned(block_side)));
        }
        rule += &format!(", or {}×{} before binning", unbinned.0, unbinned.1);
    }
    Err(Error::input(
        name,
        format!("{}×{} pixels", image.rows(), image.columns()),
        rule,
        "Record it with the camera settings of the frame.",
    )
    .with_kind(ErrorKind::Shape))
}

/// Takes `dark` from `image`, where there is one.
fn subtract(image: &mut Image, dark: Option<&Image>) {
    if let Some(dark) = dark {
        let pixels = image.data_mut().iter_mut().zip(dark.data());
        pixels.for_each(|(p, d)| *p -= d);
    }
}

/// Variance of rounding to whole counts.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

/// Slope and floor of each pixel's variance; see [`NoiseModel`].
type PixelVariances = Vec<(f64, f64)>;

/// The law of pixels that are the mean of `block_side × block_side` raw ones.
fn pixel_variances(image: &Image, camera: &Camera, block_side: usize) -> Option<PixelVariances> {
    let sensor = camera.sensor();
    let gain = sensor.gain_electrons_per_count?;
    let read = sensor.read_noise_electrons?;
    let rounding = sensor.bit_depth.map_or(0.0, |_| ROUNDING_VARIANCE);
    let raw_pixels = (block_side * block_side) as f64;
    let dark_variance = (read * read / (gain * gain) + rounding) / raw_pixels;
    Some(vec![
        (1.0 / (gain * raw_pixels), dark_variance);
        image.data().len()
    ])
}

fn divide_by_response(
    image: &mut Image,
    variances: Option<&mut PixelVariances>,
    response: &Image,
    usable: &[f32],
) -> Result<()> {
    let pixels = || response.data().iter().zip(usable);
    if let Some(at) = pixels().position(|(&f, &u)| u > 0.0 && f <= 0.0) {
        let (y, x) = (at / response.columns(), at % response.columns());
        return Err(Error::input(
            Parameter::Flat,
            format!("{} at row {y}, column {x}", response.at(y, x)),
            "every usable pixel responds to light: less the dark, its flat is above zero",
            "Give the flat as it was recorded, dark level included; record a brighter one, or mark the pixel in bad_pixels.",
        ));
    }
    let good = || pixels().filter(|(_, u)| **u > 0.0).map(|(f, _)| *f);
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
    if let Some(variances) = variances {
        for ((slope, dark_variance), g) in variances.iter_mut().zip(&gain) {
            (*slope, *dark_variance) = (*slope * g, *dark_variance * g * g);
        }
    }
    Ok(())
}

/// Bins values and variances, a block with any unusable pixel from its usable ones.
fn finish(
    image: Image,
    usable: &[f32],
    variances: Option<PixelVariances>,
    binning: usize,
    (bad, saturated): (usize, usize),
) -> Result<Measurement> {
    let (rows, columns) = (image.rows() / binning, image.columns() / binning);
    let whole = (binning * binning) as f64;
    let mut binned = Image::zeros(rows, columns);
    let mut counts = vec![0.0f64; rows * columns];
    let mut slope = vec![0.0f32; rows * columns];
    let mut dark_variance = vec![f32::INFINITY; rows * columns];
    for y in 0..rows {
        for x in 0..columns {
            let (mut sum, mut count, mut slopes, mut dark_variances) = (0.0, 0.0, 0.0, 0.0);
            for at in (0..binning * binning)
                .map(|i| (y * binning + i / binning) * image.columns() + x * binning + i % binning)
            {
                if usable[at] > 0.0 {
                    sum += f64::from(image.data()[at]);
                    count += 1.0;
                    if let Some(variances) = &variances {
                        slopes += variances[at].0;
                        dark_variances += variances[at].1;
                    }
                }
            }
            let block = y * columns + x;
            counts[block] = count;
            if count > 0.0 {
                binned.data_mut()[block] = (sum / count) as f32;
                // The mean of `count` pixels has the mean of their variances over `count`.
                slope[block] = (slopes / (count * count)) as f32;
                dark_variance[block] = (dark_variances / (count * count)) as f32;
            }
        }
    }
    let noise = variances.map(|_| NoiseModel::new(slope, dark_variance, binned.data()));
    let weights = match &noise {
        // The counts stand for the light until a model of it is there.
        Some(noise) => Some(noise.weights(binned.data())),
        None if bad + saturated == 0 => None,
        // Only relative noise is known: a whole block has 1.
        None => Some(counts.iter().map(|c| (c / whole).sqrt() as f32).collect()),
    };
    Ok(Measurement {
        weights,
        noise,
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
        Parameter::Frame,
        format!("{}×{} pixels", raw.rows(), raw.columns()),
        rule,
        phrase![
            "Set rows and columns in ",
            Parameter::Camera,
            " to the size of the frame, or crop the frame."
        ],
    )
    .with_kind(ErrorKind::Shape))
}

fn check_finite(frame: &Image) -> Result<()> {
    match frame.first_non_finite() {
        None => Ok(()),
        Some((y, x)) => Err(Error::input(
            Parameter::Frame,
            format!("{} at row {y}, column {x}", frame.at(y, x)),
            "every pixel of a frame is a finite number, below 3.4e38",
            "Mark the pixel in bad_pixels and give it any finite value.",
        )
        .with_kind(ErrorKind::NotFinite)),
    }
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
            Parameter::Frame,
            found,
            "a frame holds a speckle pattern",
            remedy,
        )
        .with_kind(ErrorKind::NoSignal));
    }
    Ok(())
}

/// Checks that some usable pixel of `image` differs from zero: without light there is no noise level either.
fn check_usable_light(
    image: &Image,
    usable: &[f32],
    (bad, saturated): (usize, usize),
) -> Result<()> {
    let mut pixels = image.data().iter().zip(usable);
    if pixels.any(|(&p, &usable)| usable > 0.0 && p != 0.0) {
        return Ok(());
    }
    let (found, remedy) = if saturated + bad == 0 {
        (
            "zero in every pixel, less the dark".to_string(),
            "Check the light, and that the dark frame is another capture than the frame.",
        )
    } else {
        (
            format!("zero in every pixel but {saturated} saturated and {bad} bad ones"),
            "Give the counts as the camera recorded them, not a mask or a thresholded picture; shorten the exposure where pixels are saturated.",
        )
    };
    Err(Error::input(
        Parameter::Frame,
        found,
        "a frame holds a speckle pattern in the pixels that are not saturated",
        remedy,
    )
    .with_kind(ErrorKind::NoSignal))
}

#[cfg(test)]
mod tests;
