//! What a torque of the last estimate rests on, and how much of its variance each input causes
//! ([`TorqueBudget`]).
//!
//! The variance of a torque is a sum already: noise, parameters, motion and places of contacts are
//! taken as independent of each other. Within each, [`Propagation::torque_shares`] and the others
//! say what is whose. Two more can raise the deviation: what identification has not refuted, and a
//! step of an offset or the beginning of a contact. The larger of them has what it adds.
//!
//! [`Propagation::torque_shares`]: crate::propagation::Propagation::torque_shares

use super::Pipeline;
use core::fmt::Write as _;
use proprio_dynamics::model::Model;
use proprio_dynamics::{PlaceErrors, SensorSet};
use proprio_identification::robot::ChannelRole;
use proprio_topics::{BudgetPart, JointTorque, Line, Name, Reason, Residual, Source, TorqueBudget};

impl Pipeline {
    /// The budget of joint number `joint` of the last estimate; none if there is no such joint.
    /// Allocates nothing.
    pub fn budget(&mut self, joint: usize) -> Option<&TorqueBudget> {
        let dof = self.setup.robot.published().nth(joint)?;
        let Self {
            setup,
            solver,
            kinematics,
            propagation,
            motion,
            place_errors,
            contacts,
            dependences,
            steps,
            budget,
            identification,
            estimate,
            travel,
            ..
        } = self;
        let (robot, structure) = (&setup.robot, &setup.robot.structure);
        let of = |values: &[f64]| values.get(dof).copied().unwrap_or(0.0);
        let doubt = identification.as_ref().and_then(|own| {
            let doubts = &own.online.solution().doubts;
            doubts.get(dof).copied()
        });
        let torque = estimate.torques.joints().get(joint);
        let places = contacts.places();
        let own: f64 = [
            of(solver.torque_deviation()),
            of(propagation.torque_std()),
            of(motion.torque_std()),
            of(place_errors.torque_std()),
        ]
        .into_iter()
        .map(|deviation| deviation * deviation)
        .sum();
        let (alternative, step) = (doubt.map_or(0.0, |d| d.deviation), of(steps.torque()));
        let least = alternative.max(step);
        let deviation = match own.is_nan() {
            true => f64::NAN,
            false => own.sqrt().max(least),
        };
        **budget = TorqueBudget::new();
        budget.header.acquired = estimate.t;
        budget.joint = u32::try_from(joint).ok()?;
        budget.is_force = u32::from(robot.model.is_prismatic(dof));
        budget.torque = torque.copied().unwrap_or(JointTorque::ABSENT);
        budget.bound = setup
            .max_deviation
            .get(dof)
            .copied()
            .unwrap_or(f64::INFINITY);
        budget.deviation = deviation;
        let part = |source: Source, name: &str, variance: f64| BudgetPart {
            name: Name::new(name).unwrap_or(Name::EMPTY),
            variance,
            source: source.in_memory(),
            ..BudgetPart::NONE
        };
        let rests_on = dependences.torques.get(dof).copied().unwrap_or_default();
        let is_measured = |number: usize| {
            let role = ChannelRole::Joint(number);
            robot.channels.iter().any(|channel| channel.role == role)
        };
        for number in rests_on.dofs.iter().filter(|number| is_measured(*number)) {
            let [least, most] = travel.get(number).copied().unwrap_or_default();
            budget.add(BudgetPart {
                travel: (most - least).max(0.0) / range(&robot.model, number),
                ..part(Source::Position, robot.model.dof_name(number), 0.0)
            });
        }
        let mut add = |source: Source, name: &str, variance: f64| {
            budget.add(part(source, name, variance));
        };
        let sensor = |number: usize| robot.sensor_names().nth(number).unwrap_or_default();
        let contact = |number: usize| robot.contact_names().nth(number).unwrap_or_default();
        for number in rests_on.sensors.iter() {
            let noise = solver.torque_noise(structure, dof, number);
            add(Source::Noise, sensor(number), noise);
        }
        for number in rests_on.links.iter() {
            add(Source::Link, robot.model.link_name(number), 0.0);
        }
        for number in rests_on.contacts.iter() {
            add(Source::Present, contact(number), 0.0);
        }
        for number in rests_on.absent.iter() {
            add(Source::Absent, contact(number), 0.0);
        }
        if rests_on.base {
            add(Source::Base, "", 0.0);
        }
        let solution = (&*solver, &*kinematics);
        propagation.torque_shares(structure, solution, dof, |source, number, variance| {
            let name = match source {
                Source::Link => robot.model.link_name(number),
                _ => sensor(number),
            };
            if variance != 0.0 {
                add(source, name, variance);
            }
        });
        motion.torque_shares(dof, |source, number, variance| {
            // A difference of two solutions has rounding errors.
            let (name, matters) = match source {
                Source::Position | Source::Acceleration => {
                    (robot.model.dof_name(number), rests_on.dofs.contains(number))
                }
                _ => ("", rests_on.base),
            };
            if matters {
                add(source, name, variance);
            }
        });
        for (number, place) in places.iter().enumerate() {
            let at = (number, place.std);
            let variance = PlaceErrors::torque_variance(structure, solver, kinematics, dof, at);
            if variance != 0.0 {
                add(Source::Place, contact(number), variance);
            }
        }
        if least > own.sqrt() {
            let source = match alternative >= step {
                true => Source::Alternative,
                false => Source::Step,
            };
            add(source, "", least * least - own);
        }
        budget.sort();
        if let Some(leading) = doubt.and_then(|doubt| doubt.leading) {
            budget.likelier = line(format_args!("{}", leading.describe(robot)));
        }
        let reason = budget.torque.reason;
        let is_disturbed = reason == Reason::Unexplained || reason == Reason::Contradicted;
        if is_disturbed {
            // Of the sub-trees of its links, and of those at the same sensors, the one that is
            // disturbed the most.
            let subtrees = structure.subtrees();
            let own = structure.moved_by(dof).iter();
            let own = own.filter_map(|link| subtrees.get(structure.subtree_of(*link)?));
            let sensors = own.fold(SensorSet::EMPTY, |all, own| all.union(&own.sensors));
            let residuals = estimate.contacts.residuals().iter().zip(subtrees);
            let worst = residuals
                .zip(robot.subtree_names())
                .filter(|((residual, subtree), _)| {
                    !subtree.sensors.intersection(&sensors).is_empty()
                        && residual.significance.is_finite()
                })
                .max_by(|((a, _), _), ((b, _), _)| a.significance.total_cmp(&b.significance));
            if let Some(((residual, _), top)) = worst {
                budget.unexplained = told(top, residual);
            }
        }
        Some(budget)
    }
}

/// The range of a joint; one without limits counts as if it had 2 rad or 0.2 m.
fn range(model: &Model, dof: usize) -> f64 {
    let joint = model.dof_joint(dof);
    let limits = joint.and_then(|joint| model.limits(joint));
    let range = limits.map(|own| own.upper - own.lower);
    let range = range.filter(|range| range.is_finite() && *range > 0.0);
    range.unwrap_or(if model.is_prismatic(dof) { 0.2 } else { 2.0 })
}

/// What a residual is.
fn told(subtree: &str, residual: &Residual) -> Line {
    let norm = |vector: [f64; 3]| vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    line(format_args!(
        "{:.1} N and {:.2} Nm on the links from {subtree} on, {:.1} deviations of what is known",
        norm(residual.force),
        norm(residual.torque),
        residual.significance,
    ))
}

fn line(text: core::fmt::Arguments<'_>) -> Line {
    let mut line = Line::EMPTY;
    // What is too long is cut.
    let _ = line.write_fmt(text);
    line
}
