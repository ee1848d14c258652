//! Scenes: videos of light in the object plane, in pixels of the sensor.
//!
//! Values lie between 0 and 1, and most pixels are zero: the scenes of the paper
//! are sparse. [`digits`] follows its Fig. 2, [`leds`] its Figs. 3 and 4,
//! [`moving_digit`] has the sub-pixel motion that a temporal prior is for, and
//! [`fit`] takes any video as a scene, [`add_background`] puts something static behind it, and [`dense`] has light
//! everywhere.

mod background;
mod dense;
mod digits;
mod fit;
mod glyph;
mod leds;

pub use background::{add_background, background};
pub use dense::{DenseScene, dense};
pub use digits::{digits, moving_digit};
pub use fit::fit;
pub use leds::{LED_FREQUENCIES_HZ, Led, leds};

use rowburst_core::{Error, Parameter, Result, Shape};

/// `Ok` where `shape` has at least one bin and `rows × columns` pixels.
fn require_field_size(shape: Shape, rows: usize, columns: usize, what: &str) -> Result<()> {
    if shape.bins >= 1 && shape.rows >= rows && shape.columns >= columns {
        return Ok(());
    }
    Err(Error::input(
        Parameter::Scene,
        format!("a video of {shape}"),
        format!("{what} needs at least 1 bin of {rows}×{columns} pixels"),
        "Take a larger field or a smaller scene.",
    ))
}
