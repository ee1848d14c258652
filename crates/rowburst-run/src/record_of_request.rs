//! The record of a request: what is read and asked for, with the hashes of the files.

use crate::guide::guide_files;
use crate::inputs::resolve_calibration;
use crate::record::{CameraNumbers, InputFile, OptionNumbers, RunRecord, role, utc_now};
use crate::request::RequestParams;
use rowburst::Result;
use rowburst::reconstruct::Tau;
use rowburst_io::{Experiment, patch_set_stack, psf_capture_path, sha256};
use std::path::{Path, PathBuf};

impl RunRecord {
    /// The record of a run that starts now. Reads all inputs for their hashes.
    ///
    /// # Errors
    /// An input that cannot be read.
    pub fn new(
        experiment: &Experiment,
        frame: &Path,
        params: &RequestParams,
        command: &str,
    ) -> Result<Self> {
        let calibration = resolve_calibration(params.calibration.clone(), experiment);
        let mut files: Vec<(&str, PathBuf)> = vec![
            (role::EXPERIMENT, experiment.path.clone()),
            (role::FRAME, frame.into()),
        ];
        let optional = [
            (role::PSF, &calibration.psf),
            (role::DARK, &calibration.dark),
            (role::FLAT, &calibration.flat),
            (role::BAD_PIXELS, &calibration.bad_pixels),
            (role::TRUTH, &params.truth.map(Path::to_path_buf)),
            (role::DIRECT, &params.direct.map(Path::to_path_buf)),
        ];
        for (role, path) in optional {
            files.extend(path.clone().map(|path| (role, path)));
        }
        let stack = calibration.psf.as_deref().and_then(patch_set_stack);
        files.extend(stack.map(|path| (role::PSF_STACK, path)));
        let capture = calibration.psf.as_deref().map(psf_capture_path);
        let capture = capture.filter(|path| path.is_file());
        files.extend(capture.map(|path| (role::PSF_CAPTURE, path)));
        let diodes = params.photodiodes.iter();
        files.extend(diodes.map(|path| (role::PHOTODIODE, path.clone())));
        let guides = guide_files(params.guides, experiment).into_iter();
        files.extend(guides.map(|guide| (role::GUIDE, guide.image)));
        let inputs = files.into_iter().map(|(role, path)| {
            Ok(InputFile {
                role: role.into(),
                sha256: sha256(&path)?,
                path: path.to_string_lossy().into_owned(),
            })
        });
        Ok(Self {
            date: utc_now(),
            command: command.into(),
            camera: CameraNumbers::new(experiment),
            options: OptionNumbers::of_request(experiment, params),
            inputs: inputs.collect::<Result<_>>()?,
            video_sha256: None,
        })
    }
}

impl OptionNumbers {
    pub(crate) fn of_request(experiment: &Experiment, params: &RequestParams) -> Self {
        let of_file = &experiment.reconstruction;
        let owned = |text: Option<&str>| text.map(str::to_string);
        let options = &params.options;
        Self {
            prior: owned(options.prior).or(of_file.prior.clone()),
            tau: owned(options.tau).or(of_file.tau.map(tau_text)),
            noise_sigma: options.noise_sigma,
            self_calibrate: owned(options.self_calibrate),
            keep_all_pixels: options.keep_all_pixels,
            max_iterations: options.max_iterations,
            time_budget_s: options.time_budget_s,
            bins: params.bins.as_ref().map(|bins| [bins.start, bins.end]),
            part_bins: params.bins_per_chunk,
            debias: params.debias,
            seed: params.seed,
            guide_model: owned(params.guide_model),
            guide_exposures_us: guide_files(params.guides, experiment)
                .iter()
                .map(|guide| {
                    guide
                        .time_us
                        .map(|time| [time, guide.exposure_us.unwrap_or(0.0)])
                })
                .collect(),
            regions: params.regions.to_vec(),
            no_stamp: false,
            write: None,
        }
    }
}

fn tau_text(tau: Tau) -> String {
    match tau {
        Tau::Auto => "auto".into(),
        Tau::HeldOut => "held-out".into(),
        Tau::Given(tau) => tau.to_string(),
    }
}
