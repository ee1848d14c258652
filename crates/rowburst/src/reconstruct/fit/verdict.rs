//! From the numbers to a verdict and a sentence.
//!
//! The thresholds were set on fits with the right model, `campaign` in `crates/rowburst/tests/fit.rs`
//! (docs/design/015).

use super::{FitInput, FitStatistics, SigmaSource, StopReason, Verdict};
use rowburst_optics::Shutter;

/// `χ²` from which a fit is suspicious; smaller doubts good fits (docs/design/015).
const SUSPICIOUS: f64 = 1.25;
/// Standard deviations by which the limits of `χ²` and of the noise floor are widened; smaller doubts good fits.
const DEVIATIONS: f64 = 4.0;
/// `χ²` above which a misfit is bad and not only suspicious.
const BAD: f64 = 4.0;
/// `χ²` below which noise has been fitted: `df` takes at most 0.3 off.
const OVERFITTED: f64 = 0.5;
/// Factor by which `σ` may be wrong before the fit is suspicious, and bad.
const SIGMA_RATIO_SUSPICIOUS: f64 = 1.5;
const SIGMA_RATIO_BAD: f64 = 5.0;
/// `r` in the passed band over that in the noise band.
const STRUCTURE: f64 = 1.25;
/// Part of the instants, columns and pixels that counts as a few.
const FEW_INSTANTS: f64 = 0.25;
const FEW_COLUMNS: f64 = 0.1;
const FEW_PIXELS: f64 = 0.02;
/// Values chosen freely for each measurement: a wrong model would be followed as well.
const MAX_TESTABLE_FREEDOM: f64 = 0.8;
/// Likeness of mirrored bins above that of others; smaller calls good fits suspicious (docs/design/015).
const MIRRORED: f64 = 0.08;
/// Part of the voxels in the support that is suspicious; larger misses offsets (docs/design/015).
const DENSE_SUPPORT: f64 = 0.11;
/// Iterations before which no video has taken shape: the solver looks for the support from
/// the 20th on, and follows the brightness for 40.
const MIN_ITERATIONS: usize = 60;
/// Iterations from which a run that has not converged was not stopped too early: the model is wrong.
const FULL_RUN: usize = 250;
/// Residual over that at four fifths of the iterations, where it still falls.
const FALLING_RATIO: f64 = 0.85;
/// Residual over the frame itself beyond which more iterations are not what is missing.
const FAR_FROM_FRAME: f64 = 0.3;
/// Power of the light in the frame over that of the noise, below which it is little but noise.
const MIN_LIGHT_OVER_NOISE: f64 = 0.1;
/// Residual over the frame itself from which a misfit is bad, although the reconstruction allows for it.
const LARGE_MISFIT: f64 = 0.1;
/// Part of the pixels that were left out as foreign from which the verdict says so.
const MANY_EXCLUDED: f64 = 0.005;
/// Detail across the rows over that along them, below which a frame is turned; larger takes dead columns for it.
pub(super) const TURNED: f64 = 1.0 / 8.0;
/// Multiples of σ below zero that noise does not reach, and the part of the pixels that may lie there.
const BELOW_ZERO: f64 = 5.0;
const MANY_BELOW_ZERO: f64 = 0.05;
/// Light of an isolated bright pixel in σ, and how many times that of each neighbour it is.
const LONE_LIGHT: f64 = 30.0;
const LONE_RATIO: f64 = 3.0;
/// Level at the highest frequencies over that of the passed band, from which a frame is white.
const WHITE_LEVEL: f64 = 0.5;
/// Residual over the frame itself at which the solver has gone astray, of which a dark video leaves 1.
const DIVERGED: f64 = 1.5;

pub(super) fn of(evidence: &FitInput, s: &FitStatistics) -> (Verdict, String) {
    let (verdict, mut reason) = of_kept_pixels(evidence, s);
    if evidence.excluded_fraction >= MANY_EXCLUDED {
        reason += &format!(
            "; {} % of the pixels belong to no video (a caption? hot pixels? see the report) and were left out",
            digits(100.0 * evidence.excluded_fraction)
        );
    }
    (verdict, reason)
}

