//! Particular robots, sensors and contacts.

use super::*;

/// Two sensors around two joints, no contact: the fused torque is the mean of the two one-sided
/// ones weighted by covariance. Its deviation is below either, and with one joint axis and white
/// noise it is always between them.
#[test]
fn both_sides_are_fused_by_covariance() {
    let model = leg();
    let sensors = [
        child_sensor(&model, "hip_ft", 0.2, 0.004),
        child_sensor(&model, "foot_ft", 0.1, 0.002),
    ];
    let at = |link: &str| ContactSpec {
        frame: model.frame(link).unwrap(),
        kind: ContactKind::Wrench,
        position: Vec3::zeros(),
    };
    // Optional contacts: one on the thigh side of every joint of the leg, one on the foot side.
    let mut random = Random::new(5);
    let mut scene = Scene::with(
        model.clone(),
        sensors.to_vec(),
        vec![at("link1"), at("link3")],
        vec![Wrench::zero(); 2],
        &mut random,
    );
    scene.disturb(&mut random);
    let structure = scene.structure();
    let solve = |active: &[usize]| scene.solve(&structure, &active.iter().copied().collect());
    let (fused, by_foot, by_hip) = (solve(&[]), solve(&[0]), solve(&[1]));
    for joint in ["knee", "ankle"] {
        let dof = model.dof(joint).unwrap();
        assert_eq!(structure.route(dof, &ContactSet::EMPTY), Some(Route::Fused));
        assert_eq!(
            structure.route(dof, &[0].into_iter().collect()),
            Some(Route::Child),
            "contact on the thigh: from the foot"
        );
        assert_eq!(
            structure.route(dof, &[1].into_iter().collect()),
            Some(Route::Parent),
            "contact on the foot: from the hip"
        );
        let deviation = |solver: &Solver| solver.torque_deviation()[dof];
        assert!(deviation(&fused) < deviation(&by_foot) && deviation(&fused) < deviation(&by_hip));
        assert_ne!(
            by_foot.torque()[dof],
            by_hip.torque()[dof],
            "the readings were disturbed"
        );
    }
    // With torque noise only, the fusion is the textbook mean of two numbers of known variance.
    let quiet = [
        child_sensor(&model, "hip_ft", 1e-7, 0.004),
        child_sensor(&model, "foot_ft", 1e-7, 0.002),
    ];
    scene.sensors = quiet.to_vec();
    // Readings that differ by torque only.
    scene.state.0[1].fill(0.0);
    scene.state.0[2].fill(0.0);
    let kinematics = scene.kinematics();
    let exact = inverse(&scene.model, &kinematics, &[]);
    let base = ExternalWrench {
        frame: Frame {
            link: scene.base,
            pose: Pose::identity(),
        },
        wrench: exact.base_wrench(),
    };
    scene.known = vec![base];
    let closed = inverse(&scene.model, &kinematics, &scene.known);
    scene.readings = quiet
        .iter()
        .map(|cut| cut.reading(&closed.transmitted(&kinematics, cut.joint())))
        .collect();
    scene.readings[0].torque += Vec3::new(0.3, -0.2, 0.1);
    let structure = scene.structure();
    let solve = |active: &[usize]| scene.solve(&structure, &active.iter().copied().collect());
    let (fused, by_foot, by_hip) = (solve(&[]), solve(&[0]), solve(&[1]));
    for joint in ["knee", "ankle"] {
        let dof = model.dof(joint).unwrap();
        let expected = (by_foot.torque()[dof] / 0.002_f64.powi(2)
            + by_hip.torque()[dof] / 0.004_f64.powi(2))
            / (0.002_f64.powi(-2) + 0.004_f64.powi(-2));
        assert!(
            (fused.torque()[dof] - expected).abs() < 1e-6,
            "{} {expected}",
            fused.torque()[dof]
        );
        assert!((by_foot.torque()[dof] - by_hip.torque()[dof]).abs() > 1e-3);
    }
}

