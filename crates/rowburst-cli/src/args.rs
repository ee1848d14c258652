//! The command line.

use crate::calibrate::CalibrateArgs;
use crate::capture::CaptureArgs;
use crate::check::CheckArgs;
use crate::design::DesignArgs;
#[cfg(feature = "view")]
use crate::live::LiveArgs;
use crate::project::{NewArgs, StatusArgs};
#[cfg(feature = "view")]
use crate::shared_args::BrowserArgs;
use crate::shared_args::{CalibrationArgs, ForceArgs, OpticsArgs};
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

/// One frame of a rolling-shutter camera behind a diffuser in, a 100,000 fps video out.
#[derive(Debug, Parser)]
#[command(
    name = "rowburst",
    bin_name = "rowburst",
    version,
    about,
    max_term_width = 100
)]
pub struct Cli {
    /// Threads to use [default: all cores]
    #[arg(long, global = true, value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
    /// Log every step with its time to standard error, in place of the progress bar
    #[arg(long, global = true)]
    pub verbose: bool,
    #[command(subcommand)]
    pub verb: Verb,
}

#[derive(Debug, Subcommand)]
pub enum Verb {
    /// Simulate the paper's experiment, reconstruct it and show how good it is
    Demo(DemoArgs),
    /// Write an experiment file for a known camera
    Init(InitArgs),
    /// Make the frame that a camera would record of a scene
    Simulate(SimulateArgs),
    /// Recover the video from one frame
    Reconstruct(ReconstructArgs),
    /// Recover the videos of a recording of many frames, into one Zarr archive
    #[cfg(feature = "batch")]
    Batch(BatchArgs),
    /// Recover the videos of a recording of many frames: not in this build
    #[cfg(not(feature = "batch"))]
    Batch(LeftOutArgs),
    /// Look at a result in the browser: video, traces, space and time, evidence
    #[cfg(feature = "view")]
    View(ViewArgs),
    /// Draw a figure for a paper from a result, as SVG or PNG
    Figure(FigureArgs),
    /// Repeat a run from its result.json alone, and compare the videos
    Rerun(RerunArgs),
    /// Print a methods paragraph for a result, with BibTeX
    Cite(CiteArgs),
    /// Calibrate a camera and a diffuser from captures of your own
    Calibrate(CalibrateArgs),
    /// What a camera, a lens and a diffuser can do before they are bought
    Design(DesignArgs),
    /// Make a folder that leads through calibration, acquisition and reconstruction
    New(NewArgs),
    /// Say what the folder of an experiment holds, and what is next
    Status(StatusArgs),
    /// Tell by one frame of a blinking light whether a set-up is good
    Check(CheckArgs),
    /// Record frames with all settings of the camera
    Capture(CaptureArgs),
    /// Look at a camera in the browser: exposure, and the video of the latest frame
    #[cfg(feature = "view")]
    Live(LiveArgs),
    /// Print the JSON Schema of the experiment file or of result.json
    Schema(SchemaArgs),
    /// Print the script that completes commands in a shell
    Completions(CompletionsArgs),
    /// Write manual pages for `man`
    Man(ManArgs),
}

/// Simulate the paper's experiment, reconstruct it and show how good it is.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst demo --scene leds -o leds\n  then open leds/report.html"
)]
pub struct DemoArgs {
    /// The paper's Fig. 2 (digits) or Fig. 3 (leds), or a digit that moves
    #[arg(long, value_enum, default_value_t = DemoScene::Digits)]
    pub scene: DemoScene,
    /// Seed of scene, speckle and noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Signal-to-noise ratio: rms of the noiseless frame over the noise; "inf" for none
    #[arg(long, default_value_t = 256.0, value_parser = parse_snr, allow_hyphen_values = true)]
    pub snr: f64,
    /// Re-estimate the active voxels by least squares, without the bias of the prior (debiasing)
    #[arg(long)]
    pub debias: bool,
    /// Folder for all results
    #[arg(short, long, default_value = "rowburst-demo")]
    pub output: PathBuf,
    #[command(flatten)]
    pub force: ForceArgs,
    /// Print result.json to standard output instead of a summary
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum DemoScene {
    /// 54 digits, each in its own place for one bin of 9.6 µs (Fig. 2)
    Digits,
    /// Three LEDs blinking at 20,833, 34,722 and 52,083 Hz (Fig. 3)
    Leds,
    /// One digit moving by up to 0.8 pixels a bin
    Moving,
}

impl DemoScene {
    pub fn name(self) -> &'static str {
        match self {
            Self::Digits => "digits",
            Self::Leds => "leds",
            Self::Moving => "moving",
        }
    }
}

