//! Row time, shutter and exposure from frames of a light that changes in a known way.
//!
//! Row `r` integrates the light over the exposure that ends at `t₀ + k[r]·τ` (Eq. 2), so that a
//! light of frequency `F` shows `ν = F·τ` cycles per row time: `τ = ν/F`. The light lights
//! all rows, as a lamp close to the sensor or through a diffuser does.
//!
//! A light of unknown course and known frequency cannot tell a readout order from its
//! reverse: played backwards it is another light of that frequency. It does tell
//! one sweep from two, which mirror each other. A light of known course tells all.

mod checks;
mod fit;
mod matched;
mod orders;
mod pattern;
mod periodic;
mod periodogram;
mod rows;
mod search;
mod square;
mod waveform;

pub use waveform::{Extension, Waveform};

use checks::{
    check_agreement, check_alias, check_expected, check_expected_periods, check_periods,
    expected_warning, readout_warning, unseen,
};
use matched::MatchedFit;
use orders::{advice, candidate, consistent_shutters};
use periodic::PeriodicFit;
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::{Image, Shutter};
use rows::RowSignals;
use search::{best_of, fundamental, refined, start_of, total_power};
use std::borrow::Cow;

/// The light in the frames.
#[derive(Debug, Clone, PartialEq)]
pub enum Lamp {
    /// A light of known frequency, of any course.
    Periodic {
        /// Its frequency in hertz.
        frequency_hz: f64,
        /// Part of the period in which it is on, for a square wave; `None` where that is not
        /// known.
        duty: Option<f64>,
    },
    /// A light of known course; when it started is not known.
    Waveform(Waveform),
}

/// What is known beside the frames.
#[derive(Debug, Clone, PartialEq)]
pub struct TimingParams {
    /// A frame without light, of the frames' size.
    pub dark: Option<Image>,
    /// A frame of even and steady light.
    pub flat: Option<Image>,
    /// Counts at and above which a pixel is saturated.
    pub saturation_counts: Option<f64>,
    /// The row time that is expected, to tell aliases apart: within 30 % of the truth.
    pub expected_row_time_us: Option<f64>,
    /// Row times among which that of a light of known course is looked for, where none
    /// is expected. The default, 2 to 100 µs, holds those of cameras from 10 to 500 kHz line rate.
    pub row_times_us: (f64, f64),
}

impl Default for TimingParams {
    fn default() -> Self {
        Self {
            dark: None,
            flat: None,
            saturation_counts: None,
            expected_row_time_us: None,
            row_times_us: (2.0, 100.0),
        }
    }
}

/// What the frames say of the camera's timing.
#[derive(Debug, Clone, PartialEq)]
pub struct Timing {
    /// Time from one instant to the next, in microseconds.
    pub row_time_us: f64,
    /// Its standard error.
    pub row_time_us_error: f64,
    /// Readout orders that the light leaves, best first.
    pub shutters: Vec<Shutter>,
    /// Exposure of a row and its standard error in microseconds; `None` where the light does not show it.
    pub exposure_us: Option<(f64, f64)>,
    /// How the exposure was found, or why it was not.
    pub exposure_basis: String,
    /// Duration of the readout of a frame, all instants, in milliseconds.
    pub readout_ms: f64,
    /// Periods of the light during the readout; `None` for a light that does not repeat.
    pub periods: Option<f64>,
    /// Of each frame, when its first instant is read: the part of a period since the
    /// maximum of the fundamental, or the time on the signal's clock in microseconds.
    pub phases: Vec<f64>,
    /// `(max − min)/(max + min)` of the light that the rows of frame 1 saw, by the fit.
    pub modulation_depth: f64,
    /// Part of the rows' variance that the fit explains.
    pub explained: f64,
    /// All readout orders, those that are left out too.
    pub candidates: Vec<Candidate>,
    /// The rows of each frame over their mean, and what the fit says of them.
    pub profiles: Vec<(Vec<f64>, Vec<f64>)>,
    /// Power against cycles per row time, of the best readout order.
    pub periodogram: Vec<(f64, f64)>,
    /// What should be known before the numbers are used.
    pub warnings: Vec<String>,
    /// The light that would decide between the candidates left.
    pub advice: Option<String>,
}

/// A readout order and how well it explains the rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The order.
    pub shutter: Shutter,
    /// Row time of its best fit in microseconds.
    pub row_time_us: f64,
    /// χ² per degree of freedom, the noise being that which the best order leaves.
    pub chi2: f64,
    /// χ² beyond the best order's, related residuals allowed for.
    pub excess: f64,
    /// Whether the light leaves it.
    pub is_consistent: bool,
}

