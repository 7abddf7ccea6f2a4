//! A link to a CAN bus: one trait, three implementations, one conformance suite for all
//! (tests/conformance).
//!
//! | link | the bus | stamps |
//! |---|---|---|
//! | [`socketcan`] | a CAN interface of the kernel | kernel, or the adapter's |
//! | [`replay`] | a recorded log | the log's, shifted to the present or as recorded |
//! | [`virtual_bus`] | IPv4 multicast on the loopback interface, without kernel CAN | kernel |
//!
//! [`ListenOnly`] takes from any of them the way to send. [`error_frame`] reads what a controller
//! reports, [`interface`] what the kernel knows of it, and [`adapter`] which interface is whose.

use crate::clock::{Clock, Monotonic, sleep_until};
use adapter::NotFound;
use proprio_drivers::{Claim, Format, Frame};
use proprio_topics::{LinkState, Nanos};

pub mod adapter;
mod bus_off;
pub mod error_frame;
pub mod interface;
pub mod replay;
mod socket;
pub mod socketcan;
pub mod virtual_bus;

/// The result of [`Link::recv`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Received {
    /// A frame, stamped with its time of arrival.
    Frame(Frame),
    /// An error frame of the interface ([`Format::Error`]), stamped likewise. It may have changed
    /// the link's state.
    Error(Frame),
    /// The deadline has passed without a frame.
    TimedOut,
    /// There will be no more frames (the end of a log).
    Ended,
    /// The link's state has changed; see [`Link::state`]. The link recovers without help.
    StateChanged,
}

/// The counters of a link.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LinkCounters {
    /// Frames that passed the filters and were returned.
    pub received: u64,
    /// Frames that the kernel dropped because the receive buffer was full.
    pub dropped: u64,
    /// Error frames returned.
    pub error_frames: u64,
    /// Frames sent.
    pub sent: u64,
    /// Number of link losses.
    pub losses: u64,
}

/// Why a frame was not sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TransmitError {
    /// The system's queue is full; a later attempt may succeed.
    #[error("the queue is full")]
    Full,
    /// The link is down, gone or bus-off.
    #[error("the link is not up")]
    NotUp,
    /// This link was opened to listen only.
    #[error("this link only listens")]
    ListenOnly,
    /// This link cannot carry such a frame (CAN FD on a classic interface), or does not send at
    /// all.
    #[error("this link cannot send such a frame")]
    Unsupported,
    /// The operating system refused.
    #[error("the operating system refused it: errno {0}")]
    System(i32),
}

/// A bus to receive from and send to. Owned by one thread; allocates nothing after opening.
pub trait Link: Send {
    /// The next frame or event until `deadline` (CLOCK_MONOTONIC \[ns\]); blocks at most until
    /// then.
    ///
    /// Frames that have arrived are read from the system in batches and returned one by one, even
    /// if the deadline is in the past. Frames that this link sent are not received.
    fn recv(&mut self, deadline: Nanos) -> Received;

    /// Hands a frame to the system to be sent: one attempt, which never waits.
    ///
    /// # Errors
    /// [`TransmitError`]; the frame was not sent and will not be.
    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError>;

    /// The link's state.
    fn state(&self) -> LinkState;

    /// The counters since opening.
    fn counters(&self) -> LinkCounters;

    /// A note for the log when the link has ended, such as lines of a log that could not be read.
    fn note(&self) -> Option<String> {
        None
    }
}

/// A link that never sends: for a bus whose devices another program commands.
pub struct ListenOnly(pub Box<dyn Link>);

impl Link for ListenOnly {
    fn recv(&mut self, deadline: Nanos) -> Received {
        self.0.recv(deadline)
    }

    /// Refuses every frame.
    fn send(&mut self, _frame: &Frame) -> Result<(), TransmitError> {
        Err(TransmitError::ListenOnly)
    }

    fn state(&self) -> LinkState {
        self.0.state()
    }

    fn counters(&self) -> LinkCounters {
        self.0.counters()
    }

    fn note(&self) -> Option<String> {
        self.0.note()
    }
}

/// Sends a frame, also if the queue is full at first: tries again every 0.2 ms until `deadline`.
/// For programs that may wait, such as a simulated board; the gateway's data plane may not.
///
/// # Errors
/// [`TransmitError`]; [`TransmitError::Full`] if the queue was full until the deadline.
pub fn send_by(link: &mut dyn Link, frame: &Frame, deadline: Nanos) -> Result<(), TransmitError> {
    loop {
        let sent = link.send(frame);
        let next = Monotonic.now() + Nanos::from_micros(200);
        if sent != Err(TransmitError::Full) || next > deadline {
            return sent;
        }
        sleep_until(next);
    }
}

/// Why a link cannot be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// There is no such interface.
    #[error(
        "there is no interface {interface}; `ip -br link` lists the interfaces, \
         `ip link add dev {interface} type vcan` creates a \
         virtual one, and source = {{ kind = \"virtual\", name = \"...\" }} needs none"
    )]
    NoInterface {
        /// Its name.
        interface: String,
    },
    /// The adapter is no interface of this machine.
    #[error("{0}")]
    NoAdapter(NotFound),
    /// The interface is not a CAN interface.
    #[error("{interface} is not a CAN interface")]
    NotCan {
        /// Its name.
        interface: String,
    },
    /// The interface carries classic frames alone, and a device needs CAN FD.
    #[error(
        "{interface} carries no CAN FD, which {device:?} needs; if the adapter can, `ip link set \
         {interface} down`, then `ip link set {interface} up type can bitrate 1000000 dbitrate \
         5000000 fd on` (a vcan: `ip link set {interface} mtu 72`)"
    )]
    NoFd {
        /// Its name.
        interface: String,
        /// The device's.
        device: String,
    },
    /// The kernel has no CAN support.
    #[error(
        "this kernel has no CAN (modules can and can-raw are not available: {cause}); \
         use the virtual bus instead: source = {{ kind = \
         \"virtual\", name = \"...\" }}"
    )]
    NoCan {
        /// The operating system's error.
        cause: std::io::Error,
    },
    /// This process lacks the permission.
    #[error("no permission to {action}: {cause}")]
    Permission {
        /// What was tried.
        action: String,
        /// The operating system's error.
        cause: std::io::Error,
    },
    /// The log cannot be read.
    #[error("{path}: {cause}")]
    Log {
        /// The log.
        path: std::path::PathBuf,
        /// Why.
        cause: std::io::Error,
    },
    /// Any other error.
    #[error("{action}: {cause}")]
    System {
        /// What was tried.
        action: String,
        /// The operating system's error.
        cause: std::io::Error,
    },
}

/// Whether one of `claims` matches the frame; without claims every frame passes. Claims match data
/// frames only, so with claims remote requests do not pass.
#[must_use]
pub fn passes(claims: &[Claim], frame: &Frame) -> bool {
    let data = matches!(frame.format, Format::Classic | Format::Fd { .. });
    claims.is_empty() || data && claims.iter().any(|c| c.matches(frame.id))
}
