//! The truth of the simulated robot at any instant: motion, joint torques, readings of ideal
//! sensors, contact wrenches.
//!
//! One link stands still and carries the robot. It is the fixed base or, with an IMU as base, the
//! link of the first contact on the IMU's link (else of the first contact that is not pushed).
//! Gravity points along its frame's negative z axis, unless `gravity_mps2` is set. Other wrenches
//! on the robot are a push on its hand (the contact named `hand`, else the last one that does not
//! carry it) and the pushes of faults ([`InjectedFault::Push`]), which the skins of estimator.toml
//! feel.

mod touch;

pub use touch::{PlannedPush, TouchEvent};

use crate::fault::InjectedFault;
use crate::robot::{SimulatedRobot, SimulatedRobotError};
use crate::settings::SimulationSettings;
use crate::trajectory::{Point, Trajectory};
use proprio_dynamics::model::{Frame, MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::spatial::{Pose, Vec3, Wrench};
use proprio_dynamics::{
    DynamicsError, ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics, Noise,
    SensorCut,
};
use proprio_estimator::config::{Base, ForceTorque};
use proprio_topics::{Kind, Skin};
use touch::{Poke, Push, SkinTruth};

/// Standard gravity \[m/s^2\].
const GRAVITY: f64 = 9.80665;
/// The truth at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    /// The instant: seconds since the start of the simulation.
    pub t: f64,
    /// The joints, by degree of freedom.
    pub joints: Vec<JointTruth>,
    /// The F/T sensors' readings, including their offsets: fx fy fz tx ty tz \[N, Nm\], in the
    /// order of estimator.toml.
    pub wrenches: Vec<[f64; 6]>,
    /// The IMUs' readings.
    pub imus: Vec<ImuTruth>,
    /// The contacts' wrenches, by the environment on the link, in the axes and at the origin of the
    /// frame that `link` names: fx fy fz tx ty tz \[N, Nm\], in the order of estimator.toml.
    pub contacts: Vec<[f64; 6]>,
}

/// One joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointTruth {
    /// \[rad or m\].
    pub position: f64,
    /// \[rad/s or m/s\].
    pub velocity: f64,
    /// \[rad/s^2 or m/s^2\].
    pub acceleration: f64,
    /// Torque along the URDF axis, exerted by the parent on the child, without friction and rotor
    /// inertia \[Nm or N\].
    pub torque: f64,
}

/// The readings of an ideal IMU, in its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuTruth {
    /// Classical acceleration of its origin minus gravity \[m/s^2\].
    pub proper_acceleration: [f64; 3],
    /// \[rad/s\].
    pub angular_velocity: [f64; 3],
    /// \[rad/s^2\].
    pub angular_acceleration: [f64; 3],
}

/// The simulated robot's mechanics. Every thread has its own copy; all copies give the same
/// results.
#[derive(Debug, Clone)]
pub struct Simulation {
    model: Model,
    joint_names: Vec<String>,
    /// The position of a joint that does not move.
    standing: Vec<Option<f64>>,
    trajectory: Trajectory,
    kinematics: Kinematics,
    dynamics: InverseDynamics,
    /// The motion of the link that stands still.
    base: FrameMotion,
    sensors: Vec<ForceTorqueSensor>,
    imus: Vec<(String, Frame)>,
    contacts: Vec<(String, Frame)>,
    /// The contact that carries the robot.
    carries: Option<usize>,
    push: Option<Push>,
    /// Undeclared pushes and their windows.
    pokes: Vec<Poke>,
    skins: Vec<SkinTruth>,
    state: [Vec<f64>; 3],
    truth: Truth,
}

#[derive(Debug, Clone)]
struct ForceTorqueSensor {
    name: String,
    cut: SensorCut,
    offset: [f64; 6],
}

