//! The reader for control loops ([`RobotReader`]) with a C interface: `include/proprio.h` is made
//! from this file, and its comments are those here.
//!
//! This layer adds nothing but C's types: handles are numbers, a result is a status, a value in the
//! caller's memory and, if wanted, the reason. No panic leaves it, and a null pointer is an answer
//! ([`proprio_status::PROPRIO_UNKNOWN`], false, nothing done), not undefined behaviour.

// Names are those of the header. It has no links.
#![allow(non_camel_case_types, rustdoc::bare_urls)]
// Pointers from C.
#![allow(unsafe_code)]

use proprio_topics::ipc::{
    ChannelHandle, Contact, ContactHandle, DomainConfig, Measured, Presence, RobotReader, Torque,
    TorqueHandle, Unavailable, monotonic,
};
use proprio_topics::{Code, Imu, JointState, Kind, Name, Nanos, Quality, Reason, Wrench};
use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;

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
    /// Never PROPRIO_OK.
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
    /// How old it is [ns].
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
    /// How old it is [ns].
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
    /// How old it is [ns].
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
    /// How old it is [ns].
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
    /// How old it is [ns].
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

/// A joint's torque, in one reader. It stays good as long as the reader, whatever is restarted.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_torque_handle {
    /// Its number.
    pub number: u32,
}

/// A contact's wrench, in one reader. It stays good as long as the reader.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_contact_handle {
    /// Its number.
    pub number: u32,
}

/// A channel of the gateway, in one reader. It stays good as long as the reader.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct proprio_channel_handle {
    /// Its number.
    pub number: u32,
}

/// The newest state of one robot. Only one thread may use it at a time.
#[derive(Debug)]
pub struct proprio_reader {
    robot: RobotReader,
    torques: Vec<TorqueHandle>,
    contacts: Vec<ContactHandle>,
    channels: Vec<ChannelHandle>,
}

/// Runs `call` with what `pointer` points to; gives `otherwise` if that is null, or after a panic.
///
/// # Safety
/// `pointer` is null, or comes from [`proprio_reader_new`] and has not been freed.
unsafe fn with<R: Copy>(
    pointer: *const proprio_reader,
    otherwise: R,
    call: impl FnOnce(&proprio_reader) -> R,
) -> R {
    // SAFETY: the caller's promise.
    let Some(reader) = (unsafe { pointer.as_ref() }) else {
        return otherwise;
    };
    catch_unwind(AssertUnwindSafe(|| call(reader))).unwrap_or(otherwise)
}

/// As [`with`], for a call that changes the reader.
///
/// # Safety
/// As there.
unsafe fn with_mut<R: Copy>(
    pointer: *mut proprio_reader,
    otherwise: R,
    call: impl FnOnce(&mut proprio_reader) -> R,
) -> R {
    // SAFETY: the caller's promise.
    let Some(reader) = (unsafe { pointer.as_mut() }) else {
        return otherwise;
    };
    catch_unwind(AssertUnwindSafe(|| call(reader))).unwrap_or(otherwise)
}

/// The text at `pointer`; `None` if that is null.
///
/// # Safety
/// `pointer` is null or points to text that ends with a zero byte.
unsafe fn text(pointer: *const c_char) -> Option<String> {
    if pointer.is_null() {
        return None;
    }
    // SAFETY: the caller's promise.
    let text = unsafe { CStr::from_ptr(pointer) };
    Some(text.to_string_lossy().into_owned())
}

/// Puts as much of `text` as fits into `to`, with a final zero byte.
fn put(text: &str, to: &mut [c_char]) {
    let Some(room) = to.len().checked_sub(1) else {
        return;
    };
    let whole = (0..=room).rev().find(|end| text.is_char_boundary(*end));
    let end = whole.unwrap_or(0);
    let bytes = text.bytes().take(end).chain([0]);
    (to.iter_mut().zip(bytes)).for_each(|(to, byte)| *to = byte as c_char);
}

