//! The camera: its readout order, the time grid, the field, and the calibration of its counts.

use crate::{Shutter, TimeGrid};
use rowburst_core::error::Phrase;
use rowburst_core::{Error, Parameter, Result, Shape, phrase};
use std::ops::Range;

/// A rolling-shutter camera and the field that is reconstructed from its frames.
///
/// [`Camera::new`] checks all parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    params: CameraParams,
    instants: Vec<usize>,
    time: TimeGrid,
    /// The part of the readout that [`Camera::subset`] keeps; `None`: the whole readout.
    subset: Option<Subset>,
    /// What [`Camera::retimed`] changed.
    retiming: Option<Retiming>,
}

#[derive(Debug, Clone, PartialEq)]
struct Retiming {
    change: TimingChange,
    /// Of each frame row, before the change.
    instants: Vec<usize>,
}

#[derive(Debug, Clone, PartialEq)]
struct Subset {
    /// Sensor row of each frame row.
    rows: Vec<usize>,
    /// First bin in the whole readout.
    first_bin: usize,
}

/// Parameters of a [`Camera`]: the tables `[camera]` and `[field]` of the experiment file.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraParams {
    /// Rows of the working grid (after binning).
    pub rows: usize,
    /// Columns of the working grid (after binning).
    pub columns: usize,
    /// Order in which the rows are read.
    pub shutter: Shutter,
    /// Time from one instant to the next, in microseconds.
    pub row_time_us: f64,
    /// Exposure of each row, in microseconds.
    pub exposure_us: f64,
    /// Time bins of the video in each row time.
    pub bins_per_row: usize,
    /// Rows and columns of the field; `None` for those of the sensor.
    pub field: Option<(usize, usize)>,
    /// Calibration of the sensor's counts.
    pub sensor: Sensor,
}

/// Pixels and counts of the sensor, and how it sees the scene. All values but the binning are optional.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensor {
    /// Raw pixels along one side of a pixel of the working grid.
    pub binning: usize,
    /// Pitch of a pixel of the working grid, in micrometres.
    pub pixel_pitch_um: Option<f64>,
    /// Size of an image on the sensor over that of the object, `M` of Eq. 1.
    pub magnification: Option<f64>,
    /// From the trigger to the start of exposure of the row that is read first, in microseconds.
    pub trigger_delay_us: Option<f64>,
    /// Bits of the analogue-to-digital converter; the largest count is `2^bits − 1`.
    pub bit_depth: Option<u32>,
    /// Counts without light.
    pub bias_counts: Option<f64>,
    /// Electrons per count.
    pub gain_electrons_per_count: Option<f64>,
    /// Read noise in electrons rms.
    pub read_noise_electrons: Option<f64>,
    /// Counts at which a pixel is full.
    pub full_well_counts: Option<f64>,
}

/// By what the timing of a camera differs from its parameters, in row times.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TimingChange {
    /// By how much the exposure of each row is longer. It ends when it did.
    pub exposure_rows: f64,
    /// By how much the lower half of a dual shutter is later than the upper half.
    pub half_delay_rows: f64,
}

impl Default for Sensor {
    fn default() -> Self {
        Self {
            binning: 1,
            pixel_pitch_um: None,
            magnification: None,
            trigger_delay_us: None,
            bit_depth: None,
            bias_counts: None,
            gain_electrons_per_count: None,
            read_noise_electrons: None,
            full_well_counts: None,
        }
    }
}

impl Sensor {
    /// Counts from which a raw pixel is saturated: the smaller one of the full well and the converter's largest
    /// count.
    ///
    /// `None` if neither is known.
    pub fn saturation_counts(&self) -> Option<f64> {
        let converter = self.bit_depth.map(|bits| f64::from(bits).exp2() - 1.0);
        match (self.full_well_counts, converter) {
            (Some(well), Some(end)) => Some(well.min(end)),
            (well, end) => well.or(end),
        }
    }

    /// Size at the object of a pixel of the working grid, in micrometres. `None` if pitch or magnification is not known.
    pub fn object_pixel_um(&self) -> Option<f64> {
        Some(self.pixel_pitch_um? / self.magnification?)
    }
}

/// Longest side of a sensor or a field in pixels: twice that of the largest sensors; tables of its pixels still fit
/// in memory.
pub const MAX_SIDE: usize = 65_536;

