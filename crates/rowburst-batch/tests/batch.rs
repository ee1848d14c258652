//! A batch is what `Problem` makes of each frame alone, to the bit.

use rowburst::camera::CameraParams;
use rowburst::error::{LibraryNames, Subject};
use rowburst::linop::LinearOperator;
use rowburst::measurement::Corrections;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Model, Options, Problem, SelfCalibration};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{
    Camera, Cancel, Error, Image, Parameter, Psf, Result, RollingShutter, Sensor, Shutter, Video,
};
use rowburst_batch::{Batch, BatchInputs, Event, RetryPolicy, Status, ThreadAllocation};
use rowburst_io::{Capture, Frames, SampleFormat};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Mutex;

/// Frames that are computed; number 2 breaks the program.
struct ComputedRecording;

impl Frames for ComputedRecording {
    fn path(&self) -> &Path {
        Path::new("computed")
    }

    fn count(&self) -> usize {
        4
    }

    fn name(&self, index: usize) -> String {
        format!("number {index}")
    }

    fn read(&self, index: usize) -> Result<Capture> {
        assert!(index != 2, "a frame that breaks the program");
        Ok(capture(index))
    }
}

/// A recording without a frame.
struct EmptyRecording;

impl Frames for EmptyRecording {
    fn path(&self) -> &Path {
        Path::new("empty")
    }

    fn count(&self) -> usize {
        0
    }

    fn name(&self, index: usize) -> String {
        format!("number {index}")
    }

    fn read(&self, _: usize) -> Result<Capture> {
        unreachable!("there is no frame")
    }
}

/// Frames that cannot be read.
struct BrokenRecording;

impl Frames for BrokenRecording {
    fn path(&self) -> &Path {
        Path::new("broken")
    }

    fn count(&self) -> usize {
        2
    }

    fn name(&self, index: usize) -> String {
        format!("frame {index}")
    }

    fn read(&self, index: usize) -> Result<Capture> {
        let subject = Subject::item(Parameter::Frames, self.name(index));
        let rule = "a frame is [y, x]";
        Err(Error::input(subject, "a row", rule, "Give a frame."))
    }
}

fn capture(index: usize) -> Capture {
    Capture {
        image: Image::from_fn(12, 20, |y, x| {
            (40 + (3 * y + 5 * x + 7 * index) % 31) as f32
        }),
        format: SampleFormat::Counts { bits: 16 },
    }
}

fn camera(shutter: Shutter, sensor: Sensor) -> Camera {
    let params = CameraParams {
        rows: 12,
        columns: 20,
        shutter,
        row_time_us: 10.0,
        exposure_us: 10.0,
        bins_per_row: 1,
        field: None,
        sensor,
    };
    Camera::new(params).unwrap()
}

fn psf() -> Psf {
    let value = |y, x| (1 + (7 * y * y + 13 * x + 3 * x * y) % 17) as f32;
    Psf::new(Image::from_fn(23, 39, value)).unwrap()
}

fn inputs(camera: &Camera, prior: &str) -> BatchInputs {
    BatchInputs {
        model: Model::new(camera, psf()).with_cached_gram(),
        corrections: Corrections::default(),
        budget: None,
        options: Options {
            prior: Some(prior.parse().unwrap()),
            max_iterations: Some(70),
            ..Options::default()
        },
        frames: Box::new(ComputedRecording),
        frame_period_us: None,
        version: "test".into(),
    }
}

#[test]
fn a_recording_without_a_frame_is_refused() {
    let camera = camera(Shutter::DualInsideOut, Sensor::default());
    let folder = tempfile::tempdir().unwrap();
    let inputs = BatchInputs {
        frames: Box::new(EmptyRecording),
        ..inputs(&camera, "tv")
    };
    let error = Batch::open(inputs, &folder.path().join("o.zarr"))
        .err()
        .unwrap();
    assert!(error.is_input(), "{error}");
    assert_eq!(error.parameter(), Some(Parameter::Frames));
    let message = error.to_string();
    assert!(message.contains("at least one frame"), "{message}");
}

#[test]
fn the_first_frame_that_fails_is_named_once() {
    let camera = camera(Shutter::DualInsideOut, Sensor::default());
    let folder = tempfile::tempdir().unwrap();
    let inputs = BatchInputs {
        frames: Box::new(BrokenRecording),
        ..inputs(&camera, "tv")
    };
    let error = Batch::open(inputs, &folder.path().join("o.zarr"))
        .err()
        .unwrap();
    assert_eq!(
        error.to_string(),
        "broken: none of its 2 frames can be used, and nothing was written; \
         frame 0: found a row; a frame is [y, x]. Give a frame."
    );
}

