//! The lit voxels of bins that several instants see, as with an exposure longer than a row.
//!
//! The bins are estimated together. With the noise `σ`, the covariance `a² L Lᵀ` of the voxels, whose blocks are the bins,
//! and `ρ = σ²/a²`
//!
//! ```text
//! H = Lᵀ Aᵀ W² A L + ρI,   E v = L H⁻¹ Lᵀ Aᵀ W² b,   cov v = σ² L H⁻¹ Lᵀ
//! ```
//!
//! `H` is banded in time: bins further apart than an exposure have no instant in common.

use super::{
    Evidence, MAX_SAMPLES, MAX_VOXELS, Mean, Place, Refit, RefitInput, THRESHOLD, VoxelValues,
    mean_square_nearby, mean_weights,
};
use crate::active_gram::ActiveColumns;
use crate::traces::kernel::{Voxel, covariance};
use crate::traces::region::Region;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Mat, Par, Side};
use rayon::prelude::*;
use rowburst_solve::block_band::{BandFactor, BlockBand};
use std::borrow::Cow;
use std::ops::Range;

/// Most multiplications of a factor of `H`; larger takes minutes.
const MAX_COST: f64 = 3e10;
/// A bright voxel, over the brightness of the video; smaller takes more voxels along (docs/design/016).
const BRIGHT: f64 = 0.1;
/// Factor on what is expected of the light at the ends of the frame, where the prior decides more; smaller makes too short
/// intervals there (docs/design/016).
const OUTER_SCALE: f64 = 2.0;
/// Columns of a parallel task; fixed, so that the bits do not depend on the number of threads.
const PART: usize = 16;
/// Step of `ln ρ` in the derivative of `ln det H`; larger is less exact, smaller is lost in rounding.
const LOG_STEP: f64 = 0.05;

/// The voxels of consecutive bins and what the frame says of them.
pub(super) struct CoupledSystem {
    /// By bin.
    voxels: Vec<Vec<Voxel>>,
    first_bin: usize,
    /// `Aᵀ W² A` and `Aᵀ W² b`.
    gram: BlockBand<f64>,
    projected: Vec<f64>,
    /// `‖W b‖²`, and the number of pixels of weight above zero.
    power: f64,
    informative: usize,
    sigma: f64,
}

impl CoupledSystem {
    /// The system of `active`, which are `voxels`.
    fn new(input: RefitInput, active: &ActiveColumns, voxels: Vec<Vec<Voxel>>) -> Self {
        let weight = |i: usize| input.weights.map_or(1.0, |w| f64::from(w[i]));
        let weighted: Vec<f64> = (0..input.measured.len())
            .map(|i| weight(i) * f64::from(input.measured[i]))
            .collect();
        let read = active.instants.clone();
        let read = read.flat_map(|i| input.operator.indices_of(i));
        let read: Vec<usize> = read.filter(|&i| weight(i) > 0.0).collect();
        Self {
            gram: active.gram(),
            projected: active.adjoint(&weighted),
            power: read.iter().map(|&i| weighted[i].powi(2)).sum(),
            informative: read.len(),
            sigma: input.sigma,
            first_bin: active.first_bin,
            voxels,
        }
    }

    /// The system in units of `L`; `None` where the covariance is not positive definite.
    pub fn whiten(&self, length_px: f64) -> Option<WhitenedBand> {
        let root = |voxels: &Vec<Voxel>| {
            let factor = covariance(voxels, length_px).llt(Side::Lower).ok()?;
            Some(factor.L().to_owned())
        };
        let roots: Vec<Mat<f64>> = self.voxels.par_iter().map(root).collect::<Option<_>>()?;
        let gram = self.gram.congruent(&roots);
        let projected = by_bin(&gram, &roots, &self.projected, |root, of| {
            root.transpose() * of
        });
        Some(WhitenedBand {
            roots,
            gram,
            projected,
            sigma: self.sigma,
        })
    }

