//! What of a design falls short, and what to do about it.

use super::{Assessment, LightParams, MIN_ROW_LIGHT, fits_full_well};
use rowburst_optics::Camera;
use rowburst_simulate::SpeckleOptics;

/// Light over noise below which even single pixels are lost.
const MIN_SNR: f64 = 8.0;
/// Part of the contrast below which the source counts as too broad: the correlation of
/// its two ends is then about one half.
const MIN_CONTRAST: f64 = 0.85;
/// Times the smallest angle from which a diffuser wastes light.
const OVERSIZED_ANGLE_RATIO: f64 = 2.5;

/// One sentence for each shortcoming, with its remedy; none where all is well.
/// `recoverable` is the number of pixels of a bin that come back at the expected SNR.
pub fn shortcomings(
    found: &Assessment,
    camera: &Camera,
    optics: &SpeckleOptics,
    light: &LightParams,
    recoverable: f64,
) -> Vec<String> {
    let mut warnings = Vec::new();
    let grain = found.grains.grain_px;
    if !found.grains.is_sampled() {
        let na = optics.aperture.na() * grain / 2.0;
        warnings.push(format!(
            "grains are undersampled: {grain:.2} pixels each, and two are needed, so the pixels blur the speckle to a contrast of {:.2}. Stop the pupil down to {:.2} mm (NA {na:.4}), or take smaller pixels.",
            found.grains.contrast(),
            2.0 * na * optics.aperture.image_distance_mm()
        ));
    }
    let reach = found.spread.reach;
    let smallest = found.smallest_diffuser_deg;
    if reach < MIN_ROW_LIGHT {
        warnings.push(format!(
            "diffuser too weak: at least {smallest:.2}° needed. A row {} rows from the source gets {} of the light of a row level with it; {MIN_ROW_LIGHT} is needed, or whole parts of the field are missing from some frames of the video.",
            found.spread.needed_px,
            part(reach)
        ));
    } else if optics.diffuser_fwhm_deg > OVERSIZED_ANGLE_RATIO * smallest {
        warnings.push(format!(
            "diffuser stronger than needed: {:.2}° would do, and {:.0} % of the light misses the sensor. Take a weaker one.",
            smallest,
            100.0 * found.spread.lost_mean
        ));
    }
    let signal = &found.signal;
    if signal.snr < MIN_SNR {
        warnings.push(format!(
            "too little light: SNR {:.1} a pixel, and below {MIN_SNR} even single pixels are lost. Collect more photons: a brighter scene, a longer exposure, a weaker diffuser or binning.",
            signal.snr
        ));
    }
    if !fits_full_well(camera, signal, light) {
        warnings.push(format!(
            "pixels saturate: the brightest hold about {:.0} electrons and a well holds {:.0}. Dim the light by {:.1}.",
            signal.peak,
            light.full_well_electrons.unwrap_or(f64::NAN),
            signal.peak / light.full_well_electrons.unwrap_or(f64::NAN)
        ));
    }
    if found.contrast_kept < MIN_CONTRAST {
        warnings.push(format!(
            "light too broad: {} nm leave {:.0} % of the speckle's contrast. Use a source or a filter of at most {:.1} nm.",
            light.source_bandwidth_nm,
            100.0 * found.contrast_kept,
            found.bandwidth_nm
        ));
    }
    if (light.bright_pixels as f64) > recoverable {
        warnings.push(format!(
            "scene too dense: {} bright pixels in a bin, and about {recoverable:.0} scattered ones can be recovered at SNR {:.0}. Light fewer, collect more photons, use a wider sensor; connected shapes are easier than scattered pixels.",
            light.bright_pixels, signal.snr
        ));
    }
    warnings
}

/// A part of the light in words that stay readable when it is tiny.
fn part(value: f64) -> String {
    if value < 1e-3 {
        "less than 0.001".into()
    } else {
        format!("{value:.3}")
    }
}
