//! The logs of an identification: the observations that can be used, why others are excluded, and
//! the segments in which they are processed.

use crate::dataset::observation::{Annotated, Observation, SubtreeSet};
use crate::dataset::{Dataset, LogRole};
use crate::finding::{Finding, FindingCode, Severity};
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{LogSegment, ReducedLog, Residuals, reduce, residuals};
use crate::robot::{ChannelRole, Robot};
use nalgebra::DVector;
use proprio_dynamics::spatial::Wrench;
use proprio_topics::{Nanos, Reason};
use std::collections::BTreeMap;

/// Observations that are not used, for one reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Excluded {
    /// The reason, in a few words: `contact declared: hand (the links that it touches)`, `contact
    /// suspected: the links at l_arm_ft_sensor`, `another load: l_hand`, `stale of knee`, or that
    /// they are too close to an end or a gap for accelerations.
    pub reason: String,
    /// Number of observations.
    pub instants: u64,
    /// Stamp of the first.
    pub first: Nanos,
    /// Stamp of the last.
    pub last: Nanos,
}

/// Fewest instants of a cross-validation fold ...
pub(crate) const MIN_FOLD: usize = 50;

/// ... or fewest seconds in which there are some: of an averaged static pose there is one instant.
pub(crate) const MIN_SECONDS: usize = 5;

/// Number of cross-validation folds that instants with these stamps suffice for.
pub(crate) fn folds(stamps: impl Iterator<Item = Nanos>) -> usize {
    let (mut count, mut seconds, mut last) = (0, 0, None);
    for t in stamps {
        let second = Some(t.0.div_euclid(1_000_000_000));
        seconds += usize::from(second != last);
        (count, last) = (count + 1, second);
    }
    (count / MIN_FOLD).max(seconds / MIN_SECONDS)
}

/// Most observations that noise, prior scale and cross-validation use, and in how many stretches of
/// long logs. Shorter stretches would not show how slow the noise is, so of many logs only some are
/// used.
pub(crate) const SAMPLE_INSTANTS: usize = 10_000;

const SAMPLE_STRETCHES: usize = 10;

/// Longer logs are divided into segments, each with unknown initial offsets, so that all cores have
/// work.
pub(crate) const SEGMENT_INSTANTS: usize = 10_000;

/// A log whose observations are ready to be used.
pub(crate) struct PreparedLog {
    pub file: String,
    pub role: LogRole,
    pub span: (Nanos, Nanos),
    pub instants: Vec<Annotated>,
    pub excluded: Vec<Excluded>,
    pub findings: Vec<Finding>,
    pub refused: bool,
    /// Per instant, the sub-trees on which an undeclared contact acts. In the end
    /// [`Annotated::disturbed`] is empty in a validation log, because figures of such a log include
    /// all of its instants.
    pub contacts: Vec<SubtreeSet>,
}

impl PreparedLog {
    /// Excludes a joint's torque, for `reason`, and reports it with `finding`.
    pub(crate) fn exclude_torque(&mut self, dof: usize, reason: String, finding: Finding) {
        let is_there = |own: &&Annotated| own.torque.get(dof).is_some_and(|x| x.is_finite());
        let times = || self.instants.iter().filter(is_there).map(|own| own.t);
        if let (Some(first), Some(last)) = (times().next(), times().next_back()) {
            let instants = times().count() as u64;
            self.excluded.push(Excluded {
                reason,
                instants,
                first,
                last,
            });
        }
        let all = std::mem::take(&mut self.instants).into_iter();
        self.instants = all.map(|own| own.map(|o| o.without_torque(dof))).collect();
        self.findings.push(finding);
    }

    /// Adds findings about the whole log. A refusal among them refuses the log.
    pub(crate) fn add_findings(&mut self, findings: Vec<Finding>) {
        let is_refusal = |finding: &Finding| finding.severity == Severity::Refusal;
        self.refused |= findings.iter().any(is_refusal);
        self.findings.extend(findings);
    }
}

