//! Finds readings that repeat the previous one: the recorder wrote an old value, or the sensor is
//! slower than its recording.

use proprio_topics::{Nanos, Reading};

/// Finds readings of a channel that repeat the previous one, as they are read.
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

    pub(crate) fn see(&mut self, t: Nanos, reading: &Reading) {
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
        self.readings += 1;
        self.compare(snapshot);
        self.first.get_or_insert(snapshot);
        self.last = Some(snapshot);
    }

    /// Appends the repeats that follow these.
    pub(crate) fn append(&mut self, mut next: Self) {
        if let Some(first) = next.first {
            self.compare(first);
        }
        self.readings += next.readings;
        self.later.append(&mut next.later);
        self.same_stamp.append(&mut next.same_stamp);
        self.first = self.first.or(next.first);
        self.last = next.last.or(self.last);
    }
}
