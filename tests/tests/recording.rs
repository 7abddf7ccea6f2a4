//! `proprio record --out FILE.mcap` beside a running robot, verbs that read the file, and black
//! boxes.
#![allow(missing_docs)]

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_tests::watch::{open, valid_since};
use proprio_tests::{Arm, PATIENCE, Process, Rig, Written, until};
use proprio_topics::ipc::monotonic;
use proprio_topics::{Nanos, Sample, TorqueEstimate};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;

/// A simulated arm whose torques are valid: simulator, gateway, estimator.
fn running(rig: &Rig) -> (Written, [Process; 3]) {
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .aligned(20.0)
        .write(&rig.path("robot"));
    let processes = [
        rig.start(&["simulate", "--robot", &arm.folder]),
        rig.start(&["gateway", "--config", &arm.gateway]),
        rig.start(&["estimator", "--config", &arm.estimator]),
    ];
    let mut torques = open::<TorqueEstimate>(&rig.open(), "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());
    (arm, processes)
}

/// The rows of a table, without its header.
fn rows(text: &str) -> BTreeSet<&str> {
    text.lines().skip(1).collect()
}

#[test]
fn a_recording_has_what_a_table_has_and_is_read_as_one() {
    let rig = Rig::new();
    let (arm, [_simulator, _gateway, _estimator]) = running(&rig);

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

/// The values of a column that are there, by the text of their instant.
fn column(table: &str, name: &str) -> BTreeMap<String, String> {
    let mut lines = table
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>());
    let header = lines.next().expect("a header");
    let place = header.iter().position(|column| *column == name);
    let place = place.unwrap_or_else(|| panic!("no column {name} in {header:?}"));
    lines
        .filter(|row| !row[place].is_empty())
        .map(|row| (row[0].to_owned(), row[place].to_owned()))
        .collect()
}

/// A recording with frames and configuration stands for itself: what is estimated, decoded and
/// replayed from it is what was live.
#[test]
fn a_recording_with_frames_and_configuration_is_enough() {
    let rig = Rig::new();
    let (arm, [_simulator, mut gateway, _estimator]) = running(&rig);

    let path = |name: &str| rig.path(name).display().to_string();
    let mut recorder = rig.start(&[
        "record",
        "--out",
        &path("run.mcap"),
        "--seconds",
        "5",
        "--frames",
        "virtual:a",
        "--frames",
        "virtual:b",
        "--config",
        &arm.estimator,
        "--config",
        &arm.gateway,
    ]);
    let mut split = rig.start(&[
        "record",
        "--out",
        &path("part.mcap"),
        "--seconds",
        "5",
        "--split",
        "2",
    ]);
    recorder.wait();
    split.wait();
    let output = recorder.output();
    assert!(output.contains(" frames, 0 lost"), "{output}");

    let table = |recording: &str, more: &[&str]| {
        let out = path("table.csv");
        let mut arguments = vec!["table", "--recording", recording, "--out", &out];
        arguments.extend(more);
        rig.run(&arguments);
        fs::read_to_string(&out).expect("the table")
    };

    // The whole time is in the parts, each of which can be read alone.
    let fx = "wrench/l_arm_ft_sensor/fx";
    let whole = column(&table(&path("run.mcap"), &[]), fx);
    let mut in_parts = BTreeMap::new();
    for number in 1..=3 {
        let part = table(&path(&format!("part_{number:04}.mcap")), &[]);
        in_parts.extend(column(&part, fx));
    }
    let (begin, end) = (in_parts.keys().next(), in_parts.keys().next_back());
    let common = whole
        .iter()
        .filter(|(t, _)| Some(*t) >= begin && Some(*t) <= end);
    let (mut count, mut missing) = (0, 0);
    for (t, force) in common {
        count += 1;
        missing += u64::from(in_parts.get(t) != Some(force));
    }
    assert!(count > 500 && missing == 0, "{missing} of {count}");

    // The robot's configuration is in it, and what is estimated with it is what was estimated live,
    // to the last digit wherever all samples had come in time. The differentiation of the first
    // samples is of a window that began before.
    let [run, estimates] = [path("run.mcap"), path("estimates.csv")];
    rig.run(&["estimate", "--samples", &run, "--out", &estimates]);
    let again = fs::read_to_string(&estimates).expect("the estimates");
    let live = table(&run, &["--estimates"]);
    let (again, live) = (
        column(&again, "torque/l_elbow"),
        column(&live, "torque/l_elbow"),
    );
    let common: Vec<_> = live
        .iter()
        .filter(|(t, _)| again.contains_key(*t))
        .collect();
    let same = common
        .iter()
        .filter(|(t, torque)| again.get(*t) == Some(torque))
        .count();
    assert!(
        common.len() > 200 && common.len() > live.len() * 3 / 4,
        "{}",
        common.len()
    );
    assert!(same > common.len() / 2, "{same} of {}", common.len());

    // Its frames are decoded to the samples that the gateway published.
    let [decoded, log] = [path("decoded.csv"), path("run.mcap")];
    rig.run(&[
        "decode",
        "--config",
        &arm.gateway,
        "--log",
        &log,
        "--out",
        &decoded,
    ]);
    let decoded = fs::read_to_string(&decoded).expect("the table");
    let values = |table: &str| -> Vec<String> {
        let name = "wrench/l_arm_ft_sensor/fx";
        let header = table.lines().next().expect("a header").split(',');
        let place = header
            .into_iter()
            .position(|column| column == name)
            .expect(name);
        let rows = table
            .lines()
            .skip(1)
            .map(|row| row.split(',').nth(place).expect("a cell"));
        rows.filter(|cell| !cell.is_empty())
            .map(str::to_owned)
            .collect()
    };
    let (of_frames, published) = (values(&decoded), values(&table(&run, &[])));
    let longest = (0..40.min(published.len()))
        .map(|skip| {
            let begin = of_frames.iter().position(|value| *value == published[skip]);
            let rest = begin.map_or(&[][..], |begin| &of_frames[begin..]);
            rest.iter()
                .zip(&published[skip..])
                .take_while(|(a, b)| a == b)
                .count()
        })
        .max();
    assert!(
        longest > Some(published.len() / 2),
        "{longest:?} of {}",
        published.len()
    );

    // A replay bus reads it as any log.
    gateway.kill();
    let replayed = fs::read_to_string(&arm.gateway).expect("a configuration");
    // A replayed bus takes the frames of an interface with its own name.
    let mut replayed = replayed
        .replace("name = \"left_arm\"\n", "name = \"a\"\n")
        .replace("name = \"left_arm_motors\"\n", "name = \"b\"\n");
    for bus in ["a", "b"] {
        let source = format!("kind = \"replay\"\nlog = {log:?}\npace = \"recorded\"");
        replayed = replayed.replace(&format!("kind = \"virtual\"\nname = \"{bus}\""), &source);
    }
    assert!(replayed.matches("replay").count() == 2, "{replayed}");
    let config = path("replay.toml");
    fs::write(&config, replayed).expect("a file of this test");
    let since = monotonic();
    let _replay = rig.start(&["gateway", "--config", &config]);
    let mut samples = open::<Sample>(&rig.open(), "icub_left_arm");
    let seen = until(PATIENCE, || {
        let sample = samples.try_take().ok()??;
        (sample.header.acquired > since).then_some(())
    });
    assert!(seen.is_some(), "the replayed log has no samples");
}

/// A black box writes what happened: a gateway that is killed, a torque that is withheld, and what
/// is asked for; and none of its samples is lost meanwhile.
#[test]
fn a_black_box_writes_when_something_happens() {
    let rig = Rig::new();
    let (arm, [_simulator, mut gateway, mut estimator]) = running(&rig);

    let folder = rig.path("box");
    let out = folder.display().to_string();
    let arguments = [
        "record",
        "--ring",
        "4",
        "--out",
        &out,
        "--config",
        &arm.estimator,
    ];
    let mut recorder = rig.start(&arguments);
    let files = |why: &str| -> Vec<String> {
        let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
        let names = entries.map(|entry| entry.path().display().to_string());
        names
            .filter(|name| name.ends_with(&format!("_{why}.mcap")))
            .collect()
    };
    // It refuses a second one.
    let ask = || rig.command(&["ctl", "snapshot"]).output().expect("it runs");
    let asked = until(PATIENCE, || {
        Some(ask()).filter(|output| output.status.success())
    });
    let asked = String::from_utf8_lossy(&asked.expect("a snapshot").stdout).into_owned();
    let second = rig.command(&arguments).output().expect("it runs");
    let second = String::from_utf8_lossy(&second.stderr).into_owned();
    assert!(second.contains("another recorder with --ring"), "{second}");
    let file = files("asked").pop().expect("the file");
    assert_eq!(asked.trim(), format!("{file} is written"));
    std::thread::sleep(std::time::Duration::from_secs(6));
    rig.run(&["ctl", "snapshot"]);
    let file = files("asked").into_iter().max().expect("the file");
    rig.run(&[
        "estimate",
        "--samples",
        &file,
        "--out",
        &rig.path("e.csv").display().to_string(),
    ]);
    let estimates = fs::read_to_string(rig.path("e.csv")).expect("the estimates");
    let valid = column(&estimates, "torque/l_elbow");
    let at = |t: Option<&String>| t.expect("an instant").parse::<f64>().expect("a number");
    let span = at(valid.keys().next_back()) - at(valid.keys().next());
    assert!(
        valid.len() > 100 && span > 3.0 && span < 5.5,
        "{span} {}",
        valid.len()
    );

    let all = || -> BTreeSet<String> {
        let entries = fs::read_dir(&folder).expect("the folder").flatten();
        let names = entries.map(|entry| entry.path().display().to_string());
        names.filter(|name| name.ends_with(".mcap")).collect()
    };
    let before = all();
    estimator.kill();
    gateway.kill();
    let killed = monotonic();
    // On a busy machine something else may have happened before, and have the name of the file.
    let reaches = |file: &String| {
        let out = rig.path("last.csv").display().to_string();
        rig.run(&["table", "--recording", file, "--out", &out]);
        let forces = column(
            &fs::read_to_string(&out).expect("the table"),
            "wrench/l_arm_ft_sensor/fx",
        );
        let span = at(forces.keys().next_back()) - at(forces.keys().next());
        span > 1.0 && at(forces.keys().next_back()) > killed.seconds() - 0.5
    };
    let written = until(PATIENCE, || {
        all().difference(&before).any(reaches).then_some(())
    });
    assert!(written.is_some(), "{:?} {}", all(), recorder.output());
    let id = Pid::from_raw(i32::try_from(recorder.id()).expect("a process number"));
    kill(id, Signal::SIGTERM).expect("the signal is sent");
    recorder.wait();
    let output = recorder.output();
    assert!(output.contains(" 0 lost"), "{output}");
    let ends = |entry: &fs::DirEntry| entry.path().extension().is_some_and(|it| it == "mcap");
    let entries = fs::read_dir(&folder).expect("the folder").flatten();
    assert!(
        entries.into_iter().all(|entry| ends(&entry)),
        "half of a file is left"
    );
}
