//! Common code of the two links over sockets: receiving in batches with stamps and drop counts,
//! waiting, buffer sizes.
//!
//! All unsafe code of the links is here: `recvmmsg` and the query of an interface's flags. nix's
//! `recvmmsg` is not suitable: its `MultiHeaders` (0.31) keep the control length of the previous
//! call. Control data that appear later, such as the drop count after the first drop, are then cut
//! off. New `MultiHeaders` per call would allocate.
#![allow(unsafe_code)]

use crate::clock::{Clock, HardwareToMonotonic, Monotonic, RealtimeToMonotonic};
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::socket::{setsockopt, sockopt};
use nix::sys::time::TimeSpec;
use proprio_topics::{Nanos, StampKind};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};

/// Maximum number of datagrams per system call.
pub(super) const BATCH: usize = 32;

/// The requested receive buffer \[bytes\]; the kernel's default holds about 270 frames.
pub(super) const RECEIVE_BUFFER: usize = 4 << 20;

/// Control data of one datagram: three time stamps (64 bytes), one time stamp (32), a drop count
/// (24).
const CONTROL: usize = 128;

#[repr(align(8))]
struct DatagramBuffer<const SIZE: usize> {
    data: [u8; SIZE],
    control: [u8; CONTROL],
}

#[derive(Clone, Copy, Default)]
struct Filled {
    len: usize,
    control: usize,
    flags: libc::c_int,
}

/// Datagrams of at most `SIZE` bytes that arrived together.
pub(super) struct Batch<const SIZE: usize> {
    slots: Box<[DatagramBuffer<SIZE>]>,
    filled: [Filled; BATCH],
    count: usize,
    next: usize,
}

/// One datagram.
#[derive(Debug, Clone, Copy)]
pub(super) struct Datagram<'a> {
    /// Its bytes, truncated to the batch's size.
    pub(super) bytes: &'a [u8],
    /// Whether the datagram or its control data were truncated.
    pub(super) truncated: bool,
    /// The kernel's control data.
    pub(super) control: Control,
}

/// Control data of a datagram.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Control {
    /// The kernel's stamp, CLOCK_REALTIME.
    pub(super) software: Option<Nanos>,
    /// The adapter's stamp, in the adapter's clock.
    pub(super) hardware: Option<Nanos>,
    /// Number of datagrams that the socket has dropped so far, modulo 2^32.
    pub(super) drops: Option<u32>,
}

impl Control {
    /// When the datagram arrived (CLOCK_MONOTONIC \[ns\]), and whose stamp that is: the adapter's,
    /// else the kernel's, else this program's.
    pub(super) fn stamp(
        &self,
        times: &RealtimeToMonotonic,
        adapter: &mut HardwareToMonotonic,
    ) -> (Nanos, StampKind) {
        let software = self.software.map(|t| times.convert(t));
        let hardware = self
            .hardware
            .zip(software)
            .and_then(|(h, s)| adapter.convert(h, s));
        match (hardware, software) {
            (Some(stamp), _) => (stamp, StampKind::Hardware),
            (None, Some(stamp)) => (stamp, StampKind::Software),
            (None, None) => (times.now(), StampKind::User),
        }
    }
}

impl<const SIZE: usize> Batch<SIZE> {
    /// An empty batch.
    pub(super) fn new() -> Self {
        let slots = (0..BATCH)
            .map(|_| DatagramBuffer {
                data: [0; SIZE],
                control: [0; CONTROL],
            })
            .collect();
        Self {
            slots,
            filled: [Filled::default(); BATCH],
            count: 0,
            next: 0,
        }
    }

