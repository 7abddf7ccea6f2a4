//! The reader for control loops: values with their reasons, restarts in any order, who is missing,
//! and a cycle that makes no system call.
// A system call that cuts off all others needs unsafe code.
#![allow(missing_docs, clippy::unwrap_used, unsafe_code)]

mod fakes;

use fakes::{CHANNELS, Estimator, Gateway, description};
use proprio_topics::ipc::{
    Domain, DomainConfig, Presence, RobotReader, Unavailable, Writer, monotonic,
};
use proprio_topics::{GatewayHealth, Kind, Nanos, Publisher, Quality, Role};
use std::io::Read;
use std::process::{Command, Stdio};
use std::time::Duration;

const ROLE: &str = "PROPRIO_TEST_ROLE";
/// Longer than anything here takes. Not a measure of speed.
const PATIENCE: Nanos = Nanos::from_millis(20_000);
const MAX_AGE: Nanos = Nanos::from_millis(50);

fn place() -> (tempfile::TempDir, DomainConfig) {
    let base = tempfile::tempdir_in("/dev/shm").unwrap();
    let config = DomainConfig::new(base.path(), "test");
    (base, config)
}

/// Calls `turn` until it returns true.
fn until(what: &str, mut turn: impl FnMut() -> bool) {
    let end = monotonic() + PATIENCE;
    while !turn() {
        assert!(monotonic() < end, "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn values_come_with_a_reason_when_they_do_not_come() {
    let (_base, config) = place();
    let mut robot = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let (elbow, wrist) = (robot.torque_handle("elbow"), robot.torque_handle("wrist"));
    let (nobody, hand) = (robot.torque_handle("nobody"), robot.contact_handle("hand"));
    let encoder = robot.channel_handle(Kind::Joint, "elbow");
    let ft = robot.channel_handle(Kind::Wrench, "ft");
    let imu = robot.channel_handle(Kind::Imu, "chest");
    let other_kind = robot.channel_handle(Kind::Imu, "ft");
    robot.update(monotonic());
    assert_eq!(robot.torque(elbow), Err(Unavailable::NeverSeen));
    assert_eq!(robot.contact(hand), Err(Unavailable::NeverSeen));
    assert_eq!(robot.wrench(ft), Err(Unavailable::NotDescribed));

    let domain = Domain::open(&config).unwrap();
    let mut estimator = Estimator::start(&domain, 1, ["elbow", "wrist"]);
    let mut gateway = Gateway::start(&domain, 2, 5);
    let mut t = Nanos::ZERO;
    until("the first values", || {
        t = monotonic();
        estimator.send(t, [1.5, 2.5]);
        gateway.send(t, 5, Quality::GOOD);
        robot.update(t + Nanos(1000));
        robot.torque(elbow).is_ok() && robot.imu(imu).is_ok() && robot.contact(hand).is_ok()
    });
    let torque = robot.torque(elbow).unwrap();
    assert_eq!((torque.torque, torque.standard_deviation), (1.5, 0.1));
    assert_eq!(torque.age, Nanos(1000));
    let withheld = robot.torque(wrist).unwrap_err();
    assert_eq!(withheld.to_string(), "withheld: stale (ft)");
    assert_eq!(robot.torque(nobody), Err(Unavailable::Unknown));
    let contact = robot.contact(hand).unwrap();
    assert_eq!((contact.wrench.force[0], contact.is_detected), (7.0, true));
    assert_eq!((contact.position[0], contact.is_located), (0.25, true));
    assert_eq!(robot.joint(encoder).unwrap().value.position, 0.25);
    assert_eq!(robot.wrench(ft).unwrap().value.torque, [4.0, 5.0, 6.0]);
    assert_eq!(robot.imu(imu).unwrap().value.proper_acceleration[2], 9.8);
    assert_eq!(robot.wrench(other_kind), Err(Unavailable::Unknown));
    assert_eq!(robot.torque_names().collect::<Vec<_>>(), ["elbow", "wrist"]);
    assert_eq!(robot.contact_names().collect::<Vec<_>>(), ["hand"]);
    assert_eq!(
        robot.channel_names().collect::<Vec<_>>(),
        CHANNELS.map(|(n, k)| (k, n))
    );
    assert_eq!(robot.torque_handle("elbow"), elbow, "a name has one handle");
    assert_ne!(robot.channel_handle(Kind::Wrench, "elbow"), encoder);
    until("both to be seen", || {
        estimator.send(t, [1.5, 2.5]);
        gateway.send(t, 5, Quality::GOOD);
        robot.who_is_missing().is_nobody()
    });

    // A gateway that describes itself again (a reload) has lost nothing.
    gateway.describe(5);
    robot.update(t + Nanos(1000));
    assert!(robot.joint(encoder).is_ok() && robot.wrench(ft).is_ok());

    // An estimate that refers to long ago is old, however late it was published.
    estimator.send(t - MAX_AGE, [1.5, 2.5]);
    robot.update(t + Nanos(1));
    let age = MAX_AGE + Nanos(1);
    assert_eq!(robot.torque(elbow), Err(Unavailable::Stale { age }));
    // A measurement ages by its channel's maximum silence.
    robot.update(t + Nanos::from_millis(30));
    assert!(robot.wrench(ft).is_ok());
    robot.update(t + Nanos::from_millis(31));
    assert!(matches!(robot.wrench(ft), Err(Unavailable::Stale { .. })));

    // What the device says of itself counts; a fault of the drive does not concern the position.
    gateway.send(t, 5, Quality::SATURATED | Quality::DRIVE_FAULT);
    robot.update(t);
    assert_eq!(
        robot.wrench(ft).unwrap_err().to_string(),
        "withheld: saturated (ft)"
    );
    gateway.send(t, 5, Quality::DRIVE_FAULT);
    robot.update(t);
    assert!(robot.joint(encoder).is_ok());
    gateway.send(t, 5, Quality::NOT_CALIBRATED);
    robot.update(t);
    assert!(robot.joint(encoder).is_err() && robot.imu(imu).is_ok());
}

/// Both are restarted, in either order, and number everything differently.
#[test]
fn handles_survive_restarts_in_any_order() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut robot = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let elbow = robot.torque_handle("elbow");
    let ft = robot.channel_handle(Kind::Wrench, "ft");
    let mut estimator = Some(Estimator::start(&domain, 1, ["elbow", "wrist"]));
    let mut gateway = Some(Gateway::start(&domain, 2, 0));
    for epoch in 3..9 {
        let (first, joints) = match epoch % 2 {
            0 => (0, ["elbow", "wrist"]),
            _ => (4, ["wrist", "elbow"]),
        };
        if epoch % 3 == 0 {
            drop((gateway.take(), estimator.take()));
        } else {
            drop((estimator.take(), gateway.take()));
        }
        let (mut e, mut g) = if epoch % 4 < 2 {
            let e = Estimator::start(&domain, epoch, joints);
            (e, Gateway::start(&domain, 100 + epoch, first))
        } else {
            let g = Gateway::start(&domain, 100 + epoch, first);
            (Estimator::start(&domain, epoch, joints), g)
        };
        let value = f64::from(u32::try_from(epoch).unwrap()) / 10.0;
        let begun = monotonic();
        until("the values after a restart", || {
            let t = monotonic();
            e.send(
                t,
                if joints[0] == "elbow" {
                    [value, 9.0]
                } else {
                    [9.0, value]
                },
            );
            g.send(t, first, Quality::GOOD);
            robot.update(t);
            // Never another joint's torque in the meantime.
            let torque = robot.torque(elbow);
            assert!(
                !torque.is_ok_and(|torque| torque.torque >= 2.0),
                "{torque:?}"
            );
            torque.is_ok_and(|torque| torque.torque == value) && robot.wrench(ft).is_ok()
        });
        let took = monotonic() - begun;
        assert!(took < Nanos::from_millis(2000), "{} s", took.seconds());
        (estimator, gateway) = (Some(e), Some(g));
    }
}

/// After a restart the joints may have other numbers: until the new names are there, nothing that
/// was sent since has a name.
#[test]
fn what_a_new_start_sends_has_no_name_of_the_old_one() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut robot = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let (elbow, hand) = (robot.torque_handle("elbow"), robot.contact_handle("hand"));
    let mut estimator = Estimator::start(&domain, 1, ["elbow", "wrist"]);
    let mut send_until = |estimator: &mut Estimator, epoch: u64| {
        until("estimates of this start", || {
            let t = monotonic();
            estimator.send(t, [1.5, 1.0]);
            robot.update(t);
            let epochs = [
                robot.torques().map(|e| e.header.epoch),
                robot.contacts().map(|e| e.header.epoch),
            ];
            epochs == [Some(epoch); 2] && robot.torque(elbow) != Err(Unavailable::NeverSeen)
        });
        (
            robot.torque(elbow).map(|e| e.torque),
            robot.contact(hand).map(|_| ()),
        )
    };
    until("the names", || {
        send_until(&mut estimator, 1) == (Ok(1.5), Ok(()))
    });
    let Estimator {
        torques,
        contacts,
        descriptions,
        health,
    } = estimator;
    drop((torques, contacts));
    let mut estimator = Estimator {
        torques: Writer::create(&domain, "icub", 2).unwrap(),
        contacts: Writer::create(&domain, "icub", 2).unwrap(),
        descriptions,
        health,
    };
    let unnamed = Unavailable::NotDescribed;
    assert_eq!(send_until(&mut estimator, 2), (Err(unnamed), Err(unnamed)));
}

