//! The reference solvers, the default one and the certificate, against each other and
//! against answers found by hand.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::noise::Noise;
use rowburst::prox::{Variation, VariationWeights};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::solve::admm::{self, AdmmParams, Progress, TauRule};
use rowburst::solve::blocks::Blocks;
use rowburst::solve::fista::{self, FistaParams};
use rowburst::solve::gpsr_bb::{self, Descent, GpsrParams};
use rowburst::solve::primal_dual::{self, PrimalDualParams};
use rowburst::solve::{
    Certified, Certifier, DataTerm, GramSolver, Limits, Objective, StopReason,
};
use rowburst::{Camera, Image, RollingShutter, Sensor, Shape, Shutter, Support};
use std::ops::ControlFlow;

const L1: VariationWeights = VariationWeights { space: 0.0, time: 0.0, l1: 1.0 };
const TV: VariationWeights = VariationWeights { space: 1.0, time: 0.5, l1: 0.0 };
const ALL: VariationWeights = VariationWeights { space: 1.0, time: 0.5, l1: 0.3 };

/// A moving digit behind a diffuser, seen by a small dual shutter.
struct Frame {
    operator: RollingShutter,
    measured: Vec<f32>,
    gram: Blocks,
}

impl Frame {
    fn new() -> Self {
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
        let optics = SpeckleOptics { diffuser_fwhm_deg: 0.3, ..SpeckleOptics::demo() };
        let psf = speckle_psf(&optics, 2 * rows - 1, 2 * columns - 1, 5).unwrap();
        let truth = scene::moving_digit(camera.video_shape(), 8, 1, 3).unwrap();
        let operator = RollingShutter::new(&camera, &psf);
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut frame);
        let noiseless = Image::new(rows, columns, frame).unwrap();
        let noise = Noise::Gaussian { snr: 64.0 };
        let recorded = noise.apply(&noiseless, camera.sensor(), 7).unwrap();
        let instants = 0..operator.rows_of_instants().len();
        let indices = instants.map(|i| operator.indices_of(i)).collect();
        let gram = Blocks::new(indices, |i, block| operator.add_gram_block(i, None, block));
        Self { measured: recorded.frame.data().to_vec(), operator, gram }
    }

    fn shape(&self) -> Shape {
        self.operator.video_shape()
    }

    /// `part` of the `τ` above which the `ℓ1` minimum is dark, `max Aᵀb`.
    fn tau(&self, part: f64) -> f64 {
        let mut pull = vec![0.0; self.operator.domain_len()];
        self.operator.adjoint(&self.measured, &mut pull);
        part * f64::from(pull.iter().copied().fold(0.0, f32::max))
    }
}

impl DataTerm for Frame {
    fn operator(&self) -> &dyn LinearOperator {
        &self.operator
    }
    fn measured(&self) -> &[f32] {
        &self.measured
    }
    fn informative(&self) -> usize {
        self.measured.len()
    }
    fn scale(&self) -> f64 {
        let (rows, columns) = self.operator.frame_shape();
        self.operator.pixel_power(rows / 4, columns / 4)
    }
    fn solve_gram(&mut self, r: &[f32], rho: f64, y: &mut [f32], gram_y: &mut [f32]) {
        GramSolver::solve(&mut self.gram, r, rho, y, gram_y);
    }
    fn misfit_of_bins(&self, _: &[f32]) -> Vec<f64> {
        unreachable!("no support is asked for")
    }
    fn restrict(&mut self, _: &Support) {
        unreachable!("no support is asked for")
    }
}

fn go_on(_: &Progress) -> ControlFlow<StopReason> {
    ControlFlow::Continue(())
}

#[test]
fn explore() {
    let mut frame = Frame::new();
    let shape = frame.shape();
    for (name, weights, part) in [("l1", L1, 0.1), ("l1", L1, 0.03), ("tv", TV, 0.01), ("tv", TV, 0.03), ("all", ALL, 0.03)] {
        let tau = frame.tau(part);
        println!("--- {name} {part}");
        let mut prior = Variation::new(shape, weights);
        let mut params = AdmmParams::new(TauRule::Fixed(tau));
        params.support = false;
        params.threshold = 0.05;
        params.tolerance = 1e-6;
        params.max_iterations = 1000;
        let begin = std::time::Instant::now();
        let found = admm::solve(&mut frame, &mut prior, shape, &params, &mut go_on);
        let objective = Objective::new(&frame, shape, weights, tau).unwrap();
        let t = begin.elapsed().as_secs_f64();
        let c = Certifier::new(&objective).certify(&found.video, 500);
        println!("admm {:.8e} {:.8e} its {} {:.2}s gap {:.1e} {:.2}s", found.objective, c.primal, found.iterations, t, c.excess(), begin.elapsed().as_secs_f64());
        let limits = Limits { max_iterations: 10000, tolerance: 3e-5 };
        let show = |name: &str, begin: std::time::Instant, f: &Certified| {
            println!("{name} {:.8e} dual {:.8e} its {} {:.2}s excess {:.1e} {:?}", f.certificate.primal, f.certificate.dual, f.iterations, begin.elapsed().as_secs_f64(), f.certificate.excess(), f.stop_reason);
        };
        let begin = std::time::Instant::now();
        let f = primal_dual::solve(&objective, Some(&found.video), &PrimalDualParams { limits, ..Default::default() }, &mut go_on);
        show("pd from admm", begin, &f);
        let begin = std::time::Instant::now();
        let f = primal_dual::solve(&objective, None, &PrimalDualParams { limits, ..Default::default() }, &mut go_on);
        show("pd", begin, &f);
        if weights == L1 {
            for descent in [Descent::Monotone, Descent::Whole] {
                let begin = std::time::Instant::now();
                let f = gpsr_bb::solve(&objective, None, &GpsrParams { descent, limits, ..Default::default() }, &mut go_on).unwrap();
                show(&format!("gpsr {descent:?}"), begin, &f);
            }
            let f = fista::solve(&objective, None, &FistaParams { limits, ..Default::default() }, &mut go_on);
            show("fista", begin, &f);
        } else {
            for (inner_tolerance, inner_steps) in [(0.1, 20), (0.3, 100), (1.0, 100), (3.0, 100)] {
            let limits = Limits { max_iterations: 3000, tolerance: 3e-5 };
        let begin = std::time::Instant::now();
        let f = fista::solve(&objective, None, &FistaParams { limits, inner_tolerance, inner_steps }, &mut go_on);
        show(&format!("fista {inner_tolerance} {inner_steps}"), begin, &f);
        }}
    }
}