    /// Replaces the contents with the datagrams that wait in the socket, without blocking; returns
    /// their number.
    ///
    /// # Errors
    /// The system's error; `EAGAIN` if nothing waits. The batch is then empty.
    pub(super) fn receive(&mut self, socket: BorrowedFd<'_>) -> Result<usize, Errno> {
        (self.count, self.next) = (0, 0);
        // SAFETY: iovec and mmsghdr are plain C structures of integers and pointers, for which all
        // zeros is a valid value.
        let mut vectors: [libc::iovec; BATCH] = unsafe { MaybeUninit::zeroed().assume_init() };
        // SAFETY: as above.
        let mut headers: [libc::mmsghdr; BATCH] = unsafe { MaybeUninit::zeroed().assume_init() };
        for ((slot, vector), header) in self.slots.iter_mut().zip(&mut vectors).zip(&mut headers) {
            vector.iov_base = slot.data.as_mut_ptr().cast();
            vector.iov_len = SIZE;
            header.msg_hdr.msg_iov = vector;
            header.msg_hdr.msg_iovlen = 1;
            header.msg_hdr.msg_control = slot.control.as_mut_ptr().cast();
            header.msg_hdr.msg_controllen = CONTROL as _;
        }
        // SAFETY: each header points to one vector and one control buffer with their true lengths;
        // all of them, and the data they point to, live until this function returns, and nothing
        // else refers to them meanwhile.
        let received = unsafe {
            libc::recvmmsg(
                socket.as_raw_fd(),
                headers.as_mut_ptr(),
                BATCH as _,
                libc::MSG_DONTWAIT as _,
                std::ptr::null_mut(),
            )
        };
        let received = usize::try_from(Errno::result(received)?)
            .unwrap_or(0)
            .min(BATCH);
        for (filled, header) in self.filled.iter_mut().zip(&headers).take(received) {
            *filled = Filled {
                len: (header.msg_len as usize).min(SIZE),
                #[allow(clippy::unnecessary_cast)] // not everywhere a usize
                control: (header.msg_hdr.msg_controllen as usize).min(CONTROL),
                flags: header.msg_hdr.msg_flags,
            };
        }
        self.count = received;
        Ok(received)
    }

    /// The next datagram of the batch.
    #[inline]
    pub(super) fn next(&mut self) -> Option<Datagram<'_>> {
        if self.next >= self.count {
            return None;
        }
        let (slot, filled) = (self.slots.get(self.next)?, self.filled.get(self.next)?);
        self.next += 1;
        Some(Datagram {
            bytes: slot.data.get(..filled.len)?,
            truncated: filled.flags & (libc::MSG_TRUNC | libc::MSG_CTRUNC) != 0,
            control: Control::parse(slot.control.get(..filled.control)?),
        })
    }
}

impl Control {
    /// Parses the kernel's `struct cmsghdr { size_t len; int level; int type; }` followed by data,
    /// aligned to words.
    fn parse(mut rest: &[u8]) -> Self {
        const WORD: usize = size_of::<usize>();
        const HEADER: usize = (WORD + 8).next_multiple_of(WORD);
        let mut control = Self::default();
        while let Some((header, _)) = rest.split_at_checked(HEADER) {
            let word = |at: usize| {
                header
                    .get(at..at + 4)
                    .and_then(|b| b.try_into().ok())
                    .map(i32::from_ne_bytes)
            };
            let len = header
                .first_chunk::<WORD>()
                .map_or(0, |b| usize::from_ne_bytes(*b));
            let Some(data) = rest.get(HEADER..len) else {
                break;
            };
            if word(WORD) == Some(libc::SOL_SOCKET) {
                match word(WORD + 4) {
                    Some(libc::SO_TIMESTAMPNS) => control.software = timespec(data, 0),
                    // Software, unused, hardware; zero if absent.
                    Some(libc::SO_TIMESTAMPING) => {
                        control.software = timespec(data, 0);
                        control.hardware = timespec(data, 2);
                    }
                    Some(libc::SO_RXQ_OVFL) => {
                        control.drops = data.first_chunk().map(|b| u32::from_ne_bytes(*b));
                    }
                    _ => {}
                }
            }
            rest = rest.get(len.next_multiple_of(WORD)..).unwrap_or(&[]);
        }
        control
    }
}

