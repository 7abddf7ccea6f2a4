//! A robot whose boards are of families drawn at random: its configuration, its true bodies, and
//! the simulated boards.

use crate::truth::random::Random;
use crate::truth::robot::{Robot, numbers, set, tables};
use proprio_dynamics::model::JointKind;
use proprio_estimator::config::Config;
use proprio_estimator::setup::Setup;
use proprio_gateway::plan::Plan;
use proprio_simulator::{SimulatedRobot, Simulation, SimulationSettings, Simulator};
use proprio_topics::{Kind, Nanos};
use std::fmt::Write as _;
use std::path::Path;

/// A device family in one of its configurations.
#[derive(Debug, Clone, Copy)]
pub struct Family {
    /// The driver, and what is particular.
    pub name: &'static str,
    /// What it measures.
    pub kind: Kind,
    driver: &'static str,
    keys: &'static str,
    /// The first device's address, if it has one.
    address: Option<u32>,
    /// Turns of the device per turn of the joint.
    ratio: f64,
    /// Joints of a device.
    joints: u32,
    /// Whether it drops answers that it has not asked for.
    pub(super) drops_old: bool,
    /// Half a step of a joint's position, times the ratio \[rad\].
    half_step: f64,
    /// Where the device reports zero \[rad\]: an encoder's count is never negative.
    offset: f64,
}

const fn joint(name: &'static str, driver: &'static str, keys: &'static str) -> Family {
    Family {
        name,
        kind: Kind::Joint,
        driver,
        keys,
        address: Some(1),
        ratio: 1.0,
        joints: 1,
        drops_old: false,
        half_step: 1e-4,
        offset: 0.0,
    }
}

const fn sensor(kind: Kind, driver: &'static str, address: Option<u32>) -> Family {
    Family {
        kind,
        address,
        ..joint(driver, driver, "")
    }
}

/// All families but those of hands and skins, those that only send, and the force sensor without
/// torques (optoforce_daq), on which no torque of a joint can rest.
pub const FAMILIES: &[Family] = &[
    Family {
        keys: "period_ms = 5\nfull_scale_n = [2000, 2000, 2000]\n\
               full_scale_nm = [100, 100, 100]",
        ..sensor(Kind::Wrench, "icub_strain", Some(1))
    },
    Family {
        keys: "period_ms = 5",
        drops_old: true,
        ..sensor(Kind::Wrench, "ati_netcanoem", Some(0x20))
    },
    Family {
        keys: "model = \"RFT80-6A03\"",
        ..sensor(Kind::Wrench, "robotous_rft", Some(0x64))
    },
    sensor(Kind::Wrench, "aidin_aft200", Some(1)),
    Family {
        keys: "full_scale_n = [1000, 1000, 1000]\nfull_scale_nm = [100, 100, 100]",
        ..sensor(Kind::Wrench, "jr3_can", Some(1))
    },
    Family {
        keys: "file = \"wrench.dbc\"\nreading = [{ kind = \"wrench\", pair_timeout_ms = 2.0, \
               fields = { fx = \"F.X\", fy = \"F.Y\", fz = \"F.Z\", tx = \"T.X\", ty = \"T.Y\", \
               tz = \"T.Z\" }, counter = \"F.Count\" }]",
        ..sensor(Kind::Wrench, "dbc", None)
    },
    Family {
        keys: "quantities = [\"acceleration\", \"angular_velocity\"]\nperiod_ms = 10",
        ..sensor(Kind::Imu, "icub_imu", Some(1))
    },
    sensor(Kind::Imu, "xsens_mti", None),
    sensor(Kind::Imu, "openimu", Some(0x80)),
    Family {
        ratio: 100.0,
        half_step: 5e-5,
        ..joint("icub_motor", "icub_motor", "period_ms = 5")
    },
    Family {
        joints: 2,
        ..joint("icub_mc4", "icub_mc4", "period_ms = 5")
    },
    Family {
        joints: 2,
        half_step: 9e-4,
        ..joint("icub_pos", "icub_pos", "period_ms = 10")
    },
    Family {
        ratio: 101.0,
        half_step: 1e-3,
        ..joint("canopen_drive", "canopen_drive", "period_ms = 5")
    },
    Family {
        ratio: 101.0,
        half_step: 1e-3,
        ..joint("canopen_drive at SYNC", "canopen_drive", "sync = 1")
    },
    Family {
        ratio: 51.0,
        half_step: 1e-3,
        offset: -6.0,
        ..joint("canopen_encoder", "canopen_encoder", "period_ms = 5")
    },
    Family {
        drops_old: true,
        ..joint("moteus", "moteus", "period_ms = 5")
    },
    joint("odrive", "odrive", "period_ms = 5"),
    // Ranges of torque that carry the arm: at its end, a reading is saturated.
    Family {
        half_step: 2e-4,
        ..joint(
            "cubemars",
            "cubemars",
            "model = \"AK80-9\"\neffort_max = 500.0\nperiod_ms = 5",
        )
    },
    Family {
        half_step: 9e-4,
        ..joint(
            "cubemars servo",
            "cubemars",
            "mode = \"servo\"\nmodel = \"AK10-9\"\nperiod_ms = 5",
        )
    },
    Family {
        half_step: 2e-4,
        ..joint(
            "damiao",
            "damiao",
            "model = \"DM4310\"\ntorque_max = 500.0\nperiod_ms = 5",
        )
    },
    Family {
        half_step: 2e-4,
        ..joint(
            "damiao asked",
            "damiao",
            "model = \"DM4310\"\ntorque_max = 500.0\nrequest_period_ms = 5",
        )
    },
    joint("myactuator", "myactuator", "request_period_ms = 5"),
    joint(
        "myactuator v2",
        "myactuator",
        "protocol = \"v2\"\nrequest_period_ms = 5",
    ),
    Family {
        half_step: 2e-4,
        ..joint(
            "robstride",
            "robstride",
            "model = \"RS03\"\ntorque_max = 500.0\nperiod_ms = 5",
        )
    },
    Family {
        half_step: 2e-4,
        ..joint(
            "robstride mit",
            "robstride",
            "model = \"RS03\"\nprotocol = \"mit\"\ntorque_max = 500.0\nperiod_ms = 5",
        )
    },
    Family {
        ratio: 50.0,
        half_step: 0.08,
        ..joint(
            "vesc",
            "vesc",
            "pole_pairs = 7\nposition = \"tachometer\"\nperiod_ms = 5",
        )
    },
];

