//! The folder of a simulated capture, which a reconstruction reads as it stands.

use super::{
    LensOptics, NoiseChoice, Scene, SimulatedCapture, Simulation, captures, check_noise, guides,
    naming_camera, pixel_pitch_um, simulate, speckle_for, subtract_background,
};
use crate::event::{Event, Observer};
use crate::format::short;
use crate::inputs::read_psfs;
use crate::memory::check_memory;
use rowburst::noise::{Noise, SimulatedFrame};
use rowburst::simulate::scene;
use rowburst::{Camera, Image, Parameter, PatchSet, Result, Video};
use rowburst_io::{
    Experiment, OutputFolder, write_csv, write_npy_image, write_npy_video, write_patch_set,
    write_tiff_image,
};
use serde_json::{Value, json};
use std::path::Path;

/// A simulated capture with the folder of files that a reconstruction of it reads.
pub struct SimulationRequest<'a> {
    /// Camera and PSF.
    pub experiment: Experiment,
    /// The name of a scene, or the file of a video; see [`Scene::read`].
    pub scene: &'a str,
    /// Brightness of a static background over that of the scene.
    pub background: Option<f64>,
    /// The file of the PSF, instead of that of the experiment; without either, a speckle PSF is computed.
    pub psf: Option<&'a Path>,
    /// The noise.
    pub noise: NoiseChoice,
    /// Seed of scene, speckle and noise.
    pub seed: u64,
    /// Height of digits in pixels.
    pub digit_px: usize,
    /// Rms phase of the diffuser in radians.
    pub diffuser_phase: f64,
    /// The optics of the speckle PSF.
    pub optics: LensOptics,
    /// Times at which a second camera takes pictures of the scene, in microseconds from the start of the frame's first
    /// exposure; each is exposed for one row time.
    pub guide_times_us: &'a [f64],
    /// Whether the captures of a calibration are written, too: darks, flats and those of a point source.
    pub captures: bool,
}

impl SimulationRequest<'_> {
    /// Simulates the capture and writes frame, PSF, truth and experiment file into `folder`. `observer` hears notes on
    /// what was simulated.
    ///
    /// # Errors
    /// Those of [`simulate`], files that cannot be read, too little memory, and failed writes.
    pub fn run(&self, folder: &OutputFolder, observer: Observer) -> Result<()> {
        let camera = self.experiment.camera()?;
        guides::check_times(self.guide_times_us, &camera)?;
        check_noise(self.noise, &camera).map_err(|e| naming_camera(e, &self.experiment.path))?;
        if self.captures {
            captures::check(&camera).map_err(|e| naming_camera(e, &self.experiment.path))?;
        }
        check_memory(&self.experiment.path, &camera, 0)?;
        let psfs = psfs_of(self, &camera, observer)?;
        let made = simulate(&Simulation {
            camera: &camera,
            psfs: &psfs,
            scene: Scene::read(self.scene)?,
            background: self.background,
            noise: self.noise,
            seed: self.seed,
            digit_height_px: self.digit_px,
        })
        .map_err(|e| {
            // What the frame's light makes impossible is the scene's.
            let is_of_scene =
                e.locations().is_empty() && e.parameter() != Some(Parameter::Background);
            if is_of_scene { e.within(self.scene) } else { e }
        })?;
        for led in &made.leds {
            let (y, x, hertz) = (led.y, led.x, led.frequency_hz);
            note(
                observer,
                &format!("LED at row {y:.1}, column {x:.1}: {hertz:.0} Hz"),
            );
        }

        let record = made.record(&SimulationNames {
            scene: self.scene,
            background: self.background,
            seed: self.seed,
            noise: self.noise,
            psf: psf_record(self, &camera),
        });
        let recorded = &made.recorded;
        let is_leds = self.scene == "leds";
        CaptureFiles {
            experiment: &self.experiment,
            psfs: &psfs,
            frame: &recorded.frame,
            truth: &made.truth,
            background: made.background.as_ref(),
            direct: &made.direct,
            photodiodes_of: is_leds.then_some(self.seed),
            captures: self.captures,
            guide_times_us: self.guide_times_us,
            seed: self.seed,
            record,
        }
        .write(folder)?;
        let frame = format!(
            "frame: {}×{} pixels, noise {} ({}), {} saturated",
            camera.rows(),
            camera.columns(),
            short(recorded.sigma),
            noise_text(self.noise),
            recorded.saturated
        );
        note(observer, &frame);
        if let Some(warning) = light_warning(self.noise, recorded, &camera) {
            note(observer, &warning);
        }
        Ok(())
    }
}

