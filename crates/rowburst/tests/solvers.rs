//! The reference solvers, the default one and the certificate, against each other and
//! against answers found by hand.

mod reference;

use reference::fista::{self, FistaParams};
use reference::gpsr_bb::{self, Descent, GpsrParams};
use reference::primal_dual::{self, PrimalDualParams};
use reference::{CertifiedSolution, Certifier, Limits, Objective};
use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::noise::Noise;
use rowburst::prox::{Variation, VariationWeights};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::admm::{self, AdmmParams, Progress, TauRule};
use rowburst::solve::{Certificate, DataTerm, StopReason};
use rowburst::{Camera, Image, RollingShutter, Sensor, Shape, Shutter, Support};
use rowburst_optics::forward::gram::add_gram_block;
use rowburst_solve::blocks::Blocks;
use std::ops::ControlFlow;

const L1: VariationWeights = VariationWeights {
    space: 0.0,
    time: 0.0,
    l1: 1.0,
};
const TV: VariationWeights = VariationWeights {
    space: 1.0,
    time: 0.5,
    l1: 0.0,
};
const ALL: VariationWeights = VariationWeights {
    space: 1.0,
    time: 0.5,
    l1: 0.3,
};

/// `A`, `b` and the blocks of `A Aᵀ`.
struct Data {
    operator: Box<dyn LinearOperator + Send>,
    measurements: Vec<f32>,
    gram: Blocks<f64>,
    scale: f64,
    shape: Shape,
}

impl Data {
    /// A moving digit behind a diffuser, seen by a small dual shutter at SNR 64.
    fn frame() -> Self {
        let (rows, columns) = (24, 20);
        let camera = Camera::new(CameraParams {
            rows,
            columns,
            shutter: Shutter::DualInsideOut,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        })
        .unwrap();
        let optics = SpeckleOptics {
            diffuser_fwhm_deg: 0.3,
            ..SpeckleOptics::demo()
        };
        let psf = speckle_psf(&optics, 2 * rows - 1, 2 * columns - 1, 5).unwrap();
        let shape = camera.video_shape();
        let truth = scene::moving_digit(shape, 8, 1, 3).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut frame);
        let noiseless = Image::new(rows, columns, frame).unwrap();
        let noise = Noise::Gaussian { snr: 64.0 };
        let recorded = noise.apply(&noiseless, camera.sensor(), 7).unwrap();
        let instants = 0..operator.rows_of_instants().len();
        let indices = instants.map(|i| operator.indices_of(i)).collect();
        Self {
            gram: Blocks::new(indices, |i, block: faer::MatMut<f64>| {
                add_gram_block(&operator, i, None, block);
            }),
            scale: operator.pixel_power(rows / 4, columns / 4),
            measurements: recorded.frame.data().to_vec(),
            operator: Box::new(operator),
            shape,
        }
    }

    /// One row of pixels seen by a matrix.
    fn dense(matrix: &[&[f32]], measurements: &[f32]) -> Self {
        let rows: Vec<Vec<f32>> = matrix.iter().map(|row| row.to_vec()).collect();
        let product = |i: usize, j: usize| -> f64 {
            let pairs = rows[i].iter().zip(&rows[j]);
            pairs.map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        let gram = Blocks::new(
            vec![(0..rows.len()).collect()],
            |_, mut block: faer::MatMut<f64>| {
                for i in 0..rows.len() {
                    for j in 0..rows.len() {
                        block[(i, j)] = product(i, j);
                    }
                }
            },
        );
        Self {
            scale: product(0, 0),
            gram,
            measurements: measurements.to_vec(),
            shape: Shape::new(1, 1, rows[0].len()),
            operator: Box::new(Dense(rows)),
        }
    }

    /// `part` of the `τ` above which the `ℓ1` minimum is dark, `max Aᵀb`.
    fn tau(&self, part: f64) -> f64 {
        let mut pull = vec![0.0; self.operator.domain_len()];
        self.operator.adjoint(&self.measurements, &mut pull);
        part * f64::from(pull.iter().copied().fold(0.0, f32::max))
    }

    fn objective(&self, weights: VariationWeights, tau: f64) -> Objective<'_> {
        Objective::new(self, self.shape, weights, tau)
    }

    fn admm(&mut self, weights: VariationWeights, tau: f64, threshold: f64) -> admm::Solution {
        let shape = self.shape;
        let params = AdmmParams {
            threshold,
            support: false,
            max_iterations: 1500,
            tolerance: 1e-6,
            ..AdmmParams::new(TauRule::Fixed(tau))
        };
        let mut prior = Variation::new(shape, weights);
        admm::solve(self, &mut prior, shape, &params, &mut never_stop)
    }
}