/// An order whose χ² exceeds the best one's by this is left out: five standard errors
/// where the orders differ by one number.
pub const CLEAR_MARGIN: f64 = 25.0;
/// Fewest periods in the readout: with fewer the profile of the lamp cannot be told from
/// the course of the light.
pub const MIN_PERIODS: f64 = 3.0;
/// Fewest row times a period that are safe from aliases where no row time is expected.
pub const MIN_ROWS_PER_PERIOD: f64 = 4.0;
/// A peak this far above its surroundings is no noise: the largest of 4096 values of noise
/// exceeds it once in 10⁵ frames.
const CLEAR_PEAK: f64 = 20.0;
/// A fit that explains less of the rows is none.
const MIN_EXPLAINED: f64 = 0.2;
/// A signal of more row times is many frames long, and would take hours to search.
const MAX_SIGNAL_ROW_TIMES: f64 = 65_536.0;
/// A row with more saturated pixels than this has lost the shape of the light.
const MAX_SATURATED_FRACTION: f64 = 0.01;

const ORDERS: [Shutter; 4] = [
    Shutter::TopDown,
    Shutter::BottomUp,
    Shutter::DualInsideOut,
    Shutter::DualOutsideIn,
];

/// Finds row time, readout order and exposure from `frames` of `light`.
///
/// # Errors
/// No frames, frames of several sizes, values that are not finite; a light that is
/// not seen, shows fewer than three periods or aliases; frames that disagree.
pub fn calibrate(frames: &[Image], light: &Lamp, params: &TimingParams) -> Result<Timing> {
    check(light, params)?;
    let signals = rows::row_signals(frames, params)?;
    let mut timing = match light {
        Lamp::Periodic { frequency_hz, duty } => {
            calibrate_periodic(&signals, *frequency_hz, *duty, params)?
        }
        Lamp::Waveform(waveform) => calibrate_waveform(&signals, waveform, params)?,
    };
    if signals.saturated > MAX_SATURATED_FRACTION {
        timing.warnings.insert(0, format!(
            "up to {:.0} % of the pixels of a row are saturated: the row time is valid, but the shape of the stripes, and with it the exposure, is not; dim the light",
            100.0 * signals.saturated
        ));
        timing.exposure_us = None;
        timing.exposure_basis = "the brightest rows are saturated".into();
    }
    Ok(timing)
}

fn check(light: &Lamp, params: &TimingParams) -> Result<()> {
    let (low, high) = params.row_times_us;
    let mut numbers = vec![
        (Parameter::RowTimesUs, low),
        (Parameter::RowTimesUs, high - low),
    ];
    numbers.extend(
        params
            .expected_row_time_us
            .map(|t| (Parameter::ExpectedRowTimeUs, t)),
    );
    if let Lamp::Periodic { frequency_hz, duty } = light {
        numbers.push((Parameter::FrequencyHz, *frequency_hz));
        if let Some(duty) = duty.filter(|d| !(0.01..=0.99).contains(d)) {
            return Err(Error::input(
                Parameter::Duty,
                duty,
                "the light is on for 0.01 to 0.99 of its period",
                "Give the part as a fraction, such as 0.5.",
            ));
        }
    }
    match numbers
        .into_iter()
        .find(|(_, v)| !(v.is_finite() && *v > 0.0))
    {
        None => Ok(()),
        Some((name, value)) => Err(Error::input(
            name,
            value,
            "a number above zero is needed",
            "Give the frequency of the light in hertz, times in microseconds.",
        )),
    }
}

fn instants(rows: usize) -> Vec<Vec<usize>> {
    ORDERS
        .iter()
        .map(|s| s.instants(rows).expect("these orders fit any sensor"))
        .collect()
}

fn count_of(k: &[usize]) -> usize {
    k.iter().max().map_or(1, |last| last + 1)
}

/// Fits of a periodic light, one for each readout order.
struct OrderFits<'a> {
    fits: Vec<PeriodicFit>,
    /// Index of the order that leaves the least residual.
    best: usize,
    /// The fitted rows; the still scene is removed where that helps.
    frames: Cow<'a, [Vec<f64>]>,
    /// Whether a frequency stands out in the frames.
    has_clear_peak: bool,
}

