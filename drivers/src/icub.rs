//! Common parts of the CAN protocol of iCub, R1 and ergoCub boards: identifiers, commands,
//! bring-up, management.
//!
//! | part of the 11-bit identifier | bits | meaning |
//! |---|---|---|
//! | CLS | 10:8 | class: [`class`] |
//! | SRC | 7:4 | address of the sender: 0 the host, 1 to 14 the boards |
//! | X | 3:0 | command class (0, 2, 7): address of the receiver, 15 for all |
//! | | | streaming class: type of the stream |
//!
//! In a command class the first byte is the command and a reply swaps sender and receiver: `20A`
//! asks board 10, `2A0` answers. In a streaming class there is no command byte. Most commands that
//! set or start something are not acknowledged.
//!
//! Sources: robotology/icub-firmware `TSD-ICUBUNIT-canprotocol-sensorboards.docx` v1.12 (25 Nov
//! 2024) and the firmware under `emBODY/eBcode/arch-arm/embot` at b4299211;
//! robotology/icub-firmware-shared `can/canProtocolLib` at 62f2818a; the hosts in
//! robotology/icub-main at 24c1a003. Certain (document and independent code agree), unless stated
//! otherwise.
//!
//! # Bring-up
//! `Bringup` is the part of a [`crate::Device`] that asks, starts, watches, restarts and stops a
//! board:
//!
//! ```text
//! Waiting --power_on_silence--> Asking --answers--> Starting --first reading--> Streaming
//!                                 ^                    |                          | (2)
//!                                 |                    v (1)                      v
//!                                 +--------------------+<----------------------- Silent
//! ```
//! (1) No reading: again, doubling the wait. (2) No reading for `max_silence`: counted once.
//!
//! After power-up these boards wait 5 s in their bootloader, and *any* frame on the bus makes them
//! stay there. If boards are powered together with the host, set `power_on_silence_ms = 6000`: this
//! host then stays silent that long at start and before each attempt to wake a silent board. It
//! cannot keep other senders silent. A reading ends the wait at once, because a board that streams
//! has left its bootloader.

use crate::{
    Claim, Decoded, Format, Frame, Frames, Id, Mode, Refusal, Spec, SpecError, State, Transmit,
};
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Nanos, StampKind};

/// The classes of messages: bits 10:8 of the identifier.
pub mod class {
    /// Commands to motor boards.
    pub const POLLING_MOTOR: u16 = 0;
    /// Streams of motor boards.
    pub const PERIODIC_MOTOR: u16 = 1;
    /// Commands to sensor boards.
    pub const POLLING_ANALOG: u16 = 2;
    /// Streams of F/T sensors, encoders and thermometers.
    pub const PERIODIC_ANALOG: u16 = 3;
    /// Streams of tactile sensors.
    pub const PERIODIC_SKIN: u16 = 4;
    /// Streams of IMUs.
    pub const PERIODIC_INERTIAL: u16 = 5;
    /// Bootloader and management.
    pub const MANAGEMENT: u16 = 7;
}

/// Commands: the first byte in a command class.
pub mod command {
    /// Class 2: start or stop streaming, `[07, mode]`.
    pub const SET_TXMODE: u8 = 0x07;
    /// Class 2: period of the streams, `[08, ms]`. (The document's drawing shows 07; its example,
    /// the header and the code 08.)
    pub const SET_CANDATARATE: u8 = 0x08;
    /// Class 2: `[18, set << 4 | channel]`, answered by `[18, set << 4 | channel, high, low]`.
    pub const GET_FULL_SCALES: u8 = 0x18;
    /// Class 2: `[1C, protocol major, minor]`, answered by `[1C, board, major, minor, build,
    /// protocol major, minor, fits]`.
    pub const GET_FIRMWARE_VERSION: u8 = 0x1C;
    /// Class 2: `[33]`, answered by 8 bytes like those of [`IMU_CONFIG_SET`].
    pub const IMU_CONFIG_GET: u8 = 0x33;
    /// Class 2: `[34, mask low, mask high, mode, orientation, 0, 0, 0]`.
    pub const IMU_CONFIG_SET: u8 = 0x34;
    /// Class 2: `[35, period in ms]`, 0 stops.
    pub const IMU_TRANSMIT: u8 = 0x35;
    /// Class 2: `[39, mask]`: the thermometers in use.
    pub const THERMOMETER_CONFIG_SET: u8 = 0x39;
    /// Class 2: `[3A, period in s]`, 0 stops.
    pub const THERMOMETER_TRANSMIT: u8 = 0x3A;
    /// Class 2: `[4F, mask, period in ms]`: legacy accelerometer and gyroscope.
    pub const ACC_GYRO_SETUP: u8 = 0x4F;
    /// Class 2: `[52, id << 4 | type, sensor 0 (3 bytes), sensor 1 (3 bytes)]`.
    pub const POS_CONFIG_SET: u8 = 0x52;
    /// Class 2: `[53, period in ms]`, 0 stops.
    pub const POS_TRANSMIT: u8 = 0x53;
    /// Class 0: as [`GET_FIRMWARE_VERSION`].
    pub const MOTOR_GET_FIRMWARE_VERSION: u8 = 0x5B;
    /// Class 7: `[FF]` to everyone, answered by `[FF, board, major, minor, build]`.
    pub const DISCOVER: u8 = 0xFF;
}