impl Camera {
    /// Checks `params` and computes the time grid.
    ///
    /// # Errors
    /// A value that breaks a rule; the error names the key, the value and the rule.
    pub fn new(params: CameraParams) -> Result<Self> {
        for (key, value) in [
            (Parameter::Rows, params.rows),
            (Parameter::Columns, params.columns),
        ] {
            require(
                (1..=MAX_SIDE).contains(&value),
                key,
                value,
                format!("a sensor has at least one and at most {MAX_SIDE}"),
                "Give the size of the frame in pixels.",
            )?;
        }
        for (key, value) in [
            (Parameter::RowTimeUs, params.row_time_us),
            (Parameter::ExposureUs, params.exposure_us),
        ] {
            require(
                value.is_finite() && value > 0.0,
                key,
                value,
                "a time is a number of microseconds above zero",
                "Read it from the camera's data sheet or software.",
            )?;
        }
        require(
            (1..=64).contains(&params.bins_per_row),
            Parameter::BinsPerRow,
            params.bins_per_row,
            "an instant is divided into 1 to 64 bins",
            "Leave it out for one bin a row.",
        )?;
        check_field(&params)?;
        check_sensor(&params.sensor)?;
        let instants = params.shutter.instants(params.rows)?;
        let time = match params.shutter {
            Shutter::Global => TimeGrid::single(params.exposure_us),
            _ => {
                let count = instants.iter().max().map_or(1, |last| last + 1);
                let exposure = params.exposure_us / params.row_time_us;
                require(
                    exposure <= 10.0 * count as f64,
                    Parameter::ExposureUs,
                    params.exposure_us,
                    format!(
                        "an exposure of {exposure:.0} row times is more than ten times the readout of {count} row times, so all rows integrate nearly the same light"
                    ),
                    "Check that exposure_us and row_time_us are both in microseconds; shorten the exposure.",
                )?;
                TimeGrid::rolling(count, params.row_time_us, exposure, params.bins_per_row)
            }
        };
        Ok(Self {
            params,
            instants,
            time,
            subset: None,
            retiming: None,
        })
    }

    /// The camera that reads only the rows that are exposed to `bins`.
    ///
    /// Its frame has only these rows, one after another, and its video only these bins; the field is the same. If the
    /// exposure is at most one row time, no row is exposed to bins both inside and outside. Then each row belongs to
    /// one subset, and a video can be reconstructed chunk by chunk.
    ///
    /// # Errors
    /// If `bins` is empty or out of range, if a row is exposed to bins both inside and outside, or
    /// if no row is exposed to them.
    pub fn subset(&self, bins: Range<usize>) -> Result<Self> {
        require(
            bins.start < bins.end && bins.end <= self.time.bins(),
            Parameter::Bins,
            format!("{}..{}", bins.start, bins.end),
            format!("a range of the bins 0..{}", self.time.bins()),
            phrase![
                "Give the first bin and the one after the last: ",
                (Parameter::Bins, "FIRST..END"),
                "."
            ],
        )?;
        for run in self.time.instants() {
            let sees = run.bins();
            let is_inside = bins.start <= sees.start && sees.end <= bins.end;
            require(
                is_inside || sees.end <= bins.start || bins.end <= sees.start,
                Parameter::Bins,
                format!("{}..{}", bins.start, bins.end),
                format!(
                    "no row is exposed both inside and outside the range, as some are to bins {}..{}",
                    sees.start, sees.end
                ),
                "Ranges need exposures of at most one row time; with bins_per_row above 1 they begin at a row.",
            )?;
        }
        self.within(bins)
    }

    /// The camera that reads only the rows that are exposed to `bins` and to no other bins. With exposures longer than a
    /// row time fewer of its rows see the first and last of these bins than those between.
    ///
    /// # Errors
    /// If no row is exposed to them alone.
    ///
    /// # Panics
    /// If `bins` is out of range.
    pub fn within(&self, bins: Range<usize>) -> Result<Self> {
        let instants = self.time.instants().iter().enumerate();
        let kept: Vec<usize> = instants
            .filter(|(_, run)| bins.start <= run.bins().start && run.bins().end <= bins.end)
            .map(|(i, _)| i)
            .collect();
        let first_instant = kept.first().copied().unwrap_or(0);
        let reads = |row: &usize| kept.contains(&self.instants[*row]);
        let kept_rows: Vec<usize> = (0..self.rows()).filter(reads).collect();
        require(
            !kept_rows.is_empty(),
            Parameter::Bins,
            format!("{}..{}", bins.start, bins.end),
            "at least one row is exposed to these bins",
            "Give a wider range.",
        )?;
        let sensor_rows: Vec<usize> = self.sensor_rows().collect();
        Ok(Self {
            params: self.params.clone(),
            instants: kept_rows
                .iter()
                .map(|&row| self.instants[row] - first_instant)
                .collect(),
            time: self.time.subset(bins.clone(), kept),
            subset: Some(Subset {
                rows: kept_rows.iter().map(|&row| sensor_rows[row]).collect(),
                first_bin: self.first_bin() + bins.start,
            }),
            retiming: self.retiming.as_ref().map(|retiming| Retiming {
                change: retiming.change,
                instants: kept_rows
                    .iter()
                    .map(|&row| retiming.instants[row])
                    .collect(),
            }),
        })
    }

