#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

pub mod cad;
pub mod drive;
pub mod fault;
mod noise;
pub mod record;
pub mod robot;
pub mod run;
pub mod settings;
pub mod simulator;
pub mod trajectory;
pub mod truth;

pub use cad::wrong_urdf;
pub use fault::{FaultError, InjectedFault};
pub use robot::{SimulatedRobot, SimulatedRobotError};
pub use run::{
    RunOptions, RunOptionsError, RunSummary, TouchListener, parse_bus, run, run_with_skin,
};
pub use settings::SimulationSettings;
pub use simulator::{Simulator, SimulatorError};
pub use truth::{PlannedPush, Simulation, TouchEvent, Truth};
