//! The lit voxels, estimated anew from the frame, with a covariance.
//!
//! Light of bin `t` is taken to lie on `S`: what the video has above 0.01 of its brightness, with
//! neighbours. There `v_S ~ N(0, K)` with the covariance of `kernel`, whose amplitude `a` and
//! length `ℓ` are those that make the frame most likely (empirical Bayes), and
//!
//! ```text
//! E v_S = argmin ‖W(b − A_S v)‖²/σ² + vᵀK⁻¹v,    cov v_S = (A_Sᵀ W² A_S/σ² + K⁻¹)⁻¹
//! ```
//!
//! **Why a prior.** Least squares on `S` is free of bias and useless: its standard errors exceed the brightness of a
//! digit (docs/design/016). The prior fixes only the form of the covariance; the frame gives `a` and `ℓ`.
//!
//! **What the errors mean.** An interval of ±1.96 standard errors holds the truth in about 95 % of all
//! voxels and bins, not of all repetitions for one voxel: the bias of the prior counts as an
//! error (Nychka, J. Am. Stat. Assoc. 83, 1134, 1988). The variance is the mean of two. One is the posterior's, which
//! is too wide for points and too narrow for large shapes. The other is that of the estimate if the reconstruction
//! were the truth: the noise that it passes, and its bias on the reconstruction, squared, over positions nearby.
//! `tests/traces.rs` measures how often the interval holds the truth (docs/design/016). Where the frame has few
//! pixels per bin, the intervals are too narrow.
//!
//! **σ** enters every error in proportion. Where the misfit `χ²` of the frame is significantly above 1 (light outside
//! `S`, a wrong PSF, a σ that is too low), all errors grow by its root. The error of σ itself is not added, since it
//! hardly changes how often the interval holds the truth (docs/design/016). Fainter light outside `S` is not
//! accounted for otherwise.
//!
//! Where an exposure is longer than a row, instants share bins, and all bins are estimated together (`coupled`).

mod coupled;

use super::kernel::{Voxel, covariance, scales};
use super::posterior::{Evidence, Information, Posterior, WhitenedSystem};
use super::region::{Region, Trace};
use coupled::CoupledSystem;
use faer::Mat;
use rayon::prelude::*;
use rowburst_core::{Error, ErrorKind, Parameter, Result, Shape, Support};
use rowburst_optics::InstantWeights;
use rowburst_optics::forward::gram::columns_of;
use rowburst_optics::{RollingShutter, Video};
use rowburst_solve::admm::brightness;
use std::ops::Range;

/// Index of each voxel in the video with its value.
type VoxelValues = Vec<(usize, f32)>;

/// What an estimate is made from.
#[derive(Clone, Copy)]
pub struct RefitInput<'a> {
    /// `A`.
    pub operator: &'a RollingShutter,
    /// `b`, in counts.
    pub measured: &'a [f32],
    /// `W`; `None`: all 1.
    pub weights: Option<&'a [f32]>,
    /// Noise of a pixel of weight 1, in counts.
    pub sigma: f64,
    /// The reconstruction, which says where light is and about how much.
    pub video: &'a Video,
}

/// A region in a bin.
pub type Place = (usize, Region);

/// An estimate of the lit voxels, bin by bin.
pub struct Refit<'a> {
    input: RefitInput<'a>,
    brightness: f64,
    /// `a`.
    amplitude: f64,
    /// `ℓ`.
    length_px: f64,
    chi_squared: f64,
    inflation: f64,
}

/// A video of refitted voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct DebiasedVideo {
    /// `max(E v_S, 0)`, and 0 outside `S`.
    pub video: Video,
    /// Light of the refit over light of the reconstruction.
    pub light_ratio: f64,
    /// The same of the voxels above half of the brightness.
    pub bright_light_ratio: f64,
    /// Bins with too many lit voxels, which were left as they were.
    pub untouched_bins: usize,
}

