//! What the estimator tells: joint torques, contact wrenches, and what it is told of contacts.

use crate::{Header, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name};
use core::fmt;
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// Why an estimate is withheld: its number stands, but must not be used.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, ZeroCopySend)]
pub enum Reason {
    /// It is valid.
    #[default]
    None = 0,
    /// A channel it depends on has never been seen.
    NeverSeen = 1,
    /// A channel it depends on has been silent for longer than it may.
    Stale = 2,
    /// A sensor it depends on is saturated.
    Saturated = 3,
    /// A device it depends on reports a fault.
    DeviceFault = 4,
    /// The unknown contacts of its sub-tree outnumber the equations: the number rests on an assumption.
    Undetermined = 5,
    /// Its predicted standard deviation exceeds the configured bound.
    Uncertain = 6,
    /// The computation gave no finite number.
    NotFinite = 7,
    /// This contact is not present.
    Absent = 8,
    /// Too few samples yet to tell a velocity and an acceleration of a channel it depends on.
    Starting = 9,
    /// It depends on how the base moves, and no link is declared to stand still.
    NoStance = 10,
    /// Neither the model nor a possible contact explains what the F/T sensors of its sub-tree read.
    Unexplained = 11,
}

impl Reason {
    /// The word for it in tables and logs.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::None => "",
            Self::NeverSeen => "never_seen",
            Self::Stale => "stale",
            Self::Saturated => "saturated",
            Self::DeviceFault => "device_fault",
            Self::Undetermined => "undetermined",
            Self::Uncertain => "uncertain",
            Self::NotFinite => "not_finite",
            Self::Absent => "absent",
            Self::Starting => "starting",
            Self::NoStance => "no_stance",
            Self::Unexplained => "unexplained",
        }
    }
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.word())
    }
}

/// `JointTorque::cause` and `ContactWrench::cause` where no single channel is to blame.
pub const NO_CAUSE: u32 = u32::MAX;

/// The estimated torque of one joint.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct JointTorque {
    /// Torque \[Nm\] (force \[N\] for a prismatic joint) by the parent link on the child link, along the URDF axis, on the
    /// link side: without rotor inertia and friction.
    pub torque: f64,
    /// Its standard deviation \[Nm\]; NaN where it is not known.
    pub standard_deviation: f64,
    /// 1 if it may be used, 0 if it is withheld.
    pub valid: u32,
    /// Why it is withheld.
    pub reason: Reason,
    /// The channel to blame: its number among the estimator's channels in `<robot>/description`, or [`NO_CAUSE`].
    pub cause: u32,
    /// Unused, zero.
    pub reserved: u32,
}

impl JointTorque {
    /// Nothing estimated yet.
    pub const ABSENT: Self = Self {
        torque: f64::NAN,
        standard_deviation: f64::NAN,
        valid: 0,
        reason: Reason::NeverSeen,
        cause: NO_CAUSE,
        reserved: 0,
    };
}

/// The torques of all joints at one instant: the payload of `<robot>/estimate/torque`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("proprio/TorqueEstimate/2")]
pub struct TorqueEstimate {
    /// When; `acquired` is the instant that the torques are of.
    pub header: Header,
    /// How many of `joints` are set.
    pub count: u32,
    /// Unused, zero.
    pub reserved: u32,
    /// The joints, in the order of the estimator's description.
    pub joints: [JointTorque; MAX_JOINTS],
}

impl TorqueEstimate {
    /// The joints that are set.
    #[must_use]
    pub fn joints(&self) -> &[JointTorque] {
        self.joints.get(..self.count as usize).unwrap_or(&self.joints)
    }
}

/// The estimated external wrench at one contact: on the link, by the environment.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct ContactWrench {
    /// Force \[N\], in the axes of the frame that the configuration's `link` names.
    pub force: [f64; 3],
    /// Torque \[Nm\], in the same axes, about that frame's origin.
    pub torque: [f64; 3],
    /// Standard deviations of force \[N\] and torque \[Nm\]; NaN where not known.
    pub standard_deviation: [f64; 6],
    /// 1 if it may be used, 0 if it is withheld.
    pub valid: u32,
    /// Why it is withheld.
    pub reason: Reason,
    /// The channel to blame, or [`NO_CAUSE`].
    pub cause: u32,
    /// 1 if nobody declared it and F/T readings show that it is present, else 0.
    pub detected: u32,
}

