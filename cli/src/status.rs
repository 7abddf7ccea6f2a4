//! `proprio status`: what a running system does, from shared memory alone.

use crate::echo::{of_joints, torque_json};
use anyhow::bail;
use proprio_bridge::{DescriptionReader, first_of, open};
use proprio_topics::ipc::{
    Domain, DomainConfig, PortError, Reader, RobotPresence, Topic, Unavailable, monotonic,
};
use proprio_topics::{
    BusHealth, Controller, Counter, Description, DeviceHealth, DeviceState, EstimatorHealth,
    GatewayHealth, Kind, LinkState, MAX_CHANNELS, Nanos, Publisher, Quality, Refusal, Role, Sample,
    TorqueEstimate, axes,
};
use serde_json::{Map, Value as Json, json};
use std::collections::BTreeMap;

/// How long `status` counts samples and estimates.
const WINDOW: Nanos = Nanos::from_millis(1000);
/// `proprio status`.
#[derive(clap::Args)]
pub(crate) struct StatusArgs {
    /// Show only this robot
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// Print as JSON, one object
    #[arg(long)]
    json: bool,
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

/// The newest payload of a topic with history.
pub(crate) fn newest<T: Topic>(domain: &Domain, robot: &str) -> Result<Option<T>, PortError> {
    let found = first_of(domain, robot, |reader: &mut Reader<T>| {
        reader.latest().ok()?
    })?;
    Ok(found.map(|(_, newest)| newest))
}

/// What a channel sent during the window.
#[derive(Debug, Clone, Copy, Default)]
struct ChannelActivity {
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
    channels: Vec<ChannelActivity>,
    /// The newest torques of the window, and the estimator's names.
    torques: Option<(TorqueEstimate, Description)>,
    /// The end of the window in which they were counted, and its duration.
    now: Nanos,
    window: Nanos,
}

impl Glance {
    fn take(domain: &Domain, presence: RobotPresence) -> anyhow::Result<Self> {
        let robot = presence.name.clone();
        let description = DescriptionReader::by(domain, &robot, Publisher::Gateway)?;
        let description = description.map(|described| *described.newest());
        let names = DescriptionReader::by(domain, &robot, Publisher::Estimator)?;
        let mut estimates = Reader::<TorqueEstimate>::open(domain, &robot).ok();
        let mut channels = vec![ChannelActivity::default(); MAX_CHANNELS];
        // Who publishes no description has no health either; each look for it takes half a second.
        let is_described = names.is_some();
        let health = || match is_described {
            true => newest::<EstimatorHealth>(domain, &robot),
            false => Ok(None),
        };
        let before = health()?;
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
        let newest_torques = estimates.as_mut().and_then(|reader| reader.latest().ok());
        let torques = newest_torques
            .flatten()
            .zip(names)
            .and_then(|(torques, mut names)| {
                let description = *names.of(torques.header.epoch)?;
                Some((torques, description))
            });
        let estimator = health()?;
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
            torques,
            now,
            window,
        })
    }

    /// Name, kind, rate \[Hz\], age \[s\] of the last sample, and quality of each channel. One that
    /// sent nothing during the window has no quality.
    fn channels(&self) -> impl Iterator<Item = (&str, Kind, f64, Option<f64>, Option<Quality>)> {
        let entries = self.description.as_ref().map(Description::entries);
        entries.unwrap_or_default().iter().filter_map(|entry| {
            let seen = self.channels.get(entry.index as usize)?;
            let rate = seen.count as f64 / self.window.seconds();
            let before = self.gateway.as_ref().and_then(|health| {
                let newest = *health.newest.get(entry.index as usize)?;
                (newest > Nanos::MIN).then_some(newest)
            });
            let age = (seen.last.or(before)).map(|last| self.now.saturating_sub(last).seconds());
            (entry.role == Role::Channel).then(|| {
                Some((
                    entry.name.as_str(),
                    entry.kind.get()?,
                    rate,
                    age,
                    seen.last.map(|_| seen.quality),
                ))
            })?
        })
    }

    fn torques(&self) -> impl Iterator<Item = (&str, f64, f64, Option<Unavailable>)> {
        let newest = self.torques.iter();
        newest.flat_map(|(torques, description)| of_joints(description, torques))
    }

    /// The time since the instant of the last estimate \[s\]; `None` before the first.
    fn since_last_estimate(&self) -> Option<f64> {
        let last = self.estimator.as_ref()?.last_estimate;
        (last > Nanos::ZERO).then(|| self.now.saturating_sub(last).seconds())
    }

    fn json(&self) -> Json {
        let channels: Vec<_> = self
            .channels()
            .map(|(name, kind, rate, age, quality)| {
                json!({
                    "name": name, "kind": kind.word(), "rate_hz": rate, "age_s": age,
                    "quality": quality.map(|quality| quality.to_string()),
                })
            })
            .collect();
        let gateway = self.gateway.as_ref().map(|health| {
            json!({
                "up_s": (self.now - health.started).seconds(),
                "buses": health.buses().iter().map(bus_json).collect::<Vec<_>>(),
                "devices": health.devices().iter().map(device_json).collect::<Vec<_>>(),
            })
        });
        let estimator = self
            .estimator
            .as_ref()
            .map(|health| self.estimator_json(health));
        json!({
            "robot": self.presence.name,
            "gateway": { "is": self.presence.gateway.to_string(), "health": gateway },
            "estimator": { "is": self.presence.estimator.to_string(), "health": estimator },
            "channels": channels,
        })
    }

    fn estimator_json(&self, health: &EstimatorHealth) -> Json {
        let torques: Map<_, _> = self
            .torques()
            .map(|(name, torque, deviation, withheld)| {
                let value = torque_json(torque, deviation, withheld.as_ref());
                (name.to_owned(), value)
            })
            .collect();
        let counts = health.identification.counts().into_iter();
        let counts: Map<_, _> = counts
            .map(|(word, count)| (word.to_owned(), json!(count)))
            .collect();
        json!({
            "up_s": (self.now - health.started).seconds(),
            "estimates_hz": self.estimates,
            "estimates": health.estimates, "withheld": health.withheld,
            "samples": health.samples, "lost": health.lost, "late": health.late,
            "last_estimate_s": self.since_last_estimate(),
            "torques": torques,
            "identification": {
                "groups": health.identification.groups,
                "paused": health.identification.paused,
                "counts": counts,
            },
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
            print_line!(
                "    device {:<21} {state:<10} {}{}",
                device.name.as_str(),
                counts(device, &[]),
                match device.frozen_axes {
                    0 => String::new(),
                    mask => format!("; {} frozen", axes(mask)),
                }
            );
        }
        for (name, kind, rate, age, quality) in self.channels() {
            let state = match (age, quality) {
                (Some(age), Some(quality)) => format!("{:.1} ms old, {quality}", age * 1e3),
                (Some(age), None) => format!("last seen {age:.0} s ago"),
                (None, _) => "never seen".to_owned(),
            };
            print_line!("    {:<8} {name:<23} {rate:>7.1} Hz, {state}", kind.word());
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
            if self.torques.is_none()
                && let Some(seconds) = self.since_last_estimate()
            {
                print_line!("    the last estimate was {seconds:.0} s ago");
            }
            let mut withheld = BTreeMap::<String, Vec<&str>>::new();
            for (name, .., why) in self.torques() {
                if let Some(why) = why {
                    withheld.entry(why.to_string()).or_default().push(name);
                }
            }
            for (why, joints) in withheld {
                print_line!("    torque of {} {why}", joints.join(", "));
            }
            if health.identification.groups > 0 {
                print_line!("    identification: {}", health.identification);
            }
        }
    }
}

