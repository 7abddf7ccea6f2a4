//! The test harness of the multi-process suites: runs the built programs in a separate
//! shared-memory domain, creates variants of the robot's configuration, reads shared memory as any
//! consumer does, and runs the tools of can-utils.
//!
//! - [`Rig`], [`Process`]: programs, their logs, their domain, and the files they leave in shared
//!   memory.
//! - [`Arm`]: `config/icub_left_arm` with other sources, periods and time-outs.
//! - [`watch`]: waits for a health condition or the first valid estimate; records everything
//!   published; reads the truth.
//! - [`damage`]: what another program may do to the files of a domain.
//! - [`terminal`]: a program on a pseudo-terminal.
//! - [`browse`]: checks a report in a headless browser.
//! - [`truth`]: is a valid torque true, whatever goes wrong?
//! - [`fuzz`]: readers of what others write, as functions of bytes.
//! - [`can`]: candump, canplayer, cangen, cansend, ip.
//!
//! Every process started here is ended by its process id when its handle is dropped, whether the
//! test passes or not.

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
