//! Sends the payloads of one topic. Never waits for a reader.

use super::bell::Bell;
use super::domain::service_name;
use super::error::transport;
use super::failures::Failures;
use super::memory;
use super::topic::{BORROWED, LOANED};
use super::{Domain, PortError, SendError, Topic};
use crate::{Header, Nanos};
use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{LoanError, SendError as IoxSendError};
use iceoryx2::prelude::{
    BackpressureStrategy, CallbackProgression, MessagingPattern, PortFactory as _, ServiceName, ipc,
};
use iceoryx2::service::Service;
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeOpenError as OpenError, PublishSubscribeOpenOrCreateError as OpenOrCreateError,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use iceoryx2::service::static_config::message_type_details::{TypeDetail, TypeVariant};
use std::format;
use std::string::{String, ToString};

/// The result of sending a payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sent {
    /// Its sequence number, as in `header.sequence`.
    pub sequence: u64,
    /// Number of readers that received it.
    pub readers: usize,
    /// Number of reader connections made: the only work in `send` whose duration varies (a few
    /// mapped files each).
    pub connected: usize,
}

type Publication<T> = (
    Publisher<ipc::Service, T, ()>,
    PortFactory<ipc::Service, T, ()>,
);

/// The sending end of a topic. Belongs to one thread: create it where it is used.
#[derive(Debug)]
pub struct Writer<T: Topic> {
    // `Some` until drop; dropped under the domain's lock.
    ports: Option<Publication<T>>,
    domain: Domain,
    bell: Bell,
    failures: Failures,
    epoch: u64,
    sequence: u64,
    readers: usize,
}

impl<T: Topic> Writer<T> {
    /// Creates a writer of `<robot>/<T::SUFFIX>`, and the service if it does not exist.
    ///
    /// `epoch` goes into every header. It is the same for all writers of a publisher and new at
    /// each of its starts ([`Domain::epoch`]). A gateway (estimator) creates its health writer
    /// first: this fails if the robot already has a gateway (estimator).
    ///
    /// # Errors
    /// [`PortError::Taken`] if the topic has its maximum number of writers;
    /// [`PortError::Incompatible`] if a live process uses another version of the topic; others as
    /// [`Domain::open`].
    pub fn create(domain: &Domain, robot: &str, epoch: u64) -> Result<Self, PortError> {
        let name = service_name(robot, T::SUFFIX)?;
        let quality = T::QUALITY;
        let failures = Failures::default();
        let (publisher, service, readers, bell) = domain.locked(memory::needed::<T>(), |node| {
            let service = node
                .service_builder(&name)
                .publish_subscribe::<T>()
                .max_publishers(quality.publishers)
                .max_subscribers(quality.subscribers)
                .max_nodes(quality.nodes)
                .subscriber_max_buffer_size(quality.buffer)
                .subscriber_max_borrowed_samples(BORROWED)
                .history_size(quality.history)
                .enable_safe_overflow(true)
                .open_or_create()
                .map_err(|e| match e {
                    OpenOrCreateError::PublishSubscribeOpenError(e) => {
                        explain::<T, _>(domain, &name, e)
                    }
                    e => PortError::Transport {
                        service: name.to_string(),
                        problem: transport(e),
                    },
                })?;
            let bell = domain.bell(&name)?;
            bell.change();
            let publisher = service
                .publisher_builder()
                .max_loaned_samples(LOANED)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .set_degradation_handler(failures.handler())
                .create()
                .map_err(|e| match e {
                    PublisherCreateError::ExceedsMaxSupportedPublishers => {
                        let mut holder = 0;
                        service.dynamic_config().list_publishers(|p| {
                            holder = domain.process_of(p.node_id.value()).unwrap_or(0);
                            CallbackProgression::Stop
                        });
                        PortError::Taken {
                            service: name.to_string(),
                            most: quality.publishers,
                            holder,
                        }
                    }
                    e => PortError::Transport {
                        service: name.to_string(),
                        problem: transport(e),
                    },
                })?;
            let readers = service.dynamic_config().number_of_subscribers();
            Ok((publisher, service, readers, bell))
        })?;
        Ok(Self {
            ports: Some((publisher, service)),
            domain: domain.clone(),
            bell,
            failures,
            epoch,
            sequence: 0,
            readers,
        })
    }

