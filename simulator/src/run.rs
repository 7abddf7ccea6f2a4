//! Runs the simulated robot live (`proprio simulate`): its boards on CAN interfaces or virtual
//! buses, one thread per bus.

use crate::record::write_truth;
use crate::robot::SimulatedRobot;
use crate::settings::SimulationSettings;
use crate::simulator::{BusCounts, BusSimulator, Simulator};
use crate::truth::{PlannedPush, Simulation, TouchEvent};
use anyhow::Context as _;
use proprio_gateway::clock::{Clock, Monotonic};
use proprio_gateway::config::FrameSource;
use proprio_gateway::daemon::open_link;
use proprio_gateway::link::adapter::Adapter;
use proprio_gateway::link::{Link, LinkCounters, Received, send_by};
use proprio_topics::Nanos;
use serde::Serialize;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::thread;
use std::time::Duration;

/// Period of the rows of the truth: one millisecond.
pub(crate) const TRUTH_PERIOD: Nanos = Nanos::from_millis(1);

/// Maximum wait of a bus thread before it checks whether to stop.
const MOST_WAIT: Nanos = Nanos::from_millis(20);
/// Maximum number of frames sent before the thread receives again. If sending takes longer than the
/// boards' periods, a frame is always due; without this limit no command and no stop request would
/// be received.
const MOST_AT_ONCE: usize = 16;
/// How far ahead the skin declares a touch.
const AHEAD: Nanos = Nanos::from_millis(100);
/// Maximum wait of a frame for a full queue.
const SEND_WITHIN: Nanos = Nanos::from_millis(20);

/// The options of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunOptions {
    /// The buses, in the order of gateway.toml: `can0` or `virtual:NAME` ([`parse_bus`]). Empty:
    /// the sources that gateway.toml gives.
    pub buses: Vec<FrameSource>,
    /// The domain of virtual buses: the gateway's.
    pub domain: String,
    /// Duration; `None`: until it is stopped.
    pub seconds: Option<f64>,
    /// The settings of the simulation. The hand is pushed once in `seconds` if given, else once in
    /// every `settings.cycle`.
    pub settings: SimulationSettings,
    /// The file for the truth, written at the end.
    pub truth: Option<PathBuf>,
}

/// Invalid options: exit code 2.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RunOptionsError {
    /// A bus that is neither an interface nor a virtual bus.
    #[error(
        "bus {0:?}: it must be a CAN interface such as \"can0\", or a virtual bus such as \
         \"virtual:left_arm\""
    )]
    Bus(String),
    /// A wrong number of buses.
    #[error(
        "{given} buses are given; the robot has {}: {}; give one for each, in this order, or none",
        names.len(), names.join(", ")
    )]
    BusCount {
        /// The number given.
        given: usize,
        /// The names of the robot's buses.
        names: Vec<String>,
    },
    /// The same bus is given twice.
    #[error("two buses of the robot have the same source; each needs a different one")]
    SameBus,
    /// The bus is a log, on which nothing can be sent.
    #[error("bus {0:?} is a replayed log; give --bus with an interface or a virtual bus")]
    Replay(String),
    /// The duration is not positive.
    #[error("seconds = {0} must be above 0")]
    Seconds(f64),
}

/// Reads `can0` or `virtual:NAME`.
///
/// # Errors
/// [`RunOptionsError::Bus`].
pub fn parse_bus(text: &str) -> Result<FrameSource, RunOptionsError> {
    match text.split_once(':') {
        Some(("virtual", name)) if !name.is_empty() => Ok(FrameSource::Virtual {
            name: name.to_owned(),
        }),
        None if !text.is_empty() && text.len() <= 15 && text != "virtual" => {
            Ok(FrameSource::SocketCan(Adapter::Interface(text.to_owned())))
        }
        _ => Err(RunOptionsError::Bus(text.to_owned())),
    }
}

/// The result of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunSummary {
    /// The robot's name.
    pub robot: String,
    /// The seed.
    pub seed: u64,
    /// Start of the simulation: CLOCK_MONOTONIC \[ns\].
    pub t0: i64,
    /// Duration \[s\].
    pub seconds: f64,
    /// Total of frames that reached a bus.
    pub sent: u64,
    /// Total of frames lost by a `lost` fault; not counted as sent.
    pub lost_on_request: u64,
    /// The buses, in the order of gateway.toml.
    pub buses: Vec<BusSummary>,
    /// Rows of truth written.
    pub truth_rows: u64,
}

