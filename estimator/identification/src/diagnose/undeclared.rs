//! Undeclared disturbances in the logs: contacts and loads. They are updated after each fit
//! ([`crate::diagnose::disturbance`] and [`crate::diagnose::load`] find them), marked in the logs
//! so that the next fit excludes them, and reported at the end.

use crate::dataset::LogRole;
use crate::dataset::observation::SubtreeSet;
use crate::diagnose::load::LoadChange;
use crate::diagnose::{disturbance, load};
use crate::finding::{Finding, FindingCode};
use crate::fit::{Identified, NoiseAndMap};
use crate::measurement::channels;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_model::NoiseModel;
use crate::prepared_log::{Excluded, PreparedLog, training_logs, training_logs_mut};
use crate::robot::Robot;
use nalgebra::DVector;
use proprio_topics::Nanos;
use std::ops::Range;

/// A contact within this time of a change of load is the hand that gives or takes the load \[s\]
/// ...
const NEAR_LOAD_CHANGE: f64 = 1.0;
/// ... if it lasts no longer than this \[s\], or than the uncertainty of the time of the change, if
/// that is longer. Two changes of load within this time are the same one.
const LONGEST_HANDOVER: f64 = 3.0;

/// Most rounds of disturbances of validation logs, for a given fit.
const ROUNDS: usize = 4;

/// Adds a load. One that differs from another only by a slightly different time of change is
/// merged with it: that time is known only to a segment of the log.
pub(crate) fn add_load(loads: &mut Vec<LoadChange>, load: LoadChange) {
    let edge = |load: &LoadChange| {
        let (first, last) = load.span;
        if load.is_after { first } else { last }
    };
    let is_same = |other: &&mut LoadChange| {
        let apart = (edge(other) - edge(&load)).seconds().abs();
        (other.log, other.index, other.is_after) == (load.log, load.index, load.is_after)
            && apart <= LONGEST_HANDOVER.max(1.5 * load.within)
    };
    match loads.iter_mut().find(is_same) {
        Some(other) => {
            other.span = (other.span.0.min(load.span.0), other.span.1.max(load.span.1));
            other.clear = (
                other.clear.0.max(load.clear.0),
                other.clear.1.min(load.clear.1),
            );
        }
        None => loads.push(load),
    }
}

/// Updates the contacts of the logs from the residuals of a fit, and marks the logs; true if
/// nothing changed.
pub(crate) fn update<'a>(
    measurement: &MeasurementModel<'_>,
    logs: impl Iterator<Item = &'a mut PreparedLog>,
    loads: &[LoadChange],
    noise: &NoiseModel,
    d: &DVector<f64>,
) -> bool {
    let mut logs: Vec<&mut PreparedLog> = logs.collect();
    let seen: Vec<&PreparedLog> = logs.iter().map(|log| &**log).collect();
    let contacts = disturbance::contacts(measurement, &seen, loads, noise, d);
    let mut unchanged = true;
    for (log, contacts) in logs.iter_mut().zip(contacts) {
        unchanged &= log.contacts == contacts;
        log.contacts = contacts;
    }
    if !unchanged {
        mark(logs.into_iter(), loads);
    }
    unchanged
}

/// Marks the disturbed instants of the logs.
pub(crate) fn mark<'a>(logs: impl Iterator<Item = &'a mut PreparedLog>, loads: &[LoadChange]) {
    for (number, log) in logs.enumerate() {
        for (instant, contact) in log.instants.iter_mut().zip(&log.contacts) {
            let carries = |load: &&LoadChange| load.log == number && load.has(instant.t);
            let loads = loads.iter().filter(carries);
            instant.disturbed = loads.fold(*contact, |set, load| set.union(&load.subtrees));
        }
    }
}

/// Reports in the logs what was excluded because of undeclared disturbances.
pub(crate) fn report(
    measurement: &MeasurementModel<'_>,
    logs: &mut [PreparedLog],
    loads: &[LoadChange],
    estimate: &NoiseAndMap,
) {
    let robot = measurement.robot();
    let training = training_logs(logs);
    let body = |load: &LoadChange| load::added_body(measurement, &training, load, estimate);
    let bodies: Vec<Option<(usize, load::AddedBody)>> = loads.iter().map(body).collect();
    for (number, log) in training_logs_mut(logs).enumerate() {
        let log_loads = loads.iter().zip(&bodies);
        let log_loads = log_loads.filter(|(load, _)| load.log == number);
        let loads: Vec<&LoadChange> = log_loads.clone().map(|(load, _)| load).collect();
        let apparent = apparent_contacts(log, &loads);
        for (part, excluded, when) in suspected(robot, log, &apparent) {
            log.excluded.push(excluded);
            let text = format!(
                "{part}: undeclared disturbance (contact, load or a jump of a sensor's offset) \
                 {when}. These instants were excluded; declare contacts where they occur"
            );
            log.findings
                .push(Finding::warning(FindingCode::Disturbance, part, text));
        }
        for (index, (load, body)) in log_loads.enumerate() {
            let handovers = apparent.iter().filter(|own| own.load == Some(index));
            report_load(measurement, log, load, body.as_ref(), handovers);
        }
    }
}

