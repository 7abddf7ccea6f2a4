//! What the verbs that read a running system share: its domain, its robot, the descriptions of its
//! publishers, and when to end.

use anyhow::{Context, bail};
use proprio_topics::ipc::{Domain, DomainConfig, PortError, Reader, TakeError, Topic, monotonic};
use proprio_topics::{Description, Nanos, Publisher};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// A description or health message is sent again to a new reader within this time.
const HISTORY: Nanos = Nanos::from_millis(500);
/// How often it is looked for: nothing tells of a payload that is sent again.
const LOOK: Nanos = Nanos::from_millis(5);

/// Set by SIGINT and SIGTERM.
pub(crate) fn interrupted() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    Ok(stop)
}

/// Opens the domain for reading; the error names the domains that there are.
pub(crate) fn open(config: &DomainConfig) -> anyhow::Result<Domain> {
    Domain::open_existing(config).map_err(|error| {
        let siblings = config.siblings();
        match siblings.is_empty() {
            true => error.into(),
            false => anyhow::Error::new(error)
                .context(format!("the domains here are {}", siblings.join(", "))),
        }
    })
}

/// The name of the robot to read: the named one, or the only one. Whether it runs is not asked:
/// that takes a second.
pub(crate) fn one_robot(domain: &Domain, name: Option<&str>) -> anyhow::Result<String> {
    let names: Vec<String> = domain.robot_names().into_iter().collect();
    match (name, names.as_slice()) {
        (_, []) => bail!("there is no robot in the domain"),
        (None, [only]) => Ok(only.clone()),
        (None, _) => bail!(
            "there are several robots: name one with --robot: {}",
            names.join(", ")
        ),
        (Some(name), _) if names.iter().any(|known| known == name) => Ok(name.to_owned()),
        (Some(name), _) => bail!("there is no robot {name:?}; there is {}", names.join(", ")),
    }
}

/// The next payload; `None` if none is waiting, or its writer cannot be reached now.
pub(crate) fn next<T: Topic>(reader: &mut Reader<T>) -> anyhow::Result<Option<T>> {
    match reader.try_take() {
        Err(TakeError::Connection) => Ok(None),
        taken => Ok(taken?),
    }
}

/// A reader of a topic with history, and the first that `take` finds in it; `None` if nobody
/// publishes it.
pub(crate) fn first_of<T: Topic, R>(
    domain: &Domain,
    robot: &str,
    mut take: impl FnMut(&mut Reader<T>) -> Option<R>,
) -> Result<Option<(Reader<T>, R)>, PortError> {
    let mut reader = match Reader::<T>::open(domain, robot) {
        Ok(reader) => reader,
        Err(PortError::NotYet { .. }) => return Ok(None),
        Err(error) => return Err(error),
    };
    let deadline = monotonic() + HISTORY;
    loop {
        if let Some(found) = take(&mut reader) {
            return Ok(Some((reader, found)));
        }
        if monotonic() >= deadline {
            return Ok(None);
        }
        reader.wait(monotonic() + LOOK);
    }
}

/// The descriptions of one publisher, over its restarts.
pub(crate) struct Described {
    reader: Reader<Description>,
    publisher: Publisher,
    newest: Description,
}

impl Described {
    /// Those of `publisher`; `None` if it does not run.
    pub(crate) fn by(
        domain: &Domain,
        robot: &str,
        publisher: Publisher,
    ) -> Result<Option<Self>, PortError> {
        let found = first_of(domain, robot, |reader| take_newest(reader, publisher))?;
        Ok(found.map(|(reader, newest)| Self {
            reader,
            publisher,
            newest,
        }))
    }

    /// The newest one.
    pub(crate) const fn newest(&self) -> &Description {
        &self.newest
    }

    /// That of the publisher's start `epoch`; `None` if it has not come yet.
    pub(crate) fn of(&mut self, epoch: u64) -> Option<&Description> {
        if self.newest.header.epoch != epoch
            && let Some(newest) = take_newest(&mut self.reader, self.publisher)
        {
            self.newest = newest;
        }
        (self.newest.header.epoch == epoch).then_some(&self.newest)
    }
}

/// The newest description of `publisher` that waits.
fn take_newest(reader: &mut Reader<Description>, publisher: Publisher) -> Option<Description> {
    let mut newest = None;
    while let Ok(Some(description)) = reader.try_take() {
        if description.publisher == publisher {
            newest = Some(description);
        }
    }
    newest
}
