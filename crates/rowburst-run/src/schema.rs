//! The JSON Schema of `result.json`.

/// The version of the keys of `result.json`, its `schema_version`. It is raised where a key is removed or gets another
/// meaning or type; a new key does not raise it.
pub const RESULT_SCHEMA_VERSION: u32 = 1;

/// The JSON Schema of `result.json`: of one video, of one in chunks, and of one in colour.
pub const RESULT_SCHEMA: &str = include_str!("../schema/result.schema.json");

#[cfg(test)]
mod tests {
    use crate::{ChunkedSummary, ColourSummary, ReconstructionSummary};
    use schemars::generate::SchemaSettings;
    use schemars::transform::{RecursiveTransform, Transform};
    use schemars::{JsonSchema, Schema};
    use serde_json::json;

    /// A `result.json`.
    #[derive(JsonSchema)]
    #[schemars(untagged)]
    #[expect(dead_code, reason = "only its schema is used")]
    enum ResultFile {
        /// `reconstruct` and `demo`: one video.
        Video(Box<ReconstructionSummary>),
        /// `reconstruct --part-bins`: a video that was reconstructed in chunks.
        Chunks(ChunkedSummary),
        /// `reconstruct` of a raw Bayer frame: a video in colour, of four planes.
        Colour(ColourSummary),
    }

    /// Puts a comment on one line, names no format that only Rust knows, and lets every number be null: JSON has no
    /// other way to say that a number is not finite.
    fn tidy(schema: &mut Schema) {
        let Some(object) = schema.as_object_mut() else {
            return;
        };
        object.remove("format");
        if object.get("type") == Some(&json!("number")) {
            object.insert("type".into(), json!(["number", "null"]));
        }
        if let Some(text) = object.get("description").and_then(|d| d.as_str()) {
            let text = text.replace('\n', " ").replace('`', "");
            object.insert("description".into(), text.into());
        }
    }

    fn generated() -> String {
        let generator = SchemaSettings::draft2020_12()
            .for_serialize()
            .into_generator();
        let mut schema = generator.into_root_schema_for::<ResultFile>();
        RecursiveTransform(tidy).transform(&mut schema);
        schema.insert("title".into(), "Rowburst result.json".into());
        schema.insert(
            "description".into(),
            "The numbers of a reconstruction. New versions add keys; schema_version is raised where a key is removed or gets another meaning.".into(),
        );
        let object = schema.to_value();
        format!("{object:#}\n")
    }

    /// `UPDATE_SCHEMA=1` renews the file.
    #[test]
    fn the_committed_schema_is_that_of_the_types() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/schema/result.schema.json");
        let schema = generated();
        if std::env::var_os("UPDATE_SCHEMA").is_some() {
            std::fs::write(path, &schema).unwrap();
        }
        // The order of keys differs between features of serde_json.
        let value = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
        let committed = std::fs::read_to_string(path).unwrap();
        assert_eq!(value(&committed), value(&schema));
    }
}
