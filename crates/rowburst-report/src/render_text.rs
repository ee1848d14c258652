//! A line of words as pixels, such as the time below a picture of a film.

use crate::figure::svg_options;
use crate::pixels::failed;
use maud::Render;
use resvg::{tiny_skia, usvg};
use rowburst::Result;

/// The ink of a line of bold words, 0 to 255 for each pixel of `width`×`height`, row after row; the
/// words begin at the left and fill the height.
///
/// # Errors
/// A size of zero.
pub fn render_text(text: &str, width: usize, height: usize) -> Result<Vec<u8>> {
    let size = 0.62 * height as f64;
    let text = text.render().into_string();
    let svg = format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}"><text x="{:.1}" y="{:.1}" font-size="{size:.1}" font-weight="bold" fill="white">{text}</text></svg>"#,
        0.4 * size,
        0.72 * height as f64,
    );
    let tree = usvg::Tree::from_str(&svg, &svg_options()).map_err(failed)?;
    let mut canvas = tiny_skia::Pixmap::new(width as u32, height as u32)
        .ok_or_else(|| failed("words without area"))?;
    resvg::render(
        &tree,
        tiny_skia::Transform::identity(),
        &mut canvas.as_mut(),
    );
    Ok(canvas.pixels().iter().map(|p| p.alpha()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rendered_text_fills_the_height() {
        let [a, b] = ["4.8 µs", "14.4 µs"].map(|text| render_text(text, 200, 22).unwrap());
        assert_eq!((a.len(), b.len()), (4400, 4400));
        let is_inked = |y: usize| a[200 * y..200 * (y + 1)].iter().any(|&v| v > 127);
        let rows: Vec<usize> = (0..22).filter(|&y| is_inked(y)).collect();
        assert!(rows.len() >= 10 && rows[0] >= 2 && *rows.last().unwrap() < 22);
        let light = |ink: &[u8]| ink.iter().map(|&v| u32::from(v)).sum::<u32>();
        assert!(light(&b) > light(&a), "a digit more");
        // The right half is free.
        assert!((0..22).all(|y| a[200 * y + 100..200 * (y + 1)].iter().all(|&v| v == 0)));
        assert!(render_text("1", 0, 9).is_err());
    }
}
