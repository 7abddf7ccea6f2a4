//! The subcommands that convert files: decode, encode, estimate.

use crate::identify::advice::sentence;
use crate::samples;
use anyhow::{Context, bail};
use clap::error::ErrorKind;
use proprio_estimator::assessment::{Assessment, Assessor, Coverage};
use proprio_estimator::config::InvalidConfig;
use proprio_estimator::sample_log::{self, SampleLogError};
use proprio_estimator::setup::Setup;
use proprio_estimator::{files, offline as estimates};
use proprio_gateway::log::{LogFormat, Stamps};
use proprio_gateway::offline::{self, DecodeReport};
use proprio_gateway::plan::Plan;
use proprio_identification::{LogRole, implausible};
use proprio_topics::csv::{self, Columns, TableReport};
use serde_json::json;
use std::fs::File;
use std::io::{BufReader, BufWriter, IsTerminal, Read, Write};
use std::path::{Path, PathBuf};

/// `proprio decode`.
#[derive(clap::Args)]
pub(crate) struct DecodeArgs {
    /// gateway.toml, which lists the devices; its sources are not opened
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// The recorded log: candump, Vector ASC or BLF, PEAK TRC, or CSV of python-can, whatever its
    /// name; - for standard input
    #[arg(long, value_name = "FILE")]
    log: PathBuf,
    #[command(flatten)]
    stamps: StatedStamps,
    /// The table to write; - for standard output
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Write all columns, also those beside motion and load: torques and currents of drives,
    /// temperatures, gauges, orientation, motor states
    #[arg(long)]
    all: bool,
    /// Print a summary of the conversion as JSON
    #[arg(long)]
    json: bool,
}

/// What the stamps of a recorded log mean.
#[derive(clap::Args)]
pub(crate) struct StatedStamps {
    /// What the relative time stamps of a candump log count from: its start (candump -t z, or -t a
    /// with a clock that was not set), or each from the line before (-t d); default: the whole log
    /// tells
    #[arg(long, value_name = "MEANING")]
    stamps: Option<Meaning>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Meaning {
    SinceStart,
    SincePrevious,
}

impl StatedStamps {
    pub(crate) const fn meaning(&self) -> Stamps {
        match self.stamps {
            None => Stamps::Detect,
            Some(Meaning::SinceStart) => Stamps::SinceStart,
            Some(Meaning::SincePrevious) => Stamps::SincePrevious,
        }
    }
}

/// `proprio encode`.
#[derive(clap::Args)]
pub(crate) struct EncodeArgs {
    /// gateway.toml, which lists the devices
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// The table of samples; - for standard input
    #[arg(long, value_name = "FILE")]
    samples: PathBuf,
    /// The log to write, in candump's log format; - for standard output
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Print a summary of the conversion as JSON
    #[arg(long)]
    json: bool,
}

/// `proprio estimate`.
#[derive(clap::Args)]
pub(crate) struct EstimateArgs {
    /// estimator.toml; default: the one that a recording has taken along
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Identified parameters and offsets (parameters.toml) to use instead of those of the URDF, of
    /// estimator.toml, and of the file that it names
    #[arg(long, value_name = "FILE")]
    parameters: Option<PathBuf>,
    /// The table of samples; - for standard input
    #[arg(long, alias = "log", value_name = "FILE")]
    samples: PathBuf,
    /// The table of estimates to write; - for standard output
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Assess the estimates: F/T readings predicted with the parameters in use and with the CAD's;
    /// residuals and errors to measured torques against the stated standard deviations
    #[arg(long)]
    assess: bool,
    /// Print a summary of the conversion as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn input(path: &Path) -> anyhow::Result<Box<dyn Read + Send>> {
    if path == Path::new("-") {
        return Ok(Box::new(std::io::stdin()));
    }
    let file = File::open(path).with_context(|| format!("{}: cannot be read", path.display()))?;
    let length = file.metadata().map_or(0, |m| m.len());
    // Show progress if standard error is a terminal.
    if length > 64 << 20 && std::io::stderr().is_terminal() {
        let bar = indicatif::ProgressBar::new(length).with_style(
            indicatif::ProgressStyle::with_template("{bar:40} {bytes}/{total_bytes} {eta}")
                .unwrap_or_else(|_| indicatif::ProgressStyle::default_bar()),
        );
        return Ok(Box::new(bar.wrap_read(file)));
    }
    Ok(Box::new(file))
}

/// The output file of a conversion. It is renamed to its final name when complete: an error leaves
/// no partial table, and a file that is both input and output is not destroyed before it is read.
pub(crate) struct OutputFile {
    writer: Option<BufWriter<Marked>>,
    new: Option<(tempfile::NamedTempFile, PathBuf)>,
}

/// A write error, to distinguish it from a read error of the input.
#[derive(Debug)]
struct Unwritable(std::io::Error);

impl std::fmt::Display for Unwritable {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for Unwritable {}

/// Records errors of the output.
pub(crate) struct Marked(Box<dyn Write>);

impl Write for Marked {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0
            .write(bytes)
            .map_err(|e| std::io::Error::new(e.kind(), Unwritable(e)))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0
            .flush()
            .map_err(|e| std::io::Error::new(e.kind(), Unwritable(e)))
    }
}

/// A conversion's error with the file concerned.
fn with_file(error: offline::ConversionError, input: &Path, output: &Path) -> anyhow::Error {
    match error {
        offline::ConversionError::Io(e)
            if e.get_ref()
                .and_then(|e| e.downcast_ref::<Unwritable>())
                .is_some() =>
        {
            anyhow::anyhow!("{}: cannot be written: {e}", output.display())
        }
        error => anyhow::Error::from(error).context(input.display().to_string()),
    }
}

impl OutputFile {
    pub(crate) fn new(path: &Path) -> anyhow::Result<Self> {
        let special = std::fs::metadata(path).is_ok_and(|m| !m.is_file());
        let unwritable = || format!("{}: cannot be written", path.display());
        let (writer, new): (Box<dyn Write>, _) = if path == Path::new("-") {
            (Box::new(std::io::stdout().lock()), None)
        } else if special {
            // A pipe or /dev/null: write directly, there is nothing to replace.
            (Box::new(File::create(path).with_context(unwritable)?), None)
        } else {
            let new = files::begin(path).with_context(unwritable)?;
            let writer = new.as_file().try_clone().with_context(unwritable)?;
            (Box::new(writer), Some((new, path.to_owned())))
        };
        Ok(Self {
            writer: Some(BufWriter::with_capacity(1 << 18, Marked(writer))),
            new,
        })
    }

