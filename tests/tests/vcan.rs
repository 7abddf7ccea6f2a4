//! The whole chain on a kernel CAN bus with third-party tools: canplayer, cansend, candump, cangen,
//! ip.
//!
//! Runs if PROPRIO_VCAN=1 is set, which means that vcan0 and vcan1 exist and belong to this test
//! (`tests/run --only vcan` provides them), one test at a time. User-mode Linux has one slow
//! processor: there the robot's periods are longer and the limit for recovery is 15 s instead of 1
//! s. `recovery.rs` measures the recovery without it.
#![allow(missing_docs)]

use proprio_drivers::{Claim, Frame};
use proprio_estimator::setup::Setup;
use proprio_gateway::clock::{Clock as _, Monotonic, sleep_until};
use proprio_gateway::decoder::Decoder;
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

    let told: serde_json::Value = serde_json::from_str(&simulator.output()).expect("a summary");
    let sent = told["sent"].as_u64().expect("a number");
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

/// A controller's error frames, which on a virtual interface any program may send: each cause is
/// counted, the first of a run is told in words, and bus-off is a state of the link.
#[test]
fn error_frames_reach_health_and_log() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let arm = Arm::slow()
        .on_interfaces(INTERFACES)
        .write(&rig.path("robot"));
    let mut gateway = gateway(&rig, &arm);
    let domain = rig.open();
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    health.wait("both links up", |h| {
        h.buses().iter().filter(|b| b.link == LinkState::Up).count() == 2
    });
    let errors = |h: &GatewayHealth, cause: BusError| h.buses()[0].errors[cause as usize];
    // Error passive in both directions with the error counters, ten times; then an overflow, and a
    // stuff error in the data length code.
    for _ in 0..10 {
        can::run("cansend vcan0 20000204#0030000000008087");
    }
    can::run("cansend vcan0 20000004#0001000000000000");
    can::run("cansend vcan0 20000008#0000040B00000000");
    let told = health.wait("the errors", |h| errors(h, BusError::Protocol) == 1);
    let bus = &told.buses()[0];
    assert_eq!(
        [BusError::Passive, BusError::RxOverflow, BusError::Bus].map(|c| errors(&told, c)),
        [10, 1, 0]
    );
    assert_eq!((bus.error_frames, bus.dropped), (12, 1));
    assert_eq!(told.buses()[1].error_frames, 0, "the other bus has none");
    // What the kernel knows of a virtual interface.
    let told = health.wait("the interface's totals", |h| {
        h.buses()[0].interface.rx_frames >= 12
    });
    assert_eq!(told.buses()[0].interface.fd, 1);

    // A bus-off with "back to active" in the same frame, as candleLight sends it, is only counted.
    for _ in 0..5 {
        can::run("cansend vcan0 20000044#004C0000007F7F00");
    }
    health.wait("the reports", |h| errors(h, BusError::BusOff) == 5);
    std::thread::sleep(Duration::from_millis(300));
    let told = health.fresh();
    assert_eq!(told.buses()[0].link, LinkState::Up);
    can::run("cansend vcan0 20000040#0000000000000000");
    health.wait("bus-off", |h| h.buses()[0].link == LinkState::BusOff);
    can::run("cansend vcan0 20000100#0000000000000000");
    let back = health.wait("up again", |h| h.buses()[0].link == LinkState::Up);
    assert_eq!(back.buses()[0].link_losses, 1);
    assert_eq!(back.buses()[1].link_losses, 0);
    drop((health, domain));
    gateway.end();
    let log = gateway.log();
    for (words, count) in [
        ("rx passive, tx passive; error counters: tx=128, rx=135", 1),
        ("receive buffer overflow", 1),
        ("protocol violation at data length code", 1),
        ("the link is bus_off", 1),
        ("the link is up again", 1),
    ] {
        assert_eq!(log.matches(words).count(), count, "{words:?} in\n{log}");
    }
    rig.assert_nothing_left();
}

