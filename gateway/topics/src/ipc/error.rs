//! Errors of domains and ports, with the information needed to correct them.

use crate::ROBOT_NAME;
use core::fmt;
use nix::sys::resource::{Resource, getrlimit};
use std::format;
use std::io;
use std::path::PathBuf;
use std::string::String;
use thiserror::Error;

/// The operating system's words for EMFILE.
const TOO_MANY: &str = "Too many open files";

/// What to do if `problem`, an error with its causes, says that no more files can be opened.
#[must_use]
pub fn open_files_remedy(problem: &str) -> Option<String> {
    problem.contains(TOO_MANY).then(|| {
        let limit = getrlimit(Resource::RLIMIT_NOFILE).map_or(0, |(soft, _)| soft);
        format!(
            "the limit of {limit} open files is too low: `ulimit -n 1024` in the shell, or \
             LimitNOFILE=1024 in the systemd unit"
        )
    })
}

/// Where shared memory lies.
pub(super) const SHM: &str = "/dev/shm";

/// An error of iceoryx2 in words: it does not tell what the operating system refused.
pub(super) fn transport(word: impl fmt::Display) -> String {
    /// More than it opens at once.
    const FILES: usize = 16;
    let limit = getrlimit(Resource::RLIMIT_NOFILE).map_or(u64::MAX, |(soft, _)| soft);
    let open = std::fs::read_dir("/proc/self/fd").map_or(usize::MAX, Iterator::count);
    let cause = if open.saturating_add(FILES) as u64 > limit {
        TOO_MANY
    } else {
        "shared memory cannot be used; `proprio doctor` tests it; if it finds nothing, end all \
         processes of this domain and start them again"
    };
    format!("{cause} (iceoryx2: {word})")
}

/// A process in words; 0 is one that is not known.
fn process(number: u32) -> String {
    match number {
        0 => String::from("another process"),
        number => format!("process {number}"),
    }
}

/// Why a domain cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DomainError {
    /// The name has characters that cannot be in it, or too many.
    #[error(
        "shared-memory domain {name:?}: a name is 1 to 32 letters, digits, `-` or `_` \
         (PROPRIO_DOMAIN)"
    )]
    Name {
        /// The name.
        name: String,
    },
    /// The directory's path is not absolute, is not UTF-8 or is too long.
    #[error(
        "shared-memory domain: directory {} must be absolute, UTF-8 and at most 65 bytes long \
         (PROPRIO_RUNTIME_DIR)", base.display()
    )]
    Base {
        /// The directory.
        base: PathBuf,
    },
    /// No process has opened the domain.
    #[error(
        "shared-memory domain: there is no {}: no gateway or estimator runs in this domain",
        root.display()
    )]
    NotYet {
        /// Its directory.
        root: PathBuf,
    },
    /// Another program has deleted or damaged files of the domain since it was opened.
    #[error(
        "shared-memory domain: files of {} were deleted or damaged: open the domain again",
        root.display()
    )]
    Damaged {
        /// Its directory.
        root: PathBuf,
    },
    /// There is no /dev/shm, or it is not writable.
    #[error(
        "no shared memory: /dev/shm {problem}; in a container, give it one that all processes \
         share (--ipc=host or --shm-size)"
    )]
    NoSharedMemory {
        /// The error.
        problem: io::Error,
    },
    /// Shared memory is full.
    #[error(
        "/dev/shm is full: {} kB are needed, {} kB are free (`df /dev/shm`); remove files there, \
         or make it larger: `mount -o remount,size=256M /dev/shm`, in a container --shm-size",
        needed.div_ceil(1024), free / 1024
    )]
    NoRoom {
        /// What is needed \[bytes\].
        needed: u64,
        /// What is free \[bytes\].
        free: u64,
    },
    /// The directory or a file in it belongs to another user. Only the owner of iceoryx2's files
    /// can use them.
    #[error(
        "shared-memory domain: {} belongs to user id {owner}, this process runs as {user}: \
         gateway, estimator and consumers must run as the same user", path.display()
    )]
    ForeignOwner {
        /// The directory or file.
        path: PathBuf,
        /// Its owner's user id.
        owner: u32,
        /// This process's user id.
        user: u32,
    },
    /// A directory or file cannot be created, read or written.
    #[error(
        "shared-memory domain: {} {}: {cause} (set PROPRIO_RUNTIME_DIR to use another directory)",
        doing, path.display()
    )]
    Io {
        /// What was tried.
        doing: &'static str,
        /// The directory or file.
        path: PathBuf,
        /// The operating system's error.
        cause: io::Error,
    },
    /// Another process holds the domain's lock for too long.
    #[error(
        "shared-memory domain: {} does not release the lock {}; is it stopped?",
        process(*holder), path.display()
    )]
    Busy {
        /// The lock file.
        path: PathBuf,
        /// The process that holds it; 0 if it is not known.
        holder: u32,
    },
    /// iceoryx2 could not do its part.
    #[error("shared-memory domain {}: {doing}: {problem}", root.display())]
    Transport {
        /// The domain's directory.
        root: PathBuf,
        /// What was tried.
        doing: &'static str,
        /// What is wrong, and what to do.
        problem: String,
    },
}

