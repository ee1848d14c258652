//! When a frame corrects its PSF and its camera, and what of them.

use super::Calibration;
use super::parameters::{COUNT, ModelParameter};
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::PatchSet;
use std::fmt;
use std::str::FromStr;

/// Stray light of rows in a list of what may be corrected, as in `result.json`.
const ROW_OFFSETS: &str = "row_offsets_counts";
/// Smooth stray light in such a list.
const SMOOTH_STRAY_LIGHT: &str = "smooth_stray_light";
/// The PSF's own pixels in such a list.
const PSF_REFINEMENT: &str = "psf_refinement";

/// When a frame corrects its PSF and its camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum When {
    /// Never.
    Off,
    /// Where the model does not explain the frame.
    #[default]
    Auto,
    /// Always.
    On,
}

impl When {
    const ALL: [Self; 3] = [Self::Off, Self::Auto, Self::On];

    fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Auto => "auto",
            Self::On => "on",
        }
    }
}

/// What of PSF and camera may be corrected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Correctable {
    parameters: [bool; COUNT],
    /// Stray light of each row.
    pub row_offsets: bool,
    /// Smooth stray light.
    pub smooth_stray_light: bool,
    /// The PSF's own pixels.
    pub psf: bool,
}

impl Correctable {
    const ALL: Self = Self {
        parameters: [true; COUNT],
        row_offsets: true,
        smooth_stray_light: true,
        psf: true,
    };
    const NOTHING: Self = Self {
        parameters: [false; COUNT],
        row_offsets: false,
        smooth_stray_light: false,
        psf: false,
    };

    /// Whether `parameter` may be corrected.
    pub fn has(&self, parameter: ModelParameter) -> bool {
        self.parameters[parameter as usize]
    }

    fn add(&mut self, name: &str) -> bool {
        let parameter = ModelParameter::ALL.into_iter().find(|p| p.name() == name);
        match (name, parameter) {
            (_, Some(parameter)) => self.parameters[parameter as usize] = true,
            (ROW_OFFSETS, _) => self.row_offsets = true,
            (SMOOTH_STRAY_LIGHT, _) => self.smooth_stray_light = true,
            (PSF_REFINEMENT, _) => self.psf = true,
            _ => return false,
        }
        true
    }

    fn names(&self) -> Vec<&'static str> {
        let parameters = ModelParameter::ALL.into_iter().filter(|p| self.has(*p));
        let mut names: Vec<&str> = parameters.map(ModelParameter::name).collect();
        names.extend(self.row_offsets.then_some(ROW_OFFSETS));
        names.extend(self.smooth_stray_light.then_some(SMOOTH_STRAY_LIGHT));
        names.extend(self.psf.then_some(PSF_REFINEMENT));
        names
    }
}

/// When a frame corrects its PSF and its camera, and what of them.
///
/// Its text is `off`, `auto`, `on`, or a list of what may be corrected, such as `scale,rotation_deg` or `on,scale`, by the
/// names of `self_calibration` in `result.json`.
///
/// ```
/// use rowburst::reconstruct::SelfCalibration;
///
/// let default: SelfCalibration = "auto".parse()?;
/// assert_eq!(default, SelfCalibration::AUTO);
/// let some: SelfCalibration = "rotation_deg,scale".parse()?;
/// assert_eq!(some.to_string(), "auto,scale,rotation_deg");
/// # Ok::<(), rowburst::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SelfCalibration {
    when: When,
    pub(super) correctable: Correctable,
}

impl SelfCalibration {
    /// Never.
    pub const OFF: Self = Self::all(When::Off);
    /// Where the model does not explain the frame.
    pub const AUTO: Self = Self::all(When::Auto);
    /// Always.
    pub const ON: Self = Self::all(When::On);

    const fn all(when: When) -> Self {
        Self {
            when,
            correctable: Correctable::ALL,
        }
    }

    /// Whether nothing is corrected.
    pub fn is_off(self) -> bool {
        self.when == When::Off
    }

    /// Whether smooth stray light is looked for where the model does not explain the frame.
    pub(in crate::reconstruct) fn finds_stray_light(self) -> bool {
        !self.is_off() && self.correctable.smooth_stray_light
    }

    /// The PSF without the floor that it shows, where that may be corrected; for frames of so many pixels.
    pub(in crate::reconstruct) fn psf_floor(
        self,
        psfs: &PatchSet,
        pixels: usize,
    ) -> Option<Calibration> {
        let may_change = !self.is_off() && self.correctable.has(ModelParameter::Floor);
        let floor = || Calibration::of_psf_floor(psfs, pixels);
        may_change.then(floor).flatten()
    }

    /// Whether corrections are looked for where the model explains the frame, too.
    pub fn is_on(self) -> bool {
        self.when == When::On
    }
}

impl Default for SelfCalibration {
    fn default() -> Self {
        Self::AUTO
    }
}

impl FromStr for SelfCalibration {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let bad = |found: String| {
            let rule = format!(
                "self-calibration is off, auto, on, or a list of {}",
                Correctable::ALL.names().join(", ")
            );
            Error::input(
                Parameter::SelfCalibrate,
                found,
                rule,
                "Leave it out: a frame that the model does not explain corrects its PSF and camera.",
            )
        };
        let words: Vec<&str> = text.split(',').map(str::trim).collect();
        let when = When::ALL.into_iter().find(|when| when.name() == words[0]);
        let names = &words[usize::from(when.is_some())..];
        let when = when.unwrap_or_default();
        if names.is_empty() {
            return Ok(Self::all(when));
        }
        if when == When::Off {
            return Err(bad(format!("\"{text}\"")));
        }
        let mut correctable = Correctable::NOTHING;
        match names.iter().find(|name| !correctable.add(name)) {
            Some(name) => Err(bad(format!("\"{name}\""))),
            None => Ok(Self { when, correctable }),
        }
    }
}

impl fmt::Display for SelfCalibration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.when.name())?;
        if self.correctable == Correctable::ALL {
            return Ok(());
        }
        let mut names = self.correctable.names().into_iter();
        names.try_for_each(|name| write!(f, ",{name}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_come_back() {
        for text in [
            "off",
            "auto",
            "on",
            "auto,scale,blur_px2",
            "on,row_offsets_counts,psf_refinement",
        ] {
            let parsed: SelfCalibration = text.parse().unwrap();
            assert_eq!(parsed.to_string(), text);
        }
        let listed: SelfCalibration = "vignetting, scale".parse().unwrap();
        assert_eq!(listed.to_string(), "auto,scale,vignetting");
        for text in ["", "always", "scale,zoom", "off,scale", "scale,"] {
            let error = text.parse::<SelfCalibration>().unwrap_err().to_string();
            assert!(error.contains("rotation_deg"), "{text}: {error}");
        }
    }
}
