//! The checked and resolved form of gateway.toml, which the rest of the gateway uses.
//!
//! A joint is measured by one output of a device, or by several (`takes`), or by the motors of a
//! coupling: `wiring` resolves that to the bus's [`Layout`], and each output's [`Route`] says where
//! it leads.

mod wiring;
mod words;

pub use crate::joints::JointMap;
pub use words::did_you_mean;

use crate::config::{Pace, Raw, RawBus, RawDevice, RawJoint, Realtime, Source};
use crate::joints::{CouplingPlan, Feed, Layout, Takes, Target};
use crate::link::adapter::Adapter;
use crate::link::replay::Matching;
use crate::load::{self, BitRates, Load, Member};
use crate::log::Stamps;
use crate::scan::{FILL_IN, placeholders};
use crate::{dbc, eds};
use proprio_drivers::{DRIVERS, Device, Mode, Options, OptionsError, OutputInfo, Outputs, Spec};
use proprio_topics::{
    Description, Entry, Kind, MAX_BUSES, MAX_CHANNELS, Name, Nanos, Publisher, ROBOT_NAME, Role,
    is_robot_name,
};
use std::f64::consts::TAU;
use std::fmt::{self, Write as _};
use std::path::{Path, PathBuf};
use wiring::Wiring;

/// An unusable configuration: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", .file.display())]
pub struct ConfigError {
    /// The file.
    pub file: PathBuf,
    /// Place, error, and the legal values.
    pub problem: String,
}

/// The gateway's plan.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The robot's name.
    pub robot: String,
    /// The buses.
    pub buses: Vec<BusPlan>,
    /// The channels; `Sample::channel` is an index of this list.
    pub channels: Vec<ChannelPlan>,
}

/// One bus.
#[derive(Debug, Clone)]
pub struct BusPlan {
    /// Its name.
    pub name: String,
    /// The source of its frames.
    pub source: Source,
    /// Scheduling of its thread.
    pub realtime: Option<Realtime>,
    /// Nothing is ever sent to it: all its devices only listen.
    pub listen_only: bool,
    /// Its bit rates, for its load.
    pub rates: BitRates,
    /// The rates are not those of the configuration, but the highest possible.
    pub rates_assumed: bool,
    /// What its devices need of it.
    pub load: Load,
    /// Its devices.
    pub devices: Vec<DevicePlan>,
    /// Its joints: which outputs of devices give them, and how.
    pub joints: Layout,
}

impl BusPlan {
    /// Whether it can not carry what its devices send. A log was carried, and so is what another
    /// program has set up.
    fn is_overloaded(&self) -> bool {
        let is_log = matches!(self.source, Source::Replay { .. });
        self.load.share > 1.0 && !self.listen_only && !is_log
    }
}

/// One device.
#[derive(Debug, Clone)]
pub struct DevicePlan {
    /// Its name.
    pub name: String,
    /// The driver's name.
    pub driver: String,
    /// The driver and its keys.
    pub options: Options,
    /// Address, silence, outputs.
    pub spec: Spec,
    /// The channel of each output; empty for a device that measures nothing.
    pub routes: Vec<Route>,
}

/// One output of a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Route {
    /// The number of the device's output.
    pub output: u8,
    /// The number of the channel.
    pub channel: u32,
    /// The kind of the channel.
    pub kind: Kind,
    /// The conversion from device angle to joint angle; the identity for sensors.
    pub map: JointMap,
    /// Where a joint's state leads, in [`BusPlan::joints`]; `None` for sensors. Then `channel` is
    /// only that of readings that are no joint's states.
    pub feed: Option<Feed>,
}

/// One channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChannelPlan {
    /// Its name: the sensor's or the joint's.
    pub name: String,
    /// What it measures.
    pub kind: Kind,
    /// The number of its bus.
    pub bus: usize,
    /// The number of its device on that bus.
    pub device: usize,
    /// The longest time between two samples that is still normal.
    pub max_silence: Nanos,
}

impl Plan {
    /// Reads and checks a configuration file.
    ///
    /// # Errors
    /// [`ConfigError`] with file, place, value and the legal values.
    pub fn load(file: &Path) -> Result<Self, ConfigError> {
        Self::read(file).map(|(plan, _)| plan)
    }

    /// The plan, and the text that it is made of.
    fn read(file: &Path) -> Result<(Self, String), ConfigError> {
        let error = |problem| ConfigError {
            file: file.to_owned(),
            problem,
        };
        let text =
            std::fs::read_to_string(file).map_err(|e| error(format!("cannot be read: {e}")))?;
        let plan = Self::parse(&text, file.parent().unwrap_or(Path::new(".")));
        Ok((plan.map_err(error)?, text))
    }

