//! Properties of a camera, as its driver names them, into the keys of the experiment file.
//!
//! One table for Andor SDK3, PCO, Hamamatsu DCAM, PVCAM and GenICam, under the names of the driver and of its
//! Micro-Manager adapter. Micro-Manager's metadata, recordings of `rowburst capture` and the Python package
//! use it. Units: SDK3 and DCAM give seconds, PCO's adapter microseconds, PVCAM nanoseconds, GenICam microseconds.

use super::{Metadata, binning_of, bits_of, positive};
use rowburst::Shutter;

/// How a value is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// The camera or the file says it.
    Read,
    /// It follows from other values.
    Calculated,
    /// Nothing says it.
    Unknown,
}

impl Origin {
    /// All, with their names.
    const NAMES: [(Self, &'static str); 3] = [
        (Self::Read, "read"),
        (Self::Calculated, "calculated"),
        (Self::Unknown, "unknown"),
    ];

    /// Its name in files.
    pub fn name(self) -> &'static str {
        let found = Self::NAMES.iter().find(|(origin, _)| *origin == self);
        found.map_or("unknown", |(_, name)| name)
    }

    /// The origin of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        let found = Self::NAMES.iter().find(|(_, known)| *known == name);
        found.map(|(origin, _)| *origin)
    }
}

/// Where a value of the experiment file comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Provenance {
    /// Key of the experiment file.
    pub key: &'static str,
    /// How it is known.
    pub origin: Origin,
    /// The property and its value, such as `RowReadTime = 9.24e-06`.
    pub from: String,
}

/// A finding about the settings of a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// Its name as data, such as `global-shutter`.
    pub name: &'static str,
    /// Whether a frame with it is of no use.
    pub is_fatal: bool,
    /// What was found.
    pub text: String,
    /// What to do about it.
    pub remedy: String,
}

/// What the properties of a camera say.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraReading {
    /// The values.
    pub metadata: Metadata,
    /// Where each value comes from.
    pub provenance: Vec<Provenance>,
    /// What makes the frames useless or doubtful.
    pub findings: Vec<Finding>,
    /// Rows of the whole sensor.
    pub sensor_rows: Option<usize>,
}

/// The drivers whose properties are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Driver {
    /// Keys of the experiment file themselves.
    Plain,
    MicroManager,
    /// Micro-Manager's rotation of the picture, which acts where [`TRANSPOSE_CONTROL`] is on.
    Transposed,
    AndorSdk3,
    Pco,
    Dcam,
    Pvcam,
    GenICam,
}