/// Board types, as boards name themselves.
pub mod board {
    /// mtb: skin and legacy inertial sensors.
    pub const MTB: u8 = 0x05;
    /// 2foc: motor control.
    pub const TWO_FOC: u8 = 0x08;
    /// strain2: F/T and IMU.
    pub const STRAIN2: u8 = 0x0C;
    /// psc: finger encoders.
    pub const PSC: u8 = 0x0F;
}

/// The address that all boards listen to.
pub const BROADCAST: u8 = 15;
/// The lowest and the highest address of a board.
pub const ADDRESSES: core::ops::RangeInclusive<u32> = 1..=14;

/// A command from the host to board `address` in a command class.
#[must_use]
pub const fn to_board(class: u16, address: u8) -> Id {
    Id::standard(class << 8 | (address as u16 & 0xF))
}

/// A reply of board `address` to the host in a command class.
#[must_use]
pub const fn to_host(class: u16, address: u8) -> Id {
    Id::standard(class << 8 | (address as u16 & 0xF) << 4)
}

/// The stream of type `kind` of board `address` in a streaming class.
#[must_use]
pub const fn stream(class: u16, address: u8, kind: u8) -> Id {
    Id::standard(class << 8 | (address as u16 & 0xF) << 4 | (kind as u16 & 0xF))
}

/// The address of `spec`, if boards of this protocol can have it.
///
/// # Errors
/// [`SpecError::Address`].
pub fn address(spec: &Spec) -> Result<u8, SpecError> {
    let (least, most) = (*ADDRESSES.start(), *ADDRESSES.end());
    match u8::try_from(spec.address) {
        Ok(address) if ADDRESSES.contains(&spec.address) => Ok(address),
        _ => Err(SpecError::Address {
            address: spec.address,
            least,
            most,
        }),
    }
}

/// The silence after power-on, from the key `power_on_silence_ms`.
///
/// # Errors
/// [`SpecError::Key`] above a minute.
pub(crate) fn power_on_silence(ms: u32) -> Result<Nanos, SpecError> {
    if ms > 60_000 {
        return Err(SpecError::Key {
            key: "power_on_silence_ms",
            value: f64::from(ms),
            expected: "at most 60000",
        });
    }
    Ok(Nanos::from_millis(i64::from(ms)))
}

/// A period in ms that fits in a byte.
///
/// # Errors
/// [`SpecError::Key`] outside 1 to 255.
pub(crate) fn period_ms(key: &'static str, ms: u32) -> Result<u8, SpecError> {
    match u8::try_from(ms) {
        Ok(byte) if byte > 0 => Ok(byte),
        _ => Err(SpecError::Key {
            key,
            value: f64::from(ms),
            expected: "an integer from 1 to 255",
        }),
    }
}

/// Checks that a sensor has no joints.
///
/// # Errors
/// [`SpecError::Joints`].
pub(crate) fn no_joints(spec: &Spec) -> Result<(), SpecError> {
    if spec.outputs.0.is_empty() {
        Ok(())
    } else {
        Err(SpecError::Joints("this device measures no joint"))
    }
}

/// Little-endian 16 bits at `at`; 0 beyond the end (callers have checked the length).
pub(crate) fn u16_le(data: &[u8], at: usize) -> u16 {
    match data.get(at..at + 2) {
        Some(&[low, high]) => u16::from_le_bytes([low, high]),
        _ => 0,
    }
}

/// As [`u16_le`], in two's complement.
pub(crate) fn i16_le(data: &[u8], at: usize) -> i16 {
    u16_le(data, at).cast_signed()
}