/// As [`put`], into memory of C.
///
/// # Safety
/// `to` is null or has room for `size` bytes.
unsafe fn put_at(text: &str, to: *mut c_char, size: usize) {
    if !to.is_null() && size > 0 {
        // SAFETY: the caller's promise; any byte is a `c_char`.
        put(text, unsafe { std::slice::from_raw_parts_mut(to, size) });
    }
}

/// Writes `value` to C's memory, if it wants one.
///
/// # Safety
/// `to` is null or may be written.
unsafe fn give<T>(value: T, to: *mut T) {
    if !to.is_null() {
        // SAFETY: the caller's promise.
        unsafe { to.write(value) };
    }
}

fn name(of: &Name) -> [c_char; PROPRIO_NAME_SIZE] {
    let mut name = [0; PROPRIO_NAME_SIZE];
    put(of.as_str(), &mut name);
    name
}

const fn status(of: &Unavailable) -> proprio_status {
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

const fn presence(of: Presence) -> proprio_presence {
    match of {
        Presence::NotStarted => PROPRIO_NOT_STARTED,
        Presence::Running => PROPRIO_RUNNING,
        Presence::Stuck { .. } => PROPRIO_STUCK,
        Presence::Ended => PROPRIO_ENDED,
        Presence::Killed => PROPRIO_KILLED,
    }
}

impl From<&Unavailable> for proprio_unavailable {
    fn from(why: &Unavailable) -> Self {
        let mut this = Self {
            status: status(why),
            reason: proprio_reason::PROPRIO_REASON_NONE,
            age: 0,
            channel: [0; PROPRIO_NAME_SIZE],
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

impl From<Result<Torque, ()>> for proprio_torque {
    fn from(torque: Result<Torque, ()>) -> Self {
        torque.map_or(
            Self {
                torque: f64::NAN,
                standard_deviation: f64::NAN,
                age: 0,
            },
            |t| Self {
                torque: t.torque,
                standard_deviation: t.standard_deviation,
                age: t.age.0,
            },
        )
    }
}

impl From<Result<Contact, ()>> for proprio_contact {
    fn from(contact: Result<Contact, ()>) -> Self {
        contact.map_or(
            Self {
                force: [f64::NAN; 3],
                torque: [f64::NAN; 3],
                standard_deviation: [f64::NAN; 6],
                position: [f64::NAN; 3],
                age: 0,
                is_detected: false,
                is_located: false,
            },
            |c| Self {
                force: c.wrench.force,
                torque: c.wrench.torque,
                standard_deviation: c.standard_deviation,
                position: c.position,
                age: c.age.0,
                is_detected: c.is_detected,
                is_located: c.is_located,
            },
        )
    }
}

/// A measurement, or one that says that nothing was reported.
fn measured<T>(of: Result<Measured<T>, ()>, absent: T) -> Measured<T> {
    of.unwrap_or(Measured {
        value: absent,
        quality: Quality::GOOD,
        age: Nanos::ZERO,
    })
}

impl From<Result<Measured<JointState>, ()>> for proprio_joint_state {
    fn from(joint: Result<Measured<JointState>, ()>) -> Self {
        let Measured {
            value,
            quality,
            age,
        } = measured(joint, JointState::ABSENT);
        Self {
            position: value.position,
            velocity: value.velocity,
            acceleration: value.acceleration,
            torque: value.torque,
            current: value.current,
            age: age.0,
            quality: quality.0,
        }
    }
}

impl From<Result<Measured<Wrench>, ()>> for proprio_wrench {
    fn from(wrench: Result<Measured<Wrench>, ()>) -> Self {
        let absent = Wrench {
            force: [f64::NAN; 3],
            torque: [f64::NAN; 3],
        };
        let Measured {
            value,
            quality,
            age,
        } = measured(wrench, absent);
        Self {
            force: value.force,
            torque: value.torque,
            age: age.0,
            quality: quality.0,
        }
    }
}

impl From<Result<Measured<Imu>, ()>> for proprio_imu {
    fn from(imu: Result<Measured<Imu>, ()>) -> Self {
        let Measured {
            value,
            quality,
            age,
        } = measured(imu, Imu::ABSENT);
        Self {
            proper_acceleration: value.proper_acceleration,
            angular_velocity: value.angular_velocity,
            angular_acceleration: value.angular_acceleration,
            magnetic_field: value.magnetic_field,
            orientation: value.orientation,
            age: age.0,
            quality: quality.0,
        }
    }
}

/// Reads a value into C's memory: NaN and the reason, if there is none.
///
/// # Safety
/// `reader` as for [`with`]; `value` and `why` are null or may be written.
unsafe fn read<T, C: From<Result<T, ()>>>(
    reader: *const proprio_reader,
    value: *mut C,
    why: *mut proprio_unavailable,
    read: impl FnOnce(&proprio_reader) -> Result<T, Unavailable>,
) -> proprio_status
where
    Result<T, Unavailable>: Copy,
{
    // SAFETY: the caller's promise.
    let result = unsafe { with(reader, Err(Unavailable::Unknown), read) };
    let found = match &result {
        Ok(_) => PROPRIO_OK,
        Err(because) => {
            // SAFETY: the caller's promise.
            unsafe { give(because.into(), why) };
            status(because)
        }
    };
    // SAFETY: the caller's promise.
    unsafe { give(C::from(result.map_err(drop)), value) };
    found
}

/// The handle with this number.
fn handle<H: Copy>(handles: &[H], number: u32) -> Result<H, Unavailable> {
    let handle = usize::try_from(number).ok().and_then(|n| handles.get(n));
    handle.copied().ok_or(Unavailable::Unknown)
}

/// The number of `handle` in `handles`, where it is put if it is new.
fn number<H: PartialEq>(handles: &mut Vec<H>, handle: H) -> u32 {
    let place = handles.iter().position(|known| *known == handle);
    let place = place.unwrap_or_else(|| {
        handles.push(handle);
        handles.len() - 1
    });
    u32::try_from(place).unwrap_or(u32::MAX)
}

/// CLOCK_MONOTONIC [ns], the clock of all instants here.
#[unsafe(no_mangle)]
pub extern "C" fn proprio_now() -> i64 {
    monotonic().0
}

/// A reader of `robot`, or NULL, and then why in `message` (of `message_size` bytes; may be NULL).
///
/// Torques and contacts are stale after `max_age` [ns], measurements after their channel's maximum
/// silence. The reader belongs to a domain: the folder `runtime_dir` and the name `domain`; where
/// they are NULL, the environment names them (PROPRIO_RUNTIME_DIR, PROPRIO_DOMAIN), as for the
/// gateway and the estimator. They need not run yet. The reader has a thread that looks for them;
/// it takes no signals, and ends with proprio_reader_free. A process that forks makes its readers
/// after that.
///
/// # Safety
/// Texts end with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_reader_new(
    robot: *const c_char,
    max_age: i64,
    runtime_dir: *const c_char,
    domain: *const c_char,
    message: *mut c_char,
    message_size: usize,
) -> *mut proprio_reader {
    // SAFETY: the caller's promise.
    let (robot, base, domain) = unsafe { (text(robot), text(runtime_dir), text(domain)) };
    let made = catch_unwind(|| {
        let robot = robot.ok_or("the robot's name is NULL")?;
        let mut config = DomainConfig::from_env();
        if let Some(base) = base {
            config.base = PathBuf::from(base);
        }
        if let Some(domain) = domain {
            config.name = domain;
        }
        let robot = RobotReader::new(&config, &robot, Nanos(max_age))
            .map_err(|error| format!("the reader's thread cannot be started: {error}"))?;
        Ok::<_, String>(Box::new(proprio_reader {
            robot,
            torques: Vec::new(),
            contacts: Vec::new(),
            channels: Vec::new(),
        }))
    });
    let why = match made {
        Ok(Ok(reader)) => return Box::into_raw(reader),
        Ok(Err(why)) => why,
        Err(_) => "a defect of this library: its message is on standard error".to_owned(),
    };
    // SAFETY: the caller's promise.
    unsafe { put_at(&why, message, message_size) };
    std::ptr::null_mut()
}

/// Ends a reader. NULL is allowed.
///
/// # Safety
/// It comes from proprio_reader_new and is not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_reader_free(reader: *mut proprio_reader) {
    if !reader.is_null() {
        // SAFETY: the caller's promise.
        let reader = unsafe { Box::from_raw(reader) };
        let _ = catch_unwind(AssertUnwindSafe(|| drop(reader)));
    }
}

/// The torque of the joint `name`, which need not exist yet. Not for the cycle: it allocates.
///
/// # Safety
/// `name` ends with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_find_torque(
    reader: *mut proprio_reader,
    name: *const c_char,
) -> proprio_torque_handle {
    // SAFETY: the caller's promise.
    let name = unsafe { text(name) };
    let find = |reader: &mut proprio_reader| match &name {
        Some(name) => number(&mut reader.torques, reader.robot.torque_handle(name)),
        None => u32::MAX,
    };
    // SAFETY: the caller's promise.
    let number = unsafe { with_mut(reader, u32::MAX, find) };
    proprio_torque_handle { number }
}

/// The wrench of the contact `name`, which need not exist yet. Not for the cycle: it allocates.
///
/// # Safety
/// `name` ends with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_find_contact(
    reader: *mut proprio_reader,
    name: *const c_char,
) -> proprio_contact_handle {
    // SAFETY: the caller's promise.
    let name = unsafe { text(name) };
    let find = |reader: &mut proprio_reader| match &name {
        Some(name) => number(&mut reader.contacts, reader.robot.contact_handle(name)),
        None => u32::MAX,
    };
    // SAFETY: the caller's promise.
    let number = unsafe { with_mut(reader, u32::MAX, find) };
    proprio_contact_handle { number }
}

