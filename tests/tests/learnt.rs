//! The state of on-line identification survives the estimator's process: killed, stopped, with a
//! damaged file, or with a file of another robot. Gateway, simulator and estimator are processes on
//! virtual buses.
#![allow(missing_docs)]

use proprio_tests::watch::{Newest, open};
use proprio_tests::{Arm, PATIENCE, Process, Rig, now, until};
use proprio_topics::ipc::{Domain, Reader};
use proprio_topics::{EstimatorHealth, InertiaEstimate, Nanos};
use std::fs;
use std::path::Path;
use toml::{Table, Value};

const ROBOT: &str = "icub_left_arm";

/// The arm with on-line identification and a free hand; the state is saved periodically in `state`.
fn learning(state: &Path, save_every_s: f64) -> Arm {
    let mut arm = Arm::slow().on_virtual(["a", "b"]);
    let identification = Table::from_iter([
        ("enabled".to_owned(), true.into()),
        (
            "state".to_owned(),
            state.to_str().expect("a path in UTF-8").into(),
        ),
        ("save_every_s".to_owned(), save_every_s.into()),
    ]);
    arm.estimator
        .insert("identification".into(), identification.into());
    for contact in arm
        .estimator
        .get_mut("contact")
        .and_then(Value::as_array_mut)
        .into_iter()
        .flatten()
    {
        let contact = contact.as_table_mut().expect("a contact is a table");
        if contact.get("name").and_then(Value::as_str) == Some("hand") {
            contact.insert("presence".into(), "possible".into());
        }
    }
    arm
}

/// The next inertia that was published after `since` and fulfils `condition`.
fn inertia(
    reader: &mut Reader<InertiaEstimate>,
    since: Nanos,
    condition: impl Fn(&InertiaEstimate) -> bool,
) -> Option<Box<InertiaEstimate>> {
    until(PATIENCE, || {
        while let Some(estimate) = reader.try_take().expect("shared memory can be read") {
            if estimate.header.published > since && condition(&estimate) {
                return Some(Box::new(estimate));
            }
        }
        None
    })
}

/// The first inertia of an estimator that was started at `since`.
fn first(domain: &Domain, since: Nanos) -> Box<InertiaEstimate> {
    let mut reader = open::<InertiaEstimate>(domain, ROBOT);
    inertia(&mut reader, since, |_| true).expect("an estimator that identifies tells so")
}

/// The sum of the masses' variances.
fn uncertainty(estimate: &InertiaEstimate) -> f64 {
    let variance = |deviations: &[f64; 10]| deviations[0] * deviations[0];
    estimate
        .links()
        .iter()
        .map(|link| variance(&link.standard_deviation))
        .sum()
}

fn masses(estimate: &InertiaEstimate) -> Vec<f64> {
    estimate
        .links()
        .iter()
        .map(|link| link.parameters[0])
        .collect()
}

fn wait_for(process: &Process, words: &str) {
    let found = until(PATIENCE, || process.log().contains(words).then_some(()));
    assert!(
        found.is_some(),
        "the log does not contain {words:?}:\n{}",
        process.log()
    );
}

