//! Known places: `v(x, t) = Σ_k s_k(t) G_k(x)`, one trace of brightness for each place that the guide shows.
//!
//! `G_k` is the light of the registered guide above its surroundings at place `k`, and `G_0` the smooth rest. With
//! `L_k = W A G_k/σ`, the light of a place that is lit evenly, and the weights `w` of the bins of an exposure, the frame is
//! linear in the traces,
//!
//! ```text
//! W b/σ = Σ_t w_t Σ_k s_k(t) L_k + noise
//! ```
//!
//! which is least squares with few unknowns for each instant, banded in time where exposures share bins. The brightness
//! `s_k(t)` has a Gaussian prior about the mean gain, of the width that makes the frame most likely (empirical Bayes): it
//! matters where exposures are longer than a row. Standard errors are those of the posterior. Where the misfit `χ²` is
//! significantly above 1, they grow: a wrong shape of a place disturbs traces more than noise does (docs/design/028).

use super::affine::{Affine, Field};
use super::frame_fit::FrameFit;
use super::picture;
use super::shapes::Shapes;
use crate::active_gram::last_bins;
use faer::Mat;
use rayon::prelude::*;
use rowburst_core::vecmath::{dot, norm_squared, solve_normal};
use rowburst_core::{Error, Parameter, Result};
use rowburst_optics::{Image, InstantWeights};
use rowburst_solve::block_band::{BandFactor, BlockBand};

/// Most places over the numbers that an instant reads; more have standard errors as large as their light
/// (docs/design/028).
const MAX_PLACES: f64 = 0.5;
/// Standard deviation of a trace about the mean gain, over that gain, during the registration; its factor in the search for
/// the most likely one, and the least one: smaller makes too short intervals where noise hides all changes.
const FIRST_WIDTH: f64 = 4.0;
const WIDTH_STEP: f64 = 0.7;
const MIN_WIDTH: f64 = 0.4;
/// Least gain over that of a guide whose light is the frame's; a frame of noise has none.
const MIN_GAIN: f64 = 1e-3;
/// Most values of the light of all places; more need over a gigabyte.
const MAX_VALUES: usize = 1 << 28;
/// Most corrections of the map, their greatest part in pixels, and the fall of the squared residual above which one was the
/// last.
const CORRECTIONS: usize = 8;
const MAX_STEP_PX: f64 = 2.0;
const SMALL_FALL: f64 = 0.999;
/// Standard deviation of a parameter of the map about its start, in pixels of a field of 108.
const AFFINE_PX: f64 = 3.0;
/// Standard deviations above 1 from which `χ²` is more than chance.
const SIGNIFICANT: f64 = 3.0;
/// Growth of the variance of a trace with `χ² − 1`; smaller makes too short intervals where the guide is blurred
/// (docs/design/028).
const MISFIT_WEIGHT: f64 = 5.0;

/// The places of a guide with their traces.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownPlaces {
    /// The place of each pixel of the field, `[y, x]`, from 1; 0: none.
    pub labels: Vec<u32>,
    /// The trace of each place, from label 1 on.
    pub traces: Vec<PlaceTrace>,
    /// `χ²` of the fit per degree of freedom.
    pub chi_squared: f64,
    /// Factor on all standard errors because of it; 1 unless the misfit is significant.
    pub inflation: f64,
}

/// The brightness of a place over time.
#[derive(Debug, Clone, PartialEq)]
pub struct PlaceTrace {
    /// Centre of its light on the field, `(y, x)` in pixels.
    pub centre: (f64, f64),
    /// Number of its pixels.
    pub pixels: usize,
    /// Mean light of its pixels above the rest in each bin, in counts.
    pub value: Vec<f64>,
    /// Standard error of `value`.
    pub standard_error: Vec<f64>,
}

