//! The state of a trial after its first iterations, from which the final run goes on.

use super::frame_data::{FrameData, RunState};
use super::held_out_check::HeldOutCheck;
use super::held_out_run::HeldOutRun;
use rowburst_solve::admm::Admm;
use rowburst_solve::prox::Prox;

/// Voxels of a video above which no run is copied; larger takes more memory and saves the repetition of a check.
const MAX_COPIED_VOXELS: usize = 1 << 22;

/// A copy of a run after as many iterations as a check of the model takes at least. The run itself goes on without the
/// held-out pixels.
pub(super) struct Checkpoint {
    pub run: HeldOutRun,
    state: RunState,
    /// How well it explains the frame.
    pub check: HeldOutCheck,
}

impl Checkpoint {
    /// A copy of `run`; `None` where the video is so large that it costs much memory.
    pub fn of(run: &HeldOutRun, data: &FrameData) -> Option<Self> {
        (data.shape().voxels() <= MAX_COPIED_VOXELS).then(|| Self {
            run: run.clone(),
            state: data.run_state(),
            check: HeldOutCheck::of(run, data),
        })
    }

    /// Goes on with all pixels.
    pub fn with_all_pixels(self, data: &mut FrameData) -> (Admm, Box<dyn Prox>) {
        self.run.resume_with_all_pixels(self.state, data)
    }
}
