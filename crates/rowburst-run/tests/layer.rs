//! The application layer on its own: requests from files and from values, their events, artifacts and errors.

use rowburst::bayer::Bayer;
use rowburst::camera::CameraParams;
use rowburst::simulate::scene;
use rowburst::solve::StopReason;
use rowburst::{Camera, Cancel, ErrorKind, Image, PatchSet, Psf, Result, Sensor, Shutter};
use rowburst_io::{
    Calibration, Capture, Experiment, OutputFolder, SampleFormat, read_video, write_npy_image,
};
use rowburst_run::options::UserOptions;
use rowburst_run::simulate::{NoiseChoice, Scene, Simulation, simulate};
use rowburst_run::{
    Artifacts, Bias, ColourTask, Event, Frame, MovieStyle, Observer, Output, Request,
    RequestParams, Setup, Summary, bias_of_array, read_experiment, solve,
};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::Command;
use std::time::Instant;
use tempfile::TempDir;

const SIDE: usize = 16;

/// A folder with the files of a small experiment, and its values.
struct Lab {
    folder: TempDir,
    camera: Camera,
    psfs: PatchSet,
    frame: Image,
}

impl Lab {
    fn new(bayer: Option<Bayer>) -> Self {
        let params = CameraParams {
            rows: SIDE,
            columns: SIDE,
            shutter: Shutter::TopDown,
            row_time_us: 10.0,
            exposure_us: 10.0,
            bins_per_row: 1,
            field: None,
            sensor: Sensor::default(),
        };
        let camera = Camera::new(params.clone()).unwrap();
        let pixel = |y: usize, x: usize| ((y * 31 + x * 17 + y * x) % 23) as f32;
        let psf = Psf::new(Image::from_fn(2 * SIDE + 1, 2 * SIDE + 1, pixel)).unwrap();
        let psfs = PatchSet::from(psf);
        let video = scene::digits(camera.video_shape(), 8, 1).unwrap();
        let made = simulate(&Simulation {
            camera: &camera,
            psfs: &psfs,
            scene: Scene::Video(video),
            background: None,
            noise: NoiseChoice::Snr(100.0),
            seed: 1,
            digit_height_px: 8,
        });
        let lab = Self {
            folder: tempfile::tempdir().unwrap(),
            frame: made.unwrap().recorded.frame,
            camera,
            psfs,
        };
        let files = lab.output("");
        for (name, image) in [
            ("frame.npy", &lab.frame),
            ("psf.npy", lab.psfs.central().image()),
        ] {
            files.write(name, |w| write_npy_image(w, image)).unwrap();
        }
        let mut experiment = Experiment::new(params);
        experiment.calibration.psf = Some(lab.path("psf.npy"));
        experiment.bayer = bayer;
        let text = experiment.to_toml(files.path());
        files
            .write_bytes("experiment.toml", text.as_bytes())
            .unwrap();
        lab
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn output(&self, name: &str) -> OutputFolder {
        OutputFolder::create(&self.path(name)).unwrap()
    }

    /// The values of the experiment.
    fn setup(&self) -> Setup {
        Setup {
            options: rowburst::reconstruct::Options {
                prior: Some("tv".parse().unwrap()),
                noise_sigma: Some(0.01),
                max_iterations: Some(10),
                self_calibration: rowburst::reconstruct::SelfCalibration::OFF,
                keep_all_pixels: true,
                ..Default::default()
            },
            ..Setup::new(self.camera.clone(), self.psfs.clone())
        }
    }

    /// The frame as an array.
    fn array(&self) -> Frame {
        Frame {
            capture: Capture {
                image: self.frame.clone(),
                format: SampleFormat::Float,
            },
            bias: bias_of_array(SampleFormat::Float),
            file: None,
        }
    }

    /// Reads the request and runs it; all events as words.
    fn run(&self, params: RequestParams) -> Result<(Artifacts, Vec<String>)> {
        let mut events = Vec::new();
        let mut observe = |event: Event| {
            events.push(match event {
                Event::Note(note) => format!("note: {note}"),
                Event::Plane(site) => format!("plane {}", site.name()),
                Event::Iteration {
                    progress,
                    chunk: None,
                    ..
                } => format!("iteration {}", progress.iteration),
                Event::Iteration {
                    chunk: Some(chunk), ..
                } => format!("bins {:?} of {}", chunk.bins, chunk.video_bins),
                Event::Writing => "writing".into(),
                _ => unreachable!(),
            });
            ControlFlow::Continue(())
        };
        let artifacts = self.run_into("result", params, &mut observe)?;
        events.dedup();
        Ok((artifacts, events))
    }

    /// Reads the request and runs it into the folder `name`.
    fn run_into(&self, name: &str, params: RequestParams, observe: Observer) -> Result<Artifacts> {
        let frame = self.path("frame.npy");
        let experiment = read_experiment(&self.path("experiment.toml"), &frame, observe)?;
        let request = Request::read(&experiment, &frame, params, observe)?;
        let output = Output {
            folder: &self.output(name),
            title: "Test",
            reproduce: None,
            movie: MovieStyle::Stamped,
            formats: None,
            record: None,
        };
        request.run(&output, Instant::now(), observe)
    }

    /// Runs in chunks of four bins into the folder `name`, and stops before bin `end`; the chunks of which an iteration
    /// was done.
    fn run_until(&self, name: &str, end: usize, params: RequestParams) -> Vec<usize> {
        let mut chunks = Vec::new();
        let params = RequestParams {
            bins_per_chunk: Some(4),
            ..params
        };
        let run = self.run_into(name, params, &mut |event| {
            if let Event::Iteration {
                chunk: Some(chunk), ..
            } = event
            {
                if chunk.bins.start >= end {
                    return ControlFlow::Break(StopReason::Interrupted);
                }
                chunks.push(chunk.bins.start);
            }
            ControlFlow::Continue(())
        });
        assert_eq!(run.is_ok(), end >= SIDE);
        chunks.dedup();
        chunks
    }
}

/// Options that make a run short, equal to those of [`Lab::setup`].
fn quick() -> RequestParams<'static> {
    RequestParams {
        options: UserOptions {
            prior: Some("tv"),
            noise_sigma: Some(0.01),
            self_calibrate: Some("off"),
            keep_all_pixels: true,
            max_iterations: Some(10),
            ..Default::default()
        },
        ..Default::default()
    }
}

