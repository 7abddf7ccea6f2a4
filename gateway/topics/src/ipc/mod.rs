//! Ports in shared memory: what a process of Proprio, or a consumer, needs to send and to read.
//!
//! - [`Domain`]: one shared-memory domain, a directory and a name. Processes meet only inside one domain.
//! - [`Topic`]: the services, one per payload type, with their quality of service; here and nowhere else.
//! - [`Writer`]: sends a payload; never waits for a reader.
//! - [`Reader`]: takes payloads in order, or the newest; counts what it lost; opens, never creates.
//! - [`TorqueReader`]: what a control loop wants: the torque of a joint, or the reason why there is none.
//! - [`Freshness`]: how old is what was read.
//! - [`monotonic`]: the clock that all stamps are of, for the outermost loop of a consumer.
//!
//! # Crashes
//! iceoryx2 0.10 survives the death of a process at any time but one: killed while it creates something, it leaves
//! files that make every later opening fail, or hang. Therefore everything here that creates or removes a resource does so
//! while it holds the domain's file lock, which dies with its process; whatever looks unfinished to the next holder of
//! the lock is then known to be a dead process's, and is removed at once ([`Swept`] counts it). `send` and `try_take` need no lock:
//! both kinds of port make their connections before they register, so the other side only ever opens finished ones.
//!
//! # Threads
//! A [`Domain`] can be cloned and sent to other threads. Ports cannot: a thread creates its own. That is what keeps `send` and
//! `try_take` free of locks; iceoryx2's sendable ports take a mutex in every call.

mod clock;
mod domain;
mod error;
mod lock;
mod reader;
mod sweep;
mod topic;
mod torque;
mod writer;

pub use clock::monotonic;
pub use domain::{Domain, DomainConfig};
pub use error::{DomainError, PortError, SendError, TakeError};
pub use reader::{Freshness, Reader};
pub use sweep::Swept;
pub use topic::{QualityOfService, Topic};
pub use torque::{NoTorque, Torque, TorqueReader};
pub use writer::{Sent, Writer};
