//! A figure: rasters in place, and SVG drawn over them.

use std::fmt::Write as _;
use std::sync::{Arc, LazyLock};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use maud::Render as _;
use resvg::{tiny_skia, usvg};
use rowburst::Result;

use crate::pixels::{Pixels, failed};

/// Where a text is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Anchor {
    Start,
    Middle,
    End,
}

/// A rectangle in units of the figure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rect {
    pub x: f64,
    pub y: f64,
    pub width: f64,
    pub height: f64,
}

impl Rect {
    pub(crate) fn new(x: f64, y: f64, width: f64, height: f64) -> Self {
        Self {
            x,
            y,
            width,
            height,
        }
    }

    pub(crate) fn right(&self) -> f64 {
        self.x + self.width
    }

    pub(crate) fn bottom(&self) -> f64 {
        self.y + self.height
    }
}

/// Figures below this width stand side by side in the page.
const NARROW: f64 = 500.0;

/// A figure of given size. What is drawn takes its colour from a class: the style
/// sheet of the page, or `RASTER_CSS` in the PNG.
#[derive(Debug)]
pub(crate) struct Figure {
    width: f64,
    height: f64,
    /// Pixels of the PNG for each unit.
    scale: f64,
    /// Width on paper in mm, and pixels per inch of the PNG.
    paper: Option<(f64, f64)>,
    rasters: Vec<(Rect, Pixels)>,
    body: String,
}

/// Classes of the SVG in the PNG: ink on white. The page's style sheet has the same classes.
const RASTER_CSS: &str = "text{font-family:'DejaVu Sans';font-size:12px;fill:#1d2330}.mark text{fill:inherit}\
.muted{fill:#5b6472}.strong{font-weight:bold}\
.axis{stroke:#6b7482;stroke-width:1;fill:none}.grid{stroke:#e3e6eb;stroke-width:1;fill:none}\
.line{stroke:#1f6fb2;stroke-width:1.6;fill:none}.reference{stroke:#5b6472;stroke-width:1.2;fill:none}\
.bars{fill:#8fb6d8;stroke:none}";

static FONTS: LazyLock<Arc<usvg::fontdb::Database>> = LazyLock::new(|| {
    let mut fonts = usvg::fontdb::Database::new();
    for face in [dejavu::sans::regular(), dejavu::sans::bold()] {
        fonts.load_font_source(usvg::fontdb::Source::Binary(Arc::new(face)));
    }
    Arc::new(fonts)
});

impl Figure {
    /// An empty figure. PNGs are 1200 to 1600 pixels wide.
    pub(crate) fn new(width: f64, height: f64) -> Self {
        Self {
            width,
            height,
            scale: if width < NARROW { 4.0 } else { 2.0 },
            paper: None,
            rasters: Vec::new(),
            body: String::new(),
        }
    }

    /// Gives the figure a width on paper, and its PNG as many pixels as `dpi` asks for.
    pub(crate) fn set_paper(&mut self, width_mm: f64, dpi: f64) {
        self.paper = Some((width_mm, dpi));
        self.scale = width_mm / 25.4 * dpi / self.width;
    }

    /// Sets the height, where it is known only after drawing.
    pub(crate) fn set_height(&mut self, height: f64) {
        self.height = height.ceil();
    }

    /// Its width.
    pub(crate) fn width(&self) -> f64 {
        self.width
    }

    /// Its height.
    pub(crate) fn height(&self) -> f64 {
        self.height
    }

    /// Puts all of `other` at `(x, y)`, enlarged by `scale`.
    pub(crate) fn put(&mut self, other: Self, x: f64, y: f64, scale: f64) {
        for (place, pixels) in other.rasters {
            let place = Rect::new(
                x + scale * place.x,
                y + scale * place.y,
                scale * place.width,
                scale * place.height,
            );
            self.rasters.push((place, pixels));
        }
        let _ = write!(
            self.body,
            r#"<g transform="translate({x:.2} {y:.2}) scale({scale:.5})">{}</g>"#,
            other.body
        );
    }

    /// Pixels of the PNG for each unit.
    pub(crate) fn scale(&self) -> f64 {
        self.scale
    }

    /// Whether the figure needs the full width of the page.
    pub(crate) fn is_wide(&self) -> bool {
        self.width >= NARROW
    }

    /// Puts a raster into `place`, under everything that is drawn.
    pub(crate) fn raster(&mut self, place: Rect, pixels: Pixels) {
        self.rasters.push((place, pixels));
    }

