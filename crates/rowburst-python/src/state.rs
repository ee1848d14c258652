//! What is stored of a completed reconstruction when it is pickled, and back.
//!
//! Everything that `numbers`, `traces`, `report` and `save` need is kept, bit for bit; a noise model is not,
//! since only a new reconstruction needs it.

use crate::array::{finite_image, from_image, from_video, video};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::options::{prior_from, self_calibration_from, tau_from, tuning_from};
use crate::pickle::{entry, optional_entry};
use crate::psf::PyPsf;
use numpy::{PyArray1, PyArray3, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rowburst::measurement::Measurement;
use rowburst::reconstruct::{
    Calibration, Candidate, Choice, Fit, FitStatistics, FoundParameter, HeldOutErrors,
    ModelParameter, Options, Prior, Reconstruction, SigmaSource, Tau, TrimmedChiSquared, Verdict,
};
use rowburst::solve::{Certificate, StopReason};
use rowburst::{Cancel, Image, Video};
use rowburst_io::FromMetadata;
use rowburst_report::Iteration;
use rowburst_run::{CompletedTask, DebiasNumbers, GuideOutcome, Task};
use std::time::Duration;

/// The state of `completed`, with `video` as its video.
pub fn of_completed<'py>(
    py: Python<'py>,
    completed: &CompletedTask,
    video: Bound<'py, PyArray3<f32>>,
) -> PyResult<Bound<'py, PyDict>> {
    let (task, found) = (&completed.task, &completed.reconstruction);
    let state = of_task(py, task)?;
    let array = |video: &Video| from_video(py, video.clone());
    let floats = |values: &Vec<f32>| PyArray1::from_slice(py, values);
    state.set_item("video", video)?;
    state.set_item(
        "background",
        found.background.as_ref().map(array).transpose()?,
    )?;
    state.set_item(
        "residual",
        from_image(py, found.normalised_residual.clone())?,
    )?;
    state.set_item("residual_over_sigma", found.residual_over_sigma)?;
    state.set_item("prior", found.prior.to_string())?;
    let candidate = |c: &Candidate| {
        (
            c.prior.to_string(),
            c.tau_factor,
            c.error,
            c.support_fraction,
            c.stopped_early,
            c.gain,
        )
    };
    let choice = found.choice.as_ref().map(|choice| {
        let candidates: Vec<_> = choice.candidates.iter().map(candidate).collect();
        (candidates, choice.held_out)
    });
    state.set_item("choice", choice)?;
    state.set_item("tau", found.tau)?;
    state.set_item(
        "certificate",
        (found.certificate.primal, found.certificate.dual),
    )?;
    state.set_item("debias", completed.debias.as_ref().map(of_debias))?;
    state.set_item("weights", found.weights.as_ref().map(floats))?;
    state.set_item("sigma", found.sigma)?;
    state.set_item("effective_sigma", found.effective_sigma)?;
    state.set_item("foreign", PyArray1::from_slice(py, &found.excluded))?;
    state.set_item("coverage", PyArray1::from_slice(py, &found.coverage))?;
    let stray_light = found.stray_light.clone();
    let stray_light = stray_light.map(|image| from_image(py, image)).transpose()?;
    state.set_item("stray_light", stray_light)?;
    state.set_item("sigma_source", found.sigma_source.name())?;
    state.set_item("iterations", found.iterations)?;
    state.set_item("stop_reason", found.stop_reason.name())?;
    state.set_item("support_fraction", found.support_fraction)?;
    state.set_item("fit", (found.fit.verdict.name(), &found.fit.reason))?;
    state.set_item("statistics", of_statistics(py, &found.fit.statistics)?)?;
    of_guide(py, &state, completed.guide.as_ref())?;
    let given = completed.given_psfs.clone().map(|psfs| PyPsf { psfs });
    state.set_item("given_psf", given)?;
    state.set_item(
        "calibration",
        found.calibration.as_ref().map(|calibration| {
            let parameter = |p: &FoundParameter| (p.parameter.name(), p.value, p.standard_error);
            let parameters: Vec<_> = calibration.parameters.iter().map(parameter).collect();
            (
                parameters,
                calibration.row_offsets.clone(),
                calibration.psf_refinement,
                calibration
                    .held_out
                    .map(|errors| (errors.before, errors.after)),
            )
        }),
    )?;
    let pixels = |of: fn(&Calibration) -> &Vec<f32>| found.calibration.as_ref().map(of).map(floats);
    state.set_item("pixel_gain", pixels(|c| &c.gain))?;
    state.set_item("pixel_offset", pixels(|c| &c.offset))?;
    let before = found.calibration.as_ref();
    let before = before.and_then(|calibration| calibration.residual_before.clone());
    let before = before.map(|image| from_image(py, image)).transpose()?;
    state.set_item("residual_before", before)?;
    state.set_item(
        "seconds",
        (
            completed.setup_seconds,
            completed.seconds,
            completed.start_offset_s,
        ),
    )?;
    let point = |i: &Iteration| {
        (
            i.iteration,
            i.seconds,
            i.objective,
            i.residual_over_sigma,
            i.change,
            i.psnr_db,
        )
    };
    state.set_item(
        "convergence",
        completed.convergence.iter().map(point).collect::<Vec<_>>(),
    )?;
    Ok(state)
}