/// A free leaf beyond the last sensor: its torque comes from the model alone, and the sensor only
/// tests it (chi-square).
#[test]
fn a_free_end_needs_no_sensor_but_is_judged_by_it() {
    let model = leg();
    let sensors = vec![
        child_sensor(&model, "hip_ft", 0.2, 0.004),
        child_sensor(&model, "foot_ft", 0.1, 0.002),
    ];
    let mut random = Random::new(6);
    let mut scene = Scene::with(model, sensors, vec![], vec![], &mut random);
    // Without the random external wrench of a scene: only the base is held.
    let kinematics = scene.kinematics();
    let exact = inverse(&scene.model, &kinematics, &[]);
    scene.known = vec![ExternalWrench {
        frame: Frame {
            link: scene.base,
            pose: Pose::identity(),
        },
        wrench: exact.base_wrench(),
    }];
    let exact = inverse(&scene.model, &kinematics, &scene.known);
    scene.readings = scene
        .sensors
        .iter()
        .map(|cut| cut.reading(&exact.transmitted(&kinematics, cut.joint())))
        .collect();
    let structure = scene.structure();
    let toe = scene.model.dof("toe").unwrap();
    let dependence = structure
        .torque_dependence(toe, &kinematics, &ContactSet::EMPTY)
        .unwrap();
    assert!(dependence.sensors.is_empty() && dependence.base && dependence.dofs.contains(toe));
    let quiet = scene.solve(&structure, &ContactSet::EMPTY);
    assert_eq!(quiet.torque_deviation()[toe], 0.0);
    assert!(
        quiet
            .balances()
            .iter()
            .all(|balance| balance.chi_square.is_none_or(|value| value < 1e-9))
    );
    // An undeclared force on the toe: the torque does not change, but the balance of that sub-tree
    // does.
    scene.readings[1].force.z += 5.0;
    let touched = scene.solve(&structure, &ContactSet::EMPTY);
    assert_eq!(touched.torque()[toe], quiet.torque()[toe]);
    let beyond = structure
        .subtree_of(scene.model.frame("link5").unwrap().link)
        .unwrap();
    let chi_square = touched.balances()[beyond].chi_square.unwrap();
    assert!(
        (chi_square - (5.0_f64 / 0.1).powi(2)).abs() < 1e-6 * chi_square,
        "{chi_square}"
    );
    assert_eq!(touched.balances()[beyond].degrees, 6);
}

/// Two full wrenches, twelve unknowns: the pair of least norm that balances, with forces compared
/// to torques by the length scale; not a basic solution.
#[test]
fn two_full_wrenches_share_by_least_norm() {
    let model = chain(&[
        ("ft", "fixed"),
        ("elbow", "continuous"),
        ("wrist", "continuous"),
    ]);
    let sensors = vec![child_sensor(&model, "ft", 0.1, 0.002)];
    let at = |link: &str| ContactSpec {
        frame: model.frame(link).unwrap(),
        kind: ContactKind::Wrench,
        position: Vec3::new(0.0, 0.0, 0.1),
    };
    let mut random = Random::new(7);
    let truth = vec![
        Wrench {
            torque: Vec3::zeros(),
            force: Vec3::new(10.0, 0.0, 0.0),
        },
        Wrench::zero(),
    ];
    let mut scene = Scene::with(
        model.clone(),
        sensors,
        vec![at("link2"), at("link3")],
        truth,
        &mut random,
    );
    scene.disturb(&mut random);
    let wrenches = |solver: &Solver| -> Vec<Wrench> {
        solver
            .contacts()
            .iter()
            .map(|contact| contact.wrench)
            .collect()
    };
    let cost = |wrenches: &[Wrench], length: f64| -> f64 {
        let about = |wrench: &Wrench| wrench.about(&Vec3::new(0.0, 0.0, 0.1));
        wrenches
            .iter()
            .map(|w| w.force.norm_squared() + about(w).torque.norm_squared() / length.powi(2))
            .sum()
    };
    for length in [0.02, 0.1, 1.0] {
        let structure =
            Structure::new(&scene.model, &scene.sensors, &scene.contacts, length).unwrap();
        let both = scene.solve(&structure, &scene.all());
        assert!(
            both.contacts()
                .iter()
                .all(|contact| contact.certainty == Determinacy::Assumed)
        );
        assert_eq!(
            both.torque_certainty()[model.dof("wrist").unwrap()],
            Determinacy::Assumed
        );
        assert_eq!(
            both.torque_certainty()[model.dof("elbow").unwrap()],
            Determinacy::Determined,
            "both contacts are beyond it"
        );
        let both = wrenches(&both);
        for single in 0..2 {
            let one = wrenches(&scene.solve(&structure, &[single].into_iter().collect()));
            assert!(
                cost(&both, length) < cost(&one, length),
                "any other pair that balances is longer"
            );
            // Mixtures of the two balance too: at the minimum, the derivative of the cost towards
            // them is zero.
            let mix = |t: f64| {
                let mixed: Vec<_> = both
                    .iter()
                    .zip(&one)
                    .map(|(a, b)| *a * (1.0 - t) + *b * t)
                    .collect();
                cost(&mixed, length)
            };
            let slope = (mix(1e-3) - mix(-1e-3)) / 2e-3;
            assert!(slope.abs() < 1e-9 * cost(&both, length), "{slope}");
        }
    }
}

