//! The control plane: opens links and ports, starts one thread per bus, and supervises them until
//! it is stopped.
//!
//! No sample passes through here. Signals are caught before the first port is created, so that a
//! start-up can be stopped cleanly too. Ten times a second this thread sends the health, logs
//! changes of it, and feeds the watchdog as long as every bus thread runs.

use crate::bus::{Bus, Turn};
use crate::clock::{Clock, Monotonic};
use crate::config::{Pace, Source};
use crate::decoder::Decoder;
use crate::health::{HealthLog, fill_health};
use crate::link::interface::{Netlink, Observer};
use crate::link::replay::Replay;
use crate::link::socketcan::SocketCan;
use crate::link::virtual_bus::VirtualBus;
use crate::link::{Link, ListenOnly, OpenError};
use crate::plan::{BusPlan, ConfigError, Plan};
use crate::publish::Shared;
use crate::status::BusStatus;
use anyhow::{Context, anyhow, bail};
use proprio_drivers::{Claim, Mode};
use proprio_topics::ipc::{Domain, DomainConfig, DomainError, Writer, open_files_remedy};
use proprio_topics::realtime;
use proprio_topics::{Description, GatewayHealth, Nanos, Sample};
use sd_notify::NotifyState;
use std::io::Write as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};

/// Period of the health messages.
const HEALTH_PERIOD: Duration = Duration::from_millis(100);
/// Delay from the start to the first frame of a replayed log.
const REPLAY_DELAY: Nanos = Nanos::from_millis(200);
/// A bus thread without a turn for this long is stuck.
const STUCK: Nanos = Nanos::from_millis(500);

/// Runs the gateway until SIGTERM, SIGINT, or the end of its logs.
///
/// # Errors
/// An error chain with cause, place and remedy; its root is a [`ConfigError`] if the configuration
/// is wrong.
pub fn run(config: &Path, domain: &DomainConfig, check: bool) -> anyhow::Result<()> {
    let plan = Plan::load(config)?;
    for bus in &plan.buses {
        if let Source::Replay {
            pace: Pace::Fast, ..
        } = bus.source
        {
            let problem = format!(
                "bus {:?}: pace = \"fast\" is for offline use (proprio decode); a daemon replays \
                 with pace = \"recorded\"",
                bus.name
            );
            return Err(ConfigError {
                file: config.to_owned(),
                problem,
            }
            .into());
        }
    }
    if check {
        // The reader of standard output may close it early.
        let _ = write!(std::io::stdout(), "{plan}");
        return Ok(());
    }
    let served = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start")
        .and_then(|runtime| runtime.block_on(serve(&plan, domain)));
    served.map_err(|error| match open_files_remedy(&format!("{error:#}")) {
        Some(remedy) => error.context(remedy),
        None => error,
    })
}

/// Whether an error of [`run`] is a wrong configuration (exit code 2, otherwise 1).
pub fn is_configuration(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.is::<ConfigError>()
            || cause
                .downcast_ref()
                .is_some_and(DomainError::is_configuration)
    })
}

