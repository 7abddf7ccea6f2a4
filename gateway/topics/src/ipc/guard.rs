//! Survives shared memory that somebody else has shortened.
//!
//! Who touches a page beyond the end of a file is killed by the kernel (SIGBUS). A control loop
//! must not die because another program has damaged a file that it only reads. So the signal's
//! handler replaces what is missing of a domain's file by empty memory of this process, and counts
//! that. An empty list of ports has no ports, an empty queue no payloads, and an empty payload is
//! no valid one: the loop sees that nothing comes, until its ports are opened again. Where iceoryx2
//! panics because of what it finds, that is caught and not printed ([`Guard::survive`]). Any other
//! bus error or panic goes to whoever would have got it without this module.

use crate::maps::Mapping;
use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use core::sync::atomic::{AtomicBool, AtomicU32};
use nix::errno::Errno;
use nix::fcntl::{OFlag, open};
use nix::libc;
use nix::sys::signal::{SaFlags, SigAction, SigHandler, SigSet, Signal, raise, sigaction};
use nix::sys::stat::Mode;
use nix::sys::uio::pread;
use nix::unistd::{SysconfVar, sysconf};
use std::boxed::Box;
use std::cell::Cell;
use std::os::fd::OwnedFd;
use std::panic::{self, AssertUnwindSafe, catch_unwind};
use std::sync::{Once, OnceLock};
use std::thread_local;

/// What the handler needs and must not ask for: the bytes of a page, and who is asked if it is not
/// responsible.
static PREPARED: OnceLock<(usize, SigAction)> = OnceLock::new();

/// The mappings that were damaged so far.
static DAMAGES: AtomicU32 = AtomicU32::new(0);

thread_local! {
    /// Whether a panic of this thread is caught by [`Guard::survive`].
    static SURVIVES: Cell<bool> = const { Cell::new(false) };
}

/// Whether a domain's memory is sound.
#[derive(Debug)]
pub(super) struct Guard {
    /// [`damages`] before any of its files was mapped.
    before: u32,
    /// What was found in it could not be.
    has_failed: AtomicBool,
}

impl Guard {
    /// That of a domain of which nothing is mapped yet.
    pub(super) fn new() -> Self {
        install();
        Self {
            before: DAMAGES.load(Acquire),
            has_failed: AtomicBool::new(false),
        }
    }

    pub(super) fn is_sound(&self) -> bool {
        DAMAGES.load(Acquire) == self.before && !self.has_failed.load(Relaxed)
    }

    /// Runs `call`, which works in the domain's memory, unless that is damaged. iceoryx2 panics
    /// where what it finds can not be: then it is damaged too.
    pub(super) fn survive<R>(&self, call: impl FnOnce() -> R) -> Option<R> {
        if !self.is_sound() {
            return None;
        }
        let before = SURVIVES.replace(true);
        let survived = catch_unwind(AssertUnwindSafe(call)).ok();
        SURVIVES.set(before);
        if survived.is_none() {
            self.has_failed.store(true, Relaxed);
        }
        survived
    }
}

/// Installs the handler, once for the process; not without a list of the process's mappings. And
/// hides panics that are caught: what follows from them is told otherwise.
#[allow(unsafe_code)]
fn install() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // A thread that panics may not change the hook.
        if !std::thread::panicking() {
            let others = panic::take_hook();
            panic::set_hook(Box::new(move |info| {
                if !SURVIVES.try_with(Cell::get).unwrap_or_default() {
                    others(info);
                }
            }));
        }
        let page = sysconf(SysconfVar::PAGE_SIZE).ok().flatten();
        let page = page.and_then(|page| usize::try_from(page).ok());
        let (Some(page), Ok(_)) = (page, mappings()) else {
            return;
        };
        let flags = SaFlags::SA_SIGINFO | SaFlags::SA_ONSTACK | SaFlags::SA_NODEFER;
        let action = SigAction::new(SigHandler::SigAction(on_bus_error), flags, SigSet::empty());
        // SAFETY: the handler makes only calls that are async-signal-safe, and takes no lock.
        if let Ok(before) = unsafe { sigaction(Signal::SIGBUS, &action) } {
            let _ = PREPARED.set((page, before));
        }
    });
}

/// The list of this process's mappings. Each fault opens its own: the kernel goes on from the last
/// mapping that was read from a descriptor, and two threads at one would make each other skip.
fn mappings() -> nix::Result<OwnedFd> {
    let flags = OFlag::O_RDONLY | OFlag::O_CLOEXEC;
    open(c"/proc/self/maps", flags, Mode::empty())
}

#[allow(unsafe_code)]
extern "C" fn on_bus_error(_: libc::c_int, info: *mut libc::siginfo_t, _: *mut libc::c_void) {
    let errno = Errno::last_raw();
    // SAFETY: the kernel passes a valid pointer to a handler with SA_SIGINFO.
    let (address, code) = unsafe { ((*info).si_addr() as usize, (*info).si_code) };
    let Some((page, before)) = PREPARED.get() else {
        return;
    };
    let is_fault = code > 0;
    match damaged(address).filter(|_| is_fault) {
        Some((end, is_deleted)) if replace(address / page * page, end) => {
            // What was deleted belongs to a domain that has been given up.
            if !is_deleted {
                DAMAGES.fetch_add(1, Release);
            }
        }
        _ => {
            // The instruction is repeated, and fails again, for the handler before this one.
            // SAFETY: that handler was installed before.
            let _ = unsafe { sigaction(Signal::SIGBUS, before) };
            if !is_fault {
                let _ = raise(Signal::SIGBUS);
            }
        }
    }
    Errno::set_raw(errno);
}

