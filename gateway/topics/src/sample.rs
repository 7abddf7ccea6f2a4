//! A reading with its channel number, time stamp, quality and sequence number.

use crate::code::coded;
use crate::reading::VALUES;
use crate::{Code, Kind, Nanos, Reading};
use core::fmt;
use core::ops::{BitOr, BitOrAssign};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

coded! {
    /// Source of an acquisition stamp, from worst to best.
    #[derive(Default, PartialOrd, Ord)]
    pub enum StampKind {
        /// No stamp (a log without time stamps): only the order is known.
        #[default]
        None = 0 => "none",
        /// Read from the clock by the receiving program, after reception.
        User = 1 => "user",
        /// As recorded in a log.
        Log = 2 => "log",
        /// The kernel's receive stamp.
        Software = 3 => "software",
        /// The CAN adapter's receive stamp, converted to CLOCK_MONOTONIC.
        Hardware = 4 => "hardware",
    }
}

/// Saturation of one axis of a six-axis sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Saturation {
    /// Within its range.
    None,
    /// At the lower end of its range.
    Low,
    /// At the upper end of its range.
    High,
}

/// Quality flags of a sample; the empty set means that no problem is known.
#[repr(C)]
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, ZeroCopySend, FromBytes)]
pub struct Quality(pub u32);

impl Quality {
    /// No flag is set.
    pub const GOOD: Self = Self(0);
    /// At least one reading was lost between this one and the one before.
    pub const GAP_BEFORE: Self = Self(1);
    /// At least one channel of the sensor is at an end of its range; see [`Quality::saturation`].
    pub const SATURATED: Self = Self(1 << 1);
    /// The device repeats its last value instead of measuring: it says so (iCub strain boards while
    /// saturated), or values repeat themselves that were too noisy before to do so by chance.
    pub const FROZEN: Self = Self(1 << 2);
    /// The device reports a fault that makes this reading doubtful.
    pub const DEVICE_FAULT: Self = Self(1 << 3);
    /// The device reports that it is not calibrated.
    pub const NOT_CALIBRATED: Self = Self(1 << 4);
    /// `Header::device_counter` is valid: it is the device's own sequence number.
    pub const DEVICE_COUNTER: Self = Self(1 << 5);
    /// The joint's drive reports a fault (emergency stop, over-current, ...) that does not concern
    /// its encoder: the position is good.
    pub const DRIVE_FAULT: Self = Self(1 << 6);

    /// The zero of the channel may have changed between this reading and the one before (a tare, a
    /// joint's new offset): no motion or load lies between them.
    pub const ZERO_CHANGED: Self = Self(1 << 7);

    /// The value is far from where those before it lead, and no later one has confirmed it yet; or
    /// the encoder has jumped further than its joint can move ([`crate::sanity`]). The estimator
    /// finds it.
    pub const IMPLAUSIBLE: Self = Self(1 << 8);

    /// The flags that make an encoder's position unusable.
    pub const UNTRUSTED_ENCODER: Self = Self(Self::DEVICE_FAULT.0 | Self::NOT_CALIBRATED.0);

    const NAMED: [(Self, &'static str); 9] = [
        (Self::GAP_BEFORE, "gap_before"),
        (Self::SATURATED, "saturated"),
        (Self::FROZEN, "frozen"),
        (Self::DEVICE_FAULT, "device_fault"),
        (Self::NOT_CALIBRATED, "not_calibrated"),
        (Self::DEVICE_COUNTER, "device_counter"),
        (Self::DRIVE_FAULT, "drive_fault"),
        (Self::ZERO_CHANGED, "zero_changed"),
        (Self::IMPLAUSIBLE, "implausible"),
    ];
    const SATURATION_SHIFT: u32 = 16;

    /// Whether all bits of `other` are set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Whether any bit of `other` is set.
    #[must_use]
    pub const fn intersects(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }

    /// This set with the saturation of axis `axis` (0 to 5: fx fy fz tx ty tz) set; sets SATURATED
    /// too.
    #[must_use]
    pub const fn with_saturation(self, axis: u32, saturation: Saturation) -> Self {
        let code = match saturation {
            Saturation::None => return self,
            Saturation::Low => 1,
            Saturation::High => 2,
        };
        if axis > 5 {
            return self;
        }
        Self(self.0 | Self::SATURATED.0 | code << (Self::SATURATION_SHIFT + 2 * axis))
    }

    /// The saturation of axis `axis` (0 to 5: fx fy fz tx ty tz).
    #[must_use]
    pub const fn saturation(self, axis: u32) -> Saturation {
        if axis > 5 {
            return Saturation::None;
        }
        match self.0 >> (Self::SATURATION_SHIFT + 2 * axis) & 3 {
            1 => Saturation::Low,
            2 => Saturation::High,
            _ => Saturation::None,
        }
    }
}

impl BitOr for Quality {
    type Output = Self;
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl BitOrAssign for Quality {
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

impl fmt::Debug for Quality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Quality({self})")
    }
}

impl fmt::Display for Quality {
    /// The names of the set flags joined by `|`, or `good`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut first = true;
        for (bit, name) in Self::NAMED {
            if self.contains(bit) {
                f.write_str(if first { "" } else { "|" })?;
                f.write_str(name)?;
                first = false;
            }
        }
        if first { f.write_str("good") } else { Ok(()) }
    }
}

