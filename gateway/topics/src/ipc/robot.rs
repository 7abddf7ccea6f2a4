//! The reader for control loops: a robot's torques, contacts and measurements by name, or the
//! reason why one is not available.
//!
//! A cycle ([`RobotReader::update`] and the values read after it) makes no system call, no file
//! operation and no allocation, whether or not a gateway or an estimator is there. A thread of its
//! own opens the services, opens them again when a gateway or estimator was restarted, and knows
//! who is missing. It passes the open ports to the cycle, and takes back those whose writers have
//! changed.

use super::clock::monotonic;
use super::presence::Watch;
use super::{Domain, DomainConfig, Freshness, PortError, Presence, Reader, Topic};
use crate::{
    Code, ContactEstimate, Description, Entry, EstimatorHealth, GatewayHealth, Imu, JointState,
    Kind, MAX_CHANNELS, Name, Nanos, Publisher, Quality, Reading, Reason, Role, Sample,
    TorqueEstimate, Wrench,
};
use core::fmt;
use core::sync::atomic::AtomicBool;
use core::sync::atomic::Ordering::{AcqRel, Acquire, Relaxed, Release};
use iceoryx2::prelude::ipc_threadsafe;
use nix::sys::signal::{SigSet, Signal};
use std::borrow::ToOwned;
use std::boxed::Box;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::string::{String, ToString};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;
use std::vec::Vec;
use std::{format, io};

/// Ports that may be passed between threads.
type Port<T> = Reader<T, ipc_threadsafe::Service>;

/// A value that may be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured<T> {
    /// The value.
    pub value: T,
    /// Its quality flags; none of them makes it unusable.
    pub quality: Quality,
    /// How old it is \[ns\], from its acquisition.
    pub age: Nanos,
}

/// A torque that may be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Torque {
    /// Torque \[Nm\] (force \[N\] for a prismatic joint) by the parent link on the child link,
    /// along the URDF axis.
    pub torque: f64,
    /// Its standard deviation \[Nm\]; NaN where it is not known.
    pub standard_deviation: f64,
    /// How old it is \[ns\].
    pub age: Nanos,
}

/// A contact wrench that may be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contact {
    /// Force \[N\] and torque \[Nm\] by the environment on the link, in the axes and about the
    /// origin of the frame that the estimator's configuration names.
    pub wrench: Wrench,
    /// Standard deviations of force \[N\] and torque \[Nm\]; NaN where not known.
    pub standard_deviation: [f64; 6],
    /// Whether it was not declared, but F/T readings show that it is present.
    pub is_detected: bool,
    /// Where it is taken to act \[m\], in the same axes, from the same origin.
    pub position: [f64; 3],
    /// Whether a declaration or a skin says so; else it is the configured place.
    pub is_located: bool,
    /// How old it is \[ns\].
    pub age: Nanos,
}

/// Why there is no value to use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unavailable {
    /// None has been received since this reader was created, or since its publisher was restarted.
    NeverSeen,
    /// The last one is older than allowed.
    Stale {
        /// How old it is \[ns\].
        age: Nanos,
    },
    /// The publisher's description, with its names, has not been received yet.
    NotDescribed,
    /// The publisher has nothing of that name and kind.
    Unknown,
    /// It is withheld.
    Withheld {
        /// The reason.
        reason: Reason,
        /// The channel that causes it; empty if there is no single one.
        channel: Name,
    },
}

impl fmt::Display for Unavailable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NeverSeen => f.pad("never seen"),
            Self::Stale { age } => write!(f, "stale: {:.3} s old", age.seconds()),
            Self::NotDescribed => f.pad("not described yet"),
            Self::Unknown => f.pad("unknown name"),
            Self::Withheld { reason, channel } if channel.as_str().is_empty() => {
                write!(f, "withheld: {reason}")
            }
            Self::Withheld { reason, channel } => write!(f, "withheld: {reason} ({channel})"),
        }
    }
}

/// A joint's torque. Resolved once, valid as long as the reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TorqueHandle(usize);

