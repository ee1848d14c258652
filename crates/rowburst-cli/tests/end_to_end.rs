//! The whole road as a user walks it: simulate, reconstruct, look at the files.

mod common;

use common::{Lab, pattern};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Files of every result.
const FILES: [&str; 5] = [
    "video.npy",
    "video.tif",
    "video.mp4",
    "report.html",
    "result.json",
];

/// A camera of 24 × 20 pixels.
const SMALL: &str = "[camera]
rows = 24
columns = 20
shutter = \"dual-inside-out\"
row_time_us = 10
exposure_us = 10
";

fn small(text: &str) -> Lab {
    let lab = Lab::empty();
    lab.experiment(text);
    lab
}

fn has_all_files(lab: &Lab, out: &str) {
    let files = lab.files(out);
    for name in FILES {
        assert!(files.iter().any(|file| file == name), "{name} in {files:?}");
        assert!(!lab.read(&format!("{out}/{name}")).is_empty(), "{name}");
    }
    assert!(
        files.iter().all(|file| !file.ends_with(".part")),
        "half-written files in {files:?}"
    );
}

/// Every key that is promised, with the kind of value that it has.
fn has_all_keys(result: &Value, with_truth: bool) {
    let text: fn(&Value) -> bool = Value::is_string;
    let whole: fn(&Value) -> bool = Value::is_u64;
    let number: fn(&Value) -> bool = |v| v.as_f64().is_some_and(f64::is_finite);
    let keys = [
        ("version", text),
        ("prior", text),
        ("tau", number),
        ("noise_sigma", number),
        ("residual_over_sigma", number),
        ("fit", text),
        ("fit_reason", text),
        ("iterations", whole),
        ("stop_reason", text),
        ("seconds", number),
        ("setup_seconds", number),
        ("frames", whole),
        ("frame_rate_hz", number),
        ("threads", whole),
        ("seed", whole),
    ];
    for (key, kind) in keys {
        assert!(kind(&result[key]), "{key} in {result:#}");
    }
    for key in ["chi_squared", "freedom", "residual_over_frame"] {
        assert!(
            number(&result["fit_statistics"][key]),
            "{key} in {result:#}"
        );
    }
    let memory = &result["peak_memory_bytes"];
    assert!(
        whole(memory) || (memory.is_null() && !cfg!(target_os = "linux")),
        "{result:#}"
    );
    for key in ["psnr_db", "ssim"] {
        assert_eq!(number(&result[key]), with_truth, "{key} in {result:#}");
    }
}

/// The course of the run: clocks that go forward from the start of the process, and an end near the
/// result.
fn has_a_history(result: &Value, with_truth: bool) {
    let points = result["history"].as_array().expect("a list");
    let number = |point: &Value, key: &str| point[key].as_f64();
    let seconds: Vec<f64> = (points.iter().map(|p| number(p, "seconds").unwrap())).collect();
    let iterations: Vec<u64> = points
        .iter()
        .map(|p| p["iteration"].as_u64().unwrap())
        .collect();
    assert_eq!(iterations[0], 1);
    assert!(
        iterations.is_sorted_by(|a, b| a < b),
        "{iterations:?} increases"
    );
    assert!(seconds.is_sorted_by(|a, b| a < b), "{seconds:?} increases");
    let (setup, solving) = (
        &result["setup_seconds"],
        result["seconds"].as_f64().unwrap(),
    );
    let (first, last) = (seconds[0], seconds[seconds.len() - 1]);
    assert!(first > setup.as_f64().unwrap(), "{first} s, set-up {setup}");
    assert!(last - first <= solving, "{first} to {last}, {solving} s");
    let end = &points[points.len() - 1];
    assert!(number(end, "residual_over_sigma").is_some(), "{end}");
    assert_eq!(number(end, "psnr_db").is_some(), with_truth, "{end}");
    if let (Some(last), Some(final_db)) = (number(end, "psnr_db"), result["psnr_db"].as_f64()) {
        assert!(
            (last - final_db).abs() < 0.5,
            "{last} dB, then {final_db} dB"
        );
        assert!(
            number(&points[0], "psnr_db").unwrap() < final_db,
            "it gains by iterating"
        );
    }
}