impl Simulation {
    /// The mechanics of `robot`.
    ///
    /// # Errors
    /// [`SimulatedRobotError::Mismatch`]: estimator.toml names a joint or link that is not in the
    /// URDF, or has inconsistent values.
    pub fn new(
        robot: &SimulatedRobot,
        settings: &SimulationSettings,
    ) -> Result<Self, SimulatedRobotError> {
        let model = robot.model.clone();
        let contacts = contacts(robot)?;
        let sensors = sensors(robot)?;
        let hand = contacts.iter().position(|(name, _)| name == "hand");
        let carrier = Carrier::new(robot, &contacts, hand)?;
        let mut imus: Vec<(String, Frame)> = carrier.imu.into_iter().collect();
        // Other IMUs must be on a link of the same name.
        for channel in robot.plan.channels.iter().filter(|c| c.kind == Kind::Imu) {
            if let Some(frame) = model.frame(&channel.name)
                && imus.iter().all(|(name, _)| *name != channel.name)
            {
                imus.push((channel.name.clone(), frame));
            }
        }
        let carries = carrier.contact;
        let on_hand = hand.or_else(|| (0..contacts.len()).rev().find(|c| Some(*c) != carries));
        let push = on_hand
            .filter(|c| settings.push && Some(*c) != carries)
            .and_then(|contact| Push::new(robot, &contacts, contact, settings));
        let pokes = Poke::of_faults(robot, &settings.faults)?;
        let skins = SkinTruth::of_robot(robot)?;
        let dofs = model.dof_count();
        let joint_names: Vec<String> = (0..dofs)
            .map(|dof| model.dof_name(dof).to_owned())
            .collect();
        let trajectory = trajectory(robot, settings, &joint_names)?;
        let standing = standing(robot, &joint_names, &trajectory);
        let kinematics = Kinematics::new(&model, carrier.frame.link)
            .map_err(|e| robot.wrong_config(format!("base: {e}")))?;
        let at_rest = FrameMotion::standing(&carrier.gravity);
        let mut this = Self {
            base: FrameMotion::of_link_from_imu(&at_rest, &carrier.frame.pose),
            dynamics: InverseDynamics::new(&model),
            truth: Truth {
                t: f64::NAN,
                joints: vec![JointTruth::UNKNOWN; dofs],
                wrenches: vec![[f64::NAN; 6]; sensors.len()],
                imus: vec![ImuTruth::UNKNOWN; imus.len()],
                contacts: vec![[0.0; 6]; contacts.len()],
            },
            state: [vec![0.0; dofs], vec![0.0; dofs], vec![0.0; dofs]],
            model,
            joint_names,
            standing,
            trajectory,
            kinematics,
            sensors,
            imus,
            contacts,
            carries,
            push,
            pokes,
            skins,
        };
        // Inconsistencies are reported here, not as absent readings later.
        this.evaluate(0.0)
            .map_err(|e| robot.wrong_config(e.to_string()))?;
        Ok(this)
    }

