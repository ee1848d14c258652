//! `--sweep`: one run for each combination of values, and one table that compares them.

use crate::shared_args::ForceArgs;
use rowburst::error::{Phrase, Subject};
use rowburst::{Error, Result};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// The options that may be swept.
const KEYS: [&str; 4] = ["prior", "tau", "noise-sigma", "max-iterations"];
/// Most runs of a sweep: more are a mistake, or a job for a script.
const MAX_RUNS: usize = 1000;

/// A combination: an option and its value each.
pub type Point = Vec<(&'static str, String)>;

/// What a run of a point gave; `None` where it does not apply.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// The point, as `tau=0.1 prior=tv`.
    pub point: String,
    pub output: String,
    pub prior: Option<String>,
    pub tau: Option<f64>,
    pub residual_over_sigma: Option<f64>,
    pub psnr_db: Option<f64>,
    pub ssim: Option<f64>,
    /// Of one frame, or how many of all frames are good.
    pub fit: Option<String>,
    pub seconds: f64,
    /// Why there is nothing.
    pub error: Option<String>,
}

/// All combinations of `KEY=VALUE,VALUE,…`; the last option changes fastest.
pub fn points(texts: &[String]) -> Result<Vec<Point>> {
    let mut points: Vec<Point> = vec![Vec::new()];
    for text in texts {
        let wrong = |found: String, rule: Phrase| {
            let remedy = "Write --sweep tau=0.001,0.01 --sweep prior=tv,tv+l1.";
            Err(Error::input(Subject::named("--sweep"), found, rule, remedy))
        };
        let Some((name, values)) = text.split_once('=') else {
            return wrong(
                format!("\"{text}\""),
                "a sweep is OPTION=VALUE,VALUE,…".into(),
            );
        };
        let name = name.trim().trim_start_matches('-').replace('_', "-");
        let Some(&key) = KEYS.iter().find(|key| **key == name) else {
            let rule = format!("one of {} is swept", KEYS.join(", "));
            return wrong(format!("the option \"{name}\""), rule.into());
        };
        if points[0].iter().any(|(other, _)| *other == key) {
            return wrong(format!("{key} twice"), "each option is swept once".into());
        }
        let values: Vec<&str> = values.split(',').map(str::trim).collect();
        if values.iter().any(|value| value.is_empty()) {
            return wrong(format!("\"{text}\""), "each value has a text".into());
        }
        let with = |point: &Point, value: &&str| {
            let mut point = point.clone();
            point.push((key, value.to_string()));
            point
        };
        points = points
            .iter()
            .flat_map(|point| values.iter().map(move |value| with(point, value)))
            .collect();
        if points.len() > MAX_RUNS {
            let rule = format!("a sweep has at most {MAX_RUNS} runs");
            return wrong(format!("{} combinations", points.len()), rule.into());
        }
    }
    Ok(points)
}

/// A point in words.
pub fn label(point: &Point) -> String {
    let parts: Vec<String> = point.iter().map(|(k, v)| format!("{k}={v}")).collect();
    parts.join(" ")
}

/// Where the results of a point go: a folder of `output` that every file system can name.
pub fn point_path(output: &Path, point: &Point, end: &str) -> PathBuf {
    let safe = |c: char| match c {
        c if c.is_ascii_alphanumeric() || "=.+-".contains(c) => c,
        '*' => 'x',
        _ => '_',
    };
    let name: String = label(point).chars().map(safe).collect();
    output.join(name + end)
}

/// Reads the value of a swept option as a number.
pub fn parse_number<T: std::str::FromStr>(key: &str, value: &str) -> Result<T> {
    value.parse().map_err(|_| {
        Error::input(
            Subject::named(format!("--sweep {key}")),
            format!("\"{value}\""),
            "it is a number that the option takes",
            "Write it as for the option of the same name.",
        )
    })
}

/// The same for a number of iterations.
pub fn parse_count(key: &str, value: &str) -> Result<u32> {
    parse_number::<std::num::NonZeroU32>(key, value).map(std::num::NonZeroU32::get)
}

/// Writes `sweep.csv` into `output`, and says where.
pub fn write(output: &Path, force: ForceArgs, rows: &[Row]) -> Result<PathBuf> {
    let mut text =
        String::from("point,prior,tau,residual_over_sigma,psnr_db,ssim,fit,seconds,output,error\n");
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    let number = |value: Option<f64>| value.map_or(String::new(), |v| v.to_string());
    for row in rows {
        let text_cell = |value: &Option<String>| value.as_deref().map_or(String::new(), quoted);
        let cells = [
            quoted(&row.point),
            text_cell(&row.prior),
            number(row.tau),
            number(row.residual_over_sigma),
            number(row.psnr_db),
            number(row.ssim),
            text_cell(&row.fit),
            row.seconds.to_string(),
            quoted(&row.output),
            text_cell(&row.error),
        ];
        text += &(cells.join(",") + "\n");
    }
    force
        .claim(output, "sweep")?
        .write_bytes("sweep.csv", text.as_bytes())?;
    Ok(output.join("sweep.csv"))
}

/// The table for a person.
pub fn lines(rows: &[Row]) -> Vec<String> {
    let short = |value: Option<f64>| value.map_or("-".into(), rowburst_run::short);
    let mut table =
        vec![["point", "tau", "residual/σ", "PSNR dB", "fit", "seconds"].map(String::from)];
    table.extend(rows.iter().map(|row| {
        [
            row.point.clone(),
            short(row.tau),
            short(row.residual_over_sigma),
            row.psnr_db.map_or("-".into(), |v| format!("{v:.2}")),
            match &row.error {
                Some(error) => format!("failed: {error}"),
                None => row.fit.clone().unwrap_or_default(),
            },
            rowburst_run::short(row.seconds),
        ]
    }));
    let width = |column: usize| table.iter().map(|r| r[column].chars().count()).max();
    let widths: Vec<usize> = (0..4).map(|c| width(c).unwrap_or(0)).collect();
    let line = |row: &[String; 6]| {
        let padded: Vec<String> = widths
            .iter()
            .zip(row)
            .map(|(&w, cell)| format!("{cell:w$}"))
            .collect();
        format!("{}  {:>8}  {}", padded.join("  "), row[5], row[4])
    };
    table.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(texts: &[&str]) -> Result<Vec<Point>> {
        points(&texts.iter().map(|t| t.to_string()).collect::<Vec<_>>())
    }

    #[test]
    fn points_are_all_combinations() {
        let found = of(&["tau=0.1,auto", "prior=tv,tv+0.5*l1"]).unwrap();
        let all: Vec<String> = found.iter().map(label).collect();
        assert_eq!(
            all,
            [
                "tau=0.1 prior=tv",
                "tau=0.1 prior=tv+0.5*l1",
                "tau=auto prior=tv",
                "tau=auto prior=tv+0.5*l1"
            ]
        );
        let name = point_path("out".as_ref(), &found[1], ".zarr");
        assert_eq!(name, Path::new("out/tau=0.1_prior=tv+0.5xl1.zarr"));
        assert_eq!(of(&["noise_sigma=1"]).unwrap()[0][0].0, "noise-sigma");
    }

    #[test]
    fn invalid_sweeps_are_refused() {
        for (texts, words) in [
            (&["tau"][..], "OPTION=VALUE"),
            (&["seed=1,2"], "prior, tau"),
            (&["tau=1", "tau=2"], "twice"),
            (&["tau=1,,2"], "each value"),
        ] {
            let error = of(texts).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
