//! A bus in simulated time, between simulated boards and the gateway's loop, and what goes wrong on
//! it.

use crate::truth::random::Random;
use proprio_drivers::{Claim, Format, Frame, Id};
use proprio_gateway::clock::Clock;
use proprio_gateway::link::{Link, LinkCounters, Received, TransmitError};
use proprio_simulator::simulator::BusSimulator;
use proprio_topics::{LinkState, Nanos, StampKind};
use std::collections::VecDeque;
use std::sync::atomic::AtomicI64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, PoisonError};

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Nothing.
    None,
    /// The device sends nothing.
    Off,
    /// It repeats its reading.
    Stuck,
    /// One of its frames in ten has any data.
    Garbage,
    /// One bit of its data is inverted.
    Wrong,
    /// A bit is flipped in 1 % of its frames.
    Flipped,
    /// Its frames arrive in 10 of 100 ms.
    Slow,
    /// Its frames are 20 ms late.
    Delayed,
    /// It sends nothing for .1 to 1 s, once in about 2 s.
    Intermittent,
    /// It starts anew, once.
    Reboot,
    /// Frames of the bus are up to .4 ms late, one in five: their order changes.
    Order,
    /// 5 % of the frames are lost.
    Loss,
    /// 5 % of the frames come twice.
    Twice,
    /// 1 % of the frames come again, 20 to 200 ms later.
    Old,
    /// All frames are up to 5 ms late, in order.
    Jitter,
    /// 20 % of the frames that the gateway sends are lost.
    Deaf,
    /// Error frames with any content, 200 a second.
    ErrorFrames,
    /// The controller is bus-off for .3 s, every three seconds.
    BusOff,
    /// The queue for sending is full.
    Full,
    /// The gateway is killed, and started again after .5 s.
    Restart,
}

impl Fault {
    /// All faults, by the name that the table has for them.
    pub const ALL: &'static [(&'static str, Self)] = &[
        ("none", Self::None),
        ("off", Self::Off),
        ("stuck", Self::Stuck),
        ("garbage", Self::Garbage),
        ("wrong", Self::Wrong),
        ("bits flipped", Self::Flipped),
        ("slow", Self::Slow),
        ("delayed 20 ms", Self::Delayed),
        ("intermittent", Self::Intermittent),
        ("reboot", Self::Reboot),
        ("order", Self::Order),
        ("loss", Self::Loss),
        ("twice", Self::Twice),
        ("old frames", Self::Old),
        ("jitter", Self::Jitter),
        ("commands lost", Self::Deaf),
        ("error frames", Self::ErrorFrames),
        ("bus-off", Self::BusOff),
        ("queue full", Self::Full),
        ("gateway killed", Self::Restart),
    ];

    /// Whether values are wrong, so that no comparison with the truth is possible.
    pub(super) const fn is_of_values(self) -> bool {
        matches!(
            self,
            Self::Stuck | Self::Garbage | Self::Wrong | Self::Flipped
        )
    }

    /// How much later than measured a frame can be stamped \[s\].
    pub(super) const fn delay(self) -> f64 {
        match self {
            Self::Delayed => 0.02,
            Self::Jitter => 5e-3,
            Self::Order => 0.4e-3,
            _ => 0.0,
        }
    }

    /// Whether it concerns one device, and not its whole bus.
    pub(super) const fn is_of_device(self) -> bool {
        matches!(
            self,
            Self::Off
                | Self::Stuck
                | Self::Garbage
                | Self::Wrong
                | Self::Flipped
                | Self::Slow
                | Self::Delayed
                | Self::Intermittent
                | Self::Reboot
        )
    }
}

/// A fault and when it is present.
#[derive(Debug, Clone)]
pub(super) struct Planned {
    pub(super) fault: Fault,
    pub(super) from: Nanos,
    pub(super) until: Nanos,
    /// What the device sends on, for a fault of a device.
    pub(super) claims: Vec<Claim>,
}

impl Planned {
    fn is_in(&self, t: Nanos) -> bool {
        self.from <= t && t < self.until
    }

    fn concerns(&self, id: Id) -> bool {
        !self.fault.is_of_device() || self.claims.iter().any(|claim| claim.matches(id))
    }
}

/// The time of a bus.
#[derive(Debug, Clone)]
pub(super) struct SimulatedClock(Arc<AtomicI64>);

impl SimulatedClock {
    pub(super) fn at(t: Nanos) -> Self {
        Self(Arc::new(AtomicI64::new(t.0)))
    }

