//! Figures for papers: several of the report's, with letters, as SVG and PDF with vector text, and as PNG.

use crate::figure::{Anchor, Figure, pdf_of};
use crate::{ReportInput, check, figures};
use rowburst::{Error, Parameter, Result, phrase};

/// What stands where.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// The paper's Fig. 2: frame, PSF, scene without the diffuser, bins with the rows that see them.
    Fig2,
    /// The paper's Fig. 3: frame, time as colour, bright points in space and time, traces and spectra.
    Fig3,
}

/// What of a result is drawn, and how large.
#[derive(Debug, Clone, PartialEq)]
pub struct FigureOptions {
    /// The panels, where `panels` does not name them.
    pub layout: Layout,
    /// Width on paper in mm; `None`: 800 units of an SVG, 1600 pixels of a PNG.
    pub width_mm: Option<f64>,
    /// Names of the panels, in their order; empty: those of the layout.
    pub panels: Vec<String>,
    /// Bins of the panels `frames` and `change`; empty: some that are spread over the video.
    pub bins: Vec<usize>,
}

impl From<Layout> for FigureOptions {
    fn from(layout: Layout) -> Self {
        Self {
            layout,
            width_mm: None,
            panels: Vec::new(),
            bins: Vec::new(),
        }
    }
}

/// A figure in both kinds of file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComposedFigure {
    /// Text as text; pictures as PNG within.
    pub svg: String,
    /// 8-bit RGB on white, 1600 pixels wide, or 600 dpi where the width on paper is given.
    pub png: Vec<u8>,
}

impl ComposedFigure {
    /// The figure as a PDF file of one page: text as text with its fonts, pictures as they are. Its width is that on
    /// paper, where it is given.
    ///
    /// # Errors
    /// A figure that cannot be converted, or a build without the feature `pdf`.
    pub fn pdf(&self) -> Result<Vec<u8>> {
        pdf_of(&self.svg)
    }
}

const WIDTH: f64 = 800.0;
/// Between panels side by side, and room above one for its letter.
const GAP: f64 = 24.0;
const HEAD: f64 = 26.0;
/// Units of a figure in a millimetre of paper: its text has 7 pt.
const UNITS_PER_MM: f64 = 12.0 / (7.0 * 25.4 / 72.0);
/// Widths on paper that a figure may have, in mm.
const WIDTHS_MM: std::ops::RangeInclusive<f64> = 40.0..=1000.0;
const DPI: f64 = 600.0;

/// The panel of still part and change, which is drawn where it is asked for.
const CHANGE: &str = "change";

/// Names of the panels that a result may have.
const PANELS: [&str; 10] = [
    "frame",
    "psf",
    "direct",
    "residual",
    "time-colour",
    "reconstruction",
    "space-time",
    "frames",
    CHANGE,
    "traces",
];

impl Layout {
    /// Names of the report's figures, in their order.
    fn panels(self) -> &'static [&'static str] {
        match self {
            Self::Fig2 => &["frame", "psf", "time-colour", "frames"],
            Self::Fig3 => &["frame", "psf", "time-colour", "space-time", "traces"],
        }
    }
}

impl FigureOptions {
    /// Checks the options against a video of `bins`.
    fn check(&self, bins: usize) -> Result<()> {
        if let Some(mm) = self.width_mm.filter(|mm| !WIDTHS_MM.contains(mm)) {
            return Err(Error::input(
                Parameter::Figure,
                format!("a width of {mm} mm"),
                "a figure is 40 to 1000 mm wide",
                "One column of a journal is about 86 mm wide, two are 178 mm.",
            ));
        }
        if let Some(name) = self.panels.iter().find(|n| !PANELS.contains(&n.as_str())) {
            return Err(Error::input(
                Parameter::Figure,
                format!("the panel \"{name}\""),
                format!("the panels are {}", PANELS.join(", ")),
                "Name some of these.",
            ));
        }
        if let Some(bin) = self.bins.iter().find(|&&bin| bin >= bins) {
            return Err(Error::input(
                Parameter::Bins,
                format!("bin {bin}"),
                format!("the bins of this video are 0 to {}", bins - 1),
                "Name bins of the video.",
            ));
        }
        Ok(())
    }