/// The training logs that are not refused.
pub(crate) fn training_logs(logs: &[PreparedLog]) -> Vec<&PreparedLog> {
    let is_used = |log: &&PreparedLog| log.role == LogRole::Train && !log.refused;
    logs.iter().filter(is_used).collect()
}

/// All instants of these logs.
pub(crate) fn training_instants(logs: &[PreparedLog]) -> impl Iterator<Item = &Annotated> {
    (training_logs(logs).into_iter()).flat_map(|log| &log.instants)
}

pub(crate) fn training_logs_mut(
    logs: &mut [PreparedLog],
) -> impl Iterator<Item = &mut PreparedLog> {
    let is_used = |log: &&mut PreparedLog| log.role == LogRole::Train && !log.refused;
    logs.iter_mut().filter(is_used)
}

/// Refuses logs that repeat another one. Training twice on the same data would understate their
/// noise, and training data cannot validate the result.
pub(crate) fn refuse_repeated(logs: &mut [PreparedLog]) {
    for number in 1..logs.len() {
        let (before, rest) = logs.split_at_mut(number);
        let Some(log) = rest.first_mut().filter(|log| !log.refused) else {
            continue;
        };
        let is_same = |other: &&mut PreparedLog| {
            // To the bit, because what was not measured is NaN.
            let numbers = |of: &Annotated| -> Vec<u64> {
                let readings = of.readings.iter().flat_map(Wrench::torque_first);
                let others = of.position.iter().chain(&of.torque).copied();
                others.chain(readings).map(f64::to_bits).collect()
            };
            let mut pairs = other.instants.iter().zip(&log.instants);
            let alike = |(a, b): (&Annotated, &Annotated)| {
                a.t - other.span.0 == b.t - log.span.0 && numbers(a) == numbers(b)
            };
            !other.refused && other.instants.len() == log.instants.len() && pairs.all(alike)
        };
        let Some(mut other) = before.iter_mut().find(is_same) else {
            continue;
        };
        let mut log = log;
        // The one for validation is refused.
        if log.role == LogRole::Train && other.role == LogRole::Validate {
            std::mem::swap(&mut log, &mut other);
        }
        let instead = match log.role {
            LogRole::Train => "it is used once",
            LogRole::Validate => {
                "it was excluded, because training data cannot validate the parameters; record \
                 another motion"
            }
        };
        let text = format!("it is the same recording as {}: {instead}", other.file);
        log.findings
            .push(Finding::refusal(FindingCode::DuplicateLog, "", text));
        log.refused = true;
    }
}

/// Why nothing can be identified: the reasons for which the training logs were refused.
pub(crate) fn no_log(logs: &[PreparedLog]) -> String {
    /// Most reasons that are named.
    const NAMED: usize = 3;
    let training = logs.iter().filter(|log| log.role == LogRole::Train);
    let reasons: Vec<String> = training
        .flat_map(|log| {
            let findings = log.findings.iter();
            let refusals = findings.filter(|f| f.severity == Severity::Refusal);
            refusals.map(|f| format!("{}: {}", log.file, f.text))
        })
        .collect();
    let more = if reasons.len() > NAMED { "; ..." } else { "" };
    let named: Vec<&str> = reasons.iter().take(NAMED).map(String::as_str).collect();
    format!("no log can be identified from: {}{more}", named.join("; "))
}

/// The observations of a log on which parameters are judged: those with known motion.
#[must_use]
pub fn judged(robot: &Robot, dataset: Dataset) -> Vec<Observation> {
    let log = prepare(robot, dataset);
    let instants = log.instants.iter();
    instants.map(|own| own.observation().clone()).collect()
}

