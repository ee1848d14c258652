//! `rowburst design`: what a camera, a lens and a diffuser can do before they are bought.

mod options;

pub use options::DesignArgs;

use crate::inputs::read_psfs;
use crate::output::print_line;
use indicatif::{ProgressBar, ProgressStyle};
use rowburst::design::Assessment;
use rowburst::design::sparsity::SuccessMap;
use rowburst::{Camera, Psf, Result};
use rowburst_io::OutputFolder;
use rowburst_run::design::{DesignInputs, DesignSummary, Page};
use rowburst_run::is_logging;
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;

pub fn run(args: &DesignArgs) -> Result<()> {
    let started = Instant::now();
    let inputs = args.inputs()?;
    let given = inputs
        .psf_file
        .as_deref()
        .map(|path| psf_of(path, &inputs.camera))
        .transpose()?;
    let assessment = inputs.assess(given.as_ref());
    let assessment = assessment.map_err(|e| args.naming_option(e))?;
    let folder = match &args.output {
        Some(path) => Some(OutputFolder::create(path)?),
        None => None,
    };
    let map = if args.quick {
        None
    } else {
        Some(map_of(&inputs, &assessment, given.as_ref())?)
    };
    let seconds = started.elapsed().as_secs_f64();
    let summary = DesignSummary::new(&inputs, &assessment, map.as_ref(), seconds);
    if let Some(folder) = &folder {
        let psf = given.or_else(|| inputs.simulated_psf(&assessment));
        let page = Page {
            inputs: &inputs,
            assessment: &assessment,
            map: map.as_ref(),
            psf: psf.as_ref(),
            summary: &summary,
            reproduce: Some(&args.command_line()),
        };
        page.write(folder)?;
    }
    if args.json {
        print_line(summary.json());
    } else {
        print_summary(&summary, args.output.as_deref());
    }
    Ok(())
}

/// The PSF of a file; of a patch set the one in the middle.
fn psf_of(path: &Path, camera: &Camera) -> Result<Psf> {
    Ok(read_psfs(path, camera, None)?.central().clone())
}

/// The success map, with a progress bar.
fn map_of(
    inputs: &DesignInputs,
    assessment: &Assessment,
    given: Option<&Psf>,
) -> Result<SuccessMap> {
    let bar = if std::io::stderr().is_terminal() && !is_logging() {
        ProgressBar::new(1000)
    } else {
        ProgressBar::hidden()
    };
    let style = ProgressStyle::with_template("{bar:30} {percent} %, about {eta} left; {msg}");
    bar.set_style(style.expect("the template is valid"));
    let map = inputs.success_map(assessment, given, &mut |camera, part| {
        if bar.position() == 0 {
            let (rows, columns) = (camera.rows(), camera.columns());
            bar.set_message(format!("trial reconstructions, {rows}×{columns} pixels"));
        }
        bar.set_position((1000.0 * part) as u64);
        ControlFlow::Continue(())
    });
    bar.finish_and_clear();
    map
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
