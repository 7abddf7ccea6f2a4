//! A CAN bus in user space, for machines whose kernel has no CAN: UDP multicast on the loopback
//! interface.
//!
//! Any number of participants in one network namespace (usually: one host), opened in any order,
//! without a daemon. All but the sender receive each frame, with the kernel's receive stamp and a
//! drop count, as with a raw CAN socket. Nothing leaves the host: frames are sent through 127.0.0.1
//! with a time to live of 0.
//!
//! The multicast group is 239.255.x.y and the port 16384 + z, with x.y the lowest 16 bits and z the
//! next 14 bits of the FNV-1a hash (64 bits) of `DOMAIN NUL NAME`. Buses whose hashes collide do
//! not mix: every datagram carries the full key. A domain keeps robots, users and tests of one host
//! apart.
//!
//! One frame per datagram, numbers with the lowest byte first:
//!
//! | bytes | content |
//! |---|---|
//! | 0..4 | `PRPB` |
//! | 4 | version of this layout: 1 |
//! | 5, bits 0..2 | 0 classic, 1 remote request, 2 CAN FD |
//! | 5, bits 4, 5, 7 | bit rate switch, error state, extended identifier |
//! | 6 | length of the data, or the requested length of a remote request |
//! | 7 | length k of the key |
//! | 8..16 | sender, a number drawn at random when it was opened |
//! | 16..20 | identifier |
//! | 20..20 + k | key: `DOMAIN NUL NAME` |
//! | 20 + k.. | data; none in a remote request |
//!
//! Any other datagram is ignored. The kernel also delivers the sender's own datagrams; they are
//! discarded here, but a drop count may include some. There is no arbitration and no bit rate:
//! frames arrive in the order in which the kernel received them, as fast as they are sent.

use super::socket::{RECEIVE_BUFFER, Receiver, enlarge_receive_buffer, newly_dropped};
use super::{Link, LinkCounters, OpenError, Received, TransmitError, passes};
use crate::clock::{Clock, HardwareToMonotonic, Monotonic, sleep_until};
use nix::sys::socket::{setsockopt, sockopt};
use proprio_drivers::{Claim, Format, Frame, Id};
use proprio_topics::ipc::fnv1a;
use proprio_topics::{LinkState, Nanos};
use socket2::{Domain, Protocol, Socket, Type};
use std::hash::{BuildHasher, Hasher};
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::os::fd::AsFd;

const MAGIC: &[u8; 4] = b"PRPB";
const VERSION: u8 = 1;
const HEADER: usize = 20;
/// The longest datagram.
const DATAGRAM: usize = 256;
/// The longest key; domain and name together have one byte less.
const LONGEST_KEY: usize = DATAGRAM - HEADER - Frame::MAX_LEN;

const REMOTE: u8 = 1;
const FD: u8 = 2;
const FORMAT: u8 = 0b111;
const BIT_RATE_SWITCH: u8 = 1 << 4;
const ERROR_STATE: u8 = 1 << 5;
const EXTENDED: u8 = 1 << 7;

/// A participant of a virtual bus.
pub struct VirtualBus {
    socket: UdpSocket,
    receiver: Receiver<DATAGRAM>,
    group: SocketAddrV4,
    /// A datagram with all fields that are the same in every frame.
    template: [u8; DATAGRAM],
    key_len: usize,
    sender: [u8; 8],
    claims: Vec<Claim>,
    state: LinkState,
    counters: LinkCounters,
}

impl std::fmt::Debug for VirtualBus {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VirtualBus")
            .field("group", &self.group)
            .field("counters", &self.counters)
            .finish_non_exhaustive()
    }
}

/// The multicast group and port of a key.
fn group(key: &[u8]) -> SocketAddrV4 {
    let [x, y, z, w, ..] = fnv1a(&[key]).to_le_bytes();
    SocketAddrV4::new(
        Ipv4Addr::new(239, 255, y, x),
        16_384 + (u16::from_le_bytes([z, w]) & 0x3FFF),
    )
}