    /// Width in units of the figure.
    fn width(&self) -> f64 {
        self.width_mm
            .map_or(WIDTH, |mm| (mm * UNITS_PER_MM).round())
    }
}

/// Draws the figure. Panels that the result has nothing for are left out. Text has the same size in all panels that are no
/// wider than the figure; such panels stand side by side where there is room.
///
/// # Errors
/// Those of [`crate::render`]; options that are not possible; a result that none of the panels can be drawn of.
pub fn compose(input: &ReportInput, options: &FigureOptions) -> Result<ComposedFigure> {
    check(input)?;
    options.check(input.video.shape().bins)?;
    let bins = Some(options.bins.as_slice()).filter(|bins| !bins.is_empty());
    let names = options.panels.iter().map(String::as_str);
    let names: Vec<&str> = if options.panels.is_empty() {
        options.layout.panels().to_vec()
    } else {
        names.collect()
    };
    let input = ReportInput {
        draws_change: names.contains(&CHANGE),
        ..input.clone()
    };
    let mut drawn: Vec<_> = figures::all(&input, bins).collect();
    let width = options.width();
    let mut whole = Figure::new(width, 0.0);
    if let Some(mm) = options.width_mm {
        whole.set_paper(mm, DPI);
    }
    let mut letters = ('a'..='z').cycle();
    let (mut left, mut top, mut tall) = (0.0, 0.0, 0.0_f64);
    for name in names {
        let Some(at) = drawn.iter().position(|d| d.name == name) else {
            continue;
        };
        let panel = drawn.swap_remove(at).figure;
        let scale = (width / panel.width()).min(1.0);
        let (wide, height) = (scale * panel.width(), scale * panel.height());
        if left > 0.0 && left + wide > width {
            (left, top, tall) = (0.0, top + HEAD + tall + GAP, 0.0);
        }
        let letter = letters.next().expect("a cycle has no end").to_string();
        whole.text(left, top + 16.0, Anchor::Start, "strong", &letter);
        whole.put(panel, left, top + HEAD, scale);
        left += wide + GAP;
        tall = tall.max(height);
    }
    if tall == 0.0 {
        return Err(Error::input(
            Parameter::Figure,
            "a result without any of its panels",
            "a layout has at least one panel",
            phrase!["Choose another ", Parameter::Layout, "."],
        ));
    }
    whole.set_height(top + HEAD + tall);
    Ok(ComposedFigure {
        svg: whole.file()?,
        png: whole.png()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_checked() {
        let options = |change: fn(&mut FigureOptions)| {
            let mut options = FigureOptions::from(Layout::Fig2);
            change(&mut options);
            options.check(54)
        };
        assert!(options(|_| ()).is_ok());
        assert!(options(|o| o.bins = vec![0, 53]).is_ok());
        type Change = fn(&mut FigureOptions);
        let wrong: [(Change, &str); 4] = [
            (|o| o.bins = vec![54], "0 to 53"),
            (|o| o.panels = vec!["frane".into()], "frame, psf"),
            (|o| o.width_mm = Some(8.6), "40 to 1000 mm"),
            (|o| o.width_mm = Some(f64::NAN), "40 to 1000 mm"),
        ];
        for (change, words) in wrong {
            let error = options(change).unwrap_err();
            assert!(
                error.is_input() && error.to_string().contains(words),
                "{error}"
            );
        }
    }

    #[test]
    fn text_on_paper_has_seven_points() {
        let mut options = FigureOptions::from(Layout::Fig3);
        options.width_mm = Some(178.0);
        let point_mm = 25.4 / 72.0;
        let text_mm = 12.0 * 178.0 / options.width();
        assert!((text_mm / point_mm - 7.0).abs() < 0.02, "{text_mm} mm");
    }
}
