//! How close a video is to the truth.

use rayon::prelude::*;
use rowburst_core::vecmath::distance_squared;
use rowburst_optics::Video;

/// Peak signal-to-noise ratio in dB, `10 log₁₀(peak² / mean (v − truth)²)`, with the
/// maximum of `truth` as the peak; infinite for equal videos.
///
/// # Panics
/// If the lengths differ.
pub fn psnr_db(video: &[f32], truth: &[f32]) -> f64 {
    let peak = f64::from(truth.iter().copied().fold(0.0f32, f32::max));
    let mean = distance_squared(video, truth) / truth.len() as f64;
    10.0 * (peak * peak / mean).log10()
}

/// Structural similarity (Wang et al. 2004), the mean over bins and pixels of the
/// single-bin map with a Gaussian window of 1.5 px, with the maximum of `truth` as the
/// range; 1 for equal videos.
///
/// # Panics
/// If the shapes differ.
pub fn ssim(video: &Video, truth: &Video) -> f64 {
    assert_eq!(video.shape(), truth.shape(), "shapes of the videos");
    let shape = video.shape();
    let range = f64::from(truth.max()).max(f64::MIN_POSITIVE);
    let bins = (0..shape.bins).into_par_iter();
    let of_bins: Vec<f64> = bins
        .map(|t| ssim_of_bin(video.bin(t), truth.bin(t), shape.columns, range))
        .collect();
    // In the order of the bins, so that the last digit is the same each time.
    of_bins.iter().sum::<f64>() / shape.bins as f64
}

fn ssim_of_bin(a: &[f32], b: &[f32], columns: usize, range: f64) -> f64 {
    let (c1, c2) = ((0.01 * range).powi(2), (0.03 * range).powi(2));
    let blurred = |value: &dyn Fn(f64, f64) -> f64| {
        let product: Vec<f64> = a
            .iter()
            .zip(b)
            .map(|(&a, &b)| value(f64::from(a), f64::from(b)))
            .collect();
        blur(&product, columns)
    };
    let (mean_a, mean_b) = (blurred(&|a, _| a), blurred(&|_, b| b));
    let (aa, bb, ab) = (
        blurred(&|a, _| a * a),
        blurred(&|_, b| b * b),
        blurred(&|a, b| a * b),
    );
    let similarity = |i: usize| {
        let (ma, mb) = (mean_a[i], mean_b[i]);
        let (va, vb, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
        (2.0 * ma * mb + c1) * (2.0 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    };
    (0..a.len()).map(similarity).sum::<f64>() / a.len() as f64
}

/// Gaussian blur of 1.5 px over 11 px, mirrored at the edges.
fn blur(values: &[f64], columns: usize) -> Vec<f64> {
    let kernel: Vec<f64> = (-5i32..=5)
        .map(|d| (-f64::from(d * d) / 4.5).exp())
        .collect();
    let total: f64 = kernel.iter().sum();
    let mirrored = |i: isize, n: usize| -> usize {
        let period = 2 * n as isize;
        let i = i.rem_euclid(period);
        (if i < n as isize { i } else { period - 1 - i }) as usize
    };
    let rows = values.len() / columns;
    let pass = |input: &[f64], along_x: bool| -> Vec<f64> {
        (0..input.len())
            .map(|at| {
                let (y, x) = ((at / columns) as isize, (at % columns) as isize);
                let near = |d: isize| {
                    if along_x {
                        input[y as usize * columns + mirrored(x + d, columns)]
                    } else {
                        input[mirrored(y + d, rows) * columns + x as usize]
                    }
                };
                (-5..=5).zip(&kernel).map(|(d, k)| k * near(d)).sum::<f64>() / total
            })
            .collect()
    };
    pass(&pass(values, true), false)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::Shape;

    #[test]
    fn psnr_of_a_known_error() {
        let truth = vec![2.0f32, 0.0, 0.0, 0.0];
        let video = vec![2.0f32, 0.0, 0.02, 0.0];
        let expected = 10.0 * (4.0f64 / (0.0004 / 4.0)).log10();
        assert!((psnr_db(&video, &truth) - expected).abs() < 1e-3);
        assert_eq!(psnr_db(&truth, &truth), f64::INFINITY);
    }

    #[test]
    fn ssim_is_one_for_equals_and_falls_with_noise() {
        let shape = Shape::new(2, 20, 24);
        let value =
            |i: usize| 0.5 + 0.5 * ((i % 24) as f32 * 0.7).sin() * ((i / 24) as f32 * 0.3).cos();
        let truth = Video::new(shape, (0..shape.voxels()).map(value).collect()).unwrap();
        assert!((ssim(&truth, &truth) - 1.0).abs() < 1e-12);
        let noisy = |a: f32| {
            let data = truth.data().iter().enumerate();
            Video::new(
                shape,
                data.map(|(i, v)| v + a * ((i * 7919) as f32).sin())
                    .collect(),
            )
            .unwrap()
        };
        let (a, b) = (ssim(&noisy(0.05), &truth), ssim(&noisy(0.3), &truth));
        assert!(a < 0.9999 && b < a - 0.05, "{a} {b}");
    }
}
