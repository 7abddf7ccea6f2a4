//! Every file under config/ works: the program that reads it on a robot loads it. No file is left
//! untested.

use proprio_dynamics::model::Model;
use proprio_estimator::config::Config;
use proprio_estimator::setup::Setup;
use proprio_gateway::plan::Plan;
use proprio_simulator::SimulatedRobot;
use proprio_topics::Kind;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn config() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("tests/ lies in the workspace")
        .join("config")
}

/// The folders of the robots: every folder but that of the systemd units.
fn robots() -> Vec<PathBuf> {
    let folders = std::fs::read_dir(config())
        .expect("config/")
        .flatten()
        .map(|e| e.path())
        .filter(|p| p.is_dir());
    let mut robots: Vec<_> = folders.filter(|p| !p.ends_with("systemd")).collect();
    robots.sort();
    assert!(robots.iter().any(|p| p.ends_with("icub_left_arm")));
    robots
}

#[test]
fn no_file_is_left_out() {
    let mut left: Vec<PathBuf> = Vec::new();
    let mut folders = vec![config()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let path = entry.path();
            let name = entry.file_name().to_string_lossy().into_owned();
            if path.is_dir() {
                folders.push(path);
            } else if !(["gateway.toml", "estimator.toml", "README.md"].contains(&name.as_str())
                || name.ends_with(".urdf")
                || name.ends_with(".service")
                || name == "proprio.sysusers")
            {
                left.push(path);
            }
        }
    }
    assert!(left.is_empty(), "no test of this file loads {left:?}");
}

/// The names of the channels of one kind.
fn names<'a>(channels: impl Iterator<Item = (Kind, &'a str)>, kind: Kind) -> BTreeSet<&'a str> {
    channels
        .filter(|(k, _)| *k == kind)
        .map(|(_, name)| name)
        .collect()
}

#[test]
fn every_robot_loads_and_its_files_fit_each_other() {
    for folder in robots() {
        let at = folder.display();
        let (gateway, estimator) = (folder.join("gateway.toml"), folder.join("estimator.toml"));
        let plan = gateway
            .is_file()
            .then(|| Plan::load(&gateway).unwrap_or_else(|e| panic!("{e}")));
        let config = estimator
            .is_file()
            .then(|| Config::load(&estimator).unwrap_or_else(|e| panic!("{e}")));
        assert!(
            plan.is_some() || config.is_some(),
            "{at} has neither gateway.toml nor estimator.toml"
        );
        if let Some(plan) = &plan {
            assert!(
                !plan.channels.is_empty(),
                "{at}: the gateway has no channel"
            );
        }
        let Some(config) = config else { continue };
        if !config.model.is_file() {
            // A URDF that may not be redistributed is fetched; a comment in the file gives its
            // origin.
            let text = std::fs::read_to_string(&estimator).unwrap();
            let name = config
                .model
                .file_name()
                .unwrap()
                .to_string_lossy()
                .into_owned();
            let is_named = text
                .lines()
                .any(|l| l.starts_with('#') && l.contains(&name));
            assert!(
                is_named,
                "{at}: there is no {}, and no comment says where it comes from",
                config.model.display()
            );
            continue;
        }
        let setup = Setup::new(&config).unwrap_or_else(|e| panic!("{}: {e}", estimator.display()));
        assert!(setup.warnings().is_empty(), "{at}: {:?}", setup.warnings());
        let Some(plan) = plan else { continue };
        SimulatedRobot::load(&folder).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(plan.robot, setup.robot.name, "{at}");
        for kind in [Kind::Joint, Kind::Wrench, Kind::Imu] {
            let measured = names(
                plan.channels.iter().map(|c| (c.kind, c.name.as_str())),
                kind,
            );
            let read = names(
                setup
                    .robot
                    .channels
                    .iter()
                    .map(|c| (c.kind, c.name.as_str())),
                kind,
            );
            let missing: Vec<_> = read.difference(&measured).collect();
            assert!(
                missing.is_empty(),
                "{at}: the estimator waits for {missing:?}, which the gateway does not have"
            );
        }
    }
}