/// The verdict on the pixels that were not left out as foreign.
fn of_kept_pixels(evidence: &FitInput, s: &FitStatistics) -> (Verdict, String) {
    if let Some(found) = untestable(evidence, s) {
        return found;
    }
    if let Some(ratio) = s.fine_ratio.filter(|ratio| *ratio < TURNED) {
        return (
            Verdict::Bad,
            format!(
                "the frame has {} times more of the finest detail along its rows than across them, where a shutter that reads row by row leaves it: the frame is turned by 90° or transposed (rows are to be those that the shutter reads)",
                digits(1.0 / ratio)
            ),
        );
    }
    if let Some(shutter) = evidence.other_shutter {
        return (Verdict::Bad, of_shutter(shutter, evidence.camera.shutter()));
    }
    if !is_model_wrong(evidence, s)
        && let Some(found) = noise_level(evidence, s)
    {
        return found;
    }
    let suspicious = |reason: String| (Verdict::Suspicious, reason);
    if let Some(mirrored) = s.mirrored.filter(|m| *m > MIRRORED) {
        return suspicious(format!(
            "the video is nearly symmetric in time (the correlation of mirrored bins exceeds that of others by {mirrored:.2}): the shutter is probably dual, reading two rows in an instant"
        ));
    }
    let limit = SUSPICIOUS + DEVIATIONS * s.chi_squared_error;
    if s.chi_squared > limit {
        return misfit(evidence, s, limit);
    }
    let light = light_over_noise(evidence);
    if light < MIN_LIGHT_OVER_NOISE {
        return suspicious(format!(
            "the frame is mostly noise: the signal power is {:.0} % of the noise power; use more light, a longer exposure or a sparser scene",
            100.0 * light.max(0.0)
        ));
    }
    if let Some(error) = evidence.undersampled_error {
        return suspicious(format!(
            "the frame sees too little of the scene to test PSF and camera: a video that fits the other pixels misses held-out ones by {} times the noise, whether they are right or not; use a sparser scene, or a shutter that reads more rows in an instant",
            digits(error)
        ));
    }
    if s.chi_squared < OVERFITTED {
        return suspicious(format!(
            "the residual is only {:.2} times the noise: the video is overfitted{}",
            s.chi_squared.sqrt(),
            if evidence.tau_is_given {
                "; give a larger τ, or leave it out"
            } else {
                ""
            }
        ));
    }
    if let Some(excess) = structure(s) {
        return suspicious(format!(
            "the residual has {excess:.2} times the noise at the frequencies that the optics pass: {}",
            possible_causes(evidence, s)
        ));
    }
    if s.freedom > MAX_TESTABLE_FREEDOM {
        return suspicious(format!(
            "the video has {:.1} degrees of freedom per measurement: a wrong PSF or shutter would fit as well, so the residual cannot test the model; use a sparser scene, or a shutter that reads more rows in an instant",
            s.freedom
        ));
    }
    if evidence.support_fraction < 1.0 && evidence.support_fraction > DENSE_SUPPORT {
        return suspicious(format!(
            "{:.0} % of all voxels are active: the scene is not sparse, or an offset was not subtracted from the frame (dark frame, bias)",
            100.0 * evidence.support_fraction
        ));
    }
    let mut reason = String::from(
        "the residual is white noise at the expected level: PSF, camera and noise level explain the frame",
    );
    if !s.tests_timing {
        reason +=
            "; the order and times of the rows are not tested, since no two rows see the same bin";
    }
    (Verdict::Good, reason)
}

/// The sentence on a frame that `other` explains and the shutter that is given does not.
fn of_shutter(other: &Shutter, given: &Shutter) -> String {
    let reversed = match other {
        Shutter::DualInsideOut => "dual-outside-in",
        _ => "bottom-up",
    };
    format!(
        "the shutter \"{}\" (or \"{reversed}\", which reverses time) explains the frame, and \"{}\" does not: give the one that has read it",
        other.name(),
        given.name()
    )
}