/// The model without its parameters, under one map of the guide.
pub(super) struct PlacesModel<'a> {
    frame: &'a FrameFit<'a>,
    field: Field,
    pub affine: Affine,
    /// The guide seen from the field.
    shapes: Shapes,
    /// Its derivatives along y and x.
    gradients: Vec<(f32, f32)>,
    /// `L_k` for one row time, from `k = 0` on.
    light: Vec<Vec<f32>>,
    /// Gain of the guide that traces vary about.
    pub gain: f64,
    /// `Lᵀ L` over the bins.
    normal: BlockBand<f64>,
    /// `1/a²` of the prior, and the factor of `Lᵀ L + ρI`.
    rho: f64,
    factor: BandFactor<f64>,
    /// The most likely `s_k(t)`, bin by bin, with `k = 0` first.
    values: Vec<f64>,
    /// `W(b − A v)/σ` of them.
    residual: Vec<f32>,
}

impl<'a> PlacesModel<'a> {
    /// The traces of the places of `guide`, registered from `start` on, with the most likely prior.
    ///
    /// # Errors
    /// No place, or too many for the numbers of an instant.
    pub fn registered(frame: &'a FrameFit<'a>, guide: &Image, start: &Affine) -> Result<Self> {
        let mut best = Self::new(frame, guide, *start, FIRST_WIDTH)?;
        for _ in 0..CORRECTIONS {
            let Some(affine) = best.corrected_map(start) else {
                break;
            };
            frame.cancel().check()?;
            // A step too far may lose the places.
            let Ok(next) = Self::new(frame, guide, affine, FIRST_WIDTH) else {
                break;
            };
            let fall = norm_squared(&next.residual) / norm_squared(&best.residual);
            if fall >= 1.0 {
                break;
            }
            best = next;
            if fall > SMALL_FALL {
                break;
            }
        }
        let width = best.likely_width()?;
        Ok(best.with_width(width))
    }

    /// The traces of the places of `guide`, which `affine` maps the field to; `width` is the standard deviation of their
    /// prior over the mean gain.
    ///
    /// # Errors
    /// As above.
    pub fn new(frame: &'a FrameFit<'a>, guide: &Image, affine: Affine, width: f64) -> Result<Self> {
        let shape = frame.shape();
        let field = Field::of(shape);
        let (dy, dx) = field.displacement(&affine);
        let places = (0..shape.pixels()).map(|i| {
            let (y, x) = ((i / field.columns) as f32, (i % field.columns) as f32);
            picture::at(guide, y + dy[i], x + dx[i])
        });
        let (guide, gradients): (Vec<f32>, Vec<(f32, f32)>) = places
            .map(|(value, along_y, along_x)| (value.max(0.0), (along_y, along_x)))
            .unzip();
        let shapes = Shapes::new(&Image::new(field.rows, field.columns, guide)?);
        let numbers = frame.fitted_count() as f64 / frame.instants().len() as f64;
        let most = (MAX_PLACES * numbers) as usize;
        check_count(shapes.count, most.min(MAX_VALUES / frame.pixels()))?;
        let even = frame.apply(&shapes.sum().repeat(shape.bins));
        let target = frame.target();
        let power = norm_squared(&even).max(f64::from(f32::MIN_POSITIVE));
        let least = MIN_GAIN * (norm_squared(&target) / power).sqrt();
        let gain = (dot(&even, &target) / power).max(least);
        let gain = gain.max(f64::from(f32::MIN_POSITIVE));
        let light = light_of(frame, &shapes)?;
        let normal = normal(frame, &light);
        let rho = prior_weight(width, gain);
        let model = Self {
            factor: normal.factor(rho),
            values: Vec::new(),
            residual: Vec::new(),
            normal,
            frame,
            field,
            affine,
            shapes,
            gradients,
            light,
            gain,
            rho,
        };
        Ok(model.with_traces())
    }

