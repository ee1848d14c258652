//! The memory effect: how far a source may move while its speckle only shifts.
//!
//! Each capture is registered to the one nearest to the middle of the places by the peak
//! of the cross-correlation. A linear map `M` from millimetres to pixels is fitted to the
//! shifts of those that still correlate well; around what it predicts the peak of the others
//! is looked for, since beyond the range the highest peak is chance.
//!
//! The correlation is that of whole captures, `Σ a b / √(Σ a² Σ b²)` of the intensities over
//! their local mean, less 1, after registration: light that left the frame counts as lost,
//! as in the peak of a cross-correlation, by which such curves are published. The
//! correlation of the overlapping parts alone, higher by the lost part, is given too.
//!
//! Reference: I. Freund, M. Rosenbluh, S. Feng, Phys. Rev. Lett. 61, 2328 (1988).

use super::filter::{shifted, smoothed};
use super::fourier::{Correlation, Spectrum};
use super::merge::Sums;
use rayon::prelude::*;
use rowburst_core::{Error, Parameter, Result, phrase};
use rowburst_optics::Image;

/// A capture at a known place of the source.
#[derive(Debug, Clone, PartialEq)]
pub struct PositionedCapture {
    /// The light, above its floor.
    pub light: Image,
    /// Place of the source in millimetres `(y, x)`.
    pub at_mm: (f64, f64),
}

/// How the pattern follows the source.
#[derive(Debug, Clone, PartialEq)]
pub struct MemoryEffect {
    /// Index of the capture that the others are compared with.
    pub reference: usize,
    /// Shift of each capture against the reference, in pixels `(y, x)`.
    pub shifts_px: Vec<(f64, f64)>,
    /// Whether the shift entered the fit.
    pub fitted: Vec<bool>,
    /// `M`: rows are the shift along `y` and `x`, columns a millimetre along `y` and `x`.
    /// Of places along a line it maps displacements along it only.
    pub px_per_mm: [[f64; 2]; 2],
    /// Shift per millimetre along the line of the places; of places in a plane the
    /// geometric mean over directions.
    pub shift_px_per_mm: f64,
    /// Rms distance of the fitted shifts from `M`, in pixels.
    pub residual_px: f64,
    /// Correlation of the overlapping part of each capture with the reference.
    pub overlap: Vec<f64>,
    /// Distance from the reference in mm and correlation, by distance.
    pub correlation: Vec<(f64, f64)>,
    /// Distance at which the correlation falls to 0.5; `None` if it never does.
    pub range_mm: Option<f64>,
    /// Distance at which it falls to 0.7, at which patches should lie: a source between
    /// two then correlates some 0.9 with both. The largest distance if it never does.
    pub spacing_mm: f64,
}

/// Correlation above which a shift is trusted for the fit.
const TRUSTED: f64 = 0.35;

