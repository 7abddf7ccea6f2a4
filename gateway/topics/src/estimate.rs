//! What the estimator tells: joint torques, contact wrenches, and what it is told of contacts.

use crate::{Header, MAX_CONTACTS, MAX_JOINTS, Name};
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
    /// Unused, zero.
    pub reserved: u32,
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
        reserved: 0,
    };
}

/// The wrenches of all contacts at one instant: the payload of `<robot>/estimate/contact`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("proprio/ContactEstimate/2")]
pub struct ContactEstimate {
    /// When; `acquired` is the instant that the wrenches are of.
    pub header: Header,
    /// How many of `contacts` are set.
    pub count: u32,
    /// Unused, zero.
    pub reserved: u32,
    /// The contacts, in the order of the estimator's description.
    pub contacts: [ContactWrench; MAX_CONTACTS],
}

impl ContactEstimate {
    /// The contacts that are set.
    #[must_use]
    pub fn contacts(&self) -> &[ContactWrench] {
        self.contacts.get(..self.count as usize).unwrap_or(&self.contacts)
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
const _: () = assert!(
    size_of::<TorqueEstimate>() == 56 + 32 * MAX_JOINTS && size_of::<ContactEstimate>() == 56 + 112 * MAX_CONTACTS
);
const _: () = assert!(size_of::<ContactDeclaration>() == 120);
