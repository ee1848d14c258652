//! `rowburst.Result` and what a progress callback is given.

use crate::array::{from_image, from_video, make_read_only, video};
use crate::camera::{PyCamera, mosaic_of};
use crate::error::to_py_err;
use crate::interrupt::interruptibly;
use crate::pickle::{State as Stored, entry, optional_entry};
use crate::psf::PyPsf;
use crate::state;
use crate::threads::{self, detached};
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use pyo3::types::{PyBytes, PyDict, PyType};
use rowburst::solve::admm::Progress;
use rowburst::{Error, Image, Parameter, Shape, Video};
use rowburst_io::{ForeignFiles, OutputFolder};
use rowburst_report::{ComposedFigure, Layout};
use rowburst_run::{
    ColourFolder, CompletedTask, MovieStyle, Output, ReportMeta, RunRecord, TraceRequest, Traces,
    VideoFormat, figure_of_folder, player_of,
};
use std::mem::swap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// An iteration, as a progress callback sees it.
#[pyclass(name = "Progress", module = "rowburst", frozen, get_all)]
pub struct PyProgress {
    /// The step that the solver runs for, such as a prior that is tested; empty in the final run.
    label: String,
    /// Iterations of this run, from 1.
    iteration: usize,
    /// Most iterations of this run.
    max_iterations: usize,
    /// Rms of the residual over sigma.
    residual_over_sigma: f64,
    /// The weight of the prior at this iteration.
    tau: f64,
    /// Relative change of the video by this iteration.
    change: f64,
    /// Seconds since the call.
    seconds: f64,
}

impl PyProgress {
    pub fn new(progress: &Progress, level: f64, seconds: f64) -> Self {
        Self {
            label: progress.label.into(),
            iteration: progress.iteration,
            max_iterations: progress.max_iterations,
            residual_over_sigma: level,
            tau: progress.tau,
            change: progress.change,
            seconds,
        }
    }
}

#[pymethods]
impl PyProgress {
    fn __repr__(&self) -> String {
        let (n, of, level) = (
            self.iteration,
            self.max_iterations,
            self.residual_over_sigma,
        );
        format!("Progress(iteration={n} of {of}, residual_over_sigma={level:.3})")
    }
}

/// A reconstructed video with what is needed to judge it.
#[pyclass(name = "Result", module = "rowburst._rowburst", frozen)]
pub struct PyReconstruction {
    state: Arc<Mutex<State>>,
    shape: Shape,
    /// Number of threads that reconstructed it.
    threads: usize,
}

struct State {
    completed: CompletedTask,
    /// The video once it was asked for: numpy owns it then, and nobody may change it.
    video: Option<Py<PyArray3<f32>>>,
    /// The video before it was refitted; `None`: it was not to be refitted.
    estimate: Option<Video>,
    /// Of the brightest spots.
    traces: Option<Traces>,
    /// What repeats the run, where all of its inputs are files.
    record: Option<RunRecord>,
}

impl State {
    /// Requested traces. They are those of the video before it was refitted, as on the command line.
    fn traces_of(&mut self, request: TraceRequest) -> Traces {
        let completed = &mut self.completed;
        let Some(estimate) = &mut self.estimate else {
            return completed.traces(request, false);
        };
        swap(&mut completed.reconstruction.video, estimate);
        let mut traces = completed.traces(request, false);
        swap(&mut completed.reconstruction.video, estimate);
        traces.debias_was_wanted = true;
        traces
    }

    /// The reconstruction, and the traces of its brightest spots.
    fn with_spots(&mut self) -> (&CompletedTask, &Traces) {
        if self.traces.is_none() {
            self.traces = Some(self.traces_of(TraceRequest::default()));
        }
        let traces = self.traces.as_ref().expect("they were just computed");
        (&self.completed, traces)
    }
}

