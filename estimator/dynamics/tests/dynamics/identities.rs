//! Identities between two computations, on random robots.

use super::*;

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 120,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// The results do not depend on the base: same motion, torques and F/T readings from any link;
    /// the wrench that closes the balance moves with the base.
    #[test]
    fn any_base_gives_the_same((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let model = RandomRobot::new(links, &mut random).model();
        let (state, motion) = (State::new(&model, &mut random), motion(&mut random));
        let external: Vec<_> = (0..3)
            .map(|_| ExternalWrench {
                frame: random.frame(&model),
                wrench: random.wrench(),
            })
            .collect();
        let first = kinematics(&model, 0, &state, &motion);
        let expected = inverse(&model, &first, &external);
        let scale = size(expected.torque()).max(size(&expected.base_wrench().force_first()));
        let mut other = Kinematics::new(&model, 0).unwrap();
        for base in 0..model.link_count() {
            other.set_base(&model, base).unwrap();
            other
                .update(&model, state.get(), first.motion(base))
                .unwrap();
            for link in 0..model.link_count() {
                let relative = first.pose(base).inverse() * *first.pose(link);
                prop_assert!((relative.rotation - other.pose(link).rotation).amax() < EXACT);
                prop_assert!((relative.translation - other.pose(link).translation).amax() < EXACT);
                let (a, b) = (first.motion(link), other.motion(link));
                let scale = 1.0 + a.proper_acceleration.amax() + a.angular_acceleration.amax();
                prop_assert!((a.angular_velocity - b.angular_velocity).amax() < EXACT * scale);
                prop_assert!(
                    (a.angular_acceleration - b.angular_acceleration).amax() < EXACT * scale
                );
                prop_assert!(
                    (a.proper_acceleration - b.proper_acceleration).amax() < EXACT * scale
                );
            }
            let mut acting = external.clone();
            acting.push(ExternalWrench {
                frame: Frame {
                    link: 0,
                    pose: Pose::identity(),
                },
                wrench: expected.base_wrench(),
            });
            let got = inverse(&model, &other, &acting);
            prop_assert!(gap(got.torque(), expected.torque()) < EXACT * scale);
            prop_assert!(
                wrench_gap(&got.base_wrench(), &Wrench::zero()) < EXACT * scale,
                "nothing is left for the base"
            );
            for joint in 0..model.joint_count() {
                prop_assert!(
                    wrench_gap(
                        &got.transmitted(&other, joint),
                        &expected.transmitted(&first, joint)
                    ) < EXACT * scale
                );
            }
            // Without the closing wrench the base wrench supplies it, in the coordinates of the
            // base.
            let needed = inverse(&model, &other, &external).base_wrench();
            let moved = first.pose(base).wrench_back(&expected.base_wrench());
            prop_assert!(wrench_gap(&needed, &moved) < EXACT * scale);
        }
    }

    /// The order in which the URDF lists links and joints changes only numbers, not torques.
    #[test]
    fn any_serialization_gives_the_same((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let mut robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let (state, motion) = (State::new(&model, &mut random), motion(&mut random));
        let expected = inverse(&model, &kinematics(&model, 0, &state, &motion), &[]);
        random.shuffle(&mut robot.links);
        random.shuffle(&mut robot.joints);
        let shuffled = robot.model();
        prop_assert_eq!(shuffled.dof_count(), model.dof_count());
        let old = |dof: usize| model.dof(shuffled.dof_name(dof)).expect("the same joints");
        let state = State(
            state
                .0
                .map(|values| (0..values.len()).map(|dof| values[old(dof)]).collect()),
        );
        let got = inverse(&shuffled, &kinematics(&shuffled, 0, &state, &motion), &[]);
        let expected: Vec<f64> = (0..model.dof_count())
            .map(|dof| expected.torque()[old(dof)])
            .collect();
        prop_assert!(gap(got.torque(), &expected) < EXACT * size(&expected));
    }

    /// Kinematics from an IMU anywhere equal kinematics from the link at rest.
    #[test]
    fn imu_rooted_is_fixed_rooted((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let model = RandomRobot::new(links, &mut random).model();
        let state = State::new(&model, &mut random);
        let fixed = random.frame(&model);
        let standing =
            FrameMotion::of_link_from_imu(&FrameMotion::standing(&random.vector(9.0)), &fixed.pose);
        let from_fixed = kinematics(&model, fixed.link, &state, &standing);
        let imu = random.frame(&model);
        let measured = from_fixed.frame_motion(&imu);
        let from_imu = kinematics(
            &model,
            imu.link,
            &state,
            &FrameMotion::of_link_from_imu(&measured, &imu.pose),
        );
        let base = inverse(&model, &from_fixed, &[]);
        let closing = ExternalWrench {
            frame: Frame {
                link: fixed.link,
                pose: Pose::identity(),
            },
            wrench: base.base_wrench(),
        };
        let got = inverse(&model, &from_imu, &[closing]);
        let scale = size(base.torque()).max(size(&base.base_wrench().force_first()));
        prop_assert!(gap(got.torque(), base.torque()) < EXACT * scale);
    }

    /// Virtual power: the power of the net wrenches along the links' twists is that of the torques
    /// along the joint velocities plus that at the base.
    #[test]
    fn power_balances((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let model = RandomRobot::new(links, &mut random).model();
        let (state, motion) = (State::new(&model, &mut random), motion(&mut random));
        let kinematics = kinematics(&model, random.below(model.link_count()), &state, &motion);
        let inverse = inverse(&model, &kinematics, &[]);
        let velocity = random.vector(1.0);
        // The base moves freely.
        let base_twist = Motion {
            angular: random.vector(1.0),
            linear: velocity,
        };
        let mut power = -base_twist.dot(&inverse.base_wrench());
        let mut scale = power.abs().max(1.0);
        for (twist, wrench) in twists(&model, &kinematics, &state.0[1], &base_twist)
            .iter()
            .zip(kinematics.net_wrenches())
        {
            power += twist.dot(wrench);
            scale += twist.dot(wrench).abs();
        }
        for (torque, rate) in inverse.torque().iter().zip(&state.0[1]) {
            power -= torque * rate;
            scale += (torque * rate).abs();
        }
        prop_assert!(power.abs() < EXACT * scale, "{power} of {scale}");
    }

    /// Along a motion of a robot on a fixed base, the joints' power is the rate of its energy
    /// (central differences).
    #[test]
    fn energy_changes_by_the_power_of_the_joints((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let model = RandomRobot::new(links, &mut random).model();
        let (state, gravity) = (State::new(&model, &mut random), random.vector(9.0));
        let at = |t: f64| {
            let [q, dq, ddq] = &state.0;
            let shifted = |x: &[f64], v: &[f64], a: &[f64], half: f64| -> Vec<f64> {
                x.iter()
                    .zip(v)
                    .zip(a)
                    .map(|((x, v), a)| x + v * t + half * a * t * t)
                    .collect()
            };
            let zeros = vec![0.0; q.len()];
            State([
                shifted(q, dq, ddq, 0.5),
                shifted(dq, ddq, &zeros, 0.0),
                ddq.clone(),
            ])
        };
        let energy = |t: f64| {
            let kinematics = kinematics(&model, 0, &at(t), &FrameMotion::standing(&gravity));
            // Velocities by finite differences of positions, without the velocity recursion.
            let h = 1e-5;
            let [before, after] = [-h, h].map(|dt| {
                self::kinematics(&model, 0, &at(t + dt), &FrameMotion::standing(&gravity))
            });
            let mut sum = 0.0;
            for (link, inertia) in model.inertias().iter().enumerate() {
                let centre = inertia.centre().unwrap();
                let velocity = (after.pose(link).point(&centre) - before.pose(link).point(&centre))
                    / (2.0 * h);
                let turn = before.pose(link).rotation.transpose() * after.pose(link).rotation;
                let omega = small_turn(&turn) / (2.0 * h);
                let about_centre = inertia
                    .transformed(&Pose {
                        translation: -centre,
                        ..Pose::identity()
                    })
                    .inertia;
                sum += 0.5 * inertia.mass * velocity.norm_squared()
                    + 0.5 * omega.dot(&(about_centre * omega));
                sum -= inertia.mass * gravity.dot(&kinematics.pose(link).point(&centre));
            }
            sum
        };
        let h = 1e-3;
        // Fourth-order differences.
        let rate =
            (8.0 * (energy(h) - energy(-h)) - (energy(2.0 * h) - energy(-2.0 * h))) / (12.0 * h);
        let torque = inverse(
            &model,
            &kinematics(&model, 0, &state, &FrameMotion::standing(&gravity)),
            &[],
        );
        let power: f64 = torque
            .torque()
            .iter()
            .zip(&state.0[1])
            .map(|(t, v)| t * v)
            .sum();
        let scale: f64 = torque
            .torque()
            .iter()
            .zip(&state.0[1])
            .map(|(t, v)| (t * v).abs())
            .sum::<f64>()
            + energy(0.0).abs()
            + 1.0;
        prop_assert!((rate - power).abs() < 1e-4 * scale, "{rate} {power}");
    }

    /// Twists and accelerations are the derivatives of the poses.
    #[test]
    fn motions_are_derivatives_of_poses((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let model = RandomRobot::new(links, &mut random).model();
        let (state, base) = (
            State::new(&model, &mut random),
            random.below(model.link_count()),
        );
        let still = FrameMotion::standing(&Vec3::zeros());
        let now = kinematics(&model, base, &state, &still);
        let h = 1e-4;
        let [before, after] = [-h, h].map(|t| {
            let [q, dq, ddq] = &state.0;
            let shifted = (0..q.len())
                .map(|i| q[i] + dq[i] * t + 0.5 * ddq[i] * t * t)
                .collect();
            kinematics(
                &model,
                base,
                &State([shifted, vec![0.0; q.len()], vec![0.0; q.len()]]),
                &still,
            )
        });
        for link in 0..model.link_count() {
            let acceleration = (after.pose(link).translation - now.pose(link).translation * 2.0
                + before.pose(link).translation)
                / (h * h);
            let turn = before.pose(link).rotation.transpose() * after.pose(link).rotation;
            let omega = small_turn(&turn) / (2.0 * h);
            let half = |a: &Kinematics, b: &Kinematics| {
                small_turn(&(a.pose(link).rotation.transpose() * b.pose(link).rotation)) / h
            };
            let alpha = (half(&now, &after) - half(&before, &now)) / h;
            let motion = now.motion(link);
            let in_base = now.pose(link).rotation * motion.proper_acceleration;
            let scale = 1.0
                + in_base.amax()
                + motion.angular_acceleration.amax()
                + motion.angular_velocity.amax().powi(3);
            prop_assert!(
                (in_base - acceleration).amax() < 1e-4 * scale,
                "acceleration of link {link}"
            );
            prop_assert!(
                (motion.angular_velocity - omega).amax() < 1e-4 * scale,
                "angular velocity of link {link}"
            );
            prop_assert!(
                (motion.angular_acceleration - alpha).amax() < 1e-3 * scale,
                "angular acceleration of link {link}"
            );
        }
    }

    /// Predicted sensor readings give back the true torques and contacts, as far as six equations
    /// per sub-tree determine them.
    #[test]
    fn predicted_readings_give_the_truth_back((links, seed) in robots()) {
        let scene = Scene::new(links, seed, 5);
        let structure = scene.structure();
        let solver = scene.solve(&structure, &scene.all());
        let scale = scene.size();
        for dof in 0..scene.model.dof_count() {
            if solver.torque_certainty()[dof] == Determinacy::Determined {
                prop_assert!(
                    (solver.torque()[dof] - scene.torque[dof]).abs()
                        < EXACT * scale * amplification(&solver)
                );
            }
        }
        for (got, truth) in solver.contacts().iter().zip(&scene.truth) {
            prop_assert_ne!(got.certainty, Determinacy::Absent);
            if got.certainty == Determinacy::Determined {
                prop_assert!(
                    wrench_gap(&got.wrench, truth) < EXACT * scale * amplification(&solver),
                    "{:?} {:?}",
                    got,
                    truth
                );
            }
        }
        for (balance, subtree) in solver.balances().iter().zip(structure.subtrees()) {
            prop_assert!(
                wrench_gap(&balance.residual, &Wrench::zero())
                    < EXACT * scale * amplification(&solver),
                "{:?}",
                balance
            );
            prop_assert_eq!(balance.chi_square.is_some(), !subtree.sensors.is_empty());
        }
    }

    /// One full wrench per sub-tree, the paper's case: everything is determined and exact.
    #[test]
    fn one_wrench_per_subtree_determines_everything((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let sensors = robot.sensors(&model, &mut random);
        let bare = Structure::new(&model, &sensors, &[], 0.1).unwrap();
        let mut contacts: Vec<ContactSpec> = Vec::new();
        for number in 0..bare.subtrees().len() {
            let members: Vec<usize> = (0..model.link_count())
                .filter(|&link| bare.subtree_of(link) == Some(number))
                .collect();
            let frame = Frame {
                link: members[random.below(members.len())],
                pose: random.pose(),
            };
            contacts.push(ContactSpec {
                frame,
                kind: ContactKind::Wrench,
                position: random.vector(0.1),
            });
        }
        random.shuffle(&mut contacts);
        let truth = contacts.iter().map(|_| random.wrench()).collect();
        let scene = Scene::with(model, sensors, contacts, truth, &mut random);
        let structure = scene.structure();
        let solver = scene.solve(&structure, &scene.all());
        let scale = scene.size();
        prop_assert!(
            solver
                .torque_certainty()
                .iter()
                .all(|&certainty| certainty == Determinacy::Determined)
        );
        prop_assert!(gap(solver.torque(), &scene.torque) < EXACT * scale);
        for (got, truth) in solver.contacts().iter().zip(&scene.truth) {
            prop_assert_eq!(got.certainty, Determinacy::Determined);
            prop_assert!(wrench_gap(&got.wrench, truth) < EXACT * scale);
        }
    }

    /// Locality: a sensor, link or joint outside a torque's dependence does not change the torque,
    /// and a sensor in it does.
    #[test]
    fn torques_depend_on_their_declared_dependence_only((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 1);
        let mut scene = Scene::new(links, seed, 5);
        scene.disturb(&mut random);
        let structure = scene.structure();
        let active = active_some(scene.contacts.len(), &mut random);
        let kinematics = scene.kinematics();
        let torque_dependence: Vec<_> = (0..scene.model.dof_count())
            .map(|dof| {
                structure
                    .torque_dependence(dof, &kinematics, &active)
                    .unwrap()
            })
            .collect();
        let contact_dependence: Vec<_> = (0..scene.contacts.len())
            .map(|k| {
                structure
                    .contact_dependence(k, &kinematics, &active)
                    .unwrap()
            })
            .collect();
        let before = scene.solve(&structure, &active);
        let scale = scene.size() * amplification(&before);
        let unchanged = |after: &Solver,
                         torque_may: &dyn Fn(usize) -> bool,
                         contact_may: &dyn Fn(usize) -> bool| {
            for dof in (0..before.torque().len()).filter(|&dof| !torque_may(dof)) {
                prop_assert!(
                    (before.torque()[dof] - after.torque()[dof]).abs() < EXACT * scale,
                    "dof {}",
                    dof
                );
            }
            for k in (0..before.contacts().len()).filter(|&k| !contact_may(k)) {
                prop_assert!(
                    wrench_gap(&before.contacts()[k].wrench, &after.contacts()[k].wrench)
                        < EXACT * scale,
                    "contact {}",
                    k
                );
            }
            Ok(())
        };
        for sensor in 0..scene.sensors.len() {
            let old = scene.readings[sensor];
            scene.readings[sensor] += random.wrench();
            let after = scene.solve(&structure, &active);
            unchanged(
                &after,
                &|dof| torque_dependence[dof].sensors.contains(sensor),
                &|k| contact_dependence[k].sensors.contains(sensor),
            )?;
            for (dof, dependence) in torque_dependence.iter().enumerate() {
                let one_sided = matches!(
                    structure.route(dof, &active),
                    Some(Route::Child | Route::Parent)
                );
                if one_sided && dependence.sensors.contains(sensor) {
                    prop_assert!(
                        (before.torque()[dof] - after.torque()[dof]).abs() > 1e-9,
                        "dof {dof} does not feel sensor {sensor}"
                    );
                }
            }
            scene.readings[sensor] = old;
        }
        for link in 0..scene.model.link_count() {
            let old = scene.model.inertias()[link];
            let parameters = old.parameters().map(|x| x + random.real(0.5));
            scene
                .model
                .set_inertia(link, RigidInertia::from_parameters(&parameters))
                .unwrap();
            let after = scene.solve(&structure, &active);
            unchanged(
                &after,
                &|dof| torque_dependence[dof].links.contains(link),
                &|k| contact_dependence[k].links.contains(link),
            )?;
            scene.model.set_inertia(link, old).unwrap();
        }
        for dof in 0..scene.model.dof_count() {
            let old = scene.state.clone();
            for values in &mut scene.state.0 {
                values[dof] += random.real(1.0);
            }
            let after = scene.solve(&structure, &active);
            unchanged(
                &after,
                &|other| torque_dependence[other].dofs.contains(dof),
                &|k| contact_dependence[k].dofs.contains(dof),
            )?;
            scene.state = old;
        }
    }

    /// The order of the contact list is irrelevant, also where there are more unknowns than
    /// equations.
    #[test]
    fn contact_order_is_irrelevant((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 2);
        let mut scene = Scene::new(links, seed, 6);
        scene.disturb(&mut random);
        let (structure, active) = (scene.structure(), scene.all());
        let before = scene.solve(&structure, &active);
        let mut order: Vec<usize> = (0..scene.contacts.len()).collect();
        random.shuffle(&mut order);
        let shuffled: Vec<_> = order.iter().map(|&k| scene.contacts[k]).collect();
        scene.contacts = shuffled;
        let after = scene.solve(&scene.structure(), &active);
        let scale = scene.size() * amplification(&before);
        prop_assert!(gap(before.torque(), after.torque()) < EXACT * scale);
        prop_assert!(
            gap(before.torque_deviation(), after.torque_deviation())
                < 1e-8 * size(before.torque_deviation())
        );
        for (new, &old) in order.iter().enumerate() {
            let (a, b) = (before.contacts()[old], after.contacts()[new]);
            prop_assert_eq!(a.certainty, b.certainty);
            prop_assert!(wrench_gap(&a.wrench, &b.wrench) < EXACT * scale);
        }
    }

    /// A contact that was moved is solved to the last bit as one that was there from the start; and
    /// a full wrench is the same wrench wherever its position is, if it is determined.
    #[test]
    fn a_moved_contact_is_one_that_was_there_from_the_start((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 4);
        let mut scene = Scene::new(links, seed, 6);
        scene.disturb(&mut random);
        let (mut moved, active) = (scene.structure(), scene.all());
        let before = scene.solve(&moved, &active);
        for (index, contact) in scene.contacts.iter_mut().enumerate() {
            contact.position = random.vector(0.3);
            let direction = random.vector(1.0).add_scalar(0.01);
            if let ContactKind::ForceAlong(own) = &mut contact.kind {
                *own = direction;
            }
            moved.place_contact(index, &contact.position, Some(&direction)).expect("finite");
        }
        let from_start = scene.solve(&scene.structure(), &active);
        let after = scene.solve(&moved, &active);
        prop_assert_eq!(from_start.torque(), after.torque());
        prop_assert_eq!(from_start.torque_deviation(), after.torque_deviation());
        prop_assert_eq!(from_start.contacts(), after.contacts());
        let scale = scene.size() * amplification(&before).max(amplification(&after));
        let pairs = before.contacts().iter().zip(after.contacts()).zip(&scene.contacts);
        for ((a, b), spec) in pairs {
            let alone = |solved: &Solver| {
                let number = moved.subtree_of(spec.frame.link).expect("a link");
                let is_single = moved.subtrees()[number].contacts.len() == 1;
                is_single && solved.balances()[number].degrees == 0
            };
            if spec.kind == ContactKind::Wrench && alone(&before) {
                prop_assert!(wrench_gap(&a.wrench, &b.wrench) < EXACT * scale);
            }
        }
    }

    /// The stated standard deviations are the errors made by taking a contact to be where it is
    /// not, added up over the axes.
    #[test]
    fn place_errors_are_the_errors_of_a_wrong_place((links, seed) in robots()) {
        const STEP: f64 = 1e-6;
        let scene = Scene::new(links, seed, 3);
        if scene.contacts.is_empty() {
            return Ok(());
        }
        let (structure, active) = (scene.structure(), scene.all());
        let before = scene.solve(&structure, &active);
        let which = Random::new(seed).below(scene.contacts.len());
        let (spec, wrench) = (scene.contacts[which], scene.truth[which]);
        // The errors of torques, contact wrenches and imbalance if the wrench differs by this.
        let error = |difference: Wrench| {
            let mut other = scene.clone();
            let changed = ExternalWrench { frame: spec.frame, wrench: difference };
            other.act(changed);
            let after = other.solve(&structure, &active);
            let mut errors: Vec<f64> = (after.torque().iter().zip(&other.torque))
                .zip(before.torque().iter().zip(&scene.torque))
                .map(|((a, b), (c, d))| (a - b - c + d) / STEP)
                .collect();
            for (number, (a, b)) in after.contacts().iter().zip(before.contacts()).enumerate() {
                let change = if number == which { difference } else { Wrench::zero() };
                errors.extend((a.wrench - b.wrench - change).force_first().map(|x| x / STEP));
            }
            errors
        };
        let estimated = before.contacts()[which].wrench.force;
        let mut kinds = vec![PlaceStd { position: 1.0, direction: 0.0 }];
        let along = match spec.kind {
            ContactKind::ForceAlong(direction) => Some(direction.normalize()),
            _ => None,
        };
        if along.is_some() {
            kinds.push(PlaceStd { position: 0.0, direction: 1.0 });
        }
        let mut stated = PlaceErrors::new(&structure);
        let kinematics = scene.kinematics();
        for std in kinds {
            let std_of = |contact: usize| if contact == which { std } else { PlaceStd::default() };
            stated.update(&structure, &before, &kinematics, std_of).expect("solved");
            let mut squares = vec![0.0; scene.torque.len() + 6 * scene.contacts.len()];
            for axis in 0..3 {
                let mut unit = Vec3::zeros();
                unit[axis] = STEP;
                // The force is the one that was estimated: the true one where it is determined.
                let difference = match along.filter(|_| std.direction > 0.0) {
                    None => Wrench { torque: unit.cross(&estimated), force: Vec3::zeros() },
                    Some(along) => {
                        let force = (unit - along * along.dot(&unit)) * estimated.norm();
                        Wrench { torque: spec.position.cross(&force), force }
                    }
                };
                for (sum, error) in squares.iter_mut().zip(error(difference)) {
                    *sum += error * error;
                }
            }
            let mut claimed = stated.torque_std().to_vec();
            for (dof, std_of_torque) in claimed.iter().enumerate() {
                let at = (which, std);
                let alone =
                    PlaceErrors::torque_variance(&structure, &before, &kinematics, dof, at).sqrt();
                prop_assert!((alone - std_of_torque).abs() <= 1e-12 * std_of_torque);
            }
            claimed.extend(stated.contact_std().iter().flatten());
            if spec.kind == ContactKind::Wrench {
                prop_assert!(claimed.iter().all(|std| *std == 0.0));
                continue;
            }
            let scale = (size(&claimed) + wrench.force.norm()) * amplification(&before);
            for (claimed, square) in claimed.iter().zip(squares) {
                let made = square.sqrt();
                prop_assert!((claimed - made).abs() < 1e-3 * scale, "{claimed} {made}");
            }
        }
    }

    /// Another frame of the link for a contact, or another base of the kinematics, changes only the
    /// coordinates of its wrench.
    #[test]
    fn contact_frame_and_base_are_irrelevant((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 3);
        let mut scene = Scene::new(links, seed, 6);
        scene.disturb(&mut random);
        let active = scene.all();
        let before = scene.solve(&scene.structure(), &active);
        let scale = scene.size() * amplification(&before);
        let turns: Vec<Pose> = scene.contacts.iter().map(|_| random.pose()).collect();
        for (contact, x_fg) in scene.contacts.iter_mut().zip(&turns) {
            contact.frame.pose = contact.frame.pose * *x_fg;
            contact.position = x_fg.inverse().point(&contact.position);
            if let ContactKind::ForceAlong(direction) = &mut contact.kind {
                *direction = x_fg.rotation.tr_mul(direction);
            }
        }
        let kinematics = scene.kinematics();
        scene.base = random.below(scene.model.link_count());
        scene.motion = *kinematics.motion(scene.base);
        let after = scene.solve(&scene.structure(), &active);
        prop_assert!(gap(before.torque(), after.torque()) < EXACT * scale);
        prop_assert!(
            gap(before.torque_deviation(), after.torque_deviation())
                < 1e-7 * size(before.torque_deviation())
        );
        prop_assert_eq!(before.torque_certainty(), after.torque_certainty());
        for ((a, b), x_fg) in before.contacts().iter().zip(after.contacts()).zip(&turns) {
            prop_assert!(wrench_gap(&a.wrench, &x_fg.wrench(&b.wrench)) < EXACT * scale);
        }
        for (a, b) in before.balances().iter().zip(after.balances()) {
            prop_assert_eq!(a.degrees, b.degrees);
            prop_assert!(wrench_gap(&a.residual, &b.residual) < EXACT * scale);
            let (a, b) = (a.chi_square.unwrap_or(0.0), b.chi_square.unwrap_or(0.0));
            prop_assert!((a - b).abs() < 1e-6 * (1.0 + a), "{} {}", a, b);
        }
    }

    /// A reading is about the origin and in the axes of the declared frame, folded parent links
    /// included.
    #[test]
    fn readings_are_in_the_named_frame((links, seed) in robots()) {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let (state, motion) = (State::new(&model, &mut random), motion(&mut random));
        let kinematics = kinematics(&model, 0, &state, &motion);
        let inverse = inverse(&model, &kinematics, &[]);
        let noise = Noise {
            force: [1.0; 3],
            torque: [1.0; 3],
        };
        for joint in &robot.cuts {
            let number = model.joint(joint).unwrap();
            let (parent, child) = model.joint_links(number).unwrap();
            let place = |link: &str| {
                let frame = model.frame(link).unwrap();
                *kinematics.pose(frame.link) * frame.pose
            };
            let transmitted = inverse.transmitted(&kinematics, number);
            let in_base = place(child).wrench(&transmitted);
            let pose = random.pose();
            let cases = [
                (MeasurementFrame::Child, place(child)),
                (MeasurementFrame::Parent, place(parent)),
                (MeasurementFrame::Sensor, place(child) * pose),
            ];
            for (frame, x_bm) in cases {
                for (direction, sign) in [
                    (MeasurementDirection::ChildToParent, -1.0),
                    (MeasurementDirection::ParentToChild, 1.0),
                ] {
                    let cut =
                        SensorCut::new(&model, joint, frame, direction, &pose, &noise).unwrap();
                    let (got, expected) =
                        (cut.reading(&transmitted), x_bm.wrench_back(&in_base) * sign);
                    prop_assert!(
                        wrench_gap(&got, &expected) < EXACT * size(&in_base.force_first()),
                        "{frame:?}"
                    );
                    prop_assert!(
                        wrench_gap(&cut.transmitted(&got), &transmitted)
                            < EXACT * size(&in_base.force_first())
                    );
                }
            }
        }
    }

    /// Chi-square of a sub-tree without contacts: its residual, weighted by the inverse of the
    /// sensors' covariance written out column by column.
    #[test]
    fn chi_square_is_the_residual_weighted_by_the_noise((links, seed) in robots()) {
        use nalgebra::{DMatrix, DVector};
        let mut scene = Scene::new(links, seed, 0);
        scene.disturb(&mut Random::new(seed ^ 6));
        let structure = scene.structure();
        let (solver, kinematics) = (
            scene.solve(&structure, &ContactSet::EMPTY),
            scene.kinematics(),
        );
        for (balance, subtree) in solver.balances().iter().zip(structure.subtrees()) {
            prop_assert_eq!(balance.degrees, 6);
            let mut columns = Vec::new();
            for sensor in subtree.sensors.iter() {
                let cut = &scene.sensors[sensor];
                let x_bm = *kinematics.pose(cut.joint() + 1) * *cut.pose();
                for (channel, deviation) in deviations_of(cut).into_iter().enumerate() {
                    let mut unit = [0.0; 6];
                    unit[channel] = deviation;
                    let unit = Wrench::from_parts(
                        [unit[0], unit[1], unit[2]],
                        [unit[3], unit[4], unit[5]],
                    );
                    columns.push(DVector::from_row_slice(
                        &kinematics
                            .pose(subtree.top)
                            .wrench_back(&x_bm.wrench(&unit))
                            .force_first(),
                    ));
                }
            }
            if columns.is_empty() {
                prop_assert_eq!(balance.chi_square, None);
                continue;
            }
            let root = DMatrix::from_columns(&columns);
            let covariance = &root * root.transpose();
            let residual = DVector::from_row_slice(&balance.residual.force_first());
            let expected = residual.dot(&covariance.lu().solve(&residual).unwrap());
            let got = balance.chi_square.unwrap();
            prop_assert!((got - expected).abs() < 1e-6 * expected, "{got} {expected}");
        }
    }

    /// Standard deviations are those of the linear map from readings to results, column by column.
    #[test]
    fn deviations_are_the_noise_carried_through((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 4);
        let mut scene = Scene::new(links, seed, 5);
        let structure = scene.structure();
        let active = active_some(scene.contacts.len(), &mut random);
        let before = scene.solve(&structure, &active);
        let mut torque = vec![0.0; scene.model.dof_count()];
        let mut contacts = vec![[0.0; 6]; scene.contacts.len()];
        for sensor in 0..scene.sensors.len() {
            let noise = deviations_of(&scene.sensors[sensor]);
            for channel in 0..6 {
                let old = scene.readings[sensor];
                // The map is linear: a large step only reduces rounding.
                let step = 1e3 * noise[channel];
                let mut values = old.force_first();
                values[channel] += step;
                scene.readings[sensor] = Wrench::from_parts(
                    [values[0], values[1], values[2]],
                    [values[3], values[4], values[5]],
                );
                let after = scene.solve(&structure, &active);
                scene.readings[sensor] = old;
                for (sum, (a, b)) in torque
                    .iter_mut()
                    .zip(before.torque().iter().zip(after.torque()))
                {
                    *sum += ((b - a) / 1e3).powi(2);
                }
                for (sum, (a, b)) in contacts
                    .iter_mut()
                    .zip(before.contacts().iter().zip(after.contacts()))
                {
                    let (a, b) = (a.wrench.force_first(), b.wrench.force_first());
                    for (sum, (a, b)) in sum.iter_mut().zip(a.iter().zip(&b)) {
                        *sum += ((b - a) / 1e3).powi(2);
                    }
                }
            }
        }
        let tolerance = 1e-9 * scene.size() * amplification(&before);
        for (deviation, variance) in before.torque_deviation().iter().zip(&torque) {
            prop_assert!(
                (deviation - variance.sqrt()).abs() < tolerance,
                "{} {}",
                deviation,
                variance.sqrt()
            );
        }
        for (contact, variances) in before.contacts().iter().zip(&contacts) {
            for (deviation, variance) in contact.deviation.iter().zip(variances) {
                prop_assert!(
                    (deviation - variance.sqrt()).abs() < tolerance,
                    "{} {}",
                    deviation,
                    variance.sqrt()
                );
            }
        }
    }

    /// A joint torque from one side is the need of the links of that side minus its sensors' and
    /// known wrenches; nothing of the other side enters. It is used where no present contact acts
    /// on that side, with the standard deviation of its linear map from readings; fused, the
    /// deviation is that of the better side at most.
    #[test]
    fn each_side_uses_only_its_own_links_and_sensors((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 7);
        let mut scene = Scene::new(links, seed, 3);
        let structure = scene.structure();
        let active = active_some(scene.contacts.len(), &mut random);
        scene.disturb(&mut random);
        let solver = scene.solve(&structure, &active);
        let scale = scene.size();
        for dof in 0..scene.model.dof_count() {
            let sides = [true, false].map(|below| scene.side(&structure, dof, below, &active));
            let (torque, deviation) = (solver.torque()[dof], solver.torque_deviation()[dof]);
            let side = match structure.route(dof, &active).unwrap() {
                Route::Child => &sides[0],
                Route::Parent => &sides[1],
                Route::Fused => {
                    for side in &sides {
                        prop_assert!(side.is_free && !side.sensors.is_empty());
                        prop_assert!(deviation <= side.deviation * (1.0 + 1e-9));
                    }
                    continue;
                }
                Route::Whole => {
                    prop_assert!(sides.iter().all(|side| !side.is_free));
                    continue;
                }
            };
            prop_assert!(side.is_free, "dof {}", dof);
            prop_assert!((side.torque - torque).abs() < EXACT * scale, "{} {torque}", side.torque);
            prop_assert!(
                (side.deviation - deviation).abs() < EXACT * scale,
                "{} {deviation}",
                side.deviation
            );
        }
    }

    /// The order of the list of sensors changes only their numbers; and the same input gives the
    /// same bits.
    #[test]
    fn sensor_order_is_irrelevant((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 9);
        let mut scene = Scene::new(links, seed, 4);
        scene.disturb(&mut random);
        let active = active_some(scene.contacts.len(), &mut random);
        let structure = scene.structure();
        let (before, again) = (
            scene.solve(&structure, &active),
            scene.solve(&structure, &active),
        );
        prop_assert_eq!(before.torque(), again.torque());
        let mut order: Vec<usize> = (0..scene.sensors.len()).collect();
        random.shuffle(&mut order);
        scene.sensors = order.iter().map(|&k| scene.sensors[k]).collect();
        scene.readings = order.iter().map(|&k| scene.readings[k]).collect();
        let other = scene.structure();
        let after = scene.solve(&other, &active);
        let scale = scene.size() * amplification(&before);
        prop_assert!(gap(before.torque(), after.torque()) < EXACT * scale);
        prop_assert!(
            gap(before.torque_deviation(), after.torque_deviation())
                < 1e-7 * size(before.torque_deviation())
        );
        for (a, b) in before.contacts().iter().zip(after.contacts()) {
            prop_assert_eq!(a.certainty, b.certainty);
            prop_assert!(wrench_gap(&a.wrench, &b.wrench) < EXACT * scale);
        }
    }
}
