//! Where the light's frequency is looked for, and how far each readout order is refined.

use super::periodic::{self, PeriodicFit};
use super::{CLEAR_PEAK, count_of, pattern, periodogram};

pub(super) fn best_of(fits: &[PeriodicFit]) -> usize {
    (0..fits.len())
        .min_by(|&a, &b| fits[a].optimum.rss.total_cmp(&fits[b].optimum.rss))
        .unwrap_or(0)
}

/// The frequency to start from, in cycles per row time, and whether it stands out.
pub(super) fn start_of(frames: &[Vec<f64>], k: &[usize]) -> (f64, bool) {
    let mut best = total_power(frames, k, 2).peak();
    if frames.len() >= pattern::MIN_FRAMES {
        // What all frames share would hide weak stripes.
        let other = total_power(&pattern::divide_by_mean(frames), k, 2).peak();
        if other.1 > best.1 {
            best = other;
        }
    }
    (best.0, best.1 > CLEAR_PEAK)
}

pub(super) fn total_power(
    frames: &[Vec<f64>],
    k: &[usize],
    degree: usize,
) -> periodogram::Periodogram {
    let mut power = periodogram::periodogram(&frames[0], k, degree);
    for frame in &frames[1..] {
        power.include(&periodogram::periodogram(frame, k, degree));
    }
    power
}

/// Harmonics by which the orders are first compared.
const FIRST_HARMONICS: usize = 8;
/// An order that leaves this many times what the best one leaves is refined no further.
const REFINE_LIMIT: f64 = 4.0;

/// The fit at the strongest frequency, or at a half or a third of it where that
/// explains more: an exposure of about a period can leave a harmonic on top.
pub(super) fn fundamental(frames: &[Vec<f64>], k: &[usize], start: f64) -> PeriodicFit {
    let coarse = |start: f64, harmonics: usize| periodic::fit(frames, k, start, harmonics);
    let (mut from, mut lowest) = (start, coarse(start, 2).optimum.rss);
    for part in [2usize, 3] {
        let lower = start / part as f64;
        if lower * (count_of(k) as f64) < 1.0 {
            break;
        }
        let other = coarse(lower, 2 * part);
        let near = (other.cycles_per_row / lower - 1.0).abs() < 0.1;
        // More harmonics always leave a little less.
        if near && other.optimum.rss < 0.5 * lowest {
            (from, lowest) = (other.cycles_per_row, other.optimum.rss);
        }
    }
    coarse(from, FIRST_HARMONICS)
}

/// `fits` with all harmonics where there is hope.
pub(super) fn refined(
    frames: &[Vec<f64>],
    orders: &[Vec<usize>],
    same_as: [usize; 4],
    fits: &[PeriodicFit],
) -> Vec<PeriodicFit> {
    let lowest = fits[best_of(fits)].optimum.rss;
    let mut all: Vec<PeriodicFit> = Vec::new();
    for (o, fit) in fits.iter().enumerate() {
        all.push(if same_as[o] != o {
            all[same_as[o]].clone()
        } else if fit.optimum.rss > REFINE_LIMIT * lowest {
            fit.clone()
        } else {
            periodic::fit(
                frames,
                &orders[o],
                fit.cycles_per_row,
                periodic::MAX_HARMONICS,
            )
        });
    }
    all
}
