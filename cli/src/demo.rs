//! `proprio demo`: the experiment of the paper, without a robot. A simulated one, the gateway and the estimator run as three processes; what they tell is watched through
//! shared memory like any consumer does, and compared with the simulator's truth at the end.
//!
//! The estimator gets a URDF that is deliberately wrong (`cad.urdf`), and identifies the robot's inertial parameters and its sensors' offsets while it works. The robot
//! stands still first, so that there is nothing to learn from, and then moves. Beside it runs what the estimator would say without identification.

mod baseline;
mod result;

use anyhow::{Context, anyhow, bail};
use baseline::{Baseline, Readers};
use indicatif::{ProgressBar, ProgressStyle};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_estimator::config::{Config, ConfigError};
use proprio_estimator::model::Model;
use proprio_estimator::pipeline::Pipeline;
use proprio_estimator::setup::Setup;
use proprio_estimator::spatial::RigidInertia;
use proprio_simulator::{Fault, Robot, Settings, Simulation, Simulator, wrong_urdf};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Topic, monotonic};
use proprio_topics::{
    ContactEstimate, ContactWrench, EstimatorHealth, GatewayHealth, InertiaEstimate, JointTorque, LinkInertia, Nanos,
    Residual, SensorOffset, TorqueEstimate,
};
use serde_json::Value as Json;
use std::fs::{self, File};
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// `proprio demo`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The robot: a folder in config/, or a path
    #[arg(long, value_name = "NAME", default_value = "icub_left_arm")]
    robot: String,
    /// How long it takes [s]: a quarter of it, 10 s at the most, the robot stands still, then it moves
    #[arg(long, value_name = "N", default_value_t = 40.0, value_parser = seconds)]
    seconds: f64,
    /// How far masses and first moments of the URDF that the estimator gets are off, as a share of them; moments of inertia by about as much
    #[arg(long, value_name = "SHARE", default_value_t = 0.2, value_parser = share)]
    cad_error: f64,
    /// Where report.html, estimates.csv, summary.json, the wrong URDF, the estimator's configuration and the processes' logs go
    #[arg(long, value_name = "DIR", default_value = "proprio-demo")]
    out: PathBuf,
    /// CAN interfaces to use instead of virtual buses, one per bus of the robot; a single one takes all devices
    #[arg(long, value_name = "INTERFACE")]
    bus: Vec<String>,
    /// The seed of trajectory, noise and what is wrong with the URDF
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A fault of the robot, as `proprio simulate` takes it; may be repeated
    #[arg(long, value_name = "FAULT")]
    fault: Vec<String>,
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (2.0..=600.0).contains(&s) => Ok(s),
        _ => Err("must be 2 to 600".into()),
    }
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (0.0..=0.5).contains(&s) => Ok(s),
        _ => Err("must be 0 to 0.5".into()),
    }
}

impl Args {
    /// How long the robot stands still [s].
    fn still(&self) -> f64 {
        (0.25 * self.seconds).min(10.0)
    }

    /// What the simulator is told.
    fn settings(&self) -> Settings {
        Settings {
            seed: self.seed,
            still: self.still(),
            cycle: self.seconds,
            ..Settings::default()
        }
    }
}

/// How long the processes may take to be ready, and to end: they need a second, but half a minute in user-mode Linux on a busy machine. One that fails is noticed at once.
const PATIENCE: Nanos = Nanos::from_millis(60_000);
/// Where the robot's configuration bounds no torque's standard deviation, this does [Nm].
const MOST_STD: f64 = 0.5;

