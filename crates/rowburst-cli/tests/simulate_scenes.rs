//! `rowburst simulate`: what is in a scene, and how bright it is.

mod common;

use common::Lab;
use serde_json::Value;

/// A camera of 48 × 40 pixels.
const CAMERA: &str = "[camera]
rows = 48
columns = 40
shutter = \"dual-inside-out\"
row_time_us = 10
exposure_us = 10
";

const SENSOR: &str = "bias_counts = 100
gain_electrons_per_count = 0.5
read_noise_electrons = 1.6
";

fn lab(sensor: &str) -> Lab {
    let lab = Lab::empty();
    lab.experiment(&format!("{CAMERA}{sensor}"));
    lab
}

fn notes(lab: &Lab, folder: &str) -> Value {
    serde_json::from_slice(&lab.read(&format!("{folder}/simulation.json"))).unwrap()
}

/// The command must be refused in words that hold all of `says`.
fn refused(lab: &Lab, arguments: &str, says: &[&str]) {
    let output = lab.run(arguments);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{arguments}\n{text}");
    for part in says {
        assert!(text.contains(part), "{arguments}: lacks \"{part}\"\n{text}");
    }
    assert!(lab.files("out").is_empty(), "{arguments}");
}

#[test]
fn a_background_is_static_and_as_bright_as_asked() {
    let lab = lab("");
    lab.done(
        "simulate experiment.toml --scene moving --seed 5 --snr inf --background 3 -o background",
    );
    lab.done("simulate experiment.toml --scene moving --seed 5 --snr inf -o plain");
    let whole = lab.array("background/truth.npy");
    let moving = lab.array("background/truth-moving.npy");
    let still: ndarray::Array2<f32> =
        ndarray_npy::read_npy(lab.path("background/truth-background.npy")).unwrap();
    let max = |values: &mut dyn Iterator<Item = &f32>| values.copied().fold(0.0, f32::max);
    let brightest = max(&mut still.iter()) / max(&mut moving.iter());
    assert!((brightest - 3.0).abs() < 1e-4, "{brightest}");
    for (t, bin) in whole.outer_iter().enumerate() {
        for ((at, whole), moving) in bin
            .indexed_iter()
            .zip(moving.index_axis(ndarray::Axis(0), t))
        {
            assert!((whole - moving - still[at]).abs() < 1e-5, "{t} {at:?}");
        }
    }
    let plain = lab.array("plain/truth.npy");
    let difference = (&plain - &moving).mapv(f32::abs);
    assert!(difference.iter().all(|&d| d < 1e-5));

    let light = notes(&lab, "background")["background"]["light_over_scene"]
        .as_f64()
        .unwrap();
    let want = whole.shape()[0] as f64 * f64::from(still.sum()) / f64::from(moving.sum());
    assert!((light / want - 1.0).abs() < 1e-3, "{light} {want}");
    assert!(notes(&lab, "plain")["background"].is_null());

    // A folder used again keeps nothing that no longer belongs to its truth.
    lab.done("simulate experiment.toml --scene moving --seed 5 -o background");
    let files = lab.files("background");
    assert!(
        !files.iter().any(|name| name.starts_with("truth-")),
        "{files:?}"
    );
}

/// Connected groups of pixels above a tenth of the brightest.
fn things(bin: ndarray::ArrayView2<f32>) -> usize {
    let bright = bin.iter().copied().fold(0.0, f32::max);
    let mut open: std::collections::BTreeSet<(usize, usize)> = bin
        .indexed_iter()
        .filter(|&(_, &v)| v > 0.1 * bright)
        .map(|(at, _)| at)
        .collect();
    let mut count = 0;
    while let Some(first) = open.pop_first() {
        count += 1;
        let mut edge = vec![first];
        while let Some((y, x)) = edge.pop() {
            let near: Vec<_> = open
                .iter()
                .copied()
                .filter(|at| at.0.abs_diff(y) <= 1 && at.1.abs_diff(x) <= 1)
                .collect();
            for at in near {
                open.remove(&at);
                edge.push(at);
            }
        }
    }
    count
}

#[test]
fn two_digits_move() {
    let lab = lab("");
    let mut most = 0;
    for seed in 1..4 {
        lab.done(&format!(
            "simulate experiment.toml --scene two-moving --seed {seed} -o sim"
        ));
        let truth = lab.array("sim/truth.npy");
        let counts: Vec<usize> = truth.outer_iter().map(things).collect();
        // One where they cross, never more than two.
        assert!(counts.iter().all(|c| (1..=2).contains(c)), "{counts:?}");
        most = most.max(counts.iter().filter(|&&c| c == 2).count());
    }
    assert!(most > 12, "two things in {most} of 24 bins");
}

