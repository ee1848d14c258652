//! Estimate of the noise level from the frame itself.
//!
//! The optics pass no detail finer than a speckle grain, so the spectrum of a row beyond their cut-off
//! holds only noise. Rows are transformed rather than columns, since each row is one instant. A Hann
//! window keeps the strong low frequencies from leaking into the noise band.

use rowburst_core::fft::FftNumber;
use rowburst_optics::measurement::Measurement;
use rowburst_optics::{Image, Psf};

/// Fraction of the frequencies that are taken for noise, those that the PSF passes least; larger averages
/// more values and admits more signal.
const NOISE_BAND: f64 = 0.1;

/// Fraction of the frequencies that make up the passed band, those that the PSF passes best.
const PASSED_BAND: f64 = 0.25;

/// Estimates the standard deviation of the noise of a pixel with weight 1, in counts, from the tenth of
/// the horizontal frequencies that `psf` passes least.
///
/// The result is an upper bound where the PSF passes all frequencies of the pixel grid (a speckle grain
/// below two pixels). `None` where bad pixels leave no part of a row that is long enough.
pub fn estimate_sigma(measurement: &Measurement, psf: &Psf) -> Option<f64> {
    Bands::new(measurement, psf).sigma(measurement)
}

impl Bands {
    /// See [`estimate_sigma`]. The bands have to be those of `measurement`.
    pub fn sigma(&self, measurement: &Measurement) -> Option<f64> {
        let image = measurement.image();
        let noise_rms = self.noise_rms(|at| {
            let weight = measurement.weights().map_or(1.0, |w| f64::from(w[at]));
            weight * f64::from(image.data()[at])
        });
        let rms =
            (rowburst_core::vecmath::norm_squared(image.data()) / image.data().len() as f64).sqrt();
        // A noiseless frame still has rounding noise.
        let min_sigma = 1e-5 * rms;
        noise_rms.map(|noise_rms| noise_rms.max(min_sigma))
    }
}

/// The horizontal frequencies that the optics pass least (noise band) and best (passed band), and the
/// windows of the frame in which they are measured.
pub(super) struct Bands {
    /// Length of a window in pixels.
    length: usize,
    /// Index in the frame of the first pixel of each window.
    starts: Vec<usize>,
    /// The Hann window.
    window: Vec<f64>,
    /// The frequencies that the optics pass least.
    noise_band: Vec<usize>,
    /// The frequencies that the optics pass best.
    passed_band: Vec<usize>,
    /// The highest frequencies, which no optics of a grain above two pixels pass, whatever the PSF.
    fine_band: Vec<usize>,
    /// See [`Self::leak`].
    leak: f64,
}

impl Bands {
    pub fn new(measurement: &Measurement, psf: &Psf) -> Self {
        Self::of_power(measurement.image(), measurement.weights(), |length| {
            transfer(psf, length)
        })
    }

    /// Those of optics that pass all frequencies alike, for [`Self::fine_rms`] alone.
    pub fn without_optics(image: &Image, weights: Option<&[f32]>) -> Self {
        Self::of_power(image, weights, |length| vec![1.0; length / 2 + 1])
    }

    /// `power` gives what the optics pass at each frequency of a window of so many pixels.
    fn of_power(image: &Image, weights: Option<&[f32]>, power: impl Fn(usize) -> Vec<f64>) -> Self {
        let (length, starts) = windows(image, weights);
        let window = (0..length)
            .map(|x| {
                (std::f64::consts::PI * (x as f64 + 0.5) / length as f64)
                    .sin()
                    .powi(2)
            })
            .collect();
        let power = power(length);
        let mut order: Vec<usize> = (1..power.len()).collect();
        order.sort_by(|&a, &b| power[a].total_cmp(&power[b]));
        let band_size = |fraction: f64, min_count: usize| {
            let count = (power.len() as f64 * fraction).ceil() as usize;
            count.max(min_count).min(order.len())
        };
        // The last frequency of an even length is real, so its power has another distribution.
        let real_end = if length.is_multiple_of(2) {
            length / 2
        } else {
            usize::MAX
        };
        let complex = |band: &[usize]| -> Vec<usize> {
            band.iter().copied().filter(|&f| f != real_end).collect()
        };
        let noise_band = complex(&order[..band_size(NOISE_BAND, 1)]);
        let passed_band = complex(&order[order.len() - band_size(PASSED_BAND, 2)..]);
        let highest = (1..power.len()).rev().take(band_size(NOISE_BAND, 2));
        let fine_band = complex(&highest.collect::<Vec<_>>());
        let mean =
            |band: &[usize]| band.iter().map(|&f| power[f]).sum::<f64>() / band.len().max(1) as f64;
        Self {
            leak: mean(&noise_band) / mean(&passed_band).max(f64::MIN_POSITIVE),
            length,
            starts,
            window,
            noise_band,
            passed_band,
            fine_band,
        }
    }

