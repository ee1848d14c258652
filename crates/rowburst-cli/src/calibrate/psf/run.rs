//! From arguments through the library to files.

use super::PsfArgs;
use super::captures::{self, File};
use super::report::{PsfReportInput, render};
use super::summary::{MemorySummary, PsfSummary, RowReach, remarks, warnings};
use crate::calibrate::experiment_of;
use crate::output::print_line;
use rowburst::calibrate::psf::{
    MemoryEffect, MergeParams, NamedCapture, PointSourceImage, PositionedCapture, ballistic_core,
    centred_psfs, centroid, memory_effect, merge, noise_of, patch_set, patches_needed, row_reach,
    select_patches, span_px, statistics, suppress_noise,
};
use rowburst::{Error, Image, PatchSet, Result};
use rowburst_io::{Experiment, OutputFolder, read_image, write_npy_image, write_patch_set};
use rowburst_run::short;

/// Standard deviations of noise above which light is light.
const NOISE_FLOOR_SIGMAS: f64 = 3.0;

pub fn run(args: &PsfArgs) -> Result<()> {
    let folder = OutputFolder::create(&args.output)?;
    let experiment = args
        .experiment
        .as_deref()
        .map(|path| experiment_of(path, &args.captures))
        .transpose()?;
    let settings = CaptureSettings::new(args, experiment.as_ref())?;
    let files = captures::read(args)?;
    let positions = args
        .positions_mm
        .as_deref()
        .map(|csv| captures::read_positions(csv, &files))
        .transpose()?;
    let groups = groups(files, positions.is_some());
    let lights = groups
        .iter()
        .map(|group| settings.light(group))
        .collect::<Result<Vec<PointSourceImage>>>()?;

    let (effect, placed_lights) = match &positions {
        None => (None, Vec::new()),
        Some(positions) => {
            let rough = statistics(&lights[lights.len() / 2].image).grain_px;
            let shots = lights
                .iter()
                .zip(positions)
                .map(|(light, at)| PositionedCapture {
                    light: light.image.clone(),
                    at_mm: *at,
                });
            let shots: Vec<PositionedCapture> = shots.collect();
            let effect = memory_effect(&shots, rough)?;
            (Some(effect), shots)
        }
    };
    let reference = effect.as_ref().map_or(0, |e| e.reference);
    let light = &lights[reference];
    let speckle = statistics(&light.image);
    let core = ballistic_core(&light.image, speckle.grain_px);
    let middle = centroid(&speckle.envelope);
    let cleaned = |light: &Image| {
        suppress_noise(light, speckle.grain_px, noise_of(light), NOISE_FLOOR_SIGMAS).image
    };
    let (rows, columns) = (light.image.rows(), light.image.columns());
    let zero = ((rows / 2) as f64, (columns / 2) as f64);
    let psf = centred_psfs(
        &[&cleaned(&light.image)],
        &[(zero.0 - middle.0, zero.1 - middle.1)],
    )?
    .remove(0);

    let sensor_rows = experiment.as_ref().map_or(rows, |e| e.params.rows);
    let field = args
        .field
        .or(experiment.as_ref().and_then(|e| e.params.field));
    let field = field.or(experiment
        .as_ref()
        .map(|e| (e.params.rows, e.params.columns)));
    let field_rows = field.map_or(sensor_rows, |f| f.0);
    let covered = (
        -middle.0.floor() as isize,
        rows as isize - 1 - middle.0.ceil() as isize,
    );
    let reach = row_reach(
        &psf,
        sensor_rows,
        field_rows,
        speckle.grain_px,
        (speckle.lit_edge_fraction > 0.02).then_some(covered),
    );
    let row_reach = RowReach::new(&reach, sensor_rows, field_rows);

    let patches = match (&effect, &positions) {
        (Some(effect), Some(positions)) => {
            let kept: Vec<usize> = match args.all_patches {
                true => (0..positions.len()).collect(),
                false => select_patches(positions, effect, field),
            };
            let cleaned: Vec<Image> = placed_lights.iter().map(|p| cleaned(&p.light)).collect();
            Some(patch_set(&cleaned, positions, effect, &kept, middle)?)
        }
        _ => None,
    };
    let memory = effect
        .as_ref()
        .zip(positions.as_ref())
        .map(|(effect, positions)| {
            let extent =
                field.map_or_else(|| span_px(positions, effect), |f| (f.0 as f64, f.1 as f64));
            let count = patches.as_ref().map_or(0, |p| p.psfs().len());
            MemorySummary::new(effect, count, patches_needed(effect, extent))
        });
    let mut warned = warnings(
        light,
        &speckle,
        core.as_ref(),
        &row_reach,
        args.expected_grain_px,
    );
    warned.extend(saturated_captures(&lights, reference, &groups));
    let summary = PsfSummary {
        version: env!("CARGO_PKG_VERSION"),
        rows: psf.image().rows(),
        columns: psf.image().columns(),
        binning: settings.binning,
        captures: lights.iter().map(|l| l.used).sum(),
        left_out: lights
            .iter()
            .flat_map(|l| &l.left_out)
            .map(|o| o.0.clone())
            .collect(),
        contrast: speckle.contrast,
        grain_px: speckle.grain_px,
        grain_y_px: speckle.grain_y_px,
        grain_x_px: speckle.grain_x_px,
        ballistic_fraction: core.map_or(0.0, |c| c.fraction),
        ballistic_at_px: core.map(|c| c.at_px),
        saturated_fraction: light.saturated_fraction,
        exponential_distance: speckle.exponential_distance,
        noise_part: speckle.noise_fraction,
        lit_fraction: speckle.lit_fraction,
        floor_counts: light.black_level.map(|f| f.counts),
        middle_px: middle,
        remarks: remarks(light, &speckle, &row_reach, effect.as_ref()),
        row_reach,
        memory,
        warnings: warned,
    };
    for warning in &summary.warnings {
        eprintln!("warning: {warning}");
    }
    for remark in &summary.remarks {
        eprintln!("note: {remark}");
    }
    let input = PsfReportInput {
        args,
        psf: psf.image(),
        speckle: &speckle,
        reach: &reach,
        effect: effect.as_ref().zip(positions.as_deref()),
        summary: &summary,
    };
    write(&folder, &input, experiment, patches.as_ref())?;
    if args.json {
        print_line(serde_json::to_string_pretty(&summary).expect("plain numbers and text"));
    } else {
        print_summary(&summary, effect.as_ref(), args);
    }
    Ok(())
}

