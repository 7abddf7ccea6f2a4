//! The tolerance, and input that is refused.

use super::known::{hand_made, left_arm};
use super::*;

/// A right angle written as 1.5708 is not exact: an axis meant to be vertical has a gravity torque
/// of four parts in a million. A larger tolerance treats it as vertical.
#[test]
#[allow(clippy::approx_constant, reason = "rounded on purpose, as URDFs are")]
fn tolerance_forgives_rounded_angles() {
    let rank = |angle: f64, tolerance| {
        let text = format!(
            "<robot name=\"pair\"><link name=\"base\"/><link name=\"turned\"><inertial>\
             <mass value=\"1\"/><inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" \
             izz=\"1\"/></inertial></link><joint name=\"j\" type=\"continuous\">\
             <parent link=\"base\"/><child link=\"turned\"/><axis xyz=\"0 1 0\"/>\
             <origin xyz=\"0.1 0 0.2\" rpy=\"{angle} 0 0\"/></joint></robot>"
        );
        let model = Model::from_urdf(&text, &[]).unwrap();
        let stand = Regime {
            tolerance,
            ..Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY))
        };
        Identifiable::new(
            &model,
            Scope::Tree,
            &stand,
            Measurement::Torques,
            Offsets::Known,
        )
        .unwrap()
        .rank()
    };
    assert_eq!(rank(std::f64::consts::FRAC_PI_2, Regime::TOLERANCE), 1);
    assert_eq!(rank(1.570796327, Regime::TOLERANCE), 1);
    assert_eq!(rank(1.5708, Regime::TOLERANCE), 3);
    assert_eq!(rank(1.5708, 1e-4), 1);
}

#[test]
fn bad_input_is_refused() {
    let (model, structure) = left_arm();
    let new = |scope, regime: &Regime| {
        Identifiable::new(&model, scope, regime, Measurement::Both, Offsets::Unknown)
            .map(|answer| answer.rank())
    };
    let free = Regime::free(&model);
    assert!(new(Scope::Tree, &free).is_ok());
    assert_eq!(
        new(
            Scope::Tree,
            &Regime {
                base: 9,
                ..free.clone()
            }
        ),
        Err(DynamicsError::NoLink(9))
    );
    assert_eq!(
        new(Scope::SubTree(&structure, 2), &free),
        Err(DynamicsError::Index {
            what: "sub-trees",
            index: 2,
            count: 2
        })
    );
    let short = Regime {
        joints: vec![JointMotion::Moving; 3],
        ..free.clone()
    };
    assert!(matches!(
        new(Scope::Tree, &short),
        Err(DynamicsError::Size {
            got: 3,
            expected: 7,
            ..
        })
    ));
    let other = hand_made(0.1);
    let other = Structure::new(&other, &[], &[], Structure::LENGTH_SCALE).unwrap();
    assert!(matches!(
        new(Scope::SubTrees(&other), &free),
        Err(DynamicsError::Size {
            got: 4,
            expected: 9,
            ..
        })
    ));
    for bad in [f64::NAN, f64::INFINITY, 1e200] {
        let gravity = Vec3::new(0.0, bad, 0.0);
        let (what, index) = ("gravity of regime", 0);
        assert_eq!(
            new(Scope::Tree, &Regime::fixed(&model, 0, &gravity)),
            Err(if bad.is_finite() {
                DynamicsError::OutOfRange { what, index }
            } else {
                DynamicsError::NotFinite { what, index }
            })
        );
    }
    for bad in [f64::NAN, f64::INFINITY] {
        assert!(matches!(
            new(
                Scope::Tree,
                &Regime {
                    tolerance: bad,
                    ..free.clone()
                }
            ),
            Err(DynamicsError::NotFinite { .. })
        ));
        let mut joints = free.joints.clone();
        joints[2] = JointMotion::Locked(bad);
        assert!(matches!(
            new(
                Scope::Tree,
                &Regime {
                    joints,
                    ..free.clone()
                }
            ),
            Err(DynamicsError::NotFinite { .. })
        ));
    }
    assert_eq!(
        new(
            Scope::Tree,
            &Regime {
                tolerance: -1.0,
                ..free.clone()
            }
        ),
        new(Scope::Tree, &free)
    );
    // No gravity, no freedom, no motion: only the offset is identifiable.
    let still = Regime {
        joints: vec![JointMotion::Locked(0.3); 7],
        ..Regime::fixed(&model, 0, &Vec3::zeros())
    };
    assert_eq!(new(Scope::SubTrees(&structure), &still), Ok(6));
}

