//! Whole sessions: recorded offline and decoded by the gateway, and live on a virtual bus.

use proprio_gateway::clock::{Clock, Monotonic};
use proprio_gateway::config::FrameSource;
use proprio_gateway::devices::BusDevices;
use proprio_gateway::link::adapter::Adapter;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received};
use proprio_gateway::offline::decode;
use proprio_gateway::status::BusStatus;
use proprio_simulator::record::{record, write_truth};
use proprio_simulator::{
    RunOptions, RunOptionsError, SimulatedRobot, Simulation, SimulationSettings, SimulatorError,
    parse_bus, run, run_with_skin,
};
use proprio_topics::csv::{Columns, Row, TableReader, Value};
use proprio_topics::{Counter, Nanos, Reading};
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

const T0: Nanos = Nanos::from_millis(100_000);

fn robot() -> SimulatedRobot {
    SimulatedRobot::open("icub_left_arm").expect("the robot of the source tree")
}

#[test]
fn a_recorded_session_decodes_to_what_was_sent() {
    let robot = robot();
    let settings = SimulationSettings {
        seed: 3,
        ..SimulationSettings::default()
    };
    let (mut log, mut table) = (Vec::new(), Vec::new());
    let recorded = record(&robot, &settings, 3.0, T0, &mut log).unwrap();
    let report = decode(&robot.plan, &log[..], &mut table, Columns::All).unwrap();
    assert_eq!(
        (
            report.bad_lines,
            report.other_interfaces,
            report.out_of_order
        ),
        (0, 0, 0),
        "{:?}",
        report.bad
    );
    let frames: u64 = recorded.iter().map(|r| r.sent + r.commands).sum();
    assert_eq!(report.frames, frames);
    assert_eq!(
        recorded[1].commands, 0,
        "nothing commands motor boards here"
    );
    for device in &report.devices {
        assert!(
            device.refusal.is_none() && device.counts.is_empty(),
            "{device:?}"
        );
    }
    let readings = |name: &str| {
        report
            .devices
            .iter()
            .find(|d| d.name == name)
            .unwrap()
            .readings
    };
    assert!(
        readings("l_arm_ft_sensor") > 2900
            && readings("chest_imu") > 280
            && readings("l_wrist_yaw_motor") >= 750
    );
    // In order, and at least a frame's duration apart on each bus.
    let mut last: HashMap<&str, Nanos> = HashMap::new();
    let text = std::str::from_utf8(&log).unwrap();
    for line in text.lines() {
        let mut words = line.split_whitespace();
        let t = Nanos::parse_seconds(words.next().unwrap().trim_matches(['(', ')'])).unwrap();
        let before = last.insert(words.next().unwrap(), t);
        assert!(
            before.is_none_or(|b| t - b >= Nanos::from_micros(130)),
            "{line}"
        );
    }
    // The same seed gives the same log.
    let mut again = Vec::new();
    record(&robot, &settings, 3.0, T0, &mut again).unwrap();
    assert!(again == log);
}

