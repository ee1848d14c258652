//! Draws a report of made-up values: `cargo run --example preview -- DIR [truth.raw bins rows columns]`.
//!
//! Without a file, a spot moves through the field and another blinks at 12 kHz. The
//! file holds little-endian f32 `[t, y, x]`.

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use rowburst::traces::{Trace, brightest_regions, frequency_of};
use rowburst::{Image, Sensor, Shape, TimeGrid, Video};
use rowburst_report::{AnnotatedTrace, Direct, DirectOrigin, Iteration, ReportInput, render};

#[expect(clippy::too_many_lines, reason = "one table: the input of the report")]
fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let folder = PathBuf::from(arguments.first().ok_or("give a folder to write into")?);
    let truth = match &arguments[1..] {
        [file, bins, rows, columns] => {
            let shape = Shape::new(bins.parse()?, rows.parse()?, columns.parse()?);
            let bytes = std::fs::read(file)?;
            let values = bytes
                .chunks_exact(4)
                .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            Video::new(shape, values.collect())?
        }
        _ => moving_spot(Shape::new(54, 108, 108)),
    };
    let shape = truth.shape();
    let mut noise = noise();
    let mut video = truth.clone();
    let peak = truth.max();
    for value in video.data_mut() {
        *value = (*value + 0.02 * peak * noise()).max(0.0);
    }
    let (rows, columns) = (shape.rows, shape.columns);
    let half = rows.div_ceil(2);
    let instants: Vec<usize> = (0..rows)
        .map(|r| if r < half { half - 1 - r } else { r - half })
        .collect();
    let time = match shape.bins {
        1 => TimeGrid::single(1000.0),
        bins => TimeGrid::rolling(bins, 9.6, 1.0, 1),
    };
    let bin_of = |y: usize| instants[y].min(shape.bins - 1);
    let direct = Image::from_fn(rows, columns, |y, x| truth.bin(bin_of(y))[y * columns + x]);
    let mut grains = || -> Vec<f32> { (0..rows * columns).map(|_| noise().powi(2)).collect() };
    let psf = Image::new(rows, columns, grains())?;
    let frame = Image::new(
        rows,
        columns,
        grains().iter().map(|v| 200.0 + 40.0 * v).collect(),
    )?;
    let residual = Image::new(
        rows,
        columns,
        (0..rows * columns).map(|_| noise()).collect(),
    )?;
    let convergence: Vec<Iteration> = (1..=160)
        .map(|i| {
            let decay = (-(i as f64) / 25.0).exp();
            Iteration {
                iteration: i,
                seconds: 0.012 * i as f64,
                objective: 1.2 + 40.0 * decay,
                residual_over_sigma: 0.98 + 60.0 * decay,
                change: 0.4 * decay + 2e-4,
                psnr_db: Some(45.1 - 30.0 * decay),
            }
        })
        .collect();
    let place = |region| {
        let mut trace = Trace::without_errors(region, &video);
        trace.standard_error.fill(0.007 * f64::from(peak));
        AnnotatedTrace {
            frequency: frequency_of(&trace.debiased, &trace.standard_error, time.frame_rate_hz()),
            photodiodes: Vec::new(),
            is_requested: false,
            trace,
        }
    };
    let traces: Vec<AnnotatedTrace> = brightest_regions(&video, 6)
        .into_iter()
        .map(place)
        .collect();
    let pair = |a: &str, b: &str| (a.to_string(), b.to_string());
    let input = ReportInput {
        title: "Preview of a report",
        frame: &frame,
        psf: &psf,
        video: &video,
        truth: Some(&truth).filter(|_| std::env::var_os("NO_TRUTH").is_none()),
        direct: Some(Direct {
            image: &direct,
            origin: DirectOrigin::Truth,
        }),
        residual: &residual,
        given_psf: None,
        stray_light: None,
        residual_before: None,
        draws_change: false,
        change_count: None,
        excluded: None,
        coverage: None,
        traces: &traces,
        instants: &instants,
        time: &time,
        convergence: &convergence,
        headline: vec![
            pair("PSNR", "45.1 dB"),
            pair("SSIM", "0.992"),
            pair("residual/σ", "0.98"),
            pair("reconstruction", "1.9 s"),
            pair("frame rate", "104,167 Hz"),
        ],
        fit: Some(rowburst_report::FitVerdict {
            verdict: "good",
            reason: "the residual is white noise at the expected level",
        }),
        settings: vec![
            (
                "Camera".into(),
                vec![
                    pair("rows × columns", &format!("{rows} × {columns}")),
                    pair("shutter", "dual-inside-out"),
                    pair("row time", "9.6 µs"),
                    pair("exposure", "9.6 µs"),
                    pair("pixel pitch", "6.5 µm"),
                ],
            ),
            (
                "Reconstruction".into(),
                vec![
                    pair("prior", "tv"),
                    pair("τ", "2.1·10⁻⁴ (auto: discrepancy)"),
                    pair("noise σ", "0.0031"),
                    pair("iterations", "160"),
                    pair(
                        "stopped because",
                        "residual/σ reached 1 and the change fell below 3·10⁻⁴",
                    ),
                ],
            ),
            (
                "Run".into(),
                vec![
                    pair("version", "0.1.0"),
                    pair("seed", "1"),
                    pair("threads", "2"),
                ],
            ),
        ],
        sensor: &Sensor {
            pixel_pitch_um: Some(6.5),
            magnification: Some(0.5),
            trigger_delay_us: Some(12.3),
            gain_electrons_per_count: Some(0.45),
            ..Sensor::default()
        },
        mp4: None,
        player: None,
        files: vec![
            pair("video.npy", "the reconstruction, float32 [t, y, x]"),
            pair("video.tif", "the same as a time stack"),
            pair("result.json", "all numbers"),
        ],
        reproduce: Some("rowburst reconstruct experiment.toml --frame frame.npy --prior tv -o out"),
    };
    let start = Instant::now();
    let report = render(&input)?;
    println!(
        "{:.3} s, page of {} KiB",
        start.elapsed().as_secs_f64(),
        report.html.len() / 1024
    );
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join("report.html"), &report.html)?;
    for picture in &report.pictures {
        std::fs::write(folder.join(&picture.name), &picture.png)?;
        println!("{}: {} KiB", picture.name, picture.png.len() / 1024);
    }
    Ok(())
}

