//! Refinement of the PSF itself.
//!
//! With the video fixed, a frame is a linear map `B` of the PSF. Its error `δp = L z` has a prior (`psf_error`), and
//! the brightness of the active voxels is marginalised as in `step`. The posterior mean solves
//!
//! ```text
//! (I + Lᵀ Bᵀ K⁻¹ B L) z = Lᵀ Bᵀ K⁻¹ W(b − B p₀)
//! ```
//!
//! by conjugate gradients, always around the capture `p₀`. Several frames are a sum. Reconstruction and refinement
//! alternate while the noise level falls to that of the sensor. Parameters that were found before the PSF are a little
//! wrong, and change with it: their derivatives are further columns of `B L`.

use super::super::RunResult;
use super::calibrator::{Calibrator, Correction, Trial};
use super::parameters::ModelParameter;
use super::psf_error::{Capture, PsfError};
use super::search::{MIN_FALL, Proposal, Search};
use super::step::{Free, Jacobian, Marginal};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;
use rowburst_core::vecmath::{dot, norm_squared};
use rowburst_optics::forward::psf_map::PsfMap;
use rowburst_optics::{Image, Psf};
use rowburst_solve::DataTerm;
use tracing::info;

/// Rounds of a reconstruction and a refinement.
const ROUNDS: usize = 5;
/// First noise level over the held-out error.
const START_LEVEL: f64 = 0.85;
/// Noise level of a round over that of the one before.
const LEVEL_RATIO: f64 = 0.7;
/// Noise level of a round over the held-out error of the one before.
const HELD_OUT_RATIO: f64 = 0.5;
/// Held-out error of a later round over the best one up to which it is preferred; larger prefers sharper PSFs.
const LATER: f64 = 1.02;
/// The round in which a refinement that has not helped is given up.
const DOUBTED_ROUND: usize = 2;
/// Standard deviation of the active voxels over the brightness; smaller than in `step`, since the PSF has more freedom.
const AMPLITUDE: f64 = 0.2;
/// Standard deviation of the change of a parameter beside the PSF, over the width of its prior; larger admits ghosts.
const PARAMETER_WIDTH: f64 = 0.3;
/// Variance of the misfit over that of sensor and capture up to which the capture's noise explains it.
const EXPLAINED_BY_NOISE: f64 = 1.4;
/// Least change of the speckle over its size that is looked for.
const MIN_CHANGE: f64 = 0.01;
/// Random vectors that give the misfit of a prior, and the seed of their draw.
const PROBES: usize = 3;
const SEED: u64 = 0x9e37_79b9;
/// Residual of conjugate gradients over the right side, and most iterations.
const TOLERANCE: f64 = 3e-3;
const MAX_ITERATIONS: usize = 40;

impl Search<'_, '_, '_> {
    /// Refines the PSF of `start`, and changes the parameters `free` a little with it. Returns `None` where it may not be
    /// refined, or does not soon reach an error below `limit`; with `only_noise` also where noise of the capture does not
    /// explain the misfit.
    pub fn refine(
        &mut self,
        start: &Proposal,
        capture: &Capture,
        limit: f64,
        only_noise: bool,
        free: &[ModelParameter],
    ) -> Result<Option<Proposal>, Box<RunResult>> {
        if !self.correctable.psf {
            return Ok(None);
        }
        let mut correction = start.correction.clone();
        let mut level = (START_LEVEL * start.error).max(self.sigma);
        let mut best: Option<Proposal> = None;
        let mut priors: Option<Vec<PsfError>> = None;
        let mut errors = Vec::new();
        for round in 0..=ROUNDS {
            let mut trials = self.run(&correction, level, self.iterations_at(level))?;
            let proposal = Proposal::new(&correction, level, &trials);
            let error = proposal.error;
            info!(
                "self-calibration, round {round} of the PSF: noise level {:.3} σ, held-out error {:.3} σ",
                level / self.sigma,
                error / self.sigma
            );
            let best_error = best.as_ref().map_or(f64::INFINITY, |best| best.error);
            if error <= LATER * best_error {
                best = Some(proposal);
            }
            let is_settled = level <= self.sigma && error > (1.0 - MIN_FALL) * best_error;
            if round == ROUNDS || is_settled {
                break;
            }
            if round == DOUBTED_ROUND && error > limit {
                return Ok(None);
            }
            let maps = trials.iter().map(|trial| self.calibrator.psf_map(trial));
            let Some(maps) = maps.collect::<Option<Vec<PsfMap>>>() else {
                return Ok(None);
            };
            if priors.is_none() {
                let Some(found) = self.error_priors(&maps, &trials, capture, level, only_noise)
                else {
                    return Ok(None);
                };
                priors = Some(found);
            }
            let refinement = Refinement {
                start: &start.correction,
                priors: priors.as_deref().expect("set above"),
                free,
                level,
            };
            refinement.step(
                &mut self.calibrator,
                &mut correction,
                &maps,
                &mut trials,
                &mut errors,
            );
            level = (LEVEL_RATIO * level)
                .min(HELD_OUT_RATIO * error)
                .max(self.sigma);
        }
        Ok(best)
    }

    /// The priors of the PSF's error that explain a misfit of the size `level`; `None` where only noise of the capture
    /// may, and does not.
    fn error_priors(
        &self,
        maps: &[PsfMap],
        trials: &[Trial],
        capture: &Capture,
        level: f64,
        only_noise: bool,
    ) -> Option<Vec<PsfError>> {
        let mut priors = Vec::new();
        let mut explained = self.sigma.powi(2);
        if let Some(noise) = &capture.noise {
            explained += misfit(maps, trials, noise);
            priors.push(noise.clone());
        }
        if only_noise && level.powi(2) > EXPLAINED_BY_NOISE * explained {
            return None;
        }
        let unexplained = (level.powi(2) - explained).max(0.0);
        let change = (unexplained / misfit(maps, trials, &capture.change)).sqrt();
        if change > MIN_CHANGE || priors.is_empty() {
            priors.push(capture.change.clone().scaled(change.max(MIN_CHANGE)));
        }
        Some(priors)
    }
}

