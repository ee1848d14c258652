//! A raw Bayer frame: four planes, each with a reconstruction of its own, and one video in colour.

use crate::artifacts::{Artifacts, Output, Summary};
use crate::colour_summary::{ColourSummary, PlaneNumbers};
use crate::completed_task::CompletedTask;
use crate::event::{Event, Observer};
use crate::schema::RESULT_SCHEMA_VERSION;
use crate::setup::{Frame, Setup};
use crate::solve::solve;
use crate::summary::{MetadataNumbers, ReconstructionSummary};
use crate::task::Task;
use crate::traces::{TraceRequest, Traces};
use rowburst::bayer::{Bayer, Colour, Site, plane_camera, plane_image, plane_psfs};
use rowburst::measurement::Corrections;
use rowburst::reconstruct::{Options, Prior, SelfCalibration};
use rowburst::solve::StopReason;
use rowburst::{Camera, Error, ErrorKind, Image, Parameter, Result, Video};
use rowburst_io::{
    Capture, FromMetadata, OutputFolder, TiffScale, write_npy_colour, write_tiff_colour,
};
use std::time::Instant;

/// The reconstruction of a raw colour frame, as values.
pub struct ColourTask {
    /// Camera, PSFs and corrections of the raw frame, and the options. A fourth of the time budget is for each plane.
    pub setup: Setup,
    /// The order of the colours.
    pub mosaic: Bayer,
    /// The raw frame.
    pub frame: Frame,
    /// Seed of the simulation that made the frame; only reported.
    pub seed: u64,
    /// Replaces the videos by the refitted ones.
    pub debias: bool,
}

/// A reconstructed plane of a raw colour frame.
pub struct Plane {
    /// Its place in the cell.
    pub site: Site,
    /// From the start of the sensor's first instant to that of the plane's, in µs.
    pub start_us: f64,
    /// Its reconstruction.
    pub completed: CompletedTask,
}

impl ColourTask {
    /// Checks that frame and corrections have the size of the sensor.
    ///
    /// # Errors
    /// Another size, with the file at fault.
    pub fn check(&self) -> Result<()> {
        let setup = &self.setup;
        let raw = &self.frame.capture.image;
        check_raw_frame(raw, &setup.camera).map_err(|error| match &self.frame.file {
            Some(file) => error.within(file),
            None => error,
        })?;
        for (name, image) in [
            (Parameter::Dark, &setup.corrections.dark),
            (Parameter::Flat, &setup.corrections.flat),
            (Parameter::BadPixels, &setup.corrections.bad_pixels),
        ] {
            let size = image.as_ref().map(|i| (i.rows(), i.columns()));
            if size.is_some_and(|size| size != (raw.rows(), raw.columns())) {
                let error = Error::input(
                    name,
                    format!("{size:?} pixels"),
                    format!("it has the frame's {}×{} pixels", raw.rows(), raw.columns()),
                    "Record it with the camera settings of the frame.",
                )
                .with_kind(ErrorKind::Shape);
                return Err(setup.naming(error, &self.frame));
            }
        }
        Ok(())
    }

    /// The camera of a plane. All planes have its size, and one is in memory at a time.
    ///
    /// # Errors
    /// Those of [`plane_camera`].
    pub fn first_plane(&self) -> Result<Camera> {
        Ok(plane_camera(&self.setup.camera, self.mosaic.sites()[0])?.camera)
    }

    /// Reconstructs the planes one after another and gives each to `finish`. Green comes first, since it has half of the
    /// pixels: the prior is chosen on it, for all.
    ///
    /// # Errors
    /// Those of [`plane_camera`], [`plane_psfs`], [`Setup::task`], [`solve`] and `finish`.
    pub fn reconstruct(
        &self,
        process_start: Instant,
        observer: Observer,
        finish: &mut dyn FnMut(Plane) -> Result<()>,
    ) -> Result<()> {
        let mut sites = self.mosaic.sites().to_vec();
        sites.sort_by_key(|site| (site.colour != Colour::Green, site.row));
        let mut prior = self.setup.options.prior;
        for site in sites {
            let _ = observer(Event::Plane(site));
            let (task, start_us) = self.plane_task(site, prior)?;
            let completed = solve(task, process_start, observer)?;
            prior = prior.or(Some(completed.reconstruction.prior));
            finish(Plane {
                site,
                start_us,
                completed,
            })?;
        }
        Ok(())
    }

