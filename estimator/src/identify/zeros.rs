//! Joints whose position is another than the model's: counted the other way round, or with its zero
//! elsewhere. What explains more than inertial parameters can, at the prior's weight
//! ([`super::hypothesis`]).
//!
//! # Direction
//! All of what is fitted is fitted again to the logs with a joint's position, velocity and acceleration turned:
//! joint by joint, and what lessens the cost the most is taken, then what else does. Zeros are not asked
//! for beside that: an encoder that counts backwards looks as zeros of other joints that are elsewhere.
//!
//! # Zeros
//! A constant error of the position.
//!
//! Of joints beyond sensors, or between them, and of those between the base and them: an error of these tilts all that is seen, otherwise in every posture, unless it is the joint at the base,
//! which looks as a base that is not level does. In all logs, or in one of several: incremental encoders find their zeros anew with each start.
//!
//! The angles are further unknowns beside the parameters, of each log its own ([`super::passes::tell_angles`]), with a prior: of all that might be, the one that lessens the cost the most is taken,
//! then what else remains.

use super::batch::{Identified, Prepared, added, over};
use super::hypothesis::needed;
use super::information::Information;
use super::outcome::{Finding, Severity};
use super::parallel;
use super::passes::{Piece, tell, tell_angles};
use super::prior::{Fit, Posterior};
use super::rows::{Layout, RowMaker};
use crate::model::JointKind;
use nalgebra::{DMatrix, DVector};

/// A position is expected to be off by this much \[rad\], one standard deviation, before anything is measured.
const SPREAD: f64 = 0.1;

/// Less than this matters to nobody \[rad\]; of a joint before the sensors: less is what floors and bases have.
const LEAST: f64 = 0.01;
const LEAST_BEFORE: f64 = 0.02;

/// Instants that are looked at, at least so many of each log, in so many stretches: offsets and noise need
/// instants that follow each other, and each stretch pays for offsets of its own.
const ENOUGH: usize = 2000;
const LEAST_OF_LOG: usize = 400;
const STRETCHES: usize = 4;

/// The same for directions: an encoder that counts backwards shows in fewer.
const ENOUGH_TURNED: usize = 1200;
const LEAST_TURNED: usize = 300;

/// Of all that might be, these are looked at closely in each round.
const TRIED: usize = 6;

/// A joint (its place among those that are asked for) whose zero is elsewhere, in all logs or in one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Zero {
    joint: usize,
    log: Option<usize>,
}

/// What each joint's zero could explain.
struct Search<'a> {
    identified: &'a Identified,
    joints: usize,
    logs: usize,
    /// Where a joint's zero may be elsewhere: in all logs; of several, in each.
    places: Vec<Option<usize>>,
    /// The information's triangle over the angles, log by log, then the parameters; and its right side.
    r: DMatrix<f64>,
    z: DVector<f64>,
    /// What one of them must gain.
    gain: f64,
}

impl<'a> Search<'a> {
    fn new(maker: &RowMaker<'_>, training: &[&Prepared], identified: &'a Identified, dofs: &[usize]) -> Self {
        let (logs, joints, unknowns) = (training.len(), dofs.len(), identified.layout.unknowns());
        let mut sum = Information::new(joints * logs + unknowns);
        for (number, log) in training.iter().enumerate() {
            let pieces = stretches(log, (ENOUGH / logs.max(1)).max(LEAST_OF_LOG));
            let told = over(maker, &pieces, |maker, _, piece| {
                tell_angles(maker, piece, &identified.noise, dofs, identified.fit.x.as_slice())
            });
            let own = added(&told, unknowns + joints);
            let parameters = (0..unknowns).map(|column| joints * logs + column);
            let angles = (0..joints).map(|joint| joints * number + joint);
            let _ = sum.merge(&own, &parameters.chain(angles).collect::<Vec<_>>());
        }
        let (r, z) = sum.to_triangle();
        let each = (0..logs).filter(|_| logs > 1).map(Some);
        let places: Vec<Option<usize>> = std::iter::once(None).chain(each).collect();
        Self {
            identified,
            joints,
            logs,
            r,
            z,
            gain: needed(1, joints * places.len()),
            places,
        }
    }

