//! What `proprio identifiable` and `proprio excite` forecast, against what identification comes to
//! with simulated logs: true bodies and offsets drawn at random, readings with the stated noise,
//! encoders with small errors.

use proprio_dynamics::spatial::{Pose, RigidInertia, Vec3};
use proprio_dynamics::{FrameMotion, JointState, Kinematics};
use proprio_estimator::config::Config;
use proprio_estimator::sample_log;
use proprio_estimator::setup::Setup;
use proprio_identification::forecast::SensorNoise;
use proprio_identification::prior::link_cad_root;
use proprio_identification::robot::{BaseMotion, ChannelRole};
use proprio_identification::{CovarianceRoot, LogRole, Outcome, Robot, Verdict, identify};
use proprio_planning::excite::{Planner, Task};
use proprio_planning::knowledge::{limit, regime};
use proprio_planning::motion::{FourierSeries, JointLimits};
use proprio_planning::workspace::{Deviation, Puppet, RISE, Workspace, range};
use proprio_simulator::SimulatedRobot as Simulated;
use proprio_topics::Nanos;
use std::f64::consts::TAU;
use std::fmt::Write as _;

fn normal(rng: &mut fastrand::Rng) -> f64 {
    (-2.0 * (1.0 - rng.f64()).ln()).sqrt() * (TAU * rng.f64()).cos()
}

/// A shipped robot, of which all contacts that do not carry it come and go; with further F/T
/// sensors, and these `[identification]` keys.
fn shipped(name: &str, sensors: &[&str], identification: &str) -> Setup {
    let folder = Simulated::find(name).expect("a robot of this repository");
    let mut config = Config::load(&folder.join("estimator.toml")).unwrap();
    let contacts = config.contact.len();
    let tip = &mut config.contact[contacts - 1];
    tip.presence = proprio_estimator::config::Occurrence::Possible;
    for joint in sensors {
        let text = format!("sensor = \"{joint}.ft\"\njoint = {joint:?}");
        config.force_torque.push(toml::from_str(&text).unwrap());
    }
    config.identification = toml::from_str(identification).unwrap();
    Setup::new(&config).unwrap()
}

/// A motion of all joints within the URDF's limits.
fn task<'a>(robot: &'a Robot, seconds: f64, wanted: &[&str]) -> Task<'a> {
    let model = &robot.model;
    let limits = (0..model.dof_count()).map(|dof| {
        let velocity = model.velocity(model.dof_joint(dof).unwrap()).unwrap();
        Some(JointLimits {
            range: range(model, dof),
            velocity,
            acceleration: velocity / RISE,
        })
    });
    Task {
        robot,
        limits: limits.collect(),
        fences: Vec::new(),
        seconds,
        wanted: wanted.iter().map(|name| model.dof(name).unwrap()).collect(),
        noise: SensorNoise::stated(robot),
        known: None,
        seed: 3,
    }
}

/// The robot with bodies that are as far from CAD as the configuration states.
fn truth(robot: &Robot, seed: u64) -> Robot {
    let mut rng = fastrand::Rng::with_seed(seed);
    let mut truth = robot.clone();
    for (link, cad) in robot.model.inertias().iter().enumerate() {
        let root = link_cad_root(cad, robot.urdf_relative_std);
        let drawn = (0..1000).map(|_| {
            let mut phi = cad.parameters();
            for row in 0..10 {
                let z = normal(&mut rng);
                (0..10).for_each(|k| phi[k] += z * root[(row, k)]);
            }
            RigidInertia::from_parameters(&phi)
        });
        let is_body = |body: &RigidInertia| body.check(1e-9).is_ok();
        if let Some(body) = drawn.into_iter().find(is_body) {
            truth.model.set_inertia(link, body).unwrap();
        }
    }
    truth
}

/// What the boards of a simulated robot add to the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Boards {
    /// Joints report exact positions, velocities and accelerations.
    ExactJoints,
    /// Encoders report positions, to this peak error [rad].
    Encoders(f64),
}

