//! A recording played back as a camera: at its own pace, or at any other.

use crate::record::CaptureRecord;
use crate::settings::Settings;
use crate::source::{Delivery, Frame, Source};
use rowburst::error::Subject;
use rowburst::{Cancel, Error, ErrorKind, Result};
use rowburst_io::{
    Capture, Experiment, Frames, SampleFormat, open_recording, read_capture_record, read_metadata,
};
use std::path::Path;
use std::time::{Duration, Instant};

/// How fast a recording is played.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Pace {
    /// By its time stamps or its frame period; without either, as fast as asked for.
    Own,
    /// Microseconds from frame to frame.
    PeriodUs(f64),
    /// As fast as the frames are taken.
    Unlimited,
}

/// A recording as a source. Frames that its record calls dropped or incomplete are so again.
pub struct Playback {
    name: String,
    frames: Box<dyn Frames>,
    settings: Settings,
    record: Option<CaptureRecord>,
    pace: Pace,
    repeats: bool,
    bits: u32,
    /// Index of the next frame of the recording, and how often it was played through.
    next: usize,
    round: u64,
    /// Number that follows the last frame.
    expected: Option<u64>,
    /// Start of the clock.
    start: Option<Instant>,
}

/// Longest sleep before Ctrl-C is looked for.
const NAP: Duration = Duration::from_millis(20);

impl Playback {
    /// Opens `PATH`, `PATH?rate=HZ`, `PATH?rate=max` or `PATH?loop`: a file of frames, a folder of images or stacks, or
    /// Zarr. Settings are those of the record beside it, of its metadata, and of `experiment.toml` beside it.
    ///
    /// # Errors
    /// A recording that cannot be read, or an option that does not exist.
    pub fn open(text: &str) -> Result<Self> {
        // A file of exactly this name has no options.
        let (path, options) = match text.rsplit_once('?') {
            Some(parts) if !Path::new(text).exists() => parts,
            _ => (text, ""),
        };
        let (pace, repeats) = parse_options(text, options)?;
        let path = Path::new(path);
        let frames = open_frames(path)?;
        let first = frames.read(0)?;
        let bits = match first.format {
            SampleFormat::Counts { bits } => bits,
            SampleFormat::Float => 16,
        };
        let record = read_capture_record(path).and_then(|r| serde_json::from_value(r).ok());
        let name = format!("play:{text}");
        let settings = settings_of(&name, path, &first, record.as_ref());
        Ok(Self {
            name,
            frames,
            settings,
            record,
            pace,
            repeats,
            bits,
            next: 0,
            round: 0,
            expected: None,
            start: None,
        })
    }

    /// Number of frames of the recording.
    pub fn count(&self) -> usize {
        self.frames.count()
    }

    /// Number and time of frame `index`, and what is wrong with it.
    fn facts(&self, index: usize) -> (u64, Option<u64>, Option<String>) {
        if let Some(page) = self.record.as_ref().and_then(|r| r.frames.get(index)) {
            return (page.number, page.time_us, page.incomplete.clone());
        }
        let number = self.frames.number(index);
        let period = self.settings.reading().metadata.frame_period_us;
        (number, period.map(|p| (number as f64 * p) as u64), None)
    }

    /// When frame `index` is due, since the start of the round; `None`: at once.
    fn due(&self, index: usize) -> Option<Duration> {
        let first = self.facts(0);
        let (number, time_us, _) = self.facts(index);
        let microseconds = match self.pace {
            Pace::Unlimited => return None,
            Pace::PeriodUs(period) => number.saturating_sub(first.0) as f64 * period,
            Pace::Own => time_us?.saturating_sub(first.1.unwrap_or(0)) as f64,
        };
        Some(Duration::from_secs_f64(microseconds * 1e-6))
    }

