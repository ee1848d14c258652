//! Photron: a header (`.cihx`: XML in a binary file; `.cih`: text) and raw frames (`.mraw`).
//!
//! Frames lie one after the other, rows from the top, 8, 10, 12 or 16 bits a pixel: 16 as
//! little-endian words, 10 and 12 packed without gaps, the highest bit first. Not documented by
//! the maker; as pyMRAW reads them, and as a FASTCAM Nova S16 wrote them.

use crate::fault;
use crate::pages::{Pages, SampleFormat};
use crate::source::Source;
use rowburst::Result;
use roxmltree::Document;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// A header is some ten kilobytes.
const MAX_HEADER_BYTES: u64 = 1 << 24;

/// What a header says.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Header {
    rows: usize,
    columns: usize,
    count: usize,
    /// Bits of a pixel in the file.
    bits: u32,
    /// Bits of it that hold the count.
    depth: u32,
    /// Places by which counts lie too high.
    shift: u32,
    pub rate_hz: Option<f64>,
    pub exposure_s: Option<f64>,
}

impl Header {
    pub fn size(&self) -> (usize, usize) {
        (self.rows, self.columns)
    }

    pub fn depth(&self) -> u32 {
        self.depth
    }
}

/// Raw frames with their header.
pub(crate) struct Stack {
    header: Header,
    file: BufReader<File>,
    bytes: u64,
}

impl Stack {
    /// Opens the raw frames beside a header, or the header beside the raw frames.
    pub fn open(source: &Source) -> Result<Self> {
        let (header_path, raw_path) = both(source)?;
        let header = read_header(source, &header_path)?;
        let open =
            || -> std::io::Result<_> { Ok((raw_path.metadata()?.len(), File::open(&raw_path)?)) };
        let (bytes, file) = open().map_err(|e| fault::read_error(&raw_path, &e))?;
        Ok(Self {
            header,
            file: BufReader::new(file),
            bytes,
        })
    }

    /// What its header says.
    pub fn header(&self) -> &Header {
        &self.header
    }
}

impl crate::pages::Stack for Stack {
    fn count(&self) -> usize {
        self.header.count
    }

    fn page(&mut self, source: &Source, at: usize) -> Result<Pages> {
        let Header {
            rows,
            columns,
            bits,
            depth,
            shift,
            ..
        } = self.header;
        let raw = Source {
            bytes: self.bytes,
            ..*source
        };
        let mut data = raw.reserve_pixels(1, rows, columns)?;
        let length = (rows * columns) as u64 * u64::from(bits) / 8;
        let start = (at as u64).saturating_mul(length);
        if start.saturating_add(length) > self.bytes {
            return Err(source.error(
                format!(
                    "raw frames of {} bytes, which end before frame {at}",
                    self.bytes
                ),
                format!(
                    "its header claims {} frames of {rows}×{columns}",
                    self.header.count
                ),
                "Save or copy the .mraw file again: it is cut short.",
            ));
        }
        let mut buffer = vec![0; length as usize];
        self.file
            .seek(SeekFrom::Start(start))
            .and_then(|_| self.file.read_exact(&mut buffer))
            .map_err(|e| source.unreadable(e))?;
        match bits {
            8 => data.extend(buffer.iter().map(|&b| f32::from(b >> shift))),
            16 => data.extend(
                buffer
                    .as_chunks()
                    .0
                    .iter()
                    .map(|&b| f32::from(u16::from_le_bytes(b) >> shift)),
            ),
            bits => unpack(&buffer, bits, shift, &mut data),
        }
        Ok(Pages {
            count: 1,
            rows,
            columns,
            data,
            format: SampleFormat::Counts { bits: depth },
        })
    }
}

/// Appends numbers of `bits` bits that lie without gaps, the highest bit first.
fn unpack(bytes: &[u8], bits: u32, shift: u32, data: &mut Vec<f32>) {
    let (mut held, mut have) = (0u32, 0);
    for &byte in bytes {
        held = held << 8 | u32::from(byte);
        have += 8;
        if have >= bits {
            have -= bits;
            data.push((held >> have >> shift) as f32);
            held &= (1 << have) - 1;
        }
    }
}

