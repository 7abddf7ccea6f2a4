//! The reader for control loops: the torque of a joint, or the reason why there is none. Never
//! blocks.

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
    /// Torque \[Nm\] (force \[N\] for a prismatic joint) by the parent link on the child link,
    /// along the URDF axis.
    pub torque: f64,
    /// Its standard deviation \[Nm\]; NaN where it is not known.
    pub standard_deviation: f64,
    /// How old it is \[ns\].
    pub age: Nanos,
}

/// Why there is no torque to use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum NoTorque {
    /// No estimate has been received since this reader was created.
    NeverSeen,
    /// The last estimate is older than allowed.
    Stale {
        /// How old it is \[ns\].
        age: Nanos,
    },
    /// The estimator's description, with the names of its joints, has not been received yet.
    NotDescribed,
    /// The estimator has no such joint.
    UnknownJoint,
    /// The estimator withholds it.
    Withheld {
        /// The reason.
        reason: Reason,
        /// The channel that causes it; empty if there is no single one.
        channel: Name,
        /// The withheld value \[Nm\]; do not use it for control.
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
            Self::Withheld {
                reason, channel, ..
            } if channel.as_str().is_empty() => write!(f, "withheld: {reason}"),
            Self::Withheld {
                reason, channel, ..
            } => write!(f, "withheld: {reason} ({channel})"),
        }
    }
}

/// Interval between attempts to open a service that does not exist yet.
const RETRY: Nanos = Nanos::from_millis(100);

/// The newest torques of one robot, by joint name or number.
///
/// Call [`TorqueReader::update`] once per cycle, then [`TorqueReader::torque`] for each joint. The
/// reader may be created before the estimator runs, and it reconnects to an estimator that was
/// restarted. While the estimator's services do not exist, one cycle in 100 ms tries to open them
/// (some file operations, about a millisecond; it does not wait for a lock that another process
/// holds). Once attached, a cycle makes no system call and no allocation, except the cycle in which
/// a new estimator is connected.
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
    /// A reader of `robot`'s torques; older than `max_age` they are stale. Opens nothing yet.
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

    /// Takes the waiting payloads at `now` (CLOCK_MONOTONIC \[ns\], see [`super::monotonic`]).
    pub fn update(&mut self, now: Nanos) -> Freshness {
        self.now = now;
        if (self.estimates.is_none() || self.descriptions.is_none()) && now >= self.next_look {
            self.next_look = now.saturating_add(RETRY);
            self.problem = None;
            attach(
                &mut self.estimates,
                &self.domain,
                &self.robot,
                &mut self.problem,
            );
            attach(
                &mut self.descriptions,
                &self.domain,
                &self.robot,
                &mut self.problem,
            );
        }
        if let Some(reader) = &mut self.descriptions {
            // The gateway sends its description on the same service.
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

    /// The freshness of the newest estimate at the last update.
    #[must_use]
    pub fn freshness(&self) -> Freshness {
        Freshness::of(self.header().map(|h| h.acquired), self.now, self.max_age)
    }

    /// The torque of the joint called `name`.
    ///
    /// # Errors
    /// [`NoTorque`], the reason why there is none.
    pub fn torque(&self, name: &str) -> Result<Torque, NoTorque> {
        self.age()?;
        let description = self.described().ok_or(NoTorque::NotDescribed)?;
        let index = description
            .index(Role::Joint, name)
            .ok_or(NoTorque::UnknownJoint)?;
        self.torque_at(index as usize)
    }

    /// The torque of joint number `index`: its index in the estimator's description, which may
    /// change when the estimator is restarted.
    ///
    /// # Errors
    /// [`NoTorque`], the reason why there is none.
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
            reason: joint.reason.get().unwrap_or_default(),
            channel,
            torque: joint.torque,
        })
    }

    /// The joints' names, in order of their numbers; empty before the estimator's description is
    /// received.
    pub fn joints(&self) -> impl Iterator<Item = &str> {
        let entries = self
            .described()
            .map(Description::entries)
            .unwrap_or_default();
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

    /// Why the last attempt to open the estimator's services failed; `None` when they are open.
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

    /// The description of the same epoch as the estimate: after a restart the numbers may mean
    /// other joints.
    fn described(&self) -> Option<&Description> {
        let epoch = self.header().map(|h| h.epoch);
        self.description
            .as_ref()
            .as_ref()
            .filter(|d| epoch.is_none_or(|e| e == d.header.epoch))
    }
}

fn attach<T: Topic>(
    reader: &mut Option<Reader<T>>,
    domain: &Domain,
    robot: &str,
    problem: &mut Option<PortError>,
) {
    if reader.is_none() {
        match Reader::open_with(domain, robot, Patience::None) {
            Ok(opened) => *reader = Some(opened),
            Err(e) => *problem = Some(e),
        }
    }
}