struct Dense(Vec<Vec<f32>>);

impl LinearOperator for Dense {
    fn domain_len(&self) -> usize {
        self.0[0].len()
    }
    fn range_len(&self) -> usize {
        self.0.len()
    }
    fn apply(&self, x: &[f32], y: &mut [f32]) {
        for (y, row) in y.iter_mut().zip(&self.0) {
            *y = row.iter().zip(x).map(|(a, x)| a * x).sum();
        }
    }
    fn adjoint(&self, y: &[f32], x: &mut [f32]) {
        x.fill(0.0);
        for (y, row) in y.iter().zip(&self.0) {
            x.iter_mut().zip(row).for_each(|(x, a)| *x += a * y);
        }
    }
}

impl DataTerm for Data {
    fn operator(&self) -> &dyn LinearOperator {
        &*self.operator
    }
    fn measurements(&self) -> &[f32] {
        &self.measurements
    }
    fn measurement_count(&self) -> usize {
        self.measurements.len()
    }
    fn scale(&self) -> f64 {
        self.scale
    }
    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) -> bool {
        self.gram.solve_with_product(r, rho, y, gram_y);
        true
    }
    fn residual_rms_of_bins(&self, _: &[f32]) -> Vec<f64> {
        unreachable!("no support is asked for")
    }
    fn restrict(&mut self, _: &Support) {
        unreachable!("no support is asked for")
    }
}

fn never_stop(_: &Progress) -> ControlFlow<StopReason> {
    ControlFlow::Continue(())
}

/// The reference solvers; GPSR-BB takes `ℓ1` alone.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Solver {
    Gpsr(Descent),
    Fista,
    PrimalDual,
}

const EVERY: [Solver; 4] = [
    Solver::PrimalDual,
    Solver::Fista,
    Solver::Gpsr(Descent::Monotone),
    Solver::Gpsr(Descent::Whole),
];

impl Solver {
    fn solve(
        self,
        objective: &Objective,
        start: Option<&[f32]>,
        limits: Limits,
        observer: &mut dyn FnMut(&Progress) -> ControlFlow<StopReason>,
    ) -> CertifiedSolution {
        match self {
            Self::Gpsr(descent) => {
                let params = GpsrParams {
                    descent,
                    limits,
                    ..GpsrParams::default()
                };
                gpsr_bb::solve(objective, start, &params, observer)
            }
            Self::Fista => {
                let params = FistaParams {
                    limits,
                    // Enough for these small videos.
                    inner_steps: 40,
                    ..FistaParams::default()
                };
                fista::solve(objective, start, &params, observer)
            }
            Self::PrimalDual => {
                let params = PrimalDualParams {
                    limits,
                    ..PrimalDualParams::default()
                };
                primal_dual::solve(objective, start, &params, observer)
            }
        }
    }
}

fn limits(max_iterations: usize, tolerance: f64) -> Limits {
    Limits {
        max_iterations,
        tolerance,
    }
}

