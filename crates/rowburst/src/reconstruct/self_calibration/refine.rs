//! Refinement of the PSF itself.
//!
//! With the video fixed, the frame is a linear map `B` of the PSF. Its error `δp = L z` has a prior (`psf_error`), and
//! the brightness of the active voxels is marginalised as in `step`. The posterior mean solves
//!
//! ```text
//! (I + Lᵀ Bᵀ K⁻¹ B L) z = Lᵀ Bᵀ K⁻¹ W(b − B p₀)
//! ```
//!
//! by conjugate gradients, always from the capture `p₀`. Reconstruction and refinement alternate while the noise level
//! falls to that of the sensor.

use super::super::RunResult;
use super::calibrator::{Correction, Trial};
use super::psf_error::{Capture, PsfError};
use super::search::{Candidate, ITERATIONS, Search};
use super::step::Marginal;
use crate::forward::psf_map::PsfMap;
use crate::solve::DataTerm;
use crate::vecmath::{dot, norm_squared};
use crate::{Image, Psf};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64;

/// Rounds of a reconstruction and a refinement.
const ROUNDS: usize = 5;
/// First noise level over the held-out error.
const START_LEVEL: f64 = 0.85;
/// Noise level of a round over that of the one before, and over the held-out error.
const LEVEL_RATIOS: (f64, f64) = (0.7, 0.5);
/// Held-out error of a later round over the best one up to which it is preferred.
const LATER: f64 = 1.02;
/// Standard deviation of the active voxels over the brightness; smaller than in `step`, since the PSF has more freedom.
const AMPLITUDE: f64 = 0.2;
/// Variance of the misfit over that of sensor and capture up to which the capture's noise explains it.
const EXPLAINED_BY_NOISE: f64 = 1.4;
/// Least change of the speckle over its size that is looked for.
const MIN_CHANGE: f64 = 0.01;
/// Random vectors that give the misfit of a prior, and the seed of their draw.
const PROBES: usize = 3;
const SEED: u64 = 0x9e37_79b9;
/// Residual of conjugate gradients over that at the start, and most iterations.
const TOLERANCE: f64 = 3e-3;
const MAX_ITERATIONS: usize = 40;

impl Search<'_, '_, '_> {
    /// Refines the PSF of `start`. With `only_noise` stops after the first reconstruction if noise of the capture does
    /// not explain the misfit, and returns `None`.
    pub fn refine(
        &mut self,
        start: &Candidate,
        capture: &Capture,
        only_noise: bool,
    ) -> Result<Option<Candidate>, Box<RunResult>> {
        let anchor = self.calibrator.psfs(&start.correction).central().clone();
        let mut correction = start.correction.clone();
        let mut level = (START_LEVEL * start.error()).max(self.sigma);
        let mut best: Option<Candidate> = None;
        let mut priors: Option<Vec<PsfError>> = None;
        for round in 0..=ROUNDS {
            let mut trial = self.run(&correction, level, ITERATIONS)?;
            let candidate = Candidate {
                correction: correction.clone(),
                level,
                held_out: trial.held_out.clone(),
            };
            let error = candidate.error();
            if best
                .as_ref()
                .is_none_or(|best| error <= LATER * best.error())
            {
                best = Some(candidate);
            }
            if round == ROUNDS {
                break;
            }
            let image = anchor.image();
            let map = PsfMap::new(
                trial.data.shutter(),
                (image.rows(), image.columns()),
                &trial.video,
            );
            if priors.is_none() {
                let Some(found) = self.error_priors(&map, &trial, capture, level, only_noise)
                else {
                    return Ok(None);
                };
                priors = Some(found);
            }
            let priors = priors.as_deref().expect("set above");
            correction.refined = Some(posterior_mean(&map, &mut trial, level, &anchor, priors));
            level = (LEVEL_RATIOS.0 * level)
                .min(LEVEL_RATIOS.1 * error)
                .max(self.sigma);
        }
        Ok(best)
    }

    /// The priors of the PSF's error that explain a misfit of the size `level`; `None` where only noise of the capture
    /// may, and does not.
    fn error_priors(
        &self,
        map: &PsfMap,
        trial: &Trial,
        capture: &Capture,
        level: f64,
        only_noise: bool,
    ) -> Option<Vec<PsfError>> {
        let mut priors = Vec::new();
        let mut explained = self.sigma.powi(2);
        if let Some(noise) = &capture.noise {
            explained += misfit(map, trial, noise);
            priors.push(noise.clone());
        }
        if only_noise && level.powi(2) > EXPLAINED_BY_NOISE * explained {
            return None;
        }
        let unexplained = (level.powi(2) - explained).max(0.0);
        let change = (unexplained / misfit(map, trial, &capture.change)).sqrt();
        if change > MIN_CHANGE || priors.is_empty() {
            priors.push(capture.change.clone().scaled(change.max(MIN_CHANGE)));
        }
        Some(priors)
    }
}

