//! A CAN interface of the kernel.
//!
//! The kernel filters identifiers. Frames are read in batches, with the adapter's stamps if it
//! provides them and the kernel's otherwise. Lost frames are counted; frames that this link sent
//! are not received. CAN FD works if the interface has it enabled (`mtu 72`).
//!
//! | event | state | recovery |
//! |---|---|---|
//! | `ip link set can0 down` | [`LinkState::Down`] | when the interface is up again |
//! | adapter unplugged, interface deleted | [`LinkState::Gone`] | new socket when it is back |
//! | too many errors: bus-off | [`LinkState::BusOff`] | controller restart (`restart-ms`) |
//! | up without a carrier | [`LinkState::NoCarrier`] | when it has a carrier |
//!
//! What an adapter reports of bus-off is not always true (`bus_off.rs`).
//!
//! An adapter that is named by its serial number or port is looked for again in sysfs while it is
//! gone: it may come back as another interface ([`super::adapter`]).
//!
//! `ip link set can0 type can restart` restarts a controller by hand. A controller without a
//! carrier is mostly bus-off since before the link was opened; only netlink tells
//! ([`super::interface`]).
//!
//! [`Link::recv`] asks for the interface's flags every 50 ms, in every state; error frames and
//! failures of the socket tell changes at once. While the state is not up nothing is sent, so that
//! no stale command waits in a queue until the bus is back. What the kernel's queue holds when the
//! interface goes down, the kernel drops. It can not be recalled while the interface is up: a
//! controller that nobody acknowledges, or that is bus-off and restarted, sends what its queue and
//! its own buffers hold (`ip link set can0 txqueuelen 10` keeps that short).

use super::adapter::{self, Adapter};
use super::bus_off::BusOff;
use super::error_frame::ErrorFrame;
use super::socket::{
    RECEIVE_BUFFER, Receiver, enlarge_receive_buffer, interface_flags, newly_dropped,
};
use super::{Link, LinkCounters, OpenError, Received, TransmitError, passes};
use crate::clock::{Clock, HardwareToMonotonic, Monotonic, sleep_until};
use nix::errno::Errno;
use nix::sys::socket::{MsgFlags, send, setsockopt, sockopt};
use proprio_drivers::{Claim, Format, Frame, Id};
use proprio_topics::{LinkState, Nanos};
use socketcan::{CanAddr, CanFdSocket, Socket, SocketOptions};
use std::io;
use std::os::fd::{AsFd, AsRawFd};
use std::path::{Path, PathBuf};

/// Interval between queries of the interface's flags.
const QUERY_PERIOD: Nanos = Nanos::from_millis(50);
/// Maximum number of kernel filters (`CAN_RAW_FILTER_MAX`).
const MOST_FILTERS: usize = 512;
/// Sizes of `struct can_frame` and `struct canfd_frame`.
const CLASSIC: usize = 16;
const FD: usize = 72;
/// Offset of the data in both.
const DATA: usize = 8;
/// `CANFD_BRS`, `CANFD_ESI`.
const BIT_RATE_SWITCH: u8 = 1;
const ERROR_STATE: u8 = 2;

/// A raw CAN socket on one interface.
pub struct SocketCan {
    adapter: Adapter,
    /// Where sysfs is.
    sys: PathBuf,
    /// The adapter's interface since the last opening.
    interface: String,
    socket: CanFdSocket,
    /// `struct can_filter`s as bytes.
    filters: Vec<u8>,
    /// The claims to filter by in user space, because they exceed the kernel's maximum.
    claims: Vec<Claim>,
    receiver: Receiver<FD>,
    adapter_clock: HardwareToMonotonic,
    state: LinkState,
    /// The state has changed outside of `recv`, which must report it.
    changed: bool,
    /// A frame that showed that the link is up again; returned after the state change.
    pending: Option<Frame>,
    /// Time of the next query of the flags.
    next_query: Nanos,
    bus_off: BusOff,
    counters: LinkCounters,
}

impl std::fmt::Debug for SocketCan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SocketCan")
            .field("interface", &self.interface)
            .field("state", &self.state)
            .field("counters", &self.counters)
            .finish_non_exhaustive()
    }
}

impl SocketCan {
    /// Opens `interface` and receives frames that match one of `claims` (all if there are none).
    /// The interface may be down.
    ///
    /// # Errors
    /// [`OpenError`]: there is no such interface, it is not a CAN interface, the kernel has no CAN,
    /// or permission is denied.
    pub fn open(interface: &str, claims: &[Claim]) -> Result<Self, OpenError> {
        let adapter = Adapter::Interface(interface.to_owned());
        Self::open_adapter(&adapter, Path::new(adapter::SYS), claims)
    }