    /// As [`Plan::load`], for a daemon, which replays logs only as they were recorded, needs buses
    /// that carry what its devices send, and a file in which nothing is left to fill in.
    ///
    /// # Errors
    /// As [`Plan::load`].
    pub fn load_live(file: &Path) -> Result<Self, ConfigError> {
        let (plan, text) = Self::read(file)?;
        let left = placeholders(&text);
        let fast = |bus: &&BusPlan| {
            matches!(
                bus.source,
                Source::Replay {
                    pace: Pace::Fast,
                    ..
                }
            )
        };
        let problem = if let Some(bus) = plan.buses.iter().find(fast) {
            format!(
                "bus {:?}: pace = \"fast\" is for offline use (proprio decode); a daemon replays \
                 with pace = \"recorded\"",
                bus.name
            )
        } else if let Some(bus) = plan.buses.iter().find(|bus| bus.is_overloaded()) {
            format!(
                "bus {:?}: its devices need up to {:.0} % of {}: make periods longer, or move \
                 devices to another bus",
                bus.name,
                bus.load.share * 100.0,
                bit_rate(bus.rates.nominal)
            )
        } else if !left.is_empty() {
            format!(
                "placeholders are not filled in; put in what is right, and remove the comment \
                 `{FILL_IN}`:\n{}",
                left.join("\n")
            )
        } else {
            return Ok(plan);
        };
        let file = file.to_owned();
        Err(ConfigError { file, problem })
    }

    /// Checks a configuration given as text; paths in it are relative to `folder`.
    ///
    /// # Errors
    /// A message with the place, the error and the legal values.
    pub fn parse(text: &str, folder: &Path) -> Result<Self, String> {
        let raw: Raw = toml::from_str(text).map_err(|e| e.to_string())?;
        Builder {
            text,
            folder,
            plan: Self {
                robot: raw.robot.clone(),
                buses: vec![],
                channels: vec![],
            },
        }
        .build(raw)
    }

    /// The frames that bus number `bus` takes from the log that its source replays, or from a log
    /// given for all buses. `None` if there is no such bus.
    #[must_use]
    pub fn matching(&self, bus: usize) -> Option<Matching> {
        let own = self.buses.get(bus).map(|b| &b.source);
        let mut this = 0;
        let mut buses = Vec::new();
        for (number, other) in self.buses.iter().enumerate() {
            let interface = match (&other.source, own) {
                (Source::SocketCan(Adapter::Interface(name)), _) => Some(name.as_str()),
                // Which interface an adapter was when a log was recorded is not known.
                (Source::SocketCan(_), _) => None,
                (Source::Virtual { name }, _) => Some(name.as_str()),
                (Source::Replay { log, .. }, Some(Source::Replay { log: own, .. }))
                    if log != own =>
                {
                    continue;
                }
                (Source::Replay { .. }, _) => None,
            };
            if number == bus {
                this = buses.len();
            }
            buses.push((interface, other.name.as_str()));
        }
        Matching::of(&buses, this)
    }

    /// The number of channel `name`.
    #[must_use]
    pub fn channel(&self, name: &str) -> Option<u32> {
        self.channels
            .iter()
            .position(|c| c.name == name)
            .and_then(|i| u32::try_from(i).ok())
    }

    /// The description of this plan's channels.
    #[must_use]
    pub fn description(&self) -> Box<Description> {
        let device = |channel: &ChannelPlan| {
            let bus = self.buses.get(channel.bus)?;
            Name::new(&bus.devices.get(channel.device)?.name)
        };
        let entries = self.channels.iter().zip(0..).map(|(channel, index)| Entry {
            name: Name::new(&channel.name).unwrap_or(Name::EMPTY),
            origin: device(channel).unwrap_or(Name::EMPTY),
            max_silence: channel.max_silence,
            role: Role::Channel.in_memory(),
            index,
            kind: channel.kind.in_memory(),
            bus: u32::try_from(channel.bus).unwrap_or(u32::MAX),
        });
        Box::new(Description::new(Publisher::Gateway, entries))
    }
}

/// The highest rates that transceivers are made for: with these a load is never overestimated.
const HIGHEST: BitRates = BitRates {
    nominal: 1_000_000,
    data: 8_000_000,
};

/// A bit rate in words.
fn bit_rate(rate: u32) -> String {
    match rate {
        1_000_000.. => format!("{} Mbit/s", f64::from(rate) / 1e6),
        _ => format!("{} kbit/s", f64::from(rate) / 1e3),
    }
}

struct Builder<'a> {
    text: &'a str,
    folder: &'a Path,
    plan: Plan,
}