#[test]
fn a_whole_video_is_the_same_from_files_and_from_values() {
    let lab = Lab::new(None);
    let (artifacts, events) = lab.run(quick()).unwrap();
    let iterations = (1..=10).map(|i| format!("iteration {i}"));
    let expected: Vec<String> = iterations.chain(["writing".to_string()]).collect();
    assert_eq!(events, expected);
    let Summary::Whole(summary) = &artifacts.summary else {
        panic!("a whole video");
    };
    assert_eq!(
        (summary.frames, summary.rows, summary.iterations),
        (SIDE, SIDE, 10)
    );
    assert!(artifacts.first_file().is_file());
    let task = lab.setup().task(&lab.array(), None).unwrap();
    let completed = solve(task, Instant::now(), &mut |_| ControlFlow::Continue(())).unwrap();
    let written = read_video(&artifacts.video()).unwrap();
    assert_eq!(completed.reconstruction.video.data(), written.data());
    assert_eq!(completed.reconstruction.tau, summary.tau);
}

#[test]
fn chunks_come_in_order() {
    let lab = Lab::new(None);
    let params = RequestParams {
        bins_per_chunk: Some(8),
        ..quick()
    };
    let (artifacts, events) = lab.run(params).unwrap();
    assert_eq!(events, ["bins 0..8 of 16", "bins 8..16 of 16"]);
    let Summary::Chunked(summary) = &artifacts.summary else {
        panic!("a video in chunks");
    };
    assert_eq!(summary.parts.len(), 2);
    let whole = read_video(&artifacts.video()).unwrap();
    let mut stored = artifacts.open_video().unwrap();
    assert_eq!((whole.shape(), whole.shape().bins), (stored.shape(), SIDE));
    assert_eq!(stored.bin(9).unwrap().data(), whole.bin(9));
}

