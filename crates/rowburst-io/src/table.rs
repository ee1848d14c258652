//! A TOML table that is read key by key, with errors that name the line.

use crate::keys::{Key, Kind, Section};
use rowburst::camera::MAX_SIDE;
use rowburst::error::Subject;
use rowburst::{Error, ErrorKind, Parameter, Result};
use std::path::Path;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// One table of a file, by its name in brackets.
#[derive(Clone, Copy)]
pub(crate) struct Table<'a> {
    pub path: &'a Path,
    pub text: &'a str,
    /// Name in brackets; empty for the file itself.
    pub name: &'a str,
    /// `None` where the file does not have the table.
    pub entries: Option<&'a DeTable<'a>>,
    /// The keys that it may have; empty for the file itself.
    pub keys: &'static [Key],
}

impl<'a> Table<'a> {
    /// The error of a text that is not TOML.
    pub fn not_toml(path: &Path, text: &str, error: &toml::de::Error) -> Error {
        let line = error.span().map_or(1, |span| line_of(text, span.start));
        Error::input(
            Subject::in_file(path, format!("line {line}")),
            error.message().replace('\n', ", "),
            "the file must be valid TOML: key = value, text in quotes",
            "Correct this line.",
        )
    }

    /// Refuses keys that are not in `known`.
    pub fn check_keys(&self, known: &[&str]) -> Result<()> {
        let Some(entries) = self.entries else {
            return Ok(());
        };
        // In the order of the file, so that the first error is reported first.
        let unknown = entries
            .keys()
            .filter(|key| !known.contains(&key.get_ref().as_ref()));
        let Some(key) = unknown.min_by_key(|key| key.span().start) else {
            return Ok(());
        };
        let place = match self.name {
            "" => "the file".to_string(),
            name => format!("[{name}]"),
        };
        Err(Error::input(
            Subject::in_file(
                self.path,
                format!("line {}", line_of(self.text, key.span().start)),
            ),
            format!("the unknown key `{}` in {place}", key.get_ref()),
            format!("{place} has {}", known.join(", ")),
            format!("Did you mean `{}`?", nearest(key.get_ref(), known)),
        )
        .with_kind(ErrorKind::Unknown))
    }

