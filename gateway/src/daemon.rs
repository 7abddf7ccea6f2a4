//! The control plane: opens links and ports, starts one thread per bus, and supervises them until
//! it is stopped.
//!
//! No sample passes through here. Signals are caught before the first port is created, so that a
//! start-up can be stopped cleanly too. Ten times a second this thread sends the health, logs
//! changes of it, and feeds the watchdog as long as every bus thread runs. What is asked over the
//! control socket ([`crate::control`]) is carried out between.

pub use crate::thread::open_link;

use crate::clock::{Clock, Monotonic};
use crate::config::FrameSource;
use crate::control;
use crate::health::{HealthLog, Loads, fill_health};
use crate::journal::Journal;
use crate::link::adapter::{self, Adapter};
use crate::link::interface::{Netlink, Observer};
use crate::operator::Operator;
use crate::plan::Plan;
use crate::thread::{BusThread, join, statuses};
use crate::watch;
use anyhow::{Context, bail};
use proprio_topics::ipc::{Domain, DomainConfig, Writer, open_files_remedy};
use proprio_topics::{Description, GatewayHealth, Nanos};
use sd_notify::NotifyState;
use std::io::Write as _;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};

/// Period of the health messages.
const HEALTH_PERIOD: Duration = Duration::from_millis(100);
/// Delay from the start to the first frame of a replayed log.
const REPLAY_DELAY: Nanos = Nanos::from_millis(200);
/// How often replies of the bus threads are taken, while something was asked.
const REPLY_PERIOD: Duration = Duration::from_millis(5);

/// Runs the gateway until SIGTERM, SIGINT, or the end of its logs.
///
/// # Errors
/// An error chain with cause, place and remedy; its root is a [`crate::plan::PlanError`] if the
/// configuration is wrong.
pub fn run(config: &Path, domain: &DomainConfig, check: bool) -> anyhow::Result<()> {
    let plan = Plan::load_live(config)?;
    if check {
        // The reader of standard output may close it early.
        let _ = write!(
            std::io::stdout(),
            "{plan}{}",
            adapters(&plan, Path::new(adapter::SYS))
        );
        return Ok(());
    }
    let served = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start")
        .and_then(|runtime| runtime.block_on(serve(config, plan, domain)));
    served.map_err(|error| match open_files_remedy(&format!("{error:#}")) {
        Some(remedy) => error.context(remedy),
        None => error,
    })
}

/// Which interface each adapter of `plan` is at this moment, a line each, by the sysfs at `sys`.
/// That it is not there is no error of the configuration: it may be plugged in later.
fn adapters(plan: &Plan, sys: &Path) -> String {
    let lines = plan.buses.iter().filter_map(|bus| match &bus.source {
        FrameSource::SocketCan(named @ (Adapter::Serial { .. } | Adapter::UsbPort { .. })) => {
            Some(match named.resolve(sys) {
                Ok(interface) => format!("bus {}: its adapter is {interface} now\n", bus.name),
                Err(problem) => format!("bus {}: {problem}\n", bus.name),
            })
        }
        _ => None,
    });
    lines.collect()
}

async fn serve(config: &Path, plan: Plan, domain: &DomainConfig) -> anyhow::Result<()> {
    let mut terminate = signal(SignalKind::terminate()).context("cannot catch SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot catch SIGINT")?;
    let (ask, mut asked) = tokio::sync::mpsc::channel(control::MAX_CLIENTS);
    let mut gateway = Gateway::start(config, plan, domain, ask)?;
    let mut ticks = tokio::time::interval(HEALTH_PERIOD);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let why = loop {
        tokio::select! {
            _ = terminate.recv() => break "SIGTERM",
            _ = interrupt.recv() => break "SIGINT",
            Some(asked) = asked.recv() => gateway.begin(asked),
            () = tokio::time::sleep(REPLY_PERIOD), if gateway.operator.waits() => {
                gateway.operator.take_replies(&mut gateway.threads, Monotonic.now());
            }
            _ = ticks.tick() => {
                if let Some(why) = gateway.tick() {
                    break why;
                }
            }
        }
    };
    tracing::info!(why, "stopping");
    gateway.stop()
}