/// Write an experiment file for a known camera.
///
/// Each number has its source in the comment beside it. What no public document says is left open, with the
/// command that measures it.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst init zyla-4.2\n  rowburst init \"ORCA-Flash4.0 V3\" -o orca.toml\nKnown: iris-9, orca-flash4.0-v3, pco.edge-4.2, pco.edge-5.5, prime-bsi, zyla-4.2, zyla-5.5"
)]
pub struct InitArgs {
    /// The camera's name
    pub camera: String,
    /// The file; one that exists is not replaced
    #[arg(short, long, default_value = "experiment.toml")]
    pub output: PathBuf,
}

/// Print the JSON Schema of the experiment file or of result.json.
///
/// Editors check and complete by it; programs check what they read. result.json has a schema_version, which is raised
/// where a key is removed or gets another meaning. New keys do not raise it.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst schema result > result.schema.json\n  rowburst schema experiment > experiment.schema.json\n  then write #:schema ./experiment.schema.json as first line of experiment.toml, for editors that know it"
)]
pub struct SchemaArgs {
    /// Which file
    #[arg(value_enum)]
    pub file: SchemaOf,
}

/// A file that has a schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SchemaOf {
    /// The experiment file, in TOML
    Experiment,
    /// result.json, of one video, of one in chunks (--part-bins) or of one in colour
    Result,
}

/// Print the script that completes commands in a shell.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst completions bash > ~/.local/share/bash-completion/completions/rowburst\n  rowburst completions zsh > ~/.zfunc/_rowburst\n  rowburst completions fish > ~/.config/fish/completions/rowburst.fish"
)]
pub struct CompletionsArgs {
    /// The shell
    pub shell: clap_complete::Shell,
}

/// Write manual pages for `man`, one for each verb.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst man -o ~/.local/share/man/man1\n  man rowburst-reconstruct"
)]
pub struct ManArgs {
    /// Folder for rowburst.1, rowburst-demo.1 and so on
    #[arg(short, long)]
    pub output: PathBuf,
}

/// A command that is not in this build, with any arguments.
#[cfg(not(feature = "batch"))]
#[derive(Debug, Args)]
pub struct LeftOutArgs {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _arguments: Vec<std::ffi::OsString>,
}

