//! The application layer of one reconstruction, for the command line and for Python.
//!
//! ```text
//! Task (camera, PSFs, measurement, options, …)
//!   ─▶ solve ─▶ CompletedTask ─▶ Traces, ReconstructionSummary, report, result folder
//! ```
//!
//! [`inputs`] reads the files of an experiment, and [`options`] parses the options of the user.
//! [`solve`] runs the solver and measures its time ([`RunClock`]). [`CompletedTask`] gives the numbers of
//! `result.json` ([`ReconstructionSummary`]), the report and the folder of results. [`run_chunked`] does
//! the same for a video too large for memory, and [`simulate`] makes simulated captures.
//!
//! The crate writes nothing to the terminal. Messages are return values, and an observer is called after
//! every iteration and may stop the run.

pub mod calibrate;
mod chunked;
mod colour;
mod completed_task;
pub mod design;
mod figure;
mod format;
pub mod inputs;
mod log;
mod memory;
mod movie;
mod numbers;
pub mod options;
mod player;
mod run_clock;
mod schema;
pub mod simulate;
mod summary;
mod task;
mod traces;
mod view_files;

pub use chunked::{ChunkNumbers, ChunkedSummary, ChunkedTask, run_chunked};
pub use colour::{ColourInputs, ColourSummary, Plane, PlaneSummary, check_raw_frame, merge_planes};
pub use completed_task::{CompletedTask, ReportMeta, ResultMeta};
pub use figure::figure_of_folder;
pub use format::short;
pub use log::{LogLevel, LogMessage, is_logging, set_log, set_log_level};
pub use memory::available_memory_bytes;
pub use movie::MovieStyle;
pub use numbers::thousands;
pub use player::{MakePlayer, PlayerPage, player_of};
pub use run_clock::RunClock;
pub use schema::{RESULT_SCHEMA, RESULT_SCHEMA_VERSION};
pub use summary::{
    CalibrationNumbers, FitNumbers, HistoryPoint, MetadataNumbers, PriorCandidate, PriorChoice,
    ReconstructionSummary, peak_memory_bytes,
};
pub use task::{IterationMetrics, Observer, Task, solve, solve_with_model};
pub use traces::{
    DebiasNumbers, HarmonicNumbers, PhotodiodeNumbers, RegionNumbers, StandardErrorNumbers,
    TraceNumbers, TraceRequest, Traces, TruthNumbers,
};
pub use view_files::ViewFiles;
