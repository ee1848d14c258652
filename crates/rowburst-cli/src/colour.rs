//! `rowburst reconstruct` of a raw Bayer frame: four planes, each with a result of its own, and
//! one video in colour.

use crate::args::ReconstructArgs;
use crate::inputs::{read_psfs, resolve_calibration};
use crate::output::print_line;
use crate::progress::Bar;
use crate::reconstruct::{command_line, movie_style, options};
use rowburst::bayer::{Bayer, Site};
use rowburst::measurement::correct;
use rowburst::reconstruct::{Options, SelfCalibration};
use rowburst::{Error, Result, Video};
use rowburst_io::{
    Calibration, Experiment, OutputFolder, TiffScale, write_npy_colour, write_tiff_colour,
};
use rowburst_run::inputs::{check_memory, naming_file, psf_path, read_corrections, read_frame};
use rowburst_run::options::parse_time_budget;
use rowburst_run::{
    ColourInputs, ColourSummary, MetadataNumbers, Plane, PlaneSummary, RESULT_SCHEMA_VERSION,
    ReconstructionSummary, ResultMeta, Task, TraceRequest, check_raw_frame, merge_planes,
    player_of, solve, thousands,
};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// What all planes share.
struct SharedInputs {
    colour: ColourInputs,
    calibration: Calibration,
    budget: Option<Duration>,
}

pub fn run(
    args: &ReconstructArgs,
    experiment: Experiment,
    mosaic: Bayer,
    process_start: Instant,
    stop: &Arc<AtomicBool>,
) -> Result<()> {
    refuse_options(args)?;
    let folder = OutputFolder::create(&args.output)?;
    let shared = SharedInputs::read(args, &experiment, mosaic)?;
    let mut options = options(args, &experiment)?;
    // Each plane would correct the PSF in its own way.
    options.self_calibration = SelfCalibration::Off;
    folder.remove("result.json")?;
    let mut planes: Vec<(Site, PlaneSummary, Video)> = Vec::new();
    let mut bin_us = 0.0;
    for site in shared.colour.sites() {
        eprintln!("{}", site.name());
        let plane = shared.colour.plane_camera(site);
        let plane = plane.map_err(|e| e.within(experiment.path.display()))?;
        let start_us = plane.start_us;
        bin_us = plane.camera.time().bin_duration_us();
        let plane = shared.colour.plane(site, plane)?;
        let (summary, video) = shared.solve(args, plane, options, process_start, stop)?;
        options.prior = options.prior.or(summary.prior.parse().ok());
        let listed = plane_summary(&summary, site, start_us, args);
        planes.push((site, listed, video));
    }
    let mut warnings = experiment.from_metadata.warnings.clone();
    warnings.extend(offset_warning(&planes));
    let shape = planes[0].2.shape();
    let videos: Vec<(Site, &Video)> = planes.iter().map(|(site, _, v)| (*site, v)).collect();
    let Some(colours) = merge_planes(&videos) else {
        return Err(Error::work(
            args.output.display().to_string(),
            "planes of different lengths: there is no video in colour",
            "The planes' own folders are whole.",
        ));
    };
    let scale = TiffScale {
        frame_interval_s: bin_us * 1e-6,
        pixel_pitch_um: shared
            .colour
            .camera
            .sensor()
            .pixel_pitch_um
            .map(|p| 2.0 * p),
    };
    folder.write("colour.npy", |w| write_npy_colour(w, shape, &colours))?;
    folder.write("colour.tif", |w| {
        write_tiff_colour(w, shape, &colours, scale)
    })?;
    let summary = ColourSummary {
        schema_version: RESULT_SCHEMA_VERSION,
        version: env!("CARGO_PKG_VERSION"),
        bayer: mosaic.name(),
        frames: shape.bins,
        rows: shape.rows,
        columns: shape.columns,
        frame_rate_hz: 1e6 / bin_us,
        metadata: MetadataNumbers::from(&experiment.from_metadata),
        planes: planes.into_iter().map(|(_, plane, _)| plane).collect(),
        warnings,
    };
    let json = serde_json::to_string_pretty(&summary).expect("plain numbers and text");
    folder.write_bytes("result.json", format!("{json}\n").as_bytes())?;
    if args.json {
        print_line(json);
    } else {
        print_summary(&summary, args);
    }
    Ok(())
}

/// What belongs to one grey video.
fn refuse_options(args: &ReconstructArgs) -> Result<()> {
    #[cfg(feature = "view")]
    let view = args.view;
    #[cfg(not(feature = "view"))]
    let view = false;
    let given = [
        ("--truth", args.truth.is_some()),
        ("--direct", args.direct.is_some()),
        ("--region", !args.region.is_empty()),
        ("--photodiode", !args.photodiode.is_empty()),
        ("--view", view),
        ("--bins", args.bins.is_some()),
        ("--part-bins", args.part_bins.is_some()),
        ("--sweep", !args.sweep.is_empty()),
        (
            "--self-calibrate",
            args.self_calibrate.as_deref() == Some(SelfCalibration::On.name()),
        ),
    ];
    match given.iter().find(|(_, given)| *given) {
        None => Ok(()),
        Some((option, _)) => Err(Error::input(
            *option,
            "a raw Bayer frame",
            "its four planes are reconstructed separately, and the option is for one video",
            "Leave it out.",
        )),
    }
}