/// Measures shift and correlation of `captures` with speckle of `grain` pixels.
///
/// # Errors
/// Fewer than three captures, two at one place, and captures of which none but the
/// reference shows its pattern, so that no shift can be measured.
pub fn memory_effect(captures: &[PositionedCapture], grain: f64) -> Result<MemoryEffect> {
    let positions: Vec<(f64, f64)> = captures.iter().map(|c| c.at_mm).collect();
    check(&positions)?;
    let reference = middle(&positions);
    let delta: Vec<(f64, f64)> = positions
        .iter()
        .map(|p| (p.0 - positions[reference].0, p.1 - positions[reference].1))
        .collect();
    let flat: Vec<Image> = captures
        .par_iter()
        .map(|c| flattened(&c.light, grain))
        .collect();
    let spectra: Vec<Spectrum> = flat.par_iter().map(|f| Spectrum::of(f, 0, 0)).collect();
    let energy: Vec<f64> = flat.iter().map(energy).collect();
    let reference_spectrum = &spectra[reference];

    let first: Vec<((f64, f64), f64)> = (0..captures.len())
        .into_par_iter()
        .map(|i| {
            let correlation = spectra[i].correlate(reference_spectrum);
            let peak = correlation.highest();
            let value = correlation.at(peak.0, peak.1) / (energy[i] * energy[reference]).sqrt();
            (correlation.refine(peak), value)
        })
        .collect();
    let grains = (flat[reference].data().len() as f64 / (1.133 * grain * grain)).max(1.0);
    let trusted = TRUSTED.max(8.0 / grains.sqrt());
    let mut fitted: Vec<bool> = first.iter().map(|f| f.1 > trusted).collect();
    let shifts: Vec<(f64, f64)> = first.iter().map(|f| f.0).collect();
    let fit = fit(&delta, &shifts, &mut fitted, reference, grain)?;

    let found: Vec<((f64, f64), (f64, f64))> = (0..captures.len())
        .into_par_iter()
        .map(|i| {
            let shift = if fitted[i] {
                shifts[i]
            } else {
                near_prediction(
                    &spectra[i].correlate(reference_spectrum),
                    mapped(&fit, delta[i]),
                    grain,
                )
            };
            (shift, registered(&flat[i], &flat[reference], shift))
        })
        .collect();
    let residuals = (0..captures.len()).filter(|&i| fitted[i]).map(|i| {
        let (y, x) = mapped(&fit, delta[i]);
        (found[i].0.0 - y).powi(2) + (found[i].0.1 - x).powi(2)
    });
    let count = fitted.iter().filter(|f| **f).count();
    let residual_px = (residuals.sum::<f64>() / count as f64).sqrt();
    let mut correlation: Vec<(f64, f64)> = delta
        .iter()
        .zip(&found)
        .map(|(d, f)| (d.0.hypot(d.1), f.1.0))
        .collect();
    correlation.sort_by(|a, b| a.0.total_cmp(&b.0));
    let farthest = correlation.last().map_or(0.0, |c| c.0);
    Ok(MemoryEffect {
        reference,
        shifts_px: found.iter().map(|f| f.0).collect(),
        fitted,
        shift_px_per_mm: magnitude(&fit, &delta),
        px_per_mm: fit,
        residual_px,
        overlap: found.iter().map(|f| f.1.1).collect(),
        range_mm: falls_to(&correlation, 0.5),
        spacing_mm: falls_to(&correlation, 0.7).unwrap_or(farthest),
        correlation,
    })
}

impl MemoryEffect {
    /// The shift that the linear map gives for a source `delta` mm from the reference's.
    pub fn predicted_px(&self, delta: (f64, f64)) -> (f64, f64) {
        mapped(&self.px_per_mm, delta)
    }
}

fn check(positions: &[(f64, f64)]) -> Result<()> {
    if positions.len() < 3 {
        return Err(Error::input(
            Parameter::PositionsMm,
            format!("{} positions", positions.len()),
            "a curve of correlation against distance needs captures at three positions or more",
            phrase![
                "Record captures in steps well below the isoplanatic range, or leave ",
                Parameter::PositionsMm,
                " out."
            ],
        ));
    }
    for (i, a) in positions.iter().enumerate() {
        if let Some(j) = positions[..i].iter().position(|b| b == a) {
            return Err(Error::input(
                Parameter::PositionsMm,
                format!(
                    "captures {} and {} both at x = {} mm, y = {} mm",
                    j + 1,
                    i + 1,
                    a.1,
                    a.0
                ),
                "each capture has its own position",
                "Check the file, or join captures of one position into one multi-page file.",
            ));
        }
    }
    Ok(())
}

