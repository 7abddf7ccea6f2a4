//! `proprio identify`: recorded logs to inertial parameters, with a report.
//!
//! Writes into one folder, each file whole or not at all: `summary.json` (for programs: [`summary`]), `parameters.toml`, `identified.urdf` and `report.html` (for
//! people). Where nothing can be identified there are a summary and a report that say why, and no parameters.

pub(crate) mod advice;
#[cfg(test)]
mod example;
mod page;
pub(crate) mod summary;

use crate::convert::blame_columns;
use advice::{Advice, findings, sentence};
use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use proprio_estimator::config::ConfigError;
use proprio_estimator::identify::{self, IdentifyError, Log, Options, Outcome, Progress, Role, Severity, Verdict};
use proprio_estimator::setup::Setup;
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
    #[arg(long, value_name = "FILE", required = true)]
    log: Vec<PathBuf>,
    /// A table of samples to test the result on, kept out of the fit; may be given several times
    #[arg(long, value_name = "FILE")]
    validate: Vec<PathBuf>,
    /// Where summary.json, parameters.toml, identified.urdf and report.html go
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// What a run writes.
const FILES: [&str; 4] = ["summary.json", "parameters.toml", "identified.urdf", "report.html"];

/// Identifies.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let (config, setup) = proprio_estimator::daemon::load(&args.config, |config| {
        // The URDF's own parameters: those identified earlier are no part of what is identified now. Nor is identification on-line asked for.
        config.parameters = None;
        config.identification.enabled = false;
    })?;
    // Now, because it may be a result of an earlier run.
    let urdf =
        fs::read_to_string(&config.model).with_context(|| format!("{}: can not be read", config.model.display()))?;
    let files: Vec<(&PathBuf, Role)> = args
        .log
        .iter()
        .map(|f| (f, Role::Train))
        .chain(args.validate.iter().map(|f| (f, Role::Validate)))
        .collect();
    let mut tables = Vec::new();
    for (file, _) in &files {
        tables.push(open(file, &args.config, &setup)?);
    }
    // Everything that is read is open: from here on, no result of an earlier run can be taken for one of this.
    fs::create_dir_all(&args.out).with_context(|| format!("{}: can not be made", args.out.display()))?;
    for name in FILES {
        let file = args.out.join(name);
        match fs::remove_file(&file) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(error).with_context(|| format!("{}: can not be replaced", file.display()));
            }
            _ => {}
        }
    }

    let names = names(&files);
    let logs = files
        .iter()
        .zip(&mut tables)
        .zip(names)
        .map(|(((_, role), table), file)| Log {
            file,
            role: *role,
            samples: table,
        })
        .collect();
    let options = Options {
        inputs: config.identification.inputs.clone(),
    };
    let bar = progress_bar();
    let result = identify::identify(&setup, logs, &options, &mut |progress: &Progress| {
        bar.set_position((progress.done * 1000.0) as u64);
        bar.set_message(progress.step.clone());
    });
    bar.finish_and_clear();
    let outcome = result.map_err(|error| match error {
        // Which measurements there are is the configuration's business.
        IdentifyError::NoInputs(problem) => ConfigError {
            file: args.config.clone(),
            problem,
        }
        .into(),
        error => anyhow::Error::from(error),
    })?;

    let advice = Advice::of(&outcome);
    let json = summary::summary(&outcome, &advice);
    let mut text = serde_json::to_string_pretty(&json)?;
    text.push('\n');
    if !matches!(outcome.verdict, Verdict::Nothing(_)) {
        let parameters = identify::parameters(&outcome, &setup, concat!("proprio ", env!("CARGO_PKG_VERSION")))?;
        let file = args.out.join("parameters.toml");
        parameters.save(&file).with_context(|| file.display().to_string())?;
        let urdf = parameters
            .urdf(&urdf, &setup)
            .with_context(|| config.model.display().to_string())?;
        write(&args.out, "identified.urdf", &urdf)?;
    }
    // The summary comes last: where it is, the others are.
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
        say!("{json}");
    } else {
        tell(&outcome, &advice, &args.out);
    }
    if let Verdict::Nothing(reason) = &outcome.verdict {
        bail!("nothing was identified: {}", reason.trim().trim_end_matches('.'));
    }
    Ok(())
}

/// Opens a table, whose columns are checked before anything else is done.
fn open(file: &Path, config: &Path, setup: &Setup) -> anyhow::Result<impl Read + Send + use<>> {
    let mut table = BufReader::with_capacity(
        1 << 18,
        File::open(file).with_context(|| format!("{}: can not be read", file.display()))?,
    );
    let mut header = Vec::new();
    // Blank lines before the header are none of its columns.
    while header.trim_ascii().is_empty() {
        let read = table
            .read_until(b'\n', &mut header)
            .with_context(|| format!("{}: can not be read", file.display()))?;
        if read == 0 {
            break;
        }
    }
    blame_columns(&header, file, config, setup)?;
    Ok(Cursor::new(header).chain(table))
}

/// What logs are called: their file names, with as many folders before them as tell them apart.
fn names(files: &[(&PathBuf, Role)]) -> Vec<String> {
    let short = |file: &Path, parts: usize| -> String {
        let all: Vec<_> = file.components().map(|c| c.as_os_str().to_string_lossy()).collect();
        all.get(all.len().saturating_sub(parts)..).unwrap_or_default().join("/")
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

/// A bar where somebody looks.
fn progress_bar() -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    ProgressBar::new(1000).with_style(
        ProgressStyle::with_template("{bar:40} {percent} % {msg}").unwrap_or_else(|_| ProgressStyle::default_bar()),
    )
}

/// Writes a file of the result; it gets its name when it is complete.
fn write(folder: &Path, name: &str, text: &str) -> anyhow::Result<()> {
    let file = folder.join(name);
    proprio_estimator::files::replace(&file, text, 0o644)
        .with_context(|| format!("{}: can not be written", file.display()))
}

/// The result in a few lines.
fn tell(outcome: &Outcome, advice: &Advice, out: &Path) {
    say!("{}: {}", outcome.robot, advice.grade.headline().to_lowercase());
    for line in &advice.why {
        say!("  {line}");
    }
    if !advice.next.is_empty() {
        say!("next:");
    }
    for line in &advice.next {
        say!("- {line}");
    }
    let written: Vec<&str> = FILES.into_iter().filter(|name| out.join(name).exists()).collect();
    say!("{}: {}", out.display(), written.join(", "));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logs_are_named_by_what_tells_them_apart() {
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
            ["one/x.csv", "two/x.csv", "y.csv", "two/y.csv", "/z.csv", "/z.csv"]
        );
    }
}
