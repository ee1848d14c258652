//! A reconstruction that is running: the latest video, its course, and the wish to stop it.
//!
//! The solver's observer writes, the server's threads read. A video is made ready to be sent only
//! when a page has asked since the last one, so a run that nobody watches costs nothing.

use crate::VideoAxes;
use crate::array::QuantisedBins;
use axum::body::Bytes;
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What is known before the first iteration.
#[derive(Debug, Clone)]
pub struct LiveStart {
    /// Title of the page.
    pub title: String,
    /// Bins, rows and columns of the video.
    pub shape: [usize; 3],
    /// Units of the axes.
    pub axes: VideoAxes,
}

/// A point of the course.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProgressPoint {
    /// Of this run.
    pub iteration: usize,
    /// Most that this run may take.
    pub max_iterations: usize,
    /// Since the start.
    pub seconds: f64,
    /// Root mean square of the residual over σ.
    pub residual_over_sigma: f64,
    /// Against the truth.
    pub psnr_db: Option<f64>,
}

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunStatus {
    /// Set-up or iterations.
    Running,
    /// The result is being written.
    Writing,
    /// The result is there.
    Done,
    /// There will be none.
    Failed,
}

/// A running reconstruction as the page sees it.
pub struct Live {
    start: LiveStart,
    stop: Arc<AtomicBool>,
    video_requested: AtomicBool,
    state: Mutex<LiveState>,
}

struct LiveState {
    status: RunStatus,
    label: String,
    history: Vec<ProgressPoint>,
    latest: Option<ProgressPoint>,
    snapshot: usize,
    /// 16-bit numbers and their range, shared with the answers that are under way.
    video: Option<(Bytes, (f32, f32))>,
    error: Option<String>,
}

impl Live {
    /// `stop` is set when the page asks for the end; the observer has to see it.
    pub fn new(start: LiveStart, stop: Arc<AtomicBool>) -> Self {
        Self {
            start,
            stop,
            video_requested: AtomicBool::new(false),
            state: Mutex::new(LiveState {
                status: RunStatus::Running,
                label: String::new(),
                history: Vec::new(),
                latest: None,
                snapshot: 0,
                video: None,
                error: None,
            }),
        }
    }

    /// Adds a point of the course, to be called in every iteration; iteration 1 begins a new one.
    pub fn point(&self, label: &str, point: ProgressPoint) {
        let mut state = self.lock_state();
        if point.iteration == 1 {
            state.history.clear();
        }
        state.label.clear();
        state.label.push_str(label);
        state.latest = Some(point);
        state.history.push(point);
    }

    /// Whether a page waits for a video.
    pub fn is_video_requested(&self) -> bool {
        self.video_requested.load(Ordering::Relaxed)
    }

    /// Shows `video`, `[t, y, x]`.
    ///
    /// # Panics
    /// If it has not the shape that was announced.
    pub fn show(&self, video: &[f32]) {
        let voxels: usize = self.start.shape.iter().product();
        assert_eq!(video.len(), voxels, "the shape that was announced");
        let QuantisedBins { bytes, range } = QuantisedBins::of(video);
        self.video_requested.store(false, Ordering::Relaxed);
        let mut state = self.lock_state();
        state.video = Some((bytes.into(), range));
        state.snapshot += 1;
    }

    /// From now on the run is at `status`.
    pub fn set_status(&self, status: RunStatus) {
        self.lock_state().status = status;
    }

    /// The run has failed.
    pub fn fail(&self, error: &str) {
        let mut state = self.lock_state();
        state.status = RunStatus::Failed;
        state.error = Some(error.into());
    }

    /// How far the run is.
    pub fn status(&self) -> RunStatus {
        self.lock_state().status
    }

    /// Asks the run to stop and keep the best so far.
    pub(crate) fn ask_to_stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Everything but the video; a page that asks waits for a video, too.
    pub(crate) fn state(&self) -> Value {
        self.video_requested.store(true, Ordering::Relaxed);
        let state = self.lock_state();
        let stopping = self.stop.load(Ordering::Relaxed);
        let status = match state.status {
            RunStatus::Running if stopping => "stopping",
            RunStatus::Running => "running",
            RunStatus::Writing => "writing",
            RunStatus::Done => "done",
            RunStatus::Failed => "failed",
        };
        let history = state.history.iter();
        let history = history.map(|p| (p.iteration, p.seconds, p.residual_over_sigma, p.psnr_db));
        json!({
            "stage": status,
            "label": state.label,
            "iteration": state.latest.map(|p| p.iteration),
            "max_iterations": state.latest.map(|p| p.max_iterations),
            "seconds": state.latest.map(|p| p.seconds),
            "course": history.collect::<Vec<_>>(),
            "snapshot": state.snapshot,
            "error": state.error,
        })
    }

    /// The video that was shown last, and its range.
    pub(crate) fn video(&self) -> Option<(Bytes, (f32, f32))> {
        self.lock_state().video.clone()
    }

    /// As that of a result, before there is one.
    pub(crate) fn meta(&self) -> Value {
        json!({
            "name": self.start.title, "images": {}, "files": [], "ranges": {},
            "shape": self.start.shape, "bin_duration_us": self.start.axes.bin_duration_us,
            "view": self.start.axes.view(&self.start.title),
            "result": null,
        })
    }

    // What is behind the lock is whole after every statement.
    fn lock_state(&self) -> MutexGuard<'_, LiveState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
