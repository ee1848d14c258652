//! Simulation: what a lab would record, made from optics, a scene and a seed.
//!
//! [`speckle`] makes the PSF from the optics, [`scene`] the light in the object
//! plane, [`direct_frame`] the frame of the same camera without the diffuser.
//! The frame with the diffuser is the forward operator applied to a scene, and
//! [`noise`] adds what the sensor adds. Every random number comes from a
//! seed that the caller gives: the same seed gives the same result.
//!
//! Reference: G. Weinberg and O. Katz, Opt. Express 28, 30616 (2020).

mod direct;
mod light;
pub mod metrics;
pub mod noise;
pub mod scene;
pub mod speckle;

pub use direct::direct_frame;
pub use light::peak_electrons;
pub use speckle::{Aperture, SpeckleOptics, phase_plate_psf, speckle_psf};

use rowburst_core::{Error, Parameter, Result};

/// `Ok` where `value` is a finite number above zero.
fn require_positive(
    parameter: Parameter,
    value: f64,
    unit: &str,
    remedy: &'static str,
) -> Result<()> {
    if value.is_finite() && value > 0.0 {
        return Ok(());
    }
    let rule = format!("a number of {unit} above zero is needed");
    Err(Error::input(parameter, value, rule, remedy))
}