/// What holds for every capture.
struct CaptureSettings {
    dark: Option<Image>,
    exposures_ms: Vec<f64>,
    saturation_counts: Option<f64>,
    binning: usize,
}

impl CaptureSettings {
    fn new(args: &PsfArgs, experiment: Option<&Experiment>) -> Result<Self> {
        let dark = args
            .dark
            .as_ref()
            .or(experiment.and_then(|e| e.calibration.dark.as_ref()));
        let sensor = experiment.map(|e| e.camera()).transpose()?;
        let sensor = sensor.as_ref().map(|c| c.sensor());
        for (option, value) in [
            ("--saturation-counts", args.saturation_counts),
            ("--expected-grain-px", args.expected_grain_px),
        ] {
            if let Some(bad) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
                return Err(Error::input(
                    option,
                    bad,
                    "the value is a number above zero",
                    "Leave the option out where it is not known.",
                ));
            }
        }
        Ok(Self {
            dark: dark.map(|path| Ok(read_image(path)?.image)).transpose()?,
            exposures_ms: args.exposures_ms.clone(),
            saturation_counts: args
                .saturation_counts
                .or(sensor.and_then(|s| s.saturation_counts())),
            binning: args
                .binning
                .map_or(sensor.map_or(1, |s| s.binning), usize::from),
        })
    }

    /// The light of one place, on the working grid.
    fn light(&self, group: &Group) -> Result<PointSourceImage> {
        let mut light = merge(
            &group.shots,
            &MergeParams {
                dark: self.dark.clone(),
                exposures_ms: self.exposures_ms.clone(),
                saturation_counts: self.saturation_counts.or(group.container_end),
            },
        )?;
        let short = light.image.rows().min(light.image.columns());
        if short < 16 * self.binning {
            return Err(Error::input(
                &group.shots[0].name,
                format!(
                    "{}×{} pixels, binned by {}",
                    light.image.rows(),
                    light.image.columns(),
                    self.binning
                ),
                "a PSF has 16 pixels or more along each side",
                "Record a larger region, or bin less.",
            ));
        }
        if self.binning > 1 {
            light.image = light.image.binned(self.binning);
        }
        Ok(light)
    }
}