/// Nothing leaves a gateway on a bus that it may only listen to, although its board is one that it
/// would start.
#[test]
fn nothing_is_sent_on_a_bus_to_listen_to() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let config = rig.path("gateway.toml");
    let plan = |listen_only: bool| {
        format!(
            "schema = 1\nrobot = \"listener\"\n[[bus]]\nname = \"bus\"\n\
             source = {{ kind = \"socketcan\", interface = \"vcan0\" }}\n\
             listen_only = {listen_only}\n[[bus.device]]\ndriver = \"icub_strain\"\n\
             name = \"ft\"\naddress = 1\nfull_scale_n = [1804.0, 1804.0, 1804.0]\n\
             full_scale_nm = [31.0, 31.0, 31.0]\n"
        )
    };
    for listen_only in [true, false] {
        fs::write(&config, plan(listen_only)).expect("a configuration");
        let dump = Candump::start(&rig, "vcan0", "", "7FF#");
        let mut gateway = rig.start(&["gateway", "--config", text(&config)]);
        let domain = rig.open();
        let mut health = Newest::<GatewayHealth>::open(&domain, "listener");
        health.wait("the link up", |h| {
            bus(h.buses(), "bus").link == LinkState::Up
        });
        for frame in ["31A#008000800080", "31B#008000800080"] {
            can::run(&format!("cansend vcan0 {frame}"));
        }
        health.wait("both frames", |h| bus(h.buses(), "bus").frames == 2);
        // The board is started again after 0.35 s of silence.
        std::thread::sleep(Duration::from_millis(1000));
        let sent = bus(health.fresh().buses(), "bus").sent;
        drop((health, domain));
        gateway.end();
        assert_eq!(sent == 0, listen_only, "{sent} sent");
        assert_eq!(dump.count() == 2, listen_only, "{}", dump.log());
    }
    rig.assert_nothing_left();
}

/// A scan that is not active sends nothing, and hears what others send.
#[test]
fn a_scan_of_an_interface_sends_nothing() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    for active in [false, true] {
        let dump = Candump::start(&rig, "vcan0", "", "7FF#");
        let mut arguments = vec!["scan", "--bus", "vcan0", "--seconds", "1"];
        if active {
            arguments.push("--active");
        }
        let mut scan = rig.start(&arguments);
        std::thread::sleep(Duration::from_millis(500));
        can::run("cansend vcan0 31A#008000800080");
        scan.wait();
        let output = scan.output();
        assert!(output.contains("31A"), "{output}");
        // Its questions are the others: all in classic frames and, on this interface, in CAN FD.
        assert_eq!(dump.count() == 1, !active, "{}", dump.log());
    }
}

/// The gateway's claims on bus number `number`, that is, its filters.
fn claims(plan: &Plan, number: usize) -> Vec<Claim> {
    let bus = &plan.buses[number];
    let status = Arc::new(BusStatus::new(0, bus));
    Decoder::new(0, bus, None, status)
        .expect("devices")
        .claims()
}

