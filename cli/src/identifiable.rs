//! `proprio identifiable`: what a robot's F/T sensors can tell of its torques at all, and which
//! further sensor, or the motion of which joint, would tell more.

use crate::names::find;
use anyhow::Context;
use proprio_dynamics::model::Model;
use proprio_estimator::check::significant;
use proprio_estimator::config::{Config, ForceTorque, InvalidConfig};
use proprio_estimator::setup::{Setup, nearest};
use proprio_identification::{Robot, parallel};
use proprio_planning::knowledge::{Knowledge, TorqueKnowledge, limit, only, regime};
use proprio_planning::workspace::{Deviation, Workspace, measured};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Number of states at which torques are looked at.
const STATES: usize = 40;

/// A sensor or a motion is named if it lessens a deviation by at least this share.
const WORTH: f64 = 0.05;

/// A smaller deviation counts as none \[Nm or N\].
const NOTHING: f64 = 1e-4;

/// Most sensors, and joints, that are named.
const NAMED: usize = 3;

/// `proprio identifiable`.
#[derive(clap::Args)]
pub(crate) struct IdentifiableArgs {
    /// The robot's URDF
    #[arg(value_name = "ROBOT.urdf", required_unless_present = "config")]
    urdf: Option<PathBuf>,
    /// estimator.toml, in place of a URDF: its sensors, contacts and base
    #[arg(long, value_name = "FILE", conflicts_with = "urdf")]
    config: Option<PathBuf>,
    /// The joints with an F/T sensor, separated by commas; repeat it to compare sets of sensors
    #[arg(long, value_name = "JOINT,...")]
    sensors: Vec<String>,
    /// The root of a URDF is at rest (fixed), or has an IMU (imu)
    #[arg(
        long,
        value_name = "KIND",
        default_value = "fixed",
        conflicts_with = "config"
    )]
    #[arg(value_parser = ["fixed", "imu"])]
    base: String,
    /// With --config: a contact that is always present while the robot works, but declared absent
    /// while it is identified; may be given several times
    #[arg(long, value_name = "CONTACT", requires = "config")]
    absent: Vec<String>,
    /// The joint whose torque matters [default: the one that remains the most uncertain]
    #[arg(long, value_name = "NAME")]
    joint: Option<String>,
    /// Also print the combinations that are identified, and which torque rests on which of them
    #[arg(long)]
    details: bool,
    /// Print all of it as JSON
    #[arg(long)]
    json: bool,
}

/// A set of sensors, and what it tells.
struct SensorPlacement {
    names: Vec<String>,
    config: Config,
    /// As it works.
    robot: Robot,
    /// The degrees of freedom and states in which torques are looked at.
    workspace: Workspace,
    /// As it moves while it is identified.
    free: Robot,
    knowledge: Knowledge,
}

/// What would lessen the deviation of a torque.
struct Remedies {
    joint: String,
    unit: &'static str,
    now: f64,
    /// The joint with a further sensor, and the deviation with it.
    sensors: Vec<(String, f64)>,
    /// The deviation while nothing moves.
    still: f64,
    /// The joint that alone moves, and the deviation after that.
    motions: Vec<(String, f64)>,
}

