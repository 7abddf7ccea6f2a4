//! What can go wrong with a domain or a port, with the facts a person needs to put it right.

use std::io;
use std::path::PathBuf;
use std::string::String;
use thiserror::Error;

/// Why a domain cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DomainError {
    /// The name has characters that cannot be in it, or too many.
    #[error("shared-memory domain {name:?}: a name is 1 to 32 letters, digits, `-` or `_` (PROPRIO_DOMAIN)")]
    Name {
        /// The name.
        name: String,
    },
    /// The directory's path is not absolute, is not UTF-8 or is too long.
    #[error(
        "shared-memory domain: directory {} must be absolute, UTF-8 and at most 65 bytes long (PROPRIO_RUNTIME_DIR)", base.display()
    )]
    Base {
        /// The directory.
        base: PathBuf,
    },
    /// There is no /dev/shm, or it cannot be written.
    #[error(
        "no shared memory: /dev/shm {problem}; in a container, give it one that all processes share (--ipc=host or --shm-size)"
    )]
    NoSharedMemory {
        /// What is wrong with it.
        problem: io::Error,
    },
    /// The directory or a file in it belongs to somebody else. iceoryx2's files are for their owner alone.
    #[error(
        "shared-memory domain: {} belongs to user id {owner}, this process runs as {user}: gateway, estimator and consumers must run as the same user", path.display()
    )]
    ForeignOwner {
        /// What belongs to somebody else.
        path: PathBuf,
        /// Whom it belongs to.
        owner: u32,
        /// Who we are.
        user: u32,
    },
    /// A directory or file cannot be created, read or written.
    #[error("shared-memory domain: {} {}: {cause} (PROPRIO_RUNTIME_DIR chooses another place)", doing, path.display())]
    Io {
        /// What was tried.
        doing: &'static str,
        /// With what.
        path: PathBuf,
        /// What the system says.
        cause: io::Error,
    },
    /// Another process has been creating something for longer than it may.
    #[error("shared-memory domain: process {holder} holds {} and does not let go; is it stopped?", path.display())]
    Busy {
        /// The lock file.
        path: PathBuf,
        /// The process that wrote its number there; 0 if it is not known.
        holder: u32,
    },
    /// iceoryx2 could not do its part.
    #[error("shared-memory domain {}: {doing}: {problem}", root.display())]
    Transport {
        /// The domain's directory.
        root: PathBuf,
        /// What was tried.
        doing: &'static str,
        /// What it says.
        problem: String,
    },
}

impl DomainError {
    /// Whether it is a name or a directory that cannot be used on any machine: a wrong configuration, not a lack of this one.
    #[must_use]
    pub fn is_configuration(&self) -> bool {
        matches!(self, Self::Name { .. } | Self::Base { .. })
    }
}

/// Why a port cannot be had.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PortError {
    /// The robot's name has characters that cannot be in it, or too many.
    #[error("robot {robot:?}: a name is 1 to 64 letters, digits, `-`, `_` or `.`")]
    Robot {
        /// The name.
        robot: String,
    },
    /// Nobody offers the service yet: try again later.
    #[error("service {service} does not exist (yet): is its publisher running, in this domain, for this robot?")]
    NotYet {
        /// The service.
        service: String,
    },
    /// The service is there with another type or another version of it, or with less room than this version needs.
    #[error(
        "service {service} offers {offered}, this program needs {needed}: update both to the same version and restart all its users"
    )]
    Incompatible {
        /// The service.
        service: String,
        /// What is there.
        offered: String,
        /// What was asked for.
        needed: String,
    },
    /// All places for writers are taken; where there is one place, another gateway (estimator) serves this robot.
    #[error(
        "service {service} has its {most} writer(s) already (process {holder}): only one gateway and one estimator per robot"
    )]
    Taken {
        /// The service.
        service: String,
        /// How many writers it admits.
        most: usize,
        /// The process of one of them; 0 if it is not known.
        holder: i32,
    },
    /// All places for readers or processes are taken.
    #[error("service {service} has no place left for another {what}")]
    Full {
        /// The service.
        service: String,
        /// For what.
        what: &'static str,
    },
    /// Its resources belong to another user.
    #[error("service {service}: permission denied: gateway, estimator and consumers must run as the same user")]
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
        /// What it says.
        problem: String,
    },
}

/// Why a payload was not sent, or not to everybody. The writer goes on; the sequence number is used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum SendError {
    /// No payload is free in shared memory; should not happen with the sizes that the topics have.
    #[error("no free payload in shared memory")]
    OutOfMemory,
    /// A connection to a reader could not be made or is broken; the other readers have it.
    #[error("a reader's connection failed")]
    Connection,
    /// Anything else that iceoryx2 says of itself.
    #[error("internal error of the transport")]
    Internal,
}

/// Why nothing could be taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum TakeError {
    /// A connection to a writer could not be made; try again.
    #[error("a writer's connection failed")]
    Connection,
    /// Anything else that iceoryx2 says of itself.
    #[error("internal error of the transport")]
    Internal,
}