/// Random frames of every kind, and every configured identifier with every length. The gateway
/// counts each frame that passes its filters, for the same reasons as `proprio decode` on candump's
/// log, and keeps running.
#[test]
fn floods_are_counted() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let arm = Arm::slow()
        .on_interfaces(INTERFACES)
        .write(&rig.path("robot"));
    let plan = &arm.robot.plan;
    let dumps: Vec<Candump> = INTERFACES
        .iter()
        .enumerate()
        .map(|(number, interface)| {
            let claims = claims(plan, number);
            let probe = format!("{:03X}#", claims[0].id.raw());
            Candump::start(&rig, interface, &can::filter(&claims), &probe)
        })
        .collect();
    let mut gateway = gateway(&rig, &arm);
    let domain = rig.open();
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    health.wait("both links up", |h| {
        h.buses().iter().filter(|b| b.link == LinkState::Up).count() == 2
    });
    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let readings = |h: &GatewayHealth| {
        h.devices()
            .iter()
            .map(|d| count(d, Counter::Readings))
            .collect::<Vec<_>>()
    };
    let quiet = health.wait("readings of all", |h| readings(h).iter().all(|n| *n > 5));
    assert_eq!(
        quiet
            .devices()
            .iter()
            .map(|d| count(d, Counter::Length))
            .sum::<u64>(),
        0
    );

    let mut data = fastrand::Rng::with_seed(3);
    let mut log = String::new();
    for (number, interface) in INTERFACES.iter().enumerate() {
        for kind in ["", "-e", "-R", "-e -R", "-f", "-m"] {
            can::run(&format!(
                "cangen {interface} -g 0 -p 100 -I r -L r -D r -n 1500 {kind}"
            ));
        }
        for claim in claims(plan, number) {
            for length in (0..=8).cycle().take(45) {
                let bytes: String = (0..length)
                    .map(|_| format!("{:02X}", data.u8(..)))
                    .collect();
                log.push_str(&format!(
                    "(0.000000) {interface} {:03X}#{bytes}\n",
                    claim.id.raw()
                ));
            }
        }
    }
    let claimed = rig.path("claimed.log");
    fs::write(&claimed, log).expect("a log");
    can::run(&format!("canplayer -t -g 0 -I {}", claimed.display()));
    let flooded = health.fresh();
    let continued = health.within(recovery(), |h| {
        readings(h)
            .iter()
            .zip(readings(&flooded))
            .all(|(now, then)| *now > then + 5)
    });
    let continued = continued.expect("readings of all soon after the flood");
    // Each claimed identifier had 5 frames of each of the lengths 0 to 8, of which at most three
    // are legal.
    for device in continued.devices() {
        assert!(count(device, Counter::Length) >= 30, "{device:?}");
    }
    gateway.assert_runs();
    simulator.end();

    // All frames have been received and written when both numbers are equal and stay constant.
    let mut last = None;
    until(PATIENCE, || {
        std::thread::sleep(Duration::from_millis(300));
        let received: Vec<u64> = health
            .fresh()
            .buses()
            .iter()
            .map(|b| b.frames + b.dropped)
            .collect();
        let seen: Vec<u64> = dumps.iter().map(|dump| dump.count() as u64).collect();
        let equal = received == seen;
        (last.replace(seen.clone()) == Some(seen) && equal).then_some(())
    });
    let end = health.fresh();
    let log = rig.path("flood.log");
    fs::write(&log, dumps.iter().map(Candump::log).collect::<String>()).expect("a log");
    for (dump, bus) in dumps.iter().zip(end.buses()) {
        assert!(!dump.log().contains("DROP"), "candump itself lost frames");
        println!(
            "{}: candump {}, gateway {} and {} dropped",
            bus.name,
            dump.count(),
            bus.frames,
            bus.dropped
        );
        assert_eq!(bus.frames + bus.dropped, dump.count() as u64, "{bus:?}");
        assert_eq!(bus.unclaimed, 0);
    }
    // Compare by reason, if the gateway has received all frames that candump has.
    if end.buses().iter().all(|b| b.dropped == 0) {
        let table = rig.path("flood.csv");
        let decode = [
            "decode",
            "--config",
            &arm.gateway,
            "--log",
            text(&log),
            "--out",
            text(&table),
            "--json",
        ];
        let decoded: serde_json::Value =
            serde_json::from_slice(&rig.run(&decode).stdout).expect("a summary");
        for (device, offline) in end
            .devices()
            .iter()
            .zip(decoded["devices"].as_array().expect("devices"))
        {
            assert_eq!(offline["name"], device.name.as_str());
            assert_eq!(
                offline["frames"],
                count(device, Counter::Frames),
                "{offline}"
            );
            // The gateway accepts an IMU's answers only after a question, but `decode` only
            // listens.
            if device.name.as_str() == "chest_imu" {
                continue;
            }
            for counter in [Counter::Length, Counter::Value] {
                let counted = offline["counts"]
                    .get(counter.word())
                    .and_then(serde_json::Value::as_u64)
                    .unwrap_or(0);
                assert_eq!(
                    counted,
                    count(device, counter),
                    "{} of {offline}",
                    counter.word()
                );
            }
        }
    }
    drop((health, domain));
    gateway.end();
    assert!(!gateway.log().contains("panicked"));
    rig.assert_nothing_left();
}

// --- Order and time
// --------------------------------------------------------------------------------

