//! The still part of a video and the change from it, apart.

use rowburst::Video;
use rowburst::design::count::ChangeCount;

use super::frames::{Line, coloured, sheet, spread};
use super::{CaptionedFigure, Section, Videos, light_text};
use crate::ReportInput;
use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::panel::{bar_bottom, colour_bar, put};
use crate::stats::display_high;

/// Bins of which the change is drawn, where none are chosen.
const BINS: usize = 6;

/// A video as the sum of its mean over time and the change from it.
struct StillAndChange<'v> {
    video: &'v Video,
    still: Vec<f32>,
}

impl<'v> StillAndChange<'v> {
    fn of(video: &'v Video) -> Self {
        let shape = video.shape();
        let mut sums = vec![0.0f64; shape.pixels()];
        for bin in 0..shape.bins {
            let pairs = sums.iter_mut().zip(video.bin(bin));
            pairs.for_each(|(sum, v)| *sum += f64::from(*v));
        }
        let bins = shape.bins as f64;
        Self {
            video,
            still: sums.iter().map(|sum| (sum / bins) as f32).collect(),
        }
    }

    fn change(&self, bin: usize) -> Vec<f32> {
        let pairs = self.video.bin(bin).iter().zip(&self.still);
        pairs.map(|(v, still)| v - still).collect()
    }

    /// White point of the change in the `bins`.
    fn high(&self, bins: &[usize]) -> f32 {
        let changes = bins.iter().flat_map(|&bin| self.change(bin));
        let sizes: Vec<f32> = changes.map(f32::abs).collect();
        display_high(&sizes)
    }
}

/// Draws the still part, and below it the change in the `chosen` bins, else in some that are spread over the video. Those of
/// the truth stand beside and above them.
pub(super) fn draw(
    input: &ReportInput,
    videos: &Videos,
    chosen: Option<&[usize]>,
) -> CaptionedFigure {
    let shape = videos.video.shape();
    let bins = chosen.map_or_else(|| spread(shape.bins, BINS), <[_]>::to_vec);
    let found = StillAndChange::of(videos.video);
    let truth = videos.truth.map(StillAndChange::of);
    let mut figure = Figure::new(800.0, 0.0);
    let light = (0.0, videos.high);
    let panels = [
        ("still part", Some(&found)),
        ("still part of the truth", truth.as_ref()),
    ];
    let mut last = Rect::new(0.0, 0.0, 0.0, 0.0);
    for (i, (name, parts)) in panels.into_iter().enumerate() {
        let Some(parts) = parts else { continue };
        let available = Rect::new(24.0 + 290.0 * i as f64, 22.0, 280.0, 400.0);
        last = put(
            &mut figure,
            available,
            coloured(input, &parts.still, Map::Light, light),
        );
        figure.text(
            last.x + last.width / 2.0,
            14.0,
            Anchor::Middle,
            "strong",
            name,
        );
    }
    colour_bar(&mut figure, last, Map::Light, light, "counts");
    let half = truth.as_ref().unwrap_or(&found).high(&bins);
    let signed = (-half, half);
    let of_video = |bin: usize| coloured(input, &found.change(bin), Map::Signed, signed);
    let of_truth = |bin: usize| {
        let parts = truth.as_ref().expect("drawn where there is a truth");
        coloured(input, &parts.change(bin), Map::Signed, signed)
    };
    let line = |name, picture| Line {
        name,
        map: Map::Signed,
        range: signed,
        picture,
    };
    let mut lines = vec![line("change", &of_video as &dyn Fn(_) -> _)];
    if truth.is_some() {
        lines.insert(0, line("true change", &of_truth));
    }
    let top = bar_bottom(last) + 14.0;
    sheet(&mut figure, input, top, &bins, &lines);
    CaptionedFigure {
        name: "change",
        section: Section::Video,
        figure,
        caption: format!(
            "The still part, which is the mean over time, and below it the change from it in {} of {} bins, on a scale of \
             its own{}. {}{}",
            bins.len(),
            shape.bins,
            if truth.is_some() {
                "; those of the truth are beside and above them"
            } else {
                ""
            },
            light_text(input),
            input.change_count.map_or(String::new(), count_text)
        ),
        alt: "The mean of the video over time, and the change from it in some of its bins.".into(),
    }
}

/// How far the change is told, as a sentence after another.
fn count_text(count: ChangeCount) -> String {
    let belief = if count.is_too_few() {
        ": too few to believe it. The still part is told by all instants together"
    } else {
        ""
    };
    format!(
        " {:.0} of {} numbers that the frame measures in an instant speak about the change{belief}.",
        count.informative, count.of
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::Shape;

    #[test]
    fn still_part_and_change_add_up_to_the_video() {
        let mut video = Video::zeros(Shape::new(3, 1, 2));
        for (bin, values) in [[1.0, 2.0], [4.0, 2.0], [1.0, 2.0]].iter().enumerate() {
            video.bin_mut(bin).copy_from_slice(values);
        }
        let parts = StillAndChange::of(&video);
        assert_eq!(parts.still, [2.0, 2.0]);
        assert_eq!(parts.change(0), [-1.0, 0.0]);
        assert_eq!(parts.high(&[0, 2]), 1.0);
        assert_eq!(parts.high(&[0, 1]), 1.0);
    }
}
