//! Takes the payloads of one topic, counts losses and reports the age of the last payload.

use super::bell::{Bell, Rings};
use super::clock::sleep_until;
use super::domain::service_name;
use super::error::transport;
use super::failures::Failures;
use super::memory;
use super::writer::explain;
use super::{Domain, PortError, TakeError, Topic};
use crate::{Header, Nanos};
use iceoryx2::port::ReceiveError;
use iceoryx2::port::subscriber::{Subscriber, SubscriberCreateError};
use iceoryx2::prelude::{CallbackProgression, PortFactory as _, ipc};
use iceoryx2::service::Service;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use std::string::ToString;
use std::vec::Vec;

/// Age of the last payload read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Freshness {
    /// Nothing has been read yet.
    NeverSeen,
    /// It is not older than allowed.
    Fresh {
        /// Its age \[ns\], from its acquisition.
        age: Nanos,
    },
    /// It is older than allowed.
    Stale {
        /// Its age \[ns\], from its acquisition.
        age: Nanos,
    },
}

impl Freshness {
    /// The freshness at `now` of a payload acquired at `acquired`; up to `max_age` it is fresh.
    #[must_use]
    pub fn of(acquired: Option<Nanos>, now: Nanos, max_age: Nanos) -> Self {
        match acquired.map(|t| now.saturating_sub(t)) {
            None => Self::NeverSeen,
            Some(age) if age <= max_age => Self::Fresh { age },
            Some(age) => Self::Stale { age },
        }
    }

    /// Whether it is fresh.
    #[must_use]
    pub fn is_fresh(self) -> bool {
        matches!(self, Self::Fresh { .. })
    }
}

type Subscription<T, S> = (Subscriber<S, T, ()>, PortFactory<S, T, ()>);

/// The receiving end of a topic. Belongs to one thread: open it where it is used.
///
/// It stays open when its writers die, and receives from their successors.
#[derive(Debug)]
pub struct Reader<T: Topic, S: Service = ipc::Service> {
    // `Some` until drop; dropped under the domain's lock.
    ports: Option<Subscription<T, S>>,
    domain: Domain<S>,
    bell: Bell,
    failures: Failures,
    /// The rings heard when nothing was waiting.
    heard: Rings,
    /// The changes of the writers before it was opened.
    changes: u32,
    tally: SequenceTally,
    invalid: u64,
    last: Option<Header>,
}

impl<T: Topic> Reader<T> {
    /// Opens `<robot>/<T::SUFFIX>`. Never creates the service: its creator, always a writer, fixes
    /// its quality of service.
    ///
    /// # Errors
    /// [`PortError::NotYet`] if it does not exist; [`PortError::Incompatible`] if it has another
    /// version; [`PortError::Full`]; [`PortError::Denied`]; others as [`Domain::open`].
    pub fn open(domain: &Domain, robot: &str) -> Result<Self, PortError> {
        Self::open_in(domain, robot)
    }

    /// Opens the service as soon as it exists. After each attempt that does not find it, calls
    /// `again` with the number of attempts; stops when `again` returns false. `again` must sleep
    /// and check the caller's deadline, because nothing here reads a clock.
    ///
    /// # Errors
    /// [`PortError::NotYet`] if `again` gave up; others as [`Reader::open`].
    pub fn wait_open(
        domain: &Domain,
        robot: &str,
        mut again: impl FnMut(u32) -> bool,
    ) -> Result<Self, PortError> {
        let mut attempts = 0;
        loop {
            match Self::open(domain, robot) {
                Err(PortError::NotYet { service }) => {
                    attempts += 1;
                    if !again(attempts) {
                        return Err(PortError::NotYet { service });
                    }
                }
                other => return other,
            }
        }
    }
}