/// Sets of contacts that contradict or repeat each other, or sub-trees without sensors: a solution
/// with its certainty, never NaN (`solve` of a scene checks every number).
#[test]
fn odd_sets_of_contacts_get_an_answer() {
    let model = chain(&[
        ("ft", "fixed"),
        ("elbow", "continuous"),
        ("wrist", "prismatic"),
    ]);
    let frame = model.frame("link3").unwrap();
    let at = |kind, x: f64| ContactSpec {
        frame,
        kind,
        position: Vec3::new(x, 0.0, 0.0),
    };
    let along = |x: f64| at(ContactKind::ForceAlong(Vec3::x()), x);
    let sets: Vec<(&str, Vec<ContactSpec>, usize, Determinacy)> = vec![
        (
            "the same wrench twice",
            vec![at(ContactKind::Wrench, 0.0); 2],
            0,
            Determinacy::Assumed,
        ),
        (
            "a force and a wrench at one place",
            vec![at(ContactKind::Wrench, 0.0), at(ContactKind::Force, 0.0)],
            0,
            Determinacy::Assumed,
        ),
        (
            "two forces: what they do to each other along their line is not seen",
            vec![at(ContactKind::Force, 0.0), at(ContactKind::Force, 0.2)],
            1,
            Determinacy::Assumed,
        ),
        (
            "the same direction along one line",
            vec![along(0.0), along(0.3)],
            5,
            Determinacy::Assumed,
        ),
        (
            "one force",
            vec![at(ContactKind::Force, 0.1)],
            3,
            Determinacy::Determined,
        ),
        (
            "one direction",
            vec![along(0.0)],
            5,
            Determinacy::Determined,
        ),
    ];
    for sensors in [vec![], vec![child_sensor(&model, "ft", 0.1, 0.002)]] {
        for (name, contacts, degrees, certainty) in &sets {
            let mut random = Random::new(8);
            let truth = vec![Wrench::zero(); contacts.len()];
            let mut scene = Scene::with(
                model.clone(),
                sensors.clone(),
                contacts.clone(),
                truth,
                &mut random,
            );
            scene.disturb(&mut random);
            let structure = scene.structure();
            let solver = scene.solve(&structure, &scene.all());
            let number = structure.subtree_of(frame.link).unwrap();
            assert_eq!(solver.balances()[number].degrees, *degrees, "{name}");
            if !sensors.is_empty() || *degrees == 0 {
                assert!(
                    solver
                        .contacts()
                        .iter()
                        .all(|contact| contact.certainty == *certainty),
                    "{name}"
                );
            } else {
                // Nothing measures the wrench that holds the rest: even a force that six equations
                // would determine is a choice.
                assert!(
                    solver
                        .contacts()
                        .iter()
                        .all(|contact| contact.certainty == Determinacy::Assumed),
                    "{name}"
                );
            }
            let none = scene.solve(&structure, &ContactSet::EMPTY);
            assert!(
                none.contacts()
                    .iter()
                    .all(|contact| contact.certainty == Determinacy::Absent
                        && contact.wrench == Wrench::zero())
            );
            if sensors.is_empty() {
                assert!(
                    none.torque_certainty()
                        .iter()
                        .all(|&certainty| certainty == Determinacy::Assumed)
                );
            }
        }
    }
}

