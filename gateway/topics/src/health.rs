//! State and counters of gateway and estimator: the payloads of `<robot>/health/gateway` and
//! `<robot>/health/estimator`.

use core::fmt;

use crate::code::coded;
use crate::{Code, Header, MAX_BUSES, MAX_CHANNELS, Name, Nanos, valid};
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

coded! {
    /// The counters of one device.
    pub enum Counter {
        /// Frames with one of the device's identifiers.
        Frames = 0 => "frames",
        /// Readings published.
        Readings = 1 => "readings",
        /// Frames with a length that the protocol does not define.
        Length = 2 => "bad_length",
        /// Frames with a value that the protocol does not define.
        Value = 3 => "bad_value",
        /// Half readings (one of two frames) whose other half did not arrive.
        Unpaired = 4 => "unpaired",
        /// Lost readings, from gaps in the device's own sequence number.
        Lost = 5 => "lost",
        /// Frames too many: replies without a request, a frame that has come before.
        Unexpected = 6 => "unexpected",
        /// Configuration replies that contradict an earlier one: the device's settings have
        /// changed.
        Changed = 7 => "changed",
        /// Readings with a saturated channel.
        Saturated = 8 => "saturated",
        /// Readings with a device fault.
        DeviceFault = 9 => "device_fault",
        /// Number of silences longer than the device's maximum.
        Silences = 10 => "silences",
        /// Number of start sequences begun.
        Starts = 11 => "starts",
        /// Readings dropped because their stamp was not later than the last one's.
        Backward = 12 => "backward_stamp",
        /// Readings with a fault of the drive that does not concern the reading.
        DriveFault = 13 => "drive_fault",
        /// Frames to the device that could not be sent.
        Unsent = 14 => "unsent",
        /// Readings with a value that has stopped to change although it was never that still: the
        /// gateway's own judgement, see [`DeviceHealth::frozen_axes`].
        Frozen = 15 => "frozen",
        /// Readings with a value beyond the sensor's full scale.
        OutOfRange = 16 => "out_of_range",
    }
}

coded! {
    /// The state of a link to a bus.
    #[derive(Default)]
    pub enum LinkState {
        /// Frames can be received and sent.
        #[default]
        Up = 0 => "up",
        /// The interface exists but is down.
        Down = 1 => "down",
        /// The interface does not exist.
        Gone = 2 => "gone",
        /// The controller is bus-off after too many errors.
        BusOff = 3 => "bus_off",
        /// The replayed log has ended.
        Ended = 4 => "ended",
        /// The interface is up, but has no carrier: its controller or its peer is not running.
        NoCarrier = 5 => "no_carrier",
    }
}

coded! {
    /// The error state of a CAN controller (ISO 11898-1), as the kernel reports it.
    #[derive(Default)]
    pub enum Controller {
        /// Not known: a virtual interface, or not asked yet.
        #[default]
        Unknown = 0 => "unknown",
        /// Error active: the normal state.
        Active = 1 => "active",
        /// An error counter has reached the warning limit (96).
        Warning = 2 => "warning",
        /// Error passive: an error counter has reached 128.
        Passive = 3 => "passive",
        /// Bus-off: the transmit error counter has passed 255.
        BusOff = 4 => "bus_off",
        /// Stopped by its host.
        Stopped = 5 => "stopped",
        /// Asleep.
        Sleeping = 6 => "sleeping",
    }
}

coded! {
    /// What an error frame of a CAN interface reports; one frame may report several.
    pub enum BusError {
        /// A frame could not be sent in time.
        TxTimeout = 0 => "tx_timeout",
        /// Arbitration was lost.
        ArbitrationLost = 1 => "arbitration_lost",
        /// The controller's receive buffer overflowed: frames were lost.
        RxOverflow = 2 => "rx_overflow",
        /// The controller's transmit buffer overflowed.
        TxOverflow = 3 => "tx_overflow",
        /// An error counter reached the warning limit.
        Warning = 4 => "warning",
        /// The controller became error passive.
        Passive = 5 => "passive",
        /// The controller became error active again.
        Active = 6 => "active",
        /// A violation of the protocol: bit, form, stuff or other error.
        Protocol = 7 => "protocol",
        /// The transceiver reports a fault, such as a broken wire or a short circuit.
        Transceiver = 8 => "transceiver",
        /// Nobody acknowledged a frame.
        NoAck = 9 => "no_ack",
        /// The controller became bus-off.
        BusOff = 10 => "bus_off",
        /// A bus error.
        Bus = 11 => "bus_error",
        /// The controller was restarted.
        Restarted = 12 => "restarted",
    }
}