/// Make the frame that a camera would record of a scene.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst simulate experiment.toml --scene digits --seed 3 -o sim\n  rowburst reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy -o result"
)]
pub struct SimulateArgs {
    /// The camera, as an experiment file
    pub experiment: PathBuf,
    /// digits, leds, moving, two-moving (they may cross), one of the dense scenes still, bench, beam,
    /// wheel, cells and spots, or a video file (.npy, multi-page .tif) that is fitted to the field
    #[arg(long)]
    pub scene: String,
    /// Add a static, textured background whose brightest pixel is this many times as bright as the
    /// brightest of the scene
    #[arg(long, value_name = "TIMES", allow_hyphen_values = true)]
    pub background: Option<f64>,
    /// PSF to use; without one (here or in the experiment) a speckle PSF is computed
    #[arg(long)]
    pub psf: Option<PathBuf>,
    /// Signal-to-noise ratio: rms of the noiseless frame over the noise; "inf" for none
    #[arg(long, default_value_t = 256.0, value_parser = parse_snr, allow_hyphen_values = true)]
    pub snr: f64,
    /// Shot and read noise instead of --snr: electrons in the brightest pixel of the frame.
    /// Needs gain_electrons_per_count and read_noise_electrons in [camera]
    #[arg(long, conflicts_with = "snr", allow_hyphen_values = true)]
    pub peak_electrons: Option<f64>,
    /// Shot and read noise, from the light of the scene: electrons that the brightest scene pixel
    /// sends to the sensor in one bin, spread over the PSF. Needs what --peak-electrons needs
    #[arg(long, conflicts_with_all = ["snr", "peak_electrons"], allow_hyphen_values = true)]
    pub scene_electrons: Option<f64>,
    /// Seed of scene, speckle and noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Height of the font of digits, moving and two-moving, in pixels
    #[arg(long, default_value_t = 12)]
    pub digit_px: usize,
    /// Rms phase of the diffuser in radians, of the same angle: 4 is speckle, 20 to 60 caustics
    #[arg(
        long,
        default_value_t = 4.0,
        value_name = "RADIANS",
        allow_hyphen_values = true
    )]
    pub diffuser_phase: f64,
    /// Also take pictures of the scene with a second camera at these times, in µs from the start of the
    /// frame's first exposure: guide-1.npy and so on, listed in experiment.toml
    #[arg(long, value_name = "T,T", value_delimiter = ',')]
    pub guide_times_us: Vec<f64>,
    /// Also record what a calibration needs: darks.npy, flats.npy, and pinhole.npy with pinhole-dark.npy,
    /// the captures of a point source. Needs gain_electrons_per_count and read_noise_electrons in [camera]
    #[arg(long)]
    pub captures: bool,
    #[command(flatten)]
    pub optics: OpticsArgs,
    /// Folder for experiment.toml, frame.npy, psf.npy, truth.npy and the frame without diffuser
    #[arg(short, long)]
    pub output: PathBuf,
    #[command(flatten)]
    pub force: ForceArgs,
}

