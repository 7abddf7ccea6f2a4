//! The whole chain on a kernel CAN bus with third-party tools: canplayer, cansend, candump, cangen,
//! ip.
//!
//! Runs if PROPRIO_VCAN=1 is set, which means that vcan0 and vcan1 exist and belong to this test
//! (`tests/run --only vcan` provides them), one test at a time. User-mode Linux has one slow
//! processor: there the robot's periods are longer and the limit for recovery is 15 s instead of 1
//! s. `recovery.rs` measures the recovery without it.
#![allow(missing_docs)]

mod traffic;

use proprio_drivers::{Claim, Frame};
use proprio_estimator::setup::Setup;
use proprio_gateway::clock::{Clock as _, Monotonic, sleep_until};
use proprio_gateway::devices::BusDevices;
use proprio_gateway::link::send_by;
use proprio_gateway::link::socketcan::SocketCan;
use proprio_gateway::log;
use proprio_gateway::plan::Plan;
use proprio_gateway::status::BusStatus;
use proprio_simulator::{SimulationSettings, record};
use proprio_tests::can::{self, Candump, vcan};
use proprio_tests::watch::{
    Newest, Recorder, Truth, all_valid, bus, count, open, rows, table_by_channel, valid_since,
};
use proprio_tests::{Arm, PATIENCE, Process, Rig, Written, now, uml, until};
use proprio_topics::{
    BusError, Counter, EstimatorHealth, GatewayHealth, LinkState, Nanos, Reading, TorqueEstimate,
};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufReader, BufWriter};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

const ROBOT: &str = "icub_left_arm";

const INTERFACES: [&str; 2] = ["vcan0", "vcan1"];

/// Maximum recovery time of the chain: a second; longer in user-mode Linux, see above.
fn recovery() -> Nanos {
    Nanos::from_millis(if uml() { 15_000 } else { 1000 })
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// A gateway with open links.
fn gateway(rig: &Rig, arm: &Written) -> Process {
    rig.start(&["gateway", "--config", &arm.gateway])
}

fn estimator(rig: &Rig, arm: &Written) -> Process {
    rig.start(&["estimator", "--config", &arm.estimator])
}

// --- A recorded log
// --------------------------------------------------------------------------------

/// A log played by canplayer gives the same samples as `proprio decode`, value for value. The log
/// contains the conversation with the boards, from which a listening gateway gets the full scales.
#[test]
fn a_played_log_gives_what_decode_gives() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let unscaled = Arm::slow()
        .patience(5000.0, 100.0)
        .each_device(|driver, device| {
            if driver == "icub_strain" {
                device.remove("full_scale_n");
                device.remove("full_scale_nm");
            }
        });
    let recorded = unscaled
        .clone()
        .on_virtual(["board_a", "board_b"])
        .write(&rig.path("recorded"));
    let listening = unscaled.on_interfaces(INTERFACES).each_device(|_, device| {
        device.insert("listen_only".into(), true.into());
    });
    let listening = listening.write(&rig.path("listening"));
    let log = rig.path("session.log");
    let faults = [
        "saturate:l_arm_ft_sensor@1.2..1.4",
        "spike:l_arm_ft_sensor@1.7",
    ];
    let settings = SimulationSettings {
        faults: faults.map(|f| f.parse().expect("a fault")).to_vec(),
        ..SimulationSettings::default()
    };
    let out = BufWriter::new(File::create(&log).expect("a log"));
    record::record(&recorded.robot, &settings, 2.5, Nanos(1_000_000_000), out).expect("a session");

    let table = rig.path("decoded.csv");
    let decode = [
        "decode",
        "--config",
        &recorded.gateway,
        "--log",
        text(&log),
        "--out",
        text(&table),
        "--all",
        "--json",
    ];
    let decoded: serde_json::Value =
        serde_json::from_slice(&rig.run(&decode).stdout).expect("a summary");
    let samples = decoded["samples"].as_u64().expect("a number") as usize;

    let mut gateway = gateway(&rig, &listening);
    let domain = rig.open();
    let mut recorder = Recorder::of_samples(&domain, ROBOT);
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    health.wait("both links up", |h| {
        h.buses().iter().filter(|b| b.link == LinkState::Up).count() == 2
    });
    let player = can::tool(&format!(
        "canplayer -I {} vcan0=board_a vcan1=board_b",
        log.display()
    ));
    let mut player = rig.spawn(player, "canplayer");
    let all = until(PATIENCE, || {
        recorder.take();
        (player.ended().is_some() && recorder.taken.len() >= samples).then_some(())
    });
    player.wait();
    assert!(
        all.is_some(),
        "{} samples instead of {samples}",
        recorder.taken.len()
    );
    std::thread::sleep(Duration::from_millis(200));
    recorder.take();
    assert_eq!((recorder.taken.len(), recorder.lost()), (samples, 0));

    let names: Vec<&str> = listening
        .robot
        .plan
        .channels
        .iter()
        .map(|c| c.name.as_str())
        .collect();
    let live: BTreeMap<String, Vec<String>> = recorder
        .by_channel()
        .into_iter()
        .map(|(number, values)| (names[number as usize].to_owned(), values))
        .collect();
    let offline = table_by_channel(&table);
    assert_eq!(live.len(), 9);
    assert_eq!(
        live.keys().collect::<Vec<_>>(),
        offline.keys().collect::<Vec<_>>()
    );
    for (channel, values) in &live {
        assert_eq!(values.len(), offline[channel].len(), "{channel}");
        for (number, (live, offline)) in values.iter().zip(&offline[channel]).enumerate() {
            assert_eq!(live, offline, "{channel}, sample {number}");
        }
    }
    let saturated = recorder
        .taken
        .iter()
        .any(|s| s.header.quality.contains(proprio_topics::Quality::FROZEN));
    assert!(saturated, "the log has saturated samples");
    for (bus, sent) in health.fresh().buses().iter().zip([0, 0]) {
        assert_eq!(
            (bus.sent, bus.dropped),
            (sent, 0),
            "a listening gateway sends nothing"
        );
    }
    println!("{samples} samples of 9 channels, value for value");
    drop((recorder, health, domain));
    gateway.end();
    rig.assert_nothing_left();
}

