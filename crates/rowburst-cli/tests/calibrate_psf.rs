//! `calibrate psf`: real speckle with known answers (skipped where it is absent), and
//! what users do wrong.

mod common;

use common::{Lab, pattern};
use rowburst::Image;
use rowburst::calibrate::psf::{ballistic_core, statistics};
use rowburst::simulate::speckle::{Aperture, SpeckleOptics, speckle_psf};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn shared(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared/data")
        .join(folder);
    if !path.exists() {
        println!("skipped: {} is not here", path.display());
        return None;
    }
    Some(path)
}

fn calibrated(lab: &Lab, arguments: &str) -> Value {
    serde_json::from_str(&lab.done(&format!("calibrate psf {arguments} --json -o out"))).unwrap()
}

/// What is said of bad input.
fn refused(lab: &Lab, arguments: &str) -> String {
    let output = lab.run(arguments);
    assert_eq!(output.status.code(), Some(2));
    String::from_utf8(output.stderr).unwrap()
}

fn warned(result: &Value, of: &str) -> bool {
    let warnings = result["warnings"].as_array().unwrap();
    warnings.iter().any(|w| w.as_str().unwrap().contains(of))
}

/// The dark of the captures, which are long exposures, is not that of the frames.
#[test]
fn the_dark_of_the_frames_stays_in_the_experiment() {
    let lab = Lab::empty();
    let light = grains(3);
    lab.image("psf-dark.png", 96, 90, |_, _| 100.0);
    lab.image("point.png", 96, 90, |y, x| {
        (100.0 + 2.0 * light(y, x)).round()
    });
    let camera = common::CAMERA
        .replace("rows = 12", "rows = 96")
        .replace("columns = 10", "columns = 90");
    for (calibration, expected) in [
        ("[calibration]\ndark = \"frames-dark.npy\"\n", true),
        ("", false),
    ] {
        lab.image("frames-dark.npy", 96, 90, |_, _| 7.0);
        lab.experiment(&format!("{camera}{calibration}"));
        calibrated(
            &lab,
            "point.png --dark psf-dark.png --experiment experiment.toml",
        );
        let written = String::from_utf8(lab.read("out/experiment.toml")).unwrap();
        assert!(!written.contains("psf-dark"), "{written}");
        assert_eq!(written.contains("frames-dark.npy"), expected, "{written}");
    }
}

#[test]
fn ground_glass_has_its_contrast_and_only_1500_grit_a_core() {
    let Some(data) = shared("speckle-grits") else {
        return;
    };
    for (grit, ballistic) in [("120", false), ("220", false), ("1500", true)] {
        let lab = Lab::empty();
        let result = calibrated(&lab, &format!("{}/{grit}.bmp", data.display()));
        let number = |key: &str| result[key].as_f64().unwrap();
        println!(
            "{grit}: {} {} {}",
            number("contrast"),
            number("grain_px"),
            number("ballistic_fraction")
        );
        assert!(
            (0.9..=1.0).contains(&number("contrast")),
            "{grit}: {result}"
        );
        assert!(
            (7.8..=9.2).contains(&number("grain_px")),
            "{grit}: {result}"
        );
        assert_eq!(
            number("ballistic_fraction") > 0.01,
            ballistic,
            "{grit}: {result}"
        );
        assert_eq!(warned(&result, "ballistic"), ballistic, "{grit}: {result}");
        let psf = rowburst_io::read_image(&lab.path("out/psf.npy"))
            .unwrap()
            .image;
        let sum: f64 = psf.data().iter().map(|&p| f64::from(p)).sum();
        assert!((sum - 1.0).abs() < 1e-4 && psf.min() >= 0.0);
        assert!(lab.files("out").contains(&"report.html".to_string()));
    }
}

