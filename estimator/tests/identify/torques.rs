//! Joint torques beside F/T readings, or alone: noise, rotors, delays, impossible values.

use super::*;

/// The results on one core and on all cores are equal to the bit.
#[test]
fn the_number_of_cores_changes_nothing() {
    if std::thread::available_parallelism().map_or(1, usize::from) < 2 {
        println!("skipped: there is but one core");
        return;
    }
    let setup = arm_with(&["ft", "wrist"]);
    let truth = real(&setup, 5);
    let first = simulate(&setup, &truth, 8.0, 0.01, 5);
    // Without velocities and accelerations, which are then estimated.
    let second = simulate(&setup, &truth, 21.0, 0.01, 6);
    let second = second
        .replace("/velocity", "/v")
        .replace("/acceleration", "/a");
    let outcome = || {
        let logs = [
            ("first", LogRole::Train, first.as_str()),
            ("second", LogRole::Train, second.as_str()),
        ];
        let outcome = run(&setup, &logs, &[]);
        assert_eq!(outcome.verdict, Verdict::Identified);
        format!("{outcome:#?}")
    };
    let on_one = std::thread::scope(|scope| {
        let alone = scope.spawn(|| {
            let this_thread = Pid::from_raw(0);
            let all = sched_getaffinity(this_thread).expect("the cores");
            let core = (0..CpuSet::count())
                .find(|&core| all.is_set(core) == Ok(true))
                .expect("a core");
            let mut one = CpuSet::new();
            one.set(core).expect("a core");
            sched_setaffinity(this_thread, &one).expect("one core");
            assert_eq!(
                std::thread::available_parallelism().map_or(0, usize::from),
                1
            );
            outcome()
        });
        alone.join().expect("an outcome")
    });
    let on_all = outcome();
    assert_eq!(on_one.lines().count(), on_all.lines().count());
    for (number, (one, all)) in on_one.lines().zip(on_all.lines()).enumerate() {
        assert_eq!(one, all, "line {number}");
    }
}

/// A sensor that is dead in the last log: its offset and standard deviation are those of the log
/// before.
#[test]
fn the_offset_of_a_sensor_is_of_the_last_log_that_reads_it() {
    let setup = arm_with(&["ft", "wrist"]);
    let truth = real(&setup, 3);
    let whole = simulate(&setup, &truth, 12.0, 0.01, 3);
    let second = simulate(&setup, &truth, 12.0, 0.01, 4);
    let dead: Vec<bool> = second
        .lines()
        .next()
        .expect("a header")
        .split(',')
        .map(|name| name.starts_with("wrench/wrist"))
        .collect();
    let without: String = second
        .lines()
        .enumerate()
        .map(|(row, line)| {
            let cells = line.split(',').zip(&dead);
            let cells = cells.map(|(cell, dead)| if *dead && row > 0 { "" } else { cell });
            cells.collect::<Vec<_>>().join(",") + "\n"
        })
        .collect();
    let logs = [
        ("whole", LogRole::Train, &*whole),
        ("without", LogRole::Train, &*without),
    ];
    let outcome = run(&setup, &logs, &[]);
    let named = |log: usize| -> Vec<&str> {
        outcome.logs[log]
            .offsets
            .iter()
            .map(|o| o.sensor.as_str())
            .collect()
    };
    assert_eq!(named(0), ["ft", "wrist"]);
    // The dead sensor is beyond `ft`, so the balance of `ft` is unknown, too.
    assert!(named(1).is_empty(), "{:?}", named(1));
    let covariance = &outcome.covariance;
    for (row, column) in covariance.columns.iter().enumerate() {
        if let ParameterColumn::Offset { sensor, component } = column {
            let deviation = covariance.root.row(row).norm();
            assert!(deviation < 1.0, "{sensor} {component}: {deviation}");
        }
    }
    let parameters = parameters(&outcome, &setup.robot, "a program 1").expect("parameters");
    assert_eq!(parameters.offsets().len(), 2);
    for (offset, told) in parameters.offsets().iter().zip(&outcome.logs[0].offsets) {
        assert_eq!(offset.reading.force_first(), told.end);
    }
}

