//! `psf.json`: the numbers of a PSF and of the memory effect, and what to make of them.

#![allow(missing_docs, reason = "the fields are the keys of psf.json")]

use rowburst::calibrate::psf::{
    Core, MIN_REACH, MemoryEffect, PointSourceImage, Reach, SpeckleStatistics,
};
use serde::Serialize;

/// Everything that `psf.json` says.
#[derive(Debug, Clone, Serialize)]
pub struct PsfSummary {
    pub version: &'static str,
    /// Rows and columns of the PSF, working grid.
    pub rows: usize,
    pub columns: usize,
    pub binning: usize,
    pub captures: usize,
    pub left_out: Vec<String>,
    pub contrast: f64,
    pub grain_px: f64,
    pub grain_y_px: f64,
    pub grain_x_px: f64,
    pub ballistic_fraction: f64,
    /// Middle (y, x) of the ballistic core in pixels of the binned capture.
    pub ballistic_at_px: Option<(f64, f64)>,
    pub saturated_fraction: f64,
    /// Kolmogorov–Smirnov distance of the intensities to the negative exponential.
    pub exponential_distance: f64,
    pub noise_part: f64,
    pub lit_fraction: f64,
    /// Taken from the captures where there is no dark frame.
    pub floor_counts: Option<f64>,
    /// What a reconstruction reads of the capture: noise, pinhole, and the PSF that they are of.
    pub capture: serde_json::Value,
    /// Point (y, x) of the binned capture that became zero displacement.
    pub middle_px: (f64, f64),
    pub row_reach: RowReach,
    #[serde(flatten)]
    pub memory: Option<MemorySummary>,
    pub warnings: Vec<String>,
    pub remarks: Vec<String>,
}

/// Light of the field's edge on the farthest sensor row.
#[derive(Debug, Clone, Serialize)]
pub struct RowReach {
    /// Relative to the mean over the rows.
    pub worst: f64,
    pub least: f64,
    pub enough: bool,
    pub extrapolated: bool,
    pub sensor_rows: usize,
    pub field_rows: usize,
}

/// What captures at several places tell.
#[derive(Debug, Clone, Serialize)]
pub struct MemorySummary {
    pub shift_px_per_mm: f64,
    /// Rows: shift along x and y; columns: a millimetre along x and y.
    pub shift_matrix_px_per_mm: [[f64; 2]; 2],
    pub shift_residual_px: f64,
    pub fitted_captures: usize,
    pub isoplanatic_range_mm: Option<f64>,
    /// Pairs of distance in mm and correlation.
    pub correlation: Vec<(f64, f64)>,
    /// The same of the parts of the captures that overlap, by capture.
    pub overlap_correlation: Vec<f64>,
    pub patch_spacing_mm: f64,
    pub patches: usize,
    /// Along rows (y) and columns (x).
    pub patches_needed: (usize, usize),
}

impl RowReach {
    pub fn new(reach: &Reach, sensor_rows: usize, field_rows: usize) -> Self {
        Self {
            worst: reach.worst,
            least: MIN_REACH,
            enough: reach.worst >= MIN_REACH,
            extrapolated: reach.extrapolated,
            sensor_rows,
            field_rows,
        }
    }
}

impl MemorySummary {
    pub fn new(effect: &MemoryEffect, patches: usize, patches_needed: (usize, usize)) -> Self {
        let m = effect.px_per_mm;
        Self {
            shift_px_per_mm: effect.shift_px_per_mm,
            shift_matrix_px_per_mm: [[m[1][1], m[1][0]], [m[0][1], m[0][0]]],
            shift_residual_px: effect.residual_px,
            fitted_captures: effect.fitted.iter().filter(|f| **f).count(),
            isoplanatic_range_mm: effect.range_mm,
            correlation: effect.correlation.clone(),
            overlap_correlation: effect.overlap.clone(),
            patch_spacing_mm: effect.spacing_mm,
            patches,
            patches_needed,
        }
    }
}

/// Below this contrast the source is not a point or not of one colour.
const MIN_CONTRAST: f64 = 0.6;
/// Part of saturated pixels that is warned of.
const MAX_SATURATED_FRACTION: f64 = 1e-3;
/// Part of ballistic light that is warned of.
const MAX_BALLISTIC_FRACTION: f64 = 0.01;