/// 31A 32A 31B 32B: two boards on one bus whose halves interleave.
#[test]
fn interleaved_boards_keep_their_own_halves() {
    if !vcan() {
        return;
    }
    let rig = Rig::new();
    let config = rig.path("gateway.toml");
    let board = |address: u32, scale: u32| {
        format!(
            "[[bus.device]]\ndriver = \"icub_strain\"\nname = \"ft{address}\"\n\
             address = {address}\nlisten_only = true\n\
             max_silence_ms = 5000\npair_timeout_ms = 500.0\n\
             full_scale_n = [{scale}, {scale}, {scale}]\n\
             full_scale_nm = [{scale}, {scale}, {scale}]\n"
        )
    };
    // The first board has a step of 1, the second of 2.
    let source = "schema = 1\nrobot = \"pair\"\n[[bus]]\nname = \"bus\"\n\
                  source = { kind = \"socketcan\", interface = \"vcan0\" }\n";
    fs::write(
        &config,
        format!("{source}{}{}", board(1, 32768), board(2, 65535)),
    )
    .expect("a configuration");
    let mut gateway = rig.start(&["gateway", "--config", text(&config)]);
    let domain = rig.open();
    let mut recorder = Recorder::of_samples(&domain, "pair");
    let mut health = Newest::<GatewayHealth>::open(&domain, "pair");
    health.wait("the link up", |h| {
        bus(h.buses(), "bus").link == LinkState::Up
    });

    // A reader's buffer holds those of both boards.
    let (readings, mut log) = (100_u32, String::new());
    for k in 0..readings {
        // Every half contains its reading's number: force k, torque k + 1000; those of the second
        // board are 5000 higher.
        for (n, (id, value)) in [
            (0x31A, k),
            (0x32A, k + 5000),
            (0x31B, k + 1000),
            (0x32B, k + 6000),
        ]
        .into_iter()
        .enumerate()
        {
            let [low, high] = u16::try_from(0x8000 + value)
                .expect("16 bits")
                .to_le_bytes();
            let t = 1.0 + 0.005 * f64::from(k) + 0.0002 * n as f64;
            log.push_str(&format!(
                "({t:.6}) can7 {id:03X}#{}\n",
                format!("{low:02X}{high:02X}").repeat(3)
            ));
        }
    }
    let file = rig.path("interleaved.log");
    fs::write(&file, log).expect("a log");
    can::run(&format!("canplayer -I {} vcan0=can7", file.display()));
    until(PATIENCE, || {
        recorder.take();
        (recorder.taken.len() >= 2 * readings as usize).then_some(())
    });
    for (number, (first, unit)) in [(0.0, 1.0), (5000.0, 65535.0 / 32768.0)]
        .into_iter()
        .enumerate()
    {
        let samples: Vec<_> = recorder
            .taken
            .iter()
            .filter(|s| s.channel as usize == number)
            .collect();
        assert_eq!(samples.len(), readings as usize, "board {number}");
        for (k, sample) in samples.iter().enumerate() {
            let Reading::Wrench(wrench) = sample.reading().unwrap() else {
                panic!("{sample:?}")
            };
            let force = (first + k as f64) * unit;
            assert_eq!(
                (wrench.force, wrench.torque),
                ([force; 3], [force + 1000.0 * unit; 3]),
                "reading {k}"
            );
            assert_eq!(sample.header.quality.0, 0);
        }
    }
    let end = health.fresh();
    assert!(
        end.devices()
            .iter()
            .all(|d| count(d, Counter::Unpaired) == 0),
        "{:?}",
        end.devices()
    );
    drop((recorder, health, domain));
    gateway.end();
    rig.assert_nothing_left();
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

/// The second bus is delayed, by half a millisecond and by more than the wait of an estimate. No
/// value gets to a wrong channel, every stamp of the trigger gives one estimate, and the estimates
/// equal those of `proprio estimate`, bit for bit.
#[test]
fn skewed_buses_are_not_mixed_up() {
    if !vcan() {
        return;
    }
    // Periods of F/T, IMU and joints, how long an estimate waits, and the skew [ms]. In the first
    // case each estimate has all channels; in the second the joints are later, and have a longer
    // period, than the wait of an estimate. The wait ends as far before a stamp of the trigger as
    // possible, so that the result does not depend on which bus's thread runs first.
    for (periods, max_wait, skew) in [([10, 20, 20], 250.0, 0.5), ([20, 20, 80], 41.0, 60.0)] {
        // If the machine stalls for longer than the wait, samples are late: then try again.
        let mut outcome = Ok(());
        for _ in 0..5 {
            outcome = skewed_buses(periods, max_wait, Nanos::from_seconds(skew * 1e-3));
            match &outcome {
                Err(stalled) => println!("{stalled}"),
                Ok(()) => break,
            }
        }
        assert_eq!(outcome, Ok(()));
    }
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
        let own = recorder
            .taken
            .iter()
            .filter(|s| s.channel == number)
            .all(|s| s.header.bus as usize == channel.bus);
        assert!(own, "{}", channel.name);
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
