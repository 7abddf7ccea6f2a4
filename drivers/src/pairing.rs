//! Combines the two halves of a reading that a board sends in two frames, in a protocol without
//! sequence numbers. Halves of different readings are not combined, but for the cases named at the
//! end.
//!
//! # Order
//! A board sends the two halves back to back, always in the same order. So a second half belongs to
//! the first half directly before it, unless a half was lost. If a first half follows a first half,
//! the missing second half is lost *or late*, and the next second half may be the late one or the
//! right one: its contents do not show which. Therefore it is dropped together with its first half:
//! one more reading is lost, but none is wrong. After that, in *doubt*, a second half must follow
//! its first as quickly as usual on this bus, until one does or a surplus second half shows that
//! one was late.
//!
//! An adapter under load may exchange two frames in a row. A second half without a first one waits
//! for it, unless it may be a late one: nothing is missing, and there is no doubt. It waits for
//! P/2 - L, at most 1 ms ([`ADAPTER`]): the next reading's first half comes P - L - J after it (P,
//! L and J: below).
//!
//! The stream may be joined between two halves: the first half that is heard, if its other half was
//! sent before, is dropped and not counted.
//!
//! # Time
//! The order does not show that a second half *and* the next first half were lost; the time does.
//! With a period P, a second half L after the first, and a delay of each frame of 0 to J on its way
//! (the arbitration, an adapter that transfers frames in batches):
//!
//! | time from the first half to | least | most |
//! |---|---|---|
//! | its own second half | 0 (the order is kept) | L + J |
//! | the next reading's second half | P + L - J | P + L + J |
//!
//! As long as J is below P/2, the limit L + P/2 separates the two. L is at most [`ADJACENT`]. Where
//! P/2 is less than 1 ms, the jitter of a USB adapter ([`ADAPTER`]), no limit can: a good pair of a
//! jittering bus looks like a wrong one of a steady bus. There the limit depends on the bus: it is
//! L + 1 ms, so that jitter costs no reading; and L + P/2 while the bus is *calm*, that is, nearly
//! all second halves come within L + P/4. At 1 kHz with a jitter of 1 ms and independent delays a
//! sixth come later, and the bus counts as calm less than once in a year; with one of up to 0.6 ms,
//! which loses nothing by the shorter limit, it does.
//!
//! Three cases cannot be distinguished from a good pair. (1) A second half that arrives between a
//! first half and its own second half and is late by more than two periods, or had lost its first
//! half, or is not the only late one in a row. (2) With a period below 2 ms, on a bus that is not
//! calm (or not yet, in the first 192 readings): a second half and the next first half are lost,
//! and the next second half comes within L + 1 ms. At 1 kHz with a jitter of 1 ms and one frame in
//! 1000 lost, that is about one reading in a million. Losses among pairs that are exchanged many
//! times in a row end the calm, too. (3) A second half has lost its first one, and is late by more
//! than P/2, to just before the next first half.

use crate::Frame;
use proprio_topics::{Nanos, StampKind};

/// Whether `frame` is at most `most` after `earlier`. Without stamps nothing expires.
pub(crate) fn within(earlier: (Nanos, StampKind), frame: &Frame, most: Nanos) -> bool {
    if earlier.1 == StampKind::None || frame.stamp == StampKind::None {
        return true;
    }
    let passed = frame.t - earlier.0;
    passed >= Nanos::ZERO && passed <= most
}

/// The result of adding a half to a [`Pairing`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Paired<T> {
    /// The half waits for its other half.
    Waiting,
    /// The half completes a reading: the stamp of what came first, the first half and the second.
    With(Nanos, StampKind, [T; 2]),
    /// The half cannot be used.
    Alone,
}

/// The longest time from the start of a first half to the end of its second half if nothing delays
/// them: one frame of another board between them, each at most 135 bits at 1 Mbit/s.
const ADJACENT: Nanos = Nanos::from_micros(300);
/// The jitter of a USB adapter: it transfers frames once per USB frame.
const ADAPTER: Nanos = Nanos::from_millis(1);
/// From so many on a bus is calm: the count of second halves that came soon, up to 255, minus
/// [`CALM_LATE`] for each other one. So four late ones in a row end the calm.
const CALM: u8 = 192;
/// More than the ratio of soon to late second halves at a jitter of 0.7 ms or more and 1 kHz, so
/// that there the count falls.
const CALM_LATE: u8 = 16;

/// The longest time from the first half of a reading to the second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Limit {
    /// A second half within this time came soon.
    soon: Nanos,
    /// On a calm bus.
    calm: Nanos,
    /// Otherwise.
    jittering: Nanos,
    /// From a second half to its first half, if they were exchanged.
    exchanged: Nanos,
}