#[test]
fn every_urdf_is_a_model() {
    let mut count = 0;
    for folder in robots() {
        for entry in std::fs::read_dir(&folder)
            .unwrap()
            .flatten()
            .filter(|e| e.path().extension().is_some_and(|x| x == "urdf"))
        {
            let text = std::fs::read_to_string(entry.path()).unwrap();
            // If no joint is kept, F/T joints are folded like other fixed joints.
            let model = Model::from_urdf(&text, &[])
                .unwrap_or_else(|e| panic!("{}: {e}", entry.path().display()));
            assert!(
                model.warnings().is_empty(),
                "{}: {:?}",
                entry.path().display(),
                model.warnings()
            );
            assert!(model.dof_count() > 0 && model.link_count() == model.dof_count() + 1);
            count += 1;
        }
    }
    assert!(count > 0);
}

/// A unit as sections of keys; a key may occur more than once.
type Unit = BTreeMap<String, Vec<(String, String)>>;

fn parse(text: &str) -> Result<Unit, String> {
    let mut unit = Unit::new();
    let mut section = None;
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with(['#', ';']) {
            continue;
        }
        if let Some(name) = line.strip_prefix('[').and_then(|l| l.strip_suffix(']')) {
            section = Some(name.to_owned());
            unit.entry(name.to_owned()).or_default();
        } else {
            let (key, value) = line
                .split_once('=')
                .ok_or(format!("line {}: {line:?} has no =", number + 1))?;
            let section = section
                .clone()
                .ok_or(format!("line {}: before any section", number + 1))?;
            unit.entry(section)
                .or_default()
                .push((key.trim().to_owned(), value.trim().to_owned()));
        }
    }
    Ok(unit)
}

/// The single value of a key; empty if the key is missing.
fn value<'a>(unit: &'a Unit, section: &str, key: &str) -> &'a str {
    let mut found = unit
        .get(section)
        .into_iter()
        .flatten()
        .filter(|(k, _)| k == key);
    let value = found.next().map_or("", |(_, v)| v.as_str());
    assert!(found.next().is_none(), "{key} is there twice");
    value
}

