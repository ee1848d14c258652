//! Writes a recording: a 16-bit TIFF stack and its record, whole or not there.
//!
//! Frames go into a hidden file beside the recording, page after page, which takes its name at the end: also where
//! the source failed, the disk is full or Ctrl-C was pressed. The record is written just before, so that no recording
//! is without one.

use crate::exposure::saturated_fraction;
use crate::guide::Guide;
use crate::record::{CaptureRecord, FrameRecord, Lost};
use crate::settings::Settings;
use crate::source::{Delivery, Frame, Source};
use rowburst::error::{Subject, With};
use rowburst::{Cancel, Error, ErrorKind, Parameter, Result, phrase};
use rowburst_io::{OutputFolder, capture_record_path, write_error};
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;
use tiff::encoder::{TiffEncoder, TiffKindBig, TiffKindStandard, colortype::Gray16};
use tiff::{TiffError, TiffResult};

/// Largest recording in the classic format, whose offsets have 32 bits.
const CLASSIC_BYTES: u64 = (1 << 32) - (1 << 26);

/// Disk space kept for the record, for the case that the disk fills up: at least, and for each frame.
const RESERVE_BYTES: u64 = 1 << 18;
const RESERVE_BYTES_PER_FRAME: u64 = 160;
/// What the settings take of it.
const RECORD_BYTES: u64 = 1 << 16;

/// Part of a frame's pixels that may be saturated without a warning.
const MAX_SATURATED: f64 = 1e-3;

/// Why a recording ended.
#[derive(Debug)]
pub enum Ended {
    /// All frames that were asked for are there.
    Complete,
    /// The source has no more frames.
    SourceEnd,
    /// The user stopped it.
    Interrupted,
    /// The source or the disk failed; what was written before is kept.
    Failed(Error),
}

/// A recording that is being written.
pub struct Recorder {
    path: PathBuf,
    folder: OutputFolder,
    hidden: NamedTempFile,
    encoder: Option<Encoder>,
    /// Length of the file after the last whole page.
    whole_bytes: u64,
    reserve: File,
    reserved: u64,
    guide: Guide,
    record: CaptureRecord,
}

enum Encoder {
    Classic(Box<TiffEncoder<File, TiffKindStandard>>),
    Big(Box<TiffEncoder<File, TiffKindBig>>),
}

impl Encoder {
    fn write(&mut self, frame: &Frame) -> TiffResult<()> {
        let (columns, rows) = (frame.columns as u32, frame.rows as u32);
        match self {
            Self::Classic(encoder) => encoder.write_image::<Gray16>(columns, rows, &frame.counts),
            Self::Big(encoder) => encoder.write_image::<Gray16>(columns, rows, &frame.counts),
        }
    }
}

