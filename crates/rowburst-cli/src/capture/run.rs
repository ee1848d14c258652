//! Records frames into a file.

use super::next::next_command;
use super::{Purpose, RecordArgs, project, source, write_experiment};
use crate::output::print_line;
use crate::progress::{Interrupt, Kept};
use indicatif::{ProgressBar, ProgressStyle};
use rowburst::{Error, Parameter, Result};
use rowburst_capture::{CaptureRecord, Ended, Recorder, Settings, record};
use rowburst_io::{Experiment, capture_record_path, read_metadata};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub fn run(args: &RecordArgs, purpose: Purpose) -> Result<()> {
    let interrupt = Interrupt::listen(Kept::Recorded);
    let mut source = source(&args.source)?;
    let settings = source.settings()?;
    let warnings = settings.check()?;
    let output = output_of(args, purpose);
    if args.replace {
        move_away(&output)?;
    }
    let count = args.count.map(|n| n as usize).or(purpose.default_count());
    let recorder = Recorder::create(&output, purpose.name(), settings.clone(), count)?;
    let dark_counts = project().and_then(|project| project.dark_counts());
    let mut recorder = recorder.with_dark_counts(dark_counts);
    let before = warnings.len();
    for warning in warnings {
        eprintln!("warning: {warning}");
        recorder.warn(warning);
    }
    let bar = progress_bar(count);
    let cancel = Arc::clone(&interrupt.run).into();
    let recorded = record(&mut *source, recorder, count, &cancel, &mut |snapshot| {
        bar.set_position(snapshot.written as u64);
    });
    bar.finish_and_clear();
    let (record, ended) = recorded?;
    report(args, &record, &output, before);
    if purpose.is_of_scene() {
        keep_experiment(&output, &settings)?;
    }
    match ended {
        Ended::Failed(error) => Err(error),
        Ended::Complete | Ended::SourceEnd | Ended::Interrupted => {
            eprintln!("next: {}", next_command(purpose, &output));
            Ok(())
        }
    }
}

fn output_of(args: &RecordArgs, purpose: Purpose) -> PathBuf {
    let name = purpose.name();
    match (&args.output, project()) {
        (Some(output), _) => output.clone(),
        (None, Some(project)) => project.capture(name),
        (None, None) => format!("{name}.tif").into(),
    }
}

/// Moves a recording of this name and its record to `NAME.old`.
fn move_away(output: &Path) -> Result<()> {
    let record = capture_record_path(output);
    for (path, ending) in [(output, "old.tif"), (record.as_path(), "old.json")] {
        let moved = path.with_extension(ending);
        match std::fs::rename(path, &moved) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(rowburst_io::write_error(&error).within(path));
            }
            _ => {}
        }
    }
    Ok(())
}

fn progress_bar(count: Option<usize>) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let (bar, template) = match count {
        Some(count) => (
            ProgressBar::new(count as u64),
            "{bar:30} frame {pos} of {len}, {per_sec}",
        ),
        None => (
            ProgressBar::no_length(),
            "{spinner} frame {pos}, {per_sec}; Ctrl-C ends it",
        ),
    };
    bar.set_style(ProgressStyle::with_template(template).expect("the template is valid"));
    bar
}

/// Prints what was recorded. The first `before` warnings were printed before.
fn report(args: &RecordArgs, record: &CaptureRecord, output: &Path, before: usize) {
    if args.json {
        print_line(serde_json::to_string_pretty(record).expect("plain numbers and text"));
    } else {
        print_line(format_args!(
            "{}: {} frames, {} dropped, {} incomplete ({})",
            output.display(),
            record.written,
            record.dropped,
            record.incomplete,
            record.ended
        ));
    }
    for lost in &record.lost {
        eprintln!(
            "lost: frames {} to {}: {}",
            lost.first, lost.last, lost.reason
        );
    }
    let marked = record
        .frames
        .iter()
        .filter_map(|f| Some((f, f.incomplete.as_ref()?)));
    for (frame, reason) in marked {
        eprintln!(
            "incomplete: frame {}, page {}: {reason}",
            frame.number, frame.page
        );
    }
    for warning in &record.warnings[before..] {
        eprintln!("warning: {warning}");
    }
}

/// Writes `experiment.toml` beside the recording or in the folder of the experiment, or compares the one that is there.
fn keep_experiment(output: &Path, settings: &Settings) -> Result<()> {
    let folder = match project() {
        Some(_) => Path::new("."),
        None => output.parent().unwrap_or(Path::new("")),
    };
    let path = folder.join("experiment.toml");
    if !path.exists() {
        return write_experiment(&path, settings);
    }
    let compared = Experiment::read_with(&path, &read_metadata(output));
    match compared {
        Ok(experiment) => {
            for warning in &experiment.from_metadata.warnings {
                eprintln!("warning: {warning}");
            }
        }
        Err(error) => eprintln!("warning: {}", message(&error)),
    }
    Ok(())
}

fn message(error: &Error) -> String {
    match error.parameter() {
        Some(Parameter::RowTimeUs) => format!("{error} (rowburst calibrate timing)"),
        _ => crate::option_names::message(error),
    }
}