/// Threshold of `S` over the brightness; larger leaves faint light out, smaller costs precision (docs/design/016).
const THRESHOLD: f64 = 0.01;
/// Doublings of the threshold in a bin that has too many voxels and shares instants with others.
const MAX_DOUBLINGS: u32 = 4;
/// Most voxels of an instant: a factorisation grows with the cube of their number.
const MAX_VOXELS: usize = 400;
/// Most instants that `a` and `ℓ` are found from; more cost time for some per cent (docs/design/016).
const MAX_SAMPLES: usize = 12;
/// Regions whose traces are estimated at a time; more make systems of coupled bins larger.
const MAX_REGIONS: usize = 4;
/// Lengths that are tried, in pixels; between them a parabola decides.
const LENGTHS_PX: [f64; 12] = [
    0.5, 0.6, 0.75, 0.9, 1.1, 1.3, 1.55, 1.85, 2.2, 2.6, 3.1, 3.7,
];
/// The length that is tried first.
const FIRST_LENGTH: usize = 6;
/// Step of the amplitude, as a factor, and its range.
const AMPLITUDE_STEP: f64 = 1.3;
const AMPLITUDES: (f64, f64) = (1e-3, 1e2);
/// Standard deviations above 1 from which `χ²` is believed to be more than chance.
const SIGNIFICANT: f64 = 3.0;

/// The voxels of an instant and what the frame says of them.
struct System {
    voxels: Vec<Voxel>,
    /// `W A/σ` and `W b/σ` of the pixels that the instant reads.
    matrix: Mat<f64>,
    measured: Mat<f64>,
    informative: usize,
}

impl<'a> Refit<'a> {
    /// Finds out how rough the light is.
    ///
    /// # Errors
    /// Too many lit voxels in bins that instants share.
    ///
    /// # Panics
    /// If a length does not match, or `σ` is not above zero.
    pub fn new(input: RefitInput<'a>) -> Result<Self> {
        let operator = input.operator;
        let pixels = operator.frame_shape().0 * operator.frame_shape().1;
        assert_eq!(input.measured.len(), pixels, "length of the frame");
        assert_eq!(input.video.shape(), operator.video_shape(), "the video");
        assert!(input.sigma > 0.0, "σ is above zero");
        let mut refit = Self {
            brightness: brightness(input.video.data()),
            input,
            amplitude: 0.5,
            length_px: LENGTHS_PX[FIRST_LENGTH],
            chi_squared: 1.0,
            inflation: 1.0,
        };
        if refit.is_coupled() && !refit.is_feasible() {
            return Err(Error::input(
                Parameter::StandardErrors,
                "an exposure longer than a row of many lit voxels",
                format!("bins that rows share are estimated together, which needs at most {MAX_VOXELS} lit voxels in each, and fewer where more rows share them"),
                "Expose for one row time at most, or use the traces without errors.",
            )
            .with_kind(ErrorKind::Unsupported));
        }
        if refit.brightness > 0.0
            && let Some(samples) = refit.samples()
        {
            refit.fit_hyperparameters(&samples);
            refit.test(&samples);
        }
        Ok(refit)
    }

    /// Rms of lit voxels over the brightness of the video, as the prior has it.
    pub fn amplitude(&self) -> f64 {
        self.amplitude
    }

    /// Distance in pixels over which light changes.
    pub fn length_px(&self) -> f64 {
        self.length_px
    }

    /// Misfit per degree of freedom: 1 where the refit explains the frame to within `σ`.
    pub fn chi_squared(&self) -> f64 {
        self.chi_squared
    }

    /// What all standard errors were multiplied by, 1 unless the misfit is significant.
    pub fn inflation(&self) -> f64 {
        self.inflation
    }

    /// The traces of `regions`, in their order.
    ///
    /// # Panics
    /// If a region does not lie in the field.
    pub fn traces(&self, regions: &[Region]) -> Vec<Trace> {
        let start = |region: &Region| Trace::without_errors(*region, self.input.video);
        let mut traces: Vec<Trace> = regions.iter().map(start).collect();
        let bins = self.shape().bins;
        let at_a_time = if self.is_coupled() {
            MAX_REGIONS
        } else {
            regions.len().max(1)
        };
        let chunks = traces.chunks_mut(at_a_time);
        for (traces, regions) in chunks.zip(regions.chunks(at_a_time)) {
            let of_bin = |t: usize| regions.iter().map(move |region| (t, *region));
            let places: Vec<Place> = (0..bins).flat_map(of_bin).collect();
            for ((k, (t, _)), mean) in places.iter().enumerate().zip(self.means(&places)) {
                if let Some((value, error)) = mean {
                    let trace = &mut traces[k % regions.len()];
                    (trace.debiased[*t], trace.standard_error[*t]) = (value, error);
                }
            }
        }
        traces
    }