/// A contact's wrench. Resolved once, valid as long as the reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ContactHandle(usize);

/// A channel of the gateway. Resolved once, valid as long as the reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChannelHandle(usize);

/// A name that the loop reads, and the number that it has now.
#[derive(Debug)]
struct Wanted {
    publisher: Publisher,
    role: Role,
    kind: Option<Kind>,
    name: String,
    index: Option<usize>,
}

impl Wanted {
    fn resolve(&mut self, description: &Description) {
        self.index = (description.entries().iter())
            .find(|entry| {
                entry.role == self.role
                    && entry.name.as_str() == self.name
                    && self.kind.is_none_or(|kind| entry.kind == kind)
            })
            .and_then(|entry| usize::try_from(entry.index).ok());
    }
}

/// The newest state of one robot.
///
/// It may be created before the robot's gateway and estimator run, and finds them again after a
/// restart in any order. Get the handles once; then, in each cycle, call [`RobotReader::update`]
/// and read the values.
#[derive(Debug)]
pub struct RobotReader {
    attaching: Attaching,
    max_age: Nanos,
    now: Nanos,
    ports: OpenPorts,
    wanted: Vec<Wanted>,
    torques: Box<Option<TorqueEstimate>>,
    contacts: Box<Option<ContactEstimate>>,
    /// By the number of the publisher.
    descriptions: Box<[Option<Description>; 2]>,
    /// The newest main reading of each channel.
    samples: Box<[Option<Sample>; MAX_CHANNELS]>,
}

/// The open ports.
#[derive(Debug, Default)]
struct OpenPorts {
    torques: Option<Port<TorqueEstimate>>,
    contacts: Option<Port<ContactEstimate>>,
    descriptions: Option<Port<Description>>,
    samples: Option<Port<Sample>>,
}

/// A port on its way between the two threads.
#[derive(Debug)]
enum Passed {
    Torques(Port<TorqueEstimate>),
    Contacts(Port<ContactEstimate>),
    Descriptions(Port<Description>),
    Samples(Port<Sample>),
}