    /// The task of a plane, and the start of its first instant in µs.
    fn plane_task(&self, site: Site, prior: Option<Prior>) -> Result<(Task, f64)> {
        let setup = &self.setup;
        let plane = plane_camera(&setup.camera, site).map_err(|error| match &setup.experiment {
            Some(path) => error.within(path),
            None => error,
        })?;
        let of = |image: &Option<Image>| image.as_ref().map(|image| plane_image(image, site));
        let plane_setup = Setup {
            camera: plane.camera,
            psfs: plane_psfs(&setup.psfs, site)?,
            corrections: Corrections {
                dark: of(&setup.corrections.dark),
                flat: of(&setup.corrections.flat),
                bad_pixels: of(&setup.corrections.bad_pixels),
                saturation_counts: None,
            },
            options: Options {
                prior,
                // Each plane would correct the PSF in its own way.
                self_calibration: SelfCalibration::OFF,
                ..setup.options
            },
            budget: setup.budget.map(|budget| budget / 4),
            ..setup.clone()
        };
        let frame = Frame {
            capture: Capture {
                image: plane_image(&self.frame.capture.image, site),
                ..self.frame.capture
            },
            bias: self.frame.bias,
            file: self.frame.file.clone(),
        };
        let task = plane_setup.task(&frame, None)?;
        let seed = self.seed;
        Ok((Task { seed, ..task }, plane.start_us))
    }

    /// Reconstructs the planes, writes a folder for each, and the video in colour beside them.
    ///
    /// # Errors
    /// Those of [`Self::reconstruct`], failed writes, and planes of different lengths.
    pub(crate) fn run(
        &self,
        output: &Output,
        process_start: Instant,
        observer: Observer,
    ) -> Result<Artifacts> {
        let mut folder = ColourFolder::begin(output, self.mosaic)?;
        self.reconstruct(process_start, observer, &mut |plane| {
            let Plane {
                site,
                start_us,
                mut completed,
            } = plane;
            if completed.reconstruction.stop_reason == StopReason::Interrupted {
                let request = TraceRequest::default().without_errors();
                let traces = completed.traces(request, false);
                folder.write_stopped_plane(site, start_us, &completed, &traces)?;
                return Err(stopped_error(output, &folder.planes));
            }
            let traces = completed.evaluate(TraceRequest::default(), self.debias);
            folder.write_plane(site, start_us, &completed, &traces)
        })?;
        let summary = folder.finish(&self.setup.from_metadata)?;
        Ok(Artifacts::new(output, summary, Vec::new()))
    }
}

/// The folder of a raw colour frame while it is written: a folder for each plane, then the video in colour.
pub struct ColourFolder<'a> {
    output: &'a Output<'a>,
    mosaic: Bayer,
    planes: Vec<PlaneNumbers>,
    videos: Vec<(Site, Video)>,
    bin_us: f64,
    pixel_pitch_um: Option<f64>,
    trigger_delay_us: Option<f64>,
}

impl<'a> ColourFolder<'a> {
    /// Begins the folder of `output`.
    ///
    /// # Errors
    /// An old `result.json` that cannot be removed.
    pub fn begin(output: &'a Output<'a>, mosaic: Bayer) -> Result<Self> {
        // The file of an earlier run does not describe the new files.
        output.folder.remove("result.json")?;
        Ok(Self {
            output,
            mosaic,
            planes: Vec::new(),
            videos: Vec::new(),
            bin_us: 0.0,
            pixel_pitch_um: None,
            trigger_delay_us: None,
        })
    }

