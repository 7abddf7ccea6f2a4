//! Tests the first samples that the daemon receives for implausible readings
//! ([`proprio_identification::implausible`]), and reports these in the log: in the first minutes,
//! when the person who set up the robot reads it.
//!
//! The data plane copies samples into a preallocated buffer, and hands it over after a [`WINDOW`].
//! A thread tests the window and returns the buffer for the next one. The data plane never waits
//! for the thread.

use crate::setup::Setup;
use anyhow::Context;
use proprio_identification::{Dataset, Finding, LogRole, Recording, Robot, implausible};
use proprio_topics::csv::Value;
use proprio_topics::{ContactState, Nanos, Quality, Reading};
use std::collections::BTreeSet;
use std::sync::mpsc;

/// Length of a window: enough to show the units and signs of a moving robot.
const WINDOW: Nanos = Nanos::from_millis(20_000);
/// Time from the start of one window to the start of the next.
const PERIOD: Nanos = Nanos::from_millis(60_000);
/// Number of windows: the robot may not move at first.
const WINDOWS: u32 = 10;
/// Smallest interval between the samples that are copied of a channel.
const MIN_INTERVAL: Nanos = Nanos::from_millis(8);

/// A sample or declaration: its number (channels first, then contacts), stamp and value.
type Received = (usize, Nanos, Value);

/// The data plane's side.
pub(crate) struct FirstLook {
    buffer: Option<Vec<Received>>,
    /// The start of the present or last window.
    began: Option<Nanos>,
    /// The stamp of each channel's last sample.
    last: Vec<Nanos>,
    /// The last declaration of each contact, which is still valid in the next window.
    declared: Vec<Option<bool>>,
    full: mpsc::SyncSender<Vec<Received>>,
    empty: mpsc::Receiver<Vec<Received>>,
}

impl FirstLook {
    /// Allocates the buffer and starts the thread, which ends when this is dropped.
    pub(crate) fn start(setup: &Setup) -> anyhow::Result<Self> {
        let channels = setup.robot.channels.len();
        let most = usize::try_from(WINDOW.0 / MIN_INTERVAL.0).unwrap_or(0);
        let (full, windows) = mpsc::sync_channel::<Vec<Received>>(1);
        let (returned, empty) = mpsc::sync_channel(1);
        let mut configured = setup.robot.clone();
        // Skipped samples must not count as silence.
        configured.max_silence = configured.max_silence.max(MIN_INTERVAL + MIN_INTERVAL);
        let watch = move || {
            let mut reported = BTreeSet::new();
            for window_number in 1..=WINDOWS {
                let Ok(mut window) = windows.recv() else {
                    return;
                };
                for Finding {
                    code,
                    subject,
                    text,
                    ..
                } in findings(&configured, &mut window)
                {
                    if reported.insert((code, subject)) {
                        tracing::warn!("{text}");
                    }
                }
                window.clear();
                // The buffer of the last window is freed: without it no more samples are taken.
                if window_number < WINDOWS && returned.send(window).is_err() {
                    return;
                }
            }
        };
        std::thread::Builder::new()
            .name("first look".into())
            .spawn(watch)
            .context("cannot start a thread")?;
        Ok(Self {
            buffer: Some(Vec::with_capacity(
                most * channels + setup.robot.contact_names().count(),
            )),
            began: None,
            last: vec![Nanos::MIN; channels],
            declared: vec![None; setup.robot.contact_names().count()],
            full,
            empty,
        })
    }

    /// Takes a sample received at `now`, by the daemon's clock, if the interval has passed.
    pub(crate) fn see(
        &mut self,
        now: Nanos,
        channel: usize,
        t: Nanos,
        reading: &Reading,
        quality: Quality,
    ) {
        // Other readings of a channel, such as motor currents, are ignored.
        let is_main = matches!(
            reading,
            Reading::Joint(_) | Reading::Wrench(_) | Reading::Imu(_)
        );
        let Some(last) = self.last.get_mut(channel).filter(|_| is_main) else {
            return;
        };
        // Stamps may jump back, with the boards' clocks.
        if *last == Nanos::MIN || t < *last || t - *last >= MIN_INTERVAL {
            *last = t;
            self.take(now, (channel, t, Value::Reading(*reading, quality)));
        }
    }

    /// The stamp of a channel's newest sample, to within [`MIN_INTERVAL`]; `None` before the first.
    pub(crate) fn newest(&self, channel: usize) -> Option<Nanos> {
        self.last.get(channel).copied().filter(|t| *t > Nanos::MIN)
    }

    /// Takes a declaration of a contact at `now`.
    pub(crate) fn declare(&mut self, now: Nanos, contact: usize, t: Nanos, active: bool) {
        let Some(declared) = self.declared.get_mut(contact) else {
            return;
        };
        // Only changes: a program may repeat its declaration a thousand times a second.
        if declared.replace(active) != Some(active) {
            let value = Value::Contact(ContactState::configured(active));
            self.take(now, (self.last.len() + contact, t, value));
        }
    }

