//! The estimator's output (joint torques, contact wrenches) and the declarations of contacts it
//! receives.

use crate::code::coded;
use crate::{Code, Header, MAX_CONTACTS, MAX_JOINTS, MAX_SUBTREES, Name, Nanos, Quality, valid};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

coded! {
    /// Why an estimate is withheld. A withheld estimate has no value: its numbers are NaN.
    #[derive(Default)]
    pub enum Reason {
        /// It is valid.
        #[default]
        None = 0 => "",
        /// A channel it depends on has never been seen.
        NeverSeen = 1 => "never_seen",
        /// A channel it depends on has been silent for longer than its maximum.
        Stale = 2 => "stale",
        /// A sensor it depends on is saturated.
        Saturated = 3 => "saturated",
        /// A device it depends on reports a fault.
        DeviceFault = 4 => "device_fault",
        /// The unknown contact wrenches of its sub-tree outnumber the equations: the value depends
        /// on an assumption.
        Undetermined = 5 => "undetermined",
        /// Its predicted standard deviation exceeds the configured bound.
        Uncertain = 6 => "uncertain",
        /// The result of the computation is not finite.
        NotFinite = 7 => "not_finite",
        /// This contact is not present.
        Absent = 8 => "absent",
        /// A channel it depends on has too few samples yet for a velocity and an acceleration.
        Starting = 9 => "starting",
        /// It depends on the base motion, and no link is declared to stand still.
        NoStance = 10 => "no_stance",
        /// Neither the model nor a possible contact explains the readings of the F/T sensors of its
        /// sub-tree.
        Unexplained = 11 => "unexplained",
        /// A sensor it depends on repeats its readings instead of measuring ([`Quality::FROZEN`]),
        /// and is not saturated.
        Frozen = 12 => "frozen",
        /// A reading it depends on contradicts the ones before it ([`Quality::IMPLAUSIBLE`]).
        Implausible = 13 => "implausible",
        /// The readings contradict what is configured: something else explains them better, such as
        /// an encoder reversed, a sensor turned, or a contact that has been there since the start.
        Contradicted = 14 => "contradicted",
    }
}

impl Reason {
    /// The reason that `quality` gives, or [`Reason::None`]; `faults` are the flags that count as a
    /// device fault.
    #[must_use]
    pub const fn of_quality(quality: Quality, faults: Quality) -> Self {
        // A board may repeat its readings because it is saturated.
        if quality.intersects(Quality::SATURATED) {
            Self::Saturated
        } else if quality.intersects(Quality::FROZEN) {
            Self::Frozen
        } else if quality.intersects(Quality::IMPLAUSIBLE) {
            Self::Implausible
        } else if quality.intersects(faults) {
            Self::DeviceFault
        } else {
            Self::None
        }
    }

    /// This reason, or `other` if there is none.
    #[must_use]
    pub const fn or(self, other: Self) -> Self {
        match self {
            Self::None => other,
            reason => reason,
        }
    }
}

/// `JointTorque::cause` and `ContactWrench::cause` if no single channel is the cause.
pub const NO_CAUSE: u32 = u32::MAX;

/// The estimated torque of one joint.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct JointTorque {
    /// Torque \[Nm\] (force \[N\] for a prismatic joint) exerted by the parent link on the child
    /// link along the URDF axis. It is the link-side torque: without rotor inertia and friction.
    /// NaN if it is withheld.
    pub torque: f64,
    /// Its standard deviation \[Nm\]. NaN if it is withheld, except for [`Reason::Uncertain`]: then
    /// it is what exceeds the bound.
    pub standard_deviation: f64,
    /// 1 if it may be used, 0 if it is withheld.
    pub valid: u32,
    /// Why it is withheld.
    pub reason: Code<Reason>,
    /// The channel that causes it: its number among the estimator's channels in
    /// `<robot>/description`, or [`NO_CAUSE`].
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
        reason: Reason::NeverSeen.in_memory(),
        cause: NO_CAUSE,
        reserved: 0,
    };
}

/// The torques of all joints at one instant: the payload of `<robot>/estimate/torque`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/TorqueEstimate/3")]
pub struct TorqueEstimate {
    /// `acquired` is the instant that the torques refer to.
    pub header: Header,
    /// Number of valid entries in `joints`.
    pub count: u32,
    /// Unused, zero.
    pub reserved: u32,
    /// The joints, in the order of the estimator's description.
    pub joints: [JointTorque; MAX_JOINTS],
}

impl TorqueEstimate {
    /// The valid joints.
    #[must_use]
    pub fn joints(&self) -> &[JointTorque] {
        valid(&self.joints, self.count)
    }
}

/// The estimated external wrench at one contact, exerted by the environment on the link.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct ContactWrench {
    /// Force \[N\], in the axes of the frame that the configuration's `link` names. NaN if it is
    /// withheld.
    pub force: [f64; 3],
    /// Torque \[Nm\], in the same axes, about that frame's origin. NaN if it is withheld.
    pub torque: [f64; 3],
    /// Standard deviations of force \[N\] and torque \[Nm\]. NaN if it is withheld.
    pub standard_deviation: [f64; 6],
    /// 1 if it may be used, 0 if it is withheld.
    pub valid: u32,
    /// Why it is withheld.
    pub reason: Code<Reason>,
    /// The channel that causes it, or [`NO_CAUSE`].
    pub cause: u32,
    /// 1 if the contact is not declared but F/T readings show that it is present, else 0.
    pub detected: u32,
    /// The point that the estimate assumes the contact to be at \[m\], in the same axes, from the
    /// same origin. A full wrench that is the only one of its sub-tree does not depend on it.
    pub position: [f64; 3],
    /// 1 if `position` comes from a declaration or a skin, 0 if it is the configured one.
    pub located: u32,
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
        reason: Reason::NeverSeen.in_memory(),
        cause: NO_CAUSE,
        detected: 0,
        position: [f64::NAN; 3],
        located: 0,
        reserved: 0,
    };
}

