//! Several captures of one point source into one picture of its light.
//!
//! With a dark frame `d` and exposures `t_i` the light is
//! `Σ_i u_i (c_i − d) / Σ_i u_i t_i`, where `u_i` is 0 for a saturated pixel and 1 for
//! all others: counts of shot noise weigh by their exposure. Captures of one exposure are
//! averaged, saturated pixels too: leaving out the ones above the end would darken
//! the rest.

use super::black_level::{BlackLevel, estimate_black_level};
use rowburst_core::error::Subject;
use rowburst_core::{Error, ErrorKind, Parameter, Result, phrase};
use rowburst_optics::Image;

/// One capture with the name that errors call it by.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedCapture {
    /// File, or file and page.
    pub name: String,
    /// Raw counts.
    pub image: Image,
}

/// How captures become one picture.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MergeParams {
    /// Counts without light. Without one the floor is read from the captures.
    pub dark: Option<Image>,
    /// Exposure of each capture in milliseconds; empty: all the same.
    pub exposures_ms: Vec<f64>,
    /// Counts from which on a pixel is saturated; without it only a pile-up of pixels at
    /// the highest count tells.
    pub saturation_counts: Option<f64>,
}

/// The light of a point source.
#[derive(Debug, Clone, PartialEq)]
pub struct PointSourceImage {
    /// Counts above the floor, negative where noise made them so; per millisecond of
    /// exposure if there are several.
    pub image: Image,
    /// Part of the pixels that are saturated in every capture.
    pub saturated_fraction: f64,
    /// What was taken from the captures without a dark frame: mean of their floors.
    pub black_level: Option<BlackLevel>,
    /// Captures that went in.
    pub used: usize,
    /// Captures that show another pattern and were left out, with their correlation.
    pub left_out: Vec<(String, f64)>,
}

/// Least correlation of captures that show one pattern.
const SAME_PATTERN: f64 = 0.5;

/// A capture that agrees less than this times the typical one is left out.
const OUTLIER: f64 = 0.8;

/// Part of saturated pixels from which on a PSF is refused: so much of the light lies in
/// the brightest grains that speckle of which they are cut off is another PSF.
const MAX_SATURATED_FRACTION: f64 = 0.2;

/// Merges `shots` of one source at one place.
///
/// # Errors
/// No capture, sizes that differ, pixels that are not finite, captures without light, a
/// dark frame brighter than a capture, exposures that do not belong to the captures,
/// captures of different patterns, more than a fifth of the pixels saturated.
pub fn merge(shots: &[NamedCapture], params: &MergeParams) -> Result<PointSourceImage> {
    check(shots, params)?;
    let mut black_levels = Vec::new();
    let mut rates = Vec::new();
    for (i, shot) in shots.iter().enumerate() {
        let end = saturation(&shot.image, params.saturation_counts);
        let full: Vec<bool> = shot
            .image
            .data()
            .iter()
            .map(|&p| end.is_some_and(|end| f64::from(p) >= end))
            .collect();
        let mut image = shot.image.clone();
        if let Some(dark) = &params.dark {
            let pairs = image.data_mut().iter_mut().zip(dark.data());
            pairs.for_each(|(p, d)| *p -= d);
        } else {
            let black_level = estimate_black_level(&image);
            let pixels = image.data_mut().iter_mut();
            pixels.for_each(|p| *p = (f64::from(*p) - black_level.counts) as f32);
            black_levels.push(black_level);
        }
        let exposure = params.exposures_ms.get(i).copied().unwrap_or(1.0);
        let sum: f64 = image.data().iter().map(|&p| f64::from(p)).sum();
        rates.push(Rate {
            scale: 1.0 / (sum / image.data().len() as f64).max(1e-30),
            image,
            full,
            exposure,
        });
    }
    let (kept, left_out) = agreeing(shots, &rates)?;
    let several = params
        .exposures_ms
        .iter()
        .any(|t| *t != params.exposures_ms[0]);
    let (image, saturated) = sum(&rates, &kept, several);
    let saturated_fraction = saturated as f64 / image.data().len() as f64;
    if saturated_fraction > MAX_SATURATED_FRACTION {
        return Err(Error::input(
            Subject::item(Parameter::Captures, &shots[kept[0]].name),
            format!(
                "{:.0} % of the pixels saturated",
                100.0 * saturated_fraction
            ),
            format!("a PSF has at most {:.0} %", 100.0 * MAX_SATURATED_FRACTION),
            phrase![
                "Shorten the exposure, or add captures of shorter ones with ",
                Parameter::ExposuresMs,
                "."
            ],
        )
        .with_kind(ErrorKind::NoSignal));
    }
    let black_level = (!black_levels.is_empty()).then(|| {
        let of = |value: fn(&BlackLevel) -> f64| {
            kept.iter().map(|&i| value(&black_levels[i])).sum::<f64>() / kept.len() as f64
        };
        BlackLevel {
            counts: of(|f| f.counts),
            is_from_dark_region: kept.iter().all(|&i| black_levels[i].is_from_dark_region),
        }
    });
    Ok(PointSourceImage {
        image,
        saturated_fraction,
        black_level,
        used: kept.len(),
        left_out,
    })
}