    pub(crate) fn writer(&mut self) -> &mut BufWriter<Marked> {
        #[allow(
            clippy::expect_used,
            reason = "taken only by finish, which consumes self"
        )]
        self.writer
            .as_mut()
            .expect("an output that is not finished has a writer")
    }

    pub(crate) fn finish(mut self) -> anyhow::Result<()> {
        if let Some(mut writer) = self.writer.take() {
            writer.flush().context("cannot be written")?;
        }
        if let Some((new, path)) = self.new.take() {
            // The result gets the permissions of a normal new file.
            files::end(new, &path, 0o644)
                .with_context(|| format!("{}: cannot be written", path.display()))?;
        }
        Ok(())
    }
}

fn report_table(log: &Path, report: &TableReport) {
    for bad in &report.bad {
        eprintln!(
            "{}: line {}: skipped: {}",
            log.display(),
            bad.line,
            bad.reason
        );
    }
    if report.bad_rows > report.bad.len() as u64 {
        eprintln!("{}: {} rows skipped in all", log.display(), report.bad_rows);
    }
    if !report.unknown_columns.is_empty() {
        eprintln!(
            "{}: columns not used: {}",
            log.display(),
            report.unknown_columns.join(", ")
        );
    }
}

/// Decodes a log.
pub(crate) fn decode(args: &DecodeArgs) -> anyhow::Result<()> {
    let plan = Plan::load(&args.config)?;
    let log = samples::log(input(&args.log)?, &args.log)
        .with_context(|| args.log.display().to_string())?;
    let log = BufReader::with_capacity(1 << 18, log);
    let mut out = OutputFile::new(&args.out)?;
    let columns = if args.all {
        Columns::All
    } else {
        Columns::Main
    };
    let stamps = args.stamps.meaning();
    let report = offline::decode_with(&plan, log, stamps, out.writer(), columns)
        .map_err(|e| with_file(e, &args.log, &args.out))?;
    // A result without rows does not replace an existing file.
    if report.samples > 0 {
        out.finish()
            .with_context(|| args.out.display().to_string())?;
    }
    print_decoded(args, &report);
    if report.samples == 0 {
        bail!(
            "{}: no sample in {} frames: {}",
            args.log.display(),
            report.frames,
            why_none(&report)
        );
    }
    Ok(())
}

