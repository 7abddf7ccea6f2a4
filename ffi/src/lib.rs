#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]
// The comments are those of the C header, where units stand in brackets as they are.
#![allow(rustdoc::broken_intra_doc_links)]
// Names are those of the header. It has no links.
#![allow(non_camel_case_types, rustdoc::bare_urls)]
// Pointers from C.
#![allow(unsafe_code)]

mod values;

use proprio_topics::ipc::{
    ChannelHandle, ContactHandle, DomainConfig, RobotReader, TorqueHandle, Unavailable, monotonic,
};
use proprio_topics::{Code, Kind, Name, Nanos, Reason};
use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use values::{At, presence, put, status};

pub use values::*;

use proprio_presence::PROPRIO_NOT_STARTED;
use proprio_status::{
    PROPRIO_NEVER_SEEN, PROPRIO_NOT_DESCRIBED, PROPRIO_OK, PROPRIO_STALE, PROPRIO_UNKNOWN,
    PROPRIO_WITHHELD,
};

/// A joint's torque, in one reader. It stays good as long as the reader, whatever is restarted; in
/// another reader it may mean another joint.
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
    /// That of the last update.
    now: i64,
    /// The process that made it: a child of that has a copy, but not its thread.
    process: u32,
}

/// Ages below are no ages: the caller's clock is not CLOCK_MONOTONIC in nanoseconds [ns].
const OTHER_CLOCK: Nanos = Nanos::from_millis(-60_000);

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

/// As [`put`], into memory of C.
///
/// # Safety
/// `to` is null or has room for `size` bytes.
unsafe fn put_at(text: &str, to: *mut c_char, size: usize) {
    if !to.is_null() {
        let mut buffer = [0; 512];
        let size = size.min(buffer.len());
        if let Some(part) = buffer.get_mut(..size) {
            put(text, part);
        }
        // SAFETY: the caller's promise; `buffer` has as many.
        unsafe { to.copy_from_nonoverlapping(buffer.as_ptr(), size) };
    }
}

/// Writes `value` to C's memory, if it wants one.
///
/// # Safety
/// `to` is null or may be written.
unsafe fn give<T>(value: T, to: *mut T) {
    // SAFETY: the caller's promise.
    unsafe { give_at(value, to, 0) };
}

/// Writes `value` to the element `index` of an array of C, if it wants one.
///
/// # Safety
/// `to` is null or has this element.
unsafe fn give_at<T>(value: T, to: *mut T, index: usize) {
    if !to.is_null() {
        // SAFETY: the caller's promise.
        unsafe { to.wrapping_add(index).write(value) };
    }
}

/// Reads a value into C's memory: NaN and the reason, if there is none.
///
/// # Safety
/// `reader` as for [`with`]; `value` and `why` are null or may be written.
unsafe fn read<T: Copy, C: From<Result<At<T>, ()>>>(
    reader: *const proprio_reader,
    value: *mut C,
    why: *mut proprio_unavailable,
    age: impl FnOnce(&T) -> Nanos,
    read: impl FnOnce(&proprio_reader) -> Result<T, Unavailable>,
) -> proprio_status {
    let read = |reader: &proprio_reader| {
        let value = read(reader)?;
        Ok((value, acquired(reader, age(&value))?))
    };
    // SAFETY: the caller's promise.
    let result = unsafe { with(reader, Err(Unavailable::Unknown), read) };
    let (found, because) = match &result {
        Ok(_) => (PROPRIO_OK, proprio_unavailable::NOT),
        Err(because) => (status(because), because.into()),
    };
    // SAFETY: the caller's promise.
    unsafe {
        give(because, why);
        give(C::from(result.map_err(drop)), value);
    }
    found
}

/// The instant of a value of this age, at the last update; no age for a clock that is another one.
fn acquired(reader: &proprio_reader, age: Nanos) -> Result<i64, Unavailable> {
    match age < OTHER_CLOCK {
        true => Err(Unavailable::Stale { age }),
        false => Ok(reader.now.saturating_sub(age.0)),
    }
}

/// The handle with this number.
fn handle<H: Copy>(handles: &[H], number: u32) -> Result<H, Unavailable> {
    let handle = usize::try_from(number).ok().and_then(|n| handles.get(n));
    handle.copied().ok_or(Unavailable::Unknown)
}

/// The number of `handle` in `handles`, where it is put if it is new.
fn number<H: PartialEq>(handles: &mut Vec<H>, handle: H) -> u32 {
    let index = handles.iter().position(|known| *known == handle);
    let index = index.unwrap_or_else(|| {
        handles.push(handle);
        handles.len() - 1
    });
    u32::try_from(index).unwrap_or(u32::MAX)
}

