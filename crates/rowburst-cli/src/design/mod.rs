//! `rowburst design`: what a camera, a lens and a diffuser can do before they are bought.

mod options;
mod page;
mod summary;

pub use options::DesignArgs;

use crate::inputs::read_psfs;
use crate::output::print_line;
use indicatif::{ProgressBar, ProgressStyle};
use options::DesignInputs;
use rowburst::design::sparsity::{SparsityParams, SuccessMap, success_map, trial_camera};
use rowburst::design::{Assessment, assess};
use rowburst::simulate::speckle_psf;
use rowburst::{Camera, Psf, Result};
use rowburst_io::OutputFolder;
use std::io::IsTerminal;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::Instant;
use summary::{DesignSummary, print_summary};

pub fn run(args: &DesignArgs) -> Result<()> {
    let started = Instant::now();
    let inputs = args.inputs()?;
    let given = inputs
        .psf
        .as_deref()
        .map(|path| psf_of(path, &inputs.camera))
        .transpose()?;
    let assessment = assess(
        &inputs.camera,
        &inputs.optics,
        &inputs.light,
        given.as_ref(),
    )
    .map_err(|e| args.naming_option(e))?;
    let folder = match &args.output {
        Some(path) => Some(OutputFolder::create(path)?),
        None => None,
    };
    let map = if args.quick {
        None
    } else {
        Some(map_of(&inputs, &assessment, given.as_ref())?)
    };
    let summary = DesignSummary::new(
        &inputs,
        &assessment,
        map.as_ref(),
        started.elapsed().as_secs_f64(),
    );
    if let Some(folder) = &folder {
        // One that cannot be simulated is only not shown.
        let psf = match given {
            Some(psf) => Some(psf),
            None => simulated(&inputs, &inputs.camera, assessment.envelope_fwhm_px).ok(),
        };
        let page = page::Page {
            inputs: &inputs,
            assessment: &assessment,
            map: map.as_ref(),
            psf: psf.as_ref(),
            summary: &summary,
            reproduce: &args.command_line(),
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

/// A speckle PSF of all displacements that `camera` needs, its envelope `fwhm_px` wide.
fn simulated(inputs: &DesignInputs, camera: &Camera, fwhm_px: f64) -> Result<Psf> {
    let (field_rows, field_columns) = camera.field();
    let optics = inputs.optics.with_envelope(fwhm_px);
    speckle_psf(
        &optics,
        (camera.rows() + field_rows - 1) | 1,
        (camera.columns() + field_columns - 1) | 1,
        inputs.seed,
    )
}

/// The success map, with the given PSF, or with speckle of the grain and, where the trial
/// camera is smaller, an envelope in proportion.
fn map_of(
    inputs: &DesignInputs,
    assessment: &Assessment,
    given: Option<&Psf>,
) -> Result<SuccessMap> {
    let camera = trial_camera(&inputs.camera)?;
    let part = camera.rows() as f64 / inputs.camera.rows() as f64;
    let psf = match given {
        Some(psf) => psf.clone(),
        None => simulated(inputs, &camera, part * assessment.envelope_fwhm_px)?,
    };
    let grain_px = assessment
        .measured_grain_px
        .unwrap_or_else(|| assessment.grains.fwhm_px());
    let mut params = SparsityParams::for_camera(&camera, grain_px, inputs.seed);
    if !inputs.trial_snrs.is_empty() {
        params.snrs = inputs.trial_snrs.clone();
    }
    let bar = if std::io::stderr().is_terminal() {
        ProgressBar::new(1000)
    } else {
        ProgressBar::hidden()
    };
    let style = ProgressStyle::with_template("{bar:30} {percent} %, about {eta} left; {msg}");
    bar.set_style(style.expect("the template is valid"));
    bar.set_message(format!(
        "trial reconstructions, {}×{} pixels",
        camera.rows(),
        camera.columns()
    ));
    let map = success_map(&camera, &psf, &params, &mut |part| {
        bar.set_position((1000.0 * part) as u64);
        ControlFlow::Continue(())
    });
    bar.finish_and_clear();
    map
}
