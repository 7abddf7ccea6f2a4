//! `proprio record`: the samples and declared contacts of a running system, as the table that
//! `identify` reads.

use crate::running::{Described, interrupted, next, one_robot, open};
use anyhow::{Context, bail};
use proprio_gateway::clock::realtime_offset;
use proprio_gateway::offline::InOrder;
use proprio_recording::Recorder;
use proprio_topics::csv::{Columns, Series, Value, What, Writer};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, monotonic};
use proprio_topics::{
    ContactDeclaration, ContactEstimate, Description, MAX_CHANNELS, Nanos, Publisher, Role, Sample,
    TorqueEstimate,
};
use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::atomic::Ordering::Relaxed;

/// How late a sample is still sorted into its place in a recording: a gateway that starts publishes
/// the frames that arrived meanwhile.
const REORDER: Nanos = Nanos::from_millis(2000);

/// The file that is written: a table, or a recording that viewers read too.
enum Output {
    Table(Writer<BufWriter<File>>),
    Recording(Box<Recorder<BufWriter<File>>>),
}

/// What is recorded, in the order of time.
enum Item {
    Value(usize, Value),
    Torques(Box<TorqueEstimate>, Rc<Description>),
    Contacts(Box<ContactEstimate>, Rc<Description>),
}

impl Output {
    fn push(&mut self, t: Nanos, item: &Item) -> io::Result<()> {
        match (self, item) {
            (Self::Table(table), Item::Value(series, value)) => table.push(Some(t), *series, value),
            (Self::Table(_), _) => Ok(()),
            (Self::Recording(recorder), item) => match item {
                Item::Value(series, value) => recorder.push(t, *series, value),
                Item::Torques(torques, names) => recorder.torques(names, torques),
                Item::Contacts(contacts, names) => recorder.contacts(names, contacts),
            }
            .map_err(io::Error::other),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Table(table) => table.flush(),
            Self::Recording(recorder) => recorder.flush().map_err(io::Error::other),
        }
    }

    fn finish(self) -> io::Result<()> {
        match self {
            Self::Table(table) => table.finish().map(drop),
            Self::Recording(recorder) => {
                let mut file = recorder.finish().map_err(io::Error::other)?;
                file.flush()
            }
        }
    }
}

/// What an estimator sends, for a recording.
struct Estimates {
    torques: Reader<TorqueEstimate>,
    contacts: Reader<ContactEstimate>,
    names: Described,
    known: Option<Rc<Description>>,
}

impl Estimates {
    /// Those of the robot's estimator; `None` if it does not run.
    fn of(domain: &Domain, robot: &str) -> Option<Self> {
        Some(Self {
            torques: Reader::open(domain, robot).ok()?,
            contacts: Reader::open(domain, robot).ok()?,
            names: Described::by(domain, robot, Publisher::Estimator).ok()??,
            known: None,
        })
    }

    /// Takes what has come; returns how many torques.
    fn take(&mut self, order: &mut InOrder<Item>, out: &mut Output) -> anyhow::Result<u64> {
        let mut count = 0;
        while let Some(torques) = next(&mut self.torques)? {
            if let Some(names) = self.names_of(torques.header.epoch) {
                let (t, item) = (
                    torques.header.acquired,
                    Item::Torques(Box::new(torques), names),
                );
                order.push(t, item, |t, item| out.push(t, item))?;
                count += 1;
            }
        }
        while let Some(contacts) = next(&mut self.contacts)? {
            if let Some(names) = self.names_of(contacts.header.epoch) {
                let t = contacts.header.acquired;
                let item = Item::Contacts(Box::new(contacts), names);
                order.push(t, item, |t, item| out.push(t, item))?;
            }
        }
        Ok(count)
    }

    /// The names of this start of the estimator, if they have come.
    fn names_of(&mut self, epoch: u64) -> Option<Rc<Description>> {
        if (self.known.as_ref()).is_none_or(|known| known.header.epoch != epoch) {
            self.known = self.names.of(epoch).map(|names| Rc::new(*names));
        }
        self.known.clone()
    }
}

/// `proprio record`.
#[derive(clap::Args)]
pub(crate) struct Record {
    /// The table of samples: a new file. One that ends with .mcap is a recording of samples,
    /// torques and contacts, which Foxglove, PlotJuggler and `identify` read
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Overwrite the file if it exists
    #[arg(long)]
    force: bool,
    /// The robot; default: the only one
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// End after so many seconds; default: at Ctrl-C
    #[arg(long, value_name = "N")]
    seconds: Option<f64>,
    /// Write all columns, such as gauges and temperatures, not only those that the estimator reads
    #[arg(long)]
    all: bool,
}

/// The channels of a gateway.
fn channels_of(description: &Description) -> Vec<Series> {
    let channels = description
        .entries()
        .iter()
        .filter(|e| e.role == Role::Channel);
    channels
        .filter_map(|entry| {
            Some(Series {
                what: What::Channel(entry.kind.get()?),
                name: entry.name.as_str().to_owned(),
            })
        })
        .collect()
}