    /// Number of values of which [`Self::noise_rms`] takes the median.
    pub fn noise_count(&self) -> usize {
        self.starts.len() * self.noise_band.len()
    }

    /// Mean power that the optics pass in the noise band over that in the passed band.
    pub fn leak(&self) -> f64 {
        self.leak
    }

    /// Root mean square per pixel of white noise with the same median power in the noise band as the
    /// picture `value(i)`, where `i` is the index of a pixel. `None` without windows. A few disturbed rows
    /// do not change the median.
    pub fn noise_rms(&self, value: impl Fn(usize) -> f64) -> Option<f64> {
        self.median_rms(&self.noise_band, value)
    }

    /// Like [`Self::noise_rms`], at the highest frequencies of the rows: it does not depend on the PSF.
    pub fn fine_rms(&self, value: impl Fn(usize) -> f64) -> Option<f64> {
        self.median_rms(&self.fine_band, value)
    }

    fn median_rms(&self, band: &[usize], value: impl Fn(usize) -> f64) -> Option<f64> {
        let mut powers = self.powers(band, value);
        if powers.is_empty() {
            return None;
        }
        let middle = powers.len() / 2;
        let median = *powers.select_nth_unstable_by(middle, f64::total_cmp).1;
        // The power of complex Gaussian noise is exponentially distributed: its median is ln 2 times its mean.
        Some((median / std::f64::consts::LN_2).sqrt())
    }

    /// Root mean square per pixel of white noise with the same mean power in the passed band as the
    /// picture `value(i)`. `None` without windows.
    pub fn passed_rms(&self, value: impl Fn(usize) -> f64) -> Option<f64> {
        let powers = self.powers(&self.passed_band, value);
        let count = powers.len();
        (count > 0).then(|| (powers.iter().sum::<f64>() / count as f64).sqrt())
    }

    /// Power of each window at each frequency of `band`, with mean 1 for white noise of variance 1.
    fn powers(&self, band: &[usize], value: impl Fn(usize) -> f64) -> Vec<f64> {
        let (fft, _) = f64::real_transforms(self.length);
        let mut spectrum = fft.make_output_vec();
        let window_power: f64 = self.window.iter().map(|w| w * w).sum();
        let mut powers = Vec::with_capacity(self.starts.len() * band.len());
        for &start in &self.starts {
            let line = self.window.iter().enumerate();
            let mut line: Vec<f64> = line.map(|(x, w)| w * value(start + x)).collect();
            fft.process(&mut line, &mut spectrum)
                .expect("lengths match");
            powers.extend(band.iter().map(|&f| spectrum[f].norm_sqr() / window_power));
        }
        powers
    }
}

/// Shortest window in pixels; smaller uses more of a frame with bad pixels, and has fewer frequencies.
const SHORTEST: usize = 16;

/// The length of the windows that are transformed, and the index of the first pixel of each. Windows
/// hold no pixel with weight 0, whose edges would show in the spectrum. They are whole rows, or parts of
/// rows where too few rows are complete.
fn windows(image: &Image, weights: Option<&[f32]>) -> (usize, Vec<usize>) {
    let columns = image.columns();
    let mut length = columns;
    loop {
        let mut starts = Vec::new();
        for y in 0..image.rows() {
            let mut run = 0;
            for at in y * columns..(y + 1) * columns {
                let usable = weights.is_none_or(|w| w[at] > 0.0);
                run = if usable { run + 1 } else { 0 };
                if run == length {
                    starts.push(at + 1 - length);
                    run = 0;
                }
            }
        }
        let enough = starts.len() * length * 8 >= image.data().len();
        if enough || length / 2 < SHORTEST {
            return (length, starts);
        }
        length /= 2;
    }
}

/// Power that the PSF passes at each frequency of a row of `columns` pixels.
fn transfer(psf: &Psf, columns: usize) -> Vec<f64> {
    let image = psf.image();
    let width = image.columns();
    let (fft, _) = f64::real_transforms(width);
    let mut power = vec![0.0; width / 2 + 1];
    let mut spectrum = fft.make_output_vec();
    let window = |x: usize| {
        (std::f64::consts::PI * (x as f64 + 0.5) / width as f64)
            .sin()
            .powi(2)
    };
    for y in 0..image.rows() {
        let mut line: Vec<f64> = (0..width)
            .map(|x| window(x) * f64::from(image.at(y, x)))
            .collect();
        fft.process(&mut line, &mut spectrum)
            .expect("lengths match");
        power
            .iter_mut()
            .zip(&spectrum)
            .for_each(|(p, s)| *p += s.norm_sqr());
    }
    (0..columns / 2 + 1)
        .map(|f| {
            let at = (f as f64 / columns as f64 * width as f64).round() as usize;
            power[at.min(power.len() - 1)]
        })
        .collect()
}
