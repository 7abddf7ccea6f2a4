//! Who is there: the domains of a machine, the robots of a domain, and whether a robot's gateway
//! and estimator live.

use super::clock::monotonic;
use super::{Domain, DomainConfig, Reader, Topic};
use crate::{EstimatorHealth, GatewayHealth, Nanos};
use core::fmt;
use iceoryx2::prelude::{CallbackProgression, ipc};
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
    /// It has ended in order, or had gone before anybody looked.
    Ended,
    /// It was killed, or has crashed: it went without leaving the domain in order.
    Killed,
}

impl fmt::Display for Presence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotStarted => f.write_str("is not running"),
            Self::Running => f.write_str("is running"),
            // In another container its number is not known.
            Self::Stuck { process: 0 } => f.write_str("is stopped or stuck"),
            Self::Stuck { process } => write!(f, "(process {process}) is stopped or stuck"),
            Self::Ended => f.write_str("has ended"),
            Self::Killed => f.write_str("was killed or has crashed"),
        }
    }
}

/// A health message comes every 0.1 s; ten in a row cannot be late on a machine that works.
const SILENCE: Nanos = Nanos::from_millis(1000);

/// Follows the health of a gateway or estimator: `T` is the topic of that health.
#[derive(Debug)]
pub struct Watch<T: Topic, S: Service = ipc::Service> {
    reader: Option<Reader<T, S>>,
    newest: Option<T>,
    /// When the last health was published, and at first when its writer was seen.
    last: Nanos,
    /// The writer: its node, and how many had left in order when it was first seen.
    writer: Option<(u128, u32)>,
    /// How the last writer went.
    went: Presence,
}

impl<T: Topic, S: Service> Default for Watch<T, S> {
    fn default() -> Self {
        Self {
            reader: None,
            newest: None,
            last: Nanos::MIN,
            writer: None,
            went: Presence::Ended,
        }
    }
}

impl<T: Topic, S: Service> Watch<T, S> {
    /// Whether it is there at `now`. Makes system calls; the first that finds it opens a port. If
    /// it has ended and another one has started since the last call, that is told by two calls.
    pub fn poll(&mut self, domain: &Domain<S>, robot: &str, now: Nanos) -> Presence {
        if self.reader.is_none() {
            self.reader = Reader::open_in(domain, robot).ok();
        }
        let Some(reader) = &mut self.reader else {
            return Presence::NotStarted;
        };
        if let Ok(Some(health)) = reader.latest() {
            self.last = health.header().published;
            self.newest = Some(health);
        }
        let alive = reader.live_writer();
        match (self.writer, alive) {
            (Some((node, _)), Some((same, process))) if node == same => {
                return if now.saturating_sub(self.last) <= SILENCE {
                    Presence::Running
                } else {
                    Presence::Stuck { process }
                };
            }
            (Some((_, farewells)), _) => {
                self.went = if reader.farewells() == farewells {
                    Presence::Killed
                } else {
                    Presence::Ended
                };
                self.writer = None;
            }
            (None, Some((node, _))) => {
                self.writer = Some((node, reader.farewells()));
                // Its first health is yet to come.
                self.last = self.last.max(now);
                return Presence::Running;
            }
            (None, None) => {}
        }
        self.went
    }

    /// The newest health that [`Watch::poll`] has seen.
    #[must_use]
    pub const fn newest(&self) -> Option<&T> {
        self.newest.as_ref()
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
            .map(|name| (name, Watch::default(), Watch::default()))
            .collect();
        let mut presences = || -> Vec<RobotPresence> {
            let robots = watches.iter_mut().map(|(name, gateway, estimator)| {
                let now = monotonic();
                RobotPresence {
                    gateway: gateway.poll(self, name, now),
                    estimator: estimator.poll(self, name, now),
                    name: name.clone(),
                }
            });
            robots.collect()
        };
        presences();
        std::thread::sleep(Duration::from_millis(1200));
        presences()
    }
}

impl<S: Service> Domain<S> {
    /// The names of the robots that have services in this domain, whether or not they run now.
    #[must_use]
    pub fn robot_names(&self) -> BTreeSet<String> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ipc::Writer;

    /// The first health of a gateway that was restarted is yet to come: it is not stuck because the
    /// last one of its predecessor is old.
    #[test]
    fn a_restarted_gateway_is_not_stuck_before_its_first_health() {
        let base = tempfile::tempdir().unwrap();
        let domain = Domain::open(&DomainConfig::new(base.path(), "test")).unwrap();
        let start = || Writer::<GatewayHealth>::create(&domain, "icub", 1).unwrap();
        let mut watch = Watch::<GatewayHealth>::default();
        let mut presence_at = |now| watch.poll(&domain, "icub", now);
        let (t, tick) = (Nanos::from_millis(5000), Nanos(1));

        let mut first = start();
        assert_eq!(presence_at(t), Presence::Running);
        first.send(&GatewayHealth::new(t), t).unwrap();
        assert_eq!(presence_at(t + SILENCE), Presence::Running);
        drop(first);
        assert_eq!(presence_at(t + SILENCE), Presence::Ended);

        let later = t + SILENCE + SILENCE;
        let _second = start();
        assert_eq!(presence_at(later), Presence::Running);
        assert_eq!(presence_at(later + SILENCE), Presence::Running);
        assert!(matches!(
            presence_at(later + SILENCE + tick),
            Presence::Stuck { .. }
        ));
    }
}
