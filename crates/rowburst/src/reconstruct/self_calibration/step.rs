//! A Gauss–Newton step in the parameters, with the brightness of the active voxels marginalised.
//!
//! The video is known only to within errors that a wrong model has caused. So the brightness of each active voxel is given
//! a Gaussian prior of standard deviation `a`, and the residual `r = W(b − A v)` has the covariance
//!
//! ```text
//! K = σ² I + a² B Bᵀ,    B = W A on the active voxels
//! ```
//!
//! The step `δ` of the parameters `θ` with priors of variance `Λ⁻¹` solves
//!
//! ```text
//! (Jᵀ K⁻¹ J + Λ) δ = Jᵀ K⁻¹ r − Λ θ,    J = ∂r/∂θ with the opposite sign
//! ```
//!
//! Several frames are a sum: of `Jᵀ K⁻¹ J`, and of `Jᵀ K⁻¹ r`. It is variable projection (Golub & Pereyra, SIAM J. Numer. Anal. 10, 413, 1973) on the active voxels, with a prior.

use super::calibrator::{Calibrator, Correction, Trial};
use super::parameters::ModelParameter;
use faer::linalg::solvers::Solve;
use faer::{Mat, Side};
use rowburst_core::Support;
use rowburst_optics::RollingShutter;
use rowburst_solve::DataTerm;
use rowburst_solve::admm::brightness;
use tracing::debug;

/// Threshold of an active voxel over the brightness; larger leaves voxels out whose light then counts as an error.
const THRESHOLD: f64 = 0.05;
/// Standard deviation `a` over the brightness; smaller trusts a wrong video.
const AMPLITUDE: f64 = 0.3;
/// Largest `σ²/a²` that is solved for: above it, as where the video is dark, `σ² K⁻¹` is one.
const MAX_RHO: f64 = 1e12;
/// Largest step over the width of a parameter's prior; larger leaves the range where the model is linear.
const MAX_STEP: f64 = 1.5;
/// Standard deviation of the stray light of a row, over the mean of the frame.
const ROW_OFFSET: f64 = 0.01;
/// Updates with the same derivatives; more cost little, and gain nothing once the parameters are found.
const UPDATES: usize = 2;
/// Least part of the measurements that the active voxels leave over.
const MIN_REMAINDER: f64 = 0.2;

/// The parameters that a step changes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Free<'a> {
    pub parameters: &'a [ModelParameter],
    /// Whether each row has an offset of its own.
    pub has_row_offsets: bool,
}

/// What a step found.
pub(super) struct StepReport {
    /// Standard error of each free parameter.
    pub standard_errors: Vec<f64>,
    /// Noise level that explains what the step leaves of the residual, in counts.
    pub remaining_sigma: f64,
}

/// `K⁻¹` of a trial.
pub(super) struct Marginal<'t> {
    pub trial: &'t mut Trial,
    /// `σ²/a²`.
    rho: f64,
}

impl<'t> Marginal<'t> {
    /// `K` at the noise level `sigma`; `amplitude` is `a` over the brightness.
    pub fn new(trial: &'t mut Trial, sigma: f64, amplitude: f64) -> Self {
        let shape = trial.data.shape();
        let threshold = THRESHOLD * brightness(&trial.video);
        let support = Support::above(&trial.video, shape, &vec![threshold; shape.bins]);
        trial.data.restrict(&support);
        let amplitude = amplitude / THRESHOLD * threshold;
        Self {
            trial,
            rho: (sigma / amplitude.max(f64::MIN_POSITIVE)).powi(2),
        }
    }

    /// `σ² K⁻¹ z` for a weighted `z`.
    pub fn solve(&mut self, z: &[f32]) -> Vec<f64> {
        if self.rho > MAX_RHO {
            return z.iter().map(|&z| f64::from(z)).collect();
        }
        let mut y = self.trial.data.solve_alone(z, self.rho);
        y.iter_mut().for_each(|y| *y *= self.rho);
        y
    }
}

