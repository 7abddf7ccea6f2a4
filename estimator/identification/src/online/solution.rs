//! Input and output of on-line identification: observations, solutions, and counts.

use crate::linear::information::InformationError;
use crate::online::bank::Hypothesis;
use crate::prior::PriorError;
use crate::robot::{Channel, ChannelRole, Robot};
use nalgebra::DMatrix;
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_dynamics::{ContactSet, DofSet, DynamicsError, FrameMotion, JointState, Kinematics};
use proprio_topics::{Nanos, Reason};

/// Length of a block of rows that the gate judges.
pub(crate) const BLOCK: Nanos = Nanos::from_millis(100);

/// Why on-line identification is not possible.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum OnlineError {
    /// No sub-tree with an F/T sensor can be free of contacts.
    #[error(
        "nothing can be identified on-line: no sub-tree with F/T sensors can be free of contacts; \
         set presence = \"possible\" for contacts that come and go"
    )]
    Nothing,
    /// Sizes do not match.
    #[error(transparent)]
    Dynamics(#[from] DynamicsError),
    /// CAD is not a valid prior.
    #[error(transparent)]
    Prior(#[from] PriorError),
    /// An earlier state does not fit.
    #[error(transparent)]
    Information(#[from] InformationError),
}

/// The observed quantities at one time.
#[derive(Clone, Copy, Debug)]
pub struct OnlineObservation<'a> {
    /// Time; later than that of the last observation.
    pub t: Nanos,
    /// Poses and motions of all links.
    pub kinematics: &'a Kinematics,
    /// Calibrated F/T readings, their offsets still in them, in their measurement frames; finite
    /// even if a sensor is faulty.
    pub readings: &'a [Wrench],
    /// The present contacts.
    pub active: &'a ContactSet,
    /// Fault of the base motion.
    pub base: Reason,
    /// Fault of each joint's motion.
    pub joints: &'a [Reason],
    /// The joints that have moved since the last observation, beyond their noise.
    pub moved: &'a DofSet,
    /// Whether the base has moved.
    pub is_base_moved: bool,
    /// The joints' motion that gave the kinematics.
    pub state: JointState<'a>,
    /// The base link's motion that did.
    pub base_motion: FrameMotion,
    /// Fault of each sensor's reading.
    pub sensors: &'a [Reason],
}

/// Why identification of a component pauses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Paused {
    /// It does not pause.
    #[default]
    No,
    /// A declared contact leaves none of its equations.
    Contact,
    /// Noise and the uncertainty of the solution do not explain its readings: an undeclared
    /// contact, an outlier, or a change.
    Suspected,
    /// A channel that it needs is faulty: why, and which.
    Fault(Reason, ChannelRole),
}

impl Paused {
    /// For a person, with the channels' names. Does not allocate.
    #[must_use]
    pub const fn describe<'r>(&self, robot: &'r Robot) -> impl std::fmt::Display + use<'r> {
        PausedOf {
            paused: *self,
            robot,
        }
    }
}

/// Why identification of a component of `robot` pauses.
struct PausedOf<'r> {
    paused: Paused,
    robot: &'r Robot,
}

impl std::fmt::Display for PausedOf<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (reason, role) = match self.paused {
            Paused::No => return f.write_str("identification is running"),
            Paused::Contact => {
                return f.write_str("identification pauses: a contact is declared");
            }
            Paused::Suspected => {
                return f.write_str(
                    "identification pauses: the readings do not fit the solution; an undeclared \
                     contact, or a change",
                );
            }
            Paused::Fault(reason, role) => (reason, role),
        };
        f.write_str("identification pauses: ")?;
        match self.robot.channels.iter().find(|c| c.role == role) {
            Some(Channel { kind, name, .. }) => {
                write!(f, "the {kind} channel {name} is faulty ({reason})")
            }
            // A base without an IMU has no channel.
            None => write!(f, "a channel is faulty ({reason})"),
        }
    }
}

/// A change that was found, and its consequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum DetectedChange {
    /// The sensors' offsets have jumped, and are re-initialised.
    Offset,
    /// The load of the outermost links has changed, and their parameters are re-initialised.
    Load,
    /// A contact since the start may have ended: everything is learnt anew.
    Anew,
}

