//! Which period the rows show: power against cycles per row.

use super::fit::{add, linear, polynomials};
use rowburst_core::fft::FftNumber;
use rustfft::num_complex::Complex64;

/// Power of a row signal at frequencies from 0 to half a cycle per instant.
pub(super) struct Periodogram {
    /// Frequency of each value: its index times this.
    pub spacing: f64,
    pub power: Vec<f64>,
    instants: usize,
}

/// Frequencies per width of a peak: a start this fine lies within the peak.
const OVERSAMPLING: usize = 8;

/// Instants are read at `k[r]`; rows of one instant are added.
pub(super) fn periodogram(rows: &[f64], k: &[usize], degree: usize) -> Periodogram {
    let instants = k.iter().max().map_or(1, |last| last + 1);
    let trend = linear(&polynomials(rows.len(), degree), rows).residual;
    let mut folded = vec![0.0; instants];
    trend.iter().zip(k).for_each(|(v, &k)| folded[k] += v);
    // The lobes of a strong low frequency would hide weak ones.
    let mut tapered: Vec<Complex64> = folded
        .iter()
        .enumerate()
        .map(|(i, v)| {
            let angle = std::f64::consts::TAU * (i as f64 + 0.5) / instants as f64;
            Complex64::new(v * (0.5 - 0.5 * angle.cos()), 0.0)
        })
        .collect();
    let length = (OVERSAMPLING * instants).next_power_of_two();
    tapered.resize(length, Complex64::default());
    let (forward, _) = f64::complex_transforms(length);
    forward.process(&mut tapered);
    Periodogram {
        spacing: 1.0 / length as f64,
        power: tapered[..length / 2].iter().map(|v| v.norm_sqr()).collect(),
        instants,
    }
}

impl Periodogram {
    /// The strongest peak of at least one cycle in all: its frequency, and its power over that
    /// of its surroundings.
    pub fn peak(&self) -> (f64, f64) {
        let lowest = (1.0 / (self.instants as f64 * self.spacing)).ceil() as usize;
        let best = (lowest..self.power.len())
            .max_by(|&a, &b| self.power[a].total_cmp(&self.power[b]))
            .unwrap_or(lowest);
        (
            best as f64 * self.spacing,
            self.power[best] / self.background(best),
        )
    }

    /// Mean power of noise around index `at`: from the median from half to twice the frequency, and at
    /// least 16 cycles to either side, without the peak itself. A scene's own structure
    /// falls off slowly with frequency and so is part of it.
    fn background(&self, at: usize) -> f64 {
        let cycle = 1.0 / (self.instants as f64 * self.spacing);
        let reach = (16.0 * cycle).max(0.5 * at as f64);
        let low = (at as f64 - reach).max(cycle) as usize;
        let high = ((at as f64 + reach.max(at as f64)) as usize).min(self.power.len());
        let half_width = 3.0 * cycle;
        let mut around: Vec<f64> = (low..high)
            .filter(|&i| (i as f64 - at as f64).abs() > half_width)
            .map(|i| self.power[i])
            .collect();
        if around.is_empty() {
            return f64::MIN_POSITIVE;
        }
        let middle = around.len() / 2;
        let (_, median, _) = around.select_nth_unstable_by(middle, f64::total_cmp);
        // The median of an exponential distribution is its mean times ln 2.
        (*median / std::f64::consts::LN_2).max(f64::MIN_POSITIVE)
    }

    /// Adds another of the same kind.
    pub fn include(&mut self, other: &Self) {
        add(&mut self.power, 1.0, &other.power);
    }
}
