//! The sessions themselves: what they hold, and what their true parameters give.

use super::*;

#[test]
fn without_noise_the_torques_are_those_of_mujoco() {
    for sessions in robots() {
        let log = sessions.log("exact");
        let setup = sessions.setup(Urdf::True, None);
        let joints: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
        let (truth, told) = (Table::new(&log), estimates(setup, &log));
        assert!(told.column("t").len() == truth.column("t").len() && truth.column("t").len() >= 18);
        for joint in &joints {
            let (tau, hat) = (
                truth.column(&format!("joint/{joint}/torque")),
                told.column(&format!("torque/{joint}")),
            );
            let size = tau.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            for (row, (tau, hat)) in tau.iter().zip(hat).enumerate() {
                assert!(
                    (tau - hat).abs() < 1e-9 * size.max(1.0),
                    "{joint}, row {row}: {hat}, not {tau}"
                );
            }
        }
        let pushed: Vec<usize> = truth
            .rows_with("contact/hand/fx")
            .into_iter()
            .filter(|row| truth.column("contact/hand/active")[*row] == 1.0)
            .collect();
        assert!(pushed.len() >= 5);
        for part in WRENCH.map(|part| format!("contact/hand/{part}")) {
            for row in &pushed {
                let (true_one, estimated) = (truth.column(&part)[*row], told.column(&part)[*row]);
                assert!(
                    (true_one - estimated).abs() < 1e-9 * 10.0,
                    "{part}, row {row}: {estimated}, not {true_one}"
                );
            }
        }
    }
}

#[test]
fn with_noise_the_true_urdf_is_as_near_as_noise_explains_and_cad_is_not() {
    for sessions in robots() {
        let scores_of = |name: &str, urdf, log: &str, counts: &dyn Fn(f64) -> bool| {
            scores(
                &sessions,
                name,
                log,
                sessions.setup(urdf, Some(name)),
                counts,
            )
        };
        for name in ["train", "validate"] {
            let log = sessions.log(name);
            let [exact, cad] =
                [Urdf::True, Urdf::Cad].map(|urdf| scores_of(name, urdf, &log, &|_| true));
            for (joint, score) in &exact {
                let Score {
                    error,
                    size,
                    stated,
                    ..
                } = score;
                if sessions.distal.contains(&joint.as_str()) {
                    println!(
                        "{name} {joint}: {error:.4} Nm of {size:.3}, CAD {:.4}",
                        cad[joint].error
                    );
                    // Nothing touches the links beyond them: their accuracy is that of the motion.
                    assert!(
                        *error < sessions.near * size,
                        "{name} {joint}: {error} of {size}"
                    );
                    let further = cad[joint].error / error;
                    assert!(
                        further > sessions.cad_further,
                        "{name} {joint}: CAD {further} times further off"
                    );
                } else {
                    // From the sensor's reading, whose offset drifts by some tenths of a newton.
                    // The stated deviation contains only the sensors' noise.
                    let near = (3.0 * stated).max(if sessions.near > 0.1 {
                        sessions.near * size
                    } else {
                        0.0
                    });
                    assert!(
                        *error < near,
                        "{name} {joint}: {error} of {size}, stated {stated}"
                    );
                }
            }
        }
    }
}

#[test]
fn with_noise_and_the_hand_touched_torques_rest_on_the_reading() {
    for sessions in robots() {
        let log = sessions.log("validate");
        let run = |urdf| {
            let setup = sessions.setup_touched(urdf, Some("validate"));
            scores(&sessions, "validate", &log, setup, |_| true)
        };
        let (exact, cad) = (run(Urdf::True), run(Urdf::Cad));
        for joint in ["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"] {
            let Score { error, stated, .. } = &exact[joint];
            println!(
                "{joint}: {error:.4} Nm, stated {stated:.4}, CAD {:.4}",
                cad[joint].error
            );
            assert!(*error < 3.0 * stated, "{joint}: {error}, stated {stated}");
            let further = cad[joint].error / error;
            assert!(
                further > sessions.cad_further,
                "{joint}: CAD {further} times further off"
            );
        }
    }
}

#[test]
fn a_push_at_the_hand_is_told_where_it_is_declared() {
    for sessions in robots() {
        let (log, pushes) = (sessions.log("contact"), sessions.pushes("contact"));
        assert!(pushes.len() >= 3);
        let at = |t: f64| {
            pushes
                .iter()
                .any(|(from, to)| t > from + 0.2 && t < to - 0.2)
        };
        let run = |urdf, log: &str| {
            scores(
                &sessions,
                "contact",
                log,
                sessions.setup(urdf, Some("contact")),
                at,
            )
        };
        let (declared, hidden) = (run(Urdf::True, &log), run(Urdf::True, &undeclared(&log)));
        for joint in ["l_elbow", "l_wrist_prosup", "l_wrist_pitch", "l_wrist_yaw"] {
            let Score { error, stated, .. } = &declared[joint];
            println!(
                "{joint}: {error:.4} Nm, stated {stated:.4}, undeclared {:.4}",
                hidden[joint].error
            );
            assert!(error < &(2.0 * stated), "{joint}: {error}, stated {stated}");
        }
        // An undeclared push is detected.
        assert!(hidden["l_elbow"].error < 1.1 * declared["l_elbow"].error);
    }
}

#[test]
fn a_standing_robots_readings_have_the_noise_of_its_board() {
    for sessions in robots() {
        let log = Table::new(&sessions.log("train"));
        let (until, _) = sessions.moving("train");
        for sensor in sessions.facts["sessions"]["train"]["offsets"]
            .as_object()
            .unwrap()
            .keys()
        {
            for (channel, part) in WRENCH.iter().enumerate() {
                let name = format!("wrench/{sensor}/{part}");
                let rows = log.rows_with(&name);
                let still: Vec<f64> = rows
                    .into_iter()
                    .filter(|row| log.column("t")[*row] < until)
                    .map(|row| log.column(&name)[row])
                    .collect();
                // Differences of neighbouring samples do not contain the drift.
                let found = rms(still.windows(2).map(|two| two[1] - two[0])) / 2.0_f64.sqrt();
                let expected = NOISE[channel].hypot(STEP[channel] / 12.0_f64.sqrt());
                // 250 values or more: a standard error of 5.5 %.
                assert!(
                    (found / expected - 1.0).abs() < 0.22,
                    "{name}: {found}, not {expected}"
                );
            }
        }
    }
}

#[test]
fn the_cad_is_a_fifth_off_in_every_link_and_physical() {
    for sessions in robots() {
        let load = |path: &Path| Model::from_file(path, &[]).unwrap();
        let (cad, truth) = (
            load(&sessions.folder.join("cad.urdf")),
            load(&sessions.urdf),
        );
        assert_eq!(cad.link_count(), truth.link_count());
        let mut off = vec![];
        for (wrong, right) in cad.inertias().iter().zip(truth.inertias()) {
            if right.mass > 0.0 {
                wrong.check(1e-9).unwrap();
                off.push((wrong.mass / right.mass - 1.0).abs());
            }
        }
        // Folded frames bring more than one link together: then some of it cancels.
        assert!(
            off.len() >= 8 && off.iter().all(|off| *off < 0.2001),
            "{off:?}"
        );
        assert!(
            off.iter().filter(|off| **off > 0.1999).count() >= 7,
            "{off:?}"
        );
    }
}
