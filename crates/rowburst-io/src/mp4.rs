//! MP4 with H.264, for a browser or a slide: the video in slow motion.

use crate::fault;
use muxide::api::{MuxerBuilder, MuxerError, VideoCodec};
use openh264::OpenH264API;
use openh264::encoder::{
    Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, Profile, RateControlMode,
    VuiConfig,
};
use openh264::formats::YUVSource;
use rowburst::error::Subject;
use rowburst::{Error, Result, Video};
use std::fmt::Display;
use std::io::Write;

/// Pictures per second on playback: slow enough to follow what moves.
const PLAYBACK_HZ: f64 = 15.0;
/// Pictures from one key picture to the next, so that seeking is at once: one second.
const KEY_PERIOD: u32 = 15;
/// Smaller videos are enlarged so that their shorter side reaches this many pixels.
const SHORT_SIDE: usize = 432;
/// No side exceeds this: the encoder ends at 3840 × 2160, either way round.
const LONG_SIDE: usize = 2160;
/// The encoder's smallest side.
const MIN_SIDE: usize = 16;
/// The fraction of voxels that lie below the brightest luma: a few hot voxels must
/// not darken the rest.
const WHITE_FRACTION: f64 = 0.999;

/// Height of the strip below the pictures, over their width, and at least, in pixels.
const STAMP_HEIGHT_RATIO: f64 = 0.05;
const MIN_STAMP_HEIGHT: usize = 20;
/// Narrower pictures have no room for words.
const MIN_STAMP_WIDTH: usize = 96;

/// What stands in a strip below each picture: from the bin, and the strip's width and height in
/// pixels, to the ink of each pixel, 0 to 255, row after row.
pub type StampRenderer<'a> = dyn Fn(usize, usize, usize) -> Result<Vec<u8>> + 'a;

/// Writes a video `[t, y, x]` as H.264 in MP4 at 15 pictures per second.
///
/// Zero is black and the 99.9th percentile white (the maximum, where that percentile
/// is zero), in between linear. Pixels are repeated so that the shorter side has
/// about 432 of them; videos beyond 2160 pixels are thinned. A `stamp` stands below the
/// pictures, so that it hides nothing; pictures narrower than 96 pixels have none.
///
/// # Errors
/// A failed write or encoding, and those of `stamp`.
///
/// # Panics
/// If `stamp` returns another number of pixels.
pub fn write_mp4(w: &mut impl Write, video: &Video, stamp: Option<&StampRenderer>) -> Result<()> {
    let scaler = Scaler::new(video);
    let mut picture = Picture::new(&scaler, stamp.is_some());
    let config = EncoderConfig::new()
        .profile(Profile::Baseline)
        .vui(VuiConfig::bt709())
        .max_frame_rate(FrameRate::from_hz(PLAYBACK_HZ as f32))
        .intra_frame_period(IntraFramePeriod::from_num_frames(KEY_PERIOD))
        // Constant quality at the encoder's own step (docs/design/018).
        .rate_control_mode(RateControlMode::Off)
        .scene_change_detect(false)
        .adaptive_quantization(false)
        .background_detection(false)
        .skip_frames(false);
    let mut encoder =
        Encoder::with_api_config(OpenH264API::from_source(), config).map_err(failed)?;
    let (width, height) = (picture.width as u32, picture.height as u32);
    let mut muxer = MuxerBuilder::new(w)
        .video(VideoCodec::H264, width, height, PLAYBACK_HZ)
        .build()
        .map_err(muxer_fault)?;
    let mut bytes = Vec::new();
    for t in 0..video.shape().bins {
        scaler.draw(video, t, &mut picture);
        if let Some(stamp) = stamp {
            picture.write_below(|width, height| stamp(t, width, height))?;
        }
        let encoded = encoder.encode(&picture).map_err(failed)?;
        bytes.clear();
        encoded.write_vec(&mut bytes);
        let key = matches!(encoded.frame_type(), FrameType::IDR | FrameType::I);
        muxer
            .write_video(t as f64 / PLAYBACK_HZ, &bytes, key)
            .map_err(muxer_fault)?;
    }
    muxer.finish().map_err(muxer_fault)
}

