//! Assembles the [`Outcome`]: the errors of every log with CAD, with CAD and fitted offsets, and
//! with the identified parameters; the parameters with their uncertainty; findings.

use crate::finding::{Finding, FindingCode};
use crate::fit::{Identified, per_column};
use crate::measurement::model::MeasurementModel;
use crate::measurement::unknowns::Unknowns;
use crate::report::calibration::{calibrations, channels};
use crate::report::comparison::Judged;
use crate::report::log::log_outcome;
use crate::report::outcome::both;
use crate::report::outcome::{
    CovarianceRoot, LogOutcome, Outcome, Predicted, TimeOffset, Verdict, WeakDirection,
};
use crate::report::prediction::{self, JudgedParameters};
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
    let spectrum = Spectrum::new(robot, unknowns, scaled, &spread);
    let subspace = subspace(robot, training, identified);
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
    let candidates = [0, 1].map(|set| JudgedParameters {
        course: vec![(Nanos::ZERO, sets[set].clone())],
        friction: friction[set].clone(),
    });
    let judged = Judged {
        identified,
        sets,
        candidates,
        root: &root,
    };
    let logs = logs
        .iter()
        .map(|log| log_outcome(&mut measurement, log, &judged))
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
        rank: spectrum.rank,
        structural_rank,
        effective: identified.fit.effective,
        condition: spectrum.condition(),
        singular_values: spectrum.singular_values,
        weakest: spectrum.weakest,
        not_separable,
        base_parameters,
        channels: channels(robot, identified, training),
        time_offsets,
        logs,
        findings,
    }
}

/// What the logs tell of the links' parameters in units of the prior's spread.
struct Spectrum {
    /// Descending.
    singular_values: Vec<f64>,
    rank: usize,
    weakest: Vec<WeakDirection>,
}

impl Spectrum {
    /// Most weak directions that are named.
    const WEAKEST: usize = 5;

    fn new(
        robot: &Robot,
        unknowns: &Unknowns,
        scaled: DMatrix<f64>,
        spread: &[DMatrix<f64>],
    ) -> Self {
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
        let weakest = order[..rank].iter().rev().take(Self::WEAKEST).map(|&i| {
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
        Self {
            weakest: weakest.collect(),
            singular_values,
            rank,
        }
    }

    fn condition(&self) -> f64 {
        match self.rank.checked_sub(1) {
            Some(last) => self.singular_values[0] / self.singular_values[last],
            None => f64::NAN,
        }
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
