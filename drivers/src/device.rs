//! The two sides of a device's protocol as sans-I/O state machines: [`Device`] on the host, [`Board`] on the device.

use crate::{Frame, Id};
use alloc::boxed::Box;
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, StampKind};

/// A set of identifiers that a device takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim {
    /// The identifier to compare with.
    pub id: Id,
    /// The bits that are compared; all ones is this one identifier.
    pub mask: u32,
    /// Whether no other device may claim one of these: true for streams, false where several devices of one board listen
    /// to the same replies.
    pub exclusive: bool,
}

impl Claim {
    /// Exactly `id`, for this device alone.
    #[must_use]
    pub const fn exclusive(id: Id) -> Self {
        Self {
            id,
            mask: u32::MAX,
            exclusive: true,
        }
    }

    /// Exactly `id`, shared with others.
    #[must_use]
    pub const fn shared(id: Id) -> Self {
        Self {
            id,
            mask: u32::MAX,
            exclusive: false,
        }
    }

    /// Whether `id` is one of these.
    #[must_use]
    pub fn matches(&self, id: Id) -> bool {
        matches!(
            (self.id, id),
            (Id::Standard(_), Id::Standard(_)) | (Id::Extended(_), Id::Extended(_))
        ) && (self.id.raw() ^ id.raw()) & self.mask == 0
    }

    /// Whether some identifier is in both sets.
    #[must_use]
    pub fn overlaps(&self, other: &Self) -> bool {
        matches!(
            (self.id, other.id),
            (Id::Standard(_), Id::Standard(_)) | (Id::Extended(_), Id::Extended(_))
        ) && (self.id.raw() ^ other.id.raw()) & self.mask & other.mask == 0
    }
}

/// A reading that a device has completed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Output {
    /// Which of the device's outputs it belongs to: 0 for a sensor, the device's own channel number for joint devices.
    pub output: u8,
    /// When its first frame was received \[ns\].
    pub acquired: Nanos,
    /// Where that stamp comes from.
    pub stamp: StampKind,
    /// The device's own sequence number where it has one (then `quality` has DEVICE_COUNTER).
    pub device_counter: u32,
    /// What is known against it.
    pub quality: Quality,
    /// What was measured.
    pub reading: Reading,
}

/// Something wrong in the frames of a device: to be counted, never to stop for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    /// What it is counted as: one of the reasons from [`Counter::Length`] on.
    pub counter: Counter,
    /// How many at once, e.g. how many readings were lost.
    pub count: u32,
    /// The identifier in whose frame it showed.
    pub id: Id,
}

/// What one frame yields.
#[derive(Debug, Default)]
pub struct Decoded {
    /// Readings that it completes.
    pub readings: ArrayVec<Output, 8>,
    /// What is wrong with it. Readings beside it are good all the same.
    pub faults: ArrayVec<Fault, 4>,
}

impl Decoded {
    /// Nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Forgets everything, to be used again.
    pub fn clear(&mut self) {
        self.readings.clear();
        self.faults.clear();
    }

    /// Adds a reading; one that does not fit (no protocol here yields so many) is counted as lost.
    pub fn push(&mut self, output: Output, id: Id) {
        if self.readings.try_push(output).is_err() {
            self.fault(Counter::Lost, 1, id);
        }
    }

    /// Adds a fault.
    pub fn fault(&mut self, counter: Counter, count: u32, id: Id) {
        // A fault that finds no room has four companions that will be seen.
        let _ = self.faults.try_push(Fault { counter, count, id });
    }
}

/// A frame to send, and until when it makes sense to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transmit {
    /// The frame.
    pub frame: Frame,
    /// After this instant it must not be sent any more \[ns\].
    pub deadline: Nanos,
}

/// Where the bring-up of a device stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum State {
    /// Keeping silent, as boards want it after power-on.
    Waiting = 0,
    /// Asking for its configuration.
    Asking = 1,
    /// Told to start; nothing received yet.
    Starting = 2,
    /// Readings come.
    Streaming = 3,
    /// No reading for longer than it may be silent; being started again.
    Silent = 4,
    /// Not usable: see the refusal.
    Refused(Refusal) = 5,
    /// Told to stop.
    Stopped = 6,
}

impl State {
    /// Its number in `DeviceHealth::state`.
    #[must_use]
    pub const fn code(self) -> u32 {
        match self {
            Self::Waiting => 0,
            Self::Asking => 1,
            Self::Starting => 2,
            Self::Streaming => 3,
            Self::Silent => 4,
            Self::Refused(_) => 5,
            Self::Stopped => 6,
        }
    }

    /// The word for state number `code` of `DeviceHealth`.
    #[must_use]
    pub const fn word(code: u32) -> &'static str {
        match code {
            0 => "waiting",
            1 => "asking",
            2 => "starting",
            3 => "streaming",
            4 => "silent",
            5 => "refused",
            6 => "stopped",
            _ => "unknown",
        }
    }
}

/// Why a device is not usable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It did not tell its full scales in time, and the configuration gives none.
    NoFullScale,
    /// It reports a full scale of zero for this channel.
    ZeroFullScale {
        /// The channel, 0 to 5.
        channel: u8,
    },
    /// It tells another configuration than before: what it sent since can not be trusted.
    Changed,
}

impl Refusal {
    /// Its number in `DeviceHealth::refusal`.
    #[must_use]
    pub const fn code(self) -> u32 {
        match self {
            Self::NoFullScale => 1,
            Self::ZeroFullScale { channel } => 0x100 | channel as u32,
            Self::Changed => 2,
        }
    }

