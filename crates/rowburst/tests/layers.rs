//! Checks the layers of the library: an import goes to the same or a lower layer (see ARCHITECTURE.md).

use std::path::{Path, PathBuf};

/// A module at the top of the crate, with its layer and permitted imports.
struct Module {
    name: &'static str,
    layer: usize,
    /// Modules of the same or a lower layer; a module may always import itself and layer 0.
    uses: &'static [&'static str],
}

const fn module(name: &'static str, layer: usize, uses: &'static [&'static str]) -> Module {
    Module { name, layer, uses }
}

const MODULES: [Module; 27] = [
    module("cancel", 0, &[]),
    module("error", 0, &[]),
    module("fft2", 0, &[]),
    module("shape", 0, &[]),
    module("vecmath", 0, &[]),
    // Values know no operators.
    module("image", 1, &[]),
    module("video", 1, &["image"]),
    module("psf", 1, &["image"]),
    module("shutter", 1, &[]),
    module("camera", 1, &["shutter"]),
    module("patches", 1, &["psf"]),
    module("support", 1, &[]),
    // Maths knows no optics.
    module("linop", 1, &[]),
    module("prox", 1, &["linop", "support"]),
    module("measurement", 2, &["image", "camera"]),
    module(
        "forward",
        2,
        &[
            "image", "psf", "patches", "shutter", "camera", "linop", "support",
        ],
    ),
    module(
        "calibrate",
        2,
        &["image", "psf", "patches", "shutter", "camera"],
    ),
    module(
        "bayer",
        2,
        &["image", "psf", "patches", "shutter", "camera"],
    ),
    // Noise is never inside A.
    module("noise", 2, &["image", "camera"]),
    module(
        "simulate",
        2,
        &["image", "video", "psf", "shutter", "camera"],
    ),
    module("metrics", 2, &["image", "video"]),
    // The solver knows neither what a pixel is nor where it comes from.
    module("solve", 2, &["linop", "prox", "support"]),
    // With `traces` the only modules where physics meets the solver.
    module(
        "reconstruct",
        3,
        &[
            "image",
            "video",
            "psf",
            "shutter",
            "camera",
            "linop",
            "prox",
            "measurement",
            "forward",
            "metrics",
            "solve",
            "patches",
            "support",
            "guide",
        ],
    ),
    // What a frame says of the changes of a picture by a second camera.
    module(
        "guide",
        3,
        &[
            "image",
            "video",
            "camera",
            "linop",
            "measurement",
            "forward",
            "metrics",
            "patches",
            "shutter",
        ],
    ),
    // What a finished video says of a place, with errors.
    module(
        "traces",
        3,
        &["image", "video", "forward", "solve", "support"],
    ),
    // Runs simulations and reconstructions of what a user plans to build.
    module(
        "design",
        4,
        &[
            "image",
            "video",
            "psf",
            "shutter",
            "camera",
            "linop",
            "measurement",
            "forward",
            "noise",
            "simulate",
            "metrics",
            "reconstruct",
        ],
    ),
    module("lib", 5, &[]),
];

/// What is re-exported at the crate's root, and where it lives.
const ROOT: [(&str, &str); 22] = [
    ("Camera", "camera"),
    ("Sensor", "camera"),
    ("Cancel", "cancel"),
    ("Error", "error"),
    ("ErrorKind", "error"),
    ("Parameter", "error"),
    ("phrase", "error"),
    ("Result", "error"),
    ("RollingShutter", "forward"),
    ("LinearOperator", "linop"),
    ("Measurement", "measurement"),
    ("Corrections", "measurement"),
    ("RawFrame", "measurement"),
    ("Image", "image"),
    ("PatchSet", "patches"),
    ("Psf", "psf"),
    ("Support", "support"),
    ("Shape", "shape"),
    ("TimeGrid", "shape"),
    ("Shutter", "shutter"),
    ("Video", "video"),
    ("CameraParams", "camera"),
];

#[test]
fn imports_only_go_to_lower_layers() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut faults = Vec::new();
    for path in files(&source) {
        let name = module_of(path.strip_prefix(&source).unwrap());
        let Some(module) = MODULES.iter().find(|module| module.name == name) else {
            faults.push(format!(
                "{}: add the module {name} to MODULES",
                path.display()
            ));
            continue;
        };
        if module.name == "lib" {
            continue;
        }
        let text = std::fs::read_to_string(&path).unwrap();
        for import in imports(&text) {
            if let Err(why) = judge(module, &import) {
                faults.push(format!("{}: crate::{import}: {why}", path.display()));
            }
        }
    }
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

/// Whether `module` may import `crate::import`.
fn judge(module: &Module, import: &str) -> Result<(), String> {
    let head = import.split("::").next().unwrap_or_default();
    let name = ROOT
        .iter()
        .find(|(item, _)| *item == head)
        .map_or(head, |(_, home)| home);
    let Some(other) = MODULES.iter().find(|other| other.name == name) else {
        return Err("no module has this name; add it to MODULES or ROOT".into());
    };
    if other.layer > module.layer {
        return Err(format!(
            "{} (layer {}) is above {} (layer {})",
            other.name, other.layer, module.name, module.layer
        ));
    }
    let known = other.name == module.name || other.layer == 0 || module.uses.contains(&other.name);
    if !known {
        return Err(format!("{} does not know {}", module.name, other.name));
    }
    Ok(())
}

/// The module of a source file: its first folder or its name.
fn module_of(path: &Path) -> String {
    let first = path.iter().next().unwrap().to_string_lossy();
    first.trim_end_matches(".rs").to_string()
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else if path.extension().is_some_and(|end| end == "rs") && !path.ends_with("tests.rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Every path after `crate::` in code before the tests, braces of an import opened.
///
/// Tests may import anything.
fn imports(text: &str) -> Vec<String> {
    let code: String = text
        .lines()
        .take_while(|line| line.trim() != "#[cfg(test)]" || line.starts_with(' '))
        .map(|line| line.split("//").next().unwrap_or_default())
        .collect::<Vec<_>>()
        .join(" ");
    let mut paths = Vec::new();
    for rest in code.split("crate::").skip(1) {
        // `pub(in crate::…)` and `$crate::…` do not occur; a tree ends with its brace.
        let mut depth = 0usize;
        let end = rest.find(|c: char| match c {
            '{' => {
                depth += 1;
                false
            }
            '}' if depth > 0 => {
                depth -= 1;
                false
            }
            ',' | ' ' if depth > 0 => false,
            c => !(c.is_alphanumeric() || c == '_' || c == ':'),
        });
        open(&rest[..end.unwrap_or(rest.len())], "", &mut paths);
    }
    paths
}

/// Opens the braces of `tree`: `a::{b, c::d}` becomes `a::b` and `a::c::d`.
fn open(tree: &str, prefix: &str, paths: &mut Vec<String>) {
    let tree = tree.trim();
    let Some((head, branches)) = tree.split_once('{') else {
        if !tree.is_empty() {
            let name = tree.split(" as ").next().unwrap_or(tree).trim();
            paths.push(format!("{prefix}{}", name.trim_end_matches("::")));
        }
        return;
    };
    let prefix = format!("{prefix}{}", head.trim());
    let branches = branches.strip_suffix('}').unwrap_or(branches);
    let (mut depth, mut start) = (0usize, 0);
    for (at, c) in branches.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth = depth.saturating_sub(1),
            ',' if depth == 0 => {
                open(&branches[start..at], &prefix, paths);
                start = at + 1;
            }
            _ => {}
        }
    }
    open(&branches[start..], &prefix, paths);
}

#[test]
fn imports_are_found() {
    let text = "use crate::{Error, solve::{DataTerm, admm::{self, Progress}}};\n\
                use crate::vecmath::simd;\n\
                // crate::forward is only spoken of\n\
                fn f() { crate::metrics::psnr_db(a, b); }\n\
                #[cfg(test)]\nmod tests { use crate::camera::Camera; }\n";
    assert_eq!(
        imports(text),
        [
            "Error",
            "solve::DataTerm",
            "solve::admm::self",
            "solve::admm::Progress",
            "vecmath::simd",
            "metrics::psnr_db",
        ]
    );
    let solve = MODULES
        .iter()
        .find(|module| module.name == "solve")
        .unwrap();
    assert!(judge(solve, "vecmath::simd").is_ok());
    assert!(judge(solve, "prox::Prox").is_ok());
    for optics in [
        "Psf",
        "Shutter",
        "camera::Camera",
        "forward::Engine",
        "RollingShutter",
    ] {
        assert!(judge(solve, optics).is_err(), "{optics}");
    }
    let prox = MODULES.iter().find(|module| module.name == "prox").unwrap();
    for optics in ["Psf", "Camera", "forward", "solve::admm"] {
        assert!(judge(prox, optics).is_err(), "{optics}");
    }
}