/// Changes the `free` parameters of `correction` towards the frames; `trials` are the reconstructions under it at the noise
/// level `sigma`. The derivatives serve all of [`UPDATES`]; what they leave is computed anew before each.
pub(super) fn step(
    calibrator: &mut Calibrator,
    correction: &mut Correction,
    trials: &mut [Trial],
    sigma: f64,
    free: Free,
) -> StepReport {
    let jacobians: Vec<Jacobian> = trials
        .iter()
        .map(|trial| Jacobian::new(calibrator, correction, trial, free))
        .collect();
    let variance = sigma * sigma;
    let mut parts: Vec<(Marginal, SolvedJacobian)> = trials
        .iter_mut()
        .zip(&jacobians)
        .map(|(trial, jacobian)| {
            let mut marginal = Marginal::new(trial, sigma, AMPLITUDE);
            let solved = SolvedJacobian::new(jacobian, &mut marginal);
            (marginal, solved)
        })
        .collect();
    let (count, row_count) = (jacobians[0].columns.len(), jacobians[0].row_count());
    let row_width = ROW_OFFSET * calibrator.mean();
    let widths = free.parameters.iter().map(|p| p.prior_width());
    let widths: Vec<f64> = widths
        .chain(std::iter::repeat_n(row_width, row_count))
        .collect();
    let normal = parts.iter().fold(
        Mat::from_fn(widths.len(), widths.len(), |i, j| {
            if i == j { widths[i].powi(-2) } else { 0.0 }
        }),
        |sum, (_, solved)| sum + solved.products(variance),
    );
    let factor = normal.llt(Side::Lower).ok();
    let mut report = StepReport {
        standard_errors: vec![f64::INFINITY; count],
        remaining_sigma: f64::INFINITY,
    };
    for _ in 0..UPDATES {
        let mut unexplained: Vec<Vec<f64>> = parts
            .iter_mut()
            .map(|(marginal, _)| {
                let residual = calibrator.residual(correction, marginal.trial);
                marginal.solve(&residual)
            })
            .collect();
        if let Some(factor) = factor.as_ref().filter(|_| !widths.is_empty()) {
            let values = free.parameters.iter().map(|&p| correction.parameters[p]);
            let values = values.chain(correction.row_offsets[..row_count].iter().copied());
            let values: Vec<f64> = values.collect();
            let mut right = Mat::from_fn(widths.len(), 1, |i, _| -values[i] * widths[i].powi(-2));
            for (jacobian, unexplained) in jacobians.iter().zip(&unexplained) {
                right += jacobian.project(unexplained, variance);
            }
            let change = factor.solve(&right);
            for ((_, solved), unexplained) in parts.iter().zip(&mut unexplained) {
                solved.subtract(&change, unexplained);
            }
            let largest = (0..count)
                .map(|i| change[(i, 0)].abs() / (MAX_STEP * widths[i]))
                .fold(1.0, f64::max);
            for (i, &parameter) in free.parameters.iter().enumerate() {
                let change = change[(i, 0)] / largest;
                correction
                    .parameters
                    .add(parameter, change, calibrator.camera());
            }
            for row in 0..row_count {
                correction.row_offsets[row] += change[(count + row, 0)] / largest;
            }
            let covariance = factor.solve(Mat::<f64>::identity(widths.len(), widths.len()));
            report.standard_errors = (0..count)
                .map(|i| covariance[(i, i)].max(0.0).sqrt())
                .collect();
        }
        report.remaining_sigma = remaining_sigma(&mut parts, &unexplained);
    }
    correction.parameters.drop_negligible_timing();
    debug!("self-calibration: {}", correction.parameters);
    report
}

/// `J`, weighted: a column for each free parameter, and those of the offsets of the rows.
pub(super) struct Jacobian {
    columns: Vec<Vec<f32>>,
    rows: Option<RowColumns>,
}