    /// The number of the joint of this name.
    #[must_use]
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joint_names.iter().position(|n| n == name)
    }

    /// The number of the F/T sensor of this name.
    #[must_use]
    pub fn wrench(&self, name: &str) -> Option<usize> {
        self.sensors.iter().position(|s| s.name == name)
    }

    /// The number of the IMU of this name.
    #[must_use]
    pub fn imu(&self, name: &str) -> Option<usize> {
        self.imus.iter().position(|(n, _)| n == name)
    }

    /// The number of the skin of this name.
    #[must_use]
    pub fn skin(&self, name: &str) -> Option<usize> {
        self.skins.iter().position(|skin| skin.name == name)
    }

    /// The values of the taxels of skin `skin` at `t` seconds \[counts\], triangle by triangle; NaN
    /// where there is no taxel. Triangles without any taxel are omitted.
    #[must_use]
    pub fn taxels(&self, skin: usize, t: f64) -> Vec<Skin> {
        let skin = self.skins.get(skin);
        skin.map_or(Vec::new(), |skin| skin.taxels(&self.pokes, t))
    }

    /// The joints' names, by degree of freedom.
    pub fn joint_names(&self) -> impl Iterator<Item = &str> {
        self.joint_names.iter().map(String::as_str)
    }

    /// The F/T sensors' names.
    pub(crate) fn wrench_names(&self) -> impl Iterator<Item = &str> {
        self.sensors.iter().map(|s| s.name.as_str())
    }

    /// The IMUs' names.
    pub(crate) fn imu_names(&self) -> impl Iterator<Item = &str> {
        self.imus.iter().map(|(name, _)| name.as_str())
    }

    /// The contacts' names.
    pub fn contact_names(&self) -> impl Iterator<Item = &str> {
        self.contacts.iter().map(|(name, _)| name.as_str())
    }

    /// The push on the hand; `None` if there is none.
    #[must_use]
    pub fn push(&self) -> Option<PlannedPush> {
        self.push.as_ref().map(Push::planned)
    }

    /// The next beginning or end of a touch after `t` seconds; `None` if there is none.
    #[must_use]
    pub(crate) fn next_touch(&self, t: f64) -> Option<TouchEvent> {
        self.push.map(|push| push.next_touch(t))
    }

    /// The motion of joint `joint` at `t` seconds, without computing anything else; `None` if there
    /// is no such joint.
    #[must_use]
    pub fn motion(&self, joint: usize, t: f64) -> Option<Point> {
        match self.standing.get(joint)? {
            Some(position) => Some(Point {
                position: *position,
                velocity: 0.0,
                acceleration: 0.0,
            }),
            None => self.trajectory.at(joint, t),
        }
    }

    /// The truth at `t` seconds. Quantities that depend on forces are NaN if they cannot be
    /// computed (which does not happen for a robot that was built).
    pub fn at(&mut self, t: f64) -> &Truth {
        #[allow(clippy::float_cmp)] // the very same instant, asked for again
        if self.truth.t != t && self.evaluate(t).is_err() {
            self.truth
                .joints
                .iter_mut()
                .for_each(|joint| joint.torque = f64::NAN);
            self.truth.wrenches.fill([f64::NAN; 6]);
            self.truth.imus.fill(ImuTruth::UNKNOWN);
            self.truth.contacts.fill([f64::NAN; 6]);
            self.truth.t = t;
        }
        &self.truth
    }

    fn evaluate(&mut self, t: f64) -> Result<(), DynamicsError> {
        for dof in 0..self.joint_names.len() {
            let Some(point) = self.motion(dof, t) else {
                continue;
            };
            let [position, velocity, acceleration] = &mut self.state;
            for (values, value) in [
                (position, point.position),
                (velocity, point.velocity),
                (acceleration, point.acceleration),
            ] {
                if let Some(slot) = values.get_mut(dof) {
                    *slot = value;
                }
            }
        }
        let push = self.push.map(|push| (push, push.at(t)));
        let present = self.pokes.iter().filter(|poke| poke.window.contains(t));
        let poked: Vec<ExternalWrench> = present.map(|poke| poke.external).collect();
        self.solve(push, &poked)?;
        self.truth.t = t;
        Ok(())
    }

    /// Computes the truth for the joints' `state`, a push on the hand and other pushes.
    fn solve(
        &mut self,
        push: Option<(Push, Wrench)>,
        poked: &[ExternalWrench],
    ) -> Result<(), DynamicsError> {
        let [position, velocity, acceleration] = &self.state;
        self.kinematics.update(
            &self.model,
            JointState {
                position,
                velocity,
                acceleration,
            },
            &self.base,
        )?;
        let pushed = push.map(|(push, wrench)| ExternalWrench {
            frame: push.frame,
            wrench,
        });
        let external: Vec<ExternalWrench> =
            pushed.into_iter().chain(poked.iter().copied()).collect();
        self.dynamics
            .update(&self.model, &self.kinematics, &external)?;
        let torque = self.dynamics.torque();
        for (dof, joint) in self.truth.joints.iter_mut().enumerate() {
            let value = |values: &[f64]| values.get(dof).copied().unwrap_or(f64::NAN);
            *joint = JointTruth {
                position: value(position),
                velocity: value(velocity),
                acceleration: value(acceleration),
                torque: value(torque),
            };
        }
        for (reading, sensor) in self.truth.wrenches.iter_mut().zip(&self.sensors) {
            let transmitted = self
                .dynamics
                .transmitted(&self.kinematics, sensor.cut.joint());
            *reading = sensor.cut.reading(&transmitted).force_first();
            reading
                .iter_mut()
                .zip(sensor.offset)
                .for_each(|(value, offset)| *value += offset);
        }
        for (truth, (_, frame)) in self.truth.imus.iter_mut().zip(&self.imus) {
            let motion = self.kinematics.frame_motion(frame);
            *truth = ImuTruth {
                proper_acceleration: motion.proper_acceleration.into(),
                angular_velocity: motion.angular_velocity.into(),
                angular_acceleration: motion.angular_acceleration.into(),
            };
        }
        for number in 0..self.contacts.len() {
            let wrench = self.contact_wrench(number, push, poked);
            if let Some(truth) = self.truth.contacts.get_mut(number) {
                *truth = wrench.force_first();
            }
        }
        Ok(())
    }

    /// The wrench on contact number `number`, in its frame.
    fn contact_wrench(
        &self,
        number: usize,
        push: Option<(Push, Wrench)>,
        poked: &[ExternalWrench],
    ) -> Wrench {
        let Some((_, frame)) = self.contacts.get(number) else {
            return Wrench::zero();
        };
        // The base of the kinematics is the body that carries the robot.
        if self.carries == Some(number) {
            return frame.pose.wrench_back(&self.dynamics.base_wrench());
        }
        let pushed = push.filter(|(push, _)| push.contact == number);
        let pushed = pushed.map_or(Wrench::zero(), |(_, wrench)| wrench);
        // Other pushes on the same link.
        let others = poked.iter().filter(|poke| poke.frame.link == frame.link);
        others.fold(pushed, |sum, poke| {
            sum + frame
                .pose
                .wrench_back(&poke.frame.pose.wrench(&poke.wrench))
        })
    }
}

