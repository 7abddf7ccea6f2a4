//! The setup of the demonstration: robot, motion, CAD, and the configuration of its processes.

use crate::folder::{read, with_files};
use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::RigidInertia;
use proprio_estimator::config::{Config, InvalidConfig};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_simulator::{PlannedPush, SimulatedRobot, Simulation, SimulationSettings, wrong_urdf};
use std::fs::{self};
use std::path::{Path, PathBuf};

/// `proprio demo`.
#[derive(clap::Args)]
pub(crate) struct DemoArgs {
    /// The robot: a folder in config/, or a path
    #[arg(long, value_name = "NAME", default_value = "icub_left_arm")]
    pub(crate) robot: String,
    /// Duration [s]: the robot stands still for a quarter of it (at most 10 s), then moves
    #[arg(long, value_name = "N", default_value_t = 40.0, value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Relative error of masses and first moments in the estimator's URDF, the CAD; moments of
    /// inertia have about the same
    #[arg(long, value_name = "SHARE", default_value_t = 0.2, value_parser = share)]
    pub(crate) cad_error: f64,
    /// Output folder for report.html, estimates.csv, summary.json, the CAD, the configuration and
    /// the processes' logs
    #[arg(long, value_name = "DIR", default_value = "proprio-demo")]
    pub(crate) out: PathBuf,
    /// CAN interfaces to use instead of virtual buses: one per bus of the robot, or a single one
    /// for all devices
    #[arg(long, value_name = "INTERFACE")]
    pub(crate) bus: Vec<String>,
    /// The seed of trajectory, noise and the CAD's errors
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// A fault of the robot, as in `proprio simulate --help`; may be repeated
    #[arg(long, value_name = "FAULT")]
    pub(crate) fault: Vec<String>,
}

pub(crate) fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (2.0..=600.0).contains(&s) => Ok(s),
        _ => Err("must be 2 to 600".into()),
    }
}

pub(crate) fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (0.0..=0.5).contains(&s) => Ok(s),
        _ => Err("must be 0 to 0.5".into()),
    }
}

impl DemoArgs {
    /// Duration without motion at the start [s].
    pub(crate) fn still(&self) -> f64 {
        (0.25 * self.seconds).min(10.0)
    }

    /// The simulator's settings.
    pub(crate) fn settings(&self) -> SimulationSettings {
        SimulationSettings {
            seed: self.seed,
            still: self.still(),
            cycle: self.seconds,
            ..SimulationSettings::default()
        }
    }
}

/// Bound of the torques' standard deviations if the robot's configuration has none [Nm].
pub(crate) const MOST_STD: f64 = 0.5;

/// The file of the estimator's URDF, which is wrong on purpose.
const CAD: &str = "cad.urdf";

/// A link's name and its ten inertial parameters.
pub(crate) type Link = (String, [f64; 10]);

/// The configurations of the estimator with and without identification, and the truth.
pub(crate) struct Experiment {
    /// The gateway's configuration, with all files that it names beside it.
    pub(crate) gateway: PathBuf,
    /// The estimator's configuration, likewise, with the CAD.
    pub(crate) config: PathBuf,
    /// The estimator's setup at the start.
    pub(crate) setup: Setup,
    /// The same without identification and without a bound.
    pub(crate) baseline: Setup,
    /// The joints in the order in which they are told: those beyond an F/T sensor, whose links are
    /// identified, come first. And how many these are.
    pub(crate) order: Vec<usize>,
    pub(crate) beyond: usize,
    /// The push, which is declared, and the name of its contact.
    pub(crate) push: Option<(PlannedPush, String)>,
    /// Per link, the inertial parameters of the robot and of the CAD.
    pub(crate) truth: Vec<Link>,
    pub(crate) cad: Vec<Link>,
    /// Per F/T sensor its true offset: fx fy fz tx ty tz [N, Nm].
    pub(crate) offsets: Vec<(String, [f64; 6])>,
    /// The bound of torques' standard deviations [Nm].
    pub(crate) most_std: f64,
    /// Why nothing can be identified.
    pub(crate) refused: Option<String>,
}

