//! Single pictures: the captured frame, the PSF, the scene without diffuser, a still reconstruction.

use rowburst::Image;

use super::{CaptionedFigure, Section, Videos};
use super::{excluded, excluded_text, light_text, unobserved, unobserved_text, without};
use crate::colour::{LEFT_OUT, Map, UNOBSERVED};
use crate::figure::{Anchor, Figure, Rect};
use crate::panel::{BAR_ROOM, PixelScale, bar_bottom, colour_bar, put, scale_bar};
use crate::pixels::{LONGEST_SIDE, Plane};
use crate::stats::{display_high, display_low};
use crate::{Direct, DirectOrigin, ReportInput};

/// The captured frame.
pub(super) fn frame(input: &ReportInput) -> CaptionedFigure {
    let image = input.frame;
    let size = format!("{} × {}", image.rows(), image.columns());
    CaptionedFigure {
        name: "frame",
        section: Section::Measurement,
        figure: picture(
            image,
            excluded(input),
            Map::Grey,
            "recorded signal (counts)",
            PixelScale::of_sensor(input.sensor),
        ),
        caption: format!(
            "The captured frame, {size} pixels, in counts. {} A good one \
             uses the range well and is nowhere saturated.{}",
            match input.video.shape().bins {
                1 => "All rows integrate the same light.",
                _ =>
                    "Every row is read at its own instant, so that behind a diffuser it looks \
                     like noise that changes from row to row.",
            },
            excluded_text(input)
        ),
        alt: format!("Grey-scale image of the captured frame, {size} pixels."),
    }
}

/// The stray light that was taken away from the frame.
pub(super) fn stray_light(input: &ReportInput, light: &Image) -> CaptionedFigure {
    let size = format!("{} × {}", light.rows(), light.columns());
    CaptionedFigure {
        name: "stray-light",
        section: Section::Measurement,
        figure: picture(
            light,
            None,
            Map::Light,
            "stray light (counts)",
            PixelScale::of_sensor(input.sensor),
        ),
        caption: "Smooth stray light in counts, such as a reflection, that no video explains. It was taken away from the \
                  captured frame, which is shown without it. Where its places are not those of a reflection, do not believe it."
            .into(),
        alt: format!("Image of the stray light, {size} pixels."),
    }
}

/// The point spread function.
pub(super) fn psf(input: &ReportInput) -> CaptionedFigure {
    let image = input.psf;
    let size = format!("{} × {}", image.rows(), image.columns());
    CaptionedFigure {
        name: "psf",
        section: Section::Measurement,
        figure: picture(
            image,
            None,
            Map::Light,
            "share of the light",
            PixelScale::of_sensor(input.sensor),
        ),
        caption: format!(
            "The point spread function, {size} pixels: where the diffuser sends the light of one \
             point, dimensionless. A good one spreads over all rows in fine, sharp grains \
             without a bright core."
        ),
        alt: format!("Image of the point spread function, {size} pixels."),
    }
}

/// How self-calibration has changed the point spread function.
pub(super) fn psf_correction(input: &ReportInput, given: &Image) -> CaptionedFigure {
    let image = input.psf;
    let pairs = image.data().iter().zip(given.data());
    let change: Vec<f32> = pairs.map(|(after, before)| after - before).collect();
    let largest = change.iter().fold(0.0f32, |most, c| most.max(c.abs()));
    let limit = largest.max(f32::MIN_POSITIVE);
    let mut figure = Figure::new(800.0, 0.0);
    let plane = Plane::reduced(image.rows(), image.columns(), &change, LONGEST_SIDE);
    let pixels = plane.coloured(Map::Signed, -limit, limit);
    let place = put(&mut figure, Rect::new(0.0, 4.0, 640.0, 560.0), pixels);
    figure.rect(place, "axis", "");
    let range = (-limit, limit);
    colour_bar(&mut figure, place, Map::Signed, range, "share of the light");
    scale_bar(
        &mut figure,
        place,
        image.columns(),
        PixelScale::of_sensor(input.sensor),
    );
    figure.set_height(bar_bottom(place) + 22.0);
    let percent = 100.0 * f64::from(largest) / f64::from(given.max().max(f32::MIN_POSITIVE));
    CaptionedFigure {
        name: "psf-correction",
        section: Section::Measurement,
        figure,
        caption: format!(
            "How the frame has corrected the point spread function: after less before, at most {percent:.0} % of its \
             maximum. Rings or spokes about the centre mean another size or angle, single grains noise of the capture."
        ),
        alt: "Map of the change of the point spread function by self-calibration.".into(),
    }
}

