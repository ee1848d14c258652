//! `rowburst view`, and the page of a reconstruction that is running.

use crate::args::{ReconstructArgs, ViewArgs};
use crate::browser::{open, open_page};
use crate::progress::wait_for_ctrl_c;
use rowburst::solve::admm::Progress;
use rowburst::{Camera, Result};
use rowburst_run::{Event, IterationMetrics};
use rowburst_view::{Live, LiveStart, ProgressPoint, ResultFiles, RunStatus, Server, VideoAxes};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

pub fn run(args: &ViewArgs) -> Result<()> {
    let results = args.results.iter().map(|path| ResultFiles::open(path));
    let results = results.collect::<Result<Vec<_>>>()?;
    let server = Server::start(args.browser.port, results, None)?;
    open_page(&server, &args.browser);
    eprintln!("Ctrl-C ends it");
    loop {
        std::thread::park();
    }
}

/// Time between two videos that are shown while it runs.
const UPDATE_INTERVAL: Duration = Duration::from_millis(250);

/// The page of a run.
pub struct LivePage {
    server: Server,
    live: Arc<Live>,
    /// When the last video was shown.
    last: Instant,
}

/// Opens the page of a run, with `--view`. `stop` is what ends the run.
pub fn open_live_page(
    args: &ReconstructArgs,
    camera: &Camera,
    stop: &Arc<AtomicBool>,
) -> Result<Option<LivePage>> {
    if !args.view {
        return Ok(None);
    }
    let shape = camera.video_shape();
    let start = LiveStart {
        title: args.output.display().to_string(),
        shape: [shape.bins, shape.rows, shape.columns],
        axes: VideoAxes::of(camera),
    };
    let live = Arc::new(Live::new(start, Arc::clone(stop)));
    let server = Server::start(args.browser.port, Vec::new(), Some(Arc::clone(&live)))?;
    // Standard output is for the result.
    eprintln!("watch it at {}", server.url());
    open(&server, &args.browser);
    Ok(Some(LivePage {
        server,
        live,
        last: Instant::now(),
    }))
}

impl LivePage {
    /// Shows an event of the run.
    pub fn show(&mut self, event: Event) {
        match event {
            Event::Iteration {
                progress, metrics, ..
            } => self.show_iteration(progress, metrics),
            Event::Writing => self.live.set_status(RunStatus::Writing),
            _ => {}
        }
    }

    fn show_iteration(&mut self, progress: &Progress, metrics: &IterationMetrics) {
        let point = ProgressPoint {
            iteration: progress.iteration,
            max_iterations: progress.max_iterations,
            seconds: metrics.seconds,
            residual_over_sigma: metrics.residual_over_sigma,
            psnr_db: metrics.psnr_db,
        };
        self.live.point(progress.label, point);
        if self.live.is_video_requested() && self.last.elapsed() > UPDATE_INTERVAL {
            self.live.show(&progress.video.get());
            self.last = Instant::now();
        }
    }

    /// Shows the result that was written to `folder`, until Ctrl-C.
    pub fn serve_until_ctrl_c(self, folder: &Path) -> Result<()> {
        self.server.show(vec![ResultFiles::open(folder)?]);
        self.live.set_status(RunStatus::Done);
        eprintln!("the result is at {}; Ctrl-C ends it", self.server.url());
        wait_for_ctrl_c()
    }
}