fn bus_json(bus: &BusHealth) -> Json {
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
}

fn device_json(device: &DeviceHealth) -> Json {
    let counters = Counter::ALL.into_iter().zip(device.counters);
    let counters: Map<_, _> = counters
        .map(|(counter, count)| (counter.word().to_owned(), json!(count)))
        .collect();
    json!({
        "name": device.name.as_str(),
        "bus": device.bus,
        "state": device.state.get().map(DeviceState::word),
        "refusal": Refusal::from_code(device.refusal).map(|refusal| refusal.to_string()),
        "frozen": axes(device.frozen_axes).to_string(),
        "out_of_range": axes(device.beyond_axes).to_string(),
        "counters": counters,
    })
}

/// The load of a bus: its share, if the bit rate is known, and its frames per second.
pub(crate) fn load(share: f64, frame_rate: f64) -> String {
    let share = match share.is_nan() {
        true => String::new(),
        false => format!("load {:.0} %, ", share * 100.0),
    };
    format!("{share}{frame_rate:.0} frames/s")
}

/// The counters of a device that are not zero, without those of `except`.
pub(crate) fn counts(device: &DeviceHealth, except: &[Counter]) -> String {
    let counts = Counter::ALL.into_iter().zip(device.counters);
    let counts = counts.filter(|(counter, count)| *count > 0 && !except.contains(counter));
    let words = counts.map(|(counter, count)| format!("{} {count}", counter.word()));
    words.collect::<Vec<_>>().join(", ")
}

/// Shows the robots of the domain.
pub(crate) fn run(args: &StatusArgs, config: &DomainConfig) -> anyhow::Result<()> {
    let domain = open(config)?;
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
        return Ok(());
    }
    print_line!("domain {} in {}", config.name, config.base.display());
    if glances.is_empty() {
        print_line!("no robot");
    }
    glances.iter().for_each(Glance::print);
    Ok(())
}
