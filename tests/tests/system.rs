//! `proprio status`, `echo` and `record` beside a running system.
#![allow(missing_docs)]

use proprio_tests::watch::{open, valid_since};
use proprio_tests::{Arm, PATIENCE, Rig, until};
use proprio_topics::csv::{Reader, Row, Value, What};
use proprio_topics::{Kind, Nanos, TorqueEstimate};
use serde_json::Value as Json;

#[test]
fn a_running_system_says_what_it_does() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .write(&rig.path("robot"));
    let out = |arguments: &[&str]| {
        let output = rig.command(arguments).output().expect("it runs");
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        (
            output.status.code(),
            text(&output.stdout),
            text(&output.stderr),
        )
    };
    // Nobody is there: the commands say so, and create nothing.
    let (code, _, err) = out(&["status"]);
    assert!(
        code == Some(1) && err.contains("no gateway or estimator runs"),
        "{err}"
    );

    let mut simulator = rig.start(&["simulate", "--robot", &arm.folder, "--skin"]);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    let domain = rig.open();
    let mut torques = open::<TorqueEstimate>(&domain, "icub_left_arm");
    assert!(valid_since(&mut torques, Nanos::ZERO, PATIENCE).is_some());

    let (code, text, err) = out(&["status", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let status: Json = serde_json::from_str(&text).expect("JSON");
    let robot = &status["robots"][0];
    assert_eq!(robot["robot"], "icub_left_arm");
    for process in ["gateway", "estimator"] {
        assert_eq!(robot[process]["is"], "is running", "{text}");
    }
    assert_eq!(robot["gateway"]["health"]["buses"][0]["link"], "up");
    let rates: Vec<_> = robot["channels"]
        .as_array()
        .expect("a list")
        .iter()
        .collect();
    assert_eq!(rates.len(), 9);
    for channel in rates {
        // Not a measure of speed: a machine that does other things catches up in bursts.
        let rate = channel["rate_hz"].as_f64().expect("a rate");
        assert!((20.0..5000.0).contains(&rate), "{channel}");
        assert!(
            channel["age_s"].as_f64().is_some_and(|age| age < 5.0),
            "{channel}"
        );
    }
    let health = &robot["estimator"]["health"];
    let rate = health["estimates_hz"].as_f64().expect("a rate");
    assert!((20.0..5000.0).contains(&rate), "{health}");
    let (_, text, _) = out(&["status"]);
    for part in [
        "robot icub_left_arm",
        "gateway is running",
        "streaming",
        "l_arm_ft_sensor",
    ] {
        assert!(text.contains(part), "{text}");
    }

    let (code, text, err) = out(&["echo", "l_arm_ft_sensor", "--count", "5", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let samples: Vec<Json> = text
        .lines()
        .map(|l| serde_json::from_str(l).expect("JSON"))
        .collect();
    assert_eq!(samples.len(), 5);
    assert!(
        samples
            .windows(2)
            .all(|w| w[0]["t_ns"].as_i64() < w[1]["t_ns"].as_i64())
    );
    assert!(
        samples[0]["values"]["fz"]
            .as_f64()
            .is_some_and(|fz| fz != 0.0),
        "{text}"
    );
    let (code, _, err) = out(&["echo", "l_arm_ft_sensr"]);
    assert!(
        code == Some(1) && err.contains("did you mean \"l_arm_ft_sensor\"?"),
        "{err}"
    );

    // A recording holds what was published, in order, over a restart of the gateway.
    let table = rig.path("samples.csv");
    let table_text = table.to_string_lossy().into_owned();
    let mut recording = rig.start(&["record", "--out", &table_text, "--seconds", "3"]);
    let begun = || std::fs::metadata(&table).is_ok_and(|m| m.len() > 64 << 10);
    assert!(
        until(PATIENCE, || begun().then_some(())).is_some(),
        "no rows"
    );
    gateway.kill();
    gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    recording.wait();
    let said = recording.output();
    assert!(said.contains(" 0 lost, 0 out of order"), "{said}");
    let mut reader = Reader::new(std::fs::File::open(&table).expect("a table")).expect("a table");
    let series = reader.series().to_vec();
    assert!(
        series
            .iter()
            .any(|s| s.what == What::Contact && s.name == "hand"),
        "{series:?}"
    );
    let ft = series
        .iter()
        .position(|s| s.what == What::Channel(Kind::Wrench));
    let (mut row, mut last, mut count) = (Row::default(), Nanos::MIN, 0);
    while reader.next_row(&mut row).expect("readable") {
        let t = row.t.expect("a stamp");
        assert!(t >= last);
        if row
            .items
            .iter()
            .any(|item| Some(item.series) == ft && matches!(item.value, Value::Reading(..)))
        {
            count += 1;
        }
        last = t;
    }
    assert_eq!(reader.report().bad_rows, 0);
    // Most of three seconds at 250 Hz, on a machine that may catch up in bursts.
    assert!((400..=2000).contains(&count), "{count}");
    [&mut estimator, &mut gateway, &mut simulator]
        .into_iter()
        .for_each(proprio_tests::Process::end);
    drop((torques, domain));
    rig.assert_nothing_left();
}
