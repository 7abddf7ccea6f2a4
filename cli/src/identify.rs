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
use proprio_estimator::config::Config;
use proprio_estimator::export;
use proprio_estimator::setup::Setup;
use proprio_identification::robot::IdentificationInput;
use proprio_identification::{LogRole, Outcome, Progress, Severity, Verdict, identify};
use std::fs;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

/// `proprio identify`.
#[derive(clap::Args)]
pub(crate) struct IdentifyArgs {
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
pub(crate) fn run(args: &IdentifyArgs) -> anyhow::Result<()> {
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
    let (config, setup) = Setup::load(&args.config, |config| {
        // Identification starts from the URDF, not from parameters identified earlier.
        config.parameters = None;
        config.identification.enabled = false;
    })?;
    let train = args.samples.iter().map(|f| (f, LogRole::Train));
    let validate = args.validate.iter().map(|f| (f, LogRole::Validate));
    let run = IdentificationRun {
        config_file: &args.config,
        // Read now: it may be a result of an earlier run, which is removed below.
        urdf: Model::read_text(&config.model)?,
        config,
        setup,
        files: train.chain(validate).collect(),
        bar: progress_bar(),
    };
    let outcome = run.identify(out)?;
    let advice = Advice::of(&outcome);
    let mut json = summary::summary(&outcome, &advice);
    let found = match advice.grade {
        Grade::Reject => Vec::new(),
        _ => run.write_parameters(&outcome, out)?,
    };
    run.bar.finish_and_clear();
    json["drives"] = drives::in_json(&found);
    let mut text = serde_json::to_string_pretty(&json)?;
    text.push('\n');
    // The summary is written last: if it exists, the others do.
    write(out, "report.html", &page::page(&outcome, &advice))?;
    write(out, "summary.json", &text)?;
    print_warnings(&outcome, &found);
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

/// A run: the configuration and the logs that it identifies from.
struct IdentificationRun<'a> {
    config_file: &'a Path,
    config: Config,
    setup: Setup,
    urdf: String,
    files: Vec<(&'a PathBuf, LogRole)>,
    bar: ProgressBar,
}

impl IdentificationRun<'_> {
    fn show(&self, step: &str, done: f64) {
        self.bar.set_position((done * 1000.0) as u64);
        self.bar.set_message(step.to_owned());
    }

    /// Reads the logs, and identifies; the results of an earlier run are removed from `out`.
    fn identify(&self, out: &Path) -> anyhow::Result<Outcome> {
        let mut tables = Vec::new();
        for (file, _) in &self.files {
            tables.push(open(file, self.config_file, &self.setup)?);
        }
        // All inputs are open.
        remove_earlier(out)?;
        let names = names(&self.files);
        // Reading takes a fifth of the time.
        let reading = 0.2;
        let mut datasets = Vec::new();
        for (((_, role), table), name) in self.files.iter().zip(&mut tables).zip(names) {
            let done = reading * datasets.len() as f64 / self.files.len() as f64;
            self.show(&format!("reading {name}"), done);
            datasets.push(read(&self.setup, &name, *role, table)?);
        }
        let mut progress = |at: &Progress| self.show(&at.step, reading + (1.0 - reading) * at.done);
        let inputs = &self.config.identification.inputs;
        let result = identify(&self.setup.robot, datasets, inputs, &mut progress);
        if result.is_err() {
            self.bar.finish_and_clear();
        }
        Ok(result?)
    }

    /// Writes parameters.toml and identified.urdf; returns what was found of the drives.
    fn write_parameters(
        &self,
        outcome: &Outcome,
        out: &Path,
    ) -> anyhow::Result<Vec<drives::Found>> {
        let setup = &self.setup;
        let program = concat!("proprio ", env!("CARGO_PKG_VERSION"));
        let mut parameters = export::parameters(outcome, &setup.robot, program)?;
        let mut found = Vec::new();
        // What was identified from torques is no opinion of its own on them.
        let is_second = !self
            .config
            .identification
            .inputs
            .contains(&IdentificationInput::Torque)
            && !setup.robot.structure.sensors().is_empty();
        if is_second {
            self.show("drives", 1.0);
            found = drives::identify(setup, &parameters, outcome, &self.files, self.config_file)
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
            .urdf(&self.urdf, &setup.robot)
            .with_context(|| self.config.model.display().to_string())?;
        write(out, "identified.urdf", &urdf)?;
        Ok(found)
    }
}

/// Makes the folder of the results, and removes those of an earlier run, which could be mistaken
/// for results of this one.
fn remove_earlier(out: &Path) -> anyhow::Result<()> {
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
    Ok(())
}

/// Says what was found in the logs, and what is odd about the drives.
fn print_warnings(outcome: &Outcome, found: &[drives::Found]) {
    for (log, finding) in findings(outcome).filter(|(_, f)| f.severity > Severity::Note) {
        let place = log.map(|l| format!("{}: ", l.file)).unwrap_or_default();
        eprintln!(
            "{}: {place}{}",
            summary::severity(finding.severity),
            sentence(&finding.text)
        );
    }
    for warning in drives::warnings(found) {
        eprintln!("warning: {warning}");
    }
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