/// What the sensors of the true robot record of a motion: a table of samples at 100 Hz, with the
/// stated noise, offsets at random, and errors of the gains of this standard deviation.
fn record(
    truth: &Robot,
    series: &FourierSeries,
    boards: Boards,
    gain_std: f64,
    seed: u64,
) -> String {
    let mut rng = fastrand::Rng::with_seed(seed);
    let of_joint = match boards {
        Boards::ExactJoints => &["position", "velocity", "acceleration"][..],
        Boards::Encoders(_) => &["position"],
    };
    let mut text = String::from("t");
    for channel in &truth.channels {
        let (kind, parts) = match channel.role {
            ChannelRole::Joint(_) => ("joint", of_joint),
            ChannelRole::Sensor(_) => ("wrench", &["fx", "fy", "fz", "tx", "ty", "tz"][..]),
            ChannelRole::Base => ("imu", &["ax", "ay", "az", "gx", "gy", "gz"][..]),
        };
        let name = &channel.name;
        let columns: Vec<String> = parts
            .iter()
            .map(|part| format!("{kind}/{name}/{part}"))
            .collect();
        write!(text, ",{}", columns.join(",")).unwrap();
    }
    text.push('\n');
    let mut sensors = Vec::new();
    for cut in truth.structure.sensors() {
        let (force, torque) = (cut.noise().force, cut.noise().torque);
        let norm = |three: [f64; 3]| three.iter().map(|x| x * x).sum::<f64>().sqrt();
        let length = norm(torque) / norm(force);
        let gains: [[f64; 6]; 6] = std::array::from_fn(|to| {
            std::array::from_fn(|of| {
                let unit = match (to < 3, of < 3) {
                    (true, false) => 1.0 / length,
                    (false, true) => length,
                    _ => 1.0,
                };
                gain_std * unit * normal(&mut rng)
            })
        });
        let offset = [8.0, 8.0, 8.0, 0.3, 0.3, 0.3].map(|size| size * normal(&mut rng));
        let noise: Vec<f64> = force.into_iter().chain(torque).collect();
        sensors.push((gains, offset, noise));
    }
    let mut puppet = Puppet::new(truth).unwrap();
    for t in series.instants(0.01) {
        let seen = puppet
            .observe(Nanos::from_seconds(t), &series.at(t))
            .unwrap();
        write!(text, "{t:.6}").unwrap();
        for channel in &truth.channels {
            let values: Vec<f64> = match (channel.role, boards) {
                (ChannelRole::Joint(dof), Boards::ExactJoints) => {
                    vec![
                        seen.position[dof],
                        seen.velocity[dof],
                        seen.acceleration[dof],
                    ]
                }
                (ChannelRole::Joint(dof), Boards::Encoders(peak)) => {
                    vec![seen.position[dof] + peak * (2.0 * rng.f64() - 1.0)]
                }
                (ChannelRole::Sensor(sensor), _) => {
                    let (gains, offset, noise) = &sensors[sensor];
                    let exact = seen.readings[sensor].force_first();
                    let part = |k: usize| {
                        let error: f64 = (0..6).map(|of| gains[k][of] * exact[of]).sum();
                        exact[k] - error + offset[k] + noise[k] * normal(&mut rng)
                    };
                    (0..6).map(part).collect()
                }
                (ChannelRole::Base, _) => {
                    let BaseMotion::Imu(pose) = &truth.base else {
                        panic!("an IMU");
                    };
                    let motion = seen.base.at(pose);
                    let all = motion.proper_acceleration.iter();
                    let all = all.chain(motion.angular_velocity.iter());
                    // Values that never change would count as those of a dead board.
                    all.map(|x| x + 1e-6 * normal(&mut rng)).collect()
                }
            };
            for value in values {
                write!(text, ",{value:.9}").unwrap();
            }
        }
        text.push('\n');
    }
    text
}

fn identified(robot: &Robot, logs: &[String]) -> Outcome {
    let datasets = logs
        .iter()
        .map(|log| sample_log::dataset(robot, "log.csv", LogRole::Train, log.as_bytes()).unwrap());
    identify(robot, datasets.collect(), &[], &mut |_| {}).unwrap()
}

