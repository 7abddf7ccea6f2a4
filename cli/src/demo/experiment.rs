//! The setup of the demonstration: robot, motion, wrong URDF, and the configuration of its
//! processes.

use proprio_dynamics::model::Model;
use proprio_dynamics::spatial::RigidInertia;
use proprio_estimator::config::{Config, ConfigError};
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_simulator::{Robot, Settings, Simulation, wrong_urdf};
use std::fs::{self};
use std::path::{Path, PathBuf};

/// `proprio demo`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The robot: a folder in config/, or a path
    #[arg(long, value_name = "NAME", default_value = "icub_left_arm")]
    pub(crate) robot: String,
    /// Duration [s]: the robot stands still for a quarter of it (at most 10 s), then moves
    #[arg(long, value_name = "N", default_value_t = 40.0, value_parser = seconds)]
    pub(crate) seconds: f64,
    /// Relative error of masses and first moments in the estimator's URDF; moments of inertia have
    /// about the same
    #[arg(long, value_name = "SHARE", default_value_t = 0.2, value_parser = share)]
    pub(crate) cad_error: f64,
    /// Output folder for report.html, estimates.csv, summary.json, the wrong URDF, the estimator's
    /// configuration and the processes' logs
    #[arg(long, value_name = "DIR", default_value = "proprio-demo")]
    pub(crate) out: PathBuf,
    /// CAN interfaces to use instead of virtual buses: one per bus of the robot, or a single one
    /// for all devices
    #[arg(long, value_name = "INTERFACE")]
    pub(crate) bus: Vec<String>,
    /// The seed of trajectory, noise and the URDF's errors
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

impl Args {
    /// Duration without motion at the start [s].
    pub(crate) fn still(&self) -> f64 {
        (0.25 * self.seconds).min(10.0)
    }

    /// The simulator's settings.
    pub(crate) fn settings(&self) -> Settings {
        Settings {
            seed: self.seed,
            still: self.still(),
            cycle: self.seconds,
            ..Settings::default()
        }
    }
}

/// Bound of the torques' standard deviations if the robot's configuration has none [Nm].
pub(crate) const MOST_STD: f64 = 0.5;

/// A link's name and its ten inertial parameters.
pub(crate) type Link = (String, [f64; 10]);

/// The configurations of the estimator with and without identification, and the truth.
pub(crate) struct Experiment {
    /// The estimator's configuration, with the wrong URDF beside it.
    pub(crate) config: PathBuf,
    /// The estimator's setup at the start.
    pub(crate) setup: Setup,
    /// The same without identification and without a bound.
    pub(crate) baseline: Setup,
    /// The contact that is pushed and declared, and the times of the push [s] of the simulation.
    pub(crate) pushed: Option<String>,
    pub(crate) touched: Vec<(f64, f64)>,
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
    /// Writes `cad.urdf` and `estimator.toml` to `out`: the configuration of `robot` with
    /// identification on, with that URDF, and with the pushed contact as a possible one.
    pub(crate) fn prepare(args: &Args, robot: &Robot, out: &Path) -> anyhow::Result<Self> {
        let settings = args.settings();
        fs::write(
            out.join("cad.urdf"),
            wrong_urdf(robot, &settings, args.cad_error)?,
        )?;
        let simulation = Simulation::new(robot, &settings)?;
        let pushed = simulation.pushed();
        let mut touched = vec![];
        let mut next = simulation.next_touch(0.0);
        while let Some(touch) = next.filter(|touch| touch.t < args.seconds) {
            if touch.begins {
                touched.push((touch.t, args.seconds));
            } else if let Some((_, until)) = touched.last_mut() {
                *until = touch.t;
            }
            next = simulation.next_touch(touch.t);
        }
        let mut table: toml::Table =
            fs::read_to_string(robot.folder.join("estimator.toml"))?.parse()?;
        table.insert("model".into(), "cad.urdf".into());
        let contacts = table.get_mut("contact").and_then(toml::Value::as_array_mut);
        if let Some(contact) = pushed.and_then(|c| contacts?.get_mut(c)?.as_table_mut()) {
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
                identification on\n# and a deliberately wrong URDF.\n";
        fs::write(&file, format!("{head}{table}"))?;
        let mut config = Config::load(&file)?;
        let setup = |config: &Config| {
            Setup::new(config).map_err(|problem| ConfigError {
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
        config.output.max_torque_std_nm = None;
        Ok(Self {
            baseline: setup(&config)?,
            pushed: simulation
                .contact_names()
                .nth(pushed.unwrap_or(usize::MAX))
                .map(ToOwned::to_owned),
            touched,
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
        })
    }

    /// A description of the experiment for the report.
    pub(crate) fn story(&self, args: &Args) -> String {
        let error = 100.0 * args.cad_error;
        let mut story = format!(
            "The robot stands still for {} s, then it moves. The estimator's URDF is deliberately \
             wrong: masses and first moments by {error:.0} %, moments of inertia by about as much \
             (cad.urdf). ",
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
        if let (Some(contact), Some((from, until))) = (&self.pushed, self.touched.first()) {
            story.push_str(&format!(
                " From {from:.1} s to {until:.1} s contact {contact:?} is pushed, and the push is \
                 declared, as by a skin: identification pauses meanwhile."
            ));
        }
        story
    }
}