impl<T: Topic, S: Service> Reader<T, S> {
    /// As [`Reader::open`], with any kind of ports.
    pub(super) fn open_in(domain: &Domain<S>, robot: &str) -> Result<Self, PortError> {
        let name = service_name(robot, T::SUFFIX)?;
        // A cheap question first: a program that waits for the service asks often.
        if !domain.has_bell(&name) {
            return Err(PortError::NotYet {
                service: name.to_string(),
            });
        }
        let failures = Failures::default();
        let (subscriber, service, predecessors, (bell, changes)) =
            domain.locked(memory::BESIDE, |node| {
                let bell = domain.bell(&name)?;
                let changes = bell.changes();
                let service = node
                    .service_builder(&name)
                    .publish_subscribe::<T>()
                    .open()
                    .map_err(|e| explain::<T, _>(domain, &name, e))?;
                let mut predecessors = Vec::new();
                service.dynamic_config().list_publishers(|p| {
                    predecessors.push(p.publisher_id.value());
                    CallbackProgression::Continue
                });
                let subscriber = subscribe(&service, &failures)?;
                Ok((subscriber, service, predecessors, (bell, changes)))
            })?;
        Ok(Self {
            ports: Some((subscriber, service)),
            domain: domain.clone(),
            bell,
            failures,
            heard: Rings::default(),
            changes,
            tally: SequenceTally::new(predecessors),
            invalid: 0,
            last: None,
        })
    }

    /// The next waiting payload, in each writer's order; `None` if none is waiting. Never blocks,
    /// never allocates. A payload whose numbers have no meaning ([`Topic::is_valid`]) is skipped
    /// and counted.
    ///
    /// Connects to new writers, with file operations. If a connection fails, as without free file
    /// descriptors, the port is opened again every 0.1 s, when no payload is waiting, until all
    /// connections are made.
    ///
    /// # Errors
    /// [`TakeError`], once for each attempt; the reader stays usable.
    pub fn try_take(&mut self) -> Result<Option<T>, TakeError> {
        let Some((subscriber, _)) = &self.ports else {
            return Err(TakeError::Internal);
        };
        let (rings, guard) = (self.bell.rings(), self.domain.guard());
        // No endless loop, even if a writer sends nonsense as fast as this reads.
        for _ in 0..T::QUALITY.buffer.saturating_mul(T::QUALITY.publishers) {
            let received = guard.survive(|| subscriber.receive());
            let sample = received
                .ok_or(TakeError::Connection)?
                .map_err(|e| match e {
                    ReceiveError::ConnectionFailure(_) => TakeError::Connection,
                    ReceiveError::ExceedsMaxBorrows => TakeError::Internal,
                })?;
            let Some(sample) = sample else {
                self.heard = rings;
                if self.failures.is_due() {
                    self.reopen()?;
                }
                return Ok(None);
            };
            let value = *sample.payload();
            let writer = sample.header().publisher_id().value();
            let mut held = Some(sample);
            let given_back = guard.survive(|| drop(held.take()));
            // In damaged memory there is nobody to give it back to.
            std::mem::forget(held);
            given_back.ok_or(TakeError::Connection)?;
            if !value.is_valid() {
                self.invalid += 1;
                continue;
            }
            self.tally.count(writer, value.header());
            self.last = Some(*value.header());
            return Ok(Some(value));
        }
        Ok(None)
    }

    /// Replaces the port by a new one, which connects to all writers. What they have sent meanwhile
    /// counts as lost.
    #[cold]
    fn reopen(&mut self) -> Result<(), TakeError> {
        let Some((port, service)) = &mut self.ports else {
            return Err(TakeError::Internal);
        };
        let failures = &self.failures;
        failures.forget();
        let reopened = self.domain.try_locked(|| {
            let new = subscribe(service, failures)?;
            drop(std::mem::replace(port, new));
            Ok::<_, PortError>(())
        });
        if !matches!(reopened, Some(Ok(()))) {
            failures.note();
        }
        // Its payloads wait in the new port.
        self.heard = Rings::default();
        match failures.any() {
            false => Ok(()),
            true => Err(TakeError::Connection),
        }
    }

    /// Waits until a payload may be waiting, at most until CLOCK_MONOTONIC shows `deadline` \[ns\];
    /// returns whether one may be. Returns at once if there may be some that
    /// [`Reader::try_take`] has not seen. One system call.
    pub fn wait(&self, deadline: Nanos) -> bool {
        if self.domain.guard().is_sound() {
            return self.bell.wait(self.heard, deadline);
        }
        sleep_until(deadline);
        false
    }

