//! `help`: the pages of the book on the terminal, for a robot PC without the source: a key of the
//! configuration, a driver, a reason or state, a page; and the help of a verb.
//!
//! What can be asked for is in the pages themselves: words in backticks in a heading name its
//! section. One of a page's parts has the part's name before its own, as `bus.device.address`.

use clap::Command;
use clap::error::ErrorKind;
use proprio_gateway::plan::did_you_mean;
use std::io::IsTerminal;

/// Title, path and text of each page, in the order of the book.
const PAGES: &[(&str, &str, &str)] = include!(concat!(env!("OUT_DIR"), "/pages.rs"));

/// The command line of `help`.
#[derive(clap::Args)]
pub(crate) struct HelpArgs {
    /// A verb, a key (max_silence_ms, input.max_silence_ms), a driver (canopen_drive), a reason or
    /// a device's state (unexplained, silent), a page; `topics` lists the pages
    #[arg(value_name = "WORD")]
    words: Vec<String>,
}

/// A section or a page that can be asked for.
struct Article {
    /// Its name: `bus.device.address`, `unexplained`, `canopen_drive`.
    name: String,
    /// Its page's title, if it is the whole page.
    title: Option<&'static str>,
    text: &'static str,
}

impl Article {
    /// Whether `word` is its name, or the last part of it.
    fn is(&self, word: &str) -> bool {
        if self.title.is_some_and(|title| title.to_lowercase() == word) {
            return true;
        }
        let rest = self.name.strip_suffix(word);
        rest.is_some_and(|rest| rest.is_empty() || rest.ends_with('.'))
    }
}

/// All sections that have a name, and all pages, by the name of their file.
fn entries() -> Vec<Article> {
    let mut all = Vec::new();
    for &(title, path, text) in PAGES {
        let file = path
            .rsplit('/')
            .next()
            .unwrap_or(path)
            .trim_end_matches(".md");
        let folder = path
            .split('/')
            .next()
            .unwrap_or(path)
            .trim_end_matches(".md");
        let name = if file == "index" { folder } else { file };
        let title = Some(title);
        all.push(Article {
            name: name.into(),
            title,
            text,
        });
        let mut part = String::new();
        for (at, line) in headings(text) {
            let depth = line.bytes().take_while(|byte| *byte == b'#').count();
            let heading = line.trim_start_matches('#').trim();
            let behind = at + line.len();
            let end = headings(text.get(behind..).unwrap_or_default())
                .find(|(_, line)| line.bytes().take_while(|byte| *byte == b'#').count() <= depth);
            let end = end.map_or(text.len(), |(end, _)| behind + end);
            let section = text.get(at..end).unwrap_or_default();
            if depth == 2 {
                part = heading.replace(['`', '[', ']'], "");
            }
            for word in heading.split('`').skip(1).step_by(2) {
                let word = word.replace(['[', ']'], "");
                let name = if depth == 3 {
                    format!("{part}.{word}")
                } else {
                    word
                };
                all.push(Article {
                    name,
                    title: None,
                    text: section,
                });
            }
        }
    }
    all
}

/// The headings of a page, outside its blocks of code, with their places.
fn headings(text: &'static str) -> impl Iterator<Item = (usize, &'static str)> {
    let (mut at, mut is_code) = (0, false);
    text.split_inclusive('\n').filter_map(move |line| {
        let here = at;
        at += line.len();
        is_code ^= line.starts_with("```");
        (!is_code && line.starts_with('#')).then(|| (here, line.trim_end()))
    })
}

/// What `proprio help` with these words shows.
#[derive(Debug, PartialEq)]
enum Lookup {
    /// The help of a verb: `proprio VERB --help`.
    Verb(Vec<String>),
    /// A text.
    Text(String),
    /// Several have the name.
    Several(Vec<String>),
    /// None has it; the end of a message.
    Unknown(String),
}