    /// The camera as it sees a scene at rest: its video has one bin, and its frame is that of a video which shows that
    /// bin throughout. It has the parameters of this camera.
    #[must_use]
    pub fn at_rest(&self) -> Self {
        Self {
            params: self.params.clone(),
            instants: vec![0; self.instants.len()],
            time: self.time.at_rest(),
            subset: self.subset.clone(),
            retiming: None,
        }
    }

    /// The camera with another timing and the same bins. Rows are read when they were, but those of the lower half of a dual
    /// shutter by [`TimingChange::half_delay_rows`] later. Light before the first bin is taken to be that of the first, and
    /// light after the last that of the last. A global shutter has no rows to be timed, and is as before.
    ///
    /// # Panics
    /// If it has another timing already, or if the change leaves nothing of the exposure.
    #[must_use]
    pub fn retimed(&self, change: TimingChange) -> Self {
        let before = self.retiming.as_ref().map(|retiming| retiming.change);
        if *self.shutter() == Shutter::Global || change == before.unwrap_or_default() {
            return self.clone();
        }
        assert_eq!(before, None, "retimed already");
        assert!(
            self.exposure_rows() + change.exposure_rows > 0.0,
            "{change:?}"
        );
        let delay = if self.shutter().is_dual() {
            change.half_delay_rows
        } else {
            0.0
        };
        let half = self.params.rows / 2;
        let delay_of = |sensor_row: usize| if sensor_row < half { 0.0 } else { delay };
        // In the order of their times, each instant of a half that is delayed by itself.
        let timed = self.instants.iter().zip(self.sensor_rows());
        let timed: Vec<(usize, f64)> = timed
            .map(|(&instant, row)| (instant, delay_of(row)))
            .collect();
        let mut distinct = timed.clone();
        let time = |&(instant, delay): &(usize, f64)| instant as f64 + delay;
        distinct.sort_by(|a, b| time(a).total_cmp(&time(b)).then(a.0.cmp(&b.0)));
        distinct.dedup();
        let moved: Vec<_> = distinct
            .iter()
            .map(|&(instant, delay)| (instant, [delay - change.exposure_rows, delay]))
            .collect();
        let place = |row| distinct.iter().position(|of| of == row);
        let width = 1.0 / self.params.bins_per_row as f64;
        Self {
            instants: timed
                .iter()
                .map(|row| place(row).expect("all are there"))
                .collect(),
            time: self.time.retimed(width, &moved),
            retiming: Some(Retiming {
                change,
                instants: self.instants.clone(),
            }),
            ..self.clone()
        }
    }

    /// The same camera, whose bin 0 starts at `start_us`: of a plane, by the zero of time of the whole sensor.
    #[must_use]
    pub fn starting_at(self, start_us: f64) -> Self {
        Self {
            time: self.time.starting_at(start_us),
            ..self
        }
    }

    /// Index of this camera's first bin in the whole readout; 0 unless it is a [`Self::subset`].
    pub fn first_bin(&self) -> usize {
        self.subset.as_ref().map_or(0, |subset| subset.first_bin)
    }

    /// The sensor row of each frame row.
    pub fn sensor_rows(&self) -> impl Iterator<Item = usize> {
        let subset = self.subset.as_ref();
        (0..self.rows()).map(move |row| subset.map_or(row, |subset| subset.rows[row]))
    }

    /// Rows of the frame (working grid): all of the sensor, or those of the [`Self::subset`].
    pub fn rows(&self) -> usize {
        self.subset
            .as_ref()
            .map_or(self.params.rows, |subset| subset.rows.len())
    }

    /// Columns of the sensor (working grid).
    pub fn columns(&self) -> usize {
        self.params.columns
    }

    /// Order in which the rows are read.
    pub fn shutter(&self) -> &Shutter {
        &self.params.shutter
    }

    /// Calibration of the sensor's counts.
    pub fn sensor(&self) -> &Sensor {
        &self.params.sensor
    }

    /// Parameters of the whole sensor, also for a [`Self::subset`].
    pub fn params(&self) -> &CameraParams {
        &self.params
    }

    /// The instant `k[r]` at which each frame row is read.
    pub fn instants(&self) -> &[usize] {
        &self.instants
    }

    /// The same without [`Self::retimed`]: the order in which the rows are read.
    pub fn readout_instants(&self) -> &[usize] {
        let retiming = self.retiming.as_ref();
        retiming.map_or(&self.instants, |retiming| &retiming.instants)
    }

    /// Exposure of each row in row times, as given.
    pub fn exposure_rows(&self) -> f64 {
        self.params.exposure_us / self.params.row_time_us
    }

    /// The time axis of the video.
    pub fn time(&self) -> &TimeGrid {
        &self.time
    }

