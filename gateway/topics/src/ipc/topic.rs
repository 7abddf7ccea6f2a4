//! The services: payload type, name and quality of service of each.

use crate::{
    ContactDeclaration, ContactEstimate, Description, DriveEstimate, EstimatorHealth,
    GatewayHealth, Header, InertiaEstimate, Sample, TorqueBudget, TorqueEstimate,
};
use core::fmt::Debug;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

/// The quality of service of one service; the first process to create the service fixes it.
///
/// A publisher reserves `subscribers * (buffer + 1) + history + 1` payloads in shared memory, which
/// are allocated when it is created.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QualityOfService {
    /// Maximum number of writers at one time; 1 where a second writer would be a mistake.
    pub publishers: usize,
    /// Maximum number of readers at one time.
    pub subscribers: usize,
    /// Maximum number of processes (open domains) at one time, writers and readers together.
    pub nodes: usize,
    /// Number of payloads of each writer that wait for a reader; when full, the oldest is replaced.
    pub buffer: usize,
    /// Number of its last payloads that a writer gives to a reader that opens late.
    pub history: usize,
}

impl QualityOfService {
    /// Number of payloads for which a writer has room: what all readers may hold at once, and the
    /// one that it writes.
    #[must_use]
    pub fn payloads(&self) -> usize {
        self.subscribers * (self.buffer + BORROWED) + self.history + LOANED
    }
}

/// Number of payloads that a reader looks at, and that a writer writes, at one time.
pub(super) const BORROWED: usize = 1;
pub(super) const LOANED: usize = 1;

/// A payload type with its own service `<robot>/<SUFFIX>`.
///
/// The version of its layout is in its type name (`proprio/Sample/2`): a reader of another version
/// gets `PortError::Incompatible`, never a misread payload. Any bytes are a legal payload
/// (`FromBytes`), though not a valid one. To add a service, implement this trait.
pub trait Topic: ZeroCopySend + FromBytes + Copy + Debug + 'static {
    /// The service's name after the robot's.
    const SUFFIX: &'static str;
    /// Its quality of service.
    const QUALITY: QualityOfService;

    /// The header.
    fn header(&self) -> &Header;
    /// The header, which the writer fills in.
    fn header_mut(&mut self) -> &mut Header;
    /// Whether its numbers have a meaning: codes that exist, counts within their arrays. A reader
    /// skips and counts a payload without.
    fn is_valid(&self) -> bool;
}

/// `topic!(payload, suffix, quality, what makes it valid)`.
macro_rules! topic {
    ($payload:ty, $suffix:literal, $quality:expr, $is_valid:expr) => {
        impl Topic for $payload {
            const SUFFIX: &'static str = $suffix;
            const QUALITY: QualityOfService = $quality;
            fn header(&self) -> &Header {
                &self.header
            }
            fn header_mut(&mut self) -> &mut Header {
                &mut self.header
            }
            fn is_valid(&self) -> bool {
                let is_valid: fn(&Self) -> bool = $is_valid;
                self.header.stamp.get().is_some() && is_valid(self)
            }
        }
    };
}

/// Whether `count` entries fit `entries`.
fn within<E>(count: u32, entries: &[E]) -> bool {
    count as usize <= entries.len()
}

/// A quality: the most writers and readers, and how many payloads wait and are given to who opens
/// late.
const fn quality(
    [publishers, subscribers]: [usize; 2],
    [buffer, history]: [usize; 2],
) -> QualityOfService {
    QualityOfService {
        publishers,
        subscribers,
        nodes: 64,
        buffer,
        history,
    }
}

// One publisher per bus, 2 MB each. 256 samples are 32 ms of the 8000 frames a second that a bus of
// 1 Mbit/s carries at most, and a quarter of a second of ten channels at 100 Hz.
topic!(
    Sample,
    "samples",
    quality([crate::MAX_BUSES, 32], [256, 0]),
    |sample| sample.reading().is_some()
);
// One writer each in gateway and estimator, and one more of each while a predecessor still ends.
topic!(Description, "description", quality([4, 32], [1, 1]), |d| {
    d.publisher.get().is_some()
        && within(d.count, &d.entries)
        && (d.entries().iter()).all(|e| e.role.get().is_some() && e.kind.get().is_some())
});
// A control loop needs only the newest; 64 let a recorder pause for 64 ms at 1 kHz.
topic!(
    TorqueEstimate,
    "estimate/torque",
    quality([1, 24], [64, 0]),
    |e| {
        within(e.count, &e.joints) && e.joints().iter().all(|joint| joint.reason.get().is_some())
    }
);
topic!(
    ContactEstimate,
    "estimate/contact",
    quality([1, 24], [64, 0]),
    |e| {
        within(e.count, &e.contacts)
            && within(e.residual_count, &e.residuals)
            && e.contacts()
                .iter()
                .all(|contact| contact.reason.get().is_some())
    }
);
// Sent once a second: a reader that reads every few seconds misses none, and one that opens late
// need not wait.
topic!(
    InertiaEstimate,
    "estimate/inertia",
    quality([1, 16], [4, 1]),
    |e| within(e.link_count, &e.links) && within(e.offset_count, &e.offsets)
);
// Of one joint after another, for a person who asks: who misses some sees the next round.
topic!(
    TorqueBudget,
    "estimate/budget",
    quality([1, 4], [8, 0]),
    |b| {
        within(b.count, &b.parts)
            && b.torque.reason.get().is_some()
            && b.parts().iter().all(|part| part.source.get().is_some())
    }
);
// For people and monitors: a reader that misses some sees the next one.
topic!(
    DriveEstimate,
    "estimate/drive",
    quality([1, 8], [16, 0]),
    |e| {
        within(e.count, &e.drives)
            && within(e.candidate_count, &e.candidates)
            && e.drives()
                .iter()
                .all(|own| own.agreement.get().is_some() && own.reason.get().is_some())
            && e.candidates().iter().all(|own| own.kind.get().is_some())
    }
);
topic!(
    ContactDeclaration,
    "contact/declared",
    quality([8, 8], [64, 1]),
    |_| true
);
// One gateway and one estimator per robot: the health service admits one publisher, so the second
// is refused.
topic!(
    GatewayHealth,
    "health/gateway",
    quality([1, 16], [1, 1]),
    |h| {
        within(h.bus_count, &h.buses)
            && within(h.device_count, &h.devices)
            && (h.buses().iter())
                .all(|b| b.link.get().is_some() && b.interface.controller.get().is_some())
            && h.devices()
                .iter()
                .all(|device| device.state.get().is_some())
    }
);
topic!(
    EstimatorHealth,
    "health/estimator",
    quality([1, 16], [8, 1]),
    |_| true
);
