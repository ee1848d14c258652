//! Speckle PSFs by scalar diffraction, from what a lab knows of its optics.
//!
//! A point source lights a circular pupil of diameter `D` that a diffuser covers;
//! a lens brings the light to the sensor at distance `z` (its focal plane, or the
//! image plane at `z = f(1 + M)`). The diffuser is a phase screen `φ` with a
//! Gaussian autocorrelation, `⟨φφ'⟩ = σ_φ² exp(−r²/ℓ²)`, so strong that no light
//! passes it unscattered. In the Fraunhofer approximation the PSF is
//!
//! ```text
//! p(x) = |∫ P(u) exp(iφ(u)) exp(−2πi x·u/(λz)) du|²  ⊛  pixel
//! ```
//!
//! - Grain: the autocorrelation of the intensity is that of the Airy disc,
//!   `|2 J₁(v)/v|²` with `v = πDr/(λz)`. **Grain** here means `λz/D`; the full
//!   width at half maximum of the autocorrelation is 1.029 of it.
//! - Envelope: the slopes of the screen are Gaussian with variance `2σ_φ²/ℓ²`, so
//!   the mean intensity is a Gaussian; `ℓ` is chosen so that its full width at
//!   half maximum is `2 z tan(θ/2)` for a diffuser of angle `θ`.
//! - Statistics: the intensity before the pixels is fully developed speckle:
//!   negative exponential, contrast 1. Pixels lower it where grains are small.
//!
//! The model is scalar, paraxial and isoplanatic (one PSF for the field).
//!
//! Reference: J. W. Goodman, Speckle Phenomena in Optics, 2nd ed. (SPIE 2020),
//! chapters 3 to 5.

mod diffraction;

use super::require_positive;
use diffraction::{Grid, RMS_PHASE};
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::{Image, Psf};

/// Wavelengths in nm that sensors see, X-rays and thermal radiation excluded.
const MIN_WAVELENGTH_NM: f64 = 50.0;
const MAX_WAVELENGTH_NM: f64 = 30_000.0;

/// The opening that bounds the light: its size seen from the sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aperture {
    /// A pupil at a known distance in front of the sensor.
    Pupil {
        /// Diameter in millimetres.
        diameter_mm: f64,
        /// Distance from the pupil to the sensor in millimetres.
        image_distance_mm: f64,
    },
    /// A numerical aperture on the side of the sensor.
    ImageNa {
        /// `D/(2z)`, from 0 to 1.
        na: f64,
        /// Distance from the diffuser to the sensor in millimetres.
        image_distance_mm: f64,
    },
    /// A pupil at a lens that images with a known magnification.
    Lens {
        /// Diameter of the pupil in millimetres.
        diameter_mm: f64,
        /// Focal length in millimetres.
        focal_length_mm: f64,
        /// Size of the image over size of the object; 0 for a far object.
        magnification: f64,
    },
}

impl Aperture {
    /// Distance `z` from the pupil to the sensor in millimetres; `f(1 + M)` for a lens.
    pub fn image_distance_mm(&self) -> f64 {
        match *self {
            Self::Pupil {
                image_distance_mm, ..
            }
            | Self::ImageNa {
                image_distance_mm, ..
            } => image_distance_mm,
            Self::Lens {
                focal_length_mm,
                magnification,
                ..
            } => focal_length_mm * (1.0 + magnification),
        }
    }

    /// Numerical aperture on the side of the sensor, `D/(2z)` (paraxial).
    pub fn na(&self) -> f64 {
        match *self {
            Self::ImageNa { na, .. } => na,
            Self::Pupil { diameter_mm, .. } | Self::Lens { diameter_mm, .. } => {
                diameter_mm / (2.0 * self.image_distance_mm())
            }
        }
    }

    fn check(&self) -> Result<()> {
        match *self {
            Self::Pupil { diameter_mm, .. } => {
                require_positive(Parameter::DiameterMm, diameter_mm, "millimetres", PUPIL)?;
            }
            Self::ImageNa { na, .. } => {
                require_positive(Parameter::Na, na, "numerical aperture", PUPIL)?;
            }
            Self::Lens {
                diameter_mm,
                focal_length_mm,
                magnification,
            } => {
                require_positive(Parameter::DiameterMm, diameter_mm, "millimetres", PUPIL)?;
                require_positive(
                    Parameter::FocalLengthMm,
                    focal_length_mm,
                    "millimetres",
                    DISTANCE,
                )?;
                if !(magnification.is_finite() && magnification >= 0.0) {
                    return Err(Error::input(
                        Parameter::Magnification,
                        magnification,
                        "a magnification is zero or more",
                        "Give the size of the image over the size of the object; 0 for a far object.",
                    ));
                }
            }
        }
        let distance = self.image_distance_mm();
        require_positive(
            Parameter::ImageDistanceMm,
            distance,
            "millimetres",
            DISTANCE,
        )?;
        let na = self.na();
        if na >= 1.0 {
            return Err(Error::input(
                Parameter::Aperture,
                format!("an image-side numerical aperture of {na:.3}"),
                "a numerical aperture in air is below 1",
                "Check that pupil diameter and distance have the same unit; stop the pupil down.",
            ));
        }
        Ok(())
    }
}

