//! Contacts that nobody declares, and residuals that nothing explains.

use super::*;

/// MuJoCo pushes the hand without a declaration: torques and wrench are the same as with one.
#[test]
fn an_undeclared_contact_is_detected() {
    // First without a contact, so that the setup is confirmed; a minute later with one.
    let (header, free, pushed) = free_and_pushed();
    let count_free = free.len();
    let log = joined(&header, &[(&free, 0.0), (&pushed, 60.0)]);
    let found = estimates_of(possible_hand_contact, &log, |_| [0.0; 6]);
    let declared = estimates_of(
        |config| {
            possible_hand_contact(config);
            config.contact.last_mut().unwrap().presence = Occurrence::Always;
        },
        &log,
        |_| [0.0; 6],
    );
    // Where the force is small but the moment is 0.5 Nm, it is not a contact of the hand.
    let is_found: Vec<bool> = found["contact/hand/detected"]
        .iter()
        .map(|d| d == "1")
        .collect();
    let (before, after) = is_found.split_at(count_free);
    let [before, after] = [before, after].map(|of| of.iter().filter(|found| **found).count());
    assert!(before == 0 && after > 190, "{before} {after}");
    for (name, cells) in &declared {
        // Standard deviations are those of the posture in which contacts changed.
        if name.starts_with("residual/") || name.contains("_std") || name == "contact/hand/detected"
        {
            continue;
        }
        let pairs = cells.iter().zip(&found[name]).zip(&is_found);
        for ((declared, found), is_found) in pairs {
            assert!(!is_found || declared == found, "{name}: {declared} {found}");
        }
    }
    assert!(declared["contact/hand/detected"].iter().all(|d| d == "0"));
    let names = found["residual/l_upper_arm/reason"].iter().zip(&is_found);
    assert!(
        names
            .skip(count_free)
            .all(|(name, is_found)| name == if *is_found { "hand" } else { "unexplained" })
    );
    // The residual has a significance where it can be tested, and none elsewhere.
    let stds = found["contact/hand/fx_std"].iter();
    assert!(
        stds.zip(&is_found)
            .all(|(std, is_found)| std.is_empty() != *is_found)
    );
    assert!(
        declared["residual/l_upper_arm/significance"]
            .iter()
            .all(String::is_empty)
    );
    assert!(
        found["residual/chest/significance"]
            .iter()
            .all(String::is_empty)
    );
}

/// A contact that was there before an encoder failed may still be there after it: torques rest on
/// the reading until the residual has been plausible for two seconds.
#[test]
fn a_contact_may_be_there_after_a_fault() {
    let (header, free, mut pushed) = free_and_pushed();
    let mut columns = header.split(',');
    let at = (columns.position(|name| name == "joint/l_elbow/position")).unwrap();
    // The last five of ten seconds; at the end of the first five the push is detected.
    for row in &mut pushed[101..] {
        let mut cells: Vec<&str> = row.split(',').collect();
        cells[at..at + 4].fill("");
        *row = cells.join(",");
    }
    let log = joined(&header, &[(&free, 0.0), (&pushed, 60.0), (&free, 71.0)]);
    let found = estimates_of(possible_hand_contact, &log, |_| [0.0; 6]);
    let (during, after) = (free.len() + 150, free.len() + pushed.len());
    assert_eq!(found["contact/hand/detected"][free.len() + 100], "1");
    assert_eq!(found["reason/l_wrist_yaw"][during], "stale:l_elbow");
    let std = |row: usize| found["torque_std/l_elbow"][row].parse::<f64>().unwrap();
    // The same motion as at first, row by row. The reading is better than the arm's model.
    assert!((5..35).all(|row| std(after + row) < 0.75 * std(row)));
    assert!((45..200).all(|row| (std(after + row) / std(row) - 1.0).abs() < 0.01));
}

#[test]
fn nothing_is_detected_without_a_disturbance() {
    for urdf_relative_std in [0.0, 0.2] {
        let change = |config: &mut Config| {
            possible_hand_contact(config);
            config.identification.urdf_relative_std = urdf_relative_std;
        };
        let found = estimates_with_added(change, "icub_left_arm_mujoco.csv", |_| [0.0; 6]);
        assert!(
            found["residual/l_upper_arm/reason"]
                .iter()
                .all(String::is_empty)
        );
        let significance = &found["residual/l_upper_arm/significance"];
        assert!(significance.iter().all(|s| s.parse::<f64>().unwrap() < 0.0));
        assert!(found["contact/hand/detected"].iter().all(|d| d == "0"));
    }
}

