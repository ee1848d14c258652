//! The folder of an experiment: what is there, what is missing, what is out of date, and the next command.
//!
//! ```text
//! rowburst.toml                 the source
//! captures/NAME.tif, NAME.json  timing, darks, flats, psf, psf-again, led, frame
//! experiment.toml               from the settings of the camera
//! timing/ sensor/ psf/ check/ result/  what calibrate, check and reconstruct write
//! ```

use crate::correlation::correlation_of_captures;
use crate::record::CaptureRecord;
use rowburst::{Error, ErrorKind, Result};
use rowburst_io::{Experiment, OutputFolder, read_capture_record, read_metadata};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// The file that makes a folder that of an experiment.
pub const PROJECT_FILE: &str = "rowburst.toml";

/// Correlation of two captures of the PSF below which the diffuser has drifted.
const MIN_CORRELATION: f64 = 0.95;

/// How far a step is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepState {
    /// It is there and fits the others.
    Done,
    /// It is not there.
    Missing,
    /// It was made with other settings, or before what it is made of.
    OutOfDate,
    /// It is there and says that something is wrong.
    Failed,
    /// It is not there, and the others do without it.
    Optional,
}

impl StepState {
    /// Its name as data.
    pub fn name(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Missing => "missing",
            Self::OutOfDate => "out-of-date",
            Self::Failed => "failed",
            Self::Optional => "optional",
        }
    }

    /// Whether something is to be done.
    pub fn is_open(self) -> bool {
        matches!(self, Self::Missing | Self::OutOfDate | Self::Failed)
    }
}

/// A step of the experiment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Step {
    /// Its name.
    pub name: &'static str,
    /// How far it is.
    pub state: StepState,
    /// Why, in words.
    pub detail: String,
    /// The command that does it.
    pub command: String,
}

/// The folder of an experiment.
pub struct Project {
    folder: PathBuf,
    source: String,
}

/// A capture of the folder, and the settings that it must share with the frame.
struct CaptureStep {
    name: &'static str,
    command: &'static str,
    keys: &'static [&'static str],
}

const TIMING: CaptureStep = CaptureStep {
    name: "timing",
    command: "rowburst capture timing -n 3",
    keys: &[
        "camera",
        "readout rate",
        "size",
        "origin",
        "binning",
        "row time",
        "shutter",
    ],
};
const DARKS: CaptureStep = CaptureStep {
    name: "darks",
    command: "rowburst capture darks -n 50",
    keys: &[
        "camera",
        "gain",
        "readout rate",
        "size",
        "origin",
        "binning",
        "exposure",
        "bit depth",
    ],
};
const FLATS: CaptureStep = CaptureStep {
    name: "flats",
    command: "rowburst capture flats -n 20",
    keys: &[
        "camera",
        "gain",
        "readout rate",
        "size",
        "origin",
        "binning",
        "bit depth",
    ],
};
const PSF: CaptureStep = CaptureStep {
    name: "psf",
    command: "rowburst capture psf -n 20",
    keys: &["camera", "size", "origin", "binning"],
};
const FRAME: CaptureStep = CaptureStep {
    name: "frame",
    command: "rowburst capture frame",
    keys: &[],
};

/// A file that a command makes of others.
struct ResultStep<'a> {
    name: &'static str,
    /// Files of the folder that it is made of.
    inputs: Vec<&'a str>,
    file: &'static str,
    command: String,
}

/// Makes the folder of an experiment whose frames come from `source`.
///
/// # Errors
/// A folder that holds one already, or cannot be written to.
pub fn create_project(folder: &Path, source: &str) -> Result<()> {
    if folder.join(PROJECT_FILE).exists() {
        return Err(Error::input(
            folder,
            "the folder of an experiment",
            "an experiment is never replaced",
            "Choose another name.",
        )
        .with_kind(ErrorKind::Exists));
    }
    let mut text = String::from(
        "# An experiment of rowburst. In this folder, rowburst status says what is there and what is next.\n\n",
    );
    // Writing to a String cannot fail.
    let _ = writeln!(text, "source = {}", toml::Value::from(source));
    OutputFolder::create(folder)?.write_bytes(PROJECT_FILE, text.as_bytes())
}