/// The header and the raw frames that `source` belongs to.
fn both(source: &Source) -> Result<(std::path::PathBuf, std::path::PathBuf)> {
    let path = source.path;
    let beside = |endings: &[&str]| {
        let mut files = endings.iter().map(|ending| path.with_extension(ending));
        files.find(|file| file.is_file())
    };
    let is_raw = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("mraw"));
    let other = if is_raw {
        beside(&["cihx", "cih", "CIHX", "CIH"])
    } else {
        beside(&["mraw", "MRAW"])
    };
    match other {
        Some(header) if is_raw => Ok((header, path.into())),
        Some(raw) => Ok((path.into(), raw)),
        None => Err(source.error(
            if is_raw {
                "raw frames without their header"
            } else {
                "a header without its raw frames"
            },
            "NAME.cihx (or .cih) and NAME.mraw lie in one folder",
            "Copy the other file beside it, with the same name.",
        )),
    }
}

fn read_header(source: &Source, path: &Path) -> Result<Header> {
    let metadata = path.metadata().map_err(|e| fault::read_error(path, &e))?;
    if metadata.len() > MAX_HEADER_BYTES {
        return Err(source.unreadable("a header longer than 16 MiB"));
    }
    let bytes = std::fs::read(path).map_err(|e| fault::read_error(path, &e))?;
    let text = String::from_utf8_lossy(&bytes);
    let is_xml = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("cihx"));
    let values = if is_xml {
        of_xml(&text)
    } else {
        of_text(&text)
    };
    let values = values.map_err(|reason| source.unreadable(reason))?;
    checked(source, &values)
}

/// The values of a header as it writes them.
#[derive(Debug, Default)]
struct Values {
    width: Option<String>,
    height: Option<String>,
    count: Option<String>,
    bits: Option<String>,
    depth: Option<String>,
    side: Option<String>,
    colour: Option<String>,
    format: Option<String>,
    rate: Option<String>,
    shutter: Option<String>,
}

fn of_xml(text: &str) -> std::result::Result<Values, String> {
    let ends = text.find("<cih>").zip(text.rfind("</cih>"));
    let xml = ends.and_then(|(start, end)| text.get(start..end + "</cih>".len()));
    let xml = xml.ok_or("no <cih> in it")?;
    let document = Document::parse(xml).map_err(|e| e.to_string())?;
    let value = |path: &[&str]| -> Option<String> {
        let mut node = document.root_element();
        for name in path {
            node = node.children().find(|n| n.has_tag_name(*name))?;
        }
        Some(node.text()?.trim().to_string())
    };
    Ok(Values {
        width: value(&["imageDataInfo", "resolution", "width"]),
        height: value(&["imageDataInfo", "resolution", "height"]),
        count: value(&["frameInfo", "totalFrame"]),
        bits: value(&["imageDataInfo", "colorInfo", "bit"]),
        depth: value(&["imageDataInfo", "effectiveBit", "depth"]),
        side: value(&["imageDataInfo", "effectiveBit", "side"]),
        colour: value(&["imageDataInfo", "colorInfo", "type"]),
        format: value(&["imageFileInfo", "fileFormat"]),
        rate: value(&["recordInfo", "recordRate"]),
        shutter: value(&["recordInfo", "shutterSpeed"]),
    })
}

fn of_text(text: &str) -> std::result::Result<Values, String> {
    let value = |key: &str| -> Option<String> {
        let mut lines = text.lines().filter_map(|line| line.split_once(':'));
        lines.find_map(|(k, v)| (k.trim() == key).then(|| v.trim().to_string()))
    };
    Ok(Values {
        width: value("Image Width"),
        height: value("Image Height"),
        count: value("Total Frame"),
        bits: value("Color Bit"),
        depth: value("EffectiveBit Depth"),
        side: value("EffectiveBit Side"),
        colour: value("Color Type"),
        format: value("File Format"),
        rate: value("Record Rate(fps)"),
        shutter: value("Shutter Speed(s)"),
    })
}

