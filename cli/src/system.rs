//! `proprio status`, `echo` and `record`: what a running system does, from shared memory alone.

use anyhow::{Context, bail};
use proprio_gateway::offline::InOrder;
use proprio_topics::csv::{Columns, Series, Value, What, Writer};
use proprio_topics::ipc::{
    Domain, DomainConfig, PortError, Reader, RobotPresence, Topic, monotonic,
};
use proprio_topics::{
    ContactDeclaration, Controller, Counter, Description, DeviceState, EstimatorHealth,
    GatewayHealth, Kind, LinkState, MAX_CHANNELS, Nanos, Publisher, Quality, Role, Sample, axes,
};
use serde_json::{Value as Json, json};
use std::fs::File;
use std::io::BufWriter;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;

/// How long `status` counts samples and estimates.
const WINDOW: Nanos = Nanos::from_millis(1000);
/// A description or health message is sent again to a new reader within this time.
const HISTORY: Nanos = Nanos::from_millis(500);

/// How late a sample is still sorted into its place in a recording: a gateway that starts publishes
/// the frames that arrived meanwhile.
const REORDER: Nanos = Nanos::from_millis(2000);

/// `proprio status`.
#[derive(clap::Args)]
pub(crate) struct Status {
    /// Show only this robot
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// Print as JSON, one object
    #[arg(long)]
    json: bool,
    /// Show again every second until interrupted
    #[arg(long)]
    watch: bool,
}

/// `proprio echo`.
#[derive(clap::Args)]
pub(crate) struct Echo {
    /// The channel: the name of a joint or sensor
    channel: String,
    /// The robot; default: the only one
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// End after so many samples
    #[arg(long, value_name = "N")]
    count: Option<u64>,
    /// Print each sample as a JSON object
    #[arg(long)]
    json: bool,
}

/// `proprio record`.
#[derive(clap::Args)]
pub(crate) struct Record {
    /// The table of samples
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
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

/// Set by SIGINT and SIGTERM.
fn interrupted() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    Ok(stop)
}

/// Opens the domain for reading; the error names the domains that there are.
fn open(config: &DomainConfig) -> anyhow::Result<Domain> {
    Domain::open_existing(config).map_err(|error| {
        let siblings = config.siblings();
        match siblings.is_empty() {
            true => error.into(),
            false => anyhow::Error::new(error)
                .context(format!("the domains here are {}", siblings.join(", "))),
        }
    })
}

/// The robots to show: the named one, or all.
fn robots(domain: &Domain, name: Option<&str>) -> anyhow::Result<Vec<RobotPresence>> {
    let all = domain.robots();
    let Some(name) = name else { return Ok(all) };
    match all.iter().find(|robot| robot.name == name) {
        Some(robot) => Ok(vec![robot.clone()]),
        None if all.is_empty() => bail!("there is no robot in the domain"),
        None => {
            let names: Vec<_> = all.into_iter().map(|robot| robot.name).collect();
            bail!("there is no robot {name:?}; there is {}", names.join(", "))
        }
    }
}

/// The name of the robot to read: the named one, or the only one.
fn one_robot(domain: &Domain, name: Option<&str>) -> anyhow::Result<String> {
    let mut found = robots(domain, name)?;
    match (found.pop(), found.is_empty()) {
        (Some(robot), true) => Ok(robot.name),
        (Some(robot), false) => {
            let names: Vec<_> = found.into_iter().map(|robot| robot.name).collect();
            bail!(
                "there are several robots: name one with --robot: {}, {}",
                names.join(", "),
                robot.name
            )
        }
        (None, _) => bail!("there is no robot in the domain"),
    }
}

/// The newest payload of a topic with history.
fn newest<T: Topic>(domain: &Domain, robot: &str) -> Result<Option<T>, PortError> {
    let mut reader = match Reader::<T>::open(domain, robot) {
        Ok(reader) => reader,
        Err(PortError::NotYet { .. }) => return Ok(None),
        Err(error) => return Err(error),
    };
    let deadline = monotonic() + HISTORY;
    loop {
        if let Ok(Some(newest)) = reader.latest() {
            return Ok(Some(newest));
        }
        if !reader.wait(deadline) {
            return Ok(None);
        }
    }
}