/// Recover the video from one frame.
#[derive(Debug, Clone, Args)]
#[command(
    after_help = "Example:\n  rowburst reconstruct experiment.toml --frame capture.tif --psf psf.tif -o result\n  then open result/report.html\n  rowburst reconstruct experiment.toml --frame run.h5:/camera/frame -o result\n  rowburst reconstruct experiment.toml --frame capture.tif --region 40,52 --photodiode led.csv -o result\n  rowburst reconstruct experiment.toml --frame capture.tif --sweep prior=tv,tv+l1 --sweep tau=auto,0.01 -o sweep\n  rowburst reconstruct wide-sensor.toml --frame capture.tif --prior tv+support --part-bins 0 -o result"
)]
pub struct ReconstructArgs {
    /// The experiment file: camera, calibration, field, reconstruction options
    pub experiment: PathBuf,
    /// The raw frame (.npy, .tif, .png, .bmp, .h5, .mat, .fits, .cihx); FILE.h5:/path names an array. Keys
    /// missing from the experiment file are taken from its metadata
    #[arg(long)]
    pub frame: PathBuf,
    #[command(flatten)]
    pub calibration: CalibrationArgs,
    /// The true video, to compare with
    #[arg(long)]
    pub truth: Option<PathBuf>,
    /// A frame of the scene taken without the diffuser, of any size, shown beside the reconstruction
    #[arg(long)]
    pub direct: Option<PathBuf>,
    /// A picture of the same scene by an ordinary second camera, taken at an unknown time within the
    /// frame: for dense scenes. Several pictures with their times stand in the experiment file, [[guide]]
    #[arg(long, value_name = "IMAGE", conflicts_with_all = ["part_bins", "bins"])]
    pub guide: Option<PathBuf>,
    /// What the scene does with the light of the guide: auto, motion, gain (places change their
    /// brightness), still, or places (a trace for each lit place of the guide, with standard errors)
    #[arg(long, value_name = "MODEL", conflicts_with_all = ["part_bins", "bins"])]
    pub guide_model: Option<String>,
    #[arg(long, allow_hyphen_values = true, help = prior_help())]
    pub prior: Option<String>,
    /// Weight of the prior: auto (by the noise level), held-out (by held-out pixels), or a number above
    /// zero
    #[arg(long, allow_hyphen_values = true)]
    pub tau: Option<String>,
    /// Standard deviation of the noise in counts [default: from the calibration, or the frame]
    #[arg(long, allow_hyphen_values = true)]
    pub noise_sigma: Option<f64>,
    /// Let the frame correct its PSF and camera: off, auto (where they do not explain the frame), on, or a
    /// list of what may be corrected, such as scale,rotation_deg, by the names in result.json
    #[arg(long, value_name = "WHEN")]
    pub self_calibrate: Option<String>,
    /// Use every pixel that is not marked as bad: do not look for foreign pixels, such as hot pixels or a
    /// printed caption
    #[arg(long)]
    pub keep_all_pixels: bool,
    /// Stop after this time and keep the current result
    #[arg(long, allow_hyphen_values = true)]
    pub time_budget_s: Option<f64>,
    /// Stop after this many iterations
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    pub max_iterations: Option<u32>,
    /// Only these bins of the video, from the rows that measure them
    #[arg(long, value_name = "FIRST..END")]
    pub bins: Option<String>,
    /// Reconstruct in chunks of N bins, each written before the next starts: for videos that do not fit
    /// in memory. No term of the prior is over all bins [default prior: tv+support]; 0: as many bins as fit
    /// in 3 GiB. The same command resumes an interrupted run
    #[arg(long, value_name = "N", conflicts_with_all = ["truth", "direct", "debias", "region", "photodiode", "time_budget_s", "sweep"])]
    pub part_bins: Option<usize>,
    /// Re-estimate the active voxels by least squares, without the bias of the prior (debiasing)
    #[arg(long)]
    pub debias: bool,
    /// Formats of the video: npy, tif, zarr, mp4, mat and h5 with commas between them; npy is written in any case
    /// [default: npy,mp4, and tif up to 64 MB]
    #[arg(long, value_name = "FORMATS")]
    pub write: Option<String>,
    /// Omit the strip with the time in µs below the picture of video.mp4, as for a paper's supplement
    #[arg(long)]
    pub no_stamp: bool,
    /// A trace of the 3×3 pixels about row Y, column X, or of a region (repeatable)
    #[arg(long, value_name = "Y,X[,ROWS,COLUMNS]", allow_hyphen_values = true)]
    pub region: Vec<String>,
    /// A photodiode's signal, aligned with the trace that fits it best: a CSV file with the
    /// columns time_us,value (or time_s, time_ms, time_ns) (repeatable)
    #[arg(long, value_name = "FILE.csv")]
    pub photodiode: Vec<PathBuf>,
    /// Show the video in the browser during the reconstruction, with a button to stop; then the result,
    /// until Ctrl-C
    #[cfg(feature = "view")]
    #[arg(long, conflicts_with_all = ["sweep", "part_bins"])]
    pub view: bool,
    #[cfg(feature = "view")]
    #[command(flatten)]
    pub browser: BrowserArgs,
    /// Run once for each value of prior, tau, noise-sigma or max-iterations, each in its own folder
    /// below the output, and compare them in sweep.csv (repeatable: all combinations)
    #[arg(long, value_name = "OPTION=VALUE,VALUE")]
    pub sweep: Vec<String>,
    /// Print result.json to standard output instead of a summary
    #[arg(long)]
    pub json: bool,
    /// Folder for all results
    #[arg(short, long)]
    pub output: PathBuf,
    #[command(flatten)]
    pub force: ForceArgs,
    /// Seed of the simulation that the frame comes from, for result.json
    #[arg(skip)]
    pub seed: u64,
}

/// Look at a result in the browser.
///
/// The page is served on 127.0.0.1, which other machines cannot reach. To view results on a remote
/// computer, run this command there with --no-open, run ssh -L 8787:localhost:8787 HOST here, and open
/// the address that it printed. The address has a token: without it nothing is served.
#[cfg(feature = "view")]
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst view result\n  rowburst view result other-result      two results side by side, with one clock\n  rowburst view result video.npy --port 9000 --no-open"
)]
pub struct ViewArgs {
    /// The folder that rowburst reconstruct has written (or a video, .npy or .tif), and another to
    /// compare it with
    #[arg(required = true, num_args = 1..=2, value_name = "RESULT")]
    pub results: Vec<PathBuf>,
    #[command(flatten)]
    pub browser: BrowserArgs,
}

