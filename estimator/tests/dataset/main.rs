//! Tests of `Dataset`: synthetic logs of a small arm with known truth, with one defect at a time;
//! and recorded logs where they are available.

#![allow(
    clippy::needless_range_loop,
    clippy::semicolon_if_nothing_returned,
    reason = "a joint's number counts in several tables; changes of a log are one expression each"
)]

mod findings;

use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{RigidInertia, Wrench};
use proprio_dynamics::{InverseDynamics, JointState, Kinematics};
use proprio_estimator::config::Config;
use proprio_estimator::differentiate::{Settings as WindowSettings, Window};
use proprio_estimator::sample_log;
use proprio_estimator::setup::Setup;
use proprio_identification::dataset::observation::Observation;
use proprio_identification::dataset::smooth::{Scratch, Smoother};
use proprio_identification::robot::BaseMotion;
use proprio_identification::{Dataset, Finding, LogRole, Robot, Severity};
use proprio_topics::{Nanos, Quality, Reason};
use std::path::{Path, PathBuf};

const URDF: &str = r#"<robot name="arm">
  <link name="base">
    <inertial><mass value="5"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial>
  </link>
  <link name="upper">
    <inertial><origin xyz="0.02 0.01 -0.1"/><mass value="2"/>
    <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial>
  </link>
  <link name="lower">
    <inertial><origin xyz="0.01 0.03 -0.12"/><mass value="1.5"/>
    <inertia ixx="0.015" ixy="0" ixz="0" iyy="0.015" iyz="0" izz="0.004"/></inertial>
  </link>
  <link name="hand">
    <inertial><origin xyz="0.05 0 -0.05"/><mass value="0.8"/>
    <inertia ixx="0.003" ixy="0" ixz="0" iyy="0.003" iyz="0" izz="0.002"/></inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.3"/><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="5"/>
  </joint>
  <joint name="ft" type="fixed">
    <origin xyz="0 0 -0.2"/><parent link="upper"/><child link="lower"/>
  </joint>
  <joint name="elbow" type="revolute">
    <origin xyz="0 0 -0.25"/><parent link="lower"/><child link="hand"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="5"/>
  </joint>
</robot>"#;

fn robot(more: &str) -> Robot {
    let text = format!(
        "schema = 1\nrobot = \"arm\"\nmodel = \"arm.urdf\"\n[base]\nkind = \"fixed\"\nlink = \
         \"base\"\n[[force_torque]]\nsensor = \"ft\"\njoint = \"ft\"\n{more}"
    );
    let config = Config::parse(&text).expect("a configuration");
    Setup::with_model(&config, Model::from_urdf(URDF, &["ft"]).expect("a model"))
        .expect("a setup")
        .robot
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Standard normal (Box and Muller).
    fn normal(&mut self) -> f64 {
        (-2.0 * self.unit().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * self.unit()).cos()
    }
}

/// Position, velocity, acceleration of a joint at a time \[rad, s\]: sums of sines. The shoulder
/// begins slowly after one second at rest.
fn motion(joint: usize, t: f64) -> [f64; 3] {
    let sines: [(f64, f64, f64); 3] = if joint == 0 {
        [(0.6, 0.21, 0.3), (0.3, 0.47, 1.1), (0.12, 0.83, 2.0)]
    } else {
        [(0.5, 0.31, 1.9), (0.35, 0.53, 0.2), (0.1, 0.91, 0.9)]
    };
    let mut sum = [0.0; 3];
    for (amplitude, hertz, phase) in sines {
        let omega = std::f64::consts::TAU * hertz;
        let angle = omega * t + phase;
        sum[0] += amplitude * angle.sin();
        sum[1] += amplitude * omega * angle.cos();
        sum[2] -= amplitude * omega * omega * angle.sin();
    }
    sum
}

