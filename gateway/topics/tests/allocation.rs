//! Sending and taking allocate nothing, except one allocation of 48 bytes per payload sent in
//! iceoryx2's loan.
// A global allocator needs unsafe code.
#![allow(missing_docs, unsafe_code, clippy::unwrap_used)]

use proprio_topics::ipc::{
    Domain, DomainConfig, Reader, RobotReader, Topic as _, Writer, monotonic,
};
use proprio_topics::{
    Description, Entry, Header, JointState, JointTorque, MAX_JOINTS, Name, Nanos, Publisher,
    Reading, Reason, Role, Sample, TorqueEstimate,
};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static COUNTED: Cell<(usize, usize)> = const { Cell::new((0, 0)) };
}

struct Counting;

// SAFETY: every call is passed on unchanged to the system's allocator, which upholds the contract;
// counting uses a thread-local that is initialised at compile time, has no destructor and does not
// allocate.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = COUNTED.try_with(|c| c.set((c.get().0 + 1, c.get().1 + layout.size())));
        // SAFETY: the caller upholds `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds `dealloc`'s contract; the pointer came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations and bytes of this thread during `run`.
fn counted(run: impl FnOnce()) -> (usize, usize) {
    let before = COUNTED.get();
    run();
    let after = COUNTED.get();
    (after.0 - before.0, after.1 - before.1)
}

#[test]
fn only_iceoryx2s_loan_allocates() {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "test")).unwrap();
    assert_ne!(
        counted(|| drop(std::hint::black_box(vec![0_u8; 8]))).0,
        0,
        "the counter counts"
    );

    let mut writer = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    let sample = Sample::new(Header::default(), 0, &Reading::Joint(JointState::ABSENT));
    writer.send(&sample, Nanos(0)).unwrap();
    reader.latest().unwrap().unwrap();

    const N: usize = 5000; // more than the buffer: overflow included
    let (count, bytes) = counted(|| {
        (0..N).for_each(|_| assert_eq!(writer.send(&sample, Nanos(0)).unwrap().readers, 1));
    });
    assert_eq!((count, bytes), (N, 48 * N), "iceoryx2's loan only");
    assert_eq!(
        counted(|| assert_eq!(writer.update_connections(), Ok(0))),
        (0, 0)
    );
    assert_eq!(
        counted(|| while reader.try_take().unwrap().is_some() {}),
        (0, 0)
    );
    assert_eq!(reader.taken(), 1 + Sample::QUALITY.buffer as u64);

    let mut estimates = Writer::<TorqueEstimate>::create(&domain, "icub", 1).unwrap();
    let mut names = Writer::<Description>::create(&domain, "icub", 1).unwrap();
    let entry = Entry {
        name: Name::new("elbow").unwrap(),
        role: Role::Joint.in_memory(),
        ..Entry::NONE
    };
    names
        .send(&Description::new(Publisher::Estimator, [entry]), Nanos(0))
        .unwrap();
    let mut robot = RobotReader::new(domain.config(), "icub", Nanos::from_millis(50)).unwrap();
    let elbow = robot.torque_handle("elbow");
    let joint = JointTorque {
        torque: 1.0,
        valid: 1,
        reason: Reason::None.in_memory(),
        ..JointTorque::ABSENT
    };
    let mut estimate = TorqueEstimate {
        header: Header::default(),
        count: 1,
        reserved: 0,
        joints: [joint; MAX_JOINTS],
    };
    // Until the reader's thread has opened the ports.
    while robot.torque(elbow).is_err() {
        names.update_connections().unwrap();
        estimate.header.acquired = monotonic();
        estimates.send(&estimate, Nanos(0)).unwrap();
        robot.update(monotonic());
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    let counted = counted(|| {
        for _ in 0..1000 {
            let now = monotonic();
            estimate.header.acquired = now;
            estimates.send(&estimate, now).unwrap();
            robot.update(now);
            assert_eq!(robot.torque(elbow).unwrap().torque, 1.0);
        }
    });
    assert_eq!(counted, (1000, 48_000), "iceoryx2's loan only");
}
