//! State and counters of gateway and estimator: the payloads of `<robot>/health/gateway` and
//! `<robot>/health/estimator`.

use core::fmt;

use crate::{Header, MAX_BUSES, MAX_CHANNELS, Name, Nanos};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// The counters of one device.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
pub enum Counter {
    /// Frames with one of the device's identifiers.
    Frames = 0,
    /// Readings published.
    Readings = 1,
    /// Frames with a length that the protocol does not define.
    Length = 2,
    /// Frames with a value that the protocol does not define.
    Value = 3,
    /// Half readings (one of two frames) whose other half did not arrive.
    Unpaired = 4,
    /// Lost readings, from gaps in the device's own sequence number.
    Lost = 5,
    /// Replies without a request.
    Unexpected = 6,
    /// Configuration replies that contradict an earlier one: the device's settings have changed.
    Changed = 7,
    /// Readings with a saturated channel.
    Saturated = 8,
    /// Readings with a device fault.
    DeviceFault = 9,
    /// Number of silences longer than the device's maximum.
    Silences = 10,
    /// Number of start sequences begun.
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

    /// Its name in tables and logs.
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
    /// Frames can be received and sent.
    #[default]
    Up = 0,
    /// The interface exists but is down.
    Down = 1,
    /// The interface does not exist.
    Gone = 2,
    /// The controller is bus-off after too many errors.
    BusOff = 3,
    /// The replayed log has ended.
    Ended = 4,
}

impl LinkState {
    /// Its name in tables and logs.
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

/// Counters and state of one bus.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct BusHealth {
    /// Its name in the configuration.
    pub name: Name,
    /// Frames received that passed the filters.
    pub frames: u64,
    /// Of these, frames with an identifier of no configured device.
    pub unclaimed: u64,
    /// Frames that the kernel dropped because the gateway read them too late.
    pub dropped: u64,
    /// Error frames received.
    pub error_frames: u64,
    /// Frames sent.
    pub sent: u64,
    /// Frames that could not be sent before their deadline.
    pub send_failures: u64,
    /// Number of link losses (down, gone, bus-off).
    pub link_losses: u64,
    /// Samples published.
    pub published: u64,
    /// Samples that could not be published.
    pub publish_failures: u64,
    /// Reader connections made while publishing.
    pub connections: u64,
    /// Stamp of the last frame \[ns\]; [`Nanos::MIN`] before the first.
    pub last_frame: Nanos,
    /// Time of the last turn of the bus thread's loop \[ns\].
    pub last_turn: Nanos,
    /// The link's state.
    pub link: LinkState,
    /// Unused, zero.
    pub reserved: u32,
}

impl BusHealth {
    /// Without a name and with all counts zero.
    pub const EMPTY: Self = Self {
        name: Name::EMPTY,
        frames: 0,
        unclaimed: 0,
        dropped: 0,
        error_frames: 0,
        sent: 0,
        send_failures: 0,
        link_losses: 0,
        published: 0,
        publish_failures: 0,
        connections: 0,
        last_frame: Nanos::MIN,
        last_turn: Nanos::MIN,
        link: LinkState::Up,
        reserved: 0,
    };
}

/// Counters and state of one device.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct DeviceHealth {
    /// Its name in the configuration.
    pub name: Name,
    /// The counters; index by `Counter as usize`.
    pub counters: [u64; Counter::ALL.len()],
    /// Its state (`proprio_drivers::State`): 0 waiting, 1 asking, 2 starting, 3 streaming, 4
    /// silent, 5 refused, 6 stopped.
    pub state: u32,
    /// Why it was refused (`proprio_drivers::Refusal`); 0 if it was not.
    pub refusal: u32,
    /// The number of its bus.
    pub bus: u32,
    /// Unused, zero.
    pub reserved: u32,
}

/// State and counters of the gateway, published ten times a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("proprio/GatewayHealth/1")]
pub struct GatewayHealth {
    /// When.
    pub header: Header,
    /// When the gateway started \[ns\].
    pub started: Nanos,
    /// Number of valid entries in `buses`.
    pub bus_count: u32,
    /// Number of valid entries in `devices`.
    pub device_count: u32,
    /// The buses.
    pub buses: [BusHealth; MAX_BUSES],
    /// The devices.
    pub devices: [DeviceHealth; MAX_CHANNELS],
}

