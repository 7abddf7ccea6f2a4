#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

mod arrows;
mod model;
mod server;

use anyhow::Context;
use clap::Parser;
use foxglove::messages::Timestamp;
use model::ShownModel;
use proprio_bridge::{Event, Heard, ListenError, Listener, Messages, definitions};
use proprio_estimator::config::Config;
use proprio_topics::csv::Value;
use proprio_topics::ipc::{DomainConfig, monotonic};
use proprio_topics::{Nanos, Reading};
use server::ServedTopics;
use std::collections::BTreeMap;
use std::io::Write;
use std::net::IpAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

/// Prints a line, whether or not anybody reads it.
macro_rules! say {
    ($($text:tt)*) => {
        let _ = writeln!(std::io::stdout(), $($text)*);
    };
}

/// How long arrows outlive the last estimate, besides two periods.
const LIFETIME: Nanos = Nanos::from_millis(500);
/// How often shared memory is looked into at least, so that it does not overflow.
const LOOK: Nanos = Nanos::from_millis(10);
/// How often diagnostics are sent.
const SECOND: Nanos = Nanos::from_millis(1000);
/// How long to wait before a robot that was not there is looked for again.
const AGAIN: Duration = Duration::from_millis(500);

/// Show a running robot in Foxglove (Open connection, Foxglove WebSocket): torques with deviations,
/// contacts, the model in motion, diagnostics. It may be started before the robot's daemons.
///
/// Exit codes: 0 success, 2 wrong configuration or command line, 1 any other failure.
#[derive(Parser)]
#[command(name = "proprio-view", version)]
struct ViewArgs {
    /// The robot; default: that of --config, or the only one
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// The robot's estimator.toml: it names the robot, its URDF and joints that are held
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The robot's URDF; default: that of --config. Without either there is no model
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// A folder that holds the packages of the URDF's meshes: clients may read what is in it. May
    /// be repeated
    #[arg(long, value_name = "FOLDER")]
    meshes: Vec<PathBuf>,
    /// The address to serve. Any other than the default lets other machines look
    #[arg(long, value_name = "IP", default_value = "127.0.0.1")]
    address: IpAddr,
    /// The port to serve; 0: any
    #[arg(long, value_name = "N", default_value_t = 8765)]
    port: u16,
    /// How many messages of a topic are sent per second at most; the newest are
    #[arg(long, value_name = "N", default_value_t = 100,
        value_parser = clap::value_parser!(u16).range(1..=1000))]
    rate: u16,
    /// The shared-memory domain [env: PROPRIO_DOMAIN] [default: default]
    #[arg(long, value_name = "NAME")]
    domain: Option<String>,
}

fn main() -> ExitCode {
    let args = ViewArgs::parse();
    let (code, error) = match describe(&args) {
        Err(error) => (2, error),
        Ok((robot, model)) => match run(&args, robot, model) {
            Ok(()) => return ExitCode::SUCCESS,
            Err(error) => (1, error),
        },
    };
    eprintln!("error: {error:#}");
    ExitCode::from(code)
}

/// The robot's name and model, as far as they were given.
fn describe(args: &ViewArgs) -> anyhow::Result<(Option<String>, Option<ShownModel>)> {
    let config = args.config.as_deref().map(Config::load).transpose()?;
    let (name, file, locked) = match config {
        Some(config) => (Some(config.robot), Some(config.model), config.locked),
        None => (None, None, BTreeMap::new()),
    };
    let model = match args.urdf.clone().or(file) {
        Some(file) => {
            let model = ShownModel::read(&file, locked);
            Some(model.with_context(|| file.display().to_string())?)
        }
        None => None,
    };
    Ok((args.robot.clone().or(name), model))
}

