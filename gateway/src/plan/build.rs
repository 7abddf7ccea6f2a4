//! From the tables of gateway.toml to the plan, checked.

use super::wiring::{NewDevice, Wiring, angle};
use super::words::did_you_mean;
use super::{BusPlan, ChannelPlan, DevicePlan, OutputPlan, Plan, bit_rate};
use crate::config::{BusConfig, DeviceConfig, FrameSource, GatewayConfig, JointConfig, Scheduling};
use crate::joints::{JointMap, JointsPlan};
use crate::load::{self, BitRates, BusLoad, Participant};
use crate::scan::contested;
use crate::{dbc, eds};
use proprio_drivers::{DRIVERS, Device, Mode, Options, OptionsError, OutputInfo, Outputs, Spec};
use proprio_topics::{Kind, MAX_BUSES, MAX_CHANNELS, Name, Nanos, ROBOT_NAME, is_robot_name};
use std::path::Path;

/// The highest rates that transceivers are made for: with these a load is never overestimated.
const HIGHEST: BitRates = BitRates {
    nominal: 1_000_000,
    data: 8_000_000,
};

impl Plan {
    /// Checks a configuration given as text; paths in it are relative to `folder`.
    ///
    /// # Errors
    /// A message with the place, the error and the legal values.
    pub fn parse(text: &str, folder: &Path) -> Result<Self, String> {
        let config: GatewayConfig = toml::from_str(text).map_err(|e| e.to_string())?;
        check(&config)?;
        let mut builder = Builder {
            text,
            folder,
            plan: Self {
                robot: config.robot,
                buses: vec![],
                channels: vec![],
            },
        };
        for bus in config.bus {
            builder.bus(bus)?;
        }
        Ok(builder.plan)
    }
}

fn check(config: &GatewayConfig) -> Result<(), String> {
    if config.schema != 1 {
        return Err(format!(
            "schema = {} is not known; this version reads schema = 1",
            config.schema
        ));
    }
    if !is_robot_name(&config.robot) {
        return Err(format!("robot = {:?}: {ROBOT_NAME}", config.robot));
    }
    match config.bus.len() {
        0 => Err("there is no [[bus]]: a gateway needs at least one".into()),
        1..=MAX_BUSES => Ok(()),
        buses => Err(format!(
            "there are {buses} buses; at most {MAX_BUSES} are possible"
        )),
    }
}

/// The plan as far as the file has been read: its last bus is the one whose table is read.
struct Builder<'a> {
    text: &'a str,
    folder: &'a Path,
    plan: Plan,
}

