//! Is a valid torque true? A robot at random moves at random, something goes wrong, and the
//! estimator gets the readings, with identification on.
//!
//! ```text
//! seed -> Robot (URDF, estimator.toml) -> World (true bodies, motion, forces)
//!                                            -> readings -> trouble -> Pipeline -> judged
//! ```
//!
//! **The promise.** A valid torque is within four stated deviations of the truth, or within 1 % of
//! the joint's range (at least .02 Nm). A run breaks it if more than one of a thousand torques do.
//! **Use.** In a run without trouble 95 % of the torques are valid from ten seconds after the first
//! motion on.
//!
//! One seed is one run. The short set of `tests/truth.rs` runs with the other tests; the long one
//! is `cargo run --release -p proprio-tests --bin truth`.

mod random;
mod robot;
mod trouble;
mod world;

pub use trouble::{Defect, TROUBLES, Trouble, When};

use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{Imu, JointState, Kind, NO_CAUSE, Nanos, Quality, Reading, Wrench};
use random::Random;
use robot::Robot;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use toml::Table;
use trouble::Series;
use world::{DURATION, World};

/// Deviations within which a valid torque is.
const DEVIATIONS: f64 = 4.0;
/// The part of a joint's range that need not be covered, and its least \[Nm\].
const SMALL: (f64, f64) = (0.01, 0.02);
/// The share of a run's torques that may break the promise: four deviations are exceeded once in
/// 16,000 times by chance, but errors last for a while.
const FEW: f64 = 1e-3;

/// A valid torque that is not true.
#[derive(Debug, Clone)]
pub struct Worst {
    /// The joint.
    pub joint: String,
    /// When \[s\].
    pub t: f64,
    /// Its error \[Nm\].
    pub error: f64,
    /// Its error in stated deviations.
    pub deviations: f64,
    /// Its error as a part of the joint's range.
    pub share: f64,
}

/// What a run showed.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The robot, in words.
    pub robot: String,
    /// Torques: all; valid; valid and not true.
    pub torques: [usize; 3],
    /// Torques from ten seconds after the first motion on: all; valid.
    pub late: [usize; 2],
    /// The largest error of a valid torque that is not true.
    pub worst: Option<Worst>,
    /// The median deviation of late valid torques, as a part of the joint's range.
    pub deviation: f64,
    /// Why torques were withheld, and how often.
    pub withheld: BTreeMap<String, usize>,
    /// The channel that has the trouble.
    pub channel: Option<String>,
}

impl Outcome {
    /// Whether the promise is broken.
    #[must_use]
    pub fn is_broken(&self) -> bool {
        let [all, _, bad] = self.torques;
        bad as f64 > FEW * all as f64
    }

    /// The share of withheld torques that name the channel that has the trouble; NaN if there is
    /// none, or if no torque is withheld.
    #[must_use]
    pub fn named(&self) -> f64 {
        let Some(channel) = &self.channel else {
            return f64::NAN;
        };
        let own = self.withheld.iter();
        let own = own.filter(|(why, _)| why.split_once(':').is_some_and(|(_, c)| c == channel));
        let all: usize = self.withheld.values().sum();
        own.map(|(_, count)| count).sum::<usize>() as f64 / all as f64
    }

