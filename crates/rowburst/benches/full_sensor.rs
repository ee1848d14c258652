//! A whole sensor, part by part: `cargo bench --workspace --bench full_sensor`. 32 of the 1024 bins of a dual
//! shutter of 2048×2048 pixels are simulated (11 digits of 12 px in each, SNR 256) and found with `tv+support`;
//! 108×108×54 beside, for the cost of a voxel. `-- SIDE BINS` for another size, `-- SIDE BINS DIGITS` for other scenes,
//! and `NAME=VALUE` for other constants of the solver.

use rowburst::camera::CameraParams;
use rowburst::linop::LinearOperator;
use rowburst::measurement::Measurement;
use rowburst::metrics::psnr_db;
use rowburst::noise::Noise;
use rowburst::reconstruct::{Chunked, Options};
use rowburst::simulate::{SpeckleOptics, scene, speckle_psf};
use rowburst::{Camera, Image, Psf, RollingShutter, Sensor, Shape, Shutter, Video};
use std::ops::ControlFlow;
use std::time::Instant;

struct Cost {
    seconds_per_bin: f64,
    per_voxel: f64,
}

/// A camera of `side`×`side` pixels with a dual shutter.
fn dual_shutter(side: usize) -> Camera {
    Camera::new(CameraParams {
        rows: side,
        columns: side,
        shutter: Shutter::DualInsideOut,
        row_time_us: 9.6,
        exposure_us: 9.6,
        bins_per_row: 1,
        field: None,
        sensor: Sensor::default(),
    })
    .expect("a valid camera")
}

/// A speckle PSF for `side`×`side` pixels: the demo's grain, from a diffuser that spreads wider in proportion.
fn speckle(side: usize) -> Psf {
    let demo = SpeckleOptics::demo();
    // The simulated speckle's transform ends at 8192 points a side.
    let reach = (side as f64).min(1450.0);
    let optics = SpeckleOptics {
        diffuser_fwhm_deg: (demo.diffuser_fwhm_deg.to_radians().tan() * reach / 108.0)
            .atan()
            .to_degrees(),
        ..demo
    };
    speckle_psf(&optics, 2 * side - 1, 2 * side - 1, 1).expect("valid optics")
}

/// The true image of one bin.
fn scene_of(bin: usize, side: usize, digits: usize) -> Video {
    let shape = Shape::new(1, side, side);
    let mut sum = vec![0.0f32; shape.voxels()];
    for i in 0..digits {
        let seed = 1 + (bin * digits + i) as u64;
        let one = scene::digits(shape, 12, seed).expect("a digit fits");
        let places = sum.iter_mut().zip(one.data());
        places.for_each(|(sum, v)| *sum = sum.max(*v));
    }
    Video::new(shape, sum).expect("the same shape")
}

/// The noisy frame of `camera`, which has the first bins of `whole`. It is computed bin by bin: the truth
/// of all bins does not fit into the memory of the reconstruction.
fn simulate(whole: &Camera, camera: &Camera, psf: &Psf, digits: usize) -> Measurement {
    let side = whole.columns();
    let mut rows = vec![0.0f32; camera.rows() * side];
    let places: Vec<usize> = camera.sensor_rows().collect();
    for bin in 0..camera.time().bins() {
        let one = whole.subset(bin..bin + 1).expect("a bin");
        let operator = RollingShutter::new(&one, psf);
        let mut read = vec![0.0; operator.range_len()];
        operator.apply(scene_of(bin, side, digits).data(), &mut read);
        for (line, row) in read.chunks_exact(side).zip(one.sensor_rows()) {
            let place = places.iter().position(|&r| r == row).expect("a row");
            rows[place * side..(place + 1) * side].copy_from_slice(line);
        }
    }
    let noiseless = Image::new(camera.rows(), side, rows).expect("a frame");
    let noisy = Noise::Gaussian { snr: 256.0 }.apply(&noiseless, camera.sensor(), 1);
    Measurement::new(noisy.expect("light").frame).expect("light")
}

/// The standard options, with constants of the solver given as `NAME=VALUE`.
fn options() -> Options {
    let mut options = Options::default();
    for given in std::env::args() {
        if let Some((name, value)) = given.split_once('=') {
            let value = value.parse().expect("a number");
            options.tuning.set(name, value).expect("a constant");
        }
    }
    options
}

