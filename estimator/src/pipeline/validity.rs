//! Validity of the outputs: the channels that each one depends on, and the faults of these.

use proprio_dynamics::{ContactSet, Dependence, Kinematics, Structure};
use proprio_identification::robot::{Channel, ChannelRole};
use proprio_topics::{NO_CAUSE, Reason};

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