    /// Mean and standard error of each region in its bin; `None` where they are not known.
    ///
    /// # Panics
    /// If a region does not lie in the field, or there is no such bin.
    pub fn means(&self, places: &[Place]) -> Vec<Option<(f64, f64)>> {
        let found: Vec<Option<Mean>> = if self.is_coupled() {
            self.coupled_means(places)
        } else {
            self.independent_means(places)
        };
        let error = |mean: Mean| self.inflation * mean.variance.max(0.0).sqrt();
        let found = found.into_iter();
        found
            .map(|mean| mean.map(|mean| (mean.value, error(mean))))
            .collect()
    }

    /// The video with its lit voxels as the refit has them.
    pub fn video(&self) -> DebiasedVideo {
        let old = self.input.video;
        let mut video = old.clone();
        let mut untouched_bins = 0;
        for (bins, found) in self.values() {
            let Some(found) = found else {
                untouched_bins += bins.len();
                continue;
            };
            for t in bins {
                video.bin_mut(t).fill(0.0);
            }
            for (at, value) in found {
                video.data_mut()[at] = value;
            }
        }
        let ratio = |lowest: f64| {
            let pairs = old.data().iter().zip(video.data());
            let (before, after) = pairs
                .filter(|(v, _)| f64::from(**v) >= lowest)
                .fold((0.0, 0.0), |(a, b), (v, w)| {
                    (a + f64::from(*v), b + f64::from(*w))
                });
            if before > 0.0 { after / before } else { 1.0 }
        };
        DebiasedVideo {
            light_ratio: ratio(f64::NEG_INFINITY),
            bright_light_ratio: ratio(0.5 * self.brightness),
            video,
            untouched_bins,
        }
    }

    /// Index of each voxel in the video with its estimate, by bins that are estimated together; `None` where they have too
    /// many lit voxels.
    fn values(&self) -> Vec<(Range<usize>, Option<VoxelValues>)> {
        let shape = self.shape();
        if self.is_coupled() {
            let values = self.coupled_values().into_iter().enumerate();
            return values.map(|(t, found)| (t..t + 1, found)).collect();
        }
        let instants = self.input.operator.time().instants().par_iter().enumerate();
        let values = |(i, run): (usize, &InstantWeights)| {
            let found = self.system(i, &[]).and_then(|system| {
                let posterior = self.estimate(&system)?;
                let index = |p: &Voxel| p.bin * shape.pixels() + p.y * shape.columns + p.x;
                let value = |k: usize| posterior.mean()[(k, 0)].max(0.0) as f32;
                let voxels = system.voxels.iter().enumerate();
                Some(voxels.map(|(k, p)| (index(p), value(k))).collect())
            });
            (run.first_bin..run.first_bin + run.weights.len(), found)
        };
        instants.map(values).collect()
    }

    fn shape(&self) -> Shape {
        self.input.video.shape()
    }

    /// The lit voxels of bin `t`, 1 in a mask; `None` where they are too many.
    fn active_mask(&self, t: usize) -> Option<Vec<u8>> {
        // The light of a bin that shares instants with others must not be left out: it would be sought in these.
        let steps = if self.is_coupled() { MAX_DOUBLINGS } else { 0 };
        (0..=steps).find_map(|step| {
            let threshold = THRESHOLD * self.brightness * f64::from(1 << step);
            let mask = self.mask_above(t, threshold);
            let count = mask.iter().filter(|&&active| active == 1).count();
            (count <= MAX_VOXELS).then_some(mask)
        })
    }