/// Reports that the load differed in a part of a log, which was excluded, and the inertial
/// parameters of that load, if they are known. `handovers`: contacts of the hands that gave or took
/// it.
fn report_load<'a>(
    measurement: &MeasurementModel<'_>,
    log: &mut PreparedLog,
    load: &LoadChange,
    body: Option<&(usize, load::AddedBody)>,
    handovers: impl Iterator<Item = &'a ApparentContact>,
) {
    let (robot, unknowns) = (measurement.robot(), measurement.unknowns());
    let index = body.map_or(load.index, |(index, _)| *index);
    let link = robot.model.link_name(unknowns.links[index]);
    let since = |t: Nanos| (t - log.span.0).seconds();
    let stamps = log.instants.iter().map(|instant| instant.t);
    let mut out: Vec<bool> = stamps.map(|t| load.has(t)).collect();
    for contact_span in handovers {
        out[contact_span.instants.clone()].fill(true);
    }
    let out: Vec<Nanos> = (log.instants.iter().zip(out))
        .filter(|(_, out)| *out)
        .map(|(instant, _)| instant.t)
        .collect();
    let (Some(&first), Some(&last)) = (out.first(), out.last()) else {
        return;
    };
    log.excluded.push(Excluded {
        reason: format!("another load: {link}"),
        instants: out.len() as u64,
        first,
        last,
    });
    let (when, at) = if load.is_after {
        ("From", first)
    } else {
        ("Up to", last)
    };
    let what = body.map_or(String::new(), |(_, body)| {
        let p = &body.parameters;
        let sigma = |i: usize| body.covariance[(i, i)].sqrt();
        format!(
            ": {:+.3} +- {:.3} kg, first moment {:+.4}, {:+.4}, {:+.4} +- {:.4} kg m in the axes \
             and about the origin of {link}",
            p[0],
            sigma(0),
            p[1],
            p[2],
            p[3],
            (1..4).map(sigma).fold(0.0, f64::max)
        )
    });
    log.findings.push(Finding::warning(
        FindingCode::LoadChanged,
        link,
        format!(
            "{when} about {:.1} s after the log's start, {link} carried another load than in the \
             rest of the data{what}. That part was excluded: the parameters are those without \
             this load",
            since(at)
        ),
    ));
}

/// A warning that the excluded instants still change after `fits` fits.
pub(crate) fn not_converged(fits: usize) -> Finding {
    Finding::warning(
        FindingCode::DisturbancesNotConverged,
        "",
        format!(
            "undeclared disturbances did not converge in {fits} fits: check the \
             instants that the logs exclude, and declare contacts where they occurred"
        ),
    )
}

/// Description of the links of a sub-tree.
fn part(robot: &Robot, subtree: usize) -> String {
    match robot.structure.subtrees().get(subtree) {
        Some(subtree) => {
            let sensors: Vec<String> = subtree
                .sensors
                .iter()
                .map(|s| channels::sensor_name(robot, s))
                .collect();
            format!("the links at {}", sensors.join(", "))
        }
        None => "the links whose joint torques are measured".to_owned(),
    }
}

/// Consecutive disturbed instants of a sub-tree.
struct ApparentContact {
    subtree: usize,
    instants: Range<usize>,
    /// The load that a hand gives or takes there; none if it is a contact.
    load: Option<usize>,
}

/// The union of these sets.
fn subtrees(contacts: &[SubtreeSet]) -> SubtreeSet {
    contacts
        .iter()
        .fold(SubtreeSet::default(), |union, set| union.union(set))
}

/// The apparent contacts of a log with their causes; `loads`: loads whose hands may be one.
fn apparent_contacts(log: &PreparedLog, loads: &[&LoadChange]) -> Vec<ApparentContact> {
    let contacts = &log.contacts;
    let mut apparent_contacts = Vec::new();
    for subtree in subtrees(contacts).iter() {
        let mut begin = 0;
        for instants in contacts.chunk_by(|a, b| a.contains(subtree) == b.contains(subtree)) {
            let range = begin..begin + instants.len();
            begin = range.end;
            if !instants[0].contains(subtree) {
                continue;
            }
            let (first, last) = (log.instants[range.start].t, log.instants[range.end - 1].t);
            let lasts = (last - first).seconds();
            let is_near = |(from, to): (Nanos, Nanos), seconds: f64| {
                (from - last).seconds() <= seconds && (first - to).seconds() <= seconds
            };
            let is_handed = |load: &&LoadChange| {
                load.subtrees.contains(subtree) && is_near(load.span, NEAR_LOAD_CHANGE)
            };
            let load = loads.iter().position(is_handed);
            let load = load.filter(|&load| lasts <= LONGEST_HANDOVER.max(loads[load].within));
            apparent_contacts.push(ApparentContact {
                subtree,
                instants: range,
                load,
            });
        }
    }
    apparent_contacts
}

