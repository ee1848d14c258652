//! `rowburst capture`: frames and settings of a camera, or of a recording that is played back.

mod next;
mod run;

use crate::output::print_line;
use clap::{Args, Subcommand};
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Result};
use rowburst_capture::{
    Driver, PROJECT_FILE, Project, Settings, Source, experiment_text, open_source,
};
use rowburst_io::OutputFolder;
use std::path::{Path, PathBuf};

/// Record frames with all settings of the camera.
///
/// A recording is a stack of 16-bit TIFF with NAME.json beside it: whole, or not there. Dropped and incomplete frames
/// are counted and named. Ctrl-C keeps what was recorded. Tried on emulated cameras alone.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rowburst capture settings --source play:recording.tif\n  rowburst capture record --source play:recording.tif -n 100 -o copy.tif\n  rowburst new bench --source play:recording.tif, then in the folder bench: rowburst capture darks -n 50"
)]
pub struct CaptureArgs {
    #[command(subcommand)]
    pub verb: CaptureVerb,
}

#[derive(Debug, Subcommand)]
pub enum CaptureVerb {
    /// List the kinds of sources, and the cameras that answer on the network
    List,
    /// Print the settings of the camera, and what they leave open
    Settings(SettingsArgs),
    /// Record one frame of the scene
    Frame(RecordArgs),
    /// Record frames without light, for calibrate sensor
    Darks(RecordArgs),
    /// Record frames of even light, for calibrate sensor
    Flats(RecordArgs),
    /// Record a point source, for calibrate psf
    Psf(PsfCaptureArgs),
    /// Record a blinking light, for calibrate timing
    Timing(RecordArgs),
    /// Record frames until -n are there, the source ends or Ctrl-C
    Record(RecordArgs),
}

/// The source of frames.
#[derive(Debug, Clone, Args)]
pub struct SourceArgs {
    /// Where frames come from: play:PATH plays a recording (a TIFF stack, a folder of images, .npy, Zarr) at its own
    /// pace; play:PATH?rate=HZ at another, ?rate=max as fast as it goes, &loop again and again [default: that of
    /// rowburst.toml in this folder]; genicam:ADDRESS or genicam:SERIAL is a camera on the network, where the program
    /// was built with the feature genicam
    #[arg(long)]
    pub source: Option<String>,
}

#[derive(Debug, Args)]
pub struct SettingsArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Print the settings as JSON
    #[arg(long)]
    pub json: bool,
    /// Also write them as an experiment file; one that exists is not replaced
    #[arg(short, long, value_name = "EXPERIMENT.toml")]
    pub output: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct RecordArgs {
    #[command(flatten)]
    pub source: SourceArgs,
    /// Number of frames [default: frame 1, timing 1, darks 50, flats 20, psf 20, record all]
    #[arg(short = 'n', long, value_parser = clap::value_parser!(u32).range(1..))]
    pub count: Option<u32>,
    /// Print the record as JSON
    #[arg(long)]
    pub json: bool,
    /// Move a recording of this name to NAME.old.tif first, instead of refusing
    #[arg(long)]
    pub replace: bool,
    /// The file, .tif [default: captures/NAME.tif in the folder of an experiment, else NAME.tif]
    #[arg(short, long)]
    pub output: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct PsfCaptureArgs {
    #[command(flatten)]
    pub record: RecordArgs,
    /// Record it a second time, as psf-again.tif: rowburst status then tells whether the diffuser has drifted
    #[arg(long)]
    pub again: bool,
}

/// What frames are recorded for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Purpose {
    Frame,
    Darks,
    Flats,
    Psf,
    PsfAgain,
    Timing,
    Record,
}

