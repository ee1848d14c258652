//! `--sweep`: one run for each combination of values, and one table that compares them.

use crate::shared_args::ForceArgs;
use rowburst::error::{Phrase, Subject};
use rowburst::{Error, Result};
use rowburst_run::{SweepPoint, SweepRow, sweep_csv};
use std::path::{Path, PathBuf};

/// The options that may be swept.
const KEYS: [&str; 4] = ["prior", "tau", "noise-sigma", "max-iterations"];
/// Most runs of a sweep: more are a mistake, or a job for a script.
const MAX_RUNS: usize = 1000;

/// All combinations of `KEY=VALUE,VALUE,…`; the last option changes fastest.
pub fn points(texts: &[String]) -> Result<Vec<SweepPoint>> {
    let mut points: Vec<SweepPoint> = vec![Vec::new()];
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
        let with = |point: &SweepPoint, value: &&str| {
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
pub fn write(output: &Path, force: ForceArgs, rows: &[SweepRow]) -> Result<PathBuf> {
    let text = sweep_csv(rows);
    let folder = force.claim(output, "sweep")?;
    folder.write_bytes("sweep.csv", text.as_bytes())?;
    Ok(output.join("sweep.csv"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rowburst_run::{sweep_label, sweep_path};

    fn of(texts: &[&str]) -> Result<Vec<SweepPoint>> {
        points(&texts.iter().map(|t| t.to_string()).collect::<Vec<_>>())
    }

    #[test]
    fn points_are_all_combinations() {
        let found = of(&["tau=0.1,auto", "prior=tv,tv+0.5*l1"]).unwrap();
        let all: Vec<String> = found.iter().map(sweep_label).collect();
        assert_eq!(
            all,
            [
                "tau=0.1 prior=tv",
                "tau=0.1 prior=tv+0.5*l1",
                "tau=auto prior=tv",
                "tau=auto prior=tv+0.5*l1"
            ]
        );
        let name = sweep_path("out".as_ref(), &sweep_label(&found[1]), ".zarr");
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
