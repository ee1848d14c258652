//! How far an objective is from its minimum: a bound from the dual problem.
//!
//! With `τ R(v) = max_p ⟨K v, p⟩ + τ w_1 Σ v` (see [`super::objective`]) the dual of
//! `min_{v≥0} ½‖b − A v‖² + τ R(v)` is
//!
//! ```text
//! max D(y) = ⟨b, y⟩ − ½‖y‖²   over  Aᵀy − Kᵀp ≤ τ w_1,  p in the balls of radius τ w
//! ```
//!
//! (Fenchel; Boyd & Vandenberghe 2004, ch. 5). Every `y` that keeps the constraint gives
//! `D(y) ≤ min F`, and at the minimum `y = b − A v` makes them equal. So a residual is
//! turned into such a `y`, and `F(v) − D(y)` bounds what is still to be gained:
//!
//! 1. `p` is fitted: accelerated projected gradient steps on `½‖(Aᵀy − Kᵀp − τ w_1)₊‖²`, from
//!    the last `p`. (Without differences there is none, and step 2 is exact.)
//! 2. What is left is repaired, by scaling `y` and `p` down (where `w_1 > 0`), or by taking
//!    a little of a light that is even in each bin from `y`, which lowers `Aᵀy` everywhere.
//!    The better one counts.
//! 3. Along `s·y`, `0 ≤ s ≤ 1`, which keeps the constraint too, the best `s` is taken.
//!
//! A bound holds for good, so the largest one is kept. Sums are f64, `Aᵀy` is f32: the bound
//! is as exact as its rounding, about 10⁻⁶ of the objective.

use super::Objective;
use crate::linop::LinearOperator;
use crate::vecmath::{dot, norm_squared};

/// The objective of a video, and a bound of the minimum from below.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Certificate {
    /// `F(v)`.
    pub primal: f64,
    /// `D(y) ≤ min F`.
    pub dual: f64,
}

impl Certificate {
    /// `F(v) − D(y)`, at least what `F(v)` is above the minimum.
    pub fn gap(&self) -> f64 {
        self.primal - self.dual
    }

    /// `(F(v) − D(y)) / D(y)`: at most by this part is the objective above its minimum;
    /// infinite where the bound says nothing.
    pub fn excess(&self) -> f64 {
        if self.dual > 0.0 {
            self.gap() / self.dual
        } else if self.primal <= 0.0 {
            0.0
        } else {
            f64::INFINITY
        }
    }
}

impl std::fmt::Display for Certificate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match 100.0 * self.excess().max(0.0) {
            percent if percent < 1e-3 => {
                f.write_str("the objective is within 0.001 % of its minimum")
            }
            percent if percent.is_finite() => {
                let digits = (1.0 - percent.log10().floor()).clamp(0.0, 4.0) as usize;
                // Up, but for rounding: it is a bound.
                let unit = 10f64.powi(digits as i32);
                let percent = (percent * unit - 1e-6).ceil() / unit;
                write!(
                    f,
                    "the objective is within {percent:.digits$} % of its minimum"
                )
            }
            _ => f.write_str("nothing is known about the distance of the objective to its minimum"),
        }
    }
}

/// Finds [`Certificate`]s of one objective; keeps the largest bound and its `p`.
pub struct Certifier<'a> {
    objective: &'a Objective<'a>,
    /// The dual of the differences.
    p: Vec<f32>,
    best: f64,
    /// `AᵀA1`.
    reach: Vec<f32>,
}

impl<'a> Certifier<'a> {
    /// Nothing known yet: the bound is 0.
    pub fn new(objective: &'a Objective<'a>) -> Self {
        let operator = objective.operator();
        let mut even = vec![0.0; operator.range_len()];
        let mut reach = vec![1.0; operator.domain_len()];
        operator.apply(&reach, &mut even);
        operator.adjoint(&even, &mut reach);
        Self {
            objective,
            p: vec![0.0; objective.differences().range_len()],
            // y = 0 keeps the constraint.
            best: 0.0,
            reach,
        }
    }

    /// The certificate of any `video ≥ 0`: its residual, with `p` fitted by `steps` steps.
    ///
    /// # Panics
    /// If a length does not match.
    pub fn certify(&mut self, video: &[f32], steps: usize) -> Certificate {
        let objective = self.objective;
        let mut light = vec![0.0; objective.operator().range_len()];
        objective.operator().apply(video, &mut light);
        let residual = residual(objective, &light);
        let mut pull = vec![0.0; video.len()];
        objective.operator().adjoint(&residual, &mut pull);
        self.fit(&pull, steps);
        let p = std::mem::take(&mut self.p);
        self.bound(&residual, &pull, &p);
        self.p = p;
        Certificate {
            primal: objective.value_with(video, &light),
            dual: self.best,
        }
    }

    /// The largest bound so far.
    pub(super) fn best(&self) -> f64 {
        self.best
    }

    /// Learns from a solver's own duals: `y` and `p` within its balls.
    pub(super) fn learn(&mut self, y: &[f32], p: &[f32]) {
        let mut pull = vec![0.0; self.reach.len()];
        self.objective.operator().adjoint(y, &mut pull);
        self.bound(y, &pull, p);
    }

