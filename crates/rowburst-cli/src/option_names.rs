//! The names of the command line for parameters and tools.

use rowburst::error::{LibraryNames, Names, Tool};
use rowburst::{Error, ErrorKind, Parameter};

/// The message of `error`, with options in place of parameters.
pub fn message(error: &Error) -> String {
    error.message(&CommandLine)
}

/// The names of the command line.
pub struct CommandLine;

impl Names for CommandLine {
    fn name(&self, parameter: Parameter) -> String {
        option(parameter).map_or_else(|| parameter.name().to_string(), String::from)
    }

    fn subject(&self, parameter: Parameter) -> String {
        match parameter {
            // Files are known by what they hold.
            Parameter::Frame
            | Parameter::Dark
            | Parameter::Flat
            | Parameter::BadPixels
            | Parameter::Signal
            | Parameter::Photodiode => parameter.name().to_string(),
            _ if parameter == Parameter::Psf || option(parameter).is_none() => {
                LibraryNames.subject(parameter)
            }
            _ => self.name(parameter),
        }
    }

    fn setting(&self, parameter: Parameter, value: &str) -> String {
        match option(parameter).filter(|option| option.starts_with('-')) {
            Some(option) => format!("{option} {value}"),
            None => format!("{} = {value}", parameter.name()),
        }
    }

    fn with(&self, parameter: Parameter) -> String {
        format!(" with {}", self.name(parameter))
    }

    fn tool(&self, tool: Tool) -> String {
        match tool {
            Tool::CalibratePatches => "`rowburst calibrate psf --positions-mm`".to_string(),
            tool => format!("`rowburst {}`", tool.name()),
        }
    }

    fn remedy(&self, error: &Error) -> Option<String> {
        match (error.parameter()?, error.kind()) {
            (Parameter::Psf, ErrorKind::Missing) => {
                Some("Give --psf FILE, or psf = \"FILE\" under [calibration].".to_string())
            }
            (Parameter::FramePeriodUs, ErrorKind::Missing) => Some(
                "Give --frame-period-us, or frame_period_us under [recording] in the experiment."
                    .to_string(),
            ),
            (Parameter::Write, ErrorKind::Unknown) => Some(
                "Name one or more of them, with commas between them and no spaces.".to_string(),
            ),
            _ => None,
        }
    }
}

/// The option of a parameter, or its table of the experiment file; `None` for keys of a table.
fn option(parameter: Parameter) -> Option<&'static str> {
    Some(match parameter {
        Parameter::Frame => "--frame",
        Parameter::Replace => "--replace",
        Parameter::Psf => "--psf",
        Parameter::Dark => "--dark",
        Parameter::Flat => "--flat",
        Parameter::BadPixels => "--bad-pixels",
        Parameter::Darks => "--darks",
        Parameter::Flats => "--flats",
        Parameter::DarksAndFlats => "--darks and --flats",
        Parameter::PositionsMm => "--positions-mm",
        Parameter::PinholeUm => "--pinhole-um",
        Parameter::ExposuresMs => "--exposures-ms",
        Parameter::Truth => "--truth",
        Parameter::Direct => "--direct",
        Parameter::Guide => "--guide",
        Parameter::GuideModel => "--guide-model",
        Parameter::GuideTimesUs => "--guide-times-us",
        Parameter::Scene => "--scene",
        Parameter::Signal => "--signal",
        Parameter::Photodiode => "--photodiode",
        Parameter::Region => "--region",
        Parameter::Experiment => "--experiment",
        Parameter::Output => "-o",
        Parameter::Force => "--force",
        Parameter::Inputs => "--inputs",
        Parameter::Write => "--write",
        Parameter::Camera => "[camera]",
        Parameter::Field => "[field]",
        Parameter::FieldRows => "[field] rows",
        Parameter::FieldColumns => "[field] columns",
        Parameter::FramePeriodUs => "--frame-period-us",
        Parameter::Prior => "--prior",
        Parameter::Tau => "--tau",
        Parameter::NoiseSigma => "--noise-sigma",
        Parameter::MaxIterations => "--max-iterations",
        Parameter::SelfCalibrate => "--self-calibrate",
        Parameter::TimeBudgetS => "--time-budget-s",
        Parameter::Bins => "--bins",
        Parameter::PartBins => "--part-bins",
        Parameter::Seed => "--seed",
        Parameter::Threads => "--threads",
        Parameter::HeightPx => "--digit-px",
        Parameter::Background => "--background",
        Parameter::WavelengthNm => "--wavelength-nm",
        Parameter::DiameterMm => "--pupil-mm",
        Parameter::Na => "--na",
        Parameter::FocalLengthMm | Parameter::ImageDistanceMm => "--focal-length-mm",
        Parameter::Magnification => "--magnification",
        Parameter::DiffuserFwhmDeg => "--diffuser-deg",
        Parameter::RmsPhase => "--diffuser-phase",
        Parameter::Snr => "--snr",
        Parameter::PeakElectrons => "--peak-electrons",
        Parameter::SceneElectrons => "--scene-electrons",
        Parameter::FrequencyHz => "--frequency-hz",
        Parameter::Duty => "--duty",
        Parameter::SuccessMap => "--quick",
        Parameter::TrialSnr => "--trial-snr",
        Parameter::FramesRange => "--frames-range",
        Parameter::Stitch => "--stitch",
        Parameter::Layout => "--layout",
        Parameter::Port => "--port",
        _ => return None,
    })
}

/// The option of `rowburst design`, which has one for each parameter of the camera and of the light as well.
pub fn design_option(parameter: Parameter) -> String {
    match parameter {
        Parameter::Field => "--field-rows and --field-columns".to_string(),
        Parameter::Aperture => "--pupil-mm".to_string(),
        Parameter::ElectronsPerCount => "--full-well-electrons and --bit-depth".to_string(),
        _ => match option(parameter).filter(|option| option.starts_with('-')) {
            Some(option) => option.to_string(),
            None => format!("--{}", parameter.name().replace('_', "-")),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::Cli;
    use clap::CommandFactory;
    use std::collections::HashSet;

    /// The long options of `command` and of its verbs.
    fn long_options(command: &clap::Command, found: &mut HashSet<String>) {
        found.extend(
            command
                .get_arguments()
                .filter_map(|argument| Some(format!("--{}", argument.get_long()?))),
        );
        for verb in command.get_subcommands() {
            long_options(verb, found);
        }
    }

    #[test]
    fn names_options_that_exist() {
        let mut known = HashSet::new();
        long_options(&Cli::command(), &mut known);
        for parameter in Parameter::ALL {
            let words = option(*parameter).unwrap_or_default().split(' ');
            for word in words.filter(|word| word.starts_with("--")) {
                assert!(known.contains(word), "{parameter}: {word}");
            }
        }
    }

    #[test]
    fn says_what_the_command_line_takes() {
        let error = Error::input(Parameter::Psf, "no PSF", "a PSF is needed", "Give the PSF.")
            .with_kind(ErrorKind::Missing);
        assert!(message(&error).contains("--psf FILE"), "{error:?}");
        let error = Error::input(Parameter::Write, "\"avi\"", "npy, tif", "Name some.")
            .with_kind(ErrorKind::Unknown);
        assert!(message(&error).contains("commas"), "{error:?}");
    }
}
