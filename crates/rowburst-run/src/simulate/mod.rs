//! Simulated captures: a scene, a PSF and noise, by name or as values.

mod captures;
mod folder;
mod guides;

pub use folder::{CaptureFiles, SimulationNames, SimulationRequest, photodiode_file};

use crate::plausibility::check_camera;
use rowburst::error::Place;
use rowburst::linop::LinearOperator;
use rowburst::noise::{Noise, SimulatedFrame};
use rowburst::simulate::scene::{self, DenseScene, Led};
use rowburst::simulate::{Aperture, SpeckleOptics, direct_frame, peak_electrons, phase_plate_psf};
use rowburst::{
    Camera, Error, ErrorKind, Image, Parameter, PatchSet, Psf, Result, RollingShutter, Video,
    phrase,
};
use rowburst_io::read_video;
use std::path::Path;

/// The inputs of a simulation.
pub struct Simulation<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// The PSF, or one PSF for each patch of the field.
    pub psfs: &'a PatchSet,
    /// The scene.
    pub scene: Scene<'a>,
    /// Brightness of a static background over that of the scene.
    pub background: Option<f64>,
    /// The noise.
    pub noise: NoiseChoice,
    /// Seed of scene and noise.
    pub seed: u64,
    /// Height of digits in pixels.
    pub digit_height_px: usize,
}

/// A scene.
pub enum Scene<'a> {
    /// One of [`Scene::NAMES`].
    Named(&'a str),
    /// A video, which is fitted to the field.
    Video(Video),
}

impl Scene<'_> {
    /// The names of scenes.
    pub const NAMES: [&'static str; 10] = [
        "digits",
        "leds",
        "moving",
        "two-moving",
        "still",
        "bench",
        "beam",
        "wheel",
        "cells",
        "spots",
    ];
}

impl<'a> Scene<'a> {
    /// The scene of a name, or the video of a file.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn read(text: &'a str) -> Result<Self> {
        let path = Path::new(text);
        // An error of the name says which there are.
        let is_name = !path.exists() && path.extension().is_none();
        if is_name || Self::NAMES.contains(&text) {
            return Ok(Self::Named(text));
        }
        read_video(path).map(Self::Video)
    }
}

/// The kind and the level of the noise.
#[derive(Debug, Clone, Copy)]
pub enum NoiseChoice {
    /// Gaussian noise with this signal-to-noise ratio; infinity: no noise.
    Snr(f64),
    /// Shot and read noise. The brightest pixel of the frame holds this number of electrons.
    PeakElectrons(f64),
    /// Shot and read noise. The brightest pixel of the scene sends this number of electrons in a bin.
    SceneElectrons(f64),
}

/// A simulated capture with its ground truth.
pub struct SimulatedCapture {
    /// The frame.
    pub recorded: SimulatedFrame,
    /// The noise that was added.
    pub noise: Noise,
    /// The video, in counts of the frame.
    pub truth: Video,
    /// The static background in `truth`.
    pub background: Option<Image>,
    /// The frame of the same camera without the diffuser.
    pub direct: Image,
    /// The LEDs of the scene.
    pub leds: Vec<Led>,
}

/// Simulates a capture.
///
/// # Errors
/// A camera of other units, a flat PSF, an unknown scene, a field too small for the scene, or a background or noise out of range.
pub fn simulate(simulation: &Simulation) -> Result<SimulatedCapture> {
    let camera = simulation.camera;
    check_camera(camera.params())?;
    simulation.psfs.check_contrast()?;
    check_noise(simulation.noise, camera)?;
    let RenderedScene {
        video: scene,
        background,
        leds,
    } = scene_of(simulation, camera)?;
    let operator = RollingShutter::new(camera, simulation.psfs);
    let mut frame = vec![0.0; operator.range_len()];
    operator.apply(scene.data(), &mut frame);
    // Scene and PSF are non-negative, so negative values are rounding of the transforms.
    frame
        .iter_mut()
        .filter(|b| **b < 0.0)
        .for_each(|b| *b = 0.0);
    let noiseless = Image::new(camera.rows(), camera.columns(), frame)?;
    let noise = match simulation.noise {
        NoiseChoice::Snr(snr) if snr.is_infinite() => Noise::None,
        NoiseChoice::Snr(snr) => Noise::Gaussian { snr },
        NoiseChoice::PeakElectrons(peak_electrons) => Noise::Camera { peak_electrons },
        NoiseChoice::SceneElectrons(electrons) => Noise::Camera {
            peak_electrons: peak_electrons(camera, &scene, &noiseless, electrons)?,
        },
    };
    let recorded = noise.apply(&noiseless, camera.sensor(), simulation.seed)?;
    let direct = direct_frame(camera, &scene);
    let in_counts = |values: &mut [f32]| {
        for v in values {
            *v = (f64::from(*v) * recorded.scale) as f32;
        }
    };
    let mut truth = scene;
    in_counts(truth.data_mut());
    let background = background.map(|mut still| {
        in_counts(still.data_mut());
        still
    });
    Ok(SimulatedCapture {
        recorded,
        noise,
        truth,
        background,
        direct,
        leds,
    })
}

