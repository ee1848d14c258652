//! Pixels that cannot be trusted: hot, dead, unstable.

use super::levels::Level;
use super::stack::{Moments, Stack};
use super::stats::{RARE_Z, centre_and_sigma, chi_square_per_dof, mean, median};
use super::transfer::TransferLine;
use rowburst_optics::Image;

/// Dark level beyond which a pixel is hot (or has no bias), in standard deviations of
/// all pixels about their row and column. The offsets of real sensors have longer tails than
/// a Gaussian: of a Laplace distribution 1 in 4000 pixels lies beyond 8.
const HOT: f64 = 8.0;

/// Response below which, relative to its neighbourhood, a pixel is dead, and above the
/// inverse of which it is as useless: real pixels differ by percents.
const DEAD: f64 = 0.5;

/// By how many of its standard errors a response must lie off: faint flats prove nothing.
const DEAD_ERRORS: f64 = 6.0;

/// Noise above which a pixel is unstable, over what is expected of it. Good pixels differ in
/// noise by up to two; the weight of one with three would be nine times too large.
const UNSTABLE: f64 = 3.0;

/// Variance of rounding to whole counts.
pub const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

/// Sides with fewer pixels have no profile of their own.
const MIN_PROFILE_LENGTH: usize = 16;

/// Pixels whose dark level stands out from their row and column.
pub fn hot(dark: &Moments, columns: usize, has_integer_counts: bool) -> Vec<bool> {
    let mut left = dark.mean.clone();
    let rows = left.len() / columns;
    if columns >= MIN_PROFILE_LENGTH {
        for row in left.chunks_exact_mut(columns) {
            let level = median(&mut row.to_vec());
            row.iter_mut().for_each(|v| *v -= level);
        }
    }
    if rows >= MIN_PROFILE_LENGTH {
        for x in 0..columns {
            let mut column: Vec<f64> = left.iter().skip(x).step_by(columns).copied().collect();
            let level = median(&mut column);
            let pixels = left.iter_mut().skip(x).step_by(columns);
            pixels.for_each(|v| *v -= level);
        }
    }
    let (centre, spread) = centre_and_sigma(left.iter().copied());
    let frames = dark.dof + 1.0;
    // Where most pixels have exactly one value the spread is that of their noise at least.
    let noise = (typical_variance(dark) / frames).sqrt();
    let rounding = if has_integer_counts {
        (ROUNDING_VARIANCE / frames).sqrt()
    } else {
        0.0
    };
    let bound = HOT * spread.max(noise).max(rounding);
    left.iter().map(|v| (v - centre).abs() > bound).collect()
}

/// Median variance of a pixel over the frames, free of the bias that few frames have.
///
/// Neighbours are pooled until 30 degrees of freedom are together: the variances of
/// three frames of whole counts have only a few possible values, and their median none between.
pub fn typical_variance(moments: &Moments) -> f64 {
    const MIN_POOLED_DOF: f64 = 30.0;
    let run = (MIN_POOLED_DOF / moments.dof).ceil() as usize;
    let run = run.min(moments.variance.len()).max(1);
    let pooled = moments.variance.chunks_exact(run);
    let mut pooled: Vec<f64> = pooled.map(|v| v.iter().sum::<f64>() / run as f64).collect();
    median(&mut pooled) / chi_square_per_dof(moments.dof * run as f64, 0.0)
}

/// Light of each pixel over the flats of `levels`, and its standard error in the same unit.
pub fn response(flats: &Stack, levels: &[&Level], dark: &[f64]) -> (Vec<f64>, f64) {
    let frames = || levels.iter().flat_map(|level| &level.frames);
    let count = frames().count() as f64;
    let mut light = vec![0.0; dark.len()];
    for &i in frames() {
        let pixels = flats.image(i).data().iter().zip(dark);
        light
            .iter_mut()
            .zip(pixels)
            .for_each(|(sum, (&p, d))| *sum += f64::from(p) - d);
    }
    light.iter_mut().for_each(|v| *v /= count);
    (light, count)
}

