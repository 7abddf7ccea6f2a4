//! Ports within one process: order, overflow, loss, late readers, isolation, versions, limits, and
//! error messages.
#![allow(missing_docs, clippy::unwrap_used)]

use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use proprio_topics::ipc::{
    Domain, DomainConfig, DomainError, Freshness, PortError, QualityOfService, Reader, Topic,
    Writer,
};
use proprio_topics::{
    Code, ContactDeclaration, ContactState, Description, Entry, EstimatorHealth, GatewayHealth,
    Header, InertiaEstimate, JointState, JointTorque, Kind, LinkInertia, MAX_CHANNELS, MAX_JOINTS,
    Name, Nanos, Publisher, Reading, Role, Sample, TorqueEstimate,
};
use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;
use zerocopy::FromBytes;

fn place() -> (tempfile::TempDir, DomainConfig) {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    (base, config)
}

fn sample(channel: u32) -> Sample {
    let joint = JointState {
        position: f64::from(channel),
        velocity: 1.0,
        acceleration: 2.0,
        torque: 3.0,
        current: 4.0,
    };
    Sample::new(Header::default(), channel, &Reading::Joint(joint))
}

fn description(publisher: Publisher, entries: &[(&str, Role, u32)]) -> Description {
    let none = Entry {
        name: Name::EMPTY,
        origin: Name::EMPTY,
        max_silence: Nanos::ZERO,
        role: Role::Channel.in_memory(),
        index: 0,
        kind: Kind::Joint.in_memory(),
        bus: 0,
    };
    let mut d = Description {
        header: Header::default(),
        publisher: publisher.in_memory(),
        count: entries.len() as u32,
        entries: [none; Description::CAPACITY],
    };
    for (entry, &(name, role, index)) in d.entries.iter_mut().zip(entries) {
        *entry = Entry {
            name: Name::new(name).unwrap(),
            role: role.in_memory(),
            index,
            ..none
        };
    }
    d
}

fn is_empty(dir: &Path) -> bool {
    std::fs::read_dir(dir).unwrap().next().is_none()
}

#[test]
fn what_is_sent_arrives_in_order_and_nothing_remains() {
    let (base, config) = place();
    let prefix;
    {
        let domain = Domain::open(&config).unwrap();
        let mut writer = Writer::<Sample>::create(&domain, "icub", 7).unwrap();
        let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
        for channel in 0..100 {
            let sent = writer.send(&sample(channel), Nanos(5)).unwrap();
            assert_eq!((sent.sequence, sent.readers), (u64::from(channel), 1));
            assert_eq!(sent.connected, usize::from(channel == 0));
        }
        for channel in 0..100 {
            let got = reader.try_take().unwrap().unwrap();
            assert_eq!(
                (got.channel, got.header.sequence),
                (channel, u64::from(channel))
            );
            assert_eq!((got.header.epoch, got.header.published), (7, Nanos(5)));
            assert_eq!(got.values, sample(channel).values);
        }
        assert_eq!(reader.try_take().unwrap(), None);
        assert_eq!(
            (reader.lost(), reader.taken(), reader.epochs()),
            (0, 100, 1)
        );
        prefix = our_segments(&config);
        assert!(!prefix.is_empty());
    }
    assert!(is_empty(base.path()), "files remain");
    for segment in prefix {
        assert!(
            !Path::new("/dev/shm").join(&segment).exists(),
            "{segment} remains"
        );
    }
}

/// The segments of a domain, by the prefix that its node files show.
fn our_segments(config: &DomainConfig) -> Vec<String> {
    let nodes = config.base.join(&config.name).join("nodes");
    let prefix = std::fs::read_dir(nodes)
        .unwrap()
        .filter_map(|e| e.unwrap().file_name().into_string().ok())
        .find_map(|n| {
            n.strip_prefix("proprio_")
                .and_then(|n| n.split_once('_').map(|(hash, _)| hash.to_owned()))
        })
        .unwrap();
    std::fs::read_dir("/dev/shm")
        .unwrap()
        .filter_map(|e| e.unwrap().file_name().into_string().ok())
        .filter(|n| n.contains(&prefix))
        .collect()
}

