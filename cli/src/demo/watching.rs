//! Collects and shows the outputs of the processes while the demonstration runs.

use super::baseline::{Baseline, Readers};
use super::experiment::{DemoArgs, Experiment};
use super::processes::{PATIENCE, Processes};
use anyhow::{Context, anyhow, bail};
use indicatif::{ProgressBar, ProgressStyle};
use proprio_simulator::SimulatedRobot;
use proprio_topics::ipc::{Domain, Reader, Topic, monotonic};
use proprio_topics::{
    ContactEstimate, ContactWrench, EstimatorHealth, GatewayHealth, InertiaEstimate, JointTorque,
    LinkInertia, Nanos, Residual, SensorOffset, TorqueEstimate,
};
use serde_json::Value as Json;
use std::fs::{self};
use std::io::{IsTerminal, Write};
use std::path::Path;
use std::time::Duration;

/// The data received through shared memory.
pub(crate) struct ReceivedRun {
    pub(crate) joints: Vec<String>,
    pub(crate) estimates: Vec<ReceivedEstimate>,
    /// The torques with the CAD's parameters, from the same samples.
    pub(crate) baseline: Vec<(Nanos, Box<[f64]>)>,
    /// The identified parameters of each solution.
    pub(crate) learnt: Vec<Learnt>,
    pub(crate) lost_estimates: u64,
    pub(crate) gateway: Box<GatewayHealth>,
    pub(crate) estimator: EstimatorHealth,
    pub(crate) simulator: Json,
}

/// The parameters identified from the data up to an instant.
pub(crate) struct Learnt {
    pub(crate) t: Nanos,
    pub(crate) links: Box<[LinkInertia]>,
    pub(crate) offsets: Box<[SensorOffset]>,
}

/// One estimate in compact form.
pub(crate) struct ReceivedEstimate {
    pub(crate) t: Nanos,
    pub(crate) published: Nanos,
    pub(crate) joints: Box<[JointTorque]>,
    pub(crate) contacts: Box<[ContactWrench]>,
    pub(crate) residuals: Box<[Residual]>,
}

