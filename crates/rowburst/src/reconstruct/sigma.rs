//! The noise level, from the frame itself.
//!
//! The optics pass no detail finer than a speckle grain: beyond their cut-off the
//! spectrum of a row holds only noise. Each row is one instant, so rows, not columns,
//! are transformed; a Hann window keeps the strong low frequencies from leaking.

use crate::measurement::Measurement;
use crate::{Image, Psf};
use realfft::RealFftPlanner;

/// Part of the frequencies that are taken for noise: those that the PSF passes least.
const NOISE_BAND: f64 = 0.1;

/// Part of the frequencies that the PSF passes best.
const PASSED_BAND: f64 = 0.25;

/// Standard deviation of the noise in `measurement` in counts (weight 1), from the
/// tenth of the horizontal frequencies that `psf` passes least.
///
/// An upper bound where the PSF passes all frequencies of the pixel grid (a grain
/// below two pixels). `None` where no part of a row is whole enough.
pub fn estimate_sigma(measurement: &Measurement, psf: &Psf) -> Option<f64> {
    Bands::new(measurement, psf).sigma(measurement)
}

impl Bands {
    /// See [`estimate_sigma`]; the bands are those of the measurement.
    pub fn sigma(&self, measurement: &Measurement) -> Option<f64> {
        let image = measurement.image();
        let blind = self.blind_rms(|at| {
            let weight = measurement.weights().map_or(1.0, |w| f64::from(w[at]));
            weight * f64::from(image.data()[at])
        });
        let rms = (crate::vecmath::norm_squared(image.data()) / image.data().len() as f64).sqrt();
        // A noiseless frame still has the rounding of its numbers.
        let floor = 1e-5 * rms;
        blind.map(|blind| blind.max(floor))
    }
}

/// The horizontal frequencies that the optics pass least and best, and where in a frame
/// they can be measured.
pub(super) struct Bands {
    length: usize,
    starts: Vec<usize>,
    window: Vec<f64>,
    blind: Vec<usize>,
    passed: Vec<usize>,
    leak: f64,
}

impl Bands {
    pub fn new(measurement: &Measurement, psf: &Psf) -> Self {
        let (length, starts) = windows(measurement.image(), measurement.weights());
        let window = (0..length)
            .map(|x| {
                (std::f64::consts::PI * (x as f64 + 0.5) / length as f64)
                    .sin()
                    .powi(2)
            })
            .collect();
        let power = transfer(psf, length);
        let mut order: Vec<usize> = (1..power.len()).collect();
        order.sort_by(|&a, &b| power[a].total_cmp(&power[b]));
        let part = |share: f64, least: usize| {
            let count = (power.len() as f64 * share).ceil() as usize;
            count.max(least).min(order.len())
        };
        // The last frequency of an even length is real: its power has another law.
        let real_end = if length.is_multiple_of(2) {
            length / 2
        } else {
            usize::MAX
        };
        let complex = |band: &[usize]| -> Vec<usize> {
            band.iter().copied().filter(|&f| f != real_end).collect()
        };
        let blind = complex(&order[..part(NOISE_BAND, 1)]);
        let passed = complex(&order[order.len() - part(PASSED_BAND, 2)..]);
        let mean =
            |band: &[usize]| band.iter().map(|&f| power[f]).sum::<f64>() / band.len().max(1) as f64;
        Self {
            leak: mean(&blind) / mean(&passed).max(f64::MIN_POSITIVE),
            length,
            starts,
            window,
            blind,
            passed,
        }
    }

    /// Number of values behind [`Self::blind_rms`].
    pub fn blind_count(&self) -> usize {
        self.starts.len() * self.blind.len()
    }

    /// Power that the optics pass in the blind band over that in the passed one.
    pub fn leak(&self) -> f64 {
        self.leak
    }

    /// Root mean square per pixel of white noise that has the median power of the blind
    /// band of `value(i)`, `i` the pixel of the frame; `None` where no row is whole
    /// enough. A median, which a few disturbed rows do not move.
    pub fn blind_rms(&self, value: impl Fn(usize) -> f64) -> Option<f64> {
        let mut powers = self.powers(&self.blind, value);
        if powers.is_empty() {
            return None;
        }
        let middle = powers.len() / 2;
        let median = *powers.select_nth_unstable_by(middle, f64::total_cmp).1;
        // The power of complex Gaussian noise is exponential: its median is ln 2 of its mean.
        Some((median / std::f64::consts::LN_2).sqrt())
    }

    /// Root mean square per pixel of white noise that has the mean power of the passed
    /// band.
    pub fn passed_rms(&self, value: impl Fn(usize) -> f64) -> Option<f64> {
        let powers = self.powers(&self.passed, value);
        let count = powers.len();
        (count > 0).then(|| (powers.iter().sum::<f64>() / count as f64).sqrt())
    }

    /// Power of each row's window at each frequency of `band`, 1 for unit white noise.
    fn powers(&self, band: &[usize], value: impl Fn(usize) -> f64) -> Vec<f64> {
        let fft = RealFftPlanner::<f64>::new().plan_fft_forward(self.length);
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

/// Shortest window of a row that still has frequencies to choose from.
const SHORTEST: usize = 16;

/// Where in the frame the windows begin that are transformed, and their length: whole
/// rows; where most rows lack a pixel, whose edges would be written into the spectrum,
/// parts of rows that lack none.
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
    let mut planner = RealFftPlanner::<f64>::new();
    let fft = planner.plan_fft_forward(width);
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
