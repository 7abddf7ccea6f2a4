//! Sensors that are turned, in other frames or beside others; gravity and payloads.

use super::*;

/// An arm on a wall whose configuration has it stand on the floor: no parameters make up for it.
#[test]
fn gravity_that_points_elsewhere_is_named() {
    let setup = arm();
    let truth = real(&setup, 3);
    let log = simulate(&setup, &truth, 20.0, 0.01, 3);
    let mut wrong = arm();
    let on_a_wall = FrameMotion::standing(&Vec3::new(9.80665, 0.0, 0.0));
    wrong.robot.base = BaseMotion::Standing(on_a_wall);
    let [right, wrong] = [setup, wrong].map(|setup| {
        let outcome = run(&setup, &[("log", LogRole::Train, &log)], &[]);
        let named = (outcome.findings.into_iter()).find(|f| f.code == FindingCode::WrongGravity);
        (outcome.verdict, named)
    });
    assert_eq!((right.0, right.1.is_none()), (Verdict::Identified, true));
    let (Verdict::Nothing(why), Some(named)) = wrong else {
        panic!("{wrong:?}");
    };
    assert!(
        named.text.contains("gravity_mps2 = [9.8, 0.0, 0.0]")
            && named.text.contains("with [0.0, 0.0, -9.8]")
            && why == named.text,
        "{}",
        named.text
    );
}

/// What a link carries in one log, and did not in another, is identified with its uncertainty, in
/// the axes of any frame of the link; if it carries nothing, no mass is significant.
#[test]
fn a_payload_is_what_a_link_carries_more_than_before() {
    let (mut deviations, mut false_masses) = (Vec::new(), 0);
    for seed in 0..4 {
        let mut setup = arm();
        let truth = real(&setup, seed);
        let right = Calibration::new(cross_talk(0.01, 40 + seed), Wrench::zero(), None);
        let log =
            |truth: &Model, seed| miscalibrated(&simulate(&setup, truth, 20.0, 0.01, seed), &right);
        // A block on the fifth link, which is neither the last one nor the first one; every second
        // time it is six times as heavy as the link, and beyond it.
        let (link, kilograms, far) = if seed % 2 == 0 {
            (5, 0.6, 0.1)
        } else {
            (5, 4.8, 0.3)
        };
        let shape = Mat3::new(2.0, 0.2, 0.0, 0.2, 1.5, -0.1, 0.0, -0.1, 1.2) * 1e-3;
        let block = RigidInertia::from_centroidal(kilograms, &Vec3::new(0.05, -0.02, far), &shape);
        let mut loaded = truth.clone();
        let both = truth.inertias()[link].parameters();
        let sum: [f64; 10] = std::array::from_fn(|i| both[i] + block.parameters()[i]);
        let carrying = RigidInertia::from_parameters(&sum);
        loaded.set_inertia(link, carrying).expect("a body");
        let (before, after) = (log(&truth, 90 + seed), log(&loaded, 190 + seed));
        let again = log(&truth, 290 + seed);

        let reference = run(&setup, &[("before", LogRole::Train, &before)], &[]);
        let reference = parameters(&reference, &setup.robot, "this test").expect("parameters");
        setup.apply(&reference).expect("they fit");
        setup.robot = setup.robot_as_identified();
        let turned = Mat3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
        let pose = Pose {
            rotation: turned,
            translation: Vec3::new(0.0, 0.03, 0.1),
        };
        let found = |log: &str| {
            let dataset = sample_log::dataset(&setup.robot, "log", LogRole::Train, log.as_bytes());
            let (frame, known) = (Frame { link, pose }, known(&reference, &setup.robot));
            let logs = vec![dataset.expect("a log")];
            payload(&setup.robot, &known, &frame, logs, &[]).expect("a payload")
        };
        let carried = found(&after);
        let (mass, std) = carried.mass();
        println!(
            "seed {seed}: {mass:.4} +- {std:.4} kg, centre {:?}",
            carried.centre()
        );
        assert!(
            carried.is_significant() && std < 0.03 * kilograms,
            "{carried:?}"
        );
        let expected = block.transformed(&pose.inverse());
        let (centre, centre_std) = carried.centre();
        let (tensor, tensor_std) = carried.about_centre();
        let off = centre - expected.centre().unwrap();
        let of_axes = off.iter().zip(centre_std.iter());
        let mut ratios: Vec<f64> = of_axes.map(|(e, s)| e / s).collect();
        let off = tensor - expected.about_centre();
        ratios.extend(off.iter().zip(tensor_std.iter()).map(|(e, s)| e / s));
        ratios.push((mass - kilograms) / std);
        deviations.extend(ratios);
        assert!(centre_std.amax() < 0.02, "{centre_std}");
        let nothing = found(&again);
        false_masses += usize::from(nothing.is_significant());
        assert!(nothing.mass().1 < 0.02, "{nothing:?}");
    }
    let rms = (deviations.iter().map(|d| d * d).sum::<f64>() / deviations.len() as f64).sqrt();
    println!("{rms:.2} of {} deviations", deviations.len());
    assert!(deviations.iter().all(|d| d.abs() < 4.0), "{deviations:?}");
    assert!((0.05..1.5).contains(&rms), "{rms}");
    assert_eq!(false_masses, 0);
}