/// Captures of one place.
struct Group {
    shots: Vec<NamedCapture>,
    container_end: Option<f64>,
}

fn groups(files: Vec<File>, by_file: bool) -> Vec<Group> {
    let groups = files.into_iter().map(|file| Group {
        shots: file.shots,
        container_end: file.container_end,
    });
    if by_file {
        return groups.collect();
    }
    let joined = groups.reduce(|mut all, one| {
        all.shots.extend(one.shots);
        all.container_end = all.container_end.or(one.container_end);
        all
    });
    // No capture at all is an error of the library.
    vec![joined.unwrap_or(Group {
        shots: Vec::new(),
        container_end: None,
    })]
}

/// Captures besides the reference that are saturated.
fn saturated_captures(
    lights: &[PointSourceImage],
    reference: usize,
    groups: &[Group],
) -> Option<String> {
    let others = lights.iter().zip(groups).enumerate();
    let mut names = others
        .filter(|(i, (light, _))| *i != reference && light.saturated_fraction > 1e-3)
        .map(|(_, (_, group))| group.shots[0].name.as_str());
    let first = names.next()?;
    Some(format!(
        "{} more captures are saturated, such as {first}: shorten the exposure",
        names.count() + 1
    ))
}

/// Writes all files, `psf.json` last: where it is, the result is whole.
fn write(
    folder: &OutputFolder,
    input: &PsfReportInput,
    experiment: Option<Experiment>,
    patches: Option<&PatchSet>,
) -> Result<()> {
    for stale in ["psf.json", "psf-patches.toml", "psf-patches.npy"] {
        folder.remove(stale)?;
    }
    folder.write("psf.npy", |w| write_npy_image(w, input.psf))?;
    if let Some(set) = patches {
        write_patch_set(folder, "psf-patches", set)?;
    }
    if let Some(mut experiment) = experiment {
        let several = patches.is_some_and(|p| p.psfs().len() > 1);
        let file = if several {
            "psf-patches.toml"
        } else {
            "psf.npy"
        };
        experiment.calibration.psf = Some(folder.path().join(file));
        if input.args.dark.is_some() {
            experiment.calibration.dark.clone_from(&input.args.dark);
        }
        experiment.params.sensor.binning = input.summary.binning;
        if let Some(field) = input.args.field {
            experiment.params.field = Some(field);
        }
        experiment.camera()?;
        let toml = experiment.to_toml(folder.path());
        folder.write_bytes("experiment.toml", toml.as_bytes())?;
    }
    let report = render(input, patches.is_some())?;
    for picture in &report.pictures {
        folder.write_bytes(&picture.name, &picture.png)?;
    }
    folder.write_bytes("report.html", report.html.as_bytes())?;
    let json = serde_json::to_string_pretty(input.summary).expect("plain numbers and text");
    folder.write_bytes("psf.json", format!("{json}\n").as_bytes())
}

fn print_summary(summary: &PsfSummary, effect: Option<&MemoryEffect>, args: &PsfArgs) {
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
            .map_or("beyond the places".into(), |r| format!("{r:.3} mm"));
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
