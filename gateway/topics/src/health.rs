//! How gateway and estimator are doing: the payloads of `<robot>/health/gateway` and `<robot>/health/estimator`.

use core::fmt;

use crate::{Header, MAX_BUSES, MAX_CHANNELS, Name, Nanos};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// What a device's frames are counted by.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
pub enum Counter {
    /// Frames with one of the device's identifiers.
    Frames = 0,
    /// Readings published.
    Readings = 1,
    /// Frames of a length that the protocol does not have.
    Length = 2,
    /// Frames with a value that the protocol does not have.
    Value = 3,
    /// Halves of a reading whose other half did not come.
    Unpaired = 4,
    /// Readings that the device's own sequence number says were lost.
    Lost = 5,
    /// Replies that were not asked for.
    Unexpected = 6,
    /// Configuration replies that contradict what was known: the device changed under us.
    Changed = 7,
    /// Readings with a saturated channel.
    Saturated = 8,
    /// Readings with a fault of the device.
    DeviceFault = 9,
    /// Times that the device was silent for longer than it may.
    Silences = 10,
    /// Times that its start sequence was begun.
    Starts = 11,
    /// Readings dropped because their stamp was not later than the last one's.
    Backward = 12,
}

impl Counter {
    /// All of them, in order.
    pub const ALL: [Self; 13] = [
        Self::Frames,
        Self::Readings,
        Self::Length,
        Self::Value,
        Self::Unpaired,
        Self::Lost,
        Self::Unexpected,
        Self::Changed,
        Self::Saturated,
        Self::DeviceFault,
        Self::Silences,
        Self::Starts,
        Self::Backward,
    ];

    /// The word for it in tables and logs.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Frames => "frames",
            Self::Readings => "readings",
            Self::Length => "bad_length",
            Self::Value => "bad_value",
            Self::Unpaired => "unpaired",
            Self::Lost => "lost",
            Self::Unexpected => "unexpected",
            Self::Changed => "changed",
            Self::Saturated => "saturated",
            Self::DeviceFault => "device_fault",
            Self::Silences => "silences",
            Self::Starts => "starts",
            Self::Backward => "backward_stamp",
        }
    }
}

/// The state of a link to a bus.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, ZeroCopySend)]
pub enum LinkState {
    /// Frames can come and go.
    #[default]
    Up = 0,
    /// The interface is there, but down.
    Down = 1,
    /// The interface is not there.
    Gone = 2,
    /// The controller is off the bus after too many errors.
    BusOff = 3,
    /// The log that is replayed has come to its end.
    Ended = 4,
}

impl LinkState {
    /// The word for it in tables and logs.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Up => "up",
            Self::Down => "down",
            Self::Gone => "gone",
            Self::BusOff => "bus_off",
            Self::Ended => "ended",
        }
    }
}

/// One bus.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct BusHealth {
    /// Its name in the configuration.
    pub name: Name,
    /// Frames received that passed the filters.
    pub frames: u64,
    /// Of these, frames that no device claims.
    pub unclaimed: u64,
    /// Frames that the kernel dropped because we did not read in time.
    pub dropped: u64,
    /// Error frames received.
    pub error_frames: u64,
    /// Frames sent.
    pub sent: u64,
    /// Frames that could not be sent before their deadline.
    pub send_failures: u64,
    /// Times that the link was lost (down, gone, bus-off).
    pub link_losses: u64,
    /// Samples published.
    pub published: u64,
    /// Samples that could not be published.
    pub publish_failures: u64,
    /// Reader connections made inside a publication.
    pub connections: u64,
    /// Stamp of the last frame \[ns\]; [`Nanos::MIN`] before the first.
    pub last_frame: Nanos,
    /// The last turn of the bus thread's loop \[ns\].
    pub last_turn: Nanos,
    /// The link's state.
    pub link: LinkState,
    /// Unused, zero.
    pub reserved: u32,
}

/// One device.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct DeviceHealth {
    /// Its name in the configuration.
    pub name: Name,
    /// Counts by reason; index by `Counter as usize`.
    pub counters: [u64; Counter::ALL.len()],
    /// Its state: see `proprio_drivers::State`; 0 waiting, 1 asking, 2 starting, 3 streaming, 4 silent, 5 refused, 6 stopped.
    pub state: u32,
    /// Why it was refused: see `proprio_drivers::Refusal`; 0 if it was not.
    pub refusal: u32,
    /// The number of its bus.
    pub bus: u32,
    /// Unused, zero.
    pub reserved: u32,
}

/// How the gateway is doing, ten times a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("proprio/GatewayHealth/1")]
pub struct GatewayHealth {
    /// When.
    pub header: Header,
    /// When the gateway started \[ns\].
    pub started: Nanos,
    /// How many of `buses` are set.
    pub bus_count: u32,
    /// How many of `devices` are set.
    pub device_count: u32,
    /// The buses.
    pub buses: [BusHealth; MAX_BUSES],
    /// The devices.
    pub devices: [DeviceHealth; MAX_CHANNELS],
}

