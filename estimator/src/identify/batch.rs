//! Several recorded logs to one set of parameters.
//!
//! 1. Each log becomes instants ([`super::instants`]), each instant rows ([`super::rows`]).
//! 2. Rounds. With the noise that the last parameters leave: what each log tells of the parameters, its
//!    own unknowns eliminated ([`super::passes`]); logs added up; the most probable bodies under the prior
//!    and its weight ([`super::prior`]). With these bodies: the residuals, and from them the noise
//!    ([`super::noise`]). Until noise stays; once more where an offset walked further than sensors do.
//!    Before the first of them: logs that repeat another one, or whose readings are no newtons ([`super::wrenches`]), are refused; so is a sensor that is mounted the wrong way, or the log in which
//!    alone it is ([`super::mounting`]).
//! 3. What this fit says that something undeclared acted on is left out, jumps of offsets that it does not bear out are dropped, and the rounds repeated, until that stays ([`super::gate`]).
//!    Then, where gains of sensors are asked for, fits with these unknown, too, and what is left out is asked again.
//! 4. A check on data held out: pieces of the logs are predicted from the others. The change from CAD is shrunk where it gains nothing ([`super::guard`]).
//! 5. Shaking that encoders do not show ([`super::shaking`]), where other sensors tell of it, is taken off; then 2 and 4 once more.
//! 6. Figures for every log ([`super::assess`]), and what undeclared acted on the robot in those to validate with.

use super::assess;
use super::consistent;
use super::gate::{self, UnitSet};
use super::guard::{self, Guard};
use super::hypothesis;
use super::information::Information;
use super::instants::{Break, Defect, Instant, Recording, RecordingError, Settings};
use super::mounting;
use super::outcome::{Finding, LeftOut, Outcome, Role, Severity, Verdict};
use super::parallel;
use super::passes::{NoiseModel, Piece, Told, Walks, leave, noise_of, tell};
use super::prior::{Fit, Posterior, Prior, PriorError};
use super::rows::{Further, Layout, RowMaker, Rows};
use super::shaking::Shaking;
use super::torques;
use super::undeclared::{self, Undeclared};
use super::wrenches;
use crate::calibration::Kind;
use crate::config::{Gain, IdentificationInput, TorqueSide};
use crate::dynamics::DynamicsError;
use crate::setup::{Setup, Use};
use crate::spatial::{RigidInertia, Vec3, Wrench};
use nalgebra::DVector;
use proprio_topics::{Nanos, Reason, csv};
use std::collections::BTreeMap;
use std::io::Read;

/// A log to identify from, or to validate with.
pub struct Log<'a> {
    /// What it is called in the outcome: its file name.
    pub file: String,
    /// What it is for.
    pub role: Role,
    /// The table of samples (CSV).
    pub samples: &'a mut (dyn Read + Send),
}

/// What is asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// From which measurements; empty: from the F/T sensors if the robot has any, else from measured joint torques.
    pub inputs: Vec<IdentificationInput>,
}

/// How far it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// What it is doing, in a few words: `reading walk.csv`, `round 3`.
    pub step: String,
    /// Share done, 0 to 1.
    pub done: f64,
}

