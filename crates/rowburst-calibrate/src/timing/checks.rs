//! Lights and frames that do not tell the row time, and what to change.

use super::{MIN_PERIODS, MIN_ROWS_PER_PERIOD, TimingParams, count_of, periodogram};
use rowburst_core::error::Subject;
use rowburst_core::{Error, ErrorKind, Parameter, Result};

pub(super) fn unseen(explained: f64, frequency_hz: f64, rows: usize) -> Error {
    Error::input(
        Parameter::Frames,
        format!(
            "no stripes above noise and scene (a periodic light explains {:.0} % of the rows' variance)",
            100.0 * explained.max(0.0)
        ),
        format!(
            "the rows show the stripes of a light of {frequency_hz} Hz, at least {MIN_PERIODS} periods in {rows} rows"
        ),
        "Light the sensor by the lamp alone, shorten the exposure to less than half a period, or choose a frequency that gives 5 to 50 periods in a readout.",
    ).with_kind(ErrorKind::NoSignal)
}

/// Refuses a light of too few periods in the readout. So few cannot be counted either, so the advice does not depend on
/// `periods`.
pub(super) fn check_periods(periods: f64, frequency_hz: f64) -> Result<()> {
    if periods >= MIN_PERIODS {
        return Ok(());
    }
    Err(Error::input(
        Parameter::Frames,
        format!("fewer than {MIN_PERIODS} periods of the light in the readout of a frame"),
        PERIODS_RULE,
        format!(
            "Blink faster, at {} Hz for example. An experiment file with the row time tells which frequency is right.",
            rounded(10.0 * frequency_hz)
        ),
    ).with_kind(ErrorKind::NoSignal))
}

/// Why a readout needs several periods.
const PERIODS_RULE: &str =
    "at least 3 are needed to separate the modulation from the profile of the lamp";

/// Refuses a light of which the readout holds too few periods at the row time that is expected. A readout has as many
/// instants as rows, or half of them where the shutter reads two at once.
pub(super) fn check_expected_periods(
    expected_us: f64,
    frequency_hz: f64,
    rows: usize,
) -> Result<()> {
    let instants = [rows.div_ceil(2) as f64, rows as f64];
    let periods = instants.map(|n| n * expected_us * 1e-6 * frequency_hz);
    if EXPECTED_TOLERANCE * periods[1] >= MIN_PERIODS {
        return Ok(());
    }
    let least = 1.1 * MIN_PERIODS / (instants[0] * expected_us * 1e-6);
    let most = MAX_CYCLES_PER_ROW / (expected_us * 1e-6);
    let good = (20.0 / MIN_PERIODS * least).min(most).max(least);
    let kilohertz = if 1e3 * periods[1] >= MIN_PERIODS && frequency_hz * 1e3 <= most {
        format!("Is the frequency {frequency_hz} kHz? Else blink")
    } else {
        "Blink".into()
    };
    Err(Error::input(
        Subject::setting(Parameter::FrequencyHz, frequency_hz),
        format!(
            "{:.2} to {:.2} periods of the light in a readout of {rows} rows at the row time of {expected_us} µs that is expected",
            periods[0], periods[1]
        ),
        PERIODS_RULE,
        format!(
            "{kilohertz} at {} Hz or more; about {} Hz is best.",
            rounded(least),
            rounded(good)
        ),
    ).with_kind(ErrorKind::NoSignal))
}

/// Factor by which an expected row time may be too small.
const EXPECTED_TOLERANCE: f64 = 1.3;
/// Cycles of the light per row time up to which its stripes are safely seen; larger aliases.
const MAX_CYCLES_PER_ROW: f64 = 0.25;
/// Relative distance from a multiple of the expected row time within which it is that multiple.
const MULTIPLE_TOLERANCE: f64 = 0.1;
/// Readout in milliseconds from which the unit of the frequency is asked for: slower than cameras read a frame.
const LONG_READOUT_MS: f64 = 100.0;

