//! From a lab's own captures to a camera and a PSF that reconstruct well.
//!
//! Pure functions of images; reading and writing is the caller's.

pub mod psf;
pub mod sensor;
pub mod timing;
