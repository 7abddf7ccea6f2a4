//! The values and reasons of the C interface, and what they are made of.

use proprio_topics::ipc::{Contact, Measured, Presence, Torque, Unavailable};
use proprio_topics::{Imu, JointState, Name, Nanos, Quality, Reason, Wrench};
use std::ffi::c_char;

/// Whether there is a value, and if not, why.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum proprio_status {
    /// There is a value, and it may be used.
    PROPRIO_OK = 0,
    /// None has been received since this reader was made, or since its publisher was restarted.
    PROPRIO_NEVER_SEEN = 1,
    /// The last one is older than allowed.
    PROPRIO_STALE = 2,
    /// The publisher's description, with its names, has not been received yet.
    PROPRIO_NOT_DESCRIBED = 3,
    /// The publisher has nothing of that name and kind, or a pointer is null.
    PROPRIO_UNKNOWN = 4,
    /// It is withheld: see `reason`.
    PROPRIO_WITHHELD = 5,
}
use proprio_status::{
    PROPRIO_NEVER_SEEN, PROPRIO_NOT_DESCRIBED, PROPRIO_OK, PROPRIO_STALE, PROPRIO_UNKNOWN,
    PROPRIO_WITHHELD,
};

/// Why a value is withheld.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum proprio_reason {
    /// It is not withheld.
    PROPRIO_REASON_NONE = 0,
    /// A channel it depends on has never been seen.
    PROPRIO_REASON_NEVER_SEEN = 1,
    /// A channel it depends on has been silent for longer than its maximum.
    PROPRIO_REASON_STALE = 2,
    /// A sensor it depends on is saturated.
    PROPRIO_REASON_SATURATED = 3,
    /// A device it depends on reports a fault.
    PROPRIO_REASON_DEVICE_FAULT = 4,
    /// The unknown contact wrenches of its sub-tree outnumber the equations.
    PROPRIO_REASON_UNDETERMINED = 5,
    /// Its predicted standard deviation exceeds the configured bound.
    PROPRIO_REASON_UNCERTAIN = 6,
    /// The result of the computation is not finite.
    PROPRIO_REASON_NOT_FINITE = 7,
    /// This contact is not present.
    PROPRIO_REASON_ABSENT = 8,
    /// A channel it depends on has too few samples yet for a velocity and an acceleration.
    PROPRIO_REASON_STARTING = 9,
    /// It depends on the base motion, and no link is declared to stand still.
    PROPRIO_REASON_NO_STANCE = 10,
    /// Neither the model nor a possible contact explains the F/T readings of its sub-tree.
    PROPRIO_REASON_UNEXPLAINED = 11,
    /// A sensor it depends on repeats its readings instead of measuring.
    PROPRIO_REASON_FROZEN = 12,
    /// A reading it depends on contradicts the ones before it.
    PROPRIO_REASON_IMPLAUSIBLE = 13,
    /// The readings contradict what is configured, such as an encoder reversed or a sensor turned.
    PROPRIO_REASON_CONTRADICTED = 14,
}

/// Whether a gateway or an estimator is there.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum proprio_presence {
    /// None has been started, or all have ended and nobody holds what they left.
    PROPRIO_NOT_STARTED = 0,
    /// It sends its health ten times a second.
    PROPRIO_RUNNING = 1,
    /// It lives, but has sent no health for a second.
    PROPRIO_STUCK = 2,
    /// It has ended in order, or had gone before anybody looked.
    PROPRIO_ENDED = 3,
    /// It was killed, or has crashed.
    PROPRIO_KILLED = 4,
}
use proprio_presence::{
    PROPRIO_ENDED, PROPRIO_KILLED, PROPRIO_NOT_STARTED, PROPRIO_RUNNING, PROPRIO_STUCK,
};

/// The kind of a channel: a joint's encoder. Read it with proprio_read_joint.
pub const PROPRIO_KIND_JOINT: u32 = 0;
/// The kind of a channel: a force/torque sensor. Read it with proprio_read_wrench.
pub const PROPRIO_KIND_WRENCH: u32 = 1;
/// The kind of a channel: an inertial measurement unit. Read it with proprio_read_imu.
pub const PROPRIO_KIND_IMU: u32 = 2;

