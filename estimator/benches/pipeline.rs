//! Load of the whole estimator on one core: a second of a full iCub's samples (32 joints, six F/T
//! sensors, an IMU) at 1 kHz each, torques and contacts at 1 kHz.
//!
//! `PROPRIO_ICUB_MODELS=... taskset -c 1 cargo bench -p proprio-estimator --bench pipeline`
//!
//! An item is a second of the robot's time: 100 ms are 10 % of a core. The robot is iCub V2.5 if
//! `PROPRIO_ICUB_MODELS` names the folder with iCubGazeboV2_5.urdf (of the PyPI package icub-models
//! 3.2.0), else a generated robot with the same number of joints and sensors. Readings are
//! simulated with noise, so that they pass the gate of identification.
//!
//! `Standing`: on a fixed base, so that the trunk is not identifiable and each limb is a component
//! of its own. `Free`: balancing on one foot beyond its F/T sensor, kinematics from an IMU: the
//! robot is one component of 426 unknowns, the largest possible. The links are a tenth heavier or
//! lighter than in CAD.

#[path = "../dynamics/tests/common/mod.rs"]
mod common;

use common::Random;
use divan::Bencher;
use divan::counter::ItemsCount;
use proprio_dynamics::model::{Frame, Model};
use proprio_dynamics::spatial::{Pose, RigidInertia, Vec3, Wrench};
use proprio_dynamics::{ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics};
use proprio_estimator::config::Config;
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{
    ContactState, Imu, JointState as Encoder, Nanos, Quality, Reading, Wrench as ForceTorque,
};
use std::path::Path;

fn main() {
    divan::main();
}

/// Milliseconds after which the motion repeats itself.
const PERIOD: usize = 4000;
const NOISE: [f64; 6] = [0.08, 0.09, 0.18, 0.002, 0.003, 0.0015];

#[derive(Clone, Copy, Debug)]
enum Base {
    Standing,
    Free,
}

struct Bench {
    pipeline: Pipeline,
    /// Of each millisecond of a period, the reading of each channel.
    readings: Vec<Vec<Reading>>,
    random: Random,
    now: usize,
}

fn robot() -> (String, Vec<String>) {
    if let Some(folder) = std::env::var_os("PROPRIO_ICUB_MODELS") {
        let text = std::fs::read_to_string(Path::new(&folder).join("iCubGazeboV2_5.urdf"))
            .expect("the robot's file");
        let sensors = Model::from_urdf(&text, &[])
            .expect("the robot")
            .sensors()
            .to_vec();
        return (
            text,
            sensors.into_iter().map(|sensor| sensor.joint).collect(),
        );
    }
    common::humanoid()
}

fn setup(base: Base, rate_hz: Option<f64>) -> Setup {
    let (text, sensors) = robot();
    let keep: Vec<&str> = sensors.iter().map(String::as_str).collect();
    let model = Model::from_urdf(&text, &keep).expect("the robot");
    let root = model.link_name(0);
    let mut toml = String::from("schema = 1\nrobot = \"bench\"\nmodel = \"robot.urdf\"\n");
    toml += &match base {
        Base::Standing => format!(
            "[base]\nkind = \"fixed\"\nlink = \"{root}\"\ngravity_mps2 = [0.0, 0.0, -9.80665]\n"
        ),
        Base::Free => format!(
            "[base]\nkind = \"imu\"\nsensor = \"imu\"\nlink = \"{root}\"\n[[contact]]\nname = \
             \"trunk\"\nlink = \"{root}\"\npresence = \"possible\"\n"
        ),
    };
    for (number, joint) in sensors.iter().enumerate() {
        let (_, child) = model
            .joint_links(model.joint(joint).expect("its joint"))
            .expect("its links");
        toml += &format!(
            "[[force_torque]]\nsensor = \"ft{number}\"\njoint = \"{joint}\"\nframe = \"child\"\n\
             direction = \"child_to_parent\"\n\
             [[contact]]\nname = \"touch{number}\"\nlink = \"{child}\"\npresence = \"possible\"\n"
        );
    }
    if let Some(rate) = rate_hz {
        toml += &format!("[identification]\nenabled = true\nrate_hz = {rate:.1}\n");
    }
    toml += "[output]\ntrigger = \"ft0\"\n";
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("robot.urdf"), text).expect("a file");
    let file = folder.path().join("estimator.toml");
    std::fs::write(&file, toml).expect("a file");
    let config = Config::load(&file).expect("a configuration");
    Setup::new(&config).expect("a setup")
}

