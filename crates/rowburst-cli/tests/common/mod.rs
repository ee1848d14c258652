//! A folder with a small experiment, and the program run in it as a user runs it.

#![allow(dead_code, reason = "each test file uses only some of these helpers")]

use ndarray::Array3;
use rowburst::{Image, Shape, Video};
use serde_json::Value;
use std::path::PathBuf;
use std::process::{Command, Output};
use tempfile::TempDir;

/// The program under test.
pub fn program() -> PathBuf {
    assert_cmd::cargo::cargo_bin!("rowburst").to_path_buf()
}

/// A temporary folder with `experiment.toml`, `frame.npy` and `psf.npy` of
/// [`ROWS`] × [`COLUMNS`] pixels, which reconstruct without a complaint.
pub struct Lab {
    folder: TempDir,
}

pub const ROWS: usize = 12;
pub const COLUMNS: usize = 10;

/// The `[camera]` of the experiment.
pub const CAMERA: &str = "[camera]
rows = 12
columns = 10
shutter = \"dual-inside-out\"
row_time_us = 9.6
exposure_us = 9.6
";

/// Numbers that look like noise, the same in every run, from 0 to 1.
pub fn pattern(y: usize, x: usize) -> f32 {
    let mut bits = (y * 1009 + x + 1) as u32;
    for _ in 0..3 {
        bits = (bits ^ (bits >> 15)).wrapping_mul(0x2c1b_3c6d);
    }
    (bits >> 8) as f32 / 16_777_216.0
}

impl Lab {
    pub fn new() -> Self {
        let lab = Self::empty();
        lab.experiment(&format!("{CAMERA}[calibration]\npsf = \"psf.npy\"\n"));
        lab.image("frame.npy", ROWS, COLUMNS, |y, x| {
            100.0 + 50.0 * pattern(y, x)
        });
        lab.image("psf.npy", 9, 7, |y, x| pattern(y + 50, x).powi(2));
        lab
    }

    /// A folder with nothing in it.
    pub fn empty() -> Self {
        Self {
            folder: tempfile::tempdir().expect("a temporary folder can be made"),
        }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    pub fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    /// The first `part` of the bytes of `from`, as `to`.
    pub fn truncate(&self, from: &str, part: f64, to: &str) {
        let bytes = self.read(from);
        self.write(to, &bytes[..(bytes.len() as f64 * part) as usize]);
    }

    pub fn experiment(&self, text: &str) {
        self.write("experiment.toml", text);
    }

    /// Writes an image in the format of its name: `.npy` and `.tif` as float32,
    /// `.png` as 16 bit.
    pub fn image(
        &self,
        name: &str,
        rows: usize,
        columns: usize,
        value: impl Fn(usize, usize) -> f32,
    ) {
        let image = Image::from_fn(rows, columns, value);
        let mut bytes = std::io::Cursor::new(Vec::new());
        match name.rsplit_once('.').map(|(_, end)| end) {
            Some("tif") => rowburst_io::write_tiff_image(&mut bytes, &image),
            Some("png") => {
                let counts: Vec<u16> = image.data().iter().map(|&v| v as u16).collect();
                rowburst_io::write_png16(&mut bytes, rows, columns, &counts)
            }
            _ => rowburst_io::write_npy_image(&mut bytes, &image),
        }
        .unwrap();
        self.write(name, bytes.into_inner());
    }

    /// Writes a video `[t, y, x]` as `.npy`.
    pub fn video(&self, name: &str, shape: [usize; 3], value: impl Fn(usize) -> f32) {
        let shape = Shape::new(shape[0], shape[1], shape[2]);
        let video = Video::new(shape, (0..shape.voxels()).map(value).collect()).unwrap();
        let mut bytes = Vec::new();
        rowburst_io::write_npy_video(&mut bytes, &video).unwrap();
        self.write(name, bytes);
    }

    /// Writes the order of a custom shutter.
    pub fn order(&self, name: &str, order: &[i64]) {
        ndarray_npy::write_npy(self.path(name), &ndarray::arr1(order)).unwrap();
    }

    /// The program with `arguments` (split at spaces), to be run in the folder.
    pub fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(program());
        command
            .args(arguments.split_whitespace())
            .current_dir(self.folder.path());
        command
    }

    /// Runs the program with `arguments` to its end.
    pub fn run(&self, arguments: &str) -> Output {
        self.command(arguments).output().unwrap()
    }

    /// Runs the program, which must succeed; its standard output.
    pub fn done(&self, arguments: &str) -> String {
        let output = self.run(arguments);
        assert!(
            output.status.success(),
            "rowburst {arguments}\n{}\n{}",
            output.status,
            String::from_utf8_lossy(&output.stderr)
        );
        String::from_utf8(output.stdout).unwrap()
    }

    /// `result.json` of the folder `out`.
    pub fn result(&self, out: &str) -> Value {
        serde_json::from_slice(&self.read(&format!("{out}/result.json"))).unwrap()
    }

    /// The number `key` of `result.json`.
    pub fn number(&self, out: &str, key: &str) -> f64 {
        let result = self.result(out);
        result[key]
            .as_f64()
            .unwrap_or_else(|| panic!("{key} in {result:#}"))
    }

    /// A video, read by another library than the program's.
    pub fn array(&self, name: &str) -> Array3<f32> {
        ndarray_npy::read_npy(self.path(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
    }

    /// Names of all files in `folder` but Rowburst's own list of them, sorted; hidden ones too.
    pub fn files(&self, folder: &str) -> Vec<String> {
        let Ok(entries) = std::fs::read_dir(self.path(folder)) else {
            return Vec::new();
        };
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.retain(|name| name != ".rowburst-files");
        names.sort();
        names
    }
}
