//! Whether the frame fits its PSF and its camera in another orientation: a slip in how it was saved.
//!
//! Where the first check of the model predicts little, the frame is turned and mirrored. Few iterations of the same check
//! tell whether it then is predicted. A mirrored frame and a mirrored PSF are the same but for a mirrored scene.

use super::choose::Observer;
use super::held_out_check::{FIRST_CHECK_ITERATION, HeldOutCheck, HeldOutRun};
use super::{Prior, Problem, RunResult};
use rowburst_optics::Image;
use rowburst_optics::measurement::Measurement;
use rowburst_solve::admm::TauRule;
use tracing::info;

/// Part of the variation that a turned frame leaves unpredicted over that of the frame as given, below which the frame is
/// turned; larger takes chance for a slip.
const MAX_RATIO: f64 = 0.5;

/// How a frame was turned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Orientation {
    Transposed,
    UpsideDown,
    Mirrored,
    HalfTurn,
}

impl Orientation {
    const ALL: [Self; 4] = [
        Self::Transposed,
        Self::UpsideDown,
        Self::Mirrored,
        Self::HalfTurn,
    ];

    /// What is wrong, as a sentence for the verdict.
    pub fn finding(self) -> &'static str {
        match self {
            Self::Transposed => "the frame is transposed, with rows for columns",
            Self::UpsideDown => "the frame or the PSF is upside down",
            Self::Mirrored => "the frame or the PSF is mirrored left to right",
            Self::HalfTurn => "the frame or the PSF is turned by half",
        }
    }

    /// The frame turned back; `None` where it would have another size.
    fn undone(self, image: &Image) -> Option<Image> {
        let (rows, columns) = (image.rows(), image.columns());
        if self == Self::Transposed && rows != columns {
            return None;
        }
        Some(Image::from_fn(rows, columns, |y, x| match self {
            Self::Transposed => image.at(x, y),
            Self::UpsideDown => image.at(rows - 1 - y, x),
            Self::Mirrored => image.at(y, columns - 1 - x),
            Self::HalfTurn => image.at(rows - 1 - y, columns - 1 - x),
        }))
    }
}

impl Problem {
    /// The orientation in which the frame is predicted, where `check` predicts little of it as given. The error is the
    /// result so far of a run that the observer stopped; it has no iterations, since it is of a turned frame.
    pub(super) fn find_orientation(
        &mut self,
        check: &HeldOutCheck,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<Option<Orientation>, Box<RunResult>> {
        let mut best = (MAX_RATIO * check.unpredicted, None);
        let mut stopped = None;
        for orientation in Orientation::ALL {
            let Some(image) = orientation.undone(self.measurement.image()) else {
                continue;
            };
            let turned = Measurement::new(image).expect("values that were finite");
            self.data.set_frame(&turned);
            match self.short_check(prior, observer) {
                Ok(unpredicted) if unpredicted < best.0 => best = (unpredicted, Some(orientation)),
                Ok(_) => {}
                Err(mut partial) => {
                    partial.solution.iterations = 0;
                    stopped = Some(partial);
                    break;
                }
            }
        }
        self.data.set_frame(&self.measurement);
        match stopped {
            Some(partial) => Err(partial),
            None => Ok(best.1),
        }
    }

    /// The part of the frame that few iterations do not predict.
    fn short_check(
        &mut self,
        prior: Prior,
        observer: &mut Observer,
    ) -> Result<f64, Box<RunResult>> {
        let rule = TauRule::Discrepancy {
            sigma: self.effective_sigma,
        };
        let settings = self.options.solver_settings();
        let mut run = HeldOutRun::new(&mut self.data, prior, rule, settings);
        run.run(&mut self.data, FIRST_CHECK_ITERATION, observer)?;
        let check = HeldOutCheck::of(&run, &self.data);
        info!(
            "turned frame: {:.3} of it are not predicted",
            check.unpredicted
        );
        Ok(check.unpredicted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_turn_is_its_own_inverse() {
        let image = Image::from_fn(4, 4, |y, x| (y * 4 + x) as f32);
        for orientation in Orientation::ALL {
            let turned = orientation.undone(&image).unwrap();
            assert_ne!(turned, image);
            assert_eq!(orientation.undone(&turned).unwrap(), image);
        }
        let wide = Image::from_fn(2, 3, |y, x| (y * 3 + x) as f32);
        assert!(Orientation::Transposed.undone(&wide).is_none());
        assert_eq!(Orientation::HalfTurn.undone(&wide).unwrap().at(0, 0), 5.0);
    }
}