    /// Takes all waiting payloads and returns the newest; `None` if none is waiting.
    ///
    /// Takes at most as many payloads as the buffers hold, so it ends even if a writer sends as
    /// fast as this reads.
    ///
    /// # Errors
    /// As [`Reader::try_take`], if there was no payload before the error.
    pub fn latest(&mut self) -> Result<Option<T>, TakeError> {
        let mut newest = None;
        for _ in 0..T::QUALITY.buffer.saturating_mul(T::QUALITY.publishers) {
            match self.try_take() {
                Ok(None) => break,
                Ok(some) => newest = some,
                Err(error) if newest.is_none() => return Err(error),
                Err(_) => break,
            }
        }
        Ok(newest)
    }

    /// The freshness at `now` of the last payload taken; up to `max_age` it is fresh.
    #[must_use]
    pub fn freshness(&self, now: Nanos, max_age: Nanos) -> Freshness {
        Freshness::of(self.last.map(|h| h.acquired), now, max_age)
    }

    /// Number of lost payloads, from gaps in the writers' sequence numbers. Payloads sent before
    /// this reader opened are not counted.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.tally.lost
    }

    /// Number of payloads taken.
    #[must_use]
    pub fn taken(&self) -> u64 {
        self.tally.taken
    }

    /// Number of payloads that were skipped because their numbers have no meaning.
    #[must_use]
    pub fn invalid(&self) -> u64 {
        self.invalid
    }

    /// Number of different epochs seen: 1, plus 1 for each restart of a publisher.
    #[must_use]
    pub fn epochs(&self) -> u64 {
        self.tally.epochs
    }

    /// Whether its writers are those that it is connected to. If not, [`Reader::try_take`] will
    /// connect to them, with file operations.
    pub(super) fn is_connected(&self) -> bool {
        self.bell.changes() == self.changes && !self.failures.any()
    }

    /// A live writer: the number of its node, which no other start of a process has, and its
    /// process (0 if it is not known).
    pub(super) fn live_writer(&self) -> Option<(u128, i32)> {
        let guard = self.domain.guard();
        guard.survive(|| self.writer_that_lives()).flatten()
    }

    fn writer_that_lives(&self) -> Option<(u128, i32)> {
        let mut writer = None;
        if let Some((_, service)) = &self.ports {
            service.dynamic_config().list_publishers(|p| {
                let node = p.node_id.value();
                writer = self.domain.process_of(node).map(|process| (node, process));
                match writer {
                    Some(_) => CallbackProgression::Stop,
                    None => CallbackProgression::Continue,
                }
            });
        }
        writer
    }

    /// The number of its writers so far that have left in order.
    pub(super) fn farewells(&self) -> u32 {
        self.bell.farewells()
    }

    /// Whether the bell has rung since nothing was waiting: a payload may be waiting. One load from
    /// memory.
    pub(super) fn has_rung(&self) -> bool {
        self.bell.rings() != self.heard
    }

    /// Number of writers now. A dead writer still counts until some process opens a domain or a
    /// port.
    #[must_use]
    pub fn writers(&self) -> usize {
        let ports = self.ports.as_ref();
        let count =
            |(_, service): &Subscription<T, S>| service.dynamic_config().number_of_publishers();
        let counted = self.domain.guard().survive(|| ports.map_or(0, count));
        counted.unwrap_or(0)
    }
}

impl<T: Topic, S: Service> Drop for Reader<T, S> {
    fn drop(&mut self) {
        let ports = self.ports.take();
        self.domain.drop_locked(ports);
    }
}

/// A new port of `service`.
fn subscribe<T: Topic, S: Service>(
    service: &PortFactory<S, T, ()>,
    failures: &Failures,
) -> Result<Subscriber<S, T, ()>, PortError> {
    let builder = service.subscriber_builder();
    let created = builder.set_degradation_handler(failures.handler()).create();
    created.map_err(|e| match e {
        SubscriberCreateError::ExceedsMaxSupportedSubscribers => PortError::Full {
            service: service.name().to_string(),
            what: "reader",
        },
        e => PortError::Transport {
            service: service.name().to_string(),
            problem: transport(e),
        },
    })
}

/// The last writers seen with their next sequence numbers. Their number is fixed, so that counting
/// never allocates.
#[derive(Debug)]
struct SequenceTally {
    /// Writers older than the reader: the first payload seen may have any sequence number. All
    /// others begin at 0.
    predecessors: Vec<u128>,
    writers: [Option<SeenWriter>; Self::WRITERS],
    known_epochs: [u64; Self::WRITERS],
    taken: u64,
    lost: u64,
    epochs: u64,
}