/// Runs the demonstration.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let original = Robot::open(&args.robot)?;
    // A wrong fault shows before anything is started.
    let faults = args
        .fault
        .iter()
        .map(|f| f.parse::<Fault>())
        .collect::<Result<Vec<_>, _>>()?;
    Simulator::new(
        &original,
        &Settings {
            faults,
            ..Settings::default()
        },
        Nanos::ZERO,
    )?;
    // Ctrl-C reaches the processes too, which end in order; this one must stay until they have, to clean up after them.
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [
        signal_hook::consts::SIGTERM,
        signal_hook::consts::SIGINT,
        signal_hook::consts::SIGHUP,
        signal_hook::consts::SIGQUIT,
    ] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    fs::create_dir_all(&args.out).with_context(|| format!("{}: can not be created", args.out.display()))?;
    let out = args.out.canonicalize()?;
    // Results of an earlier run are not those of this one.
    for name in ["summary.json", "report.html", "estimates.csv"] {
        let _ = fs::remove_file(out.join(name));
    }
    let private = tempfile::Builder::new()
        .prefix("proprio-")
        .tempdir()
        .context("no temporary folder")?;
    let domain = DomainConfig::new(private.path(), &format!("demo-{}", std::process::id()));
    let folder = private.path().join("robot");
    copy_robot(&original, &args.bus, &folder)?;
    let robot = Robot::load(&folder)?;
    let experiment = Experiment::prepare(args, &robot, &out)?;

    say!(
        "robot {}: simulator, gateway and estimator as three processes, {} s",
        robot.config.robot,
        args.seconds
    );
    say!("{}", experiment.story(args));
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
    if !matches!(removed, Ok(true)) {
        eprintln!("note: shared memory of the demonstration could not be removed: {removed:?}");
    }
    if processes.stop.load(Relaxed) {
        bail!("interrupted");
    }
    let watched = outcome.map_err(|error| processes.explain(error))?;
    ended?;
    result::finish(args, &experiment, &out, &watched, &private.path().join("truth.csv"))
}

/// Copies the robot's configuration to `to`, with the sources of its buses replaced by `buses`, if any are given.
fn copy_robot(robot: &Robot, buses: &[String], to: &Path) -> anyhow::Result<()> {
    let read = |name: &str| -> anyhow::Result<toml::Table> {
        let file = robot.folder.join(name);
        let text = fs::read_to_string(&file).with_context(|| format!("{}: can not be read", file.display()))?;
        text.parse().with_context(|| file.display().to_string())
    };
    let mut gateway = read("gateway.toml")?;
    if let (false, Some(toml::Value::Array(list))) = (buses.is_empty(), gateway.get_mut("bus")) {
        if buses.len() == 1 && list.len() > 1 {
            // One interface for all: their devices come together on the first bus.
            let devices: Vec<toml::Value> = list
                .iter_mut()
                .filter_map(|bus| bus.as_table_mut()?.remove("device"))
                .filter_map(|devices| devices.as_array().cloned())
                .flatten()
                .collect();
            list.truncate(1);
            if let Some(bus) = list.first_mut().and_then(toml::Value::as_table_mut) {
                bus.insert("device".into(), devices.into());
            }
        } else if buses.len() != list.len() {
            let problem = format!(
                "--bus is given {} times; the robot has {} buses: give one interface for each, or one for all",
                buses.len(),
                list.len()
            );
            return Err(ConfigError {
                file: robot.folder.join("gateway.toml"),
                problem,
            }
            .into());
        }
        for (bus, interface) in list.iter_mut().zip(buses) {
            if let Some(bus) = bus.as_table_mut() {
                let source = [("kind", "socketcan"), ("interface", interface.as_str())];
                let source: toml::Table = source.into_iter().map(|(k, v)| (k.to_owned(), v.into())).collect();
                bus.insert("source".into(), source.into());
            }
        }
    }
    let mut estimator = read("estimator.toml")?;
    let model = robot
        .config
        .model
        .canonicalize()
        .with_context(|| robot.config.model.display().to_string())?;
    let model = model
        .to_str()
        .with_context(|| format!("{} is not UTF-8", model.display()))?;
    estimator.insert("model".into(), model.into());
    // What was identified of a real robot is not the simulated one's.
    estimator.remove("parameters");
    if let Some(identification) = estimator.get_mut("identification").and_then(toml::Value::as_table_mut) {
        identification.remove("state");
    }
    fs::create_dir_all(to)?;
    fs::write(to.join("gateway.toml"), gateway.to_string())?;
    fs::write(to.join("estimator.toml"), estimator.to_string())?;
    Ok(())
}

/// A link's name and its ten inertial parameters.
type Link = (String, [f64; 10]);

