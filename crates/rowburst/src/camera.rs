//! The camera: which rows it reads when, and what its numbers mean.

use crate::{Error, Result, Shape, Shutter, TimeGrid};
use std::ops::Range;

/// A rolling-shutter camera and the field that it is asked to reconstruct.
///
/// Fields are read through methods; [`Camera::new`] has checked them.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    params: CameraParams,
    instants: Vec<usize>,
    time: TimeGrid,
    /// What a part of the readout reads of the sensor; `None`: every row.
    cut: Option<Cut>,
}

#[derive(Debug, Clone, PartialEq)]
struct Cut {
    rows: Vec<usize>,
    first_bin: usize,
}

/// What a [`Camera`] is made from: the experiment file's `[camera]` and `[field]`.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraParams {
    /// Rows of the working grid (after binning).
    pub rows: usize,
    /// Columns of the working grid (after binning).
    pub columns: usize,
    /// Readout order.
    pub shutter: Shutter,
    /// Time from one instant to the next, in microseconds.
    pub row_time_us: f64,
    /// Exposure of each row, in microseconds.
    pub exposure_us: f64,
    /// Time bins in each row time.
    pub bins_per_row: usize,
    /// Rows and columns of the field; `None` for those of the sensor.
    pub field: Option<(usize, usize)>,
    /// What a count means.
    pub sensor: Sensor,
}

/// What the sensor's numbers mean. Everything is optional but the binning.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensor {
    /// Raw pixels along a side of one pixel of the working grid.
    pub binning: usize,
    /// Pitch of a pixel of the working grid, in micrometres.
    pub pixel_pitch_um: Option<f64>,
    /// Bits of the analogue-to-digital converter; counts end at `2^bits − 1`.
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

impl Default for Sensor {
    fn default() -> Self {
        Self {
            binning: 1,
            pixel_pitch_um: None,
            bit_depth: None,
            bias_counts: None,
            gain_electrons_per_count: None,
            read_noise_electrons: None,
            full_well_counts: None,
        }
    }
}

impl Sensor {
    /// Counts at and above which a raw pixel holds no information: the full well or
    /// the converter's end, whichever is lower; `None` where neither is known.
    pub fn saturation_counts(&self) -> Option<f64> {
        let converter = self.bit_depth.map(|bits| f64::from(bits).exp2() - 1.0);
        match (self.full_well_counts, converter) {
            (Some(well), Some(end)) => Some(well.min(end)),
            (well, end) => well.or(end),
        }
    }
}

/// Longest side of a sensor or a field: twice that of the largest sensors, and short
/// enough that a table of its pixels can be made.
pub const MAX_SENSOR_SIDE: usize = 65_536;