/// Per torque, the deviation for this covariance.
fn deviations(robot: &Robot, workspace: &Workspace, covariance: &CovarianceRoot) -> Vec<f64> {
    let all = workspace.deviations(robot, covariance);
    all.iter().map(|own| own.torque.unwrap()).collect()
}

/// RMS of the errors of the torques in the workspace, with the identified bodies; offsets are as
/// the logs' end.
fn errors(truth: &Robot, workspace: &Workspace, outcome: &Outcome) -> Vec<f64> {
    let links = &outcome.links;
    let torque = |rows: &dyn Fn(usize, usize) -> f64, states: usize| -> f64 {
        let square = (0..states).map(|state| {
            let mut error = 0.0;
            for (link, own) in links.iter().enumerate() {
                let found = own.identified.parameters();
                let right = truth.model.inertias()[link].parameters();
                for k in 0..10 {
                    error += rows(state, 10 * link + k) * (found[k] - right[k]);
                }
            }
            error * error
        });
        (square.sum::<f64>() / states as f64).sqrt()
    };
    let all = workspace.torques();
    all.map(|(_, rows)| {
        let rows = rows.unwrap();
        torque(&|state, column| rows[(state, column)], rows.nrows())
    })
    .collect()
}

/// Per torque: the joint, its deviation before, as forecast, after a random motion, and per
/// simulated robot the stated one and the error, both relative to the forecast.
struct Compared {
    joint: String,
    before: f64,
    forecast: f64,
    random: f64,
    stated: Vec<f64>,
    errors: Vec<f64>,
}