impl ContactWrench {
    /// Nothing estimated yet.
    pub const ABSENT: Self = Self {
        force: [f64::NAN; 3],
        torque: [f64::NAN; 3],
        standard_deviation: [f64::NAN; 6],
        valid: 0,
        reason: Reason::NeverSeen,
        cause: NO_CAUSE,
        detected: 0,
    };
}

/// What links, F/T sensors and the contacts that are known to be present leave unexplained in a sub-tree, one piece of the robot between F/T sensors.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct Residual {
    /// Force \[N\] that acts on the sub-tree and is not accounted for, in the axes of its top link.
    pub force: [f64; 3],
    /// Torque \[Nm\], in the same axes, about that link's origin.
    pub torque: [f64; 3],
    /// How rare this is if nothing unknown acts: as many standard deviations of a normal variable. NaN where nothing can be tested: no sensor, one that is at fault, or a contact
    /// that may take up anything.
    pub significance: f64,
    /// The contact that explains it and is taken as present: its number in [`ContactEstimate::contacts`]; [`NO_CONTACT`] if there is none.
    pub contact: u32,
    /// 1 if it is significant and no possible contact explains it: the sub-tree's torques are withheld.
    pub unexplained: u32,
}

/// [`Residual::contact`] where no contact was detected.
pub const NO_CONTACT: u32 = u32::MAX;

impl Residual {
    /// Nothing estimated yet.
    pub const ABSENT: Self = Self {
        force: [f64::NAN; 3],
        torque: [f64::NAN; 3],
        significance: f64::NAN,
        contact: NO_CONTACT,
        unexplained: 0,
    };
}

/// The wrenches of all contacts at one instant, and what they leave unexplained: the payload of `<robot>/estimate/contact`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("proprio/ContactEstimate/3")]
pub struct ContactEstimate {
    /// When; `acquired` is the instant that the wrenches are of.
    pub header: Header,
    /// How many of `contacts` are set.
    pub count: u32,
    /// How many of `residuals` are set.
    pub residual_count: u32,
    /// The contacts, in the order of the estimator's description.
    pub contacts: [ContactWrench; MAX_CONTACTS],
    /// The sub-trees, in the order of the estimator's description.
    pub residuals: [Residual; MAX_SUBTREES],
}

impl ContactEstimate {
    /// The contacts that are set.
    #[must_use]
    pub fn contacts(&self) -> &[ContactWrench] {
        self.contacts.get(..self.count as usize).unwrap_or(&self.contacts)
    }

    /// The residuals that are set.
    #[must_use]
    pub fn residuals(&self) -> &[Residual] {
        self.residuals
            .get(..self.residual_count as usize)
            .unwrap_or(&self.residuals)
    }
}

/// Somebody who knows says whether a contact is present: the payload of `<robot>/contact/declared`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend)]
#[type_name("proprio/ContactDeclaration/1")]
pub struct ContactDeclaration {
    /// When; `acquired` is the instant from which it holds.
    pub header: Header,
    /// The contact's name in the estimator's configuration.
    pub contact: Name,
    /// 1 from `header.acquired` on present, 0 absent.
    pub active: u32,
    /// Unused, zero.
    pub reserved: u32,
}

const _: () = assert!(size_of::<JointTorque>() == 32 && size_of::<ContactWrench>() == 112);
const _: () = assert!(size_of::<TorqueEstimate>() == 56 + 32 * MAX_JOINTS && size_of::<Residual>() == 64);
const _: () = assert!(size_of::<ContactEstimate>() == 56 + 112 * MAX_CONTACTS + 64 * MAX_SUBTREES);
const _: () = assert!(size_of::<ContactDeclaration>() == 120);