    /// What bin `t` of the video has above `threshold`, with neighbours, 1 in a mask.
    fn mask_above(&self, t: usize, threshold: f64) -> Vec<u8> {
        let shape = Shape::new(1, self.shape().rows, self.shape().columns);
        if threshold <= 0.0 {
            return vec![0; shape.pixels()];
        }
        // A bin that is lit all over comes back whole.
        let support = Support::above(self.input.video.bin(t), shape, &[threshold]);
        support.mask().to_vec()
    }

    /// The system of instant `i` with the `regions` that touch lit voxels; `None` where too
    /// many voxels are lit.
    fn system(&self, i: usize, regions: &[Region]) -> Option<System> {
        let run = &self.input.operator.time().instants()[i];
        let mut voxels = Vec::new();
        for t in run.first_bin..run.first_bin + run.weights.len() {
            let mut mask = self.active_mask(t)?;
            for region in self.active_regions(&mask, regions) {
                let wide = regions[region].dilated(1, self.shape());
                wide.indices(self.shape().columns)
                    .for_each(|at| mask[at] = 1);
            }
            self.add_voxels(t, |at| mask[at] == 1, &mut voxels);
        }
        (voxels.len() <= MAX_VOXELS).then(|| self.system_of(i, voxels))
    }

    /// Indices of the `regions` that a lit voxel lies in or beside, and whose surroundings are
    /// small enough to be estimated.
    fn active_regions(&self, mask: &[u8], regions: &[Region]) -> Vec<usize> {
        let touches = |region: &Region| {
            let wide = region.dilated(1, self.shape());
            let mut near = wide.indices(self.shape().columns);
            wide.pixels() <= MAX_VOXELS / 2 && near.any(|at| mask[at] == 1)
        };
        (0..regions.len())
            .filter(|&k| touches(&regions[k]))
            .collect()
    }

    fn add_voxels(&self, bin: usize, is_in: impl Fn(usize) -> bool, voxels: &mut Vec<Voxel>) {
        let columns = self.shape().columns;
        let scales = scales(&self.expected_bin(bin), columns, self.brightness);
        let of = |(at, &scale): (usize, &f64)| Voxel {
            bin,
            y: at / columns,
            x: at % columns,
            scale,
        };
        let active = scales.iter().enumerate().filter(|(at, _)| is_in(*at));
        voxels.extend(active.map(of));
    }

    fn system_of(&self, i: usize, voxels: Vec<Voxel>) -> System {
        let RefitInput {
            operator,
            measured,
            weights,
            sigma,
            ..
        } = self.input;
        let columns = self.shape().columns;
        let run = &operator.time().instants()[i];
        let pixels: Vec<usize> = voxels.iter().map(|p| p.y * columns + p.x).collect();
        let indices = operator.indices_of(i);
        let weight = |k: usize| weights.map_or(1.0, |w| f64::from(w[indices[k]])) / sigma;
        let mut matrix = columns_of(operator, i, &pixels);
        for (j, voxel) in voxels.iter().enumerate() {
            let overlap = run.weights[voxel.bin - run.first_bin];
            for k in 0..indices.len() {
                matrix[(k, j)] *= overlap * weight(k);
            }
        }
        let informative = (0..indices.len()).filter(|&k| weight(k) > 0.0).count();
        let measured = Mat::from_fn(indices.len(), 1, |k, _| {
            weight(k) * f64::from(measured[indices[k]])
        });
        System {
            voxels,
            matrix,
            measured,
            informative,
        }
    }

    fn estimate(&self, system: &System) -> Option<Posterior> {
        let whitened = system.whiten(&system.information(), self.length_px)?;
        Some(whitened.estimate(self.amplitude)?.0)
    }

