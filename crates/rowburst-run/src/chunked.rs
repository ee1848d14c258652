//! Reconstruction of a video too large for memory, in chunks of bins that are written one by one.
//!
//! Until all chunks are complete the output folder holds `video.npy.part` and `parts.json`, and `borders.npy.part` where
//! chunks fade into one another. A run that was stopped or killed is resumed from these files.
//!
//! A chunk keeps all pixels that are not marked as bad: it has too few to tell foreign ones. Neither its foreign pixels
//! nor its coverage are written.

use crate::artifacts::{Artifacts, Output, Summary};
use crate::borders::{BORDERS_FILE, Borders};
use crate::chunked_summary::{ChunkNumbers, ChunkedSummary};
use crate::event::{Chunk, Event, IterationMetrics, Observer};
use crate::format::short;
use crate::memory::check_bytes;
use crate::movie::encode_movie;
use crate::numbers::thousands;
use crate::schema::RESULT_SCHEMA_VERSION;
use crate::summary::{MetadataNumbers, peak_memory_bytes};
use crate::task::Task;
use rowburst::error::Subject;
use rowburst::reconstruct::{ALGORITHM_REVISION, Chunked, Options, SolvedChunk, Tau, Verdict};
use rowburst::solve::StopReason;
use rowburst::vecmath::instruction_set;
use rowburst::{Error, ErrorKind, Image, Parameter, Result, Shape, TimeGrid, Video, phrase};
use rowburst_io::{ChunkedVideoFile, FromMetadata, OutputFolder};
use rowburst_report::{Curve, Drawing, Ink, Plot, Scale, Sheet};
use serde::{Deserialize, Serialize};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::Range;
use std::time::Instant;
use tracing::info;

/// Longest side of `video.mp4` in pixels; larger makes a larger file.
const PREVIEW_MAX_SIDE: usize = 256;
/// Most bins of `video.mp4`; larger makes a larger file.
const PREVIEW_MAX_BINS: usize = 512;

/// A reconstruction in chunks.
pub struct ChunkedTask {
    /// Camera, PSFs, frame and options.
    chunked: Chunked,
    /// The options as given.
    options: Options,
    /// Bins of a chunk; `None`: as many as 3 GiB hold.
    bins_per_chunk: Option<usize>,
    /// The values of the camera that came from the metadata of the frame's file.
    from_metadata: FromMetadata,
}

impl ChunkedTask {
    /// Reconstructs the video of `task` in chunks of `bins_per_chunk` bins, or as many as fit where it is 0.
    ///
    /// # Errors
    /// Those of [`Chunked::new`], and too little memory for a chunk.
    pub fn new(task: Task, bins_per_chunk: usize) -> Result<Self> {
        let bins_per_chunk = Some(bins_per_chunk).filter(|n| *n > 0);
        let chunked = Chunked::new(task.camera, task.psfs, task.measurement, task.options)?
            .with_cancel(&task.cancel);
        let ranges = chunked.ranges(bins_per_chunk);
        let largest = ranges.iter().max_by_key(|bins| chunked.chunk_bytes(bins));
        if let Some(bins) = largest {
            let solved = chunked.solved_bins(bins).len();
            let what = format!(
                "a chunk of {} bins (with its neighbours {solved})",
                bins.len()
            );
            let remedy = phrase!["Make ", Parameter::PartBins, " smaller."];
            let needed = Some(chunked.chunk_bytes(bins));
            check_bytes(Parameter::PartBins, &what, needed, remedy)?;
        }
        Ok(Self {
            options: task.options,
            chunked,
            bins_per_chunk,
            from_metadata: task.from_metadata,
        })
    }
}

/// The content of `parts.json`.
#[derive(Serialize, Deserialize)]
struct ResumeState {
    /// See [`job_hash`].
    job: u64,
    parts: Vec<ChunkNumbers>,
    /// Whether the video is complete and takes its name next.
    #[serde(default)]
    is_complete: bool,
}

impl ResumeState {
    /// What an earlier run of `job` has left in `folder`. The state of another job is removed before its bins are
    /// replaced: killed in between, neither job would resume with bins of the other.
    fn take_up(folder: &OutputFolder, job: u64) -> Result<Self> {
        let path = folder.path();
        let found = std::fs::read(path.join(STATE_FILE)).ok();
        let found = found.and_then(|bytes| serde_json::from_slice::<Self>(&bytes).ok());
        match found.filter(|state| state.job == job) {
            Some(state) => Ok(state),
            None => {
                folder.remove(STATE_FILE)?;
                Ok(Self::new(job))
            }
        }
    }

