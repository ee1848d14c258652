//! The parameters of PSF and camera that a frame can tell.

use rowburst_optics::{Camera, TimingChange};
use std::fmt;
use std::ops::{Index, IndexMut};

/// A parameter of the PSF or of the camera that self-calibration finds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ModelParameter {
    /// Size of the PSF over that of its capture, less 1.
    Scale,
    /// Rotation of the PSF against its capture, in degrees.
    Rotation,
    /// Part by which the PSF is larger along y and smaller along x than its capture.
    Anisotropy,
    /// Shear of the PSF against its capture.
    Shear,
    /// Variance of a Gaussian blur of the PSF against its capture, in pixels²; negative: the capture is blurred.
    Blur,
    /// Even light under the captured PSF, over its mean.
    Floor,
    /// Even stray light, over the mean of the frame.
    Offset,
    /// Stray light that rises along x, at the edge, over the mean of the frame.
    SlopeX,
    /// Stray light that rises along y, at the edge, over the mean of the frame.
    SlopeY,
    /// Gain at the corners of the frame over that at its centre, less 1; it changes with the square of the distance.
    Vignetting,
    /// Gain of the lower half of a dual shutter less that of the upper half, over their mean.
    HalfGain,
    /// By how many row times the exposure of each row is longer than given, where that is longer than a row.
    Exposure,
    /// By how many row times the lower half of a dual shutter is read later than the upper half.
    HalfDelay,
}

/// Largest change of the exposure over it.
const MAX_EXPOSURE_CHANGE: f64 = 0.5;
/// Largest delay of a half, in row times.
const MAX_DELAY: f64 = 2.0;
/// Number of parameters.
pub(super) const COUNT: usize = ModelParameter::ALL.len();

impl ModelParameter {
    /// All of them.
    pub const ALL: [Self; 13] = [
        Self::Scale,
        Self::Rotation,
        Self::Anisotropy,
        Self::Shear,
        Self::Blur,
        Self::Floor,
        Self::Offset,
        Self::SlopeX,
        Self::SlopeY,
        Self::Vignetting,
        Self::HalfGain,
        Self::Exposure,
        Self::HalfDelay,
    ];

    /// Its name in `result.json`, with the unit.
    pub fn name(self) -> &'static str {
        self.properties().0
    }

    /// The change of a camera's timing by parameters with these values.
    pub fn timing(value: impl Fn(Self) -> f64) -> TimingChange {
        TimingChange {
            exposure_rows: value(Self::Exposure),
            half_delay_rows: value(Self::HalfDelay),
        }
    }

    /// Standard deviation of its prior: larger values are not plausible.
    pub(super) fn prior_width(self) -> f64 {
        self.properties().1
    }

    /// Step of a numerical derivative.
    pub(super) fn step(self) -> f64 {
        self.properties().2
    }

    /// Magnitude below which a correction without it may be as good.
    pub(super) fn negligible(self) -> f64 {
        self.properties().3
    }

    fn properties(self) -> (&'static str, f64, f64, f64) {
        match self {
            Self::Scale => ("scale", 0.01, 5e-4, 1e-3),
            Self::Rotation => ("rotation_deg", 0.5, 0.03, 0.05),
            Self::Anisotropy => ("anisotropy", 0.005, 5e-4, 1e-3),
            Self::Shear => ("shear", 0.005, 5e-4, 1e-3),
            Self::Blur => ("blur_px2", 0.25, 0.02, 0.03),
            Self::Floor => ("floor", 0.3, 0.01, 0.1),
            Self::Offset => ("stray_light", 0.05, 0.01, 0.025),
            Self::SlopeX => ("stray_light_slope_x", 0.02, 0.01, 0.004),
            Self::SlopeY => ("stray_light_slope_y", 0.02, 0.01, 0.004),
            Self::Vignetting => ("vignetting", 0.2, 0.01, 0.02),
            Self::HalfGain => ("half_gain", 0.05, 0.01, 2e-3),
            Self::Exposure => ("exposure_rows", 0.3, 0.02, 0.02),
            Self::HalfDelay => ("half_delay_rows", 0.2, 0.02, 0.04),
        }
    }

    /// Whether it changes when rows see the scene.
    pub(super) fn is_of_timing(self) -> bool {
        matches!(self, Self::Exposure | Self::HalfDelay)
    }

    /// Whether the frames of `camera` can tell it.
    pub(super) fn applies_to(self, camera: &Camera) -> bool {
        match self {
            Self::HalfGain | Self::HalfDelay => camera.shutter().is_dual(),
            Self::Exposure => !camera.time().is_disjoint(),
            _ => true,
        }
    }

    /// Whether it changes the PSF.
    pub(super) fn is_of_psf(self) -> bool {
        matches!(
            self,
            Self::Scale
                | Self::Rotation
                | Self::Anisotropy
                | Self::Shear
                | Self::Blur
                | Self::Floor
        )
    }
}

/// A value for each parameter; all zero: PSF and camera are as given.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Parameters([f64; COUNT]);

impl Parameters {
    /// What they change of the camera's timing.
    pub(super) fn timing(&self) -> TimingChange {
        ModelParameter::timing(|parameter| self[parameter])
    }

    /// Sets changes of the timing that are negligible to zero: the halves of a dual shutter share bins where one is later, and
    /// reconstructions then take many times as long.
    pub(super) fn drop_negligible_timing(&mut self) {
        for parameter in ModelParameter::ALL {
            if parameter.is_of_timing() && self[parameter].abs() <= parameter.negligible() {
                self[parameter] = 0.0;
            }
        }
    }

    /// Sets all changes of the timing to zero.
    pub(super) fn drop_timing(&mut self) {
        for parameter in ModelParameter::ALL {
            if parameter.is_of_timing() {
                self[parameter] = 0.0;
            }
        }
    }

    /// Changes `parameter` of `camera`; changes of the timing stay plausible.
    pub(super) fn add(&mut self, parameter: ModelParameter, change: f64, camera: &Camera) {
        let most = match parameter {
            ModelParameter::Exposure => MAX_EXPOSURE_CHANGE * camera.exposure_rows(),
            ModelParameter::HalfDelay => MAX_DELAY,
            _ => f64::INFINITY,
        };
        self[parameter] = (self[parameter] + change).clamp(-most, most);
    }

    /// Whether the PSF is not on the pixels of its capture.
    pub(super) fn moves_psf(&self) -> bool {
        use ModelParameter::{Anisotropy, Blur, Rotation, Scale, Shear};
        [Scale, Rotation, Anisotropy, Shear, Blur]
            .iter()
            .any(|p| self[*p] != 0.0)
    }
}

impl fmt::Display for Parameters {
    /// Those that are not zero.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let found = ModelParameter::ALL.into_iter();
        let mut found = found.filter(|p| self[*p] != 0.0);
        found.try_for_each(|p| write!(f, "{} {:.5} ", p.name(), self[p]))
    }
}

impl Index<ModelParameter> for Parameters {
    type Output = f64;

    fn index(&self, parameter: ModelParameter) -> &f64 {
        &self.0[parameter as usize]
    }
}

impl IndexMut<ModelParameter> for Parameters {
    fn index_mut(&mut self, parameter: ModelParameter) -> &mut f64 {
        &mut self.0[parameter as usize]
    }
}