/// What was sent under a number before is not the value of the channel that has it now.
#[test]
fn a_channel_with_a_new_number_has_no_value_of_another() {
    let (_base, config) = place();
    let domain = Domain::open(&config).unwrap();
    let mut robot = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let elbow = robot.channel_handle(Kind::Joint, "elbow");
    let wrist = robot.channel_handle(Kind::Joint, "wrist");
    let mut gateway = Gateway::start(&domain, 1, 5);
    let mut t = Nanos::ZERO;
    until("the first values", || {
        t = monotonic();
        gateway.send(t, 5, Quality::GOOD);
        robot.update(t);
        robot.joint(elbow).is_ok()
    });
    assert_eq!(robot.joint(wrist), Err(Unavailable::Unknown));
    let entries = [("wrist", Role::Channel, Kind::Joint, 5)];
    let renumbered = description(Publisher::Gateway, &entries);
    gateway.descriptions.send(&renumbered, t).unwrap();
    until("the new names", || {
        robot.update(t);
        robot.joint(elbow) == Err(Unavailable::Unknown)
    });
    assert_eq!(robot.joint(wrist), Err(Unavailable::NeverSeen));
}

#[test]
fn a_reader_knows_who_is_missing() {
    let (base, config) = place();
    let robot = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let said = |what: &str| {
        until(what, || robot.who_is_missing().to_string().contains(what));
    };
    let is = |gateway, estimator| {
        until(&format!("gateway {gateway}, estimator {estimator}"), || {
            let missing = robot.who_is_missing();
            (missing.gateway, missing.estimator) == (gateway, estimator)
        });
    };
    said("no gateway or estimator runs in this domain");
    assert!(
        !base.path().join("test").exists(),
        "a reader creates nothing"
    );
    let other = Domain::open(&DomainConfig::new(base.path(), "lab")).unwrap();
    let _another = Writer::<GatewayHealth>::create(&other, "icub", 1).unwrap();
    said("the domains here are lab");
    let domain = Domain::open(&config).unwrap();
    let _walkman = Writer::<GatewayHealth>::create(&domain, "icub_left_arm", 1).unwrap();
    said("there is no robot \"icub\" in the domain \"test\"; the robots here are icub_left_arm");

    let mut health = Writer::<GatewayHealth>::create(&domain, "icub", 1).unwrap();
    let send = |health: &mut Writer<GatewayHealth>| {
        let now = monotonic();
        health.send(&GatewayHealth::new(now), now).unwrap();
    };
    until("the gateway to be seen", || {
        send(&mut health);
        robot.who_is_missing().gateway == Presence::Running
    });
    is(Presence::Running, Presence::NotStarted);
    // It lives, but says nothing more.
    let process = i32::try_from(std::process::id()).unwrap();
    is(Presence::Stuck { process }, Presence::NotStarted);
    drop(health);
    is(Presence::Ended, Presence::NotStarted);
}