    /// A job of which nothing is done yet.
    fn new(job: u64) -> Self {
        Self {
            job,
            parts: Vec::new(),
            is_complete: false,
        }
    }

    fn write(&self, folder: &OutputFolder) -> Result<()> {
        let json = serde_json::to_vec(self).expect("plain numbers and text");
        folder.write_bytes(STATE_FILE, &json)
    }
}

/// The file of the [`ResumeState`].
const STATE_FILE: &str = "parts.json";

/// Reconstructs all chunks that are not complete yet, and writes the result. `observer` is called after every
/// iteration and may stop the run.
///
/// # Errors
/// Those of [`Chunked::solve`], failed reads and writes, and a run that the observer stopped. Completed chunks
/// are kept for the next run.
pub fn run_chunked(task: &ChunkedTask, output: &Output, observer: Observer) -> Result<Artifacts> {
    let (chunked, folder) = (&task.chunked, output.folder);
    let run_start = Instant::now();
    let shape = chunked.camera().video_shape();
    let ranges = chunked.ranges(task.bins_per_chunk);
    for name in ["video.npy.part", "video.npy", BORDERS_FILE, STATE_FILE] {
        folder.list(name)?;
    }
    let job = job_hash(task, &ranges);
    let mut state = ResumeState::take_up(folder, job)?;
    let path = folder.path().join("video.npy");
    let is_there = |name: &str| folder.path().join(name).exists();
    let has_borders = chunked.faded_bins() == 0 || is_there(BORDERS_FILE);
    let has_video = is_there("video.npy.part");
    if !(has_video && has_borders || state.is_complete && (has_video || is_there("video.npy"))) {
        // Before files without its chunks take their place.
        folder.remove(STATE_FILE)?;
        state = ResumeState::new(job);
    }
    let mut file = if state.is_complete {
        ChunkedVideoFile::reopen(&path, shape)?
    } else {
        ChunkedVideoFile::open(&path, shape)?
    };
    let mut borders = Borders::open(folder, shape, chunked.faded_bins())?;
    if !file.is_resumed() || !state.is_complete && !borders.are_resumed() {
        folder.remove(STATE_FILE)?;
        state = ResumeState::new(job);
    }
    // The file of an earlier run does not describe the new files.
    folder.remove("result.json")?;
    let last = ranges.len() - 1;
    for (index, range) in ranges.into_iter().enumerate() {
        if state.parts.iter().any(|p| p.first_bin == range.start) {
            continue;
        }
        let began = Instant::now();
        let chunk = Chunk {
            bins: range.clone(),
            video_bins: shape.bins,
        };
        let solved = solve_chunk(chunked, &chunk, run_start, observer)?;
        let Some(solved) = solved else {
            let done: usize = state.parts.iter().map(|p| p.end_bin - p.first_bin).sum();
            return Err(Error::work(
                Subject::named("reconstruction"),
                format!("stopped with {done} of {} bins reconstructed", shape.bins),
                "Run it again with the same settings to go on from there.",
            )
            .with_kind(ErrorKind::Cancelled));
        };
        borders.write_chunk(&mut file, index, range.start, &solved)?;
        if index < last {
            borders.keep(index, &solved)?;
        }
        let reconstruction = solved.reconstruction;
        info!("wrote bins {range:?} of {}", shape.bins);
        state.parts.push(ChunkNumbers {
            first_bin: range.start,
            end_bin: range.end,
            iterations: reconstruction.iterations,
            stop_reason: reconstruction.stop_reason.name().into(),
            tau: reconstruction.tau,
            residual_over_sigma: reconstruction.residual_over_sigma,
            support_fraction: reconstruction.support_fraction,
            fit: reconstruction.fit.verdict.name().into(),
            fit_reason: reconstruction.fit.reason,
            seconds: began.elapsed().as_secs_f64(),
        });
        state.parts.sort_by_key(|p| p.first_bin);
        state.write(folder)?;
    }
    drop(borders);
    let summary = write_result(task, output, file, state)?;
    folder.remove(BORDERS_FILE)?;
    folder.remove(STATE_FILE)?;
    Ok(Artifacts::new(output, summary, Vec::new()))
}

