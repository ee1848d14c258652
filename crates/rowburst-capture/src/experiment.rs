//! The experiment file of a camera's settings, with where each number comes from.

use crate::settings::{REQUIRED, Settings};
use rowburst_io::CameraReading;
use std::fmt::Write;

/// What to do about a key that nothing says.
const REMEDIES: [(&str, &str); 3] = [
    (
        "row_time_us",
        "measure it: rowburst capture timing, then rowburst calibrate timing",
    ),
    (
        "shutter",
        "top-down, bottom-up, dual-inside-out or dual-outside-in; rowburst calibrate timing finds it",
    ),
    ("exposure_us", "the exposure of each row, as it was set"),
];

/// The text of an experiment file with what `settings` say. What they do not say stands in it as a comment.
pub fn experiment_text(settings: &Settings) -> String {
    let reading = settings.reading();
    let mut text = format!(
        "# Written by rowburst capture {} from the settings of {}.\n# Each number says where it comes from.\n\n[camera]\n",
        env!("CARGO_PKG_VERSION"),
        settings.source
    );
    if let Some(camera) = &settings.camera {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "# The camera: {}.", camera.replace('\n', " "));
    }
    for (key, value) in values_of(&reading) {
        line(&mut text, &reading, key, value);
    }
    if let Some(period) = reading.metadata.frame_period_us {
        text += "\n[recording]\n";
        line(
            &mut text,
            &reading,
            "frame_period_us",
            Some(period.to_string()),
        );
    }
    text
}

fn values_of(reading: &CameraReading) -> Vec<(&'static str, Option<String>)> {
    let metadata = &reading.metadata;
    let number = |value: Option<f64>| value.map(|v| v.to_string());
    let shutter = metadata.shutter.as_ref();
    vec![
        ("rows", metadata.size.map(|(rows, _)| rows.to_string())),
        (
            "columns",
            metadata.size.map(|(_, columns)| columns.to_string()),
        ),
        ("shutter", shutter.map(|s| format!("\"{}\"", s.name()))),
        ("row_time_us", number(metadata.row_time_us)),
        ("exposure_us", number(metadata.exposure_us)),
        (
            "binning",
            metadata.binning.filter(|&b| b > 1).map(|b| b.to_string()),
        ),
        ("bit_depth", metadata.bit_depth.map(|bits| bits.to_string())),
        ("pixel_pitch_um", number(metadata.pixel_pitch_um)),
    ]
}

fn line(text: &mut String, reading: &CameraReading, key: &str, value: Option<String>) {
    let known = reading.provenance.iter().find(|p| p.key == key);
    // Writing to a String cannot fail.
    let _ = match value {
        Some(value) => {
            let from = known.map_or(String::new(), |p| {
                format!("  # {}: {}", p.origin.name(), p.from)
            });
            writeln!(text, "{key} = {value}{from}")
        }
        None if REQUIRED.contains(&key) => {
            let remedy = REMEDIES.iter().find(|(of, _)| *of == key);
            let remedy = remedy.map_or("", |(_, remedy)| remedy);
            writeln!(text, "# {key} =  # unknown: {remedy}")
        }
        None => Ok(()),
    };
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_io::Experiment;

    #[test]
    fn the_file_says_where_its_numbers_are_from() {
        let mut settings = Settings {
            source: "play:a.tif".into(),
            ..Settings::default()
        };
        for (name, value) in [
            ("AOIHeight", "108"),
            ("AOIWidth", "200"),
            ("RowReadTime", "9.24e-06"),
            ("SensorReadoutMode", "Centre Out Simultaneous"),
        ] {
            settings.push(name, value);
        }
        let open = experiment_text(&settings);
        assert!(open.contains("# exposure_us =  # unknown"), "{open}");
        settings.push("ExposureTime", "9.24e-06");
        let text = experiment_text(&settings);
        assert!(text.contains("# read: RowReadTime = 9.24e-06"), "{text}");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("experiment.toml");
        std::fs::write(&path, text).unwrap();
        let camera = Experiment::read(&path).unwrap().camera().unwrap();
        assert_eq!((camera.rows(), camera.columns()), (108, 200));
        assert!((camera.params().row_time_us - 9.24).abs() < 1e-9);
    }
}
