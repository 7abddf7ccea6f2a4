//! A black box: the last seconds in memory, written to a file when something happens.
//!
//! A torque that was valid and is withheld, a sensor or device that reports a fault, a bus that is
//! lost, a daemon that ends: the file is written a while later, so that it has what followed. The
//! next one is written when the memory is full of new seconds, or when `proprio ctl snapshot` asks
//! for it.

use anyhow::Context;
use proprio_bridge::Heard;
use proprio_drivers::Frame;
use proprio_estimator::files;
use proprio_gateway::clock::realtime_offset;
use proprio_gateway::control;
use proprio_recording::{About, Ring, RingSnapshot, WriteError};
use proprio_topics::csv::{Series, Value};
use proprio_topics::ipc::DomainConfig;
use proprio_topics::{DeviceState, LinkState, Nanos, Quality};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};

/// How long after its cause a file is written, at most: it has what followed.
const AFTER: Nanos = Nanos::from_millis(5000);
/// If nothing comes any more, it is written so long after that.
const LATEST: Nanos = Nanos::from_millis(4000);
/// So many files are kept: the oldest of this run are deleted.
const KEPT: usize = 20;
/// Samples without a torque for so long: the estimator has ended or hangs.
const SILENCE: Nanos = Nanos::from_millis(1000);
/// The flags of a reading that are a fault.
const FAULTS: Quality = Quality(
    Quality::FROZEN.0
        | Quality::DEVICE_FAULT.0
        | Quality::DRIVE_FAULT.0
        | Quality::ZERO_CHANGED.0
        | Quality::IMPLAUSIBLE.0,
);

/// What happened, for the name of a file.
type Why = String;

/// The last seconds, and what they are watched for.
pub(super) struct BlackBox {
    ring: Ring,
    folder: PathBuf,
    robot: String,
    duration: Nanos,
    control: control::RecorderSocket,
    asking: Option<control::Asking>,
    faults: Faults,
    /// When a file is due, and why.
    due: Option<(Nanos, Why)>,
    /// The newest instant that is held.
    newest: Nanos,
    /// The next file is written no sooner, so that it has new seconds alone.
    next: Nanos,
    /// The files of this run that are there.
    written: Arc<Mutex<VecDeque<PathBuf>>>,
    writing: Vec<JoinHandle<()>>,
}

impl BlackBox {
    pub(super) fn new(
        about: About,
        series: &[Series],
        duration: Nanos,
        folder: &Path,
        domain: &DomainConfig,
    ) -> anyhow::Result<Self> {
        let robot = about.robot.clone();
        let others = control::running(domain, control::Server::Recorder)?;
        if others.contains(&robot) {
            anyhow::bail!("another recorder with --ring runs for {robot}: one is enough");
        }
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        Ok(Self {
            ring: Ring::new(about, series, duration)?,
            folder: folder.to_owned(),
            control: control::RecorderSocket::open(domain, &robot)
                .context("the socket for `proprio ctl snapshot` cannot be made")?,
            asking: None,
            robot,
            duration,
            faults: Faults::default(),
            due: None,
            newest: Nanos::MIN,
            next: Nanos::MIN,
            written: Arc::default(),
            writing: Vec::new(),
        })
    }

    pub(super) fn push(
        &mut self,
        t: Nanos,
        heard: &Heard,
        series: &[Series],
    ) -> Result<(), WriteError> {
        let recorder = self.ring.at(t)?;
        recorder.know(series)?;
        recorder.say(t, heard)?;
        recorder.each_second(t)?;
        self.newest = self.newest.max(t);
        if let Some(why) = self.faults.new_in(t, heard, series) {
            self.happened(t, why);
        }
        Ok(())
    }

    /// Something happened at `t`: a file is written when what followed is held, too.
    pub(super) fn happened(&mut self, t: Nanos, why: Why) {
        if self.due.is_none() {
            tracing::warn!("{why}: the last seconds are written soon");
            let after = t + AFTER.min(Nanos(self.duration.0 / 4));
            // What happened just after a file was written is still held when the next is.
            self.due = Some((after.max(self.next), why));
        }
    }

    pub(super) fn frame(&mut self, bus: &str, frame: &Frame) -> Result<(), WriteError> {
        self.ring.at(frame.t)?.frame(bus, frame)
    }

    /// Whether a client asks for a file: what waits to be sorted should be pushed before
    /// [`BlackBox::turn`] writes it.
    pub(super) fn is_asked(&mut self) -> bool {
        if self.asking.is_none() {
            self.asking = self.control.asked();
        }
        self.asking.is_some()
    }

