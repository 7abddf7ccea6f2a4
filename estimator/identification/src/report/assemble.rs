//! Assembles the [`Outcome`]: the errors of every log with CAD, with CAD and fitted offsets, and
//! with the identified parameters; the parameters with their uncertainty; findings.

use crate::finding::{Finding, FindingCode};
use crate::fit::{Identified, per_column};
use crate::measurement::unknowns::Unknowns;
use crate::prepared_log::{PreparedLog, training_logs};
use crate::report::calibration::{calibrations, channels};
use crate::report::comparison::Judged;
use crate::report::log::log_outcome;
use crate::report::outcome::both;
use crate::report::outcome::{LogOutcome, Outcome, Predicted, TimeOffset, Verdict, WeakDirection};
use crate::report::uncertainty::{
    base_parameters, cad_root, covariance, expression, links, rotors, rotors_not_separable,
    scaled_information, shrunk, subspace, unseen,
};
use crate::robot::Robot;
use nalgebra::DMatrix;

/// The outcome without identified parameters: CAD's, and the reason, with what was found.
pub(crate) fn nothing(
    robot: &Robot,
    logs: &[PreparedLog],
    reason: String,
    found: Vec<Finding>,
) -> Outcome {
    let logs = logs.iter().map(|log| LogOutcome {
        file: log.file.clone(),
        role: log.role,
        span: log.span,
        excluded: log.excluded.clone(),
        predicted: Predicted {
            relative_error: both([f64::NAN; 2]),
            relative_error_with_drift: both([f64::NAN; 2]),
            ..Predicted::default()
        },
        findings: log.findings.clone(),
        ..LogOutcome::default()
    });
    let links = robot.model.inertias().iter().enumerate();
    let finding = Finding::refusal(FindingCode::NotIdentified, "", reason.clone());
    Outcome {
        robot: robot.name.clone(),
        links: links.map(|(link, cad)| unseen(robot, link, cad)).collect(),
        tau: f64::NAN,
        condition: f64::NAN,
        logs: logs.collect(),
        findings: std::iter::once(finding).chain(found).collect(),
        verdict: Verdict::Nothing(reason),
        ..Outcome::default()
    }
}

/// The whole outcome; with what the search for errors of the set-up `found`, and the time offset of
/// every stream.
pub(crate) fn outcome(
    logs: &[PreparedLog],
    identified: &Identified<'_>,
    (found, time_offsets): (Vec<Finding>, Vec<TimeOffset>),
) -> Outcome {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let training = training_logs(logs);
    let narrow = identified.fit.covariance_root();
    let (scaled, spread) = scaled_information(identified);
    let root = if identified.retained.iter().all(|kept| *kept >= 1.0) {
        narrow.clone()
    } else {
        let kept = per_column(unknowns, &identified.retained);
        let (r, _) = identified.information.to_triangle();
        shrunk(&narrow, &cad_root(unknowns, &r, &spread), &kept)
    };
    let subspace = subspace(&training, identified);
    let (base_parameters, mut not_separable, structural_rank) =
        base_parameters(identified, &root, subspace.as_ref());
    let sums = rotors_not_separable(identified, &spread);
    let structural_rank = structural_rank.saturating_sub(sums.len());
    not_separable.extend(sums);
    let mut findings = inertia_findings(identified);
    findings.extend(found);
    findings.extend(identified.findings.iter().cloned());
    let (calibrations, calibration_findings) = calibrations(identified, &root);
    findings.extend(calibration_findings);
    let judged = Judged::new(logs, identified, &root);
    let Spectrum {
        singular_values,
        rank,
        condition,
        weakest,
    } = spectrum(robot, unknowns, scaled, &spread);
    Outcome {
        robot: robot.name.clone(),
        verdict: verdict(identified),
        links: links(identified, &narrow, &root, &spread),
        covariance: covariance(unknowns, &identified.reduced, &root),
        tau: identified.fit.tau,
        least_retained_fraction: identified.retained[..unknowns.links.len()]
            .iter()
            .copied()
            .fold(1.0, f64::min),
        rotors: rotors(identified, &root),
        calibrations,
        unknowns: unknowns.inertial(),
        structural_rank,
        effective: identified.fit.effective,
        not_separable,
        base_parameters,
        channels: channels(identified, &training),
        time_offsets,
        logs: logs.iter().map(|log| log_outcome(log, &judged)).collect(),
        findings,
        rank,
        condition,
        weakest,
        singular_values,
    }
}

/// Notes of the seen links whose inertia in CAD is that of no body.
fn inertia_findings(identified: &Identified<'_>) -> Vec<Finding> {
    let floors = identified.prior.floors().iter();
    let seen = floors.filter(|floor| identified.unknowns().links.contains(&floor.link));
    seen.map(|floor| {
        let name = identified.robot().model.link_name(floor.link);
        let text = floor.describe(name);
        Finding::note(FindingCode::InertiaRegularised, name, text)
    })
    .collect()
}

/// What the logs tell of the links' parameters in units of the prior's spread.
struct Spectrum {
    singular_values: Vec<f64>,
    rank: usize,
    condition: f64,
    weakest: Vec<WeakDirection>,
}

fn spectrum(
    robot: &Robot,
    unknowns: &Unknowns,
    scaled: DMatrix<f64>,
    spread: &[DMatrix<f64>],
) -> Spectrum {
    /// Most weak directions that are named.
    const WEAKEST: usize = 5;
    let svd = scaled.svd(false, true);
    let mut order: Vec<usize> = (0..svd.singular_values.len()).collect();
    order.sort_by(|&a, &b| svd.singular_values[b].total_cmp(&svd.singular_values[a]));
    let singular_values: Vec<f64> = order.iter().map(|&i| svd.singular_values[i]).collect();
    let greatest = singular_values.first().copied().unwrap_or(0.0);
    let is_seen = |s: &&f64| **s > 1e-8 * greatest && greatest > 0.0;
    let rank = singular_values.iter().filter(is_seen).count();
    let directions = svd
        .v_t
        .unwrap_or_else(|| DMatrix::zeros(0, unknowns.inertial()));
    let weakest = order[..rank].iter().rev().take(WEAKEST).map(|&i| {
        let direction = directions.row(i).transpose();
        let value = svd.singular_values[i];
        let (expression, links) = expression(robot, unknowns, spread, &direction);
        WeakDirection {
            expression,
            links,
            relative: value / greatest,
            prior_share: 1.0 / (1.0 + value * value),
        }
    });
    let least = rank.checked_sub(1).map(|last| singular_values[last]);
    Spectrum {
        rank,
        condition: least.map_or(f64::NAN, |least| greatest / least),
        weakest: weakest.collect(),
        singular_values,
    }
}

/// The verdict after cross-validation.
fn verdict(identified: &Identified<'_>) -> Verdict {
    if identified.retained.iter().any(|kept| *kept > 0.0) {
        Verdict::Identified
    } else {
        Verdict::NoBetterThanCad
    }
}