/// The reading of the F/T sensor, and the joint torques, at a time \[s\].
fn truth(robot: &Robot, t: f64) -> (Wrench, Vec<f64>) {
    truth_of(robot, [motion(0, t), motion(1, t)])
}

/// The same in any state.
fn truth_of(robot: &Robot, states: [[f64; 3]; 2]) -> (Wrench, Vec<f64>) {
    let pick = |k: usize| states.map(|s| s[k]);
    let BaseMotion::Standing(base) = robot.base else {
        panic!("a fixed base")
    };
    let mut kinematics = Kinematics::new(&robot.model, robot.base_link).unwrap();
    let (position, velocity, acceleration) = (pick(0), pick(1), pick(2));
    let state = JointState {
        position: &position,
        velocity: &velocity,
        acceleration: &acceleration,
    };
    kinematics.update(&robot.model, state, &base).unwrap();
    let mut dynamics = InverseDynamics::new(&robot.model);
    dynamics.update(&robot.model, &kinematics, &[]).unwrap();
    let cut = robot.structure.sensors()[0];
    (
        cut.reading(&dynamics.transmitted(&kinematics, cut.joint())),
        dynamics.torque().to_vec(),
    )
}

/// A log as a table of numbers: stamps in nanoseconds, NaN where a cell is empty.
#[derive(Clone)]
struct Table {
    header: Vec<String>,
    rows: Vec<(i64, Vec<f64>)>,
}

impl Table {
    fn text(&self) -> String {
        let mut text = format!("t,{}\n", self.header.join(","));
        for (t, row) in &self.rows {
            text += &Nanos(*t).to_string();
            for v in row {
                text += &if v.is_nan() {
                    ",".to_owned()
                } else {
                    format!(",{v}")
                };
            }
            text.push('\n');
        }
        text
    }

    fn dataset(&self, robot: &Robot) -> Dataset {
        read(robot, self.text().as_bytes())
    }

    /// What is wrong with it.
    fn findings(&self, robot: &Robot) -> Vec<Finding> {
        self.dataset(robot).findings().to_vec()
    }
}

fn read(robot: &Robot, log: impl std::io::Read) -> Dataset {
    sample_log::dataset(robot, "log", LogRole::Train, log).expect("a log")
}

const COLUMNS: [&str; 8] = [
    "joint/shoulder/position",
    "joint/elbow/position",
    "wrench/ft/fx",
    "wrench/ft/fy",
    "wrench/ft/fz",
    "wrench/ft/tx",
    "wrench/ft/ty",
    "wrench/ft/tz",
];

const QUANTUM: f64 = 9.6e-4;

const OFFSET: [f64; 6] = [12.0, -35.0, 80.0, 1.1, -0.4, 0.7];

/// Encoders with a coarse quantum and an F/T sensor with noise and offset, at `rate` \[Hz\], stamps
/// that jitter by up to `jitter` of a period; F/T stamps are `late` \[s\]. Encoders and F/T have
/// rows of their own, as buses are read.
fn log(robot: &Robot, seconds: f64, rate: f64, jitter: f64, late: f64, seed: u64) -> Table {
    log_of(robot, motion, seconds, rate, jitter, late, seed)
}

/// The same with any motion.
fn log_of(
    robot: &Robot,
    motion: impl Fn(usize, f64) -> [f64; 3],
    seconds: f64,
    rate: f64,
    jitter: f64,
    late: f64,
    seed: u64,
) -> Table {
    let mut random = Random(seed);
    let (mut rows, count) = (Vec::new(), (seconds * rate) as usize);
    for i in 0..count {
        let mut stamp = |phase: f64| (i as f64 + phase + jitter * (random.unit() - 0.5)) / rate;
        let (encoder, wrench) = (stamp(0.2), stamp(0.6));
        let mut row = vec![f64::NAN; 8];
        for joint in 0..2 {
            row[joint] = (motion(joint, encoder)[0] / QUANTUM).round() * QUANTUM;
        }
        rows.push(((encoder * 1e9) as i64, row));
        let (reading, _) = truth_of(robot, [motion(0, wrench), motion(1, wrench)]);
        let noise = [0.08, 0.09, 0.18, 0.002, 0.003, 0.0015];
        let mut row = vec![f64::NAN; 8];
        for (k, value) in reading.force_first().into_iter().enumerate() {
            row[2 + k] = value + OFFSET[k] + noise[k] * random.normal();
        }
        rows.push((((wrench + late) * 1e9) as i64, row));
    }
    rows.sort_by_key(|(t, _)| *t);
    Table {
        header: COLUMNS.map(str::to_owned).to_vec(),
        rows,
    }
}