/// The series of each channel number of one run of the gateway.
struct Numbers {
    epoch: u64,
    series: Vec<Option<usize>>,
}

impl Numbers {
    fn new(description: &Description, series: &[Series]) -> Self {
        let mut numbers = vec![None; MAX_CHANNELS];
        for entry in description.entries() {
            let what = entry.kind.get().map(What::Channel);
            if entry.role == Role::Channel
                && let Some(number) = numbers.get_mut(entry.index as usize)
            {
                *number = series
                    .iter()
                    .position(|one| Some(one.what) == what && one.name == entry.name.as_str());
            }
        }
        Self {
            epoch: description.header.epoch,
            series: numbers,
        }
    }

    fn series(&self, sample: &Sample) -> Option<usize> {
        let series = self.series.get(sample.channel as usize).copied().flatten();
        series.filter(|_| sample.header.epoch == self.epoch)
    }
}

/// Creates the file of a recording. An existing one is overwritten only if that is asked for; what
/// is no file, such as a pipe, has nothing to lose.
fn create(path: &Path, force: bool) -> anyhow::Result<File> {
    let special = std::fs::metadata(path).is_ok_and(|m| !m.is_file());
    let created = match force || special {
        true => File::create(path),
        false => File::create_new(path),
    };
    match created {
        Err(error) if error.kind() == ErrorKind::AlreadyExists => bail!(
            "{} exists: name another file, or overwrite it with --force",
            path.display()
        ),
        created => created.with_context(|| path.display().to_string()),
    }
}

/// A time without samples.
struct Gap {
    from: Nanos,
    to: Nanos,
    restarted: bool,
}

impl Gap {
    fn seconds(&self) -> f64 {
        (self.to - self.from).seconds()
    }
}

/// Finds the times without samples.
struct Gaps {
    /// Longer than between two samples of the slowest channel.
    silence: Nanos,
    /// The start of the gateway that sends, and the stamp of its newest sample.
    last: Option<(u64, Nanos)>,
    found: Vec<Gap>,
    /// That nothing comes has been told.
    told: bool,
}

impl Gaps {
    fn new(description: &Description) -> Self {
        let slowest = description.entries().iter().map(|entry| entry.max_silence);
        let slowest = slowest.max().unwrap_or_default();
        Self {
            silence: Nanos::from_millis(500).max(slowest + slowest),
            last: None,
            found: Vec::new(),
            told: false,
        }
    }

    /// A sample of the start `epoch` of the gateway, acquired at `t`.
    fn see(&mut self, epoch: u64, t: Nanos) {
        if let Some((of, from)) = self.last {
            let gap = Gap {
                from,
                to: t,
                restarted: epoch != of,
            };
            if gap.restarted || t - from > self.silence {
                let why = match gap.restarted {
                    true => "the gateway was restarted",
                    false => "no channel had a sample",
                };
                tracing::warn!("{why}: a gap of {:.3} s after {from} s", gap.seconds());
                self.found.push(gap);
            }
        }
        let newest = self
            .last
            .filter(|(of, _)| *of == epoch)
            .map_or(t, |(_, last)| last.max(t));
        (self.last, self.told) = (Some((epoch, newest)), false);
    }

    /// Nothing came until `now`: tells it, once.
    fn wait(&mut self, now: Nanos) {
        if let Some((_, last)) = self.last
            && now - last > self.silence
            && !std::mem::replace(&mut self.told, true)
        {
            tracing::warn!(
                "no samples since {last} s; recording goes on when they come (`proprio status`)"
            );
        }
    }

    /// What to say of them when the recording ends at `end`; empty if there are none.
    fn summary(&self, end: Nanos) -> String {
        let seconds = |gaps: &mut dyn Iterator<Item = &Gap>| gaps.map(Gap::seconds).sum::<f64>();
        let mut parts = Vec::new();
        let restarts = || self.found.iter().filter(|gap| gap.restarted);
        let others = || self.found.iter().filter(|gap| !gap.restarted);
        if restarts().count() > 0 {
            let (count, time) = (restarts().count(), seconds(&mut restarts()));
            parts.push(format!("{count} restarts of the gateway ({time:.3} s)"));
        }
        if others().count() > 0 {
            let (count, time) = (others().count(), seconds(&mut others()));
            parts.push(format!("{count} silences of all channels ({time:.3} s)"));
        }
        match self.last {
            Some((_, last)) if end - last > self.silence => {
                parts.push(format!("none in the last {:.3} s", (end - last).seconds()));
            }
            _ => {}
        }
        match parts.is_empty() {
            true => String::new(),
            false => format!("times without samples: {}", parts.join(", ")),
        }
    }
}

/// The gateway's description, which names its channels.
fn gateway_of(domain: &Domain, robot: &str) -> anyhow::Result<Described> {
    Described::by(domain, robot, Publisher::Gateway)?.context("the robot's gateway is not running")
}