/// Mean square of what `prior` makes a pixel of the weighted frames wrong by.
fn misfit(maps: &[PsfMap], trials: &[Trial], prior: &PsfError) -> f64 {
    let mut rng = Pcg64::seed_from_u64(SEED);
    let mut sum = 0.0;
    for _ in 0..PROBES {
        let z: Vec<f32> = (0..prior.unknowns())
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        let error = prior.apply(&z);
        let frames = maps.iter().zip(trials);
        sum += frames
            .map(|(map, trial)| norm_squared(&trial.data.weigh(&map.apply(&error))))
            .sum::<f64>();
    }
    let count: usize = trials.iter().map(|t| t.data.measurement_count()).sum();
    (sum / (PROBES * count.max(1)) as f64).max(f64::MIN_POSITIVE)
}

/// What each step of a refinement is made from.
struct Refinement<'r> {
    /// The correction around which parameters change.
    start: &'r Correction,
    priors: &'r [PsfError],
    free: &'r [ModelParameter],
    level: f64,
}

impl Refinement<'_> {
    /// Sets `correction` to the PSF and the parameters that its capture and the frames make most likely. `errors` is the
    /// solution of the step before, and then that of this one.
    fn step(
        &self,
        calibrator: &mut Calibrator,
        correction: &mut Correction,
        maps: &[PsfMap],
        trials: &mut [Trial],
        errors: &mut Vec<f32>,
    ) {
        let free = Free {
            parameters: self.free,
            has_row_offsets: false,
        };
        let jacobians: Vec<Jacobian> = trials
            .iter()
            .map(|trial| Jacobian::new(calibrator, correction, trial, free))
            .collect();
        let widths = self.free.iter().map(|p| PARAMETER_WIDTH * p.prior_width());
        let widths: Vec<f64> = widths.collect();
        let anchor = self.anchor(calibrator, correction);
        let residuals: Vec<Vec<f32>> = trials
            .iter()
            .zip(maps)
            .map(|(trial, map)| {
                let light = trial.data.weigh(&map.apply(anchor.image().data()));
                let measured = trial.data.measurements().iter();
                measured.zip(&light).map(|(b, a)| b - a).collect()
            })
            .collect();
        let mut system = System {
            maps,
            marginals: trials
                .iter_mut()
                .map(|trial| Marginal::new(trial, self.level, AMPLITUDE))
                .collect(),
            priors: self.priors,
            jacobians: &jacobians,
            widths: &widths,
            variance: self.level * self.level,
            psf_len: anchor.image().data().len(),
        };
        let mut right = system.weighted_adjoint(&residuals);
        let first = right.len() - widths.len();
        for ((right, parameter), width) in right[first..].iter_mut().zip(self.free).zip(&widths) {
            let moved = correction.parameters[*parameter] - self.start.parameters[*parameter];
            *right -= (moved / width) as f32;
        }
        errors.resize(right.len(), 0.0);
        // The changes of the last step have been made.
        errors[first..].fill(0.0);
        let mut product = |z: &[f32]| -> Vec<f32> {
            let frames = system.apply(z);
            let mut out = system.weighted_adjoint(&frames);
            out.iter_mut().zip(z).for_each(|(o, z)| *o += z);
            out
        };
        conjugate_gradient(&mut product, &right, errors);
        let (error, changes) = system.split(errors);
        for (parameter, change) in self.free.iter().zip(changes) {
            correction
                .parameters
                .add(*parameter, change, calibrator.camera());
        }
        correction.parameters.drop_negligible_timing();
        let anchor = self.anchor(calibrator, correction);
        let image = anchor.image();
        let pairs = image.data().iter().zip(&error);
        let values: Vec<f32> = pairs.map(|(p, e)| (p + e).max(0.0)).collect();
        let refined = Image::new(image.rows(), image.columns(), values);
        let refined = Psf::new(refined.expect("the size of the anchor"));
        correction.refined = Some(refined.unwrap_or(anchor));
    }

    /// The PSF around which errors are sought: that of the start, or with free parameters that of the parameters.
    fn anchor(&self, calibrator: &mut Calibrator, correction: &Correction) -> Psf {
        let psfs = if self.free.is_empty() {
            calibrator.psfs(self.start)
        } else {
            calibrator.model_psfs(&correction.parameters)
        };
        psfs.central().clone()
    }
}

