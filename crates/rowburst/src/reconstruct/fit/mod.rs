//! Does the model fit? A verdict on a finished reconstruction, from its residual.
//!
//! Where camera, PSF and noise level are right, `r = W(b − A v)/σ` is white noise of width
//! 1, less the `df` values that the fit has chosen freely:
//!
//! ```text
//! χ² = Σ r² / (m − df) ≈ 1 ± √(2/(m − df))
//! ```
//!
//! `σ` does not come from the fit, so `χ²` may fail: it is given, calibrated, or read from
//! the frequencies that the optics do not pass. In that **noise band** no video can do
//! anything about the residual: its level there is the noise, whatever the model
//! (`noise_floor`; 1 if `σ` is right). All that a wrong model does lies in the band that the
//! optics pass (`passed_level`).
//!
//! | fault | told by |
//! |---|---|
//! | σ wrong | the noise band, even where the fit has followed the wrong σ |
//! | PSF of another diffuser, another distance, turned, with a background | `χ²` |
//! | rows paired or overlapped wrongly (shutter, exposure too long, frame moved along `y`) | `χ²`, where the scene changes |
//! | two rows an instant taken for one (dual for single) | a video that runs back and forth |
//! | light outside the field, support too tight, bad pixels and columns | `χ²` of few instants, columns, pixels |
//! | frame turned by 90° or transposed | finest detail along the rows rather than across them, where the scene changes |
//! | stopped early | few iterations, or a residual that still falls |
//! | pixels that hold no light of the scene | the noise band, or a solver that ran away |
//! | too few measurements to tell | `df/m` |
//!
//! **No residual can tell** what another video explains as well: time reversed
//! (`dual-inside-out` for `dual-outside-in`), a PSF or a camera moved by whole pixels (the
//! video moves along), the order of rows of which no two see the same bin, and an exposure
//! too short or up to a row wrong (the video is brighter, or blurred in time).
//!
//! Reference: W. H. Press et al., Numerical Recipes, 3rd ed. (2007), section 15.1, for
//! `χ²` as a test of a model; the noise band is that of `estimate_sigma`.

mod statistics;
mod verdict;

use super::sigma::Bands;
use super::{SigmaSource, StopReason};
use rowburst_optics::{Camera, Image, Shutter, Video};

/// Whether a video may be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Verdict {
    /// The residual is the noise that was expected.
    Good,
    /// Something is wrong, or cannot be tested.
    Suspicious,
    /// The model does not explain the frame.
    Bad,
}

impl Verdict {
    /// The word in `result.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Suspicious => "suspicious",
            Self::Bad => "bad",
        }
    }
}

/// The verdict with its reason and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// Whether the video may be trusted.
    pub verdict: Verdict,
    /// A plain sentence, without a full stop.
    pub reason: String,
    /// The numbers behind it.
    pub statistics: FitStatistics,
}

