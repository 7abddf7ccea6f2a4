//! Bases, contacts and mistakes between configuration and model.

use super::*;

#[test]
fn samples_of_an_uncalibrated_encoder_are_not_differentiated() {
    let setup = setup(|_| {});
    let elbow = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let names: Vec<String> = setup.robot.joint_names().map(str::to_owned).collect();
    let events = recording(&setup, 0.6);
    let (clean, _) = run(setup.clone(), &events);
    let mut bad = events;
    for event in bad
        .iter_mut()
        .filter(|e| e.0 == elbow && e.1 < Nanos::from_millis(300))
    {
        let Reading::Joint(state) = event.2 else {
            panic!("a joint")
        };
        event.2 = Reading::Joint(JointState {
            position: state.position + 1.0,
            ..state
        });
        event.3 = Quality::NOT_CALIBRATED;
    }
    let (estimates, _) = run(setup, &bad);
    let mut withheld = 0;
    for (estimate, clean) in estimates.iter().zip(&clean) {
        for ((name, joint), right) in names
            .iter()
            .zip(estimate.torques.joints())
            .zip(clean.torques.joints())
        {
            withheld += u32::from(joint.reason == Reason::DeviceFault);
            if joint.valid == 1 && right.valid == 1 {
                let error = joint.torque - right.torque;
                assert!(error.abs() < 0.2, "{name} at {}: {error}", estimate.t);
            }
        }
    }
    assert!(withheld > 500);
    assert!(
        estimates
            .last()
            .unwrap()
            .torques
            .joints()
            .iter()
            .all(|j| j.valid == 1)
    );
}

#[test]
fn the_ground_reaction_of_a_fixed_base_cannot_be_declared_absent() {
    let fixed = |presence| {
        move |config: &mut Config| {
            config.base = proprio_estimator::config::Base::Fixed {
                link: "chest".into(),
                gravity_mps2: [0.0, 0.0, -9.80665],
            };
            config
                .contact
                .iter_mut()
                .filter(|c| c.name() == "stand")
                .for_each(|c| c.presence = presence);
        }
    };
    use proprio_estimator::config::Occurrence::{Always, Possible};
    let mut torques = vec![];
    for presence in [Always, Possible] {
        let setup = setup(fixed(presence));
        let stand = setup.robot.contact("stand").unwrap();
        let events = recording(&setup, 0.2);
        let (want, _) = run(setup.clone(), &events);
        let mut pipeline = Pipeline::new(setup);
        pipeline.declare(stand, Nanos::ZERO, &ContactState::configured(false));
        let mut got = vec![];
        for (channel, t, reading, quality) in &events {
            pipeline.push(*channel, *t, reading, *quality);
            while let Some(estimate) = pipeline.poll() {
                got.push(estimate.clone());
            }
        }
        let roll = 1;
        let (want, got) = (
            want[150].torques.joints()[roll],
            got[150].torques.joints()[roll],
        );
        assert_eq!((want.valid, got.valid), (1, 1));
        torques.extend([want.torque, got.torque]);
    }
    assert!(
        torques.iter().all(|t| (t - torques[0]).abs() < 1e-9),
        "{torques:?}"
    );
}

