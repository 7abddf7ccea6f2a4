//! Decoding is the inverse of encoding, to half a step of the frames' resolution.

use crate::rig::{board, decode, encode, listener};
use proprio_drivers::Frame;
use proprio_topics::{
    Actuator, Gauges, Imu, JointState, Nanos, Quality, Reading, Saturation, StampKind, Temperature,
    Wrench,
};
use proptest::array::{uniform3, uniform6};
use proptest::prelude::*;
use std::f64::consts::{PI, TAU};

/// Half a step plus floating-point rounding.
fn near(a: f64, b: f64, step: f64) -> bool {
    (a - b).abs() <= step * 0.5 + 1e-12 * (a.abs() + b.abs())
}

fn stamped(frames: Vec<Frame>) -> Vec<Frame> {
    frames
        .into_iter()
        .map(|frame| frame.at(Nanos::from_millis(7), StampKind::Software))
        .collect()
}

/// The reading that `reading` is decoded to after encoding.
fn through(
    driver: &str,
    keys: &str,
    outputs: &[u8],
    output: u8,
    reading: Reading,
    quality: Quality,
) -> (Reading, Quality) {
    let frames = stamped(encode(
        &mut *board(driver, keys, outputs),
        output,
        &reading,
        quality,
    ));
    let (readings, _) = decode(&mut *listener(driver, keys, outputs), &frames);
    let last = readings.last().expect("a reading comes back");
    assert_eq!(last.output, output);
    (last.reading, last.quality)
}