/// A bit of `quality`: at least one reading was lost between this one and the one before.
pub const PROPRIO_QUALITY_GAP_BEFORE: u32 = 1;
/// A bit of `quality`: the device has its own sequence numbers.
pub const PROPRIO_QUALITY_DEVICE_COUNTER: u32 = 32;
/// A bit of `quality`: the drive reports a fault that does not concern its encoder.
pub const PROPRIO_QUALITY_DRIVE_FAULT: u32 = 64;
/// A bit of `quality`: the zero of the channel may have changed since the reading before.
pub const PROPRIO_QUALITY_ZERO_CHANGED: u32 = 128;

const _: () = {
    assert!(PROPRIO_QUALITY_GAP_BEFORE == Quality::GAP_BEFORE.0);
    assert!(PROPRIO_QUALITY_DEVICE_COUNTER == Quality::DEVICE_COUNTER.0);
    assert!(PROPRIO_QUALITY_DRIVE_FAULT == Quality::DRIVE_FAULT.0);
    assert!(PROPRIO_QUALITY_ZERO_CHANGED == Quality::ZERO_CHANGED.0);
};

/// The size of a name with its final zero byte.
pub const PROPRIO_NAME_SIZE: usize = 64;

/// Why there is no value.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_unavailable {
    /// PROPRIO_OK if there is a value.
    pub status: proprio_status,
    /// Only with PROPRIO_WITHHELD.
    pub reason: proprio_reason,
    /// How old the last value is [ns]; 0 if there is none or its age is not the reason.
    pub age: i64,
    /// The channel that is the cause; empty if there is no single one.
    pub channel: [c_char; PROPRIO_NAME_SIZE],
}

/// The torque of a joint, by the parent link on the child link along the URDF axis.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_torque {
    /// Torque [Nm] (force [N] for a prismatic joint). NaN if there is none.
    pub torque: f64,
    /// Its standard deviation [Nm]; NaN where it is not known.
    pub standard_deviation: f64,
    /// CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
    pub acquired: i64,
    /// How old it was at the last update [ns].
    pub age: i64,
}

/// The wrench of a contact, by the environment on the link.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_contact {
    /// Force [N], in the axes of the frame that the estimator's configuration names.
    pub force: [f64; 3],
    /// Torque [Nm], in the same axes, about the frame's origin.
    pub torque: [f64; 3],
    /// Standard deviations of force [N] and torque [Nm]; NaN where not known.
    pub standard_deviation: [f64; 6],
    /// Where it is taken to act [m], in the same axes, from the same origin.
    pub position: [f64; 3],
    /// CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
    pub acquired: i64,
    /// How old it was at the last update [ns].
    pub age: i64,
    /// Whether it was not declared, but F/T readings show that it is present.
    pub is_detected: bool,
    /// Whether a declaration or a skin says where it is; else it is the configured place.
    pub is_located: bool,
}

/// What a joint's device reports, positive along the axis that the configuration states. NaN where
/// it does not report it.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_joint_state {
    /// Position [rad, or m].
    pub position: f64,
    /// Velocity [rad/s, or m/s].
    pub velocity: f64,
    /// Acceleration [rad/s^2, or m/s^2].
    pub acceleration: f64,
    /// Measured torque [Nm, or N].
    pub torque: f64,
    /// Motor current [A].
    pub current: f64,
    /// CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
    pub acquired: i64,
    /// How old it was at the last update [ns].
    pub age: i64,
    /// Bits PROPRIO_QUALITY_...; none of them makes it unusable.
    pub quality: u32,
}

/// What a force/torque sensor reports, in its own axes about its own origin.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_wrench {
    /// Force [N].
    pub force: [f64; 3],
    /// Torque [Nm]; NaN if the sensor measures none.
    pub torque: [f64; 3],
    /// CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
    pub acquired: i64,
    /// How old it was at the last update [ns].
    pub age: i64,
    /// Bits PROPRIO_QUALITY_...; none of them makes it unusable.
    pub quality: u32,
}