#[test]
fn a_repeated_declaration_changes_nothing() {
    let setup = setup(|config| {
        for contact in config.contact.iter_mut().filter(|c| c.name() == "hand") {
            contact.presence = Occurrence::Possible;
        }
        config.output.max_wait_ms = Some(20.0);
    });
    let hand = setup.robot.contact("hand").unwrap();
    let events = recording(&setup, 0.3);
    let mut pipeline = Pipeline::new(setup);
    let mut next = Nanos::ZERO;
    for (channel, t, reading, quality) in &events {
        while next <= *t {
            pipeline.declare(hand, next, &ContactState::configured(true));
            next += Nanos::from_millis(1);
        }
        pipeline.push(*channel, *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            assert_ne!(
                estimate.contacts.contacts()[hand].reason,
                Reason::Absent,
                "at {}",
                estimate.t
            );
        }
    }
    // More changes than are kept: before the first that is kept, the last one of those dropped is
    // valid.
    let start = events.last().unwrap().1 + Nanos::from_millis(10);
    for i in 0..600 {
        let state = ContactState::configured(i % 2 == 1);
        pipeline.declare(hand, start + Nanos::from_millis(100 + i), &state);
    }
    let (mut present, mut all) = (0, 0);
    for (channel, t, reading, quality) in &events {
        pipeline.push(*channel, start + *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            if (start..start + Nanos::from_millis(100)).contains(&estimate.t) {
                let contact = &estimate.contacts.contacts()[hand];
                all += 1;
                present += usize::from(contact.reason != Reason::Absent && contact.detected == 0);
            }
        }
    }
    assert!(all > 50 && present == all, "{present} of {all}");
}

#[test]
fn a_possible_contact_is_absent_unless_declared() {
    let possible = |config: &mut Config| {
        for contact in config.contact.iter_mut().filter(|c| c.name() == "hand") {
            contact.presence = Occurrence::Possible;
        }
    };
    let setup = setup(possible);
    let hand = setup.robot.contact("hand").unwrap();
    let events = recording(&setup, 0.3);
    let mut pipeline = Pipeline::new(setup);
    pipeline.declare(
        hand,
        Nanos::from_millis(200),
        &ContactState::configured(true),
    );
    for (channel, t, reading, quality) in &events {
        pipeline.push(*channel, *t, reading, *quality);
        while let Some(estimate) = pipeline.poll() {
            let contact = estimate.contacts.contacts()[hand];
            if estimate.t < Nanos::from_millis(50) {
                continue;
            }
            if estimate.t < Nanos::from_millis(200) {
                assert_eq!(
                    (contact.valid, contact.reason),
                    (0, Reason::Absent.in_memory())
                );
                let numbers = contact.force.into_iter().chain(contact.torque);
                let mut numbers = numbers.chain(contact.standard_deviation);
                assert!(numbers.all(f64::is_nan), "{contact:?}");
            } else {
                assert_eq!(
                    (contact.valid, contact.reason),
                    (1, Reason::None.in_memory())
                );
                assert!(contact.force.iter().any(|f| *f != 0.0));
            }
        }
    }
}

#[test]
fn each_mistake_between_configuration_and_model_has_one_clear_message() {
    let load = || Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    let problem = |change: &dyn Fn(&mut Config)| {
        let mut config = load();
        change(&mut config);
        Setup::new(&config).map(|s| s.to_string()).unwrap_err()
    };
    for (change, expected) in [
        (
            &|c: &mut Config| c.contact[1].link = "l_hnad".into(),
            "contact \"hand\": link: \"l_hnad\" is not a link of the URDF; did you mean \
             \"l_hand\"?",
        ),
        (
            &|c: &mut Config| c.force_torque[0].joint = "l_arm_ft".into(),
            "joint l_arm_ft, named as the joint of an F/T sensor, is not in the URDF; any of its \
             joints could carry one, fixed or moving (it is then on the child's side): \
             l_arm_ft_sensor",
        ),
        (
            &|c: &mut Config| {
                c.force_torque[0].joint = "l_elbow".into();
                c.force_torque[0].frame = Some(MeasurementFrame::Parent);
            },
            "the F/T sensor in joint l_elbow cannot measure in the parent's frame, because the \
             joint moves",
        ),
        (
            &|c: &mut Config| {
                c.locked.insert("l_elbw".into(), 0.5);
            },
            "locked.l_elbw: \"l_elbw\" is not a joint of the URDF; did you mean \"l_elbow\"?",
        ),
        (
            &|c: &mut Config| c.output.trigger = Some("nobody".into()),
            "output.trigger = \"nobody\" is not a channel of this configuration",
        ),
        (
            &|c: &mut Config| c.contact[1].name = Some("stand".into()),
            "two contacts have this name",
        ),
        (
            &|c: &mut Config| c.model = "nowhere.urdf".into(),
            "nowhere.urdf",
        ),
    ] as [(&dyn Fn(&mut Config), &str); 7]
    {
        let problem = problem(change);
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
    // A joint that is neither measured nor locked.
    let log = golden("icub_left_arm_mujoco.csv").replace("joint/l_elbow/", "joint/l_elbo/");
    let error = offline::estimate(setup(|_| {}), log.as_bytes(), Vec::new(), None)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("joint/l_elbow; did you mean \"joint/l_elbo\"?; use a log of"),
        "{error}"
    );
}