/// The numbers of a refit: light ratio, that of the bright voxels, bins left as they were, PSNR and SSIM before it.
type Debias = (f64, f64, usize, Option<f64>, Option<f64>);

fn of_debias(numbers: &DebiasNumbers) -> Debias {
    (
        numbers.light_ratio,
        numbers.bright_light_ratio,
        numbers.untouched_bins,
        numbers.psnr_db_before,
        numbers.ssim_before,
    )
}

fn to_debias(stored: Debias) -> DebiasNumbers {
    let (light_ratio, bright_light_ratio, untouched_bins, psnr_db_before, ssim_before) = stored;
    DebiasNumbers {
        light_ratio,
        bright_light_ratio,
        untouched_bins,
        psnr_db_before,
        ssim_before,
    }
}

fn of_task<'py>(py: Python<'py>, task: &Task) -> PyResult<Bound<'py, PyDict>> {
    let state = PyDict::new(py);
    state.set_item("camera", PyCamera::from(task.camera.clone()))?;
    let psfs = task.psfs.clone();
    state.set_item("psf", PyPsf { psfs })?;
    let measurement = &task.measurement;
    state.set_item("measured", from_image(py, measurement.image().clone())?)?;
    let weights = measurement.weights();
    state.set_item(
        "measured_weights",
        weights.map(|w| PyArray1::from_slice(py, w)),
    )?;
    state.set_item("excluded", (measurement.bad(), measurement.saturated()))?;
    let options = &task.options;
    state.set_item(
        "requested_prior",
        options.prior.map(|prior| prior.to_string()),
    )?;
    match options.tau {
        Tau::Auto => state.set_item("requested_tau", "auto")?,
        Tau::HeldOut => state.set_item("requested_tau", "held-out")?,
        Tau::Given(tau) => state.set_item("requested_tau", tau)?,
    }
    state.set_item("requested_sigma", options.noise_sigma)?;
    state.set_item("max_iterations", options.max_iterations)?;
    state.set_item("self_calibrate", options.self_calibration.to_string())?;
    state.set_item("keep_all_pixels", options.keep_all_pixels)?;
    state.set_item("tuning", options.tuning.changes())?;
    state.set_item("budget_s", task.budget.map(|b| b.as_secs_f64()))?;
    let truth = task.truth.clone().map(|truth| from_video(py, truth));
    state.set_item("truth", truth.transpose()?)?;
    let direct = task.direct.clone().map(|direct| from_image(py, direct));
    state.set_item("direct", direct.transpose()?)?;
    state.set_item("seed", task.seed)?;
    let metadata = &task.from_metadata;
    state.set_item(
        "metadata",
        (&metadata.sources, &metadata.values, &metadata.warnings),
    )?;
    Ok(state)
}