fn rms(errors: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = errors.fold((0.0, 0.0), |(s, n), e| (s + e * e, n + 1.0));
    (sum / count).sqrt()
}

/// Errors of velocity and acceleration, of the smoother and of the causal window, on one quantised
/// signal.
fn against_causal(
    stamps: &[f64],
    quantum: f64,
    signal: impl Fn(f64) -> [f64; 3],
) -> ([f64; 2], [f64; 2]) {
    let nanos: Vec<Nanos> = stamps.iter().map(|t| Nanos::from_seconds(*t)).collect();
    let values: Vec<f64> = stamps
        .iter()
        .map(|t| (signal(*t)[0] / quantum).round() * quantum)
        .collect();
    let smoother = Smoother::new(&nanos, &values, Nanos::from_millis(50));
    let mut scratch = Scratch::default();
    let mut window = Window::<1>::new(WindowSettings::new(0.5 * quantum)).unwrap();
    let (mut ours, mut causal) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()]);
    for (t, value) in nanos.iter().zip(&values) {
        window.push(*t, [*value]).unwrap();
        let truth = signal(t.seconds());
        if let (Ok(estimate), true) = (window.at(*t), t.seconds() > 1.3) {
            causal[0].push(estimate.first[0] - truth[1]);
            causal[1].push(estimate.second[0] - truth[2]);
        }
        if let Some(estimate) = smoother.at(*t, 1..=2, &mut scratch) {
            ours[0].push(estimate[1] - truth[1]);
            ours[1].push(estimate[2] - truth[2]);
        }
    }
    assert!(ours[0].len() > stamps.len() / 2 && causal[0].len() > stamps.len() / 2);
    (
        ours.map(|e| rms(e.into_iter())),
        causal.map(|e| rms(e.into_iter())),
    )
}

#[test]
fn derivatives_are_far_better_than_with_the_past_alone() {
    let sine = |t: f64| {
        let omega = std::f64::consts::PI;
        [
            20.0 * (omega * t).sin(),
            20.0 * omega * (omega * t).cos(),
            -20.0 * omega * omega * (omega * t).sin(),
        ]
    };
    let degrees = |t: f64| motion(0, t).map(f64::to_degrees);
    let regular = |rate: f64, seconds: f64| -> Vec<f64> {
        (0..(rate * seconds) as usize)
            .map(|i| i as f64 / rate)
            .collect()
    };
    let mut random = Random(4);
    let mut t = 0.0;
    let jittering: Vec<f64> = (0..1500)
        .map(|_| {
            t += 0.005 + 0.012 * random.unit();
            t
        })
        .collect();
    // Errors of velocity and acceleration [deg/s, deg/s^2] that must not be exceeded.
    for (name, (ours, causal), most) in [
        (
            "sine",
            against_causal(&regular(100.0, 12.0), 0.055, sine),
            [0.06, 1.2],
        ),
        (
            "arm",
            against_causal(&regular(100.0, 12.0), 0.055, degrees),
            [0.06, 1.5],
        ),
        (
            "arm, jitter",
            against_causal(&jittering, 0.088, degrees),
            [0.12, 2.5],
        ),
        (
            "arm, 1 kHz",
            against_causal(&regular(1000.0, 6.0), 5.5e-5, degrees),
            [1e-3, 0.02],
        ),
    ] {
        println!(
            "{name}: velocity {:.3e}, causal {:.3e} deg/s; acceleration {:.3e}, causal {:.3e} \
             deg/s^2",
            ours[0], causal[0], ours[1], causal[1]
        );
        for m in 0..2 {
            assert!(ours[m] < most[m], "{name}: {} exceeds {}", ours[m], most[m]);
            assert!(
                ours[m] < 0.4 * causal[m],
                "{name}: {} is not much better than {}",
                ours[m],
                causal[m]
            );
        }
    }
}

