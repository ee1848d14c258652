//! The strongest frequency of a trace.

use std::f64::consts::TAU;

use rowburst_core::fft::FftNumber;
use rustfft::num_complex::Complex64;

/// A sine that stands out of a trace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tone {
    /// Frequency in hertz.
    pub hertz: f64,
    /// Share of the trace's variance that a sine of this frequency explains, 0…1.
    pub share: f64,
}

/// A tone must explain this share of the variance (a square wave's fundamental has 0.81),
const MIN_EXPLAINED: f64 = 0.3;
/// and more than the strongest of `n/2` frequencies has in white noise, about `2 ln(n)/n`,
const MIN_EXPLAINED_TIMES_LENGTH: f64 = 20.0;
/// and show two periods within the trace: less is a passage, not a tone.
const MIN_PERIODS: f64 = 2.0;

/// The strongest frequency of a trace sampled at `rate_hz`, if it stands out clearly.
///
/// The peak of a zero-padded FFT is refined by least squares (offset, sine and
/// cosine), which has no bias from the few periods of a short trace. Values that are
/// not finite make the answer `None`.
pub fn strongest_tone(trace: &[f32], rate_hz: f64) -> Option<Tone> {
    let n = trace.len();
    if n < 8 || trace.iter().any(|v| !v.is_finite()) {
        return None;
    }
    let mean = trace.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64;
    let centred: Vec<f64> = trace.iter().map(|&v| f64::from(v) - mean).collect();
    let variance: f64 = centred.iter().map(|v| v * v).sum();
    if variance <= 1e-12 * mean * mean * n as f64 || variance <= 0.0 {
        return None;
    }
    let padded = 8 * n.next_power_of_two();
    let mut spectrum: Vec<Complex64> = centred.iter().map(|&v| Complex64::new(v, 0.0)).collect();
    spectrum.resize(padded, Complex64::ZERO);
    let (forward, _) = f64::complex_transforms(padded);
    forward.process(&mut spectrum);
    let half = &spectrum[..padded / 2];
    let peak =
        (1..half.len()).max_by(|&i, &j| half[i].norm_sqr().total_cmp(&half[j].norm_sqr()))?;
    let share = |cycles_per_sample: f64| explained(&centred, cycles_per_sample) / variance;
    let step = 1.0 / padded as f64;
    let centre = peak as f64 * step;
    let (mut low, mut high) = (
        (centre - 2.0 * step).max(0.1 * step),
        (centre + 2.0 * step).min(0.5),
    );
    for _ in 0..60 {
        let third = (high - low) / 3.0;
        if share(low + third) < share(high - third) {
            low += third;
        } else {
            high -= third;
        }
    }
    let best = 0.5 * (low + high);
    let tone = Tone {
        hertz: best * rate_hz,
        share: share(best).clamp(0.0, 1.0),
    };
    let needed = MIN_EXPLAINED.max(MIN_EXPLAINED_TIMES_LENGTH / n as f64);
    (tone.share >= needed && best * n as f64 >= MIN_PERIODS).then_some(tone)
}

/// Sum of squares that the least-squares fit `a + b cos + c sin` takes from a trace of zero mean.
fn explained(centred: &[f64], cycles_per_sample: f64) -> f64 {
    let n = centred.len() as f64;
    let (mut c, mut s, mut cc, mut ss, mut cs, mut yc, mut ys) =
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    for (i, y) in centred.iter().enumerate() {
        let (sin, cos) = (TAU * cycles_per_sample * i as f64).sin_cos();
        c += cos;
        s += sin;
        cc += cos * cos;
        ss += sin * sin;
        cs += cos * sin;
        yc += y * cos;
        ys += y * sin;
    }
    // The offset is eliminated: products about the means.
    let (cc, ss, cs) = (cc - c * c / n, ss - s * s / n, cs - c * s / n);
    let determinant = cc * ss - cs * cs;
    if determinant <= 1e-9 * n * n {
        return 0.0;
    }
    (yc * yc * ss - 2.0 * yc * ys * cs + ys * ys * cc) / determinant
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 1e6 / 9.6;

    fn trace(n: usize, value: impl Fn(f64) -> f64) -> Vec<f32> {
        (0..n).map(|i| value(i as f64 / RATE_HZ) as f32).collect()
    }

    #[test]
    fn sine_within_half_a_percent() {
        for hertz in [4_600.0, 7_777.0, 10_000.0, 23_456.0, 41_000.0] {
            for phase in [0.0, 0.9, 2.2] {
                let sine = trace(54, |t| 3.0 + (TAU * hertz * t + phase).sin());
                let tone = strongest_tone(&sine, RATE_HZ).expect("a clear tone");
                assert!(
                    (tone.hertz / hertz - 1.0).abs() < 0.005,
                    "{hertz}: {tone:?}"
                );
                assert!(tone.share > 0.99);
            }
        }
    }

    #[test]
    fn square_wave_within_half_a_percent() {
        let square = trace(256, |t| f64::from((t * 8_000.0).fract() < 0.5));
        let tone = strongest_tone(&square, RATE_HZ).expect("a clear tone");
        assert!((tone.hertz / 8_000.0 - 1.0).abs() < 0.005, "{tone:?}");
    }

    #[test]
    fn no_tone_in_noise_a_constant_a_passage_or_what_is_not_finite() {
        let mut state = 1_u64;
        let mut noise = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 40) as f32 / (1 << 24) as f32
        };
        for _ in 0..50 {
            let trace: Vec<f32> = (0..54).map(|_| noise()).collect();
            assert_eq!(strongest_tone(&trace, RATE_HZ), None);
        }
        assert_eq!(strongest_tone(&[2.5; 54], RATE_HZ), None);
        let passage: Vec<f32> = (0..54)
            .map(|i| (-((i as f32 - 20.0) / 6.0).powi(2)).exp())
            .collect();
        assert_eq!(strongest_tone(&passage, RATE_HZ), None);
        assert_eq!(strongest_tone(&[f32::NAN; 54], RATE_HZ), None);
        assert_eq!(strongest_tone(&[1.0, 2.0], RATE_HZ), None);
    }
}