#[test]
fn the_truth_is_a_sample_log() {
    let robot = robot();
    let mut simulation = Simulation::new(
        &robot,
        &SimulationSettings {
            cycle: 4.0,
            ..SimulationSettings::default()
        },
    )
    .unwrap();
    let mut table = Vec::new();
    let rows = write_truth(
        &mut simulation,
        T0,
        T0 + Nanos::from_millis(2_500),
        Nanos::from_millis(10),
        &mut table,
    )
    .unwrap();
    assert_eq!(rows, 251);
    let mut reader = TableReader::new(&table[..]).unwrap();
    let series = reader.series().to_vec();
    let (mut row, mut read) = (Row::default(), 0);
    while reader.next_row(&mut row).unwrap() {
        let t = row.t.unwrap();
        assert_eq!(t, T0 + Nanos::from_millis(10 * read));
        let truth = simulation.at((t - T0).seconds()).clone();
        for item in &row.items {
            let Value::Reading(reading, _) = item.value else {
                panic!()
            };
            match reading {
                Reading::Joint(state) => {
                    let joint = truth.joints[simulation.joint(&series[item.series].name).unwrap()];
                    assert_eq!(
                        (state.position, state.velocity),
                        (joint.position, joint.velocity)
                    );
                    assert_eq!(
                        (state.acceleration, state.torque),
                        (joint.acceleration, joint.torque)
                    );
                }
                Reading::Wrench(wrench) => {
                    assert_eq!([wrench.force, wrench.torque].concat(), truth.wrenches[0]);
                }
                Reading::Imu(imu) => {
                    assert_eq!(imu.angular_acceleration, truth.imus[0].angular_acceleration);
                }
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(row.items.len(), 9);
        read += 1;
    }
    assert_eq!(read, 251);
    assert_eq!(reader.report().bad_rows, 0);
    let header = std::str::from_utf8(&table).unwrap().lines().next().unwrap();
    assert!(
        header.contains(",contact/stand/fx,") && header.ends_with(",contact/hand/tz"),
        "{header}"
    );
}

/// The gateway's side of one virtual bus until `stop`: returns the frames received and each
/// device's counters.
fn listen(
    robot: &SimulatedRobot,
    bus: usize,
    domain: &str,
    name: &str,
    stop: &AtomicBool,
) -> (u64, Vec<(String, Vec<u64>)>) {
    let plan = &robot.plan.buses[bus];
    let status = Arc::new(BusStatus::new(0, plan));
    let mut devices = BusDevices::new(0, plan, None, Arc::clone(&status)).unwrap();
    let mut link = VirtualBus::open(domain, name, &[]).unwrap();
    let clock = Monotonic;
    while !stop.load(Relaxed) {
        let mut sent = Vec::new();
        devices.poll_transmit(clock.now(), |device, t| {
            link.send(&t.frame).unwrap();
            sent.push((device, t.frame));
        });
        for (device, frame) in sent {
            devices.on_sent(device, &frame, Ok(clock.now()));
        }
        let deadline = clock.now() + Nanos::from_millis(10);
        if let Received::Frame(frame) =
            link.recv(devices.next_wake().map_or(deadline, |w| w.min(deadline)))
        {
            devices.on_frame(&frame, |_| {});
        }
    }
    // Read the rest of the buffer.
    while let Received::Frame(frame) = link.recv(clock.now() + Nanos::from_millis(100)) {
        devices.on_frame(&frame, |_| {});
    }
    assert_eq!(link.counters().dropped, 0);
    let devices = status
        .devices()
        .map(|d| (d.name.as_str().to_owned(), d.counters.to_vec()))
        .collect();
    (link.counters().received, devices)
}

#[test]
fn live_on_virtual_buses_boards_are_started_and_every_frame_sent_arrives() {
    let robot = robot();
    let folder = tempfile::tempdir().unwrap();
    let truth = folder.path().join("truth.csv");
    // A separate domain, because tests run in parallel.
    let domain = format!("simulator-{}", std::process::id());
    let options = RunOptions {
        buses: vec![
            parse_bus("virtual:one").unwrap(),
            parse_bus("virtual:two").unwrap(),
        ],
        domain: domain.clone(),
        seconds: Some(1.5),
        settings: SimulationSettings {
            faults: vec!["lost:0.01".parse().unwrap()],
            ..SimulationSettings::default()
        },
        truth: Some(truth.clone()),
    };
    let over = AtomicBool::new(false);
    let (summary, heard) = std::thread::scope(|scope| {
        let (robot, domain, over) = (&robot, domain.as_str(), &over);
        let listeners: Vec<_> = ["one", "two"]
            .into_iter()
            .enumerate()
            .map(|(bus, name)| scope.spawn(move || listen(robot, bus, domain, name, over)))
            .collect();
        // The gateways must listen before the boards start, so that no frame is missed.
        std::thread::sleep(std::time::Duration::from_millis(200));
        let summary = run(robot, &options, &AtomicBool::new(false));
        over.store(true, Relaxed);
        (
            summary.unwrap(),
            listeners
                .into_iter()
                .map(|l| l.join().unwrap())
                .collect::<Vec<_>>(),
        )
    });
    for (bus, (received, devices)) in summary.buses.iter().zip(&heard) {
        assert_eq!(
            (bus.sent, bus.send_failures, bus.refused),
            (*received, 0, 0),
            "{bus:?}"
        );
        for (name, counters) in devices {
            assert!(
                counters[Counter::Readings as usize] > 20,
                "{name}: {counters:?}"
            );
        }
    }
    assert_eq!(summary.sent, heard.iter().map(|(n, _)| n).sum::<u64>());
    assert!(summary.lost_on_request > 0 && summary.buses[0].received > 0);
    assert_eq!((summary.seconds, summary.truth_rows), (1.5, 1501));
    let text = std::fs::read_to_string(truth).unwrap();
    assert_eq!(text.lines().count(), 1502);
    assert_eq!(
        text.lines()
            .nth(1)
            .unwrap()
            .split(',')
            .next()
            .and_then(Nanos::parse_seconds),
        Some(Nanos(summary.t0))
    );
    let json = serde_json::to_value(&summary).unwrap();
    assert_eq!(json["buses"][1]["source"], "virtual:two");
}

#[test]
fn it_ends_when_it_is_told_to() {
    let options = RunOptions {
        domain: format!("stop-{}", std::process::id()),
        ..RunOptions::default()
    };
    let summary = run(&robot(), &options, &AtomicBool::new(true)).unwrap();
    assert_eq!((summary.sent, summary.truth_rows), (0, 0));
}

#[test]
fn the_skin_tells_of_each_touch_ahead_of_it() {
    let options = RunOptions {
        domain: format!("skin-{}", std::process::id()),
        seconds: Some(2.0),
        ..RunOptions::default()
    };
    let mut heard_touches = Vec::new();
    let mut skin = |contact: &str, at: Nanos, touches: bool| {
        heard_touches.push((contact.to_owned(), at, touches, Monotonic.now()));
    };
    let summary =
        run_with_skin(&robot(), &options, Some(&mut skin), &AtomicBool::new(false)).unwrap();
    let touches: Vec<_> = heard_touches
        .iter()
        .map(|(contact, at, touches, heard)| {
            (
                contact.as_str(),
                *at - Nanos(summary.t0),
                *touches,
                *at - *heard,
            )
        })
        .collect();
    let [(_, from, ..), (_, until, ..)] = touches[..] else {
        panic!("{touches:?}");
    };
    // The push of a run of 2 s, from 40 % to 60 % of it.
    assert_eq!(
        (from, until),
        (Nanos::from_millis(800), Nanos::from_millis(1200))
    );
    assert!(
        touches.iter().all(|(contact, ..)| *contact == "hand"),
        "{touches:?}"
    );
    assert_eq!([touches[0].2, touches[1].2], [true, false]);
    assert!(
        touches
            .iter()
            .all(|(.., ahead)| (Nanos::ZERO..=Nanos::from_millis(100)).contains(ahead)),
        "{touches:?}"
    );
    // A stop request in the meantime is obeyed.
    let options = RunOptions {
        seconds: Some(60.0),
        ..options
    };
    let mut skin = |_: &str, _, _| {};
    let summary =
        run_with_skin(&robot(), &options, Some(&mut skin), &AtomicBool::new(true)).unwrap();
    assert!(summary.seconds < 10.0);
}

#[test]
fn options_that_can_not_be_followed_are_told() {
    let run = |options: RunOptions| run(&robot(), &options, &AtomicBool::new(true)).unwrap_err();
    let virtual_bus = |name: &str| FrameSource::Virtual { name: name.into() };
    for (options, expected) in [
        (
            RunOptions {
                buses: vec![virtual_bus("a")],
                ..RunOptions::default()
            },
            "1 buses are given; the robot has 2: left_arm, left_arm_motors",
        ),
        (
            RunOptions {
                buses: vec![virtual_bus("a"), virtual_bus("a")],
                ..RunOptions::default()
            },
            "the same source",
        ),
        (
            RunOptions {
                seconds: Some(0.0),
                ..RunOptions::default()
            },
            "seconds = 0 must be above 0",
        ),
        (
            RunOptions {
                settings: SimulationSettings {
                    faults: vec!["spike:nose@1".parse().unwrap()],
                    ..SimulationSettings::default()
                },
                ..RunOptions::default()
            },
            "no board or channel \"nose\"",
        ),
    ] {
        let error = run(options);
        assert!(format!("{error:#}").contains(expected), "{error:#}");
        assert!(error.is::<RunOptionsError>() || error.is::<SimulatorError>());
    }
    let missing = RunOptions {
        buses: vec![parse_bus("nocan0").unwrap(), parse_bus("nocan1").unwrap()],
        ..RunOptions::default()
    };
    let error = run(missing);
    assert!(
        format!("{error:#}").contains("bus \"left_arm\" (nocan0): "),
        "{error:#}"
    );
    assert!(
        !error.is::<RunOptionsError>() && !error.is::<SimulatorError>(),
        "missing CAN support is not a wrong configuration"
    );
    assert_eq!(parse_bus("virtual:left_arm"), Ok(virtual_bus("left_arm")));
    assert_eq!(
        parse_bus("vcan0"),
        Ok(FrameSource::SocketCan(Adapter::Interface("vcan0".into())))
    );
    for wrong in ["", "virtual", "virtual:", "udp:x", "an_interface_too_long"] {
        assert_eq!(parse_bus(wrong), Err(RunOptionsError::Bus(wrong.into())));
    }
}