/// The newest description of one publisher.
fn described(
    domain: &Domain,
    robot: &str,
    publisher: Publisher,
) -> Result<Option<Description>, PortError> {
    let mut reader = match Reader::<Description>::open(domain, robot) {
        Ok(reader) => reader,
        Err(PortError::NotYet { .. }) => return Ok(None),
        Err(error) => return Err(error),
    };
    let (mut found, deadline) = (None, monotonic() + HISTORY);
    loop {
        while let Ok(Some(description)) = reader.try_take() {
            if description.publisher == publisher {
                found = Some(description);
            }
        }
        if found.is_some() || !reader.wait(deadline) {
            return Ok(found);
        }
    }
}

/// What a channel sent during the window.
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    count: u64,
    last: Option<Nanos>,
    quality: Quality,
}

/// One robot at a glance.
struct Glance {
    presence: RobotPresence,
    gateway: Option<GatewayHealth>,
    estimator: Option<EstimatorHealth>,
    /// Estimates per second.
    estimates: f64,
    description: Option<Description>,
    channels: Vec<Seen>,
    /// The end of the window in which they were counted, and its duration.
    now: Nanos,
    window: Nanos,
}

impl Glance {
    fn take(domain: &Domain, presence: RobotPresence) -> anyhow::Result<Self> {
        let robot = presence.name.clone();
        let description = described(domain, &robot, Publisher::Gateway)?;
        let mut channels = vec![Seen::default(); MAX_CHANNELS];
        let before = newest::<EstimatorHealth>(domain, &robot)?;
        let mut samples = Reader::<Sample>::open(domain, &robot).ok();
        let began = monotonic();
        let until = began + WINDOW;
        while monotonic() < until {
            match &mut samples {
                Some(samples) => {
                    while let Ok(Some(sample)) = samples.try_take() {
                        if let Some(seen) = channels.get_mut(sample.channel as usize) {
                            seen.count += 1;
                            seen.last = Some(sample.header.acquired);
                            seen.quality |= sample.header.quality;
                        }
                    }
                    samples.wait(until);
                }
                None => std::thread::sleep(std::time::Duration::from_millis(50)),
            }
        }
        let now = monotonic();
        let window = now - began;
        let estimator = newest::<EstimatorHealth>(domain, &robot)?;
        let estimates = match (&before, &estimator) {
            (Some(a), Some(b)) if b.header.published > a.header.published => {
                let passed = (b.header.published - a.header.published).seconds();
                b.estimates.saturating_sub(a.estimates) as f64 / passed
            }
            _ => 0.0,
        };
        Ok(Self {
            gateway: newest(domain, &robot)?,
            presence,
            estimator,
            estimates,
            description,
            channels,
            now,
            window,
        })
    }

    /// Name, kind, rate \[Hz\], age \[s\] and quality of each channel.
    fn channels(&self) -> impl Iterator<Item = (&str, Kind, f64, Option<f64>, Quality)> {
        let entries = self.description.as_ref().map(Description::entries);
        entries.unwrap_or_default().iter().filter_map(|entry| {
            let seen = self.channels.get(entry.index as usize)?;
            let rate = seen.count as f64 / self.window.seconds();
            let age = seen
                .last
                .map(|last| self.now.saturating_sub(last).seconds());
            (entry.role == Role::Channel).then(|| {
                Some((
                    entry.name.as_str(),
                    entry.kind.get()?,
                    rate,
                    age,
                    seen.quality,
                ))
            })?
        })
    }

