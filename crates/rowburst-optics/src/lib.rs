//! The optics of Rowburst: camera, shutter, PSF, and the forward model `b = A v` from a video to a frame.
//!
//! Equations are numbered as in the head of the crate `rowburst`, which users of the library need: it re-exports what
//! this one defines.

pub mod bayer;
pub mod camera;
pub mod forward;
pub mod image;
pub mod measurement;
pub mod patches;
pub mod psf;
pub mod shutter;
mod time;
pub mod video;

pub use camera::{Camera, CameraParams, Sensor, TimingChange};
pub use forward::RollingShutter;
pub use image::Image;
pub use measurement::{Corrections, Measurement, RawFrame};
pub use patches::PatchSet;
pub use psf::{Psf, PsfCapture};
pub use shutter::Shutter;
pub use time::{InstantWeights, TimeGrid};
pub use video::Video;