    /// The means where each bin is seen by one instant at most.
    fn independent_means(&self, places: &[Place]) -> Vec<Option<Mean>> {
        let instants = self.input.operator.time().instants().par_iter().enumerate();
        let found = instants.map(|(i, run)| {
            let bins = run.first_bin..run.first_bin + run.weights.len();
            let seen = places.iter().enumerate();
            let seen: Vec<(usize, &Place)> = seen.filter(|(_, p)| bins.contains(&p.0)).collect();
            let of_instant: Vec<Place> = seen.iter().map(|(_, place)| **place).collect();
            let means = self.means_of_instant(i, &of_instant);
            let indices = seen.into_iter().map(|(k, _)| k);
            indices.zip(means).collect::<Vec<_>>()
        });
        let found: Vec<Vec<(usize, Option<Mean>)>> = found.collect();
        let mut means = vec![None; places.len()];
        for (k, mean) in found.into_iter().flatten() {
            means[k] = mean;
        }
        means
    }

    /// The means in bins of instant `i`.
    fn means_of_instant(&self, i: usize, places: &[Place]) -> Vec<Option<Mean>> {
        let none = vec![None; places.len()];
        let regions: Vec<Region> = places.iter().map(|place| place.1).collect();
        let Some(system) = self.system(i, &regions) else {
            return none;
        };
        let Some(posterior) = self.estimate(&system) else {
            return none;
        };
        let columns = self.shape().columns;
        let of_video = |p: &Voxel| f64::from(self.input.video.bin(p.bin)[p.y * columns + p.x]);
        let video = Mat::from_fn(system.voxels.len(), 1, |k, _| of_video(&system.voxels[k]));
        let pulled = system.matrix.transpose() * (&system.matrix * &video);
        let pulled = posterior.covariance_with(pulled.col_as_slice(0)) - &video;
        let mean = |(bin, region): &Place| {
            let (weights, inside) = mean_weights(&system.voxels, region, *bin);
            if !inside && region.pixels() <= MAX_VOXELS / 2 {
                return self.dark_mean(i, *bin, region, &system, &posterior);
            }
            let values = weights.iter().enumerate();
            let value = values.map(|(k, c)| c * posterior.mean()[(k, 0)]).sum();
            // The estimate is wᵀAᵀb with w = cov(v) c.
            let seen = &system.matrix * posterior.covariance_with(&weights);
            let pulled = pulled.col_as_slice(0);
            let pull = mean_square_nearby(&system.voxels, pulled, region, *bin);
            // Between what is expected of a video that the frame alone shows, and of one
            // that the reconstruction has right.
            let known = seen.squared_norm_l2() + pull;
            Some(Mean {
                value,
                variance: 0.5 * (known + posterior.variance(&weights)),
            })
        };
        places.iter().map(mean).collect()
    }

    /// Mean and variance of a region far from all lit voxels: those of the same joint estimate,
    /// by elimination of the lit voxels.
    fn dark_mean(
        &self,
        i: usize,
        bin: usize,
        region: &Region,
        active: &System,
        posterior: &Posterior,
    ) -> Option<Mean> {
        let columns = self.shape().columns;
        let wide = region.dilated(1, self.shape());
        let mut voxels = Vec::new();
        let is_in = |at: usize| wide.contains(at / columns, at % columns);
        self.add_voxels(bin, is_in, &mut voxels);
        let dark = self.system_of(i, voxels);
        let half = posterior.half(&(active.matrix.transpose() * &dark.matrix));
        let rest = &active.measured - &active.matrix * posterior.mean();
        let information = Information {
            gram: dark.matrix.transpose() * &dark.matrix - half.transpose() * &half,
            projected: dark.matrix.transpose() * rest,
        };
        let whitened = dark.whiten(&information, self.length_px)?;
        let (found, _) = whitened.estimate(self.amplitude)?;
        let (weights, _) = mean_weights(&dark.voxels, region, bin);
        let values = weights.iter().enumerate();
        Some(Mean {
            value: values.map(|(k, c)| c * found.mean()[(k, 0)]).sum(),
            variance: found.variance(&weights),
        })
    }

