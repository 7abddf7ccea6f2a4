//! What is on a bus: the traffic of its identifiers ([`Traffic`]), and what a driver concludes from
//! it ([`Finding`]).
//!
//! **One principle.** Each device that a driver knows, at each address that it may have, is a
//! hypothesis. What was heard has a probability if the device is there, and another if *some other
//! device* sent it; the ratio of both, in bits (its logarithm to base 2), speaks for the device. A
//! driver states what its device sends, as rules for frames; how often other devices would fulfil
//! them is measured (`background.rs`). Frames that a device does not send, on an identifier that is
//! its own, refute it; CAN FD is such a frame for a device of classic CAN.
//!
//! **Prior.** A bus has a device of a driver once in 32 times (5 bits: there are about 25 drivers,
//! and half of the buses have devices that none knows), and it has each of the driver's addresses
//! equally often: with 127 of them, 7 bits more. This is the price of trying them all. Where one of
//! a family is sure, the next costs 1 bit instead of 5.
//!
//! **Together** (`explain.rs`). A frame comes from one device. Of those that would explain the same
//! frames the most probable one is there, and they count against the others.
//!
//! So the sum of the bits is the odds that the device is there, and a finding has a probability:
//!
//! | word | probability of | on a bus without such a device, at most one of |
//! |---|---|---|
//! | possible | 10 % | 1 bus |
//! | likely | 99 % | 120 buses |
//! | certain | 99.9999 % | 1.2 million buses |
//!
//! The last column follows from the prior, whatever the address: for odds of 99 to 1 what was heard
//! must be 31 * 99 times as probable with the device as without it, which happens once in so many
//! buses, for each of 25 drivers. Measured, with contents made up as those of cars are, on the
//! identifiers of the 109 .dbc files with messages of opendbc 7343a66d, eight times each: something
//! was possible on 224 of 872 buses, and likely on one.

mod background;
mod explain;
mod traffic;

pub(crate) use explain::explain as together;
pub use traffic::{Stream, Traffic};

use crate::{Driver, Format, Frame, Id};
use alloc::string::{String, ToString};
use alloc::vec::Vec;
pub(crate) use background::log2;
use core::ops::RangeInclusive;
use proprio_topics::Nanos;

/// A bus has a device of one driver once in 2^5 times.
const PRIOR: f64 = 5.0;
/// The part of an identifier's frames that may be others, before it refutes a device: frames of a
/// node that has just left its bootloader, for example.
const ODD: f64 = 0.05;

/// How sure a finding is; the top of this file tells what it means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Certainty {
    /// A probability of 10 % or more.
    Possible,
    /// Of 99 % or more.
    Likely,
    /// Of 99.9999 % or more.
    Certain,
}

impl Certainty {
    /// Odds of 1 to 9 \[bits\].
    pub(crate) const POSSIBLE: f64 = -3.17;
    /// Odds of 99 to 1 \[bits\].
    pub(crate) const LIKELY: f64 = 6.63;
    /// Odds of 999,999 to 1 \[bits\].
    pub(crate) const CERTAIN: f64 = 19.93;

    /// In a word.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Possible => "possible",
            Self::Likely => "likely",
            Self::Certain => "certain",
        }
    }
}

/// A key for the device's table in gateway.toml.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key {
    /// Its name.
    pub name: &'static str,
    /// Its value, as TOML writes it.
    pub value: String,
    /// What a person has to fill in; empty if it is as found.
    pub note: &'static str,
}

impl Key {
    /// A key as found.
    #[must_use]
    pub fn new(name: &'static str, value: impl ToString) -> Self {
        Self {
            name,
            value: value.to_string(),
            note: "",
        }
    }

    /// A key that nobody but a person knows: `value` is a placeholder.
    #[must_use]
    pub fn fill_in(name: &'static str, value: impl ToString, note: &'static str) -> Self {
        Self {
            note,
            ..Self::new(name, value)
        }
    }