/// A socket of bus `name` in `group`.
fn join(name: &str, group: SocketAddrV4) -> Result<Socket, OpenError> {
    let failed = |what: &str, cause: io::Error| OpenError::System {
        action: format!("{what} for virtual bus {name}"),
        cause,
    };
    let check = |what: &str, result: io::Result<()>| result.map_err(|cause| failed(what, cause));
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP));
    let socket = socket.map_err(|cause| failed("create a socket", cause))?;
    // Every multicast datagram goes to all sockets that share the address this way.
    // SO_REUSEPORT would additionally require that all of them belong to one user.
    check("share the address", socket.set_reuse_address(true))?;
    // Bound to the group, so that datagrams to this port of another group or of the host do not
    // arrive here. The buffer fills from here on, so options that concern its frames are set
    // before.
    let stamps = setsockopt(&socket, sockopt::ReceiveTimestampns, &true);
    check("enable time stamps", stamps.map_err(Into::into))?;
    let drops = setsockopt(&socket, sockopt::RxqOvfl, &1);
    check("enable drop counts", drops.map_err(Into::into))?;
    enlarge_receive_buffer(&socket, RECEIVE_BUFFER);
    check(&format!("bind to {group}"), socket.bind(&group.into()))?;
    // Always through lo, also without a route (as in a new network namespace), and never through
    // another interface.
    let ip = Ipv4Addr::LOCALHOST;
    let lo = "through 127.0.0.1 (is the loopback interface up? `ip link set lo up`)";
    check(&format!("send {lo}"), socket.set_multicast_if_v4(&ip))?;
    check("limit frames to this host", socket.set_multicast_ttl_v4(0))?;
    check("reach this host", socket.set_multicast_loop_v4(true))?;
    let joined = socket.join_multicast_v4(group.ip(), &ip);
    check(&format!("join {group} {lo}"), joined)?;
    check("set up the socket", socket.set_nonblocking(true))?;
    Ok(socket)
}

impl VirtualBus {
    /// Joins bus `name` of `domain` and receives frames that match one of `claims` (all if there
    /// are none).
    ///
    /// # Errors
    /// [`OpenError::System`]: domain and name are too long or contain a zero byte; the loopback
    /// interface is down or missing; the port computed from the names is used by another program.
    pub fn open(domain: &str, name: &str, claims: &[Claim]) -> Result<Self, OpenError> {
        let key = [domain.as_bytes(), &[0], name.as_bytes()].concat();
        if key.len() > LONGEST_KEY
            || domain.contains('\0')
            || name.contains('\0')
            || name.is_empty()
        {
            let cause = format!(
                "domain and name may have {} bytes in all, the name at least one, and no zero byte",
                LONGEST_KEY - 1
            );
            return Err(OpenError::System {
                action: format!("open virtual bus {name:?} in domain {domain:?}"),
                cause: io::Error::new(io::ErrorKind::InvalidInput, cause),
            });
        }
        let group = group(&key);
        let socket = join(name, group)?;
        // RandomState draws its keys from the system's random numbers once per thread and then
        // increments them.
        let sender = std::hash::RandomState::new()
            .build_hasher()
            .finish()
            .to_le_bytes();
        let mut template = [0; DATAGRAM];
        #[allow(clippy::cast_possible_truncation)] // checked above
        let fixed = [
            &MAGIC[..],
            &[VERSION, 0, 0, key.len() as u8],
            &sender,
            &[0; 4],
            &key,
        ]
        .concat();
        for (to, from) in template.iter_mut().zip(fixed) {
            *to = from;
        }
        Ok(Self {
            socket: socket.into(),
            receiver: Receiver::new(),
            group,
            template,
            key_len: key.len(),
            sender,
            claims: claims.to_vec(),
            state: LinkState::Up,
            counters: LinkCounters::default(),
        })
    }

    /// Records a system error, which for a bound datagram socket means that the interface is gone.
    fn fail(&mut self) {
        if self.state == LinkState::Up {
            self.state = LinkState::Down;
            self.counters.losses += 1;
        }
    }
}

