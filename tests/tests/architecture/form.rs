//! The form of every file: what it is for, its size and width, nothing left for later, and that
//! named tests exist.

use crate::{Source, has_word, sources};
use std::path::Path;

/// Files whose first lines do not say what they are for. A crate's README.md says it for the crate.
fn without_purpose(sources: &[Source]) -> Vec<String> {
    let has_readme = |s: &Source| {
        let folder = s.path.rsplit_once("/src/").map_or("", |(folder, _)| folder);
        let readme = format!("{folder}/README.md");
        s.text
            .starts_with("#![doc = include_str!(\"../README.md\")]")
            && (sources.iter()).any(|s| s.path == readme && s.text.starts_with("# "))
    };
    sources
        .iter()
        .filter(|s| s.is_rust() && !s.text.starts_with("//! ") && !has_readme(s))
        .map(|s| s.path.clone())
        .collect()
}

#[test]
fn every_file_says_what_it_is_for() {
    let mut sources = sources();
    assert_eq!(without_purpose(&sources), [""; 0]);
    sources.push(Source::new("cli/src/new.rs", "use std::io;\n"));
    assert_eq!(without_purpose(&sources), ["cli/src/new.rs"]);
}

fn too_large(sources: &[Source]) -> Vec<String> {
    sources
        .iter()
        .filter(|s| s.size > 1 << 20)
        .map(|s| format!("{}: {} bytes", s.path, s.size))
        .collect()
}

#[test]
fn no_file_is_large() {
    let mut sources = sources();
    assert_eq!(too_large(&sources), [""; 0]);
    sources.push(Source {
        path: "tests/recording.log".into(),
        size: (1 << 20) + 1,
        text: String::new(),
    });
    assert_eq!(too_large(&sources).len(), 1);
}

/// Lines of text and code over 100 columns. The outputs of candump are as it prints them.
fn too_wide(sources: &[Source]) -> Vec<String> {
    let texts = [".rs", ".md", ".toml", ".py", ".css", ".cpp", ".hpp", "/run"];
    let ours = |s: &&Source| {
        texts.iter().any(|end| s.path.ends_with(end)) && s.path != "gateway/tests/candump.rs"
    };
    let lines = (sources.iter().filter(ours))
        .flat_map(|s| s.text.lines().zip(1..).map(move |(line, at)| (s, line, at)));
    lines
        .filter(|(_, line, _)| line.chars().count() > 100)
        .map(|(source, _, at)| format!("{}:{at}", source.path))
        .collect()
}

#[test]
fn no_line_is_wider_than_100_columns() {
    let mut sources = sources();
    assert_eq!(too_wide(&sources), [""; 0]);
    let line = format!("// {}\n", "é".repeat(97));
    sources.push(Source::new(
        "cli/src/wide.rs",
        &format!("{line}{}", &line[1..]),
    ));
    assert_eq!(too_wide(&sources), [""; 0]);
    sources.push(Source::new("cli/src/wider.rs", &format!("{line}/{line}")));
    assert_eq!(too_wide(&sources), ["cli/src/wider.rs:2"]);
}

/// Words that mark unfinished work.
fn unfinished(sources: &[Source]) -> Vec<String> {
    let words = [
        concat!("TO", "DO"),
        concat!("FIX", "ME"),
        concat!("XX", "X"),
        concat!("to", "do!"),
        concat!("unimple", "mented!"),
    ];
    let lines = sources
        .iter()
        .filter(|s| !s.path.ends_with(".csv"))
        .flat_map(|s| s.text.lines().zip(1..).map(move |(line, at)| (s, line, at)));
    lines
        .filter(|(_, line, _)| {
            words.iter().any(|w| {
                w.strip_suffix('!')
                    .map_or_else(|| has_word(line, w), |_| line.contains(w))
            })
        })
        .map(|(s, line, at)| format!("{}:{at}: {}", s.path, line.trim()))
        .collect()
}

#[test]
fn nothing_is_left_for_later() {
    let mut sources = sources();
    assert_eq!(unfinished(&sources), [""; 0]);
    sources.push(Source::new(
        "cli/src/new.rs",
        concat!(
            "//! New.\n// TO",
            "DO: the rest\nfn f() { to",
            "do!() }\nunimple",
            "mented!()\n"
        ),
    ));
    assert_eq!(unfinished(&sources).len(), 3);
}

/// Tests that SECURITY.md names as `file::test`, and that do not exist.
fn missing_tests(sources: &[Source]) -> Vec<&str> {
    let document = sources.iter().find(|source| source.path == "SECURITY.md");
    let words = document.map_or("", |source| &source.text).split('`');
    let is_missing = |word: &&str| {
        word.split_once(".rs::").is_some_and(|(file, test)| {
            let file = format!("{file}.rs");
            let mut files = sources
                .iter()
                .filter(|source| Path::new(&source.path).ends_with(&file));
            !files.any(|source| source.text.contains(&format!("fn {test}(")))
        })
    };
    words.filter(is_missing).collect()
}

#[test]
fn tests_that_a_document_names_exist() {
    let mut sources = sources();
    assert_eq!(missing_tests(&sources), [""; 0]);
    let document = (sources.iter_mut()).find(|source| source.path == "SECURITY.md");
    let text = &mut document.expect("it is there").text;
    assert!(text.matches(".rs::").count() > 10);
    text.push_str("`truth.rs::all_is_well` `none.rs::a_valid_torque_is_true`");
    let missing = ["truth.rs::all_is_well", "none.rs::a_valid_torque_is_true"];
    assert_eq!(missing_tests(&sources), missing);
}