    /// Writes the folder of a plane, whose first bin starts `start_us` after the sensor's first exposure.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write_plane(
        &mut self,
        site: Site,
        start_us: f64,
        completed: &CompletedTask,
        traces: &Traces,
    ) -> Result<()> {
        let (folder, title) = self.folder_of(site)?;
        let summary = completed.write(traces, &self.output.part(&folder, &title))?;
        self.add(site, start_us, completed, &folder, summary);
        Ok(())
    }

    /// The same of a plane that was stopped, within a second.
    fn write_stopped_plane(
        &mut self,
        site: Site,
        start_us: f64,
        completed: &CompletedTask,
        traces: &Traces,
    ) -> Result<()> {
        let (folder, title) = self.folder_of(site)?;
        let summary = completed.write_stopped(traces, &self.output.part(&folder, &title))?;
        self.add(site, start_us, completed, &folder, summary);
        Ok(())
    }

    /// The folder of a plane, and its title.
    fn folder_of(&self, site: Site) -> Result<(OutputFolder, String)> {
        let folder = (self.output.folder).subfolder(&site.name(), "reconstruct")?;
        Ok((folder, format!("{}, {}", self.output.title, site.name())))
    }

    /// Keeps what the video in colour needs of a plane.
    fn add(
        &mut self,
        site: Site,
        start_us: f64,
        completed: &CompletedTask,
        folder: &OutputFolder,
        summary: ReconstructionSummary,
    ) {
        let camera = &completed.task.camera;
        self.bin_us = camera.time().bin_duration_us();
        self.pixel_pitch_um = camera.sensor().pixel_pitch_um;
        self.trigger_delay_us = camera.sensor().trigger_delay_us;
        self.planes.push(PlaneNumbers {
            name: site.name(),
            folder: folder.path().display().to_string(),
            start_us,
            prior: summary.prior,
            tau: summary.tau,
            residual_over_sigma: summary.residual_over_sigma,
            excluded_fraction: summary.excluded_fraction,
            fit: summary.fit,
            seconds: summary.setup_seconds + summary.seconds,
        });
        self.videos
            .push((site, completed.reconstruction.video.clone()));
    }

    /// Writes the video in colour, and `result.json`.
    ///
    /// # Errors
    /// Failed writes, and planes of different lengths.
    pub fn finish(self, from_metadata: &FromMetadata) -> Result<Summary> {
        let (output, folder) = (self.output, self.output.folder);
        let shape = self.videos[0].1.shape();
        let Some(colours) = merge_planes(&self.videos) else {
            return Err(Error::work(
                output.path(),
                "planes of different lengths: there is no video in colour",
                "The planes' own folders are whole.",
            ));
        };
        let starts = self.planes.iter().map(|plane| plane.start_us);
        let start_us = starts.fold(f64::INFINITY, f64::min);
        let scale = TiffScale {
            frame_interval_s: self.bin_us * 1e-6,
            first_s: (start_us + 0.5 * self.bin_us) * 1e-6,
            pixel_pitch_um: self.pixel_pitch_um,
        };
        folder.write("colour.npy", |w| write_npy_colour(w, shape, &colours))?;
        folder.write("colour.tif", |w| {
            write_tiff_colour(w, shape, &colours, scale)
        })?;
        let mut warnings = from_metadata.warnings.clone();
        warnings.extend(offset_warning(&self.planes));
        let summary = Summary::Colour(Box::new(ColourSummary {
            schema_version: RESULT_SCHEMA_VERSION,
            version: env!("CARGO_PKG_VERSION"),
            bayer: self.mosaic.name(),
            frames: shape.bins,
            rows: shape.rows,
            columns: shape.columns,
            frame_rate_hz: 1e6 / self.bin_us,
            start_us,
            trigger_delay_us: self.trigger_delay_us,
            metadata: MetadataNumbers::from(from_metadata),
            planes: self.planes,
            warnings,
            run: output.finished_record("colour.npy")?,
        }));
        folder.remove_stale()?;
        folder.write_bytes("result.json", format!("{}\n", summary.json()).as_bytes())?;
        Ok(summary)
    }
}

/// The error of a run that was stopped: which planes there are.
fn stopped_error(output: &Output, planes: &[PlaneNumbers]) -> Error {
    let names: Vec<&str> = planes.iter().map(|plane| plane.name.as_str()).collect();
    let done = names.join(", ");
    Error::work(
        output.path(),
        format!(
            "stopped with {} of 4 planes: {done}, the last as it was",
            names.len()
        ),
        "Each plane has its own folder; there is no video in colour.",
    )
    .with_kind(ErrorKind::Cancelled)
}

/// The warning of colours that are not of one time.
fn offset_warning(planes: &[PlaneNumbers]) -> Option<String> {
    let starts = planes.iter().map(|plane| plane.start_us);
    let first = starts.clone().fold(f64::INFINITY, f64::min);
    let last = starts.fold(f64::NEG_INFINITY, f64::max);
    (last > first).then(|| {
        format!(
            "the rows of the mosaic are read at different times: colours of one bin are up to {} µs apart (start_us of each plane)",
            last - first
        )
    })
}

/// Checks that a raw frame has the size of the sensor.
fn check_raw_frame(raw: &Image, camera: &Camera) -> Result<()> {
    if (raw.rows(), raw.columns()) == (camera.rows(), camera.columns()) {
        return Ok(());
    }
    Err(Error::input(
        Parameter::Frame,
        format!("{}×{} pixels", raw.rows(), raw.columns()),
        format!("the camera has {}×{}", camera.rows(), camera.columns()),
        "Give the raw frame, before any colours are made of it.",
    )
    .with_kind(ErrorKind::Shape))
}

/// The videos of red, green (the mean of its two planes) and blue; `None` where the planes differ in length.
pub fn merge_planes(planes: &[(Site, Video)]) -> Option<[Vec<f32>; 3]> {
    let shape = planes.first()?.1.shape();
    if planes.iter().any(|(_, video)| video.shape() != shape) {
        return None;
    }
    Some([Colour::Red, Colour::Green, Colour::Blue].map(|colour| {
        // In the order of the mosaic, which decides the last bit of the mean.
        let mut sites: Vec<&(Site, Video)> = planes
            .iter()
            .filter(|(site, _)| site.colour == colour)
            .collect();
        sites.sort_by_key(|(site, _)| (site.row, site.column));
        match sites[..] {
            [(_, one), (_, other)] => {
                let pairs = one.data().iter().zip(other.data());
                pairs.map(|(a, b)| 0.5 * (a + b)).collect()
            }
            _ => sites[0].1.data().to_vec(),
        }
    }))
}
