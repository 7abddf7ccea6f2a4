//! What is on a bus: the traffic of its identifiers ([`Traffic`]), and what a driver concludes from
//! it ([`Finding`]).
//!
//! **One principle.** A property of frames speaks for a device by as many *bits* as it is rare: one
//! that arbitrary frames have once in 2^n times counts n bits, once for each identifier. A length
//! counts 3 bits, a constant byte 8, an identifier that the device must have about 11 less the
//! logarithm of how many there are on the bus. The number of addresses that the device might have
//! counts against it: with 127 of them, 7 bits. Frames that the device does not send, on an
//! identifier that is its own, refute it; CAN FD is such a frame for a device of classic CAN.
//!
//! So the bits say how many buses of arbitrary frames there are for one on which a driver finds a
//! device that is not there. With about 20 drivers (4 bits), a *possible* device (8 bits) is found
//! wrongly on one bus of 16, a *likely* one (16) on one of 4000, a *certain* one (32) on one of 250
//! million. Other devices do not send arbitrary frames: where two drivers explain the same frames,
//! more bits win.

use crate::{Format, Frame, Id};
use alloc::collections::{BTreeMap, VecDeque};
use alloc::string::{String, ToString};
use alloc::vec::Vec;
use core::ops::RangeInclusive;
use proprio_topics::Nanos;

/// The newest frames that are kept of each identifier.
const RECENT: usize = 48;
/// The frames that are kept of each identifier because they begin in a new way, such as answers to
/// different questions.
const HEADS: usize = 128;
/// The bytes with which a frame begins.
const HEAD: usize = 4;
/// The part of an identifier's frames that may be others, before it refutes a device: frames of a
/// node that has just left its bootloader, for example.
const ODD: f64 = 0.05;

/// What was heard on one identifier.
#[derive(Debug, Clone)]
pub struct Stream {
    /// The identifier.
    pub id: Id,
    /// Data frames.
    pub frames: u64,
    /// Those of them that are CAN FD.
    pub fd: u64,
    /// Remote requests.
    pub remote: u64,
    /// The shortest and the longest payload \[bytes\].
    pub lengths: (usize, usize),
    /// Stamps of the first and the last data frame \[ns\].
    pub stamps: (Nanos, Nanos),
    /// The bits of the payload that are not the same in all frames.
    changing: [u8; Frame::MAX_LEN],
    /// Each byte as it came first.
    first: [u8; Frame::MAX_LEN],
    recent: VecDeque<Frame>,
    heads: Vec<Frame>,
}

impl Stream {
    const fn new(id: Id) -> Self {
        Self {
            id,
            frames: 0,
            fd: 0,
            remote: 0,
            lengths: (0, 0),
            stamps: (Nanos::ZERO, Nanos::ZERO),
            changing: [0; Frame::MAX_LEN],
            first: [0; Frame::MAX_LEN],
            recent: VecDeque::new(),
            heads: Vec::new(),
        }
    }

    fn on_frame(&mut self, frame: &Frame) {
        match frame.format {
            Format::Classic => {}
            Format::Fd { .. } => self.fd += 1,
            Format::Remote => return self.remote += 1,
            Format::Error => return,
        }
        self.frames += 1;
        let bytes = self.changing.iter_mut().zip(&mut self.first);
        for ((place, (mask, first)), byte) in bytes.enumerate().zip(frame.data()) {
            if place < self.lengths.1 {
                *mask |= *first ^ byte;
            } else {
                *first = *byte;
            }
        }
        if self.frames == 1 {
            (self.lengths, self.stamps.0) = ((frame.len(), frame.len()), frame.t);
        }
        let (least, most) = self.lengths;
        (self.lengths, self.stamps.1) = ((least.min(frame.len()), most.max(frame.len())), frame.t);
        fn head(frame: &Frame) -> (usize, &[u8]) {
            let data = frame.data();
            (data.len(), data.get(..HEAD).unwrap_or(data))
        }
        if self.heads.len() < HEADS && self.heads.iter().all(|known| head(known) != head(frame)) {
            self.heads.push(*frame);
        }
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(*frame);
    }

    /// The frames that are kept: one for each beginning (at most 128), then the newest (at most
    /// 48) in their order.
    pub fn kept(&self) -> impl Iterator<Item = &Frame> {
        self.heads.iter().chain(&self.recent)
    }

    /// The newest frames, at most 48, in their order.
    pub fn recent(&self) -> impl DoubleEndedIterator<Item = &Frame> {
        self.recent.iter()
    }

    /// The bits of the payload that are not the same in all frames, byte by byte.
    #[must_use]
    pub fn changing(&self) -> &[u8] {
        self.changing.get(..self.lengths.1).unwrap_or_default()
    }

