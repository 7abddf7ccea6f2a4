//! The descriptions of a publisher, over its restarts, and the payloads that wait for a reader.

use proprio_topics::ipc::{Domain, PortError, Reader, TakeError, Topic, monotonic};
use proprio_topics::{Description, Nanos, Publisher};

/// A description or health message is sent again to a new reader within this time.
const HISTORY: Nanos = Nanos::from_millis(500);
/// How often it is looked for: nothing tells of a payload that is sent again.
const LOOK: Nanos = Nanos::from_millis(5);

/// The next payload; `None` if none is waiting, or its writer cannot be reached now.
///
/// # Errors
/// Those of [`Reader::try_take`] but [`TakeError::Connection`].
pub fn next<T: Topic>(reader: &mut Reader<T>) -> Result<Option<T>, TakeError> {
    match reader.try_take() {
        Err(TakeError::Connection) => Ok(None),
        taken => taken,
    }
}

/// A reader of a topic with history, and the first that `take` finds in it; `None` if nobody
/// publishes it.
///
/// # Errors
/// The topic cannot be read.
pub fn first_of<T: Topic, R>(
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
pub struct DescriptionReader {
    reader: Reader<Description>,
    publisher: Publisher,
    newest: Description,
}

impl DescriptionReader {
    /// Those of `publisher`; `None` if it does not run.
    ///
    /// # Errors
    /// They cannot be read.
    pub fn by(
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

    /// Those of `publisher`, without waiting for the first one.
    ///
    /// # Errors
    /// They cannot be read.
    pub fn to_come(domain: &Domain, robot: &str, publisher: Publisher) -> Result<Self, PortError> {
        Ok(Self {
            reader: Reader::open(domain, robot)?,
            publisher,
            newest: Description::new(publisher, []),
        })
    }

    /// The newest one; without entries if none has come.
    #[must_use]
    pub const fn newest(&self) -> &Description {
        &self.newest
    }

    /// That of the publisher's start `epoch`; `None` if it has not come yet.
    pub fn of(&mut self, epoch: u64) -> Option<&Description> {
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