    fn candidates(&self) -> impl Iterator<Item = Zero> {
        let of = |log: &Option<usize>| {
            let log = *log;
            (0..self.joints).map(move |joint| Zero { joint, log })
        };
        self.places.iter().flat_map(of)
    }

    fn column(&self, zero: Zero) -> DVector<f64> {
        let logs = zero.log.map_or(0..self.logs, |log| log..log + 1);
        let columns = logs.map(|log| self.r.column(self.joints * log + zero.joint));
        columns.fold(DVector::zeros(self.r.nrows()), |sum, column| sum + column)
    }

    /// The parameters' columns, then those of these zeros. (What is not asked for is known to be right: its columns are left out.)
    fn columns(&self, zeros: &[Zero]) -> DMatrix<f64> {
        let unknowns = self.identified.layout.unknowns();
        let own = self.r.columns(self.joints * self.logs, unknowns).into_owned();
        let mut own = own.resize_horizontally(unknowns + zeros.len(), 0.0);
        for (place, zero) in zeros.iter().enumerate() {
            own.set_column(unknowns + place, &self.column(*zero));
        }
        own
    }

    /// Parameters, then these zeros, that go best with the data and all priors; and what that costs.
    fn fit(&self, zeros: &[Zero]) -> Option<(f64, Fit)> {
        let Identified { layout, prior, fit, .. } = self.identified;
        let mut precision = layout.precision.clone();
        precision.resize(layout.further.len() + zeros.len(), SPREAD.powi(-2));
        let posterior = Posterior::new(prior, &layout.links, &self.columns(zeros), &self.z, &precision);
        let fit = posterior.ok()?.fit(fit.tau).ok()?;
        Some((cost(layout, &fit, &precision), fit))
    }

    /// What is worth trying beside these zeros, whose fit this is: what gains the most if the prior were quadratic; and the same joints in all logs.
    fn likely(&self, zeros: &[Zero], fit: &Fit) -> Vec<Zero> {
        let own = self.columns(zeros);
        let (left, root) = (&self.z - &own * &fit.x, fit.covariance_root());
        let gain = |zero: Zero| {
            let column = self.column(zero);
            let known = root.tr_mul(&own.tr_mul(&column)).norm_squared();
            column.dot(&left).powi(2) / (column.norm_squared() - known + SPREAD.powi(-2)).max(SPREAD.powi(-2))
        };
        let rest = self.candidates().filter(|zero| !zeros.contains(zero));
        let mut ranked: Vec<(f64, Zero)> = rest.map(|zero| (gain(zero), zero)).collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut likely: Vec<Zero> = ranked.into_iter().take(TRIED).map(|(_, zero)| zero).collect();
        for place in 0..likely.len() {
            let in_all = Zero {
                log: None,
                ..likely[place]
            };
            if !likely.contains(&in_all) && !zeros.contains(&in_all) {
                likely.push(in_all);
            }
        }
        likely
    }

    /// All zeros that are elsewhere, each with the angle.
    fn run(&self) -> Option<(f64, Vec<(Zero, f64)>)> {
        let mut zeros: Vec<Zero> = Vec::new();
        let (mut cost, mut fit) = self.fit(&[])?;
        loop {
            let likely = self.likely(&zeros, &fit);
            let with = |zero: Zero| zeros.iter().copied().chain([zero]).collect::<Vec<_>>();
            let fits = parallel::map(likely.len(), |number| self.fit(&with(likely[number])));
            let tried = likely.iter().zip(fits);
            let mut tried: Vec<(Zero, f64, Fit)> = tried
                .filter_map(|(zero, fit)| fit.map(|(cost, fit)| (*zero, cost, fit)))
                .collect();
            tried.sort_by(|a, b| a.1.total_cmp(&b.1));
            let Some(&(best, least, _)) = tried.first().filter(|best| cost - best.1 >= self.gain) else {
                break;
            };
            // In one log only where that is clearly better than in all.
            let in_all = Zero { log: None, ..best };
            let is_taken = |(zero, own, _): &(Zero, f64, Fit)| *zero == in_all && *own < least + self.gain;
            let place = tried.iter().position(is_taken).unwrap_or(0);
            let (zero, own, with) = tried.swap_remove(place);
            if cost - own < self.gain {
                break;
            }
            zeros.push(zero);
            (cost, fit) = (own, with);
        }
        let angles = fit.x.iter().skip(self.identified.layout.unknowns()).copied();
        Some((cost, zeros.into_iter().zip(angles).collect()))
    }

