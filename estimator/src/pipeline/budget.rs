//! What a torque of the last estimate rests on, and how much of its variance each input causes
//! ([`TorqueBudget`]).
//!
//! The variance of a torque is a sum already ([`Uncertainty::torque_shares`] says what is whose).
//! Two more can raise the deviation: what identification has not refuted, and a step of an offset
//! or the beginning of a contact. The larger of them has what it adds.
//!
//! [`Uncertainty::torque_shares`]: crate::uncertainty::Uncertainty::torque_shares

use super::Pipeline;
use super::inputs::Inputs;
use crate::setup::Setup;
use core::fmt::Write as _;
use proprio_dynamics::model::Model;
use proprio_dynamics::{Dependence, SensorSet};
use proprio_identification::robot::ChannelRole;
use proprio_topics::{BudgetPart, JointTorque, Line, Name, Reason, Residual, Source, TorqueBudget};

impl Pipeline {
    /// The budget of joint number `joint` of the last estimate; none if there is no such joint.
    /// Allocates nothing.
    pub fn budget(&mut self, joint: usize) -> Option<&TorqueBudget> {
        let dof = self.setup.robot.published().nth(joint)?;
        let Self {
            setup,
            structure,
            solver,
            kinematics,
            uncertainty,
            contacts,
            dependences,
            steps,
            budget,
            identification,
            estimate,
            inputs,
            ..
        } = self;
        let robot = &setup.robot;
        let doubt = identification.as_ref().and_then(|own| {
            let doubts = &own.online.solution().doubts;
            doubts.get(dof).copied()
        });
        **budget = TorqueBudget::new();
        budget.header.acquired = estimate.t;
        budget.joint = u32::try_from(joint).ok()?;
        budget.is_force = u32::from(robot.model.is_prismatic(dof));
        let torque = estimate.torques.joints().get(joint);
        budget.torque = torque.copied().unwrap_or(JointTorque::ABSENT);
        let bound = setup.max_deviation.get(dof).copied();
        budget.bound = bound.unwrap_or(f64::INFINITY);
        let variance = uncertainty.torque_variance(solver, dof);
        let alternative = doubt.map_or(0.0, |doubt| doubt.deviation);
        let step = steps.torque().get(dof).copied().unwrap_or(0.0);
        let least = alternative.max(step);
        budget.deviation = match variance.is_nan() {
            true => f64::NAN,
            false => variance.sqrt().max(least),
        };
        let rests_on = dependences.torques.get(dof).copied().unwrap_or_default();
        add_inputs(budget, setup, inputs, &rests_on, |sensor| {
            solver.torque_noise(structure, dof, sensor)
        });
        let solution = (&*solver, &*kinematics);
        let place_std = contacts.places().iter().map(|place| place.std);
        uncertainty.torque_shares(
            structure,
            solution,
            place_std,
            dof,
            |source, number, share| {
                if let Some(name) = cause_of(setup, &rests_on, source, (number, share)) {
                    budget.add(part(source, name, share));
                }
            },
        );
        if least > variance.sqrt() {
            let source = match alternative >= step {
                true => Source::Alternative,
                false => Source::Step,
            };
            budget.add(part(source, "", least * least - variance));
        }
        budget.sort();
        if let Some(leading) = doubt.and_then(|doubt| doubt.leading) {
            budget.likelier = line(format_args!("{}", leading.describe(robot)));
        }
        let reason = budget.torque.reason;
        if reason == Reason::Unexplained || reason == Reason::Contradicted {
            let residuals = estimate.contacts.residuals();
            budget.unexplained = disturbance(setup, dof, residuals).unwrap_or(Line::EMPTY);
        }
        Some(budget)
    }
}

/// The name of what causes a share of a torque's variance; none if it has no part in it.
fn cause_of<'a>(
    setup: &'a Setup,
    rests_on: &Dependence,
    source: Source,
    (number, share): (usize, f64),
) -> Option<&'a str> {
    let model = &setup.robot.model;
    let (name, matters) = match source {
        Source::Link => (model.link_name(number), share != 0.0),
        Source::Place => (contact_name(setup, number), share != 0.0),
        // A difference of two solutions has rounding errors.
        Source::Position | Source::Acceleration => {
            (model.dof_name(number), rests_on.dofs.contains(number))
        }
        Source::Base | Source::Rotation => ("", rests_on.base),
        _ => (sensor_name(setup, number), share != 0.0),
    };
    matters.then_some(name)
}

