//! `--verbose`: every step with its time, on standard error; nothing without it.

mod common;

use common::Lab;

#[test]
fn verbose_logs_every_step_with_its_time() {
    let lab = Lab::empty();
    // Large enough for pixels that are held out.
    lab.experiment(
        "[camera]\nrows = 40\ncolumns = 36\nshutter = \"dual-inside-out\"\nrow_time_us = 10\nexposure_us = 10\n",
    );
    lab.done("simulate experiment.toml --scene digits --digit-px 8 -o sim");
    let reconstruct = "reconstruct sim/experiment.toml --frame sim/frame.npy --self-calibrate on";
    let quiet = lab.run(&format!("{reconstruct} -o quiet"));
    assert_eq!(String::from_utf8_lossy(&quiet.stderr), "");
    let verbose = lab.run(&format!("--verbose {reconstruct} -o verbose"));
    assert!(verbose.status.success());
    let log = String::from_utf8(verbose.stderr).unwrap();
    let mut last = 0.0;
    for line in log.lines() {
        let (seconds, text) = line.split_once(" s  ").expect(line);
        let seconds: f64 = seconds.trim().parse().expect(line);
        assert!(seconds >= last && !text.is_empty(), "{line}");
        last = seconds;
    }
    // In this order, with paths as on this system.
    let log = log.replace(std::path::MAIN_SEPARATOR, "/");
    let mut rest = log.as_str();
    for step in [
        "instruction set",
        "threads",
        "of memory available",
        "read sim/frame.npy: 40×36 pixels",
        "corrected the frame",
        "set up the operator",
        "set up a frame",
        "check of the model",
        "self-calibration",
        "tried prior tv+2*tdiff+support",
        "final run: prior",
        "the fit is",
        "wrote verbose/video.npy, ",
        "wrote verbose/result.json, ",
    ] {
        let at = rest.find(step);
        let at = at.unwrap_or_else(|| panic!("no \"{step}\" after the steps before it in\n{log}"));
        rest = &rest[at + step.len()..];
    }
    let videos = ["quiet", "verbose"].map(|out| lab.read(&format!("{out}/video.npy")));
    assert!(videos[0] == videos[1]);
}