pub(crate) fn open<T: Topic>(
    domain: &Domain,
    robot: &str,
    processes: &mut Processes,
) -> anyhow::Result<Reader<T>> {
    let end = monotonic() + PATIENCE;
    let mut ended = None;
    let reader = Reader::wait_open(domain, robot, |_| {
        std::thread::sleep(Duration::from_millis(5));
        let failed = ["gateway", "estimator"]
            .into_iter()
            .find_map(|p| match processes.ended(p) {
                Ok(false) => None,
                Ok(true) => Some(anyhow!("{p} ended before the demonstration was over")),
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

/// The topics of gateway and estimator that are watched.
struct OutputReaders {
    torques: Reader<TorqueEstimate>,
    contacts: Reader<ContactEstimate>,
    /// If nothing can be identified, the estimator does not publish the inertia.
    inertias: Option<Reader<InertiaEstimate>>,
    gateway: Reader<GatewayHealth>,
    estimator: Reader<EstimatorHealth>,
}

impl OutputReaders {
    fn open(
        domain: &Domain,
        robot: &str,
        has_inertias: bool,
        processes: &mut Processes,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            torques: open(domain, robot, processes)?,
            contacts: open(domain, robot, processes)?,
            inertias: match has_inertias {
                true => Some(open(domain, robot, processes)?),
                false => None,
            },
            gateway: open(domain, robot, processes)?,
            estimator: open(domain, robot, processes)?,
        })
    }

    /// Takes what has come; returns whether there was a torque.
    fn take(&mut self, run: &mut ReceivedRun, baseline: &mut Baseline) -> anyhow::Result<bool> {
        let before = run.estimates.len();
        while let Some(estimate) = self.torques.try_take()? {
            run.estimates.push(ReceivedEstimate {
                t: estimate.header.acquired,
                published: estimate.header.published,
                joints: estimate.joints().into(),
                contacts: Box::default(),
                residuals: Box::default(),
            });
        }
        while let Some(estimate) = self.contacts.try_take()? {
            // The contacts of an instant follow its torques immediately.
            let mut newest = run.estimates.iter_mut().rev().take(600);
            if let Some(seen) = newest.find(|s| s.t == estimate.header.acquired) {
                seen.contacts = estimate.contacts().into();
                seen.residuals = estimate.residuals().into();
            }
        }
        while let Some(inertia) = self.inertias.as_mut().map_or(Ok(None), Reader::try_take)? {
            baseline.take_offsets(inertia.offsets());
            // Before the first solution the CAD's parameters are in use.
            if inertia.links().iter().any(|link| link.accepted == 1) {
                run.learnt.push(Learnt {
                    t: inertia.header.acquired,
                    links: inertia.links().into(),
                    offsets: inertia.offsets().into(),
                });
            }
        }
        baseline.turn()?;
        self.take_health(run)?;
        Ok(run.estimates.len() > before)
    }

    fn take_health(&mut self, run: &mut ReceivedRun) -> anyhow::Result<()> {
        if let Some(health) = self.gateway.latest()? {
            *run.gateway = health;
        }
        if let Some(health) = self.estimator.latest()? {
            run.estimator = health;
        }
        Ok(())
    }
}

fn utf8(path: &Path) -> anyhow::Result<&str> {
    path.to_str()
        .with_context(|| format!("{} is not UTF-8", path.display()))
}

/// The command line of the simulator.
fn simulate(
    args: &DemoArgs,
    robot: &SimulatedRobot,
    processes: &Processes,
) -> anyhow::Result<Vec<String>> {
    let truth = processes.private.join("truth.csv");
    let options = [
        ("--robot", utf8(&robot.folder)?.to_owned()),
        ("--seconds", args.seconds.to_string()),
        ("--seed", args.seed.to_string()),
        ("--still", args.still().to_string()),
        ("--truth", utf8(&truth)?.to_owned()),
    ];
    let faults = args.fault.iter().map(|fault| ("--fault", fault.clone()));
    let options = options.into_iter().chain(faults);
    let options = options.flat_map(|(key, value)| [key.to_owned(), value]);
    let flags = ["--skin", "--json"].map(str::to_owned);
    Ok(flags.into_iter().chain(options).collect())
}

/// Starts the processes and watches until the robot has stopped.
pub(crate) fn watch(
    args: &DemoArgs,
    robot: &SimulatedRobot,
    experiment: &Experiment,
    processes: &mut Processes,
) -> anyhow::Result<ReceivedRun> {
    let simulate = simulate(args, robot, processes)?;
    let (gateway_toml, estimator_toml) = (utf8(&experiment.gateway)?, utf8(&experiment.config)?);
    processes.start("gateway", &["--config", gateway_toml])?;
    processes.start("estimator", &["--config", estimator_toml])?;

    let domain = Domain::open(&processes.domain)?;
    let name = &robot.config.robot;
    let mut readers = OutputReaders::open(&domain, name, experiment.refused.is_none(), processes)?;
    // The gateway sends its first health message when all its links are open: from then on no frame
    // is lost.
    let gateway = Box::new(wait_for(&mut readers.gateway, processes)?);
    let inputs = Readers {
        samples: open(&domain, name, processes)?,
        descriptions: open(&domain, name, processes)?,
        declarations: open(&domain, name, processes)?,
    };
    let mut baseline = Baseline::new(experiment.baseline.clone(), inputs);
    processes.start("simulate", &simulate)?;

    let joints = experiment.setup.robot.joint_names();
    let joints: Vec<String> = joints.map(ToOwned::to_owned).collect();
    let mut screen = LiveTable::new(args, experiment, &joints);
    let mut run = ReceivedRun {
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
        let any = readers.take(&mut run, &mut baseline)?;
        let now = monotonic();
        if any {
            last_seen = now;
            screen.show(run.estimates.last(), now);
        }
        for process in ["gateway", "estimator"] {
            if processes.ended(process)? {
                bail!("{process} ended before the demonstration was over");
            }
        }
        if processes.ended("simulate")? && now - last_seen > Nanos::from_millis(400) {
            break;
        }
        // The simulator writes the truth after the motion, with a row per millisecond.
        if now - begin > Nanos::from_seconds(1.5 * args.seconds) + PATIENCE {
            bail!("the simulator does not end");
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    screen.end();
    run.baseline = baseline.finish();
    run.lost_estimates = readers.torques.lost();
    // Wait for the final counts: two more health messages of each process.
    let end = monotonic() + Nanos::from_millis(300);
    while monotonic() < end {
        readers.take_health(&mut run)?;
        std::thread::sleep(Duration::from_millis(10));
    }
    let summary = fs::read_to_string(processes.private.join("simulate.json"))?;
    run.simulator =
        serde_json::from_str(summary.trim()).context("cannot read the simulator's summary")?;
    if run.estimates.is_empty() {
        bail!("no estimate was published");
    }
    Ok(run)
}

pub(crate) fn wait_for<T: Topic>(
    reader: &mut Reader<T>,
    processes: &mut Processes,
) -> anyhow::Result<T> {
    let end = monotonic() + PATIENCE;
    loop {
        if let Some(value) = reader.latest()? {
            return Ok(value);
        }
        if processes.ended("gateway")? || monotonic() > end {
            bail!("the gateway publishes no health messages");
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Why a torque has no value.
fn withheld(torque: &JointTorque) -> String {
    let reason = torque.reason.get().unwrap_or_default();
    if torque.standard_deviation.is_finite() {
        format!("withheld ({reason}, +- {:.2})", torque.standard_deviation)
    } else {
        format!("withheld ({reason})")
    }
}

/// The live table and the progress bar; one line per second if the output is not a terminal.
pub(crate) struct LiveTable {
    pub(crate) terminal: bool,
    pub(crate) bar: ProgressBar,
    /// Number and name of each joint, in the order in which they are told.
    pub(crate) joints: Vec<(usize, String)>,
    /// Start of the motion [s].
    pub(crate) still: f64,
    /// Whether anything can be identified.
    pub(crate) learns: bool,
    pub(crate) has_told: bool,
    pub(crate) begin: Option<Nanos>,
    pub(crate) next: Nanos,
    pub(crate) lines: usize,
}

impl LiveTable {
    pub(crate) fn new(args: &DemoArgs, experiment: &Experiment, joints: &[String]) -> Self {
        let named = |&joint: &usize| Some((joint, joints.get(joint)?.clone()));
        let terminal = std::io::stdout().is_terminal();
        let bar = if terminal {
            ProgressBar::new((args.seconds * 10.0) as u64)
        } else {
            ProgressBar::hidden()
        };
        bar.set_style(
            ProgressStyle::with_template("{bar:40} {msg}")
                .unwrap_or_else(|_| ProgressStyle::default_bar()),
        );
        Self {
            terminal,
            bar,
            joints: experiment.order.iter().filter_map(named).collect(),
            still: args.still(),
            learns: experiment.refused.is_none(),
            has_told: false,
            begin: None,
            next: Nanos::ZERO,
            lines: 0,
        }
    }

    pub(crate) fn show(&mut self, last: Option<&ReceivedEstimate>, now: Nanos) {
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
        let estimate = |i: usize| last.joints.get(i);
        let moves = elapsed >= self.still;
        if !self.terminal {
            if moves && !std::mem::replace(&mut self.has_told, true) {
                print_line!("{elapsed:5.1} s  the robot begins to move");
            }
            let cells: Vec<_> = self
                .joints
                .iter()
                .map(|(i, j)| {
                    estimate(*i).map_or_else(String::new, |t| {
                        if t.valid == 1 {
                            format!("{j} {:.2}", t.torque)
                        } else {
                            format!("{j} {}", withheld(t))
                        }
                    })
                })
                .collect();
            print_line!("{elapsed:5.1} s  {}", cells.join("  "));
            return;
        }
        let mut text = String::new();
        for (i, joint) in &self.joints {
            let Some(torque) = estimate(*i) else { continue };
            let value = if torque.valid == 1 {
                format!(
                    "{:>9.3} Nm  +- {:.3}",
                    torque.torque, torque.standard_deviation
                )
            } else {
                format!("{:>9}     {}", "", withheld(torque))
            };
            text.push_str(&format!("\x1b[2K{joint:<20} {value}\n"));
        }
        self.bar.suspend(|| {
            if self.lines > 0 {
                print_part!("\x1b[{}A", self.lines);
            }
            print_part!("{text}");
            let _ = std::io::stdout().flush();
        });
        self.lines = self.joints.len();
        let doing = match (moves, self.learns) {
            (false, _) => "standing still",
            (true, true) => "moving, identifying",
            (true, false) => "moving",
        };
        self.bar.set_message(format!("{elapsed:.1} s, {doing}"));
        self.bar.set_position((elapsed * 10.0) as u64);
    }

    pub(crate) fn end(&self) {
        self.bar.finish_and_clear();
    }
}
