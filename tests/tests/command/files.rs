//! Estimates from files, parameters, and who runs already.

use super::*;

#[test]
fn estimates_from_files_are_those_of_other_libraries() {
    let place = Place::new();
    let no_offsets = [
        ("offset_n = [6.0, -4.0, 11.0]", "offset_n = [0.0, 0.0, 0.0]"),
        (
            "offset_nm = [0.2, -0.35, 0.1]",
            "offset_nm = [0.0, 0.0, 0.0]",
        ),
    ];
    place.change("estimator.toml", "imu.toml", &no_offsets);
    let fixed = [
        (
            "kind = \"imu\"\nsensor = \"chest_imu\"\nlink = \"chest_imu_frame\"",
            "kind = \"fixed\"\nlink = \"chest\"\ngravity_mps2 = [0.0, 0.0, -9.80665]",
        ),
        (
            "[[contact]]\nname = \"stand\"        # the ground reaction\nlink = \"chest\"\n",
            "",
        ),
    ];
    place.change("imu.toml", "fixed.toml", &fixed);
    for log in [
        "icub_left_arm_mujoco.csv",
        "icub_left_arm_mujoco_contact.csv",
    ] {
        let text = oracle(log);
        let truth = table(&text);
        for config in ["imu.toml", "fixed.toml"] {
            place.write("log.csv", &text);
            let report = place
                .line(&format!(
                    "estimate --config {config} --log log.csv --out e.csv --json"
                ))
                .good()
                .json();
            assert_eq!(
                (&report["estimates"], &report["torques_withheld"]),
                (&201.into(), &0.into()),
                "{report}"
            );
            let estimates = table(&place.read("e.csv"));
            assert_eq!(estimates["t"], truth["t"]);
            let mut compared = 0;
            let mut check = |estimated: &str, expected: Option<&Vec<f64>>| {
                for (row, value) in estimates[estimated].iter().enumerate() {
                    let expected = expected.map_or(0.0, |e| e[row]);
                    assert!(
                        (value - expected).abs() < 1e-9 * (1.0 + expected.abs()),
                        "{log}, {config}, {estimated}, row {row}: {value}, not {expected}"
                    );
                    compared += 1;
                }
            };
            for name in truth
                .keys()
                .filter_map(|n| n.strip_prefix("joint/")?.strip_suffix("/torque"))
            {
                check(
                    &format!("torque/{name}"),
                    truth.get(&format!("joint/{name}/torque")),
                );
                assert!(
                    estimates[&format!("valid/{name}")]
                        .iter()
                        .all(|v| *v == 1.0)
                );
                assert!(
                    estimates[&format!("torque_std/{name}")]
                        .iter()
                        .all(|s| *s > 0.0 && *s < 1.0)
                );
            }
            for part in ["fx", "fy", "fz", "tx", "ty", "tz"] {
                let name = format!("contact/hand/{part}");
                check(&name, truth.get(&name));
            }
            assert_eq!(compared, 201 * 13);
        }
    }
}

#[test]
fn identified_parameters_take_the_place_of_the_urdfs() {
    let place = Place::new();
    place.write("log.csv", &oracle("icub_left_arm_mujoco.csv"));
    place.write("p.toml", &parameters_file());
    let estimate = |more: &[&str]| {
        let args = [
            "estimate",
            "--config",
            "estimator.toml",
            "--log",
            "log.csv",
            "--out",
            "e.csv",
        ];
        place.run(&[&args[..], more].concat()).good();
        table(&place.read("e.csv"))
    };
    let mean = |estimates: &BTreeMap<String, Vec<f64>>, column: &str| {
        estimates[column].iter().sum::<f64>() / estimates[column].len() as f64
    };
    let (plain, with) = (estimate(&[]), estimate(&["--parameters", "p.toml"]));
    let force = |estimates: &BTreeMap<String, Vec<f64>>| {
        let parts = ["fx", "fy", "fz"].map(|part| mean(estimates, &format!("contact/hand/{part}")));
        parts.iter().map(|x| x * x).sum::<f64>().sqrt()
    };
    // The golden log has no offsets, and the file's are zero: the wrench at the hand then shows the
    // weight of the additional kilogram.
    let felt = force(&with);
    assert!((felt - 9.8).abs() < 1.5, "{felt}");
    assert!(force(&plain) > 12.0, "the offsets of estimator.toml");
    // The configuration may name the file; the daemon reports it.
    place.change(
        "estimator.toml",
        "named.toml",
        &[(
            "model = \"model.urdf\"",
            "model = \"model.urdf\"\nparameters = \"p.toml\"",
        )],
    );
    let check = place
        .line("estimator --config named.toml --check")
        .good()
        .out;
    assert!(
        check.contains("inertial parameters: identified by proprio test: 1 of 9 links"),
        "{check}"
    );
    assert!(
        check.contains("the URDF's, taken as known to 20 %: "),
        "{check}"
    );
    let check = place
        .line("estimator --config estimator.toml --check")
        .good()
        .out;
    assert!(
        check.contains("inertial parameters: the URDF's, taken as known to 20 %"),
        "{check}"
    );
    place
        .line("estimate --config named.toml --log log.csv --out named.csv")
        .good();
    assert!(
        place.read("named.csv") == place.read("e.csv"),
        "the same as by --parameters"
    );
}