#[test]
fn overflow_keeps_the_newest_and_the_writer_never_waits() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut writer = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    let buffer = Sample::QUALITY.buffer as u64;
    let sent = 3 * buffer + 17;
    for k in 0..sent {
        assert_eq!(writer.send(&sample(k as u32), Nanos(0)).unwrap().readers, 1);
    }
    for k in sent - buffer..sent {
        assert_eq!(reader.try_take().unwrap().unwrap().header.sequence, k);
    }
    assert_eq!(reader.try_take().unwrap(), None);
    // The reader joined after the writer began, so the first sequence number seen is no loss ...
    assert_eq!(reader.lost(), 0);
    // ... but a later gap is.
    for k in 0..buffer + 5 {
        writer.send(&sample(k as u32), Nanos(0)).unwrap();
    }
    assert_eq!(
        reader.latest().unwrap().unwrap().header.sequence,
        sent + buffer + 4
    );
    assert_eq!(reader.lost(), 5);
}

#[test]
fn a_reader_older_than_the_writer_counts_from_its_first_payload() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let first = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    drop(first);
    let mut writer = Writer::<Sample>::create(&domain, "icub", 2).unwrap();
    for k in 0..Sample::QUALITY.buffer as u32 + 9 {
        writer.send(&sample(k), Nanos(0)).unwrap();
    }
    while reader.try_take().unwrap().is_some() {}
    assert_eq!((reader.lost(), reader.epochs()), (9, 1));
}

#[test]
fn sixteen_buses_are_counted_apart_and_a_seventeenth_is_refused() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let epoch = domain.epoch();
    let mut writers: Vec<_> = (0..16)
        .map(|_| Writer::<Sample>::create(&domain, "icub", epoch).unwrap())
        .collect();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    for turn in 0..50 {
        for (bus, writer) in writers.iter_mut().enumerate() {
            let mut s = sample(turn);
            s.header.bus = bus as u32;
            writer.send(&s, Nanos(0)).unwrap();
        }
    }
    let mut taken = [0; 16];
    while let Some(s) = reader.try_take().unwrap() {
        assert_eq!(s.header.sequence, taken[s.header.bus as usize]);
        taken[s.header.bus as usize] += 1;
    }
    assert_eq!(taken, [50; 16]);
    assert_eq!(
        (reader.lost(), reader.epochs(), reader.writers()),
        (0, 1, 16)
    );
    match Writer::<Sample>::create(&domain, "icub", epoch) {
        Err(PortError::Taken {
            most: 16, holder, ..
        }) => assert_eq!(holder, std::process::id() as i32),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_late_reader_gets_the_last_description_of_each_publisher() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut gateway = Writer::<Description>::create(&domain, "icub", 1).unwrap();
    let mut estimator = Writer::<Description>::create(&domain, "icub", 2).unwrap();
    gateway
        .send(
            &description(Publisher::Gateway, &[("old", Role::Channel, 0)]),
            Nanos(0),
        )
        .unwrap();
    gateway
        .send(
            &description(Publisher::Gateway, &[("imu", Role::Channel, 0)]),
            Nanos(0),
        )
        .unwrap();
    estimator
        .send(
            &description(Publisher::Estimator, &[("l_elbow", Role::Joint, 0)]),
            Nanos(0),
        )
        .unwrap();

    let mut reader = Reader::<Description>::open(&domain, "icub").unwrap();
    assert!(
        reader.try_take().unwrap().is_none(),
        "the history arrives with the writer's next turn"
    );
    assert_eq!(gateway.update_connections().unwrap(), 1);
    assert_eq!(estimator.update_connections().unwrap(), 1);
    assert_eq!(gateway.update_connections().unwrap(), 0);
    let mut names = Vec::new();
    while let Some(d) = reader.try_take().unwrap() {
        names.push((d.publisher.number(), d.entries()[0].name.to_string()));
    }
    names.sort();
    assert_eq!(names, [(0, "imu".to_owned()), (1, "l_elbow".to_owned())]);
    assert_eq!(reader.lost(), 0);
}

/// Whoever waits for what was sent before it came is woken when it gets it.
#[test]
fn a_late_reader_that_waits_is_woken_for_the_history() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut writer = Writer::<Description>::create(&domain, "icub", 1).unwrap();
    let sent = description(Publisher::Gateway, &[("elbow", Role::Channel, 0)]);
    writer.send(&sent, Nanos(1)).unwrap();
    let mut reader = Reader::<Description>::open(&domain, "icub").unwrap();
    assert!(reader.try_take().unwrap().is_none());
    assert!(!reader.wait(Nanos::ZERO));
    assert_eq!(writer.update_connections(), Ok(1));
    assert!(reader.wait(Nanos::ZERO));
    assert!(reader.try_take().unwrap().is_some());
}

