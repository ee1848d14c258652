//! The brightness of a video, the unit of the solver's thresholds.

use super::tuning::Tuning;
use rayon::prelude::*;
use rowburst_core::vecmath::simd;

/// Elements of one parallel task.
pub(super) const CHUNK: usize = 1 << 14;

/// Brightness of the active voxels, `√(Σ v⁴ / Σ v²)` over the positive part: a mean on which faint haze has little
/// influence. It is 0 where no voxel is positive.
pub fn brightness(video: &[f32]) -> f64 {
    let parts: Vec<(f64, f64)> = video
        .par_chunks(CHUNK)
        .map(|chunk| {
            simd(
                #[inline(always)]
                || powers(chunk),
            )
        })
        .collect();
    let sums = parts
        .iter()
        .fold((0.0, 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    brightness_of(sums)
}

/// The number of voxels of equal brightness that would share the light of `video` alike: its participation ratio `(Σ v)² / Σ v²`. It is
/// 0 for a dark video.
pub(super) fn participation(video: &[f32]) -> f64 {
    let parts: Vec<(f64, f64)> = video
        .par_chunks(CHUNK)
        .map(|chunk| {
            chunk.iter().fold((0.0, 0.0), |(light, second), &v| {
                let v = f64::from(v);
                (light + v, second + v * v)
            })
        })
        .collect();
    let (light, second) = parts
        .iter()
        .fold((0.0, 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    if second > 0.0 {
        light * light / second
    } else {
        0.0
    }
}

/// [`brightness`], but at most [`Tuning::max_brightness_ratio`] times that of the dim bins, which would be faint beside a flash. The
/// bins are taken from the dimmest on until they hold more than [`Tuning::dim_part`] of `Σ v²`, and the last of these counts.
/// `pixels` is the number of pixels of a bin.
pub(super) fn capped_brightness(video: &[f32], pixels: usize, tuning: &Tuning) -> f64 {
    let mut bins: Vec<(f64, f64)> = video
        .par_chunks(pixels)
        .map(|bin| {
            let sums = simd(
                #[inline(always)]
                || powers(bin),
            );
            (brightness_of(sums), sums.0)
        })
        .collect();
    bins.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let dim_light = tuning.dim_part * bins.iter().map(|(_, second)| second).sum::<f64>();
    let mut sum = 0.0;
    let last_dim = bins.iter().find(|(_, second)| {
        sum += second;
        sum > dim_light
    });
    let dim_brightness = last_dim.map_or(0.0, |(bright, _)| *bright);
    brightness(video).min(tuning.max_brightness_ratio * dim_brightness)
}

/// `√(Σ v⁴ / Σ v²)` of `Σ v²` and `Σ v⁴`; 0 where both are 0.
fn brightness_of((second, fourth): (f64, f64)) -> f64 {
    if second > 0.0 {
        (fourth / second).sqrt()
    } else {
        0.0
    }
}

/// `Σ v²` and `Σ v⁴` over the positive part.
#[inline(always)]
fn powers(values: &[f32]) -> (f64, f64) {
    const LANES: usize = 8;
    let (mut second, mut fourth) = ([0.0f64; LANES], [0.0f64; LANES]);
    let (parts, rest) = values.as_chunks::<LANES>();
    let mut last = [0.0; LANES];
    last[..rest.len()].copy_from_slice(rest);
    for part in parts.iter().chain([&last]) {
        for i in 0..LANES {
            let square = f64::from(part[i].max(0.0)).powi(2);
            second[i] += square;
            fourth[i] += square * square;
        }
    }
    (second.iter().sum(), fourth.iter().sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn haze_has_little_influence() {
        let mut video = vec![0.001f32; 10_000];
        video[..100].fill(2.0);
        assert!((brightness(&video) - 2.0).abs() < 1e-4);
        assert_eq!(brightness(&[-1.0, 0.0]), 0.0);
    }

    #[test]
    fn participation_counts_voxels_that_share_the_light() {
        let mut video = vec![0.0f32; 3 * CHUNK];
        assert_eq!(participation(&video), 0.0);
        video[..2 * CHUNK].fill(0.5);
        assert_eq!(participation(&video), 2.0 * CHUNK as f64);
        video[0] = 1e6;
        assert!((participation(&video) - 1.0).abs() < 0.05);
    }

    #[test]
    fn a_flash_does_not_hide_dimmer_bins() {
        let capped = |video: &[f32]| capped_brightness(video, 2, &Tuning::STANDARD);
        // Three bins of equal light, a dark one, and one of haze that holds nearly nothing.
        let mut video = [1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.01, 0.01];
        assert_eq!(capped(&video), brightness(&video));
        video[6] = 5.0;
        assert!(brightness(&video) > 4.0);
        assert_eq!(capped(&video), 2.0);
        // A flash that holds nearly all of the light leaves no dim bins.
        video[6] = 20.0;
        assert_eq!(capped(&video), brightness(&video));
        assert_eq!(capped(&[0.0; 10]), 0.0);
    }
}
