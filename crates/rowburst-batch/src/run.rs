//! The job itself.

use crate::allocation::ThreadAllocation;
use crate::calibration::{CalibrationFile, RecordingCalibration};
use crate::choice::{ChosenPrior, RecordingSurvey, is_same_recording, pixel_format_name};
use crate::claim::Claim;
use crate::clock::Clock;
use crate::identity::check_same;
use crate::inputs::BatchInputs;
use crate::measurement::catch_panic;
use crate::state::{ClockFile, JobFile, State};
use crate::table::{FrameRow, Status, csv_of};
use rowburst::error::{Names, Subject, With};
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{
    Model, Options, Prior, Problem, Reconstruction, SelfCalibration, Sequence,
};
use rowburst::solve::StopReason;
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result, Video, phrase};
use rowburst_zarr::{ArchiveParams, Scratch, VideoArchive};
use serde_json::json;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// A recording on its way into an archive.
pub struct Batch {
    pub(crate) inputs: BatchInputs,
    pub(crate) archive: VideoArchive,
    pub(crate) scratch: Arc<Scratch>,
    pub(crate) clock: Option<Clock>,
    state: State,
    job: JobFile,
    calibration: OnceLock<RecordingCalibration>,
}

/// What an observer sees.
#[derive(Debug, Clone, Copy)]
pub enum Event<'a> {
    /// A correction of PSF and camera is being looked for.
    Calibrating,
    /// The prior is being chosen on this frame.
    Choosing {
        /// Its index.
        frame: usize,
    },
    /// A frame is through, and on disk.
    FrameFinished(&'a FrameRow),
    /// A part of the stitched video is on disk.
    Stitched {
        /// Number of parts.
        of: usize,
    },
}

type Observer<'o> = &'o (dyn Fn(Event) + Sync);

impl Batch {
    /// Begins the job in the folder `out`, or goes on with it.
    ///
    /// # Errors
    /// A recording without a single good frame, a folder that holds anything but this job, a
    /// frame period that cannot be, failed writes. Nothing is changed then.
    pub fn open(inputs: BatchInputs, out: &Path) -> Result<Self> {
        let survey = RecordingSurvey::read(&inputs)?;
        let camera = inputs.model.camera();
        let told = inputs.frame_period_us;
        let clock_of = |period| Clock::new(camera, period);
        let mut clock = told.map(clock_of).transpose()?;
        let state = State::create(out)?;
        let lock = state.lock()?;
        let identity = inputs.identity();
        let begun = state.job()?;
        if let Some(begun) = &begun {
            check_same(out, &begun.identity, &identity)?;
            if !is_same_recording(&begun.probes, &survey.probes) {
                return Err(Error::input(
                    inputs.frames.path(),
                    format!(
                        "other frames than those that {} was started with",
                        out.display()
                    ),
                    "an archive holds the videos of one recording",
                    phrase!["Choose another folder", With(Parameter::Output), "."],
                )
                .with_kind(ErrorKind::Conflict));
            }
        }
        let scratch = Arc::new(state.scratch()?);
        if told.is_none() {
            let stored = state.clock()?.map(|stored| stored.frame_period_us);
            clock = stored.map(clock_of).transpose()?;
        }
        if let Some(Clock {
            frame_period_us, ..
        }) = clock
        {
            state.write_clock(&scratch, &ClockFile { frame_period_us })?;
        }
        let params = archive_params(&inputs, clock);
        let archive = VideoArchive::create(out, params, &scratch)?;
        let job = match begun {
            Some(job) => job,
            None => {
                let RecordingSurvey {
                    probes,
                    pixel_format,
                    brightest,
                } = survey;
                let job = JobFile::new(identity, probes, pixel_format, brightest);
                // Last: a job that has its file has all the others.
                state.write_job(&scratch, &job)?;
                job
            }
        };
        drop(lock);
        Ok(Self {
            inputs,
            archive,
            scratch,
            clock,
            state,
            job,
            calibration: OnceLock::new(),
        })
    }

    /// What it is to do.
    pub fn inputs(&self) -> &BatchInputs {
        &self.inputs
    }

    /// The recording's clock, where it is known.
    pub fn clock(&self) -> Option<Clock> {
        self.clock
    }