/// Fused is the mean of the two sides' wrenches, weighted by inverse covariance, along the axis:
/// all six rows of the balance. So it is never worse than the mean of the two torques weighted by
/// inverse variance, and usually better.
#[test]
fn fused_is_the_mean_of_wrenches_weighted_by_inverse_covariance() {
    use nalgebra::{Matrix6, Vector6};
    let (mut fused, mut ratio) = (0, 0.0);
    for seed in 0..150 {
        let mut scene = Scene::new(25 + seed as usize % 16, seed, 1);
        scene.disturb(&mut Random::new(seed ^ 10));
        let structure = scene.structure();
        let active = ContactSet::EMPTY;
        let solver = scene.solve(&structure, &active);
        let scale = scene.size();
        for dof in 0..scene.model.dof_count() {
            if structure.route(dof, &active) != Some(Route::Fused) {
                continue;
            }
            let sides = [true, false].map(|below| scene.side(&structure, dof, below, &active));
            // About the joint, where the two covariances are best compared.
            let point = scene
                .kinematics()
                .pose(scene.model.dof_joint(dof).unwrap() + 1)
                .translation;
            let stack = |wrench: &Wrench| {
                let Wrench { torque, force } = wrench.about(&point);
                Vector6::new(torque.x, torque.y, torque.z, force.x, force.y, force.z)
            };
            let covariances = [0, 1].map(|i: usize| {
                let columns = sides[i].noise.iter().map(&stack);
                columns.fold(Matrix6::zeros(), |sum: Matrix6<f64>, column| {
                    sum + column * column.transpose()
                })
            });
            let weights = covariances.map(|covariance| {
                covariance
                    .cholesky()
                    .expect("noise in all directions")
                    .inverse()
            });
            let together = (weights[0] + weights[1]).cholesky().unwrap();
            let mean = together.solve(
                &(weights[0] * stack(&sides[0].wrench) + weights[1] * stack(&sides[1].wrench)),
            );
            let axis = &sides[0].axis;
            let linear = axis.linear + axis.angular.cross(&point);
            let s = Vector6::from_iterator(axis.angular.iter().chain(linear.iter()).copied());
            let deviation = s.dot(&together.solve(&s)).sqrt();
            assert!(
                (solver.torque()[dof] - s.dot(&mean)).abs() < 1e-8 * scale,
                "{} {}",
                solver.torque()[dof],
                s.dot(&mean)
            );
            assert!((solver.torque_deviation()[dof] - deviation).abs() < 1e-6 * deviation);
            let two_numbers =
                (sides[0].deviation.powi(-2) + sides[1].deviation.powi(-2)).powf(-0.5);
            assert!(deviation <= two_numbers * (1.0 + 1e-9));
            ratio += deviation / two_numbers;
            fused += 1;
        }
    }
    assert!(fused > 100, "{fused}");
    let ratio = ratio / f64::from(fused);
    println!("{fused} fused torques; deviation {ratio:.3} of that of the mean of two numbers");
    assert!(ratio < 0.95, "{ratio}");
}

/// Many draws of noise: the spread of the fused torque and of chi-square is the computed one.
#[test]
fn deviations_are_those_of_many_draws() {
    const DRAWS: usize = 4000;
    let model = leg();
    let sensors = vec![
        child_sensor(&model, "hip_ft", 0.2, 0.004),
        child_sensor(&model, "foot_ft", 0.1, 0.002),
    ];
    let mut random = Random::new(21);
    let mut scene = Scene::with(model, sensors, vec![], vec![], &mut random);
    let (structure, exact) = (scene.structure(), scene.readings.clone());
    let number = structure
        .subtree_of(scene.model.frame("link2").unwrap().link)
        .unwrap();
    // Irwin and Hall: twelve uniform numbers have a variance of one.
    let mut normal = || (0..12).map(|_| random.real(0.5)).sum::<f64>();
    let mut squares = [0.0; 2];
    let (mut chi_square, mut solver) = (0.0, None);
    for _ in 0..DRAWS {
        for ((reading, exact), cut) in scene.readings.iter_mut().zip(&exact).zip(&scene.sensors) {
            let noise = deviations_of(cut).map(|deviation| deviation * normal());
            *reading = *exact
                + Wrench::from_parts(
                    [noise[0], noise[1], noise[2]],
                    [noise[3], noise[4], noise[5]],
                );
        }
        let drawn = scene.solve(&structure, &ContactSet::EMPTY);
        chi_square += drawn.balances()[number].chi_square.unwrap() / DRAWS as f64;
        for (dof, sum) in squares.iter_mut().enumerate() {
            let error = drawn.torque()[dof] - scene.torque[dof];
            *sum += error * error / DRAWS as f64;
        }
        solver = Some(drawn);
    }
    let solver = solver.unwrap();
    // A mean square of 4000 draws is within 2.2 % of its expectation one time in two to three (1 /
    // sqrt(2000)), and within four times that almost always.
    let near =
        |mean_square: f64, deviation: f64| (mean_square / deviation.powi(2) - 1.0).abs() < 0.09;
    for (dof, square) in squares.iter().enumerate() {
        let deviation = solver.torque_deviation()[dof];
        assert!(
            near(*square, deviation),
            "dof {dof}: {} {deviation}",
            square.sqrt()
        );
    }
    assert_eq!(solver.balances()[number].degrees, 6);
    assert!(near(chi_square, 6.0_f64.sqrt()), "{chi_square}");
}

