//! The estimate at one instant: evaluate the channels, solve, test the residuals, write the results
//! with their validity.

use super::Pipeline;
use super::channels::At;
use super::contacts::Place;
use super::offset_steps::OffsetStepCover;
use super::residuals::{self, ResidualMonitor, SubtreeResidual};
use super::validity::{Dependences, ValidityCheck, first_fault};
use crate::setup::Setup;
use crate::uncertainty::{OperatingPoint, Uncertainty};
use proprio_dynamics::{ContactSet, Dependence, Determinacy, DofSet, SensorSet, Solver, Structure};
use proprio_identification::online::Doubt;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{ContactWrench, JointTorque, NO_CAUSE, NO_CONTACT, Nanos, Reason, Residual};

impl Pipeline {
    /// Computes the estimate at `t`: evaluates the channels, solves, tests the residuals, solves
    /// again if other contacts are detected, and writes the results.
    pub(super) fn compute_estimate(&mut self, t: Nanos) {
        let known = self.active_contacts(t);
        self.contacts
            .place(&mut self.structure, &self.setup.robot.always, t);
        let base = self.place_base(&known);
        let at = At {
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
        let solved = residuals::Solved {
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

/// Says of each result whether it is valid, and if not, why.
struct Judge<'a> {
    setup: &'a Setup,
    structure: &'a Structure,
    solver: &'a Solver,
    uncertainty: &'a Uncertainty,
    residuals: &'a ResidualMonitor,
    steps: &'a OffsetStepCover,
    /// Of the contacts.
    places: &'a [Place],
    dependences: &'a Dependences,
    /// What on-line identification has not refuted, by degree of freedom.
    doubts: Option<&'a [Doubt]>,
    validity: ValidityCheck<'a>,
    /// The sensors of the sub-trees whose model has not been confirmed without a contact.
    unconfirmed: SensorSet,
    /// The joints whose encoders may be stuck.
    stuck: DofSet,
    is_solved: bool,
}

impl Judge<'_> {
    /// Why the residual of a link's sub-tree speaks against what acts on the link.
    fn doubt(&self, link: usize) -> Option<Reason> {
        let structure = self.structure;
        let number = structure.subtree_of(link)?;
        let sensors = structure.subtrees().get(number)?.sensors;
        let residual = self.residuals.subtrees().nth(number)?;
        if residual.is_unexplained {
            return Some(Reason::Unexplained);
        }
        // What a wrong offset does to one sub-tree, it does to the other one at that sensor.
        let is_unconfirmed = !sensors.intersection(&self.unconfirmed).is_empty();
        is_unconfirmed.then_some(Reason::Contradicted)
    }

    fn doubts(&self, dof: usize) -> Option<&Doubt> {
        self.doubts?.get(dof)
    }

    /// The number of the channel with this role, for who reads the estimate.
    fn channel(&self, role: ChannelRole) -> u32 {
        let mut channels = self.setup.robot.channels.iter();
        let number = channels.position(|channel| channel.role == role);
        number.map_or(NO_CAUSE, |number| u32::try_from(number).unwrap_or(NO_CAUSE))
    }

    /// Why the torque of a degree of freedom is not valid, and the channel that causes it. The
    /// deviation does not matter.
    fn torque_reason(&self, dof: usize) -> (Reason, u32) {
        let none = Dependence::default();
        let dependence = self.dependences.torques.get(dof).unwrap_or(&none);
        let (reason, cause) = self.validity.reason_and_cause(dependence);
        if reason != Reason::None {
            return (reason, cause);
        }
        if self.solver.torque_certainty().get(dof) == Some(&Determinacy::Assumed) {
            return (Reason::Undetermined, cause);
        }
        if let Some(leading) = self.doubts(dof).and_then(|doubt| doubt.leading.as_ref()) {
            let channel = leading.role().map_or(NO_CAUSE, |role| self.channel(role));
            return (Reason::Contradicted, channel);
        }
        let mut moved = self.structure.moved_by(dof).iter();
        if let Some(reason) = moved.find_map(|link| self.doubt(*link)) {
            return (reason, cause);
        }
        match dependence.dofs.intersection(&self.stuck).iter().next() {
            Some(stuck) => (Reason::Frozen, self.channel(ChannelRole::Joint(stuck))),
            None => (Reason::None, cause),
        }
    }

    fn torque(&self, dof: usize) -> JointTorque {
        let least = self.doubts(dof).map_or(0.0, |doubt| doubt.deviation);
        let step = self.steps.torque().get(dof).copied().unwrap_or(0.0);
        let std = self.uncertainty.torque_std(self.solver, dof);
        let deviation = std.max(least).max(step);
        let bound = self.setup.max_deviation.get(dof);
        let (mut reason, mut cause) = self.torque_reason(dof);
        let is_uncertain = bound.is_some_and(|most| deviation > *most) || least.is_infinite();
        if reason == Reason::None && is_uncertain {
            reason = Reason::Uncertain;
        }
        let torque = self.solver.torque().get(dof).copied();
        let torque = torque.filter(|x| self.is_solved && x.is_finite() && !std.is_nan());
        if torque.is_none() {
            (reason, cause) = (Reason::NotFinite, NO_CAUSE);
        }
        let is_valid = reason == Reason::None;
        // What is published keeps the bound, however it came about.
        debug_assert!(
            !is_valid || bound.is_none_or(|most| deviation <= *most),
            "joint {dof} is valid, with a deviation of {deviation} Nm"
        );
        // Of an uncertain torque the deviation is the reason.
        let has_deviation = is_valid || reason == Reason::Uncertain;
        JointTorque {
            torque: torque.filter(|_| is_valid).unwrap_or(f64::NAN),
            standard_deviation: if has_deviation { deviation } else { f64::NAN },
            valid: u32::from(is_valid),
            reason: reason.in_memory(),
            cause,
            reserved: 0,
        }
    }

    /// `active` are the contacts that are known to be present.
    fn contact(&self, contact: usize, active: &ContactSet) -> ContactWrench {
        let (Some(result), Some(dependence), Some(at)) = (
            self.solver.contacts().get(contact),
            self.dependences.contacts.get(contact),
            self.places.get(contact),
        ) else {
            return ContactWrench::ABSENT;
        };
        let (mut reason, mut cause) = self.validity.reason_and_cause(dependence);
        let specs = self.structure.contacts();
        if reason == Reason::None {
            let link = specs.get(contact).map(|spec| spec.frame.link);
            reason = link.and_then(|link| self.doubt(link)).unwrap_or_default();
        }
        let is_detected = self.validity.detected.contains(contact);
        // One that may still be there is not reported.
        let is_known = is_detected || active.contains(contact);
        match result.certainty {
            _ if !is_known => (reason, cause) = (Reason::Absent, NO_CAUSE),
            Determinacy::Absent => (reason, cause) = (Reason::Absent, NO_CAUSE),
            Determinacy::Assumed if reason == Reason::None => reason = Reason::Undetermined,
            _ => {}
        }
        let wrench = result.wrench.force_first();
        let deviation = self.uncertainty.contact_std(self.solver, contact);
        let deviation: [f64; 6] =
            std::array::from_fn(|i| deviation[i].max(self.steps.contact(contact, wrench[i])));
        let is_finite = result.wrench.is_finite() && deviation.iter().all(|x| x.is_finite());
        if !self.is_solved || !is_finite {
            (reason, cause) = (Reason::NotFinite, NO_CAUSE);
        }
        let is_valid = reason == Reason::None;
        let unless_withheld = |values| if is_valid { values } else { [f64::NAN; 6] };
        let [fx, fy, fz, tx, ty, tz] = unless_withheld(wrench);
        ContactWrench {
            force: [fx, fy, fz],
            torque: [tx, ty, tz],
            standard_deviation: unless_withheld(deviation),
            valid: u32::from(is_valid),
            reason: reason.in_memory(),
            cause,
            detected: u32::from(is_detected),
            position: at.position.into(),
            located: u32::from(at.is_located),
            reserved: 0,
        }
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
