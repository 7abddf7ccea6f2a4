//! What is said of logs: units, encoders, what a log lacks, what nothing explains.

use super::*;

/// Requests for measurements that are not used are reported as requested but not available; no
/// other requests are.
#[test]
fn what_is_asked_for_in_vain_is_said() {
    let mut setup = arm();
    let truth = real(&setup, 6);
    let log = with_torques(
        &simulate(&setup, &truth, 6.0, 0.01, 6),
        &simulate_torques(&setup, &truth, 6.0, 0.05, 6, |_, _| true),
    );
    setup.robot.torque_side = TorqueSide::Motor;
    setup.robot.calibrated.gain = Gain::Diagonal;
    let wrench = [IdentificationInput::Wrench];
    for (inputs, expected) in [
        (
            &TORQUE[..],
            &["calibration_not_available identification.gain"][..],
        ),
        (
            &wrench,
            &["rotors_not_available identification.torque_side"],
        ),
        (
            &[IdentificationInput::Wrench, IdentificationInput::Torque],
            &[],
        ),
    ] {
        let outcome = run(&setup, &[("log", LogRole::Train, &log)], inputs);
        let notes = outcome.findings.iter();
        let notes = notes.filter(|f| {
            [
                FindingCode::CalibrationNotAvailable,
                FindingCode::RotorsNotAvailable,
            ]
            .contains(&f.code)
        });
        let notes: Vec<String> = notes.map(|f| format!("{} {}", f.code, f.subject)).collect();
        assert_eq!(notes, expected, "{inputs:?}");
    }
}

#[test]
fn joint_whose_zero_is_elsewhere_is_named() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 12.0, 0.01, 3);
    let names = |log: &str| -> Vec<String> {
        let outcome = run(&setup, &[("log", LogRole::Train, log)], &[]);
        outcome
            .findings
            .into_iter()
            .filter(|f| f.code == FindingCode::EncoderOffset)
            .map(|f| f.subject)
            .collect()
    };
    assert!(names(&log).is_empty(), "none in a log where all are right");
    // Beyond the sensor, and between base and sensor, where an error tilts the whole load.
    for joint in ["j4", "j2"] {
        let off = change(&log, &format!("joint/{joint}/position"), |q| q + 0.06);
        assert_eq!(names(&off), [joint]);
    }
}

/// A wrong encoder sign: of one joint beyond the sensor, of one before it, of two at once. No
/// encoder offset is reported for another joint.
#[test]
fn encoder_that_counts_backwards_is_named() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 12.0, 0.01, 3);
    let names = |joints: &[&str]| -> Vec<String> {
        let columns = ["position", "velocity", "acceleration"].map(|what| format!("/{what}"));
        let header = log.lines().next().expect("a header").split(',');
        let is_turned = |name: &&str| {
            let mut names = joints.iter().map(|joint| format!("joint/{joint}"));
            names.any(|joint| columns.iter().any(|column| *name == joint.clone() + column))
        };
        let turned = header
            .filter(is_turned)
            .fold(log.clone(), |log, column| change(&log, column, |x| -x));
        let findings = run(&setup, &[("log", LogRole::Train, &turned)], &[])
            .findings
            .into_iter();
        let errors = findings
            .filter(|f| [FindingCode::WrongSign, FindingCode::EncoderOffset].contains(&f.code));
        errors
            .map(|f| {
                assert!(f.text.contains("Encoder zeros and delays were not tested"));
                f.subject
            })
            .collect()
    };
    for joints in [&["j4"][..], &["j2"], &["j5"]] {
        let expected: Vec<String> = joints
            .iter()
            .map(|joint| format!("joint/{joint}"))
            .collect();
        assert_eq!(names(joints), expected);
    }
    let mut both = names(&["j3", "j5"]);
    both.sort();
    assert_eq!(both, ["joint/j3", "joint/j5"]);
}

