//! `rowburst demo`: the paper's simulation, from scene to report.

use crate::args::{DemoArgs, DemoScene, ReconstructArgs};
use crate::progress::print_note;
use crate::reconstruct;
use crate::shared_args::CalibrationArgs;
use rowburst::camera::CameraParams;
use rowburst::simulate::scene::LED_FREQUENCIES_HZ;
use rowburst::{Result, Sensor};
use rowburst_io::Experiment;
use rowburst_run::design::paper_camera;
use rowburst_run::simulate::{LensOptics, NoiseChoice, SimulationRequest, photodiode_file};
use std::time::Instant;

/// `process_start` is the start of the process.
pub fn run(args: &DemoArgs, process_start: Instant) -> Result<()> {
    let figure = match args.scene {
        DemoScene::Digits => "54 digits, one every 9.6 µs (the paper's Fig. 2)",
        DemoScene::Leds => "three LEDs at 20.8, 34.7 and 52.1 kHz (the paper's Fig. 3)",
        DemoScene::Moving => "a digit moving by up to 0.8 px every 9.6 µs",
    };
    eprintln!("simulating {figure}, seen through a diffuser by a dual rolling shutter");
    let camera = CameraParams {
        sensor: Sensor {
            pixel_pitch_um: Some(6.5),
            ..Sensor::default()
        },
        ..paper_camera()
    };
    let simulation = SimulationRequest {
        experiment: Experiment::new(camera),
        scene: args.scene.name(),
        background: None,
        psf: None,
        noise: NoiseChoice::Snr(args.snr),
        seed: args.seed,
        digit_px: 12,
        diffuser_phase: 4.0,
        optics: LensOptics::demo(),
        guide_times_us: &[],
        captures: false,
    };
    let folder = args.force.claim(&args.output, "simulate")?;
    simulation.run(&folder, &mut print_note)?;
    let reconstruction = ReconstructArgs {
        bins: None,
        part_bins: None,
        experiment: args.output.join("experiment.toml"),
        frame: args.output.join("frame.npy"),
        calibration: CalibrationArgs::default(),
        truth: Some(args.output.join("truth.npy")),
        direct: Some(args.output.join("without-diffuser.tif")),
        guide: None,
        guide_model: None,
        prior: None,
        tau: None,
        noise_sigma: None,
        keep_all_pixels: false,
        self_calibrate: None,
        time_budget_s: None,
        max_iterations: None,
        debias: args.debias,
        no_stamp: false,
        write: None,
        force: args.force,
        region: Vec::new(),
        photodiode: match args.scene {
            DemoScene::Leds => (1..=LED_FREQUENCIES_HZ.len())
                .map(|i| args.output.join(photodiode_file(i)))
                .collect(),
            DemoScene::Digits | DemoScene::Moving => Vec::new(),
        },
        #[cfg(feature = "view")]
        view: false,
        #[cfg(feature = "view")]
        browser: crate::shared_args::BrowserArgs::default(),
        sweep: Vec::new(),
        json: args.json,
        seed: args.seed,
        output: args.output.clone(),
    };
    reconstruct::run(&reconstruction, process_start)
}
