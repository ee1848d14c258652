//! The events of a run, for progress bars, live pages and logs.

use rowburst::Camera;
use rowburst::bayer::Site;
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use std::ops::{ControlFlow, Range};

/// An event of a run.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub enum Event<'a> {
    /// A remark on the inputs for the user.
    Note(&'a str),
    /// The reconstruction of a plane of a raw colour frame begins.
    Plane(Site),
    /// An iteration is complete. The observer's answer may stop the run.
    Iteration {
        /// The state of the solver.
        progress: &'a Progress<'a>,
        /// Time, residual and PSNR.
        metrics: &'a IterationMetrics,
        /// The chunk that is being reconstructed; `None`: the whole video is.
        chunk: Option<&'a Chunk>,
    },
    /// A part of the trial reconstructions of a design is complete. The observer's answer may stop them.
    Trials {
        /// The camera of the trials.
        camera: &'a Camera,
        /// The part that is complete, from 0 to 1.
        part: f64,
    },
    /// The solver has finished and the files are being written.
    Writing,
}

/// Metrics of an iteration that [`crate::RunClock`] adds to those of the solver.
#[derive(Debug, Clone, Copy)]
pub struct IterationMetrics {
    /// Time of the solver so far, in seconds.
    pub seconds: f64,
    /// Root mean square of the weighted residual over `σ`.
    pub residual_over_sigma: f64,
    /// PSNR against the truth in dB, at the iterations that the convergence curve records; else `None`.
    pub psnr_db: Option<f64>,
}

/// A chunk of a video that is reconstructed in chunks.
#[derive(Debug, Clone)]
pub struct Chunk {
    /// Its bins.
    pub bins: Range<usize>,
    /// The number of bins of the whole video.
    pub video_bins: usize,
}

/// A callback for the events of a run. Its answer to [`Event::Iteration`] and [`Event::Trials`] may stop the run; its
/// other answers have no effect.
pub type Observer<'o> = &'o mut dyn FnMut(Event) -> ControlFlow<StopReason>;