impl JointTruth {
    const UNKNOWN: Self = Self {
        position: f64::NAN,
        velocity: f64::NAN,
        acceleration: f64::NAN,
        torque: f64::NAN,
    };
}

impl ImuTruth {
    const UNKNOWN: Self = Self {
        proper_acceleration: [f64::NAN; 3],
        angular_velocity: [f64::NAN; 3],
        angular_acceleration: [f64::NAN; 3],
    };
}

/// What the robot stands on.
struct Carrier {
    /// The frame that stands still.
    frame: Frame,
    /// The contact that carries the robot.
    contact: Option<usize>,
    gravity: Vec3,
    /// The IMU of the base, if it has one.
    imu: Option<(String, Frame)>,
}

impl Carrier {
    /// As the base of estimator.toml says; `hand` is the contact that does not carry it.
    fn new(
        robot: &SimulatedRobot,
        contacts: &[(String, Frame)],
        hand: Option<usize>,
    ) -> Result<Self, SimulatedRobotError> {
        Ok(match &robot.config.base {
            Base::Fixed { link, gravity_mps2 } => {
                let frame = robot.frame("base", link)?;
                Self {
                    frame,
                    contact: contacts.iter().position(|(_, f)| f.link == frame.link),
                    gravity: Vec3::from(*gravity_mps2),
                    imu: None,
                }
            }
            // The simulated robot does not walk: it stands on its first foot.
            Base::Stance { foot } => {
                let foot = foot.first();
                let foot = foot.ok_or_else(|| robot.wrong_config("base.foot is empty".into()))?;
                Self {
                    frame: robot.frame("base.foot", &foot.link)?,
                    contact: contacts.iter().position(|(name, _)| *name == foot.contact),
                    gravity: Vec3::from(foot.gravity_mps2),
                    imu: None,
                }
            }
            Base::Imu {
                sensor,
                link,
                xyz_m,
                rpy_rad,
            } => {
                let mut imu = robot.frame("base", link)?;
                let beside = contacts.iter().position(|(_, f)| f.link == imu.link);
                let contact = beside.or_else(|| (0..contacts.len()).find(|c| Some(*c) != hand));
                let frame = contact.and_then(|c| contacts.get(c));
                let frame = frame.map_or(imu, |(_, f)| *f);
                imu.pose = imu.pose * Pose::from_xyz_rpy(*xyz_m, *rpy_rad);
                Self {
                    frame,
                    contact,
                    gravity: Vec3::new(0.0, 0.0, -GRAVITY),
                    imu: Some((sensor.clone(), imu)),
                }
            }
        })
    }
}

