//! Time of identification from a recorded log, on all available cores: from a table of samples in
//! memory to the outcome.
//!
//! `cargo bench -p proprio-estimator --bench offline`, or on one core `taskset -c 1 cargo bench
//! ...`
//!
//! Items are samples, that is rows of the table: a leg of four joints beyond one F/T sensor on a
//! fixed base, at 1 kHz, with encoder positions and the sensor's six numbers. The inertial
//! parameters differ from CAD by up to a tenth. A million samples are a quarter of an hour.

#[path = "../dynamics/tests/common/mod.rs"]
mod common;

use common::Random;
use divan::Bencher;
use divan::counter::ItemsCount;
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{RigidInertia, Vec3};
use proprio_dynamics::{FrameMotion, InverseDynamics, JointState, Kinematics};
use proprio_estimator::config::Config;
use proprio_estimator::sample_log;
use proprio_estimator::setup::Setup;
use proprio_identification::{LogRole, Verdict, identify};
use std::fmt::Write as _;

fn main() {
    divan::main();
}

const JOINTS: usize = 4;
const CONFIG: &str = r#"
schema = 1
robot = "leg"
model = "leg.urdf"
[base]
kind = "fixed"
link = "world"
[[force_torque]]
sensor = "ft"
joint = "ft"
noise_n = [0.08, 0.09, 0.18]
noise_nm = [0.002, 0.003, 0.0015]
[[contact]]
name = "foot"
link = "l4"
presence = "possible"
"#;
/// Noise of the sensor, as configured; step of the encoders [rad].
const NOISE: [f64; 6] = [0.08, 0.09, 0.18, 0.002, 0.003, 0.0015];
const STEP: f64 = 5e-5;

fn setup() -> Setup {
    let mut urdf = String::from("<robot name=\"leg\"><link name=\"world\"/>");
    let bodies = [
        (1.5, -0.08),
        (1.0, 0.08),
        (2.0, -0.08),
        (1.2, -0.1),
        (0.6, -0.05),
    ];
    for (number, (mass, z)) in bodies.into_iter().enumerate() {
        let [x, y, w] = [0.006, 0.005, 0.004].map(|radius| radius * mass);
        let _ = write!(
            urdf,
            "<link name=\"l{number}\"><inertial><origin xyz=\"0.01 0.02 {z}\"/><mass \
             value=\"{mass}\"/>\
             <inertia ixx=\"{x}\" ixy=\"0\" ixz=\"0\" iyy=\"{y}\" iyz=\"0\" izz=\"{w}\"/>\
             </inertial></link>"
        );
    }
    urdf +=
        "<joint name=\"ft\" type=\"fixed\"><parent link=\"world\"/><child link=\"l0\"/></joint>";
    let places = [
        "0 0 0.05",
        "0.02 0.05 -0.2",
        "0.02 -0.03 -0.2",
        "0.01 0.02 -0.15",
    ];
    for (number, (axis, place)) in ["1 0 0", "0 1 0", "0 0 1", "1 0 0"]
        .into_iter()
        .zip(places)
        .enumerate()
    {
        let _ = write!(
            urdf,
            "<joint name=\"j{number}\" type=\"revolute\"><parent link=\"l{number}\"/><child \
             link=\"l{}\"/><origin xyz=\"{place}\"/>\
             <axis xyz=\"{axis}\"/><limit lower=\"-3\" upper=\"3\" effort=\"99\" velocity=\"9\"/>\
             </joint>",
            number + 1
        );
    }
    urdf += "</robot>";
    let model = Model::from_urdf(&urdf, &["ft"]).expect("a model");
    Setup::with_model(&Config::parse(CONFIG).expect("a configuration"), model).expect("it fits")
}

/// Each joint on a sum of four sines of up to 1.2 Hz.
fn log(setup: &Setup, samples: usize) -> String {
    let (mut model, mut random) = (setup.robot.model.clone(), Random::new(5));
    for link in 0..model.link_count() {
        let factor = 1.0 + random.real(0.1);
        let body =
            RigidInertia::from_parameters(&model.inertias()[link].parameters().map(|p| factor * p));
        model.set_inertia(link, body).expect("a body");
    }
    let waves: Vec<[(f64, f64); 4]> = (0..JOINTS)
        .map(|_| {
            std::array::from_fn(|_| {
                (
                    std::f64::consts::TAU * (0.65 + random.real(0.55)),
                    random.real(3.0),
                )
            })
        })
        .collect();
    let base = FrameMotion::standing(&Vec3::new(0.0, 0.0, -9.80665));
    let mut kinematics = Kinematics::new(&model, setup.robot.base_link).expect("the base");
    let mut dynamics = InverseDynamics::new(&model);
    let cut = &setup.robot.structure.sensors()[0];
    let mut text = String::from("t");
    (0..JOINTS).for_each(|joint| text += &format!(",joint/j{joint}/position"));
    ["fx", "fy", "fz", "tx", "ty", "tz"]
        .iter()
        .for_each(|axis| text += &format!(",wrench/ft/{axis}"));
    for i in 0..samples {
        let t = i as f64 * 1e-3;
        let joints = |f: fn(f64, f64, f64) -> f64| -> Vec<f64> {
            let sum = |waves: &[(f64, f64); 4]| {
                waves.iter().map(|(w, phase)| 0.25 * f(*w, *phase, t)).sum()
            };
            waves.iter().map(sum).collect()
        };
        let position = joints(|w, phase, t| (w * t + phase).sin());
        let state = JointState {
            position: &position,
            velocity: &joints(|w, phase, t| w * (w * t + phase).cos()),
            acceleration: &joints(|w, phase, t| -w * w * (w * t + phase).sin()),
        };
        kinematics.update(&model, state, &base).expect("a state");
        dynamics.update(&model, &kinematics, &[]).expect("a state");
        let reading = cut.reading(&dynamics.transmitted(&kinematics, cut.joint()));
        let _ = write!(text, "\n{t:.3}");
        for q in position {
            let _ = write!(text, ",{:.6}", (q / STEP).round() * STEP);
        }
        for (value, deviation) in reading.force_first().into_iter().zip(NOISE) {
            // Variance 1: the sum of three uniform numbers from -1 to 1.
            let noise = random.reals(3, 1.0).iter().sum::<f64>();
            let _ = write!(text, ",{:.5}", value + deviation * noise);
        }
    }
    text + "\n"
}

#[divan::bench(args = [100_000, 1_000_000], sample_count = 3, sample_size = 1)]
fn identify_a_log(bencher: Bencher<'_, '_>, samples: usize) {
    let setup = setup();
    let text = log(&setup, samples);
    bencher.counter(ItemsCount::new(samples)).bench_local(|| {
        let log = text.as_bytes();
        let dataset =
            sample_log::dataset(&setup.robot, "log.csv", LogRole::Train, log).expect("a log");
        let outcome = identify(&setup.robot, vec![dataset], &[], &mut |_| ()).expect("an outcome");
        assert_eq!(outcome.verdict, Verdict::Identified);
        outcome
    });
}
