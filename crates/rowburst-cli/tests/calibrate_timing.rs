//! `rowburst calibrate timing`, run as a user runs it.

mod common;

use common::{Lab, pattern};
use serde_json::Value;
use std::path::Path;

const ROW_TIME_US: f64 = 9.6;
const EXPOSURE_US: f64 = 80.0;

/// `∫` of a square wave of 1 kHz that is on for the first half of its period.
fn square(t: f64) -> f64 {
    let t = t / 1000.0;
    1000.0 * (0.5 * t.floor() + (t - t.floor()).min(0.5))
}

/// Writes a frame of 8 columns: row `r` saw the light between `time(r)` and an exposure
/// before it, `until` being the light's integral; SNR about 40.
fn frame(lab: &Lab, name: &str, rows: usize, time: impl Fn(usize) -> f64, until: fn(f64) -> f64) {
    lab.image(name, rows, 8, |y, x| {
        let end = time(y);
        let light = (until(end) - until(end - EXPOSURE_US)) / EXPOSURE_US;
        let lamp = 1.0 - 0.3 * (y as f64 / rows as f64 - 0.4).powi(2);
        (200.0 * lamp * light + 20.0) as f32 + 10.0 * (pattern(y, x) - 0.5)
    });
}

fn inside_out(rows: usize) -> impl Fn(usize) -> f64 {
    let half = rows / 2;
    move |r| 130.0 + ROW_TIME_US * if r < half { half - 1 - r } else { r - half } as f64
}

fn json(lab: &Lab, arguments: &str) -> Value {
    serde_json::from_str(&lab.done(arguments)).unwrap()
}

fn near(value: &Value, want: f64, relative: f64) {
    let got = value
        .as_f64()
        .unwrap_or_else(|| panic!("{value} for {want}"));
    assert!((got / want - 1.0).abs() < relative, "{got} for {want}");
}

#[test]
fn a_square_wave_fills_the_experiment_in() {
    let lab = Lab::empty();
    frame(&lab, "led.tif", 1200, inside_out(1200), square);
    lab.experiment(
        "[camera]\nrows = 1200\ncolumns = 8\nshutter = \"dual-inside-out\"\nrow_time_us = 9\nexposure_us = 9\n",
    );
    let arguments =
        "calibrate timing led.tif --frequency-hz 1000 --experiment experiment.toml --json -o out";
    let result = json(&lab, arguments);
    near(&result["row_time_us"], ROW_TIME_US, 2e-3);
    assert!(result["row_time_us_error"].as_f64().unwrap() < 0.02);
    assert_eq!(result["shutters"].as_array().unwrap().len(), 2);
    for shutter in ["dual-inside-out", "dual-outside-in"] {
        assert!(
            result["shutters"]
                .as_array()
                .unwrap()
                .contains(&shutter.into())
        );
    }
    near(&result["exposure_us"], EXPOSURE_US, 0.05);
    assert!(result["advice"].as_str().unwrap().contains("chirp"));
    assert!(
        result["warnings"]
            .to_string()
            .contains("not the expected 9 µs")
    );

    let written: Value = serde_json::from_slice(&lab.read("out/timing.json")).unwrap();
    assert_eq!(written, result);
    let experiment = rowburst_io::Experiment::read(&lab.path("out/experiment.toml")).unwrap();
    let camera = experiment.camera().unwrap();
    assert_eq!(
        camera.params().row_time_us,
        result["row_time_us"].as_f64().unwrap()
    );
    assert_eq!(
        camera.params().exposure_us,
        result["exposure_us"].as_f64().unwrap()
    );
    assert_eq!(camera.shutter().name(), "dual-inside-out");
    let page = String::from_utf8(lab.read("out/report.html")).unwrap();
    assert!(
        page.contains("dual-inside-out or") && page.contains("rowburst calibrate timing led.tif")
    );
    assert_eq!(
        lab.files("out"),
        [
            "candidates.png",
            "experiment.toml",
            "periodogram.png",
            "report.html",
            "rows-middle.png",
            "rows.png",
            "timing.json"
        ]
    );
}

/// `∫` of two pulses, the first longer.
fn pulses(t: f64) -> f64 {
    (t - 300.0).clamp(0.0, 900.0) + (t - 2800.0).clamp(0.0, 300.0)
}