/// The torques of all joints also determine the links before the F/T sensors.
#[test]
fn what_can_show_counts_torques_beside_wrenches() {
    let setup = arm();
    let truth = real(&setup, 3);
    let log = with_torques(
        &simulate(&setup, &truth, 6.0, 0.01, 6),
        &simulate_torques(&setup, &truth, 6.0, 0.05, 6, |_, _| true),
    );
    let ranks = |inputs: &[IdentificationInput]| {
        let outcome = run(&setup, &[("log", LogRole::Train, &log)], inputs);
        (outcome.rank, outcome.structural_rank)
    };
    let (wrench, torque) = (IdentificationInput::Wrench, IdentificationInput::Torque);
    let (own, both) = (ranks(&[wrench]), ranks(&[wrench, torque]));
    assert_eq!(own.0, own.1);
    assert!(both.1 > own.1 && both.0 <= both.1, "{own:?} {both:?}");
}

/// The offset of an incremental encoder is set at each start: it may be wrong in one log of several
/// or in all.
#[test]
fn joint_whose_zero_is_elsewhere_in_some_logs_is_named() {
    const LOGS: [&str; 3] = ["first", "second", "third"];
    let setup = arm();
    // In the last one the robot hardly moves.
    let motion = [0.01, 0.01, 0.002];
    let clean: Vec<String> = (0..3)
        .map(|i| simulate(&setup, &real(&setup, 3), 12.0, motion[i], 3 + i as u64))
        .collect();
    let found = |count: usize, joint: &str, by: [f64; 3]| -> Vec<(String, String)> {
        let off = |i: usize| change(&clean[i], &format!("joint/{joint}/position"), |q| q + by[i]);
        let off: Vec<String> = (0..count).map(off).collect();
        let logs: Vec<_> = off
            .iter()
            .zip(LOGS)
            .map(|(log, name)| (name, LogRole::Train, &**log))
            .collect();
        let findings = run(&setup, &logs, &[]).findings.into_iter();
        let offsets = findings.filter(|f| f.code == FindingCode::EncoderOffset);
        offsets.map(|f| (f.subject, f.text)).collect()
    };
    assert_eq!(found(3, "j4", [0.0; 3]), []);
    let told = |count: usize, joint: &str, by: [f64; 3]| {
        let found = found(count, joint, by);
        let [(subject, text)] = found.as_slice() else {
            panic!("{joint} {by:?}: {found:?}")
        };
        println!("{count} logs, {by:?}: {text}");
        assert_eq!(subject, joint, "{text}");
        text.clone()
    };
    // The reported offsets, and their sizes.
    let is = |text: &str, before: &str, by: f64, after: &str| {
        let (_, rest) = text
            .split_once(before)
            .unwrap_or_else(|| panic!("not {before:?}: {text}"));
        let (number, rest) = rest.split_once(' ').expect("a number and more");
        assert!(
            (number.parse::<f64>().expect("a number") - by).abs() < 0.008,
            "{by}: {text}"
        );
        assert!(rest.starts_with(after), "not {after:?}: {text}");
    };
    for joint in ["j4", "j2"] {
        let text = told(3, joint, [0.0, 0.04, 0.0]);
        is(&text, "encoder offset of ", 0.04, "rad in second");
        for count in [2, 3] {
            let text = told(count, joint, [-0.05; 3]);
            is(&text, "encoder offset of ", -0.05, "rad in all logs");
        }
    }
    let text = told(3, "j2", [0.05, -0.04, 0.0]);
    is(&text, "encoder offset of ", 0.05, "rad in first");
    is(&text, "rad in first, ", -0.04, "rad in second");
    // The last joint, wrong in one of two logs: rotated bodies beyond it would explain it as well.
    let text = told(2, "j5", [0.0, 0.04, 0.0]);
    assert!(text.contains("or the opposite in all other logs"), "{text}");
}