/// The file of the family `dbc`.
const DBC: &str = r#"VERSION ""
NS_ :
BS_:
BU_: S
BO_ 256 F: 8 S
 SG_ X : 0|16@1- (0.02,0) [0|0] "N" G
 SG_ Y : 16|16@1- (0.02,0) [0|0] "N" G
 SG_ Z : 32|16@1- (0.02,0) [0|0] "N" G
 SG_ Count : 48|8@1+ (1,0) [0|0] "" G
BO_ 257 T: 8 S
 SG_ X : 0|16@1- (0.002,0) [0|0] "Nm" G
 SG_ Y : 16|16@1- (0.002,0) [0|0] "Nm" G
 SG_ Z : 32|16@1- (0.002,0) [0|0] "Nm" G
"#;

/// The robot of a run.
pub(super) struct ChainRig {
    /// In words.
    pub(super) name: String,
    /// The estimator's configuration: its masses are wrong, its offsets unknown.
    pub(super) setup: Setup,
    /// The configuration of the gateway.
    pub(super) plan: Plan,
    /// The truth.
    pub(super) simulation: Simulation,
    /// The boards.
    pub(super) boards: Simulator,
}

/// Duration without motion at the start \[s\].
pub(super) const REST: f64 = 2.0;

impl ChainRig {
    /// The robot of `seed`, whose devices of one kind are of `family`; `None` if it has no device
    /// of that kind. `settings` for the boards, which are powered at `t0`.
    pub(super) fn new(
        seed: u64,
        family: Family,
        settings: impl Fn(&Plan) -> SimulationSettings,
        t0: Nanos,
        folder: &Path,
    ) -> Option<Self> {
        let random = &mut Random::new(seed, family.name);
        // Rotary drives alone.
        let is_rotary = |robot: &Robot| {
            let moving = |kind: &JointKind| matches!(kind, JointKind::Prismatic(_));
            !robot.cad.joints().iter().any(|joint| moving(&joint.kind))
        };
        let mut robot = (0..).map(|k| Robot::new(seed + 1000 * k)).find(is_rotary)?;
        let pick = |kind: Kind, random: &mut Random| {
            if kind == family.kind {
                return family;
            }
            let all: Vec<&Family> = FAMILIES.iter().filter(|f| f.kind == kind).collect();
            *all[random.below(all.len())]
        };
        let families = [Kind::Wrench, Kind::Imu, Kind::Joint].map(|kind| pick(kind, random));
        let finest = families[2].half_step / families[2].ratio;
        let noise = 4.8e-4_f64.max(finest + 1e-4);
        set(
            &mut robot.config,
            "differentiation",
            "position_noise_rad",
            noise,
        );
        set(&mut robot.config, "identification", "enabled", true);
        let setup = Setup::with_model(&robot.config(), robot.cad.clone());
        let setup = setup.unwrap_or_else(|e| panic!("{}: {e}\n{}", robot.name, robot.config));
        if setup.channels().all(|(kind, _)| kind != family.kind) {
            return None;
        }
        let text = gateway(&setup, &families);
        std::fs::write(folder.join("wrench.dbc"), DBC).expect("a file");
        let plan = Plan::parse(&text, folder).unwrap_or_else(|e| panic!("{e:?}\n{text}"));
        // The true robot has offsets and other masses.
        let mut config = robot.config.clone();
        for sensor in tables(&mut config, "force_torque") {
            let mut off = |most: f64| {
                numbers(proprio_dynamics::spatial::Vec3::from_fn(|_, _| {
                    random.uniform(-most, most)
                }))
            };
            sensor.insert("offset_n".into(), off(10.0));
            sensor.insert("offset_nm".into(), off(0.5));
        }
        let simulated = SimulatedRobot {
            folder: folder.to_owned(),
            config: Config::parse(&config.to_string()).expect("as before"),
            model: robot.bodies(0.15, &mut Random::new(seed, "bodies")),
            plan: plan.clone(),
        };
        let settings = settings(&plan);
        let fail = |e: &dyn std::fmt::Display| -> ! { panic!("{}: {e}\n{text}", robot.name) };
        Some(Self {
            simulation: Simulation::new(&simulated, &settings).unwrap_or_else(|e| fail(&e)),
            boards: Simulator::new(&simulated, &settings, t0).unwrap_or_else(|e| fail(&e)),
            name: format!("{}; {}", robot.name, families.map(|f| f.name).join(", ")),
            setup,
            plan,
        })
    }
}

