//! Follows one running robot: its samples, declarations, estimates and health, by name, over
//! restarts of its daemons and damage of its domain.

use crate::described::{DescriptionReader, next};
use proprio_topics::csv::{Series, SeriesKind, Value};
use proprio_topics::ipc::{Domain, DomainConfig, DomainError, PortError, Reader, TakeError, Topic};
use proprio_topics::{
    ContactDeclaration, ContactEstimate, Description, DriveEstimate, EstimatorHealth,
    GatewayHealth, MAX_CHANNELS, Nanos, Publisher, Role, Sample, TorqueEstimate,
};
use std::rc::Rc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// How often a listener looks for an estimator, and whether the domain is intact.
const LOOK: Nanos = Nanos::from_millis(500);
/// How often a robot that is not there is looked for.
const AGAIN: Duration = Duration::from_millis(250);

/// Why a robot cannot be listened to.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ListenError {
    /// The domain cannot be opened.
    #[error("{error}{}", match siblings.is_empty() {
        true => String::new(),
        false => format!("; the domains here are {}", siblings.join(", ")),
    })]
    Domain {
        /// Why.
        error: DomainError,
        /// The domains that there are.
        siblings: Vec<String>,
    },
    /// Nobody has published anything in the domain.
    #[error("there is no robot in the domain")]
    NoRobot,
    /// None was named.
    #[error("there are several robots: name one with --robot: {}", names.join(", "))]
    Several {
        /// Their names.
        names: Vec<String>,
    },
    /// There is none of this name.
    #[error("there is no robot {name:?}; there is {}", names.join(", "))]
    Unknown {
        /// The name.
        name: String,
        /// Those that there are.
        names: Vec<String>,
    },
    /// Its gateway does not run.
    #[error("the robot's gateway is not running")]
    NoGateway,
    /// A topic cannot be read.
    #[error(transparent)]
    Port(#[from] PortError),
    /// A payload cannot be taken.
    #[error(transparent)]
    Take(#[from] TakeError),
}

/// Opens the domain for reading; the error names the domains that there are.
///
/// # Errors
/// [`ListenError::Domain`].
pub fn open(config: &DomainConfig) -> Result<Domain, ListenError> {
    Domain::open_existing(config).map_err(|error| ListenError::Domain {
        error,
        siblings: config.siblings(),
    })
}

/// The name of the robot to read: the named one, or the only one. Whether it runs is not asked:
/// that takes a second.
///
/// # Errors
/// There is none, or not one.
pub fn one_robot(domain: &Domain, name: Option<&str>) -> Result<String, ListenError> {
    let names: Vec<String> = domain.robot_names().into_iter().collect();
    match (name, names.as_slice()) {
        (_, []) => Err(ListenError::NoRobot),
        (None, [only]) => Ok(only.clone()),
        (None, _) => Err(ListenError::Several { names }),
        (Some(name), _) if names.iter().any(|known| known == name) => Ok(name.to_owned()),
        (Some(name), _) => Err(ListenError::Unknown {
            name: name.to_owned(),
            names,
        }),
    }
}

/// What a robot sends.
#[derive(Debug, Clone)]
pub enum Heard {
    /// A value of the series with this number ([`Listener::series`]).
    Value(usize, Value),
    /// Torques, with the names of the estimator that sent them.
    Torques(Box<TorqueEstimate>, Rc<Description>),
    /// Contact wrenches, likewise.
    Contacts(Box<ContactEstimate>, Rc<Description>),
    /// What the drives say of the torques, likewise.
    Drives(Box<DriveEstimate>, Rc<Description>),
    /// How the gateway is.
    Gateway(Box<GatewayHealth>),
    /// How the estimator is.
    Estimator(Box<EstimatorHealth>),
}

/// A value at an instant.
#[derive(Debug, Clone)]
pub struct Event {
    /// The instant that it is of (CLOCK_MONOTONIC).
    pub t: Nanos,
    /// The start of its publisher.
    pub epoch: u64,
    /// What it is.
    pub heard: Heard,
}

/// The names of an estimator, over its restarts.
struct Names {
    described: DescriptionReader,
    known: Option<Rc<Description>>,
}

impl Names {
    /// Those of the estimator's start `epoch`, if they have come.
    fn of(&mut self, epoch: u64) -> Option<Rc<Description>> {
        if (self.known.as_ref()).is_none_or(|known| known.header.epoch != epoch) {
            self.known = self.described.of(epoch).map(|names| Rc::new(*names));
        }
        self.known.clone()
    }
}

/// What the estimator sends.
struct Estimates {
    torques: Reader<TorqueEstimate>,
    contacts: Reader<ContactEstimate>,
    /// None if no drive is known.
    drives: Option<Reader<DriveEstimate>>,
    health: Option<Reader<EstimatorHealth>>,
    names: Names,
}

impl Estimates {
    /// Those of the robot's estimator, without waiting for its names; `None` if it has never run.
    fn of(domain: &Domain, robot: &str) -> Option<Self> {
        Some(Self {
            torques: Reader::open(domain, robot).ok()?,
            contacts: Reader::open(domain, robot).ok()?,
            drives: Reader::open(domain, robot).ok(),
            health: Reader::open(domain, robot).ok(),
            names: Names {
                described: DescriptionReader::to_come(domain, robot, Publisher::Estimator).ok()?,
                known: None,
            },
        })
    }
}

/// Takes the estimates that have come; returns how many were lost, because the names of their
/// estimator have not.
fn gather_named<T: Topic>(
    reader: &mut Reader<T>,
    names: &mut Names,
    heard: fn(Box<T>, Rc<Description>) -> Heard,
    inbox: &mut Vec<Event>,
) -> Result<u64, TakeError> {
    let mut lost = 0;
    while let Some(estimate) = next(reader)? {
        let header = estimate.header();
        let (t, epoch) = (header.acquired, header.epoch);
        match names.of(epoch) {
            Some(names) => {
                let heard = heard(Box::new(estimate), names);
                inbox.push(Event { t, epoch, heard });
            }
            None => lost += 1,
        }
    }
    Ok(lost)
}

/// Takes what has come of how a daemon is.
fn gather_health<T: Topic>(
    reader: &mut Option<Reader<T>>,
    heard: fn(Box<T>) -> Heard,
    inbox: &mut Vec<Event>,
) -> Result<(), TakeError> {
    while let Some(reader) = reader
        && let Some(health) = next(reader)?
    {
        let header = health.header();
        let (t, epoch) = (header.published, header.epoch);
        let heard = heard(Box::new(health));
        inbox.push(Event { t, epoch, heard });
    }
    Ok(())
}

/// Follows one robot.
pub struct Listener {
    domain: Domain,
    robot: String,
    gateway: DescriptionReader,
    samples: Reader<Sample>,
    declarations: Option<Reader<ContactDeclaration>>,
    health: Option<Reader<GatewayHealth>>,
    estimates: Option<Estimates>,
    series: Vec<Series>,
    /// Of each channel number of the gateway's start `epoch`: its series.
    numbers: Vec<Option<usize>>,
    epoch: u64,
    /// What waits to be sorted.
    inbox: Vec<Event>,
    look: Nanos,
    lost: u64,
    lost_estimates: u64,
    unknown: u64,
}

impl Listener {
    /// Listens to the robot of this name, or the only one. Waits half a second for the names of an
    /// estimator that does not run.
    ///
    /// # Errors
    /// [`ListenError`]: its gateway does not run, or it cannot be read.
    pub fn open(config: &DomainConfig, robot: Option<&str>) -> Result<Self, ListenError> {
        let domain = open(config)?;
        let robot = one_robot(&domain, robot)?;
        Self::of(domain, robot)
    }

    /// As [`Listener::open`], as soon as the robot is there; `None` if `stop` was set before. Gives
    /// `say` each reason why it waits, once.
    ///
    /// # Errors
    /// [`ListenError::Several`]: which one, only the user knows.
    pub fn wait_open(
        config: &DomainConfig,
        robot: Option<&str>,
        stop: &AtomicBool,
        mut say: impl FnMut(&str),
    ) -> Result<Option<Self>, ListenError> {
        let mut last_why = String::new();
        while !stop.load(Relaxed) {
            match Self::open(config, robot) {
                Ok(listener) => return Ok(Some(listener)),
                Err(error @ ListenError::Several { .. }) => return Err(error),
                Err(error) => {
                    let why = error.to_string();
                    if why != last_why {
                        say(&why);
                        last_why = why;
                    }
                }
            }
            std::thread::sleep(AGAIN);
        }
        Ok(None)
    }

    fn of(domain: Domain, robot: String) -> Result<Self, ListenError> {
        // The readers first: what comes meanwhile is heard, too.
        let samples = Reader::open(&domain, &robot).map_err(|error| match error {
            PortError::NotYet { .. } => ListenError::NoGateway,
            error => error.into(),
        })?;
        let gateway = DescriptionReader::by(&domain, &robot, Publisher::Gateway)?;
        let estimator = DescriptionReader::by(&domain, &robot, Publisher::Estimator)?;
        let mut listener = Self {
            declarations: Reader::open(&domain, &robot).ok(),
            health: Reader::open(&domain, &robot).ok(),
            estimates: Estimates::of(&domain, &robot),
            robot,
            gateway: gateway.ok_or(ListenError::NoGateway)?,
            samples,
            series: Vec::new(),
            numbers: Vec::new(),
            epoch: 0,
            inbox: Vec::new(),
            look: Nanos::MIN,
            lost: 0,
            lost_estimates: 0,
            unknown: 0,
            domain,
        };
        let description = *listener.gateway.newest();
        listener.name_channels(&description);
        if let Some(described) = estimator {
            listener.name_contacts(described.newest());
            if let Some(estimates) = &mut listener.estimates {
                estimates.names.described = described;
            }
        }
        Ok(listener)
    }

    /// The robot's name.
    #[must_use]
    pub fn robot(&self) -> &str {
        &self.robot
    }

    /// The gateway's newest description.
    #[must_use]
    pub const fn description(&self) -> &Description {
        self.gateway.newest()
    }

    /// The channels and contacts that were heard of so far; only added to.
    #[must_use]
    pub fn series(&self) -> &[Series] {
        &self.series
    }

    /// Samples that came too fast to be read, and are lost.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost + self.samples.lost()
    }

    /// Estimates (torques, contacts, drives) that came too fast to be read, or before the names of
    /// their estimator, and are lost.
    #[must_use]
    pub fn lost_estimates(&self) -> u64 {
        let lost = |estimates: &Estimates| {
            let drives = estimates.drives.as_ref().map_or(0, Reader::lost);
            estimates.torques.lost() + estimates.contacts.lost() + drives
        };
        self.lost_estimates + self.estimates.as_ref().map_or(0, lost)
    }

    /// Samples whose channel has no name: those of a gateway that has ended meanwhile.
    #[must_use]
    pub const fn unknown(&self) -> u64 {
        self.unknown
    }

    /// The number of a series, which is added if it is new.
    fn number(&mut self, kind: SeriesKind, name: &str) -> usize {
        let known = (self.series.iter()).position(|one| one.kind == kind && one.name == name);
        known.unwrap_or_else(|| {
            let name = name.to_owned();
            self.series.push(Series { kind, name });
            self.series.len() - 1
        })
    }

    /// The names of a start of the gateway: the same channels may have other numbers than before.
    fn name_channels(&mut self, description: &Description) {
        let mut numbers = vec![None; MAX_CHANNELS];
        for entry in description.entries() {
            if entry.role == Role::Channel
                && let Some(kind) = entry.kind.get()
                && let Some(number) = numbers.get_mut(entry.index as usize)
            {
                *number = Some(self.number(SeriesKind::Channel(kind), entry.name.as_str()));
            }
        }
        (self.numbers, self.epoch) = (numbers, description.header.epoch);
    }

    fn name_contacts(&mut self, description: &Description) {
        for entry in description.entries() {
            if entry.role == Role::Contact {
                self.number(SeriesKind::Contact, entry.name.as_str());
            }
        }
    }

    /// Gives what has come to `take`: declarations, then all else in the order of time.
    /// `now` is CLOCK_MONOTONIC.
    ///
    /// # Errors
    /// [`ListenError`], as its first variants; those of `take`.
    pub fn poll<E: From<ListenError>>(
        &mut self,
        now: Nanos,
        mut take: impl FnMut(&Self, Event) -> Result<(), E>,
    ) -> Result<(), E> {
        let failed = |error: TakeError| E::from(error.into());
        while let Some(reader) = &mut self.declarations
            && let Some(declared) = next(reader).map_err(failed)?
        {
            let number = self.number(SeriesKind::Contact, declared.contact.as_str());
            let event = Event {
                t: declared.header.acquired,
                epoch: declared.header.epoch,
                heard: Heard::Value(number, Value::Contact(declared.state())),
            };
            take(self, event)?;
        }
        // Shared memory delivers all samples of one bus before those of the next, and an estimate
        // apart from the samples that it is of.
        let mut inbox = std::mem::take(&mut self.inbox);
        self.gather(&mut inbox)?;
        inbox.sort_by_key(|event| event.t);
        for event in inbox.drain(..) {
            take(self, event)?;
        }
        self.inbox = inbox;
        if now >= self.look {
            self.look = now + LOOK;
            self.look_again();
        }
        Ok(())
    }

    /// Takes what has come: samples, then estimates and health.
    fn gather(&mut self, inbox: &mut Vec<Event>) -> Result<(), ListenError> {
        while let Some(sample) = next(&mut self.samples)? {
            let epoch = sample.header.epoch;
            if epoch != self.epoch
                && let Some(description) = self.gateway.of(epoch).copied()
            {
                self.name_channels(&description);
            }
            let number = self.numbers.get(sample.channel as usize).copied().flatten();
            let number = number.filter(|_| epoch == self.epoch);
            let Some((number, reading)) = number.zip(sample.reading()) else {
                self.unknown += 1;
                continue;
            };
            let value = Value::Reading(reading, sample.header.quality);
            inbox.push(Event {
                t: sample.header.acquired,
                epoch,
                heard: Heard::Value(number, value),
            });
        }
        gather_health(&mut self.health, Heard::Gateway, inbox)?;
        if let Some(Estimates {
            torques,
            contacts,
            drives,
            health,
            names,
        }) = &mut self.estimates
        {
            let lost = &mut self.lost_estimates;
            *lost += gather_named(torques, names, Heard::Torques, inbox)?;
            *lost += gather_named(contacts, names, Heard::Contacts, inbox)?;
            if let Some(drives) = drives {
                *lost += gather_named(drives, names, Heard::Drives, inbox)?;
            }
            gather_health(health, Heard::Estimator, inbox)?;
        }
        Ok(())
    }

    /// Looks for what may have come or gone.
    fn look_again(&mut self) {
        // Gateway and estimator make a damaged domain again; until they have, nothing comes.
        if let Some(Ok(domain)) = self.domain.reopened()
            && let Ok(new) = Self::of(domain, self.robot.clone())
        {
            let lost = self.lost();
            let lost_estimates = self.lost_estimates();
            let (series, unknown) = (std::mem::take(&mut self.series), self.unknown);
            *self = Self {
                series,
                lost,
                lost_estimates,
                unknown,
                look: self.look,
                ..new
            };
            let description = *self.gateway.newest();
            self.name_channels(&description);
        }
        match &mut self.estimates {
            None => self.estimates = Estimates::of(&self.domain, &self.robot),
            // Of an estimator that has learnt of drives since.
            Some(Estimates { drives, .. }) if drives.is_none() => {
                *drives = Reader::open(&self.domain, &self.robot).ok();
            }
            Some(_) => {}
        }
        if self.declarations.is_none() {
            self.declarations = Reader::open(&self.domain, &self.robot).ok();
        }
        if self.health.is_none() {
            self.health = Reader::open(&self.domain, &self.robot).ok();
        }
    }

    /// Waits until samples come, at the latest until `deadline` (CLOCK_MONOTONIC).
    pub fn wait(&mut self, deadline: Nanos) {
        self.samples.wait(deadline);
    }
}