/// What an inertial measurement unit reports, in its own axes. NaN where it does not report it.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_imu {
    /// Acceleration minus gravity [m/s^2]: it points up at rest.
    pub proper_acceleration: [f64; 3],
    /// Angular velocity [rad/s].
    pub angular_velocity: [f64; 3],
    /// Angular acceleration [rad/s^2].
    pub angular_acceleration: [f64; 3],
    /// Magnetic field [T].
    pub magnetic_field: [f64; 3],
    /// Unit quaternion w, x, y, z: world from IMU, by the device's own filter.
    pub orientation: [f64; 4],
    /// CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
    pub acquired: i64,
    /// How old it was at the last update [ns].
    pub age: i64,
    /// Bits PROPRIO_QUALITY_...; none of them makes it unusable.
    pub quality: u32,
}

/// Who is missing.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_missing {
    /// The robot's gateway.
    pub gateway: proprio_presence,
    /// The robot's estimator.
    pub estimator: proprio_presence,
    /// Whether both are running, and nothing else is wrong.
    pub is_nobody: bool,
    /// The same and what else is wrong, in words: what, where, and what to do.
    pub text: [c_char; 512],
}

/// Puts as much of `text` as fits into `to`, with a final zero byte.
pub(crate) fn put(text: &str, to: &mut [c_char]) {
    let Some(room) = to.len().checked_sub(1) else {
        return;
    };
    let whole = (0..=room).rev().find(|end| text.is_char_boundary(*end));
    let end = whole.unwrap_or(0);
    let bytes = text.bytes().take(end).chain([0]);
    (to.iter_mut().zip(bytes)).for_each(|(to, byte)| *to = byte as c_char);
}

fn name(of: &Name) -> [c_char; PROPRIO_NAME_SIZE] {
    let mut name = [0; PROPRIO_NAME_SIZE];
    put(of.as_str(), &mut name);
    name
}

pub(crate) const fn status(of: &Unavailable) -> proprio_status {
    match of {
        Unavailable::NeverSeen => PROPRIO_NEVER_SEEN,
        Unavailable::Stale { .. } => PROPRIO_STALE,
        Unavailable::NotDescribed => PROPRIO_NOT_DESCRIBED,
        Unavailable::Unknown => PROPRIO_UNKNOWN,
        Unavailable::Withheld { .. } => PROPRIO_WITHHELD,
    }
}

const fn reason(of: Reason) -> proprio_reason {
    match of {
        Reason::None => proprio_reason::PROPRIO_REASON_NONE,
        Reason::NeverSeen => proprio_reason::PROPRIO_REASON_NEVER_SEEN,
        Reason::Stale => proprio_reason::PROPRIO_REASON_STALE,
        Reason::Saturated => proprio_reason::PROPRIO_REASON_SATURATED,
        Reason::DeviceFault => proprio_reason::PROPRIO_REASON_DEVICE_FAULT,
        Reason::Undetermined => proprio_reason::PROPRIO_REASON_UNDETERMINED,
        Reason::Uncertain => proprio_reason::PROPRIO_REASON_UNCERTAIN,
        Reason::NotFinite => proprio_reason::PROPRIO_REASON_NOT_FINITE,
        Reason::Absent => proprio_reason::PROPRIO_REASON_ABSENT,
        Reason::Starting => proprio_reason::PROPRIO_REASON_STARTING,
        Reason::NoStance => proprio_reason::PROPRIO_REASON_NO_STANCE,
        Reason::Unexplained => proprio_reason::PROPRIO_REASON_UNEXPLAINED,
        Reason::Frozen => proprio_reason::PROPRIO_REASON_FROZEN,
        Reason::Implausible => proprio_reason::PROPRIO_REASON_IMPLAUSIBLE,
        Reason::Contradicted => proprio_reason::PROPRIO_REASON_CONTRADICTED,
    }
}

pub(crate) const fn presence(of: Presence) -> proprio_presence {
    match of {
        Presence::NotStarted => PROPRIO_NOT_STARTED,
        Presence::Running => PROPRIO_RUNNING,
        Presence::Stuck { .. } => PROPRIO_STUCK,
        Presence::Ended => PROPRIO_ENDED,
        Presence::Killed => PROPRIO_KILLED,
    }
}

