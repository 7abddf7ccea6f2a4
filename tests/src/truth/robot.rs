//! Robots at random, and the shipped ones: what the estimator is told of each, and its true bodies.

use super::random::Random;
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::{RigidInertia, Vec3};
use proprio_estimator::config::Config;
use std::f64::consts::FRAC_PI_2;
use std::fmt::Write as _;
use std::fs;
use toml::{Table, Value};

/// A robot and what the estimator is told of it.
#[derive(Debug, Clone)]
pub(crate) struct Robot {
    /// In words.
    pub(crate) name: String,
    /// estimator.toml, with unknown offsets; `model` names no file.
    pub(crate) config: Table,
    /// The URDF.
    pub(crate) urdf: String,
    /// The URDF's model.
    pub(crate) cad: Model,
    /// The links that may be touched.
    pub(crate) tips: Vec<String>,
}

/// Where an F/T sensor is in a limb: before this joint; after the last one if there is none.
const PLACES: [&[f64]; 5] = [&[0.0], &[0.5], &[1.0], &[0.0, 1.0], &[0.5, 0.5]];

impl Robot {
    /// Of three seeds one is that of a shipped arm, the others are trees at random.
    pub(crate) fn new(seed: u64) -> Self {
        match seed % 6 {
            1 => Self::shipped("six_axis_arm"),
            4 => Self::shipped("icub_left_arm"),
            5 => Self::tree(seed, true),
            _ => Self::tree(seed, false),
        }
    }

    fn shipped(name: &str) -> Self {
        let folder =
            proprio_simulator::SimulatedRobot::find(name).expect("a robot of this repository");
        let read = |file: &str| fs::read_to_string(folder.join(file)).expect(file);
        let mut config: Table = read("estimator.toml").parse().expect("it is TOML");
        let mut tips = Vec::new();
        for contact in tables(&mut config, "contact") {
            let link = contact
                .get("link")
                .and_then(Value::as_str)
                .unwrap_or_default();
            // The other contacts carry the robot.
            if link.contains("hand") || link == "flange" {
                tips.push(link.to_owned());
                contact.insert("presence".into(), "possible".into());
            }
        }
        for sensor in tables(&mut config, "force_torque") {
            sensor.insert("noise_n".into(), vec![0.1; 3].into());
            sensor.insert("noise_nm".into(), vec![0.005; 3].into());
        }
        for table in [
            "output",
            "input",
            "differentiation",
            "identification",
            "skin",
        ] {
            config.remove(table);
        }
        Self::told(name.into(), config, &read("model.urdf"), tips)
    }