impl RobotReader {
    /// A reader of `robot` in the domain `domain`; estimates older than `max_age` are stale, and
    /// measurements older than their channel's maximum silence. Starts the thread that opens the
    /// services.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub fn new(domain: &DomainConfig, robot: &str, max_age: Nanos) -> io::Result<Self> {
        Ok(Self {
            attaching: Attaching::start(domain.clone(), robot.to_owned())?,
            max_age,
            now: Nanos::MIN,
            ports: OpenPorts::default(),
            wanted: Vec::new(),
            torques: Box::new(None),
            contacts: Box::new(None),
            descriptions: Box::new([None; 2]),
            samples: Box::new([None; MAX_CHANNELS]),
        })
    }

    /// The torque of the joint `name`.
    pub fn torque_handle(&mut self, name: &str) -> TorqueHandle {
        TorqueHandle(self.want(Publisher::Estimator, Role::Joint, None, name))
    }

    /// The wrench of the contact `name`.
    pub fn contact_handle(&mut self, name: &str) -> ContactHandle {
        ContactHandle(self.want(Publisher::Estimator, Role::Contact, None, name))
    }

    /// The measurements of the joint or sensor `name`, of kind `kind`.
    pub fn channel_handle(&mut self, kind: Kind, name: &str) -> ChannelHandle {
        ChannelHandle(self.want(Publisher::Gateway, Role::Channel, Some(kind), name))
    }

    fn want(&mut self, publisher: Publisher, role: Role, kind: Option<Kind>, name: &str) -> usize {
        let is_known = |wanted: &Wanted| {
            (wanted.publisher, wanted.role, wanted.kind) == (publisher, role, kind)
                && wanted.name == name
        };
        if let Some(known) = self.wanted.iter().position(is_known) {
            return known;
        }
        let mut wanted = Wanted {
            publisher,
            role,
            kind,
            name: name.to_owned(),
            index: None,
        };
        if let Some(description) = self.described(publisher) {
            wanted.resolve(description);
        }
        self.wanted.push(wanted);
        self.wanted.len() - 1
    }

    /// Takes what has arrived by `now` (CLOCK_MONOTONIC \[ns\], see [`super::monotonic`]).
    pub fn update(&mut self, now: Nanos) {
        self.now = now;
        self.attaching.exchange(&mut self.ports);
        let Self {
            attaching,
            ports,
            wanted,
            torques,
            contacts,
            descriptions,
            samples,
            ..
        } = self;
        let back = &attaching.back;
        take(
            &mut ports.descriptions,
            back,
            Passed::Descriptions,
            |port| {
                while let Ok(Some(description)) = port.try_take() {
                    let Some(publisher) = description.publisher.get() else {
                        continue;
                    };
                    (wanted.iter_mut())
                        .filter(|wanted| wanted.publisher == publisher)
                        .for_each(|wanted| wanted.resolve(&description));
                    if let Some(place) = descriptions.get_mut(publisher as usize) {
                        // Numbers that mean other channels now have no value yet. (A gateway that
                        // has reloaded describes the same ones again.)
                        let name = |of: &Description, number| {
                            let entry = of.find(Role::Channel, number);
                            entry.map(|entry| (entry.name, entry.kind))
                        };
                        let is_same = |number: u32| {
                            place.as_ref().is_some_and(|known| {
                                known.header.epoch == description.header.epoch
                                    && name(known, number) == name(&description, number)
                            })
                        };
                        if publisher == Publisher::Gateway {
                            (samples.iter_mut().zip(0..))
                                .filter(|(_, number)| !is_same(*number))
                                .for_each(|(sample, _)| *sample = None);
                        }
                        *place = Some(description);
                    }
                }
            },
        );
        take(&mut ports.torques, back, Passed::Torques, |port| {
            if let Ok(Some(newest)) = port.latest() {
                **torques = Some(newest);
            }
        });
        take(&mut ports.contacts, back, Passed::Contacts, |port| {
            if let Ok(Some(newest)) = port.latest() {
                **contacts = Some(newest);
            }
        });
        take(&mut ports.samples, back, Passed::Samples, |port| {
            let [gateway, _] = descriptions.as_ref();
            while let Ok(Some(sample)) = port.try_take() {
                let entry = (gateway.as_ref())
                    .filter(|d| d.header.epoch == sample.header.epoch)
                    .and_then(|d| d.find(Role::Channel, sample.channel));
                if entry.is_some_and(|entry| entry.kind == sample.kind)
                    && let Some(place) = samples.get_mut(sample.channel as usize)
                {
                    *place = Some(sample);
                }
            }
        });
    }

    /// Waits until an estimate may have arrived since the last update, at most until `deadline`
    /// (CLOCK_MONOTONIC \[ns\]); returns whether one may have. One system call.
    pub fn wait_for_estimate(&self, deadline: Nanos) -> bool {
        self.attaching.wait(self.ports.torques.as_ref(), deadline)
    }

    /// As [`RobotReader::wait_for_estimate`], for a sample.
    pub fn wait_for_sample(&self, deadline: Nanos) -> bool {
        self.attaching.wait(self.ports.samples.as_ref(), deadline)
    }

    /// The torque of a joint.
    ///
    /// # Errors
    /// [`Unavailable`], the reason why there is none.
    pub fn torque(&self, joint: TorqueHandle) -> Result<Torque, Unavailable> {
        let estimate = self.torques.as_ref().as_ref();
        let age = self.age(estimate.map(|e| e.header.acquired), self.max_age)?;
        let index = self.index(joint.0, estimate.map(|e| e.header.epoch))?;
        let joint = estimate
            .and_then(|e| e.joints().get(index))
            .ok_or(Unavailable::Unknown)?;
        self.usable(joint.valid, joint.reason, joint.cause)?;
        Ok(Torque {
            torque: joint.torque,
            standard_deviation: joint.standard_deviation,
            age,
        })
    }

    /// The wrench of a contact.
    ///
    /// # Errors
    /// [`Unavailable`], the reason why there is none.
    pub fn contact(&self, contact: ContactHandle) -> Result<Contact, Unavailable> {
        let estimate = self.contacts.as_ref().as_ref();
        let age = self.age(estimate.map(|e| e.header.acquired), self.max_age)?;
        let index = self.index(contact.0, estimate.map(|e| e.header.epoch))?;
        let contact = estimate
            .and_then(|e| e.contacts().get(index))
            .ok_or(Unavailable::Unknown)?;
        self.usable(contact.valid, contact.reason, contact.cause)?;
        Ok(Contact {
            wrench: Wrench {
                force: contact.force,
                torque: contact.torque,
            },
            standard_deviation: contact.standard_deviation,
            is_detected: contact.detected == 1,
            position: contact.position,
            is_located: contact.located == 1,
            age,
        })
    }

    /// A joint's state as its device reports it.
    ///
    /// # Errors
    /// [`Unavailable`], the reason why there is none.
    pub fn joint(&self, channel: ChannelHandle) -> Result<Measured<JointState>, Unavailable> {
        self.measured(
            channel,
            Quality::UNTRUSTED_ENCODER,
            |reading| match reading {
                Reading::Joint(value) => Some(value),
                _ => None,
            },
        )
    }

    /// A force/torque sensor's reading.
    ///
    /// # Errors
    /// [`Unavailable`], the reason why there is none.
    pub fn wrench(&self, channel: ChannelHandle) -> Result<Measured<Wrench>, Unavailable> {
        self.measured(channel, Quality::DEVICE_FAULT, |reading| match reading {
            Reading::Wrench(value) => Some(value),
            _ => None,
        })
    }

    /// An inertial measurement unit's reading.
    ///
    /// # Errors
    /// [`Unavailable`], the reason why there is none.
    pub fn imu(&self, channel: ChannelHandle) -> Result<Measured<Imu>, Unavailable> {
        self.measured(channel, Quality::DEVICE_FAULT, |reading| match reading {
            Reading::Imu(value) => Some(value),
            _ => None,
        })
    }

    fn measured<T>(
        &self,
        channel: ChannelHandle,
        faults: Quality,
        of: impl FnOnce(Reading) -> Option<T>,
    ) -> Result<Measured<T>, Unavailable> {
        let gateway = self.described(Publisher::Gateway);
        let number = self.index(channel.0, gateway.map(|d| d.header.epoch))?;
        let sample = self.samples.get(number).and_then(Option::as_ref);
        let entry = u32::try_from(number)
            .ok()
            .and_then(|number| gateway?.find(Role::Channel, number))
            .ok_or(Unavailable::NotDescribed)?;
        let age = self.age(sample.map(|s| s.header.acquired), entry.max_silence)?;
        let sample = sample.ok_or(Unavailable::NeverSeen)?;
        let quality = sample.header.quality;
        match Reason::of_quality(quality, faults) {
            Reason::None => {}
            reason => {
                let channel = entry.name;
                return Err(Unavailable::Withheld { reason, channel });
            }
        }
        Ok(Measured {
            value: sample.reading().and_then(of).ok_or(Unavailable::Unknown)?,
            quality,
            age,
        })
    }

    /// The names of the joints whose torques are estimated, in order of their numbers; empty before
    /// the estimator's description is received.
    pub fn torque_names(&self) -> impl Iterator<Item = &str> {
        let joints = self.entries(Publisher::Estimator, Role::Joint);
        joints.map(|entry| entry.name.as_str())
    }

    /// As [`RobotReader::torque_names`], of the contacts.
    pub fn contact_names(&self) -> impl Iterator<Item = &str> {
        let contacts = self.entries(Publisher::Estimator, Role::Contact);
        contacts.map(|entry| entry.name.as_str())
    }

    /// The kinds and names of the gateway's channels, in order of their numbers; empty before the
    /// gateway's description is received.
    pub fn channel_names(&self) -> impl Iterator<Item = (Kind, &str)> {
        let channels = self.entries(Publisher::Gateway, Role::Channel);
        channels.filter_map(|entry| Some((entry.kind.get()?, entry.name.as_str())))
    }

    fn entries(&self, publisher: Publisher, role: Role) -> impl Iterator<Item = &Entry> {
        let described = self.described(publisher);
        let entries = described.map(Description::entries).unwrap_or_default();
        entries.iter().filter(move |entry| entry.role == role)
    }

    /// The newest torques as they were sent, withheld ones included.
    #[must_use]
    pub fn torques(&self) -> Option<&TorqueEstimate> {
        self.torques.as_ref().as_ref()
    }

    /// The newest contact wrenches and residuals as they were sent.
    #[must_use]
    pub fn contacts(&self) -> Option<&ContactEstimate> {
        self.contacts.as_ref().as_ref()
    }

    /// Who is missing, for a person. Takes a lock for a moment and allocates: not for the cycle.
    #[must_use]
    pub fn who_is_missing(&self) -> Missing {
        self.attaching.missing()
    }

    fn described(&self, publisher: Publisher) -> Option<&Description> {
        self.descriptions.get(publisher as usize)?.as_ref()
    }

    /// The number of a wanted name, in a payload of `epoch`.
    fn index(&self, wanted: usize, epoch: Option<u64>) -> Result<usize, Unavailable> {
        let wanted = self.wanted.get(wanted).ok_or(Unavailable::Unknown)?;
        // After a restart the numbers may mean others.
        self.described(wanted.publisher)
            .filter(|d| epoch.is_none_or(|epoch| epoch == d.header.epoch))
            .ok_or(Unavailable::NotDescribed)?;
        wanted.index.ok_or(Unavailable::Unknown)
    }

    fn age(&self, acquired: Option<Nanos>, max_age: Nanos) -> Result<Nanos, Unavailable> {
        match Freshness::of(acquired, self.now, max_age) {
            Freshness::NeverSeen => Err(Unavailable::NeverSeen),
            Freshness::Stale { age } => Err(Unavailable::Stale { age }),
            Freshness::Fresh { age } => Ok(age),
        }
    }

    fn usable(&self, valid: u32, reason: Code<Reason>, cause: u32) -> Result<(), Unavailable> {
        if valid == 1 {
            return Ok(());
        }
        let channel = self
            .described(Publisher::Estimator)
            .and_then(|d| d.find(Role::Channel, cause))
            .map_or(Name::EMPTY, |entry| entry.name);
        Err(Unavailable::Withheld {
            reason: reason.get().unwrap_or_default(),
            channel,
        })
    }
}

