//! Estimates from a file, with calibrations and temperatures.

use super::*;

#[test]
fn estimates_from_a_file_equal_those_of_other_libraries() {
    for (name, base_is_imu) in [
        ("icub_left_arm_mujoco.csv", true),
        ("icub_left_arm_mujoco.csv", false),
        ("icub_left_arm_mujoco_contact.csv", true),
        ("icub_left_arm_mujoco_contact.csv", false),
    ] {
        let setup = setup(|config| {
            if !base_is_imu {
                config.base = proprio_estimator::config::Base::Fixed {
                    link: "chest".into(),
                    gravity_mps2: [0.0, 0.0, -9.80665],
                };
                config.contact.retain(|c| c.name() != "stand");
            }
        });
        let joints: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
        let (log, mut out) = (golden(name), Vec::new());
        let report = offline::estimate(setup, log.as_bytes(), &mut out, None).unwrap();
        let (want, got) = (table(&log), table(std::str::from_utf8(&out).unwrap()));
        assert_eq!(report.estimates, 201);
        assert_eq!(want["t"].len(), got["t"].len());
        let number = |s: &String| s.parse::<f64>().unwrap();
        assert!(
            want["t"]
                .iter()
                .zip(&got["t"])
                .all(|(a, b)| number(a) == number(b)),
            "the same instants"
        );
        for joint in &joints {
            let pairs = want[&format!("joint/{joint}/torque")]
                .iter()
                .zip(&got[&format!("torque/{joint}")]);
            for (want, got) in pairs {
                let (want, got) = (number(want), number(got));
                assert!(
                    (want - got).abs() < 1e-9 * (1.0 + want.abs()),
                    "{name} imu {base_is_imu} {joint}: {want} {got}"
                );
            }
            assert!(got[&format!("valid/{joint}")].iter().all(|v| v == "1"));
            assert!(got[&format!("reason/{joint}")].iter().all(String::is_empty));
        }
        for part in ["fx", "fy", "fz", "tx", "ty", "tz"] {
            let column = format!("contact/hand/{part}");
            for (row, got) in got[&column].iter().enumerate() {
                let want = want.get(&column).map_or(0.0, |w| number(&w[row]));
                assert!(
                    (want - number(got)).abs() < 1e-9,
                    "{name} {column} {row}: {want} {got}"
                );
            }
        }
    }
}

#[test]
fn corrected_readings_give_the_same_estimates_as_exact_ones() {
    let log = golden("icub_left_arm_mujoco_contact.csv");
    let change = calibration();
    let (wrong, temperatures) = miscalibrated(&log, &change);
    assert!(temperatures.last().unwrap() - temperatures[0] > 9.0);
    let run = |setup: Setup, text: &str| {
        let mut out = Vec::new();
        offline::estimate(setup, text.as_bytes(), &mut out, None).unwrap();
        table(std::str::from_utf8(&out).unwrap())
    };
    let right = run(setup(|_| {}), &log);
    let corrected = run(setup(|config| calibrate(config, &change)), &wrong);
    let uncorrected = run(setup(|_| {}), &wrong);
    let mut off: f64 = 0.0;
    for column in [
        "torque/l_shoulder_pitch",
        "torque/l_elbow",
        "contact/hand/fz",
        "torque_std/l_elbow",
    ] {
        // Before the first row no temperature was received.
        let rows = right[column]
            .iter()
            .zip(&corrected[column])
            .zip(&uncorrected[column]);
        for ((right, corrected), uncorrected) in rows.skip(usize::from(column.contains("std"))) {
            let number = |s: &String| s.parse::<f64>().unwrap();
            assert!(
                (number(right) - number(corrected)).abs() < 1e-9,
                "{column}: {right} {corrected}"
            );
            off = off.max((number(right) - number(uncorrected)).abs());
        }
    }
    assert!(off > 1.0, "{off}");
    // Without corrections not a bit changes, with temperatures or without.
    let with_temperatures: String = log
        .lines()
        .zip(wrong.lines())
        .fold(String::new(), |text, (line, other)| {
            text + line + "," + other.rsplit_once(',').unwrap().1 + "\n"
        });
    assert_eq!(run(setup(|_| {}), &with_temperatures), right);
}

