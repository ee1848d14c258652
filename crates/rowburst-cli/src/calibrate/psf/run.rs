//! From arguments to the PSF and its files.

use super::PsfArgs;
use super::captures::read_positions;
use crate::calibrate::experiment_of;
use crate::output::print_line;
use rowburst::error::Subject;
use rowburst::{Error, Result};
use rowburst_io::{Experiment, read_image};
use rowburst_run::calibrate::psf::{
    CaptureFile, CaptureGroup, PsfCalibration, PsfFolder, PsfInputs, PsfSummary, read_captures,
};
use rowburst_run::short;

pub fn run(args: &PsfArgs) -> Result<()> {
    let folder = args.force.claim(&args.output, "calibrate psf")?;
    let experiment = args
        .experiment
        .as_deref()
        .map(|path| experiment_of(path, &args.captures))
        .transpose()?;
    let found = inputs(args, experiment.as_ref())?.calibrate()?;
    print_warnings(&found.summary);
    let reproduce = command_line(args);
    let beside = PsfFolder {
        experiment,
        field: args.field,
        reproduce: Some(&reproduce),
    };
    found.write(&folder, beside)?;
    if args.json {
        print_line(serde_json::to_string_pretty(&found.summary).expect("plain numbers and text"));
    } else {
        print_summary(&found, args);
    }
    Ok(())
}

/// Reads the captures and what the experiment says of them.
fn inputs(args: &PsfArgs, experiment: Option<&Experiment>) -> Result<PsfInputs> {
    let dark = args
        .dark
        .as_ref()
        .or(experiment.and_then(|e| e.calibration.dark.as_ref()));
    let camera = experiment.map(Experiment::camera).transpose()?;
    let sensor = camera.as_ref().map(|c| c.sensor());
    for (option, value) in [
        ("--saturation-counts", args.saturation_counts),
        ("--expected-grain-px", args.expected_grain_px),
    ] {
        if let Some(bad) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
            return Err(Error::input(
                Subject::named(option),
                bad,
                "the value is a number above zero",
                "Leave the option out where it is not known.",
            ));
        }
    }
    let dark = dark.map(|path| Ok(read_image(path)?.image)).transpose()?;
    let files = read_captures(&args.captures)?;
    let positions_mm = args
        .positions_mm
        .as_deref()
        .map(|csv| read_positions(csv, &files))
        .transpose()?;
    Ok(PsfInputs {
        groups: groups(files, positions_mm.is_some()),
        positions_mm,
        dark,
        exposures_ms: args.exposures_ms.clone(),
        saturation_counts: args
            .saturation_counts
            .or(sensor.and_then(|s| s.saturation_counts())),
        binning: args
            .binning
            .map_or(sensor.map_or(1, |s| s.binning), usize::from),
        field: field_of(args, experiment),
        sensor_rows: experiment.map(|e| e.params.rows),
        expected_grain_px: args.expected_grain_px,
        pinhole_um: args.pinhole_um,
        object_pixel_um: sensor.and_then(|s| s.object_pixel_um()),
        all_patches: args.all_patches,
    })
}

/// The size of the field in rows and columns: that of the options, else of the experiment.
fn field_of(args: &PsfArgs, experiment: Option<&Experiment>) -> Option<(usize, usize)> {
    let field = args.field.or(experiment.and_then(|e| e.params.field));
    field.or(experiment.map(|e| (e.params.rows, e.params.columns)))
}

fn groups(files: Vec<CaptureFile>, by_file: bool) -> Vec<CaptureGroup> {
    let groups = files.into_iter().map(CaptureGroup::from);
    if by_file {
        return groups.collect();
    }
    CaptureGroup::join(groups)
}

/// Prints the warnings and the remarks to standard error.
fn print_warnings(summary: &PsfSummary) {
    for warning in &summary.warnings {
        eprintln!("warning: {warning}");
    }
    for remark in &summary.remarks {
        eprintln!("note: {remark}");
    }
}

fn print_summary(found: &PsfCalibration, args: &PsfArgs) {
    let (summary, effect) = (&found.summary, found.effect.as_ref().map(|e| &e.0));
    print_line(format!("contrast     {:.3}", summary.contrast));
    print_line(format!(
        "grain        {:.2} px (rows {:.2}, columns {:.2})",
        summary.grain_px, summary.grain_y_px, summary.grain_x_px
    ));
    print_line(format!(
        "ballistic    {:.2} %",
        100.0 * summary.ballistic_fraction
    ));
    print_line(format!(
        "saturated    {:.2} %",
        100.0 * summary.saturated_fraction
    ));
    if let Some(capture) = found.psf.capture().filter(|c| c.pinhole_px > 0.0) {
        print_line(format!(
            "pinhole      {:.2} px (its blur is removed)",
            capture.pinhole_px
        ));
    }
    print_line(format!(
        "row reach    {} of the mean at the far edge ({})",
        short(summary.row_reach.worst),
        if summary.row_reach.enough {
            "enough"
        } else {
            "too little"
        }
    ));
    if let (Some(memory), Some(effect)) = (&summary.memory, effect) {
        print_line(format!(
            "shift        {:.2} px/mm (residual {:.2} px)",
            memory.shift_px_per_mm, memory.shift_residual_px
        ));
        let range = effect
            .range_mm
            .map_or("beyond the measured positions".into(), |r| {
                format!("{r:.3} mm")
            });
        print_line(format!("isoplanatic  {range}"));
        print_line(format!(
            "patches      {} written, {} × {} needed",
            memory.patches, memory.patches_needed.0, memory.patches_needed.1
        ));
    }
    print_line(format!(
        "report       {}",
        args.output.join("report.html").display()
    ));
}

fn command_line(args: &PsfArgs) -> String {
    let mut line = "rowburst calibrate psf".to_string();
    for path in &args.captures {
        line += &format!(" {}", path.display());
    }
    for (flag, path) in [
        ("--dark", &args.dark),
        ("--positions-mm", &args.positions_mm),
        ("--experiment", &args.experiment),
    ] {
        if let Some(path) = path {
            line += &format!(" {flag} {}", path.display());
        }
    }
    if !args.exposures_ms.is_empty() {
        let list: Vec<String> = args.exposures_ms.iter().map(f64::to_string).collect();
        line += &format!(" --exposures-ms {}", list.join(","));
    }
    for (flag, value) in [
        ("--binning", args.binning.map(|b| b.to_string())),
        (
            "--saturation-counts",
            args.saturation_counts.map(|v| v.to_string()),
        ),
        (
            "--expected-grain-px",
            args.expected_grain_px.map(|v| v.to_string()),
        ),
        ("--pinhole-um", args.pinhole_um.map(|v| v.to_string())),
        ("--field", args.field.map(|(r, c)| format!("{r}x{c}"))),
    ] {
        if let Some(value) = value {
            line += &format!(" {flag} {value}");
        }
    }
    if args.all_patches {
        line += " --all-patches";
    }
    line + &format!(" -o {}", args.output.display())
}
