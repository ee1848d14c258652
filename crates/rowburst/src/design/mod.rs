//! What a camera, a lens and a diffuser can do before they are bought.
//!
//! From the optics, the camera and the light: grain, reach of the PSF and light lost
//! ([`spread`]), the speckle's contrast over colour ([`speckle`]), frame rate, expected
//! signal-to-noise ratio, how many pixels of a bin may be lit ([`sparsity`]), and how many numbers of an instant speak
//! about the change of a dense scene ([`count`]).
//!
//! **Reach.** The paper asks that light from the bottom of the field reach the top row.
//! An envelope is taken to reach to where it has fallen to a tenth of its middle,
//! [`MIN_ROW_LIGHT`]; for a Gaussian whose half maximum lies at `z·tan(θ/2)` that is √(ln 10/ln 2) =
//! 1.82 times as far, so for rows `L` apart the smallest angle is
//! `2·atan(L·pitch/(1.82 z))`.
//!
//! **Signal.** `k` bright pixels of `N` electrons each a bin, `p` the PSF between field
//! point and pixel, averaged over both: a pixel of the frame has
//!
//! ```text
//! mean = K N ⟨p⟩,     rms² = N² (K ⟨p²⟩ + K(K−1) ⟨⟨p⟩_field²⟩),     K = k·(bins in an exposure)
//! noise² = mean + read² + rounding²,     SNR = rms/noise
//! ```
//!
//! in the units of the paper, rms of the noiseless frame over the noise. Bright pixels at
//! places of their own are assumed; those within a grain of each other add up to more.

pub mod count;
mod shortcomings;
pub mod sparsity;
pub mod speckle;
pub mod spread;
#[cfg(test)]
mod tests;

use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::{Camera, Psf};
use rowburst_simulate::SpeckleOptics;
use speckle::{Dispersion, Grains};
use spread::Spread;

pub use shortcomings::shortcomings;

/// The light and what the sensor makes of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightParams {
    /// Photons of one bright scene pixel in one bin that pass the lens towards the sensor.
    pub photons: f64,
    /// Bright pixels of the scene in a bin.
    pub bright_pixels: usize,
    /// Electrons per photon, up to 1.
    pub quantum_efficiency: f64,
    /// Read noise of a raw pixel in electrons rms.
    pub read_noise_electrons: f64,
    /// Electrons per count, for the noise of rounding.
    pub electrons_per_count: Option<f64>,
    /// Electrons at which a raw pixel is full.
    pub full_well_electrons: Option<f64>,
    /// Full width of the light's spectrum in nanometres, even over it.
    pub source_bandwidth_nm: f64,
    /// Rms of the optical path through the diffuser in nanometres; `None`: the 4 radians
    /// of the simulated diffuser, about the least that lets no light pass unscattered.
    pub diffuser_path_rms_nm: Option<f64>,
}

impl Default for LightParams {
    /// A scientific CMOS camera of the paper's kind, ten bright pixels, laser light.
    fn default() -> Self {
        Self {
            // A mean of about 3400 electrons in the pixels of 108×108.
            photons: 2e7,
            bright_pixels: 10,
            quantum_efficiency: 0.6,
            read_noise_electrons: 1.5,
            electrons_per_count: None,
            full_well_electrons: Some(30_000.0),
            source_bandwidth_nm: 1.0,
            diffuser_path_rms_nm: None,
        }
    }
}

/// Light of the worst row, over that of a row level with the source, that counts as reached; smaller loses quality
/// (`docs/design/017`).
pub const MIN_ROW_LIGHT: f64 = 0.1;

/// Rms phase of the simulated diffuser in radians, see [`rowburst_simulate::speckle`].
const SIMULATED_RMS_PHASE: f64 = 4.0;

