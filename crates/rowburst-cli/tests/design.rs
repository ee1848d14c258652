//! `rowburst design`, run as a user runs it.

mod common;

use common::{CAMERA, Lab};
use serde_json::Value;

fn json(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}: {text}"))
}

fn number(value: &Value, key: &str) -> f64 {
    value[key]
        .as_f64()
        .unwrap_or_else(|| panic!("{key} in {value:#}"))
}

#[test]
fn the_defaults_are_the_paper() {
    let lab = Lab::empty();
    let found = json(&lab.done("design --quick --json"));
    assert_eq!(found["frames"], 54);
    assert_eq!(number(&found, "frame_rate_hz").floor(), 104_166.0);
    assert!((number(&found, "grain_px") - 2.5).abs() < 0.02);
    assert!((number(&found, "camera_frame_rate_hz") - 1893.9).abs() < 0.1);
    assert_eq!(number(&found, "measurements_per_bin"), 216.0);
    assert_eq!(found["reach_met"], true);
    assert_eq!(found["grain_sampled"], true);
    assert_eq!(found["success_map"], Value::Null);
    assert_eq!(found["sparsity_source"], "rule");
    let pixels = number(&found, "recoverable_pixels_per_bin");
    assert!((13.0..19.0).contains(&pixels), "{pixels}");
    assert_eq!(found["warnings"], json("[]"));
    let text = lab.done("design --no-map");
    for words in ["104167 fps", "54 frames", "nothing falls short"] {
        assert!(text.contains(words), "{words} in {text}");
    }
}

#[test]
fn unmet_requirements_have_a_remedy() {
    let lab = Lab::empty();
    for (arguments, words) in [
        (
            "--diffuser-deg 0.5",
            "diffuser too weak: at least 0.84° needed",
        ),
        ("--diffuser-deg 5", "stronger than needed: 0.84° would do"),
        ("--pupil-mm 4", "Stop the pupil down to 2.14 mm"),
        ("--photons 1e4", "too little light: SNR"),
        ("--photons 1e9", "pixels saturate"),
        ("--source-bandwidth-nm 100", "light too broad: 100 nm"),
        ("--bright-pixels 60", "scene too dense: 60"),
    ] {
        let text = lab.done(&format!("design --quick {arguments}"));
        assert!(text.contains(words), "{arguments}: {words} in\n{text}");
        let found = json(&lab.done(&format!("design --quick --json {arguments}")));
        let warnings = found["warnings"].as_array().unwrap();
        assert!(warnings.iter().any(|w| w.as_str().unwrap().contains(words)));
    }
}

#[test]
fn a_run_with_trials_writes_a_page() {
    let lab = Lab::empty();
    let run = "design --rows 36 --columns 40 --diffuser-deg 0.5 --photons 1e6 --seed 3 --json";
    let found = json(&lab.done(&format!("{run} -o out")));
    let files = lab.files("out");
    for name in [
        "colour.png",
        "design.json",
        "psf.png",
        "reach.png",
        "recoverable.png",
        "report.html",
        "snr.png",
        "success-map.png",
    ] {
        assert!(files.iter().any(|f| f == name), "{name} in {files:?}");
    }
    assert_eq!(
        json(&String::from_utf8(lab.read("out/design.json")).unwrap()),
        found
    );
    let html = String::from_utf8(lab.read("out/report.html")).unwrap();
    for words in [
        "104167 fps",
        "Recoverable",
        "m = C·k·ln(n/k)",
        "--diffuser-deg 0.5",
    ] {
        assert!(html.contains(words), "{words}");
    }

    let map = &found["success_map"];
    assert_eq!(found["sparsity_source"], "trials");
    assert_eq!(map["trials"], 18);
    let (ks, snrs) = (
        map["nonzero_pixels"].as_array().unwrap().len(),
        map["snr"].as_array().unwrap().len(),
    );
    let rows = map["success"].as_array().unwrap();
    assert_eq!(rows.len(), snrs);
    assert!(rows.iter().all(|r| r.as_array().unwrap().len() == ks));
    let half = map["half_success_pixels"].as_array().unwrap();
    assert!(half[snrs - 1].as_f64() >= half[0].as_f64());
    let pixels = number(&found, "recoverable_pixels_per_bin");
    assert!((2.0..20.0).contains(&pixels), "{pixels}");

    // The same seed gives the same numbers; without trials their pictures go.
    let again = json(&lab.done(&format!("{run} --quick -o out")));
    assert_eq!(again["snr_per_pixel"], found["snr_per_pixel"]);
    assert!(!lab.files("out").contains(&"success-map.png".to_string()));
}

