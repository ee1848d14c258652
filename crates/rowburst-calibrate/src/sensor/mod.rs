//! What a sensor's numbers mean, from frames in the dark and frames of even light.
//!
//! ```text
//! count = dark + response·light/gain + noise,   noise² = read² + light/gain   (counts)
//! ```
//!
//! 1. Mean and variance of each pixel over the darks: bias map, read noise, hot pixels,
//!    noise of whole rows ([`rows`]).
//! 2. Flats sorted by their light ([`mod@levels`]); where their counts end.
//! 3. Response of each pixel, dead pixels, and the photon transfer curve from differences
//!    of flats: electrons per count ([`transfer`]).
//! 4. Pixels that are noisier than their light explains ([`pixels`]).
//!
//! Dark signal needs darks of two exposures and is part of the bias here: take the darks
//! at the exposure of use. Reference: EMVA 1288 release 4.0; J. R. Janesick, Photon
//! Transfer (SPIE 2007).

pub mod levels;
pub mod pixels;
pub mod rows;
pub mod stack;
pub mod stats;
pub mod transfer;
mod warnings;

use levels::{Level, check_light, end_of_counts, levels, lights};
use pixels::ROUNDING_VARIANCE;
use rowburst_core::{Error, ErrorKind, Parameter, Result};
use rowburst_optics::Image;
use rows::Banding;
use stack::Moments;
pub use stack::Stack;
use transfer::{FlatSeries, TransferLine, TransferPoint};

/// A calibrated sensor; maps are `[y, x]` on the grid of the frames.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorCalibration {
    /// Mean dark frame, counts.
    pub dark: Image,
    /// Mean of `dark` over the usable pixels.
    pub bias_counts: f64,
    /// A flat frame without noise to speak of, counts: `dark` plus `response` times the
    /// mean light. It is a frame like those of the camera, dark level included.
    pub flat: Image,
    /// Response to even light, mean 1 over the usable pixels.
    pub response: Image,
    /// Standard deviation of a pixel's response among its neighbours (PRNU), relative.
    pub non_uniformity: f64,
    /// Standard error of a pixel of `response`, relative.
    pub flat_error: f64,
    /// Read noise of each pixel, electrons rms.
    pub read_noise: Image,
    /// Median of `read_noise`, free of the bias that few frames give.
    pub read_noise_electrons: f64,
    /// Root mean square of the read noise over the usable pixels, electrons.
    pub read_noise_rms_electrons: f64,
    /// Electrons per count.
    pub gain_electrons_per_count: f64,
    /// Standard error of the gain, relative.
    pub gain_error: f64,
    /// Counts at which a pixel is full; `None` where the flats do not reach them.
    pub full_well: Option<FullWell>,
    /// Pixels not to be used.
    pub faults: Faults,
    /// Noise that the pixels of a row share.
    pub banding: Banding,
    /// Points of the photon transfer curve, those of the darks first.
    pub transfer: Vec<TransferPoint>,
    /// The line through them, in counts.
    pub line: TransferLine,
    /// The levels of the flats, by rising light.
    pub levels: Vec<Level>,
    /// Number of pairs of flats behind the curve.
    pub pairs: usize,
    /// By how much each dark lies above their mean, counts.
    pub dark_drift: Vec<f64>,
    /// Whether all counts are whole numbers.
    pub has_integer_counts: bool,
    /// What the user should change or know before trusting it.
    pub warnings: Vec<String>,
}

/// Where the counts end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FullWell {
    /// Counts, bias included, at and above which a pixel is saturated.
    pub counts: f64,
    /// What shows it.
    pub sign: FullSign,
}

/// What shows that pixels are full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FullSign {
    /// Readings pile up at one count.
    Clipped,
    /// The variance falls though the light rises.
    Turnover,
}

/// Pixels not to be used, and why. A pixel may have several faults.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Faults {
    /// Dark level that stands out.
    pub hot: Vec<bool>,
    /// Less than half, or more than twice, the response of its neighbours.
    pub dead: Vec<bool>,
    /// Noise out of proportion to its light.
    pub unstable: Vec<bool>,
}

impl Faults {
    /// Whether pixel `i` has any fault.
    pub fn is_bad(&self, i: usize) -> bool {
        self.hot[i] || self.dead[i] || self.unstable[i]
    }