    /// What `a` and `ℓ` are found from; `None` without light.
    fn samples(&self) -> Option<Samples> {
        let instants = self.input.operator.time().instants();
        let is_active = |i: &usize| {
            let run = &instants[*i];
            let half = (0.5 * self.brightness) as f32;
            let mut bins = run.first_bin..run.first_bin + run.weights.len();
            bins.any(|t| self.input.video.bin(t).iter().any(|&v| v > half))
        };
        let active: Vec<usize> = (0..instants.len()).filter(is_active).collect();
        if self.is_coupled() {
            return self.coupled_sample(&active).map(Samples::Coupled);
        }
        let step = active.len().div_ceil(MAX_SAMPLES).max(1);
        let chosen: Vec<usize> = active.into_iter().step_by(step).collect();
        let systems = chosen.into_par_iter().map(|i| self.system(i, &[]));
        let systems: Vec<Option<System>> = systems.collect();
        let systems = systems
            .into_iter()
            .flatten()
            .filter(|s| !s.voxels.is_empty())
            .map(|s| (s.information(), s));
        let systems: Vec<(Information, System)> = systems.collect();
        (!systems.is_empty()).then_some(Samples::Instants(systems))
    }

    /// Sets `a` and `ℓ` to what makes the frame most likely.
    fn fit_hyperparameters(&mut self, samples: &Samples) {
        let mut amplitude = self.amplitude;
        let mut tried = [None; LENGTHS_PX.len()];
        let mut value = |k: usize| -> f64 {
            *tried[k].get_or_insert_with(|| {
                samples
                    .whiten(LENGTHS_PX[k])
                    .map_or(f64::INFINITY, |whitened| {
                        let (best, value) = best_amplitude(&whitened, amplitude);
                        amplitude = best;
                        value
                    })
            })
        };
        let last = LENGTHS_PX.len() - 1;
        let mut at = FIRST_LENGTH;
        loop {
            let here = value(at);
            if at > 0 && value(at - 1) < here {
                at -= 1;
            } else if at < last && value(at + 1) < here {
                at += 1;
            } else {
                break;
            }
        }
        let logs = |k: usize| LENGTHS_PX[k].ln();
        let mut length = LENGTHS_PX[at];
        if at > 0 && at < last {
            let points = [at - 1, at, at + 1].map(|k| (logs(k), value(k)));
            length = lowest_of_parabola(points).exp();
        }
        if let Some(whitened) = samples.whiten(length) {
            self.length_px = length;
            self.amplitude = best_amplitude(&whitened, amplitude).0;
        }
    }

    /// Tests whether the refit explains what the samples were fitted to.
    fn test(&mut self, samples: &Samples) {
        let (misfit, free) = match samples {
            Samples::Coupled(system) => system
                .misfit(self.length_px, self.amplitude)
                .unwrap_or_default(),
            Samples::Instants(systems) => {
                let parts = systems.par_iter().map(|(_, system)| {
                    let posterior = self.estimate(system)?;
                    let rest = &system.measured - &system.matrix * posterior.mean();
                    let free = system.informative as f64 - posterior.effective_dof();
                    Some((rest.squared_norm_l2(), free))
                });
                let parts: Vec<Option<(f64, f64)>> = parts.collect();
                let sum = |of: fn(&(f64, f64)) -> f64| parts.iter().flatten().map(of).sum::<f64>();
                (sum(|p| p.0), sum(|p| p.1))
            }
        };
        if free >= 1.0 {
            self.chi_squared = misfit / free;
            if self.chi_squared > 1.0 + SIGNIFICANT * (2.0 / free).sqrt() {
                self.inflation = self.chi_squared.sqrt();
            }
        }
    }
}

/// What `a` and `ℓ` are found from.
enum Samples {
    /// Instants, evenly spaced in time, that hold light.
    Instants(Vec<(Information, System)>),
    /// Consecutive instants that share bins.
    Coupled(CoupledSystem),
}

impl Samples {
    /// How likely the data are for this length, of each part; `None` where a covariance is not positive definite.
    fn whiten(&self, length_px: f64) -> Option<Vec<Box<dyn Evidence>>> {
        match self {
            Self::Instants(systems) => {
                let whitened = systems.par_iter().map(|(information, system)| {
                    let whitened = system.whiten(information, length_px)?;
                    Some(Box::new(whitened) as Box<dyn Evidence>)
                });
                whitened.collect()
            }
            Self::Coupled(system) => {
                let whitened = system.whiten(length_px)?;
                Some(vec![Box::new(whitened)])
            }
        }
    }
}

