//! Tests of what is shown, with a screen in memory.

use super::snapshot::RobotState;
use super::view::{Screen, Wish};
use proprio_topics::ipc::Presence;
use proprio_topics::{
    ContactEstimate, ContactWrench, Controller, Counter, Description, DeviceState, Entry,
    EstimatorHealth, GatewayHealth, Header, InertiaEstimate, JointState, JointTorque, MAX_CONTACTS,
    MAX_JOINTS, MAX_SUBTREES, Name, Nanos, Publisher, Quality, Reading, Reason, Refusal, Residual,
    Role, Sample, TorqueEstimate,
};
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Cell;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use std::sync::Arc;

const START: Nanos = Nanos::from_millis(100_000);

fn after(ms: i64) -> Nanos {
    START + Nanos::from_millis(ms)
}

fn header(epoch: u64, t: Nanos) -> Header {
    Header {
        epoch,
        acquired: t,
        published: t,
        ..Header::default()
    }
}

fn name(text: &str) -> Name {
    Name::new(text).expect("a short name")
}

fn names(publisher: Publisher, epoch: u64, entries: &[(Role, &str)]) -> Description {
    let numbered = entries.iter().enumerate().map(|(at, (role, text))| Entry {
        name: name(text),
        origin: name("hand_frame"),
        role: role.in_memory(),
        index: (entries[..at].iter())
            .filter(|(other, _)| other == role)
            .count() as u32,
        ..Entry::NONE
    });
    let mut description = Description::new(publisher, numbered);
    description.header = header(epoch, START);
    description
}

fn torques(epoch: u64, t: Nanos, elbow: f64) -> TorqueEstimate {
    let valid = JointTorque {
        torque: elbow,
        standard_deviation: 0.05,
        valid: 1,
        reason: Reason::None.in_memory(),
        ..JointTorque::ABSENT
    };
    let stale = JointTorque {
        reason: Reason::Stale.in_memory(),
        cause: 0,
        ..JointTorque::ABSENT
    };
    let uncertain = JointTorque {
        reason: Reason::Uncertain.in_memory(),
        standard_deviation: 4.0,
        ..JointTorque::ABSENT
    };
    let mut estimate = TorqueEstimate {
        header: header(epoch, t),
        count: 3,
        reserved: 0,
        joints: [JointTorque::ABSENT; MAX_JOINTS],
    };
    estimate.joints[..3].copy_from_slice(&[valid, stale, uncertain]);
    estimate
}

fn contacts(epoch: u64, t: Nanos) -> ContactEstimate {
    let hand = ContactWrench {
        force: [10.0, -2.5, 0.0],
        torque: [0.25, 0.0, 0.0],
        standard_deviation: [0.5, 1.5, 0.5, 0.01, 0.02, 0.01],
        valid: 1,
        detected: 1,
        ..ContactWrench::ABSENT
    };
    let foot = ContactWrench {
        reason: Reason::Absent.in_memory(),
        ..ContactWrench::ABSENT
    };
    let mut estimate = ContactEstimate {
        header: header(epoch, t),
        count: 2,
        residual_count: 0,
        contacts: [ContactWrench::ABSENT; MAX_CONTACTS],
        residuals: [Residual::ABSENT; MAX_SUBTREES],
    };
    estimate.contacts[..2].copy_from_slice(&[hand, foot]);
    estimate
}

fn gateway(t: Nanos, readings: u64) -> GatewayHealth {
    let mut health = GatewayHealth::new(START);
    health.header = header(1, t);
    (health.bus_count, health.device_count) = (1, 2);
    let bus = &mut health.buses[0];
    (bus.name, bus.load, bus.frame_rate) = (name("can0"), 0.25, 1234.0);
    bus.interface.controller = Controller::Passive.in_memory();
    (
        bus.interface.tx_error_counter,
        bus.interface.rx_error_counter,
    ) = (130, 7);
    let [ft, motor, ..] = &mut health.devices;
    (ft.name, ft.frozen_axes, ft.beyond_axes) = (name("ft"), 0b100, 0b1);
    ft.state = DeviceState::Streaming.in_memory();
    ft.counters[Counter::Readings as usize] = readings;
    ft.counters[Counter::Lost as usize] = 17;
    motor.name = name("motor");
    motor.state = DeviceState::Refused.in_memory();
    motor.refusal = Refusal::NoAnswer.code();
    health
}

