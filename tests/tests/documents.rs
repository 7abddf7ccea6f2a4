//! README.md, SECURITY.md and docs/: their configuration blocks are legal, and their commands
//! exist. (Their programs are doc tests of the crate that consumers depend on.)

use proprio_estimator::config::Config;
use proprio_gateway::plan::Plan;
use std::path::{Path, PathBuf};
use std::process::Command;

fn documents() -> Vec<(PathBuf, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let docs = std::fs::read_dir(root.join("docs"))
        .expect("docs/")
        .flatten();
    let files = docs
        .map(|entry| entry.path())
        .chain(["README.md", "SECURITY.md"].map(|name| root.join(name)));
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
            let text = format!("schema = 1\nrobot = \"r\"\n{block}");
            // Parts of gateway.toml, or of estimator.toml.
            let problem = match block.contains("[[bus") {
                true => Plan::parse(&text, Path::new(".")).err(),
                false => {
                    let text = text.replacen('\n', "\nmodel = \"m.urdf\"\n", 1);
                    Config::parse(&text).err().map(|e| format!("{e:?}"))
                }
            };
            assert!(
                problem.is_none(),
                "{}: {problem:?}\n{block}",
                file.display()
            );
            count += 1;
        }
    }
    assert!(count > 0, "there is a block");
}

/// The commands of a document, in blocks and in lines of text.
fn commands(text: &str) -> Vec<String> {
    let joined: Vec<String> = blocks(text, "sh")
        .iter()
        .map(|block| block.replace("\\\n", " "))
        .collect();
    let mut prose = String::new();
    for (number, part) in text.split("```").enumerate() {
        if number % 2 == 0 {
            prose += part;
        }
    }
    let inline = prose.split('`').skip(1).step_by(2);
    let lines = joined.iter().flat_map(|block| block.lines());
    lines
        .chain(inline)
        .map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "))
        .filter_map(|line| {
            ["proprio ", "cargo run --release -- "]
                .into_iter()
                .find_map(|start| line.strip_prefix(start).map(str::to_owned))
        })
        .collect()
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
        for command in commands(&text) {
            let mut words = command.split(' ');
            let verb = words.next().expect("a verb");
            // These are programs of their own, which are not built here.
            if verb.starts_with('-') || ["view", "ros2"].contains(&verb) {
                continue;
            }
            let help = help(verb);
            assert!(help.contains("Usage:"), "{}: {command}", file.display());
            let known = || help.split(|c: char| !c.is_alphanumeric() && c != '-');
            for option in words.filter(|word| word.starts_with("--")) {
                assert!(
                    known().any(|word| word == option),
                    "{}: {verb} has no {option}",
                    file.display()
                );
            }
            count += 1;
        }
    }
    assert!(count >= 8, "{count} commands");
}