/// The result of one bus.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BusSummary {
    /// Its name.
    pub name: String,
    /// Its source, in the form of [`parse_bus`].
    pub source: String,
    /// Frames that reached the bus.
    pub sent: u64,
    /// Frames that could not be sent: the interface was down, or its queue full.
    pub send_failures: u64,
    /// Frames received: commands to the boards.
    pub received: u64,
    /// Frames lost by a `lost` fault.
    pub lost_on_request: u64,
    /// Readings skipped because this machine was too slow.
    pub skipped: u64,
    /// Readings that a board could not encode.
    pub refused: u64,
    /// The largest delay of an emission \[s\].
    pub latest: f64,
}

/// Runs `robot` for `options.seconds` or until `stop` is set.
///
/// # Errors
/// An error chain with cause, place and remedy. [`RunOptionsError`] and [`crate::SimulatorError`]
/// at its root are wrong configurations; other causes are a bus that cannot be opened or a file
/// that cannot be written.
pub fn run(
    robot: &SimulatedRobot,
    options: &RunOptions,
    stop: &AtomicBool,
) -> anyhow::Result<RunSummary> {
    run_with_skin(robot, options, None, stop)
}

/// A receiver of touches, as from a skin: the contact's name, the instant of the change, and
/// whether it is touched from then on.
pub type TouchListener<'a> = &'a mut dyn FnMut(&str, Nanos, bool);

/// As [`run`]; also calls `skin` for every touch, in this thread, 0.1 s ahead.
///
/// # Errors
/// As [`run`].
pub fn run_with_skin(
    robot: &SimulatedRobot,
    options: &RunOptions,
    skin: Option<TouchListener<'_>>,
    stop: &AtomicBool,
) -> anyhow::Result<RunSummary> {
    let buses = sources(robot, options)?;
    let mut settings = options.settings.clone();
    if let Some(seconds) = options.seconds {
        settings.cycle = seconds;
    }
    // All errors are found before anything is sent.
    let mut simulation = Simulation::new(robot, &settings).map_err(crate::SimulatorError::from)?;
    let truth = match options.truth.as_deref() {
        Some(path) => Some((path, create(path)?)),
        None => None,
    };
    let links = open_links(robot, options, &buses)?;
    let clock = Monotonic;
    let t0 = clock.now();
    let end = options
        .seconds
        .map_or(Nanos::MAX, |s| t0 + Nanos::from_seconds(s));
    let simulator = Simulator::new(robot, &settings, t0)?;
    tracing::info!(
        robot = robot.plan.robot,
        seed = settings.seed,
        buses = buses.len(),
        "the simulated robot is powered on"
    );
    if let Some(push) = simulation.push() {
        let (is_once, is_declared) = (options.seconds.is_some(), skin.is_some());
        tracing::info!("{}", push_text(robot, &push, is_once, is_declared));
    }
    let runs = thread::scope(|scope| {
        let threads: Vec<_> = simulator
            .into_buses()
            .into_iter()
            .zip(links)
            .map(|(bus, link)| {
                let name: String = format!("board {}", bus.name()).chars().take(15).collect();
                thread::Builder::new()
                    .name(name)
                    .spawn_scoped(scope, move || turn_until(bus, link, &clock, end, stop))
            })
            .collect();
        if let (Some(skin), true) = (skin, threads.iter().all(Result::is_ok)) {
            feel(&simulation, t0, skin, &clock, end, stop);
        }
        let runs = threads.into_iter().map(|thread| {
            let thread = thread
                .context("cannot start a thread")
                .inspect_err(|_| stop.store(true, Relaxed))?;
            thread
                .join()
                .map_err(|_| anyhow::anyhow!("a bus thread panicked: this is a bug in the program"))
        });
        runs.collect::<anyhow::Result<Vec<BusRun>>>()
    })?;
    let ended = clock.now().min(end);
    let truth_rows = match truth {
        None => 0,
        Some((path, file)) => write_truth(&mut simulation, t0, ended, TRUTH_PERIOD, file)
            .with_context(|| format!("cannot write {}", path.display()))?,
    };
    let named = robot.plan.buses.iter().zip(&buses).zip(runs);
    let buses: Vec<BusSummary> = named
        .map(|((plan, source), run)| run.summary(&plan.name, source))
        .collect();
    Ok(RunSummary {
        robot: robot.plan.robot.clone(),
        seed: settings.seed,
        t0: t0.0,
        seconds: (ended - t0).seconds(),
        sent: buses.iter().map(|b| b.sent).sum(),
        lost_on_request: buses.iter().map(|b| b.lost_on_request).sum(),
        buses,
        truth_rows,
    })
}

