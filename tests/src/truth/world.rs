//! The true robot: its motion, torques and the readings of its sensors.

use super::random::Random;
use super::robot::Robot;
use super::trouble::{Trouble, When, rotation};
use proprio_dynamics::model::{Frame, JointKind, Model};
use proprio_dynamics::spatial::{Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{
    ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics, SensorCut,
};
use proprio_estimator::config::{Base, Config};
use proprio_estimator::setup::Setup;
use std::f64::consts::TAU;

/// Duration of a run \[s\].
pub(super) const DURATION: f64 = 45.0;
/// When a payload is taken \[s\].
const TAKEN: f64 = 20.0;

/// A sum of three sines.
#[derive(Debug, Clone)]
struct Sines([[f64; 3]; 3]);

impl Sines {
    /// With a sum of amplitudes of at most `reach` \[rad or m\], slower if it is fast.
    fn new(reach: f64, random: &mut Random) -> Self {
        let shares = [0.0; 3].map(|_: f64| -random.uniform(1e-3, 1.0).ln());
        let all: f64 = shares.iter().sum();
        Self(shares.map(|share| {
            let f = random.uniform(0.08, 0.5);
            let amplitude = share / all * reach * (0.35 / f).min(1.0);
            [amplitude, TAU * f, random.uniform(0.0, TAU)]
        }))
    }

    /// Value, first and second derivative.
    fn at(&self, t: f64) -> [f64; 3] {
        self.0
            .iter()
            .fold([0.0; 3], |[x, v, a], [amplitude, o, phase]| {
                let (sin, cos) = (o * t + phase).sin_cos();
                [
                    x + amplitude * sin,
                    v + amplitude * o * cos,
                    a - amplitude * o * o * sin,
                ]
            })
    }
}

/// A product's value and derivatives.
fn product([a, a1, a2]: [f64; 3], [b, b1, b2]: [f64; 3]) -> [f64; 3] {
    [a * b, a1 * b + a * b1, a2 * b + 2.0 * a1 * b1 + a * b2]
}

/// The motion of a link that carries the IMU: about an axis, and along the three axes.
#[derive(Debug, Clone)]
struct Sway {
    axis: Vec3,
    angle: Sines,
    along: [Sines; 3],
}

/// A force on a link, in world axes \[N\].
#[derive(Debug, Clone)]
struct Force {
    frame: Frame,
    force: Vec3,
    spans: Vec<(f64, f64)>,
}

/// The true robot at one instant.
#[derive(Debug, Clone, Default)]
pub(super) struct Instant {
    /// By degree of freedom \[rad or m\].
    pub(super) position: Vec<f64>,
    /// By degree of freedom \[Nm or N\].
    pub(super) torque: Vec<f64>,
    /// By F/T sensor, without offset: forces, torques.
    pub(super) wrenches: Vec<[f64; 6]>,
    /// Proper acceleration, angular velocity.
    pub(super) imu: Option<[f64; 6]>,
}

/// The true robot.
pub(super) struct World {
    model: Model,
    loaded: Option<Model>,
    kinematics: Kinematics,
    dynamics: InverseDynamics,
    cuts: Vec<SensorCut>,
    joints: Vec<(f64, Sines)>,
    /// When the robot begins to move \[s\].
    pub(super) rest: f64,
    /// Proper acceleration of the base link at rest.
    upright: FrameMotion,
    imu: Option<Frame>,
    sway: Option<Sway>,
    forces: Vec<Force>,
}

impl World {
    pub(super) fn new(robot: &Robot, setup: &Setup, trouble: Trouble, seed: u64) -> Self {
        let random = &mut Random::new(seed, "world");
        let size = match trouble {
            Trouble::Cad(size) => size,
            _ => 0.15,
        };
        let model = robot.bodies(size, &mut Random::new(seed, "bodies"));
        let rest = random.uniform(0.0, 6.0);
        let joints = (0..model.dof_count()).map(|dof| {
            let joint = model.dof_joint(dof).expect("a joint");
            let reach = match model.joints()[joint].kind {
                JointKind::Prismatic(_) => 0.3,
                _ => 2.0,
            };
            let limits = model.limits(joint);
            let lower = limits.map_or(-reach, |l| l.lower.max(-reach));
            let upper = limits.map_or(reach, |l| l.upper.min(reach));
            let half = 0.5 * (upper - lower);
            let middle = 0.5 * (lower + upper) + random.uniform(-0.3, 0.3) * half;
            (middle, Sines::new(0.7 * half, random))
        });
        let joints = joints.collect();
        let (upright, imu) = base(&robot.config(), &model);
        let sway = (imu.is_some() && random.happens(0.5)).then(|| Sway {
            axis: random.direction(),
            angle: Sines::new(0.6, random),
            along: [0.0; 3].map(|_: f64| Sines::new(0.15, random)),
        });
        let mut upright = upright;
        if let Trouble::Tilt(angle) = trouble {
            let turn = rotation(across(&upright.proper_acceleration, random) * angle);
            upright.proper_acceleration = turn * upright.proper_acceleration;
        }
        let tip = &robot.tips[random.below(robot.tips.len())];
        let tip = model.frame(tip).expect("a link");
        let (frame, when) = match trouble {
            Trouble::Push(when) => (tip, Some(when)),
            Trouble::NotLearning(_) => (tip, Some(When::Middle)),
            Trouble::Elsewhere(when) => {
                // Two joints before the hand.
                let up = |link: usize| link.checked_sub(1).map(|j| model.joints()[j].parent);
                let link = up(tip.link).and_then(up).unwrap_or(tip.link);
                (
                    Frame {
                        link,
                        pose: Pose::identity(),
                    },
                    Some(when),
                )
            }
            _ => (tip, None),
        };
        let mut forces = Vec::new();
        if let Some(when) = when {
            let starts: &[(f64, f64)] = match when {
                When::Start => &[(-1.0, rest + random.uniform(2.0, 8.0))],
                When::Middle => &[(15.0, 18.0), (25.0, 27.0)],
                When::Long => &[(12.0, 24.0), (28.0, 40.0)],
            };
            forces.extend(starts.iter().map(|span| Force {
                frame,
                force: random.direction() * random.uniform(8.0, 40.0),
                spans: vec![*span],
            }));
        }
        let loaded = (trouble == Trouble::Payload).then(|| {
            let mut loaded = model.clone();
            let mass = random.uniform(0.2, 0.8);
            let body = RigidInertia::from_centroidal(
                mass,
                &Vec3::new(0.0, 0.0, 0.08),
                &(proprio_dynamics::spatial::Mat3::identity() * 1e-4),
            );
            let sum: Vec<f64> = (body.transformed(&tip.pose).parameters().iter())
                .zip(model.inertias()[tip.link].parameters())
                .map(|(a, b)| a + b)
                .collect();
            let sum = RigidInertia::from_parameters(&sum.try_into().expect("ten numbers"));
            loaded.set_inertia(tip.link, sum).expect("a possible body");
            loaded
        });
        Self {
            kinematics: Kinematics::new(&model, setup.robot.base_link).expect("a link"),
            dynamics: InverseDynamics::new(&model),
            cuts: setup.robot.structure.sensors().to_vec(),
            model,
            loaded,
            joints,
            rest,
            upright,
            imu,
            sway,
            forces,
        }
    }

    /// The truth at `t` \[s\].
    pub(super) fn at(&mut self, t: f64) -> Instant {
        let s = ((t - self.rest) / 4.0).clamp(0.0, 1.0);
        let begin = [
            s.powi(3) * (10.0 - 15.0 * s + 6.0 * s * s),
            30.0 * s * s * (1.0 - s).powi(2) / 4.0,
            60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / 16.0,
        ];
        let states: Vec<[f64; 3]> = (self.joints.iter())
            .map(|(middle, sines)| {
                let [q, dq, ddq] = product(begin, sines.at(t));
                [middle + q, dq, ddq]
            })
            .collect();
        let [position, velocity, acceleration] =
            [0, 1, 2].map(|k| states.iter().map(|state| state[k]).collect::<Vec<f64>>());
        let base = match &self.sway {
            None => self.upright,
            Some(sway) => {
                let [angle, rate, change] = product(begin, sway.angle.at(t));
                let back = rotation(sway.axis * angle).transpose();
                let along = Vec3::from_fn(|k, _| product(begin, sway.along[k].at(t))[2]);
                FrameMotion {
                    angular_velocity: sway.axis * rate,
                    angular_acceleration: sway.axis * change,
                    proper_acceleration: back * (self.upright.proper_acceleration + along),
                }
            }
        };
        let model = match &self.loaded {
            Some(loaded) if t > TAKEN => loaded,
            _ => &self.model,
        };
        let state = JointState {
            position: &position,
            velocity: &velocity,
            acceleration: &acceleration,
        };
        self.kinematics.update(model, state, &base).expect("finite");
        let present = |force: &&Force| force.spans.iter().any(|(a, b)| *a <= t && t < *b);
        let external: Vec<ExternalWrench> = (self.forces.iter().filter(present))
            .map(|force| {
                let pose = self.kinematics.pose(force.frame.link).rotation;
                let back = (pose * force.frame.pose.rotation).transpose();
                let wrench = Wrench {
                    torque: Vec3::zeros(),
                    force: back * force.force,
                };
                ExternalWrench {
                    frame: force.frame,
                    wrench,
                }
            })
            .collect();
        (self.dynamics)
            .update(model, &self.kinematics, &external)
            .expect("finite");
        let read = |cut: &SensorCut| {
            let wrench = self.dynamics.transmitted(&self.kinematics, cut.joint());
            cut.reading(&wrench).force_first()
        };
        Instant {
            torque: self.dynamics.torque().to_vec(),
            wrenches: self.cuts.iter().map(read).collect(),
            imu: self.imu.as_ref().map(|frame| {
                let motion = self.kinematics.frame_motion(frame);
                let [ax, ay, az]: [f64; 3] = motion.proper_acceleration.into();
                let [gx, gy, gz]: [f64; 3] = motion.angular_velocity.into();
                [ax, ay, az, gx, gy, gz]
            }),
            position,
        }
    }
}

/// The base link at rest, and where its IMU is.
fn base(config: &Config, model: &Model) -> (FrameMotion, Option<Frame>) {
    match &config.base {
        Base::Fixed { link, gravity_mps2 } => {
            let frame = model.frame(link).expect("a link");
            let standing = FrameMotion::standing(&Vec3::from(*gravity_mps2));
            (FrameMotion::of_link_from_imu(&standing, &frame.pose), None)
        }
        Base::Imu {
            link,
            xyz_m,
            rpy_rad,
            ..
        } => {
            let mut frame = model.frame(link).expect("a link");
            frame.pose = frame.pose * Pose::from_xyz_rpy(*xyz_m, *rpy_rad);
            let down = Vec3::new(0.0, 0.0, -9.80665);
            (FrameMotion::standing(&down), Some(frame))
        }
        Base::Stance { foot } => {
            let foot = foot.first().expect("a foot");
            let frame = model.frame(&foot.link).expect("a link");
            let standing = FrameMotion::standing(&Vec3::from(foot.gravity_mps2));
            (FrameMotion::of_link_from_imu(&standing, &frame.pose), None)
        }
    }
}

/// A direction across `v`.
fn across(v: &Vec3, random: &mut Random) -> Vec3 {
    let cross = v.cross(&random.direction());
    cross.try_normalize(1e-9).unwrap_or_else(Vec3::x)
}

#[cfg(test)]
mod tests {
    use super::super::Run;
    use super::*;

    /// At rest a sensor reads the weight of the true links beyond it; later, more or less.
    #[test]
    fn a_resting_robot_weighs_what_its_links_do() {
        for seed in [1, 2, 3, 6] {
            let mut world = Run::new(seed, Trouble::None).expect("a run").world;
            let rest = world.at(0.0).wrenches;
            assert_ne!(world.at(20.0).wrenches, rest);
            for (cut, reading) in world.cuts.iter().zip(&rest) {
                let joints = world.model.joints();
                let mut beyond = vec![false; world.model.link_count()];
                beyond[joints[cut.joint()].child] = true;
                for joint in joints {
                    beyond[joint.child] |= beyond[joint.parent];
                }
                let bodies = world.model.inertias().iter().zip(&beyond);
                let mass: f64 = bodies.filter(|(_, b)| **b).map(|(body, _)| body.mass).sum();
                let force = Vec3::new(reading[0], reading[1], reading[2]).norm();
                assert!(
                    (force / (9.80665 * mass) - 1.0).abs() < 1e-6,
                    "{seed}: {force} {mass}"
                );
            }
        }
    }

    #[test]
    fn derivatives_are_those_of_the_values() {
        let random = &mut Random::new(4, "test");
        let (a, b) = (Sines::new(1.0, random), Sines::new(0.3, random));
        let h = 1e-4;
        for t in [0.3, 2.0, 17.0] {
            let at = |t: f64| product(a.at(t), b.at(t));
            let ([before, ..], [x, v, acceleration], [after, ..]) = (at(t - h), at(t), at(t + h));
            assert!(((after - before) / (2.0 * h) - v).abs() < 1e-6);
            assert!(((after - 2.0 * x + before) / (h * h) - acceleration).abs() < 1e-5);
        }
    }
}