    /// Misfit of the estimate over `σ²`, and degrees of freedom that the frame has left.
    pub fn misfit(&self, length_px: f64, amplitude: f64) -> Option<(f64, f64)> {
        let whitened = self.whiten(length_px)?;
        let posterior = whitened.posterior(amplitude);
        let explained = dot(&posterior.whitened_mean, &whitened.projected);
        let rest = self.power
            - explained
            - posterior.rho * dot(&posterior.whitened_mean, &posterior.whitened_mean);
        // tr(I − ρH⁻¹), by the derivative of ln det H with ln ρ.
        let log_determinant = |step: f64| {
            let factor = whitened.gram.factor(posterior.rho * step.exp());
            factor.log_determinant()
        };
        let slope = (log_determinant(LOG_STEP) - log_determinant(-LOG_STEP)) / (2.0 * LOG_STEP);
        let used = posterior.whitened_mean.len() as f64 - slope;
        Some((
            rest / (self.sigma * self.sigma),
            self.informative as f64 - used,
        ))
    }
}

/// The same in units of `L`; the amplitude is still open.
pub(super) struct WhitenedBand {
    roots: Vec<Mat<f64>>,
    /// `Lᵀ Aᵀ W² A L`.
    gram: BlockBand<f64>,
    /// `Lᵀ Aᵀ W² b`.
    projected: Vec<f64>,
    sigma: f64,
}

impl WhitenedBand {
    fn posterior(&self, amplitude: f64) -> BandPosterior<'_> {
        let rho = (self.sigma / amplitude).powi(2);
        let factor = self.gram.factor(rho);
        let mut whitened_mean = self.projected.clone();
        factor.solve(&mut whitened_mean);
        BandPosterior {
            system: self,
            rho,
            factor,
            whitened_mean,
        }
    }
}

impl Evidence for WhitenedBand {
    fn negative_log_evidence(&self, amplitude: f64) -> Option<f64> {
        let posterior = self.posterior(amplitude);
        let size = self.projected.len() as f64;
        let determinant = 2.0 * size * amplitude.ln() + posterior.factor.log_determinant();
        let gain = dot(&posterior.whitened_mean, &self.projected) / (self.sigma * self.sigma);
        Some(0.5 * (determinant - gain))
    }
}

/// Mean and covariance of the voxels.
struct BandPosterior<'a> {
    system: &'a WhitenedBand,
    rho: f64,
    /// Of `H`.
    factor: BandFactor<f64>,
    /// `L⁻¹ E v`.
    whitened_mean: Vec<f64>,
}

impl BandPosterior<'_> {
    /// `E v`.
    fn mean(&self) -> Vec<f64> {
        let WhitenedBand { roots, gram, .. } = self.system;
        by_bin(gram, roots, &self.whitened_mean, |root, of| root * of)
    }

    /// `E v − v` of the estimate from the noiseless frame of the video `v`.
    fn pull(&self, video: &[f64]) -> Vec<f64> {
        let WhitenedBand { roots, gram, .. } = self.system;
        let mut values = by_bin(gram, roots, video, |root, mut of| {
            solve_lower_triangular_in_place(root.as_ref(), of.as_mut(), Par::Seq);
            of
        });
        self.factor.solve(&mut values);
        by_bin(gram, roots, &values, |root, of| {
            root * of * faer::Scale(-self.rho)
        })
    }

    /// For each `c`, weights of the voxels of a bin: the variance of `cᵀ v`, and the part of it that is noise of the estimate.
    fn variances(&self, weights: &[(usize, Vec<f64>)]) -> Vec<(f64, f64)> {
        let starts = self.system.gram.starts();
        let mut columns = Mat::<f64>::zeros(self.whitened_mean.len(), weights.len());
        let sides: Vec<Mat<f64>> = weights
            .par_iter()
            .map(|(bin, c)| {
                let c = Mat::from_fn(c.len(), 1, |i, _| c[i]);
                self.system.roots[*bin].transpose() * c
            })
            .collect();
        for (k, ((bin, _), side)) in weights.iter().zip(&sides).enumerate() {
            let mut to = columns.as_mut().subcols_mut(k, 1);
            let mut to = to.as_mut().subrows_mut(starts[*bin], side.nrows());
            to.copy_from(side);
        }
        let parts = columns.par_col_chunks_mut(PART);
        parts.for_each(|part| self.factor.solve_columns(part));
        let sigma_squared = self.system.sigma * self.system.sigma;
        let variance = |k: usize| {
            let (side, bin) = (&sides[k], &weights[k].0);
            let column = columns.col(k);
            let whole: f64 = (0..side.nrows())
                .map(|i| side[(i, 0)] * column[starts[*bin] + i])
                .sum();
            let noise = whole - self.rho * column.squared_norm_l2();
            (sigma_squared * whole, sigma_squared * noise.max(0.0))
        };
        (0..weights.len()).map(variance).collect()
    }
}