/// The residual of a sub-tree (a part of the robot between F/T sensors): the wrench that the model,
/// the F/T sensors and the contacts known to be present do not explain.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct Residual {
    /// Unexplained force \[N\] on the sub-tree, in the axes of its top link.
    pub force: [f64; 3],
    /// Torque \[Nm\], in the same axes, about that link's origin.
    pub torque: [f64; 3],
    /// Significance of the residual as a number of standard deviations of a normal variable: how
    /// improbable it is without an unknown wrench. NaN if no test is possible: no sensor, a faulty
    /// sensor, or a contact that can explain any wrench.
    pub significance: f64,
    /// The contact that explains it and is therefore assumed present: its index in
    /// [`ContactEstimate::contacts`]; [`NO_CONTACT`] if there is none.
    pub contact: u32,
    /// 1 if it is significant and no possible contact explains it: the sub-tree's torques are
    /// withheld.
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

/// The wrenches of all contacts at one instant and the residuals of all sub-trees: the payload of
/// `<robot>/estimate/contact`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/ContactEstimate/4")]
pub struct ContactEstimate {
    /// `acquired` is the instant that the wrenches refer to.
    pub header: Header,
    /// Number of valid entries in `contacts`.
    pub count: u32,
    /// Number of valid entries in `residuals`.
    pub residual_count: u32,
    /// The contacts, in the order of the estimator's description.
    pub contacts: [ContactWrench; MAX_CONTACTS],
    /// The sub-trees, in the order of the estimator's description.
    pub residuals: [Residual; MAX_SUBTREES],
}

impl ContactEstimate {
    /// The valid contacts.
    #[must_use]
    pub fn contacts(&self) -> &[ContactWrench] {
        valid(&self.contacts, self.count)
    }

    /// The valid residuals.
    #[must_use]
    pub fn residuals(&self) -> &[Residual] {
        valid(&self.residuals, self.residual_count)
    }
}

/// What is declared of a contact: whether it is present and, if that is known, where.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactState {
    /// Whether it is present.
    pub active: bool,
    /// The point where it acts \[m\], in the axes of the frame that the configuration's `link`
    /// names, from that frame's origin; NaN: the configured `position_m`.
    pub position: [f64; 3],
    /// Standard deviation of `position`, each axis \[m\]; NaN: 0, it is exact.
    pub position_std: f64,
    /// The direction of a `force_along`, in the same axes, of any length; NaN: the configured
    /// `direction`. Other kinds of contact ignore it.
    pub direction: [f64; 3],
}

impl ContactState {
    /// A contact that is present (`active`) at its configured place, or absent.
    #[must_use]
    pub const fn configured(active: bool) -> Self {
        Self {
            active,
            position: [f64::NAN; 3],
            position_std: f64::NAN,
            direction: [f64::NAN; 3],
        }
    }
}

/// A declaration that a contact is present or absent, and where it is, sent to the estimator: the
/// payload of `<robot>/contact/declared`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/ContactDeclaration/3")]
pub struct ContactDeclaration {
    /// `acquired` is the instant from which the declaration holds.
    pub header: Header,
    /// The contact's name in the estimator's configuration.
    pub contact: Name,
    /// 1: present from `header.acquired` on; 0: absent.
    pub active: u32,
    /// Unused, zero.
    pub reserved: u32,
    /// As in [`ContactState`].
    pub position: [f64; 3],
    /// As in [`ContactState`].
    pub position_std: f64,
    /// As in [`ContactState`].
    pub direction: [f64; 3],
}

impl ContactDeclaration {
    /// The declaration that `contact` has this `state` from `from` on.
    #[must_use]
    pub fn new(contact: Name, from: Nanos, state: &ContactState) -> Self {
        Self {
            header: Header {
                acquired: from,
                ..Header::default()
            },
            contact,
            active: u32::from(state.active),
            reserved: 0,
            position: state.position,
            position_std: state.position_std,
            direction: state.direction,
        }
    }

    /// What it declares.
    #[must_use]
    pub const fn state(&self) -> ContactState {
        ContactState {
            active: self.active != 0,
            position: self.position,
            position_std: self.position_std,
            direction: self.direction,
        }
    }
}

const _: () = assert!(size_of::<JointTorque>() == 32 && size_of::<ContactWrench>() == 144);
const _: () =
    assert!(size_of::<TorqueEstimate>() == 64 + 32 * MAX_JOINTS && size_of::<Residual>() == 64);
const _: () = assert!(size_of::<ContactEstimate>() == 64 + 144 * MAX_CONTACTS + 64 * MAX_SUBTREES);
const _: () = assert!(size_of::<ContactDeclaration>() == 184);
