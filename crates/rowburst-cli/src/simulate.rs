//! `rowburst simulate`: the frame that a camera would record of a scene.

use crate::args::SimulateArgs;
use crate::output::print_line;
use crate::progress::print_note;
use crate::shared_args::OpticsArgs;
use rowburst::Result;
use rowburst_io::Experiment;
use rowburst_run::simulate::{LensOptics, NoiseChoice, SimulationRequest};

pub fn run(args: &SimulateArgs) -> Result<()> {
    let noise = match (args.peak_electrons, args.scene_electrons) {
        (Some(electrons), _) => NoiseChoice::PeakElectrons(electrons),
        (None, Some(electrons)) => NoiseChoice::SceneElectrons(electrons),
        (None, None) => NoiseChoice::Snr(args.snr),
    };
    let folder = args.force.claim(&args.output, "simulate")?;
    let request = SimulationRequest {
        experiment: Experiment::read(&args.experiment)?,
        scene: &args.scene,
        background: args.background,
        psf: args.psf.as_deref(),
        noise,
        seed: args.seed,
        digit_px: args.digit_px,
        diffuser_phase: args.diffuser_phase,
        optics: args.optics.lens(),
        guide_times_us: &args.guide_times_us,
        captures: args.captures,
    };
    request.run(&folder, &mut print_note)?;
    let folder = args.output.display();
    print_line(format_args!("{folder}/frame.npy\n{folder}/experiment.toml"));
    eprintln!(
        "next: rowburst reconstruct {folder}/experiment.toml --frame {folder}/frame.npy --truth {folder}/truth.npy -o RESULT"
    );
    Ok(())
}

impl OpticsArgs {
    /// These options as optics.
    pub fn lens(&self) -> LensOptics {
        LensOptics {
            wavelength_nm: self.wavelength_nm,
            pupil_mm: self.pupil_mm,
            focal_length_mm: self.focal_length_mm,
            magnification: self.magnification,
            na: self.na,
            diffuser_deg: self.diffuser_deg,
        }
    }
}
