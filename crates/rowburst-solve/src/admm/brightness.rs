//! The brightness of a video, the unit of the solver's thresholds.

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
    let (second, fourth) = parts
        .iter()
        .fold((0.0, 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
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
}