    /// The model with a prior whose standard deviation is `width` times the mean gain.
    fn with_width(mut self, width: f64) -> Self {
        self.rho = prior_weight(width, self.gain);
        self.normal.refactor(self.rho, &mut self.factor);
        self.with_traces()
    }

    /// The model with its traces and residual.
    fn with_traces(mut self) -> Self {
        self.values = adjoint(self.frame, &self.light, &self.frame.target());
        let mean = self.rho * self.gain;
        self.values.iter_mut().for_each(|v| *v += mean);
        self.factor.solve(&mut self.values);
        self.residual = self.frame.target();
        let light = self.frame.apply(&self.linear_video());
        let pairs = self.residual.iter_mut().zip(&light);
        pairs.for_each(|(r, a)| *r -= a);
        self
    }

    /// Standard deviation of the prior over the mean gain.
    pub fn width(&self) -> f64 {
        1.0 / (self.rho.sqrt() * self.gain)
    }

    /// The width of the prior that makes the frame most likely (Rasmussen & Williams, eq. 5.8), whatever its noise: an
    /// estimate of `σ` that is a little too large takes changes of brightness for noise.
    fn likely_width(&self) -> Result<f64> {
        let bins = self.frame.shape().bins;
        let even = self.frame.apply(&self.shapes.sum().repeat(bins));
        let gain = self.gain as f32;
        let target = self.frame.target();
        let pairs = target.iter().zip(&even);
        let change: Vec<f32> = pairs.map(|(b, a)| b - gain * a).collect();
        let projected = adjoint(self.frame, &self.light, &change);
        let (power, count) = (norm_squared(&change), self.frame.fitted_count() as f64);
        let unlikelihood = |width: f64| {
            let rho = prior_weight(width, self.gain);
            let factor = self.normal.factor(rho);
            let mut solved = projected.clone();
            factor.solve(&mut solved);
            let explained: f64 = solved.iter().zip(&projected).map(|(a, b)| a * b).sum();
            let left = (power - explained).max(f64::MIN_POSITIVE);
            factor.log_determinant() - solved.len() as f64 * rho.ln() + count * left.ln()
        };
        let mut best = (FIRST_WIDTH, unlikelihood(FIRST_WIDTH));
        while best.0 > MIN_WIDTH {
            self.frame.cancel().check()?;
            let width = (WIDTH_STEP * best.0).max(MIN_WIDTH);
            let value = unlikelihood(width);
            if value >= best.1 {
                break;
            }
            best = (width, value);
        }
        Ok(best.0)
    }

    /// A Gauss–Newton step in the map, with the traces free: `(Jᵀ J − Jᵀ L N⁻¹ Lᵀ J) δ = Jᵀ r` with `N = Lᵀ L + ρI`. `None`: the
    /// frame does not tell it.
    fn corrected_map(&self, start: &Affine) -> Option<Affine> {
        let derivatives: Vec<Vec<f32>> = (0..6)
            .map(|k| {
                let above: Vec<f32> = (0..self.gradients.len())
                    .map(|i| {
                        let (eta, xi) = self.field.place(i);
                        let (along_y, along_x) = self.gradients[i];
                        let gradient = if k < 3 { along_y } else { along_x };
                        gradient * [1.0, eta, xi][k % 3]
                    })
                    .collect();
                self.frame.apply(&self.expand(&above, None))
            })
            .collect();
        let coupled = derivatives
            .iter()
            .map(|column| adjoint(self.frame, &self.light, column));
        let coupled: Vec<Vec<f64>> = coupled.collect();
        let weight = (AFFINE_PX * self.field.half_side() / 54.0).powi(-2);
        let mut gram = vec![vec![0.0; 6]; 6];
        let mut right = vec![0.0; 6];
        for k in 0..6 {
            let mut solved = coupled[k].clone();
            self.factor.solve(&mut solved);
            for j in 0..6 {
                let explained: f64 = solved.iter().zip(&coupled[j]).map(|(a, b)| a * b).sum();
                gram[j][k] = dot(&derivatives[j], &derivatives[k]) - explained;
            }
            gram[k][k] += weight;
            let deviation = self.affine.parameters[k] - start.parameters[k];
            right[k] = dot(&derivatives[k], &self.residual) - weight * deviation;
        }
        let step = solve_normal(&gram, &right)?;
        let mut affine = self.affine;
        let pairs = affine.parameters.iter_mut().zip(step);
        pairs.for_each(|(p, s)| *p += s.clamp(-MAX_STEP_PX, MAX_STEP_PX));
        Some(affine)
    }