/// A temperature may arrive up to half the wait after a wrench with a later stamp, and nothing
/// changes: a live run equals a replay.
#[test]
fn temperatures_count_by_their_stamps() {
    let change = calibration();
    let (log, _) = miscalibrated(&golden("icub_left_arm_mujoco_contact.csv"), &change);
    let run = |delay: Nanos| {
        let mut pipeline = Pipeline::new(setup(|config| {
            calibrate(config, &change);
            config.output.max_wait_ms = Some(40.0);
        }));
        let mut reader = TableReader::new(log.as_bytes()).unwrap();
        let series: Vec<_> = reader.series().to_vec();
        let (mut row, mut samples) = (Row::default(), Vec::new());
        while reader.next_row(&mut row).unwrap() {
            for item in &row.items {
                let of = &series[item.series];
                if let (SeriesKind::Channel(kind), Value::Reading(reading, quality)) =
                    (of.kind, &item.value)
                    && let Some(channel) = pipeline.setup().robot.channel(kind, &of.name)
                {
                    let late = matches!(reading, Reading::Temperature(_));
                    let arrival = row.t.unwrap() + if late { delay } else { Nanos::ZERO };
                    samples.push((arrival, row.t.unwrap(), channel, *reading, *quality));
                }
            }
        }
        samples.sort_by_key(|(arrival, ..)| *arrival);
        let mut torques = Vec::new();
        for (_, t, channel, reading, quality) in samples {
            pipeline.push(channel, t, &reading, quality);
            while let Some(estimate) = pipeline.poll() {
                torques.push((estimate.t, estimate.torques.joints()[0].torque.to_bits()));
            }
        }
        (torques, pipeline.counts().late)
    };
    let (prompt, late) = run(Nanos::ZERO);
    assert_eq!((prompt.len(), late), (201, 0));
    assert_eq!(run(Nanos::from_millis(20)), (prompt.clone(), 0));
    // Later than that it is counted as late.
    let (other, late) = run(Nanos::from_millis(80));
    assert!(late > 10, "{late}");
    assert_ne!(other, prompt);
}

/// Temperatures that are not used have no effect.
#[test]
fn temperatures_count_only_if_trusted_and_needed() {
    let change = calibration();
    let wanting = || setup(|config| calibrate(config, &change));
    let plain = setup(|_| {});
    let sensor = plain
        .robot
        .channel(Kind::Wrench, "l_arm_ft_sensor")
        .unwrap();
    let events = recording(&plain, 0.5);
    let with = |said: &[(f64, f64, Quality)]| {
        let said = said.iter();
        let said = said.map(|(t, celsius, quality)| {
            (
                sensor,
                Nanos::from_seconds(*t),
                temperature(*celsius),
                *quality,
            )
        });
        // In the order of arrival: each before samples with the same stamp.
        let mut all = events.clone();
        for one in said {
            all.insert(all.partition_point(|other| other.1 < one.1), one);
        }
        all
    };
    // If no calibration depends on temperature, not even invalid temperatures are counted.
    let odd = with(&[
        (0.1, 30.0, Quality::GOOD),
        (0.1, 30.0, Quality::GOOD),
        (0.2, f64::NAN, Quality::GOOD),
    ]);
    let ((without, before), (got, after)) = (run(plain.clone(), &events), run(plain, &odd));
    assert_eq!(bits(&got), bits(&without));
    assert_eq!(after.counts(), before.counts());
    // If one does, they are.
    let (_, pipeline) = run(wanting(), &odd);
    let (taken, counts) = (before.counts().taken, pipeline.counts());
    assert_eq!(
        (counts.taken, counts.backward, counts.not_finite),
        (taken + 1, 1, 1)
    );
    // A temperature that the board marks as faulty is not taken.
    let good = (0.1, 26.0, Quality::GOOD);
    let faulty = (0.2, 900.0, Quality::DEVICE_FAULT);
    let (right, _) = run(wanting(), &with(&[good]));
    let (got, pipeline) = run(wanting(), &with(&[good, faulty]));
    assert_eq!(bits(&got), bits(&right));
    assert_eq!(pipeline.counts().taken, taken + 1);
    let (wrong, _) = run(wanting(), &with(&[good, (0.2, 900.0, Quality::GOOD)]));
    assert_ne!(bits(&wrong), bits(&right));
}

