//! The thread of a bus: opens link and port, runs the loop, and ends when it is told to.

use crate::bus::{Bus, Turn};
use crate::clock::Monotonic;
use crate::config::FrameSource;
use crate::devices::BusDevices;
use crate::inbox::{Inbox, Requests, inbox};
use crate::link::adapter::{self, Adapter};
use crate::link::interface::{Interfaces, Netlink};
use crate::link::replay::Replay;
use crate::link::socketcan::SocketCan;
use crate::link::virtual_bus::VirtualBus;
use crate::link::{Link, ListenOnly, OpenError};
use crate::plan::{BusPlan, Plan};
use crate::publish::SharedMemory;
use crate::status::BusStatus;
use anyhow::{Context, anyhow};
use proprio_drivers::{Claim, Mode};
use proprio_topics::ipc::{Domain, Renewal, Writer};
use proprio_topics::realtime;
use proprio_topics::{Nanos, Sample};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;

/// A bus thread without a turn for this long is stuck.
const STUCK: Nanos = Nanos::from_millis(500);

/// The counters of all buses.
pub(crate) fn statuses(threads: &[BusThread]) -> Vec<&BusStatus> {
    threads.iter().map(|t| &*t.status).collect()
}

/// Stops all bus threads and waits for them; returns the name of the first that panicked.
pub(crate) fn join(threads: &mut [BusThread], stop: &AtomicBool) -> Option<String> {
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
pub(crate) struct BusThread {
    name: String,
    pub(crate) status: Arc<BusStatus>,
    ended: Arc<AtomicBool>,
    /// The way into its inbox.
    pub(crate) requests: Requests,
    /// The way to a new domain.
    pub(crate) renewal: Arc<Renewal>,
    /// What tells other gateways that this one commands boards on the interface.
    _interface_lock: Option<UnixDatagram>,
    /// The mode that overrides the devices' own.
    pub(crate) mode: Option<Mode>,
    thread: JoinOnce,
}

/// A thread that can be joined once.
struct JoinOnce(Option<JoinHandle<()>>);

impl JoinOnce {
    fn is_finished(&self) -> bool {
        self.0.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl BusThread {
    /// Whether its log has ended, or it was stopped.
    pub(crate) fn has_ended(&self) -> bool {
        self.ended.load(Acquire)
    }

    /// Whether it has ended without having been asked to.
    pub(crate) fn is_lost(&self) -> bool {
        self.thread.is_finished() && !self.has_ended()
    }

    /// Whether it has made no turn for [`STUCK`] at `now`.
    pub(crate) fn is_stuck(&self, now: Nanos) -> bool {
        !self.has_ended() && now - Nanos(self.status.last_turn.load(Relaxed)) > STUCK
    }

    fn take(&mut self) -> Option<JoinHandle<()>> {
        self.thread.0.take()
    }

    /// Opens link and port and starts the loop; returns once it runs.
    pub(crate) fn start(
        plan: &Plan,
        bus: &BusPlan,
        number: u32,
        domain: &Domain,
        stop: &Arc<AtomicBool>,
        replay_start: Nanos,
    ) -> anyhow::Result<Self> {
        let status = Arc::new(BusStatus::new(number, bus));
        // A log is not interactive: its boards answered the program that commanded them during the
        // recording.
        let listens = bus.listen_only || matches!(bus.source, FrameSource::Replay { .. });
        let mode = listens.then_some(Mode::Listen);
        let devices = BusDevices::new(number, bus, mode, Arc::clone(&status))?;
        let (name, claims) = (&domain.config().name, devices.claims());
        let link = open_own(plan, bus, number, name, &claims, replay_start)?;
        let interface_lock = match &bus.source {
            FrameSource::SocketCan(adapter) if !listens => lock_interface(adapter),
            _ => None,
        };
        let (requests, inbox) = inbox(bus.devices.len());
        let (ended, renewal) = (Arc::default(), Arc::default());
        let work = BusLoop {
            link,
            devices,
            inbox,
            status: Arc::clone(&status),
            renewal: Arc::clone(&renewal),
            stop: Arc::clone(stop),
            ended: Arc::clone(&ended),
        };
        let (domain, robot, realtime) = (domain.clone(), plan.robot.clone(), bus.realtime);
        let (ready, is_ready) = mpsc::channel();
        let body = move || {
            // A port belongs to the thread that creates it.
            let writer = match Writer::<Sample>::create(&domain, &robot, domain.epoch()) {
                Ok(writer) => writer,
                Err(error) => return drop(ready.send(Err(error))),
            };
            // The memory of a domain that is given up is freed when nobody has it any more.
            drop(domain);
            let refused = realtime.map(|r| realtime::apply(r.cpu, r.priority));
            let _ = ready.send(Ok(refused.unwrap_or_default()));
            work.run(writer, &robot);
        };
        let name: String = format!("bus {}", bus.name).chars().take(15).collect();
        let thread = std::thread::Builder::new()
            .name(name)
            .stack_size(realtime::SMALL_STACK)
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
            requests,
            renewal,
            _interface_lock: interface_lock,
            mode,
            thread: JoinOnce(Some(thread)),
        })
    }
}

/// What a bus thread works with.
struct BusLoop {
    link: Box<dyn Link>,
    devices: BusDevices,
    inbox: Inbox,
    status: Arc<BusStatus>,
    renewal: Arc<Renewal>,
    stop: Arc<AtomicBool>,
    ended: Arc<AtomicBool>,
}

impl BusLoop {
    /// Makes turns until it is told to stop, then stops the boards.
    fn run(self, writer: Writer<Sample>, robot: &str) {
        let sink = SharedMemory::new(writer, robot, self.renewal);
        let mut bus = Bus::new(self.link, self.devices, sink, self.status).with_inbox(self.inbox);
        while !self.stop.load(Acquire) {
            if bus.turn(&Monotonic) == Turn::Ended {
                if let Some(note) = bus.link_note() {
                    tracing::warn!("{note}");
                }
                self.ended.store(true, Release);
                // Readers may still read the last samples: keep the port until the gateway stops.
                while !self.stop.load(Acquire) {
                    std::thread::sleep(Duration::from_millis(20));
                }
            }
        }
        self.ended.store(true, Release);
        bus.stop(&Monotonic);
    }
}

/// Claims the interface of `adapter` for a gateway that commands boards, and warns if another one
/// has: when either ends, it stops the boards of both. The claim is the name of an abstract socket.
/// It belongs to the network namespace as the interface does, and ends with its process.
fn lock_interface(adapter: &Adapter) -> Option<UnixDatagram> {
    let interface = adapter.resolve(Path::new(adapter::SYS)).ok()?;
    let name = format!("proprio/commands/{interface}");
    let address = SocketAddr::from_abstract_name(name).ok()?;
    match UnixDatagram::bind_addr(&address) {
        Ok(claim) => Some(claim),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {
            tracing::warn!(
                interface,
                "another gateway commands boards on this interface: whichever ends stops the \
                 boards of both; end one of them, or set listen_only = true for its bus"
            );
            None
        }
        Err(_) => None,
    }
}

/// Opens the link of bus `number`; from a log, which begins at `replay_start`, it takes the frames
/// of this bus.
fn open_own(
    plan: &Plan,
    bus: &BusPlan,
    number: u32,
    domain: &str,
    claims: &[Claim],
    replay_start: Nanos,
) -> Result<Box<dyn Link>, OpenError> {
    let link: Box<dyn Link> = match &bus.source {
        FrameSource::Replay { log, pace, stamps } => {
            let matching = plan.matching(number as usize);
            let mut replay = Replay::open_with(log, *pace, *stamps, matching, claims)?;
            replay.start_at(replay_start);
            Box::new(replay)
        }
        _ => open_link(bus, domain, claims)?,
    };
    Ok(match bus.listen_only {
        true => Box::new(ListenOnly(link)),
        false => link,
    })
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
        FrameSource::SocketCan(named) => {
            let link = SocketCan::open_adapter(named, Path::new(adapter::SYS), claims)?;
            check_fd(bus, link.interface(), &mut Netlink::default())?;
            Box::new(link)
        }
        FrameSource::Virtual { name } => Box::new(VirtualBus::open(domain, name, claims)?),
        FrameSource::Replay { log, pace, stamps } => {
            Box::new(Replay::open_with(log, *pace, *stamps, None, claims)?)
        }
    })
}