/// Why there is no outcome at all. (Logs that tell nothing do give one, which says so.)
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IdentifyError {
    /// A log can not be read.
    #[error("{file}: {problem}")]
    Log {
        /// Its name.
        file: String,
        /// What is wrong, in words.
        problem: String,
    },
    /// No log to train on.
    #[error("no log to identify from: give at least one that is not for validation")]
    NoLogs,
    /// Nothing to identify from is configured or measured.
    #[error("{0}")]
    NoInputs(String),
    /// The recorded motion can not be put into the model.
    #[error("no rows can be made of the logs: {0}")]
    Dynamics(#[from] DynamicsError),
    /// The most probable bodies can not be computed.
    #[error("no bodies can be fitted to the logs: {0}")]
    Fit(#[from] PriorError),
}

/// An offset's walk follows nothing faster than this \[s\]: the motion that identifies is faster.
const DRIFT_TIME: f64 = 1.0;

/// Fits after which something else may be left out; loads that are looked for; those that turned out to be none, after which no more are.
const GATES: usize = 12;
const LOADS: usize = 4;
const REFUSED: usize = 2;

/// A load is believed if without its side of the log the noise of its part of the robot is less, by this
/// factor of the variances (geometric mean over the channels there).
const QUIETER: f64 = 2.0;

/// Most rounds of noise and prior.
const ROUNDS: usize = 14;

/// Rounds end when the logarithm of no variance changes by more than this in a round, or round a circle
/// of them: a deviation by a twentieth.
const SETTLED: f64 = 0.1;

/// How many instants a fold of the check on held-out data has at least.
pub(super) const LEAST_FOLD: usize = 50;

/// Instants that noise, prior weight and the check on held-out data look at, at most, and in how many
/// stretches of long logs. Shorter stretches would not show how slow noise is: of many logs some are taken.
const SAMPLE: usize = 10_000;
const SAMPLE_STRETCHES: usize = 10;

/// Longer logs are taken in pieces, each with offsets that begin unknown, so that all cores have work.
pub(super) const LONG: usize = 10_000;

/// A log, ready to be used.
pub(super) struct Prepared {
    pub file: String,
    pub role: Role,
    pub span: (Nanos, Nanos),
    /// [`Recording::torque_rate`].
    pub torque_rate: f64,
    pub instants: Vec<Instant>,
    pub breaks: Vec<Break>,
    pub left_out: Vec<LeftOut>,
    pub findings: Vec<Finding>,
    pub refused: bool,
    /// Of a log to validate with: per instant, what something undeclared was found to act on; empty where none was looked for. No [`Instant::suspected`], for figures are of all of such a log.
    pub touched: Vec<UnitSet>,
}

impl Prepared {
    /// What is said of the log itself, jumps included.
    pub(super) fn all_findings(&self) -> Vec<Finding> {
        let jumps = self.breaks.iter().map(|b| finding(&b.jump));
        self.findings.iter().cloned().chain(jumps).collect()
    }
}

/// What was identified, before figures are made of it.
pub(super) struct Identified {
    pub layout: Layout,
    pub inputs: Vec<IdentificationInput>,
    /// What of the sensors' calibrations was identified, too.
    pub calibrated: Kind,
    pub prior: Prior,
    pub noise: NoiseModel,
    pub information: Information,
    pub fit: Fit,
    /// Parameters less CAD, shrunk.
    pub d: DVector<f64>,
    /// CAD's parameters less themselves: zero but for unknowns of which CAD says nothing, which have the values that go best with its bodies ([`beside_cad`]).
    pub cad: DVector<f64>,
    /// Per link of the layout, then per further unknown, the share of the change from CAD that was kept.
    pub kept: Vec<f64>,
    pub findings: Vec<Finding>,
    /// Per piece of the training logs, the last one last.
    pub told: Vec<Told>,
}

/// Identifies.
///
/// # Errors
/// [`IdentifyError`]: a log that can not be read or lacks a channel, no log at all, nothing measured that parameters could be identified from, numbers that nothing can be computed from.
pub fn identify(
    setup: &Setup,
    logs: Vec<Log<'_>>,
    options: &Options,
    progress: &mut dyn FnMut(&Progress),
) -> Result<Outcome, IdentifyError> {
    if !logs.iter().any(|log| log.role == Role::Train) {
        return Err(IdentifyError::NoLogs);
    }
    let mut tell_progress = |step: String, done: f64| progress(&Progress { step, done });
    let inputs = if options.inputs.is_empty() {
        vec![if setup.structure.sensors().is_empty() {
            IdentificationInput::Torque
        } else {
            IdentificationInput::Wrench
        }]
    } else {
        options.inputs.clone()
    };
    let count = logs.len() as f64;
    let mut prepared = Vec::new();
    for (number, log) in logs.into_iter().enumerate() {
        tell_progress(format!("reading {}", log.file), 0.2 * number as f64 / count);
        let mut log = prepare(setup, log)?;
        torques::check(setup, &mut log)?;
        prepared.push(log);
    }
    refuse_repeated(&mut prepared);
    let training = used(&prepared);
    if training.is_empty() {
        return Ok(assess::nothing(setup, &prepared, no_log(&prepared)));
    }
    let all = training.iter().flat_map(|log| log.instants.iter());
    let mut maker = RowMaker::survey(setup, &inputs, all)?;
    if maker.layout().links.is_empty() {
        let what = match inputs.as_slice() {
            [IdentificationInput::Torque] => {
                "no joint torque was measured while nothing touched the links beyond the joint"
            }
            [IdentificationInput::Wrench] => {
                "no part of the robot beyond or between F/T sensors was free of unknown contacts (and measured) at any instant"
            }
            _ => "no joint torque and no F/T sensor was measured where nothing unknown touched the robot",
        };
        return Ok(assess::nothing(
            setup,
            &prepared,
            format!("nothing shows the links' parameters: {what}"),
        ));
    }
    let before = training.len();
    for log in &mut prepared {
        wrenches::check(&mut maker, log);
    }
    if let Some(surveyed) = surveyed_again(setup, &inputs, &prepared, before)? {
        maker = surveyed;
    }
    if maker.layout().links.is_empty() {
        return Ok(assess::nothing(setup, &prepared, no_log(&prepared)));
    }
    let training = used(&prepared);
    let wrong = mounting::wrong(&maker, &training);
    if !wrong.is_empty() {
        let names: Vec<&str> = wrong.iter().map(|f| f.subject.as_str()).collect();
        let mut outcome = assess::nothing(
            setup,
            &prepared,
            format!(
                "{}: mounted or configured the wrong way; nothing was identified",
                names.join(", ")
            ),
        );
        outcome.findings.extend(wrong);
        return Ok(outcome);
    }
    // Not mounted alike in all logs?
    let found = mounting::wrong_alone(&maker, &training, &prepared);
    let before = training.len();
    for (log, found) in prepared.iter_mut().zip(found) {
        log.refused |= !found.is_empty();
        log.findings.extend(found);
    }
    if let Some(surveyed) = surveyed_again(setup, &inputs, &prepared, before)? {
        maker = surveyed;
    }
    if maker.layout().links.is_empty() {
        return Ok(assess::nothing(setup, &prepared, no_log(&prepared)));
    }
    let training = used(&prepared);
    let of_temperature = Kind {
        gain: Gain::None,
        ..setup.calibrated
    };
    maker.calibrate(of_temperature, training.iter().flat_map(|log| log.instants.iter()));
    let mut gated = gated(setup, &maker, &mut prepared, &mut tell_progress)?;
    let Choice { gain, told, guard } = chosen_gain(&mut maker, &mut prepared, &gated.settled)?;
    let calibrated = Kind {
        gain,
        ..setup.calibrated
    };
    if gain != Gain::None {
        gated = with_gains(setup, &mut maker, &mut prepared, calibrated, gated, &mut tell_progress)?;
    }
    let maker = maker;
    let Gated {
        settled,
        undeclared,
        restless,
    } = gated;
    undeclared.tell(&maker, &mut prepared, &settled);
    let training = used(&prepared);
    let mut identified = fit(
        &maker,
        &training,
        inputs.clone(),
        calibrated,
        settled,
        guard,
        &mut tell_progress,
    )?;
    tell_progress("shaking".into(), 0.8);
    if let Some(shaking) = Shaking::find(&maker, &sample(&maker, &training), &identified.noise, &identified.d) {
        for log in &mut prepared {
            shaking.apply(&maker, &mut log.instants, &log.breaks);
        }
        // Once more, what encoders do not show taken off; it has been told how far along this is.
        let mut again = |step: String, _| tell_progress(format!("{step}, without shaking"), 0.8);
        let training = used(&prepared);
        let settled = settle(
            setup,
            &maker,
            &training,
            Slow::OfSensors,
            Some(identified.noise),
            &mut again,
        )?;
        identified = fit(&maker, &training, inputs, calibrated, settled, None, &mut again)?;
        identified.findings.extend(shaken(&maker, &shaking));
    }
    identified.findings.extend(restless);
    identified.findings.extend(told);
    identified.findings.extend(asked_in_vain(setup, &identified.inputs));
    undeclared::tell_of_checks(&maker, &mut prepared, &identified);
    let training = used(&prepared);
    tell_progress("figures".into(), 0.9);
    let outcome = assess::outcome(setup, &maker, &prepared, &training, &identified);
    tell_progress("done".into(), 1.0);
    Ok(outcome)
}

/// What the configuration asks for that nothing can be said of, for lack of the measurements that it is about among those that are identified from.
fn asked_in_vain(setup: &Setup, inputs: &[IdentificationInput]) -> Vec<Finding> {
    let note = |code, key: &str, text: String| Finding {
        severity: Severity::Note,
        code,
        subject: key.to_owned(),
        text,
    };
    let mut notes = Vec::new();
    if !setup.calibrated.is_empty() && !inputs.contains(&IdentificationInput::Wrench) {
        let asked = [
            (
                !matches!(setup.calibrated.gain, Gain::None | Gain::Auto),
                "identification.gain",
            ),
            (setup.calibrated.temperature, "identification.temperature"),
        ];
        let asked: Vec<&str> = asked.iter().filter(|(is, _)| *is).map(|(_, key)| *key).collect();
        let asked = asked.join(" and ");
        let text = format!(
            "{asked} asked for in vain: no F/T sensor is identified from here, so none is calibrated; add \"wrench\" to the inputs"
        );
        notes.push(note("no_calibration", &asked, text));
    }
    if setup.torque_side == TorqueSide::Motor && !inputs.contains(&IdentificationInput::Torque) {
        let key = "identification.torque_side";
        let text = format!(
            "{key} = \"motor\" asked for in vain: no joint torque is identified from here, so no rotor's inertia is; add \"torque\" to the inputs"
        );
        notes.push(note("no_rotors", key, text));
    }
    notes
}

/// A survey of the logs to train on, if they are not the `before` that there were; without any link if there are none left.
fn surveyed_again<'a>(
    setup: &'a Setup,
    inputs: &[IdentificationInput],
    prepared: &[Prepared],
    before: usize,
) -> Result<Option<RowMaker<'a>>, IdentifyError> {
    let training = used(prepared);
    if training.len() == before {
        return Ok(None);
    }
    let instants = training.iter().flat_map(|log| log.instants.iter());
    Ok(Some(RowMaker::survey(setup, inputs, instants)?))
}