/// Reads a datagram that is a frame of the bus with the key in `template`, of another sender than
/// `sender`.
fn decode(
    bytes: &[u8],
    template: &[u8; DATAGRAM],
    key_len: usize,
    sender: [u8; 8],
) -> Option<Frame> {
    let (header, rest) = bytes.split_first_chunk::<HEADER>()?;
    let [m0, m1, m2, m3, version, flags, len, k, rest_of_header @ ..] = header;
    let (from, id) = rest_of_header.split_first_chunk::<8>()?;
    let id = u32::from_le_bytes(*id.first_chunk()?);
    let (key, data) = rest.split_at_checked(key_len)?;
    if [*m0, *m1, *m2, *m3] != *MAGIC
        || *version != VERSION
        || usize::from(*k) != key_len
        || *from == sender
        || template.get(HEADER..HEADER + key_len) != Some(key)
    {
        return None;
    }
    let id = match (flags & EXTENDED != 0, id) {
        (true, 0..=0x1FFF_FFFF) => Id::extended(id),
        #[allow(clippy::cast_possible_truncation)] // at most 0x7FF
        (false, 0..=0x7FF) => Id::standard(id as u16),
        _ => return None,
    };
    let format = match flags & FORMAT {
        0 => Format::Classic,
        FD => Format::fd(flags & BIT_RATE_SWITCH != 0, flags & ERROR_STATE != 0),
        REMOTE if data.is_empty() && *len <= 8 => return Some(Frame::remote(id, *len)),
        _ => return None,
    };
    if data.len() != usize::from(*len) {
        return None;
    }
    Frame::with_format(id, format, data)
}

/// Writes a frame into `datagram`, a copy of the template, and returns the datagram's length;
/// `None` for an error frame.
fn encode(frame: &Frame, datagram: &mut [u8; DATAGRAM], key_len: usize) -> Option<usize> {
    let format = match frame.format {
        Format::Classic => 0,
        Format::Remote => REMOTE,
        Format::Fd {
            bit_rate_switch,
            error_state,
        } => {
            FD | if bit_rate_switch { BIT_RATE_SWITCH } else { 0 }
                | if error_state { ERROR_STATE } else { 0 }
        }
        Format::Error => return None,
    };
    let extended = if matches!(frame.id, Id::Extended(_)) {
        EXTENDED
    } else {
        0
    };
    *datagram.get_mut(5)? = format | extended;
    *datagram.get_mut(6)? = u8::try_from(frame.len()).ok()?;
    datagram
        .get_mut(16..20)?
        .copy_from_slice(&frame.id.raw().to_le_bytes());
    let start = HEADER + key_len;
    let end = start + frame.data().len();
    datagram.get_mut(start..end)?.copy_from_slice(frame.data());
    Some(end)
}

impl Link for VirtualBus {
    fn recv(&mut self, deadline: Nanos) -> Received {
        let mut asked = false;
        loop {
            while let Some(message) = self.receiver.batch.next() {
                self.counters.dropped +=
                    newly_dropped(&mut self.receiver.drops, message.control.drops);
                if message.truncated {
                    continue;
                }
                let Some(frame) = decode(message.bytes, &self.template, self.key_len, self.sender)
                else {
                    continue;
                };
                if !passes(&self.claims, &frame) {
                    continue;
                }
                let times = &mut self.receiver.times;
                // It has no adapter.
                let adapter = &mut HardwareToMonotonic::default();
                let (stamp, kind) = message.control.stamp(times, adapter);
                self.counters.received += 1;
                return Received::Frame(frame.at(times.limit(stamp), kind));
            }
            // A stream of discarded frames must not hold the caller beyond its deadline.
            if asked && Monotonic.now() >= deadline {
                return Received::TimedOut;
            }
            asked = true;
            match self.receiver.fill(self.socket.as_fd(), deadline) {
                Ok(true) if self.state != LinkState::Up => {
                    self.state = LinkState::Up;
                    return Received::StateChanged;
                }
                Ok(true) => {}
                Ok(false) => return Received::TimedOut,
                Err(_) if self.state == LinkState::Up => {
                    self.fail();
                    return Received::StateChanged;
                }
                Err(_) => {
                    sleep_until(deadline);
                    return Received::TimedOut;
                }
            }
        }
    }

    fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
        let mut datagram = self.template;
        let datagram = encode(frame, &mut datagram, self.key_len)
            .and_then(|len| datagram.get(..len))
            .ok_or(TransmitError::Unsupported)?;
        self.socket
            .send_to(datagram, self.group)
            .map_err(|error| match error.raw_os_error() {
                Some(libc::EAGAIN | libc::ENOBUFS | libc::EINTR) => TransmitError::Full,
                Some(libc::ENETDOWN | libc::ENETUNREACH) => TransmitError::NotUp,
                number => TransmitError::System(number.unwrap_or_default()),
            })?;
        self.counters.sent += 1;
        Ok(())
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

    const KEY: &[u8] = b"domain\0bus";

    fn template(sender: u8) -> [u8; DATAGRAM] {
        let mut template = [0; DATAGRAM];
        template[..4].copy_from_slice(MAGIC);
        template[4] = VERSION;
        template[7] = KEY.len() as u8;
        template[8..16].fill(sender);
        template[HEADER..HEADER + KEY.len()].copy_from_slice(KEY);
        template
    }

    #[test]
    fn the_hash_is_the_published_one() {
        // Test vectors of the FNV authors.
        assert_eq!(fnv1a(&[]), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a(&[b"a"]), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(fnv1a(&[b"foo", b"bar"]), 0x8594_4171_f739_67e8);
        let group = group(b"foobar");
        assert_eq!(
            group.to_string(),
            format!("239.255.{}.{}:{}", 0x67, 0xe8, 16_384 + 0x3739)
        );
    }

    #[test]
    fn a_datagram_is_laid_out_as_documented() {
        let fd = Format::Fd {
            bit_rate_switch: true,
            error_state: false,
        };
        let frame = Frame::with_format(Id::extended(0x1234_5678), fd, &[0xAA, 0xBB]).unwrap();
        let mut datagram = template(9);
        let len = encode(&frame, &mut datagram, KEY.len()).unwrap();
        let mut expected = b"PRPB\x01\x92\x02\x0A".to_vec();
        expected.extend([9; 8]);
        expected.extend([0x78, 0x56, 0x34, 0x12]);
        expected.extend(KEY);
        expected.extend([0xAA, 0xBB]);
        assert_eq!(datagram[..len], expected);
        assert_eq!(
            decode(&datagram[..len], &template(1), KEY.len(), [1; 8]),
            Some(frame)
        );
        assert_eq!(
            decode(&datagram[..len], &template(9), KEY.len(), [9; 8]),
            None,
            "its own"
        );
        assert_eq!(
            decode(&datagram[..len - 1], &template(1), KEY.len(), [1; 8]),
            None,
            "cut"
        );
        for at in [0, 4, 7, HEADER, HEADER + KEY.len() - 1] {
            let mut other = datagram;
            other[at] ^= 1;
            assert_eq!(
                decode(&other[..len], &template(1), KEY.len(), [1; 8]),
                None,
                "byte {at}"
            );
        }
        let error = Frame::with_format(Id::extended(4), Format::Error, &[0; 8]).unwrap();
        assert_eq!(encode(&error, &mut datagram, KEY.len()), None);
    }

    proptest! {
        #[test]
        fn any_datagram_is_legal_input(
            mut bytes in proptest::collection::vec(any::<u8>(), 0..DATAGRAM), valid in 0_usize..30
        ) {
            for (to, from) in bytes.iter_mut().zip(&template(2)[..valid]) {
                *to = *from;
            }
            if let Some(frame) = decode(&bytes, &template(1), KEY.len(), [1; 8]) {
                let mut datagram = template(2);
                datagram[8..16].copy_from_slice(&bytes[8..16]);
                let len = encode(&frame, &mut datagram, KEY.len()).unwrap();
                prop_assert_eq!(len, bytes.len());
            }
        }
    }
}
