//! The page and the plots of `calibrate timing`.

use super::{exposure, row_time, shutter_names};
use crate::calibrate::verdict;
use crate::short;
use rowburst::Result;
use rowburst::calibrate::timing::{CLEAR_MARGIN, Timing};
use rowburst_io::OutputFolder;
use rowburst_report::{Curve, Drawing, Ink, Plot, Scale, Sheet};

/// Writes report.html and its pictures. `reproduce` is the command that repeats the calibration.
pub(super) fn write_report(
    folder: &OutputFolder,
    timing: &Timing,
    has_experiment: bool,
    reproduce: Option<&str>,
) -> Result<()> {
    let mut files = vec![
        (
            "timing.json".to_string(),
            "the numbers, for programs".to_string(),
        ),
        ("report.html".to_string(), "this page".to_string()),
    ];
    if has_experiment {
        files.push((
            "experiment.toml".into(),
            "the experiment with these numbers".into(),
        ));
    }
    let rows = timing.profiles[0].0.len();
    let report = Sheet {
        title: "Rowburst: timing of a camera",
        summary: format!(
            "{} of {rows} rows of a light that changes",
            plural(timing.profiles.len(), "frame")
        ),
        verdict: verdict(
            &timing.warnings,
            "the light decides row time and readout order",
        ),
        warnings: timing.warnings.clone(),
        notes: timing.advice.clone().into_iter().collect(),
        headline: vec![
            ("row time".into(), row_time(timing)),
            ("shutter".into(), shutter_names(timing)),
            ("exposure".into(), exposure(timing)),
            ("readout".into(), format!("{} ms", short(timing.readout_ms))),
        ],
        sections: vec![
            ("Rows", vec![profile(timing), detail(timing)]),
            (
                "What decides",
                vec![periodogram(timing), candidates(timing)],
            ),
        ],
        tables: tables(timing),
        files,
        reproduce,
    }
    .render()?;
    for picture in &report.pictures {
        folder.write_bytes(&picture.name, &picture.png)?;
    }
    folder.write_bytes("report.html", report.html.as_bytes())
}

fn plural(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

fn curve(name: &str, points: Vec<(f64, f64)>, ink: Ink) -> Curve {
    Curve {
        name: name.into(),
        points,
        ink,
    }
}

fn over_rows(values: &[f64], from: usize, to: usize) -> Vec<(f64, f64)> {
    (from..to).map(|r| (r as f64, values[r])).collect()
}

fn profile(timing: &Timing) -> Drawing<'_> {
    let (measured, model) = &timing.profiles[0];
    let rows = measured.len();
    Drawing {
        name: "rows",
        plot: Plot::Curves {
            x: ("row", Scale::Linear(0.0, rows as f64 - 1.0)),
            y: ("light over its mean", Scale::Auto),
            curves: vec![
                curve("measured, mean of each row", over_rows(measured, 0, rows), Ink::Line),
                curve("fit", over_rows(model, 0, rows), Ink::Line),
            ],
        },
        caption: "The stripes of the first frame and their fit. Where they differ, the light, the shutter or the profile of the lamp is not as the fit assumes.".into(),
        alt: "Light of each row, measured and fitted".into(),
    }
}

/// Rows about the middle, where two sweeps meet, wide enough for some periods.
fn detail(timing: &Timing) -> Drawing<'_> {
    let (measured, model) = &timing.profiles[0];
    let rows = measured.len();
    let width = match timing.periods {
        Some(periods) => (timing.readout_ms * 1e3 / timing.row_time_us / periods * 4.0) as usize,
        None => rows / 6,
    };
    let half = width.clamp(20, 400) / 2;
    let (from, to) = ((rows / 2).saturating_sub(half), (rows / 2 + half).min(rows));
    Drawing {
        name: "rows-middle",
        plot: Plot::Curves {
            x: ("row", Scale::Linear(from as f64, to as f64 - 1.0)),
            y: ("light over its mean", Scale::Auto),
            curves: vec![
                curve("fit", over_rows(model, from, to), Ink::Line),
                curve("measured, mean of each row", over_rows(measured, from, to), Ink::Dots),
            ],
        },
        caption: "The rows about the middle of the sensor. The stripes of two sweeps mirror each other here; the width of a stripe's edge is the exposure in row times.".into(),
        alt: "Light of the middle rows, measured and fitted".into(),
    }
}