impl PyReconstruction {
    /// `estimate` is the video before it was refitted, if it was; `traces` are those of the brightest spots, where they
    /// are known already.
    pub fn new(
        completed: CompletedTask,
        estimate: Option<Video>,
        traces: Option<Traces>,
        threads: usize,
    ) -> Self {
        Self {
            shape: completed.reconstruction.video.shape(),
            threads,
            state: Arc::new(Mutex::new(State {
                completed,
                video: None,
                estimate,
                traces,
                record: None,
            })),
        }
    }

    /// The same with the record of its run.
    pub fn with_record(self, record: Option<RunRecord>) -> Self {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.record = record;
        drop(state);
        self
    }

    /// A copy of the video, of a reconstruction whose video numpy does not own yet.
    pub fn copied_video(&self, py: Python<'_>) -> Video {
        self.state(py).completed.reconstruction.video.clone()
    }

    fn state<'a>(&'a self, py: Python<'_>) -> MutexGuard<'a, State> {
        let state = self.state.lock_py_attached(py);
        state.unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets `work` see the whole reconstruction, its video among it, without the interpreter. Ctrl-C is raised at once;
    /// the work then ends in the background.
    fn with<T: Send + 'static>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut State) -> T + Send + 'static,
    ) -> PyResult<T> {
        // Another thread may have held the lock when this process was forked.
        threads::check_process()?;
        let work = Arc::new(Mutex::new(Some(work)));
        loop {
            let lent = self.state(py).video.as_ref().map(|v| v.clone_ref(py));
            // numpy owns the video: a copy for as long as it is needed.
            let copy = match lent {
                Some(array) => {
                    let data = array.bind(py).readonly().as_slice()?.to_vec();
                    Some(Video::new(self.shape, data).map_err(to_py_err)?)
                }
                None => None,
            };
            let (state, work) = (Arc::clone(&self.state), Arc::clone(&work));
            let done = interruptibly::<(), _>(py, None, None, move |_| {
                let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
                match (state.video.is_some(), copy) {
                    (true, Some(copy)) => state.completed.reconstruction.video = copy,
                    (false, _) => (),
                    // Another thread has just asked for it.
                    (true, None) => return None,
                }
                let work = work.lock().unwrap_or_else(PoisonError::into_inner).take();
                let done = work.expect("it is done once")(&mut state);
                if state.video.is_some() {
                    state.completed.reconstruction.video = placeholder();
                }
                Some(done)
            })?;
            if let Some(done) = done {
                return Ok(done);
            }
        }
    }
}

/// Stands for the video where numpy owns it.
fn placeholder() -> Video {
    Video::zeros(Shape::new(1, 1, 1))
}

