//! Random robots and states for the tests of model and dynamics: all are generated from a size and
//! a seed.

#![allow(dead_code, reason = "each test program uses its own part")]

use std::fmt::Write as _;

use nalgebra::DMatrix;
use proprio_dynamics::model::{
    Frame, Joint, JointKind, MeasurementDirection, MeasurementFrame, Model,
};
use proprio_dynamics::spatial::{Motion, Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    ContactKind, ContactSpec, ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics,
    Noise, SensorCut,
};

/// SplitMix64: small, and the same on every machine.
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn word(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Between -size and size.
    pub(crate) fn real(&mut self, size: f64) -> f64 {
        ((self.word() >> 11) as f64 / (1_u64 << 53) as f64).mul_add(2.0, -1.0) * size
    }

    pub(crate) fn below(&mut self, count: usize) -> usize {
        (self.word() % count as u64) as usize
    }

    pub(crate) fn chance(&mut self, percent: usize) -> bool {
        self.below(100) < percent
    }

    pub(crate) fn triple(&mut self, size: f64) -> [f64; 3] {
        [self.real(size), self.real(size), self.real(size)]
    }

    pub(crate) fn vector(&mut self, size: f64) -> Vec3 {
        Vec3::from(self.triple(size))
    }

    pub(crate) fn reals(&mut self, count: usize, size: f64) -> Vec<f64> {
        (0..count).map(|_| self.real(size)).collect()
    }

    pub(crate) fn wrench(&mut self) -> Wrench {
        Wrench {
            torque: self.vector(5.0),
            force: self.vector(50.0),
        }
    }

    pub(crate) fn pose(&mut self) -> Pose {
        Pose::from_xyz_rpy(self.triple(0.3), self.triple(3.1))
    }

    pub(crate) fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }

    pub(crate) fn frame(&mut self, model: &Model) -> Frame {
        Frame {
            link: self.below(model.link_count()),
            pose: self.pose(),
        }
    }
}

/// A robot as text, in parts, so that a test can reorder them.
pub(crate) struct RandomRobot {
    pub(crate) links: Vec<String>,
    pub(crate) joints: Vec<String>,
    /// Names of the fixed joints chosen to carry F/T sensors.
    pub(crate) cuts: Vec<String>,
}

impl RandomRobot {
    /// A tree of `count` links with joints of all types; about half of the fixed joints carry an
    /// F/T sensor.
    pub(crate) fn new(count: usize, random: &mut Random) -> Self {
        let (mut links, mut joints, mut cuts) = (Vec::new(), Vec::new(), Vec::new());
        for link in 0..count {
            let mass = 0.2 + random.real(0.1).abs() * 20.0;
            // Principal moments of three point masses on the axes: always physically consistent.
            let [a, b, c] = [0; 3].map(|_| mass * (0.001 + random.real(0.05).powi(2)));
            let (xyz, rpy) = (random.triple(0.1), random.triple(3.0));
            links.push(format!(
                "<link name=\"link{link}\"><inertial><origin xyz=\"{}\" rpy=\"{}\"/>\
                 <mass value=\"{mass:e}\"/>\
                 <inertia ixx=\"{:e}\" ixy=\"0\" ixz=\"0\" iyy=\"{:e}\" iyz=\"0\" izz=\"{:e}\"/>\
                 </inertial></link>",
                join(xyz),
                join(rpy),
                b + c,
                a + c,
                a + b,
            ));
            if link == 0 {
                continue;
            }
            // Mostly chains, with branches.
            let parent = if random.chance(60) {
                link - 1
            } else {
                random.below(link)
            };
            let kind =
                ["revolute", "revolute", "continuous", "prismatic", "fixed"][random.below(5)];
            let axis = match random.below(4) {
                0 => [0.0, 0.0, if random.chance(50) { 1.0 } else { -1.0 }],
                1 => [0.0, 1.0, 0.0],
                2 => [-1.0, 0.0, 0.0],
                _ => random.triple(1.0).map(|x| x + 0.1),
            };
            let name = format!("joint{link}");
            if kind == "fixed" && random.chance(50) {
                cuts.push(name.clone());
            }
            joints.push(format!(
                "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"link{parent}\"/>\
                 <child link=\"link{link}\"/>\
                 <origin xyz=\"{}\" rpy=\"{}\"/><axis xyz=\"{}\"/>\
                 <limit lower=\"-3\" upper=\"3\" effort=\"1\" velocity=\"1\"/></joint>",
                join(random.triple(0.3)),
                join(random.triple(3.1)),
                join(axis),
            ));
        }
        Self {
            links,
            joints,
            cuts,
        }
    }

