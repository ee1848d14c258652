//! Traces: the light of a place over time, with error bars.
//!
//! The value of a voxel in the video is pulled by the prior, and nobody knows how far. Here the
//! lit voxels are estimated anew from the frame, under a prior whose two numbers come from the
//! frame too, so that the estimate has a covariance that means something ([`Refit`]). A
//! [`Trace`] is the mean over a [`Region`] with its standard error in every bin; a
//! [`Frequency`] is what repeats in it, with its error; a [`Photodiode`] is the same light seen
//! by another detector.

mod frequency;
mod kernel;
mod photodiode;
mod posterior;
mod refit;
mod region;
mod spot;
mod tone;

pub use frequency::{AliasedHarmonic, Frequency, frequency_of};
pub use photodiode::{Alignment, Photodiode};
pub use refit::{DebiasedVideo, Place, Refit, RefitInput};
pub use region::{Region, Trace};
pub use spot::{Spot, brightest_regions, brightest_spots};
pub use tone::{Tone, strongest_tone};