/// Repeat a run from its result.json alone, and compare the videos.
///
/// result.json has camera, options and the SHA-256 of each input. An input that has changed since is named, and nothing is
/// computed. On the same kind of processor the new video is equal to the bit.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  rowburst rerun result -o again\n  rowburst rerun moved/result --inputs moved -o again"
)]
pub struct RerunArgs {
    /// The folder that rowburst reconstruct has written
    #[arg(value_name = "RESULT")]
    pub result: PathBuf,
    /// Folder for the new result [default: the name of the old one with -rerun]
    #[arg(short, long)]
    pub output: Option<PathBuf>,
    /// Folder with the inputs, where they are no longer at their places: they are found by name and SHA-256
    #[arg(long, value_name = "DIR")]
    pub inputs: Option<PathBuf>,
    #[command(flatten)]
    pub force: ForceArgs,
}

/// Print a methods paragraph for a result, with BibTeX.
///
/// The paragraph has the numbers of the run, in LaTeX; the entries are those of the program and of the methods that it used.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  rowburst cite result > methods.tex")]
pub struct CiteArgs {
    /// The folder that rowburst reconstruct has written
    #[arg(value_name = "RESULT")]
    pub result: PathBuf,
}

/// Draw a figure for a paper from a result.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst figure result --layout fig2 -o figure2.svg\n  rowburst figure result --layout fig3 -o figure3.png\n  rowburst figure result --width-mm 178 --panels frame,psf,frames --bins 4,12,20 -o figure.svg"
)]
pub struct FigureArgs {
    /// The folder that rowburst reconstruct has written
    #[arg(value_name = "RESULT")]
    pub result: PathBuf,
    /// What is drawn
    #[arg(long, value_enum, default_value_t = FigureLayout::Fig2)]
    pub layout: FigureLayout,
    /// Width on paper: 86 for one column of a journal, 178 for two. Text has 7 pt in panels that are no wider; a .png has
    /// 600 dpi
    #[arg(long, value_name = "MM")]
    pub width_mm: Option<f64>,
    /// The panels, in this order, in place of those of the layout: frame, psf, direct, residual, time-colour,
    /// reconstruction (of a single bin), space-time, frames, change (the still part and what changes), traces
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub panels: Vec<String>,
    /// The bins of the panels frames and change, from 0
    #[arg(long, value_name = "BINS", value_delimiter = ',')]
    pub bins: Vec<usize>,
    /// The file: .svg or .pdf (text stays text), or .png (1600 pixels wide where no width on paper is given)
    #[arg(short, long, value_name = "FILE")]
    pub output: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FigureLayout {
    /// Frame, PSF, all bins in one, and some of them with the rows that see them (the paper's Fig. 2)
    Fig2,
    /// Frame, PSF, all bins in one, bright points in space and time, traces (the paper's Fig. 3)
    Fig3,
}

/// Recover the videos of a recording of many frames, into one Zarr archive.
///
/// An interrupted run resumes with the same command.
#[cfg(feature = "batch")]
#[derive(Debug, Clone, Args)]
#[command(
    after_help = "Example:\n  rowburst batch experiment.toml --frames captures -o videos.zarr\n  rowburst batch experiment.toml --frames stack.tif --frame-period-us 2000 --stitch -o videos.zarr\n  then in Python: zarr.open(\"videos.zarr\")[\"0\"][frame, t], or drop videos.zarr into napari;\n  the table is videos.zarr/rowburst/frames.csv"
)]
pub struct BatchArgs {
    /// The experiment file: camera, calibration, field, reconstruction options
    pub experiment: PathBuf,
    /// The recording: a folder of images or stacks, a multi-page .tif, an array [frame, y, x] (.npy, .h5,
    /// .mat, .fits; FILE.h5:/path names one), .cihx with .mraw, or a Zarr array or OME-Zarr image. Keys
    /// missing from the experiment file are taken from its metadata
    #[arg(long)]
    pub frames: PathBuf,
    #[command(flatten)]
    pub calibration: CalibrationArgs,
    /// The prior of all frames, as for reconstruct; auto chooses it once, on the brightest of nine
    /// frames spread over the recording
    #[arg(long, allow_hyphen_values = true)]
    pub prior: Option<String>,
    /// Weight of the prior: auto or held-out (chosen for each frame), or a number above zero
    #[arg(long, allow_hyphen_values = true)]
    pub tau: Option<String>,
    /// Standard deviation of the noise in counts [default: from the calibration, or each frame]
    #[arg(long, allow_hyphen_values = true)]
    pub noise_sigma: Option<f64>,
    /// Let four frames together correct PSF and camera of all: off, auto (where they do not explain them) or on
    #[arg(long, value_name = "WHEN")]
    pub self_calibrate: Option<String>,
    /// Use every pixel that is not marked as bad: do not look for foreign pixels, such as hot pixels or a
    /// printed caption
    #[arg(long)]
    pub keep_all_pixels: bool,
    /// Stop each frame after this many iterations
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    pub max_iterations: Option<u32>,
    /// Preview: time limit per frame in seconds; each frame is warm-started from the previous one. The
    /// videos then depend on the speed of the machine
    #[arg(long, allow_hyphen_values = true, conflicts_with_all = ["concurrent_frames", "scheduler"])]
    pub time_budget_s: Option<f64>,
    /// Only the frames from A up to, but without, B, counted from 0 (either may be left out):
    /// several processes may work on ranges of one archive concurrently
    #[arg(
        long,
        value_name = "A:B",
        conflicts_with = "stitch",
        allow_hyphen_values = true
    )]
    pub frames_range: Option<String>,
    /// Time from the start of a frame to that of the next, instead of the experiment's
    #[arg(long, value_name = "US", allow_hyphen_values = true)]
    pub frame_period_us: Option<f64>,
    /// Join all videos on one time axis, in OUT.zarr/stitched: dead time between frames is one
    /// picture of NaN, and stitched/time_us has the time of each bin
    #[arg(long)]
    pub stitch: bool,
    /// Retry the frames that failed before
    #[arg(long)]
    pub retry_failed: bool,
    /// Run on the workers of the Dask scheduler at this address, such as tcp://host:8786. Needs the
    /// Python package with Dask (pip install 'rowburst[dask]'), here and on the workers, and a shared
    /// disk
    #[arg(long, value_name = "ADDRESS", conflicts_with_all = ["frames_range", "concurrent_frames"])]
    pub scheduler: Option<String>,
    /// Number of frames reconstructed concurrently [default: one per thread, as many as fit into memory]
    #[arg(long, alias = "at-once", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub concurrent_frames: Option<u16>,
    /// Run once for each value of prior, tau, noise-sigma or max-iterations, each into its own archive
    /// in the folder of the output, and compare them in sweep.csv (repeatable: all combinations)
    #[arg(long, value_name = "OPTION=VALUE,VALUE", conflicts_with_all = ["frames_range", "stitch"])]
    pub sweep: Vec<String>,
    /// Print a summary as JSON to standard output instead of text
    #[arg(long)]
    pub json: bool,
    /// The archive, a folder: new, or that of the same batch
    #[arg(short, long, value_name = "OUT.zarr")]
    pub output: PathBuf,
}

fn parse_snr(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(snr) if snr > 0.0 => Ok(snr),
        _ => Err("the ratio is a number above zero, or inf for no noise".into()),
    }
}

/// The help of `--prior`, with all terms.
fn prior_help() -> String {
    let terms: Vec<String> = rowburst::prox::TERMS
        .iter()
        .map(|term| format!("{} ({})", term.name, term.favours))
        .collect();
    let terms = terms.join(", ");
    format!(
        "The prior: auto, or terms joined by +, such as tv+0.5*tdiff+support. They favour: {terms}; support leaves \
         voxels without light out"
    )
}
