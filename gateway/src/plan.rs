//! The checked and resolved form of gateway.toml, which the rest of the gateway uses.
//!
//! `build` checks the tables of the file ([`crate::config`]), `show` prints the plan. A joint is
//! measured by one output of a device, or by several (`takes`), or by the motors of a coupling:
//! `wiring` resolves that to the bus's [`JointsPlan`]; each [`OutputPlan`] says where it leads.

mod build;
mod show;
mod wiring;
mod words;

pub use crate::joints::JointMap;
pub use words::did_you_mean;

use crate::config::{FrameSource, Pace, Scheduling};
use crate::joints::{JointsPlan, ShaftInput};
use crate::link::adapter::Adapter;
use crate::link::replay::Matching;
use crate::load::{BitRates, BusLoad};
use crate::scan::{FILL_IN, placeholders};
use proprio_drivers::{Options, Spec};
use proprio_topics::{Description, Entry, Kind, Name, Nanos, Publisher, Role};
use std::path::{Path, PathBuf};

/// An unusable configuration: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", .file.display())]
pub struct PlanError {
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
    pub source: FrameSource,
    /// Scheduling of its thread.
    pub realtime: Option<Scheduling>,
    /// Nothing is ever sent to it: all its devices only listen.
    pub listen_only: bool,
    /// Its bit rates, for its load.
    pub rates: BitRates,
    /// The rates are not those of the configuration, but the highest possible.
    pub rates_assumed: bool,
    /// What its devices need of it.
    pub load: BusLoad,
    /// Its devices.
    pub devices: Vec<DevicePlan>,
    /// Its joints: which outputs of devices give them, and how.
    pub joints: JointsPlan,
}

impl BusPlan {
    /// Whether it can not carry what its devices send. A log was carried, and so is what another
    /// program has set up.
    fn is_overloaded(&self) -> bool {
        let is_log = matches!(self.source, FrameSource::Replay { .. });
        self.load.share > 1.0 && !self.listen_only && !is_log
    }

    /// The name of its interface in a log.
    #[must_use]
    pub fn interface(&self) -> &str {
        match &self.source {
            FrameSource::SocketCan(Adapter::Interface(name)) | FrameSource::Virtual { name } => {
                name
            }
            FrameSource::SocketCan(_) | FrameSource::Replay { .. } => &self.name,
        }
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
    /// Its outputs in use; empty for a device that measures nothing.
    pub outputs: Vec<OutputPlan>,
}

/// One output of a device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutputPlan {
    /// Its number on the device.
    pub number: u8,
    /// The number of its channel.
    pub channel: u32,
    /// The kind of the channel.
    pub kind: Kind,
    /// The conversion from device angle to joint angle; the identity for sensors.
    pub map: JointMap,
    /// Where a joint's state leads, in [`BusPlan::joints`]; `None` for sensors. Then `channel` is
    /// only that of readings that are no joint's states.
    pub input: Option<ShaftInput>,
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
    /// [`PlanError`] with file, place, value and the legal values.
    pub fn load(file: &Path) -> Result<Self, PlanError> {
        Self::read(file).map(|(plan, _)| plan)
    }

    /// The plan, and the text that it is made of.
    fn read(file: &Path) -> Result<(Self, String), PlanError> {
        let error = |problem| PlanError {
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
    pub fn load_live(file: &Path) -> Result<Self, PlanError> {
        let (plan, text) = Self::read(file)?;
        let left = placeholders(&text);
        let fast = |bus: &&BusPlan| {
            matches!(
                bus.source,
                FrameSource::Replay {
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
        Err(PlanError { file, problem })
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
                (FrameSource::SocketCan(Adapter::Interface(name)), _) => Some(name.as_str()),
                // Which interface an adapter was when a log was recorded is not known.
                (FrameSource::SocketCan(_), _) => None,
                (FrameSource::Virtual { name }, _) => Some(name.as_str()),
                (FrameSource::Replay { log, .. }, Some(FrameSource::Replay { log: own, .. }))
                    if log != own =>
                {
                    continue;
                }
                (FrameSource::Replay { .. }, _) => None,
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

/// A bit rate in words.
fn bit_rate(rate: u32) -> String {
    match rate {
        1_000_000.. => format!("{} Mbit/s", f64::from(rate) / 1e6),
        _ => format!("{} kbit/s", f64::from(rate) / 1e3),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_drivers::Mode;
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
        let map = plan.buses[0].devices[1].outputs[0].map;
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