/// Little-endian 32 bits at `at`; 0 beyond the end.
pub(crate) fn u32_le(data: &[u8], at: usize) -> u32 {
    u32::from(u16_le(data, at)) | u32::from(u16_le(data, at + 2)) << 16
}

/// `value` in units of `lsb`, rounded to the nearest integer and limited to `least..=most`. `value`
/// must be finite.
#[allow(clippy::cast_possible_truncation)]
pub(crate) fn quantise(value: f64, lsb: f64, least: i64, most: i64) -> i64 {
    let scaled = value / lsb;
    // The cast truncates towards zero and saturates: adding half a unit away from zero rounds.
    let nearest = (scaled + if scaled < 0.0 { -0.5 } else { 0.5 }) as i64;
    nearest.clamp(least, most)
}

/// As [`quantise`], to 16 bits in two's complement.
#[allow(clippy::cast_possible_truncation)]
pub(crate) fn quantise_i16(value: f64, lsb: f64) -> i16 {
    quantise(value, lsb, i64::from(i16::MIN), i64::from(i16::MAX)) as i16
}

/// Whether `later` is at most `most` after `earlier`. Without stamps nothing expires.
pub(crate) fn within(earlier: (Nanos, StampKind), later: (Nanos, StampKind), most: Nanos) -> bool {
    if earlier.1 == StampKind::None || later.1 == StampKind::None {
        return true;
    }
    let passed = later.0 - earlier.0;
    passed >= Nanos::ZERO && passed <= most
}

/// The result of adding a half to a [`Pairing`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Paired<T> {
    /// The half waits for its other half.
    Waiting,
    /// The half completes this one, whose frame has this stamp.
    With(Nanos, StampKind, T),
    /// The half cannot be used.
    Alone,
}

/// Combines the two halves of a reading in a protocol without sequence numbers. Never combines
/// halves of different readings.
///
/// A board sends the two halves back to back, always in the same order. So a second half belongs to
/// the first half before it, if that arrived no longer than `timeout` ago. If a first half follows
/// a first half, the missing second half is lost *or late*, and the next second half may be the
/// late one or the right one: its contents do not show which. Therefore it is dropped together with
/// its first half: one more reading is lost, but none is wrong. After that a second half must
/// follow its first as quickly as usual on this bus, until one does or a surplus second half shows
/// that one was late.
///
/// One case cannot be distinguished from a good pair: a second half that arrives between a first
/// half and its own second half and is late by more than two periods, or had lost its first half,
/// or is not the only late one in a row.
#[derive(Debug)]
pub(crate) struct Pairing<T> {
    /// The longest time from the first half to the second.
    timeout: Nanos,
    /// Whether the first half always comes first. If not, either half waits for the other.
    ordered: bool,
    pending: Option<(bool, Nanos, StampKind, T)>,
    /// A second half is missing and may still arrive.
    owed: bool,
    /// A second half may still arrive, unless it was in the dropped pair.
    doubt: bool,
    /// Usual delay of second halves: a running mean.
    usual: Option<Nanos>,
}

/// Margin beyond twice the usual delay: the duration of a frame on the bus.
const USUAL_SLACK: Nanos = Nanos::from_micros(125);

impl<T: Copy> Pairing<T> {
    pub(crate) const fn new(timeout: Nanos, ordered: bool) -> Self {
        Self {
            timeout,
            ordered,
            pending: None,
            owed: false,
            doubt: false,
            usual: None,
        }
    }

    /// Adds the half in `frame` and counts the halves that are now known to be unpaired.
    pub(crate) fn push(
        &mut self,
        second: bool,
        frame: &Frame,
        half: T,
        unpaired: &mut u32,
    ) -> Paired<T> {
        let waiting = (second, frame.t, frame.stamp, half);
        let Some((was_second, t, stamp, other)) = self.pending.take() else {
            if second && self.ordered {
                // Either its first half was lost, or it is the missing second half.
                self.owed = false;
                self.doubt = false;
                *unpaired += 1;
                return Paired::Alone;
            }
            self.pending = Some(waiting);
            return Paired::Waiting;
        };
        if was_second == second {
            *unpaired += 1;
            self.owed = true;
            self.pending = Some(waiting);
            return Paired::Waiting;
        }
        let in_time = within((t, stamp), (frame.t, frame.stamp), self.timeout);
        let usual = match self.usual {
            Some(usual) => usual + usual + USUAL_SLACK,
            None => Nanos(self.timeout.0 / 2),
        };
        if in_time
            && !self.owed
            && (!self.doubt || within((t, stamp), (frame.t, frame.stamp), usual))
        {
            self.doubt = false;
            let (passed, usual) = ((frame.t - t).0, self.usual.unwrap_or(frame.t - t).0);
            self.usual = Some(Nanos(usual + (passed - usual) / 8));
            return Paired::With(t, stamp, other);
        }
        self.doubt |= self.owed;
        self.owed = false;
        *unpaired += 1;
        if self.ordered || in_time {
            *unpaired += 1;
            return Paired::Alone;
        }
        self.pending = Some(waiting);
        Paired::Waiting
    }