/// Lets `take` read a port to which something has been sent. A port whose writers have changed goes
/// back instead: to read it would connect to them, with file operations.
fn take<T: Topic>(
    port: &mut Option<Port<T>>,
    back: &SyncSender<Passed>,
    pass: fn(Port<T>) -> Passed,
    take: impl FnOnce(&mut Port<T>),
) {
    let Some(open) = port.as_mut().filter(|port| port.has_rung()) else {
        return;
    };
    if open.is_connected() {
        take(open);
    } else if let Some(port) = port.take() {
        // There is room for all ports.
        let _ = back.try_send(pass(port));
    }
}

/// Who is missing.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Missing {
    /// The robot's gateway.
    pub gateway: Presence,
    /// The robot's estimator.
    pub estimator: Presence,
    /// What is wrong besides, and what to do.
    pub problem: Option<String>,
}

impl Missing {
    /// Whether both are running, and nothing else is wrong.
    #[must_use]
    pub fn is_nobody(&self) -> bool {
        (self.gateway, self.estimator) == (Presence::Running, Presence::Running)
            && self.problem.is_none()
    }
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the gateway {}, the estimator {}",
            self.gateway, self.estimator
        )?;
        match &self.problem {
            Some(problem) => write!(f, ": {problem}"),
            None => Ok(()),
        }
    }
}