/// The logs to train on.
pub(super) fn used(prepared: &[Prepared]) -> Vec<&Prepared> {
    let is_used = |log: &&Prepared| log.role == Role::Train && !log.refused;
    prepared.iter().filter(is_used).collect()
}

pub(super) fn used_mut(prepared: &mut [Prepared]) -> impl Iterator<Item = &mut Prepared> {
    let is_used = |log: &&mut Prepared| log.role == Role::Train && !log.refused;
    prepared.iter_mut().filter(is_used)
}

/// What was found of motion that encoders do not show.
fn shaken(maker: &RowMaker<'_>, shaking: &Shaking) -> Vec<Finding> {
    let setup = maker.setup();
    let names = |sensors: &[usize]| -> String {
        let names: Vec<String> = sensors.iter().map(|s| assess::sensor_name(setup, *s)).collect();
        names.join(" and ")
    };
    let own = maker.sensors_of_subtrees();
    let parts = shaking.parts.iter();
    parts
        .map(|part| Finding {
            severity: Severity::Note,
            code: "shaking",
            subject: names(&own[part.subtree]),
            text: format!(
                "the robot shakes in a way that its encoders do not show: {:.0} % of what is quick in the imbalance at {} can be told from {}, and is taken off",
                100.0 * part.explained,
                names(&own[part.subtree]),
                names(&part.sensors)
            ),
        })
        .collect()
}

/// Reads a log; one that has columns but nothing in them is refused.
fn prepare(setup: &Setup, log: Log<'_>) -> Result<Prepared, IdentifyError> {
    match Recording::read(setup, log.samples) {
        Ok(recording) => Ok(usable(setup, log.file, log.role, recording)),
        Err(
            problem
            @ (RecordingError::NoSamples(_) | RecordingError::Log(csv::Error::Empty | csv::Error::NoRow { .. })),
        ) => Ok(Prepared {
            file: log.file,
            role: log.role,
            span: (Nanos::ZERO, Nanos::ZERO),
            torque_rate: 0.0,
            instants: Vec::new(),
            breaks: Vec::new(),
            left_out: Vec::new(),
            findings: vec![refusal("unreadable", problem.to_string())],
            refused: true,
            touched: Vec::new(),
        }),
        Err(problem) => Err(IdentifyError::Log {
            file: log.file,
            problem: problem.to_string(),
        }),
    }
}

/// A finding for which a log is not used.
fn refusal(code: &'static str, text: String) -> Finding {
    Finding {
        severity: Severity::Refusal,
        code,
        subject: String::new(),
        text,
    }
}

/// Refuses logs that are another one again: training twice on the same counts its noise as if it were less, and what was trained on tells nothing of the result.
fn refuse_repeated(prepared: &mut [Prepared]) {
    for number in 1..prepared.len() {
        let (before, rest) = prepared.split_at_mut(number);
        let Some(log) = rest.first_mut().filter(|log| !log.refused) else {
            continue;
        };
        let is_same = |other: &&mut Prepared| {
            // To the bit: what was not measured is no number.
            let same = |a: &[f64], b: &[f64]| a.iter().map(|x| x.to_bits()).eq(b.iter().map(|x| x.to_bits()));
            let reads = |a: &[Wrench], b: &[Wrench]| {
                a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(&a.torque_first(), &b.torque_first()))
            };
            let mut pairs = other.instants.iter().zip(&log.instants);
            let alike = |(a, b): (&Instant, &Instant)| {
                a.t - other.span.0 == b.t - log.span.0
                    && same(&a.position, &b.position)
                    && same(&a.torque, &b.torque)
                    && reads(&a.readings, &b.readings)
            };
            !other.refused && other.instants.len() == log.instants.len() && pairs.all(alike)
        };
        let Some(mut other) = before.iter_mut().find(is_same) else {
            continue;
        };
        let mut log = log;
        // The one that is to validate with is left out.
        if log.role == Role::Train && other.role == Role::Validate {
            std::mem::swap(&mut log, &mut other);
        }
        let instead = match log.role {
            Role::Train => "it is used once",
            Role::Validate => {
                "it was left out, for it can not show what the parameters are worth; record another motion"
            }
        };
        let text = format!("it is the same recording as {}: {instead}", other.file);
        log.findings.push(refusal("same_log", text));
        log.refused = true;
    }
}

/// Why nothing can be identified: of each log that should have been, what it was refused for.
fn no_log(prepared: &[Prepared]) -> String {
    /// So many are named.
    const NAMED: usize = 3;
    let training = prepared.iter().filter(|log| log.role == Role::Train);
    let reasons: Vec<String> = training
        .flat_map(|log| {
            let refusals = log.findings.iter().filter(|f| f.severity == Severity::Refusal);
            refusals.map(|f| format!("{}: {}", log.file, f.text))
        })
        .collect();
    let more = if reasons.len() > NAMED { "; ..." } else { "" };
    let named: Vec<&str> = reasons.iter().take(NAMED).map(String::as_str).collect();
    format!("no log can be identified from: {}{more}", named.join("; "))
}

/// The instants of a log by which parameters are judged: those at which motion is known.
///
/// # Errors
/// As for [`Recording::read`].
pub(crate) fn judged_instants(setup: &Setup, log: impl Read) -> Result<Vec<Instant>, RecordingError> {
    let recording = Recording::read(setup, log)?;
    Ok(usable(setup, String::new(), Role::Validate, recording).instants)
}