    fn wait(&mut self, index: usize, cancel: &Cancel) -> Result<()> {
        let start = *self.start.get_or_insert_with(Instant::now);
        let Some(due) = self.due(index) else {
            return cancel.check();
        };
        loop {
            cancel.check()?;
            let left = due.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Ok(());
            }
            std::thread::sleep(left.min(NAP));
        }
    }

    /// Begins the recording anew, where it repeats.
    fn rewind(&mut self) -> bool {
        if !self.repeats {
            return false;
        }
        (self.next, self.start, self.expected) = (0, None, None);
        self.round += 1;
        true
    }

    fn deliver(&self, index: usize) -> Delivery {
        let (number, time_us, incomplete) = self.facts(index);
        let frame = self.frames.read(index).and_then(|capture| {
            Ok(Frame {
                rows: capture.image.rows(),
                columns: capture.image.columns(),
                counts: counts_of(&capture, self.frames.path(), &self.frames.name(index))?,
                number: number + self.round * (self.facts(self.count() - 1).0 + 1),
                time_us,
            })
        });
        match (frame, incomplete) {
            (Ok(frame), None) => Delivery::Frame(frame),
            (Ok(frame), Some(reason)) => Delivery::Incomplete {
                number: frame.number,
                frame: Some(frame),
                reason,
            },
            (Err(error), _) => Delivery::Incomplete {
                frame: None,
                number,
                reason: error.to_string(),
            },
        }
    }
}

impl Source for Playback {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn settings(&mut self) -> Result<Settings> {
        Ok(self.settings.clone())
    }

    fn next(&mut self, cancel: &Cancel) -> Result<Delivery> {
        if self.next >= self.count() && !self.rewind() {
            return Ok(Delivery::End);
        }
        let number = self.facts(self.next).0;
        if let Some(expected) = self.expected.filter(|&expected| expected < number) {
            self.expected = Some(number);
            return Ok(Delivery::Dropped {
                first: expected,
                last: number - 1,
            });
        }
        self.wait(self.next, cancel)?;
        let delivery = self.deliver(self.next);
        if let Delivery::Incomplete { frame: None, .. } = &delivery
            && self.next == 0
        {
            // A recording of which the first frame cannot be used has the wrong kind of pixels.
            self.frames
                .read(0)
                .and_then(|first| counts_of(&first, self.frames.path(), &self.frames.name(0)))?;
        }
        self.next += 1;
        self.expected = Some(number + 1);
        Ok(delivery)
    }

    fn skip_to_latest(&mut self) -> Result<u64> {
        let Some(start) = self.start else {
            return Ok(0);
        };
        let before = self.next;
        // The last frame stays to be delivered.
        while self.next + 1 < self.count()
            && self
                .due(self.next + 1)
                .is_some_and(|due| due <= start.elapsed())
        {
            self.next += 1;
        }
        if self.next > before {
            self.expected = Some(self.facts(self.next).0);
        }
        Ok((self.next - before) as u64)
    }
}

impl Playback {
    /// Bits of the file's numbers.
    pub fn bits(&self) -> u32 {
        self.bits
    }
}

fn parse_options(text: &str, options: &str) -> Result<(Pace, bool)> {
    let (mut pace, mut repeats) = (Pace::Own, false);
    for option in options.split('&').filter(|o| !o.is_empty()) {
        match option.split_once('=') {
            None if option == "loop" => repeats = true,
            Some(("rate", "max")) => pace = Pace::Unlimited,
            Some(("rate", hertz)) if hertz.parse().is_ok_and(|hz: f64| hz > 0.0) => {
                pace = Pace::PeriodUs(1e6 / hertz.parse::<f64>().unwrap_or(1.0));
            }
            _ => {
                return Err(Error::input(
                    Subject::named("the source"),
                    format!("\"{option}\" in play:{text}"),
                    "the options of a playback are rate=HZ, rate=max and loop",
                    "Write play:recording.tif?rate=25&loop, for example.",
                ));
            }
        }
    }
    Ok((pace, repeats))
}

