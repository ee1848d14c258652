//! Figures for papers: several of the report's, with letters, as SVG with vector text and as PNG.

use crate::figure::{Anchor, Figure};
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

/// A figure in both kinds of file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ComposedFigure {
    /// Text as text; pictures as PNG within.
    pub svg: String,
    /// 8-bit RGB on white, 1600 pixels wide.
    pub png: Vec<u8>,
}

const WIDTH: f64 = 800.0;
/// Between panels side by side, and room above one for its letter.
const GAP: f64 = 24.0;
const HEAD: f64 = 26.0;

impl Layout {
    /// Names of the report's figures, row by row.
    fn rows(self) -> &'static [&'static [&'static str]] {
        match self {
            Self::Fig2 => &[&["frame", "psf"], &["time-colour"], &["frames"]],
            Self::Fig3 => &[
                &["frame", "psf"],
                &["time-colour"],
                &["space-time"],
                &["traces"],
            ],
        }
    }
}

/// Draws the figure. Panels that the result has nothing for are left out.
///
/// # Errors
/// Those of [`crate::render`]; a result that none of the panels can be drawn of.
pub fn compose(input: &ReportInput, layout: Layout) -> Result<ComposedFigure> {
    check(input)?;
    let mut drawn: Vec<_> = figures::all(input).collect();
    let mut whole = Figure::new(WIDTH, 0.0);
    let mut letters = 'a'..='z';
    let mut top = 0.0;
    for names in layout.rows() {
        let mut panels = Vec::new();
        for name in *names {
            if let Some(at) = drawn.iter().position(|d| d.name == *name) {
                panels.push(drawn.swap_remove(at).figure);
            }
        }
        if panels.is_empty() {
            continue;
        }
        let gaps = GAP * (panels.len() - 1) as f64;
        let natural: f64 = panels.iter().map(Figure::width).sum();
        let scale = (WIDTH - gaps) / natural;
        let (mut left, mut tall) = (0.0, 0.0_f64);
        for panel in panels {
            let letter = letters.next().expect("fewer panels than letters");
            whole.text(
                left,
                top + 16.0,
                Anchor::Start,
                "strong",
                &letter.to_string(),
            );
            let (width, height) = (scale * panel.width(), scale * panel.height());
            whole.put(panel, left, top + HEAD, scale);
            left += width + GAP;
            tall = tall.max(height);
        }
        top += HEAD + tall + GAP;
    }
    if top == 0.0 {
        return Err(Error::input(
            Parameter::Figure,
            "a result without any of its panels",
            "a layout has at least one panel",
            phrase!["Choose another ", Parameter::Layout, "."],
        ));
    }
    whole.set_height(top - GAP);
    Ok(ComposedFigure {
        svg: whole.file()?,
        png: whole.png()?,
    })
}
