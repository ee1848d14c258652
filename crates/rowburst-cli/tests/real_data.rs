//! Real captures and reference problems, used in place from `../shared` where it is
//! there; skipped with a message where it is not.

use std::path::{Path, PathBuf};
use std::process::Command;

fn shared(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../../shared")
        .join(folder);
    if !path.exists() {
        println!("skipped: {} is not here", path.display());
        return None;
    }
    Some(path)
}

fn rowburst(arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rowburst"));
    let output = command.args(arguments).output().unwrap();
    let talk = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{talk}");
    String::from_utf8(output.stdout).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The default prior, τ and σ from the frame, on problems made by another program. The
/// bounds lie about a decibel below what is reached.
#[test]
fn reference_problems_are_solved_well() {
    let bounds = [
        ("digits12", 47.0),
        ("digits18", 46.0),
        ("leds", 59.5),
        ("moving1", 46.5),
        ("digits12-measured-psf", 44.5),
    ];
    for (problem, at_least) in bounds {
        let Some(folder) = shared(&format!("problems/{problem}")) else {
            return;
        };
        let out = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.join(name);
        let json = rowburst(&[
            "reconstruct",
            text(&file("experiment.toml")),
            "--frame",
            text(&file("frame.npy")),
            "--psf",
            text(&file("psf.npy")),
            "--truth",
            text(&file("truth.npy")),
            "--json",
            "-o",
            text(out.path()),
        ]);
        let result: serde_json::Value = serde_json::from_str(&json).unwrap();
        let psnr = result["psnr_db"].as_f64().unwrap();
        println!("{problem}: {psnr:.2} dB, {}", result["stop_reason"]);
        assert!(psnr > at_least, "{problem}: {psnr} dB");
    }
}

/// DiffuserCam: a raw capture and a measured PSF, lensless, field twice the sensor. A
/// line across the fingers must cross four of them with dark between.
#[test]
fn a_hand_with_separate_fingers_is_seen() {
    let Some(data) = shared("data/diffusercam-still") else {
        return;
    };
    let out = tempfile::tempdir().unwrap();
    let experiment = out.path().join("experiment.toml");
    let camera =
        "rows = 150\ncolumns = 200\nshutter = \"global\"\nexposure_us = 10000\nbinning = 8";
    let toml = format!("[camera]\n{camera}\n\n[field]\nrows = 300\ncolumns = 400\n");
    std::fs::write(&experiment, toml).unwrap();
    rowburst(&[
        "reconstruct",
        text(&experiment),
        "--frame",
        text(&data.join("rawdata_hand_sample.tif")),
        "--psf",
        text(&data.join("psf_sample.tif")),
        "--max-iterations",
        "60",
        "-o",
        text(&out.path().join("result")),
    ]);
    let video = rowburst_io::read_video(&out.path().join("result/video.npy")).unwrap();
    assert_eq!((video.shape().rows, video.shape().columns), (300, 400));
    let across: Vec<f32> = (125..190)
        .map(|y| {
            video.bin(0)[y * 400 + 248..y * 400 + 254]
                .iter()
                .sum::<f32>()
                / 6.0
        })
        .collect();
    let bright = across.iter().copied().fold(0.0, f32::max);
    let lit: Vec<bool> = across.iter().map(|&v| v > 0.3 * bright).collect();
    let fingers = lit.windows(2).filter(|pair| !pair[0] && pair[1]).count();
    assert_eq!(fingers, 4, "{across:?}");
}
