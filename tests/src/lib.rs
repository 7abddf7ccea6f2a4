//! What the suites across processes share: running the built programs in a shared-memory domain of their own, variants of
//! the robot's configuration, watching through shared memory as any consumer does, and the tools of can-utils.
//!
//! - [`Rig`], [`Process`]: programs, their logs, their domain, and what they leave in shared memory.
//! - [`Arm`]: `config/icub_left_arm` with other sources, periods and patience.
//! - [`watch`]: health until it says something, the first valid estimate, everything that was published, the truth.
//! - [`browse`]: a report, in a headless browser.
//! - [`can`]: candump, canplayer, cangen, cansend, ip.
//!
//! Every process that is started here is ended when its handle goes, by its number, whether a test passes or not.

mod arm;
mod browser;
pub mod can;
mod process;
pub mod watch;

pub use arm::{Arm, Written};
pub use browser::browse;
pub use process::{PATIENCE, Process, Rig, now, uml, until};