/// The mean over a region in a bin.
#[derive(Debug, Clone, Copy)]
struct Mean {
    value: f64,
    variance: f64,
}

impl System {
    fn information(&self) -> Information {
        Information {
            gram: self.matrix.transpose() * &self.matrix,
            projected: self.matrix.transpose() * &self.measured,
        }
    }

    fn whiten(&self, information: &Information, length_px: f64) -> Option<WhitenedSystem> {
        WhitenedSystem::new(information, &covariance(&self.voxels, length_px))
    }
}

/// `c` with `cᵀv` the mean over `region` in `bin`, and whether the region has a voxel in `voxels`.
fn mean_weights(voxels: &[Voxel], region: &Region, bin: usize) -> (Vec<f64>, bool) {
    let weight = 1.0 / region.pixels() as f64;
    let is_in = |p: &Voxel| p.bin == bin && region.contains(p.y, p.x);
    let weights: Vec<f64> = voxels
        .iter()
        .map(|p| if is_in(p) { weight } else { 0.0 })
        .collect();
    let inside = weights.iter().any(|&c| c > 0.0);
    (weights, inside)
}

/// Pixels along each axis by which a region is moved to see how its pull scatters.
const NEARBY: usize = 2;

/// The mean square of the mean of `values` over `region` in `bin` and over the same region moved by
/// up to [`NEARBY`] pixels.
fn mean_square_nearby(voxels: &[Voxel], values: &[f64], region: &Region, bin: usize) -> f64 {
    let side = 2 * NEARBY + 1;
    let mut sums = vec![0.0; side * side];
    for (k, voxel) in voxels.iter().enumerate().filter(|(_, p)| p.bin == bin) {
        for (at, sum) in sums.iter_mut().enumerate() {
            let moved = |voxel: usize, shift: usize| (voxel + shift).checked_sub(NEARBY);
            let (y, x) = (moved(voxel.y, at / side), moved(voxel.x, at % side));
            if let (Some(y), Some(x)) = (y, x)
                && region.contains(y, x)
            {
                *sum += values[k];
            }
        }
    }
    let pixels = region.pixels() as f64;
    let squares: f64 = sums.iter().map(|sum| (sum / pixels).powi(2)).sum();
    squares / sums.len() as f64
}

/// The amplitude at which the data are most likely, and how unlikely they then are.
fn best_amplitude(whitened: &[Box<dyn Evidence>], start: f64) -> (f64, f64) {
    let value = |ln_a: f64| -> f64 {
        let parts: Option<Vec<f64>> = whitened
            .par_iter()
            .map(|w| w.negative_log_evidence(ln_a.exp()))
            .collect();
        parts.map_or(f64::INFINITY, |parts| parts.iter().sum())
    };
    let (low, high) = (AMPLITUDES.0.ln(), AMPLITUDES.1.ln());
    let step = AMPLITUDE_STEP.ln();
    let mut points = [start.ln() - step, start.ln(), start.ln() + step].map(|x| (x, value(x)));
    loop {
        let [first, middle, last] = points;
        if first.1 < middle.1 && first.1 <= last.1 && first.0 > low {
            let x = first.0 - step;
            points = [(x, value(x)), first, middle];
        } else if last.1 < middle.1 && last.0 < high {
            let x = last.0 + step;
            points = [middle, last, (x, value(x))];
        } else {
            break;
        }
    }
    (lowest_of_parabola(points).exp(), points[1].1)
}

/// Where the parabola through three evenly or unevenly spaced points is lowest, within them.
fn lowest_of_parabola(points: [(f64, f64); 3]) -> f64 {
    let [(x0, y0), (x1, y1), (x2, y2)] = points;
    let (left, right) = ((y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1));
    let curvature = (right - left) / (x2 - x0);
    if !(curvature.is_finite() && curvature > 0.0) {
        return x1;
    }
    (0.5 * (x0 + x1) - left / (2.0 * curvature)).clamp(x0, x2)
}