/// The linear system of a refinement: errors `z` of the PSF, and changes of parameters over their widths, in one vector.
struct System<'s> {
    maps: &'s [PsfMap],
    marginals: Vec<Marginal<'s>>,
    priors: &'s [PsfError],
    /// Of each frame, the derivative by each parameter.
    jacobians: &'s [Jacobian],
    /// Standard deviation of the change of each parameter.
    widths: &'s [f64],
    /// Square of the noise level.
    variance: f64,
    /// Number of values of the PSF.
    psf_len: usize,
}

impl System<'_> {
    /// `L z` of the errors, and the changes of the parameters.
    fn split(&self, z: &[f32]) -> (Vec<f32>, Vec<f64>) {
        let mut error = vec![0.0; self.psf_len];
        let mut rest = z;
        for prior in self.priors {
            let (part, other) = rest.split_at(prior.unknowns());
            let of_prior = prior.apply(part);
            error.iter_mut().zip(of_prior).for_each(|(s, e)| *s += e);
            rest = other;
        }
        let changes = rest.iter().zip(self.widths);
        (error, changes.map(|(z, w)| f64::from(*z) * w).collect())
    }

    /// How they change each weighted frame.
    fn apply(&self, z: &[f32]) -> Vec<Vec<f32>> {
        let (error, changes) = self.split(z);
        let frames = self.maps.iter().zip(&self.marginals).zip(self.jacobians);
        frames
            .map(|((map, marginal), jacobian)| {
                let mut light = marginal.trial.data.weigh(&map.apply(&error));
                for (column, change) in jacobian.columns().iter().zip(&changes) {
                    let pairs = light.iter_mut().zip(column);
                    pairs.for_each(|(l, c)| *l += *change as f32 * c);
                }
                light
            })
            .collect()
    }

    /// The adjoint of [`Self::apply`], after `K⁻¹`.
    fn weighted_adjoint(&mut self, frames: &[Vec<f32>]) -> Vec<f32> {
        let mut gradient = vec![0.0; self.psf_len];
        let mut changes = vec![0.0; self.widths.len()];
        for (i, frame) in frames.iter().enumerate() {
            let solved = self.marginals[i].solve(frame);
            let solved: Vec<f32> = solved.iter().map(|v| (v / self.variance) as f32).collect();
            let part = self.maps[i].adjoint(&self.marginals[i].trial.data.weigh(&solved));
            gradient.iter_mut().zip(part).for_each(|(g, p)| *g += p);
            let columns = self.jacobians[i].columns().iter();
            let products = columns.map(|column| dot(column, &solved));
            changes.iter_mut().zip(products).for_each(|(c, p)| *c += p);
        }
        let mut z: Vec<f32> = self
            .priors
            .iter()
            .flat_map(|prior| prior.adjoint(&gradient))
            .collect();
        let changes = changes.iter().zip(self.widths);
        z.extend(changes.map(|(c, w)| (c * w) as f32));
        z
    }
}

/// Solves `product(x) = right`, from `x` on.
fn conjugate_gradient(product: &mut dyn FnMut(&[f32]) -> Vec<f32>, right: &[f32], x: &mut [f32]) {
    let mut residual = right.to_vec();
    if x.iter().any(|x| *x != 0.0) {
        let pairs = residual.iter_mut().zip(product(x));
        pairs.for_each(|(r, p)| *r -= p);
    }
    let mut direction = residual.clone();
    let mut power = norm_squared(&residual);
    let target = TOLERANCE.powi(2) * norm_squared(right);
    for _ in 0..MAX_ITERATIONS {
        if power <= target {
            break;
        }
        let image = product(&direction);
        let step = (power / dot(&direction, &image)) as f32;
        x.iter_mut()
            .zip(&direction)
            .for_each(|(x, d)| *x += step * d);
        residual
            .iter_mut()
            .zip(&image)
            .for_each(|(r, i)| *r -= step * i);
        let next = norm_squared(&residual);
        let ratio = (next / power) as f32;
        power = next;
        direction
            .iter_mut()
            .zip(&residual)
            .for_each(|(d, r)| *d = r + ratio * *d);
    }
}

/// Rms change from the PSF `before` to `after` over the rms of `before`.
pub(super) fn relative_change(before: &Psf, after: &Psf) -> f64 {
    let pairs = after.image().data().iter().zip(before.image().data());
    let change: Vec<f32> = pairs.map(|(a, b)| a - b).collect();
    (norm_squared(&change) / norm_squared(before.image().data())).sqrt()
}
