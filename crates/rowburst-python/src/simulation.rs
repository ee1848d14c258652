//! `rowburst.simulate`.

use crate::array::{finite_image, from_image, from_video, is_array, path_of, video};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::interrupt::interruptibly;
use crate::pickle::{State, entry, optional_entry};
use crate::psf::{PyPsf, psfs_of};
use crate::task::threads_from;
use crate::threads::detached;
use crate::whole::{Number, Whole, optional_real};
use numpy::{PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use rowburst::{Image, PatchSet, Video};
use rowburst_io::{Experiment, ForeignFiles, OutputFolder};
use rowburst_run::simulate::{
    CaptureFiles, LensOptics, NoiseChoice, Scene, Simulation, SimulationNames, pixel_pitch_um,
    simulate as simulated, speckle_for,
};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Rms phase of the diffuser of a computed PSF, in radians.
const DIFFUSER_PHASE: f64 = 4.0;

/// A simulated capture with all that is known of it.
#[pyclass(name = "Simulation", module = "rowburst", frozen)]
pub struct PySimulation {
    camera: PyCamera,
    psfs: PatchSet,
    /// Bias included.
    frame: Image,
    truth: Video,
    direct: Image,
    background: Option<Image>,
    noise_sigma: f64,
    /// `(y, x, frequency_hz, phase)` of each LED.
    leds: Vec<(f64, f64, f64, f64)>,
    /// The seed of the scene of LEDs, if it is that.
    leds_seed: Option<u64>,
    /// The content of `simulation.json`, but for the light of the background.
    record: Value,
}

#[pymethods]
impl PySimulation {
    /// The camera that recorded the frame.
    #[getter]
    fn camera(&self) -> PyCamera {
        self.camera.clone()
    }

    /// The PSF that the frame was made with.
    #[getter]
    fn psf(&self) -> PyPsf {
        PyPsf {
            psfs: self.psfs.clone(),
        }
    }

    /// The frame as :func:`reconstruct` takes it.
    ///
    /// Integers where the camera has a bias, as a sensor gives them; without noise, floating-point numbers
    /// without the bias. float32 where the camera has none.
    #[getter]
    fn frame<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let bias = self.camera.camera.sensor().bias_counts.unwrap_or(0.0);
        let mut frame = self.frame.clone();
        if bias == 0.0 {
            return Ok(from_image(py, frame)?.into_any());
        }
        // `reconstruct` takes the bias off integers alone.
        if frame.data().iter().all(|p| p.fract() == 0.0 && *p >= 0.0) {
            let dtype = if frame.max() <= f32::from(u16::MAX) {
                "uint16"
            } else {
                "uint32"
            };
            return from_image(py, frame)?.call_method1("astype", (dtype,));
        }
        frame.data_mut().iter_mut().for_each(|p| *p -= bias as f32);
        Ok(from_image(py, frame)?.into_any())
    }

    /// The video ``[t, y, x]``, in counts of the frame.
    #[getter]
    fn truth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        from_video(py, self.truth.clone())
    }

    /// The frame of the same camera without the diffuser.
    #[getter]
    fn direct<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        from_image(py, self.direct.clone())
    }

    /// The static background ``[y, x]`` in ``truth``, in counts; None without one.
    #[getter]
    fn background<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let background = self.background.clone();
        background.map(|b| from_image(py, b)).transpose()
    }

    /// Standard deviation of the noise, in counts.
    #[getter]
    fn noise_sigma(&self) -> f64 {
        self.noise_sigma
    }

    /// ``(y, x, frequency_hz, phase)`` of each LED.
    #[getter]
    fn leds(&self) -> Vec<(f64, f64, f64, f64)> {
        self.leds.clone()
    }

    /// Writes the files of ``rowburst simulate`` into a folder, which is returned.
    ///
    /// They are ``experiment.toml``, ``frame.npy``, ``psf.npy``, ``truth.npy`` and ``simulation.json``:
    /// ``rb.reconstruct(folder / "frame.npy", rb.Experiment(folder / "experiment.toml"))`` runs as it stands.
    ///
    /// Parameters
    /// ----------
    /// folder : path
    ///     The folder.
    ///
    /// Returns
    /// -------
    /// pathlib.Path
    ///     The folder.
    ///
    /// Raises
    /// ------
    /// WorkError
    ///     A file cannot be written.
    ///
    /// Examples
    /// --------
    /// >>> folder = rb.simulate(camera, "moving", psf).save("simulated")
    /// >>> rb.Experiment(folder / "experiment.toml").camera == camera
    /// True
    #[allow(clippy::doc_lazy_continuation)]
    fn save<'py>(&self, py: Python<'py>, folder: PathBuf) -> PyResult<Bound<'py, PyAny>> {
        let experiment = Experiment {
            bayer: self.camera.bayer,
            ..Experiment::new(self.camera.camera.params().clone())
        };
        let write = || {
            let output = OutputFolder::claim(&folder, "simulate", ForeignFiles::Accept)?;
            CaptureFiles {
                experiment: &experiment,
                psfs: &self.psfs,
                frame: &self.frame,
                truth: &self.truth,
                background: self.background.as_ref(),
                direct: &self.direct,
                photodiodes_of: self.leds_seed,
                captures: false,
                guide_times_us: &[],
                seed: 0,
                record: self.record.clone(),
            }
            .write(&output)
        };
        detached(py, write)?.map_err(to_py_err)?;
        py.import("pathlib")?.getattr("Path")?.call1((folder,))
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<State<'py>> {
        let (this, py) = (slf.get(), slf.py());
        let state = PyDict::new(py);
        state.set_item("camera", this.camera())?;
        state.set_item("psf", this.psf())?;
        state.set_item("frame", from_image(py, this.frame.clone())?)?;
        state.set_item("truth", this.truth(py)?)?;
        state.set_item("direct", this.direct(py)?)?;
        state.set_item("background", this.background(py)?)?;
        state.set_item("noise_sigma", this.noise_sigma)?;
        state.set_item("leds", this.leds())?;
        state.set_item("leds_seed", this.leds_seed)?;
        state.set_item("record", this.record.to_string())?;
        Ok((slf.get_type().getattr("_restore")?, (state,)))
    }

    /// The simulation of what `__reduce__` gives.
    #[classmethod]
    fn _restore(_cls: &Bound<'_, PyType>, state: &Bound<'_, PyDict>) -> PyResult<Self> {
        let background = optional_entry(state, "background")?;
        let background = background.map(|value| finite_image(&value, "background"));
        Ok(Self {
            camera: entry(state, "camera")?.extract()?,
            psfs: entry(state, "psf")?.cast::<PyPsf>()?.get().psfs.clone(),
            frame: finite_image(&entry(state, "frame")?, "frame")?,
            truth: video(&entry(state, "truth")?, "truth")?,
            direct: finite_image(&entry(state, "direct")?, "direct")?,
            background: background.transpose()?,
            noise_sigma: entry(state, "noise_sigma")?.extract()?,
            leds: entry(state, "leds")?.extract()?,
            leds_seed: entry(state, "leds_seed")?.extract()?,
            record: entry(state, "record")?
                .extract::<String>()?
                .parse()
                .map_err(|error| PyValueError::new_err(format!("state: record: {error}")))?,
        })
    }

    fn __repr__(&self) -> String {
        let (shape, frame) = (self.truth.shape(), &self.frame);
        format!(
            "<rowburst.Simulation: a frame of {}×{}, {} bins of {}×{} in truth>",
            frame.rows(),
            frame.columns(),
            shape.bins,
            shape.rows,
            shape.columns
        )
    }

    /// What notebooks show.
    fn _repr_html_(slf: &Bound<'_, Self>) -> PyResult<String> {
        crate::html::of(slf, "simulation_html")
    }
}

