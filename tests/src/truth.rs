//! Is a valid torque true? A robot at random moves at random, something goes wrong, and the
//! estimator gets the readings, with identification on.
//!
//! ```text
//! seed -> Robot (URDF, estimator.toml) -> World (true bodies, motion, forces)
//!                                            -> readings -> trouble -> Pipeline -> judged
//! ```
//!
//! What is promised, and what use is, [`crate::promise`] tells.
//!
//! One seed is one run. The short set of `tests/truth.rs` runs with the other tests; the long one
//! is `cargo run --release -p proprio-tests --bin truth`.

pub(crate) mod random;
pub(crate) mod robot;
mod trouble;
mod world;

pub use crate::promise::Outcome;
pub use trouble::{Defect, TROUBLES, Trouble, When};

use crate::promise::Judge;
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{Imu, JointState, Kind, Nanos, Quality, Reading, Wrench};
use random::Random;
use robot::Robot;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use trouble::Series;
use world::{DURATION, World};

/// The readings of a run.
pub struct Run {
    robot: Robot,
    setup: Setup,
    world: World,
    series: Vec<Series>,
    channel: Option<String>,
}

impl Run {
    /// The run of `seed` with `trouble`; `None` if the robot of that seed has no channel for it.
    ///
    /// # Panics
    /// If the robot cannot be simulated.
    #[must_use]
    pub fn new(seed: u64, trouble: Trouble) -> Option<Self> {
        let mut robot = Robot::new(seed);
        let random = &mut Random::new(seed, "readings");
        let sensors = robot::tables(&mut robot.config, "force_torque").count();
        let offsets: Vec<[f64; 6]> = (0..sensors)
            .map(|_| {
                let mut axis = |most: f64| random.uniform(-most, most);
                [50.0, 50.0, 50.0, 2.0, 2.0, 2.0].map(&mut axis)
            })
            .collect();
        let mut learn = true;
        if let Trouble::Stated(by) | Trouble::NotLearning(by) = trouble {
            learn = matches!(trouble, Trouble::Stated(_));
            let tables = robot::tables(&mut robot.config, "force_torque");
            for (sensor, [x, y, z, nx, ny, nz]) in tables.zip(&offsets) {
                let mut off = |value: [f64; 3], by: f64| {
                    let off = random.direction() * by;
                    robot::numbers(proprio_dynamics::spatial::Vec3::from(value) + off)
                };
                sensor.insert("offset_n".into(), off([*x, *y, *z], by));
                sensor.insert("offset_nm".into(), off([*nx, *ny, *nz], 0.03 * by));
            }
        }
        robot::set(&mut robot.config, "identification", "enabled", learn);
        let setup = Setup::with_model(&robot.config(), robot.cad.clone());
        let setup = setup.unwrap_or_else(|e| panic!("{}: {e}\n{}", robot.name, robot.config));
        let mut world = World::new(&robot, &setup, trouble, seed);
        let mut series = readings(&setup, &mut world, &offsets, random);
        let mut channel = None;
        if let Trouble::Channel(kind, defect) = trouble {
            let from = series.iter().position(|s| s.kind == kind)?;
            let count = series.iter().filter(|s| s.kind == kind).count();
            let bad = random.below(count);
            channel = Some(series[from + bad].name.clone());
            defect.apply(&mut series[from..from + count], bad, random);
        }
        Some(Self {
            robot,
            setup,
            world,
            series,
            channel,
        })
    }

    /// The log, as `proprio estimate` reads it, the configuration and the URDF.
    #[must_use]
    pub fn files(&self) -> [String; 3] {
        let mut rows: Vec<(f64, usize, usize)> = Vec::new();
        let mut header = String::from("t");
        let mut width = 0;
        for (number, series) in self.series.iter().enumerate() {
            let names: &[&str] = match series.kind {
                Kind::Wrench => &["fx", "fy", "fz", "tx", "ty", "tz"],
                Kind::Imu => &["ax", "ay", "az", "gx", "gy", "gz"],
                _ => &["position"],
            };
            for name in names {
                let _ = write!(header, ",{}/{}/{name}", series.kind.word(), series.name);
            }
            rows.extend(series.rows.iter().map(|(t, _)| (*t, number, width)));
            width += names.len();
        }
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut place = vec![0; self.series.len()];
        let mut log = header + "\n";
        for (t, number, before) in rows {
            let values = &self.series[number].rows[place[number]].1;
            place[number] += 1;
            let _ = write!(log, "{t:.9}{}", ",".repeat(before));
            values.iter().for_each(|value| {
                let _ = write!(log, ",{value:.9}");
            });
            log.push_str(&",".repeat(width - before - values.len()));
            log.push('\n');
        }
        [log, self.robot.config.to_string(), self.robot.urdf.clone()]
    }