/// The number of the handle that `handle` makes of a name of C; one that no handle has, if there is
/// no name or no reader.
///
/// # Safety
/// `reader` as for [`with`], `name` as for [`text`].
unsafe fn find(
    reader: *mut proprio_reader,
    name: *const c_char,
    handle: impl FnOnce(&mut proprio_reader, &str) -> u32,
) -> u32 {
    // SAFETY: the caller's promise.
    match unsafe { text(name) } {
        // SAFETY: the caller's promise.
        Some(name) => unsafe { with_mut(reader, u32::MAX, |reader| handle(reader, &name)) },
        None => u32::MAX,
    }
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
        if max_age < 0 {
            return Err(format!("max_age is {max_age} ns: it must not be negative"));
        }
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
            now: i64::MIN,
            process: std::process::id(),
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

/// Ends a reader. NULL is allowed. In a child of the process that made it, nothing happens.
///
/// # Safety
/// It comes from proprio_reader_new and is not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_reader_free(reader: *mut proprio_reader) {
    if !reader.is_null() {
        // SAFETY: the caller's promise.
        let reader = unsafe { Box::from_raw(reader) };
        if reader.process != std::process::id() {
            // After a fork: the ports are the parent's, which goes on reading from them.
            std::mem::forget(reader);
            return;
        }
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
    let handle = |reader: &mut proprio_reader, name: &str| {
        number(&mut reader.torques, reader.robot.torque_handle(name))
    };
    // SAFETY: the caller's promise.
    let number = unsafe { find(reader, name, handle) };
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
    let handle = |reader: &mut proprio_reader, name: &str| {
        number(&mut reader.contacts, reader.robot.contact_handle(name))
    };
    // SAFETY: the caller's promise.
    let number = unsafe { find(reader, name, handle) };
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
    let kind = Code::<Kind>::of_number(kind).get();
    let handle = |reader: &mut proprio_reader, name: &str| match kind {
        Some(kind) => {
            let handle = reader.robot.channel_handle(kind, name);
            number(&mut reader.channels, handle)
        }
        None => u32::MAX,
    };
    // SAFETY: the caller's promise.
    let number = unsafe { find(reader, name, handle) };
    proprio_channel_handle { number }
}

/// Takes what has arrived by `now` (proprio_now). Once in each cycle, before values are read. No
/// system call, no lock, no allocation. If `now` is of another clock, all is stale.
///
/// # Safety
/// `reader` is NULL or comes from proprio_reader_new and has not been freed: for all calls.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_update(reader: *mut proprio_reader, now: i64) {
    // SAFETY: the caller's promise.
    unsafe {
        with_mut(reader, (), |reader| {
            reader.now = now;
            reader.robot.update(Nanos(now));
        });
    }
}

/// Waits until an estimate may have arrived since the last update, at most until `deadline`
/// (proprio_now). Returns whether one may have. One system call. A signal does not end it.
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

/// The torque of a joint, as of the last update. `torque` and `why` may be NULL; both are
/// always written. For the cycle.
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
    unsafe { read(reader, torque, why, |found| found.age, get) }
}

/// The torques of `count` joints, as of the last update. For each joint in the order of `joints`:
/// its torque [Nm] (NaN if there is none), standard deviation [Nm] and status; and the instant that
/// they all refer to, CLOCK_MONOTONIC [ns] (0 if no torque has a value). Each array, and
/// `acquired`, may be NULL. Returns how many have a value. For the cycle.
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
    acquired: *mut i64,
) -> usize {
    let (mut available, mut instant) = (0, 0);
    for index in 0..count {
        let mut found = proprio_torque::from(Err(()));
        let mut status = PROPRIO_UNKNOWN;
        if !joints.is_null() {
            // SAFETY: the caller's promise.
            unsafe {
                let joint = *joints.wrapping_add(index);
                status = proprio_read_torque(reader, joint, &raw mut found, std::ptr::null_mut());
            }
        }
        if status == PROPRIO_OK {
            (available, instant) = (available + 1, found.acquired);
        }
        // SAFETY: the caller's promise.
        unsafe {
            give_at(found.torque, torques, index);
            give_at(found.standard_deviation, standard_deviations, index);
            give_at(status, statuses, index);
        }
    }
    // SAFETY: the caller's promise.
    unsafe { give(instant, acquired) };
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
    unsafe { read(reader, value, why, |found| found.age, get) }
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
    unsafe { read(reader, value, why, |found| found.age, get) }
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
    unsafe { read(reader, value, why, |found| found.age, get) }
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
    unsafe { read(reader, value, why, |found| found.age, get) }
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

/// `why` in words, as "withheld: saturated (l_arm_ft_sensor)", in `text` of `size` bytes; "there is
/// a value" if its status is PROPRIO_OK.
///
/// # Safety
/// `why` is NULL or may be read; `text` has room for `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn proprio_describe(
    why: *const proprio_unavailable,
    text: *mut c_char,
    size: usize,
) {
    if why.is_null() {
        return;
    }
    // As numbers: C may have any there, a variant of Rust may not.
    // SAFETY: the caller's promise; any bytes are numbers and names.
    let (status, because, age, channel) = unsafe {
        (
            (&raw const (*why).status).cast::<u32>().read(),
            (&raw const (*why).reason).cast::<u32>().read(),
            Nanos((&raw const (*why).age).read()),
            (&raw const (*why).channel).read(),
        )
    };
    let channel: Vec<u8> = (channel.iter().map(|c| *c as u8))
        .take_while(|byte| *byte != 0)
        .collect();
    let known = [
        (PROPRIO_NEVER_SEEN, Unavailable::NeverSeen),
        (PROPRIO_STALE, Unavailable::Stale { age }),
        (PROPRIO_NOT_DESCRIBED, Unavailable::NotDescribed),
        (PROPRIO_UNKNOWN, Unavailable::Unknown),
        (
            PROPRIO_WITHHELD,
            Unavailable::Withheld {
                reason: Code::<Reason>::of_number(because).get().unwrap_or_default(),
                channel: Name::new(&String::from_utf8_lossy(&channel)).unwrap_or(Name::EMPTY),
            },
        ),
    ];
    let words = match known.iter().find(|(known, _)| *known as u32 == status) {
        Some((_, because)) => because.to_string(),
        None if status == PROPRIO_OK as u32 => "there is a value".to_owned(),
        None => format!("unknown status {status}"),
    };
    // SAFETY: the caller's promise.
    unsafe { put_at(&words, text, size) };
}

/// The version of this library, as "0.1.0".
#[unsafe(no_mangle)]
pub extern "C" fn proprio_version() -> *const c_char {
    const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), "\0");
    VERSION.as_ptr().cast()
}