/// Readings in other units are refused, even if bodies of other mass would fit them. A possible
/// error of the URDF is reported.
#[test]
fn readings_in_other_units_are_no_heavy_bodies() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 3);
    let scaled = |axes: &[&str], by: f64| {
        let each =
            |log: String, axis: &&str| change(&log, &format!("wrench/ft/{axis}"), |x| by * x);
        axes.iter().fold(log.clone(), each)
    };
    let found = |log: &str| {
        let outcome = run(&setup, &[("log", LogRole::Train, log)], &[]);
        let units = outcome.logs[0].findings.iter();
        let units =
            units.filter(|f| [FindingCode::WrongUnits, FindingCode::Scale].contains(&f.code));
        let units: Vec<String> = units.map(|f| format!("{} {}", f.code, f.subject)).collect();
        (units, matches!(outcome.verdict, Verdict::Nothing(_)))
    };
    assert_eq!(found(&log), (vec![], false));
    for (axes, by) in [(&AXES[..], 100.0), (&AXES[3..], 1000.0), (&AXES[..], 0.001)] {
        let expected = vec!["wrong_units wrench/ft".to_owned()];
        assert_eq!(found(&scaled(axes, by)), (expected, true), "{by}");
    }
    for by in [0.102, 10.0] {
        assert_eq!(
            found(&scaled(&AXES, by)),
            (vec!["scale wrench/ft".to_owned()], false),
            "{by}"
        );
    }
    // One log of two: the other is used.
    let other = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 4);
    let counts = scaled(&AXES, 300.0);
    let logs = [
        ("counts", LogRole::Train, counts.as_str()),
        ("good", LogRole::Train, &other),
    ];
    let outcome = run(&setup, &logs, &[]);
    assert_eq!(outcome.verdict, Verdict::Identified);
    assert_eq!(
        outcome
            .logs
            .iter()
            .map(|log| log.used > 0)
            .collect::<Vec<_>>(),
        [false, true]
    );
}

/// Before estimation, a log gets the same tests as before identification.
#[test]
fn what_can_not_be_is_said_of_a_log_that_is_only_estimated_from() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 3);
    let of_all = |names: &[String], by: f64| {
        let each = |log: String, name: &String| change(&log, name, |x| by * x);
        names.iter().fold(log.clone(), each)
    };
    let wrench = AXES.map(|axis| format!("wrench/ft/{axis}"));
    let angles = ARM_JOINTS.map(|joint| format!("joint/{joint}/position"));
    let found = |log: &str| -> Vec<FindingCode> {
        let findings = implausible(
            &setup.robot,
            sample_log::dataset(&setup.robot, "", LogRole::Validate, log.as_bytes())
                .expect("a log"),
        );
        findings.iter().map(|finding| finding.code).collect()
    };
    assert_eq!(found(&log), []);
    for (log, code) in [
        (of_all(&wrench, -1.0), FindingCode::WrongSign),
        (of_all(&wrench, 0.001), FindingCode::WrongUnits),
        (of_all(&wrench, 10.0), FindingCode::Scale),
        (of_all(&wrench, 0.0), FindingCode::Frozen),
        (of_all(&angles, 57.3), FindingCode::WrongUnits),
        // Without derivatives, so that no two rows have the same posture.
        (
            of_all(&["t".to_owned()], 1000.0)
                .replace("/velocity", "/speed")
                .replace("/acceleration", "/rate"),
            FindingCode::SampleSpacing,
        ),
    ] {
        let found = found(&log);
        assert!(found.contains(&code), "{code}: {found:?}");
    }
    // A log too short for identification is long enough for estimation.
    assert_eq!(found(&between(&log, -1.0, 0.5)), []);
    // With identified parameters, the comparison still uses the URDF's masses.
    let outcome = run(&setup, &[("log", LogRole::Train, &log)], &[]);
    let mut identified = setup.clone();
    identified
        .apply(&parameters(&outcome, &setup.robot, "a test").expect("parameters"))
        .expect("its own");
    let turned = of_all(&wrench, -1.0);
    let codes = |setup: &Setup| {
        let log = sample_log::dataset(&setup.robot, "", LogRole::Validate, turned.as_bytes());
        implausible(&setup.robot, log.expect("a log"))
    };
    assert_eq!(codes(&identified), codes(&setup));
}

