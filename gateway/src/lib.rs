//! The gateway reads CAN buses and publishes SI samples in shared memory.
//!
//! ```text
//! CAN bus <-> Link -> Frame -> Device -> Reading -> Joints -> Sink -> shared memory
//!             socketcan        (drivers)                      publish
//!             replay
//!             virtual bus
//! ```
//!
//! - [`config`]: the raw contents of gateway.toml; [`plan`]: the checked and resolved form, which
//!   everything else uses.
//! - `dbc`, `eds`: files that describe devices, as tables for the drivers.
//! - [`link`]: one trait and three links to a bus; [`log`]: recorded buses, which replay and decode
//!   read, and the log format that encode writes.
//! - [`joints`]: from the outputs of devices to joints: gears, turns, couplings, several devices at
//!   one joint; and back.
//! - [`load`]: the share of a bus's time that its devices need.
//! - [`decoder`]: all devices of one bus, without input or output; [`bus`]: the loop that moves
//!   frames through it; [`inbox`]: what the control plane asks of it while it runs.
//! - [`publish`]: the destinations of samples; [`status`]: the counters of a bus thread.
//! - [`scan`]: which devices are on a bus, and a configuration for them.
//! - [`offline`]: converts a log to a table of samples and back, without a daemon.
//! - [`daemon`]: the control plane: threads, signals, health, log lines, watchdog; [`control`]: the
//!   socket over which it is asked while it runs.
//! - `watch`: tells of devices that the configuration does not know.
//! - [`clock`]: the only place that reads a clock.

pub mod bus;
pub mod clock;
pub mod config;
pub mod control;
pub mod daemon;
mod dbc;
pub mod decoder;
mod dispatch;
mod eds;
mod health;
pub mod inbox;
pub mod joints;
mod journal;
pub mod link;
pub mod load;
pub mod log;
pub mod offline;
mod operator;
pub mod plan;
pub mod publish;
mod reload;
pub mod scan;
#[cfg(test)]
#[path = "../../tests/schema.rs"]
mod schema;
pub mod status;
mod thread;
mod watch;