// ---------------------------------------------------------------- processes

#[test]
fn a_second_gateway_or_estimator_is_refused_by_the_first_ones_number() {
    let place = Place::new();
    for (verb, config) in [("gateway", "gateway.toml"), ("estimator", "estimator.toml")] {
        let mut first = place.start(&[verb, "--config", config]);
        until(PATIENCE, || first.log().contains("running").then_some(()))
            .unwrap_or_else(|| panic!("{verb}: {}", first.log()));
        let number = format!("process {}", first.id());
        place.line(&format!("{verb} --config {config}")).fails(
            1,
            &[&number, "only one gateway and one estimator per robot"],
        );
        first.assert_runs();
        // A gateway of another robot or in another domain is permitted.
        place.change(
            config,
            "other.toml",
            &[("robot = \"icub_left_arm\"", "robot = \"other\"")],
        );
        if verb == "gateway" {
            // On separate buses.
            place.change(
                "other.toml",
                "other.toml",
                &[
                    ("name = \"left_arm\" }", "name = \"other\" }"),
                    ("name = \"left_arm_motors\" }", "name = \"other_motors\" }"),
                ],
            );
        }
        for args in [
            &[verb, "--config", "other.toml"][..],
            &[verb, "--config", config, "--domain", "elsewhere"],
        ] {
            let mut other = place.start(args);
            until(PATIENCE, || other.log().contains("running").then_some(()))
                .unwrap_or_else(|| panic!("{args:?}: {}", other.log()));
            other.end();
        }
        // SIGTERM ends it with success and a log line.
        first.end();
        assert!(first.log().contains("SIGTERM"), "{}", first.log());
        // After its end, its place is free.
        let mut next = place.start(&[verb, "--config", config]);
        until(PATIENCE, || next.log().contains("running").then_some(()))
            .unwrap_or_else(|| panic!("{verb}: {}", next.log()));
        next.end();
    }
    let left: Vec<_> = place
        .rig
        .domain
        .base
        .read_dir()
        .into_iter()
        .flatten()
        .flatten()
        .map(|e| e.path())
        .collect();
    assert!(left.is_empty(), "left over: {left:?}");
}

#[test]
fn the_simulator_tells_what_it_did_as_json() {
    let place = Place::new();
    let ran = place
        .line("simulate --seconds 0.5 --truth truth.csv --fault lost:0.1 --json")
        .good();
    let summary = ran.json();
    let push = "link l_hand is pushed at contact hand with up to 10 N and 0.3 Nm, from 0.2 s to \
                0.3 s; nobody declares it (--skin does)";
    assert!(ran.err.contains(push), "{}", ran.err);
    assert!(
        summary["sent"].as_u64().unwrap() > 500
            && summary["lost_on_request"].as_u64().unwrap() > 20,
        "{summary}"
    );
    assert_eq!(summary["truth_rows"], 501);
    assert_eq!(table(&place.read("truth.csv"))["t"].len(), 501);
    // It runs until it is stopped.
    let mut process = place.start(&["simulate", "--json"]);
    until(PATIENCE, || {
        process.log().contains("is powered on").then_some(())
    })
    .unwrap_or_else(|| panic!("{}", process.log()));
    process.end();
    let log = process.log();
    assert!(log.contains("from 8 s to 12 s of every 20 s"), "{log}");
    let calm = place.line("simulate --seconds 0.2 --no-push");
    let calm = calm.good();
    assert!(!calm.err.contains("pushed"), "{}", calm.err);
    assert!(
        serde_json::from_str::<Json>(&process.output()).is_ok(),
        "{}",
        process.output()
    );
}