/// Runs the demo of `scene` and gives its PSNR.
fn demo(scene: &str) -> f64 {
    let lab = Lab::empty();
    let said = lab.done(&format!("demo --scene {scene} -o out"));
    let report = std::path::Path::new("out").join("report.html");
    for word in ["PSNR", "SSIM", &report.to_string_lossy()] {
        assert!(said.contains(word), "{word} in {said}");
    }
    has_all_files(&lab, "out");
    for name in ["experiment.toml", "frame.npy", "psf.npy", "truth.npy"] {
        assert!(lab.path("out").join(name).exists(), "{name}");
    }
    let result = lab.result("out");
    has_all_keys(&result, true);
    has_a_history(&result, true);
    assert_eq!(result["fit"], "good", "{result:#}");
    assert!(said.contains("the fit is good"), "{said}");
    let page = String::from_utf8(lab.read("out/report.html")).unwrap();
    assert!(page.contains("Fit: good. "), "the report says it");
    assert!(
        page.contains("id=\"rowburst-data\"") && page.contains("script-src 'sha256-"),
        "the viewer's page is in the report"
    );
    assert_eq!(result["frames"], 54);
    assert_eq!(lab.array("out/video.npy").shape(), [54, 108, 108]);
    assert!((result["frame_rate_hz"].as_f64().unwrap() - 104_166.7).abs() < 1.0);
    lab.number("out", "psnr_db")
}

#[test]
fn demo_of_the_digits() {
    let psnr = demo("digits");
    assert!(psnr > 44.0, "{psnr} dB");
}

#[test]
fn demo_of_the_leds() {
    let psnr = demo("leds");
    assert!(psnr > 55.0, "{psnr} dB");
}

#[test]
fn demo_of_the_moving_digit() {
    let psnr = demo("moving");
    assert!(psnr > 43.0, "{psnr} dB");
}

#[test]
fn every_shutter() {
    // (shutter, instants of 24 rows)
    let shutters = [
        ("top-down", 24),
        ("bottom-up", 24),
        ("dual-inside-out", 12),
        ("dual-outside-in", 12),
        ("custom", 8),
        ("global", 1),
    ];
    for (shutter, instants) in shutters {
        let lab = Lab::empty();
        let order = match shutter {
            "custom" => {
                // Three rows at once, from the bottom.
                let order: Vec<i64> = (0..24).map(|r| 7 - r / 3).collect();
                lab.order("order.npy", &order);
                "row_order = \"order.npy\"\n"
            }
            _ => "",
        };
        let camera = SMALL
            .replace("dual-inside-out", shutter)
            .replace("exposure_us = 10", "exposure_us = 25");
        lab.experiment(&format!(
            "{camera}{order}bins_per_row = 2\n[field]\nrows = 31\ncolumns = 26\n"
        ));
        lab.done("simulate experiment.toml --scene moving --digit-px 8 -o sim");
        lab.done(
            "reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy -o out",
        );
        // An exposure of 2.5 row times begins in the third instant back from its end.
        let bins = if shutter == "global" {
            1
        } else {
            (instants + 2) * 2
        };
        for name in ["sim/truth.npy", "out/video.npy"] {
            assert_eq!(lab.array(name).shape(), [bins, 31, 26], "{shutter} {name}");
        }
        let video = lab.array("out/video.npy");
        assert!(
            video.iter().all(|v| v.is_finite() && *v >= 0.0),
            "{shutter}"
        );
        assert!(video.iter().any(|v| *v > 0.0), "{shutter}");
        has_all_files(&lab, "out");
        has_all_keys(&lab.result("out"), true);
        assert_eq!(lab.result("out")["frames"], bins);
        let rate = if shutter == "global" { 40e3 } else { 200e3 };
        assert!(
            (lab.number("out", "frame_rate_hz") / rate - 1.0).abs() < 1e-9,
            "{shutter}"
        );
        let psnr = lab.number("out", "psnr_db");
        assert!(psnr > 20.0, "{shutter}: {psnr} dB");
        let misfit = lab.number("out", "residual_over_sigma");
        assert!(
            (0.3..1.5).contains(&misfit),
            "{shutter}: residual/σ {misfit}"
        );
    }
}

