//! Videos are pinned: a change that is not meant to change numbers changes no bit of them.
//!
//! `pins.json` holds, for each problem, the SHA-256 of `video.npy` on each processor that has been seen, and a sketch:
//! [`SKETCH`] sums of the voxels with pseudo-random signs, from which the relative error of another video follows to
//! some 10 %. Vector loops, FFTs and matrix products choose their instructions and block sizes by the processor, so bits
//! hold on one kind of processor only; on a kind without an entry, or of another `ALGORITHM_REVISION`, the sketch is compared
//! instead.
//!
//! After a change of numerics that is meant, renew the file and say so in the commit and in `CHANGELOG.md`:
//! `UPDATE_PINS=1 cargo test --workspace --test pins`.

mod common;

use common::Lab;
use rowburst::reconstruct::ALGORITHM_REVISION;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Relative error within which a video on another kind of processor is the same: the acceleration of settled runs amplifies
/// rounding, to 2e-5 of a video between AVX-512 and portable instructions (docs/design/033).
const SAME: f64 = 1e-4;

/// Sums in the sketch of a video.
const SKETCH: usize = 64;

/// Options that leave nothing to a rule that may change; σ is given for each problem.
const OPTIONS: &str =
    "--prior tv+0.5*tdiff+support --tau auto --keep-all-pixels --self-calibrate off";

/// The problems in `../shared/problems` with their σ, the rms of the frame over 256.
const SHARED: [(&str, &str); 5] = [
    ("digits12", "4.592e-6"),
    ("digits12-measured-psf", "4.855e-6"),
    ("digits18", "1.1176e-5"),
    ("leds", "1.0559e-6"),
    ("moving1", "9.2165e-6"),
];

/// Small problems that the program simulates itself: name, camera, scene and σ.
const SIMULATED: [(&str, &str, &str, &str); 3] = [
    (
        "small-digits",
        "rows = 36\ncolumns = 30\nshutter = \"dual-inside-out\"\nrow_time_us = 10\nexposure_us = 10\n",
        "digits --digit-px 8",
        "1.76e-5",
    ),
    (
        "small-moving-long-exposure",
        "rows = 30\ncolumns = 33\nshutter = \"dual-outside-in\"\nrow_time_us = 10\nexposure_us = 25\n",
        "moving --digit-px 8",
        "4.4e-5",
    ),
    (
        "small-leds-sub-row",
        "rows = 24\ncolumns = 27\nshutter = \"top-down\"\nrow_time_us = 10\nexposure_us = 10\nbins_per_row = 2\n",
        "leds",
        "1.373e-5",
    ),
];

/// What is known of a video.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Pin {
    /// The `ALGORITHM_REVISION` that `sha256` is of.
    revision: u32,
    /// SHA-256 of `video.npy` by kind of processor.
    sha256: BTreeMap<String, String>,
    sketch: Vec<f64>,
}

type Pins = BTreeMap<String, Pin>;

fn pins_file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/pins.json")
}

/// What the bits of a video depend on besides the program: instruction set of the vector loops, processor and
/// caches (matrix products choose their blocks by these).
fn processor(simd: &str) -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        let line = info
            .lines()
            .find(|line| line.split(':').next().is_some_and(|key| key.trim() == name));
        line.and_then(|line| line.split(':').nth(1))
            .map_or("?", str::trim)
    };
    let mut text = format!(
        "{simd}, {} {}/{}",
        field("vendor_id"),
        field("cpu family"),
        field("model")
    );
    for index in 0..4 {
        let of_cache = |name: &str| {
            let path = format!("/sys/devices/system/cpu/cpu0/cache/index{index}/{name}");
            std::fs::read_to_string(path).map_or("?".into(), |text| text.trim().to_string())
        };
        if of_cache("type") != "Instruction" {
            let (level, size) = (of_cache("level"), of_cache("size"));
            write!(text, ", L{level} {size}/{}", of_cache("shared_cpu_list")).unwrap();
        }
    }
    text
}

/// Sums of all voxels with signs that depend on voxel and sum.
fn sketch(video: &[f32]) -> Vec<f64> {
    let mut sums = vec![0.0; SKETCH];
    for (i, &value) in video.iter().enumerate() {
        // SplitMix64: each bit of its output is one sign.
        let mut bits = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^= bits >> 31;
        for (j, sum) in sums.iter_mut().enumerate() {
            let sign = if bits >> j & 1 == 1 { 1.0 } else { -1.0 };
            *sum += sign * f64::from(value);
        }
    }
    sums
}