/// Plans a motion, and identifies some true robots with it.
fn compare(
    setup: &Setup,
    seconds: f64,
    wanted: &[&str],
    (boards, gain_std): (Boards, f64),
    seeds: u64,
) -> Vec<Compared> {
    let robot = &setup.robot;
    let planner = Planner::new(task(robot, seconds, wanted), robot).unwrap();
    let plan = planner.plan(&mut |_| {}).unwrap();
    let random: Vec<_> = (0..5)
        .map(|seed| {
            planner
                .deviations(&planner.random_motion(seed).unwrap())
                .unwrap()
        })
        .collect();
    let found: Vec<_> = (0..seeds)
        .map(|seed| {
            let truth = truth(robot, seed);
            let log = record(&truth, &plan.series, boards, gain_std, seed);
            let outcome = identified(robot, &[log]);
            assert_eq!(outcome.verdict, Verdict::Identified);
            let stated = deviations(robot, planner.workspace(), &outcome.covariance);
            (stated, errors(&truth, planner.workspace(), &outcome))
        })
        .collect();
    let torque = |(k, after): (usize, &Deviation)| {
        let forecast = after.torque.unwrap();
        Compared {
            joint: robot.model.dof_name(after.dof).to_owned(),
            before: plan.before[k].torque.unwrap(),
            forecast,
            random: median(random.iter().map(|own| own[k].torque.unwrap()).collect()) / forecast,
            stated: found
                .iter()
                .map(|(stated, _)| stated[k] / forecast)
                .collect(),
            errors: found
                .iter()
                .map(|(_, errors)| errors[k] / forecast)
                .collect(),
        }
    };
    let all: Vec<Compared> = plan.after.iter().enumerate().map(torque).collect();
    println!("{} {seconds} s, {boards:?}, gains {gain_std}", robot.name);
    for own in &all {
        let Compared {
            joint,
            before,
            forecast,
            random,
            stated,
            errors,
        } = own;
        println!(
            "  {joint}: {before:.4} to {forecast:.5}; stated {stated:.2?}, errors {errors:.2?}; \
             random motions {random:.2}"
        );
    }
    all
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

const NO_GAINS: &str = "gain = \"none\"";

/// The forecast of a motion is what identification states after it; random motions of the same
/// length tell far less.
#[test]
fn a_forecast_is_what_identification_comes_to() {
    let cases = [
        (
            "icub_left_arm",
            &["l_elbow", "l_wrist_pitch", "l_wrist_yaw"],
        ),
        ("six_axis_arm", &["joint_2", "joint_3", "joint_5"]),
    ];
    for (name, wanted) in cases {
        let setup = shipped(name, &[], NO_GAINS);
        let all = compare(&setup, 12.0, wanted, (Boards::ExactJoints, 0.0), 3);
        for own in all {
            let (joint, stated) = (&own.joint, median(own.stated));
            let is_wanted = wanted.contains(&joint.as_str());
            let most = if is_wanted { 1.2 } else { 1.3 };
            assert!((0.8..most).contains(&stated), "{name} {joint}: {stated}");
            let errors = own.errors;
            assert!(
                errors.iter().all(|error| *error < 4.0),
                "{joint}: {errors:?}"
            );
            if is_wanted {
                assert!(own.random > 2.0, "{name} {joint}: {}", own.random);
                assert!(own.before > 20.0 * own.forecast, "{name} {joint}");
            }
        }
    }
}

/// The same for all shipped robots, with gains and encoders: figures only.
#[test]
#[ignore = "minutes: the figures of the book's page on forecasts"]
fn figures() {
    let cases = [
        ("moteus_leg", &["hip_roll", "hip_pitch", "knee"]),
        (
            "icub_left_arm",
            &["l_elbow", "l_wrist_pitch", "l_wrist_yaw"],
        ),
        ("six_axis_arm", &["joint_2", "joint_3", "joint_5"]),
    ];
    for (name, wanted) in cases {
        for seconds in [12.0] {
            let plain = shipped(name, &[], NO_GAINS);
            let with_gains = shipped(name, &[], "gain_std = 0.02");
            for (setup, boards, gains) in [
                (&plain, Boards::ExactJoints, 0.0),
                (&plain, Boards::Encoders(2e-5), 0.0),
                (&with_gains, Boards::ExactJoints, 0.02),
            ] {
                compare(setup, seconds, wanted, (boards, gains), 3);
            }
        }
    }
}

/// The benefit of a further sensor is what identification with it comes to: what is said to be
/// certain then is, and the rest is as uncertain as was said.
#[test]
fn a_further_sensor_helps_as_forecast() {
    let wanted = ["l_shoulder_pitch", "l_shoulder_roll", "l_shoulder_yaw"];
    for sensors in [&[][..], &["l_shoulder_roll"], &["l_shoulder_pitch"]] {
        let setup = shipped("icub_left_arm", sensors, NO_GAINS);
        let robot = &setup.robot;
        let planner = Planner::new(task(robot, 12.0, &wanted), robot).unwrap();
        let series = planner.random_motion(1).unwrap();
        let forecast = planner.deviations(&series).unwrap();
        let end = limit(robot, &regime(robot), planner.workspace()).unwrap();
        let truth = truth(robot, 4);
        let log = record(&truth, &series, Boards::ExactJoints, 0.0, 4);
        let outcome = identified(robot, &[log]);
        let stated = deviations(robot, planner.workspace(), &outcome.covariance);
        let errors = errors(&truth, planner.workspace(), &outcome);
        println!("sensors beside the arm's: {sensors:?}");
        for (k, name) in wanted.iter().enumerate() {
            let (end, after) = (end[k].torque.unwrap(), forecast[k].torque.unwrap());
            println!(
                "  {name}: in the end {end:.5}, forecast {after:.5}, stated {:.5}, error {:.5}",
                stated[k], errors[k]
            );
            assert!(
                end <= after && (stated[k] / after - 1.0).abs() < 0.25,
                "{name}"
            );
            assert!(errors[k] < 4.0 * stated[k], "{name}");
            // What no reading contains stays as uncertain as it was; the rest is nearly certain.
            assert_eq!(end > 1e-3, after > 2e-3, "{name}: {end} {after}");
        }
    }
}

/// What an earlier log told counts as known: the forecast of a second log is what identification
/// states from both.
#[test]
fn a_forecast_starts_from_what_is_known() {
    let setup = shipped("icub_left_arm", &[], NO_GAINS);
    let robot = &setup.robot;
    let wanted = ["l_elbow", "l_wrist_pitch", "l_wrist_yaw"];
    let first = Planner::new(task(robot, 12.0, &wanted), robot).unwrap();
    let series = [1, 2].map(|seed| first.random_motion(seed).unwrap());
    let truth = truth(robot, 5);
    let logs = [0, 1].map(|k| record(&truth, &series[k], Boards::ExactJoints, 0.0, k as u64));
    let known = identified(robot, &logs[..1]);
    let both = identified(robot, &logs);
    let mut task = task(robot, 12.0, &wanted);
    task.known = Some(known.covariance.clone());
    let planner = Planner::new(task, robot).unwrap();
    let before = planner.before().unwrap();
    let after = planner.deviations(&series[1]).unwrap();
    let alone = first.deviations(&series[1]).unwrap();
    let stated = deviations(robot, planner.workspace(), &both.covariance);
    for name in wanted {
        let dof = robot.model.dof(name).unwrap();
        let k = after.iter().position(|own| own.dof == dof).unwrap();
        let [before, after, alone] = [&before, &after, &alone].map(|own| own[k].torque.unwrap());
        println!(
            "{name}: {before:.5} to {after:.5}, without {alone:.5}, stated {:.5}",
            stated[k]
        );
        assert!(after < before && after < alone, "{name}");
        assert!(
            (stated[k] / after - 1.0).abs() < 0.25,
            "{name}: {} {after}",
            stated[k]
        );
    }
}

/// Per joint: name, position, velocity and acceleration.
type Joints = Vec<(String, [Vec<f64>; 3])>;

/// The times and the joints of a table of samples.
fn columns(table: &str) -> (Vec<f64>, Joints) {
    let mut lines = table.lines().map(|line| line.split(','));
    let names: Vec<&str> = lines.next().unwrap().collect();
    let rows: Vec<Vec<f64>> = lines
        .map(|cells| cells.map(|cell| cell.parse().unwrap()).collect())
        .collect();
    let column = |name: &str| -> Vec<f64> {
        let at = names.iter().position(|own| *own == name).unwrap();
        rows.iter().map(|row| row[at]).collect()
    };
    let joints = names
        .iter()
        .filter_map(|name| name.strip_suffix("/position"));
    let joints = joints.map(|name| {
        let parts = ["position", "velocity", "acceleration"];
        let values = parts.map(|part| column(&format!("{name}/{part}")));
        (name.strip_prefix("joint/").unwrap().to_owned(), values)
    });
    (column("t"), joints.collect())
}

/// The cubic between two rows, by positions and velocities.
fn between(h: f64, [q0, q1]: [f64; 2], [v0, v1]: [f64; 2], s: f64) -> f64 {
    let (s2, s3) = (s * s, s * s * s);
    q0 * (2.0 * s3 - 3.0 * s2 + 1.0)
        + q1 * (3.0 * s2 - 2.0 * s3)
        + h * (v0 * (s3 - 2.0 * s2 + s) + v1 * (s3 - s2))
}

fn proprio(args: &[&str]) -> (bool, String, String) {
    let output = std::process::Command::new(proprio_tests::Rig::program())
        .args(args)
        .output();
    let output = output.expect("proprio runs");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("text");
    (
        output.status.success(),
        text(output.stdout),
        text(output.stderr),
    )
}

fn config(robot: &str) -> String {
    let folder = Simulated::find(robot).expect("a robot of this repository");
    folder.join("estimator.toml").to_str().unwrap().to_owned()
}

/// The written table keeps limits and box, between its rows too, and starts and stops at rest.
#[test]
fn a_written_motion_keeps_limits_and_box() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("motion.csv");
    let out = out.to_str().unwrap();
    let config = config("moteus_leg");
    let args = [
        "excite",
        "--config",
        &config,
        "--absent",
        "foot",
        "--seconds",
        "8",
        "--out",
        out,
    ];
    let limits = [
        "--limit",
        "knee=0.5,1.5,1.2,3",
        "--box",
        "shank@0,0,-0.2=-0.3,0.1,-1,1,-1,1",
    ];
    let (is_good, told, error) = proprio(&[&args[..], &limits[..], &["--json"]].concat());
    assert!(is_good, "{error}");
    let report: serde_json::Value = serde_json::from_str(&told).unwrap();
    for torque in report["torques"].as_array().unwrap() {
        let [before, after] = ["before", "after"].map(|key| torque[key].as_f64().unwrap());
        assert!(torque["wanted"] == true && after < before / 5.0, "{torque}");
    }
    let setup = shipped("moteus_leg", &[], NO_GAINS);
    let model = &setup.robot.model;
    let (t, joints) = columns(&std::fs::read_to_string(out).unwrap());
    assert!(t[0] == 0.0 && (t[t.len() - 1] - 8.0).abs() < 1e-9 && joints.len() == 3);
    let (shank, base) = (model.frame("shank").unwrap(), setup.robot.base_link);
    let toe = shank.pose * Pose::from_xyz_rpy([0.0, 0.0, -0.2], [0.0; 3]);
    let mut kinematics = Kinematics::new(model, base).unwrap();
    let mut reached = [f64::MAX, f64::MIN];
    for row in 0..t.len() - 1 {
        let h = t[row + 1] - t[row];
        for step in 0..10 {
            let s = f64::from(step) / 10.0;
            let mut position = vec![0.0; 3];
            for (name, [q, v, a]) in &joints {
                let at = |values: &[f64]| [values[row], values[row + 1]];
                let middle = between(h, at(q), at(v), s);
                let velocity = between(h, at(v), at(a), s);
                let (dof, joint) = (model.dof(name).unwrap(), model.joint(name).unwrap());
                let range = model.limits(joint).unwrap();
                let (range, most) = match name.as_str() {
                    "knee" => ([0.5, 1.5], [1.2, 3.0]),
                    _ => ([range.lower, range.upper], [2.5, 5.0]),
                };
                assert!(
                    middle > range[0] && middle < range[1],
                    "{name}: {middle} at {}",
                    t[row]
                );
                assert!(velocity.abs() < most[0], "{name}: {velocity} at {}", t[row]);
                assert!(
                    at(a).iter().all(|a| a.abs() < most[1]),
                    "{name} at {}",
                    t[row]
                );
                position[dof] = middle;
            }
            let still = [0.0; 3];
            let state = JointState {
                position: &position,
                velocity: &still,
                acceleration: &still,
            };
            let motion = FrameMotion::standing(&Vec3::zeros());
            kinematics.update(model, state, &motion).unwrap();
            let x = (*kinematics.pose(shank.link) * toe).translation.x;
            assert!(x > -0.3 && x < 0.1, "{x} at {}", t[row]);
            reached = [reached[0].min(x), reached[1].max(x)];
        }
    }
    println!(
        "the toe moves from {:.3} to {:.3} m",
        reached[0], reached[1]
    );
    assert!(reached[1] - reached[0] > 0.1, "it uses its room");
    for (name, [_, v, a]) in &joints {
        for row in [0, t.len() - 1] {
            assert!(
                v[row].abs() < 1e-9 && a[row].abs() < 1e-9,
                "{name} is at rest"
            );
        }
    }
}

