//! Log lines for systemd's journal, with their fields: `journalctl -u proprio-gateway
//! DEVICE=chest_imu` finds the lines about a device, `-p warning` the warnings.
//!
//! The text of a line has the fields, too. tracing-journald leaves them out of it, so that the
//! journal's usual output would no longer say which device a line is about.
//!
//! Sources: systemd.exec(5), JOURNAL_STREAM; systemd.io/JOURNAL_NATIVE_PROTOCOL.

use nix::sys::stat::fstat;
use std::fmt::{Debug, Write as _};
use std::io::{self, Write as _};
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

const SOCKET: &str = "/run/systemd/journal/socket";

/// The journal of the machine. Whoever logs never waits for it: lines that it does not take are
/// counted, and the next line says how many.
pub(crate) struct Journal {
    socket: UnixDatagram,
    path: PathBuf,
    lost: AtomicU64,
}

impl Journal {
    /// The journal, if that is where systemd sends this process's standard error.
    pub(crate) fn open() -> Option<Self> {
        let stream = std::env::var("JOURNAL_STREAM").ok()?;
        let stat = fstat(io::stderr()).ok()?;
        if stream != format!("{}:{}", stat.st_dev, stat.st_ino) {
            return None;
        }
        Self::at(SOCKET.into()).ok()
    }

    fn at(path: PathBuf) -> io::Result<Self> {
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        Ok(Self {
            socket,
            path,
            lost: AtomicU64::new(0),
        })
    }

    fn put(&self, mut line: JournalEntry, level: Level) {
        let lost = self.lost.swap(0, Ordering::Relaxed);
        if lost > 0 {
            line.fields.push(("lost_lines", lost.to_string()));
        }
        // Addressed each time, because a journal that was restarted has a new socket.
        match self.socket.send_to(&line.entry(level), &self.path) {
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                self.lost.fetch_add(lost + 1, Ordering::Relaxed);
            }
            // There is no journal, or the line is too long for a datagram.
            Err(_) => drop(writeln!(io::stderr(), "{}", line.text())),
        }
    }
}

impl<S: Subscriber> Layer<S> for Journal {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut line = JournalEntry::default();
        event.record(&mut line);
        self.put(line, *event.metadata().level());
    }
}

/// What a line says: its message and its fields.
#[derive(Default)]
struct JournalEntry {
    message: String,
    fields: Vec<(&'static str, String)>,
}

impl Visit for JournalEntry {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        match field.name() {
            "message" => self.message = format!("{value:?}"),
            name => self.fields.push((name, format!("{value:?}"))),
        }
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        match field.name() {
            "message" => value.clone_into(&mut self.message),
            name => self.fields.push((name, value.to_owned())),
        }
    }
}

impl JournalEntry {
    fn text(&self) -> String {
        let mut text = self.message.clone();
        for (name, value) in &self.fields {
            let _ = write!(text, " {name}={value}");
        }
        text
    }

    /// The datagram of the journal's own protocol.
    fn entry(&self, level: Level) -> Vec<u8> {
        // The numbers of syslog(3).
        let priority = match level {
            Level::ERROR => "3",
            Level::WARN => "4",
            Level::INFO => "6",
            _ => "7",
        };
        let mut entry = Vec::new();
        let mut put = |name: &str, value: &str| {
            entry.extend_from_slice(name.as_bytes());
            if value.contains('\n') {
                entry.push(b'\n');
                entry.extend_from_slice(&(value.len() as u64).to_le_bytes());
            } else {
                entry.push(b'=');
            }
            entry.extend_from_slice(value.as_bytes());
            entry.push(b'\n');
        };
        put("PRIORITY", priority);
        put("SYSLOG_IDENTIFIER", "proprio");
        put("MESSAGE", &self.text());
        for (name, value) in &self.fields {
            put(&name.to_uppercase(), value);
        }
        entry
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_its_fields_in_its_text_and_apart() {
        let line = JournalEntry {
            message: "silent".to_owned(),
            fields: vec![("device", "imu".to_owned()), ("error", "a\nb".to_owned())],
        };
        let expected = [
            &b"PRIORITY=4\nSYSLOG_IDENTIFIER=proprio\nMESSAGE\n\x1B\0\0\0\0\0\0\0"[..],
            b"silent device=imu error=a\nb\nDEVICE=imu\nERROR\n\x03\0\0\0\0\0\0\0a\nb\n",
        ];
        assert_eq!(line.text().len(), 27);
        assert_eq!(
            String::from_utf8_lossy(&line.entry(Level::WARN)),
            String::from_utf8_lossy(&expected.concat())
        );
    }

    #[test]
    fn nobody_waits_for_a_journal_that_hangs_and_lost_lines_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("socket");
        let reader = UnixDatagram::bind(&path).unwrap();
        reader.set_nonblocking(true).unwrap();
        let journal = Journal::at(path).unwrap();
        let log = || {
            let line = JournalEntry {
                message: "x".repeat(1000),
                fields: vec![],
            };
            journal.put(line, Level::INFO);
        };
        let read = || {
            let mut buffer = [0; 4096];
            let length = reader.recv(&mut buffer).ok()?;
            Some(String::from_utf8_lossy(&buffer[..length]).into_owned())
        };
        // More than any queue of the kernel holds.
        (0..10_000).for_each(|_| log());
        let taken = std::iter::from_fn(read).count();
        log();
        let expected = format!("LOST_LINES={}\n", 10_000 - taken);
        assert!(taken > 0 && read().unwrap().ends_with(&expected));
        log();
        assert!(!read().unwrap().contains("LOST"));
    }

    #[test]
    fn only_a_stream_of_the_journal_is_one() {
        // Tests do not run as a service whose standard error is the journal.
        assert!(Journal::open().is_none());
    }
}