impl<'a> OrderFits<'a> {
    /// Fits `frames` in each of `orders`.
    fn new(frames: &'a [Vec<f64>], orders: &[Vec<usize>]) -> Self {
        // One sweep either way is the same to a light of unknown course, and so are two
        // sweeps of an even number of rows.
        let is_even = frames[0].len().is_multiple_of(2);
        let same_as = [0, 0, 2, if is_even { 2 } else { 3 }];
        let mut has_clear_peak = false;
        let mut fits: Vec<PeriodicFit> = Vec::new();
        for (o, k) in orders.iter().enumerate() {
            if same_as[o] != o {
                fits.push(fits[same_as[o]].clone());
                continue;
            }
            let (start, clear) = start_of(frames, k);
            has_clear_peak |= clear;
            fits.push(fundamental(frames, k, start));
        }
        let fits = refined(frames, orders, same_as, &fits);
        let mut order_fits = Self {
            best: best_of(&fits),
            fits,
            frames: Cow::Borrowed(frames),
            has_clear_peak,
        };
        if pattern::is_identifiable(&order_fits.fits[order_fits.best]) {
            order_fits.remove_scene(orders, same_as);
        }
        order_fits
    }

    /// Removes the still scene from the rows, if that leaves clearly less variance.
    fn remove_scene(&mut self, orders: &[Vec<usize>], same_as: [usize; 4]) {
        let (mut cleaned, mut refits): (Vec<Vec<Vec<f64>>>, Vec<PeriodicFit>) =
            (Vec::new(), Vec::new());
        for (o, k) in orders.iter().enumerate() {
            if same_as[o] == o {
                let (rows, fit) = pattern::fit_without_scene(&self.frames, k, &self.fits[o]);
                cleaned.push(rows);
                refits.push(fit);
            } else {
                cleaned.push(cleaned[same_as[o]].clone());
                refits.push(refits[same_as[o]].clone());
            }
        }
        let variance = |f: &PeriodicFit| f.optimum.rss / f.dof.max(1.0);
        let best = best_of(&refits);
        // Without a still scene the removal would only lose information about the stripes.
        if variance(&refits[best]) < 0.7 * variance(&self.fits[self.best]) {
            self.fits = refits;
            self.best = best;
            self.frames = Cow::Owned(cleaned.swap_remove(best));
        }
    }
}

fn calibrate_periodic(
    signals: &RowSignals,
    frequency_hz: f64,
    duty: Option<f64>,
    params: &TimingParams,
) -> Result<Timing> {
    let frames = &signals.frames;
    let rows = frames[0].len();
    if let Some(expected) = params.expected_row_time_us {
        check_alias(frequency_hz * expected * 1e-6, frequency_hz, Some(expected))?;
        check_expected_periods(expected, frequency_hz, rows)?;
    }
    let orders = instants(rows);
    let order_fits = OrderFits::new(frames, &orders);
    let best = order_fits.best;
    let frames = &*order_fits.frames;
    let fit = &order_fits.fits[best];
    let explained = explained(frames, fit.optimum.rss, fit.profile.len() - 1);
    if !order_fits.has_clear_peak || explained < MIN_EXPLAINED {
        return Err(unseen(explained, frequency_hz, rows));
    }
    let periods = fit.cycles_per_row * count_of(&orders[best]) as f64;
    check_periods(periods, frequency_hz)?;
    check_agreement(frames, &orders[best], frequency_hz)?;
    if params.expected_row_time_us.is_none() {
        check_alias(fit.cycles_per_row, frequency_hz, None)?;
    }
    let period_us = 1e6 / frequency_hz;
    let (error, variance_inflation) = fit.error();
    let candidates = periodic_candidates(&order_fits.fits, fit, period_us, variance_inflation);
    let row_time_us = fit.cycles_per_row * period_us;
    if let Some(expected) = params.expected_row_time_us {
        check_expected(row_time_us, frequency_hz, expected)?;
    }
    let readout_ms = count_of(&orders[best]) as f64 * row_time_us * 1e-3;
    let mut warnings = expected_warning(row_time_us, params);
    warnings.extend(readout_warning(readout_ms, frequency_hz));
    let (exposure, exposure_basis) =
        square_exposure(frames, &orders[best], fit, duty, &mut warnings);
    let (low, high) = fit.extremes(0);
    if params.dark.is_none() {
        warnings.push("no dark frame: the modulation depth counts the bias as light".into());
    }
    Ok(Timing {
        row_time_us,
        row_time_us_error: error * period_us,
        exposure_us: exposure.map(|(e, error)| (e * period_us, error * period_us)),
        exposure_basis,
        readout_ms,
        periods: Some(periods),
        phases: (0..frames.len()).map(|f| fit.phase(f)).collect(),
        modulation_depth: depth(low, high),
        explained,
        profiles: frames
            .iter()
            .cloned()
            .zip(fit.model.iter().cloned())
            .collect(),
        periodogram: spectrum(frames, &orders[best], fit),
        warnings,
        advice: advice(&candidates, true),
        shutters: consistent_shutters(&candidates),
        candidates,
    })
}