impl LightParams {
    /// Checks the values.
    ///
    /// # Errors
    /// Names the quantity, the value, the rule and a remedy.
    pub fn check(&self) -> Result<()> {
        let positive = |name: Parameter, value: f64, remedy: &'static str| {
            if value.is_finite() && value > 0.0 {
                return Ok(());
            }
            Err(Error::input(
                name,
                value,
                "a number above zero is needed",
                remedy,
            ))
        };
        positive(
            Parameter::Photons,
            self.photons,
            "Give the photons of one bright scene pixel in one bin that pass the lens, such as 2e7.",
        )?;
        if self.bright_pixels == 0 {
            return Err(Error::input(
                Parameter::BrightPixels,
                0,
                "a scene has at least one bright pixel in a bin",
                "Give the number of scene pixels that are lit at once, such as 10.",
            ));
        }
        let efficiency = self.quantum_efficiency;
        if !(efficiency > 0.0 && efficiency <= 1.0) {
            return Err(Error::input(
                Parameter::QuantumEfficiency,
                efficiency,
                "electrons per photon lie above 0 and at most at 1",
                "Read it from the camera's data sheet at your wavelength: 0.6 for 60 %.",
            ));
        }
        if !(self.read_noise_electrons.is_finite() && self.read_noise_electrons >= 0.0) {
            return Err(Error::input(
                Parameter::ReadNoiseElectrons,
                self.read_noise_electrons,
                "a noise is zero or more",
                "Read it from the camera's data sheet, or measure it by `rowburst calibrate sensor`.",
            ));
        }
        let optional = [
            (Parameter::ElectronsPerCount, self.electrons_per_count),
            (Parameter::FullWellElectrons, self.full_well_electrons),
            (Parameter::DiffuserPathRmsNm, self.diffuser_path_rms_nm),
        ];
        for (name, value) in optional {
            if let Some(value) = value {
                positive(name, value, "Leave it out where it is not known.")?;
            }
        }
        positive(
            Parameter::SourceBandwidthNm,
            self.source_bandwidth_nm,
            "Give the width of the filter or of the source's spectrum: a laser has less than 1.",
        )
    }
}

/// What the design does.
#[derive(Debug, Clone, PartialEq)]
pub struct Assessment {
    /// The grains in the pixels.
    pub grains: Grains,
    /// Full width at half maximum of the grains of a given PSF, as measured.
    pub measured_grain_px: Option<f64>,
    /// Where the light lands.
    pub spread: Spread,
    /// Full width at half maximum of the diffuser's envelope in pixels.
    pub envelope_fwhm_px: f64,
    /// The smallest full angle of the diffuser that meets the paper's criterion.
    pub smallest_diffuser_deg: f64,
    /// Video frames a second.
    pub frame_rate_hz: f64,
    /// Video frames from one frame of the camera.
    pub frames: usize,
    /// Frames a second of the camera itself: readout of all rows after one exposure.
    pub camera_frame_rate_hz: f64,
    /// Measurements that see one bin.
    pub measurements_per_bin: f64,
    /// Pixels of the field.
    pub field_pixels: usize,
    /// Light and noise of a pixel.
    pub signal: PixelSignal,
    /// The PSF over the wavelength.
    pub dispersion: Dispersion,
    /// Wavelength difference at which two PSFs have a correlation of one half.
    pub bandwidth_nm: f64,
    /// The same, were there diffraction alone.
    pub diffraction_bandwidth_nm: f64,
    /// The same, were there the path through the diffuser alone.
    pub path_bandwidth_nm: f64,
    /// Part of the speckle's contrast that the source keeps.
    pub contrast_kept: f64,
}

/// Light and noise of a pixel of the working grid, in electrons.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelSignal {
    /// Mean of the frame.
    pub mean: f64,
    /// Root mean square of the noiseless frame.
    pub rms: f64,
    /// Four standard deviations of the frame above its mean: about the brightest pixel.
    pub peak: f64,
    /// Shot, read and rounding noise.
    pub noise: f64,
    /// `rms/noise`.
    pub snr: f64,
}

/// Assesses a design; with a `psf`, reach, loss and signal are those of that PSF.
///
/// # Errors
/// Optics, light or noise that cannot be; each names the quantity and the rule.
pub fn assess(
    camera: &Camera,
    optics: &SpeckleOptics,
    light: &LightParams,
    psf: Option<&Psf>,
) -> Result<Assessment> {
    optics.check()?;
    light.check()?;
    if light.source_bandwidth_nm >= optics.wavelength_nm {
        return Err(Error::input(
            Parameter::SourceBandwidthNm,
            light.source_bandwidth_nm,
            format!(
                "the bandwidth is smaller than the wavelength of {} nm",
                optics.wavelength_nm
            ),
            "Give both in nanometres: a laser has less than 1, a filter 1 to 50.",
        ));
    }
    let grains = Grains::new(optics.grain_px());
    let envelope = optics.envelope_fwhm_px();
    let path_rms_nm = light
        .diffuser_path_rms_nm
        .unwrap_or(SIMULATED_RMS_PHASE / std::f64::consts::TAU * optics.wavelength_nm);
    let dispersion = Dispersion::new(camera, &grains, envelope, optics.wavelength_nm, path_rms_nm);
    let contrast_kept = dispersion.contrast_kept(light.source_bandwidth_nm);
    let spread = match psf {
        Some(psf) => Spread::of_psf(camera, psf),
        None => Spread::gaussian(camera, envelope, grains.contrast() * contrast_kept),
    };
    let needed_mm = spread.needed_px as f64 * optics.pixel_pitch_um * 1e-3;
    let tenth_over_half = (MIN_ROW_LIGHT.ln() / 0.5f64.ln()).sqrt();
    let tangent = needed_mm / (tenth_over_half * optics.aperture.image_distance_mm());
    let smallest = 2.0 * tangent.atan();
    let params = camera.params();
    let instants = camera.time().instants().len() as f64;
    let own_frame_us = match camera.shutter() {
        rowburst_optics::Shutter::Global => params.exposure_us,
        _ => instants * params.row_time_us + params.exposure_us,
    };
    Ok(Assessment {
        measured_grain_px: psf.map(measured_grain_px),
        envelope_fwhm_px: envelope,
        smallest_diffuser_deg: smallest.to_degrees(),
        frame_rate_hz: camera.time().frame_rate_hz(),
        frames: camera.time().bins(),
        camera_frame_rate_hz: 1e6 / own_frame_us,
        measurements_per_bin: sparsity::measurements_per_bin(camera),
        field_pixels: camera.video_shape().pixels(),
        signal: signal(camera, &spread, light),
        bandwidth_nm: dispersion.half_width_nm(|d| dispersion.correlation(d)),
        diffraction_bandwidth_nm: dispersion.half_width_nm(|d| dispersion.by_diffraction(d)),
        path_bandwidth_nm: dispersion.half_width_nm(|d| dispersion.by_path(d)),
        contrast_kept,
        dispersion,
        grains,
        spread,
    })
}

