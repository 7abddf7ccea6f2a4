//! A recorded log as a link: any format of [`crate::log`], replayed at the recorded pace or as fast
//! as possible.
//!
//! | pace | when a frame is returned | its stamp |
//! |---|---|---|
//! | [`Pace::Recorded`] | at its stamp | the log's, shifted to the present |
//! | [`Pace::Fast`] | at once | the log's |
//!
//! At the recorded pace the first stamp is the time of the first call of [`Link::recv`].
//!
//! A log does not answer, so [`Link::send`] fails with [`TransmitError::Unsupported`]. Devices that
//! only listen never send.

use super::{Link, LinkCounters, OpenError, Received, TransmitError, passes};
use crate::clock::{Clock, Monotonic, sleep_until};
pub use crate::config::Pace;
use crate::log::{self, Bytes, LogReader, LogReport, Stamps};
use proprio_drivers::{Claim, Format, Frame};
use proprio_topics::{LinkState, Nanos, StampKind};
use std::io::{self, BufRead, BufReader};
use std::path::Path;

/// Size of the read buffer \[bytes\].
const BUFFER: usize = 1 << 16;

/// Selects the frames of one bus from a log with several interfaces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Matching {
    interface: Option<String>,
    name: Option<String>,
    is_alone: bool,
}

impl Matching {
    /// The selection of bus number `this` of `buses`, each given by its interface (if its source is
    /// one) and name: the frames of its interface, and those of an interface with the bus's name
    /// that belongs to no other bus. `None` if there is no such bus.
    #[must_use]
    pub fn of(buses: &[(Option<&str>, &str)], this: usize) -> Option<Self> {
        let (interface, name) = buses.get(this)?;
        let taken = buses
            .iter()
            .enumerate()
            .any(|(i, (other, _))| i != this && *other == Some(*name));
        Some(Self {
            interface: interface.map(str::to_owned),
            name: (!taken).then(|| (*name).to_owned()),
            is_alone: buses.len() == 1,
        })
    }

    /// The selection in this log, of which nothing is read yet. `None`: all frames, those of a
    /// single bus whose interface and name are not in the log, which was recorded under another
    /// one.
    ///
    /// # Errors
    /// The log cannot be read.
    pub(crate) fn in_log(self, log: &mut LogReader<impl BufRead>) -> io::Result<Option<Self>> {
        let takes_all = self.is_alone && !log.has_interface(|name| self.takes(name))?;
        Ok((!takes_all).then_some(self))
    }

    /// Whether frames of `interface` in the log belong to it.
    #[must_use]
    pub fn takes(&self, interface: &str) -> bool {
        self.interface.as_deref() == Some(interface) || self.name.as_deref() == Some(interface)
    }
}

/// What a person should be told if a bus takes the frames of several interfaces of a log.
pub(crate) fn several(interfaces: &[String]) -> Option<String> {
    (interfaces.len() > 1).then(|| {
        format!(
            "the log has the interfaces {}, and the frames of all count, because none in its first \
             16 MiB is the interface or name of the one bus; if only one of them is that bus, give \
             its name as interface or name of the bus in gateway.toml",
            interfaces.join(", ")
        )
    })
}

/// A log that is being replayed.
#[derive(Debug)]
pub struct Replay<R = BufReader<Bytes>> {
    log: LogReader<R>,
    pace: Pace,
    matching: Option<Matching>,
    claims: Vec<Claim>,
    clock: Monotonic,
    /// The next frame: read, not yet due.
    pending: Option<Frame>,
    /// The log's first stamp, of any interface.
    origin: Nanos,
    /// The shift added to the log's stamps, once known.
    shift: Option<Nanos>,
    /// The last stamp returned, for frames without a stamp.
    last: Nanos,
    ended: bool,
    failure: Option<io::ErrorKind>,
    unmatched: u64,
    counters: LinkCounters,
}