    fn take(&mut self, now: Nanos, received: Received) {
        let began = *self.began.get_or_insert(now);
        if self.buffer.is_none() && now - began >= PERIOD {
            self.buffer = self.empty.try_recv().ok();
            self.began = Some(now);
            let (first, t) = (self.last.len(), received.1);
            for (contact, declared) in self.declared.iter().enumerate() {
                if let (Some(active), Some(buffer)) = (declared, &mut self.buffer) {
                    let value = Value::Contact(ContactState::configured(*active));
                    buffer.push((first + contact, t, value));
                }
            }
        }
        if let Some(buffer) = self
            .buffer
            .as_mut()
            .filter(|buffer| buffer.len() < buffer.capacity())
        {
            buffer.push(received);
        }
        if now - self.began.unwrap_or(now) >= WINDOW
            && let Some(buffer) = self.buffer.take()
        {
            let _ = self.full.try_send(buffer);
        }
    }
}

/// The implausible readings of a window.
fn findings(robot: &Robot, window: &mut [Received]) -> Vec<Finding> {
    window.sort_by_key(|(_, t, ..)| *t);
    let mut recording = Recording::new(robot);
    for (number, t, value) in &*window {
        match value {
            Value::Reading(reading, quality) => recording.push(*number, *t, reading, *quality),
            Value::Contact(state) => {
                recording.declare(number - robot.channels.len(), *t, state.active);
            }
        }
    }
    recording.set_rows(window.len() as u64, None);
    // A missing channel is reported by the data plane.
    let dataset = Dataset::new(robot, "", LogRole::Validate, recording);
    dataset.map_or_else(|_| Vec::new(), |dataset| implausible(robot, dataset))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use proprio_identification::FindingCode;
    use proprio_topics::csv::{Row, SeriesKind, SeriesValue, TableReader};
    use std::path::Path;

    /// The samples of a recorded session, as they would be received; forces and torques multiplied
    /// with `by`.
    fn received(setup: &Setup, by: f64) -> Vec<Received> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/oracle/sessions");
        let log = std::fs::read_to_string(folder.join("train.csv")).expect("a session");
        let mut reader = TableReader::new(log.as_bytes()).expect("a log");
        let series: Vec<Option<usize>> = reader
            .series()
            .iter()
            .map(|series| match series.kind {
                SeriesKind::Channel(kind) => setup.robot.channel(kind, &series.name),
                SeriesKind::Contact => None,
            })
            .collect();
        let (mut row, mut seen) = (Row::default(), Vec::new());
        while reader.next_row(&mut row).expect("a row") {
            for SeriesValue {
                series: number,
                value,
            } in &row.items
            {
                if let (Some(channel), Value::Reading(reading, quality), Some(t)) =
                    (series[*number], value, row.t)
                {
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
        config.contact.last_mut().expect("the hand").presence = crate::config::Occurrence::Possible;
        Setup::new(&config).expect("it fits")
    }

    #[test]
    fn a_wrong_measurement_direction_is_found_in_a_window() {
        let setup = setup();
        let found = |by: f64| findings(&setup.robot, &mut received(&setup, by));
        assert_eq!(found(1.0), Vec::<Finding>::new());
        let [finding] = &found(-1.0)[..] else {
            panic!("{:?}", found(-1.0))
        };
        assert_eq!(
            (finding.code, finding.subject.as_str()),
            (FindingCode::WrongSign, "l_arm_ft_sensor")
        );
        // Buses are read one after the other.
        let mut mixed = received(&setup, -1.0);
        mixed.sort_by_key(|(channel, ..)| *channel);
        assert_eq!(findings(&setup.robot, &mut mixed), found(-1.0));
    }

    #[test]
    fn windows_are_taken_a_minute_apart_without_another_allocation() {
        let (mut look, full, empty) = {
            let (full, windows) = mpsc::sync_channel(1);
            let (returned, empty) = mpsc::sync_channel(1);
            let first_look = FirstLook {
                buffer: Some(Vec::with_capacity(100_000)),
                began: None,
                last: vec![Nanos::MIN; 2],
                declared: vec![None; 1],
                full,
                empty,
            };
            (first_look, windows, returned)
        };
        let reading = Reading::Wrench(proprio_topics::Wrench {
            force: [0.0; 3],
            torque: [0.0; 3],
        });
        // Two channels, one of them a thousand times a second.
        let mut run = |from: u32, to: u32| {
            for k in 1000 * from..1000 * to {
                let t = Nanos::from_millis(i64::from(k) + 5_000);
                // The boards have another clock.
                let now = t + Nanos::from_millis(7_000_000);
                // Its board sends its temperature as often, before the wrench.
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
        let count = |channel: usize| window.iter().filter(|(own, ..)| *own == channel).count();
        assert_eq!((count(0), count(1), count(2)), (2501, 2000, 1));
        assert_eq!(
            (window.capacity(), window[0].1),
            (100_000, Nanos::from_millis(5_000))
        );
        // The next minute, but not before the buffer is returned.
        let mut window = window;
        window.clear();
        empty.send(window).expect("room");
        run(30, 79);
        assert!(full.try_recv().is_err());
        run(79, 82);
        let window = full.try_recv().expect("another");
        let began = (window[0].1 - Nanos::from_millis(65_000)).0.abs();
        assert!(began < 1_000_000, "{:?}", window[0]);
        // The declaration of the first window is still valid.
        assert!(
            matches!(
                window[0],
                (2, _, Value::Contact(ContactState { active: true, .. }))
            ),
            "{:?}",
            window[0]
        );
        assert_eq!(window.iter().filter(|(own, ..)| *own == 2).count(), 1);
        assert!(
            window
                .iter()
                .all(|(.., value)| !matches!(value, Value::Reading(Reading::Temperature(_), _)))
        );
    }
}
