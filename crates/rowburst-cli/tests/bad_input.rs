//! Bad input, run as a user runs it: each gives status 2 (1 where the work itself
//! fails), words that name the thing, the value, the rule and a remedy, no panic, and no
//! half-written result.

mod common;

use common::{CAMERA, COLUMNS, Lab, ROWS, pattern};

struct Case {
    name: &'static str,
    /// Puts the bad input into the folder.
    prepare: fn(&Lab),
    arguments: &'static str,
    /// Parts of the message: file or key, value, rule, remedy.
    says: [&'static str; 4],
}

const fn case(
    name: &'static str,
    prepare: fn(&Lab),
    arguments: &'static str,
    says: [&'static str; 4],
) -> Case {
    Case {
        name,
        prepare,
        arguments,
        says,
    }
}

/// Runs `case` and gives all that is wrong with the answer.
fn faults(case: &Case, status: i32) -> Vec<String> {
    let lab = Lab::new();
    (case.prepare)(&lab);
    let output = lab.run(case.arguments);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    // Shown with --nocapture, to be read as a user reads it.
    println!(
        "{}\n    {}",
        case.name,
        text.trim_end().replace('\n', "\n    ")
    );
    let mut faults = Vec::new();
    if output.status.code() != Some(status) {
        faults.push(format!("{} instead of {status}", output.status));
    }
    if text.contains("panicked") {
        faults.push("panicked".into());
    }
    for part in case.says {
        if !text.contains(part) {
            faults.push(format!("lacks \"{part}\""));
        }
    }
    if !output.stdout.is_empty() {
        faults.push("wrote to standard output".into());
    }
    let left = lab.files("out");
    if !left.is_empty() {
        faults.push(format!("left {left:?}"));
    }
    faults
        .iter()
        .map(|fault| format!("{}: {fault}\n  {}", case.name, text.trim_end()))
        .collect()
}

/// Runs all of `cases` and shows every fault at once.
fn refused(cases: &[Case]) {
    let faults: Vec<String> = cases.iter().flat_map(|case| faults(case, 2)).collect();
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

fn nothing(_: &Lab) {}

const BAD_FRAME: &str = "reconstruct experiment.toml --frame bad.npy -o out";
const BAD_PSF: &str = "reconstruct experiment.toml --frame frame.npy --psf bad.npy -o out";
const GOOD: &str = "reconstruct experiment.toml --frame frame.npy -o out";

/// An experiment whose `[camera]` has `from` replaced by `to`.
fn camera(lab: &Lab, from: &str, to: &str) {
    assert!(CAMERA.contains(from));
    let text = CAMERA.replace(from, to);
    lab.experiment(&format!("{text}[calibration]\npsf = \"psf.npy\"\n"));
}

/// An experiment with `lines` at the end of `[camera]`.
fn more(lab: &Lab, lines: &str) {
    lab.experiment(&format!(
        "{CAMERA}{lines}\n[calibration]\npsf = \"psf.npy\"\n"
    ));
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of faulty inputs")]
fn frames() {
    refused(&[
        case(
            "frame of another shape",
            |lab| lab.image("bad.npy", 9, COLUMNS, pattern),
            BAD_FRAME,
            ["bad.npy", "9×10", "the camera has 12×10", "crop the frame"],
        ),
        case(
            "frame turned by a quarter",
            |lab| lab.image("bad.npy", COLUMNS, ROWS, pattern),
            BAD_FRAME,
            [
                "bad.npy",
                "10×12",
                "the camera has 12×10",
                "rows and columns",
            ],
        ),
        case(
            "3-D frame",
            |lab| lab.video("bad.npy", [3, ROWS, COLUMNS], |i| i as f32),
            BAD_FRAME,
            [
                "bad.npy",
                "a stack of 3 pages",
                "one image",
                "Save the page",
            ],
        ),
        case(
            "frame all zero",
            |lab| lab.image("bad.npy", ROWS, COLUMNS, |_, _| 0.0),
            BAD_FRAME,
            [
                "bad.npy",
                "zero in every pixel",
                "a frame holds",
                "Check the shutter",
            ],
        ),
        case(
            "saturated 16-bit PNG",
            |lab| lab.image("bad.png", ROWS, COLUMNS, |_, _| 65535.0),
            "reconstruct experiment.toml --frame bad.png -o out",
            [
                "bad.png",
                "65535 in every pixel",
                "a frame holds",
                "shorten the exposure",
            ],
        ),
        case(
            "saturated 8-bit PNG",
            |lab| {
                let mut bytes = Vec::new();
                let white = [255; ROWS * COLUMNS];
                rowburst_io::write_png8(&mut bytes, ROWS, COLUMNS, &white).unwrap();
                lab.write("bad.png", bytes);
            },
            "reconstruct experiment.toml --frame bad.png -o out",
            [
                "bad.png",
                "255 in every pixel",
                "a frame holds",
                "shorten the exposure",
            ],
        ),
        case(
            "constant TIFF",
            |lab| lab.image("bad.tif", ROWS, COLUMNS, |_, _| 255.0),
            "reconstruct experiment.toml --frame bad.tif -o out",
            [
                "bad.tif",
                "255 in every pixel",
                "a frame holds",
                "shorten the exposure",
            ],
        ),
        case(
            "mostly saturated frame",
            |lab| {
                more(lab, "bit_depth = 12");
                lab.image("bad.npy", ROWS, COLUMNS, |y, x| {
                    if y < 8 {
                        4095.0
                    } else {
                        1000.0 * pattern(y, x)
                    }
                });
            },
            BAD_FRAME,
            [
                "bad.npy",
                "80 of 120 pixels saturated",
                "at least half",
                "Shorten the exposure",
            ],
        ),
        case(
            "NaN in the frame",
            |lab| {
                lab.image("bad.npy", ROWS, COLUMNS, |y, x| {
                    if (y, x) == (3, 4) {
                        f32::NAN
                    } else {
                        pattern(y, x)
                    }
                });
            },
            BAD_FRAME,
            ["bad.npy", "NaN at row 3, column 4", "finite", "bad_pixels"],
        ),
        case(
            "infinite pixel in a TIFF",
            |lab| {
                lab.image("bad.tif", ROWS, COLUMNS, |y, x| {
                    if (y, x) == (11, 9) {
                        f32::INFINITY
                    } else {
                        pattern(y, x)
                    }
                });
            },
            "reconstruct experiment.toml --frame bad.tif -o out",
            ["bad.tif", "inf at row 11, column 9", "finite", "bad_pixels"],
        ),
        case(
            "all pixels marked bad",
            |lab| lab.image("bad.png", ROWS, COLUMNS, |_, _| 255.0),
            "reconstruct experiment.toml --frame frame.npy --bad-pixels bad.png -o out",
            [
                "bad.png",
                "120 of 120",
                "at least half",
                "value other than 0",
            ],
        ),
        case(
            "dark of another shape",
            |lab| lab.image("bad.tif", 3, 4, pattern),
            "reconstruct experiment.toml --frame frame.npy --dark bad.tif -o out",
            ["bad.tif", "3×4 pixels", "12×10", "Record it"],
        ),
        case(
            "NaN in the dark",
            |lab| lab.image("bad.tif", ROWS, COLUMNS, |_, _| f32::NAN),
            "reconstruct experiment.toml --frame frame.npy --dark bad.tif -o out",
            ["bad.tif", "NaN", "finite", "Record it"],
        ),
        case(
            "flat with a dead pixel",
            |lab| {
                lab.image("bad.tif", ROWS, COLUMNS, |y, x| {
                    if (y, x) == (2, 7) { 0.0 } else { 900.0 }
                });
            },
            "reconstruct experiment.toml --frame frame.npy --flat bad.tif -o out",
            [
                "bad.tif",
                "found 0 at row 2, column 7;",
                "above zero",
                "bad_pixels",
            ],
        ),
    ]);
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of faulty inputs")]
fn files() {
    refused(&[
        case(
            "no such frame",
            nothing,
            BAD_FRAME,
            ["bad.npy", "no such file", "must exist", "Check the path"],
        ),
        case(
            "no such experiment",
            nothing,
            "reconstruct lost.toml --frame frame.npy -o out",
            ["lost.toml", "no such file", "must exist", "Check the path"],
        ),
        case(
            "a folder as frame",
            |lab| std::fs::create_dir(lab.path("bad.npy")).unwrap(),
            BAD_FRAME,
            [
                "bad.npy",
                "a folder",
                "a file is needed",
                "Name a file in it",
            ],
        ),
        case(
            "a folder as experiment",
            |lab| std::fs::create_dir(lab.path("run")).unwrap(),
            "reconstruct run --frame frame.npy -o out",
            ["run", "a folder", "an experiment file", "experiment.toml"],
        ),
        case(
            "unknown extension",
            |lab| lab.write("bad.jpeg", "x"),
            "reconstruct experiment.toml --frame bad.jpeg -o out",
            ["bad.jpeg", "jpeg", ".npy, .tif", "Convert"],
        ),
        case(
            "no extension",
            |lab| lab.write("bad", "x"),
            "reconstruct experiment.toml --frame bad -o out",
            ["bad", "no ending", ".npy, .tif", "Convert"],
        ),
        case(
            "empty .npy",
            |lab| lab.write("bad.npy", ""),
            BAD_FRAME,
            [
                "bad.npy",
                "an empty file",
                "an image has pixels",
                "copy it again",
            ],
        ),
        case(
            "empty .tif",
            |lab| lab.write("bad.tif", ""),
            "reconstruct experiment.toml --frame bad.tif -o out",
            [
                "bad.tif",
                "an empty file",
                "an image has pixels",
                "copy it again",
            ],
        ),
        case(
            "empty .png",
            |lab| lab.write("bad.png", ""),
            "reconstruct experiment.toml --frame bad.png -o out",
            [
                "bad.png",
                "an empty file",
                "an image has pixels",
                "copy it again",
            ],
        ),
        case(
            "empty .bmp",
            |lab| lab.write("bad.bmp", ""),
            "reconstruct experiment.toml --frame bad.bmp -o out",
            [
                "bad.bmp",
                "an empty file",
                "an image has pixels",
                "copy it again",
            ],
        ),
        case(
            "truncated TIFF",
            |lab| {
                lab.image("whole.tif", ROWS, COLUMNS, pattern);
                lab.truncate("whole.tif", 0.5, "bad.tif");
            },
            "reconstruct experiment.toml --frame bad.tif -o out",
            [
                "bad.tif",
                "ends too early",
                "must be whole",
                "copy it again",
            ],
        ),
        case(
            "TIFF cut in its header",
            |lab| {
                lab.image("whole.tif", ROWS, COLUMNS, pattern);
                lab.truncate("whole.tif", 0.01, "bad.tif");
            },
            "reconstruct experiment.toml --frame bad.tif -o out",
            [
                "bad.tif",
                "ends too early",
                "must be whole",
                "copy it again",
            ],
        ),
        case(
            "truncated .npy",
            |lab| lab.truncate("frame.npy", 0.7, "bad.npy"),
            BAD_FRAME,
            [
                "bad.npy",
                "[12, 10]",
                "must hold every number",
                "copy it again",
            ],
        ),
        case(
            "truncated .png",
            |lab| {
                lab.image("whole.png", ROWS, COLUMNS, |y, x| 9e3 * pattern(y, x));
                lab.truncate("whole.png", 0.6, "bad.png");
            },
            "reconstruct experiment.toml --frame bad.png -o out",
            [
                "bad.png",
                "cannot be read",
                "must be whole",
                "copy it again",
            ],
        ),
        case(
            "text named .npy",
            |lab| lab.write("bad.npy", "1 2 3\n4 5 6\n"),
            BAD_FRAME,
            [
                "bad.npy",
                "a text file",
                "of the format that its name says",
                "Save the numbers",
            ],
        ),
        case(
            "PSF missing on disk",
            |lab| std::fs::remove_file(lab.path("psf.npy")).unwrap(),
            GOOD,
            [
                "psf.npy",
                "no such file",
                "must exist",
                "relative to that file",
            ],
        ),
        case(
            "PSF not given",
            |lab| lab.experiment(CAMERA),
            GOOD,
            [
                "experiment.toml",
                "no PSF",
                "needs the point-spread function",
                "--psf FILE",
            ],
        ),
        case(
            "NaN in the PSF",
            |lab| {
                lab.image("bad.npy", 5, 5, |y, x| {
                    if (y, x) == (1, 2) { f32::NAN } else { 1.0 }
                });
            },
            BAD_PSF,
            [
                "bad.npy",
                "NaN at row 1, column 2",
                "a finite number",
                "mean of its neighbours",
            ],
        ),
        case(
            "negative PSF",
            |lab| {
                lab.image(
                    "bad.npy",
                    5,
                    5,
                    |y, x| if (y, x) == (4, 0) { -0.5 } else { 1.0 },
                );
            },
            BAD_PSF,
            [
                "bad.npy",
                "-0.5 at row 4, column 0",
                "never negative",
                "Subtract a smaller",
            ],
        ),
        case(
            "PSF all zero",
            |lab| lab.image("bad.npy", 5, 5, |_, _| 0.0),
            BAD_PSF,
            [
                "bad.npy",
                "a sum of 0",
                "a PSF holds light",
                "Check the exposure",
            ],
        ),
        case(
            "truth of another shape",
            |lab| lab.video("truth.npy", [2, ROWS, COLUMNS], |i| i as f32),
            "reconstruct experiment.toml --frame frame.npy --truth truth.npy -o out",
            [
                "truth.npy",
                "2×12×10",
                "a video of 6×12×10",
                "Leave --truth out",
            ],
        ),
        case(
            "NaN in the truth",
            |lab| {
                lab.video("truth.npy", [6, ROWS, COLUMNS], |i| {
                    if i == 120 + 37 { f32::NAN } else { 1.0 }
                });
            },
            "reconstruct experiment.toml --frame frame.npy --truth truth.npy -o out",
            [
                "truth.npy",
                "NaN at bin 1, row 3, column 7",
                "finite",
                "Leave --truth out",
            ],
        ),
        case(
            "output is a file",
            |lab| lab.write("taken", "x"),
            "reconstruct experiment.toml --frame frame.npy -o taken",
            [
                "taken",
                "a file where a folder is needed",
                "results go to",
                "with -o",
            ],
        ),
        case(
            "output below a file",
            |lab| lab.write("taken", "x"),
            "reconstruct experiment.toml --frame frame.npy -o taken/out",
            [
                "taken/out",
                "a file where a folder is needed",
                "results go to",
                "with -o",
            ],
        ),
        case(
            "simulation into a file",
            |lab| lab.write("taken", "x"),
            "simulate experiment.toml --scene digits -o taken",
            [
                "taken",
                "a file where a folder is needed",
                "results go to",
                "with -o",
            ],
        ),
        case(
            "demo into a file",
            |lab| lab.write("taken", "x"),
            "demo -o taken",
            [
                "taken",
                "a file where a folder is needed",
                "results go to",
                "with -o",
            ],
        ),
    ]);
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of faulty inputs")]
fn experiments() {
    refused(&[
        case(
            "unknown key",
            |lab| camera(lab, "exposure_us", "exposure_uss"),
            GOOD,
            [
                "experiment.toml: line 6",
                "`exposure_uss`",
                "[camera] has",
                "Did you mean `exposure_us`?",
            ],
        ),
        case(
            "unknown table",
            |lab| lab.experiment(&format!("{CAMERA}[reconstructon]\ntau = \"auto\"\n")),
            GOOD,
            [
                "experiment.toml: line 7",
                "`reconstructon`",
                "the file has",
                "Did you mean `reconstruction`?",
            ],
        ),
        case(
            "unknown shutter",
            |lab| camera(lab, "dual-inside-out", "dual-inside-aut"),
            GOOD,
            [
                "experiment.toml: line 4",
                "\"dual-inside-aut\"",
                "one of top-down",
                "\"dual-inside-out\"?",
            ],
        ),
        case(
            "negative exposure",
            |lab| camera(lab, "exposure_us = 9.6", "exposure_us = -9.6"),
            GOOD,
            [
                "experiment.toml: exposure_us",
                "-9.6",
                "above zero",
                "data sheet",
            ],
        ),
        case(
            "zero exposure",
            |lab| camera(lab, "exposure_us = 9.6", "exposure_us = 0"),
            GOOD,
            [
                "experiment.toml: exposure_us",
                "found 0;",
                "above zero",
                "data sheet",
            ],
        ),
        case(
            "exposure that is not a number",
            |lab| camera(lab, "exposure_us = 9.6", "exposure_us = nan"),
            GOOD,
            [
                "experiment.toml: exposure_us",
                "NaN",
                "above zero",
                "data sheet",
            ],
        ),
        case(
            "enormous exposure",
            |lab| camera(lab, "exposure_us = 9.6", "exposure_us = 9.6e9"),
            GOOD,
            [
                "experiment.toml: exposure_us",
                "9600000000",
                "ten times the readout",
                "in microseconds",
            ],
        ),
        case(
            "infinite exposure",
            |lab| camera(lab, "exposure_us = 9.6", "exposure_us = inf"),
            GOOD,
            [
                "experiment.toml: exposure_us",
                "inf",
                "above zero",
                "data sheet",
            ],
        ),
        case(
            "negative row time",
            |lab| camera(lab, "row_time_us = 9.6", "row_time_us = -1"),
            GOOD,
            [
                "experiment.toml: row_time_us",
                "-1",
                "above zero",
                "data sheet",
            ],
        ),
        case(
            "no rows",
            |lab| camera(lab, "rows = 12", "rows = 0"),
            GOOD,
            [
                "experiment.toml: rows",
                "found 0;",
                "at least one",
                "size of the frame",
            ],
        ),
        case(
            "rows that contradict the frame",
            |lab| camera(lab, "rows = 12", "rows = 14"),
            GOOD,
            [
                "frame.npy",
                "12×10",
                "the camera has 14×10",
                "rows and columns",
            ],
        ),
        case(
            "more rows than any memory holds",
            |lab| camera(lab, "rows = 12", "rows = 9000000000000000000"),
            GOOD,
            [
                "line 2, [camera] rows",
                "9000000000000000000",
                "at most 65536",
                "size of the frame",
            ],
        ),
        case(
            "rows as text",
            |lab| camera(lab, "rows = 12", "rows = \"108\""),
            GOOD,
            [
                "line 2, [camera] rows",
                "string \"108\"",
                "a whole number",
                "Correct this line",
            ],
        ),
        case(
            "negative rows",
            |lab| camera(lab, "rows = 12", "rows = -12"),
            GOOD,
            [
                "line 2, [camera] rows",
                "integer -12",
                "a whole number",
                "Correct this line",
            ],
        ),
        case(
            "rows left out",
            |lab| camera(lab, "rows = 12\n", ""),
            GOOD,
            [
                "experiment.toml: [camera]",
                "no `rows`",
                "required",
                "Add a line `rows",
            ],
        ),
        case(
            "field smaller than the sensor",
            |lab| more(lab, "[field]\nrows = 12\ncolumns = 8"),
            GOOD,
            [
                "experiment.toml: [field]",
                "12×8",
                "at least as large as the sensor of 12×10",
                "Leave [field] out",
            ],
        ),
        case(
            "enormous field",
            |lab| more(lab, "[field]\nrows = 9000000000\ncolumns = 10"),
            GOOD,
            [
                "line 8, [field] rows",
                "9000000000",
                "at most 65536",
                "size of the frame",
            ],
        ),
        case(
            "custom shutter without an order",
            |lab| camera(lab, "dual-inside-out", "custom"),
            GOOD,
            [
                "experiment.toml",
                "no `row_order`",
                "required",
                "Add a line `row_order",
            ],
        ),
        case(
            "custom shutter with a short order",
            |lab| {
                camera(
                    lab,
                    "\"dual-inside-out\"",
                    "\"custom\"\nrow_order = \"order.npy\"",
                );
                lab.order("order.npy", &[0, 1, 2, 3]);
            },
            GOOD,
            [
                "row_order",
                "4 integers",
                "12 rows needs 12",
                "one integer per row",
            ],
        ),
        case(
            "custom shutter with a gap in the order",
            |lab| {
                camera(
                    lab,
                    "\"dual-inside-out\"",
                    "\"custom\"\nrow_order = \"order.npy\"",
                );
                lab.order("order.npy", &[0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 11]);
            },
            GOOD,
            [
                "row_order",
                "no row read at instant 6",
                "every instant",
                "one integer per row",
            ],
        ),
        case(
            "row_order without a custom shutter",
            |lab| {
                more(lab, "row_order = \"order.npy\"");
                lab.order("order.npy", &[0; ROWS]);
            },
            GOOD,
            [
                "line 7, [camera] row_order",
                "dual-inside-out",
                "\"custom\" alone",
                "Remove it",
            ],
        ),
        case(
            "not TOML",
            |lab| lab.experiment("rows: 12\n"),
            GOOD,
            [
                "experiment.toml: line 1",
                "found",
                "valid TOML",
                "Correct this line",
            ],
        ),
        case(
            "a frame as experiment",
            nothing,
            "reconstruct frame.npy --frame frame.npy -o out",
            ["frame.npy", "not UTF-8", "text in UTF-8", "with --frame"],
        ),
        case(
            "no bins in a row",
            |lab| more(lab, "bins_per_row = 0"),
            GOOD,
            [
                "experiment.toml: bins_per_row",
                "found 0;",
                "1 to 64",
                "Leave it out",
            ],
        ),
        case(
            "impossible bit depth",
            |lab| more(lab, "bit_depth = 99"),
            GOOD,
            [
                "experiment.toml: bit_depth",
                "99",
                "1 to 32 bits",
                "8, 12 or 16",
            ],
        ),
        case(
            "negative gain",
            |lab| more(lab, "gain_electrons_per_count = -0.5"),
            GOOD,
            [
                "experiment.toml: gain_electrons_per_count",
                "-0.5",
                "above zero",
                "Leave the key out",
            ],
        ),
        case(
            "unknown prior in the experiment",
            |lab| more(lab, "[reconstruction]\nprior = \"wavelets\""),
            GOOD,
            [
                "experiment.toml",
                "\"wavelets\"",
                "no prior has this name",
                "Use auto",
            ],
        ),
        case(
            "negative tau in the experiment",
            |lab| more(lab, "[reconstruction]\ntau = -1"),
            GOOD,
            [
                "experiment.toml: line 8, [reconstruction] tau",
                "-1",
                "above zero",
                "\"auto\"",
            ],
        ),
    ]);
}

#[test]
#[expect(clippy::too_many_lines, reason = "one table of faulty inputs")]
fn options() {
    refused(&[
        case(
            "unknown prior",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --prior nonsense -o out",
            [
                "--prior",
                "\"nonsense\"",
                "no prior has this name",
                "tv, tdiff, l1, tv3d, tv3d-aniso",
            ],
        ),
        case(
            "tau 0",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --tau 0 -o out",
            ["--tau", "found 0;", "above zero", "Leave it out"],
        ),
        case(
            "tau -1",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --tau -1 -o out",
            ["--tau", "-1", "above zero", "Leave it out"],
        ),
        case(
            "tau nan",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --tau nan -o out",
            ["--tau", "NaN", "above zero", "Leave it out"],
        ),
        case(
            "tau abc",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --tau abc -o out",
            ["--tau", "\"abc\"", "above zero", "Leave it out"],
        ),
        case(
            "sigma 0",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --noise-sigma 0 -o out",
            ["--noise-sigma", "found 0;", "above zero", "Leave it out"],
        ),
        case(
            "sigma -1",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --noise-sigma -1 -o out",
            ["--noise-sigma", "-1", "above zero", "Leave it out"],
        ),
        case(
            "sigma nan",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --noise-sigma nan -o out",
            ["--noise-sigma", "NaN", "above zero", "Leave it out"],
        ),
        case(
            "time budget 0",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --time-budget-s 0 -o out",
            ["--time-budget-s", "found 0;", "above zero", "Leave it out"],
        ),
        case(
            "time budget -1",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --time-budget-s -1 -o out",
            ["--time-budget-s", "-1", "above zero", "Leave it out"],
        ),
        case(
            "no iterations",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --max-iterations 0 -o out",
            ["--max-iterations", "'0'", "1..", "--help"],
        ),
        case(
            "no threads",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --threads 0 -o out",
            ["--threads", "'0'", "1..=1024", "--help"],
        ),
        case(
            "no frame",
            nothing,
            "reconstruct experiment.toml -o out",
            [
                "--frame",
                "required",
                "Usage: rowburst reconstruct",
                "--help",
            ],
        ),
        case(
            "unknown verb",
            nothing,
            "recontruct experiment.toml",
            ["'recontruct'", "unrecognized", "'reconstruct'", "--help"],
        ),
        case(
            "unknown scene of the demo",
            nothing,
            "demo --scene letters -o out",
            ["--scene", "'letters'", "digits, leds, moving", "--help"],
        ),
        case(
            "unknown scene",
            nothing,
            "simulate experiment.toml --scene letters -o out",
            [
                "--scene",
                "\"letters\"",
                "still, bench, beam, wheel, cells, spots or a video",
                "Check the name",
            ],
        ),
        case(
            "scene file missing",
            nothing,
            "simulate experiment.toml --scene lost.npy -o out",
            ["lost.npy", "no such file", "must exist", "Check the path"],
        ),
        case(
            "scene file with NaN",
            |lab| lab.video("scene.npy", [6, ROWS, COLUMNS], |_| f32::NAN),
            "simulate experiment.toml --scene scene.npy -o out",
            [
                "scene.npy",
                "NaN at bin 0",
                "finite",
                "Subtract the background",
            ],
        ),
        case(
            "dark scene",
            |lab| lab.video("scene.npy", [6, ROWS, COLUMNS], |_| 0.0),
            "simulate experiment.toml --scene scene.npy -o out",
            [
                "scene.npy",
                "no light",
                "above zero",
                "Check that the scene",
            ],
        ),
        case(
            "SNR 0",
            nothing,
            "simulate experiment.toml --scene digits --snr 0 -o out",
            ["--snr", "'0'", "above zero, or inf for no noise", "--help"],
        ),
        case(
            "SNR -3",
            nothing,
            "simulate experiment.toml --scene digits --snr -3 -o out",
            ["--snr", "'-3'", "above zero, or inf for no noise", "--help"],
        ),
        case(
            "SNR abc",
            nothing,
            "simulate experiment.toml --scene digits --snr abc -o out",
            [
                "--snr",
                "'abc'",
                "above zero, or inf for no noise",
                "--help",
            ],
        ),
        case(
            "SNR of the demo",
            nothing,
            "demo --snr -3 -o out",
            ["--snr", "'-3'", "above zero, or inf for no noise", "--help"],
        ),
        case(
            "electrons without a gain",
            nothing,
            "simulate experiment.toml --scene digits --peak-electrons 20000 -o out",
            [
                "experiment.toml",
                "no `gain_electrons_per_count`",
                "--peak-electrons",
                "[camera]",
            ],
        ),
        case(
            "no electrons",
            |lab| {
                more(
                    lab,
                    "gain_electrons_per_count = 0.5\nread_noise_electrons = 1.5",
                );
            },
            "simulate experiment.toml --scene digits --peak-electrons 0 -o out",
            ["--peak-electrons", "0", "above zero", "below the full well"],
        ),
        case(
            "negative electrons",
            |lab| {
                more(
                    lab,
                    "gain_electrons_per_count = 0.5\nread_noise_electrons = 1.5",
                );
            },
            "simulate experiment.toml --scene digits --peak-electrons -5 -o out",
            [
                "--peak-electrons",
                "-5",
                "above zero",
                "below the full well",
            ],
        ),
        case(
            "digits that do not fit",
            nothing,
            "simulate experiment.toml --scene digits --digit-px 200 -o out",
            ["--digit-px 200", "6×12×10", "a digit needs", "larger field"],
        ),
        case(
            "negative wavelength",
            |lab| lab.experiment(CAMERA),
            "simulate experiment.toml --scene digits --digit-px 7 --wavelength-nm -532 -o out",
            ["--wavelength-nm", "-532", "above zero", "Visible light"],
        ),
        case(
            "no diffuser angle",
            |lab| lab.experiment(CAMERA),
            "simulate experiment.toml --scene digits --digit-px 7 --diffuser-deg 0 -o out",
            ["--diffuser-deg", "found 0;", "above 0°", "data sheet"],
        ),
    ]);
}

#[test]
fn a_video_beyond_the_memory() {
    let lab = Lab::new();
    let text = "exposure_us = 500\nbins_per_row = 64\n[field]\nrows = 65536\ncolumns = 65536\n";
    lab.experiment(&CAMERA.replace("exposure_us = 9.6\n", text));
    for arguments in [
        "reconstruct experiment.toml --frame frame.npy --psf psf.npy -o out",
        "simulate experiment.toml --scene digits --psf psf.npy -o out",
    ] {
        let output = lab.run(arguments);
        let text = String::from_utf8_lossy(&output.stderr);
        println!("{text}");
        assert_eq!(output.status.code(), Some(1), "{text}");
        for part in [
            "experiment.toml",
            "65536×65536",
            "no memory",
            "[field] smaller",
        ] {
            assert!(text.contains(part), "{text}");
        }
        assert!(lab.files("out").is_empty());
    }
}

/// A small disk of its own, gone when dropped.
#[cfg(target_os = "linux")]
struct Disk<'a> {
    lab: &'a Lab,
}

#[cfg(target_os = "linux")]
impl<'a> Disk<'a> {
    /// Mounts it at `out`; `None`, with a message, where only the system may.
    fn mount(lab: &'a Lab, options: &str) -> Option<Self> {
        let out = lab.path("out");
        std::fs::create_dir(&out).unwrap();
        let mounted = std::process::Command::new("mount")
            .args(["-t", "tmpfs", "-o", options, "tmpfs"])
            .arg(&out)
            .output();
        if mounted.is_ok_and(|output| output.status.success()) {
            return Some(Self { lab });
        }
        eprintln!("skipped: a disk of {options} cannot be mounted here");
        None
    }

    /// Fills it to the last byte.
    fn fill(&self) {
        use std::io::Write;
        let mut file = std::fs::File::create(self.lab.path("out/filler")).unwrap();
        while file.write_all(&[0; 512]).is_ok() {}
    }
}

#[cfg(target_os = "linux")]
impl Drop for Disk<'_> {
    fn drop(&mut self) {
        let out = self.lab.path("out");
        let gone = std::process::Command::new("umount").arg(&out).status();
        if !gone.is_ok_and(|status| status.success()) {
            eprintln!("{} stays mounted", out.display());
        }
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_up() {
    let lab = Lab::new();
    let Some(disk) = Disk::mount(&lab, "size=64k") else {
        return;
    };
    let output = lab.run(GOOD);
    let text = String::from_utf8_lossy(&output.stderr);
    println!("{text}");
    assert_eq!(output.status.code(), Some(1), "{text}");
    for part in ["out/", "No space left", "Free space on this disk", "-o"] {
        assert!(text.contains(part), "lacks {part}: {text}");
    }
    let files = lab.files("out");
    assert!(!files.iter().any(|name| name == "result.json"), "{files:?}");
    assert!(
        !files.iter().any(|name| name.ends_with(".part")),
        "{files:?}"
    );
    assert_eq!(lab.array("out/video.npy").shape(), [6, ROWS, COLUMNS]);
    drop(disk);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_keeps_no_result_of_an_earlier_run() {
    let lab = Lab::new();
    let Some(disk) = Disk::mount(&lab, "size=16m") else {
        return;
    };
    lab.done(GOOD);
    assert!(lab.path("out/result.json").exists());
    disk.fill();
    let output = lab.run("reconstruct experiment.toml --frame frame.npy --tau 1e-3 --force -o out");
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("Free space"), "{text}");
    assert!(!lab.path("out/result.json").exists());
    // The old one or the new one, but whole.
    assert_eq!(lab.array("out/video.npy").shape(), [6, ROWS, COLUMNS]);
}

#[cfg(target_os = "linux")]
#[test]
fn folders_that_cannot_be_written_to() {
    let lab = Lab::new();
    let check = |out: &str| {
        let output = lab.run(&format!(
            "reconstruct experiment.toml --frame frame.npy -o {out}"
        ));
        let text = String::from_utf8_lossy(&output.stderr);
        println!("{text}");
        assert_eq!(output.status.code(), Some(2), "{text}");
        for part in [out, "cannot be written to", "results go to", "with -o"] {
            assert!(text.contains(part), "lacks {part}: {text}");
        }
    };
    check("/proc/rowburst");
    if let Some(_disk) = Disk::mount(&lab, "ro") {
        check("out");
        check("out/below");
    }
}

#[test]
fn unknown_simd_paths_are_refused() {
    let lab = Lab::new();
    let mut command = lab.command("reconstruct experiment.toml --frame frame.npy -o out");
    let output = command.env("ROWBURST_SIMD", "avx9").output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    for part in ["ROWBURST_SIMD", "avx9", "`portable`", "Unset it"] {
        assert!(text.contains(part), "lacks {part}: {text}");
    }
    assert!(lab.files("out").is_empty());
}

/// Slips that are in range: each is named with the unit or the file that was probably meant.
#[test]
#[expect(clippy::too_many_lines, reason = "one table of slips")]
fn likely_slips() {
    refused(&[
        case(
            "row time in seconds",
            |lab| camera(lab, "row_time_us = 9.6", "row_time_us = 9.6e-6"),
            GOOD,
            [
                "row_time_us",
                "9.6e-6",
                "0.05 µs or more",
                "Are these seconds? Then write 9.6.",
            ],
        ),
        case(
            "exposure in milliseconds",
            |lab| camera(lab, "exposure_us = 9.6", "exposure_us = 0.0096"),
            GOOD,
            [
                "exposure_us",
                "0.0096",
                "0.05 µs or more",
                "Are these milliseconds? Then write 9.6.",
            ],
        ),
        case(
            "pitch in metres",
            |lab| more(lab, "pixel_pitch_um = 6.5e-6"),
            GOOD,
            [
                "pixel_pitch_um",
                "6.5e-6",
                "0.2 to 500 µm",
                "Are these metres? Then write 6.5.",
            ],
        ),
        case(
            "a gain of no camera",
            |lab| more(lab, "gain_electrons_per_count = 1e300"),
            GOOD,
            [
                "gain_electrons_per_count",
                "1e300",
                "0.001 to 10000 electrons",
                "data sheet",
            ],
        ),
        case(
            "more counts than bits",
            |lab| {
                more(lab, "bit_depth = 12");
                lab.image("bad.png", ROWS, COLUMNS, |y, x| {
                    9000.0 + 900.0 * pattern(y, x)
                });
            },
            "reconstruct experiment.toml --frame bad.png -o out",
            [
                "bad.png",
                "counts up to 9",
                "bit_depth = 12 ends at 4095",
                "Set bit_depth to 14",
            ],
        ),
        case(
            "full well of another gain",
            |lab| {
                more(lab, "full_well_counts = 500");
                lab.image("bad.png", ROWS, COLUMNS, |y, x| {
                    9000.0 + 900.0 * pattern(y, x)
                });
            },
            "reconstruct experiment.toml --frame bad.png -o out",
            [
                "bad.png",
                "120 of 120 pixels",
                "full_well_counts = 500",
                "leave it out",
            ],
        ),
        case(
            "a mask for the frame",
            |lab| {
                lab.image("bad.npy", ROWS, COLUMNS, |y, x| {
                    f32::from(u8::from((x + y) % 3 == 0))
                });
            },
            BAD_FRAME,
            [
                "bad.npy",
                "only the values 0 and 1",
                "many values",
                "Is this a mask",
            ],
        ),
        case(
            "the frame for the PSF",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --psf frame.npy -o out",
            [
                "frame.npy",
                "the frame itself, 12×10",
                "another capture",
                "point source",
            ],
        ),
        case(
            "a flat PSF",
            |lab| lab.image("bad.npy", 9, 9, |_, _| 7.0),
            BAD_PSF,
            [
                "bad.npy",
                "a contrast of 0.0 %",
                "bright in few places",
                "point source",
            ],
        ),
        case(
            "text for an array",
            |lab| lab.write("bad.npy", "1 2 3\n4 5 6\n"),
            BAD_FRAME,
            [
                "bad.npy",
                "a text file (\"1 2 3\")",
                "format that its name says",
                "Save the numbers",
            ],
        ),
        case(
            "an array of nothing",
            |lab| {
                let array = ndarray::Array2::<f32>::zeros((0, 0));
                ndarray_npy::write_npy(lab.path("bad.npy"), &array).unwrap();
            },
            BAD_FRAME,
            [
                "bad.npy",
                "an empty array",
                "at least one pixel",
                "what was saved",
            ],
        ),
        case(
            "a tau for no frame",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --prior tv --tau 1e300 -o out",
            [
                "--tau",
                "1e300",
                "the video of this frame is zero",
                "Leave it out",
            ],
        ),
        case(
            "a wavelength in micrometres",
            |lab| lab.experiment(CAMERA),
            "simulate experiment.toml --scene digits --digit-px 7 --wavelength-nm 0.532 -o out",
            [
                "--wavelength-nm",
                "0.532",
                "nanometres",
                "Are these micrometres? Then write 532",
            ],
        ),
        case(
            "a row time of a planned camera in seconds",
            nothing,
            "design --rows 48 --columns 48 --row-time-us 9.6e-6 --quick -o out",
            [
                "--row-time-us",
                "9.6e-6",
                "0.05 µs or more",
                "Are these seconds?",
            ],
        ),
        case(
            "a format of no video",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --write avi -o out",
            [
                "--write",
                "\"avi\"",
                "npy, tif, zarr, mp4, mat, h5",
                "commas",
            ],
        ),
        case(
            "a prior of a sweep that is none",
            nothing,
            "reconstruct experiment.toml --frame frame.npy --sweep prior=tv,foo -o out",
            ["--prior", "\"foo\"", "no prior has this name", "Use auto"],
        ),
    ]);
}

/// A cut TIFF, and the folder of another command in the viewer.
#[test]
fn files_that_end_too_early_and_folders_of_other_commands() {
    let lab = Lab::new();
    lab.image("whole.tif", ROWS, COLUMNS, pattern);
    lab.truncate("whole.tif", 0.5, "bad.tif");
    let output = lab.run("reconstruct experiment.toml --frame bad.tif -o out");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        text.contains("ends too early") && text.contains("cut short"),
        "{text}"
    );
    std::fs::create_dir(lab.path("plan")).unwrap();
    lab.write("plan/design.json", "{}");
    let output = lab.run("view plan --no-open --port 0");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("a folder of rowburst design"), "{text}");
}

/// Own files of the user survive; those of earlier runs are replaced, and stale ones removed.
#[test]
fn files_of_the_user_are_never_replaced_unasked() {
    let lab = Lab::new();
    let mine = format!("# my notes\n{CAMERA}");
    lab.experiment(&mine);
    for arguments in [
        "simulate experiment.toml --scene digits --digit-px 7 -o .",
        "reconstruct experiment.toml --psf psf.npy --frame frame.npy -o .",
    ] {
        let output = lab.run(arguments);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(
            text.contains("experiment.toml, frame.npy, psf.npy"),
            "{text}"
        );
        assert!(text.contains("--force"), "{text}");
        assert_eq!(lab.read("experiment.toml"), mine.as_bytes());
    }
    let run = "reconstruct experiment.toml --psf psf.npy --frame frame.npy --prior tv -o out";
    lab.done(&format!("{run} --direct frame.npy --write tif,mat"));
    let files = lab.files("out");
    for (name, is_there) in [
        ("direct.png", true),
        ("video.tif", true),
        ("video.mat", true),
        ("video.mp4", false),
    ] {
        assert_eq!(
            files.iter().any(|f| f == name),
            is_there,
            "{name} in {files:?}"
        );
    }
    lab.done(&format!("{run} --write npy"));
    let files = lab.files("out");
    for stale in ["direct.png", "video.tif", "video.mat"] {
        assert!(!files.iter().any(|f| f == stale), "{stale} in {files:?}");
    }
    lab.write("out/notes.txt", "mine");
    assert_eq!(lab.run(run).status.code(), Some(2));
    lab.done(&format!("{run} --force"));
    assert_eq!(lab.read("out/notes.txt"), b"mine");
}

/// `result.json` alone repeats the run; an input that has changed is named.
#[test]
fn a_run_is_repeated_from_its_result_alone() {
    let lab = Lab::new();
    let frame = "reconstruct experiment.toml --frame frame.npy";
    lab.done(&format!("{frame} --prior tv --tau 0.5 --bins 1..4 -o out"));
    // The experiment file is not needed any more.
    lab.experiment("[camera]\n");
    let text = lab.done("rerun out -o again");
    assert!(text.contains("video.npy is equal to the bit"), "{text}");
    assert_eq!(lab.read("again/video.npy"), lab.read("out/video.npy"));
    let again = lab.done("rerun again -o third");
    assert!(again.contains("equal to the bit"), "{again}");
    let methods = lab.done("cite out");
    for words in [
        "@software{rowburst",
        "@article{rudin1992",
        "9.600 µs per row",
    ] {
        assert!(methods.contains(words), "{words}: {methods}");
    }
    lab.image("psf.npy", 9, 7, pattern);
    let output = lab.run("rerun out -o fourth");
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains("psf ") && text.contains("has changed"),
        "{text}"
    );
    assert!(!text.contains("frame.npy has changed"), "{text}");
}
