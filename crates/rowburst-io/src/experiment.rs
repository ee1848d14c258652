//! The experiment file: a camera, its calibration, the field and the recipe, in TOML.

mod from_metadata;
mod sections;

pub use from_metadata::FromMetadata;
pub use sections::experiment_schema;

use crate::metadata::Metadata;
use crate::pages::SampleFormat;
use crate::relative::relative_path;
use crate::source::{Colour, Source};
use crate::table::{Table, nearest};
use crate::{fault, npy};
use from_metadata::Filling;
use rowburst::bayer::Bayer;
use rowburst::camera::CameraParams;
use rowburst::reconstruct::Tau;
use rowburst::{Camera, Parameter, Result, Sensor, Shutter, phrase};
use sections::{CALIBRATION, CAMERA, FIELD, GUIDE, RECONSTRUCTION, RECORDING, SECTIONS};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use toml::de::DeTable;

/// What an experiment file says. Paths are those of the file's folder joined with
/// what is written.
#[derive(Debug, Clone, PartialEq)]
pub struct Experiment {
    /// The file that it was read from, for error messages.
    pub path: PathBuf,
    /// The camera and the field: `[camera]` and `[field]`.
    pub params: CameraParams,
    /// The mosaic of a colour sensor whose frames are raw.
    pub bayer: Option<Bayer>,
    /// The file of a custom shutter's order; `None` where the experiment file lists the order itself.
    pub row_order: Option<PathBuf>,
    /// Where the calibration lies.
    pub calibration: Calibration,
    /// How to reconstruct.
    pub reconstruction: Reconstruction,
    /// How frames follow each other.
    pub recording: Recording,
    /// Pictures of the scene by a second camera.
    pub guides: Vec<GuideFile>,
    /// What of all this came from the metadata of a frame.
    pub from_metadata: FromMetadata,
}

/// What `[recording]` says.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Recording {
    /// From the start of a frame to that of the next, in microseconds.
    pub frame_period_us: Option<f64>,
}

/// What a `[[guide]]` says.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GuideFile {
    /// The picture.
    pub image: PathBuf,
    /// Middle of its exposure in microseconds from the start of the frame's first exposure; `None`: unknown.
    pub time_us: Option<f64>,
    /// Its exposure in microseconds.
    pub exposure_us: Option<f64>,
}

/// Files of `[calibration]`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Calibration {
    /// The point-spread function.
    pub psf: Option<PathBuf>,
    /// A frame without light.
    pub dark: Option<PathBuf>,
    /// A frame of even light.
    pub flat: Option<PathBuf>,
    /// A mask: pixels that are not zero are bad.
    pub bad_pixels: Option<PathBuf>,
}

/// What `[reconstruction]` asks for.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reconstruction {
    /// Name of the prior; not checked here.
    pub prior: Option<String>,
    /// Weight of the prior.
    pub tau: Option<Tau>,
}

impl Experiment {
    /// An experiment with nothing but a camera, to be written.
    pub fn new(params: CameraParams) -> Self {
        Self {
            path: "experiment.toml".into(),
            params,
            bayer: None,
            row_order: None,
            calibration: Calibration::default(),
            reconstruction: Reconstruction::default(),
            recording: Recording::default(),
            guides: Vec::new(),
            from_metadata: FromMetadata::default(),
        }
    }