/// A robot after `ms` of motion, all of which works.
fn robot(ms: i64) -> RobotState {
    let mut snapshot = RobotState::default();
    snapshot.robots = vec!["left".into(), "right".into()];
    snapshot.robot = Some("left".into());
    snapshot.describe(names(
        Publisher::Gateway,
        1,
        &[(Role::Channel, "ft"), (Role::Channel, "elbow")],
    ));
    snapshot.describe(names(
        Publisher::Estimator,
        2,
        &[
            (Role::Channel, "wrist"),
            (Role::Joint, "elbow"),
            (Role::Joint, "wrist"),
            (Role::Joint, "finger"),
            (Role::Contact, "hand"),
            (Role::Contact, "Foot"),
        ],
    ));
    for t in (0..=ms).step_by(10) {
        let mut header = header(1, after(t));
        header.quality = Quality::SATURATED;
        snapshot.sample(&Sample::new(header, 0, &Reading::Joint(JointState::ABSENT)));
        if t % 100 == 0 {
            snapshot.gateway = (
                Presence::Running,
                Some(Arc::new(gateway(after(t), t as u64 / 2))),
            );
            let mut health = EstimatorHealth {
                header: self::header(2, after(t)),
                started: START,
                estimates: t as u64,
                ..EstimatorHealth::default()
            };
            health.identification.groups = 2;
            health.identification.paused = 1;
            health.identification.learnt = 55;
            snapshot.estimator = (Presence::Running, Some(Arc::new(health)));
            snapshot.tick(after(t));
        }
    }
    snapshot.hear_torques(torques(2, after(ms), 1.25));
    snapshot.hear_contacts(contacts(2, after(ms)));
    let mut inertia = InertiaEstimate {
        header: header(2, after(ms)),
        link_count: 2,
        offset_count: 1,
        ..InertiaEstimate::default()
    };
    inertia.links[0].name = name("forearm");
    inertia.links[0].accepted = 1;
    (
        inertia.links[0].parameters[0],
        inertia.links[0].standard_deviation[0],
    ) = (1.5, 0.01);
    inertia.links[1].name = name("upper_arm");
    (inertia.offsets[0].name, inertia.offsets[0].accepted) = (name("ft"), 1);
    inertia.offsets[0].standard_deviation = [0.1, 0.2, 0.1, 0.01, 0.01, 0.01];
    snapshot.hear_inertia(inertia);
    snapshot
}

/// The lines on a screen.
fn screen(view: &mut Screen, (width, height): (u16, u16), now: Nanos) -> Vec<String> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("memory");
    terminal
        .draw(|frame| view.draw(frame, now))
        .expect("memory");
    let buffer = terminal.backend().buffer();
    let rows = buffer.content.chunks(usize::from(width).max(1));
    rows.map(|row| row.iter().map(Cell::symbol).collect::<String>())
        .map(|line| line.trim_end().to_owned())
        .collect()
}

fn view_of(snapshot: RobotState) -> Screen {
    let mut view = Screen::new("test", snapshot.now);
    view.show(snapshot);
    view
}

fn press(view: &mut Screen, codes: &[KeyCode]) -> Wish {
    let mut last = Wish::Nothing;
    for code in codes {
        last = view.press((*code).into());
    }
    last
}

/// The line that begins with `name`, under the title of a section.
fn row<'a>(lines: &'a [String], section: &str, name: &str) -> &'a str {
    let lines = lines.iter().skip_while(|line| !line.starts_with(section));
    let mut rows = lines
        .skip(1)
        .filter(|line| line.trim_start().starts_with(name));
    rows.next().map_or("", |line| line.trim())
}

const WIDE: (u16, u16) = (120, 50);