    /// Writes `text`; its baseline begins, is centred or ends at `(x, y)`.
    pub(crate) fn text(&mut self, x: f64, y: f64, anchor: Anchor, class: &str, text: &str) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let text = text.render().into_string();
        let _ = write!(
            self.body,
            r#"<text x="{x:.1}" y="{y:.1}" text-anchor="{anchor}" class="{class}">{text}</text>"#
        );
    }

    /// Writes bold `text` in a colour with a dark edge, legible on any image.
    pub(crate) fn mark(&mut self, x: f64, y: f64, anchor: Anchor, colour: &str, text: &str) {
        let _ = write!(
            self.body,
            r#"<g class="mark" style="fill:{colour};paint-order:stroke;stroke:#000;stroke-width:2.5px">"#
        );
        self.text(x, y, anchor, "strong", text);
        self.body.push_str("</g>");
    }

    /// Writes `text` in a colour, where that of the page would not be seen.
    pub(crate) fn label(&mut self, x: f64, y: f64, anchor: Anchor, colour: &str, text: &str) {
        let _ = write!(self.body, r#"<g class="mark" style="fill:{colour}">"#);
        self.text(x, y, anchor, "", text);
        self.body.push_str("</g>");
    }

    /// Writes `text` upwards, centred at `(x, y)`.
    pub(crate) fn text_upwards(&mut self, x: f64, y: f64, class: &str, text: &str) {
        let _ = write!(
            self.body,
            r#"<g transform="translate({x:.1} {y:.1}) rotate(-90)">"#
        );
        self.text(0.0, 0.0, Anchor::Middle, class, text);
        self.body.push_str("</g>");
    }

    /// Draws an open line through `points`; `style` holds further attributes.
    pub(crate) fn line(&mut self, points: &[(f64, f64)], class: &str, style: &str) {
        if points.is_empty() {
            return;
        }
        let _ = write!(self.body, r#"<polyline class="{class}" {style} points=""#);
        for (x, y) in points {
            let _ = write!(self.body, "{x:.1},{y:.1} ");
        }
        self.body.push_str("\"/>");
    }

    /// Draws many short strokes, each from a point by a step, as one element.
    pub(crate) fn strokes(&mut self, from: &[(f64, f64)], step: (f64, f64), style: &str) {
        if from.is_empty() {
            return;
        }
        let _ = write!(self.body, r#"<path {style} d=""#);
        for (x, y) in from {
            let _ = write!(self.body, "M{x:.1} {y:.1}l{:.2} {:.2}", step.0, step.1);
        }
        self.body.push_str("\"/>");
    }

    /// Fills the polygon `points`; `style` holds attributes.
    pub(crate) fn area(&mut self, points: &[(f64, f64)], style: &str) {
        if points.len() < 3 {
            return;
        }
        let _ = write!(self.body, r#"<polygon {style} points=""#);
        for (x, y) in points {
            let _ = write!(self.body, "{x:.1},{y:.1} ");
        }
        self.body.push_str("\"/>");
    }

    /// Draws a rectangle; `style` holds further attributes.
    pub(crate) fn rect(&mut self, rect: Rect, class: &str, style: &str) {
        let Rect {
            x,
            y,
            width,
            height,
        } = rect;
        let _ = write!(
            self.body,
            r#"<rect x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" class="{class}" {style}/>"#
        );
    }

    /// Draws a ring.
    pub(crate) fn ring(&mut self, x: f64, y: f64, radius: f64, colour: &str, width: f64) {
        let _ = write!(
            self.body,
            r#"<circle cx="{x:.1}" cy="{y:.1}" r="{radius:.1}" fill="none" stroke="{colour}" stroke-width="{width}"/>"#
        );
    }

    /// The figure as an SVG element of the page; `alt` says in words what it shows.
    pub(crate) fn svg(&self, id: &str, alt: &str) -> Result<String> {
        let alt = alt.render().into_string();
        let mut svg = format!(
            r#"<svg role="img" aria-labelledby="{id}-alt" viewBox="0 0 {} {}" width="{}" height="{}"><title id="{id}-alt">{alt}</title>"#,
            self.width, self.height, self.width, self.height
        );
        self.write_rasters(&mut svg)?;
        svg.push_str(&self.body);
        svg.push_str("</svg>");
        Ok(svg)
    }

    /// The figure as an SVG file of its own, ink on white.
    pub(crate) fn file(&self) -> Result<String> {
        let (width, height) = (self.width, self.height);
        let (across, down) = match self.paper {
            Some((mm, _)) => (format!("{mm}mm"), format!("{:.2}mm", mm * height / width)),
            None => (width.to_string(), height.to_string()),
        };
        let mut svg = format!(
            r##"<?xml version="1.0" encoding="UTF-8"?><svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{across}" height="{down}"><style>{RASTER_CSS}.pixels{{image-rendering:pixelated}}</style><rect width="100%" height="100%" fill="#fff"/>"##
        );
        self.write_rasters(&mut svg)?;
        svg.push_str(&self.body);
        svg.push_str("</svg>\n");
        Ok(svg)
    }

    fn write_rasters(&self, svg: &mut String) -> Result<()> {
        for (place, pixels) in &self.rasters {
            let sharp = place.width * self.scale >= pixels.columns as f64;
            let class = if sharp { "pixels" } else { "photo" };
            let _ = write!(
                svg,
                r#"<image class="{class}" x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}" preserveAspectRatio="none" href="data:image/png;base64,"#,
                place.x, place.y, place.width, place.height
            );
            BASE64_STANDARD.encode_string(pixels.png()?, svg);
            svg.push_str("\"/>");
        }
        Ok(())
    }

    /// The figure as a PNG file, on white.
    pub(crate) fn png(&self) -> Result<Vec<u8>> {
        let [width, height] = [self.width, self.height].map(|s| (s * self.scale).ceil() as u32);
        let mut canvas =
            tiny_skia::Pixmap::new(width, height).ok_or_else(|| failed("a figure without area"))?;
        canvas.fill(tiny_skia::Color::WHITE);
        for (place, pixels) in &self.rasters {
            blit(&mut canvas, self.scale, place, pixels);
        }
        let svg = format!(
            r#"<svg xmlns="http://www.w3.org/2000/svg" width="{}" height="{}"><style>{RASTER_CSS}</style>{}</svg>"#,
            self.width, self.height, self.body
        );
        let tree = usvg::Tree::from_str(&svg, &svg_options()).map_err(failed)?;
        let scale = self.scale as f32;
        resvg::render(
            &tree,
            tiny_skia::Transform::from_scale(scale, scale),
            &mut canvas.as_mut(),
        );
        encode(&canvas, self.paper.map(|(_, dpi)| dpi))
    }
}

/// How an SVG is read: with the embedded fonts alone, and 96 px in an inch.
pub(crate) fn svg_options() -> usvg::Options<'static> {
    usvg::Options {
        fontdb: FONTS.clone(),
        font_family: "DejaVu Sans".into(),
        dpi: DPI,
        ..usvg::Options::default()
    }
}

/// Pixels of an SVG in an inch of paper.
const DPI: f32 = 96.0;

/// An SVG file as a PDF file of one page.
#[cfg(feature = "pdf")]
pub(crate) fn pdf_of(svg: &str) -> Result<Vec<u8>> {
    let tree = usvg::Tree::from_str(svg, &svg_options()).map_err(failed)?;
    let page = svg2pdf::PageOptions { dpi: DPI };
    svg2pdf::to_pdf(&tree, svg2pdf::ConversionOptions::default(), page).map_err(failed)
}

#[cfg(not(feature = "pdf"))]
pub(crate) fn pdf_of(_svg: &str) -> Result<Vec<u8>> {
    Err(rowburst::Error::work(
        rowburst::error::Subject::named("PDF"),
        "it is not part of this program",
        "Write an .svg or .png, or build it in: cargo install --locked --path crates/rowburst-cli --features pdf. Releases and the Python package have it.",
    )
    .with_kind(rowburst::ErrorKind::Unsupported))
}

/// Copies a raster into its place: nearest neighbour when enlarged, block means when reduced.
fn blit(canvas: &mut tiny_skia::Pixmap, scale: f64, place: &Rect, pixels: &Pixels) {
    let edge = |v: f64, limit: u32| ((v * scale).round().max(0.0) as usize).min(limit as usize);
    let (left, right) = (
        edge(place.x, canvas.width()),
        edge(place.right(), canvas.width()),
    );
    let (top, bottom) = (
        edge(place.y, canvas.height()),
        edge(place.bottom(), canvas.height()),
    );
    let sources = |from: usize, to: usize, count: usize| -> Vec<std::ops::Range<usize>> {
        let length = to.saturating_sub(from).max(1);
        let start = |i: usize| i * count / length;
        (0..length)
            .map(|i| start(i)..start(i + 1).max(start(i) + 1).min(count))
            .collect()
    };
    let columns = sources(left, right, pixels.columns);
    let stride = canvas.width() as usize;
    let data = canvas.data_mut();
    for (y, rows) in (top..bottom).zip(sources(top, bottom, pixels.rows)) {
        for (x, columns) in (left..right).zip(&columns) {
            let mut sum = [0_u32; 3];
            for source_y in rows.clone() {
                for source_x in columns.clone() {
                    let colour = pixels.at(source_y, source_x);
                    for (sum, c) in sum.iter_mut().zip(colour) {
                        *sum += u32::from(c);
                    }
                }
            }
            let count = (rows.len() * columns.len()).max(1) as u32;
            let at = 4 * (y * stride + x);
            for (target, sum) in data[at..at + 3].iter_mut().zip(sum) {
                *target = (sum / count) as u8;
            }
        }
    }
}

/// RGB rows of the opaque canvas, written one at a time.
fn encode(canvas: &tiny_skia::Pixmap, dpi: Option<f64>) -> Result<Vec<u8>> {
    use std::io::Write as _;
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, canvas.width(), canvas.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fast);
    let per_metre = dpi.map(|dpi| (dpi / 0.0254).round() as u32);
    encoder.set_pixel_dims(per_metre.map(|n| png::PixelDimensions {
        xppu: n,
        yppu: n,
        unit: png::Unit::Meter,
    }));
    let mut writer = encoder.write_header().map_err(failed)?;
    let mut stream = writer.stream_writer().map_err(failed)?;
    let mut row = Vec::with_capacity(3 * canvas.width() as usize);
    for pixels in canvas.data().chunks_exact(4 * canvas.width() as usize) {
        row.clear();
        row.extend(pixels.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]));
        stream.write_all(&row).map_err(failed)?;
    }
    stream.finish().map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(file)
}
