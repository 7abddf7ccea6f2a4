//! `proprio scan` and `proprio setup` as processes, on virtual buses with simulated robots.
#![allow(missing_docs)]

use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received};
use proprio_tests::{PATIENCE, Process, Rig, now, until};
use proprio_topics::Nanos;
use serde_json::Value;
use std::fs;

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Starts a simulated robot on virtual buses, and waits for its boards.
fn simulate(rig: &Rig, robot: &str, buses: &[&str]) -> Process {
    let names: Vec<String> = buses.iter().map(|bus| format!("virtual:{bus}")).collect();
    let mut arguments = vec!["simulate", "--robot", robot];
    for name in &names {
        arguments.extend(["--bus", name.as_str()]);
    }
    let process = rig.start(&arguments);
    let on = until(PATIENCE, || {
        process.log().contains("powered on").then_some(())
    });
    assert!(on.is_some(), "{}", process.log());
    process
}

/// What a scan finds, as JSON: the only bus.
fn scan(rig: &Rig, arguments: &[&str]) -> Value {
    let all = [&["scan", "--json"], arguments].concat();
    let output = rig.run(&all);
    let buses: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    buses[0].clone()
}

/// Driver and address of what is found, sorted, with at least this certainty.
fn found(bus: &Value, certainties: &[&str]) -> Vec<(String, u64)> {
    let devices = bus["devices"].as_array().expect("a list").iter();
    let sure = devices.filter(|d| certainties.contains(&d["certainty"].as_str().unwrap()));
    let mut found: Vec<(String, u64)> = sure
        .map(|d| {
            let driver = d["driver"].as_str().expect("a driver").to_owned();
            (driver, d["address"].as_u64().expect("an address"))
        })
        .collect();
    found.sort();
    found
}

/// Frames that reach a bus until there is none for half a second.
fn frames(listener: &mut VirtualBus) -> usize {
    let mut count = 0;
    loop {
        match listener.recv(now() + Nanos::from_millis(500)) {
            Received::Frame(_) => count += 1,
            _ => return count,
        }
    }
}

#[test]
fn a_scan_sends_nothing_unless_it_is_active() {
    let rig = Rig::new();
    let bus = "scan-quiet";
    let mut listener = VirtualBus::open(&rig.domain.name, bus, &[]).expect("a virtual bus");
    let quick = ["scan", "--bus", "virtual:scan-quiet", "--seconds", "0.5"];
    let output = rig.run(&quick);
    assert_eq!(frames(&mut listener), 0);
    let said = text(&output.stdout);
    assert!(
        said.contains("nothing was sent") && said.contains("nothing was heard"),
        "{said}"
    );
    let output = rig.run(&[&quick[..], &["--active"]].concat());
    // All CANopen nodes and moteus controllers, one question to iCub boards, two to 32 motors of
    // Damiao.
    let all = 127 + 127 + 1 + 2 * 32;
    assert_eq!(frames(&mut listener), all);
    let said = text(&output.stdout);
    assert!(
        said.contains(&format!("{all} questions were sent")),
        "{said}"
    );
    rig.run(&[&quick[..], &["--ask", "robotous_rft"]].concat());
    assert_eq!(frames(&mut listener), all + 3);
}

#[test]
fn boards_that_stream_are_found_by_listening_and_others_by_asking() {
    let rig = Rig::new();
    let mut robot = simulate(&rig, "icub_left_arm", &["scan-arm", "scan-motors"]);
    let motors = scan(&rig, &["--bus", "virtual:scan-motors", "--seconds", "1"]);
    let expected: Vec<(String, u64)> = (1..=7).map(|a| ("icub_motor".to_owned(), a)).collect();
    let of_motors = found(&motors, &["certain", "likely"]);
    assert_eq!(of_motors, expected, "{motors:#}");
    for device in motors["devices"].as_array().unwrap() {
        assert_eq!(device["keys"]["period_ms"], 4, "{device:#}");
    }
    for stream in motors["identifiers"].as_array().unwrap() {
        assert!(
            !stream["devices"].as_array().unwrap().is_empty(),
            "{stream:#}"
        );
    }
    // Boards that nobody has started are silent.
    let quiet = scan(&rig, &["--bus", "virtual:scan-arm", "--seconds", "0.5"]);
    assert_eq!(quiet["identifiers"], serde_json::json!([]));
    let asked = scan(
        &rig,
        &["--bus", "virtual:scan-arm", "--seconds", "0.5", "--active"],
    );
    let expected = [
        ("icub_imu", 1),
        ("icub_imu", 13),
        ("icub_strain", 1),
        ("icub_strain", 13),
    ]
    .map(|(driver, address)| (driver.to_owned(), address));
    // A simulated IMU is that of a strain2, and a strain2 has an IMU.
    assert_eq!(found(&asked, &["certain"]), expected, "{asked:#}");
    robot.end();
}

#[test]
fn drives_and_a_sensor_that_is_asked_by_name_are_found() {
    let rig = Rig::new();
    let mut robot = simulate(&rig, "six_axis_arm", &["scan-ft", "scan-drives"]);
    let drives = scan(
        &rig,
        &[
            "--bus",
            "virtual:scan-drives",
            "--seconds",
            "0.3",
            "--active",
        ],
    );
    let expected: Vec<(String, u64)> = (1..=6).map(|n| ("canopen_drive".to_owned(), n)).collect();
    assert_eq!(found(&drives, &["certain"]), expected, "{drives:#}");
    let sensor = ["--bus", "virtual:scan-ft", "--seconds", "0.3", "--active"];
    assert_eq!(scan(&rig, &sensor)["devices"], serde_json::json!([]));
    let named = scan(&rig, &[&sensor[..], &["--ask", "ati_netcanoem"]].concat());
    assert_eq!(
        found(&named, &["certain"]),
        [("ati_netcanoem".to_owned(), 0x20)]
    );
    robot.end();
}

