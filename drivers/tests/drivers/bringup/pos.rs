//! Bring-up of boards that measure angles (pos).

use crate::rig::{Rig, decode, frame, listener, options, spec};
use proprio_drivers::{Decoded, Mode, SpecError, State};
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading};

#[test]
fn a_pos_board_is_configured_and_started() {
    let joint = (
        2,
        Reading::Joint(JointState {
            position: 0.5,
            ..JointState::ABSENT
        }),
    );
    let keys = "sensors = [{ label = 2, inverted = true, rotation_deg = -90, zero_deg = 25.6 }, \
                { label = 3 }]\nperiod_ms = 5";
    let mut rig = Rig::new("icub_pos", keys, &[2], joint);
    rig.run(50);
    // F2: enabled, inverted, -90 deg, label 2; zero 0x0100. 83: enabled, label 3.
    assert_eq!(rig.sent, ["201#5200F20001830000", "201#5100", "201#5305"]);
    assert!(rig.readings.iter().all(|r| r.quality == Quality::GOOD));
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 10)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(
        (rig.sent.last().unwrap().as_str(), rig.board.period()),
        ("201#5300", None)
    );
}

const POS: &str = "sensors = [{ label = 2, zero_deg = 25.6 }]";

fn pos() -> (u8, Reading) {
    let state = JointState {
        position: 0.5,
        ..JointState::ABSENT
    };
    (2, Reading::Joint(state))
}

/// The board misses the configuration several times; it streams meanwhile, with its old one.
#[test]
fn an_angle_is_good_only_when_the_board_has_confirmed_its_configuration() {
    let mut rig = Rig::new("icub_pos", POS, &[2], pos());
    rig.board = options("icub_pos", POS)
        .board(&spec(1, Mode::Listen, &[2]))
        .unwrap();
    let mut sets = 0;
    rig.host_loses = Box::new(move |_, frame| {
        sets += u32::from(frame.data().first() == Some(&0x52));
        // Neither the first configurations nor any question arrive: 3 x 20 ms without an answer.
        sets <= 3
    });
    rig.run(200);
    let good: Vec<bool> = rig
        .readings
        .iter()
        .map(|reading| reading.quality == Quality::GOOD)
        .collect();
    let first = good.iter().position(|good| *good).unwrap();
    assert!((5..8).contains(&first), "{good:?}");
    for reading in &rig.readings[..first] {
        assert_eq!(reading.quality, Quality::NOT_CALIBRATED);
    }
    assert!(good[first..].iter().all(|good| *good));
    assert_eq!(rig.count(Counter::Changed), 0);
    assert_eq!(rig.sent.last().unwrap(), "201#530A");
    // A board that was reset has lost its configuration: it counts again only when confirmed.
    rig.board = options("icub_pos", POS)
        .board(&spec(1, Mode::Listen, &[2]))
        .unwrap();
    rig.device.restart(rig.now);
    let before = rig.readings.len();
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x51));
    rig.run(600);
    let after = &rig.readings[before..];
    assert!(after.len() > 10 && rig.device.state() == State::Streaming);
    assert!(after[0].quality.contains(Quality::GAP_BEFORE));
    assert!(
        after
            .iter()
            .all(|reading| reading.quality.contains(Quality::NOT_CALIBRATED))
    );
    assert_eq!(rig.count(Counter::Changed), 0);
    // An answer that comes after the start confirms it, too.
    let set = rig.sent.iter().find(|sent| sent.starts_with("201#52"));
    let answer = set.expect("a command").replace("201#52", "210#51");
    let now = rig.now.seconds() * 1e3;
    let late = [&answer, "311#0021840300000000"].map(|text| frame(text, now));
    let (readings, faults) = decode(&mut *rig.device, &late);
    assert_eq!(readings[0].quality, Quality::GOOD);
    assert!(faults.is_empty(), "{faults:?}");
}

#[test]
fn a_pos_board_that_never_agrees_is_counted_and_its_angles_stay_doubtful() {
    let mut rig = Rig::new("icub_pos", POS, &[2], pos());
    rig.host_loses = Box::new(|_, frame| frame.data().first() == Some(&0x52));
    rig.run(500);
    assert_eq!(
        (rig.device.state(), rig.count(Counter::Changed)),
        (State::Streaming, 1)
    );
    assert!(rig.readings.len() > 10);
    assert!(
        rig.readings
            .iter()
            .all(|reading| reading.quality == Quality::NOT_CALIBRATED)
    );
    // Before anything was sent.
    let mut device = options("icub_pos", POS)
        .device(&spec(1, Mode::Supervise, &[2]))
        .unwrap();
    let (readings, _) = decode(&mut *device, &[frame("311#0021840300000000", 0.0)]);
    assert_eq!(readings[0].quality, Quality::NOT_CALIBRATED);
    // Without `sensors`, and where another program commands the board, there is nothing to confirm.
    let mut rig = Rig::new("icub_pos", "", &[2], pos());
    rig.run(100);
    assert_eq!(rig.sent, ["201#530A"]);
    assert_eq!(rig.readings[0].quality, Quality::GOOD);
    let mut device = listener("icub_pos", POS, &[2]);
    let (readings, _) = decode(&mut *device, &[frame("311#0021840300000000", 0.0)]);
    assert_eq!(readings[0].quality, Quality::GOOD);
}

/// A sensor's first byte is 80 (enabled) and its label; its zero is in 0.1 deg.
#[test]
fn a_sensor_has_a_label_of_4_bits_and_a_zero_within_a_turn() {
    let first = |sensor: &str| {
        let options = options("icub_pos", &format!("sensors = [{sensor}]"));
        let mut device = options.device(&spec(1, Mode::Supervise, &[0]))?;
        let transmit = device.poll_transmit(Nanos::from_millis(1000), &mut Decoded::new());
        Ok(transmit.expect("a configuration").frame.to_string())
    };
    for (sensor, sent) in [
        ("{ label = 15 }", "201#52008F0000000000"),
        ("{ zero_deg = 360.0 }", "201#520080100E000000"),
        ("{ zero_deg = -360.0 }", "201#520080F0F1000000"),
    ] {
        assert_eq!(first(sensor), Ok(sent.to_owned()));
    }
    for (sensor, wrong) in [
        ("{ label = 16 }", "label"),
        ("{ label = 255 }", "label"),
        ("{ zero_deg = 360.1 }", "zero_deg"),
        ("{ zero_deg = -360.1 }", "zero_deg"),
        ("{ zero_deg = nan }", "zero_deg"),
        ("{ rotation_deg = 270 }", "rotation_deg"),
    ] {
        let refused = first(sensor);
        let names = matches!(refused, Err(SpecError::Key { key, .. }) if key == wrong);
        assert!(names, "{sensor}: {refused:?}");
    }
}
