//! Combines the two halves of a reading that a board sends in two frames.

use crate::Frame;
use proprio_topics::{Nanos, StampKind};

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
