//! Counting: how many numbers of an instant speak about the change of a scene.
//!
//! An instant measures `b = B v + n`, with `B` the rows of `A` that it reads and `n` white noise of variance `σ²`. Let the
//! change of the scene be white with variance `s²` in every voxel. In the basis of the eigenvectors of `B Bᵀ`, with
//! eigenvalues `g_i`, a measurement holds signal of variance `s² g_i` and noise of variance `σ²`. The linear estimate of
//! least error keeps the part `s² g_i/(s² g_i + σ²)` of it, so
//!
//! ```text
//! n = Σ_i g_i/(g_i + σ²/s²) = tr G (G + c I)⁻¹,     G = B Bᵀ,  c = σ²/s²
//! ```
//!
//! numbers speak about the change, the effective degrees of freedom of ridge regression (Hoerl & Kennard 1970). The others
//! are noise, whatever the prior: what the change has beyond `n` numbers an instant must come from outside the frame.

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};
use rowburst_optics::forward::gram::add_gram_block;
use rowburst_optics::{RollingShutter, Video};

/// Measurements of an instant above which nothing is counted: the count takes their number cubed.
const MAX_BLOCK: usize = 2048;
/// Part of an instant's numbers below which a change is not to be believed; see docs/design/028.
pub const MIN_INFORMATIVE: f64 = 0.1;

/// How many numbers of an instant speak about a change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChangeCount {
    /// The effective number of measurements.
    pub informative: f64,
    /// The measurements of the instant.
    pub of: usize,
}

impl ChangeCount {
    /// Whether the frame tells too little of the change for it to be believed.
    pub fn is_too_few(&self) -> bool {
        self.informative < MIN_INFORMATIVE * self.of as f64
    }
}

/// Counts for the instant in the middle, at a noise of `sigma` counts and a change of `change_rms` counts in every voxel.
/// `None` for an instant of more than 2048 measurements, and where the operator is not finite.
pub fn count_change(operator: &RollingShutter, sigma: f64, change_rms: f64) -> Option<ChangeCount> {
    let instant = operator.rows_of_instants().len() / 2;
    let size = operator.indices_of(instant).len();
    if size == 0 || size > MAX_BLOCK {
        return None;
    }
    let count = |informative| ChangeCount {
        informative,
        of: size,
    };
    if change_rms <= 0.0 {
        return Some(count(0.0));
    }
    let mut gram = Mat::<f64>::zeros(size, size);
    add_gram_block(operator, instant, None, gram.as_mut());
    let c = (sigma / change_rms).powi(2);
    // Only the upper triangle of the block is written.
    let shifted = Mat::from_fn(size, size, |i, j| {
        let (i, j) = (i.min(j), i.max(j));
        gram[(i, j)] + if i == j { c } else { 0.0 }
    });
    let inverse = shifted.llt(Side::Lower).ok()?.inverse();
    let trace: f64 = (0..size).map(|i| inverse[(i, i)]).sum();
    let informative = size as f64 - c * trace;
    informative.is_finite().then(|| count(informative.max(0.0)))
}

/// Root mean square of what a video has beside its mean over time.
pub fn change_rms(video: &Video) -> f64 {
    let shape = video.shape();
    let sum: f64 = (0..shape.pixels())
        .map(|i| {
            let values = (0..shape.bins).map(|t| f64::from(video.bin(t)[i]));
            let mean = values.clone().sum::<f64>() / shape.bins as f64;
            values.map(|v| (v - mean).powi(2)).sum::<f64>()
        })
        .sum();
    (sum / shape.voxels() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_core::linop::LinearOperator;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Camera, Sensor, Shutter};
    use rowburst_simulate::scene::{DenseScene, dense};
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    fn operator(n: usize) -> (Camera, RollingShutter) {
        let camera = Camera::new(CameraParams {
            rows: n,
            columns: n,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let psf = speckle_psf(&SpeckleOptics::demo(), 2 * n - 1, 2 * n - 1, 1).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        (camera, operator)
    }

    #[test]
    fn counts_between_none_and_all_and_grows_with_the_change() {
        let (_, operator) = operator(24);
        let of = |change| count_change(&operator, 1.0, change).unwrap().informative;
        assert_eq!(of(0.0), 0.0);
        let counts = [1e-3, 1.0, 10.0, 1e6].map(of);
        assert!(counts.windows(2).all(|w| w[0] < w[1]), "{counts:?}");
        assert!(counts[0] < 0.1 && counts[3] > 47.0 && counts[3] <= 48.0 + 1e-6);
    }

    #[test]
    fn a_beam_is_beyond_the_line_and_cells_are_not() {
        let (camera, operator) = operator(54);
        let of = |scene| {
            let video = dense(scene, camera.video_shape(), 3).unwrap();
            let mut frame = vec![0.0; operator.range_len()];
            operator.apply(video.data(), &mut frame);
            let rms = rowburst_core::vecmath::norm(&frame) / (frame.len() as f64).sqrt();
            count_change(&operator, rms / 256.0, change_rms(&video)).unwrap()
        };
        let (beam, cells) = (of(DenseScene::Beam), of(DenseScene::Cells));
        assert!(beam.is_too_few(), "{beam:?}");
        assert!(!cells.is_too_few(), "{cells:?}");
        assert!(of(DenseScene::Still).informative < 1e-3);
    }
}