/// The place nearest to the middle of the box around all.
fn middle(positions: &[(f64, f64)]) -> usize {
    let mid = |of: fn(&(f64, f64)) -> f64| {
        let values = || positions.iter().map(of);
        0.5 * (values().fold(f64::INFINITY, f64::min) + values().fold(f64::NEG_INFINITY, f64::max))
    };
    let (y, x) = (mid(|p| p.0), mid(|p| p.1));
    let distance = |i: &usize| (positions[*i].0 - y).hypot(positions[*i].1 - x);
    let nearest = (0..positions.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.expect("there are places")
}

/// Intensity over its local mean, less 1; zero where it is dark. An envelope or a vignette
/// that stays while the speckle moves would hold the peak at zero.
fn flattened(light: &Image, grain: f64) -> Image {
    let sigma = (6.0 * grain).min(light.rows().min(light.columns()) as f64 / 6.0);
    let mean = smoothed(light, sigma);
    let least = 0.1 * mean.max();
    Image::from_fn(light.rows(), light.columns(), |y, x| {
        if mean.at(y, x) > least {
            light.at(y, x) / mean.at(y, x) - 1.0
        } else {
            0.0
        }
    })
}

fn energy(image: &Image) -> f64 {
    image.data().iter().map(|&v| f64::from(v).powi(2)).sum()
}

fn near_prediction(correlation: &Correlation, predicted: (f64, f64), grain: f64) -> (f64, f64) {
    let inside = |d: f64, n: usize| d.abs() < n as f64 / 2.0;
    if !(inside(predicted.0, correlation.rows) && inside(predicted.1, correlation.columns)) {
        return predicted;
    }
    // A stage and a lens are true to about a grain.
    let peak = correlation.highest_near(predicted, grain.max(1.5));
    let refined = correlation.refine(peak);
    if (refined.0 - predicted.0).hypot(refined.1 - predicted.1) <= grain.max(1.5) + 0.5 {
        refined
    } else {
        predicted
    }
}

/// Correlation of `moved`, taken back by `shift`, with `still`: of the whole captures, and
/// of the parts where both are lit.
fn registered(moved: &Image, still: &Image, shift: (f64, f64)) -> (f64, f64) {
    let (rows, columns) = (still.rows(), still.columns());
    let back = shifted(moved, rows, columns, -shift.0, -shift.1);
    // The interpolation reads seven pixels to each side.
    let range = |n: usize, d: f64| {
        let from = (7.0 - d).ceil().max(0.0) as usize;
        let to = ((n as f64 - 7.0 - d).floor().max(0.0) as usize).min(n);
        from..to.max(from)
    };
    let mut sums = Sums::default();
    let product = back.data().iter().zip(still.data());
    let product: f64 = product.map(|(a, b)| f64::from(a * b)).sum();
    let whole = product
        / (energy(moved) * energy(still))
            .sqrt()
            .max(f64::MIN_POSITIVE);
    for y in range(rows, shift.0) {
        for x in range(columns, shift.1) {
            let (a, b) = (back.at(y, x), still.at(y, x));
            if a != 0.0 && b != 0.0 {
                sums.add(f64::from(a), f64::from(b));
            }
        }
    }
    (whole, sums.correlation())
}

type Matrix = [[f64; 2]; 2];

fn mapped(m: &Matrix, d: (f64, f64)) -> (f64, f64) {
    (m[0][0] * d.0 + m[0][1] * d.1, m[1][0] * d.0 + m[1][1] * d.1)
}

/// Least squares of `shift = M·delta` over the `fitted`, from which those farther than two
/// grains off are taken out, the worst first.
fn fit(
    delta: &[(f64, f64)],
    shifts: &[(f64, f64)],
    fitted: &mut [bool],
    reference: usize,
    grain: f64,
) -> Result<Matrix> {
    fitted[reference] = true;
    loop {
        let used: Vec<usize> = (0..delta.len()).filter(|&i| fitted[i]).collect();
        if used.len() < 2 {
            return Err(Error::input(
                Parameter::Captures,
                "no capture that shows the same pattern as the one nearest the middle",
                format!(
                    "the shift per millimetre needs captures with a correlation above {TRUSTED}"
                ),
                phrase![
                    "Record the source in smaller steps around the middle, and check that ",
                    Parameter::PositionsMm,
                    " names the right captures."
                ],
            ));
        }
        let m = least_squares(delta, shifts, &used);
        let off = |i: usize| {
            let (y, x) = mapped(&m, delta[i]);
            (shifts[i].0 - y).hypot(shifts[i].1 - x)
        };
        let worst = used
            .iter()
            .copied()
            .max_by(|&a, &b| off(a).total_cmp(&off(b)));
        match worst {
            Some(i) if i != reference && off(i) > (2.0 * grain).max(3.0) => fitted[i] = false,
            _ => return Ok(m),
        }
    }
}

fn least_squares(delta: &[(f64, f64)], shifts: &[(f64, f64)], used: &[usize]) -> Matrix {
    let (mut s, mut c) = ([[0.0; 2]; 2], [[0.0; 2]; 2]);
    for &i in used {
        let d = [delta[i].0, delta[i].1];
        let v = [shifts[i].0, shifts[i].1];
        for a in 0..2 {
            for b in 0..2 {
                s[a][b] += d[a] * d[b];
                c[a][b] += v[a] * d[b];
            }
        }
    }
    // Pseudo-inverse of the symmetric S by its eigenvectors: places along a line leave
    // one direction open, along which nothing is claimed.
    let (values, vectors) = eigen(s);
    let mut inverse = [[0.0; 2]; 2];
    for (value, u) in values.iter().zip(vectors) {
        if *value > 1e-6 * values[0] {
            for a in 0..2 {
                for b in 0..2 {
                    inverse[a][b] += u[a] * u[b] / value;
                }
            }
        }
    }
    let mut m = [[0.0; 2]; 2];
    for a in 0..2 {
        for b in 0..2 {
            m[a][b] = c[a][0] * inverse[0][b] + c[a][1] * inverse[1][b];
        }
    }
    m
}

/// Eigenvalues, the larger first, and unit eigenvectors of a symmetric matrix.
fn eigen(s: Matrix) -> ([f64; 2], [[f64; 2]; 2]) {
    let angle = 0.5 * (2.0 * s[0][1]).atan2(s[0][0] - s[1][1]);
    let (sin, cos) = angle.sin_cos();
    let (u, v) = ([cos, sin], [-sin, cos]);
    let value = |w: [f64; 2]| {
        w[0] * (s[0][0] * w[0] + s[0][1] * w[1]) + w[1] * (s[1][0] * w[0] + s[1][1] * w[1])
    };
    ([value(u), value(v)], [u, v])
}

/// `|M u|` along the line `u` of the places, or `√|det M|` of places in a plane.
fn magnitude(m: &Matrix, delta: &[(f64, f64)]) -> f64 {
    let mut s = [[0.0; 2]; 2];
    for d in delta {
        for (a, da) in [d.0, d.1].into_iter().enumerate() {
            for (b, db) in [d.0, d.1].into_iter().enumerate() {
                s[a][b] += da * db;
            }
        }
    }
    let (values, vectors) = eigen(s);
    let determinant = (m[0][0] * m[1][1] - m[0][1] * m[1][0]).abs().sqrt();
    if values[1] > 1e-3 * values[0] && determinant > 0.0 {
        return determinant;
    }
    let (y, x) = mapped(m, (vectors[0][0], vectors[0][1]));
    y.hypot(x)
}

/// Distance at which the curve, averaged over equal distances, first falls to `level`.
fn falls_to(curve: &[(f64, f64)], level: f64) -> Option<f64> {
    let mut means: Vec<(f64, f64, f64)> = Vec::new();
    for &(d, v) in curve {
        match means.last_mut() {
            Some(last) if (d - last.0).abs() < 1e-6 * d.max(1e-9) => {
                last.1 += v;
                last.2 += 1.0;
            }
            _ => means.push((d, v, 1.0)),
        }
    }
    let means: Vec<(f64, f64)> = means.iter().map(|m| (m.0, m.1 / m.2)).collect();
    let pair = means
        .windows(2)
        .find(|w| w[0].1 >= level && w[1].1 < level)?;
    let part = (pair[0].1 - level) / (pair[0].1 - pair[1].1);
    Some(pair[0].0 + part * (pair[1].0 - pair[0].0))
}