    /// Reads an experiment file that stands alone; see [`Experiment::read_with`].
    ///
    /// # Errors
    /// Those of [`Experiment::read_with`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::read_with(path, &Metadata::default())
    }

    /// Reads an experiment file, and the row order of a custom shutter. What the file leaves
    /// open is taken from the metadata of a frame of it, where that says it.
    ///
    /// `row_time_us` may be left out for the shutter `global`, for which it means
    /// nothing; it is then `exposure_us`.
    ///
    /// # Errors
    /// A file that is missing or not TOML, keys that are unknown or missing, values
    /// of a wrong type; each names the file, the line, the rule and the remedy. Metadata of a
    /// frame of another size.
    pub fn read_with(path: &Path, metadata: &Metadata) -> Result<Self> {
        if path.is_dir() {
            let source = path.join("experiment.toml");
            return Err(rowburst::Error::input(
                path,
                "a folder",
                "an experiment file is needed",
                format!("Name the file in it, such as {}.", source.display()),
            ));
        }
        let bytes = std::fs::read(path).map_err(|e| fault::read_error(path, &e))?;
        let text = String::from_utf8(bytes).map_err(|error| {
            rowburst::Error::input(
                path,
                format!("bytes that are not UTF-8 ({})", error.utf8_error()),
                "an experiment file is text in UTF-8",
                phrase![
                    "Name the .toml file here and the frame with ",
                    Parameter::Frame,
                    "."
                ],
            )
        })?;
        Self::parse(path, &text, metadata)
    }

    /// The camera that the file describes.
    ///
    /// # Errors
    /// A value that breaks a rule of [`Camera::new`], with the file's path.
    pub fn camera(&self) -> Result<Camera> {
        Camera::new(self.params.clone()).map_err(|e| e.within(&self.path))
    }

    fn parse(path: &Path, text: &str, metadata: &Metadata) -> Result<Self> {
        let document = DeTable::parse(text).map_err(|e| Table::not_toml(path, text, &e))?;
        let file = Table {
            path,
            text,
            name: "",
            entries: Some(document.get_ref()),
            keys: &[],
        };
        file.check_keys(&SECTIONS.map(|section| section.name))?;
        let calibration = file.table(&CALIBRATION)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let resolved = |table: &Table, key| -> Result<Option<PathBuf>> {
            Ok(table.text(key)?.map(|name| folder.join(name)))
        };
        let camera = file.table(&CAMERA)?;
        let listed_order = camera.counts("row_order")?;
        let row_order = match listed_order {
            Some(_) => None,
            None => resolved(&camera, "row_order")?,
        };
        let mut filling = Filling::new(path, metadata);
        let field = file.table(&FIELD)?;
        let order = match (listed_order, &row_order) {
            (Some(order), _) => Some(RowOrder::Listed(order)),
            (None, Some(path)) => Some(RowOrder::File(path)),
            (None, None) => None,
        };
        let params = read_params(&camera, &field, order, &mut filling)?;
        let mut recording = read_recording(&file.table(&RECORDING)?)?;
        recording.frame_period_us = filling.number(
            "frame_period_us",
            recording.frame_period_us,
            metadata.frame_period_us,
        );
        let bayer = filling.bayer(read_bayer(&camera)?);
        Ok(Self {
            path: path.into(),
            params,
            bayer,
            row_order,
            calibration: Calibration {
                psf: resolved(&calibration, "psf")?,
                dark: resolved(&calibration, "dark")?,
                flat: resolved(&calibration, "flat")?,
                bad_pixels: resolved(&calibration, "bad_pixels")?,
            },
            reconstruction: read_reconstruction(&file.table(&RECONSTRUCTION)?)?,
            recording,
            guides: read_guides(&file.tables(&GUIDE)?, folder)?,
            from_metadata: filling.from_metadata,
        })
    }

    /// The text of an experiment file that lies in `folder` and says the same.
    ///
    /// Paths are written relative to `folder`, or absolute where they have no folder in common with it but the root. The order of a
    /// custom shutter is written as a list where `row_order` is `None`; the file that
    /// `row_order` names must be written by the caller.
    pub fn to_toml(&self, folder: &Path) -> String {
        let path = |path: &PathBuf| -> toml::Value {
            let written = match path.strip_prefix(folder) {
                Ok(inside) => inside.to_string_lossy().into_owned(),
                Err(_) => relative_path(path, folder),
            };
            written.into()
        };
        let mut text = "# Every quantity carries its unit in its name.\n[camera]\n".to_string();
        let (params, sensor) = (&self.params, &self.params.sensor);
        line(&mut text, "rows", Some(params.rows as i64));
        line(&mut text, "columns", Some(params.columns as i64));
        line(&mut text, "shutter", Some(params.shutter.name()));
        line(&mut text, "row_time_us", Some(params.row_time_us));
        line(&mut text, "exposure_us", Some(params.exposure_us));
        if let Shutter::Custom(order) = &params.shutter {
            let list = || -> toml::Value {
                let numbers = order.iter().map(|&k| toml::Value::from(k as i64));
                numbers.collect::<Vec<_>>().into()
            };
            let order = self.row_order.as_ref().map_or_else(list, path);
            line(&mut text, "row_order", Some(order));
        }
        let unless_one = |n: usize| (n != 1).then_some(n as i64);
        line(&mut text, "binning", unless_one(sensor.binning));
        line(&mut text, "bins_per_row", unless_one(params.bins_per_row));
        line(&mut text, "pixel_pitch_um", sensor.pixel_pitch_um);
        line(&mut text, "magnification", sensor.magnification);
        line(&mut text, "trigger_delay_us", sensor.trigger_delay_us);
        line(&mut text, "bit_depth", sensor.bit_depth);
        line(&mut text, "bias_counts", sensor.bias_counts);
        line(
            &mut text,
            "gain_electrons_per_count",
            sensor.gain_electrons_per_count,
        );
        line(
            &mut text,
            "read_noise_electrons",
            sensor.read_noise_electrons,
        );
        line(&mut text, "full_well_counts", sensor.full_well_counts);
        line(&mut text, "bayer", self.bayer.map(Bayer::name));

        let calibration = &self.calibration;
        if *calibration != Calibration::default() {
            text += "\n[calibration]\n";
            line(&mut text, "psf", calibration.psf.as_ref().map(path));
            line(&mut text, "dark", calibration.dark.as_ref().map(path));
            line(&mut text, "flat", calibration.flat.as_ref().map(path));
            line(
                &mut text,
                "bad_pixels",
                calibration.bad_pixels.as_ref().map(path),
            );
        }
        if let Some((rows, columns)) = params.field {
            text += "\n[field]\n";
            line(&mut text, "rows", Some(rows as i64));
            line(&mut text, "columns", Some(columns as i64));
        }
        let reconstruction = &self.reconstruction;
        if *reconstruction != Reconstruction::default() {
            text += "\n[reconstruction]\n";
            line(&mut text, "prior", reconstruction.prior.clone());
            line(&mut text, "tau", reconstruction.tau.map(tau_value));
        }
        if let Some(period) = self.recording.frame_period_us {
            text += "\n[recording]\n";
            line(&mut text, "frame_period_us", Some(period));
        }
        for guide in &self.guides {
            text += "\n[[guide]]\n";
            line(&mut text, "image", Some(path(&guide.image)));
            line(&mut text, "time_us", guide.time_us);
            line(&mut text, "exposure_us", guide.exposure_us);
        }
        text
    }
}

