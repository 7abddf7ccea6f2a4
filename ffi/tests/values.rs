//! C reads what Rust reads: each number in its place, each reason with its words.
// Calls as in C. Everywhere: texts end with a zero byte, the reader lives until its end, and what
// is passed to be written may be written, or is null.
#![allow(unsafe_code, clippy::undocumented_unsafe_blocks)]
#![allow(missing_docs, clippy::unwrap_used)]

#[path = "../../gateway/topics/tests/fakes/mod.rs"]
mod fakes;

use fakes::{Estimator, Gateway};
use proprio::*;
use proprio_topics::ipc::{Domain, DomainConfig, RobotReader, Unavailable, monotonic};
use proprio_topics::{Kind, Nanos, Quality};
use std::ffi::{CStr, CString, c_char};
use std::mem::MaybeUninit;
use std::ptr::{null, null_mut};

const MAX_AGE: Nanos = Nanos::from_millis(50);
/// Longer than anything here takes. Not a measure of speed.
const PATIENCE: Nanos = Nanos::from_millis(20_000);

fn text(text: &str) -> CString {
    CString::new(text).unwrap()
}

/// What is written at a name of C.
fn said(name: &[c_char]) -> String {
    let bytes: Vec<u8> = name.iter().map(|c| *c as u8).collect();
    let text = CStr::from_bytes_until_nul(&bytes).expect("a final zero");
    text.to_str().unwrap().to_owned()
}

/// A value of C, and the status and the words that came with it. NaN before it is written.
fn read<T, H>(
    reader: *const proprio_reader,
    handle: H,
    function: unsafe extern "C" fn(
        *const proprio_reader,
        H,
        *mut T,
        *mut proprio_unavailable,
    ) -> proprio_status,
) -> (T, proprio_status, String) {
    let (mut value, mut why) = (MaybeUninit::<T>::uninit(), MaybeUninit::uninit());
    let mut words = [0; 256];
    unsafe {
        let status = function(reader, handle, value.as_mut_ptr(), why.as_mut_ptr());
        assert_eq!(why.assume_init_ref().status, status);
        proprio_describe(why.as_ptr(), words.as_mut_ptr(), words.len());
        (value.assume_init(), status, said(&words))
    }
}

