//! The keys that a TOML file may have. The reader checks a file by them, and its JSON Schema is made of them.

use serde_json::{Map, Value, json};

/// A table of the file.
pub(crate) struct Section {
    /// Name in brackets.
    pub name: &'static str,
    pub meaning: &'static str,
    pub keys: &'static [Key],
}

/// A key of a [`Section`].
pub(crate) struct Key {
    pub name: &'static str,
    pub kind: Kind,
    /// Whether the key stands wherever its table does.
    pub is_required: bool,
    pub meaning: &'static str,
}

/// The values that a key may have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Kind {
    /// A text.
    Text,
    /// The name of a file, relative to the folder of this one.
    File,
    /// One of these texts.
    Choice(&'static [&'static str]),
    /// A whole number from the first to the last.
    Count(usize, usize),
    /// A number above zero.
    Positive,
    /// A number from zero.
    NonNegative,
    /// The name of a file, or a list of whole numbers from 0.
    FileOrCounts,
    /// One of these texts, or a number above zero.
    ChoiceOrPositive(&'static [&'static str]),
}

impl Key {
    pub const fn optional(name: &'static str, kind: Kind, meaning: &'static str) -> Self {
        Self {
            name,
            kind,
            is_required: false,
            meaning,
        }
    }

    pub const fn required(name: &'static str, kind: Kind, meaning: &'static str) -> Self {
        Self {
            name,
            kind,
            is_required: true,
            meaning,
        }
    }
}

impl Kind {
    /// Whether the value may be a text.
    pub fn has_text(self) -> bool {
        !matches!(self, Self::Count(..) | Self::Positive | Self::NonNegative)
    }

    /// Whether the value may be a number with a fraction.
    pub fn has_number(self) -> bool {
        matches!(
            self,
            Self::Positive | Self::NonNegative | Self::ChoiceOrPositive(_)
        )
    }

    fn schema(self) -> Value {
        let positive = json!({ "type": "number", "exclusiveMinimum": 0 });
        let count = |least, most| json!({ "type": "integer", "minimum": least, "maximum": most });
        match self {
            Self::Text | Self::File => json!({ "type": "string" }),
            Self::Choice(names) => json!({ "enum": names }),
            Self::Count(least, most) => count(least, most),
            Self::Positive => positive,
            Self::NonNegative => json!({ "type": "number", "minimum": 0 }),
            Self::FileOrCounts => {
                let counts =
                    json!({ "type": "array", "items": { "type": "integer", "minimum": 0 } });
                json!({ "anyOf": [{ "type": "string" }, counts] })
            }
            Self::ChoiceOrPositive(names) => json!({ "anyOf": [{ "enum": names }, positive] }),
        }
    }
}

/// The JSON Schema of a file of `sections`, as text. Of those named in `repeated` a file may have several.
pub(crate) fn schema(
    title: &str,
    description: &str,
    sections: &[&Section],
    repeated: &[&str],
) -> String {
    let sections = sections.iter().map(|section| {
        let keys = section.keys.iter();
        let required: Vec<&str> = keys
            .clone()
            .filter(|key| key.is_required)
            .map(|key| key.name)
            .collect();
        let properties = keys.map(|key| {
            let mut schema = key.kind.schema();
            schema["description"] = key.meaning.into();
            (key.name.to_string(), schema)
        });
        let mut schema = json!({
            "type": "object",
            "description": section.meaning,
            "properties": properties.collect::<Map<_, _>>(),
            "additionalProperties": false,
        });
        if !required.is_empty() {
            schema["required"] = required.into();
        }
        if repeated.contains(&section.name) {
            schema = json!({ "type": "array", "items": schema });
        }
        (section.name.to_string(), schema)
    });
    let schema = json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "description": description,
        "type": "object",
        "properties": sections.collect::<Map<_, _>>(),
        "additionalProperties": false,
    });
    format!("{schema:#}\n")
}
