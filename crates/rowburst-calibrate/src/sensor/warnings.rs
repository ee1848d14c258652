//! What a calibration cannot correct, in words.

use super::levels::Level;
use super::{FullWell, SensorCalibration, Stack, pixels, stats};

/// Fewer frames than these leave the map of the dark noisier than a tenth more noise in
/// each corrected frame: √(1 + 1/10) is 5 %.
const ENOUGH_DARKS: usize = 10;

/// A lamp that changes by more than this between flats of one level is worth a word.
const FLICKER: f64 = 0.01;

/// Part of the mean by which even light varies over the field at most.
const MAX_UNEVENNESS: f64 = 0.3;

/// Standard error of the gain above which it is not one.
const GOOD_GAIN: f64 = 0.05;

/// Part of bad pixels above which the frames, not the sensor, are the likely cause.
const MANY_BAD: f64 = 0.05;

/// All that `found` should be read with.
pub(super) fn of(
    found: &SensorCalibration,
    darks: &Stack,
    flats: &Stack,
    lights: &[f64],
    usable: &[bool],
) -> Vec<String> {
    let mut warnings = Vec::new();
    dark_frames(found, darks, usable, &mut warnings);
    light(found, lights, usable, &mut warnings);
    let bad = found.faults.count() as f64 / usable.len() as f64;
    if bad > MANY_BAD {
        warnings.push(format!(
            "{:.1} % of the pixels are bad: check that all frames are raw and taken at one gain, exposure and temperature",
            100.0 * bad
        ));
    }
    if found.gain_error > GOOD_GAIN {
        warnings.push(format!(
            "the gain is uncertain by {:.0} %: record more flats, at several levels up to half of the range",
            100.0 * found.gain_error
        ));
    }
    warnings.extend(bend(found));
    if found.flat_error > found.non_uniformity.max(1e-3) {
        warnings.push(format!(
            "the flat is uncertain by {:.2} % per pixel, more than the {:.2} % by which pixels differ: correcting by it adds noise; record {} flats or more",
            100.0 * found.flat_error,
            100.0 * found.non_uniformity,
            more_flats(found, flats.len())
        ));
    }
    warnings
}

/// Flats that bring the error of the flat to the pixels' own differences.
fn more_flats(found: &SensorCalibration, now: usize) -> usize {
    let ratio = found.flat_error / found.non_uniformity.max(1e-3);
    (now as f64 * ratio * ratio).ceil() as usize
}

fn dark_frames(
    found: &SensorCalibration,
    darks: &Stack,
    usable: &[bool],
    warnings: &mut Vec<String>,
) {
    if darks.len() < ENOUGH_DARKS {
        warnings.push(format!(
            "{} darks: their mean adds {:.0} % to the noise of a dark pixel; record {ENOUGH_DARKS} or more",
            darks.len(),
            100.0 * ((1.0 + 1.0 / darks.len() as f64).sqrt() - 1.0)
        ));
    }
    let zeros = darks
        .images()
        .flat_map(|image| image.data().iter().zip(usable));
    let zero = stats::mean(
        zeros
            .filter(|(_, u)| **u)
            .map(|(&p, _)| f64::from(u8::from(p <= 0.0))),
    );
    if found.has_integer_counts && zero > 0.01 {
        warnings.push(format!(
            "{:.0} % of the dark readings are 0: noise is cut off there, and read noise and bias come out wrong; raise the camera's black level (offset)",
            100.0 * zero
        ));
    }
    let noise = found.banding.pixel_counts;
    let drift = found.dark_drift.iter().fold(0.0f64, |m, d| m.max(d.abs()));
    if drift > 0.5 * noise && drift > 0.1 {
        warnings.push(format!(
            "the dark level drifts by {drift:.2} counts from frame to frame (noise of a pixel: {noise:.2}): let the camera warm up, and take darks next to the captures"
        ));
    }
    let banding = &found.banding;
    // From here on the rows' own noise outweighs what the pixels give a row's mean.
    if banding.is_real && banding.row_counts > banding.expected_counts {
        warnings.push(format!(
            "banding: rows vary by {:.3} counts ({:.2} electrons) rms, more than the {:.3} expected from pixel noise; subtracting the mean dark does not remove this: check supply and cooling, or subtract the mean of shaded columns from each row",
            banding.row_counts,
            banding.row_counts * found.gain_electrons_per_count,
            banding.expected_counts
        ));
    }
}