fn failed(reason: impl Display) -> Error {
    let remedy = "The other files of the result hold the same video.";
    Error::work(Subject::named("encoding H.264"), reason, remedy)
}

fn muxer_fault(error: MuxerError) -> Error {
    match error {
        MuxerError::Io(error) => fault::write_error(&error),
        error => failed(error),
    }
}

/// How a bin becomes a picture.
struct Scaler {
    /// Every `thin`-th pixel is taken,
    thin: usize,
    /// and repeated this often along both sides.
    repeat: usize,
    /// Rows and columns that are taken.
    sampled: (usize, usize),
    /// Voxel value to luma above black.
    gain: f32,
}

impl Scaler {
    fn new(video: &Video) -> Self {
        let shape = video.shape();
        let long = shape.rows.max(shape.columns);
        let thin = long.div_ceil(LONG_SIDE);
        let sampled = (shape.rows.div_ceil(thin), shape.columns.div_ceil(thin));
        let (long, short) = (sampled.0.max(sampled.1), sampled.0.min(sampled.1));
        let repeat = SHORT_SIDE.div_ceil(short).min(LONG_SIDE / long).max(1);
        let white = white(video.data());
        let gain = if white > 0.0 { 219.0 / white } else { 0.0 };
        Self {
            thin,
            repeat,
            sampled,
            gain,
        }
    }

    fn draw(&self, video: &Video, t: usize, picture: &mut Picture) {
        let columns = video.shape().columns;
        let (width, repeat) = (picture.width, self.repeat);
        let rows = video.bin(t).chunks_exact(columns).step_by(self.thin);
        let blocks = picture.luma.chunks_exact_mut(width * repeat);
        for (row, block) in rows.zip(blocks) {
            let (first, others) = block.split_at_mut(width);
            let pixels = row.iter().step_by(self.thin);
            for (pixel, luma) in pixels.zip(first.chunks_exact_mut(repeat)) {
                // A saturating cast: NaN and what lies below zero are black.
                let above = (pixel * self.gain).clamp(0.0, 219.0).round() as u8;
                luma.fill(16 + above);
            }
            others
                .chunks_exact_mut(width)
                .for_each(|copy| copy.copy_from_slice(first));
        }
    }
}

/// The value shown as white, found to 1/4096 of the maximum by a histogram.
fn white(data: &[f32]) -> f32 {
    let finite = || data.iter().copied().filter(|v| v.is_finite());
    let max = finite().fold(0.0, f32::max);
    if max <= 0.0 {
        return 0.0;
    }
    let mut below = vec![0u64; 4096];
    finite().for_each(|v| below[(v / max * 4095.0).round() as usize] += 1);
    let below_white = data.len() as f64 * WHITE_FRACTION;
    let mut seen = 0;
    let level = below.iter().position(|&n| {
        seen += n;
        seen as f64 >= below_white
    });
    match level {
        Some(level) if level > 0 => max * level as f32 / 4095.0,
        _ => max,
    }
}

/// A picture of even sides; its chroma is grey.
struct Picture {
    width: usize,
    height: usize,
    /// Rows at the bottom that are for words.
    stamp_height: usize,
    luma: Vec<u8>,
    chroma: Vec<u8>,
}

impl Picture {
    fn new(scaler: &Scaler, has_stamp: bool) -> Self {
        let side = |sampled: usize| (sampled * scaler.repeat).max(MIN_SIDE).next_multiple_of(2);
        let (height, width) = (side(scaler.sampled.0), side(scaler.sampled.1));
        let stamp_height = if has_stamp && width >= MIN_STAMP_WIDTH {
            ((width as f64 * STAMP_HEIGHT_RATIO) as usize)
                .max(MIN_STAMP_HEIGHT)
                .next_multiple_of(2)
        } else {
            0
        };
        let height = height + stamp_height;
        Self {
            width,
            height,
            stamp_height,
            luma: vec![16; width * height],
            chroma: vec![128; width * height / 4],
        }
    }
}

