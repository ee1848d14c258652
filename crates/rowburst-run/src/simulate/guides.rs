//! Pictures of a simulated scene by a second camera.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rowburst::{Camera, Error, Image, Parameter, Result, Video};
use rowburst_io::{GuideFile, OutputFolder, write_npy_image};

/// Noise of a picture over its greatest value.
const NOISE: f64 = 0.01;
/// Tells the noise of the pictures from that of the frame of the same seed.
const STREAM: u64 = 0x6775_6964;

/// Checks that the second camera takes its pictures during the video of `camera`.
pub(super) fn check_times(times_us: &[f64], camera: &Camera) -> Result<()> {
    let end = camera.time().end_us();
    match times_us.iter().find(|t| !(0.0..=end).contains(*t)) {
        None => Ok(()),
        Some(time) => Err(Error::input(
            Parameter::GuideTimesUs,
            time,
            format!("the pictures are taken during the video, from 0 to {end} µs"),
            "Give times within the frame.",
        )),
    }
}

/// Writes the pictures of `video`, each with a noise of 1 % and registered with the field.
pub(super) fn write(
    folder: &OutputFolder,
    video: &Video,
    camera: &Camera,
    times_us: &[f64],
    seed: u64,
) -> Result<Vec<GuideFile>> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed ^ STREAM);
    let bin_us = camera.time().bin_duration_us();
    let shape = video.shape();
    let peak = f64::from(video.max());
    let mut guides = Vec::new();
    for (i, &time_us) in times_us.iter().enumerate() {
        let bin = (((time_us - camera.time().start_us()) / bin_us) as usize).min(shape.bins - 1);
        let noisy = video.bin(bin).iter().map(|v| {
            let noise: f64 = StandardNormal.sample(&mut rng);
            v + (NOISE * peak * noise) as f32
        });
        let image = Image::new(shape.rows, shape.columns, noisy.collect())?;
        let name = format!("guide-{}.npy", i + 1);
        folder.write(&name, |w| write_npy_image(w, &image))?;
        guides.push(GuideFile {
            image: folder.path().join(name),
            time_us: Some(time_us),
            exposure_us: Some(bin_us),
        });
    }
    Ok(guides)
}