/// Writes movie and report, ends the video and writes `result.json`. Killed in between, the same command does this alone.
fn write_result(
    task: &ChunkedTask,
    output: &Output,
    mut file: ChunkedVideoFile,
    mut state: ResumeState,
) -> Result<Summary> {
    let (chunked, folder) = (&task.chunked, output.folder);
    let shape = chunked.camera().video_shape();
    let statistics = VideoStatistics::read(&mut file, shape)?;
    folder.remove("video.mp4")?;
    let whole = chunked.camera().time();
    let time = TimeGrid::rolling(
        statistics.preview.shape().bins,
        whole.bin_duration_us() * statistics.bins_each as f64,
        1.0,
        1,
    )
    .starting_at(whole.start_us());
    if let Some(mp4) = encode_movie(&statistics.preview, &time, output.movie)? {
        folder.write_bytes("video.mp4", &mp4)?;
    }
    let mut summary = summarise(task, state.parts.clone());
    let sheet = report_sheet(task, output, &summary, &statistics);
    let report = sheet.render()?;
    for picture in &report.pictures {
        folder.write_bytes(&picture.name, &picture.png)?;
    }
    folder.write_bytes("report.html", report.html.as_bytes())?;
    state.is_complete = true;
    state.write(folder)?;
    file.finish()?;
    summary.peak_memory_bytes = peak_memory_bytes();
    summary.run = output.finished_record("video.npy")?;
    folder.remove_stale()?;
    let summary = Summary::Chunked(summary.into());
    folder.write_bytes("result.json", format!("{}\n", summary.json()).as_bytes())?;
    Ok(summary)
}

/// Reconstructs a chunk; `None` where it was stopped.
fn solve_chunk(
    chunked: &Chunked,
    chunk: &Chunk,
    run_start: Instant,
    observer: Observer,
) -> Result<Option<SolvedChunk>> {
    let solved = chunked.solve(chunk.bins.clone(), &mut |progress| {
        observer(Event::Iteration {
            progress,
            metrics: &IterationMetrics {
                seconds: run_start.elapsed().as_secs_f64(),
                residual_over_sigma: progress.residual_rms / chunked.sigma().0,
                psnr_db: None,
            },
            chunk: Some(chunk),
        })
    });
    match solved {
        Err(_) if chunked.cancel().is_cancelled() => Ok(None),
        Ok(solved) if solved.reconstruction.stop_reason == StopReason::Interrupted => Ok(None),
        solved => solved.map(Some),
    }
}

/// A hash of frame, PSFs, camera, options, `σ` and chunks. A run is resumed only if it is equal.
fn job_hash(task: &ChunkedTask, ranges: &[Range<usize>]) -> u64 {
    let mut hasher = DefaultHasher::new();
    let image = |image: &Image, hasher: &mut DefaultHasher| {
        image.data().iter().for_each(|v| v.to_bits().hash(hasher));
    };
    image(task.chunked.measurement().image(), &mut hasher);
    let weights = task.chunked.measurement().weights().unwrap_or_default();
    weights.iter().for_each(|v| v.to_bits().hash(&mut hasher));
    let psfs = task.chunked.psfs();
    for psf in psfs.psfs() {
        (psf.image().rows(), psf.image().columns()).hash(&mut hasher);
        image(psf.image(), &mut hasher);
    }
    let words = format!(
        "{} {ALGORITHM_REVISION} {:?} {:?} {} {:?} {:?} {ranges:?}",
        env!("CARGO_PKG_VERSION"),
        task.chunked.camera(),
        psfs.offsets_px(),
        task.chunked.prior(),
        task.options,
        task.chunked.sigma()
    );
    words.hash(&mut hasher);
    hasher.finish()
}

/// Pictures and curves of a video for the report, from one pass over its file.
struct VideoStatistics {
    /// Maximum of each pixel over time.
    brightest: Image,
    /// Sum of each bin.
    light: Vec<f64>,
    /// The video averaged over squares of pixels and `bins_each` bins.
    preview: Video,
    /// Bins of the video in a bin of the preview.
    bins_each: usize,
}