proptest! {
    #[test]
    fn wrenches(scales in uniform6(1.0_f64..60000.0), parts in uniform6(-1.0_f64..0.9999)) {
        let [a, b, c, d, e, f] = scales;
        let keys = format!(
            "full_scale_n = [{a:?}, {b:?}, {c:?}]\nfull_scale_nm = [{d:?}, {e:?}, {f:?}]"
        );
        let [u, v, w, x, y, z] = parts;
        let wrench = Wrench { force: [u * a, v * b, w * c], torque: [x * d, y * e, z * f] };
        let reading = Reading::Wrench(wrench);
        let (back, quality) = through("icub_strain", &keys, &[], 0, reading, Quality::GOOD);
        let Reading::Wrench(back) = back else { panic!("{back:?}") };
        prop_assert_eq!(quality, Quality::GOOD);
        for axis in 0..3 {
            prop_assert!(near(back.force[axis], wrench.force[axis], scales[axis] / 32768.0));
            prop_assert!(near(back.torque[axis], wrench.torque[axis], scales[axis + 3] / 32768.0));
        }
    }

    #[test]
    fn saturation(marks in uniform6(0_u8..3)) {
        let keys = "full_scale_n = [100, 100, 100]\nfull_scale_nm = [10, 10, 10]";
        let kinds = [Saturation::None, Saturation::Low, Saturation::High];
        let quality = (0..).zip(marks).fold(Quality::GOOD, |quality, (axis, mark)| {
            quality.with_saturation(axis, kinds[usize::from(mark)])
        });
        let wrench = Reading::Wrench(Wrench { force: [1.0; 3], torque: [1.0; 3] });
        let (_, back) = through("icub_strain", keys, &[], 0, wrench, quality);
        let saturated = quality.contains(Quality::SATURATED);
        let frozen = if saturated { Quality::FROZEN } else { Quality::GOOD };
        prop_assert_eq!(back, quality | frozen);
        let gauges = Reading::Gauges(Gauges { counts: [40000; 6] });
        let (_, back) = through("icub_strain", keys, &[], 0, gauges, quality);
        prop_assert_eq!(back, quality);
    }

    #[test]
    fn gauges_and_temperature(counts in uniform6(0_i32..=65535), celsius in -3276.0_f64..3276.0) {
        let gauges = Reading::Gauges(Gauges { counts });
        let keys = r#"stream = "uncalibrated""#;
        let (back, _) = through("icub_strain", keys, &[], 0, gauges, Quality::GOOD);
        prop_assert_eq!(back, gauges);
        let temperature = Reading::Temperature(Temperature { celsius });
        let (back, _) = through("icub_strain", "", &[], 0, temperature, Quality::GOOD);
        prop_assert!(
            matches!(back, Reading::Temperature(back) if near(back.celsius, celsius, 0.1))
        );
    }

    #[test]
    fn imus(
        acceleration in uniform3(-327.0_f64..327.0), rate in uniform3(-35.7_f64..35.7),
        field in uniform3(-2e-3_f64..2e-3),
        orientation in proptest::array::uniform4(-1.0_f64..1.0), not_calibrated: bool
    ) {
        let keys = "quantities = [\"acceleration\", \"magnetic_field\", \"angular_velocity\", \
                    \"orientation\", \"status\"]";
        let imu = Imu {
            proper_acceleration: acceleration, angular_velocity: rate, magnetic_field: field,
            orientation, ..Imu::ABSENT
        };
        let quality = if not_calibrated { Quality::NOT_CALIBRATED } else { Quality::GOOD };
        let (back, back_quality) = through("icub_imu", keys, &[], 0, Reading::Imu(imu), quality);
        let Reading::Imu(back) = back else { panic!("{back:?}") };
        prop_assert_eq!(back_quality, quality | Quality::DEVICE_COUNTER);
        for axis in 0..3 {
            prop_assert!(near(back.proper_acceleration[axis], acceleration[axis], 0.01));
            prop_assert!(near(back.angular_velocity[axis], rate[axis], PI / 180.0 / 16.0));
            prop_assert!(near(back.magnetic_field[axis], field[axis], 1e-6 / 16.0));
        }
        for (back, value) in back.orientation.into_iter().zip(orientation) {
            prop_assert!(near(back, value, 1.0 / 16384.0));
        }
    }

    #[test]
    fn legacy_imus(acceleration in uniform3(-19.6_f64..19.6), rate in uniform3(-4.36_f64..4.36)) {
        let imu = Imu { proper_acceleration: acceleration, angular_velocity: rate, ..Imu::ABSENT };
        for (keys, step, rate_step) in [
            (r#"legacy = "mtb""#, 2.0 * 9.80665 / 32768.0, 250.0 / 32768.0 * PI / 180.0),
            (r#"legacy = "bno055""#, 0.01, PI / 180.0 / 16.0),
        ] {
            let (back, _) = through("icub_imu", keys, &[], 0, Reading::Imu(imu), Quality::GOOD);
            let Reading::Imu(back) = back else { panic!("{back:?}") };
            for axis in 0..3 {
                prop_assert!(near(back.proper_acceleration[axis], acceleration[axis], step));
                prop_assert!(near(back.angular_velocity[axis], rate[axis], rate_step));
            }
        }
    }

    #[test]
    fn motors(
        position in -2e5_f64..2e5, velocity in -3000.0_f64..3000.0,
        current in -32.7_f64..32.7, bits in 0_u8..8,
    ) {
        let joint = JointState { position, velocity, current, ..JointState::ABSENT };
        let mut quality = Quality::GOOD;
        if bits & 1 != 0 { quality |= Quality::DEVICE_FAULT; }
        if bits & 2 != 0 { quality |= Quality::NOT_CALIBRATED; }
        if bits & 4 != 0 { quality |= Quality::DRIVE_FAULT; }
        let reading = Reading::Joint(joint);
        let (back, back_quality) = through("icub_motor", "", &[0], 0, reading, quality);
        let Reading::Joint(back) = back else { panic!("{back:?}") };
        prop_assert_eq!(back_quality, quality);
        prop_assert!(near(back.position, position, TAU / 65536.0));
        prop_assert!(near(back.velocity, velocity, TAU / 65.536));
        prop_assert!(near(back.current, current, 1e-3));
        // A recording without velocity stays without velocity.
        let reading = Reading::Joint(JointState { position, ..JointState::ABSENT });
        let (back, _) = through("icub_motor", "velocity = false", &[0], 0, reading, quality);
        prop_assert!(matches!(back, Reading::Joint(back) if back.velocity.is_nan()));
    }

    #[test]
    fn actuators(duty in -1.0_f64..=1.0, mode in 0_u32..256, encoder in 0_u32..256, faults: u32) {
        let actuator = Actuator { duty, mode, encoder, faults };
        let reading = Reading::Actuator(actuator);
        let (back, _) = through("icub_motor", "", &[0], 0, reading, Quality::GOOD);
        let Reading::Actuator(back) = back else { panic!("{back:?}") };
        prop_assert!(near(back.duty, duty, 1.0 / 32000.0));
        prop_assert_eq!((back.mode, back.encoder, back.faults), (mode, encoder, faults));
    }

    #[test]
    fn encoders(position in -57.0_f64..57.0, length in -3.27_f64..3.27, label in 0_u8..16) {
        let joint = |position| Reading::Joint(JointState { position, ..JointState::ABSENT });
        let (back, _) = through("icub_pos", "", &[label], label, joint(position), Quality::GOOD);
        prop_assert!(
            matches!(back, Reading::Joint(back) if near(back.position, position, TAU / 3600.0))
        );
        let keys = r#"quantity = "length""#;
        let (back, _) = through("icub_pos", keys, &[label], label, joint(length), Quality::GOOD);
        prop_assert!(matches!(back, Reading::Joint(back) if near(back.position, length, 1e-4)));
    }
}

/// Every family refuses NaN if the frame cannot mark a value as absent.
#[test]
fn what_is_not_a_number_is_not_encoded() {
    let scales = "full_scale_n = [100, 100, 100]\nfull_scale_nm = [10, 10, 10]";
    let cases: [(&str, &str, &[u8], Reading); 4] = [
        (
            "icub_strain",
            scales,
            &[],
            Reading::Wrench(Wrench {
                force: [f64::NAN; 3],
                torque: [0.0; 3],
            }),
        ),
        ("icub_imu", "", &[], Reading::Imu(Imu::ABSENT)),
        (
            "icub_motor",
            "",
            &[0],
            Reading::Joint(JointState {
                position: 1.0,
                ..JointState::ABSENT
            }),
        ),
        (
            "icub_pos",
            "",
            &[0],
            Reading::Joint(JointState {
                position: f64::INFINITY,
                ..JointState::ABSENT
            }),
        ),
    ];
    for (driver, keys, outputs, reading) in cases {
        let mut out = proprio_drivers::Frames::new();
        let result = board(driver, keys, outputs).encode(0, &reading, Quality::GOOD, &mut out);
        assert_eq!(
            result,
            Err(proprio_drivers::EncodeError::NotFinite),
            "{driver}"
        );
        assert!(out.is_empty());
    }
}

/// A recording cannot be encoded for a reader that does not know the scale.
#[test]
fn a_wrench_without_a_scale_is_not_encoded() {
    let wrench = Reading::Wrench(Wrench {
        force: [0.0; 3],
        torque: [0.0; 3],
    });
    let mut out = proprio_drivers::Frames::new();
    let result = board("icub_strain", "", &[]).encode(0, &wrench, Quality::GOOD, &mut out);
    assert_eq!(result, Err(proprio_drivers::EncodeError::NoFullScale));
}