/// The part of the readings that a contact of one kind cannot explain appears in chi-square, in
/// units of the sensor's noise.
#[test]
fn contradictory_readings_show_in_chi_square() {
    let model = chain(&[("ft", "fixed"), ("elbow", "continuous")]);
    let sensors = vec![child_sensor(&model, "ft", 0.1, 0.002)];
    // The contacts are at the sensor's origin and along its axes; the elbow has no influence.
    let at = |kind| ContactSpec {
        frame: model.frame("link1").unwrap(),
        kind,
        position: Vec3::zeros(),
    };
    let kinds = [
        (ContactKind::ForceAlong(Vec3::x() * 3.0), 5),
        (ContactKind::Force, 3),
        (ContactKind::Wrench, 0),
    ];
    for (kind, degrees) in kinds {
        let truth = vec![Wrench {
            torque: Vec3::zeros(),
            force: Vec3::new(7.0, 0.0, 0.0),
        }];
        let mut scene = Scene::with(
            model.clone(),
            sensors.clone(),
            vec![at(kind)],
            truth,
            &mut Random::new(24),
        );
        let structure = scene.structure();
        let number = structure.subtree_of(1).unwrap();
        let balance = |scene: &Scene| {
            let solver = scene.solve(&structure, &scene.all());
            assert_eq!(solver.contacts()[0].certainty, Determinacy::Determined);
            // One unknown through the sensor's own point: its deviation is that of the sensor's
            // force.
            assert!((solver.contacts()[0].deviation[0] - 0.1).abs() < 1e-12);
            let force = solver.contacts()[0].wrench.force.x;
            (solver.balances()[number], force)
        };
        let (quiet, force) = balance(&scene);
        assert_eq!(quiet.degrees, degrees);
        assert!(quiet.chi_square.unwrap() < 1e-9 && (force - 7.0).abs() < 1e-9);
        // 0.5 N across, 0.03 Nm: five and fifteen deviations.
        scene.readings[0].force.y += 0.5;
        scene.readings[0].torque.z += 0.03;
        let (loud, force) = balance(&scene);
        let expected = match degrees {
            5 => 25.0 + 225.0,
            3 => 225.0,
            _ => 0.0,
        };
        let chi_square = loud.chi_square.unwrap();
        assert!(
            (chi_square - expected).abs() < 1e-6 * (1.0 + expected),
            "{kind:?}: {chi_square}"
        );
        assert!(
            (force - 7.0).abs() < 1e-9,
            "what the contact can explain is as before"
        );
        // The sensor reads the wrench by the child on the parent, so the need of the links minus
        // the reading grows by the added wrench; the rest stays unexplained.
        let unexplained = [f64::from(degrees == 5) * 0.5, f64::from(degrees > 0) * 0.03];
        let residual = loud.residual;
        assert!(
            (residual.force.y - unexplained[0]).abs() < 1e-9,
            "{residual:?}"
        );
        assert!(
            (residual.torque.z - unexplained[1]).abs() < 1e-9,
            "{residual:?}"
        );
    }
}

