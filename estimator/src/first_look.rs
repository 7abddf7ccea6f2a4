//! Looks at what the daemon receives for what can not be ([`crate::identify::implausible`]), and says
//! it: in the first minutes, when somebody who set up the robot reads the log.
//!
//! The data plane copies samples into room that was made before it began, and hands that over when
//! [`WINDOW`] is full; a thread looks, and gives the room back for the next window. The data plane
//! never waits for it.

use crate::identify::implausible;
use crate::setup::Setup;
use anyhow::Context;
use proprio_topics::csv::{Columns, Series, Value, What, Writer};
use proprio_topics::{Nanos, Quality, Reading};
use std::collections::BTreeSet;
use std::sync::mpsc;

/// How much of the samples is looked at at once: the units and signs of a robot that moves show in it.
const WINDOW: Nanos = Nanos::from_millis(20_000);
/// From the beginning of one to that of the next; and how many, for a robot that does not move at first.
const EVERY: Nanos = Nanos::from_millis(60_000);
const WINDOWS: u32 = 10;
/// Of each channel samples further apart than this are enough.
const APART: Nanos = Nanos::from_millis(8);

/// What was received: its number among [`Setup::channels`] and, after these, [`Setup::contacts`].
type Seen = (usize, Nanos, Value);

/// The data plane's end.
pub(crate) struct FirstLook {
    room: Option<Vec<Seen>>,
    /// When the window at hand began, and per channel when its last sample was taken.
    began: Option<Nanos>,
    last: Vec<Nanos>,
    full: mpsc::SyncSender<Vec<Seen>>,
    empty: mpsc::Receiver<Vec<Seen>>,
}

impl FirstLook {
    /// Makes the room and starts the thread, which ends with this.
    pub(crate) fn start(setup: &Setup) -> anyhow::Result<Self> {
        let channels = setup.channels().len();
        let most = usize::try_from(WINDOW.0 / APART.0).unwrap_or(0);
        let (full, windows) = mpsc::sync_channel::<Vec<Seen>>(1);
        let (back, empty) = mpsc::sync_channel(1);
        let setup = setup.as_configured();
        let look = move || {
            let mut told = BTreeSet::new();
            for _ in 0..WINDOWS {
                let Ok(mut window) = windows.recv() else { return };
                for text in findings(&setup, &mut window) {
                    if told.insert(text.clone()) {
                        tracing::warn!("{text}");
                    }
                }
                window.clear();
                if back.send(window).is_err() {
                    return;
                }
            }
        };
        std::thread::Builder::new()
            .name("first look".into())
            .spawn(look)
            .context("cannot start a thread")?;
        Ok(Self {
            room: Some(Vec::with_capacity(most * channels)),
            began: None,
            last: vec![Nanos::MIN; channels],
            full,
            empty,
        })
    }

    /// Takes a sample, if it is time for it.
    pub(crate) fn see(&mut self, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        let Some(last) = self.last.get_mut(channel) else { return };
        // Stamps may jump back, with the boards' clocks.
        if *last == Nanos::MIN || t < *last || t - *last >= APART {
            *last = t;
            self.take(channel, t, Value::Reading(*reading, quality));
        }
    }

    /// Takes what was said of a contact.
    pub(crate) fn declare(&mut self, contact: usize, t: Nanos, active: bool) {
        self.take(self.last.len() + contact, t, Value::Active(active));
    }

    fn take(&mut self, number: usize, t: Nanos, value: Value) {
        let began = *self.began.get_or_insert(t);
        if self.room.is_none() {
            if t - began < EVERY {
                return;
            }
            // Gone for good after the last window.
            self.room = self.empty.try_recv().ok();
            self.began = Some(t);
        }
        if let Some(room) = self.room.as_mut().filter(|room| room.len() < room.capacity()) {
            room.push((number, t, value));
        }
        if t - self.began.unwrap_or(t) >= WINDOW
            && let Some(room) = self.room.take()
        {
            let _ = self.full.try_send(room);
        }
    }
}

