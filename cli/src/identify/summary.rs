//! `summary.json`: an outcome for programs.
//!
//! A number that is not there (nothing to compare, not measured) is `null`. SI units; six numbers
//! of an F/T sensor are in the order `fx fy fz tx ty tz` [N, Nm]; times within a log are seconds
//! since its first stamp. Wherever three sets of parameters are compared, it is as {`cad`,
//! `cad_fitted`, `identified`}: the CAD with the configured offsets, the CAD with offsets and
//! friction fitted to that log, the identified parameters with offsets and friction fitted to that
//! log.
//!
//! | key | what it is |
//! |---|---|
//! | `schema` | 2 |
//! | `robot`, `version` | the name of the robot, the version of this program |
//! | `verdict` | `identified`, `no_better_than_cad` or `nothing` |
//! | `reason` | why nothing was identified, in words; else `null` |
//! | `advice` | {`grade`: `accept`, `care` or `reject`; `why`: sentences; `next`: what to do} |
//! | `logs` | a list, in the order of the command line: below |
//! | `tau` | scale of the prior, chosen from the data: relative error of the CAD, at most 1 |
//! | `least_retained_fraction` | the least `retained_fraction` of `links` |
//! | `parameters` | how many inertial parameters there are |
//! | `structural_rank` | combinations of them that the robot's structure makes identifiable |
//! | `rank` | combinations that the logs depend on, offsets drifting (above rounding) |
//! | `effective_parameters` | combinations determined by the logs rather than the prior |
//! | `condition`, `singular_values` | of the logs' information, scaled by the prior |
//! | `weakest` | worst first: {`expression`, `relative`, `prior_share`}: below |
//! | `not_separable` | combinations that the motion of the logs cannot separate, in words |
//! | `time_offsets` | {`channel`, `seconds` (> 0: late), `std`, `significant`}: not corrected |
//! | `findings` | {`log` or `null`, `severity`, `code`, `subject`, `text`}: below |
//! | `links` | a list: below |
//! | `base_parameters` | {`expression`, `unit`, `cad`, `identified`, `std`} |
//! | `drives` | {joint: `signal`, `constant`, friction, `std`, `noise_nm`; or {`reason`}} |
//! | `rotor_inertia` | {joint: {`kgm2`, `std`}}: inertia times the square of the gear ratio |
//! | `calibration` | {sensor: ...}: below, where it was requested |
//! | `channels` | noise: {`name`, `unit`, `std`, `autocorrelation_s`, `drift`: unit per s^½} |
//!
//! - `verdict`: `no_better_than_cad` if held-out data showed no gain, or there was too little to
//!   hold any back: the parameters are those of the CAD then; `nothing`: there are no parameters.
//! - `weakest`: `relative` is the singular value over the greatest; `prior_share` is the share of
//!   the variance that is the prior's.
//! - `findings`: `severity` is `note`, `warning` or `refusal`; `code` one word
//!   ([`proprio_identification::FindingCode`]); `subject` a channel, joint or link.
//! - `links`: {`name`, `observed`, `retained_fraction`: share of the change from the CAD that is
//!   retained after cross-validation, `significance`, `cad`, `identified`, `std`}; ten numbers
//!   each, `m h_x h_y h_z I_xx I_xy I_xz I_yy I_yz I_zz` about the origin of the link.
//! - `calibration`: {`gain`: 36 numbers row by row, rows and columns `fx fy fz tx ty tz`;
//!   `gain_error`: error of the factory's gain, relative to corrected readings, 6 numbers (a
//!   diagonal) or 36; `gain_std`; `gain_prior_std`: before any log; `per_kelvin`: six numbers;
//!   `per_kelvin_std`; `reference_celsius`}.
//!
//! A log:
//!
//! | key | what it is |
//! |---|---|
//! | `file`, `role` | its file name; `train` or `validate` |
//! | `span_s`, `observations` | its length; how many observations are used |
//! | `excluded` | those not used: {`reason`, `observations`, `first_s`, `last_s`} |
//! | `onset_s` | when the robot began to move; `null`: from the start, or never |
//! | `predicted` | the prediction errors by which parameters are judged: below |
//! | `joints` | {name: {`rms_nm`: the three, `measured_rms_nm`, `coverage`}} |
//! | `sensors` | {name: {`rms`: the three, six numbers each; `coverage`: six numbers}} |
//! | `two_route_rms_nm` | {joint: the three}: RMS of the difference between the two torques |
//! | `two_route_rms_mean_removed_nm` | the same without the mean of the difference |
//! | `offsets` | {sensor: {`start`, `end`, `std`, `rate`: six numbers each}} |
//! | `friction` | {joint: {`coulomb_nm`, `viscous`: Nm s/rad, `offset_nm`, `std`: of the three}} |
//!
//! `coverage` is the share of observations within 1.96 standard deviations. The two torques of
//! `two_route` are those from the F/T sensors on either side of the joint.
//!
//! `predicted`, of the CAD and of the identified parameters, {`cad`, `identified`}: parameters,
//! gains and friction are those from the training logs, and nothing is fitted to the log but one
//! constant offset of each F/T channel. It depends on that log and the parameters alone.
//!
//! | key | what it is |
//! |---|---|
//! | `relative_error` | norm of (predicted - measured) over norm of measured |
//! | `relative_error_with_drift` | the same with a linear drift of each F/T channel fitted, too |
//! | `joints_rms_nm` | {name: RMS}, of joints with a measured torque |
//! | `sensors_rms` | {name: RMS, six numbers} of readings less predicted readings |
//! | `two_route_rms_nm` | {joint: RMS}, of the difference between the two torques |
//!
//! `relative_error` is that of joint torques if any was measured, else of F/T readings without
//! mean.