impl Builder<'_> {
    fn bus(&mut self, config: BusConfig) -> Result<(), String> {
        let place = format!("bus {:?}", config.name);
        check_name("bus: name", &config.name)?;
        let source = self.source(&place, &config)?;
        check_numbers(&place, &config)?;
        self.plan.buses.push(BusPlan {
            name: config.name,
            source,
            realtime: config.realtime,
            listen_only: config.listen_only,
            rates: BitRates {
                nominal: config.bit_rate.unwrap_or(HIGHEST.nominal),
                data: config.data_bit_rate.unwrap_or(HIGHEST.data),
            },
            rates_assumed: config.bit_rate.is_none(),
            load: BusLoad::default(),
            devices: Vec::new(),
            joints: JointsPlan::default(),
        });
        let mut wiring = Wiring::new(config.coupling).map_err(|e| format!("{place}, {e}"))?;
        for table in config.device {
            let before = self.text.get(..table.span().start);
            let line = before.map_or(0, |before| before.matches('\n').count() + 1);
            self.device(table.into_inner(), &mut wiring)
                .map_err(|e| format!("{place}, device at line {line}: {e}"))?;
        }
        let (joints, shown) = wiring.finish().map_err(|e| format!("{place}, {e}"))?;
        for shown in shown {
            if let Some(channel) = self.plan.channels.get_mut(shown.channel as usize) {
                (channel.device, channel.max_silence) = (shown.device, shown.max_silence);
            }
        }
        let Some(bus) = self.plan.buses.last_mut() else {
            return Ok(());
        };
        bus.joints = joints;
        check_claims(&place, &bus.devices)?;
        bus.load = load(&bus.devices, bus.rates).map_err(|e| format!("{place}: {e}"))?;
        Ok(())
    }

    /// The source of a bus, which no bus before has; nor its name.
    fn source(&self, place: &str, config: &BusConfig) -> Result<FrameSource, String> {
        let mut source = config.source.clone();
        match &mut source {
            FrameSource::Virtual { name } => check_name(&format!("{place}: source.name"), name)?,
            FrameSource::Replay { log, .. } => *log = self.folder.join(&*log),
            FrameSource::SocketCan(_) => {}
        }
        for other in &self.plan.buses {
            if other.name == config.name {
                return Err(format!(
                    "two buses are named {:?}; each bus needs a different name",
                    config.name
                ));
            }
            // Several buses may replay one log.
            if other.source == source && !matches!(source, FrameSource::Replay { .. }) {
                return Err(format!(
                    "{place}: same source as bus {:?}; list the devices of both under one [[bus]]",
                    other.name
                ));
            }
        }
        Ok(source)
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

    fn device(&mut self, table: toml::Table, wiring: &mut Wiring) -> Result<(), String> {
        let (config, mut options) = split(table)?;
        let name = &config.name;
        let default_address = self.describe(name, &mut options)?;
        if !(config.max_silence_ms > 0.0 && config.max_silence_ms <= 3.6e6) {
            return Err(format!(
                "{name:?}: max_silence_ms = {} must be above 0, at most an hour",
                config.max_silence_ms
            ));
        }
        let address = config.address.or(default_address).ok_or_else(|| {
            format!(
                "{name:?} ({}): address is missing; the driver's page says what it is",
                config.driver
            )
        })?;
        let (number, quiet_bus) =
            (self.plan.buses.last()).map_or((0, false), |bus| (bus.devices.len(), bus.listen_only));
        let new = NewDevice {
            name,
            bus: self.plan.buses.len() - 1,
            number,
            max_silence: Nanos::from_seconds(config.max_silence_ms * 1e-3),
        };
        let mut spec = Spec {
            address,
            max_silence: new.max_silence,
            mode: if config.listen_only || quiet_bus {
                Mode::Listen
            } else {
                Mode::Supervise
            },
            outputs: Outputs::default(),
        };
        let mut outputs = self.sensors(&new, &options.outputs())?;
        for joint in &config.joint {
            let at = format!("{name:?}, joint {:?}", joint.name);
            check_name(&at, &joint.name)?;
            outputs.push(self.joint(&at, joint, &new, &mut spec.outputs, wiring)?);
        }
        // Built here once so that --check reports a wrong address or value; the bus thread builds
        // its own.
        options
            .device(&spec)
            .map_err(|e| format!("{name:?}: {e}"))?;
        check_turns(&options, &spec, &outputs).map_err(|e| format!("{name:?}: {e}"))?;
        self.add(DevicePlan {
            name: config.name,
            driver: config.driver,
            options,
            spec,
            outputs,
        })
    }

    /// Gives a driver the files that describe its device; returns the address that it has if none
    /// is given.
    fn describe(&self, name: &str, options: &mut Options) -> Result<Option<u32>, String> {
        if let Some(file) = options.description() {
            let messages = dbc::read(&self.folder.join(file));
            options.describe(messages.map_err(|e| format!("{name:?}: file {e}"))?);
        }
        let mut address = options.default_address();
        if let Some(file) = options.eds() {
            let objects = eds::read(&self.folder.join(file));
            let objects = objects.map_err(|e| format!("{name:?}: eds {e}"))?;
            address = address.or(objects.node.map(u32::from));
            self.check_rate(objects.bit_rate)
                .map_err(|e| format!("{name:?}: eds {file:?} {e}"))?;
            options.describe_objects(objects);
        }
        Ok(address)
    }

    /// The output of a joint's table, which is added to those `used`; `at` is its place.
    fn joint(
        &mut self,
        at: &str,
        joint: &JointConfig,
        device: &NewDevice<'_>,
        used: &mut Outputs,
        wiring: &mut Wiring,
    ) -> Result<OutputPlan, String> {
        let map = joint_map(at, joint)?;
        if used.0.contains(&joint.channel) {
            return Err(format!(
                "{at}: channel = {} is already another joint",
                joint.channel
            ));
        }
        if used.0.try_push(joint.channel).is_err() {
            return Err(format!(
                "{at}: a device has at most {} joints",
                used.0.capacity()
            ));
        }
        let name = wiring.channel_name(&joint.name).to_owned();
        check_name(at, &name)?;
        let channel = match wiring.channel(&name) {
            Some(known) => known,
            None => self.channel(device.channel(name, Kind::Joint))?,
        };
        Ok(OutputPlan {
            number: joint.channel,
            channel,
            kind: Kind::Joint,
            map,
            input: Some(wiring.add(at, joint, device, channel, &map)?),
        })
    }

    /// An output with a channel for each output of a device that is no joint.
    fn sensors(
        &mut self,
        device: &NewDevice<'_>,
        outputs: &[OutputInfo],
    ) -> Result<Vec<OutputPlan>, String> {
        let mut sensors = Vec::new();
        for output in outputs.iter().filter(|output| output.kind != Kind::Joint) {
            let name = if output.suffix.is_empty() {
                device.name.to_owned()
            } else {
                format!("{}_{}", device.name, output.suffix)
            };
            check_name("the name of its channel", &name)?;
            sensors.push(OutputPlan {
                number: output.number,
                channel: self.channel(device.channel(name, output.kind))?,
                kind: output.kind,
                map: JointMap::IDENTITY,
                input: None,
            });
        }
        Ok(sensors)
    }

    /// Adds a channel; returns its number.
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

    /// Adds a device to the last bus.
    fn add(&mut self, device: DevicePlan) -> Result<(), String> {
        let devices = self.plan.buses.iter().map(|bus| bus.devices.len());
        if devices.sum::<usize>() >= MAX_CHANNELS {
            return Err(format!("there are more than {MAX_CHANNELS} devices"));
        }
        if let Some(bus) = self.plan.buses.last_mut() {
            if bus.devices.iter().any(|other| other.name == device.name) {
                return Err(format!("two devices are named {:?}", device.name));
            }
            bus.devices.push(device);
        }
        Ok(())
    }
}