/// Keeps the instants at which motion is known.
pub(super) fn usable(setup: &Setup, file: String, role: Role, recording: Recording) -> Prepared {
    let found = recording.instants(setup, &Settings::default());
    let mut findings: Vec<Finding> = found.defects.iter().map(finding).collect();
    let refused = found.defects.iter().any(|d| d.severity() == Severity::Refusal);
    let span = match (found.instants.first(), found.instants.last()) {
        (Some(first), Some(last)) => (first.t, last.t),
        _ => (Nanos::ZERO, Nanos::ZERO),
    };
    let torque_rate = recording.torque_rate();
    let mut reasons: BTreeMap<String, LeftOut> = BTreeMap::new();
    let mut leave_out = |reason: String, t: Nanos| {
        let entry = reasons.entry(reason.clone()).or_insert(LeftOut {
            reason,
            instants: 0,
            first: t,
            last: t,
        });
        entry.instants += 1;
        entry.last = t;
    };
    let mut instants = Vec::new();
    for mut instant in found.instants {
        let t = instant.t;
        if !instant.has_motion(setup.channels()) {
            let cause = setup.channels().iter().zip(&instant.faults);
            let cause = cause
                .filter(|(c, _)| !matches!(c.role, Use::Sensor(_)))
                .find(|(_, f)| **f != Reason::None);
            leave_out(
                match cause {
                    Some((_, Reason::Starting)) => {
                        "too close to the beginning, the end or a gap for accelerations".into()
                    }
                    Some((channel, fault)) => format!("{} of {}", fault.word(), channel.name),
                    None => instant.base_fault.word().into(),
                },
                t,
            );
            continue;
        }
        for (channel, fault) in setup.channels().iter().zip(&instant.faults) {
            if let Use::Sensor(sensor) = channel.role {
                let outlier = instant.outliers.contains(sensor);
                if *fault != Reason::None || outlier {
                    let why = if outlier { "outlier" } else { fault.word() };
                    leave_out(format!("{why} of {}", channel.name), t);
                    instant.readings[sensor] = Wrench {
                        torque: Vec3::repeat(f64::NAN),
                        force: Vec3::repeat(f64::NAN),
                    };
                }
            }
        }
        for contact in instant.active.difference(&setup.always).iter() {
            let name = setup.contacts.get(contact).map_or("", |c| c.name.as_str());
            leave_out(format!("contact declared: {name} (the links that it touches)"), t);
        }
        instants.push(instant);
    }
    if instants.len() < LEAST_FOLD && !refused {
        findings.push(refusal(
            "too_short",
            too_few(setup, instants.len(), &recording, &reasons, &findings),
        ));
    }
    Prepared {
        file,
        role,
        span,
        torque_rate,
        refused: refused || instants.len() < LEAST_FOLD,
        instants,
        breaks: found.breaks,
        left_out: reasons.into_values().collect(),
        findings,
        touched: Vec::new(),
    }
}

/// Says that a log's stamps are too far apart for any sample to hold until the next, if they are.
pub(super) fn stamps_apart(setup: &Setup, recording: &Recording) -> Option<String> {
    let (spacing, silence) = (recording.spacing(), setup.max_silence);
    (recording.is_stamped() && spacing > silence).then(|| {
        format!(
            "its samples are {spacing} s apart, and a channel is silent after {silence} s (input.max_silence_ms): record faster, allow more, or, if t is in milliseconds or nanoseconds, convert it to seconds"
        )
    })
}

/// Why so few instants can be used.
fn too_few(
    setup: &Setup,
    count: usize,
    recording: &Recording,
    left_out: &BTreeMap<String, LeftOut>,
    findings: &[Finding],
) -> String {
    let why = if let Some(apart) = stamps_apart(setup, recording) {
        apart
    } else if let Some(dead) = findings.iter().find(|f| ["frozen", "never_seen"].contains(&f.code)) {
        dead.text.clone()
    } else {
        let most = left_out.values().max_by_key(|l| l.instants);
        most.map_or("record more motion".to_owned(), |l| {
            format!("{} left out: {}", l.instants, l.reason)
        })
    };
    format!("only {count} instants can be used, and nothing is identified from this log: {why}")
}

pub(super) fn finding(defect: &Defect) -> Finding {
    let (code, subject) = match defect {
        Defect::SkippedRows { .. } => ("skipped_rows", String::new()),
        Defect::NeverSeen { channel } => ("never_seen", channel.clone()),
        Defect::RepeatedRows { .. } => ("repeated_rows", String::new()),
        Defect::Repeated { channel, .. } => ("repeated", channel.clone()),
        Defect::Stamps { channel, .. } => ("stamps", channel.clone()),
        Defect::Gaps { channel, .. } => ("gap", channel.clone()),
        Defect::Frozen { channel, .. } => ("frozen", channel.clone()),
        Defect::Still { channel } => ("still", channel.clone()),
        Defect::Saturated { channel, .. } => ("saturated", channel.clone()),
        Defect::WrongUnits { channels, .. } => ("wrong_units", channels.join(", ")),
        Defect::Derivative { joint, .. } => ("derivative", joint.clone()),
        Defect::NoMotion { .. } => ("no_motion", String::new()),
        Defect::TooShort { .. } => ("too_short", String::new()),
        Defect::Jump { channel, .. } => ("jump", channel.clone()),
        Defect::Outliers { channel, .. } => ("outliers", channel.clone()),
        Defect::WrongSign { sensor } => ("wrong_sign", sensor.clone()),
        Defect::WrongFrame { sensor, .. } => ("wrong_frame", sensor.clone()),
    };
    Finding {
        severity: defect.severity(),
        code,
        subject,
        text: defect.to_string(),
    }
}

/// No variance is taken as less: a hundredth of the configured deviation of a sensor's channel, a ten thousandth of a newton metre of a torque.
fn least_variances(setup: &Setup, layout: &Layout) -> Vec<f64> {
    let mut least: Vec<f64> = layout.stated(setup).map(|x| (0.01 * x).powi(2)).collect();
    least.resize(layout.channels(), 1e-8);
    least
}

/// Runs a pass over several pieces, on all cores.
pub(super) fn over<'a, T: Send>(
    maker: &RowMaker<'_>,
    pieces: &[Piece<'a>],
    pass: impl Fn(&mut RowMaker<'_>, usize, Piece<'a>) -> T + Sync,
) -> Vec<T> {
    parallel::map_with(
        pieces.len(),
        || maker.clone(),
        |maker, number| pass(maker, number, pieces[number]),
    )
}

pub(super) fn added(told: &[Told], unknowns: usize) -> Information {
    let columns: Vec<usize> = (0..unknowns).collect();
    let mut sum = Information::new(unknowns);
    for part in told {
        let _ = sum.merge(&part.information, &columns);
    }
    sum
}

pub(super) fn posterior(prior: &Prior, layout: &Layout, information: &Information) -> Result<Posterior, IdentifyError> {
    let (r, z) = information.to_triangle();
    Ok(Posterior::new(prior, &layout.links, &r, &z, &layout.precision)?)
}

/// CAD's bodies, and of what CAD says nothing ([`Further::lacks_cad`]) the values that go best with them, by their priors and by what these data tell; no rotor's inertia is negative. (Not from the log
/// that CAD is compared on: these belong to the robot.)
pub(super) fn beside_cad(layout: &Layout, information: &Information) -> DVector<f64> {
    let mut x = DVector::zeros(layout.unknowns());
    let mut columns = layout.beside_cad();
    let (r, z) = information.to_triangle();
    let (rows, precision) = (r.nrows(), &layout.precision);
    while !columns.is_empty() {
        let mut own = r.select_columns(&columns).resize_vertically(rows + columns.len(), 0.0);
        for (place, &column) in columns.iter().enumerate() {
            own[(rows + place, place)] = precision[column - layout.inertial()].sqrt();
        }
        let qr = own.qr();
        let right = qr.q().tr_mul(&z.clone().resize_vertically(rows + columns.len(), 0.0));
        let Some(values) = qr.r().solve_upper_triangular(&right) else {
            break;
        };
        let is_negative = |column: usize, value: f64| value < 0.0 && is_rotor(layout, column);
        let found = columns.iter().copied().zip(values.iter().copied());
        let kept: Vec<usize> = found
            .clone()
            .filter(|(column, value)| !is_negative(*column, *value))
            .map(|(column, _)| column)
            .collect();
        if kept.len() == columns.len() {
            found.for_each(|(column, value)| x[column] = value);
            break;
        }
        columns = kept;
    }
    x
}

