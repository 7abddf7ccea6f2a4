//! Destinations of samples: shared memory, or a vector in tests.

use proprio_topics::ipc::{Domain, Renewal, Renewing, Writer};
use proprio_topics::{Nanos, Sample};
use std::sync::Arc;

/// A sample could not be published. It is lost; the next one is not affected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the sample could not be published")]
pub struct SinkError;

/// A destination of samples. Never waits for readers.
pub trait Sink {
    /// Publishes a sample at `now`, with its sequence number and publication stamp, and in shared
    /// memory the epoch. Returns the number of readers that this call connected.
    ///
    /// # Errors
    /// [`SinkError`]: the sample was not published.
    fn publish(&mut self, sample: &mut Sample, now: Nanos) -> Result<u32, SinkError>;

    /// Called when there has been nothing to do for a while, at `now`.
    fn idle(&mut self, _now: Nanos) {}
}

/// Keeps all samples: for tests.
#[derive(Debug, Default)]
pub struct Memory {
    /// The published samples, in order.
    pub samples: Vec<Sample>,
}

impl Sink for Memory {
    fn publish(&mut self, sample: &mut Sample, now: Nanos) -> Result<u32, SinkError> {
        sample.header.sequence = self.samples.len() as u64;
        sample.header.published = now;
        self.samples.push(*sample);
        Ok(0)
    }
}

/// Shared memory: `<robot>/samples`.
#[derive(Debug)]
pub struct SharedMemory {
    writer: Writer<Sample>,
    robot: String,
    renewing: Renewing,
}

impl SharedMemory {
    /// Publishes the samples of `robot` with `writer`, until a `renewal`.
    pub fn new(writer: Writer<Sample>, robot: &str, renewal: Arc<Renewal>) -> Self {
        Self {
            writer,
            robot: robot.to_owned(),
            renewing: Renewing::new(renewal),
        }
    }

    /// Makes the writer anew if a domain was passed; until it can be made, samples are lost and
    /// counted.
    fn renew(&mut self, now: Nanos) {
        let robot = &self.robot;
        let create = |domain: &Domain| Writer::create(domain, robot, domain.epoch());
        match self.renewing.ports(now, create) {
            Some(Ok(writer)) => self.writer = writer,
            Some(Err(error)) => {
                tracing::error!("samples cannot be published: {error}; trying again");
            }
            None => {}
        }
    }
}

impl Sink for SharedMemory {
    fn publish(&mut self, sample: &mut Sample, now: Nanos) -> Result<u32, SinkError> {
        self.renew(now);
        let sent = self.writer.send(sample, now).map_err(|_| SinkError)?;
        Ok(u32::try_from(sent.connected).unwrap_or(u32::MAX))
    }

    fn idle(&mut self, now: Nanos) {
        self.renew(now);
        // A reader that cannot be connected now is connected, or counted as a failure, with the
        // next sample.
        let _ = self.writer.update_connections();
    }
}