/// Tells what is identifiable.
pub(crate) fn run(args: &IdentifiableArgs) -> anyhow::Result<()> {
    let (file, config) = match (&args.config, &args.urdf) {
        (Some(file), _) => (file, Config::load(file)?),
        (None, Some(urdf)) => (urdf, of_urdf(urdf, &args.base)?),
        (None, None) => anyhow::bail!("give a URDF, or --config with estimator.toml"),
    };
    let invalid = |problem: String| InvalidConfig {
        file: file.clone(),
        problem,
    };
    let sets = match args.sensors.as_slice() {
        [] => vec![config.clone()],
        sets => (sets.iter())
            .map(|names| with_sensors(&config, names).map_err(invalid))
            .collect::<Result<_, _>>()?,
    };
    let sets = sets.into_iter().map(|config| {
        let robot = Setup::new(&config).map_err(invalid)?.robot;
        let free = without(&robot, &args.absent).map_err(invalid)?;
        let about = || file.display().to_string();
        let workspace = Workspace::new(&robot, STATES).with_context(about)?;
        let knowledge = Knowledge::of(&free, &regime(&free), &workspace).with_context(about)?;
        let names = config.force_torque.iter().map(|ft| ft.joint.clone());
        Ok(SensorPlacement {
            names: names.collect(),
            config,
            robot,
            workspace,
            free,
            knowledge,
        })
    });
    let sets = sets.collect::<anyhow::Result<Vec<SensorPlacement>>>()?;
    let remedies = sets.iter().map(|set| {
        let dof = match &args.joint {
            Some(name) => Some(torque_of(&set.robot, name).map_err(invalid)?),
            None => None,
        };
        remedies(set, &args.absent, dof).with_context(|| file.display().to_string())
    });
    let remedies = remedies.collect::<anyhow::Result<Vec<_>>>()?;
    if args.json {
        let all = sets
            .iter()
            .zip(&remedies)
            .map(|(set, own)| set.json(own.as_ref()));
        print_line!("{}", json!({ "sets": all.collect::<Vec<_>>() }));
        return Ok(());
    }
    for (number, (set, remedies)) in sets.iter().zip(&remedies).enumerate() {
        if number > 0 {
            print_line!("");
        }
        set.print(args.details);
        if let Some(remedies) = remedies {
            remedies.print();
        }
    }
    Ok(())
}

/// The degree of freedom of a published torque, by the joint's name.
pub(crate) fn torque_of(robot: &Robot, name: &str) -> Result<usize, String> {
    let found = measured(robot).find(|&dof| robot.model.dof_name(dof) == name);
    found.ok_or_else(|| {
        let hint = nearest(name, robot.joint_names());
        format!("--joint {name}: it is not a moving joint that is measured{hint}")
    })
}

/// The robot without these contacts: they are declared absent while it is identified.
pub(crate) fn without(robot: &Robot, absent: &[String]) -> Result<Robot, String> {
    let mut free = robot.clone();
    for name in absent {
        let contact = find(name, || robot.contact_names().zip(0..))
            .map_err(|hint| format!("--absent {name}: there is no such [[contact]]{hint}"))?;
        if robot.support == Some(contact) {
            return Err(format!("--absent {name}: it carries the base"));
        }
        free.always.remove(contact);
    }
    Ok(free)
}

/// The unit of a torque.
pub(crate) fn unit(model: &Model, dof: usize) -> &'static str {
    if model.is_prismatic(dof) { "N" } else { "Nm" }
}

/// A number with two digits.
pub(crate) fn short(number: f64) -> String {
    match number.abs() < NOTHING {
        true => "0".into(),
        false => significant(number, 2),
    }
}

/// The configuration of a robot of which only the URDF is known.
fn of_urdf(urdf: &Path, base: &str) -> Result<Config, InvalidConfig> {
    let invalid = |problem| InvalidConfig {
        file: urdf.to_owned(),
        problem,
    };
    let model = Model::from_file(urdf, &[]).map_err(|error| invalid(error.to_string()))?;
    let (link, sensor) = (
        model.link_name(0),
        ["", "sensor = \"imu\""][usize::from(base == "imu")],
    );
    let text = format!(
        "schema = 1\nrobot = \"robot\"\nmodel = {urdf:?}\n[base]\nkind = {base:?}\nlink = \
         {link:?}\n{sensor}\n"
    );
    Config::parse(&text).map_err(invalid)
}