/// The state of another job is gone before its bins are replaced. Killed in between, neither job resumes with bins of the
/// other.
#[test]
fn a_job_in_chunks_leaves_nothing_that_another_resumes() {
    let lab = Lab::new(None);
    let other = || RequestParams {
        options: UserOptions {
            noise_sigma: Some(0.02),
            ..quick().options
        },
        bins_per_chunk: Some(4),
        ..quick()
    };
    assert_eq!(lab.run_until("result", 8, quick()), [0, 4]);
    let state = lab.path("result/parts.json");
    assert!(state.is_file());
    let mut is_checked = false;
    let stopped = lab.run_into("result", other(), &mut |event| {
        if let Event::Iteration { .. } = event {
            assert!(!state.exists(), "bins are replaced next");
            is_checked = true;
            return ControlFlow::Break(StopReason::Interrupted);
        }
        ControlFlow::Continue(())
    });
    assert!(is_checked && stopped.is_err());
    // The first job begins anew.
    assert_eq!(lab.run_until("result", SIDE, quick()), [0, 4, 8, 12]);
}

/// Another number of iterations gives another video: it is another job.
#[test]
fn a_job_in_chunks_depends_on_all_options() {
    let lab = Lab::new(None);
    assert_eq!(lab.run_until("result", 8, quick()), [0, 4]);
    assert_eq!(lab.run_until("result", 12, quick()), [8]);
    let shorter = RequestParams {
        options: UserOptions {
            max_iterations: Some(5),
            ..quick().options
        },
        ..quick()
    };
    assert_eq!(lab.run_until("result", SIDE, shorter), [0, 4, 8, 12]);
}

/// A process that ends between the last chunk and `result.json`, before and after the video takes its name.
#[test]
fn complete_chunks_are_not_computed_again() {
    let lab = Lab::new(None);
    lab.run_until("calm", SIDE, quick());
    let calm = std::fs::read(lab.path("calm/video.npy")).unwrap();
    for obstacle in ["report.html", "result.json"] {
        let name = format!("of-{obstacle}");
        let blocked = lab.path(&name).join(obstacle);
        let params = || RequestParams {
            bins_per_chunk: Some(4),
            ..quick()
        };
        // A folder in the way of the file.
        let run = lab.run_into(&name, params(), &mut |event| {
            if let Event::Iteration { .. } = event {
                std::fs::create_dir_all(&blocked).unwrap();
            }
            ControlFlow::Continue(())
        });
        assert!(run.is_err(), "{obstacle} is a folder");
        assert_eq!(
            lab.path(&name).join("video.npy").exists(),
            obstacle == "result.json"
        );
        std::fs::remove_dir(&blocked).unwrap();
        assert_eq!(
            lab.run_until(&name, SIDE, quick()),
            [0usize; 0],
            "{obstacle}"
        );
        assert!(std::fs::read(lab.path(&name).join("video.npy")).unwrap() == calm);
        assert!(!lab.path(&name).join("parts.json").exists());
    }
}

/// Values have no experiment file that has been checked.
#[test]
fn values_in_other_units_are_refused() {
    let lab = Lab::new(None);
    let mut setup = lab.setup();
    let params = CameraParams {
        row_time_us: 1e-5,
        exposure_us: 1e-5,
        ..lab.camera.params().clone()
    };
    setup.camera = Camera::new(params).unwrap();
    let error = setup.task(&lab.array(), None).err().expect("seconds");
    assert!(error.to_string().contains("seconds"), "{error}");
}

#[test]
fn a_range_of_bins_is_that_of_its_rows() {
    let lab = Lab::new(None);
    let params = RequestParams {
        bins: Some(4..8),
        ..quick()
    };
    let (artifacts, _) = lab.run(params).unwrap();
    assert_eq!(read_video(&artifacts.video()).unwrap().shape().bins, 4);
}

#[test]
fn planes_of_a_colour_frame_come_green_first() {
    let lab = Lab::new(Some(Bayer::Rggb));
    let (artifacts, events) = lab.run(quick()).unwrap();
    let planes: Vec<&String> = events.iter().filter(|e| e.starts_with("plane")).collect();
    assert_eq!(
        planes,
        ["plane green-1", "plane green-2", "plane red", "plane blue"]
    );
    let Summary::Colour(summary) = &artifacts.summary else {
        panic!("a video in colour");
    };
    assert_eq!((summary.frames, summary.planes.len()), (8, 4));
    assert!(artifacts.video().is_file() && artifacts.first_file().is_file());

    let task = ColourTask {
        setup: lab.setup(),
        mosaic: Bayer::Rggb,
        frame: lab.array(),
        seed: 0,
        debias: false,
    };
    let mut taus = Vec::new();
    let reconstructed = task.reconstruct(
        Instant::now(),
        &mut |_| ControlFlow::Continue(()),
        &mut |plane| {
            taus.push(plane.completed.reconstruction.tau);
            Ok(())
        },
    );
    reconstructed.unwrap();
    let written: Vec<f64> = summary.planes.iter().map(|plane| plane.tau).collect();
    assert_eq!(taus, written);
}

