//! Dynamics as identities between two computations, on random robots of 1 to 40 links with all
//! joint types, cuts and bases; and comparison with golden files.

mod common;

use common::{
    Random, RandomRobot, State, contact, external, gap, joint_axis, motion, size, twists,
    wrench_gap,
};
use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::spatial::{Mat3, Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    Certainty, ContactKind, ContactSet, ContactSpec, Disagreement, ExternalWrench, FrameMotion,
    InverseDynamics, Kinematics, Noise, PlaceErrors, PlaceStd, Route, SensorCut, SensorSet, Sides,
    Solver, Structure,
};
use proptest::prelude::*;

const EXACT: f64 = 1e-10;

fn robots() -> impl Strategy<Value = (usize, u64)> {
    (1..=40_usize, any::<u64>())
}

fn kinematics(model: &Model, base: usize, state: &State, motion: &FrameMotion) -> Kinematics {
    let mut kinematics = Kinematics::new(model, base).expect("a link of the model");
    kinematics
        .update(model, state.get(), motion)
        .expect("a finite state");
    kinematics
}

fn inverse(model: &Model, kinematics: &Kinematics, external: &[ExternalWrench]) -> InverseDynamics {
    let mut inverse = InverseDynamics::new(model);
    inverse
        .update(model, kinematics, external)
        .expect("finite wrenches");
    inverse
}

/// A robot in motion under known wrenches, its sensor readings, and the objects to solve it.
#[derive(Clone)]
struct Scene {
    model: Model,
    sensors: Vec<SensorCut>,
    contacts: Vec<ContactSpec>,
    truth: Vec<Wrench>,
    known: Vec<ExternalWrench>,
    state: State,
    base: usize,
    motion: FrameMotion,
    torque: Vec<f64>,
    readings: Vec<Wrench>,
}

impl Scene {
    /// Up to `most` random contacts, all acting; the remaining wrench that the motion of the base
    /// needs is a known wrench.
    fn new(links: usize, seed: u64, most: usize) -> Self {
        let mut random = Random::new(seed);
        let robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let sensors = robot.sensors(&model, &mut random);
        let count = random.below(most + 1);
        let (contacts, truth): (Vec<_>, Vec<_>) =
            (0..count).map(|_| contact(&model, &mut random)).unzip();
        Self::with(model, sensors, contacts, truth, &mut random)
    }

    fn with(
        model: Model,
        sensors: Vec<SensorCut>,
        contacts: Vec<ContactSpec>,
        truth: Vec<Wrench>,
        random: &mut Random,
    ) -> Self {
        let (state, base, motion) = (
            State::new(&model, random),
            random.below(model.link_count()),
            motion(random),
        );
        let kinematics = kinematics(&model, base, &state, &motion);
        let mut acting = vec![ExternalWrench {
            frame: random.frame(&model),
            wrench: random.wrench(),
        }];
        acting.extend(
            contacts
                .iter()
                .zip(&truth)
                .map(|(spec, wrench)| external(spec, *wrench)),
        );
        let inverse = inverse(&model, &kinematics, &acting);
        let known = vec![
            acting[0],
            ExternalWrench {
                frame: Frame {
                    link: base,
                    pose: Pose::identity(),
                },
                wrench: inverse.base_wrench(),
            },
        ];
        let readings = sensors
            .iter()
            .map(|cut| cut.reading(&inverse.transmitted(&kinematics, cut.joint())))
            .collect();
        let torque = inverse.torque().to_vec();
        Self {
            model,
            sensors,
            contacts,
            truth,
            known,
            state,
            base,
            motion,
            torque,
            readings,
        }
    }

    fn structure(&self) -> Structure {
        Structure::new(
            &self.model,
            &self.sensors,
            &self.contacts,
            Structure::LENGTH_SCALE,
        )
        .expect("valid")
    }

    fn kinematics(&self) -> Kinematics {
        kinematics(&self.model, self.base, &self.state, &self.motion)
    }

    fn solve(&self, structure: &Structure, active: &ContactSet) -> Solver {
        let mut solver = Solver::new(structure);
        solver
            .solve(
                &self.model,
                structure,
                &self.kinematics(),
                &self.readings,
                active,
                &self.known,
            )
            .expect("finite input");
        solver
            .update_deviations(structure)
            .expect("the same structure");
        let all = solver.torque().iter().chain(solver.torque_deviation());
        assert!(all.copied().all(f64::is_finite));
        for contact in solver.contacts() {
            assert!(contact.wrench.is_finite() && contact.deviation.iter().all(|x| x.is_finite()));
        }
        for balance in solver.balances() {
            assert!(balance.residual.is_finite() && balance.chi_square.is_none_or(f64::is_finite));
        }
        solver
    }

    fn all(&self) -> ContactSet {
        ContactSet::first(self.contacts.len())
    }

    /// Lets one more wrench act on the robot, of which the solver is not told.
    fn act(&mut self, wrench: ExternalWrench) {
        let kinematics = self.kinematics();
        let mut acting = vec![self.known[0], wrench];
        let own = self.contacts.iter().zip(&self.truth);
        acting.extend(own.map(|(spec, wrench)| external(spec, *wrench)));
        let inverse = inverse(&self.model, &kinematics, &acting);
        self.known[1].wrench = inverse.base_wrench();
        let cuts = self.readings.iter_mut().zip(&self.sensors);
        for (reading, cut) in cuts {
            *reading = cut.reading(&inverse.transmitted(&kinematics, cut.joint()));
        }
        self.torque = inverse.torque().to_vec();
    }

