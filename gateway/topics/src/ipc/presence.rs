//! Who is there: the domains of a machine, the robots of a domain, and whether a robot's gateway
//! and estimator live.

use super::clock::monotonic;
use super::{Domain, DomainConfig, Reader, Topic};
use crate::{EstimatorHealth, GatewayHealth, Nanos};
use core::fmt;
use iceoryx2::prelude::CallbackProgression;
use iceoryx2::service::Service;
use std::collections::BTreeSet;
use std::fs;
use std::string::{String, ToString};
use std::time::Duration;
use std::vec::Vec;

/// Whether a gateway or an estimator is there.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Presence {
    /// None has been started, or all have ended and nobody holds what they left.
    #[default]
    NotStarted,
    /// It sends its health ten times a second.
    Running,
    /// It lives, but has sent no health for a second: it is stopped, or stuck.
    Stuck {
        /// Its process.
        process: i32,
    },
    /// It has ended, or was killed.
    Ended,
}

impl fmt::Display for Presence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotStarted => f.write_str("was not started"),
            Self::Running => f.write_str("is running"),
            Self::Stuck { process } => write!(f, "(process {process}) is stopped or stuck"),
            Self::Ended => f.write_str("has ended"),
        }
    }
}

/// A health message comes every 0.1 s; ten in a row cannot be late on a machine that works.
const SILENCE: Nanos = Nanos::from_millis(1000);

/// Follows the health of a gateway or estimator.
#[derive(Debug)]
pub(super) struct Watch<T: Topic, S: Service> {
    reader: Option<Reader<T, S>>,
    /// When the last health was published, and at first when this was opened.
    last: Nanos,
}

impl<T: Topic, S: Service> Watch<T, S> {
    pub(super) const fn new() -> Self {
        Self {
            reader: None,
            last: Nanos::MIN,
        }
    }

    /// Whether it is there at `now`.
    pub(super) fn look(&mut self, domain: &Domain<S>, robot: &str, now: Nanos) -> Presence {
        if self.reader.is_none() {
            self.reader = Reader::open_in(domain, robot).ok();
            self.last = now;
        }
        let Some(reader) = &mut self.reader else {
            return Presence::NotStarted;
        };
        if let Ok(Some(health)) = reader.latest() {
            self.last = health.header().published;
        }
        match reader.writer_process() {
            0 => Presence::Ended,
            _ if now.saturating_sub(self.last) <= SILENCE => Presence::Running,
            process => Presence::Stuck { process },
        }
    }
}

/// A robot with services in a domain.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotPresence {
    /// Its name.
    pub name: String,
    /// Its gateway.
    pub gateway: Presence,
    /// Its estimator.
    pub estimator: Presence,
}

impl Domain {
    /// The robots of this domain, by name. Watches them for more than a second, to tell a process
    /// that is stuck from one that runs.
    #[must_use]
    pub fn robots(&self) -> Vec<RobotPresence> {
        let mut watches: Vec<(String, Watch<GatewayHealth, _>, Watch<EstimatorHealth, _>)> = self
            .robot_names()
            .into_iter()
            .map(|name| (name, Watch::new(), Watch::new()))
            .collect();
        let mut look = || -> Vec<RobotPresence> {
            let robots = watches.iter_mut().map(|(name, gateway, estimator)| {
                let now = monotonic();
                RobotPresence {
                    gateway: gateway.look(self, name, now),
                    estimator: estimator.look(self, name, now),
                    name: name.clone(),
                }
            });
            robots.collect()
        };
        look();
        std::thread::sleep(Duration::from_millis(1200));
        look()
    }
}

impl<S: Service> Domain<S> {
    /// The names of the robots that have services in this domain.
    pub(super) fn robot_names(&self) -> BTreeSet<String> {
        let mut names = BTreeSet::new();
        let suffixes = [GatewayHealth::SUFFIX, EstimatorHealth::SUFFIX];
        let _ = S::list(self.iceoryx(), |details| {
            let service = details.static_details.name().as_str();
            let robot = suffixes
                .iter()
                .find_map(|suffix| service.strip_suffix(suffix)?.strip_suffix('/'));
            names.extend(robot.map(ToString::to_string));
            CallbackProgression::Continue
        });
        names
    }
}

impl DomainConfig {
    /// The names of the domains that exist in this directory.
    #[must_use]
    pub fn siblings(&self) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(&self.base)
            .into_iter()
            .flatten()
            .flatten()
            .filter(|entry| entry.path().is_dir())
            .filter_map(|entry| entry.file_name().into_string().ok())
            .filter(|name| self.base.join(name).join("services").is_dir())
            .collect();
        names.sort();
        names
    }
}