/// Two opposite forces along the line between them have an unobservable magnitude. The torque of a
/// joint between them is determined if its axis meets that line, and not determined otherwise. This
/// holds even if the directions of the forces are known to be that line, so that only rounding of
/// them reaches the joint.
#[test]
fn opposite_forces_are_not_observable_along_their_line() {
    let text = |axis: &str| {
        let inertial = "<inertial><origin xyz=\"0.01 0.02 0.1\"/><mass value=\"1.5\"/>\
                        <inertia ixx=\"0.02\" ixy=\"0\" ixz=\"0\" iyy=\"0.03\" iyz=\"0\" \
                        izz=\"0.04\"/></inertial>";
        let links: String = (0..3)
            .map(|link| format!("<link name=\"link{link}\">{inertial}</link>"))
            .collect();
        format!(
            "<robot name=\"grip\">{links}\
             <joint name=\"ft\" type=\"fixed\"><parent link=\"link0\"/><child link=\"link1\"/>\
             <origin xyz=\"0.3 0.1 0.2\" rpy=\"0.4 0.5 0.6\"/></joint>\
             <joint name=\"elbow\" type=\"continuous\"><parent link=\"link1\"/>\
             <child link=\"link2\"/><origin xyz=\"0.13 -0.27 0.31\"/><axis xyz=\"{axis}\"/>\
             </joint></robot>"
        )
    };
    let u = Vec3::new(0.5, -0.1, 0.9);
    let cases = [
        (
            ContactKind::Force,
            1,
            "0.2 0.7 0.3",
            Determinacy::Determined,
        ),
        (
            ContactKind::Force,
            1,
            "0.2 0.7 0.3000001",
            Determinacy::Assumed,
        ),
        (
            ContactKind::ForceAlong(u),
            5,
            "0.2 0.7 0.3",
            Determinacy::Determined,
        ),
        (
            ContactKind::ForceAlong(u),
            5,
            "0.2 0.7 0.3000001",
            Determinacy::Assumed,
        ),
    ];
    for (kind, degrees, axis, certainty) in cases {
        let model = Model::from_urdf(&text(axis), &["ft"]).unwrap();
        let elbow = Vec3::new(0.13, -0.27, 0.31);
        // With the elbow at zero link 1 and link 2 have the same axes. Both contacts in the plane
        // of the first axis and u, the line through q = elbow + 0.17 axis.
        let direction = Vec3::new(0.2, 0.7, 0.3);
        let meeting = elbow + direction * 0.17;
        let at = |link: &str, position: Vec3| ContactSpec {
            frame: model.frame(link).unwrap(),
            kind,
            position,
        };
        let contacts = vec![
            at("link1", meeting - u * 0.3),
            at("link2", meeting + u * 0.45 - elbow),
        ];
        let sensors = vec![child_sensor(&model, "ft", 0.1, 0.002)];
        let mut random = Random::new(25);
        let mut scene = Scene::with(
            model.clone(),
            sensors,
            contacts,
            vec![Wrench::zero(); 2],
            &mut random,
        );
        scene.state.0[0].fill(0.0);
        let structure = scene.structure();
        assert_eq!(structure.route(0, &scene.all()), Some(Route::Whole));
        let solver = scene.solve(&structure, &scene.all());
        assert_eq!(solver.balances()[1].degrees, degrees);
        assert!(
            solver
                .contacts()
                .iter()
                .all(|contact| contact.certainty == Determinacy::Assumed)
        );
        assert_eq!(
            solver.torque_certainty()[0],
            certainty,
            "{kind:?} axis {axis}"
        );
    }
}

/// The greatest number of contacts, all in one sub-tree and many of them identical, some on
/// massless links: the balance closes, the sum of the forces is that of the sensor, and their order
/// has no influence.
#[test]
fn sixty_four_contacts_in_one_subtree() {
    let mut model = chain(&[
        ("ft", "fixed"),
        ("elbow", "continuous"),
        ("wrist", "prismatic"),
        ("tip", "continuous"),
    ]);
    model.set_inertia(2, RigidInertia::zero()).unwrap();
    model.set_inertia(4, RigidInertia::zero()).unwrap();
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let mut contacts = Vec::new();
        for number in 0..64 {
            let link = 1 + random.below(4);
            let frame = Frame {
                link,
                pose: random.pose(),
            };
            let position = random.vector(0.2);
            let kind = match (seed + number) % 4 {
                0 if seed % 3 == 0 => ContactKind::Wrench,
                1 => ContactKind::ForceAlong(random.vector(1.0).add_scalar(0.01)),
                _ => ContactKind::Force,
            };
            contacts.push(ContactSpec {
                frame,
                kind,
                position,
            });
            if contacts.len() > 2 && random.chance(30) {
                let twin = contacts[random.below(contacts.len())];
                contacts[number as usize] = twin;
            }
        }
        // One case with everything on one line.
        if seed == 7 {
            for (contact, step) in contacts.iter_mut().zip(0..) {
                let frame = Frame {
                    link: 1,
                    pose: Pose::identity(),
                };
                let position = Vec3::new(0.1, 0.2, 0.3) * f64::from(step);
                *contact = ContactSpec {
                    frame,
                    kind: ContactKind::Force,
                    position,
                };
            }
        }
        let truth = vec![Wrench::zero(); 64];
        let mut scene = Scene::with(
            model.clone(),
            vec![child_sensor(&model, "ft", 0.1, 0.002)],
            contacts,
            truth,
            &mut random,
        );
        scene.disturb(&mut random);
        let structure = scene.structure();
        let solver = scene.solve(&structure, &scene.all());
        let number = structure.subtree_of(1).unwrap();
        let balance = solver.balances()[number];
        assert_eq!(balance.degrees, if seed == 7 { 1 } else { 0 });
        assert!(
            solver
                .contacts()
                .iter()
                .all(|contact| contact.certainty == Determinacy::Assumed)
        );
        let scale = scene.size();
        if seed != 7 {
            assert!(wrench_gap(&balance.residual, &Wrench::zero()) < EXACT * scale);
            assert!(balance.chi_square.unwrap() < EXACT * scale);
        }
        let kinematics = scene.kinematics();
        let mut sum = Wrench::zero();
        for (contact, spec) in solver.contacts().iter().zip(&scene.contacts) {
            sum += (*kinematics.pose(spec.frame.link) * spec.frame.pose).wrench(&contact.wrench);
        }
        let none = scene.solve(&structure, &ContactSet::EMPTY).balances()[number].residual;
        let residual = kinematics.pose(1).wrench(&(none - balance.residual));
        assert!(
            wrench_gap(&sum, &residual) < EXACT * scale,
            "the contacts are what the rest leaves"
        );
        let mut order: Vec<usize> = (0..64).collect();
        random.shuffle(&mut order);
        scene.contacts = order.iter().map(|&k| scene.contacts[k]).collect();
        let after = scene.solve(&scene.structure(), &scene.all());
        assert!(gap(solver.torque(), after.torque()) < EXACT * scale);
        for (new, &old) in order.iter().enumerate() {
            assert!(
                wrench_gap(
                    &solver.contacts()[old].wrench,
                    &after.contacts()[new].wrench
                ) < EXACT * scale
            );
        }
    }
}