const PUPIL: &str = "Measure the opening that bounds the light at the diffuser.";
const DISTANCE: &str = "Measure the distance from the diffuser or lens to the sensor.";

/// The optics of a speckle PSF.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpeckleOptics {
    /// Wavelength in nanometres.
    pub wavelength_nm: f64,
    /// The opening at the diffuser.
    pub aperture: Aperture,
    /// Full scattering angle of the diffuser at half maximum, in degrees.
    pub diffuser_fwhm_deg: f64,
    /// Pitch of the pixels of the PSF, in micrometres.
    pub pixel_pitch_um: f64,
}

impl Default for SpeckleOptics {
    fn default() -> Self {
        Self::demo()
    }
}

impl SpeckleOptics {
    /// Optics of the size of the paper's, for a sensor of 108×108 pixels.
    ///
    /// Green light and the 6.5 µm pixels of the paper's camera; a 50 mm lens at its
    /// ×22.5 demagnification, so `z` = 52.2 mm; a diffuser of 1°, a common grade,
    /// gives an envelope of 140 px, so that light from any place in the field reaches
    /// most rows; a pupil of 1.71 mm gives grains of 2.5 px, the finest that the
    /// pixels still sample (two a grain) with some room.
    pub fn demo() -> Self {
        Self {
            wavelength_nm: 532.0,
            aperture: Aperture::Lens {
                diameter_mm: 1.71,
                focal_length_mm: 50.0,
                magnification: 1.0 / 22.5,
            },
            diffuser_fwhm_deg: 1.0,
            pixel_pitch_um: 6.5,
        }
    }

    /// Speckle grain `λz/D` in pixels.
    pub fn grain_px(&self) -> f64 {
        self.wavelength_nm * 1e-3 / (2.0 * self.aperture.na()) / self.pixel_pitch_um
    }

    /// Full width at half maximum of the envelope, `2 z tan(θ/2)`, in pixels.
    pub fn envelope_fwhm_px(&self) -> f64 {
        let half_angle = (0.5 * self.diffuser_fwhm_deg).to_radians();
        2.0e3 * self.aperture.image_distance_mm() * half_angle.tan() / self.pixel_pitch_um
    }

    /// The same optics with a diffuser whose envelope has another width, in pixels.
    #[must_use]
    pub fn with_envelope(self, fwhm_px: f64) -> Self {
        let width_mm = fwhm_px * self.pixel_pitch_um * 1e-3;
        let half_angle = (0.5 * width_mm / self.aperture.image_distance_mm()).atan();
        Self {
            diffuser_fwhm_deg: 2.0 * half_angle.to_degrees(),
            ..self
        }
    }

    /// Refuses a wavelength that is in another unit.
    fn check_wavelength(&self) -> Result<()> {
        let wavelength = self.wavelength_nm;
        if (MIN_WAVELENGTH_NM..=MAX_WAVELENGTH_NM).contains(&wavelength) {
            return Ok(());
        }
        let (unit, factor) = if wavelength < 1e-3 {
            ("metres", 1e9)
        } else {
            ("micrometres", 1e3)
        };
        let remedy = if wavelength < MIN_WAVELENGTH_NM {
            format!(
                "Are these {unit}? Then write {:.0}; visible light has 400 to 700.",
                wavelength * factor
            )
        } else {
            "Visible light has 400 to 700.".to_string()
        };
        Err(Error::input(
            Parameter::WavelengthNm,
            wavelength,
            format!("sensors see {MIN_WAVELENGTH_NM} to {MAX_WAVELENGTH_NM} nanometres"),
            remedy,
        ))
    }