    fn json(&self) -> Json {
        let gateway = self.gateway.as_ref().map(|health| {
            let buses: Vec<_> = health
                .buses()
                .iter()
                .map(|bus| {
                    let interface = &bus.interface;
                    json!({
                        "name": bus.name.as_str(),
                        "link": bus.link.get().map(LinkState::word),
                        "frames": bus.frames, "unclaimed": bus.unclaimed, "dropped": bus.dropped,
                        "error_frames": bus.error_frames, "sent": bus.sent,
                        "send_failures": bus.send_failures, "queue_full": bus.queue_full,
                        "link_losses": bus.link_losses, "published": bus.published,
                        "publish_failures": bus.publish_failures,
                        "load": bus.load, "frame_rate_hz": bus.frame_rate,
                        "controller": interface.controller.get().map(Controller::word),
                        "tx_error_counter": interface.tx_error_counter,
                        "rx_error_counter": interface.rx_error_counter,
                        "bit_rate": interface.bit_rate, "data_bit_rate": interface.data_bit_rate,
                        "restart_ms": interface.restart_ms,
                    })
                })
                .collect();
            let devices: Vec<_> = health
                .devices()
                .iter()
                .map(|device| {
                    let counters: serde_json::Map<_, _> = Counter::ALL
                        .into_iter()
                        .zip(device.counters)
                        .map(|(counter, count)| (counter.word().to_owned(), json!(count)))
                        .collect();
                    json!({
                        "name": device.name.as_str(),
                        "bus": device.bus,
                        "state": device.state.get().map(DeviceState::word),
                        "refusal": proprio_topics::Refusal::from_code(device.refusal)
                            .map(|refusal| refusal.to_string()),
                        "frozen": axes(device.frozen_axes).to_string(),
                        "out_of_range": axes(device.beyond_axes).to_string(),
                        "counters": counters,
                    })
                })
                .collect();
            json!({
                "up_s": (self.now - health.started).seconds(),
                "buses": buses,
                "devices": devices,
            })
        });
        let estimator = self.estimator.as_ref().map(|health| {
            let identification: serde_json::Map<_, _> = health
                .identification
                .counts()
                .into_iter()
                .map(|(word, count)| (word.to_owned(), json!(count)))
                .collect();
            json!({
                "up_s": (self.now - health.started).seconds(),
                "estimates_hz": self.estimates,
                "estimates": health.estimates, "withheld": health.withheld,
                "samples": health.samples, "lost": health.lost, "late": health.late,
                "identification": {
                    "groups": health.identification.groups,
                    "paused": health.identification.paused,
                    "counts": identification,
                },
            })
        });
        let channels: Vec<_> = self
            .channels()
            .map(|(name, kind, rate, age, quality)| {
                json!({
                    "name": name, "kind": kind.word(), "rate_hz": rate, "age_s": age,
                    "quality": quality.to_string(),
                })
            })
            .collect();
        json!({
            "robot": self.presence.name,
            "gateway": { "is": self.presence.gateway.to_string(), "health": gateway },
            "estimator": { "is": self.presence.estimator.to_string(), "health": estimator },
            "channels": channels,
        })
    }