#[test]
fn a_quintic_is_reproduced_on_any_stamps() {
    let mut random = Random(2);
    let mut t = 0.0;
    let stamps: Vec<Nanos> = (0..300)
        .map(|_| {
            t += 0.004 + 0.01 * random.unit();
            Nanos::from_seconds(t)
        })
        .collect();
    let exact_at = |t: f64| {
        let u = t - 1.0;
        [
            0.3 + 0.7 * u - 0.4 * u.powi(2) + 0.2 * u.powi(3) - 0.1 * u.powi(4) + 0.05 * u.powi(5),
            0.7 - 0.8 * u + 0.6 * u.powi(2) - 0.4 * u.powi(3) + 0.25 * u.powi(4),
            -0.8 + 1.2 * u - 1.2 * u.powi(2) + u.powi(3),
        ]
    };
    let values: Vec<f64> = stamps.iter().map(|t| exact_at(t.seconds())[0]).collect();
    let smoother = Smoother::new(&stamps, &values, Nanos::from_millis(50));
    assert!(smoother.sigma() < 1e-9);
    let scratch = &mut Scratch::default();
    for i in 0..20 {
        let t = Nanos::from_seconds(0.5 + 0.07 * f64::from(i));
        let estimates = smoother.at(t, 0..=2, scratch).unwrap();
        for (m, tolerance) in [(0, 1e-9), (1, 1e-7), (2, 1e-5)] {
            let (estimate, exact) = (estimates[m], exact_at(t.seconds())[m]);
            // Alone as well as with the others.
            assert_eq!(smoother.at(t, m..=m, scratch).unwrap()[m], estimate);
            assert!(
                (estimate - exact).abs() < tolerance,
                "derivative {m} at {t}: {estimate} instead of {exact}"
            );
        }
    }
    assert_eq!(smoother.at(Nanos::from_seconds(0.02), 2..=2, scratch), None);
}

#[test]
fn a_clean_log_has_no_defects_and_its_instants_are_true() {
    let robot = robot("");
    for (rate, jitter) in [(100.0, 0.5), (500.0, 0.3)] {
        let instants = log(&robot, 20.0, rate, jitter, 0.0, 7).dataset(&robot);
        assert_eq!(instants.findings(), []);
        let usable: Vec<&Observation> = instants
            .observations()
            .iter()
            .filter(|i| i.faults.iter().all(|f| *f == Reason::None))
            .collect();
        assert!(
            usable.len() > 1920,
            "{} of {}",
            usable.len(),
            instants.observations().len()
        );
        let rms_of = |f: &dyn Fn(&Observation) -> f64| rms(usable.iter().map(|i| f(i)));
        for joint in 0..2 {
            let truth = |i: &Observation| motion(joint, i.t.seconds());
            let position = rms_of(&|i| i.position[joint] - truth(i)[0]);
            let velocity = rms_of(&|i| i.velocity[joint] - truth(i)[1]);
            let acceleration = rms_of(&|i| i.acceleration[joint] - truth(i)[2]);
            println!(
                "{rate} Hz, joint {joint}: {position:.2e} rad, {velocity:.2e} rad/s, \
                 {acceleration:.2e} rad/s^2"
            );
            assert!(
                position < 0.5 * QUANTUM / 12_f64.sqrt() && velocity < 2e-3 && acceleration < 0.03
            );
        }
        // An average of five samples has less than half the noise of one; an interpolation never
        // has more.
        for (k, (noise, offset)) in [0.08, 0.09, 0.18, 0.002, 0.003, 0.0015]
            .into_iter()
            .zip(OFFSET)
            .enumerate()
        {
            let error = rms_of(&|i| {
                i.readings[0].force_first()[k]
                    - offset
                    - truth(&robot, i.t.seconds()).0.force_first()[k]
            });
            assert!(
                error < noise * if rate > 100.0 { 0.55 } else { 1.05 },
                "{rate} Hz, axis {k}: {error}"
            );
        }
    }
}

