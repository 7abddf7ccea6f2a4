//! Where samples go: shared memory, or a vector in tests.

use proprio_topics::ipc::Writer;
use proprio_topics::{Nanos, Sample};

/// A sample that could not be handed on. It is lost; the next one is not affected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the sample could not be published")]
pub struct SinkError;

/// Takes samples. Never waits for whoever reads them.
pub trait Sink {
    /// Hands on a sample at `now`; fills in its epoch, sequence number and publication stamp. Returns how many readers
    /// were newly attached by this call.
    ///
    /// # Errors
    /// [`SinkError`]: the sample was not handed on.
    fn publish(&mut self, sample: &mut Sample, now: Nanos) -> Result<u32, SinkError>;

    /// Called when there was nothing to do for a while.
    fn idle(&mut self) {}
}

/// Keeps all samples: for tests.
#[derive(Debug, Default)]
pub struct Memory {
    /// What was published, in order.
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
pub struct Shared(pub Writer<Sample>);

impl Sink for Shared {
    fn publish(&mut self, sample: &mut Sample, now: Nanos) -> Result<u32, SinkError> {
        let sent = self.0.send(sample, now).map_err(|_| SinkError)?;
        Ok(u32::try_from(sent.connected).unwrap_or(u32::MAX))
    }

    fn idle(&mut self) {
        // A reader that can not be connected now is connected, or counted, with the next sample.
        let _ = self.0.update_connections();
    }
}