    /// The lines of all frames that are through, in their order.
    ///
    /// # Errors
    /// A line that cannot be read.
    pub fn rows(&self) -> Result<Vec<FrameRow>> {
        self.state.rows(self.inputs.frames.count())
    }

    /// The frames of `range` that are not through; those that failed as well if `retry`.
    ///
    /// # Errors
    /// A line that cannot be read.
    pub fn pending(&self, range: Range<usize>, retry: RetryPolicy) -> Result<Vec<usize>> {
        let mut through = vec![false; self.inputs.frames.count()];
        for row in self.rows()? {
            through[row.frame] = row.status == Status::Done || retry == RetryPolicy::SkipFailed;
        }
        Ok(range.filter(|&frame| !through[frame]).collect())
    }

    /// Keeps other processes from making frames of `range`, until the claim is dropped or the process ends.
    ///
    /// # Errors
    /// Another process has claimed some of them, or a file that cannot be made.
    pub fn claim(&self, range: Range<usize>) -> Result<Claim> {
        // One process at a time looks at the others' claims.
        let _lock = self.state.lock()?;
        Claim::new(&self.state.claims(), range)
    }

    /// The video of a frame as the archive has it; NaN where it has none.
    ///
    /// # Errors
    /// Failed reads.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn video(&self, frame: usize) -> Result<Video> {
        let shape = self.archive.params().video;
        Video::new(shape, self.archive.read(frame, 0..shape.bins)?)
    }

    /// PSF and camera of all frames; looked for now where they are not known yet. `None` where it was stopped.
    fn calibration(
        &self,
        cancel: &Cancel,
        observer: Observer,
    ) -> Result<Option<&RecordingCalibration>> {
        if self.calibration.get().is_none() {
            // Processes that come later wait for what the first one finds.
            let _lock = self.state.lock_choice()?;
            let (inputs, folder) = (&self.inputs, self.state.folder());
            let known = || RecordingCalibration::read(inputs, folder, self.state.calibration()?);
            let mut found = known()?;
            if found.is_none() {
                observer(Event::Calibrating);
                let file = RecordingCalibration::find(inputs, folder, &self.scratch, cancel)?;
                let Some(file) = file else {
                    return Ok(None);
                };
                self.state.write_calibration(&self.scratch, &file)?;
                found = known()?;
            }
            let found = found.expect("it has just been written");
            let _ = self.calibration.set(found);
        }
        Ok(self.calibration.get())
    }

    /// What was found of PSF and camera, as in `result.json`, and the frames that it was found from; `None` before
    /// [`Self::prior`] or [`Self::run`], and where they are used as given.
    pub fn self_calibration(&self) -> Option<(&serde_json::Value, &[usize])> {
        let CalibrationFile {
            frames,
            self_calibration,
        } = &self.calibration.get()?.file;
        Some((self_calibration.as_ref()?, frames))
    }

    /// The prior of all frames; chosen now where it is neither given nor chosen yet. `None` where
    /// it was stopped.
    ///
    /// # Errors
    /// Those of a reconstruction, and failed writes.
    pub fn prior(&self, cancel: &Cancel, observer: Observer) -> Result<Option<ChosenPrior>> {
        let Some(calibration) = self.calibration(cancel, observer)? else {
            return Ok(None);
        };
        if let Some(prior) = self.inputs.options.prior {
            return Ok(Some(ChosenPrior::given(prior)));
        }
        // Processes that come later wait for the first one's choice.
        let lock = self.state.lock_choice()?;
        if let Some(chosen) = self.state.prior()? {
            return Ok(Some(chosen));
        }
        let frame = self.job.brightest;
        observer(Event::Choosing { frame });
        let chosen = ChosenPrior::choose(&self.inputs, calibration, frame, cancel)?;
        if let Some(chosen) = &chosen {
            self.state.write_prior(&self.scratch, chosen)?;
        }
        drop(lock);
        Ok(chosen)
    }

    /// Makes the videos of `frames`, as many at once as `allocation` says, until all are through or
    /// they are cancelled: frames at work are then given up.
    ///
    /// A frame that cannot be read or reconstructed gets its line, whose message has the parameters' `names`, and does
    /// not stop the others.
    ///
    /// # Errors
    /// Failed writes: what is written stays, and the job can be taken up again.
    pub fn run(
        &self,
        frames: &[usize],
        prior: &ChosenPrior,
        allocation: ThreadAllocation,
        names: &(dyn Names + Sync),
        cancel: &Cancel,
        observer: Observer,
    ) -> Result<()> {
        let Some(calibration) = self.calibration(cancel, observer)? else {
            return Ok(());
        };
        let model = calibration.model.clone().with_cancel(cancel);
        let frame_options = FrameOptions {
            calibration,
            model: &model,
            names,
            options: Options {
                prior: Some(prior.prior.parse::<Prior>()?),
                self_calibration: SelfCalibration::OFF,
                ..self.inputs.options
            },
            tau_factor: prior.tau_factor,
        };
        let budgeted = self.inputs.budget.map(|budget| BudgetedSequence {
            budget,
            sequence: Mutex::new(Sequence::new(model.clone(), frame_options.options)),
        });
        let allocation = match &budgeted {
            None => allocation,
            // One after another, in their order.
            Some(_) => ThreadAllocation {
                concurrent_frames: 1,
                threads_per_frame: allocation.concurrent_frames * allocation.threads_per_frame,
            },
        };
        let budgeted = budgeted.as_ref();
        let next = AtomicUsize::new(0);
        let failure: Mutex<Option<Error>> = Mutex::new(None);
        let give_up = Cancel::default();
        let fail = |error: Error| {
            give_up.cancel();
            let mut failure = failure.lock().unwrap_or_else(PoisonError::into_inner);
            failure.get_or_insert(error);
        };
        let is_over = || cancel.is_cancelled() || give_up.is_cancelled();
        let work = || {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(allocation.threads_per_frame);
            let pool = match pool.build() {
                Ok(pool) => pool,
                Err(error) => {
                    return fail(Error::work(
                        Parameter::Threads,
                        error,
                        phrase!["Lower ", Parameter::Threads, "."],
                    ));
                }
            };
            while !is_over() {
                let Some(&frame) = frames.get(next.fetch_add(1, Ordering::Relaxed)) else {
                    break;
                };
                // Threads of its own: a thread that waits must not begin another frame.
                let Some((row, video)) =
                    pool.install(|| self.make(frame, frame_options, budgeted, &is_over))
                else {
                    break;
                };
                let stored = video.map_or(Ok(()), |video| self.archive.store(frame, &video));
                match stored.and_then(|()| self.state.write_row(&self.scratch, &row)) {
                    Ok(()) => observer(Event::FrameFinished(&row)),
                    Err(error) => fail(error),
                }
            }
        };
        std::thread::scope(|scope| {
            for _ in 0..allocation.concurrent_frames {
                scope.spawn(work);
            }
        });
        let failure = failure.into_inner().unwrap_or_else(PoisonError::into_inner);
        failure.map_or(Ok(()), Err)
    }

    /// The line of a frame and its video, if it has one; `None` where it was given up.
    fn make(
        &self,
        frame: usize,
        frame_options: FrameOptions,
        budgeted: Option<&BudgetedSequence>,
        is_over: &(dyn Fn() -> bool + Sync),
    ) -> Option<(FrameRow, Option<Video>)> {
        let started = Instant::now();
        let made = catch_panic(|| self.reconstruct(frame, frame_options, budgeted, is_over));
        let name = self.inputs.frames.name(frame);
        let seconds = started.elapsed().as_secs_f64();
        match made {
            Ok((_, found)) if found.stop_reason == StopReason::Interrupted => None,
            Ok((measurement, found)) => {
                let saturated = measurement.saturated();
                let row = FrameRow::done(frame, name, &found, saturated, seconds);
                Some((row, Some(found.video)))
            }
            Err(error) if error.kind() == ErrorKind::Cancelled => None,
            Err(error) => {
                // The line has the frame's name already.
                let message = if error.label() == Some(&name) {
                    error.explanation(frame_options.names)
                } else {
                    error.message(frame_options.names)
                };
                Some((FrameRow::failed(frame, name, message, seconds), None))
            }
        }
    }

    fn reconstruct(
        &self,
        frame: usize,
        frame_options: FrameOptions,
        budgeted: Option<&BudgetedSequence>,
        is_over: &(dyn Fn() -> bool + Sync),
    ) -> Result<(Measurement, Reconstruction)> {
        let capture = self.inputs.frames.read(frame)?;
        let pixel_format = pixel_format_name(capture.format);
        if pixel_format != self.job.pixel_format {
            return Err(Error::input(
                Subject::item(Parameter::Frames, self.inputs.frames.name(frame)),
                pixel_format,
                format!(
                    "the frames of this recording have the pixel format {}",
                    self.job.pixel_format
                ),
                "Save all frames with the same settings.",
            ));
        }
        let measurement = self.inputs.measurement(&capture)?;
        let measurement = frame_options.calibration.corrected(measurement);
        if let Some(budgeted) = budgeted {
            let found = budgeted.reconstruct(&measurement, is_over)?;
            return Ok((measurement, found));
        }
        let problem =
            Problem::with_model(frame_options.model, &measurement, frame_options.options)?;
        let found = problem
            .with_tau_factor(frame_options.tau_factor)
            .solve(&mut |_| {
                if is_over() {
                    ControlFlow::Break(StopReason::Interrupted)
                } else {
                    ControlFlow::Continue(())
                }
            })?;
        Ok((measurement, found))
    }

    /// Joins the lines of all frames that are through, whichever process made them, to the
    /// table; returns its path.
    ///
    /// # Errors
    /// Failed reads and writes.
    pub fn write_table(&self) -> Result<PathBuf> {
        let _lock = self.state.lock()?;
        let csv = csv_of(&self.rows()?, &*self.inputs.frames, self.clock)?;
        let path = self.state.table();
        self.scratch.put(&path, &csv)?;
        Ok(path)
    }
}

