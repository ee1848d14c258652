//! `video.mp4`: the video in slow motion, with the time of each bin below it.

use rowburst::{Result, TimeGrid, Video};

/// Whether `video.mp4` shows the time of each bin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MovieStyle {
    /// The time of each bin in µs, in a strip below the picture.
    Stamped,
    /// The video alone.
    Plain,
}

/// The video as MP4; `None` in a build without the feature `mp4`.
#[cfg(feature = "mp4")]
pub(crate) fn encode_movie(
    video: &Video,
    time: &TimeGrid,
    movie: MovieStyle,
) -> Result<Option<Vec<u8>>> {
    let mut mp4 = Vec::new();
    let stamp = |bin: usize, width: usize, height: usize| {
        rowburst_report::render_text(&bin_time(time, bin), width, height)
    };
    let renderer: Option<&rowburst_io::StampRenderer> = match movie {
        MovieStyle::Stamped => Some(&stamp),
        MovieStyle::Plain => None,
    };
    rowburst_io::write_mp4(&mut mp4, video, renderer)?;
    Ok(Some(mp4))
}

/// The video as MP4; `None` in a build without the feature `mp4`.
#[cfg(not(feature = "mp4"))]
pub(crate) fn encode_movie(_: &Video, _: &TimeGrid, _: MovieStyle) -> Result<Option<Vec<u8>>> {
    Ok(None)
}

/// The middle of a bin in µs, with enough digits to distinguish bins, as in the viewer.
#[cfg(feature = "mp4")]
fn bin_time(time: &TimeGrid, bin: usize) -> String {
    let step = time.bin_duration_us();
    let digits = match step {
        s if s < 0.1 => 3,
        s if s < 1.0 => 2,
        _ => 1,
    };
    format!("{:.digits$} µs", time.middle_us(bin))
}

#[cfg(all(test, feature = "mp4"))]
mod tests {
    use super::*;

    #[test]
    fn bins_are_told_apart() {
        let time = |row_time_us| TimeGrid::rolling(4, row_time_us, 1.0, 1);
        assert_eq!(bin_time(&time(9.6), 1), "14.4 µs");
        assert_eq!(bin_time(&time(0.5), 1), "0.75 µs");
        assert_eq!(bin_time(&time(0.04), 0), "0.020 µs");
        // The first exposure begins in the middle of bin 0.
        assert_eq!(bin_time(&TimeGrid::rolling(4, 9.6, 0.5, 1), 1), "9.6 µs");
    }
}
