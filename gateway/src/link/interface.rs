//! What the kernel knows of CAN interfaces and their controllers, asked over netlink: state, error
//! counters, bit-rates, modes and totals. For the control plane; the data plane does not wait for
//! such queries.

use super::adapter::{self, Adapter};
use nix::errno::Errno;
use nix::sys::socket::sockopt::ReceiveTimeout;
use nix::sys::socket::{
    AddressFamily, MsgFlags, SockFlag, SockProtocol, SockType, recv, send, setsockopt, socket,
};
use nix::sys::time::TimeVal;
use proprio_topics::{Controller, InterfaceHealth, realtime};
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Who answers questions about interfaces: [`Netlink`], or a function with prepared answers.
pub trait Interfaces: Send {
    /// What is known of `interface`; what is not told is zero.
    ///
    /// # Errors
    /// The system's error; `ENODEV` if there is no such interface.
    fn ask(&mut self, interface: &str) -> Result<InterfaceHealth, Errno>;
}

impl<F: FnMut(&str) -> Result<InterfaceHealth, Errno> + Send> Interfaces for F {
    fn ask(&mut self, interface: &str) -> Result<InterfaceHealth, Errno> {
        self(interface)
    }
}

/// The kernel (rtnetlink). A query waits while the kernel is busy with any network interface.
#[derive(Debug, Default)]
pub struct Netlink(Option<OwnedFd>);

/// Size of `struct nlmsghdr` and of `struct ifinfomsg`.
const HEADER: usize = 16;
/// Offset and mask in an attribute's type (`NLA_TYPE_MASK`).
const TYPE: u16 = 0x3FFF;
/// Largest answer: the kernel's own limit for one message about an interface (`NLMSG_GOODSIZE` of
/// 8192 bytes), twice.
const ANSWER: usize = 16_384;
/// How long to wait for an answer: it is there when the query has been sent.
const PATIENCE: i64 = 1;

impl Interfaces for Netlink {
    fn ask(&mut self, interface: &str) -> Result<InterfaceHealth, Errno> {
        // After an error a late answer may wait in the socket: take a new one.
        let socket = match self.0.take() {
            Some(socket) => socket,
            None => open()?,
        };
        send(socket.as_raw_fd(), &query(interface), MsgFlags::empty())?;
        let mut answer = vec![0; ANSWER];
        let len = recv(socket.as_raw_fd(), &mut answer, MsgFlags::empty())?;
        self.0 = Some(socket);
        parse(answer.get(..len).unwrap_or_default())
    }
}

fn open() -> Result<OwnedFd, Errno> {
    let socket = socket(
        AddressFamily::Netlink,
        SockType::Raw,
        SockFlag::SOCK_CLOEXEC,
        SockProtocol::NetlinkRoute,
    )?;
    setsockopt(&socket, ReceiveTimeout, &TimeVal::new(PATIENCE, 0))?;
    Ok(socket)
}

/// The request `RTM_GETLINK` for the interface called `name`.
fn query(name: &str) -> Vec<u8> {
    // struct nlmsghdr { len, type: u16, flags: u16, sequence number, port }, the length last;
    // struct ifinfomsg, all zero; the attribute with the name, which ends with a zero.
    let mut message = vec![0; 2 * HEADER];
    let mut put = |at: usize, number: u16| {
        if let Some(field) = message.get_mut(at..at + 2) {
            field.copy_from_slice(&number.to_ne_bytes());
        }
    };
    put(4, libc::RTM_GETLINK);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // 1
    put(6, libc::NLM_F_REQUEST as u16);
    let len = u16::try_from(name.len() + 5).unwrap_or(u16::MAX);
    message.extend(len.to_ne_bytes());
    message.extend(libc::IFLA_IFNAME.to_ne_bytes());
    message.extend(name.bytes().chain([0]));
    message.resize(message.len().next_multiple_of(4), 0);
    let len = u32::try_from(message.len()).unwrap_or(u32::MAX);
    if let Some(field) = message.first_chunk_mut() {
        *field = len.to_ne_bytes();
    }
    message
}