    fn print(&self) {
        let RobotPresence {
            name,
            gateway,
            estimator,
        } = &self.presence;
        print_line!("robot {name}");
        print_line!("  gateway {gateway}");
        for bus in self.gateway.iter().flat_map(GatewayHealth::buses) {
            let link = bus.link.get().map_or("unknown", LinkState::word);
            print_line!(
                "    bus {:<24} {link:<10} {}, {} frames, {} dropped, {} error frames, {} not sent",
                bus.name.as_str(),
                load(bus.load, bus.frame_rate),
                bus.frames,
                bus.dropped,
                bus.error_frames,
                bus.send_failures
            );
        }
        for device in self.gateway.iter().flat_map(GatewayHealth::devices) {
            let state = device.state.get().map_or("unknown", DeviceState::word);
            let counts: Vec<_> = Counter::ALL
                .into_iter()
                .zip(device.counters)
                .filter(|(_, count)| *count > 0)
                .map(|(counter, count)| format!("{} {count}", counter.word()))
                .collect();
            print_line!(
                "    device {:<21} {state:<10} {}{}",
                device.name.as_str(),
                counts.join(", "),
                match device.frozen_axes {
                    0 => String::new(),
                    mask => format!("; {} frozen", axes(mask)),
                }
            );
        }
        for (name, kind, rate, age, quality) in self.channels() {
            let age = age.map_or("never seen".into(), |age| {
                format!("{:.1} ms old", age * 1e3)
            });
            print_line!(
                "    {:<8} {name:<23} {rate:>7.1} Hz, {age}, {quality}",
                kind.word()
            );
        }
        print_line!("  estimator {estimator}");
        if let Some(health) = &self.estimator {
            print_line!(
                "    {:.1} estimates/s, {} of {} with a torque withheld; samples: {} lost, {} late",
                self.estimates,
                health.withheld,
                health.estimates,
                health.lost,
                health.late
            );
            if health.identification.groups > 0 {
                print_line!("    identification: {}", health.identification);
            }
        }
    }
}

/// The load of a bus: its share, if the bit rate is known, and its frames per second.
pub(crate) fn load(share: f64, frame_rate: f64) -> String {
    let share = match share.is_nan() {
        true => String::new(),
        false => format!("load {:.0} %, ", share * 100.0),
    };
    format!("{share}{frame_rate:.0} frames/s")
}

/// Shows the robots of the domain.
pub(crate) fn status(args: &Status, config: &DomainConfig) -> anyhow::Result<()> {
    let stop = interrupted()?;
    let domain = open(config)?;
    loop {
        let glances = robots(&domain, args.robot.as_deref())?
            .into_iter()
            .map(|presence| Glance::take(&domain, presence))
            .collect::<anyhow::Result<Vec<_>>>()?;
        if args.json {
            let robots: Vec<_> = glances.iter().map(Glance::json).collect();
            print_line!(
                "{}",
                json!({ "domain": config.name, "domains": config.siblings(), "robots": robots })
            );
        } else {
            if args.watch {
                // Clear the screen.
                print_part!("\x1b[2J\x1b[H");
            }
            print_line!("domain {} in {}", config.name, config.base.display());
            if glances.is_empty() {
                print_line!("no robot");
            }
            glances.iter().for_each(Glance::print);
        }
        if !args.watch || stop.load(Relaxed) {
            return Ok(());
        }
    }
}

