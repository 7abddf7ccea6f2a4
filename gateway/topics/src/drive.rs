//! A second opinion on joint torques: what the drives report, beside what is estimated from the
//! force/torque sensors.

use crate::code::coded;
use crate::{Code, Header, MAX_JOINTS, NO_CAUSE, Name, Reason, valid};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

coded! {
    /// Whether the drive and the force/torque sensors agree about a torque.
    #[derive(Default)]
    pub enum Agreement {
        /// They cannot be compared: [`DriveTorque::reason`].
        #[default]
        Unknown = 0 => "unknown",
        /// Their difference is within both deviations.
        Agrees = 1 => "agrees",
        /// It is not.
        Disagrees = 2 => "disagrees",
    }
}

coded! {
    /// What may be the cause of a disagreement.
    pub enum Candidate {
        /// A contact on the named link, which no F/T sensor sees or which is taken to be elsewhere.
        Contact = 0 => "contact",
        /// The named F/T sensor: turned, damaged, or with another gain.
        Sensor = 1 => "sensor",
        /// The drive of the named joint: it reports in other units, or its friction has changed.
        Drive = 2 => "drive",
    }
}

/// A candidate by name.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend, FromBytes)]
pub struct NamedCandidate {
    /// The link, the channel of the F/T sensor, or the joint.
    pub name: Name,
    /// What it is.
    pub kind: Code<Candidate>,
    /// What it is a candidate for: the disagreements with this [`DriveTorque::group`]. It explains
    /// all of them.
    pub joint: u32,
}

/// The torque of one joint by its drive.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct DriveTorque {
    /// What the drive reports, less friction and rotor: the torque \[Nm\] (force \[N\] for a
    /// prismatic joint) by the parent link on the child link. NaN if it reports nothing, or the
    /// joint's motion is not known.
    pub torque: f64,
    /// Its standard deviation, NaN if there is no torque.
    pub standard_deviation: f64,
    /// The difference between this torque and the one of the F/T sensors, as a multiple of the
    /// deviation of both together; smoothed. NaN if they cannot be compared.
    pub deviate: f64,
    /// If it disagrees: what the drive reports by what it should, if only its unit is wrong; by
    /// least squares over the last seconds. Else NaN.
    pub ratio: f64,
    /// Whether they agree.
    pub agreement: Code<Agreement>,
    /// Why they cannot be compared: that of the estimated torque, or of the drive's report.
    pub reason: Code<Reason>,
    /// The channel that causes `reason`, or [`NO_CAUSE`].
    pub cause: u32,
    /// The joint: an index into `TorqueEstimate::joints`.
    pub joint: u32,
    /// If it disagrees: the first joint of its sub-tree that does. The candidates with this joint
    /// are those of all disagreements there. Else [`NO_GROUP`].
    pub group: u32,
    /// Unused, zero.
    pub reserved: u32,
}

/// [`DriveTorque::group`] of a joint that does not disagree.
pub const NO_GROUP: u32 = u32::MAX;

/// The torques of the drives of one instant, whose constants and friction are known: the payload of
/// `<robot>/estimate/drive`. It exists if `parameters.toml` has drives. No torque of
/// `<robot>/estimate/torque` depends on it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/DriveEstimate/1")]
pub struct DriveEstimate {
    /// `acquired` is that of the estimate with which they are compared.
    pub header: Header,
    /// Number of valid entries in `drives`.
    pub count: u32,
    /// Number of valid entries in `candidates`.
    pub candidate_count: u32,
    /// The joints whose drives are known, ascending.
    pub drives: [DriveTorque; MAX_JOINTS],
    /// What may have caused the disagreements.
    pub candidates: [NamedCandidate; Self::CANDIDATES],
}

impl DriveTorque {
    /// Nothing compared yet.
    pub const ABSENT: Self = Self {
        torque: f64::NAN,
        standard_deviation: f64::NAN,
        deviate: f64::NAN,
        ratio: f64::NAN,
        agreement: Agreement::Unknown.in_memory(),
        reason: Reason::NeverSeen.in_memory(),
        cause: NO_CAUSE,
        joint: 0,
        group: NO_GROUP,
        reserved: 0,
    };
}

impl NamedCandidate {
    /// An unused entry.
    pub const NONE: Self = Self {
        name: Name::EMPTY,
        kind: Candidate::Contact.in_memory(),
        joint: 0,
    };
}

impl DriveEstimate {
    /// Maximum number of candidates of all disagreements together; those beyond it are left out.
    pub const CANDIDATES: usize = 24;

    /// Nothing compared yet.
    #[must_use]
    pub fn new() -> Self {
        Self {
            header: Header::default(),
            count: 0,
            candidate_count: 0,
            drives: [DriveTorque::ABSENT; MAX_JOINTS],
            candidates: [NamedCandidate::NONE; Self::CANDIDATES],
        }
    }

    /// The valid joints.
    #[must_use]
    pub fn drives(&self) -> &[DriveTorque] {
        valid(&self.drives, self.count)
    }

    /// The drive of a joint, by its index in `TorqueEstimate::joints`.
    #[must_use]
    pub fn of_joint(&self, joint: u32) -> Option<&DriveTorque> {
        self.drives().iter().find(|own| own.joint == joint)
    }

    /// The valid candidates.
    #[must_use]
    pub fn candidates(&self) -> &[NamedCandidate] {
        valid(&self.candidates, self.candidate_count)
    }
}

impl Default for DriveEstimate {
    fn default() -> Self {
        Self::new()
    }
}

const _: () = assert!(size_of::<DriveTorque>() == 56 && size_of::<NamedCandidate>() == 72);
const _: () =
    assert!(size_of::<DriveEstimate>() == 64 + 56 * MAX_JOINTS + 72 * DriveEstimate::CANDIDATES);
