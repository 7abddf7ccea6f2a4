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
use anyhow::{Context, anyhow, bail};
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
/// Time between two looks for what the bus threads have replied, while something was asked.
const LOOK: Duration = Duration::from_millis(5);

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

async fn serve(config: &Path, plan: Plan, domain_config: &DomainConfig) -> anyhow::Result<()> {
    let mut terminate = signal(SignalKind::terminate()).context("cannot catch SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot catch SIGINT")?;
    let clock = Monotonic;
    let started = clock.now();
    let mut ports = ControlPorts::open(Domain::open(domain_config)?, &plan, clock.now())?;

    for bus in plan.buses.iter().filter(|bus| bus.load.is_high()) {
        tracing::warn!(
            bus = bus.name,
            "its devices need up to {:.0} % of the bus: frames of low priority come late; make \
             periods longer, or move devices to another bus",
            bus.load.share * 100.0
        );
    }
    let stop = Arc::new(AtomicBool::new(false));
    // A common start keeps the buses of one log in step; by then all of them are open.
    let replay_start = clock.now() + REPLAY_DELAY;
    let mut threads = Vec::new();
    let mut failure = None;
    for (bus, number) in plan.buses.iter().zip(0_u32..) {
        match BusThread::start(&plan, bus, number, &ports.domain, &stop, replay_start) {
            Ok(thread) => threads.push(thread),
            Err(error) => {
                failure = Some(error.context(format!("bus {:?}", bus.name)));
                break;
            }
        }
    }
    if let Some(error) = failure {
        // The threads that have started must stop their boards and release their ports.
        join(&mut threads, &stop);
        return Err(error);
    }
    let interfaces = plan.buses.iter().map(|bus| match &bus.source {
        FrameSource::SocketCan(adapter) => Some(adapter.clone()),
        FrameSource::Virtual { .. } | FrameSource::Replay { .. } => None,
    });
    let observer = Observer::start(
        interfaces.collect(),
        Netlink::default(),
        HEALTH_PERIOD,
        Arc::clone(&stop),
    );
    let observer = match observer {
        Ok(observer) => observer,
        Err(error) => {
            join(&mut threads, &stop);
            return Err(anyhow!(error).context("cannot start a thread"));
        }
    };
    let (ask, mut asked) = tokio::sync::mpsc::channel(control::MAX_CLIENTS);
    let mut socket = control_socket(domain_config, &plan.robot, &ask);
    let watched = Arc::new(Mutex::new(plan.clone()));
    if let Err(error) = watch::start(
        Arc::clone(&watched),
        domain_config.name.clone(),
        Arc::clone(&stop),
    ) {
        tracing::warn!("devices that the configuration does not know are not told: {error}");
    }
    let mut loads = Loads::new(&plan);
    let mut operator = Operator::new(config, plan);
    tracing::info!(
        robot = operator.plan().robot,
        buses = operator.plan().buses.len(),
        channels = operator.plan().channels.len(),
        "running"
    );
    let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("running")]);
    let watchdog = sd_notify::watchdog_enabled();

    let mut health = Box::new(GatewayHealth::new(started));
    let mut health_log = HealthLog::default();
    let (mut is_damaged, mut has_failed) = (false, false);
    let mut ticks = tokio::time::interval(HEALTH_PERIOD);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let why = loop {
        tokio::select! {
            _ = terminate.recv() => break "SIGTERM",
            _ = interrupt.recv() => break "SIGINT",
            Some(asked) = asked.recv() => {
                fill_health(&mut health, &statuses(&threads), &observer.newest());
                operator.begin(asked, &mut threads, &health, clock.now());
                if operator.has_reloaded() {
                    let description = operator.plan().description();
                    let _ = ports.description.send(&description, clock.now());
                    *watched.lock().unwrap_or_else(PoisonError::into_inner) =
                        operator.plan().clone();
                }
                continue;
            }
            () = tokio::time::sleep(LOOK), if operator.waits() => {
                operator.look(&mut threads, clock.now());
                continue;
            }
            _ = ticks.tick() => {}
        }
        let now = clock.now();
        let statuses = statuses(&threads);
        fill_health(&mut health, &statuses, &observer.newest());
        loads.measure(&mut health, &statuses, now);
        health_log.log_changes(&health, &statuses);
        // A reader that cannot be reached now is no reason to stop; the next health follows in 0.1
        // s.
        let _ = ports.health.send(&health, now);
        let _ = ports.description.update_connections();
        let renewed = ports.domain.renewed().map(|domain| {
            if !std::mem::replace(&mut is_damaged, true) {
                tracing::error!("{}", ports.domain.damage());
            }
            ControlPorts::open(domain?, operator.plan(), now)
        });
        match renewed {
            Some(Ok(new)) => {
                ports = new;
                for thread in &threads {
                    thread.renewal.pass(ports.domain.clone());
                }
                drop(socket.take());
                socket = control_socket(domain_config, &operator.plan().robot, &ask);
            }
            Some(Err(error)) if !has_failed => {
                has_failed = true;
                tracing::error!("{error:#}; trying again");
            }
            Some(Err(_)) => {}
            None => (is_damaged, has_failed) = (false, false),
        }
        operator.look(&mut threads, now);
        if threads.iter().any(BusThread::is_lost) {
            break "a bus thread has ended unexpectedly";
        }
        if threads.iter().all(BusThread::has_ended) {
            break "all logs have ended";
        }
        if watchdog.is_some() && !threads.iter().any(|t| t.is_stuck(now)) {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
    };
    tracing::info!(why, "stopping");
    // As long as the health's writer is there, no other gateway of this robot can have made one.
    drop(socket);
    let _ = sd_notify::notify(&[NotifyState::Stopping]);
    let panicked = join(&mut threads, &stop);
    fill_health(&mut health, &statuses(&threads), &observer.newest());
    let _ = ports.health.send(&health, clock.now());
    match panicked {
        None => Ok(()),
        Some(bus) => bail!("the thread of bus {bus:?} panicked: this is a bug in the program"),
    }
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
