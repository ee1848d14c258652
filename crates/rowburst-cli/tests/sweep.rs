//! `--sweep` of one frame: a result for each point and one table.

mod common;

use common::Lab;
use serde_json::Value;

#[test]
fn points_are_compared_in_one_table() {
    let lab = Lab::new();
    let said = lab.done(
        "reconstruct experiment.toml --frame frame.npy --sweep prior=tv,l1 --sweep tau=auto,0.5 --max-iterations 20 --json -o out",
    );
    let rows: Value = serde_json::from_str(&said).unwrap();
    let rows = rows.as_array().unwrap();
    let points: Vec<&str> = rows.iter().map(|r| r["point"].as_str().unwrap()).collect();
    let all = [
        "prior=tv tau=auto",
        "prior=tv tau=0.5",
        "prior=l1 tau=auto",
        "prior=l1 tau=0.5",
    ];
    assert_eq!(points, all);
    assert_eq!(rows[1]["tau"], 0.5);
    // The same as a run of its own.
    lab.done("reconstruct experiment.toml --frame frame.npy --prior l1 --tau 0.5 --max-iterations 20 -o one");
    assert_eq!(
        lab.read("out/prior=l1_tau=0.5/video.npy"),
        lab.read("one/video.npy")
    );
    let table = String::from_utf8(lab.read("out/sweep.csv")).unwrap();
    assert_eq!(table.lines().count(), 5);
    assert!(table.starts_with("point,prior,tau,residual_over_sigma"));
}

#[test]
fn bad_values_and_options_are_refused_before_the_first_run() {
    let lab = Lab::new();
    let refused = lab.run(
        "reconstruct experiment.toml --frame frame.npy --sweep prior=tv,tvv --max-iterations 5 -o out",
    );
    assert_eq!(refused.status.code(), Some(2));
    let words = String::from_utf8(refused.stderr).unwrap();
    assert!(
        words.contains("--prior") && words.contains("tvv"),
        "{words}"
    );
    assert!(!lab.path("out").exists());
    let refused = lab
        .command("reconstruct experiment.toml --frame frame.npy --sweep seed=1,2 -o out2")
        .output()
        .unwrap();
    assert_eq!(refused.status.code(), Some(2));
    let words = String::from_utf8(refused.stderr).unwrap();
    assert!(
        words.contains("--sweep") && words.contains("noise-sigma"),
        "{words}"
    );
    assert!(!lab.path("out2").exists());
}

/// Values that no frame can make right are named before the first run.
#[test]
fn illegal_values_are_found_before_the_first_run() {
    let lab = Lab::new();
    for (sweep, words) in [
        ("tau=0.5,-1", "--tau"),
        ("noise-sigma=1,0", "--noise-sigma"),
    ] {
        let swept = lab.run(&format!(
            "reconstruct experiment.toml --frame frame.npy --prior tv --sweep {sweep} --max-iterations 5 -o out"
        ));
        let said = String::from_utf8(swept.stderr).unwrap();
        assert_eq!(swept.status.code(), Some(2), "{said}");
        assert!(
            said.contains(words) && said.contains("above zero"),
            "{said}"
        );
        assert!(!lab.path("out").exists());
    }
}

/// A point that fails does not stop the others, and the sweep is not done then.
#[test]
fn a_point_that_fails_is_an_exit_status() {
    let lab = Lab::new();
    let swept = lab.run(
        "reconstruct experiment.toml --frame frame.npy --prior tv --sweep tau=1e300,auto --max-iterations 5 --json -o out",
    );
    let words = String::from_utf8(swept.stderr).unwrap();
    assert_eq!(swept.status.code(), Some(1), "{words}");
    assert!(words.contains("1 of 2 points failed"), "{words}");
    let rows: Value = serde_json::from_slice(&swept.stdout).unwrap();
    assert!(rows[0]["error"].is_string() && rows[1]["error"].is_null());
    assert!(lab.path("out/tau=auto/video.npy").is_file());
    assert!(lab.path("out/sweep.csv").is_file());
}