/// All solvers that take these weights come to one objective.
fn all_agree(weights: VariationWeights, part: f64, threshold: f64, most: usize) {
    let mut data = Data::frame();
    let tau = data.tau(part);
    let begin = std::time::Instant::now();
    let default = data.admm(weights, tau, threshold);
    let data = data;
    let objective = data.objective(weights, tau);
    // The prior as this module counts it and as the default solver does.
    let ours = objective.value(&default.video);
    assert!((ours - default.certificate.primal).abs() < 1e-5 * ours);
    println!(
        "admm {:?}: {ours:.6e}, {} iterations",
        begin.elapsed(),
        default.iterations
    );
    let mut values = vec![ours];
    let mut bound: f64 = 0.0;
    let solvers = EVERY
        .iter()
        .filter(|s| weights == L1 || !matches!(s, Solver::Gpsr(_)));
    for &solver in solvers {
        let begin = std::time::Instant::now();
        // Its steps with differences are few and dear.
        let most = if solver == Solver::Fista && weights != L1 {
            600
        } else {
            most
        };
        let found = solver.solve(&objective, None, limits(most, 5e-5), &mut never_stop);
        println!(
            "{solver:?} {:?}: {:.6e}, {} iterations; {}",
            begin.elapsed(),
            found.certificate.primal,
            found.iterations,
            found.certificate
        );
        assert!(found.certificate.excess() < 1e-2, "{solver:?}");
        values.push(found.certificate.primal);
        bound = bound.max(found.certificate.dual);
    }
    let best = values.iter().copied().fold(f64::INFINITY, f64::min);
    let worst = values.iter().copied().fold(0.0, f64::max);
    assert!(worst - best < 1e-4 * best, "{values:?}");
    // The default solver's own bound holds, and says about as much as the strict ones.
    let own = default.certificate;
    assert!(
        own.dual <= best * (1.0 + 1e-5) && own.excess() < 1e-2,
        "{own}"
    );
    // ... and that is the minimum.
    assert!(
        best >= bound * (1.0 - 1e-6) && best < bound * (1.0 + 6e-4),
        "{bound}"
    );
}

#[test]
fn all_agree_on_l1() {
    all_agree(L1, 0.1, 0.3, 2000);
}

#[test]
fn all_agree_on_total_variation_and_differences_in_time() {
    all_agree(TV, 0.003, 0.05, 1600);
}

#[test]
fn all_agree_on_the_whole_prior() {
    all_agree(ALL, 0.003, 0.05, 1600);
}

/// By hand: `A = I`, `b = (3, 1)`. A total variation brings the two together by `τ` each, or
/// to their mean; `ℓ1` takes `τ` from each, down to zero.
#[test]
fn two_pixels_by_hand() {
    let tv = VariationWeights {
        space: 1.0,
        time: 0.0,
        l1: 0.0,
    };
    let cases = [
        (tv, 0.5, [3.0, 1.0], [2.5, 1.5]),
        (tv, 2.0, [3.0, 1.0], [2.0, 2.0]),
        (L1, 0.5, [3.0, 1.0], [2.5, 0.5]),
        (L1, 1.5, [3.0, 1.0], [1.5, 0.0]),
        (L1, 0.5, [-1.0, 2.0], [0.0, 1.5]),
    ];
    for (weights, tau, measurements, expected) in cases {
        let data = Data::dense(&[&[1.0, 0.0], &[0.0, 1.0]], &measurements);
        let objective = data.objective(weights, tau);
        for solver in EVERY {
            if weights != L1 && matches!(solver, Solver::Gpsr(_)) {
                continue;
            }
            let found = solver.solve(&objective, None, limits(3000, 1e-7), &mut never_stop);
            for (v, e) in found.video.iter().zip(expected) {
                assert!((v - e).abs() < 2e-3, "{solver:?} {tau}: {:?}", found.video);
            }
            let excess = found.certificate.excess();
            assert!(
                (-1e-6..1e-5).contains(&excess),
                "{solver:?} {tau}: {excess}"
            );
        }
    }
}