#[test]
fn the_observer_stops_a_run() {
    let lab = Lab::new(None);
    let task = lab.setup().task(&lab.array(), None).unwrap();
    let completed = solve(task, Instant::now(), &mut |event| match event {
        Event::Iteration { progress, .. } if progress.iteration == 3 => {
            ControlFlow::Break(StopReason::Interrupted)
        }
        _ => ControlFlow::Continue(()),
    });
    let reconstruction = completed.unwrap().reconstruction;
    assert_eq!(reconstruction.iterations, 3);
    assert_eq!(reconstruction.stop_reason, StopReason::Interrupted);
}

#[test]
fn an_error_names_the_input_at_fault() {
    let lab = Lab::new(None);
    let wrong = Image::from_fn(SIDE, SIDE - 1, |_, _| 1.0);
    let folder = lab.output("");
    folder
        .write("dark.npy", |w| write_npy_image(w, &wrong))
        .unwrap();
    let dark = lab.path("dark.npy");
    let calibration = Calibration {
        dark: Some(dark.clone()),
        ..Calibration::default()
    };
    let error = lab.run(RequestParams {
        calibration,
        ..quick()
    });
    let error = error.expect_err("the dark is too small").to_string();
    assert!(error.starts_with(&dark.display().to_string()), "{error}");

    let mut setup = lab.setup();
    setup.corrections.dark = Some(wrong);
    let error = setup.task(&lab.array(), None).err().expect("the same");
    assert!(error.to_string().starts_with("dark"), "{error}");
}

#[test]
fn a_colour_frame_has_no_truth() {
    let lab = Lab::new(Some(Bayer::Rggb));
    let truth = lab.path("truth.npy");
    let params = RequestParams {
        truth: Some(&truth),
        ..quick()
    };
    assert!(lab.run(params).is_err());
    assert!(!lab.path("result").exists());
}

/// The bias is subtracted from integers; an array of floating-point numbers is free of it.
#[test]
fn the_bias_is_subtracted_once() {
    let lab = Lab::new(None);
    let mut setup = lab.setup();
    let mut params = lab.camera.params().clone();
    params.sensor.bias_counts = Some(100.0);
    setup.camera = Camera::new(params).unwrap();
    let free = setup.measurement(&lab.array()).unwrap();
    let mut raw = lab.array();
    raw.bias = Bias::Contained;
    let pixels = raw.capture.image.data_mut().iter_mut();
    pixels.for_each(|p| *p += 100.0);
    let corrected = setup.measurement(&raw).unwrap();
    let pairs = free.image().data().iter().zip(corrected.image().data());
    for (a, b) in pairs {
        assert!((a - b).abs() < 1e-4 * (1.0 + a.abs()) + 1e-4, "{a} {b}");
    }
}

/// Runs another test of this file in a process of its own, and reads what it prints.
#[test]
fn the_layer_prints_nothing() {
    let tests = [
        "a_whole_video_is_the_same_from_files_and_from_values",
        "chunks_come_in_order",
    ];
    for test in tests {
        let output = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", test, "--nocapture", "--test-threads=1"])
            .output()
            .unwrap();
        assert!(output.status.success());
        assert_eq!(String::from_utf8_lossy(&output.stderr), "");
        let printed = String::from_utf8_lossy(&output.stdout);
        let of_harness = |line: &str| {
            let starts = ["running ", "test ", "test result: "];
            line.is_empty() || starts.iter().any(|start| line.starts_with(start))
        };
        assert!(printed.lines().all(of_harness), "{printed}");
    }
}

#[test]
fn a_cancelled_run_reads_no_further_file() {
    let lab = Lab::new(None);
    let cancel = Cancel::default();
    cancel.cancel();
    let params = RequestParams {
        calibration: Calibration {
            dark: Some(lab.path("missing.npy")),
            ..Calibration::default()
        },
        cancel,
        ..RequestParams::default()
    };
    let error = lab.run(params).expect_err("it was cancelled");
    assert_eq!(error.kind(), ErrorKind::Cancelled);
}
