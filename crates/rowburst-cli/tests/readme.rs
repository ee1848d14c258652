//! The README's commands run, one after another, in one folder. Those of the site: `scripts/check_pages.py`.

use assert_cmd::Command;
use std::fs;
use std::path::Path;

/// Blocks of code that start with "```language", without their fences.
fn blocks<'a>(text: &'a str, language: &str) -> Vec<&'a str> {
    let open = format!("\n```{language}\n");
    text.split(&open)
        .skip(1)
        .map(|rest| rest.split("\n```").next().unwrap_or(rest))
        .collect()
}

/// The arguments of a line that runs Rowburst.
fn arguments(line: &str) -> Option<Vec<&str>> {
    ["rowburst ", "cargo run --release -- "]
        .iter()
        .find_map(|start| line.trim_start_matches("$ ").strip_prefix(start))
        .map(|rest| rest.split_whitespace().collect())
}

#[test]
fn commands_of_the_readme_run() {
    let readme = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../README.md");
    let text = fs::read_to_string(readme).unwrap().replace("\r\n", "\n");
    let folder = tempfile::tempdir().unwrap();
    let experiment = blocks(&text, "toml")[0];
    fs::write(folder.path().join("experiment.toml"), experiment).unwrap();
    let commands: Vec<Vec<&str>> = blocks(&text, "sh")
        .into_iter()
        .chain(blocks(&text, "console"))
        .flat_map(str::lines)
        .filter_map(arguments)
        .collect();
    for verb in ["demo", "simulate", "reconstruct"] {
        assert!(commands.iter().any(|c| c[0] == verb), "{verb} is shown");
    }
    for command in commands {
        eprintln!("rowburst {}", command.join(" "));
        Command::cargo_bin("rowburst")
            .unwrap()
            .current_dir(folder.path())
            .args(&command)
            .assert()
            .success();
        let named = command.iter().position(|&word| word == "-o");
        let output = folder
            .path()
            .join(named.map_or("rowburst-demo", |at| command[at + 1]));
        let last = if command[0] == "simulate" {
            "experiment.toml"
        } else {
            "result.json"
        };
        assert!(output.join(last).is_file(), "{last} of {command:?}");
    }
}
