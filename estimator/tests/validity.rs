//! What makes an estimate valid, and what its standard deviation is worth: on an arm that stands
//! still on an IMU, every channel sampled at the same instants, so that the reason of each number
//! is plain.

use proprio_estimator::config::{Config, Occurrence};
use proprio_estimator::pipeline::{Estimate, Pipeline};
use proprio_estimator::setup::Setup;
use proprio_identification::robot::Channel;
use proprio_topics::{
    Code, ContactState, Imu, JointState, Kind, Nanos, Quality, Reading, Reason, Wrench,
};
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
    config.output.max_wait_ms = Some(1.0);
    change(&mut config);
    Setup::new(&config).unwrap()
}

/// What channel `number` reads while nothing moves.
fn reading(setup: &Setup, number: usize) -> Reading {
    match setup.robot.channels[number].kind {
        Kind::Joint => Reading::Joint(JointState {
            position: 0.3,
            velocity: 0.0,
            acceleration: 0.0,
            ..JointState::ABSENT
        }),
        Kind::Wrench => Reading::Wrench(Wrench {
            force: [5.0, -4.0, 12.0],
            torque: [0.2, -0.3, 0.1],
        }),
        Kind::Imu => Reading::Imu(Imu {
            proper_acceleration: [0.0, 0.0, 9.80665],
            angular_velocity: [0.0; 3],
            angular_acceleration: [0.0; 3],
            ..Imu::ABSENT
        }),
        other => panic!("{other}"),
    }
}

