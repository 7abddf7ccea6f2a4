//! What the processes of a running system write to their logs, on the virtual bus: nothing that
//! warns at an ordinary start in any order, and one line with a remedy for whatever is missing.
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_gateway::link::virtual_bus::VirtualBus;
use proprio_gateway::link::{Link, Received};
use proprio_tests::watch::{Newest, open, valid_since};
use proprio_tests::{Arm, PATIENCE, Process, Rig, Written, now, until};
use proprio_topics::{DeviceState, EstimatorHealth, GatewayHealth, Nanos, TorqueEstimate};
use std::process::Command;

const ROBOT: &str = "icub_left_arm";

/// The lines of a log that warn.
fn warnings(log: &str) -> Vec<&str> {
    let warns = |line: &&str| line.contains(" WARN ") || line.contains("ERROR");
    log.lines().filter(warns).collect()
}

/// The processes of a system: simulator, gateway, estimator.
fn start(rig: &Rig, arm: &Written, which: usize) -> Process {
    match which {
        0 => rig.start(&["simulate", "--robot", &arm.folder]),
        1 => rig.start(&["gateway", "--config", &arm.gateway]),
        _ => rig.start(&["estimator", "--config", &arm.estimator]),
    }
}

/// Waits for a line of `process` that contains `text`; returns it.
fn line(process: &Process, text: &str) -> String {
    let found = until(PATIENCE, || {
        let log = process.log();
        log.lines().find(|l| l.contains(text)).map(str::to_owned)
    });
    found.unwrap_or_else(|| panic!("no line says {text:?}:\n{}", process.log()))
}

/// Also if a gateway is killed, and another one starts beside boards that stream.
#[test]
fn an_ordinary_start_in_any_order_warns_of_nothing() {
    for order in [
        [0, 1, 2],
        [0, 2, 1],
        [1, 0, 2],
        [1, 2, 0],
        [2, 0, 1],
        [2, 1, 0],
    ] {
        let rig = Rig::new();
        let arm = Arm::slow().on_virtual(["a", "b"]).write(&rig.path("robot"));
        let mut processes = order.map(|which| (which, start(&rig, &arm, which)));
        let domain = rig.open();
        let mut torques = open::<TorqueEstimate>(&domain, ROBOT);
        let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
        let mut runs = |processes: &[(usize, Process); 3]| {
            let from = now();
            assert!(
                valid_since(&mut torques, from, PATIENCE).is_some(),
                "no torque"
            );
            health.wait("all boards stream", |h| {
                h.header.published > from
                    && h.devices()
                        .iter()
                        .all(|d| d.state == DeviceState::Streaming)
            });
            // Two more, so that what they show has been told.
            health.fresh();
            health.fresh();
            for (which, process) in processes {
                let log = process.log();
                assert_eq!(
                    warnings(&log),
                    [""; 0],
                    "process {which} of {order:?}:\n{log}"
                );
            }
        };
        runs(&processes);
        // The estimator must tell of a killed gateway: so it is not there.
        let estimator = processes.iter_mut().find(|(which, _)| *which == 2);
        estimator.expect("it is one of them").1.end();
        let gateway = processes.iter_mut().find(|(which, _)| *which == 1);
        gateway.expect("it is one of them").1.kill();
        for (which, process) in &mut processes {
            if *which != 0 {
                *process = start(&rig, &arm, *which);
            }
        }
        runs(&processes);
        processes.sort_by_key(|(which, _)| 3 - which);
        processes.iter_mut().for_each(|(_, process)| process.end());
    }
}