#[test]
fn an_unequal_double_pulse_decides_the_direction() {
    let lab = Lab::empty();
    let up = |r: usize| ROW_TIME_US * (511 - r) as f64;
    frame(&lab, "pulses.npy", 512, up, pulses);
    lab.write(
        "pulses.csv",
        "time_us,value\n# two pulses\n0,0\n0,1\n900,1\n900,0\n2500,0\n2500,1\n2800,1\n2800,0\n3000,0\n",
    );
    let result = json(
        &lab,
        "calibrate timing pulses.npy --signal pulses.csv --json",
    );
    assert_eq!(result["shutters"].to_string(), "[\"bottom-up\"]");
    near(&result["row_time_us"], ROW_TIME_US, 2e-3);
    near(&result["exposure_us"], EXPOSURE_US, 0.1);
    assert_eq!(result["advice"], Value::Null);
    let text = lab.done("calibrate timing pulses.npy --signal pulses.csv");
    assert!(text.contains("shutter   bottom-up"), "{text}");
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of bad inputs")]
fn bad_input_names_what_to_do() {
    let lab = Lab::empty();
    let down = |r: usize| ROW_TIME_US * r as f64;
    frame(&lab, "led.npy", 512, down, square);
    frame(&lab, "short.npy", 200, down, square);
    frame(&lab, "other.npy", 512, |r| 17.0 * r as f64, square);
    frame(&lab, "still.npy", 512, down, |t| t);
    lab.image("narrow.npy", 512, 5, |_, _| 1.0);
    lab.image("black.npy", 512, 8, |_, _| 0.0);
    lab.image(
        "nan.npy",
        512,
        8,
        |y, _| if y == 3 { f32::NAN } else { 1.0 },
    );
    lab.write("bad.csv", "time_us,value\n0,0\n1,x\n");
    lab.write("back.csv", "0,0\n5,1\n3,0\n");
    lab.write("slow.csv", "0,0\n1e9,1\n2e9,1\n");
    lab.write("pulses.csv", "0,0\n0,1\n900,1\n900,0\n2500,0\n");
    lab.experiment(
        "[camera]\nrows = 512\ncolumns = 8\nshutter = \"top-down\"\nrow_time_us = 9.6\nexposure_us = 9.6\n",
    );
    let cases = [
        ("led.npy", "", "--frequency-hz"),
        ("led.npy", "--frequency-hz 0", "--frequency-hz"),
        ("led.npy", "--frequency-hz -5", "above zero"),
        ("led.npy", "--frequency-hz nan", "above zero"),
        ("led.npy", "--frequency-hz 1000 --duty 1.5", "--duty"),
        (
            "led.npy",
            "--frequency-hz 1000 --signal bad.csv",
            "cannot be used with",
        ),
        (
            "led.npy",
            "--frequency-hz 1000 --repeat",
            "cannot be used with",
        ),
        ("short.npy", "--frequency-hz 1000", "periods of the light"),
        ("still.npy", "--frequency-hz 1000", "no stripes"),
        (
            "led.npy other.npy",
            "--frequency-hz 1000",
            "other.npy: found row times that disagree",
        ),
        (
            "led.npy narrow.npy",
            "--frequency-hz 1000",
            "narrow.npy: found 512×5",
        ),
        (
            "led.npy",
            "--frequency-hz 1000 --dark narrow.npy",
            "narrow.npy",
        ),
        (
            "led.npy",
            "--frequency-hz 1000 --dark led.npy",
            "above the dark",
        ),
        (
            "led.npy",
            "--frequency-hz 1000 --flat black.npy",
            "no brighter than the dark",
        ),
        ("black.npy", "--frequency-hz 1000", "lamp lights the sensor"),
        ("nan.npy", "--frequency-hz 1000", "row 3, column 0"),
        ("gone.npy", "--frequency-hz 1000", "gone.npy"),
        (
            "led.npy",
            "--frequency-hz 80000 --experiment experiment.toml",
            "two row times",
        ),
        ("led.npy", "--signal bad.csv", "bad.csv, line 3"),
        ("led.npy", "--signal back.csv", "never go back"),
        ("led.npy", "--signal gone.csv", "gone.csv"),
        (
            "led.npy",
            "--signal slow.csv",
            "Shorten it to the time around",
        ),
        ("still.npy", "--signal pulses.csv", "a signal that explains"),
    ];
    for (frames, options, words) in cases {
        let arguments = format!("calibrate timing {frames} {options}");
        let output = lab.run(&arguments);
        let talk = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments}: {talk}");
        assert!(talk.contains(words), "{arguments}: {talk}");
        assert!(output.stdout.is_empty(), "{arguments}");
    }
}

#[test]
fn the_help_has_examples() {
    let lab = Lab::empty();
    let help = lab.done("calibrate timing --help");
    assert!(
        help.contains("rowburst calibrate timing led.png --frequency-hz 1000"),
        "{help}"
    );
}

/// Nikon 1 J1, 1000 Hz: the published readout of a frame is 15.73 ms.
#[test]
fn a_real_led_is_read() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared/data/led-rolling-shutter/frame_example.png");
    if !data.exists() {
        println!("skipped: {} is not here", data.display());
        return;
    }
    let lab = Lab::empty();
    let arguments = format!(
        "calibrate timing {} --frequency-hz 1000 --json",
        data.display()
    );
    let result = json(&lab, &arguments);
    near(&result["readout_ms"], 15.73, 5e-3);
    assert_eq!(
        result["shutters"].to_string(),
        "[\"top-down\",\"bottom-up\"]"
    );
}