/// The measurements of the joint or sensor `name`, of kind PROPRIO_KIND_...; it need not exist yet.
/// Not for the cycle: it allocates.
///
/// # Safety
/// `name` ends with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_find_channel(
    reader: *mut proprio_reader,
    kind: u32,
    name: *const c_char,
) -> proprio_channel_handle {
    // SAFETY: the caller's promise.
    let name = unsafe { text(name) };
    let kind = Code::<Kind>::of_number(kind).get();
    let find = |reader: &mut proprio_reader| match (&name, kind) {
        (Some(name), Some(kind)) => number(
            &mut reader.channels,
            reader.robot.channel_handle(kind, name),
        ),
        _ => u32::MAX,
    };
    // SAFETY: the caller's promise.
    let number = unsafe { with_mut(reader, u32::MAX, find) };
    proprio_channel_handle { number }
}

/// Takes what has arrived by `now` (proprio_now). Once in each cycle, before values are read. No
/// system call, no lock, no allocation.
///
/// # Safety
/// `reader` is NULL or comes from proprio_reader_new and has not been freed: for all calls.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_update(reader: *mut proprio_reader, now: i64) {
    // SAFETY: the caller's promise.
    unsafe { with_mut(reader, (), |reader| reader.robot.update(Nanos(now))) }
}