/// Time stamps and sequence number; the same in every published payload.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend, FromBytes)]
pub struct Header {
    /// Changes at each start of the publisher; `sequence` then starts again at 0.
    pub epoch: u64,
    /// Counts this publisher's payloads on this service, from 0. A gap is a loss between publisher
    /// and reader.
    pub sequence: u64,
    /// Receive time of the first CAN frame of this reading \[ns\]. For coupled joints, that of the
    /// motors' newest reading. For an estimate, the instant that it refers to.
    pub acquired: Nanos,
    /// Time just before sending \[ns\].
    pub published: Nanos,
    /// The device's own time of this reading \[ns\], in the device's clock; [`Nanos::MIN`] if it
    /// reports none.
    pub device_time: Nanos,
    /// The device's own sequence number if it has one (then `quality` has DEVICE_COUNTER), else 0.
    pub device_counter: u32,
    /// Quality flags of this sample.
    pub quality: Quality,
    /// The source of `acquired`.
    pub stamp: Code<StampKind>,
    /// Number of the bus in the gateway's configuration, from 0.
    pub bus: u32,
}

impl Default for Header {
    /// Zero, without a device's time.
    fn default() -> Self {
        Self {
            epoch: 0,
            sequence: 0,
            acquired: Nanos::ZERO,
            published: Nanos::ZERO,
            device_time: Nanos::MIN,
            device_counter: 0,
            quality: Quality::GOOD,
            stamp: StampKind::None.in_memory(),
            bus: 0,
        }
    }
}

/// One reading of one channel: the payload of `<robot>/samples`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/Sample/2")]
pub struct Sample {
    /// Time stamps, sequence number, quality.
    pub header: Header,
    /// The channel's number; `<robot>/description` holds its name and kind.
    pub channel: u32,
    /// The kind of the reading.
    pub kind: Code<Kind>,
    /// The reading's values in SI units, in the order of [`Kind::fields`]: NaN if not reported,
    /// zero beyond them.
    pub values: [f64; VALUES],
}

impl Sample {
    /// `reading` of channel `channel`.
    #[must_use]
    pub fn new(header: Header, channel: u32, reading: &Reading) -> Self {
        Self {
            header,
            channel,
            kind: reading.kind().in_memory(),
            values: reading.values(),
        }
    }

    /// The reading. A sample out of a [`Reader`](crate::ipc::Reader) has one; in other memory the
    /// kind may be unknown, or a value out of its range.
    #[must_use]
    pub fn reading(&self) -> Option<Reading> {
        Reading::from_values(self.kind.get()?, &self.values)
    }
}

// Readers in other languages depend on these byte offsets.
const _: () = {
    use core::mem::offset_of;
    assert!(size_of::<Header>() == 56 && offset_of!(Header, bus) == 52);
    assert!(size_of::<Sample>() == 192 && offset_of!(Sample, values) == 64);
};

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;

    #[test]
    fn a_header_without_a_device_time_says_so() {
        assert_eq!(Header::default().device_time, Nanos::MIN);
    }

    #[test]
    fn saturation_is_kept_per_axis() {
        let q = Quality::FROZEN
            .with_saturation(0, Saturation::Low)
            .with_saturation(5, Saturation::High);
        assert_eq!(q.saturation(0), Saturation::Low);
        assert_eq!(q.saturation(5), Saturation::High);
        assert_eq!(q.saturation(1), Saturation::None);
        assert_eq!(q.to_string(), "saturated|frozen");
        assert_eq!(Quality::GOOD.to_string(), "good");
        assert_eq!(
            Quality::GOOD.with_saturation(6, Saturation::High),
            Quality::GOOD
        );
    }
}
