//! The operator of a video whose rows are seen alike.
//!
//! Behind a diffuser that scatters less than the sensor is high, the rows of a bin that lie far from the rows that are
//! read send little light to them. The column of `A` of such a voxel is short, and a reconstruction puts its light nearer
//! to the rows that are read, as source localisation by electrodes puts sources too near to the surface (depth weighting:
//! Lin et al., NeuroImage 31, 160, 2006). So the solver looks for `w = D⁻¹v` instead of `v` (docs/design/032).

use super::{Layer, RollingShutter};
use rayon::prelude::*;
use rowburst_core::linop::Scalar;
use rowburst_core::vecmath::norm_squared;

/// Power of the sensitivity in bins with weak rows; larger changes the prior more, smaller takes more iterations
/// (docs/design/032).
const POWER: f64 = 0.8;
/// Sensitivity of a bin's weakest row over its largest one from which the bin has no factors; larger changes frames whose
/// rows are all seen well (docs/design/032).
const UNSCALED_FROM: f64 = 0.3;
/// The same up to which it has the whole [`POWER`]; smaller leaves light at the wrong place (docs/design/032).
const FULL_POWER_TO: f64 = 0.2;
/// Sensitivity of a row over the largest one of its bin from which it is seen at all; smaller asks for light in rows that are not
/// seen (docs/design/032).
const SEEN: f64 = 0.05;

impl<T: Scalar> RollingShutter<T> {
    /// `A D`, with `D` a factor of at least 1 for each row of each bin; `None` where the rows of all bins are seen well
    /// enough, and for operators that convolve whole planes.
    ///
    /// The sensitivity `s` of a row is the root mean square length of the columns of `A` of its voxels, and its factor
    /// `(s_max/s)^p`, with `s_max` the largest one of its bin. `p` is 0 in bins whose rows are all seen well, and rises to 0.8 where
    /// the weakest row has a fifth of the largest sensitivity.
    #[must_use]
    pub fn equilibrated(&self) -> Option<Self> {
        if self.convolves_planes() {
            return None;
        }
        let mut factors = self.sensitivity_of_rows();
        let bins = factors.chunks_exact_mut(self.video.rows);
        bins.for_each(equilibrate);
        if factors.iter().all(|factor| *factor == 1.0) {
            return None;
        }
        Some(Self {
            row_scales: Some(factors.iter().map(|f| *f as f32).collect()),
            video: self.video,
            time: self.time.clone(),
            geometry: self.geometry.clone(),
            frame_row_count: self.frame_row_count,
            sensor_rows_of: self.sensor_rows_of.clone(),
            frame_rows_of: self.frame_rows_of.clone(),
            layers: self.layers.clone(),
            plane_power: self.plane_power.clone(),
        })
    }

    /// Whether it is the operator `A D`.
    pub fn is_equilibrated(&self) -> bool {
        self.row_scales.is_some()
    }

    /// `video = D video`; nothing for the operator `A`.
    ///
    /// # Panics
    /// If the length is not that of a video.
    pub fn scale_rows(&self, video: &mut [T]) {
        assert_eq!(video.len(), self.video.voxels(), "length of the video");
        let bins = video.par_chunks_mut(self.video.pixels()).enumerate();
        bins.for_each(|(bin, pixels)| self.scale_part(bin, 0, pixels));
    }

    /// The factor of row `y` of a bin; 1 for the operator `A`.
    pub fn row_scale(&self, bin: usize, y: usize) -> f32 {
        let factors = self.row_scales.as_ref();
        factors.map_or(1.0, |factors| factors[bin * self.video.rows + y])
    }

    /// The factors of the rows of a bin; `None` for the operator `A`.
    pub(super) fn row_scales_of(&self, bin: usize) -> Option<&[f32]> {
        let rows = bin * self.video.rows..(bin + 1) * self.video.rows;
        self.row_scales.as_ref().map(|factors| &factors[rows])
    }

    /// Multiplies some pixels of a bin, from pixel `start` on, by the factors of their rows.
    pub(super) fn scale_part(&self, bin: usize, start: usize, pixels: &mut [T]) {
        if !self.is_equilibrated() {
            return;
        }
        let columns = self.video.columns;
        let (mut rest, mut at) = (pixels, start);
        while !rest.is_empty() {
            let (row, others) = rest.split_at_mut(rest.len().min(columns - at % columns));
            let factor = T::from(self.row_scale(bin, at / columns));
            row.iter_mut().for_each(|v| *v *= factor);
            at += row.len();
            rest = others;
        }
    }