fn answer(words: &[String], program: &Command) -> Lookup {
    let is_verb = |word: &str| program.find_subcommand(word).is_some();
    let Some(first) = words.first() else {
        return Lookup::Verb(Vec::new());
    };
    if is_verb(first) {
        return Lookup::Verb(words.to_vec());
    }
    let word = words.join(" ");
    let word = word.trim_matches(['[', ']', '`']);
    let all = entries();
    if word == "topics" {
        let pages = all.iter().filter_map(|entry| Some((entry, entry.title?)));
        let lines = pages.map(|(entry, title)| match is_verb(&entry.name) {
            true => format!("{:<18} {title}\n", title.to_lowercase()),
            false => format!("{:<18} {title}\n", entry.name),
        });
        return Lookup::Text(lines.collect());
    }
    let lower = word.to_lowercase();
    let mut found: Vec<&Article> = all.iter().filter(|entry| entry.name == lower).collect();
    if found.is_empty() {
        found = all.iter().filter(|entry| entry.is(&lower)).collect();
    }
    if found.is_empty() {
        // A key without its unit.
        let begin = format!("{lower}_");
        let is_begun = |entry: &&Article| {
            let mut ends = entry.name.match_indices(&begin).map(|(at, _)| at);
            ends.any(|at| at == 0 || entry.name.as_bytes().get(at - 1) == Some(&b'.'))
        };
        found = all.iter().filter(is_begun).collect();
    }
    let mut names: Vec<String> = found.iter().map(|entry| entry.name.clone()).collect();
    names.dedup();
    match names.len() {
        0 => {
            let names = all.iter().flat_map(|entry| {
                let last = entry.name.rsplit('.').next().unwrap_or_default();
                [entry.name.as_str(), last]
            });
            let verbs = program.get_subcommands().map(Command::get_name);
            Lookup::Unknown(did_you_mean(&lower, names.chain(verbs)))
        }
        // One, also if it is described twice, as for each kind of base.
        1 => {
            let texts = found.iter().map(|entry| match entry.text.split_once('\n') {
                Some((_, rest)) if entry.name.contains('.') && entry.title.is_none() => {
                    format!("## {}\n{}", entry.name, rest.trim_end())
                }
                _ => entry.text.trim_end().to_owned(),
            });
            Lookup::Text(texts.collect::<Vec<_>>().join("\n\n"))
        }
        _ => Lookup::Several(names),
    }
}

/// Prints the help of a verb, as `--help` does; a wrong command line if there is none.
fn print_help_of(verb: &[String], mut program: Command) {
    program.build();
    for word in verb {
        program = program.find_subcommand(word).cloned().unwrap_or_else(|| {
            let name = program.get_name().to_owned();
            let why = format!("{name} has no {word:?}; `proprio help {name}` lists what it has");
            refuse(&mut program, &why)
        });
    }
    match is_for_a_person() {
        true => print_part!("{}", program.render_long_help().ansi()),
        false => print_part!("{}", program.render_long_help()),
    }
}

/// Ends the program: the command line is wrong.
fn refuse(command: &mut Command, why: &str) -> ! {
    command.error(ErrorKind::InvalidValue, why).exit()
}

/// Whether bold letters are of use.
fn is_for_a_person() -> bool {
    std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none()
}

/// A page for the terminal: without comments and without the targets of links.
fn plain(text: &str, is_bold: bool) -> String {
    let text = without_links(text);
    let mut plain = String::new();
    let mut is_code = false;
    for line in text.lines().filter(|line| !line.starts_with("<!--")) {
        is_code ^= line.starts_with("```");
        if !is_code && line.starts_with('#') && is_bold {
            let heading = line.trim_start_matches('#').trim();
            plain += &format!("\x1b[1m{}\x1b[0m\n", heading.replace('`', ""));
            continue;
        }
        plain += line;
        plain.push('\n');
    }
    plain.trim().to_owned()
}

/// The text with `text` for `[text](page.md)`, outside blocks of code. A link may go over the end
/// of a line.
fn without_links(text: &str) -> String {
    let fence = "```";
    let parts = text.split(fence).enumerate().map(|(number, part)| {
        let mut plain = String::new();
        let mut rest = part;
        while number % 2 == 0
            && let Some((before, after)) = rest.split_once("](")
            && let Some((_, behind)) = after.split_once(')')
        {
            match before.rsplit_once('[') {
                Some((before, text)) => plain += &format!("{before}{text}"),
                None => plain += before,
            }
            rest = behind;
        }
        plain + rest
    });
    parts.collect::<Vec<_>>().join(fence)
}