#[pymethods]
impl PyReconstruction {
    #[getter]
    fn video<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let mut state = self.state(py);
        if let Some(array) = &state.video {
            return Ok(array.bind(py).clone());
        }
        let video = std::mem::replace(&mut state.completed.reconstruction.video, placeholder());
        let array = from_video(py, video)?;
        make_read_only(&array)?;
        state.video = Some(array.clone().unbind());
        Ok(array)
    }

    /// The camera of the frame, or of its plane.
    #[getter]
    fn _camera(&self, py: Python<'_>) -> PyCamera {
        self.state(py).completed.task.camera.clone().into()
    }

    #[getter]
    fn background<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray3<f32>>>> {
        let background = self.state(py).completed.reconstruction.background.clone();
        background.map(|v| from_video(py, v)).transpose()
    }

    #[getter]
    fn residual<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let residual = self
            .state(py)
            .completed
            .reconstruction
            .normalised_residual
            .clone();
        from_image(py, residual)
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<Stored<'py>> {
        let (this, py) = (slf.get(), slf.py());
        // The video goes to numpy first, so that it is not copied for the state.
        let video = this.video(py)?;
        let estimate = this.state(py).estimate.clone();
        let state = state::of_completed(py, &this.state(py).completed, video)?;
        let estimate = estimate.map(|video| from_video(py, video)).transpose()?;
        state.set_item("estimate", estimate)?;
        state.set_item("threads", this.threads)?;
        let record = this.state(py).record.clone();
        let record = record.map(|r| serde_json::to_string(&r).expect("plain numbers and text"));
        state.set_item("record", record)?;
        Ok((slf.get_type().getattr("_restore")?, (state,)))
    }

    /// The result of what `__reduce__` gives.
    #[classmethod]
    fn _restore(_cls: &Bound<'_, PyType>, state: &Bound<'_, PyDict>) -> PyResult<Self> {
        let threads = entry(state, "threads")?.extract()?;
        let completed = state::to_completed(state)?;
        let estimate = optional_entry(state, "estimate")?;
        let estimate = estimate.map(|v| video(&v, "estimate")).transpose()?;
        let record: Option<String> = entry(state, "record")?.extract()?;
        let record = record.map(|text| {
            let record = serde_json::from_str(&text);
            record.map_err(|error| PyValueError::new_err(format!("state: record: {error}")))
        });
        let result = Self::new(completed, estimate, None, threads);
        Ok(result.with_record(record.transpose()?))
    }

    /// The numbers of `result.json`, as its text.
    fn _json(&self, py: Python<'_>) -> PyResult<String> {
        let threads = self.threads;
        self.with(py, move |state| {
            let (completed, traces) = state.with_spots();
            let mut summary = completed.summary(traces);
            summary.threads = threads;
            serde_json::to_string(&summary).expect("plain numbers and text")
        })
    }

    #[getter]
    fn prior(&self, py: Python<'_>) -> String {
        self.state(py).completed.reconstruction.prior.to_string()
    }

    #[getter]
    fn tau(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.reconstruction.tau
    }

    #[getter]
    fn noise_sigma(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.reconstruction.sigma
    }

    #[getter]
    fn effective_sigma(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.reconstruction.effective_sigma
    }

    #[getter]
    fn excluded<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u8>>> {
        let state = self.state(py);
        let frame = state.completed.task.measurement.image();
        let excluded = &state.completed.reconstruction.excluded;
        PyArray1::from_slice(py, excluded).reshape([frame.rows(), frame.columns()])
    }

    #[getter]
    fn excluded_fraction(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.reconstruction.excluded_fraction()
    }

    #[getter]
    fn stray_light<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let state = self.state(py);
        let light = state.completed.reconstruction.stray_light.as_ref();
        let array = |light: &Image| {
            PyArray1::from_slice(py, light.data()).reshape([light.rows(), light.columns()])
        };
        light.map(array).transpose()
    }

    #[getter]
    fn stray_light_fraction(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.stray_light_fraction()
    }

    /// The PSF as the frame has corrected it; `None`: it was used as given.
    #[getter]
    fn corrected_psf(&self, py: Python<'_>) -> Option<PyPsf> {
        let state = self.state(py);
        let calibration = state.completed.reconstruction.calibration.as_ref()?;
        let psfs = calibration.psfs.clone();
        Some(PyPsf { psfs })
    }

    #[getter]
    fn coverage<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        let shape = self.shape;
        let state = self.state(py);
        PyArray1::from_slice(py, &state.completed.reconstruction.coverage).reshape([
            shape.bins,
            shape.rows,
            shape.columns,
        ])
    }

    #[getter]
    fn coverage_fraction(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.reconstruction.coverage_fraction()
    }

    #[getter]
    fn residual_over_sigma(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.reconstruction.residual_over_sigma
    }

    #[getter]
    fn iterations(&self, py: Python<'_>) -> usize {
        self.state(py).completed.reconstruction.iterations
    }

    #[getter]
    fn stop_reason(&self, py: Python<'_>) -> &'static str {
        self.state(py).completed.reconstruction.stop_reason.name()
    }

    #[getter]
    fn fit(&self, py: Python<'_>) -> &'static str {
        self.state(py).completed.reconstruction.fit.verdict.name()
    }

    #[getter]
    fn fit_reason(&self, py: Python<'_>) -> String {
        self.state(py).completed.reconstruction.fit.reason.clone()
    }

    #[getter]
    fn seconds(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.seconds
    }

    #[getter]
    fn setup_seconds(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.setup_seconds
    }

    #[getter]
    fn frame_rate_hz(&self, py: Python<'_>) -> f64 {
        self.state(py).completed.task.camera.time().frame_rate_hz()
    }

    /// `(y, x, rows, columns)`, value, debiased and standard error of each trace, and their
    /// numbers as JSON.
    fn _traces<'py>(
        &self,
        py: Python<'py>,
        regions: Vec<String>,
        photodiodes: Vec<PathBuf>,
    ) -> PyResult<(Vec<Bound<'py, PyDict>>, String)> {
        let request = TraceRequest::read(&regions, &photodiodes, self.shape).map_err(to_py_err)?;
        let is_plain = regions.is_empty() && photodiodes.is_empty();
        let (traces, numbers) = self.with(py, move |state| {
            let requested = (!is_plain).then(|| state.traces_of(request));
            let (completed, spots) = state.with_spots();
            let selected = requested.as_ref().unwrap_or(spots);
            let numbers = selected.trace_numbers(completed.task.truth.as_ref());
            let numbers =
                serde_json::json!({ "traces": numbers, "errors": selected.standard_errors });
            (selected.traces.clone(), numbers.to_string())
        })?;
        let dicts = traces.iter().map(|trace| {
            let dict = PyDict::new(py);
            let r = trace.region;
            dict.set_item("region", (r.y, r.x, r.rows, r.columns))?;
            dict.set_item("value", PyArray1::from_slice(py, &trace.value))?;
            dict.set_item("debiased", PyArray1::from_slice(py, &trace.debiased))?;
            let errors = PyArray1::from_slice(py, &trace.standard_error);
            dict.set_item("standard_error", errors)?;
            Ok(dict)
        });
        Ok((dicts.collect::<PyResult<_>>()?, numbers))
    }

    /// The page of the report.
    fn _report(&self, py: Python<'_>, title: String) -> PyResult<String> {
        let page = self.with(py, move |state| {
            let (completed, traces) = state.with_spots();
            let report_meta = ReportMeta {
                title: &title,
                reproduce: None,
                files: Vec::new(),
            };
            completed
                .report(traces, report_meta, player_of(Path::new(&title)))
                .map(|report| report.html)
        })?;
        page.map_err(to_py_err)
    }

    /// The figure of `rowburst figure`: SVG, PNG and PDF.
    fn _figure<'py>(&self, py: Python<'py>, layout: &str) -> PyResult<FigureFiles<'py>> {
        let layout = layout_of(layout).map_err(to_py_err)?;
        let figure = self.with(py, move |state| {
            let (completed, traces) = state.with_spots();
            completed.figure(traces, "Rowburst", &layout.into())
        })?;
        files_of(py, figure.map_err(to_py_err)?)
    }

    /// Writes all files of `rowburst reconstruct` into a folder; `formats` are those of the video, such as `npy,tif`.
    #[pyo3(signature = (folder, title, formats=None))]
    fn _save(
        &self,
        py: Python<'_>,
        folder: PathBuf,
        title: String,
        formats: Option<&str>,
    ) -> PyResult<()> {
        let formats = formats.map(VideoFormat::parse_list).transpose();
        let formats = formats.map_err(to_py_err)?;
        let saved = self.with(py, move |state| {
            let folder = OutputFolder::claim(&folder, "reconstruct", ForeignFiles::Accept)?;
            let record = state.record.clone().map(|record| RunRecord {
                options: record
                    .options
                    .with_files(MovieStyle::Stamped, formats.clone()),
                ..record
            });
            let (completed, traces) = state.with_spots();
            let output = Output {
                folder: &folder,
                title: &title,
                reproduce: record.as_ref().map(|record| record.command.as_str()),
                movie: MovieStyle::Stamped,
                formats: formats.as_deref(),
                record: record.as_ref(),
            };
            completed.write(traces, &output).map(|_| ())
        })?;
        saved.map_err(to_py_err)
    }
}

