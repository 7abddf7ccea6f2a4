//! What a control loop wants: the torque of a joint, or the reason why there is none. Never waits.

use super::lock::Patience;
use super::{Domain, Freshness, PortError, Reader, Topic};
use crate::{Description, Header, Name, Nanos, Publisher, Reason, Role, TorqueEstimate};
use core::fmt;
use std::borrow::ToOwned;
use std::boxed::Box;
use std::string::String;

/// A torque that may be used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Torque {
    /// Torque \[Nm\] (force \[N\] for a prismatic joint) by the parent link on the child link, along the URDF axis.
    pub torque: f64,
    /// Its standard deviation \[Nm\]; NaN where it is not known.
    pub standard_deviation: f64,
    /// How old it is \[ns\].
    pub age: Nanos,
}

/// Why there is no torque to use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum NoTorque {
    /// No estimate has come since this reader was made.
    NeverSeen,
    /// The last estimate is older than allowed.
    Stale {
        /// How old it is \[ns\].
        age: Nanos,
    },
    /// The estimator has not yet told the names of what it estimates.
    NotDescribed,
    /// The estimator has no such joint.
    UnknownJoint,
    /// The estimator withholds it.
    Withheld {
        /// Why.
        reason: Reason,
        /// The channel to blame; empty where there is no single one.
        channel: Name,
        /// The number that must not be used \[Nm\].
        torque: f64,
    },
}

impl fmt::Display for NoTorque {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NeverSeen => f.pad("never seen"),
            Self::Stale { age } => write!(f, "stale: {:.3} s old", age.seconds()),
            Self::NotDescribed => f.pad("not described yet"),
            Self::UnknownJoint => f.pad("unknown joint"),
            Self::Withheld { reason, channel, .. } if channel.as_str().is_empty() => write!(f, "withheld: {reason}"),
            Self::Withheld { reason, channel, .. } => write!(f, "withheld: {reason} ({channel})"),
        }
    }
}

/// How often a service that is not there is looked for.
const RETRY: Nanos = Nanos::from_millis(100);

/// The newest torques of one robot, by joint name or number.
///
/// [`TorqueReader::update`] once per cycle, then [`TorqueReader::torque`] for each joint. It may be made before the
/// estimator runs; an estimator that dies and starts again is picked up again. While the estimator's services are not there, one
/// cycle in 100 ms pays for a look (some file operations, a millisecond or so; it does not wait for a lock that somebody holds). Once attached, a cycle does no
/// system call and no allocation, but for the one in which a new estimator is connected.
#[derive(Debug)]
pub struct TorqueReader {
    domain: Domain,
    robot: String,
    max_age: Nanos,
    now: Nanos,
    next_look: Nanos,
    estimates: Option<Reader<TorqueEstimate>>,
    descriptions: Option<Reader<Description>>,
    estimate: Box<Option<TorqueEstimate>>,
    description: Box<Option<Description>>,
    problem: Option<PortError>,
}

impl TorqueReader {
    /// A reader of `robot`'s torques, which it takes as stale when they are older than `max_age`. Looks for nothing yet.
    #[must_use]
    pub fn new(domain: &Domain, robot: &str, max_age: Nanos) -> Self {
        Self {
            domain: domain.clone(),
            robot: robot.to_owned(),
            max_age,
            now: Nanos::MIN,
            next_look: Nanos::MIN,
            estimates: None,
            descriptions: None,
            estimate: Box::new(None),
            description: Box::new(None),
            problem: None,
        }
    }

