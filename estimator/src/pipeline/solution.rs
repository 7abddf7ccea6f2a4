//! The estimate at one instant: evaluate the channels, solve, test the residuals, write the results
//! with their validity.

use super::Pipeline;
use super::motion::OperatingPoint;
use super::residuals::{self, SubtreeResidual};
use crate::pipeline::estimate::root_of_squares;
use crate::pipeline::validity::{ValidityCheck, first_fault};
use proprio_dynamics::spatial::Pose;
use proprio_dynamics::{Certainty, ContactSet, Dependence, DofSet, FrameMotion, JointState};
use proprio_identification::robot::ChannelRole;
use proprio_topics::{ContactWrench, JointTorque, NO_CAUSE, NO_CONTACT, Nanos, Reason, Residual};

impl Pipeline {
    /// Computes the estimate at `t`: evaluates the channels, solves, tests the residuals, solves
    /// again if other contacts are detected, and writes the results.
    pub(super) fn compute_estimate(&mut self, t: Nanos) {
        let active = self.active_contacts(t);
        self.contacts.place(&mut self.setup.robot, t);
        let (base, imu) = self.evaluate_channels(t, &active);
        // A contact detected at the last instant is most likely still there.
        let possible = self.residuals.possible().difference(&active);
        let mut solved = self.solve(t, &base, imu.as_ref(), &active.union(&possible));
        self.test_residuals(t, &active, solved);
        if solved && self.residuals.possible() != possible {
            solved = self.solve(
                t,
                &base,
                imu.as_ref(),
                &active.union(&self.residuals.possible()),
            );
        }
        if solved {
            self.steps.update(
                &self.setup.state.model,
                &self.setup.robot.structure,
                &self.kinematics,
                &self.solver,
                &self.readings,
                [
                    &active,
                    &self.residuals.possible(),
                    &self.residuals.suspected(),
                ],
                self.residuals.steps(),
            );
        }
        self.write_estimate(t, &active, solved);
    }

    /// Solves with the contacts in `active` present, and computes all standard deviations. False if
    /// the solver failed.
    fn solve(
        &mut self,
        t: Nanos,
        base: &FrameMotion,
        imu: Option<&(FrameMotion, Pose)>,
        active: &ContactSet,
    ) -> bool {
        let (model, structure) = (&self.setup.state.model, &self.setup.robot.structure);
        let state = JointState {
            position: &self.position,
            velocity: &self.velocity,
            acceleration: &self.acceleration,
        };
        self.dependences.update(structure, &self.kinematics, active);
        self.kinematics
            .update(model, state, base)
            .and_then(|()| {
                self.solver.solve(
                    model,
                    structure,
                    &self.kinematics,
                    &self.readings,
                    active,
                    &[],
                )
            })
            .and_then(|()| self.solver.update_deviations(structure))
            .and_then(|()| {
                self.propagation
                    .update(structure, &self.solver, &self.kinematics, t)
            })
            .and_then(|()| {
                self.motion.update(&OperatingPoint {
                    t,
                    model,
                    structure,
                    state,
                    base,
                    imu: imu.map(|(measured, pose)| (measured, pose)),
                    readings: &self.readings,
                    active,
                    solver: &self.solver,
                    base_link: self.kinematics.base(),
                })
            })
            .and_then(|()| {
                let places = self.contacts.places();
                let std =
                    |contact: usize| places.get(contact).map_or_else(Default::default, |p| p.std);
                self.place_errors
                    .update(structure, &self.solver, &self.kinematics, std)
            })
            .is_ok()
    }

    /// Tests the residual of each sub-tree, when the contacts in `declared` are known to be
    /// present.
    fn test_residuals(&mut self, t: Nanos, declared: &ContactSet, is_solved: bool) {
        self.unwatched.clear();
        if !is_solved {
            return self.residuals.reset();
        }
        // A touch that is lost does not matter here: the test shows whether it is still there.
        let validity = ValidityCheck {
            channels: &self.setup.robot.channels,
            faults: &self.faults,
            first_fault: first_fault(&self.faults),
            base_fault: self.base_fault,
            lost: &[],
            detected: ContactSet::EMPTY,
            unwatched: &[],
        };
        let structure = &self.setup.robot.structure;
        for (own, dependence) in (structure.subtrees().iter()).zip(&self.dependences.subtrees) {
            let (reason, cause) = validity.reason_and_cause(dependence);
            if reason != Reason::None && !own.sensors.is_empty() {
                let unwatched = own.contacts.difference(&self.contacts.watched(t));
                self.unwatched.push((unwatched, reason, cause));
            }
        }
        let solved = residuals::Solved {
            t,
            structure: &self.setup.robot.structure,
            kinematics: &self.kinematics,
            solver: &self.solver,
            declared,
        };
        let covariance = |number: usize| {
            let dependence = self.dependences.subtrees.get(number)?;
            let (reason, _) = validity.reason_and_cause(dependence);
            let parameters = self.propagation.imbalance_covariances().get(number)?;
            let places = self.place_errors.imbalance_covariances().get(number)?;
            (reason == Reason::None)
                .then(|| parameters + places + self.motion.imbalance_covariance(number))
        };
        self.residuals.update(&solved, covariance);
    }