    /// The usual time between two frames \[ns\], the median of the newest; `None` of less than
    /// four frames.
    #[must_use]
    pub fn period(&self) -> Option<Nanos> {
        self.period_of(|_| true)
    }

    /// As [`Stream::period`], of the frames for which `is_one` holds.
    #[must_use]
    pub fn period_of(&self, is_one: impl Fn(&Frame) -> bool) -> Option<Nanos> {
        let frames = || self.recent.iter().filter(|frame| is_one(frame));
        let stamps = || frames().map(|frame| frame.t);
        let mut gaps: Vec<Nanos> = stamps().skip(1).zip(stamps()).map(|(b, a)| b - a).collect();
        gaps.sort_unstable();
        (gaps.len() >= 3).then(|| gaps.get(gaps.len() / 2).copied())?
    }

    /// Data frames per second, from the first to the last; 0 of less than two.
    #[must_use]
    pub fn rate(&self) -> f64 {
        let seconds = (self.stamps.1 - self.stamps.0).seconds();
        if self.frames < 2 || seconds <= 0.0 {
            return 0.0;
        }
        #[allow(clippy::cast_precision_loss)] // a count
        let gaps = (self.frames - 1) as f64;
        gaps / seconds
    }
}

/// All that was heard on a bus.
#[derive(Debug, Clone, Default)]
pub struct Traffic(BTreeMap<Id, Stream>);

impl Traffic {
    /// Nothing heard yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a frame of the bus. Error frames are ignored.
    pub fn on_frame(&mut self, frame: &Frame) {
        if frame.format != Format::Error {
            let stream = (self.0.entry(frame.id)).or_insert_with(|| Stream::new(frame.id));
            stream.on_frame(frame);
        }
    }

    /// What was heard on `id`, data frames or remote requests.
    #[must_use]
    pub fn stream(&self, id: Id) -> Option<&Stream> {
        self.0.get(&id)
    }

    /// What was heard, by identifier.
    pub fn streams(&self) -> impl Iterator<Item = &Stream> {
        self.0.values()
    }

    /// The bits that an identifier counts: of how many one is heard.
    fn id_bits(&self, id: Id) -> f64 {
        let is_alike = |other: &&Id| {
            let standard = matches!(id, Id::Standard(_));
            matches!(other, Id::Standard(_)) == standard
        };
        let all = match id {
            Id::Standard(_) => 11,
            Id::Extended(_) => 29,
        };
        let heard = self.0.keys().filter(is_alike).count().max(1);
        f64::from(all) - log2(heard)
    }
}

#[allow(clippy::cast_precision_loss)] // counts
fn log2(count: usize) -> f64 {
    libm::log2(count.max(1) as f64)
}

/// How sure a finding is; the thresholds are explained at the top of this file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Certainty {
    /// 8 bits or more.
    Possible,
    /// 16 bits or more.
    Likely,
    /// 32 bits or more.
    Certain,
}

impl Certainty {
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

/// A device that a driver recognises.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// The driver.
    pub driver: &'static str,
    /// The device's address, as the driver defines it.
    pub address: u32,
    /// The bits that speak for it; of a driver's own [`crate::Driver::recognise`] any number.
    pub bits: f64,
    /// What it is, in words: type, firmware, serial number, as far as it is known.
    pub what: String,
    /// Keys for its table in gateway.toml.
    pub keys: Vec<Key>,
    /// The channels of its joints.
    pub joints: Vec<u8>,
    /// The identifiers whose frames are explained by it.
    pub explains: Vec<Id>,
    /// The identifiers on which it takes commands that a question of another family might look
    /// like: such questions are not sent.
    pub commands: Vec<RangeInclusive<Id>>,
    /// Why the driver cannot be used for it; empty if it can.
    pub unusable: &'static str,
    /// The bits speak for a device of which the driver is a guess: it is possible, and no more.
    pub guess: bool,
}

impl Finding {
    /// How sure it is; `None` below 8 bits.
    #[must_use]
    pub fn certainty(&self) -> Option<Certainty> {
        match self.bits {
            8.0.. if self.guess => Some(Certainty::Possible),
            32.0.. => Some(Certainty::Certain),
            16.0.. => Some(Certainty::Likely),
            8.0.. => Some(Certainty::Possible),
            _ => None,
        }
    }
}

/// A byte that is one of `count` values.
pub(crate) fn byte_of(count: usize) -> f64 {
    8.0 - log2(count)
}
/// A payload whose length is one of `count`, of 0 to 8.
pub(crate) fn length_of(count: usize) -> f64 {
    log2(9) - log2(count)
}
/// A payload of one length.
pub(crate) const LENGTH: f64 = 3.17;
/// A constant byte.
pub(crate) const BYTE: f64 = 8.0;