/// What a property gives, with its factor to the unit of the key.
#[derive(Debug, Clone, Copy)]
enum Gives {
    RowTimeUs(f64, Origin),
    /// DCAM: seconds; its Micro-Manager adapter: milliseconds.
    DcamRowTime,
    /// Lines per second, where [`SCAN_SPEED_CONTROL`] is on.
    LinesPerSecond,
    ExposureUs(f64),
    FramePeriodUs(f64),
    FramesPerSecond,
    Readout(&'static [(&'static str, Option<&'static str>)]),
    ShutterName,
    ShutterMode,
    /// DCAM: how the sensor is read.
    SensorMode,
    Rows,
    Columns,
    /// First row, counted from this number.
    Top(usize),
    /// First column, counted from this number.
    Left(usize),
    Binning,
    BinningY,
    BinningX,
    BitDepth,
    /// A name that ends in the number of bits, such as `Mono12`.
    PixelFormat,
    PitchUm(f64),
    SensorRows,
    Alternates,
    Swaps,
    MirrorsRows,
    MirrorsColumns,
}

const SDK3_READOUT: &[(&str, Option<&str>)] = &[
    ("Centre Out Simultaneous", Some("dual-inside-out")),
    ("Outside In Simultaneous", Some("dual-outside-in")),
    ("Top Down Sequential", Some("top-down")),
    ("Bottom Up Sequential", Some("bottom-up")),
];
/// `get_interface_output_format`: the rows in the order in which they are read.
const PCO_READOUT: &[(&str, Option<&str>)] = &[
    ("top bottom", Some("top-down")),
    ("center top center bottom", Some("dual-inside-out")),
    ("top center bottom center", Some("dual-outside-in")),
];
const DCAM_READOUT: &[(&str, Option<&str>)] = &[
    ("FORWARD", Some("top-down")),
    ("BACKWARD", Some("bottom-up")),
    ("DIVERGE", Some("dual-inside-out")),
    // The direction then depends on the trigger.
    ("BYTRIGGER", None),
];
const PVCAM_READOUT: &[(&str, Option<&str>)] = &[
    ("Down", Some("top-down")),
    ("Up", Some("bottom-up")),
    // The direction changes from frame to frame.
    ("Down/Up Alternate", None),
];

/// Every property that is known, the more certain one of two first.
const TABLE: &[(Driver, &str, Gives)] = &[
    (Driver::Plain, "rows", Gives::Rows),
    (Driver::Plain, "columns", Gives::Columns),
    (Driver::Plain, "shutter", Gives::ShutterName),
    (
        Driver::Plain,
        "row_time_us",
        Gives::RowTimeUs(1.0, Origin::Read),
    ),
    (Driver::Plain, "exposure_us", Gives::ExposureUs(1.0)),
    (Driver::Plain, "frame_period_us", Gives::FramePeriodUs(1.0)),
    (Driver::Plain, "binning", Gives::Binning),
    (Driver::Plain, "bit_depth", Gives::BitDepth),
    (Driver::Plain, "pixel_pitch_um", Gives::PitchUm(1.0)),
    (Driver::Plain, "top", Gives::Top(0)),
    (Driver::Plain, "left", Gives::Left(0)),
    (Driver::Plain, "sensor_rows", Gives::SensorRows),
    (
        Driver::AndorSdk3,
        "RowReadTime",
        Gives::RowTimeUs(1e6, Origin::Read),
    ),
    (
        Driver::AndorSdk3,
        "LightScanPlus-LineScanSpeed [lines/sec]",
        Gives::LinesPerSecond,
    ),
    (
        Driver::AndorSdk3,
        "LightScanPlus-LineScanSpeed",
        Gives::LinesPerSecond,
    ),
    (Driver::AndorSdk3, "LineScanSpeed", Gives::LinesPerSecond),
    (
        Driver::AndorSdk3,
        "LightScanPlus-SensorReadoutMode",
        Gives::Readout(SDK3_READOUT),
    ),
    (
        Driver::AndorSdk3,
        "SensorReadoutMode",
        Gives::Readout(SDK3_READOUT),
    ),
    (
        Driver::AndorSdk3,
        "LightScanPlus-AlternatingReadoutDirection",
        Gives::Alternates,
    ),
    (
        Driver::AndorSdk3,
        "AlternatingReadoutDirection",
        Gives::Alternates,
    ),
    (
        Driver::AndorSdk3,
        "ElectronicShutteringMode",
        Gives::ShutterMode,
    ),
    (Driver::AndorSdk3, "ExposureTime", Gives::ExposureUs(1e6)),
    (Driver::AndorSdk3, "FrameRate", Gives::FramesPerSecond),
    (Driver::AndorSdk3, "AOIHeight", Gives::Rows),
    (Driver::AndorSdk3, "AOIWidth", Gives::Columns),
    (Driver::AndorSdk3, "AOITop", Gives::Top(1)),
    (Driver::AndorSdk3, "AOILeft", Gives::Left(1)),
    (Driver::AndorSdk3, "AOIVBin", Gives::BinningY),
    (Driver::AndorSdk3, "AOIHBin", Gives::BinningX),
    (Driver::AndorSdk3, "SensorHeight", Gives::SensorRows),
    // The adapter computes it from the clock and the model.
    (
        Driver::Pco,
        "Line Time [us]",
        Gives::RowTimeUs(1.0, Origin::Calculated),
    ),
    // Of `sdk.get_cmos_line_timing()`, in seconds.
    (
        Driver::Pco,
        "line time",
        Gives::RowTimeUs(1e6, Origin::Read),
    ),
    (
        Driver::Pco,
        "interface output format",
        Gives::Readout(PCO_READOUT),
    ),
    (Driver::Dcam, "INTERNAL LINE INTERVAL", Gives::DcamRowTime),
    (
        Driver::Dcam,
        "READOUT DIRECTION",
        Gives::Readout(DCAM_READOUT),
    ),
    (Driver::Dcam, "SENSOR MODE", Gives::SensorMode),
    (Driver::Dcam, "SHUTTER MODE", Gives::ShutterMode),
    (Driver::Dcam, "EXPOSURE TIME", Gives::ExposureUs(1e6)),
    (Driver::Dcam, "SUBARRAY VSIZE", Gives::Rows),
    (Driver::Dcam, "SUBARRAY HSIZE", Gives::Columns),
    (Driver::Dcam, "SUBARRAY VPOS", Gives::Top(0)),
    (Driver::Dcam, "SUBARRAY HPOS", Gives::Left(0)),
    (
        Driver::Pvcam,
        "ScanLineTime",
        Gives::RowTimeUs(1e-3, Origin::Read),
    ),
    (
        Driver::Pvcam,
        "ScanDirection",
        Gives::Readout(PVCAM_READOUT),
    ),
    (Driver::Pvcam, "Y-dimension", Gives::SensorRows),
    (Driver::GenICam, "SensorShutterMode", Gives::ShutterMode),
    (Driver::GenICam, "ExposureTime", Gives::ExposureUs(1.0)),
    (Driver::GenICam, "ExposureTimeAbs", Gives::ExposureUs(1.0)),
    (
        Driver::GenICam,
        "AcquisitionFrameRate",
        Gives::FramesPerSecond,
    ),
    (Driver::GenICam, "Height", Gives::Rows),
    (Driver::GenICam, "Width", Gives::Columns),
    (Driver::GenICam, "OffsetY", Gives::Top(0)),
    (Driver::GenICam, "OffsetX", Gives::Left(0)),
    (Driver::GenICam, "BinningVertical", Gives::BinningY),
    (Driver::GenICam, "BinningHorizontal", Gives::BinningX),
    (Driver::GenICam, "PixelFormat", Gives::PixelFormat),
    (Driver::GenICam, "SensorHeight", Gives::SensorRows),
    (Driver::GenICam, "ReverseY", Gives::MirrorsRows),
    (Driver::GenICam, "ReverseX", Gives::MirrorsColumns),
    (Driver::MicroManager, "Exposure", Gives::ExposureUs(1e3)),
    (Driver::MicroManager, "Binning", Gives::Binning),
    (Driver::MicroManager, "BitDepth", Gives::BitDepth),
    (Driver::MicroManager, "OnCameraCCDYSize", Gives::SensorRows),
    (Driver::Transposed, "TransposeXY", Gives::Swaps),
    (Driver::Transposed, "TransposeMirrorY", Gives::MirrorsRows),
    (
        Driver::Transposed,
        "TransposeMirrorX",
        Gives::MirrorsColumns,
    ),
    (Driver::Transposed, "Transpose_SwapXY", Gives::Swaps),
    (Driver::Transposed, "Transpose_MirrorY", Gives::MirrorsRows),
    (
        Driver::Transposed,
        "Transpose_MirrorX",
        Gives::MirrorsColumns,
    ),
];

/// What makes Micro-Manager's rotation and mirrors act. A file that does not name it may have been rotated.
const TRANSPOSE_CONTROL: &str = "TransposeCorrection";

/// What makes SDK3's line scan speed the row time.
const SCAN_SPEED_CONTROL: [&str; 2] = [
    "LightScanPlus-ScanSpeedControlEnable",
    "ScanSpeedControlEnable",
];

/// SDK3 and GenICam share names, of which the units differ: properties that only one of them has.
const SDK3_ALONE: [&str; 5] = [
    "RowReadTime",
    "SensorReadoutMode",
    "LightScanPlus-SensorReadoutMode",
    "ElectronicShutteringMode",
    "AOIHeight",
];

/// Smallest number that is a row time in milliseconds rather than in seconds: no sensor reads a row in less than a
/// microsecond.
const MIN_MILLISECONDS: f64 = 1e-3;

/// Reads the properties of a camera by the table. `property` gives the value of a name.
pub fn read_properties(property: &dyn Fn(&str) -> Option<String>) -> CameraReading {
    let is_sdk3 = SDK3_ALONE.iter().any(|name| property(name).is_some());
    let is_transposed = property(TRANSPOSE_CONTROL).is_none_or(|value| is_on(value.trim()));
    let mut reader = Reader {
        property,
        reading: CameraReading::default(),
        sides: (None, None),
        origin: (None, None),
        rows: None,
        columns: None,
    };
    for (driver, name, gives) in TABLE {
        let is_other = match driver {
            Driver::AndorSdk3 => !is_sdk3,
            Driver::GenICam => is_sdk3,
            Driver::Transposed => !is_transposed,
            _ => false,
        };
        if is_other {
            continue;
        }
        if let Some(value) = property(name) {
            reader.take(name, value.trim(), *gives);
        }
    }
    reader.finish()
}

struct Reader<'a> {
    property: &'a dyn Fn(&str) -> Option<String>,
    reading: CameraReading,
    /// Binning along y and x.
    sides: (Option<usize>, Option<usize>),
    origin: (Option<usize>, Option<usize>),
    rows: Option<usize>,
    columns: Option<usize>,
}

