//! `proprio demo`: a simulated robot, the gateway and the estimator as three processes; what they tell is watched through
//! shared memory like any consumer does, and compared with the simulator's truth at the end.

use crate::report::plot::{Axis, Ink, Plot, Series};
use crate::report::{self, Table as ReportTable};
use anyhow::{Context, anyhow, bail};
use indicatif::{ProgressBar, ProgressStyle};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use proprio_estimator::config::ConfigError;
use proprio_estimator::offline::Table;
use proprio_estimator::pipeline::Estimate;
use proprio_estimator::setup::Setup;
use proprio_simulator::{Fault, Robot, Settings, Simulator};
use proprio_topics::csv::{self, Value};
use proprio_topics::ipc::{Domain, DomainConfig, Reader, Topic, monotonic};
use proprio_topics::{
    ContactEstimate, ContactWrench, EstimatorHealth, GatewayHealth, JointTorque, Kind, Nanos, Reading, TorqueEstimate,
};
use serde_json::{Value as Json, json};
use std::fs::{self, File};
use std::io::{BufReader, BufWriter, IsTerminal, Write};
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
    /// How long the robot moves [s]
    #[arg(long, value_name = "N", default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
    /// Where report.html, estimates.csv, summary.json and the processes' logs go
    #[arg(long, value_name = "DIR", default_value = "proprio-demo")]
    out: PathBuf,
    /// CAN interfaces to use instead of virtual buses, one per bus of the robot; a single one takes all devices
    #[arg(long, value_name = "INTERFACE")]
    bus: Vec<String>,
    /// The seed of trajectory and noise
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

/// How long the processes may take to be ready, and to end.
const PATIENCE: Nanos = Nanos::from_millis(10_000);
/// Errors count from this long after the first estimate: the paper's definition of a settled estimate is later, not earlier.
const SETTLE: Nanos = Nanos::from_millis(1000);

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
    let setup = Setup::new(&robot.config).map_err(|problem| ConfigError {
        file: folder.join("estimator.toml"),
        problem,
    })?;

    say!(
        "robot {}: simulator, gateway and estimator as three processes; {} s",
        robot.config.robot,
        args.seconds
    );
    let mut processes = Processes {
        private: private.path().to_owned(),
        domain: domain.clone(),
        out: out.clone(),
        running: vec![],
        stop,
    };
    let outcome = watch(args, &robot, &setup, &mut processes);
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
    let truth = Truth::read(&private.path().join("truth.csv"), &watched.joints).context("the simulator's truth")?;
    finish(args, &setup, &out, &watched, &truth)
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
    fs::create_dir_all(to)?;
    fs::write(to.join("gateway.toml"), gateway.to_string())?;
    fs::write(to.join("estimator.toml"), estimator.to_string())?;
    Ok(())
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
    lost_estimates: u64,
    gateway: Box<GatewayHealth>,
    estimator: EstimatorHealth,
    simulator: Json,
}

/// One estimate, as small as it can be kept.
struct Seen {
    t: Nanos,
    published: Nanos,
    joints: Box<[JointTorque]>,
    contacts: Box<[ContactWrench]>,
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
fn watch(args: &Args, robot: &Robot, setup: &Setup, processes: &mut Processes) -> anyhow::Result<Watched> {
    let text = |p: &Path| {
        p.to_str()
            .map(ToOwned::to_owned)
            .with_context(|| format!("{} is not UTF-8", p.display()))
    };
    let truth = text(&processes.private.join("truth.csv"))?;
    let (duration, seed) = (args.seconds.to_string(), args.seed.to_string());
    let folder = text(&robot.folder)?;
    let mut simulate = vec![
        "--robot",
        &folder,
        "--seconds",
        &duration,
        "--seed",
        &seed,
        "--truth",
        &truth,
        "--json",
    ];
    args.fault.iter().for_each(|f| simulate.extend(["--fault", f.as_str()]));
    let (gateway_toml, estimator_toml) = (
        text(&robot.folder.join("gateway.toml"))?,
        text(&robot.folder.join("estimator.toml"))?,
    );
    processes.start("gateway", &["--config", &gateway_toml])?;
    processes.start("estimator", &["--config", &estimator_toml])?;

    let domain = Domain::open(&processes.domain)?;
    let name = robot.config.robot.clone();
    let mut torques: Reader<TorqueEstimate> = open(&domain, &name, processes)?;
    let mut contacts: Reader<ContactEstimate> = open(&domain, &name, processes)?;
    let mut gateway_health: Reader<GatewayHealth> = open(&domain, &name, processes)?;
    let mut estimator_health: Reader<EstimatorHealth> = open(&domain, &name, processes)?;
    // The gateway tells its health once all its links are open: from then on no frame is lost.
    let gateway = Box::new(wait_for(&mut gateway_health, processes)?);
    processes.start("simulate", &simulate)?;

    let joints: Vec<String> = setup.joint_names().map(ToOwned::to_owned).collect();
    let mut screen = Screen::new(args.seconds, &joints);
    let mut watched = Watched {
        joints,
        estimates: Vec::with_capacity((args.seconds * 1100.0) as usize),
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
            }
        }
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
    begin: Option<Nanos>,
    next: Nanos,
    lines: usize,
}