/// The contacts: names and frames.
fn contacts(robot: &SimulatedRobot) -> Result<Vec<(String, Frame)>, SimulatedRobotError> {
    let contacts = robot.config.contact.iter().map(|contact| {
        let name = contact.name().to_owned();
        let frame = robot.frame(&format!("contact {name:?}"), &contact.link)?;
        Ok((name, frame))
    });
    contacts.collect()
}

fn sensors(robot: &SimulatedRobot) -> Result<Vec<ForceTorqueSensor>, SimulatedRobotError> {
    let sensors = robot.config.force_torque.iter().map(|ft| {
        let cut = sensor_cut(&robot.model, ft)
            .map_err(|e| robot.wrong_config(format!("force_torque {:?}: {e}", ft.sensor)))?;
        Ok(ForceTorqueSensor {
            name: ft.sensor.clone(),
            cut,
            offset: ft.offset().0.force_first(),
        })
    });
    sensors.collect()
}

/// The motion of the joints, of which faults may hold some.
fn trajectory(
    robot: &SimulatedRobot,
    settings: &SimulationSettings,
    joint_names: &[String],
) -> Result<Trajectory, SimulatedRobotError> {
    let model = &robot.model;
    let ranges: Vec<_> = (0..model.dof_count())
        .map(|dof| model.limits(model.dof_joint(dof)?))
        .collect();
    let mut trajectory = Trajectory::new(&ranges, settings.seed, settings.still);
    for fault in &settings.faults {
        let InjectedFault::Still { joint, at } = fault else {
            continue;
        };
        let number = joint_names.iter().position(|name| name == joint);
        let number = number.ok_or_else(|| {
            robot.mismatch(format!(
                "fault {fault}: the URDF has no moving joint {joint:?}"
            ))
        })?;
        if let (Some(Some(limits)), Some(at)) = (ranges.get(number), at)
            && !(limits.lower..=limits.upper).contains(at)
        {
            let (lower, upper) = (limits.lower, limits.upper);
            return Err(robot.mismatch(format!(
                "fault {fault}: the limits in the URDF are {lower} and {upper}"
            )));
        }
        trajectory.rest(number, *at);
    }
    Ok(trajectory)
}

/// The positions of the joints that do not move.
fn standing(
    robot: &SimulatedRobot,
    joint_names: &[String],
    trajectory: &Trajectory,
) -> Vec<Option<f64>> {
    let position = |(dof, name): (usize, &String)| match robot.config.locked.get(name) {
        Some(position) => Some(*position),
        // The position of a moving joint without a channel would be unknown.
        None if robot.plan.channel(name).is_none() => {
            trajectory.at(dof, 0.0).map(|rest| rest.position)
        }
        None => None,
    };
    joint_names.iter().enumerate().map(position).collect()
}

/// The cut at an F/T sensor: from estimator.toml, else from the URDF's sensor element, else the
/// default.
fn sensor_cut(
    model: &Model,
    ft: &ForceTorque,
) -> Result<SensorCut, proprio_dynamics::StructureError> {
    let element = model.sensors().iter().find(|s| s.joint == ft.joint);
    let frame = ft.frame.or(element.map(|e| e.frame));
    let direction = ft.direction.or(element.map(|e| e.direction));
    let pose = match (ft.xyz_m, ft.rpy_rad) {
        (None, None) => element.map_or_else(Pose::identity, |e| e.pose),
        (xyz, rpy) => Pose::from_xyz_rpy(xyz.unwrap_or_default(), rpy.unwrap_or_default()),
    };
    SensorCut::new(
        model,
        &ft.joint,
        frame.unwrap_or(MeasurementFrame::Child),
        direction.unwrap_or(MeasurementDirection::ChildToParent),
        &pose,
        &Noise {
            force: ft.noise_n,
            torque: ft.noise_nm,
        },
    )
}

