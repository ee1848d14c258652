//! The same instant has the same time in every output: its zero is the start of exposure of the row that is read first.

use rowburst::bayer::Bayer;
use rowburst::camera::CameraParams;
use rowburst::{Camera, Image, Sensor, Shutter};
use rowburst_io::{Experiment, OutputFolder, read_image, write_npy_image};
use rowburst_run::options::UserOptions;
use rowburst_run::{
    MovieStyle, Output, Request, RequestParams, VideoFormat, figure_of_folder, read_experiment,
};
use serde_json::Value;
use std::fs;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};
use std::time::Instant;
use tempfile::TempDir;

const SIDE: usize = 8;
const ROW_US: f64 = 10.0;
const DELAY_US: f64 = 12.5;

struct Lab {
    folder: TempDir,
    camera: Camera,
}

impl Lab {
    fn new(shutter: Shutter, exposure_us: f64, bins_per_row: usize, bayer: Option<Bayer>) -> Self {
        let params = CameraParams {
            rows: SIDE,
            columns: SIDE,
            shutter,
            row_time_us: ROW_US,
            exposure_us,
            bins_per_row,
            field: None,
            sensor: Sensor {
                pixel_pitch_um: Some(6.5),
                magnification: Some(0.5),
                trigger_delay_us: Some(DELAY_US),
                gain_electrons_per_count: Some(0.5),
                ..Sensor::default()
            },
        };
        let folder = tempfile::tempdir().unwrap();
        let files = OutputFolder::create(folder.path()).unwrap();
        let pixel = |y: usize, x: usize| ((y * 31 + x * 17 + y * x) % 23) as f32;
        for (name, side) in [("frame.npy", SIDE), ("psf.npy", 2 * SIDE + 1)] {
            let image = Image::from_fn(side, side, pixel);
            files.write(name, |w| write_npy_image(w, &image)).unwrap();
        }
        let mut experiment = Experiment::new(params.clone());
        experiment.calibration.psf = Some(folder.path().join("psf.npy"));
        experiment.bayer = bayer;
        let text = experiment.to_toml(files.path());
        files
            .write_bytes("experiment.toml", text.as_bytes())
            .unwrap();
        Self {
            folder,
            camera: Camera::new(params).unwrap(),
        }
    }

