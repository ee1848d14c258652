//! The captures of a calibration, as the simulated sensor records them.

use super::check_sensor;
use rowburst::noise::Noise;
use rowburst::{Camera, Image, Parameter, PatchSet, Result, Shape, Video};
use rowburst_io::{OutputFolder, write_npy_image, write_npy_video};

/// Frames without light.
const DARKS: usize = 20;
/// Light of the flats over the range of the sensor. The last one shows where it saturates.
const FLAT_LEVELS: [f64; 7] = [0.03, 0.12, 0.3, 0.5, 0.7, 0.9, 1.15];
/// Flats at each level.
const FLATS: usize = 4;
/// Captures of the point source, and their brightest pixel over the range of the sensor.
const PINHOLES: usize = 20;
const PINHOLE_LEVEL: f64 = 0.8;
/// Electrons of a frame without light: it has none, and noise needs a brightest pixel.
const NO_ELECTRONS: f64 = 1e-9;
/// Range of a sensor whose saturation is not known, in counts.
const DEFAULT_RANGE: f64 = 65_535.0;
/// Tells the noise of the captures from that of the frame of the same seed.
const STREAM: u64 = 0x6361_7074;

/// Stacks `[frame, y, x]` in counts.
const STACKS: [&str; 3] = ["darks.npy", "flats.npy", "pinhole.npy"];
/// The mean of frames without light, of the size of the captures of the point source.
const PINHOLE_DARK: &str = "pinhole-dark.npy";

/// Checks that the sensor's noise is known.
pub(super) fn check(camera: &Camera) -> Result<()> {
    check_sensor(Parameter::Captures, camera)
}

/// Writes darks and flats of the size of the frame, and captures of a point source with their dark, of the size of
/// the central PSF. Unless they are `requested`, those of an earlier run are removed.
pub(super) fn write(
    folder: &OutputFolder,
    camera: &Camera,
    psfs: &PatchSet,
    requested: bool,
    seed: u64,
) -> Result<()> {
    if !requested {
        let mut names = STACKS.iter().chain([&PINHOLE_DARK]);
        return names.try_for_each(|name| folder.remove(name));
    }
    let sensor = camera.sensor();
    let gain = sensor.gain_electrons_per_count.unwrap_or(1.0);
    let end = sensor.saturation_counts().unwrap_or(DEFAULT_RANGE);
    let range = (end - sensor.bias_counts.unwrap_or(0.0)).max(1.0) * gain;
    let even = Image::from_fn(camera.rows(), camera.columns(), |_, _| 1.0);
    let point = psfs.central().image();
    let flats = FLAT_LEVELS.map(|level| [level * range; FLATS]).concat();
    let captures = [
        (&even, vec![NO_ELECTRONS; DARKS]),
        (&even, flats),
        (point, vec![PINHOLE_LEVEL * range; PINHOLES]),
    ];
    for (i, (name, (light, electrons))) in STACKS.into_iter().zip(captures).enumerate() {
        let stack = record(light, &electrons, camera, stream(seed, i))?;
        folder.write(name, |w| write_npy_video(w, &stack))?;
    }
    let even = Image::from_fn(point.rows(), point.columns(), |_, _| 1.0);
    let darks = record(
        &even,
        &[NO_ELECTRONS; DARKS],
        camera,
        stream(seed, STACKS.len()),
    )?;
    let mean = Image::from_fn(point.rows(), point.columns(), |y, x| {
        let sum: f32 = (0..DARKS)
            .map(|k| darks.bin(k)[y * point.columns() + x])
            .sum();
        sum / DARKS as f32
    });
    folder.write(PINHOLE_DARK, |w| write_npy_image(w, &mean))
}

/// The seed of the stack of a number.
fn stream(seed: u64, stack: usize) -> u64 {
    seed ^ STREAM ^ ((stack as u64) << 40)
}

/// A stack of frames of `light`, each with its electrons in the brightest pixel.
fn record(light: &Image, electrons: &[f64], camera: &Camera, seed: u64) -> Result<Video> {
    let mut counts = Vec::with_capacity(electrons.len() * light.data().len());
    for (k, &peak_electrons) in electrons.iter().enumerate() {
        let noise = Noise::Camera { peak_electrons };
        let frame = noise.apply(light, camera.sensor(), seed ^ ((k as u64) << 48))?;
        counts.extend_from_slice(frame.frame.data());
    }
    let shape = Shape::new(electrons.len(), light.rows(), light.columns());
    Video::new(shape, counts)
}