impl Project {
    /// Opens the folder of an experiment.
    ///
    /// # Errors
    /// A folder that is none, or whose file cannot be read.
    pub fn open(folder: &Path) -> Result<Self> {
        let file = folder.join(PROJECT_FILE);
        let no_project = || {
            Error::input(
                folder,
                format!("no {PROJECT_FILE}"),
                "the folder of an experiment has one",
                "Make one with rowburst new NAME, and go into it.",
            )
            .with_kind(ErrorKind::NotFound)
        };
        let text = std::fs::read_to_string(&file).map_err(|_| no_project())?;
        let table: toml::Table = text.parse().map_err(|error: toml::de::Error| {
            let remedy = "Write source = \"play:recording.tif\", for example.";
            Error::input(
                &file,
                error.message(),
                "it is a TOML file with the key source",
                remedy,
            )
        })?;
        let source = table.get("source").and_then(toml::Value::as_str);
        Ok(Self {
            folder: folder.into(),
            source: source.unwrap_or_default().into(),
        })
    }

    /// The source of the frames.
    ///
    /// # Errors
    /// None is named.
    pub fn source(&self) -> Result<&str> {
        if self.source.is_empty() {
            return Err(Error::input(
                self.folder.join(PROJECT_FILE),
                "no source",
                "the source of the frames is needed",
                "Write source = \"play:recording.tif\", for example.",
            )
            .with_kind(ErrorKind::Missing));
        }
        Ok(&self.source)
    }

    /// The file of a capture.
    pub fn capture(&self, name: &str) -> PathBuf {
        self.folder.join("captures").join(format!("{name}.tif"))
    }

    fn record(&self, name: &str) -> Option<CaptureRecord> {
        serde_json::from_value(read_capture_record(&self.capture(name))?).ok()
    }

    /// The steps of the experiment, in their order.
    ///
    /// # Errors
    /// Captures of the PSF that cannot be read.
    pub fn status(&self) -> Result<Vec<Step>> {
        let reference = self.reference();
        let reference = reference.as_ref();
        let knows_timing = self.knows_timing();
        let before_timing = self.first_of(["timing/experiment.toml", "experiment.toml"]);
        let before_psf = if self.has("sensor/sensor.json") {
            "sensor/experiment.toml"
        } else {
            before_timing
        };
        let mut steps = vec![self.settings_step()];
        let mut timing = [
            self.capture_step(&TIMING, reference),
            self.result_step(ResultStep {
                name: "calibrate timing",
                inputs: vec!["captures/timing.tif"],
                file: "timing/timing.json",
                command:
                    "rowburst calibrate timing captures/timing.tif --frequency-hz HZ -o timing"
                        .into(),
            }),
        ];
        if knows_timing {
            timing.iter_mut().for_each(make_optional);
        }
        steps.extend(timing);
        steps.push(self.experiment_step(before_timing));
        steps.push(self.capture_step(&DARKS, reference));
        steps.push(self.capture_step(&FLATS, reference));
        steps.push(self.result_step(ResultStep {
            name: "calibrate sensor",
            inputs: vec!["captures/darks.tif", "captures/flats.tif", before_timing],
            file: "sensor/sensor.json",
            command: format!("rowburst calibrate sensor --darks captures/darks.tif --flats captures/flats.tif --experiment {before_timing} -o sensor"),
        }));
        steps.push(self.psf_step(reference));
        steps.push(self.result_step(ResultStep {
            name: "calibrate psf",
            inputs: vec!["captures/psf.tif", before_psf],
            file: "psf/psf.json",
            command: format!(
                "rowburst calibrate psf captures/psf.tif --experiment {before_psf} -o psf"
            ),
        }));
        steps.push(self.check_step());
        steps.push(self.capture_step(&FRAME, reference));
        steps.push(
            self.result_step(ResultStep {
                name: "reconstruct",
                inputs: vec!["captures/frame.tif", "psf/experiment.toml"],
                file: "result/result.json",
                command:
                    "rowburst reconstruct psf/experiment.toml --frame captures/frame.tif -o result"
                        .into(),
            }),
        );
        Ok(steps)
    }