#[test]
fn a_seed_gives_the_same_bytes() {
    let lab = small(SMALL);
    let simulate = |more: &str, out: &str| {
        lab.done(&format!(
            "simulate experiment.toml --scene digits --digit-px 8 {more} -o {out}"
        ));
    };
    simulate("--seed 5", "a");
    simulate("--seed 5", "b");
    simulate("--seed 6", "c");
    for name in ["frame.npy", "psf.npy", "truth.npy"] {
        let read = |out: &str| lab.read(&format!("{out}/{name}"));
        assert_eq!(read("a"), read("b"), "{name}");
        assert_ne!(read("a"), read("c"), "{name}");
    }
    // Without noise the frame is another, the scene and the PSF are the same.
    simulate("--seed 5 --snr inf", "clean");
    assert_eq!(lab.read("a/truth.npy"), lab.read("clean/truth.npy"));
    assert_ne!(lab.read("a/frame.npy"), lab.read("clean/frame.npy"));
    let notes: Value = serde_json::from_slice(&lab.read("clean/simulation.json")).unwrap();
    assert_eq!(notes["noise_sigma"], 0.0, "{notes:#}");

    let reconstruct = |out: &str| {
        lab.done(&format!(
            "reconstruct a/experiment.toml --frame a/frame.npy -o {out}"
        ));
        lab.read(&format!("{out}/video.npy"))
    };
    assert_eq!(reconstruct("first"), reconstruct("second"));
    has_all_keys(&lab.result("first"), false);
    has_a_history(&lab.result("first"), false);
}

#[test]
fn a_frame_without_noise() {
    let lab = small(SMALL);
    lab.done("simulate experiment.toml --scene moving --digit-px 8 --snr inf -o sim");
    lab.done("reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy -o out");
    has_all_keys(&lab.result("out"), true);
}

/// The demo's camera: big enough to be stopped on the way.
const PAPER: &str = "[camera]
rows = 108
columns = 108
shutter = \"dual-inside-out\"
row_time_us = 9.6
exposure_us = 9.6
";

#[test]
fn a_time_budget_stops_and_writes() {
    let lab = small(PAPER);
    lab.done("simulate experiment.toml --scene digits -o sim");
    lab.done(
        "reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy \
         --time-budget-s 0.05 -o out",
    );
    has_all_files(&lab, "out");
    let result = lab.result("out");
    has_all_keys(&result, true);
    assert_eq!(result["stop_reason"], "time-budget", "{result:#}");
    assert_eq!(result["fit"], "suspicious", "{result:#}");
    let reason = result["fit_reason"].as_str().unwrap();
    assert!(reason.starts_with("stopped early"), "{reason}");
    assert_eq!(lab.array("out/video.npy").shape(), [54, 108, 108]);
}

/// A reconstruction that goes on until Ctrl-C, sent when its log has the line `moment`. Returns the exit status, the time
/// from Ctrl-C to the end, and what was printed.
#[cfg(target_os = "linux")]
fn interrupted(lab: &Lab, arguments: &str, moment: &str) -> (Option<i32>, Duration, String) {
    let mut child = lab
        .command(&format!("--verbose reconstruct {arguments}"))
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut log = BufReader::new(child.stderr.take().unwrap()).lines();
    let found = log.any(|line| line.unwrap().contains(moment));
    assert!(found, "the log has no {moment}");
    let sent = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(sent.unwrap().success());
    let begun = Instant::now();
    let rest: Vec<String> = log.map(Result::unwrap).collect();
    let output = child.wait_with_output().unwrap();
    let elapsed = begun.elapsed();
    let printed = String::from_utf8(output.stdout).unwrap();
    (output.status.code(), elapsed, rest.join("\n") + &printed)
}

#[cfg(target_os = "linux")]
#[test]
fn ctrl_c_writes_the_best_so_far() {
    let lab = small(PAPER);
    lab.done("simulate experiment.toml --scene digits -o sim");
    let arguments =
        "sim/experiment.toml --frame sim/frame.npy --max-iterations 1000000 --json -o out";
    let (status, _, text) = interrupted(&lab, arguments, "final run: prior");
    assert_eq!(status, Some(130), "{text}");
    assert!(
        text.contains("the current result will be written"),
        "{text}"
    );
    // No report and no movie: they take longer than a second.
    let files = lab.files("out");
    for name in ["video.npy", "traces.csv", "view.json", "result.json"] {
        assert!(files.iter().any(|file| file == name), "{name} of {files:?}");
    }
    for name in ["report.html", "video.mp4", "video.tif"] {
        assert!(files.iter().all(|file| file != name), "{name} of {files:?}");
    }
    let result = lab.result("out");
    has_all_keys(&result, false);
    assert_eq!(result["stop_reason"], "interrupted", "{result:#}");
    let printed: Value = serde_json::from_str(&text[text.find("{\n").unwrap()..]).unwrap();
    assert_eq!(printed, result);
}

