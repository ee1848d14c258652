//! Where no light is: the floor of captures without a dark frame, and what lies below
//! the noise.

use super::filter::smoothed;
use rowburst_optics::Image;

/// Counts without light, read from a capture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlackLevel {
    /// The floor.
    pub counts: f64,
    /// Whether it was read from a region without light; else from the darkest places
    /// between grains, which are dark only in speckle of full contrast.
    pub is_from_dark_region: bool,
}

/// Part of the pixels that lie below the floor of a pattern that fills the image: of
/// fully developed speckle it is darker than a thousandth of its mean.
const BLACK_LEVEL_QUANTILE: f64 = 1e-3;

/// Side of the cells that are looked through for an unlit one, against the image.
const CELLS: usize = 24;

/// The floor of `image`.
pub(super) fn estimate_black_level(image: &Image) -> BlackLevel {
    if let Some(counts) = unlit_level(image) {
        return BlackLevel {
            counts,
            is_from_dark_region: true,
        };
    }
    // Noise alone would reach below the floor: it is averaged over a twelfth of a grain,
    // which leaves the places between grains dark.
    let calm = smoothed(image, rough_grain(image) / 12.0);
    let mut values = calm.data().to_vec();
    let at = ((values.len() as f64 * BLACK_LEVEL_QUANTILE) as usize).min(values.len() - 1);
    let (_, value, _) = values.select_nth_unstable_by(at, f32::total_cmp);
    BlackLevel {
        counts: f64::from(*value),
        is_from_dark_region: false,
    }
}

/// The level of the part of `image` without light, in its unit, where that is even: a twentieth of the image or more has it to
/// within noise. Smooth light falls off towards the edges and is not even. `None`: no part is, or it is too small to tell.
#[must_use]
pub fn even_floor(image: &Image) -> Option<f64> {
    let level = unlit_level(image)?;
    let side = cell_side(image);
    let allowed = MAX_DEVIATION * noise_of(image) / side as f64 + MAX_ROUNDING * level;
    let means = image.binned(side);
    let even = means.data().iter();
    let even = even.filter(|mean| (f64::from(**mean) - level).abs() <= allowed);
    let part = even.count() as f64 / means.data().len() as f64;
    (part >= MIN_EVEN_PART).then_some(level)
}

/// Part of the image that has the level of its darkest cells, where that is a floor.
const MIN_EVEN_PART: f64 = 0.05;

/// Standard errors by which the mean of a cell may differ from that level.
const MAX_DEVIATION: f64 = 3.0;

/// Side in pixels of the cells that are looked through for an unlit one.
fn cell_side(image: &Image) -> usize {
    (image.rows().min(image.columns()) / CELLS).max(4)
}

/// Mean of the darkest cells, if they are even or hold noise alone: neighbouring pixels of noise are
/// independent, those of speckle alike.
fn unlit_level(image: &Image) -> Option<f64> {
    let side = cell_side(image);
    if image.rows() < 4 * side || image.columns() < 4 * side {
        return None;
    }
    let means = image.binned(side);
    let mut order: Vec<usize> = (0..means.data().len()).collect();
    order.sort_by(|&a, &b| means.data()[a].total_cmp(&means.data()[b]));
    order.truncate((order.len() / 50).max(2));
    let (mut variance, mut shared, mut level) = (0.0, 0.0, 0.0);
    for &cell in &order {
        let mean = f64::from(means.data()[cell]);
        let (y0, x0) = (cell / means.columns() * side, cell % means.columns() * side);
        level += mean / order.len() as f64;
        for y in y0..y0 + side {
            for x in x0..x0 + side - 1 {
                let at = |y, x| f64::from(image.at(y, x)) - mean;
                variance += at(y, x).powi(2);
                shared += at(y, x) * at(y, x + 1);
            }
        }
    }
    let pixels = (order.len() * side * (side - 1)) as f64;
    let is_noise = shared < MAX_NEIGHBOUR_CORRELATION * variance
        && variance / pixels < MAX_CELL_VARIANCE_RATIO * variance_of(image);
    // Single precision rounds even cells.
    let is_even = variance / pixels <= (MAX_ROUNDING * level).powi(2);
    (is_noise || is_even).then_some(level)
}

/// Correlation of neighbouring pixels above which a cell is lit: grains of two pixels
/// have 0.5.
const MAX_NEIGHBOUR_CORRELATION: f64 = 0.25;