    /// The `p` that `steps` steps fit to `y`.
    pub(super) fn fitted(mut self, y: &[f32], steps: usize) -> Vec<f32> {
        let mut pull = vec![0.0; self.reach.len()];
        self.objective.operator().adjoint(y, &mut pull);
        self.fit(&pull, steps);
        self.p
    }

    /// Step 1 of the module's list, for `pull = Aᵀy`.
    fn fit(&mut self, pull: &[f32], steps: usize) {
        let k = self.objective.differences();
        if self.p.is_empty() {
            return;
        }
        let step = (1.0 / k.norm_squared_bound()) as f32;
        let price = self.objective.price() as f32;
        let (mut over, mut rise) = (vec![0.0f32; pull.len()], vec![0.0f32; self.p.len()]);
        let mut extrapolated = self.p.clone();
        let mut t = 1.0f64;
        for _ in 0..steps {
            k.adjoint(&extrapolated, &mut over);
            for (over, pull) in over.iter_mut().zip(pull) {
                *over = (pull - *over - price).max(0.0);
            }
            k.apply(&over, &mut rise);
            for (extrapolated, rise) in extrapolated.iter_mut().zip(&rise) {
                *extrapolated += step * rise;
            }
            self.objective.project(&mut extrapolated);
            let next = 0.5 * (1.0 + (1.0 + 4.0 * t * t).sqrt());
            let momentum = ((t - 1.0) / next) as f32;
            for (p, extrapolated) in self.p.iter_mut().zip(&mut extrapolated) {
                let new = *extrapolated;
                *extrapolated += momentum * (new - *p);
                *p = new;
            }
            t = next;
        }
    }

    /// Steps 2 and 3 of the module's list, for `pull = Aᵀy`.
    fn bound(&mut self, y: &[f32], pull: &[f32], p: &[f32]) {
        let objective = self.objective;
        let mut over = vec![0.0f32; pull.len()];
        objective.differences().adjoint(p, &mut over);
        for (over, pull) in over.iter_mut().zip(pull) {
            *over = pull - *over;
        }
        let price = objective.price();
        let largest = over.iter().fold(0.0f64, |most, &o| most.max(f64::from(o)));
        let s = if largest > 0.0 {
            price / largest
        } else {
            f64::INFINITY
        };
        // p may be scaled down, but not up.
        let most = if p.is_empty() { s } else { s.min(1.0) };
        self.best = self.best.max(self.along(y, most));
        over.iter_mut().for_each(|o| *o -= price as f32);
        self.repair(y, &over);
    }

    /// Takes an even light in each bin from `y`, as much as the bin's voxels need that are
    /// too high by `over`; scaled, since bins that share their instants share it.
    fn repair(&mut self, y: &[f32], over: &[f32]) {
        let pixels = self.objective.shape().pixels();
        let mut light = vec![0.0f32; over.len()];
        let bins = over
            .chunks_exact(pixels)
            .zip(self.reach.chunks_exact(pixels));
        for (light, (over, reach)) in light.chunks_exact_mut(pixels).zip(bins) {
            light.fill(largest_ratio(over, reach) as f32);
        }
        let operator = self.objective.operator();
        let mut seen = vec![0.0f32; y.len()];
        operator.apply(&light, &mut seen);
        operator.adjoint(&seen, &mut light);
        let delta = largest_ratio(over, &light);
        if !(delta > 0.0 && delta.is_finite()) {
            return;
        }
        let mixed: Vec<f32> = y
            .iter()
            .zip(&seen)
            .map(|(&y, &seen)| (f64::from(y) - delta * f64::from(seen)) as f32)
            .collect();
        self.best = self.best.max(self.along(&mixed, 1.0));
    }

    /// The largest `D(s·y)` for `0 ≤ s ≤ most`.
    fn along(&self, y: &[f32], most: f64) -> f64 {
        let (slope, size) = (dot(self.objective.measured(), y), norm_squared(y));
        if slope <= 0.0 || size == 0.0 {
            return 0.0;
        }
        let s = (slope / size).min(most);
        s * slope - 0.5 * s * s * size
    }
}

/// The largest `over/reach` of the voxels with `over > 0`, at least 0.
fn largest_ratio(over: &[f32], reach: &[f32]) -> f64 {
    let pairs = over.iter().zip(reach).filter(|(over, _)| **over > 0.0);
    pairs.fold(0.0, |most, (&over, &reach)| {
        let ratio = if reach > 0.0 {
            f64::from(over) / f64::from(reach)
        } else {
            f64::INFINITY
        };
        most.max(ratio)
    })
}

/// `b − A v`.
pub(super) fn residual(objective: &Objective, light: &[f32]) -> Vec<f32> {
    let pairs = objective.measured().iter().zip(light);
    pairs.map(|(b, a)| b - a).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn says_what_it_means() {
        let text = |primal, dual| Certificate { primal, dual }.to_string();
        assert_eq!(
            text(1.0012, 1.0),
            "the objective is within 0.12 % of its minimum"
        );
        assert_eq!(
            text(1.25, 1.0),
            "the objective is within 25 % of its minimum"
        );
        assert_eq!(
            text(4.0, 1.0),
            "the objective is within 300 % of its minimum"
        );
        assert!(text(1.0, 0.0).starts_with("nothing is known"));
        assert!(text(f64::INFINITY, 0.0).starts_with("nothing is known"));
        assert!(text(0.0, 0.0).contains("0.001 %"));
    }
}
