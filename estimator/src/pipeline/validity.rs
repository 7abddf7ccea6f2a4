//! Validity of the outputs: the channels that each one depends on, the faults of these, and all
//! else that speaks against a result. [`Judge`] writes torques and contact wrenches with their
//! reasons.

use super::contacts::Place;
use super::offset_steps::OffsetStepCover;
use super::residuals::ResidualMonitor;
use crate::setup::Setup;
use crate::uncertainty::Uncertainty;
use proprio_dynamics::{
    ContactSet, Dependence, Determinacy, DofSet, Kinematics, SensorSet, Solver, Structure,
};
use proprio_identification::online::Doubt;
use proprio_identification::robot::{Channel, ChannelRole};
use proprio_topics::{ContactWrench, JointTorque, NO_CAUSE, Reason};

/// The channels that each torque, contact wrench and sub-tree balance depends on. They change only
/// with the set of contacts present.
pub(crate) struct Dependences {
    pub(crate) active: Option<ContactSet>,
    pub(crate) torques: Vec<Dependence>,
    pub(crate) contacts: Vec<Dependence>,
    pub(crate) subtrees: Vec<Dependence>,
}

impl Dependences {
    /// Updates them if `active` differs from the last set of contacts.
    pub(crate) fn update(
        &mut self,
        structure: &Structure,
        kinematics: &Kinematics,
        active: &ContactSet,
    ) {
        if self.active.replace(*active) == Some(*active) {
            return;
        }
        for (dof, dependence) in self.torques.iter_mut().enumerate() {
            *dependence = structure
                .torque_dependence(dof, kinematics, active)
                .unwrap_or_default();
        }
        for (contact, dependence) in self.contacts.iter_mut().enumerate() {
            *dependence = structure
                .contact_dependence(contact, kinematics, active)
                .unwrap_or_default();
        }
        for (number, dependence) in self.subtrees.iter_mut().enumerate() {
            *dependence = structure.subtree_dependence(number, kinematics, active);
        }
    }
}

/// Finds why an output is not valid: the first faulty channel that it depends on.
pub(crate) struct ValidityCheck<'a> {
    pub(crate) channels: &'a [Channel],
    pub(crate) faults: &'a [Reason],
    /// [`first_fault`] of these.
    pub(crate) first_fault: usize,
    pub(crate) base_fault: Reason,
    /// Per contact, the channel of the skin whose touch is lost, or [`NO_CAUSE`].
    pub(crate) lost: &'a [u32],
    /// The contacts that F/T readings show: they are known to be present.
    pub(crate) detected: ContactSet,
    /// Contacts that nobody declares and no skin feels, where F/T readings can not show them: why
    /// not, and the channel.
    pub(crate) unwatched: &'a [(ContactSet, Reason, u32)],
}

/// The number of the first channel that has a fault: mostly there is none.
pub(crate) fn first_fault(faults: &[Reason]) -> usize {
    let first = faults.iter().position(|fault| *fault != Reason::None);
    first.unwrap_or(faults.len())
}

impl ValidityCheck<'_> {
    /// The reason, [`Reason::None`] if there is none, and the number of the faulty channel.
    pub(crate) fn reason_and_cause(&self, dependence: &Dependence) -> (Reason, u32) {
        let needed = |role: ChannelRole| match role {
            ChannelRole::Joint(dof) => dependence.dofs.contains(dof),
            ChannelRole::Sensor(number) => dependence.sensors.contains(number),
            ChannelRole::Base => dependence.base,
        };
        // A channel without any sample comes first: then the output has no value at all.
        let mut found = (Reason::None, NO_CAUSE);
        let channels = self.channels.iter().zip(self.faults).zip(0..);
        for ((channel, fault), number) in channels.skip(self.first_fault) {
            if *fault == Reason::None || !needed(channel.role) {
                continue;
            }
            if *fault == Reason::NeverSeen {
                return (*fault, number);
            }
            if found.0 == Reason::None {
                found = (*fault, number);
            }
        }
        if found.0 == Reason::None && dependence.base {
            found.0 = self.base_fault;
        }
        if found.0 == Reason::None {
            let assumed = dependence.contacts.union(&dependence.absent);
            let lost = assumed.difference(&self.detected).iter();
            let lost = lost.filter_map(|contact| self.lost.get(contact).copied());
            if let Some(skin) = lost.filter(|skin| *skin != NO_CAUSE).min() {
                found = (Reason::Stale, skin);
            }
        }
        if found.0 == Reason::None {
            let absent = &dependence.absent;
            let mut unwatched = self.unwatched.iter();
            let blind = unwatched.find(|(own, ..)| !absent.intersection(own).is_empty());
            if let Some((_, reason, cause)) = blind {
                found = (*reason, *cause);
            }
        }
        found
    }
}

/// Says of each result whether it is valid, and if not, why.
pub(super) struct Judge<'a> {
    pub(super) setup: &'a Setup,
    pub(super) structure: &'a Structure,
    pub(super) solver: &'a Solver,
    pub(super) uncertainty: &'a Uncertainty,
    pub(super) residuals: &'a ResidualMonitor,
    pub(super) steps: &'a OffsetStepCover,
    /// Of the contacts.
    pub(super) places: &'a [Place],
    pub(super) dependences: &'a Dependences,
    /// What on-line identification has not refuted, by degree of freedom.
    pub(super) doubts: Option<&'a [Doubt]>,
    pub(super) validity: ValidityCheck<'a>,
    /// The sensors of the sub-trees whose model has not been confirmed without a contact.
    pub(super) unconfirmed: SensorSet,
    /// The joints whose encoders may be stuck.
    pub(super) stuck: DofSet,
    pub(super) is_solved: bool,
}

impl Judge<'_> {
    /// Why the residual of a link's sub-tree speaks against what acts on the link.
    fn residual_reason(&self, link: usize) -> Option<Reason> {
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

    /// What identification has not refuted of what a torque rests on.
    fn setup_doubt(&self, dof: usize) -> Option<&Doubt> {
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
        if let Some(leading) = self
            .setup_doubt(dof)
            .and_then(|doubt| doubt.leading.as_ref())
        {
            let channel = leading.role().map_or(NO_CAUSE, |role| self.channel(role));
            return (Reason::Contradicted, channel);
        }
        let mut moved = self.structure.moved_by(dof).iter();
        if let Some(reason) = moved.find_map(|link| self.residual_reason(*link)) {
            return (reason, cause);
        }
        match dependence.dofs.intersection(&self.stuck).iter().next() {
            Some(stuck) => (Reason::Frozen, self.channel(ChannelRole::Joint(stuck))),
            None => (Reason::None, cause),
        }
    }

    pub(super) fn torque(&self, dof: usize) -> JointTorque {
        let least = self.setup_doubt(dof).map_or(0.0, |doubt| doubt.deviation);
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
    pub(super) fn contact(&self, contact: usize, active: &ContactSet) -> ContactWrench {
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
            reason = link
                .and_then(|link| self.residual_reason(link))
                .unwrap_or_default();
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
