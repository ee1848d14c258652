//! A video too large for memory: found part by part, and written as it is found.
//!
//! The folder has `video.npy.part` and `parts.json` until all parts are through; a run that was
//! stopped, or killed, goes on from there.

#![allow(missing_docs)]

use crate::movie::{MovieStyle, encode_movie};
use crate::numbers::thousands;
use crate::summary::{MetadataNumbers, peak_memory_bytes, short};
use rowburst::reconstruct::{Chunked, Tau, Verdict};
use rowburst::solve::StopReason;
use rowburst::solve::admm::Progress;
use rowburst::vecmath::instruction_set;
use rowburst::{Error, Image, Result, Shape, TimeGrid, Video};
use rowburst_io::{ChunkedVideoFile, FromMetadata, OutputFolder};
use rowburst_report::{Curve, Drawing, Ink, Plot, Scale, Sheet};
use serde::{Deserialize, Serialize};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::{ControlFlow, Range};
use std::time::Instant;

/// Longest side and most bins of `video.mp4`.
const PREVIEW_MAX_SIDE: usize = 256;
const PREVIEW_MAX_BINS: usize = 512;

/// What is to be done, and how it is called.
pub struct ChunkedTask<'a> {
    /// The frame and the recipe.
    pub chunked: Chunked,
    /// How `τ` was asked for.
    pub tau: Tau,
    /// Bins of a part; `None`: as many as 3 GiB hold.
    pub bins_per_chunk: Option<usize>,
    /// Of the page.
    pub title: &'a str,
    /// What makes the same result again.
    pub reproduce: &'a str,
    /// What `video.mp4` shows.
    pub movie: MovieStyle,
    /// What of the camera came from the frame's metadata.
    pub from_metadata: &'a FromMetadata,
}

/// A part that is through.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ChunkNumbers {
    /// Its first bin, and the one after its last, of the video that is written.
    pub first_bin: usize,
    pub end_bin: usize,
    pub iterations: usize,
    pub stop_reason: String,
    pub tau: f64,
    pub residual_over_sigma: f64,
    pub support_fraction: f64,
    pub fit: String,
    pub fit_reason: String,
    pub seconds: f64,
}

/// Everything that `result.json` says of a video that was found in parts.
#[derive(Debug, Clone, Serialize)]
pub struct ChunkedSummary {
    pub version: &'static str,
    pub prior: String,
    pub tau_rule: &'static str,
    pub noise_sigma: f64,
    pub noise_sigma_source: &'static str,
    /// Of all parts together.
    pub residual_over_sigma: f64,
    /// The least good of the parts, and how many are.
    pub fit: &'static str,
    pub fit_reason: String,
    pub frames: usize,
    pub rows: usize,
    pub columns: usize,
    /// The bin of the whole readout that is the first one of the video.
    pub first_bin: usize,
    pub frame_rate_hz: f64,
    /// Of all runs together, and of a bin.
    pub seconds: f64,
    pub seconds_per_bin: f64,
    pub peak_memory_bytes: Option<u64>,
    pub threads: usize,
    /// See [`crate::ReconstructionSummary::simd`].
    pub simd: &'static str,
    pub bad_pixels: usize,
    pub saturated_pixels: usize,
    pub metadata: MetadataNumbers,
    pub parts: Vec<ChunkNumbers>,
    pub warnings: Vec<String>,
}

#[derive(Serialize, Deserialize)]
struct ResumeState {
    /// Of all that decides what the parts are.
    job: u64,
    parts: Vec<ChunkNumbers>,
}

const STATE_FILE: &str = "parts.json";

/// Sees the bins of the part at work, the number of all bins, and the iteration.
type Observer<'o> = dyn FnMut(Range<usize>, usize, &Progress) -> ControlFlow<StopReason> + 'o;

