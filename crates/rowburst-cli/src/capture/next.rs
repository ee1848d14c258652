//! The command that follows a capture.

use super::{Purpose, project};
use std::path::Path;

/// The next command: that of the folder's status, or else what the capture is for.
pub fn next_command(purpose: Purpose, output: &Path) -> String {
    if let Some(steps) = project().and_then(|p| p.status().ok()) {
        let step = steps.into_iter().find(|step| step.state.is_open());
        return step.map_or("rowburst status".into(), |step| step.command);
    }
    let file = output.display();
    match purpose {
        Purpose::Frame => {
            format!("rowburst reconstruct experiment.toml --frame {file} --psf PSF -o result")
        }
        Purpose::Darks => format!(
            "rowburst capture flats, then rowburst calibrate sensor --darks {file} --flats FLATS -o sensor"
        ),
        Purpose::Flats => {
            format!("rowburst calibrate sensor --darks DARKS --flats {file} -o sensor")
        }
        Purpose::Psf | Purpose::PsfAgain => format!("rowburst calibrate psf {file} -o psf"),
        Purpose::Timing => format!("rowburst calibrate timing {file} --frequency-hz HZ -o timing"),
        Purpose::Record => {
            format!("rowburst batch experiment.toml --frames {file} --psf PSF -o videos.zarr")
        }
    }
}