fn of_statistics<'py>(py: Python<'py>, s: &FitStatistics) -> PyResult<Bound<'py, PyDict>> {
    let state = PyDict::new(py);
    state.set_item("chi_squared", s.chi_squared)?;
    state.set_item("chi_squared_error", s.chi_squared_error)?;
    state.set_item("residual_over_frame", s.residual_over_frame)?;
    state.set_item("freedom", s.freedom)?;
    state.set_item("noise_floor", s.noise_floor)?;
    state.set_item("noise_floor_error", s.noise_floor_error)?;
    state.set_item("noise_band_is_dark", s.noise_band_is_dark)?;
    state.set_item("passed_level", s.passed_level)?;
    state.set_item("correlation_x", s.correlation_x)?;
    state.set_item("correlation_y", s.correlation_y)?;
    state.set_item("correlation_with_model", s.correlation_with_model)?;
    state.set_item("misfit_instants", s.misfit_instants)?;
    state.set_item("worst_instant", s.worst_instant)?;
    state.set_item("misfit_columns", s.misfit_columns)?;
    state.set_item("worst_column", s.worst_column)?;
    let without = &s.chi_squared_without;
    state.set_item(
        "chi_squared_without",
        (without.instants, without.columns, without.pixels),
    )?;
    state.set_item("lone_pixels", s.lone_pixels)?;
    state.set_item("residual_trend", s.residual_trend)?;
    state.set_item("mirrored", s.mirrored)?;
    state.set_item("fine_ratio", s.fine_ratio)?;
    state.set_item("tests_timing", s.tests_timing)?;
    Ok(state)
}

/// The completed reconstruction of a state.
///
/// # Errors
/// A state of another version.
pub fn to_completed(state: &Bound<'_, PyDict>) -> PyResult<CompletedTask> {
    let (setup_seconds, seconds, start_offset_s) = entry(state, "seconds")?.extract()?;
    type Point = (usize, f64, f64, f64, f64, Option<f64>);
    let convergence: Vec<Point> = entry(state, "convergence")?.extract()?;
    let point = |(iteration, seconds, objective, residual_over_sigma, change, psnr_db)| Iteration {
        iteration,
        seconds,
        objective,
        residual_over_sigma,
        change,
        psnr_db,
    };
    let mut task = to_task(state)?;
    let reconstruction = to_reconstruction(state, &task)?;
    if let Some(calibration) = &reconstruction.calibration {
        task.camera = calibration.corrected_camera(&task.camera);
    }
    let given = optional_entry(state, "given_psf")?;
    let given = given.map(|psf| -> PyResult<_> { Ok(psf.cast::<PyPsf>()?.get().psfs.clone()) });
    Ok(CompletedTask {
        reconstruction,
        guide: to_guide(state)?,
        task,
        given_psfs: given.transpose()?,
        debias: entry(state, "debias")?
            .extract::<Option<Debias>>()?
            .map(to_debias),
        setup_seconds,
        seconds,
        start_offset_s,
        convergence: convergence.into_iter().map(point).collect(),
    })
}

fn of_guide(
    py: Python<'_>,
    state: &Bound<'_, PyDict>,
    guide: Option<&GuideOutcome>,
) -> PyResult<()> {
    let numbers =
        |g: &GuideOutcome| serde_json::to_string(&g.numbers).expect("plain numbers and text");
    state.set_item("guide", guide.map(numbers))?;
    let picture = guide.map(|g| from_image(py, g.registered.clone()));
    state.set_item("guide_picture", picture.transpose()?)?;
    state.set_item("guide_places", guide.map(|g| g.labels.clone()))
}

fn to_guide(state: &Bound<'_, PyDict>) -> PyResult<Option<GuideOutcome>> {
    let numbers: Option<String> = entry(state, "guide")?.extract()?;
    let numbers = numbers.map(|text| {
        let numbers = serde_json::from_str(&text);
        numbers.map_err(|error| PyValueError::new_err(format!("state: guide: {error}")))
    });
    let picture = optional_entry(state, "guide_picture")?;
    let picture = picture.map(|value| finite_image(&value, "guide_picture"));
    let labels: Option<Vec<i64>> = entry(state, "guide_places")?.extract()?;
    let parts = numbers.transpose()?.zip(picture.transpose()?);
    Ok(parts.map(|(numbers, registered)| GuideOutcome {
        numbers,
        registered,
        labels: labels.unwrap_or_default(),
    }))
}

