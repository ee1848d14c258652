//! `rowburst rerun`: a run is repeated from its `result.json`, and the videos are compared.

use crate::args::RerunArgs;
use crate::output::print_line;
use crate::progress::{Bar, Interrupt, Kept};
use crate::reconstruct::print_summary;
use rowburst::error::Subject;
use rowburst::{Error, Parameter, Result};
use rowburst_io::sha256;
use rowburst_run::{MovieStyle, Output, Request, RequestParams, RunRecord};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Runs the command. `process_start` is the time at which the process started.
pub fn run(args: &RerunArgs, process_start: Instant) -> Result<()> {
    let (mut record, result) = RunRecord::read(&args.result)?;
    if let Some(inputs) = &args.inputs {
        record = record.with_inputs_of(&args.result, inputs)?;
    }
    if let Some(note) = record.check_inputs(&args.result)? {
        eprintln!("note: {note}");
    }
    let output_path = args
        .output
        .clone()
        .unwrap_or_else(|| default_output(&args.result));
    if output_path.canonicalize().ok() == args.result.canonicalize().ok() {
        return Err(Error::input(
            Parameter::Output,
            output_path.display(),
            "the new result is compared with the old one, which must stay",
            "Choose another folder with -o.",
        ));
    }
    let interrupt = Interrupt::listen(Kept::Result);
    let folder = args.force.claim(&output_path, "reconstruct")?;
    let folder = folder.with_cancel(&interrupt.writing);
    let experiment = record.experiment(&args.result)?;
    let (frame, further) = (
        record.frame(&args.result),
        record.further_files(&args.result),
    );
    let options = &record.options;
    let mut bar = Bar::new(Arc::clone(&interrupt.run));
    let params = RequestParams {
        options: options.typed(),
        truth: further.truth.as_deref(),
        direct: further.direct.as_deref(),
        regions: &options.regions,
        photodiodes: &further.photodiodes,
        bins: options.bins.map(|[first, end]| first..end),
        bins_per_chunk: options.part_bins,
        debias: options.debias,
        guide_model: options.guide_model.as_deref(),
        seed: options.seed,
        cancel: Arc::clone(bar.stop()).into(),
        ..RequestParams::default()
    };
    let again = RunRecord {
        options: options.clone(),
        ..RunRecord::new(&experiment, &frame, &params, &record.command)?
    };
    let request = Request::read(&experiment, &frame, params, &mut |e| bar.show(e))?;
    let title = format!("Rowburst: {}", frame.display());
    let output = Output {
        folder: &folder,
        title: &title,
        reproduce: Some(&record.command),
        movie: if options.no_stamp {
            MovieStyle::Plain
        } else {
            MovieStyle::Stamped
        },
        formats: options.write.as_deref(),
        record: Some(&again),
    };
    let artifacts = request.run(&output, process_start, &mut |event| bar.show(event));
    bar.finish();
    let artifacts = artifacts?;
    print_summary(&artifacts);
    compare(&record, &result, &artifacts.video())
}

/// The folder beside `result` whose name ends in `-rerun`.
fn default_output(result: &Path) -> PathBuf {
    let whole = result.canonicalize();
    let whole = whole.as_deref().unwrap_or(result);
    let name = whole.file_name().unwrap_or_default().to_string_lossy();
    result.join("..").join(format!("{name}-rerun"))
}

/// Compares the new video with the one of the record.
fn compare(record: &RunRecord, result: &Value, video: &Path) -> Result<()> {
    let name = video.file_name().unwrap_or_default().to_string_lossy();
    if record.video_sha256 == Some(sha256(video)?) {
        print_line(format_args!("{name} is equal to the bit"));
        return Ok(());
    }
    let text = |key: &str| result[key].as_str().unwrap_or("unknown").to_string();
    let stopped = text("stop_reason");
    let simd = rowburst::vecmath::instruction_set();
    let mut reasons = Vec::new();
    if text("version") != env!("CARGO_PKG_VERSION") {
        reasons.push(format!("it was computed by version {}", text("version")));
    }
    if text("simd") != simd {
        reasons.push(format!(
            "on a processor with {}, this one has {simd}",
            text("simd")
        ));
    }
    if ["interrupted", "time-budget"].contains(&stopped.as_str()) {
        reasons.push(format!("the run ended by {stopped}"));
    }
    if reasons.is_empty() {
        reasons.push(
            "version, processor and inputs are the same, so result or program were changed".into(),
        );
    }
    Err(Error::work(
        Subject::named(name.into_owned()),
        format!(
            "another video than that of the result: {}",
            reasons.join("; ")
        ),
        "Compare the two folders: `rowburst view` takes both.",
    ))
}