/// Finds all parts that are not there yet and writes the result. `observer` sees every iteration
/// and may stop it.
///
/// # Errors
/// Those of a reconstruction, failed writes, and where it was stopped: what is done stays.
pub fn run_chunked(
    task: &ChunkedTask,
    folder: &OutputFolder,
    observer: &mut Observer,
) -> Result<ChunkedSummary> {
    let chunked = &task.chunked;
    let shape = chunked.camera().video_shape();
    let ranges = chunked.ranges(task.bins_per_chunk);
    let mut file = ChunkedVideoFile::open(&folder.path().join("video.npy"), shape)?;
    let job = job_hash(task, &ranges);
    let begun = std::fs::read(folder.path().join(STATE_FILE)).ok();
    let begun = begun.and_then(|bytes| serde_json::from_slice::<ResumeState>(&bytes).ok());
    let mut state = match begun {
        Some(state) if state.job == job && file.is_resumed() => state,
        _ => ResumeState {
            job,
            parts: Vec::new(),
        },
    };
    // That of an earlier run would vouch for files that are no longer its own.
    folder.remove("result.json")?;
    for range in ranges {
        if state.parts.iter().any(|p| p.first_bin == range.start) {
            continue;
        }
        let began = Instant::now();
        let reconstruction = chunked.solve(range.clone(), &mut |progress| {
            observer(range.clone(), shape.bins, progress)
        })?;
        if reconstruction.stop_reason == StopReason::Interrupted {
            let done: usize = state.parts.iter().map(|p| p.end_bin - p.first_bin).sum();
            return Err(Error::work(
                "reconstruction",
                format!("stopped with {done} of {} bins found", shape.bins),
                "Run the same command again: it goes on from there.",
            ));
        }
        file.write(range.start, reconstruction.video.data())?;
        state.parts.push(ChunkNumbers {
            first_bin: range.start,
            end_bin: range.end,
            iterations: reconstruction.iterations,
            stop_reason: reconstruction.stop_reason.name().into(),
            tau: reconstruction.tau,
            residual_over_sigma: reconstruction.residual_over_sigma,
            support_fraction: reconstruction.support,
            fit: reconstruction.fit.verdict.name().into(),
            fit_reason: reconstruction.fit.reason,
            seconds: began.elapsed().as_secs_f64(),
        });
        state.parts.sort_by_key(|p| p.first_bin);
        let json = serde_json::to_vec(&state).expect("plain numbers and text");
        folder.write_bytes(STATE_FILE, &json)?;
    }
    let statistics = VideoStatistics::read(&mut file, shape)?;
    file.finish()?;
    folder.remove("video.mp4")?;
    let bin_us = chunked.camera().time().bin_duration_us();
    let time = TimeGrid::rolling(
        statistics.preview.shape().bins,
        bin_us * statistics.bins_each as f64,
        1.0,
        1,
    );
    if let Some(mp4) = encode_movie(&statistics.preview, &time, task.movie)? {
        folder.write_bytes("video.mp4", &mp4)?;
    }
    let mut summary = summarise(task, state.parts);
    let sheet = sheet(task, &summary, &statistics);
    let report = sheet.render()?;
    for picture in &report.pictures {
        folder.write_bytes(&picture.name, &picture.png)?;
    }
    folder.write_bytes("report.html", report.html.as_bytes())?;
    summary.peak_memory_bytes = peak_memory_bytes();
    let json = serde_json::to_string_pretty(&summary).expect("plain numbers and text");
    folder.write_bytes("result.json", format!("{json}\n").as_bytes())?;
    folder.remove(STATE_FILE)?;
    Ok(summary)
}

/// A number that another frame, PSF, camera, recipe or division would not have.
fn job_hash(task: &ChunkedTask, ranges: &[Range<usize>]) -> u64 {
    let mut hasher = DefaultHasher::new();
    let image = |image: &Image, hasher: &mut DefaultHasher| {
        image.data().iter().for_each(|v| v.to_bits().hash(hasher));
    };
    image(task.chunked.measurement().image(), &mut hasher);
    let weights = task.chunked.measurement().weights().unwrap_or_default();
    weights.iter().for_each(|v| v.to_bits().hash(&mut hasher));
    for psf in task.chunked.psfs().psfs() {
        image(psf.image(), &mut hasher);
    }
    let words = format!(
        "{} {:?} {} {:?} {:?} {ranges:?}",
        env!("CARGO_PKG_VERSION"),
        task.chunked.camera(),
        task.chunked.prior(),
        task.tau,
        task.chunked.sigma()
    );
    words.hash(&mut hasher);
    hasher.finish()
}

/// What is drawn of a video, from one pass over it.
struct VideoStatistics {
    /// The brightest that each pixel was.
    brightest: Image,
    /// All light of each bin.
    light: Vec<f64>,
    /// Means over pixels and bins.
    preview: Video,
    bins_each: usize,
}

