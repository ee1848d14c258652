//! What is expected of lit voxels before the frame is asked: how bright, how smooth.
//!
//! ```text
//! K[i, j] = a² √(uᵢ uⱼ) B k(|i − j|/ℓ),   k(q) = (1 + s + s²/3) e^{−s},  s = √5 q
//! ```
//!
//! `k` is the Matérn covariance of order 5/2 (Rasmussen & Williams, Gaussian Processes for
//! Machine Learning, 2006, eq. 4.17): neither rough nor as smooth as a Gaussian. `B` is the
//! brightness of the video, and `u` what the video looks like out of focus: variances in
//! proportion to `u` let dim places stay dim. `a` and `ℓ` come from the frame.

use faer::Mat;

/// Blur of `u`: the rms of its Gaussian in pixels.
const BLUR_PX: f64 = 0.7;
/// Lowest `u` over `B`: a voxel that the video has dark may still be lit a little.
const VARIANCE_FLOOR: f64 = 0.01;
/// Variance added to the diagonal, over `a²`: rounding must not make `K` indefinite.
const JITTER: f64 = 1e-6;

/// `√(u/B) B` of every pixel of a bin, so that `K = a² s sᵀ ∘ k`.
pub(super) fn scales(bin: &[f32], columns: usize, brightness: f64) -> Vec<f64> {
    let power: Vec<f64> = bin.iter().map(|&v| f64::from(v.max(0.0)).powi(2)).collect();
    let mut along_rows = vec![0.0; bin.len()];
    let rows = power.chunks(columns).zip(along_rows.chunks_mut(columns));
    for (row, blurred) in rows.filter(|(row, _)| row.iter().any(|p| *p > 0.0)) {
        add_blurred(row, 1, blurred);
    }
    let mut blurred = vec![0.0; bin.len()];
    add_blurred(&along_rows, columns, &mut blurred);
    let scale = |p: &f64| brightness * (p.sqrt() / brightness + VARIANCE_FLOOR).sqrt();
    blurred.iter().map(scale).collect()
}

/// Adds `input`, blurred along one axis whose neighbours lie `step` elements apart, to `out`. Beyond its ends `input` is dark.
fn add_blurred(input: &[f64], step: usize, out: &mut [f64]) {
    let weights: [f64; 5] = std::array::from_fn(|k| {
        let distance = k as f64 - 2.0;
        (-0.5 * distance * distance / (BLUR_PX * BLUR_PX)).exp()
    });
    let total: f64 = weights.iter().sum();
    for (k, weight) in weights.iter().enumerate() {
        // Element `i` gets that of element `i + (k − 2) step`.
        let (skipped_in, skipped_out) =
            (k.saturating_sub(2) * step, 2usize.saturating_sub(k) * step);
        let weight = weight / total;
        let inputs = input.iter().skip(skipped_in);
        for (out, input) in out.iter_mut().skip(skipped_out).zip(inputs) {
            *out += weight * input;
        }
    }
}

/// `K/a²` of `voxels` (bin, row, column, scale); voxels of different bins have nothing to do
/// with each other.
pub(super) fn covariance(voxels: &[Voxel], length_px: f64) -> Mat<f64> {
    let root5 = 5f64.sqrt();
    // Distances are few: those on a grid.
    let correlation = |dy: f64, dx: f64| {
        let s = root5 * dy.hypot(dx) / length_px;
        (1.0 + s + s * s / 3.0) * (-s).exp()
    };
    let mut table = Vec::new();
    let side = {
        let range = |of: &dyn Fn(&Voxel) -> usize| {
            let most = voxels.iter().map(of).max().unwrap_or(0);
            most - voxels.iter().map(of).min().unwrap_or(0) + 1
        };
        (range(&|p| p.y), range(&|p| p.x))
    };
    for dy in 0..side.0 {
        table.extend((0..side.1).map(|dx| correlation(dy as f64, dx as f64)));
    }
    Mat::from_fn(voxels.len(), voxels.len(), |i, j| {
        let (p, q) = (&voxels[i], &voxels[j]);
        if p.bin != q.bin {
            return 0.0;
        }
        let k = table[p.y.abs_diff(q.y) * side.1 + p.x.abs_diff(q.x)];
        let jitter = if i == j { JITTER } else { 0.0 };
        p.scale * q.scale * (k + jitter)
    })
}

/// A voxel that may be lit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Voxel {
    pub bin: usize,
    pub y: usize,
    pub x: usize,
    pub scale: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_follow_the_video_and_are_never_zero() {
        let mut bin = vec![0.0f32; 9 * 11];
        bin[4 * 11 + 5] = 2.0;
        let scales = scales(&bin, 11, 2.0);
        let floor = 2.0 * VARIANCE_FLOOR.sqrt();
        assert!((scales[0] - floor).abs() < 1e-12);
        let largest = scales.iter().copied().fold(0.0, f64::max);
        assert_eq!(scales[4 * 11 + 5], largest);
        assert!((scales[4 * 11 + 6] - scales[3 * 11 + 5]).abs() < 1e-12);
        // The power is spread, not lost.
        let power: f64 = scales
            .iter()
            .map(|s| (((s / 2.0).powi(2) - VARIANCE_FLOOR) * 2.0).powi(2))
            .sum();
        assert!((power - 4.0).abs() < 1e-9, "{power}");
    }

    #[test]
    fn covariance_is_that_of_the_formula() {
        let voxel = |bin, y, x, scale| Voxel { bin, y, x, scale };
        let voxels = [
            voxel(0, 3, 4, 2.0),
            voxel(0, 3, 6, 1.0),
            voxel(1, 3, 4, 1.0),
            voxel(0, 5, 4, 0.5),
        ];
        let k = covariance(&voxels, 1.5);
        let s = 5f64.sqrt() * 2.0 / 1.5;
        let wanted = (1.0 + s + s * s / 3.0) * (-s).exp();
        assert!((k[(0, 1)] - 2.0 * wanted).abs() < 1e-12);
        assert!((k[(3, 0)] - wanted).abs() < 1e-12);
        assert_eq!(k[(0, 2)], 0.0);
        assert!((k[(0, 0)] - 4.0 * (1.0 + JITTER)).abs() < 1e-12);
    }
}