/// How often the thread looks for what is missing.
const PERIOD: Duration = Duration::from_millis(50);
/// The number of kinds of ports.
const PORTS: usize = 4;

/// The thread that opens ports, as the cycle sees it.
#[derive(Debug)]
struct Attaching {
    shared: Arc<AttachState>,
    arrivals: Receiver<Passed>,
    back: SyncSender<Passed>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct AttachState {
    stop: AtomicBool,
    /// Ports have been opened and wait for the cycle.
    has_arrivals: AtomicBool,
    /// The domain's files are gone: the cycle gives all ports back.
    recall: AtomicBool,
    missing: Mutex<Missing>,
}

impl Attaching {
    fn start(domain: DomainConfig, robot: String) -> io::Result<Self> {
        let shared = Arc::new(AttachState::default());
        // Room for every port twice: a channel allocates when it is made, and never again.
        let (send, arrivals) = sync_channel(2 * PORTS);
        let (back, returned) = sync_channel(2 * PORTS);
        let there = Arc::clone(&shared);
        let thread = thread::Builder::new()
            .name("attach".into())
            .spawn(move || {
                leave_signals_to_others();
                let mut attacher = Attacher {
                    config: domain,
                    robot,
                    shared: there,
                    send,
                    returned,
                    domain: None,
                    passed: [false; PORTS],
                    gateway: Watch::default(),
                    estimator: Watch::default(),
                };
                while !attacher.shared.stop.load(Acquire) {
                    // iceoryx2 may panic in damaged memory, which must not end the thread.
                    let _ = catch_unwind(AssertUnwindSafe(|| attacher.turn(monotonic())));
                    thread::park_timeout(PERIOD);
                }
            })?;
        Ok(Self {
            shared,
            arrivals,
            back,
            thread: Some(thread),
        })
    }