/// Waits until an estimate may have arrived since the last update, at most until `deadline`
/// (proprio_now). Returns whether one may have. One system call.
///
/// # Safety
/// As for proprio_update.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_wait_for_estimate(
    reader: *const proprio_reader,
    deadline: i64,
) -> bool {
    let wait = |reader: &proprio_reader| reader.robot.wait_for_estimate(Nanos(deadline));
    // SAFETY: the caller's promise.
    unsafe { with(reader, false, wait) }
}

/// As proprio_wait_for_estimate, for a sample of any channel.
///
/// # Safety
/// As for proprio_update.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_wait_for_sample(
    reader: *const proprio_reader,
    deadline: i64,
) -> bool {
    let wait = |reader: &proprio_reader| reader.robot.wait_for_sample(Nanos(deadline));
    // SAFETY: the caller's promise.
    unsafe { with(reader, false, wait) }
}

/// The torque of a joint, as of the last update. `torque` and `why` may be NULL; `why` is written
/// only if there is no value. For the cycle.
///
/// # Safety
/// As for proprio_update; `torque` and `why` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_read_torque(
    reader: *const proprio_reader,
    joint: proprio_torque_handle,
    torque: *mut proprio_torque,
    why: *mut proprio_unavailable,
) -> proprio_status {
    let get = |r: &proprio_reader| r.robot.torque(handle(&r.torques, joint.number)?);
    // SAFETY: the caller's promise.
    unsafe { read(reader, torque, why, get) }
}