/// Data that no parameters explain are reported: a dead encoder, an axis with the wrong sign, the
/// log of another robot.
#[test]
fn readings_that_nothing_explains_are_said() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 3);
    let found = |log: &str| {
        let outcome = run(&setup, &[("log", LogRole::Train, log)], &[]);
        let mut findings = outcome.logs.into_iter().flat_map(|log| log.findings);
        findings.find(|f| f.code == FindingCode::Unexplained)
    };
    assert_eq!(found(&log), None);
    let dead = found(&change(&log, "joint/j4/position", |_| 0.3)).expect("a dead encoder");
    assert_eq!(dead.severity, Severity::Warning);
    let axis = found(&change(&log, "wrench/ft/fx", |x| -x)).expect("a turned axis");
    assert!(
        axis.text.contains("Opposite to the prediction: fx"),
        "{}",
        axis.text
    );
    // The sensor's readings of another motion.
    let other = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 9);
    let other = with_readings(&log, other.lines());
    assert!(found(&other).is_some(), "another robot's readings");
}

#[test]
fn simulated_arm_is_identified_and_its_uncertainty_is_true() {
    for memory in [0.01, 8.0] {
        let (mut covered, mut all, mut squares, mut gains) = (0.0, Vec::new(), 0.0, Vec::new());
        let seeds = 12;
        for seed in 0..seeds {
            let setup = arm();
            let truth = real(&setup, seed);
            let right = Calibration::new(cross_talk(0.01, 700 + seed), Wrench::zero(), None);
            let log = miscalibrated(&simulate(&setup, &truth, 12.0, memory, seed), &right);
            let dataset = sample_log::dataset(&setup.robot, "arm", LogRole::Train, log.as_bytes())
                .expect("a log");
            let outcome =
                identify(&setup.robot, vec![dataset], &[], &mut |_| {}).expect("an outcome");
            assert_eq!(outcome.verdict, Verdict::Identified);
            let (cad, own, inside, deviations) =
                torque_errors(&setup, &truth, &outcome, 500 + seed);
            println!(
                "memory {memory} seed {seed}: {cad:.4} -> {own:.4} Nm, covered {inside:.3}, tau \
                 {:.3} shrink {}",
                outcome.tau, outcome.least_retained_fraction
            );
            covered += inside / f64::from(u32::try_from(seeds).expect("small"));
            squares += own * own / f64::from(u32::try_from(seeds).expect("small"));
            gains.push(cad / own);
            all.extend(deviations);
        }
        all.sort_by(f64::total_cmp);
        gains.sort_by(f64::total_cmp);
        let (median, rms) = (all[all.len() / 2], squares.sqrt());
        println!(
            "memory {memory}: covered {covered:.3}, median deviation {median:.5}, RMS error \
             {rms:.5} Nm, least gain {:.1}",
            gains[0]
        );
        assert!(gains[0] >= 5.0, "{gains:?}");
        assert!((0.90..=0.99).contains(&covered), "{covered}");
        assert!(median <= 3.0 * rms, "{median} {rms}");
    }
}

