//! Finds readings that repeat the previous one: the recorder wrote an old value, or the sensor is
//! slower than its recording.

use proprio_topics::{Nanos, Reading};

/// Finds readings that repeat the previous one, as they are read.
#[derive(Debug, Clone)]
pub(crate) struct RepeatedReadings {
    pub(crate) channels: Vec<ChannelRepeats>,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct ChannelRepeats {
    first: Option<ReadingBits>,
    last: Option<ReadingBits>,
    pub(crate) readings: usize,
    /// Repeats with a later stamp, of channels whose noise makes a repeat impossible.
    pub(crate) later: Vec<Nanos>,
    /// Repeats with the same stamp.
    pub(crate) same_stamp: Vec<Nanos>,
}

/// A reading, for comparison.
#[derive(Debug, Clone, Copy)]
struct ReadingBits {
    t: Nanos,
    bits: [u64; 9],
    /// Whether the noise of the quantity makes a repeat impossible.
    is_noisy: bool,
}

impl ChannelRepeats {
    /// Compares a reading with the last one.
    fn compare(&mut self, snapshot: ReadingBits) {
        if let Some(last) = self.last
            && last.bits == snapshot.bits
        {
            if last.t == snapshot.t {
                self.same_stamp.push(snapshot.t);
            } else if snapshot.is_noisy {
                self.later.push(snapshot.t);
            }
        }
    }
}

impl RepeatedReadings {
    pub(crate) fn new(channels: usize) -> Self {
        Self {
            channels: vec![ChannelRepeats::default(); channels],
        }
    }

    pub(crate) fn see(&mut self, channel: usize, t: Nanos, reading: &Reading) {
        let Some(repeat) = self.channels.get_mut(channel) else {
            return;
        };
        let mut numbers = [0.0; 9];
        // A position alone may repeat, since encoders are coarse.
        let is_noisy = match reading {
            Reading::Joint(j) => {
                numbers[..4].copy_from_slice(&[j.position, j.velocity, j.acceleration, j.torque]);
                !j.velocity.is_nan() || !j.torque.is_nan()
            }
            Reading::Wrench(w) => {
                numbers[..3].copy_from_slice(&w.force);
                numbers[3..6].copy_from_slice(&w.torque);
                true
            }
            Reading::Imu(i) => {
                numbers[..3].copy_from_slice(&i.proper_acceleration);
                numbers[3..6].copy_from_slice(&i.angular_velocity);
                numbers[6..].copy_from_slice(&i.angular_acceleration);
                true
            }
            _ => return,
        };
        let snapshot = ReadingBits {
            t,
            bits: numbers.map(f64::to_bits),
            is_noisy,
        };
        repeat.readings += 1;
        repeat.compare(snapshot);
        repeat.first.get_or_insert(snapshot);
        repeat.last = Some(snapshot);
    }

    /// Appends the repeats that follow these.
    pub(crate) fn append(&mut self, next: Self) {
        for (own, mut next) in self.channels.iter_mut().zip(next.channels) {
            if let Some(first) = next.first {
                own.compare(first);
            }
            own.readings += next.readings;
            own.later.append(&mut next.later);
            own.same_stamp.append(&mut next.same_stamp);
            own.first = own.first.or(next.first);
            own.last = next.last.or(own.last);
        }
    }
}