#[test]
fn each_frame_is_as_if_alone() {
    let noisy = Sensor {
        gain_electrons_per_count: Some(2.0),
        read_noise_electrons: Some(1.5),
        bit_depth: Some(16),
        ..Sensor::default()
    };
    let cases = [
        (
            Shutter::DualInsideOut,
            Sensor::default(),
            "tv+0.5*tdiff+support",
        ),
        // Weights that follow the light, a part that stands still, two parts.
        (Shutter::DualInsideOut, noisy.clone(), "tv+support"),
        (Shutter::TopDown, noisy, "tv+0.3*l1+background+support"),
        (Shutter::Global, Sensor::default(), "tv"),
    ];
    for (shutter, sensor, prior) in cases {
        let camera = camera(shutter, sensor);
        let folder = tempfile::tempdir().unwrap();
        let batch = Batch::open(inputs(&camera, prior), &folder.path().join("o.zarr")).unwrap();
        let cancel = Cancel::default();
        let pending = batch.pending(0..4, RetryPolicy::SkipFailed).unwrap();
        assert_eq!(pending, [0, 1, 2, 3]);
        let chosen = batch.prior(&cancel, &|_| ()).unwrap().unwrap();
        let allocation = ThreadAllocation::new(2, 4, &batch.inputs().model, None);
        let seen = Mutex::new(Vec::new());
        let observer = |event: Event| {
            if let Event::FrameFinished(row) = event {
                seen.lock().unwrap().push(row.frame);
            }
        };
        batch
            .run(
                &pending,
                &chosen,
                allocation,
                &LibraryNames,
                &cancel,
                &observer,
            )
            .unwrap();
        let mut seen = seen.into_inner().unwrap();
        seen.sort_unstable();
        assert_eq!(seen, pending);
        let rows = batch.rows().unwrap();
        for row in &rows {
            let video = batch.video(row.frame).unwrap();
            if row.frame == 2 {
                assert_eq!(row.status, Status::Failed);
                assert!(
                    row.message.contains("breaks the program"),
                    "{}",
                    row.message
                );
                assert!(video.data().iter().all(|v| v.is_nan()));
                continue;
            }
            let measurement = batch.inputs().measurement(&capture(row.frame)).unwrap();
            let alone = Problem::new(&measurement, &camera, psf(), batch.inputs().options).unwrap();
            let alone = alone.solve(&mut |_| ControlFlow::Continue(())).unwrap();
            assert_eq!(alone.video, video, "{prior}, frame {}", row.frame);
            assert_eq!(row.tau, Some(alone.tau));
        }
    }
}

#[test]
fn what_was_stopped_is_left() {
    let camera = camera(Shutter::DualInsideOut, Sensor::default());
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("o.zarr");
    let batch = Batch::open(inputs(&camera, "tv"), &out).unwrap();
    let cancel = Cancel::default();
    let chosen = batch.prior(&cancel, &|_| ()).unwrap().unwrap();
    let allocation = ThreadAllocation::new(1, 4, &batch.inputs().model, None);
    let after_one = |_: Event| cancel.cancel();
    batch
        .run(
            &[3, 1, 0],
            &chosen,
            allocation,
            &LibraryNames,
            &cancel,
            &after_one,
        )
        .unwrap();
    assert_eq!(
        batch.pending(0..4, RetryPolicy::SkipFailed).unwrap(),
        [0, 1, 2]
    );
    drop(batch);
    let batch = Batch::open(inputs(&camera, "tv"), &out).unwrap();
    assert_eq!(
        batch.pending(0..2, RetryPolicy::SkipFailed).unwrap(),
        [0, 1]
    );
    let error = batch.stitch(&cancel, &|_| ()).unwrap_err().to_string();
    assert!(error.contains("no frame period"), "{error}");
}

/// Frames in memory.
struct StoredRecording(Vec<Image>);

impl Frames for StoredRecording {
    fn path(&self) -> &Path {
        Path::new("stored")
    }

    fn count(&self) -> usize {
        self.0.len()
    }

    fn name(&self, index: usize) -> String {
        format!("number {index}")
    }

    fn read(&self, index: usize) -> Result<Capture> {
        Ok(Capture {
            image: self.0[index].clone(),
            format: SampleFormat::Float,
        })
    }
}