impl Refit<'_> {
    /// Whether instants share bins.
    pub(super) fn is_coupled(&self) -> bool {
        !self.input.operator.time().is_disjoint()
    }

    /// The bins that `instants` see.
    fn bins_of(&self, instants: &Range<usize>) -> Range<usize> {
        let runs = &self.input.operator.time().instants()[instants.clone()];
        let first = runs.iter().map(|run| run.first_bin).min();
        let end = runs.iter().map(|run| run.first_bin + run.weights.len());
        first.unwrap_or(0)..end.max().unwrap_or(0)
    }

    /// The instants that see one of `bins`.
    fn instants_of(&self, bins: &Range<usize>) -> Range<usize> {
        let runs = self.input.operator.time().instants().iter();
        let sees = runs
            .map(|run| run.first_bin < bins.end && run.first_bin + run.weights.len() > bins.start);
        let sees: Vec<usize> = sees.enumerate().filter(|s| s.1).map(|s| s.0).collect();
        match (sees.first(), sees.last()) {
            (Some(first), Some(last)) => *first..last + 1,
            _ => 0..0,
        }
    }

    /// How bright the light of bin `t` is expected to be, `[y, x]`: as in the video, and where instants share the bin, no less
    /// than the rms of the bins that they see. A short exposure tells when the light was there, a long one does not.
    pub(super) fn expected_bin(&self, t: usize) -> Cow<'_, [f32]> {
        let own = self.input.video.bin(t);
        if !self.is_coupled() {
            return Cow::Borrowed(own);
        }
        let near = self.bins_of(&self.instants_of(&(t..t + 1)));
        let count = near.len() as f32;
        let mut squares = vec![0.0; own.len()];
        for bin in near {
            let values = squares.iter_mut().zip(self.input.video.bin(bin));
            values.for_each(|(sum, v)| *sum += v * v / count);
        }
        let pairs = squares.iter().zip(own);
        pairs.map(|(mean, v)| mean.sqrt().max(*v)).collect()
    }

    /// Consecutive bins about bin `t`, as many as share an instant with a bin in the middle of the frame.
    fn near_bins(&self, t: usize) -> Range<usize> {
        let runs = self.input.operator.time().instants().iter();
        let reach = runs.map(|run| run.weights.len()).max().unwrap_or(1) - 1;
        let bins = self.shape().bins;
        let first = t
            .saturating_sub(reach)
            .min(bins.saturating_sub(2 * reach + 1));
        first..(first + 2 * reach + 1).min(bins)
    }

    /// Whether fewer instants see a bin than others, for each bin: it lies at an end of the frame.
    fn outer_bins(&self) -> Vec<bool> {
        let mut seen_by = vec![0; self.shape().bins];
        for run in self.input.operator.time().instants() {
            let seen = &mut seen_by[run.first_bin..][..run.weights.len()];
            seen.iter_mut().for_each(|count| *count += 1);
        }
        let most = seen_by.iter().copied().max();
        seen_by.iter().map(|count| Some(*count) < most).collect()
    }

    /// Whether bin `t` has more lit voxels than are estimated: its faint light is left out, so it has no errors itself.
    fn is_crowded(&self, t: usize) -> bool {
        let mask = self.mask_above(t, THRESHOLD * self.brightness);
        mask.iter().filter(|&&lit| lit == 1).count() > MAX_VOXELS
    }

    /// The lit voxels of `bins` with the surroundings of `places`; `None` where they are too many in a bin.
    ///
    /// A voxel that is bright in two nearby bins belongs to light that goes on and off. It is taken as lit also where the
    /// video has it dark: what is left out of a bin is sought in those that share instants with it.
    fn coupled_voxels(&self, bins: Range<usize>, places: &[Place]) -> Option<Vec<Vec<Voxel>>> {
        let masks = |mask: &(dyn Fn(usize) -> Option<Vec<u8>> + Sync)| {
            let masks = bins.clone().into_par_iter().map(mask);
            masks.collect::<Option<Vec<Vec<u8>>>>()
        };
        let lit = masks(&|t| self.active_mask(t))?;
        let bright = masks(&|t| Some(self.mask_above(t, BRIGHT * self.brightness)))?;
        let outer = self.outer_bins();
        let voxels = bins.clone().into_par_iter().zip(lit).map(|(t, mut mask)| {
            let near = self.near_bins(t);
            let near = near.start.max(bins.start)..near.end.min(bins.end);
            for (at, is_in) in mask.iter_mut().enumerate() {
                let others = near.clone().filter(|&bin| bin != t);
                let mut bright = others.filter(|bin| bright[bin - bins.start][at] == 1);
                if bright.nth(1).is_some() {
                    *is_in = 1;
                }
            }
            let regions = places.iter().filter(|(bin, _)| *bin == t).map(|p| p.1);
            for region in regions.filter(|r| self.is_estimated(r)) {
                let wide = region.dilated(1, self.shape());
                wide.indices(self.shape().columns)
                    .for_each(|at| mask[at] = 1);
            }
            let mut voxels = Vec::new();
            self.add_voxels(t, |at| mask[at] == 1, &mut voxels);
            if outer[t] {
                voxels.iter_mut().for_each(|p| p.scale *= OUTER_SCALE);
            }
            voxels
        });
        Some(voxels.collect())
    }

    /// The columns of these voxels; `None` where a factor would take too long.
    fn coupled_columns(
        &self,
        instants: &Range<usize>,
        voxels: &[Vec<Voxel>],
    ) -> Option<ActiveColumns<'_>> {
        let columns = self.shape().columns;
        let pixels = voxels.iter();
        let pixels = pixels.map(|bin| bin.iter().map(|p| p.y * columns + p.x).collect());
        let active = ActiveColumns {
            operator: self.input.operator,
            weights: self.input.weights,
            instants: instants.clone(),
            first_bin: self.bins_of(instants).start,
            pixels: pixels.collect(),
        };
        (active.cost() <= MAX_COST).then_some(active)
    }

    /// Whether all bins can be estimated together.
    pub(super) fn is_feasible(&self) -> bool {
        let instants = self.all_instants();
        let voxels = self.coupled_voxels(self.bins_of(&instants), &[]);
        voxels.is_some_and(|voxels| self.coupled_columns(&instants, &voxels).is_some())
    }

    fn all_instants(&self) -> Range<usize> {
        0..self.input.operator.time().instants().len()
    }

    /// The system of `instants` with the surroundings of `places`; `None` where too many voxels are lit.
    fn coupled_system(&self, instants: &Range<usize>, places: &[Place]) -> Option<CoupledSystem> {
        let voxels = self.coupled_voxels(self.bins_of(instants), places)?;
        let active = self.coupled_columns(instants, &voxels)?;
        Some(CoupledSystem::new(self.input, &active, voxels))
    }

    /// Whether the surroundings of a region are small enough to be estimated.
    fn is_estimated(&self, region: &Region) -> bool {
        region.dilated(1, self.shape()).pixels() <= MAX_VOXELS / 2
    }

    /// Consecutive instants in the middle of those that hold light.
    pub(super) fn coupled_sample(&self, active: &[usize]) -> Option<CoupledSystem> {
        let middle = *active.get(active.len() / 2)?;
        let first = middle.saturating_sub(MAX_SAMPLES / 2).max(active[0]);
        let end = (first + MAX_SAMPLES).min(active[active.len() - 1] + 1);
        self.coupled_system(&(first..end), &[])
    }

    /// Index of each voxel in the video, with its estimate, by bin; `None` where too many are lit.
    pub(super) fn coupled_values(&self) -> Vec<Option<VoxelValues>> {
        let bins = self.shape().bins;
        let estimate = || {
            let system = self.coupled_system(&self.all_instants(), &[])?;
            let whitened = system.whiten(self.length_px)?;
            let mean = whitened.posterior(self.amplitude).mean();
            Some((system, mean))
        };
        let Some((system, mean)) = estimate() else {
            return vec![None; bins];
        };
        let shape = self.shape();
        let index = |p: &Voxel| p.bin * shape.pixels() + p.y * shape.columns + p.x;
        let mut values = vec![Some(Vec::new()); bins];
        for (p, v) in system.voxels.iter().flatten().zip(&mean) {
            let of_bin = values[p.bin].get_or_insert_default();
            of_bin.push((index(p), v.max(0.0) as f32));
        }
        (0..bins)
            .filter(|&t| self.is_crowded(t))
            .for_each(|t| values[t] = None);
        values
    }

    /// The means over regions in bins; `None` in bins that no instant sees, or where too many voxels are lit.
    pub(super) fn coupled_means(&self, places: &[Place]) -> Vec<Option<Mean>> {
        let bins = self.bins_of(&self.all_instants());
        let known: Vec<bool> = (0..self.shape().bins)
            .map(|t| bins.contains(&t) && !self.is_crowded(t))
            .collect();
        let seen = |place: &&Place| known[place.0];
        let found = self.means_of_seen(&places.iter().filter(seen).copied().collect::<Vec<_>>());
        let mut found = found.unwrap_or_default().into_iter();
        let means = places.iter();
        means
            .map(|place| seen(&place).then(|| found.next()).flatten())
            .collect()
    }

    fn means_of_seen(&self, places: &[Place]) -> Option<Vec<Mean>> {
        let system = self.coupled_system(&self.all_instants(), places)?;
        let whitened = system.whiten(self.length_px)?;
        let posterior = whitened.posterior(self.amplitude);
        let columns = self.shape().columns;
        let of_video = |p: &Voxel| f64::from(self.input.video.bin(p.bin)[p.y * columns + p.x]);
        let video: Vec<f64> = system.voxels.iter().flatten().map(of_video).collect();
        let (mean, pull) = (posterior.mean(), posterior.pull(&video));
        let weights = places.iter().map(|(bin, region)| {
            let at = bin - system.first_bin;
            (at, mean_weights(&system.voxels[at], region, *bin).0)
        });
        let weights: Vec<(usize, Vec<f64>)> = weights.collect();
        let variances = posterior.variances(&weights);
        let starts = whitened.gram.starts();
        let means = places.iter().zip(&weights).zip(variances);
        let means = means.map(|(((bin, region), (at, c)), (whole, noise))| {
            let range = starts[*at]..starts[at + 1];
            let mask = self.active_mask(*bin).expect("of a bin of the system");
            let mut wide = region.dilated(1, self.shape()).indices(columns);
            let variance = if wide.any(|i| mask[i] == 1) {
                let pull = &pull[range.clone()];
                let pull = mean_square_nearby(&system.voxels[*at], pull, region, *bin);
                // The larger of the two that are averaged where bins are independent: intervals were too short.
                whole.max(noise + pull)
            } else {
                whole
            };
            Mean {
                value: dot(c, &mean[range]),
                variance,
            }
        });
        Some(means.collect())
    }
}