/// Says what was decoded, and what not.
fn print_decoded(args: &DecodeArgs, report: &DecodeReport) {
    let log = args.log.display();
    for bad in &report.bad {
        eprintln!("{log}: skipped: {bad}");
    }
    let notes = [&report.doubt, &report.several, &report.step_back];
    for note in notes.into_iter().flatten() {
        eprintln!("{log}: {note}");
    }
    if report.dropped > 0 {
        eprintln!(
            "{log}: {} frames were lost during the recording, as it says",
            report.dropped
        );
    }
    let parts = report.format.map_or("lines", LogFormat::parts);
    if report.bad_lines > report.bad.len() as u64 {
        eprintln!("{log}: {} {parts} skipped in all", report.bad_lines);
    }
    for device in &report.devices {
        if let Some(refusal) = &device.refusal {
            eprintln!("{}: refused: {refusal}", device.name);
        }
        if let Some(lack) = &device.lack {
            eprintln!("{}: without a value: {lack}", device.name);
        }
        for (counter, count) in &device.counts {
            eprintln!("{}: {}: {count}", device.name, counter.word());
        }
    }
    if args.json {
        return print_json(&args.out, &decoded_json(report));
    }
    eprintln!(
        "{} frames, {} samples; {} frames of unknown devices, {} of other interfaces, {} {parts} \
         skipped",
        report.frames, report.samples, report.unclaimed, report.other_interfaces, report.bad_lines
    );
    if !report.other_names.is_empty() {
        // Of an adapter named by its serial number the log does not say which interface it was.
        eprintln!(
            "other interfaces: {}; a bus takes the frames of its interface, and of an interface \
             with the bus's own name",
            report.other_names.join(", ")
        );
    }
}

fn decoded_json(report: &DecodeReport) -> serde_json::Value {
    let devices = report.devices.iter().map(|d| {
        let counts = d.counts.iter();
        let counts: serde_json::Map<_, _> = counts
            .map(|(c, n)| (c.word().to_owned(), json!(n)))
            .collect();
        json!({
            "name": d.name, "frames": d.frames, "readings": d.readings, "counts": counts,
            "refusal": d.refusal, "lack": d.lack,
        })
    });
    json!({
        "format": report.format.map(|format| format.to_string()), "stamps": report.stamps.word(),
        "frames": report.frames, "samples": report.samples, "unclaimed": report.unclaimed,
        "bad_lines": report.bad_lines, "other_interfaces": report.other_interfaces,
        "other_interface_names": report.other_names,
        "error_frames": report.error_frames, "dropped": report.dropped,
        "out_of_order": report.out_of_order, "devices": devices.collect::<Vec<_>>(),
    })
}

/// Why a log gives no sample.
fn why_none(report: &DecodeReport) -> &'static str {
    let mut devices = report.devices.iter();
    if report.other_interfaces == report.frames {
        "its interfaces are not buses of the configuration"
    } else if devices.clone().any(|device| device.refusal.is_some()) {
        "devices were refused: that is said of each"
    } else if devices.any(|device| device.frames > 0) {
        "the frames of its devices make no whole reading: what was wrong with them is counted"
    } else {
        "are the devices' addresses in gateway.toml right?"
    }
}

