//! A stalled bus loop reads the frames that have arrived meanwhile before it reports a device as
//! silent.

use proprio_drivers::{Frame, Id};
use proprio_gateway::bus::Bus;
use proprio_gateway::clock::Manual;
use proprio_gateway::decoder::Decoder;
use proprio_gateway::link::{Link, LinkCounters, Received, SendError};
use proprio_gateway::plan::Plan;
use proprio_gateway::publish::Memory;
use proprio_gateway::status::BusStatus;
use proprio_topics::{Counter, LinkState, Nanos, StampKind};
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
    fn send(&mut self, _: &Frame, _: Nanos) -> Result<(), SendError> {
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

#[test]
fn a_backlog_is_no_silence() {
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
    let decoder = Decoder::new(0, &plan.buses[0], None, Arc::clone(&status)).unwrap();
    let start = Nanos::from_millis(1000);
    let clock = Manual::new(start);
    // A second of wrenches, 10 ms apart; the loop runs for the first 0.2 s, then not for 0.8 s.
    let frames = (0..100).flat_map(|i| {
        let t = start + Nanos::from_millis(10 * i + 1);
        let force = Frame::new(Id::standard(0x31A), &[0, 0x80, 0, 0x80, 0, 0x80])
            .at(t, StampKind::Software);
        let torque = Frame::new(Id::standard(0x31B), &[0, 0x80, 0, 0x80, 0, 0x80]);
        [
            force,
            torque.at(t + Nanos::from_micros(130), StampKind::Software),
        ]
    });
    let mut bus = Bus::new(
        Box::new(Script {
            frames: frames.collect(),
            sent: 0,
        }),
        decoder,
        Memory::default(),
        Arc::clone(&status),
    );
    let count = |counter: Counter| {
        status
            .devices()
            .next()
            .map_or(0, |d| d.counters[counter as usize])
    };
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
