//! A page of curves, maps and tables: calibrations and designs.

use rowburst::{Image, Result};

use crate::chart::{Axis, Chart, Labels};
use crate::colour::Map;
use crate::figure::{Anchor, Figure, Rect};
use crate::page::{Entry, Page, Part};
use crate::panel::{colour_bar, put};
use crate::pixels::{LONGEST_SIDE, Plane};
use crate::stats::{display_high, display_low};
use crate::{FitVerdict, Picture, Report};

/// What a page is made of.
#[derive(Debug, Clone, Default)]
pub struct Sheet<'a> {
    /// Title of the page.
    pub title: &'a str,
    /// One line of what was made of what.
    pub summary: String,
    /// The verdict, at the top, and its reason.
    pub verdict: Option<(&'static str, String)>,
    /// What the reader must know before the numbers, one sentence or two each.
    pub warnings: Vec<String>,
    /// What the numbers rest on, a sentence or two each.
    pub notes: Vec<String>,
    /// The few big numbers, as (name, value with unit).
    pub headline: Vec<(String, String)>,
    /// Headings with their drawings.
    pub sections: Vec<(&'a str, Vec<Drawing<'a>>)>,
    /// Tables, as (name, [(quantity, value with unit)]).
    pub tables: Vec<(String, Vec<(String, String)>)>,
    /// Files written beside the page, as (name, what it is).
    pub files: Vec<(String, String)>,
    /// The command line that repeats the run.
    pub reproduce: Option<&'a str>,
}

/// A plot with its words.
#[derive(Debug, Clone)]
pub struct Drawing<'a> {
    /// File name without extension, and id in the page: letters, digits and hyphens.
    pub name: &'a str,
    /// What is drawn.
    pub plot: Plot<'a>,
    /// What is seen, its units and what a good one looks like.
    pub caption: String,
    /// What is seen, for those who do not see it.
    pub alt: String,
}

/// What a [`Drawing`] draws.
#[derive(Debug, Clone)]
pub enum Plot<'a> {
    /// Curves over one pair of axes.
    Curves {
        /// Label of the horizontal axis, with its unit, and its scale.
        x: (&'a str, Scale),
        /// Label of the vertical axis, with its unit, and its scale.
        y: (&'a str, Scale),
        /// What is drawn, first at the bottom.
        curves: Vec<Curve>,
    },
    /// A picture of the values of an image with a colour bar.
    Map {
        /// The values; those that are not finite are grey.
        image: &'a Image,
        /// Name of the quantity, with its unit.
        quantity: &'a str,
        /// Values of black and white; `None`: from the image.
        range: Option<(f32, f32)>,
    },
    /// A picture of values over two quantities, drawn with axes.
    Grid {
        /// The values `[y, x]`, its first row at the bottom.
        image: &'a Image,
        /// Name of the quantity, with its unit, and the values of black and white.
        quantity: (&'a str, f32, f32),
        /// Label of the horizontal axis, and the values at the middle of each column.
        x: (&'a str, &'a [f64]),
        /// Label of the vertical axis, and the values at the middle of each row.
        y: (&'a str, &'a [f64]),
    },
}

/// Scale of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scale {
    /// From the smallest to the largest value with a margin; logarithmic where all are
    /// positive and span more than a decade.
    Auto,
    /// Linear between two ends.
    Linear(f64, f64),
    /// Logarithmic between two ends above zero.
    Log(f64, f64),
}

/// Points with a name.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// What it is; empty for none in the legend.
    pub name: String,
    /// `(x, y)`; a value that is not finite interrupts a line.
    pub points: Vec<(f64, f64)>,
    /// How it is drawn.
    pub ink: Ink,
}

/// How a [`Curve`] is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ink {
    /// A line.
    Line,
    /// A dashed grey line: what is expected.
    Expected,
    /// A dot at each point: what was measured.
    Dots,
    /// Bars from the bottom, as wide as the points are apart.
    Bars,
}

