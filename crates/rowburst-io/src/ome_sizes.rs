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

/// The images that OME-XML puts into one file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OmeImages {
    pub count: usize,
    /// Pages of the first one; `None` where its sizes are not known.
    pub planes: Option<usize>,
}

/// The images in the file `name`, where the text is OME-XML. Images whose data lie in other files are left out.
pub(crate) fn ome_images(description: &str, name: &str) -> Option<OmeImages> {
    if !is_ome(description) {
        return None;
    }
    let document = Document::parse(description.trim_start_matches('\u{feff}').trim()).ok()?;
    let images = document
        .descendants()
        .filter(|n| n.has_tag_name_of("Image"));
    let all: Vec<Node> = images
        .filter_map(|image| image.children().find(|n| n.has_tag_name_of("Pixels")))
        .collect();
    let files_of = |pixels: &Node| -> Vec<String> {
        let files = pixels
            .descendants()
            .filter_map(|n| n.attribute("FileName").map(String::from));
        files.collect()
    };
    let is_named = |pixels: &Node| files_of(pixels).iter().any(|file| file == name);
    // A file that was renamed has all images that have no other file.
    let is_known = all.iter().any(is_named);
    let here: Vec<&Node> = all
        .iter()
        .filter(|pixels| !is_known || is_named(pixels) || files_of(pixels).is_empty())
        .collect();
    Some(OmeImages {
        count: here.len(),
        planes: here.first().and_then(|pixels| planes_of(pixels)),
    })
}

/// Pages of an image: a page holds one channel, or a colour of several samples.
fn planes_of(pixels: &Node) -> Option<usize> {
    let size = |key: &str| -> Option<usize> { pixels.attribute(key)?.trim().parse().ok() };
    let channels = pixels.children().filter(|n| n.has_tag_name_of("Channel"));
    let channels = match channels.count() {
        0 => size("SizeC")?,
        count => count,
    };
    let depths_and_times = size("SizeZ")?.checked_mul(size("SizeT")?)?;
    channels.checked_mul(depths_and_times)
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