#[test]
fn a_reader_before_the_writer_is_told_so_and_then_works() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    assert!(matches!(
        Reader::<GatewayHealth>::open(&domain, "icub"),
        Err(PortError::NotYet { service }) if service == "icub/health/gateway"
    ));
    let mut attempts = 0;
    let none = Reader::<Sample>::wait_open(&domain, "icub", |n| {
        attempts = n;
        n < 3
    });
    assert!(matches!(none, Err(PortError::NotYet { .. })));
    assert_eq!(attempts, 3);

    let mut writer = None;
    let mut reader = Reader::<Sample>::wait_open(&domain, "icub", |_| {
        writer = Some(Writer::<Sample>::create(&domain, "icub", 1).unwrap());
        true
    })
    .unwrap();
    writer.as_mut().unwrap().send(&sample(3), Nanos(0)).unwrap();
    assert_eq!(reader.latest().unwrap().unwrap().channel, 3);
    drop(writer.take());
    assert_eq!(reader.writers(), 0);
    // The reader keeps the service alive, and the next writer uses it.
    let mut writer = Writer::<Sample>::create(&domain, "icub", 2).unwrap();
    writer.send(&sample(4), Nanos(0)).unwrap();
    assert_eq!(reader.latest().unwrap().unwrap().channel, 4);
    assert_eq!(reader.epochs(), 2);
}

#[test]
fn domains_and_robots_are_isolated() {
    let (base, config) = place();
    let other = DomainConfig::new(base.path(), "other");
    let (a, b) = (
        Domain::open(&config).unwrap(),
        Domain::open(&other).unwrap(),
    );
    assert_ne!(a.epoch(), b.epoch());
    let mut here = Writer::<Sample>::create(&a, "icub", 1).unwrap();
    let mut there = Writer::<Sample>::create(&b, "icub", 2).unwrap();
    let _twin = Writer::<GatewayHealth>::create(&a, "icub", 1).unwrap();
    let _not_a_twin = Writer::<GatewayHealth>::create(&b, "icub", 2).unwrap();
    assert!(matches!(
        Reader::<Sample>::open(&a, "ergocub"),
        Err(PortError::NotYet { .. })
    ));
    let mut ours = Reader::<Sample>::open(&a, "icub").unwrap();
    here.send(&sample(1), Nanos(0)).unwrap();
    there.send(&sample(2), Nanos(0)).unwrap();
    assert_eq!(ours.try_take().unwrap().unwrap().channel, 1);
    assert_eq!(ours.try_take().unwrap(), None);
    // Closing one domain leaves the other alone.
    drop((there, _not_a_twin, b));
    here.send(&sample(3), Nanos(0)).unwrap();
    assert_eq!(ours.try_take().unwrap().unwrap().channel, 3);
    assert!(!base.path().join("other").exists() && base.path().join("test").exists());
}

#[test]
fn a_second_gateway_of_a_robot_is_refused() {
    let (_base, config) = place();
    let first = Domain::open(&config).unwrap();
    let second = Domain::open(&config).unwrap();
    let gateway = Writer::<GatewayHealth>::create(&first, "icub", 1).unwrap();
    let error = Writer::<GatewayHealth>::create(&second, "icub", 2).unwrap_err();
    let PortError::Taken {
        most: 1, holder, ..
    } = error
    else {
        panic!("{error:?}")
    };
    assert_eq!(holder, std::process::id() as i32);
    assert!(error.to_string().contains("only one gateway"), "{error}");
    let _another_robot = Writer::<GatewayHealth>::create(&second, "ergocub", 2).unwrap();
    let _its_estimator = Writer::<EstimatorHealth>::create(&second, "icub", 2).unwrap();
    drop(gateway);
    Writer::<GatewayHealth>::create(&second, "icub", 3).unwrap();
}