/// The files of a simulated capture, as values.
pub struct CaptureFiles<'a> {
    /// The camera; its files are not used.
    pub experiment: &'a Experiment,
    /// The PSF, or one PSF for each patch of the field.
    pub psfs: &'a PatchSet,
    /// The frame, bias included.
    pub frame: &'a Image,
    /// The video, in counts of the frame.
    pub truth: &'a Video,
    /// The static background in `truth`.
    pub background: Option<&'a Image>,
    /// The frame without the diffuser.
    pub direct: &'a Image,
    /// The seed of the LEDs, of a scene of LEDs; each has the file of a photodiode.
    pub photodiodes_of: Option<u64>,
    /// See [`SimulationRequest::captures`].
    pub captures: bool,
    /// See [`SimulationRequest::guide_times_us`].
    pub guide_times_us: &'a [f64],
    /// Seed of the noise of the pictures of the second camera, and of the captures.
    pub seed: u64,
    /// The content of `simulation.json`, but for the light of the background.
    pub record: Value,
}

impl CaptureFiles<'_> {
    /// Writes frame, PSF, truth and experiment file into `folder`.
    ///
    /// # Errors
    /// Failed writes.
    pub fn write(mut self, folder: &OutputFolder) -> Result<()> {
        let camera = self.experiment.camera()?;
        let psf_file = write_psfs(folder, self.psfs)?;
        folder.write("truth.npy", |w| write_npy_video(w, self.truth))?;
        captures::write(folder, &camera, self.psfs, self.captures, self.seed)?;
        let guides = guides::write(folder, self.truth, &camera, self.guide_times_us, self.seed)?;
        let light = write_background(folder, self.truth, self.background)?;
        if let Some(background) = self.record["background"].as_object_mut() {
            background.insert("light_over_scene".into(), json!(light));
        }
        folder.write("without-diffuser.tif", |w| write_tiff_image(w, self.direct))?;
        folder.write("frame.npy", |w| write_npy_image(w, self.frame))?;
        if let Some(seed) = self.photodiodes_of {
            write_photodiodes(seed, folder, &camera)?;
        }
        let record = format!("{:#}\n", self.record);
        folder.write_bytes("simulation.json", record.as_bytes())?;
        let mut experiment = written_experiment(self.experiment, folder, psf_file);
        experiment.guides = guides;
        write_row_order(folder, &experiment, &camera)?;
        let text = experiment.to_toml(folder.path());
        folder.write_bytes("experiment.toml", text.as_bytes())?;
        folder.remove_stale()
    }
}

/// Light over noise of a frame below which a video is dark or noise.
const MIN_LIGHT_OVER_NOISE: f64 = 10.0;
/// Part of the pixels that may saturate without a warning.
const MANY_SATURATED: f64 = 0.02;

/// What is wrong with the light of a frame, and how much would do.
fn light_warning(noise: NoiseChoice, recorded: &SimulatedFrame, camera: &Camera) -> Option<String> {
    let (name, electrons) = match noise {
        NoiseChoice::PeakElectrons(n) => ("peak", n),
        NoiseChoice::SceneElectrons(n) => ("scene", n),
        NoiseChoice::Snr(_) => return None,
    };
    let pixels = recorded.frame.data();
    if recorded.saturated as f64 > MANY_SATURATED * pixels.len() as f64 {
        return Some(format!(
            "warning: {} of {} pixels are saturated by {electrons} {name} electrons, and nothing can be reconstructed from them: use fewer",
            recorded.saturated,
            pixels.len()
        ));
    }
    let bias = camera.sensor().bias_counts.unwrap_or(0.0);
    let power: f64 = pixels.iter().map(|v| (f64::from(*v) - bias).powi(2)).sum();
    let mean_square = power / pixels.len() as f64;
    let light = (mean_square - recorded.sigma.powi(2)).max(0.0).sqrt();
    let ratio = light / recorded.sigma;
    (ratio < MIN_LIGHT_OVER_NOISE).then(|| {
        format!(
            "warning: the light in the frame is only {} times the noise, and the video will be dark: about {} {name} electrons would do",
            short(ratio),
            short(electrons * (MIN_LIGHT_OVER_NOISE / ratio.max(1e-3)).powi(2))
        )
    })
}