use super::advice::{Advice, findings};
use proprio_dynamics::calibration::force_first;
use proprio_identification::{CalibrationOutcome, LogOutcome, LogRole, Outcome, Severity, Verdict};
use proprio_topics::Nanos;
use serde_json::{Map, Value as Json, json};
use std::ops::Range;

/// The outcome as JSON.
pub(crate) fn summary(outcome: &Outcome, advice: &Advice) -> Json {
    let (verdict, reason) = match &outcome.verdict {
        Verdict::Identified => ("identified", None),
        Verdict::NoBetterThanCad => ("no_better_than_cad", None),
        Verdict::Nothing(reason) => ("nothing", Some(reason)),
    };
    let found: Vec<Json> = findings(outcome)
        .map(|(log, f)| {
            json!({
                "log": log.map(|l| &l.file), "severity": severity(f.severity),
                "code": f.code.as_str(), "subject": f.subject, "text": f.text,
            })
        })
        .collect();
    let links: Vec<Json> = outcome
        .links
        .iter()
        .map(|l| {
            json!({
                "name": l.name, "observed": l.seen, "retained_fraction": l.retained_fraction,
                "significance": l.significance,
                "cad": l.cad.parameters(), "identified": l.identified.parameters(),
                "std": l.deviation,
            })
        })
        .collect();
    let rotors = object(&outcome.rotors, |r| (&r.joint, json!(r)));
    let calibration = object(&outcome.calibrations, |c| (&c.sensor, calibration(c)));
    json!({
        "schema": 3, "robot": outcome.robot, "version": env!("CARGO_PKG_VERSION"),
        "verdict": verdict, "reason": reason,
        "advice": { "grade": advice.grade.word(), "why": advice.why, "next": advice.next },
        "logs": outcome.logs.iter().map(log).collect::<Vec<_>>(),
        "tau": outcome.tau, "least_retained_fraction": outcome.least_retained_fraction,
        "parameters": outcome.unknowns, "structural_rank": outcome.structural_rank,
        "rank": outcome.rank, "effective_parameters": outcome.effective,
        "condition": outcome.condition, "singular_values": outcome.singular_values,
        "weakest": outcome.weakest, "not_separable": outcome.not_separable,
        "time_offsets": outcome.time_offsets, "findings": found, "links": links,
        "base_parameters": outcome.base_parameters, "rotor_inertia": rotors,
        "calibration": calibration, "channels": outcome.channels,
    })
}

fn calibration(c: &CalibrationOutcome) -> Json {
    let gains = c.kind.count() - 6 * usize::from(c.kind.temperature);
    let part =
        |values: &[f64], range: Range<usize>| force_first(values.get(range).unwrap_or_default());
    let of_gain = |values: &[f64]| part(values, 0..gains);
    let of_temperature = |values: &[f64]| part(values, gains..values.len());
    json!({
        "gain": c.identified.gain_force_first().to_vec(),
        "gain_error": of_gain(&c.error), "gain_std": of_gain(&c.deviation),
        "gain_prior_std": of_gain(&c.prior),
        "per_kelvin": c.identified.per_kelvin().force_first(),
        "per_kelvin_std": of_temperature(&c.deviation),
        "reference_celsius": c.identified.reference(),
    })
}

fn log(log: &LogOutcome) -> Json {
    let since = |t: Nanos| (t - log.span.0).seconds();
    let excluded: Vec<Json> = log
        .excluded
        .iter()
        .map(|l| {
            json!({
                "reason": l.reason, "observations": l.instants, "first_s": since(l.first),
                "last_s": since(l.last),
            })
        })
        .collect();
    json!({
        "file": log.file,
        "role": role(log.role),
        "span_s": since(log.span.1), "observations": log.used, "excluded": excluded,
        "onset_s": log.onset.map(since),
        "predicted": log.predicted,
        "joints": object(&log.joints, |j| (&j.name, json!(j))),
        "sensors": object(&log.sensors, |s| (&s.name, json!(s))),
        "two_route_rms_nm": object(&log.two_route, |t| (&t.joint, json!(t.rms_nm))),
        "two_route_rms_mean_removed_nm":
            object(&log.two_route, |t| (&t.joint, json!(t.rms_mean_removed_nm))),
        "offsets": object(&log.offsets, |o| (&o.sensor, json!(o))),
        "friction": object(&log.friction, |f| (&f.joint, json!(f))),
    })
}