    /// The refusal with number `code`.
    #[must_use]
    #[allow(clippy::cast_possible_truncation)]
    pub const fn from_code(code: u32) -> Option<Self> {
        match code {
            1 => Some(Self::NoFullScale),
            2 => Some(Self::Changed),
            0x100..=0x1FF => Some(Self::ZeroFullScale {
                channel: (code & 0xFF) as u8,
            }),
            _ => None,
        }
    }
}

impl core::fmt::Display for Refusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::NoFullScale => f.write_str(
                "it did not tell its full scales; check its power, cable and address, or give full_scale_n and full_scale_nm",
            ),
            Self::ZeroFullScale { channel } => write!(
                f,
                "it reports a full scale of zero for channel {channel}; its memory needs repair, or give full_scale_n and full_scale_nm"
            ),
            Self::Changed => f.write_str("it tells another configuration than before; restart the gateway once that is settled"),
        }
    }
}

/// How a device's replies and silences are treated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Live: ask, start, watch, restart, stop. A reply counts only while it is asked for.
    Supervise,
    /// Never transmit: a recorded log, or a bus whose boards somebody else commands. Replies to others' questions count;
    /// a later one that differs is a fault all the same.
    Listen,
}

/// The outputs of a device that the configuration uses.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Outputs(pub ArrayVec<u8, 16>);

/// What every driver is told, whatever its family.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    /// The device's address, as its protocol counts.
    pub address: u32,
    /// How long it may be silent \[ns\].
    pub max_silence: Nanos,
    /// Who is in command.
    pub mode: Mode,
    /// The device channels that are joints; empty for sensors.
    pub outputs: Outputs,
}

/// A configuration that a driver can not work with.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SpecError {
    /// The address is outside the protocol's range.
    #[error("address = {address} is outside {least} to {most}")]
    Address {
        /// What was given.
        address: u32,
        /// The lowest.
        least: u32,
        /// The highest.
        most: u32,
    },
    /// A key has a value that the driver can not work with.
    #[error("{key} = {value} must be {expected}")]
    Key {
        /// The key.
        key: &'static str,
        /// What was given.
        value: f64,
        /// What would be legal.
        expected: &'static str,
    },
    /// A key that is not a number, or a combination of keys, that the driver can not work with.
    #[error("{key} must be {expected}")]
    Keys {
        /// The key.
        key: &'static str,
        /// What would be legal.
        expected: &'static str,
    },
    /// Of two keys that belong together one is missing.
    #[error("{missing} is missing: it goes with {given}")]
    Incomplete {
        /// The key that is there.
        given: &'static str,
        /// The key that is not.
        missing: &'static str,
    },
    /// A joint's channel is not one that the device has.
    #[error("joint channel {channel} does not exist; this device has channels {least} to {most}")]
    Channel {
        /// What was given.
        channel: u8,
        /// The lowest.
        least: u8,
        /// The highest.
        most: u8,
    },
    /// A joint device without a joint, or a sensor with joints.
    #[error("{0}")]
    Joints(&'static str),
}

/// The host's side of a device: decoder and bring-up in one state machine.
///
/// It never reads a clock: frames carry their stamps, and the caller says what time it is.
pub trait Device: Send {
    /// What its main reading is.
    fn kind(&self) -> Kind;

    /// The identifiers it takes. The gateway refuses a plan in which two exclusive claims overlap and sets the kernel's
    /// filters from them.
    fn claims(&self) -> &[Claim];

    /// Takes a frame of one of its identifiers and adds what it yields to `out`. Total: any frame is legal input.
    fn on_frame(&mut self, frame: &Frame, out: &mut Decoded);

    /// The next frame to send at `now`; call until `None`. Never anything in [`Mode::Listen`].
    ///
    /// What only the passing of time shows (a silence, a start) is added to `out`, in [`Mode::Listen`] too.
    fn poll_transmit(&mut self, now: Nanos, out: &mut Decoded) -> Option<Transmit>;

    /// When to call [`Device::poll_transmit`] again even if no frame comes \[ns\].
    fn next_wake(&self) -> Option<Nanos>;

    /// Where its bring-up stands.
    fn state(&self) -> State;

    /// Begins to stop: [`Device::poll_transmit`] yields the stop commands, then the state is [`State::Stopped`].
    fn stop(&mut self, now: Nanos);

    /// The link was lost and is back: the board may have been reset, so begin again at `now`.
    fn restart(&mut self, now: Nanos);
}

/// Frames that a board sends at once.
pub type Frames = ArrayVec<Frame, 16>;

/// A reading that a board can not put into frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The reading is of a kind that this family does not have.
    #[error("this device has no such reading")]
    Kind,
    /// The output number is not one of the board's.
    #[error("this device has no output {0}")]
    Output(u8),
    /// A full scale is needed to encode and the configuration gives none.
    #[error("full_scale_n and full_scale_nm are needed to encode")]
    NoFullScale,
    /// A value that is not finite where the protocol has no sign for absence.
    #[error("a value is not finite")]
    NotFinite,
}

/// The device's own side of its protocol: answers commands, encodes readings. What the hardware does, without hardware.
pub trait Board: Send {
    /// Takes a frame from the bus and adds the answers to `out`. Frames meant for others are ignored.
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames);

    /// The period with which it streams its main reading now \[ns\]; `None` while it does not.
    fn period(&self) -> Option<Nanos>;

    /// Encodes a reading of output `output`, quantised and limited as the board does it, and adds its frames to `out`.
    ///
    /// `quality` sets what the protocol can carry: saturation per axis, faults. A value beyond the range is limited to it.
    ///
    /// # Errors
    /// [`EncodeError`]: a reading, output or number that the protocol does not have.
    fn encode(&mut self, output: u8, reading: &Reading, quality: Quality, out: &mut Frames) -> Result<(), EncodeError>;
}

/// A device built by [`crate::Options::device`].
pub type BoxedDevice = Box<dyn Device>;
