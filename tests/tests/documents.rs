//! README.md and docs/: their configuration blocks are legal, and their commands exist. (Their
//! programs are doc tests of the crate that consumers depend on.)

use proprio_estimator::config::Config;
use std::path::{Path, PathBuf};
use std::process::Command;

fn documents() -> Vec<(PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let docs = std::fs::read_dir(root.join("docs"))
        .expect("docs/")
        .flatten();
    let files = docs
        .map(|entry| entry.path())
        .chain([root.join("README.md")]);
    let read = |file: PathBuf| {
        let text = std::fs::read_to_string(&file).expect("a document");
        (file, text)
    };
    files.map(read).collect()
}

/// The fenced blocks of a language.
fn blocks<'a>(text: &'a str, language: &str) -> Vec<&'a str> {
    let fence = format!("```{language}\n");
    let parts = text.split(&fence).skip(1);
    parts
        .map(|part| part.split("```").next().unwrap_or_default())
        .collect()
}

#[test]
fn configuration_blocks_are_legal() {
    let mut count = 0;
    for (file, text) in documents() {
        for block in blocks(&text, "toml") {
            let text = format!("schema = 1\nrobot = \"r\"\nmodel = \"m.urdf\"\n{block}");
            let config = Config::parse(&text);
            assert!(config.is_ok(), "{}: {config:?}\n{block}", file.display());
            count += 1;
        }
    }
    assert!(count > 0, "there is a block");
}

#[test]
fn commands_and_their_options_exist() {
    let help = |verb: &str| {
        let output = Command::new(proprio_tests::Rig::program())
            .args([verb, "--help"])
            .output();
        String::from_utf8(output.expect("proprio runs").stdout).expect("text")
    };
    let mut count = 0;
    for (file, text) in documents() {
        for line in blocks(&text, "sh").iter().flat_map(|block| block.lines()) {
            let line = line.trim();
            let after =
                ["proprio ", "cargo run --release -- "].map(|start| line.strip_prefix(start));
            let Some(command) = after.into_iter().flatten().next() else {
                continue;
            };
            let mut words = command.split_whitespace();
            let verb = words.next().expect("a verb");
            let help = help(verb);
            assert!(help.contains("Usage:"), "{}: {line}", file.display());
            for option in words.filter(|word| word.starts_with("--")) {
                assert!(
                    help.contains(option),
                    "{}: {verb} has no {option}",
                    file.display()
                );
            }
            count += 1;
        }
    }
    assert!(count >= 2, "there are commands");
}