    /// `period_ms`, if `period` is within `least` to `most` milliseconds.
    pub(crate) fn period_ms(period: Option<Nanos>, least: i64, most: i64) -> Option<Self> {
        let period = period?;
        let ms = (period.0 + 500_000) / 1_000_000;
        (least..=most)
            .contains(&ms)
            .then(|| Self::new("period_ms", ms))
    }
}

/// How a device has an identifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IdUse {
    /// It alone sends its frames, or answers to them. With a number, only those frames of it that
    /// have this number: other devices of its family send the others.
    Sends(Option<u8>),
    /// It tells what it is: to other drivers of the same board, too.
    Tells,
    /// It takes commands on it that say nothing of the device.
    Takes,
}

/// An identifier that a device explains.
#[derive(Debug, Clone, PartialEq)]
pub struct Explained {
    /// The identifier.
    pub id: Id,
    /// How the device has it.
    pub part: IdUse,
    /// What the form of its frames counts \[bits\].
    bits: f64,
    /// Other identifiers whose frames have that form.
    alike: Vec<Id>,
}

/// A device that a driver recognises.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Finding {
    /// The driver.
    pub driver: &'static str,
    /// The device's address, as the driver defines it.
    pub address: u32,
    /// The odds that it is there, as a logarithm to base 2; of a driver's own
    /// [`Recognise::recognise`] without what its identifiers count.
    pub bits: f64,
    /// What it is, in words: type, firmware, serial number, as far as it is known.
    pub what: String,
    /// Keys for its table in gateway.toml.
    pub keys: Vec<Key>,
    /// The channels of its joints.
    pub joints: Vec<u8>,
    /// The identifiers whose frames are explained by it.
    pub explains: Vec<Explained>,
    /// The identifiers on which it takes commands that a question of another family might look
    /// like: such questions are not sent.
    pub commands: Vec<RangeInclusive<Id>>,
    /// Why the driver cannot be used for it; empty if it can.
    pub unusable: &'static str,
    /// It sends when a SYNC of CANopen comes, and nobody sends one.
    pub needs_sync: bool,
    /// The bits speak for a device of which the driver is a guess: it is possible, and no more.
    pub guess: bool,
}

impl Finding {
    /// Whether it explains frames of `id`.
    #[must_use]
    pub fn has(&self, id: Id) -> bool {
        self.explains.iter().any(|explained| explained.id == id)
    }

    /// The probability that it is there. Of a guess it is that of a device that some driver reads.
    #[must_use]
    pub fn probability(&self) -> f64 {
        probability(self.bits)
    }

    /// The probability in percent, with as many digits as tell it from 100.
    #[must_use]
    pub fn percent(&self) -> String {
        let percent = 100.0 * self.probability();
        match percent {
            99.9999.. => ">99.9999 %".into(),
            99.99.. => alloc::format!("{:.4} %", percent.min(99.9999)),
            99.0.. => alloc::format!("{:.2} %", percent.min(99.99)),
            _ => alloc::format!("{percent:.0} %"),
        }
    }

    /// How sure it is; `None` below 10 %.
    #[must_use]
    pub fn certainty(&self) -> Option<Certainty> {
        match self.bits {
            Certainty::POSSIBLE.. if self.guess => Some(Certainty::Possible),
            Certainty::CERTAIN.. => Some(Certainty::Certain),
            Certainty::LIKELY.. => Some(Certainty::Likely),
            Certainty::POSSIBLE.. => Some(Certainty::Possible),
            _ => None,
        }
    }
}

/// What speaks for one device.
#[derive(Debug, Clone)]
pub(crate) struct Evidence<'t> {
    pub(crate) traffic: &'t Traffic,
    bits: f64,
    explains: Vec<Explained>,
    refuted: bool,
    /// Its frames may be CAN FD.
    fd: bool,
}