/// Colours of curves, told apart by colour-blind readers too, on white and on black.
const COLOURS: [&str; 6] = [
    "#2a85c9", "#e0662f", "#1a9b74", "#c563ae", "#c2940b", "#7577d6",
];

impl Sheet<'_> {
    /// Renders the page and its pictures.
    ///
    /// # Errors
    /// A picture that cannot be encoded.
    pub fn render(&self) -> Result<Report> {
        let mut pictures = Vec::new();
        let mut parts = Vec::new();
        for (heading, drawings) in &self.sections {
            let mut entries = Vec::new();
            for drawing in drawings {
                let figure = drawing.plot.draw();
                let file = format!("{}.png", drawing.name);
                pictures.push(Picture {
                    png: figure.png()?,
                    caption: drawing.caption.clone(),
                    name: file.clone(),
                });
                entries.push(Entry {
                    svg: figure.svg(drawing.name, &drawing.alt)?,
                    wide: figure.is_wide(),
                    file,
                    caption: drawing.caption.clone(),
                });
            }
            parts.push(Part {
                heading,
                plays: false,
                mp4: None,
                entries,
            });
        }
        let html = Page {
            title: self.title,
            summary: self.summary.clone(),
            verdict: self
                .verdict
                .as_ref()
                .map(|(verdict, reason)| FitVerdict { verdict, reason }),
            warnings: &self.warnings,
            notes: &self.notes,
            player: None,
            headline: &self.headline,
            fit: None,
            parts,
            settings: &self.tables,
            files: &self.files,
            reproduce: self.reproduce,
        }
        .html();
        Ok(Report { html, pictures })
    }
}

impl Plot<'_> {
    fn draw(&self) -> Figure {
        match self {
            Self::Curves { x, y, curves } => draw_curves(*x, *y, curves),
            Self::Map {
                image,
                quantity,
                range,
            } => draw_map(image, quantity, *range),
            Self::Grid {
                image,
                quantity,
                x,
                y,
            } => draw_grid(image, *quantity, *x, *y),
        }
    }
}

/// Dots are rings of this radius.
const DOT: f64 = 2.6;

