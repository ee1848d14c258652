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
use rowburst_io::Experiment;
use rowburst_run::Setup;
use rowburst_run::options::{UserOptions, parse_time_budget};
use rowburst_view::{Monitor, MonitorStart, Server};
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
    #[arg(long, default_value_t = 0.1, allow_hyphen_values = true)]
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
    let setup = args
        .experiment
        .as_ref()
        .map(|path| setup_of(args, path, &cancel));
    let setup = setup.transpose()?;
    let first = first_frame(&mut *source, &cancel)?;
    let start = start_of(&settings, setup.as_ref(), &first, source.name());
    let monitor = Arc::new(Monitor::new(start));
    monitor.set("warnings", warnings);
    let mut solver = match setup {
        Some(setup) => Some(LiveSolver::new(setup, budget, &first)?),
        None => None,
    };
    let server = Server::start_monitor(args.browser.port, Arc::clone(&monitor))?;
    open_page(&server, &args.browser);
    eprintln!("Ctrl-C ends it");

    let latest = Arc::new(Latest::default());
    latest.put(first);
    let keeper = Keeper::new(args, settings.clone());
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
        settings,
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

/// The setup of a preview.
fn setup_of(args: &LiveArgs, path: &std::path::Path, cancel: &Cancel) -> Result<Setup> {
    let experiment = Experiment::read(path)?;
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
                bin_duration_us: setup.camera.time().bin_duration_us(),
                pixel_pitch_um: setup.camera.sensor().pixel_pitch_um,
                reconstructs: true,
            }
        }
        None => MonitorStart {
            title,
            shape: [1, first.rows, first.columns],
            bin_duration_us: metadata.exposure_us.unwrap_or(1.0),
            pixel_pitch_um: metadata.pixel_pitch_um,
            reconstructs: false,
        },
    }
}

/// Shows the latest frame and its exposure.
struct ExposureWatch {
    latest: Arc<Latest>,
    monitor: Arc<Monitor>,
    cancel: Cancel,
    settings: Settings,
}

impl ExposureWatch {
    fn run(&self) {
        let bit_depth = self.settings.reading().metadata.bit_depth;
        let mut shown = None;
        while !self.cancel.is_cancelled() {
            if let Some(frame) = self.latest.look()
                && shown != Some(frame.number)
            {
                shown = Some(frame.number);
                self.show(&frame, bit_depth);
            }
            std::thread::sleep(EXPOSURE_INTERVAL);
        }
    }

    fn show(&self, frame: &Frame, bit_depth: Option<u32>) {
        let found = Exposure::of(frame, bit_depth, 0.0);
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
