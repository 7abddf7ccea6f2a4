//! Identification alone: arrays in, inertial parameters with their covariance out. No table, no
//! configuration file, no daemon.

use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame, Model};
use proprio_dynamics::spatial::{Pose, RigidInertia, Vec3};
use proprio_dynamics::{FrameMotion, InverseDynamics, JointState, Kinematics, Noise, SensorCut};
use proprio_identification::{Dataset, LogRole, Outcome, Recording, Robot, identify};
use proprio_topics::{JointState as Encoder, Nanos, Quality, Reading, Wrench as ForceTorque};
use std::error::Error;

const GRAVITY: [f64; 3] = [0.0, 0.0, -9.80665];

/// Identifies an arm whose URDF has all masses 20 % too small, and prints the links' masses.
pub fn main() -> Result<(), Box<dyn Error>> {
    for link in run()?.links.iter().filter(|link| link.seen) {
        let (cad, own) = (link.cad.mass, link.identified.mass);
        println!(
            "{}: {cad:.3} -> {own:.3} +- {:.3} kg",
            link.name, link.deviation[0]
        );
    }
    Ok(())
}

/// The program: a robot, arrays of samples, and the outcome.
fn identified(
    cad: Model,
    sensor: SensorCut,
    samples: &[Sample],
) -> Result<Outcome, Box<dyn Error>> {
    let gravity = Vec3::from(GRAVITY);
    let robot = Robot::standing("arm", cad, "chest", &gravity, &[("ft", sensor)], &[])?;
    let mut recording = Recording::new(&robot);
    for (t, positions, reading) in samples {
        recording.push(0, *t, &Reading::Wrench(*reading), Quality::GOOD);
        for (channel, &position) in (1..).zip(positions) {
            let encoder = Encoder {
                position,
                ..Encoder::ABSENT
            };
            recording.push(channel, *t, &Reading::Joint(encoder), Quality::GOOD);
        }
    }
    let dataset = Dataset::new(&robot, "swing", LogRole::Train, recording)?;
    Ok(identify(&robot, vec![dataset], &[], &mut |_| ())?)
}

/// Simulates a log of the shipped arm and identifies from it, beginning with 20 % too small masses.
pub fn run() -> Result<Outcome, Box<dyn Error>> {
    let truth = Model::from_urdf(
        include_str!("../../../config/icub_left_arm/model.urdf"),
        &["l_arm_ft_sensor"],
    )?;
    let noise = Noise {
        force: [0.08, 0.09, 0.18],
        torque: [0.002, 0.003, 0.0015],
    };
    let (frame, direction) = (MeasurementFrame::Child, MeasurementDirection::ChildToParent);
    let pose = Pose::identity();
    let sensor = SensorCut::new(&truth, "l_arm_ft_sensor", frame, direction, &pose, &noise)?;
    let mut cad = truth.clone();
    for (link, body) in truth.inertias().iter().enumerate() {
        let lighter = body.parameters().map(|parameter| 0.8 * parameter);
        cad.set_inertia(link, RigidInertia::from_parameters(&lighter))?;
    }
    identified(cad, sensor, &samples(&truth, &sensor)?)
}

/// Simulated arrays: 30 s of motion, readings with the sensor's noise.
fn samples(truth: &Model, sensor: &SensorCut) -> Result<Vec<Sample>, Box<dyn Error>> {
    let (mut kinematics, mut inverse) = (Kinematics::new(truth, 0)?, InverseDynamics::new(truth));
    let base = FrameMotion::standing(&Vec3::from(GRAVITY));
    let mut seed = 1_u64;
    // A sum of uniform numbers (a linear congruence) is as good as normal here.
    let mut normal = || {
        let mut uniform = || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (seed >> 11) as f64 / (1_u64 << 53) as f64
        };
        (0..12).map(|_| uniform()).sum::<f64>() - 6.0
    };
    let mut samples = Vec::new();
    for k in 0..3000_i64 {
        let t = 0.01 * k as f64;
        let mut state = [vec![], vec![], vec![]];
        for dof in 0..truth.dof_count() {
            let (rate, phase) = (1.1 + 0.37 * dof as f64, 0.9 * dof as f64);
            let (sine, cosine) = (rate * t + phase).sin_cos();
            state[0].push(0.5 * sine);
            state[1].push(0.5 * rate * cosine);
            state[2].push(-0.5 * rate * rate * sine);
        }
        let [position, velocity, acceleration] = &state;
        let joints = JointState {
            position,
            velocity,
            acceleration,
        };
        kinematics.update(truth, joints, &base)?;
        inverse.update(truth, &kinematics, &[])?;
        let exact = sensor.reading(&inverse.transmitted(&kinematics, sensor.joint()));
        let noise = sensor.noise();
        let noisy = |exact: Vec3, noise: [f64; 3], normal: &mut dyn FnMut() -> f64| {
            [0, 1, 2].map(|axis| exact[axis] + noise[axis] * normal())
        };
        let reading = ForceTorque {
            force: noisy(exact.force, noise.force, &mut normal),
            torque: noisy(exact.torque, noise.torque, &mut normal),
        };
        samples.push((Nanos::from_millis(10 * k), position.clone(), reading));
    }
    Ok(samples)
}

/// Stamp, joint positions, reading of the F/T sensor.
type Sample = (Nanos, Vec<f64>, ForceTorque);
