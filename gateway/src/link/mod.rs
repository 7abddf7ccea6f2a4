//! A link to a CAN bus: one trait, three implementations, one conformance suite for all of them (tests/conformance.rs).
//!
//! | link | the bus | stamps |
//! |---|---|---|
//! | [`socketcan`] | a CAN interface of the kernel | kernel, or the adapter's |
//! | [`replay`] | a recorded log | the log's, rebased to now or as recorded |
//! | [`virtual_bus`] | IPv4 multicast on the loopback interface, where the kernel has no CAN | kernel |

use proprio_drivers::{Claim, Format, Frame};
use proprio_topics::{LinkState, Nanos};

pub mod replay;
mod socket;
pub mod socketcan;
pub mod virtual_bus;

/// What [`Link::recv`] brings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received {
    /// A frame, stamped with its arrival.
    Frame(Frame),
    /// The deadline has passed without one.
    TimedOut,
    /// There will never be another one (the end of a log).
    Ended,
    /// The link's state has changed; ask [`Link::state`]. It looks after its own recovery.
    StateChanged,
}

/// What a link counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LinkCounters {
    /// Frames that passed the filters and were handed out.
    pub received: u64,
    /// Frames that the kernel dropped because the receive buffer was full.
    pub dropped: u64,
    /// Error frames received (not handed out as frames; they set the state).
    pub error_frames: u64,
    /// Frames sent.
    pub sent: u64,
    /// Frames not sent before their deadline, or refused by the interface.
    pub send_failures: u64,
    /// Times that the link was lost.
    pub losses: u64,
}

/// Why a frame was not sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SendError {
    /// Its deadline passed first: the queue was full, or it came too late.
    #[error("the deadline passed before the frame could be sent")]
    Deadline,
    /// The link is down, gone or off the bus.
    #[error("the link is not up")]
    NotUp,
    /// This link can not carry such a frame (CAN FD on a classic interface), or does not send at all.
    #[error("this link can not send that frame")]
    Unsupported,
    /// The system refused.
    #[error("the system refused: {0}")]
    System(i32),
}

/// A bus to receive from and send to. Owned by one thread; allocates nothing after it is open.
pub trait Link: Send {
    /// The next frame, or what else happened until `deadline` (CLOCK_MONOTONIC \[ns\]); blocks until then at the most.
    ///
    /// Frames that arrived together are read from the system together and handed out one by one. A deadline in the past
    /// still hands out what has already arrived. Frames that this link sent itself do not come back.
    fn recv(&mut self, deadline: Nanos) -> Received;

    /// Sends a frame before `deadline`.
    ///
    /// # Errors
    /// [`SendError`]; the frame was not sent and will not be.
    fn send(&mut self, frame: &Frame, deadline: Nanos) -> Result<(), SendError>;

    /// The link's state.
    fn state(&self) -> LinkState;

    /// What it has counted since it was opened.
    fn counters(&self) -> LinkCounters;

    /// What a person should know of it when it has ended: lines of a log that could not be read, say.
    fn note(&self) -> Option<String> {
        None
    }
}

/// A link that could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// There is no such interface.
    #[error(
        "there is no interface {interface}; `ip -br link` lists those there are, `ip link add dev {interface} type vcan` makes a \
         virtual one, and source = {{ kind = \"virtual\", name = \"...\" }} needs none"
    )]
    NoInterface {
        /// Its name.
        interface: String,
    },
    /// The interface is not a CAN interface.
    #[error("{interface} is not a CAN interface")]
    NotCan {
        /// Its name.
        interface: String,
    },
    /// The kernel has no CAN.
    #[error(
        "this kernel has no CAN (can and can-raw are not available: {cause}); use the virtual bus instead: source = {{ kind = \
         \"virtual\", name = \"...\" }}"
    )]
    NoCan {
        /// What the system said.
        cause: std::io::Error,
    },
    /// We may not.
    #[error("no permission to {action}: {cause}")]
    Permission {
        /// What was tried.
        action: String,
        /// What the system said.
        cause: std::io::Error,
    },
    /// A log that can not be read.
    #[error("{path}: {cause}")]
    Log {
        /// The log.
        path: std::path::PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// Anything else.
    #[error("{action}: {cause}")]
    System {
        /// What was tried.
        action: String,
        /// What the system said.
        cause: std::io::Error,
    },
}

/// Whether one of `claims` takes the frame, or there are none, which takes everything. Claims are about data frames: with
/// any, remote requests do not pass.
#[must_use]
pub fn passes(claims: &[Claim], frame: &Frame) -> bool {
    let data = matches!(frame.format, Format::Classic | Format::Fd { .. });
    claims.is_empty() || data && claims.iter().any(|c| c.matches(frame.id))
}