impl proprio_unavailable {
    /// There is a value.
    pub(crate) const NOT: Self = Self {
        status: PROPRIO_OK,
        reason: proprio_reason::PROPRIO_REASON_NONE,
        age: 0,
        channel: [0; PROPRIO_NAME_SIZE],
    };
}

impl From<&Unavailable> for proprio_unavailable {
    fn from(why: &Unavailable) -> Self {
        let mut this = Self {
            status: status(why),
            ..Self::NOT
        };
        match why {
            Unavailable::Stale { age } => this.age = age.0,
            Unavailable::Withheld {
                reason: because,
                channel,
            } => {
                this.reason = reason(*because);
                this.channel = name(channel);
            }
            Unavailable::NeverSeen | Unavailable::NotDescribed | Unavailable::Unknown => {}
        }
        this
    }
}

/// A value with the instant at which it was measured.
pub(crate) type At<T> = (T, i64);

impl From<Result<At<Torque>, ()>> for proprio_torque {
    fn from(torque: Result<At<Torque>, ()>) -> Self {
        let absent = Torque {
            torque: f64::NAN,
            standard_deviation: f64::NAN,
            age: Nanos::ZERO,
        };
        let (t, acquired) = torque.unwrap_or((absent, 0));
        Self {
            torque: t.torque,
            standard_deviation: t.standard_deviation,
            acquired,
            age: t.age.0,
        }
    }
}

impl From<Result<At<Contact>, ()>> for proprio_contact {
    fn from(contact: Result<At<Contact>, ()>) -> Self {
        let absent = Contact {
            wrench: ABSENT_WRENCH,
            standard_deviation: [f64::NAN; 6],
            is_detected: false,
            position: [f64::NAN; 3],
            is_located: false,
            age: Nanos::ZERO,
        };
        let (c, acquired) = contact.unwrap_or((absent, 0));
        Self {
            force: c.wrench.force,
            torque: c.wrench.torque,
            standard_deviation: c.standard_deviation,
            position: c.position,
            acquired,
            age: c.age.0,
            is_detected: c.is_detected,
            is_located: c.is_located,
        }
    }
}

const ABSENT_WRENCH: Wrench = Wrench {
    force: [f64::NAN; 3],
    torque: [f64::NAN; 3],
};

/// A measurement, or one that says that nothing was reported.
fn measured<T>(of: Result<At<Measured<T>>, ()>, absent: T) -> At<Measured<T>> {
    of.unwrap_or_else(|()| {
        let nothing = Measured {
            value: absent,
            quality: Quality::GOOD,
            age: Nanos::ZERO,
        };
        (nothing, 0)
    })
}

impl From<Result<At<Measured<JointState>>, ()>> for proprio_joint_state {
    fn from(joint: Result<At<Measured<JointState>>, ()>) -> Self {
        let (joint, acquired) = measured(joint, JointState::ABSENT);
        Self {
            position: joint.value.position,
            velocity: joint.value.velocity,
            acceleration: joint.value.acceleration,
            torque: joint.value.torque,
            current: joint.value.current,
            acquired,
            age: joint.age.0,
            quality: joint.quality.0,
        }
    }
}

impl From<Result<At<Measured<Wrench>>, ()>> for proprio_wrench {
    fn from(wrench: Result<At<Measured<Wrench>>, ()>) -> Self {
        let (wrench, acquired) = measured(wrench, ABSENT_WRENCH);
        Self {
            force: wrench.value.force,
            torque: wrench.value.torque,
            acquired,
            age: wrench.age.0,
            quality: wrench.quality.0,
        }
    }
}

impl From<Result<At<Measured<Imu>>, ()>> for proprio_imu {
    fn from(imu: Result<At<Measured<Imu>>, ()>) -> Self {
        let (imu, acquired) = measured(imu, Imu::ABSENT);
        Self {
            proper_acceleration: imu.value.proper_acceleration,
            angular_velocity: imu.value.angular_velocity,
            angular_acceleration: imu.value.angular_acceleration,
            magnetic_field: imu.value.magnetic_field,
            orientation: imu.value.orientation,
            acquired,
            age: imu.age.0,
            quality: imu.quality.0,
        }
    }
}
