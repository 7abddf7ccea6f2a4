//! A stalled bus loop reads the frames that have arrived meanwhile before it reports a device as
//! silent, and sees the silences between them.

use proprio_drivers::{Frame, Id};
use proprio_gateway::bus::Bus;
use proprio_gateway::clock::Manual;
use proprio_gateway::devices::BusDevices;
use proprio_gateway::link::{Link, LinkCounters, Received, TransmitError};
use proprio_gateway::plan::Plan;
use proprio_gateway::publish::Memory;
use proprio_gateway::status::BusStatus;
use proprio_topics::{Counter, LinkState, Nanos, Quality, StampKind};
use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;

/// A link that returns prepared frames and discards sent ones.
struct Script {
    frames: VecDeque<Frame>,
    sent: u64,
}

impl Link for Script {
    fn recv(&mut self, _: Nanos) -> Received {
        self.frames
            .pop_front()
            .map_or(Received::TimedOut, Received::Frame)
    }
    fn send(&mut self, _: &Frame) -> Result<(), TransmitError> {
        self.sent += 1;
        Ok(())
    }
    fn state(&self) -> LinkState {
        LinkState::Up
    }
    fn counters(&self) -> LinkCounters {
        LinkCounters {
            sent: self.sent,
            ..LinkCounters::default()
        }
    }
}

/// A bus with an F/T board that may be silent for 50 ms, and the frames of wrenches at `times`.
fn bus(times: impl Iterator<Item = Nanos>) -> (Bus<Memory>, Arc<BusStatus>) {
    let text = r#"
        schema = 1
        robot = "r"
        [[bus]]
        name = "b"
        source = { kind = "virtual", name = "b" }
          [[bus.device]]
          driver = "icub_strain"
          name = "ft"
          address = 1
          period_ms = 10
          max_silence_ms = 50
          full_scale_n = [1804.0, 1804.0, 1804.0]
          full_scale_nm = [31.0, 31.0, 31.0]
    "#;
    let plan = Plan::parse(text, Path::new(".")).unwrap();
    let status = Arc::new(BusStatus::new(0, &plan.buses[0]));
    let devices = BusDevices::new(0, &plan.buses[0], None, Arc::clone(&status)).unwrap();
    let frames = times.flat_map(|t| {
        let force = Frame::new(Id::standard(0x31A), &[0, 0x80, 0, 0x80, 0, 0x80])
            .at(t, StampKind::Software);
        let torque = Frame::new(Id::standard(0x31B), &[0, 0x80, 0, 0x80, 0, 0x80]);
        [
            force,
            torque.at(t + Nanos::from_micros(130), StampKind::Software),
        ]
    });
    let link = Box::new(Script {
        frames: frames.collect(),
        sent: 0,
    });
    let bus = Bus::new(link, devices, Memory::default(), Arc::clone(&status));
    (bus, status)
}

fn count(status: &BusStatus, counter: Counter) -> u64 {
    let device = status.devices().next();
    device.map_or(0, |d| d.counters[counter as usize])
}

#[test]
fn a_backlog_is_no_silence() {
    let start = Nanos::from_millis(1000);
    let clock = Manual::new(start);
    // A second of wrenches, 10 ms apart; the loop runs for the first 0.2 s, then not for 0.8 s.
    let (mut bus, status) = bus((0..100).map(|i| start + Nanos::from_millis(10 * i + 1)));
    let count = |counter| count(&status, counter);
    for i in 0..40 {
        clock.set(start + Nanos::from_millis(5 * i + 2));
        bus.turn(&clock);
    }
    let starts = count(Counter::Starts);
    assert!(starts >= 1, "it is started once: {starts}");
    clock.set(start + Nanos::from_millis(1002));
    for _ in 0..400 {
        bus.turn(&clock);
    }
    assert_eq!(
        (count(Counter::Silences), count(Counter::Starts)),
        (0, starts)
    );
    assert_eq!(count(Counter::Readings), 100);
    // A real silence is reported.
    clock.set(start + Nanos::from_millis(1200));
    bus.turn(&clock);
    assert_eq!(count(Counter::Silences), 1);
    assert_eq!(bus.into_sink().samples.len(), 100);
}

/// A silence between two frames that both waited in the socket during a stall is one, as it is in
/// a log of them.
#[test]
fn a_silence_within_a_backlog_is_seen() {
    let start = Nanos::from_millis(1000);
    let clock = Manual::new(start);
    let times = [1, 11, 21, 61, 71, 130, 140].map(|ms| start + Nanos::from_millis(ms));
    let (mut bus, status) = bus(times.into_iter());
    // The loop runs for the first two wrenches only, then not for half a second.
    clock.set(times[0]);
    bus.turn(&clock);
    bus.turn(&clock);
    clock.set(start + Nanos::from_millis(500));
    for _ in 0..2 * times.len() - 2 {
        bus.turn(&clock);
    }
    let samples = bus.into_sink().samples;
    let gaps: Vec<bool> = samples
        .iter()
        .map(|s| s.header.quality.contains(Quality::GAP_BEFORE))
        .collect();
    // 59 ms from 71 to 130 ms are more than the maximum of 50 ms, the 40 ms before are not.
    assert_eq!(gaps, [false, false, false, false, false, true, false]);
    assert_eq!(count(&status, Counter::Silences), 1);
}
