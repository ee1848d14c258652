use ndarray::{Array2, Array3};
use ndarray_npy::read_npy;
use rowburst::camera::CameraParams;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{Options, Prior, Problem, SelfCalibration};
use rowburst::{Camera, Image, Psf, Sensor, Shutter};
use std::ops::ControlFlow;

fn image(path: &str) -> Image {
    let a: Array2<f32> = read_npy(path).unwrap();
    Image::new(a.nrows(), a.ncols(), a.iter().copied().collect()).unwrap()
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let dir = &args[1];
    let exposure: f64 = args[2].parse().unwrap();
    let mode = match args[3].as_str() {
        "off" => SelfCalibration::Off,
        "on" => SelfCalibration::On,
        _ => SelfCalibration::Auto,
    };
    let frame = image(&format!("{dir}/frame.npy"));
    let psf = Psf::new(image(&format!("{dir}/psf.npy"))).unwrap();
    let camera = Camera::new(CameraParams {
        rows: frame.rows(),
        columns: frame.columns(),
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6 * exposure,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap();
    let measurement = Measurement::new(frame).unwrap();
    let start = std::time::Instant::now();
    let options = Options {
        prior: Some(Prior::STANDARD),
        self_calibration: mode,
        ..Options::default()
    };
    let problem = Problem::new(&measurement, &camera, &psf, options).unwrap();
    let mut total = 0;
    let mut labels = std::collections::BTreeMap::new();
    let r = problem
        .solve(&mut |p| {
            *labels.entry(p.label.to_string()).or_insert(0) += 1;
            total += 1;
            ControlFlow::Continue(())
        })
        .unwrap();
    if let Some(c) = &r.calibration {
        for f in &c.parameters {
            print!(
                "{} {:.5} ± {:.5}, ",
                f.parameter.name(),
                f.value,
                f.standard_error
            );
        }
        println!(
            "rows {} held {:.2} -> {:.2}",
            c.row_offsets.len(),
            c.held_out_before / r.sigma,
            c.held_out_after / r.sigma
        );
    }
    println!("{labels:?}");
    let seconds = start.elapsed().as_secs_f64();
    let truth: Result<Array3<f32>, _> = read_npy(format!("{dir}/truth.npy"));
    if let Ok(truth) = truth {
        let v: Vec<f64> = truth.iter().map(|v| f64::from(*v)).collect();
        let x: Vec<f64> = r.video.data().iter().map(|v| f64::from(*v)).collect();
        let g = x.iter().zip(&v).map(|(a, b)| a * b).sum::<f64>()
            / x.iter().map(|a| a * a).sum::<f64>();
        let max = v.iter().copied().fold(0.0, f64::max);
        let db = |g: f64| {
            let e = x
                .iter()
                .zip(&v)
                .map(|(a, b)| (g * a - b).powi(2))
                .sum::<f64>()
                / v.len() as f64;
            10.0 * (max * max / e).log10()
        };
        println!(
            "{dir} {:.2} dB ({:.2} scaled {:.3}) r/σ {:.2} σe/σ {:.2} excluded {} its {} of {} {:.1} s {}",
            db(1.0),
            db(g),
            g,
            r.residual_over_sigma,
            r.effective_sigma / r.sigma,
            r.excluded.iter().filter(|e| **e == 1).count(),
            r.iterations,
            total,
            seconds,
            r.stop_reason.name()
        );
    }
}