    /// Takes the ports that have been opened, and gives all back if they are recalled.
    fn exchange(&self, ports: &mut OpenPorts) {
        if self.shared.has_arrivals.load(Relaxed) && self.shared.has_arrivals.swap(false, AcqRel) {
            while let Ok(port) = self.arrivals.try_recv() {
                match port {
                    Passed::Torques(port) => ports.torques = Some(port),
                    Passed::Contacts(port) => ports.contacts = Some(port),
                    Passed::Descriptions(port) => ports.descriptions = Some(port),
                    Passed::Samples(port) => ports.samples = Some(port),
                }
            }
        }
        if self.shared.recall.load(Relaxed) {
            let all = [
                ports.torques.take().map(Passed::Torques),
                ports.contacts.take().map(Passed::Contacts),
                ports.descriptions.take().map(Passed::Descriptions),
                ports.samples.take().map(Passed::Samples),
            ];
            for port in all.into_iter().flatten() {
                let _ = self.back.try_send(port);
            }
        }
    }

    /// Waits for a payload of `port`; without a port, until one may have been opened.
    fn wait<T: Topic>(&self, port: Option<&Port<T>>, deadline: Nanos) -> bool {
        if let Some(port) = port {
            return port.wait(deadline);
        }
        while !self.shared.has_arrivals.load(Acquire) {
            let left = deadline.saturating_sub(monotonic()).0;
            let Ok(left @ 1..) = u64::try_from(left) else {
                return false;
            };
            thread::sleep(Duration::from_nanos(left).min(PERIOD));
        }
        true
    }