    /// As [`SocketCan::open`]; the interface is that of `adapter` by the sysfs at `sys`
    /// ([`adapter::SYS`]), now and whenever it is opened again.
    ///
    /// # Errors
    /// As [`SocketCan::open`], and [`OpenError::NoAdapter`].
    pub fn open_adapter(
        adapter: &Adapter,
        sys: &Path,
        claims: &[Claim],
    ) -> Result<Self, OpenError> {
        let interface = adapter.resolve(sys).map_err(OpenError::NoAdapter)?;
        let by_kernel = claims.len() <= MOST_FILTERS;
        let filters = if by_kernel {
            filters(claims)
        } else {
            filters(&[])
        };
        let mut receiver = Receiver::new();
        let socket = open_socket(&interface, &filters, &mut receiver)
            .map_err(|e| open_error(&interface, e))?;
        let state = state_of(interface_flags(socket.as_fd(), &interface), false);
        Ok(Self {
            adapter: adapter.clone(),
            sys: sys.to_owned(),
            interface,
            socket,
            filters,
            claims: if by_kernel {
                Vec::new()
            } else {
                claims.to_vec()
            },
            receiver,
            adapter_clock: HardwareToMonotonic::default(),
            state,
            changed: false,
            pending: None,
            next_query: Nanos::ZERO,
            bus_off: BusOff::default(),
            counters: LinkCounters::default(),
        })
    }

    /// The name of the interface that it has opened last.
    #[must_use]
    pub fn interface(&self) -> &str {
        &self.interface
    }

    /// Sets the state; returns whether it has changed.
    fn set_state(&mut self, state: LinkState) -> bool {
        if self.state == state {
            return false;
        }
        if self.state == LinkState::Up {
            self.counters.losses += 1;
        }
        self.state = state;
        // Flags that lag behind what has told the change do not undo it at once.
        self.next_query = Monotonic.now().saturating_add(QUERY_PERIOD);
        true
    }

    /// Sets the state after a failure of the socket; returns whether it has changed.
    fn lose(&mut self, error: Errno) -> bool {
        // After any other error the socket is checked again.
        self.set_state(if matches!(error, Errno::ENODEV | Errno::ENXIO) {
            LinkState::Gone
        } else {
            LinkState::Down
        })
    }

    /// Asks, if it is time to, for the interface's flags; returns whether the state has changed.
    fn query_flags(&mut self) -> bool {
        let now = Monotonic.now();
        if now < self.next_query {
            return false;
        }
        self.next_query = now.saturating_add(QUERY_PERIOD);
        // An interface that was deleted and created again needs a new socket.
        if self.state == LinkState::Gone {
            let Ok(interface) = self.adapter.resolve(&self.sys) else {
                return false;
            };
            match open_socket(&interface, &self.filters, &mut self.receiver) {
                Ok(socket) => (self.socket, self.interface) = (socket, interface),
                Err(_) => return false,
            }
            self.adapter_clock = HardwareToMonotonic::default();
        }
        let flags = interface_flags(self.socket.as_fd(), &self.interface);
        let carrier = matches!(flags, Ok(flags) if flags & libc::IFF_RUNNING != 0);
        self.bus_off.see_carrier(carrier, now);
        self.set_state(state_of(flags, self.bus_off.is_off()))
    }

    /// Takes the next frame from the batch. `None`: the batch is empty.
    fn next(&mut self) -> Option<Received> {
        while let Some(message) = self.receiver.batch.next() {
            self.counters.dropped += newly_dropped(&mut self.receiver.drops, message.control.drops);
            let frame = match decode(message.bytes) {
                Some(frame) if frame.format == Format::Error || passes(&self.claims, &frame) => {
                    frame
                }
                _ => continue,
            };
            let times = &mut self.receiver.times;
            let (stamp, kind) = message.control.stamp(times, &mut self.adapter_clock);
            let frame = frame.at(times.limit(stamp), kind);
            if let Some(error) = ErrorFrame::of(&frame) {
                self.counters.error_frames += 1;
                // Adapters that restart a controller automatically report that it counts errors
                // again.
                self.bus_off.report(error, Monotonic.now());
                if self.state == LinkState::BusOff && !self.bus_off.is_off() {
                    self.set_state(LinkState::Up);
                }
                return Some(Received::Error(frame));
            }
            // A controller that receives is on the bus. This does not hold if the interface was
            // lost: the frame may have been waiting since before the loss, which the system reports
            // only once.
            self.bus_off.receive();
            if self.state == LinkState::BusOff && self.set_state(LinkState::Up) {
                self.pending = Some(frame);
                return Some(Received::StateChanged);
            }
            self.counters.received += 1;
            return Some(Received::Frame(frame));
        }
        None
    }
}

