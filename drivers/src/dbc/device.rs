//! The host's side: collects the values of each reading out of the frames, and watches that they
//! come.

use super::layout::{DbcLayout, ReadingLayout, SignalGroup, SignalRole, UsedSignal};
use super::options::{DbcOptions, ReadingKeys};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::pairing::within;
use crate::received::Received;
use crate::signal::Message;
use crate::{Claim, Device, Driver, Format, Id, Mode, OutputInfo, Spec, SpecError, StampedReading};
use alloc::borrow::Cow;
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::reading::VALUES;
use proprio_topics::{
    Actuator, Counter, Imu, JointState, Kind, Nanos, Quality, Reading, Skin, StampKind,
};

/// The host's side of a device that a .dbc file describes.
#[derive(Debug)]
pub(super) struct DbcDevice {
    layout: DbcLayout,
    readings: Vec<Assembly>,
}

/// A reading on its way.
#[derive(Debug)]
struct Assembly {
    layout: ReadingLayout,
    /// Without a value: not a number, or zero where the value is a number of things.
    absent: [f64; VALUES],
    values: [f64; VALUES],
    /// The values that have come.
    have: u16,
    t: Nanos,
    stamp: StampKind,
    /// Its sender, where several may send the same message.
    sender: Option<u8>,
    /// A frame came again before the others: the next reading may be a mixture.
    suspect: bool,
    /// No reading was opened yet: a frame before it belongs to one that was not heard from its
    /// beginning.
    joined: bool,
    gap: bool,
    /// The held values: until when they are used.
    held: [Option<(Nanos, f64)>; VALUES],
    fault: bool,
    /// The count of this reading, and of the last.
    count: Option<u64>,
    last_count: Option<u64>,
    /// The largest count.
    most: u64,
}

/// The values of a frame that belong to one reading.
#[derive(Default)]
struct FrameValues {
    values: [f64; VALUES],
    /// Those that have come, one bit each.
    come: u16,
    /// Those that ride along.
    along: u16,
}

impl Assembly {
    fn new(layout: &ReadingLayout, most: u64) -> Self {
        let absent = match layout.kind {
            Kind::Joint => Reading::Joint(JointState::ABSENT).values(),
            Kind::Imu => Reading::Imu(Imu::ABSENT).values(),
            Kind::Actuator => Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode: 0,
                encoder: 0,
                faults: 0,
            })
            .values(),
            Kind::Skin => Reading::Skin(Skin {
                triangle: 0,
                taxels: [f64::NAN; 12],
            })
            .values(),
            Kind::Wrench | Kind::Gauges | Kind::Temperature => [f64::NAN; VALUES],
        };
        Self {
            layout: layout.clone(),
            absent,
            values: absent,
            have: 0,
            t: Nanos::ZERO,
            stamp: StampKind::None,
            sender: None,
            suspect: false,
            joined: true,
            gap: false,
            held: [None; VALUES],
            fault: false,
            count: None,
            last_count: None,
            most,
        }
    }

    /// Takes the values of a frame. True if the reading is complete.
    fn take(&mut self, part: &SignalGroup, sender: Option<u8>, frame: &mut Received<'_>) -> bool {
        let begun = (self.t, self.stamp);
        let in_time = within(begun, frame, self.layout.limit);
        if self.have != 0 && in_time && sender.zip(self.sender).is_some_and(|(a, b)| a != b) {
            // Of another device that sends the same message.
            frame.fault(Counter::Unexpected);
            return false;
        }
        let Some(FrameValues {
            values,
            come,
            along,
        }) = self.values_of(part, frame)
        else {
            return false;
        };
        let again = self.have & come != 0;
        if self.have != 0 && (again || !in_time) {
            self.drop_one(frame);
            self.suspect = again;
        }
        if self.have == 0 {
            if come & self.layout.opening == 0 {
                // Its first frame was lost, or it is the late rest of a reading that was dropped.
                self.suspect = false;
                if !self.joined {
                    self.drop_one(frame);
                }
                return false;
            }
            self.joined = false;
            (self.t, self.stamp, self.sender) = (frame.t, frame.stamp, sender);
        }
        for (index, (place, value)) in self.values.iter_mut().zip(values).enumerate() {
            if (come | along) & 1 << index != 0 {
                *place = value;
            }
        }
        self.have |= come;
        if self.have != self.layout.needed {
            return false;
        }
        if core::mem::take(&mut self.suspect) {
            self.drop_one(frame);
            return false;
        }
        self.have = 0;
        true
    }

    /// Takes counter, fault and held values of a frame, and returns its other values; `None`: it
    /// has none, or one that is no number.
    fn values_of(&mut self, part: &SignalGroup, frame: &mut Received<'_>) -> Option<FrameValues> {
        let mut found = FrameValues::default();
        for field in &part.fields {
            let UsedSignal { bits, raw, .. } = *field;
            let Some(code) = bits.of(frame.data()) else {
                continue;
            };
            let is_none = field.is_none(code);
            match field.role {
                SignalRole::Counter => self.count = Some(code),
                SignalRole::Fault => self.fault = code != 0 && !is_none,
                SignalRole::Value {
                    index,
                    gain,
                    offset,
                    hold,
                    rides,
                } => {
                    let number = gain * raw.number(code, bits.length()) + offset;
                    let absent = self.absent.get(index).copied();
                    let value = absent.filter(|_| is_none).unwrap_or(number);
                    if !value.is_finite() && !is_none {
                        frame.fault(Counter::Value);
                        hold?;
                    } else if let Some(hold) = hold {
                        if let Some(held) = self.held.get_mut(index) {
                            *held = Some((frame.t + hold, value));
                        }
                    } else if let Some(place) = found.values.get_mut(index) {
                        *place = value;
                        *(if rides {
                            &mut found.along
                        } else {
                            &mut found.come
                        }) |= 1 << index;
                    }
                }
            }
        }
        (found.come != 0).then_some(found)
    }

    fn drop_one(&mut self, frame: &mut Received<'_>) {
        self.have = 0;
        self.gap = true;
        frame.fault(Counter::Unpaired);
    }

    /// The complete reading; `after_silence` says whether the device was silent before it. `None`
    /// if it has come before, or its values mean nothing.
    fn finish(
        &mut self,
        number: u8,
        after_silence: bool,
        frame: &mut Received<'_>,
    ) -> Option<StampedReading> {
        let mut quality = Quality::GOOD;
        if self.fault {
            quality |= Quality::DEVICE_FAULT;
            frame.fault(Counter::DeviceFault);
        }
        let mut values = self.values;
        for (held, (value, absent)) in self.held.iter().zip(values.iter_mut().zip(self.absent)) {
            if let Some((until, last)) = held {
                *value = if frame.t <= *until { *last } else { absent };
            }
        }
        if let Some(count) = self.count {
            quality |= Quality::DEVICE_COUNTER;
            if let Some(last) = self.last_count.replace(count).filter(|_| !after_silence) {
                if count == last {
                    frame.fault(Counter::Unexpected);
                    return None;
                }
                let lost = count.wrapping_sub(last).wrapping_sub(1) & self.most;
                if lost > 0 {
                    self.gap = true;
                    let lost = u32::try_from(lost).unwrap_or(u32::MAX);
                    frame.faults(Counter::Lost, lost);
                }
            }
        }
        if core::mem::take(&mut self.gap) | after_silence {
            quality |= Quality::GAP_BEFORE;
        }
        let none = |index: usize| values.get(index).is_some_and(|value| value.is_nan());
        let mut needed = (0..VALUES).filter(|index| self.layout.needed & 1 << index != 0);
        let means_nothing = match self.layout.kind {
            Kind::Wrench | Kind::Gauges => (0..6).any(none),
            _ => needed.all(none),
        };
        let reading = Reading::from_values(self.layout.kind, &values);
        let Some(reading) = reading.filter(|_| !means_nothing) else {
            frame.fault(Counter::Value);
            return None;
        };
        #[allow(clippy::cast_possible_truncation)] // the number of such a device's readings
        let device_counter = self.count.unwrap_or(0) as u32;
        Some(StampedReading {
            acquired: self.t,
            stamp: self.stamp,
            device_counter,
            ..StampedReading::new(number, frame, quality, reading)
        })
    }
}