    /// Whether it may as well be another log in which this joint's zero is elsewhere, the other way.
    fn is_exchangeable(&self, cost: f64, zeros: &[(Zero, f64)], place: usize) -> bool {
        let own = zeros[place].0;
        let others: Vec<usize> = (0..self.logs).filter(|log| Some(*log) != own.log).collect();
        let costs = parallel::map(others.len(), |number| {
            let mut zeros: Vec<Zero> = zeros.iter().map(|(zero, _)| *zero).collect();
            zeros[place].log = Some(others[number]);
            self.fit(&zeros).map(|(cost, _)| cost)
        });
        costs.into_iter().flatten().any(|other| other < cost + self.gain)
    }
}

/// What a fit leaves of the data, squared, and twice what it costs by the priors.
fn cost(layout: &Layout, fit: &Fit, precision: &[f64]) -> f64 {
    let further = fit.x.iter().skip(layout.inertial());
    let further: f64 = further.zip(precision).map(|(x, precision)| x * x * precision).sum();
    fit.residual_square + fit.divergence / fit.tau.powi(2) + further
}

/// Some of a log's instants, in stretches from the first to the last.
fn stretches(log: &Prepared, share: usize) -> Vec<Piece<'_>> {
    let stretches = if log.instants.len() > share { STRETCHES } else { 1 };
    let count = log.instants.len().min(share) / stretches;
    let piece = |stretch: usize| {
        let start = (log.instants.len() - count) * stretch / (stretches - 1).max(1);
        Piece {
            instants: &log.instants[start..start + count],
            breaks: &log.breaks,
        }
    };
    (0..stretches).map(piece).collect()
}

/// Of these joints, those whose encoders count the other way round.
fn turned(maker: &RowMaker<'_>, training: &[&Prepared], identified: &Identified, dofs: &[usize]) -> Vec<usize> {
    let Identified {
        layout,
        prior,
        noise,
        fit,
        ..
    } = identified;
    let share = (ENOUGH_TURNED / training.len().max(1)).max(LEAST_TURNED);
    let pieces: Vec<Piece<'_>> = training.iter().flat_map(|log| stretches(log, share)).collect();
    let cost_with = |turned: &[usize]| {
        let (mut maker, mut all) = (maker.clone(), Information::new(layout.unknowns()));
        let columns: Vec<usize> = (0..layout.unknowns()).collect();
        for piece in &pieces {
            let mut instants = piece.instants.to_vec();
            for instant in &mut instants {
                for &dof in turned {
                    instant.position[dof] *= -1.0;
                    instant.velocity[dof] *= -1.0;
                    instant.acceleration[dof] *= -1.0;
                }
            }
            let (instants, breaks) = (&instants[..], piece.breaks);
            let _ = all.merge(
                &tell(&mut maker, Piece { instants, breaks }, noise).information,
                &columns,
            );
        }
        let (r, z) = all.to_triangle();
        let posterior = Posterior::new(prior, &layout.links, &r, &z, &layout.precision);
        let fit = posterior.ok()?.fit(fit.tau).ok()?;
        Some(all.residual_square() + cost(layout, &fit, &layout.precision))
    };
    let mut turned: Vec<usize> = Vec::new();
    let Some(mut least) = cost_with(&[]) else { return turned };
    loop {
        let rest: Vec<usize> = dofs.iter().copied().filter(|dof| !turned.contains(dof)).collect();
        let costs = parallel::map(rest.len(), |number| {
            let with: Vec<usize> = turned.iter().copied().chain([rest[number]]).collect();
            cost_with(&with)
        });
        let found = rest.iter().zip(costs).filter_map(|(dof, cost)| Some((*dof, cost?)));
        let best = found.min_by(|a, b| a.1.total_cmp(&b.1));
        match best.filter(|best| least - best.1 > needed(1, dofs.len())) {
            Some((dof, cost)) => {
                turned.push(dof);
                least = cost;
            }
            None => return turned,
        }
    }
}