/// What the kernel knows of an interface and its CAN controller; zero where it does not tell.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend, FromBytes)]
pub struct InterfaceHealth {
    /// Frames received by the interface, for all programs.
    pub rx_frames: u64,
    /// Frames sent by the interface.
    pub tx_frames: u64,
    /// Bytes of data in the frames received.
    pub rx_bytes: u64,
    /// Bytes of data in the frames sent.
    pub tx_bytes: u64,
    /// Receive errors.
    pub rx_errors: u64,
    /// Transmit errors.
    pub tx_errors: u64,
    /// Received frames that the interface dropped.
    pub rx_dropped: u64,
    /// Frames to be sent that the interface dropped.
    pub tx_dropped: u64,
    /// The controller's error state.
    pub controller: Code<Controller>,
    /// The controller's transmit error counter.
    pub tx_error_counter: u32,
    /// The controller's receive error counter.
    pub rx_error_counter: u32,
    /// Nominal bit-rate \[bit/s\].
    pub bit_rate: u32,
    /// Bit-rate of the data phase of CAN FD \[bit/s\].
    pub data_bit_rate: u32,
    /// Time from bus-off to the automatic restart \[ms\]; 0: none.
    pub restart_ms: u32,
    /// 1 if the interface carries CAN FD frames.
    pub fd: u32,
    /// 1 if the controller only listens.
    pub listen_only: u32,
}

/// Counters and state of one bus.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct BusHealth {
    /// Its name in the configuration.
    pub name: Name,
    /// Frames received that passed the filters.
    pub frames: u64,
    /// Of these, frames with an identifier of no configured device.
    pub unclaimed: u64,
    /// Frames lost because the gateway read them too late, or the controller's buffer overflowed.
    pub dropped: u64,
    /// Error frames received.
    pub error_frames: u64,
    /// What they reported; index by `BusError as usize`.
    pub errors: [u64; BusError::ALL.len()],
    /// Frames sent.
    pub sent: u64,
    /// Frames not sent: their deadline passed, the link was lost, or the interface refused them.
    pub send_failures: u64,
    /// Attempts to send that found the interface's queue full; each was repeated until the frame's
    /// deadline.
    pub queue_full: u64,
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
    /// The share of the bus's time that the frames of the last second took, all participants', with
    /// as many stuff bits as they can have; 1 is all of it. NaN: the bit rate is not known.
    pub load: f64,
    /// Frames per second, over the last second.
    pub frame_rate: f64,
    /// The interface and its controller.
    pub interface: InterfaceHealth,
    /// The link's state.
    pub link: Code<LinkState>,
    /// Unused, zero.
    pub reserved: u32,
}

impl BusHealth {
    /// Without a name and with all counts zero.
    pub const EMPTY: Self = Self {
        last_frame: Nanos::MIN,
        last_turn: Nanos::MIN,
        load: f64::NAN,
        // Zero is a link that is up, and an interface and controller that are not known.
        ..zerocopy::transmute!([0_u8; size_of::<Self>()])
    };
}

coded! {
    /// The state of a device's bring-up.
    #[derive(Default)]
    pub enum DeviceState {
        /// The gateway keeps silent, as boards require after power-on.
        #[default]
        Waiting = 0 => "waiting",
        /// The gateway asks for the board's configuration.
        Asking = 1 => "asking",
        /// The board was started; no reading received yet.
        Starting = 2 => "starting",
        /// Readings arrive.
        Streaming = 3 => "streaming",
        /// No reading for longer than the maximum silence, or none at all after many starts; the
        /// board is started again.
        Silent = 4 => "silent",
        /// Not usable: see the refusal.
        Refused = 5 => "refused",
        /// The board was stopped.
        Stopped = 6 => "stopped",
    }
}

