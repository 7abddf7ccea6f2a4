//! A simulated arm with coupled motors in the shoulder and two devices at the elbow, of which one
//! wraps: its gateway's samples are the simulator's truth. Once without links and clocks, to the
//! last step; once as processes on virtual buses.
#![allow(missing_docs)]

use proprio_drivers::State;
use proprio_gateway::devices::BusDevices;
use proprio_gateway::status::BusStatus;
use proprio_simulator::simulator::JOINT_NOISE;
use proprio_simulator::{SimulatedRobot, Simulation, SimulationSettings, Simulator};
use proprio_tests::watch::{Newest, Recorder};
use proprio_tests::{Arm, PATIENCE, Rig, now, until};
use proprio_topics::{DeviceState, GatewayHealth, Nanos, Quality, Reading, Sample, StampKind};
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

const ROBOT: &str = "icub_left_arm";

/// Half a step of a motor's position behind its gear \[rad\], and of its velocity \[rad/s\].
const HALF_POSITION: f64 = 0.5 * TAU / 65536.0 / 100.0;
const HALF_VELOCITY: f64 = HALF_POSITION * 1000.0;
/// Half a step of the elbow's encoder \[rad\].
const HALF_ENCODER: f64 = 0.5 * TAU / 65536.0;
/// The largest sums of the shoulder's matrix and of its inverse.
const ROW: f64 = 1.615;
const INVERSE: f64 = 3.0 / 0.615;
/// The period of all boards \[s\].
const PERIOD: f64 = 4e-3;

/// The bus of the motors. `turns` are more keys of the second motor.
fn motors(bus: &str, turns: &str) -> String {
    let mut text = format!(
        "[[bus]]\nname = \"left_arm_motors\"\nlisten_only = true\n\
         source = {{ kind = \"virtual\", name = \"{bus}\" }}\n"
    );
    let names = [
        "motor_1",
        "motor_2",
        "motor_3",
        "l_elbow",
        "l_wrist_prosup",
        "l_wrist_pitch",
        "l_wrist_yaw",
    ];
    for (name, address) in names.iter().zip(1..) {
        let more = match *name {
            "motor_2" => turns,
            "l_elbow" => "takes = [\"velocity\", \"current\"]\n",
            _ => "",
        };
        write!(
            text,
            "[[bus.device]]\ndriver = \"icub_motor\"\nname = \"board_{address}\"\n\
             address = {address}\nperiod_ms = 4\nmax_silence_ms = 1000\n\
             [[bus.device.joint]]\nname = \"{name}\"\nratio = 100.0\n{more}"
        )
        .expect("text");
    }
    text += "[[bus.device]]\ndriver = \"canopen_encoder\"\nname = \"elbow_encoder\"\naddress = 20\n\
             period_ms = 4\ncounts_per_turn = 65536\nmax_silence_ms = 1000\n\
             [[bus.device.joint]]\nname = \"l_elbow\"\ntakes = [\"position\"]\noffset_rad = 1.0\n\
             wraps_rad = [0.0, 6.283185307179586]\ncentre_rad = 1.0\nmax_speed_radps = 2.0\n\
             [[bus.coupling]]\n\
             joints = [\"l_shoulder_pitch\", \"l_shoulder_roll\", \"l_shoulder_yaw\"]\n\
             motors = [\"motor_1\", \"motor_2\", \"motor_3\"]\n\
             matrix = [[1.0, 0.0, 0.0], [1.0, 0.615, 0.0], [0.0, -0.615, 0.615]]\n";
    text
}

/// Writes the arm with these motors into `folder`, its buses named after `bus`.
fn write(folder: &Path, bus: &str, turns: &str) -> SimulatedRobot {
    let names = [&format!("{bus}a"), "none"];
    let arm = Arm::new()
        .patience(1000.0, 100.0)
        .on_virtual(names.map(|name| name as &str));
    let _ = arm.write(folder);
    let file = folder.join("gateway.toml");
    let mut gateway = arm.gateway;
    let buses = gateway.get_mut("bus").and_then(toml::Value::as_array_mut);
    buses.expect("a list of buses").truncate(1);
    let text = format!("{gateway}\n{}", motors(&format!("{bus}b"), turns));
    std::fs::write(file, text).expect("a configuration can be written");
    SimulatedRobot::load(folder).unwrap_or_else(|error| panic!("{error}"))
}

/// The joint's name and state, of a sample that is a joint's.
fn state<'r>(robot: &'r SimulatedRobot, sample: &Sample) -> Option<(&'r str, [f64; 2])> {
    match sample.reading()? {
        Reading::Joint(joint) => {
            let name = &robot.plan.channels.get(sample.channel as usize)?.name;
            Some((name, [joint.position, joint.velocity]))
        }
        _ => None,
    }
}

