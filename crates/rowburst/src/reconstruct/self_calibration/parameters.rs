//! The parameters of PSF and camera that a frame can tell.

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
}

/// Number of parameters.
pub(super) const COUNT: usize = ModelParameter::ALL.len();

impl ModelParameter {
    /// All of them.
    pub const ALL: [Self; 10] = [
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
    ];

    /// Its name in `result.json`, with the unit.
    pub fn name(self) -> &'static str {
        self.properties().0
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
        }
    }

    /// Whether it changes the PSF, and not the pixels.
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
    /// Whether the PSF is not on the pixels of its capture.
    pub(super) fn moves_psf(&self) -> bool {
        use ModelParameter::{Anisotropy, Blur, Rotation, Scale, Shear};
        [Scale, Rotation, Anisotropy, Shear, Blur]
            .iter()
            .any(|p| self[*p] != 0.0)
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