/// Adds what a torque rests on: measured joints, sensors with the variance that their noise causes,
/// links, contacts and the base.
fn add_inputs(
    budget: &mut TorqueBudget,
    setup: &Setup,
    inputs: &Inputs,
    rests_on: &Dependence,
    noise: impl Fn(usize) -> f64,
) {
    let robot = &setup.robot;
    let is_measured = |number: usize| {
        let role = ChannelRole::Joint(number);
        robot.channels.iter().any(|channel| channel.role == role)
    };
    for number in rests_on.dofs.iter().filter(|number| is_measured(*number)) {
        let [least, most] = inputs.travel.get(number).copied().unwrap_or_default();
        budget.add(BudgetPart {
            travel: (most - least).max(0.0) / range(&robot.model, number),
            ..part(Source::Position, robot.model.dof_name(number), 0.0)
        });
    }
    for number in rests_on.sensors.iter() {
        budget.add(part(
            Source::Noise,
            sensor_name(setup, number),
            noise(number),
        ));
    }
    for number in rests_on.links.iter() {
        budget.add(part(Source::Link, robot.model.link_name(number), 0.0));
    }
    for number in rests_on.contacts.iter() {
        budget.add(part(Source::Present, contact_name(setup, number), 0.0));
    }
    for number in rests_on.absent.iter() {
        budget.add(part(Source::Absent, contact_name(setup, number), 0.0));
    }
    if rests_on.base {
        budget.add(part(Source::Base, "", 0.0));
    }
}

/// The residual that speaks against a torque: of the sub-trees of its links, and of those at the
/// same sensors, the one that is disturbed the most.
fn disturbance(setup: &Setup, dof: usize, residuals: &[Residual]) -> Option<Line> {
    let structure = &setup.robot.structure;
    let subtrees = structure.subtrees();
    let moved = structure.moved_by(dof).iter();
    let moved = moved.filter_map(|link| subtrees.get(structure.subtree_of(*link)?));
    let sensors = moved.fold(SensorSet::EMPTY, |all, own| all.union(&own.sensors));
    let named = residuals
        .iter()
        .zip(subtrees)
        .zip(setup.robot.subtree_names());
    let shared = named.filter(|((residual, subtree), _)| {
        let is_shared = !subtree.sensors.intersection(&sensors).is_empty();
        is_shared && residual.significance.is_finite()
    });
    let ((residual, _), top) =
        shared.max_by(|((a, _), _), ((b, _), _)| a.significance.total_cmp(&b.significance))?;
    let norm = |vector: [f64; 3]| vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    Some(line(format_args!(
        "{:.1} N and {:.2} Nm on the links from {top} on, {:.1} deviations of what is known",
        norm(residual.force),
        norm(residual.torque),
        residual.significance,
    )))
}

fn part(source: Source, name: &str, variance: f64) -> BudgetPart {
    BudgetPart {
        name: Name::new(name).unwrap_or(Name::EMPTY),
        variance,
        source: source.in_memory(),
        ..BudgetPart::NONE
    }
}

fn sensor_name(setup: &Setup, number: usize) -> &str {
    setup.robot.sensor_names().nth(number).unwrap_or_default()
}

fn contact_name(setup: &Setup, number: usize) -> &str {
    setup.robot.contact_names().nth(number).unwrap_or_default()
}

/// The range of a joint; one without limits counts as if it had 2 rad or 0.2 m.
fn range(model: &Model, dof: usize) -> f64 {
    let joint = model.dof_joint(dof);
    let limits = joint.and_then(|joint| model.limits(joint));
    let range = limits.map(|own| own.upper - own.lower);
    let range = range.filter(|range| range.is_finite() && *range > 0.0);
    range.unwrap_or(if model.is_prismatic(dof) { 0.2 } else { 2.0 })
}

fn line(text: core::fmt::Arguments<'_>) -> Line {
    let mut line = Line::EMPTY;
    // What is too long is cut.
    let _ = line.write_fmt(text);
    line
}
