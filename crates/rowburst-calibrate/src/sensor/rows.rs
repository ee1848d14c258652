//! Row-wise banding: what all pixels of a row have in common in one frame.
//!
//! The mean of a row of `n` pixels scatters from frame to frame by `pixel noise/√n`;
//! what it scatters more is the noise of the row's own readout. It does not average out
//! along the row, and each row of a rolling shutter is an instant of its own.

use super::stack::{Moments, Stack};
use super::stats::{RARE_Z, centre_and_sigma, chi_square_per_dof, median};

/// How the rows of dark frames scatter.
#[derive(Debug, Clone, PartialEq)]
pub struct Banding {
    /// Standard deviation of the rows' own noise in one frame, in counts.
    pub row_counts: f64,
    /// What pixel noise alone gives the mean of a row, in counts.
    pub expected_counts: f64,
    /// Standard deviation of a pixel without its row's noise, in counts.
    pub pixel_counts: f64,
    /// Degrees of freedom of `pixel_counts`.
    pub pixel_dof: f64,
    /// Whether there is more than chance allows.
    pub is_real: bool,
    /// Standard deviation of the rows' levels that all frames share, in counts; the dark
    /// frame takes it away.
    pub fixed_counts: f64,
    /// Row means of the first dark frame above the mean dark, in counts.
    pub first: Vec<f64>,
}

/// The banding of `darks`.
pub fn banding(darks: &Stack, dark: &Moments, usable: &[bool]) -> Banding {
    let (rows, columns) = darks.size();
    let (mut of_rows, mut row_dof) = (0.0, 0.0);
    let (mut of_pixels, mut pixel_dof) = (0.0, 0.0);
    let (mut inverse_counts, mut rows_counted) = (0.0, 0.0);
    let mut first = Vec::new();
    for (frame, (image, drift)) in darks.images().zip(&dark.drift).enumerate() {
        for y in 0..rows {
            let row = y * columns..(y + 1) * columns;
            let left = || {
                let pixels = row.clone().filter(|&i| usable[i]);
                pixels.map(|i| f64::from(image.data()[i]) - dark.mean[i] - drift)
            };
            let count = left().count() as f64;
            if count < 2.0 {
                continue;
            }
            let mean = left().sum::<f64>() / count;
            of_rows += mean * mean;
            of_pixels += left().map(|v| (v - mean).powi(2)).sum::<f64>();
            // The mean over the frames is taken away: of n frames n − 1 are free.
            let free = dark.dof / (dark.dof + 1.0);
            row_dof += free;
            pixel_dof += free * (count - 1.0);
            inverse_counts += 1.0 / count;
            rows_counted += 1.0;
            if frame == 0 {
                first.push(mean);
            }
        }
    }
    // The level of each frame is taken away as well.
    row_dof -= dark.dof;
    let pixel_variance = of_pixels / pixel_dof.max(1.0);
    let expected = pixel_variance * inverse_counts / f64::max(rows_counted, 1.0);
    let found = of_rows / row_dof.max(1.0);
    Banding {
        row_counts: (found - expected).max(0.0).sqrt(),
        expected_counts: expected.sqrt(),
        pixel_counts: pixel_variance.sqrt(),
        pixel_dof,
        is_real: row_dof >= 1.0 && found > expected * chi_square_per_dof(row_dof, RARE_Z),
        fixed_counts: fixed(dark, usable, columns),
        first,
    }
}

/// Scatter of the row levels of the mean dark beyond that of single pixels.
fn fixed(dark: &Moments, usable: &[bool], columns: usize) -> f64 {
    let mut levels = Vec::new();
    let mut within = Vec::new();
    for (row, usable) in dark
        .mean
        .chunks_exact(columns)
        .zip(usable.chunks_exact(columns))
    {
        let pixels = row.iter().zip(usable).filter(|(_, u)| **u).map(|(v, _)| *v);
        let mut pixels: Vec<f64> = pixels.collect();
        if !pixels.is_empty() {
            levels.push(pixels.iter().sum::<f64>() / pixels.len() as f64);
            within.push(centre_and_sigma(pixels.drain(..)).1);
        }
    }
    let (_, spread) = centre_and_sigma(levels.into_iter());
    let pixel = median(&mut within);
    (spread * spread - pixel * pixel / columns as f64)
        .max(0.0)
        .sqrt()
}
