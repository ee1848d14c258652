//! Where the source of each capture was.

use rowburst::error::Subject;
use rowburst::{Error, Parameter, Result};
use rowburst_run::calibrate::psf::CaptureFile;
use std::path::Path;

/// Place `(y, x)` in millimetres of each of `files`.
pub fn read_positions(csv: &Path, files: &[CaptureFile]) -> Result<Vec<(f64, f64)>> {
    let text = std::fs::read_to_string(csv).map_err(|e| {
        Error::input(
            csv,
            e,
            "the positions of the captures are a text file with lines capture,x_mm,y_mm",
            "Check the path given to --positions-mm.",
        )
    })?;
    let mut positions: Vec<Option<(f64, f64)>> = vec![None; files.len()];
    for (number, line) in text.lines().enumerate() {
        let line = line.trim().trim_start_matches('\u{feff}');
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let subject = Subject::line(csv, number + 1).of(Parameter::PositionsMm);
        let fields: Vec<&str> = line.split([',', ';', '\t']).map(str::trim).collect();
        let numbers: Vec<Option<f64>> = fields.iter().skip(1).map(|f| f.parse().ok()).collect();
        let (x, y) = match numbers[..] {
            [Some(x), Some(y)] if f64::is_finite(x + y) => (x, y),
            // A header names the columns.
            [None, None] if number == 0 => continue,
            _ => {
                return Err(Error::input(
                    subject,
                    format!("\"{line}\""),
                    "a line is capture,x_mm,y_mm: a file name and two numbers",
                    "Write numbers with a decimal point, such as 0.bmp,0.05,0.",
                ));
            }
        };
        let at = which(files, fields[0]).ok_or_else(|| {
            Error::input(
                subject.clone(),
                format!("the capture \"{}\"", fields[0]),
                "each line names one of the captures by its file name",
                "Add the capture to the command line, or take the line out.",
            )
        })?;
        if positions[at].replace((y, x)).is_some() {
            return Err(Error::input(
                subject,
                format!("the capture \"{}\" a second time", fields[0]),
                "each capture has one position",
                "Take one of the two lines out.",
            ));
        }
    }
    let missing = positions.iter().position(Option::is_none);
    if let Some(i) = missing {
        return Err(Error::input(
            csv,
            format!("no line for {}", files[i].file_name()),
            "each capture has its position",
            "Add a line capture,x_mm,y_mm, or leave the capture out.",
        ));
    }
    Ok(positions.into_iter().flatten().collect())
}

/// The file that `name` means: by its file name, else by the name without its ending.
fn which(files: &[CaptureFile], name: &str) -> Option<usize> {
    let name = Path::new(name).file_name()?.to_string_lossy();
    let only = |mut hits: Box<dyn Iterator<Item = usize> + '_>| {
        let first = hits.next();
        if hits.next().is_some() { None } else { first }
    };
    let by_name = files
        .iter()
        .enumerate()
        .filter(|(_, f)| f.file_name() == name);
    let by_stem = files.iter().enumerate().filter(|(_, f)| {
        f.path
            .file_stem()
            .is_some_and(|s| s.to_string_lossy() == name)
    });
    only(Box::new(by_name.map(|(i, _)| i))).or_else(|| only(Box::new(by_stem.map(|(i, _)| i))))
}
