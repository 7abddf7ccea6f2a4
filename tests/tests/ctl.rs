//! A running gateway that is asked over its control socket: it answers, tares, and is disturbed by
//! nobody.

use proprio_drivers::{Frame, Id};
use proprio_gateway::control::{MAX_CLIENTS, MAX_LINE, Server, ask};
use proprio_gateway::link::send_by;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_tests::watch::{Newest, Recorder, count};
use proprio_tests::{Arm, PATIENCE, Process, Rig, Written, until};
use proprio_topics::ipc::Domain;
use proprio_topics::{
    Counter, Description, DeviceState, GatewayHealth, Nanos, Quality, Reading, Sample,
};
use serde_json::{Value as Json, json};
use std::io::{BufReader, Read as _, Write as _};
use std::os::unix::fs::{FileTypeExt as _, PermissionsExt as _};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use toml::{Table, Value};

const ROBOT: &str = "icub_left_arm";

/// A simulated arm and its gateway; all devices stream.
struct Running {
    rig: Rig,
    table: Arm,
    arm: Written,
    simulator: Process,
    gateway: Process,
    domain: Option<Domain>,
}

impl Running {
    fn new(arm: Arm) -> Self {
        Self::start(arm, &[])
    }

    /// The arm does not move.
    fn still(arm: Arm) -> Self {
        Self::start(arm, &["--still", "600"])
    }

    fn start(arm: Arm, options: &[&str]) -> Self {
        let rig = Rig::new();
        let table = arm
            .periods(4, 10, 4)
            .patience(1000.0, 100.0)
            .each_device(|driver, device| {
                // The halves of a wrench may arrive far apart on a busy machine.
                if driver == "icub_strain" {
                    device.insert("pair_timeout_ms".into(), 500.0.into());
                }
            })
            .on_virtual(["a", "b"]);
        let arm = table.write(&rig.path("robot"));
        let simulate = [&["simulate", "--robot", &arm.folder], options].concat();
        let simulator = rig.start(&simulate);
        let gateway = rig.start(&["gateway", "--config", &arm.gateway]);
        let domain = Some(rig.open());
        let running = Self {
            rig,
            table,
            arm,
            simulator,
            gateway,
            domain,
        };
        running.all_stream();
        running
    }

    fn domain(&self) -> &Domain {
        self.domain.as_ref().expect("it is open until the end")
    }

    fn all_stream(&self) -> GatewayHealth {
        Newest::<GatewayHealth>::open(self.domain(), ROBOT).wait("all stream", |health| {
            let devices = health.devices();
            devices.len() > 4 && devices.iter().all(|d| d.state == DeviceState::Streaming)
        })
    }

    fn ask(&self, line: &Json) -> Json {
        self.send(&line.to_string())
    }

    fn send(&self, line: &str) -> Json {
        let answer = ask(&self.rig.domain, Server::Gateway, ROBOT, line);
        let answer =
            answer.unwrap_or_else(|error| panic!("{line}: {error}\n{}", self.gateway.log()));
        serde_json::from_str(&answer).expect("JSON")
    }

    /// The answer to an order that must be refused, for a reason with these parts.
    fn refused(&self, line: &Json, parts: &[&str]) {
        let answer = self.ask(line);
        assert_eq!(answer["ok"], false, "{line}: {answer}");
        let error = answer["error"].as_str().expect("a reason");
        for part in parts {
            assert!(
                error.contains(part),
                "{line}: the reason lacks {part:?}: {error}"
            );
        }
    }

    /// Writes gateway.toml with a change of device `name`.
    fn change(&self, name: &str, change: impl Fn(&mut Table)) {
        let changed = self.table.clone().each_device(|_, device| {
            if device.get("name").and_then(Value::as_str) == Some(name) {
                change(device);
            }
        });
        self.write(&changed.gateway.to_string());
    }

    fn write(&self, gateway: &str) {
        std::fs::write(&self.arm.gateway, gateway).expect("a configuration can be written");
    }