#[test]
fn c_reads_what_rust_reads() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    let mut rust = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let reader = unsafe {
        let (robot, base, domain) = (
            text("icub"),
            text(base.path().to_str().unwrap()),
            text("test"),
        );
        let [robot, base, domain] = [&robot, &base, &domain].map(|text| text.as_ptr());
        proprio_reader_new(robot, MAX_AGE.0, base, domain, null_mut(), 0)
    };
    let torque = |name| unsafe { proprio_find_torque(reader, text(name).as_ptr()) };
    let (elbow, wrist, nobody) = (torque("elbow"), torque("wrist"), torque("nobody"));
    assert_eq!(
        torque("elbow").number,
        elbow.number,
        "a name has one handle"
    );
    let hand = unsafe { proprio_find_contact(reader, text("hand").as_ptr()) };
    let channel = |kind, name| unsafe { proprio_find_channel(reader, kind, text(name).as_ptr()) };
    let encoder = channel(PROPRIO_KIND_JOINT, "elbow");
    let ft = channel(PROPRIO_KIND_WRENCH, "ft");
    let chest = channel(PROPRIO_KIND_IMU, "chest");
    let rust_elbow = rust.torque_handle("elbow");
    let rust_hand = rust.contact_handle("hand");
    let rust_encoder = rust.channel_handle(Kind::Joint, "elbow");
    let rust_ft = rust.channel_handle(Kind::Wrench, "ft");
    let rust_imu = rust.channel_handle(Kind::Imu, "chest");

    let (value, status, words) = read(reader, elbow, proprio_read_torque);
    assert!(value.torque.is_nan() && value.standard_deviation.is_nan());
    assert_eq!(
        (status, words.as_str()),
        (proprio_status::PROPRIO_NEVER_SEEN, "never seen")
    );
    assert!(!unsafe { proprio_wait_for_estimate(reader, proprio_now() + 1_000_000) });

    let domain = Domain::open(&config).unwrap();
    let mut estimator = Estimator::start(&domain, 1, ["elbow", "wrist"]);
    let mut gateway = Gateway::start(&domain, 2, 5);
    let (mut t, end) = (Nanos::ZERO, monotonic() + PATIENCE);
    loop {
        t = monotonic().max(t);
        estimator.send(t, [1.5, 2.5]);
        gateway.send(t, 5, Quality::GAP_BEFORE);
        rust.update(t + Nanos(1000));
        unsafe { proprio_update(reader, t.0 + 1000) };
        let all_of_c = [
            read(reader, elbow, proprio_read_torque).1,
            read(reader, hand, proprio_read_contact).1,
            read(reader, encoder, proprio_read_joint).1,
            read(reader, ft, proprio_read_wrench).1,
            read(reader, chest, proprio_read_imu).1,
        ];
        if all_of_c == [proprio_status::PROPRIO_OK; 5]
            && rust.torque(rust_elbow).is_ok()
            && rust.imu(rust_imu).is_ok()
            && rust.contact(rust_hand).is_ok()
            && rust.who_is_missing().is_nobody()
            && unsafe { proprio_who_is_missing(reader, null_mut()) }
        {
            break;
        }
        assert!(monotonic() < end, "the first values: {all_of_c:?}");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }

    let (c, r) = (
        read(reader, elbow, proprio_read_torque).0,
        rust.torque(rust_elbow).unwrap(),
    );
    assert_eq!(
        (c.torque, c.standard_deviation, c.age),
        (r.torque, r.standard_deviation, 1000)
    );
    let (c, r) = (
        read(reader, hand, proprio_read_contact).0,
        rust.contact(rust_hand).unwrap(),
    );
    assert_eq!((c.force, c.torque), (r.wrench.force, r.wrench.torque));
    assert_eq!(
        (c.standard_deviation, c.position),
        (r.standard_deviation, r.position)
    );
    assert_eq!((c.is_detected, c.is_located, c.age), (true, true, r.age.0));
    let (c, r) = (
        read(reader, encoder, proprio_read_joint).0,
        rust.joint(rust_encoder).unwrap(),
    );
    assert_eq!(
        (c.position, c.velocity),
        (r.value.position, r.value.velocity)
    );
    assert_eq!(
        (c.acceleration, c.torque),
        (r.value.acceleration, r.value.torque)
    );
    assert!(c.current.is_nan());
    assert_eq!((c.age, c.quality), (1000, PROPRIO_QUALITY_GAP_BEFORE));
    let (c, r) = (
        read(reader, ft, proprio_read_wrench).0,
        rust.wrench(rust_ft).unwrap(),
    );
    assert_eq!((c.force, c.torque), (r.value.force, r.value.torque));
    assert_eq!((c.age, c.quality), (r.age.0, r.quality.0));
    let (c, r) = (
        read(reader, chest, proprio_read_imu).0,
        rust.imu(rust_imu).unwrap(),
    );
    assert_eq!(c.proper_acceleration, r.value.proper_acceleration);
    assert_eq!(c.angular_velocity, r.value.angular_velocity);
    assert_eq!(c.angular_acceleration, r.value.angular_acceleration);
    assert_eq!(c.magnetic_field, r.value.magnetic_field);
    assert_eq!(c.orientation, r.value.orientation);
    assert_eq!((c.age, c.quality), (r.age.0, r.quality.0));

    let acquired = [
        read(reader, elbow, proprio_read_torque).0.acquired,
        read(reader, hand, proprio_read_contact).0.acquired,
        read(reader, encoder, proprio_read_joint).0.acquired,
        read(reader, ft, proprio_read_wrench).0.acquired,
        read(reader, chest, proprio_read_imu).0.acquired,
    ];
    assert_eq!(acquired, [t.0; 5], "whenever it is asked");

    // Reasons: a withheld torque, a name that nobody has, a channel read as another kind.
    let mut why = MaybeUninit::uninit();
    let status = unsafe { proprio_read_torque(reader, wrist, null_mut(), why.as_mut_ptr()) };
    let why = unsafe { why.assume_init() };
    assert_eq!(status, proprio_status::PROPRIO_WITHHELD);
    assert_eq!(why.reason, proprio_reason::PROPRIO_REASON_STALE);
    assert_eq!(said(&why.channel), "ft");
    assert_eq!(
        read(reader, wrist, proprio_read_torque).2,
        "withheld: stale (ft)"
    );
    assert_eq!(read(reader, nobody, proprio_read_torque).2, "unknown name");
    assert_eq!(read(reader, encoder, proprio_read_wrench).2, "unknown name");

    // All in one call, in the caller's order.
    let joints = [wrist, elbow, nobody];
    let (mut torques, mut deviations) = ([0.0; 3], [0.0; 3]);
    let (mut statuses, mut instant) = ([proprio_status::PROPRIO_OK; 3], 0);
    let count = unsafe {
        let (torques, deviations) = (torques.as_mut_ptr(), deviations.as_mut_ptr());
        proprio_read_torques(
            reader,
            joints.as_ptr(),
            3,
            torques,
            deviations,
            statuses.as_mut_ptr(),
            &raw mut instant,
        )
    };
    assert_eq!((count, torques[1], deviations[1]), (1, 1.5, 0.1));
    assert_eq!(instant, t.0, "the instant that all refer to");
    assert!(torques[0].is_nan() && torques[2].is_nan() && deviations[0].is_nan());
    let expected = [
        proprio_status::PROPRIO_WITHHELD,
        proprio_status::PROPRIO_OK,
        proprio_status::PROPRIO_UNKNOWN,
    ];
    assert_eq!(statuses, expected);
    let only_count = unsafe {
        proprio_read_torques(
            reader,
            joints.as_ptr(),
            3,
            null_mut(),
            null_mut(),
            null_mut(),
            null_mut(),
        )
    };
    assert_eq!(only_count, 1);

    // Names.
    let (mut name, mut kind) = ([0; PROPRIO_NAME_SIZE], u32::MAX);
    unsafe {
        assert!(proprio_torque_name(reader, 1, name.as_mut_ptr()) && said(&name) == "wrist");
        assert!(!proprio_torque_name(reader, 2, name.as_mut_ptr()));
        assert!(proprio_contact_name(reader, 0, name.as_mut_ptr()) && said(&name) == "hand");
        assert!(proprio_channel_name(
            reader,
            2,
            name.as_mut_ptr(),
            &raw mut kind
        ));
        assert_eq!((said(&name).as_str(), kind), ("chest", PROPRIO_KIND_IMU));
        assert!(!proprio_channel_name(
            reader,
            3,
            name.as_mut_ptr(),
            &raw mut kind
        ));
    }

    // An estimate that arrives wakes; an old one is stale, and says how old.
    unsafe { proprio_update(reader, t.0) };
    estimator.send(t - MAX_AGE, [1.5, 2.5]);
    assert!(unsafe { proprio_wait_for_estimate(reader, proprio_now() + PATIENCE.0) });
    gateway.send(t, 5, Quality::SATURATED);
    assert!(unsafe { proprio_wait_for_sample(reader, proprio_now() + PATIENCE.0) });
    rust.update(t + Nanos(1));
    unsafe { proprio_update(reader, t.0 + 1) };
    let age = MAX_AGE + Nanos(1);
    assert_eq!(rust.torque(rust_elbow), Err(Unavailable::Stale { age }));
    assert_eq!(
        read(reader, elbow, proprio_read_torque).2,
        "stale: 0.050 s old"
    );
    assert_eq!(
        read(reader, ft, proprio_read_wrench).2,
        "withheld: saturated (ft)"
    );
    assert!(read(reader, ft, proprio_read_wrench).0.force[0].is_nan());

    // A clock that counts something else makes nothing young.
    unsafe { proprio_update(reader, t.0 / 1000) };
    assert_eq!(
        read(reader, elbow, proprio_read_torque).1,
        proprio_status::PROPRIO_STALE
    );

    // Who ends is missed.
    drop(estimator);
    let mut missing = MaybeUninit::uninit();
    while unsafe { proprio_who_is_missing(reader, missing.as_mut_ptr()) } {
        assert!(monotonic() < end, "the end is not seen");
        gateway.send(monotonic(), 5, Quality::GOOD);
    }
    let missing = unsafe { missing.assume_init() };
    assert_eq!(missing.estimator, proprio_presence::PROPRIO_ENDED);
    assert!(!missing.is_nobody && said(&missing.text).contains("the estimator has ended"));
    unsafe { proprio_reader_free(reader) };
}