impl Recorder {
    /// Begins the recording `path`, a `.tif`, of frames taken with `settings`. `requested` is the number of frames, where
    /// it is known.
    ///
    /// # Errors
    /// A file that is there already or has another ending, or a folder that cannot be written to.
    pub fn create(
        path: &Path,
        purpose: &str,
        settings: Settings,
        requested: Option<usize>,
    ) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_ascii_lowercase());
        if !ending.is_some_and(|e| e == "tif" || e == "tiff") {
            return Err(Error::input(
                path,
                "another ending than .tif",
                "a recording is a TIFF stack",
                "Name it NAME.tif.",
            ));
        }
        if path.exists() {
            return Err(Error::input(
                path,
                "a file that is there already",
                "a recording is never replaced",
                phrase![
                    "Choose another name, or move the file away",
                    With(Parameter::Replace),
                    "."
                ],
            )
            .with_kind(ErrorKind::Exists));
        }
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty());
        let folder = OutputFolder::create(parent.unwrap_or(Path::new(".")))?;
        let fault = |error: io::Error| write_error(&error).within(path);
        let hidden = hidden_file(folder.path(), path).map_err(fault)?;
        let mut reserve = tempfile::tempfile_in(folder.path()).map_err(fault)?;
        extend(&mut reserve, RESERVE_BYTES).map_err(fault)?;
        let file = path.file_name().unwrap_or_default();
        let bit_depth = settings.reading().metadata.bit_depth;
        let mut record = CaptureRecord::new(purpose, file.to_string_lossy().into_owned(), settings);
        record.requested = requested;
        Ok(Self {
            path: path.into(),
            folder,
            hidden,
            encoder: None,
            whole_bytes: 0,
            reserve,
            reserved: RESERVE_BYTES,
            guide: Guide::new(bit_depth),
            record,
        })
    }

    /// With the level of the darks in counts, by which contrast and exposure are judged at the end.
    pub fn with_dark_counts(mut self, dark_counts: Option<f64>) -> Self {
        self.guide = self.guide.with_dark_counts(dark_counts);
        self
    }

    /// What is recorded so far.
    pub fn record(&self) -> &CaptureRecord {
        &self.record
    }

    /// Adds a warning to the record.
    pub fn warn(&mut self, warning: impl Into<String>) {
        self.record.warnings.push(warning.into());
    }

    /// Writes a frame; `incomplete` says what is wrong with it.
    ///
    /// # Errors
    /// A frame of another size than the first, or a failed write. The frames before are kept.
    pub fn write(&mut self, frame: &Frame, incomplete: Option<&str>) -> Result<()> {
        self.check_size(frame)?;
        let written = self.write_page(frame);
        written.map_err(|error| {
            self.repair();
            write_error(&error).within(&self.path)
        })?;
        let sum: u64 = frame.counts.iter().map(|&count| u64::from(count)).sum();
        let mean = sum as f64 / frame.counts.len().max(1) as f64;
        self.guide.add(frame, mean);
        self.record.frames.push(FrameRecord {
            page: self.record.written,
            number: frame.number,
            time_us: frame.time_us,
            incomplete: incomplete.map(String::from),
            saturated_fraction: saturated_fraction(frame, self.guide.bit_depth()),
            mean_counts: Some(mean),
        });
        self.record.written += 1;
        Ok(())
    }

    /// Writes what a source has delivered, or notes that it is lost.
    ///
    /// # Errors
    /// Those of [`Self::write`].
    pub fn take(&mut self, delivery: Delivery) -> Result<()> {
        match delivery {
            Delivery::Frame(frame) => self.write(&frame, None),
            Delivery::Dropped { first, last } => {
                self.record.dropped += last - first + 1;
                self.lose(first, last, "dropped");
                Ok(())
            }
            Delivery::Incomplete {
                frame,
                number,
                reason,
            } => {
                self.record.incomplete += 1;
                match frame.filter(|_| self.record.purpose == "record") {
                    Some(frame) => self.write(&frame, Some(&reason)),
                    None => {
                        self.lose(number, number, reason);
                        Ok(())
                    }
                }
            }
            Delivery::End => Ok(()),
        }
    }

    /// Notes frames that never arrived, or arrived so that they cannot be written.
    pub fn lose(&mut self, first: u64, last: u64, reason: impl Into<String>) {
        self.record.lost.push(Lost {
            first,
            last,
            reason: reason.into(),
        });
    }

    /// Gives the recording its name and writes its record.
    ///
    /// # Errors
    /// No frame at all, or a failed write.
    pub fn finish(mut self, ended: &Ended) -> Result<CaptureRecord> {
        self.record.ended = match ended {
            Ended::Complete => "complete".into(),
            Ended::SourceEnd => "end of the source".into(),
            Ended::Interrupted => "interrupted".into(),
            Ended::Failed(error) => error.to_string(),
        };
        if self.record.written == 0 {
            return Err(self.nothing(ended));
        }
        self.warn_of_saturation();
        let found = self.guide.findings(&self.record.purpose);
        self.record.warnings.extend(found);
        // Its space is for what follows.
        let freed = self.reserve.set_len(0);
        drop(self.encoder.take());
        let fault = |error: io::Error| write_error(&error).within(&self.path);
        freed
            .and_then(|()| self.hidden.as_file().sync_all())
            .map_err(fault)?;
        let path = &self.path;
        let mut json = serde_json::to_vec_pretty(&self.record).expect("plain numbers and text");
        json.push(b'\n');
        let record = capture_record_path(path);
        let name = record.file_name().unwrap_or_default().to_string_lossy();
        self.folder.write_bytes(&name, &json)?;
        if let Err(error) = self.hidden.persist_noclobber(path) {
            // A record without its recording says nothing true.
            let _ = std::fs::remove_file(&record);
            return Err(write_error(&error.error).within(path));
        }
        Ok(self.record)
    }

    fn nothing(&self, ended: &Ended) -> Error {
        match ended {
            Ended::Failed(error) => error.clone(),
            Ended::Interrupted => Error::work(
                Subject::named(self.record.settings.source.clone()),
                "cancelled",
                "No frame was recorded.",
            )
            .with_kind(ErrorKind::Cancelled),
            Ended::Complete | Ended::SourceEnd => Error::work(
                Subject::named(self.record.settings.source.clone()),
                "no frame arrived",
                "Check that the camera runs, and that the recording holds frames.",
            ),
        }
    }

    fn warn_of_saturation(&mut self) {
        let worst = self.record.worst_saturation();
        if worst > MAX_SATURATED {
            let percent = 100.0 * worst;
            self.warn(format!(
                "up to {percent:.2} % of a frame's pixels are saturated: shorten the exposure or dim the light"
            ));
        }
    }

    fn check_size(&mut self, frame: &Frame) -> Result<()> {
        let size = (frame.rows, frame.columns);
        let first = *self.record.size.get_or_insert(size);
        if first == size {
            return Ok(());
        }
        Err(Error::work(
            Subject::named(self.record.settings.source.clone()),
            format!(
                "frame {} has {}×{} pixels after frames of {}×{}",
                frame.number, size.0, size.1, first.0, first.1
            ),
            "Record each region separately.",
        ))
    }

    fn write_page(&mut self, frame: &Frame) -> io::Result<()> {
        let needed = RECORD_BYTES + RESERVE_BYTES_PER_FRAME * self.record.written as u64;
        if needed > self.reserved {
            extend(&mut self.reserve, RESERVE_BYTES)?;
            self.reserved += RESERVE_BYTES;
        }
        let mut encoder = match self.encoder.take() {
            Some(encoder) => encoder,
            None => self.start(frame)?,
        };
        encoder.write(frame).map_err(io_error)?;
        self.encoder = Some(encoder);
        self.whole_bytes = self.hidden.as_file_mut().seek(SeekFrom::End(0))?;
        Ok(())
    }

    fn start(&self, frame: &Frame) -> io::Result<Encoder> {
        let file = self.hidden.as_file().try_clone()?;
        let page = 2 * frame.counts.len() as u64 + 4096;
        let total = self.record.requested.map(|n| page.saturating_mul(n as u64));
        let is_classic = total.is_some_and(|bytes| bytes < CLASSIC_BYTES);
        if is_classic {
            let encoder = TiffEncoder::new(file).map_err(io_error)?;
            Ok(Encoder::Classic(Box::new(encoder)))
        } else {
            let encoder = TiffEncoder::new_big(file).map_err(io_error)?;
            Ok(Encoder::Big(Box::new(encoder)))
        }
    }

    /// Takes a page that was written in part off the end of the file.
    fn repair(&mut self) {
        self.encoder = None;
        let (file, pages) = (self.hidden.as_file_mut(), self.record.written);
        // Where this fails, the pages before are still in the file.
        let _ = file
            .set_len(self.whole_bytes)
            .and_then(|()| end_chain(file, pages));
    }
}

