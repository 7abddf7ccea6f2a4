//! `proprio simulate`: runs only the simulated robot, its boards on a bus.

use crate::running::interrupted;
use proprio_simulator::{InjectedFault, RunOptions, SimulatedRobot, SimulationSettings, parse_bus};
use proprio_topics::ipc::{Domain, DomainConfig, Writer, monotonic};
use proprio_topics::{ContactDeclaration, ContactState, Name, Nanos};
use std::path::PathBuf;

/// `proprio simulate`.
#[derive(clap::Args)]
pub(crate) struct SimulateArgs {
    /// The robot: a folder in config/, or a path
    #[arg(long, value_name = "NAME", default_value = "icub_left_arm")]
    robot: String,
    /// Its buses, in the order of its gateway.toml: can0 or virtual:NAME; default: the sources in
    /// gateway.toml
    #[arg(long, value_name = "BUS")]
    bus: Vec<String>,
    /// Duration [s]; default: until it is stopped
    #[arg(long, value_name = "N")]
    seconds: Option<f64>,
    /// The seed of trajectory and noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Duration without motion at the start [s]
    #[arg(long, value_name = "N", default_value_t = 1.0, value_parser = still)]
    still: f64,
    /// Do not push the robot's hand; otherwise it is pushed from 40 % to 60 % of the duration, or
    /// of every 20 s without one
    #[arg(long)]
    no_push: bool,
    /// Declare touches of the robot on ROBOT/contact/declared, as a skin does
    #[arg(long)]
    skin: bool,
    /// A fault: "lost:0.01", "silent:BOARD@3..4", "saturate:BOARD@5..5.5", "spike:BOARD@6",
    /// "freeze:BOARD@5..6", "late:BOARD=0.02@2..8" (readings of 0.02 s before),
    /// "late_half:BOARD@2..8", "push:LINK=20@8..9", "push:LINK=20:X,Y,Z:DX,DY,DZ@8..9" (where [m]
    /// and along what, in the link's frame), "still:JOINT", "still:JOINT=0.8" (where it stands);
    /// may be repeated
    #[arg(long, value_name = "FAULT")]
    fault: Vec<String>,
    /// The file for the truth, written at the end: a table of joint torques, wrenches and motion
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Print a summary of the run as JSON
    #[arg(long)]
    json: bool,
}

fn still(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if (0.0..=3600.0).contains(&s) => Ok(s),
        _ => Err("must be 0 to 3600".into()),
    }
}

/// Runs the simulated robot.
pub(crate) fn run(args: &SimulateArgs, domain: &DomainConfig) -> anyhow::Result<()> {
    let robot = SimulatedRobot::open(&args.robot)?;
    let faults = args
        .fault
        .iter()
        .map(|f| f.parse::<InjectedFault>())
        .collect::<Result<Vec<_>, _>>()?;
    let options = RunOptions {
        buses: args
            .bus
            .iter()
            .map(|b| parse_bus(b))
            .collect::<Result<_, _>>()?,
        domain: domain.name.clone(),
        seconds: args.seconds,
        settings: SimulationSettings {
            seed: args.seed,
            still: args.still,
            push: !args.no_push,
            faults,
            ..SimulationSettings::default()
        },
        truth: args.truth.clone(),
    };
    let stop = interrupted()?;
    let mut skin = args
        .skin
        .then(|| TouchPublisher::open(domain, &robot.config.robot))
        .transpose()?;
    let mut declare = |contact: &str, at, active| {
        if let Some(skin) = &mut skin {
            skin.declare(contact, at, active);
        }
    };
    let summary = proprio_simulator::run_with_skin(
        &robot,
        &options,
        args.skin.then_some(&mut declare),
        &stop,
    )?;
    if args.json {
        print_line!("{}", serde_json::to_string(&summary)?);
    } else {
        eprintln!("{} frames sent in {:.1} s", summary.sent, summary.seconds);
    }
    Ok(())
}

/// Publishes the touches of the robot as contact declarations.
struct TouchPublisher(Writer<ContactDeclaration>);

impl TouchPublisher {
    fn open(domain: &DomainConfig, robot: &str) -> anyhow::Result<Self> {
        let domain = Domain::open(domain)?;
        Ok(Self(Writer::create(&domain, robot, domain.epoch())?))
    }

    fn declare(&mut self, contact: &str, at: Nanos, active: bool) {
        let contact = Name::new(contact).unwrap_or(Name::EMPTY);
        let state = ContactState::configured(active);
        let declaration = ContactDeclaration::new(contact, at, &state);
        if let Err(error) = self.0.send(&declaration, monotonic()) {
            tracing::warn!("a touch could not be declared: {error}");
        }
    }
}