    fn reach(&self, t: Nanos) {
        self.0.fetch_max(t.0, Relaxed);
    }
}

impl Clock for SimulatedClock {
    fn now(&self) -> Nanos {
        Nanos(self.0.load(Relaxed))
    }
}

/// What has passed over a wire.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Passed {
    /// Frames of boards.
    pub(super) sent: u64,
    /// Of these, lost by a fault or because nobody listened.
    pub(super) lost: u64,
    /// Frames that were added by a fault.
    pub(super) added: u64,
    /// Frames that the gateway got.
    pub(super) delivered: u64,
}

/// A bus with its boards.
pub(super) struct Wire {
    pub(super) clock: SimulatedClock,
    boards: BusSimulator,
    /// The end of the present slice of time.
    pub(super) horizon: Nanos,
    /// In the order of time, without those that are over.
    planned: VecDeque<Planned>,
    random: Random,
    /// Frames on their way, sorted by arrival.
    under_way: VecDeque<(Nanos, Frame)>,
    /// When the bus is free for the next frame.
    free: Nanos,
    /// The last arrival of a frame that keeps its order.
    last: Nanos,
    silent_until: Nanos,
    next_silence: Nanos,
    next_error: Nanos,
    told: LinkState,
    pub(super) passed: Passed,
}

/// Duration of a frame on the bus.
const FRAME: Nanos = Nanos::from_micros(120);

impl Wire {
    pub(super) fn new(
        boards: BusSimulator,
        planned: VecDeque<Planned>,
        clock: SimulatedClock,
        random: Random,
    ) -> Self {
        let now = clock.now();
        Self {
            clock,
            boards,
            horizon: now,
            planned,
            random,
            under_way: VecDeque::new(),
            free: now,
            last: now,
            silent_until: now,
            next_silence: now,
            next_error: now,
            told: LinkState::Up,
            passed: Passed::default(),
        }
    }

    fn fault(&self, t: Nanos, id: Option<Id>) -> Fault {
        let concerned = |p: &&Planned| p.is_in(t) && id.is_none_or(|id| p.concerns(id));
        let mut begun = self.planned.iter().take_while(|p| p.from <= t);
        let present = begun.find(concerned);
        present.map_or(Fault::None, |p| p.fault)
    }

    fn state_at(&self, t: Nanos) -> LinkState {
        let is_off = |p: &Planned| {
            let since = (t - p.from).seconds();
            p.fault == Fault::BusOff && p.is_in(t) && since % 3.0 < 0.3
        };
        let mut begun = self.planned.iter().take_while(|p| p.from <= t);
        match begun.any(is_off) {
            true => LinkState::BusOff,
            false => LinkState::Up,
        }
    }

    /// Takes a frame of a board, at `t`.
    fn post(&mut self, mut frame: Frame, t: Nanos) {
        self.passed.sent += 1;
        self.free = self.free.max(t) + FRAME;
        let mut arrival = self.free;
        let mut again = None;
        let present = self.fault(t, Some(frame.id));
        let mut is_lost = false;
        let length = frame.data().len();
        let random = &mut self.random;
        let seconds = |random: &mut Random, from, to| Nanos::from_seconds(random.uniform(from, to));
        match present {
            Fault::Off => is_lost = true,
            Fault::Garbage if random.happens(0.1) => {
                let data: Vec<u8> = (0..length).map(|_| random.below(256) as u8).collect();
                frame = with_data(&frame, &data);
            }
            Fault::Wrong if length > 0 => {
                let mut data = frame.data().to_vec();
                data[length / 2] ^= 0x10;
                frame = with_data(&frame, &data);
            }
            Fault::Flipped if length > 0 && random.happens(0.01) => {
                let mut data = frame.data().to_vec();
                data[random.below(length)] ^= 1 << random.below(8);
                frame = with_data(&frame, &data);
            }
            Fault::Slow => is_lost = t.seconds() % 0.1 > 0.01,
            Fault::Delayed => arrival += Nanos::from_millis(20),
            Fault::Intermittent => {
                if t >= self.next_silence {
                    self.silent_until = t + seconds(random, 0.1, 1.0);
                    self.next_silence = self.silent_until + seconds(random, 0.5, 2.0);
                }
                is_lost = t < self.silent_until;
            }
            Fault::Order if random.happens(0.2) => {
                arrival += seconds(random, 0.0, 0.4e-3);
            }
            Fault::Loss => is_lost = random.happens(0.05),
            Fault::Twice if random.happens(0.05) => again = Some(arrival + FRAME),
            Fault::Old if random.happens(0.01) => {
                again = Some(arrival + seconds(random, 0.02, 0.2));
            }
            Fault::Jitter => {
                arrival = self.last.max(arrival + seconds(random, 0.0, 5e-3));
                self.last = arrival;
            }
            _ => {}
        }
        if is_lost || self.state_at(t) != LinkState::Up {
            self.passed.lost += 1;
            return;
        }
        if let Some(again) = again {
            self.passed.added += 1;
            self.schedule(again, frame);
        }
        self.schedule(arrival, frame);
    }