/// Any random motion keeps all limits at any time.
#[test]
fn random_motions_keep_the_limits_at_any_time() {
    let setup = shipped("icub_left_arm", &[], NO_GAINS);
    let robot = &setup.robot;
    for seconds in [4.0, 12.0, 31.7] {
        let task = task(robot, seconds, &["l_elbow"]);
        let limits = task.limits.clone();
        let planner = Planner::new(task, robot).unwrap();
        for seed in 0..8 {
            let series = planner.random_motion(seed).unwrap();
            let mut reached = vec![0.0_f64; limits.len()];
            for t in series.instants(0.0013) {
                let state = series.at(t);
                for (dof, limits) in limits.iter().enumerate() {
                    let limits = limits.unwrap();
                    let q = state.position[dof];
                    assert!(
                        q > limits.range.lower && q < limits.range.upper,
                        "{dof}: {q}"
                    );
                    let shares = [
                        state.velocity[dof].abs() / limits.velocity,
                        state.acceleration[dof].abs() / limits.acceleration,
                    ];
                    reached[dof] = shares.into_iter().fold(reached[dof], f64::max);
                }
            }
            assert!(reached.iter().all(|share| *share < 1.0), "{reached:?}");
        }
    }
}

/// Equal commands give equal tables, another seed another.
#[test]
fn a_motion_depends_on_its_seed_alone() {
    let config = config("moteus_leg");
    let table = |seed: &str| {
        let args = [
            "excite",
            "--config",
            &config,
            "--absent",
            "foot",
            "--seconds",
            "4",
        ];
        proprio(&[&args[..], &["--seed", seed, "--out", "-"]].concat()).1
    };
    let first = table("1");
    assert!(first.lines().count() == 402 && first == table("1") && first != table("2"));
}