/// The verdict where the residual cannot test noise level and model.
fn untestable(evidence: &FitInput, s: &FitStatistics) -> Option<(Verdict, String)> {
    if let Some(below) = below_zero(evidence) {
        return Some((
            Verdict::Bad,
            format!(
                "{:.0} % of the pixels lie more than {BELOW_ZERO:.0} σ below zero after the subtraction of dark or bias: the dark or the bias does not belong to this frame",
                100.0 * below
            ),
        ));
    }
    if evidence.video.max() <= 0.0 {
        return Some((
            Verdict::Bad,
            "the video is zero everywhere: the frame is consistent with noise of this level alone"
                .into(),
        ));
    }
    if s.residual_over_frame > DIVERGED && evidence.residual_history.len() >= MIN_ITERATIONS {
        return Some((
            Verdict::Bad,
            format!(
                "the residual is {} times the frame: the solver diverged. Likely causes: dead, hot or saturated pixels that are not marked, a σ that is too small, or a wrong PSF or shutter",
                digits(s.residual_over_frame)
            ),
        ));
    }
    if let Some(reason) = ended_early(evidence, s) {
        return Some((Verdict::Suspicious, reason));
    }
    frame_without_optics(evidence, s).map(|reason| (Verdict::Bad, reason))
}

/// `⟨(W b/σ)²⟩ − 1` over the pixels that hold information.
fn light_over_noise(evidence: &FitInput) -> f64 {
    let informative = |i: &usize| evidence.weights.is_none_or(|w| w[*i] > 0.0);
    let (mut power, mut count) = (0.0, 0usize);
    for i in (0..evidence.measured.len()).filter(informative) {
        power += f64::from(evidence.measured[i]).powi(2);
        count += 1;
    }
    power / count.max(1) as f64 - 1.0
}

/// Part of the pixels that dark or bias leave far below zero, where these are too many for noise.
fn below_zero(evidence: &FitInput) -> Option<f64> {
    let values = evidence.measured.iter();
    let below = values.filter(|b| f64::from(**b) < -BELOW_ZERO).count();
    let part = below as f64 / evidence.measured.len().max(1) as f64;
    (part > MANY_BELOW_ZERO).then_some(part)
}

/// The sentence on a run that was ended before the video explained the frame: nothing else can be told of it.
fn ended_early(evidence: &FitInput, s: &FitStatistics) -> Option<String> {
    let end = match evidence.stop_reason {
        StopReason::Interrupted => "the run was interrupted",
        StopReason::TimeBudget => "the time budget ended",
        _ => return None,
    };
    let limit = SUSPICIOUS + DEVIATIONS * s.chi_squared_error;
    (s.chi_squared > limit).then(|| {
        format!(
            "stopped early: {end} after {} iterations, and the residual is still {} times the noise; let it run to its end before judging the fit",
            evidence.residual_history.len(),
            digits(s.chi_squared.sqrt())
        )
    })
}

/// Whether the model is wrong rather than σ. The residual is then larger where the optics pass light than where they do
/// not, and σ is the noise that the frame has at the highest frequencies, whatever the PSF.
fn is_model_wrong(evidence: &FitInput, s: &FitStatistics) -> bool {
    let limit = SUSPICIOUS + DEVIATIONS * s.chi_squared_error;
    let frame_noise = evidence
        .bands
        .fine_rms(|at| f64::from(evidence.measured[at]));
    let allowed = SIGMA_RATIO_SUSPICIOUS * (1.0 + DEVIATIONS * s.noise_floor_error);
    let is_sigma_right = frame_noise.is_none_or(|noise| noise < allowed);
    s.chi_squared > limit && structure(s).is_some() && is_sigma_right
}