/// Standard deviation of a cell against its mean up to which it is even.
const MAX_ROUNDING: f64 = 1e-5;

/// Variance of an unlit cell against that of the whole image: fine speckle has alike ones.
const MAX_CELL_VARIANCE_RATIO: f64 = 0.1;

fn variance_of(image: &Image) -> f64 {
    let count = image.data().len() as f64;
    let mean = image.data().iter().map(|&p| f64::from(p)).sum::<f64>() / count;
    let squares = image.data().iter().map(|&p| (f64::from(p) - mean).powi(2));
    squares.sum::<f64>() / count
}

/// Rough size of the structure in pixels, from how fast neighbours part: for a Gaussian
/// autocovariance of FWHM `g`, `1 − c(2)/c(1) ≈ 3·4 ln 2/g²`.
fn rough_grain(image: &Image) -> f64 {
    let mean = image.data().iter().map(|&p| f64::from(p)).sum::<f64>() / image.data().len() as f64;
    let covariance = |d: usize| {
        let mut sum = 0.0;
        for y in 0..image.rows() {
            let row = image.row(y);
            let pairs = row.iter().zip(row.iter().skip(d));
            sum += pairs
                .map(|(a, b)| (f64::from(*a) - mean) * (f64::from(*b) - mean))
                .sum::<f64>();
        }
        sum
    };
    let (one, two) = (covariance(1), covariance(2));
    if one <= 0.0 || two <= 0.0 {
        return 1.0;
    }
    let fall = (one / two).ln().max(1e-3);
    (3.0 * 4.0 * std::f64::consts::LN_2 / fall)
        .sqrt()
        .clamp(1.0, 30.0)
}

/// What [`suppress_noise`] left.
#[derive(Debug, Clone, PartialEq)]
pub struct DenoisedLight {
    /// The light, non-negative.
    pub image: Image,
    /// Part of the pixels that were set to zero as unlit.
    pub zeroed_fraction: f64,
}

/// Sets to zero what noise alone can be.
///
/// A threshold of `k·σ` on every pixel would empty the dark places between grains and
/// raise the contrast. So only pixels around which no light is found are emptied: those
/// where the mean over two grains is below `k` times the noise of such a mean.
/// Elsewhere only negative values become zero.
pub fn suppress_noise(light: &Image, grain: f64, sigma: f64, k: f64) -> DenoisedLight {
    let scale = (2.0 * grain).max(2.0);
    let mean = smoothed(light, scale);
    let independent = 4.0 * std::f64::consts::PI * scale * scale;
    let least = (k * sigma / independent.sqrt()) as f32;
    let is_empty = |y: usize, x: usize| sigma > 0.0 && mean.at(y, x) < least;
    let image = Image::from_fn(light.rows(), light.columns(), |y, x| {
        if is_empty(y, x) {
            0.0
        } else {
            light.at(y, x).max(0.0)
        }
    });
    let mut empty = 0;
    for y in 0..light.rows() {
        empty += (0..light.columns()).filter(|&x| is_empty(y, x)).count();
    }
    DenoisedLight {
        zeroed_fraction: empty as f64 / light.data().len() as f64,
        image,
    }
}

/// Standard deviation of the noise of single pixels where `light` is darkest: from second
/// differences across the diagonal, which a smooth background does not enter.
pub fn noise_of(light: &Image) -> f64 {
    let mut squares: Vec<(f32, f64)> = Vec::new();
    for y in (0..light.rows().saturating_sub(1)).step_by(2) {
        for x in (0..light.columns().saturating_sub(1)).step_by(2) {
            let block = [
                light.at(y, x),
                light.at(y, x + 1),
                light.at(y + 1, x),
                light.at(y + 1, x + 1),
            ];
            let twist = f64::from(block[0] - block[1] - block[2] + block[3]) / 2.0;
            squares.push((block.iter().sum(), twist * twist));
        }
    }
    if squares.is_empty() {
        return 0.0;
    }
    // The darkest tenth: shot noise of bright grains is not the floor's.
    let tenth = (squares.len() / 10).max(1);
    if tenth < squares.len() {
        squares.select_nth_unstable_by(tenth, |a, b| a.0.total_cmp(&b.0));
    }
    let mut dark: Vec<f64> = squares[..tenth].iter().map(|s| s.1).collect();
    // The median of a squared normal variable is 0.455 of its mean.
    dark.sort_by(f64::total_cmp);
    (dark[dark.len() / 2] / 0.455).sqrt()
}