#[test]
fn experiment_and_psf_are_used() {
    let lab = Lab::new();
    let field = "[field]\nrows = 20\ncolumns = 16\n";
    lab.experiment(&format!(
        "{CAMERA}gain_electrons_per_count = 0.5\nread_noise_electrons = 40\nfull_well_counts = 1000\n{field}"
    ));
    let of_file = json(&lab.done("design --experiment experiment.toml --quick --json"));
    assert_eq!(of_file["frames"], 6);
    assert_eq!(of_file["field_pixels"], 320);
    assert_eq!(of_file["reach_needed_px"], 15);
    assert_eq!(of_file["measured_grain_px"], Value::Null);
    assert_eq!(of_file["saturates"], true);
    let quiet = json(&lab.done(
        "design --experiment experiment.toml --read-noise-electrons 0 --full-well-electrons 1e9 --rows 20 --field-rows 24 --quick --json",
    ));
    assert_eq!(quiet["frames"], 10);
    assert_eq!(quiet["field_pixels"], 384);
    assert_eq!(quiet["saturates"], false);

    // A PSF of two rows' reach cannot light the far rows, whatever the optics promise.
    lab.image("narrow.npy", 5, 31, |y, x| ((3 * y + 5 * x) % 7) as f32);
    let narrow =
        json(&lab.done("design --experiment experiment.toml --psf narrow.npy --quick --json"));
    assert_eq!(number(&narrow, "reach"), 0.0);
    assert_eq!(narrow["reach_met"], false);
    assert!(narrow["measured_grain_px"].is_number());
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of bad inputs")]
fn bad_input_is_refused() {
    let lab = Lab::new();
    lab.write(
        "negative.toml",
        CAMERA.replace("exposure_us = 9.6", "exposure_us = -1"),
    );
    let cases: [(&str, [&str; 4]); 27] = [
        (
            "--na 1.2",
            ["--na", "1.200", "below 1", "stop the pupil down"],
        ),
        (
            "--pupil-mm 500",
            ["--pupil-mm", "4.787", "below 1", "same unit"],
        ),
        (
            "--na 0.02 --pupil-mm 2",
            ["--na", "--pupil-mm", "cannot be used", "--help"],
        ),
        ("--na -1", ["--na", "-1", "above zero", "Measure"]),
        (
            "--wavelength-nm 0",
            ["--wavelength-nm", "0", "above zero", "400 to 700"],
        ),
        (
            "--pupil-mm nan",
            ["--pupil-mm", "NaN", "above zero", "Measure"],
        ),
        (
            "--focal-length-mm -50",
            ["--focal-length-mm", "-50", "above zero", "Measure"],
        ),
        (
            "--magnification -1",
            ["--magnification", "-1", "zero or more", "size of the image"],
        ),
        (
            "--diffuser-deg 95",
            ["--diffuser-deg", "95", "below 90°", "data sheet"],
        ),
        (
            "--diffuser-deg 0.001",
            ["--diffuser-deg", "0.001", "5 grains", "larger angle"],
        ),
        (
            "--pixel-pitch-um 0",
            ["--pixel-pitch-um", "0", "above zero", "Leave"],
        ),
        (
            "--rows 0",
            ["--rows", "0", "at least one", "size of the frame"],
        ),
        (
            "--columns 999999",
            ["--columns", "999999", "at most 32768", "part of the sensor"],
        ),
        (
            "--row-time-us nan",
            ["--row-time-us", "NaN", "above zero", "data sheet"],
        ),
        (
            "--exposure-us 0",
            ["--exposure-us", "0", "above zero", "data sheet"],
        ),
        (
            "--exposure-us 1e9",
            [
                "--exposure-us",
                "1000000000",
                "ten times the readout",
                "shorten",
            ],
        ),
        (
            "--field-rows 50",
            ["--field-rows", "50×108", "at least as large", "108×108"],
        ),
        (
            "--shutter sideways",
            ["--shutter", "sideways", "top-down", "Check the name"],
        ),
        ("--photons 0", ["--photons", "0", "above zero", "2e7"]),
        (
            "--bright-pixels 0",
            ["--bright-pixels", "0", "at least one", "such as 10"],
        ),
        (
            "--quantum-efficiency 60",
            ["--quantum-efficiency", "60", "at most at 1", "0.6 for 60 %"],
        ),
        (
            "--read-noise-electrons -1",
            ["--read-noise-electrons", "-1", "zero or more", "calibrate"],
        ),
        (
            "--bit-depth 99",
            ["--bit-depth", "99", "1 to 32", "8, 12 or 16"],
        ),
        (
            "--source-bandwidth-nm 900",
            ["--source-bandwidth-nm", "900", "smaller than", "nanometres"],
        ),
        ("--psf missing.tif", ["missing.tif", "", "", ""]),
        ("--experiment missing.toml", ["missing.toml", "", "", ""]),
        (
            "--experiment negative.toml",
            [
                "negative.toml: exposure_us",
                "-1",
                "above zero",
                "data sheet",
            ],
        ),
    ];
    let mut faults = Vec::new();
    for (arguments, says) in cases {
        let output = lab.run(&format!("design --quick -o out {arguments}"));
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        println!("{arguments}\n    {}", text.trim_end());
        if output.status.code() != Some(2) || text.contains("panicked") {
            faults.push(format!("{arguments}: {}", output.status));
        }
        for words in says.iter().filter(|words| !text.contains(**words)) {
            faults.push(format!("{arguments}: lacks \"{words}\" in {text}"));
        }
        if !output.stdout.is_empty() || !lab.files("out").is_empty() {
            faults.push(format!("{arguments}: left something behind"));
        }
    }
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
    let file = lab.run("design --quick -o frame.npy");
    assert_eq!(file.status.code(), Some(2));
}
