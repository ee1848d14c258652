//! Files of captures.

use rowburst::calibrate::psf::NamedCapture;
use rowburst::{Error, Result};
use rowburst_io::{IMAGE_ENDINGS, is_image, read_image, read_stack};
use std::path::{Path, PathBuf};

/// One file of captures.
pub struct CaptureFile {
    /// Its path.
    pub path: PathBuf,
    /// Its pages.
    pub shots: Vec<NamedCapture>,
    /// Counts at which its kind of file ends, if it holds integers.
    pub saturation_limit: Option<f64>,
}

impl CaptureFile {
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

    /// The name without the folder.
    pub fn file_name(&self) -> String {
        self.path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    }
}

/// Reads all captures; a folder stands for the images in it, by name.
///
/// # Errors
/// Files that cannot be read, and folders without images.
pub fn read_captures(given: &[PathBuf]) -> Result<Vec<CaptureFile>> {
    let mut paths = Vec::new();
    for path in given {
        if path.is_dir() {
            let found = images_in(path)?;
            if found.is_empty() {
                return Err(Error::input(
                    path,
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
    paths.into_iter().map(CaptureFile::read).collect()
}

fn images_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|e| {
        Error::input(
            folder,
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