fn to_task(state: &Bound<'_, PyDict>) -> PyResult<Task> {
    let image = |name: &str| -> PyResult<Image> { finite_image(&entry(state, name)?, name) };
    let (bad, saturated) = entry(state, "excluded")?.extract()?;
    let weights = to_weights(state, "measured_weights")?;
    let measurement = Measurement::from_stored(image("measured")?, weights, bad, saturated);
    let requested_prior: Option<String> = entry(state, "requested_prior")?.extract()?;
    let budget: Option<f64> = entry(state, "budget_s")?.extract()?;
    let truth = optional_entry(state, "truth")?;
    let direct = optional_entry(state, "direct")?;
    let (sources, values, warnings) = entry(state, "metadata")?.extract()?;
    let camera: PyCamera = entry(state, "camera")?.extract()?;
    Ok(Task {
        camera: camera.camera,
        psfs: entry(state, "psf")?.cast::<PyPsf>()?.get().psfs.clone(),
        measurement: measurement.map_err(to_py_err)?,
        options: Options {
            prior: requested_prior.map(|name| to_prior(&name)).transpose()?,
            tau: tau_from(Some(&entry(state, "requested_tau")?))?,
            noise_sigma: entry(state, "requested_sigma")?.extract()?,
            max_iterations: entry(state, "max_iterations")?.extract()?,
            self_calibration: self_calibration_from(
                &entry(state, "self_calibrate")?.extract::<String>()?,
            )?,
            keep_all_pixels: entry(state, "keep_all_pixels")?.extract()?,
            tuning: tuning_from(&entry(state, "tuning")?.extract::<Vec<(String, f64)>>()?)?,
            ..Options::default()
        },
        budget: budget.map(Duration::from_secs_f64),
        truth: truth.map(|truth| video(&truth, "truth")).transpose()?,
        truth_file: None,
        direct: direct
            .map(|value| finite_image(&value, "direct"))
            .transpose()?,
        guide: None,
        seed: entry(state, "seed")?.extract()?,
        from_metadata: FromMetadata {
            sources,
            values,
            warnings,
        },
        cancel: Cancel::default(),
    })
}

fn to_reconstruction(state: &Bound<'_, PyDict>, task: &Task) -> PyResult<Reconstruction> {
    let number = |name: &str| -> PyResult<f64> { entry(state, name)?.extract() };
    let text = |name: &str| -> PyResult<String> { entry(state, name)?.extract() };
    let background = optional_entry(state, "background")?;
    let (primal, dual) = entry(state, "certificate")?.extract()?;
    let (verdict, reason): (String, String) = entry(state, "fit")?.extract()?;
    let verdicts = [Verdict::Good, Verdict::Suspicious, Verdict::Bad];
    let reasons = [
        StopReason::Converged,
        StopReason::IterationLimit,
        StopReason::TimeBudget,
        StopReason::Interrupted,
    ];
    let sources = [
        SigmaSource::Given,
        SigmaSource::Calibration,
        SigmaSource::Frame,
        SigmaSource::HeldOut,
    ];
    Ok(Reconstruction {
        video: video(&entry(state, "video")?, "video")?,
        background: background
            .map(|value| video(&value, "background"))
            .transpose()?,
        normalised_residual: finite_image(&entry(state, "residual")?, "residual")?,
        residual_over_sigma: number("residual_over_sigma")?,
        prior: to_prior(&text("prior")?)?,
        choice: to_choice(&entry(state, "choice")?)?,
        tau: number("tau")?,
        certificate: Certificate { primal, dual },
        weights: to_weights(state, "weights")?,
        sigma: number("sigma")?,
        effective_sigma: number("effective_sigma")?,
        excluded: to_mask(state, "foreign")?,
        coverage: to_mask(state, "coverage")?,
        sigma_source: named(&sources, SigmaSource::name, &text("sigma_source")?)?,
        calibration: to_calibration(state, task)?,
        stray_light: optional_entry(state, "stray_light")?
            .map(|value| finite_image(&value, "stray_light"))
            .transpose()?,
        iterations: entry(state, "iterations")?.extract()?,
        stop_reason: named(&reasons, StopReason::name, &text("stop_reason")?)?,
        support_fraction: number("support_fraction")?,
        fit: Fit {
            verdict: named(&verdicts, Verdict::name, &verdict)?,
            reason,
            statistics: to_statistics(entry(state, "statistics")?.cast::<PyDict>()?)?,
        },
    })
}

/// The correction of PSF and camera, which `task` has been given.
fn to_calibration(state: &Bound<'_, PyDict>, task: &Task) -> PyResult<Option<Calibration>> {
    type Stored = (
        Vec<(String, f64, f64)>,
        Vec<f64>,
        Option<f64>,
        Option<(f64, f64)>,
    );
    let Some((parameters, row_offsets, psf_refinement, held_out)) =
        entry(state, "calibration")?.extract::<Option<Stored>>()?
    else {
        return Ok(None);
    };
    let parameters = parameters.into_iter().map(|(name, value, standard_error)| {
        Ok(FoundParameter {
            parameter: named(&ModelParameter::ALL, ModelParameter::name, &name)?,
            value,
            standard_error,
        })
    });
    Ok(Some(Calibration {
        parameters: parameters.collect::<PyResult<_>>()?,
        row_offsets,
        psf_refinement,
        psfs: task.psfs.clone(),
        gain: to_weights(state, "pixel_gain")?.unwrap_or_default(),
        offset: to_weights(state, "pixel_offset")?.unwrap_or_default(),
        held_out: held_out.map(|(before, after)| HeldOutErrors { before, after }),
        residual_before: optional_entry(state, "residual_before")?
            .map(|value| finite_image(&value, "residual_before"))
            .transpose()?,
    }))
}