    /// Drops the waiting half.
    pub(crate) fn reset(&mut self) {
        self.pending = None;
        self.owed = false;
        self.doubt = false;
    }
}

/// The questions that a board must answer before it can be started.
pub(crate) trait Inquiry {
    /// Starts again: the board may have been reset or replaced.
    fn begin(&mut self);
    /// The next step at `now`.
    fn poll(&mut self, now: Nanos) -> Ask;
    /// Time of the next poll.
    fn wake(&self) -> Option<Nanos>;
    /// Why the board cannot be used.
    fn refusal(&self) -> Option<Refusal>;
}

/// The next step of an [`Inquiry`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Ask {
    /// Send this question.
    Send(Frame),
    /// Wait for the answer.
    Wait,
    /// All questions are answered.
    Done,
}

/// An inquiry without questions.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NoInquiry;

impl Inquiry for NoInquiry {
    fn begin(&mut self) {}
    fn poll(&mut self, _now: Nanos) -> Ask {
        Ask::Done
    }
    fn wake(&self) -> Option<Nanos> {
        None
    }
    fn refusal(&self) -> Option<Refusal> {
        None
    }
}

/// Time to wait for an answer before the question is repeated. A board answers within a few ms;
/// icub-main repeats after 20 ms.
pub(crate) const ANSWER_TIMEOUT: Nanos = Nanos::from_millis(20);
/// Number of attempts at that pace, as in icub-main; then the board counts as not answering.
pub(crate) const ATTEMPTS: u8 = 15;
/// Interval between attempts after that: a board that is powered later starts within this time, at
/// the cost of one or two frames a second.
pub(crate) const SLOW_ATTEMPT: Nanos = Nanos::from_millis(500);
/// How long after a question its answer is accepted: slow boards answer the first attempt after the
/// second was sent.
pub(crate) const ANSWER_COUNTS: Nanos = Nanos::from_millis(1000);
/// Time from start to first reading, in addition to the maximum silence: an IMU changes its fusion
/// mode meanwhile. Doubled with each attempt up to [`START_PATIENCE_MOST`].
const START_PATIENCE: Nanos = Nanos::from_millis(250);
/// The longest time between two attempts to start.
const START_PATIENCE_MOST: Nanos = Nanos::from_millis(500);
/// A command that could not be sent for this long is dropped; the next attempt sends it again.
const SEND_WITHIN: Nanos = Nanos::from_millis(100);

/// The phase of the bring-up.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// Not begun.
    Fresh,
    /// Keeping silent.
    Waiting { until: Nanos },
    /// Asking.
    Asking,
    /// Sending the start commands.
    Starting { next: usize },
    /// All start commands sent; repeated if no reading arrives.
    Watching { until: Nanos },
    /// Sending the stop commands.
    Stopping { next: usize },
    /// Done.
    Stopped,
}

/// Asks, starts, watches, restarts and stops one board (state machine in the module documentation).
#[derive(Debug)]
pub(crate) struct Bringup {
    mode: Mode,
    max_silence: Nanos,
    power_on_silence: Nanos,
    start: ArrayVec<Frame, 8>,
    stop: ArrayVec<Frame, 4>,
    /// The stream that is watched, for the faults.
    watched: Id,
    phase: Phase,
    patience: Nanos,
    /// Time of the last reading; `None` while the board is silent.
    last: Option<Nanos>,
    silent: bool,
    /// Whether a start sequence was begun since the last known power-on.
    begun: bool,
}

impl Bringup {
    pub(crate) fn new(spec: &Spec, mode: Mode, power_on_silence: Nanos, watched: Id) -> Self {
        Self {
            mode,
            max_silence: spec.max_silence,
            power_on_silence,
            start: ArrayVec::new(),
            stop: ArrayVec::new(),
            watched,
            phase: Phase::Fresh,
            patience: START_PATIENCE,
            last: None,
            silent: false,
            begun: false,
        }
    }