impl Builder<'_> {
    fn build(mut self, raw: Raw) -> Result<Plan, String> {
        if raw.schema != 1 {
            return Err(format!(
                "schema = {} is not known; this version reads schema = 1",
                raw.schema
            ));
        }
        if !is_robot_name(&raw.robot) {
            return Err(format!("robot = {:?}: {ROBOT_NAME}", raw.robot));
        }
        if raw.bus.is_empty() {
            return Err("there is no [[bus]]: a gateway needs at least one".into());
        }
        if raw.bus.len() > MAX_BUSES {
            return Err(format!(
                "there are {} buses; at most {MAX_BUSES} are possible",
                raw.bus.len()
            ));
        }
        for bus in raw.bus {
            self.bus(bus)?;
        }
        Ok(self.plan)
    }

    fn bus(&mut self, raw: RawBus) -> Result<(), String> {
        let place = format!("bus {:?}", raw.name);
        check_name("bus: name", &raw.name)?;
        let mut source = raw.source;
        match &mut source {
            Source::Virtual { name } => check_name(&format!("{place}: source.name"), name)?,
            Source::Replay { log, .. } => *log = self.folder.join(&*log),
            Source::SocketCan(_) => {}
        }
        for other in &self.plan.buses {
            if other.name == raw.name {
                return Err(format!(
                    "two buses are named {:?}; each bus needs a different name",
                    raw.name
                ));
            }
            let same = match (&other.source, &source) {
                (Source::Replay { .. }, Source::Replay { .. }) => false,
                (a, b) => a == b,
            };
            if same {
                return Err(format!(
                    "{place}: same source as bus {:?}; list the devices of both under one [[bus]]",
                    other.name
                ));
            }
        }
        if let Some(Realtime {
            priority: Some(priority),
            ..
        }) = raw.realtime
            && !(1..=99).contains(&priority)
        {
            return Err(format!(
                "{place}: realtime.priority = {priority} must be 1 to 99"
            ));
        }
        for (key, rate) in [
            ("bit_rate", raw.bit_rate),
            ("data_bit_rate", raw.data_bit_rate),
        ] {
            if let Some(rate) = rate
                && !(10_000..=10_000_000).contains(&rate)
            {
                return Err(format!(
                    "{place}: {key} = {rate} must be 10000 to 10000000 bit/s"
                ));
            }
        }
        self.plan.buses.push(BusPlan {
            name: raw.name,
            source,
            realtime: raw.realtime,
            listen_only: raw.listen_only,
            rates: BitRates {
                nominal: raw.bit_rate.unwrap_or(HIGHEST.nominal),
                data: raw.data_bit_rate.unwrap_or(HIGHEST.data),
            },
            rates_assumed: raw.bit_rate.is_none(),
            load: Load::default(),
            devices: Vec::new(),
            joints: Layout::default(),
        });
        let mut wiring = Wiring::new(raw.coupling).map_err(|e| format!("{place}, {e}"))?;
        for table in raw.device {
            let line = self
                .text
                .get(..table.span().start)
                .map_or(0, |before| before.matches('\n').count() + 1);
            self.device(table.into_inner(), &mut wiring)
                .map_err(|e| format!("{place}, device at line {line}: {e}"))?;
        }
        let (joints, shown) = wiring.finish().map_err(|e| format!("{place}, {e}"))?;
        for shown in shown {
            if let Some(channel) = self.plan.channels.get_mut(shown.channel as usize) {
                (channel.device, channel.max_silence) = (shown.device, shown.max_silence);
            }
        }
        if let Some(bus) = self.plan.buses.last_mut() {
            bus.joints = joints;
        }
        self.check_claims(&place)?;
        self.compute_load(&place)
    }

    /// Computes the load of the last bus.
    fn compute_load(&mut self, place: &str) -> Result<(), String> {
        let Some(bus) = self.plan.buses.last_mut() else {
            return Ok(());
        };
        let outputs = |device: &DevicePlan| -> Vec<(u8, Kind)> {
            device.routes.iter().map(|r| (r.output, r.kind)).collect()
        };
        let outputs: Vec<_> = bus.devices.iter().map(outputs).collect();
        let members: Vec<Member<'_>> = (bus.devices.iter().zip(&outputs))
            .map(|(device, outputs)| Member {
                options: &device.options,
                spec: &device.spec,
                outputs,
            })
            .collect();
        bus.load = load::of_bus(&members, bus.rates).map_err(|e| format!("{place}: {e}"))?;
        Ok(())
    }

    /// Refuses a device that is configured for another bit rate than that of the last bus.
    fn check_rate(&self, configured: Option<u32>) -> Result<(), String> {
        match (configured, self.plan.buses.last()) {
            (Some(rate), Some(bus)) if !bus.rates_assumed && rate != bus.rates.nominal => {
                Err(format!(
                    "is for a bus of {} (Baudrate), and bit_rate = {} of this bus is another",
                    bit_rate(rate),
                    bus.rates.nominal
                ))
            }
            _ => Ok(()),
        }
    }

    fn device(&mut self, mut table: toml::Table, wiring: &mut Wiring) -> Result<(), String> {
        let mut common = toml::Table::new();
        for key in RawDevice::KEYS {
            if let Some(value) = table.remove(key) {
                common.insert(key.to_owned(), value);
            }
        }
        let raw: RawDevice = common
            .try_into()
            .map_err(|e: toml::de::Error| one_line(&e) + &suggest_key(&e))?;
        let name = &raw.name;
        check_name("name", name)?;
        let mut options = Options::deserialize(&raw.driver, table).map_err(|e| match e {
            OptionsError::UnknownDriver => format!(
                "driver = {:?} is not known; there is {}",
                raw.driver,
                DRIVERS.join(", ")
            ),
            OptionsError::Keys(e) => format!(
                "{name:?} ({}): {}; keys of every device: {}{}",
                raw.driver,
                one_line(&e),
                RawDevice::KEYS.join(", "),
                suggest_key(&e)
            ),
        })?;
        if let Some(file) = options.description() {
            let messages = dbc::read(&self.folder.join(file));
            options.describe(messages.map_err(|e| format!("{name:?}: file {e}"))?);
        }
        let mut own_address = options.default_address();
        if let Some(file) = options.eds() {
            let objects = eds::read(&self.folder.join(file));
            let objects = objects.map_err(|e| format!("{name:?}: eds {e}"))?;
            own_address = own_address.or(objects.node.map(u32::from));
            self.check_rate(objects.bit_rate)
                .map_err(|e| format!("{name:?}: eds {file:?} {e}"))?;
            options.describe_objects(objects);
        }
        if !(raw.max_silence_ms > 0.0 && raw.max_silence_ms <= 3.6e6) {
            return Err(format!(
                "{name:?}: max_silence_ms = {} must be above 0, at most an hour",
                raw.max_silence_ms
            ));
        }
        let max_silence = Nanos::from_seconds(raw.max_silence_ms * 1e-3);
        let bus = self.plan.buses.len() - 1;
        let (device, quiet_bus) = self
            .plan
            .buses
            .last()
            .map_or((0, false), |b| (b.devices.len(), b.listen_only));
        let address = raw.address.or(own_address).ok_or_else(|| {
            format!(
                "{name:?} ({}): address is missing; the driver's page says what it is",
                raw.driver
            )
        })?;
        let mut spec = Spec {
            address,
            max_silence,
            mode: if raw.listen_only || quiet_bus {
                Mode::Listen
            } else {
                Mode::Supervise
            },
            outputs: Outputs::default(),
        };
        let channel = |name: String, kind| ChannelPlan {
            name,
            kind,
            bus,
            device,
            max_silence,
        };
        let mut routes = self.sensors(name, &options.outputs(), &channel)?;
        for joint in raw.joint {
            let at = format!("{name:?}, joint {:?}", joint.name);
            check_name(&at, &joint.name)?;
            let map = joint_map(&at, &joint)?;
            if spec.outputs.0.contains(&joint.channel) {
                return Err(format!(
                    "{at}: channel = {} is already another joint",
                    joint.channel
                ));
            }
            if spec.outputs.0.try_push(joint.channel).is_err() {
                return Err(format!(
                    "{at}: a device has at most {} joints",
                    spec.outputs.0.capacity()
                ));
            }
            let of = wiring.channel_name(&joint.name).to_owned();
            check_name(&at, &of)?;
            let channel = match wiring.channel(&of) {
                Some(known) => known,
                None => self.channel(channel(of, Kind::Joint))?,
            };
            let device = (device, name.as_str(), max_silence);
            routes.push(Route {
                output: joint.channel,
                channel,
                kind: Kind::Joint,
                map,
                feed: Some(wiring.add(&at, &joint, device, channel, &map)?),
            });
        }
        // Built here once so that --check reports a wrong address or value; the bus thread builds
        // its own.
        options
            .device(&spec)
            .map_err(|e| format!("{name:?}: {e}"))?;
        check_turns(&options, &spec, &routes).map_err(|e| format!("{name:?}: {e}"))?;
        let plan = DevicePlan {
            name: raw.name,
            driver: raw.driver,
            options,
            spec,
            routes,
        };
        if self
            .plan
            .buses
            .iter()
            .map(|b| b.devices.len())
            .sum::<usize>()
            >= MAX_CHANNELS
        {
            return Err(format!("there are more than {MAX_CHANNELS} devices"));
        }
        if let Some(bus) = self.plan.buses.last_mut() {
            if bus.devices.iter().any(|d| d.name == plan.name) {
                return Err(format!("two devices are named {:?}", plan.name));
            }
            bus.devices.push(plan);
        }
        Ok(())
    }

    /// A channel for each output of device `name` that is no joint.
    fn sensors(
        &mut self,
        name: &str,
        outputs: &[OutputInfo],
        channel: &impl Fn(String, Kind) -> ChannelPlan,
    ) -> Result<Vec<Route>, String> {
        let mut routes = Vec::new();
        for output in outputs.iter().filter(|output| output.kind != Kind::Joint) {
            let name = if output.suffix.is_empty() {
                name.to_owned()
            } else {
                format!("{name}_{}", output.suffix)
            };
            check_name("the name of its channel", &name)?;
            routes.push(Route {
                output: output.number,
                channel: self.channel(channel(name, output.kind))?,
                kind: output.kind,
                map: JointMap::IDENTITY,
                feed: None,
            });
        }
        Ok(routes)
    }

    fn channel(&mut self, channel: ChannelPlan) -> Result<u32, String> {
        let named = self.plan.channels.iter().find(|c| c.name == channel.name);
        if let Some(other) = named.filter(|c| c.kind == channel.kind && c.bus != channel.bus) {
            let bus = |number: usize| self.plan.buses.get(number).map_or("", |b| &b.name);
            return Err(format!(
                "{:?} is on bus {:?} too; devices that measure one joint must be on one bus, \
                 because each bus has a thread of its own",
                channel.name,
                bus(other.bus)
            ));
        }
        if named.is_some() {
            return Err(format!(
                "two channels are named {:?}; joints and sensors need different names",
                channel.name
            ));
        }
        if self.plan.channels.len() >= MAX_CHANNELS {
            return Err(format!("there are more than {MAX_CHANNELS} channels"));
        }
        self.plan.channels.push(channel);
        u32::try_from(self.plan.channels.len() - 1).map_err(|e| e.to_string())
    }

    /// Checks that no identifier belongs to two devices, unless both only listen to it.
    fn check_claims(&self, place: &str) -> Result<(), String> {
        let Some(bus) = self.plan.buses.last() else {
            return Ok(());
        };
        let mut claimed: Vec<(&str, Box<dyn Device>)> = Vec::new();
        for plan in &bus.devices {
            let device = plan.options.device(&plan.spec).map_err(|e| e.to_string())?;
            for (other, taken) in &claimed {
                for (a, b) in device
                    .claims()
                    .iter()
                    .flat_map(|a| taken.claims().iter().map(move |b| (a, b)))
                {
                    if a.overlaps(b) && (a.exclusive || b.exclusive) {
                        return Err(format!(
                            "{place}: devices {:?} and {other:?} both claim identifier {}: one of \
                             their addresses is wrong",
                            plan.name, a.id
                        ));
                    }
                }
            }
            claimed.push((&plan.name, device));
        }
        Ok(())
    }
}