/// The configuration with F/T sensors in these joints. Those that it has keep their noise.
fn with_sensors(config: &Config, names: &str) -> Result<Config, String> {
    let model = Model::from_file(&config.model, &[]);
    let model = model.map_err(|error| format!("{}: {error}", config.model.display()))?;
    let joints = joints(&model);
    let mut new = config.clone();
    new.force_torque.clear();
    new.output.trigger = None;
    for name in names
        .split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
    {
        find(name, || joints.iter().map(|own| (own.as_str(), ()))).map_err(|hint| {
            format!("--sensors {names}: {name:?} is not a joint of the URDF{hint}")
        })?;
        if new.force_torque.iter().any(|own| own.joint == name) {
            return Err(format!("--sensors {names}: {name} is named twice"));
        }
        let before = config.force_torque.iter().find(|own| own.joint == name);
        new.force_torque.push(match before {
            Some(before) => before.clone(),
            None => sensor(name)?,
        });
    }
    Ok(new)
}

/// A sensor with the default noise. Where no motion tells its offset, this counts as measured.
fn sensor(joint: &str) -> Result<ForceTorque, String> {
    let zero = [0.0; 3];
    let text = format!(
        "sensor = \"{joint}.ft\"\njoint = {joint:?}\noffset_n = {zero:?}\noffset_nm = {zero:?}"
    );
    toml::from_str(&text).map_err(|error| error.to_string())
}

/// All joints of the URDF: those that move first, then in alphabetic order.
fn joints(model: &Model) -> Vec<String> {
    let kept = (0..model.joint_count()).map(|joint| model.joint_name(joint).to_owned());
    let mut folded: Vec<String> = (model.folded_joints())
        .map(|(joint, _)| joint.to_owned())
        .collect();
    folded.sort_unstable();
    kept.chain(folded).collect()
}

/// What would lessen the deviation of the torque of a degree of freedom, or of the most uncertain
/// one.
fn remedies(
    set: &SensorPlacement,
    absent: &[String],
    dof: Option<usize>,
) -> anyhow::Result<Option<Remedies>> {
    let model = &set.robot.model;
    let torques = set.knowledge.torques.iter();
    // A torque that contacts leave undetermined is as uncertain as can be.
    let torques = torques.map(|own| (own.dof, own.identified.unwrap_or(f64::INFINITY)));
    let chosen = match dof {
        Some(dof) => torques.into_iter().find(|(own, _)| *own == dof),
        None => torques.max_by(|a, b| a.1.total_cmp(&b.1)),
    };
    let Some((dof, now)) = chosen else {
        return Ok(None);
    };
    let deviation =
        |deviations: Vec<Deviation>| deviations.iter().find(|own| own.dof == dof)?.torque;
    let least = |mut all: Vec<(String, f64)>, than: f64| {
        all.retain(|(_, own)| than > NOTHING && *own < (1.0 - WORTH) * than);
        all.sort_by(|a, b| a.1.total_cmp(&b.1));
        all.truncate(NAMED);
        all
    };
    let whole = Model::from_file(&set.config.model, &[])?;
    let places: Vec<String> = joints(&whole);
    let places: Vec<&String> = places
        .iter()
        .filter(|own| !set.names.contains(own))
        .collect();
    let with = |place: &String| -> Option<f64> {
        let mut config = set.config.clone();
        config.force_torque.push(sensor(place).ok()?);
        let robot = Setup::new(&config).ok()?.robot;
        let cut = robot.model.cut(place)?;
        let mut carried = vec![false; robot.model.link_count()];
        for (number, joint) in robot.model.joints().iter().enumerate() {
            carried[joint.child] = number == cut || carried[joint.parent];
        }
        let bodies = robot.model.inertias().iter().zip(&carried);
        let mass: f64 = bodies
            .filter(|(_, own)| **own)
            .map(|(body, _)| body.mass)
            .sum();
        if mass <= 0.0 || robot.model.dof_name(dof) != model.dof_name(dof) {
            return None;
        }
        let workspace = Workspace::new(&robot, STATES).ok()?;
        let free = without(&robot, absent).ok()?;
        deviation(limit(&free, &regime(&free), &workspace).ok()?)
    };
    let sensors = parallel::map(places.len(), |k| with(places[k]));
    let sensors = places.iter().zip(sensors);
    let sensors = sensors.filter_map(|(place, own)| Some(((*place).clone(), own?)));
    let moving =
        |dofs: &[usize]| deviation(limit(&set.free, &only(&set.free, dofs), &set.workspace).ok()?);
    let still = moving(&[]).unwrap_or(now);
    let dofs: Vec<usize> = set.knowledge.torques.iter().map(|own| own.dof).collect();
    let motions = parallel::map(dofs.len(), |k| moving(&dofs[k..=k]));
    let motions = (dofs.iter().zip(motions))
        .filter_map(|(&dof, own)| Some((model.dof_name(dof).to_owned(), own?)));
    Ok(Some(Remedies {
        joint: model.dof_name(dof).to_owned(),
        unit: unit(model, dof),
        now,
        sensors: least(sensors.collect(), now),
        still,
        motions: least(motions.collect(), still),
    }))
}

