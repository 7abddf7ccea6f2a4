//! Reads health, estimates and samples from shared memory, as any consumer does, and the
//! simulator's truth for comparison.

use crate::{PATIENCE, now, until};
use proprio_estimator::offline::EstimateTable;
use proprio_estimator::pipeline::Estimate;
use proprio_estimator::setup::Setup;
use proprio_topics::csv::{self, Columns, Series, SeriesKind, Value};
use proprio_topics::ipc::{Domain, Reader, Topic};
use proprio_topics::{
    BusHealth, ContactEstimate, Counter, DeviceHealth, Kind, Nanos, Reading, Sample, TorqueEstimate,
};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Write};
use std::path::Path;

/// Opens a topic of `robot` as soon as it exists.
///
/// # Panics
/// If it does not exist within [`PATIENCE`].
#[must_use]
pub fn open<T: Topic>(domain: &Domain, robot: &str) -> Reader<T> {
    let end = now() + PATIENCE;
    let opened = Reader::wait_open(domain, robot, |_| {
        std::thread::sleep(std::time::Duration::from_millis(1));
        now() < end
    });
    opened.unwrap_or_else(|error| panic!("{error}"))
}

/// Keeps the newest payload of a topic.
pub struct Newest<T: Topic> {
    reader: Reader<T>,
    last: Option<T>,
}

impl<T: Topic> Newest<T> {
    /// Opens the topic as soon as it exists.
    #[must_use]
    pub fn open(domain: &Domain, robot: &str) -> Self {
        Self {
            reader: open(domain, robot),
            last: None,
        }
    }

    /// The newest payload, if any.
    ///
    /// # Panics
    /// If shared memory cannot be read.
    pub fn get(&mut self) -> Option<&T> {
        if let Some(newest) = self.reader.latest().expect("shared memory can be read") {
            self.last = Some(newest);
        }
        self.last.as_ref()
    }

    /// Waits at most `limit` until the newest payload fulfils `condition`.
    pub fn within(&mut self, limit: Nanos, mut condition: impl FnMut(&T) -> bool) -> Option<T> {
        until(limit, || {
            self.get().filter(|value| condition(value)).copied()
        })
    }

    /// Waits until the newest payload fulfils `condition`.
    ///
    /// # Panics
    /// After [`PATIENCE`]; the message contains `what` was expected.
    pub fn wait(&mut self, what: &str, condition: impl FnMut(&T) -> bool) -> T {
        let found = self.within(PATIENCE, condition);
        found.unwrap_or_else(|| panic!("never: {what}; the last: {:?}", self.last))
    }

    /// A payload published from now on.
    ///
    /// # Panics
    /// If none is.
    pub fn fresh(&mut self) -> T {
        let from = now();
        self.wait("a new one", |value| value.header().published >= from)
    }
}

/// The bus called `name`.
///
/// # Panics
/// If there is none.
#[must_use]
pub fn bus<'a>(buses: &'a [BusHealth], name: &str) -> &'a BusHealth {
    buses
        .iter()
        .find(|b| b.name.as_str() == name)
        .unwrap_or_else(|| panic!("no bus {name:?} in the health"))
}

/// The value of `counter` of a device.
#[must_use]
pub fn count(device: &DeviceHealth, counter: Counter) -> u64 {
    device.counters[counter as usize]
}

/// Whether every torque is valid.
#[must_use]
pub fn all_valid(estimate: &TorqueEstimate) -> bool {
    estimate.count > 0 && estimate.joints().iter().all(|joint| joint.valid == 1)
}

/// Waits for an estimate of an instant after `since` in which every torque is valid; `None` if
/// there is none within `limit` from now.
///
/// # Panics
/// If shared memory cannot be read.
pub fn valid_since(
    torques: &mut Reader<TorqueEstimate>,
    since: Nanos,
    limit: Nanos,
) -> Option<TorqueEstimate> {
    until(limit, || {
        while let Some(estimate) = torques.try_take().expect("shared memory can be read") {
            if estimate.header.acquired > since && all_valid(&estimate) {
                return Some(estimate);
            }
        }
        None
    })
}