/// As in a container that loses its directories: the reader is told, and finds the new ones.
#[test]
fn files_deleted_under_a_reader_are_found_again() {
    let (base, config) = place();
    let mut robot = RobotReader::new(&config, "icub", MAX_AGE).unwrap();
    let elbow = robot.torque_handle("elbow");
    let run = |robot: &mut RobotReader| {
        let domain = Domain::open(&config).unwrap();
        let mut estimator = Estimator::start(&domain, domain.epoch(), ["elbow", "wrist"]);
        until("a torque", || {
            let t = monotonic();
            estimator.send(t, [1.5, 2.5]);
            robot.update(t);
            robot.torque(elbow).is_ok()
        });
    };
    run(&mut robot);
    std::fs::remove_dir_all(base.path().join("test")).unwrap();
    until("the loss to be seen", || {
        robot
            .who_is_missing()
            .problem
            .is_some_and(|problem| problem.contains("deleted"))
    });
    run(&mut robot);
}

/// Not a test: a control loop, in a process whose every system call but `write` is fatal.
#[test]
fn child() {
    let Ok(role) = std::env::var(ROLE) else {
        return;
    };
    let mut robot = RobotReader::new(&DomainConfig::from_env(), "icub", PATIENCE).unwrap();
    let elbow = robot.torque_handle("elbow");
    let ft = robot.channel_handle(Kind::Wrench, "ft");
    let mut now = monotonic();
    let mut cycle = |robot: &mut RobotReader| {
        robot.update(now);
        // A clock may be a system call on some machines.
        now += Nanos(1);
        robot.torque(elbow).is_ok() && robot.wrench(ft).is_ok()
    };
    if role == "attached" {
        until("the first values", || cycle(&mut robot));
    }
    let say = |what: &[u8]| {
        // SAFETY: the bytes live across the call.
        let written = unsafe { nix::libc::write(1, what.as_ptr().cast(), what.len()) };
        assert!(written > 0);
    };
    // SAFETY: it changes nothing but which system calls this thread may make.
    unsafe {
        nix::libc::prctl(nix::libc::PR_SET_SECCOMP, nix::libc::SECCOMP_MODE_STRICT);
    }
    loop {
        let good = (0..20_000).filter(|_| cycle(&mut robot)).count();
        say(if good > 0 { b"+" } else { b"-" });
    }
}