    /// Rows and columns of the field.
    pub fn field(&self) -> (usize, usize) {
        self.params
            .field
            .unwrap_or((self.params.rows, self.params.columns))
    }

    /// Rows and columns `(oy, ox)` by which the field begins before the sensor.
    ///
    /// The field pixel `(y', x')` lies at the sensor position `(y' − oy, x' − ox)`.
    pub fn field_offset(&self) -> (usize, usize) {
        let (rows, columns) = self.field();
        (
            (rows - self.params.rows) / 2,
            (columns - self.params.columns) / 2,
        )
    }

    /// Shape of the video that is reconstructed from one frame.
    pub fn video_shape(&self) -> Shape {
        let (rows, columns) = self.field();
        Shape::new(self.time.bins(), rows, columns)
    }
}

fn check_field(params: &CameraParams) -> Result<()> {
    let Some((rows, columns)) = params.field else {
        return Ok(());
    };
    require(
        rows >= params.rows && columns >= params.columns,
        Parameter::Field,
        format!("{rows}×{columns}"),
        format!(
            "the field is at least as large as the sensor of {}×{}",
            params.rows, params.columns
        ),
        phrase![
            "Leave ",
            Parameter::Field,
            " out to reconstruct what lies on the sensor."
        ],
    )?;
    require(
        rows.max(columns) <= MAX_SIDE,
        Parameter::Field,
        format!("{rows}×{columns}"),
        format!("a side has at most {MAX_SIDE} pixels"),
        "Give the size of the field in pixels of the working grid.",
    )
}

fn check_sensor(sensor: &Sensor) -> Result<()> {
    require(
        (1..=64).contains(&sensor.binning),
        Parameter::Binning,
        sensor.binning,
        "binning is a whole number from 1 to 64",
        "Leave it out for no binning.",
    )?;
    if let Some(bits) = sensor.bit_depth {
        require(
            (1..=32).contains(&bits),
            Parameter::BitDepth,
            bits,
            "a converter has 1 to 32 bits",
            "Typical cameras have 8, 12 or 16.",
        )?;
    }
    let positive = [
        (Parameter::PixelPitchUm, sensor.pixel_pitch_um),
        (Parameter::Magnification, sensor.magnification),
        (
            Parameter::GainElectronsPerCount,
            sensor.gain_electrons_per_count,
        ),
        (Parameter::FullWellCounts, sensor.full_well_counts),
    ];
    for (key, value) in positive {
        if let Some(value) = value {
            let remedy = "Leave the key out where the value is not known.";
            require(
                value.is_finite() && value > 0.0,
                key,
                value,
                "the value is a number above zero",
                remedy,
            )?;
        }
    }
    let non_negative = [
        (Parameter::TriggerDelayUs, sensor.trigger_delay_us),
        (Parameter::BiasCounts, sensor.bias_counts),
        (Parameter::ReadNoiseElectrons, sensor.read_noise_electrons),
    ];
    for (key, value) in non_negative {
        if let Some(value) = value {
            let remedy = "Leave the key out where the value is not known.";
            require(
                value.is_finite() && value >= 0.0,
                key,
                value,
                "the value is zero or more",
                remedy,
            )?;
        }
    }
    Ok(())
}

/// An error of the key unless `holds`.
fn require(
    holds: bool,
    key: Parameter,
    found: impl ToString,
    rule: impl Into<Phrase>,
    remedy: impl Into<Phrase>,
) -> Result<()> {
    if holds {
        Ok(())
    } else {
        Err(Error::input(key, found, rule, remedy))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Halves of which one is later have instants of their own; the order of the readout and the bins stay.
    #[test]
    fn a_retimed_camera_keeps_its_readout() {
        let camera = Camera::new(CameraParams {
            rows: 5,
            columns: 4,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        assert_eq!(camera.instants(), [1, 0, 0, 1, 2]);
        for (half_delay_rows, instants) in [
            (0.25, [2, 0, 1, 3, 4]),
            (-0.25, [3, 1, 0, 2, 4]),
            (1.25, [1, 0, 2, 3, 4]),
        ] {
            let retimed = camera.retimed(TimingChange {
                exposure_rows: 0.0,
                half_delay_rows,
            });
            assert_eq!(retimed.instants(), instants, "{half_delay_rows}");
            assert_eq!(retimed.readout_instants(), camera.instants());
            assert_eq!(retimed.video_shape(), camera.video_shape());
            for instant in instants {
                let weights = &retimed.time().instants()[instant].weights;
                assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            }
            let part = retimed.within(1..3).unwrap();
            let rows: Vec<usize> = part.sensor_rows().collect();
            let readout: Vec<usize> = rows.iter().map(|&row| camera.instants()[row]).collect();
            assert_eq!(part.readout_instants(), readout);
        }
    }
}