/// The `index`th `struct timespec` of `data`, unless it is zero.
fn timespec(data: &[u8], index: usize) -> Option<Nanos> {
    const LONG: usize = size_of::<libc::c_long>();
    let long = |at: usize| {
        let bytes = data.get(at..at + LONG)?.try_into().ok()?;
        #[allow(clippy::useless_conversion)] // not on 32 bits
        Some(i64::from(libc::c_long::from_ne_bytes(bytes)))
    };
    let (seconds, ns) = (long(index * 2 * LONG)?, long((index * 2 + 1) * LONG)?);
    (seconds != 0 || ns != 0)
        .then(|| Nanos(seconds.saturating_mul(1_000_000_000).saturating_add(ns)))
}

/// Receives from a socket in batches and interprets their control data.
pub(super) struct Receiver<const SIZE: usize> {
    /// The current batch.
    pub(super) batch: Batch<SIZE>,
    /// The conversion of its stamps.
    pub(super) times: RealtimeToMonotonic,
    /// The last batch was not full, so the socket is probably empty: wait before the next read.
    empty: bool,
    /// The last drop count.
    pub(super) drops: u32,
}

impl<const SIZE: usize> Receiver<SIZE> {
    /// A receiver for a new socket.
    pub(super) fn new() -> Self {
        Self {
            batch: Batch::new(),
            times: RealtimeToMonotonic::default(),
            empty: true,
            drops: 0,
        }
    }

    /// Starts again with another socket.
    pub(super) const fn reset(&mut self) {
        (self.batch.count, self.batch.next) = (0, 0);
        self.empty = true;
        self.drops = 0;
    }

    /// Fills the batch; waits until `deadline` if the socket is empty. Returns false if nothing
    /// arrived.
    ///
    /// # Errors
    /// The system's.
    pub(super) fn fill(&mut self, socket: BorrowedFd<'_>, deadline: Nanos) -> Result<bool, Errno> {
        loop {
            if self.empty {
                let now = Monotonic.now();
                if now < deadline {
                    wait(socket, deadline.saturating_sub(now))?;
                }
            }
            match self.batch.receive(socket) {
                Ok(count) => {
                    self.empty = count < BATCH;
                    self.times.refresh();
                    return Ok(true);
                }
                Err(Errno::EINTR) => {}
                Err(Errno::EAGAIN) => {
                    self.empty = true;
                    if Monotonic.now() >= deadline {
                        return Ok(false);
                    }
                }
                Err(error) => return Err(error),
            }
        }
    }
}

/// Number of datagrams dropped since the last call: `total` is the last running total, `now` the
/// newest.
pub(super) const fn newly_dropped(total: &mut u32, now: Option<u32>) -> u64 {
    let Some(now) = now else { return 0 };
    let new = now.wrapping_sub(*total);
    *total = now;
    new as u64
}

/// Waits at most `timeout` \[ns\] until the socket can be read or has an error.
///
/// # Errors
/// The system's; a signal counts as the end of the wait.
fn wait(socket: BorrowedFd<'_>, timeout: Nanos) -> Result<(), Errno> {
    let timeout = timeout.0.max(0);
    let timeout = TimeSpec::new(timeout / 1_000_000_000, timeout % 1_000_000_000);
    match ppoll(
        &mut [PollFd::new(socket, PollFlags::POLLIN)],
        Some(timeout),
        None,
    ) {
        Ok(_) | Err(Errno::EINTR) => Ok(()),
        Err(error) => Err(error),
    }
}

/// Sets the receive buffer to `bytes`: beyond the system's limit if permitted, else up to it.
pub(super) fn enlarge_receive_buffer(socket: &impl AsFd, bytes: usize) {
    if setsockopt(socket, sockopt::RcvBufForce, &bytes).is_err() {
        // A smaller buffer only drops earlier, and drops are counted.
        let _ = setsockopt(socket, sockopt::RcvBuf, &bytes);
    }
}