/// What the user must know before using the PSF.
pub fn warnings(
    light: &PointSourceImage,
    speckle: &SpeckleStatistics,
    core: Option<&Core>,
    reach: &RowReach,
    expected_grain_px: Option<f64>,
) -> Vec<String> {
    let mut warnings = Vec::new();
    for (name, correlation) in &light.left_out {
        warnings.push(format!("{name} was excluded: its pattern differs from that of the other captures (correlation {correlation:.2}); check that nothing moved, or do not pass it"));
    }
    if let Some(core) = core.filter(|c| c.fraction > MAX_BALLISTIC_FRACTION) {
        warnings.push(format!(
            "ballistic light: at least {:.1} % of it lies in a core of {:.0} px around row {:.0}, column {:.0} that the diffuser does not scatter; take a stronger diffuser or two in a row",
            100.0 * core.fraction, 2.0 * core.radius_px, core.at_px.0, core.at_px.1
        ));
    }
    if light.saturated_fraction > MAX_SATURATED_FRACTION {
        warnings.push(format!(
            "{:.2} % of the pixels are saturated: bright grains are cut off, and contrast and PSF are too low there; shorten the exposure, or add captures of shorter ones",
            100.0 * light.saturated_fraction
        ));
    }
    if speckle.contrast < MIN_CONTRAST {
        warnings.push(format!(
            "the speckle contrast is {:.2} (a point source of one colour gives 0.9 to 1): the source is extended, or the light is broadband; take a smaller pinhole or a spectral filter, and check that nothing vibrates",
            speckle.contrast
        ));
    }
    let pattern = (speckle.lit_fraction
        * (speckle.envelope.rows() * speckle.envelope.columns()) as f64)
        .sqrt();
    if speckle.grain_px > pattern / 8.0 {
        warnings.push(format!(
            "the grain of {:.1} px is a large part of the pattern of {pattern:.0} px: the source is extended, or this is no speckle; take a smaller pinhole, or open the aperture",
            speckle.grain_px
        ));
    }
    if let Some(expected) = expected_grain_px
        && speckle.grain_px > 1.5 * expected
    {
        warnings.push(format!(
            "the grain of {:.1} px is wider than the {expected:.1} px that diffraction gives: the source is extended (not a point), or the camera is out of place; take a smaller pinhole",
            speckle.grain_px
        ));
    }
    if !reach.enough {
        warnings.push(format!(
            "light from one end of the field ({} rows) reaches the farthest of the {} sensor rows with {:.1} % of the mean{}: the frame says nothing about it at their instants; take a diffuser of a larger angle, a longer distance to it, or a smaller field",
            reach.field_rows, reach.sensor_rows, 100.0 * reach.worst,
            if reach.extrapolated { " (continued beyond the capture)" } else { "" }
        ));
    }
    warnings
}

/// What the numbers rest on.
pub fn remarks(
    light: &PointSourceImage,
    speckle: &SpeckleStatistics,
    reach: &RowReach,
    effect: Option<&MemoryEffect>,
) -> Vec<String> {
    let mut remarks = Vec::new();
    match &light.black_level {
        Some(black_level) if black_level.is_from_dark_region => remarks.push(format!(
            "no dark frame: the black level of {:.2} counts was estimated from a region without light",
            black_level.counts
        )),
        Some(black_level) => remarks.push(format!(
            "no dark frame: the black level of {:.2} counts is that of the darkest thousandth of the pixels, so the contrast is an upper bound; give a dark frame",
            black_level.counts
        )),
        None => {}
    }
    if speckle.lit_edge_fraction > 0.1 {
        remarks.push(
            "the pattern reaches the edges of the capture: light beyond them is not in the PSF"
                .into(),
        );
    }
    if reach.extrapolated {
        remarks.push(format!(
            "the capture does not cover the displacements from one end of the field to the other end of the sensor ({} rows): the reach was continued by a Gaussian; record the source at both ends of the field to measure it",
            (reach.sensor_rows + reach.field_rows) / 2 - 1
        ));
    }
    if let Some(effect) = effect {
        if effect.range_mm.is_none() {
            remarks.push(format!(
                "the correlation does not fall to 0.5 within the measured positions: the isoplanatic range is beyond {:.3} mm, and one PSF may suffice",
                effect.correlation.last().map_or(0.0, |c| c.0)
            ));
        }
        let lost = effect.fitted.iter().filter(|f| !**f).count();
        if lost > 0 {
            remarks.push(format!("{lost} captures correlate too little with the middle one to measure their shift independently: it was searched within a grain of the prediction from the others"));
        }
    }
    remarks
}