#[test]
fn the_memory_effect_is_that_of_the_scan() {
    let Some(data) = shared("speckle-memory-effect-scan") else {
        return;
    };
    let lab = Lab::empty();
    let lines = (-20..=20).map(|i| format!("{i}.bmp,{:.2},0\n", 0.05 * f64::from(i)));
    lab.write(
        "scan.csv",
        format!("capture,x_mm,y_mm\n{}", lines.collect::<String>()),
    );
    let result = calibrated(&lab, &format!("{} --positions-mm scan.csv", data.display()));
    let number = |key: &str| result[key].as_f64().unwrap();
    assert!(
        (number("shift_px_per_mm") / 160.0 - 1.0).abs() < 0.02,
        "{result}"
    );
    assert!((number("grain_px") / 7.7 - 1.0).abs() < 0.1, "{result}");
    assert!(
        (0.25..0.30).contains(&number("isoplanatic_range_mm")),
        "{result}"
    );
    let curve: Vec<(f64, f64)> = serde_json::from_value(result["correlation"].clone()).unwrap();
    for (mm, expected) in [(0.05, 0.94), (0.10, 0.87), (0.25, 0.56), (0.50, 0.14)] {
        let at = curve.iter().filter(|c| (c.0 - mm).abs() < 1e-6);
        let values: Vec<f64> = at.map(|c| c.1).collect();
        assert_eq!(values.len(), 2);
        assert!(
            values.iter().all(|v| (v - expected).abs() < 0.03),
            "{mm}: {values:?}"
        );
    }
    assert!(
        curve
            .iter()
            .filter(|c| c.0 > 0.75)
            .all(|c| c.1.abs() < 0.06),
        "{curve:?}"
    );
    let set = rowburst_io::read_patch_set(&lab.path("out/psf-patches.toml")).unwrap();
    assert_eq!(set.psfs().len() as u64, result["patches"].as_u64().unwrap());
    let xs: Vec<f64> = set.offsets_px().iter().map(|o| o.1).collect();
    let span = xs.iter().copied().fold(0.0, f64::max) - xs.iter().copied().fold(0.0, f64::min);
    assert!((span / 320.0 - 1.0).abs() < 0.02, "{xs:?}");
}

/// Grains of about four pixels that look like speckle, the same in every run, in
/// 12 bits without noise.
fn grains(seed: usize) -> impl Fn(usize, usize) -> f32 {
    move |y, x| {
        let (mut re, mut im) = (0.0f32, 0.0f32);
        for k in 0..60 {
            let angle = |s: usize| pattern(k * 7 + s, seed) - 0.5;
            let phase = std::f32::consts::TAU
                * (angle(1) * 0.2 * y as f32 + angle(2) * 0.2 * x as f32 + angle(3));
            re += phase.cos();
            im += phase.sin();
        }
        10.0 * (re * re + im * im)
    }
}

#[test]
fn exposures_are_merged_and_outliers_named() {
    let lab = Lab::empty();
    let light = grains(3);
    let recorded = |gain: f32| {
        let light = &light;
        move |y: usize, x: usize| (100.0 + gain * light(y, x)).min(4095.0).round()
    };
    lab.image("dark.png", 96, 90, |_, _| 100.0);
    lab.image("long.png", 96, 90, recorded(2.0));
    lab.image("short.png", 96, 90, recorded(0.2));
    let result = calibrated(
        &lab,
        "long.png short.png --dark dark.png --exposures-ms 10,1",
    );
    assert_eq!(result["saturated_fraction"], 0.0, "{result}");
    assert!(
        (0.85..1.15).contains(&result["contrast"].as_f64().unwrap()),
        "{result}"
    );
    let alone = calibrated(&lab, "long.png --dark dark.png");
    assert!(
        alone["saturated_fraction"].as_f64().unwrap() > 0.01 && warned(&alone, "saturated"),
        "{alone}"
    );

    lab.image("a.png", 96, 90, recorded(0.21));
    lab.image("b.png", 96, 90, recorded(0.19));
    lab.image("moved.png", 96, 90, grains(4));
    let result = calibrated(&lab, "short.png a.png b.png moved.png --dark dark.png");
    assert_eq!(
        result["left_out"],
        serde_json::json!(["moved.png"]),
        "{result}"
    );
    assert!(warned(&result, "moved.png was excluded"));
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of bad inputs")]
fn mistakes_are_named() {
    let lab = Lab::empty();
    for i in 0..4 {
        lab.image(&format!("{i}.png"), 64, 60, grains(i));
    }
    lab.image("small.png", 60, 60, grains(0));
    lab.image("black.png", 64, 60, |_, _| 0.0);
    lab.image("bright.png", 64, 60, |_, _| 60000.0);
    lab.image("full.png", 64, 60, |y, x| {
        (100.0 * grains(0)(y, x)).min(60000.0)
    });
    std::fs::create_dir(lab.path("empty")).unwrap();
    lab.write("empty/notes.txt", "");
    for (name, text) in [
        ("few.csv", "0.png,0,0\n1.png,1,0\n"),
        ("missing.csv", "0.png,0,0\n"),
        ("unknown.csv", "0.png,0,0\n9.png,1,0\n"),
        ("twice.csv", "0.png,0,0\n0.png,1,0\n"),
        ("place.csv", "0.png,0,0\n1.png,1,0\n2.png,1,0\n"),
        ("words.csv", "0.png,0,0\n1.png,one,0\n"),
        ("apart.csv", "0.png,0,0\n1.png,1,0\n2.png,2,0\n"),
    ] {
        lab.write(name, text);
    }
    let cases = [
        (
            "0.png small.png",
            &["small.png", "60×60", "0.png has 64×60"][..],
        ),
        (
            "0.png 1.png",
            &["png: found a correlation of", "--positions-mm"],
        ),
        ("black.png", &["black.png", "0 in every pixel", "exposure"]),
        (
            "full.png",
            &["full.png", "% of the pixels saturated", "Shorten"],
        ),
        (
            "0.png --dark bright.png",
            &["dark", "darker than a capture"],
        ),
        ("0.png --dark small.png", &["dark", "60×60"]),
        (
            "0.png --exposures-ms 1,2",
            &["--exposures-ms", "2 exposures for 1 captures"],
        ),
        ("0.png --exposures-ms=-1", &["--exposures-ms", "above zero"]),
        ("empty", &["empty", "a folder without images"]),
        ("gone.png", &["gone.png", "no such file"]),
        (
            "0.png 1.png --positions-mm few.csv",
            &["2 positions", "three positions or more"],
        ),
        (
            "0.png 1.png --positions-mm missing.csv",
            &["missing.csv", "no line for 1.png"],
        ),
        (
            "0.png 1.png --positions-mm unknown.csv",
            &["unknown.csv, line 2", "9.png"],
        ),
        (
            "0.png 1.png --positions-mm twice.csv",
            &["twice.csv, line 2", "second time"],
        ),
        (
            "0.png 1.png --positions-mm words.csv",
            &["words.csv, line 2", "1.png,one,0"],
        ),
        ("0.png 1.png --positions-mm gone.csv", &["gone.csv"]),
        (
            "0.png 1.png 2.png --positions-mm place.csv",
            &["both at x = 1 mm"],
        ),
        (
            "0.png 1.png 2.png --positions-mm apart.csv",
            &["smaller steps"],
        ),
        ("0.png --field 3by4", &["--field", "ROWSxCOLUMNS"]),
        ("0.png --binning 8", &["16 pixels or more"]),
        (
            "0.png --saturation-counts 0",
            &["--saturation-counts", "above zero"],
        ),
    ];
    for (arguments, says) in cases {
        let output = lab.run(&format!("calibrate psf {arguments} -o out"));
        let talk = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments}: {talk}");
        for words in says {
            assert!(talk.contains(words), "{arguments}: {words} in {talk}");
        }
        assert!(!lab.path("out/psf.json").exists(), "{arguments}");
    }
}