    /// Sends a copy of `value`, with epoch, sequence number and `published` (now \[ns\]) in its
    /// header.
    ///
    /// A reader that is too slow loses its oldest payloads. Allocates once, 48 bytes in iceoryx2.
    /// Makes no system call unless a reader has opened or closed, or waits
    /// ([`Reader::wait`](super::Reader::wait)). If a reader cannot be connected, as without free
    /// file descriptors, tries again every 0.1 s.
    ///
    /// # Errors
    /// [`SendError`]; the sequence number is used up, so that readers count the loss.
    pub fn send(&mut self, value: &T, published: Nanos) -> Result<Sent, SendError> {
        let sequence = self.sequence;
        self.sequence += 1;
        let epoch = self.epoch;
        self.put(value, |header| {
            header.epoch = epoch;
            header.sequence = sequence;
            header.published = published;
        })
    }

    /// Sends a copy of `value` as it is, with the epoch, sequence number and stamps of its first
    /// publisher: for a bridge that carries the payloads of another machine.
    ///
    /// # Errors
    /// As [`Writer::send`].
    pub fn forward(&mut self, value: &T) -> Result<Sent, SendError> {
        self.put(value, |_| {})
    }

    /// Connects new readers and gives them the history. Call it regularly while there is nothing to
    /// send. Returns the number of connections made.
    ///
    /// # Errors
    /// [`SendError::Connection`] if one could not be made.
    pub fn update_connections(&mut self) -> Result<usize, SendError> {
        let connected = self.newcomers();
        self.retry();
        let Some((publisher, _)) = &self.ports else {
            return Err(SendError::Internal);
        };
        let guard = self.domain.guard();
        let updated = guard.survive(|| publisher.update_connections());
        updated
            .ok_or(SendError::Connection)?
            .map_err(|_| SendError::Connection)?;
        // A new reader has the history now.
        self.bell.ring();
        match self.failures.any() {
            false => Ok(connected),
            true => Err(SendError::Connection),
        }
    }

    /// The sequence number of the next payload.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    /// Number of readers now.
    #[must_use]
    pub fn readers(&self) -> usize {
        let ports = self.ports.as_ref();
        let count =
            |(_, service): &Publication<T>| service.dynamic_config().number_of_subscribers();
        let counted = self.domain.guard().survive(|| ports.map_or(0, count));
        counted.unwrap_or(0)
    }

    fn put(&mut self, value: &T, fill: impl FnOnce(&mut Header)) -> Result<Sent, SendError> {
        let connected = self.newcomers();
        self.retry();
        let Some((publisher, _)) = &self.ports else {
            return Err(SendError::Internal);
        };
        let sent = self.domain.guard().survive(|| {
            let mut sample = publisher
                .loan_uninit()
                .map_err(|e| send_error(e.into()))?
                .write_payload(*value);
            let header = sample.payload_mut().header_mut();
            fill(header);
            let sequence = header.sequence;
            Ok((sequence, sample.send().map_err(send_error)?))
        });
        let (sequence, readers) = sent.ok_or(SendError::Connection)??;
        self.bell.ring();
        if self.failures.any() {
            return Err(SendError::Connection);
        }
        Ok(Sent {
            sequence,
            readers,
            connected,
        })
    }

    /// Lets iceoryx2 connect to the readers again after a failure: it does so whenever a reader
    /// comes or goes.
    fn retry(&mut self) {
        if !self.failures.is_due() {
            return;
        }
        let Some((_, service)) = &self.ports else {
            return;
        };
        self.failures.forget();
        let came_and_went = self
            .domain
            .try_locked(|| service.subscriber_builder().create().is_ok());
        if came_and_went != Some(true) {
            self.failures.note();
        }
    }

    /// Increase of the number of readers since the last call. A reader that opens while another
    /// closes is not seen.
    fn newcomers(&mut self) -> usize {
        let before = self.readers;
        self.readers = self.readers();
        self.readers.saturating_sub(before)
    }
}

impl<T: Topic> Drop for Writer<T> {
    fn drop(&mut self) {
        if self.domain.is_usable() {
            self.bell.change();
            self.bell.say_farewell();
        }
        let ports = self.ports.take();
        self.domain.drop_locked(ports);
    }
}

fn send_error(e: IoxSendError) -> SendError {
    match e {
        IoxSendError::LoanError(LoanError::OutOfMemory) => SendError::OutOfMemory,
        IoxSendError::ConnectionError(_)
        | IoxSendError::ConnectionCorrupted
        | IoxSendError::UnableToDeliver => SendError::Connection,
        _ => SendError::Internal,
    }
}