/// gateway.toml: a bus for each sensor, and one for all joints.
fn gateway(setup: &Setup, families: &[Family; 3]) -> String {
    let mut text = String::from("schema = 1\nrobot = \"truth\"\n");
    let bus = |text: &mut String, name: &str| {
        let _ = writeln!(
            text,
            "[[bus]]\nname = \"{name}\"\nsource = {{ kind = \"virtual\", name = \"{name}\" }}"
        );
    };
    let device = |text: &mut String, family: &Family, name: &str, number: u32| {
        let _ = writeln!(
            text,
            "[[bus.device]]\ndriver = \"{}\"\nname = \"{name}\"\nmax_silence_ms = 50\n{}",
            family.driver, family.keys
        );
        if let Some(first) = family.address {
            let _ = writeln!(text, "address = {}", first + number);
        }
    };
    let [wrench, imu, joint] = families;
    for (kind, name) in setup.channels() {
        match kind {
            Kind::Wrench => {
                bus(&mut text, name);
                device(&mut text, wrench, name, 0);
            }
            Kind::Imu => {
                bus(&mut text, name);
                device(&mut text, imu, name, 0);
            }
            _ => {}
        }
    }
    bus(&mut text, "joints");
    if joint.keys.contains("sync") {
        text.push_str("[[bus.device]]\ndriver = \"canopen_sync\"\nname = \"sync\"\n");
        text.push_str("period_ms = 5.0\n");
    }
    let joints: Vec<&str> = (setup.channels())
        .filter(|(kind, _)| *kind == Kind::Joint)
        .map(|(_, name)| name)
        .collect();
    for (number, names) in (0..).zip(joints.chunks(joint.joints as usize)) {
        device(&mut text, joint, &format!("board_{number}"), number);
        for (channel, name) in names.iter().enumerate() {
            let _ = writeln!(
                text,
                "[[bus.device.joint]]\nname = \"{name}\"\nchannel = {channel}\nratio = {:?}\n\
                 offset_rad = {:?}",
                joint.ratio, joint.offset
            );
        }
    }
    text
}