    /// The table of `section` in this one. Other keys than those of the section are refused.
    pub fn table(&self, section: &'static Section) -> Result<Table<'a>> {
        let name = section.name;
        let entries = match self.value(name) {
            None => None,
            Some(value) => Some(value.get_ref().as_table().ok_or_else(|| {
                self.wrong_type(name, value, &format!("a table, written [{name}]"))
            })?),
        };
        let table = Table {
            name,
            entries,
            keys: section.keys,
            ..*self
        };
        let names: Vec<&str> = section.keys.iter().map(|key| key.name).collect();
        table.check_keys(&names)?;
        Ok(table)
    }

    /// The tables of `section`, of which the file may have several, written `[[name]]`.
    pub fn tables(&self, section: &'static Section) -> Result<Vec<Table<'a>>> {
        let Some(value) = self.value(section.name) else {
            return Ok(Vec::new());
        };
        let expected = format!("tables, each written [[{}]]", section.name);
        let wrong = || self.wrong_type(section.name, value, &expected);
        let list = value.get_ref().as_array().ok_or_else(wrong)?;
        let names: Vec<&str> = section.keys.iter().map(|key| key.name).collect();
        let tables = list.iter().map(|item| {
            let table = Table {
                name: section.name,
                entries: Some(item.get_ref().as_table().ok_or_else(wrong)?),
                keys: section.keys,
                ..*self
            };
            table.check_keys(&names)?;
            Ok(table)
        });
        tables.collect()
    }

    /// The kind of the values of `key`.
    fn kind(&self, key: &str) -> Kind {
        let known = self.keys.iter().find(|known| known.name == key);
        known.expect("only keys of the section are read").kind
    }

    pub fn text(&self, key: &str) -> Result<Option<&'a str>> {
        debug_assert!(self.kind(key).has_text(), "{key} is read as a text");
        let Some(value) = self.value(key) else {
            return Ok(None);
        };
        match value.get_ref().as_str() {
            Some(text) => Ok(Some(text)),
            None => Err(self.wrong_type(key, value, "text in quotes")),
        }
    }

    pub fn number(&self, key: &str) -> Result<Option<f64>> {
        debug_assert!(self.kind(key).has_number(), "{key} is read as a number");
        let Some(value) = self.value(key) else {
            return Ok(None);
        };
        let number = match value.get_ref() {
            DeValue::Float(float) => float.as_str().parse().ok(),
            DeValue::Integer(_) => whole(value).map(|n| n as f64),
            _ => None,
        };
        number
            .map(Some)
            .ok_or_else(|| self.wrong_type(key, value, "a number"))
    }

    pub fn count(&self, key: &str) -> Result<Option<usize>> {
        debug_assert!(
            matches!(self.kind(key), Kind::Count(..)),
            "{key} is read as a whole number"
        );
        let Some(value) = self.value(key) else {
            return Ok(None);
        };
        let number = whole(value).and_then(|n| usize::try_from(n).ok());
        number
            .map(Some)
            .ok_or_else(|| self.wrong_type(key, value, "a whole number from 0"))
    }

    /// The whole numbers from 0 of a list; `None` where the key is missing or holds a text.
    pub fn counts(&self, key: &str) -> Result<Option<Vec<usize>>> {
        debug_assert_eq!(
            self.kind(key),
            Kind::FileOrCounts,
            "{key} is read as a list"
        );
        let Some(value) = self.value(key).filter(|value| !value.get_ref().is_str()) else {
            return Ok(None);
        };
        let numbers = value.get_ref().as_array().and_then(|list| {
            let numbers = list.iter().map(|item| {
                let number = whole(item)?;
                usize::try_from(number).ok()
            });
            numbers.collect::<Option<Vec<usize>>>()
        });
        numbers.map(Some).ok_or_else(|| {
            self.wrong_type(
                key,
                value,
                "the name of a file in quotes, or a list of whole numbers from 0",
            )
        })
    }

    /// The length of a side of a sensor or a field, in pixels.
    pub fn side(&self, key: &str) -> Result<Option<usize>> {
        match self.count(key)? {
            Some(side) if side > MAX_SIDE => Err(self.error(
                key,
                side,
                &format!("a side has at most {MAX_SIDE} pixels"),
                "Give the size of the frame in pixels.",
            )),
            side => Ok(side),
        }
    }

    /// The value that a required key must have.
    pub fn required<T>(&self, key: &str, value: Option<T>) -> Result<T> {
        value.ok_or_else(|| {
            Error::input(
                self.subject(key, format!("[{}]", self.name)),
                format!("no `{key}`"),
                "the key is required",
                format!("Add a line `{key} = …` to [{}].", self.name),
            )
            .with_kind(ErrorKind::Missing)
        })
    }

    /// `key` at a place in this file.
    fn subject(&self, key: &str, place: String) -> Subject {
        let subject = Subject::in_file(self.path, place);
        let name = match self.name {
            "field" => format!("field_{key}"),
            _ => key.to_string(),
        };
        match Parameter::from_name(&name) {
            Some(parameter) => subject.of(parameter),
            None => subject,
        }
    }

    /// An error about the value of `key`.
    pub fn error(&self, key: &str, found: impl ToString, rule: &str, remedy: &str) -> Error {
        let line = self.value(key).map_or(String::new(), |value| {
            format!("line {}, ", line_of(self.text, value.span().start))
        });
        let subject = self.subject(key, format!("{line}[{}] {key}", self.name));
        Error::input(subject, found, rule.to_string(), remedy.to_string())
    }

    fn value(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.entries?.get(key)
    }

    fn wrong_type(&self, key: &str, value: &Spanned<DeValue>, expected: &str) -> Error {
        let found = match self.text.get(value.span()) {
            Some(text) if !text.contains('\n') => format!("{} {text}", value.get_ref().type_str()),
            _ => value.get_ref().type_str().to_string(),
        };
        self.error(
            key,
            found,
            &format!("the value is {expected}"),
            "Correct this line.",
        )
    }
}

fn whole(value: &Spanned<DeValue>) -> Option<i64> {
    let integer = value.get_ref().as_integer()?;
    i64::from_str_radix(integer.as_str(), integer.radix()).ok()
}

fn line_of(text: &str, at: usize) -> usize {
    1 + text.bytes().take(at).filter(|&b| b == b'\n').count()
}

/// The name in `known` that takes the fewest changes to reach.
pub(crate) fn nearest<'a>(name: &str, known: &[&'a str]) -> &'a str {
    let distance = |known: &&&str| strsim::damerau_levenshtein(name, known);
    known
        .iter()
        .min_by_key(distance)
        .copied()
        .unwrap_or_default()
}