/// A control loop that may make no system call goes on while nobody is there, while a gateway and
/// an estimator send, when both are restarted, and when their files are deleted.
#[test]
fn a_cycle_makes_no_system_call() {
    for role in ["alone", "attached"] {
        let (base, config) = place();
        let domain = Domain::open(&config).unwrap();
        let mut both = (role == "attached").then(|| {
            (
                Estimator::start(&domain, 1, ["elbow", "wrist"]),
                Gateway::start(&domain, 2, 0),
            )
        });
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "child", "--nocapture"])
            .env(ROLE, role)
            .env("PROPRIO_RUNTIME_DIR", base.path())
            .env("PROPRIO_DOMAIN", "test")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut out = child.stdout.take().unwrap();
        let (said, hears) = std::sync::mpsc::channel();
        let listening = std::thread::spawn(move || {
            let mut byte = [0];
            while out.read(&mut byte).is_ok_and(|count| count > 0) && said.send(byte[0]).is_ok() {}
        });
        let mut hear = |what: &str, wanted: u8, count: usize, both: &mut Option<(_, _)>| {
            let mut heard = 0;
            until(what, || {
                if let Some((estimator, gateway)) = both.as_mut() {
                    let t = monotonic();
                    Estimator::send(estimator, t, [1.5, 2.5]);
                    Gateway::send(gateway, t, 0, Quality::GOOD);
                }
                heard += hears.try_iter().filter(|byte| *byte == wanted).count();
                assert!(child.try_wait().unwrap().is_none(), "{what}: a system call");
                heard >= count
            });
        };
        match role {
            "alone" => hear("cycles alone", b'-', 20, &mut both),
            _ => {
                hear("cycles with values", b'+', 20, &mut both);
                drop(both.take());
                both = Some((
                    Estimator::start(&domain, 3, ["wrist", "elbow"]),
                    Gateway::start(&domain, 4, 7),
                ));
                hear("cycles after a restart", b'-', 1, &mut both);
                std::fs::remove_dir_all(base.path().join("test")).unwrap();
                hear("cycles without files", b'-', 20, &mut None);
            }
        }
        child.kill().unwrap();
        child.wait().unwrap();
        listening.join().unwrap();
    }
}
