//! The book's pages of keys are what follows from the JSON Schemas in docs/, which unit tests make
//! from the types (`tests/schema.rs`).
//! `PROPRIO_WRITE_REFERENCE=1 cargo test -p proprio-tests --test reference` writes them.

use serde_json::Value;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

fn docs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs")
}

fn schema(file: &str) -> Value {
    let text = fs::read_to_string(docs().join(file)).expect("a schema");
    serde_json::from_str(&text).expect("JSON")
}

/// A word of a key's value, or a number as people write it.
fn word(value: &Value) -> String {
    match value {
        Value::String(text) => format!("`\"{text}\"`"),
        Value::Array(list) => {
            let words: Vec<String> = list.iter().map(|one| word(one).replace('`', "")).collect();
            format!("`[{}]`", words.join(", "))
        }
        other => format!("`{other}`"),
    }
}

/// What kind of value a schema allows.
fn kind(schema: &Value) -> String {
    if schema.get("oneOf").is_some() || schema.get("enum").is_some() {
        return "a word".into();
    }
    match schema["type"].as_str() {
        Some("string") => "text".into(),
        Some("boolean") => "`true` or `false`".into(),
        Some("integer") => "a whole number".into(),
        Some("number") => "a number".into(),
        Some("object") => "a table".into(),
        Some("array") => {
            let items = kind(&schema["items"]);
            let items = match items.split_once(' ') {
                Some(("a", noun)) => noun.replacen("list", "lists", 1),
                _ => items.replacen("list", "lists", 1),
            };
            let many = if items.ends_with('s') { "" } else { "s" };
            match schema["minItems"]
                .as_u64()
                .filter(|n| schema["maxItems"] == *n)
            {
                Some(count) => format!("a list of {count} {items}{many}"),
                None => format!("a list of {items}{many}"),
            }
        }
        _ => panic!("no kind: {schema}"),
    }
}

/// The first unit in brackets of a description.
fn unit(description: &str) -> Option<&str> {
    let (_, rest) = description.split_once(" [")?;
    rest.split_once(']').map(|(unit, _)| unit)
}

/// Paragraphs of at most 100 columns.
fn fill(text: &str, indent: &str) -> String {
    let (mut lines, mut line) = (String::new(), String::new());
    for word in text.split_whitespace() {
        if !line.is_empty() && line.chars().count() + 1 + word.chars().count() > 100 {
            lines += &(std::mem::take(&mut line) + "\n");
        }
        line += if line.is_empty() && !lines.is_empty() {
            indent
        } else {
            ""
        };
        line += if line.trim().is_empty() { "" } else { " " };
        line += word;
    }
    lines + &line + "\n"
}

/// The section of a table of the file, and those of the tables in it.
fn table(page: &mut String, place: &str, heading: &str, schema: &Value) {
    let _ = writeln!(page, "## {heading}\n");
    let description = schema["description"].as_str().unwrap_or_default();
    // Some begin with the heading.
    let description = description.strip_prefix(heading).unwrap_or(description);
    let description = description.trim_start_matches([':', '.', ' ']);
    if let Some(first) = description.chars().next() {
        let rest = description.get(first.len_utf8()..).unwrap_or_default();
        let _ = writeln!(
            page,
            "{}",
            fill(&(first.to_uppercase().to_string() + rest), "")
        );
    }
    let required = |schema: &Value, key: &str| {
        let list = schema["required"].as_array();
        list.is_some_and(|list| list.iter().any(|one| one == key))
    };
    let mut inner: Vec<(String, String, Value)> = Vec::new();
    let mut keys = |page: &mut String, schema: &Value, of: &str| {
        let Some(properties) = schema["properties"].as_object() else {
            return;
        };
        for (key, value) in properties {
            // Of a driver's table: the gateway's own keys, which have a section.
            if value.get("$ref").is_some() || value.get("const").is_some() {
                continue;
            }
            let (many, of_table) = match value["type"].as_str() {
                Some("array") => (true, &value["items"]),
                _ => (false, value),
            };
            let has_keys = |one: &Value| one["properties"].is_object();
            let kinds = of_table["oneOf"].as_array();
            let is_table = has_keys(of_table)
                || kinds.is_some_and(|kinds| kinds.iter().any(has_keys))
                || (many
                    && of_table["oneOf"]
                        .as_array()
                        .is_some_and(|all| all.iter().any(|one| one.get("$ref").is_some())));
            let description = value["description"].as_str().unwrap_or_default();
            if is_table {
                let name = if place.is_empty() {
                    key.clone()
                } else {
                    format!("{place}.{key}")
                };
                let brackets = if many {
                    format!("`[[{name}]]`")
                } else {
                    format!("`[{name}]`")
                };
                let mut of_table = of_table.clone();
                if !of_table["description"].is_string() {
                    of_table["description"] = description.into();
                }
                inner.push((name, brackets, of_table));
                continue;
            }
            let _ = writeln!(page, "### `{key}`\n");
            let mut line = kind(value);
            if let Some(unit) = unit(description) {
                let _ = write!(line, " [{unit}]");
            }
            if required(schema, key) {
                line += "; needed";
            } else if let Some(default) = value.get("default").filter(|d| d.as_str() != Some("")) {
                let _ = write!(line, "; default {}", word(default));
            }
            if !of.is_empty() {
                let _ = write!(line, "; with kind = {of}");
            }
            let _ = writeln!(page, "{}", fill(&line, ""));
            let _ = writeln!(page, "{}", fill(description, ""));
            let mut words = String::new();
            let value = if many { &value["items"] } else { value };
            for one in value["oneOf"].as_array().into_iter().flatten() {
                for name in one["enum"].as_array().into_iter().flatten() {
                    let _ = writeln!(words, "- `{}`", word(name).replace('`', ""));
                }
                let Some(name) = one.get("const") else {
                    continue;
                };
                let meaning = one["description"].as_str().unwrap_or_default();
                let meaning = meaning.strip_prefix(&word(name)).unwrap_or(meaning);
                let meaning = meaning.trim_start_matches([':', '.', ' ']);
                let colon = if meaning.is_empty() { "" } else { ": " };
                words += &fill(&format!("- {}{colon}{meaning}", word(name)), "  ");
            }
            for name in value["enum"].as_array().into_iter().flatten() {
                let _ = writeln!(words, "- {}", word(name));
            }
            if !words.is_empty() {
                let _ = writeln!(page, "{words}");
            }
        }
    };
    keys(page, schema, "");
    let kinds = schema["oneOf"].as_array().map_or(&[][..], Vec::as_slice);
    let kind_of = |one: &Value| word(&one["properties"]["kind"]["const"]);
    if kinds.iter().any(|one| one["properties"].is_object()) {
        let _ = writeln!(
            page,
            "### `kind`\n\na word; needed\n\nWhich of these it is:\n"
        );
        for one in kinds {
            let meaning = one["description"].as_str().unwrap_or_default();
            *page += &fill(&format!("- {}: {meaning}", kind_of(one)), "  ");
        }
        page.push('\n');
    }
    for one in kinds {
        keys(page, one, &kind_of(one));
    }
    for (name, heading, schema) in inner {
        table(page, &name, &heading, &schema);
    }
}

