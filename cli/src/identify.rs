//! `proprio identify`: recorded logs to inertial parameters, with a report.
//!
//! Writes into one folder, each file atomically: `summary.json` (for programs: [`summary`]),
//! `parameters.toml`, `identified.urdf` and `report.html` (for a person). If nothing can be
//! identified, or what was identified explains too little, is no better than the CAD, or comes from
//! a wrong configuration, summary and report give the reason, there are no parameters, and the
//! program exits with 1.

pub(crate) mod advice;
#[cfg(test)]
mod example;
mod page;
pub(crate) mod summary;

use crate::convert::check_columns;
use advice::{Advice, Grade, findings, sentence};
use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use proprio_dynamics::model::Model;
use proprio_estimator::setup::Setup;
use proprio_estimator::{export, reading};
use proprio_identification::{Options, Outcome, Progress, Role, Severity, Verdict, identify};
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Cursor, IsTerminal, Read};
use std::path::{Path, PathBuf};

/// `proprio identify`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// estimator.toml
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// A table of samples to identify from; may be given several times
    #[arg(long, alias = "log", value_name = "FILE", required = true)]
    samples: Vec<PathBuf>,
    /// A table of samples for validation, not used for training; may be given several times
    #[arg(long, value_name = "FILE")]
    validate: Vec<PathBuf>,
    /// Folder for summary.json, parameters.toml, identified.urdf and report.html
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// Files that a run writes.
const FILES: [&str; 4] = [
    "summary.json",
    "parameters.toml",
    "identified.urdf",
    "report.html",
];

/// Identifies.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let (config, setup) = proprio_estimator::daemon::load(&args.config, |config| {
        // Identification starts from the URDF, not from parameters identified earlier.
        config.parameters = None;
        config.identification.enabled = false;
    })?;
    // Read now: it may be a result of an earlier run, which is removed below.
    let urdf = Model::read_text(&config.model)?;
    let files: Vec<(&PathBuf, Role)> = args
        .samples
        .iter()
        .map(|f| (f, Role::Train))
        .chain(args.validate.iter().map(|f| (f, Role::Validate)))
        .collect();
    let mut tables = Vec::new();
    for (file, _) in &files {
        tables.push(open(file, &args.config, &setup)?);
    }
    // All inputs are open. Remove the results of an earlier run, which could be mistaken for
    // results of this one.
    fs::create_dir_all(&args.out)
        .with_context(|| format!("{}: cannot be created", args.out.display()))?;
    for name in FILES {
        let file = args.out.join(name);
        match fs::remove_file(&file) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(error)
                    .with_context(|| format!("{}: cannot be replaced", file.display()));
            }
            _ => {}
        }
    }

    let names = names(&files);
    let options = Options {
        inputs: config.identification.inputs.clone(),
    };
    let bar = progress_bar();
    let show = |step: &str, done: f64| {
        bar.set_position((done * 1000.0) as u64);
        bar.set_message(step.to_owned());
    };
    // Reading takes a fifth of the time.
    let of_reading = 0.2;
    let mut datasets = Vec::new();
    for (number, (((_, role), table), name)) in files.iter().zip(&mut tables).zip(names).enumerate()
    {
        show(
            &format!("reading {name}"),
            of_reading * number as f64 / files.len() as f64,
        );
        let dataset = reading::dataset_or_unreadable(&setup.robot, &name, *role, table);
        datasets.push(dataset.with_context(|| name.clone())?);
    }
    let result = identify(
        &setup.robot,
        datasets,
        &options,
        &mut |progress: &Progress| {
            show(
                &progress.step,
                of_reading + (1.0 - of_reading) * progress.done,
            );
        },
    );
    bar.finish_and_clear();
    let outcome = result?;

    let advice = Advice::of(&outcome);
    let json = summary::summary(&outcome, &advice);
    let mut text = serde_json::to_string_pretty(&json)?;
    text.push('\n');
    if advice.grade != Grade::Reject {
        let parameters = export::parameters(
            &outcome,
            &setup.robot,
            concat!("proprio ", env!("CARGO_PKG_VERSION")),
        )?;
        let file = args.out.join("parameters.toml");
        parameters
            .save(&file)
            .with_context(|| file.display().to_string())?;
        let urdf = parameters
            .urdf(&urdf, &setup.robot)
            .with_context(|| config.model.display().to_string())?;
        write(&args.out, "identified.urdf", &urdf)?;
    }
    // The summary is written last: if it exists, the others do.
    write(&args.out, "report.html", &page::page(&outcome, &advice))?;
    write(&args.out, "summary.json", &text)?;
    for (log, finding) in findings(&outcome).filter(|(_, f)| f.severity > Severity::Note) {
        let place = log.map(|l| format!("{}: ", l.file)).unwrap_or_default();
        eprintln!(
            "{}: {place}{}",
            summary::severity(finding.severity),
            sentence(&finding.text)
        );
    }
    if args.json {
        print_line!("{json}");
    } else {
        print_outcome(&outcome, &advice, &args.out);
    }
    if let Verdict::Nothing(reason) = &outcome.verdict {
        bail!(
            "nothing was identified: {}",
            reason.trim().trim_end_matches('.')
        );
    }
    if advice.grade == Grade::Reject {
        bail!(
            "the result was rejected, and no parameters were written: {} gives the reasons",
            args.out.join("report.html").display()
        );
    }
    Ok(())
}