/// What speaks for one device.
#[derive(Debug, Clone)]
pub(crate) struct Evidence<'t> {
    pub(crate) traffic: &'t Traffic,
    bits: f64,
    explains: Vec<Id>,
    refuted: bool,
    /// Its frames may be CAN FD.
    fd: bool,
}

impl<'t> Evidence<'t> {
    /// Nothing yet for a device of classic CAN that might have one of `addresses` addresses.
    pub(crate) fn new(traffic: &'t Traffic, addresses: usize) -> Self {
        Self {
            traffic,
            bits: -log2(addresses),
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

    /// The device sends `id`, and all its data frames are of its format and fulfil `rule`, which
    /// one of 2^`bits` arbitrary frames does. Returns what was heard on it, if anything was.
    pub(crate) fn sends(
        &mut self,
        id: Id,
        bits: f64,
        rule: impl Fn(&Frame) -> bool,
    ) -> Option<&'t Stream> {
        let stream = (self.traffic.stream(id)).filter(|stream| stream.frames > 0)?;
        let (mut all, mut odd) = (0_u32, 0_u32);
        for frame in stream.kept() {
            all += 1;
            let is_own = self.fd || frame.format == Format::Classic;
            odd += u32::from(!(is_own && rule(frame)));
        }
        if f64::from(odd) > f64::from(all) * ODD {
            self.refuted = true;
            return None;
        }
        self.explains(id, bits);
        Some(stream)
    }

    /// As [`Evidence::sends`], for frames of length `length`.
    pub(crate) fn sends_length(&mut self, id: Id, length: usize) -> Option<&'t Stream> {
        self.sends(id, LENGTH, |frame| frame.len() == length)
    }