    /// Writes what is due at `now`, and what is asked for.
    pub(super) fn turn(&mut self, now: Nanos, series: &[Series]) -> io::Result<()> {
        self.ring.set_offset(realtime_offset());
        let newest = self.newest;
        let is_due = |at: Nanos| newest >= at || now >= at + LATEST;
        if let Some((at, why)) = self.due.take_if(|(at, _)| is_due(*at)) {
            self.next = at + self.duration;
            self.write(now, &why, series, None)?;
        }
        if let Some(client) = self.asking.take() {
            self.write(now, "asked", series, Some(client))?;
        }
        Ok(())
    }

    /// Has a thread write a file, which tells `client` its name: samples go on to be read here.
    fn write(
        &mut self,
        now: Nanos,
        why: &str,
        series: &[Series],
        client: Option<control::Asking>,
    ) -> io::Result<()> {
        let wall = now.saturating_add(realtime_offset()).0;
        let time = jiff::Timestamp::from_nanosecond(wall.into()).map_err(io::Error::other)?;
        let time = time.strftime("%Y%m%dT%H%M%S%.3fZ");
        let is_word = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        let why: String = (why.chars().map(|c| if is_word(c) { c } else { '_' })).collect();
        let path = self
            .folder
            .join(format!("{}_{time}_{why}.mcap", self.robot));
        let snapshot = self.ring.snapshot(series).map_err(io::Error::other)?;
        let all = Arc::clone(&self.written);
        let writing = thread::Builder::new()
            .name("snapshot".into())
            .spawn(move || {
                let written = write(&snapshot, &path);
                let written = written
                    .map_err(|error| format!("{}: cannot be written: {error}", path.display()));
                match &written {
                    Ok(()) => tracing::info!("{} is written", path.display()),
                    Err(error) => tracing::error!("{error}"),
                }
                if written.is_ok() {
                    keep(&all, path.clone());
                }
                if let Some(client) = client {
                    let file = written.as_ref().map(|()| path.as_path());
                    client.answer(file.map_err(String::as_str));
                }
            })?;
        self.writing.retain(|thread| !thread.is_finished());
        self.writing.push(writing);
        Ok(())
    }

    /// Writes what is due, though not all that followed has come, and waits for the files that are
    /// being written; returns their number.
    pub(super) fn finish(&mut self, now: Nanos, series: &[Series]) -> io::Result<usize> {
        if let Some((_, why)) = self.due.take() {
            self.write(now, &why, series, None)?;
        }
        for thread in self.writing.drain(..) {
            let _ = thread.join();
        }
        Ok(self.written.lock().map_or(0, |written| written.len()))
    }

    /// The memory that the last seconds take \[bytes\].
    pub(super) fn memory(&self) -> usize {
        self.ring.memory()
    }
}

/// Writes a file: it has its name when it is complete, and outlives a loss of power then.
fn write(snapshot: &RingSnapshot, path: &Path) -> io::Result<()> {
    let file = BufWriter::new(files::begin(path)?);
    let file = snapshot.write(file).map_err(io::Error::other)?;
    files::end(file.into_inner()?, path, 0o644)
}

/// Adds a file to those that are there; the oldest is deleted if there are enough.
fn keep(written: &Mutex<VecDeque<PathBuf>>, path: PathBuf) {
    let Ok(mut written) = written.lock() else {
        return;
    };
    written.push_back(path);
    if written.len() > KEPT
        && let Some(oldest) = written.pop_front()
    {
        let _ = fs::remove_file(oldest);
    }
}

/// What is wrong at present.
#[derive(Default)]
struct Faults {
    valid: BTreeMap<usize, bool>,
    readings: BTreeMap<usize, Quality>,
    health: BTreeSet<String>,
    /// The newest torques, until it was told that none come any more.
    torques: Option<Nanos>,
}