fn is_rotor(layout: &Layout, column: usize) -> bool {
    let further = column
        .checked_sub(layout.inertial())
        .and_then(|k| layout.further.get(k));
    matches!(further, Some(Further::RotorInertia(_)))
}

/// The most probable parameters of which no rotor's inertia is negative: what comes out negative is held at zero, and the rest fitted again.
pub(super) fn without_negative_rotors(
    prior: &Prior,
    layout: &Layout,
    information: &Information,
    fit: &Fit,
) -> Result<DVector<f64>, IdentifyError> {
    let mut x = fit.x.clone();
    let mut keep: Vec<usize> = (0..layout.unknowns()).collect();
    let (r, z) = information.to_triangle();
    let is_negative = |x: &DVector<f64>, column: usize| x[column] < 0.0 && is_rotor(layout, column);
    while keep.iter().any(|&column| is_negative(&x, column)) {
        keep.retain(|&column| !is_negative(&x, column));
        let precision = &layout.precision;
        let of_kept = keep.iter().filter(|column| **column >= layout.inertial());
        let precision: Vec<f64> = of_kept.map(|column| precision[column - layout.inertial()]).collect();
        let own = Posterior::new(prior, &layout.links, &r.select_columns(&keep), &z, &precision)?.fit(fit.tau)?;
        x = DVector::zeros(layout.unknowns());
        keep.iter().zip(&own.x).for_each(|(&column, value)| x[column] = *value);
    }
    Ok(x)
}

/// Rotors whose inertia comes out negative, and not by chance.
fn negative_rotors(setup: &Setup, layout: &Layout, fit: &Fit) -> Vec<Finding> {
    if layout.further.is_empty() {
        return Vec::new();
    }
    let root = fit.covariance_root();
    let mut findings = Vec::new();
    let farther = hypothesis::deviations(layout.further.len());
    for (further, column) in layout.further.iter().zip(layout.inertial()..) {
        let Further::RotorInertia(dof) = *further else {
            continue;
        };
        let (value, deviation) = (fit.x[column], root.row(column).norm());
        if value < -farther * deviation {
            let joint = setup.model.dof_name(dof).to_owned();
            findings.push(Finding {
                severity: Severity::Warning,
                code: "negative_rotor",
                text: format!(
                    "{joint}: the inertia of its rotor comes out as {value:.4} +- {deviation:.4}, and no rotor has less than nothing; it was taken as 0. The sign of its torque, velocity or acceleration is wrong, or its torque is stamped otherwise than its encoder, or torques are not measured at the motors (identification.torque_side)"
                ),
                subject: joint,
            });
        }
    }
    findings
}

/// Noise, prior and its weight, after rounds that settled.
pub(super) struct Settled {
    pub prior: Prior,
    pub noise: NoiseModel,
    pub fit: Fit,
    pub information: Information,
    /// By how much the last round still changed a variance, if rounds did not end; else 0.
    change: f64,
}

/// Rounds of noise and fit, until both stay, from the noise that a fit to nearly the same data left, if there is one.
fn settle(
    setup: &Setup,
    maker: &RowMaker<'_>,
    training: &[&Prepared],
    slow: Slow,
    from: Option<NoiseModel>,
    progress: &mut dyn FnMut(String, f64),
) -> Result<Settled, IdentifyError> {
    let layout = maker.layout().clone();
    let prior = Prior::new(setup.model.inertias())?.expecting(setup.model_deviation());
    let least = least_variances(setup, &layout);
    let walks = walks(setup, &layout, slow);
    let sampled = sample(maker, training);
    let noise_left = |noise: &NoiseModel, d: &DVector<f64>| {
        let left = over(maker, &sampled, |maker, _, piece| {
            leave(maker, piece, noise, std::slice::from_ref(d))
        });
        noise_of(&layout, &left, 0, &walks, &least)
    };
    let has_cad = layout.beside_cad().is_empty();
    let noise = from.unwrap_or_else(|| {
        let unknown = NoiseModel::unknown(least.clone());
        (0..3).fold(unknown, |noise, _| {
            let cad = if has_cad {
                DVector::zeros(layout.unknowns())
            } else {
                let told = over(maker, &sampled, |maker, _, piece| tell(maker, piece, &noise));
                beside_cad(&layout, &added(&told, layout.unknowns()))
            };
            noise_left(&noise, &cad)
        })
    });
    let mut rounds = vec![noise];
    loop {
        let round = rounds.len();
        progress(format!("round {round}"), 0.2 + 0.5 * (round - 1) as f64 / ROUNDS as f64);
        let last = &rounds[round - 1];
        let told = over(maker, &sampled, |maker, _, piece| tell(maker, piece, last));
        let information = added(&told, layout.unknowns());
        let fit = posterior(&prior, &layout, &information)?.weigh()?;
        let next = noise_left(last, &fit.x);
        let change = next.change(last);
        rounds.push(next);
        let (noise, change) = match NoiseModel::of_circle(&rounds, SETTLED) {
            Some(noise) => (noise, 0.0),
            None if round == ROUNDS => (rounds.swap_remove(round), change),
            None => continue,
        };
        return Ok(Settled {
            prior,
            noise,
            fit,
            information,
            change,
        });
    }
}

/// What is left when what something undeclared acted on was left out.
struct Gated {
    settled: Settled,
    undeclared: Undeclared,
    /// Said if what is left out did not come to stay.
    restless: Option<Finding>,
}

