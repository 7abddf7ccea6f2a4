//! Gains and drifts of F/T sensors.

use super::*;

#[test]
fn gains_of_a_sensor_are_identified() {
    let setup = arm();
    let truth = real_beyond(&setup, 1);
    let gain = Matrix6::from_diagonal(&Vector6::new(1.07, 0.92, 1.05, 1.06, 0.93, 1.04));
    let right = Calibration::new(gain, Wrench::zero(), None);
    let log = miscalibrated(&simulate(&setup, &truth, 50.0, 3.0, 11), &right);
    let (train, rest) = (between(&log, -1.0, 40.0), between(&log, 40.0, 99.0));
    let found = |gain: Gain| with_gain(&setup, gain, &truth, (&train, &rest));
    let (without, file, (rough, missed, _)) = found(Gain::None);
    assert!(without.calibrations.is_empty() && !file.to_string().contains("\ngain"));
    let (with, file, (fine, inside, deviation)) = found(Gain::Diagonal);
    let errors = calibration_errors(&with, &right);
    assert!(errors.iter().all(|error| error.abs() < 3.0), "{errors:?}");
    // Only the prior separates the common gain of the forces from mass, and that is reported. Their
    // differences are known much better.
    assert!(
        with.findings
            .iter()
            .any(|f| f.code == FindingCode::GainMassNotSeparable),
        "{:?}",
        with.findings
    );
    let of_force = |i: usize| with.calibrations[0].error[i] - gain[(i, i)];
    for (a, b) in [(3, 4), (4, 5)] {
        assert!(
            (of_force(a) - of_force(b)).abs() < 0.01,
            "{} {}",
            of_force(a),
            of_force(b)
        );
    }
    // The remaining error of the torque before the sensor comes from the common gain, and the
    // stated deviation contains it.
    assert!(fine < 0.75 * rough, "{fine} {rough}");
    assert!(inside > 0.9 && missed < 0.85, "{inside} {missed}");
    assert!(deviation < 3.0 * fine, "{deviation} {fine}");
    // Held-out data are predicted better.
    let rms = |outcome: &Outcome| outcome.logs[1].predicted.relative_error.identified;
    assert!(
        rms(&with) < 0.5 * rms(&without),
        "{} {}",
        rms(&with),
        rms(&without)
    );
    // The file contains all of it.
    assert_eq!(Parameters::parse(&file.to_string()).expect("a file"), file);
    assert_eq!(file.calibration_deviation(0).len(), 6);
    let pairs = file
        .calibration_deviation(0)
        .iter()
        .zip(&with.calibrations[0].deviation);
    for (file, told) in pairs {
        assert!((file - told).abs() < 1e-9, "{file} {told}");
    }
}

/// A sensor whose force gains are wrong by 8 %, on an arm with a large load that leans over only
/// once: there the residual looks like a contact while gains are unknown. A real push is still
/// found.
#[test]
fn what_a_gain_leaves_under_load_is_no_contact() {
    let mut setup = arm();
    let hand = setup.robot.model.frame("l6").expect("a link").link;
    let heavy = RigidInertia::from_parameters(
        &setup.robot.model.inertias()[hand]
            .parameters()
            .map(|p| 12.0 * p),
    );
    setup.robot.model.set_inertia(hand, heavy).expect("a body");
    setup.initial = InertialState::configured(&setup.robot);
    let truth = real_beyond(&setup, 8);
    let lean = |phase: &[f64], t: f64| {
        let (mut q, mut dq, mut ddq) = state(phase, t);
        for values in [&mut q, &mut dq, &mut ddq] {
            values.iter_mut().for_each(|x| *x *= 0.1);
        }
        let rate = std::f64::consts::FRAC_PI_2;
        let (s, c) = (rate * (t - 16.0).clamp(0.0, 4.0)).sin_cos();
        if t > 16.0 && t < 20.0 {
            q[1] += 0.7 * (1.0 - c);
            dq[1] += 0.7 * rate * s;
            ddq[1] += 0.7 * rate * rate * c;
        }
        (q, dq, ddq)
    };
    let gain = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, 1.08, 0.92, 1.08));
    let right = Calibration::new(gain, Wrench::zero(), None);
    let log = miscalibrated(
        &simulate_motion(&setup, &truth, 22.0, 3.0, 18, lean),
        &right,
    );
    let log = change_rows(&log, "wrench/ft/fx", |row, value| {
        let share = (row as f64 - 600.0) / 150.0;
        value + 20.0 * (std::f64::consts::PI * share.clamp(0.0, 1.0)).sin()
    });
    setup.robot.calibrated.gain = Gain::Diagonal;
    let outcome = run(
        &setup,
        &[("log", LogRole::Train, &log)],
        &[IdentificationInput::Wrench],
    );
    let left_out = outcome.logs[0].excluded.iter();
    let suspected: Vec<_> = left_out
        .filter(|out| out.reason.contains("suspected"))
        .collect();
    let [push] = suspected.as_slice() else {
        panic!("{suspected:?}")
    };
    let (from, to) = (push.first.seconds(), push.last.seconds());
    assert!(
        (5.6..6.2).contains(&from) && (7.3..7.9).contains(&to),
        "{push:?}"
    );
}