impl DomainError {
    /// Whether the configuration is wrong (a name or directory that is invalid on every machine),
    /// as opposed to a problem of this machine.
    #[must_use]
    pub fn is_configuration(&self) -> bool {
        matches!(self, Self::Name { .. } | Self::Base { .. })
    }
}

/// Why a port cannot be opened or created.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PortError {
    /// The robot's name has characters that cannot be in it, or too many.
    #[error("robot {robot:?}: {ROBOT_NAME}")]
    Robot {
        /// The name.
        robot: String,
    },
    /// The service does not exist yet: try again later.
    #[error(
        "service {service} does not exist yet: is its publisher running in this domain for \
         this robot?"
    )]
    NotYet {
        /// The service.
        service: String,
    },
    /// The service exists with another payload type or version, or with less capacity than this
    /// version needs.
    #[error(
        "service {service} offers {offered}, this program needs {needed}: update all its users to \
         the same version and restart them"
    )]
    Incompatible {
        /// The service.
        service: String,
        /// The type of the existing service.
        offered: String,
        /// The type that this program needs.
        needed: String,
    },
    /// The service has its maximum number of writers. If the maximum is one, another gateway
    /// (estimator) serves this robot.
    #[error(
        "service {service} already has {most} writer(s) (process {holder}): only one gateway \
         and one estimator per robot"
    )]
    Taken {
        /// The service.
        service: String,
        /// The maximum number of writers.
        most: usize,
        /// The process of one of them; 0 if it is not known.
        holder: i32,
    },
    /// The service has its maximum number of readers or processes.
    #[error("service {service} has its maximum number of users; no {what} can be added")]
    Full {
        /// The service.
        service: String,
        /// Reader or process.
        what: &'static str,
    },
    /// The service's files belong to another user.
    #[error(
        "service {service}: permission denied: gateway, estimator and consumers must run as the \
         same user"
    )]
    Denied {
        /// The service.
        service: String,
    },
    /// The domain cannot be used.
    #[error(transparent)]
    Domain(#[from] DomainError),
    /// iceoryx2 could not do its part.
    #[error("service {service}: {problem}")]
    Transport {
        /// The service.
        service: String,
        /// What is wrong, and what to do.
        problem: String,
    },
}

/// Why a payload was not sent, or not to all readers. The writer stays usable; the sequence number
/// is used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum SendError {
    /// No free payload in shared memory; does not happen with the topics' sizes.
    #[error("no free payload in shared memory")]
    OutOfMemory,
    /// A connection to a reader could not be made or is broken; the other readers have the payload.
    /// Or the domain is damaged ([`Domain::is_intact`](super::Domain::is_intact)).
    #[error("a reader's connection failed")]
    Connection,
    /// Any other error of iceoryx2.
    #[error("internal error of the transport")]
    Internal,
}

/// Why no payload could be taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum TakeError {
    /// A connection to a writer could not be made, or the domain is damaged
    /// ([`Domain::is_intact`](super::Domain::is_intact)); try again.
    #[error("a writer's connection failed")]
    Connection,
    /// Any other error of iceoryx2.
    #[error("internal error of the transport")]
    Internal,
}