/// Encodes a table.
pub(crate) fn encode(args: &EncodeArgs) -> anyhow::Result<()> {
    let plan = Plan::load(&args.config)?;
    let samples = samples::table(input(&args.samples)?, &args.samples)?;
    let mut out = OutputFile::new(&args.out)?;
    let report = offline::encode(&plan, samples, out.writer())
        .map_err(|e| with_file(e, &args.samples, &args.out))?;
    if report.samples > 0 {
        out.finish()
            .with_context(|| args.out.display().to_string())?;
    }
    report_table(&args.samples, &report.table);
    if !report.unknown_channels.is_empty() {
        eprintln!(
            "{}: not in {}: {}",
            args.samples.display(),
            args.config.display(),
            report.unknown_channels.join(", ")
        );
    }
    if let Some(first) = &report.first_refusal {
        eprintln!(
            "{}: {} samples not encoded; the first is {first}",
            args.samples.display(),
            report.refused
        );
    }
    if args.json {
        let summary = json!({
            "frames": report.frames, "samples": report.samples, "refused": report.refused,
            "rows": report.table.rows, "bad_rows": report.table.bad_rows,
            "unknown_channels": report.unknown_channels,
        });
        print_json(&args.out, &summary);
    } else {
        eprintln!("{} samples, {} frames", report.samples, report.frames);
    }
    if report.samples == 0 {
        bail!("{}: no sample could be encoded", args.samples.display());
    }
    Ok(())
}

/// Checks that a table's header (its first line) has a column for every channel that the estimator
/// reads.
///
/// # Errors
/// An [`InvalidConfig`]: the configuration does not match the log.
pub(crate) fn check_header(
    header: &[u8],
    log: &Path,
    config: &Path,
    setup: &Setup,
) -> anyhow::Result<()> {
    let reader = csv::TableReader::new(header).with_context(|| log.display().to_string())?;
    sample_log::check_columns(&setup.robot, reader.series(), |_| true)
        .map_err(|missing| unfit(config, log, &missing).into())
}

/// The error that the configuration does not match the log.
pub(crate) fn unfit(config: &Path, log: &Path, error: &dyn std::error::Error) -> InvalidConfig {
    InvalidConfig {
        file: config.to_owned(),
        problem: format!("{}: {error}", log.display()),
    }
}

/// The estimator's configuration for a log.
pub(crate) struct Configured {
    /// The file.
    pub(crate) config: PathBuf,
    pub(crate) setup: Setup,
    /// The files that a recording has taken along.
    pub(crate) folder: Option<tempfile::TempDir>,
}

impl Configured {
    /// The one that is given, or the one that the recording has taken along; with other identified
    /// parameters, if they are given.
    pub(crate) fn new(
        config: Option<&Path>,
        parameters: Option<&Path>,
        samples: &Path,
    ) -> anyhow::Result<Self> {
        let folder = match is_file(samples) {
            true => samples::files_in(samples)?,
            false => None,
        };
        let in_folder = folder.as_ref();
        let taken_along = in_folder.map(|folder| folder.path().join("estimator.toml"));
        let taken_along = taken_along.filter(|config| config.is_file());
        let Some(config) = config.map(Path::to_owned).or(taken_along) else {
            let text = "give --config estimator.toml: only a recording made with `record \
                        --config` has its own\n";
            clap::Error::raw(ErrorKind::MissingRequiredArgument, text).exit();
        };
        let (_, setup) = Setup::load(&config, |config| {
            // The command line overrides the configuration.
            if let Some(parameters) = parameters {
                config.parameters = Some(parameters.to_owned());
            }
        })?;
        Ok(Self {
            config,
            setup,
            folder,
        })
    }
}

/// Estimates from a table.
pub(crate) fn estimate(args: &EstimateArgs) -> anyhow::Result<()> {
    let configured = Configured::new(
        args.config.as_deref(),
        args.parameters.as_deref(),
        &args.samples,
    )?;
    let (config, setup) = (&configured.config, configured.setup);
    warn_of_implausible(args, &setup);
    let mut assessor = args
        .assess
        .then(|| assessor(args, config, &setup))
        .transpose()?;
    let log = samples::table(input(&args.samples)?, &args.samples)?;
    let mut out = OutputFile::new(&args.out)?;
    let report = estimates::estimate(setup, log, out.writer(), assessor.as_mut());
    let report = match report {
        Ok(report) => report,
        Err(error @ estimates::EstimationError::MissingChannels(_)) => {
            return Err(unfit(config, &args.samples, &error).into());
        }
        Err(estimates::EstimationError::Write(error)) => {
            bail!("{}: cannot be written: {error}", args.out.display())
        }
        Err(error) => return Err(error).with_context(|| args.samples.display().to_string()),
    };
    if report.estimates > 0 {
        out.finish()
            .with_context(|| args.out.display().to_string())?;
    }
    report_table(&args.samples, &report.log);
    print_trouble(args, config, &report);
    let assessment = assessor.map(Assessor::finish);
    print_estimated(args, &report, assessment.as_ref());
    if report.estimates == 0 {
        bail!(
            "{}: the trigger channel has no sample, so there is no estimate",
            args.samples.display()
        );
    }
    Ok(())
}

