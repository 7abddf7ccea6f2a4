//! A simulated robot whose boards speak CAN: they answer the commands that start the real ones, stream with realistic rates,
//! quantisation and noise, and fail on request. What really happens, torques included, is known.
//!
//! ```text
//! Robot (gateway.toml, estimator.toml, URDF)
//!   -> Trajectory, from a seed -> Simulation: the truth at any instant -> Simulator: boards, noise, faults -> buses
//! ```
//!
//! - [`robot`]: the three files, found by the robot's name.
//! - [`trajectory`]: how the joints move; [`truth`]: what every sensor would read without noise, through the estimator's own
//!   dynamics (which are checked against three others in `tests/oracle`).
//! - [`simulator`]: the boards, without links and without a clock; [`fault`]: what can be made to go wrong.
//! - [`mod@cad`]: a URDF that is wrong, for the estimator.
//! - [`mod@run`]: live, on CAN interfaces or virtual buses; [`record`]: offline, a whole session as a CAN log.

pub mod cad;
pub mod fault;
mod noise;
pub mod record;
pub mod robot;
pub mod run;
pub mod simulator;
pub mod trajectory;
pub mod truth;

pub use cad::wrong_urdf;
pub use fault::{Fault, FaultError};
pub use robot::{Robot, RobotError};
pub use run::{Options, OptionsError, Skin, Summary, is_configuration, parse_bus, run, run_with_skin};
pub use simulator::{Settings, Simulator, SimulatorError};
pub use truth::{Simulation, Touch, Truth};