#[test]
fn what_was_learnt_survives_the_process() {
    let rig = Rig::new();
    let state = rig.path("learnt");
    let often = learning(&state, 1.0).write(&rig.path("often"));
    let seldom = learning(&state, 3600.0).write(&rig.path("seldom"));
    let start = |config: &str| rig.start(&["estimator", "--config", config]);
    let mut simulator = rig.start(&["simulate", "--robot", &often.folder]);
    let mut gateway = rig.start(&["gateway", "--config", &often.gateway]);
    let began = now();
    let mut estimator = start(&often.estimator);
    let domain = rig.open();
    let mut reader = open::<InertiaEstimate>(&domain, ROBOT);
    let start_of_all = inertia(&mut reader, began, |_| true).expect("an inertia is published");
    assert_ne!(
        start_of_all.header.acquired,
        Nanos::MIN,
        "there was nothing to resume"
    );
    let learnt = inertia(&mut reader, began, |e| {
        e.links()
            .iter()
            .all(|link| link.accepted == 1 && link.motion > 2.0)
    });
    let learnt = learnt.unwrap_or_else(|| {
        let newest = inertia(&mut reader, began, |_| true).map(|e| e.links().to_vec());
        let health = Newest::<EstimatorHealth>::open(&domain, ROBOT).wait("how it is", |_| true);
        panic!("nothing is learnt: {newest:?} {:?}", health.identification)
    });
    // After two seconds of motion no solution is in use yet, so the certainty is at most that of
    // the CAD.
    assert!(uncertainty(&learnt) <= uncertainty(&start_of_all));
    // The health's counters agree.
    let mut health = Newest::<EstimatorHealth>::open(&domain, ROBOT);
    let counts = health
        .wait("instants are learnt from", |h| h.identification.learnt > 0)
        .identification;
    assert_eq!(
        (counts.groups, counts.contact, counts.failed),
        (1, 0, 0),
        "{counts:?}"
    );
    drop((health, reader));
    let written = || fs::metadata(&state).and_then(|m| m.modified()).ok();
    let before = written();
    let saved = until(PATIENCE, || (written() > before).then_some(()));
    assert!(saved.is_some(), "nothing is kept");

    // Killed without a chance to save.
    estimator.kill();
    let since = now();
    let mut estimator = start(&often.estimator);
    let resumed = first(&domain, since);
    assert_eq!(
        resumed.header.acquired,
        Nanos::MIN,
        "it begins with what was kept"
    );
    assert!(
        resumed
            .links()
            .iter()
            .all(|link| link.motion == 0.0 && link.accepted == 1)
    );
    // The offset is estimated again, so it is a little less certain; the CAD is far less certain.
    assert!(uncertainty(&resumed) <= uncertainty(&start_of_all));
    let close = |to: &InertiaEstimate| {
        let deviation = uncertainty(&learnt).sqrt();
        masses(&resumed)
            .iter()
            .zip(masses(to))
            .all(|(a, b)| (a - b).abs() < 3.0 * deviation)
    };
    assert!(
        close(&learnt),
        "{:?} {:?}",
        masses(&resumed),
        masses(&learnt)
    );
    wait_for(&estimator, "identification resumes from this state");

    // Stopped: it saves its state, long before the next periodic time.
    estimator.end();
    let since = now();
    let mut estimator = start(&seldom.estimator);
    let mut reader = open::<InertiaEstimate>(&domain, ROBOT);
    let again = inertia(&mut reader, since, |e| e.header.acquired > Nanos::MIN);
    assert!(again.is_some(), "it does not learn");
    drop(reader);
    fs::remove_file(&state).expect("it was there");
    estimator.end();
    let kept = fs::read_to_string(&state).expect("kept at the end");
    assert!(
        estimator
            .log()
            .contains("observations of identification: learnt"),
        "{}",
        estimator.log()
    );

    // A damaged file, for example after a full disk.
    fs::write(&state, &kept[..kept.len() / 2]).expect("a file");
    let since = now();
    let mut estimator = start(&seldom.estimator);
    wait_for(&estimator, "identification starts without it");
    let log = estimator.log();
    assert!(
        log.contains("is damaged") && log.contains("learnt.bad-1"),
        "{log}"
    );
    let aside = fs::read_to_string(rig.path("learnt.bad-1")).expect("set aside");
    assert_eq!(aside, kept[..kept.len() / 2]);
    assert_ne!(
        first(&domain, since).header.acquired,
        Nanos::MIN,
        "from CAD"
    );
    estimator.kill();

    // Another robot's.
    fs::write(&state, &kept).expect("a file");
    let mut other = learning(&state, 3600.0);
    other.estimator.insert("robot".into(), "right_arm".into());
    other.gateway.insert("robot".into(), "right_arm".into());
    let other = other.write(&rig.path("other"));
    let mut estimator = start(&other.estimator);
    wait_for(&estimator, "learnt.bad-2");
    let log = estimator.log();
    assert!(
        log.contains("is for another robot: icub_left_arm instead of right_arm"),
        "{log}"
    );
    estimator.end();
    assert!(
        !state.exists(),
        "nothing is identified, so no state is saved"
    );

    drop(domain);
    [&mut gateway, &mut simulator]
        .into_iter()
        .for_each(Process::end);
    rig.assert_nothing_left();
}

/// A daemon with a wrong direction of a force/torque sensor reports it in its first minute.
#[test]
fn a_sensor_the_wrong_way_round_is_told_live() {
    let rig = Rig::new();
    let robot =
        proprio_simulator::SimulatedRobot::find(ROBOT).expect("the robot of this repository");
    let config = fs::read_to_string(robot.join("estimator.toml")).expect("a configuration");
    let mut turned = config.clone();
    for (from, to) in [
        ("model = \"", format!("model = \"{}/", robot.display())),
        (
            "direction = \"child_to_parent\"",
            "direction = \"parent_to_child\"".into(),
        ),
        (
            "link = \"l_hand\"",
            "link = \"l_hand\"\npresence = \"possible\"".into(),
        ),
    ] {
        assert_eq!(config.matches(from).count(), 1, "{from}");
        turned = turned.replace(from, &to);
    }
    let file = rig.path("turned.toml");
    fs::write(&file, turned).expect("a file");
    let gateway = robot.join("gateway.toml");
    let [gateway, file] = [&gateway, &file].map(|path| path.to_str().expect("a path in UTF-8"));
    let mut simulator = rig.start(&["simulate", "--robot", ROBOT, "--skin"]);
    let mut gateway = rig.start(&["gateway", "--config", gateway]);
    let mut estimator = rig.start(&["estimator", "--config", file]);
    let words = "l_arm_ft_sensor fits only with the opposite sign";
    let line = until(PATIENCE + Nanos::from_millis(20_000), || {
        estimator.log().contains(words).then_some(())
    });
    assert!(line.is_some(), "{}", estimator.log());
    [&mut estimator, &mut gateway, &mut simulator]
        .into_iter()
        .for_each(Process::end);
}