/// Why a device is not usable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It did not report its full scales in time, and the configuration has none.
    NoFullScale,
    /// It reports a full scale of zero for this channel.
    ZeroFullScale {
        /// The channel, 0 to 5.
        channel: u8,
    },
    /// It reports a different configuration than before: its readings since then cannot be trusted.
    Changed,
    /// It did not report its calibration in time, and the configuration has none.
    NoCalibration,
    /// Its calibration cannot be used for this channel: zeros, or no numbers.
    BadCalibration {
        /// The channel, 0 to 5.
        channel: u8,
    },
    /// It does not answer.
    NoAnswer,
    /// It is a device of another kind.
    OtherDevice {
        /// What it says it is: the CiA profile of a CANopen node.
        profile: u16,
    },
    /// It refuses something that is needed.
    Rejected {
        /// What: the index of the object of a CANopen node.
        object: u16,
    },
    /// What it tells of itself can not be, beside what else it tells, or is in a unit that is not
    /// known.
    Implausible {
        /// What: the index of the object of a CANopen node.
        object: u16,
    },
    /// What its values are scaled by is not known.
    Untold {
        /// What: the index of the object of a CANopen node.
        object: u16,
    },
    /// What is needed of it is switched off.
    SwitchedOff {
        /// What: the index of the object of a CANopen node.
        object: u16,
    },
    /// It does not send what is needed of it.
    NotMapped,
    /// It sends with an identifier that is not received.
    OtherIdentifier {
        /// The identifier.
        id: u32,
    },
}

impl Refusal {
    /// Its number in [`DeviceHealth::refusal`].
    #[must_use]
    pub const fn code(self) -> u32 {
        match self {
            Self::NoFullScale => 1,
            Self::ZeroFullScale { channel } => 0x100 | channel as u32,
            Self::Changed => 2,
            Self::NoCalibration => 3,
            Self::BadCalibration { channel } => 0x200 | channel as u32,
            Self::NoAnswer => 4,
            Self::NotMapped => 5,
            Self::OtherDevice { profile } => 0x1_0000 | profile as u32,
            Self::Rejected { object } => 0x2_0000 | object as u32,
            Self::Implausible { object } => 0x3_0000 | object as u32,
            Self::Untold { object } => 0x4_0000 | object as u32,
            Self::SwitchedOff { object } => 0x5_0000 | object as u32,
            Self::OtherIdentifier { id } => 0x4000_0000 | id,
        }
    }