impl Picture {
    fn write_below(&mut self, ink: impl FnOnce(usize, usize) -> Result<Vec<u8>>) -> Result<()> {
        if self.stamp_height == 0 {
            return Ok(());
        }
        let ink = ink(self.width, self.stamp_height)?;
        let from = self.luma.len() - self.width * self.stamp_height;
        let luma = &mut self.luma[from..];
        assert_eq!(ink.len(), luma.len(), "the ink of each pixel");
        for (luma, ink) in luma.iter_mut().zip(ink) {
            *luma = 16 + (f32::from(ink) * (219.0 / 255.0)).round() as u8;
        }
        Ok(())
    }
}

impl YUVSource for Picture {
    fn dimensions(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn strides(&self) -> (usize, usize, usize) {
        (self.width, self.width / 2, self.width / 2)
    }

    fn y(&self) -> &[u8] {
        &self.luma
    }

    fn u(&self) -> &[u8] {
        &self.chroma
    }

    fn v(&self) -> &[u8] {
        &self.chroma
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst::Shape;

    #[test]
    fn pictures_of_any_size_are_encoded_with_the_index_first() {
        let sizes = [(54, 27, 36), (1, 1, 1), (3, 5, 4000), (2, 433, 501)];
        for (bins, rows, columns) in sizes {
            let mut video = Video::zeros(Shape::new(bins, rows, columns));
            let values = video.data_mut().iter_mut().enumerate();
            values.for_each(|(i, v)| *v = (i % 97) as f32);
            let mut bytes = Vec::new();
            write_mp4(&mut bytes, &video, None).unwrap();
            let at = |name: &[u8]| bytes.windows(4).position(|w| w == name).unwrap();
            assert!(at(b"moov") < at(b"mdat"));
        }
    }

    #[test]
    fn white_is_the_99_9th_percentile() {
        let mut data: Vec<f32> = (0..10_000).map(|v| v as f32).collect();
        data[5] = f32::NAN;
        data[6] = -3.0;
        assert!((white(&data) - 9990.0).abs() < 5.0, "{}", white(&data));
        assert_eq!(white(&[0.0, -1.0, f32::NAN]), 0.0);
        let mut sparse = vec![0.0; 100_000];
        sparse[7] = 2.0;
        assert_eq!(white(&sparse), 2.0);
    }

    #[test]
    fn luma_spans_the_video_range() {
        let data = vec![0.0, 1.0, f32::NAN, -1.0, 0.5, f32::INFINITY];
        let video = Video::new(Shape::new(1, 2, 3), data).unwrap();
        let scaler = Scaler::new(&video);
        let mut picture = Picture::new(&scaler, false);
        scaler.draw(&video, 0, &mut picture);
        let (width, repeat) = (picture.width, scaler.repeat);
        assert_eq!((picture.height, width), (432, 648));
        let luma = |y, x| picture.luma[y * repeat * width + x * repeat];
        let drawn = [0, 1].map(|y| [luma(y, 0), luma(y, 1), luma(y, 2)]);
        assert_eq!(drawn, [[16, 235, 16], [16, 126, 235]]);
    }

    #[test]
    fn the_stamp_is_below_the_frame() {
        let video = Video::zeros(Shape::new(1, 108, 108));
        let mut picture = Picture::new(&Scaler::new(&video), true);
        assert_eq!(
            (picture.width, picture.height, picture.stamp_height),
            (432, 454, 22)
        );
        picture
            .write_below(|width, height| Ok(vec![255; width * height]))
            .unwrap();
        let (above, below) = picture.luma.split_at(432 * 432);
        assert!(above.iter().all(|&v| v == 16) && below.iter().all(|&v| v == 235));
        let narrow = Video::zeros(Shape::new(1, 4000, 4));
        assert_eq!(Picture::new(&Scaler::new(&narrow), true).stamp_height, 0);
        let mut bytes = Vec::new();
        let stamp = |_, width, height| Ok(vec![9; width * height]);
        write_mp4(&mut bytes, &video, Some(&stamp)).unwrap();
        assert!(bytes.len() > 100);
    }
}