const MADE: &str =
    "<!-- Made by tests/tests/reference.rs from the types: change their comments. -->\n";

/// The pages of the schemas, by their file.
fn pages() -> Vec<(&'static str, String)> {
    let mut gateway = schema("gateway.schema.json");
    let device = gateway["definitions"]["device"].take();
    *gateway
        .pointer_mut("/properties/bus/items/properties/device/items")
        .expect("devices") = device;
    let mut pages = Vec::new();
    for (file, schema, about) in [
        (
            "gateway.toml",
            gateway.clone(),
            "What the gateway reads: buses, devices, joints.",
        ),
        (
            "estimator.toml",
            schema("estimator.schema.json"),
            "What the estimator reads: the robot, its sensors and contacts, what is published.",
        ),
    ] {
        let mut schema = schema;
        schema["description"] = "".into();
        let mut page = format!("{MADE}# {file}\n\n{about}\n\n");
        table(&mut page, "", file, &schema);
        pages.push((
            if file == "gateway.toml" {
                "gateway.md"
            } else {
                "estimator.md"
            },
            page,
        ));
    }
    let drivers = gateway["definitions"].as_object().expect("drivers");
    let parts = [("a", "d"), ("i", "j"), ("m", "x")];
    for (file, (first, last)) in ["drivers-a.md", "drivers-i.md", "drivers-m.md"]
        .into_iter()
        .zip(parts)
    {
        let title = format!("Keys of drivers: {first} to {last}");
        let is_here = |name: &str| name.get(..1).is_some_and(|l| (first..=last).contains(&l));
        let mut page = format!(
            "{MADE}# {title}\n\nBeside those of every `[[bus.device]]` \
             ([gateway.toml](gateway.md)).\n\n"
        );
        for (driver, schema) in drivers.iter().filter(|(name, _)| is_here(name)) {
            if driver == "device" {
                continue;
            }
            let mut schema = schema.clone();
            schema["description"] = format!("Its page: [{driver}](../devices/{driver}.md).").into();
            table(&mut page, "", driver, &schema);
        }
        pages.push((file, page));
    }
    for (_, page) in &mut pages {
        *page = page.trim_end().to_owned() + "\n";
    }
    pages
}

#[test]
fn the_reference_pages_are_new() {
    for (file, page) in pages() {
        let path = docs().join("book/src/reference").join(file);
        if std::env::var_os("PROPRIO_WRITE_REFERENCE").is_some() {
            fs::write(&path, &page).expect("the page can be written");
        }
        let committed = fs::read_to_string(&path).unwrap_or_default();
        assert!(
            committed == page,
            "{} is old: PROPRIO_WRITE_REFERENCE=1 cargo test -p proprio-tests --test reference",
            path.display()
        );
    }
}

/// Nothing of Rust is in them, and nothing is without a meaning.
#[test]
fn each_key_has_a_meaning_in_words() {
    let mut count = 0;
    for (file, page) in pages() {
        assert!(!page.contains("::") && !page.contains("\\["), "{file}");
        for section in page.split("\n### ").skip(1) {
            let section = section.split("\n## ").next().unwrap_or_default();
            let mut parts = section.split("\n\n");
            let key = parts.next().unwrap_or_default();
            let meaning = parts.nth(1).unwrap_or_default();
            assert!(meaning.trim().len() > 5, "{file}: {key} has no comment");
            count += 1;
        }
    }
    assert!(count > 200, "{count} keys");
}
