//! The contents of gateway.toml, unchecked. [`crate::plan`] checks and resolves them; nothing else
//! uses this form.

use crate::link::adapter::Adapter;
use crate::log::Stamps;
use serde::Deserialize;
use std::path::PathBuf;
use toml::Spanned;

/// The whole file.
#[derive(Debug, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct GatewayConfig {
    /// The version of the file format: 1.
    pub schema: u32,
    /// The robot's name: the first part of every service's name.
    pub robot: String,
    /// The buses.
    #[serde(default)]
    pub bus: Vec<BusConfig>,
}

/// `[[bus]]`.
#[derive(Debug, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct BusConfig {
    /// The bus's name, in messages and in `proprio status`.
    pub name: String,
    /// The source of its frames.
    pub source: FrameSource,
    /// Its bit rate \[bit/s\]; that of the arbitration phase for CAN FD. It is used to compute the
    /// load, where the interface does not tell it; it is not set.
    pub bit_rate: Option<u32>,
    /// The bit rate of the data phase of CAN FD \[bit/s\].
    pub data_bit_rate: Option<u32>,
    /// Scheduling of its thread.
    pub realtime: Option<Scheduling>,
    /// Never send to it: every device of the bus has `listen_only`.
    #[serde(default)]
    pub listen_only: bool,
    /// `[[bus.device]]`: common keys and the driver's own keys in one table.
    #[serde(default)]
    #[cfg_attr(test, schemars(with = "Vec<DeviceConfig>"))]
    pub device: Vec<Spanned<toml::Table>>,
    /// `[[bus.coupling]]`: joints that several motors move together.
    #[serde(default)]
    pub coupling: Vec<CouplingConfig>,
}

/// The source of a bus's frames.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum FrameSource {
    /// A CAN interface of the kernel: `interface = "can0"`, or its adapter by `serial = "..."` or
    /// `usb_port = "1-2.3"`, with `channel = 0` if that has several interfaces. The adapter is
    /// looked for whenever the link is opened.
    SocketCan(Adapter),
    /// The virtual bus on the loopback interface.
    Virtual {
        /// The bus's name: all programs of a domain that name it hear each other.
        name: String,
    },
    /// A recorded log, of any format of [`crate::log`].
    Replay {
        /// The file, relative to the configuration.
        log: PathBuf,
        /// The replay speed.
        #[serde(default)]
        pace: Pace,
        /// What relative stamps count from; by default the log tells.
        #[serde(default)]
        stamps: Stamps,
    },
}

/// The speed of a replay.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "lowercase")]
pub enum Pace {
    /// As recorded; stamps are shifted to the present.
    #[default]
    Recorded,
    /// As fast as possible, with the log's own stamps; offline only.
    Fast,
}

/// Scheduling of a thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Scheduling {
    /// The processor it is bound to.
    pub cpu: Option<usize>,
    /// Its SCHED_FIFO priority, 1 to 99.
    pub priority: Option<i32>,
}

/// The keys common to all devices.
#[derive(Debug, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct DeviceConfig {
    /// The driver's name: a page of the book.
    pub driver: String,
    /// The device's name, in messages and in `proprio status`; for a sensor also the name of its
    /// channel, which `estimator.toml` reads.
    pub name: String,
    /// Its address, as the driver defines it: the page of the driver tells. Some drivers have a
    /// default.
    pub address: Option<u32>,
    /// Maximum silence \[ms\]: after so long without a reading the device is `silent`, and it is
    /// started again.
    #[serde(default = "default_max_silence_ms")]
    pub max_silence_ms: f64,
    /// Never send to it: another program commands it.
    #[serde(default)]
    pub listen_only: bool,
    /// `[[bus.device.joint]]`.
    #[serde(default)]
    pub joint: Vec<JointConfig>,
}

impl DeviceConfig {
    /// The names of the keys above; all other keys are the driver's.
    pub const KEYS: [&str; 6] = [
        "driver",
        "name",
        "address",
        "max_silence_ms",
        "listen_only",
        "joint",
    ];
}

