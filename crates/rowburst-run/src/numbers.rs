//! The numbers of a run as a reader meets them: the few big ones, and the table of all settings.

use crate::summary::{ReconstructionSummary, short};
use crate::task::Task;

/// Groups of name and value: camera, reconstruction, run.
pub(crate) fn settings(
    task: &Task,
    summary: &ReconstructionSummary,
) -> Vec<(String, Vec<(String, String)>)> {
    let camera = &task.camera;
    let sensor = camera.sensor();
    let pair = |name: &str, value: String| (name.to_string(), value);
    let mut of_camera = vec![
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
        ("bit_depth", sensor.bit_depth.map(f64::from)),
        ("bias_counts", sensor.bias_counts),
        ("gain_electrons_per_count", sensor.gain_electrons_per_count),
        ("read_noise_electrons", sensor.read_noise_electrons),
        ("full_well_counts", sensor.full_well_counts),
    ];
    for (name, value) in optional {
        if let Some(value) = value {
            of_camera.push(pair(name, value.to_string()));
        }
    }
    if let Some(from_metadata) = task.from_metadata.summary_line() {
        of_camera.push(pair("from metadata", from_metadata));
    }
    let psf = task.psfs.central().image();
    let of_solver = vec![
            pair("objective", "½‖W(b − Av)‖² + τ R(v), v ≥ 0".into()),
            pair("prior R", summary.prior.clone()),
            pair("its choice", summary.prior_choice.reason.clone()),
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
                "noise over σ, outside the optics' band",
                summary
                    .fit_statistics
                    .noise_floor
                    .map_or("not measurable".into(), |v| format!("{v:.2}")),
            ),
            pair(
                "residual/σ inside it",
                summary
                    .fit_statistics
                    .passed_level
                    .map_or("not measurable".into(), |v| format!("{v:.2}")),
            ),
            pair(
                "free values per measurement",
                format!("{:.2}", summary.fit_statistics.freedom),
            ),
            pair(
                "objective at the end",
                format!("{}; {}", short(summary.objective), summary.certificate),
            ),
            pair(
                "voxels allowed to be lit",
                format!("{:.2} %", 100.0 * summary.support_fraction),
            ),
            pair(
                "standard errors of traces",
                match (&summary.trace_errors, &summary.trace_errors.missing_because) {
                    (_, Some(why)) => format!("not known: {why}"),
                    (errors, None) => format!(
                        "light changes over {:.1} px by {:.2} of its brightness, χ² {:.2}, found in {:.2} s",
                        errors.prior_length_px.unwrap_or(f64::NAN),
                        errors.prior_amplitude.unwrap_or(f64::NAN),
                        errors.chi_squared.unwrap_or(f64::NAN),
                        errors.seconds
                    ),
                },
            ),
            pair(
                "debiased",
                summary.debias.as_ref().map_or("no".into(), |d| {
                    let psnr = d.psnr_db_before.zip(summary.psnr_db);
                    let psnr = psnr.map_or(String::new(), |(a, b)| format!(", PSNR {a:.1} to {b:.1} dB"));
                    format!(
                        "yes: light × {:.4}, bright parts × {:.4}{psnr}; residual and fit are those before",
                        d.light_ratio, d.bright_light_ratio
                    )
                }),
            ),
            pair("iterations", summary.iterations.to_string()),
            pair("stopped", summary.stop_reason.into()),
            pair(
                "PSF",
                match task.psfs.psfs().len() {
                    1 => format!("{} × {} pixels", psf.rows(), psf.columns()),
                    n => format!("{n} patches of {} × {} pixels", psf.rows(), psf.columns()),
                },
            ),
            pair(
                "bad and saturated pixels",
                format!("{} and {}", summary.bad_pixels, summary.saturated_pixels),
            ),
        ];
    let of_run = vec![
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
    ];
    vec![
        ("Camera".into(), of_camera),
        ("Reconstruction".into(), of_solver),
        ("Run".into(), of_run),
    ]
}

/// The few big numbers.
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
        (
            "Frame rate".to_string(),
            format!("{} fps", thousands(summary.frame_rate_hz)),
        ),
        ("Frames".to_string(), summary.frames.to_string()),
        (
            "Time".to_string(),
            format!("{:.2} s", summary.setup_seconds + summary.seconds),
        ),
    ]);
    lines
}

/// A whole number with a comma every three digits.
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