/// The conversion of a joint's table, checked; `at` is its place.
fn joint_map(at: &str, joint: &RawJoint) -> Result<JointMap, String> {
    if !joint.ratio.is_finite() || joint.ratio == 0.0 {
        return Err(format!(
            "{at}: ratio = {} must be a number other than 0",
            joint.ratio
        ));
    }
    if joint.sign.abs() != 1 {
        return Err(format!("{at}: sign = {} must be 1 or -1", joint.sign));
    }
    if !joint.offset_rad.is_finite() {
        return Err(format!(
            "{at}: offset_rad = {} must be a finite number",
            joint.offset_rad
        ));
    }
    // More than a full turn is no other angle: such a number is in degrees.
    if joint.offset_rad.abs() > TAU {
        return Err(format!(
            "{at}: offset_rad = {} looks like degrees; in rad it is {:.6} (at most a full \
             turn, {TAU:.6}, is possible)",
            joint.offset_rad,
            joint.offset_rad.to_radians()
        ));
    }
    Ok(JointMap {
        gain: f64::from(joint.sign) / joint.ratio,
        offset: joint.offset_rad,
    })
}

/// Checks that turns can be counted: a board that streams sends before its shaft has turned by half
/// its range.
fn check_turns(options: &Options, spec: &Spec, routes: &[Route]) -> Result<(), String> {
    let wraps = |route: &Route| route.feed.and_then(|feed| feed.wrap);
    let Some(wrap) = routes
        .iter()
        .filter_map(wraps)
        .min_by_key(|wrap| wrap.certain)
    else {
        return Ok(());
    };
    // A board that has been started.
    let mode = Mode::Listen;
    let board = options.board(&Spec {
        mode,
        ..spec.clone()
    });
    match board.map_err(|e| e.to_string())?.period() {
        Some(period) if period >= wrap.certain => Err(format!(
            "at max_speed_radps its shaft turns by half the range of wraps_rad in {} s, and it \
             sends only every {period} s: the turns cannot be counted; make its period shorter",
            wrap.certain
        )),
        _ => Ok(()),
    }
}