/// The readout orders, compared with the `best` fit of a periodic light.
fn periodic_candidates(
    fits: &[PeriodicFit],
    best: &PeriodicFit,
    period_us: f64,
    variance_inflation: f64,
) -> Vec<Candidate> {
    let variance = best.optimum.rss / best.dof.max(1.0);
    fits.iter()
        .zip(ORDERS)
        .map(|(f, shutter)| {
            candidate(
                shutter,
                f.cycles_per_row * period_us,
                f.optimum.rss,
                f.dof,
                best.optimum.rss,
                variance * variance_inflation,
                variance,
            )
        })
        .collect()
}

fn calibrate_waveform(
    signals: &RowSignals,
    waveform: &Waveform,
    params: &TimingParams,
) -> Result<Timing> {
    let frames = &signals.frames;
    let rows = frames[0].len();
    let orders = instants(rows);
    let range = row_time_range(waveform, params)?;
    let fits = matched::fit_all(frames, &orders, waveform, range);
    let best = (0..fits.len())
        .filter(|&o| fits[o].is_some())
        .min_by(|&a, &b| {
            let rss = |o: usize| fits[o].as_ref().map_or(f64::INFINITY, |f| f.rss);
            rss(a).total_cmp(&rss(b))
        });
    let found = best.and_then(|o| Some((o, fits[o].as_ref()?)));
    let explained = found.map_or(0.0, |(_, f)| explained(frames, f.rss, 3));
    let Some((best, fit)) = found.filter(|_| explained > MIN_EXPLAINED) else {
        return Err(Error::input(
            Parameter::Frames,
            format!(
                "a signal that explains {:.0} % of the rows' variance",
                100.0 * explained.max(0.0)
            ),
            format!(
                "the rows follow the signal at a row time from {:.3} to {:.3} µs",
                range.0, range.1
            ),
            "Check that the signal is that of the lamp, that it lasts longer than the readout (or repeats), and the expected row time.",
        ));
    };
    let candidates = matched_candidates(&fits, fit);
    let mut warnings = expected_warning(fit.row_time_us, params);
    if fit.row_time_us < 1.01 * range.0 || fit.row_time_us > range.1 / 1.01 {
        warnings.push(format!(
            "the row time is at an end of the searched range, {:.3} to {:.3} µs: the true one may be outside",
            range.0, range.1
        ));
    }
    let shown = fit.exposure_error < MAX_RELATIVE_ERROR * fit.exposure_us;
    let (low, high) = fit.extremes;
    Ok(Timing {
        row_time_us: fit.row_time_us,
        row_time_us_error: fit.row_time_error,
        exposure_us: shown.then_some((fit.exposure_us, fit.exposure_error)),
        exposure_basis: if shown {
            "fit of the known waveform, blurred by the exposure".into()
        } else {
            "the light changes too slowly, or the rows are too noisy, to show the exposure".into()
        },
        readout_ms: count_of(&orders[best]) as f64 * fit.row_time_us * 1e-3,
        periods: None,
        phases: fit.offsets_us.clone(),
        modulation_depth: depth(low, high),
        explained,
        profiles: frames
            .iter()
            .cloned()
            .zip(fit.model.iter().cloned())
            .collect(),
        periodogram: {
            let p = periodogram::periodogram(&frames[0], &orders[best], 2);
            points(&p)
        },
        warnings,
        advice: advice(&candidates, false),
        shutters: consistent_shutters(&candidates),
        candidates,
    })
}

/// Smallest and largest row time to search for a light of known course, in microseconds.
fn row_time_range(waveform: &Waveform, params: &TimingParams) -> Result<(f64, f64)> {
    let range = match params.expected_row_time_us {
        Some(expected) => (expected / 1.3, expected * 1.3),
        None => params.row_times_us,
    };
    let (first, last) = waveform.span_us();
    if (last - first) / range.0 > MAX_SIGNAL_ROW_TIMES {
        return Err(Error::input(
            Parameter::Signal,
            format!("a waveform of {} ms", (last - first) * 1e-3),
            format!(
                "it lasts no longer than {MAX_SIGNAL_ROW_TIMES} of the shortest row times looked for, {} µs",
                range.0
            ),
            "Shorten it to the time around the frame, check that its times are in microseconds, or give the expected row time.",
        ));
    }
    Ok(range)
}