impl SharedInputs {
    fn read(args: &ReconstructArgs, experiment: &Experiment, mosaic: Bayer) -> Result<Self> {
        let camera = experiment.camera()?;
        let calibration = resolve_calibration(&args.calibration, experiment);
        let psf_path = psf_path(&calibration, experiment)?.to_path_buf();
        let (raw, saturation_limit) = read_frame(&args.frame)?;
        check_raw_frame(&args.frame.display().to_string(), &raw, &camera)?;
        let corrections = read_corrections(&calibration, saturation_limit)?;
        let colour = ColourInputs {
            raw,
            psfs: read_psfs(&psf_path, &camera, corrections.dark.as_ref())?,
            camera,
            mosaic,
            corrections,
        };
        let check = colour.check_corrections();
        check.map_err(|e| naming_file(e, &args.frame, &calibration))?;
        check_memory(&args.experiment, &colour.camera)?;
        Ok(Self {
            colour,
            calibration,
            budget: parse_time_budget(args.time_budget_s)?.map(|budget| budget / 4),
        })
    }

    /// Solves a plane and writes its folder.
    fn solve(
        &self,
        args: &ReconstructArgs,
        plane: Plane,
        options: Options,
        process_start: Instant,
        stop: &Arc<AtomicBool>,
    ) -> Result<(ReconstructionSummary, Video)> {
        let (site, camera) = (plane.site, plane.camera.camera);
        let measurement = correct(&plane.raw, &camera, &plane.corrections)
            .map_err(|e| naming_file(e, &args.frame, &self.calibration))?;
        let shape = camera.video_shape();
        let task = Task {
            camera,
            psfs: plane.psfs,
            measurement,
            options,
            budget: self.budget,
            truth: None,
            truth_file: None,
            direct: None,
            seed: args.seed,
            from_metadata: Default::default(),
        };
        let mut bar = Bar::new(Arc::clone(stop));
        let completed = solve(task, process_start, &mut |progress, metrics| {
            bar.show(progress, metrics)
        });
        bar.finish();
        let mut completed = completed?;
        let request = TraceRequest::read(&[], &[], shape)?;
        let mut traces = completed.traces(request, args.debias);
        completed.take_debiased(&mut traces);
        let folder = OutputFolder::create(&args.output.join(site.name()))?;
        let title = format!("Rowburst: {}, {}", args.frame.display(), site.name());
        let reproduce = command_line(args);
        let result_meta = ResultMeta {
            title: &title,
            reproduce: Some(&reproduce),
            player: player_of(folder.path()),
            movie: movie_style(args),
        };
        let summary = completed.write(&traces, &folder, result_meta)?;
        Ok((summary, completed.reconstruction.video))
    }
}

/// The plane `site` in the list of planes.
fn plane_summary(
    summary: &ReconstructionSummary,
    site: Site,
    start_us: f64,
    args: &ReconstructArgs,
) -> PlaneSummary {
    PlaneSummary {
        name: site.name(),
        folder: args.output.join(site.name()).display().to_string(),
        start_us,
        prior: summary.prior.clone(),
        tau: summary.tau,
        residual_over_sigma: summary.residual_over_sigma,
        excluded_fraction: summary.excluded_fraction,
        fit: summary.fit,
        seconds: summary.setup_seconds + summary.seconds,
    }
}

/// Colours that are not of one time.
fn offset_warning(planes: &[(Site, PlaneSummary, Video)]) -> Option<String> {
    let starts = planes.iter().map(|(_, plane, _)| plane.start_us);
    let first = starts.clone().fold(f64::INFINITY, f64::min);
    let last = starts.fold(f64::NEG_INFINITY, f64::max);
    (last > first).then(|| {
        format!(
            "the rows of the mosaic are read at different times: colours of one bin are up to {} µs apart (start_us of each plane)",
            last - first
        )
    })
}

fn print_summary(summary: &ColourSummary, args: &ReconstructArgs) {
    print_line(format_args!(
        "{} frames of {}×{} in colour at {} fps from one raw {} frame",
        summary.frames,
        summary.rows,
        summary.columns,
        thousands(summary.frame_rate_hz),
        summary.bayer
    ));
    for plane in &summary.planes {
        let left_out = if plane.excluded_fraction > 0.0 {
            format!(
                ", {:.1} % of the pixels left out",
                100.0 * plane.excluded_fraction
            )
        } else {
            String::new()
        };
        print_line(format_args!(
            "{}: prior {}, residual/σ {:.3}, the fit is {}{left_out}, {:.2} s",
            plane.name, plane.prior, plane.residual_over_sigma, plane.fit, plane.seconds
        ));
    }
    for warning in &summary.warnings {
        print_line(format_args!("warning: {warning}"));
    }
    print_line(format_args!(
        "video: {}",
        args.output.join("colour.tif").display()
    ));
}
