//! Formats and metadata on the whole road, from the file to result.json.
//! What other programs write is checked by `scripts/check_inputs.py`.

mod common;

use common::{COLUMNS, Lab, ROWS, pattern};
use serde_json::Value;

const QUICK: &str = "--prior tv --max-iterations 5";

/// `result.json` of the frame.
fn reconstruct(lab: &Lab, frame: &str) -> Value {
    let arguments = format!("reconstruct experiment.toml --frame {frame} {QUICK} --json -o out");
    serde_json::from_str(&lab.done(&arguments)).unwrap()
}

/// The message of a command that the user got wrong.
fn refused(lab: &Lab, arguments: &str) -> String {
    let output = lab.run(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{message}");
    message
}

/// An array of any type that numpy has, as `.npy`.
fn npy(lab: &Lab, name: &str, dtype: &str, shape: &str, data: &[u8]) {
    let text = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend(data);
    lab.write(name, bytes);
}

#[test]
fn signed_counts_end_at_the_top_of_their_type() {
    let lab = Lab::new();
    let shape = format!("{ROWS}, {COLUMNS}");
    for (dtype, top) in [("<i2", 32767), ("<u2", 65535), ("|i1", 127), ("|u1", 255)] {
        let count = |i: usize| match i {
            17 | 40 => top,
            _ => 20 + (60.0 * pattern(i / COLUMNS, i % COLUMNS)) as i32,
        };
        let width = if dtype.ends_with('1') { 1 } else { 2 };
        let counts = (0..ROWS * COLUMNS).map(count);
        let data: Vec<u8> = counts
            .flat_map(|v| v.to_le_bytes().into_iter().take(width))
            .collect();
        npy(&lab, "counts.npy", dtype, &shape, &data);
        let result = reconstruct(&lab, "counts.npy");
        assert_eq!(result["saturated_pixels"], 2, "{dtype}");
    }
}

#[test]
fn metadata_is_taken_over_and_contradictions_are_told() {
    let lab = Lab::new();
    let calibration = "[calibration]\npsf = \"psf.npy\"\n";
    let whole = reconstruct(&lab, "frame.npy");
    assert_eq!(whole["metadata"]["taken"].as_object().unwrap().len(), 0);
    let video = lab.read("out/video.npy");

    lab.write(
        "metadata.txt",
        format!(
            r#"{{"FrameKey-0-0-0": {{"ROI": "4-8-{COLUMNS}-{ROWS}", "Binning": 1, "Core-Camera": "Z",
            "Z-LightScanPlus-SensorReadoutMode": "Centre Out Simultaneous"}}}}"#
        ),
    );
    lab.experiment(&format!(
        "[camera]\nrow_time_us = 9.6\nexposure_us = 9.6\n{calibration}"
    ));
    let result = reconstruct(&lab, "frame.npy");
    assert_eq!(lab.read("out/video.npy"), video);
    assert_eq!(result["metadata"]["taken"]["rows"], "12");
    assert_eq!(
        result["metadata"]["taken"]["shutter"],
        "\"dual-inside-out\""
    );
    let report = String::from_utf8(lab.read("out/report.html")).unwrap();
    assert!(report.contains("from metadata"));
    lab.done(
        "reconstruct experiment.toml --frame frame.npy --prior tv+support --part-bins 3 -o parts",
    );
    let parts: Value = serde_json::from_slice(&lab.read("parts/result.json")).unwrap();
    assert_eq!(parts["metadata"], result["metadata"]);

    lab.write(
        "metadata.txt",
        r#"{"FrameKey-0-0-0": {"Exposure-ms": 0.02}}"#,
    );
    lab.experiment(&format!("{}{calibration}", common::CAMERA));
    let warnings = reconstruct(&lab, "frame.npy")["warnings"].to_string();
    assert!(warnings.contains("exposure_us is 9.6"), "{warnings}");
    assert!(
        warnings.contains("the experiment file takes precedence"),
        "{warnings}"
    );

    lab.write(
        "metadata.txt",
        r#"{"FrameKey-0-0-0": {"ROI": "0-0-10-16"}}"#,
    );
    let message = refused(&lab, "reconstruct experiment.toml --frame frame.npy -o out");
    assert!(message.contains("has 16 rows by its metadata"), "{message}");
}

#[test]
fn a_raw_bayer_frame_gives_a_video_in_colour() {
    let lab = Lab::new();
    let camera = common::CAMERA.to_string() + "bayer = \"grbg\"\n";
    lab.experiment(&format!("{camera}[calibration]\npsf = \"psf.npy\"\n"));
    let result = reconstruct(&lab, "frame.npy");
    let planes = result["planes"].as_array().unwrap();
    let names: Vec<&str> = planes.iter().map(|p| p["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["green-1", "green-2", "red", "blue"]);
    assert_eq!(
        (&result["rows"], &result["columns"]),
        (&6.into(), &5.into())
    );
    for name in names {
        assert!(lab.path(&format!("out/{name}/result.json")).exists());
        assert!(lab.path(&format!("out/{name}/report.html")).exists());
    }
    let colour: ndarray::Array4<f32> = ndarray_npy::read_npy(lab.path("out/colour.npy")).unwrap();
    let red: ndarray::Array3<f32> = ndarray_npy::read_npy(lab.path("out/red/video.npy")).unwrap();
    assert_eq!(colour.index_axis(ndarray::Axis(3), 0), red);
    assert_eq!(colour.shape()[3], 3);

    let wrong = "reconstruct experiment.toml --frame frame.npy -o wrong";
    for options in ["--region 1,1", "--sweep tau=1,2", "--truth frame.npy"] {
        let message = refused(&lab, &format!("{wrong} {options}"));
        let option = options.split(' ').next().unwrap();
        assert!(message.contains(option), "{message}");
    }
    lab.experiment(&camera.replace("grbg", "rgb"));
    let message = refused(&lab, wrong);
    assert!(message.contains("rggb, bggr, grbg, gbrg"), "{message}");
}