/// Replaces a range of the end of a damaged mapping by empty memory; returns whether it could.
#[allow(unsafe_code)]
fn replace(start: usize, end: usize) -> bool {
    let access = libc::PROT_READ | libc::PROT_WRITE;
    let kind = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_FIXED;
    // SAFETY: the kernel has no memory for the range any more, so nothing is lost, and nobody can
    // hold a reference that was valid. Its users expect that others change its content at any time.
    let mapped = unsafe { libc::mmap(start as *mut _, end - start, access, kind, -1, 0) };
    mapped != libc::MAP_FAILED
}

/// The end of the mapping at `address` if it is one of a domain's file, and whether that file has
/// been deleted. Without allocation.
fn damaged(address: usize) -> Option<(usize, bool)> {
    let maps = mappings().ok()?;
    let (mut lines, mut chunk, mut place) = (Lines::default(), [0; 1024], 0);
    loop {
        let length = match pread(&maps, &mut chunk, place) {
            Ok(0) | Err(_) => return None,
            Ok(length) => length,
        };
        place += i64::try_from(length).ok()?;
        for &byte in chunk.iter().take(length) {
            let line = lines
                .take(byte)
                .and_then(|line| core::str::from_utf8(line).ok());
            if let Some(mapping) = line.and_then(Mapping::parse)
                && (mapping.start..mapping.end).contains(&address)
            {
                return is_of_domain(&mapping).then_some((mapping.end, mapping.is_deleted()));
            }
        }
    }
}

/// Whether a mapping is that of a segment or a bell.
fn is_of_domain(mapping: &Mapping<'_>) -> bool {
    mapping.rest.contains(" /dev/shm/proprio_") || mapping.rest.contains("/bells/")
}

/// Cuts text into lines; of a line that is too long, the rest is lost.
struct Lines {
    line: [u8; 512],
    length: usize,
    is_whole: bool,
}

impl Default for Lines {
    fn default() -> Self {
        Self {
            line: [0; 512],
            length: 0,
            is_whole: false,
        }
    }
}

impl Lines {
    /// The line that `byte` ends.
    fn take(&mut self, byte: u8) -> Option<&[u8]> {
        if core::mem::take(&mut self.is_whole) {
            self.length = 0;
        }
        if byte == b'\n' {
            self.is_whole = true;
            return self.line.get(..self.length);
        }
        if let Some(place) = self.line.get_mut(self.length) {
            *place = byte;
            self.length += 1;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use memmap2::MmapOptions;
    use std::fs::File;
    use std::io::Write as _;
    use std::vec;

    /// Several pages of any machine.
    const PAGE: usize = 1 << 16;

    #[test]
    fn lines_of_the_kernel_are_read() {
        let text = b"7f00-8000 rw-s 00000000 00:1a 5 /dev/shm/proprio_0a_x.data\n\
                     8000-a000 r--p 00000000 00:1a 6 /lib/libc.so\nb000-c000 rw-p 0 00:00 0\n";
        let mut lines = Lines::default();
        let mut found = vec![];
        for byte in text {
            let line = lines
                .take(*byte)
                .map(|line| core::str::from_utf8(line).unwrap());
            let mapping = line.and_then(Mapping::parse);
            found.extend(mapping.map(|own| (own.start, own.end, is_of_domain(&own))));
        }
        let expected = [
            (0x7f00, 0x8000, true),
            (0x8000, 0xa000, false),
            (0xb000, 0xc000, false),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    #[allow(unsafe_code)]
    fn what_was_cut_off_reads_as_zero() {
        let guard = Guard::new();
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("bells")).unwrap();
        let path = folder.path().join("bells/one");
        File::create(&path)
            .unwrap()
            .write_all(&[7; 5 * PAGE])
            .unwrap();
        let file = File::options().write(true).read(true).open(&path).unwrap();
        let map = MmapOptions::new().map_raw(&file).unwrap();
        // SAFETY: within the mapping.
        let at = |place: usize| unsafe { map.as_ptr().add(place).read_volatile() };
        assert_eq!(at(4 * PAGE), 7);
        file.set_len(2 * PAGE as u64).unwrap();
        assert!(guard.is_sound());
        assert_eq!([at(PAGE), at(2 * PAGE), at(5 * PAGE - 1)], [7, 0, 0]);
        assert!(!guard.is_sound() && Guard::new().is_sound());
    }

    #[test]
    fn what_panics_is_not_used_again() {
        let guard = Guard::new();
        assert_eq!(guard.survive(|| 5), Some(5));
        assert_eq!(guard.survive(|| panic!("as iceoryx2 does")), None::<u8>);
        assert_eq!(guard.survive(|| 5), None);
    }
}