    /// The refusal with number `code`.
    #[must_use]
    #[allow(clippy::cast_possible_truncation)]
    pub const fn from_code(code: u32) -> Option<Self> {
        let (channel, profile, object) = (code as u8, code as u16, code as u16);
        Some(match code {
            1 => Self::NoFullScale,
            2 => Self::Changed,
            3 => Self::NoCalibration,
            4 => Self::NoAnswer,
            5 => Self::NotMapped,
            0x100..=0x1FF => Self::ZeroFullScale { channel },
            0x200..=0x2FF => Self::BadCalibration { channel },
            0x1_0000..=0x1_FFFF => Self::OtherDevice { profile },
            0x2_0000..=0x2_FFFF => Self::Rejected { object },
            0x3_0000..=0x3_FFFF => Self::Implausible { object },
            0x4_0000..=0x4_FFFF => Self::Untold { object },
            0x5_0000..=0x5_FFFF => Self::SwitchedOff { object },
            0x4000_0000..=0x5FFF_FFFF => Self::OtherIdentifier {
                id: code & 0x1FFF_FFFF,
            },
            _ => return None,
        })
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoFullScale => f.write_str(
                "it did not report its full scales; check its power, cable and address, or set \
                 full_scale_n and full_scale_nm",
            ),
            Self::ZeroFullScale { channel } => write!(
                f,
                "it reports a full scale of zero for channel {channel}; its memory needs repair, \
                 or set full_scale_n and full_scale_nm"
            ),
            Self::Changed => f.write_str(
                "it reports a different configuration than before; check the board, then restart \
                 the gateway",
            ),
            Self::NoCalibration => f.write_str(
                "it did not report its calibration; check its power, cable and address, or \
                 configure it (matrix, counts, units)",
            ),
            Self::BadCalibration { channel } => write!(
                f,
                "its calibration cannot be used for channel {channel} (zeros, or no numbers); \
                 its memory needs repair, or configure it (matrix, counts, units)"
            ),
            Self::NoAnswer => {
                f.write_str("it does not answer; check its power, cable, address and bit rate")
            }
            Self::OtherDevice { profile } => write!(
                f,
                "it is a device of another kind (profile {profile}); check its address and driver"
            ),
            Self::Rejected { object } => write!(
                f,
                "it refuses object {object:04X}; the driver's page says which key replaces it"
            ),
            Self::Implausible { object } => {
                let (problem, keys) = match object {
                    0x6076 => (
                        "a rated torque that no motor with its rated current (6075) or speed \
                         (6080) has",
                        "rated_torque_unit or rated_torque",
                    ),
                    0x60A8 => ("a unit that is not known", "counts_per_turn"),
                    0x60A9 => ("a unit that is not known", "velocity_unit"),
                    _ => ("what can not be", "the key that replaces it"),
                };
                write!(f, "object {object:04X} tells {problem}; set {keys}")
            }
            Self::Untold { object } => {
                let (what, key) = match object {
                    0x6076 => ("the rated torque", "rated_torque"),
                    0x6075 => ("the rated current", "rated_current"),
                    0x608F => ("the counts per turn", "counts_per_turn"),
                    _ => ("a scale", "the key that replaces it"),
                };
                write!(
                    f,
                    "object {object:04X} ({what}) is not known: neither the node nor its file \
                     (eds; a default does not count) states it; set {key}"
                )
            }
            Self::SwitchedOff { object } => write!(
                f,
                "the process data that have the position are switched off (object {object:04X} \
                 sub 1, bit 31): switch them on with the maker's tool, or, if the file (eds) is \
                 wrong, correct it there"
            ),
            Self::NotMapped => f.write_str(
                "none of its process data that are switched on has the position; map it with the \
                 maker's tool, or, if another program commands it, state the mapping (the driver's \
                 page says how)",
            ),
            Self::OtherIdentifier { id } => write!(
                f,
                "its process data has the identifier 0x{id:03X}, which is not received; the \
                 driver's page says which key states it"
            ),
        }
    }
}

/// Counters and state of one device.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
pub struct DeviceHealth {
    /// Its name in the configuration.
    pub name: Name,
    /// The counters; index by `Counter as usize`.
    pub counters: [u64; Counter::ALL.len()],
    /// Its state.
    pub state: Code<DeviceState>,
    /// Why it was refused ([`Refusal::from_code`]), or, while it streams, why its readings lack a
    /// value that it sends; else 0.
    pub refusal: u32,
    /// The number of its bus.
    pub bus: u32,
    /// The axes of an F/T sensor that are frozen: bit k is axis k of fx fy fz tx ty tz. The gateway
    /// judges so: a value repeats itself that was too noisy before to do so by chance.
    pub frozen_axes: u16,
    /// The axes whose last value was beyond the sensor's full scale.
    pub beyond_axes: u16,
}

/// The names of the axes in `mask`, as those of [`DeviceHealth::frozen_axes`]: "fx, tz".
#[must_use]
pub fn axes(mask: u16) -> impl fmt::Display {
    struct Axes(u16);
    impl fmt::Display for Axes {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            let mut gap = "";
            for (axis, name) in ["fx", "fy", "fz", "tx", "ty", "tz"].into_iter().enumerate() {
                if self.0 >> axis & 1 == 1 {
                    write!(f, "{gap}{name}")?;
                    gap = ", ";
                }
            }
            Ok(())
        }
    }
    Axes(mask)
}

