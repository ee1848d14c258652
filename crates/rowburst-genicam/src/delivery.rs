//! Blocks of a GigE Vision stream as frames, with their gaps.

use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Result};
use rowburst_capture::{Delivery, Frame};
use viva_genicam::pfnc::convert::unpack_u16;
use viva_genicam::{Frame as Block, FrameStatus};

/// The numbers and times of a camera's blocks.
#[derive(Debug)]
pub struct Sequence {
    ticks_per_second: Option<u64>,
    /// Number that follows the last block.
    expected: Option<u64>,
}

impl Sequence {
    /// A camera whose clock has `ticks_per_second`, where it says so.
    pub fn new(ticks_per_second: Option<u64>) -> Self {
        Self {
            ticks_per_second,
            expected: None,
        }
    }

    /// What a block means: the blocks that are missing before it, and itself.
    ///
    /// # Errors
    /// Pixels that are not a plain grey picture.
    pub fn take(&mut self, name: &str, block: &Block) -> Result<Vec<Delivery>> {
        let number = block.block_id;
        let gap = self.expected.filter(|&expected| expected < number);
        let gap = gap.map(|first| Delivery::Dropped {
            first,
            last: number - 1,
        });
        self.expected = Some(number + 1);
        let delivery = match reason(block.status) {
            None => Delivery::Frame(self.frame(name, block)?),
            Some(reason) => Delivery::Incomplete {
                frame: self.frame(name, block).ok(),
                number,
                reason,
            },
        };
        Ok(gap.into_iter().chain([delivery]).collect())
    }

    fn frame(&self, name: &str, block: &Block) -> Result<Frame> {
        let refused = |found: String| {
            Error::input(
                Subject::named(name.to_string()),
                found,
                "a frame is one plane of counts",
                "Set PixelFormat to Mono16, Mono12 or another Mono format.",
            )
            .with_kind(ErrorKind::Unsupported)
        };
        let (rows, columns) = (block.height as usize, block.width as usize);
        if rows * columns == 0 {
            return Err(refused("a block without a picture".into()));
        }
        // Missing packets at the end may have left the buffer short.
        let mut bytes = block.payload.to_vec();
        let full = block.expected_size.unwrap_or(0);
        if bytes.len() < full {
            bytes.resize(full, 0);
        }
        let stride = block.row_stride();
        let counts = unpack_u16(
            block.pixel_format,
            block.width,
            block.height,
            stride,
            &bytes,
        )
        .map_err(|error| refused(error.to_string()))?;
        let microseconds = |ticks: u64, per_second: u64| {
            (u128::from(ticks) * 1_000_000 / u128::from(per_second.max(1))) as u64
        };
        Ok(Frame {
            rows,
            columns,
            counts,
            number: block.block_id,
            time_us: block
                .ts_dev
                .zip(self.ticks_per_second)
                .map(|(t, f)| microseconds(t, f)),
        })
    }
}

/// What is wrong with a block.
fn reason(status: FrameStatus) -> Option<String> {
    match status {
        FrameStatus::Complete => None,
        FrameStatus::Incomplete { missing_packets } => Some(format!(
            "{missing_packets} packets are missing; their pixels are 0"
        )),
        FrameStatus::TrailerMissing => Some("its end is missing; missing pixels are 0".into()),
        other => Some(format!("the camera reports an error ({other:?})")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use viva_genicam::pfnc::PixelFormat;

    fn block(id: u64, status: FrameStatus) -> Block {
        // Two by two pixels of 16 bits.
        let bytes: &'static [u8] = &[1, 0, 2, 0, 3, 0, 0, 4];
        let mut block = Block::new(bytes.into(), 2, 2, PixelFormat::Mono16);
        block.block_id = id;
        block.status = status;
        block.ts_dev = Some(2_000);
        block
    }

    #[test]
    fn gaps_and_missing_packets_are_told() {
        let mut sequence = Sequence::new(Some(1_000_000_000));
        let first = sequence
            .take("a", &block(7, FrameStatus::Complete))
            .unwrap();
        let [Delivery::Frame(frame)] = &first[..] else {
            panic!("{first:?}")
        };
        assert_eq!((frame.number, frame.time_us), (7, Some(2)));
        assert_eq!(frame.counts, [1, 2, 3, 1024]);
        let lost = FrameStatus::Incomplete { missing_packets: 3 };
        let second = sequence.take("a", &block(10, lost)).unwrap();
        assert_eq!(second[0], Delivery::Dropped { first: 8, last: 9 });
        assert!(
            matches!(&second[1], Delivery::Incomplete { frame: Some(_), number: 10, reason } if reason.contains("3 packets")),
            "{second:?}"
        );
        // A block whose beginning is lost has no picture, but is told.
        let mut nothing = block(11, FrameStatus::TrailerMissing);
        (nothing.width, nothing.height) = (0, 0);
        let third = sequence.take("a", &nothing).unwrap();
        assert!(
            matches!(
                &third[..],
                [Delivery::Incomplete {
                    frame: None,
                    number: 11,
                    ..
                }]
            ),
            "{third:?}"
        );
    }

    #[test]
    fn colours_are_refused() {
        let mut colour = block(1, FrameStatus::Complete);
        colour.pixel_format = PixelFormat::RGB8Packed;
        let error = Sequence::new(None).take("a", &colour).unwrap_err();
        assert!(error.to_string().contains("Mono16"), "{error}");
    }
}