/// One capture above its floor.
struct Rate {
    image: Image,
    full: Vec<bool>,
    exposure: f64,
    /// One over its mean: a bright capture does not outvote the others.
    scale: f64,
}

fn check(shots: &[NamedCapture], params: &MergeParams) -> Result<()> {
    let Some(first) = shots.first() else {
        return Err(Error::input(
            Parameter::Captures,
            "none",
            "a PSF needs at least one capture of a point source",
            "Name image files, or a folder with some.",
        )
        .with_kind(ErrorKind::Missing));
    };
    let size = |image: &Image| format!("{}×{} pixels", image.rows(), image.columns());
    for shot in shots {
        let image = &shot.image;
        if size(image) != size(&first.image) {
            return Err(Error::input(
                Subject::item(Parameter::Captures, &shot.name),
                size(image),
                format!(
                    "all captures have one size; {} has {}",
                    first.name,
                    size(&first.image)
                ),
                "Record all captures with one region of interest and binning, or leave this one out.",
            ).with_kind(ErrorKind::Shape));
        }
        if let Some((y, x)) = image.first_non_finite() {
            return Err(Error::input(
                Subject::item(Parameter::Captures, &shot.name),
                format!("{} at row {y}, column {x}", image.at(y, x)),
                "every pixel of a capture is a finite number",
                "Record it again, or replace the pixel by the mean of its neighbours.",
            )
            .with_kind(ErrorKind::NotFinite));
        }
        if image.min() == image.max() {
            return Err(Error::input(
                Subject::item(Parameter::Captures, &shot.name),
                format!("{} in every pixel", image.max()),
                "a capture of a point source shows its speckle",
                "Check light, shutter and exposure, and that no dark frame is among the captures.",
            )
            .with_kind(ErrorKind::NoSignal));
        }
        if let Some(dark) = &params.dark {
            check_dark(shot, dark)?;
        }
    }
    let exposures = &params.exposures_ms;
    if !exposures.is_empty() && exposures.len() != shots.len() {
        return Err(Error::input(
            Parameter::ExposuresMs,
            format!("{} exposures for {} captures", exposures.len(), shots.len()),
            "each capture has its exposure, in the same order",
            phrase![
                "Give one number per capture, such as ",
                (Parameter::ExposuresMs, "1,10,100"),
                "; files of a folder go by name."
            ],
        )
        .with_kind(ErrorKind::Shape));
    }
    if let Some(bad) = exposures.iter().find(|t| !(t.is_finite() && **t > 0.0)) {
        return Err(Error::input(
            Parameter::ExposuresMs,
            bad,
            "an exposure is a number of milliseconds above zero",
            "Read it from the camera's software.",
        ));
    }
    Ok(())
}

fn check_dark(shot: &NamedCapture, dark: &Image) -> Result<()> {
    let size = |image: &Image| format!("{}×{} pixels", image.rows(), image.columns());
    if size(dark) != size(&shot.image) {
        return Err(Error::input(
            Parameter::Dark,
            size(dark),
            format!("it has the size of the captures, {}", size(&shot.image)),
            "Record it with the camera settings of the captures.",
        )
        .with_kind(ErrorKind::Shape));
    }
    if let Some((y, x)) = dark.first_non_finite() {
        return Err(Error::input(
            Parameter::Dark,
            format!("{} at row {y}, column {x}", dark.at(y, x)),
            "every pixel of a dark frame is a finite number",
            "Record it again, or replace the pixel by the mean of its neighbours.",
        )
        .with_kind(ErrorKind::NotFinite));
    }
    let mean = |image: &Image| {
        image.data().iter().map(|&p| f64::from(p)).sum::<f64>() / image.data().len() as f64
    };
    let (below, above) = (mean(dark), mean(&shot.image));
    if below >= above {
        return Err(Error::input(
            Parameter::Dark,
            format!("a mean of {below:.1} counts, {} has {above:.1}", shot.name),
            "a dark frame is darker than a capture",
            "Check that the two are not exchanged, and that the lens was covered.",
        )
        .with_kind(ErrorKind::NoSignal));
    }
    Ok(())
}

/// Counts from which on a pixel of `image` is saturated.
fn saturation(image: &Image, known: Option<f64>) -> Option<f64> {
    let top = image.max();
    let mut next = f32::NEG_INFINITY;
    let (mut at_top, mut at_next) = (0, 0);
    for &p in image.data() {
        if p == top {
            at_top += 1;
        } else if p > next {
            (next, at_next) = (p, 1);
        } else if p == next {
            at_next += 1;
        }
    }
    // Speckle gets rarer towards bright values: many more pixels at the last than at the
    // one before were cut off there.
    let piled = at_top >= 20 && at_top >= 4 * at_next;
    match known {
        Some(end) if piled => Some(end.min(f64::from(top))),
        known => known.or(piled.then_some(f64::from(top))),
    }
}