/// Converts the reason why a service cannot be opened into a message. Called under the lock.
pub(super) fn explain<T: Topic, S: Service>(
    domain: &Domain<S>,
    name: &ServiceName,
    e: OpenError,
) -> PortError {
    let service = name.to_string();
    match e {
        OpenError::DoesNotExist | OpenError::IsMarkedForDestruction => {
            PortError::NotYet { service }
        }
        OpenError::InsufficientPermissions => PortError::Denied { service },
        OpenError::ExceedsMaxNumberOfNodes => PortError::Full {
            service,
            what: "process",
        },
        OpenError::IncompatibleTypes
        | OpenError::IncompatibleMessagingPattern
        | OpenError::IncompatibleAttributes
        | OpenError::IncompatibleOverflowBehavior
        | OpenError::VersionMismatch
        | OpenError::DoesNotSupportRequestedMinBufferSize
        | OpenError::DoesNotSupportRequestedMinHistorySize
        | OpenError::DoesNotSupportRequestedMinSubscriberBorrowedSamples
        | OpenError::DoesNotSupportRequestedAmountOfPublishers
        | OpenError::DoesNotSupportRequestedAmountOfSubscribers
        | OpenError::DoesNotSupportRequestedAmountOfNodes => {
            let needed = TypeDetail::new::<T>(TypeVariant::FixedSize);
            let offered =
                ipc::Service::details(name, domain.iceoryx(), MessagingPattern::PublishSubscribe);
            let offered = match offered {
                Ok(Some(details)) => {
                    let offered = details
                        .static_details
                        .publish_subscribe()
                        .message_type_details()
                        .payload;
                    if offered == needed {
                        format!(
                            "{} with another capacity (iceoryx2: {e})",
                            describe(&offered)
                        )
                    } else {
                        describe(&offered)
                    }
                }
                _ => format!("something else (iceoryx2: {e})"),
            };
            PortError::Incompatible {
                service,
                offered,
                needed: describe(&needed),
            }
        }
        e => PortError::Transport {
            service,
            problem: transport(e),
        },
    }
}

fn describe(detail: &TypeDetail) -> String {
    format!("{} ({} bytes)", detail.type_name(), detail.size())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ipc::DomainConfig;
    use crate::{
        ContactDeclaration, ContactEstimate, Description, DriveEstimate, EstimatorHealth,
        GatewayHealth, InertiaEstimate, Sample, TorqueBudget, TorqueEstimate,
    };
    use std::fs;

    /// The segments that a writer makes.
    fn made<T: Topic>() -> u64 {
        let base = tempfile::tempdir().unwrap();
        let domain = Domain::open(&DomainConfig::new(base.path(), "test")).unwrap();
        let length = || -> u64 {
            let entries = fs::read_dir("/dev/shm").unwrap().flatten();
            let segments = entries.filter(|entry| {
                let name = entry.file_name();
                name.to_string_lossy().starts_with(domain.prefix())
            });
            segments
                .map(|entry| entry.metadata().map_or(0, |meta| meta.len()))
                .sum()
        };
        let before = length();
        let _writer = Writer::<T>::create(&domain, "icub", 1).unwrap();
        length() - before
    }

    #[test]
    fn the_memory_that_a_writer_needs_is_known_before() {
        fn compared<T: Topic>() -> (&'static str, u64, u64) {
            (T::SUFFIX, made::<T>(), memory::needed::<T>())
        }
        for (topic, made, needed) in [
            compared::<Sample>(),
            compared::<Description>(),
            compared::<TorqueEstimate>(),
            compared::<ContactEstimate>(),
            compared::<InertiaEstimate>(),
            compared::<TorqueBudget>(),
            compared::<DriveEstimate>(),
            compared::<ContactDeclaration>(),
            compared::<GatewayHealth>(),
            compared::<EstimatorHealth>(),
        ] {
            std::println!("{topic}: {made} of {needed}");
            // Connections to readers that exist come on top.
            assert!(
                made + memory::BESIDE / 4 < needed,
                "{topic}: {made} of {needed}"
            );
            assert!(
                needed < made + made / 4 + memory::BESIDE,
                "{topic}: {made} of {needed}"
            );
        }
    }
}
