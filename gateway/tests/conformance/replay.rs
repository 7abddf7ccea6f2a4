//! What logs alone have: stamps, and several buses in one log.

use super::{Log, PATIENCE, RECORDED, exactly, frame, now, silent};
use proprio_drivers::{Frame, Id};
use proprio_gateway::link::replay::{Matching, Pace, Replay};
use proprio_gateway::link::{Link, ListenOnly, Received};
use proprio_gateway::log::Stamps;
use proprio_gateway::log::candump::write_log_line;
use proprio_topics::{LinkState, Nanos, StampKind};

#[test]
fn a_log_at_its_pace_is_moved_to_now() {
    let bus = Log::new(Pace::Recorded);
    let mut log = Vec::new();
    for ms in [0, 5, 5, 205] {
        write_log_line(
            &mut log,
            RECORDED + Nanos::from_millis(ms),
            "can0",
            &Frame::new(Id::standard(1), &[]),
        )
        .unwrap();
    }
    let mut link = Replay::open(&bus.write(&log), Pace::Recorded, None, &[]).unwrap();
    let before = now();
    let first = frame(&mut link);
    assert!(first.t >= before && first.t <= now());
    for ms in [5, 5] {
        let next = frame(&mut link);
        assert_eq!(
            (next.t - first.t, next.stamp),
            (Nanos::from_millis(ms), StampKind::Log)
        );
        assert!(now() >= next.t, "not before its time");
    }
    let deadline = now() + Nanos::from_millis(10);
    // Unless the machine was suspended, the last frame is not due yet.
    if deadline < first.t + Nanos::from_millis(200) {
        assert_eq!(link.recv(deadline), Received::TimedOut);
        assert!(now() >= deadline);
        assert_eq!(link.recv(Nanos::ZERO), Received::TimedOut);
        assert_eq!(link.state(), LinkState::Up);
    }
    assert_eq!(frame(&mut link).t - first.t, Nanos::from_millis(205));
    assert_eq!(link.recv(now()), Received::Ended);
    assert_eq!(link.counters().received, 4);

    // Several buses of one log stay in step, independent of when each is first read.
    let (start, path) = (now() - Nanos::from_millis(300), bus.write(&log));
    for _ in 0..2 {
        let mut link = Replay::open(&path, Pace::Recorded, None, &[]).unwrap();
        link.start_at(start);
        assert_eq!(exactly(&mut link, 4)[3].t, start + Nanos::from_millis(205));
    }
}

/// `stamps` in the source: what relative stamps count from.
#[test]
fn a_source_may_state_what_stamps_count_from() {
    let bus = Log::new(Pace::Fast);
    let line = " (000.010000)  can0  001   [0]\n";
    let path = bus.write(line.repeat(3).as_bytes());
    for (stamps, ms) in [
        (Stamps::SinceStart, [10, 10, 10]),
        (Stamps::SincePrevious, [10, 20, 30]),
    ] {
        let mut link = Replay::open_with(&path, Pace::Fast, stamps, None, &[]).unwrap();
        let times: Vec<_> = exactly(&mut link, 3).iter().map(|frame| frame.t).collect();
        assert_eq!(times, ms.map(Nanos::from_millis));
        assert_eq!(link.note(), None);
    }
    let mut link = Replay::open(&path, Pace::Fast, None, &[]).unwrap();
    exactly(&mut link, 3);
    let note = link.note().expect("three lines prove nothing");
    assert!(note.contains("State it with stamps = "), "{note}");
}

/// It has the stamp of the line before it, as it was recorded after that one.
#[test]
fn a_line_without_a_stamp_comes_with_the_one_before_it() {
    let bus = Log::new(Pace::Recorded);
    let path = bus.write(b"(1.00) can0 001#\n(1.02) can0 002#\ncan0 003#\n(1.03) can0 004#\n");
    let mut link = Replay::open(&path, Pace::Recorded, None, &[]).unwrap();
    let start = now() - Nanos::from_millis(100);
    link.start_at(start);
    let times = exactly(&mut link, 4)
        .into_iter()
        .map(|frame| frame.t - start);
    let wanted = [0, 20, 20, 30].map(Nanos::from_millis);
    assert_eq!(times.collect::<Vec<_>>(), wanted);
}

