//! What makes an estimate valid, and what its standard deviation is worth: on an arm that stands
//! still on an IMU, every channel sampled at the same instants, so that the reason of each number
//! is plain.

use proprio_estimator::config::{Config, Presence};
use proprio_estimator::pipeline::{Estimate, Pipeline};
use proprio_estimator::setup::Setup;
use proprio_topics::{Imu, JointState, Kind, Nanos, Quality, Reading, Reason, Wrench};
use std::path::{Path, PathBuf};

const PERIOD: i64 = 10_000_000;
const NOISE: ([f64; 3], [f64; 3]) = ([0.4, 0.5, 0.6], [0.02, 0.03, 0.01]);

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The arm of the example, its inertial parameters known exactly.
fn setup(change: impl FnOnce(&mut Config)) -> Setup {
    let mut config = Config::load(&root().join("config/icub_left_arm/estimator.toml")).unwrap();
    config.identification.urdf_relative_std = 0.0;
    config.output.max_torque_std_nm = Some(1000.0);
    for ft in &mut config.force_torque {
        (ft.noise_n, ft.noise_nm) = NOISE;
    }
    change(&mut config);
    Setup::new(&config).unwrap()
}

/// What channel `number` reads while nothing moves, with so much added to the F/T sensor.
fn reading(setup: &Setup, number: usize, noise: [f64; 6]) -> Reading {
    match setup.robot.channels[number].kind {
        Kind::Joint => Reading::Joint(JointState {
            position: 0.3,
            velocity: 0.0,
            acceleration: 0.0,
            ..JointState::ABSENT
        }),
        Kind::Wrench => Reading::Wrench(Wrench {
            force: [5.0 + noise[0], -4.0 + noise[1], 12.0 + noise[2]],
            torque: [0.2 + noise[3], -0.3 + noise[4], 0.1 + noise[5]],
        }),
        Kind::Imu => Reading::Imu(Imu {
            proper_acceleration: [0.0, 0.0, 9.80665],
            angular_velocity: [0.0; 3],
            angular_acceleration: [0.0; 3],
            ..Imu::ABSENT
        }),
    }
}

/// The estimates of so many instants; `quality` of each channel at each instant.
fn estimates(
    setup: &Setup,
    count: usize,
    noise: impl Fn(usize) -> [f64; 6],
    quality: impl Fn(usize, usize) -> Quality,
) -> Vec<Estimate> {
    let mut pipeline = Pipeline::new(setup.clone());
    let mut estimates = Vec::new();
    for instant in 0..count {
        let t = Nanos(PERIOD * i64::try_from(instant).unwrap());
        for channel in 0..setup.robot.channels.len() {
            let reading = reading(setup, channel, noise(instant));
            pipeline.push(channel, t, &reading, quality(channel, instant));
            while let Some(estimate) = pipeline.poll() {
                estimates.push(estimate.clone());
            }
        }
    }
    pipeline.finish();
    while let Some(estimate) = pipeline.poll() {
        estimates.push(estimate.clone());
    }
    estimates
}

/// Normal deviates: sums of twelve uniform numbers of a linear congruence.
fn normals(count: usize) -> Vec<[f64; 6]> {
    let mut state = 9_u64;
    let mut uniform = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (state >> 11) as f64 / (1_u64 << 53) as f64
    };
    let mut normal = || (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
    (0..count)
        .map(|_| std::array::from_fn(|_| normal()))
        .collect()
}

/// Everything uncertain but the readings is the same at all instants, so the scatter of an estimate
/// is what its variance owes to the noise: a third of what the variance grows by when the stated
/// noise is doubled.
#[test]
fn torques_and_contact_wrenches_scatter_as_stated() {
    let count = 4000;
    let (force, torque) = NOISE;
    let sigma = [force, torque].concat();
    let deviates = normals(count);
    let stated = setup(|_| {});
    let doubled = setup(|config| {
        for ft in &mut config.force_torque {
            (ft.noise_n, ft.noise_nm) = (force.map(|x| 2.0 * x), torque.map(|x| 2.0 * x));
        }
    });
    let noise = |i: usize| std::array::from_fn(|k| sigma[k] * deviates[i][k]);
    let good = |_: usize, _: usize| Quality::GOOD;
    let found = estimates(&stated, count, noise, good);
    let more = estimates(&doubled, 50, noise, good);
    assert_eq!(found.len(), count);
    let hand = stated.robot.contact("hand").unwrap();
    let numbers = |estimate: &Estimate| -> (Vec<f64>, Vec<f64>) {
        let contact = &estimate.contacts.contacts()[hand];
        assert_eq!(contact.valid, 1, "{:?}", contact.reason);
        let joints = estimate.torques.joints().iter();
        let (mut values, mut deviations): (Vec<f64>, Vec<f64>) = joints
            .map(|joint| (joint.torque, joint.standard_deviation))
            .unzip();
        values.extend(contact.force.iter().chain(&contact.torque));
        deviations.extend(contact.standard_deviation);
        (values, deviations)
    };
    let all: Vec<(Vec<f64>, Vec<f64>)> = found.iter().skip(20).map(numbers).collect();
    let (_, once) = numbers(&found[40]);
    let (_, twice) = numbers(&more[40]);
    let mut compared = 0;
    for k in 0..once.len() {
        let mean = all.iter().map(|(values, _)| values[k]).sum::<f64>() / all.len() as f64;
        let square = all
            .iter()
            .map(|(values, _)| (values[k] - mean).powi(2))
            .sum::<f64>();
        let scatter = (square / all.len() as f64).sqrt();
        let expected = ((twice[k].powi(2) - once[k].powi(2)) / 3.0).sqrt();
        if expected < 1e-6 {
            continue;
        }
        // Four standard errors of a deviation from 4000 numbers, and of single precision.
        assert!(
            (scatter / expected - 1.0).abs() < 0.06,
            "{k}: {scatter} of {expected}"
        );
        compared += 1;
    }
    assert!(compared >= 9, "{compared}");
}

