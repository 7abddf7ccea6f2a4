//! `proprio identify --payload`: what a link carries in some logs, compared with parameters of the
//! robot without it, or with logs without it.

use super::advice::{Advice, Grade, sentence};
use super::logs::{names, open, read};
use super::summary::severity;
use anyhow::{Context, bail};
use proprio_dynamics::spatial::Mat3;
use proprio_estimator::config::InvalidConfig;
use proprio_estimator::export;
use proprio_estimator::parameters::Parameters;
use proprio_estimator::setup::{Setup, frame};
use proprio_identification::robot::IdentificationInput;
use proprio_identification::{Dataset, LogRole, Payload, Severity, Verdict, identify, payload};
use std::path::{Path, PathBuf};

/// The components of a tensor of inertia, the diagonal first.
const COMPONENTS: [(&str, (usize, usize)); 6] = [
    ("xx", (0, 0)),
    ("yy", (1, 1)),
    ("zz", (2, 2)),
    ("xy", (0, 1)),
    ("xz", (0, 2)),
    ("yz", (1, 2)),
];

/// Identifies a payload, and prints it.
pub(super) fn run(
    config_file: &Path,
    samples: &[PathBuf],
    name: &str,
    reference: &[PathBuf],
    as_json: bool,
) -> anyhow::Result<()> {
    let mut configured = None;
    let (config, mut setup) = Setup::load(config_file, |config| {
        configured = config.parameters.take();
        config.identification.enabled = false;
    })?;
    let frame = frame(&setup.robot.model, name).map_err(|problem| InvalidConfig {
        file: config_file.to_owned(),
        problem: format!("--payload: {problem}"),
    })?;
    let inputs = &config.identification.inputs;
    let parameters = match (reference, configured) {
        ([], Some(file)) => load(&file)?,
        (files, _) => without_payload(files, config_file, &setup, inputs)?,
    };
    setup
        .apply(&parameters)
        .context("the reference does not fit this robot")?;

    setup.robot = setup.robot_as_identified();
    let known = export::known(&parameters, &setup.robot);
    let datasets = datasets(samples, config_file, &setup)?;
    let found = payload(&setup.robot, &known, &frame, datasets, inputs)?;
    for finding in found
        .findings
        .iter()
        .filter(|f| f.severity > Severity::Note)
    {
        eprintln!(
            "{}: {}",
            severity(finding.severity),
            sentence(&finding.text)
        );
    }
    if as_json {
        print_line!("{}", json(name, &found));
    } else {
        print(name, &found);
    }
    Ok(())
}

/// The parameters of the robot without the payload: those of a file, or identified from logs.
fn without_payload(
    files: &[PathBuf],
    config: &Path,
    setup: &Setup,
    inputs: &[IdentificationInput],
) -> anyhow::Result<Parameters> {
    let is_toml = |file: &PathBuf| file.extension().is_some_and(|word| word == "toml");
    match files {
        [] => Err(InvalidConfig {
            file: config.to_owned(),
            problem: "a payload is what a robot weighs more than without it: give the parameters \
                      or a log of the robot without it with --reference, or name its parameters \
                      here"
                .into(),
        }
        .into()),
        [file] if is_toml(file) => load(file),
        files if files.iter().any(is_toml) => {
            bail!("the reference is one file of parameters, or tables of samples, not both")
        }
        logs => {
            let datasets = datasets(logs, config, setup)?;
            let outcome = identify(&setup.robot, datasets, inputs, &mut |_| ())?;
            // Without better parameters, the CAD's are known as well as CAD's are.
            let advice = Advice::of(&outcome);
            if advice.grade == Grade::Reject && outcome.verdict != Verdict::NoBetterThanCad {
                bail!("the reference identifies nothing: {}", advice.why.join(" "));
            }
            let program = concat!("proprio ", env!("CARGO_PKG_VERSION"));
            Ok(export::parameters(&outcome, &setup.robot, program)?)
        }
    }
}

fn load(file: &Path) -> anyhow::Result<Parameters> {
    Parameters::load(file).with_context(|| file.display().to_string())
}

/// Reads logs.
fn datasets(files: &[PathBuf], config: &Path, setup: &Setup) -> anyhow::Result<Vec<Dataset>> {
    let files: Vec<(&PathBuf, LogRole)> = files.iter().map(|file| (file, LogRole::Train)).collect();
    let names = names(&files);
    let all = files.iter().zip(names).map(|((file, role), name)| {
        let mut table = open(file, config, setup)?;
        read(setup, &name, *role, &mut table)
    });
    all.collect()
}

fn json(name: &str, found: &Payload) -> serde_json::Value {
    let (mass, mass_std) = found.mass();
    let ((centre, centre_std), (tensor, tensor_std)) = (found.centre(), found.about_centre());
    let six = |m: &Mat3| COMPONENTS.map(|(_, place)| m[place]);
    let if_significant = |value: serde_json::Value| {
        if found.is_significant() {
            value
        } else {
            serde_json::Value::Null
        }
    };
    serde_json::json!({
        "payload": name,
        "is_significant": found.is_significant(),
        "mass_kg": mass,
        "mass_std_kg": mass_std,
        "centre_m": if_significant(<[f64; 3]>::from(centre).to_vec().into()),
        "centre_std_m": if_significant(<[f64; 3]>::from(centre_std).to_vec().into()),
        "first_moment_kgm": found.parameters[1..4],
        "inertia_kgm2": if_significant(six(&tensor).to_vec().into()),
        "inertia_std_kgm2": if_significant(six(&tensor_std).to_vec().into()),
        "instants": found.instants,
    })
}

fn print(name: &str, found: &Payload) {
    let (mass, deviation) = found.mass();
    print_line!("{name} carries {mass:.4} +- {deviation:.4} kg");
    if !found.is_significant() {
        print_line!("  no mass can be told: it is below four standard deviations");
        return;
    }
    let ((centre, centre_std), (tensor, tensor_std)) = (found.centre(), found.about_centre());
    print_line!("  centre of mass in the axes of {name} [m], inertia about it [kg m^2]:");
    for (axis, label) in ["x", "y", "z"].into_iter().enumerate() {
        print_line!("  {label}  {:+.4} +- {:.4}", centre[axis], centre_std[axis]);
    }
    for (label, place) in COMPONENTS {
        print_line!(
            "  {label} {:+.5} +- {:.5}",
            tensor[place],
            tensor_std[place]
        );
    }
}