/// Says what is odd about samples and configuration.
fn print_trouble(args: &EstimateArgs, config: &Path, report: &estimates::EstimateReport) {
    let (samples, config) = (args.samples.display(), config.display());
    if !report.unused_channels.is_empty() {
        eprintln!(
            "{samples}: not in {config}: {}",
            report.unused_channels.join(", ")
        );
    }
    let [late, backward, not_finite] = report.dropped;
    if late + backward + not_finite > 0 {
        eprintln!(
            "{samples}: samples dropped, the first in line {}: {late} late (stamped before an \
             estimate that was already made), {backward} not later than their channel's last, \
             {not_finite} not finite",
            report.first_dropped.unwrap_or_default()
        );
    }
    if let Some((line, from, to)) = report.step_back {
        eprintln!(
            "{samples}: at line {line} the time steps back by {} s, from {from} s to {to} s: what \
             is not later than its channel's last sample is dropped. Cut the table there, and \
             estimate from the parts one by one",
            from.saturating_sub(to)
        );
    }
    for (t, likelier) in &report.likelier {
        eprintln!(
            "{samples}: from {t} s on the readings contradict {config}: more likely, {likelier}; \
             torques that depend on it are withheld"
        );
    }
}

/// Says what was estimated, and how good that is if it was assessed.
fn print_estimated(
    args: &EstimateArgs,
    report: &estimates::EstimateReport,
    assessment: Option<&Assessment>,
) {
    let withheld: u64 = report.withheld.values().sum();
    if args.json {
        let [late, backward, not_finite] = report.dropped;
        let mut summary = json!({
            "estimates": report.estimates, "torques_withheld": withheld,
            "withheld_by_reason": report.withheld,
            "rows": report.log.rows, "bad_rows": report.log.bad_rows, "late": late,
            "backward": backward, "not_finite": not_finite,
            "likelier": report.likelier.iter().map(|(t, text)| json!({
                "t": t.seconds(), "likelier": text,
            })).collect::<Vec<_>>(),
        });
        if let Some(assessment) = assessment {
            summary["assessment"] = assessment_json(assessment);
        }
        return print_json(&args.out, &summary);
    }
    let reasons: Vec<String> = (report.withheld.iter())
        .map(|(reason, count)| format!("{count} {}", reason.replace('_', " ")))
        .collect();
    eprintln!(
        "{} estimates from {} rows; {withheld} torques withheld{}{}",
        report.estimates,
        report.log.rows,
        if reasons.is_empty() { "" } else { ": " },
        reasons.join(", ")
    );
    if let Some(assessment) = assessment {
        print_assessment(assessment);
    }
}

/// The part of a log that is checked for implausible channels \[bytes\]: half an hour of a robot's
/// samples, which fits in memory.
const CHECKED: u64 = 256 << 20;

/// Whether a log can be read twice; a pipe cannot.
pub(crate) fn is_file(log: &Path) -> bool {
    log != Path::new("-") && std::fs::metadata(log).is_ok_and(|data| data.is_file())
}

/// Warns of implausible channels in the log before the estimation. Errors of reading are reported
/// by the estimation itself; a log that can be read only once is not checked.
fn warn_of_implausible(args: &EstimateArgs, setup: &Setup) {
    let log = is_file(&args.samples)
        .then(|| File::open(&args.samples).ok())
        .flatten();
    let robot = &setup.robot;
    let read =
        |log: File| sample_log::dataset(robot, "", LogRole::Validate, log.take(CHECKED)).ok();
    let found = log
        .and_then(read)
        .map(|dataset| implausible(robot, dataset));
    for finding in found.into_iter().flatten() {
        eprintln!(
            "warning: {}: {}",
            args.samples.display(),
            sentence(&finding.text)
        );
    }
}

