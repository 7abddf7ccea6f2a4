//! The host's side of a device's protocol as a sans-I/O state machine, [`Device`], and [`Driver`],
//! which makes it from a device's keys.

use crate::calibration::Calibration;
use crate::objects::Objects;
use crate::signal::Message;
use crate::{Frame, Id};
use alloc::borrow::Cow;
use alloc::boxed::Box;
use alloc::string::String;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use proprio_topics::{
    Counter, DeviceState, Kind, Nanos, Quality, Reading, Refusal, StampKind, Wrench,
};

/// A set of identifiers whose frames a device receives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim {
    /// The identifier to compare with.
    pub id: Id,
    /// The bits to compare; all ones matches only `id`.
    pub mask: u32,
    /// Whether no other device may claim one of these: true for streams, false where several
    /// devices of one board listen to the same replies.
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

    /// Whether `id` is in the set.
    #[must_use]
    pub fn matches(&self, id: Id) -> bool {
        self.overlaps(&Self::shared(id))
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

/// A complete reading of one output of a device, with its stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedReading {
    /// The number of the output that gives it: 0 for a sensor, the device's own channel number for
    /// joint devices.
    pub output: u8,
    /// Receive time of its first frame \[ns\].
    pub acquired: Nanos,
    /// The source of that stamp.
    pub stamp: StampKind,
    /// The device's own time of the reading \[ns\], in its own clock; [`Nanos::MIN`] if it reports
    /// none.
    pub device_time: Nanos,
    /// The device's own sequence number if it has one (then `quality` has DEVICE_COUNTER).
    pub device_counter: u32,
    /// Its quality flags.
    pub quality: Quality,
    /// The measured quantities.
    pub reading: Reading,
}

impl StampedReading {
    /// A reading that `frame` holds, of a device without time and sequence number.
    #[must_use]
    pub const fn new(output: u8, frame: &Frame, quality: Quality, reading: Reading) -> Self {
        Self {
            output,
            acquired: frame.t,
            stamp: frame.stamp,
            device_time: Nanos::MIN,
            device_counter: 0,
            quality,
            reading,
        }
    }

    /// The same reading with the stamp `acquired`.
    #[must_use]
    pub(crate) const fn at(mut self, acquired: Nanos, stamp: StampKind) -> Self {
        (self.acquired, self.stamp) = (acquired, stamp);
        self
    }
}

/// An output of a device, as its driver states it before the device is built.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutputInfo {
    /// Its number: [`StampedReading::output`].
    pub number: u8,
    /// The kind of its main reading. An output of kind [`Kind::Joint`] is used only if a
    /// `[[bus.device.joint]]` with that channel names it.
    pub kind: Kind,
    /// For another output, the end of its channel's name, `<device>_<suffix>`; empty: the name is
    /// the device's own.
    pub suffix: Cow<'static, str>,
}

impl OutputInfo {
    /// Output `number`, without a suffix.
    #[must_use]
    pub const fn new(number: u8, kind: Kind) -> Self {
        Self {
            number,
            kind,
            suffix: Cow::Borrowed(""),
        }
    }

    /// Output `number`, a temperature with a channel of its own.
    #[must_use]
    pub fn temperature(number: u8, suffix: &'static str) -> Self {
        Self {
            suffix: Cow::Borrowed(suffix),
            ..Self::new(number, Kind::Temperature)
        }
    }
}

/// A fault in the frames of a device. It is counted and never stops the gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    /// The counter to increase: one from [`Counter::Length`] on.
    pub counter: Counter,
    /// The increment, such as the number of lost readings.
    pub count: u32,
    /// The identifier of the frame that showed it.
    pub id: Id,
}

/// The result of decoding one frame.
#[derive(Debug, Default)]
pub struct Decoded {
    /// Readings that the frame completes.
    pub readings: ArrayVec<StampedReading, { Self::MOST }>,
    /// Faults in the frame. They do not affect the readings.
    pub faults: ArrayVec<Fault, 4>,
}

