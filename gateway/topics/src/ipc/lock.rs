//! The domain's file lock. A process holds it while it creates or removes a resource of the domain;
//! the kernel frees it when the process dies.

use super::DomainError;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::string::ToString;
use std::time::Duration;

/// How long to wait for the lock, about five seconds: a hundred times the duration of a creation
/// on a busy machine.
const STEP: Duration = Duration::from_millis(1);
const STEPS: u32 = 5000;

/// The lock, held until dropped.
#[derive(Debug)]
pub(super) struct Lock {
    path: PathBuf,
    // Closing the file frees the lock.
    _file: File,
}

impl Lock {
    /// Takes the lock at `path`; creates the file if it does not exist.
    pub(super) fn take(path: &Path) -> Result<Self, DomainError> {
        Self::take_within(path, STEPS)
    }

    /// As [`Lock::take`], without waiting.
    pub(super) fn try_take(path: &Path) -> Result<Self, DomainError> {
        Self::take_within(path, 0)
    }

    fn take_within(path: &Path, mut steps: u32) -> Result<Self, DomainError> {
        let io = |doing| {
            move |cause| DomainError::Io {
                doing,
                path: path.to_path_buf(),
                cause,
            }
        };
        loop {
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .open(path)
                .map_err(io("cannot open lock file"))?;
            loop {
                match file.try_lock() {
                    Ok(()) => break,
                    Err(TryLockError::WouldBlock) if steps > 0 => {
                        steps -= 1;
                        std::thread::sleep(STEP);
                    }
                    Err(TryLockError::WouldBlock) => {
                        return Err(DomainError::Busy {
                            path: path.to_path_buf(),
                            holder: holder(&mut file),
                        });
                    }
                    Err(TryLockError::Error(e)) if e.kind() == std::io::ErrorKind::Interrupted => {}
                    Err(TryLockError::Error(e)) => return Err(io("cannot lock")(e)),
                }
            }
            // The last user of a domain removes the lock file, so the locked file may no longer be
            // the one at `path`.
            let ours = file.metadata().map_err(io("cannot examine lock file"))?;
            if std::fs::metadata(path).is_ok_and(|m| m.ino() == ours.ino() && m.dev() == ours.dev())
            {
                // Only for the error message of a process that waits too long.
                let _ = file
                    .set_len(0)
                    .and_then(|()| file.write_all(std::process::id().to_string().as_bytes()));
                return Ok(Self {
                    path: path.to_path_buf(),
                    _file: file,
                });
            }
        }
    }

    /// Removes the lock file and frees the lock.
    pub(super) fn remove(self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

fn holder(file: &mut File) -> u32 {
    let mut text = [0; 16];
    let read = file
        .rewind()
        .and_then(|()| file.read(&mut text))
        .unwrap_or(0);
    let text = text.get(..read).unwrap_or_default();
    core::str::from_utf8(text)
        .ok()
        .and_then(|t| t.trim().parse().ok())
        .unwrap_or(0)
}
