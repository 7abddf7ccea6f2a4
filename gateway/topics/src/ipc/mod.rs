//! Ports in shared memory, with which Proprio's processes and consumers send and read payloads.
//!
//! - [`Domain`]: a shared-memory domain: a directory and a name. Processes communicate only within
//!   one domain.
//! - [`Topic`]: the services, one per payload type, with their quality of service.
//! - [`Writer`]: sends a payload; never waits for a reader.
//! - [`Reader`]: takes payloads in order, or the newest; counts losses; opens a service but never
//!   creates one.
//! - [`RobotReader`]: for control loops: torques, contacts and measurements by name, or the reason
//!   why one is not available.
//! - [`Freshness`]: the age of the last payload read.
//! - [`monotonic`]: the clock of all stamps, for the outermost loop of a consumer.
//!
//! # Crashes
//! iceoryx2 0.10 survives the death of a process except while it creates a resource: the unfinished
//! files then make every later opening fail or hang. Therefore this module holds the domain's file
//! lock whenever it creates or removes a resource. The lock dies with its process, so the next
//! holder knows that an unfinished resource belongs to a dead process, and removes it at once
//! ([`SweepCounts`] counts it). `send` and `try_take` need no lock: both kinds of port make their
//! connections before they register, so the other side opens only finished ones.
//!
//! # Threads
//! A [`Domain`] can be cloned and sent to other threads. Ports cannot: each thread creates its own.
//! This keeps `send` and `try_take` free of locks; iceoryx2's sendable ports take a mutex in every
//! call. Only [`RobotReader`] uses those: one thread opens a port, another reads it, and no two use
//! it at a time, so that the mutex is always free.

mod bell;
mod clock;
mod domain;
mod error;
mod failures;
mod guard;
mod lock;
mod memory;
mod presence;
mod reader;
mod renewal;
mod robot;
mod sweep;
mod topic;
mod writer;

pub use clock::monotonic;
pub use domain::{Domain, DomainConfig, fnv1a};
pub use error::{DomainError, PortError, SendError, TakeError, open_files_remedy};
pub use memory::memory_needed;
pub use presence::{Presence, RobotPresence, Watch};
pub use reader::{Freshness, Reader};
pub use renewal::{Renewal, Renewing};
pub use robot::{
    ChannelHandle, Contact, ContactHandle, Measured, Missing, RobotReader, Torque, TorqueHandle,
    Unavailable,
};
pub use sweep::SweepCounts;
pub use topic::{QualityOfService, Topic};
pub use writer::{Sent, Writer};
