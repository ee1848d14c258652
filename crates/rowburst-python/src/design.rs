//! `rowburst.design`: what a planned set-up can do.

use crate::array::video;
use crate::camera::PyCamera;
use crate::error::to_py_err;
use crate::interrupt::{Answer, OnProgress, interruptibly};
use crate::psf::psfs_of;
use crate::task::threads_from;
use crate::threads::detached;
use crate::whole::{Number, Numbers, Whole, is_bool, optional_real};
use pyo3::prelude::*;
use rowburst::Camera;
use rowburst::design::LightParams;
use rowburst::simulate::SpeckleOptics;
use rowburst::solve::StopReason;
use rowburst_io::{ForeignFiles, OutputFolder};
use rowburst_run::Event;
use rowburst_run::design::{Design, DesignInputs, checked_snrs, light_of, paper_camera};
use rowburst_run::simulate::LensOptics;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Instant;

/// A planned set-up and what it can do.
#[pyclass(name = "_Design", module = "rowburst._rowburst", frozen)]
pub struct PyDesign {
    design: Design,
}

#[pymethods]
impl PyDesign {
    #[new]
    #[pyo3(signature = (camera=None, psf=None, *, wavelength_nm, pupil_mm, focal_length_mm, magnification, na, diffuser_deg,
        photons, bright_pixels, quantum_efficiency, read_noise_electrons, full_well_electrons, source_bandwidth_nm,
        diffuser_path_rms_nm, trials, trial_snrs, seed, progress=None, scene=None, threads=None))]
    #[allow(clippy::too_many_arguments, clippy::fn_params_excessive_bools)]
    fn new(
        py: Python<'_>,
        camera: Option<&PyCamera>,
        psf: Option<&Bound<'_, PyAny>>,
        wavelength_nm: Number,
        pupil_mm: Number,
        focal_length_mm: Number,
        magnification: Number,
        na: Option<Number>,
        diffuser_deg: Number,
        photons: Number,
        bright_pixels: Whole,
        quantum_efficiency: Number,
        read_noise_electrons: Option<Number>,
        full_well_electrons: Option<Number>,
        source_bandwidth_nm: Number,
        diffuser_path_rms_nm: Option<Number>,
        trials: bool,
        trial_snrs: Numbers,
        seed: Whole,
        progress: Option<Py<PyAny>>,
        scene: Option<&Bound<'_, PyAny>>,
        threads: Option<Whole>,
    ) -> PyResult<Self> {
        let began = Instant::now();
        let threads = threads_from(threads)?;
        let trial_snrs = checked_snrs(&trial_snrs.named("trial_snr")?).map_err(to_py_err)?;
        let camera = match camera {
            Some(camera) => camera.camera.clone(),
            None => Camera::new(paper_camera()).map_err(to_py_err)?,
        };
        let psf = psf.map(|psf| psfs_of(psf, &camera, None)).transpose()?;
        let psf = psf.map(|psfs| psfs.central().clone());
        let light = LightParams {
            photons: photons.named("photons")?,
            bright_pixels: bright_pixels.named("bright_pixels")?,
            quantum_efficiency: quantum_efficiency.named("quantum_efficiency")?,
            source_bandwidth_nm: source_bandwidth_nm.named("source_bandwidth_nm")?,
            diffuser_path_rms_nm: optional_real(diffuser_path_rms_nm, "diffuser_path_rms_nm")?,
            ..light_of(
                &camera,
                optional_real(read_noise_electrons, "read_noise_electrons")?,
                optional_real(full_well_electrons, "full_well_electrons")?,
            )
        };
        let optics = LensOptics {
            wavelength_nm: wavelength_nm.named("wavelength_nm")?,
            pupil_mm: pupil_mm.named("pupil_mm")?,
            focal_length_mm: focal_length_mm.named("focal_length_mm")?,
            magnification: magnification.named("magnification")?,
            na: optional_real(na, "na")?,
            diffuser_deg: diffuser_deg.named("diffuser_deg")?,
        };
        let pitch_um = camera.sensor().pixel_pitch_um;
        let inputs = DesignInputs {
            optics: optics.optics(pitch_um.unwrap_or(SpeckleOptics::demo().pixel_pitch_um)),
            camera,
            light,
            psf_file: None,
            trial_snrs,
            scene: scene.map(|scene| video(scene, "scene")).transpose()?,
            seed: seed.named("seed")? as u64,
        };
        let call = |py: Python<'_>, part: f64| {
            let Some(progress) = &progress else {
                return Ok(Answer::Continue);
            };
            let answer = progress.call1(py, (part,))?;
            let answer = answer.bind(py);
            let continues = answer.is_none() || !is_bool(answer)? || answer.is_truthy()?;
            Ok(if continues {
                Answer::Continue
            } else {
                Answer::Finish
            })
        };
        let on_progress: Option<OnProgress<f64>> = match progress {
            Some(_) => Some(&call),
            None => None,
        };
        let found = interruptibly(py, threads, on_progress, move |reporter| {
            let design = inputs.run(psf, trials, began, &mut |event| match event {
                Event::Trials { part, .. } => match reporter.ask(|| part) {
                    Answer::Continue => ControlFlow::Continue(()),
                    Answer::Finish | Answer::Abandon => ControlFlow::Break(StopReason::Interrupted),
                },
                _ => ControlFlow::Continue(()),
            })?;
            Ok(Self { design })
        })?;
        found.map_err(to_py_err)
    }

    fn json(&self) -> String {
        self.design.summary.json()
    }

    /// The numbers in words: headings with pairs of quantity and value.
    fn sections(&self) -> Vec<(String, Vec<(String, String)>)> {
        self.design.summary.sections()
    }

    fn save(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        let write = || {
            let folder = OutputFolder::claim(&folder, "design", ForeignFiles::Accept)?;
            self.design.write(&folder, None)
        };
        detached(py, write)?.map_err(to_py_err)
    }
}