#[test]
fn coupled_wrapped_and_merged_joints_are_the_truth() {
    let folder = tempfile::tempdir().expect("a folder");
    let plain = SimulatedRobot::open(ROBOT).expect("the robot of this repository");
    let settings = SimulationSettings {
        noise: false,
        ..SimulationSettings::default()
    };
    // Where the second motor is at start: it reports its shaft's angle within a turn.
    let simulation = Simulation::new(&plain, &settings).expect("a simulation");
    let rest = |name: &str| {
        let joint = simulation.joint(name).expect("a joint");
        simulation.motion(joint, 0.0).expect("a motion").position
    };
    let centre = (rest("l_shoulder_roll") - rest("l_shoulder_pitch")) / 0.615 + 0.01;
    // A joint moves with 1.2 rad/s at most.
    let speed = 1.2 * 2.0 / 0.615 * 100.0;
    let turns = format!(
        "wraps_rad = [0.0, 6.283185307179586]\ncentre_rad = {centre}\nmax_speed_radps = {speed}\n"
    );
    let robot = write(folder.path(), "none", &turns);
    let t0 = Nanos::from_millis(5000);
    let mut simulator = Simulator::new(&robot, &settings, t0).expect("a simulator");
    let plan = &robot.plan.buses[1];
    let status = Arc::new(BusStatus::new(1, plan));
    let mut devices = BusDevices::new(1, plan, None, status).expect("devices");
    let end = t0 + Nanos::from_seconds(8.0);
    let (mut samples, mut now) = (Vec::new(), t0);
    while now < end {
        while let Some((bus, frame)) = simulator.poll(now) {
            if bus == 1 {
                let frame = frame.at(now, StampKind::Software);
                devices.on_frame(&frame, |sample| samples.push(*sample));
            }
        }
        devices.poll_transmit(now, |_, _| {});
        let wakes = [simulator.next_wake(), devices.next_wake()]
            .into_iter()
            .flatten();
        now = wakes.min().unwrap_or(end).max(now + Nanos(1));
    }
    assert!(devices.states().all(|state| state == State::Streaming));
    let at = |name: &str, t: f64| {
        let joint = simulation.joint(name).expect("a joint");
        simulation.motion(joint, t).expect("a motion")
    };
    // The greatest acceleration and jerk of a joint.
    let (mut most, mut jerk) = (0.0_f64, 0.0_f64);
    for ms in 0..8000 {
        for name in simulation.joint_names() {
            let [a, b] = [0.0, 1e-3].map(|dt| at(name, f64::from(ms) * 1e-3 + dt).acceleration);
            most = most.max(a.abs());
            jerk = jerk.max((b - a).abs() / 1e-3);
        }
    }
    let (mut counts, mut wrapped) = (std::collections::BTreeMap::new(), [0; 2]);
    for sample in &samples {
        let Some((name, [position, velocity])) = state(&robot, sample) else {
            continue;
        };
        let t = (sample.header.acquired - t0).seconds();
        let truth = at(name, t);
        let coupled = name.contains("shoulder");
        // A motor that is carried over a period accelerates as much as the inverse matrix says.
        let carried = 0.5 * most * INVERSE * PERIOD * PERIOD + HALF_VELOCITY * PERIOD;
        let (within, of_velocity) = match name {
            _ if coupled => (
                ROW * (HALF_POSITION + carried),
                ROW * (4.0 * HALF_VELOCITY + jerk * INVERSE * PERIOD * PERIOD),
            ),
            "l_elbow" => (HALF_ENCODER, 4.0 * HALF_VELOCITY + jerk * PERIOD * PERIOD),
            _ => (HALF_POSITION, HALF_VELOCITY),
        };
        let off = (position - truth.position).abs();
        assert!(
            off <= within + 1e-9,
            "{name} at {t}: {position} {truth:?}, {within}"
        );
        let off = (velocity - truth.velocity).abs();
        // The first ones of the elbow may come before the motor's.
        let starts = t < 0.01 && name == "l_elbow";
        assert!(
            off <= of_velocity + 1e-9 || starts,
            "{name} at {t}: {velocity} {truth:?}"
        );
        assert_eq!(sample.header.quality, Quality::GOOD, "{name} at {t}");
        *counts.entry(name).or_insert(0) += 1;
        if name == "l_elbow" {
            wrapped[usize::from(position > 1.0)] += 1;
        }
    }
    assert_eq!(counts.len(), 7);
    assert!(
        counts.values().all(|n| (1990..=2001).contains(n)),
        "{counts:?}"
    );
    assert!(
        wrapped.iter().all(|n| *n > 300),
        "the encoder has wrapped: {wrapped:?}"
    );
    let moved =
        |t: f64| (at("l_shoulder_roll", t).position - at("l_shoulder_pitch", t).position) / 0.615;
    let range = (0..8000).map(|ms| moved(f64::from(ms) * 1e-3));
    let (low, high) = range.fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)));
    assert!(
        (high - low) * 100.0 / TAU > 10.0,
        "the motor has turned often"
    );
}

