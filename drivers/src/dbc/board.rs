//! The device's own side: sends its readings in the frames that the file describes, from power-on.

use super::layout::{DbcLayout, SignalGroup, SignalRole, implies, shared};
use super::options::DbcOptions;
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, keys};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Nanos, Quality, Reading};

/// A simulated device that a .dbc file describes. Signals that the keys do not name are zero.
#[derive(Debug)]
struct DbcBoard {
    layout: DbcLayout,
    period: Nanos,
    frames: Vec<Pending>,
    /// The messages of each reading, in the order that they are sent in.
    orders: Vec<Vec<usize>>,
    /// The number of readings encoded so far, per reading.
    counts: Vec<u64>,
}

/// A frame on its way: the parts of one message that are sent together.
#[derive(Debug)]
struct Pending {
    message: usize,
    parts: Vec<SignalGroup>,
    data: [u8; 64],
    /// The parts whose values are new, one bit each.
    fresh: u128,
}

impl Simulate for DbcOptions {
    /// A device after power-on.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        let layout = DbcLayout::new(spec, self)?;
        let period = keys::duration("period_ms", self.period_ms.unwrap_or(10))?;
        let mut frames: Vec<Pending> = Vec::new();
        for (message, layout) in layout.messages.iter().enumerate() {
            for conditions in shared(layout.parts.iter().map(|part| &part.conditions)) {
                let mut data = [0; 64];
                for condition in &conditions {
                    let raw = condition.ranges.first().map_or(0, |range| range.0);
                    condition.bits.set(raw, &mut data);
                }
                let has = |part: &&SignalGroup| implies(&conditions, &part.conditions);
                frames.push(Pending {
                    message,
                    parts: layout.parts.iter().filter(has).cloned().collect(),
                    data,
                    fresh: 0,
                });
            }
        }
        let readings = 0..layout.readings.len();
        Ok(Box::new(DbcBoard {
            orders: readings
                .clone()
                .map(|reading| layout.order(reading))
                .collect(),
            counts: readings.map(|_| 0).collect(),
            layout,
            period,
            frames,
        }))
    }
}

impl Board for DbcBoard {
    fn period(&self) -> Option<Nanos> {
        Some(self.period)
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let number = usize::from(output);
        let Some(layout) = self.layout.readings.get(number) else {
            return Err(EncodeError::Output(output));
        };
        if reading.kind() != layout.kind {
            return Err(EncodeError::Kind);
        }
        let values = reading.values();
        let needed = |index: usize| layout.needed & 1 << index != 0;
        if values
            .iter()
            .enumerate()
            .any(|(index, value)| needed(index) && !value.is_finite())
        {
            return Err(EncodeError::NotFinite);
        }
        let count = self.counts.get_mut(number).map_or(0, |count| {
            *count = count.wrapping_add(1);
            *count
        });
        for message in self.orders.get(number).into_iter().flatten() {
            let Some(layout) = self.layout.messages.get(*message) else {
                continue;
            };
            for pending in self
                .frames
                .iter_mut()
                .filter(|frame| frame.message == *message)
            {
                let all = pending
                    .parts
                    .iter()
                    .map(|_| 1)
                    .fold(0, |all, bit| all << 1 | bit);
                for (place, part) in pending.parts.iter().enumerate() {
                    if part.reading != number {
                        continue;
                    }
                    pending.fresh |= 1 << place;
                    for field in &part.fields {
                        let length = field.bits.length();
                        let raw = match field.role {
                            SignalRole::Counter => count,
                            SignalRole::Fault => u64::from(quality.contains(Quality::DEVICE_FAULT)),
                            SignalRole::Value {
                                index,
                                gain,
                                offset,
                                ..
                            } => {
                                let value = values.get(index).copied().unwrap_or(0.0);
                                field.raw.bits((value - offset) / gain, length)
                            }
                        };
                        field.bits.set(raw, &mut pending.data);
                    }
                }
                if pending.fresh == all {
                    pending.fresh = 0;
                    let data = pending.data.get(..layout.size).unwrap_or_default();
                    let frame = Frame::with_format(layout.frames.id, layout.format(), data);
                    let _ = frame.map(|frame| out.try_push(frame));
                }
            }
        }
        Ok(())
    }
}