/// The scene as the camera sees it without the diffuser.
pub(super) fn direct(input: &ReportInput, direct: Direct) -> CaptionedFigure {
    let image = direct.image;
    // One of another size has pixels of which nothing is known.
    let is_of_sensor =
        (image.rows(), image.columns()) == (input.frame.rows(), input.frame.columns());
    let scale = PixelScale::of_scene(input.sensor).filter(|_| is_of_sensor);
    let mut caption = String::from(match direct.origin {
        DirectOrigin::Truth => {
            "What the same camera would record without the diffuser (computed from the truth), in \
             the units of the frame"
        }
        DirectOrigin::Given => "The frame given as taken without the diffuser, in its own units",
    });
    caption += match input.video.shape().bins {
        1 => ".",
        _ => {
            ": each row sees the scene at its own instant only, and events elsewhere at that time \
             are lost."
        }
    };
    CaptionedFigure {
        name: "direct",
        section: Section::Measurement,
        figure: picture(image, None, Map::Grey, "recorded signal (counts)", scale),
        caption,
        alt: "Grey-scale image of the scene as the camera records it without diffuser.".into(),
    }
}

/// A reconstruction of a single bin, beside its truth.
pub(super) fn still(input: &ReportInput, videos: &Videos) -> CaptionedFigure {
    let shape = videos.video.shape();
    let mut figure = Figure::new(800.0, 0.0);
    let panels: Vec<_> = [
        ("reconstruction", Some(videos.video)),
        ("truth", videos.truth),
    ]
    .into_iter()
    .filter_map(|(name, video)| Some((name, video?)))
    .collect();
    let width = if panels.len() == 2 { 335.0 } else { 690.0 };
    let mut last = Rect::new(0.0, 0.0, 0.0, 0.0);
    for (i, (name, video)) in panels.iter().enumerate() {
        let available = Rect::new(i as f64 * (width + 10.0), 22.0, width, 560.0);
        let plane = Plane::reduced(shape.rows, shape.columns, video.bin(0), LONGEST_SIDE);
        let mut pixels = plane.coloured(Map::Light, 0.0, videos.high);
        if let (0, Some(mask)) = (i, unobserved(input, 0)) {
            let size = (shape.rows, shape.columns);
            pixels = pixels.marked(&mask, size, LONGEST_SIDE, UNOBSERVED);
        }
        last = put(&mut figure, available, pixels);
        let middle = last.x + last.width / 2.0;
        figure.text(middle, 14.0, Anchor::Middle, "strong", name);
    }
    let range = (0.0, videos.high);
    colour_bar(&mut figure, last, Map::Light, range, "light (counts)");
    scale_bar(
        &mut figure,
        last,
        shape.columns,
        PixelScale::of_scene(input.sensor),
    );
    figure.set_height(bar_bottom(last) + 22.0);
    CaptionedFigure {
        name: "reconstruction",
        section: Section::Video,
        figure,
        caption: format!(
            "The reconstruction: a single time bin, since every row integrates the same light. \
             {} A good one shows sharp objects on a dark, quiet ground.{}",
            light_text(input),
            unobserved_text(input, " (slate)")
        ),
        alt: "Image of the reconstructed scene.".into(),
    }
}

/// An image with its colour bar and a scale bar. The `excluded` pixels are marked and do not set the range.
fn picture(
    image: &Image,
    excluded: Option<&[u8]>,
    map: Map,
    unit: &str,
    scale: Option<PixelScale>,
) -> Figure {
    let values = without(image.data(), excluded);
    let high = display_high(&values);
    let low = display_low(&values, high);
    let mut figure = Figure::new(250.0 + BAR_ROOM, 0.0);
    let plane = Plane::reduced(image.rows(), image.columns(), image.data(), LONGEST_SIDE);
    let mut pixels = plane.coloured(map, low, high);
    if let Some(mask) = excluded {
        let size = (image.rows(), image.columns());
        pixels = pixels.marked(mask, size, LONGEST_SIDE, LEFT_OUT);
    }
    let available = Rect::new(0.0, 2.0, 250.0, 320.0);
    let place = put(&mut figure, available, pixels);
    colour_bar(&mut figure, place, map, (low, high), unit);
    scale_bar(&mut figure, place, image.columns(), scale);
    figure.set_height(bar_bottom(place) + 22.0);
    figure
}