    /// The share of late torques that are valid.
    #[must_use]
    pub fn use_of(&self) -> f64 {
        self.late[1] as f64 / self.late[0].max(1) as f64
    }
}

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
        let mut identification = Table::new();
        identification.insert("enabled".into(), learn.into());
        robot
            .config
            .insert("identification".into(), identification.into());
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
        let mut judge = Judge::new(joints, names, &mut self.world);
        let mut pipeline = Pipeline::new(self.setup);
        let mut drain = |pipeline: &mut Pipeline| {
            while let Some(estimate) = pipeline.poll() {
                judge.on_estimate(
                    estimate.t.seconds(),
                    estimate.torques.joints(),
                    &mut self.world,
                );
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

/// Compares torques with the truth.
struct Judge {
    joints: Vec<String>,
    channels: Vec<String>,
    small: Vec<f64>,
    ranges: Vec<f64>,
    begin: f64,
    deviations: Vec<f64>,
    outcome: Outcome,
}

impl Judge {
    fn new(joints: Vec<String>, channels: Vec<String>, world: &mut World) -> Self {
        let mut least = vec![f64::INFINITY; joints.len()];
        let mut most = vec![f64::NEG_INFINITY; joints.len()];
        for step in 0..200 {
            let truth = world.at(DURATION / 200.0 * f64::from(step)).torque;
            for (torque, (least, most)) in truth.iter().zip(least.iter_mut().zip(&mut most)) {
                (*least, *most) = (least.min(*torque), most.max(*torque));
            }
        }
        let ranges: Vec<f64> = (least.iter().zip(&most))
            .map(|(a, b)| b - a + 0.1 * a.abs().max(b.abs()))
            .collect();
        let small = ranges.iter().map(|range| SMALL.1.max(SMALL.0 * range));
        Self {
            small: small.collect(),
            joints,
            channels,
            ranges,
            begin: world.rest + 10.0,
            deviations: Vec::new(),
            outcome: Outcome {
                robot: String::new(),
                torques: [0; 3],
                late: [0; 2],
                worst: None,
                deviation: f64::NAN,
                withheld: BTreeMap::new(),
                channel: None,
            },
        }
    }

    fn on_estimate(&mut self, t: f64, torques: &[proprio_topics::JointTorque], world: &mut World) {
        let truth = world.at(t).torque;
        for (joint, (torque, truth)) in torques.iter().zip(truth).enumerate() {
            let is_late = t > self.begin;
            self.outcome.torques[0] += 1;
            self.outcome.late[0] += usize::from(is_late);
            if torque.valid != 1 {
                let word = torque.reason.get().map_or("?", |reason| reason.word());
                let cause = match torque.cause {
                    NO_CAUSE => String::new(),
                    cause => format!(":{}", self.channels[cause as usize]),
                };
                *(self.outcome.withheld.entry(format!("{word}{cause}"))).or_default() += 1;
                continue;
            }
            self.outcome.torques[1] += 1;
            if is_late {
                self.outcome.late[1] += 1;
                self.deviations
                    .push(torque.standard_deviation / self.ranges[joint]);
            }
            let error = (torque.torque - truth).abs();
            let deviations = error / torque.standard_deviation;
            // A value that is not finite is no true one.
            let is_true = deviations <= DEVIATIONS || error <= self.small[joint];
            if !is_true {
                self.outcome.torques[2] += 1;
                let share = error / self.ranges[joint];
                if self
                    .outcome
                    .worst
                    .as_ref()
                    .is_none_or(|worst| share > worst.share)
                {
                    self.outcome.worst = Some(Worst {
                        joint: self.joints[joint].clone(),
                        t,
                        error,
                        deviations,
                        share,
                    });
                }
            }
        }
    }

    fn outcome(mut self, robot: String, channel: Option<String>) -> Outcome {
        (self.outcome.robot, self.outcome.channel) = (robot, channel);
        self.deviations.sort_by(f64::total_cmp);
        if let Some(median) = self.deviations.get(self.deviations.len() / 2) {
            self.outcome.deviation = *median;
        }
        self.outcome
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
    let mut of =
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
        let own = if together {
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
                of(kind, name, period, own, &mut read);
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
                of(kind, name, 0.01, random.uniform(0.0, 0.01), &mut read);
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
                of(kind, name, 0.01, random.uniform(0.0, 0.01), &mut read);
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

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::{JointTorque, Reason};

    /// An estimate of each joint that is off by so many of its deviations, which are a part of its
    /// range.
    fn judged(deviations: f64, part: f64) -> Outcome {
        let Run {
            setup, mut world, ..
        } = Run::new(2, Trouble::None).expect("a run");
        let names: Vec<String> = setup.robot.joint_names().map(Into::into).collect();
        let mut judge = Judge::new(names, vec!["one".into()], &mut world);
        let t = world.rest + 11.0;
        let truth = world.at(t).torque;
        let mut torques: Vec<JointTorque> = (truth.iter().zip(&judge.ranges))
            .map(|(truth, range)| JointTorque {
                torque: truth + deviations * part * range,
                standard_deviation: part * range,
                valid: 1,
                reason: Reason::None.into(),
                ..JointTorque::ABSENT
            })
            .collect();
        judge.on_estimate(t, &torques, &mut world);
        torques.truncate(1);
        torques[0] = JointTorque {
            cause: 0,
            reason: Reason::Stale.into(),
            ..JointTorque::ABSENT
        };
        judge.on_estimate(t, &torques, &mut world);
        judge.outcome("a robot".into(), None)
    }

    #[test]
    fn what_is_far_off_and_valid_is_not_true() {
        for (deviations, part, is_true) in [
            (3.9, 0.1, true),
            (-3.9, 0.1, true),
            (4.1, 0.1, false),
            (-4.1, 0.1, false),
            // Within the small part of the range.
            (9.0, 0.0005, true),
            (100.0, 0.005, false),
            (f64::NAN, 0.1, false),
        ] {
            let outcome = judged(deviations, part);
            let valid = outcome.torques[1];
            let bad = if is_true { 0 } else { valid };
            assert_eq!(
                outcome.torques,
                [valid + 1, valid, bad],
                "{deviations} {part}"
            );
            assert_eq!(outcome.late, [valid + 1, valid]);
            assert_eq!(outcome.is_broken(), !is_true);
            assert_eq!(outcome.withheld, [("stale:one".to_owned(), 1)].into());
            assert!((outcome.deviation - part).abs() < 1e-12 || !is_true);
        }
    }
}
