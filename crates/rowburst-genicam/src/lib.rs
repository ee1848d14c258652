//! Cameras on the network (GigE Vision, GenICam) as sources of frames.
//!
//! ```text
//! genicam:ADDRESS   asks this address alone
//! genicam:SERIAL    asks the networks of this machine for the camera with this serial number or name
//! ```
//!
//! Features of the camera are the settings, under their GenICam names. GenICam has no row time: it is measured
//! (`rowburst calibrate timing`). Nothing is sent before a source is opened or cameras are listed.
//!
//! Tried on Aravis' fake camera alone.

mod camera;
mod delivery;
mod features;

pub use camera::GenicamCamera;

use rowburst::Result;
use rowburst_capture::{Driver, Source};

/// The sources `genicam:…`.
pub const DRIVER: Driver = Driver {
    scheme: "genicam",
    open: open_boxed,
    list: camera::list,
};

fn open_boxed(address: &str) -> Result<Box<dyn Source>> {
    Ok(Box::new(GenicamCamera::open(address)?))
}