impl Screen {
    fn new(seconds: f64, joints: &[String]) -> Self {
        let terminal = std::io::stdout().is_terminal();
        let bar = if terminal {
            ProgressBar::new((seconds * 10.0) as u64)
        } else {
            ProgressBar::hidden()
        };
        bar.set_style(ProgressStyle::with_template("{bar:40} {msg}").unwrap_or_else(|_| ProgressStyle::default_bar()));
        Self {
            terminal,
            bar,
            joints: joints.to_vec(),
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
        if !self.terminal {
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
        self.bar.set_message(format!("{elapsed:.1} s"));
        self.bar.set_position((elapsed * 10.0) as u64);
    }

    fn end(&self) {
        self.bar.finish_and_clear();
    }
}

/// The simulator's truth: joint torques over time.
struct Truth {
    t: Vec<Nanos>,
    /// Per joint, its torque at each of `t`.
    torques: Vec<Vec<f64>>,
}

impl Truth {
    fn read(file: &Path, joints: &[String]) -> anyhow::Result<Self> {
        let mut reader = csv::Reader::new(BufReader::new(File::open(file)?))?;
        let series: Vec<Option<usize>> = joints
            .iter()
            .map(|j| {
                reader
                    .series()
                    .iter()
                    .position(|s| s.what == csv::What::Channel(Kind::Joint) && s.name == *j)
            })
            .collect();
        let mut this = Self {
            t: vec![],
            torques: vec![vec![]; joints.len()],
        };
        let mut row = csv::Row::default();
        while reader.next_row(&mut row)? {
            let Some(t) = row.t else { continue };
            this.t.push(t);
            for (torques, series) in this.torques.iter_mut().zip(&series) {
                let torque = row
                    .items
                    .iter()
                    .find(|i| Some(i.series) == *series)
                    .and_then(|i| match i.value {
                        Value::Reading(Reading::Joint(state), _) => Some(state.torque),
                        _ => None,
                    });
                torques.push(torque.unwrap_or(f64::NAN));
            }
        }
        Ok(this)
    }

    /// The torque of joint `joint` at `t`, on a straight line between two rows; NaN outside them.
    fn torque(&self, joint: usize, t: Nanos) -> f64 {
        let after = self.t.partition_point(|x| *x < t);
        let row = |i: usize| Some((*self.t.get(i)?, *self.torques.get(joint)?.get(i)?));
        match (row(after), after.checked_sub(1).and_then(row)) {
            (Some((t1, y1)), _) if t1 == t => y1,
            (Some((t1, y1)), Some((t0, y0))) => y0 + (y1 - y0) * ((t - t0).seconds() / (t1 - t0).seconds()),
            _ => f64::NAN,
        }
    }
}

/// The q-quantile of sorted numbers.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let at = ((sorted.len() as f64 - 1.0) * q).round().max(0.0) as usize;
    sorted.get(at).copied().unwrap_or(f64::NAN)
}

/// Writes estimates.csv, summary.json and report.html, and tells the result.
fn finish(args: &Args, setup: &Setup, out: &Path, watched: &Watched, truth: &Truth) -> anyhow::Result<()> {
    let file = |name: &str| -> anyhow::Result<_> {
        Ok(BufWriter::new(
            File::create(out.join(name)).with_context(|| out.join(name).display().to_string())?,
        ))
    };
    let mut table = Table::new(file("estimates.csv")?, setup)?;
    for seen in &watched.estimates {
        let mut estimate = Estimate::absent(seen.t);
        estimate
            .torques
            .joints
            .iter_mut()
            .zip(&seen.joints)
            .for_each(|(to, from)| *to = *from);
        estimate
            .contacts
            .contacts
            .iter_mut()
            .zip(&seen.contacts)
            .for_each(|(to, from)| *to = *from);
        estimate.torques.count = u32::try_from(seen.joints.len())?;
        estimate.contacts.count = u32::try_from(seen.contacts.len())?;
        table.write(&estimate, true)?;
    }
    table.into_inner().flush()?;

    let sum = |f: fn(&proprio_topics::BusHealth) -> u64| watched.gateway.buses().iter().map(f).sum::<u64>();
    let (frames, samples) = (sum(|b| b.frames), sum(|b| b.published));
    // Bus by bus: what one has too many must not hide what another lost.
    let (mut lost, mut foreign) = (watched.estimator.lost, 0);
    for bus in watched.gateway.buses() {
        let of_simulator = watched.simulator["buses"]
            .as_array()
            .into_iter()
            .flatten()
            .find(|b| b["name"] == bus.name.as_str());
        let sent = of_simulator
            .and_then(|b| b["sent"].as_u64())
            .with_context(|| format!("the simulator's count of bus {}", bus.name))?;
        lost += sent.saturating_sub(bus.frames);
        foreign += bus.frames.saturating_sub(sent);
    }
    let first = watched.estimates.first().map_or(Nanos::ZERO, |s| s.t);
    let last = watched.estimates.last().map_or(Nanos::ZERO, |s| s.t);
    let rate = (watched.estimates.len() as f64 - 1.0) / (last - first).seconds();
    let torques = || watched.estimates.iter().flat_map(|s| &s.joints);
    let valid_share = torques().filter(|j| j.valid == 1).count() as f64 / torques().count() as f64;
    let mut latency: Vec<f64> = watched
        .estimates
        .iter()
        .map(|s| (s.published - s.t).seconds() * 1e6)
        .collect();
    latency.sort_by(f64::total_cmp);

    let mut errors = serde_json::Map::new();
    let mut plots = Vec::new();
    let mut rows = ReportTable::new(
        "Torques against the simulator's truth, from one second on",
        &["joint", "RMS error [Nm]", "RMS torque [Nm]"],
    );
    for (joint, name) in watched.joints.iter().enumerate() {
        let (mut square, mut truth_square, mut count) = (0.0, 0.0, 0_u32);
        let (mut estimated, mut real, mut error) = (vec![], vec![], vec![]);
        for seen in &watched.estimates {
            let Some(torque) = seen.joints.get(joint) else { continue };
            let right = truth.torque(joint, seen.t);
            let t = (seen.t - first).seconds();
            estimated.push((t, torque.torque));
            real.push((t, right));
            error.push((t, torque.torque - right));
            // The last few estimates may be later than the truth's last row.
            if seen.t - first >= SETTLE && !right.is_nan() {
                square += (torque.torque - right).powi(2);
                truth_square += right.powi(2);
                count += 1;
            }
        }
        if count == 0 {
            bail!(
                "no estimate of {name} can be compared with the truth: the motion was too short, or nothing came after its first second"
            );
        }
        let rms = (square / f64::from(count)).sqrt();
        errors.insert(name.clone(), json!(rms));
        rows.row(vec![
            name.as_str().into(),
            rms.into(),
            (truth_square / f64::from(count)).sqrt().into(),
        ]);
        let plot = |title: String, note: &str, series| Plot {
            title,
            note: note.to_owned(),
            x: Axis::new("t [s]"),
            y: Axis::new("torque [Nm]"),
            series,
            ..Plot::default()
        };
        plots.push(plot(
            name.clone(),
            "",
            vec![
                Series::line("estimated", Ink::Identified, estimated),
                Series::line("truth", Ink::Measured, real),
            ],
        ));
        plots.push(plot(
            name.clone(),
            "error: estimated − truth",
            vec![Series::line("", Ink::Cad, error)],
        ));
    }
    let upstream = setup.upstream_note();

    let latency_us =
        json!({ "p50": quantile(&latency, 0.5), "p99": quantile(&latency, 0.99), "p999": quantile(&latency, 0.999) });
    let summary = json!({
        "robot": setup.robot, "seconds": args.seconds, "seed": args.seed,
        "frames": frames, "samples": samples, "lost": lost, "foreign": foreign, "estimates": watched.estimates.len(),
        "lost_estimates": watched.lost_estimates, "late": watched.estimator.late,
        "rate_hz": rate, "valid_share": valid_share, "latency_us": latency_us, "torque_rms_error_nm": errors,
        "simulator": watched.simulator,
    });
    let mut text = serde_json::to_string_pretty(&summary)?;
    text.push('\n');
    fs::write(out.join("summary.json"), text)?;
    let facts = [
        ("robot", setup.robot.clone()),
        ("motion", format!("{} s, seed {}", args.seconds, args.seed)),
        ("frames", format!("{frames} received, {lost} lost")),
        (
            "estimates",
            format!(
                "{} at {rate:.1} Hz, {:.2} % of torques valid",
                watched.estimates.len(),
                valid_share * 100.0
            ),
        ),
        (
            "latency",
            format!(
                "{:.0} us median, {:.0} us at 99 %, from frame stamp to torque published",
                quantile(&latency, 0.5),
                quantile(&latency, 0.99)
            ),
        ),
    ];
    fs::write(
        out.join("report.html"),
        report::page(
            &format!("proprio demo: {}", setup.robot),
            &[
                report::facts(&facts),
                report::section(
                    "Joint torques",
                    &[rows.html(), report::paragraph(&upstream), report::figures(&plots)],
                ),
            ],
        ),
    )?;

    for (name, value) in &facts {
        say!("{name:<10} {value}");
    }
    say!("RMS error of the torques against the simulator's truth, from one second on:");
    for (joint, error) in &errors {
        say!("  {joint:<20} {:.4} Nm", error.as_f64().unwrap_or(f64::NAN));
    }
    if !upstream.is_empty() {
        say!("{upstream}");
    }
    say!(
        "{}: report.html, estimates.csv, summary.json and the processes' logs",
        args.out.display()
    );
    Ok(())
}