/// Checks the numbers of a bus's table.
fn check_numbers(place: &str, config: &BusConfig) -> Result<(), String> {
    if let Some(Scheduling {
        priority: Some(priority),
        ..
    }) = config.realtime
        && !(1..=99).contains(&priority)
    {
        return Err(format!(
            "{place}: realtime.priority = {priority} must be 1 to 99"
        ));
    }
    for (key, rate) in [
        ("bit_rate", config.bit_rate),
        ("data_bit_rate", config.data_bit_rate),
    ] {
        if let Some(rate) = rate
            && !(10_000..=10_000_000).contains(&rate)
        {
            return Err(format!(
                "{place}: {key} = {rate} must be 10000 to 10000000 bit/s"
            ));
        }
    }
    Ok(())
}

/// The common keys of a device's table, and those of its driver.
fn split(mut table: toml::Table) -> Result<(DeviceConfig, Options), String> {
    let mut common = toml::Table::new();
    for key in DeviceConfig::KEYS {
        if let Some(value) = table.remove(key) {
            common.insert(key.to_owned(), value);
        }
    }
    let config: DeviceConfig = common
        .try_into()
        .map_err(|e: toml::de::Error| one_line(&e) + &suggest_key(&e))?;
    check_name("name", &config.name)?;
    let options = Options::deserialize(&config.driver, table).map_err(|e| match e {
        OptionsError::UnknownDriver => format!(
            "driver = {:?} is not known; there is {}",
            config.driver,
            DRIVERS.join(", ")
        ),
        OptionsError::Keys(e) => format!(
            "{:?} ({}): {}; keys of every device: {}{}",
            config.name,
            config.driver,
            one_line(&e),
            DeviceConfig::KEYS.join(", "),
            suggest_key(&e)
        ),
    })?;
    Ok((config, options))
}

