//! One reconstruction as a user meets it, from the command line or from Python.
//!
//! ```text
//! Task (camera, PSF, measurement, recipe, …) ─▶ solve ─▶ Solved ─▶ traces, Outcome, page, folder
//! ```
//!
//! Reads the files of an experiment into values ([`inputs`]), what is typed into choices
//! ([`options`]), runs the solver with a clock beside it ([`RunClock`]), and turns what it found into
//! the numbers of `result.json`, the report and the folder of results. No terminal: what is to be
//! said goes to the caller, and an observer sees every iteration and may stop it.

mod chunked;
mod completed_task;
pub mod inputs;
mod movie;
mod numbers;
pub mod options;
mod player;
pub mod simulate;
mod summary;
mod task;
mod traces;
mod view_files;
mod watch;

pub use chunked::{ChunkNumbers, ChunkedSummary, ChunkedTask, run_chunked};
pub use completed_task::{CompletedTask, ReportMeta, ResultMeta};
pub use movie::MovieStyle;
pub use numbers::thousands;
pub use player::{MakePlayer, PlayerPage, player_of};
pub use summary::{
    FitNumbers, HistoryPoint, MetadataNumbers, PriorCandidate, PriorChoice, ReconstructionSummary,
    peak_memory_bytes, short,
};
pub use task::{IterationMetrics, Task, solve};
pub use traces::{
    DebiasNumbers, ErrorNumbers, HarmonicNumbers, PhotodiodeNumbers, RegionNumbers, TraceNumbers,
    TraceRequest, Traces, TruthNumbers,
};
pub use view_files::ViewFiles;
pub use watch::RunClock;
