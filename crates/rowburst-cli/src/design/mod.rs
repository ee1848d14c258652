//! `rowburst design`: what a camera, a lens and a diffuser can do before they are bought.

mod options;

pub use options::DesignArgs;

use crate::output::print_line;
use indicatif::{ProgressBar, ProgressStyle};
use rowburst::{Camera, Psf, Result};
use rowburst_run::design::DesignSummary;
use rowburst_run::inputs::read_psfs;
use rowburst_run::{Event, check_camera, is_logging};
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

pub fn run(args: &DesignArgs) -> Result<()> {
    let started = Instant::now();
    let inputs = args.inputs()?;
    for warning in check_camera(inputs.camera.params()).map_err(|e| args.naming_option(e))? {
        eprintln!("warning: {warning}");
    }
    let given = inputs
        .psf_file
        .as_deref()
        .map(|path| psf_of(path, &inputs.camera))
        .transpose()?;
    let folder = match &args.output {
        Some(path) => Some(args.force.claim(path, "design")?),
        None => None,
    };
    let bar = bar();
    let design = inputs.run(given, !args.quick, started, &mut |event| {
        show(&bar, event);
        ControlFlow::Continue(())
    });
    bar.finish_and_clear();
    let design = design.map_err(|e| args.naming_option(e))?;
    if let Some(folder) = &folder {
        design.write(folder, Some(&args.command_line()))?;
    }
    let summary = &design.summary;
    if args.json {
        print_line(summary.json());
    } else {
        print_summary(summary, args.output.as_deref());
    }
    Ok(())
}

/// The PSF of a file; of a patch set the one in the middle.
fn psf_of(path: &Path, camera: &Camera) -> Result<Psf> {
    let (psfs, note) = read_psfs(path, camera, None)?;
    if let Some(note) = note {
        eprintln!("{note}");
    }
    Ok(psfs.central().clone())
}

/// The progress bar of the trials.
fn bar() -> ProgressBar {
    let bar = if std::io::stderr().is_terminal() && !is_logging() {
        ProgressBar::new(1000)
    } else {
        ProgressBar::hidden()
    };
    let style = ProgressStyle::with_template("{bar:30} {percent} %, about {eta} left; {msg}");
    bar.set_style(style.expect("the template is valid"));
    bar
}

fn show(bar: &ProgressBar, event: Event) {
    if let Event::Trials { camera, part } = event {
        if bar.position() == 0 {
            let (rows, columns) = (camera.rows(), camera.columns());
            bar.set_message(format!("trial reconstructions, {rows}×{columns} pixels"));
        }
        bar.set_position((1000.0 * part) as u64);
    }
}

/// The sections, the shortcomings and where to look.
pub fn print_summary(summary: &DesignSummary, folder: Option<&Path>) {
    for (heading, lines) in summary.sections() {
        print_line(heading);
        for (name, value) in lines {
            print_line(format_args!("  {name:<31} {value}"));
        }
    }
    for warning in &summary.warnings {
        print_line(format_args!("warning: {warning}"));
    }
    if summary.warnings.is_empty() {
        print_line("nothing falls short");
    }
    if let Some(folder) = folder {
        print_line(format_args!(
            "open {}",
            folder.join("report.html").display()
        ));
    }
}
