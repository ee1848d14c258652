//! What users see is pinned: help texts, keys and types of the JSON files, the public items of the libraries.
//!
//! Where a change is meant, `INSTA_UPDATE=always cargo test -p rowburst-cli --test snapshots` renews the files in
//! `tests/snapshots`; read their difference before it is committed.

#![cfg(all(feature = "batch", feature = "hdf5", feature = "mp4", feature = "view"))]

mod common;

use common::{Lab, pattern, program};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Every verb.
const VERBS: [&str; 22] = [
    "",
    "demo",
    "init",
    "simulate",
    "reconstruct",
    "batch",
    "view",
    "figure",
    "calibrate",
    "calibrate psf",
    "calibrate sensor",
    "calibrate timing",
    "new",
    "status",
    "check",
    "capture",
    "capture record",
    "capture settings",
    "live",
    "schema",
    "completions",
    "man",
];

#[test]
fn help() {
    let mut text = String::new();
    for verb in VERBS.iter().chain(&["design"]) {
        let output = Command::new(program())
            .args(verb.split_whitespace())
            .arg("--help")
            .env_remove("COLUMNS")
            .output()
            .unwrap();
        assert!(output.status.success(), "{verb} --help");
        let help = String::from_utf8(output.stdout).unwrap();
        text += &format!("$ rowburst {verb} --help\n{help}\n");
    }
    insta::assert_snapshot!("help", text);
}

/// The terms of priors, for the page on them.
#[test]
fn prior_terms() {
    let terms = rowburst::prox::TERMS.iter();
    let mut lines: Vec<String> = terms
        .map(|term| format!("{}: {}", term.name, term.favours))
        .collect();
    lines.push("support: sparse scenes before a dark background".into());
    insta::assert_snapshot!("prior-terms", lines.join("\n"));
}

/// Objects whose keys are data.
const MAPS: [&str; 1] = ["metadata.taken"];

/// Adds the types of `value` and of all below it, by path.
fn add_types(types: &mut BTreeMap<String, BTreeSet<&'static str>>, path: &str, value: &Value) {
    let name = match value {
        Value::Null => "null",
        Value::Bool(_) => "bool",
        Value::Number(_) => "number",
        Value::String(_) => "text",
        Value::Array(_) => "list",
        Value::Object(_) => "object",
    };
    types.entry(path.to_string()).or_default().insert(name);
    match value {
        Value::Array(values) => {
            let below = format!("{path}[]");
            values.iter().for_each(|v| add_types(types, &below, v));
        }
        Value::Object(_) if MAPS.contains(&path) => {}
        Value::Object(values) => {
            for (key, value) in values {
                let below = [path, key].map(|part| part.to_string());
                let below = below.iter().filter(|part| !part.is_empty());
                let below: Vec<&str> = below.map(String::as_str).collect();
                add_types(types, &below.join("."), value);
            }
        }
        _ => {}
    }
}

/// Keys of a JSON text with the types of their values, a line each.
fn types_of(text: impl AsRef<[u8]>) -> String {
    let value: Value = serde_json::from_slice(text.as_ref()).unwrap();
    let mut types = BTreeMap::new();
    add_types(&mut types, "", &value);
    let line = |(path, types): (&String, &BTreeSet<&str>)| {
        let types: Vec<&str> = types.iter().copied().collect();
        format!("{path}: {}\n", types.join(" | "))
    };
    types.iter().map(line).collect()
}

const CAMERA: &str = "[camera]
rows = 24
columns = 20
shutter = \"dual-inside-out\"
row_time_us = 10
exposure_us = 10
";

/// Options that make a run short.
const QUICK: &str = "--prior tv+0.5*tdiff --max-iterations 20";

/// A folder with a simulated capture in `sim`.
fn lab() -> Lab {
    let lab = Lab::empty();
    lab.experiment(CAMERA);
    lab.done("simulate experiment.toml --scene digits --digit-px 8 -o sim");
    lab
}

#[test]
fn json_of_simulate_and_reconstruct() {
    let lab = lab();
    let files = "sim/experiment.toml --frame sim/frame.npy";
    lab.done(&format!(
        "reconstruct {files} --truth sim/truth.npy --debias --region 8,8 -o result"
    ));
    lab.done(&format!(
        "reconstruct {files} --prior tv --part-bins 4 -o parts"
    ));
    let sweep = lab.done(&format!(
        "reconstruct {files} {QUICK} --truth sim/truth.npy --sweep tau=auto,0.01 --json -o sweep"
    ));
    insta::assert_snapshot!("simulation.json", types_of(lab.read("sim/simulation.json")));
    insta::assert_snapshot!("result.json", types_of(lab.read("result/result.json")));
    insta::assert_snapshot!("view.json", types_of(lab.read("result/view.json")));
    insta::assert_snapshot!("parts-result.json", types_of(lab.read("parts/result.json")));
    insta::assert_snapshot!("sweep", types_of(sweep));
}

#[test]
fn json_of_a_frame_in_colour() {
    let lab = Lab::new();
    lab.experiment(&format!(
        "{}bayer = \"grbg\"\n[calibration]\npsf = \"psf.npy\"\n",
        common::CAMERA
    ));
    lab.done(&format!(
        "reconstruct experiment.toml --frame frame.npy {QUICK} -o result"
    ));
    insta::assert_snapshot!(
        "colour-result.json",
        types_of(lab.read("result/result.json"))
    );
}

