//! The numbers of a run in the report: the headline, and the table of all settings.

use crate::format::{percent, short};
use crate::guide::GuideNumbers;
use crate::summary::ReconstructionSummary;
use crate::task::Task;
use crate::traces::StandardErrorNumbers;

/// The table of settings: the groups camera, reconstruction and run, each of pairs of name and value.
pub(crate) fn settings(
    task: &Task,
    summary: &ReconstructionSummary,
) -> Vec<(String, Vec<(String, String)>)> {
    vec![
        ("Camera".into(), camera_settings(task)),
        (
            "Reconstruction".into(),
            reconstruction_settings(task, summary),
        ),
        ("Run".into(), run_settings(summary)),
    ]
}

/// A setting and its value.
fn pair(name: &str, value: String) -> (String, String) {
    (name.to_string(), value)
}

/// The settings of the camera.
fn camera_settings(task: &Task) -> Vec<(String, String)> {
    let camera = &task.camera;
    let sensor = camera.sensor();
    let mut lines = vec![
        pair(
            "rows × columns",
            format!("{} × {}", camera.rows(), camera.columns()),
        ),
        pair("shutter", camera.shutter().name().into()),
        pair("row_time_us", camera.params().row_time_us.to_string()),
        pair("exposure_us", camera.params().exposure_us.to_string()),
        pair("bins_per_row", camera.params().bins_per_row.to_string()),
        pair(
            "field",
            format!("{} × {}", camera.field().0, camera.field().1),
        ),
        pair("binning", sensor.binning.to_string()),
    ];
    let optional = [
        ("pixel_pitch_um", sensor.pixel_pitch_um),
        ("magnification", sensor.magnification),
        ("trigger_delay_us", sensor.trigger_delay_us),
        ("bit_depth", sensor.bit_depth.map(f64::from)),
        ("bias_counts", sensor.bias_counts),
        ("gain_electrons_per_count", sensor.gain_electrons_per_count),
        ("read_noise_electrons", sensor.read_noise_electrons),
        ("full_well_counts", sensor.full_well_counts),
    ];
    for (name, value) in optional {
        if let Some(value) = value {
            lines.push(pair(name, value.to_string()));
        }
    }
    if let Some(from_metadata) = task.from_metadata.summary_line() {
        lines.push(pair("from metadata", from_metadata));
    }
    lines
}

/// The settings of the reconstruction, and its numbers.
fn reconstruction_settings(task: &Task, summary: &ReconstructionSummary) -> Vec<(String, String)> {
    let psf = task.psfs.central().image();
    let mut lines = vec![
        pair("objective", "½‖W(b − Av)‖² + τ R(v), v ≥ 0".into()),
        pair("prior R", summary.prior.clone()),
        pair(
            "how the prior was chosen",
            summary.prior_choice.reason.clone(),
        ),
        pair(
            "τ",
            format!("{} ({})", short(summary.tau), summary.tau_rule),
        ),
        pair(
            "σ",
            format!(
                "{} counts ({})",
                short(summary.noise_sigma),
                summary.noise_sigma_source
            ),
        ),
        pair(
            "effective σ",
            format!(
                "{} counts (noise and error of the model)",
                short(summary.effective_sigma)
            ),
        ),
    ];
    lines.extend(fit_settings(summary));
    lines.extend(summary.guide.iter().flat_map(GuideNumbers::lines));
    lines.extend([
        pair(
            "objective at the end",
            format!("{}; {}", short(summary.objective), summary.certificate),
        ),
        pair(
            "active voxels (support)",
            format!("{:.2} %", 100.0 * summary.support_fraction),
        ),
        pair(
            "standard errors of traces",
            trace_errors_text(&summary.trace_errors),
        ),
        pair("debiased", debias_text(summary)),
        pair("iterations", summary.iterations.to_string()),
        pair("stopped", summary.stop_reason.into()),
        pair(
            "PSF",
            match task.psfs.psfs().len() {
                1 => format!("{} × {} pixels", psf.rows(), psf.columns()),
                n => format!("{n} patches of {} × {} pixels", psf.rows(), psf.columns()),
            },
        ),
    ]);
    lines.extend(coverage_settings(task, summary));
    lines.extend(calibration_settings(summary));
    lines
}

/// The statistics of the fit.
fn fit_settings(summary: &ReconstructionSummary) -> Vec<(String, String)> {
    vec![
        pair("residual/σ", format!("{:.4}", summary.residual_over_sigma)),
        pair("fit", format!("{}: {}", summary.fit, summary.fit_reason)),
        pair(
            "χ² per degree of freedom",
            format!(
                "{} ± {}",
                short(summary.fit_statistics.chi_squared),
                short(summary.fit_statistics.chi_squared_error)
            ),
        ),
        pair(
            "noise/σ outside the passband of the optics",
            summary
                .fit_statistics
                .noise_floor
                .map_or("not measurable".into(), |v| format!("{v:.2}")),
        ),
        pair(
            "residual/σ inside the passband",
            summary
                .fit_statistics
                .passed_level
                .map_or("not measurable".into(), |v| format!("{v:.2}")),
        ),
        pair(
            "degrees of freedom per measurement",
            format!("{:.2}", summary.fit_statistics.freedom),
        ),
    ]
}