impl Bench {
    fn new(base: Base, rate_hz: Option<f64>) -> Self {
        let setup = setup(base, rate_hz);
        let (mut model, mut random) = (setup.robot.model.clone(), Random::new(1));
        for link in 0..model.link_count() {
            let factor = 1.0 + random.real(0.1);
            let body = RigidInertia::from_parameters(
                &model.inertias()[link].parameters().map(|p| factor * p),
            );
            model.set_inertia(link, body).expect("a body");
        }
        let model = &model;
        // The foot: the last of the links after a sensor.
        let depth = |mut link: usize| {
            let mut depth = 0;
            while link > 0 {
                (link, depth) = (model.joints()[link - 1].parent, depth + 1);
            }
            depth
        };
        let sensors = setup.robot.structure.sensors();
        let stance = (0..sensors.len()).max_by_key(|&number| depth(sensors[number].joint() + 1));
        let stance = stance.filter(|_| matches!(base, Base::Free));
        let mut kinematics = Kinematics::new(model, setup.robot.base_link).expect("the base");
        let mut inverse = InverseDynamics::new(model);
        let dofs = model.dof_count();
        let waves: Vec<(f64, f64, f64)> = (0..dofs)
            .map(|_| {
                let hertz = [0.25, 0.5, 0.75][random.below(3)];
                (0.3, std::f64::consts::TAU * hertz, random.real(3.0))
            })
            .collect();
        let readings = (0..PERIOD)
            .map(|millisecond| {
                let t = millisecond as f64 * 1e-3;
                let joints = |f: fn(&(f64, f64, f64), f64) -> f64| {
                    waves.iter().map(|wave| f(wave, t)).collect::<Vec<_>>()
                };
                let position = joints(|(a, w, p), t| a * (w * t + p).sin());
                let velocity = joints(|(a, w, p), t| a * w * (w * t + p).cos());
                let acceleration = joints(|(a, w, p), t| -a * w * w * (w * t + p).sin());
                let state = JointState {
                    position: &position,
                    velocity: &velocity,
                    acceleration: &acceleration,
                };
                // With a free base, the base swings to and fro, and the IMU measures it.
                let swing = match base {
                    Base::Standing => 0.0,
                    Base::Free => 0.5 * (std::f64::consts::TAU * 0.25 * t).sin(),
                };
                let down = Vec3::new(9.80665 * f64::sin(swing), 0.0, -9.80665 * f64::cos(swing));
                let motion = FrameMotion::standing(&down);
                kinematics.update(model, state, &motion).expect("a state");
                inverse
                    .update(model, &kinematics, &[])
                    .expect("no wrenches");
                if let Some(number) = stance {
                    // The ground reaction acts on the foot instead of the base.
                    let link = sensors[number].joint() + 1;
                    let in_world = kinematics
                        .pose(kinematics.base())
                        .wrench(&inverse.base_wrench());
                    let carried = ExternalWrench {
                        frame: Frame {
                            link,
                            pose: Pose::identity(),
                        },
                        wrench: kinematics.pose(link).wrench_back(&in_world),
                    };
                    inverse
                        .update(model, &kinematics, &[carried])
                        .expect("a wrench");
                    assert!(inverse.base_wrench().force.norm() < 1e-6);
                }
                let reading = |role: ChannelRole| match role {
                    ChannelRole::Joint(dof) => Reading::Joint(Encoder {
                        position: position[dof],
                        ..Encoder::ABSENT
                    }),
                    ChannelRole::Sensor(number) => {
                        let cut = &setup.robot.structure.sensors()[number];
                        let Wrench { torque, force } =
                            cut.reading(&inverse.transmitted(&kinematics, cut.joint()));
                        Reading::Wrench(ForceTorque {
                            force: force.into(),
                            torque: torque.into(),
                        })
                    }
                    ChannelRole::Base => Reading::Imu(Imu {
                        proper_acceleration: motion.proper_acceleration.into(),
                        angular_velocity: [0.0; 3],
                        angular_acceleration: [0.0; 3],
                        ..Imu::ABSENT
                    }),
                };
                setup
                    .robot
                    .channels
                    .iter()
                    .map(|channel| reading(channel.role))
                    .collect()
            })
            .collect();
        let touch = stance.and_then(|number| setup.robot.contact(&format!("touch{number}")));
        assert_eq!(touch.is_some(), stance.is_some());
        let mut pipeline = Pipeline::new(setup);
        if let Some(contact) = touch {
            pipeline.declare(contact, Nanos::ZERO, &ContactState::configured(true));
        }
        let mut bench = Self {
            pipeline,
            readings,
            random,
            now: 1,
        };
        if rate_hz.is_some() {
            assert!(bench.pipeline.identification_refused().is_none());
        }
        // Until the gate uses solutions and the noise is known.
        (0..4).for_each(|_| bench.second(true));
        bench
    }