/// A log with the observations at which the motion is known; the reasons why others are excluded.
pub(crate) fn prepare(robot: &Robot, dataset: Dataset) -> PreparedLog {
    let apart = stamps_apart(robot, &dataset);
    let Dataset {
        name: file,
        role,
        instants: all,
        mut findings,
        ..
    } = dataset;
    let refused = findings.iter().any(|own| own.severity == Severity::Refusal);
    let span = match (all.first(), all.last()) {
        (Some(first), Some(last)) => (first.t, last.t),
        _ => (Nanos::ZERO, Nanos::ZERO),
    };
    let mut reasons: BTreeMap<String, Excluded> = BTreeMap::new();
    let mut exclude = |reason: String, t: Nanos| {
        let entry = reasons.entry(reason.clone()).or_insert(Excluded {
            reason,
            instants: 0,
            first: t,
            last: t,
        });
        entry.instants += 1;
        entry.last = t;
    };
    let mut instants = Vec::new();
    for instant in all {
        let t = instant.t;
        if !instant.knows_motion(&robot.channels) {
            exclude(without_motion(robot, &instant), t);
            continue;
        }
        let mut excluded = Vec::new();
        for (channel, fault) in robot.channels.iter().zip(&instant.faults) {
            if let ChannelRole::Sensor(sensor) = channel.role
                && *fault != Reason::None
            {
                exclude(format!("{} of {}", fault.word(), channel.name), t);
                excluded.push(sensor);
            }
        }
        for contact in instant.active.difference(&robot.always).iter() {
            let name = robot.contacts.get(contact).map_or("", |c| c.name.as_str());
            let reason = format!("contact declared: {name} (the links that it touches)");
            exclude(reason, t);
        }
        let read = excluded
            .into_iter()
            .fold(instant, Observation::without_reading);
        instants.push(Annotated::from(read));
    }
    let excluded: Vec<Excluded> = reasons.into_values().collect();
    let is_short = folds(instants.iter().map(|instant| instant.t)) < 1;
    if is_short && !refused {
        let text = too_few(instants.len(), apart, &excluded, &findings);
        findings.push(Finding::refusal(FindingCode::TooShort, "", text));
    }
    PreparedLog {
        file,
        role,
        span,
        refused: refused || is_short,
        contacts: vec![SubtreeSet::default(); instants.len()],
        instants,
        excluded,
        findings,
    }
}

/// Why the motion is not known at an instant.
fn without_motion(robot: &Robot, instant: &Observation) -> String {
    let mut all = robot.channels.iter().zip(&instant.faults);
    let cause = all.find(|(channel, fault)| {
        !matches!(channel.role, ChannelRole::Sensor(_)) && **fault != Reason::None
    });
    match cause {
        Some((_, Reason::Starting)) => {
            "too close to the beginning, the end or a gap for accelerations".into()
        }
        Some((channel, fault)) => format!("{} of {}", fault.word(), channel.name),
        None => instant.base_fault.word().into(),
    }
}

/// A text if the samples of a log are too far apart for any sample to be valid until the next.
pub(crate) fn stamps_apart(robot: &Robot, dataset: &Dataset) -> Option<String> {
    let silence = robot.max_silence;
    dataset.apart.map(|spacing| {
        format!(
            "its samples are {spacing} s apart, and a channel counts as silent after {silence} s \
             (input.max_silence_ms): record faster, increase that limit, or, if t is in \
             milliseconds or nanoseconds, convert it to seconds"
        )
    })
}

/// Why so few observations can be used.
fn too_few(
    count: usize,
    apart: Option<String>,
    excluded: &[Excluded],
    findings: &[Finding],
) -> String {
    let why = if let Some(apart) = apart {
        apart
    } else if let Some(dead) = findings
        .iter()
        .find(|f| [FindingCode::Frozen, FindingCode::NeverSeen].contains(&f.code))
    {
        dead.text.clone()
    } else {
        let most = excluded.iter().max_by_key(|l| l.instants);
        most.map_or("record more motion".to_owned(), |l| {
            format!("{} excluded: {}", l.instants, l.reason)
        })
    };
    format!("usable instants: {count}, so nothing is identified from this log: {why}")
}