#[test]
fn the_estimator_says_when_the_gateway_goes_and_comes() {
    let rig = Rig::new();
    let arm = Arm::slow().on_virtual(["a", "b"]).write(&rig.path("robot"));
    let mut estimator = start(&rig, &arm, 2);
    let waits = line(
        &estimator,
        "waiting for the gateway of robot \"icub_left_arm\"",
    );
    assert!(waits.contains("PROPRIO_DOMAIN"), "{waits}");
    let mut simulator = start(&rig, &arm, 0);
    let mut gateway = start(&rig, &arm, 1);
    line(&estimator, "the gateway is running");
    let signal = |process: &Process, signal| {
        let id = Pid::from_raw(i32::try_from(process.id()).expect("an id"));
        kill(id, signal).expect("it is there");
    };
    signal(&gateway, Signal::SIGSTOP);
    let stuck = line(&estimator, "is stopped or stuck");
    assert!(stuck.contains(&gateway.id().to_string()), "{stuck}");
    signal(&gateway, Signal::SIGCONT);
    line(&estimator, "the gateway sends its health again");
    gateway.kill();
    line(&estimator, "the gateway was killed or has crashed");
    gateway = start(&rig, &arm, 1);
    line(&estimator, "the gateway is running again");
    gateway.end();
    line(&estimator, "the gateway has stopped");
    // Each once.
    let log = estimator.log();
    for once in [
        "waiting for",
        "stuck",
        "its health again",
        "killed",
        "has stopped",
    ] {
        assert_eq!(log.matches(once).count(), 1, "{once}:\n{log}");
    }
    estimator.end();
    simulator.end();
}

/// The gateway's F/T device has another address than the board, and the gateway does not have the
/// IMU, so this gateway.toml is no robot's own: both logs say which is missing, once, and what to
/// check.
#[test]
fn a_board_that_never_answers_and_a_channel_that_is_missing_are_named() {
    let rig = Rig::new();
    let arm = Arm::new().on_virtual(["a", "b"]);
    let boards = arm.clone().write(&rig.path("boards"));
    let mut other = arm.each_device(|driver, device| {
        if driver == "icub_strain" {
            device.insert("address".into(), 14.into());
        }
    });
    for bus in other.gateway["bus"].as_array_mut().expect("buses") {
        if let Some(devices) = bus.get_mut("device").and_then(toml::Value::as_array_mut) {
            devices.retain(|d| d["driver"].as_str() != Some("icub_imu"));
        }
    }
    std::fs::write(rig.path("gateway.toml"), other.gateway.to_string()).expect("a file");
    let path = |name: &str| rig.path(name).to_string_lossy().into_owned();
    let mut simulator = start(&rig, &boards, 0);
    let mut gateway = rig.start(&["gateway", "--config", &path("gateway.toml")]);
    let mut estimator = rig.start(&["estimator", "--config", &boards.estimator]);
    let undescribed = line(&estimator, "the gateway does not have chest_imu");
    assert!(undescribed.contains("gateway.toml"), "{undescribed}");
    let silent = line(&gateway, "silent");
    for word in [
        "WARN",
        "l_arm_ft_sensor",
        "power",
        "address",
        "bit rate",
        "termination",
    ] {
        assert!(silent.contains(word), "{silent}");
    }
    let missing = line(&estimator, "no samples of l_arm_ft_sensor:");
    assert!(missing.contains("proprio status"), "{missing}");
    assert_eq!(warnings(&gateway.log()), [silent], "{}", gateway.log());
    assert_eq!(
        warnings(&estimator.log()),
        [undescribed, missing],
        "{}",
        estimator.log()
    );
    [&mut estimator, &mut gateway, &mut simulator]
        .into_iter()
        .for_each(Process::end);
}