/// Light and noise of a pixel; see the module's "Signal".
pub fn signal(camera: &Camera, spread: &Spread, light: &LightParams) -> PixelSignal {
    let params = camera.params();
    let bins_in_exposure = match camera.shutter() {
        rowburst_optics::Shutter::Global => 1.0,
        _ => params.exposure_us / params.row_time_us * params.bins_per_row as f64,
    };
    let sources = light.bright_pixels as f64 * bins_in_exposure;
    let electrons = light.photons * light.quantum_efficiency;
    let mean = electrons * sources * spread.mean;
    let square =
        sources * spread.mean_square + (sources * (sources - 1.0)).max(0.0) * spread.square_of_mean;
    let rms = electrons * square.sqrt();
    let raw_pixels = params.sensor.binning.pow(2) as f64;
    let rounding = light.electrons_per_count.map_or(0.0, |g| g * g / 12.0);
    let noise = (mean + raw_pixels * (light.read_noise_electrons.powi(2) + rounding)).sqrt();
    PixelSignal {
        mean,
        rms,
        peak: mean + 4.0 * (rms * rms - mean * mean).max(0.0).sqrt(),
        noise,
        snr: rms / noise,
    }
}

/// Whether the frame's brightest pixels stay below the full well.
pub fn fits_full_well(camera: &Camera, signal: &PixelSignal, light: &LightParams) -> bool {
    let raw_pixels = camera.sensor().binning.pow(2) as f64;
    light
        .full_well_electrons
        .is_none_or(|well| signal.peak <= raw_pixels * well)
}

/// Longest distance at which the grains of a PSF are compared, in pixels.
const MAX_LAG: usize = 96;

/// Full width at half maximum of the autocovariance of a PSF, the mean of both axes.
///
/// From the structure function `D(s) = ⟨(p(x) − p(x+s))²⟩ = 2(K(0) − K(s))` of the middle
/// half, which the envelope, slow against the grains, does not enter.
pub fn measured_grain_px(psf: &Psf) -> f64 {
    let image = psf.image();
    let (rows, columns) = (image.rows(), image.columns());
    let half = |n: usize| (n / 4, (n - n / 4).max(n / 4 + 1));
    let (y, x) = (half(rows), half(columns));
    let width = |across: bool| -> f64 {
        let side = if across { columns } else { rows };
        let longest = MAX_LAG.min(side / 4).max(1);
        let difference = |lag: usize| -> f64 {
            let (mut sum, mut count) = (0.0, 0.0);
            for i in y.0..y.1 {
                for j in x.0..x.1 {
                    let other = if across { (i, j + lag) } else { (i + lag, j) };
                    if other.0 < rows && other.1 < columns {
                        let change = image.at(i, j) - image.at(other.0, other.1);
                        sum += f64::from(change).powi(2);
                        count += 1.0;
                    }
                }
            }
            sum / f64::max(count, 1.0)
        };
        let curve: Vec<f64> = (0..=longest).map(difference).collect();
        // Far apart the grains have nothing in common.
        let far = &curve[longest.div_ceil(2)..];
        let level = 0.5 * far.iter().sum::<f64>() / far.len() as f64;
        match curve.iter().position(|&d| d >= level) {
            Some(i) if i > 0 => {
                let part = (level - curve[i - 1]) / (curve[i] - curve[i - 1]);
                2.0 * ((i - 1) as f64 + part)
            }
            _ => 2.0 * longest as f64,
        }
    };
    (width(true) * width(false)).sqrt()
}