    /// Adds a start command.
    pub(crate) fn start_with(&mut self, id: Id, data: &[u8]) {
        let fits = self.start.try_push(Frame::new(id, data));
        debug_assert!(
            fits.is_ok(),
            "no family here has more than 8 start commands"
        );
    }

    /// Adds a stop command.
    pub(crate) fn stop_with(&mut self, id: Id, data: &[u8]) {
        let fits = self.stop.try_push(Frame::new(id, data));
        debug_assert!(fits.is_ok(), "no family here has more than 4 stop commands");
    }

    pub(crate) const fn mode(&self) -> Mode {
        self.mode
    }

    /// Whether it has been silent for too long.
    pub(crate) const fn is_silent(&self) -> bool {
        self.silent
    }

    /// Whether frames are still processed.
    pub(crate) const fn active(&self) -> bool {
        !matches!(self.phase, Phase::Stopping { .. } | Phase::Stopped)
    }

    /// Records a reading at `t`. Returns whether it is the first after a silence.
    pub(crate) fn reading(&mut self, t: Nanos) -> bool {
        self.last = Some(t);
        if let Phase::Waiting { .. } = self.phase {
            // A board that streams has left its bootloader.
            self.phase = Phase::Waiting { until: Nanos::MIN };
        }
        core::mem::take(&mut self.silent)
    }

    pub(crate) fn poll(
        &mut self,
        now: Nanos,
        inquiry: &mut impl Inquiry,
        out: &mut Decoded,
    ) -> Option<Transmit> {
        if self.active()
            && let Some(last) = self.last
            && now - last > self.max_silence
        {
            self.last = None;
            self.silent = true;
            out.fault(Counter::Silences, 1, self.watched);
            if matches!(self.phase, Phase::Watching { .. }) {
                self.patience = START_PATIENCE;
                self.phase = Phase::Fresh;
            }
        }
        // Each turn returns or advances to a later phase, so the loop ends.
        loop {
            match self.phase {
                Phase::Fresh if self.mode == Mode::Listen => {
                    self.phase = Phase::Watching { until: Nanos::MAX }
                }
                Phase::Fresh => {
                    let until = if self.power_on_silence > Nanos::ZERO {
                        now + self.power_on_silence
                    } else {
                        Nanos::MIN
                    };
                    self.phase = Phase::Waiting { until };
                }
                Phase::Waiting { until } if now < until => return None,
                Phase::Waiting { .. } => {
                    out.fault(Counter::Starts, 1, self.watched);
                    self.begun = true;
                    inquiry.begin();
                    self.phase = Phase::Asking;
                }
                Phase::Asking => match inquiry.poll(now) {
                    Ask::Send(frame) => {
                        return Some(Transmit {
                            frame,
                            deadline: now + ANSWER_TIMEOUT,
                        });
                    }
                    Ask::Wait => return None,
                    Ask::Done => self.phase = Phase::Starting { next: 0 },
                },
                Phase::Starting { next } => {
                    if let Some(&frame) = self.start.get(next) {
                        self.phase = Phase::Starting { next: next + 1 };
                        return Some(Transmit {
                            frame,
                            deadline: now + SEND_WITHIN,
                        });
                    }
                    self.phase = Phase::Watching {
                        until: now + self.max_silence + self.patience,
                    };
                    self.patience = START_PATIENCE_MOST.min(self.patience + self.patience);
                    return None;
                }
                Phase::Watching { until } if self.last.is_some() || now < until => return None,
                Phase::Watching { .. } if self.mode == Mode::Listen => return None,
                Phase::Watching { .. } => self.phase = Phase::Fresh,
                Phase::Stopping { next } => {
                    if let Some(&frame) = self.stop.get(next) {
                        self.phase = Phase::Stopping { next: next + 1 };
                        return Some(Transmit {
                            frame,
                            deadline: now + SEND_WITHIN,
                        });
                    }
                    self.phase = Phase::Stopped;
                }
                Phase::Stopped => return None,
            }
        }
    }

    pub(crate) fn next_wake(&self, inquiry: &impl Inquiry) -> Option<Nanos> {
        let silence = self.last.map(|last| last + self.max_silence + Nanos(1));
        let phase = match self.phase {
            Phase::Fresh | Phase::Starting { .. } | Phase::Stopping { .. } => Some(Nanos::MIN),
            Phase::Waiting { until } => Some(until),
            Phase::Asking => inquiry.wake(),
            Phase::Watching { until } => {
                (self.last.is_none() && until < Nanos::MAX).then_some(until)
            }
            Phase::Stopped => return None,
        };
        match (silence, phase) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }

    pub(crate) fn state(&self, inquiry: &impl Inquiry) -> State {
        if self.phase == Phase::Stopped {
            return State::Stopped;
        }
        if let Some(refusal) = inquiry.refusal() {
            return State::Refused(refusal);
        }
        match self.phase {
            _ if self.last.is_some() => State::Streaming,
            _ if self.silent => State::Silent,
            Phase::Fresh if self.mode == Mode::Listen => State::Starting,
            Phase::Fresh | Phase::Waiting { .. } => State::Waiting,
            Phase::Asking => State::Asking,
            Phase::Starting { .. }
            | Phase::Watching { .. }
            | Phase::Stopping { .. }
            | Phase::Stopped => State::Starting,
        }
    }

    pub(crate) fn stop(&mut self) {
        // Sends nothing while the bus must be silent, or to a board that another program commands.
        let waiting = matches!(self.phase, Phase::Fresh | Phase::Waiting { .. });
        let quiet = self.mode == Mode::Listen
            || !self.begun
            || (waiting && self.power_on_silence > Nanos::ZERO);
        if self.active() {
            self.phase = if quiet {
                Phase::Stopped
            } else {
                Phase::Stopping { next: 0 }
            };
        }
        self.last = None;
    }

    pub(crate) fn restart(&mut self) {
        if self.active() {
            self.phase = Phase::Fresh;
            self.patience = START_PATIENCE;
            self.last = None;
            self.silent = false;
        }
    }
}

/// The type of a frame of streaming class `class` of board `address`, if it is one.
pub(crate) const fn stream_type(id: Id, class: u16, address: u8) -> Option<u8> {
    match id {
        Id::Standard(raw) if raw >> 4 == class << 4 | address as u16 => Some((raw & 0xF) as u8),
        _ => None,
    }
}

/// The payload of a classic data frame. Other frames are counted, except error frames, which belong
/// to no device.
pub(crate) fn payload<'f>(frame: &'f Frame, out: &mut Decoded) -> Option<&'f [u8]> {
    match frame.format {
        Format::Classic => return Some(frame.data()),
        Format::Fd { .. } => out.fault(Counter::Value, 1, frame.id),
        Format::Remote => out.fault(Counter::Length, 1, frame.id),
        Format::Error => {}
    }
    None
}

/// Claims on the streams `kinds` of a class.
pub(crate) fn claims<const N: usize>(class: u16, address: u8, kinds: &[u8]) -> ArrayVec<Claim, N> {
    kinds
        .iter()
        .map(|&kind| Claim::exclusive(stream(class, address, kind)))
        .take(N)
        .collect()
}

/// The bytes of a command of class `class` to board `address` in `frame`, starting with the command
/// byte.
pub(crate) fn command_for(frame: &Frame, class: u16, address: u8) -> Option<&[u8]> {
    let broadcast = to_board(class, BROADCAST);
    let ours = frame.id == to_board(class, address) || frame.id == broadcast;
    (ours && frame.format == Format::Classic && !frame.is_empty()).then(|| frame.data())
}

/// Answers the management requests: board type and firmware version (a plausible one: 2.0.8,
/// protocol 2.0).
pub(crate) fn answer_management(
    frame: &Frame,
    class: u16,
    address: u8,
    board: u8,
    out: &mut Frames,
) {
    const FIRMWARE: [u8; 3] = [2, 0, 8];
    let [major, minor, build] = FIRMWARE;
    if let Some([command::DISCOVER]) = command_for(frame, class::MANAGEMENT, address) {
        let id = to_host(class::MANAGEMENT, address);
        let _ = out.try_push(Frame::new(
            id,
            &[command::DISCOVER, board, major, minor, build],
        ));
    }
    let version = if class == class::POLLING_MOTOR {
        command::MOTOR_GET_FIRMWARE_VERSION
    } else {
        command::GET_FIRMWARE_VERSION
    };
    if let Some(&[command, want_major, want_minor]) = command_for(frame, class, address)
        && command == version
    {
        let fits = u8::from(want_major == 2 && want_minor == 0);
        let _ = out.try_push(Frame::new(
            to_host(class, address),
            &[version, board, major, minor, build, 2, 0, fits],
        ));
    }
}