#[test]
fn who_comes_late_finds_the_last_inertia_at_once() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut writer = Writer::<InertiaEstimate>::create(&domain, "icub", 3).unwrap();
    let mut estimate = Box::new(InertiaEstimate::default());
    for second in 1..=20 {
        estimate.header.acquired = Nanos::from_millis(1000 * second);
        estimate.link_count = 1;
        estimate.links[0] = LinkInertia {
            name: Name::new("hand").unwrap(),
            parameters: [second as f64; 10],
            ..LinkInertia::ABSENT
        };
        writer.send(&estimate, Nanos(second)).unwrap();
    }
    let mut reader = Reader::<InertiaEstimate>::open(&domain, "icub").unwrap();
    writer.update_connections().unwrap();
    let got = reader.try_take().unwrap().unwrap();
    assert_eq!(
        (got.header.acquired, got.header.sequence),
        (Nanos::from_millis(20_000), 19)
    );
    assert_eq!((got.links().len(), got.offsets().len()), (1, 0));
    assert_eq!(
        (got.links[0].name.as_str(), got.links[0].parameters),
        ("hand", [20.0; 10])
    );
    assert!(reader.try_take().unwrap().is_none());
    assert!(
        Writer::<InertiaEstimate>::create(&domain, "icub", 4).is_err(),
        "there is one estimator"
    );
}

/// A later version of the sample, on the same service.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend, FromBytes)]
#[type_name("proprio/Sample/3")]
struct NextSample {
    header: Header,
    more: [u64; 17],
}

impl Topic for NextSample {
    const SUFFIX: &'static str = Sample::SUFFIX;
    const QUALITY: QualityOfService = Sample::QUALITY;
    fn header(&self) -> &Header {
        &self.header
    }
    fn header_mut(&mut self) -> &mut Header {
        &mut self.header
    }
    fn is_valid(&self) -> bool {
        true
    }
}

#[test]
fn another_version_is_told_apart_although_its_size_is_the_same() {
    assert_eq!(size_of::<NextSample>(), size_of::<Sample>());
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let _writer = Writer::<NextSample>::create(&domain, "icub", 1).unwrap();
    for error in [
        Reader::<Sample>::open(&domain, "icub").unwrap_err(),
        Writer::<Sample>::create(&domain, "icub", 1).unwrap_err(),
    ] {
        let PortError::Incompatible {
            offered, needed, ..
        } = error
        else {
            panic!("{error:?}")
        };
        assert_eq!(
            (offered.as_str(), needed.as_str()),
            (
                "proprio/Sample/3 (192 bytes)",
                "proprio/Sample/2 (192 bytes)"
            )
        );
    }
}

#[test]
fn names_are_checked() {
    let (base, _) = place();
    for name in ["", "a b", "a/b", "..", "a.lock", "ä", &"x".repeat(33)] {
        let result = Domain::open(&DomainConfig::new(base.path(), name));
        assert!(matches!(result, Err(DomainError::Name { .. })), "{name:?}");
    }
    for dir in ["relative", &format!("/{}", "x".repeat(65))] {
        let result = Domain::open(&DomainConfig::new(dir, "test"));
        assert!(matches!(result, Err(DomainError::Base { .. })), "{dir:?}");
    }
    assert!(is_empty(base.path()));
    // The longest legal path works, ports included.
    let longest = base
        .path()
        .join("y".repeat(64 - base.path().as_os_str().len()));
    let domain = Domain::open(&DomainConfig::new(&longest, &"x".repeat(32))).unwrap();
    let robot = "r".repeat(63);
    let mut writer = Writer::<ContactDeclaration>::create(&domain, &robot, 1).unwrap();
    let mut reader = Reader::<ContactDeclaration>::open(&domain, &robot).unwrap();
    let state = ContactState {
        position: [0.1, 0.2, 0.3],
        ..ContactState::configured(true)
    };
    let declared = ContactDeclaration::new(Name::new("hand").unwrap(), Nanos(7), &state);
    writer.send(&declared, Nanos(0)).unwrap();
    let got = reader.latest().unwrap().unwrap();
    assert_eq!(
        (got.contact.as_str(), got.header.acquired),
        ("hand", Nanos(7))
    );
    assert_eq!(
        (got.state().active, got.state().position),
        (true, [0.1, 0.2, 0.3])
    );
    for robot in ["", "a/b", "a b", "ä", &"r".repeat(65)] {
        assert!(
            matches!(
                Writer::<Sample>::create(&domain, robot, 1),
                Err(PortError::Robot { .. })
            ),
            "{robot:?}"
        );
    }
}

#[test]
fn anothers_domain_is_refused_by_name_of_its_owner() {
    let (base, config) = place();
    if std::fs::metadata(base.path()).unwrap().uid() != 0 {
        eprintln!("skipped: only the superuser can give a directory away");
        return;
    }
    std::fs::create_dir(base.path().join("test")).unwrap();
    std::os::unix::fs::chown(base.path().join("test"), Some(65534), Some(65534)).unwrap();
    let error = Domain::open(&config).unwrap_err();
    assert!(
        matches!(
            error,
            DomainError::ForeignOwner {
                owner: 65534,
                user: 0,
                ..
            }
        ),
        "{error:?}"
    );
    assert!(
        error.to_string().contains("must run as the same user"),
        "{error}"
    );
}

