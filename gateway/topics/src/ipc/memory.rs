//! The memory behind a domain's files: allocated when a file is made, and watched while it is used.
//!
//! A file of shared memory is sparse as iceoryx2 makes it: the kernel finds a page when a process
//! first touches it, and kills the process (SIGBUS) if /dev/shm is full by then. So what is made
//! is allocated at once, before anybody uses it; a lack is an error of whoever starts or attaches.
//! Before iceoryx2 makes a file, which touches its first pages, there must be room for all of it.

use super::error::SHM;
use super::sweep::DomainPaths;
use super::{DomainError, Topic};
use crate::maps::{self, Mapping};
use crate::{
    ContactDeclaration, ContactEstimate, Description, DriveEstimate, EstimatorHealth,
    GatewayHealth, InertiaEstimate, Sample, TorqueBudget, TorqueEstimate,
};
use nix::fcntl::posix_fallocate;
use nix::libc;
use nix::sys::statvfs::statvfs;
use std::borrow::ToOwned;
use std::collections::BTreeSet;
use std::format;
use std::fs::{self, Metadata, OpenOptions};
use std::io;
use std::os::fd::{FromRawFd, OwnedFd};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::string::String;
use std::vec::Vec;

/// What a port or a process needs beside payloads: the lists of a service's ports, the connections
/// to those that exist, directories \[bytes\].
pub(super) const BESIDE: u64 = 512 << 10;

/// The bytes that are free in shared memory; no limit if its file system has none.
pub(super) fn free() -> u64 {
    statvfs(SHM).map_or(u64::MAX, |system| match system.blocks() {
        0 => u64::MAX,
        _ => system.blocks_available() * system.fragment_size(),
    })
}

/// The bytes of shared memory that a writer needs: payloads, each with iceoryx2's header and its
/// place in the lists of free ones, and what is beside them.
pub(super) fn needed<T: Topic>() -> u64 {
    const BESIDE_PAYLOAD: usize =
        size_of::<iceoryx2::service::header::publish_subscribe::Header>() + 24;
    let payload = (size_of::<T>() + BESIDE_PAYLOAD).next_multiple_of(align_of::<T>());
    (T::QUALITY.payloads() * payload) as u64 + BESIDE
}

/// Shared memory \[bytes\]: what the gateway and the estimator of a robot need, that of each bus,
/// and what is free.
#[must_use]
pub fn memory_needed() -> ([u64; 2], u64) {
    let robot = 2 * needed::<Description>()
        + needed::<GatewayHealth>()
        + needed::<EstimatorHealth>()
        + needed::<TorqueEstimate>()
        + needed::<ContactEstimate>()
        + needed::<InertiaEstimate>()
        + needed::<TorqueBudget>()
        + needed::<DriveEstimate>()
        + needed::<ContactDeclaration>();
    ([robot, needed::<Sample>()], free())
}

/// Fails if there is no room for `needed` bytes.
pub(super) fn require(needed: u64) -> Result<(), DomainError> {
    let free = free();
    match needed <= free {
        true => Ok(()),
        false => Err(DomainError::NoRoom { needed, free }),
    }
}

/// Whether a segment is empty although it was finished: another program has emptied it. iceoryx2
/// would wait for its content without end.
pub(super) fn is_emptied(meta: &Metadata) -> bool {
    meta.len() == 0 && meta.mode() & 0o400 != 0
}

/// A file of the domain as it was when this process made it.
#[derive(Debug)]
pub(super) struct MadeFile {
    path: PathBuf,
    inode: u64,
    length: u64,
}

impl MadeFile {
    fn of(path: PathBuf) -> Option<Self> {
        let meta = fs::metadata(&path).ok()?;
        Some(Self {
            inode: meta.ino(),
            length: meta.len(),
            path,
        })
    }

    /// Whether it is still the same file, and not shorter.
    pub(super) fn is_intact(&self) -> bool {
        fs::metadata(&self.path)
            .is_ok_and(|meta| meta.ino() == self.inode && meta.len() >= self.length)
    }

    pub(super) fn exists(&self) -> bool {
        self.path.exists()
    }
}

