//! Another program deletes, empties or shortens the files of a running domain: gateway and
//! estimator say so and make the files again, and a control loop in this process has valid torques
//! again without a restart. Meanwhile its values are stale, never wrong.
//!
//! Of deleted files nobody dies. A daemon may die of a shortened file in which it writes: iceoryx2
//! follows without checks what it finds there (and with the checks of a debug build, aborts). A
//! service manager starts the daemon again, and the loop goes on as before.
#![allow(missing_docs)]

use proprio_tests::damage::{DELETIONS, SHORTENINGS};
use proprio_tests::{Arm, PATIENCE, Process, Rig, now, until};
use proprio_topics::Nanos;
use proprio_topics::ipc::{RobotReader, Unavailable};
use std::fs;
use std::path::Path;

const ROBOT: &str = "icub_left_arm";

/// How many deleted segments a process has mapped, and how many files it has open.
fn held(process: &Process) -> [usize; 2] {
    let proc = Path::new("/proc").join(process.id().to_string());
    let maps = fs::read_to_string(proc.join("maps")).expect("a process that runs");
    let deleted = |line: &&str| line.contains("/proprio_") && line.ends_with(" (deleted)");
    let open = fs::read_dir(proc.join("fd")).expect("a process that runs");
    [maps.lines().filter(deleted).count(), open.count()]
}

#[test]
fn whatever_is_deleted_or_shortened_is_made_again() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .write(&rig.path("robot"));
    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let domain = rig.domain.clone();
    let mut robot = RobotReader::new(&domain, ROBOT, Nanos::from_millis(100)).expect("a thread");
    let elbow = robot.torque_handle("l_elbow");
    // A valid torque that was acquired after `since`, as a loop of 1 kHz reads it.
    let mut valid_after = |since: Nanos, meanwhile: &mut dyn FnMut()| {
        until(PATIENCE, || {
            meanwhile();
            robot.update(now());
            match robot.torque(elbow) {
                Ok(torque) => (now() - torque.age > since).then_some(()),
                Err(Unavailable::Unknown) => panic!("a name is lost"),
                Err(_) => None,
            }
        })
        .is_some()
    };
    assert!(
        valid_after(Nanos::ZERO, &mut || ()),
        "the chain does not start"
    );

    let before = [held(&gateway), held(&estimator)];
    for (what, damage) in DELETIONS {
        let start = now();
        damage(&rig);
        let recovered = valid_after(now() + Nanos::from_millis(300), &mut || ());
        for process in [&mut simulator, &mut gateway, &mut estimator] {
            process.assert_runs();
        }
        assert!(
            recovered,
            "{what}: no torque any more\ngateway:\n{}\nestimator:\n{}",
            gateway.log(),
            estimator.log()
        );
        println!("{what}: {} s", now() - start);
    }
    let is_given_back = until(PATIENCE, || {
        let after = [held(&gateway), held(&estimator)];
        let mut pairs = before.iter().zip(&after);
        // At most those of one domain of three stay; each has at least 20 of both.
        let is_few = |before: &[usize; 2], after: &[usize; 2]| {
            after[0] <= before[0] + 20 && after[1] <= before[1] + 20
        };
        pairs
            .all(|(before, after)| is_few(before, after))
            .then_some(())
    });
    assert!(
        is_given_back.is_some(),
        "mappings and descriptors: {before:?} before, {:?} after",
        [held(&gateway), held(&estimator)]
    );
    let streaming = gateway.log().matches("streaming device").count();
    assert_eq!(streaming, 9, "boards were started again\n{}", gateway.log());
    assert!(
        gateway.log().contains("by another program"),
        "{}",
        gateway.log()
    );

    for (what, damage) in SHORTENINGS {
        let start = now();
        damage(&rig);
        let mut restarts = 0;
        let recovered = valid_after(now() + Nanos::from_millis(300), &mut || {
            for (process, arguments) in [
                (&mut gateway, ["gateway", "--config", &arm.gateway]),
                (&mut estimator, ["estimator", "--config", &arm.estimator]),
            ] {
                if process.ended().is_some() {
                    *process = rig.start(&arguments);
                    restarts += 1;
                }
            }
        });
        simulator.assert_runs();
        assert!(
            recovered,
            "{what}: no torque any more\ngateway:\n{}\nestimator:\n{}",
            gateway.log(),
            estimator.log()
        );
        println!("{what}: {} s, {restarts} restarts", now() - start);
    }
    drop(robot);
    for process in [&mut simulator, &mut gateway, &mut estimator] {
        process.end();
    }
    rig.assert_nothing_left();
}