#[test]
fn what_is_identifiable_is_told() {
    let config = config("icub_left_arm");
    let args = [
        "identifiable",
        "--config",
        &config,
        "--absent",
        "hand",
        "--json",
    ];
    let (is_good, told, error) = proprio(&args);
    assert!(is_good, "{error}");
    let report: serde_json::Value = serde_json::from_str(&told).unwrap();
    let set = &report["sets"][0];
    assert_eq!(
        (set["rank"].as_u64(), set["unknowns"].as_u64()),
        (Some(44), Some(96))
    );
    assert_eq!(set["base_parameters"].as_array().unwrap().len(), 44);
    for torque in set["torques"].as_array().unwrap() {
        let [cad, end] =
            ["deviation_cad", "deviation_identified"].map(|key| torque[key].as_f64().unwrap());
        let is_shoulder = torque["joint"].as_str().unwrap().contains("shoulder");
        assert_eq!(end > 1e-6, is_shoulder, "{torque}");
        assert_eq!(
            torque["cad_of"].as_array().unwrap().is_empty(),
            !is_shoulder,
            "{torque}"
        );
        assert!(cad > 3.0 * end, "{torque}");
    }
    let first = &set["remedies"]["sensors"][0];
    assert_eq!(first["joint"], "l_shoulder_pitch");
    assert!(first["deviation"].as_f64().unwrap() < 1e-3, "{first}");
    // Sets of sensors are compared.
    let urdf = config.replace("estimator.toml", "model.urdf");
    for base in ["fixed", "imu"] {
        let mut args = vec!["identifiable", &urdf, "--base", base, "--json"];
        for sensors in [
            "l_wrist_yaw",
            "l_arm_ft_sensor",
            "l_arm_ft_sensor,l_wrist_yaw",
        ] {
            args.extend(["--sensors", sensors]);
        }
        let report: serde_json::Value = serde_json::from_str(&proprio(&args).1).unwrap();
        let ranks = report["sets"]
            .as_array()
            .unwrap()
            .iter()
            .map(|set| set["rank"].as_u64());
        assert_eq!(
            ranks.collect::<Vec<_>>(),
            [Some(16), Some(44), Some(60)],
            "{base}"
        );
    }
}

