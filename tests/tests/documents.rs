//! The book, README.md and the other documents: their links lead somewhere, no page is long, every
//! page is in the book's list, configuration blocks are legal, and a test knows each block of code.
//! (Commands are run by `book.rs`, programs are compiled by the tests of the readers.)

use proprio_estimator::config::Config;
use proprio_gateway::plan::Plan;
use pulldown_cmark::{CodeBlockKind, Event, Options, Parser, Tag, TagEnd};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The most words of a page: what a person reads in ten minutes.
const MOST_WORDS: usize = 2000;

fn root() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    root.canonicalize().expect("the folder of the workspace")
}

/// All pages of the book, and the documents at the root, with their texts.
fn documents() -> BTreeMap<PathBuf, String> {
    let mut folders = vec![root().join("docs/book/src")];
    let names = [
        "README.md",
        "SECURITY.md",
        "CONTRIBUTING.md",
        "CHANGELOG.md",
    ];
    let mut files: Vec<PathBuf> = names.map(|name| root().join(name)).into();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).expect("a folder").flatten() {
            match entry.path() {
                path if path.is_dir() => folders.push(path),
                path => files.push(path),
            }
        }
    }
    let read = |file: PathBuf| {
        let text = fs::read_to_string(&file).expect("a document");
        (file, text)
    };
    files.into_iter().map(read).collect()
}

fn events(text: &str) -> Parser<'_> {
    Parser::new_ext(text, Options::ENABLE_TABLES)
}

/// The fenced blocks, with their languages.
fn blocks(text: &str) -> Vec<(String, String)> {
    let mut blocks: Vec<(String, String)> = Vec::new();
    let mut is_open = false;
    for event in events(text) {
        match event {
            Event::Start(Tag::CodeBlock(kind)) => {
                let language = match kind {
                    CodeBlockKind::Fenced(language) => language.to_string(),
                    CodeBlockKind::Indented => String::new(),
                };
                blocks.push((language, String::new()));
                is_open = true;
            }
            Event::End(TagEnd::CodeBlock) => is_open = false,
            Event::Text(part) if is_open => blocks.last_mut().expect("open").1 += &part,
            _ => {}
        }
    }
    blocks
}

/// The targets of headings: as mdBook and GitHub make them.
fn anchors(text: &str) -> Vec<String> {
    let (mut anchors, mut heading) = (Vec::new(), None::<String>);
    for event in events(text) {
        match event {
            Event::Start(Tag::Heading { .. }) => heading = Some(String::new()),
            Event::End(TagEnd::Heading(_)) => anchors.extend(heading.take().map(|heading| {
                let kept = heading.to_lowercase();
                let kept = kept
                    .chars()
                    .filter(|c| c.is_alphanumeric() || " _-".contains(*c));
                kept.map(|c| if c == ' ' { '-' } else { c })
                    .collect::<String>()
            })),
            Event::Text(part) | Event::Code(part) => {
                if let Some(heading) = &mut heading {
                    *heading += &part;
                }
            }
            _ => {}
        }
    }
    anchors
}

/// Links of `documents` that lead nowhere.
fn broken(documents: &BTreeMap<PathBuf, String>) -> Vec<String> {
    let mut broken = Vec::new();
    for (file, text) in documents {
        for event in events(text) {
            let Event::Start(Tag::Link { dest_url, .. } | Tag::Image { dest_url, .. }) = event
            else {
                continue;
            };
            if dest_url.starts_with("https://") {
                continue;
            }
            let (path, anchor) = dest_url.split_once('#').unwrap_or((&dest_url, ""));
            let folder = file.parent().expect("a folder");
            let target = match path {
                "" => file.clone(),
                path => folder.join(path).canonicalize().unwrap_or_default(),
            };
            let is_in_book = |file: &Path| file.starts_with(root().join("docs/book/src"));
            let is_there = target.exists()
                // The book is also read without the source.
                && (!is_in_book(file) || is_in_book(&target))
                && (anchor.is_empty()
                    || (documents.get(&target))
                        .is_some_and(|text| anchors(text).iter().any(|one| one == anchor)));
            if !is_there {
                broken.push(format!("{}: {dest_url}", file.display()));
            }
        }
    }
    broken
}