/// Reads the kernel's answer to [`query`].
fn parse(answer: &[u8]) -> Result<InterfaceHealth, Errno> {
    let number = |at: usize| -> Option<u16> {
        Some(u16::from_ne_bytes(answer.get(at..at + 2)?.try_into().ok()?))
    };
    match number(4) {
        Some(libc::RTM_NEWLINK) => {}
        // struct nlmsgerr begins with the negative error number.
        Some(kind) if i32::from(kind) == libc::NLMSG_ERROR => {
            let error = answer.get(HEADER..).and_then(|d| word(d, 0)).unwrap_or(0);
            return Err(Errno::from_raw(0_i32.wrapping_sub(error.cast_signed())));
        }
        _ => return Err(Errno::EBADMSG),
    }
    let mut health = InterfaceHealth::default();
    for (kind, data) in Attributes(answer.get(2 * HEADER..).unwrap_or_default()) {
        match kind {
            // CANFD_MTU or larger; 16 is classic CAN.
            libc::IFLA_MTU => health.fd = u32::from(word(data, 0).is_some_and(|mtu| mtu >= 72)),
            libc::IFLA_STATS64 => {
                // struct rtnl_link_stats64.
                let total = |at| long(data, at).unwrap_or(0);
                health.rx_frames = total(0);
                health.tx_frames = total(1);
                health.rx_bytes = total(2);
                health.tx_bytes = total(3);
                health.rx_errors = total(4);
                health.tx_errors = total(5);
                health.rx_dropped = total(6);
                health.tx_dropped = total(7);
            }
            libc::IFLA_LINKINFO => {
                // Only the CAN drivers' data are of the form below; vcan and vxcan have none.
                let info = |wanted| {
                    let mut attributes = Attributes(data);
                    attributes.find_map(|(kind, data)| (kind == wanted).then_some(data))
                };
                if info(libc::IFLA_INFO_KIND).is_some_and(|kind| kind.starts_with(b"can\0")) {
                    controller(info(libc::IFLA_INFO_DATA).unwrap_or_default(), &mut health);
                }
            }
            _ => {}
        }
    }
    Ok(health)
}

/// Reads the attributes of linux/can/netlink.h.
fn controller(data: &[u8], health: &mut InterfaceHealth) {
    for (kind, data) in Attributes(data) {
        let first = word(data, 0).unwrap_or(0);
        match libc::c_int::from(kind) {
            libc::IFLA_CAN_STATE => {
                health.controller = match first {
                    0 => Controller::Active,
                    1 => Controller::Warning,
                    2 => Controller::Passive,
                    3 => Controller::BusOff,
                    4 => Controller::Stopped,
                    5 => Controller::Sleeping,
                    _ => Controller::Unknown,
                }
                .in_memory();
            }
            // struct can_bittiming begins with the bit-rate.
            libc::IFLA_CAN_BITTIMING => health.bit_rate = first,
            libc::IFLA_CAN_DATA_BITTIMING => health.data_bit_rate = first,
            libc::IFLA_CAN_RESTART_MS => health.restart_ms = first,
            // struct can_ctrlmode { mask, flags }.
            libc::IFLA_CAN_CTRLMODE => {
                let flags = word(data, 1).unwrap_or(0);
                health.listen_only = u32::from(flags & libc::CAN_CTRLMODE_LISTENONLY != 0);
            }
            // struct can_berr_counter { txerr: u16, rxerr: u16 }.
            libc::IFLA_CAN_BERR_COUNTER => {
                if let Some(&[t0, t1, r0, r1]) = data.first_chunk() {
                    health.tx_error_counter = u16::from_ne_bytes([t0, t1]).into();
                    health.rx_error_counter = u16::from_ne_bytes([r0, r1]).into();
                }
            }
            _ => {}
        }
    }
}

/// The `at`th 32-bit number of `data`.
fn word(data: &[u8], at: usize) -> Option<u32> {
    let bytes = data.get(4 * at..4 * at + 4)?.try_into().ok()?;
    Some(u32::from_ne_bytes(bytes))
}

/// The `at`th 64-bit number of `data`.
fn long(data: &[u8], at: usize) -> Option<u64> {
    let bytes = data.get(8 * at..8 * at + 8)?.try_into().ok()?;
    Some(u64::from_ne_bytes(bytes))
}

/// Types and contents of consecutive `struct rtattr { len: u16, type: u16 }`, aligned to 4 bytes.
struct Attributes<'a>(&'a [u8]);