/// What the estimator is given, and what it would say without identification.
struct Experiment {
    /// The estimator's configuration, with the wrong URDF beside it.
    config: PathBuf,
    /// As the estimator has it at the start.
    setup: Setup,
    /// The same without identification, and without a bound.
    baseline: Setup,
    /// The contact that is pushed and declared, and from when until when [s] of the simulation.
    pushed: Option<String>,
    touched: Vec<(f64, f64)>,
    /// Per link its inertial parameters, of the robot and of the CAD.
    truth: Vec<Link>,
    cad: Vec<Link>,
    /// Per F/T sensor its true offset: fx fy fz tx ty tz [N, Nm].
    offsets: Vec<(String, [f64; 6])>,
    /// The bound of torques' standard deviations [Nm].
    most_std: f64,
    /// Why nothing can be identified.
    refused: Option<String>,
}

impl Experiment {
    /// Writes `cad.urdf` and `estimator.toml` to `out`: the configuration of `robot` with identification on, with that URDF, and with the contact that the simulator
    /// pushes and declares as one that comes and goes.
    fn prepare(args: &Args, robot: &Robot, out: &Path) -> anyhow::Result<Self> {
        let settings = args.settings();
        fs::write(out.join("cad.urdf"), wrong_urdf(robot, &settings, args.cad_error)?)?;
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
        let mut table: toml::Table = fs::read_to_string(robot.folder.join("estimator.toml"))?.parse()?;
        table.insert("model".into(), "cad.urdf".into());
        let contacts = table.get_mut("contact").and_then(toml::Value::as_array_mut);
        if let Some(contact) = pushed.and_then(|c| contacts?.get_mut(c)?.as_table_mut()) {
            contact.insert("presence".into(), "possible".into());
        }
        let mut set = |section: &str, key: &str, value: toml::Value| {
            let section = table.entry(section).or_insert_with(|| toml::Table::new().into());
            if let Some(section) = section.as_table_mut() {
                section.insert(key.into(), value);
            }
        };
        set("identification", "enabled", true.into());
        let most_std = robot.config.output.max_torque_std_nm.unwrap_or(MOST_STD);
        set("output", "max_torque_std_nm", most_std.into());
        let file = out.join("estimator.toml");
        let head = "# The estimator's configuration of the demonstration: the robot's, with identification on and a URDF that is deliberately wrong.\n";
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
            cad: links(&with.model, with.cad()),
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

    /// What happens, in words.
    fn story(&self, args: &Args) -> String {
        let error = 100.0 * args.cad_error;
        let mut story = format!(
            "The robot stands still for {} s, then it moves. The estimator's URDF is deliberately wrong: masses and first moments by {error:.0} %, moments of inertia by about as much (cad.urdf). ",
            args.still()
        );
        match &self.refused {
            None => story.push_str(&format!(
                "From the F/T sensors it learns the right ones while the robot moves; a torque whose standard deviation is above {} Nm is withheld until then.",
                self.most_std
            )),
            Some(why) => story.push_str(&format!("Nothing is learnt: {}.", why.trim_end_matches('.'))),
        }
        if let (Some(contact), Some((from, until))) = (&self.pushed, self.touched.first()) {
            story.push_str(&format!(
                " From {from} s to {until} s something pushes contact {contact:?} and is declared, as by a skin: meanwhile nothing is learnt."
            ));
        }
        story
    }
}

/// The processes of the demonstration. None outlives it.
struct Processes {
    private: PathBuf,
    domain: DomainConfig,
    out: PathBuf,
    running: Vec<(&'static str, Child)>,
    /// Set by a signal: everything is to end.
    stop: Arc<AtomicBool>,
}

impl Processes {
    fn start(&mut self, name: &'static str, args: &[&str]) -> anyhow::Result<()> {
        let program = std::env::current_exe().context("this program's own path")?;
        let log = File::create(self.out.join(format!("{name}.log")))?;
        let output = if name == "simulate" {
            File::create(self.private.join("simulate.json"))?.into()
        } else {
            Stdio::null()
        };
        let child = Command::new(program)
            .arg(name)
            .args(args)
            .env("PROPRIO_DOMAIN", &self.domain.name)
            .env("PROPRIO_RUNTIME_DIR", &self.domain.base)
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(log)
            .spawn()
            .with_context(|| format!("cannot start {name}"))?;
        self.running.push((name, child));
        Ok(())
    }