fn draw_curves(x: (&str, Scale), y: (&str, Scale), curves: &[Curve]) -> Figure {
    let named = || curves.iter().filter(|c| !c.name.is_empty());
    let top = 10.0 + 18.0 * named().count() as f64;
    let mut figure = Figure::new(480.0, top + 262.0);
    let values = |of: fn(&(f64, f64)) -> f64| curves.iter().flat_map(|c| &c.points).map(of);
    let axis = |(label, scale): (&str, Scale), of: fn(&(f64, f64)) -> f64| match scale {
        Scale::Auto => Axis::about(values(of), label),
        Scale::Linear(low, high) => Axis::linear(low, high, label),
        Scale::Log(low, high) => Axis::logarithmic(low, high, label),
    };
    let chart = Chart {
        place: Rect::new(66.0, top, 400.0, 218.0),
        x: axis(x, |p| p.0),
        y: axis(y, |p| p.1),
    };
    chart.frame(&mut figure, Labels::Both);
    let mut legend = 12.0;
    for (i, curve) in curves.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let stroke = format!(r#"style="stroke:{colour}""#);
        let swatch = [(70.0, legend - 4.0), (92.0, legend - 4.0)];
        let draw = |figure: &mut Figure, at: &[(f64, f64)]| match curve.ink {
            Ink::Line => figure.line(at, "line", &stroke),
            Ink::Expected => figure.line(at, "reference", r#"stroke-dasharray="4 3""#),
            Ink::Dots => {
                for &(x, y) in at {
                    figure.ring(x, y, DOT, colour, 1.6);
                }
            }
            Ink::Bars => bars(figure, &chart, at),
        };
        match curve.ink {
            Ink::Line => chart.curve(&mut figure, &curve.points, "line", &stroke),
            Ink::Expected => chart.curve(
                &mut figure,
                &curve.points,
                "reference",
                r#"stroke-dasharray="4 3""#,
            ),
            Ink::Dots | Ink::Bars => {
                let finite = curve
                    .points
                    .iter()
                    .filter(|(x, y)| x.is_finite() && y.is_finite());
                let at: Vec<_> = finite.map(|&(x, y)| chart.at(x, y)).collect();
                draw(&mut figure, &at);
            }
        }
        if !curve.name.is_empty() {
            match curve.ink {
                Ink::Bars => {
                    let swatch = Rect::new(70.0, legend - 10.0, 22.0, 10.0);
                    figure.rect(swatch, "bars", "");
                }
                Ink::Dots => draw(&mut figure, &[(81.0, legend - 4.0)]),
                _ => draw(&mut figure, &swatch),
            }
            figure.text(100.0, legend, Anchor::Start, "", &curve.name);
            legend += 18.0;
        }
    }
    figure
}

fn bars(figure: &mut Figure, chart: &Chart, at: &[(f64, f64)]) {
    let width = match at {
        [a, b, ..] => (b.0 - a.0).abs(),
        _ => 8.0,
    };
    let bottom = chart.place.bottom();
    for &(x, y) in at {
        let bar = Rect::new(x - 0.5 * width, y, width, (bottom - y).max(0.0));
        figure.rect(bar, "bars", "");
    }
}

fn draw_map(image: &Image, quantity: &str, range: Option<(f32, f32)>) -> Figure {
    let (low, high) = range.unwrap_or_else(|| {
        let high = display_high(image.data());
        (display_low(image.data(), high), high)
    });
    let mut figure = Figure::new(480.0, 0.0);
    let plane = Plane::reduced(image.rows(), image.columns(), image.data(), LONGEST_SIDE);
    let available = Rect::new(0.0, 2.0, 390.0, 390.0);
    let place = put(
        &mut figure,
        available,
        plane.coloured(Map::Light, low, high),
    );
    colour_bar(&mut figure, place, Map::Light, (low, high), quantity);
    figure.set_height(place.bottom().max(116.0) + 6.0);
    figure
}

fn draw_grid(
    image: &Image,
    (quantity, low, high): (&str, f32, f32),
    x: (&str, &[f64]),
    y: (&str, &[f64]),
) -> Figure {
    let mut figure = Figure::new(480.0, 320.0);
    let flipped = Image::from_fn(image.rows(), image.columns(), |r, c| {
        image.at(image.rows() - 1 - r, c)
    });
    let plane = Plane::reduced(image.rows(), image.columns(), flipped.data(), LONGEST_SIDE);
    let place = Rect::new(66.0, 8.0, 320.0, 260.0);
    figure.raster(place, plane.coloured(Map::Light, low, high));
    figure.rect(place, "axis", "");
    colour_bar(&mut figure, place, Map::Light, (low, high), quantity);
    let (columns, rows) = (image.columns() as f64, image.rows() as f64);
    for (i, text) in grid_ticks(x.1) {
        let at = place.x + (i + 0.5) / columns * place.width;
        figure.text(at, place.bottom() + 16.0, Anchor::Middle, "muted", &text);
    }
    for (i, text) in grid_ticks(y.1) {
        let at = place.bottom() - (i + 0.5) / rows * place.height;
        figure.text(place.x - 6.0, at + 4.0, Anchor::End, "muted", &text);
    }
    let below = place.bottom() + 34.0;
    figure.text(place.x + place.width / 2.0, below, Anchor::Middle, "", x.0);
    figure.text_upwards(place.x - 46.0, place.y + place.height / 2.0, "", y.0);
    figure
}

/// Ticks of a grid whose rows or columns have these `values`: their places, counted in rows or columns, and texts. They are
/// round values where the values are equally far from each other, else some of the values.
fn grid_ticks(values: &[f64]) -> Vec<(f64, String)> {
    const TICKS: usize = 7;
    let last = values.len().saturating_sub(1);
    let step = (values.last().copied().unwrap_or(0.0) - values.first().copied().unwrap_or(0.0))
        / last.max(1) as f64;
    let is_even = |(i, v): (usize, &f64)| {
        (v - (values[0] + i as f64 * step)).abs() <= 1e-6 * step.abs() * values.len() as f64
    };
    if last > TICKS && step > 0.0 && values.iter().enumerate().all(is_even) {
        let axis = Axis::linear(values[0], values[last], "");
        let ticks = axis.ticks(TICKS - 1).into_iter();
        return ticks
            .map(|(value, text)| ((value - values[0]) / step, text))
            .collect();
    }
    let every = values.len().div_ceil(TICKS).max(1);
    let some = values.iter().enumerate().step_by(every);
    some.map(|(i, &value)| (i as f64, crate::format::number(value, 3)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_of_a_grid_are_round_where_they_can_be() {
        let values: Vec<f64> = (0..32).map(|i| 18.7 / 7.0 * f64::from(i)).collect();
        let texts: Vec<String> = grid_ticks(&values).into_iter().map(|t| t.1).collect();
        assert_eq!(texts, ["0", "10", "20", "30", "40", "50", "60", "70", "80"]);
        let powers = [1.0, 2.0, 4.0, 8.0];
        let places: Vec<f64> = grid_ticks(&powers).into_iter().map(|t| t.0).collect();
        assert_eq!(places, [0.0, 1.0, 2.0, 3.0]);
        assert!(grid_ticks(&[]).is_empty());
    }

    #[test]
    fn a_sheet_has_all_that_it_is_given() {
        let image = Image::from_fn(6, 9, |y, x| (y * x) as f32);
        let drawing = |name, plot| Drawing {
            name,
            plot,
            caption: format!("caption of {name}"),
            alt: "a plot".into(),
        };
        let points: Vec<(f64, f64)> = (1..9).map(|i| (f64::from(i), f64::from(i * i))).collect();
        let inks = [Ink::Bars, Ink::Line, Ink::Expected, Ink::Dots];
        let curves = inks
            .map(|ink| Curve {
                name: format!("{ink:?}"),
                points: points.clone(),
                ink,
            })
            .to_vec();
        let sheet = Sheet {
            title: "A <sheet>",
            verdict: Some(("doubtful", "one warning".into())),
            warnings: vec!["beware".into()],
            notes: vec!["no dark frame".into()],
            sections: vec![(
                "Plots",
                vec![
                    drawing(
                        "curves",
                        Plot::Curves {
                            x: ("x (px)", Scale::Linear(0.0, 9.0)),
                            y: ("y (counts)", Scale::Auto),
                            curves,
                        },
                    ),
                    drawing(
                        "map",
                        Plot::Map {
                            image: &image,
                            quantity: "counts",
                            range: None,
                        },
                    ),
                    drawing(
                        "grid",
                        Plot::Grid {
                            image: &image,
                            quantity: ("success", 0.0, 1.0),
                            x: ("k", &[1.0; 9]),
                            y: ("SNR", &[2.0; 6]),
                        },
                    ),
                ],
            )],
            tables: vec![("Sensor".into(), vec![("gain".into(), "0.5".into())])],
            ..Sheet::default()
        };
        let report = sheet.render().unwrap();
        for words in [
            "A &lt;sheet&gt;",
            "Verdict: doubtful. </strong>One warning.",
            "beware",
            "no dark frame",
            "caption of curves",
            "caption of grid",
            ">Dots<",
            "y (counts)",
            "gain",
        ] {
            assert!(report.html.contains(words), "{words}");
        }
        assert_eq!(report.pictures.len(), 3);
        assert!(report.pictures.iter().all(|p| p.png.len() > 1000));
    }
}