/// Fits, leaves out what something undeclared acted on, and fits again, until that stays.
fn gated(
    setup: &Setup,
    maker: &RowMaker<'_>,
    prepared: &mut [Prepared],
    progress: &mut dyn FnMut(String, f64),
) -> Result<Gated, IdentifyError> {
    let mut settled = settle(setup, maker, &used(prepared), Slow::All, None, progress)?;
    // It has been told how far along this is.
    let mut progress = |step: String, _| progress(step, 0.7);
    let mut undeclared = Undeclared::none(used_mut(prepared));
    let mut refused = 0;
    let mut stays = false;
    // A load that comes or goes would pass for noise of everything beside offsets that hardly walk.
    let mut slow = Slow::All;
    for _ in 0..GATES {
        progress("undeclared contacts".into(), 0.7);
        let training = used(prepared);
        let load = (refused < REFUSED && undeclared.loads.len() < LOADS)
            .then(|| gate::load(maker, &settled.prior, &training, &settled.noise, settled.fit.tau))
            .flatten();
        if let Some(load) = load {
            let before = undeclared.loads.clone();
            let channels = maker.channels_of(&load.units);
            undeclared.carry(load);
            undeclared.mark(used_mut(prepared));
            let without = settle(
                setup,
                maker,
                &used(prepared),
                slow,
                Some(settled.noise.clone()),
                &mut progress,
            )?;
            if without.noise.quieter(&settled.noise, &channels) > QUIETER {
                settled = without;
                continue;
            }
            undeclared.loads = before;
            refused += 1;
            undeclared.mark(used_mut(prepared));
        }
        if let Slow::All = slow {
            slow = Slow::OfSensors;
            let rates = walks(setup, maker.layout(), slow).rates;
            if settled.noise.drift.iter().zip(&rates).any(|(found, most)| found > most) {
                // Afresh: noise beside offsets that follow all is shared out otherwise. Where none walked
                // further than sensors do, the bound would have changed nothing.
                settled = settle(setup, maker, &used(prepared), slow, None, &mut progress)?;
            }
        }
        let Settled { noise, fit, .. } = &settled;
        stays = undeclared.ask(maker, used_mut(prepared), noise, &fit.x);
        if stays {
            break;
        }
        settled = settle(setup, maker, &used(prepared), slow, Some(settled.noise), &mut progress)?;
    }
    Ok(Gated {
        settled,
        undeclared,
        restless: (!stays).then(|| undeclared::restless(GATES)),
    })
}

/// Which gains to find out.
struct Choice {
    gain: Gain,
    /// What there is to say of it.
    told: Option<Finding>,
    /// The check on held-out data without gains, if it was made and there are none.
    guard: Option<Guard>,
}

impl Choice {
    const fn of(gain: Gain) -> Self {
        Self {
            gain,
            told: None,
            guard: None,
        }
    }
}

/// Which gains to find out: those asked for; or, step by step from none, those with which data held out
/// are predicted better than with fewer, by more than a standard error and, at some sensor, by more than
/// they cost. A gain common to all channels reads as a mass common to all links, so it stays as uncertain
/// as the workbench left it, and it is in every torque: the cost is the square of that, relative to the
/// square of what the sensor reads. Asked of the noise and the bodies that were found without gains, of
/// which a gain's error is a small change.
fn chosen_gain(
    maker: &mut RowMaker<'_>,
    prepared: &mut [Prepared],
    settled: &Settled,
) -> Result<Choice, IdentifyError> {
    let wanted = maker.setup().calibrated;
    if wanted.gain != Gain::Auto {
        return Ok(Choice::of(wanted.gain));
    }
    if maker.layout().sensors.is_empty() {
        return Ok(Choice::of(Gain::None));
    }
    let cost = maker.setup().gain_deviation.powi(2);
    read_as_fitted(maker, prepared, settled);
    let mut checked = |gain: Gain| -> Result<Guard, IdentifyError> {
        let training = used(prepared);
        let instants = training.iter().flat_map(|log| log.instants.iter());
        maker.calibrate(Kind { gain, ..wanted }, instants);
        let sampled = sample(maker, &training);
        let Settled { prior, noise, fit, .. } = settled;
        guard::held_out(maker, prior, &sampled, noise, fit.tau)
    };
    let guard = checked(Gain::None)?;
    let none = &guard.held;
    let (mut chosen, mut best) = (Gain::None, none.clone());
    for gain in [Gain::Diagonal, Gain::Full] {
        let before = best.relative_squares();
        if !before.iter().any(|square| *square > cost) {
            break;
        }
        let other = checked(gain)?.held;
        let after = other.relative_squares();
        let is_worth = before.iter().zip(after).any(|(before, after)| before - after > cost);
        let (gained, error) = other.gain_over(&best);
        if !(is_worth && gained > error) {
            break;
        }
        (chosen, best) = (gain, other);
    }
    // As the fit at hand has it.
    let training = used(prepared);
    let instants = training.iter().flat_map(|log| log.instants.iter());
    let gain = Gain::None;
    maker.calibrate(Kind { gain, ..wanted }, instants);
    let what = match chosen {
        Gain::Full => "all entries of the F/T sensors' gains are identified",
        Gain::Diagonal => "a gain of each channel of the F/T sensors is identified",
        Gain::Auto | Gain::None => {
            for instant in used_mut(prepared).flat_map(|log| &mut log.instants) {
                instant.fitted = Vec::new();
            }
            let guard = Some(guard);
            return Ok(Choice {
                guard,
                ..Choice::of(Gain::None)
            });
        }
    };
    let text = format!(
        "{what}: readings of data held out are predicted with {:.0} % less error than without (identification.gain = \"none\" leaves the workbench's gains as they are)",
        100.0 * (1.0 - best.relative_to(none))
    );
    let told = Some(Finding {
        severity: Severity::Note,
        code: "gain_chosen",
        subject: "identification.gain".into(),
        text,
    });
    Ok(Choice {
        told,
        ..Choice::of(chosen)
    })
}

/// What of a slow change is an offset's.
#[derive(Clone, Copy, Debug)]
enum Slow {
    /// All that is no faster than [`DRIFT_TIME`]: what stands out of the rest was something undeclared.
    All,
    /// What sensors do by themselves, by no more than their stated noise per square root of a second.
    /// The rest is what the model lacks, and its noise: bodies that have been fitted beside an offset
    /// which follows it predict other logs less well.
    OfSensors,
}

fn walks(setup: &Setup, layout: &Layout, slow: Slow) -> Walks {
    let rates = match slow {
        Slow::All => vec![f64::INFINITY; 6 * layout.sensors.len()],
        Slow::OfSensors => layout.stated(setup).map(|x| x * x).collect(),
    };
    Walks {
        relative: (super::passes::BLOCK / DRIFT_TIME).powi(2),
        rates,
    }
}

/// Gains of the sensors, too. What a gain that is off leaves where the robot carries much may have been taken for a contact: that is asked again when gains are known, and if it was otherwise, gains are
/// fitted again, a few times at the most. (Each time some of what was left out comes back, and tells more of gains.)
fn with_gains(
    setup: &Setup,
    maker: &mut RowMaker<'_>,
    prepared: &mut [Prepared],
    calibrated: Kind,
    mut gated: Gated,
    progress: &mut dyn FnMut(String, f64),
) -> Result<Gated, IdentifyError> {
    const AGAIN: usize = 4;
    gated.settled = gains(setup, maker, prepared, calibrated, gated.settled, progress)?;
    gated.restless = Some(undeclared::restless(AGAIN));
    for _ in 0..AGAIN {
        let Settled { noise, fit, .. } = &gated.settled;
        if gated.undeclared.ask(maker, used_mut(prepared), noise, &fit.x) {
            gated.restless = None;
            break;
        }
        gated.settled = gains(setup, maker, prepared, calibrated, gated.settled, progress)?;
    }
    Ok(gated)
}