/// Writes the files of `rowburst reconstruct` for a raw colour frame: a folder for each plane, the video in colour, and
/// `result.json`. A plane has its name, its start in microseconds and its result.
#[pyfunction]
pub fn _save_colour(
    py: Python<'_>,
    folder: PathBuf,
    title: &str,
    bayer: &str,
    planes: Vec<(String, f64, Py<PyReconstruction>)>,
) -> PyResult<()> {
    let mosaic = mosaic_of(bayer).map_err(to_py_err)?;
    let folder = detached(py, || {
        OutputFolder::claim(&folder, "reconstruct", ForeignFiles::Accept)
    })?;
    let folder = folder.map_err(to_py_err)?;
    let output = Output {
        folder: &folder,
        title,
        reproduce: None,
        movie: MovieStyle::Stamped,
        formats: None,
        record: None,
    };
    let mut colour = ColourFolder::begin(&output, mosaic).map_err(to_py_err)?;
    let mut from_metadata = None;
    for (name, start_us, plane) in &planes {
        let site = mosaic.sites().into_iter().find(|site| site.name() == *name);
        let site = site.ok_or_else(|| PyValueError::new_err(format!("planes: found {name}")))?;
        let plane = plane.get();
        // numpy owns the video from now on; the state has a copy for as long as it is needed.
        let data = plane.video(py)?.readonly().as_slice()?.to_vec();
        let copy = Video::new(plane.shape, data).map_err(to_py_err)?;
        let written = detached(py, || {
            let mut state = plane.state.lock().unwrap_or_else(PoisonError::into_inner);
            state.completed.reconstruction.video = copy;
            let (completed, traces) = state.with_spots();
            let written = colour.write_plane(site, *start_us, completed, traces);
            from_metadata.get_or_insert_with(|| completed.task.from_metadata.clone());
            state.completed.reconstruction.video = placeholder();
            written
        })?;
        written.map_err(to_py_err)?;
    }
    let finished = detached(py, || colour.finish(&from_metadata.unwrap_or_default()))?;
    finished.map(|_| ()).map_err(to_py_err)
}

