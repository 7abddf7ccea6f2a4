//! The host's side of a unit. It configures the unit if the keys say so, and combines the two
//! frames of each packet.

use super::options::OptoforceDaqOptions;
use super::protocol::{
    ANSWER, CONFIGURATION, ERRORS, OVERLOAD_FX, OptoIds, OptoSettings, PACKET, ZERO_OWN, sum,
};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::received::Received;
use crate::wrench::{self, NewZero};
use crate::{
    Claim, Device, Driver, Frame, Id, Mode, NotSent, OutputInfo, Spec, SpecError, StampedReading,
    bytes,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, StampKind, Wrench};

/// A configuration that is not answered within this time has taken effect, or was lost.
const ANSWERED: Nanos = Nanos::from_millis(100);

/// The frames of a configuration.
fn frames(id: Id, settings: OptoSettings, fill: bool) -> [Frame; 2] {
    let [a, b, c, d] = CONFIGURATION;
    let OptoSettings {
        speed,
        filter,
        zero,
    } = settings;
    let [high, low] = sum(&[a, b, c, d, speed, filter, zero]).to_be_bytes();
    let second = [low, 0, 0, 0, 0, 0, 0, 0];
    let length = if fill { 8 } else { 1 };
    [
        Frame::new(id, &[a, b, c, d, speed, filter, zero, high]),
        Frame::new(id, second.get(..length).unwrap_or(&second)),
    ]
}

/// The host's side of a unit.
#[derive(Debug)]
pub(super) struct Opto {
    ids: OptoIds,
    /// Steps per N.
    scale: [f64; 3],
    /// The first frame that waits for its second, and its stamp.
    waiting: Option<(Nanos, StampKind, [u8; 8])>,
    /// Whether a first frame was heard: the second one of an earlier packet is not missing
    /// anything.
    joined: bool,
    /// The counter of the last packet.
    last: Option<u16>,
    zero: NewZero,
}

impl Opto {
    /// Takes a frame that is not half a packet.
    fn answer(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let Some((&[a, b, c, d, error], _)) = data.split_first_chunk() else {
            return frame.fault(Counter::Length);
        };
        if data.len() != 7 {
            frame.fault(Counter::Length);
        } else if [a, b, c, d] != ANSWER
            || sum(&[a, b, c, d, error]) != bytes::u16_be(data, 5)
            || error != 0
        {
            frame.fault(Counter::Value);
        } else {
            self.zero.confirm(frame.t);
        }
    }

    /// Takes a packet with a right checksum.
    fn packet(
        &mut self,
        halves: [[u8; 8]; 2],
        first: (Nanos, StampKind),
        frame: &mut Received<'_>,
        session: &mut Session,
    ) {
        let [[_, _, _, _, c0, c1, s0, s1], [a, b, c, d, e, f, _, _]] = halves;
        let counter = u16::from_be_bytes([c0, c1]);
        let status = u16::from_be_bytes([s0, s1]);
        let mut quality = Quality::DEVICE_COUNTER;
        if let Some(last) = self.last.replace(counter) {
            match counter.wrapping_sub(last) {
                0 => quality |= Quality::FROZEN,
                1 => {}
                step => {
                    session.bringup.lost();
                    // A large step is a unit that was started again.
                    if step <= u16::MAX / 2 {
                        frame.faults(Counter::Lost, u32::from(step) - 1);
                    }
                }
            }
        }
        let mut force = self.scale;
        let counts = [[a, b], [c, d], [e, f]].map(i16::from_be_bytes);
        for (value, count) in force.iter_mut().zip(counts) {
            *value = f64::from(count) / *value;
        }
        let [x, y, z] = force;
        for (axis, value) in (0..).zip([x, y, z, 0.0, 0.0, 0.0]) {
            if status >> (OVERLOAD_FX - axis) & 1 == 1 {
                quality = wrench::overloaded(quality, axis, value);
            }
        }
        if status & ERRORS != 0 {
            quality |= Quality::DEVICE_FAULT;
        }
        quality |= self.zero.mark(frame.t);
        let torque = [f64::NAN; 3];
        let (acquired, stamp) = first;
        let stamped = StampedReading {
            acquired,
            stamp,
            device_counter: u32::from(counter),
            ..StampedReading::new(0, frame, quality, Reading::Wrench(Wrench { force, torque }))
        };
        session.add(stamped, frame);
    }
}

impl Driver for OptoforceDaqOptions {
    const NAME: &'static str = "optoforce_daq";
    const ADDRESS: Option<u32> = Some(0x100);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let ids = self.ids(spec)?;
        let settings = self.settings()?;
        let mode = match settings {
            Some(_) => spec.mode,
            None => Mode::Listen,
        };
        let mut bringup = Bringup::new(spec, mode, Timing::USUAL, ids.data);
        if let Some(settings) = settings {
            for frame in frames(ids.config, settings, self.fill) {
                bringup.start_with(frame.id, frame.data());
            }
            let stopped = OptoSettings {
                speed: 0,
                zero: ZERO_OWN,
                ..settings
            };
            for frame in frames(ids.config, stopped, self.fill) {
                bringup.stop_with(frame.id, frame.data());
            }
        }
        let this = Opto {
            ids,
            scale: self.scale()?,
            waiting: None,
            joined: false,
            last: None,
            zero: NewZero::default(),
        };
        let claims = [Claim::exclusive(ids.data)];
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for Opto {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        if frame.id != self.ids.data {
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        let Ok(half) = <[u8; 8]>::try_from(data) else {
            return self.answer(data, frame);
        };
        let waiting = self.waiting.take();
        if let Some((t, stamp, first)) = waiting {
            let before = sum(&first).wrapping_add(sum(half.get(..6).unwrap_or(&half)));
            if before == bytes::u16_be(&half, 6) {
                return self.packet([first, half], (t, stamp), frame, session);
            }
        }
        let begins = half.starts_with(&PACKET);
        if begins {
            self.waiting = Some((frame.t, frame.stamp, half));
        }
        match (waiting, begins) {
            // The second frame is missing.
            (Some(_), true) => frame.fault(Counter::Unpaired),
            // The checksum is wrong.
            (Some(_), false) => frame.fault(Counter::Value),
            // The first frame is missing.
            (None, false) if self.joined => frame.fault(Counter::Unpaired),
            (None, _) => {
                self.joined |= begins;
                return;
            }
        }
        session.bringup.lost();
    }

    fn reset(&mut self) {
        self.waiting = None;
        self.joined = false;
        self.last = None;
    }

    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        if let Ok(t) = outcome
            && frame.id == self.ids.config
        {
            self.zero.expect(t + ANSWERED);
        }
    }
}
