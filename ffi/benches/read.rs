//! What the C interface costs more than Rust's: `cargo bench -p proprio-ffi`.
#![allow(unsafe_code)] // C's pointers

use divan::{Bencher, black_box};
use proprio::{
    proprio_find_torque, proprio_read_torque, proprio_read_torques, proprio_reader,
    proprio_reader_free, proprio_reader_new, proprio_status, proprio_torque, proprio_torque_handle,
    proprio_unavailable, proprio_update,
};
use proprio_topics::ipc::{Domain, DomainConfig, RobotReader, Writer, monotonic};
use proprio_topics::{
    Description, Entry, Header, JointTorque, Kind, MAX_JOINTS, Name, Nanos, Publisher, Reason,
    Role, TorqueEstimate,
};
use std::ffi::CString;
use std::ptr;

/// Calls in one measurement.
const CALLS: u32 = 1000;
const JOINTS: u32 = 7;

/// An estimator, which is this process, with seven valid torques.
struct Estimator {
    _base: tempfile::TempDir,
    config: DomainConfig,
    torques: Writer<TorqueEstimate>,
    descriptions: Writer<Description>,
}

fn name(number: u32) -> String {
    format!("joint_{number}")
}

impl Estimator {
    fn new() -> Self {
        let base = tempfile::tempdir().unwrap();
        let config = DomainConfig::new(base.path(), "bench");
        let domain = Domain::open(&config).unwrap();
        let mut descriptions = Writer::create(&domain, "r", domain.epoch()).unwrap();
        let entries = (0..JOINTS).map(|number| Entry {
            name: Name::new(&name(number)).unwrap(),
            role: Role::Joint.in_memory(),
            kind: Kind::Joint.in_memory(),
            index: number,
            ..Entry::NONE
        });
        let description = Description::new(Publisher::Estimator, entries);
        descriptions.send(&description, monotonic()).unwrap();
        Self {
            torques: Writer::create(&domain, "r", domain.epoch()).unwrap(),
            _base: base,
            config,
            descriptions,
        }
    }

    fn send(&mut self, at: Nanos) {
        let valid = JointTorque {
            torque: 1.5,
            standard_deviation: 0.1,
            valid: 1,
            reason: Reason::None.in_memory(),
            ..JointTorque::ABSENT
        };
        let estimate = TorqueEstimate {
            header: Header {
                acquired: at,
                ..Header::default()
            },
            count: JOINTS,
            reserved: 0,
            joints: [valid; MAX_JOINTS],
        };
        self.torques.send(&estimate, monotonic()).unwrap();
        // A reader that came late has the names too.
        self.descriptions.update_connections().unwrap();
    }
}

/// A C reader that has an estimate, and the handles of all joints.
fn in_c(estimator: &mut Estimator) -> (*mut proprio_reader, Vec<proprio_torque_handle>) {
    let text = |text: &str| CString::new(text).unwrap();
    let (robot, base) = (text("r"), text(estimator.config.base.to_str().unwrap()));
    let domain = text(&estimator.config.name);
    // SAFETY: these texts live across the calls, the reader until the end.
    unsafe {
        let (base, domain) = (base.as_ptr(), domain.as_ptr());
        let reader = proprio_reader_new(robot.as_ptr(), i64::MAX, base, domain, ptr::null_mut(), 0);
        let joints: Vec<_> = (0..JOINTS)
            .map(|number| proprio_find_torque(reader, text(&name(number)).as_ptr()))
            .collect();
        let mut value = proprio_torque {
            torque: 0.0,
            standard_deviation: 0.0,
            acquired: 0,
            age: 0,
        };
        while proprio_read_torque(reader, joints[0], &raw mut value, ptr::null_mut())
            != proprio_status::PROPRIO_OK
        {
            estimator.send(monotonic());
            proprio_update(reader, monotonic().0);
        }
        (reader, joints)
    }
}

#[divan::bench(sample_count = 500)]
fn torque_in_rust(bencher: Bencher<'_, '_>) {
    let mut estimator = Estimator::new();
    let mut reader = RobotReader::new(&estimator.config, "r", Nanos::MAX).unwrap();
    let joint = reader.torque_handle(&name(3));
    while reader.torque(joint).is_err() {
        estimator.send(monotonic());
        reader.update(monotonic());
    }
    bencher.counter(CALLS).bench_local(|| {
        for _ in 0..CALLS {
            assert!(black_box(&reader).torque(black_box(joint)).is_ok());
        }
    });
}

#[divan::bench(sample_count = 500)]
fn torque_in_c(bencher: Bencher<'_, '_>) {
    let mut estimator = Estimator::new();
    let (reader, joints) = in_c(&mut estimator);
    let read = black_box(
        proprio_read_torque
            as unsafe extern "C" fn(
                *const proprio_reader,
                proprio_torque_handle,
                *mut proprio_torque,
                *mut proprio_unavailable,
            ) -> proprio_status,
    );
    let mut value = proprio_torque {
        torque: 0.0,
        standard_deviation: 0.0,
        acquired: 0,
        age: 0,
    };
    bencher.counter(CALLS).bench_local(|| {
        for _ in 0..CALLS {
            // SAFETY: the reader lives, the value may be written.
            let status = unsafe {
                read(
                    black_box(reader),
                    black_box(joints[3]),
                    &raw mut value,
                    ptr::null_mut(),
                )
            };
            assert_eq!(status, proprio_status::PROPRIO_OK);
            black_box(value);
        }
    });
    // SAFETY: not used again.
    unsafe { proprio_reader_free(reader) };
}

/// All seven torques in one call.
#[divan::bench(sample_count = 500)]
fn seven_torques_in_c(bencher: Bencher<'_, '_>) {
    let mut estimator = Estimator::new();
    let (reader, joints) = in_c(&mut estimator);
    let (mut torques, mut deviations) = ([0.0; JOINTS as usize], [0.0; JOINTS as usize]);
    bencher.counter(CALLS).bench_local(|| {
        for _ in 0..CALLS {
            // SAFETY: the reader lives, the arrays have as many elements as there are handles.
            let available = unsafe {
                proprio_read_torques(
                    black_box(reader),
                    joints.as_ptr(),
                    joints.len(),
                    torques.as_mut_ptr(),
                    deviations.as_mut_ptr(),
                    ptr::null_mut(),
                    ptr::null_mut(),
                )
            };
            assert_eq!(available, joints.len());
            black_box((&torques, &deviations));
        }
    });
    // SAFETY: not used again.
    unsafe { proprio_reader_free(reader) };
}

fn main() {
    divan::main();
}