// --- The chain against the truth
// --------------------------------------------------------------------------------

#[test]
fn torques_agree_with_the_truth() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let mut arm = Arm::slow().on_interfaces(INTERFACES);
    if uml() {
        // If the simulator is preempted between measuring and sending, a stamp is late by
        // milliseconds, and a position that changes by 1 rad/s is wrong accordingly.
        arm = arm.position_noise(5e-3);
    }
    let arm = arm.write(&rig.path("robot"));
    let (mut gateway, mut estimator) = (gateway(&rig, &arm), estimator(&rig, &arm));
    let domain = rig.open();
    let mut recorder = Recorder::of_all(&domain, ROBOT);
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    let mut estimator_health = Newest::<EstimatorHealth>::open(&domain, ROBOT);
    health.wait("both links up", |h| {
        h.buses().iter().filter(|b| b.link == LinkState::Up).count() == 2
    });
    let truth = rig.path("truth.csv");
    let mut simulator = rig.start(&[
        "simulate",
        "--robot",
        &arm.folder,
        "--seconds",
        "7",
        "--truth",
        text(&truth),
        "--json",
    ]);
    let ended = until(PATIENCE, || {
        recorder.take();
        simulator.ended()
    });
    assert!(ended.is_some(), "the simulator does not end");
    simulator.wait();
    recorder.take();

    let summary: serde_json::Value = serde_json::from_str(&simulator.output()).expect("a summary");
    let sent = summary["sent"].as_u64().expect("a number");
    let health = health.fresh();
    let frames: u64 = health.buses().iter().map(|b| b.frames).sum();
    let dropped: u64 = health
        .buses()
        .iter()
        .map(|b| b.dropped + b.publish_failures)
        .sum();
    assert_eq!(
        (sent.abs_diff(frames), dropped),
        (0, 0),
        "{sent} frames sent, {frames} received"
    );
    let estimator_health = estimator_health.fresh();
    assert_eq!(
        (
            estimator_health.lost,
            estimator_health.backward,
            recorder.lost()
        ),
        (0, 0, 0)
    );
    let published: u64 = health.buses().iter().map(|b| b.published).sum();
    assert_eq!(recorder.taken.len() as u64, published);

    let setup = Setup::new(&arm.robot.config).expect("the robot's model");
    let joints: Vec<&str> = setup.robot.joint_names().collect();
    let truth = Truth::read(&truth, &joints);
    let first = *recorder.estimates.keys().next().expect("estimates");
    let settled = || {
        recorder
            .estimates
            .values()
            .filter(|e| e.t > first + Nanos::from_millis(1000))
            .map(|e| &e.torques)
    };
    let valid = settled().filter(|e| all_valid(e)).count() as f64 / settled().count() as f64;
    println!(
        "{sent} frames, {published} samples, {} estimates, {:.2} % valid, {} late samples",
        recorder.estimates.len(),
        100.0 * valid,
        estimator_health.late
    );
    for (joint, name) in joints.iter().enumerate() {
        let mut errors = truth.errors(joint, settled());
        let all = rms(&errors);
        errors.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
        let most = errors.len() * 98 / 100;
        let (most, number) = (rms(&errors[..most]), errors.len());
        println!(
            "  {name:<20} RMS error {all:.4} Nm over {number} estimates, {most:.4} Nm without the \
             worst 2 %"
        );
        let error = if uml() { most } else { all };
        assert!(
            number > 200 && error < 0.15,
            "{name}: RMS error {error} Nm over {number} estimates"
        );
    }
    assert!(valid > 0.99, "valid share {valid}");
    drop((recorder, domain));
    estimator.end();
    gateway.end();
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