/// The optics of a simulated speckle PSF, in the usual quantities of a laboratory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensOptics {
    /// Wavelength in nanometres.
    pub wavelength_nm: f64,
    /// Diameter of the pupil in millimetres.
    pub pupil_mm: f64,
    /// Focal length of the lens in millimetres.
    pub focal_length_mm: f64,
    /// Magnification from scene to sensor.
    pub magnification: f64,
    /// Image-side numerical aperture, instead of the pupil's diameter.
    pub na: Option<f64>,
    /// Full width at half maximum of the diffuser's scattering, in degrees.
    pub diffuser_deg: f64,
}

impl LensOptics {
    /// The defaults of the command line.
    pub fn demo() -> Self {
        Self {
            wavelength_nm: 532.0,
            pupil_mm: 1.71,
            focal_length_mm: 50.0,
            magnification: 1.0 / 22.5,
            na: None,
            diffuser_deg: 1.0,
        }
    }

    /// The optics for the simulation of the PSF, on pixels of `pixel_pitch_um`.
    pub fn optics(&self, pixel_pitch_um: f64) -> SpeckleOptics {
        let lens = Aperture::Lens {
            diameter_mm: self.pupil_mm,
            focal_length_mm: self.focal_length_mm,
            magnification: self.magnification,
        };
        let aperture = match self.na {
            None => lens,
            Some(na) => Aperture::ImageNa {
                na,
                image_distance_mm: lens.image_distance_mm(),
            },
        };
        SpeckleOptics {
            wavelength_nm: self.wavelength_nm,
            aperture,
            diffuser_fwhm_deg: self.diffuser_deg,
            pixel_pitch_um,
        }
    }
}

/// A speckle PSF that covers every displacement from the field of `camera` to its sensor.
///
/// # Errors
/// Those of [`phase_plate_psf`], with the names of the command-line options.
pub fn speckle_for(
    camera: &Camera,
    optics: &SpeckleOptics,
    diffuser_phase: f64,
    seed: u64,
) -> Result<Psf> {
    let (field_rows, field_columns) = camera.field();
    let (rows, columns) = (
        camera.rows() + field_rows - 1,
        camera.columns() + field_columns - 1,
    );
    phase_plate_psf(optics, diffuser_phase, rows | 1, columns | 1, seed)
}

/// Checks that the noise can be simulated for `camera`: shot noise needs the gain and the read noise of the sensor.
///
/// # Errors
/// Numbers of electrons that are not above zero, or a sensor without gain or read noise.
pub fn check_noise(noise: NoiseChoice, camera: &Camera) -> Result<()> {
    let (parameter, electrons, rule, remedy) = match noise {
        NoiseChoice::Snr(_) => return Ok(()),
        NoiseChoice::PeakElectrons(electrons) => (
            Parameter::PeakElectrons,
            electrons,
            "the brightest pixel holds a number of electrons above zero",
            "Give a number below the full well: full wells hold 10⁴ to 10⁶ electrons.",
        ),
        NoiseChoice::SceneElectrons(electrons) => (
            Parameter::SceneElectrons,
            electrons,
            "the brightest scene pixel sends a number of electrons above zero in a bin",
            "Multiply the photons that pass the lens by the quantum efficiency; 200 are few.",
        ),
    };
    if !(electrons.is_finite() && electrons > 0.0) {
        return Err(Error::input(parameter, electrons, rule, remedy));
    }
    check_sensor(parameter, camera)
}