/// The gateway while it runs.
struct Gateway<'a> {
    domain: &'a DomainConfig,
    stop: Arc<AtomicBool>,
    observer: Observer,
    threads: Vec<BusThread>,
    ports: ControlPorts,
    ask: tokio::sync::mpsc::Sender<control::Asked>,
    socket: Option<control::Socket>,
    /// The plan that unknown devices are told by.
    watched: Arc<Mutex<Plan>>,
    operator: Operator,
    loads: Loads,
    health: Box<GatewayHealth>,
    health_log: HealthLog,
    /// Whether systemd waits for signs of life.
    is_watched: bool,
    /// Whether the domain's files are damaged.
    is_damaged: bool,
    /// Whether renewing them has failed.
    has_failed: bool,
}

impl<'a> Gateway<'a> {
    /// Opens the ports and starts the threads of `plan`, which `config` holds.
    fn start(
        config: &Path,
        plan: Plan,
        domain: &'a DomainConfig,
        ask: tokio::sync::mpsc::Sender<control::Asked>,
    ) -> anyhow::Result<Self> {
        let started = Monotonic.now();
        let ports = ControlPorts::open(Domain::open(domain)?, &plan, Monotonic.now())?;
        for bus in plan.buses.iter().filter(|bus| bus.load.is_high()) {
            tracing::warn!(
                bus = bus.name,
                "its devices need up to {:.0} % of the bus: frames of low priority come late; \
                 make periods longer, or move devices to another bus",
                bus.load.share * 100.0
            );
        }
        let stop = Arc::new(AtomicBool::new(false));
        let mut threads = Vec::new();
        let started_all = start_threads(&plan, &ports.domain, &stop, &mut threads);
        let observer = match started_all.and_then(|()| observe(&plan, &stop)) {
            Ok(observer) => observer,
            Err(error) => {
                // The threads that have started must stop their boards and release their ports.
                join(&mut threads, &stop);
                return Err(error);
            }
        };
        let socket = control_socket(domain, &plan.robot, &ask);
        let watched = Arc::new(Mutex::new(plan.clone()));
        if let Err(error) =
            watch::start(Arc::clone(&watched), domain.name.clone(), Arc::clone(&stop))
        {
            tracing::warn!("devices that the configuration does not know are not told: {error}");
        }
        tracing::info!(
            robot = plan.robot,
            buses = plan.buses.len(),
            channels = plan.channels.len(),
            "running"
        );
        let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("running")]);
        Ok(Self {
            domain,
            stop,
            observer,
            threads,
            ports,
            ask,
            socket,
            watched,
            loads: Loads::new(&plan),
            operator: Operator::new(config, plan),
            health: Box::new(GatewayHealth::new(started)),
            health_log: HealthLog::default(),
            is_watched: sd_notify::watchdog_enabled().is_some(),
            is_damaged: false,
            has_failed: false,
        })
    }

    /// Begins to carry out what is asked.
    fn begin(&mut self, asked: control::Asked) {
        let now = Monotonic.now();
        fill_health(
            &mut self.health,
            &statuses(&self.threads),
            &self.observer.newest(),
        );
        self.operator
            .begin(asked, &mut self.threads, &self.health, now);
        if self.operator.has_reloaded() {
            let plan = self.operator.plan();
            let _ = self.ports.description.send(&plan.description(), now);
            *self.watched.lock().unwrap_or_else(PoisonError::into_inner) = plan.clone();
        }
    }

    /// What is done each [`HEALTH_PERIOD`]; returns why the gateway ends, if it does.
    fn tick(&mut self) -> Option<&'static str> {
        let now = Monotonic.now();
        let statuses = statuses(&self.threads);
        fill_health(&mut self.health, &statuses, &self.observer.newest());
        self.loads.measure(&mut self.health, &statuses, now);
        self.health_log.log_changes(&self.health, &statuses);
        // A reader that cannot be reached now is no reason to stop; the next health follows in 0.1
        // s.
        let _ = self.ports.health.send(&self.health, now);
        let _ = self.ports.description.update_connections();
        self.renew(now);
        self.operator.take_replies(&mut self.threads, now);
        if self.threads.iter().any(BusThread::is_lost) {
            return Some("a bus thread has ended unexpectedly");
        }
        if self.threads.iter().all(BusThread::has_ended) {
            return Some("all logs have ended");
        }
        if self.is_watched && !self.threads.iter().any(|t| t.is_stuck(now)) {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
        None
    }

    /// Opens the ports anew if the domain's files are damaged.
    fn renew(&mut self, now: Nanos) {
        let Some(renewed) = self.ports.domain.renewed() else {
            (self.is_damaged, self.has_failed) = (false, false);
            return;
        };
        if !std::mem::replace(&mut self.is_damaged, true) {
            tracing::error!("{}", self.ports.domain.damage());
        }
        let plan = self.operator.plan();
        let opened = renewed.map_err(Into::into);
        match opened.and_then(|domain| ControlPorts::open(domain, plan, now)) {
            Ok(ports) => {
                self.ports = ports;
                for thread in &self.threads {
                    thread.renewal.pass(self.ports.domain.clone());
                }
                drop(self.socket.take());
                self.socket = control_socket(self.domain, &plan.robot, &self.ask);
            }
            Err(error) if !std::mem::replace(&mut self.has_failed, true) => {
                tracing::error!("{error:#}; trying again");
            }
            Err(_) => {}
        }
    }

    fn stop(mut self) -> anyhow::Result<()> {
        // As long as the health's writer is there, no other gateway of this robot can have made
        // one.
        drop(self.socket.take());
        let _ = sd_notify::notify(&[NotifyState::Stopping]);
        let panicked = join(&mut self.threads, &self.stop);
        fill_health(
            &mut self.health,
            &statuses(&self.threads),
            &self.observer.newest(),
        );
        let _ = self.ports.health.send(&self.health, Monotonic.now());
        match panicked {
            None => Ok(()),
            Some(bus) => bail!("the thread of bus {bus:?} panicked: this is a bug in the program"),
        }
    }
}

