//! `rowburst live`: the page of a camera, with the video of its latest frame.
//!
//! ```text
//! Source ─▶ grab thread ─▶ Latest (one frame; a newer one replaces it) ─▶ solver (this thread) ─▶ Monitor ─▶ page
//!                └▶ Recorder                        └▶ exposure thread ──────────────────────────┘
//! ```

mod grab;
mod keep;
mod solve;

use crate::browser::open_page;
use crate::capture::{SourceArgs, source};
use crate::inputs::calibration_from_args;
use crate::progress::{Interrupt, Kept};
use crate::shared_args::{BrowserArgs, CalibrationArgs};
use clap::Args;
use grab::{Grabber, Latest};
use keep::Keeper;
use rowburst::{Cancel, ErrorKind, Result};
use rowburst_capture::{Delivery, Exposure, Frame, Settings, Source};
use rowburst_io::{Experiment, Metadata};
use rowburst_run::Setup;
use rowburst_run::options::{UserOptions, parse_time_budget};
use rowburst_view::{Monitor, MonitorStart, Server, VideoAxes};
use serde_json::json;
use solve::LiveSolver;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Look at a camera in the browser: exposure, and the video of the latest frame.
///
/// Frames that come while the solver is busy are left out, so that the picture is never late. Each video goes on from
/// the one before: look at it, but measure with reconstruct. Without an experiment only the raw frame is shown. Tried
/// on emulated cameras alone.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst live psf/experiment.toml --source \"play:recording.tif?rate=20&loop\"\n  rowburst live --source play:recording.tif"
)]
pub struct LiveArgs {
    /// The experiment file with its PSF; without it nothing is reconstructed
    pub experiment: Option<PathBuf>,
    #[command(flatten)]
    pub source: SourceArgs,
    #[command(flatten)]
    pub calibration: CalibrationArgs,
    /// Time that the solver takes for a frame, in seconds
    #[arg(long, default_value_t = 0.07, allow_hyphen_values = true)]
    pub time_budget_s: f64,
    /// Folder for the frames, recordings and results that are kept
    #[arg(short, long, default_value = "rowburst-live")]
    pub output: PathBuf,
    #[command(flatten)]
    pub browser: BrowserArgs,
}

/// Time between two looks at the exposure.
const EXPOSURE_INTERVAL: Duration = Duration::from_millis(100);

/// Longest wait for a frame before Ctrl-C is looked for.
pub const WAIT: Duration = Duration::from_millis(100);

pub fn run(args: &LiveArgs) -> Result<()> {
    let interrupt = Interrupt::listen(Kept::Recorded);
    let cancel: Cancel = Arc::clone(&interrupt.run).into();
    let budget = parse_time_budget(Some(args.time_budget_s))?;
    let mut source = source(&args.source)?;
    let settings = source.settings()?;
    let mut warnings = settings.check()?;
    if args.experiment.is_some() {
        // The experiment says it.
        warnings.retain(|warning| !warning.contains("row time"));
    }
    let metadata = Metadata {
        sources: vec![format!("the settings of {}", source.name())],
        ..settings.reading().metadata
    };
    let setup = args
        .experiment
        .as_ref()
        .map(|path| setup_of(args, path, &metadata, &cancel));
    let setup = setup.transpose()?;
    if let Some(setup) = &setup {
        warnings.extend(setup.from_metadata.warnings.iter().cloned());
    }
    let watch_params = WatchParams::of(&settings, setup.as_ref());
    let first = first_frame(&mut *source, &cancel)?;
    let start = start_of(&settings, setup.as_ref(), &first, source.name());
    let monitor = Arc::new(Monitor::new(start));
    monitor.set("warnings", warnings);
    monitor.set("controls", controls_of(&mut *source)?);
    let mut solver = match setup {
        Some(setup) => Some(LiveSolver::new(setup, budget, &first)?),
        None => None,
    };
    let server = Server::start_monitor(args.browser.port, Arc::clone(&monitor))?;
    open_page(&server, &args.browser);
    eprintln!("Ctrl-C ends it");

    let latest = Arc::new(Latest::default());
    latest.put(first);
    let keeper = Keeper::new(args, settings, cancel.clone());
    let grabber = Grabber {
        source,
        latest: Arc::clone(&latest),
        monitor: Arc::clone(&monitor),
        keeper,
        cancel: cancel.clone(),
    };
    let exposure = ExposureWatch {
        latest: Arc::clone(&latest),
        monitor: Arc::clone(&monitor),
        cancel: cancel.clone(),
        params: watch_params,
    };
    std::thread::scope(|scope| {
        let grabbing = scope.spawn(|| grabber.run());
        scope.spawn(|| exposure.run());
        while !cancel.is_cancelled() {
            match &mut solver {
                Some(solver) => solver.step(&latest, &monitor, &cancel),
                None => std::thread::sleep(WAIT),
            }
        }
        grabbing.join().expect("the grabber does not panic")
    })
}

/// The controls of a source as the page takes them.
pub fn controls_of(source: &mut dyn Source) -> Result<serde_json::Value> {
    let controls = source.controls()?;
    let controls = controls.iter().map(|control| {
        json!({
            "name": control.name, "value": control.value,
            "min": control.min, "max": control.max, "unit": control.unit,
        })
    });
    Ok(controls.collect())
}