fn light(found: &SensorCalibration, lights: &[f64], usable: &[bool], warnings: &mut Vec<String>) {
    // Steps from frame to frame as they were taken. A fine series of levels has steps
    // between its levels only, a lamp that flickers between nearly all frames.
    let step = |level: &Level| {
        let mut order = level.frames.clone();
        order.sort_unstable();
        let steps = order
            .windows(2)
            .map(|pair| (lights[pair[0]] - lights[pair[1]]).abs());
        let mut steps: Vec<f64> = steps.collect();
        steps.sort_by(f64::total_cmp);
        steps.get(steps.len() / 3).map(|step| step / level.light)
    };
    let whole = found.levels.iter().filter(|l| l.is_unclipped());
    let flicker = stats::median(&mut whole.filter_map(step).collect::<Vec<f64>>());
    if flicker > FLICKER {
        warnings.push(format!(
            "flats of one level differ in light by {:.1} %; pairs were scaled to equal light; a steady (direct-current) lamp is better",
            100.0 * flicker
        ));
    }
    let single = found.levels.iter().filter(|l| l.frames.len() < 2).count();
    if single > 0 {
        warnings.push(format!(
            "{single} of {} levels have one flat only and give no noise; record two or more at each",
            found.levels.len()
        ));
    }
    if found.levels.iter().all(|level| !level.is_unclipped()) {
        warnings.push("some pixels are saturated in every flat: flat field and gain are less certain; dim the light for some".into());
    }
    let uneven = pixels::unevenness(&found.response, usable);
    if uneven > MAX_UNEVENNESS {
        warnings.push(format!(
            "the flats' brightness varies by {:.0} % of its mean over the field: uneven light is mistaken for the sensor's response; take off the lens and use a diffuse source",
            100.0 * uneven
        ));
    }
}

/// Whether the curve bends: a gain that differs between its halves.
fn bend(found: &SensorCalibration) -> Option<String> {
    const MAX_NONLINEARITY: f64 = 0.1;
    let gone = |p: &&super::TransferPoint| p.used && p.level.is_some() && p.samples > 5000.0;
    let worst = found.transfer.iter().filter(gone).map(|p| {
        let expected = found.line.at(p.light);
        (p.variance - expected) / expected
    });
    let worst = worst.fold(0.0f64, |m, v| if v.abs() > m.abs() { v } else { m });
    (worst.abs() > MAX_NONLINEARITY).then(|| {
        format!(
            "the photon transfer curve is not linear: one level deviates by {:+.0} %; give raw, linear counts (no gamma, no denoising), one gain for all",
            100.0 * worst
        )
    })
}

impl SensorCalibration {
    /// What the results were made from, and what they cannot tell.
    pub fn remarks(&self) -> Vec<String> {
        let levels = self.levels.iter().filter(|l| l.frames.len() > 1).count();
        let points = self.transfer.iter().filter(|p| p.used).count() - 1;
        let gain = if levels == 1 {
            format!(
                "gain: variance of {} pairs of flats of one level, in {points} bins of the field's own brightness, and the darks",
                self.pairs
            )
        } else {
            format!(
                "gain: variance of {} pairs of flats of {levels} levels, {points} points, and the darks",
                self.pairs
            )
        };
        let full = match self.full_well {
            Some(FullWell { counts, sign }) => match sign {
                super::FullSign::Clipped => {
                    format!("full well: readings pile up at {counts:.0} counts")
                }
                super::FullSign::Turnover => format!(
                    "full well: the variance falls above {counts:.0} counts; it lies between this level and the next"
                ),
            },
            None => "full well: not reached by these flats; add some that are too bright".into(),
        };
        vec![
            gain,
            full,
            "dark current: not separated from the bias, since all darks are assumed to have one exposure; take them at the exposure of use".into(),
        ]
    }
}