/// The problems of a daemon's unit.
fn problems(unit: &Unit, daemon: &str) -> Vec<String> {
    let mut problems = Vec::new();
    let mut expect = |key: &str, fits: &dyn Fn(&str) -> bool| {
        let found = value(unit, "Service", key);
        if !fits(found) {
            problems.push(format!("{key}={found}"));
        }
    };
    // cli/tests/install.rs runs this line.
    let line = format!("proprio {daemon} --config /etc/proprio/{daemon}.toml");
    expect("ExecStart", &|v| v == line);
    expect("Type", &|v| v == "notify");
    expect("WatchdogSec", &|v| {
        v.strip_suffix('s')
            .and_then(|s| s.parse::<f64>().ok())
            .is_some_and(|s| s >= 1.0)
    });
    expect("Restart", &|v| v == "on-failure");
    expect("RestartSec", &|v| v == "200ms");
    expect("RestartSteps", &|v| v == "6");
    expect("RestartMaxDelaySec", &|v| v == "10s");
    // The exit code of a wrong configuration.
    expect("RestartPreventExitStatus", &|v| v == "2");
    expect("User", &|v| v == "proprio");
    expect("DynamicUser", &str::is_empty);
    expect("RuntimeDirectory", &|v| v == "proprio");
    expect("RuntimeDirectoryPreserve", &|v| v == "yes");
    expect("Environment", &|v| v == "PROPRIO_RUNTIME_DIR=/run/proprio");
    expect("LimitRTPRIO", &|v| v.parse::<u32>().is_ok_and(|p| p > 0));
    expect("LimitMEMLOCK", &|v| v == "infinity");
    // It would forbid what LimitRTPRIO permits.
    expect("RestrictRealtime", &str::is_empty);
    expect("ProtectSystem", &|v| v == "strict");
    expect("ReadWritePaths", &|v| v == "/dev/shm");
    for key in [
        "NoNewPrivileges",
        "PrivateDevices",
        "PrivateMounts",
        "PrivateTmp",
        "ProtectHome",
        "ProtectClock",
        "ProtectControlGroups",
        "ProtectKernelModules",
        "ProtectKernelTunables",
        "RestrictNamespaces",
        "RestrictSUIDSGID",
        "LockPersonality",
        "MemoryDenyWriteExecute",
    ] {
        expect(key, &|v| v == "yes");
    }
    // A private one would be a separate domain.
    expect("PrivateIPC", &str::is_empty);
    let (rights, families) = match daemon {
        "gateway" => ("CAP_NET_ADMIN", "AF_CAN AF_NETLINK AF_UNIX"),
        _ => ("", "AF_UNIX"),
    };
    expect("AmbientCapabilities", &|v| v == rights);
    expect("CapabilityBoundingSet", &|v| v == rights);
    expect("RestrictAddressFamilies", &|v| v == families);
    // @resources and @memlock are for real time.
    let filters: Vec<&str> = unit["Service"]
        .iter()
        .filter(|(key, _)| key == "SystemCallFilter")
        .map(|(_, value)| value.as_str())
        .collect();
    if filters != ["@system-service", "~@privileged"] {
        problems.push(format!("SystemCallFilter={filters:?}"));
    }
    if !unit
        .get("Service")
        .is_some_and(|s| s.iter().any(|(k, _)| k == "CapabilityBoundingSet"))
    {
        problems.push("CapabilityBoundingSet is not there: it would have every right".into());
    }
    if value(unit, "Install", "WantedBy") != "multi-user.target" {
        problems.push("it is not started at boot".into());
    }
    problems
}

#[test]
fn the_systemd_units_start_our_daemons_watched_and_in_a_sandbox() {
    let mut daemons = BTreeSet::new();
    for entry in std::fs::read_dir(config().join("systemd"))
        .unwrap()
        .flatten()
        .filter(|e| e.file_name() != "proprio.sysusers")
    {
        let name = entry.file_name().to_string_lossy().into_owned();
        let daemon = name
            .strip_prefix("proprio-")
            .and_then(|n| n.strip_suffix(".service"));
        let daemon = daemon
            .unwrap_or_else(|| panic!("{name} is not proprio-*.service"))
            .to_owned();
        let text = std::fs::read_to_string(entry.path()).unwrap();
        let unit = parse(&text).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(problems(&unit, &daemon), [""; 0], "{name}");
        // The check detects missing and surplus keys.
        for (from, to, expected) in [
            ("Type=notify", "Type=simple", "Type=simple"),
            ("\nWatchdogSec=2s", "", "WatchdogSec="),
            ("User=proprio", "DynamicUser=yes", "User="),
            (
                "RuntimeDirectoryPreserve=yes",
                "",
                "RuntimeDirectoryPreserve=",
            ),
            (
                "ProtectSystem=strict",
                "ProtectSystem=full",
                "ProtectSystem=full",
            ),
            (
                "LimitMEMLOCK=infinity",
                "RestrictRealtime=yes",
                "LimitMEMLOCK=",
            ),
        ] {
            assert!(text.contains(from), "{name}: {from}");
            let problems = problems(&parse(&text.replacen(from, to, 1)).unwrap(), &daemon);
            assert_eq!(
                problems.first().map(String::as_str),
                Some(expected),
                "{name}: {problems:?}"
            );
        }
        daemons.insert(daemon);
    }
    assert_eq!(
        daemons,
        BTreeSet::from(["estimator".to_owned(), "gateway".to_owned()])
    );
}