/// Shows what the words of `args` name; `program` is the whole command line.
pub(crate) fn run(args: &HelpArgs, mut program: Command) {
    let word = args.words.join(" ");
    match answer(&args.words, &program) {
        Lookup::Verb(words) => print_help_of(&words, program),
        Lookup::Text(text) => {
            print_line!("{}", plain(&text, is_for_a_person()));
        }
        Lookup::Several(names) => {
            let lines = names.iter().map(|name| format!("  proprio help {name}\n"));
            print_line!(
                "{word} is in several places:\n{}",
                lines.collect::<String>().trim_end()
            );
        }
        Lookup::Unknown(near) => refuse(
            &mut program,
            &format!("nothing is called {word:?}{near}; `proprio help topics` lists the pages"),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CommandLine;
    use clap::{CommandFactory as _, Parser as _};

    fn ask(words: &str) -> Lookup {
        answer(
            &words.split(' ').map(ToOwned::to_owned).collect::<Vec<_>>(),
            &CommandLine::command(),
        )
    }

    fn text(words: &str) -> String {
        match ask(words) {
            Lookup::Text(text) => plain(&text, false),
            other => panic!("{words}: {other:?}"),
        }
    }

    #[test]
    fn keys_drivers_reasons_and_pages_are_found() {
        assert!(text("urdf_relative_std").contains("default `0.2`"));
        assert!(text("input.max_silence_ms").contains("default `50.0`"));
        assert!(text("input.max_silence").starts_with("## input.max_silence_ms\n"));
        assert!(text("canopen_drive").contains("6064"));
        assert!(text("canopen_drive.hold_ms").contains("TPDO"));
        assert!(text("unexplained").starts_with("## `unexplained`"));
        assert!(text("silent").contains("terminations of 120 Ohm"));
        assert!(text("theory").contains("rRNEA"));
        assert!(text("What a torque rests on").contains("Offsets."));
        assert!(text("topics").contains("canopen_drive"));
        assert!(
            !text("unexplained").contains("\n## `contradicted`"),
            "it ends with its section"
        );
    }

    #[test]
    fn the_targets_of_links_are_left_out_over_lines_too() {
        let page = "# A\n[one](a.md), ([two\nthree](b.md#c)) and x[1]\n```sh\n[a](b)\n```\n";
        assert_eq!(
            plain(page, false),
            "# A\none, (two\nthree) and x[1]\n```sh\n[a](b)\n```"
        );
    }

    #[test]
    fn what_is_in_several_places_is_listed_and_near_words_are_named() {
        let Lookup::Several(names) = ask("max_silence_ms") else {
            panic!("{:?}", ask("max_silence_ms"))
        };
        for name in [
            "bus.device.max_silence_ms",
            "input.max_silence_ms",
            "skin.max_silence_ms",
        ] {
            assert!(names.iter().any(|one| one == name), "{names:?}");
            assert!(matches!(ask(name), Lookup::Text(_)), "{name}");
        }
        for (wrong, near) in [
            ("max_silense_ms", "max_silence_ms"),
            ("canopen_driv", "canopen_drive"),
            ("unexplaned", "unexplained"),
            ("gatway", "gateway"),
        ] {
            let Lookup::Unknown(text) = ask(wrong) else {
                panic!("{:?}", ask(wrong))
            };
            assert!(
                text.contains(&format!("did you mean {near:?}")),
                "{wrong}: {text}"
            );
        }
    }

    #[test]
    fn verbs_keep_their_help() {
        for verb in ["gateway", "estimator", "ctl tare"] {
            let words: Vec<String> = verb.split(' ').map(ToOwned::to_owned).collect();
            assert_eq!(ask(verb), Lookup::Verb(words));
        }
        assert_eq!(
            answer(&[], &CommandLine::command()),
            Lookup::Verb(Vec::new())
        );
    }

    /// Each name that is listed shows one text, so that nobody is sent in a circle.
    #[test]
    fn each_entry_can_be_shown() {
        for entry in entries() {
            let shown = ask(entry
                .title
                .filter(|_| {
                    CommandLine::command()
                        .find_subcommand(&entry.name)
                        .is_some()
                })
                .unwrap_or(&entry.name));
            assert!(
                matches!(shown, Lookup::Text(_)),
                "{}: {shown:?}",
                entry.name
            );
        }
    }

    #[test]
    fn each_reason_each_state_and_each_driver_has_a_text() {
        use proprio_topics::{DeviceState, LinkState, Reason};
        let reasons = Reason::ALL.iter().map(|reason| reason.word());
        let states = DeviceState::ALL.iter().map(|state| state.word());
        let links = LinkState::ALL.iter().map(|state| state.word());
        let drivers = proprio_drivers::DRIVERS.iter().copied();
        let well = ["", "streaming", "up", "ended"];
        let all = reasons.chain(states).chain(links).chain(drivers);
        for word in all.filter(|word| !well.contains(word)) {
            assert!(
                matches!(ask(word), Lookup::Text(_)),
                "{word}: {:?}",
                ask(word)
            );
        }
    }

    #[test]
    fn the_page_of_commands_has_each() {
        let page = text("commands");
        for verb in CommandLine::command().get_subcommands() {
            assert!(
                page.contains(&format!("| `{}` |", verb.get_name())),
                "{}",
                verb.get_name()
            );
        }
    }

    /// The commands of a document: whole ones of its blocks, and parts of them in lines of text.
    fn commands(text: &str) -> Vec<(String, bool)> {
        let mut all = Vec::new();
        for (number, part) in text.split("```").enumerate() {
            if number % 2 == 0 {
                let inline = part.split('`').skip(1).step_by(2);
                all.extend(inline.map(|line| (line.replace('\n', " "), false)));
            } else if let Some(block) = part.strip_prefix("sh\n") {
                let block = block.replace("\\\n", " ");
                all.extend(block.lines().map(|line| (line.to_owned(), true)));
            }
        }
        all
    }

    /// What is given to `proprio` in this line of a shell, if anything is.
    fn arguments(line: &str) -> Option<Vec<String>> {
        let line = line.replace("cargo run --release -- ", "proprio ");
        let line = line
            .strip_prefix("source <(")
            .map_or(line.as_str(), |rest| rest.trim_end_matches(')'));
        let line = line.strip_prefix("sudo -u proprio ").unwrap_or(line);
        let line = line.strip_prefix("sudo ").unwrap_or(line);
        let line = line.strip_prefix("target/release/").unwrap_or(line);
        let line = line.strip_prefix("proprio ")?;
        Some(line.split_whitespace().map(ToOwned::to_owned).collect())
    }

    /// In every document, each command has legal options and values; those in blocks are whole.
    #[test]
    fn each_command_of_the_documents_is_legal() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let others = ["README.md", "SECURITY.md", "CONTRIBUTING.md"]
            .map(|name| std::fs::read_to_string(root.join(name)).expect("a document"));
        let mut count = 0;
        let texts = PAGES
            .iter()
            .map(|(_, _, text)| *text)
            .chain(others.iter().map(String::as_str));
        for (line, is_whole) in texts.flat_map(commands) {
            let Some(mut arguments) = arguments(&line) else {
                continue;
            };
            // In text a word in capitals stands for any: `proprio ctl tare SENSOR`.
            if !is_whole {
                arguments.push("--help".into());
            }
            let parsed =
                CommandLine::try_parse_from(["proprio".to_owned()].into_iter().chain(arguments));
            let problem = parsed
                .err()
                .filter(|error| error.kind() != ErrorKind::DisplayHelp);
            assert!(
                problem.is_none(),
                "`{line}`: {}",
                problem.map_or_else(String::new, |e| e.to_string())
            );
            count += 1;
        }
        assert!(count > 80, "{count} commands");
    }
}