impl Camera {
    /// Checks `params` and works out the time grid.
    ///
    /// # Errors
    /// Names the key, the value and the rule that it breaks.
    pub fn new(params: CameraParams) -> Result<Self> {
        for (key, value) in [("rows", params.rows), ("columns", params.columns)] {
            require(
                (1..=MAX_SENSOR_SIDE).contains(&value),
                key,
                value,
                format!("a sensor has at least one and at most {MAX_SENSOR_SIDE}"),
                "Give the size of the frame in pixels.",
            )?;
        }
        for (key, value) in [
            ("row_time_us", params.row_time_us),
            ("exposure_us", params.exposure_us),
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
            "bins_per_row",
            params.bins_per_row,
            "an instant is divided into 1 to 64 bins",
            "Leave it out for one bin a row.",
        )?;
        if let Some((rows, columns)) = params.field {
            require(
                rows >= params.rows && columns >= params.columns,
                "[field]",
                format!("{rows}×{columns}"),
                format!(
                    "the field is at least as large as the sensor of {}×{}",
                    params.rows, params.columns
                ),
                "Leave [field] out to reconstruct what lies on the sensor.",
            )?;
        }
        if let Some((rows, columns)) = params.field {
            require(
                rows.max(columns) <= MAX_SENSOR_SIDE,
                "[field]",
                format!("{rows}×{columns}"),
                format!("a side has at most {MAX_SENSOR_SIDE} pixels"),
                "Give the size of the field in pixels of the working grid.",
            )?;
        }
        check_sensor(&params.sensor)?;
        let instants = params.shutter.instants(params.rows)?;
        let time = match params.shutter {
            Shutter::Global => TimeGrid::single(params.exposure_us),
            _ => {
                let count = instants.iter().max().map_or(1, |last| last + 1);
                let exposure = params.exposure_us / params.row_time_us;
                require(
                    exposure <= 10.0 * count as f64,
                    "exposure_us",
                    params.exposure_us,
                    format!(
                        "an exposure of {exposure:.0} row times is more than ten times the readout of {count}: every row sees the same light"
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
            cut: None,
        })
    }

    /// The camera that reads only what sees the light of `bins`: its frame has only those rows, one
    /// after another, its video only those bins, and the field is the same. Where no row sees bins
    /// inside and outside (an exposure of at most a row), `A` of the whole readout is made of the `A`
    /// of its parts, so a video can be found part by part.
    ///
    /// # Errors
    /// Bins that are not there, and rows whose exposure reaches beyond them.
    pub fn subset(&self, bins: Range<usize>) -> Result<Self> {
        require(
            bins.start < bins.end && bins.end <= self.time.bins(),
            "bins",
            format!("{}..{}", bins.start, bins.end),
            format!("a range of the bins 0..{}", self.time.bins()),
            "Give the first bin and the one after the last, FIRST..END.",
        )?;
        let mut kept = Vec::new();
        for (i, run) in self.time.instants().iter().enumerate() {
            let sees = run.first_bin..run.first_bin + run.weights.len();
            if bins.start <= sees.start && sees.end <= bins.end {
                kept.push(i);
            } else {
                require(
                    sees.end <= bins.start || bins.end <= sees.start,
                    "bins",
                    format!("{}..{}", bins.start, bins.end),
                    format!(
                        "rows are exposed to bins {}..{}, inside and outside",
                        sees.start, sees.end
                    ),
                    "A video can be made in parts where no exposure is longer than a row; with sub-row bins the parts begin at a row.",
                )?;
            }
        }
        let first_instant = kept.first().copied().unwrap_or(0);
        let reads = |row: &usize| kept.contains(&self.instants[*row]);
        let places: Vec<usize> = (0..self.rows()).filter(reads).collect();
        require(
            !places.is_empty(),
            "bins",
            format!("{}..{}", bins.start, bins.end),
            "some row reads the bins",
            "Give a wider range.",
        )?;
        let sensor_rows: Vec<usize> = self.sensor_rows().collect();
        Ok(Self {
            params: self.params.clone(),
            instants: places
                .iter()
                .map(|&place| self.instants[place] - first_instant)
                .collect(),
            time: self.time.subset(bins.clone(), kept),
            cut: Some(Cut {
                rows: places.iter().map(|&place| sensor_rows[place]).collect(),
                first_bin: self.first_bin() + bins.start,
            }),
        })
    }

    /// The bin of the whole readout at which this part of it begins.
    pub fn first_bin(&self) -> usize {
        self.cut.as_ref().map_or(0, |cut| cut.first_bin)
    }

    /// The row of the sensor that each row of the frame is.
    pub fn sensor_rows(&self) -> impl Iterator<Item = usize> {
        let cut = self.cut.as_ref();
        (0..self.rows()).map(move |place| cut.map_or(place, |cut| cut.rows[place]))
    }

    /// Rows of the frame (working grid): those of the sensor, or of the part that is read.
    pub fn rows(&self) -> usize {
        self.cut
            .as_ref()
            .map_or(self.params.rows, |cut| cut.rows.len())
    }

    /// Columns of the sensor (working grid).
    pub fn columns(&self) -> usize {
        self.params.columns
    }

    /// Readout order.
    pub fn shutter(&self) -> &Shutter {
        &self.params.shutter
    }

    /// What its numbers mean.
    pub fn sensor(&self) -> &Sensor {
        &self.params.sensor
    }

    /// What it was made from.
    pub fn params(&self) -> &CameraParams {
        &self.params
    }

    /// The instant `k[r]` at which each row is read.
    pub fn instants(&self) -> &[usize] {
        &self.instants
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

    /// Rows and columns by which the field begins before the sensor:
    /// field pixel `(y', x')` lies at sensor position `(y' − oy, x' − ox)`.
    pub fn field_offset(&self) -> (usize, usize) {
        let (rows, columns) = self.field();
        (
            (rows - self.params.rows) / 2,
            (columns - self.params.columns) / 2,
        )
    }

    /// Shape of the video that one frame gives.
    pub fn video_shape(&self) -> Shape {
        let (rows, columns) = self.field();
        Shape::new(self.time.bins(), rows, columns)
    }
}

fn check_sensor(sensor: &Sensor) -> Result<()> {
    require(
        (1..=64).contains(&sensor.binning),
        "binning",
        sensor.binning,
        "binning is a whole number from 1 to 64",
        "Leave it out for no binning.",
    )?;
    if let Some(bits) = sensor.bit_depth {
        require(
            (1..=32).contains(&bits),
            "bit_depth",
            bits,
            "a converter has 1 to 32 bits",
            "Typical cameras have 8, 12 or 16.",
        )?;
    }
    let positive = [
        ("pixel_pitch_um", sensor.pixel_pitch_um),
        ("gain_electrons_per_count", sensor.gain_electrons_per_count),
        ("full_well_counts", sensor.full_well_counts),
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
        ("bias_counts", sensor.bias_counts),
        ("read_noise_electrons", sensor.read_noise_electrons),
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

fn require(
    holds: bool,
    key: &str,
    found: impl ToString,
    rule: impl Into<String>,
    remedy: impl Into<String>,
) -> Result<()> {
    if holds {
        Ok(())
    } else {
        Err(Error::input(key, found, rule, remedy))
    }
}