/// Says which joints' positions are others.
pub(super) fn joint_zeros(maker: &RowMaker<'_>, training: &[&Prepared], identified: &Identified) -> Vec<Finding> {
    let setup = maker.setup();
    let layout = &identified.layout;
    let joint = |dof: usize| {
        let joint = setup.model.dof_joint(dof).map(|joint| &setup.model.joints()[joint]);
        joint.filter(|joint| matches!(joint.kind, JointKind::Revolute(_)))
    };
    // Beyond which, or between which, everything is seen.
    let is_within = |dof: usize| {
        joint(dof).is_some_and(|joint| {
            let inside = setup.structure.subtree_of(joint.parent) == setup.structure.subtree_of(joint.child)
                && layout.links.contains(&joint.parent);
            layout.links.contains(&joint.child) && (inside || !layout.joints.is_empty())
        })
    };
    // Whoever moves nothing that is seen has columns of zeros, and explains nothing.
    let dofs: Vec<usize> = (0..setup.model.dof_count())
        .filter(|&dof| setup.locked[dof].is_nan() && joint(dof).is_some())
        .collect();
    let turned = turned(maker, training, identified, &dofs);
    if !turned.is_empty() {
        let finding = |dof: &usize| {
            let joint = format!("joint/{}", setup.model.dof_name(*dof));
            Finding {
                severity: Severity::Warning,
                code: "wrong_sign",
                text: format!(
                    "{joint} fits only with its position turned: its encoder counts the other way round, or its axis in the URDF points the other way"
                ),
                subject: joint,
            }
        };
        return turned.iter().map(finding).collect();
    }
    let search = Search::new(maker, training, identified, &dofs);
    let Some((cost, zeros)) = search.run() else {
        return Vec::new();
    };
    let mut findings = Vec::new();
    for (number, &dof) in dofs.iter().enumerate() {
        let of_joint = |place: &usize| zeros[*place].0.joint == number;
        let places: Vec<usize> = (0..zeros.len()).filter(of_joint).collect();
        let is_within = is_within(dof);
        let least = if is_within { LEAST } else { LEAST_BEFORE };
        if places.iter().all(|&place| zeros[place].1.abs() <= least) {
            continue;
        }
        let file = |log: usize| training[log].file.as_str();
        let (what, rest) = match *places {
            [place] => match zeros[place] {
                (Zero { log: None, .. }, angle) => {
                    (format!("its zero is {angle:.4} rad from the model's"), String::new())
                }
                (Zero { log: Some(log), .. }, angle) if search.is_exchangeable(cost, &zeros, place) => (
                    format!(
                        "its zeros in {} and in the other logs are {:.4} rad apart, and either may be wrong",
                        file(log),
                        angle.abs()
                    ),
                    " and use logs of one calibration".to_owned(),
                ),
                (Zero { log: Some(log), .. }, angle) => (
                    format!(
                        "its zero in {} is {angle:.4} rad from that in the other logs",
                        file(log)
                    ),
                    format!(" and leave {} out", file(log)),
                ),
            },
            _ => {
                let each = places.iter().map(|&place| match zeros[place] {
                    (Zero { log: None, .. }, angle) => format!("{angle:.4} rad in all logs"),
                    (Zero { log: Some(log), .. }, angle) => format!("{angle:.4} rad in {}", file(log)),
                });
                let each = each.collect::<Vec<_>>().join(", and by ");
                (
                    format!("its zero is not the same in all logs, off the model's by {each}"),
                    " and use logs of one calibration".to_owned(),
                )
            }
        };
        let name = setup.model.dof_name(dof);
        let text = if is_within {
            format!(
                "joint/{name}: {what}; calibrate the encoder{rest}, or the error is taken for a shifted centre of mass"
            )
        } else {
            format!(
                "joint/{name}: {what}, or the base (its IMU, its gravity_mps2, the floor) is turned by that: what is beyond weighs in another direction than the model says; calibrate the encoder{rest}, and level the base"
            )
        };
        findings.push(Finding {
            severity: Severity::Warning,
            code: "joint_zero",
            subject: name.to_owned(),
            text,
        });
    }
    findings
}
