//! Traces as a user gets them: traces.csv, result.json, photodiodes, --debias.

mod common;

use common::Lab;

const CAMERA: &str = "[camera]
rows = 40
columns = 40
shutter = \"dual-inside-out\"
row_time_us = 9.6
exposure_us = 9.6
pixel_pitch_um = 6.5
";

fn leds() -> Lab {
    let lab = Lab::empty();
    lab.experiment(CAMERA);
    lab.done("simulate experiment.toml --scene leds --diffuser-deg 0.4 -o sim");
    lab
}

const RECONSTRUCT: &str =
    "reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy";

#[test]
fn traces_have_errors_and_photodiodes_find_their_leds() {
    let lab = leds();
    let diode = String::from_utf8(lab.read("sim/photodiode-1.csv")).unwrap();
    assert_eq!(diode.lines().next(), Some("time_us,value"));
    assert_eq!(diode.lines().count(), 1 + 20 * 20);
    let said = lab.done(&format!(
        "{RECONSTRUCT} --region 5,6,4,3 --photodiode sim/photodiode-1.csv --photodiode sim/photodiode-2.csv --debias -o out"
    ));
    assert!(said.contains("photodiode-1.csv: correlation"), "{said}");
    assert!(said.contains("debiased: total light"), "{said}");
    let result = lab.result("out");
    let traces = result["traces"].as_array().unwrap();
    assert_eq!(traces[0]["region"]["y"], 5);
    assert_eq!(traces[0]["region"]["columns"], 3);
    let mut laid = 0;
    for trace in traces {
        assert!(
            trace["mean_standard_error"].as_f64().unwrap() > 0.0,
            "{trace:#}"
        );
        if let Some(r) = trace["photodiode_correlation"].as_f64() {
            assert!(r > 0.9, "{trace:#}");
            laid += trace["photodiodes"].as_array().unwrap().len();
        }
    }
    assert_eq!(laid, 2);
    // Another video: without the pull of the prior, and noisier.
    let before = result["debias"]["psnr_db_before"].as_f64().unwrap();
    let change = lab.number("out", "psnr_db") - before;
    assert!(change != 0.0 && change > -3.0, "{before} dB {change:+}");
    let table = String::from_utf8(lab.read("out/traces.csv")).unwrap();
    let heading: Vec<&str> = table.lines().next().unwrap().split(',').collect();
    assert_eq!(heading.len(), 1 + 4 * traces.len());
    assert_eq!(
        heading[..5],
        [
            "time_us",
            "y5_x6_4x3_value",
            "y5_x6_4x3_debiased",
            "y5_x6_4x3_standard_error",
            "y5_x6_4x3_before_debias"
        ]
    );
    // The value is that of the video that is written.
    let video = lab.array("out/video.npy");
    for (t, line) in table.lines().skip(1).enumerate() {
        let value: f64 = line.split(',').nth(1).unwrap().parse().unwrap();
        let pixels = (5..9).flat_map(|y| (6..9).map(move |x| [t, y, x]));
        let mean = pixels.map(|at| f64::from(video[at])).sum::<f64>() / 12.0;
        let limit = 1e-6 * mean.abs() + 1e-12;
        assert!((value - mean).abs() <= limit, "bin {t}: {value} {mean}");
    }
    assert_eq!(table.lines().count(), 1 + 20);
    assert!(table.lines().nth(1).unwrap().starts_with("4.8,"));
    let page = String::from_utf8(lab.read("out/report.html")).unwrap();
    assert!(page.contains("95 % confidence intervals") && page.contains("photodiode-1.csv over"));
    assert!(page.contains("--region 5,6,4,3 --photodiode sim/photodiode-1.csv"));
}

#[test]
fn long_exposures_have_errors_too() {
    let lab = Lab::empty();
    lab.experiment(&CAMERA.replace("exposure_us = 9.6", "exposure_us = 24"));
    lab.done("simulate experiment.toml --scene moving --digit-px 8 -o sim");
    let said = lab.done(&format!("{RECONSTRUCT} --debias -o out"));
    assert!(said.contains("debiased: total light"), "{said}");
    let result = lab.result("out");
    assert!(result["trace_errors"]["missing_because"].is_null());
    let error = result["traces"][0]["mean_standard_error"].as_f64().unwrap();
    assert!(error > 0.0, "{error}");
    assert_eq!(result["debias"]["untouched_bins"], 0);
}

#[test]
fn errors_that_are_not_known_are_left_empty() {
    let lab = Lab::empty();
    lab.experiment(&CAMERA.replace("exposure_us = 9.6", "exposure_us = 24"));
    lab.done("simulate experiment.toml --scene still -o sim");
    lab.done(&format!(
        "{RECONSTRUCT} --prior tv+2*tdiff --max-iterations 40 --debias -o out"
    ));
    let result = lab.result("out");
    let why = result["trace_errors"]["missing_because"].as_str().unwrap();
    assert!(why.contains("lit voxels"), "{why}");
    assert!(result["traces"][0]["mean_standard_error"].is_null());
    let warnings = result["warnings"].to_string();
    assert!(warnings.contains("debiasing had no effect"), "{warnings}");
    let table = String::from_utf8(lab.read("out/traces.csv")).unwrap();
    assert!(table.lines().nth(1).unwrap().ends_with(','), "{table}");
}

/// Without a prior the video would follow what is wrong with the model.
#[test]
fn a_wrong_psf_is_not_debiased() {
    let lab = Lab::empty();
    lab.experiment(CAMERA);
    lab.done("simulate experiment.toml --scene moving --digit-px 8 -o sim");
    let psf: ndarray::Array2<f32> = ndarray_npy::read_npy(lab.path("sim/psf.npy")).unwrap();
    let (rows, columns) = psf.dim();
    lab.image("mirrored.npy", rows, columns, |y, x| {
        psf[[y, columns - 1 - x]]
    });
    lab.done(&format!("{RECONSTRUCT} --psf mirrored.npy --debias -o out"));
    let result = lab.result("out");
    assert!(result["debias"].is_null(), "{}", result["debias"]);
    let warnings = result["warnings"].to_string();
    assert!(
        warnings.contains("debiasing had no effect: the "),
        "{warnings}"
    );
}

#[test]
fn bad_regions_and_photodiodes_are_refused() {
    let lab = Lab::new();
    lab.write("bad.csv", "time_us,value\n0,1\n1,x\n");
    let run = "reconstruct experiment.toml --frame frame.npy -o out";
    for (arguments, words) in [
        ("--region 12,0", "rows are 0 to 11"),
        ("--region 1,2,3", "two or four"),
        ("--region 0,8,2,3", "lies in the field"),
        ("--region a,b", "\"a,b\""),
        ("--photodiode bad.csv", "bad.csv: line 3"),
        ("--photodiode none.csv", "no such file"),
    ] {
        let output = lab.run(&format!("{run} {arguments}"));
        assert_eq!(output.status.code(), Some(2), "{arguments}");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.contains(words), "{arguments}: {said}");
        assert!(!lab.path("out").exists(), "{arguments}");
    }
}