fn object<'a, T>(items: &'a [T], entry: impl Fn(&'a T) -> (&'a String, Json)) -> Map<String, Json> {
    items
        .iter()
        .map(entry)
        .map(|(name, value)| (name.clone(), value))
        .collect()
}

/// A role's word.
pub(crate) fn role(role: LogRole) -> &'static str {
    match role {
        LogRole::Train => "train",
        LogRole::Validate => "validate",
    }
}

/// A severity's word.
pub(crate) fn severity(severity: Severity) -> &'static str {
    match severity {
        Severity::Note => "note",
        Severity::Warning => "warning",
        Severity::Refusal => "refusal",
    }
}

#[cfg(test)]
mod tests {
    use super::super::example;
    use super::*;

    #[test]
    fn the_keys_that_programs_rely_on_are_there_and_numbers_that_are_not_are_null() {
        let outcome = example::outcome();
        let json = summary(&outcome, &Advice::of(&outcome));
        let text = json.to_string();
        assert!(!text.contains("NaN") && serde_json::from_str::<Json>(&text).is_ok());
        let log = &json["logs"][0];
        assert_eq!(
            (&log["file"], &log["role"]),
            (&json!("walk_1.csv"), &json!("train"))
        );
        assert_eq!(json["logs"][1]["role"], "validate");
        assert_eq!(
            log["predicted"],
            json!({
                "relative_error": { "cad": 0.064, "identified": 0.0235 },
                "relative_error_with_drift": { "cad": 0.06, "identified": 0.0225 },
                "joints_rms_nm": { "r_knee": { "cad": 0.24, "identified": 0.09 } },
                "sensors_rms": {
                    "r_leg_ft_sensor": {
                        "cad": [0.6, 3.0, 0.6, 0.3, 0.2, 0.1],
                        "identified": [0.5, 0.5, 0.5, 0.5, 0.5, 0.5],
                    }
                },
                "two_route_rms_nm": { "r_knee": { "cad": 0.25, "identified": 0.14 } },
            })
        );
        assert_eq!(
            log["joints"]["r_knee"]["rms_nm"],
            json!({ "cad": 0.9, "cad_fitted": 0.2, "identified": 0.07 })
        );
        let rms = &log["sensors"]["r_leg_ft_sensor"]["rms"];
        assert_eq!(rms["cad"], json!([null, null, null, null, null, null]));
        assert_eq!(rms["identified"], json!([0.4, 0.9, 0.45, 0.1, 0.09, 0.04]));
        assert_eq!(
            log["sensors"]["r_leg_ft_sensor"]["coverage"],
            json!([0.95, 0.94, 0.968, 0.95, 0.97, 0.93])
        );
        assert_eq!(log["two_route_rms_nm"]["r_knee"]["identified"], 0.13);
        assert_eq!(
            (&json["tau"], &json["rank"], &json["condition"]),
            (&json!(0.58), &json!(31), &json!(3.2e5))
        );
        assert_eq!(json["weakest"].as_array().map(Vec::len), Some(20));
        assert_eq!(json["time_offsets"][0]["channel"], "wrench/r_leg_ft_sensor");
        assert_eq!(log["onset_s"], 4.0);
        assert_eq!(
            log["excluded"][1],
            json!({
                "reason": "contact declared: right_foot", "observations": 240, "first_s": 12.0,
                "last_s": 14.4,
            })
        );
        assert_eq!(json["findings"][0]["log"], Json::Null);
        assert_eq!(json["findings"][1]["code"], "disturbance");
    }

    #[test]
    fn every_key_is_documented() {
        let text = include_str!("summary.rs");
        let documented = |key: &str| {
            text.lines()
                .any(|line| line.starts_with("//!") && line.contains(&format!("`{key}`")))
        };
        let outcome = example::outcome();
        let json = summary(&outcome, &Advice::of(&outcome));
        let mut objects = vec![&json, &json["logs"][0]];
        for list in [
            "findings",
            "links",
            "base_parameters",
            "channels",
            "weakest",
            "time_offsets",
        ] {
            objects.push(&json[list][0]);
        }
        objects.extend([&json["advice"], &json["logs"][0]["excluded"][0]]);
        objects.extend([
            &json["calibration"]["r_leg_ft_sensor"],
            &json["logs"][0]["offsets"]["r_leg_ft_sensor"],
            &json["logs"][0]["friction"]["r_knee"],
            &json["rotor_inertia"]["r_knee"],
            &json["logs"][0]["joints"]["r_knee"],
            &json["logs"][0]["predicted"],
        ]);
        for object in objects {
            let object = object.as_object().expect("an object");
            for key in object.keys() {
                assert!(documented(key), "{key} is not documented");
            }
        }
    }
}