    fn schedule(&mut self, arrival: Nanos, frame: Frame) {
        let earlier = self.under_way.iter().rposition(|(t, _)| *t <= arrival);
        let place = earlier.map_or(0, |at| at + 1);
        self.under_way.insert(place, (arrival, frame));
    }

    /// Lets time pass until `t` with nobody who listens.
    pub(super) fn pass_unheard(&mut self, t: Nanos) {
        self.horizon = t;
        while self.clock.now() < t {
            if let Received::Frame(_) = self.recv(t) {
                self.passed.delivered -= 1;
                self.passed.lost += 1;
            }
        }
    }

    /// Frames that have not arrived.
    pub(super) fn under_way(&self) -> u64 {
        self.under_way.len() as u64
    }

    fn recv(&mut self, deadline: Nanos) -> Received {
        let end = deadline.min(self.horizon);
        loop {
            let now = self.clock.now();
            if self
                .planned
                .front()
                .is_some_and(|planned| planned.until < now)
            {
                self.planned.pop_front();
            }
            let state = self.state_at(now);
            if state != self.told {
                self.told = state;
                return Received::StateChanged;
            }
            while let Some(frame) = self.boards.poll(now) {
                self.post(frame, now);
            }
            if let Some((arrival, frame)) = self.under_way.front().copied()
                && arrival <= now
            {
                self.under_way.pop_front();
                self.passed.delivered += 1;
                return Received::Frame(frame.at(arrival, StampKind::Software));
            }
            if self.fault(now, None) == Fault::ErrorFrames && now >= self.next_error {
                self.next_error = now + Nanos::from_millis(5);
                let data: [u8; 8] = std::array::from_fn(|_| self.random.below(256) as u8);
                let classes = self.random.below(1 << 10) as u32;
                let mut frame = Frame::new(Id::extended(classes), &data);
                frame.format = Format::Error;
                return Received::Error(frame.at(now, StampKind::Software));
            }
            // Bus-off begins and ends without a frame.
            let mut next = now + Nanos::from_millis(1);
            next = next.min(self.boards.next_wake().unwrap_or(Nanos::MAX));
            next = next.min(self.under_way.front().map_or(Nanos::MAX, |(t, _)| *t));
            if next > end || end <= now {
                self.clock.reach(end);
                return Received::TimedOut;
            }
            self.clock.reach(next);
        }
    }

    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
        let now = self.clock.now();
        if self.state_at(now) != LinkState::Up {
            return Err(TransmitError::NotUp);
        }
        match self.fault(now, None) {
            Fault::Full => return Err(TransmitError::Full),
            Fault::Deaf if self.random.happens(0.2) => return Ok(()),
            _ => {}
        }
        self.free = self.free.max(now) + FRAME;
        self.boards
            .on_frame(&frame.at(now, StampKind::Software), now);
        Ok(())
    }
}

fn with_data(frame: &Frame, data: &[u8]) -> Frame {
    let mut other = Frame::new(frame.id, data);
    other.format = frame.format;
    other
}

/// The gateway's end of a wire, which outlives the gateway.
#[derive(Clone)]
pub(super) struct End(pub(super) Arc<Mutex<Wire>>);

impl End {
    pub(super) fn with<T>(&self, act: impl FnOnce(&mut Wire) -> T) -> T {
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Link for End {
    fn recv(&mut self, deadline: Nanos) -> Received {
        self.with(|wire| wire.recv(deadline))
    }

    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
        self.with(|wire| wire.send(frame))
    }

    fn state(&self) -> LinkState {
        self.with(|wire| wire.told)
    }

    fn counters(&self) -> LinkCounters {
        LinkCounters {
            received: self.with(|wire| wire.passed.delivered),
            ..LinkCounters::default()
        }
    }
}