#[test]
fn a_table_whose_clock_was_set_back_is_told_with_its_place() {
    let log = golden("icub_left_arm_mujoco.csv");
    let lines: Vec<&str> = log.lines().collect();
    let t = |line: usize| {
        let cell = lines[line].split(',').next().unwrap();
        Nanos::parse_seconds(cell).unwrap()
    };
    let set_back = [&lines[..100], &lines[20..40]].concat().join("\n");
    let report = offline::estimate(setup(|_| {}), set_back.as_bytes(), Vec::new(), None).unwrap();
    assert_eq!(report.step_back, Some((101, t(99), t(20))));
    assert_eq!(report.first_dropped, Some(101));
}

/// A robot whose IMU reads its weight does not fly because nobody has named what carries it.
#[test]
fn what_carries_an_imu_need_not_be_named() {
    let possible = |config: &mut Config| possible_hand_contact(config);
    let named = estimates_with_added(possible, "icub_left_arm_mujoco.csv", |_| [0.0; 6]);
    let unnamed = |config: &mut Config| {
        possible_hand_contact(config);
        config.contact.retain(|c| c.name() != "stand");
    };
    let others = estimates_with_added(unnamed, "icub_left_arm_mujoco.csv", |_| [0.0; 6]);
    let torques: Vec<&String> = named
        .keys()
        .filter(|name| name.contains("torque"))
        .collect();
    assert_eq!(torques.len(), 14);
    assert!(
        torques
            .iter()
            .all(|name| named[*name] == others[*name] && !named[*name][9].is_empty())
    );
    // It is told; and on the part of the robot beyond the sensor a contact carries nothing.
    let warns = |setup: &Setup| setup.warnings().iter().any(|w| w.contains("does not fly"));
    assert!(warns(&setup(unnamed)));
    assert!(!warns(&setup(possible)));
    // What may fly says so.
    assert!(!warns(&setup(|config| {
        config.contact[0].presence = Occurrence::Possible;
    })));
}