/// Records `count` frames, or all that come, and gives the recording its name. `observer` hears what arrives.
///
/// Frames that are incomplete are kept, marked, in a recording of the purpose `record`; in a capture for a calibration
/// they would spoil the means, and are named as lost instead.
///
/// # Errors
/// No frame at all, or a recording that cannot be put in place. A source or disk that fails later is [`Ended::Failed`].
pub fn record(
    source: &mut dyn Source,
    mut recorder: Recorder,
    count: Option<usize>,
    cancel: &Cancel,
    observer: &mut dyn FnMut(&CaptureRecord),
) -> Result<(CaptureRecord, Ended)> {
    let ended = loop {
        if count.is_some_and(|count| recorder.record.written >= count) {
            break Ended::Complete;
        }
        match source.next(cancel) {
            Ok(Delivery::End) => break Ended::SourceEnd,
            Ok(delivery) => {
                if let Err(error) = recorder.take(delivery) {
                    break Ended::Failed(error);
                }
            }
            Err(error) if error.kind() == ErrorKind::Cancelled => break Ended::Interrupted,
            Err(error) => break Ended::Failed(error),
        }
        observer(&recorder.record);
    };
    if let (Ended::SourceEnd, Some(count)) = (&ended, count) {
        let written = recorder.record.written;
        recorder.warn(format!(
            "the source ended after {written} of {count} frames: record the rest"
        ));
    }
    let record = recorder.finish(&ended)?;
    Ok((record, ended))
}

