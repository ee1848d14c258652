//! Contrast, grain and histogram of a speckle pattern.
//!
//! Light of one colour from a true point behind a strong diffuser is fully developed
//! speckle: the intensity over its local mean follows the negative exponential
//! `exp(−I/⟨I⟩)`, of contrast 1 (J. W. Goodman, Speckle Phenomena in Optics, 2nd ed.,
//! chapters 3 and 4). A source wider than a grain, a broad spectrum, vibration and pixels
//! wider than a grain lower the contrast, and with it what a frame tells of the scene.

use super::envelope::local_mean;
use super::fourier::Spectrum;
use rowburst_optics::Image;

/// What the pattern says about source and diffuser.
#[derive(Debug, Clone, PartialEq)]
pub struct SpeckleStatistics {
    /// Standard deviation over mean of the intensity divided by its local mean (over 12
    /// grains), in the lit region, without the pixels' own noise.
    pub contrast: f64,
    /// Full width at half maximum of the autocovariance: geometric mean of `y` and `x`.
    pub grain_px: f64,
    /// The same along `y`.
    pub grain_y_px: f64,
    /// The same along `x`.
    pub grain_x_px: f64,
    /// Part of the variance that is noise of single pixels; 0 where grains of fewer than
    /// four pixels do not let the two be told apart.
    pub noise_fraction: f64,
    /// Autocovariance against displacement in pixels along `y`, 1 at zero.
    pub autocovariance_y: Vec<f64>,
    /// The same along `x`.
    pub autocovariance_x: Vec<f64>,
    /// Density of `I/⟨I⟩` in bins of [`HISTOGRAM_BIN_WIDTH`], from 0.
    pub histogram: Vec<f64>,
    /// Kolmogorov–Smirnov distance to the negative exponential: the largest difference
    /// of the two cumulative distributions, 0 to 1.
    pub exponential_distance: f64,
    /// Part of the image that is lit: its local mean is above a tenth of the highest.
    pub lit_fraction: f64,
    /// Part of the pixels at the image's edges that are lit: what lies beyond was not
    /// recorded.
    pub lit_edge_fraction: f64,
    /// The local mean over its largest value, `[y, x]`.
    pub envelope: Image,
}

/// Width of the histogram's bins in units of the local mean.
pub const HISTOGRAM_BIN_WIDTH: f64 = 0.2;
const BINS: usize = 40;

/// Part of the highest local mean above which a pixel counts as lit: below it floor and
/// noise weigh as much as the speckle.
const MIN_RELATIVE_ENVELOPE: f64 = 0.1;

/// Statistics of `light`, non-negative and without its floor.
pub fn statistics(light: &Image) -> SpeckleStatistics {
    let short = light.rows().min(light.columns());
    let mut grain = short as f64 / 50.0;
    let mut result = None;
    // The local mean needs the grain, which needs the local mean: the second round
    // changes the grain by some per cent, the third by less than one.
    for _ in 0..3 {
        let envelope = local_mean(light, grain);
        let normalised = NormalisedSpeckle::new(light, &envelope);
        let auto = Autocovariance::of(&normalised);
        grain = (auto.width_y * auto.width_x)
            .sqrt()
            .clamp(1.0, short as f64 / 4.0);
        result = Some((envelope, normalised, auto));
    }
    let (mut envelope, normalised, auto) = result.expect("there are three rounds");
    let top = high(&envelope);
    envelope
        .data_mut()
        .iter_mut()
        .for_each(|p| *p = (*p / top).min(1.0));
    let (histogram, distance) = normalised.against_exponential();
    SpeckleStatistics {
        contrast: (auto.variance * (1.0 - auto.noise_fraction)).sqrt() / normalised.mean,
        grain_px: (auto.width_y * auto.width_x).sqrt(),
        grain_y_px: auto.width_y,
        grain_x_px: auto.width_x,
        noise_fraction: auto.noise_fraction,
        autocovariance_y: auto.along_y,
        autocovariance_x: auto.along_x,
        histogram,
        exponential_distance: distance,
        lit_fraction: normalised.lit_fraction(),
        lit_edge_fraction: normalised.lit_edge_fraction(),
        envelope,
    }
}

/// The highest local mean but for the top hundredth: a small bright core does not make
/// everything else dark.
fn high(envelope: &Image) -> f32 {
    let mut values: Vec<f32> = envelope.data().iter().copied().step_by(7).collect();
    values.sort_by(f32::total_cmp);
    values[(values.len() * 99) / 100].max(f32::MIN_POSITIVE)
}

/// Intensity over local mean in the lit region.
struct NormalisedSpeckle {
    values: Image,
    illuminated: Image,
    mean: f64,
}

impl NormalisedSpeckle {
    fn new(light: &Image, envelope: &Image) -> Self {
        let least = MIN_RELATIVE_ENVELOPE as f32 * high(envelope);
        let illuminated = Image::from_fn(light.rows(), light.columns(), |y, x| {
            if envelope.at(y, x) > least { 1.0 } else { 0.0 }
        });
        let values = Image::from_fn(light.rows(), light.columns(), |y, x| {
            if illuminated.at(y, x) > 0.0 {
                light.at(y, x) / envelope.at(y, x)
            } else {
                0.0
            }
        });
        let count: f64 = illuminated.data().iter().map(|&l| f64::from(l)).sum();
        let sum: f64 = values.data().iter().map(|&v| f64::from(v)).sum();
        Self {
            mean: sum / count.max(1.0),
            values,
            illuminated,
        }
    }

