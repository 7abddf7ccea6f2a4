//! The estimate at one instant: evaluate the channels, solve, test the residuals, write the results
//! with their validity.

use super::Pipeline;
use super::inputs::EvaluationPoint;
use super::residuals::{SolvedInstant, SubtreeResidual};
use super::validity::{Judge, ValidityCheck, first_fault};
use crate::uncertainty::OperatingPoint;
use proprio_dynamics::{ContactSet, DofSet};
use proprio_identification::robot::ChannelRole;
use proprio_topics::{NO_CONTACT, Nanos, Reason, Residual};

impl Pipeline {
    /// Computes the estimate at `t`: evaluates the channels, solves, tests the residuals, solves
    /// again if other contacts are detected, and writes the results.
    pub(super) fn compute_estimate(&mut self, t: Nanos) {
        let known = self.active_contacts(t);
        self.contacts
            .place(&mut self.structure, &self.setup.robot.always, t);
        let base = self.place_base(&known);
        let at = EvaluationPoint {
            t,
            until: self.until(t),
            setup: &self.setup,
            parameters: &self.parameters,
            new_zeros: &self.new_zeros,
            uncertainty: &mut self.uncertainty,
        };
        self.inputs.evaluate(at, &self.buffers, base);
        // A contact detected at the last instant is most likely still there.
        let lingering = self.residuals.lingering().difference(&known);
        let mut solved = self.solve(t, &known.union(&lingering));
        self.test_residuals(t, &known, solved);
        if solved && self.residuals.lingering() != lingering {
            solved = self.solve(t, &known.union(&self.residuals.lingering()));
        }
        if solved {
            self.steps.update(
                &self.parameters.model,
                &self.structure,
                &self.kinematics,
                &self.solver,
                &self.inputs.readings,
                [
                    &known,
                    &self.residuals.lingering(),
                    &self.residuals.suspected(),
                ],
                self.residuals.steps(),
            );
        }
        self.write_estimate(t, &known, solved);
    }

    /// Solves with the contacts in `assumed` present, and computes all standard deviations. False
    /// if the solver failed.
    fn solve(&mut self, t: Nanos, assumed: &ContactSet) -> bool {
        let (model, structure) = (&self.parameters.model, &self.structure);
        let (inputs, kinematics, solver) = (&self.inputs, &mut self.kinematics, &mut self.solver);
        self.dependences.update(structure, kinematics, assumed);
        let solved = kinematics
            .update(model, inputs.joints(), &inputs.base)
            .and_then(|()| {
                solver.solve(model, structure, kinematics, &inputs.readings, assumed, &[])
            })
            .and_then(|()| solver.update_deviations(structure));
        let point = OperatingPoint {
            t,
            model,
            structure,
            state: inputs.joints(),
            base: &inputs.base,
            imu: inputs.imu.as_ref(),
            readings: &inputs.readings,
            active: assumed,
            kinematics,
            solver,
        };
        let places = self.contacts.places();
        let place_std =
            |contact: usize| places.get(contact).map_or_else(Default::default, |p| p.std);
        solved
            .and_then(|()| self.uncertainty.update(&point, place_std))
            .is_ok()
    }

    /// Tests the residual of each sub-tree, when the contacts in `known` are present.
    fn test_residuals(&mut self, t: Nanos, known: &ContactSet, is_solved: bool) {
        self.unwatched.clear();
        if !is_solved {
            return self.residuals.reset();
        }
        // A touch that is lost does not matter here: the test shows whether it is still there.
        let validity = ValidityCheck {
            channels: &self.setup.robot.channels,
            faults: &self.inputs.faults,
            first_fault: first_fault(&self.inputs.faults),
            base_fault: self.base_fault,
            lost: &[],
            detected: ContactSet::EMPTY,
            unwatched: &[],
        };
        let structure = &self.structure;
        for (own, dependence) in (structure.subtrees().iter()).zip(&self.dependences.subtrees) {
            let (reason, cause) = validity.reason_and_cause(dependence);
            if reason != Reason::None && !own.sensors.is_empty() {
                let unwatched = own.contacts.difference(&self.contacts.watched(t));
                self.unwatched.push((unwatched, reason, cause));
            }
        }
        let solved = SolvedInstant {
            t,
            structure,
            kinematics: &self.kinematics,
            solver: &self.solver,
            known,
        };
        let covariance = |number: usize| {
            let dependence = self.dependences.subtrees.get(number)?;
            let (reason, _) = validity.reason_and_cause(dependence);
            let has_no_fault = reason == Reason::None;
            has_no_fault.then(|| self.uncertainty.imbalance_covariance(number))?
        };
        self.residuals.update(&solved, covariance);
    }

