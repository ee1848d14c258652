//! From arguments through the library to files.

use super::PsfArgs;
use super::captures::{self, File};
use super::report::{PsfReportInput, render};
use super::summary::{MemorySummary, PsfSummary, RowReach, remarks, warnings};
use crate::calibrate::experiment_of;
use crate::output::print_line;
use rowburst::calibrate::psf::{
    Core, MemoryEffect, MergeParams, NamedCapture, PointSourceImage, PositionedCapture, Reach,
    SpeckleStatistics, ballistic_core, centred_psfs, centroid, memory_effect, merge, noise_of,
    patch_set, patches_needed, row_reach, select_patches, span_px, statistics, suppress_noise,
};
use rowburst::{Error, Image, PatchSet, Psf, Result};
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

    let memory = positions
        .map(|positions| MemoryMeasurement::new(&lights, positions))
        .transpose()?;
    let effect = memory.as_ref().map(|m| &m.effect);
    let index = effect.map_or(0, |e| e.reference);
    let reference = ReferencePsf::new(&lights[index])?;
    let field = field_of(args, experiment.as_ref());
    let sensor_rows = experiment
        .as_ref()
        .map_or(reference.light.image.rows(), |e| e.params.rows);
    let field_rows = field.map_or(sensor_rows, |f| f.0);
    let reach = reference.reach(sensor_rows, field_rows);
    let row_reach = RowReach::new(&reach, sensor_rows, field_rows);
    let patches = memory
        .as_ref()
        .map(|m| m.patches(&reference, field, args.all_patches))
        .transpose()?;
    let patch_count = patches.as_ref().map_or(0, |p| p.psfs().len());
    let mut warned = warnings(
        reference.light,
        &reference.speckle,
        reference.core.as_ref(),
        &row_reach,
        args.expected_grain_px,
    );
    warned.extend(saturated_captures(&lights, index, &groups));
    let summary = reference.summary(
        &lights,
        settings.binning,
        row_reach,
        effect,
        memory.as_ref().map(|m| m.summary(field, patch_count)),
        warned,
    );
    print_warnings(&summary);
    let input = PsfReportInput {
        args,
        psf: reference.psf.image(),
        speckle: &reference.speckle,
        reach: &reach,
        effect: memory.as_ref().map(|m| (&m.effect, m.positions.as_slice())),
        summary: &summary,
    };
    write(&folder, &input, experiment, patches.as_ref())?;
    if args.json {
        print_line(serde_json::to_string_pretty(&summary).expect("plain numbers and text"));
    } else {
        print_summary(&summary, effect, args);
    }
    Ok(())
}

/// The size of the field in rows and columns: that of the options, else of the experiment.
fn field_of(args: &PsfArgs, experiment: Option<&Experiment>) -> Option<(usize, usize)> {
    let field = args.field.or(experiment.and_then(|e| e.params.field));
    field.or(experiment.map(|e| (e.params.rows, e.params.columns)))
}

/// The PSF of the reference capture, and the speckle that it was computed from.
struct ReferencePsf<'a> {
    light: &'a PointSourceImage,
    speckle: SpeckleStatistics,
    core: Option<Core>,
    /// Centroid `(y, x)` of the envelope, which becomes zero displacement.
    centre: (f64, f64),
    psf: Psf,
}

impl<'a> ReferencePsf<'a> {
    fn new(light: &'a PointSourceImage) -> Result<Self> {
        let speckle = statistics(&light.image);
        let core = ballistic_core(&light.image, speckle.grain_px);
        let centre = centroid(&speckle.envelope);
        let (rows, columns) = (light.image.rows(), light.image.columns());
        let zero = ((rows / 2) as f64, (columns / 2) as f64);
        let psf = centred_psfs(
            &[&cleaned(&light.image, speckle.grain_px)],
            &[(zero.0 - centre.0, zero.1 - centre.1)],
        )?
        .remove(0);
        Ok(Self {
            light,
            speckle,
            core,
            centre,
            psf,
        })
    }

    /// The light that each sensor row gets from each row of the field.
    fn reach(&self, sensor_rows: usize, field_rows: usize) -> Reach {
        let covered = (
            -self.centre.0.floor() as isize,
            self.light.image.rows() as isize - 1 - self.centre.0.ceil() as isize,
        );
        row_reach(
            &self.psf,
            sensor_rows,
            field_rows,
            self.speckle.grain_px,
            (self.speckle.lit_edge_fraction > 0.02).then_some(covered),
        )
    }