/// The pixels that were left out, and the voxels that the frame observes.
fn coverage_settings(task: &Task, summary: &ReconstructionSummary) -> Vec<(String, String)> {
    let pixels = task.measurement.image().data().len() as f64;
    let fraction = summary.excluded_fraction;
    let is_searched = !task.options.keep_all_pixels && task.budget.is_none();
    let foreign = if is_searched {
        format!("{:.0} ({})", fraction * pixels, percent(fraction))
    } else {
        "not looked for".into()
    };
    let mut lines = vec![
        pair(
            "bad and saturated pixels",
            format!("{} and {}", summary.bad_pixels, summary.saturated_pixels),
        ),
        pair("foreign pixels left out", foreign),
        pair(
            "voxels that the frame observes",
            percent(summary.coverage_fraction),
        ),
    ];
    if summary.stray_light_fraction > 0.0 {
        let part = format!("{} of the light", percent(summary.stray_light_fraction));
        lines.push(pair("smooth stray light taken away", part));
    }
    lines
}

/// What the frame has corrected of its PSF and camera.
fn calibration_settings(summary: &ReconstructionSummary) -> Vec<(String, String)> {
    let Some(found) = &summary.self_calibration else {
        return vec![pair("self-calibration", "nothing was corrected".into())];
    };
    let mut lines = vec![pair("self-calibration", found.evidence())];
    let parameters = found.lines().into_iter();
    lines.extend(parameters.map(|(name, value)| (format!("  {name}"), value)));
    lines
}

/// How the standard errors of the traces were computed.
fn trace_errors_text(errors: &StandardErrorNumbers) -> String {
    match &errors.missing_because {
        Some(why) => format!("not known: {why}"),
        None => format!(
            "Gaussian prior: correlation length {:.1} px, relative amplitude {:.2}, χ² {:.2}; {:.2} s",
            errors.prior_length_px.unwrap_or(f64::NAN),
            errors.prior_amplitude.unwrap_or(f64::NAN),
            errors.chi_squared.unwrap_or(f64::NAN),
            errors.seconds
        ),
    }
}

/// What debiasing changed.
fn debias_text(summary: &ReconstructionSummary) -> String {
    summary.debias.as_ref().map_or("no".into(), |d| {
        let psnr = d.psnr_db_before.zip(summary.psnr_db);
        let psnr = psnr.map_or(String::new(), |(a, b)| format!(", PSNR {a:.1} to {b:.1} dB"));
        format!(
            "yes: total light × {:.4}, bright voxels × {:.4}{psnr}; residual and fit are those before debiasing",
            d.light_ratio, d.bright_light_ratio
        )
    })
}

/// The program, its time, memory and warnings.
fn run_settings(summary: &ReconstructionSummary) -> Vec<(String, String)> {
    vec![
        pair("rowburst", summary.version.into()),
        pair("threads", summary.threads.to_string()),
        pair(
            "set-up and solving",
            format!(
                "{:.2} s and {:.2} s",
                summary.setup_seconds, summary.seconds
            ),
        ),
        pair(
            "peak memory",
            summary
                .peak_memory_bytes
                .map_or("unknown".into(), |b| format!("{} MB", b / 1_000_000)),
        ),
        pair(
            "warnings",
            if summary.warnings.is_empty() {
                "none".into()
            } else {
                summary.warnings.join("; ")
            },
        ),
    ]
}

/// The main numbers, as pairs of name and value.
pub(crate) fn headline(summary: &ReconstructionSummary) -> Vec<(String, String)> {
    let mut lines = Vec::new();
    if let Some(psnr) = summary.psnr_db {
        lines.push(("PSNR".to_string(), format!("{psnr:.1} dB")));
    }
    if let Some(ssim) = summary.ssim {
        lines.push(("SSIM".to_string(), format!("{ssim:.4}")));
    }
    lines.extend([
        ("Fit".to_string(), summary.fit.to_string()),
        (
            "Residual/σ".to_string(),
            format!("{:.2}", summary.residual_over_sigma),
        ),
    ]);
    if summary.excluded_fraction > 0.0 {
        let left_out = format!("{} of pixels", percent(summary.excluded_fraction));
        lines.push(("Left out".to_string(), left_out));
    }
    lines.extend([
        (
            "Frame rate".to_string(),
            format!("{} fps", thousands(summary.frame_rate_hz)),
        ),
        ("Frames".to_string(), summary.frames.to_string()),
        (
            "Computed in".to_string(),
            format!("{:.2} s", summary.setup_seconds + summary.seconds),
        ),
    ]);
    lines
}

/// `value` rounded to a whole number, with a comma every three digits.
pub fn thousands(value: f64) -> String {
    let digits = format!("{value:.0}");
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}
