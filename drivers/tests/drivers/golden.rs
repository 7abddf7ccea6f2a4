//! Golden bytes: the worked examples of the protocol's documents, and frames computed by hand from
//! their tables.

use crate::rig::{board, count, decode, encode, frame, listener};
use proprio_drivers::icub_motor::{encoder, fault};
use proprio_drivers::{Board, Frame, Frames};
use proprio_topics::{
    Actuator, Counter, Imu, JointState, Quality, Reading, Saturation, Temperature, Wrench,
};

const SCALES: &str = "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]";

fn texts(frames: &[Frame]) -> Vec<String> {
    frames.iter().map(ToString::to_string).collect()
}

fn answers(board: &mut dyn Board, text: &str) -> Vec<String> {
    let mut out = Frames::new();
    board.on_frame(&frame(text, 0.0), &mut out);
    texts(&out)
}

fn assert_near(values: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(values.len(), expected.len());
    for (value, expected) in values.iter().zip(expected) {
        assert!(
            (value - expected).abs() <= tolerance,
            "{values:?} is not {expected}"
        );
    }
}

#[test]
fn the_worked_example_of_the_strain_board() {
    let wrench = Wrench {
        force: [12.5, -300.0, 100.0],
        torque: [1.0, -2.0, 0.25],
    };
    let mut board = board("icub_strain", SCALES, &[]);
    let frames = encode(&mut *board, 0, &Reading::Wrench(wrench), Quality::GOOD);
    assert_eq!(texts(&frames), ["31A#E380B76A1887", "31B#2184BE770881"]);

    let mut device = listener("icub_strain", SCALES, &[]);
    let (readings, faults) = decode(
        &mut *device,
        &[
            frame("31A#E380B76A1887", 3.0),
            frame("31B#2184BE770881", 3.2),
        ],
    );
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!(readings.len(), 1);
    let Reading::Wrench(decoded) = readings[0].reading else {
        panic!("{readings:?}")
    };
    // The example's counts by the document's formula, and the encoded values to half a step.
    assert_near(
        &decoded.force,
        &[227.0, -5449.0, 1816.0].map(|count| count / 32768.0 * 1804.0),
        1e-12,
    );
    assert_near(
        &decoded.force,
        &[12.5, -300.0, 100.0],
        1804.0 / 32768.0 / 2.0,
    );
    assert_near(&decoded.torque, &[1.0, -2.0, 0.25], 31.0 / 32768.0 / 2.0);
    assert_eq!(readings[0].acquired, frame("0#", 3.0).t);
    assert_eq!(readings[0].quality, Quality::GOOD);
}