    /// Readings that are inconsistent with the motion.
    fn disturb(&mut self, random: &mut Random) {
        for reading in &mut self.readings {
            *reading += random.wrench();
        }
    }

    /// One side of a degree of freedom's joint within its sub-tree, link by link: by the
    /// definition, not as in the solver.
    fn side(&self, structure: &Structure, dof: usize, below: bool, active: &ContactSet) -> OneSide {
        let kinematics = self.kinematics();
        let joint = self.model.joints()[self.model.dof_joint(dof).unwrap()];
        let number = structure.subtree_of(joint.child);
        let members: Vec<usize> = (0..self.model.link_count())
            .filter(|&link| structure.subtree_of(link) == number)
            .filter(|&link| {
                // Whether the joint is on the path to the root.
                let way = std::iter::successors(Some(link), |&at| {
                    (at > 0).then(|| self.model.joints()[at - 1].parent)
                });
                way.into_iter().any(|at| at == joint.child) == below
            })
            .collect();
        let mut needs = Wrench::zero();
        for &link in &members {
            needs += kinematics.net_wrenches()[link];
        }
        for known in self
            .known
            .iter()
            .filter(|known| members.contains(&known.frame.link))
        {
            needs -= kinematics
                .pose(known.frame.link)
                .wrench(&known.frame.pose.wrench(&known.wrench));
        }
        let (mut sensors, mut noise) = (SensorSet::EMPTY, Vec::new());
        for (index, cut) in self.sensors.iter().enumerate() {
            let sensor_joint = self.model.joints()[cut.joint()];
            let sign = match [sensor_joint.child, sensor_joint.parent]
                .map(|link| members.contains(&link))
            {
                [true, false] => 1.0,
                [false, true] => -1.0,
                _ => continue,
            };
            sensors.insert(index);
            let pose = kinematics.pose(sensor_joint.child);
            needs -= pose.wrench(&cut.transmitted(&self.readings[index])) * sign;
            for (channel, deviation) in deviations_of(cut).into_iter().enumerate() {
                let mut unit = [0.0; 6];
                unit[channel] = deviation;
                let unit =
                    Wrench::from_parts([unit[0], unit[1], unit[2]], [unit[3], unit[4], unit[5]]);
                noise.push(pose.wrench(&cut.transmitted(&unit)));
            }
        }
        let axis = joint_axis(&kinematics, &joint).expect("it has a degree of freedom");
        // By the parent on the child: the need of the child's side, and the negative of that of the
        // parent's.
        let wrench = if below { needs } else { -needs };
        OneSide {
            is_free: !active
                .iter()
                .any(|contact| members.contains(&self.contacts[contact].frame.link)),
            torque: axis.dot(&wrench),
            deviation: noise
                .iter()
                .map(|unit| axis.dot(unit).powi(2))
                .sum::<f64>()
                .sqrt(),
            sensors,
            axis,
            wrench,
            noise,
        }
    }

    /// Magnitude to which rounding is relative: the greatest wrench anywhere, with lever arms of
    /// metres.
    fn size(&self) -> f64 {
        let kinematics = self.kinematics();
        let mut values = self.torque.clone();
        for wrench in kinematics
            .net_wrenches()
            .iter()
            .chain(&self.readings)
            .chain(self.known.iter().map(|known| &known.wrench))
        {
            values.extend(wrench.force_first());
        }
        size(&values)
    }
}

/// One side of a joint, in base coordinates.
struct OneSide {
    /// No present contact acts there.
    is_free: bool,
    torque: f64,
    deviation: f64,
    sensors: SensorSet,
    axis: Motion,
    /// The wrench by the joint's parent on its child.
    wrench: Wrench,
    /// Its change by one standard deviation of each channel.
    noise: Vec<Wrench>,
}