/// Records everything that gateway and estimator publish.
pub struct Recorder {
    samples: Option<Reader<Sample>>,
    torques: Option<Reader<TorqueEstimate>>,
    contacts: Option<Reader<ContactEstimate>>,
    /// The samples, in order of arrival.
    pub taken: Vec<Sample>,
    /// The estimates by their instants.
    pub estimates: BTreeMap<Nanos, Estimate>,
}

impl Recorder {
    /// Records the samples of `robot`.
    #[must_use]
    pub fn of_samples(domain: &Domain, robot: &str) -> Self {
        Self {
            samples: Some(open(domain, robot)),
            torques: None,
            contacts: None,
            taken: Vec::new(),
            estimates: BTreeMap::new(),
        }
    }

    /// Records the samples and the estimates of `robot`.
    #[must_use]
    pub fn of_all(domain: &Domain, robot: &str) -> Self {
        let (torques, contacts) = (Some(open(domain, robot)), Some(open(domain, robot)));
        Self {
            torques,
            contacts,
            ..Self::of_samples(domain, robot)
        }
    }

    /// Takes the waiting payloads; call it at least once a second.
    ///
    /// # Panics
    /// If shared memory cannot be read.
    pub fn take(&mut self) {
        fn next<T: Topic>(reader: &mut Option<Reader<T>>) -> Option<T> {
            reader
                .as_mut()?
                .try_take()
                .expect("shared memory can be read")
        }
        while let Some(sample) = next(&mut self.samples) {
            self.taken.push(sample);
        }
        while let Some(torques) = next(&mut self.torques) {
            self.estimate(torques.header.acquired).torques = torques;
        }
        while let Some(contacts) = next(&mut self.contacts) {
            self.estimate(contacts.header.acquired).contacts = contacts;
        }
    }

    fn estimate(&mut self, t: Nanos) -> &mut Estimate {
        self.estimates
            .entry(t)
            .or_insert_with(|| Estimate::absent(t))
    }

    /// The number of payloads lost.
    #[must_use]
    pub fn lost(&self) -> u64 {
        let samples = self.samples.as_ref().map_or(0, Reader::lost);
        let torques = self.torques.as_ref().map_or(0, Reader::lost);
        samples + torques + self.contacts.as_ref().map_or(0, Reader::lost)
    }

    /// The samples as text per channel number, in order, without their stamps: the reading,
    /// exactly, and its quality.
    #[must_use]
    pub fn by_channel(&self) -> BTreeMap<u32, Vec<String>> {
        let mut channels: BTreeMap<u32, Vec<String>> = BTreeMap::new();
        for sample in &self.taken {
            channels
                .entry(sample.channel)
                .or_default()
                .push(exact(&sample.reading().unwrap(), sample.header.quality));
        }
        channels
    }

    /// Writes the main readings as a table of samples in order of their stamps, for `proprio
    /// estimate`.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write_samples(&self, channels: &[(Kind, String)], file: &Path) {
        let series: Vec<Series> = channels
            .iter()
            .map(|(kind, name)| Series {
                kind: SeriesKind::Channel(*kind),
                name: name.clone(),
            })
            .collect();
        let out = File::create(file).expect("a file in a temporary folder");
        let mut writer =
            csv::TableWriter::new(out, &series, Columns::Main).expect("a table can be written");
        let mut samples: Vec<&Sample> = self
            .taken
            .iter()
            .filter(|s| is_main(&s.reading().unwrap()))
            .collect();
        samples.sort_by_key(|s| s.header.acquired);
        for sample in samples {
            let value = Value::Reading(sample.reading().unwrap(), sample.header.quality);
            let pushed = writer.push(
                Some(sample.header.acquired),
                sample.channel as usize,
                &value,
            );
            pushed.expect("a table can be written");
        }
        writer
            .finish()
            .expect("a table can be written")
            .flush()
            .expect("a table can be written");
    }

    /// The estimates as `proprio estimate` writes them: one row each, by their stamps as text; the
    /// header under `t`.
    ///
    /// # Panics
    /// Never: it writes to memory.
    #[must_use]
    pub fn estimate_rows(&self, setup: &Setup) -> BTreeMap<String, String> {
        let mut table = EstimateTable::new(Vec::new(), setup).expect("memory can be written");
        for estimate in self.estimates.values() {
            table
                .write(estimate, None, true)
                .expect("memory can be written");
        }
        rows(&String::from_utf8(table.into_inner()).expect("a table is text"))
    }
}

