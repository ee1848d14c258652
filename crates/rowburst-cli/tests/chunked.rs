//! Videos that are found part by part, and a range of bins alone.

mod common;

use common::Lab;
use ndarray::{ArrayView3, Axis, Slice};
use std::process::Stdio;
use std::time::{Duration, Instant};

const CAMERA: &str = "[camera]
rows = 24
columns = 20
shutter = \"dual-inside-out\"
row_time_us = 10
exposure_us = 10
";

fn simulated() -> Lab {
    let lab = Lab::empty();
    lab.experiment(CAMERA);
    lab.done("simulate experiment.toml --scene digits --digit-px 8 --seed 2 -o sim");
    lab
}

const FRAME: &str = "reconstruct sim/experiment.toml --frame sim/frame.npy";

/// With `τ` given, the parts together are the video of the whole.
#[test]
fn chunks_equal_the_whole_solve() {
    let lab = simulated();
    let how = "--prior tv+l1 --tau 1e-6 --noise-sigma 1e-4 --max-iterations 3000";
    lab.done(&format!("{FRAME} {how} -o whole"));
    let said = lab.done(&format!("{FRAME} {how} --part-bins 5 -o parts"));
    assert!(said.contains("in 3 chunks"), "{said}");
    let (whole, parts) = (lab.array("whole/video.npy"), lab.array("parts/video.npy"));
    assert_eq!(whole.dim(), parts.dim());
    let far = (&whole - &parts)
        .mapv(|d| f64::from(d).powi(2))
        .sum()
        .sqrt();
    let size = whole.mapv(|v| f64::from(v).powi(2)).sum().sqrt();
    assert!(far < 0.03 * size, "{far} of {size}");
    for name in ["report.html", "result.json", "video.mp4", "brightest.png"] {
        assert!(!lab.read(&format!("parts/{name}")).is_empty());
    }
    assert!(lab.files("parts").iter().all(|f| !f.contains("part")));
    let result = lab.result("parts");
    assert_eq!(result["frames"], 12);
    assert_eq!(result["parts"].as_array().unwrap().len(), 3);
    assert_eq!(result["parts"][2]["end_bin"], 12);
}

/// A range of bins is the part of these bins, whichever way.
#[test]
fn a_bin_range_equals_its_chunk() {
    let lab = simulated();
    let how = "--prior tv+support --noise-sigma 1e-4";
    lab.done(&format!("{FRAME} {how} --part-bins 4 -o parts"));
    lab.done(&format!("{FRAME} {how} --bins 4..8 -o range"));
    let (parts, range) = (lab.array("parts/video.npy"), lab.array("range/video.npy"));
    let of = |bins: std::ops::Range<usize>| -> ArrayView3<f32> {
        parts.slice_axis(Axis(0), Slice::from(bins))
    };
    assert_eq!(of(4..8), range);
    // Both at once.
    lab.done(&format!("{FRAME} {how} --bins 4..12 --part-bins 4 -o both"));
    assert_eq!(lab.array("both/video.npy"), of(4..12));
    assert_eq!(lab.result("both")["first_bin"], 4);
}

/// Exposures longer than a row and a prior over neighbouring bins couple the chunks: solved with their neighbours, they are
/// nearly the video of the whole.
#[test]
fn coupled_chunks_nearly_equal_the_whole_solve() {
    for (exposure_us, prior) in [(25, "tv+l1"), (40, "tv+l1"), (10, "tv+0.5*tdiff+l1")] {
        let lab = Lab::empty();
        lab.experiment(&format!(
            "[camera]\nrows = 72\ncolumns = 20\nshutter = \"top-down\"\nrow_time_us = 10\nexposure_us = {exposure_us}\n"
        ));
        lab.done("simulate experiment.toml --scene digits --digit-px 8 --seed 2 -o sim");
        let how = format!("--prior {prior} --tau 1e-6 --noise-sigma 1e-4 --max-iterations 2000");
        // Chunks keep all pixels and take the PSF as given.
        let alone = "--keep-all-pixels --self-calibrate off";
        lab.done(&format!("{FRAME} {how} {alone} -o whole"));
        lab.done(&format!("{FRAME} {how} --part-bins 20 -o parts"));
        let (whole, parts) = (lab.array("whole/video.npy"), lab.array("parts/video.npy"));
        assert_eq!(whole.dim(), parts.dim());
        let norm = |video: &ndarray::Array3<f32>| video.mapv(|v| f64::from(v).powi(2)).sum().sqrt();
        let error = norm(&(&whole - &parts)) / norm(&whole);
        println!("{exposure_us} µs, {prior}: relative error {error:.4}");
        assert!(error < 0.02, "{exposure_us} µs, {prior}: {error}");
        assert!(lab.files("parts").iter().all(|f| !f.contains("part")));
    }
}

/// Killed, the same command goes on, and ends with what it would have ended with.
#[test]
fn a_killed_run_resumes() {
    killed_and_resumed(CAMERA);
    // Chunks that fade into one another.
    killed_and_resumed(&CAMERA.replace("exposure_us = 10", "exposure_us = 25"));
}

fn killed_and_resumed(camera: &str) {
    let lab = Lab::empty();
    lab.experiment(camera);
    lab.done("simulate experiment.toml --scene digits --digit-px 8 --seed 2 -o sim");
    let how = "--prior tv+support --part-bins 1";
    lab.done(&format!("{FRAME} {how} -o calm"));
    let mut child = lab
        .command(&format!("{FRAME} {how} -o killed"))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let began = Instant::now();
    while !lab.path("killed/parts.json").exists() && !lab.path("killed/result.json").exists() {
        assert!(began.elapsed() < Duration::from_secs(60), "a part is found");
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    lab.done(&format!("{FRAME} {how} -o killed"));
    assert_eq!(lab.read("killed/video.npy"), lab.read("calm/video.npy"));
    // Another recipe begins anew.
    lab.done(&format!("{FRAME} {how} --noise-sigma 2e-4 -o killed"));
    assert_ne!(lab.read("killed/video.npy"), lab.read("calm/video.npy"));
}

#[test]
fn invalid_combinations_are_refused() {
    let lab = simulated();
    lab.write(
        "long.toml",
        CAMERA.replace("exposure_us = 10", "exposure_us = 25"),
    );
    let cases = [
        (
            format!("{FRAME} --prior tv+background --part-bins 4 -o x"),
            "couples all bins",
        ),
        (format!("{FRAME} --bins 4 -o x"), "FIRST..END"),
        (format!("{FRAME} --bins 4..99 -o x"), "0..12"),
        (
            format!("{FRAME} --truth sim/truth.npy --part-bins 4 -o x"),
            "--truth",
        ),
        (
            "reconstruct long.toml --frame sim/frame.npy --psf sim/psf.npy --bins 0..4 -o x".into(),
            "inside and outside",
        ),
    ];
    for (command, word) in cases {
        let output = lab.run(&command);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{command}: {said}");
        assert!(said.contains(word), "{command}: {said}");
        assert!(!lab.path("x").exists(), "{command}");
    }
}
