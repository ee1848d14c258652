//! Zarr: recordings `[frame, y, x]` in, videos of many frames `[frame, t, y, x]` out.
//!
//! [`open_zarr_recording`] reads arrays of Zarr 2 and 3 and OME-Zarr images frame by frame.
//! [`VideoArchive`] writes OME-Zarr 0.5 (Zarr 3), [`write_video`] a single video. A file of an archive is whole or not there:
//! it is written to a [`Scratch`] folder and takes its name last, so a process that is killed
//! leaves nothing that is half done.

mod archive;
mod array;
mod image;
mod ome;
mod recording;
mod scratch;
mod store;

pub use archive::{ArchiveParams, StitchParams, StitchedVideo, VideoArchive};
pub use image::write_video;
pub use recording::{is_zarr, open_zarr_recording};
pub use scratch::{Lock, Scratch};