impl VideoStatistics {
    fn read(file: &mut ChunkedVideoFile, shape: Shape) -> Result<Self> {
        let side = shape.rows.max(shape.columns).div_ceil(PREVIEW_MAX_SIDE);
        let bins_each = shape.bins.div_ceil(PREVIEW_MAX_BINS);
        let small = Shape::new(
            shape.bins.div_ceil(bins_each),
            shape.rows.div_ceil(side),
            shape.columns.div_ceil(side),
        );
        let mut preview = vec![0.0f32; small.voxels()];
        let mut brightest = vec![0.0f32; shape.pixels()];
        let mut light = Vec::with_capacity(shape.bins);
        for bin in 0..shape.bins {
            let values = file.read(bin)?;
            light.push(values.iter().map(|v| f64::from(*v)).sum());
            brightest
                .iter_mut()
                .zip(&values)
                .for_each(|(b, v)| *b = b.max(*v));
            let picture = &mut preview[bin / bins_each * small.pixels()..][..small.pixels()];
            for (y, row) in values.chunks_exact(shape.columns).enumerate() {
                let line = &mut picture[y / side * small.columns..][..small.columns];
                for (x, v) in row.iter().enumerate() {
                    line[x / side] += v / (side * side * bins_each) as f32;
                }
            }
        }
        Ok(Self {
            brightest: Image::new(shape.rows, shape.columns, brightest)?,
            light,
            preview: Video::new(small, preview)?,
            bins_each,
        })
    }
}

fn summarise(task: &ChunkedTask, parts: Vec<ChunkNumbers>) -> ChunkedSummary {
    let camera = task.chunked.camera();
    let shape = camera.video_shape();
    let (sigma, source) = task.chunked.sigma();
    let bins = |p: &ChunkNumbers| (p.end_bin - p.first_bin) as f64;
    let squares: f64 = parts
        .iter()
        .map(|p| bins(p) * p.residual_over_sigma.powi(2))
        .sum();
    let order = [Verdict::Bad, Verdict::Suspicious, Verdict::Good];
    let worst = order
        .iter()
        .map(|v| v.name())
        .find(|name| parts.iter().any(|p| p.fit == *name))
        .unwrap_or(Verdict::Good.name());
    let of_worst: Vec<&ChunkNumbers> = parts.iter().filter(|p| p.fit == worst).collect();
    let fit_reason = format!(
        "{} of {} parts are {worst}; bins {}..{}: {}",
        of_worst.len(),
        parts.len(),
        of_worst[0].first_bin,
        of_worst[0].end_bin,
        of_worst[0].fit_reason
    );
    let seconds: f64 = parts.iter().map(|p| p.seconds).sum();
    let mut warnings = task.from_metadata.warnings.clone();
    if worst != Verdict::Good.name() {
        warnings.push(format!("the fit is {worst}: {fit_reason}"));
    }
    let saturated = task.chunked.measurement().saturated();
    if saturated > 0 {
        warnings.push(format!("{saturated} saturated pixels were left out"));
    }
    ChunkedSummary {
        version: env!("CARGO_PKG_VERSION"),
        prior: task.chunked.prior().to_string(),
        tau_rule: match task.tau {
            Tau::Given(_) => "given",
            Tau::HeldOut => "held-out pixels, for each part",
            Tau::Auto => "discrepancy principle, for each part",
        },
        noise_sigma: sigma,
        noise_sigma_source: source.name(),
        residual_over_sigma: (squares / shape.bins as f64).sqrt(),
        fit: worst,
        fit_reason,
        frames: shape.bins,
        rows: shape.rows,
        columns: shape.columns,
        first_bin: camera.first_bin(),
        frame_rate_hz: camera.time().frame_rate_hz(),
        seconds,
        seconds_per_bin: seconds / shape.bins as f64,
        peak_memory_bytes: peak_memory_bytes(),
        threads: rayon::current_num_threads(),
        simd: instruction_set(),
        bad_pixels: task.chunked.measurement().bad(),
        saturated_pixels: saturated,
        metadata: MetadataNumbers::from(task.from_metadata),
        parts,
        warnings,
    }
}