/// Too little data for cross-validation: whether the parameters are better than CAD's is unknown,
/// so CAD's are kept.
#[test]
fn nothing_is_called_identified_that_was_not_checked() {
    let setup = arm();
    // 25 rows a second, for 3.6 s.
    let log = simulate(&setup, &real(&setup, 3), 3.6, 0.01, 3);
    let rows = log.lines().skip(1).step_by(4);
    let short: String = log
        .lines()
        .take(1)
        .chain(rows)
        .flat_map(|line| [line, "\n"])
        .collect();
    let outcome = run(&setup, &[("short", LogRole::Train, &short)], &[]);
    if matches!(outcome.verdict, Verdict::Nothing(_)) {
        panic!("the log is too short for this test: {:?}", outcome.findings);
    }
    assert_eq!(outcome.verdict, Verdict::NoBetterThanCad);
    assert!(
        outcome
            .findings
            .iter()
            .any(|f| f.code == FindingCode::NotCrossValidated),
        "{:?}",
        outcome.findings
    );
    for link in outcome.links.iter().filter(|link| link.seen) {
        assert_eq!(link.retained_fraction, 0.0);
        assert_eq!(link.identified, link.cad);
        // The standard deviation is that of the prior: tau times the mass.
        assert!(
            link.deviation[0] > 0.1 * outcome.tau * link.cad.mass,
            "{}: {:?}",
            link.name,
            link.deviation
        );
    }
}

/// A log longer than the part that noise is estimated from, with a joint's torque measured only
/// outside that part.
#[test]
fn noise_of_a_torque_that_was_seldom_measured_is_known() {
    let setup = arm_with(&[]);
    let truth = real(&setup, 3);
    let log = simulate_torques(&setup, &truth, 125.0, 0.02, 3, |joint, i| {
        joint != 5 || (1080..1240).contains(&i)
    });
    let outcome = run(&setup, &[("long", LogRole::Train, &log)], &TORQUE);
    let deviation = |joint: &str| {
        let name = format!("joint/{joint}/torque");
        outcome
            .channels
            .iter()
            .find(|c| c.name == name)
            .expect("a channel")
            .deviation
    };
    for joint in ["j5", "j6"] {
        assert!(
            (deviation(joint) / 0.02 - 1.0).abs() < 0.3,
            "{joint}: {}",
            deviation(joint)
        );
    }
}

/// Trained on one trajectory and tested on another: the error is within a hundredth, while that of
/// the URDF with fitted friction and offsets is several hundredths.
#[test]
fn torques_of_a_rich_log_come_within_a_hundredth() {
    let setup = arm_with(&[]);
    let truth = real(&setup, 5);
    let logs = [(5, LogRole::Train, 25.0), (7, LogRole::Validate, 12.0)];
    let logs =
        logs.map(|(seed, role, seconds)| (role, rich_torques(&setup, &truth, seconds, seed)));
    let given: Vec<(&str, LogRole, &str)> = logs
        .iter()
        .map(|(role, log)| ("log", *role, &**log))
        .collect();
    let outcome = run(&setup, &given, &TORQUE);
    assert_eq!(outcome.verdict, Verdict::Identified);
    let error = &outcome.logs[1].predicted.relative_error;
    assert!(error.identified < 0.011 && error.cad > 0.02, "{error:?}");
}