/// Captures that are kept, and names and correlations of those left out.
type AgreeingCaptures = (Vec<usize>, Vec<(String, f64)>);

/// Which captures show the pattern of the others, and those that do not.
fn agreeing(shots: &[NamedCapture], rates: &[Rate]) -> Result<AgreeingCaptures> {
    let all: Vec<usize> = (0..rates.len()).collect();
    if all.len() == 1 {
        return Ok((all, Vec::new()));
    }
    // A capture that is far off drags down the mean that the others are compared with:
    // the second round is without those found in the first.
    let mut kept = all.clone();
    let mut values = Vec::new();
    for _ in 0..2 {
        values = all
            .iter()
            .map(|&i| correlation(&rates[i], rates, &kept, i))
            .collect();
        let mut sorted: Vec<f64> = kept.iter().map(|&i| values[i]).collect();
        sorted.sort_by(f64::total_cmp);
        let typical = sorted[sorted.len() / 2];
        if typical < SAME_PATTERN || all.len() == 2 && sorted[0] < SAME_PATTERN {
            let worst = all
                .iter()
                .min_by(|&&a, &&b| values[a].total_cmp(&values[b]));
            let worst = *worst.expect("there are two or more");
            return Err(Error::input(
                Subject::item(Parameter::Captures, &shots[worst].name),
                format!(
                    "a correlation of {:.2} with the other captures",
                    values[worst]
                ),
                format!(
                    "captures that are averaged show one pattern: a correlation above {SAME_PATTERN}"
                ),
                phrase![
                    "Fix source, diffuser and camera; if the source was moved on purpose, give the positions with ",
                    Parameter::PositionsMm,
                    "."
                ],
            ));
        }
        kept = all
            .iter()
            .copied()
            .filter(|&i| values[i] >= OUTLIER * typical)
            .collect();
    }
    let out = all.iter().filter(|i| !kept.contains(i));
    let left_out = out.map(|&i| (shots[i].name.clone(), values[i])).collect();
    Ok((kept, left_out))
}

/// Pearson's correlation of a capture with the mean of the `others`, over pixels that are
/// not saturated in either.
fn correlation(rate: &Rate, rates: &[Rate], others: &[usize], index: usize) -> f64 {
    let mut sums = Sums::default();
    for p in 0..rate.full.len() {
        if rate.full[p] {
            continue;
        }
        let (mut light, mut time) = (0.0, 0.0);
        for &i in others {
            if i != index && !rates[i].full[p] {
                light += f64::from(rates[i].image.data()[p]) * rates[i].scale;
                time += rates[i].exposure * rates[i].scale;
            }
        }
        if time > 0.0 {
            sums.add(f64::from(rate.image.data()[p]), light / time);
        }
    }
    sums.correlation()
}

/// Running sums for Pearson's correlation.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    n: f64,
    a: f64,
    b: f64,
    aa: f64,
    ab: f64,
    bb: f64,
}

impl Sums {
    pub fn add(&mut self, a: f64, b: f64) {
        self.n += 1.0;
        self.a += a;
        self.b += b;
        self.aa += a * a;
        self.ab += a * b;
        self.bb += b * b;
    }

    /// 0 where there is nothing to correlate.
    pub fn correlation(&self) -> f64 {
        let n = self.n.max(1.0);
        let (a, b) = (self.a / n, self.b / n);
        let variance = (self.aa / n - a * a) * (self.bb / n - b * b);
        if variance > 0.0 {
            (self.ab / n - a * b) / variance.sqrt()
        } else {
            0.0
        }
    }
}

/// The merged light, and how many pixels are saturated in (nearly) all captures.
fn sum(rates: &[Rate], kept: &[usize], several: bool) -> (Image, usize) {
    let first = &rates[kept[0]].image;
    let mut image = Image::zeros(first.rows(), first.columns());
    let mut saturated = 0;
    let shortest = kept
        .iter()
        .copied()
        .min_by(|&a, &b| rates[a].exposure.total_cmp(&rates[b].exposure))
        .expect("a capture is kept");
    for p in 0..first.data().len() {
        let full = kept.iter().filter(|&&i| rates[i].full[p]).count();
        let (mut light, mut time) = (0.0, 0.0);
        for &i in kept {
            if !(several && rates[i].full[p]) {
                light += f64::from(rates[i].image.data()[p]);
                time += rates[i].exposure;
            }
        }
        if time == 0.0 {
            light = f64::from(rates[shortest].image.data()[p]);
            time = rates[shortest].exposure;
        }
        let lost = if several {
            full == kept.len()
        } else {
            2 * full >= kept.len() && full > 0
        };
        saturated += usize::from(lost);
        image.data_mut()[p] = (light / time) as f32;
    }
    (image, saturated)
}