impl VideoStatistics {
    /// Reads the whole video, bin by bin.
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

/// The summary of completed chunks.
fn summarise(task: &ChunkedTask, parts: Vec<ChunkNumbers>) -> ChunkedSummary {
    let camera = task.chunked.camera();
    let shape = camera.video_shape();
    let (rows_before, columns_before) = camera.field_offset();
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
        "{} of {} chunks have a {worst} fit; bins {}..{}: {}",
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
        warnings.push(format!("{saturated} saturated pixels were excluded"));
    }
    ChunkedSummary {
        schema_version: RESULT_SCHEMA_VERSION,
        version: env!("CARGO_PKG_VERSION"),
        prior: task.chunked.prior().to_string(),
        tau_rule: match task.options.tau {
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
        first_row: -(rows_before as i64),
        first_column: -(columns_before as i64),
        first_bin: camera.first_bin(),
        frame_rate_hz: camera.time().frame_rate_hz(),
        start_us: camera.time().start_us(),
        trigger_delay_us: camera.sensor().trigger_delay_us,
        seconds,
        seconds_per_bin: seconds / shape.bins as f64,
        peak_memory_bytes: peak_memory_bytes(),
        threads: rayon::current_num_threads(),
        simd: instruction_set(),
        bad_pixels: task.chunked.measurement().bad(),
        saturated_pixels: saturated,
        metadata: MetadataNumbers::from(&task.from_metadata),
        parts,
        warnings,
        run: None,
    }
}

/// The report.
#[expect(clippy::too_many_lines, reason = "one table of the report")]
fn report_sheet<'a>(
    task: &'a ChunkedTask,
    output: &Output<'a>,
    summary: &ChunkedSummary,
    statistics: &'a VideoStatistics,
) -> Sheet<'a> {
    let camera = task.chunked.camera();
    let grid = camera.time();
    let time = |bin: usize| grid.middle_us(bin);
    let top =
        |points: &[(f64, f64)]| 1.05 * points.iter().map(|p| p.1).fold(f64::MIN_POSITIVE, f64::max);
    let course = |name: &'a str, what, points: Vec<(f64, f64)>, caption: &str| Drawing {
        name,
        plot: Plot::Curves {
            x: ("time (µs)", Scale::Linear(grid.start_us(), grid.end_us())),
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
    let first = summary
        .parts
        .first()
        .map_or(0..0, |p| p.first_bin..p.end_bin);
    let bins_per_chunk = first.len();
    let neighbours = if task.chunked.solved_bins(&first).len() > bins_per_chunk {
        ", together with bins next to it"
    } else {
        ", independently"
    };
    Sheet {
        title: output.title,
        summary: format!(
            "{} frames of {}×{} at {} fps from one frame, reconstructed in {} chunks.",
            summary.frames,
            summary.rows,
            summary.columns,
            thousands(summary.frame_rate_hz),
            summary.parts.len()
        ),
        verdict: None,
        warnings: summary.warnings.clone(),
        notes: vec![format!(
            "Each chunk of {bins_per_chunk} bins is reconstructed from the rows that measure it{neighbours}."
        )],
        headline: vec![
            pair("Fit", summary.fit.into()),
            pair("Residual/σ", format!("{:.2}", summary.residual_over_sigma)),
            pair(
                "Frame rate",
                format!("{} fps", thousands(summary.frame_rate_hz)),
            ),
            pair("Frames", summary.frames.to_string()),
            pair("Computed in", format!("{:.1} s", summary.seconds)),
        ],
        sections: vec![
            (
                "The scene",
                vec![
                    map(
                        "brightest",
                        &statistics.brightest,
                        "counts",
                        "The maximum of each pixel over time.",
                    ),
                    course(
                        "light",
                        "light (counts)",
                        light.collect(),
                        "The total light of each bin over time.",
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
                        "The captured frame, corrected; for a range of bins only the rows that measure them.",
                    ),
                    course(
                        "residual",
                        "residual/σ",
                        residual.collect(),
                        "Residual over the noise of each chunk: about 1 where the video explains its rows.",
                    ),
                ],
            ),
        ],
        tables: vec![(
            "Reconstruction".into(),
            vec![
                pair(
                    "objective",
                    "½‖W(b − Av)‖² + τ R(v), v ≥ 0, in each chunk".into(),
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
            ("video.mp4", "the same, reduced in size and slowed down"),
            ("report.html", "this page"),
            ("result.json", "the numbers, for programs"),
        ]
        .iter()
        .filter(|(name, _)| cfg!(feature = "mp4") || *name != "video.mp4")
        .map(|(name, what)| pair(name, (*what).into()))
        .collect(),
        reproduce: output.reproduce,
    }
}