impl Reader<'_> {
    fn take(&mut self, name: &str, value: &str, gives: Gives) {
        let number = value.parse::<f64>().ok();
        match gives {
            Gives::RowTimeUs(factor, origin) => {
                self.row_time(number.map(|n| n * factor), origin, name, value);
            }
            Gives::DcamRowTime => {
                let factor = |n: f64| if n < MIN_MILLISECONDS { 1e6 } else { 1e3 };
                let time = number.map(|n| n * factor(n));
                self.row_time(time, Origin::Read, name, value);
            }
            Gives::LinesPerSecond => {
                let lines = number.filter(|_| self.controls_scan_speed());
                self.row_time(lines.map(|n| 1e6 / n), Origin::Calculated, name, value);
            }
            Gives::ExposureUs(factor) => {
                let time = number.and_then(|n| positive(n * factor));
                let CameraReading {
                    metadata,
                    provenance,
                    ..
                } = &mut self.reading;
                let slot = &mut metadata.exposure_us;
                note(
                    provenance,
                    slot,
                    time,
                    "exposure_us",
                    Origin::Read,
                    name,
                    value,
                );
            }
            Gives::FramePeriodUs(factor) => {
                self.frame_period(number.map(|n| n * factor), Origin::Read, name, value);
            }
            Gives::FramesPerSecond => {
                self.frame_period(number.map(|n| 1e6 / n), Origin::Calculated, name, value);
            }
            Gives::BitDepth => self.bit_depth(number.and_then(bits_of), name, value),
            Gives::PixelFormat => self.pixel_format(name, value),
            Gives::PitchUm(factor) => self.pitch(number.map(|n| n * factor), name, value),
            Gives::Readout(names) => self.readout(names, name, value),
            Gives::ShutterName => self.shutter(Shutter::from_name(value), name, value),
            Gives::ShutterMode if value.to_ascii_lowercase().starts_with("global") => {
                self.global(name, value);
            }
            Gives::ShutterMode => {}
            Gives::SensorMode => self.sensor_mode(name, value),
            Gives::Alternates | Gives::Swaps | Gives::MirrorsRows | Gives::MirrorsColumns => {
                if is_on(value) {
                    self.orientation(gives, name, value);
                }
            }
            _ => self.region(number, name, value, gives),
        }
    }

    /// Size, place and binning of the region.
    fn region(&mut self, number: Option<f64>, name: &str, value: &str, gives: Gives) {
        let count = number.filter(|n| n.fract() == 0.0 && *n >= 0.0);
        let count = count.map(|n| n as usize);
        let from = |first: usize| count.and_then(|n| n.checked_sub(first));
        let provenance = &mut self.reading.provenance;
        match gives {
            Gives::Rows => note(
                provenance,
                &mut self.rows,
                count,
                "rows",
                Origin::Read,
                name,
                value,
            ),
            Gives::Columns => {
                note(
                    provenance,
                    &mut self.columns,
                    count,
                    "columns",
                    Origin::Read,
                    name,
                    value,
                );
            }
            Gives::Top(first) => self.origin.0 = self.origin.0.or_else(|| from(first)),
            Gives::Left(first) => self.origin.1 = self.origin.1.or_else(|| from(first)),
            Gives::BinningY => self.sides.0 = self.sides.0.or(count),
            Gives::BinningX => self.sides.1 = self.sides.1.or(count),
            Gives::SensorRows => self.reading.sensor_rows = self.reading.sensor_rows.or(count),
            _ => self.binning(name, value),
        }
    }

    fn pitch(&mut self, pitch: Option<f64>, name: &str, value: &str) {
        let slot = &mut self.reading.metadata.pixel_pitch_um;
        let pitch = pitch.and_then(positive);
        note(
            &mut self.reading.provenance,
            slot,
            pitch,
            "pixel_pitch_um",
            Origin::Read,
            name,
            value,
        );
    }

    fn controls_scan_speed(&self) -> bool {
        let mut values = SCAN_SPEED_CONTROL.iter().filter_map(|n| (self.property)(n));
        values.any(|value| is_on(&value))
    }

    fn row_time(&mut self, time_us: Option<f64>, origin: Origin, name: &str, value: &str) {
        let slot = &mut self.reading.metadata.row_time_us;
        let time_us = time_us.and_then(positive);
        note(
            &mut self.reading.provenance,
            slot,
            time_us,
            "row_time_us",
            origin,
            name,
            value,
        );
    }

    fn frame_period(&mut self, period: Option<f64>, origin: Origin, name: &str, value: &str) {
        let slot = &mut self.reading.metadata.frame_period_us;
        let period = period.and_then(positive);
        note(
            &mut self.reading.provenance,
            slot,
            period,
            "frame_period_us",
            origin,
            name,
            value,
        );
    }

    fn bit_depth(&mut self, bits: Option<u32>, name: &str, value: &str) {
        let slot = &mut self.reading.metadata.bit_depth;
        note(
            &mut self.reading.provenance,
            slot,
            bits,
            "bit_depth",
            Origin::Read,
            name,
            value,
        );
    }

    /// `Mono8`, `Mono12`, `Mono12Packed`, `Mono16`; 16 bits are those of the container alone.
    fn pixel_format(&mut self, name: &str, value: &str) {
        let digits = value.strip_prefix("Mono").unwrap_or_default();
        let digits: String = digits.chars().take_while(char::is_ascii_digit).collect();
        let bits = digits.parse().ok().filter(|bits| (1..16).contains(bits));
        self.bit_depth(bits, name, value);
    }

    fn shutter(&mut self, shutter: Option<Shutter>, name: &str, value: &str) {
        if shutter == Some(Shutter::Global) {
            self.global(name, value);
            return;
        }
        let slot = &mut self.reading.metadata.shutter;
        note(
            &mut self.reading.provenance,
            slot,
            shutter,
            "shutter",
            Origin::Read,
            name,
            value,
        );
    }

    fn readout(&mut self, names: &[(&str, Option<&str>)], name: &str, value: &str) {
        let wanted = plain_letters(value);
        let found = names
            .iter()
            .find(|(known, _)| plain_letters(known) == wanted);
        match found {
            Some((_, Some(shutter))) => self.shutter(Shutter::from_name(shutter), name, value),
            Some((_, None)) => self.orientation(Gives::Alternates, name, value),
            None => self.reading.metadata.notes.push(format!(
                "{name} is \"{value}\", a readout order that has no name here: give shutter = \"custom\" with row_order"
            )),
        }
    }

    /// `AREA` and `PROGRESSIVE` read rows one after the other; other modes do not.
    fn sensor_mode(&mut self, name: &str, value: &str) {
        let mode = value.to_ascii_uppercase();
        let found = format!("the sensor is not read as one picture ({name} = {value})");
        let remedy = "Set SENSOR MODE to AREA or PROGRESSIVE.";
        if mode.contains("LINE") || mode.contains("TDI") {
            self.find("no-area", true, found, remedy);
        } else if mode.contains("SPLIT") || mode.contains("DUAL") {
            self.find(
                "split",
                false,
                format!("the sensor is read in two parts ({name} = {value})"),
                "Set SENSOR MODE to AREA or PROGRESSIVE, or give shutter = \"custom\" with row_order.",
            );
        }
    }

    fn global(&mut self, name: &str, value: &str) {
        self.reading.metadata.shutter = Some(Shutter::Global);
        let provenance = &mut self.reading.provenance;
        provenance.retain(|known| known.key != "shutter");
        provenance.push(Provenance {
            key: "shutter",
            origin: Origin::Read,
            from: format!("{name} = {value}"),
        });
        self.find(
            "global-shutter",
            true,
            format!("the shutter is global ({name} = {value}): all rows are exposed together, and the frame holds no time"),
            "Set the camera's rolling shutter.",
        );
    }

    fn binning(&mut self, name: &str, value: &str) {
        let sides: Vec<&str> = value.split(['x', 'X', '×']).map(str::trim).collect();
        if let [y, x] = sides[..]
            && y != x
        {
            self.uneven(&format!("{name} = {value}"));
            return;
        }
        let slot = &mut self.reading.metadata.binning;
        note(
            &mut self.reading.provenance,
            slot,
            binning_of(value),
            "binning",
            Origin::Read,
            name,
            value,
        );
    }

    fn uneven(&mut self, found: &str) {
        self.find(
            "uneven-binning",
            true,
            format!("the camera bins rows and columns differently ({found})"),
            "Set the same binning along both axes, best 1x1.",
        );
    }

    fn orientation(&mut self, gives: Gives, name: &str, value: &str) {
        let found = format!("{name} = {value}");
        match gives {
            Gives::Swaps => self.find(
                "rotated",
                true,
                format!("the driver exchanges rows and columns ({found}): y is then not the axis that the shutter scans"),
                "Turn the rotation of the picture off.",
            ),
            Gives::Alternates => self.find(
                "alternating",
                true,
                format!("the readout direction changes from frame to frame ({found})"),
                "Turn the alternation off, so that every frame is read in one order.",
            ),
            Gives::MirrorsRows => self.find(
                "mirrored-rows",
                true,
                format!("the driver turns the picture upside down ({found}): the readout order of the settings is then wrong"),
                "Turn the mirroring of the picture off.",
            ),
            _ => self.find(
                "mirrored-columns",
                false,
                format!("the driver mirrors the picture left to right ({found})"),
                "Turn it off, or keep it for the PSF and every frame alike.",
            ),
        }
    }

    fn find(&mut self, name: &'static str, is_fatal: bool, text: String, remedy: &str) {
        self.reading.findings.push(Finding {
            name,
            is_fatal,
            text,
            remedy: remedy.into(),
        });
    }

    fn finish(mut self) -> CameraReading {
        if let (Some(y), Some(x)) = self.sides {
            if y == x {
                let from = format!("binning {y}x{x}");
                let slot = &mut self.reading.metadata.binning;
                note(
                    &mut self.reading.provenance,
                    slot,
                    Some(y),
                    "binning",
                    Origin::Read,
                    &from,
                    &y.to_string(),
                );
            } else {
                self.uneven(&format!("{y} rows, {x} columns"));
            }
        }
        self.reading.metadata.size = self.rows.zip(self.columns);
        self.reading.metadata.origin = self.origin.0.zip(self.origin.1);
        self.check_centre();
        self.reading
    }

    /// The halves of a dual shutter meet at the middle of the sensor.
    fn check_centre(&mut self) {
        let is_dual = matches!(
            self.reading.metadata.shutter,
            Some(Shutter::DualInsideOut | Shutter::DualOutsideIn)
        );
        if !is_dual {
            return;
        }
        let binning = self.reading.metadata.binning.unwrap_or(1);
        let (Some(sensor), Some(top), Some(rows)) =
            (self.reading.sensor_rows, self.origin.0, self.rows)
        else {
            self.warn_of_unknown_centre();
            return;
        };
        let below = sensor.saturating_sub(top + rows * binning);
        if top.abs_diff(below) > 1 {
            self.find(
                "off-centre",
                true,
                format!("the region begins {top} rows from the sensor's top and ends {below} from its bottom, but the halves of the shutter meet in the middle"),
                "Centre the region vertically.",
            );
        }
    }

    /// A driver that names the shutter but not the sensor's height. Who names the shutter himself knows his region.
    fn warn_of_unknown_centre(&mut self) {
        let mut known = self.reading.provenance.iter();
        let of_driver = known.any(|p| p.key == "shutter" && !p.from.starts_with("shutter = "));
        if of_driver {
            self.find(
                "centre-unknown",
                false,
                "it is not known whether the region is centred, since the height of the sensor or the place of the region is not: the halves of the shutter meet in the middle of the sensor".into(),
                "Centre the region vertically, or use the whole sensor.",
            );
        }
    }
}