#[test]
fn a_base_that_is_a_file_is_said_to_be() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let error = Domain::open(&DomainConfig::new(file.path(), "test")).unwrap_err();
    assert!(
        matches!(error, DomainError::Io { .. })
            && error.to_string().contains("PROPRIO_RUNTIME_DIR"),
        "{error}"
    );
}

#[test]
fn ports_of_many_threads_share_one_domain() {
    let (base, config) = place();
    let domain = Domain::open(&config).unwrap();
    std::thread::scope(|scope| {
        for bus in 0..8 {
            let domain = domain.clone();
            scope.spawn(move || {
                for turn in 0..5 {
                    let mut writer =
                        Writer::<Sample>::create(&domain, "icub", u64::from(turn * 8 + bus))
                            .unwrap();
                    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
                    writer.send(&sample(bus), Nanos(0)).unwrap();
                    let mut seen = false;
                    while let Some(s) = reader.try_take().unwrap() {
                        seen |= s.channel == bus;
                    }
                    assert!(seen);
                }
            });
        }
    });
    drop(domain);
    assert!(is_empty(base.path()));
}

/// What another process may write where samples are expected: bytes of the right size.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend, FromBytes)]
#[type_name("proprio/Sample/2")]
struct Garbage {
    header: Header,
    words: [u64; 17],
}

impl Topic for Garbage {
    const SUFFIX: &'static str = Sample::SUFFIX;
    const QUALITY: QualityOfService = Sample::QUALITY;
    fn header(&self) -> &Header {
        &self.header
    }
    fn header_mut(&mut self) -> &mut Header {
        &mut self.header
    }
    fn is_valid(&self) -> bool {
        true
    }
}

#[test]
fn garbage_is_counted_and_skipped() {
    assert_eq!(size_of::<Garbage>(), size_of::<Sample>());
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut honest = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    let mut other = Writer::<Garbage>::create(&domain, "icub", 2).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    let mut state = 1_u64;
    let mut random = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1442695040888963407);
        state >> 3 ^ state << 29
    };
    let mut bytes = [0; size_of::<Garbage>()];
    let count = Sample::QUALITY.buffer as u64 / 2;
    for _ in 0..count {
        bytes
            .chunks_mut(8)
            .for_each(|word| word.copy_from_slice(&random().to_ne_bytes()));
        let garbage = Garbage::read_from_bytes(&bytes).unwrap();
        other.forward(&garbage).unwrap();
        honest.send(&sample(7), Nanos(1)).unwrap();
    }
    let mut taken = 0;
    while let Some(sample) = reader.try_take().unwrap() {
        assert_eq!((sample.channel, sample.header.epoch), (7, 1));
        assert!(sample.reading().is_some());
        taken += 1;
    }
    assert_eq!((taken, reader.invalid(), reader.lost()), (count, count, 0));
    assert!(
        other.forward(&garbage_of(&sample(8))).is_ok(),
        "the service still works"
    );
    assert_eq!(reader.try_take().unwrap().map(|s| s.channel), Some(8));
}

/// The same bytes as a sample's.
fn garbage_of(sample: &Sample) -> Garbage {
    let kind = u64::from(sample.kind.number()) << 32;
    let mut words = [kind | u64::from(sample.channel); 17];
    let values = sample.values.map(f64::to_bits);
    words[1..].copy_from_slice(&values);
    Garbage {
        header: sample.header,
        words,
    }
}