/// A robot that stands on its chest, then on its hand, then on nothing: the base follows the
/// declarations, and the torques equal the true ones.
#[test]
fn the_base_is_the_link_that_stands() {
    use proprio_dynamics::spatial::Vec3;
    use proprio_dynamics::{FrameMotion, InverseDynamics, JointState as State, Kinematics};
    use proprio_estimator::config::{Base, Foot, Occurrence};

    const GRAVITY: [[f64; 3]; 2] = [[0.0, 0.0, -9.80665], [3.0, 0.0, -9.3]];
    let on = |config: &mut Config| {
        let foot = |link: &str, contact: &str, gravity_mps2| Foot {
            link: link.into(),
            contact: contact.into(),
            gravity_mps2,
        };
        config.base = Base::Stance {
            foot: vec![
                foot("chest", "stand", GRAVITY[0]),
                foot("l_hand", "hand", GRAVITY[1]),
            ],
        };
        for contact in &mut config.contact {
            contact.presence = Occurrence::Possible;
        }
    };
    let setup = setup(on);
    let (stand, hand) = (
        setup.robot.contact("stand").unwrap(),
        setup.robot.contact("hand").unwrap(),
    );
    let dofs = setup.robot.model.dof_count();
    let mut pipeline = Pipeline::new(setup.clone());
    let ms = Nanos::from_millis;
    for (contact, t, active) in [
        (stand, 0, true),
        (stand, 40, false),
        (hand, 30, true),
        (hand, 70, false),
    ] {
        pipeline.declare(contact, ms(t), &ContactState::configured(active));
    }
    for step in 0..100 {
        let t = ms(step);
        let value = |dof: usize, factor: f64| (0.05 * step as f64 * factor + dof as f64).sin();
        let states = [1.0, 2.0, 5.0].map(|factor| {
            (0..dofs)
                .map(|dof| value(dof, factor))
                .collect::<Vec<f64>>()
        });
        // While both are declared, the foot listed first is the base.
        let foot = usize::from(step >= 40);
        let base = [
            setup.robot.base_link,
            setup.robot.model.frame("l_hand").unwrap().link,
        ][foot];
        let mut truth = Kinematics::new(&setup.robot.model, base).unwrap();
        let state = State {
            position: &states[0],
            velocity: &states[1],
            acceleration: &states[2],
        };
        let standing = FrameMotion::standing(&Vec3::from(GRAVITY[foot]));
        truth.update(&setup.robot.model, state, &standing).unwrap();
        let mut dynamics = InverseDynamics::new(&setup.robot.model);
        dynamics.update(&setup.robot.model, &truth, &[]).unwrap();
        let sensor = setup.robot.structure.sensors()[0];
        let [fx, fy, fz, tx, ty, tz] = sensor
            .reading(&dynamics.transmitted(&truth, sensor.joint()))
            .force_first();
        for (number, channel) in setup.robot.channels.iter().enumerate() {
            let reading = match channel.role {
                proprio_identification::robot::ChannelRole::Joint(dof) => {
                    Reading::Joint(JointState {
                        position: states[0][dof],
                        velocity: states[1][dof],
                        acceleration: states[2][dof],
                        ..JointState::ABSENT
                    })
                }
                _ => Reading::Wrench(Wrench {
                    force: [fx, fy, fz],
                    torque: [tx, ty, tz],
                }),
            };
            pipeline.push(number, t, &reading, Quality::GOOD);
        }
        let estimate = pipeline.poll().expect("every channel has this instant");
        for (joint, want) in estimate.torques.joints().iter().zip(dynamics.torque()) {
            // Both are declared from 30 to 40 ms: one contact in each half of the robot. Gravity is
            // another one at once then, and the first reading of it is not believed.
            if step == 40 && joint.valid == 0 {
                assert_eq!(joint.reason, Reason::Implausible);
            } else if step < 70 {
                assert_eq!(
                    (joint.valid, joint.reason),
                    (1, Reason::None.in_memory()),
                    "at {step} ms"
                );
                assert!(
                    (joint.torque - want).abs() < 1e-10,
                    "at {step} ms: {} {want}",
                    joint.torque
                );
            } else {
                // The motion of the base is unknown, and so is the ground reaction.
                assert_eq!(
                    (joint.valid, joint.reason),
                    (0, Reason::NoStance.in_memory()),
                    "at {step} ms"
                );
            }
        }
    }
}