/// Noise of very different sizes, contacts far outside the robot, readings beyond any sensor: all
/// results are finite (`solve` of a scene checks every one).
#[test]
fn extremes_give_numbers() {
    let model = leg();
    let direction = Vec3::new(0.3, 0.2, 0.1);
    for (force, torque) in [(0.1, 0.002), (1e9, 1e-9), (1e-9, 1e9)] {
        let noise = Noise {
            force: [force, 0.1, 1.0],
            torque: [0.1, torque, 0.01],
        };
        let uneven = SensorCut::new(
            &model,
            "foot_ft",
            MeasurementFrame::Child,
            MeasurementDirection::ChildToParent,
            &Pose::identity(),
            &noise,
        )
        .unwrap();
        for (far, load) in [(0.1, 1.0), (1e10, 1e12), (1e80, 1e6), (1e200, 1e100)] {
            for kind in [
                ContactKind::Wrench,
                ContactKind::Force,
                ContactKind::ForceAlong(direction),
            ] {
                for other in [child_sensor(&model, "foot_ft", 0.1, 0.002), uneven] {
                    let at = |link: &str, position: Vec3| ContactSpec {
                        frame: model.frame(link).unwrap(),
                        kind,
                        position,
                    };
                    let contacts = vec![
                        at("link2", Vec3::new(1.0, 0.3, 0.1) * far),
                        at("link3", direction),
                    ];
                    let sensors = vec![child_sensor(&model, "hip_ft", force, torque), other];
                    let truth = vec![Wrench::zero(); 2];
                    let mut scene =
                        Scene::with(model.clone(), sensors, contacts, truth, &mut Random::new(3));
                    scene.readings[0].force.x += load;
                    let structure = scene.structure();
                    for active in [scene.all(), [0].into_iter().collect(), ContactSet::EMPTY] {
                        scene.solve(&structure, &active);
                    }
                }
            }
        }
    }
}