/// After the check and after the last iteration a run ends within a second, with a video.
#[cfg(target_os = "linux")]
#[test]
fn ctrl_c_ends_a_large_run_within_a_second() {
    let lab = Lab::empty();
    lab.experiment(
        "[camera]\nrows = 256\ncolumns = 256\nshutter = \"dual-inside-out\"\nrow_time_us = 9.6\nexposure_us = 9.6\n",
    );
    lab.done("simulate experiment.toml --scene digits -o sim");
    lab.done("simulate experiment.toml --scene digits --seed 2 -o other");
    let prior = "--prior tv+0.5*tdiff+support";
    // With the PSF of another diffuser searches follow the check.
    let searching = "--psf other/psf.npy";
    let short = "--self-calibrate off --keep-all-pixels --max-iterations 30";
    let moments = [("check of the model", searching), ("iterations, ", short)];
    for (i, (moment, options)) in moments.into_iter().enumerate() {
        let arguments =
            format!("sim/experiment.toml --frame sim/frame.npy {prior} {options} -o out{i}");
        let (status, elapsed, text) = interrupted(&lab, &arguments, moment);
        assert_eq!(status, Some(130), "{moment}: {text}");
        // A second, and what other work on this machine adds.
        assert!(elapsed < Duration::from_secs(2), "{moment}: {elapsed:?}");
        println!("{moment}: {elapsed:?}");
        let out = format!("out{i}");
        assert!(lab.number(&out, "iterations") >= 20.0, "{moment}");
        assert!(
            lab.array(&format!("{out}/video.npy"))
                .iter()
                .any(|v| *v > 0.0)
        );
        assert!(!lab.files(&out).contains(&"report.html".to_string()));
    }
}

/// A set-up that takes many seconds ends at once, and leaves nothing.
#[cfg(target_os = "linux")]
#[test]
fn ctrl_c_ends_a_set_up_at_once() {
    let lab = Lab::empty();
    lab.experiment(
        "[camera]\nrows = 512\ncolumns = 512\nshutter = \"dual-inside-out\"\nrow_time_us = 9.6\nexposure_us = 9.6\n",
    );
    lab.image("frame.npy", 512, 512, |y, x| 100.0 + 50.0 * pattern(y, x));
    lab.image("psf.npy", 301, 301, |y, x| pattern(y + 600, x).powi(2));
    let arguments = "experiment.toml --frame frame.npy --psf psf.npy -o out";
    let (status, elapsed, text) = interrupted(&lab, arguments, "set up the operator");
    assert_eq!(status, Some(130), "{text}");
    // A second, and what other work on this machine adds.
    assert!(elapsed < Duration::from_secs(2), "{elapsed:?}");
    assert!(lab.files("out").is_empty());
}

#[test]
fn json_is_all_that_is_printed() {
    let lab = Lab::new();
    let printed = lab.done("reconstruct experiment.toml --frame frame.npy --json -o out");
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(printed, lab.result("out"));
    has_all_keys(&printed, false);
}

#[test]
fn help_has_an_example() {
    let lab = Lab::empty();
    for verb in ["demo", "simulate", "reconstruct"] {
        let help = lab.done(&format!("{verb} --help"));
        assert!(help.contains("Example:"), "{help}");
        assert!(help.contains(&format!("\n  rowburst {verb} ")), "{help}");
    }
    let help = lab.done("--help");
    for verb in ["demo", "simulate", "reconstruct"] {
        assert!(help.contains(verb), "{help}");
    }
    assert!(lab.done("--version").starts_with("rowburst "));
}

/// A camera of 48 × 40 pixels: a scene in it is recovered well.
const MEDIUM: &str = "[camera]
rows = 48
columns = 40
shutter = \"dual-inside-out\"
row_time_us = 10
exposure_us = 10
bit_depth = 16
";