    /// Writes the estimate: values, standard deviations, validity and reasons.
    fn write_estimate(&mut self, t: Nanos, active: &ContactSet, is_solved: bool) {
        self.estimate.t = t;
        self.estimate.torques.header.acquired = t;
        self.estimate.contacts.header.acquired = t;
        let stuck = self.stuck_encoders();
        let robot = &self.setup.robot;
        let judge = Judge {
            setup: &self.setup,
            structure: &self.structure,
            solver: &self.solver,
            uncertainty: &self.uncertainty,
            residuals: &self.residuals,
            steps: &self.steps,
            places: self.contacts.places(),
            dependences: &self.dependences,
            doubts: (self.identification.as_ref()).map(|own| &*own.online.solution().doubts),
            validity: ValidityCheck {
                channels: &robot.channels,
                faults: &self.inputs.faults,
                first_fault: first_fault(&self.inputs.faults),
                base_fault: self.base_fault,
                lost: self.contacts.lost(),
                detected: self.residuals.detected(),
                unwatched: &self.unwatched,
            },
            unconfirmed: self.residuals.unconfirmed(&self.structure),
            stuck,
            is_solved,
        };
        let joints = self.estimate.torques.joints.iter_mut();
        for (to, dof) in joints.zip(robot.published()) {
            *to = judge.torque(dof);
        }
        let contacts = self.estimate.contacts.contacts.iter_mut();
        for (to, contact) in contacts.zip(0..self.solver.contacts().len()) {
            *to = judge.contact(contact, active);
        }
        let residuals = self.estimate.contacts.residuals.iter_mut();
        for (to, residual) in residuals.zip(self.residuals.subtrees()) {
            *to = residual.published();
        }
    }

    /// The joints whose encoders may be stuck. One that stands before a residual may be: then no
    /// contact explains it.
    fn stuck_encoders(&mut self) -> DofSet {
        let before = |is_one: fn(&SubtreeResidual) -> bool| {
            let balances = self.residuals.subtrees().zip(&self.dependences.subtrees);
            let balances = balances.filter(|(residual, _)| is_one(residual));
            balances.fold(DofSet::EMPTY, |all, (_, own)| all.union(&own.dofs))
        };
        let disturbed = before(SubtreeResidual::is_disturbed);
        let unexplained = before(|residual| residual.is_unexplained);
        let mut stuck = DofSet::EMPTY;
        for (channel, sanity) in self.setup.robot.channels.iter().zip(&mut self.sanity) {
            if let ChannelRole::Joint(dof) = channel.role {
                sanity.suspect(unexplained.contains(dof));
                if sanity.may_be_stuck(disturbed.contains(dof)) {
                    stuck.insert(dof);
                }
            }
        }
        stuck
    }
}

impl SubtreeResidual {
    fn published(&self) -> Residual {
        let [fx, fy, fz, tx, ty, tz] = self.wrench.force_first();
        Residual {
            force: [fx, fy, fz],
            torque: [tx, ty, tz],
            significance: self.significance,
            contact: self
                .contact
                .and_then(|contact| u32::try_from(contact).ok())
                .unwrap_or(NO_CONTACT),
            unexplained: u32::from(self.is_unexplained),
        }
    }
}