    /// One or two limbs of three to six joints; of two the first may be the one it stands on.
    fn tree(seed: u64, stands: bool) -> Self {
        let random = &mut Random::new(seed, "robot");
        let mut urdf = String::from("<robot name=\"tree\">\n");
        link(&mut urdf, "base", 2.0, random);
        let mut config = Table::new();
        let mut tips = Vec::new();
        let limbs = 1 + usize::from(stands || random.happens(0.35));
        let mut places = Vec::new();
        for limb in 0..limbs {
            let joints = 3 + random.below(4);
            let place = PLACES[random.below(PLACES.len())];
            places.push(format!("{joints} joints, F/T at {place:?}"));
            let sensor = |k: usize| ((place[k] * joints as f64).round() as usize, k);
            let sensors: Vec<_> = (0..place.len()).map(sensor).collect();
            let mut parent = String::from("base");
            for joint in 0..=joints {
                for (_, k) in sensors.iter().filter(|(at, _)| *at == joint) {
                    let (name, child) = (format!("ft_{limb}_{k}"), format!("l{limb}_flange{k}"));
                    link(&mut urdf, &child, 0.15, random);
                    fixed(&mut urdf, &name, &parent, &child, random);
                    parent = child;
                    tables_mut(&mut config, "force_torque").push(force_torque(&name));
                }
                if joint == joints {
                    break;
                }
                let child = format!("l{limb}_link{joint}");
                let mass = random.uniform(0.3, 3.0) * 0.85_f64.powf(joint as f64);
                link(&mut urdf, &child, mass, random);
                moving(
                    &mut urdf,
                    &format!("l{limb}_j{joint}"),
                    &parent,
                    &child,
                    random,
                );
                parent = child;
            }
            let hand = format!("l{limb}_hand");
            let mass = random.uniform(0.3, 1.0);
            link(&mut urdf, &hand, mass, random);
            fixed(&mut urdf, &format!("l{limb}_wrist"), &parent, &hand, random);
            let is_foot = stands && limb == 0;
            let mut tip = Table::new();
            tip.insert("name".into(), hand.clone().into());
            tip.insert("link".into(), hand.clone().into());
            let presence = if is_foot { "always" } else { "possible" };
            tip.insert("presence".into(), presence.into());
            tables_mut(&mut config, "contact").push(tip.into());
            if !is_foot {
                tips.push(hand);
            }
        }
        urdf.push_str("</robot>\n");
        let mut base = Table::new();
        let is_fixed = random.happens(0.6);
        if stands {
            let mut foot = Table::new();
            foot.insert("link".into(), "l0_hand".into());
            foot.insert("contact".into(), "l0_hand".into());
            base.insert("kind".into(), "stance".into());
            base.insert("foot".into(), vec![foot].into());
        } else if is_fixed {
            base.insert("link".into(), "base".into());
            base.insert("kind".into(), "fixed".into());
            if random.happens(0.4) {
                let gravity = random.direction() * 9.80665;
                base.insert("gravity_mps2".into(), numbers(gravity));
            }
        } else {
            base.insert("link".into(), "base".into());
            base.insert("kind".into(), "imu".into());
            base.insert("sensor".into(), "imu".into());
            let turned: [f64; 3] = std::array::from_fn(|_| random.uniform(-1.5, 1.5));
            base.insert("rpy_rad".into(), turned.to_vec().into());
            base.insert("xyz_m".into(), numbers(random.direction() * 0.1));
            let mut stand = Table::new();
            stand.insert("name".into(), "stand".into());
            stand.insert("link".into(), "base".into());
            tables_mut(&mut config, "contact").push(stand.into());
        }
        config.insert("base".into(), base.into());
        let base = match (stands, is_fixed) {
            (true, _) => "standing on the first",
            (false, true) => "fixed",
            (false, false) => "on an IMU",
        };
        Self::told(
            format!("{}, {base}", places.join("; ")),
            config,
            &urdf,
            tips,
        )
    }

    fn told(name: String, mut config: Table, urdf: &str, tips: Vec<String>) -> Self {
        for sensor in tables(&mut config, "force_torque") {
            for key in ["offset_n", "offset_nm"] {
                sensor.remove(key);
            }
        }
        config.insert("schema".into(), 1.into());
        config.insert("robot".into(), "truth".into());
        config.insert("model".into(), "model.urdf".into());
        set(&mut config, "input", "max_silence_ms", 50.0);
        set(&mut config, "output", "max_wait_ms", 20.0);
        let joints: Vec<String> = tables(&mut config, "force_torque")
            .filter_map(|sensor| Some(sensor.get("joint")?.as_str()?.to_owned()))
            .collect();
        let keep: Vec<&str> = joints.iter().map(String::as_str).collect();
        let cad = Model::from_urdf(urdf, &keep).unwrap_or_else(|e| panic!("{e}\n{urdf}"));
        Self {
            name,
            config,
            urdf: urdf.into(),
            cad,
            tips,
        }
    }

    /// The configuration.
    pub(crate) fn config(&self) -> Config {
        let text = self.config.to_string();
        Config::parse(&text).unwrap_or_else(|e| panic!("{e}\n{text}"))
    }

    /// The true bodies: those of the URDF, wrong by about the fraction `size`.
    pub(crate) fn bodies(&self, size: f64, random: &mut Random) -> Model {
        let mut truth = self.cad.clone();
        for (link, body) in self.cad.inertias().iter().enumerate() {
            let Some(centre) = body.centre().filter(|_| body.mass > 1e-6) else {
                continue;
            };
            let k = 1.0 + size * random.uniform(-1.0, 1.0);
            let radius = (body.about_centre().trace() / body.mass).sqrt();
            let away = Vec3::from_fn(|_, _| random.normal()) * (size * 0.1 * radius);
            let body = RigidInertia::from_centroidal(
                body.mass * k,
                &(centre + away),
                &(body.about_centre() * k),
            );
            truth.set_inertia(link, body).expect("a possible body");
        }
        truth
    }
}