    /// The mean factor of row `y` in the bins of an instant.
    pub(super) fn mean_row_scale(&self, instant: usize, y: usize) -> f32 {
        let run = &self.time.instants()[instant];
        let bins = run.first_bin..run.first_bin + run.weights.len();
        let count = bins.len() as f32;
        bins.map(|bin| self.row_scale(bin, y)).sum::<f32>() / count
    }

    /// The sensitivity of each row of each bin, as if light never fell beside the sensor's columns.
    fn sensitivity_of_rows(&self) -> Vec<f64> {
        let energies: Vec<Vec<f64>> = self.layers.iter().map(energy_of_psf_rows).collect();
        let shares: Vec<Vec<f64>> = self.layers.iter().map(|l| self.mean_shares(l)).collect();
        let mut powers = vec![0.0; self.video.bins * self.video.rows];
        for (run, rows) in self.time.instants().iter().zip(&self.sensor_rows_of) {
            for y in 0..self.video.rows {
                let from = |energies: &Vec<f64>, r: usize| {
                    let row = self.geometry.row_displacement(r, y) + (energies.len() / 2) as isize;
                    let row = usize::try_from(row).ok();
                    row.and_then(|row| energies.get(row))
                        .copied()
                        .unwrap_or(0.0)
                };
                let of_layer = |(energies, shares): (&Vec<f64>, &Vec<f64>)| {
                    shares[y] * rows.iter().map(|&r| from(energies, r)).sum::<f64>()
                };
                let power: f64 = energies.iter().zip(&shares).map(of_layer).sum();
                for (k, weight) in run.weights.iter().enumerate() {
                    let bin = run.first_bin + k;
                    powers[bin * self.video.rows + y] += weight * weight * power;
                }
            }
        }
        powers.iter().map(|power| power.sqrt()).collect()
    }

    /// The mean of the squared share of a layer in each row of the field.
    fn mean_shares(&self, layer: &Layer<T>) -> Vec<f64> {
        let columns = self.video.columns;
        match &layer.share {
            None => vec![1.0; self.video.rows],
            Some(share) => {
                let rows = share.chunks_exact(columns);
                rows.map(|row| norm_squared(row) / columns as f64).collect()
            }
        }
    }
}

/// Replaces the sensitivities of a bin's rows by their factors.
fn equilibrate(rows: &mut [f64]) {
    let largest = rows.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    rows.iter_mut().for_each(|s| *s /= largest);
    let seen = rows.iter().copied().filter(|ratio| *ratio >= SEEN);
    let weakest = seen.fold(1.0, f64::min);
    let power =
        POWER * ((UNSCALED_FROM - weakest) / (UNSCALED_FROM - FULL_POWER_TO)).clamp(0.0, 1.0);
    rows.iter_mut()
        .for_each(|ratio| *ratio = ratio.max(SEEN).powf(-power));
}