impl<'t> Evidence<'t> {
    /// Nothing yet for a device of classic CAN that might have one of `addresses` addresses.
    pub(crate) fn new(traffic: &'t Traffic, addresses: usize) -> Self {
        Self {
            traffic,
            bits: -PRIOR - log2(addresses),
            explains: Vec::new(),
            refuted: false,
            fd: false,
        }
    }

    /// As [`Evidence::new`], for a device that sends CAN FD too.
    pub(crate) fn with_fd(traffic: &'t Traffic, addresses: usize) -> Self {
        Self {
            fd: true,
            ..Self::new(traffic, addresses)
        }
    }

    /// What was heard on `id`, if anything was; all its data frames are of the device's format and
    /// fulfil `rule`, or it is refuted.
    fn heard(&mut self, id: Id, rule: &dyn Fn(&Frame) -> bool) -> Option<&'t Stream> {
        let stream = (self.traffic.stream(id)).filter(|stream| stream.frames > 0)?;
        let (mut all, mut odd) = (0_u32, 0_u32);
        for frame in stream.kept() {
            all += 1;
            odd += u32::from(!self.is_own(frame, rule));
        }
        if f64::from(odd) > f64::from(all) * ODD {
            self.refuted = true;
            return None;
        }
        Some(stream)
    }

    fn is_own(&self, frame: &Frame, rule: &dyn Fn(&Frame) -> bool) -> bool {
        (self.fd || frame.format == Format::Classic) && rule(frame)
    }

    /// The device sends `id`, and all its data frames are of its format and fulfil `rule`: it
    /// refuses every length and value that the device does not send. How rare that is, is measured;
    /// a rule about several bytes together, such as a checksum, counts by [`Evidence::add`].
    /// Returns what was heard on it, if anything was.
    pub(crate) fn sends(&mut self, id: Id, rule: impl Fn(&Frame) -> bool) -> Option<&'t Stream> {
        self.sends_as(IdUse::Sends(None), id, rule)
    }

    /// As [`Evidence::sends`], for an identifier that several devices of the family may share.
    pub(crate) fn sends_as(
        &mut self,
        part: IdUse,
        id: Id,
        rule: impl Fn(&Frame) -> bool,
    ) -> Option<&'t Stream> {
        let stream = self.heard(id, &rule)?;
        let bits = background::form(stream, &|frame| self.is_own(frame, &rule));
        self.explain(id, part, bits, &rule);
        Some(stream)
    }

    /// As [`Evidence::sends`], for frames of length `length`.
    pub(crate) fn sends_length(&mut self, id: Id, length: usize) -> Option<&'t Stream> {
        self.sends(id, |frame| frame.len() == length)
    }

    /// As [`Evidence::sends`], for a rule that one of 2^`bits` devices fulfils by chance.
    pub(crate) fn sends_rarely(
        &mut self,
        id: Id,
        bits: f64,
        rule: impl Fn(&Frame) -> bool,
    ) -> Option<&'t Stream> {
        let stream = self.heard(id, &rule)?;
        self.explain(id, IdUse::Sends(None), bits, &rule);
        Some(stream)
    }

    /// As [`Evidence::sends`], of a protocol in which a frame without data asks for another of the
    /// same identifier. Questions alone say nothing.
    pub(crate) fn answers(&mut self, id: Id, rule: impl Fn(&Frame) -> bool) -> Option<&'t Stream> {
        let has_answer = (self.traffic.stream(id)).is_some_and(|stream| stream.lengths.1 > 0);
        has_answer.then(|| self.sends(id, |frame| frame.is_empty() || rule(frame)))?
    }

    /// Another program's commands on `id`, of which the device answers each at once by a frame of
    /// `replies` that is its own. That counts 4 bits: one of 16 pairs of streams goes in step by
    /// chance, for one controller often sends several. A log that has replies alone counts three
    /// against it: few recorders leave out what their own computer sends.
    pub(crate) fn is_commanded(
        &mut self,
        id: Id,
        replies: &Stream,
        is_own: impl Fn(&Frame) -> bool,
    ) {
        let Some(commands) = self.traffic.stream(id).filter(|stream| stream.frames > 0) else {
            return self.add(-3.0);
        };
        if follows(commands, replies, &is_own) {
            self.explain(id, IdUse::Sends(None), 4.0, &|_| false);
        } else {
            self.belongs(id);
        }
    }

    fn explain(&mut self, id: Id, part: IdUse, bits: f64, rule: &dyn Fn(&Frame) -> bool) {
        let mut known = self.explains.iter_mut().filter(|known| known.id == id);
        if let Some(known) = known.find(|known| known.part != IdUse::Takes) {
            return known.bits += bits;
        }
        self.explains.retain(|known| known.id != id);
        let alike = background::alike(self.traffic, id, &|frame| self.is_own(frame, rule));
        self.explains.push(Explained {
            id,
            part,
            bits,
            alike,
        });
    }

    /// `id` counts, and `bits` more: on it the board tells what it is.
    pub(crate) fn tells(&mut self, id: Id, bits: f64) {
        self.explain(id, IdUse::Tells, bits, &|_| false);
    }

    /// `id` counts, and `bits` more.
    pub(crate) fn explains(&mut self, id: Id, bits: f64) {
        self.explain(id, IdUse::Sends(None), bits, &|_| false);
    }

    /// `id` is the device's too, which counts nothing.
    pub(crate) fn belongs(&mut self, id: Id) {
        let is_new = self.explains.iter().all(|known| known.id != id);
        if is_new && self.traffic.stream(id).is_some() {
            self.explain(id, IdUse::Takes, 0.0, &|_| false);
        }
    }

    /// `bits` more, or less.
    pub(crate) fn add(&mut self, bits: f64) {
        self.bits += bits;
    }

    /// Something is not heard that the device sends: one of 16 is set up without it.
    pub(crate) fn lacks(&mut self) {
        self.bits -= 4.0;
    }

    /// Whether a motor's position goes on as its velocity says, in frames that `motion` reads:
    /// steps are a multiple of the velocity, but for a tenth of their squares. It need not be known
    /// which. Of other devices one of 64 has two such numbers in the same places. A motor at rest
    /// says nothing.
    pub(crate) fn moves(&mut self, stream: &Stream, motion: impl Fn(&Frame) -> Option<(f64, f64)>) {
        let read = |frame: &Frame| motion(frame).map(|of| (frame.t.seconds(), of.0, of.1));
        let all: Vec<(f64, f64, f64)> = stream.recent().filter_map(read).collect();
        let (mut steps, mut xx, mut xy, mut yy) = (0, 0.0, 0.0, 0.0);
        for ((t, position, velocity), (next, other, after)) in all.iter().zip(all.iter().skip(1)) {
            let (x, y) = ((velocity + after) * (next - t), other - position);
            steps += usize::from(x != 0.0 && y != 0.0);
            (xx, xy, yy) = (xx + x * x, xy + x * y, yy + y * y);
        }
        if steps >= 8 && xy > 0.0 && xy * xy >= 0.9 * xx * yy {
            self.bits += 6.0;
        }
    }

    /// `stream` is a measurement: its frames differ. One of 16 sensors sends the same for long;
    /// half of what other devices send does not change.
    pub(crate) fn measures(&mut self, stream: &Stream) {
        if stream.changing().iter().any(|mask| *mask != 0) {
            self.bits += 1.0;
        } else if stream.frames >= 8 {
            self.bits -= 3.0;
        }
    }

    /// Frames of `second` follow those of `first` at once, which counts 2 bits: of the pairs of
    /// streams with one period, those of one device do.
    pub(crate) fn together(&mut self, first: &Stream, second: &Stream) {
        if follows(first, second, &|_| true) {
            self.bits += 2.0;
        }
    }

    /// Whether `count` of consecutive frames goes up by 0 or 1, and not always by 0: a counter of
    /// 8 bits. One of 32 streams has one in the same place.
    pub(crate) fn counts(&mut self, stream: &Stream, count: impl Fn(&Frame) -> u8) {
        let counts = || stream.recent().map(&count);
        let steps = || {
            counts()
                .skip(1)
                .zip(counts())
                .map(|(b, a)| b.wrapping_sub(a))
        };
        let (all, good) = (steps().count(), steps().filter(|step| *step <= 1).count());
        if all >= 3 && good * 10 >= all * 9 && steps().any(|step| step == 1) {
            self.bits += 5.0;
        }
    }

    /// Whether something speaks for the device and nothing refutes it.
    pub(crate) fn holds(&self) -> bool {
        !self.refuted && self.explains.iter().any(|known| known.part != IdUse::Takes)
    }

    /// Whether it sends something, beside telling what it is.
    pub(crate) fn is_sending(&self) -> bool {
        let is_sent = |known: &Explained| matches!(known.part, IdUse::Sends(_));
        self.explains.iter().any(is_sent)
    }

    /// The device at `address`, if it holds.
    pub(crate) fn finding(
        self,
        driver: &'static str,
        address: u32,
        what: impl Into<String>,
    ) -> Option<Finding> {
        let holds = self.holds();
        let finding = Finding {
            driver,
            address,
            bits: self.bits,
            what: what.into(),
            explains: self.explains,
            ..Finding::default()
        };
        holds.then_some(finding)
    }
}