/// A hidden file beside `path`, with the permissions of any new file.
fn hidden_file(folder: &Path, path: &Path) -> io::Result<NamedTempFile> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let prefix = format!(".{name}.");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(".part");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(folder)
}

/// Appends bytes, which take space on the disk.
fn extend(file: &mut File, bytes: u64) -> io::Result<()> {
    let block = vec![0x20; bytes as usize];
    file.write_all(&block)?;
    file.flush()
}

fn io_error(error: TiffError) -> io::Error {
    match error {
        TiffError::IoError(error) => error,
        error => io::Error::other(error),
    }
}

/// Makes page number `pages` the last one: its directory names no next one.
fn end_chain(file: &mut File, pages: usize) -> io::Result<()> {
    let mut header = [0; 16];
    file.rewind()?;
    file.read_exact(&mut header)?;
    let is_big = header[2] == 43;
    // Width of an offset, of an entry, of their count.
    let (offset_bytes, entry, count_bytes) = if is_big { (8, 20, 8) } else { (4, 12, 2) };
    let mut pointer = if is_big { 8 } else { 4 };
    for _ in 0..pages {
        let directory = number_at(file, pointer, offset_bytes)?;
        let entries = number_at(file, directory, count_bytes)?;
        pointer = directory + count_bytes as u64 + entries * entry;
    }
    file.seek(SeekFrom::Start(pointer))?;
    file.write_all(&[0; 8][..offset_bytes])
}

/// The number of `bytes` bytes at `position`, in the order of this machine, which the encoder writes.
fn number_at(file: &mut File, position: u64, bytes: usize) -> io::Result<u64> {
    let mut number = [0; 8];
    file.seek(SeekFrom::Start(position))?;
    if cfg!(target_endian = "big") {
        file.read_exact(&mut number[8 - bytes..])?;
    } else {
        file.read_exact(&mut number[..bytes])?;
    }
    Ok(u64::from_ne_bytes(number))
}