    /// Takes what has come, at `now` (CLOCK_MONOTONIC \[ns\], see [`super::monotonic`]).
    pub fn update(&mut self, now: Nanos) -> Freshness {
        self.now = now;
        if (self.estimates.is_none() || self.descriptions.is_none()) && now >= self.next_look {
            self.next_look = now.saturating_add(RETRY);
            self.problem = None;
            attach(&mut self.estimates, &self.domain, &self.robot, &mut self.problem);
            attach(&mut self.descriptions, &self.domain, &self.robot, &mut self.problem);
        }
        if let Some(reader) = &mut self.descriptions {
            // The gateway describes its channels on the same service.
            while let Ok(Some(description)) = reader.try_take() {
                if description.publisher == Publisher::Estimator {
                    *self.description = Some(description);
                }
            }
        }
        if let Some(reader) = &mut self.estimates
            && let Ok(Some(estimate)) = reader.latest()
        {
            *self.estimate = Some(estimate);
        }
        self.freshness()
    }

    /// How old the newest estimate was at the last update.
    #[must_use]
    pub fn freshness(&self) -> Freshness {
        Freshness::of(self.header().map(|h| h.acquired), self.now, self.max_age)
    }

    /// The torque of the joint called `name`.
    ///
    /// # Errors
    /// [`NoTorque`] says why there is none.
    pub fn torque(&self, name: &str) -> Result<Torque, NoTorque> {
        self.age()?;
        let description = self.described().ok_or(NoTorque::NotDescribed)?;
        let index = description.index(Role::Joint, name).ok_or(NoTorque::UnknownJoint)?;
        self.torque_at(index as usize)
    }

    /// The torque of joint number `index`: its place in the estimator's description, which may be another after a restart of the estimator.
    ///
    /// # Errors
    /// [`NoTorque`] says why there is none.
    pub fn torque_at(&self, index: usize) -> Result<Torque, NoTorque> {
        let age = self.age()?;
        let joints = self
            .estimate
            .as_ref()
            .as_ref()
            .map(TorqueEstimate::joints)
            .unwrap_or_default();
        let joint = joints.get(index).ok_or(NoTorque::UnknownJoint)?;
        if joint.valid == 1 {
            return Ok(Torque {
                torque: joint.torque,
                standard_deviation: joint.standard_deviation,
                age,
            });
        }
        let channel = self
            .described()
            .and_then(|d| d.find(Role::Channel, joint.cause))
            .map_or(Name::EMPTY, |e| e.name);
        Err(NoTorque::Withheld {
            reason: joint.reason,
            channel,
            torque: joint.torque,
        })
    }

    /// The joints' names, in order of their numbers; none before the estimator has described them.
    pub fn joints(&self) -> impl Iterator<Item = &str> {
        let entries = self.described().map(Description::entries).unwrap_or_default();
        entries
            .iter()
            .filter(|e| e.role == Role::Joint)
            .map(|e| e.name.as_str())
    }

    /// The newest estimate as it was sent.
    #[must_use]
    pub fn estimate(&self) -> Option<&TorqueEstimate> {
        self.estimate.as_ref().as_ref()
    }

    /// Why the estimator's services could not be opened at the last look; `None` when they are open.
    #[must_use]
    pub fn problem(&self) -> Option<&PortError> {
        self.problem.as_ref()
    }

    fn header(&self) -> Option<&Header> {
        self.estimate().map(Topic::header)
    }

    fn age(&self) -> Result<Nanos, NoTorque> {
        match self.freshness() {
            Freshness::NeverSeen => Err(NoTorque::NeverSeen),
            Freshness::Stale { age } => Err(NoTorque::Stale { age }),
            Freshness::Fresh { age } => Ok(age),
        }
    }

    /// The description that belongs to the estimate: after a restart the numbers may mean other joints.
    fn described(&self) -> Option<&Description> {
        let epoch = self.header().map(|h| h.epoch);
        self.description
            .as_ref()
            .as_ref()
            .filter(|d| epoch.is_none_or(|e| e == d.header.epoch))
    }
}

fn attach<T: Topic>(reader: &mut Option<Reader<T>>, domain: &Domain, robot: &str, problem: &mut Option<PortError>) {
    if reader.is_none() {
        match Reader::open_with(domain, robot, Patience::None) {
            Ok(opened) => *reader = Some(opened),
            Err(e) => *problem = Some(e),
        }
    }
}