#[test]
fn a_log_that_holds_everything_is_used_row_by_row() {
    let robot = robot("");
    let mut header = COLUMNS.map(str::to_owned).to_vec();
    for joint in ["shoulder", "elbow"] {
        header.extend(["velocity", "acceleration", "torque"].map(|q| format!("joint/{joint}/{q}")));
    }
    let rows: Vec<(i64, Vec<f64>)> = (0..400)
        .map(|i| {
            let t = f64::from(i) * 0.01;
            let (reading, torque) = truth(&robot, t);
            let mut row = vec![motion(0, t)[0], motion(1, t)[0]];
            row.extend(reading.force_first());
            for joint in 0..2 {
                row.extend([motion(joint, t)[1], motion(joint, t)[2], torque[joint]]);
            }
            (i64::from(i) * 10_000_000, row)
        })
        .collect();
    let table = Table { header, rows };
    let check = |instants: &Dataset| {
        assert_eq!(instants.findings(), []);
        assert_eq!(instants.observations().len(), table.rows.len());
        for (instant, (_, row)) in instants.observations().iter().zip(&table.rows) {
            assert!(instant.faults.iter().all(|f| *f == Reason::None));
            let mut held = instant.position.clone();
            held.extend(instant.readings[0].force_first());
            for joint in 0..2 {
                held.extend([
                    instant.velocity[joint],
                    instant.acceleration[joint],
                    instant.torque[joint],
                ]);
            }
            assert_eq!(&held, row);
        }
    };
    check(&table.dataset(&robot));
    // Rows that the recorder repeated, with the same stamp or a new one.
    let mut again = table.clone();
    for at in [350, 200, 120, 119, 70] {
        let (t, row) = again.rows[at].clone();
        again
            .rows
            .insert(at + 1, (t + if at > 150 { 0 } else { 3_000_000 }, row));
    }
    let recording = again.dataset(&robot);
    let [repeated] = recording.findings() else {
        panic!("{:?}", recording.findings());
    };
    assert_eq!(code(repeated), "repeated_rows");
    assert!(repeated.text.starts_with("5 rows repeat"), "{repeated:?}");
    assert!(repeated.text.contains("at 0.703"), "{repeated:?}");
    assert_eq!(recording.observations().len(), table.rows.len());
    // The same without stamps.
    let text: String = table
        .text()
        .lines()
        .enumerate()
        .map(|(i, l)| {
            if i == 0 {
                format!("{l}\n")
            } else {
                format!(",{}\n", l.split_once(',').unwrap().1)
            }
        })
        .collect();
    let recording = read(&robot, text.as_bytes());
    check(&recording);
}