fn sheet<'a>(
    task: &'a ChunkedTask,
    summary: &ChunkedSummary,
    statistics: &'a VideoStatistics,
) -> Sheet<'a> {
    let camera = task.chunked.camera();
    let bin_us = camera.time().bin_duration_us();
    let time = |bin: usize| ((camera.first_bin() + bin) as f64 + 0.5) * bin_us;
    let top =
        |points: &[(f64, f64)]| 1.05 * points.iter().map(|p| p.1).fold(f64::MIN_POSITIVE, f64::max);
    let course = |name: &'a str, what, points: Vec<(f64, f64)>, caption: &str| Drawing {
        name,
        plot: Plot::Curves {
            x: (
                "time (µs)",
                Scale::Linear(
                    time(0) - 0.5 * bin_us,
                    time(statistics.light.len()) - 0.5 * bin_us,
                ),
            ),
            y: (what, Scale::Linear(0.0, top(&points))),
            curves: vec![Curve {
                name: String::new(),
                points,
                ink: Ink::Line,
            }],
        },
        caption: caption.into(),
        alt: caption.into(),
    };
    let map = |name: &'a str, image: &'a Image, quantity: &'a str, caption: &str| Drawing {
        name,
        plot: Plot::Map {
            image,
            quantity,
            range: None,
        },
        caption: caption.into(),
        alt: caption.into(),
    };
    let light = (0..statistics.light.len()).map(|bin| (time(bin), statistics.light[bin]));
    let residual = summary.parts.iter().flat_map(|p| {
        [
            (time(p.first_bin), p.residual_over_sigma),
            (time(p.end_bin - 1), p.residual_over_sigma),
        ]
    });
    let pair = |name: &str, value: String| (name.to_string(), value);
    let bins_per_chunk = summary.parts.first().map_or(0, |p| p.end_bin - p.first_bin);
    Sheet {
        title: task.title,
        summary: format!(
            "{} frames of {}×{} at {} fps from one frame, found in {} parts.",
            summary.frames,
            summary.rows,
            summary.columns,
            thousands(summary.frame_rate_hz),
            summary.parts.len()
        ),
        warnings: summary.warnings.clone(),
        notes: vec![format!(
            "Each part of {bins_per_chunk} bins is a problem of its own, of the rows that see it. The prior has no term over time."
        )],
        headline: vec![
            pair("Fit", summary.fit.into()),
            pair("Residual/σ", format!("{:.2}", summary.residual_over_sigma)),
            pair(
                "Frame rate",
                format!("{} fps", thousands(summary.frame_rate_hz)),
            ),
            pair("Frames", summary.frames.to_string()),
            pair("Time", format!("{:.1} s", summary.seconds)),
        ],
        sections: vec![
            (
                "The scene",
                vec![
                    map(
                        "brightest",
                        &statistics.brightest,
                        "counts",
                        "The brightest that each pixel was at any time.",
                    ),
                    course(
                        "light",
                        "light (counts)",
                        light.collect(),
                        "All light of each bin over time.",
                    ),
                ],
            ),
            (
                "Evidence",
                vec![
                    map(
                        "frame",
                        task.chunked.measurement().image(),
                        "counts",
                        "The captured frame, corrected; of a range of bins the rows that see them, one after another.",
                    ),
                    course(
                        "residual",
                        "residual/σ",
                        residual.collect(),
                        "Residual over the noise of each part: about 1 where the video explains its rows.",
                    ),
                ],
            ),
        ],
        tables: vec![(
            "Reconstruction".into(),
            vec![
                pair(
                    "objective",
                    "½‖W(b − Av)‖² + τ R(v), v ≥ 0, in each part".into(),
                ),
                pair("prior R", summary.prior.clone()),
                pair("τ", summary.tau_rule.into()),
                pair(
                    "σ",
                    format!(
                        "{} counts ({})",
                        short(summary.noise_sigma),
                        summary.noise_sigma_source
                    ),
                ),
                pair("fit", format!("{}: {}", summary.fit, summary.fit_reason)),
                pair("shutter", camera.shutter().name().into()),
                pair("seconds per bin", short(summary.seconds_per_bin)),
                pair(
                    "peak memory",
                    summary
                        .peak_memory_bytes
                        .map_or("unknown".into(), |b| format!("{} MB", b / 1_000_000)),
                ),
                pair("rowburst", summary.version.into()),
            ],
        )],
        files: [
            ("video.npy", "the video, float32 [t, y, x], in counts"),
            ("video.mp4", "the same made smaller, slowed down"),
            ("report.html", "this page"),
            ("result.json", "the numbers, for programs"),
        ]
        .iter()
        .filter(|(name, _)| cfg!(feature = "mp4") || *name != "video.mp4")
        .map(|(name, what)| pair(name, (*what).into()))
        .collect(),
        reproduce: Some(task.reproduce),
    }
}
