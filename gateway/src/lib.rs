//! The gateway reads CAN buses and publishes SI samples in shared memory.
//!
//! ```text
//! CAN bus <-> Link -> Frame -> Device -> Reading -> JointMap -> Sink -> shared memory
//!             socketcan        (drivers)            (plan)      publish
//!             replay
//!             virtual bus
//! ```
//!
//! - [`config`]: the raw contents of gateway.toml; [`plan`]: the checked and resolved form, which
//!   everything else uses.
//! - `dbc`, `eds`: files that describe devices, as tables for the drivers.
//! - [`link`]: one trait and three links to a bus; [`candump`]: the log format of replay, decode
//!   and encode.
//! - [`load`]: the share of a bus's time that its devices need.
//! - [`decoder`]: all devices of one bus, without input or output; [`bus`]: the loop that moves
//!   frames through it; [`inbox`]: what the control plane asks of it while it runs.
//! - [`publish`]: the destinations of samples; [`status`]: the counters of a bus thread.
//! - [`offline`]: converts a log to a table of samples and back, without a daemon.
//! - [`daemon`]: the control plane: threads, signals, health, log lines, watchdog; [`control`]: the
//!   socket over which it is asked while it runs.
//! - [`clock`]: the only place that reads a clock.

pub mod bus;
pub mod candump;
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
pub mod link;
pub mod load;
pub mod offline;
mod operator;
pub mod plan;
pub mod publish;
mod reload;
pub mod status;
mod thread;