#[test]
fn given_velocities_are_kept_and_differentiated() {
    let robot = robot("");
    let mut table = log(&robot, 10.0, 100.0, 0.0, 0.0, 1);
    table
        .header
        .extend(["joint/shoulder/velocity", "joint/elbow/velocity"].map(str::to_owned));
    for (t, row) in &mut table.rows {
        let given = (0..2).map(|j| {
            if row[0].is_nan() {
                f64::NAN
            } else {
                motion(j, Nanos(*t).seconds())[1]
            }
        });
        row.extend(given.collect::<Vec<_>>());
    }
    // RMS errors of the elbow's velocity and acceleration.
    let errors = |dataset: &Dataset| {
        let usable = (dataset.observations().iter()).filter(|i| i.knows_motion(&robot.channels));
        let errors: Vec<[f64; 2]> = usable
            .map(|i| {
                let [_, velocity, acceleration] = motion(1, i.t.seconds());
                [i.velocity[1] - velocity, i.acceleration[1] - acceleration]
            })
            .collect();
        assert!(errors.len() > 900);
        [0, 1].map(|k| rms(errors.iter().map(|e| e[k])))
    };
    let dataset = table.dataset(&robot);
    assert_eq!(dataset.findings(), []);
    let [velocity, acceleration] = errors(&dataset);
    println!("{velocity:.2e} {acceleration:.2e}");
    // The error of a linear interpolation between samples 10 ms apart is up to dt^2 / 8 times the
    // second derivative, 1e-3 here.
    assert!(velocity < 1e-6 && acceleration < 1e-5);
    // A bit has flipped in one of them.
    let last = table.header.len() - 1;
    let given = (500..).find(|row| !table.rows[*row].1[last].is_nan());
    table.rows[given.unwrap()].1[last] += 40.0;
    let dataset = table.dataset(&robot);
    let [finding] = dataset.findings() else {
        panic!("{:?}", dataset.findings());
    };
    let text = &finding.text;
    assert!(
        text.starts_with("joint/elbow: 1 outlier of velocity, the largest by 39.9"),
        "{text}"
    );
    let [velocity, acceleration] = errors(&dataset);
    assert!(
        velocity < 1e-3 && acceleration < 1e-2,
        "{velocity} {acceleration}"
    );
}

/// Accelerations that a controller has differenced are noise: those of the positions are better, or
/// those of recorded velocities.
#[test]
fn derivatives_that_are_noise_are_not_used() {
    let robot = robot("");
    for (reference, has_velocity) in [("positions", false), ("velocities", true)] {
        let mut table = log(&robot, 10.0, 100.0, 0.0, 0.0, 1);
        (table.header).push("joint/elbow/acceleration".to_owned());
        (table.header).extend(has_velocity.then(|| "joint/elbow/velocity".to_owned()));
        let mut noise = Random(3);
        for (t, row) in &mut table.rows {
            let [_, velocity, acceleration] = motion(1, Nanos(*t).seconds());
            let given = [acceleration + 12.0 * noise.normal(), velocity];
            let given = given.map(|own| if row[0].is_nan() { f64::NAN } else { own });
            row.extend_from_slice(&given[..=usize::from(has_velocity)]);
        }
        let instants = table.dataset(&robot);
        let [noisy] = instants.findings() else {
            panic!("{:?}", instants.findings());
        };
        let begin =
            format!("joint/elbow: the logged acceleration is not that of the {reference}: ");
        let off: f64 = (noisy.text.strip_prefix(&begin))
            .and_then(|rest| rest.split(' ').next()?.parse().ok())
            .unwrap_or_else(|| panic!("{}", noisy.text));
        assert!((off - 12.0).abs() < 1.5, "{off}");
        let usable = instants
            .observations()
            .iter()
            .filter(|i| i.knows_motion(&robot.channels));
        let error = rms(usable.map(|i| i.acceleration[1] - motion(1, i.t.seconds())[2]));
        assert!(error < 0.1, "{error}");
    }
}

/// The code of a finding.
fn code(finding: &Finding) -> &'static str {
    finding.code.as_str()
}

/// A recorded log, or none if it is not available.
fn data(file: &str) -> Option<PathBuf> {
    let Some(folder) = std::env::var_os("PROPRIO_DATA") else {
        println!("skipped: PROPRIO_DATA (recorded logs) is not set");
        return None;
    };
    let path = Path::new(&folder).join(file);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: there is no {}", path.display());
    None
}