/// A copy of another log does not count twice, and does not validate parameters that were trained
/// on the original. An empty log is refused alone.
#[test]
fn logs_that_say_nothing_new_or_nothing_at_all_are_left_out() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 3);
    let once = run(&setup, &[("one", LogRole::Train, &log)], &[]);
    let header = log.lines().next().expect("a header").to_owned() + "\n";
    let dates = log.replace('\n', "\n2024-01-01T00:00:0");
    let logs = [
        ("one", LogRole::Train, log.as_str()),
        ("again", LogRole::Train, &log),
        ("header", LogRole::Train, &header),
        ("same", LogRole::Validate, &log),
        (
            "other",
            LogRole::Validate,
            &simulate(&setup, &real(&setup, 3), 6.0, 0.01, 4),
        ),
    ];
    let outcome = run(&setup, &logs, &[]);
    assert_eq!(outcome.tau, once.tau);
    assert_eq!(
        outcome
            .logs
            .iter()
            .map(|log| log.used > 0)
            .collect::<Vec<_>>(),
        [true, false, false, false, true]
    );
    let refusal = |log: &LogOutcome| {
        let refusals = log
            .findings
            .iter()
            .filter(|f| f.severity == Severity::Refusal);
        refusals
            .map(|f| format!("{}: {}", f.code, f.text))
            .collect::<String>()
    };
    let refusals: Vec<String> = outcome.logs.iter().map(refusal).collect();
    assert_eq!(
        refusals[1],
        "duplicate_log: it is the same recording as one: it is used once"
    );
    assert_eq!(refusals[2], "unreadable: it has a header but no rows");
    assert!(
        refusals[3].starts_with("duplicate_log: it is the same recording as one: it was excluded"),
        "{}",
        refusals[3]
    );

    // Two seconds, from the first row to the end of the last.
    let short: String = log
        .lines()
        .take(201)
        .map(|line| line.to_owned() + "\n")
        .collect();
    let shorter: String = log
        .lines()
        .take(199)
        .map(|line| line.to_owned() + "\n")
        .collect();
    let logs = [
        ("one", LogRole::Train, log.as_str()),
        ("short", LogRole::Validate, &short),
        ("shorter", LogRole::Validate, &shorter),
    ];
    let refusals: Vec<String> = run(&setup, &logs, &[]).logs.iter().map(refusal).collect();
    assert_eq!(refusals[1], "");
    assert!(
        refusals[2].contains("too short: record at least 2 s"),
        "{}",
        refusals[2]
    );

    // Neither does a copy with missing readings.
    let holes: String = log
        .lines()
        .enumerate()
        .fold(String::new(), |text, (number, line)| {
            let at = line.split(',').count();
            let gone = |(place, cell)| {
                if number % 50 == 9 && place + 6 >= at {
                    ""
                } else {
                    cell
                }
            };
            let cells: Vec<&str> = line.split(',').enumerate().map(gone).collect();
            text + &cells.join(",") + "\n"
        });
    let twice = run(
        &setup,
        &[
            ("one", LogRole::Train, &holes),
            ("again", LogRole::Train, &holes),
        ],
        &[],
    );
    assert!(refusal(&twice.logs[1]).starts_with("duplicate_log: "));

    // The verdict states for each log what is wrong.
    // Without derivatives, which make each row a posture of its own.
    let milliseconds = change(&log, "t", |t| 1e3 * t)
        .replace("/velocity", "/speed")
        .replace("/acceleration", "/rate");
    let dead = AXES.iter().fold(log.clone(), |log, axis| {
        change(&log, &format!("wrench/ft/{axis}"), |_| 1.5)
    });
    for (log, reason) in [
        (
            &header,
            "no log can be identified from: bad: it has a header but no rows",
        ),
        (&dates, "none of its"),
        (&milliseconds, "if t is in milliseconds"),
        (&dead, "wrench/ft does not change"),
    ] {
        let outcome = run(&setup, &[("bad", LogRole::Train, log)], &[]);
        let Verdict::Nothing(found) = outcome.verdict else {
            panic!("{:?}", outcome.verdict)
        };
        assert!(found.contains(reason), "{found}");
    }
}

/// A slow sensor in the rows of fast encoders, with its last reading repeated: it is used at its
/// own rate.
#[test]
fn a_sensor_that_is_held_between_its_readings_is_used() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 12.0, 0.01, 3);
    let mut last = "";
    let held = log.lines().enumerate().map(|(number, row)| {
        // The header, and every eighth row.
        if number == 0 || number % 8 == 1 {
            last = row;
        }
        last
    });
    let outcome = run(
        &setup,
        &[("held", LogRole::Train, &with_readings(&log, held))],
        &[],
    );
    assert_eq!(outcome.verdict, Verdict::Identified);
    let codes: Vec<FindingCode> = outcome.logs[0].findings.iter().map(|f| f.code).collect();
    assert_eq!(codes, [FindingCode::Repeated]);
}

/// Encoders with the configured noise have no spikes; those with more noise have.
#[test]
fn what_a_position_may_be_off_by_is_no_spike() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 6.0, 0.01, 3);
    let spikes = |size: f64| {
        let row = std::cell::Cell::new(0);
        let spiked = change(&log, "joint/j4/position", |q| {
            row.set(row.get() + 1);
            if row.get() % 100 == 50 { q + size } else { q }
        });
        let outcome = run(&setup, &[("log", LogRole::Train, &spiked)], &[]);
        let findings = outcome.logs[0].findings.iter();
        findings
            .filter(|f| f.code == FindingCode::Outliers && f.subject == "joint/j4")
            .count()
    };
    assert_eq!(setup.joint_settings.noise, 4.8e-4);
    assert_eq!([spikes(4e-4), spikes(0.02)], [0, 1]);
}
