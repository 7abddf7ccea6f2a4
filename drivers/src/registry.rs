//! The drivers: one list from which their names, their keys and their devices follow.

#[cfg(feature = "recognise")]
use crate::Frame;
use crate::objects::Objects;
#[cfg(feature = "recognise")]
use crate::recognise::{self, Finding, Recognise, Traffic};
use crate::signal::Message;
#[cfg(feature = "boards")]
use crate::{Board, Simulate};
use crate::{
    Device, Driver, OutputInfo, Spec, SpecError, aidin_aft200, ati_netcanoem, canopen_drive,
    canopen_encoder, canopen_sync, cubemars, damiao, dbc, icub_imu, icub_mais, icub_mc4,
    icub_motor, icub_pos, icub_skin, icub_strain, jr3_can, moteus, myactuator, odrive, openimu,
    optoforce_daq, robotous_rft, robstride, vesc, xsens_mti,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::Kind;
use serde::Deserialize;

/// Why a driver's keys cannot be read.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OptionsError<E> {
    /// There is no driver of that name; [`DRIVERS`] lists them.
    #[error("there is no driver of that name")]
    UnknownDriver,
    /// A key is unknown or has a wrong value.
    #[error("its keys are wrong: {0}")]
    Keys(E),
}

macro_rules! drivers {
    ($($(#[$doc:meta])* $variant:ident: $module:ident::$options:ident,)+) => {
        /// The names of all drivers, as gateway.toml writes them.
        pub const DRIVERS: &[&str] = &[$(<$module::$options as Driver>::NAME),+];

        /// What each driver has for recognising its devices.
        #[cfg(feature = "recognise")]
        const RECOGNISERS: &[Recogniser] = &[$(Recogniser {
            driver: <$module::$options as Driver>::NAME,
            recognise: <$module::$options as Recognise>::recognise,
            questions: <$module::$options as Recognise>::questions,
            asked_by_name: <$module::$options as Recognise>::ASKED_BY_NAME,
        }),+];

        /// Each driver's keys, as a schema.
        #[cfg(test)]
        fn schemas() -> Vec<(&'static str, serde_json::Value)> {
            [$((
                <$module::$options as Driver>::NAME,
                crate::schema::of::<$module::$options>(),
            )),+].into()
        }

        /// A driver with its keys.
        #[derive(Debug, Clone, PartialEq)]
        #[non_exhaustive]
        pub enum Options {
            $($(#[$doc])* $variant($module::$options),)+
        }

        impl Options {
            /// Reads the keys of driver `driver`.
            ///
            /// # Errors
            /// [`OptionsError`]: no such driver, or an unknown key or wrong value (the
            /// deserializer's message).
            pub fn deserialize<'de, D: serde::Deserializer<'de>>(
                driver: &str,
                keys: D,
            ) -> Result<Self, OptionsError<D::Error>> {
                $(if driver == <$module::$options as Driver>::NAME {
                    return <$module::$options>::deserialize(keys)
                        .map(Self::$variant)
                        .map_err(OptionsError::Keys);
                })+
                Err(OptionsError::UnknownDriver)
            }

            /// The address of a device whose table has none ([`Driver::ADDRESS`]).
            #[must_use]
            pub const fn default_address(&self) -> Option<u32> {
                match self {
                    $(Self::$variant(_) => <$module::$options as Driver>::ADDRESS,)+
                }
            }

            /// Whether its devices need a bus with CAN FD ([`Driver::needs_fd`]).
            #[must_use]
            pub fn needs_fd(&self) -> bool {
                match self {
                    $(Self::$variant(options) => options.needs_fd(),)+
                }
            }

            /// Whether it is known how often its devices send ([`Driver::states_period`]).
            #[must_use]
            pub fn states_period(&self) -> bool {
                match self {
                    $(Self::$variant(options) => options.states_period(),)+
                }
            }

            /// The file that describes the device ([`Driver::description`]).
            #[must_use]
            pub fn description(&self) -> Option<&str> {
                match self {
                    $(Self::$variant(options) => options.description(),)+
                }
            }

            /// Takes the contents of that file.
            pub fn describe(&mut self, messages: Vec<Message>) {
                match self {
                    $(Self::$variant(options) => options.describe(messages),)+
                }
            }

            /// The EDS or DCF file that describes the device ([`Driver::eds`]).
            #[must_use]
            pub fn eds(&self) -> Option<&str> {
                match self {
                    $(Self::$variant(options) => options.eds(),)+
                }
            }

            /// Takes the objects of that file.
            pub fn describe_objects(&mut self, objects: Objects) {
                match self {
                    $(Self::$variant(options) => options.describe_objects(objects),)+
                }
            }

            /// The outputs of its devices.
            #[must_use]
            pub fn outputs(&self) -> Vec<OutputInfo> {
                match self {
                    $(Self::$variant(options) => options.outputs(),)+
                }
            }

            /// The host's side of one device.
            ///
            /// # Errors
            /// [`SpecError`]: an address, joint or value that is invalid for the family.
            pub fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
                check_joints(spec, &self.outputs())?;
                match self {
                    $(Self::$variant(options) => options.device(spec),)+
                }
            }

            /// The device's own side.
            ///
            /// # Errors
            /// As [`Options::device`].
            #[cfg(feature = "boards")]
            pub fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
                check_joints(spec, &self.outputs())?;
                match self {
                    $(Self::$variant(options) => options.board(spec),)+
                }
            }
        }
    };
}

drivers! {
    /// iCub F/T boards.
    IcubStrain: icub_strain::IcubStrainOptions,
    /// iCub IMUs.
    IcubImu: icub_imu::IcubImuOptions,
    /// iCub 2FOC motor boards.
    IcubMotor: icub_motor::IcubMotorOptions,
    /// Older iCub motor boards.
    IcubMc4: icub_mc4::IcubMc4Options,
    /// iCub POS encoders.
    IcubPos: icub_pos::IcubPosOptions,
    /// iCub skin.
    IcubSkin: icub_skin::IcubSkinOptions,
    /// iCub Hall sensors.
    IcubMais: icub_mais::IcubMaisOptions,
    /// ATI F/T sensors.
    AtiNetcanoem: ati_netcanoem::AtiNetcanoemOptions,
    /// CANopen drives.
    CanopenDrive: canopen_drive::CanopenDriveOptions,
    /// CANopen encoders.
    CanopenEncoder: canopen_encoder::CanopenEncoderOptions,
    /// The SYNC of a CANopen bus.
    CanopenSync: canopen_sync::CanopenSyncOptions,
    /// moteus controllers.
    Moteus: moteus::MoteusOptions,
    /// ODrive motor controllers.
    Odrive: odrive::OdriveOptions,
    /// CubeMars actuators.
    Cubemars: cubemars::CubemarsOptions,
    /// Damiao actuators.
    Damiao: damiao::DamiaoOptions,
    /// MyActuator RMD actuators.
    Myactuator: myactuator::MyactuatorOptions,
    /// RobStride actuators and CyberGear.
    Robstride: robstride::RobstrideOptions,
    /// VESC motor controllers.
    Vesc: vesc::VescOptions,
    /// Xsens MTi.
    XsensMti: xsens_mti::XsensMtiOptions,
    /// Aceinna OpenIMU and MTLT.
    OpenImu: openimu::OpenImuOptions,
    /// Robotous RFT force/torque sensors.
    RobotousRft: robotous_rft::RobotousRftOptions,
    /// AIDIN AFT200 force/torque sensors.
    AidinAft200: aidin_aft200::AidinAft200Options,
    /// JR3 force/torque sensors.
    Jr3Can: jr3_can::Jr3CanOptions,
    /// OptoForce force sensors.
    OptoforceDaq: optoforce_daq::OptoforceDaqOptions,
    /// Devices that a .dbc file describes.
    Dbc: dbc::DbcOptions,
}

/// What a driver has for recognising its devices: the items of [`Recognise`].
#[cfg(feature = "recognise")]
struct Recogniser {
    driver: &'static str,
    recognise: fn(&Traffic) -> Vec<Finding>,
    questions: fn(&Traffic) -> Vec<Frame>,
    asked_by_name: bool,
}

/// The drivers whose questions are sent only if they are named ([`Recognise::ASKED_BY_NAME`]).
#[cfg(feature = "recognise")]
pub fn asked_by_name() -> impl Iterator<Item = &'static str> {
    let asked = RECOGNISERS.iter().filter(|known| known.asked_by_name);
    asked.map(|known| known.driver)
}

/// What nothing in `seen` refutes, however little speaks for it; the most probable first.
#[cfg(feature = "recognise")]
fn suspect(seen: &Traffic) -> Vec<Finding> {
    let all = RECOGNISERS.iter().flat_map(|known| (known.recognise)(seen));
    recognise::together(seen, all.collect())
}

/// The devices that `seen` shows, judged together: the surest first, of those that are equally sure
/// the most probable.
#[cfg(feature = "recognise")]
#[must_use]
pub fn recognise(seen: &Traffic) -> Vec<Finding> {
    let mut all = suspect(seen);
    all.retain(|finding| finding.certainty().is_some());
    all.sort_by_key(|finding| core::cmp::Reverse(finding.certainty()));
    all
}

/// The questions of all drivers ([`Recognise::questions`]), each once; of those that are asked by
/// name only, the drivers in `named`. None is on an identifier on which a device of another driver
/// takes commands, however little speaks for that device, unless all that does is explained by one
/// for which more speaks.
#[cfg(feature = "recognise")]
#[must_use]
pub fn questions(seen: &Traffic, named: &[&str]) -> Vec<Frame> {
    let suspects = suspect(seen);
    let mut there: Vec<&Finding> = Vec::new();
    for finding in &suspects {
        let mut ids = finding.explains.iter().map(|explained| explained.id);
        if !ids.all(|id| there.iter().any(|better| better.has(id))) {
            there.push(finding);
        }
    }
    let is_command = |driver: &str, question: &Frame| {
        let mut others = there.iter().filter(|finding| finding.driver != driver);
        others.any(|other| other.commands.iter().any(|c| c.contains(&question.id)))
    };
    let mut all: Vec<Frame> = Vec::new();
    for known in RECOGNISERS {
        if known.asked_by_name && !named.contains(&known.driver) {
            continue;
        }
        for question in (known.questions)(seen) {
            if !all.contains(&question) && !is_command(known.driver, &question) {
                all.push(question);
            }
        }
    }
    all
}

/// Checks that the joints of `spec` are outputs of the driver, and that one that measures joints
/// has at least one.
fn check_joints(spec: &Spec, outputs: &[OutputInfo]) -> Result<(), SpecError> {
    let joints = || {
        outputs
            .iter()
            .filter(|output| output.kind == Kind::Joint)
            .map(|output| output.number)
    };
    let (Some(least), Some(most)) = (joints().min(), joints().max()) else {
        return if spec.outputs.0.is_empty() {
            Ok(())
        } else {
            Err(SpecError::Joints(
                "this device measures no joint; remove its [[bus.device.joint]]",
            ))
        };
    };
    if spec.outputs.0.is_empty() {
        return Err(SpecError::Joints(
            "this device needs a joint: name it in [[bus.device.joint]]",
        ));
    }
    match spec
        .outputs
        .0
        .iter()
        .find(|&&channel| joints().all(|joint| joint != channel))
    {
        Some(&channel) => Err(SpecError::Channel {
            channel,
            least,
            most,
        }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema;
    use serde_json::{Value, json};
    use std::format;

    /// `definitions/<driver>` is the schema of a device of that driver: its keys, and those of all
    /// devices, which are the gateway's.
    #[test]
    fn the_reference_of_the_keys_of_devices_is_new() {
        schema::check("gateway.schema.json", |old| {
            let mut made = old.clone();
            let definitions = schema::entries(&mut made, "definitions");
            let device = definitions.entry("device").or_insert_with(|| json!({}));
            let common = schema::entries(device, "properties").clone();
            for (driver, mut schema) in schemas() {
                if let Some(object) = schema.as_object_mut() {
                    object.remove("$schema");
                    object.remove("title");
                    let required = object.entry("required").or_insert_with(|| json!([]));
                    let required = required.as_array_mut().expect("a list");
                    required.extend(["driver", "name"].map(Value::from));
                }
                let keys = schema::entries(&mut schema, "properties");
                for key in common.keys() {
                    assert!(
                        !keys.contains_key(key),
                        "{driver}: {key} is a key of every device"
                    );
                    let place = format!("#/definitions/device/properties/{key}");
                    keys.insert(key.clone(), json!({ "$ref": place }));
                }
                keys.insert("driver".into(), json!({ "const": driver }));
                definitions.insert(driver.into(), schema);
            }
            made
        });
    }
}