/// The setup of a preview.
fn setup_of(
    args: &LiveArgs,
    path: &std::path::Path,
    metadata: &Metadata,
    cancel: &Cancel,
) -> Result<Setup> {
    let experiment = Experiment::read_with(path, metadata)?;
    let options = UserOptions {
        self_calibrate: Some("off"),
        keep_all_pixels: true,
        ..UserOptions::default()
    };
    let given = calibration_from_args(&args.calibration);
    Setup::read(
        &experiment,
        given,
        &options,
        cancel,
        &mut crate::progress::print_note,
    )
}

/// Waits for a whole frame.
fn first_frame(source: &mut dyn Source, cancel: &Cancel) -> Result<Frame> {
    loop {
        match source.next(cancel)? {
            Delivery::Frame(frame) => return Ok(frame),
            Delivery::Dropped { .. } | Delivery::Incomplete { .. } => {}
            Delivery::End => {
                return Err(rowburst::Error::input(
                    rowburst::error::Subject::named(source.name()),
                    "no whole frame",
                    "a live view needs frames",
                    "Check the recording, or that the camera runs.",
                )
                .with_kind(ErrorKind::NoSignal));
            }
        }
    }
}

fn start_of(
    settings: &Settings,
    setup: Option<&Setup>,
    first: &Frame,
    title: String,
) -> MonitorStart {
    let metadata = settings.reading().metadata;
    match setup {
        Some(setup) => {
            let shape = setup.camera.video_shape();
            MonitorStart {
                title,
                shape: [shape.bins, shape.rows, shape.columns],
                axes: VideoAxes::of(&setup.camera),
                reconstructs: true,
            }
        }
        None => MonitorStart {
            title,
            shape: [1, first.rows, first.columns],
            axes: VideoAxes::of_frame(metadata.exposure_us.unwrap_or(1.0), metadata.pixel_pitch_um),
            reconstructs: false,
        },
    }
}

/// Shows the latest frame and its exposure.
struct ExposureWatch {
    latest: Arc<Latest>,
    monitor: Arc<Monitor>,
    cancel: Cancel,
    params: WatchParams,
}

/// What the exposure is judged by.
#[derive(Debug, Clone, Copy, PartialEq)]
struct WatchParams {
    bit_depth: Option<u32>,
    /// Level without light, in counts.
    dark_counts: f64,
}

impl WatchParams {
    /// Those of the experiment, and what it leaves open by the settings of the camera.
    fn of(settings: &Settings, setup: Option<&Setup>) -> Self {
        let sensor = setup.map(|setup| setup.camera.sensor());
        let dark = setup.and_then(|setup| setup.corrections.dark.as_ref());
        let dark = dark.map(|dark| {
            let data = dark.data();
            data.iter().map(|&v| f64::from(v)).sum::<f64>() / data.len() as f64
        });
        let bias = sensor.and_then(|sensor| sensor.bias_counts);
        let bits = sensor.and_then(|sensor| sensor.bit_depth);
        Self {
            bit_depth: bits.or(settings.reading().metadata.bit_depth),
            dark_counts: dark.or(bias).unwrap_or(0.0),
        }
    }
}

impl ExposureWatch {
    fn run(&self) {
        let mut shown = None;
        while !self.cancel.is_cancelled() {
            if let Some(frame) = self.latest.look()
                && shown != Some(frame.number)
            {
                shown = Some(frame.number);
                self.show(&frame);
            }
            std::thread::sleep(EXPOSURE_INTERVAL);
        }
    }

    fn show(&self, frame: &Frame) {
        let found = Exposure::of(frame, self.params.bit_depth, self.params.dark_counts);
        self.monitor.set(
            "exposure",
            json!({
                "histogram": found.histogram,
                "saturation_counts": found.saturation_counts,
                "saturated_fraction": found.saturated_fraction,
                "mean": found.mean,
                "max": found.max,
                "contrast": found.contrast,
                "grain_px": found.grain_px,
                "number": frame.number,
            }),
        );
        self.monitor
            .show_frame((frame.rows, frame.columns), &frame.counts);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::{Image, Psf};

    #[test]
    fn exposure_is_judged_by_the_experiment() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("experiment.toml");
        let text = "[camera]\nrows = 24\ncolumns = 24\nshutter = \"top-down\"\nrow_time_us = 10\nexposure_us = 10\nbit_depth = 12\nbias_counts = 100\n[calibration]\npsf = \"psf.npy\"\n";
        std::fs::write(&path, text).unwrap();
        let psf = Psf::new(Image::from_fn(3, 3, |_, _| 1.0)).unwrap();
        let out = rowburst_io::OutputFolder::create(folder.path()).unwrap();
        out.write("psf.npy", |w| rowburst_io::write_npy_image(w, psf.image()))
            .unwrap();
        let experiment = Experiment::read(&path).unwrap();
        let options = UserOptions::default();
        let quiet = &mut |_: rowburst_run::Event| std::ops::ControlFlow::Continue(());
        let given = rowburst_io::Calibration::default();
        let mut setup =
            Setup::read(&experiment, given, &options, &Cancel::default(), quiet).unwrap();
        let mut settings = Settings::default();
        settings.push("bit_depth", 14);
        let of = |setup: Option<&Setup>| WatchParams::of(&settings, setup);
        assert_eq!(of(None).bit_depth, Some(14));
        let found = of(Some(&setup));
        assert_eq!((found.bit_depth, found.dark_counts), (Some(12), 100.0));
        setup.corrections.dark = Some(Image::from_fn(24, 24, |_, _| 120.0));
        assert_eq!(of(Some(&setup)).dark_counts, 120.0);
    }
}