/// Estimate of the relative error of the videos of two sketches.
fn relative_error(sketch: &[f64], pinned: &[f64]) -> f64 {
    assert_eq!(sketch.len(), pinned.len(), "sums of a sketch");
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let mut differences = sketch.iter().zip(pinned).map(|(a, b)| a - b);
    norm(&mut differences) / norm(&mut pinned.iter().copied())
}

/// Reconstructs with 1 and with 2 threads, and compares with what is pinned. An error says what differs.
fn check(lab: &Lab, name: &str, arguments: &str, pins: &mut Pins, renew: bool) -> Option<String> {
    let mut digests = Vec::new();
    for threads in [1, 2] {
        lab.done(&format!(
            "--threads {threads} reconstruct {arguments} {OPTIONS} -o result"
        ));
        let mut digest = String::new();
        for byte in Sha256::digest(lab.read("result/video.npy")) {
            write!(digest, "{byte:02x}").unwrap();
        }
        digests.push(digest);
    }
    if digests[0] != digests[1] {
        return Some(format!("{name}: 1 and 2 threads give other bits"));
    }
    let simd = lab.result("result")["simd"].as_str().unwrap().to_string();
    let key = processor(&simd);
    let sums = sketch(lab.array("result/video.npy").as_slice().unwrap());
    if renew {
        let pin = pins.entry(name.into()).or_default();
        let is_other = pin
            .sha256
            .get(&key)
            .is_some_and(|pinned| *pinned != digests[0]);
        if is_other
            || pin.revision != ALGORITHM_REVISION
            || relative_error(&sums, &pin.sketch) > SAME
        {
            // Entries of other processors are of the numbers before.
            *pin = Pin {
                revision: ALGORITHM_REVISION,
                sha256: BTreeMap::new(),
                sketch: sums,
            };
        }
        pin.sha256.insert(key, digests.remove(0));
        return None;
    }
    let pin = &pins[name];
    let error = relative_error(&sums, &pin.sketch);
    let pinned = pin.sha256.get(&key);
    match pinned.filter(|_| pin.revision == ALGORITHM_REVISION) {
        Some(pinned) if *pinned == digests[0] => None,
        Some(_) => Some(format!(
            "{name}: other bits than those pinned; relative error {error:.1e}"
        )),
        None => {
            println!(
                "{name}: no entry of revision {ALGORITHM_REVISION} for \"{key}\"; compared by relative error, {error:.1e} of {SAME:.0e}"
            );
            // `is_nan` counts as a difference.
            (error.partial_cmp(&SAME) != Some(std::cmp::Ordering::Less))
                .then(|| format!("{name}: relative error {error:.1e} above {SAME:.0e}"))
        }
    }
}

#[test]
fn videos_are_those_that_are_pinned() {
    let renew = std::env::var_os("UPDATE_PINS").is_some();
    let mut pins: Pins = match std::fs::read(pins_file()) {
        Ok(bytes) => serde_json::from_slice(&bytes).unwrap(),
        Err(_) if renew => Pins::new(),
        Err(error) => panic!("{}: {error}", pins_file().display()),
    };
    let mut different = Vec::new();
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/problems");
    if shared.is_dir() {
        for (name, sigma) in SHARED {
            let folder = shared.join(name).canonicalize().unwrap();
            let folder = folder.to_str().unwrap();
            let lab = Lab::empty();
            let arguments = format!(
                "{folder}/experiment.toml --frame {folder}/frame.npy --psf {folder}/psf.npy --noise-sigma {sigma}"
            );
            different.extend(check(&lab, name, &arguments, &mut pins, renew));
        }
    } else {
        println!("skipped: {} is not there", shared.display());
    }
    for (name, camera, scene, sigma) in SIMULATED {
        let lab = Lab::empty();
        lab.experiment(&format!("[camera]\n{camera}"));
        lab.done(&format!(
            "simulate experiment.toml --scene {scene} --seed 5 -o sim"
        ));
        let arguments = format!("sim/experiment.toml --frame sim/frame.npy --noise-sigma {sigma}");
        different.extend(check(&lab, name, &arguments, &mut pins, renew));
    }
    if renew {
        let text = serde_json::to_string_pretty(&pins).unwrap() + "\n";
        std::fs::write(pins_file(), text).unwrap();
    }
    assert!(
        different.is_empty(),
        "{}\nA change that is meant to change numbers renews tests/pins.json (see the head of tests/pins.rs).",
        different.join("\n")
    );
}