impl Faults {
    /// What has become wrong with this, heard at `t`.
    fn new_in(&mut self, t: Nanos, heard: &Heard, series: &[Series]) -> Option<Why> {
        match heard {
            Heard::Value(..)
                if self
                    .torques
                    .take_if(|newest| t - *newest > SILENCE)
                    .is_some() =>
            {
                Some("estimator-silent".to_owned())
            }
            Heard::Value(number, Value::Reading(_, quality)) => {
                let now = Quality(quality.0 & FAULTS.0);
                let before = self.readings.insert(*number, now).unwrap_or(Quality::GOOD);
                let is_new = now.0 & !before.0 != 0;
                let name = series.get(*number).map_or("?", |one| one.name.as_str());
                is_new.then(|| format!("{name}-{now}"))
            }
            Heard::Torques(torques, names) => {
                self.torques = Some(t);
                let mut why = None;
                for (number, joint) in torques.joints().iter().enumerate() {
                    let is_valid = joint.valid == 1;
                    if self.valid.insert(number, is_valid) == Some(true) && !is_valid {
                        let index = u32::try_from(number).unwrap_or(u32::MAX);
                        let entry = names.find(proprio_topics::Role::Joint, index);
                        let name = entry.map_or("?", |entry| entry.name.as_str());
                        let reason = joint.reason.get().map_or("?", |reason| reason.word());
                        why.get_or_insert_with(|| format!("{name}-{reason}"));
                    }
                }
                why
            }
            Heard::Gateway(health) => {
                let buses = health.buses().iter().filter_map(|bus| {
                    let state = bus.link.get().unwrap_or_default();
                    let is_lost = !matches!(state, LinkState::Up | LinkState::Ended);
                    is_lost.then(|| format!("{}-{}", bus.name.as_str(), state.word()))
                });
                let devices = health.devices().iter().filter_map(|device| {
                    let state = device.state.get().unwrap_or_default();
                    let is_lost = matches!(state, DeviceState::Silent | DeviceState::Refused);
                    is_lost.then(|| format!("{}-{}", device.name.as_str(), state.word()))
                });
                let now: BTreeSet<String> = buses.chain(devices).collect();
                let new = now.difference(&self.health).next().cloned();
                self.health = now;
                new
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::csv::SeriesKind;
    use proprio_topics::{
        BusHealth, Description, Entry, GatewayHealth, Header, JointState, JointTorque, Kind,
        MAX_JOINTS, Name, Publisher, Reading, Reason, Role, TorqueEstimate,
    };
    use std::rc::Rc;

    /// Each thing that becomes wrong is told once, until it is right again.
    #[test]
    fn what_becomes_wrong_is_told_once() {
        let series = [Series {
            kind: SeriesKind::Channel(Kind::Joint),
            name: "elbow".to_owned(),
        }];
        let name = |text: &str| Name::new(text).unwrap();
        let reading = |quality| {
            let reading = Reading::Joint(JointState::ABSENT);
            Heard::Value(0, Value::Reading(reading, quality))
        };
        let torque = |reason: Reason| {
            let mut joints = [JointTorque::ABSENT; MAX_JOINTS];
            joints[0].valid = u32::from(reason == Reason::None);
            joints[0].reason = reason.in_memory();
            let entry = Entry {
                name: name("elbow"),
                role: Role::Joint.in_memory(),
                ..Entry::NONE
            };
            let estimate = TorqueEstimate {
                header: Header::default(),
                count: 1,
                reserved: 0,
                joints,
            };
            let names = Description::new(Publisher::Estimator, [entry]);
            Heard::Torques(Box::new(estimate), Rc::new(names))
        };
        let bus = |state: LinkState| {
            let mut health = GatewayHealth::new(Nanos::ZERO);
            health.bus_count = 1;
            health.buses[0] = BusHealth {
                name: name("can0"),
                link: state.in_memory(),
                ..BusHealth::EMPTY
            };
            Heard::Gateway(Box::new(health))
        };
        let mut faults = Faults::default();
        for (heard, expected) in [
            (reading(Quality::GOOD), None),
            (reading(Quality::SATURATED), None),
            (reading(Quality::FROZEN), Some("elbow-frozen")),
            (reading(Quality::FROZEN), None),
            (reading(Quality::GOOD), None),
            (reading(Quality::FROZEN), Some("elbow-frozen")),
            (torque(Reason::NeverSeen), None),
            (torque(Reason::None), None),
            (torque(Reason::Stale), Some("elbow-stale")),
            (torque(Reason::Frozen), None),
            (bus(LinkState::Up), None),
            (bus(LinkState::Down), Some("can0-down")),
            (bus(LinkState::Down), None),
            (bus(LinkState::BusOff), Some("can0-bus_off")),
        ] {
            let found = faults.new_in(Nanos::ZERO, &heard, &series);
            assert_eq!(found.as_deref(), expected, "{heard:?}");
        }
        // The estimator ends while samples go on.
        let at = |ms| Nanos::from_millis(ms);
        let mut hear = |ms, heard: &Heard| faults.new_in(at(ms), heard, &series);
        assert_eq!(hear(5_000, &torque(Reason::Frozen)), None);
        let reading = reading(Quality::FROZEN);
        assert_eq!(hear(6_000, &reading), None);
        assert_eq!(hear(6_001, &reading).as_deref(), Some("estimator-silent"));
        assert_eq!(hear(9_000, &reading), None);
    }
}