impl SensorPlacement {
    /// Where the sensors are, in words.
    fn title(&self) -> String {
        match self.names.as_slice() {
            [] => "no F/T sensor".into(),
            [one] => format!("F/T sensor in {one}"),
            names => format!("F/T sensors in {}", names.join(", ")),
        }
    }

    fn print(&self, details: bool) {
        let model = &self.robot.model;
        let Knowledge { rank, unknowns, .. } = self.knowledge;
        print_line!(
            "{}: {rank} combinations of {unknowns} parameters and offsets can be identified",
            self.title()
        );
        let name = |torque: &TorqueKnowledge| model.dof_name(torque.dof).to_owned();
        let torques = self.knowledge.torques.iter();
        let width = torques
            .clone()
            .map(|own| name(own).len())
            .fold(14, usize::max);
        print_line!("");
        print_line!(
            "{:width$}  {:>9}  {:>9}",
            "deviation of",
            "from CAD",
            "in the end"
        );
        for torque in torques {
            let number = |value: Option<f64>| value.map_or("-".to_owned(), short);
            print_line!(
                "{:width$}  {:>9}  {:>9} {:2}  {}",
                name(torque),
                number(torque.cad),
                number(torque.identified),
                unit(model, torque.dof),
                self.why(torque)
            );
        }
        if details {
            self.print_details();
        }
    }

    /// What a torque rests on that cannot be identified, in words.
    fn why(&self, torque: &TorqueKnowledge) -> String {
        if torque.identified.is_none() {
            return "undetermined: too many contacts".into();
        }
        let sensors = self.robot.sensor_names().enumerate();
        let is_known = |sensor: usize| self.robot.offsets[sensor].1 == [0.0; 6];
        let sensors =
            sensors.filter(|(sensor, _)| torque.offsets.contains(sensor) && !is_known(*sensor));
        let offsets: Vec<String> = sensors
            .map(|(_, name)| format!("offset of {name}"))
            .collect();
        let links = torque.assumed.iter().take(4).map(|(link, deviation)| {
            format!(
                "{} {}",
                self.robot.model.link_name(*link),
                short(*deviation)
            )
        });
        let mut links: Vec<String> = links.collect();
        match torque.assumed.len().saturating_sub(links.len()) {
            0 => {}
            more => links.push(format!("{more} more")),
        }
        let rests_on_cad = torque.identified.is_some_and(|own| own >= NOTHING);
        match (offsets.is_empty(), rests_on_cad && !links.is_empty()) {
            (true, false) => "rests on what is identified".into(),
            (true, true) => format!("CAD of {}", links.join(", ")),
            (false, false) => offsets.join(", "),
            (false, true) => format!("{}; CAD of {}", offsets.join(", "), links.join(", ")),
        }
    }

