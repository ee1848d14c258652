//! The PSF of a diffuser from captures of a point source, and what it says about the
//! optics.
//!
//! ```text
//! captures ──merge──▶ PointSourceImage ──without_pinhole, suppress_noise──▶ light ≥ 0 ──centred_psfs──▶ Psf
//!                                       │
//!                                       ├─ statistics: contrast, grain, histogram
//!                                       ├─ ballistic_core: light that was not scattered
//!                                       └─ row_reach: rows that each part of the field reaches
//! captures at known places ──memory_effect──▶ shift per mm, correlation ──patch_set──▶ PatchSet
//! ```

mod ballistic;
mod black_level;
mod envelope;
mod filter;
mod fourier;
mod memory;
mod merge;
mod pinhole;
mod place;
mod power;
mod reach;
mod statistics;

pub use ballistic::{Core, ballistic_core};
pub use black_level::{BlackLevel, DenoisedLight, even_floor, noise_of, suppress_noise};
pub use memory::{MemoryEffect, PositionedCapture, memory_effect};
pub use merge::{MergeParams, NamedCapture, PointSourceImage, merge};
pub use pinhole::{SharpenedCapture, pinhole_inverse, pinhole_transfer, without_pinhole};
pub use place::{centred_psfs, centroid, patch_set, patches_needed, select_patches, span_px};
pub use power::{CaptureSpectrum, PaddedFft};
pub use reach::{MIN_REACH, Reach, row_reach};
pub use statistics::{HISTOGRAM_BIN_WIDTH, SpeckleStatistics, statistics};