/// A TOML error in one line, with the key that it is about.
fn one_line(error: &toml::de::Error) -> String {
    error
        .to_string()
        .lines()
        .map(str::trim)
        .filter(|l| !l.is_empty())
        .collect::<Vec<_>>()
        .join(" ")
}

/// A suggestion for an unknown key of a device, out of the driver's and the common keys.
fn suggest_key(error: &toml::de::Error) -> String {
    // The message names the key first, then the driver's keys, each between backquotes.
    let mut words = error.message().split('`').skip(1).step_by(2);
    match words.next() {
        Some(unknown) if error.message().starts_with("unknown field") => {
            did_you_mean(unknown, words.chain(RawDevice::KEYS))
        }
        _ => String::new(),
    }
}

fn check_name(place: &str, name: &str) -> Result<(), String> {
    if name.is_empty() || name.len() > Name::CAPACITY || name.contains(['/', ',', '"', '\n', '\0'])
    {
        return Err(format!(
            "{place} = {name:?} must have 1 to {} bytes, without / , \" or line breaks",
            Name::CAPACITY
        ));
    }
    Ok(())
}

impl fmt::Display for Plan {
    /// A readable table; `proprio gateway --check` prints it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "robot {}: {} buses, {} channels",
            self.robot,
            self.buses.len(),
            self.channels.len()
        )?;
        for bus in &self.buses {
            let source = match &bus.source {
                Source::SocketCan(Adapter::Interface(name)) => format!("CAN interface {name}"),
                Source::SocketCan(named) => format!("CAN adapter with {named}"),
                Source::Virtual { name } => format!("virtual bus {name}"),
                Source::Replay { log, pace, stamps } => {
                    let pace = match pace {
                        Pace::Fast => "fast",
                        Pace::Recorded => "as recorded",
                    };
                    let stamps = match stamps {
                        Stamps::Detect => "",
                        Stamps::SinceStart => ", stamps since its start",
                        Stamps::SincePrevious => ", stamps since the previous line",
                    };
                    format!("log {} ({pace}{stamps})", log.display())
                }
            };
            write!(f, "\nbus {}: {source}", bus.name)?;
            if let Some(realtime) = bus.realtime {
                realtime
                    .cpu
                    .map_or(Ok(()), |cpu| write!(f, ", cpu {cpu}"))?;
                realtime
                    .priority
                    .map_or(Ok(()), |p| write!(f, ", SCHED_FIFO {p}"))?;
            }
            if bus.listen_only {
                write!(f, ", listens only")?;
            }
            writeln!(
                f,
                "\n  load at most {:.0} % of {}{}, {:.0} frames/s{}",
                bus.load.share * 100.0,
                bit_rate(bus.rates.nominal),
                if bus.rates_assumed { " (assumed)" } else { "" },
                bus.load.frames,
                if bus.load.is_high() {
                    "; above 70 % frames of low priority come late, and there is no room for \
                     others"
                } else {
                    ""
                }
            )?;
            for device in &bus.devices {
                if !device.options.states_period() {
                    writeln!(f, "  without {:?}: its period_ms is not given", device.name)?;
                }
            }
            for device in &bus.devices {
                let mut ids = String::new();
                if let Ok(built) = device.options.device(&device.spec) {
                    for claim in built.claims() {
                        write!(
                            ids,
                            " {}{}",
                            claim.id,
                            if claim.exclusive { "" } else { "*" }
                        )?;
                    }
                }
                let listen = if device.spec.mode == Mode::Listen {
                    ", listens only"
                } else {
                    ""
                };
                writeln!(
                    f,
                    "  {} ({}, address {}{listen}): identifiers{ids}",
                    device.name, device.driver, device.spec.address
                )?;
                for route in &device.routes {
                    let Some(channel) = self.channels.get(route.channel as usize) else {
                        continue;
                    };
                    write!(
                        f,
                        "    channel {:>3} {} {}",
                        route.channel,
                        channel.kind.word(),
                        channel.name
                    )?;
                    if let Some(feed) = &route.feed {
                        show_feed(f, &bus.joints, route, feed)?;
                    }
                    writeln!(f, ", stale after {} s", channel.max_silence)?;
                }
            }
            for coupling in &bus.joints.couplings {
                show_coupling(f, &bus.joints, coupling)?;
            }
        }
        writeln!(f, "\n* shared with other devices of the same board")
    }
}

