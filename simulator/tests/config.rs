//! Every configuration of the project can be loaded, matches its URDF and can be simulated.

use proprio_simulator::{SimulatedRobot, SimulationSettings, Simulator};
use proprio_topics::Nanos;
use std::path::Path;

#[test]
fn every_robot_under_config_can_be_loaded_and_simulated() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
    let mut robots = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let folder = entry.unwrap().path();
        if !folder.join("gateway.toml").exists() {
            continue;
        }
        robots += 1;
        let robot = SimulatedRobot::load(&folder).unwrap_or_else(|e| panic!("{e}"));
        assert!(
            robot.model.warnings().is_empty(),
            "{}: {:?}",
            folder.display(),
            robot.model.warnings()
        );
        Simulator::new(&robot, &SimulationSettings::default(), Nanos::ZERO)
            .unwrap_or_else(|e| panic!("{e}"));
        // The gateway publishes everything that the estimator needs.
        for ft in &robot.config.force_torque {
            assert!(
                robot.plan.channel(&ft.sensor).is_some(),
                "{}: no channel for {:?}",
                folder.display(),
                ft.sensor
            );
        }
    }
    assert!(robots > 0);
}

/// The worst-case load of both buses of icub_left_arm, as stated in its gateway.toml.
#[test]
fn no_bus_carries_more_than_sixty_percent() {
    let robot = SimulatedRobot::open("icub_left_arm").unwrap();
    let mut log = Vec::new();
    proprio_simulator::record::record(
        &robot,
        &SimulationSettings::default(),
        2.0,
        Nanos::ZERO,
        &mut log,
    )
    .unwrap();
    for bus in &robot.plan.buses {
        // Bits in the second second, when the boards stream.
        let bits: usize = std::str::from_utf8(&log)
            .unwrap()
            .lines()
            .filter(|l| {
                l.starts_with("(0000000001.")
                    && l.split_whitespace().nth(1) == Some(bus.name.as_str())
            })
            .map(|l| (l.rsplit_once('#').unwrap().1.len()) / 2)
            .map(|bytes| 47 + 8 * bytes + (33 + 8 * bytes) / 4)
            .sum();
        assert!(
            bits > 100_000 && bits < 600_000,
            "{}: {bits} bits in a second",
            bus.name
        );
    }
}