#[test]
fn electrons_of_the_scene_are_those_of_the_truth() {
    let lab = lab(SENSOR);
    for (scene, electrons) in [("digits", 3000.0), ("leds", 2e5)] {
        lab.done(&format!(
            "simulate experiment.toml --scene {scene} --scene-electrons {electrons} -o sim"
        ));
        let truth = lab.array("sim/truth.npy");
        let brightest = 0.5 * f64::from(truth.iter().copied().fold(0.0, f32::max));
        assert!(
            (brightest / electrons - 1.0).abs() < 1e-4,
            "{scene}: {brightest}"
        );
        let frame: ndarray::Array2<f32> = ndarray_npy::read_npy(lab.path("sim/frame.npy")).unwrap();
        let recorded = 0.5 * (f64::from(frame.sum()) - 100.0 * frame.len() as f64);
        let notes = notes(&lab, "sim");
        assert_eq!(notes["noise"]["scene_electrons"], electrons);
        let peak = notes["noise"]["peak_electrons"].as_f64().unwrap();
        let psf = ndarray_npy::read_npy(lab.path("sim/psf.npy")).unwrap();
        let light = noiseless(&truth, &psf).mapv(|counts| 0.5 * counts);
        let brightest = light.iter().copied().fold(0.0, f64::max);
        assert!((peak / brightest - 1.0).abs() < 1e-3, "{peak} {brightest}");
        let (sum, pixels) = (light.sum(), light.len() as f64);
        let deviation = (sum + pixels * 1.6 * 1.6).sqrt();
        assert!(
            (recorded - sum).abs() < 5.0 * deviation,
            "{scene}: {recorded} instead of {sum} ± {deviation}"
        );
    }
}

/// The frame by its definition: bin `j` is seen by the rows `23 − j` and `24 + j`.
fn noiseless(truth: &ndarray::Array3<f32>, psf: &ndarray::Array2<f32>) -> ndarray::Array2<f64> {
    let mut frame = ndarray::Array2::zeros((48, 40));
    for (j, bin) in truth.outer_iter().enumerate() {
        for ((y, x), &value) in bin.indexed_iter().filter(|&(_, &v)| v > 0.0) {
            for row in [23 - j, 24 + j] {
                for column in 0..40 {
                    let at = (psf.nrows() / 2 + row - y, psf.ncols() / 2 + column - x);
                    frame[(row, column)] += f64::from(value) * f64::from(psf[at]);
                }
            }
        }
    }
    frame
}

#[test]
fn leds_are_noted() {
    let lab = lab("");
    lab.done("simulate experiment.toml --scene leds -o sim");
    let notes = notes(&lab, "sim");
    let leds = notes["leds"].as_array().unwrap();
    let hertz: Vec<f64> = leds
        .iter()
        .map(|led| led["frequency_hz"].as_f64().unwrap())
        .collect();
    assert_eq!(hertz, [20_833.0, 34_722.0, 52_083.0]);
    let truth = lab.array("sim/truth.npy");
    for led in leds {
        let at = |key: &str| led[key].as_f64().unwrap().round() as usize;
        let lit = (0..24).any(|t| truth[(t, at("row"), at("column"))] > 0.3);
        assert!(lit, "{led}");
    }
}

#[test]
fn invalid_scenes_are_refused() {
    let dark = lab(SENSOR);
    dark.video("dark.npy", [24, 48, 40], |_| 0.0);
    refused(
        &dark,
        "simulate experiment.toml --scene dark.npy --background 3 -o out",
        &["--background", "dark"],
    );
    for times in ["0", "-3", "nan", "inf"] {
        refused(
            &dark,
            &format!("simulate experiment.toml --scene moving --background {times} -o out"),
            &["--background", "above zero", "Leave it out"],
        );
    }
    for electrons in ["0", "-200", "nan"] {
        refused(
            &dark,
            &format!(
                "simulate experiment.toml --scene moving --scene-electrons {electrons} -o out"
            ),
            &["--scene-electrons", "above zero", "200"],
        );
    }
    for other in ["--snr 8", "--peak-electrons 500"] {
        refused(
            &dark,
            &format!("simulate experiment.toml --scene moving --scene-electrons 9 {other} -o out"),
            &["--scene-electrons", "cannot be used with"],
        );
    }
    let bare = lab("");
    refused(
        &bare,
        "simulate experiment.toml --scene moving --scene-electrons 200 -o out",
        &["gain_electrons_per_count", "--scene-electrons", "[camera]"],
    );
    refused(
        &bare,
        "simulate experiment.toml --scene three-moving -o out",
        &["--scene", "three-moving", "two-moving"],
    );
    for phase in ["0", "3", "nan", "1000"] {
        refused(
            &bare,
            &format!("simulate experiment.toml --scene moving --diffuser-phase {phase} -o out"),
            &["--diffuser-phase", "4 to 100 radians"],
        );
    }
    for snr in ["0", "-8", "8,nan", "inf"] {
        refused(
            &bare,
            &format!("design --trial-snr {snr} -o out"),
            &["--trial-snr", "above zero", "Leave it out"],
        );
    }
    let tiny = Lab::new();
    refused(
        &tiny,
        "simulate experiment.toml --scene digits --digit-px 7 --background 2 -o out",
        &["--background", "6×12×10", "larger field"],
    );
}

