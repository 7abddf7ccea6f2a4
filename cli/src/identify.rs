//! `proprio identify`: recorded logs to inertial parameters, with a report.
//!
//! Writes into one folder, each file atomically: `summary.json` (for programs: [`summary`]),
//! `parameters.toml`, `identified.urdf` and `report.html` (for a person). If nothing can be
//! identified, or what was identified explains too little, is no better than the CAD, or comes from
//! a wrong configuration, summary and report give the reason, there are no parameters, and the
//! program exits with 1.

pub(crate) mod advice;
mod drives;
#[cfg(test)]
mod example;
mod logs;
mod page;
mod payload;
pub(crate) mod summary;

use advice::{Advice, Grade, findings, sentence};
use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use logs::{names, open, read};
use proprio_dynamics::model::Model;
use proprio_estimator::export;
use proprio_identification::robot::IdentificationInput;
use proprio_identification::{Options, Outcome, Progress, Role, Severity, Verdict, identify};
use std::fs;
use std::io::IsTerminal;
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
    #[arg(long, value_name = "DIR", required_unless_present = "payload")]
    out: Option<PathBuf>,
    /// Identify, instead of the robot, what this link or frame carries in the samples: its mass,
    /// centre of mass and inertia
    #[arg(long, value_name = "LINK", conflicts_with_all = ["validate", "out"])]
    payload: Option<String>,
    /// The robot without the payload: its parameters.toml, or a table of samples, which may be
    /// given several times [default: the parameters that estimator.toml names]
    #[arg(long, value_name = "FILE", requires = "payload")]
    reference: Vec<PathBuf>,
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
    if let Some(name) = &args.payload {
        return payload::run(
            &args.config,
            &args.samples,
            name,
            &args.reference,
            args.json,
        );
    }
    let out = args.out.as_deref().unwrap_or_else(|| Path::new("."));
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
    fs::create_dir_all(out).with_context(|| format!("{}: cannot be created", out.display()))?;
    for name in FILES {
        let file = out.join(name);
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
        datasets.push(read(&setup, &name, *role, table)?);
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
    if result.is_err() {
        bar.finish_and_clear();
    }
    let outcome = result?;

    let advice = Advice::of(&outcome);
    let mut json = summary::summary(&outcome, &advice);
    let mut found = Vec::new();
    if advice.grade != Grade::Reject {
        let mut parameters = export::parameters(
            &outcome,
            &setup.robot,
            concat!("proprio ", env!("CARGO_PKG_VERSION")),
        )?;
        // What was identified from torques is no opinion of its own on them.
        let is_second = !options.inputs.contains(&IdentificationInput::Torque)
            && !setup.robot.structure.sensors().is_empty();
        if is_second {
            show("drives", 1.0);
            found = drives::identify(&setup, &parameters, &outcome, &files, &args.config)
                .unwrap_or_else(|error| {
                    tracing::warn!("the drives give no second opinion: {error:#}");
                    Vec::new()
                });
        }
        let drives = found.iter().filter_map(|(_, drive)| drive.as_ref().ok());
        parameters.set_drives(&drives.cloned().collect::<Vec<_>>())?;
        let file = out.join("parameters.toml");
        parameters
            .save(&file)
            .with_context(|| file.display().to_string())?;
        let urdf = parameters
            .urdf(&urdf, &setup.robot)
            .with_context(|| config.model.display().to_string())?;
        write(out, "identified.urdf", &urdf)?;
    }
    bar.finish_and_clear();
    json["drives"] = drives::in_json(&found);
    let mut text = serde_json::to_string_pretty(&json)?;
    text.push('\n');
    // The summary is written last: if it exists, the others do.
    write(out, "report.html", &page::page(&outcome, &advice))?;
    write(out, "summary.json", &text)?;
    for (log, finding) in findings(&outcome).filter(|(_, f)| f.severity > Severity::Note) {
        let place = log.map(|l| format!("{}: ", l.file)).unwrap_or_default();
        eprintln!(
            "{}: {place}{}",
            summary::severity(finding.severity),
            sentence(&finding.text)
        );
    }
    for warning in drives::warnings(&found) {
        eprintln!("warning: {warning}");
    }
    if args.json {
        print_line!("{json}");
    } else {
        print_outcome(&outcome, &advice, &found, out);
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
            out.join("report.html").display()
        );
    }
    Ok(())
}

/// A progress bar if stderr is a terminal.
pub(crate) fn progress_bar() -> ProgressBar {
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
fn print_outcome(outcome: &Outcome, advice: &Advice, found: &[drives::Found], out: &Path) {
    print_line!(
        "{}: {}",
        outcome.robot,
        advice.grade.headline().to_lowercase()
    );
    for line in &advice.why {
        print_line!("  {line}");
    }
    if let Some(line) = drives::line(found) {
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
