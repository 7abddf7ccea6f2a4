#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

pub mod assessment;
pub mod check;
pub mod config;
pub mod daemon;
mod description;
pub mod differentiate;
pub mod drive;
pub mod export;
pub mod files;
mod first_look;
mod gateway_log;
pub mod history;
pub mod inertial;
pub mod offline;
pub mod parameters;
pub mod pipeline;
pub mod sample_log;
#[cfg(test)]
#[path = "../../tests/schema.rs"]
mod schema;
pub mod setup;
pub mod skin;
mod uncertainty;
mod units;

pub use uncertainty::propagation;