    /// The mean level of the darks in counts, where they were recorded.
    pub fn dark_counts(&self) -> Option<f64> {
        let record = self.record(DARKS.name)?;
        let means = record.frames.iter().filter_map(|frame| frame.mean_counts);
        let (sum, count) = means.fold((0.0, 0), |(sum, count), mean| (sum + mean, count + 1));
        (count > 0).then(|| sum / f64::from(count))
    }

    /// The first of `names` that is there, or else the last.
    fn first_of(&self, names: [&'static str; 2]) -> &'static str {
        if self.has(names[0]) {
            names[0]
        } else {
            names[1]
        }
    }

    fn has(&self, name: &str) -> bool {
        self.folder.join(name).is_file()
    }

    /// The capture whose settings the others must share: the frame, or else the latest but the PSF, whose exposure is free.
    fn reference(&self) -> Option<CaptureRecord> {
        let latest = || {
            let names = [TIMING.name, DARKS.name, FLATS.name];
            let records = names.iter().filter_map(|name| self.record(name));
            records.max_by_key(|record| record.started_unix_s)
        };
        self.record(FRAME.name).or_else(latest)
    }

    fn knows_timing(&self) -> bool {
        Experiment::read(&self.folder.join("experiment.toml")).is_ok()
    }

    fn settings_step(&self) -> Step {
        let (state, detail) = if self.has("experiment.toml") {
            (StepState::Done, "experiment.toml")
        } else {
            (
                StepState::Missing,
                "no experiment.toml yet: a capture of a frame writes it",
            )
        };
        Step {
            name: "settings",
            state,
            detail: detail.into(),
            command: FRAME.command.into(),
        }
    }

    /// The keys of the experiment file that the camera left open, and whether they are those of the latest frame.
    fn experiment_step(&self, name: &str) -> Step {
        let file = self.folder.join(name);
        let frame = self.capture(FRAME.name);
        let mut metadata = read_metadata(&frame);
        metadata.size = self.record(FRAME.name).and_then(|record| record.size);
        let of_frame = || Experiment::read_with(&file, &metadata);
        let contradictions = |experiment: Experiment| {
            let warnings = experiment.from_metadata.warnings.into_iter();
            // The first ones are remarks on the metadata themselves.
            warnings.skip(metadata.notes.len()).collect::<Vec<_>>()
        };
        let (state, detail) = match Experiment::read(&file) {
            Err(error) => (StepState::Missing, error.to_string()),
            Ok(_) => match of_frame().map(contradictions) {
                Ok(found) if found.is_empty() => (
                    StepState::Done,
                    format!("{name} has what a reconstruction needs"),
                ),
                Ok(found) => (StepState::OutOfDate, found.join("; ")),
                Err(error) => (StepState::OutOfDate, error.to_string()),
            },
        };
        let command = if state == StepState::OutOfDate {
            format!(
                "correct {name}, or move it away and take the frame again: rowburst capture frame --replace"
            )
        } else {
            "fill in experiment.toml; timing/timing.json has row_time_us and shutters".into()
        };
        Step {
            name: "experiment",
            state,
            detail,
            command,
        }
    }

    /// The check of the set-up, and what it found.
    fn check_step(&self) -> Step {
        let file = "check/check.json";
        let is_there = self.folder.join("captures/led.tif").is_file();
        let replace = if is_there { " --replace" } else { "" };
        let mut step = self.result_step(ResultStep {
            name: "check",
            inputs: vec!["captures/led.tif", "psf/experiment.toml"],
            file,
            command: format!("rowburst capture frame -o captures/led.tif{replace}, of a blinking point; then rowburst check psf/experiment.toml --frame captures/led.tif --frequency-hz HZ -o check"),
        });
        match step.state {
            StepState::Missing => {
                step.state = StepState::Optional;
                step.detail =
                    "one frame of a blinking point tells whether the set-up is good".into();
            }
            StepState::Done => {
                let failed = self.failed_checks(file);
                if !failed.is_empty() {
                    step.state = StepState::Failed;
                    step.detail = failed.join("; ");
                }
            }
            _ => {}
        }
        step
    }

    /// What a check found wrong, with the remedies.
    fn failed_checks(&self, file: &str) -> Vec<String> {
        let read = std::fs::read(self.folder.join(file));
        let found: serde_json::Value = match read.map(|bytes| serde_json::from_slice(&bytes)) {
            Ok(Ok(found)) => found,
            _ => return vec![format!("{file} cannot be read")],
        };
        let checks = found["checks"].as_array().cloned().unwrap_or_default();
        let failed = checks.iter().filter(|check| check["passed"] == false);
        let words = |check: &serde_json::Value, key: &str| {
            check[key].as_str().unwrap_or_default().to_string()
        };
        failed
            .map(|check| {
                let [name, found, remedy] =
                    ["name", "found", "remedy"].map(|key| words(check, key));
                format!("{name}: {found}. {remedy}")
            })
            .collect()
    }

    fn capture_step(&self, step: &CaptureStep, reference: Option<&CaptureRecord>) -> Step {
        let (state, detail) = match self.record(step.name) {
            None => (StepState::Missing, "not recorded".to_string()),
            Some(record) => {
                let others = reference.map(|r| &r.fingerprint);
                let differences =
                    others.map(|other| record.fingerprint.differences(other, step.keys));
                let differences = differences.unwrap_or_default();
                if differences.is_empty() {
                    (StepState::Done, summary(&record))
                } else {
                    let differences = differences.join("; ");
                    (
                        StepState::OutOfDate,
                        format!("taken with other settings than the latest frame: {differences}"),
                    )
                }
            }
        };
        let mut step = Step {
            name: step.name,
            state,
            detail,
            command: step.command.into(),
        };
        if step.state == StepState::OutOfDate {
            replace_capture(&mut step);
        }
        step
    }

    /// The PSF, and how much a second capture of it differs.
    fn psf_step(&self, reference: Option<&CaptureRecord>) -> Step {
        let mut step = self.capture_step(&PSF, reference);
        let again = self.capture("psf-again");
        if step.state != StepState::Done || !again.is_file() {
            return step;
        }
        let found = match correlation_of_captures(&self.capture(PSF.name), &again) {
            Ok(found) => found,
            // Of another region, or damaged: it tells nothing of the diffuser.
            Err(error) => {
                let _ = write!(
                    step.detail,
                    "; no comparison with the second capture: {error}"
                );
                step.state = StepState::OutOfDate;
                step.command = "rowburst capture psf -n 20 --again --replace".into();
                return step;
            }
        };
        let (y, x) = found.shift_px;
        let _ = write!(
            step.detail,
            "; correlation with the second capture {:.3}, shift {y}, {x} px",
            found.correlation
        );
        if found.correlation < MIN_CORRELATION || (y, x) != (0, 0) {
            step.state = StepState::OutOfDate;
            replace_capture(&mut step);
            let _ = write!(
                step.detail,
                ": the diffuser has moved or drifted (limit {MIN_CORRELATION}, no shift); take the PSF anew"
            );
        }
        step
    }

    fn result_step(&self, step: ResultStep) -> Step {
        let modified = |name: &str| {
            let path = self.folder.join(name);
            path.metadata().and_then(|m| m.modified()).ok()
        };
        let file = step.file;
        let made = modified(file);
        let newer = step.inputs.iter().find(|input| modified(input) > made);
        let (state, detail) = match (made, newer) {
            (None, _) => (StepState::Missing, format!("no {file}")),
            (Some(_), Some(input)) => (
                StepState::OutOfDate,
                format!("{file} was made before {input}"),
            ),
            (Some(_), None) => (StepState::Done, file.to_string()),
        };
        Step {
            name: step.name,
            state,
            detail,
            command: step.command,
        }
    }
}

/// The command of a capture that is there already.
fn replace_capture(step: &mut Step) {
    step.command.push_str(" --replace");
}

fn make_optional(step: &mut Step) {
    if step.state == StepState::Missing {
        step.state = StepState::Optional;
        step.detail = "not needed: the camera says its row time, shutter and exposure".into();
    }
}

fn summary(record: &CaptureRecord) -> String {
    let mut text = format!("{} frames", record.written);
    if record.dropped + record.incomplete > 0 {
        let _ = write!(
            text,
            ", {} dropped, {} incomplete",
            record.dropped, record.incomplete
        );
    }
    for warning in &record.warnings {
        let _ = write!(text, "; {warning}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recorder::{Ended, Recorder};
    use crate::settings::Settings;
    use crate::source::Frame;

    /// Speckle of grains of two pixels, part of it from another seed.
    fn speckle(part: f64, shift: usize) -> Frame {
        let noise = |y: usize, x: usize, seed: usize| {
            let mut bits = (y * 1009 + x + seed * 7_777_777 + 1) as u32;
            for _ in 0..3 {
                bits = (bits ^ (bits >> 15)).wrapping_mul(0x2c1b_3c6d);
            }
            f64::from(bits >> 8) / 16_777_216.0
        };
        let side = 48;
        let counts = (0..side * side).map(|i| {
            let (y, x) = ((i / side + shift) / 2, (i % side) / 2);
            (1000.0 * ((1.0 - part) * noise(y, x, 0) + part * noise(y, x, 1))) as u16
        });
        Frame {
            rows: side,
            columns: side,
            counts: counts.collect(),
            number: 0,
            time_us: None,
        }
    }

    fn settings(exposure: &str) -> Settings {
        let mut settings = Settings::default();
        for (name, value) in [
            ("rows", "48"),
            ("columns", "48"),
            ("shutter", "dual-inside-out"),
            ("row_time_us", "9.6"),
            ("exposure_us", exposure),
        ] {
            settings.push(name, value);
        }
        settings
    }

    fn capture(project: &Project, name: &str, frame: &Frame, settings: Settings) {
        let path = project.capture(name);
        let mut recorder = Recorder::create(&path, name, settings, Some(1)).unwrap();
        recorder.write(frame, None).unwrap();
        recorder.finish(&Ended::Complete).unwrap();
    }

    fn state(project: &Project, name: &str) -> (StepState, String) {
        let steps = project.status().unwrap();
        let step = steps.into_iter().find(|step| step.name == name).unwrap();
        (step.state, step.detail)
    }

    fn project(folder: &Path) -> Project {
        create_project(folder, "play:a \"b\".tif").unwrap();
        Project::open(folder).unwrap()
    }

    #[test]
    fn captures_with_other_settings_are_out_of_date() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        assert_eq!(project.source().unwrap(), "play:a \"b\".tif");
        assert_eq!(state(&project, "darks").0, StepState::Missing);
        let text = crate::experiment_text(&settings("9.6"));
        std::fs::write(folder.path().join("experiment.toml"), text).unwrap();
        assert_eq!(state(&project, "timing").0, StepState::Optional);
        capture(&project, "darks", &speckle(0.0, 0), settings("9.6"));
        capture(&project, "psf", &speckle(0.0, 0), settings("500"));
        assert_eq!(state(&project, "darks").0, StepState::Done);
        capture(&project, "frame", &speckle(0.0, 0), settings("20"));
        let (is, why) = state(&project, "darks");
        assert_eq!(is, StepState::OutOfDate);
        assert!(
            why.contains("exposure 9.600000 µs, not 20.000000 µs"),
            "{why}"
        );
        let command = |name: &str| {
            let steps = project.status().unwrap();
            let step = steps.into_iter().find(|step| step.name == name);
            step.unwrap().command
        };
        assert_eq!(command("darks"), "rowburst capture darks -n 50 --replace");
        assert_eq!(command("flats"), "rowburst capture flats -n 20");
        // A PSF is normalised: its exposure is free.
        assert_eq!(state(&project, "psf").0, StepState::Done);
    }

    #[test]
    fn an_experiment_of_other_settings_than_the_frame_is_out_of_date() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        let text = crate::experiment_text(&settings("9.6"));
        std::fs::write(folder.path().join("experiment.toml"), text).unwrap();
        capture(&project, "frame", &speckle(0.0, 0), settings("9.6"));
        assert_eq!(state(&project, "experiment").0, StepState::Done);
        std::fs::remove_file(project.capture("frame")).unwrap();
        capture(&project, "frame", &speckle(0.0, 0), settings("20"));
        let (is, why) = state(&project, "experiment");
        assert_eq!(is, StepState::OutOfDate, "{why}");
        assert!(why.contains("exposure_us is 9.6"), "{why}");
        // Also a frame of another region, whose file says no more than its pixels.
        let text = crate::experiment_text(&settings("20")).replace("rows = 48", "rows = 50");
        std::fs::write(folder.path().join("experiment.toml"), text).unwrap();
        let (is, why) = state(&project, "experiment");
        assert_eq!(is, StepState::OutOfDate, "{why}");
        assert!(why.contains("rows"), "{why}");
    }

    #[test]
    fn results_made_before_the_experiment_are_out_of_date() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
            // A file system may tell times no finer than this.
            std::thread::sleep(std::time::Duration::from_millis(20));
        };
        write("experiment.toml", &crate::experiment_text(&settings("9.6")));
        write("psf/experiment.toml", "");
        write("psf/psf.json", "{}");
        write(
            "check/check.json",
            r#"{"checks": [{"name": "contrast", "passed": false, "found": "0.1", "remedy": "Take it anew."}]}"#,
        );
        write("result/result.json", "{}");
        assert_eq!(state(&project, "reconstruct").0, StepState::Done);
        let (is, why) = state(&project, "check");
        assert_eq!(
            (is, why.as_str()),
            (StepState::Failed, "contrast: 0.1. Take it anew.")
        );
        write("experiment.toml", &crate::experiment_text(&settings("20")));
        let (is, why) = state(&project, "calibrate psf");
        assert_eq!(is, StepState::OutOfDate, "{why}");
        assert!(why.contains("before experiment.toml"), "{why}");
        write("psf/experiment.toml", "");
        assert_eq!(state(&project, "reconstruct").0, StepState::OutOfDate);
        assert_eq!(state(&project, "check").0, StepState::OutOfDate);
    }