/// SIGTERM stops the boards before the process ends.
#[test]
fn a_gateway_that_is_terminated_stops_its_boards() {
    let rig = Rig::new();
    let arm = Arm::slow().on_virtual(["a", "b"]).write(&rig.path("robot"));
    let mut simulator = start(&rig, &arm, 0);
    let mut gateway = start(&rig, &arm, 1);
    let domain = rig.open();
    let mut health = Newest::<GatewayHealth>::open(&domain, ROBOT);
    health.wait("all boards stream", |h| {
        h.device_count > 0
            && h.devices()
                .iter()
                .all(|d| d.state == DeviceState::Streaming)
    });
    // The other bus has motor boards only, which have no command that stops their stream.
    let mut bus = VirtualBus::open(&rig.domain.name, "a", &[]).expect("a virtual bus");
    let mut quiet = |limit| {
        until(limit, || {
            // Ten periods of every board.
            let frame = bus.recv(now() + Nanos::from_millis(200));
            (!matches!(frame, Received::Frame(_))).then_some(())
        })
    };
    assert!(quiet(Nanos::from_millis(500)).is_none(), "they stream");
    gateway.end();
    assert!(
        quiet(Nanos::from_millis(20_000)).is_some(),
        "the boards stream on"
    );
    simulator.end();
}

/// Whichever step of a start it is that finds no file descriptor left.
#[test]
fn a_limit_of_open_files_that_is_too_low_is_named_with_its_remedy() {
    let rig = Rig::new();
    let arm = Arm::slow().on_virtual(["a", "b"]).write(&rig.path("robot"));
    let limited = |limit: u32, verb: &str, config: &str| {
        let mut command = rig.command(&[]);
        let program = Rig::program();
        let environment: Vec<_> = command
            .get_envs()
            .map(|(k, v)| (k.to_owned(), v.map(ToOwned::to_owned)))
            .collect();
        command = Command::new("sh");
        for (key, value) in environment {
            match value {
                Some(value) => command.env(key, value),
                None => command.env_remove(key),
            };
        }
        let script = format!("ulimit -n {limit}; exec \"$0\" {verb} {config}");
        let output = command
            .arg("-c")
            .arg(script)
            .arg(program)
            .output()
            .expect("a shell");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (
            output.status.code(),
            text(&output.stdout) + &text(&output.stderr),
        )
    };
    for limit in [8, 10, 12, 14, 16, 18, 20, 22, 24, 26] {
        for (verb, config) in [("gateway", &arm.gateway), ("estimator", &arm.estimator)] {
            let (code, said) = limited(limit, verb, &format!("--config {config}"));
            assert_eq!(code, Some(1), "{verb} with {limit}: {said}");
            let remedy = format!("the limit of {limit} open files is too low: `ulimit -n 1024`");
            assert!(
                said.contains(&remedy) && said.contains("LimitNOFILE=1024"),
                "{verb} with {limit}: {said}"
            );
        }
    }
    let finding = |limit| {
        let (_, said) = limited(limit, "doctor", "");
        let mut lines = said.lines().skip_while(|l| !l.contains("open files"));
        (
            lines.next().unwrap_or_default().to_owned(),
            lines.next().unwrap_or_default().to_owned(),
        )
    };
    let (low, hint) = finding(100);
    assert!(
        low.starts_with("lacking") && low.contains("may open 100"),
        "{low}"
    );
    assert!(hint.contains("LimitNOFILE=1024"), "{hint}");
    assert!(finding(256).0.starts_with("ok"), "{}", finding(256).0);
}

/// What a system has open is below what `proprio doctor` says that a run needs.
#[test]
fn a_run_opens_no_more_files_than_doctor_says() {
    let rig = Rig::new();
    let arm = Arm::slow().on_virtual(["a", "b"]).write(&rig.path("robot"));
    let mut processes = [0, 1, 2].map(|which| start(&rig, &arm, which));
    let domain = rig.open();
    let mut health = Newest::<EstimatorHealth>::open(&domain, ROBOT);
    health.wait("estimates", |h| h.estimates > 0);
    for process in &processes {
        let open = std::fs::read_dir(format!("/proc/{}/fd", process.id()));
        let open = open.expect("it runs").count();
        println!("{open} open files");
        assert!(open < 128, "{open}");
    }
    processes.iter_mut().rev().for_each(Process::end);
}