/// Motor torques: rotor inertias as large as the load are identified from two logs with different
/// friction. If the torques are taken as link-side torques, the same logs give worse parameters.
#[test]
fn rotors_are_identified_from_torques_of_motors() {
    let mut setup = arm_with(&[]);
    let truth = real(&setup, 5);
    let log = |seed, friction| {
        let log = simulate_torques(&setup, &truth, 15.0, 0.05, seed, |_, _| true);
        at_the_motors(&log, &ROTORS, friction)
    };
    let logs = [log(5, 0.5), log(6, 1.5), log(7, 1.0)];
    let roles = [LogRole::Train, LogRole::Train, LogRole::Validate];
    let given: Vec<(&str, LogRole, &str)> = logs
        .iter()
        .zip(roles)
        .map(|(log, role)| ("log", role, &**log))
        .collect();
    let wrong = run(&setup, &given, &TORQUE);
    assert!(wrong.rotors.is_empty());
    setup.robot.torque_side = TorqueSide::Motor;
    let outcome = run(&setup, &given, &TORQUE);
    assert_eq!(outcome.verdict, Verdict::Identified);
    assert_eq!(outcome.rotors.len(), 6);
    for (rotor, truth) in outcome.rotors.iter().zip(ROTORS) {
        let error = rotor.inertia - truth;
        assert!(
            error.abs() < 3.0 * rotor.deviation,
            "{rotor:?}, not {truth}"
        );
        // The first joint turns the whole arm about one axis: only CAD separates its rotor from the
        // links.
        let known = if rotor.joint == "j1" { 0.5 } else { 0.05 };
        assert!(rotor.deviation < known * truth.max(0.1), "{rotor:?}");
    }
    let error = |outcome: &Outcome| outcome.logs[2].predicted.relative_error;
    let (right, wrong) = (error(&outcome), error(&wrong));
    assert!(
        3.0 * right.identified < wrong.identified,
        "{right:?} {wrong:?}"
    );
    // Rotors are not attributed to errors of CAD.
    assert!(2.0 * right.cad < wrong.cad, "{right:?} {wrong:?}");
    let (cad, own, inside, _) = torque_errors(&setup, &truth, &outcome, 77);
    println!("torques of the links: {cad:.4} -> {own:.4} Nm, covered {inside:.3}");
    assert!(5.0 * own < cad && inside > 0.85, "{cad} {own} {inside}");
    for (log, friction) in outcome.logs.iter().zip([0.5, 1.5, 1.0]) {
        for joint in &log.friction {
            let off = [
                joint.coulomb_nm - friction,
                joint.viscous - 0.6 * friction,
                joint.offset_nm - 0.3 * friction,
            ];
            for (off, deviation) in off.iter().zip(joint.deviation) {
                assert!(off.abs() < 4.0 * deviation, "{joint:?} of {friction}");
            }
        }
    }
}

/// A rotor inertia that would be negative is set to zero and reported.
#[test]
fn a_negative_rotor_is_named() {
    let mut setup = arm_with(&[]);
    setup.robot.torque_side = TorqueSide::Motor;
    let truth = real(&setup, 5);
    let log = simulate_torques(&setup, &truth, 12.0, 0.05, 5, |_, _| true);
    let rotors = [0.3, 0.2, 0.1, -0.1, 0.05, 0.0];
    let outcome = run(
        &setup,
        &[("log", LogRole::Train, &at_the_motors(&log, &rotors, 0.5))],
        &TORQUE,
    );
    let rotor = |joint: &str| {
        outcome
            .rotors
            .iter()
            .find(|r| r.joint == joint)
            .expect("a rotor")
    };
    assert_eq!(rotor("j4").inertia, 0.0);
    // A rotor that does not exist is negative by chance only.
    let none = rotor("j6");
    assert!(
        (0.0..3.0 * none.deviation).contains(&none.inertia),
        "{none:?}"
    );
    let named: Vec<&str> = outcome
        .findings
        .iter()
        .filter(|f| f.code == FindingCode::NegativeRotorInertia)
        .map(|f| f.subject.as_str())
        .collect();
    assert_eq!(named, ["j4"]);
}

/// If links keep their CAD values, no rotor inertia is negative.
#[test]
fn no_rotor_beside_cads_links_is_negative() {
    let mut setup = arm_with(&[]);
    setup.robot.torque_side = TorqueSide::Motor;
    let truth = real(&setup, 4);
    let log = simulate_torques(&setup, &truth, 3.6, 0.05, 4, |_, _| true);
    let log = at_the_motors(&log, &[0.3, 0.2, 0.1, -0.3, 0.05, 0.02], 0.5);
    let rows = log.lines().skip(1).step_by(4);
    let short: String = log
        .lines()
        .take(1)
        .chain(rows)
        .flat_map(|line| [line, "\n"])
        .collect();
    let outcome = run(&setup, &[("short", LogRole::Train, &short)], &TORQUE);
    assert_eq!(outcome.verdict, Verdict::NoBetterThanCad);
    let inertias: Vec<f64> = outcome.rotors.iter().map(|rotor| rotor.inertia).collect();
    assert!(
        inertias.iter().all(|inertia| *inertia >= 0.0),
        "{inertias:?}"
    );
    assert_eq!(inertias[3], 0.0);
}