    /// A second of samples.
    fn second(&mut self, solves: bool) {
        for _ in 0..1000 {
            let t = Nanos::from_millis(i64::try_from(self.now).expect("a while"));
            for (channel, reading) in self.readings[self.now % PERIOD].iter().enumerate() {
                let mut reading = *reading;
                if let Reading::Wrench(wrench) = &mut reading {
                    let six = wrench.force.iter_mut().chain(&mut wrench.torque);
                    // Uniform distribution with this standard deviation.
                    six.zip(NOISE)
                        .for_each(|(x, noise)| *x += self.random.real(1.732 * noise));
                }
                self.pipeline.push(channel, t, &reading, Quality::GOOD);
                while self.pipeline.poll().is_some() {
                    if solves && let Some(mut job) = self.pipeline.take_job() {
                        job.run();
                        self.pipeline.give_back(job);
                    }
                }
            }
            self.now += 1;
        }
    }

    /// Checks that every component uses its rows: otherwise the benchmark measures something else.
    fn check(&self) {
        let online = self.pipeline.identification().expect("it identifies");
        for group in 0..online.solution().components.len() {
            let (paused, counts) = online.state(group).expect("a group");
            assert!(
                counts.learnt * 20 > (counts.suspected + counts.outlier) && counts.failed == 0,
                "{paused:?} {counts:?}"
            );
        }
    }
}

/// Torques and contacts alone.
#[divan::bench(args = [Base::Standing, Base::Free], sample_count = 10, sample_size = 1)]
fn a_estimates(bencher: Bencher<'_, '_>, base: Base) {
    let mut bench = Bench::new(base, None);
    bencher
        .counter(ItemsCount::new(1_usize))
        .bench_local(|| bench.second(false));
}

/// With identification: rows at this rate, and the solver once a second, in any thread.
#[divan::bench(
    args = [(Base::Standing, 100.0), (Base::Free, 100.0)],
    sample_count = 10,
    sample_size = 1
)]
fn b_estimates_and_learns(bencher: Bencher<'_, '_>, (base, rate): (Base, f64)) {
    let mut bench = Bench::new(base, Some(rate));
    bencher
        .counter(ItemsCount::new(1_usize))
        .bench_local(|| bench.second(true));
    bench.check();
}

/// The part of that in the data plane: without the solver.
#[divan::bench(
    args = [(Base::Standing, 100.0), (Base::Free, 100.0)],
    sample_count = 10,
    sample_size = 1
)]
fn c_of_which_in_the_data_plane(bencher: Bencher<'_, '_>, (base, rate): (Base, f64)) {
    let mut bench = Bench::new(base, Some(rate));
    bencher
        .counter(ItemsCount::new(1_usize))
        .bench_local(|| bench.second(false));
    bench.check();
}
