//! The viewer's page inside a report.

use crate::view_files::ViewFiles;
use rowburst::Image;
use rowburst_view::{BUNDLE, Offline};
use serde_json::Value;
use std::path::Path;

/// Makes the viewer's page from the viewer's files and the content of `view.json`; `None` where the video is too
/// large for it.
pub type MakePlayer = Box<dyn Fn(&ViewFiles, &Value) -> Option<PlayerPage>>;

/// The viewer's page for a report in one file.
pub struct PlayerPage {
    /// JavaScript.
    pub script: &'static str,
    /// CSS.
    pub style: &'static str,
    /// The videos, pictures and values that it shows, as JSON.
    pub data: String,
}

/// Makes the viewer's page of a result, with the name of the folder `result`.
pub fn player_of(result: &Path) -> MakePlayer {
    let name = result.file_name().unwrap_or(result.as_os_str());
    let name = name.to_string_lossy().into_owned();
    Box::new(move |files, view| {
        let mut videos = vec![("video", files.video)];
        videos.extend(files.truth.map(|(truth, _)| ("truth", truth)));
        let excluded = files.has_excluded().then(|| {
            let mask = files.excluded.iter().copied().map(f32::from).collect();
            Image::new(files.frame.rows(), files.frame.columns(), mask)
                .expect("the mask has the size of the frame")
        });
        let mut pictures = vec![
            ("frame", files.frame),
            ("psf", files.psf),
            ("residual", files.residual),
        ];
        pictures.extend(files.direct.map(|image| ("direct", image)));
        pictures.extend(excluded.as_ref().map(|image| ("excluded", image)));
        let offline = Offline {
            name: &name,
            view,
            videos: &videos,
            pictures: &pictures,
            coverage: files.has_unobserved().then_some(files.coverage),
        };
        Some(PlayerPage {
            script: BUNDLE.script,
            style: BUNDLE.style,
            data: offline.json()?,
        })
    })
}
