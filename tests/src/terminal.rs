//! A program on a pseudo-terminal, and what its screen shows.

use crate::{PATIENCE, until};
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::pty::{Winsize, openpty};
use nix::sys::termios::{Termios, tcgetattr};
use std::fs::File;
use std::io::{Read, Write};
use std::num::NonZeroU16;
use std::os::fd::OwnedFd;
use std::process::{Child, Command, ExitStatus};

fn size(rows: u16, columns: u16) -> (NonZeroU16, NonZeroU16) {
    let side = |n| NonZeroU16::new(n).expect("a size");
    (side(rows), side(columns))
}

/// A terminal with a program on it.
pub struct Terminal {
    /// The program.
    pub child: Child,
    keyboard: File,
    /// This end of it stays open, so that its settings can be asked for afterwards.
    pub line: OwnedFd,
    before: Termios,
    screen: vt100::Parser,
}

impl Terminal {
    /// Starts a program in 100 columns and 50 rows.
    ///
    /// # Panics
    /// If there is no terminal, or the program cannot be started.
    #[must_use]
    pub fn start(command: &mut Command) -> Self {
        let window = Winsize {
            ws_row: 50,
            ws_col: 100,
            ws_xpixel: 0,
            ws_ypixel: 0,
        };
        let pair = openpty(&window, None).expect("a pseudo-terminal");
        let before = tcgetattr(&pair.slave).expect("its settings");
        let line = || pair.slave.try_clone().expect("a file descriptor");
        let child = (command.stdin(line()).stdout(line()).stderr(line()).spawn()).expect("it runs");
        fcntl(&pair.master, FcntlArg::F_SETFL(OFlag::O_NONBLOCK)).expect("a flag");
        let (rows, columns) = size(50, 100);
        Self {
            child,
            keyboard: File::from(pair.master),
            line: pair.slave,
            before,
            screen: vt100::Parser::new(rows, columns, 0),
        }
    }

    /// Types.
    ///
    /// # Panics
    /// If the terminal takes nothing.
    pub fn press(&mut self, keys: &str) {
        self.keyboard.write_all(keys.as_bytes()).expect("it reads");
    }

    /// What it shows now.
    pub fn text(&mut self) -> String {
        let mut bytes = [0; 4096];
        while let Ok(count @ 1..) = self.keyboard.read(&mut bytes) {
            self.screen.process(&bytes[..count]);
        }
        self.screen.screen().contents()
    }

    /// Expects the next picture of a program that has the whole screen in another size.
    pub fn resized(&mut self, rows: u16, columns: u16) {
        let (rows, columns) = size(rows, columns);
        self.screen = vt100::Parser::new(rows, columns, 0);
        self.screen.process(b"\x1b[?1049h\x1b[?25l");
    }

    /// Whether the program has the whole screen.
    #[must_use]
    pub fn is_full_screen(&self) -> bool {
        self.screen.screen().alternate_screen()
    }

    /// Waits until it shows what is expected.
    ///
    /// # Panics
    /// If it does not within [`PATIENCE`].
    pub fn wait(&mut self, what: &str, mut shows: impl FnMut(&str) -> bool) -> String {
        let found = until(PATIENCE, || {
            let text = self.text();
            shows(&text).then_some(text)
        });
        found.unwrap_or_else(|| panic!("never {what}:\n{}", self.text()))
    }

    /// Waits until it ends, which leaves the terminal as it was.
    ///
    /// # Panics
    /// If it does not.
    pub fn ended(&mut self) -> ExitStatus {
        let ended = until(PATIENCE, || {
            self.text();
            self.child.try_wait().expect("a child")
        });
        let text = self.text();
        let screen = self.screen.screen();
        assert!(
            !screen.alternate_screen() && !screen.hide_cursor(),
            "{text}"
        );
        assert!(tcgetattr(&self.line).expect("its settings") == self.before);
        ended.unwrap_or_else(|| panic!("it does not end:\n{text}"))
    }

    /// Whether anything is coloured.
    #[must_use]
    pub fn has_colours(&self) -> bool {
        let screen = self.screen.screen();
        let mut cells = (0..50).flat_map(|row| (0..100).filter_map(move |at| screen.cell(row, at)));
        cells.any(|cell| cell.fgcolor() != vt100::Color::Default)
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