/// Three pixels seen by two values: no formula, but few enough to try all.
#[test]
fn three_pixels_by_brute_force() {
    let mut data = Data::dense(&[&[1.0, 0.4, 0.1], &[0.2, 0.7, 0.9]], &[1.5, 1.0]);
    let with_l1 = VariationWeights {
        space: 0.3,
        time: 0.0,
        l1: 1.0,
    };
    for (weights, tau) in [(L1, 0.1), (with_l1, 0.1), (with_l1, 0.4)] {
        let default = data.admm(weights, tau, 0.3);
        let objective = data.objective(weights, tau);
        let best = brute_force(&|v| objective.value(v));
        let check = |name: &str, found: f64| {
            assert!(
                (found - best).abs() < 2e-5 * best,
                "{name} {tau}: {found}, {best}"
            );
        };
        check("default", objective.value(&default.video));
        for solver in EVERY {
            if weights == L1 || !matches!(solver, Solver::Gpsr(_)) {
                let found = solver.solve(&objective, None, limits(5000, 1e-6), &mut never_stop);
                check(&format!("{solver:?}"), found.certificate.primal);
                let dual = found.certificate.dual;
                assert!(
                    dual <= best * (1.0 + 1e-6) && dual > best * (1.0 - 1e-4),
                    "{dual}"
                );
            }
        }
    }
}

/// The least value over `[0, 4]³`: a grid that closes in on its best point.
fn brute_force(value: &dyn Fn(&[f32]) -> f64) -> f64 {
    let (mut centre, mut reach) = ([2.0f32; 3], 2.0f32);
    let mut best = f64::INFINITY;
    for _ in 0..40 {
        let at = |i: usize, c: f32| (c + reach * (i as f32 / 6.0 - 1.0)).max(0.0);
        let around = centre;
        for i in 0..13 * 13 * 13 {
            let v = [
                at(i % 13, around[0]),
                at(i / 13 % 13, around[1]),
                at(i / 169, around[2]),
            ];
            let here = value(&v);
            if here < best {
                (best, centre) = (here, v);
            }
        }
        reach *= 0.7;
    }
    best
}

/// The certificate of an iterate, from its video alone, bounds what is truly missing to the
/// minimum at every stage, and that bound goes to zero.
#[test]
fn the_gap_bounds_the_distance_to_the_minimum_along_every_solver() {
    let data = Data::frame();
    for (weights, part) in [(L1, 0.1), (ALL, 0.003)] {
        let objective = data.objective(weights, data.tau(part));
        let reference = Solver::Fista.solve(&objective, None, limits(400, 1e-4), &mut never_stop);
        let least = reference.certificate.primal;
        for solver in EVERY {
            if weights != L1 && matches!(solver, Solver::Gpsr(_)) {
                continue;
            }
            let mut excesses = Vec::new();
            let stages = [1, 5, 25, 125, 500];
            solver.solve(&objective, None, limits(500, 0.0), &mut |p| {
                if stages.contains(&p.iteration) {
                    let certificate = Certifier::new(&objective).certify(&p.video.get(), 300);
                    let missing = objective.value(&p.video.get()) - least;
                    assert!(certificate.gap() >= missing - 2e-5 * least, "{solver:?}");
                    assert!(certificate.dual <= least * (1.0 + 1e-6), "{solver:?}");
                    excesses.push(certificate.excess());
                }
                never_stop(p)
            });
            println!("{solver:?} {excesses:?}");
            assert_eq!(excesses.len(), stages.len());
            assert!(
                excesses[4] < 0.05 && excesses[4] < 0.2 * excesses[1],
                "{solver:?}"
            );
        }
    }
}

#[test]
fn gpsr_descends_in_every_step() {
    let data = Data::frame();
    let objective = data.objective(L1, data.tau(0.03));
    let mut last = objective.value(&vec![0.0; data.shape.voxels()]);
    let mut worst: f64 = 0.0;
    let found =
        Solver::Gpsr(Descent::Monotone).solve(&objective, None, limits(400, 0.0), &mut |p| {
            let now = objective.value(&p.video.get());
            worst = worst.max(now / last - 1.0);
            last = now;
            never_stop(p)
        });
    assert_eq!(found.iterations, 400);
    assert!(worst < 1e-6, "rises by {worst}");
}