impl GatewayHealth {
    /// The buses that are set.
    #[must_use]
    pub fn buses(&self) -> &[BusHealth] {
        self.buses.get(..self.bus_count as usize).unwrap_or(&self.buses)
    }

    /// The devices that are set.
    #[must_use]
    pub fn devices(&self) -> &[DeviceHealth] {
        self.devices.get(..self.device_count as usize).unwrap_or(&self.devices)
    }
}

/// What on-line identification has used and left out, and why, since the estimator started.
///
/// Counted are the instants of each group of links and sensors that is identified by itself: of two groups, one may pause while the other learns. There are at most
/// `identification.rate_hz` instants a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend)]
pub struct IdentificationHealth {
    /// How many groups there are; 0 if nothing is identified.
    pub groups: u32,
    /// How many of them learn nothing at present.
    pub paused: u32,
    /// Learnt from.
    pub learnt: u64,
    /// Of these, instants at which nothing moved, which teach little.
    pub still: u64,
    /// Left out: a contact was declared.
    pub contact: u64,
    /// Left out: readings did not fit what is known, but for no longer than an instant or a few.
    pub outlier: u64,
    /// Left out: readings did not fit what is known for longer: a contact that nobody declared, or a change.
    pub suspected: u64,
    /// Left out: a channel was silent.
    pub stale: u64,
    /// Left out: a sensor was saturated.
    pub saturated: u64,
    /// Left out: a device reported a fault.
    pub device_fault: u64,
    /// Left out: a channel was not seen yet, had too few samples, or nothing was known of how the base moves.
    pub unseen: u64,
    /// F/T offsets that have jumped and are learnt anew.
    pub offset_changes: u64,
    /// Loads taken up or put down.
    pub load_changes: u64,
    /// Changes that could not be explained, after which all is learnt anew.
    pub unknown_changes: u64,
    /// Solutions that came later than they should have.
    pub late: u64,
    /// Solutions that could not be found.
    pub failed: u64,
}

impl IdentificationHealth {
    /// Every count, with the word for it in tables and logs.
    #[must_use]
    pub const fn counts(&self) -> [(&'static str, u64); 14] {
        [
            ("learnt", self.learnt),
            ("still", self.still),
            ("contact", self.contact),
            ("outlier", self.outlier),
            ("suspected", self.suspected),
            ("stale", self.stale),
            ("saturated", self.saturated),
            ("device_fault", self.device_fault),
            ("unseen", self.unseen),
            ("offset_changes", self.offset_changes),
            ("load_changes", self.load_changes),
            ("unknown_changes", self.unknown_changes),
            ("late", self.late),
            ("failed", self.failed),
        ]
    }
}

impl fmt::Display for IdentificationHealth {
    /// The counts that are not zero.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut gap = "";
        for (word, count) in self.counts().into_iter().filter(|(_, count)| *count > 0) {
            write!(f, "{gap}{word} {count}")?;
            gap = ", ";
        }
        Ok(())
    }
}

/// How the estimator is doing, ten times a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("proprio/EstimatorHealth/2")]
pub struct EstimatorHealth {
    /// When.
    pub header: Header,
    /// When the estimator started \[ns\].
    pub started: Nanos,
    /// Samples received.
    pub samples: u64,
    /// Samples that sequence gaps say were lost between gateway and estimator.
    pub lost: u64,
    /// Times that a new epoch of the gateway was seen (its restarts).
    pub epochs: u64,
    /// Samples of channels that the configuration does not name.
    pub unknown_channel: u64,
    /// Samples dropped because they came after their instant had been estimated.
    pub late: u64,
    /// Samples dropped because their stamp was not later than their channel's last.
    pub backward: u64,
    /// Samples dropped because they hold a number that is not finite.
    pub not_finite: u64,
    /// Estimates published.
    pub estimates: u64,
    /// Estimates in which at least one joint was withheld.
    pub withheld: u64,
    /// Estimates that could not be published.
    pub publish_failures: u64,
    /// The last turn of the loop \[ns\].
    pub last_turn: Nanos,
    /// The instant of the last estimate \[ns\]; 0 before the first.
    pub last_estimate: Nanos,
    /// On-line identification.
    pub identification: IdentificationHealth,
}

const _: () = assert!(size_of::<BusHealth>() == 64 + 13 * 8 && size_of::<DeviceHealth>() == 64 + 13 * 8 + 16);
const _: () = assert!(size_of::<GatewayHealth>() == 64 + 168 * MAX_BUSES + 184 * MAX_CHANNELS);
const _: () =
    assert!(size_of::<IdentificationHealth>() == 15 * 8 && size_of::<EstimatorHealth>() == 48 + 13 * 8 + 15 * 8);
