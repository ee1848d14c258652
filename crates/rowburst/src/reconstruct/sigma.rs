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

/// Standard deviation of the noise in `measurement` in counts (weight 1), from the
/// tenth of the horizontal frequencies that `psf` passes least.
///
/// An upper bound where the PSF passes all frequencies of the pixel grid (a grain
/// below two pixels).
pub fn estimate_sigma(measurement: &Measurement, psf: &Psf) -> f64 {
    let image = measurement.image();
    let weights = measurement.weights();
    let (length, windows) = windows(image, weights);
    let window: Vec<f64> = (0..length)
        .map(|x| {
            (std::f64::consts::PI * (x as f64 + 0.5) / length as f64)
                .sin()
                .powi(2)
        })
        .collect();
    let window_power: f64 = window.iter().map(|w| w * w).sum();
    let passed = transfer(psf, length);
    let mut order: Vec<usize> = (1..passed.len()).collect();
    order.sort_by(|&a, &b| passed[a].total_cmp(&passed[b]));
    order.truncate(((passed.len() as f64 * NOISE_BAND).ceil() as usize).max(1));
    // The last frequency of an even length is real: its power has another law.
    let real_end = if length.is_multiple_of(2) {
        length / 2
    } else {
        usize::MAX
    };

    let mut planner = RealFftPlanner::<f64>::new();
    let fft = planner.plan_fft_forward(length);
    let mut spectrum = fft.make_output_vec();
    let mut powers = Vec::new();
    for start in windows {
        let mut line: Vec<f64> = (0..length)
            .map(|x| {
                let weight = weights.map_or(1.0, |w| f64::from(w[start + x]));
                weight * window[x] * f64::from(image.data()[start + x])
            })
            .collect();
        fft.process(&mut line, &mut spectrum)
            .expect("lengths match");
        powers.extend(
            order
                .iter()
                .filter(|&&f| f != real_end)
                .map(|&f| spectrum[f].norm_sqr()),
        );
    }
    let rms = (crate::vecmath::norm_squared(image.data()) / image.data().len() as f64).sqrt();
    // A noiseless frame still has the rounding of its numbers.
    let floor = 1e-5 * rms;
    if powers.is_empty() {
        return floor.max(rms / 256.0);
    }
    let middle = powers.len() / 2;
    let median = *powers.select_nth_unstable_by(middle, f64::total_cmp).1;
    // The power of complex Gaussian noise is exponential: its median is ln 2 of its mean.
    (median / (std::f64::consts::LN_2 * window_power))
        .sqrt()
        .max(floor)
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
