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
//! [`reconstruct()`] makes the video of a corrected frame:
//!
//! ```
//! use rowburst::{Camera, CameraParams, Measurement, Options, Sensor, Shutter};
//! use rowburst::{noise::Noise, simulate, RollingShutter, LinearOperator, Image};
//!
//! let camera = Camera::new(CameraParams {
//!     rows: 24,
//!     columns: 24,
//!     shutter: Shutter::DualInsideOut,
//!     row_time_us: 9.6,
//!     exposure_us: 9.6,
//!     bins_per_row: 1,
//!     field: None,
//!     sensor: Sensor::default(),
//! })?;
//! // A frame of a moving digit, in place of one of your own.
//! let psf = simulate::speckle_psf(&simulate::SpeckleOptics::demo(), 47, 47, 1)?;
//! let truth = simulate::scene::moving_digit(camera.video_shape(), 12, 1, 1)?;
//! let mut light = vec![0.0; 24 * 24];
//! RollingShutter::<f32>::new(&camera, &psf).apply(truth.data(), &mut light);
//! let noise = Noise::Gaussian { snr: 256.0 };
//! let frame = noise.apply(&Image::new(24, 24, light)?, camera.sensor(), 1)?.frame;
//!
//! let frame = Measurement::new(frame)?;
//! let result = rowburst::reconstruct(&frame, &camera, &psf, &Options::default())?;
//! assert_eq!(result.video.shape(), camera.video_shape());
//! println!("{}: {}", result.fit.verdict.name(), result.fit.reason);
//! # Ok::<(), rowburst::Error>(())
//! ```
//!
//! [`RawFrame::correct`] corrects a raw frame; [`Problem`] shows each iteration and can be stopped; [`Sequence`] makes the
//! videos of consecutive frames, [`Chunked`] one that does not fit into memory. [`calibrate`] turns captures into the
//! values that these need.
//!
//! The library is pure: it touches no files, clock, terminal or global state.
//! Arrays are C order; a video is `[t, y, x]`, an image `[y, x]`, and `y` is the
//! axis that the shutter scans.

mod active_gram;
pub mod design;
pub mod guide;
pub mod reconstruct;
pub mod traces;

pub use reconstruct::{
    Chunked, Fit, Model, Options, Prior, Problem, Reconstruction, SelfCalibration, Sequence, Tau,
    Verdict,
};
#[doc(inline)]
pub use rowburst_calibrate as calibrate;
/// A token that cancels a run from another thread.
///
/// ```
/// let cancel = rowburst::Cancel::default();
/// let other = cancel.clone();
/// std::thread::spawn(move || other.cancel()).join().unwrap();
/// assert!(cancel.is_cancelled() && cancel.check().is_err());
/// ```
#[doc(inline)]
pub use rowburst_core::Cancel;
/// ```
/// use rowburst::{ErrorKind, Parameter, Psf, Image};
///
/// let error = Psf::new(Image::new(1, 2, vec![1.0, -1.0])?).unwrap_err();
/// assert_eq!(error.kind(), ErrorKind::Invalid);
/// assert_eq!(error.parameter(), Some(Parameter::Psf));
/// assert_eq!(error.value(), "-1 at row 0, column 1");
/// # Ok::<(), rowburst::Error>(())
/// ```
#[doc(inline)]
pub use rowburst_core::Error;
#[doc(inline)]
pub use rowburst_core::{
    ErrorKind, LinearOperator, Parameter, Result, Shape, Support, error, linop, phrase, vecmath,
};
/// ```
/// use rowburst::{Camera, CameraParams, Corrections, Image, RawFrame, Sensor, Shutter};
///
/// let camera = Camera::new(CameraParams {
///     rows: 4,
///     columns: 6,
///     shutter: Shutter::TopDown,
///     row_time_us: 9.6,
///     exposure_us: 9.6,
///     bins_per_row: 1,
///     field: None,
///     sensor: Sensor { bias_counts: Some(100.0), ..Sensor::default() },
/// })?;
/// let counts = Image::from_fn(4, 6, |y, x| 100.0 + (y * x) as f32);
/// let frame = RawFrame::new(counts).correct(&camera, &Corrections::default())?;
/// assert_eq!(frame.image().at(3, 5), 15.0);
/// # Ok::<(), rowburst::Error>(())
/// ```
#[doc(inline)]
pub use rowburst_optics::RawFrame;
#[doc(inline)]
pub use rowburst_optics::{
    Camera, CameraParams, Corrections, Image, InstantWeights, Measurement, PatchSet, Psf,
    PsfCapture, RollingShutter, Sensor, Shutter, TimeGrid, TimingChange, Video, bayer, camera,
    measurement,
};
#[doc(inline)]
pub use rowburst_simulate::{self as simulate, metrics, noise};
#[doc(inline)]
pub use rowburst_solve::{
    Certificate, StopReason,
    admm::{Progress, Tuning, VideoOfIteration},
};

use std::ops::ControlFlow;

/// The solver, as far as results and observers show it; the crate `rowburst-solve` has all of it.
pub mod solve {
    #[doc(inline)]
    pub use rowburst_solve::{
        Capabilities, Certificate, DataHints, DataTerm, FusedAdjoint, ProblemKind, StopReason, admm,
    };
}

/// The terms of priors and their proximal operators.
pub mod prox {
    #[doc(inline)]
    pub use rowburst_solve::prox::{Coupling, Prox, TERMS, TermSpec, Variation, VariationWeights};
}

/// Reconstructs the video `v[t, y, x]` of one corrected frame (Eqs. 4 and 5 in the head of the crate).
///
/// `psf` is one PSF for the whole field (`&Psf`) or one for each patch of it (`&PatchSet`). [`Problem`] does the same with
/// an observer that sees each iteration.
///
/// # Errors
/// A frame of another size than the sensor of `camera`, options that contradict the camera or are out of range, and
/// numbers that overflow.
pub fn reconstruct(
    frame: &Measurement,
    camera: &Camera,
    psf: impl Into<PatchSet>,
    options: &Options,
) -> Result<Reconstruction> {
    Problem::new(frame, camera, psf, *options)?.solve(&mut |_| ControlFlow::Continue(()))
}