    /// Checks that the optics can be.
    ///
    /// # Errors
    /// Those of [`speckle_psf`] but for sizes.
    pub fn check(&self) -> Result<()> {
        require_positive(
            Parameter::WavelengthNm,
            self.wavelength_nm,
            "nanometres",
            "Visible light has 400 to 700.",
        )?;
        self.check_wavelength()?;
        require_positive(
            Parameter::PixelPitchUm,
            self.pixel_pitch_um,
            "micrometres",
            "Read it from the camera's data sheet.",
        )?;
        self.aperture.check()?;
        let angle = self.diffuser_fwhm_deg;
        if !(angle > 0.0 && angle < 90.0) {
            return Err(Error::input(
                Parameter::DiffuserFwhmDeg,
                angle,
                "a diffuser's full angle is above 0° and below 90°",
                "Read it from the diffuser's data sheet; holographic diffusers have 0.5° to 30°.",
            ));
        }
        let grains = self.envelope_fwhm_px() / self.grain_px();
        if grains < MIN_GRAINS {
            return Err(Error::input(
                Parameter::DiffuserFwhmDeg,
                format!("{angle}°, an envelope of {grains:.1} grains"),
                format!("a speckle PSF is at least {MIN_GRAINS} grains wide"),
                "Take a diffuser of a larger angle, or open the pupil.",
            ));
        }
        Ok(())
    }
}

/// Narrower than this a PSF is a distorted focus, and speckle statistics do not hold:
/// about two correlation lengths of the screen lie across the pupil.
const MIN_GRAINS: f64 = 5.0;

/// Longest side of a PSF in pixels: 16384² values are 1 GiB.
const MAX_SIDE: usize = 16384;

/// One random speckle PSF of these optics.
///
/// # Shapes
/// `rows × columns`; element `(rows/2, columns/2)` lies on the axis. A sensor of
/// `R × C` pixels uses `2R − 1 × 2C − 1`.
///
/// # Units
/// Intensity integrated over each pixel, scaled to sum to 1 over the elements kept.
/// Displacements of more than about two envelope widths (5σ) are zero.
///
/// # Errors
/// Optics that cannot be (numerical aperture ≥ 1, angle ≥ 90°, a length that is not
/// above zero), an envelope of fewer than five grains, a side of zero or of more than
/// 16384 pixels, and optics that need a Fourier transform of more than 8192² points.
///
/// # Cost
/// Four transforms of the size of the window, 10σ of the envelope: the demo's
/// 215×215 takes some tens of milliseconds.
pub fn speckle_psf(optics: &SpeckleOptics, rows: usize, columns: usize, seed: u64) -> Result<Psf> {
    phase_plate_psf(optics, RMS_PHASE, rows, columns, seed)
}

/// [`speckle_psf`] of a diffuser of another relief: the same scattering angle by a phase of
/// `rms_phase` radians.
///
/// The slopes of the phase make the angle, so a stronger phase is a smoother one:
/// `ℓ = √2 σ_φ / slope`. At 4 radians many independent parts fill the pupil and their light adds
/// up to speckle. At 20 and more few parts are left, each of which refracts as a lens does, and
/// the light gathers in caustics, bright folds and cusps with fringes one grain wide.
///
/// # Shapes, Units, Cost
/// Those of [`speckle_psf`].
///
/// # Errors
/// Those of [`speckle_psf`], and an `rms_phase` below 4 (light would go through unscattered) or
/// above 100 radians (one lens would be left, whose place in the pupil is all that is random).
pub fn phase_plate_psf(
    optics: &SpeckleOptics,
    rms_phase: f64,
    rows: usize,
    columns: usize,
    seed: u64,
) -> Result<Psf> {
    optics.check()?;
    if !(RMS_PHASE..=MAX_RMS_PHASE).contains(&rms_phase) {
        return Err(Error::input(
            Parameter::RmsPhase,
            rms_phase,
            format!("the phase of a diffuser is {RMS_PHASE} to {MAX_RMS_PHASE} radians rms"),
            "Take 4 for speckle, 20 to 60 for caustics.",
        ));
    }
    for (key, side) in [(Parameter::PsfRows, rows), (Parameter::PsfColumns, columns)] {
        if side == 0 || side > MAX_SIDE {
            return Err(Error::input(
                key,
                side,
                format!("a PSF has 1 to {MAX_SIDE}"),
                "Twice the sensor's rows and columns less one cover every displacement.",
            ));
        }
    }
    let grid = Grid::new(optics.grain_px(), optics.envelope_fwhm_px(), rms_phase)?;
    let window = grid.pixel_intensity(seed);
    let image = Image::from_fn(rows, columns, |y, x| {
        let dy = y as isize - (rows / 2) as isize;
        let dx = x as isize - (columns / 2) as isize;
        grid.at(&window, dy, dx)
    });
    Psf::new(image).map_err(|e| e.within("simulated speckle"))
}

/// Strongest phase: the correlation of the demo's screen is then the pupil's diameter.
const MAX_RMS_PHASE: f64 = 100.0;

#[cfg(test)]
mod tests;