async fn serve(plan: &Plan, domain_config: &DomainConfig) -> anyhow::Result<()> {
    let mut terminate = signal(SignalKind::terminate()).context("cannot catch SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot catch SIGINT")?;
    let clock = Monotonic;
    let started = clock.now();
    let domain = Domain::open(domain_config)?;
    let epoch = domain.epoch();
    // Health first: it admits one writer, so this fails if the robot already has a gateway.
    let mut health_writer = Writer::<GatewayHealth>::create(&domain, &plan.robot, epoch)?;
    let mut description_writer = Writer::<Description>::create(&domain, &plan.robot, epoch)?;
    description_writer.send(&plan.description(), clock.now())?;

    let stop = Arc::new(AtomicBool::new(false));
    // A common start keeps the buses of one log in step; by then all of them are open.
    let replay_start = clock.now() + REPLAY_DELAY;
    let mut threads = Vec::new();
    let mut failure = None;
    for (bus, number) in plan.buses.iter().zip(0_u32..) {
        match BusThread::start(plan, bus, number, &domain, epoch, &stop, replay_start) {
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
        Source::SocketCan { interface } => Some(interface.clone()),
        Source::Virtual { .. } | Source::Replay { .. } => None,
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
    tracing::info!(
        robot = plan.robot,
        buses = plan.buses.len(),
        channels = plan.channels.len(),
        "running"
    );
    let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("running")]);
    let watchdog = sd_notify::watchdog_enabled();

    let mut health = Box::new(GatewayHealth::new(started));
    let mut health_log = HealthLog::default();
    let mut ticks = tokio::time::interval(HEALTH_PERIOD);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let why = loop {
        tokio::select! {
            _ = terminate.recv() => break "SIGTERM",
            _ = interrupt.recv() => break "SIGINT",
            _ = ticks.tick() => {}
        }
        let now = clock.now();
        let statuses = statuses(&threads);
        fill_health(&mut health, &statuses, &observer.newest());
        health_log.log_changes(&health, &statuses);
        // A reader that cannot be reached now is no reason to stop; the next health follows in 0.1
        // s.
        let _ = health_writer.send(&health, now);
        let _ = description_writer.update_connections();
        if threads
            .iter()
            .any(|t| t.thread.is_finished() && !t.ended.load(Acquire))
        {
            break "a bus thread has ended unexpectedly";
        }
        if threads.iter().all(|t| t.ended.load(Acquire)) {
            break "all logs have ended";
        }
        let stuck = threads.iter().any(|t| {
            !t.ended.load(Relaxed) && now - Nanos(t.status.last_turn.load(Relaxed)) > STUCK
        });
        if watchdog.is_some() && !stuck {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
    };
    tracing::info!(why, "stopping");
    let _ = sd_notify::notify(&[NotifyState::Stopping]);
    let panicked = join(&mut threads, &stop);
    fill_health(&mut health, &statuses(&threads), &observer.newest());
    let _ = health_writer.send(&health, clock.now());
    match panicked {
        None => Ok(()),
        Some(bus) => bail!("the thread of bus {bus:?} panicked: this is a bug in the program"),
    }
}

fn statuses(threads: &[BusThread]) -> Vec<&BusStatus> {
    threads.iter().map(|t| &*t.status).collect()
}

/// Stops all bus threads and waits for them; returns the name of the first that panicked.
fn join(threads: &mut [BusThread], stop: &AtomicBool) -> Option<String> {
    stop.store(true, Release);
    let mut panicked = None;
    for bus in threads {
        if let Some(thread) = bus.take()
            && thread.join().is_err()
        {
            panicked.get_or_insert_with(|| bus.name.clone());
        }
    }
    panicked
}

/// The control plane's handle of a bus thread.
struct BusThread {
    name: String,
    status: Arc<BusStatus>,
    ended: Arc<AtomicBool>,
    thread: Finished,
}

/// A thread that can be joined once.
struct Finished(Option<JoinHandle<()>>);

impl Finished {
    fn is_finished(&self) -> bool {
        self.0.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl BusThread {
    fn take(&mut self) -> Option<JoinHandle<()>> {
        self.thread.0.take()
    }

    /// Opens link and port and starts the loop; returns once it runs.
    fn start(
        plan: &Plan,
        bus: &BusPlan,
        number: u32,
        domain: &Domain,
        epoch: u64,
        stop: &Arc<AtomicBool>,
        replay_start: Nanos,
    ) -> anyhow::Result<Self> {
        let status = Arc::new(BusStatus::new(number, bus));
        // A log is not interactive: its boards answered the program that commanded them during the
        // recording.
        let listens = bus.listen_only || matches!(bus.source, Source::Replay { .. });
        let mode = listens.then_some(Mode::Listen);
        let decoder = Decoder::new(number, bus, mode, Arc::clone(&status))?;
        let mut link: Box<dyn Link> = if let Source::Replay { log, pace } = &bus.source {
            let mut replay = Replay::open(
                log,
                *pace,
                plan.matching(number as usize),
                &decoder.claims(),
            )?;
            replay.start_at(replay_start);
            Box::new(replay)
        } else {
            open_link(bus, &domain.config().name, &decoder.claims())?
        };
        if bus.listen_only {
            link = Box::new(ListenOnly(link));
        }
        let ended = Arc::new(AtomicBool::new(false));
        let (ready, is_ready) = mpsc::channel();
        let (domain, robot, realtime) = (domain.clone(), plan.robot.clone(), bus.realtime);
        let (stop, ended_there, status_there) =
            (Arc::clone(stop), Arc::clone(&ended), Arc::clone(&status));
        let body = move || {
            // A port belongs to the thread that creates it.
            let writer = match Writer::<Sample>::create(&domain, &robot, epoch) {
                Ok(writer) => writer,
                Err(error) => return drop(ready.send(Err(error))),
            };
            let refused = realtime
                .map(|r| realtime::apply(r.cpu, r.priority))
                .unwrap_or_default();
            let _ = ready.send(Ok(refused));
            let clock = Monotonic;
            let mut bus = Bus::new(link, decoder, Shared(writer), status_there);
            while !stop.load(Acquire) {
                if bus.turn(&clock) == Turn::Ended {
                    if let Some(note) = bus.link_note() {
                        tracing::warn!("{note}");
                    }
                    ended_there.store(true, Release);
                    // Readers may still read the last samples: keep the port until the gateway
                    // stops.
                    while !stop.load(Acquire) {
                        std::thread::sleep(Duration::from_millis(20));
                    }
                }
            }
            ended_there.store(true, Release);
            bus.stop(&clock);
        };
        let name: String = format!("bus {}", bus.name).chars().take(15).collect();
        let thread = std::thread::Builder::new()
            .name(name)
            .spawn(body)
            .context("cannot start a thread")?;
        let refused = is_ready
            .recv()
            .map_err(|_| anyhow!("its thread ended at once"))??;
        for refusal in refused {
            tracing::warn!(
                bus = bus.name,
                "real-time scheduling not granted: {refusal}"
            );
        }
        Ok(Self {
            name: bus.name.clone(),
            status,
            ended,
            thread: Finished(Some(thread)),
        })
    }
}

/// Opens the link of `bus`; from a log it takes every frame.
///
/// # Errors
/// [`OpenError`], with the remedy in its message.
pub fn open_link(
    bus: &BusPlan,
    domain: &str,
    claims: &[Claim],
) -> Result<Box<dyn Link>, OpenError> {
    Ok(match &bus.source {
        Source::SocketCan { interface } => Box::new(SocketCan::open(interface, claims)?),
        Source::Virtual { name } => Box::new(VirtualBus::open(domain, name, claims)?),
        Source::Replay { log, pace } => Box::new(Replay::open(log, *pace, None, claims)?),
    })
}

/// Sends log lines to standard error; RUST_LOG selects the level, `info` by default.
pub fn start_logging() {
    use std::io::IsTerminal as _;
    // neli logs every byte that it sends or receives.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info,neli=warn"));
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .try_init();
}