#[test]
fn dark_flat_and_bad_pixels_are_undone() {
    let lab = small(MEDIUM);
    lab.done("simulate experiment.toml --scene moving -o sim");
    let run = |experiment: &str, frame: &str, more: &str, out: &str| {
        lab.done(&format!(
            "reconstruct {experiment} --frame {frame} --truth sim/truth.npy {more} -o {out}"
        ));
        lab.number(out, "psnr_db")
    };
    let clean = run("sim/experiment.toml", "sim/frame.npy", "", "clean");

    let frame: ndarray::Array2<f32> = ndarray_npy::read_npy(lab.path("sim/frame.npy")).unwrap();
    let dark = |y: usize, x: usize| 1000.0 + 20.0 * y as f32 + 200.0 * pattern(y, x + 99);
    // The mean is close to 1, so that the flat leaves the truth's scale as it is.
    let response = |y: usize, x: usize| 0.8 + 0.4 * pattern(y + 77, x);
    let bad = |y: usize, x: usize| [(3, 7), (20, 31), (40, 2), (41, 2)].contains(&(y, x));
    lab.image("dark.tif", 48, 40, dark);
    lab.image("flat.tif", 48, 40, |y, x| {
        dark(y, x) + 20_000.0 * response(y, x)
    });
    lab.image(
        "bad.png",
        48,
        40,
        |y, x| if bad(y, x) { 255.0 } else { 0.0 },
    );
    lab.image("raw.npy", 48, 40, |y, x| {
        if bad(y, x) {
            30_000.0 * pattern(y, x)
        } else {
            dark(y, x) + response(y, x) * frame[(y, x)]
        }
    });
    let camera = MEDIUM.replace("bit_depth = 16\n", "");
    let calibration = "psf = \"sim/psf.npy\"\ndark = \"dark.tif\"\nflat = \"flat.tif\"\nbad_pixels = \"bad.png\"\n";
    lab.write("lab.toml", format!("{camera}[calibration]\n{calibration}"));
    lab.write("bare.toml", &camera);

    let by_file = run("lab.toml", "raw.npy", "", "by-file");
    assert!(
        (by_file - clean).abs() < 1.0,
        "{by_file} dB after {clean} dB"
    );
    assert_eq!(lab.result("by-file")["bad_pixels"], 4);
    let flags = "--psf sim/psf.npy --dark dark.tif --flat flat.tif --bad-pixels bad.png";
    run("bare.toml", "raw.npy", flags, "by-flags");
    assert_eq!(
        lab.read("by-file/video.npy"),
        lab.read("by-flags/video.npy")
    );

    // Flags override what the experiment says.
    lab.image("none.png", 48, 40, |_, _| 0.0);
    lab.write("wrong.toml", format!("{camera}[calibration]\npsf = \"lost.npy\"\ndark = \"lost.tif\"\nflat = \"lost.tif\"\nbad_pixels = \"none.png\"\n"));
    run("wrong.toml", "raw.npy", flags, "override");
    assert_eq!(
        lab.read("by-file/video.npy"),
        lab.read("override/video.npy")
    );

    let uncorrected = run("bare.toml", "raw.npy", "--psf sim/psf.npy", "raw");
    assert!(
        uncorrected < clean - 3.0,
        "{uncorrected} dB after {clean} dB"
    );
}

#[test]
fn noise_comes_from_gain_and_read_noise() {
    let sensor = "bias_counts = 100\ngain_electrons_per_count = 0.5\nread_noise_electrons = 1.6\n";
    let lab = small(&format!("{MEDIUM}{sensor}"));
    lab.done("simulate experiment.toml --scene moving --peak-electrons 20000 -o sim");
    let run = |more: &str, out: &str| {
        lab.done(&format!(
            "reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy {more} -o {out}"
        ));
        lab.result(out)
    };
    let result = run("", "out");
    assert_eq!(
        result["noise_sigma_source"], "from the calibration",
        "{result:#}"
    );
    let notes: Value = serde_json::from_slice(&lab.read("sim/simulation.json")).unwrap();
    let (found, made) = (&result["noise_sigma"], &notes["noise_sigma"]);
    let ratio = found.as_f64().unwrap() / made.as_f64().unwrap();
    assert!(
        (0.7..1.4).contains(&ratio),
        "σ {found}, simulated with {made}"
    );
    let misfit = lab.number("out", "residual_over_sigma");
    assert!((0.7..1.3).contains(&misfit), "residual/σ {misfit}");

    let given = run("--noise-sigma 123", "given");
    assert_eq!(given["noise_sigma_source"], "given");
    assert_eq!(given["noise_sigma"], 123.0);
}

