//! A Gaussian estimate `v ~ N(0, K)` from `b = A v + noise` of width 1.
//!
//! ```text
//! K = L Lᵀ,  P = I + Lᵀ Aᵀ A L = F Fᵀ
//! E v = L P⁻¹ Lᵀ Aᵀ b,   cov v = L P⁻¹ Lᵀ
//! ```
//!
//! Of the size of the voxels, and never singular: what the data leave open is as uncertain as
//! the prior has it.

use faer::linalg::triangular_solve::{
    solve_lower_triangular_in_place, solve_upper_triangular_in_place,
};
use faer::{Mat, Par, Side};

/// The data's say on a set of voxels: `Aᵀ A` and `Aᵀ b`, both for noise of width 1.
pub(super) struct Information {
    pub gram: Mat<f64>,
    pub projected: Mat<f64>,
}

/// How likely data are for each amplitude of a prior.
pub(super) trait Evidence: Send + Sync {
    /// Minus the logarithm of how likely the prior `amplitude² K` makes the data, up to a constant (Rasmussen & Williams,
    /// eq. 5.8); `None` where rounding made it unknown.
    fn negative_log_evidence(&self, amplitude: f64) -> Option<f64>;
}

/// `Lᵀ Aᵀ A L` and `Lᵀ Aᵀ b` of a prior; its amplitude is still open.
pub(super) struct WhitenedSystem {
    root: Mat<f64>,
    gram: Mat<f64>,
    projected: Mat<f64>,
}

impl WhitenedSystem {
    /// `None` where `K` is not positive definite.
    pub fn new(information: &Information, covariance: &Mat<f64>) -> Option<Self> {
        let root = covariance.llt(Side::Lower).ok()?.L().to_owned();
        let half = &information.gram * &root;
        Some(Self {
            gram: root.transpose() * half,
            projected: root.transpose() * &information.projected,
            root,
        })
    }

    /// The estimate for the prior `amplitude² K`, and [`Evidence::negative_log_evidence`].
    pub fn estimate(self, amplitude: f64) -> Option<(Posterior, f64)> {
        let (factor, solved, evidence) = self.factorise(amplitude)?;
        let mean = &self.root * solved * faer::Scale(amplitude);
        let posterior = Posterior {
            root: self.root * faer::Scale(amplitude),
            factor,
            mean,
        };
        Some((posterior, evidence))
    }

    fn factorise(&self, amplitude: f64) -> Option<(Mat<f64>, Mat<f64>, f64)> {
        let size = self.gram.nrows();
        let mut p = Mat::from_fn(size, size, |i, j| {
            f64::from(u8::from(i == j)) + amplitude * amplitude * self.gram[(i, j)]
        });
        p = p.llt(Side::Lower).ok()?.L().to_owned();
        let mut solved = &self.projected * faer::Scale(amplitude);
        solve_lower_triangular_in_place(p.as_ref(), solved.as_mut(), Par::Seq);
        let gain: f64 = (0..size).map(|i| solved[(i, 0)].powi(2)).sum();
        let determinant: f64 = (0..size).map(|i| p[(i, i)].ln()).sum();
        solve_upper_triangular_in_place(p.transpose(), solved.as_mut(), Par::Seq);
        Some((p, solved, determinant - 0.5 * gain))
    }
}

impl Evidence for WhitenedSystem {
    fn negative_log_evidence(&self, amplitude: f64) -> Option<f64> {
        self.factorise(amplitude).map(|(_, _, evidence)| evidence)
    }
}

/// Mean and covariance of a set of voxels.
pub(super) struct Posterior {
    /// `a L`.
    root: Mat<f64>,
    /// `F`.
    factor: Mat<f64>,
    mean: Mat<f64>,
}

impl Posterior {
    /// `E v`.
    pub fn mean(&self) -> &Mat<f64> {
        &self.mean
    }

    /// Variance of `cᵀ v`.
    pub fn variance(&self, c: &[f64]) -> f64 {
        let column = Mat::from_fn(c.len(), 1, |i, _| c[i]);
        let half = self.half(&column);
        (0..c.len()).map(|i| half[(i, 0)].powi(2)).sum()
    }