#[test]
fn a_foot_needs_a_contact_that_can_carry() {
    use proprio_estimator::config::{Base, ContactModel, Foot};
    let foot = |link: &str, contact: &str| Foot {
        link: link.into(),
        contact: contact.into(),
        gravity_mps2: [0.0, 0.0, -9.8],
    };
    let problem = |kind, foot| {
        let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
        config.contact[0].kind = kind;
        config.base = Base::Stance { foot };
        Setup::new(&config).map(|s| s.to_string()).unwrap_err()
    };
    for (second, expected) in [
        (
            foot("l_hand", "hand"),
            "contact \"stand\" is always present, so no later foot could become the base",
        ),
        (
            foot("chest", "stand"),
            "contact \"stand\" is always present",
        ),
    ] {
        let problem = problem(ContactModel::Wrench, vec![foot("chest", "stand"), second]);
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
    for (link, contact, kind, expected) in [
        (
            "chst",
            "stand",
            ContactModel::Wrench,
            "base.foot \"chst\": link: \"chst\" is not a link of the URDF; did you mean \"chest\"?",
        ),
        (
            "chest",
            "stnd",
            ContactModel::Wrench,
            "contact = \"stnd\" is not a contact; did you mean \"stand\"?",
        ),
        (
            "chest",
            "hand",
            ContactModel::Wrench,
            "must be on the same link and of kind \"wrench\"",
        ),
        (
            "chest",
            "stand",
            ContactModel::Force,
            "must be on the same link and of kind \"wrench\"",
        ),
    ] {
        let problem = problem(kind, vec![foot(link, contact)]);
        assert!(problem.contains(expected), "{expected}: {problem}");
    }
}

#[test]
fn the_plan_states_how_many_parameters_each_sensor_can_identify() {
    use proprio_estimator::config::{Base, Occurrence};
    let possible = |config: &mut Config| {
        for contact in &mut config.contact {
            contact.presence = Occurrence::Possible;
        }
    };
    // Four links and three revolute joints above the sensor, five and four beyond it; each joint
    // hides three directions.
    let text = setup(possible).to_string();
    for expected in [
        "31 independent combinations of its 40 inertial parameters can be identified",
        "38 independent combinations of its 50 inertial parameters can be identified",
    ] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
    // The unknown wrench of an always present contact absorbs the effect of all parameters.
    let text = setup(|_| {}).to_string();
    for contact in ["stand", "hand"] {
        let expected =
            format!("none of its inertial parameters can be identified while {contact} is present");
        assert!(text.contains(&expected), "{expected}:\n{text}");
    }
    // So does the ground reaction of a fixed base; and a locked joint joins two bodies.
    let less = setup(|config| {
        possible(config);
        config.base = Base::Fixed {
            link: "chest".into(),
            gravity_mps2: [0.0, 0.0, -9.80665],
        };
        config.locked.insert("l_wrist_yaw".into(), 0.3);
    });
    let text = less.to_string();
    for expected in [
        "none of its inertial parameters can be identified while the support of the base is \
         present",
        "31 independent combinations of its 50 inertial parameters can be identified",
    ] {
        assert!(text.contains(expected), "{expected}:\n{text}");
    }
}

#[test]
fn a_torque_that_is_too_uncertain_is_withheld() {
    let estimate = |bound| {
        let setup = setup(|config| config.output.max_torque_std_nm = Some(bound));
        let events = recording(&setup, 0.2);
        run(setup, &events).0.pop().unwrap()
    };
    let wide = estimate(1.0);
    let deviations: Vec<f64> = wide
        .torques
        .joints()
        .iter()
        .map(|j| j.standard_deviation)
        .collect();
    assert!(
        wide.torques.joints().iter().all(|j| j.valid == 1),
        "{deviations:?}"
    );
    // A bound between the smallest and the largest: some are withheld, and how uncertain they are
    // is told.
    let greatest = deviations.iter().copied().fold(0.0, f64::max);
    let narrow = estimate(0.9 * greatest);
    assert!(narrow.torques.joints().iter().any(|j| j.valid == 1));
    for (joint, other) in narrow.torques.joints().iter().zip(wide.torques.joints()) {
        let (reason, torque) = if other.standard_deviation > 0.9 * greatest {
            (Reason::Uncertain, f64::NAN)
        } else {
            (Reason::None, other.torque)
        };
        assert_eq!(
            (
                joint.reason,
                joint.torque.to_bits(),
                joint.standard_deviation
            ),
            (
                reason.in_memory(),
                torque.to_bits(),
                other.standard_deviation
            )
        );
    }
}