/// A figure as SVG, PNG and PDF.
type FigureFiles<'py> = (String, Bound<'py, PyBytes>, Bound<'py, PyBytes>);

fn files_of(py: Python<'_>, figure: ComposedFigure) -> PyResult<FigureFiles<'_>> {
    let pdf = detached(py, || figure.pdf())?.map_err(to_py_err)?;
    Ok((
        figure.svg,
        PyBytes::new(py, &figure.png),
        PyBytes::new(py, &pdf),
    ))
}

/// The figure of a result folder: SVG, PNG and PDF.
#[pyfunction]
#[pyo3(name = "_figure_of_folder")]
pub fn figure_from_folder<'py>(
    py: Python<'py>,
    folder: PathBuf,
    layout: &str,
) -> PyResult<FigureFiles<'py>> {
    let layout = layout_of(layout).map_err(to_py_err)?;
    let figure = detached(py, || figure_of_folder(&folder, &layout.into()))?.map_err(to_py_err)?;
    files_of(py, figure)
}

fn layout_of(name: &str) -> rowburst::Result<Layout> {
    match name {
        "fig2" => Ok(Layout::Fig2),
        "fig3" => Ok(Layout::Fig3),
        _ => Err(Error::input(
            Parameter::Layout,
            format!("\"{name}\""),
            "a layout is \"fig2\" or \"fig3\"",
            "Leave it out for \"fig2\".",
        )),
    }
}
