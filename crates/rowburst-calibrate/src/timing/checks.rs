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

pub(super) fn check_periods(periods: f64, frequency_hz: f64) -> Result<()> {
    if periods >= MIN_PERIODS {
        return Ok(());
    }
    Err(Error::input(
        Parameter::Frames,
        format!("{periods:.2} periods of the light in the readout of a frame"),
        format!(
            "at least {MIN_PERIODS} are needed to separate the modulation from the profile of the lamp"
        ),
        format!(
            "Blink at {} Hz or more; about {} Hz gives 20 periods.",
            rounded(1.1 * MIN_PERIODS / periods * frequency_hz),
            rounded(20.0 / periods * frequency_hz)
        ),
    ).with_kind(ErrorKind::NoSignal))
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