impl Limit {
    /// As derived above, for readings with this period.
    pub(crate) fn of_period(period: Nanos) -> Self {
        let half = Nanos(period.0 / 2);
        Self {
            soon: ADJACENT + Nanos(period.0 / 4),
            calm: ADJACENT + half,
            jittering: ADJACENT + half.max(ADAPTER),
            exchanged: (half - ADJACENT).clamp(Nanos::ZERO, ADAPTER),
        }
    }

    /// Always `time`.
    pub(crate) const fn fixed(time: Nanos) -> Self {
        Self {
            soon: time,
            calm: time,
            jittering: time,
            exchanged: if time.0 < ADAPTER.0 { time } else { ADAPTER },
        }
    }
}

/// In which order the halves of a reading come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HalfOrder {
    /// Either half may come first, and waits for the other.
    Any,
    /// The first half comes first, unless an adapter exchanges them.
    Usual,
    /// The first half comes first; an exchanged pair is dropped.
    Strict,
}

/// Combines the two halves of a reading (rules in the module documentation).
#[derive(Debug)]
pub(crate) struct Pairing<T> {
    limit: Limit,
    order: HalfOrder,
    /// Nothing but the waiting half was heard: its other half may have been sent before.
    joined: bool,
    pending: Option<(bool, Nanos, StampKind, T)>,
    /// A second half that may have been exchanged with its first half.
    ahead: Option<(Nanos, StampKind, T)>,
    /// A second half is missing and may still arrive.
    owed: bool,
    /// A second half may still arrive, unless it was in the dropped pair.
    doubt: bool,
    /// Usual delay of second halves: a running mean.
    usual: Option<Nanos>,
    /// Rises with second halves that come soon, falls with others ([`CALM`]).
    calm: u8,
}

/// Margin beyond twice the usual delay: the duration of a frame on the bus.
const USUAL_SLACK: Nanos = Nanos::from_micros(125);

impl<T: Copy> Pairing<T> {
    pub(crate) const fn new(limit: Limit, order: HalfOrder) -> Self {
        Self {
            limit,
            order,
            joined: true,
            pending: None,
            ahead: None,
            owed: false,
            doubt: false,
            usual: None,
            calm: 0,
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
        let is_ordered = self.order != HalfOrder::Any;
        let waiting = (second, frame.t, frame.stamp, half);
        let has_stamp = frame.stamp != StampKind::None;
        if let Some((t, stamp, other)) = self.ahead.take() {
            if !second && has_stamp && within((t, stamp), frame, self.limit.exchanged) {
                self.calm = self.calm.saturating_add(1);
                return Paired::With(t, stamp, [half, other]);
            }
            *unpaired += 1;
        }
        let Some((was_second, t, stamp, other)) = self.pending.take() else {
            if second && is_ordered {
                // Its first half was lost, or comes next; or it is the missing second half.
                let is_late = core::mem::take(&mut self.owed) | core::mem::take(&mut self.doubt);
                let joined = core::mem::take(&mut self.joined);
                if self.order == HalfOrder::Usual && !joined && !is_late && has_stamp {
                    self.ahead = Some((frame.t, frame.stamp, half));
                    return Paired::Waiting;
                }
                *unpaired += u32::from(!joined);
                return Paired::Alone;
            }
            // A first half is followed by its second.
            self.joined &= !is_ordered;
            self.pending = Some(waiting);
            return Paired::Waiting;
        };
        let joined = core::mem::take(&mut self.joined);
        if was_second == second {
            *unpaired += u32::from(!joined);
            self.owed = true;
            self.pending = Some(waiting);
            return Paired::Waiting;
        }
        let limit = if self.calm >= CALM {
            self.limit.calm
        } else {
            self.limit.jittering
        };
        let in_time = within((t, stamp), frame, limit);
        let usual = match self.usual {
            Some(usual) => usual + usual + USUAL_SLACK,
            None => Nanos(limit.0 / 2),
        };
        if !self.owed {
            self.calm = if within((t, stamp), frame, self.limit.soon) {
                self.calm.saturating_add(1)
            } else {
                self.calm.saturating_sub(CALM_LATE)
            };
        }
        if in_time && !self.owed && (!self.doubt || within((t, stamp), frame, usual)) {
            self.doubt = false;
            let (passed, usual) = ((frame.t - t).0, self.usual.unwrap_or(frame.t - t).0);
            self.usual = Some(Nanos(usual + (passed - usual) / 8));
            let halves = if second { [other, half] } else { [half, other] };
            return Paired::With(t, stamp, halves);
        }
        self.doubt |= self.owed;
        self.owed = false;
        *unpaired += u32::from(!joined);
        if is_ordered || in_time {
            *unpaired += 1;
            return Paired::Alone;
        }
        self.pending = Some(waiting);
        Paired::Waiting
    }

    /// Drops the waiting half.
    pub(crate) fn reset(&mut self) {
        self.joined = true;
        self.pending = None;
        self.ahead = None;
        self.owed = false;
        self.doubt = false;
    }
}