/// A moment without a force is not a contact of the hand, and neither is a force far from it. The
/// place where it acts is unknown.
#[test]
fn an_unexplained_residual_withholds_the_torques_of_its_sub_tree() {
    let push = |number: usize| {
        if (50..100).contains(&number) {
            1.0
        } else {
            0.0
        }
    };
    for far in [
        [0.0, 0.0, 0.0, 0.0, 8.0, 0.0],
        [0.0, 100.0, 0.0, 0.0, 0.0, 0.0],
    ] {
        let found = estimates_with_added(possible_hand_contact, "icub_left_arm_mujoco.csv", |n| {
            far.map(|x| x * push(n))
        });
        for (joint, sees) in [
            ("l_elbow", true),
            ("l_wrist_yaw", true),
            ("l_shoulder_roll", false),
        ] {
            let column = |what: &str| &found[&format!("{what}/{joint}")];
            for (number, (reason, valid)) in
                column("reason").iter().zip(column("valid")).enumerate()
            {
                // A reading that jumps is not believed before the next one.
                if matches!(number, 50 | 100) {
                    continue;
                }
                let is_pushed = sees && push(number) > 0.0;
                let expected = if is_pushed {
                    ("unexplained", "0")
                } else {
                    ("", "1")
                };
                assert_eq!(
                    (reason.as_str(), valid.as_str()),
                    expected,
                    "{joint} {number} {far:?}"
                );
            }
        }
        let reason = |number: usize| found["residual/l_upper_arm/reason"][number].as_str();
        let expected = |n: usize| if push(n) > 0.0 { "unexplained" } else { "" };
        assert!((0..201).all(|n| matches!(n, 50 | 100) || reason(n) == expected(n)));
        // The residual is the added wrench, with opposite sign: it acts from parent to child.
        let force: f64 = ["fx", "fy", "fz"]
            .map(|axis| {
                found[&format!("residual/l_upper_arm/{axis}")][60]
                    .parse::<f64>()
                    .unwrap()
                    .powi(2)
            })
            .iter()
            .sum();
        assert!((force.sqrt() - far[1]).abs() < 1e-6);
    }
}

/// The hand is touched at a point by declaration. A torque that no force at that point explains
/// makes the wrench of that contact invalid, too.
#[test]
fn an_unexplained_residual_withholds_the_wrench_of_a_known_contact() {
    let touched = |config: &mut Config| {
        config.identification.urdf_relative_std = 0.0;
        let hand = config.contact.iter_mut().find(|c| c.name() == "hand");
        let hand = hand.unwrap();
        (hand.kind, hand.presence) = (ContactModel::Force, Occurrence::Always);
    };
    let found = estimates_with_added(touched, "icub_left_arm_mujoco.csv", |number| {
        let torque = if (50..100).contains(&number) {
            8.0
        } else {
            0.0
        };
        [0.0, 0.0, 0.0, 0.0, torque, torque]
    });
    for (number, reason) in found["contact/hand/reason"].iter().enumerate() {
        let expected = match number {
            // A reading that jumps is not believed before the next one.
            50 | 100 => "implausible:l_arm_ft_sensor",
            51..100 => "unexplained",
            _ => "",
        };
        assert_eq!(reason, expected, "{number}");
    }
}

/// A small force is below the noise of one reading, but significant in the mean of many. It is no
/// longer reported after it ends.
#[test]
fn the_mean_shows_a_force_below_the_noise_of_one_reading() {
    let noisy = |config: &mut Config| {
        possible_hand_contact(config);
        config.force_torque[0].noise_n = [1.0; 3];
        config.force_torque[0].noise_nm = [0.1; 3];
        config.output.max_wait_ms = Some(20.0);
    };
    let setup = setup(noisy);
    let events = recording(&setup, 0.9);
    let hand = setup.robot.contact("hand").unwrap();
    let (from, to) = (Nanos::from_millis(400), Nanos::from_millis(700));
    let detected = |force: f64| {
        let mut pipeline = Pipeline::new(setup.clone());
        let mut found = Vec::new();
        for (channel, t, reading, quality) in &events {
            let mut reading = *reading;
            if let Reading::Wrench(wrench) = &mut reading
                && (from..to).contains(t)
            {
                wrench.force[0] += force;
            }
            pipeline.push(*channel, *t, &reading, *quality);
            while let Some(estimate) = pipeline.poll() {
                let residuals = estimate.contacts.residuals();
                let is_seen = residuals
                    .iter()
                    .any(|r| r.unexplained == 1 || r.contact == hand as u32);
                found.push((estimate.t, is_seen));
            }
        }
        found
    };
    // 2.5 standard deviations of one reading, and many more of the mean of some 50.
    let found = detected(2.5);
    let first = found.iter().find(|(_, seen)| *seen).expect("it is seen").0;
    let last = found.iter().rev().find(|(_, seen)| *seen).unwrap().0;
    assert!(
        first > from + Nanos::from_millis(2) && first < from + Nanos::from_millis(60),
        "{first}"
    );
    assert!(last > to && last < to + Nanos::from_millis(150), "{last}");
    // Ten standard deviations are significant at once.
    let found = detected(10.0);
    let first = found.iter().find(|(_, seen)| *seen).expect("it is seen").0;
    assert!(
        first >= from && first < from + Nanos::from_millis(2),
        "{first}"
    );
}

/// An offset that is neither configured nor identified is unknown: its residual is never
/// significant, and the torques that depend on it are not valid.
#[test]
fn an_offset_that_is_not_configured_is_unknown() {
    let unknown = |config: &mut Config| {
        possible_hand_contact(config);
        (
            config.force_torque[0].offset_n,
            config.force_torque[0].offset_nm,
        ) = (None, None);
    };
    let found = estimates_with_added(unknown, "icub_left_arm_mujoco.csv", |_| {
        [100.0, -50.0, 20.0, 3.0, -2.0, 1.0]
    });
    assert!(
        found["residual/l_upper_arm/reason"]
            .iter()
            .all(String::is_empty)
    );
    for (joint, reason) in [("l_shoulder_roll", "uncertain"), ("l_elbow", "")] {
        assert!(
            found[&format!("reason/{joint}")]
                .iter()
                .all(|own| own == reason),
            "{joint}"
        );
    }
    let std = |joint: &str| {
        found[&format!("torque_std/{joint}")][0]
            .parse::<f64>()
            .unwrap()
    };
    assert!(std("l_shoulder_roll") > 100.0 && std("l_elbow") < 0.1);
}