/// The demonstration on kernel buses: on two interfaces, and on one for all devices.
#[test]
fn the_demonstration_runs_on_interfaces() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let arm = Arm::slow().write(&rig.path("robot"));
    for interfaces in [&INTERFACES[..], &INTERFACES[..1]] {
        let out = rig.path("demo");
        let mut arguments = vec![
            "demo",
            "--robot",
            &arm.folder,
            "--seconds",
            "10",
            "--out",
            text(&out),
        ];
        interfaces
            .iter()
            .for_each(|i| arguments.extend(["--bus", i]));
        rig.run(&arguments);
        let summary = fs::read_to_string(out.join("summary.json")).expect("a summary");
        let summary: serde_json::Value = serde_json::from_str(&summary).expect("JSON");
        let number = |value: &serde_json::Value, key: &str| {
            let number = value.get(key).and_then(serde_json::Value::as_f64);
            number.unwrap_or_else(|| panic!("{key} is not a number in {value}"))
        };
        for key in ["frames", "samples", "estimates", "rate_hz", "valid_share"] {
            assert!(number(&summary, key) > 0.0, "{key}: {summary}");
        }
        assert_eq!(number(&summary, "lost"), 0.0, "{summary}");
        for key in ["p50", "p99", "p999"] {
            assert!(number(&summary["latency_us"], key) > 0.0, "{key}");
        }
        let errors = summary["torque_rms_error_nm"]
            .as_object()
            .expect("an error per joint");
        assert_eq!(errors.len(), 7);
        // On a slow machine the joints before the sensor may have no valid torque in this time.
        for (joint, error) in errors {
            let valid = number(&summary["valid_estimates"], joint);
            assert_eq!(error.is_number(), valid > 0.0, "{joint}: {summary}");
        }
        assert!(errors["l_elbow"].is_number(), "{summary}");
        for file in [
            "report.html",
            "estimates.csv",
            "gateway.log",
            "estimator.log",
            "simulate.log",
        ] {
            assert!(out.join(file).is_file(), "{file}");
        }
        println!(
            "{} interfaces: {} frames, {} estimates",
            interfaces.len(),
            summary["frames"],
            summary["estimates"]
        );
    }
}

// --- What goes wrong
// --------------------------------------------------------------------------------

/// The running chain on both interfaces, and its readers.
struct Chain {
    torques: proprio_topics::ipc::Reader<TorqueEstimate>,
    health: Newest<GatewayHealth>,
    estimator_health: Newest<EstimatorHealth>,
    domain: proprio_topics::ipc::Domain,
    simulator: Process,
    gateway: Process,
    estimator: Process,
    arm: Written,
    rig: Rig,
}

impl Chain {
    fn start() -> Self {
        let rig = Rig::new();
        let arm = Arm::slow()
            .on_interfaces(INTERFACES)
            .write(&rig.path("robot"));
        let simulator = rig.start(&["simulate", "--robot", &arm.folder]);
        let (gateway, estimator) = (gateway(&rig, &arm), estimator(&rig, &arm));
        let domain = rig.open();
        let mut this = Self {
            torques: open(&domain, ROBOT),
            health: Newest::open(&domain, ROBOT),
            estimator_health: Newest::open(&domain, ROBOT),
            domain,
            simulator,
            gateway,
            estimator,
            arm,
            rig,
        };
        this.recovers(now(), PATIENCE, "at the start");
        this
    }