fn checked(source: &Source, values: &Values) -> Result<Header> {
    let number = |key: &str, value: &Option<String>| -> Result<usize> {
        let text = value.as_deref();
        let number = text
            .and_then(|t| t.parse::<usize>().ok())
            .filter(|&n| n > 0);
        number.ok_or_else(|| {
            source.unreadable(format!("its {key} is {:?}", text.unwrap_or("missing")))
        })
    };
    let is = |value: &Option<String>, word: &str| {
        value.as_ref().is_none_or(|v| v.eq_ignore_ascii_case(word))
    };
    if !is(&values.format, "mraw") {
        return Err(source.unsupported(format!(
            "that a {} file of Photron holds",
            values.format.as_deref().unwrap_or_default()
        )));
    }
    let is_grey =
        is(&values.colour, "mono") || is(&values.colour, "raw") || is(&values.colour, "bayer");
    let bits = number("colour bit", &values.bits)? as u32;
    if !is_grey || ![8, 10, 12, 16].contains(&bits) {
        return Err(source.unsupported(format!(
            "{} of {bits} bits in MRAW",
            values.colour.as_deref().unwrap_or("grey")
        )));
    }
    let (rows, columns) = (
        number("height", &values.height)?,
        number("width", &values.width)?,
    );
    if !(rows.saturating_mul(columns).saturating_mul(bits as usize)).is_multiple_of(8) {
        return Err(source.unreadable("frames that end within a byte"));
    }
    let depth = match &values.depth {
        None => bits,
        Some(_) => number("effective bit depth", &values.depth)? as u32,
    };
    if depth > bits {
        return Err(source.unreadable(format!("{depth} effective of {bits} bits")));
    }
    let is_low = is(&values.side, "lower");
    let number_of = |text: &str| text.trim().parse::<f64>().ok();
    // 1/30000, or 30000 for the same.
    let exposure_s = values
        .shutter
        .as_deref()
        .and_then(|text| match text.split_once('/') {
            Some((a, b)) => Some(number_of(a)? / number_of(b)?),
            None => number_of(text).map(|s| if s > 1.0 { 1.0 / s } else { s }),
        });
    Ok(Header {
        rows,
        columns,
        count: number("total frame", &values.count)?,
        bits,
        depth,
        shift: if is_low { 0 } else { bits - depth },
        rate_hz: values.rate.as_deref().and_then(number_of),
        exposure_s,
    })
}

#[cfg(test)]
mod tests {
    use crate::metadata::read_metadata;
    use crate::pages::SampleFormat;
    use crate::read::read_stack;
    use crate::recording::open_recording;
    use std::path::Path;

    fn cihx(bits: u32, depth: u32, side: &str) -> String {
        format!(
            "\u{0}\u{1}junk<cih><fileInfo><date>2026/11/22</date></fileInfo>
            <recordInfo><recordRate>50000</recordRate><shutterSpeed>200000</shutterSpeed></recordInfo>
            <frameInfo><totalFrame>2</totalFrame></frameInfo>
            <imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo>
            <imageDataInfo><resolution><width>4</width><height>2</height></resolution>
            <colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo>
            <effectiveBit><depth>{depth}</depth><side>{side}</side></effectiveBit></imageDataInfo></cih>\u{0}"
        )
    }

    fn write(folder: &Path, header: &str, raw: &[u8]) {
        std::fs::write(folder.join("a.cihx"), header).unwrap();
        std::fs::write(folder.join("a.mraw"), raw).unwrap();
    }

    /// Numbers packed without gaps, the highest bit first.
    fn packed(numbers: &[u16], bits: u32) -> Vec<u8> {
        let digits: String = numbers
            .iter()
            .map(|n| format!("{n:0width$b}", width = bits as usize))
            .collect();
        let bytes = digits.as_bytes().chunks(8);
        bytes
            .map(|b| u8::from_str_radix(std::str::from_utf8(b).unwrap(), 2).unwrap())
            .collect()
    }