/// Mean square of what `prior` makes a pixel of the weighted frame wrong by.
fn misfit(map: &PsfMap, trial: &Trial, prior: &PsfError) -> f64 {
    let mut rng = Pcg64::seed_from_u64(SEED);
    let mut sum = 0.0;
    for _ in 0..PROBES {
        let z: Vec<f32> = (0..prior.unknowns())
            .map(|_| StandardNormal.sample(&mut rng))
            .collect();
        sum += norm_squared(&trial.data.weigh(&map.apply(&prior.apply(&z))));
    }
    let count = trial.data.measurement_count().max(1);
    (sum / (PROBES * count) as f64).max(f64::MIN_POSITIVE)
}

/// The PSF that `anchor` and the frame make most likely.
fn posterior_mean(
    map: &PsfMap,
    trial: &mut Trial,
    level: f64,
    anchor: &Psf,
    priors: &[PsfError],
) -> Psf {
    let image = anchor.image();
    let starts: Vec<usize> = priors
        .iter()
        .scan(0, |end, prior| {
            let start = *end;
            *end += prior.unknowns();
            Some(start)
        })
        .collect();
    let error_of = |z: &[f32]| -> Vec<f32> {
        let mut sum = vec![0.0; image.data().len()];
        for (prior, &start) in priors.iter().zip(&starts) {
            let part = prior.apply(&z[start..start + prior.unknowns()]);
            sum.iter_mut().zip(part).for_each(|(s, p)| *s += p);
        }
        sum
    };
    let light = trial.data.weigh(&map.apply(image.data()));
    let measured = trial.data.measurements().iter();
    let residual: Vec<f32> = measured.zip(&light).map(|(b, a)| b - a).collect();
    let weights_and_map = |x: &[f32], trial: &Trial| trial.data.weigh(&map.apply(x));
    let mut marginal = Marginal::new(trial, level, AMPLITUDE);
    let variance = level * level;
    // Lᵀ Bᵀ K⁻¹ of a weighted residual.
    let back = |r: &[f32], marginal: &mut Marginal| -> Vec<f32> {
        let solved = marginal.solve(r);
        let solved: Vec<f32> = solved.iter().map(|v| (v / variance) as f32).collect();
        let gradient = map.adjoint(&marginal.trial.data.weigh(&solved));
        priors
            .iter()
            .flat_map(|prior| prior.adjoint(&gradient))
            .collect()
    };
    let right = back(&residual, &mut marginal);
    let mut product = |z: &[f32]| -> Vec<f32> {
        let predicted = weights_and_map(&error_of(z), marginal.trial);
        let mut out = back(&predicted, &mut marginal);
        out.iter_mut().zip(z).for_each(|(o, z)| *o += z);
        out
    };
    let z = conjugate_gradient(&mut product, right);
    let error = error_of(&z);
    let pairs = image.data().iter().zip(&error);
    let values: Vec<f32> = pairs.map(|(p, e)| (p + e).max(0.0)).collect();
    let refined = Image::new(image.rows(), image.columns(), values);
    Psf::new(refined.expect("the size of the anchor")).unwrap_or_else(|_| anchor.clone())
}

/// Solves `product(x) = right`.
fn conjugate_gradient(product: &mut dyn FnMut(&[f32]) -> Vec<f32>, right: Vec<f32>) -> Vec<f32> {
    let mut x = vec![0.0; right.len()];
    let mut residual = right;
    let mut direction = residual.clone();
    let mut power = norm_squared(&residual);
    let target = TOLERANCE.powi(2) * power;
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
    x
}

impl Correction {
    /// Rms change of the PSF by its refinement over its rms; `model` is the PSF before. `None`: it was not refined.
    pub fn refinement(&self, model: &Psf) -> Option<f64> {
        let refined = self.refined.as_ref()?.image().data();
        let pairs = refined.iter().zip(model.image().data());
        let change: Vec<f32> = pairs.map(|(after, before)| after - before).collect();
        Some((norm_squared(&change) / norm_squared(model.image().data())).sqrt())
    }
}