/// What the calibrations find in the captures is what the simulation was told.
#[test]
fn the_captures_of_a_calibration_give_the_sensor_and_the_psf() {
    let lab = lab(&format!(
        "{SENSOR}bit_depth = 16\nfull_well_counts = 40000\n"
    ));
    lab.done("simulate experiment.toml --scene moving --peak-electrons 9000 --captures -o sim");
    lab.done("calibrate sensor --darks sim/darks.npy --flats sim/flats.npy --experiment experiment.toml -o sensor");
    let sensor: Value = serde_json::from_slice(&lab.read("sensor/sensor.json")).unwrap();
    for (key, told, relative) in [
        ("gain_electrons_per_count", 0.5, 0.03),
        ("read_noise_electrons", 1.6, 0.03),
        ("bias_counts", 100.0, 0.002),
        ("full_well_counts", 40_000.0, 0.01),
    ] {
        let found = sensor[key]
            .as_f64()
            .unwrap_or_else(|| panic!("{key} in {sensor:#}"));
        assert!((found / told - 1.0).abs() < relative, "{key}: {found}");
    }
    lab.done("calibrate psf sim/pinhole.npy --dark sim/pinhole-dark.npy --experiment sensor/experiment.toml -o psf");
    let psf =
        |name: &str| -> ndarray::Array2<f32> { ndarray_npy::read_npy(lab.path(name)).unwrap() };
    let (found, told) = (psf("psf/psf.npy"), psf("sim/psf.npy"));
    // Its centre is that of its light.
    let best = (-3i64..=3)
        .flat_map(|dy| (-3i64..=3).map(move |dx| (dy, dx)))
        .map(|(dy, dx)| correlation(&found, &told, dy, dx))
        .fold(0.0, f64::max);
    assert!(best > 0.8, "{best}");

    // A run without them leaves none behind.
    lab.done("simulate experiment.toml --scene moving -o sim");
    let files = lab.files("sim");
    assert!(
        !files
            .iter()
            .any(|name| name.contains("dark") || name.contains("flat") || name.contains("pinhole")),
        "{files:?}"
    );
}

/// Correlation of two images whose middles are `(dy, dx)` apart.
fn correlation(a: &ndarray::Array2<f32>, b: &ndarray::Array2<f32>, dy: i64, dx: i64) -> f64 {
    let (middle_a, middle_b) = (a.dim(), b.dim());
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for ((y, x), &value) in a.indexed_iter() {
        let row = y as i64 - (middle_a.0 / 2) as i64 + (middle_b.0 / 2) as i64 + dy;
        let column = x as i64 - (middle_a.1 / 2) as i64 + (middle_b.1 / 2) as i64 + dx;
        let other = usize::try_from(row)
            .ok()
            .zip(usize::try_from(column).ok())
            .and_then(|at| b.get(at));
        if let Some(&other) = other {
            let (value, other) = (f64::from(value), f64::from(other));
            ab += value * other;
            aa += value * value;
            bb += other * other;
        }
    }
    ab / (aa * bb).sqrt()
}

#[test]
fn captures_without_gain_are_refused() {
    let lab = lab("");
    refused(
        &lab,
        "simulate experiment.toml --scene leds --captures -o out",
        &["gain_electrons_per_count", "captures needs"],
    );
}

#[test]
fn a_direct_frame_is_shown() {
    let lab = Lab::new();
    lab.image("direct.png", 30, 17, |y, x| (40 * y + x) as f32);
    let page = |more: &str| {
        lab.done(&format!(
            "reconstruct experiment.toml --frame frame.npy --max-iterations 5 {more} -o result"
        ));
        String::from_utf8(lab.read("result/report.html")).unwrap()
    };
    let title = ">without the diffuser</text>";
    assert!(!page("").contains(title));
    let with = page("--direct direct.png");
    assert!(with.contains(title));
    assert!(with.contains("The frame given as taken without the diffuser"));
    assert!(with.contains("--direct direct.png"), "the command is whole");
    refused(
        &lab,
        "reconstruct experiment.toml --frame frame.npy --direct lost.png -o out",
        &["lost.png"],
    );
    lab.truncate("direct.png", 0.5, "half.png");
    refused(
        &lab,
        "reconstruct experiment.toml --frame frame.npy --direct half.png -o out",
        &["half.png"],
    );
}

#[test]
fn trials_are_made_at_the_snr_asked_for() {
    let lab = Lab::empty();
    let printed =
        lab.done("design --rows 16 --columns 16 --diffuser-deg 0.3 --trial-snr 64,16 --json");
    let design: Value = serde_json::from_str(&printed).unwrap();
    let map = &design["success_map"];
    assert_eq!(map["snr"], serde_json::json!([16.0, 64.0]));
    assert_eq!(map["half_success_pixels"].as_array().unwrap().len(), 2);
}
