//! What set-up and an iteration cost, in forward plus adjoint of the same run, and how many
//! iterations a picture takes: `cargo bench --workspace --bench solver`. Four scenes of 108×108×54
//! at SNR 256 with the standard prior.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Options, Prior, Problem};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shape, Shutter, Video};
use std::hint::black_box;
use std::ops::ControlFlow;
use std::time::Instant;

const SIDE: usize = 108;
/// Runs that are timed.
const TIMED: usize = 7;
/// Iterations whose cost counts: before the video is restricted to its support, and after.
const UNRESTRICTED: std::ops::Range<usize> = 5..19;

fn scenes(shape: Shape) -> Vec<(&'static str, Video)> {
    let of = |video: rowburst::Result<Video>| video.expect("the scene fits");
    vec![
        ("digits, 12 px", of(scene::digits(shape, 12, 1))),
        ("digits, 18 px", of(scene::digits(shape, 18, 1))),
        (
            "three LEDs",
            of(scene::leds(shape, 9.6, 6.5, 1).map(|s| s.0)),
        ),
        ("moving digit", of(scene::moving_digit(shape, 12, 1, 1))),
    ]
}

/// The camera of the bench.
fn camera() -> Camera {
    Camera::new(CameraParams {
        rows: SIDE,
        columns: SIDE,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .expect("a valid camera")
}

/// The noisy frame of `truth`.
fn measure(operator: &RollingShutter, camera: &Camera, truth: &Video) -> Measurement {
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(truth.data(), &mut frame);
    let noiseless = Image::new(SIDE, SIDE, frame).expect("a frame");
    let noise = Noise::Gaussian { snr: 256.0 };
    let recorded = noise.apply(&noiseless, camera.sensor(), 1).expect("light");
    Measurement::new(recorded.frame).expect("light")
}

/// The shortest times of all runs, in seconds.
struct Costs {
    setup: f64,
    /// An iteration before the video is restricted to its support.
    unrestricted: f64,
    /// An iteration on the support.
    restricted: f64,
    /// All iterations of a run.
    all: f64,
    /// Forward plus adjoint.
    products: f64,
}

impl Default for Costs {
    fn default() -> Self {
        Self {
            setup: f64::MAX,
            unrestricted: f64::MAX,
            restricted: f64::MAX,
            all: f64::MAX,
            products: f64::MAX,
        }
    }
}

impl Costs {
    /// Sets the problem up.
    fn time_setup(&mut self, measurement: &Measurement, camera: &Camera, psf: &Psf) -> Problem {
        let options = Options {
            prior: Some(Prior::STANDARD),
            ..Options::default()
        };
        let begin = Instant::now();
        let problem = Problem::new(measurement, camera, psf, options).expect("a problem");
        self.setup = self.setup.min(begin.elapsed().as_secs_f64());
        problem
    }

    /// Solves `problem`.
    fn time_solve(&mut self, problem: Problem) {
        let begin = Instant::now();
        let mut stamps = Vec::new();
        problem
            .solve(&mut |progress| {
                stamps.push((begin.elapsed().as_secs_f64(), progress.support_fraction));
                ControlFlow::Continue(())
            })
            .expect("a video");
        self.all = self.all.min(stamps.last().expect("an iteration").0);
        for (k, pair) in stamps.windows(2).enumerate() {
            let time = pair[1].0 - pair[0].0;
            if UNRESTRICTED.contains(&k) {
                self.unrestricted = self.unrestricted.min(time);
            } else if pair[0].1 < 1.0 {
                self.restricted = self.restricted.min(time);
            }
        }
    }

    /// Applies `operator` and its adjoint.
    fn time_products(&mut self, operator: &RollingShutter, truth: &Video) {
        let light: Vec<f32> = truth.data().iter().map(|v| v + 0.1).collect();
        let mut frame = vec![0.0; operator.range_len()];
        let mut back = light.clone();
        for _ in 0..5 {
            let begin = Instant::now();
            operator.apply(black_box(&light), &mut frame);
            operator.adjoint(black_box(&frame), &mut back);
            self.products = self.products.min(begin.elapsed().as_secs_f64());
        }
    }
}

fn main() {
    let camera = camera();
    let side = 2 * SIDE - 1;
    let psf = speckle_psf(&SpeckleOptics::demo(), side, side, 1).expect("valid optics");
    let operator = RollingShutter::new(&camera, &psf);
    let verbose = std::env::args().any(|a| a == "--verbose");
    println!(
        "| scene | set-up | iteration, all voxels active | on the support | forward + adjoint | iteration over it | set-up over it | total | iterations | dB | iterations to 0.5 dB below |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for (name, truth) in scenes(camera.video_shape()) {
        let measurement = measure(&operator, &camera, &truth);
        let mut costs = Costs::default();
        let mut curve = Vec::new();
        for _ in 0..TIMED {
            let problem = costs.time_setup(&measurement, &camera, &psf);
            costs.time_solve(problem);
            costs.time_products(&operator, &truth);
        }
        // Pictures are compared in a run of their own, whose iterations are not timed.
        let problem = costs.time_setup(&measurement, &camera, &psf);
        let found = problem
            .solve(&mut |progress| {
                curve.push(psnr_db(&progress.video.get(), truth.data()));
                ControlFlow::Continue(())
            })
            .expect("a video");
        *curve.last_mut().expect("an iteration") = psnr_db(found.video.data(), truth.data());
        let last = *curve.last().expect("an iteration");
        let near = curve
            .iter()
            .rposition(|d| *d < last - 0.5)
            .map_or(1, |k| k + 2);
        if verbose {
            let some = curve.iter().enumerate().filter(|(k, _)| (k + 1) % 10 == 0);
            let text: Vec<String> = some.map(|(k, d)| format!("{}:{d:.1}", k + 1)).collect();
            println!("{}", text.join(" "));
        }
        println!(
            "| {name} | {:.0} ms | {:.2} ms | {:.2} ms | {:.2} ms | {:.2} | {:.1} | {:.0} ms | {} | {last:.1} | {near} |",
            1e3 * costs.setup,
            1e3 * costs.unrestricted,
            1e3 * costs.restricted,
            1e3 * costs.products,
            costs.unrestricted / costs.products,
            costs.setup / costs.products,
            1e3 * costs.all,
            curve.len()
        );
    }
}
