//! All frames on one time axis.
//!
//! Dead time, however long, is one picture of NaN: a plot breaks there, a viewer shows one dark
//! picture, and nothing is spent on it. The time of every bin stands beside in `time_us`. A frame
//! that failed, or is missing from the recording, is dead time too. Where long exposures make
//! the videos of neighbouring frames overlap, the earlier frame's bins are taken.

use crate::clock::Clock;
use crate::run::{Batch, Event};
use crate::table::Status;
use rayon::prelude::*;
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result, phrase};
use rowburst_io::write_error;
use rowburst_zarr::{StitchParams, StitchedVideo};
use std::path::PathBuf;

impl Batch {
    /// Copies the videos of all frames into one array `[t, y, x]` inside the archive, whole or
    /// not at all; returns its path, or `None` where it was stopped.
    ///
    /// # Errors
    /// An unknown frame period, frames that are not through, failed reads and writes.
    pub fn stitch(
        &self,
        cancel: &Cancel,
        observer: &(dyn Fn(Event) + Sync),
    ) -> Result<Option<PathBuf>> {
        let clock = self.clock_to_stitch()?;
        let frames = &self.inputs.frames;
        let rows = self.rows()?;
        let missing = frames.count() - rows.len();
        let out = self.archive.path();
        if missing > 0 {
            return Err(Error::work(
                out,
                format!("{missing} of {} frames are not done yet", frames.count()),
                "Run the batch to its end, then stitch.",
            ));
        }
        let done = rows.iter().filter(|row| row.status == Status::Done);
        let done: Vec<usize> = done.map(|row| row.frame).collect();
        let params = bins_of(&done, &clock.starts_us(&**frames), clock);
        if params.bins.is_empty() {
            return Err(Error::work(
                out,
                "no frame has a video",
                "See the messages in rowburst/frames.csv.",
            ));
        }
        let hidden = self.scratch.folder().join("stitched");
        let stitched = StitchedVideo::create(&self.archive, &params, &hidden)?;
        let of = stitched.chunks();
        (0..of).into_par_iter().try_for_each(|chunk| {
            if cancel.is_cancelled() {
                return Ok(());
            }
            stitched.copy_chunk(chunk)?;
            observer(Event::Stitched { of });
            Ok(())
        })?;
        if cancel.is_cancelled() {
            return Ok(None);
        }
        let path = out.join("stitched");
        let removed = if path.exists() {
            std::fs::remove_dir_all(&path)
        } else {
            Ok(())
        };
        removed
            .and_then(|()| std::fs::rename(&hidden, &path))
            .map_err(|e| write_error(&e).within(&path))?;
        Ok(Some(path))
    }

    /// The clock that stitching needs.
    ///
    /// # Errors
    /// An unknown frame period.
    pub fn clock_to_stitch(&self) -> Result<Clock> {
        self.clock.ok_or_else(|| {
            Error::input(
                Parameter::Stitch,
                "no frame period",
                "one time axis needs the time from the start of a frame to that of the next",
                phrase![
                    "Give ",
                    Parameter::FramePeriodUs,
                    ", or the frame period of the recording in the experiment."
                ],
            )
            .with_kind(ErrorKind::Missing)
        })
    }
}

/// The bins of the frames `done`, which begin at `starts_us`, and their times.
fn bins_of(done: &[usize], starts_us: &[f64], clock: Clock) -> StitchParams {
    let bins = (clock.video_us / clock.bin_us).round() as usize;
    let mut params = StitchParams {
        bins: Vec::new(),
        time_us: Vec::new(),
    };
    let mut end_us: Option<f64> = None;
    for &frame in done {
        let start_us = starts_us[frame] + clock.first_bin_us;
        // Half a bin either way is the jitter of a period that was measured.
        let gap_bins = end_us.map_or(0.0, |end| (start_us - end) / clock.bin_us);
        if let Some(end_us) = end_us.filter(|_| gap_bins > 0.5) {
            params.bins.push(None);
            params.time_us.push((end_us + start_us) / 2.0);
        }
        let overlap = (-gap_bins).round().max(0.0) as usize;
        for bin in overlap..bins {
            params.bins.push(Some((frame, bin)));
            params
                .time_us
                .push(start_us + (bin as f64 + 0.5) * clock.bin_us);
        }
        end_us = Some(start_us + clock.video_us);
    }
    params
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clock(frame_period_us: f64) -> Clock {
        Clock {
            frame_period_us,
            bin_us: 10.0,
            first_bin_us: 0.0,
            video_us: 30.0,
        }
    }

    /// Frames and bins in a line, `-` for dead time.
    fn line(params: &StitchParams) -> String {
        let bin = |bin: &Option<(usize, usize)>| match bin {
            Some((frame, bin)) => format!("{frame}.{bin}"),
            None => "-".into(),
        };
        params.bins.iter().map(bin).collect::<Vec<_>>().join(" ")
    }

    #[test]
    fn dead_time_is_one_picture_whatever_its_length() {
        let params = bins_of(&[0, 1], &[0.0, 100.0], clock(100.0));
        assert_eq!(line(&params), "0.0 0.1 0.2 - 1.0 1.1 1.2");
        assert_eq!(params.time_us, [5.0, 15.0, 25.0, 65.0, 105.0, 115.0, 125.0]);
        // Exposures of half a row time: the first bin starts half a row time before the first exposure.
        let early = Clock {
            first_bin_us: -5.0,
            ..clock(100.0)
        };
        let params = bins_of(&[0, 1], &[0.0, 100.0], early);
        assert_eq!(params.time_us, [0.0, 10.0, 20.0, 60.0, 100.0, 110.0, 120.0]);
    }

    #[test]
    fn frames_that_follow_at_once_are_joined() {
        let params = bins_of(&[0, 1], &[0.0, 30.0], clock(30.0));
        assert_eq!(line(&params), "0.0 0.1 0.2 1.0 1.1 1.2");
        // A frame that failed is dead time.
        let params = bins_of(&[0, 2], &[0.0, 30.0, 60.0], clock(30.0));
        assert_eq!(line(&params), "0.0 0.1 0.2 - 2.0 2.1 2.2");
        assert_eq!(params.time_us[3], 45.0);
    }

    #[test]
    fn what_two_frames_see_is_taken_from_the_earlier() {
        let params = bins_of(&[0, 1], &[0.0, 19.0], clock(19.0));
        assert_eq!(line(&params), "0.0 0.1 0.2 1.1 1.2");
        assert!(params.time_us.windows(2).all(|pair| pair[0] < pair[1]));
    }
}
