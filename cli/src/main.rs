#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]
// The comments are the text of --help, where units stand in brackets as they are.
#![allow(rustdoc::broken_intra_doc_links, rustdoc::invalid_html_tags)]

#[macro_use]
mod print;

mod convert;
mod ctl;
mod demo;
mod doctor;
mod echo;
mod estimator;
mod excite;
mod folder;
mod help;
mod identifiable;
mod identify;
mod install;
mod names;
mod programs;
mod record;
mod report;
mod running;
mod samples;
mod scan;
mod setup;
mod simulate;
mod status;
mod table;
mod top;
mod why;

use clap::{CommandFactory as _, Parser, Subcommand};
use proprio_topics::ipc::{DomainConfig, DomainError};
use std::path::PathBuf;
use std::process::ExitCode;

/// Robot proprioception over CAN: joint torques and contact wrenches from encoders, IMUs and
/// force/torque sensors.
///
/// Exit codes: 0 success, 2 wrong configuration or command line, 1 any other failure.
#[derive(Parser)]
#[command(name = "proprio", version, about, disable_help_subcommand = true)]
struct CommandLine {
    #[command(subcommand)]
    verb: Verb,
    /// The shared-memory domain: only processes of one domain see each other [env: PROPRIO_DOMAIN]
    /// [default: default]
    #[arg(long, global = true, value_name = "NAME")]
    domain: Option<String>,
}

#[derive(Subcommand)]
enum Verb {
    /// Simulate a robot, run gateway and estimator on it, and compare with the truth
    Demo(demo::DemoArgs),
    /// Run the gateway daemon: read CAN buses, publish samples in shared memory
    Gateway(GatewayArgs),
    /// Run the estimator daemon: read samples, publish joint torques and contact wrenches
    Estimator(estimator::EstimatorArgs),
    /// Run only the simulated robot: its boards on a bus
    Simulate(simulate::SimulateArgs),
    /// Find out which devices are on a bus, or in a recorded log
    Scan(scan::ScanArgs),
    /// Write a gateway.toml for the devices that are found on the buses of this machine
    Setup(setup::SetupArgs),
    /// Convert a recorded CAN log to a table of samples in SI units
    Decode(convert::DecodeArgs),
    /// Convert a table of samples to a CAN log: the inverse of decode
    Encode(convert::EncodeArgs),
    /// Convert a recording (MCAP) to a table of its samples or estimates
    Table(table::TableArgs),
    /// Estimate joint torques and contact wrenches from a table of samples
    Estimate(convert::EstimateArgs),
    /// Tell what a robot's F/T sensors can identify, and which torques rest on CAD for ever
    Identifiable(identifiable::IdentifiableArgs),
    /// Plan the motion that lessens the uncertainty of torques the most
    Excite(excite::ExciteArgs),
    /// Identify inertial parameters from recorded tables of samples and write a report
    Identify(identify::IdentifyArgs),
    /// Show the robots of a running system: processes, buses, devices, channels, estimates
    Status(status::StatusArgs),
    /// Show a running robot on the whole terminal: torques, contacts, channels, buses
    Top(top::TopArgs),
    /// Say why a torque is what it is, how uncertain it is and why, or why it is withheld
    Why(why::WhyArgs),
    /// Print the samples of a channel, the torques or the contacts as they come
    Echo(echo::EchoArgs),
    /// Record what a robot measures and feels: a table, a recording, a black box
    Record(record::RecordArgs),
    /// Ask a running gateway: its state, its devices, a tare, a changed configuration
    Ctl(ctl::CtlArgs),
    /// Let Foxglove look at a running robot (the program proprio-view)
    View(programs::ProgramArgs),
    /// Publish a running robot to ROS 2 (the program proprio-ros2)
    Ros2(programs::ProgramArgs),
    /// Check this machine: CAN, permissions, shared memory, buffers, real-time limits
    Doctor(doctor::DoctorArgs),
    /// Install this program, its systemd units and a robot's configuration
    Install(install::InstallArgs),
    /// Show a page of the book: a key, a driver, a reason, a verb; `help topics` lists all
    Help(help::HelpArgs),
    /// Print the completions of a shell: `source <(proprio completions bash)`
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

#[derive(clap::Args)]
struct GatewayArgs {
    /// The configuration file
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Check the configuration, print the resulting plan and exit
    #[arg(long)]
    check: bool,
}

fn main() -> ExitCode {
    let args = CommandLine::parse();
    let is_journal = proprio_gateway::daemon::start_logging();
    // Recordings: what reads logs reads their frames.
    proprio_gateway::log::convert_with(samples::log_of_file);
    let mut domain = DomainConfig::from_env();
    if let Some(name) = args.domain {
        domain.name = name;
    }
    let result = match args.verb {
        Verb::Demo(args) => demo::run(&args, &domain),
        Verb::Gateway(args) => proprio_gateway::daemon::run(&args.config, &domain, args.check),
        Verb::Estimator(args) => estimator::run(&args, &domain),
        Verb::Simulate(args) => simulate::run(&args, &domain),
        Verb::Scan(args) => scan::run(&args, &domain),
        Verb::Setup(args) => setup::run(&args, &domain),
        Verb::Decode(args) => convert::decode(&args),
        Verb::Encode(args) => convert::encode(&args),
        Verb::Table(args) => table::run(&args),
        Verb::Why(args) => why::run(&args, &domain),
        Verb::Estimate(args) => convert::estimate(&args),
        Verb::Identifiable(args) => identifiable::run(&args),
        Verb::Excite(args) => excite::run(&args),
        Verb::Identify(args) => identify::run(&args),
        Verb::Status(args) => status::run(&args, &domain),
        Verb::Top(args) => top::run(&args, &domain),
        Verb::Echo(args) => echo::run(&args, &domain),
        Verb::Record(args) => record::run(&args, &domain),
        Verb::Ctl(args) => ctl::run(&args, &domain),
        Verb::View(args) => programs::run("view", &args, &domain),
        Verb::Ros2(args) => programs::run("ros2", &args, &domain),
        Verb::Doctor(args) => doctor::run(&args, &domain),
        Verb::Install(args) => install::run(&args),
        Verb::Help(args) => {
            help::run(&args, CommandLine::command());
            Ok(())
        }
        Verb::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut CommandLine::command(), "proprio", &mut script);
            print_part!("{}", String::from_utf8_lossy(&script));
            Ok(())
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => fail(&error, is_journal),
    }
}