    /// The video of the model, without negative light.
    pub fn video(&self) -> Vec<f32> {
        let mut video = self.linear_video();
        video.iter_mut().for_each(|v| *v = v.max(0.0));
        video
    }

    /// The traces in counts with their standard errors, and the degrees of freedom that they have taken.
    pub fn traces(&self) -> (KnownPlaces, f64) {
        let errors: Vec<f64> = self
            .factor
            .inverse_diagonal()
            .iter()
            .map(|v| v.max(0.0).sqrt())
            .collect();
        let left: f64 = errors.iter().map(|e| self.rho * e * e).sum();
        let parameters = self.values.len() as f64 - left;
        let freedom = (self.frame.fitted_count() as f64 - parameters).max(1.0);
        let chi_squared = norm_squared(&self.residual) / freedom;
        let is_chance = chi_squared < 1.0 + SIGNIFICANT * (2.0 / freedom).sqrt();
        let excess = if is_chance { 0.0 } else { chi_squared - 1.0 };
        let inflation = (1.0 + MISFIT_WEIGHT * excess).sqrt();
        let traces = (1..=self.shapes.count).map(|k| self.trace(k, &errors, inflation));
        let places = KnownPlaces {
            traces: traces.collect(),
            labels: self.shapes.labels.clone(),
            chi_squared,
            inflation,
        };
        (places, parameters)
    }

    fn trace(&self, k: usize, errors: &[f64], inflation: f64) -> PlaceTrace {
        let (labels, above) = (&self.shapes.labels, &self.shapes.above);
        let (mut count, mut light, mut y, mut x) = (0, 0.0, 0.0, 0.0);
        for i in (0..labels.len()).filter(|&i| labels[i] as usize == k) {
            let value = f64::from(above[i].max(f32::MIN_POSITIVE));
            count += 1;
            light += value;
            y += value * (i / self.field.columns) as f64;
            x += value * (i % self.field.columns) as f64;
        }
        let mean = light / count as f64;
        let of = |values: &[f64], factor: f64| {
            let bins = values.chunks_exact(self.shapes.count + 1);
            bins.map(|bin| factor * bin[k]).collect()
        };
        PlaceTrace {
            centre: (y / light, x / light),
            pixels: count,
            value: of(&self.values, mean),
            standard_error: of(errors, mean * inflation),
        }
    }

    /// `Σ_k s_k(t) G_k`.
    fn linear_video(&self) -> Vec<f32> {
        self.expand(&self.shapes.above, Some(&self.shapes.rest))
    }

    /// The video whose place `k` is `s_k(t)` times `above`, over `s_0(t)` times `rest`.
    fn expand(&self, above: &[f32], rest: Option<&[f32]>) -> Vec<f32> {
        let owners = &self.shapes.owners;
        let bins = self.values.chunks_exact(self.shapes.count + 1);
        bins.flat_map(|bin| {
            (0..owners.len()).map(|i| {
                let place = match owners[i] {
                    0 => 0.0,
                    owner => bin[owner as usize] as f32 * above[i],
                };
                place + rest.map_or(0.0, |rest| bin[0] as f32 * rest[i])
            })
        })
        .collect()
    }
}

/// `1/a²` of a prior whose standard deviation `a` is `width` times the mean gain.
fn prior_weight(width: f64, gain: f64) -> f64 {
    (width * gain).powi(-2)
}