impl Driver for DbcOptions {
    const NAME: &'static str = "dbc";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        let info = |(number, reading): (u8, &ReadingKeys)| OutputInfo {
            number,
            kind: reading.kind,
            suffix: Cow::Owned(reading.name.clone()),
        };
        (0..).zip(&self.reading).map(info).collect()
    }

    fn states_period(&self) -> bool {
        self.period_ms.is_some()
    }

    fn description(&self) -> Option<&str> {
        Some(&self.file)
    }

    fn describe(&mut self, messages: Vec<Message>) {
        self.messages = messages;
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let layout = DbcLayout::new(spec, self)?;
        let claims: Vec<Claim> = layout.messages.iter().map(|m| m.frames).collect();
        let watched = (layout.order(0).first())
            .and_then(|number| layout.messages.get(*number))
            .map_or(Id::standard(0), |message| message.frames.id);
        let readings = layout.readings.iter().enumerate();
        let readings = readings.map(|(number, reading)| {
            let parts = layout.messages.iter().flat_map(|message| &message.parts);
            let fields = parts
                .filter(|part| part.reading == number)
                .flat_map(|part| &part.fields);
            let counter = fields.filter(|field| field.role == SignalRole::Counter);
            let most = counter
                .map(|field| u64::MAX >> (64 - field.bits.length()))
                .max();
            Assembly::new(reading, most.unwrap_or(0))
        });
        let bringup = Bringup::new(spec, Mode::Listen, Timing::LISTENED, watched);
        let this = DbcDevice {
            readings: readings.collect(),
            layout,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for DbcDevice {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        // Who asks for a frame of the device says nothing of it.
        if matches!(frame.format, Format::Error | Format::Remote) {
            return;
        }
        let (id, data) = (frame.id, frame.data());
        let messages = self.layout.messages.iter();
        let messages = messages.filter(|message| message.frames.matches(id));
        let mut is_short = false;
        let parts = messages.flat_map(|message| {
            let sender = message.sender(id);
            message.parts.iter().map(move |part| (part, sender))
        });
        for (part, sender) in parts {
            let Some(assembly) = self.readings.get_mut(part.reading) else {
                continue;
            };
            if data.len() < part.reach {
                is_short = true;
                continue;
            }
            let has = part
                .conditions
                .iter()
                .all(|condition| condition.holds(data));
            if !has || !assembly.take(part, sender, frame) {
                continue;
            }
            let after_silence = session.bringup.reading(frame.t);
            let number = u8::try_from(part.reading).unwrap_or(u8::MAX);
            if let Some(stamped) = assembly.finish(number, after_silence, frame) {
                frame.push(stamped);
            }
        }
        if is_short {
            frame.fault(Counter::Length);
        }
    }

    fn reset(&mut self) {
        for assembly in &mut self.readings {
            let fresh = Assembly::new(&assembly.layout, assembly.most);
            let seen = !core::mem::replace(assembly, fresh).joined;
            assembly.gap = seen;
        }
    }
}