/// The way of a device's output to a joint.
fn show_feed(
    f: &mut fmt::Formatter<'_>,
    joints: &Layout,
    route: &Route,
    feed: &Feed,
) -> fmt::Result {
    let shaft = joints.shafts.get(feed.shaft);
    if let Some(motor) = shaft.filter(|s| matches!(s.target, Target::Motor(..))) {
        write!(f, ", by the coupling; motor {}", motor.name)?;
    }
    let JointMap { gain, offset } = route.map;
    write!(
        f,
        " = {gain} * output {} of the device {offset:+} rad",
        route.output
    )?;
    show_takes(
        f,
        joints
            .source(feed)
            .map_or(Takes::ALL, |source| source.takes),
    )?;
    if let Some(wrap) = feed.wrap {
        let (centre, half) = (gain * wrap.centre + offset, 0.5 * (gain * wrap.range).abs());
        write!(
            f,
            ", turns counted, certain over {} s, else right from {:.4} to {:.4} rad",
            wrap.certain,
            centre - half,
            centre + half
        )?;
    }
    Ok(())
}

fn show_takes(f: &mut fmt::Formatter<'_>, takes: Takes) -> fmt::Result {
    if takes == Takes::ALL {
        return Ok(());
    }
    let words: Vec<_> = takes.quantities().map(wiring::word).collect();
    write!(f, " ({} alone)", words.join(", "))
}