    /// Whether `name` has ended, and how.
    fn ended(&mut self, name: &str) -> anyhow::Result<bool> {
        if self.stop.load(Relaxed) {
            bail!("interrupted");
        }
        let Some((_, child)) = self.running.iter_mut().find(|(n, _)| *n == name) else {
            return Ok(true);
        };
        match child.try_wait()? {
            None => Ok(false),
            Some(status) if status.success() => Ok(true),
            Some(status) => Err(anyhow!("{name} ended with {status}")),
        }
    }

    /// Ends all, politely first, in the order estimator, gateway, simulator.
    fn end(&mut self) -> anyhow::Result<()> {
        let mut problem = Ok(());
        for (name, mut child) in std::mem::take(&mut self.running).into_iter().rev() {
            if child.try_wait()?.is_none() {
                let _ = kill(Pid::from_raw(i32::try_from(child.id())?), Signal::SIGTERM);
            }
            let end = monotonic() + PATIENCE;
            let status = loop {
                if let Some(status) = child.try_wait()? {
                    break status;
                }
                if monotonic() > end {
                    child.kill()?;
                    break child.wait()?;
                }
                std::thread::sleep(Duration::from_millis(5));
            };
            if !status.success() && problem.is_ok() {
                problem = Err(anyhow!(
                    "{name} ended with {status}; see {}",
                    self.out.join(format!("{name}.log")).display()
                ));
            }
        }
        problem
    }