/// The flags (`IFF_UP` and so on) of network interface `name`.
///
/// # Errors
/// The system's error; `ENODEV` if there is no interface of that name.
pub(super) fn interface_flags(socket: BorrowedFd<'_>, name: &str) -> Result<libc::c_int, Errno> {
    // SAFETY: ifreq is a plain C structure, for which all zeros is a valid value.
    let mut request: libc::ifreq = unsafe { MaybeUninit::zeroed().assume_init() };
    // One byte less than the field: the name ends with a zero.
    let room = request.ifr_name.len() - 1;
    if name.len() > room {
        return Err(Errno::ENODEV);
    }
    for (to, from) in request.ifr_name.iter_mut().zip(name.bytes()) {
        *to = from as libc::c_char;
    }
    // SAFETY: SIOCGIFFLAGS reads the name from and writes the flags to an ifreq, which lives across
    // the call.
    Errno::result(unsafe {
        libc::ioctl(
            socket.as_raw_fd(),
            libc::SIOCGIFFLAGS as _,
            &raw mut request,
        )
    })?;
    // SAFETY: the call succeeded, so the kernel has set this member of the union; it is an integer.
    Ok(libc::c_int::from(unsafe { request.ifr_ifru.ifru_flags }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(level: i32, kind: i32, data: &[u8]) -> Vec<u8> {
        let mut bytes = (size_of::<usize>() + 8 + data.len()).to_ne_bytes().to_vec();
        bytes.extend(level.to_ne_bytes());
        bytes.extend(kind.to_ne_bytes());
        bytes.extend(data);
        bytes.resize(bytes.len().next_multiple_of(size_of::<usize>()), 0);
        bytes
    }

    fn times(numbers: &[libc::c_long]) -> Vec<u8> {
        numbers.iter().flat_map(|n| n.to_ne_bytes()).collect()
    }

    /// Two frames that came 9 and 4 ms ago, by the wall clock and by the clock of an adapter, which
    /// counts from its start.
    #[test]
    fn every_stamp_is_on_the_monotonic_clock() {
        let mut times = RealtimeToMonotonic::default();
        times.refresh();
        let (now, offset) = (times.now(), crate::clock::realtime_offset());
        let mut adapter = HardwareToMonotonic::default();
        let ms = |n: i64| Nanos::from_millis(n);
        for (ago, hardware) in [(9, 1000), (4, 1005)] {
            let mut control = Control {
                software: Some(now + offset - ms(ago)),
                hardware: Some(ms(hardware)),
                drops: None,
            };
            for kind in [StampKind::Hardware, StampKind::Software] {
                let (stamp, from) = control.stamp(&times, &mut adapter);
                assert_eq!(from, kind);
                let error = (stamp - (now - ms(ago))).0.abs();
                assert!(error < ms(1).0, "{kind:?}: {error} ns");
                control.hardware = None;
            }
        }
        let stamp = Control::default().stamp(&times, &mut adapter);
        assert_eq!(stamp, (now, StampKind::User));
    }

    #[test]
    fn control_data_are_told_apart() {
        let mut bytes = message(
            libc::SOL_SOCKET,
            libc::SO_TIMESTAMPING,
            &times(&[7, 8, 0, 0, 3, 4]),
        );
        bytes.extend(message(libc::SOL_SOCKET, 9999, &[1, 2, 3]));
        bytes.extend(message(libc::SOL_IP, libc::SO_TIMESTAMPNS, &times(&[1, 1])));
        bytes.extend(message(
            libc::SOL_SOCKET,
            libc::SO_RXQ_OVFL,
            &77_u32.to_ne_bytes(),
        ));
        let expected = Control {
            software: Some(Nanos(7_000_000_008)),
            hardware: Some(Nanos(3_000_000_004)),
            drops: Some(77),
        };
        assert_eq!(Control::parse(&bytes), expected);
        // Truncated anywhere, it neither panics nor returns wrong values.
        for end in 0..bytes.len() {
            let cut = Control::parse(&bytes[..end]);
            assert!(cut.software.is_none() || cut.software == expected.software);
            assert!(cut.drops.is_none() || cut.drops == expected.drops);
        }
        let absent = message(
            libc::SOL_SOCKET,
            libc::SO_TIMESTAMPING,
            &times(&[7, 8, 0, 0, 0, 0]),
        );
        assert_eq!(Control::parse(&absent).hardware, None);
        // A length of zero does not loop forever.
        assert_eq!(Control::parse(&[0; 64]), Control::default());
    }
}
