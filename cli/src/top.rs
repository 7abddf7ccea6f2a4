//! `proprio top`: a running robot on the screen of a terminal.
//!
//! ```text
//! shared memory -> follow: a thread -> RobotState -> Screen -> the terminal
//!                  (ports)             (pure)        (pure: keys, drawing)
//! ```

mod follow;
mod sections;
mod snapshot;
#[cfg(test)]
mod tests;
mod view;

use crate::running::interrupted;
use anyhow::{Context, bail};
use follow::follow;
use proprio_topics::ipc::{DomainConfig, monotonic};
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event};
use snapshot::RobotState;
use std::io::{IsTerminal as _, stdout};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel, sync_channel};
use std::time::Duration;
use view::{Screen, Wish};

/// How often the screen is drawn, without a key.
const DRAW: Duration = Duration::from_millis(100);
/// How long the thread that reads may take to leave the domain.
const FAREWELL: Duration = Duration::from_millis(1000);

/// `proprio top`.
#[derive(clap::Args)]
pub(crate) struct TopArgs {
    /// The robot that is shown first; default: the first one (key r: the next)
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
}

/// Shows a robot until a key or a signal ends it.
pub(crate) fn run(args: &TopArgs, config: &DomainConfig) -> anyhow::Result<()> {
    if !stdout().is_terminal() {
        bail!("standard output is no terminal: `proprio status` prints the same once");
    }
    let (ask, wanted) = channel();
    let (out, snapshots) = sync_channel(1);
    let (config, robot) = (config.clone(), args.robot.clone());
    let view = Screen::new(&config.name, monotonic());
    // First, so that the domain keeps the panics that it catches from the terminal's hook.
    let terminal = ratatui::try_init().context("the terminal cannot be used");
    let shown = terminal.and_then(|terminal| {
        std::thread::Builder::new()
            .name("reader".into())
            .spawn(move || follow(&config, robot, &wanted, &out))
            .context("cannot start a thread")?;
        show(terminal, view, &snapshots, &ask)
    });
    ratatui::restore();
    drop(ask);
    while snapshots.recv_timeout(FAREWELL).is_ok() {}
    shown
}

fn show(
    mut terminal: DefaultTerminal,
    mut view: Screen,
    snapshots: &Receiver<RobotState>,
    ask: &Sender<String>,
) -> anyhow::Result<()> {
    let stop = interrupted()?;
    while !stop.load(Relaxed) {
        match snapshots.try_recv() {
            Ok(snapshot) => view.show(snapshot),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => bail!("the thread that reads has ended"),
        }
        terminal.draw(|frame| view.draw(frame, monotonic()))?;
        let mut wait = DRAW;
        while event::poll(wait)? {
            wait = Duration::ZERO;
            if let Event::Key(key) = event::read()?
                && key.is_press()
            {
                match view.press(key) {
                    Wish::Nothing => {}
                    Wish::Quit => return Ok(()),
                    Wish::Robot(name) => ask.send(name)?,
                }
            }
        }
    }
    Ok(())
}