    /// An error with the last lines of the logs, in which its cause is.
    fn explain(&self, error: anyhow::Error) -> anyhow::Error {
        let mut text = String::new();
        for name in ["gateway", "estimator", "simulate"] {
            let log = fs::read_to_string(self.out.join(format!("{name}.log"))).unwrap_or_default();
            let lines: Vec<_> = log
                .lines()
                .filter(|l| l.contains("ERROR") || l.starts_with("error"))
                .collect();
            for line in lines.iter().rev().take(3).rev() {
                text.push_str(&format!("\n  {name}: {line}"));
            }
        }
        if text.is_empty() {
            error
        } else {
            error.context(format!("the processes' own words:{text}\n"))
        }
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        for (_, child) in &mut self.running {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// What was seen through shared memory.
struct Watched {
    joints: Vec<String>,
    estimates: Vec<Seen>,
    /// What the CAD makes of the same samples.
    baseline: Vec<(Nanos, Box<[f64]>)>,
    /// What was identified, solution by solution.
    learnt: Vec<Learnt>,
    lost_estimates: u64,
    gateway: Box<GatewayHealth>,
    estimator: EstimatorHealth,
    simulator: Json,
}

/// What was identified from the data up to some instant.
struct Learnt {
    t: Nanos,
    links: Box<[LinkInertia]>,
    offsets: Box<[SensorOffset]>,
}

/// One estimate, as small as it can be kept.
struct Seen {
    t: Nanos,
    published: Nanos,
    joints: Box<[JointTorque]>,
    contacts: Box<[ContactWrench]>,
    residuals: Box<[Residual]>,
}

fn open<T: Topic>(domain: &Domain, robot: &str, processes: &mut Processes) -> anyhow::Result<Reader<T>> {
    let end = monotonic() + PATIENCE;
    let mut ended = None;
    let reader = Reader::wait_open(domain, robot, |_| {
        std::thread::sleep(Duration::from_millis(5));
        let failed = ["gateway", "estimator"]
            .into_iter()
            .find_map(|p| match processes.ended(p) {
                Ok(false) => None,
                Ok(true) => Some(anyhow!("{p} ended too early")),
                Err(error) => Some(error),
            });
        ended = failed;
        ended.is_none() && monotonic() < end
    });
    match (reader, ended) {
        (Err(_), Some(error)) => Err(error),
        (reader, _) => Ok(reader?),
    }
}

/// Starts the processes and watches until the robot has stopped.
fn watch(args: &Args, robot: &Robot, experiment: &Experiment, processes: &mut Processes) -> anyhow::Result<Watched> {
    let text = |p: &Path| {
        p.to_str()
            .map(ToOwned::to_owned)
            .with_context(|| format!("{} is not UTF-8", p.display()))
    };
    let truth = text(&processes.private.join("truth.csv"))?;
    let (duration, seed, still) = (
        args.seconds.to_string(),
        args.seed.to_string(),
        args.still().to_string(),
    );
    let folder = text(&robot.folder)?;
    let mut simulate = vec![
        "--robot",
        &folder,
        "--seconds",
        &duration,
        "--seed",
        &seed,
        "--still",
        &still,
        "--skin",
        "--truth",
        &truth,
        "--json",
    ];
    args.fault.iter().for_each(|f| simulate.extend(["--fault", f.as_str()]));
    let (gateway_toml, estimator_toml) = (text(&robot.folder.join("gateway.toml"))?, text(&experiment.config)?);
    processes.start("gateway", &["--config", &gateway_toml])?;
    processes.start("estimator", &["--config", &estimator_toml])?;

    let domain = Domain::open(&processes.domain)?;
    let name = robot.config.robot.clone();
    let mut torques: Reader<TorqueEstimate> = open(&domain, &name, processes)?;
    let mut contacts: Reader<ContactEstimate> = open(&domain, &name, processes)?;
    // Where nothing can be identified, nobody tells of it.
    let mut inertias: Option<Reader<InertiaEstimate>> = match experiment.refused {
        None => Some(open(&domain, &name, processes)?),
        Some(_) => None,
    };
    let mut gateway_health: Reader<GatewayHealth> = open(&domain, &name, processes)?;
    let mut estimator_health: Reader<EstimatorHealth> = open(&domain, &name, processes)?;
    // The gateway tells its health once all its links are open: from then on no frame is lost.
    let gateway = Box::new(wait_for(&mut gateway_health, processes)?);
    let readers = Readers {
        samples: open(&domain, &name, processes)?,
        descriptions: open(&domain, &name, processes)?,
        declarations: open(&domain, &name, processes)?,
    };
    let mut baseline = Baseline::new(experiment.baseline.clone(), readers);
    processes.start("simulate", &simulate)?;

    let joints: Vec<String> = experiment.setup.joint_names().map(ToOwned::to_owned).collect();
    let mut screen = Screen::new(args, &joints, experiment.refused.is_none());
    let mut watched = Watched {
        joints,
        estimates: Vec::with_capacity((args.seconds * 1100.0) as usize),
        baseline: vec![],
        learnt: vec![],
        lost_estimates: 0,
        gateway,
        estimator: EstimatorHealth::default(),
        simulator: Json::Null,
    };
    let begin = monotonic();
    let mut last_seen = begin;
    loop {
        let mut any = false;
        while let Some(estimate) = torques.try_take()? {
            any = true;
            watched.estimates.push(Seen {
                t: estimate.header.acquired,
                published: estimate.header.published,
                joints: estimate.joints().into(),
                contacts: Box::default(),
                residuals: Box::default(),
            });
        }
        while let Some(estimate) = contacts.try_take()? {
            // The contacts of an instant follow its torques at once.
            let seen = watched
                .estimates
                .iter_mut()
                .rev()
                .take(600)
                .find(|s| s.t == estimate.header.acquired);
            if let Some(seen) = seen {
                seen.contacts = estimate.contacts().into();
                seen.residuals = estimate.residuals().into();
            }
        }
        while let Some(inertia) = inertias.as_mut().map_or(Ok(None), Reader::try_take)? {
            // What is in force before the first solution is the CAD.
            if inertia.links().iter().any(|link| link.accepted == 1) {
                watched.learnt.push(Learnt {
                    t: inertia.header.acquired,
                    links: inertia.links().into(),
                    offsets: inertia.offsets().into(),
                });
            }
        }
        baseline.turn()?;
        if let Some(health) = gateway_health.latest()? {
            *watched.gateway = health;
        }
        if let Some(health) = estimator_health.latest()? {
            watched.estimator = health;
        }
        let now = monotonic();
        if any {
            last_seen = now;
            screen.show(watched.estimates.last(), now);
        }
        for process in ["gateway", "estimator"] {
            if processes.ended(process)? {
                bail!("{process} ended too early");
            }
        }
        if processes.ended("simulate")? && now - last_seen > Nanos::from_millis(400) {
            break;
        }
        // The truth is written after the motion, a row for each of its milliseconds.
        if now - begin > Nanos::from_seconds(1.5 * args.seconds) + PATIENCE {
            bail!("the simulator does not end");
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    screen.end();
    watched.baseline = baseline.finish();
    watched.lost_estimates = torques.lost();
    // The final counts: two more healths of each.
    let end = monotonic() + Nanos::from_millis(300);
    while monotonic() < end {
        if let Some(health) = gateway_health.latest()? {
            *watched.gateway = health;
        }
        if let Some(health) = estimator_health.latest()? {
            watched.estimator = health;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let told = fs::read_to_string(processes.private.join("simulate.json"))?;
    watched.simulator = serde_json::from_str(told.trim()).context("what the simulator says of itself")?;
    if watched.estimates.is_empty() {
        bail!("no estimate was published");
    }
    Ok(watched)
}

fn wait_for<T: Topic>(reader: &mut Reader<T>, processes: &mut Processes) -> anyhow::Result<T> {
    let end = monotonic() + PATIENCE;
    loop {
        if let Some(value) = reader.latest()? {
            return Ok(value);
        }
        if processes.ended("gateway")? || monotonic() > end {
            bail!("the gateway tells nothing of its health");
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The live table and the progress bar; a line a second where the output is no terminal.
struct Screen {
    terminal: bool,
    bar: ProgressBar,
    joints: Vec<String>,
    /// When the robot begins to move [s].
    still: f64,
    /// Whether there is something that can be learnt.
    learns: bool,
    has_told: bool,
    begin: Option<Nanos>,
    next: Nanos,
    lines: usize,
}

impl Screen {
    fn new(args: &Args, joints: &[String], learns: bool) -> Self {
        let terminal = std::io::stdout().is_terminal();
        let bar = if terminal {
            ProgressBar::new((args.seconds * 10.0) as u64)
        } else {
            ProgressBar::hidden()
        };
        bar.set_style(ProgressStyle::with_template("{bar:40} {msg}").unwrap_or_else(|_| ProgressStyle::default_bar()));
        Self {
            terminal,
            bar,
            joints: joints.to_vec(),
            still: args.still(),
            learns,
            has_told: false,
            begin: None,
            next: Nanos::ZERO,
            lines: 0,
        }
    }

    fn show(&mut self, last: Option<&Seen>, now: Nanos) {
        let begin = *self.begin.get_or_insert(now);
        let Some(last) = last.filter(|_| now >= self.next) else {
            return;
        };
        self.next = now
            + if self.terminal {
                Nanos::from_millis(100)
            } else {
                Nanos::from_millis(1000)
            };
        let elapsed = (now - begin).seconds();
        let of = |i: usize| last.joints.get(i);
        let moves = elapsed >= self.still;
        if !self.terminal {
            if moves && !std::mem::replace(&mut self.has_told, true) {
                say!("{elapsed:5.1} s  the robot begins to move");
            }
            let cells: Vec<_> = self
                .joints
                .iter()
                .enumerate()
                .map(|(i, j)| {
                    of(i).map_or_else(String::new, |t| {
                        format!("{j} {:.2}{}", t.torque, if t.valid == 1 { "" } else { "!" })
                    })
                })
                .collect();
            say!("{elapsed:5.1} s  {}", cells.join("  "));
            return;
        }
        let mut text = String::new();
        for (i, joint) in self.joints.iter().enumerate() {
            let Some(torque) = of(i) else { continue };
            let state = if torque.valid == 1 {
                "valid"
            } else {
                torque.reason.word()
            };
            text.push_str(&format!(
                "\x1b[2K{joint:<20} {:>9.3} Nm  +- {:>6.3}  {state}\n",
                torque.torque, torque.standard_deviation
            ));
        }
        self.bar.suspend(|| {
            if self.lines > 0 {
                say_part!("\x1b[{}A", self.lines);
            }
            say_part!("{text}");
            let _ = std::io::stdout().flush();
        });
        self.lines = self.joints.len();
        let doing = match (moves, self.learns) {
            (false, _) => "standing still",
            (true, true) => "moving, learning",
            (true, false) => "moving",
        };
        self.bar.set_message(format!("{elapsed:.1} s, {doing}"));
        self.bar.set_position((elapsed * 10.0) as u64);
    }

    fn end(&self) {
        self.bar.finish_and_clear();
    }
}