    #[test]
    fn all_packings_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let numbers: Vec<u16> = (0..16).map(|v| v * 61 + 1).collect();
        let expected: Vec<f32> = numbers.iter().map(|&v| f32::from(v)).collect();
        let low: Vec<u8> = numbers.iter().flat_map(|v| v.to_le_bytes()).collect();
        let high: Vec<u8> = numbers
            .iter()
            .flat_map(|v| (v << 4).to_le_bytes())
            .collect();
        let cases = [
            (10, 10, "Lower", packed(&numbers, 10)),
            (12, 12, "Lower", packed(&numbers, 12)),
            (16, 12, "Lower", low),
            (16, 12, "Higher", high),
        ];
        for (bits, depth, side, raw) in cases {
            write(folder.path(), &cihx(bits, depth, side), &raw);
            for name in ["a.cihx", "a.mraw"] {
                let stack = read_stack(&folder.path().join(name)).unwrap();
                assert_eq!(
                    (stack.len(), stack[0].rows(), stack[0].columns()),
                    (2, 2, 4)
                );
                assert_eq!(
                    [stack[0].data(), stack[1].data()].concat(),
                    expected,
                    "{bits} {side}"
                );
            }
            let frames = open_recording(folder.path()).unwrap();
            assert_eq!(frames.count(), 2);
            assert_eq!(
                frames.read(1).unwrap().format,
                SampleFormat::Counts { bits: depth }
            );
        }
        let found = read_metadata(&folder.path().join("a.mraw"));
        assert_eq!(
            (found.exposure_us, found.frame_period_us),
            (Some(5.0), Some(20.0))
        );
        assert_eq!((found.size, found.bit_depth), (Some((2, 4)), Some(12)));
    }

    #[test]
    fn the_older_header_is_text() {
        let folder = tempfile::tempdir().unwrap();
        let text = "#Camera Information Header\r\nRecord Rate(fps) : 50000\r\nShutter Speed(s) : 1/200000\r\nTotal Frame : 2\r\nImage Width : 4\r\nImage Height : 2\r\nColor Type : Mono\r\nColor Bit : 8\r\nFile Format : MRaw\r\nEffectiveBit Depth : 8\r\nEffectiveBit Side : Lower\r\n";
        std::fs::write(folder.path().join("a.cih"), text).unwrap();
        std::fs::write(folder.path().join("a.mraw"), (0..16).collect::<Vec<u8>>()).unwrap();
        assert_eq!(
            read_stack(&folder.path().join("a.cih")).unwrap()[1].at(1, 3),
            15.0
        );
        let found = read_metadata(&folder.path().join("a.mraw"));
        assert_eq!(found.exposure_us, Some(5.0));
    }

    #[test]
    fn bad_files_say_what_is_wrong() {
        let folder = tempfile::tempdir().unwrap();
        let message = |header: &str, raw: &[u8]| {
            write(folder.path(), header, raw);
            read_stack(&folder.path().join("a.cihx"))
                .unwrap_err()
                .to_string()
        };
        let header = cihx(12, 12, "Lower");
        assert!(message(&header, &[0; 23]).contains("end before frame 1"));
        assert!(message("nothing", &[0; 24]).contains("no <cih>"));
        assert!(message(&header.replace("Mono", "RGB"), &[0; 24]).contains("RGB of 12 bits"));
        assert!(message(&header.replace(">4<", ">-4<"), &[0; 24]).contains("width is \"-4\""));
        assert!(message(&header.replace(">4<", ">400000000<"), &[0; 24]).contains("400000000"));
        for length in 0..header.len() {
            write(folder.path(), header.get(..length).unwrap_or(""), &[0; 24]);
            let _ = read_stack(&folder.path().join("a.cihx"));
        }
        std::fs::remove_file(folder.path().join("a.cihx")).unwrap();
        let error = read_stack(&folder.path().join("a.mraw"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("raw frames without their header"), "{error}");
    }
}
