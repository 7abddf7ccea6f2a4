//! `proprio record --out FILE.mcap` beside a running robot, and verbs that read the file.
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_tests::watch::{open, valid_since};
use proprio_tests::{Arm, PATIENCE, Rig, until};
use proprio_topics::{Nanos, TorqueEstimate};
use std::collections::BTreeSet;
use std::fs;

/// The rows of a table, without its header.
fn rows(text: &str) -> BTreeSet<&str> {
    text.lines().skip(1).collect()
}

#[test]
fn a_recording_has_what_a_table_has_and_is_read_as_one() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .aligned(20.0)
        .write(&rig.path("robot"));
    let _simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let _gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let _estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let mut torques = open::<TorqueEstimate>(&rig.open(), "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());

    let path = |name: &str| rig.path(name).display().to_string();
    let (mcap, csv, killed) = (path("run.mcap"), path("run.csv"), path("killed.mcap"));
    let mut killed_one = rig.start(&["record", "--out", &killed]);
    let mut recording = rig.start(&["record", "--out", &mcap, "--seconds", "3"]);
    let mut table = rig.start(&["record", "--out", &csv, "--all", "--seconds", "3"]);
    table.wait();
    recording.wait();
    assert!(
        recording.output().contains(" samples in 3."),
        "{}",
        recording.output()
    );
    assert!(
        recording.output().contains("estimates of torques"),
        "{}",
        recording.output()
    );
    let id = Pid::from_raw(i32::try_from(killed_one.id()).expect("a process number"));
    kill(id, Signal::SIGKILL).expect("the signal is sent");
    until(PATIENCE, || killed_one.ended()).expect("it ends");

    // Both begin and end at other instants; in between, each row is the same to the last digit.
    let mut found = Vec::new();
    let recorded = fs::File::open(&mcap).expect("the recording");
    let summary = proprio_recording::to_table(recorded, &mut found).expect("it can be read");
    assert!(
        summary.values > 500 && summary.damaged == 0 && !summary.is_cut,
        "{summary:?}"
    );
    let (found, expected) = (
        String::from_utf8(found).expect("text"),
        fs::read_to_string(&csv).expect("the table"),
    );
    assert_eq!(found.lines().next(), expected.lines().next());
    let (own, other) = (rows(&found), rows(&expected));
    let common = own.intersection(&other).count();
    assert!(
        common > own.len() / 2,
        "{common} of {} and {}",
        own.len(),
        other.len()
    );

    // What verbs make of the recording is what they make of its table.
    let same = path("same.csv");
    fs::write(&same, &found).expect("a file of this test");
    let estimates = |samples: &str, out: &str| {
        rig.run(&[
            "estimate",
            "--config",
            &arm.estimator,
            "--samples",
            samples,
            "--out",
            out,
        ]);
        fs::read_to_string(out).expect("the estimates")
    };
    let of_recording = estimates(&mcap, &path("a.csv"));
    assert!(of_recording.lines().count() > 100);
    assert_eq!(of_recording, estimates(&same, &path("b.csv")));
    let refused = |samples: &str| {
        let arguments = ["identify", "--config", &arm.estimator, "--samples", samples];
        let output = rig.command(&arguments).output().expect("it runs");
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    assert_eq!(refused(&mcap), refused(&same));

    // A killed recorder leaves what it had flushed.
    let output = rig
        .command(&[
            "estimate",
            "--config",
            &arm.estimator,
            "--samples",
            &killed,
            "--out",
            &path("c.csv"),
        ])
        .output()
        .expect("it runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && said.contains("the end is missing or damaged"),
        "{said}"
    );
}
