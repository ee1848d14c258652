//! A recording of many frames to one archive of videos, as a job that can be taken up again.
//!
//! ```text
//! BatchInputs (model, corrections, options, frames) ─▶ Batch::open ─▶ Batch::run ─▶ write_table, stitch
//! ```
//!
//! **What is on disk** (`OUT.zarr/rowburst`): `job.json`, what the job was begun with; `prior.json`,
//! the prior that was chosen for all frames; `calibration.json`, the correction of PSF and camera that
//! was found for all frames, with its arrays; `frames/NNNNNN.json`, a line of the table for each
//! frame that is through; `frames.csv`, all lines. Every file is whole or not there. A frame's line
//! is written after its video, so a frame with a line is done, and one without is done (again).
//! Frames do not know of each other: what is in the archive does not depend on the order of the
//! frames, on the number of threads, or on how often the job was killed.
//!
//! **Several processes** may work on parts of one job at once, on one machine or on several that
//! share a disk. On the command line a process claims its range of frames ([`Batch::claim`]), and another one is
//! refused. Two that are given the same frame without a claim both do it, and the same is written.
//!
//! **No warm start**: a frame does not start from the result of its neighbour, see `docs/design/014`.

mod allocation;
mod calibration;
mod choice;
mod claim;
mod clock;
mod files;
mod identity;
mod inputs;
mod measurement;
mod run;
mod state;
mod stitch;
mod table;

pub use allocation::ThreadAllocation;
pub use choice::ChosenPrior;
pub use claim::Claim;
pub use clock::Clock;
pub use files::{BatchFiles, LoadedBatch, load_batch, name_correction_file};
pub use inputs::BatchInputs;
pub use measurement::is_of_correction;
pub use run::{Batch, Event, RetryPolicy};
pub use table::{FrameRow, Status};