/// What in a window can not be.
fn findings(setup: &Setup, window: &mut [Seen]) -> Vec<String> {
    window.sort_by_key(|(_, t, ..)| *t);
    let channels = setup.channels().iter();
    let channels = channels.map(|channel| (What::Channel(channel.kind), channel.name.as_str()));
    let contacts = setup.contact_names().map(|name| (What::Contact, name));
    let series: Vec<Series> = channels
        .chain(contacts)
        .map(|(what, name)| Series {
            what,
            name: name.to_owned(),
        })
        .collect();
    // As if it had been recorded: no other way of reading it could differ from identification's.
    let table = || -> std::io::Result<Vec<u8>> {
        let mut writer = Writer::new(Vec::new(), &series, Columns::Main)?;
        for (number, t, value) in &*window {
            writer.push(Some(*t), *number, value)?;
        }
        writer.finish()
    };
    // A channel that is missing has been told of by the data plane.
    let found = table().ok().and_then(|table| implausible(setup, &table[..]).ok());
    found.into_iter().flatten().map(|finding| finding.text).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use proprio_topics::csv::{Item, Reader, Row};
    use std::path::Path;

    /// The samples of a recorded session, as they would be received; forces and torques `by` so many
    /// times, all of it moved by `later`.
    fn received(setup: &Setup, by: f64, later: Nanos) -> Vec<Seen> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/oracle/sessions");
        let log = std::fs::read_to_string(folder.join("train.csv")).expect("a session");
        let mut reader = Reader::new(log.as_bytes()).expect("a log");
        let series: Vec<Option<usize>> = reader
            .series()
            .iter()
            .map(|series| match series.what {
                What::Channel(kind) => setup.channel(kind, &series.name),
                What::Contact => None,
            })
            .collect();
        let (mut row, mut seen) = (Row::default(), Vec::new());
        while reader.next_row(&mut row).expect("a row") {
            for Item { series: number, value } in &row.items {
                if let (Some(channel), Value::Reading(reading, quality), Some(t)) = (series[*number], value, row.t) {
                    let mut reading = *reading;
                    if let Reading::Wrench(wrench) = &mut reading {
                        wrench.force = wrench.force.map(|x| by * x);
                        wrench.torque = wrench.torque.map(|x| by * x);
                    }
                    seen.push((channel, t + later, Value::Reading(reading, *quality)));
                }
            }
        }
        seen
    }

    fn setup() -> Setup {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/oracle/sessions");
        let mut config = Config::load(&folder.join("estimator.toml")).expect("a configuration");
        config.contact.last_mut().expect("the hand").presence = crate::config::Presence::Possible;
        Setup::new(&config).expect("it fits")
    }

    #[test]
    fn a_sensor_the_wrong_way_round_is_said_of_a_window() {
        let setup = setup();
        let texts = |by: f64| findings(&setup, &mut received(&setup, by, Nanos::ZERO));
        assert_eq!(texts(1.0), Vec::<String>::new());
        let [text] = &texts(-1.0)[..] else {
            panic!("{:?}", texts(-1.0))
        };
        assert!(
            text.contains("l_arm_ft_sensor fits only with its sign turned"),
            "{text}"
        );
        // Buses are read one after the other.
        let mut mixed = received(&setup, -1.0, Nanos::ZERO);
        mixed.sort_by_key(|(channel, ..)| *channel);
        assert_eq!(findings(&setup, &mut mixed), texts(-1.0));
    }

    #[test]
    fn windows_are_taken_a_minute_apart_without_another_allocation() {
        let (mut look, full, empty) = {
            let (full, windows) = mpsc::sync_channel(1);
            let (back, empty) = mpsc::sync_channel(1);
            let look = FirstLook {
                room: Some(Vec::with_capacity(100_000)),
                began: None,
                last: vec![Nanos::MIN; 2],
                full,
                empty,
            };
            (look, windows, back)
        };
        let reading = Reading::Wrench(proprio_topics::Wrench {
            force: [0.0; 3],
            torque: [0.0; 3],
        });
        // Two channels, one of them a thousand times a second.
        let mut run = |from: u32, to: u32| {
            for k in 1000 * from..1000 * to {
                let t = Nanos::from_millis(i64::from(k) + 5_000);
                look.see(0, t, &reading, Quality::default());
                if k % 10 == 0 {
                    look.see(1, t, &reading, Quality::default());
                }
            }
        };
        run(0, 30);
        let window = full.try_recv().expect("a window");
        let of = |channel: usize| window.iter().filter(|(own, ..)| *own == channel).count();
        assert_eq!((of(0), of(1)), (2501, 2000));
        assert_eq!((window.capacity(), window[0].1), (100_000, Nanos::from_millis(5_000)));
        // The next minute; not before the room is back.
        let mut window = window;
        window.clear();
        empty.send(window).expect("room");
        run(30, 79);
        assert!(full.try_recv().is_err());
        run(79, 82);
        let window = full.try_recv().expect("another");
        assert!(
            (window[0].1 - Nanos::from_millis(65_000)).0.abs() < 1_000_000,
            "{:?}",
            window[0].1
        );
    }
}
