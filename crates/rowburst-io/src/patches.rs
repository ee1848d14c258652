//! A patch set: a small TOML file beside the stack of its PSFs.
//!
//! ```toml
//! psfs = "psf-patches.npy"                    # [patch, y, x]
//! offsets_px = [[-40.0, 0.0], [40.0, 0.0]]    # of each source from the middle of the field
//! ```

use crate::fault;
use crate::folder::OutputFolder;
use crate::npy::write_npy_video;
use crate::read::read_stack;
use rowburst::error::Tool;
use rowburst::{Error, PatchSet, Psf, Result, Shape, Video, phrase};
use std::path::{Path, PathBuf};

/// Whether `path` names a patch set and not an image.
pub fn is_patch_set(path: &Path) -> bool {
    path.extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("toml"))
}

/// Reads a patch set.
///
/// # Errors
/// A file that is missing or not a patch set, a stack that cannot be read, PSFs and
/// offsets that do not belong together.
pub fn read_patch_set(path: &Path) -> Result<PatchSet> {
    let text = std::fs::read_to_string(path).map_err(|e| fault::read_error(path, &e))?;
    let bad = |found: String| {
        Error::input(
            path,
            found,
            "a patch set has psfs = \"FILE\" and offsets_px = [[dy, dx], …]",
            phrase!["Write it anew by ", Tool::CalibratePatches, "."],
        )
    };
    let file: toml::Table = text
        .parse()
        .map_err(|e: toml::de::Error| bad(e.message().replace('\n', ", ")))?;
    let known = ["psfs", "offsets_px"];
    if let Some(key) = file.keys().find(|k| !known.contains(&k.as_str())) {
        return Err(bad(format!("the unknown key `{key}`")));
    }
    let name = file.get("psfs").and_then(toml::Value::as_str);
    let name = name.ok_or_else(|| bad("no file of PSFs".into()))?;
    let number = |v: &toml::Value| v.as_float().or_else(|| v.as_integer().map(|i| i as f64));
    let pair = |v: &toml::Value| match v.as_array()?.as_slice() {
        [y, x] => Some((number(y)?, number(x)?)),
        _ => None,
    };
    let offsets = file.get("offsets_px").and_then(toml::Value::as_array);
    let offsets: Option<Vec<(f64, f64)>> = offsets.and_then(|o| o.iter().map(pair).collect());
    let offsets = offsets.ok_or_else(|| bad("no pairs of offsets".into()))?;
    let stack = path.parent().unwrap_or(Path::new("")).join(name);
    let psfs = read_stack(&stack)?
        .into_iter()
        .enumerate()
        .map(|(i, image)| {
            let place = format!("{}: page {}", stack.display(), i + 1);
            Psf::new(image).map_err(|e| e.within(place))
        })
        .collect::<Result<Vec<_>>>()?;
    PatchSet::new(psfs, offsets).map_err(|e| e.within(path))
}

/// The file of the PSFs of a patch set; `None` where `path` is no patch set.
pub fn patch_set_stack(path: &Path) -> Option<PathBuf> {
    let file: toml::Table = std::fs::read_to_string(path).ok()?.parse().ok()?;
    let name = file.get("psfs")?.as_str()?;
    Some(path.parent().unwrap_or(Path::new("")).join(name))
}

/// Writes `set` as `NAME.toml` and the stack `NAME.npy` beside it.
///
/// # Errors
/// Failed writes.
pub fn write_patch_set(folder: &OutputFolder, name: &str, set: &PatchSet) -> Result<()> {
    let first = set.psfs()[0].image();
    let pages = set.psfs().iter().flat_map(|p| p.image().data()).copied();
    let shape = Shape::new(set.psfs().len(), first.rows(), first.columns());
    let stack = Video::new(shape, pages.collect())?;
    let file = format!("{name}.npy");
    folder.write(&file, |w| write_npy_video(w, &stack))?;
    let offsets: Vec<String> = set
        .offsets_px()
        .iter()
        .map(|(y, x)| format!("    [{y:?}, {x:?}],\n"))
        .collect();
    let text = format!(
        "# PSFs at several positions of the field: psf = \"…\" under [calibration] takes this file.\n\
         # [patch, y, x]\npsfs = {}\n\
         # Row and column offset of each source from the middle of the field, in pixels.\n\
         offsets_px = [\n{}]\n",
        toml::Value::from(file),
        offsets.concat()
    );
    folder.write_bytes(&format!("{name}.toml"), text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::Image;

    #[test]
    fn a_set_comes_back_as_it_was_written() {
        let base = tempfile::tempdir().unwrap();
        let folder = OutputFolder::create(base.path()).unwrap();
        let psf = |i: usize| Psf::new(Image::from_fn(4, 5, |y, x| (i + y * x) as f32)).unwrap();
        let set = PatchSet::new(vec![psf(1), psf(2)], vec![(-1.5, 0.0), (2.25, 1e-3)]).unwrap();
        write_patch_set(&folder, "p", &set).unwrap();
        let path = base.path().join("p.toml");
        assert!(is_patch_set(&path));
        let read = read_patch_set(&path).unwrap();
        assert_eq!(read.offsets_px(), set.offsets_px());
        let near = |a: &Psf, b: &Psf| {
            let pairs = a.image().data().iter().zip(b.image().data());
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) < 1e-7
        };
        assert!(near(&read.psfs()[1], &set.psfs()[1]));
        for (text, says) in [
            ("psfs = 3", "no file of PSFs"),
            ("psfs = \"p.npy\"", "no pairs"),
            (
                "psfs = \"p.npy\"\noffsets_px = [[1.0, 2.0]]",
                "2 PSFs and 1 offsets",
            ),
            ("psfs = \"p.npy\"\nbins = 2", "unknown key `bins`"),
            ("psfs = ", "psfs"),
        ] {
            folder.write_bytes("p.toml", text.as_bytes()).unwrap();
            let message = read_patch_set(&path).unwrap_err().to_string();
            assert!(
                message.contains(says) && message.contains("p.toml"),
                "{message}"
            );
        }
    }
}