fn tau_value(tau: Tau) -> toml::Value {
    match tau {
        Tau::Auto => "auto".into(),
        Tau::HeldOut => "held-out".into(),
        Tau::Given(tau) => tau.into(),
    }
}

fn line(text: &mut String, key: &str, value: Option<impl Into<toml::Value>>) {
    if let Some(value) = value {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{key} = {}", value.into());
    }
}

/// The order of a custom shutter, as `[camera]` gives it.
enum RowOrder<'a> {
    Listed(Vec<usize>),
    File(&'a Path),
}

fn read_params(
    camera: &Table,
    field: &Table,
    row_order: Option<RowOrder>,
    filling: &mut Filling,
) -> Result<CameraParams> {
    let metadata = filling.metadata;
    let (rows, columns, binning) = filling.size(
        camera.side("rows")?,
        camera.side("columns")?,
        camera.count("binning")?,
    )?;
    let rows = camera.required("rows", rows)?;
    let columns = camera.required("columns", columns)?;
    let own_shutter = read_shutter(camera, row_order)?;
    let shutter = camera.required("shutter", filling.shutter(own_shutter))?;
    let exposure_us = camera.number("exposure_us")?;
    let exposure_us = filling.number("exposure_us", exposure_us, metadata.exposure_us);
    let row_time_us = camera.number("row_time_us")?;
    let row_time_us = match shutter {
        Shutter::Global => row_time_us.or(exposure_us),
        _ => filling.number("row_time_us", row_time_us, metadata.row_time_us),
    };
    let frame_rows = metadata.size.map_or(rows, |(rows, _)| rows);
    let pitch_factor = frame_rows as f64 / rows.max(1) as f64;
    let pixel_pitch_um = filling.pitch(camera.number("pixel_pitch_um")?, pitch_factor);
    let bit_depth = camera.count("bit_depth")?;
    let metadata_bits = metadata.bit_depth.map(|bits| bits as usize);
    let bit_depth = filling.count("bit_depth", bit_depth, metadata_bits);
    let bit_depth = bit_depth.map(u32::try_from).transpose();
    Ok(CameraParams {
        rows,
        columns,
        shutter,
        row_time_us: camera.required("row_time_us", row_time_us)?,
        exposure_us: camera.required("exposure_us", exposure_us)?,
        bins_per_row: camera.count("bins_per_row")?.unwrap_or(1),
        field: match field.entries {
            None => None,
            Some(_) => Some((
                field.required("rows", field.side("rows")?)?,
                field.required("columns", field.side("columns")?)?,
            )),
        },
        sensor: Sensor {
            binning: binning.unwrap_or(1),
            pixel_pitch_um,
            magnification: camera.number("magnification")?,
            trigger_delay_us: camera.number("trigger_delay_us")?,
            // What 32 bits cannot hold is out of range as well.
            bit_depth: bit_depth.unwrap_or(Some(u32::MAX)),
            bias_counts: camera.number("bias_counts")?,
            gain_electrons_per_count: camera.number("gain_electrons_per_count")?,
            read_noise_electrons: camera.number("read_noise_electrons")?,
            full_well_counts: camera.number("full_well_counts")?,
        },
    })
}