/// `map(root, part)` of the part of `values` that belongs to each bin.
fn by_bin(
    band: &BlockBand<f64>,
    roots: &[Mat<f64>],
    values: &[f64],
    map: impl Fn(&Mat<f64>, Mat<f64>) -> Mat<f64> + Sync,
) -> Vec<f64> {
    let parts = band.starts().par_windows(2).zip(roots);
    let parts = parts.flat_map_iter(|(window, root)| {
        let part = &values[window[0]..window[1]];
        let part = Mat::from_fn(part.len(), 1, |i, _| part[i]);
        let mapped = map(root, part);
        (0..mapped.nrows())
            .map(|i| mapped[(i, 0)])
            .collect::<Vec<_>>()
    });
    parts.collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::linalg::solvers::Solve;
    use rowburst_core::LinearOperator;
    use rowburst_optics::camera::CameraParams;
    use rowburst_optics::{Camera, Image, Psf, RollingShutter, Sensor, Shutter, Video};

    const LENGTH_PX: f64 = 1.4;
    const SIGMA: f64 = 0.3;
    /// Some of the instants, as a sample has them.
    const INSTANTS: Range<usize> = 1..3;

    /// A frame of 6×5 pixels at an exposure of 2.5 rows, and two voxels that are lit in each bin.
    struct Frame {
        operator: RollingShutter,
        video: Video,
        measured: Vec<f32>,
        weights: Vec<f32>,
    }

    impl Frame {
        fn new() -> Self {
            let camera = Camera::new(CameraParams {
                rows: 6,
                columns: 5,
                shutter: Shutter::DualInsideOut,
                row_time_us: 10.0,
                exposure_us: 25.0,
                bins_per_row: 1,
                field: None,
                sensor: Sensor::default(),
            })
            .unwrap();
            let wave = |i: usize| ((i * i) as f32 * 0.7).sin() + 1.1;
            let psf = Psf::new(Image::from_fn(11, 9, |y, x| wave(y * 9 + x))).unwrap();
            let mut video = Video::zeros(camera.video_shape());
            for bin in 0..camera.video_shape().bins {
                let columns = camera.video_shape().columns;
                let at = [(1 + bin % 3, 2), (4, bin % 4)];
                for (k, (y, x)) in at.into_iter().enumerate() {
                    video.bin_mut(bin)[y * columns + x] = 1.0 + 0.3 * k as f32;
                }
            }
            Self {
                operator: RollingShutter::new(&camera, &psf),
                video,
                measured: (0..30).map(|i| 2.0 * wave(i + 3)).collect(),
                weights: (0..30).map(|i| [1.0, 0.5, 0.0][i % 3]).collect(),
            }
        }

        fn refit(&self) -> Refit<'_> {
            Refit {
                input: RefitInput {
                    operator: &self.operator,
                    measured: &self.measured,
                    weights: Some(&self.weights),
                    sigma: SIGMA,
                    video: &self.video,
                },
                brightness: 1.2,
                amplitude: 0.8,
                length_px: LENGTH_PX,
                chi_squared: 1.0,
                inflation: 1.0,
            }
        }

        /// Indices of the pixels of the instants.
        fn read(&self) -> Vec<usize> {
            INSTANTS.flat_map(|i| self.operator.indices_of(i)).collect()
        }

        /// `W A` of the voxels and `W b`, 0 in the rows that other instants read.
        fn dense(&self, voxels: &[Voxel]) -> (Mat<f64>, Mat<f64>) {
            let (m, read, columns) = (30, self.read(), self.video.shape().columns);
            let mut a = Mat::<f64>::zeros(m, voxels.len());
            let mut b = Mat::<f64>::zeros(m, 1);
            for (j, voxel) in voxels.iter().enumerate() {
                let mut one = Video::zeros(self.video.shape());
                one.bin_mut(voxel.bin)[voxel.y * columns + voxel.x] = 1.0;
                let mut light = vec![0.0; m];
                self.operator.apply(one.data(), &mut light);
                for &i in &read {
                    a[(i, j)] = f64::from(self.weights[i]) * f64::from(light[i]);
                }
            }
            for i in read {
                b[(i, 0)] = f64::from(self.weights[i]) * f64::from(self.measured[i]);
            }
            (a, b)
        }
    }

    fn assert_near(found: f64, expected: f64, tolerance: f64) {
        let limit = tolerance * expected.abs().max(1.0);
        assert!((found - expected).abs() < limit, "{found} {expected}");
    }

    /// Against the textbook's form, `K Aᵀ W (W A K Aᵀ W + σ²I)⁻¹` of dense matrices.
    #[test]
    fn estimate_errors_and_evidence_agree_with_another_form() {
        let frame = Frame::new();
        let refit = frame.refit();
        let system = refit.coupled_system(&INSTANTS, &[]).unwrap();
        let whitened = system.whiten(LENGTH_PX).unwrap();
        let voxels: Vec<Voxel> = system.voxels.iter().flatten().copied().collect();
        let (a, b) = frame.dense(&voxels);
        let (n, m) = (voxels.len(), a.nrows());
        let mut evidences = Vec::new();
        for amplitude in [0.8, 1.7] {
            let posterior = whitened.posterior(amplitude);
            let k = covariance(&voxels, LENGTH_PX) * faer::Scale(amplitude * amplitude);
            let noise = Mat::<f64>::identity(m, m) * faer::Scale(SIGMA * SIGMA);
            let dense = &a * &k * a.transpose() + noise;
            let whole = dense.llt(Side::Lower).unwrap();
            let gain = &k * a.transpose() * whole.solve(Mat::<f64>::identity(m, m));
            let mean = &gain * &b;
            for (i, value) in posterior.mean().iter().enumerate() {
                assert_near(*value, mean[(i, 0)], 1e-6);
            }
            let starts = whitened.gram.starts();
            let c: Vec<f64> = (0..starts[3] - starts[2]).map(|i| 1.0 - i as f64).collect();
            let mut all = Mat::<f64>::zeros(n, 1);
            (0..c.len()).for_each(|i| all[(starts[2] + i, 0)] = c[i]);
            let (variance, of_noise) = posterior.variances(&[(2, c)])[0];
            let covariance = &k - &gain * &a * &k;
            let expected = (all.transpose() * &covariance * &all)[(0, 0)];
            assert_near(variance, expected, 1e-6);
            let passed = gain.transpose() * &all;
            assert_near(of_noise, SIGMA * SIGMA * passed.squared_norm_l2(), 1e-6);
            let truth: Vec<f64> = (0..n).map(|i| (i as f64).cos()).collect();
            let v = Mat::from_fn(n, 1, |i, _| truth[i]);
            let expected = &gain * &a * &v - &v;
            for (i, value) in posterior.pull(&truth).iter().enumerate() {
                assert_near(*value, expected[(i, 0)], 1e-6);
            }
            let determinant: f64 = (0..m).map(|i| whole.L()[(i, i)].ln()).sum();
            let expected = determinant + 0.5 * (b.transpose() * whole.solve(&b))[(0, 0)];
            evidences.push(whitened.negative_log_evidence(amplitude).unwrap() - expected);
            let (misfit, free) = system.misfit(LENGTH_PX, amplitude).unwrap();
            let rest = (&b - &a * &mean).squared_norm_l2() / (SIGMA * SIGMA);
            assert_near(misfit, rest, 1e-5);
            let read = frame.read().into_iter();
            let informative = read.filter(|&i| frame.weights[i] > 0.0).count() as f64;
            let used: f64 = (0..m).map(|i| (&a * &gain)[(i, i)]).sum();
            assert_near(informative - free, used, 0.02);
        }
        assert!((evidences[0] - evidences[1]).abs() < 1e-5, "{evidences:?}");
    }
}