impl<'a> Iterator for Attributes<'a> {
    type Item = (u16, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let [l0, l1, k0, k1] = *self.0.first_chunk()?;
        let len = usize::from(u16::from_ne_bytes([l0, l1]));
        let data = self.0.get(4..len)?;
        self.0 = self.0.get(len.next_multiple_of(4)..).unwrap_or_default();
        Some((u16::from_ne_bytes([k0, k1]) & TYPE, data))
    }
}

/// Keeps the newest answers about some interfaces.
///
/// A thread of its own asks, because a query waits while the kernel sets up or removes any network
/// interface, which with a USB adapter can take seconds. It is not joined: it ends within a period
/// after the end was asked for.
#[derive(Debug)]
pub(crate) struct Observer(Arc<Mutex<Vec<InterfaceHealth>>>);

impl Observer {
    /// Asks for each of `interfaces` (`None` has no answer) every `period` until `stop`. Adapters
    /// are looked for each time, in [`adapter::SYS`].
    ///
    /// # Errors
    /// The system's: the thread could not be started.
    pub(crate) fn start(
        interfaces: Vec<Option<Adapter>>,
        mut source: impl Interfaces + 'static,
        period: Duration,
        stop: Arc<AtomicBool>,
    ) -> std::io::Result<Self> {
        let newest = Arc::new(Mutex::new(vec![
            InterfaceHealth::default();
            interfaces.len()
        ]));
        let this = Self(Arc::clone(&newest));
        if interfaces.iter().all(Option::is_none) {
            return Ok(this);
        }
        let mut failing = vec![false; interfaces.len()];
        let body = move || {
            while !stop.load(Relaxed) {
                let answers = interfaces.iter().zip(&mut failing).map(|(name, failing)| {
                    let name = name
                        .as_ref()
                        .map(|named| named.resolve(Path::new(adapter::SYS)));
                    let Some(Ok(name)) = name else {
                        return InterfaceHealth::default();
                    };
                    let answer = source.ask(&name);
                    // That it is gone is told by the link's state.
                    let fails = answer.is_err_and(|error| error != Errno::ENODEV);
                    if let Err(error) = answer
                        && fails
                        && !*failing
                    {
                        tracing::warn!(
                            interface = name,
                            "its controller's state and totals are not known: netlink: {error}"
                        );
                    }
                    *failing = fails;
                    answer.unwrap_or_default()
                });
                let answers = answers.collect();
                *newest.lock().unwrap_or_else(PoisonError::into_inner) = answers;
                std::thread::sleep(period);
            }
        };
        std::thread::Builder::new()
            .name("interfaces".to_owned())
            .stack_size(realtime::SMALL_STACK)
            .spawn(body)?;
        Ok(this)
    }

