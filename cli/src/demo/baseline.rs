//! The estimates with the CAD's inertial parameters: a second pipeline, which processes the samples
//! of the running demonstration, with the offsets that identification finds.

use proprio_dynamics::spatial::Wrench;
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_topics::ipc::{Reader, TakeError};
use proprio_topics::{
    ContactDeclaration, Description, MAX_CHANNELS, Nanos, Publisher, Role, Sample, SensorOffset,
};

/// The second pipeline and its inputs.
pub(super) struct Baseline {
    pipeline: Pipeline,
    samples: Reader<Sample>,
    descriptions: Reader<Description>,
    declarations: Reader<ContactDeclaration>,
    /// Per channel number of the gateway: the pipeline's channel.
    channels: Vec<Option<usize>>,
    /// The gateway's epoch that `channels` belongs to.
    epoch: u64,
    inbox: Vec<Sample>,
    /// The results, as [`Baseline::finish`] returns them.
    torques: Vec<(Nanos, Box<[f64]>)>,
}

impl Baseline {
    pub(super) fn new(setup: Setup, readers: Readers) -> Self {
        let Readers {
            samples,
            descriptions,
            declarations,
        } = readers;
        Self {
            pipeline: Pipeline::new(setup),
            samples,
            descriptions,
            declarations,
            channels: vec![],
            epoch: 0,
            inbox: vec![],
            torques: vec![],
        }
    }

    /// Uses these offsets of F/T sensors from now on, so that the CAD's torques and the identified
    /// ones differ in the inertial parameters alone.
    pub(super) fn take_offsets(&mut self, offsets: &[SensorOffset]) {
        for offset in offsets.iter().filter(|offset| offset.accepted == 1) {
            if let Some(sensor) = self.pipeline.setup().robot.sensor(offset.name.as_str()) {
                let reading = Wrench::from_parts(offset.force, offset.torque);
                self.pipeline.set_offset(sensor, reading);
            }
        }
    }

    /// Takes the waiting samples.
    pub(super) fn turn(&mut self) -> Result<(), TakeError> {
        while let Some(description) = self.descriptions.try_take()? {
            if description.publisher == Publisher::Gateway {
                self.channels = (0..MAX_CHANNELS)
                    .map(|number| {
                        let entry = description.find(Role::Channel, u32::try_from(number).ok()?)?;
                        self.pipeline
                            .setup()
                            .channel(entry.kind.get()?, entry.name.as_str())
                    })
                    .collect();
                self.epoch = description.header.epoch;
            }
        }
        while let Some(declared) = self.declarations.try_take()? {
            if let Some(contact) = self
                .pipeline
                .setup()
                .robot
                .contact(declared.contact.as_str())
            {
                self.pipeline
                    .declare(contact, declared.header.acquired, &declared.state());
            }
        }
        while let Some(sample) = self.samples.try_take()? {
            self.inbox.push(sample);
        }
        // Shared memory returns all samples of one bus before those of the next; samples too far
        // behind others would be dropped.
        self.inbox
            .sort_unstable_by_key(|s| (s.header.acquired, s.header.bus, s.header.sequence));
        for sample in std::mem::take(&mut self.inbox) {
            let channel = self
                .channels
                .get(sample.channel as usize)
                .copied()
                .flatten();
            if let Some(channel) = channel.filter(|_| sample.header.epoch == self.epoch)
                && let Some(reading) = sample.reading()
            {
                let (t, quality) = (sample.header.acquired, sample.header.quality);
                self.pipeline.push(channel, t, &reading, quality);
                self.keep();
            }
        }
        Ok(())
    }

    /// Stores the estimates.
    fn keep(&mut self) {
        while let Some(estimate) = self.pipeline.poll() {
            let torques = estimate
                .torques
                .joints()
                .iter()
                .map(|joint| joint.torque)
                .collect();
            self.torques.push((estimate.t, torques));
        }
    }

    /// The instants, ascending, with the joints' torques \[Nm\]; NaN where withheld.
    pub(super) fn finish(mut self) -> Vec<(Nanos, Box<[f64]>)> {
        self.pipeline.finish();
        self.keep();
        self.torques
    }
}

/// The inputs of a [`Baseline`].
pub(super) struct Readers {
    pub(super) samples: Reader<Sample>,
    pub(super) descriptions: Reader<Description>,
    pub(super) declarations: Reader<ContactDeclaration>,
}