/// What setup writes, the gateway accepts; and it runs with it.
#[test]
fn a_configuration_is_written_that_the_gateway_runs() {
    let rig = Rig::new();
    let buses = ["setup-arm", "setup-motors"];
    let mut robot = simulate(&rig, "icub_left_arm", &buses);
    let folder = rig.path("found");
    let folder = folder.to_str().expect("a path");
    let setup = [
        "setup",
        "--out",
        folder,
        "--bus",
        "virtual:setup-arm",
        "--bus",
        "virtual:setup-motors",
        "--robot",
        "found",
        "--seconds",
        "1",
        "--active",
    ];
    let output = rig.run(&setup);
    assert!(text(&output.stdout).contains("gateway.toml is written"));
    let config = format!("{folder}/gateway.toml");
    let written = fs::read_to_string(&config).expect("the file");
    for part in [
        "joint_7",
        "# fill in",
        "period_ms = 4",
        "name = \"setup-motors_icub_motor_7\"",
    ] {
        assert!(written.contains(part), "{part}:\n{written}");
    }
    // Placeholders are refused, each by its key, until somebody has looked at them.
    let check = ["gateway", "--config", &config, "--check"];
    let install = ["install", "--config", folder, "--dry-run"];
    for arguments in [&check[..], &check[..3], &install] {
        let refused = rig.command(arguments).output().expect("proprio runs");
        let said = text(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{arguments:?}: {said}");
        for part in ["name = \"joint_7\"", "ratio = 1.0", "fill in"] {
            assert!(said.contains(part), "{part}:\n{said}");
        }
    }
    let filled: Vec<&str> = (written.lines())
        .map(|line| line.split("  # fill in").next().unwrap_or_default())
        .collect();
    fs::write(&config, filled.join("\n")).expect("the file");
    let plan = text(&rig.run(&check).stdout);
    fs::write(&config, &written).expect("the file");
    assert!(plan.contains("robot found: 2 buses, 11 channels"), "{plan}");
    let twice = [
        &["setup", "--out", "unused"][..],
        &["--bus", "virtual:a"].repeat(2),
    ]
    .concat();
    let said = text(&rig.command(&twice).output().expect("proprio runs").stderr);
    assert!(said.contains("--bus virtual:a is given twice"), "{said}");
    // It is not overwritten by accident.
    let again = rig.command(&setup).output().expect("proprio runs");
    let said = text(&again.stderr);
    assert!(
        !again.status.success() && said.contains("--force overwrites it"),
        "{said}"
    );
    fs::write(&config, "mine").expect("the file");
    rig.run(&[&setup[..], &["--force"]].concat());
    assert_eq!(fs::read_to_string(&config).expect("the file"), written);
    fs::write(&config, filled.join("\n")).expect("the file");
    let mut gateway = rig.start(&["gateway", "--config", &config]);
    let streams = until(PATIENCE, || {
        let output = rig
            .command(&["status", "--json"])
            .output()
            .expect("proprio runs");
        let status = text(&output.stdout);
        (status.matches("streaming").count() >= 9).then_some(())
    });
    assert!(streams.is_some(), "{}", gateway.log());
    gateway.end();
    robot.end();
}

#[test]
fn a_recorded_log_is_scanned_by_interface() {
    let rig = Rig::new();
    let mut log = String::new();
    for turn in 0..100 {
        let t = f64::from(turn) * 0.01;
        log += &format!("({t:.6}) can0 13A#0102030405{turn:02X}\n");
        log += &format!("({:.6}) can0 31A#00800080{turn:02X}80\n", t + 0.001);
        log += &format!("({:.6}) can0 31B#00800080{turn:02X}80\n", t + 0.0012);
        log += &format!("({t:.6}) can1 2AA#{turn:02X}\n");
    }
    let file = rig.path("bus.log");
    fs::write(&file, log).expect("a file");
    let file = file.to_str().expect("a path");
    let said = text(&rig.run(&["scan", "--log", file]).stdout);
    for part in [
        "bus can0: 300 frames, 3 identifiers",
        "bus can1: 100 frames, 1 identifiers",
        "likely (99.",
        "icub_strain_1: iCub board",
        "driver = \"icub_strain\"",
        "period_ms = 10",
        "unknown",
        "driver = \"dbc\"",
    ] {
        assert!(said.contains(part), "{part}:\n{said}");
    }
    let line = said
        .lines()
        .find(|line| line.starts_with("0x31A"))
        .expect("a row");
    let words: Vec<&str> = line.split_whitespace().collect();
    assert_eq!(
        words,
        [
            "0x31A",
            "100",
            "100.0",
            "6",
            "classic",
            "........7F..",
            "icub_strain_1"
        ]
    );
}

#[test]
fn a_wrong_command_line_is_told() {
    let rig = Rig::new();
    for (arguments, part) in [
        (&["scan"][..], "--bus"),
        (&["scan", "--bus", "virtual:"], "virtual:left_arm"),
        (
            &["scan", "--bus", "virtual:a", "--ask", "moteus"],
            "must be ati_netcanoem or ",
        ),
        (&["scan", "--log", "a", "--active"], "--active"),
        (
            &["scan", "--bus", "virtual:a", "--seconds", "0"],
            "0.1 to 3600",
        ),
        (&["setup"], "--out"),
    ] {
        let output = rig.command(arguments).output().expect("proprio runs");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
    let missing = rig
        .command(&["scan", "--log", "no.log"])
        .output()
        .expect("it runs");
    assert_eq!(missing.status.code(), Some(1));
    assert!(text(&missing.stderr).contains("no.log"));
}