/// Refuses an interface without CAN FD for a device that needs it. If the kernel does not tell, the
/// counters of frames that were not sent will.
fn check_fd(bus: &BusPlan, interface: &str, kernel: &mut impl Interfaces) -> Result<(), OpenError> {
    let needs = bus.devices.iter().find(|device| device.options.needs_fd());
    match needs {
        Some(device) if kernel.ask(interface).is_ok_and(|health| health.fd == 0) => {
            Err(OpenError::NoFd {
                interface: interface.to_owned(),
                device: device.name.clone(),
            })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
impl BusThread {
    /// A bus that makes no turn, and its end of the inbox.
    pub(crate) fn still(bus: &BusPlan) -> (Self, Inbox) {
        let (requests, inbox) = inbox(bus.devices.len());
        let this = Self {
            name: bus.name.clone(),
            status: Arc::new(BusStatus::new(0, bus)),
            ended: Arc::default(),
            requests,
            renewal: Arc::default(),
            _interface_lock: None,
            mode: matches!(bus.source, FrameSource::Replay { .. }).then_some(Mode::Listen),
            thread: JoinOnce(None),
        };
        (this, inbox)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clock;
    use nix::errno::Errno;
    use proprio_topics::InterfaceHealth;
    use proprio_topics::ipc::{DomainConfig, Reader};
    use std::fmt::Write as _;

    #[test]
    fn a_log_that_has_ended_is_not_stuck() {
        let text = "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                    source = { kind = \"virtual\", name = \"b\" }\n";
        let plan = Plan::parse(text, Path::new(".")).unwrap();
        let (thread, _inbox) = BusThread::still(&plan.buses[0]);
        let turn = Nanos::from_millis(1000);
        thread.status.last_turn.store(turn.0, Relaxed);
        assert!(!thread.is_stuck(turn + STUCK));
        assert!(thread.is_stuck(turn + STUCK + Nanos(1)));
        thread.ended.store(true, Release);
        assert!(!thread.is_stuck(turn + STUCK + Nanos(1)));
    }

    #[test]
    fn an_interface_is_claimed_by_one_gateway_at_a_time() {
        let adapter = Adapter::Interface(format!("none{}", std::process::id()));
        let other = Adapter::Interface(format!("other{}", std::process::id()));
        let first = lock_interface(&adapter);
        assert!(first.is_some() && lock_interface(&adapter).is_none());
        assert!(lock_interface(&other).is_some());
        drop(first);
        assert!(lock_interface(&adapter).is_some());
    }

    #[test]
    fn a_device_that_needs_fd_is_not_started_without() {
        let plan = |driver: &str| {
            let text = format!(
                "schema = 1\nrobot = \"r\"\n[[bus]]\nname = \"b\"\n\
                 source = {{ kind = \"socketcan\", interface = \"can0\" }}\n\
                 [[bus.device]]\ndriver = \"{driver}\"\nname = \"knee_drive\"\naddress = 4\n\
                 [[bus.device.joint]]\nname = \"knee\"\n"
            );
            Plan::parse(&text, Path::new(".")).unwrap()
        };
        let check = |driver: &str, answer: Result<u32, Errno>| {
            let mut kernel = |_: &str| {
                let health = |fd| InterfaceHealth {
                    fd,
                    ..InterfaceHealth::default()
                };
                answer.map(health)
            };
            check_fd(&plan(driver).buses[0], "can0", &mut kernel)
        };
        let refused = check("moteus", Ok(0)).unwrap_err().to_string();
        assert!(
            refused.contains("can0") && refused.contains("\"knee_drive\""),
            "{refused}"
        );
        assert!(refused.contains("fd on"), "{refused}");
        assert!(check("moteus", Ok(1)).is_ok() && check("icub_motor", Ok(0)).is_ok());
        assert!(check("moteus", Err(Errno::EPERM)).is_ok());
    }

    /// The buses of one log begin at the instant that is common to all, not when each is opened.
    #[test]
    fn the_buses_of_one_log_are_in_step() {
        let folder = tempfile::tempdir().unwrap();
        let log = "(7.0) a 140#0000000000000000\n(7.0) b 140#0000000000000000\n";
        std::fs::write(folder.path().join("both.log"), log).unwrap();
        let mut text = "schema = 1\nrobot = \"r\"\n".to_owned();
        for bus in ["a", "b"] {
            write!(
                text,
                "[[bus]]\nname = \"{bus}\"\nsource = {{ kind = \"replay\", log = \"both.log\" }}\n\
                 [[bus.device]]\ndriver = \"icub_motor\"\nname = \"{bus}_board\"\naddress = 4\n\
                 [[bus.device.joint]]\nname = \"{bus}_joint\"\n"
            )
            .unwrap();
        }
        let plan = Plan::parse(&text, folder.path()).unwrap();
        let domain = Domain::open(&DomainConfig::new(folder.path(), "test")).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let start = Monotonic.now() + Nanos::from_millis(300);
        let mut threads = Vec::new();
        for (bus, number) in plan.buses.iter().zip(0..) {
            let thread = BusThread::start(&plan, bus, number, &domain, &stop, start);
            threads.push(thread.unwrap());
        }
        let mut reader = Reader::<Sample>::open(&domain, "r").unwrap();
        let mut begun = Vec::new();
        let end = start + Nanos::from_millis(20_000);
        while begun.len() < 2 {
            assert!(Monotonic.now() < end, "{begun:?}");
            match reader.try_take().unwrap() {
                Some(sample) => begun.push(sample.header.acquired),
                None => std::thread::sleep(Duration::from_millis(1)),
            }
        }
        assert_eq!(begun, [start; 2]);
        assert_eq!(join(&mut threads, &stop), None);
    }
}
