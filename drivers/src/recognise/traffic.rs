//! The traffic of a bus, by identifier.

use crate::{Format, Frame, Id};
use alloc::collections::{BTreeMap, VecDeque};
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
    /// How many frames had 0 to 8 bytes.
    by_length: [u64; 9],
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
            by_length: [0; 9],
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
        if let Some(count) = self.by_length.get_mut(frame.len()) {
            *count += 1;
        }
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

    /// The first bytes of its frames, each once: the numbers of its senders, for example.
    pub(crate) fn first_bytes(&self) -> Vec<u8> {
        let mut found = Vec::new();
        for first in self.kept().filter_map(|frame| frame.data().first()) {
            if !found.contains(first) {
                found.push(*first);
            }
        }
        found
    }

    /// The newest frames, at most 48, in their order.
    pub fn recent(&self) -> impl DoubleEndedIterator<Item = &Frame> {
        self.recent.iter()
    }

    /// The lengths from 0 to 8 that more than a few of its frames have.
    pub(super) fn usual_lengths(&self) -> impl Iterator<Item = usize> {
        let counts = self.by_length.iter().enumerate();
        let few = self.frames / 20;
        counts
            .filter(move |(_, count)| **count > few)
            .map(|(length, _)| length)
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

    /// The identifiers in `range` on which something was heard.
    pub(super) fn between(&self, range: RangeInclusive<Id>) -> impl Iterator<Item = Id> {
        self.0.range(range).map(|(id, _)| *id)
    }

    /// Whether `a` and `b` are of one format, and each identifier between them was heard, too.
    pub(super) fn are_in_a_row(&self, a: Id, b: Id) -> bool {
        let gap = a.raw().abs_diff(b.raw()) as usize;
        core::mem::discriminant(&a) == core::mem::discriminant(&b)
            && self.between(a.min(b)..=a.max(b)).count() == gap + 1
    }

    /// What was heard, by identifier.
    pub fn streams(&self) -> impl Iterator<Item = &Stream> {
        self.0.values()
    }
}
