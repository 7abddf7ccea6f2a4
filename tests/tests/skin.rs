//! A skin from the bus to the contact wrench: the simulated boards of an arm and of the skin on its
//! forearm, the gateway's devices, and the estimator.
#![allow(missing_docs)]

use proprio_simulator::record::record;
use proprio_simulator::{InjectedFault, SimulationSettings};
use proprio_tests::watch::Newest;
use proprio_tests::{Arm, Rig, Written};
use proprio_topics::{ContactEstimate, Nanos};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use toml::{Table, Value};

/// The distance of neighbouring taxels \[m\].
const PITCH: f64 = 0.006;
/// The push: where, in which direction (into the skin), and how strong \[N\].
const PLACE: [f64; 3] = [0.0305, -0.052, 0.0];
const ALONG: [f64; 3] = [-1.0, 0.0, 0.0];
const FORCE: f64 = 12.0;

/// 16 triangles around a forearm of 3 cm radius.
fn taxels() -> String {
    let mut text = String::from("x,y,z,nx,ny,nz\n");
    for triangle in 0..16 {
        for own in 0..12 {
            let side = f64::from(triangle % 4) * std::f64::consts::FRAC_PI_2;
            let around = side + (f64::from(own / 4) - 1.0) * PITCH / 0.03;
            let along = -0.03 - 4.0 * PITCH * f64::from(triangle / 4) - PITCH * f64::from(own % 4);
            let (sin, cos) = around.sin_cos();
            text += &match own {
                6 | 10 => "0,0,0,0,0,0\n".to_owned(),
                _ => format!("{},{along},{},{cos},0,{sin}\n", 0.03 * cos, 0.03 * sin),
            };
        }
    }
    text
}

/// The arm with a skin board and a possible contact on its forearm, in this folder.
fn arm(arm: Arm, folder: &Path) -> Written {
    let mut arm = arm;
    let table = |pairs: &[(&str, Value)]| {
        Value::Table(Table::from_iter(
            pairs.iter().map(|(k, v)| ((*k).to_owned(), v.clone())),
        ))
    };
    let bus = &mut arm.gateway["bus"].as_array_mut().unwrap()[0];
    let devices = bus["device"].as_array_mut().unwrap();
    devices.push(table(&[
        ("driver", "icub_skin".into()),
        ("name", "l_forearm_skin".into()),
        ("address", 5.into()),
        ("max_silence_ms", 500.into()),
        ("period_ms", 20.into()),
    ]));
    let contacts = arm.estimator["contact"].as_array_mut().unwrap();
    for contact in contacts
        .iter_mut()
        .filter(|c| c["name"].as_str() == Some("hand"))
    {
        contact
            .as_table_mut()
            .unwrap()
            .insert("presence".into(), "possible".into());
    }
    contacts.push(table(&[
        ("name", "forearm".into()),
        ("link", "l_forearm".into()),
        ("kind", "force".into()),
        ("presence", "possible".into()),
    ]));
    arm.estimator.insert(
        "skin".into(),
        vec![table(&[
            ("channel", "l_forearm_skin".into()),
            ("link", "l_forearm".into()),
            ("contact", "forearm".into()),
            ("taxels", "taxels.csv".into()),
            ("max_silence_ms", 1000.0.into()),
        ])]
        .into(),
    );
    // The simulated arm is exactly that of its URDF.
    arm.estimator.insert(
        "identification".into(),
        table(&[("urdf_relative_std", 0.0.into())]),
    );
    fs::create_dir_all(folder).unwrap();
    fs::write(folder.join("taxels.csv"), taxels()).unwrap();
    arm.write(folder)
}

fn push(from: f64, until: f64) -> String {
    let list = |v: [f64; 3]| v.map(|x| x.to_string()).join(",");
    format!(
        "push:l_forearm={FORCE}:{}:{}@{from}..{until}",
        list(PLACE),
        list(ALONG)
    )
}

fn truth() -> [f64; 6] {
    let [x, y, z] = ALONG.map(|d| d * FORCE);
    let [px, py, pz] = PLACE;
    [x, y, z, py * z - pz * y, pz * x - px * z, px * y - py * x]
}