    /// `cov(v) c`.
    pub fn covariance_with(&self, c: &[f64]) -> Mat<f64> {
        let column = Mat::from_fn(c.len(), 1, |i, _| c[i]);
        let mut half = self.half(&column);
        solve_upper_triangular_in_place(self.factor.transpose(), half.as_mut(), Par::Seq);
        &self.root * half
    }

    /// `H = F⁻¹ Lᵀ X`, with which `Xᵀ cov(v) X = Hᵀ H`.
    pub fn half(&self, x: &Mat<f64>) -> Mat<f64> {
        let mut half = self.root.transpose() * x;
        solve_lower_triangular_in_place(self.factor.as_ref(), half.as_mut(), Par::Seq);
        half
    }

    /// Values that the data have chosen: `tr(I − P⁻¹)`.
    pub fn effective_dof(&self) -> f64 {
        let size = self.factor.nrows();
        let mut inverse = Mat::<f64>::identity(size, size);
        solve_lower_triangular_in_place(self.factor.as_ref(), inverse.as_mut(), Par::Seq);
        size as f64 - inverse.squared_norm_l2()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem() -> (Mat<f64>, Mat<f64>, Mat<f64>) {
        let a = Mat::from_fn(5, 3, |i, j| ((i * 3 + j) as f64 * 0.7).sin());
        let b = Mat::from_fn(5, 1, |i, _| (i as f64).cos());
        let k = Mat::from_fn(3, 3, |i, j| (-(i.abs_diff(j) as f64)).exp());
        (a, b, k)
    }

    /// Against the textbook's form, `K Aᵀ (A K Aᵀ + I)⁻¹`.
    #[test]
    fn mean_covariance_and_evidence_agree_with_another_form() {
        let (a, b, k) = problem();
        let information = Information {
            gram: a.transpose() * &a,
            projected: a.transpose() * &b,
        };
        let whitened = WhitenedSystem::new(&information, &k).unwrap();
        let (posterior, evidence) = whitened.estimate(1.3).unwrap();
        let k = k * faer::Scale(1.69);
        let m = &a * &k * a.transpose() + Mat::<f64>::identity(5, 5);
        let m = m.llt(Side::Lower).unwrap();
        use faer::linalg::solvers::Solve;
        let mean = &k * a.transpose() * m.solve(&b);
        let covariance = &k - &k * a.transpose() * m.solve(&a * &k);
        assert!((&mean - posterior.mean()).norm_l2() < 1e-12);
        let c = [0.2, -1.0, 0.5];
        let wanted: f64 = (0..9)
            .map(|n| c[n / 3] * covariance[(n / 3, n % 3)] * c[n % 3])
            .sum();
        assert!((posterior.variance(&c) - wanted).abs() < 1e-12);
        let with = posterior.covariance_with(&c);
        let again: f64 = (0..3).map(|i| c[i] * with[(i, 0)]).sum();
        assert!((again - wanted).abs() < 1e-12);
        let bmb = (b.transpose() * m.solve(&b))[(0, 0)];
        let determinant: f64 = (0..5).map(|i| m.L()[(i, i)].ln()).sum();
        let bb = (b.transpose() * &b)[(0, 0)];
        assert!((evidence - (determinant + 0.5 * (bmb - bb))).abs() < 1e-12);
        let hat = (&a * &k * a.transpose()) * m.solve(Mat::<f64>::identity(5, 5));
        let effective_dof: f64 = (0..5).map(|i| hat[(i, i)]).sum();
        assert!((posterior.effective_dof() - effective_dof).abs() < 1e-12);
    }

    #[test]
    fn what_the_data_do_not_see_stays_as_the_prior_has_it() {
        let information = Information {
            gram: Mat::zeros(2, 2),
            projected: Mat::zeros(2, 1),
        };
        let k = Mat::from_fn(2, 2, |i, j| if i == j { 4.0 } else { 1.0 });
        let (posterior, _) = WhitenedSystem::new(&information, &k)
            .unwrap()
            .estimate(0.5)
            .unwrap();
        assert!((posterior.variance(&[1.0, 0.0]) - 1.0).abs() < 1e-12);
        assert!((posterior.variance(&[1.0, 1.0]) - 2.5).abs() < 1e-12);
        assert_eq!(posterior.mean()[(0, 0)], 0.0);
    }
}