#[test]
fn a_source_that_is_no_point_is_warned_of() {
    let lab = Lab::empty();
    // Thirty independent patterns on one another: an extended or broadband source.
    lab.image("extended.png", 64, 60, |y, x| {
        (0..30).map(|s| grains(s)(y, x)).sum()
    });
    let result = calibrated(&lab, "extended.png --saturation-counts 65000");
    // Without a dark frame the floor hides it: the note says so.
    assert!(
        result["remarks"].to_string().contains("upper bound"),
        "{result}"
    );
    lab.image("dark.png", 64, 60, |_, _| 0.0);
    let result = calibrated(
        &lab,
        "extended.png --dark dark.png --saturation-counts 65000",
    );
    assert!(warned(&result, "the source is extended"), "{result}");
    lab.image("point.png", 64, 60, grains(1));
    let result = calibrated(&lab, "point.png --dark dark.png --expected-grain-px 1");
    assert!(warned(&result, "wider than the 1.0 px"), "{result}");
}

/// Simulated speckle of a grain of `grain` pixels under an envelope of `width` pixels.
fn speckle(grain: f64, width: f64, size: (usize, usize), seed: u64) -> Image {
    let (distance_mm, pitch): (f64, f64) = (50.0, 6.5);
    let angle = 2.0 * (width * pitch / 2e3 / distance_mm).atan();
    let optics = SpeckleOptics {
        wavelength_nm: 532.0,
        aperture: Aperture::ImageNa {
            na: 0.532 / (2.0 * grain * pitch),
            image_distance_mm: distance_mm,
        },
        diffuser_fwhm_deg: angle.to_degrees(),
        pixel_pitch_um: pitch,
    };
    let psf = speckle_psf(&optics, size.0, size.1, seed).unwrap();
    psf.image().clone()
}

