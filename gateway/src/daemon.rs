//! The control plane: opens links and ports, starts one thread per bus, and looks after them until told to stop.
//!
//! Nothing here is on the way of a sample. Signals are caught before the first port is made, so that even a start-up is
//! ended in order. Ten times a second it sends the health, tells the log what is new in it, and feeds the watchdog as long
//! as every bus thread turns.

use crate::bus::{Bus, Turn};
use crate::clock::{Clock, Monotonic};
use crate::config::{Pace, Source};
use crate::decoder::Decoder;
use crate::link::replay::Replay;
use crate::link::socketcan::SocketCan;
use crate::link::virtual_bus::VirtualBus;
use crate::link::{Link, OpenError};
use crate::plan::{BusPlan, ConfigError, Plan};
use crate::publish::Shared;
use crate::status::BusStatus;
use anyhow::{Context, anyhow, bail};
use proprio_drivers::{Claim, Mode, Refusal, State};
use proprio_topics::ipc::{Domain, DomainConfig, DomainError, Writer};
use proprio_topics::realtime;
use proprio_topics::{
    Counter, Description, DeviceHealth, GatewayHealth, Header, LinkState, MAX_CHANNELS, Nanos, Sample,
};
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

/// How often health is sent.
const HEALTH_PERIOD: Duration = Duration::from_millis(100);
/// How long after the start a replayed log begins.
const REPLAY_DELAY: Nanos = Nanos::from_millis(200);
/// A bus thread that has not turned for so long is stuck.
const STUCK: Nanos = Nanos::from_millis(500);