impl Replay {
    /// Opens the log at `path`, whose own content tells what its stamps mean.
    ///
    /// # Errors
    /// As [`Replay::open_with`].
    pub fn open(
        path: &Path,
        pace: Pace,
        interface: Option<Matching>,
        claims: &[Claim],
    ) -> Result<Self, OpenError> {
        Self::open_with(path, pace, Stamps::Detect, interface, claims)
    }

    /// Opens the log at `path`, whose relative stamps mean `stamps`. Only frames that `interface`
    /// takes (all if `None`) and that one of `claims` matches (all if there are none) are returned.
    ///
    /// # Errors
    /// [`OpenError::Log`]: it cannot be read, or has no time stamps but the recorded pace needs
    /// them.
    pub fn open_with(
        path: &Path,
        pace: Pace,
        stamps: Stamps,
        interface: Option<Matching>,
        claims: &[Claim],
    ) -> Result<Self, OpenError> {
        let fail = |cause| OpenError::Log {
            path: path.to_owned(),
            cause,
        };
        let file = log::open(path).map_err(fail)?;
        let log = LogReader::with_stamps(BufReader::with_capacity(BUFFER, file), stamps);
        Self::of(log, pace, interface, claims).map_err(fail)
    }
}

impl<R: BufRead> Replay<R> {
    /// A log of which nothing is read yet.
    fn of(
        mut log: LogReader<R>,
        pace: Pace,
        interface: Option<Matching>,
        claims: &[Claim],
    ) -> io::Result<Self> {
        let matching = match interface {
            Some(interface) => interface.in_log(&mut log)?,
            None => None,
        };
        // The first frame of the whole log is the origin, so that the buses of one log stay in
        // step.
        let matches = |interface: &str| matching.as_ref().is_none_or(|m| m.takes(interface));
        let first = (log.next_record()?).map(|r| (r.stamp, matches(r.interface), r.frame));
        let mut replay = Self {
            log,
            pace,
            matching,
            claims: claims.to_vec(),
            clock: Monotonic,
            pending: None,
            origin: Nanos::ZERO,
            shift: None,
            last: Nanos::ZERO,
            ended: false,
            failure: None,
            unmatched: 0,
            counters: LinkCounters::default(),
        };
        let fail = |why: String| Err(io::Error::new(io::ErrorKind::InvalidData, why));
        match first {
            // The log is empty.
            None if replay.log.report().bad == 0 => replay.ended = true,
            None => return fail(format!("it holds no frame: {}", replay.log.why_empty())),
            Some((None, ..)) if pace == Pace::Recorded => {
                return fail(
                    "it has no time stamps, which pace = \"recorded\" needs; record with \
                     `candump -l`, or use pace = \"fast\""
                        .to_owned(),
                );
            }
            Some((stamp, matches, frame)) => {
                replay.origin = stamp.unwrap_or_default();
                replay.last = replay.origin;
                replay.pending = replay.sort(frame, matches);
            }
        }
        Ok(replay)
    }

    /// The report of the log's reader so far: bad lines, frames without stamps.
    #[must_use]
    pub const fn report(&self) -> &LogReport {
        self.log.report()
    }

    /// Shifts the log's first stamp to `now` instead of the first call of [`Link::recv`], so that
    /// several buses replayed from one log stay in step.
    pub const fn start_at(&mut self, now: Nanos) {
        self.shift = Some(now.saturating_sub(self.origin));
    }

    /// Number of frames of other buses' interfaces.
    #[must_use]
    pub const fn unmatched(&self) -> u64 {
        self.unmatched
    }

    /// The read error, if the log ended because of one.
    #[must_use]
    pub const fn failure(&self) -> Option<io::ErrorKind> {
        self.failure
    }

    /// Returns the frame if it is for this bus; otherwise counts it.
    fn sort(&mut self, frame: Frame, matches: bool) -> Option<Frame> {
        if !matches {
            self.unmatched += 1;
            return None;
        }
        (frame.format == Format::Error || passes(&self.claims, &frame)).then_some(frame)
    }