/// Finite numbers that are too large, and large ones that are valid: never a panic, never a basis
/// that is not finite.
#[test]
fn absurd_numbers_are_refused_or_harmless() {
    // An angle of any size is valid.
    let model = hand_made(0.25);
    let ask = |model: &Model, regime: &Regime| {
        let answer = Identifiable::new(
            model,
            Scope::Tree,
            regime,
            Measurement::Both,
            Offsets::Known,
        )?;
        let (basis, null) = (answer.basis(), answer.null());
        assert!(basis.iter().chain(&null).all(|x| x.is_finite()));
        Ok(basis * basis.transpose())
    };
    for mut regime in [
        Regime::free(&model),
        Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, -GRAVITY)),
    ] {
        for angle in [1e10_f64, 1e150, -1e300] {
            let reduced = f64::atan2(angle.sin(), angle.cos());
            let [far, near] = [angle, reduced].map(|angle: f64| {
                regime.joints[1] = JointMotion::Locked(angle);
                ask(&model, &regime).unwrap()
            });
            assert!((far - near).amax() < 1e-12);
        }
    }
    // A distance of that size is not.
    let far = hand_made(1e150);
    assert!(matches!(
        ask(&far, &Regime::free(&far)),
        Err(DynamicsError::OutOfRange { index: 2, .. })
    ));
    // Distances that are rounding errors, and negligible gravity, do not set units.
    let ranks = [(1e-200, 1e-300), (0.0, 0.0)].map(|(length, gravity)| {
        let model = hand_made(length);
        let regime = Regime::fixed(&model, 0, &Vec3::new(0.0, 0.0, gravity));
        ask(&model, &regime).unwrap().trace().round()
    });
    assert_eq!(ranks[0], ranks[1]);
    // In a model the error has the joint's link, wherever the pass begins.
    let mut regime = Regime::free(&model);
    regime.base = 2;
    regime.joints[2] = JointMotion::Locked(1e150);
    assert_eq!(
        Identifiable::new(
            &model,
            Scope::Tree,
            &regime,
            Measurement::Wrench,
            Offsets::Known
        )
        .map(|_| ()),
        Err(DynamicsError::OutOfRange {
            what: "joint to link",
            index: 3
        })
    );
    for tolerance in [0.0, -1.0, 1e300] {
        let regime = Regime {
            tolerance,
            ..Regime::free(&model)
        };
        let answer = Identifiable::new(
            &model,
            Scope::Tree,
            &regime,
            Measurement::Wrench,
            Offsets::Known,
        )
        .unwrap();
        assert!(answer.basis().iter().all(|x| x.is_finite()));
    }
}

/// Contacts without a closed form are errors.
#[test]
fn contacts_without_closed_form_are_refused() {
    let (model, plain) = left_arm();
    let (top, hand) = (plain.subtrees()[1].top, model.link_count() - 1);
    let contact = |link, kind| ContactSpec {
        frame: Frame {
            link,
            pose: Pose::identity(),
        },
        kind,
        position: Vec3::new(0.02, 0.0, 0.01),
    };
    let contacts = [
        contact(hand, ContactKind::Force),
        contact(hand, ContactKind::Wrench),
        contact(top, ContactKind::Force),
        contact(0, ContactKind::Force),
    ];
    let structure =
        Structure::new(&model, plain.sensors(), &contacts, Structure::LENGTH_SCALE).unwrap();
    let rank = |scope, contacts: &[usize], measured| {
        let regime = Regime {
            contacts: contacts.iter().copied().collect(),
            ..Regime::free(&model)
        };
        Identifiable::new(&model, scope, &regime, measured, Offsets::Known)
            .map(|answer| answer.rank())
    };
    let arm = Scope::SubTree(&structure, 1);
    assert_eq!(rank(arm, &[], Measurement::Wrench), Ok(38));
    assert_eq!(
        rank(arm, &[0], Measurement::Wrench),
        Err(DynamicsError::Contact(0))
    );
    assert_eq!(rank(arm, &[1], Measurement::Wrench), Ok(0));
    assert_eq!(
        rank(arm, &[1], Measurement::Both),
        Err(DynamicsError::Contact(1))
    );
    assert_eq!(
        rank(arm, &[1], Measurement::Torques),
        Err(DynamicsError::Contact(1))
    );
    // On another sub-tree it removes nothing; all together lose the combinations that only the
    // chest's rows determine.
    assert_eq!(rank(arm, &[3], Measurement::Wrench), Ok(38));
    assert_eq!(
        rank(Scope::SubTrees(&structure), &[1], Measurement::Wrench),
        Ok(69 - 38)
    );
    // Three equations are left. With the arm moving freely they determine everything except masses
    // and centre-of-mass offsets that a force hides.
    let left = rank(arm, &[2], Measurement::Wrench).unwrap();
    assert!(0 < left && left < 38, "{left}");
    let error = |index, count| {
        Err(DynamicsError::Index {
            what: "contacts",
            index,
            count,
        })
    };
    assert_eq!(rank(arm, &[4], Measurement::Wrench), error(4, 4));
    assert_eq!(rank(Scope::Tree, &[0], Measurement::Wrench), error(0, 0));
}
