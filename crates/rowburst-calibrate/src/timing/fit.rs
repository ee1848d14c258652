//! Least squares with a few parameters that enter the model nonlinearly.
//!
//! `minimise_θ ‖y − B(θ) c‖²`, the linear `c` eliminated for each `θ` (variable
//! projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 413, 1973), `θ` by
//! Levenberg–Marquardt. The Jacobian of the projected residual gives the errors of `θ`
//! with those of `c` included.

use rowburst_core::vecmath::solve_normal;

/// Columns of a linear model.
pub(super) type Basis = Vec<Vec<f64>>;

/// The least-squares fit of `y` by the columns of `basis`.
pub(super) struct Linear {
    /// A weight for each column; 0 for one that the others make superfluous.
    pub weights: Vec<f64>,
    pub residual: Vec<f64>,
}

/// A column whose remainder beside the others is below this part of it is superfluous.
const RANK_TOLERANCE: f64 = 1e-7;

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// `y += s x`
pub(super) fn add(y: &mut [f64], s: f64, x: &[f64]) {
    y.iter_mut().zip(x).for_each(|(y, x)| *y += s * x);
}

/// Fits by modified Gram–Schmidt.
pub(super) fn linear(basis: &[Vec<f64>], y: &[f64]) -> Linear {
    let n = basis.len();
    let mut directions: Basis = Vec::with_capacity(n);
    let mut mixing = vec![vec![0.0; n]; n];
    let mut along = vec![0.0; n];
    let mut residual = y.to_vec();
    for (j, column) in basis.iter().enumerate() {
        let mut rest = column.clone();
        let whole = dot(&rest, &rest).sqrt();
        for (i, direction) in directions.iter().enumerate() {
            mixing[i][j] = dot(direction, &rest);
            add(&mut rest, -mixing[i][j], direction);
        }
        let left = dot(&rest, &rest).sqrt();
        if left > RANK_TOLERANCE * whole && left > 0.0 {
            rest.iter_mut().for_each(|v| *v /= left);
            mixing[j][j] = left;
            along[j] = dot(&rest, &residual);
            add(&mut residual, -along[j], &rest);
        } else {
            rest.fill(0.0);
        }
        directions.push(rest);
    }
    let mut weights = vec![0.0; n];
    for j in (0..n).rev() {
        if mixing[j][j] > 0.0 {
            let later: f64 = (j + 1..n).map(|i| mixing[j][i] * weights[i]).sum();
            weights[j] = (along[j] - later) / mixing[j][j];
        }
    }
    Linear { weights, residual }
}

/// Where a fit ended.
#[derive(Debug, Clone)]
pub(super) struct Optimum {
    pub theta: Vec<f64>,
    pub residual: Vec<f64>,
    pub rss: f64,
    /// Derivatives of the residual with respect to each parameter.
    pub jacobian: Vec<Vec<f64>>,
}

const MAX_STEPS: usize = 60;

/// Minimises `‖residual(θ)‖²` from `theta`; `steps` are small against the width of the
/// minimum in each parameter.
pub(super) fn minimise(
    theta: &[f64],
    steps: &[f64],
    residual: &dyn Fn(&[f64]) -> Vec<f64>,
) -> Optimum {
    let mut at = theta.to_vec();
    let mut now = residual(&at);
    let mut rss = dot(&now, &now);
    let mut damping = 1e-3;
    let mut jacobian = jacobian_at(&at, steps, residual);
    for _ in 0..MAX_STEPS {
        let n = at.len();
        let gram: Vec<Vec<f64>> = jacobian
            .iter()
            .map(|a| jacobian.iter().map(|b| dot(a, b)).collect())
            .collect();
        let slope: Vec<f64> = jacobian.iter().map(|a| -dot(a, &now)).collect();
        let mut better = false;
        let mut gain = 0.0;
        while damping < 1e8 {
            let mut damped = gram.clone();
            for i in 0..n {
                damped[i][i] += damping * gram[i][i].max(f64::MIN_POSITIVE);
            }
            let Some(step) = solve_normal(&damped, &slope) else {
                damping *= 10.0;
                continue;
            };
            let next: Vec<f64> = at.iter().zip(&step).map(|(a, s)| a + s).collect();
            let new = residual(&next);
            let new_rss = dot(&new, &new);
            if new_rss < rss {
                gain = 1.0 - new_rss / rss;
                (at, now, rss) = (next, new, new_rss);
                damping = (damping * 0.2).max(1e-9);
                better = true;
                break;
            }
            damping *= 5.0;
        }
        if better {
            jacobian = jacobian_at(&at, steps, residual);
        }
        if !better || gain < 1e-6 {
            break;
        }
    }
    Optimum {
        theta: at,
        residual: now,
        rss,
        jacobian,
    }
}