impl Decoded {
    /// The most readings that one frame completes: one for each byte of a frame of CAN FD. No
    /// sensor is known whose readings are shorter.
    pub const MOST: usize = 64;

    /// An empty result.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Clears the result for reuse.
    pub fn clear(&mut self) {
        self.readings.clear();
        self.faults.clear();
    }

    /// Adds a reading; one that does not fit is counted as lost (no device is built that yields
    /// that many).
    pub fn push(&mut self, stamped: StampedReading, id: Id) {
        if self.readings.try_push(stamped).is_err() {
            self.fault(Counter::Lost, 1, id);
        }
    }

    /// Adds a fault: to the count of one of its kind, if the frame has shown one already.
    pub fn fault(&mut self, counter: Counter, count: u32, id: Id) {
        let same = |fault: &&mut Fault| fault.counter == counter && fault.id == id;
        if let Some(known) = self.faults.iter_mut().find(same) {
            known.count = known.count.saturating_add(count);
            return;
        }
        // If there is no room, four other faults are reported already.
        let _ = self.faults.try_push(Fault { counter, count, id });
    }
}

/// A frame to send before a deadline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Transmit {
    /// The frame.
    pub frame: Frame,
    /// After this instant it must not be sent any more \[ns\].
    pub deadline: Nanos,
}

/// The state of a device's bring-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// The host keeps silent, as boards require after power-on.
    Waiting,
    /// The host asks for the board's configuration.
    Asking,
    /// The board was started; no reading received yet.
    Starting,
    /// Readings arrive.
    Streaming,
    /// No reading for longer than the maximum silence, or none at all after many starts; the board
    /// is started again.
    Silent,
    /// Not usable.
    Refused(Refusal),
    /// The board was stopped.
    Stopped,
}

impl State {
    /// The state as readers of `DeviceHealth` see it.
    #[must_use]
    pub const fn published(self) -> DeviceState {
        match self {
            Self::Waiting => DeviceState::Waiting,
            Self::Asking => DeviceState::Asking,
            Self::Starting => DeviceState::Starting,
            Self::Streaming => DeviceState::Streaming,
            Self::Silent => DeviceState::Silent,
            Self::Refused(_) => DeviceState::Refused,
            Self::Stopped => DeviceState::Stopped,
        }
    }

    /// Why the device is not usable, if it is not.
    #[must_use]
    pub const fn refusal(self) -> Option<Refusal> {
        match self {
            Self::Refused(refusal) => Some(refusal),
            _ => None,
        }
    }
}

/// Why a frame was not sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotSent {
    /// Its deadline passed before the interface took it.
    Deadline,
    /// The link was lost, or is not up.
    LinkLost,
    /// The link cannot carry it or does not send at all, or the system refused it.
    Refused,
}

/// Whether the host commands a device or only listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Live: ask, start, watch, restart, stop. A reply is accepted only after a question.
    Supervise,
    /// Never transmit: for a recorded log, or a bus whose boards another program commands. Replies
    /// to other programs' questions are accepted; a later one that differs is a fault.
    Listen,
}

/// What an operator may ask of a device while it runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Command {
    /// Take the present load of a sensor as its zero, until the board is restarted.
    Tare,
    /// Read the calibration that a sensor has in its memory.
    Calibration,
}

/// Why a command was not begun. Nothing was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CommandRefused {
    /// The family has no such command.
    #[error("this device has no such command")]
    Unsupported,
    /// The keys of this device leave nothing for the command to act on.
    #[error("{0}")]
    Useless(&'static str),
    /// What is asked for has not been read from the board yet.
    #[error("{0} is not known yet; `proprio ctl devices` shows its state")]
    Unknown(&'static str),
    /// [`Mode::Listen`].
    #[error(
        "the gateway only listens to this device: another program commands its board, and would \
         not know of it"
    )]
    ListenOnly,
    /// The board's readings do not arrive.
    #[error("its readings do not arrive; `proprio ctl devices` shows its state")]
    NotStreaming,
    /// The command before has not ended.
    #[error("an earlier command to this device has not ended")]
    Busy,
}