/// Opens the robot's buses on these sources.
fn open_links(
    robot: &SimulatedRobot,
    options: &RunOptions,
    sources: &[FrameSource],
) -> anyhow::Result<Vec<Box<dyn Link>>> {
    let links = robot.plan.buses.iter().zip(sources).map(|(plan, source)| {
        let mut plan = plan.clone();
        plan.source = source.clone();
        // No claims: boards receive all frames, as on a real bus.
        let link = open_link(&plan, &options.domain, &[]);
        link.with_context(|| format!("bus {:?} ({})", plan.name, source_text(source)))
    });
    links.collect()
}

/// What happened on one bus.
struct BusRun {
    boards: BusCounts,
    link: LinkCounters,
    /// Frames that could not be sent.
    send_failures: u64,
}

impl BusRun {
    fn summary(&self, name: &str, source: &FrameSource) -> BusSummary {
        BusSummary {
            name: name.to_owned(),
            source: source_text(source),
            sent: self.link.sent,
            send_failures: self.send_failures,
            received: self.link.received,
            lost_on_request: self.boards.lost_on_request,
            skipped: self.boards.skipped,
            refused: self.boards.refused,
            latest: self.boards.latest.seconds(),
        }
    }
}

/// What is pushed, when and how hard, for a person who wonders what the sensors read.
fn push_text(
    robot: &SimulatedRobot,
    push: &PlannedPush,
    is_once: bool,
    is_declared: bool,
) -> String {
    let contact = robot.config.contact.get(push.contact);
    let (name, link) = contact.map_or(("", ""), |c| (c.name(), c.link.as_str()));
    let every = if is_once {
        String::new()
    } else {
        format!(" of every {} s", rounded(push.cycle))
    };
    let declared = if is_declared {
        "it is declared, as by a skin"
    } else {
        "nobody declares it (--skin does)"
    };
    format!(
        "link {link} is pushed at contact {name} with up to {} N and {} Nm, from {} s to {} \
         s{every}; {declared}; --no-push leaves it out",
        rounded(push.force),
        rounded(push.torque),
        rounded(push.from),
        rounded(push.until)
    )
}

/// A number for a text, to a hundredth.
fn rounded(number: f64) -> f64 {
    (100.0 * number).round() / 100.0
}

/// The loop of one bus: send the frames that are due, then wait for a frame or for the next due
/// time.
fn turn_until(
    mut bus: BusSimulator,
    mut link: Box<dyn Link>,
    clock: &impl Clock,
    end: Nanos,
    stop: &AtomicBool,
) -> BusRun {
    let mut send_failures = 0;
    loop {
        let now = clock.now();
        if now >= end || stop.load(Relaxed) {
            break;
        }
        for _ in 0..MOST_AT_ONCE {
            let Some(frame) = bus.poll(clock.now()) else {
                break;
            };
            let sent = send_by(&mut *link, &frame, clock.now() + SEND_WITHIN);
            send_failures += u64::from(sent.is_err());
        }
        let deadline = (clock.now() + MOST_WAIT)
            .min(end)
            .min(bus.next_wake().unwrap_or(Nanos::MAX));
        match link.recv(deadline) {
            Received::Frame(frame) => bus.on_frame(&frame, clock.now()),
            Received::Error(_) | Received::TimedOut | Received::StateChanged => {}
            Received::Ended => break,
        }
    }
    BusRun {
        boards: bus.counts(),
        link: link.counters(),
        send_failures,
    }
}

/// The loop of the skin, until no more touch follows.
fn feel(
    simulation: &Simulation,
    t0: Nanos,
    skin: TouchListener<'_>,
    clock: &impl Clock,
    end: Nanos,
    stop: &AtomicBool,
) {
    let mut next = simulation.next_touch(0.0);
    while let Some(TouchEvent { t, contact, begins }) = next {
        let at = t0 + Nanos::from_seconds(t);
        if at >= end {
            break;
        }
        while clock.now() < at - AHEAD {
            if stop.load(Relaxed) {
                return;
            }
            let wait = (at - AHEAD - clock.now()).clamp(Nanos::ZERO, MOST_WAIT);
            thread::sleep(Duration::from_nanos(wait.0.unsigned_abs()));
        }
        skin(
            simulation.contact_names().nth(contact).unwrap_or_default(),
            at,
            begins,
        );
        next = simulation.next_touch(t);
    }
}