fn note(observer: Observer, text: &str) {
    let _ = observer(Event::Note(text));
}

/// Writes the static background and the moving part of the truth. Returns the light of the background over that of
/// the moving part.
fn write_background(
    folder: &OutputFolder,
    truth: &Video,
    background: Option<&Image>,
) -> Result<Option<f64>> {
    // Files of an earlier run would not add up to this truth.
    for name in BACKGROUND_FILES {
        folder.remove(name)?;
    }
    let Some(still) = background else {
        return Ok(None);
    };
    let moving = subtract_background(truth.clone(), still);
    let light = total(still.data()) * moving.shape().bins as f64 / total(moving.data());
    let [of_still, of_moving] = BACKGROUND_FILES;
    folder.write(of_still, |w| write_npy_image(w, still))?;
    folder.write(of_moving, |w| write_npy_video(w, &moving))?;
    Ok(Some(light))
}

/// What `simulation.json` says of the inputs of a simulation.
pub struct SimulationNames<'a> {
    /// The name of the scene, or its file.
    pub scene: &'a str,
    /// Brightness of a static background over that of the scene.
    pub background: Option<f64>,
    /// Seed of scene and noise.
    pub seed: u64,
    /// The noise that was asked for.
    pub noise: NoiseChoice,
    /// The file of the PSF, or the optics of the speckle.
    pub psf: Value,
}

impl SimulatedCapture {
    /// The contents of `simulation.json`, but for the light of the background.
    pub fn record(&self, names: &SimulationNames) -> Value {
        json!({
            "version": env!("CARGO_PKG_VERSION"),
            "scene": names.scene,
            "background": names.background.map(|times| json!({ "brightest_over_scene": times })),
            "leds": self.leds.iter().map(|led| json!({
                "row": led.y, "column": led.x, "frequency_hz": led.frequency_hz, "phase": led.phase,
            })).collect::<Vec<_>>(),
            "seed": names.seed,
            "noise": noise_record(names.noise, self.noise),
            "noise_sigma": self.recorded.sigma,
            "counts_per_unit_of_scene": self.recorded.scale,
            "saturated_pixels": self.recorded.saturated,
            "psf": names.psf,
        })
    }
}

/// The noise that was asked for; `noise` is the one that was added.
fn noise_record(choice: NoiseChoice, noise: Noise) -> Value {
    match choice {
        NoiseChoice::Snr(snr) => {
            json!({ "model": "gaussian", "snr": snr.is_finite().then_some(snr) })
        }
        NoiseChoice::PeakElectrons(_) | NoiseChoice::SceneElectrons(_) => json!({
            "model": "shot and read noise",
            "peak_electrons": match noise {
                Noise::Camera { peak_electrons } => Some(peak_electrons),
                Noise::None | Noise::Gaussian { .. } => None,
            },
            "scene_electrons": match choice {
                NoiseChoice::SceneElectrons(n) => Some(n),
                NoiseChoice::Snr(_) | NoiseChoice::PeakElectrons(_) => None,
            },
        }),
    }
}

/// The file of the PSF, or the optics of the speckle.
fn psf_record(request: &SimulationRequest, camera: &Camera) -> Value {
    match &request
        .psf
        .map(Path::to_path_buf)
        .or(request.experiment.calibration.psf.clone())
    {
        Some(path) => json!(path.display().to_string()),
        None => (request.optics).record(request.diffuser_phase, pixel_pitch_um(camera)),
    }
}

impl LensOptics {
    /// The optics of a speckle PSF, in `simulation.json`.
    pub fn record(&self, diffuser_phase: f64, pixel_pitch_um: f64) -> Value {
        json!({
            "wavelength_nm": self.wavelength_nm,
            "pupil_mm": self.na.is_none().then_some(self.pupil_mm),
            "na": self.na,
            "focal_length_mm": self.focal_length_mm,
            "magnification": self.magnification,
            "diffuser_fwhm_deg": self.diffuser_deg,
            "diffuser_phase_rad": diffuser_phase,
            "pixel_pitch_um": pixel_pitch_um,
        })
    }
}

