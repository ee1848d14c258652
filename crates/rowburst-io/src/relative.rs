//! Paths as seen from a folder, so that both may move together.

use crate::source::ArrayPath;
use std::io;
use std::path::{Path, PathBuf};

/// `path` as seen from `folder`, with `/` on every system; absolute where they have no folder in common but the root.
/// `FILE.h5:/path` keeps the name of its array.
pub fn relative_path(path: &Path, folder: &Path) -> String {
    let ArrayPath { file, array } = ArrayPath::of(path);
    // Both by the same rule: on Windows the two forms have no component in common.
    let both = |rule: fn(&Path) -> io::Result<PathBuf>| Ok((rule(&file)?, rule(folder)?));
    let found: io::Result<_> = both(|path| path.canonicalize())
        .or_else(|_: io::Error| both(|path| std::path::absolute(path)));
    let Ok((file, folder)) = found else {
        return path.to_string_lossy().into_owned();
    };
    let pairs = file.components().zip(folder.components());
    let common = pairs.take_while(|(a, b)| a == b).count();
    // The root is a component.
    let seen = if common > 1 {
        let mut seen = PathBuf::new();
        (common..folder.components().count()).for_each(|_| seen.push(".."));
        seen.extend(file.components().skip(common));
        seen.to_string_lossy()
            .replace(std::path::MAIN_SEPARATOR, "/")
    } else {
        file.to_string_lossy().into_owned()
    };
    let name = array.map_or(String::new(), |array| format!(":{array}"));
    seen + &name
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_seen_from_the_folder() {
        let base = tempfile::tempdir().unwrap();
        let (sim, result) = (base.path().join("sim"), base.path().join("a/result"));
        std::fs::create_dir_all(&sim).unwrap();
        std::fs::create_dir_all(&result).unwrap();
        std::fs::write(sim.join("f.h5"), "").unwrap();
        let named = PathBuf::from(format!("{}:/x", sim.join("f.h5").display()));
        assert_eq!(relative_path(&named, &result), "../../sim/f.h5:/x");
        assert_eq!(relative_path(&result.join("v.npy"), &result), "v.npy");
    }
}