/// How a command that was begun has ended well.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum CommandOutcome {
    /// What the board adds to its measurement from now on, as it reads it back: minus the load at
    /// the tare \[N, Nm\]. `None`: it can not be asked.
    Tared(Option<Wrench>),
    /// The calibration in the sensor's memory.
    Calibration(Calibration),
}

/// Why a command that was begun has not ended well.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CommandFailed {
    /// The bus did not take the command: the board knows nothing of it.
    #[error("the command could not be sent")]
    NotSent,
    /// The command was sent, and the questions after it were not answered.
    #[error("the board did not confirm it: whether it took effect is not known")]
    NoAnswer,
    /// The device was started again or stopped meanwhile.
    #[error("the device was restarted meanwhile: whether it took effect is not known")]
    Interrupted,
}

/// The outputs of a device that the configuration uses.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Outputs(pub ArrayVec<u8, { Decoded::MOST }>);

/// The settings common to all drivers.
#[derive(Debug, Clone, PartialEq)]
pub struct Spec {
    /// The device's address, as its protocol defines it.
    pub address: u32,
    /// Maximum silence \[ns\].
    pub max_silence: Nanos,
    /// Whether to command the device or only listen.
    pub mode: Mode,
    /// The outputs that are joints ([`OutputInfo::number`]); empty for sensors.
    pub outputs: Outputs,
}

impl Spec {
    /// The same in another mode.
    #[must_use]
    pub fn in_mode(&self, mode: Mode) -> Self {
        Self {
            mode,
            ..self.clone()
        }
    }
}

/// A configuration that a driver cannot use.
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
    /// A key has an invalid value.
    #[error("{key} = {value} must be {expected}")]
    Key {
        /// The key.
        key: &'static str,
        /// What was given.
        value: f64,
        /// What would be legal.
        expected: &'static str,
    },
    /// A key that is not a number, or a combination of keys, is invalid.
    #[error("{key} must be {expected}")]
    Keys {
        /// The key.
        key: &'static str,
        /// What would be legal.
        expected: &'static str,
    },
    /// Two keys belong together and one is missing.
    #[error("{missing} is missing: it is needed together with {given}")]
    Incomplete {
        /// The key that is given.
        given: &'static str,
        /// The key that is missing.
        missing: &'static str,
    },
    /// A joint's channel does not exist in the device.
    #[error("joint channel {channel} does not exist; this device has channels {least} to {most}")]
    Channel {
        /// What was given.
        channel: u8,
        /// The lowest.
        least: u8,
        /// The highest.
        most: u8,
    },
    /// What the keys say of a description ([`Driver::description`]) does not fit it.
    #[error("{0}")]
    Description(String),
    /// A joint device without a joint, or a sensor with joints.
    #[error("{0}")]
    Joints(&'static str),
}

impl SpecError {
    /// [`SpecError::Key`].
    pub(crate) fn key(key: &'static str, value: impl Into<f64>, expected: &'static str) -> Self {
        let value = value.into();
        Self::Key {
            key,
            value,
            expected,
        }
    }

    /// [`SpecError::Keys`].
    pub(crate) const fn keys(key: &'static str, expected: &'static str) -> Self {
        Self::Keys { key, expected }
    }
}

/// The host's side of a device: decoder and bring-up in one state machine.
///
/// It never reads a clock: frames carry their stamps, and the caller passes the time.
pub trait Device: Send {
    /// The identifiers it receives. The gateway rejects a plan with overlapping exclusive claims
    /// and sets the kernel's filters from the claims.
    fn claims(&self) -> &[Claim];

    /// Decodes a frame with one of its identifiers and adds the result to `out`. Any frame is legal
    /// input.
    fn on_frame(&mut self, frame: &Frame, out: &mut Decoded);

    /// Another device of this host has sent `frame` at its stamp: the interface does not return
    /// what it sends. There is no reading in it.
    fn overhear(&mut self, frame: &Frame, out: &mut Decoded) {
        let _ = (frame, out);
    }