/// Which frames are done anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RetryPolicy {
    /// Those that have no line.
    SkipFailed,
    /// Those that failed, too.
    RetryFailed,
}

/// Frames in a time budget, each from the end of the last one.
struct BudgetedSequence {
    budget: Duration,
    sequence: Mutex<Sequence>,
}

impl BudgetedSequence {
    fn reconstruct(
        &self,
        measurement: &Measurement,
        is_over: &(dyn Fn() -> bool + Sync),
    ) -> Result<Reconstruction> {
        let began = Instant::now();
        let mut sequence = self.sequence.lock().unwrap_or_else(PoisonError::into_inner);
        let found = sequence.reconstruct(measurement, &mut |_| {
            if is_over() {
                return ControlFlow::Break(StopReason::Interrupted);
            }
            if began.elapsed() > self.budget {
                ControlFlow::Break(StopReason::TimeBudget)
            } else {
                ControlFlow::Continue(())
            }
        })?;
        Ok(found.0)
    }
}

/// How each frame is reconstructed.
#[derive(Clone, Copy)]
struct FrameOptions<'b> {
    calibration: &'b RecordingCalibration,
    /// That of the calibration, which the run's cancellation stops.
    model: &'b Model,
    names: &'b (dyn Names + Sync),
    options: Options,
    tau_factor: f64,
}

fn archive_params(inputs: &BatchInputs, clock: Option<Clock>) -> ArchiveParams {
    let camera = inputs.model.camera();
    ArchiveParams {
        frames: inputs.frames.count(),
        video: camera.video_shape(),
        bin_us: camera.time().bin_duration_us(),
        first_bin_us: camera.time().start_us(),
        pixel_pitch_um: camera.sensor().pixel_pitch_um,
        field_offset: camera.field_offset(),
        frame_period_us: clock.map(|clock| clock.frame_period_us),
        frame_start_us: clock.map(|clock| clock.starts_us(&*inputs.frames)),
        attributes: json!({
            "version": inputs.version,
            "values": "light in counts per bin; frames that failed are NaN",
            "table": "rowburst/frames.csv",
            "frame_period_us": clock.map(|clock| clock.frame_period_us),
            "video_us": clock.map(|clock| clock.video_us),
            "dead_us": clock.map(|clock| clock.dead_us()),
        }),
    }
}