#[cfg(test)]
mod tests {
    use super::touch::PUSH;
    use super::*;
    use std::collections::HashMap;
    use std::path::Path;

    fn robot() -> SimulatedRobot {
        SimulatedRobot::open("icub_left_arm").unwrap()
    }

    /// The columns of a golden table by name.
    fn golden(file: &str) -> Vec<HashMap<String, f64>> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../tests/oracle")
            .join(file);
        let text = std::fs::read_to_string(path).unwrap();
        let mut lines = text.lines();
        let names: Vec<&str> = lines.next().unwrap().split(',').collect();
        lines
            .map(|l| {
                names
                    .iter()
                    .map(|n| (*n).to_owned())
                    .zip(l.split(',').map(|v| v.parse().unwrap()))
                    .collect()
            })
            .collect()
    }

    /// This crate's truth against MuJoCo's: `tests/oracle/README.md` describes how those tables
    /// were made.
    fn agrees(file: &str, rows: usize) {
        let mut robot = robot();
        let offsets = robot.config.force_torque[0].clone();
        robot.config.force_torque[0].offset_n = None;
        robot.config.force_torque[0].offset_nm = None;
        let mut simulation = Simulation::new(&robot, &SimulationSettings::default()).unwrap();
        let push = simulation.push.unwrap();
        let table = golden(file);
        assert_eq!(table.len(), rows);
        let parts = ["fx", "fy", "fz", "tx", "ty", "tz"];
        for row in table {
            let value = |column: String| row[&column];
            for (dof, name) in simulation.joint_names.clone().iter().enumerate() {
                for (slot, part) in
                    simulation
                        .state
                        .iter_mut()
                        .zip(["position", "velocity", "acceleration"])
                {
                    slot[dof] = value(format!("joint/{name}/{part}"));
                }
            }
            let six = |what: &str| {
                parts.map(|part| row.get(&format!("{what}/{part}")).copied().unwrap_or(0.0))
            };
            let [fx, fy, fz, tx, ty, tz] = six("contact/hand");
            let hand = Wrench::from_parts([fx, fy, fz], [tx, ty, tz]);
            simulation.solve(Some((push, hand)), &[]).unwrap();
            let close = |ours: f64, theirs: f64, what: &str| {
                assert!((ours - theirs).abs() < 1e-9, "{what}: {ours}, {theirs}");
            };
            for (joint, name) in simulation.truth.joints.iter().zip(&simulation.joint_names) {
                close(joint.torque, value(format!("joint/{name}/torque")), name);
            }
            for (ours, theirs) in simulation.truth.wrenches[0]
                .into_iter()
                .zip(six("wrench/l_arm_ft_sensor"))
            {
                close(ours, theirs, "F/T");
            }
            let imu = simulation.truth.imus[0];
            let ours = [
                imu.proper_acceleration,
                imu.angular_velocity,
                imu.angular_acceleration,
            ];
            for (ours, part) in ours
                .into_iter()
                .flatten()
                .zip(["ax", "ay", "az", "gx", "gy", "gz", "alx", "aly", "alz"])
            {
                close(ours, value(format!("imu/chest_imu/{part}")), part);
            }
            assert_eq!(simulation.truth.contacts[1], [fx, fy, fz, tx, ty, tz]);
        }
        // The offset of estimator.toml is added.
        let bare = simulation.at(3.0).wrenches[0];
        robot.config.force_torque[0] = offsets.clone();
        let mut simulation = Simulation::new(&robot, &SimulationSettings::default()).unwrap();
        let offset = offsets.offset().0.force_first();
        assert!(
            offset.iter().all(|o| *o != 0.0),
            "with zero offsets this test would show nothing"
        );
        for ((with, without), offset) in simulation.at(3.0).wrenches[0]
            .into_iter()
            .zip(bare)
            .zip(offset)
        {
            assert!((with - without - offset).abs() < 1e-12);
        }
    }

    #[test]
    fn the_truth_agrees_with_mujoco() {
        agrees("icub_left_arm_mujoco.csv", 201);
    }

    #[test]
    fn the_truth_agrees_with_mujoco_while_the_hand_is_pushed() {
        agrees("icub_left_arm_mujoco_contact.csv", 201);
    }

    #[test]
    fn what_carries_the_standing_robot_is_its_weight() {
        let robot = robot();
        let mut simulation = Simulation::new(
            &robot,
            &SimulationSettings {
                push: false,
                ..SimulationSettings::default()
            },
        )
        .unwrap();
        let mass: f64 = robot.model.inertias().iter().map(|i| i.mass).sum();
        let [fx, fy, fz, ..] = simulation.at(0.5).contacts[0];
        assert!(
            fx.abs() < 1e-9 && fy.abs() < 1e-9 && (fz - mass * GRAVITY).abs() < 1e-9,
            "{fx} {fy} {fz}, {mass}"
        );
    }

    #[test]
    fn the_hand_is_pushed_in_the_middle_of_a_cycle_and_only_then() {
        let mut simulation = Simulation::new(
            &robot(),
            &SimulationSettings {
                cycle: 10.0,
                ..SimulationSettings::default()
            },
        )
        .unwrap();
        assert_eq!(
            simulation.contact_names().collect::<Vec<_>>(),
            ["stand", "hand"]
        );
        let mut force = |t: f64| {
            let [fx, fy, fz, ..] = simulation.at(t).contacts[1];
            (fx * fx + fy * fy + fz * fz).sqrt()
        };
        for t in [0.0, 3.99, 6.01, 9.9, 13.99] {
            assert_eq!(force(t), 0.0, "{t}");
        }
        for t in [5.0, 15.0] {
            assert!((force(t) - PUSH.0).abs() < 1e-9, "{t}");
        }
        // The declared touch covers exactly the time with a force.
        let simulation = Simulation::new(
            &robot(),
            &SimulationSettings {
                cycle: 10.0,
                ..SimulationSettings::default()
            },
        )
        .unwrap();
        let mut touches = vec![simulation.next_touch(0.0).unwrap()];
        for _ in 0..3 {
            let last = touches.last().unwrap().t;
            touches.push(simulation.next_touch(last).unwrap());
        }
        let actual: Vec<_> = touches.iter().map(|t| (t.t, t.contact, t.begins)).collect();
        assert_eq!(
            actual,
            [
                (4.0, 1, true),
                (6.0, 1, false),
                (14.0, 1, true),
                (16.0, 1, false)
            ]
        );
        let push = simulation.push().unwrap();
        assert_eq!((push.contact, push.cycle), (1, 10.0));
        for (actual, expected) in [
            (push.force, PUSH.0),
            (push.torque, PUSH.1),
            (push.from, 4.0),
            (push.until, 6.0),
        ] {
            assert!((actual - expected).abs() < 1e-9, "{push:?}");
        }
        let calm = SimulationSettings {
            push: false,
            ..SimulationSettings::default()
        };
        let mut calm = Simulation::new(&robot(), &calm).unwrap();
        assert_eq!((calm.push(), calm.next_touch(0.0)), (None, None));
        assert_eq!(calm.at(10.0).contacts[1], [0.0; 6]);
        // The push begins and ends smoothly.
        let steepest = (0..2000)
            .map(|k| f64::from(k) * 1e-3 + 4.0)
            .map(|t| (force(t + 1e-3) - force(t)).abs())
            .fold(0.0, f64::max);
        assert!(
            steepest < 1e-3 * PUSH.0 * 140.0 / 64.0 / 0.5 * 1.01,
            "{steepest}"
        );
    }

    #[test]
    fn a_joint_that_nobody_measures_stands_still() {
        let mut robot = robot();
        let mut locked = robot.clone();
        locked.config.locked.insert("l_elbow".into(), 1.0);
        let simulation = Simulation::new(&locked, &SimulationSettings::default()).unwrap();
        let elbow = simulation.joint("l_elbow").unwrap();
        assert_eq!(
            simulation.motion(elbow, 7.0),
            Some(Point {
                position: 1.0,
                velocity: 0.0,
                acceleration: 0.0
            })
        );
        robot.plan.channels.retain(|c| c.name != "l_elbow");
        let simulation = Simulation::new(&robot, &SimulationSettings::default()).unwrap();
        assert_eq!(simulation.motion(elbow, 7.0), simulation.motion(elbow, 0.0));
        assert_ne!(
            simulation.motion(elbow + 1, 7.0),
            simulation.motion(elbow + 1, 0.0)
        );
    }

    #[test]
    fn a_joint_stands_where_it_is_told_within_its_limits() {
        let standing = |fault: &str| {
            let faults = vec![fault.parse().unwrap()];
            let simulation = Simulation::new(
                &robot(),
                &SimulationSettings {
                    faults,
                    ..SimulationSettings::default()
                },
            );
            simulation.map(|simulation| {
                let elbow = simulation.joint("l_elbow").unwrap();
                simulation.motion(elbow, 7.0).unwrap().position
            })
        };
        assert_eq!(standing("still:l_elbow=0.8").unwrap(), 0.8);
        let message = standing("still:l_elbow=9").unwrap_err().to_string();
        assert!(message.contains("the limits in the URDF are"), "{message}");
    }

    #[test]
    fn a_link_that_the_urdf_lacks_is_named() {
        let mut robot = robot();
        robot.config.contact[1].link = "left_hand".into();
        let message = Simulation::new(&robot, &SimulationSettings::default())
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("contact \"hand\": link = \"left_hand\" is not a link of the URDF"),
            "{message}"
        );
    }

    /// A fault's push is a wrench on that link. It changes the sensor's readings and the torques as
    /// the same wrench at the link's contact would.
    #[test]
    fn a_push_by_a_fault_acts_where_it_is_typed() {
        let robot = robot();
        let at = |faults: &[&str], t: f64| {
            let settings = SimulationSettings {
                push: false,
                faults: faults.iter().map(|fault| fault.parse().unwrap()).collect(),
                ..SimulationSettings::default()
            };
            Simulation::new(&robot, &settings).map(|mut simulation| simulation.at(t).clone())
        };
        let hand = robot
            .config
            .contact
            .iter()
            .position(|c| c.name() == "hand")
            .unwrap();
        let (free, pushed) = (
            at(&[], 1.5).unwrap(),
            at(&["push:l_hand=20@1..2"], 1.5).unwrap(),
        );
        assert_eq!(pushed.contacts[hand], [20.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let force = |truth: &Truth| Vec3::from_column_slice(&truth.wrenches[0][..3]);
        assert!(((force(&pushed) - force(&free)).norm() - 20.0).abs() < 1e-9);
        assert!(
            free.joints
                .iter()
                .zip(&pushed.joints)
                .any(|(a, b)| (a.torque - b.torque).abs() > 0.5)
        );
        // Two pushes at a time, on frames of the same body; none before and after.
        let both = at(&["push:l_hand=20@1..2", "push:l_hand_palm=-5@1..2"], 1.5).unwrap();
        assert!((both.contacts[hand][0] - 20.0).hypot(both.contacts[hand][1]) > 1.0);
        assert_eq!(
            at(&["push:l_hand=20@1..2"], 2.0).unwrap(),
            at(&[], 2.0).unwrap()
        );
        let message = at(&["push:hnad=20@1..2"], 0.0).unwrap_err().to_string();
        assert!(
            message.contains("\"hnad\" is not a link of the URDF"),
            "{message}"
        );
    }
}