    /// Time from `since` until a valid estimate of a later instant arrives.
    fn recovers(&mut self, since: Nanos, limit: Nanos, what: &str) -> Nanos {
        let valid = valid_since(&mut self.torques, since, PATIENCE);
        assert!(
            valid.is_some(),
            "{what}: no valid estimate; {:?}",
            self.health.get()
        );
        let took = now() - since;
        [&mut self.simulator, &mut self.gateway, &mut self.estimator]
            .into_iter()
            .for_each(Process::assert_runs);
        assert!(
            took <= limit,
            "{what}: recovered after {:.3} s, more than {:.3} s",
            took.seconds(),
            limit.seconds()
        );
        took
    }

    fn end(self) {
        let Self {
            mut simulator,
            mut gateway,
            mut estimator,
            rig,
            ..
        } = self;
        drop((
            self.torques,
            self.health,
            self.estimator_health,
            self.domain,
        ));
        [&mut simulator, &mut estimator, &mut gateway]
            .into_iter()
            .for_each(Process::end);
        for log in [gateway.log(), estimator.log(), simulator.log()] {
            assert!(!log.contains("panicked"), "{log}");
        }
        rig.assert_nothing_left();
    }
}

#[test]
fn the_chain_recovers_from_kills() {
    if !vcan() {
        return;
    }
    let mut chain = Chain::start();
    let segments = chain.rig.settled_segments().len();
    let mut random = fastrand::Rng::with_seed(11);
    let startup = if uml() { 1500.0 } else { 15.0 };
    let begin = now();
    chain
        .rig
        .run(&["gateway", "--config", &chain.arm.gateway, "--check"]);
    println!(
        "a program takes {:.0} ms to start, read its configuration and end",
        (now() - begin).seconds() * 1e3
    );
    let mut most = Nanos::ZERO;
    for kill in 0..10 {
        let (victim, at_startup) = (kill % 2, kill / 2 % 2 == 0);
        let start = |chain: &Chain| {
            if victim == 0 {
                gateway(&chain.rig, &chain.arm)
            } else {
                estimator(&chain.rig, &chain.arm)
            }
        };
        let process = |chain: &mut Chain, new: Option<Process>| {
            let place = if victim == 0 {
                &mut chain.gateway
            } else {
                &mut chain.estimator
            };
            match new {
                Some(new) => *place = new,
                None => place.kill(),
            }
        };
        let mut wait = Duration::from_millis(150).mul_f64(random.f64());
        if at_startup {
            process(&mut chain, None);
            let new = start(&chain);
            process(&mut chain, Some(new));
            wait = Duration::from_secs_f64(startup * 1e-3 * random.f64());
        }
        std::thread::sleep(wait);
        process(&mut chain, None);
        let restarted = now();
        let new = start(&chain);
        process(&mut chain, Some(new));
        let what = format!(
            "{} killed {:.1} ms {}",
            ["gateway", "estimator"][victim],
            wait.as_secs_f64() * 1e3,
            if at_startup {
                "after its start"
            } else {
                "while running"
            }
        );
        let took = chain.recovers(restarted, recovery(), &what);
        println!("{what}: recovered after {:.0} ms", took.seconds() * 1e3);
        most = most.max(took);
    }
    let settled = until(PATIENCE, || {
        chain.health.get();
        chain.estimator_health.get();
        let _ = valid_since(&mut chain.torques, Nanos::MAX, Nanos::ZERO);
        (chain.rig.segments().len() <= segments).then_some(())
    });
    assert!(
        settled.is_some(),
        "instead of {segments} segments: {:#?}",
        chain.rig.segments()
    );
    println!("10 kills, at worst {:.0} ms", most.seconds() * 1e3);
    chain.end();
}