    /// The next frame to send at `now`. While the outcome of the last one is open
    /// ([`Device::on_sent`]), and in [`Mode::Listen`], there is none.
    ///
    /// Events that only the passing of time shows (a silence, a start) are added to `out`, also in
    /// [`Mode::Listen`].
    fn poll_transmit(&mut self, now: Nanos, out: &mut Decoded) -> Option<Transmit>;

    /// What became of `frame`, which [`Device::poll_transmit`] gave: when the interface took it
    /// \[ns\], or why it did not. Must be called once for each such frame.
    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>);

    /// When to call [`Device::poll_transmit`] again even if no frame comes \[ns\].
    fn next_wake(&self) -> Option<Nanos>;

    /// The state of its bring-up.
    fn state(&self) -> State;

    /// Begins to stop: [`Device::poll_transmit`] yields the stop commands, then the state is
    /// [`State::Stopped`].
    fn stop(&mut self, now: Nanos);

    /// Starts again at `now` after a link loss, because the board may have been reset.
    fn restart(&mut self, now: Nanos);

    /// Of a device that streams: why a value that it sends is not in its readings.
    fn lacks(&self) -> Option<Refusal> {
        None
    }

    /// The largest magnitudes fx fy fz tx ty tz for which an F/T sensor is made \[N, Nm\], if they
    /// are known: values may be beyond them.
    fn full_scale(&self) -> Option<[f64; 6]> {
        None
    }

    /// Changes the maximum silence \[ns\] from now on.
    fn set_max_silence(&mut self, max_silence: Nanos);

    /// Begins `command` at `now`. Its frames leave through [`Device::poll_transmit`] while readings
    /// go on, and [`Device::outcome`] tells how it ended.
    ///
    /// # Errors
    /// [`CommandRefused`]: nothing was begun, and there will be no outcome.
    fn command(&mut self, command: Command, now: Nanos) -> Result<(), CommandRefused> {
        let _ = (command, now);
        Err(CommandRefused::Unsupported)
    }

    /// How the last command ended; `None` while it is under way. Each outcome is given once, and
    /// it comes within [`COMMAND_TIME`] as long as the device is polled.
    fn outcome(&mut self) -> Option<Result<CommandOutcome, CommandFailed>> {
        None
    }
}

/// The longest time from a command to its outcome. A board answers within milliseconds. A tare of
/// six questions gets over an answer lost to each; a calibration of 42 over a few in all.
pub const COMMAND_TIME: Nanos = Nanos::from_millis(1000);

/// A driver: implemented by the type of its keys, of which a value is one device.
pub trait Driver {
    /// Its name in gateway.toml: that of its file.
    const NAME: &'static str;
    /// The address of a device whose table has none: the one that its maker delivers it with. None
    /// if each device needs an address of its own.
    const ADDRESS: Option<u32> = None;

    /// Whether a device with these keys needs frames of CAN FD.
    fn needs_fd(&self) -> bool {
        false
    }

    /// Whether it is known how often its devices send.
    fn states_period(&self) -> bool {
        true
    }

    /// The .dbc file that the keys name, relative to the configuration.
    fn description(&self) -> Option<&str> {
        None
    }

    /// Takes the messages of that file, before anything else is asked of it.
    fn describe(&mut self, messages: Vec<Message>) {
        let _ = messages;
    }

    /// The EDS or DCF file that the keys name, relative to the configuration.
    fn eds(&self) -> Option<&str> {
        None
    }

    /// Takes the objects of that file, before anything else is asked of it.
    fn describe_objects(&mut self, objects: Objects) {
        let _ = objects;
    }

    /// The outputs of a device with these keys, in the order of its channels. None: it takes part
    /// in the bus and measures nothing.
    fn outputs(&self) -> Vec<OutputInfo>;

    /// The host's side of one device. The joints of `spec` are outputs of this driver.
    ///
    /// # Errors
    /// [`SpecError`]: an address or value that is invalid for the family.
    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError>;
}
