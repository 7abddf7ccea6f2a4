//! Reads a robot's shared memory, in a thread of its own: opening something there may take seconds,
//! and the screen must not wait for it.

use super::snapshot::RobotState;
use proprio_bridge::{next, open};
use proprio_topics::ipc::{Domain, DomainConfig, PortError, Reader, Topic, Watch, monotonic};
use proprio_topics::{
    ContactEstimate, Description, EstimatorHealth, GatewayHealth, InertiaEstimate, Nanos, Sample,
    TorqueEstimate,
};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender};
use std::time::Duration;

/// How often payloads are taken: a bus sends fewer meanwhile than wait for a reader.
const TURN: Duration = Duration::from_millis(20);
/// How often what was heard is shown.
const SHOW: Nanos = Nanos::from_millis(100);
/// How often it is looked for robots, for topics that nobody published before, and for damage.
const POLL_PERIOD: Nanos = Nanos::from_millis(500);

/// A topic, as soon as somebody publishes it.
struct TopicFeed<T: Topic>(Option<Reader<T>>);

impl<T: Topic> Default for TopicFeed<T> {
    fn default() -> Self {
        Self(None)
    }
}

impl<T: Topic> TopicFeed<T> {
    fn open(&mut self, domain: &Domain, robot: &str, trouble: &mut String) {
        if self.0.is_some() {
            return;
        }
        match Reader::open(domain, robot) {
            Ok(reader) => self.0 = Some(reader),
            Err(PortError::NotYet { .. }) => {}
            Err(error) => *trouble = error.to_string(),
        }
    }

    fn take(&mut self, mut hear: impl FnMut(T)) {
        while let Some(reader) = &mut self.0 {
            match next(reader) {
                Ok(Some(payload)) => hear(payload),
                Ok(None) => return,
                Err(_) => self.0 = None,
            }
        }
    }
}

/// What is followed of one robot.
#[derive(Default)]
struct Feeds {
    gateway: Watch<GatewayHealth>,
    estimator: Watch<EstimatorHealth>,
    names: TopicFeed<Description>,
    samples: TopicFeed<Sample>,
    torques: TopicFeed<TorqueEstimate>,
    contacts: TopicFeed<ContactEstimate>,
    inertia: TopicFeed<InertiaEstimate>,
}

struct Follower<'a> {
    config: &'a DomainConfig,
    wanted: Option<String>,
    domain: Option<Domain>,
    feeds: Feeds,
    snapshot: RobotState,
}

impl Follower<'_> {
    /// Looks for what has come or gone.
    fn poll(&mut self) {
        if self.domain.as_ref().is_some_and(|it| !it.is_intact()) {
            // Gateway and estimator make a damaged domain again.
            (self.feeds, self.snapshot) = (Feeds::default(), RobotState::default());
            self.domain = None;
        }
        if self.domain.is_none() {
            match open(self.config) {
                Ok(domain) => self.domain = Some(domain),
                Err(error) => self.snapshot.trouble = format!("waiting: {error}"),
            }
        }
        let Some(domain) = &self.domain else { return };
        let robots: Vec<String> = domain.robot_names().into_iter().collect();
        let robot = self.wanted.clone().or_else(|| robots.first().cloned());
        if robot != self.snapshot.robot {
            (self.feeds, self.snapshot) = (Feeds::default(), RobotState::default());
        }
        let trouble = &mut self.snapshot.trouble;
        trouble.clear();
        match &robot {
            None => "waiting: there is no robot in the domain".clone_into(trouble),
            Some(robot) if !robots.contains(robot) => {
                *trouble = match robots.is_empty() {
                    true => format!("waiting: nobody publishes robot {robot:?}"),
                    false => {
                        let names = robots.join(", ");
                        format!("waiting: there is no robot {robot:?}; there is {names}")
                    }
                }
            }
            Some(robot) => {
                let feeds = &mut self.feeds;
                feeds.names.open(domain, robot, trouble);
                feeds.samples.open(domain, robot, trouble);
                feeds.torques.open(domain, robot, trouble);
                feeds.contacts.open(domain, robot, trouble);
                feeds.inertia.open(domain, robot, trouble);
                // The first robot is not another one when others come.
                self.wanted = Some(robot.clone());
            }
        }
        (self.snapshot.robot, self.snapshot.robots) = (robot, robots);
    }

    /// Takes what has come.
    fn take(&mut self) {
        let (feeds, snapshot) = (&mut self.feeds, &mut self.snapshot);
        feeds.names.take(|names| snapshot.describe(names));
        feeds.samples.take(|sample| snapshot.sample(&sample));
        feeds.torques.take(|torques| snapshot.hear_torques(torques));
        (feeds.contacts).take(|contacts| snapshot.hear_contacts(contacts));
        feeds.inertia.take(|inertia| snapshot.hear_inertia(inertia));
    }

    /// How the daemons are.
    fn watch(&mut self, now: Nanos) {
        let RobotState {
            robot: Some(robot),
            gateway,
            estimator,
            ..
        } = &mut self.snapshot
        else {
            return;
        };
        let (Some(domain), feeds) = (&self.domain, &mut self.feeds) else {
            return;
        };
        gateway.0 = feeds.gateway.poll(domain, robot, now);
        gateway.1 = feeds.gateway.newest().map(|it| Arc::new(*it));
        estimator.0 = feeds.estimator.poll(domain, robot, now);
        estimator.1 = feeds.estimator.newest().map(|it| Arc::new(*it));
    }
}

/// Follows a robot, that of the name that came last in `wanted`, until nobody can send one any
/// more. `out` gets what is known, about ten times a second, unless the one before still waits.
pub(super) fn follow(
    config: &DomainConfig,
    robot: Option<String>,
    wanted: &Receiver<String>,
    out: &SyncSender<RobotState>,
) {
    let mut follower = Follower {
        config,
        wanted: robot,
        domain: None,
        feeds: Feeds::default(),
        snapshot: RobotState::default(),
    };
    let (mut next_poll, mut next_show) = (Nanos::MIN, Nanos::MIN);
    loop {
        let now = monotonic();
        if now >= next_poll {
            next_poll = now + POLL_PERIOD;
            follower.poll();
        }
        follower.take();
        if now >= next_show {
            next_show = now + SHOW;
            let now = monotonic();
            follower.watch(now);
            follower.snapshot.tick(now);
            let _ = out.try_send(follower.snapshot.clone());
        }
        match wanted.recv_timeout(TURN) {
            Ok(name) => (follower.wanted, next_poll) = (Some(name), Nanos::MIN),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}