    fn missing(&self) -> Missing {
        let missing = self.shared.missing.lock();
        missing.unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Drop for Attaching {
    fn drop(&mut self) {
        self.shared.stop.store(true, Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

/// The program's signals are for its own threads, but for those that say that an instruction of
/// this thread went wrong.
fn leave_signals_to_others() {
    let mut signals = SigSet::all();
    let synchronous = [
        Signal::SIGBUS,
        Signal::SIGSEGV,
        Signal::SIGILL,
        Signal::SIGFPE,
        Signal::SIGTRAP,
        Signal::SIGABRT,
    ];
    synchronous
        .into_iter()
        .for_each(|signal| signals.remove(signal));
    let _ = signals.thread_block();
}

/// What the thread owns.
struct Attacher {
    config: DomainConfig,
    robot: String,
    shared: Arc<AttachState>,
    send: SyncSender<Passed>,
    returned: Receiver<Passed>,
    domain: Option<Domain<ipc_threadsafe::Service>>,
    /// Which ports the cycle has, by [`Passed`]'s order.
    passed: [bool; PORTS],
    gateway: Watch<GatewayHealth, ipc_threadsafe::Service>,
    estimator: Watch<EstimatorHealth, ipc_threadsafe::Service>,
}

impl Attacher {
    fn turn(&mut self, now: Nanos) {
        while let Ok(port) = self.returned.try_recv() {
            let number = match &port {
                Passed::Torques(_) => 0,
                Passed::Contacts(_) => 1,
                Passed::Descriptions(_) => 2,
                Passed::Samples(_) => 3,
            };
            if let Some(passed) = self.passed.get_mut(number) {
                *passed = false;
            }
        }
        let missing = self.poll(now);
        *self
            .shared
            .missing
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = missing;
    }

    fn poll(&mut self, now: Nanos) -> Missing {
        if let Err(problem) = self.renew_domain() {
            return Missing {
                problem: Some(problem),
                ..Missing::default()
            };
        }
        let mut problem = self.open_ports();
        let Some(domain) = &self.domain else {
            return Missing::default();
        };
        let robot = &self.robot;
        let gateway = self.gateway.poll(domain, robot, now);
        let estimator = self.estimator.poll(domain, robot, now);
        if (gateway, estimator) == (Presence::NotStarted, Presence::NotStarted) && problem.is_none()
        {
            let others = domain.robot_names();
            if !others.is_empty() {
                let others: Vec<String> = others.into_iter().collect();
                problem = Some(format!(
                    "there is no robot {robot:?} in the domain {:?}; the robots here are {}",
                    self.config.name,
                    others.join(", ")
                ));
            }
        }
        Missing {
            gateway,
            estimator,
            problem,
        }
    }

    /// Opens the domain, or a new one for one that is gone, of which the cycle gives all ports
    /// back.
    fn renew_domain(&mut self) -> Result<(), String> {
        let is_gone = |domain: &Domain<_>| !domain.is_usable();
        if self.domain.as_ref().is_some_and(is_gone) {
            // Somebody has deleted or damaged the domain's files, or the last other process has
            // left it.
            self.shared.recall.store(true, Relaxed);
            if self.passed.contains(&true) {
                return Err(format!(
                    "files of the domain {:?} were deleted or damaged; waiting for new ones",
                    self.config.name
                ));
            }
            (self.gateway, self.estimator) = (Watch::default(), Watch::default());
            self.domain = None;
        }
        self.shared.recall.store(false, Relaxed);
        if self.domain.is_none() {
            let domain = Domain::existing(&self.config).map_err(|error| {
                let siblings = self.config.siblings();
                match siblings.is_empty() {
                    true => error.to_string(),
                    false => format!("{error}; the domains here are {}", siblings.join(", ")),
                }
            })?;
            self.domain = Some(domain);
        }
        Ok(())
    }

    /// Opens the ports that the cycle has not, and passes them to it; returns a problem.
    fn open_ports(&mut self) -> Option<String> {
        let (domain, robot) = (self.domain.as_ref()?, &self.robot);
        let mut problem = None;
        let missing = self.passed.iter_mut().enumerate();
        for (number, passed) in missing.filter(|(_, passed)| !**passed) {
            let opened = match number {
                0 => Reader::open_in(domain, robot).map(Passed::Torques),
                1 => Reader::open_in(domain, robot).map(Passed::Contacts),
                2 => Reader::open_in(domain, robot).map(Passed::Descriptions),
                _ => Reader::open_in(domain, robot).map(Passed::Samples),
            };
            match opened {
                Ok(port) => {
                    *passed = self.send.try_send(port).is_ok();
                    self.shared.has_arrivals.store(true, Release);
                }
                Err(PortError::NotYet { .. }) => {}
                Err(error) => problem = Some(error.to_string()),
            }
        }
        problem
    }
}