/// Opens a log and checks its columns.
fn open(file: &Path, config: &Path, setup: &Setup) -> anyhow::Result<impl Read + Send + use<>> {
    let mut table = BufReader::with_capacity(
        1 << 18,
        File::open(file).with_context(|| format!("{}: cannot be read", file.display()))?,
    );
    let mut header = Vec::new();
    // Skip blank lines before the header.
    while header.trim_ascii().is_empty() {
        let read = table
            .read_until(b'\n', &mut header)
            .with_context(|| format!("{}: cannot be read", file.display()))?;
        if read == 0 {
            break;
        }
    }
    check_columns(&header, file, config, setup)?;
    Ok(Cursor::new(header).chain(table))
}

/// Names of the logs: file names, with as many parent folders as make them unique.
fn names(files: &[(&PathBuf, Role)]) -> Vec<String> {
    let short = |file: &Path, parts: usize| -> String {
        let all: Vec<_> = file
            .components()
            .map(|c| c.as_os_str().to_string_lossy())
            .collect();
        all.get(all.len().saturating_sub(parts)..)
            .unwrap_or_default()
            .join("/")
    };
    files
        .iter()
        .map(|(file, _)| {
            let most = file.components().count();
            let alone = |parts: &usize| {
                files
                    .iter()
                    .filter(|(f, _)| short(f, *parts) == short(file, *parts))
                    .count()
                    == 1
            };
            let told = (1..=most).find(alone).map(|parts| short(file, parts));
            told.unwrap_or_else(|| file.display().to_string())
        })
        .collect()
}

/// A progress bar if stderr is a terminal.
fn progress_bar() -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    ProgressBar::new(1000).with_style(
        ProgressStyle::with_template("{bar:40} {percent} % {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_bar()),
    )
}

/// Writes a file of the result atomically.
fn write(folder: &Path, name: &str, text: &str) -> anyhow::Result<()> {
    let file = folder.join(name);
    proprio_estimator::files::replace(&file, text, 0o644)
        .with_context(|| format!("{}: cannot be written", file.display()))
}

/// The result in a few lines.
fn print_outcome(outcome: &Outcome, advice: &Advice, out: &Path) {
    print_line!(
        "{}: {}",
        outcome.robot,
        advice.grade.headline().to_lowercase()
    );
    for line in &advice.why {
        print_line!("  {line}");
    }
    if !advice.next.is_empty() {
        print_line!("next:");
    }
    for line in &advice.next {
        print_line!("- {line}");
    }
    let written: Vec<&str> = FILES
        .into_iter()
        .filter(|name| out.join(name).exists())
        .collect();
    print_line!("{}: {}", out.display(), written.join(", "));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logs_have_the_shortest_unique_names() {
        let files: Vec<PathBuf> = [
            "/a/one/x.csv",
            "/a/two/x.csv",
            "y.csv",
            "/a/two/y.csv",
            "/z.csv",
            "/z.csv",
        ]
        .map(PathBuf::from)
        .to_vec();
        let files: Vec<(&PathBuf, Role)> = files.iter().map(|f| (f, Role::Train)).collect();
        assert_eq!(
            names(&files),
            [
                "one/x.csv",
                "two/x.csv",
                "y.csv",
                "two/y.csv",
                "/z.csv",
                "/z.csv"
            ]
        );
    }
}