#[test]
fn links_lead_somewhere() {
    let mut documents = documents();
    assert_eq!(broken(&documents), [""; 0]);
    let page = root().join("docs/book/src/index.md");
    let text = documents.get_mut(&page).expect("the first page");
    *text += "[a](none.md) [b](first.md#none) [c](../../../README.md) [d](theory.md#the-idea)";
    assert_eq!(broken(&documents).len(), 3);
}

#[test]
fn no_page_is_long() {
    for (file, text) in documents() {
        let words = text.split_whitespace().count();
        // Pages of keys are looked up, not read.
        let most = match text.starts_with("<!-- Made by") {
            true => MOST_WORDS * 3 / 2,
            false => MOST_WORDS,
        };
        assert!(words <= most, "{}: {words} words", file.display());
    }
}

#[test]
fn every_page_is_in_the_list_once() {
    let book = root().join("docs/book/src");
    let list = fs::read_to_string(book.join("SUMMARY.md")).expect("the list");
    for file in documents().keys() {
        if let Ok(path) = file.strip_prefix(&book)
            && path != Path::new("SUMMARY.md")
        {
            let link = format!("]({})", path.display());
            assert_eq!(list.matches(&link).count(), 1, "{}", path.display());
        }
    }
}

/// The languages of blocks, and where the test of it looks; none: everywhere.
const LANGUAGES: [(&str, Option<&str>); 8] = [
    ("sh", None),   // book.rs
    ("toml", None), // below, and gateway/tests/pages.rs
    ("text", None),
    ("json", Some("reference/editors.md")), // below
    ("rust,no_run", Some("read/rust.md")),  // gateway/topics/src/lib.rs
    ("c", Some("read/c.md")),               // tests/ffi.rs
    ("cpp", Some("read/c.md")),
    ("python", Some("read/python.md")), // python/tests
];

#[test]
fn a_test_knows_each_block_of_code() {
    for (file, text) in documents() {
        for (language, block) in blocks(&text) {
            let known = LANGUAGES.iter().find(|(name, _)| *name == language);
            let is_there = known.is_some_and(|(_, place)| place.is_none_or(|p| file.ends_with(p)));
            assert!(is_there, "{}: {language:?}\n{block}", file.display());
            if language == "json" {
                let object = serde_json::from_str::<serde_json::Value>(&format!("{{{block}}}"));
                assert!(object.is_ok(), "{block}: {object:?}");
            }
        }
    }
}

#[test]
fn configuration_blocks_are_legal() {
    let mut count = 0;
    for (file, text) in documents() {
        // Drivers' pages have keys of a device alone: gateway/tests/pages.rs.
        if file
            .parent()
            .is_some_and(|folder| folder.ends_with("devices"))
        {
            continue;
        }
        let blocks = blocks(&text).into_iter();
        for (_, block) in blocks.filter(|(language, _)| language == "toml") {
            // A whole file, or parts of gateway.toml or estimator.toml.
            let text = match block.contains("schema = ") {
                true => block.clone(),
                false => format!("schema = 1\nrobot = \"r\"\nmodel = \"m.urdf\"\n{block}"),
            };
            let problem = match block.contains("[[bus") {
                true => {
                    Plan::parse(&text.replace("model = \"m.urdf\"\n", ""), Path::new(".")).err()
                }
                false => Config::parse(&text).err().map(|e| format!("{e:?}")),
            };
            assert!(
                problem.is_none(),
                "{}: {problem:?}\n{block}",
                file.display()
            );
            count += 1;
        }
    }
    assert!(count > 4, "{count} blocks");
}