fn sources(
    robot: &SimulatedRobot,
    options: &RunOptions,
) -> Result<Vec<FrameSource>, RunOptionsError> {
    if let Some(seconds) = options.seconds
        && !(seconds > 0.0 && seconds.is_finite())
    {
        return Err(RunOptionsError::Seconds(seconds));
    }
    let plans = &robot.plan.buses;
    let sources: Vec<FrameSource> = plans.iter().map(|b| b.source.clone()).collect();
    let sources = if options.buses.is_empty() {
        sources
    } else {
        options.buses.clone()
    };
    if sources.len() != plans.len() {
        let names = plans.iter().map(|b| b.name.clone()).collect();
        return Err(RunOptionsError::BusCount {
            given: sources.len(),
            names,
        });
    }
    for (number, (source, plan)) in sources.iter().zip(plans).enumerate() {
        if matches!(source, FrameSource::Replay { .. }) {
            return Err(RunOptionsError::Replay(plan.name.clone()));
        }
        if sources.iter().take(number).any(|other| other == source) {
            return Err(RunOptionsError::SameBus);
        }
    }
    Ok(sources)
}

fn source_text(source: &FrameSource) -> String {
    match source {
        FrameSource::SocketCan(adapter) => adapter.to_string(),
        FrameSource::Virtual { name } => format!("virtual:{name}"),
        FrameSource::Replay { log, .. } => log.display().to_string(),
    }
}

fn create(path: &Path) -> anyhow::Result<BufWriter<File>> {
    let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(BufWriter::new(file))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_drivers::Frame;
    use proprio_gateway::devices::BusDevices;
    use proprio_gateway::link::TransmitError;
    use proprio_gateway::status::BusStatus;
    use proprio_topics::{Counter, LinkState};
    use std::collections::VecDeque;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicI64, AtomicU64};

    /// A clock that only a slow link advances.
    #[derive(Clone, Default)]
    struct Slow(Arc<AtomicI64>);

    impl Clock for Slow {
        fn now(&self) -> Nanos {
            Nanos(self.0.load(Relaxed))
        }
    }

    /// A bus on which a frame takes longer than all boards' periods, with a gateway's devices at
    /// its other end.
    struct SlowLink {
        clock: Slow,
        gateway: BusDevices,
        commands: VecDeque<(u16, Frame)>,
        sent: Arc<AtomicU64>,
        stop: Arc<AtomicBool>,
    }

    impl Link for SlowLink {
        fn recv(&mut self, deadline: Nanos) -> Received {
            let now = self.clock.now();
            let commands = &mut self.commands;
            self.gateway
                .poll_transmit(now, |device, t| commands.push_back((device, t.frame)));
            match self.commands.pop_front() {
                Some((device, command)) => {
                    self.gateway.on_sent(device, &command, Ok(now));
                    Received::Frame(command)
                }
                None => {
                    self.clock.0.fetch_max(deadline.0, Relaxed);
                    Received::TimedOut
                }
            }
        }

        fn send(&mut self, frame: &Frame) -> Result<(), TransmitError> {
            let now = Nanos(self.clock.0.fetch_add(10_000_000, Relaxed));
            self.gateway
                .on_frame(&frame.at(now, proprio_topics::StampKind::Software), |_| {});
            let sent = self.sent.fetch_add(1, Relaxed);
            self.stop.store(sent >= 3000, Relaxed);
            assert!(sent < 3100, "it does not hear that it should stop");
            Ok(())
        }

        fn state(&self) -> LinkState {
            LinkState::Up
        }

        fn counters(&self) -> LinkCounters {
            LinkCounters::default()
        }
    }

    #[test]
    fn an_overloaded_bus_is_still_listened_to() {
        let robot = SimulatedRobot::open("icub_left_arm").unwrap();
        let settings = SimulationSettings::default();
        let clock = Slow::default();
        let simulator = Simulator::new(&robot, &settings, clock.now()).unwrap();
        for (bus, (plan, number)) in simulator
            .into_buses()
            .into_iter()
            .zip(robot.plan.buses.iter().zip(0..))
        {
            let status = Arc::new(BusStatus::new(number, plan));
            let (sent, stop) = (
                Arc::new(AtomicU64::new(0)),
                Arc::new(AtomicBool::new(false)),
            );
            let link = SlowLink {
                clock: clock.clone(),
                gateway: BusDevices::new(number, plan, None, Arc::clone(&status)).unwrap(),
                commands: VecDeque::new(),
                sent: Arc::clone(&sent),
                stop: Arc::clone(&stop),
            };
            turn_until(bus, Box::new(link), &clock, Nanos::MAX, &stop);
            // Every board was started, although others stream already.
            for device in status.devices() {
                assert!(device.counters[Counter::Frames as usize] > 0, "{device:?}");
            }
        }
    }
}