    /// Reconstructs into `result`, in all formats.
    fn run(&self, bins: Option<Range<usize>>, bins_per_chunk: Option<usize>) -> PathBuf {
        let (frame, out) = (self.folder.path().join("frame.npy"), self.folder.path());
        let observe = &mut |_: rowburst_run::Event| ControlFlow::Continue(());
        let experiment = read_experiment(&out.join("experiment.toml"), &frame, observe).unwrap();
        let regions = match experiment.bayer {
            None => vec!["3,3".to_string()],
            Some(_) => Vec::new(),
        };
        let params = RequestParams {
            options: UserOptions {
                prior: Some("tv"),
                noise_sigma: Some(0.1),
                self_calibrate: Some("off"),
                keep_all_pixels: true,
                max_iterations: Some(3),
                ..Default::default()
            },
            bins,
            bins_per_chunk,
            regions: &regions,
            ..Default::default()
        };
        let request = Request::read(&experiment, &frame, params, observe).unwrap();
        let folder = out.join("result");
        // rowburst-io tests HDF5.
        let formats = [
            VideoFormat::Tif,
            VideoFormat::Mat,
            #[cfg(feature = "zarr")]
            VideoFormat::Zarr,
        ];
        let output = Output {
            folder: &OutputFolder::create(&folder).unwrap(),
            title: "Test",
            reproduce: None,
            movie: MovieStyle::Plain,
            formats: bins_per_chunk.is_none().then_some(&formats[..]),
            record: None,
        };
        request.run(&output, Instant::now(), observe).unwrap();
        folder
    }
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

fn near(found: f64, expected: f64, what: &str) {
    assert!(
        (found - expected).abs() < 1e-3,
        "{what}: {found}, not {expected}"
    );
}

/// Checks that the first bin of the result in `folder` starts at `start_us`, and that bins last `step_us`, in every file.
fn check_times(folder: &Path, start_us: f64, step_us: f64) {
    let middle = |bin: usize| start_us + (bin as f64 + 0.5) * step_us;
    let result = json(&folder.join("result.json"));
    near(
        result["start_us"].as_f64().unwrap(),
        start_us,
        "result.json",
    );
    near(
        result["trigger_delay_us"].as_f64().unwrap(),
        DELAY_US,
        "delay",
    );
    let bins = result["frames"].as_u64().unwrap() as usize;

    let view = json(&folder.join("view.json"));
    near(view["start_us"].as_f64().unwrap(), start_us, "view.json");
    near(
        view["bin_duration_us"].as_f64().unwrap(),
        step_us,
        "view.json",
    );
    assert_eq!(view["trigger_delay_us"], DELAY_US);
    assert_eq!(view["magnification"], 0.5);
    assert_eq!(view["gain_electrons_per_count"], 0.5);

    let traces = fs::read_to_string(folder.join("traces.csv")).unwrap();
    let times = traces
        .lines()
        .skip(1)
        .map(|line| line.split(',').next().unwrap());
    let times: Vec<f64> = times.map(|time| time.parse().unwrap()).collect();
    assert_eq!(times.len(), bins);
    for (bin, time) in times.into_iter().enumerate() {
        near(time, middle(bin), "traces.csv");
    }

    let tiff = fs::read(folder.join("video.tif")).unwrap();
    let text = String::from_utf8_lossy(&tiff);
    let first = text.split("time_of_first_frame=").nth(1).unwrap();
    let first: f64 = first.lines().next().unwrap().parse().unwrap();
    near(first * 1e6, middle(0), "video.tif");

    if bins > 1 {
        let mat = format!("{}:time_us", folder.join("video.mat").display());
        let mat = read_image(mat.as_ref()).unwrap().image;
        assert_eq!(mat.data().len(), bins);
        for (bin, time) in mat.data().iter().enumerate() {
            near(f64::from(*time), middle(bin), "video.mat");
        }
    }

    #[cfg(feature = "zarr")]
    {
        let zarr = json(&folder.join("video.ome.zarr/zarr.json"));
        let dataset = &zarr["attributes"]["ome"]["multiscales"][0]["datasets"][0];
        let maps = &dataset["coordinateTransformations"];
        near(maps[0]["scale"][0].as_f64().unwrap(), step_us, "zarr");
        near(
            maps[1]["translation"][0].as_f64().unwrap(),
            middle(0),
            "zarr",
        );
        // Files keep the pitch of the sensor.
        near(
            maps[0]["scale"][1].as_f64().unwrap(),
            view["pixel_pitch_um"].as_f64().unwrap(),
            "zarr",
        );
    }

    let report = fs::read_to_string(folder.join("report.html")).unwrap();
    for words in [
        "12.5 µs after the trigger",
        "at the object",
        "1 count is 0.5 electrons",
    ] {
        assert!(report.contains(words), "{words}");
    }
    assert!(figure_of_folder(folder, &rowburst_report::Layout::Fig2.into()).is_ok());
}

/// A bin is `step` long, and the exposure of the first row begins at 0.
#[test]
fn every_file_has_the_same_clock() {
    for (shutter, exposure_us, bins_per_row, start_us) in [
        (Shutter::TopDown, 10.0, 1, 0.0),
        (Shutter::BottomUp, 4.0, 1, -6.0),
        (Shutter::DualInsideOut, 10.0, 2, 0.0),
        (Shutter::DualOutsideIn, 17.0, 1, -3.0),
        (Shutter::TopDown, 30.0, 1, 0.0),
    ] {
        let lab = Lab::new(shutter, exposure_us, bins_per_row, None);
        let step_us = ROW_US / bins_per_row as f64;
        near(lab.camera.time().start_us(), start_us, "camera");
        check_times(&lab.run(None, None), start_us, step_us);
    }
}

/// A range of bins has the times that these bins have in the whole video.
#[test]
fn a_range_of_bins_keeps_its_times() {
    let lab = Lab::new(Shutter::TopDown, 4.0, 1, None);
    check_times(&lab.run(Some(3..6), None), 24.0, ROW_US);
}

#[test]
fn a_video_in_chunks_has_the_same_clock() {
    let lab = Lab::new(Shutter::TopDown, 4.0, 1, None);
    let result = json(&lab.run(Some(2..8), Some(2)).join("result.json"));
    assert_eq!(result["first_bin"], 2);
    near(result["start_us"].as_f64().unwrap(), 14.0, "result.json");
    assert_eq!(result["trigger_delay_us"], DELAY_US);
}

/// Planes count from the first exposure of the sensor, not from their own.
#[test]
fn planes_have_the_clock_of_the_sensor() {
    let lab = Lab::new(Shutter::TopDown, 4.0, 1, Some(Bayer::Rggb));
    let folder = lab.run(None, None);
    let result = json(&folder.join("result.json"));
    // A bin of a plane is two row times long; its first exposure is the end of bin 0.
    near(result["start_us"].as_f64().unwrap(), -16.0, "colour");
    for plane in result["planes"].as_array().unwrap() {
        let name = plane["name"].as_str().unwrap();
        let start_us = match name {
            "red" | "green-1" => -16.0,
            _ => -6.0,
        };
        near(plane["start_us"].as_f64().unwrap(), start_us, name);
        check_times(&folder.join(name), start_us, 2.0 * ROW_US);
    }
}