    /// The newest answers, in the order of the interfaces; all zero before the first and where
    /// there is none.
    #[must_use]
    pub(crate) fn newest(&self) -> Vec<InterfaceHealth> {
        let newest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        newest.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn attribute(kind: u16, data: &[u8]) -> Vec<u8> {
        let mut bytes = (data.len() as u16 + 4).to_ne_bytes().to_vec();
        bytes.extend(kind.to_ne_bytes());
        bytes.extend(data);
        bytes.resize(bytes.len().next_multiple_of(4), 0);
        bytes
    }

    fn words(numbers: &[u32]) -> Vec<u8> {
        numbers.iter().flat_map(|n| n.to_ne_bytes()).collect()
    }

    fn message(kind: u16, body: &[u8]) -> Vec<u8> {
        let mut bytes = (16 + body.len() as u32).to_ne_bytes().to_vec();
        bytes.extend(kind.to_ne_bytes());
        bytes.extend([0; 10]);
        bytes.extend(body);
        bytes
    }

    /// The answer for a controller, written out from linux/if_link.h and linux/can/netlink.h.
    fn answer(kind: &[u8], state: u32) -> Vec<u8> {
        let totals: Vec<u8> = (100..125_u64).flat_map(u64::to_ne_bytes).collect();
        let bit_timing = |rate| words(&[rate, 875, 12, 6, 7, 2, 1, 1]);
        let can = [
            attribute(1, &bit_timing(1_000_000)),
            attribute(3, &words(&[80_000_000])),
            attribute(4, &words(&[state])),
            attribute(5, &words(&[0xFFFF_FFFF, 0x22])),
            attribute(6, &words(&[100])),
            attribute(
                8,
                &[0x80_u16.to_ne_bytes(), 0x7F_u16.to_ne_bytes()].concat(),
            ),
            attribute(9, &bit_timing(4_000_000)),
        ]
        .concat();
        let info = [attribute(1, kind), attribute(2 | 0x8000, &can)].concat();
        let body = [
            vec![0; 16],
            attribute(3, b"can0\0"),
            attribute(4, &words(&[72])),
            attribute(23, &totals),
            attribute(18 | 0x8000, &info),
        ];
        message(16, &body.concat())
    }

    #[test]
    fn an_answer_is_read_as_the_kernel_lays_it_out() {
        let expected = InterfaceHealth {
            rx_frames: 100,
            tx_frames: 101,
            rx_bytes: 102,
            tx_bytes: 103,
            rx_errors: 104,
            tx_errors: 105,
            rx_dropped: 106,
            tx_dropped: 107,
            controller: Controller::Passive.in_memory(),
            tx_error_counter: 128,
            rx_error_counter: 127,
            bit_rate: 1_000_000,
            data_bit_rate: 4_000_000,
            restart_ms: 100,
            fd: 1,
            listen_only: 1,
        };
        assert_eq!(parse(&answer(b"can\0", 2)), Ok(expected));
        let states = [0, 1, 2, 3, 4, 5, 6]
            .map(|state| parse(&answer(b"can\0", state)).unwrap().controller.get());
        let expected = [
            Controller::Active,
            Controller::Warning,
            Controller::Passive,
            Controller::BusOff,
            Controller::Stopped,
            Controller::Sleeping,
            Controller::Unknown,
        ];
        assert_eq!(states, expected.map(Some));
        // Another kind of interface has data of another form.
        let other = parse(&answer(b"vcan\0", 2)).unwrap();
        assert_eq!((other.rx_frames, other.fd, other.bit_rate), (100, 1, 0));
        assert_eq!(other.controller, Controller::Unknown);
    }

    #[test]
    fn a_refusal_is_an_error() {
        let refusal = message(2, &(-libc::ENODEV).to_ne_bytes());
        assert_eq!(parse(&refusal), Err(Errno::ENODEV));
        assert_eq!(parse(&message(3, &[])), Err(Errno::EBADMSG));
        assert_eq!(parse(&[]), Err(Errno::EBADMSG));
    }

    proptest! {
        #[test]
        fn any_answer_is_legal_input(
            cut in 0_usize..1000, at in 0_usize..1000, byte in any::<u8>()
        ) {
            let mut answer = answer(b"can\0", 1);
            let at = at % answer.len();
            answer[at] = byte;
            answer.truncate(cut);
            let _ = parse(&answer);
        }
    }

    /// The loopback interface is one that every machine has.
    #[test]
    fn the_kernel_answers() {
        let mut netlink = Netlink::default();
        for _ in 0..2 {
            let lo = netlink.ask("lo").unwrap();
            assert_eq!(
                (lo.controller.get(), lo.bit_rate),
                (Some(Controller::Unknown), 0)
            );
            assert_eq!(lo.rx_frames, lo.tx_frames);
            assert_eq!(netlink.ask("nosuchcan0"), Err(Errno::ENODEV));
        }
        assert!(netlink.ask("much-too-long-for-an-interface").is_err());
        assert!(netlink.ask("lo").is_ok(), "also after an error");
    }

    #[test]
    fn an_observer_keeps_the_newest_answers() {
        let stop = Arc::new(AtomicBool::new(false));
        let mut asked = 0;
        let source = move |name: &str| {
            asked += 1;
            match name {
                "can0" => Ok(InterfaceHealth {
                    rx_frames: asked,
                    ..InterfaceHealth::default()
                }),
                _ => Err(Errno::EPERM),
            }
        };
        let name = |name: &str| Some(Adapter::Interface(name.to_owned()));
        let names = vec![name("can0"), None, name("can1")];
        let period = Duration::from_millis(1);
        let observer = Observer::start(names, source, period, Arc::clone(&stop)).unwrap();
        while observer.newest()[0].rx_frames < 20 {
            std::thread::sleep(period);
        }
        stop.store(true, Relaxed);
        assert_eq!(observer.newest()[1..], [InterfaceHealth::default(); 2]);
    }
}