#[test]
fn a_null_pointer_is_an_answer() {
    unsafe {
        let (mut message, mut torques) = ([0; 12], [1.0; 2]);
        let reader = proprio_reader_new(
            null(),
            0,
            null(),
            null(),
            message.as_mut_ptr(),
            message.len(),
        );
        assert!(reader.is_null());
        assert_eq!(
            said(&message),
            "the robot's",
            "as much as there is room for"
        );
        assert!(proprio_reader_new(null(), 0, null(), null(), null_mut(), 0).is_null());
        let joint = proprio_find_torque(null_mut(), text("elbow").as_ptr());
        assert_eq!(
            read(null(), joint, proprio_read_torque).1,
            proprio_status::PROPRIO_UNKNOWN
        );
        let channel = proprio_find_channel(null_mut(), 99, null());
        assert_eq!(
            read(null(), channel, proprio_read_imu).1,
            proprio_status::PROPRIO_UNKNOWN
        );
        let contact = proprio_find_contact(null_mut(), null());
        assert_eq!(
            read(null(), contact, proprio_read_contact).1,
            proprio_status::PROPRIO_UNKNOWN
        );
        assert_eq!(
            proprio_read_torques(
                null(),
                null(),
                2,
                torques.as_mut_ptr(),
                null_mut(),
                null_mut(),
                null_mut(),
            ),
            0
        );
        assert!(
            torques.iter().all(|torque| torque.is_nan()),
            "none stays as it was"
        );
        proprio_update(null_mut(), 0);
        assert!(!proprio_wait_for_estimate(null(), 0) && !proprio_wait_for_sample(null(), 0));
        assert!(!proprio_torque_name(null(), 0, null_mut()));
        assert!(!proprio_who_is_missing(null(), null_mut()));
        proprio_describe(null(), null_mut(), 0);
        // What was never written is no reason, and no end of the program.
        let why = [0xff_u8; size_of::<proprio_unavailable>()];
        let mut words = [0; 64];
        proprio_describe(why.as_ptr().cast(), words.as_mut_ptr(), words.len());
        assert_eq!(said(&words), "unknown status 4294967295");
        let robot = text("icub");
        let (size, at) = (message.len(), message.as_mut_ptr());
        assert!(proprio_reader_new(robot.as_ptr(), -1, null(), null(), at, size).is_null());
        assert_eq!(said(&message), "max_age is ");
        let version = CStr::from_ptr(proprio_version()).to_str();
        assert_eq!(version, Ok(env!("CARGO_PKG_VERSION")));
        proprio_reader_free(null_mut());

        let reader = proprio_reader_new(text("icub").as_ptr(), 0, null(), null(), null_mut(), 0);
        let joint = proprio_find_torque(reader, null());
        assert_eq!(
            read(reader, joint, proprio_read_torque).1,
            proprio_status::PROPRIO_UNKNOWN
        );
        let channel = proprio_find_channel(reader, 99, text("elbow").as_ptr());
        assert_eq!(
            read(reader, channel, proprio_read_joint).1,
            proprio_status::PROPRIO_UNKNOWN
        );
        proprio_reader_free(reader);
    }
}
