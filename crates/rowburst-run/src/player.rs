//! The viewer's page within a report.

use crate::view_files::ViewFiles;
use serde_json::Value;
use std::path::Path;

/// From what the viewer shows, and `view.json`, to its page; `None` where the video is too large.
pub type MakePlayer = Box<dyn Fn(&ViewFiles, &Value) -> Option<PlayerPage>>;

/// The viewer's page for one file.
pub struct PlayerPage {
    /// Its code.
    pub script: String,
    /// Its looks.
    pub style: String,
    /// What it shows.
    pub data: String,
}

/// Makes the page of a result that is named as its folder; `None` in a build without the page.
#[cfg(feature = "page")]
pub fn player_of(result: &Path) -> Option<MakePlayer> {
    use rowburst_view::{Offline, bundle};

    let bundle = bundle()?;
    let name = result.file_name().unwrap_or(result.as_os_str());
    let name = name.to_string_lossy().into_owned();
    Some(Box::new(move |files, view| {
        let mut videos = vec![("video", files.video)];
        videos.extend(files.truth.map(|(truth, _)| ("truth", truth)));
        let mut pictures = vec![
            ("frame", files.frame),
            ("psf", files.psf),
            ("residual", files.residual),
        ];
        pictures.extend(files.direct.map(|image| ("direct", image)));
        let offline = Offline {
            name: &name,
            view,
            videos: &videos,
            pictures: &pictures,
        };
        Some(PlayerPage {
            script: bundle.script.clone(),
            style: bundle.style.clone(),
            data: offline.json()?,
        })
    }))
}

/// In a build without the viewer.
#[cfg(not(feature = "page"))]
pub fn player_of(_: &Path) -> Option<MakePlayer> {
    None
}