/// The frame that a camera records of a scene.
///
/// Parameters
/// ----------
/// camera : Camera
///     The camera.
/// scene : str, path or array, optional
///     ``"digits"`` (the default), ``"leds"``, ``"moving"``, ``"two-moving"``, or a video ``[t, y, x]`` that is fitted to
///     the field.
/// psf : Psf, array or path, optional
///     The point-spread function ``[y, x]``; by default a speckle PSF is computed.
/// snr : float
///     Rms of the noiseless frame over the noise; ``inf`` for none.
/// peak_electrons, scene_electrons : float, optional
///     Shot and read noise instead of ``snr``: electrons in the brightest pixel of the frame, or from the brightest pixel
///     of the scene in a bin. The camera needs gain and read noise.
/// background : float, optional
///     Brightness of a static background over that of the scene.
/// seed : int
///     The seed of scene and noise.
/// digit_px : int
///     Height of the digits in pixels.
/// threads : int, optional
///     Threads of this call alone; by default all those of the process (:func:`threads`).
///
/// Returns
/// -------
/// Simulation
///     The frame with the true video.
///
/// Raises
/// ------
/// InputError
///     An argument breaks a rule.
/// WorkError
///     The machine has too little memory.
///
/// Examples
/// --------
/// >>> made = rb.simulate(camera, "moving", psf, snr=100)
/// >>> made.frame.shape, made.truth.shape
/// ((24, 30), (12, 24, 30))
#[allow(clippy::doc_lazy_continuation)]
#[pyfunction]
#[pyo3(signature = (camera, scene=None, psf=None, *, snr=Number::of(256.0), peak_electrons=None,
    scene_electrons=None, background=None, seed=Whole::of(1), digit_px=Whole::of(12), threads=None),
    text_signature = "(camera, scene=None, psf=None, *, snr=256.0, peak_electrons=None, scene_electrons=None, background=None, seed=1, digit_px=12, threads=None)")]
