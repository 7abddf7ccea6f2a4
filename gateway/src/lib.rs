//! CAN buses in, SI samples in shared memory out.
//!
//! ```text
//! CAN bus <-> Link -> Frame -> Device -> Reading -> JointMap -> Sink -> shared memory
//!             socketcan        (drivers)            (plan)      publish
//!             replay
//!             virtual bus
//! ```
//!
//! - [`config`]: gateway.toml, as typed; [`plan`]: the same, checked and resolved. Nothing else sees the raw form.
//! - [`link`]: one trait, three links to a bus; [`candump`]: the log format that replay, decode and encode share.
//! - [`decoder`]: all devices of one bus, without input or output; [`bus`]: the loop that moves frames through it.
//! - [`publish`]: where samples go; [`status`]: what a bus thread counts.
//! - [`offline`]: a log to a table of samples and back, without a daemon.
//! - [`daemon`]: the control plane: threads, signals, health, watchdog.
//! - [`clock`]: the only place that reads a clock.

pub mod bus;
pub mod candump;
pub mod clock;
pub mod config;
pub mod daemon;
pub mod decoder;
pub mod link;
pub mod offline;
pub mod plan;
pub mod publish;
pub mod status;
