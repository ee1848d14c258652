//! The viewer: result folders as a page in the browser, served to this machine alone.
//!
//! ```text
//! folder, .npy ─▶ Opened (description + arrays read bin by bin) ─┐
//! solver ─▶ Live (latest video, course, stop) ───────────────────┼─▶ Server ─▶ page
//! camera ─▶ Monitor (latest frame, latest video, requests) ────────┤
//! page/ (made from web/) ────────────────────────────────────────┘
//! ```
//!
//! The server listens on 127.0.0.1, answers only requests whose `Host` is this machine, serves only
//! the files of a result that are named in [`result_files`], and sends a policy that lets the page fetch
//! from nowhere else. Videos travel as 16-bit numbers with their scale, some bins at a time, so that
//! a picture is seen long before the video is there.

mod array;
#[cfg(feature = "server")]
mod axes;
#[cfg(feature = "server")]
mod guard;
#[cfg(feature = "server")]
mod live;
#[cfg(feature = "server")]
mod monitor;
pub mod offline;
mod page;
#[cfg(feature = "server")]
pub mod result_files;
#[cfg(feature = "server")]
mod server;

pub use array::{Array, QuantisedBins, quantise8, range_of_video};
#[cfg(feature = "server")]
pub use axes::VideoAxes;
#[cfg(feature = "server")]
pub use live::{Live, LiveStart, ProgressPoint, RunStatus};
#[cfg(feature = "server")]
pub use monitor::{Monitor, MonitorRequest, MonitorStart};
pub use offline::Offline;
pub use page::{BUNDLE, Bundle};
#[cfg(feature = "server")]
pub use result_files::ResultFiles;
#[cfg(feature = "server")]
pub use server::Server;
