//! The PSF of a diffuser from captures of a point source, and what it says about the
//! optics.
//!
//! ```text
//! captures ──merge──▶ Light ──suppress_noise──▶ light ≥ 0 ──placed──▶ Psf
//!                                       │
//!                                       ├─ statistics: contrast, grain, histogram
//!                                       ├─ ballistic_core: light that was not scattered
//!                                       └─ row_reach: rows that each part of the field reaches
//! captures at known places ──memory_effect──▶ shift per mm, correlation ──patch_set──▶ PatchSet
//! ```

mod ballistic;
mod envelope;
mod filter;
mod floor;
mod fourier;
mod memory;
mod merge;
mod place;
mod reach;
mod statistics;

pub use ballistic::{Core, ballistic_core};
pub use floor::{DenoisedLight, Floor, noise_of, suppress_noise};
pub use memory::{MemoryEffect, PositionedCapture, memory_effect};
pub use merge::{Light, MergeParams, Shot, merge};
pub use place::{centred_psfs, centroid, patch_set, patches_needed, select_patches, span_px};
pub use reach::{LEAST_REACH, Reach, row_reach};
pub use statistics::{BIN, Speckle, statistics};