/// `L_k` for one row time, from `k = 0` on.
fn light_of(frame: &FrameFit, shapes: &Shapes) -> Result<Vec<Vec<f32>>> {
    let one = |k: usize| {
        frame.cancel().check()?;
        let pixels = shapes.above.iter().zip(&shapes.owners);
        let place: Vec<f32> = match k {
            0 => shapes.rest.clone(),
            k => pixels
                .map(|(g, &owner)| if owner as usize == k { *g } else { 0.0 })
                .collect(),
        };
        let mut light = frame.apply(&place.repeat(frame.shape().bins));
        for (i, instant) in frame.instants().iter().enumerate() {
            let total: f64 = instant.weights.iter().sum();
            for at in frame.pixels_of(i) {
                light[at] /= total as f32;
            }
        }
        Ok(light)
    };
    (0..=shapes.count).map(one).collect()
}

/// `Lᵀ L` over all bins.
fn normal(frame: &FrameFit, light: &[Vec<f32>]) -> BlockBand<f64> {
    let bins = frame.shape().bins;
    let instants = frame.instants();
    let grams: Vec<Mat<f64>> = (0..instants.len())
        .into_par_iter()
        .map(|i| {
            let pixels = frame.pixels_of(i);
            let of = |i: usize, k: usize| f64::from(light[k][pixels[i]]);
            let columns = Mat::from_fn(pixels.len(), light.len(), of);
            columns.transpose() * &columns
        })
        .collect();
    let mut normal = BlockBand::zero(&vec![light.len(); bins], last_bins(instants, 0, bins));
    for (InstantWeights { first_bin, weights }, gram) in instants.iter().zip(&grams) {
        for (a, &weight) in weights.iter().enumerate() {
            for (b, &other) in weights[..=a].iter().enumerate() {
                let block = faer::Scale(weight * other) * gram;
                normal.add(first_bin + a, first_bin + b, block.as_ref());
            }
        }
    }
    normal
}

/// `Lᵀ values` over all bins.
fn adjoint(frame: &FrameFit, light: &[Vec<f32>], values: &[f32]) -> Vec<f64> {
    let size = light.len();
    let mut out = vec![0.0; size * frame.shape().bins];
    for (i, InstantWeights { first_bin, weights }) in frame.instants().iter().enumerate() {
        let pixels = frame.pixels_of(i);
        for (k, light) in light.iter().enumerate() {
            let products = pixels
                .iter()
                .map(|&p| f64::from(light[p]) * f64::from(values[p]));
            let product: f64 = products.sum();
            for (a, weight) in weights.iter().enumerate() {
                out[(first_bin + a) * size + k] += weight * product;
            }
        }
    }
    out
}

/// Refuses no place, and a number of places that an instant cannot tell apart or that memory does not hold.
fn check_count(count: usize, most: usize) -> Result<()> {
    let fault = |rule: String, remedy: &'static str| {
        Err(Error::input(
            Parameter::Guide,
            format!("{count} places in the guide"),
            rule,
            remedy,
        ))
    };
    if count == 0 {
        return fault(
            "a place is lit: four or more pixels that touch and are brighter than others".into(),
            "Give a guide with bright places on a darker ground and without hot pixels, or another model.",
        );
    }
    if count > most {
        return fault(
            format!(
                "there are at most {most} places: half of the numbers of an instant, and what a gigabyte holds"
            ),
            "Give a guide with fewer lit places, or another model; lit pixels that touch are one place.",
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_place_and_too_many_are_refused() {
        assert!(check_count(108, 108).is_ok());
        let error = check_count(109, 108).unwrap_err().to_string();
        assert!(error.contains("at most 108"), "{error}");
        let error = check_count(0, 108).unwrap_err().to_string();
        assert!(error.contains("hot pixels"), "{error}");
    }
}