#[test]
fn interfaces_go_and_come_back() {
    if !vcan() {
        return;
    }
    let mut chain = Chain::start();
    let names: Vec<String> = chain
        .arm
        .robot
        .plan
        .buses
        .iter()
        .map(|b| b.name.clone())
        .collect();
    let mut losses = [0, 0];
    for (interface, deleted) in [(1, false), (0, false), (1, true), (0, true), (1, false)] {
        let name = INTERFACES[interface];
        let other = &names[1 - interface];
        let before = bus(chain.health.fresh().buses(), other).frames;
        let (state, goes) = if deleted {
            (LinkState::Gone, "del")
        } else {
            (LinkState::Down, "set down dev")
        };
        can::run(&format!("ip link {goes} {name}"));
        losses[interface] += 1;
        let lost = chain.health.wait("the loss", |h| {
            bus(h.buses(), &names[interface]).link == state
        });
        assert_eq!(
            bus(lost.buses(), &names[interface]).link_losses,
            losses[interface]
        );
        assert_eq!(bus(lost.buses(), other).link, LinkState::Up);
        // The other bus continues.
        chain.health.wait("frames of the other bus", |h| {
            bus(h.buses(), other).frames > before
        });
        std::thread::sleep(Duration::from_millis(300));
        if deleted {
            can::add_interface(name);
        } else {
            can::run(&format!("ip link set up dev {name}"));
        }
        let back = now();
        let what = format!(
            "{name} {}",
            if deleted {
                "deleted and made anew"
            } else {
                "down and up"
            }
        );
        let took = chain.recovers(back, recovery(), &what);
        let healthy = chain.health.wait("the link up", |h| {
            bus(h.buses(), &names[interface]).link == LinkState::Up
        });
        assert_eq!(
            bus(healthy.buses(), &names[interface]).link_losses,
            losses[interface]
        );
        println!("{what}: recovered after {:.0} ms", took.seconds() * 1e3);
    }
    let log = chain.gateway.log();
    for told in [
        "the link is down",
        "the link is gone",
        "the link is up again",
    ] {
        assert!(
            log.contains(told),
            "{told:?} is not in the gateway's log:\n{log}"
        );
    }
    chain.end();
}

/// The gateway's claims on bus number `number`, that is, its filters.
fn claims(plan: &Plan, number: usize) -> Vec<Claim> {
    let bus = &plan.buses[number];
    let status = Arc::new(BusStatus::new(0, bus));
    BusDevices::new(0, bus, None, status)
        .expect("devices")
        .claims()
}

/// Plays `frames` (time, interface, frame) at their times.
fn play(frames: &[(Nanos, usize, Frame)], mut meanwhile: impl FnMut()) {
    let mut links =
        INTERFACES.map(|interface| SocketCan::open(interface, &[]).expect("an interface"));
    let Some((begin, ..)) = frames.first() else {
        return;
    };
    let start = Monotonic.now() + Nanos::from_millis(50) - *begin;
    for (t, interface, frame) in frames {
        sleep_until(start + *t);
        send_by(&mut links[*interface], frame, Monotonic.now() + PATIENCE)
            .expect("a frame can be sent");
        meanwhile();
    }
}

/// The frames of a log in order, with those of the second interface delayed by `skew`.
fn skewed(log: &Path, interfaces: [&str; 2], skew: Nanos) -> Vec<(Nanos, usize, Frame)> {
    let mut reader = log::LogReader::new(BufReader::new(File::open(log).expect("the log")));
    let mut frames = Vec::new();
    while let Some(record) = reader.next_record().expect("a log") {
        let interface = interfaces
            .iter()
            .position(|i| *i == record.interface)
            .expect("one of the two");
        let t = record.stamp.expect("a stamp") + if interface == 1 { skew } else { Nanos::ZERO };
        frames.push((t, interface, record.frame));
    }
    frames.sort_by_key(|(t, ..)| *t);
    frames
}

