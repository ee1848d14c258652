//! The captures that the command line names, and where their source was.

use super::PsfArgs;
use rowburst::calibrate::psf::NamedCapture;
use rowburst::{Error, Result};
use rowburst_io::{IMAGE_ENDINGS, is_image, read_image, read_stack};
use std::path::{Path, PathBuf};

/// One file of captures.
pub struct File {
    pub path: PathBuf,
    /// Its pages.
    pub shots: Vec<NamedCapture>,
    /// Counts at which its kind of file ends, if it holds integers.
    pub saturation_limit: Option<f64>,
}

impl File {
    fn read(path: PathBuf) -> Result<Self> {
        let pages = read_stack(&path)?;
        let count = pages.len();
        let saturation_limit = match count {
            1 => read_image(&path)?.format.saturation_limit(),
            _ => None,
        };
        let name = |page: usize| match count {
            1 => path.display().to_string(),
            _ => format!("{} page {page}", path.display()),
        };
        let shots = pages.into_iter().enumerate();
        let shots = shots.map(|(i, image)| NamedCapture {
            name: name(i + 1),
            image,
        });
        Ok(Self {
            shots: shots.collect(),
            path,
            saturation_limit,
        })
    }

    fn file_name(&self) -> String {
        self.path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    }
}

/// Reads all captures; a folder stands for the images in it, by name.
pub fn read(args: &PsfArgs) -> Result<Vec<File>> {
    let mut paths = Vec::new();
    for path in &args.captures {
        if path.is_dir() {
            let found = images_in(path)?;
            if found.is_empty() {
                return Err(Error::input(
                    path.display().to_string(),
                    "a folder without images",
                    format!("captures are read as {IMAGE_ENDINGS}"),
                    "Name the folder that the captures lie in.",
                ));
            }
            paths.extend(found);
        } else {
            paths.push(path.clone());
        }
    }
    paths.into_iter().map(File::read).collect()
}

fn images_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|e| {
        Error::input(
            folder.display().to_string(),
            e,
            "the folder of the captures can be read",
            "Check its permissions.",
        )
    })?;
    let mut found: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| {
            let hidden = path
                .file_name()
                .is_some_and(|n| n.to_string_lossy().starts_with('.'));
            path.is_file() && !hidden && is_image(path)
        })
        .collect();
    found.sort_by_cached_key(|path| {
        natural(&path.file_name().unwrap_or_default().to_string_lossy())
    });
    Ok(found)
}

/// Key by which capture2 comes before capture10.
fn natural(name: &str) -> Vec<(u64, String)> {
    let mut parts: Vec<(u64, String)> = Vec::new();
    let mut digits = String::new();
    for c in name.chars().chain([' ']) {
        if c.is_ascii_digit() {
            digits.push(c);
            continue;
        }
        if !digits.is_empty() {
            parts.push((digits.parse().unwrap_or(u64::MAX), String::new()));
            digits.clear();
        }
        parts.push((0, c.to_string()));
    }
    parts
}

/// Place `(y, x)` in millimetres of each of `files`.
pub fn read_positions(csv: &Path, files: &[File]) -> Result<Vec<(f64, f64)>> {
    let text = std::fs::read_to_string(csv).map_err(|e| {
        Error::input(
            csv.display().to_string(),
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
        let subject = format!("{}, line {}", csv.display(), number + 1);
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
                &subject,
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
            csv.display().to_string(),
            format!("no line for {}", files[i].file_name()),
            "each capture has its position",
            "Add a line capture,x_mm,y_mm, or leave the capture out.",
        ));
    }
    Ok(positions.into_iter().flatten().collect())
}

/// The file that `name` means: by its file name, else by the name without its ending.
fn which(files: &[File], name: &str) -> Option<usize> {
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