/// The sentence on a frame that no optics have made: pixels that stand alone, or that all differ from their neighbours.
fn frame_without_optics(evidence: &FitInput, s: &FitStatistics) -> Option<String> {
    let limit = SUSPICIOUS + DEVIATIONS * s.chi_squared_error;
    if s.chi_squared <= limit {
        return None;
    }
    let lone = lone_bright_pixels(evidence);
    if lone > 0 && lone as f64 <= FEW_PIXELS * evidence.measured.len() as f64 {
        return Some(format!(
            "{lone} isolated pixels are far brighter than their neighbours: mark them as bad pixels, or let foreign pixels be left out"
        ));
    }
    let value = |at: usize| f64::from(evidence.measured[at]);
    let (fine, passed) = (
        evidence.bands.fine_rms(value)?,
        evidence.bands.passed_rms(value)?,
    );
    let is_white = fine > WHITE_LEVEL * passed && fine > SIGMA_RATIO_BAD;
    is_white.then(|| {
        "pixels of the frame do not resemble their neighbours, as behind no optics: bytes in the wrong order, or a file of another size or kind".into()
    })
}

/// Pixels whose neighbours all have a small part of their light.
fn lone_bright_pixels(evidence: &FitInput) -> usize {
    let columns = evidence.camera.columns();
    let rows = evidence.measured.len() / columns;
    let usable = |at: usize| evidence.weights.is_none_or(|w| w[at] > 0.0);
    let neighbours = |at: usize| {
        let (y, x) = (at / columns, at % columns);
        let near = |v: usize, end: usize| v.saturating_sub(1)..(v + 2).min(end);
        near(y, rows).flat_map(move |r| near(x, columns).map(move |c| r * columns + c))
    };
    let is_lone = |at: &usize| {
        let value = f64::from(evidence.measured[*at]);
        value > LONE_LIGHT
            && usable(*at)
            && neighbours(*at)
                .filter(|n| n != at)
                .all(|n| LONE_RATIO * f64::from(evidence.measured[n]) < value)
    };
    (0..evidence.measured.len()).filter(is_lone).count()
}

fn noise_level(evidence: &FitInput, s: &FitStatistics) -> Option<(Verdict, String)> {
    let floor = s.noise_floor?;
    let allowed = SIGMA_RATIO_SUSPICIOUS * (1.0 + DEVIATIONS * s.noise_floor_error);
    let high = floor > allowed && s.noise_band_is_dark;
    let low = floor < 1.0 / allowed;
    if !(high || low) {
        return None;
    }
    let verdict = if floor.max(1.0 / floor) > SIGMA_RATIO_BAD {
        Verdict::Bad
    } else {
        Verdict::Suspicious
    };
    let check = match evidence.sigma_source {
        SigmaSource::Given => "leave σ out, or give",
        SigmaSource::Calibration => "check gain and read noise, or give a σ of",
        SigmaSource::Frame | SigmaSource::HeldOut => "give a σ of",
    };
    let effect = if high {
        "the video is fitted to noise (or the frame has finer detail than the optics pass, such as bad pixels or columns that are not marked)"
    } else {
        "the video is smoothed more than the noise requires"
    };
    Some((
        verdict,
        format!(
            "the measured noise is {} times the σ of {} counts ({}): {effect}; {check} about {} counts",
            digits(floor),
            digits(evidence.sigma),
            evidence.sigma_source.name(),
            digits(floor * evidence.sigma),
        ),
    ))
}