/// Pixels whose `response`, good to `error`, is far from that of their neighbours.
pub fn dead(response: &[f64], error: impl Fn(f64) -> f64, columns: usize) -> Vec<bool> {
    let rows = response.len() / columns;
    let mut around = Vec::with_capacity(25);
    let mut flags = vec![false; response.len()];
    for y in 0..rows {
        for x in 0..columns {
            around.clear();
            for yy in y.saturating_sub(2)..(y + 3).min(rows) {
                let row = &response[yy * columns..(yy + 1) * columns];
                around.extend_from_slice(&row[x.saturating_sub(2)..(x + 3).min(columns)]);
            }
            let expected = median(&mut around);
            let found = response[y * columns + x];
            let odd = found < DEAD * expected || found * DEAD > expected;
            let off = (found - expected).abs() > DEAD_ERRORS * error(expected.max(found));
            flags[y * columns + x] = odd && off && expected > 0.0;
        }
    }
    flags
}

/// Pixels whose variance over `dof` + 1 frames is out of all proportion to `expected`.
pub fn unstable(variance: &[f64], expected: impl Fn(usize) -> f64, dof: f64) -> Vec<bool> {
    let mut ratios: Vec<f64> = (0..variance.len())
        .map(|i| variance[i] / expected(i).max(f64::MIN_POSITIVE))
        .collect();
    // What all pixels have more than expected, such as a lamp that flickers, is no fault of one.
    let common = median(&mut ratios.clone()) / chi_square_per_dof(dof, 0.0);
    let bound = chi_square_per_dof(dof, RARE_Z).max(UNSTABLE * UNSTABLE) * common.max(1.0);
    ratios.iter_mut().map(|&mut ratio| ratio > bound).collect()
}

/// Unstable pixels of the flats: their variance within each level against `line`.
pub fn unstable_in_light(
    flats: &Stack,
    levels: &[&Level],
    dark: &[f64],
    line: &TransferLine,
) -> Vec<bool> {
    let mut squares = vec![0.0; dark.len()];
    let mut dof = 0.0;
    for level in levels.iter().filter(|level| level.frames.len() > 1) {
        let (light, count) = response(flats, &[level], dark);
        let mean_light = mean(light.iter().copied());
        dof += count - 1.0;
        for &i in &level.frames {
            let pixels = flats.image(i).data();
            let frame_mean = mean(pixels.iter().zip(dark).map(|(&p, d)| f64::from(p) - d));
            let scale = mean_light / frame_mean;
            let readings = pixels.iter().zip(dark).zip(&light);
            squares
                .iter_mut()
                .zip(readings)
                .for_each(|(sum, ((&p, d), m))| {
                    let difference = scale * (f64::from(p) - d) - m;
                    *sum += difference * difference / line.at(m.max(0.0)).max(f64::MIN_POSITIVE);
                });
        }
    }
    if dof == 0.0 {
        return vec![false; dark.len()];
    }
    squares.iter_mut().for_each(|s| *s /= dof);
    unstable(&squares, |_| 1.0, dof)
}

/// Standard deviation of the pixels' own response relative to its mean (PRNU): that of
/// differences of neighbours, less the part of variance `noise` that the flats still have.
pub fn non_uniformity(response: &Image, usable: &[bool], noise: f64) -> f64 {
    let columns = response.columns();
    let pairs = (1..usable.len()).filter(|i| i % columns != 0 && usable[*i] && usable[i - 1]);
    let differences = pairs.map(|i| f64::from(response.data()[i] - response.data()[i - 1]));
    let (_, sigma) = centre_and_sigma(differences);
    (0.5 * sigma * sigma - noise).max(0.0).sqrt()
}

/// Largest over smallest part of the mean by which the light varies over the field:
/// medians of a grid of blocks.
pub fn unevenness(response: &Image, usable: &[bool]) -> f64 {
    const BLOCKS: usize = 8;
    let (rows, columns) = (response.rows(), response.columns());
    let (high, wide) = (rows.div_ceil(BLOCKS), columns.div_ceil(BLOCKS));
    let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
    for y in (0..rows).step_by(high) {
        for x in (0..columns).step_by(wide) {
            let block = (y..(y + high).min(rows))
                .flat_map(|y| (x..(x + wide).min(columns)).map(move |x| y * columns + x));
            let mut block: Vec<f64> = block
                .filter(|&i| usable[i])
                .map(|i| f64::from(response.data()[i]))
                .collect();
            if !block.is_empty() {
                let middle = median(&mut block);
                (least, most) = (least.min(middle), most.max(middle));
            }
        }
    }
    most - least
}
