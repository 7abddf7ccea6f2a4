//! `proprio demo`: the experiment of the paper, without a real robot. A simulated robot, the
//! gateway and the estimator run as three processes. The command reads their outputs from shared
//! memory, as any consumer does, and compares them with the simulator's truth at the end.
//!
//! The estimator gets a deliberately wrong URDF (`cad.urdf`, called the CAD) and identifies the
//! robot's inertial parameters and its sensors' offsets on-line. The robot first stands still,
//! which gives no information, and then moves. For comparison, a second pipeline uses the CAD's
//! parameters to the end, with the same offsets.

mod baseline;
mod experiment;
mod processes;
mod result;
mod watching;

pub(crate) use experiment::DemoArgs;

use crate::folder::{read, with_files};
use crate::running::interrupted_by;
use anyhow::{Context, bail};
use experiment::Experiment;
use processes::Processes;
use proprio_estimator::config::InvalidConfig;
use proprio_simulator::{FaultError, InjectedFault, SimulatedRobot, SimulationSettings, Simulator};
use proprio_topics::Nanos;
use proprio_topics::ipc::{Domain, DomainConfig};
use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use std::fs;
use std::path::Path;
use std::sync::atomic::Ordering::Relaxed;
use watching::watch;

/// The domain of who names none: a robot may run there.
const DEFAULT: &str = "default";

/// Runs the demonstration.
pub(crate) fn run(args: &DemoArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let original = SimulatedRobot::open(&args.robot)?;
    check_faults(args, &original)?;
    // Ctrl-C reaches the child processes too. This process must outlive them to clean up.
    let stop = interrupted_by(&[SIGTERM, SIGINT, SIGHUP, SIGQUIT])?;
    fs::create_dir_all(&args.out)
        .with_context(|| format!("{}: cannot be created", args.out.display()))?;
    let out = args.out.canonicalize()?;
    // Remove the results of an earlier run.
    for name in ["summary.json", "report.html", "estimates.csv"] {
        let _ = fs::remove_file(out.join(name));
    }
    let private = tempfile::Builder::new()
        .prefix("proprio-")
        .tempdir()
        .context("cannot create a temporary folder")?;
    // One of its own: a robot that runs here is left alone. Others can look, if they know it.
    let domain = match domain.name == DEFAULT {
        true => DomainConfig::new(&domain.base, &format!("demo-{}", std::process::id())),
        false => domain.clone(),
    };
    let folder = private.path().join("robot");
    copy_robot(&original, &args.bus, &folder)?;
    let robot = SimulatedRobot::load(&folder)?;
    let experiment = Experiment::prepare(args, &robot, &out)?;

    print_line!(
        "robot {}: simulator, gateway and estimator as three processes, {} s",
        robot.config.robot,
        args.seconds
    );
    print_line!("{}", experiment.story(args));
    print_line!(
        "To look at it meanwhile: proprio top --domain {}",
        domain.name
    );
    let mut processes = Processes {
        private: private.path().to_owned(),
        domain: domain.clone(),
        out: out.clone(),
        running: vec![],
        stop,
    };
    let outcome = watch(args, &robot, &experiment, &mut processes);
    let ended = processes.end();
    let removed = Domain::remove_if_unused(&domain);
    let left = match removed {
        Ok(true) => None,
        Ok(false) => Some("another process still uses it".to_owned()),
        Err(error) => Some(error.to_string()),
    };
    if let Some(why) = left {
        eprintln!("note: shared memory of the demonstration could not be removed: {why}");
    }
    if processes.stop.load(Relaxed) {
        bail!("interrupted");
    }
    let watched = outcome.map_err(|error| processes.explain(error))?;
    ended?;
    result::finish(
        args,
        &experiment,
        &out,
        &watched,
        &private.path().join("truth.csv"),
    )
}

/// Checks the faults before anything is started.
fn check_faults(args: &DemoArgs, robot: &SimulatedRobot) -> anyhow::Result<()> {
    let faults = args.fault.iter().map(|f| f.parse::<InjectedFault>());
    let faults = faults.collect::<Result<Vec<_>, _>>()?;
    let mut named = args.fault.iter().zip(&faults);
    if let Some((text, _)) = named.find(|(_, fault)| fault.begin() >= args.seconds) {
        return Err(FaultError::AfterEnd {
            text: text.clone(),
            seconds: args.seconds,
        }
        .into());
    }
    let settings = SimulationSettings {
        faults,
        ..SimulationSettings::default()
    };
    Simulator::new(robot, &settings, Nanos::ZERO)?;
    Ok(())
}

/// Copies the robot's configuration, and all files that it names, to the folder `to`. If `buses`
/// are given, they replace the sources of its buses.
fn copy_robot(robot: &SimulatedRobot, buses: &[String], to: &Path) -> anyhow::Result<()> {
    let mut gateway = read(&robot.folder.join("gateway.toml"))?;
    if let (false, Some(toml::Value::Array(list))) = (buses.is_empty(), gateway.get_mut("bus")) {
        if buses.len() == 1 && list.len() > 1 {
            // One interface for all: all devices move to the first bus.
            let mut all = |key: &str| -> Vec<toml::Value> {
                list.iter_mut()
                    .filter_map(|bus| bus.as_table_mut()?.remove(key))
                    .filter_map(|of_bus| of_bus.as_array().cloned())
                    .flatten()
                    .collect()
            };
            let parts = ["device", "coupling"].map(|key| (key, all(key)));
            list.truncate(1);
            if let Some(bus) = list.first_mut().and_then(toml::Value::as_table_mut) {
                for (key, of_all) in parts.into_iter().filter(|(_, of_all)| !of_all.is_empty()) {
                    bus.insert(key.into(), of_all.into());
                }
            }
        } else if buses.len() != list.len() {
            let problem = format!(
                "--bus is given {} times; the robot has {} buses: give one interface for each, or \
                 one for all",
                buses.len(),
                list.len()
            );
            return Err(InvalidConfig {
                file: robot.folder.join("gateway.toml"),
                problem,
            }
            .into());
        }
        for (bus, interface) in list.iter_mut().zip(buses) {
            if let Some(bus) = bus.as_table_mut() {
                let source = [("kind", "socketcan"), ("interface", interface.as_str())];
                let source: toml::Table = source
                    .into_iter()
                    .map(|(k, v)| (k.to_owned(), v.into()))
                    .collect();
                bus.insert("source".into(), source.into());
            }
        }
    }
    let mut estimator = read(&robot.folder.join("estimator.toml"))?;
    // Parameters identified on a real robot do not apply to the simulated one.
    estimator.remove("parameters");
    if let Some(identification) = estimator
        .get_mut("identification")
        .and_then(toml::Value::as_table_mut)
    {
        identification.remove("state");
    }
    fs::create_dir_all(to)?;
    for (name, table) in [("gateway.toml", gateway), ("estimator.toml", estimator)] {
        let table = with_files(table, &robot.folder, to)?;
        fs::write(to.join(name), table.to_string())?;
    }
    Ok(())
}