impl Jacobian {
    /// `J` of a trial under `correction`.
    pub fn new(
        calibrator: &mut Calibrator,
        correction: &Correction,
        trial: &Trial,
        free: Free,
    ) -> Self {
        let light = trial.data.light(&trial.video);
        let map = calibrator.psf_map(trial);
        let mut column = |&parameter: &ModelParameter| {
            let column = calibrator.derivative(correction, parameter, trial, map.as_ref(), &light);
            trial.data.weigh(&column)
        };
        let columns = free.parameters.iter().map(&mut column).collect();
        let unit = || trial.data.weigh(&calibrator.offset_derivative(correction));
        Self {
            columns,
            rows: if free.has_row_offsets {
                RowColumns::new(trial.data.shutter(), unit())
            } else {
                None
            },
        }
    }

    /// The column of each free parameter.
    pub fn columns(&self) -> &[Vec<f32>] {
        &self.columns
    }

    /// Number of rows with an offset of their own.
    fn row_count(&self) -> usize {
        self.rows.as_ref().map_or(0, |rows| rows.place.len())
    }

    /// `Jᵀ z` over `variance`.
    fn project(&self, z: &[f64], variance: f64) -> Mat<f64> {
        let columns = self.columns.len();
        Mat::from_fn(columns + self.row_count(), 1, |i, _| {
            let product = match (i.checked_sub(columns), &self.rows) {
                (Some(row), Some(rows)) => rows.dot(row, z),
                _ => dot(&self.columns[i], z),
            };
            product / variance
        })
    }
}

/// `σ² K⁻¹ J`.
struct SolvedJacobian<'j> {
    jacobian: &'j Jacobian,
    columns: Vec<Vec<f64>>,
    rows: Option<SolvedRows<'j>>,
}

impl<'j> SolvedJacobian<'j> {
    fn new(jacobian: &'j Jacobian, marginal: &mut Marginal) -> Self {
        let columns = jacobian.columns.iter();
        Self {
            columns: columns.map(|column| marginal.solve(column)).collect(),
            rows: jacobian.rows.as_ref().map(|rows| rows.solve(marginal)),
            jacobian,
        }
    }

    /// `Jᵀ σ² K⁻¹ J` over `variance`.
    fn products(&self, variance: f64) -> Mat<f64> {
        let columns = self.columns.len();
        let size = columns + self.jacobian.row_count();
        let mut products = Mat::<f64>::zeros(size, size);
        for (j, column) in self.columns.iter().enumerate() {
            let projected = self.jacobian.project(column, variance);
            for i in 0..size {
                products[(i, j)] = projected[(i, 0)];
                products[(j, i)] = projected[(i, 0)];
            }
        }
        if let (Some(rows), Some(solved)) = (&self.jacobian.rows, &self.rows) {
            for row in 0..self.jacobian.row_count() {
                for &other in rows.partners(row) {
                    products[(columns + row, columns + other)] =
                        rows.dot(row, solved.of(other)) / variance;
                }
            }
        }
        products
    }

    /// `z −= σ² K⁻¹ J change`.
    fn subtract(&self, change: &Mat<f64>, z: &mut [f64]) {
        for (j, column) in self.columns.iter().enumerate() {
            let pairs = z.iter_mut().zip(column);
            pairs.for_each(|(z, c)| *z -= change[(j, 0)] * c);
        }
        if let (Some(rows), Some(solved)) = (&self.jacobian.rows, &self.rows) {
            for row in 0..self.jacobian.row_count() {
                rows.subtract(row, change[(self.columns.len() + row, 0)], solved, z);
            }
        }
    }
}