/// Held-out data are predicted with the reported parameters: where a rotor inertia would be
/// negative and is set to zero, links are not worse than CAD, and not reported as certain.
#[test]
fn a_negative_rotor_is_no_help_on_held_out_data() {
    let mut setup = arm_with(&[]);
    setup.robot.torque_side = TorqueSide::Motor;
    let truth = real(&setup, 5);
    for (seed, negative) in [(5, 0.3), (5, 1.0), (6, 0.3)] {
        let log = simulate_torques(&setup, &truth, 12.0, 0.05, seed, |_, _| true);
        let log = at_the_motors(&log, &[0.3, 0.2, 0.1, -negative, 0.05, 0.02], 0.5);
        let outcome = run(&setup, &[("log", LogRole::Train, &log)], &TORQUE);
        let (cad, own, inside, _) = torque_errors(&setup, &truth, &outcome, 77);
        println!("torques of the links: {cad:.4} -> {own:.4} Nm, covered {inside:.3}");
        assert!(
            own <= cad && inside > 0.65,
            "{seed} {negative}: {cad} {own} {inside}"
        );
        assert!(outcome.rotors.iter().all(|rotor| rotor.inertia >= 0.0));
    }
}

/// CAD's errors affect the joint torques far more than the sensor's readings: the reversed sensor
/// is still found.
#[test]
fn joint_torques_do_not_hide_a_turned_sensor() {
    let setup = arm();
    let truth = real(&setup, 3);
    let mut log = with_torques(
        &simulate(&setup, &truth, 10.0, 0.01, 3),
        &simulate_torques(&setup, &truth, 10.0, 0.05, 3, |_, _| true),
    );
    for (number, joint) in ARM_JOINTS.into_iter().enumerate() {
        let rate = 0.031 + 0.007 * number as f64;
        log = change_rows(&log, &format!("joint/{joint}/torque"), |i, x| {
            x + 300.0 * (rate * i as f64).sin()
        });
    }
    for axis in AXES {
        log = change(&log, &format!("wrench/ft/{axis}"), |x| -x);
    }
    let both = [IdentificationInput::Wrench, IdentificationInput::Torque];
    let outcome = run(&setup, &[("turned", LogRole::Train, &log)], &both);
    assert!(
        matches!(outcome.verdict, Verdict::Nothing(_)),
        "{:?}",
        outcome.verdict
    );
    let found: Vec<_> = outcome
        .findings
        .iter()
        .filter(|f| f.code == FindingCode::WrongSign)
        .collect();
    assert!(
        found.len() == 1 && found[0].subject == "ft",
        "{:?}",
        outcome.findings
    );
}

/// F/T sensor and motor torques together: the links before the sensor are identified from the
/// torques, the links beyond it from both.
#[test]
fn rotors_are_identified_beside_a_force_torque_sensor() {
    let mut setup = arm();
    setup.robot.torque_side = TorqueSide::Motor;
    let truth = real(&setup, 8);
    let log = |seed| {
        let wrenches = simulate(&setup, &truth, 15.0, 0.01, seed);
        let torques = simulate_torques(&setup, &truth, 15.0, 0.05, seed, |_, _| true);
        at_the_motors(&with_torques(&wrenches, &torques), &ROTORS, 0.8)
    };
    let both = [IdentificationInput::Wrench, IdentificationInput::Torque];
    let outcome = run(&setup, &[("log", LogRole::Train, &log(8))], &both);
    assert_eq!(outcome.verdict, Verdict::Identified);
    assert_eq!(outcome.rotors.len(), 6);
    for (rotor, truth) in outcome.rotors.iter().zip(ROTORS) {
        let error = rotor.inertia - truth;
        assert!(
            error.abs() < 3.0 * rotor.deviation,
            "{rotor:?}, not {truth}"
        );
    }
    let (cad, own, inside, _) = torque_errors(&setup, &truth, &outcome, 78);
    println!("torques of the links: {cad:.4} -> {own:.4} Nm, covered {inside:.3}");
    assert!(5.0 * own < cad && inside > 0.85, "{cad} {own} {inside}");
}