    /// Number of pixels with any fault.
    pub fn count(&self) -> usize {
        (0..self.hot.len()).filter(|&i| self.is_bad(i)).count()
    }
}

/// Calibrates a sensor from `darks`, taken at the exposure of use, and `flats` of even
/// light at one or several levels.
///
/// # Errors
/// Stacks of different sizes; flats darker than the darks, without light or all
/// saturated; no two flats of one level; a variance that does not grow with the light.
pub fn calibrate(darks: &Stack, flats: &Stack) -> Result<SensorCalibration> {
    flats.check_same_size(darks)?;
    let (rows, columns) = darks.size();
    let has_integer_counts = darks.has_integer_counts() && flats.has_integer_counts();
    let dark = Moments::of(darks);
    let hot = pixels::hot(&dark, columns, has_integer_counts);
    let typical = pixels::typical_variance(&dark);
    let noisy = pixels::unstable(
        &dark.variance,
        |_| typical.max(min_variance(has_integer_counts)),
        dark.dof,
    );
    let mut usable = neither(&hot, &noisy);

    let end = end_of_counts(flats, &usable);
    let lights = lights(flats, &dark.mean, &usable);
    let levels = levels(flats, &lights, end, &usable);
    let bias = stats::mean(kept(&dark.mean, &usable));
    check_light(&lights, &levels, bias, typical.sqrt())?;

    let trusted = unclipped_levels(&levels);
    let (light, frames) = pixels::response(flats, &trusted, &dark.mean);
    let rough_gain = rough_gain(flats, &trusted, &light);
    let error = |light: f64| ((typical + light.max(0.0) * rough_gain) / frames).sqrt();
    let dead = pixels::dead(&light, error, columns);
    usable.iter_mut().zip(&dead).for_each(|(u, &d)| *u &= !d);
    check_usable(&usable)?;

    let banding = rows::banding(darks, &dark, &usable);
    let series = FlatSeries {
        flats,
        levels: &levels,
        dark: &dark.mean,
        response: &light,
        usable: &usable,
    };
    let (transfer, line, full_well) = transfer_curve(series, &banding, end, bias)?;
    let gain = 1.0 / line.slope;
    let in_light = pixels::unstable_in_light(flats, &trusted, &dark.mean, &line);
    let unstable: Vec<bool> = noisy.iter().zip(&in_light).map(|(a, b)| a | b).collect();
    let faults = Faults {
        hot,
        dead,
        unstable,
    };
    let usable: Vec<bool> = (0..rows * columns).map(|i| !faults.is_bad(i)).collect();

    let mean_light = stats::mean(kept(&light, &usable));
    let image = |of: &dyn Fn(usize) -> f64| {
        Image::from_fn(rows, columns, |y, x| of(y * columns + x) as f32)
    };
    let response = image(&|i| light[i] / mean_light);
    let flat_variance = line.at(mean_light) / (frames * mean_light * mean_light);
    let electrons = |variance: f64| gain * without_rounding(variance, has_integer_counts).sqrt();
    let mut found = SensorCalibration {
        bias_counts: stats::mean(kept(&dark.mean, &usable)),
        flat: image(&|i| dark.mean[i] + light[i]),
        non_uniformity: pixels::non_uniformity(&response, &usable, flat_variance),
        flat_error: flat_variance.sqrt(),
        read_noise: image(&|i| electrons(dark.variance[i])),
        read_noise_electrons: electrons(typical),
        read_noise_rms_electrons: electrons(stats::mean(kept(&dark.variance, &usable))),
        gain_electrons_per_count: gain,
        gain_error: line.slope_error / line.slope,
        pairs: levels.iter().map(|level| level.frames.len() / 2).sum(),
        dark: image(&|i| dark.mean[i]),
        response,
        full_well,
        faults,
        banding,
        transfer,
        line,
        levels,
        dark_drift: dark.drift.clone(),
        has_integer_counts,
        warnings: Vec::new(),
    };
    found.warnings = warnings::of(&found, darks, flats, &lights, &usable);
    Ok(found)
}

/// Refuses a sensor of which fewer than half of the pixels are usable.
fn check_usable(usable: &[bool]) -> Result<()> {
    if usable.iter().filter(|u| **u).count() * 2 >= usable.len() {
        return Ok(());
    }
    let bad = usable.iter().filter(|u| !**u).count();
    Err(Error::input(
        Parameter::DarksAndFlats,
        format!("{bad} of {} pixels hot, dead or unstable", usable.len()),
        "at least half of the pixels are sound",
        "Check that all frames are raw, of one camera, one gain and one exposure.",
    ))
}

