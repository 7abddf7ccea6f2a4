//! Assembles the [`Outcome`]: the errors of every log with CAD, with CAD and fitted offsets, and
//! with the identified parameters; the parameters with their uncertainty; findings.

use crate::finding::{Finding, FindingCode};
use crate::fit::{Identified, per_column};
use crate::measurement::model::MeasurementModel;
use crate::report::calibration::{calibrations, channels};
use crate::report::log::log_outcome;
use crate::report::outcome::both;
use crate::report::outcome::{
    CovarianceRoot, LogOutcome, Outcome, Predicted, TimeOffset, Verdict, WeakDirection,
};
use crate::report::prediction::{self, Candidate};
use crate::report::uncertainty::{
    base_parameters, cad_root, covariance, expression, links, rotors, rotors_not_separable,
    scaled_information, shrunk, subspace, unseen,
};
use crate::robot::Robot;
use crate::training::TrainingLog;
use nalgebra::DMatrix;
use proprio_topics::Nanos;

/// The outcome without identified parameters: CAD's, and the reason.
pub(crate) fn nothing(robot: &Robot, logs: &[TrainingLog], reason: String) -> Outcome {
    let logs = logs.iter().map(|log| LogOutcome {
        file: log.file.clone(),
        role: log.role,
        span: log.span,
        used: 0,
        excluded: log.excluded.clone(),
        onset: None,
        predicted: Predicted {
            relative_error: both([f64::NAN; 2]),
            relative_error_with_drift: both([f64::NAN; 2]),
            ..Predicted::default()
        },
        joints: Vec::new(),
        sensors: Vec::new(),
        two_route: Vec::new(),
        offsets: Vec::new(),
        friction: Vec::new(),
        findings: log.findings.clone(),
        curves: Vec::new(),
    });
    Outcome {
        robot: robot.name.clone(),
        links: robot
            .model
            .inertias()
            .iter()
            .enumerate()
            .map(|(link, cad)| unseen(robot, link, cad))
            .collect(),
        covariance: CovarianceRoot {
            columns: Vec::new(),
            calibrations: Vec::new(),
            root: DMatrix::zeros(0, 0),
        },
        rotors: Vec::new(),
        calibrations: Vec::new(),
        tau: f64::NAN,
        least_retained_fraction: 0.0,
        unknowns: 0,
        rank: 0,
        structural_rank: 0,
        effective: 0.0,
        condition: f64::NAN,
        singular_values: Vec::new(),
        weakest: Vec::new(),
        not_separable: Vec::new(),
        base_parameters: Vec::new(),
        channels: Vec::new(),
        time_offsets: Vec::new(),
        logs: logs.collect(),
        findings: vec![Finding::refusal(
            FindingCode::NotIdentified,
            "",
            reason.clone(),
        )],
        verdict: Verdict::Nothing(reason),
    }
}

/// The whole outcome; with what the search for errors of the set-up `found`, and the time offset of
/// every stream.
pub(crate) fn outcome(
    robot: &Robot,
    measurement: &MeasurementModel<'_>,
    logs: &[TrainingLog],
    training: &[&TrainingLog],
    identified: &Identified,
    (found, time_offsets): (Vec<Finding>, Vec<TimeOffset>),
) -> Outcome {
    let unknowns = &identified.unknowns;
    let p = unknowns.inertial();
    let narrow = identified.fit.covariance_root();
    let (scaled, spread) = scaled_information(identified);
    let root = if identified.retained.iter().all(|kept| *kept >= 1.0) {
        narrow.clone()
    } else {
        let kept = per_column(unknowns, &identified.retained);
        let (r, _) = identified.information.to_triangle();
        shrunk(&narrow, &cad_root(unknowns, &r, &spread), &kept)
    };
    let svd = scaled.svd(false, true);
    let mut order: Vec<usize> = (0..svd.singular_values.len()).collect();
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    let singular: Vec<f64> = order.iter().map(|&i| svd.singular_values[i]).collect();
    let greatest = singular.first().copied().unwrap_or(0.0);
    let rank = singular
        .iter()
        .filter(|s| **s > 1e-8 * greatest && greatest > 0.0)
        .count();
    let subspace = subspace(robot, training, identified);
    let directions = svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, p));
    let weakest = order[..rank].iter().rev().take(5).map(|&i| {
        let direction = directions.row(i).transpose();
        let value = svd.singular_values[i];
        let (expression, links) = expression(robot, unknowns, &spread, &direction);
        WeakDirection {
            expression,
            links,
            relative: value / greatest,
            prior_share: 1.0 / (1.0 + value * value),
        }
    });
    let (base_parameters, mut not_separable, structural_rank) =
        base_parameters(robot, identified, &root, subspace.as_ref());
    let sums = rotors_not_separable(robot, identified, &spread);
    let structural_rank = structural_rank.saturating_sub(sums.len());
    not_separable.extend(sums);
    let mut findings: Vec<Finding> = identified
        .prior
        .floors()
        .iter()
        .filter(|floor| unknowns.links.contains(&floor.link))
        .map(|floor| {
            Finding::note(
                FindingCode::InertiaRegularised,
                robot.model.link_name(floor.link),
                floor.describe(robot.model.link_name(floor.link)),
            )
        })
        .collect();
    findings.extend(found);
    findings.extend(identified.findings.iter().cloned());
    let (calibrations, calibration_findings) = calibrations(robot, measurement, identified, &root);
    findings.extend(calibration_findings);
    let mut measurement = measurement.clone();
    let sets = [identified.cad.clone(), identified.d.clone()];
    let instants = training.iter().flat_map(|log| &log.instants);
    let friction = prediction::friction(&measurement, instants, &sets);
    let candidates = [0, 1].map(|set| Candidate {
        course: vec![(Nanos::ZERO, sets[set].clone())],
        friction: friction[set].clone(),
    });
    let logs = logs
        .iter()
        .map(|log| log_outcome(&mut measurement, log, identified, &sets, &candidates, &root))
        .collect();
    Outcome {
        robot: robot.name.clone(),
        verdict: verdict(identified),
        links: links(robot, identified, &narrow, &root, &spread),
        covariance: covariance(unknowns, &identified.reduced, &root),
        tau: identified.fit.tau,
        least_retained_fraction: identified.retained[..unknowns.links.len()]
            .iter()
            .copied()
            .fold(1.0, f64::min),
        rotors: rotors(robot, identified, &root),
        calibrations,
        unknowns: p,
        rank,
        structural_rank,
        effective: identified.fit.effective,
        condition: if rank > 0 {
            greatest / singular[rank - 1]
        } else {
            f64::NAN
        },
        singular_values: singular,
        weakest: weakest.collect(),
        not_separable,
        base_parameters,
        channels: channels(robot, identified, training),
        time_offsets,
        logs,
        findings,
    }
}

/// The verdict after cross-validation.
fn verdict(identified: &Identified) -> Verdict {
    if identified.retained.iter().any(|kept| *kept > 0.0) {
        Verdict::Identified
    } else {
        Verdict::NoBetterThanCad
    }
}
