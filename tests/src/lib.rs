#![doc = include_str!("../README.md")]

mod arm;
mod browser;
pub mod can;
pub mod chain;
pub mod damage;
pub mod fuzz;
mod parallel;
mod process;
pub mod promise;
pub mod terminal;
pub mod truth;
pub mod watch;

pub use arm::{Arm, Written};
pub use browser::browse;
pub use parallel::on_all_processors;
pub use process::{PATIENCE, Process, Rig, now, uml, until};