impl DeviceHealth {
    /// Without a name and with all counts zero.
    pub const EMPTY: Self = Self {
        name: Name::EMPTY,
        counters: [0; Counter::ALL.len()],
        state: 0,
        refusal: 0,
        bus: 0,
        reserved: 0,
    };
}

impl GatewayHealth {
    /// Without buses and devices.
    #[must_use]
    pub fn new(started: Nanos) -> Self {
        Self {
            header: Header::default(),
            started,
            bus_count: 0,
            device_count: 0,
            buses: [BusHealth::EMPTY; MAX_BUSES],
            devices: [DeviceHealth::EMPTY; MAX_CHANNELS],
        }
    }

    /// The valid buses.
    #[must_use]
    pub fn buses(&self) -> &[BusHealth] {
        self.buses
            .get(..self.bus_count as usize)
            .unwrap_or(&self.buses)
    }

    /// The valid devices.
    #[must_use]
    pub fn devices(&self) -> &[DeviceHealth] {
        self.devices
            .get(..self.device_count as usize)
            .unwrap_or(&self.devices)
    }
}

/// Instants that on-line identification has used and excluded since the estimator's start, by
/// reason.
///
/// Instants are counted per group of links and sensors. Groups are identified independently: one
/// may pause while another learns. There are at most `identification.rate_hz` instants a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend)]
pub struct IdentificationHealth {
    /// Number of groups; 0 if nothing is identified.
    pub groups: u32,
    /// Number of groups that are paused at present.
    pub paused: u32,
    /// Instants used.
    pub learnt: u64,
    /// Of these, instants without motion, which contain little information.
    pub still: u64,
    /// Excluded: a contact was declared.
    pub contact: u64,
    /// Excluded: the prediction error was too large, for one or a few instants.
    pub outlier: u64,
    /// Excluded: the prediction error was too large for longer: an undeclared contact or load, or a
    /// change.
    pub suspected: u64,
    /// Excluded: a channel was silent.
    pub stale: u64,
    /// Excluded: a sensor was saturated.
    pub saturated: u64,
    /// Excluded: a device reported a fault.
    pub device_fault: u64,
    /// Excluded: a channel was not seen yet or had too few samples, or the base motion was not
    /// known.
    pub unseen: u64,
    /// Offset jumps: the F/T offset is re-initialised.
    pub offset_changes: u64,
    /// Loads taken up or put down.
    pub load_changes: u64,
    /// Unexplained changes; each restarts the identification.
    pub unknown_changes: u64,
    /// Solutions that were late.
    pub late: u64,
    /// Solutions that failed.
    pub failed: u64,
}

impl IdentificationHealth {
    /// Every counter with its name in tables and logs.
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
    /// The counters that are not zero.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut gap = "";
        for (word, count) in self.counts().into_iter().filter(|(_, count)| *count > 0) {
            write!(f, "{gap}{word} {count}")?;
            gap = ", ";
        }
        Ok(())
    }
}

/// State and counters of the estimator, published ten times a second.
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
    /// Samples lost between gateway and estimator, from gaps in the sequence numbers.
    pub lost: u64,
    /// Number of gateway epochs seen (its starts).
    pub epochs: u64,
    /// Samples of channels that are not in the configuration.
    pub unknown_channel: u64,
    /// Samples dropped because they arrived after the estimate of their instant.
    pub late: u64,
    /// Samples dropped because their stamp was not later than their channel's last.
    pub backward: u64,
    /// Samples dropped because they hold a number that is not finite.
    pub not_finite: u64,
    /// Estimates published.
    pub estimates: u64,
    /// Estimates with at least one joint withheld.
    pub withheld: u64,
    /// Estimates that could not be published.
    pub publish_failures: u64,
    /// Time of the last turn of the loop \[ns\].
    pub last_turn: Nanos,
    /// The instant of the last estimate \[ns\]; 0 before the first.
    pub last_estimate: Nanos,
    /// On-line identification.
    pub identification: IdentificationHealth,
}

const _: () =
    assert!(size_of::<BusHealth>() == 64 + 13 * 8 && size_of::<DeviceHealth>() == 64 + 13 * 8 + 16);
const _: () = assert!(size_of::<GatewayHealth>() == 64 + 168 * MAX_BUSES + 184 * MAX_CHANNELS);
const _: () = assert!(
    size_of::<IdentificationHealth>() == 15 * 8
        && size_of::<EstimatorHealth>() == 48 + 13 * 8 + 15 * 8
);