/// Whether a frame of `second` that `is_own` follows nine of ten of `first` at once: within an
/// eighth of their period, which two devices do once in 8 times.
fn follows(first: &Stream, second: &Stream, is_own: &dyn Fn(&Frame) -> bool) -> bool {
    // Frames without stamps have no period.
    let Some(period) = first.period().filter(|period| *period > Nanos::ZERO) else {
        return false;
    };
    let own_frames = || second.recent().filter(|frame| is_own(frame));
    let near = |a: &&Frame| {
        let mut after = own_frames().map(|b| b.t - a.t);
        after.any(|gap| gap >= Nanos::ZERO && gap.0 * 8 <= period.0)
    };
    // Both have the same number of newest frames: those of one may reach further back.
    let front = own_frames().next().map(|frame| frame.t);
    let late = |a: &&Frame| front.is_none_or(|front| front <= a.t);
    let all = first.recent().filter(late).count();
    let followed = first.recent().filter(late).filter(near).count();
    all >= 3 && followed * 10 >= all * 9
}

/// The probability of odds of so many bits.
fn probability(bits: f64) -> f64 {
    1.0 / (1.0 + libm::exp2(-bits))
}

impl Finding {
    /// With these keys.
    pub(crate) fn with_keys(mut self, keys: impl IntoIterator<Item = Key>) -> Self {
        self.keys.extend(keys);
        self
    }

    /// With commands on these identifiers.
    pub(crate) fn with_commands(
        mut self,
        commands: impl IntoIterator<Item = RangeInclusive<Id>>,
    ) -> Self {
        self.commands.extend(commands);
        self
    }

    /// With joints on these channels.
    pub(crate) fn with_joints(mut self, joints: impl IntoIterator<Item = u8>) -> Self {
        self.joints.extend(joints);
        self
    }
}

/// A driver whose devices can be recognised in the traffic of a bus. What it has by default is that
/// of one that recognises none.
pub trait Recognise: Driver {
    /// The devices that `seen` shows.
    #[must_use]
    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let _ = seen;
        Vec::new()
    }

    /// Questions that make devices tell what they are. They start, move, write and reconfigure
    /// nothing. `seen` is what was heard so far, so that a device that has answered can be asked
    /// for more.
    #[must_use]
    fn questions(seen: &Traffic) -> Vec<Frame> {
        let _ = seen;
        Vec::new()
    }

    /// Some other family takes these questions for commands: they are sent only on a bus of which a
    /// person says that such devices are there.
    const ASKED_BY_NAME: bool = false;
}
