//! Golden bytes: the worked examples of the protocol's documents, and frames computed by hand from
//! their tables.

use crate::rig::{board, count, decode, encode, frame, listener, options, spec, texts};
use proprio_drivers::icub_motor::{encoder, fault};
use proprio_drivers::{Board, EncodeError, Frame, Frames, Mode};
use proprio_topics::{
    Actuator, Counter, Imu, JointState, Nanos, Quality, Reading, Saturation, Temperature, Wrench,
};

const SCALES: &str = "full_scale_n = [1804, 1804, 1804]\nfull_scale_nm = [31, 31, 31]";

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

/// What is beyond the 16 bits of a count is at their end, on both sides.
#[test]
fn the_tare_of_a_strain_board_stays_within_its_bits() {
    let mut board = board("icub_strain", SCALES, &[]);
    let first = |board: &mut dyn Board, force: f64| {
        let load = Wrench {
            force: [force, 0.0, 0.0],
            torque: [0.0; 3],
        };
        let frames = encode(board, 0, &Reading::Wrench(load), Quality::GOOD);
        texts(&frames)[0].clone()
    };
    let (least, most) = (-1804.0, 1804.0 * 32767.0 / 32768.0);
    assert_eq!(first(&mut *board, least), "31A#000000800080");
    // 32768 steps do not fit.
    answers(&mut *board, "201#1501");
    assert_eq!(answers(&mut *board, "201#1600"), ["210#16007FFF"]);
    assert_eq!(first(&mut *board, most), "31A#FFFF00800080");
    answers(&mut *board, "201#1501");
    assert_eq!(answers(&mut *board, "201#1600"), ["210#16008001"]);
    assert_eq!(first(&mut *board, least), "31A#000000800080");
}