#[test]
fn a_gateway_publishes_one_channel_for_each_joint() {
    let rig = Rig::new();
    let folder = rig.path("robot");
    // Buses of its own: other tests' arms are on the virtual bus, too.
    let name = rig
        .path("")
        .file_name()
        .and_then(|name| name.to_str())
        .expect("a name")
        .to_owned();
    let robot = write(&folder, &name, "");
    let text = |path: &Path| path.to_str().expect("a path in UTF-8").to_owned();
    let gateway = text(&folder.join("gateway.toml"));
    let check = rig.run(&["gateway", "--config", &gateway, "--check"]);
    let check = String::from_utf8_lossy(&check.stdout).into_owned();
    assert!(
        check.contains("l_shoulder_roll = 1 * motor_1 + 0.615 * motor_2"),
        "{check}"
    );
    let still = 6.0;
    let folder = text(&folder);
    let truth = rig.path("truth.csv");
    let mut simulator = rig.start(&[
        "simulate",
        "--robot",
        &folder,
        "--still",
        &still.to_string(),
        "--truth",
        &text(&truth),
        "--json",
    ]);
    let mut gateway = rig.start(&["gateway", "--config", &gateway]);
    let domain = rig.open();
    let mut recorder = Recorder::of_samples(&domain, ROBOT);
    Newest::<GatewayHealth>::open(&domain, ROBOT).wait("all stream", |health| {
        let devices = health.devices();
        devices.len() == 10 && devices.iter().all(|d| d.state == DeviceState::Streaming)
    });
    let end = now() + Nanos::from_seconds(still + 6.0);
    let _ = until(PATIENCE, || {
        recorder.take();
        (now() > end).then_some(())
    });
    simulator.end();
    gateway.end();
    let summary: serde_json::Value =
        serde_json::from_str(&simulator.output()).expect("a summary as JSON");
    let t0 = Nanos(summary["t0"].as_i64().expect("an instant"));
    let settings = SimulationSettings {
        still,
        ..SimulationSettings::default()
    };
    let simulation = Simulation::new(&robot, &settings).expect("a simulation");
    let mut counts = std::collections::BTreeMap::new();
    for sample in &recorder.taken {
        let Some((name, [position, velocity])) = state(&robot, sample) else {
            continue;
        };
        let joint = simulation.joint(name).expect("a joint");
        let t = (sample.header.acquired - t0).seconds();
        let truth = simulation.motion(joint, t).expect("a motion");
        let step = if name == "l_elbow" {
            HALF_ENCODER
        } else {
            ROW * HALF_POSITION
        };
        // As long as it stands still, to half a step and the noise of each motor, which is carried
        // along by half a step of velocity. In motion a busy machine may stamp a frame late.
        let late = if t < still {
            PERIOD * HALF_VELOCITY
        } else {
            0.3 * 1.2
        };
        let within = step + ROW * (7.5 * JOINT_NOISE) + late;
        let off = (position - truth.position).abs();
        assert!(
            off <= within,
            "{name} at {t}: {position} {truth:?}, {within}"
        );
        let moves = t >= still;
        assert!(
            moves || velocity.abs() <= ROW * HALF_VELOCITY || velocity.is_nan(),
            "{velocity}"
        );
        counts.entry(name).or_insert([0, 0])[usize::from(moves)] += 1;
    }
    assert_eq!(counts.len(), 7, "{counts:?}");
    assert!(counts.values().flatten().all(|n| *n > 20), "{counts:?}");
    // The way back: a table of the truth, as a log and decoded again, is the same table.
    let (log, back) = (text(&rig.path("arm.log")), text(&rig.path("back.csv")));
    let config = format!("{folder}/gateway.toml");
    rig.run(&[
        "encode",
        "--config",
        &config,
        "--samples",
        &text(&truth),
        "--out",
        &log,
    ]);
    rig.run(&["decode", "--config", &config, "--log", &log, "--out", &back]);
    let tables = [&truth, Path::new(&back)].map(columns);
    for name in simulation.joint_names() {
        let [before, after] = tables
            .each_ref()
            .map(|t| &t[&format!("joint/{name}/position")]);
        assert!(before.len() > 1000 && after.len() == before.len());
        let step = if name == "l_elbow" {
            HALF_ENCODER
        } else {
            ROW * HALF_POSITION
        };
        for (before, after) in before.iter().zip(after) {
            assert!(
                (before - after).abs() <= step + 1e-9,
                "{name}: {before} {after}"
            );
        }
    }
}

/// The numbers of a table by column.
fn columns(file: &Path) -> std::collections::BTreeMap<String, Vec<f64>> {
    let text = std::fs::read_to_string(file).expect("a table");
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
    let mut columns = std::collections::BTreeMap::<String, Vec<f64>>::new();
    for line in lines {
        for (name, cell) in names.iter().zip(line.split(',')) {
            let column = columns.entry((*name).to_owned()).or_default();
            column.extend(cell.parse::<f64>().ok());
        }
    }
    columns
}