#[cfg(feature = "zarr")]
fn open_frames(path: &Path) -> Result<Box<dyn Frames>> {
    if rowburst_zarr::is_zarr(path) {
        return rowburst_zarr::open_zarr_recording(path);
    }
    open_recording(path)
}

#[cfg(not(feature = "zarr"))]
fn open_frames(path: &Path) -> Result<Box<dyn Frames>> {
    open_recording(path)
}

/// The settings of a recording.
fn settings_of(
    name: &str,
    path: &Path,
    first: &Capture,
    record: Option<&CaptureRecord>,
) -> Settings {
    let mut settings = match record {
        Some(record) => Settings {
            source: name.into(),
            ..record.settings.clone()
        },
        None => Settings {
            source: name.into(),
            ..Settings::default()
        },
    };
    settings
        .properties
        .retain(|property| property.value.is_some());
    if record.is_none() {
        settings.push("rows", first.image.rows());
        settings.push("columns", first.image.columns());
        settings.push_metadata(&read_metadata(path));
        push_experiment(&mut settings, path, first);
    }
    if let SampleFormat::Counts { bits } = first.format
        && bits < 16
        && settings.reading().metadata.bit_depth.is_none()
    {
        settings.push_as("bit_depth", bits, rowburst_io::Origin::Calculated);
    }
    settings.mark_unknown();
    settings
}

/// The camera of `experiment.toml` beside the recording, where the frames have its size.
fn push_experiment(settings: &mut Settings, path: &Path, first: &Capture) {
    let file = path.with_file_name("experiment.toml");
    let Ok(experiment) = Experiment::read(&file) else {
        return;
    };
    let params = &experiment.params;
    let raw = (
        params.rows * params.sensor.binning,
        params.columns * params.sensor.binning,
    );
    if raw != (first.image.rows(), first.image.columns()) || params.sensor.binning != 1 {
        return;
    }
    let metadata = rowburst_io::Metadata {
        shutter: Some(params.shutter.clone()),
        row_time_us: Some(params.row_time_us),
        exposure_us: Some(params.exposure_us),
        frame_period_us: experiment.recording.frame_period_us,
        bit_depth: params.sensor.bit_depth,
        pixel_pitch_um: params.sensor.pixel_pitch_um,
        ..rowburst_io::Metadata::default()
    };
    settings.push_metadata(&metadata);
}

