//! The sizes of the axes that OME-XML names, which tell how the pages of a TIFF are ordered.

use roxmltree::{Document, Node};

/// Whether a TIFF's description is OME-XML.
pub(crate) fn is_ome(description: &str) -> bool {
    let start = description.trim_start_matches('\u{feff}').trim_start();
    start.starts_with('<') && start.contains("<OME")
}

/// `SizeC`, `SizeZ` and `SizeT` of the first image, where the text is OME-XML.
pub(crate) fn ome_sizes(
    description: &str,
) -> Option<(Option<usize>, Option<usize>, Option<usize>)> {
    if !is_ome(description) {
        return None;
    }
    let document = Document::parse(description.trim_start_matches('\u{feff}').trim()).ok()?;
    let mut elements = document.descendants();
    let pixels = elements.find(|n| n.has_tag_name_of("Pixels"))?;
    let size = |key: &str| pixels.attribute(key)?.trim().parse().ok();
    Some((size("SizeC"), size("SizeZ"), size("SizeT")))
}

/// Names without their namespace, which changes with the version of the schema.
pub(crate) trait TagNameExt {
    fn has_tag_name_of(&self, name: &str) -> bool;
}

impl TagNameExt for Node<'_, '_> {
    fn has_tag_name_of(&self, name: &str) -> bool {
        self.is_element() && self.tag_name().name() == name
    }
}
