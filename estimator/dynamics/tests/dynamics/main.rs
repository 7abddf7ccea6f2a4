//! Dynamics as identities between two computations, on random robots of 1 to 40 links with all
//! joint types, cuts and bases; and comparison with golden files.

mod cases;
#[path = "../common/mod.rs"]
mod common;
mod golden;
mod identities;

use common::{
    Random, RandomRobot, State, contact, external, gap, joint_axis, motion, size, twists,
    wrench_gap,
};
use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::spatial::{Mat3, Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSet, ContactSpec, Determinacy, ExternalWrench, FrameMotion,
    InverseDynamics, Kinematics, Noise, PlaceErrors, PlaceStd, Route, SensorCut, SensorSet, Solver,
    Structure,
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
        let contacts = self.contacts.iter().zip(&self.truth);
        acting.extend(contacts.map(|(spec, wrench)| external(spec, *wrench)));
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