fn active_some(count: usize, random: &mut Random) -> ContactSet {
    (0..count).filter(|_| random.chance(60)).collect()
}

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
            if solver.torque_certainty()[dof] == Certainty::Determined {
                prop_assert!(
                    (solver.torque()[dof] - scene.torque[dof]).abs()
                        < EXACT * scale * amplification(&solver)
                );
            }
        }
        for (got, truth) in solver.contacts().iter().zip(&scene.truth) {
            prop_assert_ne!(got.certainty, Certainty::Absent);
            if got.certainty == Certainty::Determined {
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
                .all(|&certainty| certainty == Certainty::Determined)
        );
        prop_assert!(gap(solver.torque(), &scene.torque) < EXACT * scale);
        for (got, truth) in solver.contacts().iter().zip(&scene.truth) {
            prop_assert_eq!(got.certainty, Certainty::Determined);
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
                let own = if number == which { difference } else { Wrench::zero() };
                errors.extend((a.wrench - b.wrench - own).force_first().map(|x| x / STEP));
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
            let of = |contact: usize| if contact == which { std } else { PlaceStd::default() };
            stated.update(&structure, &before, &kinematics, of).expect("solved");
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
            let own = random.pose();
            let cases = [
                (MeasurementFrame::Child, place(child)),
                (MeasurementFrame::Parent, place(parent)),
                (MeasurementFrame::Sensor, place(child) * own),
            ];
            for (frame, x_bm) in cases {
                for (direction, sign) in [
                    (MeasurementDirection::ChildToParent, -1.0),
                    (MeasurementDirection::ParentToChild, 1.0),
                ] {
                    let cut =
                        SensorCut::new(&model, joint, frame, direction, &own, &noise).unwrap();
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
    /// known wrenches; nothing of the other side enters. It exists exactly where no present contact
    /// acts on that side. Its standard deviation is that of its linear map from readings, and
    /// `torque` equals it where it uses one side.
    #[test]
    fn each_side_uses_only_its_own_links_and_sensors((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 7);
        let mut scene = Scene::new(links, seed, 3);
        let structure = scene.structure();
        let active = active_some(scene.contacts.len(), &mut random);
        let exact = scene.solve(&structure, &scene.all());
        let scale = scene.size();
        for dof in 0..scene.model.dof_count() {
            let Sides { child, parent } = exact.sides(&structure, dof).unwrap();
            for side in [child, parent].into_iter().flatten() {
                prop_assert!(
                    (side.torque - scene.torque[dof]).abs() < EXACT * scale,
                    "readings of the truth tell it"
                );
            }
        }
        scene.disturb(&mut random);
        let solver = scene.solve(&structure, &active);
        let scale = scene.size();
        for dof in 0..scene.model.dof_count() {
            let sides = solver.sides(&structure, dof).unwrap();
            let own = [true, false].map(|below| scene.side(&structure, dof, below, &active));
            for (side, own) in [sides.child, sides.parent].into_iter().zip(&own) {
                prop_assert_eq!(side.is_some(), own.is_free, "dof {}", dof);
                let Some(side) = side else { continue };
                prop_assert!(
                    (side.torque - own.torque).abs() < EXACT * scale,
                    "{} {}",
                    side.torque,
                    own.torque
                );
                prop_assert!(
                    (side.deviation - own.deviation).abs() < EXACT * scale,
                    "{} {}",
                    side.deviation,
                    own.deviation
                );
                prop_assert_eq!(side.sensors, own.sensors);
            }
            let (torque, deviation) = (solver.torque()[dof], solver.torque_deviation()[dof]);
            match structure.route(dof, &active).unwrap() {
                Route::Child => prop_assert_eq!(sides.child.unwrap().torque, torque),
                Route::Parent => prop_assert_eq!(sides.parent.unwrap().torque, torque),
                Route::Fused => {
                    for side in [sides.child.unwrap(), sides.parent.unwrap()] {
                        prop_assert!(deviation <= side.deviation * (1.0 + 1e-9));
                    }
                }
                Route::Whole => prop_assert_eq!(sides, Sides::default()),
            }
            match (sides.disagreement(), &own) {
                (
                    Some(Disagreement {
                        difference,
                        deviation,
                    }),
                    [child, parent],
                ) => {
                    prop_assert!(
                        (difference - (child.torque - parent.torque)).abs() < 2.0 * EXACT * scale
                    );
                    prop_assert!(
                        (deviation.powi(2) - child.deviation.powi(2) - parent.deviation.powi(2))
                            .abs()
                            < EXACT * scale
                    );
                }
                (None, [child, parent]) => {
                    let comparable = child.is_free
                        && parent.is_free
                        && !child.sensors.union(&parent.sensors).is_empty();
                    prop_assert!(!comparable);
                }
            }
        }
    }

    /// A wrong reading affects only the side of its sensor; so a large disagreement shows that one
    /// of the two is wrong.
    #[test]
    fn a_wrong_reading_stays_on_its_side((links, seed) in robots()) {
        let mut random = Random::new(seed ^ 8);
        let mut scene = Scene::new(links, seed, 2);
        let structure = scene.structure();
        let active = active_some(scene.contacts.len(), &mut random);
        let before = scene.solve(&structure, &active);
        for sensor in 0..scene.sensors.len() {
            let old = scene.readings[sensor];
            scene.readings[sensor] += random.wrench();
            let (after, scale) = (scene.solve(&structure, &active), scene.size());
            for dof in 0..scene.model.dof_count() {
                let [a, b] = [&before, &after].map(|solver| solver.sides(&structure, dof).unwrap());
                for (a, b) in [(a.child, b.child), (a.parent, b.parent)] {
                    let (Some(a), Some(b)) = (a, b) else { continue };
                    let change = (a.torque - b.torque).abs();
                    if a.sensors.contains(sensor) {
                        prop_assert!(change > 1e-9, "dof {} does not feel sensor {}", dof, sensor);
                    } else {
                        prop_assert!(change < EXACT * scale, "dof {} feels sensor {}", dof, sensor);
                    }
                    prop_assert_eq!((a.deviation, a.sensors), (b.deviation, b.sensors));
                }
            }
            scene.readings[sensor] = old;
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
        for dof in 0..scene.model.dof_count() {
            let (a, b) = (
                before.sides(&structure, dof).unwrap(),
                after.sides(&other, dof).unwrap(),
            );
            prop_assert_eq!(a, again.sides(&structure, dof).unwrap());
            for (a, b) in [(a.child, b.child), (a.parent, b.parent)] {
                prop_assert_eq!(a.is_some(), b.is_some());
                let (Some(a), Some(b)) = (a, b) else { continue };
                prop_assert!(
                    (a.torque - b.torque).abs() < EXACT * scale
                        && (a.deviation - b.deviation).abs() < EXACT
                );
                prop_assert_eq!(a.sensors, b.sensors.iter().map(|k| order[k]).collect());
            }
        }
    }
}

/// The rotation vector of a small rotation (the angle from its sine: an arc cosine would lose half
/// of the digits).
fn small_turn(r: &Mat3) -> Vec3 {
    let v = Vec3::new(
        r[(2, 1)] - r[(1, 2)],
        r[(0, 2)] - r[(2, 0)],
        r[(1, 0)] - r[(0, 1)],
    ) / 2.0;
    let sine = v.norm();
    if sine == 0.0 {
        v
    } else {
        v * (sine.asin() / sine)
    }
}

/// Ratio of the greatest deviation to the noise of one sensor: where contacts are nearly dependent,
/// rounding errors grow as noise does.
fn amplification(solver: &Solver) -> f64 {
    let mut most = 1.0_f64;
    for contact in solver.contacts() {
        most = contact
            .deviation
            .iter()
            .fold(most, |most, &x| most.max(x / 0.05));
        // Without sensors there are no deviations; the forces are used instead.
        most = contact
            .wrench
            .force_first()
            .iter()
            .fold(most, |most, &x| most.max(x.abs() / 1e3));
    }
    most
}

fn deviations_of(sensor: &SensorCut) -> [f64; 6] {
    let noise = sensor.noise();
    [
        noise.force[0],
        noise.force[1],
        noise.force[2],
        noise.torque[0],
        noise.torque[1],
        noise.torque[2],
    ]
}

// ---------------------------------------------------------------- particular cases

/// A chain of `count` links whose joints are those of a random robot, with F/T sensors in the
/// joints named.
fn chain(joints: &[(&str, &str)]) -> Model {
    let mut text = String::from("<robot name=\"chain\">");
    let inertial = "<inertial><origin xyz=\"0.01 0.02 0.1\"/><mass value=\"1.5\"/>\
                    <inertia ixx=\"0.02\" ixy=\"0\" ixz=\"0\" iyy=\"0.03\" iyz=\"0\" \
                    izz=\"0.04\"/></inertial>";
    for link in 0..=joints.len() {
        text += &format!("<link name=\"link{link}\">{inertial}</link>");
    }
    for (index, (name, kind)) in joints.iter().enumerate() {
        let axis = ["1 0 0", "0 1 0", "0 0.6 0.8"][index % 3];
        text += &format!(
            "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"link{index}\"/>\
             <child link=\"link{}\"/>\
             <origin xyz=\"0.02 -0.01 0.25\" rpy=\"0.1 0.2 0.3\"/><axis xyz=\"{axis}\"/></joint>",
            index + 1
        );
    }
    text += "</robot>";
    let keep: Vec<&str> = joints
        .iter()
        .filter(|(_, kind)| *kind == "fixed")
        .map(|(name, _)| *name)
        .collect();
    Model::from_urdf(&text, &keep).expect("valid")
}

fn child_sensor(model: &Model, joint: &str, force: f64, torque: f64) -> SensorCut {
    let noise = Noise {
        force: [force; 3],
        torque: [torque; 3],
    };
    SensorCut::new(
        model,
        joint,
        MeasurementFrame::Child,
        MeasurementDirection::ChildToParent,
        &Pose::identity(),
        &noise,
    )
    .unwrap()
}

fn leg() -> Model {
    chain(&[
        ("hip_ft", "fixed"),
        ("knee", "continuous"),
        ("ankle", "continuous"),
        ("foot_ft", "fixed"),
        ("toe", "continuous"),
    ])
}

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
                .all(|contact| contact.certainty == Certainty::Assumed)
        );
        assert_eq!(
            both.torque_certainty()[model.dof("wrist").unwrap()],
            Certainty::Assumed
        );
        assert_eq!(
            both.torque_certainty()[model.dof("elbow").unwrap()],
            Certainty::Determined,
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
    let sets: Vec<(&str, Vec<ContactSpec>, usize, Certainty)> = vec![
        (
            "the same wrench twice",
            vec![at(ContactKind::Wrench, 0.0); 2],
            0,
            Certainty::Assumed,
        ),
        (
            "a force and a wrench at one place",
            vec![at(ContactKind::Wrench, 0.0), at(ContactKind::Force, 0.0)],
            0,
            Certainty::Assumed,
        ),
        (
            "two forces: what they do to each other along their line is not seen",
            vec![at(ContactKind::Force, 0.0), at(ContactKind::Force, 0.2)],
            1,
            Certainty::Assumed,
        ),
        (
            "the same direction along one line",
            vec![along(0.0), along(0.3)],
            5,
            Certainty::Assumed,
        ),
        (
            "one force",
            vec![at(ContactKind::Force, 0.1)],
            3,
            Certainty::Determined,
        ),
        ("one direction", vec![along(0.0)], 5, Certainty::Determined),
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
                        .all(|contact| contact.certainty == Certainty::Assumed),
                    "{name}"
                );
            }
            let none = scene.solve(&structure, &ContactSet::EMPTY);
            assert!(
                none.contacts()
                    .iter()
                    .all(|contact| contact.certainty == Certainty::Absent
                        && contact.wrench == Wrench::zero())
            );
            if sensors.is_empty() {
                assert!(
                    none.torque_certainty()
                        .iter()
                        .all(|&certainty| certainty == Certainty::Assumed)
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

/// Many draws of noise: the spread of both sides, of their difference, of the fused torque and of
/// chi-square is the computed one.
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
    let mut squares = [[0.0; 4]; 2];
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
        for (dof, squares) in squares.iter_mut().enumerate() {
            let sides = drawn.sides(&structure, dof).unwrap();
            let (truth, apart) = (scene.torque[dof], sides.disagreement().unwrap());
            let errors = [
                sides.child.unwrap().torque - truth,
                sides.parent.unwrap().torque - truth,
                apart.difference,
                drawn.torque()[dof] - truth,
            ];
            for (sum, error) in squares.iter_mut().zip(errors) {
                *sum += error * error / DRAWS as f64;
            }
        }
        solver = Some(drawn);
    }
    let solver = solver.unwrap();
    // A mean square of 4000 draws is within 2.2 % of its expectation one time in two to three (1 /
    // sqrt(2000)), and within four times that almost always.
    let near =
        |mean_square: f64, deviation: f64| (mean_square / deviation.powi(2) - 1.0).abs() < 0.09;
    for (dof, squares) in squares.iter().enumerate() {
        let sides = solver.sides(&structure, dof).unwrap();
        let announced = [
            sides.child.unwrap().deviation,
            sides.parent.unwrap().deviation,
            sides.disagreement().unwrap().deviation,
            solver.torque_deviation()[dof],
        ];
        for (square, deviation) in squares.iter().zip(announced) {
            assert!(
                near(*square, deviation),
                "dof {dof}: {} {deviation}",
                square.sqrt()
            );
        }
    }
    assert_eq!(solver.balances()[number].degrees, 6);
    assert!(near(chi_square, 6.0_f64.sqrt()), "{chi_square}");
}

/// There are no sides before a solution or for a degree of freedom that does not exist.
#[test]
fn sides_of_nothing() {
    let model = leg();
    let sensors = vec![child_sensor(&model, "hip_ft", 0.2, 0.004)];
    let scene = Scene::with(
        model.clone(),
        sensors.clone(),
        vec![],
        vec![],
        &mut Random::new(22),
    );
    let structure = scene.structure();
    assert_eq!(
        Solver::new(&structure).sides(&structure, 0),
        Ok(Sides::default())
    );
    let solver = scene.solve(&structure, &ContactSet::EMPTY);
    assert_eq!(solver.sides(&structure, 99), Ok(Sides::default()));
    let other = Structure::new(&model, &[], &[], 0.1).unwrap();
    assert!(solver.sides(&other, 0).is_err());
    // Beyond the hip's sensor all links are free: the model alone from the child's side, the sensor
    // from the parent's.
    let Sides { child, parent } = solver.sides(&structure, 0).unwrap();
    let (child, parent) = (child.unwrap(), parent.unwrap());
    assert!(child.sensors.is_empty() && child.deviation == 0.0);
    assert!(parent.sensors.contains(0) && parent.deviation > 0.0);
    assert_eq!(
        solver
            .sides(&structure, 0)
            .unwrap()
            .disagreement()
            .unwrap()
            .deviation,
        parent.deviation
    );
    // No sensor at all: two sides without measurements have no disagreement.
    let bare = Scene::with(model, vec![], vec![], vec![], &mut Random::new(23));
    let sides = bare
        .solve(&other, &ContactSet::EMPTY)
        .sides(&other, 0)
        .unwrap();
    assert!(sides.child.is_some() && sides.parent.is_some() && sides.disagreement().is_none());
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
            assert_eq!(solver.contacts()[0].certainty, Certainty::Determined);
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
        (ContactKind::Force, 1, "0.2 0.7 0.3", Certainty::Determined),
        (
            ContactKind::Force,
            1,
            "0.2 0.7 0.3000001",
            Certainty::Assumed,
        ),
        (
            ContactKind::ForceAlong(u),
            5,
            "0.2 0.7 0.3",
            Certainty::Determined,
        ),
        (
            ContactKind::ForceAlong(u),
            5,
            "0.2 0.7 0.3000001",
            Certainty::Assumed,
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
                .all(|contact| contact.certainty == Certainty::Assumed)
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
                .all(|contact| contact.certainty == Certainty::Assumed)
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

// ---------------------------------------------------------------- golden files

mod golden {
    use super::*;
    use std::path::PathBuf;

    const NEAR: f64 = 1e-9;

    fn folder() -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..")
    }

    /// The arm of the golden files, with its sensor as the URDF describes it.
    fn arm() -> (Model, SensorCut) {
        let model = Model::from_file(
            &folder().join("config/icub_left_arm/model.urdf"),
            &["l_arm_ft_sensor"],
        )
        .unwrap();
        assert_eq!(model.warnings(), &[] as &[String]);
        let element = model.sensors()[0].clone();
        let noise = Noise {
            force: [0.08, 0.09, 0.18],
            torque: [0.002, 0.003, 0.0015],
        };
        let cut = SensorCut::new(
            &model,
            &element.joint,
            element.frame,
            element.direction,
            &element.pose,
            &noise,
        )
        .unwrap();
        (model, cut)
    }

    /// Columns of a log by name, and its rows.
    struct Log(Vec<String>, Vec<Vec<f64>>);

    impl Log {
        fn read(name: &str) -> Self {
            let mut reader =
                csv::Reader::from_path(folder().join("tests/oracle").join(name)).unwrap();
            let names = reader
                .headers()
                .unwrap()
                .iter()
                .map(str::to_owned)
                .collect();
            let rows = reader
                .records()
                .map(|row| {
                    row.unwrap()
                        .iter()
                        .map(|cell| cell.parse().unwrap())
                        .collect()
                })
                .collect();
            Self(names, rows)
        }

        fn get<const N: usize>(&self, row: usize, columns: [&str; N]) -> [f64; N] {
            columns
                .map(|column| self.1[row][self.0.iter().position(|name| name == column).unwrap()])
        }

        fn wrench(&self, row: usize, name: &str) -> Wrench {
            let [f, t] = ["f", "t"].map(|kind| {
                ["x", "y", "z"].map(|axis| self.get(row, [&format!("{name}/{kind}{axis}")])[0])
            });
            Wrench::from_parts(f, t)
        }

        fn vector(&self, row: usize, name: &str) -> Vec3 {
            Vec3::from(["x", "y", "z"].map(|axis| self.get(row, [&format!("{name}{axis}")])[0]))
        }

        fn joints(&self, row: usize, model: &Model, what: &str) -> Vec<f64> {
            (0..model.dof_count())
                .map(|dof| self.get(row, [&format!("joint/{}/{what}", model.dof_name(dof))])[0])
                .collect()
        }

        /// Largest magnitude over the file, per kind of quantity, as in the limits of the golden
        /// files.
        fn largest(&self, ends: &[&str]) -> f64 {
            let wanted = |name: &str| ends.iter().any(|end| name.ends_with(end));
            let columns = self
                .0
                .iter()
                .enumerate()
                .filter(|(_, name)| wanted(name))
                .map(|(index, _)| index);
            columns
                .flat_map(|index| self.1.iter().map(move |row| row[index].abs()))
                .fold(0.0, f64::max)
        }
    }

    /// Both logs, from the fixed chest and from the IMU: predictions agree with MuJoCo, and the
    /// torques and the contact are recovered from MuJoCo's readings.
    #[test]
    fn arm_on_a_fixed_chest() {
        let (model, cut) = arm();
        let chest = model.frame("chest").unwrap();
        let hand = ContactSpec {
            frame: model.frame("l_hand").unwrap(),
            kind: ContactKind::Wrench,
            position: Vec3::new(0.0, 0.0, 0.1),
        };
        let base = ContactSpec {
            frame: chest,
            kind: ContactKind::Wrench,
            position: Vec3::zeros(),
        };
        let structure =
            Structure::new(&model, &[cut], &[hand, base], Structure::LENGTH_SCALE).unwrap();
        let mut solver = Solver::new(&structure);
        let imu = model.frame("chest_imu_frame").unwrap();
        for (name, touched) in [
            ("icub_left_arm_mujoco.csv", false),
            ("icub_left_arm_mujoco_contact.csv", true),
        ] {
            let log = Log::read(name);
            assert_eq!(log.1.len(), 201);
            let torque_limit = NEAR * log.largest(&["/torque"]);
            let force_limit = NEAR * log.largest(&["/fx", "/fy", "/fz"]);
            let moment_limit = NEAR * log.largest(&["/tx", "/ty", "/tz"]);
            let agree = |a: &Wrench, b: &Wrench| {
                (a.force - b.force).amax() < force_limit
                    && (a.torque - b.torque).amax() < moment_limit
            };
            for row in 0..log.1.len() {
                let state = State(
                    ["position", "velocity", "acceleration"]
                        .map(|what| log.joints(row, &model, what)),
                );
                let measured = FrameMotion {
                    angular_velocity: log.vector(row, "imu/chest_imu/g"),
                    angular_acceleration: log.vector(row, "imu/chest_imu/al"),
                    proper_acceleration: log.vector(row, "imu/chest_imu/a"),
                };
                let standing = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.80665));
                let contact = if touched {
                    log.wrench(row, "contact/hand")
                } else {
                    Wrench::zero()
                };
                let reading = log.wrench(row, "wrench/l_arm_ft_sensor");
                let expected = log.joints(row, &model, "torque");
                for motion in [
                    standing,
                    FrameMotion::of_link_from_imu(&measured, &imu.pose),
                ] {
                    let kinematics = kinematics(&model, chest.link, &state, &motion);
                    let acting = [ExternalWrench {
                        frame: hand.frame,
                        wrench: contact,
                    }];
                    let inverse = inverse(&model, &kinematics, &acting);
                    assert!(
                        gap(inverse.torque(), &expected) < torque_limit,
                        "{name} {row}"
                    );
                    assert!(
                        agree(
                            &cut.reading(&inverse.transmitted(&kinematics, cut.joint())),
                            &reading
                        ),
                        "{name} {row}"
                    );
                    let felt = kinematics.frame_motion(&imu);
                    assert!(
                        (felt.proper_acceleration - measured.proper_acceleration).amax()
                            < NEAR * 10.0
                    );
                    solver
                        .solve(
                            &model,
                            &structure,
                            &kinematics,
                            &[reading],
                            &ContactSet::first(2),
                            &[],
                        )
                        .unwrap();
                    assert!(
                        gap(solver.torque(), &expected) < torque_limit,
                        "{name} {row}"
                    );
                    assert!(
                        agree(&solver.contacts()[0].wrench, &contact),
                        "{name} {row}"
                    );
                }
            }
        }
    }

    fn list(value: &serde_json::Value) -> Vec<f64> {
        value
            .as_array()
            .expect("a list")
            .iter()
            .map(|x| x.as_f64().expect("a number"))
            .collect()
    }

    fn vector(value: &serde_json::Value) -> Vec3 {
        Vec3::from_row_slice(&list(value))
    }

    fn force_first(value: &serde_json::Value) -> Wrench {
        let v = list(value);
        Wrench::from_parts([v[0], v[1], v[2]], [v[3], v[4], v[5]])
    }

    /// 30 random states of the arm on a moving chest, by Pinocchio.
    #[test]
    fn arm_on_a_moving_chest() {
        let (model, cut) = arm();
        let text =
            std::fs::read_to_string(folder().join("tests/oracle/icub_left_arm_moving_base.json"))
                .unwrap();
        let golden: serde_json::Value = serde_json::from_str(&text).unwrap();
        let cases = golden["cases"].as_array().unwrap();
        assert_eq!(cases.len(), 30);
        let names: Vec<_> = golden["joints"]
            .as_array()
            .unwrap()
            .iter()
            .map(|name| name.as_str().unwrap())
            .collect();
        assert_eq!(
            names,
            (0..7).map(|dof| model.dof_name(dof)).collect::<Vec<_>>(),
            "dofs are numbered as the URDF lists them"
        );
        let chest = model.frame("chest").unwrap();
        let imu = model.frame("chest_imu_frame").unwrap();
        for case in cases {
            let state =
                State(["position", "velocity", "acceleration"].map(|what| list(&case[what])));
            let motion_of = |prefix: &str| FrameMotion {
                angular_velocity: vector(&case[format!("{prefix}_angular_velocity")]),
                angular_acceleration: vector(&case[format!("{prefix}_angular_acceleration")]),
                proper_acceleration: vector(&case[format!("{prefix}_proper_acceleration")]),
            };
            let from_imu = FrameMotion::of_link_from_imu(&motion_of("imu"), &imu.pose);
            for motion in [motion_of("base"), from_imu] {
                let kinematics = kinematics(&model, chest.link, &state, &motion);
                let inverse = inverse(&model, &kinematics, &[]);
                let expected = list(&case["torque"]);
                assert!(gap(inverse.torque(), &expected) < NEAR * size(&expected));
                let (reading, base) = (force_first(&case["ft"]), force_first(&case["base_wrench"]));
                let got = cut.reading(&inverse.transmitted(&kinematics, cut.joint()));
                assert!(wrench_gap(&got, &reading) < NEAR * size(&reading.force_first()));
                assert!(
                    wrench_gap(&inverse.base_wrench(), &base) < NEAR * size(&base.force_first())
                );
            }
        }
    }

    /// A whole iCub (32 joints, 6 F/T sensors, 7 sub-trees, one full wrench in each, kinematics
    /// from the chest's IMU) as iDynTree solves it.
    ///
    /// The robot's URDF may not be redistributed here, so the test runs only where it is available:
    /// `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of the PyPI package
    /// icub-models 3.2.0), `PROPRIO_DATA` that of the recorded logs, beside which the golden file
    /// is.
    #[test]
    fn whole_icub_as_idyntree_has_it() {
        let (Ok(models), Ok(data)) = (
            std::env::var("PROPRIO_ICUB_MODELS"),
            std::env::var("PROPRIO_DATA"),
        ) else {
            println!(
                "skipped: PROPRIO_ICUB_MODELS and PROPRIO_DATA do not say where the robot and the \
                 golden file are"
            );
            return;
        };
        let golden = PathBuf::from(data).join("../oracle/icub_v25_idyntree.json");
        let Ok(golden) = std::fs::read_to_string(&golden) else {
            println!("skipped: there is no {}", golden.display());
            return;
        };
        let golden: serde_json::Value = serde_json::from_str(&golden).unwrap();
        let names = |key: &str| -> Vec<String> {
            golden[key]
                .as_array()
                .unwrap()
                .iter()
                .map(|name| name.as_str().unwrap().to_owned())
                .collect()
        };
        let text =
            std::fs::read_to_string(PathBuf::from(models).join("iCubGazeboV2_5.urdf")).unwrap();
        let elements = Model::from_urdf(&text, &[]).unwrap().sensors().to_vec();
        let sensors: Vec<_> = names("ft")
            .iter()
            .map(|name| {
                elements
                    .iter()
                    .find(|element| element.name == *name)
                    .unwrap()
                    .clone()
            })
            .collect();
        let keep: Vec<&str> = sensors
            .iter()
            .map(|element| element.joint.as_str())
            .collect();
        let model = Model::from_urdf(&text, &keep).unwrap();
        let noise = Noise {
            force: [0.1; 3],
            torque: [0.003; 3],
        };
        let cuts: Vec<_> = sensors
            .iter()
            .map(|s| {
                SensorCut::new(&model, &s.joint, s.frame, s.direction, &s.pose, &noise).unwrap()
            })
            .collect();
        assert_eq!(names("dofs").len(), model.dof_count());
        for case in golden["cases"].as_array().unwrap() {
            let contact_names: Vec<&String> = case["ext"].as_object().unwrap().keys().collect();
            let contacts: Vec<_> = contact_names
                .iter()
                .map(|name| ContactSpec {
                    frame: model.frame(name).unwrap(),
                    kind: ContactKind::Wrench,
                    position: Vec3::zeros(),
                })
                .collect();
            let structure =
                Structure::new(&model, &cuts, &contacts, Structure::LENGTH_SCALE).unwrap();
            assert_eq!(structure.subtrees().len(), 7);
            let by_name = |values: &serde_json::Value| {
                let (names, values) = (names("dofs"), list(values));
                (0..model.dof_count())
                    .map(|dof| values[names.iter().position(|n| n == model.dof_name(dof)).unwrap()])
                    .collect::<Vec<_>>()
            };
            let state = State(["q", "dq", "ddq"].map(|what| by_name(&case[what])));
            let frame = model.frame(case["imu_frame"].as_str().unwrap()).unwrap();
            let measured = FrameMotion {
                angular_velocity: vector(&case["omega"]),
                angular_acceleration: vector(&case["alpha"]),
                proper_acceleration: vector(&case["acc"]),
            };
            let kinematics = kinematics(
                &model,
                frame.link,
                &state,
                &FrameMotion::of_link_from_imu(&measured, &frame.pose),
            );
            let readings: Vec<_> = case["ft"]
                .as_array()
                .unwrap()
                .iter()
                .map(force_first)
                .collect();
            let mut solver = Solver::new(&structure);
            solver
                .solve(
                    &model,
                    &structure,
                    &kinematics,
                    &readings,
                    &ContactSet::first(contacts.len()),
                    &[],
                )
                .unwrap();
            let expected = by_name(&case["tau"]);
            assert!(
                gap(solver.torque(), &expected) < NEAR * size(&expected),
                "{}",
                gap(solver.torque(), &expected)
            );
            for (contact, name) in solver.contacts().iter().zip(&contact_names) {
                let expected = force_first(&case["ext"][name.as_str()]);
                assert!(
                    wrench_gap(&contact.wrench, &expected) < NEAR * 300.0,
                    "{name}"
                );
            }
        }
    }
}

/// A base changed between two updates, in every kind of robot: all results are at once those of a
/// constant base.
#[test]
fn a_new_base_holds_at_once() {
    let mut random = Random::new(31);
    for links in [1, 2, 7, 25] {
        let robot = RandomRobot::new(links, &mut random);
        let model = robot.model();
        let state = State::new(&model, &mut random);
        let first = random.below(model.link_count());
        let mut changed = kinematics(&model, first, &state, &motion(&mut random));
        for _ in 0..3 {
            let second = random.below(model.link_count());
            let fresh = kinematics(&model, second, &state, changed.motion(second));
            changed.set_base(&model, second).unwrap();
            assert_eq!(changed.base(), second);
            let size = size(
                &fresh
                    .net_wrenches()
                    .iter()
                    .flat_map(Wrench::force_first)
                    .collect::<Vec<_>>(),
            );
            for link in 0..model.link_count() {
                let (got, want) = (changed.pose(link), fresh.pose(link));
                assert!(
                    (got.rotation - want.rotation).amax() < EXACT
                        && (got.translation - want.translation).amax() < EXACT
                );
                let gap = wrench_gap(&changed.net_wrenches()[link], &fresh.net_wrenches()[link]);
                assert!(gap < EXACT * size, "{gap}");
            }
            let (a, b) = (inverse(&model, &changed, &[]), inverse(&model, &fresh, &[]));
            assert!(gap(a.torque(), b.torque()) < EXACT * size);
            assert!(wrench_gap(&a.base_wrench(), &b.base_wrench()) < EXACT * size);
        }
    }
}

/// The same number of links but other joints: refused, not computed with the data of another model.
#[test]
fn a_model_with_other_joints_is_refused() {
    use proprio_dynamics::DynamicsError;
    let (moving, kept) = (
        chain(&[("a", "revolute"), ("b", "prismatic")]),
        chain(&[("a", "revolute"), ("b", "fixed")]),
    );
    assert_eq!(moving.link_count(), kept.link_count());
    let state = State([vec![0.1; 2], vec![0.0; 2], vec![0.0; 2]]);
    let still = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.81));
    let mut kinematics = Kinematics::new(&kept, 0).unwrap();
    let refused = DynamicsError::Size {
        what: "degrees of freedom of the model",
        got: 2,
        expected: 1,
    };
    assert_eq!(
        kinematics.update(&moving, state.get(), &still),
        Err(refused)
    );
    assert_eq!(kinematics.set_base(&moving, 1), Err(refused));
}