fn periodogram(timing: &Timing) -> Drawing<'_> {
    // The peak and ten harmonics; the noise to their right says nothing more.
    let instants = timing.readout_ms * 1e3 / timing.row_time_us;
    let end = match timing.periods {
        Some(periods) => (12.0 * periods / instants).min(0.5),
        None => 0.5,
    };
    let shown: Vec<(f64, f64)> = timing
        .periodogram
        .iter()
        .filter(|p| p.0 <= end)
        .map(|&(x, y)| (x, y.max(1e-8)))
        .collect();
    let mut curves = vec![curve("power of the rows", shown, Ink::Line)];
    if let Some(periods) = timing.periods {
        let at = periods / instants;
        curves.push(curve(
            "the frequency found",
            vec![(at, 1e-8), (at, 1.0)],
            Ink::Expected,
        ));
    }
    Drawing {
        name: "periodogram",
        plot: Plot::Curves {
            x: ("frequency (cycles per row time)", Scale::Linear(0.0, end)),
            y: ("power over the highest", Scale::Log(1e-8, 1.0)),
            curves,
        },
        caption: "How strongly the rows vary at each frequency, read in the best order. A light of one frequency has a peak there and at its multiples, far above the rest.".into(),
        alt: "Power against frequency in cycles per row time".into(),
    }
}

fn candidates(timing: &Timing) -> Drawing<'_> {
    let place = |i: usize| i as f64 + 1.0;
    let points: Vec<(f64, f64)> = timing
        .candidates
        .iter()
        .enumerate()
        .map(|(i, c)| (place(i), c.excess.max(1.0)))
        .collect();
    let highest = points.iter().map(|p| p.1).fold(CLEAR_MARGIN, f64::max);
    let labels: Vec<String> = timing
        .candidates
        .iter()
        .enumerate()
        .map(|(i, c)| format!("{} {}", place(i), c.shutter.name()))
        .collect();
    Drawing {
        name: "candidates",
        plot: Plot::Curves {
            x: (
                "readout order, numbered as in the table",
                Scale::Linear(0.5, place(timing.candidates.len()) - 0.5),
            ),
            y: (
                "χ² beyond the best (below 1: 1)",
                Scale::Log(0.5, 3.0 * highest),
            ),
            curves: vec![
                curve(
                    "excluded above",
                    vec![(0.5, CLEAR_MARGIN), (4.5, CLEAR_MARGIN)],
                    Ink::Expected,
                ),
                curve(&labels.join(", "), points, Ink::Dots),
            ],
        },
        caption: format!(
            "How much worse than the best each readout order explains the rows: {}. Orders above the dashed line, at {CLEAR_MARGIN}, are excluded.",
            labels.join(", ")
        ),
        alt: "Excess of χ² of the four readout orders".into(),
    }
}

fn tables(timing: &Timing) -> Vec<(String, Vec<(String, String)>)> {
    let pair = |name: &str, value: String| (name.to_string(), value);
    let mut found = vec![
        pair("row time", row_time(timing)),
        pair("consistent shutters", shutter_names(timing)),
        pair("exposure", exposure(timing)),
        pair("exposure from", timing.exposure_basis.clone()),
        pair(
            "readout of a frame",
            format!("{} ms", short(timing.readout_ms)),
        ),
        pair(
            "modulation depth",
            format!("{:.1} %", 100.0 * timing.modulation_depth),
        ),
        pair(
            "variance explained",
            format!("{:.2} %", 100.0 * timing.explained),
        ),
    ];
    let numbers: Vec<String> = timing.phases.iter().map(|p| short(*p)).collect();
    match timing.periods {
        Some(periods) => {
            found.push(pair("periods in the readout", short(periods)));
            found.push(pair("phase of each frame (periods)", numbers.join(", ")));
        }
        None => found.push(pair("start on the signal's clock (µs)", numbers.join(", "))),
    }
    let orders = timing.candidates.iter().enumerate().map(|(i, c)| {
        let verdict = if c.is_consistent {
            "consistent"
        } else {
            "excluded"
        };
        let text = format!(
            "{verdict}: χ² beyond the best {}, χ² per degree of freedom {}, row time {} µs",
            short(c.excess),
            short(c.chi2),
            short(c.row_time_us)
        );
        (format!("{} {}", i + 1, c.shutter.name()), text)
    });
    vec![
        ("Timing".into(), found),
        ("Readout orders".into(), orders.collect()),
    ]
}
