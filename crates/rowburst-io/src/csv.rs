//! Tables of numbers as text: signals of a photodiode, traces.

use crate::fault;
use rowburst::error::Subject;
use rowburst::traces::Photodiode;
use rowburst::{Error, ErrorKind, Result};
use std::io::Write;
use std::path::Path;

/// Names of the time column and microseconds in its unit.
const TIMES: [(&str, f64); 4] = [
    ("time_us", 1.0),
    ("time_ns", 1e-3),
    ("time_ms", 1e3),
    ("time_s", 1e6),
];
/// Largest file that is read: a second at 10 MHz.
const MAX_BYTES: u64 = 512 << 20;

/// Reads a photodiode's signal: a heading `time_us,value` (or `time_s`, `time_ms`, `time_ns`),
/// then a line for each sample. Empty lines and those that begin with `#` are passed over; commas,
/// semicolons and tabs separate.
///
/// # Errors
/// A file that cannot be read, a heading without a unit of time, a line that has not two numbers,
/// times that do not increase.
pub fn read_photodiode(path: &Path) -> Result<Photodiode> {
    let size = std::fs::metadata(path)
        .map_err(|e| fault::read_error(path, &e))?
        .len();
    if size > MAX_BYTES {
        return Err(Error::input(
            path,
            format!("{} MB", size >> 20),
            format!("a signal has at most {} MB", MAX_BYTES >> 20),
            "Cut it to the time of the frame, or record fewer samples.",
        ));
    }
    let bytes = std::fs::read(path).map_err(|e| fault::read_error(path, &e))?;
    let text = String::from_utf8(bytes).map_err(|_| {
        Error::input(
            path,
            "bytes that are no text",
            "a signal is a text file with the columns time and value",
            "Export it as CSV.",
        )
    })?;
    let lines = text.trim_start_matches('\u{feff}').lines().enumerate();
    let mut lines = lines
        .map(|(i, line)| (i + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let cells = |line: &str| -> Vec<String> {
        let parts = line.split([',', ';', '\t']);
        parts
            .map(|p| p.trim().trim_matches('"').to_string())
            .collect()
    };
    let place = |number: usize| Subject::in_file(path, format!("line {number}"));
    let heading_rule =
        "the first line names the columns: time_us (or time_s, time_ms, time_ns) and value";
    let Some((number, heading)) = lines.next() else {
        return Err(Error::input(
            path,
            "an empty file",
            heading_rule,
            "Begin it with the line time_us,value.",
        )
        .with_kind(ErrorKind::Missing));
    };
    let names = cells(&heading.to_lowercase());
    let unit = names
        .first()
        .and_then(|n| TIMES.iter().find(|(t, _)| t == n));
    let (Some((_, us)), 2) = (unit, names.len()) else {
        return Err(Error::input(
            place(number),
            format!("\"{heading}\""),
            heading_rule,
            "Write the heading with the unit of the times, such as time_us,value.",
        ));
    };
    let mut points: Vec<(f64, f64)> = Vec::new();
    for (number, line) in lines {
        let values: Vec<Option<f64>> = cells(line).iter().map(|c| c.parse().ok()).collect();
        let [Some(time), Some(value)] = values[..] else {
            return Err(Error::input(
                place(number),
                format!("\"{line}\""),
                "a line has two numbers, the time and the value",
                "Use a point for decimals and a comma between the numbers.",
            ));
        };
        let later = points.last().is_none_or(|(last, _)| time * us > *last);
        if !(time.is_finite() && value.is_finite() && later) {
            return Err(Error::input(
                place(number),
                format!("\"{line}\""),
                "numbers are finite, and each time is later than the one before",
                "Sort the lines by time, and take out those that are not numbers.",
            ));
        }
        points.push((time * us, value));
    }
    Photodiode::new(&points).map_err(|e| e.within(path))
}

/// Writes a table: `heading`, then a line for each row; what is not a number is left empty.
///
/// # Errors
/// Failed writes.
pub fn write_csv(
    w: &mut impl Write,
    heading: &[String],
    rows: impl IntoIterator<Item = Vec<f64>>,
) -> Result<()> {
    let mut line = |text: String| writeln!(w, "{text}").map_err(|e| fault::write_error(&e));
    line(heading.join(","))?;
    for row in rows {
        let cell = |v: &f64| {
            if v.is_finite() {
                let text = format!("{v:.8e}");
                let plain = text.parse::<f64>().unwrap_or(*v).to_string();
                if plain.len() < text.len() {
                    plain
                } else {
                    text
                }
            } else {
                String::new()
            }
        };
        line(row.iter().map(cell).collect::<Vec<_>>().join(","))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &[u8]) -> Result<Vec<(f64, f64)>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("diode.csv");
        std::fs::write(&path, text).unwrap();
        Ok(read_photodiode(&path)?.points().collect())
    }

    #[test]
    fn units_separators_and_comments() {
        let expected = vec![(0.0, 1.5), (2.0, -3.0)];
        for text in [
            "time_us,value\n0,1.5\n2,-3\n",
            "# scope\n\ntime_us,value\n0,1.5\n2,-3\n",
            "time_us;value\r\n0;1.5\r\n# note\r\n2;-3\r\n",
            "\"Time_ms\"\t\"value\"\n0\t1.5\n0.002\t-3\n",
            "\u{feff}time_ns, value\n0, 1.5\n2e3, -3\n",
        ] {
            assert_eq!(read(text.as_bytes()).unwrap(), expected, "{text}");
        }
        let seconds = read(b"time_s,value\n0,1\n1e-6,2\n").unwrap();
        assert!((seconds[1].0 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn mistakes_name_the_line() {
        for (text, word) in [
            ("", "empty file"),
            ("0,1\n1,2\n", "line 1"),
            ("time,value\n0,1\n", "unit"),
            ("time_us,value,x\n", "line 1"),
            ("time_us,value\n0,1\n1,2,3\n", "line 3"),
            ("time_us,value\n0,1\n\n1,two\n", "line 4"),
            ("time_us,value\n0,1\n0,2\n", "line 3"),
            ("time_us,value\n0,NaN\n", "line 2"),
            ("time_us,value\n0,1\n", "at least two"),
        ] {
            let message = read(text.as_bytes()).unwrap_err().to_string();
            assert!(
                message.contains(word) && message.contains("diode.csv"),
                "{message}"
            );
        }
        assert!(read(&[0xff, 0xfe, 0]).is_err());
        assert!(read_photodiode("none.csv".as_ref()).is_err());
    }

    #[test]
    fn tables_come_back() {
        let mut bytes = Vec::new();
        let heading = ["time_us".to_string(), "value".to_string()];
        let rows = [vec![0.0, 0.1], vec![4.8, f64::NAN], vec![9.6, 1.0 / 3.0e7]];
        write_csv(&mut bytes, &heading, rows).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        assert_eq!(text, "time_us,value\n0,0.1\n4.8,\n9.6,3.33333333e-8\n");
    }
}