/// A reference solver that starts from what the default one found certifies it.
#[test]
fn the_result_of_another_solver_is_certified() {
    let mut data = Data::frame();
    let tau = data.tau(0.003);
    let default = data.admm(TV, tau, 0.05);
    let objective = data.objective(TV, tau);
    let primal = objective.value(&default.video);
    let alone = Certifier::new(&objective).certify(&default.video, 500);
    let found = Solver::Fista.solve(
        &objective,
        Some(&default.video),
        limits(100, 1e-4),
        &mut never_stop,
    );
    let certificate = Certificate {
        primal,
        dual: found.certificate.dual,
    };
    println!("alone: {alone}; after FISTA: {certificate}");
    assert!((0.0..2e-2).contains(&alone.excess()), "{alone}");
    assert!((0.0..1e-3).contains(&certificate.excess()), "{certificate}");
}

#[test]
fn a_warm_start_is_a_start_from_there() {
    let data = Data::frame();
    let objective = data.objective(L1, data.tau(0.2));
    for solver in EVERY {
        let found = solver.solve(&objective, None, limits(4000, 3e-4), &mut never_stop);
        assert_eq!(
            found.stop_reason,
            StopReason::Converged,
            "{solver:?} {}",
            found.certificate
        );
        let again = solver.solve(
            &objective,
            Some(&found.video),
            limits(4000, 3e-4),
            &mut never_stop,
        );
        println!("{solver:?} {} {}", found.iterations, again.iterations);
        assert!(again.iterations < found.iterations / 2, "{solver:?}");
    }
}

/// A frame times 1000 at `τ` times 1000 gives a video times 1000 after as many iterations.
#[test]
fn nothing_depends_on_the_units_of_the_frame() {
    let data = Data::frame();
    let mut scaled = Data::frame();
    scaled.measurements.iter_mut().for_each(|b| *b *= 1024.0);
    for (weights, part) in [(L1, 0.1), (ALL, 0.003)] {
        let tau = data.tau(part);
        let (one, other) = (
            data.objective(weights, tau),
            scaled.objective(weights, 1024.0 * tau),
        );
        for solver in EVERY {
            if weights == L1 || !matches!(solver, Solver::Gpsr(_)) {
                let a = solver.solve(&one, None, limits(60, 0.0), &mut never_stop);
                let b = solver.solve(&other, None, limits(60, 0.0), &mut never_stop);
                let expected: Vec<f32> = a.video.iter().map(|v| 1024.0 * v).collect();
                let error = rowburst::vecmath::distance_squared(&b.video, &expected).sqrt();
                assert!(
                    error < 1e-4 * rowburst::vecmath::norm(&expected),
                    "{solver:?}"
                );
            }
        }
    }
}

#[test]
fn an_observer_stops_every_solver() {
    let data = Data::frame();
    let objective = data.objective(L1, data.tau(0.1));
    for solver in EVERY {
        let found = solver.solve(&objective, None, Limits::default(), &mut |p| {
            assert!(p.objective.is_finite() && p.residual_rms > 0.0);
            match p.iteration {
                7 => ControlFlow::Break(StopReason::TimeBudget),
                _ => ControlFlow::Continue(()),
            }
        });
        assert_eq!(
            (found.iterations, found.stop_reason),
            (7, StopReason::TimeBudget)
        );
    }
}

/// Above `max Aᵀb` darkness is the minimum, and its certificate says so without an error.
#[test]
fn darkness_is_certified_where_it_is_the_answer() {
    let data = Data::frame();
    let objective = data.objective(L1, data.tau(1.001));
    let dark = vec![0.0; data.shape.voxels()];
    let certificate = Certifier::new(&objective).certify(&dark, 0);
    assert!(certificate.excess().abs() < 1e-6, "{certificate:?}");
    let text = certificate.to_string();
    assert_eq!(text, "the objective is within 0.001 % of its minimum");
    for solver in EVERY {
        let found = solver.solve(&objective, None, Limits::default(), &mut never_stop);
        assert_eq!(found.iterations, 1, "{solver:?}");
    }
}