/// Bytes of an 8-bit grey BMP, rows from the bottom and padded to four bytes.
fn bmp(rows: usize, columns: usize, value: impl Fn(usize, usize) -> u8) -> Vec<u8> {
    let stride = columns.next_multiple_of(4);
    let start = 14 + 40 + 1024;
    let mut bytes = b"BM".to_vec();
    let mut put = |fields: &[u32]| fields.iter().for_each(|f| bytes.extend(f.to_le_bytes()));
    put(&[(start + stride * rows) as u32, 0, start as u32]);
    put(&[
        40,
        columns as u32,
        rows as u32,
        8 << 16 | 1,
        0,
        0,
        0,
        0,
        256,
        0,
    ]);
    (0..256).for_each(|grey| put(&[grey * 0x01_01_01]));
    for y in (0..rows).rev() {
        bytes.extend((0..stride).map(|x| if x < columns { value(y, x) } else { 0 }));
    }
    bytes
}

/// Bytes of a 16-bit grey TIFF in one strip.
fn tiff16(rows: usize, columns: usize, value: impl Fn(usize, usize) -> u16) -> Vec<u8> {
    let pixels = 2 * rows * columns;
    let mut bytes = b"II*\0".to_vec();
    bytes.extend((8 + pixels as u32).to_le_bytes());
    for y in 0..rows {
        (0..columns).for_each(|x| bytes.extend(value(y, x).to_le_bytes()));
    }
    // (tag, value): size, bits, no compression, black is zero, strip, channels.
    let tags = [
        (256u16, columns),
        (257, rows),
        (258, 16),
        (259, 1),
        (262, 1),
        (273, 8),
        (277, 1),
        (278, rows),
        (279, pixels),
    ];
    bytes.extend((tags.len() as u16).to_le_bytes());
    for (tag, value) in tags {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(4u16.to_le_bytes());
        bytes.extend(1u32.to_le_bytes());
        bytes.extend((value as u32).to_le_bytes());
    }
    bytes.extend([0; 4]);
    bytes
}

#[test]
fn every_format_gives_the_same_video() {
    let (rows, columns) = (24, 20);
    let lab = small(&format!("{SMALL}bit_depth = 8\n"));
    lab.done("simulate experiment.toml --scene moving --digit-px 8 -o sim");
    let frame: ndarray::Array2<f32> = ndarray_npy::read_npy(lab.path("sim/frame.npy")).unwrap();
    let psf: ndarray::Array2<f32> = ndarray_npy::read_npy(lab.path("sim/psf.npy")).unwrap();
    let top = psf.iter().copied().fold(0.0, f32::max);
    let psf = psf.mapv(|p| (p / top * 250.0).round());
    for (name, image) in [("frame", &frame), ("psf", &psf)] {
        let (rows, columns) = image.dim();
        let at = |y: usize, x: usize| image[(y, x)];
        assert!(
            image
                .iter()
                .all(|v| v.fract() == 0.0 && (0.0..255.0).contains(v))
        );
        let path = |kind: &str| lab.path(&format!("{name}-{kind}"));
        ndarray_npy::write_npy(path("f32.npy"), image).unwrap();
        ndarray_npy::write_npy(path("f64.npy"), &image.mapv(f64::from)).unwrap();
        ndarray_npy::write_npy(path("u16.npy"), &image.mapv(|v| v as u16)).unwrap();
        lab.image(&format!("{name}-f32.tif"), rows, columns, at);
        lab.image(&format!("{name}-u16.png"), rows, columns, at);
        lab.write(
            &format!("{name}-u16.tif"),
            tiff16(rows, columns, |y, x| at(y, x) as u16),
        );
        lab.write(
            &format!("{name}-u8.bmp"),
            bmp(rows, columns, |y, x| at(y, x) as u8),
        );
    }
    lab.experiment(SMALL);
    let run = |kind: &str| {
        lab.done(&format!(
            "reconstruct experiment.toml --frame frame-{kind} --psf psf-{kind} --max-iterations 40 -o {kind}-out"
        ));
        lab.array(&format!("{kind}-out/video.npy"))
    };
    let first = run("f32.npy");
    assert_eq!(first.shape(), [12, rows, columns]);
    let power: f32 = first.iter().map(|v| v * v).sum();
    assert!(power > 0.0);
    for kind in [
        "f64.npy", "u16.npy", "f32.tif", "u16.tif", "u16.png", "u8.bmp",
    ] {
        let other = run(kind);
        let error: f32 = first.iter().zip(&other).map(|(a, b)| (a - b).powi(2)).sum();
        assert!(error <= 1e-10 * power, "{kind}: {}", (error / power).sqrt());
    }
}