/// `struct can_filter { id, mask }` for each claim; without claims a filter that passes everything.
fn filters(claims: &[Claim]) -> Vec<u8> {
    let everything = [[0_u32, 0]];
    let claims = claims.iter().map(|claim| {
        let (id, mask) = match claim.id {
            Id::Standard(id) => (u32::from(id), claim.mask & libc::CAN_SFF_MASK),
            Id::Extended(id) => (id | libc::CAN_EFF_FLAG, claim.mask & libc::CAN_EFF_MASK),
        };
        // Without the flags in the mask, a standard filter would also pass remote requests and
        // extended identifiers with the same low bits.
        [id, mask | libc::CAN_EFF_FLAG | libc::CAN_RTR_FLAG]
    });
    let all: Vec<[u32; 2]> = if claims.len() == 0 {
        everything.to_vec()
    } else {
        claims.collect()
    };
    all.iter()
        .flatten()
        .flat_map(|word| word.to_ne_bytes())
        .collect()
}

/// A socket on `interface` with all options set, that has received nothing yet.
fn open_socket(
    interface: &str,
    filters: &[u8],
    receiver: &mut Receiver<FD>,
) -> io::Result<CanFdSocket> {
    let socket = CanFdSocket::open_addr(&CanAddr::from_iface(interface)?)?;
    socket.set_nonblocking(true)?;
    socket.set_socket_option_bytes(libc::SOL_CAN_RAW, libc::CAN_RAW_FILTER, filters)?;
    socket.set_error_filter_accept_all()?;
    socket.set_recv_own_msgs(false)?;
    let software = libc::SOF_TIMESTAMPING_RX_SOFTWARE | libc::SOF_TIMESTAMPING_SOFTWARE;
    let hardware = libc::SOF_TIMESTAMPING_RX_HARDWARE | libc::SOF_TIMESTAMPING_RAW_HARDWARE;
    socket.set_timestamping(if socket.has_hw_timestamps() {
        software | hardware
    } else {
        software
    })?;
    setsockopt(&socket, sockopt::RxqOvfl, &1)?;
    enlarge_receive_buffer(&socket, RECEIVE_BUFFER);
    // Discard the unfiltered frames that arrived between binding and filtering, without waiting for
    // more.
    receiver.reset();
    for _ in 0..1_000 {
        match receiver.batch.receive(socket.as_fd()) {
            Ok(_) => {}
            // A socket on an interface that is down reports this once.
            Err(_) => break,
        }
    }
    receiver.reset();
    Ok(socket)
}

/// The state of an interface with these flags, of which an error frame may have told that it is
/// bus-off.
const fn state_of(flags: Result<libc::c_int, Errno>, bus_off: bool) -> LinkState {
    match flags {
        Err(_) => LinkState::Gone,
        Ok(flags) if flags & libc::IFF_UP == 0 => LinkState::Down,
        Ok(_) if bus_off => LinkState::BusOff,
        Ok(flags) if flags & libc::IFF_RUNNING == 0 => LinkState::NoCarrier,
        Ok(_) => LinkState::Up,
    }
}

/// Converts an error of opening a socket to an [`OpenError`].
fn open_error(interface: &str, cause: io::Error) -> OpenError {
    let interface = interface.to_owned();
    // Find out which is missing: the interface or CAN support.
    let can = CanFdSocket::open_iface(0).err();
    let no_can = |error: &io::Error| {
        matches!(
            error.raw_os_error(),
            Some(
                libc::EAFNOSUPPORT
                    | libc::EPROTONOSUPPORT
                    | libc::ENOPROTOOPT
                    | libc::ESOCKTNOSUPPORT
            )
        )
    };
    match (can, cause.raw_os_error()) {
        (Some(error), _) if no_can(&error) => OpenError::NoCan { cause: error },
        (_, Some(libc::EPERM | libc::EACCES)) => OpenError::Permission {
            action: format!("open {interface}"),
            cause,
        },
        (_, Some(libc::ENODEV | libc::ENXIO | libc::EINVAL)) => {
            match nix::net::if_::if_nametoindex(interface.as_str()) {
                Ok(_) => OpenError::NotCan { interface },
                Err(_) => OpenError::NoInterface { interface },
            }
        }
        _ => OpenError::System {
            action: format!("open {interface}"),
            cause,
        },
    }
}