impl Experiment {
    /// Writes a configuration that stands alone to `out`: that of `robot`, the estimator's with
    /// identification on, with the CAD, and with the pushed contact as a possible one.
    pub(crate) fn prepare(
        args: &DemoArgs,
        robot: &SimulatedRobot,
        out: &Path,
    ) -> anyhow::Result<Self> {
        let settings = args.settings();
        let push = Simulation::new(robot, &settings)?.push();
        let gateway = out.join("gateway.toml");
        let table = read(&robot.folder.join("gateway.toml"))?;
        let table = with_files(table, &robot.folder, out)?;
        fs::write(&gateway, table.to_string())?;
        let mut table = read(&robot.folder.join("estimator.toml"))?;
        table.remove("model");
        let mut table = with_files(table, &robot.folder, out)?;
        table.insert("model".into(), CAD.into());
        fs::write(out.join(CAD), wrong_urdf(robot, &settings, args.cad_error)?)?;
        let contacts = table.get_mut("contact").and_then(toml::Value::as_array_mut);
        if let Some(contact) = push.and_then(|p| contacts?.get_mut(p.contact)?.as_table_mut()) {
            contact.insert("presence".into(), "possible".into());
        }
        let mut set = |section: &str, key: &str, value: toml::Value| {
            let section = table
                .entry(section)
                .or_insert_with(|| toml::Table::new().into());
            if let Some(section) = section.as_table_mut() {
                section.insert(key.into(), value);
            }
        };
        set("identification", "enabled", true.into());
        let most_std = robot.config.output.max_torque_std_nm.unwrap_or(MOST_STD);
        set("output", "max_torque_std_nm", most_std.into());
        let file = out.join("estimator.toml");
        let head = "# The estimator's configuration of the demonstration: the robot's own with \
                identification on\n# and a deliberately wrong URDF, the CAD.\n";
        fs::write(&file, format!("{head}{table}"))?;
        let mut config = Config::load(&file)?;
        let setup = |config: &Config| {
            Setup::new(config).map_err(|problem| InvalidConfig {
                file: file.clone(),
                problem,
            })
        };
        let with = setup(&config)?;
        let links = |model: &Model, inertias: &[RigidInertia]| -> Vec<Link> {
            let named = inertias.iter().enumerate();
            named
                .map(|(link, inertia)| (model.link_name(link).to_owned(), inertia.parameters()))
                .collect()
        };
        config.identification.enabled = false;
        // Without identification the CAD's own torques are all wanted.
        config.output.max_torque_std_nm = Some(f64::MAX);
        let named = |push: PlannedPush| {
            let contact = robot.config.contact.get(push.contact)?;
            Some((push, contact.name().to_owned()))
        };
        let (order, beyond) = order(&with);
        Ok(Self {
            order,
            beyond,
            baseline: setup(&config)?,
            push: push.and_then(named),
            truth: links(&robot.model, robot.model.inertias()),
            cad: links(&with.robot.model, with.robot.model.inertias()),
            offsets: (robot.config.force_torque.iter())
                .map(|ft| (ft.sensor.clone(), ft.offset().0.force_first()))
                .collect(),
            most_std,
            refused: Pipeline::new(with.clone())
                .identification_refused()
                .map(ToString::to_string),
            setup: with,
            config: file,
            gateway,
        })
    }

    /// A description of the experiment for the report.
    pub(crate) fn story(&self, args: &DemoArgs) -> String {
        let error = 100.0 * args.cad_error;
        let mut story = format!(
            "The robot stands still for {} s, then it moves. The estimator's URDF, called the CAD, \
             is wrong on purpose: masses and first moments by {error:.0} %, moments of inertia by \
             about as much (cad.urdf). ",
            args.still()
        );
        match &self.refused {
            None => story.push_str(&format!(
                "The estimator identifies the right parameters from the F/T sensors while the \
                 robot moves; until then, torques with a standard deviation above {} Nm are \
                 withheld.",
                self.most_std
            )),
            Some(why) => story.push_str(&format!(
                "Nothing is identified: {}.",
                why.trim_end_matches('.')
            )),
        }
        if let Some((push, contact)) = &self.push {
            story.push_str(&format!(
                " From {:.1} s to {:.1} s contact {contact:?} is pushed with {:.0} N, and the push \
                 is declared, as by a skin: identification pauses meanwhile.",
                push.from, push.until, push.force
            ));
        }
        story
    }
}

/// The joints, those beyond an F/T sensor first, and how many these are.
fn order(setup: &Setup) -> (Vec<usize>, usize) {
    let structure = &setup.robot.structure;
    // The root is in the only sub-tree that no sensor holds from above.
    let is_beyond = |dof: &usize| {
        let subtree = structure
            .link_of(*dof)
            .and_then(|link| structure.subtree_of(link));
        subtree.is_some_and(|number| structure.subtrees().get(number).is_some_and(|s| s.top != 0))
    };
    let (mut order, before): (Vec<usize>, Vec<usize>) =
        (0..setup.robot.model.dof_count()).partition(is_beyond);
    let beyond = order.len();
    order.extend(before);
    (order, beyond)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_beyond_a_sensor_come_first() {
        for (robot, expected) in [
            ("icub_left_arm", (vec![3, 4, 5, 6, 0, 1, 2], 4)),
            ("six_axis_arm", (vec![0, 1, 2, 3, 4, 5], 6)),
        ] {
            let robot = SimulatedRobot::open(robot).unwrap();
            assert_eq!(order(&Setup::new(&robot.config).unwrap()), expected);
        }
    }
}