#[test]
fn sensor_the_wrong_way_round_is_named_and_nothing_identified() {
    let setup = arm();
    let mut log = simulate(&setup, &real(&setup, 3), 10.0, 0.01, 3);
    for axis in AXES {
        log = change(&log, &format!("wrench/ft/{axis}"), |x| -x);
    }
    let outcome = run(&setup, &[("turned", LogRole::Train, &log)], &[]);
    assert!(
        matches!(outcome.verdict, Verdict::Nothing(_)),
        "{:?}",
        outcome.verdict
    );
    assert!(
        outcome
            .findings
            .iter()
            .any(|f| f.code == FindingCode::WrongSign && f.subject == "ft"),
        "{:?}",
        outcome.findings
    );
    assert!(outcome.links.iter().all(|link| link.identified == link.cad));
}

/// A sensor with the wrong measurement direction in one log of three, or in the validation log:
/// that log is refused with a finding, and the others are used.
#[test]
fn a_log_with_a_sensor_turned_is_refused_alone() {
    let setup = arm();
    let truth = real(&setup, 3);
    let log = |seed, is_turned| {
        let log = simulate(&setup, &truth, 8.0, 0.01, seed);
        let turned = |log: String, axis| change(&log, &format!("wrench/ft/{axis}"), |x| -x);
        if is_turned {
            AXES.into_iter().fold(log, turned)
        } else {
            log
        }
    };
    let logs = [
        log(3, false),
        log(4, true),
        log(5, false),
        log(6, true),
        log(7, false),
    ];
    let roles = [
        LogRole::Train,
        LogRole::Train,
        LogRole::Train,
        LogRole::Validate,
        LogRole::Validate,
    ];
    let given: Vec<(&str, LogRole, &str)> = logs
        .iter()
        .zip(roles)
        .map(|(log, role)| ("log", role, &**log))
        .collect();
    let outcome = run(&setup, &given, &[]);
    assert_eq!(outcome.verdict, Verdict::Identified);
    for (log, is_turned) in outcome.logs.iter().zip([false, true, false, true, false]) {
        let found: Vec<&Finding> = log
            .findings
            .iter()
            .filter(|f| f.code == FindingCode::WrongSign)
            .collect();
        assert_eq!(found.len(), usize::from(is_turned), "{:?}", log.findings);
        assert!(
            found
                .iter()
                .all(|f| f.subject == "ft" && f.severity == Severity::Refusal)
        );
        assert_eq!(log.used == 0, is_turned);
    }
    let (cad, own, inside, _) = torque_errors(&setup, &truth, &outcome, 77);
    assert!(5.0 * own < cad && inside > 0.85, "{cad} {own} {inside}");
}

/// The log of a sensor whose measurement frame differs from the configuration, and the correct
/// configuration.
#[test]
fn a_sensor_in_another_frame_is_named_with_the_right_one() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 12.0, 0.01, 3);
    let turned = |pose: &Pose, sign: f64| {
        let mut lines = log.lines();
        let header = lines.next().expect("a header");
        let places = AXES.map(|axis| {
            header
                .split(',')
                .position(|name| name == format!("wrench/ft/{axis}"))
                .expect("a column")
        });
        let mut text = format!("{header}\n");
        for line in lines {
            let mut cells: Vec<String> = line.split(',').map(str::to_owned).collect();
            let [fx, fy, fz, tx, ty, tz] =
                places.map(|place| cells[place].parse::<f64>().expect("a number"));
            let there = pose.wrench_back(&Wrench::from_parts([fx, fy, fz], [tx, ty, tz])) * sign;
            for (place, value) in places.into_iter().zip(there.force_first()) {
                cells[place] = value.to_string();
            }
            text += &format!("{}\n", cells.join(","));
        }
        text
    };
    // The sensor's joint is a translation by 5 cm along z: the parent's frame has its origin below.
    let parent = Pose::from_xyz_rpy([0.0, 0.0, -0.05], [0.0; 3]);
    let quarter = Pose::from_xyz_rpy([0.0; 3], [0.0, 0.0, std::f64::consts::FRAC_PI_2]);
    let upside_down = Pose::from_xyz_rpy([0.0; 3], [std::f64::consts::PI, 0.0, 0.0]);
    for (pose, sign, expected) in [
        (
            quarter,
            1.0,
            "rpy_rad = [0, 0, 1.5708], direction = \"child_to_parent\"",
        ),
        (
            upside_down,
            1.0,
            "rpy_rad = [3.1416, 0, 0], direction = \"child_to_parent\"",
        ),
        (
            quarter,
            -1.0,
            "rpy_rad = [0, 0, 1.5708], direction = \"parent_to_child\"",
        ),
    ] {
        let outcome = run(
            &setup,
            &[("turned", LogRole::Train, &turned(&pose, sign))],
            &[],
        );
        assert!(
            matches!(outcome.verdict, Verdict::Nothing(_)),
            "{:?}",
            outcome.verdict
        );
        let found = outcome
            .findings
            .iter()
            .find(|f| f.code == FindingCode::WrongFrame);
        let found = found.expect("a finding");
        assert_eq!(found.subject, "ft");
        assert!(found.text.contains(expected), "{}", found.text);
    }
    // An origin error of the size of errors of the bodies is not a wrong frame.
    let outcome = run(
        &setup,
        &[("moved", LogRole::Train, &turned(&parent, 1.0))],
        &[],
    );
    assert!(
        outcome
            .findings
            .iter()
            .all(|f| f.code != FindingCode::WrongFrame && f.code != FindingCode::WrongSign)
    );
}

