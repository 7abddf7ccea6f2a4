//! `proprio simulate`: the simulated robot alone, its boards on a bus.

use anyhow::Context;
use proprio_simulator::{Fault, Options, Robot, Settings, parse_bus};
use proprio_topics::ipc::DomainConfig;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// `proprio simulate`.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The robot: a folder in config/, or a path
    #[arg(long, value_name = "NAME", default_value = "icub_left_arm")]
    robot: String,
    /// Where its buses are, in the order of its gateway.toml: can0 or virtual:NAME; default: as gateway.toml says
    #[arg(long, value_name = "BUS")]
    bus: Vec<String>,
    /// How long it runs [s]; default: until it is told to stop
    #[arg(long, value_name = "N")]
    seconds: Option<f64>,
    /// The seed of trajectory and noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A fault: "lost:0.01", "silent:BOARD@3..4", "saturate:BOARD@5..5.5", "spike:BOARD@6", "late_half:BOARD@2..8"; may be repeated
    #[arg(long, value_name = "FAULT")]
    fault: Vec<String>,
    /// Where to write the truth at the end: a table of joint torques, wrenches and motion
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Print what became of the run as JSON
    #[arg(long)]
    json: bool,
}

/// Runs the simulated robot.
pub(crate) fn run(args: &Args, domain: &DomainConfig) -> anyhow::Result<()> {
    let robot = Robot::open(&args.robot)?;
    let faults = args
        .fault
        .iter()
        .map(|f| f.parse::<Fault>())
        .collect::<Result<Vec<_>, _>>()?;
    let options = Options {
        buses: args.bus.iter().map(|b| parse_bus(b)).collect::<Result<_, _>>()?,
        domain: domain.name.clone(),
        seconds: args.seconds,
        settings: Settings {
            seed: args.seed,
            faults,
            ..Settings::default()
        },
        truth: args.truth.clone(),
    };
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("cannot catch signals")?;
    }
    let summary = proprio_simulator::run(&robot, &options, &stop)?;
    if args.json {
        say!("{}", serde_json::to_string(&summary)?);
    } else {
        eprintln!("{} frames sent in {:.1} s", summary.sent, summary.seconds);
    }
    Ok(())
}