/// The torques of `count` joints, as of the last update. For each joint in the order of `joints`:
/// its torque [Nm] (NaN if there is none), standard deviation [Nm] and status; each array may be
/// NULL. Returns how many have a value. For the cycle.
///
/// # Safety
/// As for proprio_update; arrays have `count` elements.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_read_torques(
    reader: *const proprio_reader,
    joints: *const proprio_torque_handle,
    count: usize,
    torques: *mut f64,
    standard_deviations: *mut f64,
    statuses: *mut proprio_status,
) -> usize {
    if joints.is_null() {
        return 0;
    }
    let at = |array: *mut f64, place: usize| {
        if array.is_null() {
            array
        } else {
            array.wrapping_add(place)
        }
    };
    let mut available = 0;
    for place in 0..count {
        let mut torque = proprio_torque::from(Err(()));
        // SAFETY: the caller's promise.
        let status = unsafe {
            let joint = *joints.wrapping_add(place);
            proprio_read_torque(reader, joint, &raw mut torque, std::ptr::null_mut())
        };
        available += usize::from(status == PROPRIO_OK);
        // SAFETY: the caller's promise.
        unsafe {
            give(torque.torque, at(torques, place));
            give(torque.standard_deviation, at(standard_deviations, place));
            if !statuses.is_null() {
                statuses.wrapping_add(place).write(status);
            }
        }
    }
    available
}

/// The wrench of a contact: as proprio_read_torque.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_read_contact(
    reader: *const proprio_reader,
    contact: proprio_contact_handle,
    value: *mut proprio_contact,
    why: *mut proprio_unavailable,
) -> proprio_status {
    let get = |r: &proprio_reader| r.robot.contact(handle(&r.contacts, contact.number)?);
    // SAFETY: the caller's promise.
    unsafe { read(reader, value, why, get) }
}

/// The state of a joint as its device reports it: as proprio_read_torque.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_read_joint(
    reader: *const proprio_reader,
    channel: proprio_channel_handle,
    value: *mut proprio_joint_state,
    why: *mut proprio_unavailable,
) -> proprio_status {
    let get = |r: &proprio_reader| r.robot.joint(handle(&r.channels, channel.number)?);
    // SAFETY: the caller's promise.
    unsafe { read(reader, value, why, get) }
}

/// A force/torque sensor's reading: as proprio_read_torque.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_read_wrench(
    reader: *const proprio_reader,
    channel: proprio_channel_handle,
    value: *mut proprio_wrench,
    why: *mut proprio_unavailable,
) -> proprio_status {
    let get = |r: &proprio_reader| r.robot.wrench(handle(&r.channels, channel.number)?);
    // SAFETY: the caller's promise.
    unsafe { read(reader, value, why, get) }
}

/// An inertial measurement unit's reading: as proprio_read_torque.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_read_imu(
    reader: *const proprio_reader,
    channel: proprio_channel_handle,
    value: *mut proprio_imu,
    why: *mut proprio_unavailable,
) -> proprio_status {
    let get = |r: &proprio_reader| r.robot.imu(handle(&r.channels, channel.number)?);
    // SAFETY: the caller's promise.
    unsafe { read(reader, value, why, get) }
}

/// Gives the entry `number` of a list of names to C; whether there is one.
///
/// # Safety
/// `name` is null or has room for a name.
unsafe fn entry<'a>(
    mut names: impl Iterator<Item = &'a str>,
    number: usize,
    name: *mut c_char,
) -> bool {
    let Some(found) = names.nth(number) else {
        return false;
    };
    // SAFETY: the caller's promise.
    unsafe { put_at(found, name, PROPRIO_NAME_SIZE) };
    true
}