/// Invalid input is refused, and the results stay unchanged.
#[test]
fn wrong_input_is_refused_and_changes_nothing() {
    use proprio_dynamics::{DynamicsError, JointState, StructureError};
    let model = leg();
    let sensors = vec![
        child_sensor(&model, "hip_ft", 0.2, 0.004),
        child_sensor(&model, "foot_ft", 0.1, 0.002),
    ];
    let mut scene = Scene::with(
        model.clone(),
        sensors.clone(),
        vec![],
        vec![],
        &mut Random::new(9),
    );
    let structure = scene.structure();
    let mut solver = scene.solve(&structure, &ContactSet::EMPTY);
    let before = solver.torque().to_vec();
    let mut kinematics = scene.kinematics();
    scene.readings[1].force.y = f64::NAN;
    let refused = solver.solve(
        &model,
        &structure,
        &kinematics,
        &scene.readings,
        &ContactSet::EMPTY,
        &[],
    );
    assert_eq!(
        refused,
        Err(DynamicsError::NotFinite {
            what: "F/T reading",
            index: 1
        })
    );
    let refused = solver.solve(
        &model,
        &structure,
        &kinematics,
        &[],
        &ContactSet::EMPTY,
        &[],
    );
    assert_eq!(
        refused,
        Err(DynamicsError::Size {
            what: "F/T readings",
            got: 0,
            expected: 2
        })
    );
    let refused = solver.solve(
        &chain(&[]),
        &structure,
        &kinematics,
        &scene.readings,
        &ContactSet::EMPTY,
        &[],
    );
    assert!(matches!(refused, Err(DynamicsError::Size { .. })));
    let nowhere = ExternalWrench {
        frame: Frame {
            link: 77,
            pose: Pose::identity(),
        },
        wrench: Wrench::zero(),
    };
    scene.readings[1].force.y = 0.0;
    let refused = solver.solve(
        &model,
        &structure,
        &kinematics,
        &scene.readings,
        &ContactSet::EMPTY,
        &[nowhere],
    );
    assert_eq!(refused, Err(DynamicsError::NoLink(77)));
    let mut askew = ExternalWrench {
        frame: Frame {
            link: 1,
            ..nowhere.frame
        },
        ..nowhere
    };
    askew.frame.pose.translation.z = f64::NAN;
    let refused = solver.solve(
        &model,
        &structure,
        &kinematics,
        &scene.readings,
        &ContactSet::EMPTY,
        &[askew],
    );
    assert!(matches!(
        refused,
        Err(DynamicsError::NotFinite { index: 0, .. })
    ));
    assert_eq!(solver.torque(), before);

    let (zeros, mut bad) = (vec![0.0; 3], vec![0.0; 3]);
    bad[2] = f64::INFINITY;
    let state = JointState {
        position: &zeros,
        velocity: &bad,
        acceleration: &zeros,
    };
    let refused = kinematics.update(&model, state, &scene.motion);
    assert_eq!(
        refused,
        Err(DynamicsError::NotFinite {
            what: "joint velocities",
            index: 2
        })
    );
    assert_eq!(
        kinematics.set_base(&model, 99),
        Err(DynamicsError::NoLink(99))
    );

    let build = |sensors: &[SensorCut], contacts: &[ContactSpec], length| {
        Structure::new(&model, sensors, contacts, length).err()
    };
    let twice = [sensors[0], sensors[0]];
    assert_eq!(
        build(&twice, &[], 0.1),
        Some(StructureError::TwoSensors("hip_ft".to_owned()))
    );
    assert_eq!(
        build(&sensors, &[], 0.0),
        Some(StructureError::LengthScale(0.0))
    );
    let frame = model.frame("link2").unwrap();
    let flat = ContactSpec {
        frame,
        kind: ContactKind::ForceAlong(Vec3::zeros()),
        position: Vec3::zeros(),
    };
    assert_eq!(
        build(&sensors, &[flat], 0.1),
        Some(StructureError::Direction { index: 0 })
    );
    assert_eq!(
        build(
            &sensors,
            &[ContactSpec {
                frame: Frame { link: 50, ..frame },
                ..flat
            }],
            0.1
        ),
        Some(StructureError::Contact { index: 0 })
    );
    let mut askew = flat;
    askew.frame.pose.rotation[(1, 2)] = f64::NAN;
    assert_eq!(
        build(&sensors, &[askew], 0.1),
        Some(StructureError::Contact { index: 0 })
    );
    assert!(matches!(
        build(&sensors, &vec![flat; 65], 0.1),
        Some(StructureError::TooMany { most: 64, .. })
    ));
    let cut = |joint: &str, noise: f64| {
        let noise = Noise {
            force: [noise; 3],
            torque: [0.1; 3],
        };
        SensorCut::new(
            &model,
            joint,
            MeasurementFrame::Child,
            MeasurementDirection::ChildToParent,
            &Pose::identity(),
            &noise,
        )
        .err()
    };
    assert_eq!(
        cut("hip_ft", 0.0),
        Some(StructureError::Noise("hip_ft".to_owned()))
    );
    assert_eq!(
        cut("hip_ft", 1e-200),
        Some(StructureError::Noise("hip_ft".to_owned()))
    );
    let noise = sensors[0].noise();
    let mut nowhere = Pose::identity();
    nowhere.translation.y = f64::INFINITY;
    let (frame, direction) = (
        MeasurementFrame::Sensor,
        MeasurementDirection::ChildToParent,
    );
    assert_eq!(
        SensorCut::new(&model, "hip_ft", frame, direction, &nowhere, &noise).err(),
        Some(StructureError::SensorPose("hip_ft".to_owned()))
    );
    assert_eq!(
        cut("knee", 0.1),
        Some(StructureError::JointMoves("knee".to_owned()))
    );
    assert_eq!(
        cut("nose", 0.1),
        Some(StructureError::NoJoint("nose".to_owned()))
    );
}