/// The load of a bus with these devices.
fn load(devices: &[DevicePlan], rates: BitRates) -> Result<BusLoad, String> {
    let participants = devices.iter().map(|device| Participant {
        options: &device.options,
        spec: &device.spec,
        outputs: device.outputs.iter().map(|o| (o.number, o.kind)).collect(),
    });
    let participants: Vec<_> = participants.collect();
    load::of_bus(&participants, rates).map_err(|e| e.to_string())
}

/// Checks that no identifier belongs to two devices, unless both only listen to it.
fn check_claims(place: &str, devices: &[DevicePlan]) -> Result<(), String> {
    let mut claimed: Vec<(&str, Box<dyn Device>)> = Vec::new();
    for plan in devices {
        let device = plan.options.device(&plan.spec).map_err(|e| e.to_string())?;
        for (other, taken) in &claimed {
            if let Some(claim) = contested(device.claims(), taken.claims()) {
                return Err(format!(
                    "{place}: devices {:?} and {other:?} both claim identifier {}: one of their \
                     addresses is wrong",
                    plan.name, claim.id
                ));
            }
        }
        claimed.push((&plan.name, device));
    }
    Ok(())
}

/// The conversion of a joint's table, checked; `at` is its place.
fn joint_map(at: &str, joint: &JointConfig) -> Result<JointMap, String> {
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
    angle(at, "offset_rad", joint.offset_rad)?;
    Ok(JointMap {
        gain: f64::from(joint.sign) / joint.ratio,
        offset: joint.offset_rad,
    })
}

/// Checks that turns can be counted: a board that streams sends before its shaft has turned by half
/// its range.
fn check_turns(options: &Options, spec: &Spec, outputs: &[OutputPlan]) -> Result<(), String> {
    let wraps = outputs.iter().filter_map(|output| output.input?.wrap);
    let Some(wrap) = wraps.min_by_key(|wrap| wrap.certain) else {
        return Ok(());
    };
    // A board that has been started.
    let board = options.board(&spec.in_mode(Mode::Listen));
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
            did_you_mean(unknown, words.chain(DeviceConfig::KEYS))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_sensor_of_a_device_has_a_channel() {
        let mut builder = Builder {
            text: "",
            folder: Path::new("."),
            plan: Plan {
                robot: "r".into(),
                buses: vec![],
                channels: vec![],
            },
        };
        let device = |name| NewDevice {
            name,
            bus: 0,
            number: 2,
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
        let sensors = builder.sensors(&device("hand"), &outputs).unwrap();
        let key = |o: &OutputPlan| (o.number, o.channel, o.kind);
        assert_eq!(
            sensors.iter().map(key).collect::<Vec<_>>(),
            [(0, 0, Kind::Wrench), (7, 1, Kind::Skin)]
        );
        let names: Vec<&str> = builder
            .plan
            .channels
            .iter()
            .map(|c| c.name.as_str())
            .collect();
        assert_eq!(names, ["hand", "hand_skin"]);
        assert_eq!(builder.sensors(&device("none"), &[]), Ok(vec![]));
        let long = "x".repeat(Name::CAPACITY - 2);
        let problem = builder.sensors(&device(&long), &outputs).unwrap_err();
        assert!(problem.starts_with("the name of its channel"), "{problem}");
    }
}
