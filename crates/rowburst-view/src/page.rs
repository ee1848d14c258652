//! The page: the files that `scripts/page` makes from `web/`.

/// Script and style of the page, to be put into one file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bundle {
    /// JavaScript, one classic script.
    pub script: &'static str,
    /// CSS.
    pub style: &'static str,
}

/// The page's script and style.
pub const BUNDLE: Bundle = Bundle {
    script: include_str!("../page/app.js"),
    style: include_str!("../page/app.css"),
};

/// A file of the page with its type, as the browser asks for it.
#[cfg(feature = "server")]
pub(crate) fn file(name: &str) -> Option<(&'static str, &'static str)> {
    match name {
        "index.html" => Some((
            "text/html; charset=utf-8",
            include_str!("../page/index.html"),
        )),
        "app.js" => Some(("text/javascript; charset=utf-8", BUNDLE.script)),
        "app.css" => Some(("text/css; charset=utf-8", BUNDLE.style)),
        _ => None,
    }
}