fn to_choice(value: &Bound<'_, PyAny>) -> PyResult<Option<Choice>> {
    type Stored = (Vec<(String, f64, f64, f64, bool, Option<f64>)>, usize);
    let Some((candidates, held_out)) = value.extract::<Option<Stored>>()? else {
        return Ok(None);
    };
    let candidates = candidates.into_iter().map(
        |(prior, tau_factor, error, support_fraction, stopped_early, gain)| {
            Ok(Candidate {
                prior: to_prior(&prior)?,
                tau_factor,
                error,
                support_fraction,
                stopped_early,
                gain,
            })
        },
    );
    Ok(Some(Choice {
        candidates: candidates.collect::<PyResult<_>>()?,
        held_out,
    }))
}

fn to_statistics(state: &Bound<'_, PyDict>) -> PyResult<FitStatistics> {
    let number = |name: &str| -> PyResult<f64> { entry(state, name)?.extract() };
    let optional = |name: &str| -> PyResult<Option<f64>> { entry(state, name)?.extract() };
    let (instants, columns, pixels) = entry(state, "chi_squared_without")?.extract()?;
    Ok(FitStatistics {
        chi_squared: number("chi_squared")?,
        chi_squared_error: number("chi_squared_error")?,
        residual_over_frame: number("residual_over_frame")?,
        freedom: number("freedom")?,
        noise_floor: optional("noise_floor")?,
        noise_floor_error: number("noise_floor_error")?,
        noise_band_is_dark: entry(state, "noise_band_is_dark")?.extract()?,
        passed_level: optional("passed_level")?,
        correlation_x: number("correlation_x")?,
        correlation_y: number("correlation_y")?,
        correlation_with_model: number("correlation_with_model")?,
        misfit_instants: entry(state, "misfit_instants")?.extract()?,
        worst_instant: entry(state, "worst_instant")?.extract()?,
        misfit_columns: entry(state, "misfit_columns")?.extract()?,
        worst_column: entry(state, "worst_column")?.extract()?,
        chi_squared_without: TrimmedChiSquared {
            instants,
            columns,
            pixels,
        },
        lone_pixels: entry(state, "lone_pixels")?.extract()?,
        residual_trend: number("residual_trend")?,
        mirrored: optional("mirrored")?,
        fine_ratio: optional("fine_ratio")?,
        tests_timing: entry(state, "tests_timing")?.extract()?,
    })
}

fn to_weights(state: &Bound<'_, PyDict>, name: &str) -> PyResult<Option<Vec<f32>>> {
    let weights = optional_entry(state, name)?;
    let values = |value: Bound<'_, PyAny>| -> PyResult<Vec<f32>> {
        // What Dask has unpacked is not aligned; a copy is.
        let aligned = value.call_method0("copy")?;
        Ok(aligned
            .cast::<PyArray1<f32>>()?
            .readonly()
            .as_slice()?
            .to_vec())
    };
    weights.map(values).transpose()
}

fn to_mask(state: &Bound<'_, PyDict>, name: &str) -> PyResult<Vec<u8>> {
    let value = entry(state, name)?;
    Ok(value
        .cast::<PyArray1<u8>>()?
        .readonly()
        .as_slice()?
        .to_vec())
}

fn to_prior(name: &str) -> PyResult<Prior> {
    prior_from(name)?.ok_or_else(|| PyValueError::new_err(format!("state: found the prior {name}")))
}

/// The one of `all` with this name.
fn named<T: Copy>(all: &[T], name_of: fn(T) -> &'static str, name: &str) -> PyResult<T> {
    let found = all.iter().find(|value| name_of(**value) == name);
    found.copied().ok_or_else(|| {
        PyValueError::new_err(format!(
            "state: found {name}; it was pickled by another version of rowburst. Pickle it again with this one."
        ))
    })
}
