//! The `proprio` command: every verb in one program. `proprio --help` lists them.

/// `println!` for people who pipe into `head`: an output that nobody reads any more is not an error.
macro_rules! say {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($text)*);
    }};
}

/// The same without a line's end.
macro_rules! say_part {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stdout(), $($text)*);
    }};
}

mod convert;
mod demo;
mod doctor;
mod estimator;
mod identify;
mod report;
mod simulate;

use clap::{Parser, Subcommand};
use proprio_topics::ipc::DomainConfig;
use std::path::PathBuf;
use std::process::ExitCode;

/// A robot's proprioception over CAN: joint torques and contact wrenches from encoders, IMUs and force/torque sensors.
///
/// Exit codes: 0 success, 2 a wrong configuration or command line, 1 any other failure.
#[derive(Parser)]
#[command(name = "proprio", version, about)]
struct Args {
    #[command(subcommand)]
    verb: Verb,
    /// The shared-memory domain: processes of one domain see each other, others do not [env: PROPRIO_DOMAIN] [default: default]
    #[arg(long, global = true, value_name = "NAME")]
    domain: Option<String>,
}

#[derive(Subcommand)]
enum Verb {
    /// Run a simulated robot through gateway and estimator, as three processes, and compare with the truth
    Demo(demo::Args),
    /// The gateway daemon: CAN buses in, samples in shared memory out
    Gateway(Daemon),
    /// The estimator daemon: samples in, joint torques and contact wrenches out
    Estimator(estimator::Args),
    /// The simulated robot alone: its boards on a bus
    Simulate(simulate::Args),
    /// A recorded CAN log to a table of samples in SI units
    Decode(convert::Decode),
    /// A table of samples to a CAN log: the inverse of decode
    Encode(convert::Encode),
    /// A table of samples to a table of joint torques and contact wrenches
    Estimate(convert::Estimate),
    /// Recorded tables of samples to inertial parameters, with a report
    Identify(identify::Args),
    /// What this machine lacks: CAN, rights, shared memory, buffers, real-time limits
    Doctor(doctor::Args),
}

#[derive(clap::Args)]
struct Daemon {
    /// The configuration file
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print the plan and end
    #[arg(long)]
    check: bool,
}

fn main() -> ExitCode {
    let args = Args::parse();
    proprio_gateway::daemon::start_logging();
    let mut domain = DomainConfig::from_env();
    if let Some(name) = args.domain {
        domain.name = name;
    }
    let result = match args.verb {
        Verb::Demo(args) => demo::run(&args),
        Verb::Gateway(args) => proprio_gateway::daemon::run(&args.config, &domain, args.check),
        Verb::Estimator(args) => estimator::run(&args, &domain),
        Verb::Simulate(args) => simulate::run(&args, &domain),
        Verb::Decode(args) => convert::decode(&args),
        Verb::Encode(args) => convert::encode(&args),
        Verb::Estimate(args) => convert::estimate(&args),
        Verb::Identify(args) => identify::run(&args),
        Verb::Doctor(args) => doctor::run(&args, &domain),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => fail(&error),
    }
}

/// Tells an error as one chain; 2 if a wrong configuration is at its root, else 1.
fn fail(error: &anyhow::Error) -> ExitCode {
    eprintln!("error: {error:#}");
    let configuration = proprio_simulator::is_configuration(error)
        || proprio_gateway::daemon::is_configuration(error)
        || proprio_estimator::daemon::is_configuration(error);
    ExitCode::from(if configuration { 2 } else { 1 })
}
