//! The photon transfer curve: variance over light gives electrons per count.
//!
//! ```text
//! variance = read² + light/gain         counts², counts, electrons per count
//! d = (a − D) − s·(b − D),   light = ⟨a + b − 2D⟩/2,   variance = ⟨d²⟩/(2s)
//! ```
//!
//! `a` and `b` are two flats of one level, `D` the mean dark, `s` the ratio of their
//! light, row by row. The difference has no fixed pattern (PRNU, dust, uneven light);
//! `s` takes out what the lamp does between and during the readouts, and row noise.
//! Reference: J. R. Janesick, Photon Transfer (SPIE 2007), chapters 5 and 6;
//! EMVA 1288 release 4.0, section 6.

use super::levels::Level;
use super::stack::Stack;
use super::stats::centre_and_sigma;

/// A point of the curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransferPoint {
    /// Mean counts above dark.
    pub light: f64,
    /// Variance of a pixel in counts².
    pub variance: f64,
    /// Differences that it comes from.
    pub samples: f64,
    /// Index of its level; `None` for the darks.
    pub level: Option<usize>,
    /// Whether the line was fitted to it.
    pub used: bool,
}

/// The line through the curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransferLine {
    /// Variance without light, counts².
    pub dark_variance: f64,
    /// Variance per light: counts² per count, 1/gain.
    pub slope: f64,
    /// Standard error of `slope`.
    pub slope_error: f64,
}

/// Bins of brightness in which the pixels of a level are taken together: the field is
/// never even, and each bin is a point of its own.
const BRIGHTNESS_BINS: usize = 8;

/// Fewest pixels of a bin: a variance of 500 differences is good to 6 %.
const MIN_PIXELS: usize = 500;

/// Differences beyond this many standard deviations are no shot noise (cosmic rays,
/// flashing pixels); a Gaussian loses 1e-7 of its variance.
const OUTLIER_SIGMAS: f64 = 6.0;

/// Error that a point keeps however many pixels it has: cameras are not linear to
/// better than a percent.
const MODEL_ERROR: f64 = 0.01;

/// Part of the light at saturation up to which the line is fitted, as EMVA 1288 has it:
/// above, real sensors bend.
const FIT_RANGE: f64 = 0.7;

/// Flats, and what is known of their pixels.
#[derive(Debug, Clone, Copy)]
pub struct FlatSeries<'a> {
    /// The flats.
    pub flats: &'a Stack,
    /// Their levels.
    pub levels: &'a [Level],
    /// Counts of each pixel without light.
    pub dark: &'a [f64],
    /// Light of each pixel, in any unit.
    pub response: &'a [f64],
    /// Whether a pixel is to be used.
    pub usable: &'a [bool],
}

/// Points of all levels with at least two frames, the point of the darks first:
/// `dark_variance` is the variance of a dark pixel without row noise, from `dark_samples`
/// degrees of freedom.
pub fn curve(series: FlatSeries, (dark_variance, dark_samples): (f64, f64)) -> Vec<TransferPoint> {
    let mut points = vec![TransferPoint {
        light: 0.0,
        variance: dark_variance,
        samples: dark_samples,
        level: None,
        used: true,
    }];
    let (bin_of, bins) = brightness_bins(series.response, series.usable);
    for (index, level) in series.levels.iter().enumerate() {
        let mut sums = vec![Sum::default(); bins];
        for pair in level.frames.chunks_exact(2) {
            add_pair(
                series,
                (pair[0], pair[1]),
                dark_variance,
                &bin_of,
                &mut sums,
            );
        }
        let filled = sums.iter().filter(|s| s.samples > 0.0);
        points.extend(filled.map(|sum| TransferPoint {
            light: sum.light / sum.samples,
            variance: sum.squares / sum.samples,
            samples: sum.samples,
            level: Some(index),
            used: false,
        }));
    }
    points
}

#[derive(Debug, Clone, Default)]
struct Sum {
    light: f64,
    squares: f64,
    samples: f64,
}

/// Bin of each pixel, `None` for those not usable; and the number of bins.
fn brightness_bins(response: &[f64], usable: &[bool]) -> (Vec<Option<u8>>, usize) {
    let mut order: Vec<usize> = (0..response.len()).filter(|&i| usable[i]).collect();
    order.sort_unstable_by(|&a, &b| response[a].total_cmp(&response[b]));
    let bins = (order.len() / MIN_PIXELS).clamp(1, BRIGHTNESS_BINS);
    let mut bin_of = vec![None; response.len()];
    for (rank, &pixel) in order.iter().enumerate() {
        bin_of[pixel] = Some((rank * bins / order.len()) as u8);
    }
    (bin_of, bins)
}