#[test]
fn each_part_shows_its_values_or_why_not() {
    let snapshot = robot(3000);
    let now = snapshot.now;
    let lines = screen(&mut view_of(snapshot), WIDE, now);
    let text = lines.join("\n");
    for expected in [
        "robot left (1 of 2)  domain test",
        "gateway   is running, up 3.0 s",
        "estimator is running, up 3.0 s, 1000.0 estimates/s",
        "TORQUES  1 of 3 valid",
        "CONTACTS  1 of 2 present",
        "CHANNELS  1 of 2 alive",
        "DEVICES  1 of 2 streaming",
        "BUSES  1 of 1 up",
        "IDENTIFICATION  groups: 2, paused: 1",
    ] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
    let is = |section: &str, name: &str, begin: &str| {
        let row = row(&lines, section, name);
        let words: Vec<&str> = row.split_whitespace().collect();
        assert!(words.join(" ").starts_with(begin), "{begin}: {row}\n{text}");
    };
    is("TORQUES", "elbow", "elbow 1.250 ± 0.100 │███");
    is("TORQUES", "wrist", "wrist withheld: stale (wrist)");
    is("TORQUES", "finger", "finger withheld: uncertain, ± 8.000");
    is(
        "CONTACTS",
        "hand",
        "hand detected 10.0 -2.5 0.0 ± 3.0 0.25 0.00 0.00 ± 0.04 as configured, in hand_frame",
    );
    is("CONTACTS", "Foot", "Foot withheld: absent");
    is("CHANNELS", "ft", "ft joint 100.0 0.0 ms saturated");
    is("CHANNELS", "elbow", "elbow joint 0.0 - never seen");
    is(
        "DEVICES",
        "ft",
        "ft can0 streaming 500.0 fz frozen; fx out of range; lost 17",
    );
    is(
        "DEVICES",
        "motor",
        "motor can0 refused 0.0 it does not answer",
    );
    is(
        "BUSES",
        "can0",
        "can0 up passive, errors tx 130 rx 7 load 25 %, 1234 frames/s 0 0 0",
    );
    is("IDENTIFICATION", "instants", "instants learnt 55");
    is(
        "IDENTIFICATION",
        "forearm",
        "forearm 1.500 ± 0.020 kg 0.0 s 9 of 10 parameters unknown",
    );
    is(
        "IDENTIFICATION",
        "upper_arm",
        "upper_arm NaN not known 0.0 s nothing accepted yet",
    );
    is("IDENTIFICATION", "ft", "ft ± 0.400 N, ± 0.0200 Nm");
}

/// No value is shown that may no longer be true.
#[test]
fn what_is_gone_is_not_shown_as_if_it_were_there() {
    let now = |snapshot: &mut RobotState, ms| {
        snapshot.tick(after(ms));
        screen(&mut view_of(snapshot.clone()), WIDE, after(ms))
    };
    let mut snapshot = robot(3000);
    let lines = now(&mut snapshot, 3900);
    assert!(row(&lines, "TORQUES", "elbow").contains("1.250"));
    let mut killed = snapshot.clone();
    killed.estimator.0 = Presence::Killed;
    for (mut snapshot, ms, age) in [
        (snapshot.clone(), 4100, "1.1 s"),
        (killed, 3950, "950.0 ms"),
    ] {
        let lines = now(&mut snapshot, ms);
        let text = lines.join("\n");
        let expected = format!("TORQUES  the last estimate was {age} ago");
        assert!(text.contains(&expected), "{text}");
        assert_eq!(row(&lines, "TORQUES", "elbow"), "elbow   gone");
        assert_eq!(row(&lines, "CONTACTS", "hand"), "hand     gone");
        assert!(!text.contains("1.250") && !text.contains("10.0"), "{text}");
    }
    // The channels of a gateway that is gone are silent.
    snapshot.gateway.0 = Presence::Killed;
    let lines = now(&mut snapshot, 5000);
    assert!(
        row(&lines, "CHANNELS", "ft").ends_with("0.0  2.0 s  silent"),
        "{lines:?}"
    );
    let text = lines.join("\n");
    assert!(
        text.contains("gateway   was killed or has crashed\n"),
        "{text}"
    );
    assert!(text.contains("DEVICES  as of 2.0 s ago"), "{text}");
    // The estimator that was started again has other names: no torque until it has sent one.
    let mut snapshot = robot(3000);
    snapshot.describe(names(Publisher::Estimator, 3, &[(Role::Joint, "shoulder")]));
    let text = now(&mut snapshot, 3100).join("\n");
    assert!(
        text.contains("TORQUES  no estimate yet") && !text.contains("1.250"),
        "{text}"
    );
    snapshot.hear_torques(torques(3, after(3200), 7.5));
    let lines = now(&mut snapshot, 3200);
    assert!(
        row(&lines, "TORQUES", "shoulder").contains("7.500"),
        "{lines:?}"
    );
}

#[test]
fn it_says_what_it_waits_for_and_that_shared_memory_does_not_answer() {
    let mut snapshot = RobotState::default();
    "waiting: nobody is there".clone_into(&mut snapshot.trouble);
    snapshot.tick(START);
    let mut view = view_of(snapshot);
    let text = screen(&mut view, WIDE, START).join("\n");
    assert!(
        text.contains("waiting: nobody is there") && !text.contains("TORQUES"),
        "{text}"
    );
    assert!(text.contains("gateway   is not running"), "{text}");

    let mut view = view_of(robot(3000));
    let text = screen(&mut view, WIDE, after(8000)).join("\n");
    assert!(
        text.contains("shared memory has not answered for 5.0 s"),
        "{text}"
    );
    assert!(!text.contains("1.250"), "{text}");
}

