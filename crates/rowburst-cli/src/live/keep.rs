//! What the buttons of the page keep: recordings, frames, and full reconstructions.

use super::LiveArgs;
use crate::inputs::calibration_from_args;
use rowburst::solve::StopReason;
use rowburst::{Cancel, Result};
use rowburst_capture::{Delivery, Ended, Frame, Recorder, Settings, Source};
use rowburst_io::{Experiment, ForeignFiles, OutputFolder};
use rowburst_run::{MovieStyle, Output, Request, RequestParams};
use rowburst_view::{Monitor, MonitorRequest};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Answers the requests of the page.
pub struct Keeper {
    folder: PathBuf,
    settings: Settings,
    job: SaveJob,
    recorder: Option<Recorder>,
    saving: Option<std::thread::JoinHandle<Result<PathBuf>>>,
}

/// What a full reconstruction needs beside the frame.
#[derive(Clone)]
struct SaveJob {
    experiment: Option<PathBuf>,
    calibration: rowburst_io::Calibration,
    /// Ends it, with the result so far.
    cancel: Cancel,
}

impl Keeper {
    pub fn new(args: &LiveArgs, settings: Settings, cancel: Cancel) -> Self {
        Self {
            folder: args.output.clone(),
            settings,
            job: SaveJob {
                experiment: args.experiment.clone(),
                calibration: calibration_from_args(&args.calibration),
                cancel,
            },
            recorder: None,
            saving: None,
        }
    }

    /// Answers one request, if there is one, and tells of a reconstruction that is finished.
    pub fn answer(
        &mut self,
        monitor: &Monitor,
        frame: Option<Arc<Frame>>,
        source: &mut dyn Source,
    ) {
        if self
            .saving
            .as_ref()
            .is_some_and(std::thread::JoinHandle::is_finished)
        {
            self.tell_saved(monitor);
        }
        let (Some(request), Some(frame)) = (monitor.take_request(), frame) else {
            return;
        };
        let told = match request {
            MonitorRequest::Record => self.begin(),
            MonitorRequest::Stop => self.end(&Ended::Complete),
            MonitorRequest::Snapshot => self
                .snapshot(&frame)
                .map(|path| format!("kept {}", path.display())),
            MonitorRequest::Save => self.save(&frame),
            MonitorRequest::Set { name, value } => self.set(&name, value, source, monitor),
        };
        monitor.set("message", told.unwrap_or_else(|error| error.to_string()));
        monitor.set(
            "recording",
            self.recorder.as_ref().map(|r| r.record().written),
        );
    }

    fn begin(&mut self) -> Result<String> {
        if self.recorder.is_some() {
            return Ok("a recording is going on".into());
        }
        let path = self.free_name("recording", "tif");
        let recorder = Recorder::create(&path, "record", self.settings.clone(), None)?;
        self.recorder = Some(recorder);
        Ok(format!("recording {}", path.display()))
    }

    fn end(&mut self, ended: &Ended) -> Result<String> {
        let Some(recorder) = self.recorder.take() else {
            return Ok("there is no recording".into());
        };
        let record = recorder.finish(ended)?;
        Ok(format!("kept {} frames in {}", record.written, record.file))
    }

    /// Sets a control of the camera; recordings that begin later have the new settings.
    fn set(
        &mut self,
        name: &str,
        value: f64,
        source: &mut dyn Source,
        monitor: &Monitor,
    ) -> Result<String> {
        let set = source.set(name, value);
        // Also after a refusal: the page shows what the camera has.
        monitor.set("controls", super::controls_of(source)?);
        set?;
        self.settings = source.settings()?;
        Ok(format!("{name} is set"))
    }

    /// Ends the recording that goes on because the source has ended, and tells so.
    pub fn source_ended(&mut self, ended: &Ended, monitor: &Monitor) {
        if self.recorder.is_some() {
            let told = self.end(ended).unwrap_or_else(|error| error.to_string());
            monitor.set("message", told);
            monitor.set("recording", serde_json::Value::Null);
        }
    }