#[test]
fn cross_talk_of_a_sensor_is_identified() {
    let setup = arm();
    let truth = real_beyond(&setup, 2);
    let gain = cross_talk(0.03, 77);
    let right = Calibration::new(gain, Wrench::zero(), None);
    let log = miscalibrated(&simulate(&setup, &truth, 60.0, 3.0, 12), &right);
    let (train, rest) = (between(&log, -1.0, 50.0), between(&log, 50.0, 99.0));
    let found = |gain: Gain| with_gain(&setup, gain, &truth, (&train, &rest));
    let (without, _, (rough, ..)) = found(Gain::None);
    let (with, _, (fine, inside, _)) = found(Gain::Full);
    let errors = calibration_errors(&with, &right);
    assert_eq!(errors.len(), 36);
    let beyond = |bound: f64| errors.iter().filter(|error| error.abs() > bound).count();
    assert!(beyond(4.0) == 0 && beyond(2.0) <= 5, "{errors:?}");
    assert!(
        fine < 0.5 * rough && inside > 0.85,
        "{fine} {rough} {inside}"
    );
    let rms = |outcome: &Outcome| outcome.logs[1].predicted.relative_error.identified;
    assert!(
        rms(&with) < 0.3 * rms(&without),
        "{} {}",
        rms(&with),
        rms(&without)
    );
}

#[test]
fn the_drift_of_a_sensor_with_temperature_is_identified() {
    let mut setup = arm();
    let truth = real_beyond(&setup, 3);
    let per_kelvin = Wrench::from_parts([0.05, -0.05, 0.05], [0.001, -0.002, 0.003]);
    let right = Calibration::new(Matrix6::identity(), per_kelvin, Some(35.0));
    let plain = simulate(&setup, &truth, 60.0, 3.0, 13);
    let log = miscalibrated(&plain, &right);
    let wrench = [IdentificationInput::Wrench];
    // If temperature drift is not requested, temperatures change nothing.
    let text = |log: &str, setup: &Setup| {
        let outcome = run(setup, &[("train", LogRole::Train, log)], &wrench);
        parameters(&outcome, &setup.robot, "a test")
            .expect("parameters")
            .to_string()
    };
    let cold = miscalibrated(&plain, &Calibration::default());
    let without_temperature: String = cold
        .lines()
        .map(|line| line.rsplit_once(',').expect("cells").0.to_owned() + "\n")
        .collect();
    assert_eq!(text(&cold, &setup), text(&without_temperature, &setup));

    setup.robot.calibrated = Kind {
        gain: Gain::None,
        temperature: true,
    };
    let outcome = run(&setup, &[("train", LogRole::Train, &log)], &wrench);
    let errors = calibration_errors(&outcome, &right);
    assert_eq!(errors.len(), 6);
    assert!(errors.iter().all(|error| error.abs() < 3.0), "{errors:?}");
    let found = &outcome.calibrations[0];
    for (deviation, truth) in found.deviation.iter().zip(per_kelvin.torque_first()) {
        assert!(*deviation < 0.4 * truth.abs(), "{deviation} of {truth}");
    }
    // Without a configured reference temperature the mean is used, and the offset is that at the
    // mean.
    let reference = found.identified.reference().expect("a reference");
    assert!((34.0..37.0).contains(&reference), "{reference}");
    // A missing temperature is reported, and nothing else changes.
    let blind = run(
        &setup,
        &[("train", LogRole::Train, &without_temperature)],
        &wrench,
    );
    assert!(blind.calibrations.is_empty());
    assert!(
        blind
            .findings
            .iter()
            .any(|f| f.code == FindingCode::NoTemperature && f.subject == "ft")
    );
}

