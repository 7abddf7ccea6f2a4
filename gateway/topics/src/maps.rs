//! The lines of /proc/PID/maps, the mappings of a process. Source: proc_pid_maps(5).

use std::string::String;
use std::{fs, io};

/// How the kernel says that a file has been deleted.
const DELETED: &str = " (deleted)";

/// The lines of this process.
pub(crate) fn own() -> io::Result<String> {
    fs::read_to_string("/proc/self/maps")
}

/// The kernel's name of a file, without what says that it has been deleted.
pub(crate) fn file_name(name: &str) -> &str {
    name.strip_suffix(DELETED).unwrap_or(name)
}

/// A mapping. Reading it allocates nothing: a signal handler does so.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Mapping<'a> {
    /// Its first address, and that after its last.
    pub(crate) start: usize,
    pub(crate) end: usize,
    /// Access (`rw-s`), offset, device, inode and file.
    pub(crate) rest: &'a str,
}

impl<'a> Mapping<'a> {
    /// The mapping of a line; `None` if it is none.
    pub(crate) fn parse(line: &'a str) -> Option<Self> {
        let (range, rest) = line.split_once(' ')?;
        let (start, end) = range.split_once('-')?;
        let address = |digits| usize::from_str_radix(digits, 16).ok();
        let (start, end) = (address(start)?, address(end)?);
        Some(Self { start, end, rest })
    }

    /// Its length \[bytes\].
    pub(crate) fn length(&self) -> usize {
        self.end.saturating_sub(self.start)
    }

    /// Whether it can be read, and is not the kernel's own.
    pub(crate) fn is_readable(&self) -> bool {
        self.rest.starts_with('r') && !self.rest.contains("[v")
    }

    /// Whether its file has been deleted.
    pub(crate) fn is_deleted(&self) -> bool {
        self.rest.ends_with(DELETED)
    }

    /// Device, inode and file: what tells one file from another.
    pub(crate) fn file(&self) -> &'a str {
        let rest = file_name(self.rest);
        rest.splitn(3, ' ').nth(2).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_read() {
        let read = |line| {
            let own = Mapping::parse(line).unwrap();
            (own.start, own.length(), own.is_readable(), own.is_deleted())
        };
        let line = "7f00-8000 rw-s 00000000 00:1a 5 /dev/shm/proprio_0a_x.data";
        assert_eq!(read(line), (0x7f00, 0x100, true, false));
        let line = "7f00-8000 rw-s 00000000 00:1a 5 /dev/shm/proprio_0a_x.data (deleted)";
        assert_eq!(read(line), (0x7f00, 0x100, true, true));
        let file = Mapping::parse(line).unwrap().file();
        assert_eq!(file, "00:1a 5 /dev/shm/proprio_0a_x.data");
        let line = "7f00-8000 ---p 00000000 00:00 0 ";
        assert_eq!(read(line), (0x7f00, 0x100, false, false));
        let line = "7f00-8000 r-xp 00000000 00:00 0 [vdso]";
        assert_eq!(read(line), (0x7f00, 0x100, false, false));
        assert_eq!(Mapping::parse("7f00 rw-s"), None);
    }
}