/// The estimates of so many instants; `change` has the instant, the channel and what the channel
/// reads, and returns the quality.
fn estimates(
    setup: &Setup,
    count: usize,
    change: impl Fn(usize, usize, &mut Reading) -> Quality,
) -> Vec<Estimate> {
    let mut pipeline = Pipeline::new(setup.clone());
    let mut estimates = Vec::new();
    for instant in 0..count {
        let t = Nanos(PERIOD * i64::try_from(instant).unwrap());
        for channel in 0..setup.robot.channels.len() {
            let mut reading = reading(setup, channel);
            let quality = change(instant, channel, &mut reading);
            pipeline.push(channel, t, &reading, quality);
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

/// Values and standard deviations of all torques, and of the valid wrench at the hand.
fn stated(setup: &Setup, estimate: &Estimate) -> (Vec<f64>, Vec<f64>) {
    let joints = estimate.torques.joints().iter();
    let hand = &estimate.contacts.contacts()[setup.robot.contact("hand").unwrap()];
    assert_eq!(hand.valid, 1, "{:?}", hand.reason);
    let (mut values, mut deviations): (Vec<f64>, Vec<f64>) = joints
        .map(|joint| (joint.torque, joint.standard_deviation))
        .unzip();
    values.extend(hand.force.iter().chain(&hand.torque));
    deviations.extend(hand.standard_deviation);
    (values, deviations)
}

/// What is stated of the last of so many estimates, the readings of each channel changed.
fn stated_last(
    setup: &Setup,
    count: usize,
    change: impl Fn(usize, &mut Reading),
) -> (Vec<f64>, Vec<f64>) {
    let found = estimates(setup, count, |_, channel, reading| {
        change(channel, reading);
        Quality::GOOD
    });
    stated(setup, found.last().unwrap())
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
    let nominal = setup(|_| {});
    let doubled = setup(|config| {
        for ft in &mut config.force_torque {
            (ft.noise_n, ft.noise_nm) = (force.map(|x| 2.0 * x), torque.map(|x| 2.0 * x));
        }
    });
    let noise = |instant: usize, _: usize, reading: &mut Reading| {
        if let Reading::Wrench(wrench) = reading {
            let values = wrench.force.iter_mut().chain(&mut wrench.torque);
            for ((value, sigma), deviate) in values.zip(&sigma).zip(&deviates[instant]) {
                *value += sigma * deviate;
            }
        }
        Quality::GOOD
    };
    let found = estimates(&nominal, count, noise);
    let more = estimates(&doubled, 50, noise);
    assert_eq!(found.len(), count);
    let all: Vec<_> = found
        .iter()
        .skip(20)
        .map(|e| stated(&nominal, e).0)
        .collect();
    let (_, once) = stated(&nominal, &found[40]);
    let (_, twice) = stated(&doubled, &more[40]);
    let mut compared = 0;
    for k in 0..once.len() {
        let mean = all.iter().map(|values| values[k]).sum::<f64>() / all.len() as f64;
        let square = all
            .iter()
            .map(|values| (values[k] - mean).powi(2))
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
    assert_eq!(compared, once.len());
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
    let frozen = |instant: usize, channel: usize, _: &mut Reading| {
        if channel == sensor && instant >= 30 {
            Quality::FROZEN
        } else {
            Quality::GOOD
        }
    };
    let found = estimates(&setup, 60, frozen);
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
    for joint in found[40].torques.joints() {
        assert_eq!(joint.reason, Reason::Frozen);
        assert_eq!(joint.cause as usize, sensor);
    }
}

/// A contact that is possible is absent because the F/T sensor would show it. While that can not
/// see, the torques that rest on its absence are withheld, unless a program declares it.
#[test]
fn a_contact_that_nothing_would_show_is_not_assumed_absent() {
    let setup = setup(|config| {
        let hand = config.contact.last_mut().unwrap();
        hand.presence = Occurrence::Possible;
    });
    let channel = |kind| setup.robot.channels.iter().position(|c| c.kind == kind);
    let (ft, hand) = (channel(Kind::Wrench).unwrap(), setup.robot.contact("hand"));
    for declared in [false, true] {
        let mut pipeline = Pipeline::new(setup.clone());
        if declared {
            let absent = ContactState::configured(false);
            pipeline.declare(hand.unwrap(), Nanos::ZERO, &absent);
        }
        let mut last = None;
        for instant in 0..60 {
            for number in 0..setup.robot.channels.len() {
                let quality = match number == ft {
                    true => Quality::DEVICE_FAULT,
                    false => Quality::GOOD,
                };
                let t = Nanos(PERIOD * instant);
                pipeline.push(number, t, &reading(&setup, number), quality);
            }
            while let Some(estimate) = pipeline.poll() {
                last = Some(estimate.clone());
            }
        }
        // The wrist is behind the sensor: its torque follows from the hand's links alone.
        let last = last.unwrap();
        let wrist = last.torques.joints().last().unwrap();
        let cause = u32::try_from(ft).unwrap();
        match declared {
            true => assert_eq!(wrist.valid, 1, "{wrist:?}"),
            false => assert_eq!(
                (wrist.reason.get(), wrist.cause),
                (Some(Reason::DeviceFault), cause)
            ),
        }
    }
}

/// The offset in use is that of the zero before: until another one is given, nothing that depends
/// on the sensor is valid, also if the reading that tells of it is not a number. The first reading
/// of all is of the zero that the configuration is of.
#[test]
fn a_new_zero_makes_the_offset_unknown() {
    let setup = setup(|_| {});
    let wrench = |c: &Channel| c.kind == Kind::Wrench;
    let ft = setup.robot.channels.iter().position(wrench).unwrap();
    let shoulder = |estimate: &Estimate| estimate.torques.joints()[0];
    for (zero_at, is_lost) in [(0, false), (60, false), (60, true)] {
        let found = estimates(&setup, 120, |instant, channel, reading| {
            if (instant, channel) != (zero_at, ft) {
                return Quality::GOOD;
            }
            if let Reading::Wrench(wrench) = reading
                && is_lost
            {
                wrench.force[0] = f64::NAN;
            }
            Quality::ZERO_CHANGED
        });
        let (before, after) = (shoulder(&found[50]), shoulder(found.last().unwrap()));
        assert_eq!(before.valid, 1, "{before:?}");
        match zero_at {
            0 => assert_eq!(after.valid, 1, "{after:?}"),
            _ => assert_eq!(
                (after.reason.get(), after.cause),
                (Some(Reason::Uncertain), u32::try_from(ft).unwrap())
            ),
        }
    }
}

/// A joint moves with jitter, stops, and stays at one count: it is not frozen. An F/T sensor whose
/// noise ends like that is.
#[test]
fn a_joint_that_stands_is_not_frozen() {
    let setup = setup(|_| {});
    let joint = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let sensor = setup.robot.channel(Kind::Wrench, "l_arm_ft_sensor");
    let deviates = normals(300);
    let count = std::f64::consts::TAU / 65536.0;
    let reasons = |noisy: usize| {
        let found = estimates(&setup, 400, |instant, channel, reading| {
            let jitter = deviates
                .get(instant)
                .map_or([0.0; 6], |d| d.map(|d| 10.0 * d));
            match reading {
                Reading::Joint(state) if channel == noisy => {
                    // It slows down, and stops.
                    let left = (1.0 - instant as f64 / 300.0).max(0.0);
                    let moved = (0.2 * (1.0 - left * left) / count + jitter[0]).round();
                    *state = JointState {
                        position: 0.3 + count * moved,
                        ..JointState::ABSENT
                    };
                }
                Reading::Wrench(wrench) if channel == noisy => {
                    let values = wrench.force.iter_mut().chain(&mut wrench.torque);
                    for (value, jitter) in values.zip(jitter) {
                        *value += 1e-3 * jitter.round();
                    }
                }
                _ => {}
            }
            Quality::GOOD
        });
        let last = found.last().unwrap();
        let reasons = last.torques.joints().iter().map(|joint| joint.reason.get());
        reasons.collect::<Vec<_>>()
    };
    assert!(
        reasons(joint)
            .iter()
            .all(|reason| *reason == Some(Reason::None))
    );
    let frozen = reasons(sensor.unwrap());
    assert!(
        frozen.iter().all(|reason| *reason == Some(Reason::Frozen)),
        "{frozen:?}"
    );
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
        second.presence = Occurrence::Always;
        config.contact.push(second);
    });
    let last = |setup: &Setup| {
        let found = estimates(setup, 40, |_, _, _| Quality::GOOD);
        found.last().unwrap().clone()
    };
    let (one, two) = (last(&one), last(&two));
    assert!(one.torques.joints().iter().all(|joint| joint.valid == 1));
    let open = |reason: Code<Reason>, valid: u32| reason == Reason::Undetermined && valid == 0;
    let contacts = two.contacts.contacts().iter();
    assert_eq!(contacts.filter(|c| open(c.reason, c.valid)).count(), 2);
    let joints = setup(|_| {}).robot;
    let undetermined: Vec<&str> = (joints.joint_names().zip(two.torques.joints()))
        .filter(|(_, joint)| open(joint.reason, joint.valid))
        .map(|(name, _)| name)
        .collect();
    // Only these joints are between the two contacts.
    assert_eq!(undetermined, ["l_wrist_pitch", "l_wrist_yaw"]);
}

/// An instant waits for a silent channel as long as configured, and no longer.
#[test]
fn an_estimate_waits_as_long_as_configured() {
    let wait = 40_000_000;
    let setup = setup(|config| {
        config.output.max_wait_ms = Some(40.0);
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
            pipeline.push(channel, t, &reading(&setup, channel), Quality::GOOD);
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

/// With known bodies and a sensor without noise, what is uncertain is each encoder's offset (0.005
/// rad) and the base's proper acceleration (0.1 m/s^2 along each axis). So the variance is the sum
/// of the squares of what such errors change, one by one.
#[test]
fn errors_of_positions_and_of_gravity_are_propagated() {
    let setup = setup(|config| {
        for ft in &mut config.force_torque {
            (ft.noise_n, ft.noise_nm) = ([1e-6; 3], [1e-6; 3]);
        }
    });
    let (usual, deviations) = stated_last(&setup, 3, |_, _| ());
    let mut variances = vec![0.0; usual.len()];
    let mut add = |values: Vec<f64>, step: f64, sigma: f64| {
        for ((sum, value), usual) in variances.iter_mut().zip(values).zip(&usual) {
            *sum += ((value - usual) / step * sigma).powi(2);
        }
    };
    for number in 0..setup.robot.channels.len() {
        for axis in 0..3 {
            let step = 1e-4;
            let (values, _) = stated_last(&setup, 3, |channel, reading| match reading {
                Reading::Joint(joint) if channel == number && axis == 0 => joint.position += step,
                Reading::Imu(imu) if channel == number => imu.proper_acceleration[axis] += step,
                _ => {}
            });
            let sigma = match setup.robot.channels[number].kind {
                Kind::Joint => 0.005,
                Kind::Imu => 0.1,
                _ => continue,
            };
            add(values, step, sigma);
        }
    }
    for (number, (variance, stated)) in variances.iter().zip(&deviations).enumerate() {
        let expected = variance.sqrt();
        // The sensitivities are finite differences, too, and positions have a little noise.
        assert!(
            (stated - expected).abs() < 0.02 * expected + 1e-4,
            "{number}: {stated}, not {expected}"
        );
    }
    assert!(
        deviations.iter().all(|deviation| *deviation > 1e-4),
        "{deviations:?}"
    );
}

/// Twice the uncertainty of the URDF, four times its part of every variance.
#[test]
fn the_uncertainty_of_bodies_is_part_of_every_deviation() {
    let deviations = |relative: f64| {
        let setup = setup(|config| config.identification.urdf_relative_std = relative);
        stated_last(&setup, 3, |_, _| ()).1
    };
    let (none, once, twice) = (deviations(0.0), deviations(0.1), deviations(0.2));
    let mut compared = 0;
    for ((none, once), twice) in none.iter().zip(&once).zip(&twice) {
        let (once, twice) = (once * once - none * none, twice * twice - none * none);
        if once > 1e-9 {
            assert!((twice / once - 4.0).abs() < 0.02, "{once} {twice}");
            compared += 1;
        }
    }
    // All but the torques at and beyond the elbow's side of the sensor depend on bodies.
    assert!(compared >= 10, "{compared}");
}

/// An IMU without angular acceleration: it is differentiated, and its noise counts.
#[test]
fn a_differentiated_angular_acceleration_is_uncertain() {
    let setup = setup(|_| {});
    let [exact, noisy] = [false, true].map(|is_differentiated| {
        let found = estimates(&setup, 60, |_, _, reading| {
            if let Reading::Imu(imu) = reading
                && is_differentiated
            {
                imu.angular_acceleration = [f64::NAN; 3];
            }
            Quality::GOOD
        });
        let last = found.last().unwrap();
        assert!(last.torques.joints().iter().all(|joint| joint.valid == 1));
        stated(&setup, last).1
    });
    let larger = exact.iter().zip(&noisy).filter(|(a, b)| b > a).count();
    assert!(larger > exact.len() / 2, "{larger} of {}", exact.len());
}

/// What comes too late to be used everywhere is counted: a declaration for a released instant, and
/// a sample that would have changed one.
#[test]
fn what_comes_too_late_is_counted() {
    let wait = Nanos::from_millis(20);
    let setup = setup(|config| {
        config.output.max_wait_ms = Some(20.0);
        config.input.max_silence_ms = 1000.0;
    });
    let (hand, silent) = (
        setup.robot.contact("hand").unwrap(),
        setup.robot.channel(Kind::Joint, "l_elbow").unwrap(),
    );
    let mut pipeline = Pipeline::new(setup.clone());
    let mut released = Nanos::ZERO;
    for instant in 0..60 {
        let t = Nanos(PERIOD * instant);
        for channel in (0..setup.robot.channels.len()).filter(|c| *c != silent || instant < 20) {
            pipeline.push(channel, t, &reading(&setup, channel), Quality::GOOD);
        }
        while let Some(estimate) = pipeline.poll() {
            released = estimate.t;
        }
    }
    assert_eq!(pipeline.counts().late, 0);
    pipeline.declare(hand, released, &ContactState::configured(true));
    assert_eq!(pipeline.counts().late, 1);
    pipeline.declare(hand, released + Nanos(1), &ContactState::configured(false));
    assert_eq!(pipeline.counts().late, 1);
    // Taken, because it is later than the released instant, but that instant would have used it.
    let taken = pipeline.counts().taken;
    let soon = released + Nanos(wait.0 / 4);
    pipeline.push(silent, soon, &reading(&setup, silent), Quality::GOOD);
    let counts = pipeline.counts();
    assert_eq!((counts.taken - taken, counts.late), (1, 2));
}

/// A wait of 250 ms at 2 kHz: instants are released when 256 wait, not only when it ends.
#[test]
fn no_more_than_256_instants_wait() {
    let setup = setup(|config| {
        config.output.max_wait_ms = Some(250.0);
        config.input.max_silence_ms = 1000.0;
    });
    let silent = setup.robot.channel(Kind::Joint, "l_elbow").unwrap();
    let mut pipeline = Pipeline::new(setup.clone());
    let mut released = 0;
    for instant in 0..300 {
        let t = Nanos(500_000 * instant);
        for channel in (0..setup.robot.channels.len()).filter(|channel| *channel != silent) {
            pipeline.push(channel, t, &reading(&setup, channel), Quality::GOOD);
        }
        while pipeline.poll().is_some() {
            released += 1;
        }
    }
    assert_eq!(released, 300 - 255);
}

/// A torque may be as uncertain as a quarter of the drive's effort, if that is more than the
/// gravity load of the links, and if the URDF's limit is credible.
#[test]
fn the_default_bound_of_a_torque_is_a_quarter_of_its_effort() {
    let setup = setup(|config| config.output.max_torque_std_nm = None);
    let model = &setup.robot.model;
    let mut compared = 0;
    for (number, joint) in model.joints().iter().enumerate() {
        if let (Some(dof), Some(effort)) = (joint.dof, model.effort(number)) {
            let bound = setup.max_deviation[dof];
            // 9.80665 m/s^2 times the whole mass beyond at less than a metre.
            let load: f64 = 9.80665 * model.inertias().iter().map(|body| body.mass).sum::<f64>();
            assert!(
                bound <= load.max(effort / 4.0),
                "{bound} Nm, effort {effort} Nm"
            );
            compared += usize::from((bound - effort / 4.0).abs() < 1e-9);
        }
    }
    assert!(compared >= 3, "{compared} joints");
}