/// The name of the estimator's joint `number`, from 0, in `name` of PROPRIO_NAME_SIZE bytes; false
/// if there is none, or if the estimator has not been seen yet.
///
/// # Safety
/// As for proprio_update; `name` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_torque_name(
    reader: *const proprio_reader,
    number: usize,
    name: *mut c_char,
) -> bool {
    // SAFETY: the caller's promise.
    let get = |r: &proprio_reader| unsafe { entry(r.robot.torque_names(), number, name) };
    // SAFETY: the caller's promise.
    unsafe { with(reader, false, get) }
}

/// The name of the estimator's contact `number`: as proprio_torque_name.
///
/// # Safety
/// As there.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_contact_name(
    reader: *const proprio_reader,
    number: usize,
    name: *mut c_char,
) -> bool {
    // SAFETY: the caller's promise.
    let get = |r: &proprio_reader| unsafe { entry(r.robot.contact_names(), number, name) };
    // SAFETY: the caller's promise.
    unsafe { with(reader, false, get) }
}

/// The name of the gateway's channel `number` and its kind (PROPRIO_KIND_..., or a greater number
/// for one that this library does not read): as proprio_torque_name.
///
/// # Safety
/// As there; `kind` may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_channel_name(
    reader: *const proprio_reader,
    number: usize,
    name: *mut c_char,
    kind: *mut u32,
) -> bool {
    let get = |reader: &proprio_reader| {
        let mut channels = reader.robot.channel_names();
        let Some((of, found)) = channels.nth(number) else {
            return false;
        };
        // SAFETY: the caller's promise.
        unsafe {
            put_at(found, name, PROPRIO_NAME_SIZE);
            give(of as u32, kind);
        }
        true
    };
    // SAFETY: the caller's promise.
    unsafe { with(reader, false, get) }
}

/// Who is missing. Not for the cycle: it takes a lock for a moment and allocates. Returns
/// `is_nobody`.
///
/// # Safety
/// As for proprio_update; `missing` is NULL or may be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_who_is_missing(
    reader: *const proprio_reader,
    missing: *mut proprio_missing,
) -> bool {
    let mut who = proprio_missing {
        gateway: PROPRIO_NOT_STARTED,
        estimator: PROPRIO_NOT_STARTED,
        is_nobody: false,
        text: [0; 512],
    };
    put("there is no reader", &mut who.text);
    let ask = |reader: &proprio_reader| {
        let found = reader.robot.who_is_missing();
        let mut who = proprio_missing {
            gateway: presence(found.gateway),
            estimator: presence(found.estimator),
            is_nobody: found.is_nobody(),
            ..who
        };
        put(&found.to_string(), &mut who.text);
        who
    };
    // SAFETY: the caller's promise.
    let who = unsafe { with(reader, who, ask) };
    // SAFETY: the caller's promise.
    unsafe { give(who, missing) };
    who.is_nobody
}

/// `why` in words, as "withheld: saturated (l_arm_ft_sensor)", in `text` of `size` bytes.
///
/// # Safety
/// `why` may be read; `text` has room for `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_describe(
    why: *const proprio_unavailable,
    text: *mut c_char,
    size: usize,
) {
    // SAFETY: the caller's promise.
    let Some(why) = (unsafe { why.as_ref() }) else {
        return;
    };
    let channel: Vec<u8> = (why.channel.iter())
        .map(|c| *c as u8)
        .take_while(|byte| *byte != 0)
        .collect();
    let because = match why.status {
        PROPRIO_OK => return,
        PROPRIO_NEVER_SEEN => Unavailable::NeverSeen,
        PROPRIO_STALE => Unavailable::Stale {
            age: Nanos(why.age),
        },
        PROPRIO_NOT_DESCRIBED => Unavailable::NotDescribed,
        PROPRIO_UNKNOWN => Unavailable::Unknown,
        PROPRIO_WITHHELD => Unavailable::Withheld {
            reason: (Reason::ALL.into_iter())
                .find(|known| reason(*known) == why.reason)
                .unwrap_or_default(),
            channel: Name::new(&String::from_utf8_lossy(&channel)).unwrap_or(Name::EMPTY),
        },
    };
    // SAFETY: the caller's promise.
    unsafe { put_at(&because.to_string(), text, size) };
}