/// Plays one session; an error may be the result of a stall.
fn skewed_buses(
    [force_torque, imu, motors]: [i64; 3],
    max_wait: f64,
    skew: Nanos,
) -> Result<(), String> {
    let rig = Rig::new();
    let arm = Arm::slow()
        .periods(force_torque, imu, motors)
        .patience(1000.0, max_wait)
        .on_interfaces(INTERFACES)
        .each_device(|_, device| {
            device.insert("listen_only".into(), true.into());
        });
    let arm = arm.write(&rig.path("robot"));
    let log = rig.path("session.log");
    let out = BufWriter::new(File::create(&log).expect("a log"));
    record::record(
        &arm.robot,
        &SimulationSettings::default(),
        3.0,
        Nanos(1_000_000_000),
        out,
    )
    .expect("a session");

    let (mut gateway, mut estimator) = (gateway(&rig, &arm), estimator(&rig, &arm));
    let domain = rig.open();
    let mut recorder = Recorder::of_all(&domain, ROBOT);
    let mut health = Newest::<EstimatorHealth>::open(&domain, ROBOT);
    // Send motor states, which no estimate uses, until the estimator knows the channels.
    let mut before = None;
    health.wait("samples that the estimator knows", |h| {
        INTERFACES
            .iter()
            .for_each(|i| can::run(&format!("cansend {i} 113#0600000000000000")));
        std::thread::sleep(Duration::from_millis(150));
        let known = before.is_some_and(|b: EstimatorHealth| {
            h.samples > b.samples && h.unknown_channel == b.unknown_channel
        });
        before = Some(*h);
        known
    });
    recorder.take();
    recorder.taken.clear();
    play(&skewed(&log, INTERFACES, skew), || recorder.take());
    std::thread::sleep(Duration::from_millis(500));
    recorder.take();
    let health = health.fresh();
    assert_eq!((health.lost, recorder.lost(), health.backward), (0, 0, 0));
    drop(domain);

    // Each value is in the same channel as with decode.
    let table = rig.path("decoded.csv");
    rig.run(&[
        "decode",
        "--config",
        &arm.gateway,
        "--log",
        text(&log),
        "--out",
        text(&table),
        "--all",
    ]);
    let plan = &arm.robot.plan;
    let offline = table_by_channel(&table);
    for (number, values) in recorder.by_channel() {
        let channel = &plan.channels[number as usize];
        assert_eq!(values, offline[&channel.name], "{}", channel.name);
        let all_there = recorder
            .taken
            .iter()
            .filter(|s| s.channel == number)
            .all(|s| s.header.bus as usize == channel.bus);
        assert!(all_there, "{}", channel.name);
    }

    let samples = rig.path("samples.csv");
    let channels: Vec<_> = plan
        .channels
        .iter()
        .map(|c| (c.kind, c.name.clone()))
        .collect();
    recorder.write_samples(&channels, &samples);
    let estimates = rig.path("estimates.csv");
    let estimate = [
        "estimate",
        "--config",
        &arm.estimator,
        "--log",
        text(&samples),
        "--out",
        text(&estimates),
        "--json",
    ];
    let summary: serde_json::Value =
        serde_json::from_slice(&rig.run(&estimate).stdout).expect("a summary");
    assert_eq!(summary["late"], 0);
    estimator.end();
    gateway.end();
    println!(
        "skew {:.1} ms, wait {max_wait} ms: {} samples, {} estimates, {} late",
        skew.seconds() * 1e3,
        recorder.taken.len(),
        recorder.estimates.len(),
        health.late
    );
    if health.late > 0 {
        return Err(format!("{} samples were late", health.late));
    }
    let setup = Setup::new(&arm.robot.config).expect("the robot's model");
    let offline = rows(&fs::read_to_string(&estimates).expect("estimates"));
    let live = recorder.estimate_rows(&setup);
    // Including the header. The last instants, which still wait for samples at the end, are not
    // estimated live.
    let rest = offline.len() - live.len();
    assert!(
        rest <= 3 + (max_wait / 10.0) as usize,
        "{} estimates live, {} offline",
        live.len(),
        offline.len()
    );
    let different = live
        .iter()
        .filter(|(t, row)| offline.get(*t) != Some(row))
        .count();
    if different > 0 {
        return Err(format!("{different} of {} estimates differ", live.len()));
    }
    let valid = recorder
        .estimates
        .values()
        .filter(|e| all_valid(&e.torques))
        .count();
    let least = recorder.estimates.len() * 9 / 10;
    if valid <= least {
        // Late frames have late stamps, which makes the motion uncertain.
        return Err(format!("{valid} valid of {}", recorder.estimates.len()));
    }
    let triggers = recorder
        .taken
        .iter()
        .filter(|s| plan.channels[s.channel as usize].name == "l_arm_ft_sensor");
    assert_eq!(
        triggers.count() + 1,
        offline.len(),
        "one estimate for each stamp of the trigger"
    );
    Ok(())
}