/// Prints the samples of a channel.
pub(crate) fn echo(args: &Echo, config: &DomainConfig) -> anyhow::Result<()> {
    let stop = interrupted()?;
    let domain = open(config)?;
    let robot = one_robot(&domain, args.robot.as_deref())?;
    let description = described(&domain, &robot, Publisher::Gateway)?
        .context("the robot's gateway is not running")?;
    let names = || {
        let channels = description
            .entries()
            .iter()
            .filter(|e| e.role == Role::Channel);
        channels.map(|entry| entry.name.as_str())
    };
    let Some(number) = description.index(Role::Channel, &args.channel) else {
        let hint = proprio_estimator::setup::nearest(&args.channel, names());
        bail!("there is no channel {:?}{hint}", args.channel);
    };
    let mut samples = Reader::<Sample>::open(&domain, &robot)?;
    let mut printed = 0;
    while !stop.load(Relaxed) && args.count.is_none_or(|count| printed < count) {
        while let Some(sample) = samples.try_take()? {
            let Some(kind) = sample.kind.get().filter(|_| sample.channel == number) else {
                continue;
            };
            if args.count.is_some_and(|count| printed >= count) {
                break;
            }
            printed += 1;
            let (t, quality) = (sample.header.acquired, sample.header.quality);
            let values = kind.fields().iter().zip(sample.values);
            if args.json {
                let values: serde_json::Map<_, _> = values
                    .map(|(field, value)| ((*field).to_owned(), json!(value)))
                    .collect();
                print_line!(
                    "{}",
                    json!({
                        "t_ns": t.0, "kind": kind.word(), "values": values,
                        "quality": quality.to_string(),
                    })
                );
            } else {
                let values: Vec<_> = values
                    .filter(|(_, value)| !value.is_nan())
                    .map(|(field, value)| format!("{field} {value:.6}"))
                    .collect();
                print_line!("{t} {} {}  {quality}", kind.word(), values.join(" "));
            }
        }
        samples.wait(monotonic() + Nanos::from_millis(200));
    }
    Ok(())
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

/// Records samples and declared contacts.
pub(crate) fn record(args: &Record, config: &DomainConfig) -> anyhow::Result<()> {
    let stop = interrupted()?;
    let domain = open(config)?;
    let robot = one_robot(&domain, args.robot.as_deref())?;
    // The readers first: what comes while the table is prepared is recorded, too.
    let mut samples = Reader::<Sample>::open(&domain, &robot)?;
    let mut declarations = Reader::<ContactDeclaration>::open(&domain, &robot).ok();
    let mut descriptions = Reader::<Description>::open(&domain, &robot)?;
    let description = described(&domain, &robot, Publisher::Gateway)?
        .context("the robot's gateway is not running")?;
    let estimator = described(&domain, &robot, Publisher::Estimator)?;
    let mut series = channels_of(&description);
    for contact in estimator.iter().flat_map(Description::entries) {
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
    let file = File::create(&args.out).with_context(|| args.out.display().to_string())?;
    let mut table = Writer::new(BufWriter::new(file), &series, columns)?;
    let (mut order, mut inbox) = (InOrder::<(usize, Value)>::new(REORDER), Vec::new());
    let began = monotonic();
    let end = args
        .seconds
        .map(|seconds| began + Nanos::from_seconds(seconds));
    let (mut count, mut others, mut next_flush) = (0_u64, 0_u64, began);
    while !stop.load(Relaxed) && end.is_none_or(|end| monotonic() < end) {
        while let Some(declared) = declarations.as_mut().map_or(Ok(None), Reader::try_take)? {
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
            order.push(t, (at, value), |t, (at, value)| {
                table.push(Some(t), *at, value)
            })?;
        }
        // Shared memory delivers all samples of one bus before those of the next.
        while let Some(sample) = samples.try_take()? {
            inbox.push(sample);
        }
        inbox.sort_by_key(|sample| sample.header.acquired);
        for sample in inbox.drain(..) {
            if sample.header.epoch != numbers.epoch {
                // The gateway was restarted: the same channels may have other numbers.
                while let Some(description) = descriptions.try_take()? {
                    if description.publisher == Publisher::Gateway {
                        numbers = Numbers::new(&description, &series);
                    }
                }
            }
            let (Some(at), Some(reading)) = (numbers.series(&sample), sample.reading()) else {
                others += 1;
                continue;
            };
            count += 1;
            let value = Value::Reading(reading, sample.header.quality);
            let t = sample.header.acquired;
            order.push(t, (at, value), |t, (at, value)| {
                table.push(Some(t), *at, value)
            })?;
        }
        let now = monotonic();
        if now >= next_flush {
            // If this program is killed, the rows of the last moments are lost, not the table.
            next_flush = now + Nanos::from_millis(500);
            table.flush()?;
        }
        samples.wait((now + Nanos::from_millis(100)).min(end.unwrap_or(Nanos::MAX)));
    }
    order.finish(|t, (at, value)| table.push(Some(t), *at, value))?;
    table.finish()?;
    print_line!(
        "{}: {count} samples in {:.1} s, {} lost, {} out of order",
        args.out.display(),
        (monotonic() - began).seconds(),
        samples.lost(),
        order.out_of_order()
    );
    if others > 0 {
        print_line!(
            "{others} samples and declarations are not in the table: they are of channels or \
             contacts that were not there when the recording began"
        );
    }
    Ok(())
}