/// How the value of the property `name` is known, where a driver gives it.
pub fn origin_of_property(name: &str) -> Origin {
    let known = TABLE.iter().find(|(_, known, _)| *known == name);
    match known {
        Some((_, _, Gives::RowTimeUs(_, origin))) => *origin,
        _ => Origin::Read,
    }
}

/// Puts a value where none is yet, with where it comes from.
fn note<T>(
    provenance: &mut Vec<Provenance>,
    slot: &mut Option<T>,
    value: Option<T>,
    key: &'static str,
    origin: Origin,
    name: &str,
    text: &str,
) {
    if slot.is_some() || value.is_none() {
        return;
    }
    *slot = value;
    provenance.push(Provenance {
        key,
        origin,
        from: format!("{name} = {text}"),
    });
}

fn is_on(value: &str) -> bool {
    matches!(
        value.to_ascii_lowercase().as_str(),
        "on" | "1" | "true" | "yes"
    )
}

/// Letters and digits of a name, lower case, without PCO's prefix.
fn plain_letters(text: &str) -> String {
    let text = text.strip_prefix("SCCMOS_FORMAT_").unwrap_or(text);
    let letters = text.chars().filter(|c| c.is_alphanumeric());
    letters.flat_map(char::to_lowercase).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(pairs: &[(&str, &str)]) -> CameraReading {
        read_properties(&|name| {
            let found = pairs.iter().find(|(n, _)| *n == name);
            found.map(|(_, value)| (*value).to_string())
        })
    }

    fn names(reading: &CameraReading) -> Vec<&str> {
        reading.findings.iter().map(|f| f.name).collect()
    }

    #[test]
    fn row_times_have_the_unit_of_their_driver() {
        let cases: [(&[(&str, &str)], f64); 7] = [
            (&[("RowReadTime", "9.24e-06")], 9.24),
            (
                &[
                    ("LightScanPlus-LineScanSpeed [lines/sec]", "100000"),
                    ("LightScanPlus-ScanSpeedControlEnable", "On"),
                    ("ElectronicShutteringMode", "Rolling"),
                ],
                10.0,
            ),
            (&[("Line Time [us]", "27.77")], 27.77),
            (&[("line time", "2.777e-05")], 27.77),
            (&[("INTERNAL LINE INTERVAL", "9.74436e-06")], 9.74436),
            (&[("INTERNAL LINE INTERVAL", "0.00974436")], 9.74436),
            (&[("ScanLineTime", "10260")], 10.26),
        ];
        for (pairs, wanted) in cases {
            let found = read(pairs).metadata.row_time_us.unwrap();
            assert!((found / wanted - 1.0).abs() < 1e-9, "{pairs:?}: {found}");
        }
        // The speed means nothing where its control is off.
        let off = [("LineScanSpeed", "1e5"), ("RowReadTime", "x")];
        assert_eq!(read(&off).metadata.row_time_us, None);
        assert_eq!(
            read(&[("Line Time [us]", "27.77")]).provenance[0].origin,
            Origin::Calculated
        );
    }

    #[test]
    fn readout_orders_of_each_driver() {
        let cases = [
            (
                "SensorReadoutMode",
                "Centre Out Simultaneous",
                Shutter::DualInsideOut,
            ),
            (
                "interface output format",
                "SCCMOS_FORMAT_TOP_CENTER_BOTTOM_CENTER",
                Shutter::DualOutsideIn,
            ),
            ("READOUT DIRECTION", "BACKWARD", Shutter::BottomUp),
            ("ScanDirection", "Down", Shutter::TopDown),
            ("shutter", "dual-inside-out", Shutter::DualInsideOut),
        ];
        for (name, value, wanted) in cases {
            let found = read(&[(name, value)]);
            assert_eq!(found.metadata.shutter, Some(wanted), "{name}");
            assert!(found.findings.iter().all(|f| f.name == "centre-unknown"));
        }
        let odd = read(&[("SensorReadoutMode", "Centre Out Sequential")]);
        assert!(odd.metadata.shutter.is_none() && odd.metadata.notes[0].contains("row_order"));
    }

    #[test]
    fn seconds_of_sdk3_are_not_microseconds_of_genicam() {
        let sdk3 = read(&[("ExposureTime", "0.001"), ("AOIHeight", "100")]);
        assert_eq!(sdk3.metadata.exposure_us, Some(1000.0));
        let genicam = read(&[("ExposureTime", "1000"), ("PixelFormat", "Mono12Packed")]);
        assert_eq!(genicam.metadata.exposure_us, Some(1000.0));
        assert_eq!(genicam.metadata.bit_depth, Some(12));
        assert_eq!(read(&[("PixelFormat", "Mono16")]).metadata.bit_depth, None);
    }

    #[test]
    fn settings_that_spoil_frames_are_found() {
        let cases: [(&[(&str, &str)], &str); 8] = [
            (
                &[("ElectronicShutteringMode", "Global - 100% Duty Cycle")],
                "global-shutter",
            ),
            (&[("SensorShutterMode", "GlobalReset")], "global-shutter"),
            (&[("ScanDirection", "Down/Up Alternate")], "alternating"),
            (
                &[
                    ("AlternatingReadoutDirection", "1"),
                    ("RowReadTime", "1e-5"),
                ],
                "alternating",
            ),
            (&[("Transpose_SwapXY", "1")], "rotated"),
            (&[("ReverseY", "true")], "mirrored-rows"),
            (&[("Binning", "1x2")], "uneven-binning"),
            (
                &[("BinningVertical", "2"), ("BinningHorizontal", "1")],
                "uneven-binning",
            ),
        ];
        for (pairs, name) in cases {
            let found = read(pairs);
            assert_eq!(names(&found), [name], "{pairs:?}");
            assert!(found.findings[0].is_fatal && !found.findings[0].remedy.is_empty());
        }
        assert!(names(&read(&[("Transpose_MirrorY", "0")])).is_empty());
        // Micro-Manager's names; they act where the correction is on.
        let transposed = |is_on| {
            read(&[
                ("TransposeXY", "1"),
                ("TransposeMirrorY", "1"),
                ("TransposeMirrorX", "0"),
                ("TransposeCorrection", is_on),
            ])
        };
        assert_eq!(names(&transposed("1")), ["rotated", "mirrored-rows"]);
        assert!(names(&transposed("0")).is_empty());
        assert_eq!(names(&read(&[("SENSOR MODE", "TDI")])), ["no-area"]);
        assert_eq!(names(&read(&[("SENSOR MODE", "SPLIT VIEW")])), ["split"]);
        assert!(names(&read(&[("SENSOR MODE", "PROGRESSIVE")])).is_empty());
        let mirrored = read(&[("Transpose_MirrorX", "1")]);
        assert!(!mirrored.findings[0].is_fatal);
    }

    #[test]
    fn the_region_of_a_dual_shutter_is_centred() {
        let region = |top| {
            read(&[
                ("SensorReadoutMode", "Centre Out Simultaneous"),
                ("SensorHeight", "2160"),
                ("AOIHeight", "108"),
                ("AOIWidth", "200"),
                ("AOITop", top),
                ("AOILeft", "1"),
            ])
        };
        let centred = region("1027");
        assert!(centred.findings.is_empty(), "{:?}", centred.findings);
        assert_eq!(centred.metadata.origin, Some((1026, 0)));
        assert_eq!(centred.metadata.size, Some((108, 200)));
        assert_eq!(names(&region("1001")), ["off-centre"]);
        // The sensor's height of Micro-Manager's cameras.
        let micro_manager = |top| {
            read(&[
                ("LightScanPlus-SensorReadoutMode", "Centre Out Simultaneous"),
                ("OnCameraCCDYSize", "512"),
                ("rows", "108"),
                ("columns", "200"),
                ("top", top),
                ("left", "0"),
            ])
        };
        assert!(micro_manager("202").findings.is_empty());
        assert_eq!(names(&micro_manager("0")), ["off-centre"]);
        let unknown = [
            ("SensorReadoutMode", "Centre Out Simultaneous"),
            ("AOIHeight", "108"),
        ];
        assert_eq!(names(&read(&unknown)), ["centre-unknown"]);
        assert!(!read(&unknown).findings[0].is_fatal);
        assert!(read(&[("shutter", "dual-inside-out")]).findings.is_empty());
        assert_eq!(origin_of_property("Line Time [us]"), Origin::Calculated);
        assert_eq!(origin_of_property("RowReadTime"), Origin::Read);
    }
}
