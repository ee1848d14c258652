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
use rowburst::{Camera, Image, RollingShutter, Sensor, Shape, Shutter, Video};
use std::hint::black_box;
use std::ops::ControlFlow;
use std::time::Instant;

const SIDE: usize = 108;
/// Runs that are timed.
const TIMED: usize = 7;
/// Iterations whose cost counts: before the video is restricted to its support, and after.
const OPEN: std::ops::Range<usize> = 5..19;

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

fn main() {
    let camera = Camera::new(CameraParams {
        rows: SIDE,
        columns: SIDE,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .expect("a valid camera");
    let side = 2 * SIDE - 1;
    let psf = speckle_psf(&SpeckleOptics::demo(), side, side, 1).expect("valid optics");
    let operator = RollingShutter::new(&camera, &psf);
    let verbose = std::env::args().any(|a| a == "--verbose");
    println!(
        "| scene | set-up | iteration, all lit | on the support | forward + adjoint | iteration over it | set-up over it | all | iterations | dB | to 0.5 dB of that |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    for (name, truth) in scenes(camera.video_shape()) {
        let mut frame = vec![0.0; operator.range_len()];
        operator.apply(truth.data(), &mut frame);
        let noiseless = Image::new(SIDE, SIDE, frame.clone()).expect("a frame");
        let noise = Noise::Gaussian { snr: 256.0 };
        let recorded = noise.apply(&noiseless, camera.sensor(), 1).expect("light");
        let measurement = Measurement::new(recorded.frame).expect("light");
        let options = Options {
            prior: Some(Prior::STANDARD),
            ..Options::default()
        };
        // The fastest of all runs; pictures are looked at in a run of their own, which is not timed.
        let (mut setup, mut open, mut tight, mut all) = (f64::MAX, f64::MAX, f64::MAX, f64::MAX);
        let mut products = f64::MAX;
        let mut curve = Vec::new();
        let light: Vec<f32> = truth.data().iter().map(|v| v + 0.1).collect();
        let mut back = light.clone();
        for run in 0..=TIMED {
            let is_looked_at = run == TIMED;
            let begin = Instant::now();
            let problem = Problem::new(&measurement, &camera, &psf, options).expect("a problem");
            setup = setup.min(begin.elapsed().as_secs_f64());
            let begin = Instant::now();
            let mut stamps = Vec::new();
            let found = problem
                .solve(&mut |progress| {
                    stamps.push((begin.elapsed().as_secs_f64(), progress.support));
                    if is_looked_at {
                        curve.push(psnr_db(progress.video, truth.data()));
                    }
                    ControlFlow::Continue(())
                })
                .expect("a video");
            if is_looked_at {
                *curve.last_mut().expect("an iteration") =
                    psnr_db(found.video.data(), truth.data());
                continue;
            }
            all = all.min(stamps.last().expect("an iteration").0);
            for (k, pair) in stamps.windows(2).enumerate() {
                let time = pair[1].0 - pair[0].0;
                if OPEN.contains(&k) {
                    open = open.min(time);
                } else if pair[0].1 < 1.0 {
                    tight = tight.min(time);
                }
            }
            for _ in 0..5 {
                let begin = Instant::now();
                operator.apply(black_box(&light), &mut frame);
                operator.adjoint(black_box(&frame), &mut back);
                products = products.min(begin.elapsed().as_secs_f64());
            }
        }
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
            1e3 * setup,
            1e3 * open,
            1e3 * tight,
            1e3 * products,
            open / products,
            setup / products,
            1e3 * all,
            curve.len()
        );
    }
}