/// Fits gains, too: what a gain multiplies is what the fit before says that was there to be read ([`super::rows`]); until that stays.
fn gains(
    setup: &Setup,
    maker: &mut RowMaker<'_>,
    prepared: &mut [Prepared],
    calibrated: Kind,
    mut settled: Settled,
    progress: &mut dyn FnMut(String, f64),
) -> Result<Settled, IdentifyError> {
    /// Fits at the most: each makes the error of a gain less by about as much as the gain was off, twenty times say. And what of the prior's standard deviation is little.
    const FITS: usize = 6;
    const LITTLE: f64 = 1e-3;
    let mut progress = |step: String, _| progress(format!("{step}, with gains"), 0.7);
    read_as_fitted(maker, prepared, &settled);
    let instants = used(prepared);
    maker.calibrate(calibrated, instants.iter().flat_map(|log| log.instants.iter()));
    let mut last: Option<Vec<f64>> = None;
    for _ in 0..FITS {
        settled = settle(
            setup,
            maker,
            &used(prepared),
            Slow::OfSensors,
            Some(settled.noise),
            &mut progress,
        )?;
        read_as_fitted(maker, prepared, &settled);
        let layout = maker.layout();
        let own = layout.precision.iter().copied().zip(layout.inertial()..);
        let now: Vec<f64> = own
            .map(|(precision, column)| settled.fit.x[column] * precision.sqrt())
            .collect();
        let stays = |last: &Vec<f64>| last.iter().zip(&now).all(|(a, b)| (a - b).abs() < LITTLE);
        if last.as_ref().is_some_and(stays) {
            break;
        }
        last = Some(now);
    }
    Ok(settled)
}

/// Says in the training logs what the sensors would have read without noise, by this fit.
fn read_as_fitted(maker: &RowMaker<'_>, prepared: &mut [Prepared], settled: &Settled) {
    let layout = maker.layout();
    let training = used(prepared);
    let pieces = chunks(&training, LONG);
    let left = over(maker, &pieces, |maker, _, piece| {
        leave(maker, piece, &settled.noise, std::slice::from_ref(&settled.fit.x))
    });
    let mut fitted = Vec::new();
    for (piece, left) in pieces.iter().zip(&left) {
        for (i, instant) in piece.instants.iter().enumerate() {
            let mut readings = vec![Wrench::from_parts([f64::NAN; 3], [f64::NAN; 3]); instant.readings.len()];
            for (place, &sensor) in layout.sensors.iter().enumerate() {
                let noise = std::array::from_fn(|axis| left.noise[0][6 * place + axis][i]);
                readings[sensor] = instant.readings[sensor] - Wrench::from_torque_first(noise);
            }
            fitted.push(readings);
        }
    }
    // In the order of the pieces, which is that of the logs.
    let mut fitted = fitted.into_iter();
    let training = used_mut(prepared);
    for instant in training.flat_map(|log| &mut log.instants) {
        instant.fitted = fitted.next().unwrap_or_default();
    }
}

fn fit(
    maker: &RowMaker<'_>,
    training: &[&Prepared],
    inputs: Vec<IdentificationInput>,
    calibrated: Kind,
    settled: Settled,
    guard: Option<Guard>,
    progress: &mut dyn FnMut(String, f64),
) -> Result<Identified, IdentifyError> {
    let layout = maker.layout().clone();
    let pieces = chunks(training, LONG);
    let Settled {
        prior,
        noise,
        fit: Fit { tau, .. },
        change,
        ..
    } = settled;
    progress("held-out data".into(), 0.75);
    let sampled = sample(maker, training);
    let mut guard = match guard {
        Some(guard) => guard,
        None => guard::held_out(maker, &prior, &sampled, &noise, tau)?,
    };
    guard.findings.extend(unsettled(change));
    // Parameters have taken a part of the noise that they were fitted to, most of all where it is as slow as the motion.
    let walks = walks(maker.setup(), &layout, Slow::OfSensors);
    let noise = guard.noise(maker, &sampled, noise, &walks);
    let told = over(maker, &pieces, |maker, _, piece| tell(maker, piece, &noise));
    let information = added(&told, layout.unknowns());
    let fit = posterior(&prior, &layout, &information)?.weigh()?;
    guard.findings.extend(negative_rotors(maker.setup(), &layout, &fit));
    let cad = beside_cad(&layout, &information);
    let mut d = without_negative_rotors(&prior, &layout, &information, &fit)?;
    for (column, share) in per_column(&layout, &guard.share).into_iter().enumerate() {
        d[column] = cad[column] + share * (d[column] - cad[column]);
    }
    Ok(Identified {
        layout,
        inputs,
        calibrated,
        prior,
        noise,
        information,
        d,
        cad,
        kept: guard.share,
        findings: guard.findings,
        fit,
        told,
    })
}

/// What there is per link of the layout and per further unknown, for each column.
pub(super) fn per_column(layout: &Layout, values: &[f64]) -> Vec<f64> {
    let (links, further) = values.split_at(layout.links.len());
    let of_links = links.iter().flat_map(|value| [*value; 10]);
    of_links.chain(further.iter().copied()).collect()
}

/// Says that rounds ended before noise and prior's weight stayed.
fn unsettled(change: f64) -> Option<Finding> {
    (change > 0.0).then(|| Finding {
        severity: Severity::Warning,
        code: "unsettled",
        subject: String::new(),
        text: format!(
            "noise and the prior's weight had not settled after {ROUNDS} rounds: the last one still changed a variance by {:.0} %, and stated deviations are as uncertain as that; longer logs settle",
            100.0 * change.exp_m1()
        ),
    })
}

/// All instants of all logs, in pieces of at most so many.
fn chunks<'a>(training: &[&'a Prepared], most: usize) -> Vec<Piece<'a>> {
    let mut pieces = Vec::new();
    for log in training {
        let count = log.instants.len().div_ceil(most).max(1);
        for number in 0..count {
            let at = |k: usize| log.instants.len() * k / count;
            pieces.push(Piece {
                instants: &log.instants[at(number)..at(number + 1)],
                breaks: &log.breaks,
            });
        }
    }
    pieces
}

