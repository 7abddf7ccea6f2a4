//! What a publication and a reader's cycle cost, each beside iceoryx2 alone:
//! `cargo bench -p proprio-topics --features ipc`.

use divan::Bencher;
use iceoryx2::prelude::*;
use proprio_topics::ipc::{Domain, DomainConfig, Reader, RobotReader, Writer, monotonic};
use proprio_topics::{
    Description, Header, JointState, JointTorque, MAX_JOINTS, Nanos, Reading, Sample,
    TorqueEstimate,
};
use std::cell::RefCell;

/// Calls in one measurement.
const CALLS: u32 = 100;

fn sample() -> Sample {
    Sample::new(Header::default(), 0, &Reading::Joint(JointState::ABSENT))
}

fn estimate() -> TorqueEstimate {
    TorqueEstimate {
        header: Header::default(),
        count: 7,
        reserved: 0,
        joints: [JointTorque::ABSENT; MAX_JOINTS],
    }
}

/// A sample through a [`Writer`], with a reader that takes all of them.
#[divan::bench(sample_count = 200)]
fn send_and_take(bencher: Bencher<'_, '_>) {
    let base = tempfile::tempdir().unwrap();
    let domain = Domain::open(&DomainConfig::new(base.path(), "bench")).unwrap();
    let mut writer = Writer::<Sample>::create(&domain, "r", domain.epoch()).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "r").unwrap();
    let sample = sample();
    bencher.counter(CALLS).bench_local(|| {
        for _ in 0..CALLS {
            writer.send(&sample, Nanos::ZERO).unwrap();
            assert!(reader.try_take().unwrap().is_some());
        }
    });
}

/// The same with iceoryx2 alone.
#[divan::bench(sample_count = 200)]
fn send_and_take_bare(bencher: Bencher<'_, '_>) {
    let node = NodeBuilder::new().create::<ipc::Service>().unwrap();
    let name = format!("proprio/bench/{}", std::process::id());
    let service = node
        .service_builder(&name.as_str().try_into().unwrap())
        .publish_subscribe::<Sample>()
        .open_or_create()
        .unwrap();
    let publisher = service.publisher_builder().create().unwrap();
    let subscriber = service.subscriber_builder().create().unwrap();
    let sample = sample();
    bencher.counter(CALLS).bench_local(|| {
        for _ in 0..CALLS {
            publisher.send_copy(sample).unwrap();
            let taken = *subscriber.receive().unwrap().unwrap();
            assert_eq!(taken.channel, sample.channel);
        }
    });
}

/// A robot whose estimator is this process, and a reader that has attached to it.
fn robot() -> (tempfile::TempDir, Writer<TorqueEstimate>, RobotReader) {
    let base = tempfile::tempdir().unwrap();
    let config = DomainConfig::new(base.path(), "bench");
    let domain = Domain::open(&config).unwrap();
    let mut descriptions = Writer::<Description>::create(&domain, "r", domain.epoch()).unwrap();
    let mut torques = Writer::<TorqueEstimate>::create(&domain, "r", domain.epoch()).unwrap();
    let description = Description::new(proprio_topics::Publisher::Estimator, []);
    descriptions.send(&description, monotonic()).unwrap();
    let mut reader = RobotReader::new(&config, "r", Nanos::from_millis(100)).unwrap();
    while reader.torques().is_none() {
        torques.send(&estimate(), monotonic()).unwrap();
        reader.update(monotonic());
    }
    (base, torques, reader)
}

/// A cycle of a control loop in which nothing new has come.
#[divan::bench(sample_count = 200)]
fn cycle_with_nothing_new(bencher: Bencher<'_, '_>) {
    let (_base, _torques, mut reader) = robot();
    bencher.counter(CALLS).bench_local(|| {
        for _ in 0..CALLS {
            reader.update(Nanos(1));
        }
    });
}

/// A cycle that takes a new estimate and reads one torque; publishing is not counted.
#[divan::bench(sample_count = 2000)]
fn cycle_with_an_estimate(bencher: Bencher<'_, '_>) {
    let (_base, torques, mut reader) = robot();
    let joint = reader.torque_handle("elbow");
    let torques = RefCell::new(torques);
    bencher
        .with_inputs(|| torques.borrow_mut().send(&estimate(), monotonic()).unwrap())
        .bench_local_values(|_| {
            reader.update(Nanos(1));
            reader.torque(joint).is_err()
        });
}

fn main() {
    divan::main();
}
