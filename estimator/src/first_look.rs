//! Looks at what the daemon receives for what can not be ([`crate::identify::implausible`]), and
//! says it: in the first minutes, when somebody who set up the robot reads the log.
//!
//! The data plane copies samples into room that was made before it began, and hands that over when
//! [`WINDOW`] is full; a thread looks, and gives the room back for the next window. The data plane
//! never waits for it.

use crate::identify::{Finding, implausible};
use crate::setup::Setup;
use anyhow::Context;
use proprio_topics::csv::{Columns, Series, Value, What, Writer};
use proprio_topics::{Nanos, Quality, Reading};
use std::collections::BTreeSet;
use std::sync::mpsc;

/// How much of the samples is looked at at once: units and signs of a robot that moves show in it.
const WINDOW: Nanos = Nanos::from_millis(20_000);
/// From the beginning of one to that of the next; and how many: a robot may not move at first.
const EVERY: Nanos = Nanos::from_millis(60_000);
const WINDOWS: u32 = 10;
/// Of each channel samples further apart than this are enough.
const APART: Nanos = Nanos::from_millis(8);

/// What was received: its number among [`Setup::channels`] and, after these, [`Setup::contacts`].
type Seen = (usize, Nanos, Value);

/// The data plane's end.
pub(crate) struct FirstLook {
    room: Option<Vec<Seen>>,
    /// When the window at hand, or the last one, began; and the stamp of each channel's last sample.
    began: Option<Nanos>,
    last: Vec<Nanos>,
    /// What was said last of each contact, which holds in the next window, too.
    said: Vec<Option<bool>>,
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
        let mut configured = setup.as_configured();
        // Samples are left out: that is no silence.
        configured.max_silence = configured.max_silence.max(APART + APART);
        let look = move || {
            let mut told = BTreeSet::new();
            for window_number in 1..=WINDOWS {
                let Ok(mut window) = windows.recv() else { return };
                for Finding {
                    code, subject, text, ..
                } in findings(&configured, &mut window)
                {
                    if told.insert((code, subject)) {
                        tracing::warn!("{text}");
                    }
                }
                window.clear();
                // The last one's room is freed here: without it nothing more is taken.
                if window_number < WINDOWS && back.send(window).is_err() {
                    return;
                }
            }
        };
        std::thread::Builder::new()
            .name("first look".into())
            .spawn(look)
            .context("cannot start a thread")?;
        Ok(Self {
            room: Some(Vec::with_capacity(most * channels + setup.contact_names().count())),
            began: None,
            last: vec![Nanos::MIN; channels],
            said: vec![None; setup.contact_names().count()],
            full,
            empty,
        })
    }

    /// Takes a sample that is received at `now`, by the daemon's clock, if it is time for it.
    pub(crate) fn see(&mut self, now: Nanos, channel: usize, t: Nanos, reading: &Reading, quality: Quality) {
        // Of a channel that also tells currents, say, only its motion is looked at.
        let is_main = matches!(reading, Reading::Joint(_) | Reading::Wrench(_) | Reading::Imu(_));
        let Some(last) = self.last.get_mut(channel).filter(|_| is_main) else {
            return;
        };
        // Stamps may jump back, with the boards' clocks.
        if *last == Nanos::MIN || t < *last || t - *last >= APART {
            *last = t;
            self.take(now, (channel, t, Value::Reading(*reading, quality)));
        }
    }

    /// Takes what is said of a contact at `now`.
    pub(crate) fn declare(&mut self, now: Nanos, contact: usize, t: Nanos, active: bool) {
        let Some(said) = self.said.get_mut(contact) else { return };
        // Whoever declares may do so a thousand times a second.
        if said.replace(active) != Some(active) {
            self.take(now, (self.last.len() + contact, t, Value::Active(active)));
        }
    }

    fn take(&mut self, now: Nanos, seen: Seen) {
        let began = *self.began.get_or_insert(now);
        if self.room.is_none() && now - began >= EVERY {
            self.room = self.empty.try_recv().ok();
            self.began = Some(now);
            let (first, t) = (self.last.len(), seen.1);
            for (contact, said) in self.said.iter().enumerate() {
                if let (Some(active), Some(room)) = (said, &mut self.room) {
                    room.push((first + contact, t, Value::Active(*active)));
                }
            }
        }
        if let Some(room) = self.room.as_mut().filter(|room| room.len() < room.capacity()) {
            room.push(seen);
        }
        if now - self.began.unwrap_or(now) >= WINDOW
            && let Some(room) = self.room.take()
        {
            let _ = self.full.try_send(room);
        }
    }
}

/// What in a window can not be.
fn findings(setup: &Setup, window: &mut [Seen]) -> Vec<Finding> {
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
    found.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use proprio_topics::csv::{Item, Reader, Row};
    use std::path::Path;

    /// The samples of a recorded session, as they would be received; forces and torques `by` so many
    /// times.
    fn received(setup: &Setup, by: f64) -> Vec<Seen> {
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
                    seen.push((channel, t, Value::Reading(reading, *quality)));
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
        let of = |by: f64| findings(&setup, &mut received(&setup, by));
        assert_eq!(of(1.0), Vec::<Finding>::new());
        let [finding] = &of(-1.0)[..] else {
            panic!("{:?}", of(-1.0))
        };
        assert_eq!(
            (finding.code, finding.subject.as_str()),
            ("wrong_sign", "l_arm_ft_sensor")
        );
        // Buses are read one after the other.
        let mut mixed = received(&setup, -1.0);
        mixed.sort_by_key(|(channel, ..)| *channel);
        assert_eq!(findings(&setup, &mut mixed), of(-1.0));
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
                said: vec![None; 1],
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
                // The boards' clock is another.
                let now = t + Nanos::from_millis(7_000_000);
                // Its board tells its temperature as often, before it.
                look.see(
                    now,
                    0,
                    t,
                    &Reading::Temperature(proprio_topics::Temperature { celsius: 30.0 }),
                    Quality::default(),
                );
                look.see(now, 0, t, &reading, Quality::default());
                if k % 10 == 0 {
                    look.see(now, 1, t, &reading, Quality::default());
                }
                if k < 1000 {
                    look.declare(now, 0, t, true);
                }
            }
        };
        run(0, 30);
        let window = full.try_recv().expect("a window");
        let of = |channel: usize| window.iter().filter(|(own, ..)| *own == channel).count();
        assert_eq!((of(0), of(1), of(2)), (2501, 2000, 1));
        assert_eq!((window.capacity(), window[0].1), (100_000, Nanos::from_millis(5_000)));
        // The next minute; not before the room is back.
        let mut window = window;
        window.clear();
        empty.send(window).expect("room");
        run(30, 79);
        assert!(full.try_recv().is_err());
        run(79, 82);
        let window = full.try_recv().expect("another");
        let began = (window[0].1 - Nanos::from_millis(65_000)).0.abs();
        assert!(began < 1_000_000, "{:?}", window[0]);
        // What was said of a contact in the first one still holds.
        assert!(matches!(window[0], (2, _, Value::Active(true))), "{:?}", window[0]);
        assert_eq!(window.iter().filter(|(own, ..)| *own == 2).count(), 1);
        assert!(
            window
                .iter()
                .all(|(.., value)| !matches!(value, Value::Reading(Reading::Temperature(_), _)))
        );
    }
}