/// Reads a `struct can_frame` or `struct canfd_frame`.
fn decode(bytes: &[u8]) -> Option<Frame> {
    let raw = u32::from_ne_bytes(*bytes.first_chunk()?);
    let (len, flags) = (*bytes.get(4)?, *bytes.get(5)?);
    let len = usize::from(len);
    let payload = bytes.get(DATA..)?.get(..len);
    if raw & libc::CAN_ERR_FLAG != 0 {
        return Frame::with_format(
            Id::extended(raw & libc::CAN_ERR_MASK),
            Format::Error,
            payload?,
        );
    }
    let id = if raw & libc::CAN_EFF_FLAG != 0 {
        Id::extended(raw & libc::CAN_EFF_MASK)
    } else {
        #[allow(clippy::cast_possible_truncation)] // 11 bits
        Id::standard((raw & libc::CAN_SFF_MASK) as u16)
    };
    match bytes.len() {
        #[allow(clippy::cast_possible_truncation)] // of a byte
        CLASSIC if raw & libc::CAN_RTR_FLAG != 0 => Some(Frame::remote(id, len as u8)),
        CLASSIC => Frame::with_format(id, Format::Classic, payload?),
        FD => {
            let format = Format::fd(flags & BIT_RATE_SWITCH != 0, flags & ERROR_STATE != 0);
            Frame::with_format(id, format, payload?)
        }
        _ => None,
    }
}

/// Writes a frame as `struct can_frame` or `struct canfd_frame` and returns its size; `None` for an
/// error frame.
fn encode(frame: &Frame, bytes: &mut [u8; FD]) -> Option<usize> {
    let id = match frame.id {
        Id::Standard(id) => u32::from(id),
        Id::Extended(id) => id | libc::CAN_EFF_FLAG,
    };
    let (id, flags, size) = match frame.format {
        Format::Classic => (id, 0, CLASSIC),
        Format::Remote => (id | libc::CAN_RTR_FLAG, 0, CLASSIC),
        Format::Fd {
            bit_rate_switch,
            error_state,
        } => {
            let flags = if bit_rate_switch { BIT_RATE_SWITCH } else { 0 }
                | if error_state { ERROR_STATE } else { 0 };
            (id, flags, FD)
        }
        Format::Error => return None,
    };
    bytes.get_mut(..4)?.copy_from_slice(&id.to_ne_bytes());
    *bytes.get_mut(4)? = u8::try_from(frame.len()).ok()?;
    *bytes.get_mut(5)? = flags;
    bytes
        .get_mut(DATA..DATA + frame.data().len())?
        .copy_from_slice(frame.data());
    Some(size)
}

