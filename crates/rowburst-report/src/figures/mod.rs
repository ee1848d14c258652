//! The figures of the report, one a file.

mod change;
mod convergence;
mod frames;
mod image;
mod residual;
mod space_time;
mod time_colour;
mod traces;

pub use traces::REGION_COLOURS;

use rowburst::Video;
use std::borrow::Cow;

use crate::ReportInput;
use crate::figure::Figure;
use crate::format::number;
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

/// The mask of the pixels that were left out; `None` where there are none.
fn excluded<'a>(input: &ReportInput<'a>) -> Option<&'a [u8]> {
    input.excluded.filter(|mask| mask.contains(&1))
}

/// The `values` of the pixels that are not in the mask `excluded`.
fn without<'a>(values: &'a [f32], excluded: Option<&[u8]>) -> Cow<'a, [f32]> {
    match excluded {
        None => Cow::Borrowed(values),
        Some(mask) => {
            let kept = values.iter().zip(mask).filter(|(_, value)| **value == 0);
            Cow::Owned(kept.map(|(value, _)| *value).collect())
        }
    }
}

/// The sentence of a caption on the pixels that were left out; empty where there are none.
fn excluded_text(input: &ReportInput) -> String {
    excluded(input).map_or(String::new(), |mask| {
        let count = mask.iter().filter(|&&value| value == 1).count();
        let percent = number(100.0 * count as f64 / mask.len() as f64, 2);
        format!(" Yellow: {count} pixels ({percent} %) that were left out, since no video explains them.")
    })
}

/// A mask of the voxels of bin `t` that the frame does not observe; `None` where it observes all of the video.
fn unobserved(input: &ReportInput, t: usize) -> Option<Vec<u8>> {
    let coverage = input.coverage.filter(|mask| mask.contains(&0))?;
    let pixels = input.video.shape().pixels();
    let bin = &coverage[t * pixels..(t + 1) * pixels];
    Some(bin.iter().map(|&value| 1 - value.min(1)).collect())
}

/// The sentence of a caption on the voxels that the frame does not observe, with `mark` for their colour; empty where it
/// observes all.
fn unobserved_text(input: &ReportInput, mark: &str) -> String {
    let mask = input.coverage.filter(|mask| mask.contains(&0));
    mask.map_or(String::new(), |mask| {
        let count = mask.iter().filter(|&&value| value == 0).count();
        let percent = number(100.0 * count as f64 / mask.len() as f64, 2);
        format!(" The frame does not observe {percent} % of the voxels; they are zero{mark}.")
    })
}

/// What brightness is given in, as a sentence.
fn light_text(input: &ReportInput) -> String {
    let span = match input.video.shape().bins {
        1 => "the exposure",
        _ => "one row time",
    };
    let electrons = input.sensor.gain_electrons_per_count;
    let electrons = electrons.map_or(String::new(), |gain| {
        format!(" (1 count is {} electrons)", number(gain, 3))
    });
    format!(
        "Brightness is in counts{electrons}, those that the place would give in {span} without the diffuser."
    )
}

/// Where the zero of time is, as a sentence.
pub(crate) fn time_text(input: &ReportInput) -> String {
    let delay = input.sensor.trigger_delay_us;
    let delay = delay.map_or(String::new(), |us| {
        format!(", {} µs after the trigger", number(us, 6))
    });
    format!("Time 0 is the start of exposure of the row that is read first{delay}.")
}

/// All figures, in the order of the page; each is drawn when it is asked for, so that
/// only one is held at a time. `bins` are those of the sheet of frames, where they are chosen.
pub(crate) fn all<'a>(
    input: &'a ReportInput<'a>,
    bins: Option<&'a [usize]>,
) -> impl Iterator<Item = CaptionedFigure> + 'a {
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
    (0..13).filter_map(move |figure| match figure {
        0 if moving => Some(time_colour::draw(input, &videos, truth.take())),
        0 => Some(image::still(input, &videos)),
        1 if moving => space_time::draw(input, &videos),
        2 => moving.then(|| frames::draw(input, &videos, bins)),
        3 => (moving && input.draws_change).then(|| change::draw(input, &videos, bins)),
        4 if moving => traces::draw(input, &videos),
        5 => Some(image::frame(input)),
        6 => input
            .stray_light
            .map(|light| image::stray_light(input, light)),
        7 => Some(image::psf(input)),
        8 => input
            .given_psf
            .map(|given| image::psf_correction(input, given)),
        9 => input.direct.map(|direct| image::direct(input, direct)),
        10 => Some(residual::draw(input)),
        11 => input
            .residual_before
            .map(|before| residual::draw_before(input, before)),
        12 => convergence::draw(input.convergence),
        _ => None,
    })
}