/// Adds the scaled differences of frames `a` and `b` to the sums of their bins.
fn add_pair(
    FlatSeries { flats, dark, .. }: FlatSeries,
    (a, b): (usize, usize),
    dark_variance: f64,
    bin_of: &[Option<u8>],
    sums: &mut [Sum],
) {
    let columns = flats.size().1;
    let (a, b) = (flats.image(a), flats.image(b));
    let rows = || (0..dark.len()).step_by(columns).map(|at| at..at + columns);
    let light = |range: std::ops::Range<usize>| {
        range
            .filter(|&i| bin_of[i].is_some())
            .fold((0.0, 0.0, 0.0), |(la, lb, n), i| {
                let (pa, pb) = (f64::from(a.data()[i]), f64::from(b.data()[i]));
                (la + pa - dark[i], lb + pb - dark[i], n + 1.0)
            })
    };
    let (all_a, all_b, _) = light(0..dark.len());
    let frame_ratio = if all_b > 0.0 { all_a / all_b } else { 1.0 };
    let mut differences: Vec<Vec<f64>> = vec![Vec::new(); sums.len()];
    for row in rows() {
        let (row_a, row_b, count) = light(row.clone());
        // A row with hardly any light says nothing about the lamp.
        let enough = 10.0 * (count * dark_variance).sqrt();
        let by_row = count > 2.0 && row_a.min(row_b) > enough;
        let (ratio, freedom) = if by_row {
            (row_a / row_b, count / (count - 1.0))
        } else {
            (frame_ratio, 1.0)
        };
        let unit = (freedom / (2.0 * ratio)).sqrt();
        for i in row {
            let Some(bin) = bin_of[i].map(usize::from) else {
                continue;
            };
            let above_a = f64::from(a.data()[i]) - dark[i];
            let above_b = f64::from(b.data()[i]) - dark[i];
            differences[bin].push(unit * (above_a - ratio * above_b));
            sums[bin].light += 0.5 * (above_a + above_b);
            sums[bin].samples += 1.0;
        }
    }
    for (sum, differences) in sums.iter_mut().zip(&differences) {
        let (_, sigma) = centre_and_sigma(differences.iter().copied());
        let bound = if sigma > 0.0 {
            OUTLIER_SIGMAS * sigma
        } else {
            f64::INFINITY
        };
        let tame = differences.iter().filter(|d| d.abs() <= bound);
        let (squares, kept) = tame.fold((0.0, 0.0), |(s, n), d| (s + d * d, n + 1.0));
        if kept > 0.0 {
            sum.squares += squares / kept * differences.len() as f64;
        }
    }
}

/// Light and variance of each level, over all its points.
pub fn by_level(points: &[TransferPoint], levels: usize) -> Vec<Option<(f64, f64)>> {
    (0..levels)
        .map(|level| {
            let level_points = points.iter().filter(|p| p.level == Some(level));
            let (l, v, n) = level_points.fold((0.0, 0.0, 0.0), |(l, v, n), p| {
                (
                    l + p.samples * p.light,
                    v + p.samples * p.variance,
                    n + p.samples,
                )
            });
            (n > 0.0).then(|| (l / n, v / n))
        })
        .collect()
}

/// Light at which the variance falls though the light rises: the pixels are full.
pub fn turnover(points: &[TransferPoint], levels: usize) -> Option<f64> {
    let curve: Vec<(f64, f64)> = by_level(points, levels).into_iter().flatten().collect();
    let peak = curve.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1))?;
    // Shot noise grows with the light: a fall to 70 % is no scatter.
    let falls = |&(light, variance): &(f64, f64)| light > peak.0 && variance < 0.7 * peak.1;
    curve.iter().any(falls).then_some(peak.0)
}

/// Marks the points that the line is to be fitted to: whole levels below `full`.
pub fn choose(points: &mut [TransferPoint], levels: &[Level], full: Option<f64>) {
    let whole = |p: &TransferPoint| p.level.is_none_or(|l| levels[l].is_unclipped());
    let mut mark = |limit: f64| {
        for p in points.iter_mut() {
            p.used = whole(p) && p.light <= limit;
        }
        points.iter().any(|p| p.used && p.level.is_some())
    };
    let Some(full) = full else {
        mark(f64::INFINITY);
        return;
    };
    if !mark(FIT_RANGE * full) {
        mark(full);
    }
}

/// The line through the points in use, by weighted least squares with Huber's weights;
/// `None` where it does not rise.
pub fn fit(points: &[TransferPoint]) -> Option<TransferLine> {
    const HUBER: f64 = 1.5;
    let used: Vec<&TransferPoint> = points.iter().filter(|p| p.used).collect();
    let sigma = |p: &TransferPoint, variance: f64| {
        (variance * (2.0 / p.samples.max(2.0) + MODEL_ERROR * MODEL_ERROR).sqrt()).max(1e-12)
    };
    let mut sigmas: Vec<f64> = used.iter().map(|p| sigma(p, p.variance)).collect();
    let mut trust = vec![1.0; used.len()];
    let mut line = None;
    for _ in 0..20 {
        let (mut s, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for ((p, sigma), trust) in used.iter().zip(&sigmas).zip(&trust) {
            let w = trust / (sigma * sigma);
            s += w;
            sx += w * p.light;
            sy += w * p.variance;
            sxx += w * p.light * p.light;
            sxy += w * p.light * p.variance;
        }
        let determinant = s * sxx - sx * sx;
        let slope = (s * sxy - sx * sy) / determinant;
        let found = TransferLine {
            dark_variance: (sy - slope * sx) / s,
            slope,
            slope_error: (s / determinant).sqrt(),
        };
        if !(slope.is_finite() && slope > 0.0) {
            return None;
        }
        for ((p, sigma_of), trust) in used.iter().zip(&mut sigmas).zip(&mut trust) {
            let expected = found.at(p.light);
            *sigma_of = sigma(p, expected);
            *trust = (HUBER * *sigma_of / (p.variance - expected).abs()).min(1.0);
        }
        line = Some(found);
    }
    line
}

impl TransferLine {
    /// Variance expected at `light`, counts².
    pub fn at(&self, light: f64) -> f64 {
        (self.dark_variance + self.slope * light).max(0.0)
    }
}
