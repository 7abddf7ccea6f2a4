//! The domain's file lock. A process holds it while it creates or removes a resource of the domain;
//! the kernel frees it when the process dies.

use super::DomainError;
use std::fs::{File, OpenOptions, TryLockError};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How long to wait for the lock, about five seconds: a hundred times the duration of a creation
/// on a busy machine.
const STEP: Duration = Duration::from_millis(1);
pub(super) const STEPS: u32 = 5000;

/// How long a process waits that has other things to do, and tries again: 20 ms.
pub(super) const FEW_STEPS: u32 = 20;

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

    /// As [`Lock::take`], waiting for so many steps.
    pub(super) fn take_within(path: &Path, mut steps: u32) -> Result<Self, DomainError> {
        let io = |doing| {
            move |cause| DomainError::Io {
                doing,
                path: path.to_path_buf(),
                cause,
            }
        };
        loop {
            let file = OpenOptions::new()
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
                            holder: holder(&file),
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

/// The process that holds the lock of `file`, from the kernel's list; 0 if it is not in it.
///
/// Nothing is written to the file for this: on a disk that others write to, a write can wait for
/// seconds.
fn holder(file: &File) -> u32 {
    let locks = std::fs::read_to_string("/proc/locks").unwrap_or_default();
    let inode = file.metadata().map_or(0, |meta| meta.ino());
    let of_file = |line: &&str| line.split_whitespace().nth(1) == Some("FLOCK");
    // 1: FLOCK  ADVISORY  WRITE 15653 fe:00:5489643 0 EOF
    let held = locks.lines().filter(of_file).find_map(|line| {
        let mut words = line.split_whitespace().skip(4);
        let (process, place) = (words.next()?, words.next()?);
        let (_, number) = place.rsplit_once(':')?;
        (number.parse() == Ok(inode)).then(|| process.parse().ok())?
    });
    held.unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_holder_of_a_lock_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("test.lock");
        let lock = Lock::take(&path).unwrap();
        match Lock::try_take(&path) {
            Err(DomainError::Busy { holder, .. }) => assert_eq!(holder, std::process::id()),
            other => panic!("{other:?}"),
        }
        drop(lock);
        Lock::try_take(&path).unwrap();
        assert_eq!(holder(&File::open(&path).unwrap()), 0);
        assert_eq!(path.metadata().unwrap().len(), 0, "nothing is written");
    }
}
