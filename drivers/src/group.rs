//! Combines the frames of a reading that a device sends in several frames, always in the same
//! order: a chain of `pairing.rs`. The frames so far are a first half, and the next frame is the
//! second. So two frames in a row are of the same reading, or the reading is dropped. It is also
//! dropped if a frame has come once too often, which may be a late one of the reading before.

use crate::Frame;
use crate::pairing::{HalfOrder, Limit, Paired, Pairing};
use arrayvec::ArrayVec;
use proprio_topics::{Nanos, StampKind};

/// One less than the largest number of frames of a reading.
const LINKS: usize = 6;

/// The frames of a reading that have come.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PartialReading<T> {
    /// The stamp of its first frame, and the source of that stamp.
    pub(crate) acquired: Nanos,
    pub(crate) stamp: StampKind,
    pub(crate) content: T,
}

/// Combines the frames of a reading (rules in the module documentation).
#[derive(Debug)]
pub(crate) struct FrameGroup<T> {
    /// One between each frame and the next.
    links: ArrayVec<Pairing<PartialReading<T>>, LINKS>,
    /// No first frame was heard: what comes belongs to a reading that began before.
    joined: bool,
    /// A reading has begun and is not complete.
    open: bool,
    /// This reading is dropped, and counted: a frame of it is missing, or one too many has come.
    counted: bool,
}

impl<T: Copy> FrameGroup<T> {
    /// Readings of `frames` frames, each of which follows the one before within `limit`.
    pub(crate) fn new(frames: usize, limit: Limit) -> Self {
        let links = (1..frames).map(|_| Pairing::new(limit, HalfOrder::Strict));
        Self {
            links: links.take(LINKS).collect(),
            joined: true,
            open: false,
            counted: false,
        }
    }

    /// Takes the frame number `position` of a reading, from 0: `add` adds what it holds to `empty`
    /// or to the frames before it. Returns the reading that it completes, and increases `dropped`
    /// by the readings that are now known to be incomplete.
    pub(crate) fn push(
        &mut self,
        position: usize,
        frame: &Frame,
        empty: T,
        add: impl FnOnce(&mut T),
        dropped: &mut u32,
    ) -> Option<PartialReading<T>> {
        if position == 0 {
            *dropped += u32::from(self.open && !self.counted);
            (self.joined, self.open, self.counted) = (false, true, false);
        }
        let mut part = PartialReading {
            acquired: frame.t,
            stamp: frame.stamp,
            content: empty,
        };
        let before = position.checked_sub(1);
        if let Some(link) = before.and_then(|link| self.links.get_mut(link)) {
            let Paired::With(_, _, [first, _]) = link.push(true, frame, part, &mut 0) else {
                *dropped += u32::from(!self.joined && !self.counted);
                self.counted = true;
                return None;
            };
            part = first;
        }
        add(&mut part.content);
        if let Some(link) = self.links.get_mut(position) {
            link.push(false, frame, part, &mut 0);
            return None;
        }
        self.open = false;
        (!self.counted).then_some(part)
    }

    /// Drops an incomplete reading without counting it.
    pub(crate) fn reset(&mut self) {
        self.links.iter_mut().for_each(Pairing::reset);
        (self.joined, self.open, self.counted) = (true, false, false);
    }
}
