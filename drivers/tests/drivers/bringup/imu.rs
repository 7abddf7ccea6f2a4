//! Bring-up of IMU boards.

use super::imu;
use crate::rig::{Rig, decode, frame, options, spec};
use proprio_drivers::{Decoded, Mode, State};
use proprio_topics::{Counter, Imu, Nanos, Quality, Reading};

#[test]
fn an_imu_is_told_asked_and_started_as_in_the_document() {
    let keys = r#"quantities = ["acceleration", "angular_velocity", "status"]"#;
    let mut rig = Rig::new("icub_imu", keys, &[], imu());
    rig.run(100);
    // The document's example: 201#3405800100000000, 201#350A.
    assert_eq!(rig.sent, ["201#3405800100000000", "201#33", "201#350A"]);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 10)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(
        (rig.sent.last().unwrap().as_str(), rig.board.period()),
        ("201#3500", None)
    );
}

#[test]
fn an_imu_that_lost_its_configuration_is_told_again() {
    let mut rig = Rig::new("icub_imu", "placement = 6\nmode = \"imu\"", &[], imu());
    rig.host_loses = Box::new(|number, _| number == 1);
    rig.run(100);
    assert_eq!(
        rig.sent,
        [
            "201#3405008886000000",
            "201#33",
            "201#3405008886000000",
            "201#33",
            "201#350A"
        ]
    );
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(rig.count(Counter::Changed), 0);
}

#[test]
fn an_imu_that_does_not_answer_is_started_all_the_same() {
    let mut rig = Rig::new("icub_imu", "", &[], imu());
    rig.board_loses = Box::new(|_, frame| frame.data().first() == Some(&0x33));
    rig.run(500);
    assert_eq!(rig.device.state(), State::Streaming);
}

#[test]
fn a_silent_imu_is_started_again_and_its_counter_begins_anew() {
    let mut rig = Rig::new("icub_imu", "", &[], imu());
    rig.run(500);
    rig.board = options("icub_imu", "")
        .board(&spec(1, Mode::Supervise, &[]))
        .unwrap();
    let before = rig.readings.len();
    rig.run(200);
    assert_eq!(
        (
            rig.device.state(),
            rig.count(Counter::Silences),
            rig.count(Counter::Lost)
        ),
        (State::Streaming, 1, 0)
    );
    assert!(rig.readings[before].quality.contains(Quality::GAP_BEFORE));
    assert_eq!(rig.readings[before].device_counter, 1);
}

/// A gateway that is started anew beside a board that streams: its first acquisition is heard from
/// the middle, and the start makes the counter begin anew. Neither is a loss; a gap later is.
#[test]
fn an_imu_that_streams_already_loses_nothing_at_the_start() {
    let keys = "quantities = [\"acceleration\", \"angular_velocity\", \"orientation\"]";
    let mut rig = Rig::new("icub_imu", keys, &[], imu());
    rig.reading.1 = Reading::Imu(Imu {
        orientation: [1.0, 0.0, 0.0, 0.0],
        ..match imu().1 {
            Reading::Imu(imu) => imu,
            other => panic!("{other:?}"),
        }
    });
    rig.run(1130);
    let fresh = options("icub_imu", keys).device(&spec(1, Mode::Supervise, &[]));
    rig.device = fresh.unwrap();
    // It begins to listen after the acceleration, and its first question is lost, so that the board
    // streams on for some time.
    let from = rig.received;
    let sent = rig.sent.len();
    rig.board_loses = Box::new(move |number, _| number == from + 1);
    rig.host_loses = Box::new(move |number, _| number <= sent + 2);
    rig.run(500);
    assert_eq!(rig.device.state(), State::Streaming);
    assert_eq!(
        rig.faults
            .iter()
            .filter(|f| f.counter != Counter::Starts)
            .count(),
        0
    );
    let last = rig.readings.last().expect("readings").device_counter;
    assert!(last < 60, "the counter began anew: {last}");
    let from = rig.received;
    rig.board_loses = Box::new(move |number, _| number <= from + 9);
    rig.run(100);
    assert_eq!(rig.count(Counter::Lost), 3);
}

/// A command makes the counter begin anew once. What jumps after that is lost.
#[test]
fn a_command_excuses_one_jump_of_an_imus_counter() {
    let device = options("icub_imu", "").device(&spec(1, Mode::Supervise, &[]));
    let (mut device, now) = (device.unwrap(), Nanos::from_millis(1000));
    let command = device.poll_transmit(now, &mut Decoded::new()).unwrap();
    device.on_sent(&command.frame, Ok(now));
    let acquisitions = [(7, 1001.0), (100, 1010.0), (150, 1020.0)].map(|(sequence, ms)| {
        [0, 2].map(|sensor| {
            let text = format!("513#{sequence:02X}{sensor:02X}000000000000");
            frame(&text, ms)
        })
    });
    let (readings, faults) = decode(&mut *device, acquisitions.as_flattened());
    let gaps = readings
        .iter()
        .map(|reading| reading.quality.contains(Quality::GAP_BEFORE));
    assert_eq!(gaps.collect::<Vec<_>>(), [false, true, true]);
    let counted: Vec<_> = faults.iter().map(|f| (f.counter, f.count)).collect();
    assert_eq!(counted, [(Counter::Lost, 49)]);
}

#[test]
fn a_legacy_imu_is_started_with_its_own_command() {
    let mut rig = Rig::new("icub_imu", "legacy = \"mtb\"\nperiod_ms = 20", &[], imu());
    rig.run(100);
    assert_eq!(rig.sent, ["201#4F0614"]);
    assert_eq!(
        (rig.device.state(), rig.readings.len()),
        (State::Streaming, 5)
    );
    rig.device.stop(rig.now);
    rig.run(2);
    assert_eq!(
        (rig.sent.last().unwrap().as_str(), rig.board.period()),
        ("201#4F0000", None)
    );
}

/// It takes the command within the 20 ms of an answer and sends a period later: until then a jump
/// is excused.
#[test]
fn a_command_excuses_a_jump_of_an_imus_counter_for_a_while() {
    for (ms, lost) in [(1029.9, 0), (1030.1, 92)] {
        let device = options("icub_imu", "").device(&spec(1, Mode::Supervise, &[]));
        let (mut device, now) = (device.unwrap(), Nanos::from_millis(1000));
        let command = device.poll_transmit(now, &mut Decoded::new()).unwrap();
        device.on_sent(&command.frame, Ok(now));
        let texts = [7, 100].map(|sequence: u8| format!("513#{sequence:02X}00000000000000"));
        let frames = [frame(&texts[0], 1001.0), frame(&texts[1], ms)];
        let (_, faults) = decode(&mut *device, &frames);
        assert_eq!(crate::rig::count(&faults, Counter::Lost), lost, "{ms}");
    }
}