/// The readout orders, compared with the `best` fit of a light of known course.
fn matched_candidates(fits: &[Option<MatchedFit>], best: &MatchedFit) -> Vec<Candidate> {
    let variance = best.rss / best.dof.max(1.0);
    fits.iter()
        .zip(ORDERS)
        .filter_map(|(f, shutter)| {
            let f = f.as_ref()?;
            Some(candidate(
                shutter,
                f.row_time_us,
                f.rss,
                f.dof,
                best.rss,
                variance * best.variance_inflation,
                variance,
            ))
        })
        .collect()
}

/// An exposure with a larger standard error than this part of it is not shown by the frame.
const MAX_RELATIVE_ERROR: f64 = 0.2;
/// The third harmonic of a square wave or a pulse stands this many standard errors above
/// zero, or the light may as well be a sine, whose depth is not known.
const MIN_HARMONIC_Z: f64 = 6.0;
/// A trapezoid may leave this much more variance than free harmonics do; a lamp that
/// rises slowly, or a camera that is not linear, leaves more.
const TRAPEZOID_MAX_VARIANCE_RATIO: f64 = 1.5;

fn square_exposure(
    frames: &[Vec<f64>],
    k: &[usize],
    free: &PeriodicFit,
    duty: Option<f64>,
    warnings: &mut Vec<String>,
) -> (Option<(f64, f64)>, String) {
    if free.max_harmonic_z() < MIN_HARMONIC_Z {
        return (None, "only the fundamental is visible: a sine of unknown modulation depth does not determine the exposure; use a square wave or a chirp".into());
    }
    let Some(square) = square::fit(frames, k, free, duty) else {
        return (
            None,
            "no square wave fits: the light may have another waveform; give it as a signal file"
                .into(),
        );
    };
    let variance = |rss: f64, dof: f64| rss / dof.max(1.0);
    let misfit = variance(square.rss, square.dof) / variance(free.optimum.rss, free.dof);
    if misfit > TRAPEZOID_MAX_VARIANCE_RATIO {
        let found = format!(
            "a square wave leaves {misfit:.1} times the variance that free harmonics leave"
        );
        if duty.is_none() {
            return (
                None,
                format!(
                    "{found}: the light is no square wave, or the camera is not linear; give its duty cycle, or its waveform as a signal file"
                ),
            );
        }
        warnings.push(format!("{found}: the exposure may be off"));
    }
    match square.exposure {
        Some((exposure, error)) if error < MAX_RELATIVE_ERROR * exposure => (
            Some((exposure, error)),
            format!("edges of a square wave with a duty cycle of {:.3}; the exposure is assumed to be shorter than half a period", square.duty),
        ),
        Some(_) => (None, "the edges of the stripes are too sharp for their width to be measured: the exposure is short against the row time or the noise".into()),
        None => (None, format!("exposure and duty cycle cannot be separated: the pulse lasts {:.3} of the period, which is not near one half; give the duty cycle", square.duty)),
    }
}

fn explained(frames: &[Vec<f64>], rss: f64, degree: usize) -> f64 {
    let profile = fit::polynomials(frames[0].len(), degree);
    let total: f64 = frames
        .iter()
        .map(|y| {
            fit::linear(&profile, y)
                .residual
                .iter()
                .map(|e| e * e)
                .sum::<f64>()
        })
        .sum();
    if total > 0.0 { 1.0 - rss / total } else { 0.0 }
}

fn depth(low: f64, high: f64) -> f64 {
    // The fit may swing below zero where the light is out.
    ((high - low) / (high + low)).min(1.0)
}

fn spectrum(frames: &[Vec<f64>], k: &[usize], fit: &PeriodicFit) -> Vec<(f64, f64)> {
    points(&total_power(frames, k, fit.profile.len() - 1))
}

fn points(power: &periodogram::Periodogram) -> Vec<(f64, f64)> {
    let most = power
        .power
        .iter()
        .copied()
        .fold(f64::MIN_POSITIVE, f64::max);
    let values = power.power.iter().enumerate().skip(1);
    values
        .map(|(i, p)| (i as f64 * power.spacing, p / most))
        .collect()
}

#[cfg(test)]
mod tests;