    fn print_details(&self) {
        print_line!("");
        print_line!("identified:");
        for (number, base) in self.knowledge.base_parameters.iter().enumerate() {
            print_line!("{:>4}  {base}", number + 1);
        }
        print_line!("");
        for torque in &self.knowledge.torques {
            let name = self.robot.model.dof_name(torque.dof);
            print_line!("{name} rests on {}", ranges(&torque.rests_on));
        }
    }

    fn json(&self, remedies: Option<&Remedies>) -> Value {
        let model = &self.robot.model;
        let sensors: Vec<&str> = self.robot.sensor_names().collect();
        let torques = self.knowledge.torques.iter().map(|own| {
            let assumed = own.assumed.iter();
            let assumed = assumed.map(|(link, deviation)| {
                json!({ "link": model.link_name(*link), "deviation": deviation })
            });
            let offsets = own.offsets.iter().map(|&sensor| sensors.get(sensor));
            json!({
                "joint": model.dof_name(own.dof),
                "unit": unit(model, own.dof),
                "deviation_cad": own.cad,
                "deviation_identified": own.identified,
                "rests_on": own.rests_on,
                "cad_of": assumed.collect::<Vec<_>>(),
                "offset_of": offsets.collect::<Vec<_>>(),
            })
        });
        let bases = self.knowledge.base_parameters.iter();
        json!({
            "sensors": self.names,
            "rank": self.knowledge.rank,
            "unknowns": self.knowledge.unknowns,
            "base_parameters": bases.map(ToString::to_string).collect::<Vec<_>>(),
            "torques": torques.collect::<Vec<_>>(),
            "remedies": remedies.map(|own| json!({
                "joint": own.joint,
                "unit": own.unit,
                "deviation": own.now,
                "sensors": named("joint", &own.sensors),
                "deviation_still": own.still,
                "motions": named("joint", &own.motions),
            })),
        })
    }
}

fn named(key: &str, all: &[(String, f64)]) -> Vec<Value> {
    let all = all.iter();
    all.map(|(name, deviation)| json!({ key: name, "deviation": deviation }))
        .collect()
}

impl Remedies {
    fn print(&self) {
        let Self { joint, unit, .. } = self;
        let list = |all: &[(String, f64)]| {
            let all = all.iter();
            let all = all.map(|(name, deviation)| format!("{name} {}", short(*deviation)));
            all.collect::<Vec<_>>().join(", ")
        };
        print_line!("");
        if self.now.is_infinite() && !self.sensors.is_empty() {
            print_line!(
                "a further F/T sensor would determine {joint}, to: {} {unit}",
                list(&self.sensors)
            );
        } else if self.now.is_infinite() {
            print_line!("no further F/T sensor alone would determine {joint}");
        } else if self.now <= NOTHING {
            print_line!("nothing that rests on CAD remains of {joint}");
        } else if self.sensors.is_empty() {
            print_line!(
                "no further F/T sensor would lessen {} {unit} of {joint}",
                short(self.now)
            );
        } else {
            print_line!(
                "a further F/T sensor would lessen {} {unit} of {joint} to: {}",
                short(self.now),
                list(&self.sensors)
            );
        }
        if self.now.is_infinite() {
            return;
        }
        if self.motions.is_empty() {
            print_line!("no joint's motion alone lessens what is uncertain of {joint}");
        } else {
            print_line!(
                "one joint's motion alone lessens {joint} from {} {unit} to: {}",
                short(self.still),
                list(&self.motions)
            );
        }
    }
}

/// Numbers from 1, in ranges: `1 to 4, 7`.
fn ranges(numbers: &[usize]) -> String {
    let mut parts: Vec<(usize, usize)> = Vec::new();
    for &number in numbers {
        match parts.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => parts.push((number, number)),
        }
    }
    let parts = parts.iter().map(|(first, last)| match first == last {
        true => format!("{}", first + 1),
        false => format!("{} to {}", first + 1, last + 1),
    });
    let parts: Vec<String> = parts.collect();
    match parts.is_empty() {
        true => "none of them".into(),
        false => parts.join(", "),
    }
}
