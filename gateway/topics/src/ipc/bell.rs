//! Wakes the readers that wait for a payload: one word in shared memory per service, and the
//! kernel's futex.
//!
//! iceoryx2 has events of its own. They are ports, with files and connections that must survive the
//! death of a process at any instant, and each notification is a system call. A futex needs nothing
//! but memory: it survives every death, and ringing costs a system call only if somebody waits.
//!
//! A second word counts the changes of the service's writers. A reader that must not make file
//! operations compares it before it reads, because iceoryx2 connects to new writers while reading.
//!
//! A third word counts the writers that have left in order, which tells them from killed ones.

use super::PortError;
use crate::Nanos;
use core::num::NonZeroU32;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::{AcqRel, Acquire};
use memmap2::{MmapOptions, MmapRaw};
use nix::fcntl::posix_fallocate;
use rustix::io::Errno;
use rustix::thread::futex::{self, Flags, Timespec};
use std::fs::{DirBuilder, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

/// The word's lowest bit: somebody waits. The other bits count the rings.
const WAITED_FOR: u32 = 1;
const RING: u32 = 2;

/// The rings, the changes of the writers, and the writers that have left in order.
type Words = [AtomicU32; 3];

/// The bell of one service, in every process that writes or reads it.
#[derive(Debug)]
pub(super) struct Bell {
    memory: MmapRaw,
}

/// A number of rings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Rings(u32);

impl Bell {
    /// The bell of `service` under the domain's directory `root`. Creates it if it does not exist:
    /// whoever comes first.
    pub(super) fn open(root: &Path, service: &str) -> Result<Self, PortError> {
        Self::map(&root.join("bells"), service).map_err(|cause| PortError::Transport {
            service: service.into(),
            problem: std::format!("its bell cannot be opened: {cause}"),
        })
    }

    /// Whether somebody has opened the bell of `service`.
    pub(super) fn exists(root: &Path, service: &str) -> bool {
        Self::file(&root.join("bells"), service).exists()
    }

    fn file(folder: &Path, service: &str) -> PathBuf {
        folder.join(service.replace('/', "."))
    }

    fn map(folder: &Path, service: &str) -> io::Result<Self> {
        match DirBuilder::new().mode(0o700).create(folder) {
            Err(cause) if cause.kind() != io::ErrorKind::AlreadyExists => return Err(cause),
            _ => {}
        }
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(Self::file(folder, service))?;
        // Whoever was killed between these two lines has left an empty file, which is as good as a
        // new one.
        loop {
            match posix_fallocate(&file, 0, size_of::<Words>() as i64) {
                Err(nix::Error::EINTR) => {}
                done => break done?,
            }
        }
        let memory = MmapOptions::new().len(size_of::<Words>()).map_raw(&file)?;
        Ok(Self { memory })
    }

    #[allow(unsafe_code)]
    fn words(&self) -> &Words {
        // SAFETY: the mapping is readable, writable and as long as the words; it begins at a page,
        // so it is aligned; it lives as long as `self`. All processes access it atomically only,
        // and any bytes are legal.
        unsafe { &*self.memory.as_ptr().cast() }
    }

    fn word(&self) -> &AtomicU32 {
        let [rings, ..] = self.words();
        rings
    }

    /// The number of changes of the service's writers.
    pub(super) fn changes(&self) -> u32 {
        let [_, changes, _] = self.words();
        changes.load(Acquire)
    }

    /// Counts a change of the service's writers. Call it before the change.
    pub(super) fn change(&self) {
        let [_, changes, _] = self.words();
        changes.fetch_add(1, AcqRel);
    }

    /// The number of writers that have left in order.
    pub(super) fn farewells(&self) -> u32 {
        let [.., farewells] = self.words();
        farewells.load(Acquire)
    }

    /// Counts a writer that leaves in order. Call it before it leaves.
    pub(super) fn say_farewell(&self) {
        let [.., farewells] = self.words();
        farewells.fetch_add(1, AcqRel);
    }

    /// Counts a change of the writers of every service under the domain's directory `root`.
    pub(super) fn change_all(root: &Path) {
        let folder = root.join("bells");
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            if let Some(name) = entry.file_name().to_str()
                && let Ok(bell) = Self::map(&folder, name)
            {
                bell.change();
            }
        }
    }

    /// Wakes everybody who waits.
    pub(super) fn ring(&self) {
        let word = self.word();
        if word.fetch_add(RING, AcqRel) & WAITED_FOR != 0 {
            word.fetch_and(!WAITED_FOR, AcqRel);
            // Not private: the word is shared between processes.
            let _ = futex::wake(word, Flags::empty(), i32::MAX.cast_unsigned());
        }
    }

    /// The number of rings so far.
    pub(super) fn rings(&self) -> Rings {
        Rings(self.word().load(Acquire) & !WAITED_FOR)
    }

    /// Waits until the bell has rung since there were `heard` rings, at most until CLOCK_MONOTONIC
    /// shows `deadline`; returns whether it has.
    pub(super) fn wait(&self, heard: Rings, deadline: Nanos) -> bool {
        let word = self.word();
        // Before the clock's origin is long ago.
        let ns = deadline.0.max(0);
        let until = Timespec {
            tv_sec: ns / 1_000_000_000,
            tv_nsec: ns % 1_000_000_000,
        };
        loop {
            let before = word.fetch_or(WAITED_FOR, AcqRel);
            if Rings(before & !WAITED_FOR) != heard {
                return true;
            }
            // Returns at once if the bell rings meanwhile; its time is absolute, unlike that of the
            // plain wait, so that signals do not prolong it.
            let value = before | WAITED_FOR;
            match futex::wait_bitset(word, Flags::empty(), value, Some(&until), NonZeroU32::MAX) {
                Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
                Err(_) => return self.rings() != heard,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ipc::monotonic;
    use std::sync::atomic::AtomicBool;
    use std::sync::atomic::Ordering::Relaxed;
    use std::thread;

    /// No ring is lost: whoever waits for the next number gets it, without the deadline's help.
    #[test]
    fn every_ring_is_heard() {
        let folder = tempfile::tempdir().unwrap();
        let open = || Bell::open(folder.path(), "icub/samples").unwrap();
        let (near, far) = (open(), open());
        const COUNT: u32 = 20_000;
        let answered = AtomicBool::new(false);
        thread::scope(|scope| {
            let answered = &answered;
            scope.spawn(move || {
                for _ in 0..COUNT {
                    near.ring();
                    while !answered.swap(false, Relaxed) {
                        thread::yield_now();
                    }
                }
            });
            let mut heard = Rings(0);
            let patience = Nanos::from_millis(20_000);
            for _ in 0..COUNT {
                assert!(far.wait(heard, monotonic() + patience), "a ring was lost");
                heard = far.rings();
                answered.store(true, Relaxed);
            }
            assert_eq!(heard, Rings(COUNT * RING));
        });
    }

    #[test]
    fn a_wait_ends_at_its_deadline() {
        let folder = tempfile::tempdir().unwrap();
        let bell = Bell::open(folder.path(), "icub/estimate/torque").unwrap();
        let deadline = monotonic() + Nanos::from_millis(5);
        assert!(!bell.wait(bell.rings(), deadline));
        assert!(monotonic() >= deadline);
        assert!(!bell.wait(bell.rings(), Nanos::MIN), "long past");
        bell.ring();
        assert!(bell.wait(Rings(0), Nanos::MIN), "rung before");
    }
}