/// State and counters of the gateway, published ten times a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend, FromBytes)]
#[type_name("proprio/GatewayHealth/4")]
pub struct GatewayHealth {
    /// When.
    pub header: Header,
    /// When the gateway started \[ns\].
    pub started: Nanos,
    /// CLOCK_REALTIME minus CLOCK_MONOTONIC at `header.published` \[ns\]: what to add to a stamp
    /// to have the time of day (UTC).
    pub realtime_offset: Nanos,
    /// Number of valid entries in `buses`.
    pub bus_count: u32,
    /// Number of valid entries in `devices`.
    pub device_count: u32,
    /// The buses.
    pub buses: [BusHealth; MAX_BUSES],
    /// The devices.
    pub devices: [DeviceHealth; MAX_CHANNELS],
    /// When the newest sample of each channel was acquired \[ns\], by its number;
    /// [`Nanos::MIN`] if there was none since the gateway started.
    pub newest: [Nanos; MAX_CHANNELS],
}

impl DeviceHealth {
    /// Without a name, waiting, with all counts zero.
    pub const EMPTY: Self = zerocopy::transmute!([0_u8; size_of::<Self>()]);

    /// The value of a counter.
    #[must_use]
    pub fn count(&self, counter: Counter) -> u64 {
        (self.counters.get(counter as usize).copied()).unwrap_or_default()
    }
}

impl GatewayHealth {
    /// Without buses and devices.
    #[must_use]
    pub fn new(started: Nanos) -> Self {
        Self {
            header: Header::default(),
            started,
            realtime_offset: Nanos::ZERO,
            bus_count: 0,
            device_count: 0,
            buses: [BusHealth::EMPTY; MAX_BUSES],
            devices: [DeviceHealth::EMPTY; MAX_CHANNELS],
            newest: [Nanos::MIN; MAX_CHANNELS],
        }
    }

    /// The valid buses.
    #[must_use]
    pub fn buses(&self) -> &[BusHealth] {
        valid(&self.buses, self.bus_count)
    }

    /// The valid devices.
    #[must_use]
    pub fn devices(&self) -> &[DeviceHealth] {
        valid(&self.devices, self.device_count)
    }
}

/// Instants that on-line identification has used and excluded since the estimator's start, by
/// reason.
///
/// Instants are counted per group of links and sensors. Groups are identified independently: one
/// may pause while another learns. There are at most `identification.rate_hz` instants a second.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend, FromBytes)]
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
    /// Excluded: a device reported a fault, or repeated its readings instead of measuring.
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend, FromBytes)]
#[type_name("proprio/EstimatorHealth/3")]
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

const _: () = {
    assert!(size_of::<InterfaceHealth>() == 8 * 8 + 8 * 4);
    assert!(size_of::<BusHealth>() == 64 + 28 * 8 + size_of::<InterfaceHealth>() + 8);
    assert!(size_of::<DeviceHealth>() == 64 + 17 * 8 + 16);
    assert!(size_of::<GatewayHealth>() == 80 + 392 * MAX_BUSES + 224 * MAX_CHANNELS);
    assert!(size_of::<IdentificationHealth>() == 15 * 8);
    assert!(size_of::<EstimatorHealth>() == 56 + 13 * 8 + 15 * 8);
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_found_by_its_number() {
        let scales = (0..6).map(|channel| Refusal::ZeroFullScale { channel });
        let calibrations = (0..6).map(|channel| Refusal::BadCalibration { channel });
        let refusals = [
            Refusal::NoFullScale,
            Refusal::Changed,
            Refusal::NoCalibration,
            Refusal::NoAnswer,
            Refusal::NotMapped,
            Refusal::OtherDevice { profile: 0 },
            Refusal::OtherDevice { profile: 0xFFFF },
            Refusal::Rejected { object: 0x608F },
            Refusal::Implausible { object: 0x6076 },
            Refusal::Untold { object: 0x6075 },
            Refusal::SwitchedOff { object: 0x1803 },
            Refusal::OtherIdentifier { id: 0x1B2 },
            Refusal::OtherIdentifier { id: 0x1FFF_FFFF },
        ];
        for refusal in refusals.into_iter().chain(scales).chain(calibrations) {
            assert_eq!(Refusal::from_code(refusal.code()), Some(refusal));
        }
        for none in [
            0,
            6,
            0xFF,
            0x300,
            0xFFFF,
            0x6_0000,
            0x3FFF_FFFF,
            0x6000_0000,
            u32::MAX,
        ] {
            assert_eq!(Refusal::from_code(none), None, "{none}");
        }
    }
}