impl Link for SocketCan {
    fn recv(&mut self, deadline: Nanos) -> Received {
        if std::mem::take(&mut self.changed) {
            return Received::StateChanged;
        }
        if let Some(frame) = self.pending.take() {
            self.counters.received += 1;
            return Received::Frame(frame);
        }
        let mut asked = false;
        loop {
            if let Some(received) = self.next() {
                return received;
            }
            if self.query_flags() {
                return Received::StateChanged;
            }
            // An endless series of error frames must not hold the caller beyond its deadline.
            if asked && Monotonic.now() >= deadline {
                return Received::TimedOut;
            }
            asked = true;
            let until = deadline.min(self.next_query);
            if self.state == LinkState::Gone {
                // The old socket will not report anything more.
                sleep_until(until);
                continue;
            }
            if let Err(error) = self.receiver.fill(self.socket.as_fd(), until)
                && self.lose(error)
            {
                return Received::StateChanged;
            }
        }
    }

    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
        let mut bytes = [0; FD];
        let bytes = encode(frame, &mut bytes)
            .and_then(|size| bytes.get(..size))
            .ok_or(TransmitError::Unsupported)?;
        if self.state != LinkState::Up {
            return Err(TransmitError::NotUp);
        }
        if self.bus_off.is_suspected() {
            return Err(TransmitError::Full);
        }
        match send(self.socket.as_raw_fd(), bytes, MsgFlags::MSG_DONTWAIT) {
            Ok(_) => {
                self.counters.sent += 1;
                Ok(())
            }
            // The socket's own queue, the interface's queue, a signal.
            Err(Errno::EAGAIN | Errno::ENOBUFS | Errno::EINTR) => Err(TransmitError::Full),
            Err(error @ (Errno::ENETDOWN | Errno::ENODEV | Errno::ENXIO)) => {
                self.changed |= self.lose(error);
                Err(TransmitError::NotUp)
            }
            Err(Errno::EINVAL | Errno::EMSGSIZE) => Err(TransmitError::Unsupported),
            Err(error) => Err(TransmitError::System(error as i32)),
        }
    }

    fn state(&self) -> LinkState {
        self.state
    }

    fn counters(&self) -> LinkCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn filters_tell_standard_from_extended() {
        let claims = [
            Claim::exclusive(Id::standard(0x123)),
            Claim {
                mask: 0x1FFF_FF00,
                ..Claim::shared(Id::extended(0x1234_5600))
            },
        ];
        let words: Vec<u32> = filters(&claims)
            .chunks_exact(4)
            .map(|w| u32::from_ne_bytes(w.try_into().unwrap()))
            .collect();
        assert_eq!(words, [0x123, 0xC000_07FF, 0x9234_5600, 0xDFFF_FF00]);
        assert_eq!(filters(&[]), [0; 8]);
    }

    #[test]
    fn frames_are_laid_out_as_linux_can_h_says() {
        let mut bytes = [0; FD];
        assert_eq!(
            encode(
                &Frame::new(Id::extended(0x18FF_0001), &[1, 2, 3]),
                &mut bytes
            ),
            Some(CLASSIC)
        );
        assert_eq!(bytes[..4], 0x98FF_0001_u32.to_ne_bytes());
        assert_eq!(bytes[4..16], [3, 0, 0, 0, 1, 2, 3, 0, 0, 0, 0, 0]);
    }

    /// The kernel marks its own messages with a flag; their identifiers are class bits.
    #[test]
    fn an_error_frame_is_not_taken_for_data() {
        let mut bytes = [0; CLASSIC];
        let classes = libc::CAN_ERR_BUSOFF | libc::CAN_ERR_CNT;
        bytes[..4].copy_from_slice(&(libc::CAN_ERR_FLAG | classes).to_ne_bytes());
        bytes[4..].copy_from_slice(&[8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 248, 7]);
        let frame = decode(&bytes).unwrap();
        assert_eq!(frame.format, Format::Error);
        let data = [0, 0, 0, 0, 0, 0, 248, 7];
        assert_eq!(ErrorFrame::of(&frame), Some(ErrorFrame { classes, data }));
    }

    /// What the flags of an interface mean, without and with an error frame that told of bus-off.
    #[test]
    fn the_state_follows_the_flags() {
        use LinkState::{BusOff, Down, Gone, NoCarrier, Up};
        let (up, carrier, other) = (libc::IFF_UP, libc::IFF_RUNNING, libc::IFF_NOARP);
        for (flags, state, after_bus_off) in [
            (Err(Errno::ENODEV), Gone, Gone),
            (Ok(0), Down, Down),
            (Ok(carrier | other), Down, Down),
            (Ok(up | other), NoCarrier, BusOff),
            (Ok(up | carrier | other), Up, BusOff),
        ] {
            assert_eq!(state_of(flags, false), state, "{flags:?}");
            assert_eq!(state_of(flags, true), after_bus_off, "{flags:?}");
        }
    }

    fn frame() -> impl Strategy<Value = Frame> {
        let id = prop_oneof![
            (0..=0x7FF_u16).prop_map(Id::Standard),
            (0..=0x1FFF_FFFF_u32).prop_map(Id::Extended)
        ];
        (
            id,
            0..4,
            any::<(bool, bool)>(),
            proptest::collection::vec(any::<u8>(), 0..=64),
        )
            .prop_map(
                |(id, kind, (bit_rate_switch, error_state), data)| match kind {
                    0 => Frame::remote(id, (data.len() % 9) as u8),
                    1 => Frame::with_format(
                        id,
                        Format::Fd {
                            bit_rate_switch,
                            error_state,
                        },
                        &data,
                    )
                    .unwrap(),
                    _ => Frame::new(id, &data),
                },
            )
    }

    proptest! {
        #[test]
        fn frames_survive(frame in frame()) {
            let mut bytes = [0; FD];
            let size = encode(&frame, &mut bytes).unwrap();
            match decode(&bytes[..size]) {
                Some(back) => prop_assert_eq!(back, frame),
                None => prop_assert!(false),
            }
        }

        #[test]
        fn any_bytes_are_legal_input(bytes in proptest::collection::vec(any::<u8>(), 0..=FD)) {
            let _ = decode(&bytes);
        }
    }
}
