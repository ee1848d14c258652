//! `rowburst init`: an experiment file for a known camera, with the source of each number.

use crate::args::InitArgs;
use crate::output::print_line;
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Parameter, Result};
use rowburst_io::OutputFolder;
use std::path::Path;

/// The known cameras: the name of each and its experiment file.
const CAMERAS: [(&str, &str); 7] = [
    ("iris-9", include_str!("cameras/iris-9.toml")),
    (
        "orca-flash4.0-v3",
        include_str!("cameras/orca-flash4.0-v3.toml"),
    ),
    ("pco.edge-4.2", include_str!("cameras/pco.edge-4.2.toml")),
    ("pco.edge-5.5", include_str!("cameras/pco.edge-5.5.toml")),
    ("prime-bsi", include_str!("cameras/prime-bsi.toml")),
    ("zyla-4.2", include_str!("cameras/zyla-4.2.toml")),
    ("zyla-5.5", include_str!("cameras/zyla-5.5.toml")),
];

pub fn run(args: &InitArgs) -> Result<()> {
    let text = experiment_of(&args.camera)?;
    let (path, folder) = (&args.output, args.output.parent());
    let name = path.file_name().ok_or_else(|| {
        Error::input(
            Subject::setting(Parameter::Output, path.display()),
            "no name of a file",
            "the experiment is one file",
            "Name a file, such as experiment.toml.",
        )
    })?;
    if path.exists() {
        return Err(Error::input(
            path,
            "a file that is there already",
            "an experiment file is never replaced",
            "Choose another name with -o, or move the file away.",
        )
        .with_kind(ErrorKind::Exists));
    }
    let folder = folder.filter(|folder| !folder.as_os_str().is_empty());
    let folder = OutputFolder::create(folder.unwrap_or(Path::new(".")))?;
    folder.write_bytes(&name.to_string_lossy(), text.as_bytes())?;
    print_line(path.display());
    eprintln!("set rows, columns and what is left open in it; each number says where it is from");
    Ok(())
}

/// The experiment file of a camera. Case, spaces and signs in its name do not matter.
fn experiment_of(camera: &str) -> Result<&'static str> {
    let wanted = letters_and_digits(camera);
    let found = CAMERAS
        .iter()
        .find(|(name, _)| letters_and_digits(name) == wanted);
    match found {
        Some((_, text)) => Ok(text),
        None => Err(Error::input(
            Subject::named("CAMERA"),
            format!("\"{camera}\""),
            format!("the known cameras are {}", CAMERAS.map(|c| c.0).join(", ")),
            "Choose the one most like yours and change its numbers, or start from the \
             experiment.toml that rowburst demo writes.",
        )
        .with_kind(ErrorKind::Unknown)),
    }
}

fn letters_and_digits(name: &str) -> String {
    let signs = name.chars().filter(|c| c.is_alphanumeric());
    signs.flat_map(char::to_lowercase).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_found_as_people_write_it() {
        for written in ["Zyla 4.2", "zyla-4.2", "ZYLA4.2"] {
            assert!(experiment_of(written).unwrap().contains("# Andor Zyla 4.2"));
        }
        assert!(experiment_of("ORCA-Flash4.0 V3").is_ok() && experiment_of("Iris 9").is_ok());
        assert!(experiment_of("Zyla").is_err() && experiment_of("").is_err());
    }
}