/// The noise level of `unexplained`, the residual that active voxels and parameters leave over, for each measurement that
/// is left over. The number of these, `σ² tr K⁻¹`, is estimated with a random vector (Hutchinson, Commun. Stat. 19, 433,
/// 1990).
fn remaining_sigma(parts: &mut [(Marginal, SolvedJacobian)], unexplained: &[Vec<f64>]) -> f64 {
    let sign = |i: usize| {
        let hash = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
        if hash & 1 == 0 { 1.0 } else { -1.0 }
    };
    let (mut power, mut remainder) = (0.0, 0.0);
    for ((marginal, _), unexplained) in parts.iter_mut().zip(unexplained) {
        let usable = marginal.trial.data.usable();
        let probe: Vec<f32> = (0..usable.len())
            .map(|i| if usable[i] { sign(i) } else { 0.0 })
            .collect();
        let solved = marginal.solve(&probe);
        let count = usable.iter().filter(|u| **u).count() as f64;
        remainder += dot(&probe, &solved).clamp(MIN_REMAINDER * count, count);
        let usable_values = unexplained.iter().zip(&usable).filter(|(_, u)| **u);
        power += usable_values.map(|(e, _)| e * e).sum::<f64>();
    }
    (power / remainder).sqrt()
}

fn dot(a: &[f32], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * b).sum()
}

/// The columns of `J` that belong to the offsets of the rows: each is `unit` on its row. Where no bin is seen by two
/// instants, the rows of different instants do not disturb each other, so one solve serves a row of every instant.
struct RowColumns {
    unit: Vec<f32>,
    columns: usize,
    /// The rows of each instant.
    instants: Vec<Vec<usize>>,
    /// Instant of each row, and its place there.
    place: Vec<(usize, usize)>,
}

/// `σ² K⁻¹` of the columns, one vector for the rows at one place of all instants.
struct SolvedRows<'r> {
    rows: &'r RowColumns,
    positions: Vec<Vec<f64>>,
}

impl RowColumns {
    /// `None` where exposures are longer than a row: the rows of all instants are then coupled.
    fn new(shutter: &RollingShutter, unit: Vec<f32>) -> Option<Self> {
        if !shutter.time().is_disjoint() {
            return None;
        }
        let (rows, columns) = shutter.frame_shape();
        let mut place = vec![(0, 0); rows];
        let instants: Vec<Vec<usize>> = (0..shutter.rows_of_instants().len())
            .map(|i| {
                let pixels = shutter.indices_of(i);
                pixels
                    .chunks(columns)
                    .map(|line| line[0] / columns)
                    .collect()
            })
            .collect();
        for (i, rows) in instants.iter().enumerate() {
            for (k, &row) in rows.iter().enumerate() {
                place[row] = (i, k);
            }
        }
        Some(Self {
            unit,
            columns,
            instants,
            place,
        })
    }

    fn pixels(&self, row: usize) -> std::ops::Range<usize> {
        row * self.columns..(row + 1) * self.columns
    }

    /// The rows that are read at the same instant.
    fn partners(&self, row: usize) -> &[usize] {
        &self.instants[self.place[row].0]
    }

    fn dot(&self, row: usize, values: &[f64]) -> f64 {
        let pixels = self.pixels(row);
        dot(&self.unit[pixels.clone()], &values[pixels])
    }

    fn solve(&self, marginal: &mut Marginal) -> SolvedRows<'_> {
        let most = self.instants.iter().map(Vec::len).max().unwrap_or(0);
        let probe = |place: usize| {
            let mut probe = vec![0.0; self.unit.len()];
            for row in self.instants.iter().filter_map(|rows| rows.get(place)) {
                let pixels = self.pixels(*row);
                probe[pixels.clone()].copy_from_slice(&self.unit[pixels]);
            }
            probe
        };
        SolvedRows {
            rows: self,
            positions: (0..most)
                .map(|place| marginal.solve(&probe(place)))
                .collect(),
        }
    }

    /// `values −= factor · σ² K⁻¹` of the column of `row`.
    fn subtract(&self, row: usize, factor: f64, solved: &SolvedRows, values: &mut [f64]) {
        let column = solved.of(row);
        for &partner in self.partners(row) {
            for at in self.pixels(partner) {
                values[at] -= factor * column[at];
            }
        }
    }
}

impl SolvedRows<'_> {
    /// `σ² K⁻¹` of the column of `row`, at the pixels of its instant.
    fn of(&self, row: usize) -> &[f64] {
        &self.positions[self.rows.place[row].1]
    }
}