#[test]
fn simulated_speckle_has_its_numbers_and_a_planted_core_is_found() {
    for (grain, width, size) in [
        (4.0, 160.0, (256, 240)),
        (6.0, 900.0, (240, 320)),
        (2.5, 140.0, (215, 215)),
    ] {
        for seed in 1..4 {
            let mut light = speckle(grain, width, size, seed);
            let found = statistics(&light);
            println!("{grain} {width}: {} {}", found.contrast, found.grain_px);
            assert!((0.88..1.08).contains(&found.contrast), "{}", found.contrast);
            let ratio = found.grain_px / (1.03 * grain);
            assert!((0.85..1.15).contains(&ratio), "{grain}: {}", found.grain_px);
            assert_eq!(ballistic_core(&light, found.grain_px), None);
            // A focus as wide as a grain with 3 parts of light to 100.
            let (cy, cx) = (size.0 as f64 * 0.45, size.1 as f64 * 0.55);
            let sigma = grain / 2.355;
            let peak = 0.03 / (2.0 * std::f64::consts::PI * sigma * sigma);
            for y in 0..size.0 {
                for x in 0..size.1 {
                    let r = (y as f64 - cy).powi(2) + (x as f64 - cx).powi(2);
                    let value = peak * (-0.5 * r / (sigma * sigma)).exp();
                    light.data_mut()[y * size.1 + x] += value as f32;
                }
            }
            let core = ballistic_core(&light, found.grain_px).unwrap();
            println!("{core:?}");
            assert!((0.02..0.045).contains(&core.fraction), "{core:?}");
            assert!(
                (core.at_px.0 - cy).hypot(core.at_px.1 - cx) < grain,
                "{core:?}"
            );
        }
    }
}

#[test]
fn the_experiment_written_reconstructs() {
    let lab = Lab::empty();
    lab.image("pinhole.png", 96, 90, grains(5));
    lab.experiment(
        "[camera]\nrows = 48\ncolumns = 44\nshutter = \"dual-inside-out\"\nrow_time_us = 9.6\nexposure_us = 9.6\n",
    );
    calibrated(&lab, "pinhole.png --experiment experiment.toml");
    lab.done("simulate out/experiment.toml --scene digits --digit-px 8 -o sim");
    let result = lab.done(
        "reconstruct out/experiment.toml --frame sim/frame.npy --truth sim/truth.npy --json -o video",
    );
    let result: Value = serde_json::from_str(&result).unwrap();
    assert!(result["psnr_db"].as_f64().unwrap() > 25.0, "{result}");
}

/// The size of the pinhole's image follows from the camera; the reconstruction reads how the PSF was captured.
#[test]
fn a_pinhole_is_removed_and_its_noise_is_handed_on() {
    let lab = Lab::empty();
    lab.image("pinhole.png", 96, 90, grains(5));
    let camera = |more: &str| {
        format!(
            "[camera]\nrows = 48\ncolumns = 44\nshutter = \"dual-inside-out\"\nrow_time_us = 9.6\nexposure_us = 9.6\n{more}"
        )
    };
    lab.experiment(&camera(""));
    let told = refused(
        &lab,
        "calibrate psf pinhole.png --experiment experiment.toml --pinhole-um 26 -o out",
    );
    assert!(told.contains("--pinhole-um: found 26"), "{told}");
    assert!(told.contains("pixel_pitch_um"), "{told}");
    let told = refused(&lab, "calibrate psf pinhole.png --pinhole-um -1 -o out");
    assert!(told.contains("above zero"), "{told}");

    lab.experiment(&camera("pixel_pitch_um = 6.5\nmagnification = 0.5\n"));
    let blurred = calibrated(&lab, "pinhole.png --experiment experiment.toml");
    assert_eq!(blurred["capture"]["pinhole_px"], 0.0, "{blurred}");
    let before = lab.read("out/psf.npy");
    let found = calibrated(
        &lab,
        "pinhole.png --experiment experiment.toml --pinhole-um 13",
    );
    assert_eq!(found["capture"]["pinhole_px"], 1.0, "{found}");
    assert_ne!(lab.read("out/psf.npy"), before);
    assert!(
        found["capture"]["noise_per_light"].as_f64().unwrap() > 0.0,
        "{found}"
    );
    let wide = calibrated(
        &lab,
        "pinhole.png --experiment experiment.toml --pinhole-um 100",
    );
    assert!(
        warned(&wide, "the image of the pinhole is 7.7 px wide"),
        "{wide}"
    );

    calibrated(
        &lab,
        "pinhole.png --experiment experiment.toml --pinhole-um 13",
    );
    lab.done("simulate out/experiment.toml --scene digits --digit-px 8 -o sim");
    let reconstruct = "reconstruct out/experiment.toml --frame sim/frame.npy --json -o video";
    let result: Value = serde_json::from_str(&lab.done(reconstruct)).unwrap();
    let inputs = result["run"]["inputs"].as_array().unwrap();
    assert!(
        inputs.iter().any(|i| i["role"] == "psf_capture"),
        "{result}"
    );
}
