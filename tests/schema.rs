//! The JSON Schemas in docs/, for editors and for the pages of keys in the book: unit tests of the
//! crates that read the keys make them from the types, each its part, and say when a file is old.
//! `schemars` is a dependency of these tests alone, so that no program has it, whatever features
//! others turn on. (This file is a module of each of these crates.)

use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};
use std::string::{String, ToString};
use std::vec::Vec;
use std::{format, fs};

/// How the files, and the pages that follow from them, are written.
const WRITE: &str = "PROPRIO_WRITE_REFERENCE=1 cargo test -p proprio-drivers -p proprio-gateway \
                     -p proprio-estimator -p proprio-tests --lib --test reference reference";

/// The schema of a type, with everything in its place: editors that complete keys do not follow
/// all references.
pub(crate) fn of<T: schemars::JsonSchema>() -> Value {
    let mut settings = SchemaSettings::draft07();
    settings.inline_subschemas = true;
    let schema = settings.into_generator().into_root_schema_for::<T>();
    let mut value = schema.to_value();
    plain(&mut value);
    value
}

/// Checks docs/`file`, or writes it: `make` gets what it holds, and returns what it should hold.
pub(crate) fn check(file: &str, make: impl FnOnce(&Value) -> Value) {
    let path = format!("{}/../docs/{file}", env!("CARGO_MANIFEST_DIR"));
    let committed = fs::read_to_string(&path).unwrap_or_default();
    let old = serde_json::from_str(&committed).unwrap_or_else(|_| json!({}));
    let made = serde_json::to_string_pretty(&make(&old)).expect("JSON") + "\n";
    if std::env::var_os("PROPRIO_WRITE_REFERENCE").is_some() {
        fs::write(&path, made).expect("the schema can be written");
        return;
    }
    assert!(committed == made, "docs/{file} is old. Twice: {WRITE}");
}

/// TOML has no null, keys have no Rust types, and a description is one paragraph of plain text.
fn plain(value: &mut Value) {
    if let Value::Array(list) = value {
        list.iter_mut().for_each(plain);
    }
    let Value::Object(object) = value else { return };
    object.remove("format");
    if object.get("default").is_some_and(Value::is_null) {
        object.remove("default");
    }
    for key in ["type", "enum", "anyOf"] {
        let Some(Value::Array(list)) = object.get_mut(key) else {
            continue;
        };
        list.retain(|one| !one.is_null() && *one != "null" && *one != json!({ "type": "null" }));
        let only = match list.as_slice() {
            [only] if key != "enum" => only.clone(),
            _ => continue,
        };
        match only {
            Value::Object(only) => {
                object.remove(key);
                only.into_iter().for_each(|(key, value)| {
                    object.entry(key).or_insert(value);
                });
            }
            only => {
                object.insert(key.to_string(), only);
            }
        }
    }
    if let Some(Value::String(text)) = object.get_mut("description") {
        *text = without_links(text);
    }
    object.values_mut().for_each(plain);
}

/// A comment as people read it who have no source: links to code are names, or left out where they
/// are in parentheses; units are in brackets.
fn without_links(comment: &str) -> String {
    let line: Vec<&str> = comment.split_whitespace().collect();
    let line = line.join(" ").replace("\\[", "[").replace("\\]", "]");
    let mut text = String::new();
    let mut rest = line.as_str();
    while let Some((before, after)) = rest.split_once("[`") {
        let (path, after) = after.split_once("`]").unwrap_or((after, ""));
        let name = path.rsplit("::").next().unwrap_or(path);
        match (before.strip_suffix(" ("), after.strip_prefix(')')) {
            (Some(before), Some(after)) => {
                text.push_str(before);
                rest = after;
            }
            _ => {
                text.push_str(&format!("{before}`{name}`"));
                rest = after;
            }
        }
    }
    text + rest
}

/// An object's entry, which is an object.
#[allow(dead_code)] // not all crates share a file with others
pub(crate) fn entries<'a>(value: &'a mut Value, key: &str) -> &'a mut Map<String, Value> {
    let entry = value
        .as_object_mut()
        .expect("an object")
        .entry(key.to_string());
    entry
        .or_insert_with(|| json!({}))
        .as_object_mut()
        .expect("an object")
}