/// Its memory is corrupt: it sends zero, whatever the load.
#[test]
fn a_strain_board_with_a_scale_of_zero_sends_zero() {
    let keys = "full_scale_n = [1804, 1804, 0]\nfull_scale_nm = [31, 31, 31]";
    let mut board = board("icub_strain", keys, &[]);
    for force in [-5.0, 0.0, 5.0] {
        let load = Wrench {
            force: [0.0, 0.0, force],
            torque: [0.0; 3],
        };
        let frames = encode(&mut *board, 0, &Reading::Wrench(load), Quality::GOOD);
        assert_eq!(texts(&frames), ["31A#008000800080", "31B#008000800080"]);
    }
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
    // Only the first thermometer is selected.
    for (text, counter) in [
        ("31E#00FA000000", Counter::Value),
        ("31E#02FA000000", Counter::Value),
        ("31E#01FA0000", Counter::Length),
        ("31F#01FA00000000", Counter::Length),
    ] {
        let (readings, faults) = decode(&mut *device, &[frame(text, 1.0)]);
        assert_eq!((readings.len(), faults.len()), (0, 1), "{text}");
        assert_eq!(faults[0].counter, counter, "{text}");
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

/// One frame of an acquisition with these counts.
fn triple(sequence: u8, sensor: u8, ms: f64) -> Frame {
    frame(&format!("513#{sequence:02X}{sensor:02X}0001FF000A00"), ms)
}

/// A frame of up to 4 acquisitions back is late; all other jumps are gaps, of up to 250.
#[test]
fn a_jump_of_seq_is_a_gap_or_a_late_frame() {
    for (sequence, expected) in [
        (104, (Counter::Lost, 3)),
        (200, (Counter::Lost, 99)),
        (95, (Counter::Lost, 250)),
        (96, (Counter::Unpaired, 1)),
        (99, (Counter::Unpaired, 1)),
    ] {
        let mut device = listener("icub_imu", "", &[]);
        let frames = [triple(100, 0, 0.0), triple(100, 2, 0.2)];
        assert_eq!(decode(&mut *device, &frames).0.len(), 1);
        let (_, faults) = decode(&mut *device, &[triple(sequence, 0, 10.0)]);
        let counted: Vec<_> = faults.iter().map(|f| (f.counter, f.count)).collect();
        assert_eq!(counted, [expected], "{sequence}");
    }
}

/// Nothing that the board sends besides changes a reading: here of acquisitions 7, 8 (without the
/// angular velocity) and 9, each in the document's order.
#[test]
fn quantities_that_are_not_wanted_are_ignored() {
    let acquisition = |seq: u8| {
        let t = 10.0 * f64::from(seq);
        let others = [3, 5, 6].map(|sensor| triple(seq, sensor, t + 0.6));
        let last = [
            frame("514#0040000000000000", t + 0.8),
            frame(&format!("515#{seq:02X}00000000000000"), t + 1.0),
        ];
        let wanted = [0, 1, 2].map(|sensor| triple(seq, sensor, t));
        let sent = if seq == 8 { 2 } else { 3 };
        [&wanted[..sent], &others, &last].concat()
    };
    let frames: Vec<Frame> = (7..=9).flat_map(acquisition).collect();
    let mut device = listener("icub_imu", "", &[]);
    let (readings, faults) = decode(&mut *device, &frames);
    let read: Vec<_> = readings
        .iter()
        .map(|r| (r.device_counter, r.quality))
        .collect();
    let good = Quality::DEVICE_COUNTER;
    assert_eq!(read, [(7, good), (9, good | Quality::GAP_BEFORE)]);
    assert_eq!((count(&faults, Counter::Unpaired), faults.len()), (1, 1));
    let is_absent = |values: &[f64]| values.iter().all(|value| value.is_nan());
    for reading in &readings {
        let Reading::Imu(imu) = reading.reading else {
            panic!("{reading:?}")
        };
        assert!(is_absent(&imu.magnetic_field) && is_absent(&imu.orientation));
        assert!(!is_absent(&imu.angular_velocity));
    }
    // The quaternion that is heard first belongs to an earlier acquisition.
    let keys = "quantities = [\"acceleration\", \"orientation\"]";
    let mut device = listener("icub_imu", keys, &[]);
    let early = frame("514#0040000000000000", 65.0);
    let (readings, faults) = decode(&mut *device, &[&[early][..], &acquisition(7)].concat());
    assert_eq!((readings.len(), faults.len()), (1, 0), "{faults:?}");
    let Reading::Imu(imu) = readings[0].reading else {
        panic!("{readings:?}")
    };
    assert!(is_absent(&imu.angular_velocity) && imu.orientation[0] == 1.0);
}

#[test]
fn a_calibration_above_3_is_none() {
    let mut device = listener("icub_imu", IMU, &[]);
    for text in [
        "515#0704030300000000",
        "515#0703040300000000",
        "515#0703030400000000",
    ] {
        let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        assert_eq!((readings.len(), faults.len()), (0, 1), "{text}");
        assert_eq!(faults[0].counter, Counter::Value, "{text}");
    }
}

/// Frames of a wrong length and answers without a command are counted; those of another board, and
/// those of the other kind of IMU, are nothing to this one.
#[test]
fn an_imu_counts_only_its_own_frames() {
    let legacy = "legacy = \"mtb\"";
    for (keys, text, counts) in [
        ("", "513#0700000000000000", false),
        ("", "513#07000000000000", true),
        ("", "513#", true),
        (IMU, "514#00400000000000", true),
        (IMU, "515#07030303000000", true),
        ("", "210#", true),
        ("", "220#", false),
        ("", "523#07", false),
        ("", "511#01", false),
        (legacy, "511#0040000000C0", false),
        (legacy, "511#0040000000C000", true),
        (legacy, "510#0040000000", true),
        (legacy, "210#", false),
        (legacy, "513#07", false),
    ] {
        let (_, faults) = decode(&mut *listener("icub_imu", keys, &[]), &[frame(text, 0.0)]);
        let counted: Vec<_> = faults.iter().map(|f| f.counter).collect();
        let expected = if counts { &[Counter::Length][..] } else { &[] };
        assert_eq!(counted, expected, "{keys} {text}");
    }
    let newer = [triple(7, 0, 0.0), triple(7, 2, 0.1)];
    assert_eq!(
        decode(&mut *listener("icub_imu", "", &[]), &newer).0.len(),
        1
    );
    assert!(
        decode(&mut *listener("icub_imu", legacy, &[]), &newer)
            .0
            .is_empty()
    );
}

/// The halves of an acquisition before and after a restart do not belong together, and a gap before
/// it is still one after it.
#[test]
fn an_imu_begins_anew_after_a_restart() {
    let mut device = listener("icub_imu", "", &[]);
    let frames = [triple(7, 0, 0.0), triple(7, 2, 0.1), triple(8, 0, 10.0)];
    assert_eq!(decode(&mut *device, &frames).0.len(), 1);
    // Acquisition 8 lacks its angular velocity, and 9 is cut.
    let (readings, faults) = decode(&mut *device, &[triple(9, 0, 20.0)]);
    assert!(readings.is_empty() && count(&faults, Counter::Unpaired) == 1);
    device.restart(Nanos::from_millis(20));
    let frames = [
        triple(9, 2, 20.1),
        triple(10, 0, 30.0),
        triple(10, 2, 30.1),
        triple(11, 0, 40.0),
        triple(11, 2, 40.1),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    assert!(faults.is_empty(), "{faults:?}");
    let read: Vec<_> = readings
        .iter()
        .map(|r| (r.device_counter, r.quality))
        .collect();
    let good = Quality::DEVICE_COUNTER;
    assert_eq!(read, [(10, good | Quality::GAP_BEFORE), (11, good)]);
}

#[test]
fn legacy_frames_are_paired_in_the_order_of_their_board() {
    let (acceleration, rate) = ("511#0040000000C0", "510#00400000FFFF");
    // A BNO055 sends the accelerometer first; the order of an mtb is not known.
    for (keys, any_order) in [("legacy = \"bno055\"", false), ("legacy = \"mtb\"", true)] {
        let mut device = listener("icub_imu", keys, &[]);
        let frames = [frame(rate, 0.0), frame(acceleration, 0.3)];
        let (readings, _) = decode(&mut *device, &frames);
        assert_eq!(readings.len(), usize::from(any_order), "{keys}");
    }
    // The rates at 0 and at 10 ms are lost, or late: the next is dropped with its acceleration.
    let mut device = listener("icub_imu", "legacy = \"bno055\"", &[]);
    let frames = [
        frame(acceleration, 0.0),
        frame(acceleration, 10.0),
        frame(rate, 10.3),
        frame(acceleration, 20.0),
        frame(rate, 20.3),
        frame(acceleration, 30.0),
        frame(rate, 30.3),
    ];
    let (readings, faults) = decode(&mut *device, &frames);
    let qualities: Vec<Quality> = readings.iter().map(|reading| reading.quality).collect();
    assert_eq!(qualities, [Quality::GAP_BEFORE, Quality::GOOD]);
    assert_eq!(count(&faults, Counter::Unpaired), 3);
    // One quantity alone waits for nothing.
    for (quantity, index) in [("acceleration", 0), ("angular_velocity", 1)] {
        let keys = format!("legacy = \"mtb\"\nquantities = [\"{quantity}\"]");
        let mut device = listener("icub_imu", &keys, &[]);
        let frames = [0.0, 10.0, 20.0].map(|ms| [frame(acceleration, ms), frame(rate, ms + 0.3)]);
        let (readings, faults) = decode(&mut *device, frames.as_flattened());
        assert_eq!((readings.len(), faults.len()), (3, 0));
        assert_eq!(readings[0].acquired, frames[0][index].t);
        let Reading::Imu(imu) = readings[0].reading else {
            panic!("{readings:?}")
        };
        let absent = [imu.proper_acceleration, imu.angular_velocity].map(|v| v[0].is_nan());
        assert_eq!(absent, [index == 1, index == 0]);
    }
}

/// It sends what it was told to send last, and a command of the other kind of boards is none.
#[test]
fn an_imu_board_does_what_it_is_told() {
    let started = |keys: &str| {
        let board = options("icub_imu", keys).board(&spec(1, Mode::Listen, &[]));
        board.expect("legal keys")
    };
    let ids = |board: &mut dyn Board| -> Vec<String> {
        let frames = encode(board, 0, &Reading::Imu(imu()), Quality::GOOD);
        // The identifier, and the sensor of a triple.
        let id = |text: String| match text.starts_with("513") {
            true => format!("{}{}", &text[..4], &text[6..8]),
            false => text[..3].to_owned(),
        };
        texts(&frames).into_iter().map(id).collect()
    };
    let mut newer = started(IMU);
    assert_eq!(answers(&mut *newer, "70F#FF"), ["710#FF0C020008"]);
    assert_eq!(
        ids(&mut *newer),
        ["513#00", "513#01", "513#02", "514", "515"]
    );
    answers(&mut *newer, "201#4F0000");
    assert!(newer.period().is_some());
    for (mask, sends) in [
        ("0100", &["513#00"][..]),
        ("1400", &["513#02", "514"]),
        ("0080", &["515"]),
        ("0000", &[]),
    ] {
        answers(&mut *newer, &format!("201#34{mask}0100000000"));
        assert_eq!(newer.period(), None, "a new configuration stops it");
        answers(&mut *newer, "201#3514");
        assert_eq!(newer.period().is_some(), !sends.is_empty(), "{mask}");
        assert_eq!(ids(&mut *newer), sends);
        answers(&mut *newer, "201#3500");
        assert_eq!(newer.period(), None);
    }
    for (keys, board) in [("legacy = \"mtb\"", "05"), ("legacy = \"bno055\"", "0C")] {
        let mut legacy = started(keys);
        assert_eq!(
            answers(&mut *legacy, "70F#FF"),
            [format!("710#FF{board}020008")]
        );
        for text in ["201#3401000100000000", "201#33", "201#3500"] {
            assert_eq!(answers(&mut *legacy, text), [""; 0], "{text}");
            assert_eq!(legacy.period(), Some(Nanos::from_millis(10)), "{text}");
        }
        assert_eq!(ids(&mut *legacy), ["511", "510"]);
        for (command, sends, streams) in [
            ("201#4F0214", &["511"][..], true),
            ("201#4F0414", &["510"], true),
            ("201#4F0014", &[], false),
            ("201#4F0614", &["511", "510"], true),
            ("201#4F0600", &["511", "510"], false),
        ] {
            answers(&mut *legacy, command);
            let period = streams.then_some(Nanos::from_millis(20));
            assert_eq!(legacy.period(), period, "{command}");
            assert_eq!(ids(&mut *legacy), sends, "{command}");
        }
    }
}

/// These frames cannot mark a value as absent, of whichever quantity.
#[test]
fn each_quantity_of_an_imu_must_be_a_number() {
    let mut board = board("icub_imu", IMU, &[]);
    let absent = [
        Imu {
            proper_acceleration: [0.0, 0.0, f64::NAN],
            ..imu()
        },
        Imu {
            angular_velocity: [f64::NAN, 0.0, 0.0],
            ..imu()
        },
        Imu {
            magnetic_field: [0.0, f64::INFINITY, 0.0],
            ..imu()
        },
        Imu {
            orientation: [f64::NAN; 4],
            ..imu()
        },
    ];
    for imu in absent {
        let mut out = Frames::new();
        let encoded = board.encode(0, &Reading::Imu(imu), Quality::GOOD, &mut out);
        assert_eq!(
            (encoded, out.len()),
            (Err(EncodeError::NotFinite), 0),
            "{imu:?}"
        );
    }
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
    // The board's buffer overflows: a fault of it, whatever the frame holds.
    for text in ["115#", "115#01", "115#0000000000000000"] {
        let (readings, faults) = decode(&mut *device, &[frame(text, 0.0)]);
        assert_eq!((readings.len(), faults.len()), (0, 1), "{text}");
        assert_eq!(faults[0].counter, Counter::DeviceFault, "{text}");
    }
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
    // Beside it: an invalid command, an expired setpoint, and a state of the bus.
    let faults = fault::EXTERNAL | 1 | 1 << 14 | 1 << 31;
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