/// A board that repeats its last reading does not measure, whether or not it says that it is
/// saturated.
#[test]
fn a_frozen_sensor_gives_no_valid_torque() {
    let setup = setup(|_| {});
    let sensor = setup
        .robot
        .channel(Kind::Wrench, "l_arm_ft_sensor")
        .unwrap();
    let frozen = |channel: usize, instant: usize| {
        if channel == sensor && instant >= 30 {
            Quality::FROZEN
        } else {
            Quality::GOOD
        }
    };
    let found = estimates(&setup, 60, |_| [0.0; 6], frozen);
    let valid = |i: usize| {
        found[i]
            .torques
            .joints()
            .iter()
            .filter(|j| j.valid == 1)
            .count()
    };
    assert_eq!(
        (valid(25), valid(40)),
        (setup.robot.joint_names().count(), 0)
    );
    let mut reasons = found[40].torques.joints().iter().map(|joint| joint.reason);
    assert!(reasons.all(|reason| reason == Reason::Saturated));
}

/// Two unknown wrenches in one sub-tree are twelve unknowns in six equations: each may be anything,
/// and so may torques between them.
#[test]
fn what_two_unknown_contacts_leave_open_is_undetermined() {
    let one = setup(|_| {});
    let two = setup(|config| {
        let mut second = config.contact.last().unwrap().clone();
        second.name = Some("forearm".into());
        second.link = "l_forearm".into();
        second.presence = Presence::Always;
        config.contact.push(second);
    });
    let good = |_: usize, _: usize| Quality::GOOD;
    let of = |setup: &Setup| estimates(setup, 40, |_| [0.0; 6], good).pop().unwrap();
    let (one, two) = (of(&one), of(&two));
    assert!(one.torques.joints().iter().all(|joint| joint.valid == 1));
    let undetermined = |estimate: &Estimate| {
        let open = |reason: Reason, valid: u32| reason == Reason::Undetermined && valid == 0;
        let joints = estimate.torques.joints().iter();
        let contacts = estimate.contacts.contacts().iter();
        (
            joints
                .filter(|joint| open(joint.reason, joint.valid))
                .count(),
            contacts
                .filter(|contact| open(contact.reason, contact.valid))
                .count(),
        )
    };
    assert_eq!(undetermined(&one), (0, 0));
    let (joints, contacts) = undetermined(&two);
    assert!(
        joints > 0 && contacts == 2,
        "{joints} torques, {contacts} contacts"
    );
}

/// An instant waits for a silent channel as long as configured, and no longer.
#[test]
fn an_estimate_waits_as_long_as_configured() {
    let wait = 40_000_000;
    let setup = setup(|config| {
        config.output.max_wait_ms = 40.0;
        config.input.max_silence_ms = 1000.0;
    });
    let silent = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let mut pipeline = Pipeline::new(setup.clone());
    let (mut delays, step) = (Vec::new(), 1_000_000);
    for k in 0..300_i64 {
        let t = Nanos(step * k);
        for channel in 0..setup.robot.channels.len() {
            if channel == silent && k >= 100 {
                continue;
            }
            pipeline.push(
                channel,
                t,
                &reading(&setup, channel, [0.0; 6]),
                Quality::GOOD,
            );
            while let Some(estimate) = pipeline.poll() {
                if estimate.t > Nanos(100 * step) {
                    delays.push((t - estimate.t).0);
                }
            }
        }
    }
    assert!(delays.len() > 100);
    let right = |delay: &i64| (wait..=wait + step).contains(delay);
    assert!(
        delays.iter().all(right),
        "{:?}",
        delays.iter().find(|delay| !right(delay))
    );
}