    /// The next frame to return, due or not.
    fn next(&mut self) -> Option<Frame> {
        if let Some(frame) = self.pending.take() {
            return Some(frame);
        }
        while !self.ended {
            let (frame, matches) = match self.log.next_record() {
                Ok(Some(record)) => (
                    record.frame,
                    self.matching
                        .as_ref()
                        .is_none_or(|m| m.takes(record.interface)),
                ),
                Ok(None) => {
                    self.ended = true;
                    break;
                }
                Err(error) => {
                    self.failure = Some(error.kind());
                    self.ended = true;
                    self.counters.losses += 1;
                    break;
                }
            };
            if let Some(frame) = self.sort(frame, matches) {
                return Some(frame);
            }
        }
        None
    }
}

impl<R: BufRead + Send> Link for Replay<R> {
    fn note(&self) -> Option<String> {
        let mut notes = Vec::new();
        if let Some(failure) = self.failure {
            notes.push(format!("the log could not be read to its end: {failure}"));
        }
        notes.extend(self.log.skipped());
        let key = "stamps = \"since_start\" or \"since_previous\" of the source";
        notes.extend(self.log.doubt(key));
        notes.extend(self.log.step_back());
        if self.matching.is_none() {
            notes.extend(several(self.log.interfaces()));
        }
        if self.counters.received == 0 {
            notes.push(format!(
                "none of the log's {} frames is for this bus",
                self.log.report().records
            ));
        }
        (!notes.is_empty()).then(|| notes.join("; "))
    }

    /// As [`Link::recv`]. At the recorded pace, a frame that is not due by `deadline` gives
    /// [`Received::TimedOut`] and is returned by a later call.
    fn recv(&mut self, deadline: Nanos) -> Received {
        let Some(frame) = self.next() else {
            return Received::Ended;
        };
        let handed_out = match self.pace {
            Pace::Fast => frame,
            Pace::Recorded => {
                // A line without a stamp among others gets the stamp of the previous line.
                let recorded = if frame.stamp == StampKind::None {
                    self.last
                } else {
                    frame.t
                };
                let now = self.clock.now();
                let shift = *self.shift.get_or_insert(now.saturating_sub(self.origin));
                let due = recorded.saturating_add(shift);
                if due > now {
                    sleep_until(due.min(deadline));
                    if due > deadline {
                        self.pending = Some(frame);
                        return Received::TimedOut;
                    }
                }
                self.last = recorded;
                frame.at(due, StampKind::Log)
            }
        };
        if frame.format == Format::Error {
            self.counters.error_frames += 1;
            return Received::Error(handed_out);
        }
        self.counters.received += 1;
        Received::Frame(handed_out)
    }

    /// Never sends: a log does not answer.
    fn send(&mut self, _frame: &Frame) -> Result<(), TransmitError> {
        Err(TransmitError::Unsupported)
    }

    fn state(&self) -> LinkState {
        if self.ended && self.pending.is_none() {
            LinkState::Ended
        } else {
            LinkState::Up
        }
    }

    fn counters(&self) -> LinkCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As a file on a disk that fails.
    #[derive(Debug)]
    struct Failing;

    impl io::Read for Failing {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::ErrorKind::ConnectionReset.into())
        }
    }

    #[test]
    fn a_log_that_can_not_be_read_to_its_end_is_not_complete() {
        let text = b"(1.0) can0 123#11\n(1.1) can0 123#22\n".as_slice();
        let log = LogReader::with_stamps(
            BufReader::new(io::Read::chain(text, Failing)),
            Stamps::Detect,
        );
        let mut replay = Replay::of(log, Pace::Fast, None, &[]).unwrap();
        let mut received = Vec::new();
        let end = loop {
            match replay.recv(Nanos::ZERO) {
                Received::Frame(frame) => received.extend_from_slice(frame.data()),
                other => break other,
            }
        };
        assert_eq!((received, end), (vec![0x11, 0x22], Received::Ended));
        assert_eq!(replay.failure(), Some(io::ErrorKind::ConnectionReset));
        assert_eq!(replay.counters().losses, 1);
        let note = replay.note().unwrap();
        assert!(
            note.starts_with("the log could not be read to its end: connection reset"),
            "{note}"
        );
    }
}