/// Each payload with one number that has no meaning.
#[test]
fn every_payload_is_checked() {
    let mut good = sample(1);
    assert!(good.is_valid());
    good.kind = Code::of_number(7);
    assert!(!good.is_valid());
    let mut stamp = sample(1);
    stamp.header.stamp = Code::of_number(5);
    assert!(!stamp.is_valid());
    let mut gauges = sample(1);
    gauges.kind = Kind::Gauges.in_memory();
    gauges.values[3] = 0.5;
    assert!(!gauges.is_valid());

    let names = description(Publisher::Gateway, &[("a", Role::Channel, 0)]);
    assert!(names.is_valid());
    let changes: [fn(&mut Description); 4] = [
        |d| d.publisher = Code::of_number(2),
        |d| d.count = u32::MAX,
        |d| d.entries[0].role = Code::of_number(4),
        |d| d.entries[0].kind = Code::of_number(99),
    ];
    for change in changes {
        let mut names = names;
        change(&mut names);
        assert!(!names.is_valid());
    }

    let mut torques = TorqueEstimate {
        header: Header::default(),
        count: 1,
        reserved: 0,
        joints: [JointTorque::ABSENT; MAX_JOINTS],
    };
    torques.joints[1].reason = Code::of_number(15);
    assert!(torques.is_valid(), "what is not counted is not looked at");
    torques.count = 2;
    assert!(!torques.is_valid());
    torques.count = MAX_JOINTS as u32 + 1;
    assert!(!torques.is_valid());

    let mut health = Box::new(GatewayHealth::new(Nanos::ZERO));
    (health.bus_count, health.device_count) = (1, 1);
    assert!(health.is_valid());
    let changes: [fn(&mut GatewayHealth); 5] = [
        |h| h.buses[0].link = Code::of_number(6),
        |h| h.buses[0].interface.controller = Code::of_number(7),
        |h| h.devices[0].state = Code::of_number(7),
        |h| h.bus_count = 17,
        |h| h.device_count = MAX_CHANNELS as u32 + 1,
    ];
    for change in changes {
        let mut health = health.clone();
        change(&mut health);
        assert!(!health.is_valid());
    }
}

/// A bridge keeps what the first publisher wrote; a writer of its own does not.
#[test]
fn a_forwarded_payload_is_that_of_its_first_publisher() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut writer = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    let mut there = sample(3);
    there.header = Header {
        epoch: 77,
        sequence: 1234,
        acquired: Nanos(5),
        published: Nanos(6),
        device_time: Nanos(7),
        ..Header::default()
    };
    assert_eq!(writer.forward(&there).unwrap().sequence, 1234);
    assert_eq!(reader.try_take().unwrap(), Some(there));
    assert_eq!(writer.send(&there, Nanos(9)).unwrap().sequence, 0);
    let sent = reader.try_take().unwrap().unwrap().header;
    assert_eq!(
        (sent.epoch, sent.sequence, sent.published),
        (1, 0, Nanos(9))
    );
    assert_eq!((sent.acquired, sent.device_time), (Nanos(5), Nanos(7)));
}

/// An estimate of an old instant is old, however late it was published.
#[test]
fn freshness_counts_from_the_acquisition() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut writer = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    let mut reader = Reader::<Sample>::open(&domain, "icub").unwrap();
    let mut sent = sample(0);
    sent.header.acquired = Nanos(1000);
    writer.send(&sent, Nanos(1100)).unwrap();
    reader.latest().unwrap().unwrap();
    let age = Nanos(150);
    assert_eq!(
        reader.freshness(Nanos(1150), Nanos(120)),
        Freshness::Stale { age }
    );
    assert_eq!(reader.freshness(Nanos(1150), age), Freshness::Fresh { age });
}

/// A port that is dropped without the domain's lock could be seen half removed. Whoever holds the
/// lock here, as another process would, delays the drop.
#[test]
fn ports_are_dropped_under_the_domains_lock() {
    let (base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let _service = Writer::<Sample>::create(&domain, "icub", 1).unwrap();
    for port in ["writer", "reader"] {
        let (say, said) = channel();
        let (go, may_go) = channel::<()>();
        let there = domain.clone();
        let thread = std::thread::spawn(move || {
            let (writer, reader) = match port {
                "writer" => (Writer::<Sample>::create(&there, "icub", 2).ok(), None),
                _ => (None, Reader::<Sample>::open(&there, "icub").ok()),
            };
            assert!(writer.is_some() || reader.is_some(), "no {port}");
            say.send("open").unwrap();
            may_go.recv().unwrap();
            drop((writer, reader));
            say.send("dropped").unwrap();
        });
        assert_eq!(said.recv(), Ok("open"));
        let lock = File::open(base.path().join("test.lock")).unwrap();
        lock.lock().unwrap();
        go.send(()).unwrap();
        let early = said.recv_timeout(Duration::from_millis(100));
        assert_eq!(early, Err(RecvTimeoutError::Timeout), "the {port}");
        drop(lock);
        assert_eq!(said.recv(), Ok("dropped"));
        thread.join().unwrap();
    }
}