/// The frame of a video behind a lens that vignettes by 20 %, by a camera whose lower half is 0.2 row times late.
fn late_and_vignetted(operator: &RollingShutter, truth: &Video) -> Image {
    let (rows, columns) = operator.frame_shape();
    let (mut light, mut next) = (
        vec![0.0; operator.range_len()],
        vec![0.0; operator.range_len()],
    );
    operator.apply(truth.data(), &mut light);
    let bins = (1..truth.shape().bins).chain([truth.shape().bins - 1]);
    let next_bins: Vec<f32> = bins.flat_map(|t| truth.bin(t).to_vec()).collect();
    operator.apply(&next_bins, &mut next);
    let place = |at: usize, length: usize| 2.0 * at as f32 / (length - 1) as f32 - 1.0;
    Image::from_fn(rows, columns, |y, x| {
        let (now, next) = (light[y * columns + x], next[y * columns + x]);
        let seen = if y < rows / 2 {
            now
        } else {
            0.8 * now + 0.2 * next
        };
        let distance = place(y, rows).powi(2) + place(x, columns).powi(2);
        seen.max(0.0) * (1.0 - 0.1 * distance)
    })
}

/// A recording behind a vignetting lens, by a camera whose lower half is late, corrects both by several frames together,
/// once; whoever takes the job up again takes what was found, to the bit.
#[test]
fn a_recording_corrects_its_camera() {
    let (rows, columns) = (64, 60);
    let camera = Camera::new(CameraParams {
        rows,
        columns,
        shutter: Shutter::DualInsideOut,
        row_time_us: 10.0,
        exposure_us: 10.0,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .unwrap();
    let optics = SpeckleOptics {
        diffuser_fwhm_deg: 0.6,
        ..SpeckleOptics::demo()
    };
    let psf = speckle_psf(&optics, 2 * rows - 1, 2 * columns - 1, 5).unwrap();
    let operator = RollingShutter::new(&camera, &psf);
    let truth = |seed| scene::moving_digit(camera.video_shape(), 10, 1, seed).unwrap();
    let frame = |seed| {
        let vignetted = late_and_vignetted(&operator, &truth(seed));
        let noise = Noise::Gaussian { snr: 256.0 };
        noise
            .apply(&vignetted, camera.sensor(), seed)
            .unwrap()
            .frame
    };
    let open = |self_calibration, out: &Path| {
        let inputs = BatchInputs {
            model: Model::new(&camera, &psf).with_cached_gram(),
            options: Options {
                self_calibration,
                max_iterations: None,
                ..inputs(&camera, "tv+0.5*tdiff+support").options
            },
            frames: Box::new(StoredRecording((1..4).map(frame).collect())),
            ..inputs(&camera, "tv+0.5*tdiff+support")
        };
        Batch::open(inputs, out).unwrap()
    };
    let folder = tempfile::tempdir().unwrap();
    let cancel = Cancel::default();
    let videos = |batch: &Batch, frames: &[usize]| -> Vec<Video> {
        let prior = batch.prior(&cancel, &|_| ()).unwrap().unwrap();
        let allocation = ThreadAllocation::new(2, frames.len(), &batch.inputs().model, None);
        batch
            .run(frames, &prior, allocation, &LibraryNames, &cancel, &|_| ())
            .unwrap();
        frames.iter().map(|f| batch.video(*f).unwrap()).collect()
    };
    let psnr = |videos: &[Video]| -> Vec<f64> {
        let pairs = videos.iter().zip(1..);
        pairs
            .map(|(video, seed)| psnr_db(video.data(), truth(seed).data()))
            .collect()
    };
    let off = open(SelfCalibration::OFF, &folder.path().join("off.zarr"));
    let before = psnr(&videos(&off, &[0, 1, 2]));
    assert!(off.self_calibration().is_none());
    let out = folder.path().join("auto.zarr");
    let batch = open(SelfCalibration::AUTO, &out);
    let found = videos(&batch, &[0, 1, 2]);
    let after = psnr(&found);
    for (before, after) in before.iter().zip(&after) {
        assert!(after > &(before + 4.0), "{before} -> {after} dB");
    }
    let (calibration, frames) = batch.self_calibration().expect("a correction");
    assert_eq!(frames, [0, 1, 2]);
    let vignetting = calibration["vignetting"]["value"].as_f64().unwrap();
    assert!((vignetting + 0.2).abs() < 0.02, "{vignetting}");
    let delay = calibration["half_delay_rows"]["value"].as_f64().unwrap();
    assert!((delay - 0.2).abs() < 0.02, "{delay}");
    let again = open(SelfCalibration::AUTO, &out);
    assert_eq!(videos(&again, &[1])[0], found[1]);
    assert_eq!(again.self_calibration(), batch.self_calibration());
}
