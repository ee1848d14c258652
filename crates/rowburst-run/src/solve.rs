//! The reconstruction of one frame.

use crate::completed_task::CompletedTask;
use crate::event::{Event, Observer};
use crate::guide::GuideOutcome;
use crate::run_clock::RunClock;
use crate::task::Task;
use rowburst::Result;
use rowburst::reconstruct::{Model, Options, Prior, Problem};
use std::time::Instant;

/// Reconstructs the frame of `task`. `process_start` is the start of the program, the zero of the convergence curve's
/// time axis. `observer` is called after every iteration and may stop the run; its time is not counted
/// as the solver's.
///
/// # Errors
/// Those of [`Problem::new`] and [`Problem::solve`].
pub fn solve(task: Task, process_start: Instant, observer: Observer) -> Result<CompletedTask> {
    let setup_start = Instant::now();
    let model = Model::new(&task.camera, &task.psfs);
    solve_since(setup_start, &model, task, process_start, observer)
}

/// Like [`solve`], for one of several frames that share `model`, which is that of the task's camera and PSFs. The video
/// is the same.
///
/// # Errors
/// Those of [`solve`].
pub fn solve_with_model(
    model: &Model,
    task: Task,
    process_start: Instant,
    observer: Observer,
) -> Result<CompletedTask> {
    solve_since(Instant::now(), model, task, process_start, observer)
}

fn solve_since(
    setup_start: Instant,
    model: &Model,
    mut task: Task,
    process_start: Instant,
    observer: Observer,
) -> Result<CompletedTask> {
    let options = Options {
        // A choice of the prior takes a run for each candidate, so a time budget excludes it.
        prior: task.options.prior.or(task.budget.map(|_| Prior::STANDARD)),
        is_preview: task.budget.is_some(),
        ..task.options
    };
    let model = model.clone().with_cancel(&task.cancel);
    let problem = Problem::with_model(&model, &task.measurement, options)?;
    let setup = setup_start.elapsed();
    let remaining = task.budget.map(|b| b.saturating_sub(setup));
    let mut clock = RunClock::new(problem.sigma(), task.truth.as_ref(), remaining);
    let guide = task
        .guide
        .as_ref()
        .map(|guide| guide.fit(&problem, &task.camera, &task.cancel))
        .transpose()?;
    let outcome = guide.as_ref().map(GuideOutcome::new);
    let result = if let Some(found) = guide.filter(|found| found.used) {
        let degrees_of_freedom = found.degrees_of_freedom;
        problem.judge(found.video, degrees_of_freedom)
    } else {
        problem.solve(&mut |progress| {
            let flow = clock.observe(progress);
            clock.untimed(|metrics| {
                observer(Event::Iteration {
                    progress,
                    metrics,
                    chunk: None,
                })
            })?;
            flow
        })
    };
    let seconds = clock.seconds();
    let reconstruction = result?;
    clock.rescale(reconstruction.sigma);
    let start_offset_s = clock.start_offset_s(process_start);
    let convergence = clock.convergence;
    // What follows, such as traces and report, is made with the corrected PSF and frame.
    task.measurement = reconstruction.corrected(&task.measurement);
    let given_psfs = reconstruction.calibration.as_ref().map(|calibration| {
        task.camera = calibration.corrected_camera(&task.camera);
        std::mem::replace(&mut task.psfs, calibration.psfs.clone())
    });
    Ok(CompletedTask {
        task,
        given_psfs,
        reconstruction,
        guide: outcome,
        debias: None,
        setup_seconds: setup.as_secs_f64(),
        seconds,
        start_offset_s,
        convergence,
    })
}