#[test]
fn a_filter_shows_only_names_that_contain_it() {
    use KeyCode::{Backspace, Char, Enter, Esc};
    let mut view = view_of(robot(3000));
    let shown = |view: &mut Screen| screen(view, WIDE, after(3000)).join("\n");
    assert_eq!(
        press(&mut view, &[Char('/'), Char('E'), Char('L'), Char('q')]),
        Wish::Nothing
    );
    let text = shown(&mut view);
    assert!(
        text.contains("no name has this in it") && text.contains("filter: ELq_"),
        "{text}"
    );
    press(&mut view, &[Backspace, Char('B'), Enter]);
    let text = shown(&mut view);
    assert!(
        text.contains("  elbow ") && text.contains("filter: ELB  q quit"),
        "{text}"
    );
    assert!(
        !text.contains("  wrist ") && !text.contains("BUSES"),
        "{text}"
    );
    assert_eq!(press(&mut view, &[Esc]), Wish::Nothing);
    assert!(shown(&mut view).contains("  wrist "));
    press(&mut view, &[Char('/'), Char('f'), Char('o')]);
    let text = shown(&mut view);
    assert!(
        text.contains("  Foot ") && !text.contains("  hand "),
        "{text}"
    );
    press(&mut view, &[Esc]);
    assert!(shown(&mut view).contains("  hand "));
    assert_eq!(press(&mut view, &[Esc]), Wish::Quit);
    assert_eq!(press(&mut view, &[Char('q')]), Wish::Quit);
    press(&mut view, &[Char('/')]);
    let control_c = KeyEvent::new(Char('c'), KeyModifiers::CONTROL);
    assert_eq!(view.press(control_c), Wish::Quit);
}

#[test]
fn a_pause_keeps_the_picture() {
    let mut view = view_of(robot(3000));
    let before = screen(&mut view, WIDE, after(3000));
    press(&mut view, &[KeyCode::Char('p')]);
    let mut later = robot(6000);
    later.hear_torques(torques(2, after(6000), 9.0));
    view.show(later.clone());
    let paused = screen(&mut view, WIDE, after(6000));
    assert!(paused[0].starts_with("PAUSED  robot left"), "{paused:?}");
    assert_eq!(before[1..], paused[1..]);
    press(&mut view, &[KeyCode::Char(' ')]);
    view.show(later);
    let lines = screen(&mut view, WIDE, after(6000));
    assert!(
        row(&lines, "TORQUES", "elbow").contains("9.000"),
        "{lines:?}"
    );
}

#[test]
fn sections_are_reached_by_keys_and_robots_in_turn() {
    let mut view = view_of(robot(3000));
    let top = |view: &mut Screen, codes: &[KeyCode]| {
        press(view, codes);
        screen(view, (80, 12), after(3000))[3].clone()
    };
    assert!(top(&mut view, &[]).starts_with("TORQUES"));
    assert!(top(&mut view, &[KeyCode::Tab]).starts_with("CONTACTS"));
    assert!(
        top(&mut view, &[KeyCode::Down])
            .trim_start()
            .starts_with("contact ")
    );
    assert!(top(&mut view, &[KeyCode::Up, KeyCode::BackTab]).starts_with("TORQUES"));
    assert!(top(&mut view, &[KeyCode::BackTab]).starts_with("IDENTIFICATION"));
    assert!(top(&mut view, &[KeyCode::Home, KeyCode::PageDown]).starts_with("  Foot"));
    assert!(top(&mut view, &[KeyCode::End]).starts_with("IDENTIFICATION"));
    assert!(top(&mut view, &[KeyCode::Tab]).starts_with("TORQUES"));
    assert_eq!(
        press(&mut view, &[KeyCode::Char('r')]),
        Wish::Robot("right".into())
    );
}

#[test]
fn any_size_is_drawn() {
    for snapshot in [RobotState::default(), robot(3000)] {
        let mut view = view_of(snapshot);
        for (width, height) in (0..70).flat_map(|w| (0..25).map(move |h| (2 * w, 2 * h))) {
            let scroll = KeyCode::PageDown;
            press(
                &mut view,
                &[KeyCode::Char('?'), KeyCode::Tab, scroll, KeyCode::Char('p')],
            );
            screen(&mut view, (width, height), after(4000));
        }
    }
    let lines = screen(&mut view_of(robot(3000)), (40, 10), after(3000));
    assert!(
        row(&lines, "TORQUES", "elbow").contains("1.250  ± 0.100"),
        "{lines:?}"
    );
    assert!(
        row(&lines, "TORQUES", "wrist").contains("withheld: stale (wrist)"),
        "{lines:?}"
    );
}