/// The tables of an array of the configuration.
pub(crate) fn tables<'a>(
    config: &'a mut Table,
    name: &str,
) -> impl Iterator<Item = &'a mut Table> + use<'a> {
    let array = config.get_mut(name).and_then(Value::as_array_mut);
    array.into_iter().flatten().filter_map(Value::as_table_mut)
}

/// Sets a key in a table of the configuration.
pub(crate) fn set(config: &mut Table, table: &str, key: &str, value: impl Into<Value>) {
    let table = config.entry(table).or_insert_with(|| Table::new().into());
    let table = table.as_table_mut().expect("a table");
    table.insert(key.into(), value.into());
}

fn tables_mut<'a>(config: &'a mut Table, name: &str) -> &'a mut Vec<Value> {
    let array = config
        .entry(name)
        .or_insert_with(|| Value::Array(Vec::new()));
    array.as_array_mut().expect("an array")
}

pub(crate) fn numbers(v: Vec3) -> Value {
    let v: [f64; 3] = v.into();
    v.to_vec().into()
}

fn force_torque(joint: &str) -> Value {
    let mut sensor = Table::new();
    sensor.insert("sensor".into(), joint.into());
    sensor.insert("joint".into(), joint.into());
    sensor.insert("noise_n".into(), vec![0.1; 3].into());
    sensor.insert("noise_nm".into(), vec![0.005; 3].into());
    sensor.into()
}

/// A box of this mass.
fn link(urdf: &mut String, name: &str, mass: f64, random: &mut Random) {
    let [a, b, c] = [0.0; 3].map(|_: f64| random.uniform(0.04, 0.14));
    let centre = random.direction() * random.uniform(0.01, 0.08);
    let [x, y, z] = [b * b + c * c, a * a + c * c, a * a + b * b].map(|sum| mass / 12.0 * sum);
    let _ = writeln!(
        urdf,
        "<link name=\"{name}\"><inertial><origin xyz=\"{} {} {}\"/><mass value=\"{mass}\"/>\
         <inertia ixx=\"{x}\" iyy=\"{y}\" izz=\"{z}\" ixy=\"0\" ixz=\"0\" iyz=\"0\"/></inertial>\
         </link>",
        centre.x, centre.y, centre.z
    );
}

/// Where a joint is in its parent: turned by right angles, as most are, and along the link.
fn origin(random: &mut Random) -> String {
    let along = random.direction() * random.uniform(0.02, 0.25);
    let turn = [0.0; 3].map(|_: f64| (random.below(4) as f64 - 1.0) * FRAC_PI_2);
    format!(
        "<origin xyz=\"{} {} {}\" rpy=\"{} {} {}\"/>",
        along.x, along.y, along.z, turn[0], turn[1], turn[2]
    )
}

fn fixed(urdf: &mut String, name: &str, parent: &str, child: &str, random: &mut Random) {
    let origin = origin(random);
    let _ = writeln!(
        urdf,
        "<joint name=\"{name}\" type=\"fixed\">{origin}<parent link=\"{parent}\"/>\
         <child link=\"{child}\"/></joint>"
    );
}

fn moving(urdf: &mut String, name: &str, parent: &str, child: &str, random: &mut Random) {
    let origin = origin(random);
    let axis = match random.happens(0.8) {
        true => [Vec3::x(), Vec3::y(), Vec3::z()][random.below(3)],
        false => random.direction(),
    };
    let (kind, reach) = match random.happens(0.08) {
        true => ("prismatic", 0.2),
        false => ("revolute", random.uniform(0.6, 2.0)),
    };
    let middle = random.uniform(-0.5, 0.5) * reach;
    let _ = writeln!(
        urdf,
        "<joint name=\"{name}\" type=\"{kind}\">{origin}<parent link=\"{parent}\"/>\
         <child link=\"{child}\"/><axis xyz=\"{} {} {}\"/>\
         <limit lower=\"{}\" upper=\"{}\" effort=\"300\" velocity=\"5\"/></joint>",
        axis.x,
        axis.y,
        axis.z,
        middle - reach,
        middle + reach
    );
}
