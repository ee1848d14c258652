//! `rowburst.simulate`.

use crate::array::{from_image, from_video, video};
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::psf::{PyPsf, psfs_of};
use numpy::{PyArray2, PyArray3};
use pyo3::prelude::*;
use rowburst::{Camera, PatchSet};
use rowburst_run::inputs::check_memory;
use rowburst_run::simulate::{
    LensOptics, NoiseChoice, Scene, SimulatedCapture, Simulation, pixel_pitch_um,
    simulate as simulated, speckle_for,
};

/// A simulated capture with all that is known of it.
#[pyclass(name = "Simulation", module = "rowburst", frozen)]
pub struct PySimulation {
    camera: Camera,
    psfs: PatchSet,
    made: SimulatedCapture,
}

#[pymethods]
impl PySimulation {
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera {
            camera: self.camera.clone(),
        }
    }

    #[getter]
    fn psf(&self) -> PyPsf {
        PyPsf {
            psfs: self.psfs.clone(),
        }
    }

    #[getter]
    fn frame<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        from_image(py, self.made.recorded.frame.clone())
    }

    #[getter]
    fn truth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        from_video(py, self.made.truth.clone())
    }

    #[getter]
    fn direct<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        from_image(py, self.made.direct.clone())
    }

    #[getter]
    fn background<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        let background = self.made.background.clone();
        background.map(|b| from_image(py, b)).transpose()
    }

    #[getter]
    fn noise_sigma(&self) -> f64 {
        self.made.recorded.sigma
    }

    /// `(y, x, frequency_hz, phase)` of each LED.
    #[getter]
    fn leds(&self) -> Vec<(f64, f64, f64, f64)> {
        let leds = self.made.leds.iter();
        leds.map(|l| (l.y, l.x, l.frequency_hz, l.phase)).collect()
    }
}

/// The frame that a camera records of a scene.
#[pyfunction]
#[pyo3(signature = (camera, scene=None, psf=None, *, snr=256.0, peak_electrons=None,
    scene_electrons=None, background=None, seed=1, digit_px=12))]
#[allow(clippy::too_many_arguments)]
pub fn simulate(
    py: Python<'_>,
    camera: &PyCamera,
    scene: Option<&Bound<'_, PyAny>>,
    psf: Option<&Bound<'_, PyAny>>,
    snr: f64,
    peak_electrons: Option<f64>,
    scene_electrons: Option<f64>,
    background: Option<f64>,
    seed: u64,
    digit_px: usize,
) -> PyResult<PySimulation> {
    let camera = camera.camera.clone();
    check_memory("the video".as_ref(), &camera).map_err(to_py_err)?;
    let name: String;
    let scene = match scene {
        None => Scene::Named("digits"),
        Some(value) => match value.extract::<String>() {
            Ok(text) => {
                name = text;
                Scene::Named(&name)
            }
            Err(_) => Scene::Video(video(value, "scene")?),
        },
    };
    let noise = match (peak_electrons, scene_electrons) {
        (Some(electrons), _) => NoiseChoice::PeakElectrons(electrons),
        (None, Some(electrons)) => NoiseChoice::SceneElectrons(electrons),
        (None, None) => NoiseChoice::Snr(snr),
    };
    let psfs = psf.map(|p| psfs_of(p, &camera, None)).transpose()?;
    let made = py.detach(|| {
        let psfs = match psfs {
            Some(psfs) => psfs,
            None => {
                let optics = LensOptics::demo().optics(pixel_pitch_um(&camera));
                speckle_for(&camera, &optics, 4.0, seed)?.into()
            }
        };
        let made = simulated(&Simulation {
            camera: &camera,
            psfs: &psfs,
            scene,
            background,
            noise,
            seed,
            digit_px,
        })?;
        Ok((psfs, made))
    });
    let (psfs, made) = made.map_err(to_py_err)?;
    Ok(PySimulation { camera, psfs, made })
}
