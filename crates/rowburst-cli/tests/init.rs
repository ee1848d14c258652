//! `rowburst init`: files that the program reads, each number with its source; and the command line for shells.

mod common;

use common::Lab;
use rowburst::Shutter;
use rowburst_io::Experiment;

/// Each camera with the rows of its sensor, or of [`OPEN`] where no source says them, and its shutter.
const CAMERAS: [(&str, usize, Shutter); 7] = [
    ("iris-9", 1000, Shutter::TopDown),
    ("orca-flash4.0-v3", 2048, Shutter::DualInsideOut),
    ("pco.edge-4.2", 2048, Shutter::DualOutsideIn),
    ("pco.edge-5.5", 2160, Shutter::DualOutsideIn),
    ("prime-bsi", 2048, Shutter::TopDown),
    ("zyla-4.2", 2048, Shutter::DualInsideOut),
    ("zyla-5.5", 2160, Shutter::DualInsideOut),
];

/// What a user fills in where no source says it.
const OPEN: [(&str, &str); 4] = [
    ("# rows =", "rows = 1000"),
    ("# columns =", "columns = 1000"),
    ("# row_time_us =", "row_time_us = 10"),
    ("# exposure_us =", "exposure_us = 10"),
];

#[test]
fn the_program_reads_each_file_once_its_open_lines_are_filled() {
    for (camera, rows, shutter) in CAMERAS {
        let lab = Lab::empty();
        assert_eq!(
            lab.done(&format!("init {camera}")).trim(),
            "experiment.toml"
        );
        let mut text = String::from_utf8(lab.read("experiment.toml")).unwrap();
        let path = lab.path("experiment.toml");
        // The first of the lines left open is what the program asks for; nothing else is wrong.
        for (open, filled) in OPEN {
            if let Some(line) = text.lines().find(|line| line.starts_with(open)) {
                let error = Experiment::read(&path).unwrap_err().to_string();
                assert!(error.contains("the key is required"), "{camera}: {error}");
                let line = line.to_string();
                assert!(
                    line.contains("rowburst calibrate timing") || line.contains("[yours]"),
                    "{camera}: {line}"
                );
                text = text.replace(&line, filled);
            }
        }
        lab.write("experiment.toml", &text);
        let experiment = Experiment::read(&path).unwrap_or_else(|e| panic!("{camera}: {e}"));
        experiment
            .camera()
            .unwrap_or_else(|e| panic!("{camera}: {e}"));
        assert_eq!(experiment.params.rows, rows, "{camera}");
        assert_eq!(experiment.params.shutter, shutter, "{camera}");
    }
}

#[test]
fn each_number_names_a_source_that_the_file_lists() {
    for (camera, ..) in CAMERAS {
        let lab = Lab::empty();
        lab.done(&format!("init {camera}"));
        let text = String::from_utf8(lab.read("experiment.toml")).unwrap();
        assert!(
            text.contains(&format!("`rowburst init {camera}`")),
            "{camera}"
        );
        let (head, keys) = text.split_once("[camera]").unwrap();
        let keys = keys.split("[calibration]").next().unwrap();
        for line in keys.lines().filter(|line| line.contains(" = ")) {
            if line.starts_with('#') {
                continue;
            }
            let (_, comment) = line.split_once("# [").unwrap_or_else(|| panic!("{line}"));
            let source = format!("[{}]", comment.split(']').next().unwrap());
            assert!(head.contains(&source), "{camera}: {line}");
        }
        // A line that is left open says how its number is found.
        for line in keys.lines().filter(|line| line.starts_with("# ")) {
            assert!(
                line.contains("measure it: rowburst calibrate") || line.contains("[yours]"),
                "{camera}: {line}"
            );
        }
    }
}

#[test]
fn an_unknown_camera_lists_the_known_ones() {
    let lab = Lab::empty();
    let output = lab.run("init Kodak");
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    for (camera, ..) in CAMERAS {
        assert!(said.contains(camera), "{camera} in {said}");
    }
    assert!(!lab.path("experiment.toml").exists());
    let help = lab.done("init --help");
    for (camera, ..) in CAMERAS {
        assert!(help.contains(camera), "{camera} in {help}");
    }
}

#[test]
fn a_file_that_exists_is_left_as_it_is() {
    let lab = Lab::empty();
    lab.write("experiment.toml", "mine");
    let output = lab.run("init zyla-4.2");
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("never replaced"));
    assert_eq!(lab.read("experiment.toml"), b"mine");
    lab.done("init zyla-4.2 -o new/other.toml");
    assert!(lab.path("new/other.toml").exists());
}

#[test]
fn each_shell_has_a_script_with_the_options() {
    let lab = Lab::empty();
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = lab.done(&format!("completions {shell}"));
        for word in ["reconstruct", "noise-sigma", "calibrate"] {
            assert!(script.contains(word), "{word} for {shell}");
        }
    }
    assert_eq!(lab.run("completions tcsh").status.code(), Some(2));
    // The shell itself takes the script, where there is one.
    lab.write("rowburst.bash", lab.done("completions bash"));
    let bash = std::process::Command::new("bash")
        .args(["-n", "rowburst.bash"])
        .current_dir(lab.path(""))
        .output();
    if let Ok(bash) = bash {
        assert!(
            bash.status.success(),
            "{}",
            String::from_utf8_lossy(&bash.stderr)
        );
    }
}

#[test]
fn each_verb_has_a_manual_page() {
    let lab = Lab::empty();
    assert_eq!(lab.done("man -o man1").trim(), "man1");
    for (page, words) in [
        ("rowburst.1", "rowburst\\-reconstruct(1)"),
        ("rowburst-reconstruct.1", "noise\\-sigma"),
        ("rowburst-calibrate-timing.1", "frequency\\-hz"),
        ("rowburst-init.1", "zyla\\-4.2"),
    ] {
        let text = String::from_utf8(lab.read(&format!("man1/{page}"))).unwrap();
        assert!(text.contains(words), "{words} in {page}:\n{text}");
    }
    // A page for each verb of the help and of calibrate.
    let verbs = |verb: &str| {
        let help = lab.done(&format!("{verb} --help"));
        let commands = help.split("Commands:").nth(1).unwrap();
        let lines = commands.lines().skip(1);
        let verbs = lines.take_while(|line| !line.is_empty());
        let name = |line: &str| line.split_whitespace().next().unwrap().to_string();
        verbs
            .map(name)
            .filter(|name| name != "help")
            .collect::<Vec<_>>()
    };
    for verb in verbs("") {
        assert!(
            lab.path(&format!("man1/rowburst-{verb}.1")).exists(),
            "{verb}"
        );
    }
    for verb in verbs("calibrate") {
        assert!(
            lab.path(&format!("man1/rowburst-calibrate-{verb}.1"))
                .exists(),
            "{verb}"
        );
    }
}