#[derive(Debug, Clone, Copy)]
struct SeenWriter {
    writer: u128,
    next: u64,
    last_taken: u64,
}

impl SequenceTally {
    /// Twice the largest number of writers of any topic.
    const WRITERS: usize = 2 * crate::MAX_BUSES;

    fn new(predecessors: Vec<u128>) -> Self {
        Self {
            predecessors,
            writers: [None; Self::WRITERS],
            known_epochs: [0; Self::WRITERS],
            taken: 0,
            lost: 0,
            epochs: 0,
        }
    }

    fn count(&mut self, writer: u128, header: &Header) {
        self.taken += 1;
        if !self.known_epochs.contains(&header.epoch) || (header.epoch == 0 && self.epochs == 0) {
            let len = self.known_epochs.len() as u64;
            // Replaces the oldest.
            if let Some(place) = self.known_epochs.get_mut((self.epochs % len) as usize) {
                *place = header.epoch;
            }
            self.epochs += 1;
        }
        let next = header.sequence.saturating_add(1);
        if let Some(seen) = self
            .writers
            .iter_mut()
            .flatten()
            .find(|s| s.writer == writer)
        {
            self.lost = self
                .lost
                .saturating_add(header.sequence.saturating_sub(seen.next));
            seen.next = next;
            seen.last_taken = self.taken;
            return;
        }
        if !self.predecessors.contains(&writer) {
            self.lost = self.lost.saturating_add(header.sequence);
        }
        // A free place, else the place of the writer that has been silent for longest: it is dead.
        let place = self
            .writers
            .iter_mut()
            .min_by_key(|s| s.map_or(0, |s| s.last_taken));
        if let Some(place) = place {
            *place = Some(SeenWriter {
                writer,
                next,
                last_taken: self.taken,
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;

    fn header(epoch: u64, sequence: u64) -> Header {
        Header {
            epoch,
            sequence,
            ..Header::default()
        }
    }

    #[test]
    fn gaps_are_counted_per_writer() {
        let mut tally = SequenceTally::new(vec![1]);
        for (writer, epoch, sequence, lost) in [
            (1, 7, 100, 0), // older than the reader: no loss
            (1, 7, 101, 0),
            (2, 8, 0, 0),
            (1, 7, 104, 2),
            (2, 8, 1, 2),
            (3, 9, 5, 7), // younger: its first five are lost
            (3, 9, 6, 7),
        ] {
            tally.count(writer, &header(epoch, sequence));
            assert_eq!(tally.lost, lost, "writer {writer} sequence {sequence}");
        }
        assert_eq!((tally.epochs, tally.taken), (3, 7));
    }

    #[test]
    fn any_number_of_restarts_is_counted() {
        let mut tally = SequenceTally::new(vec![]);
        for restart in 0..100 {
            tally.count(u128::from(restart), &header(1000 + restart, 0));
            tally.count(u128::from(restart), &header(1000 + restart, 1));
        }
        assert_eq!((tally.epochs, tally.lost), (100, 0));
    }

    /// A bus that goes on is not forgotten for those that come and go.
    #[test]
    fn restarts_of_others_are_no_loss_of_one_that_goes_on() {
        let mut tally = SequenceTally::new(vec![]);
        for restart in 0..100 {
            tally.count(u128::from(1000 + restart), &header(1000 + restart, 0));
            tally.count(1, &header(1, restart));
        }
        assert_eq!(tally.lost, 0);
    }

    #[test]
    fn freshness_is_a_comparison_of_ages() {
        let max_age = Nanos(10);
        assert_eq!(Freshness::of(None, Nanos(5), max_age), Freshness::NeverSeen);
        assert_eq!(
            Freshness::of(Some(Nanos(0)), Nanos(10), max_age),
            Freshness::Fresh { age: Nanos(10) }
        );
        assert_eq!(
            Freshness::of(Some(Nanos(0)), Nanos(11), max_age),
            Freshness::Stale { age: Nanos(11) }
        );
        assert!(
            Freshness::of(Some(Nanos(12)), Nanos(11), max_age).is_fresh(),
            "stamped by a clock a little ahead"
        );
    }
}