    /// Writes the estimate: values, standard deviations, validity and reasons.
    fn write_estimate(&mut self, t: Nanos, active: &ContactSet, is_solved: bool) {
        self.estimate.t = t;
        self.estimate.torques.header.acquired = t;
        self.estimate.contacts.header.acquired = t;
        let detected = self.residuals.detected();
        let validity = ValidityCheck {
            channels: &self.setup.robot.channels,
            faults: &self.faults,
            first_fault: first_fault(&self.faults),
            base_fault: self.base_fault,
            lost: self.contacts.lost(),
            detected,
            unwatched: &self.unwatched,
        };
        let results = self
            .solver
            .torque()
            .iter()
            .zip(self.solver.torque_deviation())
            .zip(self.propagation.torque_std())
            .zip(self.solver.torque_certainty())
            .zip(self.motion.torque_std())
            .zip(self.place_errors.torque_std())
            .zip(self.steps.torque());
        let structure = &self.setup.robot.structure;
        let residual = |number: usize| self.residuals.subtrees().nth(number);
        // What a wrong offset does to one sub-tree, it does to the other one at that sensor.
        let unconfirmed = self.residuals.unconfirmed(structure);
        let doubted = |link: usize| {
            let number = structure.subtree_of(link)?;
            let sensors = structure.subtrees().get(number)?.sensors;
            match residual(number)? {
                own if own.is_unexplained => Some(Reason::Unexplained),
                _ if !sensors.intersection(&unconfirmed).is_empty() => Some(Reason::Contradicted),
                _ => None,
            }
        };
        // An encoder that stands before a residual may be stuck: then no contact explains it.
        let channels = &self.setup.robot.channels;
        let before = |is_one: fn(&SubtreeResidual) -> bool| {
            let balances = self.residuals.subtrees().zip(&self.dependences.subtrees);
            let balances = balances.filter(|(residual, _)| is_one(residual));
            balances.fold(DofSet::EMPTY, |all, (_, own)| all.union(&own.dofs))
        };
        let disturbed = before(SubtreeResidual::is_disturbed);
        let unexplained = before(|residual| residual.is_unexplained);
        let mut stuck = DofSet::EMPTY;
        for (channel, sanity) in channels.iter().zip(&mut self.sanity) {
            if let ChannelRole::Joint(dof) = channel.role {
                sanity.suspect(unexplained.contains(dof));
                if sanity.may_be_stuck(disturbed.contains(dof)) {
                    stuck.insert(dof);
                }
            }
        }
        let stuck = |dependence: &Dependence| {
            let dof = dependence.dofs.intersection(&stuck).iter().next()?;
            let role = ChannelRole::Joint(dof);
            channels.iter().position(|channel| channel.role == role)
        };
        let moved = |dof: usize| structure.moved_by(dof).iter().copied();
        let identification = self.identification.as_ref();
        let doubts = identification.map(|own| &own.online.solution().doubts);
        let robot = &self.setup.robot;
        let results = (results.zip(&self.dependences.torques).enumerate())
            .filter(|(dof, _)| robot.is_published(*dof));
        for (
            place,
            (dof, (((((((torque, noise), model), certainty), motion), located), step), dependence)),
        ) in self.estimate.torques.joints.iter_mut().zip(results)
        {
            let (mut reason, mut cause) = validity.reason_and_cause(dependence);
            let doubt = doubts.and_then(|doubts| doubts.get(dof));
            let least = doubt.map_or(0.0, |doubt| doubt.deviation);
            let own = root_of_squares([*noise, *model, *motion, *located]);
            let deviation = own.max(least).max(*step);
            if reason == Reason::None && *certainty == Certainty::Assumed {
                reason = Reason::Undetermined;
            }
            if reason == Reason::None
                && let Some(leading) = doubt.and_then(|doubt| doubt.leading)
            {
                let channel = robot
                    .channels
                    .iter()
                    .position(|c| Some(c.role) == leading.role());
                let number = channel.and_then(|channel| u32::try_from(channel).ok());
                (reason, cause) = (Reason::Contradicted, number.unwrap_or(NO_CAUSE));
            }
            if reason == Reason::None {
                reason = moved(dof).find_map(doubted).unwrap_or_default();
            }
            if reason == Reason::None
                && let Some(channel) = stuck(dependence)
            {
                let number = u32::try_from(channel).unwrap_or(NO_CAUSE);
                (reason, cause) = (Reason::Frozen, number);
            }
            if reason == Reason::None
                && self
                    .setup
                    .max_deviation
                    .get(dof)
                    .is_some_and(|most| deviation > *most)
            {
                reason = Reason::Uncertain;
            }
            if reason == Reason::None && least.is_infinite() {
                reason = Reason::Uncertain;
            }
            if !is_solved || !torque.is_finite() || own.is_nan() {
                (reason, cause) = (Reason::NotFinite, NO_CAUSE);
            }
            let is_valid = reason == Reason::None;
            *place = JointTorque {
                torque: if is_valid { *torque } else { f64::NAN },
                // Of an uncertain torque the deviation is the reason.
                standard_deviation: if is_valid || reason == Reason::Uncertain {
                    deviation
                } else {
                    f64::NAN
                },
                valid: u32::from(is_valid),
                reason: reason.in_memory(),
                cause,
                reserved: 0,
            };
            // What is published keeps the bound, however it came about.
            debug_assert!(
                place.valid == 0
                    || (self.setup.max_deviation.get(dof))
                        .is_none_or(|most| place.standard_deviation <= *most),
                "joint {dof} is valid, with a deviation of {} Nm",
                place.standard_deviation
            );
        }
        let places = self
            .estimate
            .contacts
            .contacts
            .iter_mut()
            .zip(&self.dependences.contacts);
        let results = self
            .solver
            .contacts()
            .iter()
            .zip(self.propagation.contact_std());
        let results = results
            .zip(self.motion.contact_std())
            .zip(self.place_errors.contact_std())
            .zip(self.contacts.places());
        let contacts = places.zip(results);
        for (number, ((place, dependence), ((((result, model), motion), located), at))) in
            contacts.enumerate()
        {
            let (mut reason, mut cause) = validity.reason_and_cause(dependence);
            let link = structure.contacts().get(number).map(|spec| spec.frame.link);
            if reason == Reason::None {
                reason = link.and_then(doubted).unwrap_or_default();
            }
            // One that may still be there is not reported.
            let is_known = detected.contains(number) || active.contains(number);
            match result.certainty {
                _ if !is_known => (reason, cause) = (Reason::Absent, NO_CAUSE),
                Certainty::Absent => (reason, cause) = (Reason::Absent, NO_CAUSE),
                Certainty::Assumed if reason == Reason::None => reason = Reason::Undetermined,
                _ => {}
            }
            let deviation: [f64; 6] = std::array::from_fn(|i| {
                let motion = motion.get(i).copied().unwrap_or(0.0);
                root_of_squares([result.deviation[i], model[i], motion, located[i]])
                    .max(self.steps.contact(number, result.wrench.force_first()[i]))
            });
            let is_finite = result.wrench.is_finite() && deviation.iter().all(|x| x.is_finite());
            if !is_solved || !is_finite {
                (reason, cause) = (Reason::NotFinite, NO_CAUSE);
            }
            let is_valid = reason == Reason::None;
            let unless_withheld = |values| if is_valid { values } else { [f64::NAN; 6] };
            let [fx, fy, fz, tx, ty, tz] = unless_withheld(result.wrench.force_first());
            *place = ContactWrench {
                force: [fx, fy, fz],
                torque: [tx, ty, tz],
                standard_deviation: unless_withheld(deviation),
                valid: u32::from(is_valid),
                reason: reason.in_memory(),
                cause,
                detected: u32::from(detected.contains(number)),
                position: at.position.into(),
                located: u32::from(at.is_located),
                reserved: 0,
            };
        }
        let places = self.estimate.contacts.residuals.iter_mut();
        for (place, residual) in places.zip(self.residuals.subtrees()) {
            let [fx, fy, fz, tx, ty, tz] = residual.wrench.force_first();
            *place = Residual {
                force: [fx, fy, fz],
                torque: [tx, ty, tz],
                significance: residual.significance,
                contact: residual
                    .contact
                    .and_then(|contact| u32::try_from(contact).ok())
                    .unwrap_or(NO_CONTACT),
                unexplained: u32::from(residual.is_unexplained),
            };
        }
    }
}