/// Refuses a row time that is half or twice the expected one, or ten times off: the light has another frequency than it
/// is said to have.
pub(super) fn check_expected(row_time_us: f64, frequency_hz: f64, expected: f64) -> Result<()> {
    let ratio = row_time_us / expected;
    let is_times = |factor: f64| (ratio / factor - 1.0).abs() < MULTIPLE_TOLERANCE;
    let question = if is_times(2.0) {
        format!(
            "Does the light blink at {} Hz, twice in each period of its current?",
            2.0 * frequency_hz
        )
    } else if is_times(0.5) {
        format!(
            "Does the light blink at {} Hz, once in two periods?",
            0.5 * frequency_hz
        )
    } else if (0.1..10.0).contains(&ratio) {
        return Ok(());
    } else {
        "Is the frequency in hertz?".into()
    };
    Err(Error::input(
        Subject::setting(Parameter::FrequencyHz, frequency_hz),
        format!("a row time of {row_time_us:.4} µs, {ratio:.3} times the {expected} µs that are expected"),
        "the row time that is expected is within 30 % of the true one",
        format!("{question} If the expected row time is wrong, correct it in the experiment file."),
    )
    .with_kind(ErrorKind::Conflict))
}

/// Asks for the unit of the frequency where the readout is slower than that of any camera.
pub(super) fn readout_warning(readout_ms: f64, frequency_hz: f64) -> Option<String> {
    (readout_ms > LONG_READOUT_MS).then(|| {
        format!(
            "a readout of {readout_ms:.0} ms is longer than cameras take: is the light of {frequency_hz} Hz, or of {frequency_hz} kHz?"
        )
    })
}

pub(super) fn check_alias(
    cycles_per_row: f64,
    frequency_hz: f64,
    expected: Option<f64>,
) -> Result<()> {
    let most = if expected.is_some() {
        0.45
    } else {
        1.0 / MIN_ROWS_PER_PERIOD
    };
    if cycles_per_row <= most {
        return Ok(());
    }
    let slower = rounded(0.1 / cycles_per_row * frequency_hz);
    let found = match expected {
        Some(expected) => format!(
            "a period of {:.2} row times at the row time of {expected} µs that is expected",
            1.0 / cycles_per_row
        ),
        None => format!("stripes of {:.2} rows", 1.0 / cycles_per_row),
    };
    Err(Error::input(
        Subject::setting(Parameter::FrequencyHz, frequency_hz),
        found,
        match expected {
            Some(_) => "a period lasts more than two row times, or the light aliases: its stripes look like those of a slower one".to_string(),
            None => format!("stripes of fewer than {MIN_ROWS_PER_PERIOD} rows may be an alias of a faster light, which would give another row time"),
        },
        format!("Blink more slowly: about {slower} Hz gives 10 rows a period."),
    ))
}

/// To two digits.
fn rounded(value: f64) -> f64 {
    let unit = 10f64.powf(value.abs().log10().floor() - 1.0);
    let rounded = (value / unit).round() * unit;
    if unit >= 1.0 {
        rounded.round()
    } else {
        rounded
    }
}

pub(super) fn check_agreement(frames: &[Vec<f64>], k: &[usize], frequency_hz: f64) -> Result<()> {
    let width = 1.0 / count_of(k) as f64;
    let peaks: Vec<f64> = frames
        .iter()
        .map(|frame| periodogram::periodogram(frame, k, 2).peak().0)
        .collect();
    let Some(odd) = peaks.iter().position(|p| (p - peaks[0]).abs() > width) else {
        return Ok(());
    };
    let list: Vec<String> = peaks
        .iter()
        .map(|p| format!("{:.3}", p / frequency_hz * 1e6))
        .collect();
    Err(Error::input(
        Subject::element(Parameter::Frames, "frame", odd),
        format!("row times that disagree: {} µs", list.join(", ")),
        "all frames are of one light and one setting of the camera",
        "Leave out the frames of another frequency or another readout rate.",
    )
    .with_kind(ErrorKind::Conflict))
}

pub(super) fn expected_warning(row_time_us: f64, params: &TimingParams) -> Vec<String> {
    let off = |expected: &f64| (row_time_us / expected - 1.0).abs() > 0.02;
    let warning = |expected: f64| {
        format!(
            "the row time found, {row_time_us:.4} µs, is not the expected {expected} µs ({:+.1} %): check the frequency of the light, and that the experiment is of this camera setting",
            100.0 * (row_time_us / expected - 1.0)
        )
    };
    params
        .expected_row_time_us
        .filter(off)
        .map(warning)
        .into_iter()
        .collect()
}
