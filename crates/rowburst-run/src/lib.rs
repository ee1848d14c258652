//! The application layer under command line, viewer and Python: load and check, reconstruct, write.
//!
//! ```text
//! files  ─▶ Request::read ─▶ Request ─▶ Request::run ─▶ Artifacts (result.json, video, report)
//! values ─▶ Setup, Frame ─▶ Task ─▶ solve ─▶ CompletedTask ─▶ Traces, numbers, report, folder
//! ```
//!
//! A [`Setup`] is what the frames of an experiment share, a [`Frame`] is one of them, and a [`Task`] is both, corrected
//! and checked. [`solve`] runs the solver and measures its time ([`RunClock`]). [`CompletedTask`] gives the numbers of
//! `result.json` ([`ReconstructionSummary`]), the report and the folder of results. A video too large for memory is a
//! [`ChunkedTask`], a raw colour frame a [`ColourTask`]; a [`Request`] is one of the three. [`inputs`] reads files,
//! [`options`] parses the options of the user, and [`simulate`] makes simulated captures.
//!
//! The crate parses no command line and writes nothing to the terminal. An [`Observer`] hears the [`Event`]s of a run and
//! may stop it.

mod artifacts;
mod borders;
pub mod calibrate;
mod check;
mod chunked;
mod chunked_summary;
mod cite;
mod colour;
mod colour_summary;
mod completed_task;
pub mod design;
mod event;
mod figure;
mod format;
mod formats;
mod guide;
pub mod inputs;
mod log;
mod memory;
mod movie;
mod numbers;
pub mod options;
mod plausibility;
mod player;
mod record;
mod record_of_request;
mod request;
mod run_clock;
mod schema;
mod setup;
pub mod simulate;
mod solve;
mod summary;
mod sweep;
mod task;
mod traces;
mod view_files;

pub use artifacts::{Artifacts, Output, Summary};
pub use check::{CheckItem, CheckParams, SetupCheck};
pub use chunked::{ChunkedTask, run_chunked};
pub use chunked_summary::{ChunkNumbers, ChunkedSummary};
pub use cite::cite;
pub use colour::{ColourFolder, ColourTask, Plane, merge_planes};
pub use colour_summary::{ColourSummary, PlaneNumbers};
pub use completed_task::{CompletedTask, ReportMeta};
pub use event::{Chunk, Event, IterationMetrics, Observer};
pub use figure::figure_of_folder;
pub use format::short;
pub use formats::VideoFormat;
pub use guide::{
    AffineNumbers, GuideNumbers, GuideOutcome, GuideTask, GuideTrialNumbers, PlaceNumbers,
    PlacesNumbers,
};
pub use log::{LogLevel, LogMessage, is_logging, set_log, set_log_level};
pub use memory::{available_memory_bytes, check_bytes, check_memory};
pub use movie::MovieStyle;
pub use numbers::thousands;
pub use plausibility::{check_camera, check_frame};
pub use player::{MakePlayer, PlayerPage, player_of};
pub use record::{CameraNumbers, FurtherFiles, InputFile, OptionNumbers, RunRecord};
pub use request::{Request, RequestParams, read_experiment};
pub use run_clock::RunClock;
pub use schema::{RESULT_SCHEMA, RESULT_SCHEMA_VERSION};
pub use setup::{Bias, Frame, Setup, bias_of_array, correct_capture};
pub use solve::{solve, solve_with_model};
pub use summary::{
    CalibrationNumbers, ChangeNumbers, FitNumbers, HistoryPoint, MetadataNumbers, PriorCandidate,
    PriorChoice, ReconstructionSummary, peak_memory_bytes,
};
pub use sweep::{SweepPoint, SweepRow, sweep_csv, sweep_label, sweep_lines, sweep_path};
pub use task::Task;
pub use traces::{
    DebiasNumbers, HarmonicNumbers, PhotodiodeNumbers, RegionNumbers, StandardErrorNumbers,
    TraceNumbers, TraceRequest, Traces, TruthNumbers,
};
pub use view_files::ViewFiles;