#[allow(clippy::too_many_arguments)]
pub fn simulate(
    py: Python<'_>,
    camera: &PyCamera,
    scene: Option<&Bound<'_, PyAny>>,
    psf: Option<&Bound<'_, PyAny>>,
    snr: Number,
    peak_electrons: Option<Number>,
    scene_electrons: Option<Number>,
    background: Option<Number>,
    seed: Whole,
    digit_px: Whole,
    threads: Option<Whole>,
) -> PyResult<PySimulation> {
    let threads = threads_from(threads)?;
    let snr = snr.named("snr")?;
    let peak_electrons = optional_real(peak_electrons, "peak_electrons")?;
    let scene_electrons = optional_real(scene_electrons, "scene_electrons")?;
    let background = optional_real(background, "background")?;
    let (seed, digit_px) = (seed.named("seed")? as u64, digit_px.named("digit_px")?);
    let (py_camera, camera) = (camera.clone(), camera.camera.clone());
    crate::memory::check(&camera, 0)?;
    let (name, given) = match scene {
        None => ("digits".to_string(), None),
        Some(value) if is_array(value) => (String::new(), Some(video(value, "scene")?)),
        Some(value) => match value.extract::<String>() {
            Ok(name) => (name, None),
            Err(_) => (String::new(), Some(video(value, "scene")?)),
        },
    };
    let noise = match (peak_electrons, scene_electrons) {
        (Some(electrons), _) => NoiseChoice::PeakElectrons(electrons),
        (None, Some(electrons)) => NoiseChoice::SceneElectrons(electrons),
        (None, None) => NoiseChoice::Snr(snr),
    };
    let psf_file = psf.and_then(path_of);
    let is_speckle = psf.is_none();
    let psfs = psf.map(|p| psfs_of(p, &camera, None)).transpose()?;
    let scene_name = match &given {
        Some(_) => scene
            .and_then(path_of)
            .map_or("an array".into(), |path| path.display().to_string()),
        None => name.clone(),
    };
    let pitch_um = pixel_pitch_um(&camera);
    let made = interruptibly::<(), _>(py, threads, None, move |_| {
        let psfs = match psfs {
            Some(psfs) => psfs,
            None => {
                let optics = LensOptics::demo().optics(pixel_pitch_um(&camera));
                speckle_for(&camera, &optics, DIFFUSER_PHASE, seed)?.into()
            }
        };
        let scene = match given {
            Some(video) => Scene::Video(video),
            None => Scene::read(&name)?,
        };
        let made = simulated(&Simulation {
            camera: &camera,
            psfs: &psfs,
            scene,
            background,
            noise,
            seed,
            digit_height_px: digit_px,
        })?;
        Ok((psfs, made))
    })?;
    let (psfs, made) = made.map_err(to_py_err)?;
    let psf_record = match psf_file {
        Some(path) => json!(path.display().to_string()),
        None if is_speckle => LensOptics::demo().record(DIFFUSER_PHASE, pitch_um),
        None => json!("an array"),
    };
    let record = made.record(&SimulationNames {
        scene: &scene_name,
        background,
        seed,
        noise,
        psf: psf_record,
    });
    let leds = made.leds.iter();
    Ok(PySimulation {
        record,
        leds_seed: (scene_name == "leds").then_some(seed),
        camera: py_camera,
        psfs,
        frame: made.recorded.frame,
        truth: made.truth,
        direct: made.direct,
        background: made.background,
        noise_sigma: made.recorded.sigma,
        leds: leds.map(|l| (l.y, l.x, l.frequency_hz, l.phase)).collect(),
    })
}