/// Starts the thread of each bus into `threads`, up to the first that cannot.
fn start_threads(
    plan: &Plan,
    domain: &Domain,
    stop: &Arc<AtomicBool>,
    threads: &mut Vec<BusThread>,
) -> anyhow::Result<()> {
    // A common start keeps the buses of one log in step; by then all of them are open.
    let replay_start = Monotonic.now() + REPLAY_DELAY;
    for (bus, number) in plan.buses.iter().zip(0_u32..) {
        let thread = BusThread::start(plan, bus, number, domain, stop, replay_start);
        threads.push(thread.with_context(|| format!("bus {:?}", bus.name))?);
    }
    Ok(())
}

/// Asks the kernel for the state of the interfaces of `plan` until `stop`.
fn observe(plan: &Plan, stop: &Arc<AtomicBool>) -> anyhow::Result<Observer> {
    let interfaces = plan.buses.iter().map(|bus| match &bus.source {
        FrameSource::SocketCan(adapter) => Some(adapter.clone()),
        FrameSource::Virtual { .. } | FrameSource::Replay { .. } => None,
    });
    let (kernel, stop) = (Netlink::default(), Arc::clone(stop));
    Observer::start(interfaces.collect(), kernel, HEALTH_PERIOD, stop)
        .context("cannot start a thread")
}

/// The control plane's ports.
struct ControlPorts {
    domain: Domain,
    health: Writer<GatewayHealth>,
    description: Writer<Description>,
}

impl ControlPorts {
    fn open(domain: Domain, plan: &Plan, now: Nanos) -> anyhow::Result<Self> {
        let epoch = domain.epoch();
        // Health first: it admits one writer, so this fails if the robot already has a gateway.
        let health = Writer::create(&domain, &plan.robot, epoch)?;
        let mut description = Writer::<Description>::create(&domain, &plan.robot, epoch)?;
        description.send(&plan.description(), now)?;
        Ok(Self {
            domain,
            health,
            description,
        })
    }
}

fn control_socket(
    domain: &DomainConfig,
    robot: &str,
    ask: &tokio::sync::mpsc::Sender<control::Asked>,
) -> Option<control::Socket> {
    match control::Socket::open(domain, robot, ask.clone()) {
        Ok(socket) => Some(socket),
        // Measuring is more important.
        Err(error) => {
            tracing::warn!("there is no control socket, and `proprio ctl` cannot work: {error}");
            None
        }
    }
}

/// Sends log lines to systemd's journal, if standard error goes there, else to standard error;
/// RUST_LOG selects the level, `info` by default. Returns whether they go to the journal.
pub fn start_logging() -> bool {
    use std::io::IsTerminal as _;
    use tracing_subscriber::prelude::*;
    // neli logs every byte that it sends or receives.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info,neli=warn"));
    let journal = Journal::open();
    let is_journal = journal.is_some();
    let text = (!is_journal).then(|| {
        tracing_subscriber::fmt::layer()
            .with_target(false)
            .with_ansi(std::io::stderr().is_terminal())
            .with_writer(std::io::stderr)
    });
    let _ = tracing_subscriber::registry()
        .with(filter)
        .with(journal)
        .with(text)
        .try_init();
    is_journal
}
