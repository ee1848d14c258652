//! The figures of the report, one a file.

mod convergence;
mod frames;
mod image;
mod residual;
mod space_time;
mod time_colour;
mod traces;

use rowburst::Video;

use crate::ReportInput;
use crate::figure::Figure;
use crate::projection::Projection;
use crate::stats::display_high;

/// The part of the page that a figure belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Section {
    /// What was reconstructed.
    Video,
    /// What was measured.
    Measurement,
    /// How well the one explains the other.
    Fit,
}

/// A figure with its words.
pub(crate) struct CaptionedFigure {
    /// File name without extension, and id in the page.
    pub name: &'static str,
    pub section: Section,
    pub figure: Figure,
    /// What is seen, its units and what a good one looks like.
    pub caption: String,
    /// What is seen, for those who do not see it.
    pub alt: String,
}

/// What several figures need to know of the videos.
struct Videos<'a> {
    video: &'a Video,
    truth: Option<&'a Video>,
    /// Projection of the reconstruction over time.
    projection: Projection,
    /// White point of the reconstruction and the truth.
    high: f32,
}

/// All figures, in the order of the page; each is drawn when it is asked for, so that
/// only one is held at a time.
pub(crate) fn all<'a>(input: &'a ReportInput<'a>) -> impl Iterator<Item = CaptionedFigure> + 'a {
    let projection = Projection::of(input.video);
    let truth = input.truth.map(Projection::of);
    let high = display_high(&truth.as_ref().unwrap_or(&projection).max);
    let videos = Videos {
        video: input.video,
        truth: input.truth,
        projection,
        high,
    };
    let moving = input.video.shape().bins > 1;
    let mut truth = truth;
    (0..9).filter_map(move |figure| match figure {
        0 if moving => Some(time_colour::draw(input, &videos, truth.take())),
        0 => Some(image::still(input, &videos)),
        1 if moving => space_time::draw(input, &videos),
        2 => moving.then(|| frames::draw(input, &videos)),
        3 if moving => traces::draw(input, &videos),
        4 => Some(image::frame(input)),
        5 => Some(image::psf(input)),
        6 => input.direct.map(|direct| image::direct(input, direct)),
        7 => Some(residual::draw(input)),
        8 => convergence::draw(input.convergence),
        _ => None,
    })
}