/// If a board's temperature is unknown, the standard deviations of torques grow, as with an
/// uncertain offset.
#[test]
fn without_a_temperature_torques_are_less_certain() {
    let change = calibration();
    // All channels at rest at one instant, and a temperature of this age.
    let log = golden("icub_left_arm_mujoco.csv");
    let std = |age: Option<f64>, kelvin: f64| {
        let mut pipeline = Pipeline::new(setup(|config| {
            calibrate(config, &change);
            let ft = &mut config.force_torque[0];
            ft.offset_std_n = Some(ft.temperature_n_per_k.map(|k| (k * kelvin).abs()));
            ft.offset_std_nm = Some(ft.temperature_nm_per_k.map(|k| (k * kelvin).abs()));
        }));
        let t = Nanos::from_seconds(10_000.0);
        if let Some(age) = age {
            let sensor = pipeline
                .setup()
                .robot
                .channel(Kind::Wrench, "l_arm_ft_sensor")
                .unwrap();
            pipeline.push(
                sensor,
                t - Nanos::from_seconds(age),
                &temperature(27.0),
                Quality::GOOD,
            );
        }
        let mut reader = TableReader::new(log.as_bytes()).unwrap();
        let series: Vec<_> = reader.series().to_vec();
        let mut row = Row::default();
        assert!(reader.next_row(&mut row).unwrap());
        for item in &row.items {
            let of = &series[item.series];
            if let (SeriesKind::Channel(kind), Value::Reading(reading, quality)) =
                (of.kind, &item.value)
                && let Some(channel) = pipeline.setup().robot.channel(kind, &of.name)
            {
                pipeline.push(channel, t, reading, *quality);
            }
        }
        pipeline.finish();
        let torques = pipeline.poll().unwrap().torques;
        let missing: Vec<&str> = pipeline.without_temperature().collect();
        let deviations: Vec<f64> = torques
            .joints()
            .iter()
            .map(|j| j.standard_deviation)
            .collect();
        (deviations, missing == ["l_arm_ft_sensor"])
    };
    let known = std(Some(30.0), 0.0);
    assert!(!known.1);
    assert_eq!(std(Some(59.0), 0.0), known);
    for (age, kelvin) in [(Some(180.0), 2.0), (Some(5000.0), 10.0), (None, 10.0)] {
        let (found, is_told) = std(age, 0.0);
        let (expected, _) = std(Some(30.0), kelvin);
        assert!(is_told, "{age:?}");
        for ((found, expected), known) in found.iter().zip(&expected).zip(&known.0) {
            // The temperature is that of half the wait before.
            assert!(
                (found / expected - 1.0).abs() < 1e-3,
                "{age:?}: {found} {expected}"
            );
            assert!(found > known, "{age:?}: {found} {known}");
        }
    }
}

/// Information gathered with one gain is not valid for readings with another gain.
#[test]
fn a_state_identified_with_other_calibrations_is_not_resumed() {
    let identifying = |change: &dyn Fn(&mut Config)| {
        Pipeline::new(setup(|config| {
            config.identification.enabled = true;
            config.contact.last_mut().unwrap().presence = Occurrence::Possible;
            change(config);
        }))
    };
    let mut pipeline = identifying(&|_| {});
    let events = recording(pipeline.setup(), 3.0);
    let mut state = None;
    for (channel, t, reading, quality) in events {
        pipeline.push(channel, t, &reading, quality);
        while pipeline.poll().is_some() {
            if let Some(job) = pipeline.take_job() {
                state = Some(job.state());
                pipeline.give_back(job);
            }
        }
    }
    let state = state.expect("a job within three seconds");
    identifying(&|_| {}).resume(&state).unwrap();
    // Offsets are not compared: a restart may change them.
    identifying(&|config| config.force_torque[0].offset_n = Some([5.0, 0.0, 0.0]))
        .resume(&state)
        .unwrap();
    let other: [&dyn Fn(&mut Config); 4] = [
        &|config| config.force_torque[0].gain = Some(vec![1.07, 1.0, 1.0, 1.0, 1.0, 1.0]),
        &|config| {
            config.force_torque[0].temperature_n_per_k = [0.0, 0.05, 0.0];
            config.force_torque[0].reference_celsius = Some(25.0);
        },
        &|config| {
            config.force_torque[0].direction = match config.force_torque[0].direction {
                Some(MeasurementDirection::ChildToParent) => {
                    Some(MeasurementDirection::ParentToChild)
                }
                _ => Some(MeasurementDirection::ChildToParent),
            }
        },
        &|config| config.force_torque[0].frame = Some(MeasurementFrame::Parent),
    ];
    for (number, change) in other.into_iter().enumerate() {
        let mut pipeline = identifying(change);
        let fresh = pipeline.identification().unwrap().solution().components[0]
            .bodies
            .clone();
        let error = pipeline.resume(&state).unwrap_err().to_string();
        assert!(
            error.contains("mounting or calibration"),
            "{number}: {error}"
        );
        let after = &pipeline.identification().unwrap().solution().components[0].bodies;
        assert_eq!(after, &fresh);
    }
}
