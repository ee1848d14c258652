//! The page, as it was at build.

use rust_embed::RustEmbed;

#[derive(RustEmbed)]
#[folder = "../../web/dist"]
#[allow_missing = true]
struct Files;

/// Script and style of the page, to be put into one file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bundle {
    /// JavaScript, one classic script.
    pub script: String,
    /// CSS.
    pub style: String,
}

/// What to do where there is no page.
pub const MISSING_PAGE_HELP: &str = "This program was built without the viewer's page. \
    Install Node.js 18 or later with npm, run scripts/page in the source folder, then build again \
    with cargo build --release.";

/// The page's script and style; `None` in a program that was built without the page.
pub fn bundle() -> Option<Bundle> {
    let text = |name| String::from_utf8(Files::get(name)?.data.into_owned()).ok();
    Some(Bundle {
        script: text("app.js")?,
        style: text("app.css")?,
    })
}

#[cfg(feature = "server")]
/// A file of the page with its type, as the browser asks for it.
pub(crate) fn file(name: &str) -> Option<(&'static str, Vec<u8>)> {
    let kind = match name {
        "index.html" => "text/html; charset=utf-8",
        "app.js" => "text/javascript; charset=utf-8",
        "app.css" => "text/css; charset=utf-8",
        _ => return None,
    };
    Some((kind, Files::get(name)?.data.into_owned()))
}

#[cfg(feature = "server")]
/// In the place of a page that was not built.
pub(crate) fn missing_page() -> String {
    format!(
        "<!doctype html><html lang=en><meta charset=utf-8><title>Rowburst</title><h1>No page</h1><p>{MISSING_PAGE_HELP}</p>"
    )
}