/// Prints an error chain; exit code 2 if its root is a wrong configuration, else 1.
fn fail(error: &anyhow::Error, is_journal: bool) -> ExitCode {
    if is_journal {
        // Not through the journal's socket: the journal looks up there, by the process, which
        // service a line is from, and the process may have ended by then (systemd issue 2913).
        // It knows whose standard error it reads. The prefix is syslog's number of an error.
        for line in format!("{error:#}").lines() {
            eprintln!("<3>{line}");
        }
    } else {
        eprintln!("error: {error:#}");
    }
    ExitCode::from(if is_configuration(error) { 2 } else { 1 })
}

/// Whether a wrong configuration is at the root of an error.
fn is_configuration(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.is::<proprio_gateway::plan::PlanError>()
            || cause.is::<proprio_estimator::config::InvalidConfig>()
            || cause.is::<proprio_simulator::SimulatorError>()
            || cause.is::<proprio_simulator::SimulatedRobotError>()
            || cause.is::<proprio_simulator::FaultError>()
            || cause.is::<proprio_simulator::RunOptionsError>()
            || (cause.downcast_ref()).is_some_and(DomainError::is_configuration)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::path::Path;

    /// `packaging/man/` has what clap says of each verb.
    #[test]
    fn the_man_pages_are_new() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../packaging/man");
        let mut program = CommandLine::command();
        program.build();
        for verb in [&program].into_iter().chain(program.get_subcommands()) {
            let name = verb.get_display_name().unwrap_or_else(|| verb.get_name());
            let page = clap_mangen::Man::new(verb.clone()).source("Proprio");
            let mut made = Vec::new();
            page.render(&mut made).expect("a page");
            let file = folder.join(format!("{name}.1"));
            if std::env::var_os("PROPRIO_WRITE_MAN").is_some() {
                fs::write(&file, &made).expect("the page can be written");
            }
            assert!(
                fs::read(&file).unwrap_or_default() == made,
                "{} is old: PROPRIO_WRITE_MAN=1 cargo test -p proprio-cli man",
                file.display()
            );
        }
    }
}