/// Runs the gateway until SIGTERM, SIGINT, or the end of its logs.
///
/// # Errors
/// One chain that says what, where and what to do; [`ConfigError`] at its root is a wrong configuration.
pub fn run(config: &Path, domain: &DomainConfig, check: bool) -> anyhow::Result<()> {
    let plan = Plan::load(config)?;
    for bus in &plan.buses {
        if let Source::Replay { pace: Pace::Fast, .. } = bus.source {
            let problem = format!(
                "bus {:?}: pace = \"fast\" is for offline use (proprio decode); a daemon replays with pace = \"recorded\"",
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
        // Whoever reads it may stop early.
        let _ = write!(std::io::stdout(), "{plan}");
        return Ok(());
    }
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start")?;
    runtime.block_on(serve(&plan, domain))
}

/// Whether an error that [`run`] ended with is a wrong configuration: exit 2, else 1.
pub fn is_configuration(error: &anyhow::Error) -> bool {
    error
        .chain()
        .any(|cause| cause.is::<ConfigError>() || cause.downcast_ref().is_some_and(DomainError::is_configuration))
}

async fn serve(plan: &Plan, domain_config: &DomainConfig) -> anyhow::Result<()> {
    let mut terminate = signal(SignalKind::terminate()).context("cannot catch SIGTERM")?;
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot catch SIGINT")?;
    let clock = Monotonic;
    let started = clock.now();
    let domain = Domain::open(domain_config)?;
    let epoch = domain.epoch();
    // The health first: it admits one writer, which is how a second gateway of this robot finds out.
    let mut health_writer = Writer::<GatewayHealth>::create(&domain, &plan.robot, epoch)?;
    let mut description_writer = Writer::<Description>::create(&domain, &plan.robot, epoch)?;
    description_writer.send(&plan.description(), clock.now())?;

    let stop = Arc::new(AtomicBool::new(false));
    // The buses of one log stay in step; by then all of them are open.
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
        // Those that have begun must stop their boards and give back their ports.
        join(&mut threads, &stop);
        return Err(error);
    }
    tracing::info!(
        robot = plan.robot,
        buses = plan.buses.len(),
        channels = plan.channels.len(),
        "running"
    );
    let _ = sd_notify::notify(&[NotifyState::Ready, NotifyState::Status("running")]);
    let watchdog = sd_notify::watchdog_enabled();

    let mut health = Box::new(empty_health(started));
    let mut diary = Diary::default();
    let mut ticks = tokio::time::interval(HEALTH_PERIOD);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let why = loop {
        tokio::select! {
            _ = terminate.recv() => break "SIGTERM",
            _ = interrupt.recv() => break "SIGINT",
            _ = ticks.tick() => {}
        }
        let now = clock.now();
        fill_health(&mut health, &threads);
        diary.tell(&health);
        // A reader that can not be reached now is not worth ending for; the next health comes in a tenth of a second.
        let _ = health_writer.send(&health, now);
        let _ = description_writer.update_connections();
        if threads.iter().any(|t| t.thread.is_finished() && !t.ended.load(Acquire)) {
            break "a bus thread has ended unexpectedly";
        }
        if threads.iter().all(|t| t.ended.load(Acquire)) {
            break "the end of all logs";
        }
        let stuck = threads
            .iter()
            .any(|t| !t.ended.load(Relaxed) && now - Nanos(t.status.last_turn.load(Relaxed)) > STUCK);
        if watchdog.is_some() && !stuck {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
    };
    tracing::info!(why, "stopping");
    let _ = sd_notify::notify(&[NotifyState::Stopping]);
    let panicked = join(&mut threads, &stop);
    fill_health(&mut health, &threads);
    let _ = health_writer.send(&health, clock.now());
    match panicked {
        None => Ok(()),
        Some(bus) => bail!("the thread of bus {bus:?} panicked; this is a mistake in the program"),
    }
}

/// Stops all bus threads and waits for them; the name of the first that panicked.
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

/// One bus thread, as the control plane sees it.
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
        // The boards of a log answered whoever commanded them when it was recorded.
        let mode = matches!(bus.source, Source::Replay { .. }).then_some(Mode::Listen);
        let decoder = Decoder::new(number, bus, mode, Arc::clone(&status))?;
        let link: Box<dyn Link> = if let Source::Replay { log, pace } = &bus.source {
            let mut replay = Replay::open(log, *pace, plan.matching(number as usize), &decoder.claims())?;
            replay.start_at(replay_start);
            Box::new(replay)
        } else {
            open_link(bus, &domain.config().name, &decoder.claims())?
        };
        let ended = Arc::new(AtomicBool::new(false));
        let (ready, is_ready) = mpsc::channel();
        let (domain, robot, realtime) = (domain.clone(), plan.robot.clone(), bus.realtime);
        let (stop, ended_there, status_there) = (Arc::clone(stop), Arc::clone(&ended), Arc::clone(&status));
        let body = move || {
            // A port belongs to the thread that makes it.
            let writer = match Writer::<Sample>::create(&domain, &robot, epoch) {
                Ok(writer) => writer,
                Err(error) => return drop(ready.send(Err(error))),
            };
            let refused = realtime.map(|r| realtime::apply(r.cpu, r.priority)).unwrap_or_default();
            let _ = ready.send(Ok(refused));
            let clock = Monotonic;
            let mut bus = Bus::new(link, decoder, Shared(writer), status_there);
            while !stop.load(Acquire) {
                if bus.turn(&clock) == Turn::Ended {
                    if let Some(note) = bus.link_note() {
                        tracing::warn!("{note}");
                    }
                    ended_there.store(true, Release);
                    // Readers may still be reading what was published last: the port stays until the end.
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
        let refused = is_ready.recv().map_err(|_| anyhow!("its thread ended at once"))??;
        for refusal in refused {
            tracing::warn!(bus = bus.name, "real-time scheduling not granted: {refusal}");
        }
        Ok(Self {
            name: bus.name.clone(),
            status,
            ended,
            thread: Finished(Some(thread)),
        })
    }
}

/// Opens the link that `bus` is configured for; of a log it takes every frame.
///
/// # Errors
/// [`OpenError`], which says what to do.
pub fn open_link(bus: &BusPlan, domain: &str, claims: &[Claim]) -> Result<Box<dyn Link>, OpenError> {
    Ok(match &bus.source {
        Source::SocketCan { interface } => Box::new(SocketCan::open(interface, claims)?),
        Source::Virtual { name } => Box::new(VirtualBus::open(domain, name, claims)?),
        Source::Replay { log, pace } => Box::new(Replay::open(log, *pace, None, claims)?),
    })
}

fn empty_health(started: Nanos) -> GatewayHealth {
    let bus = BusStatus::new(
        0,
        &BusPlan {
            name: String::new(),
            source: Source::Virtual { name: String::new() },
            realtime: None,
            devices: vec![],
        },
    )
    .bus();
    let device = DeviceHealth {
        name: proprio_topics::Name::EMPTY,
        counters: [0; Counter::ALL.len()],
        state: 0,
        refusal: 0,
        bus: 0,
        reserved: 0,
    };
    GatewayHealth {
        header: Header::default(),
        started,
        bus_count: 0,
        device_count: 0,
        buses: [bus; proprio_topics::MAX_BUSES],
        devices: [device; MAX_CHANNELS],
    }
}

fn fill_health(health: &mut GatewayHealth, threads: &[BusThread]) {
    (health.bus_count, health.device_count) = (0, 0);
    for (slot, thread) in health.buses.iter_mut().zip(threads) {
        *slot = thread.status.bus();
        health.bus_count += 1;
    }
    for (slot, device) in health
        .devices
        .iter_mut()
        .zip(threads.iter().flat_map(|t| t.status.devices()))
    {
        *slot = device;
        health.device_count += 1;
    }
}

/// Turns health into log lines: the first of a run of trouble, and its end.
#[derive(Default)]
struct Diary {
    last: Option<Box<GatewayHealth>>,
    /// Per device and counter, how many ticks in a row brought more; per bus likewise for drops.
    quiet: Vec<[u32; Counter::ALL.len()]>,
    /// Per bus, for how many more ticks a dropped frame is the same trouble as the last one.
    dropping: Vec<u32>,
}

impl Diary {
    /// Trouble that has rested for so many ticks is new when it comes again.
    const REST: u32 = 50;

    fn tell(&mut self, health: &GatewayHealth) {
        let last = self.last.replace(Box::new(*health));
        self.quiet
            .resize(health.devices().len(), [Self::REST; Counter::ALL.len()]);
        for (i, bus) in health.buses().iter().enumerate() {
            let before = last.as_ref().and_then(|l| l.buses().get(i));
            let was = before.map_or(LinkState::Up, |b| b.link);
            if bus.link != was {
                let name = bus.name.as_str();
                match bus.link {
                    LinkState::Up => tracing::info!(bus = name, "the link is up again"),
                    LinkState::Ended => tracing::info!(bus = name, frames = bus.frames, "the log has come to its end"),
                    state => tracing::error!(bus = name, "the link is {}; waiting for it to come back", state.word()),
                }
            }
            let dropped = bus.dropped - before.map_or(0, |b| b.dropped.min(bus.dropped));
            self.dropping.resize(health.buses().len(), 0);
            let first = self.dropping.get_mut(i).is_none_or(|rest| {
                let first = *rest == 0;
                *rest = if dropped > 0 {
                    Self::REST
                } else {
                    rest.saturating_sub(1)
                };
                first
            });
            if dropped > 0 && first {
                tracing::warn!(
                    bus = bus.name.as_str(),
                    dropped,
                    "the kernel dropped frames: the receive buffer was full"
                );
            }
        }
        for (i, device) in health.devices().iter().enumerate() {
            let before = last.as_ref().and_then(|l| l.devices().get(i));
            let name = device.name.as_str();
            if before.is_none_or(|b| (b.state, b.refusal) != (device.state, device.refusal)) {
                match Refusal::from_code(device.refusal) {
                    Some(refusal) => tracing::error!(device = name, "refused: {refusal}"),
                    None => tracing::info!(device = name, "{}", State::word(device.state)),
                }
            }
            let Some(quiet) = self.quiet.get_mut(i) else { continue };
            for counter in Counter::ALL
                .into_iter()
                .filter(|c| !matches!(c, Counter::Frames | Counter::Readings | Counter::Starts))
            {
                let at = counter as usize;
                let count = device.counters.get(at).copied().unwrap_or(0);
                let new = count - before.and_then(|b| b.counters.get(at).copied()).unwrap_or(0).min(count);
                let Some(rest) = quiet.get_mut(at) else { continue };
                if new == 0 {
                    *rest = (*rest + 1).min(Self::REST);
                } else {
                    if *rest >= Self::REST {
                        tracing::warn!(
                            device = name,
                            total = count,
                            "{}: {new} (further ones are counted in health)",
                            counter.word()
                        );
                    }
                    *rest = 0;
                }
            }
        }
    }
}

/// Sends log lines to standard error; RUST_LOG chooses which, `info` by default.
pub fn start_logging() {
    use std::io::IsTerminal as _;
    // neli tells every byte it sends or receives.
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info,neli=warn"));
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .try_init();
}
