//! How much a dense scene changes, by the frame alone.
//!
//! A reconstruction shrinks the change of a dense scene towards nothing, so its change cannot be counted. The frame is
//! fitted by a scene at rest instead. What is left has the variance `σ² + s² g`, where `s²` is the variance of a white
//! change in a voxel and `g` the mean diagonal of `A Aᵀ` (the method of moments). At the fitted pixels the fit takes a part
//! of that away, so the held-out ones give the variance: what the fit adds to it there is about what the still picture
//! takes of the change. The fit is repeated at the noise that it has found.

use super::frame_fit::FrameFit;
use super::without_guide::WithoutGuide;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rowburst_core::Cancel;
use rowburst_core::linop::LinearOperator;
use rowburst_core::vecmath::norm_squared;
use rowburst_optics::camera::CameraParams;
use rowburst_optics::forward::count::{ChangeCount, count_change};
use rowburst_optics::{Camera, Measurement, PatchSet, RollingShutter, Shutter};

/// Fits of a scene at rest; more change the noise that they assume by little.
const FITS: usize = 3;
/// Iterations of a fit; fewer leave a part of the still picture in the residual.
const ITERATIONS: usize = 80;

/// The change of a scene by its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameChange {
    /// Standard deviation `s` of a white change in every voxel, in counts.
    pub change_rms: f64,
    /// How many numbers of an instant speak about it.
    pub count: ChangeCount,
}

/// Estimates the change of the scene of `measurement`, whose pixels of weight 1 have the noise `sigma` in counts.
/// `operator` is that of `camera` and `psfs`. `None` for an instant of more than 2048 measurements, for one bin, and where
/// it was cancelled.
///
/// Its cost is that of some 500 convolutions of a picture, and of a factor of an instant's measurements.
pub fn estimate_change(
    camera: &Camera,
    psfs: &PatchSet,
    operator: &RollingShutter,
    measurement: &Measurement,
    sigma: f64,
    cancel: &Cancel,
) -> Option<FrameChange> {
    // No count, no estimate.
    count_change(operator, sigma, 0.0)?;
    if camera.video_shape().bins == 1 {
        return None;
    }
    let params = CameraParams {
        shutter: Shutter::Global,
        exposure_us: camera.params().row_time_us,
        bins_per_row: 1,
        ..camera.params().clone()
    };
    let still = RollingShutter::new(&Camera::new(params).ok()?, psfs.clone());
    // The noise that a fit assumes, and what it leaves at held-out pixels.
    let (mut noise, mut left) = (sigma, sigma);
    for _ in 0..FITS {
        let frame = FrameFit::new(&still, measurement, noise, cancel);
        let fit = WithoutGuide::with_iterations(&frame, ITERATIONS);
        let (fitted, held_out) = frame.errors(&fit.video);
        cancel.check().ok()?;
        left = noise * held_out;
        noise *= (fitted * held_out).sqrt();
    }
    let power = (left * left - sigma * sigma).max(0.0);
    let change_rms = (power / mean_power(operator)).sqrt();
    Some(FrameChange {
        change_rms,
        count: count_change(operator, sigma, change_rms)?,
    })
}

/// Mean diagonal of `A Aᵀ`, by a random probe.
fn mean_power(operator: &RollingShutter) -> f64 {
    let mut rng = Pcg64::seed_from_u64(3);
    let probe: Vec<f32> = (0..operator.range_len())
        .map(|_| if rng.random::<bool>() { 1.0 } else { -1.0 })
        .collect();
    let mut video = vec![0.0; operator.domain_len()];
    operator.adjoint(&probe, &mut video);
    (norm_squared(&video) / probe.len() as f64).max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_optics::{Image, Sensor};
    use rowburst_simulate::noise::Noise;
    use rowburst_simulate::scene::{DenseScene, dense};
    use rowburst_simulate::{SpeckleOptics, speckle_psf};

    /// The change of a beam is beyond a frame; those of a bench, a wheel and of cells are not, and a scene at rest has none.
    #[test]
    fn the_five_dense_scenes_lie_on_their_sides_of_the_line() {
        const N: usize = 108;
        let camera = Camera::new(CameraParams {
            rows: N,
            columns: N,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let psf = speckle_psf(&SpeckleOptics::demo(), 2 * N - 1, 2 * N - 1, 4).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let mut found = Vec::new();
        for scene in DenseScene::ALL {
            for seed in [41, 52] {
                let truth = dense(scene, camera.video_shape(), seed).unwrap();
                let mut light = vec![0.0; N * N];
                operator.apply(truth.data(), &mut light);
                let noise = Noise::Gaussian { snr: 256.0 };
                let light = Image::new(N, N, light).unwrap();
                let recorded = noise.apply(&light, camera.sensor(), seed).unwrap();
                let measurement = Measurement::new(recorded.frame).unwrap();
                let sigma = recorded.sigma;
                let psfs = PatchSet::from(&psf);
                let cancel = Cancel::default();
                let change =
                    estimate_change(&camera, &psfs, &operator, &measurement, sigma, &cancel);
                let count = change.unwrap().count;
                found.push((scene, seed, count.informative, count.is_too_few()));
            }
        }
        for (scene, _, _, is_too_few) in &found {
            let expected = matches!(scene, DenseScene::Still | DenseScene::Beam);
            assert_eq!(*is_too_few, expected, "{} of {found:?}", scene.name());
        }
    }
}