/// F/T readings that are stamped late or early, by a fraction of a row's period or by several
/// periods: the delay is found, with its standard deviation.
#[test]
fn late_readings_are_found_with_their_deviation() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 20.0, 0.01, 3);
    // A column delayed by this number of rows, interpolated linearly between rows.
    let shifted = |log: &str, column: &str, rows: f64| {
        let values = values(log, column);
        change_rows(log, column, |i, _| {
            let at = (i as f64 - rows).clamp(0.0, values.len() as f64 - 1.001);
            let (before, share) = (at.floor() as usize, at.fract());
            values[before] + share * (values[before + 1] - values[before])
        })
    };
    let axes = ["fx", "fy", "fz", "tx", "ty", "tz"].map(|axis| format!("wrench/ft/{axis}"));
    for late in [0.0, 0.7, -1.2, 3.0] {
        let log = axes
            .iter()
            .fold(log.clone(), |log, axis| shifted(&log, axis, late));
        let outcome = run(&setup, &[("log", LogRole::Train, &log)], &[]);
        let [offset] = &outcome.time_offsets[..] else {
            panic!("{:?}", outcome.time_offsets)
        };
        println!("{late} rows: {offset:?}");
        assert_eq!(
            (offset.channel.as_str(), offset.significant),
            ("wrench/ft", late != 0.0)
        );
        let (off, deviation) = (offset.seconds - 0.01 * late, offset.deviation);
        assert!(
            off.abs() < 4.0 * deviation + 0.03 * 0.01 * late.abs() && deviation < 2e-3,
            "{offset:?}"
        );
        let offsets = outcome
            .findings
            .iter()
            .filter(|f| f.code == FindingCode::TimeOffset);
        let texts: Vec<&str> = offsets.map(|f| f.text.as_str()).collect();
        assert_eq!(texts.len(), usize::from(late != 0.0), "{texts:?}");
        let word = if late > 0.0 { "behind" } else { "ahead of" };
        assert!(texts.iter().all(|text| text.contains(word)), "{texts:?}");
    }
}

