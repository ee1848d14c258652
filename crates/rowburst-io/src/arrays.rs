//! Which of the arrays of a file is meant: the one that was named, or the only one there is.

use crate::source::{ArrayPath, Source};
use rowburst::Result;

/// An array that could be a frame or a stack.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ArrayInfo {
    pub name: String,
    pub shape: Vec<usize>,
    /// Kind of its numbers, in words.
    pub kind: String,
    /// Whether numbers of this kind are read.
    pub is_numeric: bool,
}

impl ArrayInfo {
    /// Two or three axes, and more than a line: scalars and vectors are settings, no frames.
    fn is_image(&self) -> bool {
        let long = self.shape.iter().filter(|&&side| side > 1).count();
        self.is_numeric && (2..=3).contains(&self.shape.len()) && long >= 2
    }
}

/// The index of the array that `source` names, or of the only image among `all`.
pub(crate) fn choose(source: &Source, all: &[ArrayInfo]) -> Result<usize> {
    let array_path = ArrayPath::of(source.path);
    let remedy = |name: &str| format!("Name it: {}:{name}", array_path.file.display());
    if let Some(array) = &array_path.array {
        let plain = |name: &str| name.trim_start_matches('/').to_string();
        let found = all.iter().position(|c| plain(&c.name) == plain(array));
        let Some(found) = found else {
            return Err(source.error(
                format!("no array \"{array}\""),
                format!("the file has {}", list(all)),
                remedy(all.first().map_or("NAME", |c| &c.name)),
            ));
        };
        let chosen = &all[found];
        if !chosen.is_numeric {
            return Err(source.unsupported(&chosen.kind));
        }
        if !(2..=3).contains(&chosen.shape.len()) || chosen.shape.contains(&0) {
            return Err(source.error(
                format!("an array of shape {:?}", chosen.shape),
                "an image has two axes, a stack or video three",
                "Name another array, or reshape it.",
            ));
        }
        return Ok(found);
    }
    let images: Vec<usize> = (0..all.len()).filter(|&i| all[i].is_image()).collect();
    match images[..] {
        [only] => Ok(only),
        [] => Err(source.error(
            format!("no image, but {}", list(all)),
            "the file must hold one numeric array of two or three axes",
            "Check how it was saved.",
        )),
        [first, ..] => Err(source.error(
            format!("several arrays: {}", list(all)),
            "name the image where a file has more than one",
            remedy(&all[first].name),
        )),
    }
}

/// Names, shapes and kinds; the first twelve.
fn list(all: &[ArrayInfo]) -> String {
    let words = |c: &ArrayInfo| format!("{} ({:?}, {})", c.name, c.shape, c.kind);
    let mut text = all
        .iter()
        .take(12)
        .map(words)
        .collect::<Vec<_>>()
        .join(", ");
    if all.len() > 12 {
        text += &format!(" and {} more", all.len() - 12);
    }
    if text.is_empty() {
        text = "nothing in it".into();
    }
    text
}