/// The counts of a frame.
fn counts_of(capture: &Capture, path: &Path, name: &str) -> Result<Vec<u16>> {
    let is_count = |v: f32| v.fract() == 0.0 && (0.0..=65_535.0).contains(&v);
    let bad = capture.image.data().iter().find(|&&v| !is_count(v));
    match bad {
        None => Ok(capture.image.data().iter().map(|&v| v as u16).collect()),
        Some(value) => Err(Error::input(
            path,
            format!("a pixel of {value} in {name}"),
            "the frames of a camera are whole numbers from 0 to 65535",
            "Play back the raw frames, not corrected ones; numpy.rint(frame).clip(0, 65535).astype(\"uint16\") rounds.",
        )
        .with_kind(ErrorKind::Unsupported)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recorder::{Ended, Recorder, record};
    use rowburst::{Shape, Video};
    use rowburst_io::write_npy_video;
    use std::path::PathBuf;

    /// A recording of four frames `frames.npy` of 3×2 counts.
    fn recording(folder: &Path) -> PathBuf {
        let data = (0..24).map(|i| (i * 100) as f32).collect();
        let video = Video::new(Shape::new(4, 3, 2), data).unwrap();
        let out = rowburst_io::OutputFolder::create(folder).unwrap();
        out.write("frames.npy", |w| write_npy_video(w, &video))
            .unwrap();
        folder.join("frames.npy")
    }

    fn all(source: &mut dyn Source) -> Vec<Delivery> {
        let cancel = Cancel::default();
        std::iter::from_fn(|| match source.next(&cancel).unwrap() {
            Delivery::End => None,
            delivery => Some(delivery),
        })
        .collect()
    }

    #[test]
    fn frames_come_in_order_with_their_counts() {
        let folder = tempfile::tempdir().unwrap();
        let path = recording(folder.path());
        let mut source = Playback::open(path.to_str().unwrap()).unwrap();
        let found = all(&mut source);
        assert_eq!(found.len(), 4);
        let Delivery::Frame(last) = &found[3] else {
            panic!("{found:?}")
        };
        assert_eq!(
            (last.number, last.counts.as_slice()),
            (3, [1800, 1900, 2000, 2100, 2200, 2300].as_slice())
        );
        let unknown = source.settings().unwrap();
        assert_eq!(unknown.value("rows"), Some("3"));
        assert!(
            unknown
                .properties
                .iter()
                .any(|p| p.name == "row_time_us" && p.origin == "unknown")
        );
    }

    #[test]
    fn a_record_gives_gaps_and_incomplete_frames_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = recording(folder.path());
        let mut source = Playback::open(path.to_str().unwrap()).unwrap();
        let copy = folder.path().join("copy.tif");
        let recorder = Recorder::create(&copy, "record", source.settings().unwrap(), None).unwrap();
        let (mut written, ended) =
            record(&mut source, recorder, None, &Cancel::default(), &mut |_| ()).unwrap();
        assert!(matches!(ended, Ended::SourceEnd) && written.written == 4);
        written.frames[2].number = 7;
        written.frames[3].number = 8;
        written.frames[3].incomplete = Some("two packets lost".into());
        let json = serde_json::to_vec(&written).unwrap();
        std::fs::write(folder.path().join("copy.json"), json).unwrap();
        let mut again = Playback::open(copy.to_str().unwrap()).unwrap();
        let found = all(&mut again);
        assert_eq!(found[2], Delivery::Dropped { first: 2, last: 6 });
        assert!(
            matches!(&found[4], Delivery::Incomplete { number: 8, frame: Some(_), reason } if reason == "two packets lost")
        );
    }

    #[test]
    fn a_rate_is_kept_and_late_frames_can_be_skipped() {
        let folder = tempfile::tempdir().unwrap();
        let path = recording(folder.path());
        let mut source = Playback::open(&format!("{}?rate=100", path.display())).unwrap();
        let start = Instant::now();
        source.next(&Cancel::default()).unwrap();
        std::thread::sleep(Duration::from_millis(25));
        assert_eq!(source.skip_to_latest().unwrap(), 1);
        let Delivery::Frame(third) = source.next(&Cancel::default()).unwrap() else {
            panic!("a frame")
        };
        assert_eq!(third.number, 2);
        source.next(&Cancel::default()).unwrap();
        assert!(start.elapsed() >= Duration::from_millis(30));
        let mut endless = Playback::open(&format!("{}?rate=max&loop", path.display())).unwrap();
        let numbers: Vec<_> = (0..6)
            .map(|_| match endless.next(&Cancel::default()).unwrap() {
                Delivery::Frame(frame) => frame.number,
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(numbers, [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn corrected_frames_and_unknown_options_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let video = Video::new(Shape::new(1, 1, 2), vec![0.5, 1.0]).unwrap();
        let out = rowburst_io::OutputFolder::create(folder.path()).unwrap();
        out.write("a.npy", |w| write_npy_video(w, &video)).unwrap();
        let path = folder.path().join("a.npy");
        let mut source = Playback::open(path.to_str().unwrap()).unwrap();
        let error = source.next(&Cancel::default()).unwrap_err();
        assert!(
            error.is_input() && error.to_string().contains("0.5"),
            "{error}"
        );
        let error = Playback::open(&format!("{}?speed=2", path.display()))
            .err()
            .unwrap();
        assert!(error.to_string().contains("rate=HZ"), "{error}");
    }
}
