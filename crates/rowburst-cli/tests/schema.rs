//! `rowburst schema`: what the program writes and reads follows the schemas that it prints.

mod common;

use common::{CAMERA, Lab};
use serde_json::{Value, json};

/// The schema of `file`, which is one itself.
fn schema(file: &str) -> Value {
    let schema = Lab::empty().done(&format!("schema {file}"));
    let schema: Value = serde_json::from_str(&schema).unwrap();
    jsonschema::meta::validate(&schema).unwrap();
    schema
}

/// Refuses keys that the schema does not name.
fn close(schema: &mut Value) {
    match schema {
        Value::Object(object) => {
            if object.contains_key("properties") {
                object.entry("additionalProperties").or_insert(json!(false));
            }
            object.values_mut().for_each(close);
        }
        Value::Array(values) => values.iter_mut().for_each(close),
        _ => {}
    }
}

/// The faults of `value`.
fn faults(schema: &Value, value: &Value) -> Vec<String> {
    let validator = jsonschema::validator_for(schema).unwrap();
    let faults = validator.iter_errors(value);
    faults
        .map(|fault| format!("{}: {fault}", fault.instance_path()))
        .collect()
}

#[test]
fn every_kind_of_result_follows_the_schema() {
    let lab = Lab::new();
    let files = "experiment.toml --frame frame.npy --prior tv --max-iterations 20";
    lab.done(&format!("reconstruct {files} --debias -o whole"));
    lab.done("reconstruct experiment.toml --frame frame.npy --self-calibrate on -o auto");
    lab.done(&format!("reconstruct {files} --part-bins 3 -o chunks"));
    lab.done("simulate experiment.toml --scene digits --digit-px 8 -o sim");
    lab.done("reconstruct sim/experiment.toml --frame sim/frame.npy --truth sim/truth.npy --prior tv -o truth");
    lab.experiment(&format!(
        "{CAMERA}bayer = \"grbg\"\n[calibration]\npsf = \"psf.npy\"\n"
    ));
    lab.done(&format!("reconstruct {files} -o colour"));
    let mut schema = schema("result");
    close(&mut schema);
    let one_kind = |definition: &str| {
        let mut kind = schema.clone();
        kind.as_object_mut().unwrap().remove("anyOf");
        kind["$ref"] = format!("#/$defs/{definition}").into();
        kind
    };
    for (folder, kind) in [
        ("whole", "ReconstructionSummary"),
        ("auto", "ReconstructionSummary"),
        ("truth", "ReconstructionSummary"),
        ("colour/green-1", "ReconstructionSummary"),
        ("chunks", "ChunkedSummary"),
        ("colour", "ColourSummary"),
    ] {
        let result = lab.read(&format!("{folder}/result.json"));
        let mut result: Value = serde_json::from_slice(&result).unwrap();
        let none: [String; 0] = [];
        assert_eq!(faults(&one_kind(kind), &result), none, "{folder}");
        assert_eq!(faults(&schema, &result), none, "{folder}");
        assert_eq!(result["schema_version"], 1);
        result["schema_version"] = 2.into();
        assert!(!faults(&schema, &result).is_empty());
    }
}

#[test]
fn experiment_files_follow_the_schema() {
    let schema = schema("experiment");
    let json = |text: &str| -> Value { toml::from_str(text).unwrap() };
    let lab = Lab::new();
    lab.done("init zyla-4.2 -o zyla.toml");
    lab.done("simulate experiment.toml --scene digits --digit-px 8 -o sim");
    for file in ["experiment.toml", "zyla.toml", "sim/experiment.toml"] {
        let text = String::from_utf8(lab.read(file)).unwrap();
        assert_eq!(faults(&schema, &json(&text)), [""; 0], "{file}");
    }
    // What the schema refuses, the program refuses too.
    for wrong in [
        "[camera]\nrowz = 12\n",
        "[camera]\nrows = \"12\"\n",
        "[camera]\nrows = 0\ncolumns = 10\nshutter = \"top-down\"\nrow_time_us = 9.6\nexposure_us = 9.6\n",
        "[camera]\nshutter = \"sideways\"\n",
        "[field]\nrows = 4\n",
        "[reconstruction]\ntau = 0\n",
        "[recording]\nframe_period_us = \"1\"\n",
        "[optics]\n",
    ] {
        assert!(!faults(&schema, &json(wrong)).is_empty(), "{wrong}");
        lab.experiment(wrong);
        let output = lab.run("reconstruct experiment.toml --frame frame.npy --psf psf.npy -o out");
        assert_eq!(output.status.code(), Some(2), "{wrong}");
    }
}