/// A reversed sensor makes the balance between two sensors wrong for both. Only the reversed one is
/// named.
#[test]
fn of_two_sensors_the_turned_one_is_named() {
    let setup = arm_with(&["ft", "wrist"]);
    let log = simulate(&setup, &real(&setup, 3), 10.0, 0.01, 3);
    for turned in [vec!["ft"], vec!["wrist"], vec!["ft", "wrist"]] {
        let mut text = log.clone();
        for sensor in &turned {
            for axis in AXES {
                text = change(&text, &format!("wrench/{sensor}/{axis}"), |x| -x);
            }
        }
        let outcome = run(&setup, &[("turned", LogRole::Train, &text)], &[]);
        assert!(
            matches!(outcome.verdict, Verdict::Nothing(_)),
            "{:?}",
            outcome.verdict
        );
        let named: Vec<&str> = outcome
            .findings
            .iter()
            .filter(|f| f.code == FindingCode::WrongSign)
            .map(|f| f.subject.as_str())
            .collect();
        assert_eq!(named, turned);
    }
}

/// Each of two sensors is compared with its reading predicted from the other sensor and the links
/// between them: with the complete reading, not with a part of the balance.
#[test]
fn readings_of_two_sensors_are_compared_as_they_are() {
    let setup = arm_with(&["ft", "wrist"]);
    let truth = real(&setup, 3);
    let log = simulate(&setup, &truth, 12.0, 0.01, 3);
    let outcome = run(&setup, &[("log", LogRole::Train, &log)], &[]);
    assert_eq!(outcome.verdict, Verdict::Identified);
    let table: Vec<Vec<f64>> = log
        .lines()
        .skip(1)
        .map(|line| {
            line.split(',')
                .map(|cell| cell.parse().expect("a number"))
                .collect()
        })
        .collect();
    let header: Vec<&str> = log.lines().next().expect("a header").split(',').collect();
    for (sensor, cut) in ["ft", "wrist"].iter().zip(setup.robot.structure.sensors()) {
        let of_sensor = &outcome.logs[0]
            .sensors
            .iter()
            .find(|s| s.name == *sensor)
            .expect("it");
        for (axis, word) in AXES.iter().enumerate() {
            let place = header
                .iter()
                .position(|name| *name == format!("wrench/{sensor}/{word}"))
                .expect("a column");
            let curve = outcome.logs[0]
                .curves
                .iter()
                .find(|curve| curve.name == format!("{sensor} {word}"))
                .expect("a curve");
            // The measured values equal the readings up to an offset: the difference is nearly
            // constant.
            let first = table[0][0];
            let mut apart = Vec::new();
            for (t, measured) in curve
                .t
                .iter()
                .zip(&curve.measured)
                .filter(|(_, m)| m.is_finite())
            {
                let row = &table[((t + first) / 0.01).round() as usize];
                apart.push(row[place] - measured);
            }
            let mean = apart.iter().sum::<f64>() / apart.len() as f64;
            let noise = if axis < 3 {
                cut.noise().force[axis]
            } else {
                cut.noise().torque[axis - 3]
            };
            let most = apart
                .iter()
                .fold(0.0_f64, |most, x| most.max((x - mean).abs()));
            assert!(
                most < noise,
                "{sensor} {word}: its offset wanders by {most}"
            );
            // The difference has the noise of both sensors. (A torque also has that of the other's
            // force times the distance.)
            let rms = of_sensor.rms.identified[axis];
            let force = |axis: usize| -> f64 {
                let squares = setup
                    .robot
                    .structure
                    .sensors()
                    .iter()
                    .map(|c| c.noise().force[axis].powi(2));
                squares.sum::<f64>().sqrt()
            };
            assert!(
                rms > 0.95 * noise && rms < of_sensor.rms.cad_fitted[axis],
                "{sensor} {word}: {:?}",
                of_sensor.rms
            );
            if axis < 3 {
                assert!(
                    rms < 1.3 * force(axis) + 0.02,
                    "{sensor} {word}: {:?}",
                    of_sensor.rms
                );
            }
        }
        // Both have the stamps of the encoders.
        let late = &outcome.time_offsets;
        assert!(late.iter().all(|late| !late.significant), "{late:?}");
    }
}