#[test]
fn a_log_at_once_keeps_its_stamps_and_its_lack_of_them() {
    let bus = Log::new(Pace::Fast);
    let path = bus.write(
        b"(1479121923.123456) can0 123#11\nrubbish\n  can0  123   [1]  22\n\
          (1.5) can0 20000004#00\n(2.5) can0 123#33\n",
    );
    let mut link = Replay::open(&path, Pace::Fast, None, &[]).unwrap();
    let mut next = || match link.recv(now() + PATIENCE) {
        Received::Frame(frame) => (false, frame.t.0, frame.stamp),
        Received::Error(frame) => (true, frame.t.0, frame.stamp),
        other => panic!("{other:?}"),
    };
    assert_eq!(
        [next(), next(), next(), next()],
        [
            (false, 1_479_121_923_123_456_000, StampKind::Log),
            (false, 0, StampKind::None),
            (true, 1_500_000_000, StampKind::Log),
            (false, 2_500_000_000, StampKind::Log)
        ]
    );
    silent(&mut link);
    assert_eq!(
        (
            link.report().bad,
            link.report().unstamped,
            link.counters().error_frames
        ),
        (1, 1, 1)
    );
    // Without stamps the recorded pace is not possible.
    let path = bus.write(b"  can0  123   [1]  22\n");
    let error = Replay::open(&path, Pace::Recorded, None, &[]).unwrap_err();
    assert!(error.to_string().contains("no time stamps"), "{error}");
    assert!(Replay::open(&path, Pace::Fast, None, &[]).is_ok());
    let missing = bus.folder.path().join("missing.log");
    assert!(
        Replay::open(&missing, Pace::Fast, None, &[])
            .unwrap_err()
            .to_string()
            .contains("missing.log")
    );
    let mut empty = Replay::open(&bus.write(b""), Pace::Recorded, None, &[]).unwrap();
    assert_eq!(
        (empty.recv(now() + PATIENCE), empty.state()),
        (Received::Ended, LinkState::Ended)
    );
    // The log of the gateway says so; also of a bus that is listened to.
    let note = ListenOnly(Box::new(link)).note().unwrap();
    assert!(
        note.starts_with("1 lines of the log were skipped; the first is "),
        "{note}"
    );
    let link = Replay::open(&bus.write(b"(1.0) can0 123#11\n"), Pace::Fast, None, &[]);
    let mut link = ListenOnly(Box::new(link.unwrap()));
    assert!(matches!(link.recv(now() + PATIENCE), Received::Frame(_)));
    assert_eq!(link.note(), None);
}

#[test]
fn a_log_of_several_buses_is_taken_apart_by_interface_then_by_name() {
    let bus = Log::new(Pace::Fast);
    let path = bus.write(
        b"(1.0) can0 001#\n(1.1) can1 002#\n(1.2) left 003#\n(1.3) other 004#\n(1.4) can0 005#\n",
    );
    let buses = [
        (Some("can0"), "left"),
        (Some("can1"), "can0"),
        (None, "right"),
    ];
    let replayed = |this, buses: &[_]| {
        let mut link = Replay::open(&path, Pace::Fast, Matching::of(buses, this), &[]).unwrap();
        let mut ids = Vec::new();
        while let Received::Frame(frame) = link.recv(now()) {
            ids.push(frame.id.raw());
        }
        assert_eq!(link.unmatched() + ids.len() as u64, 5);
        (ids, link.note())
    };
    let ids = |this, buses: &[_]| replayed(this, buses).0;
    assert_eq!(ids(0, &buses), [1, 3, 5]);
    assert_eq!(
        ids(1, &buses),
        [2],
        "can0 is the other bus's interface, although it is this bus's name"
    );
    assert!(ids(2, &buses).is_empty());
    assert_eq!(replayed(0, &buses[..1]), (vec![1, 3, 5], None));
    // A single bus takes all if the log was recorded under another name; that is told if they may
    // be several buses.
    let (all, note) = replayed(0, &[(Some("can7"), "arm")]);
    assert_eq!(all, [1, 2, 3, 4, 5]);
    let note = note.unwrap();
    assert!(
        note.starts_with(
            "the log has the interfaces can0, can1, left, other, and the frames of all"
        ),
        "{note}"
    );
}