/// The first `bins` bins of a sensor of `side`×`side` pixels.
fn run(side: usize, bins: usize, digits: usize) -> Cost {
    let whole = dual_shutter(side);
    let all = whole.time().bins();
    let camera = whole.subset(0..bins).expect("bins of the camera");
    let began = Instant::now();
    let psf = speckle(side);
    println!(
        "{side}×{side}, bins 0..{bins} of {all}, {digits} digits in each; PSF computed in {:.1} s",
        began.elapsed().as_secs_f64()
    );
    let measurement = simulate(&whole, &camera, &psf, digits);
    let chunks = Chunked::new(camera, psf.into(), measurement, options()).expect("parts");
    let mut decibels = Vec::new();
    let began = Instant::now();
    let mut comparing = 0.0;
    for range in chunks.ranges(None) {
        let begun = Instant::now();
        let mut stamps = Vec::new();
        let chunk = chunks
            .solve(range.clone(), &mut |progress| {
                stamps.push((begun.elapsed().as_secs_f64(), progress.support_fraction));
                ControlFlow::Continue(())
            })
            .expect("a video");
        let taken = begun.elapsed().as_secs_f64();
        let now = Instant::now();
        let pixels = side * side;
        for (i, bin) in range.clone().enumerate() {
            let own = &chunk.video()[i * pixels..(i + 1) * pixels];
            decibels.push(psnr_db(own, scene_of(bin, side, digits).data()));
        }
        comparing += now.elapsed().as_secs_f64();
        let found = &chunk.reconstruction;
        let unrestricted = stamps.iter().take_while(|s| s.1 == 1.0).count();
        println!(
            "- bins {range:?}: {taken:.1} s, {} iterations ({unrestricted} of them on all voxels, until {:.1} s), residual/σ {:.3}, support {:.2e}, τ {:.3e}, {}",
            found.iterations,
            stamps[unrestricted.saturating_sub(1)].0,
            found.residual_over_sigma,
            found.support_fraction,
            found.tau,
            found.fit.verdict.name()
        );
    }
    let seconds = began.elapsed().as_secs_f64() - comparing;
    decibels.sort_by(f64::total_cmp);
    let each = seconds / bins as f64;
    let voxel = each / (side * side) as f64;
    println!(
        "{each:.2} s a bin, {:.2} µs a voxel, median {:.1} dB (least {:.1}); the whole sensor of {all} bins: {:.2} h; peak memory {}\n",
        1e6 * voxel,
        decibels[decibels.len() / 2],
        decibels[0],
        each * all as f64 / 3600.0,
        peak_memory().map_or("unknown".into(), |b| format!("{:.2} GB", b / 1e9)),
    );
    Cost {
        seconds_per_bin: each,
        per_voxel: voxel,
    }
}

/// Digits in each bin of a sensor of `side`×`side` pixels that are as hard for compressed sensing as one on
/// 108×108: `k` lit of `n` pixels take measurements in proportion to `k ln(n/k)`, of which there are `2·side`.
fn as_hard(side: usize) -> usize {
    const LIT: f64 = 60.0;
    let part = |side: usize, digits: usize| {
        let (n, k) = ((side * side) as f64, LIT * digits as f64);
        k * (n / k).ln() / (2 * side) as f64
    };
    let too_many = (2..).find(|&digits| part(side, digits) > part(108, 1));
    too_many.expect("every sensor has its limit") - 1
}

/// Of this process, in bytes (Linux).
fn peak_memory() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    line.split_whitespace()
        .nth(1)?
        .parse::<f64>()
        .ok()
        .map(|kib| 1024.0 * kib)
}

fn main() {
    let given: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let (side, bins, digits) = match given[..] {
        [side, bins] => (side, bins, as_hard(side)),
        [side, bins, digits] => (side, bins, digits),
        _ => (2048, 32, as_hard(2048)),
    };
    let small = run(108, 54, 1);
    let large = run(side, bins, digits);
    println!(
        "{:.2} s a bin; a voxel costs {:.2} times that of 108×108×54",
        large.seconds_per_bin,
        large.per_voxel / small.per_voxel
    );
}