    /// The answer to a line, while samples are recorded: a reader that pauses loses some.
    fn ask_recording(&self, line: &Json, recorder: &mut Recorder) -> Json {
        let (domain, line) = (self.rig.domain.clone(), line.to_string());
        let asking = std::thread::spawn(move || ask(&domain, Server::Gateway, ROBOT, &line));
        while !asking.is_finished() {
            recorder.take();
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        let answer = asking.join().expect("no panic").expect("an answer");
        serde_json::from_str(&answer).expect("JSON")
    }

    fn reload_recording(&self, recorder: &mut Recorder) -> Json {
        self.ask_recording(&json!({ "do": "reload" }), recorder)
    }

    fn reload(&self) -> Json {
        self.ask(&json!({ "do": "reload" }))
    }

    fn socket(&self) -> PathBuf {
        let domain = &self.rig.domain;
        domain
            .base
            .join(&domain.name)
            .join(format!("{ROBOT}.gateway.sock"))
    }

    fn connect(&self) -> UnixStream {
        let stream = UnixStream::connect(self.socket()).expect("the socket");
        stream
            .set_read_timeout(Some(std::time::Duration::from_secs(20)))
            .expect("a time-out");
        stream
    }

    /// The number of a channel.
    fn channel(&self, name: &str) -> u32 {
        self.arm.robot.plan.channel(name).expect("a channel")
    }

    fn end(mut self) {
        self.gateway.end();
        self.simulator.end();
        self.domain = None;
        self.rig.assert_nothing_left();
    }
}

fn line_of(reader: &mut impl std::io::BufRead) -> Option<Json> {
    let mut line = String::new();
    match reader.read_line(&mut line) {
        Ok(0) | Err(_) => None,
        Ok(_) => serde_json::from_str(&line).ok(),
    }
}

#[test]
fn it_says_what_it_runs() {
    let running = Running::new(Arm::new());
    let status = running.ask(&json!({ "do": "status" }));
    assert_eq!(
        (&status["ok"], &status["robot"]),
        (&json!(true), &json!(ROBOT))
    );
    assert_eq!(status["process"], running.gateway.id());
    assert_eq!(status["config"], running.arm.gateway);
    assert_eq!(status["buses"].as_array().map(Vec::len), Some(2));
    assert_eq!(status["buses"][0]["link"], "up");
    assert!(status["buses"][0]["frames"].as_u64() > Some(0), "{status}");
    assert_eq!(status["streaming"], status["devices"]);

    let answer = running.ask(&json!({ "do": "devices" }));
    let devices = answer["devices"].as_array().expect("a list");
    let plan = &running.arm.robot.plan;
    let names: Vec<_> = (plan.buses.iter())
        .flat_map(|b| b.devices.iter().map(|d| &d.name))
        .collect();
    assert_eq!(
        devices.iter().map(|d| &d["name"]).collect::<Vec<_>>(),
        names
    );
    let sensor = devices
        .iter()
        .find(|d| d["name"] == "l_arm_ft_sensor")
        .expect("the sensor");
    assert_eq!(
        (&sensor["driver"], &sensor["state"]),
        (&json!("icub_strain"), &json!("streaming"))
    );
    assert_eq!(sensor["channels"], json!(["l_arm_ft_sensor"]));
    assert_eq!(sensor["listen_only"], false);
    assert!(sensor["readings"].as_u64() > Some(0), "{sensor}");

    // The load is known once the bus was measured for a while; here without a bit rate.
    let measured = until(PATIENCE, || {
        let status = running.ask(&json!({ "do": "status" }));
        let mut buses = status["buses"].as_array().expect("a list").iter();
        assert!(buses.clone().all(|bus| bus["load"].is_null()), "{status}");
        buses
            .all(|bus| bus["frame_rate_hz"].as_f64() > Some(0.0))
            .then_some(())
    });
    measured.expect("frames per second");
    assert_eq!(
        (&sensor["frozen"], &sensor["out_of_range"]),
        (&json!(""), &json!(""))
    );

    running.refused(&json!({ "do": "devises" }), &["did you mean \"devices\"?"]);
    running.refused(
        &json!({ "do": "tare", "device": "l_arm_ft_sensr" }),
        &[
            "no device \"l_arm_ft_sensr\"",
            "did you mean \"l_arm_ft_sensor\"?",
        ],
    );
    running.end();
}

/// The wrenches of the sensor after `since`.
fn wrenches(samples: &[Sample], channel: u32, since: Nanos) -> Vec<([f64; 6], Quality)> {
    let later = samples
        .iter()
        .filter(|s| s.channel == channel && s.header.acquired > since);
    later
        .filter_map(|sample| match sample.reading() {
            Some(Reading::Wrench(w)) => {
                let ([a, b, c], [d, e, f]) = (w.force, w.torque);
                Some(([a, b, c, d, e, f], sample.header.quality))
            }
            _ => None,
        })
        .collect()
}

#[test]
fn a_tare_makes_the_present_load_the_zero() {
    let running = Running::still(Arm::new());
    let sensor = running.channel("l_arm_ft_sensor");
    let mut recorder = Recorder::of_samples(running.domain(), ROBOT);
    let began = proprio_tests::now();
    some(&mut recorder, sensor, began);
    let order = json!({ "do": "tare", "device": "l_arm_ft_sensor" });
    let answer = running.ask_recording(&order, &mut recorder);
    let tared = proprio_tests::now();
    assert_eq!(
        (&answer["ok"], &answer["device"]),
        (&json!(true), &json!("l_arm_ft_sensor"))
    );
    some(&mut recorder, sensor, tared);
    let wrenches = wrenches(&recorder.taken, sensor, began);
    let force = |w: &[f64; 6]| w[..3].iter().map(|f| f * f).sum::<f64>().sqrt();
    // The arm stands still: the load is the weight beyond the sensor, and its noise is below 1 N.
    let first = wrenches
        .iter()
        .position(|(w, _)| force(w) < 3.0)
        .expect("a zero");
    assert!(first > 10, "{wrenches:?}");
    assert!(
        wrenches[..first].iter().all(|(w, _)| force(w) > 6.0),
        "{wrenches:?}"
    );
    assert!(
        wrenches[first..].iter().all(|(w, _)| force(w) < 3.0),
        "{wrenches:?}"
    );
    assert!(
        wrenches[first].1.contains(Quality::ZERO_CHANGED),
        "{:?}",
        wrenches[first]
    );
    let marked = wrenches
        .iter()
        .filter(|(_, q)| q.contains(Quality::ZERO_CHANGED));
    assert!((1..10).contains(&marked.count()));
    assert!(
        !wrenches
            .last()
            .expect("some")
            .1
            .contains(Quality::ZERO_CHANGED)
    );
    // The answer is what was added.
    for axis in 0..3 {
        let added = answer["added"]["force_n"][axis].as_f64().expect("a number");
        assert!(
            (added + wrenches[first - 1].0[axis]).abs() < 3.0,
            "{answer}"
        );
    }
    assert!(running.gateway.log().contains("tared: the board adds"));
    // Nothing was lost, and no other channel is marked.
    let since = recorder.taken.iter().filter(|s| s.header.acquired > began);
    let others: Vec<_> = since
        .filter(|s| s.channel != sensor && s.header.quality.contains(Quality::ZERO_CHANGED))
        .collect();
    assert!(others.is_empty(), "{others:?}");
    assert_eq!(recorder.lost(), 0);
    drop(recorder);
    let devices = &running.arm.robot.plan.buses[1].devices;
    let joints = devices
        .iter()
        .find(|d| d.driver == "icub_motor")
        .expect("a board of joints");
    let order = json!({ "do": "tare", "device": joints.name });
    running.refused(&order, &[&joints.name, "no such command"]);
    running.end();

    let listens = Running::still(Arm::new().each_device(|driver, device| {
        if driver == "icub_strain" {
            device.insert("listen_only".into(), true.into());
            device.insert("full_scale_n".into(), vec![1804.0; 3].into());
            device.insert("full_scale_nm".into(), vec![31.0; 3].into());
        }
    }));
    listens.refused(
        &json!({ "do": "tare", "device": "l_arm_ft_sensor" }),
        &[
            "l_arm_ft_sensor",
            "only listens",
            "another program commands its board",
        ],
    );
    listens.end();
}

/// Also of a board whose memory was damaged: the message on the bus is that of the maker's tool.
#[test]
fn a_calibration_is_read_and_what_is_wrong_is_told() {
    let running = Running::still(Arm::new());
    let order = json!({ "do": "calibration", "device": "l_arm_ft_sensor" });
    let mut recorder = Recorder::of_samples(running.domain(), ROBOT);
    let began = proprio_tests::now();
    let answer = running.ask_recording(&order, &mut recorder);
    assert_eq!(answer["ok"], true, "{answer}");
    assert_eq!(answer["problems"], json!([]));
    assert_eq!(answer["full_scale_n"].as_array().map(Vec::len), Some(3));
    let one = answer["matrix"][3][3].as_f64();
    assert!(one.is_some_and(|x| (x - 1.0).abs() < 1e-4), "{answer}");
    assert_eq!(answer["matrix"][3][4], 0.0);
    let sensor = running.channel("l_arm_ft_sensor");
    some(&mut recorder, sensor, began);
    assert_continuous(&recorder, &[], began);

    let proprio_gateway::config::FrameSource::Virtual { name } =
        &running.arm.robot.plan.buses[0].source
    else {
        panic!("a virtual bus")
    };
    let mut bus = VirtualBus::open(&running.rig.domain.name, name, &[]).expect("the bus");
    let patience = proprio_tests::now() + Nanos::from_millis(1000);
    let damage = Frame::new(Id::standard(0x20D), &[0x03, 2, 4, 0xFF, 0xFF]);
    send_by(&mut bus, &damage, patience).expect("a frame can be sent");
    let damaged = until(PATIENCE, || {
        let problems = running.ask(&order)["problems"].clone();
        (problems != json!([])).then_some(problems)
    });
    let expected = "the entry of fz, gauge 4 is FFFF, as in erased memory";
    assert_eq!(damaged.expect("it is noticed"), json!([expected]));
    running.refused(
        &json!({ "do": "calibration", "device": "l_elbow_motor" }),
        &["no such command"],
    );
    let output = running
        .rig
        .command(&["ctl", "calibration", "l_arm_ft_sensor"])
        .output()
        .expect("it runs");
    let (out, err) = (
        String::from_utf8_lossy(&output.stdout).into_owned(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    );
    assert_eq!(output.status.code(), Some(1), "{err}");
    assert!(
        err.contains(expected) && err.starts_with("error: "),
        "{err}"
    );
    for part in ["full scale: ", " Nm\n", "matrix, by gauge", "    tz "] {
        assert!(out.contains(part), "{out}");
    }
    assert!(running.gateway.log().contains(expected));
    drop(recorder);
    running.end();
}

#[test]
fn a_board_that_does_not_answer_about_its_calibration_is_named() {
    let running = Running::start(Arm::new(), &["--fault", "silent:l_arm_ft_sensor@15..600"]);
    let order = json!({ "do": "calibration", "device": "l_arm_ft_sensor" });
    let failed = until(PATIENCE, || {
        let answer = running.ask(&order);
        (answer["ok"] == false).then(|| answer["error"].to_string())
    });
    let failed = failed.expect("it falls silent");
    let reasons = [
        "did not confirm",
        "restarted meanwhile",
        "do not arrive",
        "not ended",
    ];
    assert!(failed.contains("l_arm_ft_sensor"), "{failed}");
    assert!(
        reasons.iter().any(|reason| failed.contains(reason)),
        "{failed}"
    );
    running.end();
}

#[test]
fn a_frozen_sensor_is_in_health_and_in_the_log() {
    let running = Running::start(Arm::new(), &["--fault", "freeze:l_arm_ft_sensor@15..600"]);
    let mut reader = Newest::<GatewayHealth>::open(running.domain(), ROBOT);
    let frozen = reader.wait("it freezes", |health| {
        health.devices().iter().any(|d| d.frozen_axes == 0x3F)
    });
    let device = frozen
        .devices()
        .iter()
        .find(|d| d.frozen_axes != 0)
        .expect("one");
    assert_eq!(device.name.as_str(), "l_arm_ft_sensor");
    assert!(count(device, Counter::Frozen) > 0);
    let answer = running.ask(&json!({ "do": "devices" }));
    let named = (answer["devices"].as_array().expect("a list").iter())
        .filter(|d| d["frozen"] == "fx, fy, fz, tx, ty, tz")
        .count();
    assert_eq!(named, 1, "{answer}");
    let line = until(PATIENCE, || {
        let log = running.gateway.log();
        log.contains("fx, fy, fz, tx, ty, tz repeats itself")
            .then_some(())
    });
    line.expect("a line of the log");
    let output = running
        .rig
        .command(&["status", "--json"])
        .output()
        .expect("it runs");
    let status: Json = serde_json::from_slice(&output.stdout).expect("JSON");
    let health = &status["robots"][0]["gateway"]["health"];
    let device = (health["devices"].as_array().expect("a list").iter())
        .find(|d| d["name"] == "l_arm_ft_sensor");
    let device = device.expect("the sensor");
    assert_eq!(device["frozen"], "fx, fy, fz, tx, ty, tz", "{device}");
    assert!(device["counters"]["frozen"].as_u64() > Some(0), "{device}");
    assert!(
        health["buses"][0]["frame_rate_hz"].as_f64() > Some(0.0),
        "{health}"
    );
    drop(reader);
    running.end();
}

#[test]
fn nobody_disturbs_it() {
    let mut running = Running::new(Arm::new());
    let meta = std::fs::symlink_metadata(running.socket()).expect("the socket");
    assert!(meta.file_type().is_socket());
    assert_eq!(meta.permissions().mode() & 0o777, 0o600);

    // Nonsense, and then a line that is right, over the same connection.
    let stream = running.connect();
    let mut reader = BufReader::new(stream.try_clone().expect("a second handle"));
    let say = |bytes: &[u8]| (&stream).write_all(bytes).expect("it is taken");
    for nonsense in [
        &b"hello\n"[..],
        b"\n",
        b"\0\xff\xfe\n",
        b"{\"do\": \"status\"\n",
    ] {
        say(nonsense);
        let answer = line_of(&mut reader).expect("an answer");
        assert_eq!(answer["ok"], false, "{answer}");
    }
    say(&vec![b'x'; 1 << 20]);
    say(b"\n{\"do\": \"sta");
    let answer = line_of(&mut reader).expect("an answer");
    let limit = MAX_LINE.to_string();
    assert!(
        answer["error"].as_str().is_some_and(|e| e.contains(&limit)),
        "{answer}"
    );
    say(b"tus\"}\n{\"do\": \"devices\"}\n");
    assert!(line_of(&mut reader).expect("an answer")["buses"].is_array());
    assert!(line_of(&mut reader).expect("an answer")["devices"].is_array());

    // Clients that say nothing, half of something, or do not listen.
    let silent: Vec<_> = (0..MAX_CLIENTS + 4).map(|_| running.connect()).collect();
    for (stream, number) in silent.iter().zip(0..) {
        let mut stream = stream;
        let _ = match number % 3 {
            0 => stream.write_all(b"{\"do\""),
            1 => stream.write_all(&b"{\"do\": \"devices\"}\n".repeat(50)),
            _ => Ok(()),
        };
    }
    let answer = running.ask(&json!({ "do": "status" }));
    assert!(
        answer["error"]
            .as_str()
            .is_some_and(|e| e.contains("16 clients")),
        "{answer}"
    );
    // The samples go on, and the silent ones are sent away.
    running.all_stream();
    let served = until(PATIENCE, || {
        std::thread::sleep(std::time::Duration::from_millis(200));
        let answer = ask(
            &running.rig.domain,
            Server::Gateway,
            ROBOT,
            "{\"do\": \"status\"}",
        )
        .ok()?;
        answer.contains("\"buses\"").then_some(())
    });
    served.expect("places are free again");
    let mut rest = Vec::new();
    let _ = { &silent[2] }.read_to_end(&mut rest);
    assert!(rest.is_empty(), "{rest:?}");
    running.gateway.assert_runs();
    let health = running.all_stream();
    for device in health.devices() {
        assert_eq!(count(device, Counter::Silences), 0, "{device:?}");
    }
    drop((silent, reader, stream));

    // A gateway that is killed leaves its socket; the next one replaces it.
    running.gateway.kill();
    assert!(running.socket().exists());
    let gone = ask(
        &running.rig.domain,
        Server::Gateway,
        ROBOT,
        "{\"do\": \"status\"}",
    );
    assert_eq!(
        gone.map_err(|e| e.kind()),
        Err(std::io::ErrorKind::ConnectionRefused)
    );
    running.gateway = running
        .rig
        .start(&["gateway", "--config", &running.arm.gateway]);
    let answered = until(PATIENCE, || {
        ask(
            &running.rig.domain,
            Server::Gateway,
            ROBOT,
            "{\"do\": \"status\"}",
        )
        .ok()
    });
    let status: Json = serde_json::from_str(&answered.expect("an answer")).expect("JSON");
    assert_eq!(status["process"], running.gateway.id());
    let mode = std::fs::symlink_metadata(running.socket()).expect("the socket");
    assert_eq!(mode.permissions().mode() & 0o777, 0o600);
    // A second gateway of this robot does not take it away.
    let second = running
        .rig
        .command(&["gateway", "--config", &running.arm.gateway])
        .output();
    assert_eq!(second.expect("it runs").status.code(), Some(1));
    assert_eq!(
        running.ask(&json!({ "do": "status" }))["process"],
        running.gateway.id()
    );
    running.all_stream();
    // The folder in which it was made is gone, and at the end the socket, too.
    running.gateway.end();
    let left: Vec<_> = std::fs::read_dir(running.socket().parent().expect("a folder"))
        .expect("the domain")
        .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
        .filter(|name| name.contains("gateway"))
        .collect();
    assert_eq!(left, [""; 0]);
    running.end();
}

/// Takes samples until the channel has sent some more after `since`.
fn some(recorder: &mut Recorder, channel: u32, since: Nanos) {
    let enough = until(PATIENCE, || {
        recorder.take();
        let new = |s: &&Sample| s.channel == channel && s.header.acquired > since;
        (recorder.taken.iter().filter(new).count() >= 20).then_some(())
    });
    enough.expect("samples of the channel");
}

/// Asserts that no sample of any bus was lost, and that each of these channels, and no other, has
/// one reading that does not continue the one before.
fn assert_continuous(recorder: &Recorder, channels: &[u32], since: Nanos) {
    assert_eq!(recorder.lost(), 0);
    let taken = || recorder.taken.iter().filter(|s| s.header.acquired > since);
    for bus in 0..2 {
        let numbers: Vec<u64> = taken()
            .filter(|s| s.header.bus == bus)
            .map(|s| s.header.sequence)
            .collect();
        assert!(numbers.len() > 10);
        assert!(
            numbers.windows(2).all(|w| w[1] == w[0] + 1),
            "bus {bus}: {numbers:?}"
        );
    }
    let marked = |s: &&Sample| s.header.quality.contains(Quality::ZERO_CHANGED);
    let mut marked: Vec<u32> = taken().filter(marked).map(|s| s.channel).collect();
    marked.sort_unstable();
    assert_eq!(marked, channels);
}

#[test]
fn a_reload_changes_one_device_and_the_others_do_not_notice() {
    let running = Running::still(Arm::new());
    let elbow = running.channel("l_elbow");
    let mut recorder = Recorder::of_samples(running.domain(), ROBOT);
    let began = proprio_tests::now();
    some(&mut recorder, elbow, began);
    assert_eq!(
        running.reload_recording(&mut recorder),
        json!({ "ok": true, "changed": [] }),
        "nothing is new"
    );

    // A joint's offset: the device goes on.
    running.change("l_elbow_motor", |device| {
        let joints = device["joint"].as_array_mut().expect("a list");
        joints[0]
            .as_table_mut()
            .expect("a table")
            .insert("offset_rad".into(), 0.5.into());
    });
    let changed = json!({ "device": "l_elbow_motor", "what": ["joints"], "restarted": false });
    assert_eq!(
        running.reload_recording(&mut recorder),
        json!({ "ok": true, "changed": [changed] })
    );
    some(&mut recorder, elbow, proprio_tests::now());
    assert_continuous(&recorder, &[elbow], began);
    let angles: Vec<(f64, Quality)> = (recorder.taken.iter())
        .filter(|s| s.channel == elbow && s.header.acquired > began)
        .filter_map(|s| match s.reading() {
            Some(Reading::Joint(joint)) => Some((joint.position, s.header.quality)),
            _ => None,
        })
        .collect();
    let at = angles
        .iter()
        .position(|(_, q)| q.contains(Quality::ZERO_CHANGED))
        .expect("a mark");
    let step = |(angle, _): &(f64, Quality)| angle - angles[0].0;
    assert!(
        angles[..at].iter().all(|a| step(a).abs() < 0.01),
        "{angles:?}"
    );
    assert!(
        angles[at..].iter().all(|a| (step(a) - 0.5).abs() < 0.01),
        "{angles:?}"
    );

    // The driver's keys: the sensor is stopped and started, the IMU on its bus goes on. (And the
    // elbow, whose offset is not in this file, goes back.)
    let sensor = running.channel("l_arm_ft_sensor");
    let before = running.all_stream();
    let rate = |device: &Table| device["period_ms"].as_integer();
    running.change("l_arm_ft_sensor", |device| {
        assert_eq!(rate(device), Some(4));
        device.insert("period_ms".into(), 8.into());
        device.insert("max_silence_ms".into(), 900.0.into());
    });
    // A new recording, because nobody has taken samples meanwhile.
    recorder = Recorder::of_samples(running.domain(), ROBOT);
    let began = proprio_tests::now();
    some(&mut recorder, elbow, began);
    let answer = running.reload_recording(&mut recorder);
    let what = ["keys of the driver", "max_silence_ms"];
    let sensor_changed = json!({ "device": "l_arm_ft_sensor", "what": what, "restarted": true });
    let elbow_changed =
        json!({ "device": "l_elbow_motor", "what": ["joints"], "restarted": false });
    assert_eq!(
        answer,
        json!({ "ok": true, "changed": [sensor_changed, elbow_changed] })
    );
    some(&mut recorder, sensor, proprio_tests::now());
    let mut channels = [sensor, elbow];
    channels.sort_unstable();
    assert_continuous(&recorder, &channels, began);
    let marked = |s: &&Sample| s.header.quality.contains(Quality::ZERO_CHANGED);
    let times: Vec<Nanos> = (recorder.taken.iter())
        .filter(|s| s.channel == sensor && s.header.acquired > began)
        .skip_while(|s| !marked(s))
        .map(|s| s.header.acquired)
        .collect();
    let periods = times.windows(2).map(|w| (w[1] - w[0]).seconds());
    let mean = periods.sum::<f64>() / (times.len() - 1) as f64;
    assert!((0.007..0.02).contains(&mean), "8 ms: {mean}");
    let after = running.all_stream();
    for (before, after) in before.devices().iter().zip(after.devices()) {
        let starts = |d: &proprio_topics::DeviceHealth| count(d, Counter::Starts);
        let restarted = u64::from(after.name.as_str() == "l_arm_ft_sensor");
        assert_eq!(starts(after), starts(before) + restarted, "{after:?}");
        assert_eq!(count(after, Counter::Silences), 0, "{after:?}");
    }
    // Readers are told of the new time-out.
    let mut description = Newest::<Description>::open(running.domain(), ROBOT);
    description.wait("the new time-out", |description| {
        let entries = description.entries();
        entries.iter().any(|e| {
            e.name.as_str() == "l_arm_ft_sensor" && e.max_silence == Nanos::from_millis(900)
        })
    });
    drop((recorder, description));
    running.end();
}

#[test]
fn a_reload_that_cannot_be_done_changes_nothing() {
    let running = Running::still(Arm::new());
    let good = running.table.gateway.to_string();
    let mut recorder = Recorder::of_samples(running.domain(), ROBOT);
    let began = proprio_tests::now();
    let elbow = running.channel("l_elbow");
    // Each of these has a change that could be done, too.
    let offset = good.replacen("ratio = 100.0", "ratio = 50.0", 1);
    assert_ne!(offset, good);
    let other_robot = offset.replace(&format!("\"{ROBOT}\""), "\"other\"");
    let bus = "\n[[bus]]\nname = \"third\"\nsource = { kind = \"virtual\", name = \"third\" }\n";
    for (text, parts) in [
        (other_robot, &["needs a restart of the gateway: robot"][..]),
        (
            format!("{offset}{bus}"),
            &["needs a restart of the gateway", "bus \"third\": added"],
        ),
        (
            offset.replace("address = 13", "address = 12"),
            &["\"l_arm_ft_sensor\": address"],
        ),
    ] {
        running.write(&text);
        running.refused(&json!({ "do": "reload" }), parts);
        let places = &running.reload()["restart"];
        assert_eq!(places.as_array().map(Vec::len), Some(1), "{places}");
    }
    // A wrong file is refused with the words of --check.
    running.write(&offset.replace("period_ms = 10", "period_ms = 1000"));
    let check = running
        .rig
        .command(&["gateway", "--config", &running.arm.gateway, "--check"]);
    let check = { check }.output().expect("it runs");
    let message = String::from_utf8_lossy(&check.stderr).into_owned();
    let message = message.trim().strip_prefix("error: ").expect("a message");
    assert!(message.contains("period_ms = 1000"), "{message}");
    let answer = running.reload();
    assert_eq!(
        (&answer["ok"], &answer["error"]),
        (&json!(false), &json!(message))
    );
    std::fs::remove_file(&running.arm.gateway).expect("the file");
    running.refused(
        &json!({ "do": "reload" }),
        &["gateway.toml: cannot be read"],
    );

    some(&mut recorder, elbow, proprio_tests::now());
    let marked = |s: &Sample| s.header.quality.contains(Quality::ZERO_CHANGED);
    let since: Vec<_> = recorder
        .taken
        .iter()
        .filter(|s| s.header.acquired > began)
        .collect();
    assert!(!since.iter().any(|s| marked(s)));
    // And then the good change is done.
    running.write(&offset);
    assert_eq!(
        running.reload()["changed"].as_array().map(Vec::len),
        Some(1)
    );
    drop(recorder);
    running.end();
}

#[test]
fn the_command_says_it_in_words() {
    let rig = Rig::new();
    let out = |rig: &Rig, arguments: &[&str]| {
        let output = rig
            .command(&[&["ctl"], arguments].concat())
            .output()
            .expect("it runs");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (
            output.status.code(),
            text(&output.stdout),
            text(&output.stderr),
        )
    };
    let (code, _, err) = out(&rig, &["status"]);
    assert_eq!(code, Some(1));
    let nobody = format!("no gateway runs in the domain {}", rig.domain.name);
    assert!(err.contains(&nobody), "{err}");
    assert!(
        err.contains("start one with `proprio gateway --config FILE`"),
        "{err}"
    );
    assert_eq!(out(&rig, &[]).0, Some(2));
    assert_eq!(out(&rig, &["tare"]).0, Some(2), "it needs a device");
    let made = std::fs::read_dir(&rig.domain.base).expect("the folder of the rig");
    assert_eq!(made.count(), 0, "nothing was created");

    let running = Running::still(Arm::new());
    let rig = &running.rig;
    let good = |arguments: &[&str], parts: &[&str]| {
        let (code, text, err) = out(rig, arguments);
        assert_eq!((code, err.as_str()), (Some(0), ""), "{arguments:?}");
        for part in parts {
            assert!(
                text.contains(part),
                "{arguments:?}: {part:?} is not in {text}"
            );
        }
        text
    };
    let process = format!("process {}", running.gateway.id());
    good(
        &["status"],
        &[
            "robot icub_left_arm",
            &process,
            "bus left_arm ",
            "9 of 9 devices stream",
        ],
    );
    good(
        &["devices", "--robot", ROBOT],
        &[
            "l_arm_ft_sensor          streaming  icub_strain, address 13 on left_arm;",
            "address 1 on left_arm_motors, listens only; channels: l_shoulder_pitch",
        ],
    );
    let text = good(&["--json", "devices"], &[]);
    let json: Json = serde_json::from_str(&text).expect("JSON");
    assert_eq!(json["devices"].as_array().map(Vec::len), Some(9));
    good(
        &["tare", "l_arm_ft_sensor"],
        &[
            "l_arm_ft_sensor is tared: its board adds",
            " Nm until",
            "no longer hold",
        ],
    );
    good(&["tare", "left_arm/l_arm_ft_sensor"], &["is tared"]);
    good(&["reload"], &["nothing has changed"]);
    running.change("chest_imu", |device| {
        device.insert("period_ms".into(), 20.into());
    });
    good(
        &["reload"],
        &["chest_imu: keys of the driver; it was restarted"],
    );

    let bad = |arguments: &[&str], wanted: i32, part: &str| {
        let (code, text, err) = out(rig, arguments);
        assert_eq!(code, Some(wanted), "{arguments:?}: {err}");
        assert!(
            err.starts_with("error: ") && err.contains(part),
            "{arguments:?}: {err}"
        );
        text
    };
    bad(
        &["tare", "l_arm_ft"],
        1,
        "did you mean \"l_arm_ft_sensor\"?",
    );
    bad(&["tare", "l_elbow_motor"], 1, "no such command");
    bad(
        &["status", "--robot", "icub"],
        1,
        "no gateway of robot \"icub\"",
    );
    let text = bad(&["tare", "nobody", "--json"], 1, "no device");
    assert_eq!(
        serde_json::from_str::<Json>(&text).expect("JSON")["ok"],
        false
    );
    running.write("schema = 1\nrobot = 7\n");
    bad(&["reload"], 2, "gateway.toml: ");

    // A second robot in the same domain.
    let other = "schema = 1\nrobot = \"other\"\n[[bus]]\nname = \"b\"\n\
                 source = { kind = \"virtual\", name = \"nobody\" }\n";
    let file = rig.path("other.toml");
    std::fs::write(&file, other).expect("a configuration can be written");
    let mut second = rig.start(&[
        "gateway",
        "--config",
        file.to_str().expect("a path in UTF-8"),
    ]);
    let both = until(PATIENCE, || {
        let (_, _, err) = out(rig, &["status"]);
        err.contains("name a robot with --robot: icub_left_arm, other")
            .then_some(())
    });
    both.expect("both are named");
    good(
        &["status", "--robot", "other"],
        &["robot other", "0 of 0 devices stream"],
    );
    second.end();
    good(&["status"], &["robot icub_left_arm"]);
    running.end();
}

/// `estimator --check` beside a running gateway: the readings to expect in the robot's own posture,
/// and what is measured, which differs by the offset.
#[test]
fn a_check_compares_with_what_the_running_robot_measures() {
    let running = Running::start(Arm::new(), &["--still", "600", "--no-push"]);
    let check = |more: &[&str]| {
        let arguments = ["estimator", "--config", &running.arm.estimator, "--check"];
        let output = running.rig.run(&[&arguments[..], more].concat());
        String::from_utf8(output.stdout).expect("text")
    };
    let text = check(&[]);
    assert!(
        text.contains("posture: of the running robot: l_shoulder_pitch "),
        "{text}"
    );
    assert!(text.contains("gravity as the IMU measures it"), "{text}");
    let numbers = |after: &str| -> Vec<f64> {
        let line = text
            .lines()
            .find_map(|line| line.trim().strip_prefix(after));
        let line = line.unwrap_or_else(|| panic!("{after}: {text}"));
        let inside = line.split(['[', ']']).skip(1).step_by(2).take(2);
        let each = inside.flat_map(|three| three.split(", "));
        each.map(|number| number.parse().expect("a number"))
            .collect()
    };
    let (offset, used) = (numbers("the difference: "), numbers("its offset in use: "));
    // The load of 19 N and 1 Nm, turned by a degree: what noise of encoders and IMU amounts to at
    // most, beside that of the sensor's mean.
    let bounds = [0.5, 0.5, 0.5, 0.05, 0.05, 0.05];
    for ((offset, used), bound) in offset.iter().zip(&used).zip(bounds) {
        assert!((offset - used).abs() < bound, "{text}");
    }
    // A posture that is given needs no robot.
    let text = check(&["--at", "l_elbow=1"]);
    assert!(
        text.contains("posture: l_elbow 1, others") && !text.contains("measured"),
        "{text}"
    );
}