const fn default_max_silence_ms() -> f64 {
    100.0
}

/// `[[bus.device.joint]]`: the joint, or the motor of a coupling, that a channel of the device
/// measures: joint = sign * device / ratio + offset.
#[derive(Debug, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct JointConfig {
    /// The name of the joint, or of the motor. Several devices of a bus may measure one joint if
    /// `takes` says which gives what.
    pub name: String,
    /// The device's channel, of a device that measures several joints: the driver's page tells.
    #[serde(default)]
    pub channel: u8,
    /// Gear ratio: how far the device turns while the joint turns by one.
    #[serde(default = "one")]
    pub ratio: f64,
    /// 1, or -1 if the device counts the other way than the axis of the URDF.
    #[serde(default = "plus")]
    pub sign: i8,
    /// The joint's angle where the device reports zero \[rad\].
    #[serde(default)]
    pub offset_rad: f64,
    /// What is taken of this device; all by default.
    pub takes: Option<Vec<JointQuantity>>,
    /// The ends of the range in which the device reports its angle and begins anew \[rad\], if the
    /// joint goes beyond: `[0.0, 6.283185307179586]` for one turn of the device. Needs the two keys
    /// below.
    pub wraps_rad: Option<[f64; 2]>,
    /// The joint's angle to which the turn is chosen nearest, at start and after a gap \[rad\].
    /// Right if the joint is within half a range (divided by `ratio`) of it: `--check` prints the
    /// limits.
    pub centre_rad: Option<f64>,
    /// The highest speed of the device's shaft, not of the joint \[rad/s\]. While no two readings
    /// are so far apart in time that it could have turned by half the range, the turn is certain.
    pub max_speed_radps: Option<f64>,
}

/// A quantity that a device measures of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "lowercase")]
pub enum JointQuantity {
    /// `"position"`.
    Position,
    /// `"velocity"`.
    Velocity,
    /// `"acceleration"`.
    Acceleration,
    /// `"torque"`.
    Torque,
    /// `"current"`: of the motor.
    Current,
}

/// `[[bus.coupling]]`: joints = matrix * motors. Velocities and accelerations follow the same
/// matrix, torques the transpose of its inverse: power is conserved.
#[derive(Debug, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct CouplingConfig {
    /// The joints' names.
    pub joints: Vec<String>,
    /// The motors, as many: names of `[[bus.device.joint]]` of this bus. `ratio`, `sign` and
    /// `offset_rad` there are applied before the matrix.
    pub motors: Vec<String>,
    /// A row for each joint, a column for each motor.
    pub matrix: Vec<Vec<f64>>,
    /// What is taken of the motors; all by default. The rest comes from devices at the joints.
    pub takes: Option<Vec<JointQuantity>>,
}

const fn one() -> f64 {
    1.0
}

const fn plus() -> i8 {
    1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema;
    use proprio_drivers::DRIVERS;
    use serde_json::json;

    /// All but the definitions of devices of one driver, which are the drivers' part.
    #[test]
    fn the_reference_of_gateway_toml_is_new() {
        schema::check("gateway.schema.json", |old| {
            let mut made = schema::of::<GatewayConfig>();
            let mut device = json!({ "oneOf": [] });
            let place = "/properties/bus/items/properties/device/items";
            if let Some(place) = made.pointer_mut(place) {
                std::mem::swap(place, &mut device);
            }
            let one_of: Vec<_> = (DRIVERS.iter())
                .map(|driver| json!({ "$ref": format!("#/definitions/{driver}") }))
                .collect();
            made.pointer_mut(place).expect("devices")["oneOf"] = one_of.into();
            let names = schema::entries(&mut device, "properties").keys();
            assert!(
                names.eq(DeviceConfig::KEYS
                    .iter()
                    .collect::<std::collections::BTreeSet<_>>())
            );
            let definitions = schema::entries(&mut made, "definitions");
            definitions.insert("device".into(), device);
            for driver in DRIVERS {
                definitions.insert((*driver).into(), old["definitions"][*driver].clone());
            }
            made
        });
    }
}
