#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

pub mod bus;
pub mod clock;
pub mod config;
pub mod control;
pub mod daemon;
mod dbc;
pub mod devices;
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