#[test]
fn a_saturated_strain_board_names_its_gauges_and_is_frozen() {
    let mut device = listener("icub_strain", SCALES, &[]);
    // 05: flag, gauge 0 low. 81: flag, gauge 5 high.
    let frames = [
        frame("31A#E380B76A188705", 0.0),
        frame("31B#2184BE77088181", 0.2),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    let quality = readings[0].quality;
    assert!(quality.contains(Quality::SATURATED) && quality.contains(Quality::FROZEN));
    let gauges = [0, 1, 2, 3, 4, 5].map(|axis| quality.saturation(axis));
    use Saturation::{High, Low, None};
    assert_eq!(gauges, [Low, None, None, None, None, High]);
    assert_eq!(count(&faults, Counter::Saturated), 1);
    // Saturation in only one of the frames counts as well.
    let frames = [
        frame("31A#E380B76A1887", 10.0),
        frame("31B#2184BE77088101", 10.2),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    assert_eq!(readings[0].quality, Quality::SATURATED | Quality::FROZEN);
    // Raw gauges are marked as saturated but are not frozen.
    let frames = [
        frame("318#E380B76A188705", 20.0),
        frame("319#2184BE77088181", 20.2),
    ];
    let (readings, _) = decode(&mut *device, &frames);
    assert!(
        readings[0].quality.contains(Quality::SATURATED)
            && !readings[0].quality.contains(Quality::FROZEN)
    );
    let Reading::Gauges(gauges) = readings[0].reading else {
        panic!("{readings:?}")
    };
    assert_eq!(
        gauges.counts,
        [0x80E3, 0x6AB7, 0x8718, 0x8421, 0x77BE, 0x8108]
    );
}

#[test]
fn a_saturated_board_repeats_its_last_good_vector() {
    let mut board = board("icub_strain", SCALES, &[]);
    let good = Wrench {
        force: [12.5, -300.0, 100.0],
        torque: [1.0, -2.0, 0.25],
    };
    let beyond = Wrench {
        force: [1900.0, 0.0, 0.0],
        torque: [0.0, -32.0, 0.0],
    };
    encode(&mut *board, 0, &Reading::Wrench(good), Quality::GOOD);
    let frames = encode(&mut *board, 0, &Reading::Wrench(beyond), Quality::GOOD);
    // 09: flag, gauge 0 high. 11: flag, gauge 4 low.
    assert_eq!(texts(&frames), ["31A#E380B76A188709", "31B#2184BE77088111"]);
    let frames = encode(&mut *board, 0, &Reading::Wrench(good), Quality::GOOD);
    assert_eq!(texts(&frames), ["31A#E380B76A1887", "31B#2184BE770881"]);
    // A recorded reading that is already frozen is encoded unchanged.
    let frozen = Reading::Wrench(Wrench {
        force: [0.0; 3],
        torque: [0.0; 3],
    });
    let quality = Quality::FROZEN.with_saturation(5, Saturation::High);
    let frames = encode(&mut *board, 0, &frozen, quality);
    assert_eq!(texts(&frames), ["31A#00800080008001", "31B#00800080008081"]);
}

#[test]
fn a_saturation_byte_that_contradicts_itself_is_counted() {
    let mut device = listener("icub_strain", SCALES, &[]);
    // No flag; a flag of 2; a gauge both low and high.
    for byte in ["00", "04", "02", "0D", "C1"] {
        let (readings, faults) = decode(
            &mut *device,
            &[frame(&format!("31A#E380B76A1887{byte}"), 0.0)],
        );
        assert!(readings.is_empty());
        assert_eq!(count(&faults, Counter::Value), 1, "{byte}");
    }
    for text in ["31A#", "31A#E380B76A18", "31A#E380B76A18870500"] {
        let (_, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        assert_eq!(count(&faults, Counter::Length), 1, "{text}");
    }
}

#[test]
fn temperatures_come_with_both_type_codes() {
    let mut device = listener("icub_strain", SCALES, &[]);
    for (text, celsius) in [("31E#01FA000000", 25.0), ("31F#01CEFF0000", -5.0)] {
        let (readings, faults) = decode(&mut *device, &[frame(text, 1.0)]);
        assert!(faults.is_empty(), "{faults:?}");
        let Reading::Temperature(temperature) = readings[0].reading else {
            panic!("{readings:?}")
        };
        assert_near(&[temperature.celsius], &[celsius], 1e-9);
    }
    let mut board = board("icub_strain", SCALES, &[]);
    let reading = Reading::Temperature(Temperature { celsius: 25.0 });
    assert_eq!(
        texts(&encode(&mut *board, 0, &reading, Quality::GOOD)),
        ["31E#01FA000000"]
    );
}

#[test]
fn boards_say_who_they_are() {
    let mut strain = board("icub_strain", "", &[]);
    assert_eq!(answers(&mut *strain, "70F#FF"), ["710#FF0C020008"]);
    assert_eq!(
        answers(&mut *strain, "201#1C0200"),
        ["210#1C0C020008020001"]
    );
    assert_eq!(answers(&mut *strain, "201#1800"), ["210#1800070C"]);
    assert_eq!(answers(&mut *strain, "201#1805"), ["210#1805001F"]);
    assert!(
        answers(&mut *strain, "202#1805").is_empty(),
        "meant for another"
    );
    let mut motor = board("icub_motor", "", &[0]);
    let mut pos = board("icub_pos", "", &[2]);
    assert!(answers(&mut *pos, "201#5200F20001830000").is_empty());
    assert_eq!(answers(&mut *pos, "201#5100"), ["210#5100F20001830000"]);
    assert_eq!(answers(&mut *motor, "001#5B0100"), ["010#5B08020008020000"]);
}

const IMU: &str = "quantities = [\"acceleration\", \"magnetic_field\", \"angular_velocity\", \
                   \"orientation\", \"status\"]";

fn imu() -> Imu {
    Imu {
        proper_acceleration: [0.0, -1.0, 9.81],
        angular_velocity: [90_f64.to_radians(), 0.0, -0.5_f64.to_radians()],
        magnetic_field: [20e-6, 0.0, -45e-6],
        orientation: [1.0, 0.0, 0.0, 0.0],
        ..Imu::ABSENT
    }
}

#[test]
fn an_imu_acquisition() {
    let golden = [
        "513#010000009CFFD503",
        "513#01014001000030FD",
        "513#0102A0050000F8FF",
        "514#0040000000000000",
        "515#01030303A00F0000",
    ];
    let mut board = board("icub_imu", IMU, &[]);
    assert_eq!(
        texts(&encode(&mut *board, 0, &Reading::Imu(imu()), Quality::GOOD)),
        golden
    );

    let mut device = listener("icub_imu", IMU, &[]);
    let frames: Vec<Frame> = golden
        .iter()
        .zip(0_u8..)
        .map(|(text, k)| frame(text, f64::from(k) * 0.2))
        .collect();
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    assert_eq!((readings.len(), readings[0].device_counter), (1, 1));
    assert_eq!(readings[0].quality, Quality::DEVICE_COUNTER);
    let Reading::Imu(decoded) = readings[0].reading else {
        panic!("{readings:?}")
    };
    assert_near(
        &decoded.proper_acceleration,
        &imu().proper_acceleration,
        1e-9,
    );
    assert_near(&decoded.angular_velocity, &imu().angular_velocity, 1e-9);
    assert_near(&decoded.magnetic_field, &imu().magnetic_field, 1e-15);
    assert_near(&decoded.orientation, &imu().orientation, 1e-9);
    assert!(
        decoded
            .angular_acceleration
            .iter()
            .all(|value| value.is_nan()),
        "absent is not zero"
    );
}

/// The quaternion has no SEQ: if one is lost, that of the next acquisition must not take its place.
#[test]
fn a_quaternion_belongs_to_an_acquisition_for_half_a_period() {
    let keys = r#"quantities = ["acceleration", "orientation"]"#;
    // The period is 10 ms.
    for (ms, pairs) in [(0.2, true), (4.9, true), (5.1, false), (9.0, false)] {
        let mut device = listener("icub_imu", keys, &[]);
        let frames = [
            frame("513#070000009CFFD503", 0.0),
            frame("514#0040000000000000", ms),
        ];
        let (readings, faults) = decode(&mut *device, &frames);
        assert_eq!(readings.len(), usize::from(pairs), "{ms} ms");
        assert_eq!(
            count(&faults, Counter::Unpaired),
            u32::from(!pairs),
            "{ms} ms"
        );
    }
}

#[test]
fn an_uncalibrated_sensor_in_use_is_told() {
    let keys = r#"quantities = ["angular_velocity", "status"]"#;
    let mut device = listener("icub_imu", keys, &[]);
    // First the gyroscope is at 3, and accelerometer and magnetometer, which are not used, at 0;
    // then the gyroscope is at 0.
    let frames = [
        "513#0702A0050000F8FF",
        "515#0703000000000000",
        "513#0802A0050000F8FF",
        "515#0800030300000000",
    ];
    let frames: Vec<Frame> = frames.iter().map(|text| frame(text, 0.0)).collect();
    let (readings, _) = decode(&mut *device, &frames);
    assert_eq!(readings[0].quality, Quality::DEVICE_COUNTER);
    assert_eq!(
        readings[1].quality,
        Quality::DEVICE_COUNTER | Quality::NOT_CALIBRATED
    );
}

#[test]
fn a_gap_in_seq_is_counted_and_told() {
    let mut device = listener("icub_imu", "", &[]);
    let acquisition = |seq: u8, t: f64| {
        [
            frame(&format!("513#{seq:02X}00000000000000"), t),
            frame(&format!("513#{seq:02X}02000000000000"), t),
        ]
    };
    let frames: Vec<Frame> = [254, 255, 0, 3]
        .iter()
        .zip(0_u8..)
        .flat_map(|(&seq, k)| acquisition(seq, f64::from(k) * 10.0))
        .collect();
    let (readings, faults) = decode(&mut *device, &frames);
    assert_eq!(
        readings
            .iter()
            .map(|r| r.device_counter)
            .collect::<Vec<_>>(),
        [254, 255, 0, 3]
    );
    assert_eq!(count(&faults, Counter::Lost), 2);
    let gaps: Vec<bool> = readings
        .iter()
        .map(|r| r.quality.contains(Quality::GAP_BEFORE))
        .collect();
    assert_eq!(gaps, [false, false, false, true]);
    // An acquisition with a missing frame is dropped, and a late frame is not mixed into the next
    // one.
    let [acc, gyr] = acquisition(4, 40.0);
    let [acc5, gyr5] = acquisition(5, 50.0);
    let (readings, faults) = decode(&mut *device, &[acc, acc5, gyr, gyr5]);
    assert_eq!(
        readings
            .iter()
            .map(|r| r.device_counter)
            .collect::<Vec<_>>(),
        [5]
    );
    assert_eq!(count(&faults, Counter::Unpaired), 2);
    assert!(readings[0].quality.contains(Quality::GAP_BEFORE));
}

#[test]
fn legacy_frames_have_the_scale_of_their_board() {
    let frames = [
        frame("511#0040000000C0", 0.0),
        frame("510#00400000FFFF", 0.3),
    ];
    for (keys, acceleration, degrees) in [
        (r#"legacy = "mtb""#, 9.80665, 125.0),
        (r#"legacy = "bno055""#, 163.84, 1024.0_f64),
    ] {
        let mut device = listener("icub_imu", keys, &[]);
        let (readings, faults) = decode(&mut *device, &frames);
        assert!(faults.is_empty(), "{faults:?}");
        let Reading::Imu(imu) = readings[0].reading else {
            panic!("{readings:?}")
        };
        assert_near(
            &imu.proper_acceleration,
            &[acceleration, 0.0, -acceleration],
            1e-9,
        );
        assert_near(&imu.angular_velocity[..1], &[degrees.to_radians()], 1e-9);
    }
    // Without `legacy` their scale is unknown, and they are ignored.
    let (readings, _) = decode(&mut *listener("icub_imu", "", &[]), &frames);
    assert!(readings.is_empty());
}

#[test]
fn a_motor_board() {
    let joint = JointState {
        position: core::f64::consts::TAU,
        velocity: -1000.0 * core::f64::consts::TAU / 65536.0,
        current: 1.0,
        ..JointState::ABSENT
    };
    let mut board = board("icub_motor", "", &[0]);
    let text = "110#E803FFFF00000100";
    assert_eq!(
        texts(&encode(
            &mut *board,
            0,
            &Reading::Joint(joint),
            Quality::GOOD
        )),
        [text]
    );
    let mut device = listener("icub_motor", "", &[0]);
    let (readings, _) = decode(&mut *device, &[frame(text, 0.0)]);
    let Reading::Joint(decoded) = readings[0].reading else {
        panic!("{readings:?}")
    };
    assert_near(
        &[decoded.position, decoded.velocity, decoded.current],
        &[joint.position, joint.velocity, 1.0],
        1e-12,
    );
    assert!(
        decoded.torque.is_nan() && decoded.acceleration.is_nan(),
        "absent is not zero"
    );
    // The raw motor temperature has no known scale: a legal frame without a reading.
    let (readings, faults) = decode(&mut *device, &[frame("11C#00003412", 0.0)]);
    assert!(readings.is_empty() && faults.is_empty());
}

#[test]
fn the_faults_of_a_motor_board_are_those_of_the_document() {
    // The document's worked value: bits 0, 7, 14 and 31.
    let mut device = listener("icub_motor", "", &[0]);
    let (readings, faults) = decode(
        &mut *device,
        &[
            frame("113#0610007D81400080", 0.0),
            frame("110#0000000000000000", 0.1),
        ],
    );
    let Reading::Actuator(actuator) = readings[0].reading else {
        panic!("{readings:?}")
    };
    let counts = [Counter::DeviceFault, Counter::DriveFault].map(|c| count(&faults, c));
    assert_eq!(
        counts,
        [0, 1],
        "the emergency button does not move the joint"
    );
    let faults = fault::CAN_INVALID_PROTOCOL | fault::EXTERNAL | fault::SETPOINT_EXPIRED | 1 << 31;
    let encoder = encoder::NOT_CALIBRATED;
    assert_eq!(
        actuator,
        Actuator {
            duty: 1.0,
            mode: 6,
            encoder,
            faults
        }
    );
    assert_eq!(
        readings[1].quality,
        Quality::DRIVE_FAULT | Quality::NOT_CALIBRATED
    );
    // Bus faults are neutral, an encoder's make a position doubtful, a drive's do not; finally all
    // is well.
    for (status, quality) in [
        ("113#0600000000BC00F8", Quality::GOOD),
        ("113#0600000010000000", Quality::DRIVE_FAULT),
        ("113#0602000000000000", Quality::DEVICE_FAULT),
        ("113#A000000000000000", Quality::DRIVE_FAULT),
        (
            "113#A001000000000000",
            Quality::DRIVE_FAULT | Quality::DEVICE_FAULT,
        ),
        ("113#B000000000000000", Quality::NOT_CALIBRATED),
        ("113#0600000000000000", Quality::GOOD),
    ] {
        let (readings, _) = decode(
            &mut *device,
            &[frame(status, 1.0), frame("110#0000000000000000", 1.1)],
        );
        assert_eq!(readings[1].quality, quality, "{status}");
    }
    // Bit by bit, after the names in the document.
    for bit in 0..32_u32 {
        let [a, b, c, d] = (1_u32 << bit).to_le_bytes();
        let status = frame(&format!("113#06000000{a:02X}{b:02X}{c:02X}{d:02X}"), 2.0);
        let (readings, faults) =
            decode(&mut *device, &[status, frame("110#0000000000000000", 2.1)]);
        let (quality, counts) = match bit {
            1..=3 | 17..=19 => (Quality::DEVICE_FAULT, [1, 0]),
            10..=13 | 15 | 27..=31 => (Quality::GOOD, [0, 0]),
            _ => (Quality::DRIVE_FAULT, [0, 1]),
        };
        assert_eq!(readings[1].quality, quality, "bit {bit}");
        assert_eq!(
            [Counter::DeviceFault, Counter::DriveFault].map(|c| count(&faults, c)),
            counts
        );
    }
}

#[test]
fn a_pos_frame_holds_several_joints() {
    // Type 0, label 2, two values: 90.0 and -6.2 deg; the third is ignored.
    let mut device = listener("icub_pos", "", &[2, 3]);
    let (readings, faults) = decode(&mut *device, &[frame("311#00228403C2FF3412", 0.0)]);
    assert!(faults.is_empty(), "{faults:?}");
    let positions: Vec<(u8, f64)> = readings
        .iter()
        .map(|r| {
            (
                r.output,
                if let Reading::Joint(joint) = r.reading {
                    joint.position.to_degrees()
                } else {
                    f64::NAN
                },
            )
        })
        .collect();
    assert_eq!(positions.len(), 2);
    assert_eq!((positions[0].0, positions[1].0), (2, 3));
    assert_near(&[positions[0].1, positions[1].1], &[90.0, -6.2], 1e-9);
    // The other quantity, no value, four values, a label beyond 15.
    for text in [
        "311#0122000000000000",
        "311#0020000000000000",
        "311#0024000000000000",
        "311#00F2000000000000",
    ] {
        let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        assert!(readings.is_empty());
        assert_eq!(count(&faults, Counter::Value), 1, "{text}");
    }
    let reading = Reading::Joint(JointState {
        position: 90_f64.to_radians(),
        ..JointState::ABSENT
    });
    let mut board = board("icub_pos", "", &[2]);
    assert_eq!(
        texts(&encode(&mut *board, 2, &reading, Quality::GOOD)),
        ["311#0021840300000000"]
    );
}