    pub(crate) fn urdf(&self) -> String {
        let mut text = String::from("<robot name=\"random\">");
        for part in self.links.iter().chain(&self.joints) {
            let _ = writeln!(text, "{part}");
        }
        text + "</robot>"
    }

    pub(crate) fn model(&self) -> Model {
        let keep: Vec<&str> = self.cuts.iter().map(String::as_str).collect();
        Model::from_urdf(&self.urdf(), &keep).expect("a random robot is a valid one")
    }

    /// One sensor per cut, with random frame, direction and noise.
    pub(crate) fn sensors(&self, model: &Model, random: &mut Random) -> Vec<SensorCut> {
        self.cuts
            .iter()
            .map(|joint| {
                let frame = [
                    MeasurementFrame::Child,
                    MeasurementFrame::Parent,
                    MeasurementFrame::Sensor,
                ][random.below(3)];
                let direction = [
                    MeasurementDirection::ChildToParent,
                    MeasurementDirection::ParentToChild,
                ][random.below(2)];
                let noise = Noise {
                    force: random.triple(0.1).map(|x| x.abs() + 0.05),
                    torque: random.triple(0.005).map(|x| x.abs() + 0.002),
                };
                SensorCut::new(model, joint, frame, direction, &random.pose(), &noise)
                    .expect("a kept fixed joint")
            })
            .collect()
    }
}

/// Writes link number `link`, with a mass of one kilogram, and its joint of this `kind` if it has a
/// parent.
pub(crate) fn write_link(
    text: &mut String,
    link: usize,
    parent: Option<usize>,
    kind: &str,
    [x, y, z]: [f64; 3],
) {
    let _ = write!(
        text,
        "<link name=\"link{link}\"><inertial><origin xyz=\"{x} {y} {z}\" rpy=\"0 0 0\"/>\
         <mass value=\"1\"/>\
         <inertia ixx=\"0.01\" ixy=\"0\" ixz=\"0\" iyy=\"0.012\" iyz=\"0\" izz=\"0.015\"/>\
         </inertial></link>"
    );
    if let Some(parent) = parent {
        let axis = ["1 0 0", "0 1 0", "0 0 -1"][link % 3];
        let _ = write!(
            text,
            "<joint name=\"joint{link}\" type=\"{kind}\"><parent link=\"link{parent}\"/>\
             <child link=\"link{link}\"/>\
             <origin xyz=\"{y} {z} {x}\" rpy=\"{x} {y} {z}\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-3\" upper=\"3\" effort=\"1\" velocity=\"1\"/></joint>"
        );
    }
}

/// The tree of an iCub, 39 links and 32 joints, as text, and the joints of its six F/T sensors:
/// torso and head of three joints, arms of seven with a sensor after three, legs of six with
/// sensors after two and at the foot.
pub(crate) fn humanoid() -> (String, Vec<String>) {
    let mut random = Random::new(2015);
    let (mut text, mut sensors, mut links) =
        (String::from("<robot name=\"generated\">"), Vec::new(), 0);
    let mut link = |text: &mut String, parent: Option<usize>, kind: &str| {
        write_link(text, links, parent, kind, random.triple(0.1));
        links += 1;
        links - 1
    };
    let root = link(&mut text, None, "");
    let mut chest = root;
    for _ in 0..3 {
        chest = link(&mut text, Some(chest), "revolute");
    }
    for (from, joints, after) in [
        (chest, 3, &[] as &[usize]),
        (chest, 7, &[3]),
        (chest, 7, &[3]),
        (root, 6, &[2, 6]),
        (root, 6, &[2, 6]),
    ] {
        let mut parent = from;
        for joint in 1..=joints {
            parent = link(&mut text, Some(parent), "revolute");
            if after.contains(&joint) {
                parent = link(&mut text, Some(parent), "fixed");
                sensors.push(format!("joint{parent}"));
            }
        }
    }
    (text + "</robot>", sensors)
}

fn join(values: [f64; 3]) -> String {
    values.map(|value| format!("{value:e}")).join(" ")
}

/// Positions, velocities and accelerations.
#[derive(Clone)]
pub(crate) struct State(pub(crate) [Vec<f64>; 3]);

impl State {
    pub(crate) fn new(model: &Model, random: &mut Random) -> Self {
        Self([2.0, 2.0, 5.0].map(|size| random.reals(model.dof_count(), size)))
    }

    pub(crate) fn get(&self) -> JointState<'_> {
        let [position, velocity, acceleration] = &self.0;
        JointState {
            position,
            velocity,
            acceleration,
        }
    }
}

pub(crate) fn motion(random: &mut Random) -> FrameMotion {
    FrameMotion {
        angular_velocity: random.vector(2.0),
        angular_acceleration: random.vector(5.0),
        proper_acceleration: random.vector(10.0),
    }
}

