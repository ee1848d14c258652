//! What the integration tests share.
#![allow(dead_code, reason = "each test file uses only some of these")]

use ndarray_npy::ReadNpyExt;
use rowburst::camera::CameraParams;
use rowburst::{Camera, Image, Psf, Sensor, Shutter};
use std::path::{Path, PathBuf};

/// Folders of the oracle's cases.
pub fn oracle_cases() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/oracle");
    let mut cases: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    cases.sort();
    assert!(cases.len() >= 8, "the oracle's cases are here");
    cases
}

/// Shape and values of a `.npy` file of f32 or f64.
pub fn read_f32(path: &Path) -> (Vec<usize>, Vec<f32>) {
    let open = || std::fs::File::open(path).unwrap();
    if let Ok(array) = ndarray::ArrayD::<f32>::read_npy(open()) {
        return (array.shape().to_vec(), array.iter().copied().collect());
    }
    let array = ndarray::ArrayD::<f64>::read_npy(open()).unwrap();
    (
        array.shape().to_vec(),
        array.iter().map(|&v| v as f32).collect(),
    )
}

/// The camera of a case's `experiment.toml` (only the keys that the oracle uses).
pub fn camera_of(case: &Path) -> Camera {
    let text = std::fs::read_to_string(case.join("experiment.toml")).unwrap();
    let value = |key: &str| -> String {
        let line = text
            .lines()
            .find(|l| l.starts_with(&format!("{key} =")))
            .unwrap();
        line.split('=')
            .nth(1)
            .unwrap()
            .trim()
            .trim_matches('"')
            .to_string()
    };
    let shutter = match value("shutter").as_str() {
        "top-down" => Shutter::TopDown,
        "bottom-up" => Shutter::BottomUp,
        "dual-inside-out" => Shutter::DualInsideOut,
        "dual-outside-in" => Shutter::DualOutsideIn,
        "global" => Shutter::Global,
        other => panic!("shutter {other}"),
    };
    Camera::new(CameraParams {
        rows: value("rows").parse().unwrap(),
        columns: value("columns").parse().unwrap(),
        shutter,
        row_time_us: value("row_time_us").parse().unwrap(),
        exposure_us: value("exposure_us").parse().unwrap(),
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap()
}

/// The value of the image at `(y, x)` by a windowed sinc, which self-calibration does not use.
fn interpolated(image: &Image, y: f64, x: f64) -> f64 {
    const HALF: isize = 6;
    let sinc = |t: f64| {
        let angle = std::f64::consts::PI * t;
        if angle == 0.0 {
            1.0
        } else {
            angle.sin() / angle
        }
    };
    let kernel = |t: f64| sinc(t) * sinc(t / HALF as f64);
    let mut sum = 0.0;
    for row in y.floor() as isize - HALF + 1..=y.floor() as isize + HALF {
        for column in x.floor() as isize - HALF + 1..=x.floor() as isize + HALF {
            let row_inside = (0..image.rows() as isize).contains(&row);
            if row_inside && (0..image.columns() as isize).contains(&column) {
                let value = f64::from(image.at(row as usize, column as usize));
                sum += value * kernel(y - row as f64) * kernel(x - column as f64);
            }
        }
    }
    sum
}

/// The PSF from a capture that is `scale` times as large and turned by `degrees`.
pub fn distorted(psf: &Psf, scale: f64, degrees: f64) -> Psf {
    let image = psf.image();
    let (sin, cos) = degrees.to_radians().sin_cos();
    let (centre_y, centre_x) = ((image.rows() / 2) as f64, (image.columns() / 2) as f64);
    let at = |y: usize, x: usize| {
        let (dy, dx) = ((y as f64 - centre_y) / scale, (x as f64 - centre_x) / scale);
        let value = interpolated(
            image,
            cos * dy - sin * dx + centre_y,
            sin * dy + cos * dx + centre_x,
        );
        value.max(0.0) as f32
    };
    Psf::new(Image::from_fn(image.rows(), image.columns(), at)).unwrap()
}