/// Numbers of a residual `r = W(b − A v)/σ`; see the module.
#[derive(Debug, Clone, PartialEq)]
pub struct FitStatistics {
    /// `Σ r² / (m − df)`, with `df` of at most 0.3 `m`; 1 for a good fit.
    pub chi_squared: f64,
    /// Standard deviation of `chi_squared` for a good fit, `√(2/(m − df))`.
    pub chi_squared_error: f64,
    /// `‖r‖ / ‖W b/σ‖`: a dark video leaves 1.
    pub residual_over_frame: f64,
    /// `df/m`: values that the fit has chosen freely over measurements.
    pub freedom: f64,
    /// Rms of `r` in the tenth of the horizontal frequencies that the optics pass least;
    /// 1 if `σ` is right. `None` where too few whole rows are there to measure it.
    pub noise_floor: Option<f64>,
    /// Standard error of `noise_floor` over itself.
    pub noise_floor_error: f64,
    /// Whether the PSF passes almost nothing at these frequencies; else `noise_floor` is an upper bound.
    pub noise_band_is_dark: bool,
    /// Rms of `r` in the quarter of the frequencies that they pass best; up to 1 for a
    /// good fit.
    pub passed_level: Option<f64>,
    /// Correlation of `r` with itself one pixel along `x`.
    pub correlation_x: f64,
    /// The same one row down.
    pub correlation_y: f64,
    /// Correlation of `r` with `W A v`; strong where an offset, a gain or a solver that ran
    /// away is behind the misfit.
    pub correlation_with_model: f64,
    /// Instants whose own `χ²` is higher than noise makes it, of how many.
    pub misfit_instants: (usize, usize),
    /// The instant with the highest `χ²`, and that.
    pub worst_instant: (usize, f64),
    /// Columns whose own `χ²` is higher than noise makes it, of how many.
    pub misfit_columns: (usize, usize),
    /// The column with the highest `χ²`, and that.
    pub worst_column: (usize, f64),
    /// `χ²` without the misfit instants, without the misfit columns, and without lone
    /// pixels beyond ±5.
    pub chi_squared_without: TrimmedChiSquared,
    /// Lone pixels beyond ±5.
    pub lone_pixels: usize,
    /// Residual at the end over that at four fifths of the iterations; below 1 where it
    /// still falls.
    pub residual_trend: f64,
    /// How much more alike bins are that lie mirrored about the middle of the time axis
    /// than others that far apart; `None` where instants read several rows.
    pub mirrored: Option<f64>,
    /// Level of the frame at the highest frequencies along `y` over that along `x`, without the means of rows and columns:
    /// 1 or more, since rows are read at different instants and the optics pass neither. `None` where the PSF passes
    /// the highest frequencies, and where there are too few whole rows or columns.
    pub fine_ratio: Option<f64>,
    /// Whether a wrong row order or exposure could show: bins are seen by several rows.
    pub tests_timing: bool,
}

/// `χ²` of what is left when the worst is taken away.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrimmedChiSquared {
    /// Without [`FitStatistics::misfit_instants`].
    pub instants: f64,
    /// Without [`FitStatistics::misfit_columns`].
    pub columns: f64,
    /// Without [`FitStatistics::lone_pixels`].
    pub pixels: f64,
}

/// What a verdict is made from.
pub(super) struct FitInput<'a> {
    /// `W(b − A v)/σ`, `[y, x]`.
    pub normalised_residual: &'a Image,
    /// `W b/σ`, `[y, x]`.
    pub measured: &'a [f32],
    /// `W`; 0 for pixels without information.
    pub weights: Option<&'a [f32]>,
    pub camera: &'a Camera,
    /// A shutter of another kind that explains the frame, which the camera's does not.
    pub other_shutter: Option<&'a Shutter>,
    pub bands: &'a Bands,
    pub video: &'a Video,
    /// `df` as the prior counts it.
    pub degrees_of_freedom: f64,
    /// See [`Tuning::max_freedom`](rowburst_solve::admm::Tuning::max_freedom).
    pub max_freedom: f64,
    /// Rms of the residual after each iteration.
    pub residual_history: &'a [f64],
    pub sigma: f64,
    /// Noise and error of the model together; `sigma` where the model was not checked or explains the frame, and where the frame
    /// sees too little of the scene to judge it.
    pub effective_sigma: f64,
    /// Held-out error over `sigma` where the frame sees too little of the scene to judge the model by it.
    pub undersampled_error: Option<f64>,
    /// Part of the pixels that were left out as foreign.
    pub excluded_fraction: f64,
    pub sigma_source: SigmaSource,
    pub tau_is_given: bool,
    pub stop_reason: StopReason,
    /// Part of the voxels that are active; 1 without a support.
    pub support_fraction: f64,
}

/// Judges a reconstruction.
pub(super) fn judge(evidence: &FitInput) -> Fit {
    let statistics = statistics::of(evidence);
    let (verdict, reason) = verdict::of(evidence, &statistics);
    Fit {
        verdict,
        reason,
        statistics,
    }
}

/// Whether a frame `W b/σ` with weights `W`, `[y, x]`, has its fine detail along the rows, where a shutter that reads row by
/// row leaves it across them: it is turned by 90° or transposed.
pub(super) fn is_turned(
    measured: &[f32],
    weights: Option<&[f32]>,
    camera: &Camera,
    bands: &Bands,
) -> bool {
    let ratio = statistics::fine_ratio_of_frame(measured, weights, camera, bands);
    ratio.is_some_and(|ratio| ratio < verdict::TURNED)
}