    /// The numbers of `psf.json`; `lights` are those of all captures.
    fn summary(
        &self,
        lights: &[PointSourceImage],
        binning: usize,
        row_reach: RowReach,
        effect: Option<&MemoryEffect>,
        memory: Option<MemorySummary>,
        warnings: Vec<String>,
    ) -> PsfSummary {
        PsfSummary {
            version: env!("CARGO_PKG_VERSION"),
            rows: self.psf.image().rows(),
            columns: self.psf.image().columns(),
            binning,
            captures: lights.iter().map(|l| l.used).sum(),
            left_out: lights
                .iter()
                .flat_map(|l| &l.left_out)
                .map(|o| o.0.clone())
                .collect(),
            contrast: self.speckle.contrast,
            grain_px: self.speckle.grain_px,
            grain_y_px: self.speckle.grain_y_px,
            grain_x_px: self.speckle.grain_x_px,
            ballistic_fraction: self.core.map_or(0.0, |c| c.fraction),
            ballistic_at_px: self.core.map(|c| c.at_px),
            saturated_fraction: self.light.saturated_fraction,
            exponential_distance: self.speckle.exponential_distance,
            noise_part: self.speckle.noise_fraction,
            lit_fraction: self.speckle.lit_fraction,
            floor_counts: self.light.black_level.map(|f| f.counts),
            middle_px: self.centre,
            remarks: remarks(self.light, &self.speckle, &row_reach, effect),
            row_reach,
            memory,
            warnings,
        }
    }
}

/// `light` without its noise.
fn cleaned(light: &Image, grain_px: f64) -> Image {
    suppress_noise(light, grain_px, noise_of(light), NOISE_FLOOR_SIGMAS).image
}

/// The memory effect between captures at known positions.
struct MemoryMeasurement {
    /// Positions `(y, x)` in millimetres.
    positions: Vec<(f64, f64)>,
    captures: Vec<PositionedCapture>,
    effect: MemoryEffect,
}

impl MemoryMeasurement {
    fn new(lights: &[PointSourceImage], positions: Vec<(f64, f64)>) -> Result<Self> {
        let rough = statistics(&lights[lights.len() / 2].image).grain_px;
        let captures = lights.iter().zip(&positions);
        let captures: Vec<PositionedCapture> = captures
            .map(|(light, at)| PositionedCapture {
                light: light.image.clone(),
                at_mm: *at,
            })
            .collect();
        let effect = memory_effect(&captures, rough)?;
        Ok(Self {
            positions,
            captures,
            effect,
        })
    }

    /// A PSF for each patch of the field, or for each position if `all` is set.
    fn patches(
        &self,
        reference: &ReferencePsf,
        field: Option<(usize, usize)>,
        all: bool,
    ) -> Result<PatchSet> {
        let kept: Vec<usize> = if all {
            (0..self.positions.len()).collect()
        } else {
            select_patches(&self.positions, &self.effect, field)
        };
        let captures = self.captures.iter();
        let cleaned: Vec<Image> = captures
            .map(|p| cleaned(&p.light, reference.speckle.grain_px))
            .collect();
        patch_set(
            &cleaned,
            &self.positions,
            &self.effect,
            &kept,
            reference.centre,
        )
    }

    /// The numbers of the memory effect; `patches` is the number of PSFs written.
    fn summary(&self, field: Option<(usize, usize)>, patches: usize) -> MemorySummary {
        let extent = field.map_or_else(
            || span_px(&self.positions, &self.effect),
            |f| (f.0 as f64, f.1 as f64),
        );
        let needed = patches_needed(&self.effect, extent);
        MemorySummary::new(&self.effect, patches, needed)
    }
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
                saturation_counts: self.saturation_counts.or(group.saturation_limit),
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
    saturation_limit: Option<f64>,
}

fn groups(files: Vec<File>, by_file: bool) -> Vec<Group> {
    let groups = files.into_iter().map(|file| Group {
        shots: file.shots,
        saturation_limit: file.saturation_limit,
    });
    if by_file {
        return groups.collect();
    }
    let joined = groups.reduce(|mut all, one| {
        all.shots.extend(one.shots);
        all.saturation_limit = all.saturation_limit.or(one.saturation_limit);
        all
    });
    // No capture at all is an error of the library.
    vec![joined.unwrap_or(Group {
        shots: Vec::new(),
        saturation_limit: None,
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

/// Prints the warnings and the remarks to standard error.
fn print_warnings(summary: &PsfSummary) {
    for warning in &summary.warnings {
        eprintln!("warning: {warning}");
    }
    for remark in &summary.remarks {
        eprintln!("note: {remark}");
    }
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