/// The information of each segment.
pub(crate) fn reduced_segments(
    measurement: &MeasurementModel<'_>,
    segments: &[LogSegment<'_>],
    noise: &NoiseModel,
) -> Vec<ReducedLog> {
    measurement.map(segments, |measurement, segment| {
        reduce(measurement, *segment, noise)
    })
}

/// The residuals of each segment, for these parameters.
pub(crate) fn segment_residuals(
    measurement: &MeasurementModel<'_>,
    segments: &[LogSegment<'_>],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> Vec<Residuals> {
    measurement.map(segments, |measurement, segment| {
        residuals(measurement, *segment, noise, std::slice::from_ref(d))
    })
}

/// All instants of all logs, in segments of at most `most`.
pub(crate) fn segments_of<'a>(training: &[&'a PreparedLog], most: usize) -> Vec<LogSegment<'a>> {
    let mut segments = Vec::new();
    for (number, log) in training.iter().enumerate() {
        let count = log.instants.len().div_ceil(most).max(1);
        for part in 0..count {
            let at = |k: usize| log.instants.len() * k / count;
            segments.push(LogSegment {
                instants: &log.instants[at(part)..at(part + 1)],
                log: Some(number),
            });
        }
    }
    segments
}

/// All instants of short logs; of long logs, stretches spread over them, and more where these lack
/// a channel. Noise and the prior's scale need no more.
pub(crate) fn sample<'a>(
    measurement: &MeasurementModel<'_>,
    training: &[&'a PreparedLog],
) -> Vec<LogSegment<'a>> {
    let total: usize = training.iter().map(|log| log.instants.len()).sum();
    if total <= SAMPLE_INSTANTS {
        return segments_of(training, usize::MAX);
    }
    let segments = segments_of(training, total / SAMPLE_STRETCHES);
    let least = SAMPLE_INSTANTS / SAMPLE_STRETCHES;
    let in_stretches: usize = segments
        .iter()
        .map(|segment| segment.instants.len().min(least))
        .sum();
    let every = ((in_stretches + SAMPLE_INSTANTS / 2) / SAMPLE_INSTANTS).max(1);
    let length = SAMPLE_INSTANTS / segments.len().div_ceil(every);
    let stretch = |segment: &LogSegment<'a>, start: usize| LogSegment {
        instants: &segment.instants[start..segment.instants.len().min(start + length)],
        ..*segment
    };
    let taken = segments.iter().step_by(every);
    let mut sampled: Vec<LogSegment<'a>> = taken.map(|segment| stretch(segment, 0)).collect();
    // How often each channel occurs, up to `MIN_FOLD`: without any sample of it, its noise would be
    // estimated as zero.
    let mut measurement = measurement.clone();
    let mut appears = vec![0; measurement.unknowns().channels()];
    let mut count_channels = |instant: &Annotated, appears: &mut [usize]| -> bool {
        let rows = measurement.rows(instant);
        let mut lacked = false;
        for (channel, appears) in appears.iter_mut().enumerate() {
            if rows.has(channel) {
                lacked |= *appears < MIN_FOLD;
                *appears += 1;
            }
        }
        lacked
    };
    for segment in &sampled {
        for instant in segment.instants {
            if appears.iter().all(|appears| *appears >= MIN_FOLD) {
                return sampled;
            }
            count_channels(instant, &mut appears);
        }
    }
    for (number, segment) in segments.iter().enumerate() {
        let mut i = if number % every == 0 { length } else { 0 };
        while i < segment.instants.len() && appears.iter().any(|appears| *appears < MIN_FOLD) {
            if count_channels(&segment.instants[i], &mut appears) {
                let additional = stretch(segment, i);
                for instant in &additional.instants[1..] {
                    count_channels(instant, &mut appears);
                }
                i += additional.instants.len() - 1;
                sampled.push(additional);
            }
            i += 1;
        }
    }
    sampled
}