fn away(position: [f64; 3]) -> f64 {
    position
        .iter()
        .zip(PLACE)
        .map(|(a, b)| (a - b).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// The columns of a table by name, as text.
fn table(file: &Path) -> BTreeMap<String, Vec<String>> {
    let text = fs::read_to_string(file).unwrap();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let mut columns: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for line in lines {
        for (name, cell) in names.iter().zip(line.split(',')) {
            columns
                .entry((*name).to_owned())
                .or_default()
                .push(cell.to_owned());
        }
    }
    columns
}

/// A recorded bus with a push of two seconds on the moving arm: with the skin the contact is where
/// it is, and its wrench right within what is stated; without it, it comes from F/T readings alone.
#[test]
fn a_touch_on_the_bus_becomes_a_wrench_where_it_is() {
    const FROM: f64 = 4.0;
    let rig = Rig::new();
    let written = arm(Arm::new().aligned(20.0), &rig.path("robot"));
    let settings = SimulationSettings {
        push: false,
        faults: vec![push(FROM, FROM + 2.0).parse::<InjectedFault>().unwrap()],
        ..SimulationSettings::default()
    };
    let log = rig.path("session.log");
    let t0 = Nanos::from_millis(1000);
    let file = fs::File::create(&log).unwrap();
    let recorded = record(&written.robot, &settings, 8.0, t0, file).unwrap();
    assert!(
        recorded.iter().all(|bus| bus.counts.refused == 0),
        "{recorded:?}"
    );
    let path = |name: &str| rig.path(name).to_string_lossy().into_owned();
    let (log, samples) = (path("session.log"), path("samples.csv"));
    rig.run(&[
        "decode",
        "--config",
        &written.gateway,
        "--log",
        &log,
        "--out",
        &samples,
    ]);
    // The same without a skin.
    let text = fs::read_to_string(&written.estimator).unwrap();
    let mut blind: Table = text.parse().unwrap();
    blind.remove("skin");
    fs::write(rig.path("robot/blind.toml"), blind.to_string()).unwrap();
    let mut found = BTreeMap::new();
    for (name, config) in [
        ("skin", written.estimator.clone()),
        ("blind", path("robot/blind.toml")),
    ] {
        let out = path(&format!("{name}.csv"));
        rig.run(&[
            "estimate", "--config", &config, "--log", &samples, "--out", &out,
        ]);
        found.insert(name, table(Path::new(&out)));
    }
    let [skin, blind] = ["skin", "blind"].map(|name| &found[name]);
    let number = |table: &BTreeMap<String, Vec<String>>, column: &str, row: usize| -> f64 {
        table[column][row].parse().unwrap_or(f64::NAN)
    };
    let seconds = |row: usize| number(skin, "t", row) - 1.0;
    let rows = skin["t"].len();
    assert_eq!(rows, blind["t"].len());
    let is = |table: &BTreeMap<String, Vec<String>>, row: usize, what: &str| {
        table[&format!("contact/forearm/{what}")][row] == "1"
    };
    // When the contact is there, and what it is in the middle of the push.
    let first = |table, what| {
        (0..rows)
            .find(|&row| is(table, row, what))
            .map(|row| seconds(row) - FROM)
    };
    let (touched, detected) = (first(skin, "located"), first(blind, "detected"));
    let explains = |row: &usize| {
        let reasons = blind
            .iter()
            .filter(|(name, _)| name.starts_with("residual/"));
        let mut reasons = reasons.filter(|(name, _)| name.ends_with("/reason"));
        seconds(*row) > FROM && reasons.any(|(_, cells)| !cells[*row].is_empty())
    };
    let unexplained = (0..rows).find(explains).map(|row| seconds(row) - FROM);
    let hand = (0..rows).filter(|&row| (FROM..FROM + 2.0).contains(&seconds(row)));
    let hand = hand
        .filter(|&row| blind["contact/hand/detected"][row] == "1")
        .count();
    eprintln!(
        "touched after {touched:?} s; without a skin the residual is significant after \
         {unexplained:?} s, taken for the forearm's contact after {detected:?} s, for the \
         hand's in {hand} estimates"
    );
    // Two readings of 20 ms, and the delay of the skin.
    assert!(
        touched.is_some_and(|after| after > 0.0 && after < 0.07),
        "{touched:?}"
    );
    let parts = ["fx", "fy", "fz", "tx", "ty", "tz"];
    let (mut beyond, mut compared, mut farthest, mut stated) = (0, 0, 0.0_f64, 0.0_f64);
    let (mut worst, mut blind_worst) = (0.0_f64, 0.0_f64);
    for row in (0..rows).filter(|&row| (FROM + 0.3..FROM + 1.7).contains(&seconds(row))) {
        assert!(
            is(skin, row, "located") && is(skin, row, "valid"),
            "{}",
            seconds(row)
        );
        let value = |part: &str| number(skin, &format!("contact/forearm/{part}"), row);
        farthest = farthest.max(away([value("px"), value("py"), value("pz")]));
        for (part, truth) in parts.iter().zip(truth()) {
            let std = value(&format!("{part}_std"));
            compared += 1;
            beyond += usize::from((value(part) - truth).abs() > 3.0 * std);
            if part.starts_with('f') {
                stated = stated.max(std);
                worst = worst.max((value(part) - truth).abs());
                let blind = number(blind, &format!("contact/forearm/{part}"), row);
                blind_worst = blind_worst.max((blind - truth).abs());
            }
        }
    }
    eprintln!(
        "{:.1} mm away, force wrong by up to {worst:.2} N (stated {stated:.2} N), without a skin \
         {blind_worst:.2} N; {beyond} of {compared} beyond three deviations",
        1e3 * farthest
    );
    assert!(
        compared > 1000 && beyond * 50 < compared,
        "{beyond} of {compared}"
    );
    assert!(
        farthest < PITCH && stated < 0.3 * FORCE,
        "{farthest} m, {stated} N"
    );
    // No touch where there is none, and the wrist does not depend on it.
    let outside = |row: &usize| !(FROM..FROM + 2.2).contains(&seconds(*row));
    assert!(
        (0..rows)
            .filter(outside)
            .all(|row| !is(skin, row, "located"))
    );
    let valid =
        |row: usize| skin["valid/l_elbow"][row] == "1" && skin["valid/l_wrist_yaw"][row] == "1";
    let settled = (0..rows).filter(|&row| seconds(row) > 1.0);
    let (valid, all) = (
        settled.clone().filter(|&row| valid(row)).count(),
        settled.count(),
    );
    assert!(valid * 100 >= 97 * all, "{valid} of {all}");
}

/// A channel that the gateway does not publish is told before anything runs.
#[test]
fn a_misspelt_skin_is_told() {
    let rig = Rig::new();
    let written = arm(Arm::new(), &rig.path("robot"));
    let gateway = fs::read_to_string(&written.gateway).unwrap();
    let other = rig.path("robot/other.toml").to_string_lossy().into_owned();
    let check = [
        "estimator",
        "--config",
        &written.estimator,
        "--check",
        "--gateway",
        &other,
    ];
    for (name, told) in [
        (
            "l_forearm_skn",
            "skin/l_forearm_skin (did you mean \"l_forearm_skn\"?)",
        ),
        ("l_forearm_skin", ""),
    ] {
        fs::write(&other, gateway.replace("l_forearm_skin", name)).unwrap();
        let output = rig.command(&check).output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        let code = if told.is_empty() { 0 } else { 2 };
        assert_eq!(
            (output.status.code(), error.contains(told)),
            (Some(code), true),
            "{error}"
        );
    }
}

/// The same live: simulator, gateway and estimator as processes.
#[test]
fn a_touch_is_published_with_its_place() {
    let rig = Rig::new();
    let written = arm(Arm::slow().on_virtual(["a", "b"]), &rig.path("robot"));
    // Again and again, so that it does not matter how long the processes need to start.
    let pushes: Vec<String> = (0..30)
        .map(|k| push(3.0 + 6.0 * f64::from(k), 6.0 + 6.0 * f64::from(k)))
        .collect();
    let mut arguments = vec!["simulate", "--robot", &written.folder, "--still", "300"];
    for push in &pushes {
        arguments.extend(["--fault", push]);
    }
    let mut simulator = rig.start(&arguments);
    let mut gateway = rig.start(&["gateway", "--config", &written.gateway]);
    let mut estimator = rig.start(&["estimator", "--config", &written.estimator]);
    let domain = rig.open();
    let forearm = 2;
    let mut contacts = Newest::<ContactEstimate>::open(&domain, "icub_left_arm");
    let estimate = contacts.wait("a touch with its wrench", |estimate| {
        let contact = &estimate.contacts()[forearm];
        let values = contact.force.iter().chain(&contact.torque);
        let mut within = values.zip(truth()).zip(contact.standard_deviation);
        contact.valid == 1
            && contact.located == 1
            && within.all(|((value, truth), std)| (value - truth).abs() < 4.0 * std)
    });
    let contact = &estimate.contacts()[forearm];
    assert!(away(contact.position) < PITCH, "{contact:?}");
    assert_eq!(contact.detected, 0);
    contacts.wait("the end of the touch", |estimate| {
        let contact = &estimate.contacts()[forearm];
        contact.located == 0 && contact.position == [0.0; 3]
    });
    for process in [&mut estimator, &mut gateway, &mut simulator] {
        process.assert_runs();
    }
}