/// A factory calibration with a prior deviation of 1/2000: no log determines the gains better, and
/// that is reported.
#[test]
fn a_gain_that_no_motion_tells_stays_the_workbenchs() {
    let mut setup = arm();
    let truth = real_beyond(&setup, 4);
    let log = simulate(&setup, &truth, 12.0, 3.0, 14);
    setup.robot.calibrated.gain = Gain::Diagonal;
    setup.robot.gain_std = 5e-4;
    let outcome = run(
        &setup,
        &[("train", LogRole::Train, &log)],
        &[IdentificationInput::Wrench],
    );
    let found = &outcome.calibrations[0];
    assert!(
        found.error.iter().all(|error| error.abs() < 1e-3),
        "{found:?}"
    );
    let finding = outcome
        .findings
        .iter()
        .find(|f| f.code == FindingCode::CalibrationNotObservable);
    let text = &finding.expect("a finding").text;
    assert!(text.contains("the gain of fz"), "{text}");
}

/// Gains are identified unless the configuration says otherwise. Where they are right they cost
/// nothing; where one is wrong, another log is predicted better.
#[test]
fn gains_cost_nothing_where_they_are_right() {
    let mut setup = arm_with(&["ft", "wrist"]);
    assert_eq!(setup.robot.calibrated.gain, Gain::Auto);
    let truth = real(&setup, 3);
    let logs = [3, 4].map(|seed| simulate(&setup, &truth, 12.0, 0.01, seed));
    for (channels, gain) in [
        (&["ft/fz", "ft/tx"][..], 1.0),
        (&["wrist/fz", "wrist/tx"], 1.12),
    ] {
        let [train, other] = logs.each_ref().map(|log| {
            channels.iter().fold(log.clone(), |log, channel| {
                change(&log, &format!("wrench/{channel}"), |x| gain * x)
            })
        });
        let [own, without] = [Gain::Auto, Gain::None].map(|kind| {
            setup.robot.calibrated.gain = kind;
            let logs = [
                ("train", LogRole::Train, &*train),
                ("other", LogRole::Validate, &*other),
            ];
            let outcome = run(&setup, &logs, &[IdentificationInput::Wrench]);
            assert_eq!(
                outcome.calibrations.len(),
                if kind == Gain::Auto { 2 } else { 0 }
            );
            outcome.logs[1].predicted.relative_error.identified
        });
        println!("{channels:?} {gain}: {own:.5}, without gains {without:.5}");
        let most = if gain == 1.0 { 1.02 } else { 0.5 };
        assert!(own < most * without, "{channels:?} {gain}: {own} {without}");
    }
}

/// The estimated drift of an offset is never larger than that of a real sensor, at any actual
/// drift.
#[test]
fn no_offset_walks_faster_than_its_noise() {
    let setup = arm();
    let log = simulate(&setup, &real(&setup, 3), 12.0, 0.01, 3);
    let noise = setup.robot.structure.sensors()[0].noise();
    let stated: Vec<f64> = noise.force.into_iter().chain(noise.torque).collect();
    let mut normal = Noise(5);
    let log = AXES.iter().zip(&stated).fold(log, |log, (axis, stated)| {
        let mut offset = 0.0;
        change_rows(&log, &format!("wrench/ft/{axis}"), |_, x| {
            offset += 3.0 * stated * 0.1 * normal.normal();
            x + offset
        })
    });
    let outcome = run(&setup, &[("log", LogRole::Train, &log)], &[]);
    for (axis, stated) in AXES.iter().zip(&stated) {
        let name = format!("wrench/ft/{axis}");
        let mut channels = outcome.channels.iter();
        let found = channels.find(|c| c.name == name).expect("a channel").drift;
        assert!(found <= 1.001 * stated, "{axis}: {found} of {stated}");
    }
}
