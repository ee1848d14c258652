//! What a reconstruction of one frame is to do, and doing it.

use crate::completed_task::CompletedTask;
use crate::watch::RunClock;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{Options, Prior, Problem};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst::{Camera, Image, PatchSet, Result, Video};
use rowburst_io::FromMetadata;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// A frame and what is wanted of it: values, wherever they come from.
pub struct Task {
    /// The camera.
    pub camera: Camera,
    /// The PSF, or those of the parts of the field.
    pub psfs: PatchSet,
    /// The corrected frame.
    pub measurement: Measurement,
    /// How to reconstruct. Where its prior is left open it is chosen, if there is time for it.
    pub options: Options,
    /// For set-up and solver.
    pub budget: Option<Duration>,
    /// The true video, to compare with.
    pub truth: Option<Video>,
    /// The file that it was read from.
    pub truth_file: Option<PathBuf>,
    /// A frame of the scene without the diffuser, to be shown.
    pub direct: Option<Image>,
    /// Of the simulation that the frame comes from.
    pub seed: u64,
    /// What of the camera came from the frame's metadata.
    pub from_metadata: FromMetadata,
}

/// What the clock beside the solver knows of an iteration.
#[derive(Debug, Clone, Copy)]
pub struct IterationMetrics {
    /// Of the solver so far.
    pub seconds: f64,
    /// Residual over the noise level.
    pub residual_over_sigma: f64,
    /// Against the truth, at the iterations that are points of the history.
    pub psnr_db: Option<f64>,
}

/// Solves it. `began` is when the program was started, for the history; `show` sees every
/// iteration, at its own time, and may stop it.
///
/// # Errors
/// Those of [`Problem::new`] and [`Problem::solve`].
pub fn solve(
    task: Task,
    began: Instant,
    show: &mut dyn FnMut(&Progress, &IterationMetrics) -> ControlFlow<StopReason>,
) -> Result<CompletedTask> {
    let options = Options {
        // A choice takes a run for each candidate: a budget has no time for it.
        prior: task.options.prior.or(task.budget.map(|_| Prior::STANDARD)),
        ..task.options
    };
    let started = Instant::now();
    let problem = Problem::new(&task.measurement, &task.camera, &task.psfs, options)?;
    let setup = started.elapsed();
    let left = task.budget.map(|b| b.saturating_sub(setup));
    let mut watch = RunClock::new(problem.sigma(), task.truth.as_ref(), left);
    let result = problem.solve(&mut |progress| {
        let flow = watch.observe(progress);
        watch.untimed(|metrics| show(progress, metrics))?;
        flow
    });
    let seconds = watch.seconds();
    let reconstruction = result?;
    watch.rescale(reconstruction.sigma);
    let start_offset_s = watch.start_offset_s(began);
    let curve = watch.curve;
    Ok(CompletedTask {
        task,
        reconstruction,
        debias: None,
        setup_seconds: setup.as_secs_f64(),
        seconds,
        start_offset_s,
        curve,
    })
}
