//! A paragraph on the methods of a run, with its numbers, and BibTeX of program and methods.

use crate::format::short;
use crate::numbers::thousands;
use rowburst::error::Tool;
use rowburst::{Error, Result, phrase};
use serde_json::Value;
use std::path::Path;

/// An entry of BibTeX, and the part of a prior's name that asks for it; no part: it is always cited.
struct Entry {
    key: &'static str,
    part: Option<&'static str>,
    text: &'static str,
}

const WEINBERG: &str = "@article{weinberg2020,
  author  = {Weinberg, G. and Katz, O.},
  title   = {100,000 frames-per-second compressive imaging with a conventional rolling-shutter camera by random point-spread-function engineering},
  journal = {Optics Express},
  volume  = {28},
  pages   = {30616},
  year    = {2020}
}";
const BOYD: &str = "@article{boyd2011,
  author  = {Boyd, S. and Parikh, N. and Chu, E. and Peleato, B. and Eckstein, J.},
  title   = {Distributed optimization and statistical learning via the alternating direction method of multipliers},
  journal = {Foundations and Trends in Machine Learning},
  volume  = {3},
  number  = {1},
  pages   = {1--122},
  year    = {2011}
}";
const MOROZOV: &str = "@article{morozov1966,
  author  = {Morozov, V. A.},
  title   = {On the solution of functional equations by the method of regularization},
  journal = {Soviet Mathematics Doklady},
  volume  = {7},
  pages   = {414--417},
  year    = {1966}
}";
const RUDIN: &str = "@article{rudin1992,
  author  = {Rudin, L. I. and Osher, S. and Fatemi, E.},
  title   = {Nonlinear total variation based noise removal algorithms},
  journal = {Physica D},
  volume  = {60},
  pages   = {259--268},
  year    = {1992}
}";
const CHEN: &str = "@article{chen1998,
  author  = {Chen, S. S. and Donoho, D. L. and Saunders, M. A.},
  title   = {Atomic decomposition by basis pursuit},
  journal = {SIAM Journal on Scientific Computing},
  volume  = {20},
  pages   = {33--61},
  year    = {1998}
}";
const MALLAT: &str = "@article{mallat1989,
  author  = {Mallat, S. G.},
  title   = {A theory for multiresolution signal decomposition: the wavelet representation},
  journal = {IEEE Transactions on Pattern Analysis and Machine Intelligence},
  volume  = {11},
  pages   = {674--693},
  year    = {1989}
}";
const YUAN: &str = "@article{yuan2006,
  author  = {Yuan, M. and Lin, Y.},
  title   = {Model selection and estimation in regression with grouped variables},
  journal = {Journal of the Royal Statistical Society B},
  volume  = {68},
  pages   = {49--67},
  year    = {2006}
}";
const CAI: &str = "@article{cai2010,
  author  = {Cai, J.-F. and Cand{\\`e}s, E. J. and Shen, Z.},
  title   = {A singular value thresholding algorithm for matrix completion},
  journal = {SIAM Journal on Optimization},
  volume  = {20},
  pages   = {1956--1982},
  year    = {2010}
}";

const ENTRIES: [Entry; 7] = [
    Entry::of(None, "weinberg2020", WEINBERG),
    Entry::of(None, "boyd2011", BOYD),
    Entry::of(Some("tv"), "rudin1992", RUDIN),
    Entry::of(Some("l1"), "chen1998", CHEN),
    Entry::of(Some("wavelet"), "mallat1989", MALLAT),
    Entry::of(Some("group"), "yuan2006", YUAN),
    Entry::of(Some("lowrank"), "cai2010", CAI),
];

impl Entry {
    const fn of(part: Option<&'static str>, key: &'static str, text: &'static str) -> Self {
        Self { key, part, text }
    }
}

/// The methods of the result in `folder`: a paragraph with the numbers of the run, and the BibTeX of what it cites.
///
/// # Errors
/// A folder without a whole result of one video.
pub fn cite(folder: &Path) -> Result<String> {
    let path = folder.join("result.json");
    let bad = |found: String| {
        Error::input(
            &path,
            found,
            "a methods paragraph is made of the numbers of a whole result",
            phrase!["Run ", Tool::Reconstruct, ", and give its folder."],
        )
    };
    let text = std::fs::read(&path).map_err(|e| bad(e.to_string()))?;
    let result: Value = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
    if !result["prior"].is_string() || !result["noise_sigma"].is_number() {
        return Err(bad("no prior and no noise level of one video".into()));
    }
    Ok(citation(&result))
}

fn citation(result: &Value) -> String {
    let prior = result["prior"].as_str().unwrap_or_default();
    let rule = result["tau_rule"].as_str().unwrap_or_default();
    let version = result["version"].as_str().unwrap_or_default();
    let is_asked = |entry: &&Entry| {
        entry.part.is_none_or(|part| {
            prior.split('+').any(|term| {
                term.trim_start_matches(|c: char| c.is_ascii_digit() || ".*e-".contains(c))
                    .starts_with(part)
            })
        })
    };
    let mut entries: Vec<(&str, &str)> = ENTRIES
        .iter()
        .filter(is_asked)
        .filter(|entry| entry.key != "boyd2011" || !has_guide(result))
        .map(|entry| (entry.key, entry.text))
        .collect();
    if rule.contains("discrepancy") {
        entries.push(("morozov1966", MOROZOV));
    }
    let program = format!(
        "@software{{rowburst,\n  author  = {{The Rowburst developers}},\n  title   = {{Rowburst}},\n  version = {{{version}}},\n  url     = {{https://github.com/rowburst/rowburst}},\n  year    = {{{}}}\n}}",
        year(result)
    );
    let mut text = paragraph(result, &entries);
    text += "\n\n";
    text += &program;
    for (_, entry) in entries {
        text += "\n\n";
        text += entry;
    }
    text
}

/// The year of the run; that of the paper's method where it is not known.
fn year(result: &Value) -> &str {
    let date = result["run"]["date"].as_str().unwrap_or_default();
    date.get(..4).unwrap_or("n.d.")
}

fn paragraph(result: &Value, entries: &[(&str, &str)]) -> String {
    let number = |key: &str| result[key].as_f64().unwrap_or(f64::NAN);
    let words = |key: &str| result[key].as_str().unwrap_or_default();
    let cited = |key: &str| {
        let is_cited = entries.iter().any(|(name, _)| *name == key);
        if is_cited {
            format!(" \\cite{{{key}}}")
        } else {
            String::new()
        }
    };
    let camera = &result["run"]["camera"];
    let shutter = match (camera["shutter"].as_str(), camera["row_time_us"].as_f64()) {
        (Some(shutter), Some(row_time)) => format!(
            " ({shutter} shutter, {} µs per row, exposure {} µs)",
            short(row_time),
            short(camera["exposure_us"].as_f64().unwrap_or(f64::NAN))
        ),
        _ => String::new(),
    };
    let mut text = format!(
        "Videos of {} frames of {}×{} pixels at {} frames per second were reconstructed from single rolling-shutter frames{shutter} recorded through a diffuser{}, with Rowburst {} \\cite{{rowburst}}.",
        number("frames"),
        number("rows"),
        number("columns"),
        thousands(number("frame_rate_hz")),
        cited("weinberg2020"),
        words("version"),
    );
    text += &if has_guide(result) {
        guide_sentences(result)
    } else {
        solver_sentences(result, &cited)
    };
    text += &format!(
        " The noise was σ = {} counts ({}), and the residual of the fit {} σ (verdict: {}).",
        short(number("noise_sigma")),
        words("noise_sigma_source"),
        short(number("residual_over_sigma")),
        words("fit"),
    );
    let calibration = &result["self_calibration"];
    let error = |name: &str| calibration[name].as_f64().map(short);
    if let (Some(before), Some(after)) = (error("held_out_before"), error("held_out_after")) {
        text += &format!(
            " Point-spread function and camera were corrected by the frame itself; the error at held-out pixels fell from {before} σ to {after} σ."
        );
    } else if calibration.is_object() {
        text += " The even light in the dark part of the captured point-spread function was taken away from all of it.";
    }
    text
}

/// Whether the video is that of a guide, which no solver and no prior have made.
fn has_guide(result: &Value) -> bool {
    result["guide"]["used"] == true
}

/// How a picture of a second camera gave the video.
fn guide_sentences(result: &Value) -> String {
    let guide = &result["guide"];
    let number = |key: &str| short(guide[key].as_f64().unwrap_or(f64::NAN));
    let change = match guide["model"].as_str().unwrap_or_default() {
        "motion" => "a smooth displacement field with a few temporal modes",
        "gain" => "a gain field with a few temporal modes",
        "places" => "a trace of brightness for each place that it shows",
        _ => "a constant gain and offset",
    };
    format!(
        " Each is the picture of a second camera, registered to the frame by an affine map, with {change} fitted to the frame by least squares. At held-out pixels the error was {} σ, and {} σ without the picture.",
        number("held_out"),
        number("held_out_without"),
    )
}

/// How the solver found the video, with the citations of `cited`.
fn solver_sentences(result: &Value, cited: &dyn Fn(&str) -> String) -> String {
    let words = |key: &str| result[key].as_str().unwrap_or_default();
    let methods: Vec<String> = ["rudin1992", "chen1998", "mallat1989", "yuan2006", "cai2010"]
        .iter()
        .map(|key| cited(key))
        .collect();
    let iterations = result["iterations"].as_u64();
    let tau = result["tau"].as_f64();
    format!(
        " The video v minimises ½‖W(b − Av)‖² + τR(v) with v ≥ 0, by ADMM{} ({} iterations, {}), where b is the frame, A the convolution with the measured point-spread function and the exposure of each row, and R is {}{}. The weight τ{} was set by the {}{}.",
        cited("boyd2011"),
        iterations.map_or("several".into(), |n| n.to_string()),
        result["stop_reason"].as_str().unwrap_or("in chunks"),
        words("prior"),
        methods.concat(),
        tau.map_or(String::new(), |tau| format!(" = {}", short(tau))),
        words("tau_rule").replace("given", "user"),
        cited("morozov1966"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_and_methods_of_the_run_are_named() {
        let result = json!({
            "version": "0.1.0", "prior": "tv+0.5*l1", "tau": 0.25, "tau_rule": "discrepancy principle",
            "noise_sigma": 3.5, "noise_sigma_source": "given", "residual_over_sigma": 1.0, "fit": "good",
            "frames": 54, "rows": 108, "columns": 100, "frame_rate_hz": 104_166.7, "iterations": 120,
            "stop_reason": "converged", "run": { "date": "2026-11-24T13:45:18Z",
                "camera": { "shutter": "top-down", "row_time_us": 9.6, "exposure_us": 9.6 } },
        });
        let text = citation(&result);
        for words in [
            "54 frames of 108×100",
            "104,167 frames",
            "120 iterations",
            "τ = 0.2500",
            "σ = 3.500 counts",
            "top-down shutter",
            "@article{rudin1992",
            "@article{chen1998",
            "@article{morozov1966",
            "year    = {2026}",
        ] {
            assert!(text.contains(words), "{words}: {text}");
        }
        assert!(
            !text.contains("mallat1989") && !text.contains("NaN"),
            "{text}"
        );
        let keys = text.matches("\\cite{").count();
        assert_eq!(keys, text.matches("\n@").count());

        let mut guided = result;
        guided["prior"] = "guide motion".into();
        guided["tau_rule"] = "none: the video is that of a guide".into();
        guided["guide"] =
            json!({ "used": true, "model": "motion", "held_out": 0.98, "held_out_without": 1.03 });
        let text = citation(&guided);
        assert!(text.contains("a smooth displacement field"), "{text}");
        assert!(
            !text.contains("ADMM") && !text.contains("boyd2011"),
            "{text}"
        );
        let keys = text.matches("\\cite{").count();
        assert_eq!(keys, text.matches("\n@").count());
    }
}