/// Records samples and declared contacts.
pub(crate) fn run(args: &Record, config: &DomainConfig) -> anyhow::Result<()> {
    let stop = interrupted()?;
    let mut domain = open(config)?;
    let robot = one_robot(&domain, args.robot.as_deref())?;
    // The readers first: what comes while the table is prepared is recorded, too.
    let mut samples = Reader::<Sample>::open(&domain, &robot)?;
    let mut declarations = Reader::<ContactDeclaration>::open(&domain, &robot).ok();
    let mut gateway = gateway_of(&domain, &robot)?;
    let description = *gateway.newest();
    let estimator = Described::by(&domain, &robot, Publisher::Estimator)?;
    let estimator = estimator.as_ref().map(Described::newest);
    let mut series = channels_of(&description);
    for contact in estimator.into_iter().flat_map(Description::entries) {
        if contact.role == Role::Contact {
            series.push(Series {
                what: What::Contact,
                name: contact.name.as_str().to_owned(),
            });
        }
    }
    let mut numbers = Numbers::new(&description, &series);
    let columns = match args.all {
        true => Columns::All,
        false => Columns::Main,
    };
    let file = create(&args.out, args.force)?;
    let mut gaps = Gaps::new(&description);
    let file = BufWriter::new(file);
    let is_recording = args
        .out
        .extension()
        .is_some_and(|extension| extension == "mcap");
    let mut out = match is_recording {
        true => {
            let program = concat!("proprio ", env!("CARGO_PKG_VERSION"));
            Output::Recording(Box::new(Recorder::new(
                file,
                &robot,
                program,
                &series,
                realtime_offset(),
            )?))
        }
        false => Output::Table(Writer::new(file, &series, columns)?),
    };
    let (mut estimates, mut estimate_count): (Option<Estimates>, u64) = (None, 0);
    let (mut order, mut inbox) = (InOrder::<Item>::new(REORDER), Vec::new());
    let began = monotonic();
    let end = args
        .seconds
        .map(|seconds| began + Nanos::from_seconds(seconds));
    let (mut count, mut others, mut lost, mut next_flush) = (0_u64, 0_u64, 0_u64, began);
    while !stop.load(Relaxed) && end.is_none_or(|end| monotonic() < end) {
        while let Some(declared) = declarations.as_mut().map_or(Ok(None), next)? {
            let contact = Series {
                what: What::Contact,
                name: declared.contact.as_str().to_owned(),
            };
            let Some(at) = series.iter().position(|one| *one == contact) else {
                others += 1;
                continue;
            };
            let value = Value::Contact(declared.state());
            // What was declared long before arrives with the next declaration.
            let t = declared.header.acquired.max(order.passed_on());
            order.push(t, Item::Value(at, value), |t, item| out.push(t, item))?;
        }
        // Shared memory delivers all samples of one bus before those of the next.
        while let Some(sample) = next(&mut samples)? {
            inbox.push(sample);
        }
        inbox.sort_by_key(|sample| sample.header.acquired);
        for sample in inbox.drain(..) {
            gaps.see(sample.header.epoch, sample.header.acquired);
            if sample.header.epoch != numbers.epoch
                && let Some(description) = gateway.of(sample.header.epoch)
            {
                // The gateway was restarted: the same channels may have other numbers.
                numbers = Numbers::new(description, &series);
            }
            let (Some(at), Some(reading)) = (numbers.series(&sample), sample.reading()) else {
                others += 1;
                continue;
            };
            count += 1;
            let value = Value::Reading(reading, sample.header.quality);
            let t = sample.header.acquired;
            order.push(t, Item::Value(at, value), |t, item| out.push(t, item))?;
        }
        if let Some(estimates) = &mut estimates {
            estimate_count += estimates.take(&mut order, &mut out)?;
        }
        let now = monotonic();
        if now >= next_flush {
            if is_recording && estimates.is_none() {
                estimates = Estimates::of(&domain, &robot);
            }
            // If this program is killed, the rows of the last moments are lost, not the table.
            next_flush = now + Nanos::from_millis(500);
            out.flush()?;
            // Gateway and estimator make a damaged domain again; until they have, nothing comes.
            if !domain.is_intact()
                && let Ok(new) = open(config)
                && let Ok(described) = gateway_of(&new, &robot)
                && let Ok(reader) = Reader::open(&new, &robot)
            {
                lost += samples.lost();
                (samples, gateway) = (reader, described);
                declarations = Reader::open(&new, &robot).ok();
                estimates = None;
                domain = new;
            }
        }
        gaps.wait(now);
        samples.wait((now + Nanos::from_millis(100)).min(end.unwrap_or(Nanos::MAX)));
    }
    order.finish(|t, item| out.push(t, item))?;
    out.finish()?;
    print_line!(
        "{}: {count} samples in {:.1} s, {} lost, {} out of order",
        args.out.display(),
        (monotonic() - began).seconds(),
        lost + samples.lost(),
        order.out_of_order()
    );
    if is_recording {
        print_line!("{estimate_count} estimates of torques");
    }
    let without = gaps.summary(monotonic());
    if !without.is_empty() {
        print_line!("{without}");
    }
    if others > 0 {
        print_line!(
            "{others} samples and declarations are not in the table: they are of channels or \
             contacts that were not there when the recording began"
        );
    }
    Ok(())
}