/// The rows of a coupling.
fn show_coupling(
    f: &mut fmt::Formatter<'_>,
    joints: &Layout,
    coupling: &CouplingPlan,
) -> fmt::Result {
    let name = |shaft: usize| joints.shafts.get(shaft).map_or("", |shaft| &shaft.name);
    let condition = coupling.matrix.condition();
    write!(f, "  coupling, condition number {condition:.1}")?;
    let source = coupling
        .joints
        .first()
        .and_then(|(shaft, place)| joints.shafts.get(*shaft)?.sources.get(*place));
    show_takes(f, source.map_or(Takes::ALL, |source| source.takes))?;
    writeln!(f)?;
    for (number, (shaft, _)) in coupling.joints.iter().enumerate() {
        let weights = coupling.matrix.row(number).zip(&coupling.motors);
        let used = weights.filter(|(weight, _)| *weight != 0.0);
        let terms = used.map(|(weight, motor)| format!("{weight} * {}", name(*motor)));
        writeln!(
            f,
            "    {} = {}",
            name(*shaft),
            terms.collect::<Vec<_>>().join(" + ")
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::JointState;

    const ARM: &str = r#"
        schema = 1
        robot = "icub"
        [[bus]]
        name = "arm"
        source = { kind = "virtual", name = "arm" }
          [[bus.device]]
          driver = "icub_strain"
          name = "ft"
          address = 13
          max_silence_ms = 30
          full_scale_n = [1804.0, 1804.0, 1804.0]
          full_scale_nm = [31.0, 31.0, 31.0]
          [[bus.device]]
          driver = "icub_motor"
          name = "elbow_board"
          address = 4
            [[bus.device.joint]]
            name = "elbow"
            ratio = 100.0
            sign = -1
            offset_rad = 0.5
    "#;

    fn problem(from: &str, to: &str) -> String {
        assert!(ARM.contains(from), "{from}");
        Plan::parse(&ARM.replacen(from, to, 1), Path::new("."))
            .map(|p| p.to_string())
            .unwrap_err()
    }

    #[test]
    fn the_plan_resolves_channels_and_maps() {
        let plan = Plan::parse(ARM, Path::new(".")).unwrap();
        assert_eq!(plan.channel("ft"), Some(0));
        assert_eq!(plan.channel("elbow"), Some(1));
        let map = plan.buses[0].devices[1].routes[0].map;
        let joint = map.joint(JointState {
            position: 10.0,
            velocity: 100.0,
            ..JointState::ABSENT
        });
        assert!((joint.position - 0.4).abs() < 1e-15 && (joint.velocity + 1.0).abs() < 1e-15);
        assert!((map.device(joint).position - 10.0).abs() < 1e-12);
        assert!(plan.to_string().contains("3DA"), "{plan}");
    }

    #[test]
    fn each_mistake_has_one_clear_message() {
        for (from, to, expected) in [
            ("schema = 1", "schema = 2", "schema = 2 is not known"),
            (
                "robot = \"icub\"",
                "robot = \"i cub\"",
                "robot = \"i cub\": a robot's name begins with a letter or a digit",
            ),
            (
                "robot = \"icub\"",
                "robot = \"..\"",
                "robot = \"..\": a robot's name begins with a letter or a digit",
            ),
            (
                "robot = \"icub\"",
                "robbot = \"icub\"",
                "unknown field `robbot`, expected one of `schema`, `robot`, `bus`",
            ),
            (
                "kind = \"virtual\"",
                "kind = \"virtuel\"",
                "unknown variant `virtuel`",
            ),
            (
                "\"icub_strain\"",
                "\"icub_strian\"",
                "driver = \"icub_strian\" is not known; there is icub_strain, icub_imu",
            ),
            (
                "max_silence_ms = 30",
                "max_silence_ms = 0",
                "max_silence_ms = 0 must be above 0",
            ),
            (
                "full_scale_n = ",
                "full_scale_N = ",
                "unknown field `full_scale_N`",
            ),
            (
                "address = 13",
                "address = 15",
                "address = 15 is outside 1 to 14",
            ),
            (
                "address = 13",
                "",
                "\"ft\" (icub_strain): address is missing",
            ),
            (
                "offset_rad = 0.5",
                "offset_rad = 90.0",
                "offset_rad = 90 looks like degrees; in rad it is 1.570796",
            ),
            (
                "offset_rad = 0.5",
                "offset_rad = -6.3",
                "offset_rad = -6.3 looks like degrees",
            ),
            (
                "offset_rad = 0.5",
                "channel = 1",
                "joint channel 1 does not exist",
            ),
            (
                "full_scale_nm = [31.0, 31.0, 31.0]",
                "full_scale_nm = [31.0, 31.0, 31.0]\n[[bus.device.joint]]\nname = \"wrist\"",
                "this device measures no joint; remove its [[bus.device.joint]]",
            ),
            ("sign = -1", "sign = 2", "sign = 2 must be 1 or -1"),
            (
                "ratio = 100.0",
                "ratio = 0.0",
                "ratio = 0 must be a number other than 0",
            ),
            (
                "name = \"elbow\"",
                "name = \"ft\"",
                "two channels are named \"ft\"",
            ),
            (
                "name = \"elbow_board\"",
                "name = \"ft\"",
                "two devices are named \"ft\"",
            ),
        ] {
            let problem = problem(from, to);
            assert!(problem.contains(expected), "{from} -> {to}: {problem}");
        }
    }

    #[test]
    fn each_sensor_of_a_device_has_a_channel() {
        let mut builder = Builder {
            text: "",
            folder: Path::new("."),
            plan: Plan::parse(ARM, Path::new(".")).unwrap(),
        };
        let channel = |name, kind| ChannelPlan {
            name,
            kind,
            bus: 0,
            device: 2,
            max_silence: Nanos::ZERO,
        };
        let outputs = [
            OutputInfo::new(0, Kind::Wrench),
            OutputInfo::new(1, Kind::Joint),
            OutputInfo {
                suffix: "skin".into(),
                ..OutputInfo::new(7, Kind::Skin)
            },
        ];
        let routes = builder.sensors("hand", &outputs, &channel).unwrap();
        let of = |route: &Route| (route.output, route.channel, route.kind);
        assert_eq!(
            routes.iter().map(of).collect::<Vec<_>>(),
            [(0, 2, Kind::Wrench), (7, 3, Kind::Skin)]
        );
        let names: Vec<&str> = builder.plan.channels[2..]
            .iter()
            .map(|c| c.name.as_str())
            .collect();
        assert_eq!(names, ["hand", "hand_skin"]);
        assert_eq!(builder.sensors("none", &[], &channel), Ok(vec![]));
        let long = "x".repeat(Name::CAPACITY - 2);
        let problem = builder.sensors(&long, &outputs, &channel).unwrap_err();
        assert!(problem.starts_with("the name of its channel"), "{problem}");
    }

    #[test]
    fn an_unknown_key_leads_to_the_one_that_was_meant() {
        for (key, meant) in [
            ("max_silence = 30.0", "max_silence_ms"),
            ("listen = true", "listen_only"),
            ("adress = 3", "address"),
            ("perod_ms = 3", "period_ms"),
            ("pair_time_out_ms = 3", "pair_timeout_ms"),
        ] {
            let problem = problem("max_silence_ms = 30", key);
            assert!(
                problem.ends_with(&format!("did you mean {meant:?}?")),
                "{key}: {problem}"
            );
            assert!(problem.contains("keys of every device: driver, name"));
        }
        let problem = problem("max_silence_ms = 30", "velocity = true");
        assert!(!problem.contains("did you mean"), "{problem}");
    }

    #[test]
    fn a_bus_that_is_only_listened_to_has_no_device_that_sends() {
        let modes = |text: &str| {
            let plan = Plan::parse(text, Path::new(".")).unwrap();
            let modes: Vec<Mode> = plan.buses[0].devices.iter().map(|d| d.spec.mode).collect();
            (plan.buses[0].listen_only, modes)
        };
        let supervised = vec![Mode::Supervise; 2];
        assert_eq!(modes(ARM), (false, supervised));
        let quiet = ARM.replacen("name = \"arm\"", "name = \"arm\"\nlisten_only = true", 1);
        assert_eq!(modes(&quiet), (true, vec![Mode::Listen; 2]));
        let one = ARM.replacen("address = 13", "address = 13\nlisten_only = true", 1);
        assert_eq!(modes(&one), (false, vec![Mode::Listen, Mode::Supervise]));
    }

    #[test]
    fn two_devices_can_not_claim_one_identifier() {
        let second = "[[bus.device]]\n driver = \"icub_strain\"\n name = \"ft2\"\n \
                      address = 13\n [[bus.device]]";
        let problem = problem("[[bus.device]]", second);
        assert!(
            problem.contains("\"ft\" and \"ft2\" both claim identifier 0x3DA"),
            "{problem}"
        );
    }
}
