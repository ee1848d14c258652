//! Rolling-shutter compressive imaging.
//!
//! One frame `b` of a rolling-shutter camera behind a diffuser is turned into a
//! video `v[t, y, x]` (Weinberg & Katz, Opt. Express 28, 30616, 2020):
//!
//! ```text
//! I(x,y,t)   = O(x/M, y/M, t) ⊛ PSF                                 (Eq. 1)
//! I_cam(x,y) = ∫ I(x,y,t) dt over the exposure ending at t = y/V_s  (Eq. 2)
//! b = A v,     v̂ = argmin_{v≥0} ½‖W(b − A v)‖² + τ‖Ψ v‖₁             (Eqs. 4, 5)
//! ```
//!
//! The library is pure: it touches no files, clock, terminal or global state.
//! Arrays are C order; a video is `[t, y, x]`, an image `[y, x]`, and `y` is the
//! axis that the shutter scans.

pub mod bayer;
pub mod calibrate;
pub mod camera;
mod cancel;
pub mod design;
pub mod error;
mod fft2;
pub mod forward;
pub mod image;
pub mod linop;
pub mod measurement;
pub mod metrics;
pub mod noise;
pub mod patches;
pub mod prox;
pub mod psf;
pub mod reconstruct;
pub mod shape;
pub mod shutter;
pub mod simulate;
pub mod solve;
pub mod support;
pub mod traces;
pub mod vecmath;
pub mod video;

pub use camera::{Camera, Sensor};
pub use cancel::Cancel;
pub use error::{Error, ErrorKind, Parameter, Result};
pub use forward::RollingShutter;
pub use image::Image;
pub use patches::PatchSet;
pub use psf::Psf;
pub use shape::{Shape, TimeGrid};
pub use shutter::Shutter;
pub use support::Support;
pub use video::Video;