fn misfit(evidence: &FitInput, s: &FitStatistics, limit: f64) -> (Verdict, String) {
    let ratio = digits(s.chi_squared.sqrt());
    let stopped = evidence.stop_reason != StopReason::Converged;
    let iterations = evidence.residual_history.len();
    let suspicious = |reason: String| (Verdict::Suspicious, reason);
    if stopped && iterations < MIN_ITERATIONS {
        let more = match evidence.stop_reason {
            StopReason::TimeBudget => "time",
            _ => "iterations",
        };
        return suspicious(format!(
            "stopped early, after {iterations} iterations: the residual is still {ratio} times the noise; allow more {more} before judging the fit"
        ));
    }
    if let Some(reason) = local_misfit(s, limit, stopped) {
        return suspicious(reason);
    }
    let is_short = stopped && iterations < FULL_RUN;
    if is_short && s.residual_trend < FALLING_RATIO && s.residual_over_frame < FAR_FROM_FRAME {
        return suspicious(format!(
            "stopped early, after {iterations} iterations: the residual is {ratio} times the noise and still falling; allow more iterations; if it stays this large, {}",
            possible_causes(evidence, s)
        ));
    }
    let is_small =
        evidence.effective_sigma > evidence.sigma && s.residual_over_frame < LARGE_MISFIT;
    let verdict = if s.chi_squared > BAD && !is_small {
        Verdict::Bad
    } else {
        Verdict::Suspicious
    };
    let (misfits, all) = s.misfit_instants;
    let place = if all > 1 {
        format!(" ({misfits} of {all} instants do not fit)")
    } else {
        String::new()
    };
    (
        verdict,
        format!(
            "the model explains the frame to {} % of its light; sensor noise alone would be {} %{place}: {}",
            digits(100.0 * s.residual_over_frame),
            digits(100.0 * s.residual_over_frame / s.chi_squared.sqrt()),
            possible_causes(evidence, s)
        ),
    )
}

/// A misfit that sits in few pixels, columns or instants.
fn local_misfit(s: &FitStatistics, limit: f64, stopped: bool) -> Option<String> {
    let few = |(misfits, all): (usize, usize), part: f64| {
        misfits > 0 && misfits as f64 <= (part * all as f64).max(1.0) && all > 3
    };
    let (instants, columns) = (s.misfit_instants, s.misfit_columns);
    let pixels = instants.1.max(1) * columns.1;
    if s.lone_pixels > 0
        && s.lone_pixels as f64 <= FEW_PIXELS * pixels as f64
        && s.chi_squared_without.pixels < limit
    {
        return Some(format!(
            "{} isolated pixels do not fit: mark them as bad pixels",
            s.lone_pixels
        ));
    }
    if few(columns, FEW_COLUMNS) && s.chi_squared_without.columns < limit {
        return Some(format!(
            "{} of {} columns do not fit, column {} worst: bad columns, or something at the edge of the frame",
            columns.0, columns.1, s.worst_column.0
        ));
    }
    if few(instants, FEW_INSTANTS) && s.chi_squared_without.instants < limit {
        return Some(format!(
            "{} of {} instants do not fit (instant {} worst), the others do: {}light may come from outside the field, or the support is too small (try a larger field, or a prior without support)",
            instants.0,
            instants.1,
            s.worst_instant.0,
            if stopped {
                "there were too few iterations, or "
            } else {
                ""
            }
        ));
    }
    None
}

/// Level of the passed band over the noise, where it is more than noise makes it.
fn structure(s: &FitStatistics) -> Option<f64> {
    let (passed, floor) = (s.passed_level?, s.noise_floor?);
    let excess = passed / floor.max(1.0);
    (excess > STRUCTURE * (1.0 + s.noise_floor_error)).then_some(excess)
}

/// What may be wrong with a model that fits nowhere.
fn possible_causes(evidence: &FitInput, s: &FitStatistics) -> String {
    let mut list = Vec::new();
    if evidence.tau_is_given {
        list.push("the given τ is too large");
    }
    if evidence.residual_history.is_empty() {
        list.push("the scene does not follow the model of the guide");
    }
    list.push("the PSF does not belong to this frame (another diffuser or distance, turned, or with a background left in it)");
    if s.tests_timing {
        list.push("the row times are not those assumed (wrong shutter, exposure too long, frame shifted along y)");
    }
    if evidence.stop_reason != StopReason::Converged {
        list.push("the solver did not converge");
    }
    list.join("; or ")
}

fn digits(value: f64) -> String {
    match value {
        v if v >= 100.0 => format!("{v:.0}"),
        v if v >= 10.0 => format!("{v:.1}"),
        v if v >= 0.1 => format!("{v:.2}"),
        v if v >= 0.01 => format!("{v:.3}"),
        v => format!("{v:.2e}"),
    }
}