/// The files of the domain at this moment. A connection's file is left out: the reader at its other
/// end may remove it.
pub(super) fn files(paths: &DomainPaths) -> Result<BTreeSet<PathBuf>, DomainError> {
    let mut files: BTreeSet<PathBuf> = paths
        .segments()?
        .into_iter()
        .map(|(path, _)| path)
        .filter(|path| path.extension().is_none_or(|end| end != "connection"))
        .collect();
    for folder in ["services", "nodes", "bells"] {
        files.extend(entries(&paths.root.join(folder)));
    }
    Ok(files)
}

fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path())
}

/// Allocates all segments of the domain, and returns the files that are not among those `before`.
pub(super) fn commit(
    paths: &DomainPaths,
    before: &BTreeSet<PathBuf>,
) -> Result<Vec<MadeFile>, DomainError> {
    for (path, meta) in paths.segments()? {
        // 512 is the unit of st_blocks on every file system (stat(2)).
        if meta.blocks() * 512 < meta.len() {
            allocate(&path, meta.len() - meta.blocks() * 512)?;
        }
    }
    let made = files(paths)?.into_iter();
    Ok(made
        .filter(|path| !before.contains(path))
        .filter_map(MadeFile::of)
        .collect())
}

/// What this process has mapped and opened of a domain that it gives up. iceoryx2's objects that
/// hold it are never dropped: they would remove files of the domain that replaces it.
#[derive(Debug, Default)]
pub(super) struct OpenMappings {
    /// Lines of the kernel's list.
    mappings: Vec<String>,
    /// Numbers, and the kernel's names of the files.
    descriptors: Vec<(i32, String)>,
}

impl OpenMappings {
    /// Everything in files whose names have this prefix.
    pub(super) fn of(prefix: &str) -> Self {
        let lines = maps::own().unwrap_or_default();
        let mappings = lines.lines().filter(|line| line.contains(prefix));
        let descriptors = entries(Path::new("/proc/self/fd")).filter_map(|entry| {
            let number = entry.file_name()?.to_str()?.parse().ok()?;
            let name = fs::read_link(&entry).ok()?.to_str()?.to_owned();
            name.contains(prefix).then_some((number, name))
        });
        Self {
            mappings: mappings.map(ToOwned::to_owned).collect(),
            descriptors: descriptors.collect(),
        }
    }

    /// Unmaps and closes what is still there. Nobody may use it any more.
    #[allow(unsafe_code)]
    pub(super) fn release(self) {
        let lines = maps::own().unwrap_or_default();
        let held = self.mappings.iter();
        let held: Vec<_> = held.filter_map(|line| Mapping::parse(line)).collect();
        for now in lines.lines().filter_map(Mapping::parse) {
            // The end may have been replaced since: `guard`.
            let is_held = held.iter().any(|before| {
                before.start <= now.start && now.end <= before.end && before.file() == now.file()
            });
            if is_held {
                // SAFETY: the mapping belongs to objects that are not used and not dropped.
                unsafe { libc::munmap(now.start as *mut _, now.length()) };
            }
        }
        for (number, name) in self.descriptors {
            let now = fs::read_link(format!("/proc/self/fd/{number}")).unwrap_or_default();
            if now.to_str().map(maps::file_name) == Some(maps::file_name(&name)) {
                // SAFETY: as above.
                drop(unsafe { OwnedFd::from_raw_fd(number) });
            }
        }
    }
}

fn allocate(path: &Path, needed: u64) -> Result<(), DomainError> {
    let file = match OpenOptions::new().read(true).write(true).open(path) {
        // Its owner has just removed it.
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => return Ok(()),
        other => other.map_err(|cause| io_error(path, cause))?,
    };
    let length = file
        .metadata()
        .map_err(|cause| io_error(path, cause))?
        .len();
    let length = i64::try_from(length).unwrap_or(i64::MAX);
    loop {
        match posix_fallocate(&file, 0, length) {
            Ok(()) => return Ok(()),
            Err(nix::Error::EINTR) => {}
            Err(nix::Error::ENOSPC) => {
                let free = free();
                return Err(DomainError::NoRoom { needed, free });
            }
            Err(cause) => return Err(io_error(path, cause.into())),
        }
    }
}

fn io_error(path: &Path, cause: io::Error) -> DomainError {
    DomainError::Io {
        doing: "cannot allocate",
        path: path.to_path_buf(),
        cause,
    }
}