fn run(args: &ViewArgs, robot: Option<String>, model: Option<ShownModel>) -> anyhow::Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    let mut domain = DomainConfig::from_env();
    if let Some(name) = &args.domain {
        domain.name.clone_from(name);
    }
    let period = Nanos(SECOND.0 / i64::from(args.rate));
    let mut topics = ServedTopics::new(period);
    let urdf = model.as_ref().map(ShownModel::urdf);
    let server = topics
        .serve(args.address, args.port, urdf, args.meshes.clone())
        .with_context(|| {
            let (address, port) = (args.address, args.port);
            format!("{address}, port {port}: another program may serve there (--port)")
        })?;
    say!(
        "ws://{}",
        std::net::SocketAddr::new(args.address, server.port())
    );
    let mut view = RobotView::new(topics, robot.as_deref().unwrap_or("robot"), model, period);
    let mut said = String::new();
    while !stop.load(Relaxed) {
        let opened = Listener::open(&domain, robot.as_deref());
        let ended = match opened {
            Ok(mut listener) => {
                said.clear();
                say!("showing {}", listener.robot());
                view = RobotView::new(
                    view.messages.into_sink(),
                    listener.robot(),
                    view.model,
                    period,
                );
                view.follow(&mut listener, &stop)
            }
            Err(error @ ListenError::Several { .. }) => return Err(error.into()),
            Err(error) => Err(error),
        };
        if let Err(error) = ended {
            let why = format!("waiting for a robot: {error}");
            if why != said {
                say!("{why}");
                said = why;
            }
            view.update(monotonic());
            std::thread::sleep(AGAIN);
        }
    }
    Ok(())
}

/// One robot, as it is shown.
struct RobotView {
    messages: Messages<ServedTopics>,
    model: Option<ShownModel>,
    period: Nanos,
    /// The newest instant of a joint's position.
    moved: Option<Nanos>,
    /// Whether the transforms of that were not sent yet.
    moves: bool,
    /// When diagnostics are next.
    second: Nanos,
}

impl RobotView {
    fn new(topics: ServedTopics, robot: &str, model: Option<ShownModel>, period: Nanos) -> Self {
        let mut messages = Messages::new(topics, robot, realtime_offset());
        let Ok(()) = messages.announce();
        Self {
            messages,
            model,
            period,
            moved: None,
            moves: false,
            second: Nanos::MIN,
        }
    }

    /// Shows what is heard until `stop`.
    fn follow(&mut self, listener: &mut Listener, stop: &AtomicBool) -> Result<(), ListenError> {
        let mut next = monotonic();
        while !stop.load(Relaxed) {
            let now = monotonic();
            let Ok(()) = self.messages.know(listener.series());
            listener.poll::<ListenError>(now, |listener, event| {
                let Ok(()) = self.messages.know(listener.series());
                self.hear(&event);
                Ok(())
            })?;
            self.update(now);
            // No longer than the period on average, and without catching up after a long pause.
            next = (next + self.period.min(LOOK)).max(now);
            let pause = next.saturating_sub(monotonic()).max(Nanos::ZERO);
            std::thread::sleep(Duration::from_nanos(pause.0.unsigned_abs()));
        }
        Ok(())
    }

    fn hear(&mut self, event: &Event) {
        let messages = &mut self.messages;
        let Ok(()) = messages.say(event.t, &event.heard);
        match &event.heard {
            Heard::Value(_, Value::Reading(Reading::Joint(_), _)) => {
                self.moved = self.moved.max(Some(event.t));
                self.moves = true;
            }
            Heard::Torques(torques, names) => {
                let Ok(()) = messages.torque_bands(names, torques);
            }
            Heard::Contacts(contacts, names) => {
                let wall = messages.wall(event.t);
                let lifetime = LIFETIME + self.period + self.period;
                let scene = arrows::scene(wall, lifetime, names, contacts);
                messages.sink().scene("/contact_arrows", wall, &scene);
            }
            _ => {}
        }
    }

    /// Sends what is due.
    fn update(&mut self, now: Nanos) {
        let is_second = now >= self.second;
        if is_second {
            self.second = now + SECOND;
            self.messages.set_offset(realtime_offset());
            let Ok(()) = self.messages.diagnostics(now);
        }
        // Also if nothing moves: for those who have just come.
        if let Some(model) = &self.model
            && (self.moves || is_second)
        {
            self.moves = false;
            let t = self.moved.unwrap_or(now);
            let transforms = model.transforms(|joint| self.messages.state(joint, t).position);
            let Ok(()) = self
                .messages
                .send("/tf", definitions::transforms, t, |wall| {
                    model::message(wall, &transforms)
                });
        }
        self.messages.sink().flush(now);
    }
}

/// The wall clock minus CLOCK_MONOTONIC.
fn realtime_offset() -> Nanos {
    let wall = i64::try_from(Timestamp::now().total_nanos()).unwrap_or_default();
    Nanos(wall - monotonic().0)
}
