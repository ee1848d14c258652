//! What every part of Rowburst is built on: errors, shapes, sets of voxels, vector arithmetic and linear operators.
//!
//! Users of the library need the crate `rowburst`, which re-exports what this one defines.

mod cancel;
pub mod error;
pub mod fft;
pub mod linop;
mod shape;
pub mod support;
pub mod vecmath;

pub use cancel::Cancel;
pub use error::{Error, ErrorKind, Parameter, Result};
pub use linop::LinearOperator;
pub use shape::Shape;
pub use support::Support;