/// Joint torques with each of the faults of torque channels: the fault is named and the channel
/// excluded, so that the rest is identified as well as without it.
#[test]
fn torques_that_can_not_be_are_named_and_left_out() {
    let setup = arm_with(&[]);
    let truth = real(&setup, 9);
    let good = simulate_torques(&setup, &truth, 12.0, 0.05, 9, |_, _| true);
    let codes = [
        FindingCode::WrongSign,
        FindingCode::WrongUnits,
        FindingCode::Frozen,
        FindingCode::Outliers,
        FindingCode::TimeOffset,
        FindingCode::NegativeRotorInertia,
    ];
    let named = |log: &str| {
        let outcome = run(&setup, &[("log", LogRole::Train, log)], &TORQUE);
        let found = outcome.findings.iter().chain(&outcome.logs[0].findings);
        let found = found.filter(|f| codes.contains(&f.code));
        let names: Vec<String> = found.map(|f| format!("{} {}", f.code, f.subject)).collect();
        (outcome, names)
    };
    let (outcome, names) = named(&good);
    assert!(
        names.is_empty(),
        "{names:?} in a log in which nothing is wrong"
    );
    let (cad, best, ..) = torque_errors(&setup, &truth, &outcome, 79);
    let torque = |joint: &str| format!("joint/{joint}/torque");
    let cases = [
        (
            change(&good, &torque("j3"), |x| -x),
            "wrong_sign joint/j3/torque",
        ),
        (
            change(&good, &torque("j2"), |x| 1000.0 * x),
            "wrong_units joint/j2/torque",
        ),
        (
            change_rows(&good, &torque("j4"), |i, _| {
                0.37 + 1e-3 * (i as f64 * 0.7).sin()
            }),
            "wrong_units joint/j4/torque",
        ),
        (
            change(&good, &torque("j4"), |_| 0.37),
            "frozen joint/j4/torque",
        ),
        (
            {
                let mut held = 0.0;
                change_rows(&good, &torque("j3"), |i, x| {
                    if !(400..700).contains(&i) {
                        held = x;
                    }
                    held
                })
            },
            "frozen joint/j3/torque",
        ),
        (
            change_rows(&good, &torque("j5"), |i, x| {
                if i % 190 == 77 { x + 40.0 } else { x }
            }),
            "outliers joint/j5",
        ),
    ];
    for (log, expected) in &cases {
        let (outcome, names) = named(log);
        assert_eq!(names, [*expected]);
        assert_eq!(outcome.verdict, Verdict::Identified, "{expected}");
        let (_, own, inside, _) = torque_errors(&setup, &truth, &outcome, 79);
        println!("{expected}: {cad:.4} -> {own:.4} Nm, {best:.4} without it, covered {inside:.3}");
        assert!(
            3.0 * own < cad && inside > 0.8,
            "{expected}: {cad} {own} {inside}"
        );
    }
    // Late by three rows: all of them, or one.
    let late = |joints: &[&str]| {
        let mut late = good.clone();
        for joint in joints {
            let mut before = std::collections::VecDeque::new();
            late = change_rows(&late, &torque(joint), |_, x| {
                before.push_back(x);
                if before.len() > 4 {
                    before.pop_front();
                }
                if before.len() == 4 { before[0] } else { x }
            });
        }
        late
    };
    let cases = [
        (&ARM_JOINTS[..], "joint torques"),
        (&["j4"], "joint/j4/torque"),
        (&["j2"], "joint/j2/torque"),
    ];
    for (joints, subject) in cases {
        let (outcome, names) = named(&late(joints));
        assert_eq!(names, [format!("time_offset {subject}")]);
        let finding = outcome
            .findings
            .iter()
            .find(|f| f.code == FindingCode::TimeOffset)
            .expect("it");
        println!("{}", finding.text);
        let words: Vec<&str> = finding.text.split(' ').collect();
        let at = words
            .iter()
            .position(|word| *word == "stamped")
            .expect("how late");
        let late: f64 = words[at + 1].parse().expect("milliseconds");
        assert!(
            (25.0..35.0).contains(&late) && words[at + 3] == "behind",
            "{}",
            finding.text
        );
    }
    // If all others are late, the one that is on time is not reported.
    let (_, names) = named(&late(&["j1", "j2", "j3", "j5", "j6"]));
    assert!(!names.iter().any(|name| name.contains("j4")), "{names:?}");
}

/// If links keep their CAD values because cross-validation was not possible, rotor inertias are
/// those that fit best with CAD, with the corresponding uncertainty.
#[test]
fn rotors_beside_links_that_stay_as_in_cad_are_as_uncertain_as_these() {
    let mut setup = arm_with(&[]);
    setup.robot.torque_side = TorqueSide::Motor;
    let truth = real(&setup, 4);
    let log = simulate_torques(&setup, &truth, 3.6, 0.05, 4, |_, _| true);
    let log = at_the_motors(&log, &ROTORS, 0.5);
    let rows = log.lines().skip(1).step_by(4);
    let short: String = log
        .lines()
        .take(1)
        .chain(rows)
        .flat_map(|line| [line, "\n"])
        .collect();
    let outcome = run(&setup, &[("short", LogRole::Train, &short)], &TORQUE);
    assert_eq!(outcome.verdict, Verdict::NoBetterThanCad);
    assert!(outcome.links.iter().all(|link| link.identified == link.cad));
    for (rotor, truth) in outcome.rotors.iter().zip(ROTORS) {
        assert!(
            (rotor.inertia - truth).abs() < 3.0 * rotor.deviation,
            "{rotor:?}, not {truth}"
        );
        assert!(rotor.deviation > 1e-3, "{rotor:?}");
    }
}