/// `Σ_x p(y, x)²` of each row of a layer's PSF.
fn energy_of_psf_rows<T: Scalar>(layer: &Layer<T>) -> Vec<f64> {
    let image = layer.psf.image();
    let rows = image.data().chunks_exact(image.columns());
    rows.map(norm_squared).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraParams;
    use crate::forward::gram::tests::{brute_force, row_by_row};
    use crate::forward::gram::{active_columns, add_gram_block};
    use crate::{Camera, Image, PatchSet, Psf, Shutter};
    use faer::Mat;
    use rand::{RngExt, SeedableRng};
    use rowburst_core::Support;
    use rowburst_core::linop::{LinearOperator, laws};

    /// A random PSF whose light falls to a tenth within `reach` rows.
    fn narrow_psf(rows: usize, columns: usize, reach: f64, seed: u64) -> Psf {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let middle = rows / 2;
        let values = (0..rows * columns).map(|i| {
            let distance = (i / columns).abs_diff(middle) as f64 / reach;
            rng.random_range(0.5..1.0) * 0.1f64.powf(distance) as f32
        });
        Psf::new(Image::new(rows, columns, values.collect()).unwrap()).unwrap()
    }

    fn cameras() -> Vec<Camera> {
        let exposed = |shutter, exposure_us, bins_per_row| {
            let camera = row_by_row(12, 5, shutter);
            Camera::new(CameraParams {
                exposure_us,
                bins_per_row,
                ..camera.params().clone()
            })
            .unwrap()
        };
        vec![
            exposed(Shutter::TopDown, 1.0, 1),
            exposed(Shutter::DualInsideOut, 1.0, 1),
            exposed(Shutter::DualOutsideIn, 1.0, 2),
            exposed(Shutter::TopDown, 2.5, 1),
        ]
    }

    fn operators() -> Vec<RollingShutter> {
        let psf = |seed| narrow_psf(23, 9, 6.0, seed);
        let patches = PatchSet::new(vec![psf(2), psf(3)], vec![(-3.0, 0.0), (3.0, 0.0)]).unwrap();
        let operators = cameras().into_iter().flat_map(|camera| {
            let of_one = RollingShutter::new(&camera, psf(1));
            [of_one, RollingShutter::new(&camera, patches.clone())]
        });
        operators.collect()
    }

    fn random_video(operator: &RollingShutter) -> Vec<f32> {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(4);
        let voxels = 0..operator.domain_len();
        voxels.map(|_| rng.random_range(0.0..1.0)).collect()
    }

    #[test]
    fn it_is_the_operator_after_the_factors_of_the_rows() {
        for operator in operators() {
            let equilibrated = operator.equilibrated().expect("rows are seen weakly");
            laws::check(&equilibrated, 5);
            let video = random_video(&operator);
            let mut scaled = video.clone();
            equilibrated.scale_rows(&mut scaled);
            assert!(scaled.iter().zip(&video).any(|(s, v)| *s > 3.0 * v));
            let (mut light, mut expected) = (vec![0.0; 60], vec![0.0; 60]);
            equilibrated.apply(&video, &mut light);
            operator.apply(&scaled, &mut expected);
            for (light, expected) in light.iter().zip(&expected) {
                assert!(
                    (light - expected).abs() < 1e-5 * expected,
                    "{light} {expected}"
                );
            }
        }
    }

    #[test]
    fn its_blocks_agree_with_operator_calls() {
        for operator in operators() {
            let equilibrated = operator.equilibrated().expect("rows are seen weakly");
            let shape = equilibrated.video_shape();
            let video = random_video(&equilibrated);
            let mut thresholds = vec![0.97; shape.bins];
            thresholds[0] = 0.0;
            let some = Support::above(&video, shape, &thresholds);
            for support in [None, Some(&some)] {
                let expected = brute_force(&equilibrated, support);
                for instant in 0..equilibrated.rows_of_instants().len() {
                    let indices = equilibrated.indices_of(instant);
                    let mut gram = Mat::<f64>::zeros(indices.len(), indices.len());
                    add_gram_block(&equilibrated, instant, support, gram.as_mut());
                    let columns = support.and_then(|support| {
                        active_columns::<f64>(&equilibrated, instant, support, usize::MAX)
                    });
                    let products = columns.map(|columns| &columns * columns.transpose());
                    for (i, &row) in indices.iter().enumerate() {
                        if support.is_none() {
                            let columns = shape.columns;
                            let power = equilibrated.pixel_power(row / columns, row % columns);
                            assert!((power / gram[(i, i)] - 1.0).abs() < 1e-6);
                        }
                        for (j, &column) in indices.iter().enumerate().skip(i) {
                            let expected = f64::from(expected[row][column]);
                            let allowed = 1e-5 * gram[(i, i)].max(gram[(j, j)]);
                            let error = (gram[(i, j)] - expected).abs();
                            assert!(error <= allowed, "{instant} {i} {j}: {error} {allowed}");
                            if let Some(products) = &products {
                                assert!((products[(i, j)] - expected).abs() <= allowed);
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn rows_that_are_seen_well_stay_as_they_are() {
        for camera in cameras() {
            let psf = narrow_psf(23, 9, 30.0, 1);
            assert!(RollingShutter::new(&camera, &psf).equilibrated().is_none());
        }
    }

    #[test]
    fn a_row_that_is_not_seen_gets_no_larger_factor_than_the_dimmest_seen_one() {
        let camera = row_by_row(12, 5, Shutter::TopDown);
        // Light reaches four rows.
        let operator = RollingShutter::new(&camera, narrow_psf(9, 9, 3.0, 1));
        let equilibrated = operator.equilibrated().expect("rows are seen weakly");
        let largest = SEEN.powf(-POWER) as f32;
        assert_eq!(equilibrated.row_scale(0, 11), largest);
        assert!((0..12).all(|y| (1.0..=largest).contains(&equilibrated.row_scale(0, y))));
        assert_eq!(equilibrated.row_scale(0, 0), 1.0);
    }
}