    /// As [`Evidence::sends`], of a protocol in which a frame without data asks for another of the
    /// same identifier. Questions alone say nothing.
    pub(crate) fn answers(
        &mut self,
        id: Id,
        bits: f64,
        rule: impl Fn(&Frame) -> bool,
    ) -> Option<&'t Stream> {
        let has_answer = (self.traffic.stream(id)).is_some_and(|stream| stream.lengths.1 > 0);
        has_answer.then(|| self.sends(id, bits, |frame| frame.is_empty() || rule(frame)))?
    }

    /// `id` counts, and `bits` more.
    pub(crate) fn explains(&mut self, id: Id, bits: f64) {
        if !self.explains.contains(&id) {
            self.bits += self.traffic.id_bits(id);
            self.explains.push(id);
        }
        self.bits += bits;
    }

    /// `id` is the device's too, which counts nothing.
    pub(crate) fn belongs(&mut self, id: Id) {
        if self.traffic.stream(id).is_some() && !self.explains.contains(&id) {
            self.explains.push(id);
        }
    }

    /// `bits` more, or less.
    pub(crate) fn add(&mut self, bits: f64) {
        self.bits += bits;
    }

    /// Frames of `second` follow those of `first` at once: within an eighth of their period, which
    /// two devices do once in 8 times.
    pub(crate) fn together(&mut self, first: &Stream, second: &Stream) {
        // Frames without stamps have no period.
        let Some(period) = first.period().filter(|period| *period > Nanos::ZERO) else {
            return;
        };
        let follows = |a: &&Frame| {
            let mut after = second.recent.iter().map(|b| b.t - a.t);
            after.any(|gap| gap >= Nanos::ZERO && gap.0 * 8 <= period.0)
        };
        // Both have the same number of newest frames: those of one may reach further back.
        let late = |a: &&Frame| second.recent.front().is_none_or(|b| b.t <= a.t);
        let all = first.recent.iter().filter(late).count();
        let near = first.recent.iter().filter(late).filter(follows).count();
        if all >= 3 && near * 10 >= all * 9 {
            self.bits += 3.0;
        }
    }

    /// Whether `count` of consecutive frames goes up by 0 or 1, and not always by 0: a counter of
    /// 8 bits, wherever it is. It counts as a byte.
    pub(crate) fn counts(&mut self, stream: &Stream, count: impl Fn(&Frame) -> u8) {
        let counts = || stream.recent.iter().map(&count);
        let steps = || {
            counts()
                .skip(1)
                .zip(counts())
                .map(|(b, a)| b.wrapping_sub(a))
        };
        let (all, good) = (steps().count(), steps().filter(|step| *step <= 1).count());
        if all >= 3 && good * 10 >= all * 9 && steps().any(|step| step == 1) {
            self.bits += BYTE;
        }
    }

    /// Whether something was added since `before`.
    pub(crate) fn has_more_than(&self, before: &Self) -> bool {
        self.bits > before.bits
    }

    /// Whether something speaks for the device and nothing refutes it.
    pub(crate) fn holds(&self) -> bool {
        !self.refuted && !self.explains.is_empty()
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
            keys: Vec::new(),
            joints: Vec::new(),
            explains: self.explains,
            commands: Vec::new(),
            unusable: "",
            guess: false,
        };
        holds.then_some(finding)
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::StampKind;
    use std::vec;

    fn heard(frames: &[(u16, &[u8], f64)]) -> Traffic {
        let mut traffic = Traffic::new();
        for (id, data, ms) in frames {
            let frame = Frame::new(Id::standard(*id), data);
            let t = Nanos::from_seconds(ms * 1e-3);
            traffic.on_frame(&frame.at(t, StampKind::Software));
        }
        traffic
    }

    /// The usual time is the median: neither a pause nor a burst changes it.
    #[test]
    fn a_period_is_the_median() {
        let stamps = [0.0, 50.0, 60.0, 70.0, 80.0, 80.1, 80.2];
        let frames: Vec<(u16, &[u8], f64)> = stamps.iter().map(|t| (1, &[][..], *t)).collect();
        let period = |count| {
            let traffic = heard(&frames[..count]);
            traffic.stream(Id::standard(1)).unwrap().period()
        };
        assert_eq!(period(7), Some(Nanos::from_millis(10)));
        assert_eq!((period(4).is_some(), period(3)), (true, None));
    }

    /// An answer is kept, whatever comes after it; memory stays bounded.
    #[test]
    fn frames_with_new_beginnings_are_kept() {
        let mut traffic = heard(&[(0x581, &[0x43, 0, 0x10, 0, 9, 9, 9, 9], 0.0)]);
        for count in 0..5000_u32 {
            let [a, b, ..] = count.to_le_bytes();
            let data = [0x43, a, b, 1, 0, 0, 0, 0];
            traffic.on_frame(&Frame::new(Id::standard(0x581), &data));
        }
        let stream = traffic.stream(Id::standard(0x581)).unwrap();
        assert_eq!(stream.kept().next().unwrap().data()[4], 9);
        assert_eq!(stream.kept().count(), RECENT + HEADS);
        let last = stream.recent().next_back().unwrap().data();
        assert_eq!(last[1..3], 4999_u16.to_le_bytes());
    }

    #[test]
    fn rare_properties_count_and_foreign_frames_refute() {
        let data = vec![(0x10, &[7, 0][..], 0.0), (0x11, &[8][..], 1.0)];
        let traffic = heard(&data);
        let bits = |rule: &dyn Fn(&mut Evidence<'_>)| {
            let mut evidence = Evidence::new(&traffic, 4);
            rule(&mut evidence);
            evidence.holds().then_some(evidence.bits)
        };
        let sends = |id: u16, first: u8| {
            move |evidence: &mut Evidence<'_>| {
                evidence.sends(Id::standard(id), BYTE, |f| f.data().first() == Some(&first));
            }
        };
        // 11 bits of an identifier, less one for two; 2 bits for the addresses.
        assert_eq!(bits(&sends(0x10, 7)), Some(10.0 + 8.0 - 2.0));
        assert_eq!(bits(&sends(0x10, 8)), None);
        assert_eq!(bits(&sends(0x12, 7)), None);
        let both = |evidence: &mut Evidence<'_>| {
            sends(0x10, 7)(evidence);
            sends(0x11, 7)(evidence);
        };
        assert_eq!(bits(&both), None);
    }

    #[test]
    fn frames_of_one_instant_and_counters_are_seen() {
        let mut frames = vec![];
        let counts: Vec<[u8; 1]> = (250..=255).chain(0..30).map(|c| [c]).collect();
        for (k, count) in counts.iter().enumerate() {
            let t = k as f64 * 10.0;
            frames.push((0x20, &count[..], t));
            frames.push((0x21, &[3][..], t + 0.3));
            frames.push((0x22, &[3][..], t + 5.0));
        }
        let traffic = heard(&frames);
        let of = |id| traffic.stream(Id::standard(id)).unwrap();
        let bits = |rule: &dyn Fn(&mut Evidence<'_>)| {
            let mut evidence = Evidence::new(&traffic, 1);
            rule(&mut evidence);
            evidence.bits
        };
        assert_eq!(bits(&|e| e.together(of(0x20), of(0x21))), 3.0);
        assert_eq!(bits(&|e| e.together(of(0x20), of(0x22))), 0.0);
        assert_eq!(bits(&|e| e.together(of(0x21), of(0x20))), 0.0);
        let first = |frame: &Frame| frame.data()[0];
        assert_eq!(bits(&|e| e.counts(of(0x20), first)), 8.0);
        assert_eq!(bits(&|e| e.counts(of(0x21), first)), 0.0);
    }
}