/// A spot on a circle and one that blinks.
fn moving_spot(shape: Shape) -> Video {
    let mut video = Video::zeros(shape);
    let (rows, columns) = (shape.rows as f64, shape.columns as f64);
    for t in 0..shape.bins {
        let angle = 5.0 * t as f64 / shape.bins as f64;
        let (cy, cx) = (
            rows * (0.5 + 0.33 * angle.sin()),
            columns * (0.5 + 0.33 * angle.cos()),
        );
        let blink = 0.5 + 0.5 * (std::f64::consts::TAU * 12_000.0 * 9.6e-6 * t as f64).sin();
        for (i, value) in video.bin_mut(t).iter_mut().enumerate() {
            let (y, x) = ((i / shape.columns) as f64, (i % shape.columns) as f64);
            let spot = |cy: f64, cx: f64| (-((y - cy).powi(2) + (x - cx).powi(2)) / 18.0).exp();
            *value = (spot(cy, cx) + blink * spot(0.5 * rows, 0.5 * columns)) as f32;
        }
    }
    video
}

/// Roughly Gaussian noise of width 1.
fn noise() -> impl FnMut() -> f32 {
    let mut state = 7_u64;
    move || {
        let mut uniform = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 40) as f32 / (1_u64 << 24) as f32
        };
        (0..12).map(|_| uniform()).sum::<f32>() - 6.0
    }
}