impl Purpose {
    fn name(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Darks => "darks",
            Self::Flats => "flats",
            Self::Psf => "psf",
            Self::PsfAgain => "psf-again",
            Self::Timing => "timing",
            Self::Record => "record",
        }
    }

    fn default_count(self) -> Option<usize> {
        match self {
            Self::Frame | Self::Timing => Some(1),
            Self::Darks => Some(50),
            Self::Flats | Self::Psf | Self::PsfAgain => Some(20),
            Self::Record => None,
        }
    }

    /// Whether the frames have the exposure of the experiment.
    fn is_of_scene(self) -> bool {
        matches!(self, Self::Frame | Self::Record)
    }
}

pub fn run(args: &CaptureArgs) -> Result<()> {
    match &args.verb {
        CaptureVerb::List => list()?,
        CaptureVerb::Settings(args) => print_settings(args)?,
        CaptureVerb::Frame(args) => run::run(args, Purpose::Frame)?,
        CaptureVerb::Darks(args) => run::run(args, Purpose::Darks)?,
        CaptureVerb::Flats(args) => run::run(args, Purpose::Flats)?,
        CaptureVerb::Psf(args) => {
            let purpose = if args.again {
                Purpose::PsfAgain
            } else {
                Purpose::Psf
            };
            run::run(&args.record, purpose)?;
        }
        CaptureVerb::Timing(args) => run::run(args, Purpose::Timing)?,
        CaptureVerb::Record(args) => run::run(args, Purpose::Record)?,
    }
    Ok(())
}

/// Kinds of cameras that this program was built with.
const DRIVERS: &[Driver] = &[
    #[cfg(feature = "genicam")]
    rowburst_genicam::DRIVER,
];

fn list() -> Result<()> {
    print_line("play:PATH   a recording played back: TIFF, .npy, a folder of images, Zarr");
    for driver in DRIVERS {
        let cameras = (driver.list)()?;
        if cameras.is_empty() {
            eprintln!("no {} camera answered", driver.scheme);
        }
        for (name, description) in cameras {
            print_line(format_args!("{name}   {description}"));
        }
    }
    eprintln!("cameras of Micro-Manager are read from Python: rowburst.capture.from_mmcore(core)");
    Ok(())
}

/// The folder of the experiment that the program runs in.
pub fn project() -> Option<Project> {
    Path::new(PROJECT_FILE)
        .is_file()
        .then(|| Project::open(Path::new(".")).ok())?
}

/// Opens the source of the command line, or else that of the folder.
pub fn source(args: &SourceArgs) -> Result<Box<dyn Source>> {
    if let Some(name) = &args.source {
        return open_source(name, DRIVERS);
    }
    match project() {
        Some(project) => open_source(project.source()?, DRIVERS),
        None => Err(Error::input(
            Subject::named("--source"),
            "no source",
            "the source of the frames is needed",
            format!("Give --source play:recording.tif, for example, or go into a folder with a {PROJECT_FILE} (rowburst new)."),
        )
        .with_kind(ErrorKind::Missing)),
    }
}

fn print_settings(args: &SettingsArgs) -> Result<()> {
    let settings = source(&args.source)?.settings()?;
    if args.json {
        print_line(serde_json::to_string_pretty(&settings).expect("plain text"));
    } else {
        for property in &settings.properties {
            let value = property.value.as_deref().unwrap_or("?");
            print_line(format_args!(
                "{} = {value}  ({})",
                property.name, property.origin
            ));
        }
    }
    if let Some(path) = &args.output {
        write_experiment(path, &settings)?;
    }
    for warning in settings.check()? {
        eprintln!("warning: {warning}");
    }
    Ok(())
}

/// Writes the experiment file of `settings`, unless there is one.
fn write_experiment(path: &Path, settings: &Settings) -> Result<()> {
    if path.exists() {
        return Err(Error::input(
            path,
            "a file that is there already",
            "an experiment file is never replaced",
            "Choose another name with -o, or move the file away.",
        )
        .with_kind(ErrorKind::Exists));
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let folder = OutputFolder::create(folder.unwrap_or(Path::new(".")))?;
    folder.write_bytes(&name, experiment_text(settings).as_bytes())?;
    eprintln!(
        "wrote {}: each number says where it comes from",
        path.display()
    );
    Ok(())
}