/// Reads the log once before the estimation.
fn assessor(args: &EstimateArgs, config: &Path, setup: &Setup) -> anyhow::Result<Assessor> {
    let log = samples::table(input(&args.samples)?, &args.samples)?;
    if !is_file(&args.samples) {
        bail!(
            "--assess reads the table twice: give a file with --samples, no standard input or pipe"
        );
    }
    Assessor::new(setup, log).map_err(|error| match error {
        SampleLogError::MissingChannels(_) => unfit(config, &args.samples, &error).into(),
        error => anyhow::Error::from(error).context(args.samples.display().to_string()),
    })
}

fn assessment_json(assessment: &Assessment) -> serde_json::Value {
    let coverage = |of: &[(String, Coverage)]| -> serde_json::Map<_, _> {
        let entry = |(name, c): &(String, Coverage)| {
            let figures =
                json!({ "rms": c.rms, "within_two_deviations": c.covered, "count": c.count });
            (name.clone(), figures)
        };
        of.iter().map(entry).collect()
    };
    json!({
        "predicted": assessment.predicted, "changes": assessment.changes,
        "residuals": coverage(&assessment.residuals), "torques": coverage(&assessment.torques),
    })
}

fn print_assessment(assessment: &Assessment) {
    let Assessment {
        predicted,
        changes,
        residuals,
        torques,
    } = assessment;
    let [once, drifting] = [
        &predicted.relative_error,
        &predicted.relative_error_with_drift,
    ];
    if once.cad.is_finite() {
        let percent =
            [once.identified, once.cad, drifting.identified, drifting.cad].map(|x| 100.0 * x);
        let [own, cad, own_drifting, cad_drifting] = percent;
        let how = match changes {
            0 => "the given parameters".to_owned(),
            1 => "the parameters in use (changed once)".to_owned(),
            _ => format!("the parameters in use (changed {changes} times)"),
        };
        eprintln!(
            "F/T prediction error: {own:.1} % with {how}, {cad:.1} % with the CAD's; \
             {own_drifting:.1} % and {cad_drifting:.1} % with drifting offsets"
        );
    } else {
        eprintln!(
            "no F/T reading can be predicted: no sensor, a contact that is always present, or no \
             usable sample"
        );
    }
    for (top, c) in residuals {
        eprintln!(
            "residual of the sub-tree at {top}: {:.1} % of {} instants within two standard \
             deviations",
            100.0 * c.covered,
            c.count
        );
    }
    for (joint, c) in torques {
        eprintln!(
            "torque of {joint}: {:.4} Nm (RMS) from the measured torque, {:.1} % of {} within two \
             standard deviations",
            c.rms,
            100.0 * c.covered,
            c.count
        );
    }
}

/// JSON goes to standard output, unless the table itself does.
fn print_json(out: &Path, summary: &serde_json::Value) {
    if out == Path::new("-") {
        eprintln!("{summary}");
    } else {
        print_line!("{summary}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_gateway::offline::DeviceReport;

    /// Addresses are in doubt only where nothing else is known.
    #[test]
    fn a_log_without_samples_has_its_reason() {
        let why = |other_interfaces, frames, refusal: Option<&str>| {
            why_none(&DecodeReport {
                frames: 9,
                other_interfaces,
                devices: vec![DeviceReport {
                    name: "d".into(),
                    frames,
                    readings: 0,
                    counts: Vec::new(),
                    refusal: refusal.map(str::to_owned),
                    lack: None,
                }],
                ..DecodeReport::default()
            })
        };
        for (why, told) in [
            (why(9, 0, None), "interfaces are not buses"),
            (why(0, 3, Some("object 608F")), "were refused"),
            (why(0, 3, None), "no whole reading"),
            (why(0, 0, None), "addresses"),
        ] {
            assert!(why.contains(told), "{why}");
        }
    }
}
