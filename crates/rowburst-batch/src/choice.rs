//! What is decided once for all frames: the kind of their numbers, and the prior.
//!
//! A choice for each frame would cost four times the run. It is made once, on the brightest of a
//! few frames spread over the recording, and kept in the job: the same for all processes that
//! work on it, and after every kill.

use crate::calibration::RecordingCalibration;
use crate::inputs::BatchInputs;
use crate::measurement::{is_of_correction, read_measurement};
use rowburst::error::LibraryNames;
use rowburst::reconstruct::{Choice, Options, Prior, Problem, SelfCalibration};
use rowburst::solve::StopReason;
use rowburst::vecmath::norm;
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result};
use rowburst_io::SampleFormat;
use rowburst_io::hash_image;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;

/// Frames that are looked at before the job begins.
const PROBES: usize = 9;

/// A frame that was looked at.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Probe {
    pub frame: usize,
    /// Hash of its pixels; `None` where it could not be used.
    pub content: Option<String>,
}

/// What the frames that were looked at tell.
pub(crate) struct RecordingSurvey {
    pub probes: Vec<Probe>,
    /// The kind of numbers of the first good one.
    pub pixel_format: String,
    /// The good one with the most light.
    pub brightest: usize,
}

impl RecordingSurvey {
    /// Looks at frames spread over the recording, and at all of them if none of those is good.
    pub fn read(inputs: &BatchInputs) -> Result<Self> {
        let count = inputs.frames.count();
        if count == 0 {
            return Err(Error::input(
                Parameter::Frames,
                "no frame",
                "a recording has at least one frame",
                "Check how the array was made: its first axis, that of the frames, has the length 0.",
            )
            .with_kind(ErrorKind::Shape));
        }
        let spread = PROBES.min(count);
        let last = (spread - 1).max(1);
        let picked: Vec<usize> = (0..spread).map(|i| i * (count - 1) / last).collect();
        let rest = (0..count).filter(|frame| !picked.contains(frame));
        let mut probes = Vec::new();
        let mut best: Option<(usize, f64)> = None;
        let mut pixel_format = None;
        let mut first: Option<(usize, Error)> = None;
        for frame in picked.iter().copied().chain(rest) {
            if probes.len() >= spread && best.is_some() {
                break;
            }
            inputs.model.cancel().check()?;
            let content = match read_measurement(inputs, frame) {
                Ok((capture, measurement)) => {
                    pixel_format.get_or_insert_with(|| pixel_format_name(capture.format));
                    let light = norm(measurement.image().data());
                    if best.is_none_or(|(_, most)| light > most) {
                        best = Some((frame, light));
                    }
                    Some(hash_image(&capture.image))
                }
                Err(error) => {
                    first.get_or_insert((frame, error));
                    None
                }
            };
            probes.push(Probe { frame, content });
        }
        if let (Some(pixel_format), Some((brightest, _))) = (pixel_format, best) {
            return Ok(Self {
                probes,
                pixel_format,
                brightest,
            });
        }
        let (frame, error) = first.expect("a recording has frames");
        if is_of_correction(&error) {
            return Err(error);
        }
        Err(none_usable(inputs, frame, error))
    }
}

/// The error of a recording whose frames all fail, with that of the first one that was looked at, `frame`.
fn none_usable(inputs: &BatchInputs, frame: usize, error: Error) -> Error {
    let frames = &inputs.frames;
    Error::work(
        frames.path(),
        format!(
            "none of its {} frames can be used, and nothing was written; {}: {}",
            frames.count(),
            frames.name(frame),
            error.reason(&LibraryNames)
        ),
        error.remedy().clone(),
    )
    .of(Parameter::Frames)
    .with_source(error)
}

/// Refuses another recording of the same length: frames that both times could be read differ.
pub(crate) fn is_same_recording(begun: &[Probe], now: &[Probe]) -> bool {
    let same = |probe: &Probe| {
        let other = now.iter().find(|other| other.frame == probe.frame);
        match (
            &probe.content,
            other.and_then(|other| other.content.as_ref()),
        ) {
            (Some(then), Some(now)) => then == now,
            _ => true,
        }
    };
    begun.iter().all(same)
}

/// The kind of numbers in words.
pub(crate) fn pixel_format_name(format: SampleFormat) -> String {
    match format {
        SampleFormat::Counts { bits } if bits % 8 == 7 => {
            format!("signed integers of {} bits", bits + 1)
        }
        SampleFormat::Counts { bits } => format!("integers of {bits} bits"),
        SampleFormat::Float => "floating point".into(),
    }
}

/// The prior that all frames of a batch have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChosenPrior {
    /// Its name.
    pub prior: String,
    /// `τ` over that of the discrepancy principle.
    #[serde(rename = "strength")]
    pub tau_factor: f64,
    /// The frame that it was chosen on; `None` where it was given.
    pub frame: Option<usize>,
    /// Why.
    pub reason: String,
}

impl ChosenPrior {
    pub(crate) fn given(prior: Prior) -> Self {
        Self {
            prior: prior.to_string(),
            tau_factor: 1.0,
            frame: None,
            reason: "given".into(),
        }
    }

    /// Chooses on `frame`; `None` where it was stopped.
    pub(crate) fn choose(
        inputs: &BatchInputs,
        calibration: &RecordingCalibration,
        frame: usize,
        cancel: &Cancel,
    ) -> Result<Option<Self>> {
        let (_, measurement) = read_measurement(inputs, frame)?;
        let measurement = calibration.corrected(measurement);
        let options = Options {
            self_calibration: SelfCalibration::OFF,
            ..inputs.options
        };
        let model = calibration.model.clone().with_cancel(cancel);
        let problem = Problem::with_model(&model, &measurement, options);
        if cancel.is_cancelled() {
            return Ok(None);
        }
        let chosen = problem?.choose(&mut |_| {
            if cancel.is_cancelled() {
                ControlFlow::Break(StopReason::Interrupted)
            } else {
                ControlFlow::Continue(())
            }
        });
        Ok(match chosen {
            Err(_) => None,
            Ok(None) => Some(Self {
                prior: Prior::STANDARD.to_string(),
                tau_factor: 1.0,
                frame: Some(frame),
                reason:
                    "standard prior: too few pixels to compare priors (one bin, or a small frame)"
                        .into(),
            }),
            Ok(Some(choice)) => Some(Self {
                prior: choice.best_for_others().prior.to_string(),
                tau_factor: choice.best_for_others().tau_factor,
                frame: Some(frame),
                reason: reason(&choice),
            }),
        })
    }
}

/// The reason for the choice, and what it means for other frames.
fn reason(choice: &Choice) -> String {
    let others = choice.best_for_others();
    let mut reason = choice.reason();
    if others != choice.best() {
        reason += &format!(
            "; that frame is at rest, and others may not be: {} for all",
            others.name()
        );
    }
    reason
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_was_mended_does_not_make_another_recording() {
        let probe = |frame, content: Option<&str>| Probe {
            frame,
            content: content.map(Into::into),
        };
        let begun = [probe(0, Some("a")), probe(5, None), probe(9, Some("c"))];
        let mended = [
            probe(0, Some("a")),
            probe(5, Some("b")),
            probe(9, Some("c")),
        ];
        assert!(is_same_recording(&begun, &mended));
        assert!(is_same_recording(&mended, &begun));
        let other = [probe(0, Some("a")), probe(5, None), probe(9, Some("x"))];
        assert!(!is_same_recording(&begun, &other));
    }
}
