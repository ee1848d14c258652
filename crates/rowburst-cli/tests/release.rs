//! Files of a release agree with the program's version.

use std::fs;
use std::path::Path;

fn read(name: &str) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let text = fs::read_to_string(root.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    text.replace("\r\n", "\n")
}

#[test]
fn the_citation_names_this_version() {
    let version = env!("CARGO_PKG_VERSION");
    let citation = read("CITATION.cff");
    let line = format!("version: {version}");
    assert!(citation.lines().any(|l| l == line), "{line} in\n{citation}");
    // What the release workflow compares the tag with.
    let manifest = format!("version = \"{version}\"");
    assert!(read("Cargo.toml").lines().any(|l| l == manifest));
}

#[test]
fn the_changelog_has_a_section_for_the_next_release() {
    let changelog = read("CHANGELOG.md");
    let sections: Vec<&str> = changelog.lines().filter(|l| l.starts_with("## ")).collect();
    let version = env!("CARGO_PKG_VERSION");
    assert!(
        sections[0].ends_with("unreleased") || sections[0].starts_with(&format!("## {version}")),
        "{sections:?}"
    );
    let shown = sections
        .iter()
        .any(|l| l.starts_with(&format!("## {version}")));
    assert!(shown, "{version} in {sections:?}");
}