fn is_main(reading: &Reading) -> bool {
    matches!(
        reading,
        Reading::Joint(_) | Reading::Wrench(_) | Reading::Imu(_)
    )
}

/// The rows of a table by their first cell.
#[must_use]
pub fn rows(table: &str) -> BTreeMap<String, String> {
    let row = |line: &str| Some((line.split(',').next()?.to_owned(), line.to_owned()));
    table.lines().filter_map(row).collect()
}

/// A reading and its quality as text that differs whenever a bit of them does.
fn exact(reading: &Reading, quality: proprio_topics::Quality) -> String {
    format!("{reading:?} {:#x}", quality.0)
}

/// The contents of a table of samples per channel name, in order, as in [`Recorder::by_channel`].
///
/// # Panics
/// If it is not a table of samples.
#[must_use]
pub fn table_by_channel(file: &Path) -> BTreeMap<String, Vec<String>> {
    let mut reader = csv::TableReader::new(BufReader::new(File::open(file).expect("the table")))
        .expect("a table");
    let names: Vec<String> = reader.series().iter().map(|s| s.name.clone()).collect();
    let mut channels: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut row = csv::Row::default();
    while reader.next_row(&mut row).expect("a table with rows") {
        for item in &row.items {
            if let Value::Reading(reading, quality) = &item.value {
                channels
                    .entry(names[item.series].clone())
                    .or_default()
                    .push(exact(reading, *quality));
            }
        }
    }
    assert_eq!(reader.report().bad_rows, 0, "{:?}", reader.report());
    channels
}

/// The simulator's truth: joint torques over time.
pub struct Truth {
    t: Vec<Nanos>,
    torques: Vec<Vec<f64>>,
}

impl Truth {
    /// Reads the output of `proprio simulate --truth` for `joints`.
    ///
    /// # Panics
    /// If it is not such a table.
    #[must_use]
    pub fn read(file: &Path, joints: &[&str]) -> Self {
        let mut reader =
            csv::TableReader::new(BufReader::new(File::open(file).expect("the truth")))
                .expect("a table");
        let series: Vec<usize> = joints
            .iter()
            .map(|j| {
                let found = reader
                    .series()
                    .iter()
                    .position(|s| s.kind == SeriesKind::Channel(Kind::Joint) && s.name == *j);
                found.unwrap_or_else(|| panic!("the truth has no joint {j}"))
            })
            .collect();
        let mut this = Self {
            t: Vec::new(),
            torques: vec![Vec::new(); joints.len()],
        };
        let mut row = csv::Row::default();
        while reader.next_row(&mut row).expect("a table with rows") {
            this.t.push(row.t.expect("a stamp"));
            for (torques, series) in this.torques.iter_mut().zip(&series) {
                let torque = row.items.iter().find_map(|item| match item.value {
                    Value::Reading(Reading::Joint(state), _) if item.series == *series => {
                        Some(state.torque)
                    }
                    _ => None,
                });
                torques.push(torque.expect("a torque"));
            }
        }
        this
    }

    /// The torque of joint `joint` at `t`, interpolated linearly; `None` outside the table.
    #[must_use]
    pub fn torque(&self, joint: usize, t: Nanos) -> Option<f64> {
        let after = self.t.partition_point(|x| *x < t).max(1);
        let (t0, t1) = (*self.t.get(after - 1)?, *self.t.get(after)?);
        let (y0, y1) = (self.torques[joint][after - 1], self.torques[joint][after]);
        (t >= t0).then(|| y0 + (y1 - y0) * ((t - t0).seconds() / (t1 - t0).seconds()))
    }

    /// The errors of joint `joint` in those of `estimates` that are within the truth's time \[Nm\].
    #[must_use]
    pub fn errors<'a>(
        &self,
        joint: usize,
        estimates: impl Iterator<Item = &'a TorqueEstimate>,
    ) -> Vec<f64> {
        let error = |estimate: &TorqueEstimate| {
            let right = self.torque(joint, estimate.header.acquired)?;
            Some(estimate.joints().get(joint)?.torque - right)
        };
        estimates.filter_map(error).collect()
    }
}
