//! `proprio top` on a pseudo-terminal, beside daemons that come, go and are killed.
#![allow(missing_docs)]

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::pty::{Winsize, openpty};
use nix::sys::signal::{Signal, kill};
use nix::sys::termios::{Termios, tcgetattr};
use nix::unistd::{Pid, ttyname};
use proprio_tests::{Arm, PATIENCE, Rig, now, until};
use proprio_topics::Nanos;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::num::NonZeroU16;
use std::os::fd::OwnedFd;
use std::process::{Child, Command, ExitStatus};

fn size(rows: u16, columns: u16) -> (NonZeroU16, NonZeroU16) {
    let side = |n| NonZeroU16::new(n).expect("a size");
    (side(rows), side(columns))
}

/// A terminal with a program on it.
struct Terminal {
    child: Child,
    keyboard: File,
    /// This end of it stays open, so that its settings can be asked for afterwards.
    line: OwnedFd,
    before: Termios,
    screen: vt100::Parser,
}

impl Terminal {
    /// `proprio top` in 100 columns and 50 rows.
    fn start(command: &mut Command) -> Self {
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

    fn press(&mut self, keys: &str) {
        self.keyboard.write_all(keys.as_bytes()).expect("it reads");
    }

    /// What it shows now.
    fn text(&mut self) -> String {
        let mut bytes = [0; 4096];
        while let Ok(count @ 1..) = self.keyboard.read(&mut bytes) {
            self.screen.process(&bytes[..count]);
        }
        self.screen.screen().contents()
    }

    /// Waits until it shows what is expected.
    fn wait(&mut self, what: &str, mut shows: impl FnMut(&str) -> bool) -> String {
        let found = until(PATIENCE, || {
            let text = self.text();
            shows(&text).then_some(text)
        });
        found.unwrap_or_else(|| panic!("never {what}:\n{}", self.text()))
    }

    /// Waits until it ends, which leaves the terminal as it was.
    fn ended(&mut self) -> ExitStatus {
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

    fn has_colours(&self) -> bool {
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

fn all_valid(text: &str) -> bool {
    text.contains("TORQUES  7 of 7 valid")
}

#[test]
fn a_robot_is_followed_whatever_comes_and_goes() {
    let rig = Rig::new();
    let arm = Arm::new()
        .periods(4, 10, 4)
        .on_virtual(["a", "b"])
        .aligned(20.0)
        .write(&rig.path("robot"));
    let mut top = Terminal::start(rig.command(&["top"]).env_remove("NO_COLOR"));
    top.wait("it waits", |text| text.contains("waiting: "));
    let _simulator = rig.start(&["simulate", "--robot", &arm.folder]);
    let mut gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    top.wait("channels", |text| text.contains("CHANNELS  9 of 9 alive"));
    let mut estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    top.wait("torques", all_valid);
    assert!(top.has_colours());

    estimator.kill();
    let text = top.wait("it is gone", |text| text.contains("estimator was killed"));
    assert!(text.contains("  l_elbow           gone"), "{text}");
    estimator = rig.start(&["estimator", "--config", &arm.estimator]);
    top.wait("torques again", all_valid);
    gateway.kill();
    top.wait("the gateway is gone", |text| {
        text.contains("gateway   was killed") && text.contains("CHANNELS  0 of 9 alive")
    });
    let _gateway = rig.start(&["gateway", "--config", &arm.gateway]);
    top.wait("torques again", all_valid);
    // Another program deletes the domain; the daemons make it again.
    let root = rig.domain.base.join(&rig.domain.name);
    fs::remove_dir_all(&root).expect("the domain is there");
    let since = now();
    top.wait("torques, from a new domain", |text| {
        all_valid(text) && root.is_dir() && now() - since > Nanos::from_millis(2000)
    });

    top.press("/ELBOW\r");
    let text = top.wait("a filter", |text| !text.contains("l_wrist_yaw"));
    assert!(
        text.contains("l_elbow") && text.contains("filter: ELBOW"),
        "{text}"
    );
    top.press("p");
    let paused = top.wait("a pause", |text| text.starts_with("PAUSED"));
    let picture = |text: &str| text.split_once('\n').map(|(_, rest)| rest.to_owned());
    std::thread::sleep(std::time::Duration::from_millis(500));
    assert_eq!(picture(&top.text()), picture(&paused));
    top.press("p");
    top.wait("it goes on", |text| {
        text.starts_with("proprio top") && picture(text) != picture(&paused)
    });
    top.press("\x1b");
    top.wait("all names", |text| text.contains("l_wrist_yaw"));

    let path = ttyname(&top.line).expect("its path");
    let mut stty = Command::new("stty");
    stty.arg("-F").arg(path).args(["cols", "40", "rows", "10"]);
    assert!(stty.status().expect("stty runs").success());
    let (rows, columns) = size(10, 40);
    top.screen = vt100::Parser::new(rows, columns, 0);
    top.screen.process(b"\x1b[?1049h\x1b[?25l");
    top.wait("a small screen", |text| {
        text.contains("TORQUES") && text.lines().last() == Some("q quit  ? keys")
    });
    top.press("q");
    assert!(top.ended().success());
    estimator.assert_runs();
}

#[test]
fn signals_end_it_and_what_is_no_terminal_is_refused() {
    let rig = Rig::new();
    let start = || {
        let mut command = rig.command(&["top", "--robot", "nobody"]);
        let mut top = Terminal::start(command.env("NO_COLOR", "1"));
        top.wait("it waits", |text| text.contains("waiting: "));
        assert!(!top.has_colours());
        top
    };
    for signal in [Signal::SIGTERM, Signal::SIGINT] {
        let mut top = start();
        let id = Pid::from_raw(i32::try_from(top.child.id()).expect("a process"));
        kill(id, signal).expect("it runs");
        assert!(top.ended().success());
    }
    let mut top = start();
    top.press("\x03");
    assert!(top.ended().success());

    let output = rig.command(&["top"]).output().expect("it runs");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.starts_with("error: standard output is no terminal"),
        "{said}"
    );
    assert_eq!(said.lines().count(), 1, "{said}");
}