/// The noise that was asked for, in words.
fn noise_text(noise: NoiseChoice) -> String {
    match noise {
        NoiseChoice::Snr(snr) => format!("SNR {snr}"),
        NoiseChoice::PeakElectrons(n) => format!("{n} electrons in the brightest pixel"),
        NoiseChoice::SceneElectrons(n) => {
            format!("{n} electrons of the brightest scene pixel in a bin")
        }
    }
}

/// Writes the row order of a custom shutter.
fn write_row_order(folder: &OutputFolder, experiment: &Experiment, camera: &Camera) -> Result<()> {
    if let (Some(order), rowburst::Shutter::Custom(k)) = (&experiment.row_order, camera.shutter()) {
        let name = order
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let k: Vec<i64> = k.iter().map(|&k| k as i64).collect();
        folder.write(&name, |w| rowburst_io::write_npy_i64(w, &[k.len()], &k))?;
    }
    Ok(())
}

/// Samples of a photodiode in a bin of the video.
const SAMPLES_PER_BIN: usize = 20;

/// Name of the file of a photodiode before LED `number`, from 1.
pub fn photodiode_file(number: usize) -> String {
    format!("photodiode-{number}.csv")
}

/// Writes what a fast photodiode before each LED records: 1 where it is lit, 0 where not.
fn write_photodiodes(seed: u64, folder: &OutputFolder, camera: &Camera) -> Result<()> {
    let (shape, bin_us) = (camera.video_shape(), camera.time().bin_duration_us());
    let (_, leds) = scene::leds(shape, bin_us, pixel_pitch_um(camera), seed)?;
    let step_us = bin_us / SAMPLES_PER_BIN as f64;
    let heading = ["time_us".to_string(), "value".to_string()];
    for (i, led) in leds.iter().enumerate() {
        let sample = |k: usize| {
            let start = k as f64 * step_us;
            let time = camera.time().start_us() + start + 0.5 * step_us;
            vec![time, led.mean_intensity(start, step_us)]
        };
        let samples = (0..shape.bins * SAMPLES_PER_BIN).map(sample);
        folder.write(&photodiode_file(i + 1), |w| write_csv(w, &heading, samples))?;
    }
    Ok(())
}

/// The experiment as it is after the simulation: the frame is on the working grid, and
/// the PSF lies beside it.
fn written_experiment(
    experiment: &Experiment,
    folder: &OutputFolder,
    psf_file: &str,
) -> Experiment {
    let mut experiment = experiment.clone();
    experiment.params.sensor.binning = 1;
    experiment.calibration = rowburst_io::Calibration {
        psf: Some(folder.path().join(psf_file)),
        ..rowburst_io::Calibration::default()
    };
    if matches!(experiment.params.shutter, rowburst::Shutter::Custom(_)) {
        experiment.row_order = Some(folder.path().join("row_order.npy"));
    }
    experiment
}

/// Writes the PSF, or the patch set, and gives the name of its file.
fn write_psfs(folder: &OutputFolder, psfs: &PatchSet) -> Result<&'static str> {
    if let [psf] = psfs.psfs() {
        folder.write("psf.npy", |w| write_npy_image(w, psf.image()))?;
        return Ok("psf.npy");
    }
    write_patch_set(folder, "psf-patches", psfs)?;
    Ok("psf-patches.toml")
}

fn psfs_of(request: &SimulationRequest, camera: &Camera, observer: Observer) -> Result<PatchSet> {
    if let Some(path) = request
        .psf
        .or(request.experiment.calibration.psf.as_deref())
    {
        if request.optics != LensOptics::demo() || request.diffuser_phase != 4.0 {
            let path = path.display();
            let text =
                format!("note: the options of the speckle PSF have no effect: the PSF is {path}");
            note(observer, &text);
        }
        let (psfs, text) = read_psfs(path, camera, None)?;
        if let Some(text) = text {
            note(observer, &text);
        }
        return Ok(psfs);
    }
    let optics = request.optics.optics(pixel_pitch_um(camera));
    let psf = speckle_for(camera, &optics, request.diffuser_phase, request.seed)?;
    let (grain, envelope) = (optics.grain_px(), optics.envelope_fwhm_px());
    note(
        observer,
        &format!("speckle PSF: grain {grain:.2} px, envelope {envelope:.0} px"),
    );
    Ok(psf.into())
}

/// Files that only a scene with a background has: it, and the rest of the truth.
const BACKGROUND_FILES: [&str; 2] = ["truth-background.npy", "truth-moving.npy"];

fn total(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum()
}