    #[test]
    fn a_diffuser_that_has_drifted_is_found() {
        for (part, shift, expected) in [
            (0.0, 0, StepState::Done),
            (0.05, 0, StepState::Done),
            (0.5, 0, StepState::OutOfDate),
            (0.0, 2, StepState::OutOfDate),
        ] {
            let folder = tempfile::tempdir().unwrap();
            let project = project(folder.path());
            capture(&project, "psf", &speckle(0.0, 0), settings("9.6"));
            capture(
                &project,
                "psf-again",
                &speckle(part, shift),
                settings("9.6"),
            );
            let (is, why) = state(&project, "psf");
            assert_eq!(is, expected, "{part} {shift}: {why}");
            if shift > 0 {
                assert!(
                    why.contains("correlation with the second capture 1.000, shift -2, 0 px"),
                    "{why}"
                );
            }
        }
    }

    #[test]
    fn a_second_capture_of_another_region_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let project = project(folder.path());
        capture(&project, "psf", &speckle(0.0, 0), settings("9.6"));
        let other = Frame {
            rows: 20,
            columns: 30,
            counts: vec![1000; 600],
            number: 0,
            time_us: None,
        };
        capture(&project, "psf-again", &other, settings("9.6"));
        let steps = project.status().unwrap();
        let step = steps.iter().find(|step| step.name == "psf").unwrap();
        assert_eq!(step.state, StepState::OutOfDate);
        assert!(step.detail.contains("no comparison"), "{}", step.detail);
        assert!(
            step.command.ends_with("--again --replace"),
            "{}",
            step.command
        );
    }

    #[test]
    fn an_experiment_is_not_replaced() {
        let folder = tempfile::tempdir().unwrap();
        project(folder.path());
        let error = create_project(folder.path(), "").unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Exists);
        let error = Project::open(&folder.path().join("none")).err().unwrap();
        assert!(error.to_string().contains("rowburst new"), "{error}");
    }
}