/// Reads the tables `[[guide]]`.
fn read_guides(tables: &[Table], folder: &Path) -> Result<Vec<GuideFile>> {
    let read = |table: &Table| {
        let image = table.required("image", table.text("image")?)?;
        let guide = GuideFile {
            image: folder.join(image),
            time_us: table.number("time_us")?,
            exposure_us: table.number("exposure_us")?,
        };
        if let Some(below) = guide.exposure_us.filter(|e| *e < 0.0) {
            return Err(table.error(
                "exposure_us",
                below,
                "an exposure is not below zero",
                "Correct this line.",
            ));
        }
        Ok(guide)
    };
    tables.iter().map(read).collect()
}

fn read_shutter(camera: &Table, row_order: Option<RowOrder>) -> Result<Option<Shutter>> {
    let Some(name) = camera.text("shutter")? else {
        return Ok(None);
    };
    if name == "custom" {
        let order = match camera.required("row_order", row_order)? {
            RowOrder::Listed(order) => order,
            RowOrder::File(path) => read_row_order(path)?,
        };
        return Ok(Some(Shutter::Custom(order)));
    }
    let shutter = Shutter::from_name(name).ok_or_else(|| {
        camera.error(
            "shutter",
            format!("\"{name}\""),
            &format!("the shutter is one of {}", Shutter::NAMES.join(", ")),
            &format!("Did you mean \"{}\"?", nearest(name, &Shutter::NAMES)),
        )
    })?;
    match row_order {
        None => Ok(Some(shutter)),
        Some(_) => Err(camera.error(
            "row_order",
            format!("an order of rows for the shutter \"{name}\""),
            "row_order goes with shutter = \"custom\" alone",
            "Remove it, or set shutter = \"custom\".",
        )),
    }
}

fn read_bayer(camera: &Table) -> Result<Option<Bayer>> {
    let Some(name) = camera.text("bayer")? else {
        return Ok(None);
    };
    let mosaic = Bayer::from_name(name).ok_or_else(|| {
        camera.error(
            "bayer",
            format!("\"{name}\""),
            &format!("the mosaic is one of {}", Bayer::NAMES.join(", ")),
            "Give the colours of the first two pixels of the first row, then of the second.",
        )
    })?;
    Ok(Some(mosaic))
}

fn read_row_order(path: &Path) -> Result<Vec<usize>> {
    let (source, file) = Source::open(path, Colour::Refused)?;
    let array = npy::read_array(&source, file)?;
    let bad = array.data.iter().find(|&&k| k < 0.0);
    let found = match bad {
        None if matches!(array.format, SampleFormat::Counts { .. }) => {
            return Ok(array.data.iter().map(|&k| k as usize).collect());
        }
        None => "numbers in floating point".to_string(),
        Some(k) => format!("the instant {k}"),
    };
    Err(source.error(
        found,
        "a row order has one integer from 0 per row",
        "Save it as numpy.save(\"order.npy\", order.astype(int)).",
    ))
}

fn read_reconstruction(table: &Table) -> Result<Reconstruction> {
    let tau = match (table.number("tau"), table.text("tau")) {
        (Ok(None), _) => None,
        (_, Ok(Some("auto"))) => Some(Tau::Auto),
        (_, Ok(Some("held-out"))) => Some(Tau::HeldOut),
        (Ok(Some(tau)), _) if tau.is_finite() && tau > 0.0 => Some(Tau::Given(tau)),
        (number, text) => {
            let found = match (number, text) {
                (Ok(Some(number)), _) => number.to_string(),
                (_, Ok(Some(text))) => format!("\"{text}\""),
                _ => "neither text nor a number".to_string(),
            };
            return Err(table.error(
                "tau",
                found,
                "tau is \"auto\", \"held-out\" or a number above zero",
                "Write tau = \"auto\".",
            ));
        }
    };
    Ok(Reconstruction {
        prior: table.text("prior")?.map(str::to_string),
        tau,
    })
}

fn read_recording(table: &Table) -> Result<Recording> {
    let frame_period_us = table.number("frame_period_us")?;
    if let Some(period) = frame_period_us.filter(|p| !(p.is_finite() && *p > 0.0)) {
        return Err(table.error(
            "frame_period_us",
            period,
            "it is the time from the start of a frame to that of the next, above zero",
            "Write 1e6 over the camera's frames per second.",
        ));
    }
    Ok(Recording { frame_period_us })
}

#[cfg(test)]
mod tests;