/// Points, line and saturation: which points the line goes through depends on where the
/// counts end, which is `end` if readings pile up there.
fn transfer_curve(
    series: FlatSeries,
    banding: &Banding,
    end: Option<f64>,
    bias: f64,
) -> Result<(Vec<TransferPoint>, TransferLine, Option<FullWell>)> {
    let FlatSeries { flats, levels, .. } = series;
    let dark_variance = banding.pixel_counts.powi(2);
    let mut points = transfer::curve(series, (dark_variance, banding.pixel_dof));
    if points.len() == 1 {
        return Err(Error::input(
            Parameter::Flats,
            format!("{} flats, no two of equal light", flats.len()),
            "the gain comes from the noise between two flats of equal light (within 5 %)",
            "Record at least two flats at each level.",
        ));
    }
    let full_well = match end {
        Some(counts) => Some(FullWell {
            counts,
            sign: FullSign::Clipped,
        }),
        None => transfer::turnover(&points, levels.len()).map(|light| FullWell {
            counts: bias + light,
            sign: FullSign::Turnover,
        }),
    };
    transfer::choose(
        &mut points,
        levels,
        full_well.map(|full| full.counts - bias),
    );
    let usable_points = points.iter().any(|p| p.used && p.level.is_some());
    let line = transfer::fit(&points).filter(|_| usable_points);
    let line = line.ok_or_else(|| {
        let (light, variance) = points[1..]
            .iter()
            .map(|p| (p.light, p.variance))
            .fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a });
        Error::input(
            Parameter::Flats,
            format!(
                "a variance of {variance:.3} counts² at {light:.1} counts of light, {:.3} without light",
                dark_variance
            ),
            "the variance must grow with the light in flats that are not saturated",
            "Give raw frames (no averaging, denoising or compression), two or more at each level, at about half of the range.",
        ).with_kind(ErrorKind::NoSignal)
    })?;
    Ok((points, line, full_well))
}

/// Levels whose readings are not cut off; where there is none, the one that is least.
fn unclipped_levels(levels: &[Level]) -> Vec<&Level> {
    let whole: Vec<&Level> = levels.iter().filter(|level| level.is_unclipped()).collect();
    if !whole.is_empty() {
        return whole;
    }
    let least = levels.iter().min_by(|a, b| a.clipped.total_cmp(&b.clipped));
    least.into_iter().collect()
}

/// Counts² of variance per count of light, from the brightest level alone and with its
/// scatter over the pixels: an upper bound, for telling dead pixels from faint flats.
fn rough_gain(flats: &Stack, levels: &[&Level], light: &[f64]) -> f64 {
    let pair = levels
        .iter()
        .rev()
        .find_map(|level| level.frames.last_chunk());
    let Some(&[a, b]) = pair else {
        return 0.0;
    };
    let (a, b) = (flats.image(a).data(), flats.image(b).data());
    let differences = a.iter().zip(b).map(|(a, b)| f64::from(a - b));
    let (_, sigma) = stats::centre_and_sigma(differences);
    0.5 * sigma * sigma / stats::median(&mut light.to_vec()).max(f64::MIN_POSITIVE)
}

fn neither(a: &[bool], b: &[bool]) -> Vec<bool> {
    a.iter().zip(b).map(|(a, b)| !a && !b).collect()
}

fn kept<'a>(values: &'a [f64], usable: &'a [bool]) -> impl Iterator<Item = f64> + 'a {
    values
        .iter()
        .zip(usable)
        .filter(|(_, u)| **u)
        .map(|(v, _)| *v)
}

/// Least variance that counts can have: darks of whole counts may all be equal.
fn min_variance(has_integer_counts: bool) -> f64 {
    if has_integer_counts {
        ROUNDING_VARIANCE
    } else {
        f64::MIN_POSITIVE
    }
}

/// Variance without that of rounding to whole counts, which holds from 0.24 counts² on
/// (EMVA 1288, section 6.4): below, rounding is no longer noise of its own.
fn without_rounding(variance: f64, has_integer_counts: bool) -> f64 {
    if has_integer_counts && variance >= 0.24 {
        variance - ROUNDING_VARIANCE
    } else {
        variance
    }
}

#[cfg(test)]
mod tests;