    /// Estimates, and compares with the truth.
    #[must_use]
    pub fn judged(mut self) -> Outcome {
        let mut samples: Vec<(f64, usize, &[f64], Kind)> = Vec::new();
        for series in &self.series {
            let channel = self.setup.channel(series.kind, &series.name);
            let channel = channel.expect("the configuration names it");
            let rows = series.rows.iter();
            samples.extend(rows.map(|(t, values)| (*t, channel, &values[..], series.kind)));
        }
        samples.sort_by(|a, b| a.0.total_cmp(&b.0));
        let names: Vec<String> = (self.setup.channels())
            .map(|(_, name)| name.into())
            .collect();
        let joints: Vec<String> = self.setup.robot.joint_names().map(Into::into).collect();
        let (begin, world) = (self.world.rest + 10.0, &mut self.world);
        let mut truth = |t: f64| world.at(t).torque;
        let mut judge = Judge::new(joints, names, &mut truth, DURATION, begin);
        let mut pipeline = Pipeline::new(self.setup);
        let mut drain = |pipeline: &mut Pipeline| {
            while let Some(estimate) = pipeline.poll() {
                let torques = estimate.torques.joints();
                judge.on_estimate(estimate.t.seconds(), torques, &mut truth);
                if let Some(mut job) = pipeline.take_job() {
                    job.run();
                    pipeline.give_back(job);
                }
            }
        };
        for (t, channel, values, kind) in samples {
            pipeline.push(
                channel,
                Nanos::from_seconds(t),
                &reading(kind, values),
                Quality::GOOD,
            );
            drain(&mut pipeline);
        }
        pipeline.finish();
        drain(&mut pipeline);
        judge.outcome(self.robot.name, self.channel)
    }
}

/// The readings of all channels, with noise, each board at its own instants.
fn readings(
    setup: &Setup,
    world: &mut World,
    offsets: &[[f64; 6]],
    random: &mut Random,
) -> Vec<Series> {
    let period = [0.005, 0.01, 0.01, 0.02][random.below(4)];
    let together = random.happens(0.5);
    let phase = random.uniform(0.0, period);
    // Resolutions: none, or that of usual encoders and of 16 bits of usual ranges.
    let turn = [0.0, TAU / 65536.0, TAU / 16384.0][random.below(3)];
    let bits = if random.happens(0.5) {
        1.0 / 32768.0
    } else {
        0.0
    };
    let rounded = |value: f64, step: f64| match step > 0.0 {
        true => (value / step).round() * step,
        false => value,
    };
    let mut all = Vec::new();
    let mut add =
        |kind: Kind, name: &str, period: f64, phase: f64, read: &mut dyn FnMut(f64) -> Vec<f64>| {
            let mut rows = Vec::new();
            let mut slot = 0.0;
            while slot < DURATION {
                let t = slot + phase;
                rows.push((t, read(t)));
                slot += period;
            }
            let name = name.to_owned();
            all.push(Series { kind, name, rows });
        };
    for (number, (kind, name)) in setup.channels().enumerate() {
        let mut noise = Random::new(number as u64 ^ random.below(1 << 30) as u64, "noise");
        let first = if together {
            phase
        } else {
            random.uniform(0.0, period)
        };
        match kind {
            Kind::Joint => {
                let dof = setup.robot.joint_names().position(|joint| joint == name);
                let dof = dof.expect("its joint");
                let deviation = if turn > 0.0 { 2e-5 } else { 1e-4 };
                let mut read = |t| {
                    vec![rounded(
                        world.at(t).position[dof] + deviation * noise.normal(),
                        turn,
                    )]
                };
                add(kind, name, period, first, &mut read);
            }
            Kind::Wrench => {
                let role = setup.robot.channels.get(number).map(|channel| channel.role);
                let Some(ChannelRole::Sensor(sensor)) = role else {
                    continue;
                };
                let mut read = |t| {
                    let wrench = world.at(t).wrenches[sensor];
                    let axes = wrench.iter().zip(offsets[sensor]).enumerate();
                    let noisy = axes.map(|(axis, (value, offset))| {
                        let (deviation, range) = if axis < 3 {
                            (0.1, 1000.0)
                        } else {
                            (0.005, 40.0)
                        };
                        rounded(value + offset + deviation * noise.normal(), range * bits)
                    });
                    noisy.collect()
                };
                add(kind, name, 0.01, random.uniform(0.0, 0.01), &mut read);
            }
            Kind::Imu => {
                let mut read = |t| {
                    let axes = world.at(t).imu.unwrap_or_default();
                    let axes = axes.iter().enumerate();
                    let noisy = axes.map(|(axis, value)| {
                        let deviation = if axis < 3 { 0.01 } else { 1e-3 };
                        value + deviation * noise.normal()
                    });
                    noisy.collect()
                };
                add(kind, name, 0.01, random.uniform(0.0, 0.01), &mut read);
            }
            _ => {}
        }
    }
    all.sort_by_key(|series| match series.kind {
        Kind::Joint => 0,
        Kind::Wrench => 1,
        _ => 2,
    });
    all
}

fn reading(kind: Kind, values: &[f64]) -> Reading {
    let three = |from: usize| std::array::from_fn(|axis| values[from + axis]);
    match kind {
        Kind::Wrench => Reading::Wrench(Wrench {
            force: three(0),
            torque: three(3),
        }),
        Kind::Imu => Reading::Imu(Imu {
            proper_acceleration: three(0),
            angular_velocity: three(3),
            ..Imu::ABSENT
        }),
        _ => Reading::Joint(JointState {
            position: values[0],
            ..JointState::ABSENT
        }),
    }
}