/// Each sub-tree with contacts: its links, what is excluded, and in words how often, when and how
/// long.
fn suspected(
    robot: &Robot,
    log: &PreparedLog,
    contacts: &[ApparentContact],
) -> Vec<(String, Excluded, String)> {
    let contacts = contacts.iter().filter(|own| own.load.is_none());
    let contacts: Vec<&ApparentContact> = contacts.collect();
    let of_subtree = |own: &[&ApparentContact]| {
        let part = part(robot, own[0].subtree);
        let instants: usize = own.iter().map(|own| own.instants.len()).sum();
        let first = log.instants[own[0].instants.start].t;
        let last = log.instants[own[own.len() - 1].instants.end - 1].t;
        let since = |t: Nanos| (t - log.span.0).seconds();
        let when = format!(
            "{} time{} between {:.1} and {:.1} s after the log's start, {:.1} % of the log",
            own.len(),
            if own.len() == 1 { "" } else { "s" },
            since(first),
            since(last),
            100.0 * instants as f64 / log.instants.len() as f64
        );
        let excluded = Excluded {
            reason: format!("contact suspected: {part}"),
            instants: instants as u64,
            first,
            last,
        };
        (part, excluded, when)
    };
    // They are in the order of the sub-trees.
    let subtrees = contacts.chunk_by(|a, b| a.subtree == b.subtree);
    subtrees.map(of_subtree).collect()
}

/// Reports undeclared disturbances of the validation logs. The figures of these logs still include
/// all rows: validation data must not be selected by the model that they validate.
pub(crate) fn report_validation(logs: &mut [PreparedLog], identified: &Identified<'_>) {
    let is_checked = |log: &&mut PreparedLog| log.role == LogRole::Validate && !log.refused;
    let (measurement, robot) = (&identified.measurement, identified.robot());
    let converges = (0..ROUNDS).any(|_| {
        let checked = logs.iter_mut().filter(is_checked);
        update(measurement, checked, &[], &identified.noise, &identified.d)
    });
    for log in logs.iter_mut().filter(is_checked) {
        let apparent = apparent_contacts(log, &[]);
        for (part, _, when) in suspected(robot, log, &apparent) {
            let text = format!(
                "{part}: residuals as of an undeclared disturbance (contact, load or a jump of a \
                 sensor's offset) {when}. The figures of this log include these instants"
            );
            log.findings
                .push(Finding::note(FindingCode::Disturbance, part, text));
        }
        if !converges {
            log.findings.push(Finding::note(
                FindingCode::DisturbancesNotConverged,
                "",
                format!(
                    "undeclared disturbances of this log did not converge in \
                     {ROUNDS} rounds: those reported are uncertain"
                ),
            ));
        }
        for instant in &mut log.instants {
            instant.disturbed = SubtreeSet::default();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A load that comes at `from` \[s\], known to `within`, of a log of 100 s.
    fn load(log: usize, index: usize, from: i64, within: f64) -> LoadChange {
        let at = |seconds: i64| Nanos::from_millis(1000 * seconds);
        LoadChange {
            log,
            index,
            span: (at(from), at(100)),
            clear: (at(from + 1), at(100)),
            within,
            is_after: true,
            subtrees: SubtreeSet::default(),
        }
    }

    #[test]
    fn two_findings_of_one_load_change_are_merged() {
        let merged = |loads: &[LoadChange]| {
            let mut merged = Vec::new();
            let each = loads.iter().cloned();
            each.for_each(|load| add_load(&mut merged, load));
            merged
        };
        let first = load(0, 3, 23, 1.0);
        for sooner in [22, 24] {
            let [one] = merged(&[first.clone(), load(0, 3, sooner, 1.0)])
                .try_into()
                .unwrap();
            // All instants that may have the load are excluded; those that surely have it give its
            // parameters.
            assert_eq!(one.span, load(0, 3, sooner.min(23), 1.0).span);
            assert_eq!(one.clear, load(0, 3, sooner.max(23), 1.0).clear);
        }
        // In a long log the time of a change is known to a longer segment.
        assert_eq!(merged(&[load(0, 3, 40, 9.4), load(0, 3, 31, 9.4)]).len(), 1);
        for other in [
            load(1, 3, 22, 1.0),
            load(0, 4, 22, 1.0),
            load(0, 3, 18, 1.0),
        ] {
            assert_eq!(
                merged(&[first.clone(), other.clone()]),
                [first.clone(), other]
            );
        }
    }
}
