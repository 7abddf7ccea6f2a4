//! A simulated robot with CAN boards. The boards answer the start commands of the real ones, stream
//! with realistic rates, quantisation and noise, and fail on request. The true motion, torques and
//! wrenches are known.
//!
//! ```text
//! Robot (gateway.toml, estimator.toml, URDF)
//!   -> Trajectory, from a seed
//!   -> Simulation: the truth at any instant
//!   -> Simulator: boards, noise, faults
//!   -> buses
//! ```
//!
//! - [`robot`]: loads the three files by the robot's name.
//! - [`trajectory`]: the motion of the joints; [`truth`]: the noise-free readings of all sensors,
//!   computed with the estimator's own dynamics (which `tests/oracle` checks against three other
//!   libraries).
//! - [`settings`]: the settings of a simulation.
//! - [`simulator`]: the boards, without links and without a clock; [`fault`]: faults on request.
//! - [`drive`]: what drives report of the torques of their joints.
//! - [`mod@cad`]: a deliberately wrong URDF for the estimator.
//! - [`mod@run`]: live, on CAN interfaces or virtual buses; [`record`]: offline, a whole session as
//!   a CAN log.

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