impl std::fmt::Display for DetectedChange {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Offset => "an F/T offset has jumped: offsets are re-initialised",
            Self::Load => {
                "the load has changed: the parameters of the outermost links are re-initialised"
            }
            Self::Anew => "a contact since the start may have ended: everything is identified anew",
        })
    }
}

/// Counts of a component's observations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ObservationCounts {
    /// Absorbed observations.
    pub learnt: u64,
    /// Absorbed observations of blocks without motion: they determine a weight once, and offsets.
    pub still: u64,
    /// Excluded under a declared contact.
    pub contact: u64,
    /// Rejected by the gate for at most one block: outliers, and the begin of every disturbance.
    pub outlier: u64,
    /// Rejected by the gate for longer: undeclared contacts, and changes until they are found.
    pub suspected: u64,
    /// Excluded because a channel was silent.
    pub stale: u64,
    /// Excluded because a sensor was saturated.
    pub saturated: u64,
    /// Excluded because a device reported a fault.
    pub device_fault: u64,
    /// Excluded because a channel was not seen yet or had too few samples, or the base motion was
    /// unknown.
    pub unseen: u64,
    /// Changes found: all,
    pub changes: u64,
    /// of offsets,
    pub offset_changes: u64,
    /// and of loads.
    pub load_changes: u64,
    /// Solutions that came after their stamp.
    pub late: u64,
    /// Solutions that failed.
    pub failed: u64,
}

/// The solution of a component.
#[derive(Clone, Debug, Default)]
pub struct ComponentSolution {
    /// Its links.
    pub links: Vec<usize>,
    /// Their inertias, physically consistent.
    pub bodies: Vec<RigidInertia>,
    /// Its sensors.
    pub sensors: Vec<usize>,
    /// Their offsets, calibrated minus true reading, in their measurement frames.
    pub offsets: Vec<Wrench>,
    /// A root `U` of the covariance `P = U^T U` over [ten per link | torque, force of each sensor's
    /// offset].
    pub root: DMatrix<f64>,
    /// Drift rate of each offset: standard deviation after a second [Nm/s^½, N/s^½], [torque;
    /// force].
    pub drift_std: Vec<[f64; 6]>,
    /// Variance of one reading about its prediction [Nm^2, N^2], [torque; force]: sensor noise,
    /// vibration, late stamps.
    pub noise: Vec<[f64; 6]>,
    /// Its part within a second, in the worst of the last ones in which nothing disturbed the
    /// sensor.
    pub worst: Vec<[f64; 6]>,
    /// The stamp of the newest data used.
    pub data_until: Nanos,
    /// The prior's weight; NaN before the first solution.
    pub tau: f64,
    /// Number of parameters that the data determine, rather than the prior.
    pub effective: f64,
    /// Duration of motion of its links in the absorbed data \[s\].
    pub seconds_in_motion: f64,
    /// Number of absorbed rows, in motion and at rest.
    pub rows: u64,
    /// Whether this solution uses the data up to [`Solution::data_until`]. Otherwise the job
    /// failed, and the earlier solution is kept.
    pub is_accepted: bool,
    /// What is likelier than the stated setup.
    pub leading: Option<Hypothesis>,
    /// The most probable unknowns, `[s | d]`, and a root of their covariance over `[d | s]`. The
    /// gate judges new readings by them.
    pub(crate) estimate: Vec<f64>,
    pub(crate) covariance_root: DMatrix<f64>,
}

/// The result of a job.
#[derive(Clone, Debug, Default)]
pub struct Solution {
    /// The stamp of the newest data of the job.
    pub data_until: Nanos,
    /// The solution of each component.
    pub components: Vec<ComponentSolution>,
    /// Per degree of freedom.
    pub doubts: Vec<Doubt>,
}

/// What else than stated may be the case, as far as a torque depends on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Doubt {
    /// The least deviation of the torque, because of hypotheses that are not refuted \[Nm or N\].
    pub deviation: f64,
    /// What is likelier than the stated setup.
    pub leading: Option<Hypothesis>,
}

impl Doubt {
    /// Before anything is known.
    pub(crate) const COMPLETE: Self = Self {
        deviation: f64::INFINITY,
        leading: None,
    };
    /// Where nothing is in doubt.
    pub(crate) const NONE: Self = Self {
        deviation: 0.0,
        leading: None,
    };
}

/// Period of the solutions, and the delay of their use after their data.
pub(crate) const SOLVE: Nanos = Nanos::from_millis(1000);