impl Settings {
    /// Refuses settings with which frames are of no use; returns warnings with their remedies.
    ///
    /// # Errors
    /// The first finding that makes frames useless, with its remedy.
    pub fn check(&self) -> Result<Vec<String>> {
        let reading = self.reading();
        if let Some(fatal) = reading.findings.iter().find(|finding| finding.is_fatal) {
            return Err(Error::input(
                Subject::named(self.source.clone()),
                &fatal.text,
                "a reconstruction needs frames of a rolling shutter, row by row as the sensor reads them",
                phrase![fatal.remedy.clone()],
            )
            .with_kind(ErrorKind::Unsupported));
        }
        let findings = reading.findings.iter();
        let mut warnings: Vec<String> = findings
            .map(|finding| format!("{}: {}", finding.text, finding.remedy))
            .collect();
        warnings.extend(reading.metadata.notes.iter().cloned());
        if reading.metadata.row_time_us.is_none() {
            warnings.push(
                "the row time is not known: measure it with a light that blinks (rowburst capture timing)".into(),
            );
        }
        Ok(warnings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_io::read_stack;

    fn frame(number: u64) -> Frame {
        Frame {
            rows: 3,
            columns: 4,
            counts: (0..12).map(|i| i * 10 + number as u16).collect(),
            number,
            time_us: Some(number * 1000),
        }
    }

    /// A source of a list of deliveries, and an error at its end.
    struct Listed(Vec<Delivery>);

    impl Source for Listed {
        fn name(&self) -> String {
            "listed".into()
        }

        fn settings(&mut self) -> Result<Settings> {
            Ok(Settings::default())
        }

        fn next(&mut self, cancel: &Cancel) -> Result<Delivery> {
            cancel.check()?;
            if self.0.is_empty() {
                return Err(Error::work(
                    Subject::named("listed"),
                    "unplugged",
                    "Plug it in.",
                ));
            }
            Ok(self.0.remove(0))
        }
    }

    fn recorded(
        folder: &Path,
        purpose: &str,
        deliveries: Vec<Delivery>,
        count: Option<usize>,
    ) -> Result<(CaptureRecord, Ended)> {
        let path = folder.join("a.tif");
        let recorder = Recorder::create(&path, purpose, Settings::default(), count)?;
        record(
            &mut Listed(deliveries),
            recorder,
            count,
            &Cancel::default(),
            &mut |_| (),
        )
    }

    fn faulty() -> Vec<Delivery> {
        vec![
            Delivery::Frame(frame(0)),
            Delivery::Dropped { first: 1, last: 3 },
            Delivery::Incomplete {
                frame: Some(frame(4)),
                number: 4,
                reason: "a packet is missing".into(),
            },
            Delivery::Frame(frame(5)),
        ]
    }

    #[test]
    fn nothing_is_lost_silently() {
        let folder = tempfile::tempdir().unwrap();
        let (record, ended) = recorded(folder.path(), "record", faulty(), None).unwrap();
        // A camera that goes away ends the recording and loses no frame.
        assert!(matches!(ended, Ended::Failed(_)) && record.ended.contains("unplugged"));
        assert_eq!(
            (record.written, record.dropped, record.incomplete),
            (3, 3, 1)
        );
        assert_eq!(
            record.frames[1].incomplete.as_deref(),
            Some("a packet is missing")
        );
        assert_eq!((record.lost[0].first, record.lost[0].last), (1, 3));
        let pages = read_stack(&folder.path().join("a.tif")).unwrap();
        assert_eq!(pages.len(), 3);
        assert_eq!(pages[2].at(2, 3), 115.0);
        let json = std::fs::read(folder.path().join("a.json")).unwrap();
        assert_eq!(
            serde_json::from_slice::<CaptureRecord>(&json).unwrap(),
            record
        );
    }

    #[test]
    fn calibrations_get_whole_frames_alone() {
        let folder = tempfile::tempdir().unwrap();
        let (record, ended) = recorded(folder.path(), "darks", faulty(), Some(2)).unwrap();
        assert!(matches!(ended, Ended::Complete));
        assert_eq!((record.written, record.incomplete), (2, 1));
        assert_eq!(
            (record.lost[1].first, record.lost[1].reason.as_str()),
            (4, "a packet is missing")
        );
    }

    #[test]
    fn a_recording_is_not_replaced_and_an_empty_one_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let error = recorded(folder.path(), "record", Vec::new(), None).unwrap_err();
        assert!(error.to_string().contains("unplugged"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        std::fs::write(folder.path().join("a.tif"), "x").unwrap();
        let error = recorded(folder.path(), "record", faulty(), None).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Exists);
    }

    #[test]
    fn a_page_written_in_part_is_taken_off() {
        for requested in [Some(9), None] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.tif");
            let mut recorder =
                Recorder::create(&path, "record", Settings::default(), requested).unwrap();
            recorder.write(&frame(0), None).unwrap();
            recorder.write(&frame(1), None).unwrap();
            let whole = recorder.whole_bytes;
            recorder.write_page(&frame(2)).unwrap();
            recorder.whole_bytes = whole;
            recorder.repair();
            let ended = Ended::Failed(Error::work(Subject::named("disk"), "full", "Free space."));
            recorder.finish(&ended).unwrap();
            let pages = read_stack(&path).unwrap();
            assert_eq!(pages.len(), 2);
            assert_eq!(pages[1].at(0, 1), 11.0);
        }
    }

    #[test]
    fn no_recording_is_without_its_record() {
        let folder = tempfile::tempdir().unwrap();
        // The name of the record is taken by a folder, so it cannot be written.
        std::fs::create_dir(folder.path().join("a.json")).unwrap();
        let error = recorded(folder.path(), "record", faulty(), None).unwrap_err();
        assert!(error.to_string().contains("a.json"), "{error}");
        assert!(!folder.path().join("a.tif").exists());
    }

    #[test]
    fn what_is_wrong_with_a_capture_is_in_its_record() {
        let folder = tempfile::tempdir().unwrap();
        let equal = vec![Delivery::Frame(frame(1)), Delivery::Frame(frame(1))];
        let (record, _) = recorded(folder.path(), "darks", equal, Some(2)).unwrap();
        assert!(
            record
                .warnings
                .iter()
                .any(|w| w.contains("the darks are equal")),
            "{:?}",
            record.warnings
        );
        assert_eq!(record.frames[0].mean_counts, Some(56.0));
    }

    #[test]
    fn a_global_shutter_is_refused() {
        let mut settings = Settings::default();
        settings.push("SensorShutterMode", "Global");
        let error = settings.check().unwrap_err();
        assert!(
            error.is_input() && error.to_string().contains("rolling shutter"),
            "{error}"
        );
        let warnings = Settings::default().check().unwrap();
        assert!(warnings[0].contains("row time"), "{warnings:?}");
    }
}