/// What is wrong, where, and what is possible.
#[test]
fn wrong_questions_are_answered_clearly() {
    let folder = tempfile::tempdir().unwrap();
    let (leg, arm) = (config("moteus_leg"), config("icub_left_arm"));
    let urdf = arm.replace("estimator.toml", "model.urdf");
    let write = |name: &str, text: &str| {
        let file = folder.path().join(name);
        std::fs::write(&file, text).unwrap();
        file.to_str().unwrap().to_owned()
    };
    let model = std::fs::read_to_string(&urdf).unwrap();
    let free = model.replace(
        "upper=\"0.1745\" effort=\"40\" velocity=\"2\"",
        "effort=\"40\"",
    );
    assert_ne!(free, model);
    let free = free.replace("lower=\"-1.6668\" ", "");
    write("model.urdf", &free);
    let text = std::fs::read_to_string(&arm).unwrap();
    let without_limits = write("estimator.toml", &text);
    let start = text.find("[[force_torque]]").unwrap();
    let end = text.find("# Unknown external").unwrap();
    let text = text
        .replace(&text[start..end], "")
        .replace("trigger = \"l_arm_ft_sensor\"", "");
    let without_sensor = write("blind.toml", &text);
    let out = folder.path().join("motion.csv");
    let out = out.to_str().unwrap();
    let excite = |config: &'_ str, more: &[&str]| {
        let args = ["excite", "--config", config, "--out", out];
        let (is_good, _, error) = proprio(&[&args[..], more].concat());
        assert!(!is_good, "{more:?}");
        error
    };
    let identifiable = |args: &[&str]| {
        let (is_good, _, error) = proprio(&[&["identifiable"], args].concat());
        assert!(!is_good, "{args:?}");
        error
    };
    let foot = ["--absent", "foot"];
    for (error, parts) in [
        (
            excite(&leg, &[]),
            &["nothing can be identified", "--absent"][..],
        ),
        (excite(&leg, &["--absent", "feet"]), &["feet", "\"foot\""]),
        (
            excite(&leg, &["--joint", "knie"]),
            &["knie", "did you mean \"knee\""],
        ),
        (
            excite(&leg, &["--limit", "knie=0,1"]),
            &["knie", "did you mean \"knee\""],
        ),
        (
            excite(&leg, &["--limit", "knee=0,9"]),
            &["the URDF allows 0.4 to 2.2"],
        ),
        (
            excite(&leg, &["--limit", "knee=1,2,3"]),
            &["a velocity of 2.5 only"],
        ),
        (excite(&leg, &["--limit", "knee=1"]), &["LOWER,UPPER"]),
        (excite(&leg, &["--box", "shank=0,1"]), &["XMIN,XMAX"]),
        (
            excite(&leg, &["--box", "shnk=0,1,0,1,0,1"]),
            &["did you mean \"shank\""],
        ),
        (
            excite(&leg, &["--box", "shank=1,0,0,1,0,1"]),
            &["below the greatest"],
        ),
        (
            excite(
                &leg,
                &[&foot[..], &["--box", "shank=5,6,-1,1,-1,1"]].concat(),
            ),
            &["shank", "gets to x"],
        ),
        (
            excite(&leg, &["--seconds", "0"]),
            &["--seconds 0", "4 to 120"],
        ),
        (
            excite(&leg, &["--seconds", "nan"]),
            &["--seconds NaN", "4 to 120"],
        ),
        (
            excite(
                &leg,
                &[
                    &foot[..],
                    &[
                        "--limit",
                        "knee=1,1",
                        "--limit",
                        "hip_roll=0,0",
                        "--limit",
                        "hip_pitch=0,0",
                    ],
                ]
                .concat(),
            ),
            &["no joint moves"],
        ),
        (
            excite(&without_limits, &[]),
            &["no limits", "l_shoulder_pitch", "--limit"],
        ),
        (
            excite(&without_sensor, &[]),
            &["[[force_torque]]", "proprio identifiable"],
        ),
        (excite(&leg, &["--parameters", &leg]), &["parameters.toml"]),
        (
            identifiable(&[&urdf, "--sensors", "l_elbw"]),
            &["did you mean \"l_elbow\""],
        ),
        (
            identifiable(&[&urdf, "--joint", "l_elbw"]),
            &["did you mean \"l_elbow\""],
        ),
        (
            identifiable(&[&urdf, "--sensors", "l_elbow,l_elbow"]),
            &["named twice"],
        ),
        (identifiable(&["none.urdf"]), &["none.urdf"]),
        (identifiable(&[]), &["ROBOT.urdf"]),
        (
            identifiable(&["--config", &arm, "--absent", "hnd"]),
            &["\"hand\""],
        ),
    ] {
        for part in parts {
            assert!(error.contains(part), "{part:?} is not in {error}");
        }
    }
    assert!(
        !std::path::Path::new(out).exists(),
        "no table of a motion that there is not"
    );
    let (is_good, told, _) = proprio(&["identifiable", "--config", &without_sensor]);
    assert!(
        is_good && told.contains("no F/T sensor") && told.contains("would determine"),
        "{told}"
    );
}