fn jacobian_at(at: &[f64], steps: &[f64], residual: &dyn Fn(&[f64]) -> Vec<f64>) -> Vec<Vec<f64>> {
    let shifted = |i: usize, by: f64| {
        let mut theta = at.to_vec();
        theta[i] += by;
        residual(&theta)
    };
    (0..at.len())
        .map(|i| {
            let (up, down) = (shifted(i, steps[i]), shifted(i, -steps[i]));
            let half = 0.5 / steps[i];
            up.iter().zip(&down).map(|(u, d)| half * (u - d)).collect()
        })
        .collect()
}

/// Residuals this far apart still count as related: where the model does not hold
/// exactly they are not independent.
const MAX_LAG: usize = 8;

impl Optimum {
    /// Standard error of each parameter, and the factor by which the variance of the
    /// first exceeds that of independent residuals (at least 1).
    ///
    /// `dof` is the number of residuals less that of all parameters. `(JᵀJ)⁻¹σ²` is
    /// the Cramér–Rao bound for the noise that the residual shows; related residuals
    /// raise it (Newey & West, Econometrica 55, 703, 1987). Residuals are related only
    /// within stretches of `run` values.
    pub fn errors(&self, dof: f64, run: usize) -> (Vec<f64>, f64) {
        let n = self.theta.len();
        let variance = self.rss / dof.max(1.0);
        let gram: Vec<Vec<f64>> = self
            .jacobian
            .iter()
            .map(|a| self.jacobian.iter().map(|b| dot(a, b)).collect())
            .collect();
        let mut errors = Vec::new();
        let mut variance_inflation = 1.0f64;
        for i in 0..n {
            let mut unit = vec![0.0; n];
            unit[i] = 1.0;
            let Some(row) = solve_normal(&gram, &unit) else {
                errors.push(f64::INFINITY);
                continue;
            };
            // The estimate moves by `influence · noise`.
            let mut influence = vec![0.0; self.residual.len()];
            for (j, column) in self.jacobian.iter().enumerate() {
                add(&mut influence, row[j], column);
            }
            let independent = row[i].max(0.0) * variance;
            let pulled: Vec<f64> = influence
                .iter()
                .zip(&self.residual)
                .map(|(a, b)| a * b)
                .collect();
            let mut sum = 0.0;
            for part in pulled.chunks(run) {
                for lag in 0..=MAX_LAG.min(part.len() / 4) {
                    let weight = if lag == 0 { 1.0 } else { 2.0 };
                    let taper = 1.0 - lag as f64 / (MAX_LAG + 1) as f64;
                    sum += weight * taper * dot(&part[lag..], &part[..part.len() - lag]);
                }
            }
            sum *= self.residual.len() as f64 / dof.max(1.0);
            let factor = if independent > 0.0 {
                (sum / independent).max(1.0)
            } else {
                1.0
            };
            if i == 0 {
                variance_inflation = factor;
            }
            errors.push((independent * factor).sqrt());
        }
        (errors, variance_inflation)
    }
}

/// Chebyshev polynomials `T_0 … T_degree` over `n` rows.
pub(super) fn polynomials(n: usize, degree: usize) -> Basis {
    let x = |i: usize| {
        if n > 1 {
            2.0 * i as f64 / (n - 1) as f64 - 1.0
        } else {
            0.0
        }
    };
    let mut basis: Basis = vec![vec![1.0; n]];
    for d in 1..=degree {
        let next = (0..n)
            .map(|i| match d {
                1 => x(i),
                _ => 2.0 * x(i) * basis[d - 1][i] - basis[d - 2][i],
            })
            .collect();
        basis.push(next);
    }
    basis
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_of_a_linear_model_are_found() {
        let mut basis = polynomials(40, 3);
        basis.push(basis[1].clone());
        let mut y = vec![0.0; 40];
        for (weight, column) in [3.0, -2.0, 0.5, 7.0].iter().zip(&basis) {
            add(&mut y, *weight, column);
        }
        let fit = linear(&basis, &y);
        for (got, want) in fit.weights.iter().zip([3.0, -2.0, 0.5, 7.0, 0.0]) {
            assert!((got - want).abs() < 1e-10, "{:?}", fit.weights);
        }
        assert!(dot(&fit.residual, &fit.residual) < 1e-20);
    }

    #[test]
    fn a_decay_rate_is_found_beside_its_amplitude() {
        let t: Vec<f64> = (0..50).map(|i| f64::from(i) * 0.1).collect();
        let y: Vec<f64> = t.iter().map(|t| 2.0 * (-0.7 * t).exp() + 1.0).collect();
        let model = |theta: &[f64]| {
            let basis = vec![
                vec![1.0; t.len()],
                t.iter().map(|t| (-theta[0] * t).exp()).collect(),
            ];
            linear(&basis, &y).residual
        };
        let found = minimise(&[2.0], &[1e-5], &model);
        assert!((found.theta[0] - 0.7).abs() < 1e-6, "{:?}", found.theta);
    }
}