#[test]
fn json_of_batch() {
    let lab = lab();
    std::fs::create_dir(lab.path("rec")).unwrap();
    for name in ["rec/a.npy", "rec/b.npy"] {
        std::fs::copy(lab.path("sim/frame.npy"), lab.path(name)).unwrap();
    }
    let summary = lab.done(&format!(
        "batch sim/experiment.toml --frames rec {QUICK} --frame-period-us 2000 --json -o videos.zarr"
    ));
    lab.done("batch sim/experiment.toml --frames rec -o auto.zarr");
    insta::assert_snapshot!("batch", types_of(summary));
    let folder = "videos.zarr/rowburst";
    for name in ["job.json", "clock.json", "frames/000000.json"] {
        let snapshot = format!("batch-{}", name.replace('/', "-"));
        insta::assert_snapshot!(snapshot, types_of(lab.read(&format!("{folder}/{name}"))));
    }
    insta::assert_snapshot!(
        "batch-prior.json",
        types_of(lab.read("auto.zarr/rowburst/prior.json"))
    );
    insta::assert_snapshot!(
        "batch-zarr.json",
        types_of(lab.read("videos.zarr/zarr.json"))
    );
}

#[test]
fn json_of_calibrate_psf() {
    let lab = lab();
    let mut lines = "capture,x_mm,y_mm\n".to_string();
    for i in 0..5 {
        let name = format!("{i}.npy");
        lab.image(&name, 40, 40, |y, x| 100.0 * pattern(y, x + 2 * i).powi(3));
        lines += &format!("{name},{},0\n", 0.1 * (i as f64 - 2.0));
    }
    lab.write("scan.csv", lines);
    let text = lab.done(
        "calibrate psf 0.npy 1.npy 2.npy 3.npy 4.npy --positions-mm scan.csv --experiment experiment.toml --json -o psf",
    );
    insta::assert_snapshot!("psf.json", types_of(&text));
}

#[test]
fn json_of_calibrate_sensor() {
    let lab = lab();
    let frame = |name: &str, light: f64, seed: usize| {
        // Uniform noise with the variance of shot and read noise at a gain of 2 electrons a count.
        let width = (12.0 * (light / 2.0 + 4.0)).sqrt();
        lab.image(name, 24, 20, |y, x| {
            let noise = width * (f64::from(pattern(y + 100 * seed, x)) - 0.5);
            (100.0 + light + noise).round() as f32
        });
    };
    let mut names = String::from("--darks");
    for i in 0..8 {
        frame(&format!("dark{i}.npy"), 0.0, i);
        names += &format!(" dark{i}.npy");
    }
    names += " --flats";
    for (i, light) in [500.0, 1000.0, 2000.0, 3000.0].into_iter().enumerate() {
        for copy in 0..3 {
            let name = format!("flat{i}-{copy}.npy");
            frame(&name, light, 10 + 3 * i + copy);
            names += &format!(" {name}");
        }
    }
    let text = lab.done(&format!(
        "calibrate sensor {names} --experiment experiment.toml --json -o sensor"
    ));
    insta::assert_snapshot!("sensor.json", types_of(&text));
}

#[test]
fn json_of_calibrate_timing() {
    let lab = lab();
    let (row_time, exposure) = (9.6, 80.0);
    let light_until = |t: f64| 0.5 * (t / 1000.0).floor() + (t / 1000.0).fract().min(0.5);
    lab.image("led.tif", 1200, 8, |y, x| {
        let end = 130.0 + row_time * y as f64;
        let light = (light_until(end) - light_until(end - exposure)) * 1000.0 / exposure;
        (200.0 * light + 20.0) as f32 + 10.0 * (pattern(y, x) - 0.5)
    });
    let text = lab.done("calibrate timing led.tif --frequency-hz 1000 --json -o timing");
    insta::assert_snapshot!("timing.json", types_of(&text));
}

#[test]
fn json_of_design() {
    let text = Lab::empty().done("design --quick --json");
    insta::assert_snapshot!("design.json", types_of(&text));
}

/// Crates whose public items are pinned.
const LIBRARIES: [&str; 13] = [
    "rowburst",
    "rowburst-batch",
    "rowburst-calibrate",
    "rowburst-capture",
    "rowburst-core",
    "rowburst-io",
    "rowburst-optics",
    "rowburst-report",
    "rowburst-run",
    "rowburst-simulate",
    "rowburst-solve",
    "rowburst-view",
    "rowburst-zarr",
];

/// Documents all crates as JSON; the folder with the files. One run for the whole workspace: another choice of packages
/// would change the features of dependencies, and check them anew.
fn rustdoc_json() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let output = Command::new(env!("CARGO"))
        .args(["doc", "--quiet", "--workspace", "--no-deps", "--lib"])
        .env("RUSTDOC", root.join("scripts/rustdoc-unstable"))
        .env(
            "RUSTDOCFLAGS",
            "-Z unstable-options --output-format json --cap-lints allow",
        )
        .current_dir(&root)
        .output()
        .unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo doc\n{errors}");
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or("target".into(), PathBuf::from);
    root.join(target).join("doc")
}

#[test]
fn public_items_of_the_libraries() {
    let folder = rustdoc_json();
    for library in LIBRARIES {
        let json = folder.join(format!("{}.json", library.replace('-', "_")));
        let api = public_api::Builder::from_rustdoc_json(json)
            .omit_blanket_impls(true)
            .omit_auto_trait_impls(true)
            .omit_auto_derived_impls(true)
            .build()
            .unwrap();
        let items: String = api.items().map(|item| format!("{item}\n")).collect();
        insta::assert_snapshot!(format!("api-{library}"), items);
    }
}