    fn lit_fraction(&self) -> f64 {
        let count: f64 = self.illuminated.data().iter().map(|&l| f64::from(l)).sum();
        count / self.illuminated.data().len() as f64
    }

    fn lit_edge_fraction(&self) -> f64 {
        let (rows, columns) = (self.illuminated.rows(), self.illuminated.columns());
        let sides = [0, rows - 1]
            .map(|y| self.illuminated.row(y).to_vec())
            .concat();
        let ends = (0..rows).flat_map(|y| {
            [
                self.illuminated.at(y, 0),
                self.illuminated.at(y, columns - 1),
            ]
        });
        let illuminated: f64 = sides.into_iter().chain(ends).map(f64::from).sum();
        illuminated / (2 * (rows + columns)) as f64
    }

    fn against_exponential(&self) -> (Vec<f64>, f64) {
        let pairs = self.values.data().iter().zip(self.illuminated.data());
        let illuminated = pairs.filter(|(_, l)| **l > 0.0);
        let mut values: Vec<f64> = illuminated
            .map(|(v, _)| f64::from(*v) / self.mean)
            .collect();
        values.sort_by(f64::total_cmp);
        let count = values.len().max(1) as f64;
        let mut histogram = vec![0.0; BINS];
        let mut distance = 0.0f64;
        for (i, &value) in values.iter().enumerate() {
            if let Some(bin) = histogram.get_mut((value / HISTOGRAM_BIN_WIDTH) as usize) {
                *bin += 1.0 / (count * HISTOGRAM_BIN_WIDTH);
            }
            let expected = 1.0 - (-value.max(0.0)).exp();
            let (below, above) = (i as f64 / count, (i + 1) as f64 / count);
            distance = distance.max(expected - below).max(above - expected);
        }
        (histogram, distance)
    }
}

struct Autocovariance {
    along_y: Vec<f64>,
    along_x: Vec<f64>,
    width_y: f64,
    width_x: f64,
    variance: f64,
    noise_fraction: f64,
}

impl Autocovariance {
    /// Over pairs of lit pixels only: without padding's triangle, without wrap-around.
    fn of(normalised: &NormalisedSpeckle) -> Self {
        let (rows, columns) = (normalised.values.rows(), normalised.values.columns());
        let mut centred = normalised.values.clone();
        for (v, &illuminated) in centred
            .data_mut()
            .iter_mut()
            .zip(normalised.illuminated.data())
        {
            *v = illuminated * (f64::from(*v) - normalised.mean) as f32;
        }
        let lags = (rows.min(columns) / 3).max(1);
        let spectrum = |image: &Image| Spectrum::of(image, rows + lags, columns + lags);
        let (values, illuminated) = (spectrum(&centred), spectrum(&normalised.illuminated));
        let (values, pairs) = (
            values.correlate(&values),
            illuminated.correlate(&illuminated),
        );
        let at = |dy: usize, dx: usize| {
            let (dy, dx) = (dy as isize, dx as isize);
            values.at(dy, dx) / pairs.at(dy, dx).max(1.0)
        };
        let along_y: Vec<f64> = (0..lags).map(|d| at(d, 0)).collect();
        let along_x: Vec<f64> = (0..lags).map(|d| at(0, d)).collect();
        let variance = along_y[0].max(f64::MIN_POSITIVE);
        let noise_fraction = noise_fraction(&along_y).min(noise_fraction(&along_x));
        let peak = variance * (1.0 - noise_fraction);
        let relative = |line: Vec<f64>| -> Vec<f64> {
            let mut line: Vec<f64> = line.iter().map(|v| v / peak).collect();
            line[0] = 1.0;
            line
        };
        let (along_y, along_x) = (relative(along_y), relative(along_x));
        Self {
            width_y: width(&along_y),
            width_x: width(&along_x),
            along_y,
            along_x,
            variance,
            noise_fraction,
        }
    }
}

/// Noise of single pixels stands on the value at zero alone. Near zero the rest is a
/// parabola, `c(d) = c₀ − a d²`, so `c₀ = (4c(1) − c(2))/3`.
fn noise_fraction(line: &[f64]) -> f64 {
    let [zero, one, two] = [0, 1, 2].map(|i| line.get(i).copied().unwrap_or(0.0));
    // The parabola holds for grains of four pixels and more.
    if two < 0.5 * zero {
        return 0.0;
    }
    (1.0 - (4.0 * one - two) / (3.0 * zero)).clamp(0.0, 0.9)
}

/// Full width at half maximum of a curve from its maximum, 1, on: between two points
/// as a Gaussian has it, `ln c` linear in `d²`.
fn width(curve: &[f64]) -> f64 {
    let half = 0.5f64;
    let Some(below) = curve.iter().position(|&c| c < half) else {
        return 2.0 * curve.len() as f64;
    };
    let (d0, d1) = ((below - 1) as f64, below as f64);
    let (c0, c1) = (curve[below - 1].ln(), curve[below].max(1e-3).ln());
    let part = (c0 - half.ln()) / (c0 - c1);
    2.0 * (d0 * d0 + part * (d1 * d1 - d0 * d0)).sqrt()
}