/// The ten parameters of every link.
pub(crate) fn parameters(model: &Model) -> Vec<f64> {
    let links = model.inertias().iter();
    links.flat_map(RigidInertia::parameters).collect()
}

/// The mass matrix for a floating base, column by column: inverse dynamics of unit accelerations
/// at rest. Rows and columns are those of the base, force and linear part first, then the joints.
pub(crate) fn mass_matrix(model: &Model, base: usize, position: &[f64]) -> DMatrix<f64> {
    let (size, still) = (6 + model.dof_count(), vec![0.0; model.dof_count()]);
    let (mut kinematics, mut inverse) = (
        Kinematics::new(model, base).unwrap(),
        InverseDynamics::new(model),
    );
    let mut mass = DMatrix::zeros(size, size);
    for column in 0..size {
        let unit: Vec<f64> = (0..size)
            .map(|i| f64::from(u8::from(i == column)))
            .collect();
        let state = JointState {
            position,
            velocity: &still,
            acceleration: &unit[6..],
        };
        let motion = FrameMotion {
            angular_velocity: Vec3::zeros(),
            angular_acceleration: Vec3::from_column_slice(&unit[3..6]),
            proper_acceleration: Vec3::from_column_slice(&unit[..3]),
        };
        kinematics.update(model, state, &motion).unwrap();
        inverse.update(model, &kinematics, &[]).unwrap();
        let rows = inverse.base_wrench().force_first();
        let rows = rows.iter().chain(inverse.torque()).copied();
        mass.column_mut(column)
            .iter_mut()
            .zip(rows)
            .for_each(|(to, row)| *to = row);
    }
    mass
}

/// The unit motion of a joint's URDF child relative to its parent, in base coordinates, from the
/// child's pose; `None` for a fixed joint.
pub(crate) fn joint_axis(kinematics: &Kinematics, joint: &Joint) -> Option<Motion> {
    let pose = kinematics.pose(joint.child);
    match &joint.kind {
        JointKind::Revolute(axis) => Some(Motion::rotation(
            &(pose.rotation * axis.vector),
            &pose.translation,
        )),
        JointKind::Prismatic(axis) => Some(Motion::translation(&(pose.rotation * axis.vector))),
        JointKind::Fixed => None,
    }
}

/// Twists of all links in base coordinates when the base moves with `base_twist`, by a separate
/// recursion from the model's root.
pub(crate) fn twists(
    model: &Model,
    kinematics: &Kinematics,
    velocity: &[f64],
    base_twist: &Motion,
) -> Vec<Motion> {
    let mut twists = vec![Motion::zero(); model.link_count()];
    for joint in model.joints() {
        twists[joint.child] = twists[joint.parent];
        if let (Some(dof), Some(axis)) = (joint.dof, joint_axis(kinematics, joint)) {
            twists[joint.child] += axis * velocity[dof];
        }
    }
    let shift = *base_twist - twists[kinematics.base()];
    twists.iter_mut().for_each(|twist| *twist += shift);
    twists
}

/// A contact of any kind anywhere, and a wrench of that kind in its frame.
pub(crate) fn contact(model: &Model, random: &mut Random) -> (ContactSpec, Wrench) {
    let (frame, position) = (random.frame(model), random.vector(0.2));
    let kind = match random.below(3) {
        0 => ContactKind::Wrench,
        1 => ContactKind::Force,
        _ => ContactKind::ForceAlong(random.vector(1.0).add_scalar(0.01)),
    };
    let force = match kind {
        ContactKind::ForceAlong(direction) => direction.normalize() * random.real(50.0),
        _ => random.vector(50.0),
    };
    let mut torque = position.cross(&force);
    if kind == ContactKind::Wrench {
        torque += random.vector(5.0);
    }
    (
        ContactSpec {
            frame,
            kind,
            position,
        },
        Wrench { torque, force },
    )
}

pub(crate) fn external(spec: &ContactSpec, wrench: Wrench) -> ExternalWrench {
    ExternalWrench {
        frame: spec.frame,
        wrench,
    }
}

/// Largest difference of two lists.
pub(crate) fn gap(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |most, (x, y)| {
        assert!(x.is_finite() && y.is_finite(), "{x} {y}");
        f64::max(most, (x - y).abs())
    })
}

/// Largest magnitude, at least 1.
pub(crate) fn size(values: &[f64]) -> f64 {
    values
        .iter()
        .fold(1.0, |most, value| f64::max(most, value.abs()))
}

pub(crate) fn wrench_gap(a: &Wrench, b: &Wrench) -> f64 {
    gap(&a.force_first(), &b.force_first())
}