/// All instants, or of long logs stretches spread over them, and others where these lack a channel: noise and the prior's weight need no more.
pub(super) fn sample<'a>(maker: &RowMaker<'_>, training: &[&'a Prepared]) -> Vec<Piece<'a>> {
    let total: usize = training.iter().map(|log| log.instants.len()).sum();
    if total <= SAMPLE {
        return chunks(training, usize::MAX);
    }
    let pieces = chunks(training, total / SAMPLE_STRETCHES);
    let least = SAMPLE / SAMPLE_STRETCHES;
    let in_stretches: usize = pieces.iter().map(|piece| piece.instants.len().min(least)).sum();
    let every = ((in_stretches + SAMPLE / 2) / SAMPLE).max(1);
    let length = SAMPLE / pieces.len().div_ceil(every);
    let stretch = |piece: &Piece<'a>, start: usize| Piece {
        instants: &piece.instants[start..piece.instants.len().min(start + length)],
        ..*piece
    };
    let taken = pieces.iter().step_by(every);
    let mut sampled: Vec<Piece<'a>> = taken.map(|piece| stretch(piece, 0)).collect();
    // How often each channel shows, as far as it matters: without any of it, its noise would be taken to be nothing.
    let (mut maker, mut rows) = (maker.clone(), Rows::new(maker.layout()));
    let mut heard = vec![0; maker.layout().channels()];
    let mut listen = |instant: &Instant, heard: &mut [usize]| -> bool {
        let made = maker.make(instant, &mut rows).is_ok();
        let mut lacked = false;
        for (channel, heard) in heard.iter_mut().enumerate() {
            if made && rows.has(channel) {
                lacked |= *heard < LEAST_FOLD;
                *heard += 1;
            }
        }
        lacked
    };
    for piece in &sampled {
        for instant in piece.instants {
            if heard.iter().all(|heard| *heard >= LEAST_FOLD) {
                return sampled;
            }
            listen(instant, &mut heard);
        }
    }
    for (number, piece) in pieces.iter().enumerate() {
        let mut i = if number % every == 0 { length } else { 0 };
        while i < piece.instants.len() && heard.iter().any(|heard| *heard < LEAST_FOLD) {
            if listen(&piece.instants[i], &mut heard) {
                let further = stretch(piece, i);
                for instant in &further.instants[1..] {
                    listen(instant, &mut heard);
                }
                i += further.instants.len() - 1;
                sampled.push(further);
            }
            i += 1;
        }
    }
    sampled
}

/// CAD moved by `d` in the columns of a layout: all links.
pub(super) fn bodies(setup: &Setup, layout: &Layout, d: &DVector<f64>) -> Vec<RigidInertia> {
    let mut bodies = setup.model.inertias().to_vec();
    for (place, &link) in layout.links.iter().enumerate() {
        let mut phi = bodies[link].parameters();
        for (value, change) in phi.iter_mut().zip(d.rows(10 * place, 10).iter()) {
            *value += change;
        }
        bodies[link] = RigidInertia::from_parameters(&phi);
    }
    bodies
}

/// Whether bodies exist that have what the data say.
pub(super) fn feasibility(setup: &Setup, identified: &Identified) -> super::outcome::Consistency {
    use super::outcome::Consistency;
    let (r, z) = identified.information.to_triangle();
    match consistent::nearest(
        &identified.prior,
        &identified.layout.links,
        &r,
        &z,
        &identified.layout.precision,
    ) {
        Ok(nearest) => Consistency {
            feasible: match &nearest.verdict {
                consistent::Verdict::Feasible => Some(true),
                consistent::Verdict::Infeasible(_) => Some(false),
                consistent::Verdict::Undecided => None,
            },
            deviations: nearest.deviations(),
            links: match &nearest.verdict {
                consistent::Verdict::Infeasible(violations) => violations
                    .iter()
                    .map(|v| setup.model.link_name(v.link).to_owned())
                    .collect(),
                _ => Vec::new(),
            },
            text: nearest.describe(|link| setup.model.link_name(link)),
        },
        Err(e) => Consistency {
            feasible: None,
            deviations: f64::NAN,
            links: Vec::new(),
            text: e.to_string(),
        },
    }
}

/// The verdict, given the held-out check.
pub(super) fn verdict(identified: &Identified) -> Verdict {
    if identified.kept.iter().any(|kept| *kept > 0.0) {
        Verdict::Identified
    } else {
        Verdict::NoBetterThanCad
    }
}

#[cfg(test)]
mod tests {
    use super::super::passes::tests::{between_two_sensors, readings};
    use super::*;
    use crate::dynamics::ContactSet;

    /// A log of these instants.
    fn log(instants: &[Instant]) -> Prepared {
        Prepared {
            file: String::new(),
            role: Role::Train,
            span: (instants[0].t, instants[instants.len() - 1].t),
            torque_rate: 0.0,
            instants: instants.to_vec(),
            breaks: Vec::new(),
            left_out: Vec::new(),
            findings: Vec::new(),
            refused: false,
            touched: Vec::new(),
        }
    }

    /// Noise that is as slow as a few seconds shows in stretches that are longer than that, of however many logs.
    #[test]
    fn stretches_of_many_logs_are_not_short() {
        let setup = between_two_sensors();
        let all = readings(&setup, 15_000, &[0.1; 12], &[0.0; 12]);
        for (count, instants) in [(1, 15_000), (4, 12_000), (60, 1000), (100, 300)] {
            let logs: Vec<Prepared> = (0..count).map(|_| log(&all[..instants])).collect();
            let logs: Vec<&Prepared> = logs.iter().collect();
            let wrench = [IdentificationInput::Wrench];
            let all = logs.iter().flat_map(|log| &log.instants);
            let maker = RowMaker::survey(&setup, &wrench, all).expect("rows");
            let lengths: Vec<usize> = sample(&maker, &logs).iter().map(|piece| piece.instants.len()).collect();
            let sum: usize = lengths.iter().sum();
            assert!((SAMPLE / 2..=SAMPLE).contains(&sum), "{count} logs: {sum} instants");
            let least = lengths.iter().min().copied().unwrap_or(0);
            assert!(
                least >= if instants < 1000 { 290 } else { 700 },
                "{count} logs: {least} at once"
            );
        }
    }

    /// Whether a limb is quieter without a load is asked of its own sensors.
    #[test]
    fn a_load_is_asked_for_where_it_is() {
        let setup = between_two_sensors();
        let mut instants = readings(&setup, 200, &[0.1; 12], &[0.0; 12]);
        for instant in &mut instants {
            (instant.torque, instant.active) = (vec![0.1; 2], ContactSet::default());
        }
        let both = [IdentificationInput::Wrench, IdentificationInput::Torque];
        let maker = RowMaker::survey(&setup, &both, instants.iter()).expect("rows");
        let of_link = |link: &str| {
            let link = (0..setup.model.link_count()).find(|&number| setup.model.link_name(number) == link);
            let mut units = UnitSet::default();
            units.insert(setup.structure.subtree_of(link.expect("a link")).expect("its sub-tree"));
            units
        };
        let channels_of = |link: &str| maker.channels_of(&of_link(link));
        let thigh = channels_of("thigh");
        assert_eq!(thigh, (0..12).collect::<Vec<_>>());
        let foot = channels_of("foot");
        assert_eq!(foot.len(), 6);
        let mut with_torques = of_link("foot");
        with_torques.insert(Instant::TORQUES);
        assert_eq!(maker.channels_of(&with_torques), [foot.clone(), vec![12, 13]].concat());
        let noise = NoiseModel::unknown(vec![1e-6; 14]);
        let mut quieter = noise.clone();
        quieter.square.fill(100.0);
        for &channel in &foot {
            (quieter.square[channel], quieter.block[channel]) = (0.25, 0.25);
        }
        assert!((quieter.quieter(&noise, &foot) - 4.0).abs() < 1e-9);
        assert!((quieter.quieter(&noise, &thigh) - 0.2).abs() < 1e-9);
    }
}