/// Checks that gain and read noise are known, which `parameter` needs.
fn check_sensor(parameter: Parameter, camera: &Camera) -> Result<()> {
    let sensor = camera.sensor();
    for (key, value) in [
        ("gain_electrons_per_count", sensor.gain_electrons_per_count),
        ("read_noise_electrons", sensor.read_noise_electrons),
    ] {
        if value.is_none() {
            return Err(Error::input(
                Parameter::Camera,
                format!("no `{key}`"),
                phrase![parameter, " needs the sensor's gain and read noise"],
                phrase![
                    format!("Add a line `{key} = …` to "),
                    Parameter::Camera,
                    ", or do without ",
                    parameter,
                    "."
                ],
            )
            .with_kind(ErrorKind::Missing));
        }
    }
    Ok(())
}

/// Puts the name of the experiment file in front of an error of its camera.
pub fn naming_camera(error: Error, file: &Path) -> Error {
    if error.parameter() == Some(Parameter::Camera) {
        return error.within(file);
    }
    error
}

/// The pixel pitch of `camera` in µm, or that of [`SpeckleOptics::demo`].
pub fn pixel_pitch_um(camera: &Camera) -> f64 {
    camera
        .sensor()
        .pixel_pitch_um
        .unwrap_or(SpeckleOptics::demo().pixel_pitch_um)
}

/// The dense scene of a name.
fn dense_scene(name: &str) -> Option<DenseScene> {
    DenseScene::ALL.into_iter().find(|s| s.name() == name)
}

/// A scene as a video.
struct RenderedScene {
    /// The video, with the background.
    video: Video,
    /// The static background in `video`.
    background: Option<Image>,
    leds: Vec<Led>,
}

/// Renders the scene and its background.
fn scene_of(simulation: &Simulation, camera: &Camera) -> Result<RenderedScene> {
    let shape = camera.video_shape();
    let of_font = |error: Error| {
        if error.parameter() == Some(Parameter::HeightPx) {
            return error;
        }
        let height = simulation.digit_height_px.to_string();
        error.within(Place::Setting(Parameter::HeightPx, height))
    };
    let moving =
        |digits| scene::moving_digit(shape, simulation.digit_height_px, digits, simulation.seed);
    let mut leds = Vec::new();
    let mut video = match &simulation.scene {
        Scene::Named("digits") => {
            scene::digits(shape, simulation.digit_height_px, simulation.seed).map_err(of_font)?
        }
        Scene::Named("moving") => moving(1).map_err(of_font)?,
        Scene::Named("two-moving") => moving(2).map_err(of_font)?,
        Scene::Named("leds") => {
            let bin_duration_us = camera.time().bin_duration_us();
            let (video, found) = scene::leds(
                shape,
                bin_duration_us,
                pixel_pitch_um(camera),
                simulation.seed,
            )?;
            leds = found;
            video
        }
        Scene::Named(name) if dense_scene(name).is_some() => {
            let scene = dense_scene(name).expect("a dense scene");
            scene::dense(scene, shape, simulation.seed)?
        }
        Scene::Named(name) => {
            return Err(Error::input(
                Parameter::Scene,
                format!("\"{name}\""),
                "a scene is digits, leds, moving, two-moving, still, bench, beam, wheel, cells, spots or a video file",
                "Check the name, or give a .npy or multi-page .tif file.",
            )
            .with_kind(ErrorKind::Unknown));
        }
        Scene::Video(video) => scene::fit(video, shape)?,
    };
    let background = match simulation.background {
        None => None,
        Some(times) => {
            let picture = scene::background(shape, simulation.seed)
                .map_err(|e| e.within(Place::Setting(Parameter::Background, times.to_string())))?;
            let added = scene::add_background(&mut video, &picture, times);
            Some(added?)
        }
    };
    Ok(RenderedScene {
        video,
        background,
        leds,
    })
}

/// Subtracts the picture `still` from every bin of `video`; negative values become zero.
pub fn subtract_background(mut video: Video, still: &Image) -> Video {
    for t in 0..video.shape().bins {
        for (voxel, still) in video.bin_mut(t).iter_mut().zip(still.data()) {
            *voxel = (*voxel - still).max(0.0);
        }
    }
    video
}