    /// Writes a delivery where a recording is going on. A recording that fails is ended, with what it has.
    pub fn record(&mut self, delivery: &Delivery, monitor: &Monitor) {
        let Some(recorder) = &mut self.recorder else {
            return;
        };
        match recorder.take(delivery.clone()) {
            Ok(()) => monitor.set("recording", recorder.record().written),
            Err(error) => {
                let ended = Ended::Failed(error.clone());
                let kept = self.recorder.take().map(|recorder| recorder.finish(&ended));
                let kept = kept.and_then(Result::ok).map_or(0, |record| record.written);
                monitor.set("recording", serde_json::Value::Null);
                monitor.set("message", format!("{error}; {kept} frames are kept"));
            }
        }
    }

    fn snapshot(&self, frame: &Frame) -> Result<PathBuf> {
        let path = self.free_name(&format!("frame-{}", frame.number), "tif");
        let mut recorder = Recorder::create(&path, "frame", self.settings.clone(), Some(1))?;
        recorder.write(frame, None)?;
        recorder.finish(&Ended::Complete)?;
        Ok(path)
    }

    /// Keeps the frame and begins its full reconstruction.
    fn save(&mut self, frame: &Frame) -> Result<String> {
        let Some(experiment) = self.job.experiment.clone() else {
            return Ok("there is no experiment: nothing can be reconstructed".into());
        };
        if self.saving.is_some() {
            return Ok("a reconstruction is going on: wait for it".into());
        }
        let path = self.snapshot(frame)?;
        let told = format!("kept {}; reconstructing it in full", path.display());
        let job = self.job.clone();
        self.saving = Some(std::thread::spawn(move || {
            reconstruct(&experiment, job.calibration, &path, job.cancel)
        }));
        Ok(told)
    }

    fn tell_saved(&mut self, monitor: &Monitor) {
        let Some(saving) = self.saving.take() else {
            return;
        };
        let told = match saving.join() {
            Ok(Ok(folder)) => format!("the result is in {0}: rowburst view {0}", folder.display()),
            Ok(Err(error)) => error.to_string(),
            Err(_) => "the reconstruction failed".into(),
        };
        monitor.set("message", told);
    }

    /// Ends the recording that goes on, after Ctrl-C, and waits for the reconstruction, which then ends, too.
    pub fn finish(mut self) -> Result<()> {
        if self.recorder.is_some() {
            eprintln!("{}", self.end(&Ended::Interrupted)?);
        }
        match self.saving.take().map(std::thread::JoinHandle::join) {
            Some(Ok(Ok(folder))) => eprintln!("{}", folder.display()),
            Some(Ok(Err(error))) if error.kind() == rowburst::ErrorKind::Cancelled => {
                eprintln!("the reconstruction had just begun: it has no result");
            }
            Some(Ok(Err(error))) => return Err(error),
            Some(Err(_)) | None => {}
        }
        Ok(())
    }

    /// A name in the folder that no file has yet.
    fn free_name(&self, name: &str, ending: &str) -> PathBuf {
        let numbered = |n: usize| self.folder.join(format!("{name}-{n}.{ending}"));
        let first = self.folder.join(format!("{name}.{ending}"));
        let mut names = std::iter::once(first).chain((2..).map(numbered));
        names
            .find(|path| !path.exists())
            .expect("some name is free")
    }
}

/// Reconstructs the file `frame` as `rowburst reconstruct` does, into a folder of its name.
fn reconstruct(
    experiment: &Path,
    calibration: rowburst_io::Calibration,
    frame: &Path,
    cancel: Cancel,
) -> Result<PathBuf> {
    let output = frame.with_extension("");
    let experiment = Experiment::read_with(experiment, &rowburst_io::read_metadata(frame))?;
    let folder = OutputFolder::claim(&output, "reconstruct", ForeignFiles::Refuse)?;
    let params = RequestParams {
        calibration,
        cancel: cancel.clone(),
        ..RequestParams::default()
    };
    let quiet = &mut |_: rowburst_run::Event| {
        if cancel.is_cancelled() {
            ControlFlow::Break(StopReason::Interrupted)
        } else {
            ControlFlow::Continue(())
        }
    };
    let request = Request::read(&experiment, frame, params, quiet)?;
    let title = format!("Rowburst: {}", frame.display());
    let output_params = Output {
        folder: &folder,
        title: &title,
        reproduce: None,
        movie: MovieStyle::Stamped,
        formats: None,
        record: None,
    };
    request.run(&output_params, Instant::now(), quiet)?;
    Ok(output)
}
